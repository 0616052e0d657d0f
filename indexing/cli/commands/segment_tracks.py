"""``dyntorch segment`` of whole videos and of tables of tracks: bodies through all frames."""

from __future__ import annotations

import dataclasses
import re
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

import dyntorch
from dyntorch.numerics import with_words
from indexing.cli.console import check_report, count, flag_words, present, progress
from indexing.cli.flags.geometry import Segment
from indexing.cli.scenes import Asked, as_tracks, follow_whole, inputs_of, is_video, photographs, source_of
from indexing.files import manifest
from indexing.readers.matches import MatchedPair, Photograph
from indexing.readers.tracks import TrackSet, read_tracks
from indexing.report.bodies import FILES, FILM, PANELS, BodiesReport
from indexing.report.segmentation import colour_of
from indexing.video.drawing import Overlay, write_overlay
from indexing.video.scene import SceneTracks, evenly_spaced
from indexing.video.sequence import PictureSequence, chunks

WORDS = flag_words("bodies", "threshold", cameras="the cameras (in Python: cameras=)")
LEAST = 8  # tracks, or matches
SMALL = 50  # thresholds across the points, below which these are hardly pixels
UNTIMED = 10.0  # frames per second of the video that is written where nobody says how fast pictures follow each other


@dataclass(frozen=True, eq=False)
class Given:
    """Tracks, and where they come from."""

    tracks: TrackSet  # through two frames at least
    followed: SceneTracks | None = None  # points of a video or of pictures; None where a file has the tracks

    def as_pair(self) -> MatchedPair:
        """Two frames, as a file of matches would give them."""

        tracks, size = self.tracks, None
        if self.followed is not None:
            size = (float(self.followed.size[0]), float(self.followed.size[1]))
        x1, x2 = flat(tracks)
        weights = None if tracks.weights is None else tracks.weights.min(axis=0)
        return MatchedPair(tracks.path, Path(tracks.path).name, x1, x2, tracks.ids, weights, tracks.known, size)


def track_inputs(flags: Segment) -> list[Path]:
    """The files that are read."""
    return inputs_of([path.expanduser() for path in (*flags.files, *(flags.images or ()))])


def read_given(files: Sequence[Path], scene: bool, asked: Asked, key: str | None) -> Given:
    """The tracks of a video, of pictures, or of files."""
    if scene:
        followed = follow_whole(files, asked)
        return Given(as_tracks(followed, files[0], is_video(files[0])), followed)

    span = asked.span()
    if span is not None:
        return Given(_within(read_tracks(files, key=key), span))
    frames = None if asked.frames is None else [word.strip() for word in asked.frames.split(",")]
    return Given(read_tracks(files, frames=frames, key=key))


def _within(tracks: TrackSet, span: tuple[int, int]) -> TrackSet:
    """The views whose numbers, or times, are in a span."""
    views = [name for name in tracks.views if re.fullmatch(r"-?\d+(\.\d+)?", name) and span[0] <= float(name) <= span[1]]
    if len(views) < 2:
        said = f"{tracks.path}: --frames {span[0]}-{span[1]}: {count(len(views), 'frame')} of it, and 2 are needed"
        raise ValueError(f"{said}; its {len(tracks.views)} frames are {tracks.views[0]} to {tracks.views[-1]}")
    return tracks.select(views)


def flat(tracks: TrackSet) -> Any:
    """Positions ``(views, n, 2)`` as a camera sees them."""
    if tracks.values.shape[-1] != 2:
        raise ValueError(f"{tracks.path}: holds 3D points, and segment takes what a camera sees; give columns x, y alone")
    return tracks.values


def run_bodies(flags: Segment, given: Given, read: float) -> int:
    """Segment, draw, write, and say what was found."""
    folder = check_report(flags.out, track_inputs(flags), FILES)
    tracks = given.tracks
    notes = [*tracks.notes, *check_tracks(tracks, float(flags.threshold))]
    pictures = Pictures.of(flags, given)
    started = time.perf_counter()
    seen = int((_frame_counts(tracks) > 1).sum())
    with progress(f"segmenting {count(seen, 'track')}", steps=False):
        result = solve(tracks, flags)
    timings = {"read": read, "segment": time.perf_counter() - started}
    found = int(result.bodies)
    if flags.bodies != "auto" and 0 < found < flags.bodies:
        notes.append(f"--bodies asks for {flags.bodies}, the tracks carry {found}")
    notes += stretches(tracks, result)
    shown = {} if pictures is None or folder is None else pictures.read_photographs(given)
    report = BodiesReport(
        result=result, tracks=tracks, photographs=shown, size=flags.size, heading=flags.title or "", notes=notes, words=WORDS,
        manifest=manifest({"command": "segment", **dataclasses.asdict(flags)}, track_inputs(flags), flags.seed, timings),
    )  # fmt: skip
    if folder is not None and pictures is not None and report.bodies:
        with progress("drawing the video", steps=False):
            report = pictures.draw_video(report)
    return present(report, folder)


def check_tracks(tracks: TrackSet, threshold: float) -> list[str]:
    """What to say about the input."""
    values = flat(tracks)
    number = len(tracks.ids)
    short = int((_frame_counts(tracks) < 2).sum())
    if short == number:
        said = f"{tracks.path}: none of its {number} tracks is seen in two frames"
        raise ValueError(f"{said}; a point keeps its id from frame to frame, check the column id")
    if number - short < LEAST:
        raise ValueError(f"{tracks.path}: {count(number - short, 'track')} in two frames or more, {LEAST} are needed; give more")
    notes = []
    if short:
        was = count(short, "track is seen in fewer than two frames and was", "tracks are seen in fewer than two frames and were")
        notes.append(f"{was} left out")
    if tracks.weights is not None and len(np.unique(tracks.weights[tracks.weights > 0])) > 1:
        notes.append("weights of 0 leave an observation out; all others count alike")
    extent = float(np.nanmax(np.nanmax(values, axis=(0, 1)) - np.nanmin(values, axis=(0, 1))))
    return notes + unit_notes(tracks.path, extent, threshold, auto=False)


def unit_notes(path: str, extent: float, threshold: float | None, auto: bool = True) -> list[str]:
    """That points are hardly pixels."""
    if threshold is None or extent >= SMALL * threshold:
        return []
    said = f"the points lie within {extent:.3g}, and --threshold is {threshold:g}"
    if 0 < extent <= threshold:
        raise ValueError(f"{path}: {said}: give --threshold in the unit of the points{', or --threshold auto' * auto}")
    return [f"{said}; if they are not in pixels, give --threshold in their unit{', or auto' * auto}"]


def _frame_counts(tracks: TrackSet) -> Any:
    """``(n,)`` in how many frames each track is seen."""
    return np.isfinite(tracks.values).all(axis=-1).sum(axis=0)


def solve(tracks: TrackSet, flags: Segment) -> Any:
    """The segmentation, by the library.

    Raises:
        ValueError: naming the file.
    """
    values = tracks.values
    if tracks.weights is not None:
        values = np.where(tracks.weights[..., None] > 0, values, np.nan)
    try:
        return dyntorch.segment_tracks(
            torch.from_numpy(values),
            bodies=None if flags.bodies == "auto" else int(flags.bodies),
            threshold=float(flags.threshold),
            generator=torch.Generator().manual_seed(flags.seed),
        )
    except ValueError as problem:
        raise ValueError(f"{tracks.path}: {with_words(problem, WORDS)}") from problem


def stretches(tracks: TrackSet, result: Any) -> list[str]:
    """Which frames to give where the scene changes."""
    views = tracks.views
    if tracks.by_time or not all(re.fullmatch(r"\d+", name) for name in views):
        return []
    cuts = [int(notice.values["frame"]) for notice in result.notices if notice.code == "cut" and "frame" in notice.values]
    before = [f"--frames {views[0]}-{views[cut - 1]}" for cut in cuts if 1 < cut < len(views)]
    after = [f"--frames {views[cut]}-{views[-1]}" for cut in cuts if 0 < cut < len(views) - 1]
    return [f"{' or '.join([*before, *after])}: the frames of one scene"] if before or after else []


# ----------------------------------------------------------------------------------------------------------------------
# The pictures behind the tracks: those that they were found in, or those of --images.


@dataclass(frozen=True, eq=False)
class Pictures:
    """Where pictures come from, and which of them belong to the views."""

    source: Any  # a video, a folder, a pattern, or pictures
    frames: tuple[int, ...]  # number of the picture of each view

    @staticmethod
    def of(flags: Segment, given: Given) -> Pictures | None:
        """Those that are asked for, if there are any."""
        if given.followed is not None:
            return Pictures(source_of([path.expanduser() for path in flags.files]), given.followed.frames)
        if not flags.images or flags.out is None:
            return None

        source, views = source_of([path.expanduser() for path in flags.images]), given.tracks.views
        stream: Any = chunks(source)
        number = len(stream) if isinstance(stream, PictureSequence) else stream.info.frames
        if number == len(views):
            return Pictures(source, tuple(range(number)))
        if not given.tracks.by_time and all(re.fullmatch(r"\d+", name) for name in views):
            numbers = [int(name) for name in views]
            if numbers == sorted(set(numbers)) and numbers[-1] < number:
                return Pictures(source, tuple(numbers))
        said = f"--images {flags.images[0]}: {count(number, 'picture')}, and the tracks have {len(views)} frames"
        raise ValueError(f"{said} ({views[0]} to {views[-1]}); give a picture for each, or the whole video with frames from 0")

    def read_photographs(self, given: Given) -> dict[int, Photograph]:
        """Some of them, by their views."""

        if given.followed is not None:
            places = given.followed.pictured or range(len(self.frames))
            return dict(zip(places, photographs(given.followed), strict=True))
        wanted = {self.frames[i]: i for i in evenly_spaced(len(self.frames), PANELS)}
        found, index = {}, 0
        stream: Any = chunks(self.source, size=1280)
        for chunk in stream:
            for image in chunk.frames:
                if index in wanted:
                    across, down = (round(side / by) for side, by in zip(image.shape[::-1], stream.scale, strict=True))
                    gray = np.divide(image, 255, dtype=np.float32)
                    found[wanted[index]] = Photograph(f"frame {index}", gray, (float(across), float(down)))
                index += 1
        return found

    def draw_video(self, report: BodiesReport) -> BodiesReport:
        """The report with the video in which the tracks are drawn."""

        from matplotlib.colors import to_rgb

        tracks = report.tracks
        labels = range(1, report.bodies + 1)
        reach = 0.0 if tracks.times is None else float(tracks.times[-1] - tracks.times[0])
        overlay = Overlay(
            points=tracks.values,
            frames=self.frames,
            size=next(iter(report.photographs.values())).size,
            groups=report.arrays.labels,
            names=[f"body {label}" + " (static)" * (label == report.static) for label in labels],
            colours=[_rgb(to_rgb(colour_of(label))) for label in labels],
            captions=_captions(tracks),
        )
        film = write_overlay(self.source, overlay, (len(tracks.views) - 1) / reach if reach > 0 else UNTIMED)
        return replace(report, besides={**report.besides, FILM: film})


def _captions(tracks: TrackSet) -> list[str]:
    if tracks.times is None or tracks.by_time:
        return [f"{name} s" if tracks.by_time else f"frame {name}" for name in tracks.views]
    return [f"frame {name}  {moment:.2f} s" for name, moment in zip(tracks.views, tracks.times.tolist(), strict=True)]


def _rgb(colour: tuple[float, float, float]) -> tuple[int, int, int]:
    red, green, blue = (round(255 * part) for part in colour)
    return red, green, blue
