"""Synchronization by different points: the lag of most mutual information and the lag of the row spaces, and one decision."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyntorch.core.outcome import Notice, Status, status_from
from dyntorch.tasks.synchronize.motion_capture import fit_combination
from dyntorch.tasks.synchronize.result import Shift, ShiftNotice, SynchronizeOptions
from dyntorch.tasks.synchronize.row_spaces import (
    KINDS,
    MEASURES,
    Hypothesis,
    Kind,
    KindMoments,
    Place,
    TrackPair,
    hypotheses,
    kind_moments,
    refine_lag,
)
from dyntorch.tasks.synchronize.subspace import (
    MAX_SIGMA_FRAMES,
    MIN_PEAK_SEPARATION_SECONDS,
    NUM_PEAKS,
    Body,
    SubspaceCurve,
    SubspaceShift,
    bodies_curve,
    subspace_curve,
    subspace_shift,
)
from dyntorch.tasks.synchronize.tracks import MAX_FRAME_RATE_ERROR, RATE_SIGNIFICANCE_SIGMAS, Tracks, lag_range, smooth_at

MIN_STEP_SECONDS = 1 / 30  # Step of the search at least: faster videos say no more.
MIN_SECONDS_FOR_RATE = 20.0  # Overlap from which clock rates are searched.


def different_points(a: Tracks, b: Tracks, *, max_shift: float | None, rate: float | None, options: SynchronizeOptions) -> Shift:
    """The shift of cameras that see different points of one motion."""
    for name, value, known in (("measure", options.measure, MEASURES), ("camera_model", options.camera_model, ("auto", *KINDS))):
        if value not in known:
            raise ValueError(f"options.{name} must be one of {', '.join(known)}, got {value!r}")
    step = max(a.step, b.step, MIN_STEP_SECONDS)
    a, b = _orient_axes(a, b, step, rate or 1.0, max_shift)
    samples = _Samples(a, b, step, rate or 1.0)
    curve = samples.curve(max_shift)
    best = samples.shift(curve)
    rate_sigma = 0.0
    span = min(float(t.times[-1] - t.times[0]) for t in (a, b))
    if rate is None and span > MIN_SECONDS_FOR_RATE and math.isfinite(best.sigma):
        # a shift that is sure of itself is near enough everywhere; one that is not may be smeared by a wrong rate
        settled = _rate_by_windows(curve, best, step) if best.ok else _rate_by_search(a, b, step, span, samples.lag(best.position))
        ratio, rate_sigma = settled
        if ratio != 1:
            samples = _Samples(a, b, step, ratio)
            curve = samples.curve(max_shift)
            best = samples.shift(curve)
    body = _result(a, b, samples, curve, _refuse_coarse(best, step, max(a.step, b.step)), rate_sigma)
    spaces = row_space_shift(a, b, step=step, rate=body.rate, max_shift=max_shift, around=body.offset, options=options)
    if options.measure == options.camera_model == "auto":
        return _test_time_reversal(_refine_by_combinations(a, b, _decide(body, spaces)), curve)
    return _with_row_space_lag(body, spaces, 1 / min(body.fps))


# From here on the lag is that of one kind of camera; below, sigma includes the difference of both methods.
SELF_SUFFICIENT_CLEARNESS = 8.0
PRECISE_SIGMA_FRAMES = 0.045  # Sigma up to which it is, too, frames.
MIN_CONTRADICTING_STRENGTH = 0.3  # Relative clearness from which another lag than that of shape and motion refutes it.
MIN_CONFIRMING_STRENGTH = 0.6  # The same above which a row-space peak that agrees with the shape-motion peak is accepted.
MIN_SUPPORTING_STRENGTH = 0.15  # The same below which even an agreeing lag is refused.


def _decide(body: Shift, spaces: RowSpaceShift | None) -> Shift:
    """What the body's shape and motion say, and what its row spaces say: both may decide, neither may contradict the other."""
    if spaces is None or body.status in (Status.TOO_FEW, Status.DEGENERATE):
        return body
    away = abs(spaces.lag - body.offset)
    apart, frame = away > MIN_PEAK_SEPARATION_SECONDS, 1 / min(body.fps)
    if not apart and spaces.clearness < SELF_SUFFICIENT_CLEARNESS and spaces.sigma > PRECISE_SIGMA_FRAMES * frame:
        # cameras that are nearly of some kind bend a lag by a frame or two, each way of looking by as much as it is wrong
        spaces = dataclasses.replace(spaces, sigma=math.hypot(spaces.sigma, away))
    if spaces.ok:
        return _refuse_contradiction(body, spaces) if apart and body.ok else _with_row_space_lag(body, spaces, frame)
    if not body.ok:  # the likelier candidate of two that do not decide
        return _with_row_space_lag(body, spaces, frame) if spaces.strength > MIN_CONFIRMING_STRENGTH else body
    if apart:
        return _refuse_contradiction(body, spaces) if spaces.strength > MIN_CONTRADICTING_STRENGTH else body
    if spaces.strength > MIN_CONFIRMING_STRENGTH:
        return _with_row_space_lag(body, spaces, frame, confirmed=True)
    if spaces.strength < MIN_SUPPORTING_STRENGTH:
        return _refuse_contradiction(body, spaces)
    return body if away <= frame else _refuse_imprecise(body, math.hypot(body.sigma, away / 2), frame)


def _refine_by_combinations(a: Tracks, b: Tracks, shift: Shift) -> Shift:
    """Of a camera and points in space, which are seen as combinations of these, the place between frames that a camera tells."""
    blunt = any(notice.code == ShiftNotice.BLUNT for notice in shift.notices)
    if a.x.shape[-1] == b.x.shape[-1] or not (shift.ok or blunt):
        return shift
    turned = a.x.shape[-1] == 3  # the fit goes from the camera to the space
    offset, rate = (-shift.offset / shift.rate, 1 / shift.rate) if turned else (shift.offset, shift.rate)
    fit = fit_combination(b, a, offset, rate) if turned else fit_combination(a, b, offset, rate)
    if fit is None:
        return shift
    place, sigma = (-fit.offset * shift.rate, fit.sigma * shift.rate) if turned else (fit.offset, fit.sigma)
    sigma = math.hypot(sigma, (place - shift.offset) / 2)
    if sigma > shift.sigma:
        return shift
    peaks = shift.peaks.clone()
    peaks[:1, 0] += place - shift.offset
    return dataclasses.replace(shift, offset=place, sigma=sigma, peaks=peaks)


# Nats above the time-reversed video: good pairs 7.7 and more, unrelated ones 0 +- 8 (experiments.synchronization.silent).
MIN_FORWARD_MARGIN = 5.0
CLEAR_MARGIN = 20.0  # Margin (nats) above which the time-reversal test is skipped.


def _test_time_reversal(shift: Shift, curve: SubspaceCurve) -> Shift:
    """Refused where b played backwards tells about as much at its best lag: chance does that, and a film that somebody reversed."""
    if not shift.ok or curve.bodies is None:
        return shift
    first, second = curve.bodies
    lags = int(curve.lags[0]), int(curve.lags[-1])
    other = bodies_curve(first, second.time_reversed, lags, first.step)
    best, backwards = (float(one.scores.nan_to_num(-math.inf).max()) for one in (curve, other))
    more = (best - backwards if backwards > -math.inf else math.inf) - MIN_FORWARD_MARGIN
    confidence = shift.confidence / (1 + math.exp(-max(min(more, 700.0), -700.0)))
    # a shift that is far clear of all others is no chance, whatever another film tells
    clear = len(shift.peaks) < 2 or float(shift.peaks[0, 1] - shift.peaks[1, 1]) >= CLEAR_MARGIN
    if more >= 0 or clear:
        return dataclasses.replace(shift, confidence=shift.confidence if clear else confidence)
    notice = Notice(ShiftNotice.BACKWARDS, best - backwards)
    return dataclasses.replace(shift, status=status_from((notice,)), notices=(notice, *shift.notices), confidence=confidence)


def _refuse_imprecise(shift: Shift, sigma: float, frame: float) -> Shift:
    """Refused: known to no better than a frame."""
    notice = Notice(ShiftNotice.BLUNT, sigma, {"case": "frame", "frame": frame})
    return dataclasses.replace(
        shift, sigma=sigma, status=status_from((notice,)), notices=(notice,), confidence=min(shift.confidence, 0.5)
    )


def _refuse_contradiction(body: Shift, spaces: RowSpaceShift) -> Shift:
    """Two answers, both sure."""
    rivals = ", ".join(f"{second + (body.rate - 1) * body.center:+.2f}" for second in (body.offset, spaces.lag))
    notice = Notice(ShiftNotice.REPEATED, spaces.margin, {"case": "others", "rivals": rivals})
    return dataclasses.replace(body, status=status_from((notice,)), notices=(notice,), confidence=min(body.confidence, 0.5))


def _with_row_space_lag(body: Shift, spaces: RowSpaceShift | None, frame: float, *, confirmed: bool = False) -> Shift:
    """The answer of the row spaces, with the body's clock rate; ``confirmed`` by the evidence of shape and motion."""
    if spaces is None:
        notice = Notice(ShiftNotice.SHORT_OVERLAP)
        return dataclasses.replace(body, status=status_from((notice,)), notices=(notice,), confidence=0.0, sigma=math.inf)
    drift = (body.rate - 1) * body.center
    peaks = spaces.peaks.clone()
    peaks[:, 0] += drift
    notices: list[Notice] = []
    if not (spaces.ok or confirmed):
        rivals = ", ".join(f"{second:+.2f}" for second in peaks[1:4, 0].tolist())
        notices.append(Notice(ShiftNotice.REPEATED, spaces.margin, {"case": "unclear", "rivals": rivals}))
    for which, mask in zip("ab", spaces.rejected, strict=True):
        if bool(mask.any()):
            tracks = ", ".join(str(k) for k in mask.nonzero()[:, 0].tolist())
            notices.append(Notice(ShiftNotice.FOREIGN, float(mask.sum()), {"which": which, "tracks": tracks, "points": len(mask)}))
    found = dataclasses.replace(
        body,
        offset=spaces.lag,
        sigma=spaces.sigma,
        confidence=max(spaces.confidence, body.confidence) if confirmed else spaces.confidence,
        peaks=peaks,
        lags=spaces.seconds + drift,
        scores=spaces.curve.scores * spaces.curve.counts * spaces.curve.samples,
        status=status_from(tuple(notices)),
        notices=tuple(notices),
    )
    decided = spaces.ok or confirmed
    return _refuse_imprecise(found, found.sigma, frame) if decided and found.sigma > MAX_SIGMA_FRAMES * frame else found


def _refuse_coarse(best: SubspaceShift, step: float, frame: float) -> SubspaceShift:
    """Refused where the shift is not known to a frame of the slower camera, though it may be to a step of the search."""
    if not best.ok or best.sigma * step <= MAX_SIGMA_FRAMES * frame:
        return best
    return dataclasses.replace(best, refusal=Notice(ShiftNotice.BLUNT, best.sigma * step, {"case": "frame", "frame": frame}))


def _orient_axes(a: Tracks, b: Tracks, step: float, rate: float, max_shift: float | None) -> tuple[Tracks, Tracks]:
    """Both, points in space with that axis second which shares most with the y of the camera: files have y or z up."""
    if a.x.shape[-1] == b.x.shape[-1]:
        return a, b
    first = a.x.shape[-1] == 3
    space, film = (a, b) if first else (b, a)
    rolled = [dataclasses.replace(space, x=space.x.roll(by, -1)) for by in range(3)]
    turned = [(one, film) if first else (film, one) for one in rolled]
    best = [float(_Samples(*both, step, rate).curve(max_shift).scores.nan_to_num(-math.inf).max()) for both in turned]
    return turned[best.index(max(best))]


class _Samples:
    """Both cameras at equal steps of a's clock."""

    def __init__(self, a: Tracks, b: Tracks, step: float, rate: float) -> None:
        self.first, self.wa = _resample(a, step)
        self.second, self.wb = _resample(b, step * rate)
        self.start = float(b.times[0]) / rate - float(a.times[0])
        self.step, self.rate = step, rate

    def curve(self, max_shift: float | None, around: float = 0.0) -> SubspaceCurve:
        """At all lags of a's clock within ``max_shift`` seconds of ``around``."""
        frames = len(self.first), len(self.second)
        lags = lag_range(frames, self.start, self.step, self.rate, max_shift, around, at_least_one=True)
        return subspace_curve(self.first, self.second, self.wa, self.wb, lags, step=self.step)

    def shift(self, curve: SubspaceCurve) -> SubspaceShift:
        return subspace_shift(curve, start=self.start, step=self.step)

    def lag(self, position: Tensor | float) -> Tensor | float:
        """Seconds of b's clock at time 0 of a's."""
        return (self.start + position * self.step) * self.rate


def _resample(tracks: Tracks, step: float) -> tuple[Tensor, Tensor]:
    if abs(tracks.step / step - 1) < 1e-6 and float((tracks.times.diff() / step - 1).abs().max()) < 1e-3:
        return tracks.x, tracks.weights  # its own frames: nothing to interpolate
    x, _, weights = smooth_at(tracks, tracks.every(step), max(0.5 * step, 0.5 * tracks.step))
    return x, weights


RATE_SEARCH_SECONDS = 1.0  # Range around the best shift in which rates are compared.
RATE_WINDOW_SECONDS = 10.0  # Window that has a shift of its own.
MIN_WINDOW_PROBABILITY = 0.5  # Probability from which the shift of a window counts.
MIN_WINDOW_SIGMA_FRAMES = 0.3  # Error of the shift of a window at least, frames.


def _rate_by_windows(curve: SubspaceCurve, best: SubspaceShift, step: float) -> tuple[float, float]:
    """The clock rate by a line through the shifts of windows, and its sigma; 1 unless it differs significantly."""
    assert curve.bodies is not None
    first, second = curve.bodies
    lag, reach = round(best.position), round(RATE_SEARCH_SECONDS / step)
    begin, end = max(0, reach - lag), min(len(first.rows), len(second.rows) - lag)
    size = min(round(RATE_WINDOW_SECONDS / step), (end - begin) // 4)
    windows = []
    for start in range(begin, end - size + 1, size):
        parts = _slice_body(first, start, start + size), _slice_body(second, start + lag - reach, start + lag + size + reach)
        local = subspace_shift(bodies_curve(*parts, (0, 2 * reach), step), step=1.0)
        if math.isfinite(local.sigma) and local.probability > MIN_WINDOW_PROBABILITY and 1 < local.position < 2 * reach - 1:
            windows.append((start + size / 2, local.position, max(local.sigma, MIN_WINDOW_SIGMA_FRAMES)))
    if len(windows) < 3:
        return 1.0, math.inf
    times, shifts, sigmas = torch.tensor(windows, dtype=torch.float64).unbind(1)
    slopes = torch.combinations(shifts).diff(dim=1)[:, 0] / torch.combinations(times).diff(dim=1)[:, 0]
    slope = slopes.median()
    away = shifts - slope * times
    kept = (away - away.median()).abs() < 4 * sigmas
    w = torch.where(kept, sigmas.pow(-2), 0.0)
    middle = (w * times).sum() / w.sum()
    lever = w * (times - middle)
    total = float((lever * (times - middle)).sum())
    if total <= 0:
        return 1.0, math.inf
    drift, sigma = float((lever * shifts).sum()) / total, total**-0.5
    return (1 + drift, sigma) if abs(drift) > RATE_SIGNIFICANCE_SIGMAS * sigma else (1.0, sigma)


def _slice_body(body: Body, start: int, end: int) -> Body:
    part = slice(start, min(end, len(body.rows)))
    return dataclasses.replace(body, rows=body.rows[part], motion=body.motion[part], weights=body.weights[part])


MIN_RATE_GAIN = 8.0  # Nats by which another clock rate has to be better.


def _rate_by_search(a: Tracks, b: Tracks, step: float, span: float, lag: Tensor | float) -> tuple[float, float]:
    """The clock rate whose best score near a shift is highest, by the parabola over rates, and its sigma; 1 unless convincing."""
    change = 4 * step / span  # moves the ends of the overlap by two steps
    count = math.ceil(MAX_FRAME_RATE_ERROR / change)
    rates = [1 + k * change for k in range(-count, count + 1)]
    middle = span / 2
    best = []
    for rate in rates:
        samples = _Samples(a, b, step, rate)
        # the moment in the middle keeps its place: (t + lag) of the old rate is rate (t + lag') of the new
        around = float(lag) - (rate - 1) * middle
        best.append(float(samples.curve(RATE_SEARCH_SECONDS, around).scores.nan_to_num(-math.inf).max()))
    scores = torch.tensor(best, dtype=torch.float64)
    top = int(scores.argmax())
    bend = float(scores[top - 1] - 2 * scores[top] + scores[top + 1]) if 0 < top < len(rates) - 1 else 0.0
    if not (math.isfinite(bend) and bend < 0):
        return 1.0, 0.0
    sigma = change / math.sqrt(-bend)
    place = 0.5 * float(scores[top - 1] - scores[top + 1]) / bend
    if best[top] - best[count] < MIN_RATE_GAIN:
        return 1.0, sigma
    return rates[top] + change * max(-0.5, min(0.5, place)), sigma


def _result(a: Tracks, b: Tracks, samples: _Samples, curve: SubspaceCurve, best: SubspaceShift, rate_sigma: float) -> Shift:
    offset = float(samples.lag(best.position))
    rate = samples.rate
    first = max(float(a.times[0]), (float(b.times[0]) - offset) / rate)
    last = min(float(a.times[-1]), (float(b.times[-1]) - offset) / rate)
    center = (first + last) / 2
    drift = (rate - 1) * center
    peaks = best.peaks.clone()
    if len(peaks):
        peaks[:, 0] = samples.lag(peaks[:, 0]) + drift
    limits = () if best.refusal is None else (best.refusal,)
    return Shift(
        offset=offset,
        sigma=best.sigma * samples.step,
        rate=rate,
        rate_sigma=rate_sigma if rate != 1 else 0.0,
        confidence=best.probability,
        peaks=peaks,
        method="subspace",
        fps=(1 / a.step, 1 / b.step),
        center=center,
        lags=torch.as_tensor(samples.lag(curve.lags)) + drift,
        scores=curve.scores,
        status=status_from(limits),
        notices=limits,
    )


CLEARNESS_ODDS = 4.0  # Log odds per relative clearness.
MAX_RANKED_LAGS = 400  # Lags among which local maxima are searched.


@dataclass(frozen=True, eq=False)
class RowSpaceShift:
    """The lag that stands out most of all kinds of cameras and levels of noise."""

    lag: float  # seconds of b's clock at time 0 of a's, at a rate of 1 after that
    sigma: float  # its standard deviation, seconds
    kind: Kind  # of the cameras
    clearness: float  # margin of the best lag over the spread of the others
    votes: float  # share of the kinds and levels that say the same lag
    margin: float  # nats over any other lag
    curve: Hypothesis  # of that kind and level
    seconds: Tensor  # ``(L,)`` of its lags
    rejected: tuple[Tensor, Tensor]  # tracks of a and of b ``(n,)``, ``(m,)`` bool that were left out

    @property
    def ok(self) -> bool:
        """Whether the lag is beyond doubt."""
        return self.strength >= 1

    @property
    def strength(self) -> float:
        """Clearness over what its votes need: 1 decides."""
        return _strength(self.clearness, self.votes)

    @property
    def peaks(self) -> Tensor:
        """``(k, 2)`` lag in seconds and score of local maxima, best first, the first one between frames."""
        scores, selected = self.curve.totals, list[int]()
        for place in scores.argsort(descending=True)[:MAX_RANKED_LAGS].tolist():
            away = all(abs(float(self.curve.lags[place] - self.curve.lags[other])) > self.curve.apart for other in selected)
            if away and math.isfinite(float(scores[place])):
                selected.append(place)
        selected = selected[:NUM_PEAKS]
        peaks = torch.stack([self.seconds[selected], scores[selected]], dim=1)
        peaks[0, 0] = self.lag
        return peaks

    @property
    def confidence(self) -> float:
        """Probability that the lag is right, from how clear it is."""
        odds = (self.strength - 1) * CLEARNESS_ODDS + math.log(19)
        return 1 / (1 + math.exp(-max(min(odds, 700.0), -700.0)))

    def exchange(self, rate: float) -> RowSpaceShift:
        """The same with a and b exchanged; ``rate`` of the new b's clock."""
        lag, sigma, seconds = -self.lag * rate, self.sigma * rate, -self.seconds * rate
        return replace(self, lag=lag, sigma=sigma, seconds=seconds, rejected=(self.rejected[1], self.rejected[0]))


MIN_CLEARNESS = 4.2  # Margin over the spread of other lags that decides where all hypotheses agree.
LONE_CLEARNESS = 3.0  # How much more a single hypothesis needs; in proportion between.


def _strength(clearness: float, votes: float) -> float:
    """Clearness over what these votes need: 1 decides."""
    return clearness / (MIN_CLEARNESS + (1 - votes) * LONE_CLEARNESS)


MIN_STRENGTH_FOR_REJECTION = 0.35  # Relative clearness below which no track is rejected.
MIN_CLEARNESS_GAIN = 1.15  # Factor by which a lag must stand out more without a track to reject it.


def row_space_shift(
    a: Tracks, b: Tracks, *, step: float, rate: float, max_shift: float | None, around: float = 0.0, options: SynchronizeOptions
) -> RowSpaceShift | None:
    """The clearest lag between two cameras' row spaces; None where none can be judged."""
    if a.static or b.static:
        return None
    if b.x.shape[-1] == 3:  # what is looked at between frames is the second, and a camera is the shorter take of fewer points
        back = {"step": step * rate, "rate": 1 / rate, "around": -around / rate}
        other = row_space_shift(b, a, max_shift=max_shift, options=options, **back)
        return None if other is None else other.exchange(rate)
    films = TrackPair(a, b, step, rate, options)
    films = films.without_gaps if films.spatial else films
    ta, tb = films.times
    if min(len(ta), len(tb)) < 3:
        return None
    start = float(tb[0]) / rate - float(ta[0])
    lags = _lag_range(films, start, max_shift, around / rate)
    if lags is None:
        return None
    kinds = kind_moments(films, lags)
    scored = hypotheses(kinds)
    if not scored:
        return None
    best, votes = _select_clearest(scored)
    kept = tuple(torch.ones(x.x.shape[1], dtype=torch.bool, device=x.x.device) for x in (a, b))
    if MIN_STRENGTH_FOR_REJECTION < _strength(best.clearness, votes) < 1:
        without = _reject_tracks(kinds, best)
        if without is not None:
            fewer = hypotheses([one.only(*without) for one in kinds])
            chosen, agree = _select_clearest(fewer)
            if _strength(chosen.clearness, agree) > MIN_CLEARNESS_GAIN * _strength(best.clearness, votes):
                best, votes, kept, scored = chosen, agree, without, fewer
    kind, place = _locate_between_frames(films.only(*kept), scored, best)
    seconds = (start + best.lags * step) * rate
    lag, sigma, foreign = (start + place.lag * step) * rate, place.sigma * step * rate, (~kept[0], ~kept[1])
    return RowSpaceShift(lag, sigma, kind, best.clearness, votes, best.margin, best, seconds, foreign)


MAX_LAGS = 1_200  # Lags; of longer searches those near the best one of shape and motion.


def _lag_range(films: TrackPair, start: float, max_shift: float | None, around: float) -> tuple[int, int] | None:
    """First and last lag, frames."""
    ta, tb = films.times
    lo, hi = lag_range((len(ta), len(tb)), start, films.step, films.rate, max_shift)
    if hi - lo >= MAX_LAGS:
        middle = min(max(round((around - start) / films.step), lo), hi)
        lo, hi = max(lo, middle - MAX_LAGS // 2), min(hi, middle + MAX_LAGS // 2)
    return (lo, hi) if hi - lo >= 2 else None


def _select_clearest(scored: list[Hypothesis]) -> tuple[Hypothesis, float]:
    """The clearest, and the share of all that say the same lag."""
    best = max(scored, key=lambda one: one.clearness)
    place = float(best.lags[best.best_index])
    return best, sum(abs(float(one.lags[one.best_index]) - place) <= best.apart for one in scored) / len(scored)


EQUIVALENT_NATS_SHARE = 0.75  # Share of the nats of the best kind of camera from which another one is equivalent.


def _locate_between_frames(films: TrackPair, scored: list[Hypothesis], best: Hypothesis) -> tuple[Kind, Place]:
    """Of the kinds that say the same lag, the one with most nats at its place: cameras as they are leave but noise
    unexplained."""
    lag = float(best.lags[best.best_index])
    same = [one for one in scored if abs(float(one.lags[one.best_index]) - lag) <= best.apart]
    fixed = [one for one in same if one.kind == "affine"]
    chosen = [
        max(part, key=lambda one: float(one.totals[one.best_index]))
        for part in (fixed, [x for x in same if x not in fixed])
        if part
    ]
    places = [(one.kind, refine_lag(films, one)) for one in chosen]
    kind, first = max(places, key=lambda pair: pair[1].nats)
    rivals = [place for _, place in places if place.nats > EQUIVALENT_NATS_SHARE * first.nats]
    half_range = max((abs(place.lag - first.lag) for place in rivals), default=0.0) / 2
    return kind, replace(first, sigma=math.hypot(first.sigma, half_range))


MAX_REJECTED_SHARE = 0.34  # Share of a camera's tracks that may be rejected.
MIN_TRACKS = 3  # Tracks that stay at least.


def _reject_tracks(kinds: list[KindMoments], best: Hypothesis) -> tuple[Tensor, Tensor] | None:
    """Tracks of a and of b ``(n,)``, ``(m,)`` bool that are left when those go, one by one, without which a lag stands out more."""
    counts = [kinds[0].films.a.x.shape[1], kinds[0].films.b.x.shape[1]]
    remaining = [torch.ones(count, dtype=torch.bool) for count in counts]
    tried = [one for one in kinds if one.kind == best.kind]
    clearest = best.clearness
    for _ in range(math.ceil(MAX_REJECTED_SHARE * max(counts))):
        rejection: tuple[float, int, int] | None = None
        for side in (1,) if kinds[0].films.spatial else (0, 1):
            if int(remaining[side].sum()) <= max(MIN_TRACKS, (1 - MAX_REJECTED_SHARE) * counts[side]):
                continue
            for point in remaining[side].nonzero()[:, 0].tolist():
                rest = [mask.clone() for mask in remaining]
                rest[side][point] = False
                clear = max(
                    (h.clearness for one in tried if (h := one.only(*rest).hypothesis(best.level)) is not None), default=0.0
                )
                if rejection is None or clear > rejection[0]:
                    rejection = clear, side, point
        if rejection is None or rejection[0] < clearest * MIN_CLEARNESS_GAIN:
            break
        clearest = rejection[0]
        remaining[rejection[1]][rejection[2]] = False
    return (remaining[0], remaining[1]) if not all(bool(mask.all()) for mask in remaining) else None
