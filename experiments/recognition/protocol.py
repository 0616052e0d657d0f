"""How the action indexer is measured: which clips are learned from, which are asked, and what counts as right.

Shared by every script, so that all methods see the same splits, the same cameras and the same noise.  Virtual cameras are
those of :func:`indexing.cameras.virtual`: perspective from 4.5 m, people scaled to 1.5 m, 15 mm noise on every 3D joint; an
exemplar is seen at azimuth 0 and elevation .1 rad, a query turned by 0 / 45 / 90 / 150 degrees at elevation .1 +- .1.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from indexing import Clip, ClipSet
from indexing.cameras import virtual
from indexing.skeleton import Skeleton

Array = NDArray[Any]
DATA = "DYNTORCH_DATA"
TURNS = (0, 45, 90, 150)  # degrees from the exemplars' camera to the query's
ELEVATION, SPREAD = 0.1, 0.1  # radians: every exemplar, and how far a query is from there at most
STREAM_TURNS = (0, 90)
RATIO = 3  # frames of joints per label in the exercise streams: 30 fps against 10 fps
SHORTEST = 6  # frames: shorter runs of one label hold no exercise


class Classifier(Protocol):
    """What every method under test can do."""

    def fit(self, clips: Sequence[Clip], labels: Array, /) -> Any:
        """Learn from clips."""

    def predict(self, clips: Sequence[Clip], /) -> Array:
        """One label per clip."""


class FrameScorer(Protocol):
    """A method that scores the frames of a stream."""

    @property
    def classes_(self) -> Array:
        """Labels, in the order of the scores."""

    def fit(self, clips: Sequence[Clip], labels: Array, /) -> Any:
        """Learn from clips."""

    def score_frames(self, clip: Clip, /) -> Array:
        """``(frames, classes)``."""


@dataclass(frozen=True)
class Rendered:
    """A set of 3D clips as virtual cameras see it: ``solid`` in 3D, ``exemplars`` in one view, ``queries`` by azimuth."""

    solid: tuple[Clip, ...]
    exemplars: tuple[Clip, ...]
    queries: dict[int, tuple[Clip, ...]]
    labels: Array
    subjects: Array


@dataclass(frozen=True)
class Exercise:
    """An untrimmed stream of exercises: 3D joints at 30 fps, and a label at every third frame."""

    name: str
    clip: Clip
    labels: Array

    @property
    def subject(self) -> str:
        """Who exercises: the number before the underscore."""
        return self.name.split("_")[0]

    @property
    def frames(self) -> Array:
        """``(labels,)`` index of the 30 fps frame in the middle of each label's interval."""
        return np.minimum(RATIO * np.arange(len(self.labels)) + RATIO // 2, len(self.clip) - 1)


# ---- data --------------------------------------------------------------------------------------------------------------
def data_folder() -> Path:
    """The folder named by the environment variable ``DYNTORCH_DATA``.

    Raises:
        ValueError: the variable is unset, or names no folder.
    """
    value = os.environ.get(DATA)
    if not value:
        raise ValueError(f"{DATA} is not set: it must name the folder with the recordings, for example {DATA}=../shared/data")
    folder = Path(value)
    if not folder.is_dir():
        raise ValueError(f"{DATA}={value}: no such folder")
    return folder


def load_set(name: str) -> ClipSet:
    """One clip set of the data folder."""
    return ClipSet.load(data_folder() / f"{name}.npz")


def load_exercises(name: str = "mocap6_exercises") -> list[Exercise]:
    """The streams that have joints.

    Raises:
        ValueError: the file is missing.
    """
    path = data_folder() / f"{name}.npz"
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    with np.load(path, allow_pickle=False) as file:
        names = sorted(key.split("/")[0] for key in file.files if key.endswith("/joints_30fps"))
        joints = tuple(str(joint) for joint in file["joint_names"])
        bones = tuple((int(parent), i) for i, parent in enumerate(file["parents"]) if parent >= 0)
        skeleton = Skeleton(path.stem, joints, bones)
        return [
            Exercise(
                stream,
                Clip(file[f"{stream}/joints_30fps"], fps=30.0, name=stream, skeleton=skeleton),
                file[f"{stream}/label_10fps"].astype(np.int64),
            )
            for stream in names
        ]


# ---- cameras -----------------------------------------------------------------------------------------------------------
def exemplar_view(clip: Clip, rng: np.random.Generator) -> Clip:
    """The view that is learned from."""
    return virtual(clip, 0.0, ELEVATION, random_state=rng)


def query_view(clip: Clip, azimuth: float, rng: np.random.Generator) -> Clip:
    """The view that is asked: turned, and up to .1 rad higher or lower."""
    return virtual(clip, azimuth, ELEVATION + SPREAD * rng.uniform(-1.0, 1.0), random_state=rng)


def render(clips: ClipSet, seed: int, turns: Iterable[int] = TURNS) -> Rendered:
    """A 3D clip set in its exemplar view and in every query view; all noise comes from the seed."""
    rng = np.random.default_rng(seed)
    exemplars = tuple(exemplar_view(clip, rng) for clip in clips)
    queries = {azimuth: tuple(query_view(clip, azimuth, rng) for clip in clips) for azimuth in turns}
    return Rendered(clips.clips, exemplars, queries, clips.labels, clips.column("subject"))


# ---- splits ------------------------------------------------------------------------------------------------------------
def leave_one_subject_out(subjects: Array) -> Iterator[tuple[Array, Array]]:
    """``(training, test)`` indices, one subject's clips for test at a time."""
    for subject in np.unique(subjects):
        yield np.flatnonzero(subjects != subject), np.flatnonzero(subjects == subject)


def merged(subjects: Array, most: int) -> Array:
    """Subjects as at most ``most`` groups of neighbours, of nearly the same number: fewer folds to leave out."""
    names, number = np.unique(subjects, return_inverse=True)
    return np.asarray(number * min(most, len(names)) // len(names))


def few(labels: Array, count: int, rng: np.random.Generator) -> Array:
    """Indices of ``count`` examples of every class (all of them where there are fewer), drawn at random."""
    chosen = [rng.permutation(np.flatnonzero(labels == label))[:count] for label in np.unique(labels)]
    return np.sort(np.concatenate(chosen))


def runs(labels: Array) -> list[tuple[int, int]]:
    """``(start, end)`` of the maximal runs of one label, end exclusive."""
    cuts = np.flatnonzero(labels[1:] != labels[:-1]) + 1
    bounds = [0, *cuts.tolist(), len(labels)]
    return list(pairwise(bounds))


def cut_runs(exercise: Exercise, image: Clip) -> tuple[list[Clip], list[int]]:
    """The rendered stream cut where its label changes: one training clip per run, and their labels."""
    clips, labels = [], []
    for start, end in runs(exercise.labels):
        span = slice(RATIO * start, min(RATIO * end, len(image)))
        if span.stop - span.start >= SHORTEST:
            clips.append(image.replace(joints=image.joints[span], times=image.times[span]))
            labels.append(int(exercise.labels[start]))
    return clips, labels


# ---- what counts as right ----------------------------------------------------------------------------------------------
def right_by_turn(method: Classifier, rendered: Rendered, test: Array) -> Array:
    """``(turns, tests)`` whether each query is recognized; all turns are asked in one call."""
    asked = [clips[i] for clips in rendered.queries.values() for i in test]
    answers = np.asarray(method.predict(asked)).reshape(len(rendered.queries), len(test))
    return np.asarray(answers == rendered.labels[test])


def accuracy_by_turn(
    make: Callable[[], Classifier],
    rendered: Rendered,
    *,
    solid: bool = False,
    choose: Callable[[Array], Array] | None = None,
) -> Array:
    """``(turns,)`` accuracy over all clips, leave-one-subject-out.

    Args:
        make: a new, unfitted method.
        solid: learn from the 3D joints instead of from one view.
        choose: from the labels of the training clips, the indices of those to learn from (all by default).
    """
    source = rendered.solid if solid else rendered.exemplars
    right = np.zeros(len(rendered.queries))
    for train, test in leave_one_subject_out(rendered.subjects):
        kept = train if choose is None else train[choose(rendered.labels[train])]
        method = make()
        method.fit([source[i] for i in kept], rendered.labels[kept])
        right += right_by_turn(method, rendered, test).sum(axis=1)
    return right / len(rendered.labels)


def split_accuracy(method: Classifier, clips: ClipSet, split: int) -> float:
    """Accuracy on one official split (``split<k>``: 0 = training, 1 = test)."""
    part = clips.column(f"split{split}")
    train, test = clips[part == 0], clips[part == 1]
    method.fit(list(train), train.labels)
    return float(np.mean(np.asarray(method.predict(list(test))) == test.labels))


def stream_accuracy(make: Callable[[], FrameScorer], exercises: Sequence[Exercise], seed: int) -> tuple[Array, int]:
    """``(turns,)`` share of the frames named rightly, and how many frames count: those whose exercise was trained.

    Each subject's streams are asked of what was learned from the other subjects' streams, seen at azimuth 0.
    """
    rng = np.random.default_rng(seed)
    images = [exemplar_view(one.clip, rng) for one in exercises]
    queries = {azimuth: [query_view(one.clip, azimuth, rng) for one in exercises] for azimuth in STREAM_TURNS}
    right, count = np.zeros(len(STREAM_TURNS)), 0
    for train, test in leave_one_subject_out(np.array([one.subject for one in exercises])):
        parts = [cut_runs(exercises[i], images[i]) for i in train]
        method = make()
        method.fit([clip for clips, _ in parts for clip in clips], np.array([label for _, labels in parts for label in labels]))
        for i in test:
            known = np.isin(exercises[i].labels, method.classes_)
            count += int(known.sum())
            for k, azimuth in enumerate(STREAM_TURNS):
                scores = method.score_frames(queries[azimuth][i])[exercises[i].frames]
                right[k] += np.sum(method.classes_[scores.argmax(axis=1)][known] == exercises[i].labels[known])
    return right / max(1, count), count
