"""The picture of a segmentation: both images, the matches coloured by their body, and how they moved."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from indexing.report.canvas import Theme, new_figure, png, shorten, style
from indexing.report.reconstruction_look import finish, foot, layout, limits, sample

if TYPE_CHECKING:
    from indexing.readers.images import Photograph
    from indexing.report.segmentation import SegmentationReport

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
