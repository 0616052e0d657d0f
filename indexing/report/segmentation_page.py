"""The sections of the report on a segmentation, as HTML."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from indexing.report.page import Card, Column, cards, details, escape, listed, picture, provenance, section, sentence, table
from indexing.report.reconstruction_words import heading
from indexing.report.segmentation_picture import colour_of

if TYPE_CHECKING:
    from indexing.report.segmentation import SegmentationReport

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
