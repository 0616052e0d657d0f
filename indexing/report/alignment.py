"""The report on an alignment: what moved, what stood still, how the sensor moved, and how far that can be trusted."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from indexing import files
from indexing.report.canvas import DARK, LIGHT, Theme, new_figure, png, shorten, style
from indexing.report.page import Card, Column, cards, escape, listed, made_by, page, picture, provenance, section, sentence, table

# ----------------------------------------------------------------------------------------------------------------------
# The sections of the report on an alignment, as HTML.


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


# ----------------------------------------------------------------------------------------------------------------------
# The picture of an alignment: view 1 with the paths of what moves, and the other views, coloured alike.


Box = tuple[float, float, float, float]  # left, right, low, high
# apart for colour-blind eyes, too, on both papers; outliers are crosses besides
COLOURS = {"static": "#2f7fb8", "moving": "#e8741e", "outlier": "#8b949c"}
MARKS = {"static": "o", "moving": "o", "outlier": "x"}
PATHS = 1500  # paths drawn; more are a blot
ROOM = 0.06  # around the points, of their extent
REACH = 0.6  # how far beyond view 1 paths are shown, of its extent
WIDTH, MARGIN, GAP, TITLE, FOOT = 10.2, 0.65, 0.6, 0.3, 0.35  # inches
WIDE = 0.62  # height over width of view 1, below which it gets the whole width


def picture_of(report: AlignmentReport, theme: Theme) -> bytes:
    """PNG: view 1, large, with the path of every moving match carried over from the other views; beside it the other views."""
    kinds = np.array(report.kinds) if report.solved else np.where(report.missing, "missing", "unlabelled")
    colours = {**COLOURS, "unlabelled": theme.muted}
    segments = report.views[0].ndim == 3
    axes_shown, turned = _axes(report)
    flat = [view[..., axes_shown] for view in report.views]
    boxes = [_box(points, kinds) for points in flat]
    if report.solved:
        boxes[0] = _widened(boxes[0], report, kinds, axes_shown)
    with style(theme):
        height, places = _layout([(box[3] - box[2]) / (box[1] - box[0]) for box in boxes])
        figure = new_figure(WIDTH, height)
        for number, (points, place, box) in enumerate(zip(flat, places, boxes, strict=True), start=1):
            left, top, width, tall = place
            panel = figure.add_axes((left / WIDTH, 1 - (top + tall) / height, width / WIDTH, tall / height))
            if number == 1 and report.solved:
                _draw_paths(panel, report, kinds, axes_shown, box)
            _draw_points(panel, points, kinds, colours, large=number == 1, segments=segments)
            _finish(panel, box, turned, theme)
            panel.set_title(f"view {number}: {shorten(report.names[number - 1], 40)}", fontsize=9, loc="left", parse_math=False)
            if number == 1:
                panel.set_xlabel("xyz"[axes_shown[0]])
                panel.set_ylabel("xyz"[axes_shown[1]])
        _legend(figure, kinds, colours, theme, segments)
        return png(figure, tight=True)


def _layout(ratios: list[float]) -> tuple[float, list[Box]]:
    """Height of the figure, and left, top, width and height of every panel, in inches.

    View 1 is large: above the others where it is wide, left of them otherwise.

    Args:
        ratios: height over width of what each panel shows.
    """

    def fitted(left: float, top: float, width: float, ratio: float, limit: float) -> Box:
        tall = min(limit, max(0.6, width * ratio))
        return left, top, min(width, tall / ratio), tall

    room = WIDTH - MARGIN
    half = (room - GAP) / 2
    if len(ratios) == 2:
        found = [fitted(MARGIN + i * (half + GAP), TITLE, half, ratio, 5.5) for i, ratio in enumerate(ratios)]
    elif ratios[0] < WIDE:
        first = fitted(MARGIN, TITLE, room, ratios[0], 5.0)
        below = first[1] + first[3] + FOOT + TITLE
        found = [first, *(fitted(MARGIN + i * (half + GAP), below, half, ratio, 4.0) for i, ratio in enumerate(ratios[1:]))]
    else:
        large = 0.64 * (room - GAP)
        found = [fitted(MARGIN, TITLE, large, ratios[0], 6.5)]
        top = TITLE
        for ratio in ratios[1:]:
            found.append(fitted(MARGIN + large + GAP, top, room - GAP - large, ratio, 3.2))
            top = found[-1][1] + found[-1][3] + FOOT + TITLE
    return max(place[1] + place[3] for place in found) + FOOT + 0.4, found


def _axes(report: AlignmentReport) -> tuple[list[int], bool]:
    """The two coordinates in which view 1 extends most, and whether the second points down, as in images."""
    points = report.views[0].reshape(-1, report.views[0].shape[-1])
    if points.shape[-1] == 2:
        return [0, 1], True
    spread = (
        np.nan_to_num(np.nanpercentile(points, 95, axis=0) - np.nanpercentile(points, 5, axis=0)) if len(points) else np.ones(3)
    )
    return sorted(np.argsort(-spread, kind="stable")[:2].tolist()), False


def _box(points: FloatArray, kinds: NDArray[Any]) -> Box:
    """Left, right, low, high of the matches that fit (of all, where none does), with room around."""
    kept = np.isin(kinds, ("static", "moving"))
    shown = points[kept if kept.sum() > 1 else kinds != "missing"].reshape(-1, 2)
    if not len(shown):
        return 0.0, 1.0, 0.0, 1.0
    low, high = shown.min(axis=0), shown.max(axis=0)
    # points that all but coincide keep a box that the ticks can name
    room = max(ROOM * float((high - low).max()), 1e-3 * float(np.abs(shown).max()), 1e-6)
    return float(low[0] - room), float(high[0] + room), float(low[1] - room), float(high[1] + room)


def _widened(box: Box, report: AlignmentReport, kinds: NDArray[Any], shown: list[int]) -> Box:
    """The box of view 1 with the paths of what moves in it, as far as they do not lead far away."""
    found = [
        carried(matrix, view[kinds == "moving"])[..., shown].reshape(-1, 2)
        for view, matrix in zip(report.views[1:], report.motion, strict=True)
        if view.shape[-1] + 1 == matrix.shape[-1]
    ]
    low, high = np.array(box[::2]), np.array(box[1::2])
    room = REACH * (high - low).max()
    places = np.concatenate([low[None], high[None], *found])
    places = places[((places >= low - room) & (places <= high + room)).all(axis=1)]
    least, most = places.min(axis=0), places.max(axis=0)
    return float(least[0]), float(most[0]), float(least[1]), float(most[1])


def as_segments(lines: FloatArray) -> FloatArray:
    """Two points ``(n, 2, 3)`` of lines in Pluecker coordinates ``(n, 6)`` (01, 02, 03, 12, 13, 23), around their common middle.

    Example:
        >>> a, b = np.array([0.0, 2.0, 3.0, 1.0]), np.array([4.0, 2.0, 3.0, 1.0])  # along x, through (., 2, 3)
        >>> pairs = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
        >>> as_segments(np.array([[a[i] * b[j] - a[j] * b[i] for i, j in pairs]]))[0, :, 1:].tolist()
        [[2.0, 3.0], [2.0, 3.0]]
    """
    direction = -lines[:, [2, 4, 5]]
    moment = np.stack([lines[:, 3], -lines[:, 1], lines[:, 0]], axis=1)
    square = np.square(direction).sum(axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        foot = np.cross(direction, moment) / square
        unit = direction / np.sqrt(square)
    middle = np.nan_to_num(np.nanmedian(foot, axis=0)) if np.isfinite(foot).any() else np.zeros(3)
    foot = foot + ((middle - foot) * unit).sum(axis=1, keepdims=True) * unit
    reach = 0.5 * float(np.nan_to_num(np.nanmedian(np.abs(foot - middle)))) or 0.5
    out: FloatArray = np.stack([foot - reach * unit, foot + reach * unit], axis=1)
    return out


def carried(matrix: FloatArray, points: FloatArray) -> FloatArray:
    """Points ``(..., d)`` moved by a collineation."""
    moved = points @ matrix[:-1, :-1].T + matrix[:-1, -1]
    last = points @ matrix[-1, :-1] + matrix[-1, -1]
    with np.errstate(divide="ignore", invalid="ignore"):
        out: FloatArray = moved / last[..., None]
    return out


def _draw_paths(panel: Any, report: AlignmentReport, kinds: NDArray[Any], shown: list[int], box: Box) -> None:
    from matplotlib.collections import LineCollection

    colour = COLOURS["moving"]
    fits = [view.shape[-1] + 1 == matrix.shape[-1] for view, matrix in zip(report.views[1:], report.motion, strict=True)]
    if not all(fits):
        return
    moving = np.flatnonzero(kinds == "moving")[:PATHS]
    others = [carried(matrix, view[moving]) for view, matrix in zip(report.views[1:], report.motion, strict=True)]
    if report.views[0].ndim == 3:  # lines: where view 2 saw them, dashed
        panel.add_collection(
            LineCollection(list(others[0][..., shown]), colors=colour, linewidths=0.9, alpha=0.55, linestyles=(0, (3, 2)))
        )
        return
    path = np.stack([report.views[0][moving], *others], axis=1)[..., shown]
    size = max(box[1] - box[0], box[3] - box[2])
    near = np.isfinite(path).all(axis=(1, 2)) & (np.abs(path - path[:, :1]).max(axis=(1, 2), initial=0) < 2 * size)
    doubtful = np.zeros(len(path), dtype=bool) if report.unverified is None else report.unverified[moving]
    if (near & doubtful).any():
        look: Any = {"linewidths": 0.9, "alpha": 0.6, "linestyles": (0, (2, 2))}
        panel.add_collection(LineCollection(list(path[near & doubtful]), colors=colour, **look))
    path = path[near & ~doubtful]
    if not len(path):
        return
    centre = path.mean(axis=1, keepdims=True)
    _, _, direction = np.linalg.svd(path - centre)
    along = ((path - centre) @ direction[:, 0, :, None])[..., 0]
    reach = 0.5 * (along.max(axis=1) - along.min(axis=1))
    ends = np.stack([along.min(axis=1) - reach, along.max(axis=1) + reach], axis=1)
    panel.add_collection(
        LineCollection(list(centre + ends[..., None] * direction[:, :1]), colors=colour, linewidths=0.7, alpha=0.28)
    )
    panel.add_collection(LineCollection(list(path), colors=colour, linewidths=1.3, alpha=0.75))
    for i, size in ((1, 9), (2, 4)):
        panel.scatter(*path[:, i].T, s=size, facecolor=panel.get_facecolor(), edgecolor=colour, linewidth=0.9, zorder=3)


def _draw_points(panel: Any, points: FloatArray, kinds: NDArray[Any], colours: dict[str, str], large: bool, segments: bool) -> None:
    from matplotlib.collections import LineCollection

    size = float(np.clip(4000 / max(1, len(points)), 3, 22)) * (1.0 if large else 0.5)
    for kind in ("unlabelled", "outlier", "static", "moving"):  # what matters most on top
        mine = points[kinds == kind]
        if not len(mine):
            continue
        if segments:
            look: Any = (0, (1, 1.5)) if kind == "outlier" else "solid"
            panel.add_collection(
                LineCollection(list(mine), colors=colours[kind], linewidths=1.4 if large else 1.0, linestyles=look, zorder=4)
            )
            panel.scatter(*mine.reshape(-1, 2).T, s=size / 3, color=colours[kind], linewidth=0, zorder=4)
        else:
            line = {"linewidth": 1.1} if kind == "outlier" else {"linewidth": 0}
            panel.scatter(*mine.T, s=size, c=colours[kind], marker=MARKS.get(kind, "o"), zorder=4, **line)


def _finish(panel: Any, box: Box, turned: bool, theme: Theme) -> None:
    panel.set(xlim=box[:2], ylim=box[2:][::-1] if turned else box[2:])
    panel.set_aspect("equal", adjustable="box", anchor="N")
    panel.tick_params(length=2.5, labelsize=7.5)
    panel.locator_params(nbins=6)
    panel.ticklabel_format(useOffset=False)
    for side in panel.spines.values():
        side.set_linewidth(0.8)


def _legend(figure: Any, kinds: NDArray[Any], colours: dict[str, str], theme: Theme, segments: bool) -> None:
    from matplotlib.lines import Line2D

    handles = []
    for kind in ("static", "moving", "outlier", "unlabelled"):
        number = int((kinds == kind).sum())
        if number:
            mark = None if segments else MARKS.get(kind, "o")
            look: Any = ("solid" if kind != "outlier" else "dotted") if segments else ""
            handles.append(
                Line2D(
                    [],
                    [],
                    color=colours[kind],
                    marker=mark,
                    linestyle=look,
                    markersize=5,
                    label=f"{number:,} {kind}{'s' * (kind == 'outlier' and number > 1)}",
                )
            )
    figure.legend(
        handles=handles,
        loc="upper center",
        bbox_to_anchor=(0.5, 0.25 / figure.get_figheight()),
        ncols=4,
        frameon=False,
        labelcolor=theme.ink,
    )


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
