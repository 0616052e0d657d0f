"""Do the labels that ``index suggest`` asks for teach more than labels of any parts?

    DYNTORCH_DATA=../shared/data python -m experiments.labels.suggesting

Somebody labels recordings a few parts at a time, and after each round a model is learned from all labels so far and asked about
recordings of other people: the share of the frames that are right.  A part is labelled with what happens in most of it, from its
true begin to its true end, at most half of its length beyond it; parts in which nothing happens are learned as background.  All
ways begin with the same two parts of two actions, drawn at random, and choose among the same kind of parts; *any*: drawn at random,
the longer the likelier.  *Each part alone*: farthest first, whatever else is like it; *however sure*: nobody asks how sure the
model is.

*Exercises*: the streams of one subject are labelled, those of the other asked; *UTKinect*: clips of four people joined to
recordings, three others asked; *actors*: synthetic people who rest 1 to 4 s between thirteen actions; there frames without an
action count, too.  All are seen from azimuth 0.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from experiments.common.runner import BaseConfig, Grid, Tables, experiment
from experiments.common.tables import note
from experiments.recognition import protocol
from experiments.recognition.detection import Recording, end_to_end
from experiments.recognition.detection_metrics import segments
from experiments.recognition.protocol import Array
from indexing import ActionIndexer, Clip
from indexing.actors import ACTIONS, Person, detect, stream
from indexing.recordings.suggesting import parts_of, suggest
from indexing.scoring import Event

SETS = Literal["exercises", "utkinect", "actors"]
NONE = ""
LONGEST = 10.0  # seconds: longer clips of UTKinect hold more than their action
BEYOND = 0.5  # of a part's length, that its label may reach beyond it
FIRST = 2.5  # seconds of the two parts that everybody begins with
WAYS = ("any", "suggested")
Marked = tuple[int, str, float, float]
"""Number of the recording, label, start and end in seconds."""


@dataclass(frozen=True)
class Config(BaseConfig):
    """What labels teach, suggested ones and any."""

    sets: tuple[SETS, ...] = ("exercises", "actors")
    """Which recordings; ``utkinect`` takes several times longer than both others."""
    counts: tuple[int, ...] = (4, 8, 16)
    """Labels after which the model is asked; as many at a time are chosen as lie between."""
    seeds: int = 3
    """Repetitions with other first labels, and other people."""


# ---- recordings --------------------------------------------------------------------------------------------------------
def recordings(name: SETS, seed: int) -> tuple[list[Recording], list[Recording]]:
    """Those that are labelled, and those that are asked about."""
    rng = np.random.default_rng([seed, 5])
    if name == "actors":
        return [performed(rng) for _ in range(3)], [performed(rng) for _ in range(2)]
    if name == "exercises":
        with np.load(protocol.data_folder() / "mocap6_exercises.npz") as file:
            names = file["action_names"]
        every = protocol.load_exercises()
        found = []
        for one in every:
            clip, true = protocol.exemplar_view(one.clip, rng), names[one.labels - 1]
            found.append(Recording(clip, segments(true, protocol.RATIO / 30.0), clip.times[one.frames], true))
        people = sorted({one.subject for one in every})
        first = people[seed % len(people)]
        mine = [one.subject == first for one in every]
        return [one for one, own in zip(found, mine, strict=True) if own], [
            one for one, own in zip(found, mine, strict=True) if not own
        ]
    clips = protocol.load_set(name)
    subjects = clips.column("subject")
    joined = []
    for person in rng.permutation(np.unique(subjects))[:7]:
        order = rng.permutation([i for i in np.flatnonzero(subjects == person) if clips[int(i)].duration < LONGEST])
        views = [protocol.exemplar_view(clips[int(i)], rng) for i in order]
        joined.append(end_to_end(views, clips.labels[order], f"{name} {person}"))
    return joined[:4], joined[4:]


def performed(rng: np.random.Generator) -> Recording:
    """A synthetic person who does fourteen actions, and rests between them."""
    clip, intervals = stream(rng.choice(ACTIONS, 14).tolist(), Person.random(rng), rng=rng, rest=(1.0, 4.0))
    labels = np.full(len(clip), NONE, dtype="U20")
    for label, start, end in intervals:
        labels[(clip.times >= start) & (clip.times <= end)] = label
    truth = [Event(label, start, end, 0.0, 0.0) for label, start, end in intervals]
    return Recording(detect(clip, azimuth=0.0, rng=rng), truth, clip.times, labels)


# ---- whoever labels ------------------------------------------------------------------------------------------------------
def annotated(recording: Recording, number: int, start: float, end: float) -> Marked:
    """What somebody marks who is shown a part of a recording: the action that fills most of it, where it really is."""
    times, labels = recording.times, recording.labels
    inside = np.flatnonzero((times >= start) & (times <= end))
    if not len(inside):
        return number, NONE, start, end
    names, counts = np.unique(labels[inside], return_counts=True)
    label = str(names[counts.argmax()])
    mine = inside[labels[inside] == label]
    low = high = int(mine[len(mine) // 2])
    reach = BEYOND * (end - start)
    while low > 0 and labels[low - 1] == label and times[low - 1] >= start - reach:
        low -= 1
    while high + 1 < len(times) and labels[high + 1] == label and times[high + 1] <= end + reach:
        high += 1
    return (number, NONE, start, end) if label == NONE else (number, label, float(times[low]), float(times[high]))


def first_labels(pool: Sequence[Recording], rng: np.random.Generator) -> list[Marked]:
    """Two parts of two actions."""
    found: dict[str, Marked] = {}
    while len(found) < 2:
        number = int(rng.integers(len(pool)))
        times = pool[number].times
        start = float(rng.uniform(times[0], times[-1] - FIRST))
        one = annotated(pool[number], number, start, start + FIRST)
        if one[1] != NONE and one[3] - one[2] > 0.5 * FIRST:
            found.setdefault(one[1], one)
    return list(found.values())


def learned(marked: Sequence[Marked], pool: Sequence[Recording]) -> ActionIndexer:
    """What the labels so far teach."""
    clips: list[Clip] = []
    names: list[str] = []
    background: list[Clip] = []
    for number, label, start, end in marked:
        part = pool[number].clip.between(start, end)
        if len(part) < 4:
            continue
        if label == NONE:
            background.append(part)
        else:
            clips.append(part)
            names.append(label)
    try:
        return ActionIndexer().fit(clips, names, background=background or None)
    except ValueError:  # no part of the background is as long as an action
        return ActionIndexer().fit(clips, names)


def right(indexer: ActionIndexer, asked: Sequence[Recording]) -> float:
    """The share of the frames that are right: the action, or none where some frames have none."""
    good: list[Array] = []
    for one in asked:
        told = indexer.decode(one.clip)
        if (one.labels == NONE).any():
            said = np.full(len(one.times), NONE, dtype=one.labels.dtype)
            for event in told.events:
                said[(one.times >= event.start) & (one.times <= event.end)] = event.label
        else:
            said = indexer.classes_[told.scores[np.searchsorted(one.clip.times, one.times)].argmax(axis=1)]
        good.append(said == one.labels)
    return float(np.concatenate(good).mean())


def next_parts(
    indexer: ActionIndexer, pool: Sequence[Recording], marked: Sequence[Marked], number: int, way: str, rng: np.random.Generator
) -> list[Marked]:
    """The next labels: of parts that are suggested, or of any."""
    done = [[(start, end) for which, _, start, end in marked if which == i] for i in range(len(pool))]
    if way == "suggested":
        found = suggest(indexer, [one.clip for one in pool], number, done)
        return [annotated(pool[one.recording], one.recording, one.start, one.end) for one in found]
    parts = [parts_of(indexer, one.clip, spans) for one, spans in zip(pool, done, strict=True)]
    spans = [(i, *span) for i, some in enumerate(parts) if some is not None for span in some.spans[some.worth].tolist()]
    if not spans:
        return []
    lengths = np.array([end - start for _, start, end in spans])
    picked = rng.choice(len(spans), size=min(number, len(spans)), replace=False, p=lengths / lengths.sum())
    return [annotated(pool[spans[k][0]], *spans[k]) for k in picked]


def course(name: SETS, way: str, counts: Sequence[int], seed: int) -> tuple[list[float], list[float]]:
    """Frames that are right, and actions that are known, after so many labels."""
    pool, asked = recordings(name, seed)
    rng = np.random.default_rng(seed)
    marked = first_labels(pool, rng)
    shares, kinds = [], []
    for count in counts:
        more = next_parts(learned(marked, pool), pool, marked, count - len(marked), way, rng) if count > len(marked) else []
        marked += more
        shares.append(right(learned(marked, pool), asked))
        kinds.append(float(len({label for _, label, _, _ in marked if label != NONE})))
    return shares, kinds


FILES = {"exercises": "mocap6_exercises", "utkinect": "utkinect"}


@experiment(Config(), quick={"sets": ("actors",), "counts": (4,), "seeds": 1})
def tables(config: Config) -> Tables:
    """What labels teach, suggested ones and any.

    Raises:
        ValueError: counts that do not grow from 3 on, or no data folder.
    """
    if list(config.counts) != sorted(set(config.counts)) or not config.counts or config.counts[0] < 3:
        raise ValueError(f"counts must grow from 3 on, got {config.counts}")
    for name in config.sets:
        found = {}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that one part is labelled twice
            for way in WAYS:
                note(f"... {name}, {way}")
                found[way] = np.array([course(name, way, config.counts, seed) for seed in range(config.seeds)])
        columns = [f"{count} labels" for count in config.counts]
        right = {way: values[:, 0].mean(axis=0).tolist() for way, values in found.items()}
        yield f"{name}: frames that are right", Grid(columns, right)
        spread = {way: values[:, 0].std(axis=0).tolist() for way, values in found.items()}
        yield f"{name}: standard deviation over {config.seeds} repetitions", Grid(columns, spread)
        known = {way: values[:, 1].mean(axis=0).tolist() for way, values in found.items()}
        yield f"{name}: actions that are known", Grid(columns, known)
