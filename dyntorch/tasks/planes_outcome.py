"""From the parameters of the fit of translating planes to what the caller gets."""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.algebra.homogeneous import homogeneous, nonzero_sign, skew, two_sided, unit, unit_vectors
from dyntorch.algebra.rigid import nearest_rotation
from dyntorch.solution import Status, failed
from dyntorch.tasks.notices import NoticeCode
from dyntorch.tasks.planes_checks import misfit, turned
from dyntorch.tasks.planes_input import Given, enough
from dyntorch.tasks.planes_notices import EXACT, NEAR, Figures, planes_notices
from dyntorch.tasks.planes_problem import Layout
from dyntorch.tasks.planes_result import TranslatingPlanes
from dyntorch.tasks.planes_solver import noise_variance, projected

UNCERTAIN = 0.5
"""Expected relative error of the homography at infinity, in normalized coordinates, from which on nothing is known of it."""
STILL = 3.0
"""Standard deviations within which a plane does not move."""


def outcome(given: Given, found: tuple[Tensor, ...], method: str, refined: bool) -> TranslatingPlanes:
    """The result with a flat batch.

    Args:
        given: what was fitted.
        found: what :func:`~dyntorch.tasks.planes_solver.solve` returns, for all problems, and the cost under the given matrices.
        method: of the start.
        refined: whether it was refined; a start as it is has a residual of its own.
    """
    theta, cost, covariance, undetermined, other, separate = found
    layout = Layout(given.homographies.shape[1], given.fundamentals.shape[1])
    used = given.used()
    planes, bodies = used[:, : layout.planes].sum(-1), used[:, layout.planes :].sum(-1)
    rows, spare = given.rows()
    covariance = noise_variance(cost, spare)[:, None, None] * covariance
    figures = _figures(layout, theta, covariance, used)
    against = misfit(given, cost, separate)
    # what one homography at infinity leaves beyond the noise is an error as well
    covariance = against.excess[:, None, None] * covariance
    uncertainty = projected(covariance[:, :9, :9], theta[:, :9]).diagonal(dim1=-2, dim2=-1).sum(-1).sqrt()
    right = enough(planes, bodies, method)
    several = figures.several()
    # what moves alike, or not at all, differs by noise alone
    told = ~several & ~undetermined & right & refined
    vague = against.vague & told
    apart = (against.apart & told) | vague
    chance = against.chance & told & ~apart
    status = torch.where((uncertainty > UNCERTAIN) | other | several | chance, Status.AMBIGUOUS, Status.OK)
    status = torch.where(apart, Status.NO_CONSENSUS, status)
    status = torch.where(undetermined, Status.DEGENERATE, status)
    status = torch.where(right, status, Status.TOO_FEW)
    distance, bent = turned(given, theta[:, :9], covariance[:, :9, :9], status)
    said = {
        NoticeCode.NO_COMMON_INFINITY: (against.ratio, apart & ~vague),
        NoticeCode.CHANCE: (against.ratio, chance),
        NoticeCode.INCOHERENT: (against.vagueness, vague),
        NoticeCode.CALIBRATION: (distance, bent),
        NoticeCode.UNCERTAIN: (uncertainty, (uncertainty > UNCERTAIN) & right & ~apart),
        NoticeCode.OTHER_SOLUTION: (used.sum(-1), (other | several) & right & ~apart),
    }
    warnings = planes_notices(figures, right, said, given)
    there = (~failed(status)).to(theta.dtype)
    infinity, epipoles, normals = _measured(given, layout, theta)
    infinity = infinity * there[:, None, None]
    mask = (used & there.bool()[:, None]).to(theta.dtype)[..., None]
    epipoles, normals = epipoles * mask, normals * mask[:, : layout.planes]
    models = infinity[:, None] + epipoles[:, : layout.planes, :, None] * normals[..., None, :]
    size = models.square().sum((-2, -1))
    scales = (models * given.measured).sum((-2, -1)) / torch.where(size > 0, size, 1.0)
    rotation = None
    if given.calibration is not None:
        first, second = given.calibration.unbind(1)
        rotation = nearest_rotation(torch.linalg.inv_ex(second)[0] @ infinity @ first)
    return TranslatingPlanes(
        homography_at_infinity=infinity,
        epipoles=epipoles,
        fundamentals=unit(skew(epipoles) @ infinity[:, None]),
        normals=normals,
        scales=scales * mask[:, : layout.planes, 0],
        used=used,
        residual=(cost / rows.clamp(min=1)).sqrt() * there,
        covariance=_known(_carried(covariance[:, :9, :9], theta[:, :9], given.frames), there),
        uncertainty=_known(uncertainty, there),
        status=status,
        rotation=rotation,
        calibration=given.calibration,
        warnings=warnings,
        unit="px" if given.matched else "relative",
    )


def _figures(layout: Layout, theta: Tensor, covariance: Tensor, used: Tensor) -> Figures:
    """Directions of epipoles and normals with their covariances, and which planes move."""
    infinity, epipoles, planes = layout.unpack(theta)
    p = layout.planes
    at = 9 + 3 * torch.arange(p + layout.bodies, device=theta.device)[:, None] + torch.arange(3, device=theta.device)
    of_epipoles = covariance[:, at[:, :, None], at[:, None, :]]
    at = layout.shared + 4 * torch.arange(p, device=theta.device)[:, None] + torch.arange(3, device=theta.device)
    of_normals = covariance[:, at[:, :, None], at[:, None, :]]
    e, n, d = epipoles[:, :p], planes[..., :3], planes[..., 3].abs()
    size = torch.linalg.matrix_norm(infinity)[:, None] * d
    # of e n^T, to first order
    spread = (
        of_normals.diagonal(dim1=-2, dim2=-1).sum(-1) * e.square().sum(-1)
        + of_epipoles[:, :p].diagonal(dim1=-2, dim2=-1).sum(-1) * n.square().sum(-1)
    ).sqrt()
    length = e.norm(dim=-1) * n.norm(dim=-1)
    still = (length <= EXACT * size) | ((length <= NEAR * size) & (length <= STILL * spread))
    moving = torch.cat([used[:, :p] & ~still, used[:, p:]], dim=1)
    return Figures(
        unit_vectors(epipoles), projected(of_epipoles, epipoles), unit_vectors(n), projected(of_normals, n), moving, used
    )


def _measured(given: Given, layout: Layout, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Homography at infinity of norm 1, unit epipoles and normals in measured coordinates."""
    infinity, epipoles, planes = layout.unpack(theta)
    first, back = given.frames[0], torch.linalg.inv_ex(given.frames[1])[0]
    moved = back @ infinity @ first
    found = unit(moved)
    size = (moved * found).sum((-2, -1))
    e = epipoles @ back.mT
    length = e.norm(dim=-1)
    depth = planes[..., 3]
    tiny = torch.finfo(depth.dtype).tiny
    depth = torch.where(depth == 0, tiny, depth)
    normals = planes[..., :3] @ first * (length[:, : layout.planes] / (depth * size[:, None]))[..., None]
    # points of a plane are in front of the camera: its matches, or without them the middle of the image
    points, weights = given.planes.views[0], given.planes.weights
    if not given.matched:
        points, weights = torch.zeros_like(planes[..., None, :2]), torch.ones_like(planes[..., :1])
    inverse = (homogeneous(points) @ planes[..., :3, None])[..., 0] / depth[..., None] / size[:, None, None]
    sign = nonzero_sign((inverse.sign() * weights).sum(-1))[..., None]
    e = unit_vectors(e)
    bodies = unit(e[:, layout.planes :, :, None])[..., 0]
    return found, torch.cat([e[:, : layout.planes] * sign, bodies], dim=1), normals * sign


def _known(value: Tensor, there: Tensor) -> Tensor:
    """Zero where there is no result, infinite where a number of it is beyond the range."""
    wide = (..., *[None] * (value.ndim - 1))
    finite = value.isfinite().flatten(1).all(-1) if value.ndim > 1 else value.isfinite()
    return torch.where(there.bool()[wide], torch.where(finite[wide], value, torch.inf), 0.0)


def _carried(covariance: Tensor, entries: Tensor, frames: tuple[Tensor, Tensor]) -> Tensor:
    """Covariance ``(b, 9, 9)`` of the entries of the homography at infinity in measured coordinates, at norm 1."""
    back = torch.linalg.inv_ex(frames[1])[0]
    lift = two_sided(back, frames[0])
    return projected(lift @ covariance @ lift.mT, (lift @ entries[..., None])[..., 0])
