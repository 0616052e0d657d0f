"""Tracks of two cameras at the frame times of one of them, and what of them is motion: every frequency, every combination."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.fft import dct, idct
from torch import Tensor

from dyntorch.tasks.synchronize.result import Shift
from dyntorch.tasks.synchronize.tracks import Tracks, read_tracks

MAX_RESIDUAL_SIGMAS = 2.6  # of a coordinate, up to which a position agrees where no threshold is given


@dataclass(frozen=True)
class Overlap:
    """What both cameras saw in the frames of a within the overlap, NaN = missing."""

    a: Tensor  # ``(frames, n, 2)`` float64
    b: Tensor  # ``(frames, m, 2)`` float64, at the same moments
    times: Tensor  # ``(frames,)`` of a's clock
    noise: tuple[float, float]  # pixels, of a coordinate of a and of b, as third differences show it


OVERLAP_ROUNDING = 1e-6  # share of a frame by which a moment may be outside of the overlap


def overlap(
    a: Tensor, b: Tensor, shift: Shift | float, *, fps: float | Sequence[float] | None = None, times: Sequence[Any] | None = None
) -> Overlap:
    """Both cameras at a's frame times. a ``(frames, n, 2)``, b ``(frames, m, 2)``."""
    rates, clocks = _clocks(shift, fps, times)
    tracks = [read_tracks(name, x, rate, clock, None) for name, x, rate, clock in zip("ab", (a, b), rates, clocks, strict=True)]
    if a.device != b.device:
        raise ValueError(f"a and b must be on one device, got {a.device} and {b.device}; use b.to(a.device)")
    first, second = tracks
    wanted = shift.at(first.times) if isinstance(shift, Shift) else first.times + shift
    if not len(second.times):
        return Overlap(_with_gaps(first)[:0], _with_gaps(second), first.times[:0], (first.noise, second.noise))
    start, end = second.times[0], second.times[-1]
    # rounding moves no frame out of the overlap
    inside = (
        (wanted - wanted.clamp(start, end)).abs() <= OVERLAP_ROUNDING * second.step if len(second.times) > 1 else wanted == start
    )
    wanted = wanted.clamp(start, end)
    return Overlap(
        _with_gaps(first)[inside],
        interpolate(_with_gaps(second), second.times, wanted[inside]),
        first.times[inside],
        (first.noise, second.noise),
    )


def _clocks(
    shift: Shift | float, fps: float | Sequence[float] | None, times: Sequence[Any] | None
) -> tuple[tuple[float | None, float | None], tuple[Tensor | None, Tensor | None]]:
    if not isinstance(shift, Shift | float | int) or isinstance(shift, bool):
        raise ValueError(f"shift must be a Shift or an offset in seconds, got {shift!r}; use dyntorch.synchronize(a, b, ...)")
    if isinstance(shift, float | int) and not -1e12 < shift < 1e12:
        raise ValueError(f"shift must be finite seconds, got {shift}")
    if times is not None:
        if fps is not None or len(times) != 2:
            raise ValueError(f"give either fps or times=(times of a, times of b), got fps={fps} and {len(times)} times")
        return (None, None), (times[0], times[1])
    if fps is None:
        if not isinstance(shift, Shift):
            raise ValueError("an offset in seconds needs fps= or times=; or give the Shift of dyntorch.synchronize")
        fps = shift.fps
    pair = (fps, fps) if isinstance(fps, float | int) else tuple(fps)
    if len(pair) != 2:
        raise ValueError(f"fps must be one number or two, of a and of b, got {fps}")
    return (float(pair[0]), float(pair[1])), (None, None)


def _with_gaps(tracks: Tracks) -> Tensor:
    return torch.where((tracks.weights > 0)[..., None], tracks.x, torch.nan)


# around a moment, as many as are seen: six lose less of fast motion than two, and smooth noise less
INTERPOLATION_FRAMES = (6, 4, 2)
MAX_GAP_FRAMES = 2.5  # between two frames that are interpolated


def interpolate(x: Tensor, times: Tensor, at: Tensor) -> Tensor:
    r"""Positions at any moments by Lagrange's polynomial through the frames around each: six where all are seen, else four or
    two. x ``(frames, n, 2)``, times ``(frames,)``, at ``(m,)`` -> ``(m, n, 2)``."""
    frames = len(times)
    result = torch.full((len(at), *x.shape[1:]), torch.nan, dtype=x.dtype, device=x.device)
    if not len(at) or not frames:
        return result
    after = torch.searchsorted(times, at.contiguous(), right=True).clamp(1, max(frames - 1, 1))
    step = times.diff().median() if frames > 1 else times.new_tensor(1.0)
    for order in reversed(INTERPOLATION_FRAMES):
        if frames < order:
            continue
        start = (after - order // 2).clamp(0, frames - order)
        index = start[:, None] + torch.arange(order, device=x.device)
        found = _lagrange(x, times, at, index, MAX_GAP_FRAMES * step)
        result = torch.where(found.isnan(), result, found)
    return result


def _lagrange(x: Tensor, times: Tensor, at: Tensor, index: Tensor, gap: Tensor) -> Tensor:
    t = times[index]
    apart = t[:, :, None] - t[:, None, :]
    eye = torch.eye(index.shape[1], dtype=torch.bool, device=x.device)
    share = torch.where(eye, 1.0, (at[:, None, None] - t[:, None, :]) / torch.where(eye, 1.0, apart))
    weights = share.prod(-1)
    # a frame that the moment falls on needs no neighbours
    needed = weights.abs() > 1e-9
    whole = (t.diff(dim=1) < gap).all(-1) | (needed.sum(-1) == 1)
    seen = torch.where(needed[:, :, None, None], x[index], 0.0)
    found = (weights[:, :, None, None] * seen).sum(1)
    return torch.where(whole[:, None, None] & (at >= times[0])[:, None, None] & (at <= times[-1])[:, None, None], found, torch.nan)


# ----------------------------------------------------------------------------------------------------------------------
# Which track of one camera is which of the other, once both are transferred into one frame.


MAX_DISTANCE_RATIO = 0.5  # to the second nearest track
MAX_ALONG_RATIO = 4.0  # of one point seen twice, along the coordinate that both cameras see, over the residual
MAX_APART_RATIO = 12.0  # in all: transfer amplifies noise three to five times
MAX_ALONG_EXTENT = 0.005  # over the extent of the points, where that is more: mean places are known less well
MAX_APART_EXTENT = 0.03  # over the extent of the points, where that is more


def match_tracks(points: Tensor, n: int, residual: float) -> tuple[Tensor, Tensor]:
    """Mutually nearest tracks that no other comes near to. points ``(frames, n + m, 3)`` -> ``(m,)``."""
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
    best, track = mutually_nearest(torch.where(known, distances, torch.inf))
    same = along.nan_to_num(nan=torch.inf).gather(0, track[None])[0] <= max(MAX_ALONG_RATIO * residual, MAX_ALONG_EXTENT * extent)
    near = best <= max(MAX_APART_RATIO * residual, MAX_APART_EXTENT * extent)
    return torch.where(same & near, track, none), distances


def mutually_nearest(distances: Tensor) -> tuple[Tensor, Tensor]:
    """Distance ``(m,)`` of every column ``(n, m)`` from its nearest row, infinite where that has another nearest column, or another
    pair of either comes near to it, and the row."""
    best, row = distances.min(0)
    column = torch.arange(len(row), device=row.device)
    other = distances.clone()
    other[row, column] = torch.inf
    sure = (distances.argmin(1)[row] == column) & (best <= MAX_DISTANCE_RATIO * torch.minimum(other.amin(0), other[row].amin(1)))
    return torch.where(sure, best, torch.inf), row


# ----------------------------------------------------------------------------------------------------------------------
# What tracks of one camera say of themselves: how much of every frequency and every combination of points is motion, not noise.


def cosines(x: Tensor) -> Tensor:
    """Orthonormal discrete cosine transform (type II) over the first dimension, without its constant."""
    return torch.from_numpy(dct(x.numpy(), axis=0, norm="ortho")[1:])


def inverse_cosines(z: Tensor) -> Tensor:
    """The inverse of :func:`cosines`: ``(T - 1, ...)`` to ``(T, ...)`` of mean 0."""
    return torch.from_numpy(idct(np.concatenate([np.zeros((1, *z.shape[1:])), z.numpy()]), axis=0, norm="ortho"))


MIN_POWER_RATIO = 1e-6  # of the motion of any frequency over the noise, and of the noise in gaps over the motion


def motion_spectrum(z: Tensor, variance: float) -> Tensor:
    """Power of the motion at each frequency, mean over points and coordinates, smoothed over an eighth of an octave,
    ``(T - 1,)``."""
    power = z.square().mean((1, 2))
    total = torch.cat([power.new_zeros(1), power.cumsum(0)])
    place = torch.arange(len(power), device=z.device)
    low, high = (place - 1 - place // 8).clamp(min=0), (place + 2 + place // 8).clamp(max=len(power))
    smooth = (total[high] - total[low]) / (high - low)
    return (smooth - variance).clamp(min=MIN_POWER_RATIO * variance + 1e-300)


EM_ITERATIONS = 20  # for the covariance of the points


@dataclass(frozen=True)
class Prior:
    """The motion of the points of one camera."""

    spectrum: Tensor  # ``(T - 1,)`` S
    energies: Tensor  # ``(n,)`` eigenvalues of B
    modes: Tensor  # ``(n, n)`` its eigenvectors, as columns
    variance: float  # of the noise

    @staticmethod
    def of(z: Tensor, variance: float) -> Prior:
        """Of ``(T - 1, n, 2)`` of :func:`cosines`, by expectation-maximization."""
        spectrum = motion_spectrum(z, variance)
        n = z.shape[1]
        found = Prior(spectrum, z.new_ones(n), torch.eye(n, dtype=z.dtype, device=z.device), variance)
        root = spectrum.sqrt()[:, None, None]
        for _ in range(EM_ITERATIONS):
            hidden = (found.denoise(z) / root).mT.flatten(0, 1)
            left = (found.energies * (1 - found.shares())).sum(0) * 2
            moment = (hidden.mT @ hidden + found.modes @ torch.diag(left) @ found.modes.mT) / (2 * len(z))
            energies, modes = torch.linalg.eigh(moment)
            found = Prior(spectrum, energies.clamp(min=1e-12), modes, variance)
        return found

    def shares(self) -> Tensor:
        """``(T - 1, n)``: how much of each frequency of each mode is motion."""
        power = self.spectrum[:, None] * self.energies
        return power / (power + self.variance)

    def denoise(self, z: Tensor) -> Tensor:
        """The expected motion given ``(T - 1, n, 2)`` (Wiener)."""
        shares = self.shares()[..., None]
        return self.modes @ ((self.modes.mT @ z) * shares)


FILL_ITERATIONS = 30  # each leaves about the share of the missing positions of the error


def fill_gaps(x: Tensor, variance: float) -> Tensor:
    r"""Tracks ``(T, n, 2)`` whose gaps (NaN) hold what the other points expect, and what these miss around the gap."""
    seen = x.isfinite().all(-1)
    if bool(seen.all()):
        return x
    found = torch.where(seen[..., None], x, _interpolate_linearly(x, seen))
    weights = seen.to(x)
    mean = found.mean(0)
    spread = (found - mean).mT.flatten(0, 1)
    B = spread.mT @ spread / len(spread)
    level = max(variance, MIN_POWER_RATIO * float(B.diagonal().mean()))
    for _ in range(FILL_ITERATIONS):
        shared = weights[:, :, None] * B * weights[:, None]
        # points that are missing have an equation of their own
        precision = torch.linalg.inv_ex(shared + torch.diag_embed(torch.where(seen, level, 1.0)))[0] * weights[:, None]
        offset = weights[..., None] * (found - mean)
        gain = B @ (weights[:, :, None] * precision)
        expected = gain @ offset
        found = torch.where(seen[..., None], x, expected + mean)
        left = torch.where(seen[..., None], offset, expected).mT.flatten(0, 1)
        unsure = (B - gain @ (weights[:, :, None] * B)) * (1 - weights)[:, :, None] * (1 - weights)[:, None]
        B, mean = (left.mT @ left + 2 * unsure.sum(0)) / len(left), found.mean(0)
    # what the others would have missed, had they to say where the point is
    beside = (precision @ offset) / torch.where(seen, precision.diagonal(dim1=-2, dim2=-1), 1.0)[..., None]
    return torch.where(seen[..., None], x, found + _interpolate_linearly(torch.where(seen[..., None], beside, torch.nan), seen))


def _interpolate_linearly(x: Tensor, seen: Tensor) -> Tensor:
    """Gaps bridged by straight lines, the ends by the nearest position; 0 for points never seen."""
    frames = len(x)
    place = torch.arange(frames, device=x.device)[:, None].expand_as(seen)
    before = torch.where(seen, place, -1).cummax(0).values
    after = torch.where(seen, place, frames).flip(0).cummin(0).values.flip(0)
    low, high = torch.where(before < 0, after, before), torch.where(after >= frames, before, after)
    known = x.nan_to_num()

    def at(index: Tensor) -> Tensor:
        return known.gather(0, index.clamp(0, frames - 1)[..., None].expand_as(x))

    share = ((place - low) / (high - low).clamp(min=1)).clamp(0, 1)[..., None]
    return at(low) * (1 - share) + at(high) * share
