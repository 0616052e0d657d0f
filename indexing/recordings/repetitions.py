"""How often an action is performed, how long each time, with which pauses and how far: counted by the movement itself.

The heights of the joints hardly depend on where the camera stands, so an exemplar's heights say what to look for.  Its course is
followed through the recording as often as it is there, with rests between (dynamic programming over a loop); then it is learned
anew from what was found, in the recording's own view, and followed again.  Where exemplars repeat themselves, their cycles count.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from indexing.action.exemplars import mirror_permutation
from indexing.clip import Clip
from indexing.scoring import Event
from indexing.windows import Ragged, concatenate_clips, resample_clips, sample

Array = NDArray[Any]
Unit = Literal["performance", "cycle"]


# chosen on synthetic actors, other people than those of any acceptance set
SAMPLE_RATE = 15.0  # per second, that movements are compared at
SPAN_MARGIN = 0.5  # seconds looked at before the first and after the last event of a span
MAX_EVENT_GAP = 4.0  # seconds between events of one label, without another label between them, that are one span
MAX_EXEMPLARS = 4  # that are asked, spread over those given
# 1 - correlation of changes of pose a period later: actors' gait .1-.5, jacks .02-.1, single movements mostly above .6
MAX_PERIODIC_DEPTH = 0.55
# the same over any half cycle of an exemplar made of cycles: walks below .56, runs and jacks .71, punches above .84
MAX_WORST_DEPTH = 0.75
# times the longest exemplar without rest, from which what repeats inside is counted; a first guess, as the next three
MIN_UNBROKEN_FACTOR = 1.6
MAX_INNER_CYCLE = 0.6  # of the shortest exemplar; of key poses, punches in a row .4, swings of a wave .25
REST_SPEED = 0.35  # of the usual speed of the joints (80 % of the time slower)
MIN_REST_SECONDS = 0.3
MIN_CYCLE_SECONDS = 0.4
MAX_CYCLE_SECONDS = 4.0
VELOCITY_SECONDS = 0.15  # that velocities are multiplied by beside heights: down and up differ
DURATION_SCALES = (0.75, 1.0, 1.33)  # that are tried, times the exemplar's
NUM_STARTS = 3  # best beginnings that are learned on
NUM_ROUNDS = 4  # times that the course is learned anew
# of a sample, in variances of the movement, while the exemplar is another person's; at 1 lunges to the camera are missed
FIRST_UNEXPLAINED_COST = 2.0
UNEXPLAINED_COST = 1.0  # the same once it was learned anew
CYCLES_COST = 2.0  # of beginning a run of cycles
PERFORMANCE_COST = 1.0  # of beginning a performance
TEMPO_COST = 0.08  # of a sample at half or twice the tempo
JOINT_NOISE = 0.01  # body heights
MAX_STRETCH = 1.6  # of a course while it is learned anew; without a bound one slow course explains all


@dataclass(frozen=True)
class Repetition:
    """One performance or cycle: start and end in seconds; range: the farthest that any joint goes up or down meanwhile."""

    start: float
    end: float
    range: float


@dataclass(frozen=True)
class RepetitionCount:
    """All repetitions of one action.  unit: ``"performance"``, one exemplar's worth; ``"cycle"`` where exemplars repeat it."""

    label: Any
    performances: tuple[Repetition, ...]
    unit: Unit = "performance"

    @property
    def count(self) -> int:
        """How many."""
        return len(self.performances)

    @property
    def durations(self) -> tuple[float, ...]:
        """Seconds of each."""
        return tuple(one.end - one.start for one in self.performances)

    @property
    def pauses(self) -> tuple[float, ...]:
        """Seconds between one and the next."""
        return tuple(max(0.0, after.start - before.end) for before, after in pairwise(self.performances))

    @property
    def ranges(self) -> tuple[float, ...]:
        """Of each, see :class:`Repetition`."""
        return tuple(one.range for one in self.performances)


def count_repetitions(
    clip: Clip,
    events: Sequence[Event],
    exemplars: Mapping[Any, Sequence[Clip]] = {},
) -> list[RepetitionCount]:
    """Count what was found in a recording, one entry per label in order of the labels' first performance."""
    if not events:
        return []
    counts, repaired = [], _Repaired.of(clip)
    for label in dict.fromkeys(event.label for event in sorted(events, key=lambda event: event.start)):
        mine = sorted((event for event in events if event.label == label), key=lambda event: event.start)
        given = list(exemplars.get(label, ()))
        for shown in given:
            if shown.joints.shape[1] != clip.joints.shape[1]:
                raise ValueError(
                    f"exemplars of {label!r}: {shown.joints.shape[1]} joints, but the recording has {clip.joints.shape[1]}; "
                    "use clips of one joint layout"
                )
        pick: list[int] = (
            np.unique(np.linspace(0, len(given) - 1, min(len(given), MAX_EXEMPLARS)).round().astype(int)).tolist() if given else []
        )
        shown_clips = [given[i] for i in pick] or _event_exemplars(clip, mine)
        pattern = _pattern(shown_clips)
        spans = _spans(mine, events)
        tracks = [_track(repaired, start, end) for start, end, _ in spans]
        pattern = _inner_pattern(tracks, pattern)
        performances: list[Repetition] = []
        for track, (_, _, inside) in zip(tracks, spans, strict=True):
            performances += _count_span(track, inside, pattern)
        counts.append(RepetitionCount(label, tuple(performances), "cycle" if pattern.period else "performance"))
    return sorted(counts, key=lambda one: one.performances[0].start if one.performances else np.inf)


def _event_exemplars(clip: Clip, events: Sequence[Event]) -> list[Clip]:
    """Events of usual length, as exemplars."""
    ordered = sorted(events, key=lambda event: event.end - event.start)
    middle = ordered[max(0, len(ordered) // 2 - 1) : len(ordered) // 2 + 1]
    parts = [(event.start, event.end) for event in middle if ((clip.times >= event.start) & (clip.times <= event.end)).sum() > 1]
    return [clip.between(*part) for part in parts]


def _spans(mine: Sequence[Event], events: Sequence[Event]) -> list[tuple[float, float, list[Event]]]:
    """Neighbouring events of one label as one span, kept apart from those of other labels."""
    others = [event for event in events if event.label != mine[0].label]
    groups: list[list[Event]] = []
    for event in mine:
        last = max((one.end for one in groups[-1]), default=-np.inf) if groups else -np.inf
        between = any(last <= (one.start + one.end) / 2 <= event.start for one in others)
        if event.start - last <= MAX_EVENT_GAP and not between:
            groups[-1].append(event)
        else:
            groups.append([event])
    out = []
    for group in groups:
        first, last = group[0].start, max(one.end for one in group)
        before = max([one.end for one in others if one.end <= first] + [first - SPAN_MARGIN])
        after = min([one.start for one in others if one.start >= last] + [last + SPAN_MARGIN])
        out.append((before, after, group))
    return out


# ---- movements ---------------------------------------------------------------------------------------------------------
class _RepeatedTrack(NamedTuple):
    """A recording at an even rate: times ``(F,)``, heights ``(F, n)``, poses ``(F, n * dims)``, in body heights."""

    times: Array
    heights: Array
    poses: Array


class _Cycle(NamedTuple):
    """An exemplar: its heights, and those of its left-right mirror image."""

    heights: Array
    swap: Array | None


class _Pattern(NamedTuple):
    """What is looked for: exemplars (one cycle each where there is a period), and the period in seconds."""

    shown: tuple[_Cycle, ...]
    period: float


class _Repaired(NamedTuple):
    """A recording without what is missing or wrong, and how tall the person is in it: found once, however many spans it has."""

    source: Ragged
    size: float

    @classmethod
    def of(cls, clip: Clip) -> _Repaired:
        source = concatenate_clips([clip], repair=True)
        y = source.joints[:, source.seen[0], 1]
        return cls(source, max(float(np.median(y.max(axis=1) - y.min(axis=1))), 1e-9) if y.shape[1] else 1.0)


def _track(repaired: _Repaired, start: float, end: float) -> _RepeatedTrack:
    source, size = repaired
    start, end = max(start, float(source.times[0])), min(end, float(source.times[-1]))
    count = max(1, round((end - start) * SAMPLE_RATE))
    x = sample(source, np.zeros(1, int), np.array([start]), np.array([end]), count)[0].double().numpy() / size
    x = x - x.mean(axis=1, keepdims=True)
    if count > 2:
        padded = np.concatenate([x[:1], x, x[-1:]])
        x = (padded[:-2] + 2 * padded[1:-1] + padded[2:]) / 4
    times = start + (np.arange(count) + 0.5) * (end - start) / count
    return _RepeatedTrack(times, x[..., 1], x.reshape(count, -1))


def _with_velocities(values: Array) -> Array:
    """Positions beside velocities."""
    if len(values) < 2:
        return np.concatenate([values, np.zeros_like(values)], axis=1)
    return np.concatenate([values, VELOCITY_SECONDS * SAMPLE_RATE * np.gradient(values, axis=0)], axis=1)


def _period(poses: Array, shortest: float, longest: float) -> tuple[float, float, float]:
    """Seconds after which changes of pose come back, how far from it they remain (1 = they do not), and where it is worst."""
    count = len(poses)
    x = poses[4:] - poses[:-4] if count > 8 else poses[:0]
    low, high = round(shortest * SAMPLE_RATE), min(round(longest * SAMPLE_RATE), 2 * count // 3, len(x) - 2)
    if high <= low + 2:
        return 0.0, 1.0, 1.0
    energy = np.square(x).sum(axis=1)
    depth = np.array(
        [
            1 - 2 * (x[k:] * x[: len(x) - k]).sum() / max(energy[k:].sum() + energy[: len(x) - k].sum(), 1e-30)
            for k in range(high + 1)
        ]
    )
    dips = [k for k in range(max(low, 1), high) if depth[k] <= depth[k - 1] and depth[k] < depth[k + 1]]
    if not dips:
        return 0.0, 1.0, 1.0
    level = max(1.3 * min(depth[k] for k in dips), MAX_PERIODIC_DEPTH / 2)
    best = next(k for k in dips if depth[k] <= level)
    box, most = np.ones(min(max(1, best // 2), len(x) - best)), energy[best:] + energy[: len(x) - best]
    worst = np.convolve(np.square(x[best:] - x[: len(x) - best]).sum(axis=1), box, "valid") / np.maximum(
        np.convolve(most, box, "valid"), 1e-30
    )
    return best / SAMPLE_RATE, float(depth[best]), float(worst.max())


def _detect_rest(track: _RepeatedTrack) -> Array:
    """``(F,)`` where the joints rest."""
    wide = max(1, round(MIN_REST_SECONDS * SAMPLE_RATE))
    if len(track.times) < 2 * wide:
        return np.zeros(len(track.times), bool)
    speed = np.sqrt(np.convolve(np.square(np.gradient(track.poses, axis=0)).sum(axis=1), np.ones(wide) / wide, "same"))
    slow = speed < REST_SPEED * np.quantile(speed, 0.8)
    for first, end in _stretches(slow):
        slow[first:end] = end - first >= wide
    return slow


def _stretches(on: Array) -> Array:
    """``(n, 2)`` first sample, and the one after the last, of every run."""
    return np.flatnonzero(np.diff(np.concatenate([[False], on, [False]]).astype(int))).reshape(-1, 2)


def _longest_motion(track: _RepeatedTrack) -> slice:
    """The longest part without a rest."""
    parts = _stretches(~_detect_rest(track))
    return slice(*parts[(parts[:, 1] - parts[:, 0]).argmax()]) if len(parts) else slice(0, len(track.times))


def _inner_pattern(tracks: Sequence[_RepeatedTrack], pattern: _Pattern) -> _Pattern:
    """A movement that goes on for longer than its exemplars, because it repeats a part of them, is counted by that part."""
    if pattern.period or not pattern.shown:
        return pattern
    lasts = [len(one.heights) / SAMPLE_RATE for one in pattern.shown]
    part = max((track.poses[_longest_motion(track)] for track in tracks), key=len)
    if len(part) < MIN_UNBROKEN_FACTOR * max(lasts) * SAMPLE_RATE:
        return pattern
    seconds, depth, _ = _period(part, MIN_CYCLE_SECONDS, MAX_INNER_CYCLE * min(lasts))
    return _Pattern((), seconds) if depth <= MAX_PERIODIC_DEPTH else pattern


def _pattern(shown: Sequence[Clip]) -> _Pattern:
    """What exemplars show, and whether they repeat it."""
    parts = []
    for clip in shown:
        track = _track(_Repaired.of(clip), float(clip.times[0]), float(clip.times[-1]))
        source = concatenate_clips([clip])
        swap = (
            mirror_permutation(clip.skeleton, resample_clips(source, 12)) if clip.dims == 2 or clip.skeleton is not None else None
        )
        seconds, depth, worst = _period(track.poses, MIN_CYCLE_SECONDS, MAX_CYCLE_SECONDS)
        depth = depth if worst <= MAX_WORST_DEPTH else 1.0
        parts.append((track.heights, None if swap is None else swap.numpy(), seconds, depth))
    sure = [seconds for _, _, seconds, depth in parts if depth <= MAX_PERIODIC_DEPTH]
    usual = float(np.median(sure)) if sure else 0.0
    # an exemplar of about one cycle cannot tell
    able = [
        depth <= MAX_PERIODIC_DEPTH
        for h, _, _, depth in parts
        if sure and (depth <= MAX_PERIODIC_DEPTH or len(h) > 2.2 * usual * SAMPLE_RATE)
    ]
    if not able or np.mean(able) < 0.5:
        return _Pattern(tuple(_Cycle(h, swap) for h, swap, _, _ in parts if len(h) > 3), 0.0)
    cycles = [_Cycle(_mean_cycle(h, seconds), swap) for h, swap, seconds, depth in parts if depth <= MAX_PERIODIC_DEPTH]
    return _Pattern(tuple(cycles), usual)


def _mean_cycle(heights: Array, seconds: float) -> Array:
    m = max(4, round(seconds * SAMPLE_RATE))
    phase = np.arange(len(heights)) / (SAMPLE_RATE * seconds)
    phase_distance = (phase[:, None] - np.arange(m) / m + 0.5) % 1.0 - 0.5
    weight = np.exp(-0.5 * np.square(phase_distance * m)) + 1e-9
    return np.asarray((weight / weight.sum(axis=0)).T @ heights)


def _resample(course: Array, m: int, turns: bool) -> Array:
    at = np.arange(m) * len(course) / m if turns else np.linspace(0, len(course) - 1, m)
    longer = np.concatenate([course, course[:1]]) if turns else course
    return np.stack([np.interp(at, np.arange(len(longer)), column) for column in longer.T], axis=1)


# ---- following a course through a recording ----------------------------------------------------------------------------
def _costs(x: Array, course: Array, turns: bool, level: float, left: Array | None, still: Array) -> tuple[Array, Array]:
    """``(F, m)`` cost of every sample at every place of the course, and ``(F,)`` at rest; joints count by what they tell."""
    spread = course.var(axis=0)
    doubt = np.full(len(spread), JOINT_NOISE**2) if left is None else np.maximum(left, JOINT_NOISE**2)
    weight = spread / (spread + doubt)
    scale = np.sqrt(weight / max((weight * spread).sum(), 1e-12))
    a, b = x * scale, course * scale
    cost = np.maximum(np.square(a).sum(1)[:, None] + np.square(b).sum(1) - 2 * a @ b.T, 0)
    rest = np.full(len(x), level)
    if turns:
        cost[still], rest[still] = cost[still] + level, 0.0
    else:
        pose = (b[0] + b[-1]) / 2
        pose[len(pose) // 2 :] = 0
        rest = np.minimum(rest, np.square(a - pose).sum(axis=1))
    return cost, rest


def _follow_course(cost: Array, rest: Array, turns: bool) -> tuple[float, Array]:
    """The cheapest way, and ``(F,)`` the place of every sample; m = at rest."""
    count, m = cost.shape
    begin = CYCLES_COST if turns else PERFORMANCE_COST
    place, back = np.arange(m), np.zeros((count, m + 1), int)
    before = np.stack([place, (place - 1) % m, (place - 2) % m, np.full(m, m)])
    total, after = np.append(cost[0] + begin if turns else np.full(m, np.inf), rest[0]), np.empty(m + 1)
    total[0] = cost[0, 0] + begin
    ways = np.full((4, m), np.inf)  # what is not written below stays so; made once, as frames are many and places few
    for f in range(1, count):
        came, idle = total[:m], total[m]
        np.add(came, TEMPO_COST, out=ways[0])
        ways[1, 1:] = came[:-1]
        np.add(came[:-2], TEMPO_COST, out=ways[2, 2:])
        if turns:
            ways[1, 0], ways[2, :2], ways[3] = came[-1], came[-2:] + TEMPO_COST, idle + begin
        else:
            ways[3, 0] = min(idle + begin, came[-1] + begin / 2)
        way = ways.argmin(axis=0)
        source = before[way, place]
        if not turns and way[0] == 3 and came[-1] + begin / 2 < idle + begin:
            source[0] = m - 1
        last = int(came.argmin()) if turns else m - 1 if came[-1] <= came[-2] + TEMPO_COST else m - 2
        back[f, :m], back[f, m] = source, m if idle <= came[last] else last
        np.add(ways.min(axis=0), cost[f], out=after[:m])
        after[m] = min(idle, came[last]) + rest[f]
        total, after = after, total
    at = int(total.argmin()) if turns else m if total[m] <= total[m - 1] else m - 1
    best, path = float(total[at]), np.zeros(count, int)
    for f in range(count - 1, -1, -1):
        path[f], at = at, back[f, at]
    return best, path


def _runs(path: Array, m: int, turns: bool) -> list[tuple[int, Array]]:
    """First sample of every run, and its places: unwrapped phase where the course turns."""
    out = []
    for first, end in _stretches(path < m):
        part = path[first:end]
        step = np.diff(part)
        if turns:
            out.append((int(first), part[0] + np.concatenate([[0], np.cumsum(np.where(step < 0, step + m, step))])))
        else:
            cuts = [0, *(np.flatnonzero(step < 0) + 1).tolist(), len(part)]
            out += [(int(first) + a, part[a:b]) for a, b in pairwise(cuts)]
    return out


def _learn_course(x: Array, path: Array, m: int) -> Array | None:
    """``(m, d)`` mean sample at every place; None where too few are known."""
    places = np.unique(path[path < m])
    if len(places) < 3:
        return None
    means = np.stack([x[path == place].mean(axis=0) for place in places])
    return np.stack([np.interp(np.arange(m), places, column) for column in means.T], axis=1)


def _even(course: Array, path: Array, turns: bool, first: int) -> Array:
    """The course with its places spread evenly over the time that samples spend at them."""
    m = len(course)
    covers = np.zeros(m)
    for _, places in _runs(path, m, turns):
        np.add.at(covers, np.arange(places[0], places[-1] + 1) % m, 1)
    spent = np.bincount(path[path < m], minlength=m) / np.maximum(covers, 1)
    used = spent > 0
    size = int(np.clip(round(spent.sum()), max(4, first / MAX_STRETCH), max(4, first * MAX_STRETCH)))
    middle = (np.cumsum(spent) - spent / 2)[used]
    whole_time, values = spent.sum(), course[used]
    at = (np.arange(size) + 0.5) * whole_time / size
    if turns:
        middle, values = np.concatenate([middle - whole_time, middle, middle + whole_time]), np.concatenate([values] * 3)
    return np.stack([np.interp(at, middle, column) for column in values.T], axis=1)


def _beginnings(track: _RepeatedTrack, pattern: _Pattern) -> list[tuple[float, Array, int]]:
    """Cost, path and length of the courses that fit best: exemplars, their mirror images, and the span's own cycle."""
    x, turns, still = _with_velocities(track.heights), pattern.period > 0, _detect_rest(track)
    starts: list[tuple[float, Array, int]] = []
    for shown in pattern.shown:
        for heights in [shown.heights] if shown.swap is None else [shown.heights, shown.heights[:, shown.swap]]:
            tried = []
            for scale in DURATION_SCALES:
                m = max(4, round(len(heights) * scale))
                course = _resample(heights, m, turns)
                course = _with_velocities(np.concatenate([course] * 3))[m : 2 * m] if turns else _with_velocities(course)
                tried.append((*_follow_course(*_costs(x, course, turns, FIRST_UNEXPLAINED_COST, None, still), turns), m))
            starts.append(min(tried, key=lambda one: one[0]))
    starts = sorted(starts, key=lambda one: one[0])[:NUM_STARTS]
    if turns:
        part = _longest_motion(track)
        seconds, depth, _ = _period(track.poses[part], max(0.3, pattern.period / 2), 2 * pattern.period)
        if depth < 0.8:
            m = max(4, round(seconds * SAMPLE_RATE))
            path = np.full(len(x), m)
            path[part] = (np.arange(part.stop - part.start) / (seconds * SAMPLE_RATE) * m).astype(int) % m
            starts.append((0.0, path, m))
    return starts


def _count_span(track: _RepeatedTrack, events: Sequence[Event], pattern: _Pattern) -> list[Repetition]:
    """The repetitions in one span; its longest event where the movement tells nothing."""
    turns, still = pattern.period > 0, _detect_rest(track)
    best: tuple[float, Array, int] | None = None
    if len(track.times) > 3:
        for _, begun, first in _beginnings(track, pattern):
            for values in (track.poses, track.heights):
                x, path, m, cost = _with_velocities(values), begun, first, np.inf
                for again in range(NUM_ROUNDS):
                    course = _learn_course(x, path, m)
                    if course is None:
                        break
                    on = path < m
                    left = np.square(x[on] - course[path[on]]).mean(axis=0)
                    course = _even(course, path, turns, first) if again else course
                    m = len(course)
                    cost, path = _follow_course(*_costs(x, course, turns, UNEXPLAINED_COST, left, still), turns)
                if best is None or cost < best[0]:
                    best = (cost, path, m)
    parts: list[tuple[float, float]] = []
    if best is not None and np.isfinite(best[0]):
        step = float(track.times[1] - track.times[0])
        for first, places in _runs(best[1], best[2], turns):
            phase = (places - places[0]) / best[2]
            cycles = int(phase[-1] + 1 / best[2] + 0.5) if turns else 1
            cuts = [first + int(np.searchsorted(phase, k)) for k in range(cycles)] + [first + len(phase)]
            if cycles and turns and phase[-1] > cycles:
                cuts[-1] = first + int(np.searchsorted(phase, cycles))
            edges = [float(track.times[0]) + step * (cut - 0.5) for cut in cuts]
            parts += list(pairwise(edges)) if cycles else []
    if not parts:
        one = max(events, key=lambda event: event.end - event.start)
        parts = [(one.start, one.end)]
    return [_repetition(track, *part) for part in parts]


def _repetition(track: _RepeatedTrack, start: float, end: float) -> Repetition:
    inside = (track.times >= start) & (track.times <= end)
    reach = float(np.ptp(track.heights[inside], axis=0).max()) if inside.any() else 0.0
    return Repetition(float(start), float(end), reach)
