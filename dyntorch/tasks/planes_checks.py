"""What speaks against a fit of translating planes: a residual that noise does not explain, and a calibration that does not fit."""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.algebra.homogeneous import two_sided
from dyntorch.algebra.rigid import nearest_rotation
from dyntorch.solution import Status
from dyntorch.tasks.planes_input import Given

SPREAD = 0.4
"""Noise that the residuals show, over what it would be without epipoles and normals, from which on no homography at infinity is
common to the planes.  Of 1200 scenes of 4, 5 and 8 planes, 40 matches in 120 pixels each, the largest is 0.37 at 0.5 and 1 px."""
ENTRIES = 0.065
"""Noise of the entries of homographies of norm 1 in normalized coordinates, the same; there it is 0.059 at most."""
WORSE = 6.0
"""Square of the deviations that one homography at infinity forces on the matrices, in noise variances (1 is expected), from which
on it is not common to them.  Of 360 scenes of 4, 5 and 8 planes up to 1 px the largest is 3.9; of 60 times 8 random homographies
near the identity, seen with 0.5 px, the smallest is 8.1."""
LEAST = 8
"""Residuals of the separate matrices to spare from which on these say what the noise is."""
ROUNDING = 1e-5
"""Residual in normalized coordinates that single precision may leave."""
TURNED = 0.01
"""Distance from a rotation that a calibration to two or three digits leaves."""
SMALL = 0.01
"""Deviation from which on four planes do not tell."""
DEVIATIONS = 8.0
"""Standard deviations of that distance that noise is believed to reach."""


def misfit(given: Given, cost: Tensor, separate: Tensor) -> tuple[Tensor, Tensor]:
    r"""How far the planes and bodies are from one homography at infinity, and whether noise does not explain it.

    With matches, the F ratio: what the cost grows by over that of their own matrices, per parameter less, over the variance of
    the noise that is left under these.  With homographies alone, the noise that the residuals show over that which a single
    homography for all would leave; three of them have one residual to spare, which says nothing.

    Args:
        given: what was fitted.
        cost: ``(b,)`` of the fit.
        separate: ``(b,)`` cost of the matches under the given matrices; zero without matches.

    Returns:
        The ratio ``(b,)``, and bool ``(b,)``.
    """
    rows, spare = given.rows()
    sigma, used = (cost / spare.clamp(min=1)).sqrt(), given.used()
    p = given.homographies.shape[1]
    if given.matched:
        planes, bodies = used[:, :p].sum(-1), used[:, p:].sum(-1)
        free = rows - 8 * planes - 7 * bodies
        variance = (separate / free.clamp(min=1)).clamp(min=(ROUNDING / given.frames[1][:, 0, 0]) ** 2)
        ratio = (cost - separate) / (spare - free).clamp(min=1) / variance
        return ratio, (ratio > WORSE) & (free >= LEAST) & (spare > free)
    entries = given.homographies.flatten(-2)
    apart = used[:, :p].sum(-1) - torch.linalg.eigvalsh(entries.mT @ entries)[:, -1]
    ratio = sigma / (apart / (rows - 8).clamp(min=1)).clamp(min=torch.finfo(sigma.dtype).tiny).sqrt()
    told = (spare > 1) & (used[:, p:].sum(-1) == 0)
    return ratio, told & (sigma > ROUNDING) & ((ratio > SPREAD) | (sigma > ENTRIES))


def turned(given: Given, infinity: Tensor, covariance: Tensor, status: Tensor) -> tuple[Tensor, Tensor]:
    r"""Distance ``(b,)`` of :math:`K_2^{-1} H_\infty K_1`, of determinant 1, from a rotation, and whether noise is no reason.

    Args:
        given: with the calibration, or without one.
        infinity: ``(b, 9)`` homography at infinity in normalized coordinates, of any scale.
        covariance: ``(b, 9, 9)`` of it, its scale held.
        status: ``(b,)``; only where it is OK anything is said.
    """
    if given.calibration is None:
        return torch.zeros_like(infinity[:, 0]), torch.zeros_like(status, dtype=torch.bool)
    first, second = given.calibration.unbind(1)
    before = given.frames[0] @ first
    after = torch.linalg.inv_ex(given.frames[1] @ second)[0]
    moved = after @ infinity.unflatten(-1, (3, 3)) @ before
    det = torch.linalg.det(moved)
    scale = (det.sign() * det.abs().clamp(min=torch.finfo(det.dtype).tiny).pow(1 / 3))[:, None, None]
    rotation = nearest_rotation(moved / scale)
    eye = torch.eye(3, dtype=moved.dtype, device=moved.device)
    distance = torch.linalg.matrix_norm(moved / scale - rotation)
    # the symmetric part of R^T M, without its trace, is what no rotation and no scale takes up
    lift = two_sided(rotation.mT @ after, before).unflatten(1, (3, 3)) / scale[..., None]
    lift = (lift + lift.transpose(1, 2)) / 2
    lift = lift - eye[:, :, None] * torch.einsum("biij->bj", lift)[:, None, None] / 3
    lift = lift.flatten(1, 2)
    deviation = (lift @ covariance @ lift.mT).diagonal(dim1=-2, dim2=-1).sum(-1).clamp(min=0).sqrt()
    # from one residual, as of three planes, nobody knows the noise
    known = (status == Status.OK) & (given.rows()[1] > 1)
    # the fit of four small planes may be another minimum, far from what its covariance says
    used, p = given.used(), given.homographies.shape[1]
    known = known & ((used[:, :p].sum(-1) >= 5) | used[:, p:].any(-1) | (deviation < SMALL))
    return distance, known & (distance > TURNED) & (distance > DEVIATIONS * deviation)
