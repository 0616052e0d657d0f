"""Speed of the brightness indexer, beside the goal: features and scoring of 640 x 480 video with 10,000 exemplar frames.

    python -m experiments.benchmarks.brightness_indexer

Needs no recordings: the exemplars are random descriptors, laid out as learned ones (each frame twice, see
:func:`indexing.brightness.stream.build_library`), and the video is a moving texture. One thread; processor time of this process,
and the fastest of several rounds: others at work slow the caches down. ``file`` scores an array in chunks of 32 frames; ``live``
pushes single frames. Mirrored exemplars double the library.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from experiments.common.runner import BaseConfig, Tables, experiment
from experiments.common.tables import Row, note
from indexing.brightness.descriptors import LENGTH
from indexing.brightness.indexer import BrightnessIndexer
from indexing.brightness.stream import VideoExemplars

IMAGES = ((160, 120), (640, 480))
GOAL = 600.0  # frames per second
CLASSES, TRACK = 10, 100  # frames of one exemplar


@dataclass(frozen=True)
class Config(BaseConfig):
    """Speed of the brightness indexer, beside the goal."""

    library: tuple[int, ...] = (1_500, 10_000)
    """Exemplar frames."""
    frames: int = 320
    """Of the video that is scored."""
    rounds: int = 5
    """How often each is measured."""


def texture(frames: int, width: int, height: int) -> NDArray[np.uint8]:
    """``(frames, height, width)``: a texture that moves within a resting one."""
    rng = np.random.default_rng(0)
    cells = -(-height // 16), -(-width // 16)
    still = np.kron(rng.integers(0, 256, cells), np.ones((16, 16)))[:height, :width].astype(np.uint8)
    video = np.repeat(still[None], frames, axis=0)
    side = height // 2
    for t in range(frames):
        at = round(side / 2 * (1 + np.sin(t / 10)))
        video[t, at : at + side, side : 2 * side] = np.roll(still, 3 * t, axis=1)[:side, :side]
    return video


def learned(frames: int) -> BrightnessIndexer:
    """An indexer of so many exemplar frames, each seen twice."""
    generator = torch.Generator().manual_seed(0)
    rows = torch.nn.functional.normalize(torch.rand(2 * frames, LENGTH, generator=generator), dim=1)
    tracks = 2 * frames // TRACK
    parts = VideoExemplars(rows, torch.full((tracks,), TRACK), torch.arange(tracks) % CLASSES)
    return BrightnessIndexer(flip=False)._learn(parts, np.arange(CLASSES))


def rate(work: Callable[[], Any], frames: int, rounds: int) -> float:
    """Frames per second of processor time, the fastest of rounds after one to warm up."""
    seconds = []
    for _ in range(rounds + 1):
        start = time.process_time()
        work()
        seconds.append(time.process_time() - start)
    return frames / min(seconds[1:])


def live(indexer: BrightnessIndexer, video: NDArray[np.uint8]) -> None:
    """Push frame by frame."""
    stream = indexer.stream()
    for frame in video:
        stream.push(frame)


def table(config: Config) -> list[Row]:
    """Frames per second by image, library and way of pushing."""
    rows = []
    for width, height in IMAGES:
        video = texture(config.frames, width, height)
        for frames in config.library:
            indexer = learned(frames)
            ways: dict[str, Callable[[], Any]] = {
                "file": partial(indexer.score_frames, video),
                "live": partial(live, indexer, video),
            }
            for name, work in ways.items():
                setting = f"{width} x {height}, {frames} exemplar frames"
                rows.append(Row(name, setting, rate(work, len(video), config.rounds), goal=GOAL, unit="frames/s"))
                note(f"... {name}, {setting}: {rows[-1].measured:.0f} frames/s")
    return rows


@experiment(Config(), quick={"library": (1500,), "frames": 40, "rounds": 1})
def tables(config: Config) -> Tables:
    """Files, and pictures pushed one by one."""
    yield "Brightness indexer", table(config)
