"""The homography at infinity of translating bodies of which one or more have a known fundamental matrix."""

from __future__ import annotations

from dataclasses import dataclass
from math import prod

import torch
from torch import Tensor

from dyntorch.geometry.extensors import compound, extensor_of, subspace_of, wedge
from dyntorch.geometry.homogeneous import cofactors, nonzero_sign, null_vectors, rank_one, skew, unit_size, unit_vectors
from dyntorch.numerics.blocks import constant, map_blocks
from dyntorch.numerics.nullspace import gram_null_space, null_space, real_eigenvalues

# ----------------------------------------------------------------------------------------------------------------------
# Pencils of matrices with a member of rank one: what a plane of a translating body makes with the homography at infinity.


DETERMINANT_EPSILON = 1e-12  # |det| / |H|^3 below which a homography cannot be scaled to determinant 1


BEAM_WIDTH = 243  # selections of scales while planes are added: all of up to six planes
NUM_SCALE_CHOICES = 4  # selections of scales that are solved to the end
NUM_REWEIGHTINGS = 1  # of the planes beside a known fundamental matrix; three do no better


@dataclass(frozen=True)
class PlaneParts:
    """Planes of translating bodies under a homography at infinity: :math:`H_i = \\lambda_i (H_\\infty + e_i n_i^T)`."""

    scale: Tensor
    """``(*batch, n)`` :math:`\\lambda_i`."""
    epipole: Tensor
    """``(*batch, n, 3)`` unit vectors :math:`e_i` in view 2; their signs are arbitrary."""
    normal: Tensor
    """``(*batch, n, 3)`` :math:`n_i`, for the unit epipole; about 0 for a plane that does not move, or at infinity."""
    residual: Tensor
    """``(*batch, n)`` what is left, :math:`\\|H_i - \\lambda_i (H_\\infty + e_i n_i^T)\\| / \\|H_i\\|`; no scale
    changes it."""


def unit_determinant(matrix: Tensor) -> Tensor:
    r"""A 3 x 3 matrix up to scale with determinant 1; one that is singular gets norm 1 instead, and 0 stays. matrix
    ``(*batch, 3, 3)`` -> ``(*batch, 3, 3)``."""
    norm = torch.linalg.matrix_norm(matrix, keepdim=True)
    scaled = matrix / torch.where(norm > 0, norm, 1.0)
    det = torch.linalg.det(scaled)[..., None, None]
    regular = det.abs() > DETERMINANT_EPSILON
    root = torch.where(regular, det.abs(), 1.0) ** (1 / 3)
    return torch.where(regular, scaled * nonzero_sign(det) / root, scaled)


def rank_one_scale(first: Tensor, second: Tensor) -> Tensor:
    r"""The :math:`\nu` for which :math:`A - \nu B` is nearest to rank one, relative to its size. first ``(*batch, r, c)`` ->
    ``(*batch,)``."""
    a, size_a = unit_size(first)
    b, size_b = unit_size(second)
    a, b = torch.broadcast_tensors(a, b)
    constant, quadratic = compound(a, 2).flatten(-2), compound(b, 2).flatten(-2)
    linear = constant + quadratic - compound(a - b, 2).flatten(-2)
    coefficients = (
        (constant * linear).sum(-1),
        (linear.square() + 2 * constant * quadratic).sum(-1),
        (linear * quadratic).sum(-1),
        quadratic.square().sum(-1),
    )
    ratio = (a * b).sum((-2, -1))[..., None]
    candidates = torch.cat([_stationary(*coefficients), ratio], dim=-1)
    member = a[..., None, :, :] - candidates[..., None, None] * b[..., None, :, :]
    best = second_singular_value(member).argmin(-1, keepdim=True)
    return candidates.gather(-1, best)[..., 0] * (size_a / torch.where(size_b > 0, size_b, 1.0))[..., 0, 0]


def _stationary(c0: Tensor, c1: Tensor, c2: Tensor, c3: Tensor) -> Tensor:
    """Real parts ``(*batch, 3)`` of the roots of 2 c3 v^3 - 3 c2 v^2 + c1 v - c0, the derivative of the quartic (halved)."""
    lead = 2 * torch.where(c3 > torch.finfo(c3.dtype).tiny, c3, 1.0)
    companion = torch.diag_embed(torch.ones_like(c0)[..., None].expand(*c0.shape, 2), offset=-1)
    companion[..., 0, :] = torch.stack([3 * c2, -c1, c0], dim=-1) / lead[..., None]
    # the real part of a complex root is one more candidate, and never the best
    return torch.linalg.eigvals(companion.nan_to_num(0.0, 1e100, -1e100)).real


def second_singular_value(matrix: Tensor) -> Tensor:
    r"""About the second singular value, :math:`\|C_2(D)\| / \|D\|`: 0 where the rank is one, and for D = 0. matrix
    ``(*batch, r, c)`` -> ``(*batch,)``."""
    size = torch.linalg.matrix_norm(matrix)
    return torch.linalg.matrix_norm(compound(matrix, 2)) / torch.where(size > 0, size, 1.0)


def plane_parts(homographies: Tensor, infinity: Tensor) -> PlaneParts:
    r"""Scale, epipole and normal of planes, given the homography at infinity: :math:`H_i = \lambda_i (H_\infty + e_i n_i^T)`.
    homographies ``(*batch, n, 3, 3)``, infinity ``(*batch, 3, 3)``."""
    check_homographies(homographies, 1)
    if infinity.shape[-2:] != (3, 3):
        raise ValueError(f"infinity must be (*batch, 3, 3), got {tuple(infinity.shape)}")
    planes, finite = finite_matrices(homographies)
    base = finite_matrices(infinity)[0][..., None, :, :]
    scale = rank_one_scale(planes, base)
    nonzero = torch.where(scale == 0, 1.0, scale)
    difference = planes / nonzero[..., None, None] - base
    epipole, normal = rank_one(difference)
    left = torch.linalg.matrix_norm(difference - epipole[..., :, None] * normal[..., None, :])
    size = torch.linalg.matrix_norm(planes)
    residual = left * nonzero.abs() / torch.where(size > 0, size, 1.0)
    mask = finite.to(planes.dtype)
    return PlaneParts(scale * mask, epipole * mask[..., None], normal * mask[..., None], residual * mask)


def check_homographies(homographies: Tensor, least: int) -> None:
    """Refuse what is not a stack of at least so many homographies."""
    if homographies.ndim < 3 or homographies.shape[-2:] != (3, 3) or not homographies.is_floating_point():
        raise ValueError(
            f"H must be a floating point tensor (*batch, n, 3, 3), got {tuple(homographies.shape)} {homographies.dtype}"
        )
    if homographies.shape[-3] < least:
        raise ValueError(
            f"H has {homographies.shape[-3]} planes, this method takes at least {least}: add {least - homographies.shape[-3]}"
        )


def finite_matrices(matrices: Tensor) -> tuple[Tensor, Tensor]:
    """Matrices in float64 with zeros for those that are not finite, and which are finite ``(*batch,)``."""
    finite = matrices.isfinite().flatten(-2).all(-1)
    return torch.where(finite[..., None, None], matrices, 0.0).double(), finite


# ----------------------------------------------------------------------------------------------------------------------
# The homography at infinity of independently translating planes in closed form, from three of them.
#
# With the right scales, :math:`G_i = H_i / \lambda_i = H_\infty + e_i n_i^T`, the differences
#
# .. math:: D_{ij} = G_i - G_j = e_i n_i^T - e_j n_j^T
#
# are singular; a left null vector of :math:`D_{ij}` is the line through both epipoles, a right one the line of both normals.


RIDGE_EPSILON = 1e-14  # of the trace: what keeps normal equations invertible


def infinity_closed_form(homographies: Tensor) -> tuple[Tensor, Tensor]:
    r"""The homography at infinity from three planes of translating bodies, or more, in closed form. homographies
    ``(*batch, n, 3, 3)`` -> ``(*batch, 3, 3)``."""
    check_homographies(homographies, 3)
    batch, count = homographies.shape[:-3], homographies.shape[-3]
    given, finite = finite_matrices(homographies.reshape(prod(batch), count, 3, 3))
    # those that are not finite last: the first plane is the one that all scales refer to
    finite, order = finite.sort(dim=-1, descending=True, stable=True)
    planes = unit_determinant(given.take_along_dim(order[..., None, None], dim=1))
    present = finite.double()[:, None]
    scaled = _choices(_scaled_candidates(planes), present)
    # the last candidates: each of the planes, if it is static
    found = torch.cat([*(solve(scaled, present) for solve in SOLVERS), planes], dim=1)
    found = unit_determinant(found.nan_to_num(0.0, 0.0, 0.0))
    errors = _mean(plane_parts(planes[:, None], found).residual.square()[..., None], present)[..., 0].sqrt()
    errors = torch.where((found == 0).flatten(-2).all(-1), 1.0, errors)  # all of a plane
    best = errors.argmin(-1, keepdim=True)
    residual = errors.gather(-1, best)[:, 0]
    found = found.take_along_dim(best[..., None, None], dim=1)[:, 0]
    return found.reshape(*batch, 3, 3), residual.reshape(batch)


def _scaled_candidates(planes: Tensor) -> Tensor:
    """``(b, n, 3, 3, 3)``: every plane with three scales, of which one goes with the first plane as it is."""
    inverse = cofactors(planes[:, 1:]).mT  # determinant 1
    ratios = real_eigenvalues(inverse @ planes[:, :1])
    ratios = torch.cat([torch.ones_like(planes[:, :1, 0]), ratios], dim=1)
    return ratios[..., None, None] * planes[:, :, None]


def _choices(candidates: Tensor, present: Tensor) -> Tensor:
    """``(b, k, n, 3, 3)``: the choices of scales for which the differences are nearest to singular."""
    cost = _pair_costs(candidates) * (present.mT * present)[..., None, None]
    b, n = candidates.shape[:2]
    chosen = torch.zeros(b, 1, 1, dtype=torch.long, device=candidates.device)
    total = cost.new_zeros(b, 1)
    for j in range(1, n):
        # cost[i, j, choice_i, .] summed over the planes i before j
        rows = [cost[:, i, j].gather(1, chosen[:, :, i, None].expand(-1, -1, 3)) for i in range(j)]
        more = (total[..., None] + torch.stack(rows).sum(0)).flatten(1)
        total, index = more.topk(min(BEAM_WIDTH, more.shape[1]), dim=1, largest=False)
        before = chosen.gather(1, (index // 3)[..., None].expand(-1, -1, j))
        chosen = torch.cat([before, (index % 3)[..., None]], dim=-1)
    chosen = chosen.gather(
        1, total.topk(min(NUM_SCALE_CHOICES, total.shape[1]), largest=False).indices[..., None].expand(-1, -1, n)
    )
    return candidates[:, None].take_along_dim(chosen[..., None, None, None], dim=3)[:, :, :, 0]


def _pair_costs(candidates: Tensor) -> Tensor:
    """How far from singular the differences of two planes are, ``(b, n, n, 3, 3)``: scales of the first, of the second."""
    first, second = candidates[:, :, None, :, None], candidates[:, None, :, None, :]
    difference = first - second
    size = torch.linalg.matrix_norm(first) + torch.linalg.matrix_norm(second)
    minors = torch.linalg.matrix_norm(cofactors(difference))
    third = torch.linalg.det(difference).abs() / torch.where(minors > 0, minors, 1.0)
    # below rank two the quotient of two zeros says nothing
    return torch.minimum(third, second_singular_value(difference)) / torch.where(size > 0, size, 1.0)


def _general(planes: Tensor, present: Tensor) -> Tensor:
    """The solution ``(b, k, 3, 3)`` for scaled planes ``(b, k, n, 3, 3)`` in general position: all e_i, n_i, then least squares."""
    left, right = (gram_null_space(v.mT @ v).basis[..., 0, :] for v in _null_vectors(planes, present))
    outer = (left[..., :, None] * right[..., None, :]).flatten(-2)
    across = torch.eye(9, dtype=planes.dtype, device=planes.device) - outer[..., :, None] * outer[..., None, :]
    across = across * present[..., None, None]
    found = ridge_solution(across.sum(-3), (across @ planes.flatten(-2)[..., None]).sum(-3)[..., 0])
    return found.unflatten(-1, (3, 3))


def _collinear(planes: Tensor, present: Tensor) -> Tensor:
    r"""The solution for epipoles on one line l, where :math:`l^T G_i = l^T H_\infty` for all planes."""
    lines = _null_vectors(planes, present)[0].flatten(-3, -2)
    # two unit vectors across the common line, the eigenvector of the largest eigenvalue
    across = gram_null_space(lines.mT @ lines, 2).basis
    line = unit_vectors(torch.linalg.cross(across[..., 0, :], across[..., 1, :]))
    rows = across[..., None, :, :] @ planes
    centre = _mean(rows, present)
    p, q = (rows - centre[..., None, :, :]).unbind(-2)
    equations = torch.cat([-skew(q), skew(p)], dim=-1)
    constants = torch.linalg.cross(p, q)
    equations = (equations - _mean(equations, present)[..., None, :, :]) * present[..., None, None]
    constants = (constants - _mean(constants, present)[..., None, :]) * present[..., None]
    equations, constants = equations.flatten(-3, -2), constants.flatten(-2)
    found = ridge_solution(equations.mT @ equations, (equations.mT @ constants[..., None])[..., 0]).unflatten(-1, (2, 3))
    return across.mT @ (found + centre) + line[..., :, None] * (line[..., None, :] @ _mean(planes, present))


# for normals that are orthogonal to one direction the transposed problem is one of epipoles on one line
SOLVERS = (_general, _collinear, lambda planes, present: _collinear(planes.mT, present).mT)


def _null_vectors(planes: Tensor, present: Tensor) -> tuple[Tensor, Tensor]:
    """Left and right null vectors ``(b, k, n, n, 3)`` of all differences, as long as these are far from rank one."""
    difference = planes[..., :, None, :, :] - planes[..., None, :, :, :]
    left, right = null_vectors(difference)
    strength = (second_singular_value(difference) * present[..., :, None] * present[..., None, :])[..., None]
    return left * strength, right * strength


def _mean(values: Tensor, present: Tensor) -> Tensor:
    """Over the planes ``(b, k, n, ...)`` that are present ``(b, 1, n)``."""
    weights = (present / present.sum(-1, keepdim=True).clamp(min=1.0))[(..., *([None] * (values.ndim - 3)))]
    return (values * weights).sum(2)


def ridge_solution(gram: Tensor, right: Tensor) -> Tensor:
    """Solution ``(..., k)`` of normal equations ``(..., k, k)``, finite for a singular matrix, as of parallel planes."""
    trace = gram.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    eye = torch.eye(gram.shape[-1], dtype=gram.dtype, device=gram.device)
    inverse = torch.linalg.inv_ex(gram + (RIDGE_EPSILON * trace + torch.finfo(gram.dtype).tiny) * eye)[0]
    return (inverse @ right[..., None])[..., 0]


def infinity_from_fundamentals(fundamentals: Tensor) -> tuple[Tensor, Tensor]:
    r"""The homography at infinity from two fundamental matrices of translating bodies, or more. fundamentals
    ``(*batch, m, 3, 3)`` -> ``(*batch, 3, 3)``."""
    if fundamentals.ndim < 3 or fundamentals.shape[-2:] != (3, 3) or fundamentals.shape[-3] < 2:
        raise ValueError(f"F must be (*batch, m, 3, 3) with m >= 2, got {tuple(fundamentals.shape)}")
    known = unit_vectors(finite_matrices(fundamentals)[0].flatten(-2))
    axes = torch.eye(9, dtype=known.dtype, device=known.device).unflatten(-1, (3, 3))
    products = axes.mT @ known.unflatten(-1, (3, 3))[..., None, :, :]
    # the equations in the columns: one for every entry, so that those off the diagonal weigh as much as in the norm
    rows = (products + products.mT).flatten(-2).mT.flatten(-3, -2)
    found = null_space(rows)[..., 0, :].unflatten(-1, (3, 3))
    return unit_determinant(found), torch.linalg.svdvals(rows.detach())


def infinity_from_mixed(fundamental: Tensor, homographies: Tensor) -> tuple[Tensor, Tensor]:
    r"""The homography at infinity from one fundamental matrix and two planes of other bodies, or more, in closed form.
    fundamental ``(*batch, 3, 3)``, homographies ``(*batch, n, 3, 3)`` -> ``(*batch, 3, 3)``."""
    check_homographies(homographies, 2)
    if fundamental.shape[-2:] != (3, 3):
        raise ValueError(f"F must be (*batch, 3, 3), got {tuple(fundamental.shape)}")
    known, planes = finite_matrices(fundamental)[0], unit_determinant(finite_matrices(homographies)[0])
    present = (planes != 0).flatten(-2).any(-1).double()
    epipole, _ = null_vectors(known)
    visible = skew(epipole) @ known
    visible = visible / torch.linalg.matrix_norm(visible, keepdim=True).clamp(min=torch.finfo(visible.dtype).tiny)
    across = null_space(epipole[..., None, :], 2)
    base = (across @ visible)[..., None, :, :]
    scale = rank_one_scale(across[..., None, :, :] @ planes, base)
    scale = torch.where(scale == 0, 1.0, scale)[..., None]
    normal = rank_one(across[..., None, :, :] @ planes - scale[..., None] * base)[1]
    strength = normal.norm(dim=-1) * present
    normal = unit_vectors(normal)
    on_line = (epipole[..., None, None, :] @ planes)[..., 0, :] / scale
    a = _nearest_to_lines(on_line, normal, strength, scale[..., 0], NUM_REWEIGHTINGS)
    infinity = unit_determinant(visible + epipole[..., :, None] * a[..., None, :])
    squares = plane_parts(planes, infinity).residual.square() * present
    return infinity, (squares.sum(-1) / present.sum(-1).clamp(min=1.0)).sqrt()


def _nearest_to_lines(points: Tensor, directions: Tensor, strength: Tensor, scale: Tensor, reweightings: int) -> Tensor:
    """The point ``(*batch, 3)`` nearest to lines through points ``(*batch, n, 3)``, each by what it is known with."""
    eye = torch.eye(3, dtype=points.dtype, device=points.device)
    weight = strength.square()
    for _ in range(1 + reweightings):
        across = eye - directions[..., :, None] * directions[..., None, :]
        across = across * weight[..., None, None]
        found = ridge_solution(across.sum(-3), (across @ points[..., None]).sum(-3)[..., 0])
        along = ((found[..., None, :] - points) * directions).sum(-1)
        weight = (scale * strength).square() / (strength.square() + (scale * along).square() + torch.finfo(points.dtype).tiny)
    return found.nan_to_num(0.0, 0.0, 0.0)


# ----------------------------------------------------------------------------------------------------------------------
# The homography at infinity of independently translating planes by linear equations for an extensor.
#
# For a homography H the fundamental matrices that it is compatible with form a subspace of :math:`R^9`,
#
# .. math:: S(H) = \{[e]_\times H : e \in R^3\} = \{F : H^T F + F^T H = 0\},
#
# of dimension three.  A plane with the homography :math:`H_i = \lambda_i (H_\infty + e_i n_i^T)` has
# :math:`F_i = [e_i]_\times H_\infty` in common with :math:`S(H_\infty)`: a transversal of all :math:`S(H_i)`.  Subspaces meet
# where their join vanishes, :math:`a \vee \mathrm{ext}\, S(H_i) = 0` for the extensor a of :math:`S(H_\infty)`, linear in a.


BLOCK = 1 << 19
"""Numbers per block of equations (4 MB): they stay in the cache."""


def infinity_linear(homographies: Tensor) -> tuple[Tensor, Tensor]:
    r"""The homography at infinity from four planes of translating bodies, or more: 64 linear unknowns. homographies
    ``(*batch, n, 3, 3)`` -> ``(*batch, 3, 3)``."""
    check_homographies(homographies, 4)
    return _solve(homographies, 64)


def infinity_thesis(homographies: Tensor) -> tuple[Tensor, Tensor]:
    r"""The homography at infinity from five planes or more, by the double algebra of the thesis: 84 linear unknowns.
    homographies ``(*batch, n, 3, 3)`` -> ``(*batch, 3, 3)``."""
    check_homographies(homographies, 5)
    return _solve(homographies, 84)


def _solve(planes: Tensor, unknowns: int) -> tuple[Tensor, Tensor]:
    """The solution among extensors of 64 or 84 unknowns."""
    # unit extensors of the S(H); 0 for a plane that is not finite, or singular
    axes = skew(torch.eye(3, dtype=torch.float64, device=planes.device))
    members = axes @ unit_determinant(finite_matrices(planes)[0])[..., None, :, :]
    extensors, table, batch = unit_vectors(extensor_of(members.flatten(-2))), _joins(unknowns, planes.device), planes.shape[:-3]

    def block(extensors: Tensor) -> tuple[Tensor, Tensor]:
        rows = (extensors @ table.flatten(1)).unflatten(-1, table.shape[1:]).flatten(1, 2)
        return null_space(rows)[:, 0], torch.linalg.svdvals(rows.detach())

    flat = extensors.reshape(prod(batch), *extensors.shape[-2:])
    vector, spectrum = map_blocks(block, flat, size=max(1, BLOCK // max(1, flat.shape[1] * table[0].numel())))
    extensor = vector if unknowns == 84 else vector @ _invariant_basis(planes.device)
    transversal = subspace_of(extensor, 9, 3).unflatten(-1, (3, 3))
    return infinity_from_fundamentals(transversal)[0].reshape(*batch, 3, 3), spectrum.reshape(*batch, unknowns)


@constant
def _joins(unknowns: int, device: torch.device) -> Tensor:
    """The join with every unknown, as a linear map of an extensor: ``(84, equations, unknowns)``."""
    eye = torch.eye(84, dtype=torch.float64, device=device)
    return wedge(eye[:, None, :], _invariant_basis(device) if unknowns == 64 else eye, 9, (3, 3)).mT.contiguous()


@constant
def _invariant_basis(device: torch.device) -> Tensor:
    r"""Orthonormal basis ``(64, 84)`` of what the extensors of all S(H) span."""
    grid = [(i, j, 3 - i - j) for i in range(4) for j in range(4 - i)]  # on which no cubic vanishes
    points = torch.tensor(grid, dtype=torch.float64)
    eye = torch.eye(3, dtype=torch.float64)
    left = eye[None, :, :, None] * points[:, None, None, :]
    right = points[:, None, :, None] * eye[None, :, None, :]
    others = extensor_of(torch.cat([left, right]).flatten(-2))
    return null_space(others, 64).to(device)
