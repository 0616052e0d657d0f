"""The report on a reconstruction: what moves and how, from where it was seen, and how far that can be trusted."""

from __future__ import annotations

import csv
import io
import math
import re
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
from indexing.report.page import (
    Card,
    Column,
    cards,
    details,
    escape,
    listed,
    made_by,
    page,
    picture,
    provenance,
    section,
    sentence,
    table,
)
from indexing.report.reconstruction_picture import scene_picture, tracks_picture

# ----------------------------------------------------------------------------------------------------------------------
# What the notices of a reconstruction mean, in plain words.


Candidate = tuple[str, float, float, str]
HEADINGS = {"weak_stack": "views too alike", "behind": "points behind a camera"}
MEANING = {
    "weak_stack": (
        "Where and how fast a point moves is found from the differences between the views; here they hardly differ in one respect, "
        "so that a small error of a track becomes a large error of its point."
    ),
    "behind": (
        "No camera sees what is behind it: the places found for these points, or for that camera, are wrong, however well they fit."
    ),
}


def heading(code: str) -> str:
    """What a notice is about.

    Example:
        >>> heading("weak_stack"), heading("static_scene")
        ('views too alike', 'static scene')
    """
    return HEADINGS.get(code, code.replace("_", " "))


def one(message: str) -> str:
    """A message with the singular where its number is 1.

    Example:
        >>> one("1 points are behind a camera"), one("11 points are behind a camera")
        ('1 point is behind a camera', '11 points are behind a camera')
    """
    return re.sub(r"\b(?<![\d.,])1 (\w+)s are\b", r"1 \1 is", message)


def left_out(candidates: Sequence[Candidate]) -> str:
    """Which models were not tried and why, and which were without success; empty where all were compared.

    Example:
        >>> left_out([("a", 1.0, 0.1, ""), ("b", math.inf, math.nan, "needs 4 views"), ("c", math.inf, math.nan, "")])
        'not tried: b (needs 4 views); found no scene: c'
    """
    untried = [f"{name} ({reason})" for name, _, _, reason in candidates if reason]
    failed = [name for name, score, _, reason in candidates if not reason and not math.isfinite(score)]
    parts = (("not tried", untried), ("found no scene", failed))
    return "; ".join(f"{said}: {', '.join(names)}" for said, names in parts if names)


# ----------------------------------------------------------------------------------------------------------------------
# The sections of the report on a reconstruction, as HTML.


Drawn = tuple[bytes, bytes]
LISTED = 300  # points whose names are listed on the page


def body(report: ReconstructionReport, tracks: Drawn, scene: Drawn | None) -> str:
    """The page's sections: headline numbers, warnings, pictures, models, views, what stays open, points, settings."""
    parts = [cards(_headline(report)), _warnings(report), _scene(report, scene), _tracks(report, tracks), _models(report)]
    if report.solved:
        parts.append(_views(report))
    if report.ambiguity and report.solved:
        parts.append(section("What the tracks cannot tell", "", f"The scene is {report.ambiguity}."))
    parts.append(_points(report))
    parts.append(provenance(report.manifest))
    return "\n".join(part for part in parts if part)


def describe(report: ReconstructionReport) -> str:
    """The result in plain words."""
    number, views, counts = len(report.tracks.ids), len(report.tracks.views), report.counts
    if report.status != "OK":
        said = any(message in report.reason for _, _, message in report.warnings)  # then it is in the list that follows
        start = f"The {number:,} tracks through {views} views do not decide what the scene is."
        start += "" if said else f" {sentence(report.reason)}"
        return start + " The numbers are those of the best scene found, and not to be relied on." * report.solved
    parts = [f"{counts[name]:,} {'are on ' if report.bodies > 1 else ''}{_verb(name)}" for name in list(counts)[:2] if counts[name]]
    if counts["outlier"]:
        parts.append(f"{counts['outlier']:,} do not fit")
    if counts["missing"]:
        parts.append(f"{counts['missing']:,} are seen too rarely")
    return f"Of {number:,} points tracked through {views} views, {', '.join(parts)}. {report.motion[1]}"


def _verb(kind: str) -> str:
    return {"static": "stand still", "moving": "move"}.get(kind, kind)


def _headline(report: ReconstructionReport) -> list[Card]:
    counts, number = report.counts, len(report.tracks.ids)
    ok = report.status == "OK"
    items = [Card("Status", "Solved" if ok else "Refused", "the tracks decide" if ok else report.status.lower().replace("_", " "))]
    if not report.solved:
        return [*items, Card("Tracks", f"{number:,}", f"through {len(report.tracks.views)} views")]
    items += [Card(name.capitalize(), f"{counts[name]:,}", f"of {number:,} points") for name in list(counts)[:2] if counts[name]]
    single = int((np.isfinite(report.tracks.values).all(axis=-1) & ~report.inliers)[:, report.labels > 0].sum())
    rest = f"of {number:,} points" + f", and {single:,} single observation{'s' * (single > 1)} left out" * bool(single)
    rest += f"; {counts['missing']:,} seen too rarely" * bool(counts["missing"])
    items.append(Card("Outliers", f"{counts['outlier']:,}", rest))
    items.append(Card("Residual", f"{report.residual:.3g}", "rms distance from the tracks, in their unit"))
    items.append(Card("Noise", f"{report.sigma:.3g}", "standard deviation of a coordinate that this shows"))
    return items


def _warnings(report: ReconstructionReport) -> str:
    lines = []
    for code, _, text in report.warnings:
        meant, refuses = MEANING.get(code, ""), text in report.reason
        head = (
            f'<b class="bad">Refused: {escape(heading(code))}.</b>' if refuses else f"<b>{escape(heading(code).capitalize())}.</b>"
        )
        lines.append(f"<li>{head} {escape(f'{sentence(text)} {meant}'.strip())}</li>")
    lines += [f"<li>{escape(sentence(note))}</li>" for note in report.notes]
    return section("Please note", f"<ul>{''.join(lines)}</ul>") if lines else ""


def _scene(report: ReconstructionReport, drawn: Drawn | None) -> str:
    if drawn is None:
        return ""
    if report.bodies > 1:
        note = "Each body for itself: how large one is against the other, no view can tell."
    elif report.velocities is None or not np.nan_to_num(report.velocities).any():
        note = "Every point where it stands."
    else:
        note = "Every point where it was in the first view, and its way until the last."
    caption = "Drawn in the frame that comes nearest to the first view; the tracks leave it open, as said below."
    alt = f"The scene: {', '.join(f'{count} {name}' for name, count in report.counts.items() if count)}"
    return section("The scene", picture(drawn[0], alt, dark=drawn[1], caption=caption), note)


def _tracks(report: ReconstructionReport, drawn: Drawn) -> str:
    note = f"Every track{' by what it was found to be' * report.drawable}, with a dot where it begins."
    caption = (
        "On the right, the motion of the camera is taken out: what stands still is a dot, what moves keeps its own way."
        if report.drawable and report.velocities is not None
        else ""
    )
    title = "The tracks" if report.drawable else "The tracks as measured"
    return section(title, picture(drawn[0], f"{len(report.tracks.ids)} tracks", dark=drawn[1], caption=caption), note)


def _models(report: ReconstructionReport) -> str:
    if not report.candidates:
        return ""
    taken = ' <small class="none">taken</small>'
    rows = [
        [escape(name) + taken * (name == report.motion[0]), f"{score:.6g}", _figure(residual, ".3g", "")]
        for name, score, residual, _ in report.candidates
        if np.isfinite(score)
    ]
    failed = left_out(report.candidates)
    also = f" {sentence(failed)}" if failed else ""
    columns = [Column("Model"), Column("Penalized cost", "number"), Column("Rms residual", "number")]
    note = "The model of least cost was taken. Unknowns cost, so that a model is not chosen for being able to bend more." + also
    return section("Which motion", table(columns, rows, caption="Models, best first"), note)


def _figure(value: float, form: str, otherwise: str) -> str:
    return f"{value:{form}}" if np.isfinite(value) else otherwise


def _views(report: ReconstructionReport) -> str:
    """Times and residuals of all views, and their cameras behind a click."""
    rows, matrices = [], []
    for i, name in enumerate(report.tracks.views):
        seen = np.isfinite(report.tracks.values[i]).all(axis=1)
        used = report.inliers[i] & np.isfinite(report.residuals[i])
        rms = float(np.sqrt(np.mean(np.square(report.residuals[i, used])))) if used.any() else float("nan")
        out = int((seen & ~used).sum())
        rows.append([escape(name), f"{report.times[i]:.6g}", f"{int(seen.sum()):,}", f"{out:,}", _figure(rms, ".3g", "")])
        matrix = "<br>".join("&ensp;".join(f"{value:.6g}" for value in row) for row in report.cameras[i])
        matrices.append([escape(name), f"<code>{matrix}</code>"])
    names = ("Time", "Points seen", "Left out", "Rms residual")
    shown = table([Column("View"), *(Column(name, "number") for name in names)], rows, caption="Views")
    frame = "x, y, 1" if report.points.shape[1] == 2 else "x, y, z, 1"
    listed = table([Column("View"), Column(f"From ({frame}) to its image", "long")], matrices, css="plain", caption="Cameras")
    return section("The views", shown + details("Cameras", listed), "How well each view agrees with the scene.")


def _points(report: ReconstructionReport) -> str:
    if not report.solved:
        return ""
    order = ("moving", "body 1", "body 2", "outlier", "missing", "static")
    names = listed(report.tracks.ids, report.kinds, order, LISTED, "points.csv")
    note = "By the names of the file; points.csv has positions, velocities and residuals, reconstruction.npz all arrays."
    return section("Each point", names, note)


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
