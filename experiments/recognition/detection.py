"""Actions found in untrimmed recordings of other people, and from another side: every frame, and as segments.

    DYNTORCH_DATA=../shared/data python -m experiments.recognition.detection

*UTKinect*, *Florence3D*: recordings joined from all clips of one person, in random order and without a pause, each seen from
where it is asked; learned from the clips of others (five folds), seen at azimuth 0.  *UTKinect, evenly*: the same with its frames
1/30 s apart, as files without times are read; its own clock has about 7 frames per second.  *Exercises*: each subject's streams
are asked of what was learned from the other's, cut at their labels and seen at azimuth 0; every frame has a label; exercises that
were never learned, and what is found in them, are left out of account.  *Actors*: synthetic people perform actions with rests
between them, seen by a noisy detector that loses joints; learned from one clip per action and person of three others.  Queries are
seen from azimuth 0 and 90, actors from 0 and 60.

Two readings of the same scores: *every frame* gets the class of its best score, runs are segments (there is no rest: made for the
exercises); *found* is what ``find`` says (rests are not to be found: made for the actors).  A segment's score is how far its class
stands above the mean of all.  The baselines are given the same windows, tempi and explanation; only the distance differs.
``windows`` are short windows alone, without an explanation by segments.  ``--parts`` leaves one part of the explanation out at a
time.  The weights of the explanation (:mod:`indexing.recordings.decoding`) were chosen on these four sets together, so figures on
them are, if anything, too good.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from experiments.common.runner import BaseConfig, Grid, Tables, experiment
from experiments.common.tables import note
from experiments.recognition import protocol
from experiments.recognition.contenders import NAMES, Method, Part, check_methods, sliding
from experiments.recognition.detection_metrics import edit_score, f1, mean_average_precision, segments
from experiments.recognition.protocol import Array
from indexing import Clip
from indexing.actors import ACTIONS, Person, dataset, detect, stream
from indexing.scoring import Event, events

SETS = Literal["utkinect", "utkinect, evenly", "florence3d", "exercises", "actors"]
TURNS = (0, 90)
ACTORS = (0, 60)  # from the side too much of one arm is hidden for thirteen actions
FOLDS = 5
THRESHOLDS = (0.3, 0.5, 0.7)
COLUMNS = ("frames", *(f"mAP@{t:g}" for t in THRESHOLDS), "F1@0.5", "edit")
PEOPLE = 3  # actors learned from
EVERYWHERE, FOUND = READINGS = ("every frame", "found")


@dataclass(frozen=True)
class Recording:
    """A stream in one view: the clip, its true segments, and the label of frames at some times."""

    clip: Clip
    truth: list[Event]
    times: Array
    labels: Array


@dataclass(frozen=True)
class Task:
    """What is learned, and by azimuth what is asked of it."""

    clips: list[Clip]
    labels: Array
    asked: dict[int, list[Recording]]


@dataclass(frozen=True)
class Answer:
    """What a method says of a recording: whether each frame of a known action is right, its segments, and the true ones."""

    right: Array
    everywhere: list[Event]
    found: list[Event]
    truth: list[Event]


@dataclass(frozen=True)
class Config(BaseConfig):
    """Untrimmed detection on the exercise streams of the folder DYNTORCH_DATA and on synthetic actors."""

    sets: tuple[SETS, ...] = ("utkinect", "utkinect, evenly", "florence3d", "exercises", "actors")
    """Which recordings."""
    methods: tuple[Method, ...] = ("equal", "windows", "image", "dtw")
    """Which methods."""
    parts: tuple[Part, ...] = get_args(Part)
    """Parts of the explanation that ours is measured without, one at a time."""
    longest: float = np.inf
    """Seconds: longer clips are left out of what is asked.  One push of UTKinect lasts 35 s and holds a walk: .04 of its frames."""
    streams: int = 4
    """Streams of synthetic actors, a person each."""
    actions: int = 8
    """Actions in each of them."""
    seeds: int = 1
    """Repetitions with other noise, cameras, and actors."""


# ---- recordings --------------------------------------------------------------------------------------------------------
def joined_tasks(name: str, evenly: bool, longest: float, seed: int) -> list[Task]:
    """One per fold of people: learned from the others' clips, asked of each person's clips end to end, but for too long ones."""
    clips = protocol.load_set(name)
    rng = np.random.default_rng([seed, 7])
    solid = [clip.replace(times=np.arange(len(clip)) / 30.0, fps=None) if evenly else clip for clip in clips]
    images = [protocol.exemplar_view(clip, rng) for clip in solid]
    people, tasks = clips.column("subject"), []
    for train, test in protocol.leave_one_subject_out(protocol.merged(people, FOLDS)):
        asked: dict[int, list[Recording]] = {turn: [] for turn in TURNS}
        for person in np.unique(people[test]):
            order = rng.permutation([i for i in test[people[test] == person] if clips[i].duration <= longest])
            for turn in TURNS:
                views = [protocol.query_view(solid[i], turn, rng) for i in order]
                asked[turn].append(end_to_end(views, clips.labels[order], f"{name} {person}"))
        tasks.append(Task([images[i] for i in train], clips.labels[train], asked))
    return tasks


def end_to_end(clips: Sequence[Clip], labels: Array, name: str) -> Recording:
    """Clips one after the other; each lasts until its last frame has been shown."""
    times, truth, begin = [], [], 0.0
    for clip, label in zip(clips, labels, strict=True):
        times.append(begin + clip.times - clip.times[0])
        end = begin + clip.duration + float(np.median(np.diff(clip.times)))
        truth.append(Event(label, begin, end, 0.0, 0.0))
        begin = end
    joints = np.concatenate([clip.joints for clip in clips])
    whole = clips[0].replace(joints=joints, times=np.concatenate(times), fps=None, confidence=None, name=name)
    return Recording(whole, truth, whole.times, np.repeat(labels, [len(clip) for clip in clips]))


def exercise_tasks(seed: int) -> list[Task]:
    """One per subject: learned from the others' streams, asked of this one's."""
    with np.load(protocol.data_folder() / "mocap6_exercises.npz") as file:
        names = file["action_names"]
    exercises = protocol.load_exercises()
    rng = np.random.default_rng(seed)
    images = [protocol.exemplar_view(one.clip, rng) for one in exercises]
    queries = {turn: [protocol.query_view(one.clip, turn, rng) for one in exercises] for turn in TURNS}
    tasks = []
    for train, test in protocol.leave_one_subject_out(np.array([one.subject for one in exercises])):
        parts = [protocol.cut_runs(exercises[i], images[i]) for i in train]
        clips, numbers = [clip for part, _ in parts for clip in part], [label for _, part in parts for label in part]
        step = protocol.RATIO / 30.0
        true = {i: names[exercises[i].labels - 1] for i in test}
        asked = {
            turn: [Recording(views[i], segments(true[i], step), views[i].times[exercises[i].frames], true[i]) for i in test]
            for turn, views in queries.items()
        }
        tasks.append(Task(clips, names[np.array(numbers) - 1], asked))
    return tasks


def actor_tasks(streams: int, actions: int, seed: int) -> list[Task]:
    """One: synthetic people, of whom others are learned from."""
    rng = np.random.default_rng([seed, 1])
    learned = dataset(PEOPLE, ACTIONS, azimuth=0.0, rng=rng)
    asked: dict[int, list[Recording]] = {turn: [] for turn in ACTORS}
    for _ in range(streams):
        clip, intervals = stream(rng.choice(ACTIONS, actions).tolist(), Person.random(rng), rng=rng)
        truth = [Event(label, start, end, 0.0, 0.0) for label, start, end in intervals]
        labels = np.full(len(clip), "", dtype=learned.labels.dtype)
        for one in truth:
            labels[(clip.times >= one.start) & (clip.times <= one.end)] = one.label
        for turn in ACTORS:
            asked[turn].append(Recording(detect(clip, azimuth=turn, rng=rng), truth, clip.times, labels))
    return [Task(list(learned), learned.labels, asked)]


# ---- answers -----------------------------------------------------------------------------------------------------------
def answer(learned: Any, recording: Recording) -> Answer:
    """What a learned method says of a recording, beside the truth of the actions that it knows."""
    scores, found = learned.scan(recording.clip)
    classes, times = learned.classes_, recording.clip.times
    known = np.isin(recording.labels, classes)
    named = classes[scores[np.searchsorted(times, recording.times)].argmax(axis=1)]
    contrast = scores - scores.mean(axis=1, keepdims=True)
    everywhere = events(contrast, times, classes.tolist(), -np.inf, -np.inf)
    strange = [one for one in recording.truth if one.label not in classes]
    return Answer(
        (named == recording.labels)[known],
        outside(everywhere, strange),
        outside(found, strange),
        [one for one in recording.truth if one.label in classes],
    )


def outside(found: Sequence[Event], strange: Sequence[Event]) -> list[Event]:
    """The finds less than half of which lie in one of the segments that are left out of account."""

    def inside(one: Event, other: Event) -> float:
        return (min(one.end, other.end) - max(one.start, other.start)) / (one.end - one.start)

    return [one for one in found if all(inside(one, other) < 0.5 for other in strange)]


def figures(answers: Sequence[Answer], reading: str) -> list[float]:
    """In the order of COLUMNS."""
    truth = [one.truth for one in answers]
    parts = [one.found if reading == FOUND else one.everywhere for one in answers]
    precise = [mean_average_precision(parts, truth, threshold) for threshold in THRESHOLDS]
    frames = np.nan if reading == FOUND else float(np.mean(np.concatenate([one.right for one in answers])))
    return [frames, *precise, f1(parts, truth), edit_score(parts, truth)]


def evaluate(tasks: Sequence[Task], method: Method, seed: int, without: Part | None = None) -> dict[tuple[int, str], list[float]]:
    """By azimuth and reading: :func:`figures` over the recordings of all tasks."""
    turns = list(tasks[0].asked)
    answers: dict[int, list[Answer]] = {turn: [] for turn in turns}
    for task in tasks:
        learned = sliding(method, seed, without).fit(task.clips, task.labels)
        for turn in turns:
            answers[turn] += [answer(learned, one) for one in task.asked[turn]]
    return {(turn, reading): figures(answers[turn], reading) for turn in turns for reading in READINGS}


def tasks_of(name: SETS, config: Config, seed: int) -> list[Task]:
    """The tasks of one set."""
    if name == "exercises":
        return exercise_tasks(seed)
    if name == "actors":
        return actor_tasks(config.streams, config.actions, seed)
    return joined_tasks(name.split(",")[0], name.endswith("evenly"), config.longest, seed)


@experiment(Config(), quick={"sets": ("actors",), "methods": ("equal",), "parts": (), "streams": 1, "actions": 3})
def tables(config: Config) -> Tables:
    """Every set at every turn of the camera.

    Raises:
        ValueError: no data folder though recordings are asked for, or a method that cannot be made.
    """
    check_methods(config.methods)
    for name in config.sets:
        tasks = [tasks_of(name, config, seed) for seed in range(config.seeds)]
        ways: dict[str, tuple[Method, Part | None]] = {NAMES[method]: (method, None) for method in config.methods}
        ways |= {f"ours without {part}": ("equal", part) for part in config.parts}
        found = {}
        for title, (method, part) in ways.items():
            note(f"... {name}, {title}")
            found[title] = [evaluate(each, method, seed, part) for seed, each in enumerate(tasks)]
        for turn in tasks[0][0].asked:
            lines = {
                f"{title}, {reading}": np.mean([one[turn, reading] for one in found[title]], axis=0).tolist()
                for reading in READINGS
                for title in ways
            }
            yield f"{name}, camera turned {turn} degrees", Grid(COLUMNS, lines)
