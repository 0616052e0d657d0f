"""The picture of an alignment: view 1 with the paths of what moves, and the other views, coloured alike."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from indexing.report.canvas import Theme, new_figure, png, shorten, style

if TYPE_CHECKING:
    from indexing.report.alignment import AlignmentReport

FloatArray = NDArray[np.float64]
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
