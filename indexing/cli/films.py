"""Videos in place of keypoints: which inputs are pixels, what is read of them, and the indexer that learns from them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from indexing.cli.console import names

if TYPE_CHECKING:
    from indexing.brightness.indexer import BrightnessIndexer
    from indexing.cli.inputs import Example, Reading
    from indexing.readers.clipset import Film, FilmSet

FASTEST = 30.0  # frames per second that are compared at most: the window of the method was chosen at 15 and 30


@dataclass(frozen=True)
class Pixels:
    """How videos are compared where no keypoints are given."""

    region: Annotated[str, tyro.conf.arg(metavar="REGION")] = "motion"
    """of videos: motion (the box about what moves), all (the whole image), or x0,y0,x1,y1 in pixels"""

    def indexer(self, fps: float, **options: Any) -> BrightnessIndexer:
        """A new indexer of videos.

        Raises:
            ValueError: the region makes no sense.
        """
        from indexing.brightness.indexer import BrightnessIndexer

        return BrightnessIndexer(fps=fps, region=self._region(), **options)

    def _region(self) -> Any:
        if self.region in ("motion", "all"):
            return None if self.region == "all" else "motion"
        try:
            x0, y0, x1, y1 = (float(word) for word in self.region.split(","))
        except ValueError:
            raise ValueError(f"--region {self.region!r}: expected motion, all, or x0,y0,x1,y1 in pixels") from None
        return (x0, y0, x1, y1)


def refuse_film_flags(pixels: Pixels) -> None:
    """Raise where a flag is set that says nothing of keypoints."""
    given = [name for name, field in Pixels.__dataclass_fields__.items() if getattr(pixels, name) != field.default]
    if given:
        listed = names([f"--{name.replace('_', '-')}" for name in given])
        raise ValueError(f"{listed}: of videos only, but the inputs are keypoints; leave it out")


def are_films(paths: Sequence[Path]) -> bool:
    """Whether the inputs are videos or film sets, not keypoints.

    Raises:
        ValueError: some are and some are not.
    """
    from indexing.readers.clipset import holds_frames
    from indexing.readers.files import VIDEOS

    kinds = [path.suffix.lower() in VIDEOS or holds_frames(path) for path in paths]
    if any(kinds) and not all(kinds):
        film, other = paths[kinds.index(True)], paths[kinds.index(False)]
        raise ValueError(f"{film} is a video, but {other} holds keypoints; give one kind of input")
    return bool(kinds) and kinds[0]


def refuse_keypoint_flags(command: Any, *flags: str) -> None:
    """Raise where a flag is set that says nothing of videos."""
    defaults = type(command).__dataclass_fields__
    given = [flag for flag in flags if getattr(command, flag) != defaults[flag].default]
    if given:
        listed = names([f"--{flag.replace('_', '-')}" for flag in given])
        raise ValueError(f"{listed}: of keypoints only, but the inputs are videos; leave it out")


class AsTheyAre:
    """Films as they were taken: there is no camera to choose."""

    settings = [""]

    def exemplar(self, film: Film, number: int) -> Any:
        """A film as it is learned from: chunks of frames with their times."""
        from indexing.video.reading import Chunk

        return [Chunk(film.frames, film.times)]

    def query(self, film: Film, number: int, view: int) -> Any:
        """A film as it is asked about."""
        return self.exemplar(film, number)


def read_examples(examples: Sequence[Example], reading: Reading, select: Sequence[str]) -> tuple[list[Any], list[str], list[float]]:
    """Sources of frames, their labels, and their seconds.

    Raises:
        ValueError: naming the file: it cannot be read, or has no label.
    """
    from indexing.readers.clipset import holds_frames

    sources: list[Any] = []
    labels: list[str] = []
    seconds: list[float] = []
    for example in examples:
        if holds_frames(example.path):
            films = read_set(example.path, reading, select)
            if example.label is not None or example.start is not None or example.end is not None:
                raise ValueError(f"{example.path}: a set of films has its own labels; give it without a label and seconds")
            sources += [AsTheyAre().exemplar(film, i) for i, film in enumerate(films)]
            labels += [str(film.label) for film in films]
            seconds += [film.duration for film in films]
            continue
        if example.label is None:
            raise ValueError(f"{example.path}: a video does not say its action; give it with its label, as in squat={example.path}")
        video, length = read_part(example, reading)
        sources.append(video)
        labels.append(example.label)
        seconds.append(length)
    return sources, labels, seconds


def read_set(path: Path, reading: Reading, select: Sequence[str] = ()) -> FilmSet:
    """The labelled films of a set that meet the criteria.

    Raises:
        ValueError: no film has a label, or none meets them.
    """
    from indexing.cli.protocol import choose
    from indexing.readers.clipset import read_film_set

    films = read_film_set(path, fps=reading.fps)
    known = films[[i for i, film in enumerate(films) if film.label is not None]]
    if not len(known):
        raise ValueError(f"{path}: says nothing of the actions; save 'action' (and 'action_names') in the set")
    return known[choose(known, select, "--select")] if select else known


def read_part(example: Example, reading: Reading) -> tuple[Any, float]:
    """The seconds of a video that count, and how many they are."""
    from indexing.video import read_video

    video = read_video(example.path.expanduser(), start=example.start, stop=example.end, fps=reading.fps)
    whole = video.info.duration
    begin, end = example.start or 0.0, whole if example.end is None else min(example.end, whole)
    return video, end - begin


@dataclass(frozen=True)
class FilmRecording:
    """A video to search, and what to call it."""

    name: str
    source: Any


def read_films(paths: Sequence[Path], reading: Reading) -> tuple[list[FilmRecording], list[str]]:
    """Videos, and the films of sets, with names that differ, and what a person should know about them."""
    from indexing.readers.clipset import holds_frames
    from indexing.video import read_video

    found: list[FilmRecording] = []
    notes: list[str] = []
    for path in paths:
        if holds_frames(path):
            found += [FilmRecording(film.name, AsTheyAre().exemplar(film, i)) for i, film in enumerate(read_set(path, reading))]
            continue
        video = read_video(path.expanduser(), fps=reading.fps)
        notes += [f"{path}: {note}" for note in video.info.notes]
        twice = [other.name for other in paths].count(path.name) > 1
        found.append(FilmRecording(str(path) if twice else path.name, video))
    return found, notes


def frame_rate(sources: Iterable[Any]) -> float:
    """The rate at which sources are compared: that of the slowest, at most 30 per second."""
    import numpy as np

    rates = []
    for one in sources:
        if isinstance(one, list):
            times = np.concatenate([chunk.times for chunk in one])
            rates.append(float(1 / np.median(np.diff(times))) if len(times) > 1 else FASTEST)
        else:
            rates.append(float(one.info.fps))
    return min(FASTEST, *rates)
