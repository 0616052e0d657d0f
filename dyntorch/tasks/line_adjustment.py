r"""Bundle adjustment of cameras and straight trajectories: all distances of points from the images of their lines at once."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from dyntorch.algebra.extensors import plucker_form
from dyntorch.algebra.homogeneous import skew
from dyntorch.algebra.klein_quadric import nearest_line
from dyntorch.algebra.line_cameras import line_camera
from dyntorch.algebra.line_collineation import skew_line
from dyntorch.least_squares import damped_step
from dyntorch.tasks.line_descent import Sightings, image_distances

STEPS, SETTLED = 25, 1e-6
"""At most so many steps, and the relative decrease of the cost below which a problem has converged."""
STUCK = 1e8  # damping at which no step is left to take


def adjust(data: Sightings, lines: Tensor) -> Sightings:
    r"""Levenberg-Marquardt over cameras and lines, the lines eliminated (Schur complement).

    With :math:`l = M(P) L` and :math:`g = \partial r / \partial l` the derivative of a distance in the camera is
    :math:`[g]_\times P [L]`; along the collineations of space and the scales of the cameras, which change nothing, the damping
    holds it.

    Args:
        data: normalized sightings, cameras to start from.
        lines: ``(*batch, n, 6)`` on the Klein quadric.

    Returns:
        The sightings with the best cameras, each of norm 1.
    """
    damping = torch.full_like(lines[..., 0, 0], 1e-3)
    cost = _cost(data, lines)
    done = torch.zeros_like(cost, dtype=torch.bool)
    for _ in range(STEPS):
        shift, turn = _step(data, lines, damping)
        moved = data.cameras - shift
        trial = replace(data, cameras=moved / torch.linalg.matrix_norm(moved, keepdim=True))
        ends = nearest_line(lines - turn)
        found = _cost(trial, ends)
        better = (found < cost) & ~done
        settled = (better & (cost - found <= SETTLED * cost)) | (damping > STUCK)
        data = replace(data, cameras=torch.where(better[..., None, None, None], trial.cameras, data.cameras))
        lines = torch.where(better[..., None, None], ends, lines)
        cost, damping = torch.where(better, found, cost), torch.where(better, damping / 10, damping * 10).clamp(min=1e-12)
        done = done | settled
        if bool(done.all()):
            break
    return data


def _cost(data: Sightings, lines: Tensor) -> Tensor:
    """Sum of squared weighted distances, ``(*batch,)`` px^2."""
    return image_distances(data, lines)[0].square().sum((-2, -1))


def _step(data: Sightings, lines: Tensor, damping: Tensor) -> tuple[Tensor, Tensor]:
    """Steps of the cameras ``(*batch, views, 3, 4)`` and the lines ``(*batch, n, 6)``, to be subtracted."""
    distance, slope = image_distances(data, lines)  # (*batch, views, n), (*batch, views, n, 3)
    by_line = torch.einsum("...vni,...vik->...nvk", slope, line_camera(data.cameras))
    across = torch.stack([lines, lines @ plucker_form(device=lines.device)], dim=-2)
    by_line = by_line - (by_line @ across.mT) @ across
    by_camera = (skew(slope) @ data.cameras[..., None, :, :] @ skew_line(lines)[..., None, :, :, :]).flatten(-2)
    views = distance.shape[-2]
    own = by_line.mT @ by_line
    size = own.diagonal(dim1=-2, dim2=-1).sum(-1) + torch.finfo(own.dtype).tiny
    own = own + torch.diag_embed(own.diagonal(dim1=-2, dim2=-1) * damping[..., None, None])
    factor, _ = torch.linalg.cholesky_ex(
        own + size[..., None, None] * (across.mT @ across + 1e-12 * torch.eye(6, dtype=own.dtype, device=own.device))
    )
    pull = torch.einsum("...nvk,...vn->...nk", by_line, distance)
    mixed = (by_camera.transpose(-3, -2)[..., None] * by_line[..., None, :]).flatten(-3, -2)  # (*batch, n, 12 views, 6)
    solved = torch.cholesky_solve(mixed.mT, factor).mT
    whole = torch.einsum("...vnp,...vnq->...vpq", by_camera, by_camera)
    blocks = torch.eye(views, dtype=whole.dtype, device=whole.device)[:, None, :, None] * whole[..., :, :, None, :]
    reduced = blocks.flatten(-4, -3).flatten(-2) - (mixed.transpose(-3, -2).flatten(-2) @ solved.transpose(-3, -2).flatten(-2).mT)
    gradient = torch.einsum("...vnp,...vn->...vp", by_camera, distance).flatten(-2) - (solved @ pull[..., None])[..., 0].sum(-2)
    shift = damped_step(gradient.flatten(0, -2), reduced.flatten(0, -3), damping.flatten()).view(gradient.shape)
    rest = pull - (mixed.mT @ shift[..., None, :, None])[..., 0]
    turn = torch.cholesky_solve(rest[..., None], factor)[..., 0]
    return shift.unflatten(-1, (views, 3, 4)), torch.where(turn.isfinite(), turn, 0.0)
