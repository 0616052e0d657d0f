"""The report on a reconstruction: what moves and how, from where it was seen, and how far that can be trusted."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dyntorch.numerics import worded
from dyntorch.tasks import MOTION_MODELS
from indexing.readers.pairs import Photograph
from indexing.readers.tracks import TrackSet
from indexing.report.canvas import DARK
from indexing.report.page import Picture, ResultReport, markup, matrix, npz, render, safe_cell, sentence, table_csv, write_files
from indexing.report.reconstruction_picture import scene_picture, tracks_picture

FloatArray = NDArray[np.float64]
FILES = ("report.html", "reconstruction.npz", "reconstruction.json", "points.csv", "tracks.png", "scene.png")
WRITTEN = (*FILES, "tracks.csv")  # the last one of videos
ROUNDING = 1e-12
LABELS = (("outlier", "static", "moving"), ("outlier", "body 1", "body 2"))
ARRAYS = ("cameras", "points", "residuals", "inliers", "structure", "projections")
PURPOSE = {model.name: model.purpose for model in MOTION_MODELS}


@dataclass(frozen=True, eq=False, kw_only=True)
class ReconstructionReport(ResultReport):
    """Everything that the report on a reconstruction says."""

    tracks: TrackSet
    threshold: float | None = None
    photograph: Photograph | None = None

    TITLES = ("What moves, and how", "The tracks do not decide")

    @property
    def motion(self) -> str:
        """Name of the model."""
        return str(self.result.motion.name)

    @property
    def bodies(self) -> int:
        """1, or 2 of which one is shifted against the other."""
        return int(self.result.motion.bodies)

    @functools.cached_property
    def labels(self) -> NDArray[np.int64]:
        """``(n,)`` 0 outlier or not found, 1 static, 2 moving; of two bodies 1 and 2."""
        labels = self.found.labels
        return np.asarray(labels.clip(max=1) if self.result.motion.static and self.bodies == 1 else labels)

    @functools.cached_property
    def velocities(self) -> FloatArray | None:
        """``(n, d)`` per unit of the times; None = the model has none."""
        return rested(self.found.velocities, self.found.points, float(np.ptp(self.found.times)))

    @functools.cached_property
    def positions(self) -> FloatArray:
        """``(views, n, d)`` at the times of the views; of two bodies the points, each in the frame of its body."""
        return np.stack([self.result.at(float(moment)).numpy() for moment in self.found.times])

    @property
    def residual(self) -> float:
        """Rms reprojection error."""
        return float(self.found.residual)

    @property
    def sigma(self) -> float:
        """Noise of one coordinate."""
        return float(self.found.sigma)

    @property
    def poses(self) -> dict[str, Any]:
        """Whether the scene is metric, and rotations and translations of the cameras; nothing without a calibration."""
        found = self.result
        if found.metric is None:
            return {}
        return {
            "metric": bool(found.metric),
            "rotations": found.rotations.numpy(),
            "translations": found.translations.numpy(),
            "calibration": found.calibration.numpy(),
        }

    @property
    def ambiguity(self) -> str:
        """What the tracks cannot tell, even without noise."""
        return worded(self.result.ambiguity, self.words)

    @property
    def single(self) -> int:
        """How many observations of points that fit do not."""
        given = np.isfinite(self.tracks.values).all(axis=-1)
        return int((given & ~self.found.inliers)[:, self.labels > 0].sum())

    @property
    def solved(self) -> bool:
        """Whether there is a scene at all, good or doubtful."""
        return bool(np.isfinite(self.found.cameras).all() and np.abs(self.found.cameras).max() > 0 and self.placed.any())

    @property
    def drawable(self) -> bool:
        """Whether there is a scene worth a picture: of one that the data do not decide, it would only mislead."""
        return self.solved and self.status == "OK"

    @property
    def placed(self) -> NDArray[np.bool_]:
        """``(n,)`` points with a position."""
        return np.asarray(np.isfinite(self.found.points).all(axis=1))

    @property
    def times(self) -> FloatArray:
        """``(views,)`` from 0."""
        given = self.tracks.times
        return np.arange(len(self.tracks.views), dtype=np.float64) if given is None else given

    @property
    def kinds(self) -> list[str]:
        """What each point is: outlier, static, moving (or body 1, body 2), or missing, where too few views show it."""
        names = np.array(LABELS[self.bodies > 1])
        kinds = np.where(self.placed, names[self.labels], "outlier")
        given = np.isfinite(self.tracks.values).all(axis=2)
        seen = (given if self.tracks.weights is None else given & (self.tracks.weights > 0)).sum(axis=0)
        # no more coordinates than the unknowns of a point fit any camera, and so place none
        few = seen * self.tracks.values.shape[2] <= self.found.structure.shape[1] - 1
        return [str(kind) for kind in np.where(few & ~self.placed, "missing", kinds)]

    @property
    def counts(self) -> dict[str, int]:
        """How many points of each kind."""
        kinds = self.kinds
        return {name: kinds.count(name) for name in (*LABELS[self.bodies > 1][1:], "outlier", "missing")}


def left_out(report: ReconstructionReport) -> str:
    """Which models were not tried and why, and which were without success; empty where all were compared."""
    untried = [f"{one.motion} ({one.reason})" for one in report.result.candidates if one.reason]
    failed = [one.motion for one in report.result.candidates if not one.reason and not math.isfinite(one.score)]
    parts = (("not tried", untried), ("found no scene", failed))
    return "; ".join(f"{said}: {', '.join(names)}" for said, names in parts if names)


def describe(report: ReconstructionReport) -> str:
    """The result in plain words."""
    number, views, counts = len(report.tracks.ids), len(report.tracks.views), report.counts
    if report.status != "OK":
        said = any(message in report.reason for _, _, message in report.warnings)  # then it is in the list that follows
        start = f"The {number:,} tracks through {views} views do not decide what the scene is."
        start += "" if said else f" {sentence(report.reason)}"
        return start + " The numbers are those of the best scene found, and not to be relied on." * report.solved
    verbs = {"static": "stand still", "moving": "move", "outlier": "do not fit", "missing": "are seen too rarely"}
    parts = [f"{many:,} {verbs.get(name, f'are on {name}')}" for name, many in counts.items() if many]
    return f"Of {number:,} points tracked through {views} views, {', '.join(parts)}. {PURPOSE.get(report.motion, '')}"


def write_reconstruction(folder: str | Path, report: ReconstructionReport) -> Path:
    """Write a report into a folder: the files of :data:`FILES`, each whole or not at all, ``report.html`` last."""
    tracks = tracks_picture(report)
    scene = scene_picture(report) if report.drawable else None
    picture = Picture(tracks, dark=tracks_picture(report, DARK) if report.photograph is not None else None)
    values = {"summary": describe(report), "scene": scene and Picture(scene), "picture": picture, **tables(report)}
    contents: dict[str, Any] = {"tracks.png": tracks, "scene.png": scene, "points.csv": points_csv(report)}
    contents |= {"reconstruction.npz": as_npz(report), "reconstruction.json": as_json(report), "tracks.csv": None}
    contents |= report.besides
    contents["report.html"] = render("reconstruction", report, **values)
    return write_files(folder, contents)


def tables(report: ReconstructionReport) -> dict[str, Any]:
    """Rows of the page's tables: models, views and their cameras; and what to say about the models left out."""
    taken = markup('{name} <small class="none">taken</small>', name=report.motion)
    fitted = [one for one in report.result.candidates if math.isfinite(one.score)]
    models = [
        [taken if one.motion == report.motion else one.motion, f"{one.score:.6g}", f"{one.residual:.3g}".replace("nan", "")]
        for one in fitted
    ]
    views, cameras = [], []
    for i, name in enumerate(report.tracks.views if report.solved else ()):
        seen = np.isfinite(report.tracks.values[i]).all(axis=1)
        residuals = report.found.residuals[i]
        used = report.found.inliers[i] & np.isfinite(residuals)
        rms = f"{float(np.sqrt(np.mean(np.square(residuals[used])))):.3g}" if used.any() else ""
        views.append([name, f"{report.times[i]:.6g}", f"{seen.sum():,}", f"{(seen & ~used).sum():,}", rms])
        cameras.append([name, matrix(report.found.cameras[i])])
    return {"models": models, "views": views, "cameras": cameras, "left_out": left_out(report), "moves": moves(report)}


def moves(report: ReconstructionReport) -> bool:
    """Whether any point has a velocity."""
    return report.velocities is not None and bool(np.nan_to_num(report.velocities).any())


def as_npz(report: ReconstructionReport) -> bytes:
    """All arrays, without pickle: cameras, points, velocities, labels, residuals, inliers, structure, projections, times, ids, and
    ``first_time``, the time in the files of the first view, which ``times`` count from."""
    arrays: dict[str, Any] = {name: getattr(report.found, name) for name in ARRAYS}
    arrays |= {"labels": report.labels, "times": report.times, "tracks": report.tracks.values, "ids": np.array(report.tracks.ids)}
    arrays |= {} if report.velocities is None else {"velocities": report.velocities}
    arrays |= {name: np.asarray(value) for name, value in report.poses.items()}
    return npz({**arrays, "status": report.status, "first_time": report.tracks.start})


def as_json(report: ReconstructionReport) -> dict[str, Any]:
    """The result as numbers: cameras, residuals, status, warnings, and how it came about."""
    return {
        "status": report.status,
        "reason": report.reason or None,
        "motion": report.motion,
        "views": list(report.tracks.views),
        "times": report.times,
        "first_time": report.tracks.start,
        "tracks": len(report.tracks.ids),
        "counts": report.counts,
        "residual": report.residual if report.solved else None,
        "sigma": report.sigma if report.solved else None,
        "threshold": report.threshold,
        "cameras": report.found.cameras if report.solved else None,
        "ambiguity": report.ambiguity,
        **report.poses,
        "candidates": [
            {"motion": one.motion, "score": one.score, "residual": one.residual, "not_tried": one.reason or None}
            for one in report.result.candidates
        ],
        "warnings": report.warnings_json,
        "notes": list(report.notes),
        "manifest": report.manifest,
    }


def rested(velocities: FloatArray | None, points: FloatArray, span: float) -> FloatArray | None:
    """Velocities without what is nothing but rounding: ways, from first to last view, that are no part of the scene's size."""
    if velocities is None:
        return None
    size = float(np.nan_to_num(np.abs(points)).max(initial=0.0))
    return np.where(np.abs(velocities) * span <= ROUNDING * size, 0.0, velocities)


def points_csv(report: ReconstructionReport) -> str:
    """``id, label, name``, position at the first view, velocity, number of views that count, and rms residual of every point."""
    points, residuals = report.found.points, report.found.residuals
    axes = "xyz"[: points.shape[1]]
    velocities = np.full_like(points, np.nan) if report.velocities is None else report.velocities
    counted = np.where(report.found.inliers & np.isfinite(residuals), residuals, np.nan)
    seen = np.isfinite(counted).sum(axis=0)
    rms = np.sqrt(np.nansum(np.square(counted), axis=0) / np.maximum(seen, 1))
    rows: list[list[Any]] = []
    for i, (name, kind) in enumerate(zip(report.tracks.ids, report.kinds, strict=True)):
        place = [f"{value:.9g}" if np.isfinite(value) else "" for value in (*points[i], *velocities[i])]
        rows.append([safe_cell(name), int(report.labels[i]), kind, *place, int(seen[i]), f"{rms[i]:.6g}" if seen[i] else ""])
    return table_csv(["id", "label", "name", *axes, *(f"v{axis}" for axis in axes), "views", "rms"], rows)
