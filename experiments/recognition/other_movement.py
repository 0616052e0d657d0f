"""Events that are told where nobody does what was learned: how many an hour, and how many true ones that costs.

    DYNTORCH_DATA=../shared/data python -m experiments.recognition.other_movement

Models learn from one 2D view (azimuth 0) and are asked of recordings of other people from 0 and 90 degrees: *actors*, synthetic
people seen by a noisy detector; *UTKinect*, *Florence3D*, *UI-PRMD*, clips of one person end to end.  *Other movement* are takes in
which nobody does any of it: of Bandai-Namco, UI-PRMD, and motion capture, several of one kind a recording, 3 s between them.  What
holds a learned movement within itself is left out (:data:`ALIKE`): a raised arm is a wave that goes on.

``--train`` learns the table of :mod:`indexing.recordings.verification` anew, from other people and takes than are printed:
actors of other seeds, UTKinect 1 to 3, Florence3D 1 to 5, UI-PRMD 1 to 3, and the takes of CMU as other movement.  The level is
the one at which that movement is told once an hour.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import islice
from typing import Literal
from unittest import mock

import numpy as np

from dyntorch.numerics import DecisionModel
from experiments.common.decisions import train, write
from experiments.common.runner import BaseConfig, Grid, Tables, experiment
from experiments.common.tables import note
from experiments.recognition import protocol
from experiments.recognition.detection import end_to_end
from experiments.recognition.detection_metrics import overlap
from experiments.recognition.novelty import named
from experiments.recognition.protocol import Array
from indexing import ActionIndexer, Clip
from indexing.actors import ACTIONS, Person, dataset, detect, stream
from indexing.recordings import decoding
from indexing.recordings.verification import FIGURES, TABLE, adapt, log_odds
from indexing.scoring import Event
from indexing.skeleton import Skeleton

SETS = Literal["actors", "utkinect", "florence3d", "uiprmd_half"]
TURNS = (0, 90)
ROOM = 2.2  # metres from the middle of a take that a virtual camera sees
TAKES, GAP = 8, 3.0  # of other movement in a recording, and seconds between two of them
COLUMNS = ("true events", "told before", "told", "wrong before", "wrong", "hours of others", "an hour before", "an hour")
# learned action: words of takes that hold it, or something that cannot be told from a part of it
_HAND = ("wave", "bye", "raise", "call", "respond", "guide", "abduction", "scaption", "traffic", "signal")
_LEG = ("kick", "soccer", "lunge", "hurdle", "leg_raise", "mixed")
_DOWN = ("squat", "sit", "bow", "bend", "lunge", "mixed")
_DOWN_LEARNED = ("squat", "sit_down", "stand_up", "sitDown", "standUp", "sit down", "stand up", "sit_to_stand", "deep_squat")
ALIKE = {
    **dict.fromkeys(("walk", "run", "carry"), ("walk", "run", "jog", "dash", "mixed")),
    **dict.fromkeys(("punch", "throw", "push", "pull"), ("punch", "strike", "throw", "basketball", "slash", "mixed")),
    **dict.fromkeys(("wave", "waveHands", "clap", "clapHands", "answer phone", "drink"), _HAND),
    **dict.fromkeys(("kick", "lunge", "inline_lunge", "side_lunge", "hurdle_step"), _LEG),
    **dict.fromkeys((*_DOWN_LEARNED, "pick_up", "pickUp", "bow", "tight lace"), _DOWN),
    **dict.fromkeys([f"shoulder_{way}" for way in ("abduction", "scaption", "extension", "rotation")], ("raise", "wave", "bye")),
    "jumping_jack": ("jump", "raise-up-both", "wave-both", "mixed"),
}
BANDAI = {"Hips": "pelvis", "Spine": "spine", "Chest": "chest", "Neck": "neck", "Head": "head_center"} | {
    f"{part}_{letter}": f"{side}_{joint}"
    for letter, side in (("L", "left"), ("R", "right"))
    for part, joint in (
        *(("Shoulder", "clavicle"), ("UpperArm", "shoulder"), ("LowerArm", "elbow"), ("Hand", "wrist")),
        *(("UpperLeg", "hip"), ("LowerLeg", "knee"), ("Foot", "ankle"), ("Toes", "toe")),
    )
}


@dataclass(frozen=True)
class Config(BaseConfig):
    """Events in other movement, on recordings in the folder DYNTORCH_DATA."""

    sets: tuple[SETS, ...] = ("actors", "utkinect", "florence3d", "uiprmd_half")
    """Which recordings."""
    train: bool = False
    """Learn the table first."""


@dataclass(frozen=True)
class Asked:
    """A recording: of what, from where, and what is performed in it; None: nothing that was learned."""

    clip: Clip
    turn: int
    truth: list[Event] | None


@dataclass(frozen=True)
class Trial:
    """A model, and what is asked of it."""

    name: str
    indexer: ActionIndexer
    asked: Callable[[], Iterator[Asked]]


@dataclass(frozen=True)
class Told:
    """Of one recording: figures of its events ``(events, FIGURES)``, which are right, how many could be, hours."""

    name: str
    asked: Asked
    figures: Array
    right: Array
    true: int


# ---- other movement ----------------------------------------------------------------------------------------------------
def takes_of_cmu() -> list[tuple[str, Clip]]:
    """Everyday movement by its description, every third take: what is asked of all of them takes an hour."""
    with np.load(protocol.data_folder() / "cmu_prior.npz") as file:
        skeleton = Skeleton("cmu", tuple(map(str, file["joint_names"])), ())
        joints, ends = file["joints"].astype(float) / 1000, file["offsets"].tolist()
        words = [str(one) for one in file["description"]]
    return [(word, Clip(joints[a:b], fps=30.0, skeleton=skeleton)) for word, a, b in zip(words, ends[:-1], ends[1:], strict=True)]


def takes_of_others(own: str) -> list[tuple[str, Clip]]:
    """Half of Bandai-Namco's and, where it is not what was learned, a sixth of UI-PRMD's by their labels."""
    bandai = protocol.load_set("bandai_half")
    bones = bandai[0].skeleton
    assert bones is not None
    skeleton = Skeleton("bandai", tuple(BANDAI[joint] for joint in bones.joints), bones.bones)
    found = [(str(clip.label), clip.replace(skeleton=skeleton)) for clip in list(bandai)[::2]]
    if own != "uiprmd_half":
        found += [(str(clip.label), clip) for clip in list(protocol.load_set("uiprmd_half"))[::6]]
    return found


def others(takes: Sequence[tuple[str, Clip]], learned: Sequence[str], rng: np.random.Generator) -> Iterator[Asked]:
    """Recordings of takes that hold nothing that was learned."""
    strange = {word for label in learned for word in (*ALIKE.get(label, ()), label)}
    kinds: dict[str, list[Clip]] = {}
    for word, clip in takes:
        seen = within_room(clip)
        if seen is not None and not any(part in word for part in strange):
            kinds.setdefault(word, []).append(seen)
    for clips in kinds.values():
        rest = iter(clips)
        while part := list(islice(rest, TAKES)):
            for turn in TURNS:
                views = [protocol.query_view(clip, turn, rng) for clip in part]
                times, late = [], 0.0
                for view in views:
                    times.append(late + view.times - view.times[0])
                    late = float(times[-1][-1]) + GAP
                joints = np.concatenate([view.joints for view in views])
                yield Asked(views[0].replace(joints=joints, times=np.concatenate(times), fps=None, confidence=None), turn, None)


def within_room(clip: Clip) -> Clip | None:
    """The longest part of a take that stays where a camera sees it."""
    middle = np.nanmean(clip.joints, axis=1)
    near = np.linalg.norm((middle - np.nanmean(middle, axis=0))[:, [0, 2]], axis=1) < ROOM
    parts = [part for part in protocol.runs(near) if near[part[0]]]
    first, end = max(parts, key=lambda part: part[1] - part[0], default=(0, 0))
    return clip.replace(joints=clip.joints[first:end], times=clip.times[first:end], confidence=None) if end - first > 30 else None


# ---- trials ------------------------------------------------------------------------------------------------------------
def actor_trials(seed: int, takes: Sequence[tuple[str, Clip]]) -> Iterator[Trial]:
    """Models of few and of many actions, one to three people each."""
    rng = np.random.default_rng(seed)
    for number, people in ((3, 1), (3, 3), (6, 2), (10, 3), (13, 1)):
        known = sorted(rng.choice(ACTIONS, number, replace=False).tolist())
        lesson = dataset(people, known, azimuth=0.0, rng=rng)
        child = np.random.default_rng(rng.integers(2**31))

        def asked(known: list[str] = known, rng: np.random.Generator = child) -> Iterator[Asked]:
            for _ in range(4):
                clip, spans = stream(rng.choice(known, 8).tolist(), Person.random(rng), rng=rng)
                truth = [Event(label, start, end, 0.0, 0.0) for label, start, end in spans]
                for turn in TURNS:
                    yield Asked(detect(clip, azimuth=turn, rng=rng), turn, truth)
            yield from others(takes, known, rng)

        yield Trial("actors", ActionIndexer().fit(lesson, lesson.labels), asked)


def set_trials(name: str, people: Sequence[int], seed: int, takes: Sequence[tuple[str, Clip]], fresh: bool) -> Iterator[Trial]:
    """One per person to be asked, learned from ``people``, or from the others among them; a second model knows six actions.

    Args:
        fresh: whether those are asked who are not among the people.
    """
    clips, rng = protocol.load_set(name), np.random.default_rng(seed)
    subjects, labels, keep = clips.column("subject"), clips.labels, np.ones(len(clips), dtype=bool)
    if name == "uiprmd_half":
        keep = np.isin(clips.column("take"), (2, 6)) & clips.column("correct").astype(bool)
    asking = [one for one in np.unique(subjects) if (one in people) != fresh]
    for number, person in enumerate(asking):
        few = np.isin(labels, rng.permutation(np.unique(labels))[:6]) if number % 2 else np.ones(len(clips), dtype=bool)
        taught = np.flatnonzero(np.isin(subjects, people) & (subjects != person) & keep & few)
        views = [protocol.exemplar_view(named(clips[i], name), rng) for i in taught]
        mine = rng.permutation([i for i in np.flatnonzero((subjects == person) & keep) if clips[i].duration < 20])
        child = np.random.default_rng(rng.integers(2**31))

        def asked(
            mine: Array = mine, known: Array = labels[taught], first: bool = number == 0, rng: np.random.Generator = child
        ) -> Iterator[Asked]:
            for turn in TURNS:
                whole = end_to_end([protocol.query_view(named(clips[i], name), turn, rng) for i in mine], labels[mine], name)
                yield Asked(whole.clip, turn, whole.truth)
            if first:
                yield from others(takes, np.unique(known).tolist(), rng)

        yield Trial(name, ActionIndexer().fit(views, labels[taught]), asked)


LEARNED_FROM = {"utkinect": (1, 2, 3), "florence3d": (1, 2, 3, 4, 5), "uiprmd_half": (1, 2, 3)}


def trials_of(name: str, training: bool, seed: int) -> Iterator[Trial]:
    """Those of one set that train the table, or that are printed."""
    takes = takes_of_cmu() if training else takes_of_others(name)
    if name == "actors":
        return actor_trials(seed + 100 * training, takes)
    return set_trials(name, LEARNED_FROM[name], seed, takes, not training)


# ---- answers -----------------------------------------------------------------------------------------------------------
def tell(trial: Trial) -> Iterator[Told]:
    """Everything that is found, whatever its odds."""
    known = set(trial.indexer.classes_.tolist())
    for one in trial.asked():
        rows: list[Array] = []

        def record(figures: Array, rows: list[Array] = rows) -> Array:
            rows.append(figures)
            return np.full(len(figures), np.inf)

        with mock.patch.object(decoding, "log_odds", record):
            events = trial.indexer.find(one.clip)
        truth = [event for event in one.truth or [] if event.label in known]
        yield Told(trial.name, one, np.concatenate([*rows, np.zeros((0, len(FIGURES)))]), right_events(events, truth), len(truth))


def right_events(events: Sequence[Event], truth: Sequence[Event]) -> Array:
    """Which events overlap one of their label by half, each of which counts once."""
    right, taken = np.zeros(len(events), dtype=bool), np.zeros(len(truth), dtype=bool)
    for i, event in enumerate(events):
        share = overlap([event], truth)[0] * np.array([event.label == one.label for one in truth], dtype=float) * ~taken
        if len(share) and share.max() >= 0.5:
            right[i] = taken[int(share.argmax())] = True
    return right


def learn_table(config: Config) -> None:
    """Write the table: every set counts the same, right events as much as other movement."""
    told = [one for name in config.sets for trial in trials_of(name, True, config.seed) for one in tell(trial)]
    other = np.concatenate([np.full(len(one.figures), one.asked.truth is None) for one in told])
    right = np.concatenate([one.right for one in told])
    sets, groups = (np.repeat(values, [len(one.figures) for one in told]) for values in ([t.name for t in told], range(len(told))))
    kept = other | right
    figures, weights = np.concatenate([one.figures for one in told]), np.zeros(len(kept))
    for name in config.sets:
        for mine in ((sets == name) & right, (sets == name) & other):
            weights[mine] = 1.0 / max(1, mine.sum())
    trained = train(FIGURES, figures[kept], right[kept], groups[kept], weights[kept] / weights[kept].mean())
    table, negative = trained.table, [one for one in told if one.asked.truth is None]
    hours = sum(one.asked.clip.duration for one in negative) / 3600
    low, high = -12.0, 6.0
    command = "python -m experiments.recognition.other_movement --train"
    source = f"{datetime.now(UTC):%Y-%m-%d}, {int(kept.sum())} events, {hours:.1f} h of other movement, {command}"
    intercept = float(table["intercept"])
    for _ in range(20):  # bisection: the level at which other movement is told once an hour
        table["intercept"] = round(intercept + (low + high) / 2, 6)
        write(TABLE, source, {"event": table})
        DecisionModel.load.cache_clear()
        wrong = sum(int(told_now(one).sum()) for one in negative)
        low, high = ((low + high) / 2, high) if wrong <= hours else (low, (low + high) / 2)
    table["intercept"] = round(intercept + low, 6)
    write(TABLE, source, {"event": table})
    DecisionModel.load.cache_clear()


def told_now(one: Told) -> Array:
    """``(events,)`` which are told by default."""
    return adapt(log_odds(one.figures)) > 0 if len(one.figures) else np.zeros(0, dtype=bool)


def line(told: Sequence[Told]) -> list[float]:
    """In the order of COLUMNS."""
    asked, other = [one for one in told if one.asked.truth is not None], [one for one in told if one.asked.truth is None]
    true, hours = sum(one.true for one in asked), sum(one.asked.clip.duration for one in other) / 3600
    parts = [(one.right, one.right & told_now(one), ~one.right, ~one.right & told_now(one)) for one in asked]
    counts = np.sum([[part.sum() for part in four] for four in parts], axis=0).tolist()
    before, now = sum(len(one.figures) for one in other), sum(int(told_now(one).sum()) for one in other)
    right = [counts[0] / max(1, true), counts[1] / max(1, true)]
    return [true, *right, *counts[2:], hours, before / max(hours, 1e-9), now / max(hours, 1e-9)]


@experiment(Config(), quick={"sets": ("florence3d",)})
def tables(config: Config) -> Tables:
    """What is told of true actions and of other movement, before and after events were verified.

    Raises:
        ValueError: no data folder.
    """
    warnings.simplefilter("ignore", UserWarning)
    if config.train:
        learn_table(config)
    found: list[Told] = []
    for name in config.sets:
        note(f"... {name}")
        found += [one for trial in trials_of(name, False, config.seed) for one in tell(trial)]
    lines = {
        f"{name}, {turn}°": line([one for one in found if one.name == name and one.asked.turn == turn])
        for name in config.sets
        for turn in TURNS
    }
    yield "events told", Grid(COLUMNS, {**lines, "all": line(found)})
