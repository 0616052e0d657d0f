"""``dyntorch segment``: what moves together, between two images or through a whole video, and how each body moves."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import time
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

import numpy as np
import torch

import dyntorch
from dyntorch.numerics import with_words
from indexing.archive.workers import QuietProcesses
from indexing.cli.commands.segment_tracks import LEAST, Given, read_given, run_bodies, track_inputs, unit_notes
from indexing.cli.console import (
    check_folder,
    check_report,
    check_seed,
    count,
    flag_words,
    keep,
    names,
    of_total,
    present,
    progress,
)
from indexing.cli.flags.geometry import Segment
from indexing.cli.scenes import LEFT_OUT, PICTURE_FILES, Asked, as_pair, follow, inputs_of, is_scene, photographs, tracks_csv
from indexing.colmap import MatchDatabase, check_target, find_static, read_database
from indexing.colmap.pair_segmentation import colmap
from indexing.colmap.static import MIN_PARALLEL_PAIRS, write_masks
from indexing.files import manifest
from indexing.readers.matches import MatchedPair, Photograph, read_image, read_pair
from indexing.readers.tracks import holds_tracks
from indexing.report.segmentation import FILES, SegmentationReport
from indexing.report.static import FILES as STATIC_FILES
from indexing.report.static import StaticReport, images_drawn
from indexing.video.scene import SceneTracks

WORDS = flag_words("bodies", "threshold", "spatial")
OUTSIDE = 0.02  # of the matches, beyond which an image is hardly the one they were found in


def run(flags: Segment) -> int:
    """Read, segment, write, and say what was found."""
    _check(flags)
    if flags.colmap is not None or flags.masks is not None:
        return _from_colmap(flags)
    files = [path.expanduser() for path in flags.files]
    scene, asked = is_scene(files), Asked(flags.frames, flags.at, flags.every)
    whole = _is_whole(flags, files, scene, asked)
    _check_kind(flags, scene, whole, asked)
    started = time.perf_counter()
    given = None
    if whole:
        check_report(flags.out, track_inputs(flags), ())
        with progress("reading", steps=False):
            given = read_given(files, scene, asked, flags.key)
        if len(given.tracks.views) > 2:
            return run_bodies(flags, given, time.perf_counter() - started)
    return _two_views(flags, files, scene, asked, given)


def _from_colmap(flags: Segment) -> int:
    """The static matches of a database."""
    if flags.colmap is None:
        raise ValueError(f"--masks {flags.masks}: it is for --colmap DATABASE; leave it out")
    if flags.files:
        raise ValueError(f"{flags.files[0]}: --colmap {flags.colmap} gives the matches; leave one out")
    for flag in ("pair", "key", "frames", "at", "every", "size"):
        if getattr(flags, flag) is not None:
            raise ValueError(f"--{flag} does not go with --colmap; leave it out")
    if flags.bodies != "auto":
        raise ValueError(f"--bodies {flags.bodies} does not go with --colmap, whose pairs differ; leave it out")
    if flags.images is not None and len(flags.images) != 1:
        raise ValueError(f"--images: {len(flags.images)} are given; with --colmap, give the folder of the images")
    return run_colmap(flags)


def _two_views(flags: Segment, files: list[Path], scene: bool, asked: Asked, given: Given | None) -> int:
    """The same of matches of two images, or of tracks through two frames."""
    inputs = [*files, *(path.expanduser() for path in flags.images or ())]
    inputs = inputs_of(inputs) if scene else inputs

    folder = check_report(flags.out, inputs, FILES)
    started = time.perf_counter()
    with progress("reading", steps=False):
        pair, tracks = _pair(flags, files, scene, asked, given)
        shown = photographs(tracks) if tracks else _images(flags, given is not None)
    notes = [*(tracks.notes if tracks else ()), *_notes(flags, pair, shown)]
    read = time.perf_counter()
    with progress(f"segmenting {count(int(pair.complete.sum()), 'match', 'matches')}", steps=False):
        result = _solve(flags, pair)
    timings = {"read": read - started, "segment": time.perf_counter() - read}
    found = int(result.bodies)
    if flags.bodies != "auto" and 0 < found < flags.bodies:
        notes.append(f"--bodies asks for {flags.bodies}, the matches carry {found}")
    report = SegmentationReport(
        result=result,
        pair=pair,
        photographs=shown,
        size=flags.size or pair.size,
        heading=flags.title or "",
        notes=notes,
        words=WORDS,
        manifest=manifest({"command": "segment", **dataclasses.asdict(flags)}, inputs, flags.seed, timings),
        besides={"tracks.csv": tracks_csv(tracks)} if tracks else {},
    )
    return present(report, folder)


def _pair(
    flags: Segment, files: list[Path], scene: bool, asked: Asked, given: Given | None
) -> tuple[MatchedPair, SceneTracks | None]:
    """The matches, and the two frames where they were followed."""
    if given is not None:
        return given.as_pair(), given.followed
    if scene:
        tracks = follow(files, asked, views=2)
        return as_pair(tracks, files[0]), tracks
    return read_pair(files[0], flags.pair), None


def _images(flags: Segment, tracked: bool) -> list[Photograph]:
    """Both images."""
    images = flags.images or ()
    if images and len(images) != 2:
        of = "tracks through two frames" if tracked else "matches"
        raise ValueError(f"--images: {count(len(images), 'is', 'are')} given, and {of} are drawn on two; give both images")
    return [read_image(path) for path in images]


def _is_whole(flags: Segment, files: list[Path], scene: bool, asked: Asked) -> bool:
    """Whether the inputs are tracks, or a video or pictures of which more than two frames are taken."""
    if not scene:
        return flags.pair is None and len(files) == 1 and (flags.key is not None or holds_tracks(files[0]))
    if asked.span() is not None:
        return True
    named = asked.numbers() or asked.moments()
    pictures = len(files) == 2 and all(path.suffix.lower() in PICTURE_FILES for path in files)
    return len(named) != 2 if named is not None else not pictures


def _check(flags: Segment) -> None:
    """Raise on flags that make no sense by themselves, before any file is read."""
    if flags.bodies != "auto" and int(flags.bodies) < 1:
        raise ValueError(f"--bodies must be a whole number from 1, or auto, got {flags.bodies}")
    if flags.threshold != "auto" and not 0 < float(flags.threshold) < float("inf"):
        raise ValueError(f"--threshold must be a positive distance in pixels or auto, got {flags.threshold}")
    if flags.size is not None and not all(0 < side < float("inf") for side in flags.size):
        raise ValueError(f"--size must be width and height in pixels, such as 640 480, got {flags.size[0]:g} {flags.size[1]:g}")
    if flags.images is not None and not flags.images:
        raise ValueError("--images: its value is missing; give both images of matches, or the video or pictures of tracks")
    if flags.size is not None and flags.images is not None:
        raise ValueError("--size and --images both say how large the images are; leave one out")
    check_seed(flags.seed)


def _check_kind(flags: Segment, scene: bool, whole: bool, asked: Asked) -> None:
    """Raise on flags that do not fit what is given."""
    if not flags.files:
        raise ValueError("no input; give a video, a file of tracks, or a file of matches with x1, x2")
    if flags.pair is not None and flags.key is not None:
        raise ValueError("--pair is of files of matches and --key of files of tracks; leave one out")
    if not scene and len(flags.files) > 1:
        raise ValueError(f"{len(flags.files)} files; give one file of tracks or of matches, or pictures alone")
    if not scene and not whole and flags.frames is not None:
        raise ValueError(f"--frames {flags.frames}: {LEFT_OUT}, or for a file of tracks; leave it out")
    asked.check(scene)
    for flag in ("pair", "images", "size", "key"):
        if scene and getattr(flags, flag) is not None:
            of = "files of tracks" if flag == "key" else "files of matches" if flag == "pair" else "files of matches or tracks"
            raise ValueError(f"--{flag} is of {of}, and a video or pictures are given; leave it out")
    if whole and flags.threshold == "auto":
        said = "--threshold auto is of two images, and more frames are given; their noise is found from the tracks"
        raise ValueError(f"{said}, give the usual distance in pixels, such as --threshold 2.5")
    if whole and not flags.spatial:
        raise ValueError("--no-spatial is of two images, and more frames are given; leave it out")


def _notes(flags: Segment, pair: MatchedPair, shown: list[Photograph]) -> list[str]:
    """What to say about the input."""
    seen = pair.complete
    number, lost = int(seen.sum()), int((~seen).sum())
    if number < LEAST:
        said = f"{pair.path}: x1, x2 hold {number} complete matches{f' and {lost} with a missing coordinate' * (lost > 0)}"
        raise ValueError(f"{said}, {LEAST} are needed; give more matches")
    notes = []
    if lost:
        was = count(lost, "match lacks a coordinate and was", "matches lack a coordinate and were")
        notes.append(f"{was} left out")
    reach = float(np.ptp(np.concatenate([pair.x1[seen], pair.x2[seen]]), axis=0).max())
    notes += unit_notes(pair.path, reach, None if flags.threshold == "auto" else float(flags.threshold))
    size = flags.size or pair.size
    frames = [(photograph.name, photograph.size) for photograph in shown]
    frames = frames or [(f"image {i}", size) for i in (1, 2) if size is not None]
    for (name, (wide, tall)), points in zip(frames, (pair.x1[seen], pair.x2[seen]), strict=False):
        out = int(((points < -0.5) | (points > np.array([wide, tall]) - 0.5)).any(axis=1).sum())
        if out > OUTSIDE * number:
            said = f"{out:,} of {number:,} matches lie outside of {name} ({wide:g} by {tall:g})"
            what = "images" if shown else "size of the images"
            notes.append(f"{said}; give the {what} in which the matches were found, in their order, and x before y")
    return notes


def _solve(flags: Segment, pair: MatchedPair) -> Any:
    """The segmentation, by the library."""
    try:
        return dyntorch.segment(
            torch.from_numpy(pair.x1),
            torch.from_numpy(pair.x2),
            bodies=None if flags.bodies == "auto" else int(flags.bodies),
            threshold=None if flags.threshold == "auto" else float(flags.threshold),
            weights=None if pair.weights is None else torch.from_numpy(pair.weights),
            spatial=flags.spatial,
            generator=torch.Generator().manual_seed(flags.seed),
        )
    except ValueError as problem:
        raise ValueError(f"{pair.path}: {with_words(problem, WORDS)}") from problem


# ----------------------------------------------------------------------------------------------------------------------
# ``--colmap``: which matches of a COLMAP database stand still, written as a database for its mapper.


def run_colmap(flags: Segment) -> int:
    """Read, divide, vote, write, and say what was found; the report goes into the folder ``NAME-report`` beside the database."""
    if flags.colmap is None or flags.out is None:
        raise ValueError("--colmap: where to? name the database to write, --out static.db")
    database, out = flags.colmap.expanduser(), flags.out.expanduser()
    images = flags.images[0] if flags.images else None
    threshold = None if flags.threshold == "auto" else float(flags.threshold)
    out = check_target(out, database)
    check_folder(out.parent)
    keep([database], [out])
    folder = check_report(out.with_name(f"{out.stem}-report"), [database], STATIC_FILES)
    masks = check_folder((flags.masks or out.with_name(f"{out.stem}-masks")).expanduser())
    assert folder is not None
    _check_images(images)
    if images is not None and masks.resolve() == images.expanduser().resolve():
        raise ValueError(f"--masks {masks}: is the folder of the images; give masks a folder of their own")
    started = time.perf_counter()
    with progress("reading", steps=False):
        held = read_database(database)
        colmap()
        shown, notes = _photographs(held, images)
    read = time.perf_counter()
    with progress(f"segmenting {count(len(held.pairs), 'pair')}") as tell, _workforce(len(held.pairs)) as executor:
        found = find_static(held, threshold, flags.spatial, flags.seed, progress=of_total(tell), executor=executor)
    timings = {"read": read - started, "segment": time.perf_counter() - read}
    if found.ok:
        with progress("writing", steps=False):
            write_masks(masks, found)
            found.write(out)
    report = StaticReport(
        static=found,
        written=str(out) if found.ok else "",
        masks=str(masks) if found.ok else "",
        photographs=shown,
        heading=flags.title or "",
        notes=notes,
        manifest=manifest({"command": "segment", **dataclasses.asdict(flags)}, [database], flags.seed, timings),
    )
    return present(report, folder)


def _workforce(pairs: int) -> contextlib.AbstractContextManager[Executor | None]:
    """All cores, where that is worth it."""
    cores = os.cpu_count() or 1
    return contextlib.nullcontext() if cores < 2 or pairs < MIN_PARALLEL_PAIRS else QuietProcesses(cores)


def _check_images(folder: Path | None) -> None:
    if folder is not None and not folder.expanduser().is_dir():
        what = "is a file" if folder.expanduser().exists() else "no such folder"
        raise ValueError(f"--images {folder}: {what}; with --colmap, give the folder that the images were extracted from")


def _photographs(database: MatchDatabase, folder: Path | None) -> tuple[dict[int, Photograph], list[str]]:
    """Those of the images that the report draws, by their places, and what is to be said."""
    if folder is None:
        return {}, []

    found, missing, other = {}, [], []
    for place in images_drawn(database):
        image = database.images[place]
        path = folder.expanduser() / image.name
        if not path.is_file():
            missing.append(image.name)
            continue
        photograph = read_image(path)
        if photograph.size == (float(image.camera.width), float(image.camera.height)):
            found[place] = photograph
        else:
            other.append(image.name)
    notes = [f"--images {folder} has no {names(missing)}; the report shows points alone"] if missing else []
    notes += [f"{names(other)} in --images {folder} has another size than the database says, and is not drawn"] if other else []
    return found, notes
