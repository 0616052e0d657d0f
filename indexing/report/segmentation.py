"""The report on a segmentation: which match moves with which body, how each body moved, and how sure that is."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from indexing import files
from indexing.readers.pairs import MatchedPair, Photograph
from indexing.report.alignment import safe_cell
from indexing.report.canvas import DARK, LIGHT, Theme, new_figure, png, shorten, style
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
from indexing.report.reconstruction import heading
from indexing.report.reconstruction_picture import finish, foot, layout, limits, sample

# ----------------------------------------------------------------------------------------------------------------------
# The picture of a segmentation: both images, the matches coloured by their body, and how they moved.


if TYPE_CHECKING:
    from indexing.readers.pairs import Photograph

FloatArray = NDArray[np.float64]
Box = tuple[FloatArray, FloatArray]
# neighbours in the list are apart for colour-blind eyes, too, on both papers and on gray
COLOURS = ("#2f7fb8", "#e8741e", "#2fa36b", "#c2478f", "#b99a0d", "#7d62c9", "#1fa6a6", "#d1493f")
MARKS = ("o", "s", "^", "D")  # one for every round through the colours
WIDTH, TALL, EDGE, GAP, HEAD, TICKS, FOOT = 10.2, 5.2, 0.45, 0.5, 0.32, 0.3, 0.5  # inches
WIDE = 0.42  # height over width below which images are drawn one above the other
FADE = (0.62, 0.78)  # how much of white and of dark paper is laid over a photograph
STRAYS = 0.995  # of the matches, those that a panel without image shows
SLIM = 0.2  # least ratio of the sides of such a panel


def colour_of(label: int) -> str:
    """The colour of a body.

    Example:
        >>> colour_of(1), colour_of(9) == colour_of(1)
        ('#2f7fb8', True)
    """
    return COLOURS[(label - 1) % len(COLOURS)]


def picture_of(report: SegmentationReport, theme: Theme) -> bytes:
    """PNG: image 1 with the way of every match of a body to its place in image 2, and image 2."""
    places = (report.pair.x1, report.pair.x2)
    photographs: list[Photograph | None] = [*report.photographs] or [None, None]
    boxes = [_box(report, i) for i in range(2)]
    size = float(np.clip(4500 / max(1, len(report.labels)), 5, 20))
    with style(theme):
        figure, panels = _panels(boxes, bool(report.photographs))
        for i, (panel, points, photograph, box) in enumerate(zip(panels, places, photographs, boxes, strict=True)):
            if photograph is not None:
                _draw_photograph(panel, photograph, theme)
            _draw_outliers(panel, points[report.pair.seen & (report.labels == 0)], size, theme)
            for label in range(1, report.bodies + 1):  # the small ones on top: dense bodies would hide them otherwise
                mine = report.pair.seen & (report.labels == label)
                if i == 0:
                    _draw_ways(panel, np.stack([points[mine], places[1][mine]]), label, box)
                _draw_points(panel, points[mine], label, size, theme)
            name = photograph.name if photograph is not None else f"image {i + 1}"
            finish(panel, *box, True, shorten(name, 50) + ", with the way to image 2" * (i == 0 and report.bodies > 0))
            if photograph is not None:
                panel.set(xticks=[], yticks=[])
        foot(figure, _handles(report, theme), theme, columns=6)
        return png(figure, tight=True)


def _box(report: SegmentationReport, which: int) -> Box:
    """What a panel shows: the image where its size is known, otherwise the matches in either image."""
    size = report.photographs[which].size if report.photographs else report.size
    if size is not None:
        return np.array([-0.5, -0.5]), np.array(size) - 0.5
    places = np.stack([report.pair.x1, report.pair.x2])
    low, high = limits(places[:, report.labels > 0])
    every = limits(places[:, report.pair.seen], STRAYS)
    if (report.labels > 0).any():
        every = np.minimum(low, every[0]), np.maximum(high, every[1])
    sides = every[1] - every[0]
    room = np.maximum(0, SLIM * sides.max() - sides) / 2
    return every[0] - room, every[1] + room


def _panels(boxes: list[Box], bare: bool) -> tuple[Any, list[Any]]:
    """A figure with both images, side by side, or one above the other where they are wide."""
    edge, ticks = (0.0, 0.0) if bare else (EDGE, TICKS)
    ratios = [float((high - low)[1] / (high - low)[0]) for low, high in boxes]
    if max(ratios) > WIDE:
        return layout(boxes, TALL, edge, 0.15 if bare else GAP)
    wide = WIDTH - edge
    heights = [wide * max(ratio, 0.05) for ratio in ratios]
    height = sum(heights) + 2 * (HEAD + ticks) + FOOT
    figure, top, panels = new_figure(WIDTH, height), 0.0, []
    for tall in heights:
        top += HEAD + tall
        panels.append(figure.add_axes((edge / WIDTH, 1 - top / height, wide / WIDTH, tall / height)))
        top += ticks
    return figure, panels


def _draw_photograph(panel: Any, photograph: Photograph, theme: Theme) -> None:
    """The image in gray, faded into the paper, so that the colours of the bodies stand out on it."""
    from matplotlib.colors import to_rgb

    wide, tall = photograph.size
    paper = np.array(to_rgb(theme.paper))
    fade = FADE[int(paper.mean() < 0.5)]
    shown = (1 - fade) * photograph.gray[..., None] + fade * paper
    panel.imshow(shown, extent=(-0.5, wide - 0.5, tall - 0.5, -0.5), interpolation="bilinear", zorder=0)


def _draw_outliers(panel: Any, points: FloatArray, size: float, theme: Theme) -> None:
    panel.scatter(*points.T, s=0.7 * size, c=theme.muted, marker="x", linewidth=0.8, alpha=0.65, zorder=2)


def _draw_ways(panel: Any, paths: FloatArray, label: int, box: Box) -> None:
    """Where matches ``(2, n, 2)`` went; of long ways that would tangle, some."""
    from matplotlib.collections import LineCollection

    ways = paths[:, sample(paths, box)].transpose(1, 0, 2)
    panel.add_collection(LineCollection(list(ways), colors=colour_of(label), linewidths=0.8, alpha=0.45, zorder=3), autolim=False)


def _draw_points(panel: Any, points: FloatArray, label: int, size: float, theme: Theme) -> None:
    look: Any = {"marker": _mark_of(label), "edgecolor": theme.paper, "linewidth": 0.4}
    panel.scatter(*points.T, s=size, c=colour_of(label), zorder=4, **look)


def _mark_of(label: int) -> str:
    return MARKS[(label - 1) // len(COLOURS) % len(MARKS)]


def _handles(report: SegmentationReport, theme: Theme) -> list[Any]:
    """Entries of the legend: every body with its matches and its model, and the outliers."""
    from matplotlib.lines import Line2D

    counts, found = report.counts, []
    for label, model in enumerate(report.models, start=1):
        text = f"body {label}: {counts[f'body {label}']:,}" + " (homography)" * (model == "homography")
        found.append(Line2D([], [], color=colour_of(label), marker=_mark_of(label), linestyle="", markersize=5.5, label=text))
    if counts["outlier"]:
        noun = "outlier" if report.bodies else "unlabelled"
        text = f"{counts['outlier']:,} {noun}{'s' * (report.bodies > 0 and counts['outlier'] > 1)}"
        found.append(Line2D([], [], color=theme.muted, marker="x", linestyle="", markersize=5, label=text))
    return found


# ----------------------------------------------------------------------------------------------------------------------
# The sections of the report on a segmentation, as HTML.


LISTED = 300  # matches whose names are listed on the page
MEANING = {
    "fundamental": "fundamental matrix: a rigid body with depth",
    "homography": "homography: a plane, or a body seen under a rotation alone",
}


def body(report: SegmentationReport, drawn: tuple[bytes, bytes]) -> str:
    """The page's sections: headline numbers, warnings, picture, bodies, comparison, labels, settings."""
    parts = [cards(_headline(report)), _warnings(report), _picture(report, drawn)]
    if report.bodies:
        parts += [_bodies(report), _comparison(report), _labels(report)]
    parts.append(provenance(report.manifest))
    return "\n".join(part for part in parts if part)


def describe(report: SegmentationReport) -> str:
    """The result in plain words."""
    number, counts = int(report.pair.seen.sum()), report.counts
    if report.status != "OK" or not report.bodies:
        start = f"The {number:,} matches do not decide what moves with what. {sentence(report.reason)}"
        return start + " What follows is the best segmentation found, and not to be relied on." * (report.bodies > 0)
    *most, last = [f"{counts[f'body {i}']:,}" for i in range(1, report.bodies + 1)]
    moved = f"{number - counts['outlier']:,} move "
    moved += f"with one of {report.bodies} bodies ({', '.join(most)} and {last})" if most else "as one body"
    rest = f"; {counts['outlier']:,} fit{'s' * (counts['outlier'] == 1)} none" * (counts["outlier"] > 0)
    lost = f" {counts['missing']:,} more {'is' if counts['missing'] == 1 else 'are'} missing in an image." * (counts["missing"] > 0)
    return f"Of {number:,} matches of two images, {moved}{rest}.{lost}"


def _headline(report: SegmentationReport) -> list[Card]:
    counts, ok = report.counts, report.status == "OK"
    number = int(report.pair.seen.sum())
    items = [Card("Status", "Solved" if ok else "Refused", "the matches decide" if ok else report.status.lower().replace("_", " "))]
    if not report.bodies:
        return [*items, Card("Matches", f"{number:,}", f"and {counts['missing']:,} missing" if counts["missing"] else "")]
    planes = sum(model == "homography" for model in report.models)
    kind = f"{planes} by a homography" if planes else "all with depth"
    items.append(Card("Bodies", f"{report.bodies:,}", kind))
    items.append(Card("On a body", f"{number - counts['outlier']:,}", f"of {number:,} matches"))
    rest = f", and {counts['missing']:,} missing in an image" if counts["missing"] else ""
    items.append(Card("Outliers", f"{counts['outlier']:,}", f"{_share(counts['outlier'], number)} of the matches{rest}"))
    items.append(Card("Residual", f"{_rms(report) or 'no'} px", f"rms; the threshold is {report.threshold:.3g} px"))
    if report.misclassified is not None:
        items.append(Card("Misclassified", f"{100 * report.misclassified:.2g} %", "against the labels of the file"))
    return items


def _rms(report: SegmentationReport, label: int | None = None) -> str:
    value = report.rms(label)
    return f"{value:.3g}" if np.isfinite(value) else ""


def _share(part: int, whole: int) -> str:
    share = 100 * part / max(1, whole)
    return "under 1 %" if 0 < share < 1 else f"{share:.0f} %"


def _warnings(report: SegmentationReport) -> str:
    lines = [
        f"<li><b>{escape(heading(code).capitalize())}.</b> {escape(sentence(text))}</li>"
        for code, _, text in report.warnings
        if text not in report.reason
    ]
    lines += [f"<li>{escape(sentence(note))}</li>" for note in report.notes]
    if report.reason:
        lines.insert(0, f'<li><b class="bad">Refused.</b> {escape(sentence(report.reason))}</li>')
    return section("Please note", f"<ul>{''.join(lines)}</ul>") if lines else ""


def _picture(report: SegmentationReport, drawn: tuple[bytes, bytes]) -> str:
    note = "Every match in both images, coloured by the body that it moves with; crosses fit none."
    if not report.bodies:
        note = "The matches as given; no bodies were found in them."
    ways = "Lines in image 1 lead to where image 2 shows the match; where long ones would tangle, some are drawn."
    caption = ways if report.bodies else ""
    alt = f"Two images: {', '.join(f'{count} {name}' for name, count in report.counts.items() if count)}"
    title = "What moves with what" if report.bodies else "The matches"
    return section(title, picture(drawn[0], alt, dark=drawn[1], caption=caption), note)


def _bodies(report: SegmentationReport) -> str:
    number, rows, matrices = int(report.pair.seen.sum()), [], []
    for label, model in enumerate(report.models, start=1):
        mine = report.pair.seen & (report.labels == label)
        count = int(mine.sum())
        dot = f'<span style="color:{colour_of(label)}" aria-hidden="true">●</span> body {label}'
        figures = [f"{count:,}", _share(count, number), _rms(report, label), f"{int((mine & report.doubtful).sum()):,}"]
        rows.append([dot, *figures, escape(MEANING.get(model, model))])
        flat = report.homographies[label - 1] if model == "homography" else report.fundamentals[label - 1]
        entries = "<br>".join("&ensp;".join(f"{value:.6g}" for value in row) for row in flat)
        matrices.append([f"body {label}", escape(model), f"<code>{entries}</code>"])
    names = ("Matches", "Share", "Rms residual, px", "Doubtful")
    shown = table(
        [Column("Body"), *(Column(name, "number") for name in names), Column("Motion")], rows, caption="Bodies", css="stack"
    )
    columns = [Column("Body"), Column("Model"), Column("Matrix, norm 1", "long")]
    kept = details("Matrices", table(columns, matrices, css="plain", caption="Matrices"))
    note = (
        "The largest first. A residual is the Sampson distance from the motion of the own body; a match is doubtful where its "
        "label has a probability below 0.9. Fundamental matrices fulfil x2ᵀ F x1 = 0, homographies lead from image 1 to image 2."
    )
    return section("How each body moved", shown + kept, note)


def _comparison(report: SegmentationReport) -> str:
    """How many matches of every known body were found to be of which."""
    known = report.pair.known
    if known is None:
        return ""
    rows = []
    for label in sorted(np.unique(known[report.pair.seen]).tolist(), key=lambda label: (label == 0, label)):
        found = report.labels[report.pair.seen & (known == label)]
        cells = [f"{int((found == i).sum()):,}" for i in (*range(1, report.bodies + 1), 0)]
        rows.append([f"body {label}" if label else "outlier", *(cell if cell != "0" else "" for cell in cells)])
    columns = [Column("In the file"), *(Column(name, "number") for name in (*report.names[1:], "outlier"))]
    note = "Rows are the labels of the file, columns what was found; the numbers of the bodies need not agree."
    return section("Compared with the labels of the file", table(columns, rows, caption="Known and found labels"), note)


def _labels(report: SegmentationReport) -> str:
    several = report.counts["outlier"] > 1
    kinds = ["outliers" if kind == "outlier" and several else kind for kind in report.kinds]
    order = (*report.names[1:], "outliers" if several else "outlier", "missing")
    names = listed(report.pair.ids, kinds, order, LISTED, "labels.csv")
    doubtful = ["doubtful" if odd else "" for odd in report.doubtful.tolist()]
    names += listed(report.pair.ids, doubtful, ("doubtful",), LISTED, "labels.csv")
    note = "By the names of the file, or the numbers of its rows; labels.csv has them all, segmentation.npz all arrays."
    return section("Each match", names, note)


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
