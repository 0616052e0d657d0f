"""COLMAP before scenes in which more moves than stands still: its mapper alone, and after ``dyntorch segment --colmap``.

    python -m experiments.segmentation.colmap
    python -m experiments.segmentation.colmap --quick

Ten scenes of 12 images in which 60 % of the right matches move: with one large body, with two and with three, each on a way of its
own.  Keypoints have noise of half a pixel, a tenth of the matches are wrong.  COLMAP alone is its own verification of the matches
and its incremental mapper; after ours, it is the same mapper on the database that was written.  The error is that of the worst
camera position, after the similarity that brings all nearest to the truth, over the extent of the path; 100 % where an image is in
no model.  The focal length that COLMAP starts from is 15 % off.

Needs pycolmap: ``pip install 'dyntorch[colmap]'``.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments.common.runner import BaseConfig, Tables, experiment
from experiments.common.tables import Row
from experiments.segmentation.photographs import FOCAL, HEIGHT, WIDTH, Photographs, photographs
from indexing.colmap import find_static, read_database

FloatArray = NDArray[np.float64]
BODIES = (1, 1, 1, 1, 2, 2, 2, 3, 3, 3)
"""Moving bodies of the scenes."""
GUESS = 1.15
"""The focal length that COLMAP starts from, over the true one."""
SMALLEST = 3
"""Images of a model: COLMAP would throw away those of fewer than ten."""


@dataclass(frozen=True)
class Mapped:
    """What the mapper made: images in its largest model, points, and the error of the worst camera in percent of the path."""

    images: int
    points: int
    error: float


def colmap() -> Any:
    """pycolmap, quiet.

    Raises:
        ValueError: it is not installed.
    """
    from indexing.colmap.pair_segmentation import colmap

    module = colmap()
    module.logging.minloglevel = 2
    return module


def write_scene(path: Path, scene: Photographs, verify: bool = True) -> Path:
    """The database that COLMAP's extractor and matcher would have written, its own verification of the matches included."""
    module = colmap()
    settings = module.TwoViewGeometryOptions()
    settings.ransac.random_seed = 0
    database = module.Database.open(path)
    camera = module.Camera(model="SIMPLE_PINHOLE", width=WIDTH, height=HEIGHT, params=[GUESS * FOCAL, WIDTH / 2, HEIGHT / 2])
    key = database.write_camera(camera)
    keys = [database.write_image(module.Image(name=name, camera_id=key)) for name in scene.names]
    for image, points in zip(keys, scene.keypoints, strict=True):
        database.write_keypoints(image, points)
    for (i, j), matches in scene.matches.items():
        database.write_matches(keys[i], keys[j], matches)
        if verify:
            views = (camera, scene.keypoints[i].astype(float), camera, scene.keypoints[j].astype(float))
            database.write_two_view_geometry(keys[i], keys[j], module.estimate_two_view_geometry(*views, matches, settings))
    database.close()
    return path


def mapped(path: Path, scene: Photographs) -> Mapped:
    """COLMAP's incremental mapper on a database, compared with the truth."""
    module = colmap()
    options = module.IncrementalPipelineOptions()
    options.extract_colors, options.random_seed, options.num_threads, options.min_model_size = False, 0, 1, SMALLEST
    with tempfile.TemporaryDirectory() as folder:
        models = module.incremental_mapping(path, folder, folder, options)
    if not models:
        return Mapped(0, 0, 100.0)
    model = max(models.values(), key=lambda each: each.num_reg_images())
    found = {image.name: image.projection_center() for image in model.images.values() if image.has_pose}
    if len(found) < len(scene.names):
        return Mapped(len(found), model.num_points3D(), 100.0)
    centres = np.stack([found[name] for name in scene.names])
    return Mapped(len(found), model.num_points3D(), 100 * worst(centres, scene.centres))


def worst(found: FloatArray, true: FloatArray) -> float:
    """Greatest distance of positions ``(n, 3)`` from the true ones after a similarity (Umeyama 1991), over the path's extent.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> path = rng.normal(size=(9, 3))
        >>> worst(3 * path[:, [1, 2, 0]] + 5, path) < 1e-12
        True
    """
    a, b = found - found.mean(axis=0), true - true.mean(axis=0)
    left, values, right = np.linalg.svd(b.T @ a)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    scale = float(values @ signs) / max(float((a**2).sum()), 1e-12)
    errors = np.linalg.norm(b - scale * a @ (left * signs @ right).T, axis=1)
    return float(errors.max() / np.linalg.norm(np.ptp(true, axis=0)))


@dataclass(frozen=True)
class Compared:
    """One scene: the mapper alone and after ours, what was kept, how much wider than the next body it spreads, and the time."""

    bodies: int
    matches: int
    moving: float
    alone: Mapped
    after: Mapped
    precision: float
    recall: float
    lead: float
    seconds: float


def compared(bodies: int, seed: int) -> Compared:
    """Make a scene, and map it twice."""
    scene = photographs(bodies=bodies, seed=seed)
    with tempfile.TemporaryDirectory() as folder:
        given = write_scene(Path(folder) / "database.db", scene)
        clock = time.perf_counter()
        found = find_static(read_database(given))
        seconds = time.perf_counter() - clock
        after = mapped(found.write(Path(folder) / "static.db"), scene) if found.ok else Mapped(0, 0, 100.0)
        alone = mapped(given, scene)
    kept = np.concatenate([
        scene.still(pair.first, pair.second, geometry.inliers)
        for pair, geometry in zip(found.database.pairs, found.geometries, strict=True)
    ])  # fmt: skip
    still = sum(int(scene.still(i, j, matches).sum()) for (i, j), matches in scene.matches.items())
    total = sum(map(len, scene.matches.values()))
    precision, recall = float(kept.mean()) if len(kept) else math.nan, float(kept.sum()) / still
    return Compared(bodies, total, scene.share, alone, after, precision, recall, found.lead, seconds)


def table(config: BaseConfig) -> list[Row]:
    """Every scene, and how many are within 1 %."""
    chosen = list(enumerate(BODIES))[:: 4 if config.quick else 1]
    runs = [compared(bodies, config.seed + number) for number, bodies in chosen]
    rows = []
    for (number, _), run in zip(chosen, runs, strict=True):
        what = f"{run.bodies} moving {'body' if run.bodies == 1 else 'bodies'}, {100 * run.moving:.0f} % of {run.matches:,} matches"
        rows.append(Row(f"scene {number + 1}, alone", f"{what}; {_said(run.alone)}", run.alone.error, unit=" %"))
        rows.append(Row(f"scene {number + 1}, after ours", f"{what}; {_said(run.after)}", run.after.error, unit=" %"))
    return rows + _summary(runs)


def _said(found: Mapped) -> str:
    return f"{found.images} images, {found.points:,} points" if found.images else "no model"


def _summary(runs: Sequence[Compared]) -> list[Row]:
    setting, least = f"of {len(runs)} scenes", 0.9 * len(runs)
    return [
        Row("within 1 %, alone", setting, sum(run.alone.error <= 1 for run in runs)),
        Row("within 1 %, after ours", setting, sum(run.after.error <= 1 for run in runs), least),
        Row("error, alone", "median", median(run.alone.error for run in runs), unit=" %"),
        Row("error, after ours", "median", median(run.after.error for run in runs), unit=" %"),
        Row("error, after ours", "worst", max(run.after.error for run in runs), unit=" %"),
        Row("inlier matches that stand still", "least of all scenes", 100 * min(run.precision for run in runs), unit=" %"),
        Row("static matches that are kept", "least of all scenes", 100 * min(run.recall for run in runs), unit=" %"),
        Row("spread of the scene over that of the next body", "least of all scenes", min(run.lead for run in runs)),
        Row("time", "median, 66 pairs", median(run.seconds for run in runs), unit=" s"),
    ]


@experiment(BaseConfig())
def tables(config: BaseConfig) -> Tables:
    """COLMAP's mapper alone and after the static points were found; quick: three scenes."""
    colmap()
    yield "Rendered scenes of which 60 % of the matches move, through COLMAP", table(config)
