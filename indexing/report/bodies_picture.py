"""The picture of bodies through many frames: some of the frames, the points in the colours of their bodies, and their tails."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from indexing.report.canvas import LIGHT, Theme, draw_photograph, new_figure, png, shorten, style
from indexing.report.labelled import colour_of
from indexing.report.reconstruction_picture import finish, foot, limits
from indexing.report.segmentation import STRAYS, mark_of
from indexing.video.scene import evenly_spaced

if TYPE_CHECKING:
    from indexing.report.bodies import BodiesReport

FloatArray = NDArray[np.float64]
Box = tuple[FloatArray, FloatArray]
PANELS = 4  # frames that are shown
WIDTH, TALL, EDGE, GAP, HEAD, TICKS, FOOT = 10.2, 4.4, 0.45, 0.12, 0.3, 0.28, 0.5  # inches
WIDE = 0.22  # height over width below which pictures are drawn one above the other
NARROW = 1.3  # and from which they are all drawn side by side
TAIL = 0.12  # of all views: how far back tails lead
FRINGE = 3  # views before which tails are too short to be seen
DRAWN = 1500  # tracks of a body in a panel; more are a blot


def picture_of(report: BodiesReport, theme: Theme = LIGHT) -> bytes:
    """PNG: four frames from the first to the last, or those that there are photographs of."""
    shown = sorted(report.photographs) or evenly_spaced(len(report.tracks.views), PANELS)
    box = _box(report)
    with style(theme):
        figure, panels = _grid(len(shown), box, bool(report.photographs))
        for panel, view in zip(panels, shown, strict=True):
            photograph = report.photographs.get(view)
            if photograph is not None:
                draw_photograph(panel, photograph, theme)
            _draw(panel, report, view, theme)
            finish(panel, *box, True, shorten(_named(report, view), 60))
            if photograph is not None:
                panel.set(xticks=[], yticks=[])
        foot(figure, _handles(report, theme), columns=6, ink=theme.ink)
        return png(figure, tight=True)


def _named(report: BodiesReport, view: int) -> str:
    name, times = report.tracks.views[view], report.tracks.times
    if report.tracks.by_time:
        return f"{name} s"
    moment = "" if times is None else f", {times[view]:.2f} s"
    return f"frame {name}{moment}" if name.lstrip("-").replace(".", "", 1).isdigit() else name


def _box(report: BodiesReport) -> Box:
    """What every panel shows: the picture where its size is known, otherwise all of the tracks."""
    size = next((photograph.size for photograph in report.photographs.values()), report.size)
    if size is not None:
        return np.array([-0.5, -0.5]), np.array(size) - 0.5
    return limits(report.tracks.values[..., :2], STRAYS)


def _grid(number: int, box: Box, bare: bool) -> tuple[Any, list[Any]]:
    """A figure of panels, two in a row, all where they are narrow, or one where they are wide."""
    edge, ticks = (0.0, 0.0) if bare else (EDGE, TICKS)
    ratio = float(np.clip((box[1] - box[0])[1] / (box[1] - box[0])[0], 0.05, 20))
    columns = min(number, PANELS if ratio > NARROW else 2 if ratio > WIDE else 1)
    wide = (WIDTH - edge - (columns - 1) * (GAP + edge)) / columns
    tall = wide * ratio
    if tall > TALL:
        wide, tall = wide * TALL / tall, TALL
    rows = -(-number // columns)
    width, height = edge + columns * wide + (columns - 1) * (GAP + edge), rows * (HEAD + tall + ticks) + FOOT
    figure, panels = new_figure(width, height), []
    for i in range(number):
        row, column = divmod(i, columns)
        left, top = edge + column * (wide + GAP + edge), row * (HEAD + tall + ticks) + HEAD + tall
        panels.append(figure.add_axes((left / width, 1 - top / height, wide / width, tall / height)))
    return figure, panels


def _draw(panel: Any, report: BodiesReport, view: int, theme: Theme) -> None:
    """Points of one frame, those of small bodies on top, and the way that they came."""
    from matplotlib.collections import LineCollection

    tail = max(FRINGE, round(TAIL * len(report.tracks.views)))
    part = report.tracks.values[max(0, view - tail) : view + 1, :, :2]
    here = np.isfinite(part[-1]).all(axis=-1) & report.present
    size = float(np.clip(3000 / max(1, int(here.sum())), 3, 16))
    strays = part[-1, here & (report.found.labels == 0)]
    panel.scatter(*strays.T, s=0.8 * size, c=theme.muted, marker="x", linewidth=0.8, alpha=0.65, zorder=2)
    for label in range(1, report.bodies + 1):
        mine = np.flatnonzero(here & (report.found.labels == label))
        mine = mine[np.linspace(0, len(mine) - 1, min(len(mine), DRAWN)).round().astype(int)]
        ways = [path[np.isfinite(path).all(axis=1)] for path in part[:, mine].transpose(1, 0, 2)]
        lines = LineCollection(ways, colors=colour_of(label), linewidths=0.8, alpha=0.55, zorder=2 + label)
        panel.add_collection(lines, autolim=False)
        look: Any = {"marker": mark_of(label), "edgecolor": theme.paper, "linewidth": 0.3}
        panel.scatter(*part[-1, mine].T, s=size, c=colour_of(label), zorder=2.5 + label, **look)


def _handles(report: BodiesReport, theme: Theme) -> list[Any]:
    """Entries of the legend: every body with its tracks, and the outliers."""
    from matplotlib.lines import Line2D

    counts, found = report.counts, []
    for label in range(1, report.bodies + 1):
        text = f"body {label}: {counts[f'body {label}']:,}" + " (static)" * (label == report.static)
        found.append(Line2D([], [], color=colour_of(label), marker=mark_of(label), linestyle="", markersize=5.5, label=text))
    if counts["outlier"]:
        noun = "outlier" if report.bodies else "unlabelled"
        text = f"{counts['outlier']:,} {noun}{'s' * (report.bodies > 0 and counts['outlier'] > 1)}"
        found.append(Line2D([], [], color=theme.muted, marker="x", linestyle="", markersize=5, label=text))
    return found
