"""The report on an alignment: what moved, what stood still, how the sensor moved, and how far that can be trusted."""

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
from indexing.report.alignment_page import body, describe
from indexing.report.alignment_picture import picture_of
from indexing.report.canvas import DARK, LIGHT
from indexing.report.page import made_by, page

FloatArray = NDArray[np.float64]

FILES = ("report.html", "alignment.json", "labels.csv", "alignment.png")
LABELS = ("outlier", "static", "moving")


@dataclass(frozen=True, eq=False)
class AlignmentReport:
    """Everything that the report on an alignment says.

    Args:
        title: heading of the page.
        model: how points may move, and what the sensor may do; and in a few words.
        views: ``(n, d)`` points or ``(n, 2, 3)`` lines of each view, NaN = missing.
        names: of the views.
        ids: ``n`` names of the matches.
        labels: ``(n,)`` 0 outlier, 1 static, 2 moving.
        motion: A and B (with three views), from view 2 and 3 to view 1.
        covariance: ``(p, p)`` of their entries, one after the other, row by row.
        sigma: noise of one coordinate, in the unit of the views.
        status: the status's name, ``"OK"`` where the data decided.
        reason: why not, and what to do; empty where they did.
        ambiguity: what the data cannot tell, even without noise.
        warnings: code, figure and message of each.
        notes: what a reader should know about the input, a sentence each.
        velocities: ``(n, d)``, where the model has them.
        unverified: ``(n,)`` matches that stand still between two of the views only.
        metric: whether the motion is rigid.
        threshold: greatest distance of an inlier; None = estimated.
        manifest: of :func:`indexing.files.manifest`.
    """

    title: str
    model: tuple[str, str]
    views: Sequence[FloatArray]
    names: Sequence[str]
    ids: Sequence[str]
    labels: NDArray[np.int64]
    motion: Sequence[FloatArray]
    covariance: FloatArray
    sigma: float
    status: str = "OK"
    reason: str = ""
    ambiguity: str = ""
    warnings: Sequence[tuple[str, float, str]] = ()
    notes: Sequence[str] = ()
    velocities: FloatArray | None = None
    unverified: NDArray[np.bool_] | None = None
    metric: bool = False
    threshold: float | None = None
    manifest: Mapping[str, Any] = field(default_factory=dict)

    @property
    def solved(self) -> bool:
        """Whether there is a motion at all, good or doubtful."""
        return all(np.isfinite(part).all() and np.abs(part).max() > 0 for part in self.motion)

    @property
    def missing(self) -> NDArray[np.bool_]:
        """``(n,)`` matches that are missing in a view."""
        return np.any([np.isnan(view.reshape(len(view), -1)).any(axis=1) for view in self.views], axis=0)

    @property
    def kinds(self) -> list[str]:
        """What each match is: outlier, static, moving or missing."""
        return [
            "missing" if gone else LABELS[label] for label, gone in zip(self.labels.tolist(), self.missing.tolist(), strict=True)
        ]

    @property
    def counts(self) -> dict[str, int]:
        """How many matches of each kind."""
        kinds = self.kinds
        return {name: kinds.count(name) for name in ("static", "moving", "outlier", "missing")}

    def deviations(self) -> list[FloatArray]:
        """Standard deviations of the entries of the motion."""
        spread = np.sqrt(np.clip(np.diagonal(self.covariance), 0, None))
        ends = np.cumsum([part.size for part in self.motion])[:-1]
        return [part.reshape(matrix.shape) for part, matrix in zip(np.split(spread, ends), self.motion, strict=True)]


def write_alignment(folder: str | Path, report: AlignmentReport) -> Path:
    """Write a report into a folder: ``report.html``, ``alignment.json``, ``labels.csv`` and ``alignment.png``.

    Every file is written whole or not at all, ``report.html`` last.

    Returns:
        the path of ``report.html``.

    Raises:
        ValueError: the folder or a file in it cannot be written.

    Example:
        >>> import tempfile
        >>> points = np.array([[0.0, 0.0], [3.0, 1.0], [1.0, 2.0]])
        >>> found = dict(labels=np.array([1, 1, 2]), motion=[np.eye(3)] * 2, covariance=np.eye(18) * 1e-8, sigma=0.1)
        >>> report = AlignmentReport("Three dots", ("planar", ""), [points] * 3, ["a", "b", "c"], ["1", "2", "3"], **found)
        >>> path = write_alignment(tempfile.mkdtemp(), report)
        >>> sorted(file.name for file in path.parent.iterdir())
        ['alignment.json', 'alignment.png', 'labels.csv', 'report.html']
    """
    where = files.prepare(folder)
    drawn = picture_of(report, LIGHT), picture_of(report, DARK)
    html = page(
        report.title, body(report, drawn), summary=describe(report), kind="Dynamic alignment", footer=made_by(report.manifest)
    )
    files.write_bytes(where / "alignment.png", drawn[0])
    files.write_text(where / "labels.csv", labels_csv(report))
    files.write_json(where / "alignment.json", as_json(report))
    return files.write_text(where / "report.html", html)


def as_json(report: AlignmentReport) -> dict[str, Any]:
    """The result as numbers: motion, labels, noise, covariance, status, warnings, and how it came about."""
    names = ("A", "B")[: len(report.motion)]
    spreads = report.deviations()
    return {
        "status": report.status,
        "reason": report.reason or None,
        "model": report.model[0],
        "views": list(report.names),
        "matches": len(report.ids),
        "counts": report.counts,
        "sigma": report.sigma,
        "threshold": report.threshold,
        **(dict(zip(names, report.motion, strict=True)) if report.solved else {}),
        **({f"{name}_deviation": spread for name, spread in zip(names, spreads, strict=True)} if report.solved else {}),
        "covariance": report.covariance if report.solved else None,
        "ambiguity": report.ambiguity,
        "warnings": [{"code": code, "value": value, "message": message} for code, value, message in report.warnings],
        "notes": list(report.notes),
        "ids": list(report.ids),
        "labels": report.labels,
        "velocities": report.velocities,
        "unverified": None if report.unverified is None else [report.ids[i] for i in np.flatnonzero(report.unverified)],
        "manifest": report.manifest,
    }


def labels_csv(report: AlignmentReport) -> str:
    """``id,label,name`` of every match; 0 outlier or missing, 1 static, 2 moving."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["id", "label", "name"])
    writer.writerows(zip(map(safe_cell, report.ids), report.labels.tolist(), report.kinds, strict=True))
    return out.getvalue()


def safe_cell(name: str) -> str:
    """A name as a cell.  Spreadsheets run text that begins like a formula; an apostrophe keeps it text."""
    return f"'{name}" if name.lstrip(" ")[:1] in tuple("=+@\t\r\n") or (name[:1] == "-" and not name[1:2].isdigit()) else name
