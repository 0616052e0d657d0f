"""How far the points of each view are from the nearest image of a known shape, with the camera of the view eliminated."""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.algebra.homogeneous import unit_vectors
from dyntorch.algebra.shape_points import AFFINE, GENERAL, dual_cameras, reference_cameras
from dyntorch.algebra.shape_rows import canonical, lines_through, local
from dyntorch.constants import constant
from dyntorch.invariants.reprojection import Linearization, linearize

CAMERA = {"general": 11, "plane": 11, "affine": 8}
"""Degrees of freedom of the camera that each frame leaves open."""


def reprojection_residual(structure: Tensor, x: Tensor, scale: Tensor, frame: str) -> Tensor:
    r"""Reprojection error that no camera takes away, in standard deviations of noise, to first order.

    A camera is to the points of a view what a point is to the cameras of several views, so it is eliminated in the same way:
    point i sees the unknown camera through :math:`X_i^T \otimes I`.

    Args:
        structure: ``(*batch, n, 4)`` homogeneous points.
        x: ``(*batch, views, n, 3)`` measurements; third coordinate 0 where missing.
        scale: ``(*batch,)`` standard deviation of the noise of one coordinate.
        frame: which cameras there are.

    Returns:
        ``(*batch, views, 2 n)``, whose square sum follows chi squared with 2 n - 11 (8) degrees of freedom; NaN where a view
        shows no more than its camera takes.
    """
    at, known, _ = _linearized(structure, x, scale, frame)
    error = at.error - (at.slope @ (at.inverse @ (at.slope.mT @ at.error[..., None])))[..., 0]
    return torch.where(known[..., None], error[..., 0, :], torch.nan)


def reprojection_derivative(structure: Tensor, x: Tensor, scale: Tensor, frame: str) -> tuple[Tensor, Tensor]:
    """:func:`residual` and its derivative ``(*batch, views, 2 n, n, 4)`` by the points; both 0 where a view says nothing.

    The camera follows the points (Kaufman's form of variable projection), as the points follow the cameras in reconstruction.
    """
    at, known, length = _linearized(structure, x, scale, frame)
    known = known[..., None, None]
    project = torch.eye(at.error.shape[-1], dtype=x.dtype, device=x.device) - (at.slope @ at.inverse @ at.slope.mT)[..., 0, :, :]
    error = (project @ at.error.mT)[..., 0]
    n = x.shape[-2]
    maps = _maps(frame, x.device)  # (4, 3, K)
    # the image of each point by its own four coordinates
    moved = torch.einsum("...k,ark->...ra", at.structure[..., 0, :], maps)  # (.., 3, 4): the camera
    image, depth, weight = (part[..., 0, :].unflatten(-1, (n, 2)) for part in (at.image, at.depth, at.weight.expand_as(at.image)))
    own = (moved[..., None, :2, :] - image[..., None] * moved[..., None, 2:, :]) * (weight / depth)[..., None]
    seen = looked_at(x)[..., None, None]
    own = torch.where(seen, own / length[..., None, :, None, None], 0.0)
    derivative = -torch.einsum("...cni,...nia->...cna", project.unflatten(-1, (n, 2)), own)
    return torch.where(known[..., 0], error, 0.0), torch.where(known[..., None], derivative, 0.0)


def looked_at(x: Tensor) -> Tensor:
    """Which points of measurements ``(..., n, 3)`` are seen."""
    return x[..., 2] > 0


def view_score(structure: Tensor, x: Tensor, frame: str) -> Tensor:
    r"""How nearly the equations of the camera of each view are dependent, ``(*batch, views)`` in [0, 1].

    :math:`\sigma_4 / \|E\|_F`, E the equations :math:`l^T \hat P_i m = 0` of the points in the frame of the basis; for affine
    cameras the error of the centred points over their size.

    Args:
        structure: ``(*batch, n, 4)`` in the standard frame.
        x: ``(*batch, views, n, 3)`` measurements.
        frame: which cameras there are.

    Returns:
        NaN where a view shows no more than its camera takes.
    """
    seen = looked_at(x).to(x)
    x = torch.cat([torch.where(seen[..., None] > 0, x[..., :2], 0.0), seen[..., None]], dim=-1)
    if frame == AFFINE:
        factor, ones = local(x)[1], torch.ones_like(structure[..., 0, 0])
        return reprojection_residual(structure, x, ones, frame).norm(dim=-1) * factor / seen.sum(-1).clamp(min=1.0).sqrt()
    others = unit_vectors(structure[..., 4:, :])
    cameras = torch.stack(dual_cameras(others) if frame == GENERAL else reference_cameras(others), dim=-3)
    q = canonical(x)[0] * seen[..., :4].amin(-1)[..., None, None]
    equations = (lines_through(q) @ cameras[..., None, :, :, :]).flatten(-3, -2)
    finite = equations.isfinite().flatten(-2).all(-1)  # a shape that could not be fitted has no cameras
    values = torch.linalg.svdvals(torch.where(finite[..., None, None], equations, 0.0))
    known = finite & ((q != 0).any(-1).sum(-1) > 1)
    return torch.where(known, values[..., 3] / values.norm(dim=-1).clamp(min=1e-300), torch.nan)


def _linearized(structure: Tensor, x: Tensor, scale: Tensor, frame: str) -> tuple[Linearization, Tensor, Tensor]:
    """Cameras and images of all views; which views say something; the lengths ``(*batch, n)`` of the points."""
    seen = looked_at(x)
    # zero measurements where missing, and zero points there, give zero equations
    p, factor = local(torch.cat([torch.where(seen[..., None], x[..., :2], 0.0), seen[..., None].to(x)], dim=-1))
    noise = scale[..., None] * factor
    length = structure.norm(dim=-1)
    points = unit_vectors(structure)[..., None, :, :] * seen[..., None]
    looks = torch.einsum("...na,ark->...nrk", points, _maps(frame, x.device))
    n = x.shape[-2]
    at = linearize(looks.unbind(-3), [p[..., i, None, :2] for i in range(n)], [noise] * n)
    return at, 2 * seen.sum(-1) > CAMERA[frame], torch.where(length > 0, length, 1.0)


@constant
def _maps(frame: str, device: torch.device) -> Tensor:
    """What point coordinate a shows of camera entry k in image coordinate r: ``(4, 3, 12)``, affine cameras ``(4, 3, 9)``."""
    maps = torch.einsum("ab,rs->arsb", torch.eye(4), torch.eye(3)).flatten(-2).double()
    if frame == AFFINE:
        # the last row of the camera is (0, 0, 0, s)
        maps = maps[..., [*range(8), 11]]
    return maps.to(device)
