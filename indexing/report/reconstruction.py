"""The report on a reconstruction: what moves and how, from where it was seen, and how far that can be trusted."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from indexing import files
from indexing.readers.tracks import TrackSet
from indexing.report.alignment import safe_cell
from indexing.report.canvas import DARK, LIGHT
from indexing.report.page import made_by, page
from indexing.report.reconstruction_page import body, describe
from indexing.report.reconstruction_scene import scene_picture
from indexing.report.reconstruction_tracks import tracks_picture
from indexing.report.reconstruction_words import Candidate

FloatArray = NDArray[np.float64]

FILES = ("report.html", "reconstruction.npz", "reconstruction.json", "points.csv", "tracks.png", "scene.png")
ROUNDING = 1e-12
LABELS = (("outlier", "static", "moving"), ("outlier", "body 1", "body 2"))


@dataclass(frozen=True, eq=False)
class ReconstructionReport:
    """Everything that the report on a reconstruction says.

    Args:
        title: heading of the page.
        motion: name of the model, and what it says in a few words.
        tracks: what was given, with times from 0.
        cameras: ``(views, l + 1, d + 1)``.
        points: ``(n, d)`` at time 0; NaN = not found.
        positions: ``(views, n, d)`` at the times of the views; of two bodies the points, each in the frame of its body.
        velocities: ``(n, d)`` per unit of the times; None = the model has none.
        labels: ``(n,)`` 0 outlier or not found, 1 static, 2 moving; of two bodies 1 and 2.
        residuals: ``(views, n)`` reprojection distances; NaN = missing.
        inliers: ``(views, n)`` observations that count.
        structure: ``(n, K)`` homogeneous constants of the model.
        projections: ``(views, l + 1, K)``.
        residual: rms reprojection error.
        sigma: noise of one coordinate.
        status: the status's name, ``"OK"`` where the data decided.
        reason: why not, and what to do; empty where they did.
        ambiguity: what the data cannot tell, even without noise.
        warnings: code, figure and message of each.
        notes: what a reader should know about the input, a sentence each.
        candidates: name, penalized cost and residual of the models that were compared, best first, and why one was not tried.
        threshold: as given; None = estimated, or no outliers.
        bodies: 2 for two bodies.
        manifest: of :func:`indexing.files.manifest`.
    """

    title: str
    motion: tuple[str, str]
    tracks: TrackSet
    cameras: FloatArray
    points: FloatArray
    positions: FloatArray
    labels: NDArray[np.int64]
    residuals: FloatArray
    inliers: NDArray[np.bool_]
    structure: FloatArray
    projections: FloatArray
    residual: float
    sigma: float
    velocities: FloatArray | None = None
    status: str = "OK"
    reason: str = ""
    ambiguity: str = ""
    warnings: Sequence[tuple[str, float, str]] = ()
    notes: Sequence[str] = ()
    candidates: Sequence[Candidate] = ()
    threshold: float | None = None
    bodies: int = 1
    manifest: Mapping[str, Any] = field(default_factory=dict)

    @property
    def solved(self) -> bool:
        """Whether there is a scene at all, good or doubtful."""
        return bool(np.isfinite(self.cameras).all() and np.abs(self.cameras).max() > 0 and self.found.any())

    @property
    def drawable(self) -> bool:
        """Whether there is a scene worth a picture: of one that the data do not decide, it would only mislead."""
        return self.solved and self.status == "OK"

    @property
    def found(self) -> NDArray[np.bool_]:
        """``(n,)`` points with a position."""
        return np.asarray(np.isfinite(self.points).all(axis=1))

    @property
    def times(self) -> FloatArray:
        """``(views,)`` from 0."""
        given = self.tracks.times
        return np.arange(len(self.tracks.views), dtype=np.float64) if given is None else given

    @property
    def kinds(self) -> list[str]:
        """What each point is: outlier, static, moving (or body 1, body 2), or missing, where too few views show it."""
        names = np.array(LABELS[self.bodies > 1])
        kinds = np.where(self.found, names[self.labels], "outlier")
        given = np.isfinite(self.tracks.values).all(axis=2)
        seen = (given if self.tracks.weights is None else given & (self.tracks.weights > 0)).sum(axis=0)
        # no more coordinates than the unknowns of a point fit any camera, and so place none
        few = seen * self.tracks.values.shape[2] <= self.structure.shape[1] - 1
        return [str(kind) for kind in np.where(few & ~self.found, "missing", kinds)]

    @property
    def counts(self) -> dict[str, int]:
        """How many points of each kind."""
        kinds = self.kinds
        return {name: kinds.count(name) for name in (*LABELS[self.bodies > 1][1:], "outlier", "missing")}


def write_reconstruction(folder: str | Path, report: ReconstructionReport) -> Path:
    """Write a report into a folder: the files of :data:`FILES`, each whole or not at all, ``report.html`` last.

    Returns:
        the path of ``report.html``.

    Raises:
        ValueError: the folder or a file in it cannot be written.
    """
    where = files.prepare(folder)
    tracks = tracks_picture(report, LIGHT), tracks_picture(report, DARK)
    scene = (scene_picture(report, LIGHT), scene_picture(report, DARK)) if report.drawable else None
    summary = describe(report)
    html = page(
        report.title,
        body(report, tracks, scene),
        summary=summary,
        kind="Dynamic reconstruction",
        footer=made_by(report.manifest),
    )
    files.write_bytes(where / "tracks.png", tracks[0])
    if scene is not None:
        files.write_bytes(where / "scene.png", scene[0])
    else:  # that of an earlier run is not that of this one
        (where / "scene.png").unlink(missing_ok=True)
    files.write_text(where / "points.csv", points_csv(report))
    files.write_bytes(where / "reconstruction.npz", as_npz(report))
    files.write_json(where / "reconstruction.json", as_json(report))
    return files.write_text(where / "report.html", html)


def as_npz(report: ReconstructionReport) -> bytes:
    """All arrays, without pickle: cameras, points, velocities, labels, residuals, inliers, structure, projections, times, ids, and
    ``first_time``, the time in the files of the first view, which ``times`` count from."""
    names = ("cameras", "points", "velocities", "labels", "residuals", "inliers", "structure", "projections", "times")
    arrays: dict[str, Any] = {name: getattr(report, name) for name in names if getattr(report, name) is not None}
    arrays |= {"tracks": report.tracks.values, "ids": np.array(report.tracks.ids), "status": np.array(report.status)}
    arrays["first_time"] = np.array(report.tracks.start)
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


def as_json(report: ReconstructionReport) -> dict[str, Any]:
    """The result as numbers: cameras, residuals, status, warnings, and how it came about."""
    return {
        "status": report.status,
        "reason": report.reason or None,
        "motion": report.motion[0],
        "views": list(report.tracks.views),
        "times": report.times,
        "first_time": report.tracks.start,
        "tracks": len(report.tracks.ids),
        "counts": report.counts,
        "residual": report.residual if report.solved else None,
        "sigma": report.sigma if report.solved else None,
        "threshold": report.threshold,
        "cameras": report.cameras if report.solved else None,
        "ambiguity": report.ambiguity,
        "candidates": [
            {"motion": name, "score": score, "residual": residual, "not_tried": reason or None}
            for name, score, residual, reason in report.candidates
        ],
        "warnings": [{"code": code, "value": value, "message": message} for code, value, message in report.warnings],
        "notes": list(report.notes),
        "manifest": report.manifest,
    }


def rested(velocities: FloatArray | None, points: FloatArray, span: float) -> FloatArray | None:
    """Velocities without what is nothing but rounding: ways, from first to last view, that are no part of the scene's size.

    Example:
        >>> rested(np.array([[1e-17, 0.0], [1e-3, 1e-17]]), np.array([[0.0, 0.0], [1.0, 2.0]]), 1.0).tolist()
        [[0.0, 0.0], [0.001, 0.0]]
    """
    if velocities is None:
        return None
    size = float(np.nan_to_num(np.abs(points)).max(initial=0.0))
    return np.where(np.abs(velocities) * span <= ROUNDING * size, 0.0, velocities)


def points_csv(report: ReconstructionReport) -> str:
    """``id, label, name``, position at the first view, velocity, number of views that count, and rms residual of every point."""
    dim = report.points.shape[1]
    axes = "xyz"[:dim]
    velocities = np.full_like(report.points, np.nan) if report.velocities is None else report.velocities
    counted = np.where(report.inliers & np.isfinite(report.residuals), report.residuals, np.nan)
    seen = np.isfinite(counted).sum(axis=0)
    rms = np.sqrt(np.nansum(np.square(counted), axis=0) / np.maximum(seen, 1))
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["id", "label", "name", *axes, *(f"v{axis}" for axis in axes), "views", "rms"])
    for i, (name, kind) in enumerate(zip(report.tracks.ids, report.kinds, strict=True)):
        place = [f"{value:.9g}" if np.isfinite(value) else "" for value in (*report.points[i], *velocities[i])]
        rest = [int(seen[i]), f"{rms[i]:.6g}" if seen[i] else ""]
        writer.writerow([safe_cell(name), int(report.labels[i]), kind, *place, *rest])
    return out.getvalue()
