"""Starts of structured bundle adjustment that need no tensor: the scene as if it stood still, in several frames."""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.algebra.lift import gauge_algebra
from dyntorch.algebra.lift_frames import centred, finite, moved
from dyntorch.motions import Motion
from dyntorch.tasks.lifted_projections import Tracks, choices, projections_of_tracks

REST = 1e-8
"""Of the lifts: below it constants of a point do not change its position."""
VIEWS = 4
"""Of the tensor of the scene at rest."""
WINDOWS = (6, 5)
"""Views that are taken at once, in turn.  Of 30 scenes of constant velocity, 8, 9 and 12 views with gaps of 20 to 25 %, most with
too few points common to any four views, 28 are found and 2 given up."""
TILT = 0.25
"""Standard deviation of the hyperplane at infinity of further frames, for points of unit variance."""


def middle(times: Tensor, number: int = 0) -> Tensor:
    """Indices of the views in the middle of the time, during which nothing moves far; all, where they are few."""
    count = len(times) if len(times) <= WINDOWS[0] else WINDOWS[number % len(WINDOWS)]
    first = (len(times) - count) // 2
    return times.argsort()[first : first + count].sort().values


def resting_constants(lifts: Tensor) -> Tensor:
    """Orthonormal ``(K, a + 1)`` constants of the points that do not move; of no columns where not all positions are theirs."""
    change = (lifts - lifts.mean(0)).flatten(0, 1)
    _, values, vh = torch.linalg.svd(change, full_matrices=True)
    still = vh[int((values > REST * lifts.norm()).sum()) :].mT
    return still if still.shape[-1] >= lifts.shape[-2] else still[:, :0]


def resting(tracks: Tracks, sensor: int, dim: int) -> Tensor:
    """The cameras ``(b, views, l + 1, dim + 1)`` that explain tracks best if no point moves, points finite and of unit variance.

    Where motion is slow against the extent of the scene they are near the truth, whatever the motion model.

    Args:
        tracks: flat batch.
        sensor: dimension l of the views.
        dim: dimension of the world.
    """
    eye = torch.eye(dim + 1, dtype=tracks.x.dtype, device=tracks.x.device)
    views = tracks.x.shape[1]
    still = Motion(lambda time: torch.eye(dim + 1, dtype=torch.float64), sensor=sensor, static=True)
    invariant = still.tensor(min(views, VIEWS if dim + 1 > sensor + 1 else 2))
    found = projections_of_tracks(tracks, invariant, choices(tracks, len(invariant.profile))[:, :1])
    lifts = eye.expand(views, -1, -1)
    known = (found.structure != 0).any(-1).to(tracks.x.dtype)
    G, cameras, structure = finite(found.projections, found.structure, lifts, gauge_algebra(lifts), tracks.weights)
    cameras, structure = moved(G, cameras, structure, lifts)
    cameras, _ = moved(centred(structure, lifts, known), cameras, structure, lifts)
    return cameras


def tilted(cameras: Tensor, number: int) -> Tensor:
    """Cameras of the resting scene in one of many frames: the first as nearly affine as it can be, the others with the infinite
    tilted."""
    size = cameras.shape[-1]
    frame = torch.eye(size, dtype=torch.float64)
    if number:
        frame[-1, :-1] = TILT * torch.randn(size - 1, generator=torch.Generator().manual_seed(number), dtype=torch.float64)
    return cameras @ frame.to(cameras)
