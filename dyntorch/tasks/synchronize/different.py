"""Synchronization by different points: common steps of time, then the shift at which the cameras share most information."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.core.outcome import Notice, Status, status_from
from dyntorch.tasks.synchronize.camera_models import KINDS
from dyntorch.tasks.synchronize.combinations import combined_fit
from dyntorch.tasks.synchronize.measures import MEASURES
from dyntorch.tasks.synchronize.options import SynchronizeOptions
from dyntorch.tasks.synchronize.result import Shift, ShiftNotice
from dyntorch.tasks.synchronize.row_spaces import RowSpaceShift, row_space_shift
from dyntorch.tasks.synchronize.subspace import STEP, Body, SubspaceCurve, bodies_curve, halves, information, subspace_curve
from dyntorch.tasks.synchronize.tracks import Tracks, smoothed

# ----------------------------------------------------------------------------------------------------------------------
# What speaks against a lag between different points: motion that repeats itself, and a peak that depends on single moments.


def resemblance(curve: SubspaceCurve, best: int, apart: float, options: SynchronizeOptions) -> float:
    r"""How much the motion resembles itself at another time that fits as well: 0 not at all, 1 as much as at the same time."""
    if curve.bodies is None:
        return 0.0
    judged = curve.scores.isfinite()
    rivals = judged.nonzero()[:, 0] - best
    frames, step = min(len(body.rows) for body in curve.bodies), curve.bodies[0].step
    reach = min(int(rivals.abs().max()), frames - math.ceil(options.subspace.least_seconds / step))
    if reach <= apart:
        return 0.0
    both = sum((_alike(body, reach, options) for body in curve.bodies), curve.scores.new_zeros(2 * reach + 1))
    both = both + both.flip(0)
    padded = torch.nn.functional.pad(both, (1, 1), value=math.inf)
    peak = (both >= padded[:-2]) & (both >= padded[2:])
    rivals = rivals[(rivals.abs() <= reach) & (rivals.abs() > apart)] + reach
    found = both[rivals[peak[rivals]]]
    if not len(found):
        return 0.0
    own, other = float(both[reach]), float(found.max())
    return other / own if own > 0 else math.inf


def _alike(body: Body, reach: int, options: SynchronizeOptions) -> Tensor:
    """Evidence per frame ``(2 reach + 1,)`` between halves of the points."""
    first, second = halves(body, options)
    return bodies_curve(first.blurred, second.blurred, (-reach, reach), body.step, options=options).rates.nan_to_num(-math.inf)


def wobble(curve: SubspaceCurve, lag: int, options: SynchronizeOptions) -> float:
    r"""Standard deviation of the best lag in frames, by the jackknife over parts of the overlap."""
    if curve.bodies is None:
        return 0.0
    a, b = curve.bodies
    start, end = max(0, 1 - lag), min(len(a.rows), len(b.rows) - lag - 1)
    if end - start < options.different.blocks:
        return math.inf
    edges = torch.linspace(start, end, options.different.blocks + 1).round().long().tolist()
    sizes = torch.tensor(edges).diff().tolist()
    shapes: list[Tensor] = []
    motions: list[Tensor] = []
    for at in range(lag - 1, lag + 2):
        w = a.weights[start:end] * b.weights[start + at : end + at]
        for kept, x, y in ((shapes, a.rows, b.rows), (motions, a.motion, b.motion)):
            both = torch.cat([x[start:end], y[start + at : end + at], torch.ones_like(w)[:, None]], dim=1) * w[:, None]
            kept.append(torch.stack([part.mT @ part for part in both.split(sizes)]))
    shape, motion = (_without(torch.stack(kept)) for kept in (shapes, motions))
    before, here, after = information(shape, motion, (a, b), options).unflatten(0, (3, options.different.blocks))
    bend = float((before - 2 * here + after).mean())
    return (
        math.sqrt((options.different.blocks - 1) * float(((after - before) / 2).var(correction=0))) / -bend
        if bend < 0
        else math.inf
    )


def _without(moments: Tensor) -> Tensor:
    """Covariances ``(L B, d, d)`` of all parts but one, of moments ``(L, B, d + 1, d + 1)``."""
    rest = (moments.sum(1, keepdim=True) - moments).flatten(0, 1)
    count = rest[:, -1:, -1:].clamp(min=1.0)
    mean = rest[:, :-1, -1:] / count
    return rest[:, :-1, :-1] / count - mean @ mean.mT


# ----------------------------------------------------------------------------------------------------------------------
# The lag between two cameras that track different points, between frames, with what speaks against it.


@dataclass(frozen=True, eq=False)
class SubspaceShift:
    """Which frame of b goes with which of a."""

    position: float  # frames: frame i of a is at i + position of b; 0 where nothing could be judged
    sigma: float  # its standard deviation if the peak is the right one, frames
    peaks: Tensor  # ``(k, 2)`` position and score of local maxima, best first
    probability: float  # that the position is right to within a frame
    margin: float  # nats per frame over the next peak, times the frames that overlap at the best: periodic motion has none
    refusal: Notice | None = None  # why the data do not decide; None where they do

    @property
    def ok(self) -> bool:
        """Whether the data decide."""
        return self.refusal is None

    @property
    def reason(self) -> str:
        """Why not, and what to do; empty where they do."""
        return "" if self.refusal is None else self.refusal.text


def subspace_shift(
    curve: SubspaceCurve, *, start: float = 0.0, step: float = STEP, options: SynchronizeOptions = SynchronizeOptions()
) -> SubspaceShift:
    r"""The best lag of a curve, by the parabola through its highest three scores, and whether to believe it."""
    judged = curve.scores.isfinite()
    if int(judged.sum()) < 3:
        return SubspaceShift(0.0, math.inf, curve.scores.new_zeros(0, 2), 0.0, 0.0, Notice(ShiftNotice.SHORT_OVERLAP))
    scores = curve.scores.nan_to_num(-math.inf)
    top = _maxima(scores, options.different.apart / step, options)
    positions = [_between(scores, i) for i in top[: options.different.peaks]]
    places = torch.tensor([p for p, _ in positions], dtype=scores.dtype, device=scores.device)
    peaks = torch.stack([curve.lags[0] + places, scores[top[: options.different.peaks]]], dim=1)
    best = top[0]
    probability, margin = _probability(scores, best), _margin(curve, best, options.different.apart / step, options)
    probability = min(probability, 1 / (1 + math.exp(-max(min(margin, 700.0), -700.0))))
    position = float(peaks[0, 0])
    sigma = math.hypot(options.different.blur / step, max(positions[0][1], wobble(curve, round(position), options)))
    times = start + step * peaks[1:4, 0]
    refusal = _refusal(curve, best, probability, margin, times, step, options)
    if (
        refusal is None
        and margin < options.different.alone * float(scores[best])
        and resemblance(curve, best, options.different.apart / step, options) > options.different.repeated
    ):
        refusal = Notice(ShiftNotice.REPEATED, margin, {"case": "itself"})
    if refusal is None and sigma > options.different.sharp:
        refusal = Notice(ShiftNotice.BLUNT, sigma * step, {"case": "known" if math.isfinite(sigma) else "rough"})
    return SubspaceShift(position, sigma, peaks, probability, margin, refusal)


def _maxima(scores: Tensor, apart: float, options: SynchronizeOptions) -> list[int]:
    """Local maxima, best first, none within so many frames of a better one."""
    padded = torch.nn.functional.pad(scores, (1, 1), value=-math.inf)
    top = ((scores >= padded[:-2]) & (scores >= padded[2:]) & scores.isfinite()).nonzero()[:, 0]
    kept: list[int] = []
    for i in top[scores[top].argsort(descending=True)].tolist():
        if all(abs(i - j) > apart + 1e-9 for j in kept):
            kept.append(i)
        if len(kept) > 4 * options.different.peaks:
            break
    return kept


def _between(scores: Tensor, i: int) -> tuple[float, float]:
    """Place of the maximum near entry i, and its standard deviation."""
    around = scores[max(i - 1, 0) : i + 2].tolist()
    bend = around[0] - 2 * around[1] + around[2] if len(around) == 3 else 0.0
    if not (math.isfinite(bend) and bend < 0):
        return float(i), 1.0
    move = 0.5 * (around[0] - around[2]) / bend
    return i + max(-0.5, min(0.5, move)), math.sqrt(-1 / bend)


def _probability(scores: Tensor, best: int) -> float:
    """Share of the posterior within a frame of the best."""
    weight = (scores - scores[best]).exp()
    return float(weight[max(best - 1, 0) : best + 2].sum() / weight.sum())


def _margin(curve: SubspaceCurve, best: int, apart: float, options: SynchronizeOptions) -> float:
    """Nats per frame over the best other maximum, times the best one's frames."""
    rates = torch.where(curve.scores.isfinite(), curve.rates, -math.inf)
    others = [i for i in _maxima(rates, apart, options) if abs(i - best) > apart + 1e-9]
    return float((rates[best] - rates[others[0]]) * curve.counts[best]) if others else float(curve.scores[best])


def _refusal(
    curve: SubspaceCurve, best: int, probability: float, margin: float, times: Tensor, step: float, options: SynchronizeOptions
) -> Notice | None:
    """Why the data do not decide; empty where they do."""
    if min(curve.signal) < 1 or float(curve.rates[best]) < options.different.telling * step:
        return Notice(ShiftNotice.NOISY, min(curve.signal))
    if curve.bodies is not None and min(body.bend for body in curve.bodies) < options.different.bent:
        return Notice(ShiftNotice.STRAIGHT, min(body.bend for body in curve.bodies))
    if probability >= options.different.sure and margin >= options.different.clear:
        return None
    others = ", ".join(f"{time:+.2f}" for time in times.tolist())
    return Notice(
        ShiftNotice.REPEATED, margin, {"case": "others" if margin < options.different.clear else "unclear", "rivals": others}
    )


def different_points(a: Tracks, b: Tracks, *, max_shift: float | None, rate: float | None, options: SynchronizeOptions) -> Shift:
    """The shift of cameras that see different points of one motion."""
    for name, value, known in (
        ("measure", options.different.measure, MEASURES),
        ("camera", options.different.camera, ("auto", *KINDS)),
    ):
        if value not in known:
            raise ValueError(f"options.different.{name} must be one of {', '.join(known)}, got {value!r}")
    step = max(a.step, b.step, options.different.finest)
    a, b = _upright(a, b, step, rate or 1.0, max_shift, options)
    found = _Samples(a, b, step, rate or 1.0, options=options)
    curve = found.curve(max_shift)
    best = found.shift(curve)
    rate_sigma = 0.0
    span = min(float(t.times[-1] - t.times[0]) for t in (a, b))
    if rate is None and span > options.different.drifting and math.isfinite(best.sigma):
        # a shift that is sure of itself is near enough everywhere; one that is not may be smeared by a wrong rate
        settled = _drift(curve, best, step, options) if best.ok else _rate(a, b, step, span, found.lag(best.position), options)
        ratio, rate_sigma = settled
        if ratio != 1:
            found = _Samples(a, b, step, ratio, options=options)
            curve = found.curve(max_shift)
            best = found.shift(curve)
    body = _result(a, b, found, curve, _to_a_frame(best, step, max(a.step, b.step), options), rate_sigma)
    spaces = row_space_shift(a, b, step=step, rate=body.rate, max_shift=max_shift, around=body.offset, options=options)
    if options.different.measure == options.different.camera == "auto":
        return _forwards(_between_frames(a, b, _combined(body, spaces, options), options), curve, options)
    return _of_spaces(body, spaces, 1 / min(body.fps), options)


def _combined(body: Shift, spaces: RowSpaceShift | None, options: SynchronizeOptions) -> Shift:
    """What the body's shape and motion say, and what its row spaces say: both may decide, neither may contradict the other."""
    if spaces is None or body.status in (Status.TOO_FEW, Status.DEGENERATE):
        return body
    away = abs(spaces.lag - body.offset)
    apart, frame = away > options.different.apart, 1 / min(body.fps)
    if not apart and spaces.clearness < options.rows.beyond and spaces.sigma > options.rows.precise * frame:
        # cameras that are nearly of some kind bend a lag by a frame or two, each way of looking by as much as it is wrong
        spaces = dataclasses.replace(spaces, sigma=math.hypot(spaces.sigma, away))
    if spaces.ok:
        return _refused(body, spaces) if apart and body.ok else _of_spaces(body, spaces, frame, options)
    if not body.ok:  # the likelier candidate of two that do not decide
        return _of_spaces(body, spaces, frame, options) if spaces.strength > options.rows.confirming else body
    if apart:
        return _refused(body, spaces) if spaces.strength > options.rows.contradicting else body
    if spaces.strength > options.rows.confirming:
        return _of_spaces(body, spaces, frame, options, confirmed=True)
    if spaces.strength < options.rows.heard:
        return _refused(body, spaces)
    return body if away <= frame else _blunt(body, math.hypot(body.sigma, away / 2), frame)


def _between_frames(a: Tracks, b: Tracks, shift: Shift, options: SynchronizeOptions) -> Shift:
    """Of a camera and points in space, which are seen as combinations of these, the place between frames that a camera tells."""
    blunt = any(notice.code == ShiftNotice.BLUNT for notice in shift.notices)
    if a.x.shape[-1] == b.x.shape[-1] or not (shift.ok or blunt):
        return shift
    turned = a.x.shape[-1] == 3  # the fit goes from the camera to the space
    offset, rate = (-shift.offset / shift.rate, 1 / shift.rate) if turned else (shift.offset, shift.rate)
    found = combined_fit(b, a, offset, rate, options) if turned else combined_fit(a, b, offset, rate, options)
    if found is None:
        return shift
    place, sigma = (-found.offset * shift.rate, found.sigma * shift.rate) if turned else (found.offset, found.sigma)
    sigma = math.hypot(sigma, (place - shift.offset) / 2)
    if sigma > shift.sigma:
        return shift
    peaks = shift.peaks.clone()
    peaks[:1, 0] += place - shift.offset
    return dataclasses.replace(shift, offset=place, sigma=sigma, peaks=peaks)


def _forwards(shift: Shift, curve: SubspaceCurve, options: SynchronizeOptions) -> Shift:
    """Refused where b played backwards tells about as much at its best lag: chance does that, and a film that somebody reversed."""
    if not shift.ok or curve.bodies is None:
        return shift
    first, second = curve.bodies
    lags = int(curve.lags[0]), int(curve.lags[-1])
    other = bodies_curve(first, second.reversed, lags, first.step, options=options)
    best, backwards = (float(one.scores.nan_to_num(-math.inf).max()) for one in (curve, other))
    more = (best - backwards if backwards > -math.inf else math.inf) - options.different.forward
    confidence = shift.confidence / (1 + math.exp(-max(min(more, 700.0), -700.0)))
    # a shift that is far clear of all others is no chance, whatever another film tells
    clear = len(shift.peaks) < 2 or float(shift.peaks[0, 1] - shift.peaks[1, 1]) >= options.different.forward_clear
    if more >= 0 or clear:
        return dataclasses.replace(shift, confidence=shift.confidence if clear else confidence)
    notice = Notice(ShiftNotice.BACKWARDS, best - backwards)
    return dataclasses.replace(shift, status=status_from((notice,)), notices=(notice, *shift.notices), confidence=confidence)


def _blunt(shift: Shift, sigma: float, frame: float) -> Shift:
    """Refused: known to no better than a frame."""
    notice = Notice(ShiftNotice.BLUNT, sigma, {"case": "frame", "frame": frame})
    return dataclasses.replace(
        shift, sigma=sigma, status=status_from((notice,)), notices=(notice,), confidence=min(shift.confidence, 0.5)
    )


def _refused(body: Shift, spaces: RowSpaceShift) -> Shift:
    """Two answers, both sure."""
    rivals = ", ".join(f"{second + (body.rate - 1) * body.center:+.2f}" for second in (body.offset, spaces.lag))
    notice = Notice(ShiftNotice.REPEATED, spaces.margin, {"case": "others", "rivals": rivals})
    return dataclasses.replace(body, status=status_from((notice,)), notices=(notice,), confidence=min(body.confidence, 0.5))


def _of_spaces(
    body: Shift, spaces: RowSpaceShift | None, frame: float, options: SynchronizeOptions, *, confirmed: bool = False
) -> Shift:
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
    for which, mask in zip("ab", spaces.foreign, strict=True):
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
    return _blunt(found, found.sigma, frame) if decided and found.sigma > options.different.sharp_frames * frame else found


def _to_a_frame(best: SubspaceShift, step: float, frame: float, options: SynchronizeOptions) -> SubspaceShift:
    """Refused where the shift is not known to a frame of the slower camera, though it may be to a step of the search."""
    if not best.ok or best.sigma * step <= options.different.sharp_frames * frame:
        return best
    return dataclasses.replace(best, refusal=Notice(ShiftNotice.BLUNT, best.sigma * step, {"case": "frame", "frame": frame}))


def _upright(
    a: Tracks, b: Tracks, step: float, rate: float, max_shift: float | None, options: SynchronizeOptions
) -> tuple[Tracks, Tracks]:
    """Both, points in space with that axis second which shares most with the y of the camera: files have y or z up."""
    if a.x.shape[-1] == b.x.shape[-1]:
        return a, b
    first = a.x.shape[-1] == 3
    space, film = (a, b) if first else (b, a)
    rolled = [dataclasses.replace(space, x=space.x.roll(by, -1)) for by in range(3)]
    turned = [(one, film) if first else (film, one) for one in rolled]
    best = [
        float(_Samples(*both, step, rate, options=options).curve(max_shift).scores.nan_to_num(-math.inf).max()) for both in turned
    ]
    return turned[best.index(max(best))]


class _Samples:
    """Both cameras at equal steps of a's clock."""

    def __init__(self, a: Tracks, b: Tracks, step: float, rate: float, options: SynchronizeOptions) -> None:
        self.options = options
        self.first, self.wa = _sampled(a, step, self.options)
        self.second, self.wb = _sampled(b, step * rate, self.options)
        self.start = float(b.times[0]) / rate - float(a.times[0])
        self.step, self.rate = step, rate

    def curve(self, max_shift: float | None, around: float = 0.0) -> SubspaceCurve:
        """At all lags of a's clock within ``max_shift`` seconds of ``around``."""
        lo, hi = 1 - len(self.first), len(self.second) - 1
        if max_shift is not None:
            low, high = (((around + sign * max_shift) / self.rate - self.start) / self.step for sign in (-1, 1))
            lo, hi = min(max(lo, math.ceil(low - 1e-9)), hi), max(min(hi, math.floor(high + 1e-9)), lo)
        return subspace_curve(self.first, self.second, self.wa, self.wb, (lo, max(lo, hi)), step=self.step, options=self.options)

    def shift(self, curve: SubspaceCurve) -> SubspaceShift:
        return subspace_shift(curve, start=self.start, step=self.step, options=self.options)

    def lag(self, position: Tensor | float) -> Tensor | float:
        """Seconds of b's clock at time 0 of a's."""
        return (self.start + position * self.step) * self.rate


def _sampled(tracks: Tracks, step: float, options: SynchronizeOptions) -> tuple[Tensor, Tensor]:
    if abs(tracks.step / step - 1) < 1e-6 and float((tracks.times.diff() / step - 1).abs().max()) < 1e-3:
        return tracks.x, tracks.weights  # its own frames: nothing to interpolate
    x, _, weights = smoothed(tracks, tracks.every(step), max(0.5 * step, 0.5 * tracks.step), options)
    return x, weights


def _drift(curve: SubspaceCurve, best: SubspaceShift, step: float, options: SynchronizeOptions) -> tuple[float, float]:
    """The clock rate by a line through the shifts of windows, and its sigma; 1 unless it differs significantly."""
    assert curve.bodies is not None
    first, second = curve.bodies
    lag, reach = round(best.position), round(options.different.near / step)
    begin, end = max(0, reach - lag), min(len(first.rows), len(second.rows) - lag)
    size = min(round(options.different.window / step), (end - begin) // 4)
    found = []
    for start in range(begin, end - size + 1, size):
        parts = _cut(first, start, start + size), _cut(second, start + lag - reach, start + lag + size + reach)
        local = subspace_shift(bodies_curve(*parts, (0, 2 * reach), step, options=options), step=1.0, options=options)
        if math.isfinite(local.sigma) and local.probability > options.different.likely and 1 < local.position < 2 * reach - 1:
            found.append((start + size / 2, local.position, max(local.sigma, options.different.spread)))
    if len(found) < 3:
        return 1.0, math.inf
    times, shifts, sigmas = torch.tensor(found, dtype=torch.float64).unbind(1)
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
    return (1 + drift, sigma) if abs(drift) > options.different.significant * sigma else (1.0, sigma)


def _cut(body: Body, start: int, end: int) -> Body:
    part = slice(start, min(end, len(body.rows)))
    return dataclasses.replace(body, rows=body.rows[part], motion=body.motion[part], weights=body.weights[part])


def _rate(a: Tracks, b: Tracks, step: float, span: float, lag: Tensor | float, options: SynchronizeOptions) -> tuple[float, float]:
    """The clock rate whose best score near a shift is highest, by the parabola over rates, and its sigma; 1 unless convincing."""
    change = 4 * step / span  # moves the ends of the overlap by two steps
    count = math.ceil(options.input.frame_rate_error / change)
    rates = [1 + k * change for k in range(-count, count + 1)]
    middle = span / 2
    best = []
    for rate in rates:
        samples = _Samples(a, b, step, rate, options=options)
        # the moment in the middle keeps its place: (t + lag) of the old rate is rate (t + lag') of the new
        around = float(lag) - (rate - 1) * middle
        best.append(float(samples.curve(options.different.near, around).scores.nan_to_num(-math.inf).max()))
    scores = torch.tensor(best, dtype=torch.float64)
    top = int(scores.argmax())
    bend = float(scores[top - 1] - 2 * scores[top] + scores[top + 1]) if 0 < top < len(rates) - 1 else 0.0
    if not (math.isfinite(bend) and bend < 0):
        return 1.0, 0.0
    sigma = change / math.sqrt(-bend)
    place = 0.5 * float(scores[top - 1] - scores[top + 1]) / bend
    if best[top] - best[count] < options.different.convincing:
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
