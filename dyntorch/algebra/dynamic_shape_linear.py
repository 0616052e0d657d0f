r"""Linear forms of a moving shape seen by affine cameras: the graph over a basis, and the span of all its positions."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.algebra.dynamic_shape_descent import Views, canonical
from dyntorch.algebra.shape_rows import centred
from dyntorch.eigenspace import spectrum
from dyntorch.nullspace import gram_null_space, null_space

RANK = 1e-9
"""Singular value, of the largest, below which products of basis functions are the same function at these times."""
NEAREST = 6
"""Least number of views in a window in which the shape is taken to stand still."""
ANCHORS = 200
"""Windows at most."""
ROUNDS = 3
"""Rounds in which missing points are filled in from the mean shape."""


@dataclass(frozen=True)
class Graph:
    r"""The subspace as a graph over three coordinates: :math:`D(t)\, z_j = \sum_i N_{ij}(t)\, y_i`.

    Attributes:
        scale: ``(b, K)`` coefficients of D, norm 1.
        slopes: ``(b, K, 3, m)`` coefficients of N.
        degenerate: ``(b,)`` bool: more than one such graph fulfils the equations.
    """

    scale: Tensor
    slopes: Tensor
    degenerate: Tensor

    def bases(self, powers: Tensor) -> Tensor:
        """Columns that span the subspace ``(b, views, 3 + m, 3)`` at ``powers (b, views, K)``: y above, z below."""
        eye = torch.eye(3, dtype=powers.dtype, device=powers.device)
        above = (powers @ self.scale[..., None])[..., None] * eye
        below = torch.einsum("bvk,bkim->bvmi", powers, self.slopes)
        return torch.cat([above, below], dim=-2)


def graph(y: Tensor, z: Tensor, powers: Tensor, share: Tensor) -> Graph:
    r"""Solve :math:`D(t_v)\, z_j = \sum_i N_{ij}(t_v)\, y_i` for the coefficients of D and N, linear for known times.

    All points share D, each has its own N: what the columns of y explain is projected out of the columns of every z, and D is
    the null vector of what remains, K numbers instead of :math:`K (1 + 3 m)`.

    Args:
        y: ``(b, views, 3, 2)`` differences of four basis points, or other three coordinates of the subspace.
        z: ``(b, views, m, 2)`` the same of the other points.
        powers: ``(b, views, K)`` basis of the products of three of the functions of the trajectories.
        share: ``(b, views)`` weights of the views.

    Returns:
        A :class:`Graph`.

    Source: theory of brackets: D and N are 4 x 4 determinants of the moving basis points.
    """
    root = share.sqrt()[..., None, None, None]
    known = (powers[..., :, None, None] * y[..., None, :, :] * root).flatten(-3, -2)  # (b, v, 3 K, 2)
    known = known.mT.flatten(1, 2)
    q, r = torch.linalg.qr(known)
    pivots = r.diagonal(dim1=-2, dim2=-1).abs()
    flat = pivots.amin(-1) <= 1e-12 * pivots.amax(-1)
    columns = (powers[..., :, None, None] * z[..., None, :, :] * root).permute(0, 3, 1, 4, 2).flatten(2, 3)  # (b, m, 2 v, K)
    inner = q.mT[:, None] @ columns
    left = columns - q[:, None] @ inner
    found = gram_null_space((left.mT @ left).sum(1))
    scale = null_space(left.flatten(1, 2))[..., 0, :]
    slopes = torch.linalg.solve_triangular(r, (inner @ scale[:, None, :, None])[..., 0].mT, upper=True)
    slopes = slopes.unflatten(1, (powers.shape[-1], 3))
    slopes = torch.where(slopes.isfinite(), slopes, 0.0)
    return Graph(scale, slopes, flat | found.degenerate)


def complete(views: Views) -> Tensor:
    """The centred views ``(b, views, n, 2)`` with missing points filled in from the mean shape of all views."""
    x, seen = views.x, (views.weights > 0)[..., None]
    if bool(seen.all()):
        return x
    for _ in range(ROUNDS):
        mean = leading(x, views.share)[:, None]
        part = torch.where(seen, mean, 0.0)
        filled = mean @ _regressed(part, torch.where(seen, x, 0.0))
        x = torch.where(seen, x, filled)
        x = x - x.mean(-2, keepdim=True)
    return x


def _regressed(basis: Tensor, x: Tensor) -> Tensor:
    gram = basis.mT @ basis
    ridge = 1e-3 * torch.eye(basis.shape[-1], dtype=x.dtype, device=x.device)
    return torch.linalg.solve_ex(gram + ridge, basis.mT @ x)[0]


def leading(x: Tensor, share: Tensor, count: int = 3) -> Tensor:
    """The directions ``(..., n, count)`` with the most energy in views ``(..., views, n, 2)``."""
    scatter = (x * share[..., None, None]).movedim(-3, -2).flatten(-2) @ x.movedim(-3, -2).flatten(-2).mT
    return spectrum(scatter)[1][..., -count:].flip(-1)


def products(rows: Tensor) -> Tensor:
    """Orthonormal basis ``(b, views, K)`` of all products of three of the functions ``(b, views, B)``, as seen at the views."""
    size = rows.shape[-1]
    places = torch.combinations(torch.arange(size), 3, with_replacement=True).to(rows.device)
    cubes = rows[..., places].prod(-1)
    u, s, _ = torch.linalg.svd(cubes, full_matrices=False)
    # one width for the whole batch: a function more than a problem can tell is one it cannot tell either
    return u[..., : max((s > RANK * s[..., :1]).sum(-1).clamp(min=1).tolist(), default=size)]


def shapes_through(bases: Tensor, rows: Tensor, share: Tensor) -> Tensor:
    r"""The shapes whose span is nearest to given subspaces: :math:`(I - \Pi_v) \sum_b c_{vb} X_b = 0`, a null space of dimension 3.

    Args:
        bases: ``(b, views, k, 3)`` columns that span the subspace at each view.
        rows: ``(b, views, B)``.
        share: ``(b, views)``.

    Returns:
        ``(b, B, k, 3)``.
    """
    q = torch.linalg.qr(torch.where(bases.isfinite(), bases, 0.0))[0]
    eye = torch.eye(q.shape[-2], dtype=q.dtype, device=q.device)
    away = (eye - q @ q.mT).flatten(2)
    lifted = (rows[..., None] * rows[..., None, :]).flatten(2) * share[..., None]
    size, k = rows.shape[-1], q.shape[-2]
    gram = (lifted.mT @ away).reshape(-1, size, size, k, k).transpose(2, 3).reshape(-1, size * k, size * k)
    return gram_null_space(gram, 3).basis.mT.unflatten(1, (size, k))


def graph_start(x: Tensor, rows: Tensor, share: Tensor) -> Tensor | None:
    """Shapes ``(b, B, n, 3)`` by the graph over the mean shape of centred views ``(b, views, n, 2)``; None with too few views."""
    powers = products(rows)
    helmert = centred(x.shape[-2], x.device)
    flat = helmert @ x
    if 2 * x.shape[1] < 3 * powers.shape[-1] + 1:
        return None
    scatter = leading(flat, share, flat.shape[-2])
    turned = scatter.mT[:, None] @ flat
    found = graph(turned[..., :3, :], turned[..., 3:, :], powers, share)
    return helmert.mT @ scatter[:, None] @ shapes_through(found.bases(powers), rows, share)


def window_start(x: Tensor, rows: Tensor, share: Tensor) -> Tensor:
    """Shapes ``(b, B, n, 3)`` by the static shapes of windows of views at about one time."""
    helmert = centred(x.shape[-2], x.device)
    flat = helmert @ x
    count = x.shape[1]
    anchors = torch.linspace(0, count - 1, min(count, ANCHORS), device=x.device).round().long()
    nearest = min(count, max(NEAREST, count // (4 * rows.shape[-1])))
    apart = torch.cdist(rows[:, anchors], rows) + torch.where(share > 0, 0.0, torch.inf)[:, None]
    window = apart.topk(nearest, largest=False).indices  # (b, anchors, nearest)
    problem = torch.arange(len(x), device=x.device)[:, None, None]
    bases = leading(flat[problem, window], share[problem, window])
    return helmert.mT @ shapes_through(bases, rows[:, anchors], torch.ones_like(share[:, anchors]))


def pooled_start(x: Tensor, rows: Tensor, share: Tensor) -> Tensor | None:
    r"""Shapes ``(b, B, n, 3)`` by the span of all positions, of dimension 3 B; None where that is the whole space.

    With coordinates :math:`x_v = U y_v` in the span, :math:`c_a(t) W_b y_v = c_b(t) W_a y_v` is linear in the inverse W of the
    shapes: three null vectors.
    """
    size, n = rows.shape[-1], x.shape[-2]
    if n - 1 < 3 * size or 2 * x.shape[1] * (size - 1) < 3 * size * size - 3:
        return None
    u = leading(x, share, 3 * size)
    y = u.mT[:, None] @ x  # (b, v, 3 B, 2)
    q = torch.linalg.qr(rows[..., None], mode="complete")[0][..., 1:]  # (b, v, B, B - 1)
    equations = torch.einsum("bvcq,bvku,bv->bvquck", q, y, share.sqrt()).flatten(4).flatten(1, 3)
    inverse = null_space(equations, 3).unflatten(-1, (size, 3 * size)).transpose(1, 2).flatten(1, 2)  # (b, 3 B, 3 B): rows (b, k)
    shapes = torch.linalg.solve_ex(inverse.mT, u.mT)[0].mT  # (b, n, 3 B)
    return canonical(shapes.unflatten(-1, (size, 3)).transpose(1, 2))
