"""Which track of one camera is which of the other, once both are transferred into one frame."""

from __future__ import annotations

import torch
from torch import Tensor

AMBIGUOUS = 0.5
"""Of the distance to the second nearest track, above which the nearest one is not taken."""
SAME, NEAR = 4.0, 12.0
"""Times the residual that one point seen twice may differ along the coordinate that both cameras see, and in all: transfer
amplifies noise three to five times."""
SMALL, CLOSE = 0.005, 0.03
"""The same, as shares of the extent of the points: mean places are known less well than motions."""


def match_tracks(points: Tensor, n: int, residual: float) -> tuple[Tensor, Tensor]:
    """Mutually nearest tracks that no other comes near to.

    Args:
        points: ``(frames, n + m, 3)``, the first coordinate seen by both cameras; NaN for points that were not found.
        n: tracks of the first camera.
        residual: rms difference of the first coordinate.

    Returns:
        ``(m,)`` the track of the first camera, -1 = none, and rms distances ``(n, m)``.

    Example:
        >>> import torch
        >>> walk = torch.randn(50, 4, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        >>> match_tracks(torch.cat([walk, walk[:, [2, 0]]], dim=1), 4, 0.01)[0].tolist()
        [2, 0]
    """
    first, second = points[:, :n], points[:, n:]
    # track by track: all pairs of a long take at once do not fit into memory
    squares = [(first - track[:, None]).square().mean(0) for track in second.unbind(1)]
    apart = torch.stack(squares, dim=1) if squares else points.new_zeros(n, 0, 3)
    distances, along = apart.sum(-1).sqrt(), apart[..., 0].sqrt()
    none = torch.full((points.shape[1] - n,), -1, dtype=torch.long, device=points.device)
    known = distances.isfinite()
    if not bool(known.any()):
        return none, distances
    place = points.nanmean(0)
    extent = float((place - place.nanmean(0)).square().sum(-1).nanmean().sqrt())
    ranked = torch.where(known, distances, torch.inf)
    best, track = ranked.min(0)
    nearest = ranked.argmin(1)
    mutual = nearest[track] == torch.arange(len(track), device=points.device)
    other = ranked.clone()
    other[track, torch.arange(len(track), device=points.device)] = torch.inf
    second_best = torch.minimum(other.amin(0), other[track].amin(1))
    same = along.nan_to_num(nan=torch.inf).gather(0, track[None])[0] <= max(SAME * residual, SMALL * extent)
    near = best <= max(NEAR * residual, CLOSE * extent)
    return torch.where(mutual & same & near & (best <= AMBIGUOUS * second_best), track, none), distances
