"""The sections of the report on an alignment, as HTML."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from indexing.report.page import Card, Column, cards, escape, listed, picture, provenance, section, sentence, table

if TYPE_CHECKING:
    from indexing.report.alignment import AlignmentReport

FloatArray = NDArray[np.float64]
LISTED = 300  # matches whose labels are listed on the page
ROUNDING = 1e-14  # of the largest entry: what arithmetic leaves of a deviation that is zero (measured: 3e-17)


def body(report: AlignmentReport, drawn: tuple[bytes, bytes]) -> str:
    """The page's sections: headline numbers, warnings, picture, motion, what stays open, labels, settings."""
    parts = [cards(_headline(report)), _warnings(report), _picture(report, drawn)]
    if report.solved:
        parts.append(_motion(report))
    if report.ambiguity:
        parts.append(section("What the data cannot tell", "", report.ambiguity))
    parts.append(_labels(report))
    parts.append(provenance(report.manifest))
    return "\n".join(part for part in parts if part)


def describe(report: AlignmentReport) -> str:
    """The result in plain words."""
    number, counts = len(report.ids), report.counts
    what = "lines" if report.views[0].ndim == 3 else "points"
    if report.status != "OK":
        start = f"The {number:,} {what} do not decide how the sensor moved."
        return f"{start} {sentence(report.reason)}" + (
            " What follows is the best motion found, and not to be relied on." * report.solved
        )
    parts = [f"{counts['static']:,} stand still and {counts['moving']:,} move"]
    if counts["outlier"]:
        parts.append(f"{counts['outlier']:,} fit neither")
    if counts["missing"]:
        parts.append(f"{counts['missing']:,} are missing in a view")
    return f"Of {number:,} {what} in {len(report.views)} views, {'; '.join(parts)}. {report.model[1]}"


def display_scale(matrix: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray, bool]:
    """A collineation scaled so that its last entry is 1 (where that is not near 0), with the standard deviations that follow.

    Returns:
        matrix, standard deviations, and whether it was scaled.
    """
    flat, last = matrix.ravel(), float(matrix[-1, -1])
    if abs(last) < 1e-9 * float(np.abs(flat).max()):
        return matrix, np.sqrt(np.clip(np.diagonal(covariance), 0, None)).reshape(matrix.shape), False
    if not np.isfinite(covariance).all():  # as few matches as can be: nothing is left to judge by
        spread = np.full(flat.size, np.inf)
        spread[-1] = 0.0
        return matrix / last, spread.reshape(matrix.shape), True
    derivative = np.eye(flat.size) / last
    derivative[:, -1] -= flat / last**2
    derivative[-1] = 0.0  # the last entry is 1 by decree, whatever rounding says
    spread = np.sqrt(np.clip(np.diagonal(derivative @ covariance @ derivative.T), 0, None))
    spread[spread < ROUNDING * np.abs(flat / last).max()] = 0.0
    return matrix / last, spread.reshape(matrix.shape), True


def turn_and_shift(matrix: FloatArray) -> tuple[float, FloatArray]:
    """Angle of a rigid motion in degrees, and its translation."""
    motion = matrix / matrix[-1, -1]
    rotation = motion[:3, :3]
    sine = 0.5 * np.linalg.norm([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
    return math.degrees(math.atan2(float(sine), float(np.trace(rotation) - 1) / 2)), motion[:3, 3]


def figures(value: float, spread: float) -> tuple[str, str]:
    """A number and its standard deviation, with as many decimals as the deviation supports (two figures of it); empty where it is
    zero or unknown.

    Example:
        >>> figures(0.98765432, 0.00123), figures(412.3456, 1.5), figures(2.0, 0.0), figures(-3.2e-06, 4.5e-08)
        (('0.9877', '0.0012'), ('412.3', '1.5'), ('2', ''), ('-3.200e-06', '4.5e-08'))
    """
    if not (math.isfinite(spread) and spread > 0 and math.isfinite(value)):
        return f"{value:.6g}", ""
    places = 1 - math.floor(math.log10(spread))
    if places > 6:
        power = math.floor(math.log10(abs(value))) if value else 0
        return f"{value:.{min(15, max(1, places + power))}e}", f"{spread:.1e}"
    return f"{value:.{max(0, places)}f}", f"{spread:.{max(0, places)}f}"


def _headline(report: AlignmentReport) -> list[Card]:
    counts, number = report.counts, len(report.ids)
    ok = report.status == "OK"
    items = [Card("Status", "Solved" if ok else "Refused", "the data decide" if ok else report.status.lower().replace("_", " "))]
    if report.solved:
        items += [Card(name.capitalize(), f"{counts[name]:,}", f"of {number:,}") for name in ("static", "moving")]
        rest = f"and {counts['missing']:,} missing in a view" if counts["missing"] else f"of {number:,}"
        items.append(Card("Outliers", f"{counts['outlier']:,}", rest))
        items.append(Card("Noise", f"{report.sigma:.3g}", "standard deviation of a coordinate, in the unit of the files"))
        if report.metric:
            angle, shift = turn_and_shift(report.motion[0])
            items.append(Card("View 2 to 1", f"{angle:.3g}°", f"turn, and a shift of {np.linalg.norm(shift):.4g}"))
    else:
        items.append(Card("Matches", f"{number:,}", f"{counts['missing']:,} of them missing in a view"))
    return items


def _warnings(report: AlignmentReport) -> str:
    lines = [
        f"<li><b>{escape(code.replace('_', ' ').capitalize())}.</b> {escape(sentence(text))}</li>"
        for code, _, text in report.warnings
    ]
    lines += [f"<li>{escape(sentence(note))}</li>" for note in report.notes]
    if report.reason:
        lines.insert(0, f'<li><b class="bad">Refused.</b> {escape(sentence(report.reason))}</li>')
    return section("Please note", f"<ul>{''.join(lines)}</ul>") if lines else ""


def _picture(report: AlignmentReport, drawn: tuple[bytes, bytes]) -> str:
    counts = report.counts
    if not report.solved:
        note, caption = "The matches as measured; without a motion there are no labels.", ""
    elif report.views[0].ndim == 3:
        note = "Every match in every view, by what it was found to be."
        caption = "Dashed in view 1: where view 2 saw what moves, carried over by A."
    else:
        note = "Every match in every view, by what it was found to be."
        caption = (
            "In view 1, the path of each moving point: where view 1 saw it (filled), where the others did, carried over by A and B "
            "(open, view 3 the smaller), and the straight line it moves on."
        ) + (" Dashed: static in two views, mismatched or moved in the third." * bool(np.any(report.unverified)))
    if report.views[0].shape[-1] == 3:
        caption += " Of the three coordinates, the two are shown in which view 1 extends most."
    alt = f"The views: {counts['static']} static, {counts['moving']} moving, {counts['outlier']} outliers"
    title = "What moves" if report.solved else "The matches"
    return section(title, picture(drawn[0], alt, dark=drawn[1], caption=caption.strip()), note)


def _motion(report: AlignmentReport) -> str:
    parts, scaled_all, start = [], True, 0
    for number, (name, matrix) in enumerate(zip("AB", report.motion, strict=False), start=2):
        size = matrix.size
        values, spread, scaled = display_scale(matrix, report.covariance[start : start + size, start : start + size])
        scaled_all &= scaled
        start += size
        rows = []
        for i, row in enumerate(values):
            cells = [_cell(*figures(float(v), float(s))) for v, s in zip(row, spread[i], strict=True)]
            rows.append([f"{name}, row {i + 1}", *cells])
        columns = [Column(f"View {number} to view 1"), *(Column(f"column {j + 1}", "number") for j in range(values.shape[1]))]
        parts.append(table(columns, rows, caption=f"{name}, from view {number} to view 1"))
        if report.metric:
            angle, shift = turn_and_shift(matrix)
            moved = ", ".join(f"{value:.4g}" for value in shift)
            parts.append(f'<p class="note">A turn by {angle:.4g}° and a shift by ({moved}).</p>')
    scale = "" if report.metric else f" Scaled {'so that the last entry is 1' if scaled_all else 'to Frobenius norm 1'}."
    note = f"The matrices that carry a static point to where view 1 sees it, each entry ± its standard deviation.{scale}"
    return section("How the sensor moved", "".join(parts), note)


def _cell(value: str, spread: str) -> str:
    return f'{value} <small class="none">± {spread}</small>' if spread else value


def _labels(report: AlignmentReport) -> str:
    if not report.solved:
        return ""
    names = listed(report.ids, report.kinds, ("moving", "outlier", "missing", "static"), LISTED, "labels.csv")
    return section("Each match", names, "By the names of the file, or the numbers of its rows; labels.csv has them all.")
