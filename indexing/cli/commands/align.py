"""``dyntorch align``: how a sensor moved among things that move, and what stood still."""

from __future__ import annotations

import dataclasses
import time
from typing import Any

import torch

import dyntorch
from dyntorch.numerics import with_words
from indexing.cli.console import check_report, check_seed, count, flag_words, names, present, progress
from indexing.cli.flags.geometry import Align
from indexing.cli.scenes import (
    Asked,
    as_matches,
    calibration_files,
    follow,
    inputs_of,
    is_scene,
    photographs,
    tracks_csv,
    undistort_views,
)
from indexing.files import manifest
from indexing.readers.matches import Matched, read_matches
from indexing.report.alignment import FILES, PURPOSE, AlignmentReport
from indexing.video.scene import SCENE_FOLLOWING, THRESHOLD, SceneTracks

SEVERAL = ("planar", "join", "minimal_join")
"""Models that take more than three views."""
WORDS = flag_words(
    "model", "threshold", "motion", "calibration", static="a column static", static_points="--static-points FILE FILE"
)


def run(flags: Align) -> int:
    """Read, align, write, and say what was found."""
    inputs = [path.expanduser() for path in (*flags.files, *flags.static_points)]
    _check(flags)
    scene, asked = is_scene(inputs), Asked(flags.frames, flags.at)
    asked.check(scene)
    inputs = [*(inputs_of(inputs) if scene else inputs), *calibration_files(flags.calibration)]

    folder = check_report(flags.out, inputs, FILES)
    started = time.perf_counter()
    with progress("reading", steps=False):
        matched, tracks = _read(flags, asked if scene else None)
    model, notes = _model(flags, matched)
    threshold = _limit(flags, tracks)
    if flags.threshold is None and threshold is not None:
        notes.append(f"threshold {threshold:.3g} px, that of points followed through videos; --threshold says otherwise")
    read = time.perf_counter()
    with progress(f"aligning {count(len(matched.ids), 'match', 'matches')}", steps=False):
        result = _solve(flags, matched, model, threshold)
    timings = {"read": read - started, "align": time.perf_counter() - read}
    arguments = {"command": "align", **dataclasses.asdict(flags), "model": model}
    report = AlignmentReport(
        result=result,
        read=matched,
        model=model,
        threshold=threshold,
        notes=[*notes, *matched.notes],
        words=WORDS,
        manifest=manifest(arguments, inputs, flags.seed, timings),
        photographs=photographs(tracks) if tracks else (),
        besides={"tracks.csv": tracks_csv(tracks)} if tracks else {},
    )
    return present(report, folder)


def _check(flags: Align) -> None:
    """Raise on flags that make no sense by themselves, before any file is read."""
    if not flags.files:
        raise ValueError("no files; give a file of points for each view, or one .npz or .c3d with all of them")
    if flags.threshold not in ("auto", None) and not 0 < float(flags.threshold) < float("inf"):
        raise ValueError(f"--threshold must be a positive distance in the unit of the files or auto, got {flags.threshold}")
    check_seed(flags.seed)


def _read(flags: Align, asked: Asked | None) -> tuple[Matched, SceneTracks | None]:
    """The matches, and the tracks that they are where ``asked`` says frames of a video."""
    if asked is None:
        return read_matches(flags.files, frames=frame_numbers(flags.frames), static_points=flags.static_points), None
    if flags.static_points:
        raise ValueError("--static-points are of lines, and a video has points; leave it out")
    if flags.model not in (None, "planar"):
        raise ValueError(f"--model {flags.model} needs 3D points or lines, and a video has 2D points; use --model planar")
    tracks = follow(flags.files, asked, views=3, more=True)
    return as_matches(tracks), tracks


def _model(flags: Align, matched: Matched) -> tuple[str, list[str]]:
    """The model, and what to say about it."""
    dims, kind = matched.dims, "lines" if matched.lines else f"{matched.dims[0]}D points"
    given = flags.model or ("lines" if matched.lines else "planar" if dims[0] == 2 else "rigid")
    odd = next((i for i, d in enumerate(dims) if d != dims[0]), None)
    if odd is not None:
        raise ValueError(f"{matched.names[odd]}: holds {dims[odd]}D points, {matched.names[0]} {dims[0]}D; give one kind")
    needed = {"planar": "2D points", "lines": "lines"}.get(given, "3D points")
    if needed != kind:
        fitting = "lines" if matched.lines else "planar" if dims[0] == 2 else "rigid, join or another of 3D points"
        raise ValueError(f"{matched.names[0]}: holds {kind}, --model {given} needs {needed}; use --model {fitting}")
    views = 2 if given == "lines" else 3
    if len(dims) != views and not (given in SEVERAL and len(dims) > views):
        have = f"{count(len(dims), 'view')} ({names(matched.names)})"
        raise ValueError(f"--model {given} needs {views} views, got {have}; give {views} files, or {views} frames of one")
    if flags.motion != "straight" and given != "rigid":
        raise ValueError(f"--motion {flags.motion} belongs to --model rigid, got {given}; use --model constant_velocity")
    if flags.calibration is not None and given != "planar":
        raise ValueError(f"--calibration is of cameras, and --model {given} of 3D sensors, which need none; leave it out")
    if flags.model is not None:
        return given, []

    others = ", ".join(name for name in PURPOSE if name not in ("planar", "lines", given))
    hint = f"; if their scale or axes are not to be trusted, say --model with one of {others}" if given == "rigid" else ""
    return given, [f"model {given}, because the files hold {kind}{hint}"]


def _limit(flags: Align, tracks: SceneTracks | None) -> float | None:
    """The threshold as the library takes it; None = estimated."""
    if flags.threshold is None and tracks is not None:
        return THRESHOLD * max(1.0, max(tracks.size) / SCENE_FOLLOWING.working_side)
    return None if flags.threshold in ("auto", None) else float(flags.threshold)


def _solve(flags: Align, matched: Matched, model: str, threshold: float | None) -> Any:
    """The alignment, by the library."""
    views = [torch.from_numpy(view) for view in matched.views]
    options: dict[str, Any] = {
        "threshold": threshold,
        "weights": None if matched.weights is None else torch.from_numpy(matched.weights),
        "generator": torch.Generator().manual_seed(flags.seed),
    }
    if matched.static is not None:
        options["static"] = torch.from_numpy(matched.static)
    try:
        if model == "planar":
            straight, matrices = undistort_views(flags.calibration, torch.stack(views))
            return dyntorch.align_planar(*straight, calibration=matrices, **options)
        if model == "lines":
            points = tuple(torch.from_numpy(part) for part in matched.static_points)
            return dyntorch.align_lines(*views, static_points=points or None, **options)
        return dyntorch.align_points(*views, model=model, motion=flags.motion, **options)
    except ValueError as problem:
        raise ValueError(f"{names(matched.names)}: {with_words(problem, WORDS)}") from problem


def frame_numbers(text: str | None) -> tuple[int, ...] | None:
    """``10,20,30`` as numbers."""
    if text is None:
        return None
    try:
        return tuple(int(word) for word in text.split(","))
    except ValueError:
        raise ValueError(f"--frames {text!r}: expected whole numbers with commas between them, such as --frames 10,20,30") from None
