"""Videos on the command line: as the keypoints of the people in them, where a pose model is there, or as pixels."""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from indexing import pose
from indexing.brightness.indexer import BrightnessIndexer
from indexing.cli.console import check_folder, count, names, of_total, progress
from indexing.cli.flags.shared import Example, Pixels, Reading, Watched, Watching
from indexing.cli.protocol import choose
from indexing.pose import models
from indexing.pose.detection import NobodyInVideo, VideoTask, workers_here
from indexing.pose.writing import KeypointFile, kept_file, keypoint_files
from indexing.readers.files import VIDEOS, WatchOptions
from indexing.readers.formats.clipset import Film, FilmSet, holds_frames, read_film_set
from indexing.video import read_video
from indexing.video.reading import Chunk

NO_MODEL = "there is no pose model, so videos count as pixels; dyntorch pose --get-models fetches one"
FASTEST = 30.0  # frames per second that are compared at most: the window of the method was chosen at 15 and 30


def pixel_indexer(pixels: Pixels, fps: float, **options: Any) -> BrightnessIndexer:
    """A new indexer of videos."""
    return BrightnessIndexer(fps=fps, region=_region(pixels), **options)


def _region(pixels: Pixels) -> Any:
    if pixels.region in ("motion", "all"):
        return None if pixels.region == "all" else "motion"
    try:
        x0, y0, x1, y1 = (float(word) for word in pixels.region.split(","))
    except ValueError:
        raise ValueError(f"--region {pixels.region!r}: expected motion, all, or x0,y0,x1,y1 in pixels") from None
    return (x0, y0, x1, y1)


def count_as_keypoints(footage: Watching, paths: Sequence[Path]) -> bool:
    """Whether inputs are read as keypoints: files of keypoints, and videos unless their pixels are meant."""
    videos = [path for path in paths if is_video(path)]
    frames = [path for path in paths if holds_frames(path)]
    if footage.by == "pixels" or frames:
        if footage.by == "keypoints":
            raise ValueError(f"{frames[0]}: --by keypoints: holds frames, and keypoints are found in videos; leave --by out")
        if not are_films(paths):
            raise ValueError(f"{paths[0] if paths else 'no input'}: --by pixels: is no video; leave --by out, or give videos")
        return False
    return not videos or wants_keypoints(footage) or not are_films(paths)


def watch_options(footage: Watching) -> WatchOptions:
    """The same as the readers take it."""
    return WatchOptions(footage.people, None if footage.pose_model == "auto" else footage.pose_model, footage.every)


def wants_keypoints(footage: Watching) -> bool:
    """Whether the keypoints of a video are looked for."""
    return footage.by == "keypoints" or (footage.by == "auto" and pose.available() is not None)


def find_keypoints(footage: Watching, paths: Iterable[Path], beside: Path | None, fps: float | None = None) -> Watched:
    """Find the keypoints of all videos among some inputs, or find them where they were kept."""
    videos = list(dict.fromkeys(path for path in paths if is_video(path)))
    if not videos:
        return Watched({})
    for name, value in (("people", footage.people), ("every", footage.every)):
        if value < 1:
            raise ValueError(f"--{name} {value}: expected 1 or more")

    home = footage.poses.expanduser() if footage.poses is not None else None if beside is None else beside / "pose"
    usual = (footage.pose_model, footage.people, footage.every) == ("auto", Watching.people, Watching.every)
    if home is not None and not usual:  # beside what was found as usual, or by dyntorch pose, which stays
        home /= f"{footage.pose_model}-{footage.people}-{footage.every}"
    folders = _folders(videos, Path(_passing().name) if home is None else check_folder(home))
    there = {video: kept_file(video.expanduser(), folder) for folder, some in folders.items() for video in some if usual}
    keypoints: dict[Path, Path | ValueError] = {video: file for video, file in there.items() if file is not None}
    again = f"{count(len(keypoints), 'video')}: the keypoints that were kept in {home} are used"
    notes = [again] if keypoints else []
    left = {folder: [video for video in some if video not in keypoints] for folder, some in folders.items()}
    if any(left.values()):
        made, said = _detect(footage, left, fps, home)
        keypoints, notes = keypoints | made, [*notes, *said]
    return Watched(keypoints, tuple(notes))


def _detect(
    footage: Watching, folders: Mapping[Path, Sequence[Path]], fps: float | None, home: Path | None
) -> tuple[dict[Path, Path | ValueError], list[str]]:
    """The keypoint file of each video, made now, and what to know of them."""
    videos = [video for some in folders.values() for video in some]
    try:
        model = models.load_models(None if footage.pose_model == "auto" else footage.pose_model)
    except ValueError as problem:
        raise ValueError(f"{videos[0]}: is a video, and its keypoints cannot be found: {problem}") from None
    keypoints: dict[Path, Path | ValueError] = {}
    notes: list[str] = []
    for folder, some in folders.items():
        tasks = [VideoTask(video.expanduser(), footage.people, footage.every, fps, model.name) for video in some]
        with progress(f"finding people in {count(len(some), 'video')}") as tell:
            made = list(keypoint_files(tasks, folder, model, workers_here(), of_total(tell), json=False))
        for video, (_, one) in zip(some, made, strict=True):
            if not isinstance(one, KeypointFile | NobodyInVideo):
                raise one
            keypoints[video] = one.path if isinstance(one, KeypointFile) else one
            notes += [f"{video}: {note}" for note in getattr(getattr(one, "found", None), "notes", ())]
    kept = "" if home is None else f", kept in {home}/"
    return keypoints, [f"people in {count(len(videos), 'video')} found by BlazePose {model.name}, not smoothed{kept}", *notes]


_PASSING: list[tempfile.TemporaryDirectory[str]] = []


def _passing() -> tempfile.TemporaryDirectory[str]:
    """A folder that is gone when the command ends."""
    if not _PASSING:
        _PASSING.append(tempfile.TemporaryDirectory(prefix="dyntorch-pose-"))
    return _PASSING[0]


def _folders(videos: Sequence[Path], home: Path) -> dict[Path, list[Path]]:
    """Where the keypoints of each video go: those of one name, in folders of their own, go to such again."""
    owners: dict[Path, list[Path]] = {}
    times = Counter(video.stem.lower() for video in videos)
    for video in videos:
        alone = times[video.stem.lower()] == 1
        owners.setdefault(home if alone else home / video.expanduser().resolve().parent.name, []).append(video)
    return owners


def are_sets(examples: Sequence[Example]) -> bool:
    """Whether all examples are sets of frames, which are pixels in any case."""
    return not any(is_video(example.path) for example in examples)


def is_video(path: Path) -> bool:
    """Whether a path is called as videos are, and no folder."""
    return path.suffix.lower() in VIDEOS and not path.expanduser().is_dir()


def refuse_film_flags(pixels: Pixels) -> None:
    """Raise where a flag is set that says nothing of keypoints."""
    given = [name for name, field in Pixels.__dataclass_fields__.items() if getattr(pixels, name) != field.default]
    if given:
        listed = names([f"--{name.replace('_', '-')}" for name in given])
        raise ValueError(f"{listed}: of the pixels of videos only, but keypoints are compared; leave it out, or add --by pixels")


def are_films(paths: Sequence[Path]) -> bool:
    """Whether the inputs are videos or film sets, not keypoints."""
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

        return [Chunk(film.frames, film.times)]

    def query(self, film: Film, number: int, view: int) -> Any:
        """A film as it is asked about."""
        return self.exemplar(film, number)


def read_video_examples(
    examples: Sequence[Example], reading: Reading, select: Sequence[str]
) -> tuple[list[Any], list[str], list[float]]:
    """Sources of frames, their labels, and their seconds."""
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
    """The labelled films of a set that meet the criteria."""
    films = read_film_set(path, fps=reading.fps)
    known = films[[i for i, film in enumerate(films) if film.label is not None]]
    if not len(known):
        raise ValueError(f"{path}: says nothing of the actions; save 'action' (and 'action_names') in the set")
    return known[choose(known, select, "--select")] if select else known


def read_part(example: Example, reading: Reading) -> tuple[Any, float]:
    """The seconds of a video that count, and how many they are."""
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
    recordings: list[FilmRecording] = []
    notes: list[str] = []
    for path in paths:
        if holds_frames(path):
            recordings += [
                FilmRecording(film.name, AsTheyAre().exemplar(film, i)) for i, film in enumerate(read_set(path, reading))
            ]
            continue
        video = read_video(path.expanduser(), fps=reading.fps)
        notes += [f"{path}: {note}" for note in video.info.notes]
        twice = [other.name for other in paths].count(path.name) > 1
        recordings.append(FilmRecording(str(path) if twice else path.name, video))
    return recordings, notes


def frame_rate(sources: Iterable[Any]) -> float:
    """The rate at which sources are compared: that of the slowest, at most 30 per second."""
    rates = []
    for one in sources:
        if isinstance(one, list):
            times = np.concatenate([chunk.times for chunk in one])
            rates.append(float(1 / np.median(np.diff(times))) if len(times) > 1 else FASTEST)
        else:
            rates.append(float(one.info.fps))
    return min(FASTEST, *rates)
