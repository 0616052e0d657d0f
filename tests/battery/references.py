"""Brute force: estimation matrices row by row, distances by projection onto the exact matches.  Nothing of the library is used."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations

import torch
from torch import Tensor

from dyntorch.core.primitives import Hyperplane, HyperplanesThrough, Line, Monomials, Primitive, Projected
from tests.battery.cases import Case, Motion, lift

Views = tuple[Tensor, ...]


def plucker(ends: Tensor) -> Tensor:
    """The six minors of two points ``(..., 2, 3)``, in the order 01, 02, 03, 12, 13, 23."""
    p, q = lift(ends).unbind(-2)
    return torch.stack([p[..., i] * q[..., j] - p[..., j] * q[..., i] for i, j in combinations(range(4), 2)], dim=-1)


def monomials(p: Tensor, mixed: float = 1.0) -> Tensor:
    """Of degree two, in the order 00, 01, 02, 11, 12, 22, with a factor for those of two coordinates."""
    return torch.stack([p[i] * p[j] * (1.0 if i == j else mixed) for i in range(len(p)) for j in range(i, len(p))])


def lifted_frame(frame: Tensor) -> Tensor:
    """How a change of coordinates acts on the monomials of degree two: read off enough points."""
    points = torch.randn(20, len(frame), generator=torch.Generator().manual_seed(0), dtype=frame.dtype)
    before, after = (torch.stack([monomials(p) for p in q]) for q in (points, points @ frame.T))
    return torch.linalg.lstsq(before, after).solution.T


def subdeterminants(matrix: Tensor, order: int) -> Tensor:
    """All minors of an order, in lexicographic order of rows and columns."""
    rows, columns = (list(combinations(range(size), order)) for size in matrix.shape)
    return torch.stack([torch.stack([torch.linalg.det(matrix[list(r)][:, list(c)]) for c in columns]) for r in rows])


def vectors(primitive: Primitive, x: Tensor) -> list[Tensor]:
    """All vectors that one measurement puts into its slot, as long as they count."""
    if isinstance(primitive, Hyperplane):
        return [x / x[:-1].norm()]
    if isinstance(primitive, Line):
        return [plucker(x) / (x[1] - x[0]).norm().sqrt()]
    if isinstance(primitive, Monomials):
        return [monomials(lift(x), 2**0.5 if primitive.isometric else 1.0)]
    if isinstance(primitive, HyperplanesThrough):
        planes = torch.cat([torch.eye(len(x), dtype=x.dtype), -x[:, None]], dim=1)
        return list(subdeterminants(planes, primitive.order))
    return [lift(x)]


def free_vectors(primitive: Primitive, x: Tensor) -> list[Tensor]:
    """All vectors that a slot allows when the other slots hold one and the same static thing."""
    if isinstance(primitive, Line):
        # the lines that meet a line are those whose moment form with it vanishes: 01 goes with 23, 02 with -13, 03 with 12
        form = torch.zeros(6, 6, dtype=x.dtype)
        for (a, b), sign in {(0, 5): 1.0, (1, 4): -1.0, (2, 3): 1.0}.items():
            form[a, b] = form[b, a] = sign
        return list(torch.linalg.svd((plucker(x) @ form)[None]).Vh[1:])
    return list(torch.eye(primitive.width, dtype=x.dtype))


def product(parts: tuple[Tensor, ...]) -> Tensor:
    row = parts[0]
    for part in parts[1:]:
        row = torch.kron(row, part)
    return row


def matrices(case: Case, views: Views, static: list[bool] | None = None) -> list[Tensor]:
    """The estimation matrix of one problem, for every camera where there are given ones."""
    primitives = case.invariant.primitives
    cameras = next((p.cameras for p in primitives if isinstance(p, Projected)), None)
    found = []
    for camera in [None] if cameras is None else cameras:
        rows = []
        for i in range(views[0].shape[0]):
            match = [x[i] for x in views]
            slots = [vectors(p, x) for p, x in zip(primitives, match, strict=True)]
            every = [free_vectors(p, x) for p, x in zip(primitives, match, strict=True)]
            if camera is not None:
                slots[2] = [camera @ u for u in slots[2]]
            choices = [slots]
            if static is not None and static[i]:
                choices = [[*slots[:v], every[v], *slots[v + 1 :]] for v in range(len(slots))]
            rows += [product(parts) for chosen in choices for parts in _choices(chosen)]
        found.append(torch.stack(rows))
    return found


def _choices(slots: list[list[Tensor]]) -> list[tuple[Tensor, ...]]:
    found: list[tuple[Tensor, ...]] = [()]
    for slot in slots:
        found = [(*parts, u) for parts in found for u in slot]
    return found


def rank(matrix: Tensor) -> int:
    """Rank with a gap of at least a thousand between what counts and what does not."""
    s = torch.linalg.svdvals(matrix)
    s = torch.nn.functional.pad(s, (0, max(0, matrix.shape[-1] - len(s)))) / s[0]
    count = int((s > 1e-11).sum())
    assert count == len(s) or s[count - 1] > 1e3 * s[count], f"no gap: {s[count - 1]:.1e}, {s[count]:.1e}"
    return count


def spans(case: Case, tensor: Tensor) -> Tensor:
    """Tensors as orthonormal rows ``(problems, nullity, D)``."""
    order = len(case.invariant.shape())
    flat = tensor.flatten(-order)
    return flat.reshape(-1, case.nullity, flat.shape[-1])


def apart(case: Case, first: Tensor, second: Tensor) -> float:
    """The largest distance between the spans of two (batches of) tensors."""
    a, b = spans(case, first).double(), spans(case, second).double()
    return float(torch.linalg.matrix_norm(a - (a @ b.mT) @ b).max()) if a.numel() else 0.0


def chart(primitive: Primitive, x: Tensor) -> Tensor:
    """Free coordinates of measurements, in which the noise is the same in all directions: ``(..., coordinates)``."""
    if isinstance(primitive, Hyperplane):
        assert primitive.dim == 2
        return torch.stack([torch.atan2(x[..., 1], x[..., 0]), x[..., 2]], dim=-1)
    return x.flatten(-2) if isinstance(primitive, Line) else x


def measured(primitive: Primitive, z: Tensor) -> Tensor:
    if isinstance(primitive, Hyperplane):
        return torch.stack([z[..., 0].cos(), z[..., 0].sin(), z[..., 1]], dim=-1)
    return z.unflatten(-1, (2, 3)) if isinstance(primitive, Line) else z


def noisy(case: Case, exact: Views, sigma: float, seed: int = 1) -> Views:
    """Independent noise in the free coordinates of every view."""
    g = torch.Generator().manual_seed(seed)
    found = []
    for primitive, x in zip(case.invariant.primitives, exact, strict=True):
        z = chart(primitive, x)
        found.append(measured(primitive, z + sigma * torch.randn(z.shape, generator=g, dtype=z.dtype)))
    return tuple(found)


def _form(case: Case, motion: Motion, views: Views, scales: tuple[float, ...]) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
    """Coordinates of all matches of one problem in standard deviations ``(n, coordinates)``, and their conditions."""
    parts = [chart(p, x) / s for p, x, s in zip(case.invariant.primitives, views, scales, strict=True)]
    sizes = [part.shape[-1] for part in parts]

    def conditions(z: Tensor) -> Tensor:
        split = zip(case.invariant.primitives, z.split(sizes), scales, strict=True)
        return case.conditions(motion, *(measured(p, part * s) for p, part, s in split))

    return torch.cat(parts, dim=-1), conditions


def _solve(jacobian: Tensor, value: Tensor, rank: int) -> Tensor:
    """Least squares solution of smallest norm with the given rank."""
    u, s, vh = torch.linalg.svd(jacobian, full_matrices=False)
    inverse = torch.where(torch.arange(s.shape[-1]) < rank, 1 / s, torch.zeros_like(s))
    return (vh.mT @ (inverse[..., None] * (u.mT @ value[..., None])))[..., 0]


def first_order(case: Case, motion: Motion, views: Views, scales: tuple[float, ...]) -> Tensor:
    r"""Sampson distance by autograd, :math:`\sqrt{e^T (J J^T)^+ e}`, of the matches of one problem."""
    z, conditions = _form(case, motion, views, scales)
    jacobian = torch.func.vmap(torch.func.jacrev(conditions))(z)
    return _solve(jacobian, torch.func.vmap(conditions)(z), case.invariant.codim).norm(dim=-1)


def geometric(case: Case, motion: Motion, views: Views, scales: tuple[float, ...]) -> Tensor:
    """How far the matches of one problem are from the nearest exact ones: projection onto the linearized conditions, iterated."""
    start, conditions = _form(case, motion, views, scales)
    z = start
    for _ in range(15):
        jacobian = torch.func.vmap(torch.func.jacrev(conditions))(z)
        value = torch.func.vmap(conditions)(z) + (jacobian @ (start - z)[..., None])[..., 0]
        z = start - _solve(jacobian, value, case.invariant.codim)
    assert torch.func.vmap(conditions)(z).abs().max() < 1e-9
    return (z - start).norm(dim=-1)


def pulled_back(case: Case, tensor: Tensor, frames: Views) -> Tensor:
    """The tensor of views as they were before a change of coordinates, from that of the views after it."""
    primitives, axes = case.invariant.primitives, case.invariant.axes()
    lead = tensor.ndim - len(axes)
    for axis, v in enumerate(axes):
        frame = frames[v]
        if isinstance(primitives[v], Projected):
            continue  # the cameras followed: what they see has not changed
        if isinstance(primitives[v], Hyperplane | HyperplanesThrough):
            frame = torch.linalg.inv(frame).mT
        if isinstance(primitives[v], HyperplanesThrough):
            frame = subdeterminants(frame, primitives[v].order)
        if isinstance(primitives[v], Monomials):
            frame = lifted_frame(frame)
        if isinstance(primitives[v], Line):
            frame = subdeterminants(frame, 2)
        tensor = torch.tensordot(tensor, frame, dims=([lead + axis], [0])).movedim(-1, lead + axis)
    flat = spans(case, tensor)
    return torch.linalg.qr(flat.mT)[0].mT.reshape(tensor.shape)
