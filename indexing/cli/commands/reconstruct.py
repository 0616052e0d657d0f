"""``dyntorch reconstruct``: cameras, points and velocities from tracks of points that all may move."""

from __future__ import annotations

import dataclasses
import math
import re
import time
from typing import Any

import numpy as np
import torch

import dyntorch
from dyntorch.numerics import with_words
from indexing.cli.console import check_report, check_seed, count, flag_words, present, progress
from indexing.cli.flags.geometry import Reconstruct
from indexing.cli.scenes import (
    Asked,
    as_tracks,
    calibration_files,
    follow,
    inputs_of,
    is_scene,
    is_video,
    photographs,
    tracks_csv,
    undistort_views,
)
from indexing.files import manifest
from indexing.readers.tracks import TrackSet, read_tracks, shortest_repr
from indexing.report.reconstruction import FILES, ReconstructionReport

WORDS = flag_words("times", "static", "threshold", "motion", "calibration")
UNFIXED = (
    "no point is known to stand still, so that a motion common to all is open and none can be told to rest; "
    "--static names some that do"
)


def run(flags: Reconstruct) -> int:
    """Read, reconstruct, write, and say what was found."""
    given = (*flags.files, *((flags.static,) if flags.static else ()), *calibration_files(flags.calibration))
    inputs = [path.expanduser() for path in given]
    _check(flags)
    scene, asked = is_scene([path.expanduser() for path in flags.files]), Asked(flags.frames, flags.at, flags.every)
    _check_scene(flags, scene, asked)
    inputs = inputs_of(inputs) if scene else inputs

    folder = check_report(flags.out, inputs, FILES)
    started = time.perf_counter()
    with progress("reading", steps=False):
        frames = None if flags.frames is None else [word.strip() for word in flags.frames.split(",")]
        followed = follow(flags.files, asked, missing=True, fps=flags.fps) if scene else None
        filmed = as_tracks(followed, flags.files[0], _has_frame_times(flags)) if followed else None
        tracks = _with_times(flags, filmed or read_tracks(flags.files, frames=frames, key=flags.key, static=flags.static))
    read = time.perf_counter()
    with progress(f"reconstructing {count(len(tracks.ids), 'track')}", steps=False):
        result = _solve(flags, tracks)
    timings = {"read": read - started, "reconstruct": time.perf_counter() - read}
    limit = _limit(flags)
    report = ReconstructionReport(
        result=result,
        tracks=tracks,
        threshold=None if limit == math.inf else limit,
        notes=[*tracks.notes, *open_motion_notes(tracks, result)],
        words=WORDS,
        manifest=manifest({"command": "reconstruct", **dataclasses.asdict(flags)}, inputs, flags.seed, timings),
        photograph=photographs(followed)[0] if followed else None,
        besides={"tracks.csv": tracks_csv(followed)} if followed else {},
    )
    return present(report, folder)


def _check(flags: Reconstruct) -> None:
    """Raise on flags that make no sense by themselves, before any file is read."""
    if not flags.files:
        raise ValueError("no files; give a table of tracks with columns frame, id, x, y, an .npz, or a file for each view")
    _limit(flags)
    if flags.fps is not None and not 0 < flags.fps < float("inf"):
        raise ValueError(f"--fps must be a positive number of frames per second, got {flags.fps:g}")
    if flags.fps is not None and flags.times is not None:
        raise ValueError("--fps and --times both give times; leave one out")
    check_seed(flags.seed)


def _check_scene(flags: Reconstruct, scene: bool, asked: Asked) -> None:
    """Raise on flags that do not fit what is given."""
    asked.check(scene)
    for flag in ("key", "static"):
        if scene and getattr(flags, flag) is not None:
            raise ValueError(f"--{flag} is of files of tracks, and a video or pictures are given; leave it out")
    if scene and flags.fps is not None and _has_frame_times(flags):
        raise ValueError(f"--fps {flags.fps:g}: a video has the times of its frames; leave it out")


def _has_frame_times(flags: Reconstruct) -> bool:
    """Whether the frames have times of their own, or a rate that was given."""
    return is_video(flags.files[0])


def _limit(flags: Reconstruct) -> float | None:
    """The threshold as the library takes it: None = estimated, inf = all tracks fit."""
    if flags.threshold in ("auto", "none"):
        return None if flags.threshold == "auto" else math.inf
    try:
        limit = float(flags.threshold)
    except ValueError:
        limit = math.nan
    if not 0 < limit < math.inf:
        said = "--threshold must be a positive distance in the unit of the tracks, auto or none"
        raise ValueError(f"{said}, got {flags.threshold}")
    return limit


def _with_times(flags: Reconstruct, tracks: TrackSet) -> TrackSet:
    """The tracks with times that begin at 0, and what to say about them."""
    notes = []
    if flags.times is not None:
        times = numbers(flags.times, len(tracks.views))
    elif tracks.times is not None and flags.fps is None:
        times = tracks.times
    else:
        numbered = all(re.fullmatch(r"-?\d+(\.\d+)?", name) for name in tracks.views)
        times = np.array([float(name) for name in tracks.views]) if numbered else np.arange(float(len(tracks.views)))
        if flags.fps is None:
            unit = "the numbers of the frames" if numbered else "0, 1, 2, ..., one per file"
            notes.append(f"times are {unit}, because the files have none; --times or --fps give others")
        else:
            times = times / flags.fps
    timed = dataclasses.replace(tracks.drop_short(), times=times).since_first()
    if timed.start != 0:
        notes.append(f"time 0 of the result is the first view, at {shortest_repr(timed.start)}")
    return dataclasses.replace(timed, notes=(*timed.notes, *notes))


def _solve(flags: Reconstruct, tracks: TrackSet) -> Any:
    """The reconstruction, by the library."""
    values, matrices = undistort_views(flags.calibration, torch.from_numpy(tracks.values))
    try:
        return dyntorch.reconstruct(
            values,
            flags.motion,
            torch.from_numpy(tracks.times),
            static=None if tracks.static is None else torch.from_numpy(tracks.static),
            threshold=_limit(flags),
            weights=None if tracks.weights is None else torch.from_numpy(tracks.weights),
            calibration=matrices,
            generator=torch.Generator().manual_seed(flags.seed),
        )
    except ValueError as problem:
        raise ValueError(f"{tracks.path}: {with_words(problem, WORDS)}") from problem


def open_motion_notes(tracks: TrackSet, result: Any) -> list[str]:
    """That a motion common to all points is open, where it is."""
    known = tracks.static is not None and bool(tracks.static.any())
    decided = int(result.status) == 0 and result.velocities is not None and not result.motion.static
    return [UNFIXED] if decided and not known else []


def numbers(text: str, expected: int) -> Any:
    """``0,0.5,1.2`` as numbers, one per view."""
    try:
        found = np.array([float(word) for word in text.split(",")])
    except ValueError:
        raise ValueError(f"--times {text!r}: expected numbers with commas between them, such as --times 0,0.5,1.2") from None
    if len(found) != expected or not np.isfinite(found).all():
        raise ValueError(f"--times {text!r}: {len(found)} times for {expected} views; give one finite number per view")
    return found
