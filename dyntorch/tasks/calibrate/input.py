"""What is given to calibrate(): checked, and put into pixels of ideal cameras where lenses are known."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dyntorch.core.outcome import Status
from dyntorch.geometry.lens import undistort_points
from dyntorch.numerics.arguments import FARTHEST
from dyntorch.tasks.synchronize.epipolar import Grid
from dyntorch.tasks.synchronize.result import Clocks
from dyntorch.tasks.synchronize.tracks import Tracks, read_tracks, reject_outliers

MAX_QUANTILE_POSITIONS = 1_000_000
"""Positions that say where points lie: torch takes quantiles of 16 million numbers at most."""


@dataclass(frozen=True)
class Rig:
    """Cameras as given."""

    x: list[Tensor]  # per camera ``(frames, n, 2)`` px, without the distortion of lenses that are known
    tracks: list[Tracks]  # the same, checked and cleaned, on their own clocks
    fps: tuple[float, ...]  # frames per second
    sizes: Tensor  # ``(c, 2)`` px
    centers: Tensor  # ``(c, 2)`` px, principal points
    focals: Tensor  # ``(c,)`` px, NaN = unknown
    lenses: list[tuple[Tensor, Tensor] | None]  # per camera K and distortion, or None
    one_lens: bool  # whether focal length and distortion are the same in all
    scale: Scale  # metres that fix the scale, see :class:`Scale`

    @property
    def known_lens(self) -> Tensor:
        """``(c,)`` bool: lenses whose distortion was taken out."""
        return torch.tensor([lens is not None for lens in self.lenses])


@dataclass(frozen=True)
class Scale:
    """What is known of lengths: the standing extent of the tallest body, distances between points; both None = nothing."""

    height: float | None = None
    lengths: Mapping[tuple[int, int], float] | None = None


MAX_CAMERAS = 8  # the graph of their pairs is complete


def read_rig(
    tracks: Sequence[Tensor],
    fps: float | Sequence[float],
    times: Sequence[Tensor | None] | None,
    sizes: Any,
    focal: Any,
    calibration: Sequence[Any] | None,
    weights: Sequence[Tensor] | None,
    one_lens: bool,
    scale: Scale,
) -> Rig:
    """The cameras of checked input."""
    c = len(tracks)
    if not 2 <= c <= MAX_CAMERAS:
        raise ValueError(f"tracks: {c} cameras given; give 2 to {MAX_CAMERAS}")
    points = {x.shape[1] for x in tracks if isinstance(x, Tensor) and x.ndim == 3}
    if len(points) > 1:
        raise ValueError(f"tracks: cameras have {sorted(points)} points; give the same points of every camera, NaN where missing")
    _refuse_twins(tracks)
    rates = _per_camera("fps", fps, c)
    if any(rate is None for rate in rates):
        raise ValueError(f"fps: give frames per second of every camera, got {fps}")
    size = _sizes(sizes, c)
    lenses = _lenses(calibration, c)
    focals = _per_camera("focal", focal, c)
    for i, (value, lens) in enumerate(zip(focals, lenses, strict=True)):
        if value is not None and lens is not None:
            raise ValueError(f"focal of camera {i} is given twice, also by calibration; give one of them")
    straight, found = [], []
    for i in range(c):
        try:
            x, lens = tracks[i].detach().double() if isinstance(tracks[i], Tensor) else tracks[i], lenses[i]
            own = None if times is None else times[i]
            given = None if weights is None else weights[i]
            read = read_tracks(f"tracks[{i}]", x, None if own is not None else rates[i], own, given)
            _check_inside(x, size[i])
            straight.append(x if lens is None else _ideal(undistort_points(x, lens), lens[0]))
            if lens is not None:
                own = read.times if own is None else own
                read = read_tracks(f"tracks[{i}]", straight[-1], None, own, given)
            found.append(reject_outliers(read))
        except ValueError as error:
            raise ValueError(f"camera {i}: {error}") from error
    centers = torch.stack([size[i] / 2 if lens is None else lens[0][:2, 2] for i, lens in enumerate(lenses)])
    known = [math.nan if value is None else value for value in focals]
    known = [value if lens is None else float(lens[0][0, 0]) for value, lens in zip(known, lenses, strict=True)]
    _check_scale(scale, points.pop())
    every = tuple(1 / track.step for track in found) if times is not None else tuple(float(rate or 0.0) for rate in rates)
    return Rig(straight, found, every, size, centers, torch.tensor(known, dtype=torch.float64), lenses, one_lens, scale)


def read_clocks(clocks: Any, cameras: int) -> Tensor:
    """``(c, 2)`` offsets and rates of clocks that are given."""
    if isinstance(clocks, Clocks):
        values = torch.stack([clocks.offsets, clocks.rates], dim=-1).double()
    else:
        values = torch.as_tensor(clocks, dtype=torch.float64)
        values = torch.stack([values, torch.ones_like(values)], dim=-1) if values.ndim == 1 else values
    if values.shape != (cameras, 2) or not bool(values.isfinite().all()) or bool((values[:, 1] <= 0).any()):
        raise ValueError(
            f"clocks: give {cameras} offsets in seconds, ({cameras}, 2) offsets and rates, or what synchronize_cameras returns, "
            f"got {tuple(values.shape)} {values.tolist() if values.numel() < 20 else ''}"
        )
    return values


def clocks_as_given(clocks: Any, values: Tensor, center: float) -> Clocks:
    """Clocks that are taken as given."""
    if isinstance(clocks, Clocks):
        return clocks
    still = torch.zeros(len(values), dtype=torch.float64)
    return Clocks(
        offsets=values[:, 0], rates=values[:, 1], sigmas=still, rate_sigmas=still, confidence=1.0, pairs=(), cycle_error=math.nan,
        worst_cycle=None, outliers=[], reference=0, center=center, shifts={}, status=torch.tensor(int(Status.OK)),
    )  # fmt: skip


def _per_camera(name: str, value: Any, cameras: int) -> list[float | None]:
    """A number for each camera, from one for all or one each."""
    if value is None or isinstance(value, (int, float)):
        values = [value] * cameras
    else:
        values = value.tolist() if isinstance(value, Tensor) else list(value)
    if len(values) != cameras:
        raise ValueError(f"{name}: {len(values)} values for {cameras} cameras; give one, or one per camera")
    for i, one in enumerate(values):
        if one is not None and not (isinstance(one, (int, float)) and 0 < one < math.inf):
            raise ValueError(f"{name} of camera {i} must be a positive number, got {one}")
    return values


def _sizes(sizes: Any, cameras: int) -> Tensor:
    """``(c, 2)``."""
    try:
        size = torch.as_tensor(sizes, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError):
        size = torch.zeros(0)
    size = size.expand(cameras, 2) if size.shape == (2,) else size
    if size.shape != (cameras, 2) or not bool((size.isfinite() & (size > 0)).all()):
        raise ValueError(f"sizes must be the width and height of the pictures in px, of all cameras or of each, got {sizes}")
    return size


def _lenses(calibration: Sequence[Any] | None, cameras: int) -> list[tuple[Tensor, Tensor] | None]:
    """K and distortion ``(5,)`` or ``(8,)`` of each camera, or None."""
    if calibration is None:
        return [None] * cameras
    if len(calibration) != cameras:
        raise ValueError(f"calibration: {len(calibration)} values for {cameras} cameras; give (K, dist) or None per camera")
    found: list[tuple[Tensor, Tensor] | None] = []
    for i, lens in enumerate(calibration):
        if lens is None:
            found.append(None)
            continue
        try:
            undistort_points(torch.zeros(1, 2, dtype=torch.float64), lens)
        except ValueError as error:
            raise ValueError(f"camera {i}: {error}") from error
        dist = torch.zeros(5) if lens[1] is None else torch.as_tensor(lens[1])
        dist = dist.double().flatten()
        padded = torch.nn.functional.pad(dist, (0, max(0, 5 - len(dist))))
        found.append((torch.as_tensor(lens[0]).double(), padded))
    return found


def _ideal(x: Tensor, K: Tensor) -> Tensor:
    """Pixels of a camera with square pixels and no skew, of the same f_x and principal point."""
    change = torch.eye(3, dtype=torch.float64) * torch.stack([K[0, 0], K[0, 0], torch.ones_like(K[0, 0])])
    change[:2, 2] = K[:2, 2]
    change = change @ torch.linalg.inv(K)
    return x @ change[:2, :2].mT + change[:2, 2]


MAX_OUTSIDE = 0.5  # share of the picture by which positions may lie outside of it
MAX_SHARE_COORDINATE = 2.0  # largest coordinate up to which positions are shares of the picture and no pixels
MAX_OUTSIDE_SHARE = 0.05  # of the positions that lie farther out


def _check_inside(x: Tensor, size: Tensor) -> None:
    """Raise where positions and the size of the picture do not belong together."""
    seen = x[(x.abs() <= FARTHEST).all(-1)]
    if not len(seen):
        raise ValueError("no point is seen; check the detections")
    far = ((seen < -MAX_OUTSIDE * size) | (seen > (1 + MAX_OUTSIDE) * size)).any(-1).double().mean()
    if float(far) > MAX_OUTSIDE_SHARE:
        some = seen[:: max(1, len(seen) // MAX_QUANTILE_POSITIONS)]
        low, high = (some.quantile(q, dim=0).round().int().tolist() for q in (0.02, 0.98))
        width, height = size.int().tolist()
        raise ValueError(
            f"sizes say {width}x{height} px, but points lie from {low} to {high}: give the size of the pictures that they were "
            "found in"
        )
    if float(seen.max()) <= MAX_SHARE_COORDINATE:
        raise ValueError("points lie between 0 and 1, as shares of the picture: multiply them by its size in px")


def _refuse_twins(tracks: Sequence[Tensor]) -> None:
    for (j, other), (i, one) in combinations(enumerate(tracks), 2):
        alike = isinstance(one, Tensor) and isinstance(other, Tensor) and one.shape == other.shape
        if alike and len(one) and bool(one.isfinite().any()) and torch.equal(one.nan_to_num(-1.0), other.nan_to_num(-1.0)):
            raise ValueError(f"tracks: cameras {j} and {i} are the same recording; give every camera once")


def _check_scale(scale: Scale, points: int) -> None:
    if scale.height is not None and not 0 < scale.height < math.inf:
        raise ValueError(f"height must be a positive number of metres, got {scale.height}")
    for ends, length in (scale.lengths or {}).items():
        if len(set(ends)) != 2 or not all(isinstance(end, int) and 0 <= end < points for end in ends):
            raise ValueError(f"lengths: {ends} are not two different points out of 0..{points - 1}")
        if not 0 < length < math.inf:
            raise ValueError(f"lengths: the distance of points {ends} must be a positive number of metres, got {length}")
    if scale.height is not None and scale.lengths:
        raise ValueError("height and lengths both fix the scale; give one of them")


# ----------------------------------------------------------------------------------------------------------------------
# What the cameras saw, at common moments: tracks smoothed by the same kernel, read at any time of any clock.


class Sightings(NamedTuple):
    """Positions at common moments."""

    x: Tensor
    """``(b, c, T, n, 2)`` px, 0 where not seen."""
    v: Tensor
    """``(b, c, T, n, 2)`` px per second."""
    weights: Tensor
    """``(b, c, T, n)``, 0 where not seen."""


@dataclass(frozen=True)
class RigViews:
    """The tracks of c cameras, ready to be read at T moments of the reference clock."""

    grids: tuple[Grid, ...]  # of each camera
    centers: Tensor  # ``(c, 2)`` px, the principal points
    middle: float  # the moment in the middle, seconds of the reference clock
    times: Tensor  # ``(T,)`` seconds from the middle
    frames: Tensor  # ``(c,)`` seconds from one frame to the next
    noise: Tensor  # ``(c,)`` of the tracks, over its geometric mean

    def at(self, clocks: Tensor, shift: float = 0.0) -> Sightings:
        """What is seen with clocks ``(b, c, 2)``: against the reference clock at the middle, and the logarithm of the rate."""
        shape = (len(clocks), len(self.times), self.grids[0].x.shape[1])
        parts = []
        for i, grid in enumerate(self.grids):
            own = clocks[:, i, 1:].exp() * self.times + clocks[:, i, :1] + (self.middle + shift * float(self.frames[i]))
            x, v, w = grid.at(own.flatten())
            parts.append((x.view(*shape, 2), v.view(*shape, 2), w.view(shape)))
        return Sightings(*(torch.stack(part, dim=1) for part in zip(*parts, strict=True)))

    def steady_weights(self, clocks: Tensor) -> Tensor:
        """Weights ``(b, c, T, n)`` of positions that two cameras see, and a frame before and after, too: clocks may move so far."""
        now, before, after = (self.at(clocks, shift).weights for shift in (0.0, -1.0, 1.0))
        steady = torch.where((before > 0) & (after > 0), now, 0.0)
        return steady * ((steady > 0).sum(1, keepdim=True) >= 2)

    def thin(self, count: int) -> RigViews:
        """About ``count`` of the moments, evenly spread."""
        return replace(self, times=self.times[:: max(1, len(self.times) // count)])

    def between(self, start: float, end: float) -> RigViews:
        """The moments from ``start`` on and before ``end``, seconds from the middle."""
        return replace(self, times=self.times[(self.times >= start) & (self.times < end)])


KERNEL_FRAMES = 1.0  # standard deviation of the smoothing: below 1 clocks are drawn to half frames
MAX_NOISE_RATIO = 2.0  # noise of a camera over the geometric mean of all, and its inverse
MIN_NOISE = 0.05  # px: exact data have no scale


def common_views(tracks: Sequence[Tracks], centers: Tensor, clocks: Tensor) -> RigViews:
    """Views at the moments at which two cameras at least run, a frame of the slowest camera apart. centers ``(c, 2)``, clocks
    ``(c, 2)``."""
    runs = [((float(t.times[0]) - o) / r, (float(t.times[-1]) - o) / r) for t, (o, r) in zip(tracks, clocks.tolist(), strict=True)]
    start, end = sorted(run[0] for run in runs)[1], sorted(run[1] for run in runs)[-2]
    step = max(t.step / r for t, (_, r) in zip(tracks, clocks.tolist(), strict=True))
    # the second start and the last end but one may lie in a gap, or in one camera's run alone
    if not any(max(a[0], b[0]) + step < min(a[1], b[1]) for a, b in combinations(runs, 2)):
        spans = ", ".join(f"camera {i} {a:.3g} to {b:.3g} s" for i, (a, b) in enumerate(runs))
        raise ValueError(
            f"tracks: no two cameras run at the same time ({spans} of the reference clock): check clocks, fps and times"
        )
    middle = 0.5 * (start + end)
    times = start - middle + step * torch.arange(math.floor((end - start) / step + 1e-9) + 1, dtype=torch.float64)
    grids = tuple(Grid.of(t, KERNEL_FRAMES * step * r) for t, (_, r) in zip(tracks, clocks.tolist(), strict=True))
    frames, noise = torch.tensor([[t.step, t.noise] for t in tracks], dtype=torch.float64).unbind(-1)
    most = math.log(MAX_NOISE_RATIO)
    noise = noise.clamp(min=MIN_NOISE).log()
    noise = (noise - noise.mean()).clamp(-most, most).exp()
    return RigViews(grids, centers, middle, times, frames, noise)
