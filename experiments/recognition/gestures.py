"""Twenty signs, one video each: is a sign found again when its video is changed?

    DYNTORCH_DATA=../shared/data python -m experiments.recognition.gestures

There is no second performance of any sign, so nothing here says how well a sign is recognized of another person, or of the same
person on another day.  What can be asked: each of the 20 videos is learned as a class of its own, and changed copies are asked:
other tempo, part of it, mirrored, noisy, under other light, from nearer and aside, as a negative.  Chance is .05.
Five people sign, in front of two backgrounds: whoever looks at the picture alone can tell much.  So *still image* compares the
mean images, and *backwards* is a control: the same picture, another motion.  A method that finds the sign there knows the person,
not the movement: there, less is better.
Nothing was tuned on these videos.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
import torch
import tyro
from torch.nn.functional import interpolate

from experiments.benchmarks.interleaved import threads
from experiments.common.book import Book
from experiments.common.plots import heat
from experiments.common.tables import command, note
from experiments.recognition.brightness_baselines import BASELINES, FrameNearest, Frames
from experiments.recognition.brightness_indexing import Pixels, Recognizer
from experiments.recognition.protocol import Array, data_folder
from indexing.video import read_video

Method = Literal["brightness", "brightness, flipped too", "tracks", "energy grid", "HOG", "activity correlation", "still image"]
Change = Callable[[Frames, np.random.Generator], Frames]
FPS = 30.0
SIZE = (160, 120)


def tempo(video: Frames, rng: np.random.Generator, factor: float) -> Frames:
    """Faster by a factor; frames between frames are mixed."""
    at = np.arange(0, len(video) - 1, factor)
    low = at.astype(int)
    share = (at - low)[:, None, None]
    return ((1 - share) * video[low] + share * video[low + 1]).round().astype(np.uint8)


def middle(video: Frames, rng: np.random.Generator) -> Frames:
    """The middle 60 % of the frames."""
    return video[round(0.2 * len(video)) : round(0.8 * len(video))]


def noisy(video: Frames, rng: np.random.Generator) -> Frames:
    """8 grey levels of noise per pixel and frame."""
    return np.clip(video + rng.normal(scale=8.0, size=video.shape), 0, 255).round().astype(np.uint8)


def light(video: Frames, rng: np.random.Generator) -> Frames:
    """A darker picture, unevenly lit: gamma 1.6, and half as bright at one side."""
    shade = np.linspace(1.0, 0.5, video.shape[2])
    return (255 * (video / 255) ** 1.6 * shade).round().astype(np.uint8)


def nearer(video: Frames, rng: np.random.Generator) -> Frames:
    """80 % of width and height, cut out at a random place about the middle."""
    height, width = video.shape[1:]
    top, left = (int(rng.integers(0, round(0.2 * side) + 1)) for side in (height, width))
    part = torch.from_numpy(video[:, top : top + round(0.8 * height), left : left + round(0.8 * width)])
    grown = interpolate(part[:, None].float(), size=(height, width), mode="bilinear", align_corners=False)
    return grown[:, 0].round().to(torch.uint8).numpy()


CHANGES: dict[str, Change] = {
    "none": lambda video, rng: video,
    "1.4 x faster": partial(tempo, factor=1.4),
    "0.7 x as fast": partial(tempo, factor=0.7),
    "middle 60 %": middle,
    "mirrored": lambda video, rng: np.ascontiguousarray(video[:, :, ::-1]),
    "noise": noisy,
    "light": light,
    "nearer, aside": nearer,
    "negative": lambda video, rng: 255 - video,
    "backwards": lambda video, rng: np.ascontiguousarray(video[::-1]),
}
CONTROL = "backwards"


@dataclass(frozen=True)
class Config:
    """Changed videos of signs, found again among twenty, from the folder DYNTORCH_DATA."""

    methods: tuple[Method, ...] = (
        "brightness", "brightness, flipped too", "tracks", "energy grid", "HOG", "activity correlation", "still image",
    )  # fmt: skip
    """Which methods."""
    signs: int = 20
    """How many of the videos."""
    seed: int = 0
    """Of noise and cuts."""
    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("results/gestures")
    """Where tables (JSON) and pictures are written."""


class StillImage:
    """The mean picture, small: who and where, and nothing of the movement."""

    def fit(self, videos: Sequence[Frames], labels: Any) -> Self:
        """Keep the mean pictures."""
        self.classes_, numbers = np.unique(np.asarray(labels), return_inverse=True)
        self.bank = np.array([self._look(video) for video in videos])[np.argsort(numbers)]
        return self

    def answer(self, video: Frames) -> tuple[Array, Array]:
        """Correlation with every mean picture, for the whole and for every frame."""
        scores = self.bank @ self._look(video)
        return scores, np.tile(scores, (len(video), 1))

    def _look(self, video: Frames) -> Array:
        mean = torch.from_numpy(video.mean(axis=0))[None, None]
        small = interpolate(mean, size=(24, 32), mode="area").flatten().numpy()
        centred = small - small.mean()
        return np.asarray(centred / max(float(np.linalg.norm(centred)), 1e-9))


def contender(method: Method) -> Callable[[], Recognizer]:
    """A way to make a new one."""
    if method == "brightness":
        return partial(Pixels, fps=FPS)
    if method == "brightness, flipped too":
        return partial(Pixels, fps=FPS, flip=True)
    if method == "still image":
        return StillImage
    return partial(FrameNearest, BASELINES[method], FPS)


def signs(count: int) -> tuple[list[Frames], Array]:
    """Grey videos, and what they show.

    Raises:
        ValueError: there are no such videos.
    """
    paths = sorted((data_folder() / "asl_gestures").glob("*.mkv"))[:count]
    if len(paths) < 2:
        raise ValueError(f"{data_folder() / 'asl_gestures'}: expected at least two .mkv files, found {len(paths)}")
    videos = [np.concatenate([chunk.frames for chunk in read_video(path, size=SIZE)]) for path in paths]
    return videos, np.array([path.stem for path in paths])


def found_again(make: Callable[[], Recognizer], videos: Sequence[Frames], names: Array, seed: int) -> Array:
    """``(changes, signs)`` whether each changed video is taken for the sign it was."""
    learned = make().fit(videos, names)
    out = np.zeros((len(CHANGES), len(videos)), dtype=bool)
    for row, change in enumerate(CHANGES.values()):
        for i, video in enumerate(videos):
            whole, _ = learned.answer(change(video, np.random.default_rng([seed, i])))
            out[row, i] = learned.classes_[int(np.argmax(whole))] == names[i]
    return out


def run(config: Config) -> None:
    """Print the table, draw the picture, write the file.

    Raises:
        ValueError: no data folder, no videos, or no method.
    """
    if not config.methods:
        raise ValueError("methods: give at least one")
    book = Book(config.out)
    with threads(1):
        videos, names = signs(config.signs)
        lines: dict[str, list[float]] = {}
        shares = {}
        for method in config.methods:
            note(f"... {method}")
            clock = time.process_time()
            right = found_again(contender(method), videos, names, config.seed).mean(axis=1)
            fair = [share for share, change in zip(right, CHANGES, strict=True) if change != CONTROL]
            lines[method] = [*right.tolist(), float(np.mean(fair)), time.process_time() - clock]
            shares[method] = right
    columns = [*CHANGES, f"mean without {CONTROL}", "CPU seconds"]
    book.grid(f"{len(videos)} signs, found again ({CONTROL}: less is better)", columns, lines)
    table = np.array(list(shares.values()))
    book.picture("gestures", heat({f"{len(videos)} signs, found again": table}, list(lines), list(CHANGES), ("", "change")))
    book.close(vars(config), [data_folder() / "asl_gestures" / f"{name}.mkv" for name in names], seed=config.seed)


if __name__ == "__main__":
    command(lambda: run(tyro.cli(Config, prog="python -m experiments.recognition.gestures")))
