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
from dyntorch.tasks.synchronize.options import SynchronizeOptions

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
        return float(self.centred.square().sum(-1).mul(self.weights).sum().div(self.weights.sum().clamp(min=1e-300)).sqrt())

    @cached_property
    def still(self) -> bool:
        """Whether no point moves by more than a millionth of how far points lie apart."""
        share = self.weights / self.weights.sum(0).clamp(min=1e-300)
        away = (self.x - (self.x * share[..., None]).sum(0)).square().sum(-1)
        return bool((torch.where(share > 0, away, 0.0).amax(0).sqrt() <= 1e-6 * self.scale).all())

    @cached_property
    def centred(self) -> Tensor:
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


def read_tracks(
    name: str, x: Tensor, fps: float | None, times: Tensor | None, weights: Tensor | None, options: SynchronizeOptions
) -> Tracks:
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
    _check_dense(name, clock, options)
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


def _check_dense(name: str, times: Tensor, options: SynchronizeOptions) -> None:
    """Raise where a take is nearly all gap."""
    steps = times.diff()
    if len(steps) == 0:
        return
    span, step = float(times[-1] - times[0]), float(steps.median())
    if span <= step * max(options.input.longest_over_frames * len(times), options.input.longest_steps):
        return
    at = int(steps.argmax())
    raise ValueError(
        Message(
            "times of {camera:{which}} run over {span:.3g} s, but it has {count} frames {step:.3g} s apart, and none for "
            "{gap:.3g} s after "
            "{last:.6g} s; give the frames on one side of that gap",
            which=name,
            span=span,
            count=len(times),
            step=step,
            gap=float(steps[at]),
            last=float(times[at]),
        )
    )


def without(tracks: Tracks, bad: Tensor) -> Tracks:
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


def smoothed(tracks: Tracks, at: Tensor, width: float, options: SynchronizeOptions) -> tuple[Tensor, Tensor, Tensor]:
    r"""Positions and velocities at any moments, by a line fitted to the frames around each, with Gaussian weights. at ``(m,)``
    -> ``(m, n, 2)``."""
    taps = 2 * (math.ceil(options.cleaning.kernel_end * width / tracks.step) + 1) + 1
    rows = max(1, PIECE // max(1, taps * tracks.x[0].numel()))
    pieces = [_smoothed(tracks, piece, width, taps // 2, options) for piece in at.split(rows)] or [
        _smoothed(tracks, at, width, taps // 2, options)
    ]
    return tuple(torch.cat(parts) for parts in zip(*pieces, strict=True))  # type: ignore[return-value]


def _smoothed(tracks: Tracks, at: Tensor, width: float, taps: int, options: SynchronizeOptions) -> tuple[Tensor, Tensor, Tensor]:
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
    seen = (usual > options.cleaning.least_seen * full) & (determinant > 0.15 * s0.square())
    share = torch.where(seen, 1 / torch.where(seen, determinant, 1.0), 0.0)[..., None]
    position = (s2[..., None] * t0 - s1[..., None] * t1) * share
    velocity = (s0[..., None] * t1 - s1[..., None] * t0) * share / width
    # at the edges of gaps the line hangs on one side, and its noise is several times as large
    sure = (usual / full).clamp(max=1.0) * (determinant / s0.square().clamp(min=1e-300)).clamp(max=1.0)
    return position, velocity, torch.where(seen, sure * s0 / usual.clamp(min=1e-300), 0.0)


# ----------------------------------------------------------------------------------------------------------------------
# Positions that are elsewhere for a frame or a few: found by the track's own neighbouring frames.


def cleaned(tracks: Tracks, options: SynchronizeOptions) -> Tracks:
    r"""Without positions far from the median of their neighbours, then, one by one, without those far from a line through the
    others."""
    if len(tracks.x) < 2 * options.cleaning.neighbours + 1:
        return tracks
    return _peeled(without(tracks, _far_from_median(tracks, options)), options)


def _far_from_median(tracks: Tracks, options: SynchronizeOptions) -> Tensor:
    seen = tracks.weights > 0
    x = torch.where(seen[..., None], tracks.x, torch.nan)
    ends = [x[: options.cleaning.neighbours].flip(0), x[-options.cleaning.neighbours :].flip(0)]
    window = torch.cat([ends[0], x, ends[1]]).unfold(0, 2 * options.cleaning.neighbours + 1, 1)  # (frames, n, 2, width)
    middle = window.nanmedian(-1).values
    far = (x - middle).abs()
    spread = 1.4826 * (window - middle[..., None]).abs().nanmedian(-1).values
    usual = 1.4826 * _usual(torch.where(seen[..., None], far, torch.nan))
    usual = torch.maximum(usual, usual.nanmedian(0).values).clamp(min=options.cleaning.least_deviation * tracks.scale)
    return (far > options.cleaning.outlying * torch.maximum(spread, usual)).any(-1)


def _peeled(tracks: Tracks, options: SynchronizeOptions) -> Tracks:
    """The worst position of its neighbourhood goes first, then the line through what is left is fitted again."""
    kept = tracks.weights > 0
    for _ in range(options.cleaning.line_rounds):
        away = _from_line(tracks.x, kept, options)
        scale = 1.4826 * _usual(away)
        scale = scale.clamp(min=max(options.cleaning.least_deviation * tracks.scale, float(scale.nanmedian().nan_to_num(0.0))))
        away = away.nan_to_num(0.0)
        rows = pad(away, (0, 0, 2, 2))
        near = torch.stack([rows[k : k + len(away)] for k in (0, 1, 3, 4)])
        bad = (
            (away > options.cleaning.line_outlying * scale / 1.18)
            & (away > options.cleaning.over_neighbours * near.median(0).values)
            & (away >= near.amax(0))
        )
        if not bool(bad.any()):
            break
        kept = kept & ~bad
    return without(tracks, ~kept)


def _usual(far: Tensor) -> Tensor:
    """Medians over the frames; of what differs from 0 where most do not: points at rest, or rounded to whole pixels."""
    usual, rounding = far.nanmedian(0).values, 1e-9 * far.nan_to_num(0.0).amax()
    other = torch.where(far > rounding, far, torch.nan).nanmedian(0).values.nan_to_num(0.0)
    return torch.where(usual > rounding, usual, other)


def _from_line(x: Tensor, kept: Tensor, options: SynchronizeOptions) -> Tensor:
    """``(frames, n)`` distances from a line in time through the neighbouring frames but not the own one; NaN where there is
    none."""
    reach = int(3 * options.cleaning.line_width)
    u = torch.arange(-reach, reach + 1, dtype=x.dtype, device=x.device) / options.cleaning.line_width
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


# ----------------------------------------------------------------------------------------------------------------------
# Tracks about the middle of each frame, in units of how large they are there: what affine cameras would have seen.


def frame_scaled(tracks: Tracks, options: SynchronizeOptions) -> Tracks:
    r"""Tracks with the strongest effects of perspective taken out."""
    seen = tracks.weights > 0
    shown = torch.where(seen[..., None], tracks.x, torch.nan)
    middle = shown.nanmedian(1).values  # (frames, 2)
    away = shown - middle[:, None]
    size = away.norm(dim=-1).nanmedian(1).values
    slow = _slow(size, tracks.times, options)
    level = slow[slow > 0].median() if bool((slow > 0).any()) else slow.new_ones(())
    scaled = away / torch.where(slow > 0, slow / level, 1.0)[:, None, None]
    return dataclasses.replace(tracks, x=torch.where(seen[..., None], scaled, 0.0))


def _slow(size: Tensor, times: Tensor, options: SynchronizeOptions) -> Tensor:
    """Gaussian means over time of what is known."""
    known = size.isfinite()
    reach = max(1, int(3 * options.cleaning.distance_width / float(times.diff().median())) if len(times) > 1 else 1)
    values = torch.where(known, size, 0.0)
    offsets = torch.arange(-reach, reach + 1, dtype=torch.float64, device=size.device)
    step = float(times.diff().median()) if len(times) > 1 else 1.0
    kernel = torch.exp(-0.5 * (offsets * step / options.cleaning.distance_width).square())[None, None]
    total, share = (torch.nn.functional.conv1d(row[None, None], kernel, padding=reach)[0, 0] for row in (values, known.double()))
    return torch.where(share > 1e-9, total / share.clamp(min=1e-9), 0.0)
