"""Synchronization by points that both cameras see: a search over all shifts, then what may be wrong with the input, one by one."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import torch
from torch import Generator, Tensor

from dyntorch.core.outcome import Notice, status_from
from dyntorch.geometry.lens import fit_distortion
from dyntorch.tasks.synchronize.epipolar import (
    EPIPOLAR,
    MIN_PEAK_SEPARATION_FRAMES,
    Curve,
    EpipolarFit,
    PairModel,
    ShiftDescent,
    epipolar_curve,
)
from dyntorch.tasks.synchronize.evidence import NUM_PEAKS, Attempt, consistent_points
from dyntorch.tasks.synchronize.result import Shift, ShiftNotice, SynchronizeOptions
from dyntorch.tasks.synchronize.tracks import (
    MAX_FRAME_RATE_ERROR,
    MAX_RATE_DEVIATION,
    MIN_SECONDS_FOR_RATE,
    RATE_SIGNIFICANCE_SIGMAS,
    Tracks,
    remove_positions,
    scale_frames,
    smooth_at,
)

# ----------------------------------------------------------------------------------------------------------------------
# The search for the best shift of corresponding points: all lags at some clock rates, then descents from the best of them.


@dataclass(frozen=True)
class ShiftSearch:
    """How to search."""

    options: SynchronizeOptions
    step: float = 0.0  # seconds per lag; the slower camera's frame at least
    max_shift: float | None = None  # seconds, None for all shifts with some overlap
    rates: tuple[float, ...] = (1.0,)  # of b's clock, to search at
    free_rate: bool = True  # whether the descent may change the rate
    method: str = "epipolar"  # ``"epipolar"``, ``"camera"`` or ``"affine"``: what the tracks were made for
    model: PairModel = EPIPOLAR  # what is compared
    generator: Generator | None = None  # of the subsets of points


def search_shift(a: Tracks, b: Tracks, search: ShiftSearch, points: Tensor | None = None) -> Attempt:
    """Search all shifts at the given rates of b's clock, descend from the best, and settle the rate. points ``(n,)``."""
    points = torch.ones(a.x.shape[1], dtype=torch.bool, device=a.x.device) if points is None else points
    a, b = (a, b) if bool(points.all()) else (a.only(points), b.only(points))
    step = max(a.step, b.step, search.step)
    searched = [
        (samples, epipolar_curve(samples, search.max_shift))
        for samples in (search.model.samples.of(a, b, step, r) for r in search.rates)
    ]
    fit = _descend_from_peaks(a, b, [curve for _, curve in searched], step, search)
    samples, curve = min(searched, key=lambda found: abs(found[0].rate - (fit.rate if fit else 1.0)))
    if fit is not None and abs(fit.rate - samples.rate) * (float(a.times[-1]) - float(a.times[0])) > 0.25 * step:
        samples = search.model.samples.of(a, b, step, fit.rate)
        curve = epipolar_curve(samples, search.max_shift)
    return Attempt(
        a, b, fit, curve, samples, step, search.max_shift, points, search.method, search.options.min_margin, model=search.model
    )


CLEAR_PEAK_MARGIN = 0.6  # Nats above the next peak from which that one needs no descent of its own.


def _descend_from_peaks(a: Tracks, b: Tracks, curves: list[Curve], step: float, search: ShiftSearch) -> EpipolarFit | None:
    """The likeliest minimum near the peaks of the curves."""
    free_rate = search.free_rate
    frame = max(a.step, b.step)
    starts = sorted(
        ((score, lag * curve.rate, curve.rate) for curve in curves for lag, score in curve.peaks(NUM_PEAKS)), reverse=True
    )
    if not starts:
        return None
    apart = max(MIN_PEAK_SEPARATION_FRAMES * frame, 1.5 * step)
    rivals = [start for start in starts if abs(start[1] - starts[0][1]) > apart or start[2] != starts[0][2]]
    several = len(curves) > 1 or not rivals or starts[0][0] - rivals[0][0] < CLEAR_PEAK_MARGIN
    widths = [step]
    while widths[-1] > frame:
        widths.append(max(frame, widths[-1] / 3))
    descent = search.model.descent(a, b, step)
    fits = []
    for score, offset, rate in starts[: NUM_PEAKS if several else 1]:
        fit = descent.run(offset, rate, free_rate=free_rate and step > frame)
        if fit is not None:
            # the curve's variance counts everything, the fit's robust residual nothing that is far: both have a say
            fits.append((score - math.log(max(fit.residual, 1e-300)) + 0.5 * math.log(fit.effective), fit))
    if not fits:
        return None
    best = max(fits, key=lambda pair: pair[0])[1]
    for width in widths[1:]:
        descent = search.model.descent(a, b, width)
        best = descent.run(best.offset, best.rate, free_rate=free_rate) or best
    long = float(best.times[-1] - best.times[0]) > MIN_SECONDS_FOR_RATE
    return _select_rate(descent, best) if free_rate and long else best


MIN_RATE_EFFECT_FRAMES = 0.1  # Frames over the take that a rate must amount to.


def _select_rate(descent: ShiftDescent, fit: EpipolarFit) -> EpipolarFit:
    """With its own rate where that differs from 1 beyond doubt, else with rate 1."""
    free = descent.run(fit.offset, fit.rate, free_rate=True)
    span = float(fit.times[-1] - fit.times[0])
    if free is not None and MAX_RATE_DEVIATION > abs(free.rate - 1) > max(
        RATE_SIGNIFICANCE_SIGMAS * free.rate_sigma, MIN_RATE_EFFECT_FRAMES * descent.frame / span
    ):
        return free
    fixed = descent.run(fit.shift, 1.0) if fit.rate != 1 else fit
    return fixed or fit


# ----------------------------------------------------------------------------------------------------------------------
# Synchronization by points that both cameras see: plain first, then what may be wrong with the input, one thing at a time.


@dataclasses.dataclass(frozen=True, eq=False)
class SamePointsResult:
    """The best attempt and what it took."""

    attempt: Attempt
    notices: tuple[Notice, ...]
    seen: Tensor  # ``(n,)`` bool, points that both cameras show at all


MAX_STEPS = 4_000  # Steps of a take; longer takes are searched in coarser steps.
MIN_ROUGHNESS_FOR_LENSES = 1.25  # Residual over the noise from which lenses are fitted.


def search_same_points(
    a: Tracks,
    b: Tracks,
    *,
    max_shift: float | None,
    rate: float | None,
    camera: str,
    lenses: bool,
    generator: Generator | None,
    options: SynchronizeOptions,
    model: PairModel = EPIPOLAR,
) -> SamePointsResult:
    """The shift of cameras that see the same points, or of a camera and the same points in space."""
    span = min(float(t.times[-1] - t.times[0]) for t in (a, b))
    search = ShiftSearch(
        step=span / MAX_STEPS, max_shift=max_shift, rates=(rate or 1.0,), free_rate=rate is None,
        method=model.method, model=model,
        options=options, generator=generator,
    )  # fmt: skip
    seen = (a.weights > 0).any(0) & (b.weights > 0).any(0)
    if a.static or b.static:
        return SamePointsResult(dataclasses.replace(search_shift(a, b, search), fit=None), (), seen)
    if camera == "affine":
        return SamePointsResult(_search_affine(a, b, search), (), seen)
    attempt = _search_without_outliers(a, b, search)
    if not attempt.accepted_shift and rate is None:
        attempt = _select_attempt(attempt, _search_rates(a, b, search, span))
    notices: tuple[Notice, ...] = ()
    if lenses and attempt.fit is not None and attempt.normalized_residual > MIN_ROUGHNESS_FOR_LENSES:
        attempt, notices = _search_undistorted(attempt, a, b, search)
    if camera == "auto" and model is EPIPOLAR and not attempt.accepted_shift:
        scaled = _search_affine(a, b, search)
        # without the place in the picture a gait repeats itself, so that affine cameras alone may be sure of a wrong period
        if scaled.accepted_shift and _same_shift(scaled, attempt):
            return SamePointsResult(scaled, (Notice(ShiftNotice.AFFINE),), seen)
    return SamePointsResult(attempt, notices if attempt.accepted_shift else (), seen)


def _search_without_outliers(a: Tracks, b: Tracks, search: ShiftSearch) -> Attempt:
    """An attempt with all points, and one without those that do not fit, where that may be why it fails."""
    attempt = search_shift(a, b, search)
    pruned = _reject_positions(attempt)
    if pruned is not None:
        a, b = pruned
        attempt = _select_attempt(attempt, dataclasses.replace(search_shift(a, b, search), positions_removed=True))
    if attempt.accepted_shift and not bool(_suspected_points(attempt).any()):
        return attempt
    points = consistent_points(a, b, attempt, search.generator) if search.options.reject_points else None
    if points is None or bool(points.all()):
        return attempt
    return _select_attempt(attempt, dataclasses.replace(search_shift(a, b, search, points), positions_removed=pruned is not None))


OUTLIER_SIGMAS = 6.0  # Robust sigmas from the fit at which a position is an outlier.
MAX_OUTLIER_SHARE = 0.3  # Share of the positions of a point, or of a stretch of the take, that may be outliers.
NUM_STRETCHES = 8  # Stretches of the take that are tested for it.
NEGLIGIBLE_OUTLIER_SHARE = 0.01  # Share of outliers that makes no difference to an accepted fit.


def _reject_positions(attempt: Attempt) -> tuple[Tracks, Tracks] | None:
    """Tracks without the positions far from the fit, in both cameras: whose is wrong is not known; None where all is well."""
    fit = attempt.fit
    if fit is None or len(fit.times) != len(attempt.a.times):
        return None
    far = fit.distances.abs() > OUTLIER_SIGMAS
    seen = fit.distances.isfinite()
    # a point that is mostly elsewhere is another point, and is found as such
    far = far & (far.sum(0) <= MAX_OUTLIER_SHARE * seen.sum(0))
    parts = [
        (float(one.sum()), float(all_.sum())) for one, all_ in zip(far.chunk(NUM_STRETCHES), seen.chunk(NUM_STRETCHES), strict=True)
    ]
    if attempt.accepted_shift and float(far.double().mean()) < NEGLIGIBLE_OUTLIER_SHARE:
        return None  # the weights of the fit are enough
    # a stretch that does not fit is no outlier: it contradicts
    if not bool(far.any()) or any(lost > MAX_OUTLIER_SHARE * whole for lost, whole in parts):
        return None
    frames, joints = far.nonzero().unbind(1)
    there = fit.times[frames] * fit.rate + fit.offset
    nearest = (there[:, None] - attempt.b.times).abs().argmin(1)
    other = torch.zeros_like(attempt.b.weights, dtype=torch.bool)
    other[nearest, joints] = True
    return remove_positions(attempt.a, far), remove_positions(attempt.b, other)


MAX_RATE_STEPS = 2_000  # Steps of a take for a search over rates, of a tenth of a second at least.


def _search_rates(a: Tracks, b: Tracks, search: ShiftSearch, span: float) -> Attempt | None:
    """A search over clock rates too, where a wrong one would have smeared the motion."""
    step = max(span / MAX_RATE_STEPS, 0.1)
    change = 2 * step / span  # moves the ends of the overlap by a step
    count = math.ceil(MAX_FRAME_RATE_ERROR / change)
    if span < MIN_SECONDS_FOR_RATE:
        return None
    rates = tuple(1 + k * change for k in range(-count, count + 1))
    coarse = search_shift(a, b, dataclasses.replace(search, step=step, rates=rates))
    if coarse.fit is None:
        return None
    return _search_without_outliers(a, b, dataclasses.replace(search, rates=(coarse.fit.rate,)))


def _search_affine(a: Tracks, b: Tracks, search: ShiftSearch) -> Attempt:
    return _search_without_outliers(scale_frames(a), scale_frames(b), dataclasses.replace(search, method="affine"))


def _select_attempt(one: Attempt, other: Attempt | None) -> Attempt:
    """The decided one; where both are, the other, which had the more careful input; where none is, the one more likely right."""
    if other is None or other.fit is None:
        return one
    if one.fit is None or other.accepted_shift:
        return other
    return one if one.accepted_shift or one.confidence >= other.confidence else other


def _same_shift(one: Attempt, other: Attempt) -> bool:
    """Whether the best shifts are the same."""
    return (
        one.fit is not None
        and other.fit is not None
        and abs(one.fit.shift - other.fit.shift) <= MIN_PEAK_SEPARATION_FRAMES * one.frame
    )


SUSPECT_RESIDUAL_RATIO = 3.0  # Residual over the usual one beyond which a point is suspected.


def _suspected_points(attempt: Attempt) -> Tensor:
    """``(n,)`` of the points that took part: whether their residual is out of all proportion."""
    assert attempt.fit is not None
    own = attempt.fit.distances.abs().nanmedian(0).values * 1.4826
    return own.nan_to_num(0.0) > SUSPECT_RESIDUAL_RATIO


def _search_undistorted(attempt: Attempt, a: Tracks, b: Tracks, search: ShiftSearch) -> tuple[Attempt, tuple[Notice, ...]]:
    """Once more with lenses fitted at the shift found, where they are significant."""
    assert attempt.fit is not None
    fit = attempt.fit
    x1, _, w1 = smooth_at(attempt.a, fit.times, attempt.frame)
    x2, _, w2 = smooth_at(attempt.b, fit.times * fit.rate + fit.offset, attempt.frame)
    lens = fit_distortion(x1.flatten(0, 1), x2.flatten(0, 1), (w1 * w2).flatten())
    if not lens.significant:
        return attempt, ()
    straight = []
    for tracks, one in zip((a, b), lens.lenses, strict=True):
        x = one.undistort(tracks.x)
        seen = x.isfinite().all(-1)
        straight.append(dataclasses.replace(tracks, x=torch.where(seen[..., None], x, 0.0), weights=tracks.weights * seen))
    again = search_shift(straight[0], straight[1], search, attempt.points)
    better = again.fit is not None and again.fit.residual < fit.residual and _select_attempt(attempt, again) is again
    values = {"a": lens.lambda_a, "b": lens.lambda_b}
    return (again, (Notice(ShiftNotice.LENS, 0.0, values),)) if better else (attempt, ())


MAX_CAMERA_MOTION_RATIO = 1.35  # Residual over that of each half by itself beyond which a camera may have moved.


def shift_of(result: SamePointsResult) -> Shift:
    """The result of an attempt."""
    attempt, limits = result.attempt, result.notices
    fps = 1 / attempt.a.step, 1 / attempt.b.step
    fit = attempt.fit
    points = attempt.points & result.seen
    if fit is None:
        return Shift.unknown(attempt.method, fps, [_refuse_without_peak(attempt)], result.seen)
    if not attempt.accepted_shift:
        limits = (_refusal(attempt), *limits)
    wrong = (result.seen & ~attempt.points).nonzero()[:, 0].tolist()
    if wrong:
        which = ", ".join(str(point) for point in wrong)
        limits = (*limits, Notice(ShiftNotice.LEFT_OUT, float(len(wrong)), {"points": len(points), "which": which}))
    if attempt.accepted_shift and attempt.camera_motion_ratio > MAX_CAMERA_MOTION_RATIO:
        limits = (*limits, Notice(ShiftNotice.MOVED, attempt.camera_motion_ratio))
    lags = attempt.curve.rate * (attempt.curve.lags + fit.center) - fit.center
    return Shift(
        offset=fit.offset,
        sigma=attempt.sigma,
        rate=fit.rate,
        rate_sigma=fit.rate_sigma,
        confidence=attempt.confidence,
        peaks=torch.tensor(attempt.peaks, dtype=torch.float64),
        method=attempt.method,
        fps=fps,
        center=fit.center,
        lags=lags,
        scores=attempt.curve.scores,
        points=points,
        fundamental=fit.fundamental if attempt.method == "epipolar" else None,
        projection=fit.fundamental if attempt.method == "camera" else None,
        status=status_from(limits),
        notices=limits,
    )


def _refuse_without_peak(attempt: Attempt) -> Notice:
    """Why no shift stands out."""
    for name, tracks in (("a", attempt.a), ("b", attempt.b)):
        if not bool((tracks.weights > 0).any()):
            return Notice(ShiftNotice.NO_POINT, 0.0, {"which": name})
        if tracks.static:
            return Notice(ShiftNotice.STILL, 0.0, {"which": name})
    return Notice(ShiftNotice.NOTHING)


MAX_SIGMA_OF_PEAK_FRAMES = 10.0  # Sigma from which no shift stands out at all, frames.


def _refusal(attempt: Attempt) -> Notice:
    """Why the data do not decide."""
    fit = attempt.fit
    assert fit is not None
    if fit.sigma > MAX_SIGMA_OF_PEAK_FRAMES * attempt.frame:
        return _refuse_without_peak(attempt)
    if (
        attempt.halves_agree
        and attempt.margin >= attempt.required_margin
        and attempt.time_reversal_margin < attempt.required_time_reversal_margin
    ):
        return Notice(ShiftNotice.BACKWARDS, attempt.time_reversal_margin)
    if attempt.at_search_end:
        return Notice(ShiftNotice.EDGE, fit.shift, {"best": fit.shift})
    if not attempt.precise:
        return Notice(ShiftNotice.BLUNT, fit.sigma, {"case": "small", "best": fit.shift})
    if attempt.margin < attempt.required_margin and len(attempt.peaks) > 1:
        least = attempt.misfits[0] - attempt.required_margin
        near = [shift for (shift, _), misfit in zip(attempt.peaks, attempt.misfits, strict=True) if misfit > least]
        rivals = ", ".join(f"{shift:+.3g} s" for shift in near[1:4])
        return Notice(ShiftNotice.REPEATED, attempt.margin, {"case": "rivals", "best": attempt.peaks[0][0], "rivals": rivals})
    first, second = attempt.halves
    shifts = (f"{fit.shift + away * attempt.frame:+.3g} s" for away in (first, second))
    said = " and ".join("nothing" if "nan" in shift else shift for shift in shifts)
    return Notice(ShiftNotice.HALVES, 0.0, {"halves": said, "apart": attempt.half_disagreement, "best": fit.shift})
