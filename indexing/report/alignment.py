"""The report on an alignment: what moved, what stood still, how the sensor moved, and how far that can be trusted."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from string import ascii_uppercase
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dyntorch.numerics import with_words
from indexing.readers.matches import Matched, Photograph
from indexing.report.canvas import (
    LIGHT,
    Theme,
    draw_photograph,
    finish,
    legend,
    limits,
    new_figure,
    png,
    shorten,
    style,
    widest_axes,
)
from indexing.report.page import ResultReport, markup, safe_cell, sentence, table_csv
from indexing.report.summary import Summary, Table, register_page, warning_lines

FloatArray = NDArray[np.float64]
FILES = ("report.html", "alignment.json", "labels.csv", "alignment.png", "tracks.csv")  # the last one of videos
LABELS = ("outlier", "static", "moving")
ROUNDING = 1e-14  # of the largest entry: what arithmetic leaves of a deviation that is zero (measured: 3e-17)
PURPOSE = {
    "planar": "Points of a plane stand still or move on straight lines before a moving camera.",
    "join": "Points stand still or move on straight lines before an uncalibrated 3D sensor.",
    "minimal_join": "Points stand still or move on straight lines before an uncalibrated 3D sensor.",
    "constant_velocity": "Points move at constant velocity before an uncalibrated 3D sensor.",
    "affine_constant_velocity": "Points move at constant velocity before a 3D sensor that is known up to an affinity.",
    "rigid": "Points stand still or move on straight lines before a 3D sensor that moves rigidly.",
    "lines": "Lines stand still or stay in a plane while they move, before a 3D sensor.",
}


@dataclass(frozen=True, eq=False, kw_only=True)
class AlignmentReport(ResultReport):
    """Everything that the report on an alignment says."""

    read: Matched
    model: str
    threshold: float | None = None
    photographs: Sequence[Photograph] = ()

    TITLES = ("What moved, and how the sensor did", "The matches do not decide")

    @functools.cached_property
    def views(self) -> list[FloatArray]:
        """``(n, d)`` points or ``(n, 2, 3)`` lines of each view, NaN = missing."""
        return [as_segments(view) if view.shape[1:] == (6,) else view for view in self.read.views]

    @property
    def segments(self) -> bool:
        """Whether the matches are lines."""
        return self.views[0].ndim == 3

    @property
    def ids(self) -> tuple[str, ...]:
        """Names of the matches."""
        return self.read.ids

    @property
    def names(self) -> list[str]:
        """Names of the views."""
        return [Path(name).name for name in self.read.names]

    @functools.cached_property
    def motion(self) -> list[FloatArray]:
        """A, B (with three views) and so on, from view 2, 3, ... to view 1."""
        return [part for part in (self.arrays.A, self.arrays.B, *map(np.asarray, self.arrays.others)) if part is not None]

    @property
    def sigma(self) -> float:
        """Noise of one coordinate, in the unit of the views."""
        return float(self.arrays.sigma)

    @property
    def ambiguity(self) -> str:
        """What the data cannot tell, even without noise."""
        return with_words(self.result.ambiguity, self.words)

    @property
    def has_motion(self) -> bool:
        """Whether there is a motion at all, good or doubtful."""
        return all(np.isfinite(part).all() and np.abs(part).max() > 0 for part in self.motion)

    @property
    def has_unverified(self) -> bool:
        """Whether there are matches that stand still between two of the views only."""
        return bool(np.any(self.arrays.unverified))

    @property
    def missing(self) -> NDArray[np.bool_]:
        """``(n,)`` matches that are missing in a view."""
        return np.any([np.isnan(view.reshape(len(view), -1)).any(axis=1) for view in self.views], axis=0)

    @functools.cached_property
    def kinds(self) -> list[str]:
        """What each match is: outlier, static, moving or missing."""
        labels = self.arrays.labels.tolist()
        return ["missing" if gone else LABELS[label] for label, gone in zip(labels, self.missing.tolist(), strict=True)]

    @property
    def counts(self) -> dict[str, int]:
        """How many matches of each kind."""
        return {name: self.kinds.count(name) for name in ("static", "moving", "outlier", "missing")}

    @functools.cached_property
    def motion_rows(self) -> list[tuple[str, int, list[list[Any]], bool]]:
        """Of each motion: its name, the view that it leads from, its rows with deviations, and whether its last entry is 1."""
        out, start = [], 0
        for view, (name, matrix) in enumerate(zip(ascii_uppercase, self.motion if self.has_motion else (), strict=False), start=2):
            block = slice(start, start := start + matrix.size)
            values, spreads, scaled = display_scale(matrix, self.arrays.covariance[block, block])
            rows = [
                [f"{name}, row {i}", *(figures(float(v), float(s)) for v, s in zip(*row, strict=True))]
                for i, row in enumerate(zip(values, spreads, strict=True), start=1)
            ]
            out.append((name, view, rows, scaled))
        return out

    @property
    def poses(self) -> list[tuple[int, float, list[float]]]:
        """Of calibrated cameras: view, turn in degrees against view 1, and shift in distances of the plane; empty without."""
        found = self.arrays
        if found.rotations is None or not self.has_motion:
            return []
        pairs = enumerate(zip(found.rotations, found.translations, strict=True), start=1)
        return [(view, turn_of(turn), shift.tolist()) for view, (turn, shift) in pairs if view > 1]


def describe(report: AlignmentReport) -> str:
    """The result in plain words."""
    number, counts = len(report.ids), report.counts
    what = "lines" if report.segments else "points"
    if report.status != "OK":
        start = f"The {number:,} {what} do not decide how the sensor moved."
        return f"{start} {sentence(report.reason)}" + (
            " What follows is the best motion found, and not to be relied on." * report.has_motion
        )
    parts = [f"{counts['static']:,} stand still and {counts['moving']:,} move"]
    if counts["outlier"]:
        parts.append(f"{counts['outlier']:,} fit neither")
    if counts["missing"]:
        parts.append(f"{counts['missing']:,} are missing in a view")
    return f"Of {number:,} {what} in {len(report.views)} views, {'; '.join(parts)}. {PURPOSE[report.model]}"


@register_page(AlignmentReport, "alignment", FILES)
def summarize(report: AlignmentReport) -> Summary:
    """Everything that is said of an alignment."""
    known, poses = report.has_motion, report.poses
    row: list[object] = [len(report.ids), *(n if known or name == "missing" else "" for name, n in report.counts.items())]
    row += [f"{report.sigma:.3g}" if known else "", report.state]
    tables = [Table(["matches ", "static ", "moving ", "outliers ", "missing ", "noise ", "status"], [row])]
    for name, view, rows, scaled in report.motion_rows:
        heading = f"{name}: view {view} to view 1" + ("" if scaled else ", norm 1")
        cells = [[f"row {i}", *(" ± ".join(filter(None, cell)) for cell in row[1:])] for i, row in enumerate(rows, start=1)]
        tables.append(Table([heading, *(f"column {j} " for j in range(1, len(cells[0])))], cells))
    if poses:
        cells = [[f"view {v}", f"{turn:.4g}°", *(f"{x:.4g}" for x in shift)] for v, turn, shift in poses]
        normal = ", ".join(f"{x:.4g}" for x in report.arrays.normal)
        plane = f"plane: normal ({normal}) before view 1; shifts in units of its distance"
        tables.append(Table(["camera against view 1", "turn ", "x ", "y ", "z "], cells, [plane]))
    return Summary(
        headline=describe(report), tables=tables, notes=warning_lines(report),
        closing=[f"open: {report.ambiguity}"] if known and report.ambiguity else [],
        pictures={"alignment.png": partial(picture_of, report)}, dark=bool(report.photographs),
        files={"labels.csv": partial(labels_csv, report), "alignment.json": partial(as_json, report), "tracks.csv": None},
        values=partial(page_values, report),
    )  # fmt: skip


def page_values(report: AlignmentReport) -> dict[str, Any]:
    """The page's tables of motions, and of rigid ones turns and shifts."""
    turns = []
    if report.model == "rigid":
        turns = [(angle, shift, float(np.linalg.norm(shift))) for angle, shift in map(turn_and_shift, report.motion)]
    motions = [(name, view, [[row[0], *map(_cell, row[1:])] for row in rows], one) for name, view, rows, one in report.motion_rows]
    return {"motions": motions, "turns": turns}


def _cell(number: tuple[str, str]) -> Any:
    value, spread = number
    return markup('{value} <small class="none">± {spread}</small>', value=value, spread=spread) if spread else value


def as_json(report: AlignmentReport) -> dict[str, Any]:
    """The result as numbers: motion, labels, noise, covariance, status, warnings, and how it came about."""
    known: dict[str, Any] = {}
    if report.has_motion:
        spread = np.sqrt(np.clip(np.diagonal(report.arrays.covariance), 0, None))
        spreads = np.split(spread, np.cumsum([part.size for part in report.motion])[:-1])
        known = dict(zip(ascii_uppercase, report.motion, strict=False))
        known |= {
            f"{name}_deviation": part.reshape(known[name].shape) for name, part in zip(ascii_uppercase, spreads, strict=False)
        }
    unverified = report.arrays.unverified
    return {
        **report.outcome_json,
        "model": report.model,
        "views": report.names,
        "matches": len(report.ids),
        "counts": report.counts,
        "sigma": report.sigma,
        "threshold": report.threshold,
        **known,
        "covariance": report.arrays.covariance if report.has_motion else None,
        **_euclidean(report),
        "ambiguity": report.ambiguity,
        "ids": list(report.ids),
        "labels": report.arrays.labels,
        "velocities": report.arrays.velocities,
        "unverified": None if unverified is None else [report.ids[i] for i in np.flatnonzero(unverified)],
    }


def _euclidean(report: AlignmentReport) -> dict[str, Any]:
    """Rotations, translations and the normal of the plane, and the other ones that fit as well; nothing without a calibration."""
    found, names = report.arrays, ("rotations", "translations", "normal")
    if not report.poses:
        return {}
    other = {name: part.numpy() for name, part in zip(names, found.other_motion, strict=True)}
    return {**{name: getattr(found, name) for name in names}, "other_motion": other if other["normal"].any() else None}


def labels_csv(report: AlignmentReport) -> str:
    """``id,label,name`` of every match; 0 outlier or missing, 1 static, 2 moving."""
    rows = zip(map(safe_cell, report.ids), report.arrays.labels.tolist(), report.kinds, strict=True)
    return table_csv(["id", "label", "name"], list(rows))


# ----------------------------------------------------------------------------------------------------------------------
# Numbers as the page shows them.


def display_scale(matrix: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray, bool]:
    """A collineation scaled so that its last entry is 1 (where that is not near 0), with the standard deviations that follow."""
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
    return turn_of(motion[:3, :3]), motion[:3, 3]


def turn_of(rotation: FloatArray) -> float:
    """Angle of a rotation in degrees."""
    sine = 0.5 * np.linalg.norm([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
    return math.degrees(math.atan2(float(sine), float(np.trace(rotation) - 1) / 2))


def figures(value: float, spread: float) -> tuple[str, str]:
    """A number and its standard deviation, with as many decimals as the deviation supports (two figures of it); empty where it
    is zero or unknown."""
    if not (math.isfinite(spread) and spread > 0 and math.isfinite(value)):
        return f"{value:.6g}", ""
    places = 1 - math.floor(math.log10(spread))
    if places > 6:
        power = math.floor(math.log10(abs(value))) if value else 0
        return f"{value:.{min(15, max(1, places + power))}e}", f"{spread:.1e}"
    return f"{value:.{max(0, places)}f}", f"{spread:.{max(0, places)}f}"


# ----------------------------------------------------------------------------------------------------------------------
# The picture of an alignment: view 1 with the paths of what moves, and the other views, coloured alike.


Box = tuple[float, float, float, float]  # left, top, width, height
Limits = tuple[FloatArray, FloatArray]  # low, high
# apart for colour-blind eyes, too, on both papers; outliers are crosses besides
COLOURS = {"static": "#2f7fb8", "moving": "#e8741e", "outlier": "#8b949c"}
MARKS = {"static": "o", "moving": "o", "outlier": "x"}
PATHS = 1500  # paths drawn; more are a blot
REACH = 0.6  # how far beyond view 1 paths are shown, of its extent
WIDTH, MARGIN, GAP, TITLE, FOOT = 10.2, 0.65, 0.6, 0.3, 0.35  # inches
WIDE = 0.62  # height over width of view 1, below which it gets the whole width


def picture_of(report: AlignmentReport, theme: Theme = LIGHT) -> bytes:
    """PNG: view 1, large, with the path of every moving match carried over from the other views; beside it the other views."""
    kinds = np.array(report.kinds) if report.has_motion else np.where(report.missing, "missing", "unlabelled")
    colours = {**COLOURS, "unlabelled": theme.muted}
    segments = report.segments
    axes_shown, turned = widest_axes(report.views[0]), report.views[0].shape[-1] == 2
    # three views are drawn; the paths are those of all
    flat = [view[..., axes_shown] for view in report.views[:3]]
    boxes = [_box(points, kinds) for points in flat]
    if report.photographs:
        boxes = [(np.full(2, -0.5), np.array(photograph.size) - 0.5) for photograph in report.photographs]
    elif report.has_motion:
        boxes[0] = _widen_box(boxes[0], report, kinds, axes_shown)
    with style(theme):
        height, places = _layout([float((high - low)[1] / (high - low)[0]) for low, high in boxes])
        figure = new_figure(WIDTH, height)
        for number, (points, place, box) in enumerate(zip(flat, places, boxes, strict=True), start=1):
            left, top, width, tall = place
            panel = figure.add_axes((left / WIDTH, 1 - (top + tall) / height, width / WIDTH, tall / height))
            if report.photographs:
                draw_photograph(panel, report.photographs[number - 1], theme)
            if number == 1 and report.has_motion:
                _draw_paths(panel, report, kinds, axes_shown, box)
            _draw_points(panel, points, kinds, colours, large=number == 1, segments=segments)
            finish(panel, *box, turned, f"view {number}: {shorten(report.names[number - 1], 40)}")
            if number == 1:
                panel.set_xlabel("xyz"[axes_shown[0]])
                panel.set_ylabel("xyz"[axes_shown[1]])
        legend(figure, kinds, colours, theme.ink, lines=segments)
        return png(figure, tight=True)


def _layout(ratios: list[float]) -> tuple[float, list[Box]]:
    """Height of the figure, and left, top, width and height of every panel, in inches."""

    def fit_panel(left: float, top: float, width: float, ratio: float, limit: float) -> Box:
        tall = min(limit, max(0.6, width * ratio))
        return left, top, min(width, tall / ratio), tall

    room = WIDTH - MARGIN
    half = (room - GAP) / 2
    if len(ratios) == 2:
        found = [fit_panel(MARGIN + i * (half + GAP), TITLE, half, ratio, 5.5) for i, ratio in enumerate(ratios)]
    elif ratios[0] < WIDE:
        first = fit_panel(MARGIN, TITLE, room, ratios[0], 5.0)
        below = first[1] + first[3] + FOOT + TITLE
        found = [first, *(fit_panel(MARGIN + i * (half + GAP), below, half, ratio, 4.0) for i, ratio in enumerate(ratios[1:]))]
    else:
        large = 0.64 * (room - GAP)
        found = [fit_panel(MARGIN, TITLE, large, ratios[0], 6.5)]
        top = TITLE
        for ratio in ratios[1:]:
            found.append(fit_panel(MARGIN + large + GAP, top, room - GAP - large, ratio, 3.2))
            top = found[-1][1] + found[-1][3] + FOOT + TITLE
    return max(place[1] + place[3] for place in found) + FOOT + 0.4, found


def _box(points: FloatArray, kinds: NDArray[Any]) -> Limits:
    """Around the matches that fit; of all, where none does."""
    fitting = np.isin(kinds, ("static", "moving"))
    return limits(points[fitting if fitting.sum() > 1 else kinds != "missing"])


def _widen_box(box: Limits, report: AlignmentReport, kinds: NDArray[Any], shown: list[int]) -> Limits:
    """The box of view 1 with the paths of what moves in it, as far as they do not lead far away."""
    paths = [
        transform_points(matrix, view[kinds == "moving"])[..., shown].reshape(-1, 2)
        for view, matrix in zip(report.views[1:], report.motion, strict=True)
        if view.shape[-1] + 1 == matrix.shape[-1]
    ]
    low, high = box
    room = REACH * (high - low).max()
    places = np.concatenate([low[None], high[None], *paths])
    places = places[((places >= low - room) & (places <= high + room)).all(axis=1)]
    return places.min(axis=0), places.max(axis=0)


def as_segments(lines: FloatArray) -> FloatArray:
    """Two points ``(n, 2, 3)`` of lines in Pluecker coordinates ``(n, 6)`` (01, 02, 03, 12, 13, 23), around their common
    middle."""
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


def transform_points(matrix: FloatArray, points: FloatArray) -> FloatArray:
    """Points ``(..., d)`` moved by a collineation."""
    moved = points @ matrix[:-1, :-1].T + matrix[:-1, -1]
    last = points @ matrix[-1, :-1] + matrix[-1, -1]
    with np.errstate(divide="ignore", invalid="ignore"):
        out: FloatArray = moved / last[..., None]
    return out


def _draw_paths(panel: Any, report: AlignmentReport, kinds: NDArray[Any], shown: list[int], box: Limits) -> None:
    from matplotlib.collections import LineCollection

    colour = COLOURS["moving"]
    fits = [view.shape[-1] + 1 == matrix.shape[-1] for view, matrix in zip(report.views[1:], report.motion, strict=True)]
    if not all(fits):
        return
    moving = np.flatnonzero(kinds == "moving")[:PATHS]
    others = [transform_points(matrix, view[moving]) for view, matrix in zip(report.views[1:], report.motion, strict=True)]
    if report.segments:  # lines: where view 2 saw them, dashed
        panel.add_collection(
            LineCollection(list(others[0][..., shown]), colors=colour, linewidths=0.9, alpha=0.55, linestyles=(0, (3, 2)))
        )
        return
    path = np.stack([report.views[0][moving], *others], axis=1)[..., shown]
    size = float((box[1] - box[0]).max())
    near = np.isfinite(path).all(axis=(1, 2)) & (np.abs(path - path[:, :1]).max(axis=(1, 2), initial=0) < 2 * size)
    doubtful = np.zeros(len(path), dtype=bool) if report.arrays.unverified is None else report.arrays.unverified[moving]
    if (near & doubtful).any():
        look: Any = {"linewidths": 0.9, "alpha": 0.6, "linestyles": (0, (2, 2))}
        panel.add_collection(LineCollection(list(path[near & doubtful]), colors=colour, **look))
    path = path[near & ~doubtful]
    if not len(path):
        return
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
