"""Whether the row spaces of two cameras that see different points decide a lag, and which tracks have no part in the motion."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyntorch.tasks.synchronize.camera_models import Films, Hypothesis, Kind, KindMoments, Place, hypotheses, kind_moments, refined
from dyntorch.tasks.synchronize.options import SynchronizeOptions
from dyntorch.tasks.synchronize.tracks import Tracks


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
    foreign: tuple[Tensor, Tensor]  # tracks of a and of b ``(n,)``, ``(m,)`` bool that were left out
    options: SynchronizeOptions

    @property
    def ok(self) -> bool:
        """Whether the lag is beyond doubt."""
        return _decided(self.clearness, self.votes, self.options)

    @property
    def strength(self) -> float:
        """Clearness over what its votes need: 1 decides."""
        return _strength(self.clearness, self.votes, self.options)

    @property
    def peaks(self) -> Tensor:
        """``(k, 2)`` lag in seconds and score of local maxima, best first, the first one between frames."""
        scores, kept = self.curve.totals, list[int]()
        for place in scores.argsort(descending=True)[: self.options.rows.looked_at].tolist():
            away = all(abs(float(self.curve.lags[place] - self.curve.lags[other])) > self.curve.apart for other in kept)
            if away and math.isfinite(float(scores[place])):
                kept.append(place)
        kept = kept[: self.options.different.peaks]
        found = torch.stack([self.seconds[kept], scores[kept]], dim=1)
        found[0, 0] = self.lag
        return found

    @property
    def confidence(self) -> float:
        """Probability that the lag is right, from how clear it is."""
        return _sigmoid((_strength(self.clearness, self.votes, self.options) - 1) * self.options.rows.odds + math.log(19))

    def turned(self, rate: float) -> RowSpaceShift:
        """The same with a and b exchanged; ``rate`` of the new b's clock."""
        lag, sigma, seconds = -self.lag * rate, self.sigma * rate, -self.seconds * rate
        return replace(self, lag=lag, sigma=sigma, seconds=seconds, foreign=(self.foreign[1], self.foreign[0]))


def _strength(clearness: float, votes: float, options: SynchronizeOptions) -> float:
    """Clearness over what these votes need: 1 decides."""
    return clearness / (options.rows.clear + (1 - votes) * options.rows.alone)


def _decided(clearness: float, votes: float, options: SynchronizeOptions) -> bool:
    return _strength(clearness, votes, options) >= 1


def _sigmoid(x: float) -> float:
    return 1 / (1 + math.exp(-max(min(x, 700.0), -700.0)))


def row_space_shift(
    a: Tracks, b: Tracks, *, step: float, rate: float, max_shift: float | None, around: float = 0.0, options: SynchronizeOptions
) -> RowSpaceShift | None:
    """The clearest lag between two cameras' row spaces; None where none can be judged."""
    if a.still or b.still:
        return None
    if b.x.shape[-1] == 3:  # what is looked at between frames is the second, and a camera is the shorter take of fewer points
        back = {"step": step * rate, "rate": 1 / rate, "around": -around / rate}
        other = row_space_shift(b, a, max_shift=max_shift, options=options, **back)
        return None if other is None else other.turned(rate)
    films = Films(a, b, step, rate, options)
    films = films.completed if films.spatial else films
    ta, tb = films.times
    if min(len(ta), len(tb)) < 3:
        return None
    start = float(tb[0]) / rate - float(ta[0])
    lags = _span(films, start, max_shift, around / rate, options)
    if lags is None:
        return None
    kinds = kind_moments(films, lags)
    found = hypotheses(kinds)
    if not found:
        return None
    best, votes = _chosen(found)
    kept = tuple(torch.ones(x.x.shape[1], dtype=torch.bool, device=x.x.device) for x in (a, b))
    if options.rows.hopeful < _strength(best.clearness, votes, options) < 1:
        without = _left_out(kinds, best, options)
        if without is not None:
            fewer = hypotheses([one.only(*without) for one in kinds])
            chosen, agree = _chosen(fewer)
            if _strength(chosen.clearness, agree, options) > options.rows.gain * _strength(best.clearness, votes, options):
                best, votes, kept, found = chosen, agree, without, fewer
    kind, place = _plainest(films.only(*kept), found, best)
    seconds = (start + best.lags * step) * rate
    lag, sigma, foreign = (start + place.lag * step) * rate, place.sigma * step * rate, (~kept[0], ~kept[1])
    return RowSpaceShift(lag, sigma, kind, best.clearness, votes, best.margin, best, seconds, foreign, options)


def _span(
    films: Films, start: float, max_shift: float | None, around: float, options: SynchronizeOptions
) -> tuple[int, int] | None:
    """First and last lag, frames."""
    ta, tb = films.times
    lo, hi = 1 - len(ta), len(tb) - 1
    if max_shift is not None:
        low, high = ((sign * max_shift / films.rate - start) / films.step for sign in (-1, 1))
        lo, hi = max(lo, math.ceil(low - 1e-9)), min(hi, math.floor(high + 1e-9))
    if hi - lo >= options.rows.most_lags:
        middle = min(max(round((around - start) / films.step), lo), hi)
        lo, hi = max(lo, middle - options.rows.most_lags // 2), min(hi, middle + options.rows.most_lags // 2)
    return (lo, hi) if hi - lo >= 2 else None


def _chosen(found: list[Hypothesis]) -> tuple[Hypothesis, float]:
    """The clearest, and the share of all that say the same lag."""
    best = max(found, key=lambda one: one.clearness)
    place = float(best.lags[best.best])
    return best, sum(abs(float(one.lags[one.best]) - place) <= best.apart for one in found) / len(found)


def _plainest(films: Films, found: list[Hypothesis], best: Hypothesis) -> tuple[Kind, Place]:
    """Of the kinds that say the same lag, the one with most nats at its place: cameras as they are leave but noise
    unexplained."""
    lag = float(best.lags[best.best])
    same = [one for one in found if abs(float(one.lags[one.best]) - lag) <= best.apart]
    fixed = [one for one in same if one.kind == "affine"]
    chosen = [
        max(part, key=lambda one: float(one.totals[one.best])) for part in (fixed, [x for x in same if x not in fixed]) if part
    ]
    places = [(one.kind, refined(films, one)) for one in chosen]
    kind, first = max(places, key=lambda pair: pair[1].nats)
    rivals = [place for _, place in places if place.nats > films.options.rows.nearly * first.nats]
    apart = max((abs(place.lag - first.lag) for place in rivals), default=0.0) / 2
    return kind, replace(first, sigma=math.hypot(first.sigma, apart))


def _left_out(kinds: list[KindMoments], best: Hypothesis, options: SynchronizeOptions) -> tuple[Tensor, Tensor] | None:
    """Tracks of a and of b ``(n,)``, ``(m,)`` bool that are left when those go, one by one, without which a lag stands out more."""
    counts = [kinds[0].films.a.x.shape[1], kinds[0].films.b.x.shape[1]]
    kept = [torch.ones(count, dtype=torch.bool) for count in counts]
    tried = [one for one in kinds if one.kind == best.kind]
    clearest = best.clearness
    for _ in range(math.ceil(options.rows.foreign * max(counts))):
        found: tuple[float, int, int] | None = None
        for side in (1,) if kinds[0].films.spatial else (0, 1):
            if int(kept[side].sum()) <= max(options.rows.fewest, (1 - options.rows.foreign) * counts[side]):
                continue
            for point in kept[side].nonzero()[:, 0].tolist():
                rest = [mask.clone() for mask in kept]
                rest[side][point] = False
                clear = max(
                    (h.clearness for one in tried if (h := one.only(*rest).hypothesis(best.level)) is not None), default=0.0
                )
                if found is None or clear > found[0]:
                    found = clear, side, point
        if found is None or found[0] < clearest * options.rows.gain:
            break
        clearest = found[0]
        kept[found[1]][found[2]] = False
    return (kept[0], kept[1]) if not all(bool(mask.all()) for mask in kept) else None
