"""What the tests of reports show: a stick figure, a recording of it, and what was found there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from indexing.clip import Clip
from indexing.report import RecordingResult
from indexing.skeleton import from_names

STICK = from_names(
    "stick", ("nose", "left_hand", "right_hand", "hip", "left_foot", "right_foot"),
    (("nose", "hip"), ("nose", "left_hand"), ("nose", "right_hand"), ("hip", "left_foot"), ("hip", "right_foot")),
)  # fmt: skip


@dataclass(frozen=True)
class Hit:
    label: object
    start: float
    end: float
    score: float = -0.5
    margin: float = 0.25
    exemplar: int | None = None


def person(frames=60, up="y", fps=30.0):
    joints = np.zeros((frames, 6, 2))
    joints[:] = [[0, 1.7], [-0.6, 1.2], [0.6, 1.2], [0, 0.9], [-0.2, 0], [0.2, 0]]
    joints[:, 1:3, 1] += 0.5 * np.sin(np.arange(frames) / 8)[:, None]
    return Clip(joints * ([1, -1] if up == "-y" else [1, 1]), fps=fps, skeleton=STICK, up=up)


def recording(events=(), truth=None, classes=("squat", "lunge"), frames=300, name="session.json", clip=True):
    rng = np.random.default_rng(0)
    times = np.arange(frames) / 30
    return RecordingResult(
        name, person(frames) if clip else None, times, list(classes), rng.normal(size=(frames, len(classes))), events, truth
    )
