"""The report on a segmentation: which match moves with which body, how each body moved, and how sure that is."""

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
from indexing.readers.images import Photograph
from indexing.readers.pairs import MatchedPair
from indexing.report.alignment import safe_cell
from indexing.report.canvas import DARK, LIGHT
from indexing.report.page import made_by, page
from indexing.report.segmentation_page import body, describe
from indexing.report.segmentation_picture import picture_of

FloatArray = NDArray[np.float64]

FILES = ("report.html", "segmentation.npz", "segmentation.json", "labels.csv", "segmentation.png")
SURE = 0.9  # probability of its label below which a match is called doubtful


@dataclass(frozen=True, eq=False)
class SegmentationReport:
    """Everything that the report on a segmentation says.

    Args:
        title: heading of the page.
        pair: what was given.
        labels: ``(n,)`` 0 outlier or missing, 1..K the bodies.
        fundamentals: ``(K, 3, 3)``.
        homographies: ``(K, 3, 3)``, 0 where the model is a fundamental matrix.
        models: ``K`` names, fundamental or homography.
        probabilities: ``(n, K + 1)`` of outlier and bodies.
        residuals: ``(n,)`` distance from the own body's model, px.
        coherence: ``(n,)`` in [0, 1].
        threshold: greatest distance of an inlier, px.
        status: the status's name, ``"OK"`` where the data decided.
        reason: why not, and what to do; empty where they did.
        warnings: code, figure and message of each.
        notes: what a reader should know about the input, a sentence each.
        misclassified: share of the matches whose label is not the known one; None = not known.
        photographs: of both images; empty = none.
        size: width and height of the images; None = not known.
        manifest: of :func:`indexing.files.manifest`.
    """

    title: str
    pair: MatchedPair
    labels: NDArray[np.int64]
    fundamentals: FloatArray
    homographies: FloatArray
    models: Sequence[str]
    probabilities: FloatArray
    residuals: FloatArray
    coherence: FloatArray
    threshold: float
    status: str = "OK"
    reason: str = ""
    warnings: Sequence[tuple[str, float, str]] = ()
    notes: Sequence[str] = ()
    misclassified: float | None = None
    photographs: Sequence[Photograph] = ()
    size: tuple[float, float] | None = None
    manifest: Mapping[str, Any] = field(default_factory=dict)

    @property
    def bodies(self) -> int:
        """How many bodies."""
        return len(self.models)

    @property
    def names(self) -> list[str]:
        """What labels mean: outlier, body 1, body 2, ..."""
        return ["outlier", *(f"body {i}" for i in range(1, self.bodies + 1))]

    @property
    def kinds(self) -> list[str]:
        """What each match is: one of the names, or missing."""
        seen = self.pair.seen.tolist()
        return [self.names[label] if there else "missing" for label, there in zip(self.labels.tolist(), seen, strict=True)]

    @property
    def counts(self) -> dict[str, int]:
        """How many matches of each kind, bodies first."""
        kinds = self.kinds
        return {name: kinds.count(name) for name in (*self.names[1:], "outlier", "missing")}

    @property
    def certainty(self) -> FloatArray:
        """``(n,)`` probability of the label of each match; NaN where it is missing."""
        own = np.take_along_axis(self.probabilities, self.labels[:, None], axis=1)[:, 0]
        return np.where(self.pair.seen, own, np.nan)

    @property
    def doubtful(self) -> NDArray[np.bool_]:
        """``(n,)`` matches that might well have another label."""
        return np.asarray(self.certainty < SURE)

    def rms(self, label: int | None = None) -> float:
        """Root mean square of the residuals of one body, or of all; NaN where there are no matches."""
        mine = self.pair.seen & ((self.labels > 0) if label is None else (self.labels == label))
        return float(np.sqrt(np.mean(np.square(self.residuals[mine])))) if mine.any() else float("nan")


def write_segmentation(folder: str | Path, report: SegmentationReport) -> Path:
    """Write a report into a folder: the files of :data:`FILES`, each whole or not at all, ``report.html`` last.

    Returns:
        the path of ``report.html``.

    Raises:
        ValueError: the folder or a file in it cannot be written.
    """
    where = files.prepare(folder)
    drawn = picture_of(report, LIGHT), picture_of(report, DARK)
    html = page(
        report.title, body(report, drawn), summary=describe(report), kind="Bodies in two views", footer=made_by(report.manifest)
    )
    files.write_bytes(where / "segmentation.png", drawn[0])
    files.write_text(where / "labels.csv", labels_csv(report))
    files.write_bytes(where / "segmentation.npz", as_npz(report))
    files.write_json(where / "segmentation.json", as_json(report))
    return files.write_text(where / "report.html", html)


def as_npz(report: SegmentationReport) -> bytes:
    """All arrays, without pickle; ``x1, x2, ids, known`` are those that were given."""
    names = ("labels", "fundamentals", "homographies", "probabilities", "residuals", "coherence", "threshold")
    arrays: dict[str, Any] = {name: np.asarray(getattr(report, name)) for name in names}
    arrays |= {"models": np.array(report.models, dtype=np.str_), "status": np.array(report.status)}
    arrays |= {"x1": report.pair.x1, "x2": report.pair.x2, "ids": np.array(report.pair.ids)}
    if report.pair.known is not None:
        arrays["known"] = report.pair.known
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


def as_json(report: SegmentationReport) -> dict[str, Any]:
    """The result as numbers: bodies with their models, counts, status, warnings, and how it came about."""
    seen = max(1, int(report.pair.seen.sum()))
    return {
        "status": report.status,
        "reason": report.reason or None,
        "pair": report.pair.name,
        "matches": len(report.pair.ids),
        "bodies": [
            {
                "label": label,
                "matches": report.counts[f"body {label}"],
                "share": report.counts[f"body {label}"] / seen,
                "model": str(model),
                "rms_residual": report.rms(label),
                "fundamental": report.fundamentals[label - 1],
                "homography": report.homographies[label - 1] if model == "homography" else None,
            }
            for label, model in enumerate(report.models, start=1)
        ],
        "counts": report.counts,
        "doubtful": int(report.doubtful.sum()),
        "rms_residual": report.rms(),
        "threshold": report.threshold,
        "misclassified": report.misclassified,
        "warnings": [{"code": code, "value": value, "message": message} for code, value, message in report.warnings],
        "notes": list(report.notes),
        "manifest": report.manifest,
    }


def labels_csv(report: SegmentationReport) -> str:
    """``id, x1, y1, x2, y2, label, name, probability, residual`` of every match; label 0 is an outlier, or missing.

    The probability is that of the label, the residual the distance from the own body's model, for outliers from the nearest.
    """
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["id", "x1", "y1", "x2", "y2", "label", "name", "probability", "residual"])
    columns = zip(report.pair.ids, report.pair.x1, report.pair.x2, report.kinds, report.certainty, strict=True)
    for i, (name, first, second, kind, sure) in enumerate(columns):
        places = [f"{value:.9g}" if np.isfinite(value) else "" for value in (*first, *second)]
        rest = ["", ""] if kind == "missing" else [f"{sure:.4f}", f"{report.residuals[i]:.6g}" if report.bodies else ""]
        writer.writerow([safe_cell(name), *places, int(report.labels[i]), kind, *rest])
    return out.getvalue()
