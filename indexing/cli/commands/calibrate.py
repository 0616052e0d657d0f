"""``dyntorch calibrate``: cameras on tripods and the movement in 3D, from the people in view."""

from __future__ import annotations

import dataclasses
import math
import re
import time
from pathlib import Path
from typing import Any

from dyntorch.numerics import with_words
from indexing.calibrate import CameraRig, RigPriors, calibrate_recordings
from indexing.calibrate.priors import check_height
from indexing.cli.console import check_folder, count, finish, flag_words, progress, show
from indexing.cli.flags.geometry import Calibrate
from indexing.cli.flags.shared import Watched
from indexing.cli.inputs import camera_numbers, refuse_range
from indexing.cli.videos import find_keypoints
from indexing.files import manifest
from indexing.report.calibration import CalibrationReport, check_folder_of, summarize, write_calibration
from indexing.sync.recordings import Take, find_cameras, take_of

WORDS = flag_words(
    "fps", "size", "focal", "one_lens", "exif", "height", "length", "clocks", "rate", "max_shift", "person", "people",
    "min_confidence", "format", "layout", sizes="--size", lengths="--length", calibration="--calibration FILE.toml",
)  # fmt: skip


def run(flags: Calibrate) -> int:
    """Read, calibrate, write, and say what was found."""
    clocks = _check(flags)
    for path in flags.cameras:
        refuse_range(path)

    found = find_cameras([path.expanduser() for path in flags.cameras])
    files = [flags.calibration] if flags.calibration is not None else []
    files += [Path(clocks)] if clocks not in (None, "known") else []
    inputs = [*found.values(), *(path.expanduser() for path in files)]
    folder = None if flags.out is None else check_folder(flags.out)
    if folder is not None:
        check_folder_of(folder, inputs, flags.footage.people)
    started = time.perf_counter()
    watched = find_keypoints(flags.footage, found.values(), folder, camera_numbers("fps", flags.fps, len(found))[0])
    with progress("reading", steps=False):
        takes = _read(flags, found, watched)
    read = time.perf_counter()
    with progress(f"calibrating {count(len(takes), 'camera')}", steps=False):
        rig = _solve(flags, takes, clocks, watched)
    timings = {"read": read - started, "calibrate": time.perf_counter() - read}
    report = CalibrationReport(rig, flags.title or "")
    page: Path | None = None
    if folder is not None:
        with progress("writing", steps=False):
            made = manifest({"command": "calibrate", **dataclasses.asdict(flags)}, inputs, None, timings)
            report = dataclasses.replace(report, manifest=made)
            page, report = write_calibration(folder, report)
    show(summarize(report))
    return finish(page, None if rig.ok else rig.reason)


def _check(flags: Calibrate) -> str | None:
    """Raise on flags that make no sense by themselves, before any file is read; the clocks that were given."""
    if flags.max_shift is not None and not 0 < flags.max_shift < math.inf:
        raise ValueError(f"--max-shift must be a positive number of seconds, got {flags.max_shift:g}")
    if flags.synchronized and flags.clocks not in (None, "known"):
        raise ValueError(f"--synchronized and --clocks {flags.clocks} both say how the clocks run; give one of them")
    clocks = "known" if flags.synchronized else flags.clocks
    if clocks is not None and flags.max_shift is not None:
        raise ValueError("--max-shift is of clocks that are searched, and they are given; leave it out")
    if flags.height is not None:
        try:
            check_height(flags.height)
        except ValueError as problem:
            raise ValueError(with_words(problem, WORDS)) from None
    if flags.footage.by == "pixels":
        raise ValueError("--by pixels: cameras are calibrated from the joints of people; leave it out")
    camera_numbers("fps", flags.fps, None), camera_numbers("focal", flags.focal, None), _sizes(flags, None)
    return clocks


def _sizes(flags: Calibrate, cameras: int | None) -> list[tuple[int, int]] | None:
    """Width and height of each camera's pictures; None where they are not given."""
    if flags.size is None:
        return None
    words = [re.fullmatch(r"\s*(\d{1,6})\s*[xX*]\s*(\d{1,6})\s*", word) for word in flags.size.split(",")]
    sizes = [(int(word[1]), int(word[2])) for word in words if word]
    if len(sizes) < len(words) or any(min(size) < 1 for size in sizes):
        raise ValueError(f"--size must be width x height in pixels, as in 1920x1080, or one per camera, got {flags.size}")
    if cameras is not None and len(sizes) not in (1, cameras):
        raise ValueError(f"--size gives {len(sizes)} sizes for {cameras} cameras; give one, or one per camera")
    return sizes * ((cameras or 1) if len(sizes) == 1 else 1)


def _read(flags: Calibrate, found: dict[str, Path], watched: Watched) -> list[Take]:

    options: dict[str, Any] = {"person": "auto" if flags.person == "everyone" else flags.person, "format": flags.format}
    options |= {"min_confidence": flags.min_confidence, "layout": flags.layout, "by": "keypoints"}
    rates = camera_numbers("fps", flags.fps, len(found))
    try:
        return [
            take_of(path, name=name, fps=rate, keypoints=watched.files.get(path), **options)
            for (name, path), rate in zip(found.items(), rates, strict=True)
        ]
    except ValueError as problem:
        raise ValueError(with_words(problem, WORDS)) from problem


def _rig_priors(flags: Calibrate, cameras: int, clocks: str | None) -> RigPriors:

    focal = camera_numbers("focal", flags.focal, cameras)
    return RigPriors(
        focal=None if flags.focal is None else [value for value in focal if value is not None],
        one_lens=flags.one_lens,
        calibration=None if flags.calibration is None else flags.calibration.expanduser(),
        exif=flags.exif,
        clocks=clocks,
        rate=flags.rate,
        max_shift=flags.max_shift,
        height=flags.height,
        lengths={(a, b): metres for a, b, metres in flags.length},
    )


def _solve(flags: Calibrate, takes: list[Take], clocks: str | None, watched: Watched) -> CameraRig:

    people = flags.footage.people if flags.person == "everyone" else 1
    try:
        rig = calibrate_recordings(
            takes, _rig_priors(flags, len(takes), clocks), sizes=_sizes(flags, len(takes)), people=people, words=WORDS
        )
    except ValueError as problem:
        raise ValueError(with_words(problem, WORDS)) from problem
    return dataclasses.replace(rig, remarks=(*watched.notes, *rig.remarks))
