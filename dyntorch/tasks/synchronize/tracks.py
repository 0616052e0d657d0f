"""Tracks of one camera on its own clock: checked, and smoothed to any moments."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor
from torch.nn.functional import conv1d, pad

from dyntorch.geometry.homogeneous import similarity
from dyntorch.numerics.arguments import FARTHEST
from dyntorch.numerics.messages import Message

MAX_FRAME_RATE_ERROR = 0.02  # Largest relative error of a given frame rate: clock rates are searched within it.
# Overlap from which a clock rate is estimated; in shorter ones 1 % is less than two frames at the ends.
MIN_SECONDS_FOR_RATE = 10.0
RATE_SIGNIFICANCE_SIGMAS = 3.0  # Deviation of a rate from 1, over its sigma, that is significant.
MAX_RATE_DEVIATION = 0.022  # Estimated rates that differ from 1 by more are rejected.


PIECE = 1 << 21
"""Numbers that one piece of a long take gathers at a time."""


@dataclass(frozen=True, eq=False)
class Tracks:
    """Points of one camera.

    Attributes:
        x: ``(frames, n, 2)`` float64, 0 where missing; of points in space ``(frames, n, 3)``.
        weights: ``(frames, n)``, 0 where missing.
        times: ``(frames,)`` seconds, increasing.
        step: seconds from one frame to the next, the median.
    """

    x: Tensor
    weights: Tensor
    times: Tensor
    step: float

    @cached_property
    def noise(self) -> float:
        r"""Standard deviation of a coordinate, from third differences :math:`\mathrm{med}|d_3| / (.6745 \sqrt{20})`: motion is
        smooth."""
        seen = self.weights > 0
        whole = seen[3:] & seen[2:-1] & seen[1:-2] & seen[:-3]
        rough = self.x.diff(n=3, dim=0)[whole].abs()
        return float(rough.median()) / (0.6745 * math.sqrt(20)) if rough.numel() else 0.0

    @cached_property
    def scale(self) -> float:
        """Root mean square distance of the points from their mean."""
        return float(self.centred_points.square().sum(-1).mul(self.weights).sum().div(self.weights.sum().clamp(min=1e-300)).sqrt())

    @cached_property
    def static(self) -> bool:
        """Whether no point moves by more than a millionth of how far points lie apart."""
        share = self.weights / self.weights.sum(0).clamp(min=1e-300)
        away = (self.x - (self.x * share[..., None]).sum(0)).square().sum(-1)
        return bool((torch.where(share > 0, away, 0.0).amax(0).sqrt() <= 1e-6 * self.scale).all())

    @cached_property
    def centred_points(self) -> Tensor:
        """Points about their mean over the take; 0 where missing."""
        share = (self.weights / self.weights.sum().clamp(min=1e-300))[..., None]
        return torch.where(share > 0, self.x - (self.x * share).sum((0, 1)), 0.0)

    @cached_property
    def change(self) -> Tensor:
        """``(3, 3)`` similarity to mean 0 and root mean square distance sqrt(2); of points in space ``(4, 4)``."""
        share = (self.weights / self.weights.sum().clamp(min=1e-300))[..., None]
        scale = math.sqrt(2) / self.scale if self.scale > 0 else 1.0
        return similarity(torch.as_tensor(scale, dtype=torch.float64, device=self.x.device), (self.x * share).sum((0, 1)))

    def every(self, step: float) -> Tensor:
        """Seconds from the first frame to the last, ``step`` apart."""
        start, end = float(self.times[0]), float(self.times[-1])
        return start + step * torch.arange(int((end - start) / step + 1e-6) + 1, dtype=torch.float64, device=self.x.device)

    def only(self, points: Tensor) -> Tracks:
        """These points ``(n,)`` bool alone."""
        return dataclasses.replace(self, x=self.x[:, points], weights=self.weights[:, points])


def read_tracks(name: str, x: Tensor, fps: float | None, times: Tensor | None, weights: Tensor | None) -> Tracks:
    """Tracks of checked input, of a camera or of points in space."""
    if not isinstance(x, Tensor) or x.ndim != 3 or x.shape[-1] not in (2, 3):
        got = tuple(x.shape) if isinstance(x, Tensor) else type(x).__name__
        text = "{camera:{which}} must be a tensor (frames, points, 2), got {got}; of motion capture (frames, points, 3)"
        raise ValueError(Message(text, which=name, got=got))
    if x.shape[1] == 0:
        raise ValueError(
            Message("{camera:{which}} has no points: shape {shape}; give (frames, points, 2)", which=name, shape=tuple(x.shape))
        )
    if not x.is_floating_point():
        raise ValueError(f"{name} must hold floating point numbers, got {x.dtype}; use {name}.double()")
    if times is None:
        if fps is None or not 0 < fps < math.inf:
            raise ValueError(
                Message(
                    "{arg:fps} of {camera:{which}} must be a positive number of frames per second, got {fps}; or give {arg:times=}",
                    which=name,
                    fps=fps,
                )
            )
        times = torch.arange(len(x), dtype=torch.float64, device=x.device) / fps
    x = x.detach()
    clock = torch.as_tensor(times, dtype=torch.float64, device=x.device)
    if clock.shape != x.shape[:1] or not bool(clock.isfinite().all()):
        raise ValueError(
            Message(
                "times of {camera:{which}} must be {count} finite seconds, one per frame, got {shape}",
                which=name,
                count=x.shape[0],
                shape=tuple(clock.shape),
            )
        )
    steps = clock.diff()
    if bool((steps <= 0).any()):
        at = int((steps <= 0).nonzero()[0, 0]) + 1
        raise ValueError(
            Message(
                "times of {camera:{which}} must increase, but frame {at} is not after the one before; sort or drop such frames",
                which=name,
                at=at,
            )
        )
    _check_dense(name, clock)
    seen = (x.double().abs() <= FARTHEST).all(-1)
    if weights is None:
        given = seen.double()
    else:
        given = torch.as_tensor(weights, dtype=torch.float64, device=x.device)
        if given.shape != seen.shape or not bool((given.isfinite() & (given >= 0)).all()):
            raise ValueError(f"weights of {name} must be {tuple(seen.shape)}, finite and not negative, got {tuple(given.shape)}")
        given = given * seen
    step = float(steps.median()) if len(steps) else math.nan
    return Tracks(torch.where((given > 0)[..., None], x.double(), 0.0), given, clock, step)


MAX_SPAN_PER_FRAME = 20  # A clock may run over so many times its frames: lags are searched frame by frame.
MAX_SPAN_STEPS = 20_000  # Steps that a clock may run over in any case.


def _check_dense(name: str, times: Tensor) -> None:
    """Raise where a take is nearly all gap."""
    steps = times.diff()
    if len(steps) == 0:
        return
    span, step = float(times[-1] - times[0]), float(steps.median())
    if span <= step * max(MAX_SPAN_PER_FRAME * len(times), MAX_SPAN_STEPS):
        return
    at = int(steps.argmax())
    raise ValueError(
        Message(
            "times of {camera:{which}} run over {span:.3g} s, but it has {count} frames {step:.3g} s apart, and none for "
            "{gap:.3g} s after {last:.6g} s; give the frames on one side of that gap",
            which=name,
            span=span,
            count=len(times),
            step=step,
            gap=float(steps[at]),
            last=float(times[at]),
        )
    )


def lag_range(
    frames: tuple[int, int], start: float, step: float, rate: float, max_shift: float | None, around: float = 0.0, *,
    at_least_one: bool = False,
) -> tuple[int, int]:  # fmt: skip
    """First and last lag, in steps, with some overlap, and shifts of b's clock within ``max_shift`` seconds of ``around``."""
    lo, hi = 1 - frames[0], frames[1] - 1
    if max_shift is None:
        return lo, hi
    low, high = (((around + sign * max_shift) / rate - start) / step for sign in (-1, 1))
    first, last = max(lo, math.ceil(low - 1e-9)), min(hi, math.floor(high + 1e-9))
    return (min(first, hi), max(last, min(first, hi))) if at_least_one else (first, last)


def remove_positions(tracks: Tracks, bad: Tensor) -> Tracks:
    """Tracks without some positions ``(frames, n)`` bool."""
    kept = torch.where(bad, 0.0, tracks.weights)
    return dataclasses.replace(tracks, x=torch.where((kept > 0)[..., None], tracks.x, 0.0), weights=kept)


def noise_ratio(a: Tracks, b: Tracks) -> float:
    """Noise of b over that of a, no farther from the ratio of their sizes than a factor of 2."""
    size = b.scale / a.scale if min(a.scale, b.scale) > 0 else 1.0
    noise = b.noise / a.noise if a.noise > 1e-6 * a.scale and b.noise > 1e-6 * b.scale else size
    return min(max(noise, size / 2), size * 2)


def image_of(a: Tracks, b: Tracks) -> Tracks:
    """Of a camera and points in space the camera; of two cameras the first."""
    return a if a.x.shape[-1] == 2 else b


KERNEL_SIGMAS = 4.0  # Half width of the smoothing kernel, standard deviations.


def smooth_at(tracks: Tracks, at: Tensor, width: float) -> tuple[Tensor, Tensor, Tensor]:
    r"""Positions and velocities at any moments, by a line fitted to the frames around each, with Gaussian weights. at ``(m,)``
    -> ``(m, n, 2)``."""
    taps = 2 * (math.ceil(KERNEL_SIGMAS * width / tracks.step) + 1) + 1
    rows = max(1, PIECE // max(1, taps * tracks.x[0].numel()))
    pieces = [_smooth_chunk(tracks, piece, width, taps // 2) for piece in at.split(rows)] or [
        _smooth_chunk(tracks, at, width, taps // 2)
    ]
    return tuple(torch.cat(parts) for parts in zip(*pieces, strict=True))  # type: ignore[return-value]


MIN_KERNEL_WEIGHT = 0.4  # Share of the kernel's weight that must be visible; less is a gap.


def _smooth_chunk(tracks: Tracks, at: Tensor, width: float, taps: int) -> tuple[Tensor, Tensor, Tensor]:
    frames = len(tracks.weights)
    near = torch.searchsorted(tracks.times, at.contiguous())[:, None] + torch.arange(-taps, taps + 1, device=at.device)
    index = near.clamp(0, frames - 1)
    u = (tracks.times[index] - at[:, None]) / width
    kernel = torch.exp(-0.5 * u.square()) * (near == index)  # (m, taps)
    w, x = tracks.weights[index], tracks.x[index].flatten(2)  # (m, taps, n), (m, taps, d n)
    powers = torch.stack([kernel, kernel * u, kernel * u * u], dim=1)  # (m, 3, taps)
    s0, s1, s2 = torch.bmm(powers, w).unbind(1)
    wx = (w[..., None] * x.unflatten(2, tracks.x.shape[1:])).flatten(2)
    t0, t1 = torch.bmm(powers[:, :2], wx).unflatten(2, tracks.x.shape[1:]).unbind(1)
    full = math.sqrt(2 * math.pi) * width / tracks.step
    determinant = s0 * s2 - s1.square()
    usual = torch.bmm(powers[:, :1], (w > 0).double())[:, 0]  # the kernel's weight on frames that show the point
    # two-sided: a line through frames on one side only would extrapolate
    seen = (usual > MIN_KERNEL_WEIGHT * full) & (determinant > 0.15 * s0.square())
    share = torch.where(seen, 1 / torch.where(seen, determinant, 1.0), 0.0)[..., None]
    position = (s2[..., None] * t0 - s1[..., None] * t1) * share
    velocity = (s0[..., None] * t1 - s1[..., None] * t0) * share / width
    # at the edges of gaps the line hangs on one side, and its noise is several times as large
    sure = (usual / full).clamp(max=1.0) * (determinant / s0.square().clamp(min=1e-300)).clamp(max=1.0)
    return position, velocity, torch.where(seen, sure * s0 / usual.clamp(min=1e-300), 0.0)


# ----------------------------------------------------------------------------------------------------------------------
# Positions that are elsewhere for a frame or a few: found by the track's own neighbouring frames.


HAMPEL_HALF_WIDTH = 3  # Frames on either side of that median.


def reject_outliers(tracks: Tracks) -> Tracks:
    r"""Without positions far from the median of their neighbours, then, one by one, without those far from a line through the
    others."""
    if len(tracks.x) < 2 * HAMPEL_HALF_WIDTH + 1:
        return tracks
    return _reject_from_line(remove_positions(tracks, _far_from_median(tracks)))


HAMPEL_SIGMAS = 4.0  # Robust sigmas from the running median beyond which a position is an outlier (3 rejects turning points).
MIN_RELATIVE_DEVIATION = 1e-3  # Floor of the robust scale over the RMS coordinate: keeps it above 0 for static points.


def _far_from_median(tracks: Tracks) -> Tensor:
    seen = tracks.weights > 0
    x = torch.where(seen[..., None], tracks.x, torch.nan)
    ends = [x[:HAMPEL_HALF_WIDTH].flip(0), x[-HAMPEL_HALF_WIDTH:].flip(0)]
    window = torch.cat([ends[0], x, ends[1]]).unfold(0, 2 * HAMPEL_HALF_WIDTH + 1, 1)  # (frames, n, 2, width)
    middle = window.nanmedian(-1).values
    far = (x - middle).abs()
    spread = 1.4826 * (window - middle[..., None]).abs().nanmedian(-1).values
    usual = 1.4826 * _usual_deviation(torch.where(seen[..., None], far, torch.nan))
    usual = torch.maximum(usual, usual.nanmedian(0).values).clamp(min=MIN_RELATIVE_DEVIATION * tracks.scale)
    return (far > HAMPEL_SIGMAS * torch.maximum(spread, usual)).any(-1)


LINE_OUTLIER_SIGMAS = 6.0  # Robust sigmas from the local line beyond which a position is an outlier.
MIN_RESIDUAL_RATIO = 2.0  # and its residual over those of the neighbouring frames: sudden movements bend several frames alike.
MAX_LINE_PASSES = 8  # Repetitions of the second pass.


def _reject_from_line(tracks: Tracks) -> Tracks:
    """The worst position of its neighbourhood goes first, then the line through what is left is fitted again."""
    kept = tracks.weights > 0
    for _ in range(MAX_LINE_PASSES):
        away = _from_line(tracks.x, kept)
        scale = 1.4826 * _usual_deviation(away)
        scale = scale.clamp(min=max(MIN_RELATIVE_DEVIATION * tracks.scale, float(scale.nanmedian().nan_to_num(0.0))))
        away = away.nan_to_num(0.0)
        rows = pad(away, (0, 0, 2, 2))
        near = torch.stack([rows[k : k + len(away)] for k in (0, 1, 3, 4)])
        bad = (
            (away > LINE_OUTLIER_SIGMAS * scale / 1.18)
            & (away > MIN_RESIDUAL_RATIO * near.median(0).values)
            & (away >= near.amax(0))
        )
        if not bool(bad.any()):
            break
        kept = kept & ~bad
    return remove_positions(tracks, ~kept)


def _usual_deviation(far: Tensor) -> Tensor:
    """Medians over the frames; of what differs from 0 where most do not: points at rest, or rounded to whole pixels."""
    usual, rounding = far.nanmedian(0).values, 1e-9 * far.nan_to_num(0.0).amax()
    other = torch.where(far > rounding, far, torch.nan).nanmedian(0).values.nan_to_num(0.0)
    return torch.where(usual > rounding, usual, other)


LINE_KERNEL_FRAMES = 1.5  # Standard deviation of the kernel of the local line in the second pass, frames.


def _from_line(x: Tensor, kept: Tensor) -> Tensor:
    """``(frames, n)`` distances from a line in time through the neighbouring frames but not the own one; NaN where there is
    none."""
    reach = int(3 * LINE_KERNEL_FRAMES)
    u = torch.arange(-reach, reach + 1, dtype=x.dtype, device=x.device) / LINE_KERNEL_FRAMES
    kernel = torch.exp(-0.5 * u.square())
    kernel[reach] = 0.0
    w = kept.to(x.dtype)
    s0, s1, s2 = (_correlate(w, kernel * u**power) for power in range(3))
    weighted = torch.where(kept[..., None], x, 0.0)
    t0, t1 = (_correlate(weighted.flatten(1), kernel * u**power).unflatten(1, x.shape[1:]) for power in range(2))
    determinant = s0 * s2 - s1.square()
    known = kept & (determinant > 0.1 * s0.square()) & (s0 > 0.3)
    line = (s2[..., None] * t0 - s1[..., None] * t1) / torch.where(known, determinant, 1.0)[..., None]
    return torch.where(known, (x - line).norm(dim=-1), torch.nan)


def _correlate(rows: Tensor, kernel: Tensor) -> Tensor:
    """``(frames, channels)`` with a kernel in time."""
    return conv1d(rows.mT[:, None], kernel[None, None], padding=len(kernel) // 2)[:, 0].mT


# ----------------------------------------------------------------------------------------------------------------------
# Tracks about the middle of each frame, in units of how large they are there: what affine cameras would have seen.


def scale_frames(tracks: Tracks) -> Tracks:
    r"""Tracks with the strongest effects of perspective taken out."""
    seen = tracks.weights > 0
    shown = torch.where(seen[..., None], tracks.x, torch.nan)
    middle = shown.nanmedian(1).values  # (frames, 2)
    away = shown - middle[:, None]
    size = away.norm(dim=-1).nanmedian(1).values
    slow = _smooth_size(size, tracks.times)
    level = slow[slow > 0].median() if bool((slow > 0).any()) else slow.new_ones(())
    scaled = away / torch.where(slow > 0, slow / level, 1.0)[:, None, None]
    return dataclasses.replace(tracks, x=torch.where(seen[..., None], scaled, 0.0))


SIZE_KERNEL_SECONDS = 0.5  # Standard deviation of the kernel for the size of a person in the image.


def _smooth_size(size: Tensor, times: Tensor) -> Tensor:
    """Gaussian means over time of what is known."""
    known = size.isfinite()
    reach = max(1, int(3 * SIZE_KERNEL_SECONDS / float(times.diff().median())) if len(times) > 1 else 1)
    values = torch.where(known, size, 0.0)
    offsets = torch.arange(-reach, reach + 1, dtype=torch.float64, device=size.device)
    step = float(times.diff().median()) if len(times) > 1 else 1.0
    kernel = torch.exp(-0.5 * (offsets * step / SIZE_KERNEL_SECONDS).square())[None, None]
    total, share = (torch.nn.functional.conv1d(row[None, None], kernel, padding=reach)[0, 0] for row in (values, known.double()))
    return torch.where(share > 1e-9, total / share.clamp(min=1e-9), 0.0)
