r"""Shapes of :math:`P^k` behind views :math:`P^k \to P^l`: the rows of their tensors, and how these give the points back.

The first k + 1 points are the basis of :math:`P^k`, so a camera is known by their images up to k + 1 scales,
:math:`M = (p_1, \dots, p_{k+1})\,\mathrm{diag}(m)`, and a further point X is seen at

.. math:: x \sim B\,\mathrm{diag}(X)\, m, \qquad B = (p_1, \dots, p_{k+1}):

camera and point have changed places, as in :math:`P^3 \to P^2` (Carlsson and Weinshall), but for k > l + 1 the dual projections
:math:`B\,\mathrm{diag}(X)` are other ones in every view.  With :math:`\alpha_j` hyperplanes :math:`S_j` through further point j,
:math:`\sum_j \alpha_j = k + 1`, the determinant of all :math:`S_j B\,\mathrm{diag}(X_j)` vanishes; by the columns that each point
takes it is a sum over the ordered partitions of the basis,

.. math:: \sum_{(I_1, \dots, I_m)} \pm \Big(\prod_j \det (S_j B)_{I_j}\Big)\, T_{I_1 \dots I_m} = 0,
          \qquad T_{I_1 \dots I_m} = \prod_j \prod_{i \in I_j} X_{ji} .

The factors before T follow from the view, whatever its coordinates: a collineation of the view multiplies all of them alike.
"""

from __future__ import annotations

from itertools import combinations
from math import comb

import torch
from torch import Tensor

from dyntorch.core.primitives import inverse
from dyntorch.geometry.extensors import compound
from dyntorch.geometry.grassmann import candidates
from dyntorch.geometry.grassmann_nearest import projections_of
from dyntorch.geometry.homogeneous import unit_vectors
from dyntorch.numerics.blocks import constant
from dyntorch.numerics.nullspace import null_space
from dyntorch.shapes.static import GENERAL, THIN, centring_basis, lines_through, local, with_basis

Profile = tuple[int, ...]
ROUNDS = 10
"""Rounds of spreading."""
TRIES = 40
"""Solutions compared where a tensor has more than one (views of one dimension)."""


def profile_of(k: int, others: int) -> Profile:
    """How many hyperplanes through each of so many points behind the basis enter the tensor: as even as possible, sum k + 1."""
    least, more = divmod(k + 1, others)
    return (least + 1,) * more + (least,) * (others - more)


def _ordered_partitions(left: tuple[int, ...], profile: Profile) -> list[tuple[tuple[int, ...], ...]]:
    """All ordered partitions of ``left`` into sets of these sizes."""
    if not profile:
        return [()]
    first = combinations(left, profile[0])
    return [(s, *rest) for s in first for rest in _ordered_partitions(tuple(i for i in left if i not in s), profile[1:])]


@constant
def partitions(k: int, profile: Profile, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """The ordered partitions of the basis, one column each.

    Returns:
        ``(m, N)`` which minor of the compound matrix of each point, ``(N,)`` signs, and ``(N, m, k + 1)`` which coordinates of
        which point the entry of the tensor is the product of.
    """
    found = _ordered_partitions(tuple(range(k + 1)), profile)
    place = [{s: i for i, s in enumerate(combinations(range(k + 1), a))} for a in profile]
    index = torch.tensor([[place[j][s] for s in row] for j, row in enumerate(zip(*found, strict=True))])
    flat = [[i for s in row for i in s] for row in found]
    signs = [(-1.0) ** sum(a > b for n, a in enumerate(order) for b in order[n + 1 :]) for order in flat]
    member = torch.zeros(len(found), len(profile), k + 1, dtype=torch.bool)
    for n, row in enumerate(found):
        for j, s in enumerate(row):
            member[n, j, list(s)] = True
    return index.to(device), torch.tensor(signs, dtype=torch.float64, device=device), member.to(device)


def products(basis: Tensor, hyperplanes: Tensor, profile: Profile) -> Tensor:
    """What one view puts before the entries of the tensor: ``(..., r, N)``, a row for every choice of hyperplanes."""
    index, signs, _ = partitions(basis.shape[-2] - 1, profile, basis.device)
    incidence = hyperplanes @ basis[..., None, :, :].mT  # (.., m, h, k + 1)
    rows = signs.to(basis.dtype).expand(*basis.shape[:-2], 1, -1)
    for j, a in enumerate(profile):
        minors = compound(incidence[..., j, :, :], a)[..., index[j]]
        rows = (rows[..., :, None, :] * minors[..., None, :, :]).flatten(-3, -2)
    return rows


def view_rows(x: Tensor, profile: Profile) -> Tensor:
    """Rows of views ``(..., n, l + 1)`` in the coordinates of :func:`free`, ``(..., r, width)``; 0 where a point is missing."""
    k = x.shape[-2] - len(profile) - 1
    p = spread(local(x)[0])
    rows = products(p[..., : k + 1, :], lines_through(p[..., k + 1 :, :]), profile) @ free(k, x.shape[-1] - 1, profile, x.device).mT
    return rows * (x[..., -1] > 0).all(-1)[..., None, None]


def spread(p: Tensor) -> Tensor:
    r"""Points ``(..., n, l + 1)`` of each view after the collineation that spreads their directions evenly, of norm 1."""
    size = p.shape[-1]
    eye = torch.eye(size, dtype=p.dtype, device=p.device)
    unit = unit_vectors(p)
    for _ in range(ROUNDS):
        gram = unit.mT @ unit * (size / p.shape[-2])
        factor, failed = torch.linalg.cholesky_ex(gram + 1e-12 * eye)
        factor = torch.where((failed > 0)[..., None, None], eye, factor)
        unit = unit_vectors(torch.linalg.solve_triangular(factor, unit.mT, upper=False).mT)
    return unit


@constant
def free(k: int, l: int, profile: Profile, device: torch.device) -> Tensor:  # noqa: E741
    r"""Orthonormal basis ``(width, N)`` of what views can say of a tensor: the rows of points anywhere, of no shape."""
    draw = torch.Generator().manual_seed(0)
    count = partitions(k, profile, torch.device("cpu"))[0].shape[1]
    each = _rows_of_a_view(l, profile)
    views = -(-count // each) + 4
    p = unit_vectors(torch.randn(views, k + 1 + len(profile), l + 1, generator=draw, dtype=torch.float64))
    rows = unit_vectors(products(p[:, : k + 1], lines_through(p[:, k + 1 :]), profile).flatten(0, 1))
    values, vectors = torch.linalg.eigh(rows.mT @ rows)
    return vectors[:, values > 1e-9 * values[-1]].mT.contiguous().to(device)


def _rows_of_a_view(l: int, profile: Profile) -> int:  # noqa: E741
    count = 1
    for a in profile:
        count *= comb(l, a)
    return count


@constant
def count_rows(k: int, l: int, profile: Profile) -> tuple[int, int]:  # noqa: E741
    """Independent rows of one view, and fewest views that determine the tensor: ranks of views of a random shape."""
    draw = torch.Generator().manual_seed(1)
    basis = free(k, l, profile, torch.device("cpu"))
    width, n = len(basis), k + 1 + len(profile)
    shape = torch.cat(
        [torch.eye(k + 1, dtype=torch.float64), torch.randn(len(profile), k + 1, generator=draw, dtype=torch.float64)]
    )
    gram, views, rows = torch.zeros(width, width, dtype=torch.float64), 0, 0
    while True:
        camera = torch.randn(k + 1, l + 1, generator=draw, dtype=torch.float64)
        p = unit_vectors(shape @ camera)
        own = products(p[: k + 1], lines_through(p[k + 1 : n]), profile) @ basis.mT
        gram, views = gram + own.mT @ own / own.square().sum(), views + 1
        if views == 1:
            rows = int(torch.linalg.matrix_rank(own, rtol=1e-9))
        if views * rows >= width - 1 and int(torch.linalg.matrix_rank(gram, rtol=1e-12, hermitian=True)) >= width - 1:
            return rows, views


def compose_entries(points: Tensor, profile: Profile) -> Tensor:
    """Entries ``(*batch, N)`` of the tensor of points ``(*batch, n, k + 1)`` in the frame of the basis, all partitions."""
    others = points[..., -len(profile) :, :]
    member = partitions(points.shape[-1] - 1, profile, points.device)[2]
    return torch.where(member, others[..., None, :, :], 1.0).flatten(-2).prod(-1)


def multilinear(tensor: Tensor, basis: Tensor, profile: Profile) -> Tensor:
    r"""The tensor of the points behind the basis for given images of it: the Grassmann tensor of the
    :math:`B\,\mathrm{diag}(X_j)`. tensor ``(*batch, N)``, basis ``(k + 1, l + 1)`` ->
    ``(*batch, binomial(l + 1, alpha_1), ...)``."""
    size = basis.shape[-1]
    eye = torch.eye(size, dtype=basis.dtype, device=basis.device).expand(len(profile), size, size)
    rows = products(basis, eye, profile)
    return (tensor @ rows.mT).unflatten(-1, tuple(comb(size, a) for a in profile))


@constant
def chosen_basis(k: int, l: int, device: torch.device) -> Tensor:  # noqa: E741
    """Images ``(k + 1, l + 1)`` of the basis for which points are taken from a tensor: of 200 random ones the most even."""
    draw = torch.Generator().manual_seed(2)
    tried = unit_vectors(torch.randn(200, k + 1, l + 1, generator=draw, dtype=torch.float64))
    subsets = torch.tensor(list(combinations(range(k + 1), l + 1)))
    return tried[torch.linalg.det(tried[:, subsets]).abs().amin(-1).argmax()].to(device)


def points_of(tensor: Tensor, k: int, l: int, profile: Profile) -> Tensor:  # noqa: E741
    r"""Points ``(*batch, n, k + 1)`` of a tensor ``(*batch, N)``, in closed form for a tensor that is one; 0 for none."""
    basis = chosen_basis(k, l, tensor.device)
    form = multilinear(tensor, basis, profile)
    sizes = (l + 1,) * len(profile)
    if l > 1:
        return _from_projections(projections_of(form, profile, sizes), basis)[0]
    # projections to lines have several solutions, of which one sees the basis
    tried = _from_projections(candidates(form, profile, sizes, TRIES), basis)
    best = tried[1].argmin(0)
    return tried[0].gather(0, best[None, ..., None, None].expand(1, *tried[0].shape[1:]))[0]


def _from_projections(projections: tuple[Tensor, ...], basis: Tensor) -> tuple[Tensor, Tensor]:
    """Points in the standard frame, and how far the basis is from where it should be seen."""
    whole = torch.stack([m / m.flatten(-2).norm(dim=-1)[..., None, None].clamp(min=1e-300) for m in projections], dim=-3)
    sound = whole.flatten(-2).abs().amax(-1).amin(-1) > 0
    eye = torch.eye(*whole.shape[-2:], dtype=whole.dtype, device=whole.device)
    whole = torch.where(sound[..., None, None, None], whole, eye)
    incidence = lines_through(basis)[:, None] @ whole[..., None, :, :, :]  # (.., k + 1, m, l, k + 1)
    stacked = incidence.flatten(-3, -2)
    corner = null_space(stacked)[..., 0, :]  # (.., k + 1, k + 1): corner i
    miss = (stacked @ corner[..., None])[..., 0].norm(dim=-1).amax(-1)
    seen = torch.einsum("...jra,...ia->...jir", whole, corner)
    depth = (seen * basis).sum(-1)  # (.., m, k + 1)
    ratio = depth / depth[..., :1, :]
    points = with_basis(torch.cat([ratio[..., :1, :], unit_vectors(ratio[..., 1:, :])], dim=-2), GENERAL)
    good = sound & points.isfinite().flatten(-2).all(-1)
    return torch.where(good[..., None, None], points, 0.0), torch.where(good, miss, torch.inf)


# ----------------------------------------------------------------------------------------------------------------------
# Points beside a hyperplane: of k = l + 1, where the l + 2 points of the frame of every view lie in a hyperplane of space.


def plane_rows(x: Tensor) -> Tensor:
    r"""Rows of points beside a reference hyperplane, ``(..., l m, (l + 1) (m - 1))``: :math:`p_j \sim v_j + c`, c projected
    out."""
    size = x.shape[-1]
    p, seen = local(x)[0], x[..., -1:]
    corners = p[..., :size, :]
    volume = torch.linalg.det(unit_vectors(corners))[..., None, None].abs() > THIN
    others = p[..., size:, :] @ inverse(torch.where(volume, corners, torch.eye(size, dtype=x.dtype, device=x.device)))
    one = others[..., :1, :]
    sound = volume & (one.abs().amin(-1, keepdim=True) > THIN) & (seen[..., : size + 1, :].amin(-2, keepdim=True) > 0)
    q = unit_vectors(torch.where(sound & (seen[..., size + 1 :, :] > 0), others[..., 1:, :] / torch.where(sound, one, 1.0), 0.0))
    count = q.shape[-2]
    camera = lines_through(q).flatten(-3, -2)  # (.., l m, l + 1)
    own = torch.eye(count, dtype=q.dtype, device=q.device).repeat_interleave(size - 1, 0)
    points = (own[..., None] * camera[..., None, :]).flatten(-2)
    # what the camera explains is left out: the rows across to the columns of c
    square = camera.mT @ camera
    eye = torch.eye(size, dtype=q.dtype, device=q.device)
    shared = inverse(square + 1e-14 * (1 + square.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]) * eye)
    for _ in range(2):
        points = points - camera @ (shared @ (camera.mT @ points))
    return (points.unflatten(-1, (count, size)).mT @ centring_basis(count, x.device).mT).mT.flatten(-2)


def camera_score(structure: Tensor, x: Tensor, freedom: int, affine: bool) -> Tensor:
    r""":math:`\sigma_{\min} / \|E\|_F` of the equations of each view for its camera, ``(*batch, views)``; NaN: too few."""
    seen = x[..., -1:] > 0
    p = unit_vectors(local(torch.cat([torch.where(seen, x[..., :-1], 0.0), seen.to(x)], dim=-1))[0])
    known = unit_vectors(structure)[..., None, :, :]
    size, k = x.shape[-1], structure.shape[-1] - 1
    equations = (
        (lines_through(p)[..., :, None] * known[..., None, None, :]).flatten(-4, -3).flatten(-2)
    )  # (.., l n, (l + 1)(k + 1))
    if affine:
        equations = torch.cat([equations[..., : (size - 1) * (k + 1)], equations[..., -1:]], dim=-1)
    told = (seen[..., 0].sum(-1) * (size - 1) > freedom) & equations.isfinite().flatten(-2).all(-1)
    values = torch.linalg.svdvals(torch.where(told[..., None, None], equations, 0.0))
    return torch.where(told, values[..., -1] / values.norm(dim=-1).clamp(min=1e-300), torch.nan)
