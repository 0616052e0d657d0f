"""Positions that are elsewhere for a frame or a few: found by the track's own neighbouring frames."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import conv1d, pad

from dyntorch.tasks.sync_tracks import Tracks, without

OUTLYING = 4.0
"""Robust standard deviations from the median of the neighbouring frames beyond which a position is an outlier (Hampel's 3 takes
more good positions at turns of the motion)."""
NEIGHBOURS = 3
"""Frames on each side that an outlier is judged by."""
WIDTH = 1.5
"""Frames, standard deviation of the line's kernel in the second pass."""
PEELED = 6.0
"""Robust standard deviations from that line."""
ALONE = 2.0
"""Times the residual of the neighbours: a sudden movement bends several frames alike, a wrong position its own most."""
FINE = 1e-3
"""Of the distance of the points from their mean: a deviation below it is none, whatever the spread; points at rest have no
spread."""
ROUNDS = 8


def cleaned(tracks: Tracks) -> Tracks:
    r"""Without positions far from the median of their neighbours, then, one by one, without those far from a line through the
    others.

    .. math:: |x_t - m_t| > \tau\, 1.4826\, \mathrm{med}_{|k| \le K} |x_{t+k} - m_t|,\quad m_t = \mathrm{med}_{|k| \le K}\, x_{t+k}

    The spread has floors, the track's own usual one and that of most tracks, without which a point at rest would lose good
    positions.  The median leaves
    5 of 100 outliers (of 15 mm of noise, 15 of 100 positions anywhere), often far away; the second pass leaves 2, near by.

    Source: Hampel 1974, The influence curve and its role in robust estimation.
    """
    if len(tracks.x) < 2 * NEIGHBOURS + 1:
        return tracks
    return _peeled(without(tracks, _far_from_median(tracks)))


def _far_from_median(tracks: Tracks) -> Tensor:
    seen = tracks.weights > 0
    x = torch.where(seen[..., None], tracks.x, torch.nan)
    ends = [x[:NEIGHBOURS].flip(0), x[-NEIGHBOURS:].flip(0)]
    window = torch.cat([ends[0], x, ends[1]]).unfold(0, 2 * NEIGHBOURS + 1, 1)  # (frames, n, 2, width)
    middle = window.nanmedian(-1).values
    far = (x - middle).abs()
    spread = 1.4826 * (window - middle[..., None]).abs().nanmedian(-1).values
    usual = 1.4826 * _usual(torch.where(seen[..., None], far, torch.nan))
    usual = torch.maximum(usual, usual.nanmedian(0).values).clamp(min=FINE * tracks.scale)
    return (far > OUTLYING * torch.maximum(spread, usual)).any(-1)


def _peeled(tracks: Tracks) -> Tracks:
    """The worst position of its neighbourhood goes first, then the line through what is left is fitted again."""
    kept = tracks.weights > 0
    for _ in range(ROUNDS):
        away = _from_line(tracks.x, kept)
        scale = 1.4826 * _usual(away)
        scale = scale.clamp(min=max(FINE * tracks.scale, float(scale.nanmedian().nan_to_num(0.0))))
        away = away.nan_to_num(0.0)
        rows = pad(away, (0, 0, 2, 2))
        near = torch.stack([rows[k : k + len(away)] for k in (0, 1, 3, 4)])
        bad = (away > PEELED * scale / 1.18) & (away > ALONE * near.median(0).values) & (away >= near.amax(0))
        if not bool(bad.any()):
            break
        kept = kept & ~bad
    return without(tracks, ~kept)


def _usual(far: Tensor) -> Tensor:
    """Medians over the frames; of what differs from 0 where most do not: points at rest, or rounded to whole pixels."""
    usual, rounding = far.nanmedian(0).values, 1e-9 * far.nan_to_num(0.0).amax()
    other = torch.where(far > rounding, far, torch.nan).nanmedian(0).values.nan_to_num(0.0)
    return torch.where(usual > rounding, usual, other)


def _from_line(x: Tensor, kept: Tensor) -> Tensor:
    """``(frames, n)`` distances from a line in time through the neighbouring frames but not the own one; NaN where there is
    none."""
    reach = int(3 * WIDTH)
    u = torch.arange(-reach, reach + 1, dtype=x.dtype, device=x.device) / WIDTH
    kernel = torch.exp(-0.5 * u.square())
    kernel[reach] = 0.0
    w = kept.to(x.dtype)
    s0, s1, s2 = (_correlated(w, kernel * u**power) for power in range(3))
    weighted = torch.where(kept[..., None], x, 0.0)
    t0, t1 = (_correlated(weighted.flatten(1), kernel * u**power).unflatten(1, x.shape[1:]) for power in range(2))
    determinant = s0 * s2 - s1.square()
    known = kept & (determinant > 0.1 * s0.square()) & (s0 > 0.3)
    line = (s2[..., None] * t0 - s1[..., None] * t1) / torch.where(known, determinant, 1.0)[..., None]
    return torch.where(known, (x - line).norm(dim=-1), torch.nan)


def _correlated(rows: Tensor, kernel: Tensor) -> Tensor:
    """``(frames, channels)`` with a kernel in time."""
    return conv1d(rows.mT[:, None], kernel[None, None], padding=len(kernel) // 2)[:, 0].mT
