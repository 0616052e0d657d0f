"""Clocks that break: frames that a camera lost or wrote twice without saying so, found as moments at which the offset jumps.

``breaks`` compares two cameras, piece by piece; ``camera_breaks`` asks all pairs which camera it was.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dyntorch.core.outcome import Notice, status_from
from dyntorch.numerics.arguments import check_options, on_cpu
from dyntorch.numerics.blocks import one_thread
from dyntorch.tasks.synchronize.piecewise_offset import Jump, JumpEvidence, PiecewiseOffset, repair_clocks
from dyntorch.tasks.synchronize.result import BreakNotice, Breaks, ClockBreak, Clocks, Shift, SynchronizeOptions
from dyntorch.tasks.synchronize.synchronize import prepare_tracks, synchronize
from dyntorch.tasks.synchronize.tracks import Tracks

# ----------------------------------------------------------------------------------------------------------------------
# Two cameras.


@one_thread
@on_cpu
def breaks(
    a: Tensor,
    b: Tensor,
    shift: Shift | None = None,
    *,
    fps: float | tuple[float, float] | None = None,
    times: tuple[Tensor, Tensor] | None = None,
    max_shift: float | None = None,
    calibration: tuple[Any, Any] | None = None,
    weights: tuple[Tensor | None, Tensor | None] | None = None,
    options: SynchronizeOptions | None = None,
) -> Breaks:
    r"""Where frames are missing, or twice, in one of two films of the same points whose frame numbers do not say so.

    .. math:: \min_{F, s(t)} \sum_{ij} \rho\!\left(\frac{d(x_{b,j}(t_i + s(t_i)),\, F x_{a,j}(t_i))^2}{\sigma_j^2}\right)
              + p\, \#\{\text{jumps of } s\}

    by dynamic programming over the lags at every moment, and least squares of F and the offset with what was lost put back, in
    turn.
    A jump counts where one offset on both sides of it costs many nats more, and where each side, if it is long enough, has the same
    best shift by itself.  Of two cameras nothing tells which one it was: a lost frame of one and a frame that the other wrote
    twice look the same.

    Args:
        a: ``(frames_a, n, 2)`` px, NaN = missing.  Point k of a is point k of b.
        b: ``(frames_b, n, 2)``.
        shift: what :func:`dyntorch.synchronize` said, ok or not; computed by default.
        fps: frames per second of both, or of each.
        times: instead, ``(frames,)`` seconds of each frame.
        max_shift: seconds; how far to search.
        calibration: per camera None or ``(K, dist)``.
        weights: per camera ``(frames, n)``, 0 = ignore.
        options: ``max_jump`` and those of :func:`dyntorch.synchronize`.

    Returns:
        The breaks with their evidence, mended times of both cameras, and the shift with these; refused where the data do not
        decide even piece by piece.

    Raises:
        ValueError: input of the wrong shape, or settings that make no sense.

    Example:
        >>> import torch
        >>> g = torch.Generator().manual_seed(0)
        >>> t = torch.arange(300, dtype=torch.float64)[:, None, None] / 30
        >>> wave = lambda: torch.randn(12, 3, generator=g, dtype=torch.float64)
        >>> speeds, phases, sizes, base = 4 * wave().abs(), 6 * wave(), wave(), 3 * wave()
        >>> def film(t, turn):  # twelve points that wobble, from five metres away
        ...     p = base / 3 + 0.2 * sizes * torch.sin(speeds * t + phases)
        ...     c, d = math.cos(turn), math.sin(turn)
        ...     x, z = c * p[..., 0] + d * p[..., 2], c * p[..., 2] - d * p[..., 0]
        ...     return 800 * torch.stack([x, p[..., 1]], -1) / (z + 5)[..., None]
        >>> kept = torch.ones(300, dtype=torch.bool).index_fill(0, torch.arange(140, 146), False)  # six frames are lost
        >>> found = breaks(film(t, 0.0), film(t - 0.4, 1.0)[kept], fps=30.0)
        >>> [(one.frames, one.camera, round(one.jump, 1)) for one in found.breaks], round(found.clocks.offset, 2)
        ([(6, None, -0.2)], 0.4)
    """
    options = SynchronizeOptions() if options is None else options
    check_options(options, SynchronizeOptions)
    given: dict[str, Any] = {"fps": fps, "times": times, "calibration": calibration, "weights": weights}
    if shift is None:
        shift = synchronize(a, b, max_shift=max_shift, options=options, **given)
    if shift.status.ndim:
        raise ValueError("breaks are of one pair of films; give those of a batch one by one")
    first, second, origin = prepare_tracks(a, b, options=options, **given)
    if a.shape[1] != b.shape[1]:
        raise ValueError(f"breaks are told by corresponding points; a has {a.shape[1]} and b {b.shape[1]}: give the same ones")
    clocks = first.times + origin, second.times + origin
    significant = None
    if not (first.static or second.static):
        start = shift.since(-origin)
        rates = (1.0, shift.rate) if shift.rate != 1 else (1.0,)
        evidence = JumpEvidence(first, second, rates, start.offset if start.sigma < math.inf else None, max_shift, options)
        significant = evidence.select_significant()
    if significant is None or not significant[0].jumps:
        return _without_breaks(shift, clocks)
    course, nats, residuals = significant
    clock_breaks = _clock_breaks(course, nats, residuals, *evidence.sizes(course), (first, second), origin)
    a_times, b_times = repair_clocks(
        first, second, course.rate, course.offset, _snap_to_frames(course, clock_breaks, (first.step, second.step))
    )
    new = a_times.times + origin, b_times.times + origin
    again = synchronize(a, b, times=new, max_shift=max_shift, calibration=calibration, weights=weights, options=options)
    if not again.ok or evidence.is_contradicted(course):
        refused = (Notice(BreakNotice.UNDECIDED, 0.0, {"said": again.reason or "pieces of the take contradict each other"}),)
        return Breaks((), clocks, shift, status=status_from(refused), notices=refused)
    limits = tuple(_notice(one) for one in clock_breaks)
    return Breaks(clock_breaks, new, again, status=status_from(limits), notices=limits)


def _without_breaks(shift: Shift, clocks: tuple[Tensor, Tensor]) -> Breaks:
    """Nothing jumps; where no single offset is sure either, that is said."""
    limits = () if shift.ok else (Notice(BreakNotice.UNDECIDED, 0.0, {"said": shift.reason}),)
    return Breaks((), clocks, shift, status=status_from(limits), notices=limits)


WHOLE_FRAME_TOLERANCE = 0.3  # Frames by which a jump may differ from a whole number of frames.


def _clock_breaks(
    course: PiecewiseOffset, nats: list[float], residuals: list[float], sizes: list[float], sigmas: list[float],
    tracks: tuple[Tracks, Tracks], origin: float,
) -> tuple[ClockBreak, ...]:  # fmt: skip
    """The jumps as breaks of one or the other camera."""
    a, b = tracks
    offset, result = course.offset, []
    for jump, size, sigma, gain, residual in zip(course.jumps, sizes, sigmas, nats, residuals, strict=True):
        moments = jump.moment + origin, jump.moment * course.rate + offset + origin
        loser = 1 if size < 0 else 0  # it lost frames, or the other one has some twice
        lost = abs(size) / (b if loser else a).step / (1.0 if loser else course.rate)
        whole = round(lost)
        fits = whole >= 1 and abs(lost - whole) <= max(WHOLE_FRAME_TOLERANCE, 3 * sigma / (b if loser else a).step)
        result.append(
            ClockBreak(
                candidates=(loser, 1 - loser),
                moments=(moments[loser], moments[1 - loser]),
                sigma=jump.sigma,
                jump=size,
                jump_sigma=sigma,
                frames=whole if fits else None,
                evidence=gain,
                residuals=(residual, course.fit.residual),
            )
        )
        offset += jump.size
    return tuple(result)


def _snap_to_frames(course: PiecewiseOffset, clock_breaks: Sequence[ClockBreak], steps: tuple[float, float]) -> tuple[Jump, ...]:
    """The jumps by whole frames where those fit, else by as much as was measured."""
    exact = []
    for jump, one in zip(course.jumps, clock_breaks, strict=True):
        size = one.jump
        if one.frames is not None:
            size = one.frames * steps[0] * course.rate if size > 0 else -one.frames * steps[1]
        exact.append(dataclasses.replace(jump, size=size))
    return tuple(exact)


def _notice(one: ClockBreak) -> Notice:
    """What happened, in words."""
    lost = one.frames if one.frames is not None else round(abs(one.jump), 3)
    values = {
        "case": ("frames" if one.frames is not None else "seconds") + ("" if one.camera is None else " of one"),
        "which": one.candidates[0], "other": one.candidates[-1], "at": one.moments[0], "there": one.moments[-1], "lost": lost,
    }  # fmt: skip
    return Notice(BreakNotice.TWICE if one.is_doubled else BreakNotice.LOST, one.evidence, values)


# ----------------------------------------------------------------------------------------------------------------------
# Several cameras: the one that all its pairs blame.


@dataclass(frozen=True)
class Blame:
    """One break as one pair sees it."""

    pair: tuple[int, int]  # (i, j)
    time: float  # of the reference clock, seconds
    one: ClockBreak  # as the pair tells it, with candidates 0 = i and 1 = j

    def by(self, camera: int) -> float:
        """Seconds by which the clock of one of the two jumps if it was that one."""
        return self.one.jump if camera == self.pair[1] else -self.one.jump

    def moment(self, camera: int) -> float:
        """Of that one's own clock."""
        place = self.one.candidates.index(self.pair.index(camera))
        return self.one.moments[place]


@one_thread
@on_cpu
def camera_breaks(
    tracks: Sequence[Tensor],
    clocks: Clocks,
    *,
    fps: float | Sequence[float] | None = None,
    times: Sequence[Tensor] | None = None,
    max_shift: float | None = None,
    calibration: Sequence[Any] | None = None,
    weights: Sequence[Tensor] | None = None,
    options: SynchronizeOptions | None = None,
) -> Breaks:
    """Where frames are missing, or twice, in some of several films of the same points: :func:`breaks` of every pair, then the
    camera that all its pairs blame.

    Args:
        tracks: per camera ``(frames, n, 2)`` px, NaN = missing.
        clocks: what :func:`dyntorch.synchronize_cameras` said of them, ok or not.
        fps: frames per second, of all cameras or of each.
        times: per camera ``(frames,)`` seconds, instead of ``fps``.
        max_shift: seconds.
        calibration: per camera None or ``(K, dist)``.
        weights: per camera ``(frames, n)``.
        options: as of :func:`breaks`.

    Returns:
        The breaks, each with its camera where three or more cameras tell, and mended times of all.  ``clocks`` are those given:
        synchronize again with these times.  Refused where no pair decides.

    Raises:
        ValueError: lists of other lengths, or a pair's own complaint.

    Example:
        >>> import torch
        >>> from dyntorch import synchronize_cameras
        >>> g = torch.Generator().manual_seed(0)
        >>> t = torch.arange(240, dtype=torch.float64)[:, None, None] / 30
        >>> wave = lambda: torch.randn(12, 3, generator=g, dtype=torch.float64)
        >>> speeds, phases, sizes, base = 4 * wave().abs(), 6 * wave(), wave(), 3 * wave()
        >>> def film(turn):
        ...     p = base / 3 + 0.2 * sizes * torch.sin(speeds * t + phases)
        ...     c, d = math.cos(turn), math.sin(turn)
        ...     x, z = c * p[..., 0] + d * p[..., 2], c * p[..., 2] - d * p[..., 0]
        ...     return 800 * torch.stack([x, p[..., 1]], -1) / (z + 5)[..., None]
        >>> films = [film(0.0), torch.cat([film(1.0)[:100], film(1.0)[105:]]), film(2.2)]
        >>> clocks = synchronize_cameras(films, fps=30.0, max_shift=1.0)
        >>> [(one.camera, one.frames) for one in camera_breaks(films, clocks, fps=30.0, max_shift=1.0).breaks]
        [(1, 5)]
    """
    count = len(tracks)
    every = per_camera(count, fps=fps, times=times, calibration=calibration, weights=weights)
    own_times = _own_times(tracks, every.get("fps"), times)
    results: dict[tuple[int, int], Breaks] = {}
    for (i, j), shift in clocks.shifts.items():
        try:
            results[i, j] = breaks(tracks[i], tracks[j], shift, max_shift=max_shift, options=options, **of_pair(every, i, j))
        except ValueError as error:
            raise ValueError(f"cameras {i} and {j}: {error}") from error
    sure = {pair: one for pair, one in results.items() if one.ok}
    blames = [
        Blame(pair, _reference(clocks, pair[0], one.moments[one.candidates.index(0)]), one)
        for pair, result in sure.items()
        for one in result.breaks
    ]
    broken = tuple(
        one for group in _group_by_moment(blames) for one in _attribute_to_cameras(group, sorted(sure), count, own_times)
    )
    limits: tuple[Notice, ...] = tuple(_notice(one) for one in broken)
    if not sure:
        reason = next((one.reason for one in results.values()), "no pair was compared")
        limits = (Notice(BreakNotice.UNDECIDED, 0.0, {"said": reason}),)
    new = tuple(repair_times(clock, camera, broken) for camera, clock in enumerate(own_times))
    return Breaks(broken, new, clocks, status=status_from(limits), notices=limits)


def per_camera(count: int, **given: Any) -> dict[str, Sequence[Any]]:
    """Arguments with a value for each camera; of those that are not given, none."""
    fps = given.get("fps")
    every = {**given, "fps": [float(fps)] * count if isinstance(fps, (int, float)) else fps}
    for name, values in every.items():
        if values is not None and len(values) != count:
            raise ValueError(f"{name}: {len(values)} values for {count} cameras; give one per camera")
    return {name: values for name, values in every.items() if values is not None}


def of_pair(every: Mapping[str, Sequence[Any]], i: int, j: int) -> dict[str, Any]:
    """The arguments of two cameras."""
    return {name: (values[i], values[j]) for name, values in every.items()}


def _own_times(tracks: Sequence[Tensor], fps: Sequence[Any] | None, times: Sequence[Tensor] | None) -> list[Tensor]:
    if times is not None:
        return [torch.as_tensor(one, dtype=torch.float64) for one in times]
    if fps is None:
        raise ValueError("give either fps or times, got neither")
    return [torch.arange(len(x), dtype=torch.float64) / float(rate) for x, rate in zip(tracks, fps, strict=True)]


def _reference(clocks: Clocks, camera: int, moment: float) -> float:
    """Of the reference clock; of the camera's own where it has no other."""
    time = float(clocks.inverse(camera, moment))
    return time if math.isfinite(time) else moment


MAX_BREAK_DISTANCE_SECONDS = 1.0  # Within this the breaks of several pairs are one.


def _group_by_moment(blames: list[Blame]) -> list[list[Blame]]:
    """Groups of breaks that may be one, by their moments."""
    groups: list[list[Blame]] = []
    for one in sorted(blames, key=lambda blame: blame.time):
        if groups and one.time - groups[-1][-1].time <= MAX_BREAK_DISTANCE_SECONDS:
            groups[-1].append(one)
        else:
            groups.append([one])
    return groups


def _attribute_to_cameras(
    group: list[Blame], pairs: Sequence[tuple[int, int]], count: int, times: Sequence[Tensor]
) -> list[ClockBreak]:
    """Cameras that broke at about one moment: as long as there is something to explain, the one that explains most of it."""
    left, attributed = list(group), []
    while left:
        ranked = []
        for camera in range(count):
            mine = _largest_agreeing_set([one for one in left if camera in one.pair], camera, times)
            # a pair of this camera that saw nothing, and a break of two others, speak against it
            silent = sum(camera in pair for pair in pairs) - len({one.pair for one in mine})
            ranked.append((len(mine) - silent, len(mine), camera, mine))
        ranked.sort(key=lambda one: one[:2], reverse=True)
        best, second = ranked[0], ranked[1]
        if best[1] >= 2 and best[:2] > second[:2]:
            attributed.append(_of_camera(best[2], best[3], times))
            left = [one for one in left if one not in best[3]]
        else:
            one = max(left, key=lambda blame: blame.one.evidence)
            attributed.append(dataclasses.replace(one.one, candidates=tuple(one.pair[k] for k in one.one.candidates)))
            left = [other for other in left if not set(other.pair) & set(one.pair)]
    return attributed


def _largest_agreeing_set(mine: list[Blame], camera: int, times: Sequence[Tensor]) -> list[Blame]:
    """The largest set of a camera's pairs that say the same jump, to half a frame."""
    frame = float(times[camera].diff().median()) if len(times[camera]) > 1 else 0.0
    sets = [
        [other for other in mine if abs(other.by(camera) - one.by(camera)) <= 0.5 * frame + 3 * one.one.jump_sigma] for one in mine
    ]
    return max(sets, key=len, default=[])


def _of_camera(camera: int, mine: list[Blame], times: Sequence[Tensor]) -> ClockBreak:
    """What all pairs of a camera say together."""
    w = torch.tensor([one.one.sigma**-2 for one in mine], dtype=torch.float64)
    moments = torch.tensor([one.moment(camera) for one in mine], dtype=torch.float64)
    sharp = torch.tensor([max(one.one.jump_sigma, 1e-9) ** -2 for one in mine], dtype=torch.float64)
    jump = float((sharp * torch.tensor([one.by(camera) for one in mine], dtype=torch.float64)).sum() / sharp.sum())
    step = float(times[camera].diff().median())
    whole = round(abs(jump) / step)
    strongest = max(mine, key=lambda one: one.one.evidence).one
    return ClockBreak(
        candidates=(camera,),
        moments=(float((w * moments).sum() / w.sum()),),
        sigma=float(w.sum() ** -0.5),
        jump=jump,
        jump_sigma=float(sharp.sum() ** -0.5),
        frames=whole if whole >= 1 and abs(abs(jump) / step - whole) <= WHOLE_FRAME_TOLERANCE else None,
        evidence=sum(one.one.evidence for one in mine),
        residuals=strongest.residuals,
    )


def repair_times(times: Tensor, camera: int, broken: Sequence[ClockBreak]) -> Tensor:
    """Times ``(frames,)`` of a camera's frames, as a clock that does not break would have told them."""
    new = times.clone()
    step = float(times.diff().median()) if len(times) > 1 else 0.0
    for one in broken:
        if one.candidates[0] != camera:
            continue
        size = one.seconds(step)
        later = times > one.moments[0]
        if not one.is_doubled:
            new = torch.where(later, new + size, new)
            continue
        squeezed = later & (times <= one.moments[0] + size)
        count = int(squeezed.sum())
        start = new[~later][-1] if bool((~later).any()) else new[0] - step
        close = start + step * torch.arange(1, count + 1, dtype=times.dtype) / (count + 1)
        new = torch.where(later, new - size, new)
        new[squeezed] = close
    return new
