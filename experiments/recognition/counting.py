"""How many repetitions there are in a set of 5 to 30, done by somebody else and seen from another side.

    python -m experiments.recognition.counting

Learned from one clip per action and person, seen at azimuth 0; asked of sets of one action by other people, seen from azimuth 0 and
90 by a noisy detector that loses joints.  *In a row*: one repetition touches the next.  *With rests*: the person stands for .6 to
1.5 s between them; actions that are cycles (walk, run, jumping jacks) come in bouts of three, and all their cycles count.  What the
recording holds is found by the indexer (:meth:`~indexing.ActionIndexer.decode`), so that a wrong label costs what it hides.

All ways of counting are given the same events.  *Events*: their number.  *Counted*: :func:`~indexing.recordings.repetitions.
count_repetitions`.  *Peaks* of the first principal component of the poses, at least half of its range high.  *Autocorrelation*: how
long the events last, by the time after which poses come back.  *Phase*: the turns of PhaseIndexer's phase, where its course turns.
*Counted, true events*: as if every set were found as a whole, to tell apart what finding costs.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.signal import find_peaks

from experiments.common.runner import BaseConfig, Grid, Tables, experiment
from experiments.common.tables import Row, note
from experiments.recognition.protocol import Array
from indexing import ActionIndexer, Clip, PhaseIndexer
from indexing.actors import ACTIONS, Person, dataset, detect, perform, stream
from indexing.recordings.repetitions import count_repetitions
from indexing.scoring import Event
from indexing.windows import concatenate_clips, sample

TURNS = (0, 90)
ONCE = ("sit_down", "stand_up")  # cannot be repeated without the other between
CYCLES = ("walk", "run", "jumping_jack")
BOUT = 3  # cycles in each part of a set with rests
FEWEST, MOST = 5, 30
GOAL = 0.9
RATE = 15.0  # samples per second that the peers see
SHORTEST, LONGEST = 0.4, 4.0  # seconds of a repetition, for the peers
Kind = Literal["in a row", "with rests"]
KINDS: tuple[Kind, ...] = ("in a row", "with rests")
WAYS = ("events", "counted", "peaks", "autocorrelation", "phase", "counted, true events")


@dataclass(frozen=True)
class RepeatedSet:
    """One set in one view: how often the action is done, and when it begins and ends."""

    action: str
    kind: Kind
    turn: int
    clip: Clip
    count: int
    inside: tuple[float, float]


@dataclass(frozen=True)
class Config(BaseConfig):
    """Repetitions of synthetic actors, counted."""

    people: tuple[int, ...] = (1, 3)
    """How many people are learned from, a clip of each action by each."""
    sets: int = 1
    """Sets per action, kind and seed, a person each."""
    seeds: int = 2
    """Repetitions with other people everywhere."""
    first: int = 100
    """First seed: parameters were chosen on seeds below 100."""
    actions: tuple[str, ...] = ACTIONS
    """Which actions."""


# ---- sets --------------------------------------------------------------------------------------------------------------
def repeated(action: str, kind: Kind, rng: np.random.Generator) -> Iterator[RepeatedSet]:
    """One set in every view."""
    person, count = Person.random(rng), int(rng.integers(FEWEST, MOST + 1))
    if kind == "in a row":
        solid = perform(action, person, repeats=count, rng=rng)
        inside = (0.0, solid.duration)
    else:
        each = BOUT if action in CYCLES else 1
        bouts = max(2, round(count / each))
        solid, truth = stream([action] * bouts, person, rng=rng, repeats=each if action in CYCLES else None)
        count, inside = bouts * each, (truth[0][1], truth[-1][2])
    for turn in TURNS:
        yield RepeatedSet(action, kind, turn, detect(solid, azimuth=turn, rng=rng), count, inside)


def repeated_sets(actions: Sequence[str], number: int, seed: int) -> list[RepeatedSet]:
    """All kinds of sets, ``number`` of each."""
    kinds = [(action, kind) for action in actions for kind in KINDS if kind != "in a row" or action not in ONCE]
    return [
        one
        for which, (action, kind) in enumerate(kinds)
        for take in range(number)
        for one in repeated(action, kind, np.random.default_rng([seed, which, take, 2]))
    ]


# ---- peers -------------------------------------------------------------------------------------------------------------
def poses(clip: Clip, spans: Sequence[tuple[float, float]]) -> list[Array]:
    """``(samples, joints * 2)`` of each span, at an even rate, about their centre."""
    source, out = concatenate_clips([clip]), []
    for start, end in spans:
        count = max(2, round((end - start) * RATE))
        x = sample(source, np.zeros(1, int), np.array([start]), np.array([end]), count)[0].double().numpy()
        out.append((x - x.mean(axis=1, keepdims=True)).reshape(count, -1))
    return out


def merged_spans(events: Sequence[Event], bridge: float = 2.0) -> list[tuple[float, float]]:
    """Where events follow each other within ``bridge`` seconds, they are one span."""
    spans: list[tuple[float, float]] = []
    for one in sorted(events, key=lambda event: event.start):
        if spans and one.start - spans[-1][1] <= bridge:
            spans[-1] = spans[-1][0], max(spans[-1][1], one.end)
        else:
            spans.append((one.start, one.end))
    return spans


def peaks(x: Array) -> int:
    """Peaks of the first principal component; of its two signs the one with fewer."""
    course = x - x.mean(axis=0)
    along = course @ np.linalg.svd(course, full_matrices=False)[2][0]
    low, high = np.percentile(along, [5, 95])
    return min(
        len(find_peaks(sign * along, prominence=0.5 * (high - low), distance=max(1, round(SHORTEST * RATE / 2)))[0])
        for sign in (-1.0, 1.0)
    )


def autocorrelated(x: Array) -> int:
    """The duration over the period at the first high peak of the autocorrelation."""
    course = x - x.mean(axis=0)
    low, high = round(SHORTEST * RATE), min(round(LONGEST * RATE), len(x) // 2)
    if high <= low + 2:
        return 1
    energy = max(float((course * course).sum()) / len(x), 1e-30)
    like = np.array([(course[k:] * course[: len(x) - k]).sum() / (len(x) - k) / energy for k in range(high + 1)])
    found = find_peaks(like[low:])[0] + low
    if not len(found):
        return 1
    best = next(k for k in found if like[k] >= 0.8 * like[found].max())
    return max(1, round(len(x) / best))


def turns_of(phase: PhaseIndexer, clip: Clip, action: str, spans: Sequence[tuple[float, float]]) -> float:
    """Turns of the action's phase in the spans, to the nearest whole each; NaN where its course does not turn."""
    column = phase.classes_.tolist().index(action)
    if not phase.periodic_[column]:
        return np.nan
    values, total = phase.phase(clip)[:, column], 0
    for start, end in spans:
        part = values[(clip.times >= start) & (clip.times <= end)]
        part = part[np.isfinite(part)]
        if len(part) > 1:
            total += abs(round(float(np.unwrap(2 * np.pi * part)[-1] - 2 * np.pi * part[0]) / (2 * np.pi)))
    return float(total)


# ---- counting ----------------------------------------------------------------------------------------------------------
def counts(one: RepeatedSet, events: Sequence[Event], exemplars: dict[str, list[Clip]], phase: PhaseIndexer) -> list[float]:
    """What each of WAYS counts; the action's events are what was found of it, the others are neighbours."""

    def ours(found: Sequence[Event]) -> float:
        return float(sum(each.count for each in count_repetitions(one.clip, found, exemplars) if each.label == one.action))

    mine = [event for event in events if event.label == one.action]
    spans = merged_spans(mine)
    seen = poses(one.clip, spans)
    return [
        float(len(mine)),
        ours(events),
        float(sum(map(peaks, seen))),
        float(sum(map(autocorrelated, seen))),
        turns_of(phase, one.clip, one.action, spans),
        ours([Event(one.action, *one.inside, 1.0, 1.0)]),
    ]


def measure(config: Config, people: int) -> dict[tuple[str, Kind, int], Array]:
    """``(sets, ways)`` errors, and the share of the events that have another label in the last column, by action, kind and view."""
    found: dict[tuple[str, Kind, int], list[list[float]]] = {}
    for seed in range(config.first, config.first + config.seeds):
        rng = np.random.default_rng([seed, people, 1])
        learned = dataset(people, config.actions, azimuth=0.0, rng=rng)
        indexer = ActionIndexer(random_state=seed).fit(learned, learned.labels)
        phase = PhaseIndexer(window=0.5).fit(learned, learned.labels)
        exemplars: dict[str, list[Clip]] = {}
        for clip in learned:
            exemplars.setdefault(str(clip.label), []).append(clip)
        for one in repeated_sets(config.actions, config.sets, seed):
            events = indexer.find(one.clip)
            other = float(np.mean([event.label != one.action for event in events])) if events else 1.0
            errors = [value - one.count for value in counts(one, events, exemplars, phase)]
            found.setdefault((one.action, one.kind, one.turn), []).append([*errors, other])
    return {key: np.array(values) for key, values in found.items()}


def within_one(errors: Array) -> list[float]:
    """Share of the sets counted to within one, for each way; NaN where there is none."""
    known: Array = np.asarray(np.isfinite(errors))
    right = (np.abs(np.where(known, errors, np.inf)) <= 1).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    return [float(v) if any_known else np.nan for v, any_known in zip(right, np.atleast_1d(known.any(axis=0)), strict=True)]


def learned_from(found: dict[tuple[str, Kind, int], Array], people: int) -> Tables:
    """Shares counted to within one, by kind and view and by action, and the mean absolute errors."""
    who = "one person" if people == 1 else f"{people} people"
    shares, off = {}, {}
    rows = []
    for kind in KINDS:
        for turn in TURNS:
            errors = np.concatenate([value for (_, one, view), value in found.items() if (one, view) == (kind, turn)])[:, :-1]
            name = f"{kind}, {turn}°"
            known = np.isfinite(errors)
            total = np.where(known, np.abs(errors), 0.0).sum(axis=0)
            mean = np.where(known.any(axis=0), total / np.maximum(known.sum(axis=0), 1), np.nan)
            shares[name], off[name] = within_one(errors), mean.tolist()
            rows.append(Row(name, f"counted within one, learned from {who}", shares[name][WAYS.index("counted")], GOAL))
    yield f"share of the sets counted to within one, learned from {who}", Grid(WAYS, shares, rows)
    yield f"mean absolute error, learned from {who}", Grid(WAYS, off)
    each = {
        f"{action}, {turn}°": [
            within_one(np.concatenate([found[action, kind, turn] for kind in KINDS if (action, kind, turn) in found])[:, :-1])[k]
            for k in (WAYS.index("counted"), WAYS.index("counted, true events"))
        ]
        + [float(np.concatenate([v[:, -1] for (a, _, view), v in found.items() if (a, view) == (action, turn)]).mean())]
        for action in dict.fromkeys(action for action, _, _ in found)
        for turn in TURNS
    }
    yield f"by action, learned from {who}", Grid(["counted", "counted, true events", "events of other labels"], each)


@experiment(Config(), quick={"people": (1,), "seeds": 1, "actions": ACTIONS[:2]})
def tables(config: Config) -> Tables:
    """Repetitions of synthetic actors, counted.

    Raises:
        ValueError: an action that actors do not know.
    """
    unknown = [action for action in config.actions if action not in ACTIONS]
    if unknown or len(config.actions) < 2:
        raise ValueError(f"actions: give two or more of {', '.join(ACTIONS)}, got {', '.join(config.actions)}")
    for people in config.people:
        note(f"... learned from {people}")
        yield from learned_from(measure(config, people), people)
