"""Tracks about the middle of each frame, in units of how large they are there: what affine cameras would have seen."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from dyntorch.tasks.sync_tracks import Tracks

SLOW = 0.5
"""Seconds: how slowly the distance of a person changes."""


def frame_scaled(tracks: Tracks) -> Tracks:
    r"""Tracks with the strongest effects of perspective taken out.

    .. math:: y_{ij} = \frac{x_{ij} - c_i}{\bar r_i}, \qquad c_i = \operatorname{med}_j x_{ij}, \quad r_i =
    \operatorname{med}_j |x_{ij} - c_i|,

    with the size smoothed over half a second, and its mean over the take restored.  Medians, which single wrong points do not move.

    Source: Wolf and Zomet 2002 for affine cameras; Zelnik-Manor and Irani 2003.
    """
    seen = tracks.weights > 0
    shown = torch.where(seen[..., None], tracks.x, torch.nan)
    middle = shown.nanmedian(1).values  # (frames, 2)
    away = shown - middle[:, None]
    size = away.norm(dim=-1).nanmedian(1).values
    slow = _slow(size, tracks.times)
    level = slow[slow > 0].median() if bool((slow > 0).any()) else slow.new_ones(())
    scaled = away / torch.where(slow > 0, slow / level, 1.0)[:, None, None]
    return dataclasses.replace(tracks, x=torch.where(seen[..., None], scaled, 0.0))


def _slow(size: Tensor, times: Tensor) -> Tensor:
    """Gaussian means over time of what is known."""
    known = size.isfinite()
    reach = max(1, int(3 * SLOW / float(times.diff().median())) if len(times) > 1 else 1)
    values = torch.where(known, size, 0.0)
    offsets = torch.arange(-reach, reach + 1, dtype=torch.float64, device=size.device)
    step = float(times.diff().median()) if len(times) > 1 else 1.0
    kernel = torch.exp(-0.5 * (offsets * step / SLOW).square())[None, None]
    total, share = (torch.nn.functional.conv1d(row[None, None], kernel, padding=reach)[0, 0] for row in (values, known.double()))
    return torch.where(share > 1e-9, total / share.clamp(min=1e-9), 0.0)
