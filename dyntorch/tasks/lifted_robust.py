"""Reconstruction from tracks of which some are wrong."""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.invariants.grassmann_tensor import GrassmannTensor
from dyntorch.tasks.lifted_projections import Projections, Tracks, projections_of_tracks
from dyntorch.tasks.lifted_scene import Lifting

SMEARED = 1.5
"""Noise by the mean square over noise by the median above which some tracks do not belong to the model."""
FAR = 2.0
"""Residual over the threshold above which an observation is wrong."""


def suspicious(tracks: Tracks, apart: Tensor, k: int, limit: float | None) -> Tensor:
    """Which problems ``(b,)`` show outliers after least squares.

    Args:
        tracks: flat batch.
        apart: ``(b, views, n)`` reprojection distances, NaN = missing.
        k: dimension of the space of the points.
        limit: three standard deviations of the noise, None: judged by the residuals alone.
    """
    if limit is not None:
        return (apart.nan_to_num() > FAR * limit).flatten(1).any(-1)
    seen = apart.isfinite().sum(1)
    square = apart.square().nansum(1) / (seen * tracks.x.shape[-1] - k).clamp(min=1)
    square = torch.where(seen * tracks.x.shape[-1] > k, square, torch.nan)
    middle, mean = square.nanmedian(-1).values, square.nanmean(-1)
    extent = 1 / tracks.scales.amin(1)
    return (mean.sqrt() > SMEARED * middle.sqrt()) & (mean.sqrt() > 1e-9 * extent)


def robust_projections(
    tracks: Tracks, invariant: GrassmannTensor, lifting: Lifting | None, limit: float | None, generator: torch.Generator | None
) -> tuple[Projections, Tracks]:
    """Projections from the tracks that agree, and the tracks with weight 0 for all other observations."""
    return projections_of_tracks(tracks, invariant), tracks
