"""Dynamic P^n -> P^n: points that move within flats of any dimension, in any number of views of a space of any dimension."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, reduce
from itertools import combinations, combinations_with_replacement, permutations
from math import comb
from typing import NamedTuple

import torch
from torch import Tensor

from dyntorch.core.invariant import Frame, Invariant
from dyntorch.core.normalize import unit_tensors
from dyntorch.core.primitives import Point, Primitive
from dyntorch.core.residual import whiten
from dyntorch.counting.dimension import dim_v
from dyntorch.geometry.extensors import levi_civita
from dyntorch.geometry.homogeneous import homogeneous, inhomogeneous, unit
from dyntorch.invariants.agreement import skew_partner, static_residual
from dyntorch.numerics.blocks import constant
from dyntorch.numerics.eigenspaces import jacobi, on_host
from dyntorch.numerics.least_squares import follow_minimum, normalized_derivative
from dyntorch.numerics.nullspace import eigh, gram_null_space


@lru_cache
def _nullity(size: int, views: int, step: int) -> int:
    return int(size**views - dim_v(size, views, step))


@dataclass(frozen=True, repr=False)
class DynamicTensor(Invariant):
    r"""Points of :math:`P^n` in m views related by collineations, each moving within a linear subspace of dimension k.

    Every match has vectors :math:`p_1, A_2 p_2, \dots, A_m p_m` in k dimensions: k = 1 is a point that stands still, k = 2 one
    that moves on a line, k = 3 in a plane.  Any k + 1 of its views are then linearly dependent,

    .. math:: p_1 \wedge A_2 p_2 \wedge \dots \wedge A_{k+1} p_{k+1} = 0 ,

    and so for every choice of k + 1 views.  All forms on the m views that vanish are a space of :math:`(n+1)^m - \dim V(n+1, m, k)`
    dimensions, the null space of the rows :math:`p_1 \otimes \dots \otimes p_m`; a fit gives an orthonormal basis of it.

    It determines :math:`A_2, \dots, A_m`, each up to its scale, whenever there is a form at all, that is for k <= n and m > k; a
    point that may be anywhere (k = n + 1), or that k views or fewer show, fulfils nothing.  ``DynamicTensor(2, 3, 2)`` is the
    homography tensor, ``DynamicTensor(3, 3, 2)`` the family of join tensors.  What more than k + 1 views have in common follows
    from k + 1 of them; they lower the noise, but the linear fit takes more matches: :func:`dyntorch.align_planar` and
    :func:`dyntorch.align_points` start from three views each and refine all of them together.

    Matches may be of different kinds.  Those known to stay within fewer dimensions say more; the argument ``dimensions`` of
    ``fit`` and ``refine``, ``(*batch, n)`` integers from 1 to k, says how many (``static`` means 1).

    Args:
        n: dimension of the space.
        views: m, their number.
        k: dimension of the subspace of a match, as in the thesis's V(n, m, k): 2 for a line.

    Raises:
        ValueError: numbers for which nothing can be told.

    Source: thesis sections 9.3 and 9.4.

    Example:
        >>> import torch
        >>> DynamicTensor(2, 3, 2).minimal(), DynamicTensor(3, 3, 2).minimal(), DynamicTensor(3, 4, 3).minimal()
        (26, 60, 255)
        >>> draw = torch.Generator().manual_seed(0)
        >>> A = torch.rand(2, 4, 4, generator=draw, dtype=torch.float64)
        >>> in_three_views = DynamicTensor(3, 3, 2)
        >>> found = in_three_views.decompose(in_three_views.compose(*A))
        >>> [bool(torch.allclose(a / a.norm(), b)) for a, b in zip(A, found)]
        [True, True]
    """

    n: int
    views: int
    k: int

    def __post_init__(self) -> None:
        for name in ("n", "views", "k"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ValueError(f"{name} must be an integer of at least 1, got {value!r}")
        if self.k > self.n:
            raise ValueError(
                f"k must be at most n = {self.n}, got {self.k}: points that may be anywhere in P^{self.n} fulfil no equation"
            )
        if self.views <= self.k:
            raise ValueError(
                f"views must be more than k = {self.k}, got {self.views}: so many points always lie in {self.k} dimensions; "
                f"give {self.k + 1} views or more"
            )

    @property
    def size(self) -> int:
        """Homogeneous coordinates of a point."""
        return self.n + 1

    @property
    def primitives(self) -> tuple[Primitive, ...]:  # type: ignore[override]
        return (Point(self.n),) * self.views

    @property
    def motion(self) -> tuple[Frame, ...]:  # type: ignore[override]
        return tuple(Frame(0, view) for view in range(1, self.views))

    @property
    def nullity(self) -> int:  # type: ignore[override]
        """Independent forms that all matches fulfil."""
        return _nullity(self.size, self.views, self.k)

    @property
    def dof(self) -> int:  # type: ignore[override]
        """Entries of the collineations, each up to scale."""
        return (self.views - 1) * (self.size**2 - 1)

    @property
    def codim(self) -> int:  # type: ignore[override]
        """Coordinates of all views, less those of a flat and of a point on it in every view."""
        return (self.views - self.k) * (self.size - self.k)

    @property
    def within(self) -> int:  # type: ignore[override]
        return self.k

    @property
    def labels_static(self) -> bool:  # type: ignore[override]
        return self.k > 1

    def compose(self, *maps: Tensor) -> Tensor:
        r"""An orthonormal basis of the forms that vanish on points moved by :math:`A_2, \dots, A_m`.

        Args:
            *maps: ``(*batch, n + 1, n + 1)``, view 2, 3, ... to view 1, of any scale.

        Returns:
            ``(*batch, nullity, n + 1, ..., n + 1)``, one axis per view, without that of the nullity where it is 1; zero where a
            map is.

        Raises:
            ValueError: another number of maps, or of another size.

        Example:
            >>> import torch
            >>> still = DynamicTensor(1, 2, 1).compose(torch.eye(2))  # p x p' = 0
            >>> still.mul(2**0.5).round().tolist()
            [[0.0, 1.0], [-1.0, 0.0]]
        """
        self._check(maps)
        forms = self._carry_forms(maps)
        return unit_tensors(forms.squeeze(-self.views - 1) if self.nullity == 1 else forms, self.views, self.nullity)

    def compose_derivative(self, motion: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
        if self.nullity > 1:
            return super().compose_derivative(motion)
        size, views = self.size, self.views
        eye = torch.eye(size, dtype=motion[0].dtype, device=motion[0].device)
        slopes = []
        for v in range(1, views):
            # linear in each map: its axis i is left as it is, and entry (i, j) of the map takes it to j
            rest = self._carry_forms(motion, but=v).squeeze(-views - 1).movedim(v - views, -views).flatten(-views + 1)
            put = rest[..., :, None, None, :] * eye[:, :, None]  # i, j, where it is taken, the other axes
            put = put.unflatten(-1, (size,) * (views - 1)).movedim(-views, v - views)
            slopes.append(put.flatten(-views).flatten(-3, -2))
        return normalized_derivative(self._carry_forms(motion).flatten(-views)[..., 0, :], torch.cat(slopes, dim=-2))

    def decompose(self, tensor: Tensor) -> tuple[Tensor, ...]:
        r"""The collineations behind a basis of vanishing forms, linearly.

        The forms on k + 1 views alone are those that stay forms whatever stands in the other slots; a slice S of them between
        view 1 and view v is a skew matrix times :math:`A_v`, so that :math:`A_v^T S + S^T A_v = 0`, whose only solution is
        :math:`A_v` up to scale.

        Args:
            tensor: ``(*batch, nullity, n + 1, ..., n + 1)`` any basis, without the first axis where the nullity is 1.

        Returns:
            :math:`A_2, \dots, A_m`, ``(*batch, n + 1, n + 1)`` each, norm 1, canonical sign; zero for a zero tensor (a failed fit).

        Raises:
            ValueError: another shape.

        Source: thesis sections 8.1 (i) and 9.3; the forms on k + 1 views: derived here.

        Example:
            >>> import torch
            >>> in_planes = DynamicTensor(3, 4, 3)
            >>> A = torch.rand(3, 4, 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
            >>> bool(torch.allclose(in_planes.decompose(in_planes.compose(*A))[2], A[2] / A[2].norm()))
            True
        """
        shape = (self.nullity,) * (self.nullity > 1) + self.shape()
        if tuple(tensor.shape[-len(shape) :]) != shape:
            raise ValueError(f"tensor of {self!r} must be (*batch, {', '.join(map(str, shape))}), got {tuple(tensor.shape)}")
        flat = self.basis_of(tensor.double())
        none = (flat == 0).all(-1).all(-1)[..., None, None]
        stand_in = vanishing_forms(self.size, self.views, self.k, flat.device).flatten(1)
        rows = torch.where(none, stand_in, flat)
        basis = torch.linalg.qr(rows.mT)[0].mT if self.nullity > 1 else torch.nn.functional.normalize(rows, dim=-1)
        maps = collineations(basis.unflatten(-1, (self.size,) * self.views), self.views, self.k)
        return tuple(torch.where(none, 0.0, part).to(tensor.dtype) for part in maps)

    def transfer(self, tensor: Tensor, x: Tensor, source: int = 2, target: int = 1) -> Tensor:
        r"""Where static points of one view are in another: :math:`A_t^{-1} A_s p`.

        Args:
            tensor: as :func:`dyntorch.fit` gives it.
            x: ``(*batch, n, d)`` points of view ``source``.
            source: 1 to m.
            target: another view.

        Returns:
            ``(*batch, n, d)``.

        Raises:
            ValueError: views that are not two different ones.

        Example:
            >>> import torch
            >>> shift = torch.tensor([[1.0, 5.0], [0.0, 1.0]])
            >>> line = DynamicTensor(1, 2, 1)
            >>> line.transfer(line.compose(shift), torch.tensor([[2.0]])).round(decimals=4).tolist()
            [[7.0]]
        """
        if source == target or not {source, target} <= set(range(1, self.views + 1)):
            raise ValueError(f"source and target must be two different views of 1 to {self.views}, got {source} and {target}")
        maps = self._stack_maps(self.decompose(tensor.double()))
        both = torch.linalg.solve_ex(maps[..., target - 1, :, :], maps[..., source - 1, :, :])[0]
        return inhomogeneous(homogeneous(x.double()) @ both.mT).to(x.dtype)

    def flats(self, tensor: Tensor, *views: Tensor, view: int = 1) -> Tensor:
        r"""The subspace in which each match moves, by hyperplanes that contain it: for k = 2 in the plane its trajectory line.

        Args:
            tensor: as :func:`dyntorch.fit` gives it.
            *views: the matches, ``(*batch, n, d)`` each.
            view: 1 to m, in whose coordinates the hyperplanes are.

        Returns:
            ``(*batch, n, d + 1 - k, d + 1)`` orthonormal hyperplanes; those of least distance from all views.

        Raises:
            ValueError: another number of views, or no such view.

        Source: thesis section 8.1 (iii), for any dimension.

        Example:
            >>> import torch
            >>> eye, x = torch.eye(3), torch.tensor([[0.0, 1.0]])
            >>> on_lines = DynamicTensor(2, 3, 2)
            >>> on_lines.flats(on_lines.compose(eye, eye), x, x + x, x * 4).abs().round(decimals=4).tolist()
            [[[1.0, 0.0, 0.0]]]
        """
        if len(views) != self.views or view not in range(1, self.views + 1):
            raise ValueError(f"expected {self.views} views and one of their numbers, got {len(views)} views and view={view}")
        batch, count = views[0].shape[:-2], views[0].shape[-2]
        points = torch.stack([x.double() for x in views], dim=-2).reshape(-1, count, self.views, self.n)
        maps = self._stack_maps(self.decompose(tensor.double()))
        maps = maps.expand(*batch, -1, -1, -1).reshape(-1, self.views, self.size, self.size)
        nearest = nearest_flats(maps, points, torch.ones(len(maps), self.views, dtype=torch.float64, device=maps.device), self.k)
        planes = torch.linalg.qr((nearest.hyperplanes @ maps[:, None, view - 1]).mT)[0].mT
        return planes.reshape(*batch, *planes.shape[1:]).to(views[0].dtype)

    def whitened_residual(self, motion: tuple[Tensor, ...], views: tuple[Tensor, ...], scales: tuple[Tensor, ...]) -> Tensor | None:
        """Distances of all views from the nearest flat, ``(*batch, n, m (n + 1 - k))``; None where one equation says it all."""
        if self.single():
            return None
        batch = torch.broadcast_shapes(*(part.shape[:-2] for part in motion), *(x.shape[:-2] for x in views))
        maps = self._stack_maps(motion).expand(*batch, -1, -1, -1).reshape(-1, self.views, self.size, self.size)
        flat = [x.expand(*batch, -1, -1).reshape(-1, *x.shape[-2:]).double() for x in views]
        residual = flat_residual(maps.double(), flat, [s.double().expand(batch).reshape(-1) for s in scales], self.k)
        return residual.reshape(*batch, *residual.shape[1:]).to(views[0].dtype)

    def linearize(
        self, motion: tuple[Tensor, ...], views: tuple[Tensor, ...], scales: tuple[Tensor, ...]
    ) -> tuple[Tensor, Tensor] | None:
        return None if self.single() else flat_residual_derivative(self._stack_maps(motion), views, scales, self.k)

    def whitened_static_residual(self, motion: tuple[Tensor, ...], views: tuple[Tensor, ...], scales: tuple[Tensor, ...]) -> Tensor:
        """Disagreement of the views of a static point, ``(*batch, n, n (m - 1))``."""
        return static_residual(motion, views, scales)

    def confine(self, free: int) -> Invariant | None:
        return None if self.k - free <= 1 else DynamicTensor(self.n, self.views, self.k - free)

    def _carry_forms(self, maps: tuple[Tensor, ...], but: int = -1) -> Tensor:
        """The forms ``(*batch, nullity, N, ..., N)`` of the maps, of any length; axis ``but`` is left as it is."""
        forms = vanishing_forms(self.size, self.views, self.k, maps[0].device).to(maps[0].dtype)
        batch = torch.broadcast_shapes(*(part.shape[:-2] for part in maps))
        return reduce(
            lambda total, v: total if v == but else self._carry_axis(total, maps[v - 1], v),
            range(1, self.views),
            forms.expand(*batch, *forms.shape),
        )

    def _carry_axis(self, forms: Tensor, matrix: Tensor, view: int) -> Tensor:
        """One axis of the forms contracted with a map ``(*batch, N, N)``."""
        axis = view - self.views
        moved = forms.movedim(axis, -1)
        return (moved @ matrix.reshape(*matrix.shape[:-2], *[1] * (self.views - 1), self.size, self.size)).movedim(-1, axis)

    def _stack_maps(self, maps: tuple[Tensor, ...]) -> Tensor:
        """``(*batch, m, N, N)`` with the identity for view 1."""
        return torch.stack([torch.eye(self.size, dtype=maps[0].dtype, device=maps[0].device).expand_as(maps[0]), *maps], dim=-3)

    def _check(self, maps: tuple[Tensor, ...]) -> None:
        if len(maps) != self.views - 1 or any(part.shape[-2:] != (self.size, self.size) for part in maps):
            raise ValueError(
                f"{self!r} has {self.views - 1} maps (*batch, {self.size}, {self.size}), got {[tuple(part.shape) for part in maps]}"
            )

    def __repr__(self) -> str:
        return f"DynamicTensor({self.n}, {self.views}, {self.k})"


@dataclass(frozen=True, repr=False)
class DynamicMotion(DynamicTensor):
    r"""The motion of a :class:`DynamicTensor` by itself, for any number of views: no form is composed, so nothing grows with
    them."""

    nullity = 1
    motion_alone = True

    def shape(self) -> tuple[int, ...]:
        return (self.views - 1, self.size, self.size)

    def width(self) -> int:
        return (self.views - 1) * self.size**2

    def single(self) -> bool:
        return False

    def minimal(self) -> int:
        raise ValueError(f"{self!r} holds no forms to fit; use DynamicTensor{self.n, self.views, self.k}")

    def compose(self, *maps: Tensor) -> Tensor:
        self._check(maps)
        return torch.stack([unit(part) for part in maps], dim=-3)

    def decompose(self, tensor: Tensor) -> tuple[Tensor, ...]:
        return tensor.unbind(-3)

    def confine(self, free: int) -> Invariant | None:
        return DynamicMotion(self.n, self.views, self.k - free)

    def whitened_static_residual(self, motion: tuple[Tensor, ...], views: tuple[Tensor, ...], scales: tuple[Tensor, ...]) -> Tensor:
        """Distances of all views from the nearest static point, ``(*batch, n, m n)``, of n (m - 1) degrees of freedom."""
        residual = DynamicMotion(self.n, self.views, 1).whitened_residual(motion, views, scales)
        assert residual is not None
        return residual

    def __repr__(self) -> str:
        return f"DynamicMotion({self.n}, {self.views}, {self.k})"


# ----------------------------------------------------------------------------------------------------------------------
# The forms on m vectors that vanish wherever the vectors span no more than k dimensions.


SMALL = 1e-9
"""Singular value of integer generators (the others are above .1) that is zero."""


@constant
def vanishing_forms(size: int, views: int, step: int, device: torch.device) -> Tensor:
    r"""Orthonormal basis of all forms on ``views`` vectors that vanish where these span no more than ``step`` dimensions."""
    if size == views == step + 1:
        epsilon = levi_civita(size, device=device)
        return (epsilon / epsilon.norm())[None]
    blocks: dict[tuple[int, ...], tuple[list[tuple[int, ...]], Tensor]] = {}
    rows: list[Tensor] = []
    place = torch.tensor([size ** (views - 1 - v) for v in range(views)])
    for indices in combinations_with_replacement(range(size), views):
        names = sorted(set(indices), key=lambda i: (-indices.count(i), i))
        pattern = tuple(indices.count(i) for i in names)
        if pattern not in blocks:
            blocks[pattern] = _block(pattern, step)
        words, basis = blocks[pattern]
        where = torch.tensor([[names[letter] for letter in word] for word in words]) @ place
        block = torch.zeros(len(basis), size**views, dtype=torch.float64)
        block[:, where] = basis
        rows.append(block)
    return torch.cat(rows).unflatten(-1, (size,) * views).to(device)


def _block(pattern: tuple[int, ...], step: int) -> tuple[list[tuple[int, ...]], Tensor]:
    """All words with so many of each letter, and an orthonormal basis of the vanishing forms on them."""
    letters = [letter for letter, count in enumerate(pattern) for _ in range(count)]
    words = sorted(set(permutations(letters)))
    number = {word: i for i, word in enumerate(words)}
    generated = set()
    for word in words:
        for slots in combinations(range(len(letters)), step + 1):
            # one generator for each set of words that differ by the order of these letters
            chosen = [word[s] for s in slots]
            if len(set(chosen)) == len(chosen) and chosen == sorted(chosen):
                generated.add((word, slots))
    generators = torch.zeros(len(generated), len(words), dtype=torch.float64)
    for row, (word, slots) in enumerate(sorted(generated)):
        for order in permutations(range(len(slots))):
            other = list(word)
            for s, i in zip(slots, order, strict=True):
                other[s] = word[slots[i]]
            generators[row, number[tuple(other)]] = _sign(order)
    if not generated:
        return words, generators
    _, values, basis = torch.linalg.svd(generators, full_matrices=False)
    return words, basis[: int((values > SMALL * values[0]).sum())]


def _sign(order: Sequence[int]) -> int:
    return (-1) ** sum(a > b for a, b in combinations(order, 2))


# ----------------------------------------------------------------------------------------------------------------------
# The distance of the views of a moving point from a flat that contains all of its positions.


STEPS = 6
"""Gauss-Newton steps to the nearest flat at most: from one through the carried points, exact to rounding after 2 or 3, more where
the points hardly move."""
SPREAD = 1e-12
"""Of the trace: what keeps the inverse of a flat's information finite where the points do not determine it."""
TINY = 1e-150


class Flats(NamedTuple):
    """The nearest flat of each match, and how far its views are from it."""

    residual: Tensor
    """``(b, n, m, c)`` whitened distance of every view from the flat, along c normals."""
    hyperplanes: Tensor
    """``(b, n, c, N)`` that contain the flat, in the coordinates of view 1."""
    root: Tensor
    """``(b, n, m, c, c)`` what whitens the incidences with these hyperplanes."""
    feet: Tensor
    """``(b, n, m, N)`` nearest points of the flat, in the coordinates of each view."""
    slope: Tensor
    """``(b, n, m c, c k)`` of the residual, by the displacements of the flat."""
    inverse: Tensor
    """``(b, n, c k, c k)`` inverse of the information on these."""


def nearest_flats(maps: Tensor, points: Tensor, scales: Tensor, step: int) -> Flats:
    r"""The flats of ``step`` - 1 dimensions of least distance from all views of a match. maps ``(b, m, N, N)``, points
    ``(b, n, m, N - 1)``, scales ``(b, m)``."""
    p, s = homogeneous(points), scales[:, None, :, None, None]
    carried = torch.nn.functional.normalize((maps[:, None] @ p[..., None])[..., 0], dim=-1)
    carried = torch.nan_to_num(carried)
    square = carried.mT @ carried
    # an accelerator waits for eigh, and these are tiny
    vectors = eigh(square)[1] if on_host(square) else jacobi(square.flatten(0, 1))[1].unflatten(0, square.shape[:2])
    size = vectors.shape[-1]
    count = size - step
    base, across = vectors[..., :count].mT, vectors[..., count:].mT
    at, cost = _linearize_at(base, across, maps, p, s), torch.full(p.shape[:2], torch.inf, dtype=p.dtype, device=p.device)
    for _ in range(STEPS):
        cost = at.residual.square().sum((-2, -1))
        pulled = at.slope.mT @ at.residual.flatten(-2)[..., None]
        move = -(at.inverse @ pulled)[..., 0].unflatten(-1, (count, step)) @ across
        tried = _linearize_at(at.hyperplanes + move, across, maps, p, s)
        new = tried.residual.square().sum((-2, -1))
        # where the points hardly move the flat may turn far: only what helps counts
        better = new < cost
        at = Flats(*(torch.where(better[(..., *[None] * (a.ndim - 2))], a, b) for a, b in zip(tried, at, strict=True)))
        # an accelerator would wait for the answer longer than for the steps
        if on_host(cost) and not bool((better & (cost - new > 1e-12 * cost)).any()):
            break
    return at


def _linearize_at(hyperplanes: Tensor, across: Tensor, maps: Tensor, p: Tensor, s: Tensor) -> Flats:
    """What belongs to given flats; ``across (b, n, k, N)`` is what displacements of the hyperplanes are made of."""
    residual, root, h = whitened_incidence(hyperplanes, maps, p, s)
    force = (root.mT @ residual[..., None])[..., 0]
    foot = torch.nn.functional.pad(((h * s).mT @ force[..., None])[..., 0][..., :-1] * s[..., 0], (0, 1))
    feet = p - foot
    along = (across[:, :, None] @ (maps[:, None] @ feet[..., None]))[..., 0]  # (b, n, m, k)
    slope = (root[..., :, :, None] * along[..., None, None, :]).flatten(-2).flatten(-3, -2)
    information = slope.mT @ slope
    trace = information.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None].clamp(min=TINY)
    eye = torch.eye(information.shape[-1], dtype=p.dtype, device=p.device)
    inverse = torch.linalg.inv_ex(information + SPREAD * trace * eye)[0]
    return Flats(residual, hyperplanes, root, feet, slope, torch.nan_to_num(inverse, posinf=0.0, neginf=0.0))


def whitened_incidence(hyperplanes: Tensor, maps: Tensor, p: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Whitened incidences ``(b, n, m, c)``, what whitened them ``(.., c, c)``, and the hyperplanes ``(.., c, N)`` of each view."""
    h = hyperplanes[:, :, None] @ maps[:, None]
    normals = h[..., :-1] * s
    spread = normals @ normals.mT
    eye = torch.eye(spread.shape[-1], dtype=p.dtype, device=p.device)
    size = spread.diagonal(dim1=-2, dim2=-1).amax(-1)[..., None, None].detach().clamp(min=TINY)
    # the columns of the inverse root; a flat at infinity has no normals: the floor of whiten() keeps it finite
    root = whiten(eye, (spread / size)[..., None, :, :]).mT / size.sqrt()
    return (root @ (h @ p[..., None]))[..., 0], root, h


def flat_residual(maps: Tensor, views: Sequence[Tensor], scales: Sequence[Tensor], step: int) -> Tensor:
    r"""Whitened distances of matches from the flats they stay in, ``(b, n, m c)``, whose square sum is the least possible."""
    points, noise = torch.stack(list(views), dim=-2), torch.stack(list(scales), dim=-1)
    with torch.no_grad():
        hyperplanes = nearest_flats(maps, points, noise, step).hyperplanes
    if torch.is_grad_enabled() and any(x.requires_grad for x in (maps, points, noise)):
        hyperplanes = _differentiable_flats(hyperplanes, maps, points, noise, step)
    s = noise[:, None, :, None, None]
    return whitened_incidence(hyperplanes, maps, homogeneous(points), s)[0].flatten(-2)


def _differentiable_flats(hyperplanes: Tensor, maps: Tensor, points: Tensor, noise: Tensor, step: int) -> Tensor:
    """The nearest flats ``(b, n, c, N)`` as functions of what they are nearest to, every match by itself."""
    problems, count, c, size = hyperplanes.shape
    across = eigh(hyperplanes.mT @ hyperplanes)[1][..., : size - c].mT[..., :step, :]

    def displace(by: Tensor, hyperplanes: Tensor, across: Tensor) -> Tensor:
        return hyperplanes + by.unflatten(-1, (c, across.shape[-2])) @ across

    def cost(by: Tensor, hyperplanes: Tensor, across: Tensor, points: Tensor, maps: Tensor, noise: Tensor) -> Tensor:
        at = displace(by, hyperplanes, across)[:, None]
        incidence = whitened_incidence(at, maps, homogeneous(points)[:, None], noise[:, None, :, None, None])
        return incidence[0].square().sum((-3, -2, -1))

    flat = hyperplanes.flatten(0, 1), across.flatten(0, 1)
    zero = flat[0].new_zeros(problems * count, c * across.shape[-2])
    several = [x[:, None].expand(-1, count, *x.shape[1:]).flatten(0, 1) for x in (maps, noise)]
    by = follow_minimum(cost, zero, zero.new_zeros(*zero.shape, 0), *flat, points.flatten(0, 1), *several)
    return displace(by, *flat).unflatten(0, (problems, count))


def flat_residual_derivative(maps: Tensor, views: Sequence[Tensor], scales: Sequence[Tensor], step: int) -> tuple[Tensor, Tensor]:
    r""":func:`flat_residual`, flat ``(b, n m c)``, and its derivative ``(b, p, n m c)`` by the entries of all maps but the
    first."""
    at = nearest_flats(maps, torch.stack(list(views), dim=-2), torch.stack(list(scales), dim=-1), step)
    b, n, m, c = at.residual.shape
    size = maps.shape[-1]
    rows = at.root @ at.hyperplanes[:, :, None]  # (b, n, m, c, N)
    own = (rows[..., :, None] * at.feet[..., None, None, :]).flatten(-2)  # (b, n, m, c, N N)
    moved = own.new_zeros(b, n, m, c, m - 1, size * size)
    for v in range(1, m):
        moved[:, :, v, :, v - 1] = own[:, :, v]
    moved = moved.flatten(4).flatten(2, 3)  # (b, n, m c, p)
    derivative = moved - at.slope @ (at.inverse @ (at.slope.mT @ moved))
    return at.residual.flatten(1), derivative.movedim(-1, 1).flatten(2)


# ----------------------------------------------------------------------------------------------------------------------
# The collineations behind the vanishing forms of moved points.


def forms_of_views(basis: Tensor, views: int, slots: Sequence[int], step: int) -> Tensor:
    r"""The forms on ``step`` + 1 of the views alone, from an orthonormal basis of those on all views. basis
    ``(*batch, nullity, N, ..., N)`` -> ``(*batch, forms, N, ..., N)``."""
    if views == len(slots):
        return basis
    size, lead = basis.shape[-1], basis.ndim - views
    others = [v for v in range(views) if v not in slots]
    parted = basis.permute(*range(lead), *(lead + v for v in (*slots, *others))).flatten(lead + len(slots))
    parted = parted.flatten(lead, lead + len(slots) - 1)  # (*batch, nullity, N^(k+1), N^(m-k-1))
    trace = (parted @ parted.mT).sum(-3)
    eye = torch.eye(trace.shape[-1], dtype=basis.dtype, device=basis.device)
    basis_of_slots = gram_null_space(parted.shape[-1] * eye - trace, comb(size, step + 1)).basis
    return basis_of_slots.unflatten(-1, (size,) * len(slots))


def collineations(basis: Tensor, views: int, step: int) -> tuple[Tensor, ...]:
    r"""The collineations from every view but the first to the first, linearly and uniquely, from the vanishing forms. basis
    ``(*batch, nullity, N, ..., N)`` -> ``(*batch, N, N)``."""
    lead = basis.ndim - views
    slices: list[list[Tensor]] = [[] for _ in range(views)]
    for slots in combinations(range(1, views), step):
        forms = forms_of_views(basis, views, (0, *slots), step)
        for i, v in enumerate(slots, start=1):
            pair = forms.permute(*range(lead), *(lead + s for s in range(step + 1) if s not in (0, i)), lead, lead + i)
            slices[v].append(pair.flatten(lead - 1, -3))
    return tuple(skew_partner(torch.cat(found, dim=-3)) for found in slices[1:])
