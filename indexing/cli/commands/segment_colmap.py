"""``dyntorch segment --colmap``: which matches of a COLMAP database stand still, written as a database for its mapper."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from indexing.archive.workers import QuietProcesses
from indexing.cli.console import check_folder, check_report, count, counting_bar, keep, names, present, progress
from indexing.colmap import MatchDatabase, check_target, find_static, read_database
from indexing.colmap.masks import write_masks
from indexing.colmap.pair_segmentation import colmap
from indexing.colmap.static import MIN_PARALLEL_PAIRS
from indexing.files import manifest
from indexing.readers.matches import Photograph, read_image
from indexing.report.static import FILES, StaticReport, images_drawn


@dataclass(frozen=True)
class ColmapJob:
    """What ``--colmap`` and the flags beside it ask for."""

    database: Path  # to read
    out: Path | None  # the database to write; the report goes into the folder ``NAME-report`` beside it
    images: Path | None = None  # folder of the images, to draw on; None = none
    masks: Path | None = None  # folder of the masks; None = ``NAME-masks`` beside ``out``
    threshold: float | None = 2.5  # of ``segment``, pixels; None estimates it
    spatial: bool = True  # whether neighbours tend to move alike
    seed: int = 0  # of the random samples
    title: str = ""  # heading of the report


def run_colmap(job: ColmapJob, arguments: Mapping[str, Any]) -> int:
    """Read, divide, vote, write, and say what was found."""
    if job.out is None:
        raise ValueError("--colmap: where to? name the database to write, --out static.db")
    database, out = job.database.expanduser(), job.out.expanduser()
    out = check_target(out, database)
    check_folder(out.parent)
    keep([database], [out])
    folder = check_report(out.with_name(f"{out.stem}-report"), [database], FILES)
    masks = check_folder((job.masks or out.with_name(f"{out.stem}-masks")).expanduser())
    assert folder is not None
    _check_images(job.images)
    if job.images is not None and masks.resolve() == job.images.expanduser().resolve():
        raise ValueError(f"--masks {masks}: is the folder of the images; give masks a folder of their own")
    started = time.perf_counter()
    with progress("reading", steps=False):
        held = read_database(database)
        colmap()
        shown, notes = _photographs(held, job.images)
    read = time.perf_counter()
    with counting_bar(f"segmenting {count(len(held.pairs), 'pair')}", "pairs/s") as told, _workforce(len(held.pairs)) as executor:
        found = find_static(held, job.threshold, job.spatial, job.seed, progress=told, executor=executor)
    timings = {"read": read - started, "segment": time.perf_counter() - read}
    if found.ok:
        with progress("writing", steps=False):
            write_masks(masks, found)
            found.write(out)
    report = StaticReport(
        found=found,
        written=str(out) if found.ok else "",
        masks=str(masks) if found.ok else "",
        photographs=shown,
        heading=job.title,
        notes=notes,
        manifest=manifest({"command": "segment", **arguments}, [database], job.seed, timings),
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
