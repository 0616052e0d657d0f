"""Actions recognized from pixels alone: two people raising their arms, and figures that exercise, turned to the camera.

    DYNTORCH_DATA=../shared/data python -m experiments.recognition.brightness_indexing

*Arm raises*: 18 real videos, 2 people, 3 actions, a fixed camera: learned from one person, asked of the other, both ways.  *Moving
frames* are those in which more than noise changes, after the first 8 frames of a clip; the same for all methods.
*Exercises*: the motion capture streams, filmed as textured figures at 15 frames per second; learned from the other person, cut at
labels, seen at azimuth 0, and asked at 0 and 60, each film with its own texture and background.  Frames of exercises that were
never learned are left out.  The scores of a frame know nothing of later frames.

The thesis's own measure, the kernel of brightness differences without where they are, is among the baselines.  The indexer's
constants were chosen on these two people (18 videos: one is .056) and on films of these streams: read the figures as those of the
training set of whoever chose them.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any, Literal, Protocol, Self

import numpy as np
import torch

from experiments.common.runner import BaseConfig, Grid, Tables, experiment
from experiments.common.tables import Row, note
from experiments.recognition import protocol
from experiments.recognition.brightness_baselines import BASELINES, FrameNearest, Frames, WindowKernels
from experiments.recognition.protocol import Array
from indexing import Clip
from indexing.actors.textured import render_clip
from indexing.brightness.indexer import BrightnessIndexer
from indexing.skeleton import COCO17
from indexing.sync.brightness_features import motion

Method = Literal["ours", "whole image", "thesis kernel", "activity correlation", "energy grid", "HOG"]
NAMES = {
    "ours": "brightness indexer",
    "whole image": "brightness indexer, no motion box",
}
OPTIONS: dict[str, dict[str, Any]] = {
    "ours": {},
    "whole image": {"region": None},
}
ARMS_FPS, FILM_FPS = 30.0, 15.0
WARM = 8  # frames at the start of a clip that are not counted
MOVING = 2e-4  # mean brightness change per pixel and frame, above the noise (grey 0..1)
TURNS = (0, 60)
GOALS_ARMS, GOALS_FILMS = (18.0, 0.96), (0.82, 0.72)
JOINTS = (
    *["head"] * 5, "lclavicle", "rclavicle", "lhumerus", "rhumerus", "lwrist", "rwrist", "lhipjoint", "rhipjoint", "lfemur",
    "rfemur", "ltibia", "rtibia",
)  # fmt: skip
"""Of the motion capture (named after the bones that end there), in the order of COCO-17."""


class Recognizer(Protocol):
    """What every method can do."""

    classes_: Array

    def fit(self, videos: Sequence[Frames], labels: Any, /) -> Self:
        """Learn from videos."""

    def answer(self, video: Frames, /) -> tuple[Array, Array]:
        """Scores of the whole video, and after every frame."""


class Pixels:
    """The brightness indexer, both answers in one call; ``options`` are its own."""

    def __init__(self, fps: float, **options: Any) -> None:
        self.indexer = BrightnessIndexer(fps=fps, **options)

    def fit(self, videos: Sequence[Frames], labels: Any) -> Self:
        """Learn from videos."""
        self.indexer.fit(videos, labels)
        self.classes_: Array = self.indexer.classes_
        return self

    def answer(self, video: Frames) -> tuple[Array, Array]:
        """Scores of the whole video, and after every frame."""
        return self.indexer.decision_function([video])[0], self.indexer.score_frames(video)


@dataclass(frozen=True)
class Config(BaseConfig):
    """Recognition from pixels, on the recordings in the folder DYNTORCH_DATA."""

    sets: tuple[Literal["arms", "exercises"], ...] = ("arms", "exercises")
    """Which recordings."""
    methods: tuple[Method, ...] = ("ours", "whole image", "thesis kernel", "activity correlation", "energy grid", "HOG")
    """Which methods; goals are those of the first."""


def contender(method: Method, fps: float) -> Callable[[], Recognizer]:
    """A way to make a new one."""
    if method in OPTIONS:
        return partial(Pixels, fps=fps, **OPTIONS[method])
    if method == "thesis kernel":
        return partial(WindowKernels, fps)
    return partial(FrameNearest, BASELINES[method], fps)


# ---- recordings --------------------------------------------------------------------------------------------------------
def arm_raises() -> tuple[list[Frames], Array, Array]:
    """Videos, actions, people."""
    with np.load(protocol.data_folder() / "armraise_gray160x120.npz") as file:
        frames, offsets = file["frames"], file["offsets"]
        return [frames[a:b] for a, b in pairwise(offsets)], file["action"], file["subject"]


def as_coco(clip: Clip) -> Clip:
    """Motion capture joints as the 17 of COCO, the face all at the end of the head."""
    assert clip.skeleton is not None
    where = [clip.skeleton.joints.index(name) for name in JOINTS]
    return clip.replace(joints=clip.joints[:, where], skeleton=COCO17)


@dataclass(frozen=True)
class Filmed:
    """A stream on film: the videos by name of the view, and a label per frame."""

    subject: str
    views: Mapping[str, Frames]
    labels: Array


def films(seed: int) -> list[Filmed]:
    """Every stream as it is learned from ("learned") and as it is asked ("0", "60")."""
    out = []
    for number, one in enumerate(protocol.load_exercises()):
        step = round(30 / FILM_FPS)
        clip = as_coco(one.clip)
        clip = clip.replace(joints=clip.joints[::step], times=clip.times[::step])
        views = {"learned": 0.0} | {str(turn): float(turn) for turn in TURNS}
        videos = {
            view: render_clip(clip, azimuth=turn, rng=np.random.default_rng([seed, number, k]))
            for k, (view, turn) in enumerate(views.items())
        }
        at = np.minimum((clip.times * 30 / protocol.RATIO + 1e-6).astype(int), len(one.labels) - 1)
        out.append(Filmed(one.subject, videos, one.labels[at]))
    return out


# ---- what counts as right ----------------------------------------------------------------------------------------------
def moving(video: Frames) -> Array:
    """``(F,)`` frames that are counted."""
    return (motion(torch.from_numpy(video)).activity.numpy() >= MOVING) & (np.arange(len(video)) >= WARM)


def arms(make: Callable[[], Recognizer], videos: Sequence[Frames], actions: Array, people: Array) -> tuple[int, float, float]:
    """Videos recognized, share of the moving frames, and the least margin of a video in its own spread of scores."""
    hits, frames, margins = 0, [], []
    for train, test in protocol.leave_one_subject_out(people):
        learned = make().fit([videos[i] for i in train], actions[train])
        for i in test:
            whole, each = learned.answer(videos[i])
            mine = learned.classes_ == actions[i]
            margins.append(float((whole[mine].max() - whole[~mine].max()) / max(np.ptp(whole), 1e-12)))
            hits += margins[-1] > 0
            frames.append((learned.classes_[each.argmax(axis=1)] == actions[i])[moving(videos[i])])
    return hits, float(np.mean(np.concatenate(frames))), min(margins)


def exercises(make: Callable[[], Recognizer], streams: Sequence[Filmed]) -> tuple[list[float], int]:
    """Share of the frames named rightly, by turn, and how many frames count."""
    right, count = np.zeros(len(TURNS)), 0
    for train, test in protocol.leave_one_subject_out(np.array([one.subject for one in streams])):
        videos, labels = [], []
        for i in train:
            for start, end in protocol.runs(streams[i].labels):
                if end - start >= WARM:
                    videos.append(streams[i].views["learned"][start:end])
                    labels.append(streams[i].labels[start])
        learned = make().fit(videos, np.array(labels))
        for i in test:
            known = np.isin(streams[i].labels, learned.classes_)
            count += int(known.sum())
            for k, turn in enumerate(TURNS):
                said = learned.classes_[learned.answer(streams[i].views[str(turn)])[1].argmax(axis=1)]
                right[k] += np.sum((said == streams[i].labels)[known])
    return (right / max(1, count)).tolist(), count


def table_arms(config: Config) -> Grid:
    """Shares by method."""
    videos, actions, people = arm_raises()
    lines, shown = {}, {}
    for method in config.methods:
        note(f"... arm raises, {NAMES.get(method, method)}")
        clock = time.process_time()
        hits, frames, margin = arms(contender(method, ARMS_FPS), videos, actions, people)
        lines[NAMES.get(method, method)] = [f"{hits}/{len(videos)}", frames, margin, time.process_time() - clock]
        shown[NAMES.get(method, method)] = [hits / len(videos), frames]
    first = shown[NAMES.get(config.methods[0], config.methods[0])]
    rows = [
        Row("arm raises", "videos recognized", first[0] * len(videos), GOALS_ARMS[0]),
        Row("arm raises", "moving frames", first[1], GOALS_ARMS[1]),
    ]
    return Grid(["videos", "moving frames", "least margin", "CPU seconds"], lines, rows)


def table_exercises(config: Config) -> Grid:
    """Shares by method."""
    note("... filming")
    streams = films(config.seed)
    shown, count = {}, 0
    for method in config.methods:
        note(f"... exercises, {NAMES.get(method, method)}")
        shown[NAMES.get(method, method)], count = exercises(contender(method, FILM_FPS), streams)
    first = shown[NAMES.get(config.methods[0], config.methods[0])]
    rows = [Row("exercises", f"turned {turn} degrees", first[k], GOALS_FILMS[k]) for k, turn in enumerate(TURNS)]
    return Grid([f"{turn}°, {count} frames" for turn in TURNS], shown, rows)


@experiment(Config(), quick={"sets": ("arms",), "methods": ("ours",)})
def tables(config: Config) -> Tables:
    """Recordings of the folder DYNTORCH_DATA; the seed is that of textures, backgrounds and sensor noise of the films.

    Raises:
        ValueError: no data folder, a missing file, or no method.
    """
    if not config.methods:
        raise ValueError("methods: give at least one")
    if "arms" in config.sets:
        yield "Arm raises, from one person to the other", table_arms(config)
    if "exercises" in config.sets:
        yield "Exercises on film, other person", table_exercises(config)
