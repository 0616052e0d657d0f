"""The picture of the scene: a plan of a plane, or space from two sides, with the way of every point from first to last view."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from indexing.report.canvas import Theme, new_figure, png, style
from indexing.report.reconstruction_look import SHOWN, WIDTH, around, colour_of, finish, kinds_of, layout, legend, sample, size_of

if TYPE_CHECKING:
    from indexing.report.reconstruction import ReconstructionReport

FloatArray = NDArray[np.float64]
Box = tuple[FloatArray, FloatArray]
TALL = 6.2  # inches, the greatest height of a plan
STRAYS = 0.99  # of the positions, those that a panel shows
SIDES = ((90.0, -90.0, 1.6, "as the first camera looks"), (24.0, -62.0, 1.2, "from the side"))  # elevation, azimuth, zoom, name


def scene_picture(report: ReconstructionReport, theme: Theme) -> bytes:
    """PNG of the scene in the frame nearest to the first view: the tracks fix it only up to an affinity or less."""
    kinds = kinds_of(report)
    positions = nearest_frame(report)
    with style(theme):
        draw = _plan if positions.shape[-1] == 2 else _space
        figure = draw(report, positions, kinds, theme)
        legend(figure, kinds, theme)
        return png(figure, tight=True)


def nearest_frame(report: ReconstructionReport) -> FloatArray:
    """Positions ``(views, n, d)`` carried by the affinity that brings the first ones nearest to their images in the first view.

    Of space, the depth is what is left: scaled to the spread across, along the direction that says least about the image.
    """
    image = report.tracks.values[0, :, :2]
    fits = np.isfinite(image).all(axis=1) & report.found & (report.labels > 0)
    dim = report.points.shape[1]
    if fits.sum() < dim + 1:
        return report.positions
    start = report.positions[0, fits]
    middle, aim = start.mean(axis=0), image[fits].mean(axis=0)
    across = np.linalg.lstsq(start - middle, image[fits] - aim, rcond=None)[0]  # (d, 2)
    if dim == 2:
        return np.asarray((report.positions - middle) @ across + aim)
    # the coordinate of the points that is uncorrelated with those two
    spread = np.cov((start - middle).T)
    depth = np.linalg.svd((spread @ across).T)[2][-1]
    shown = (report.positions - middle) @ np.column_stack([across, depth])
    size = shown[0, fits].std(axis=0)
    shown[..., 2] *= size[:2].mean() / max(size[2], 1e-12)
    if _depth_order(report, fits, shown[0, fits, 2]) < 0:
        shown[..., 2] *= -1
    out: FloatArray = shown * np.array([1.0, -1.0, -1.0])  # y of images points down, and depth away
    return out


def _depth_order(report: ReconstructionReport, fits: NDArray[np.bool_], depth: FloatArray) -> float:
    """Whether a coordinate grows with the depth in the first view; no telling up to a collineation, but nearly always right."""
    camera = report.cameras[0]
    w = report.points[fits] @ camera[-1, :-1] + camera[-1, -1]
    return float(np.nan_to_num(np.sign(w.mean()) * np.cov(w, depth)[0, 1]))


def _plan(report: ReconstructionReport, positions: FloatArray, kinds: NDArray[Any], theme: Theme) -> Any:
    """The plane, with an arrow from the first to the last view for every moving point."""
    halves = ["body 1", "body 2"] if report.bodies > 1 else [""]
    shown = [positions[:, kinds == half] if half else positions[:, np.isin(kinds, ("static", "moving"))] for half in halves]
    boxes = [around(points, STRAYS) for points in shown]
    figure, panels = layout(boxes, TALL, 0.1, 0.5)
    for panel, half, box in zip(panels, halves, boxes, strict=True):
        reach = float(np.max(box[1] - box[0]))
        for kind in ("outlier", "static", "moving", "body 1", "body 2"):
            mine = positions[:, (kinds == kind) & np.isin(kind, [half or kind])][:, :SHOWN]
            _arrows(panel, mine, kind, reach, size_of(positions.shape[1]), theme, box)
        finish(panel, *box, True, half or "the plane, in a frame of its own" + _sampled(positions, kinds, box))
        panel.set(xticks=[], yticks=[])
    return figure


def _sampled(positions: FloatArray, kinds: NDArray[Any], box: Box) -> str:
    """That only some ways are drawn, where that is so."""
    moving = positions[:, kinds == "moving"]
    drawn = len(sample(moving, box))
    return f"; the ways of {drawn} of {moving.shape[1]:,}" if drawn < moving.shape[1] else ""


def _arrows(panel: Any, points: FloatArray, kind: str, reach: float, size: float, theme: Theme, box: Box) -> None:
    """Where points ``(views, n, 2)`` begin, their ways, and the heads of those long enough to have one."""
    from matplotlib.collections import LineCollection

    if not points.shape[1] or kind == "outlier":
        return
    colour = colour_of(kind, theme)
    panel.scatter(*points[0].T, s=size, c=colour, linewidth=0, zorder=3)
    if kind != "moving":
        return
    points = points[:, sample(points, box)]
    ends = points[[0, -1]]
    step = ends[1] - ends[0]
    length = np.linalg.norm(step, axis=-1)
    panel.add_collection(LineCollection(list(points.transpose(1, 0, 2)), colors=colour, linewidths=1.2, alpha=0.75, zorder=2))
    head = np.minimum(0.35 * length, 0.016 * reach)
    long = length > 0.006 * reach
    last = points[-1] - points[-2]
    with np.errstate(invalid="ignore", divide="ignore"):
        along = last / np.linalg.norm(last, axis=-1, keepdims=True)
    across = np.stack([-along[:, 1], along[:, 0]], axis=-1)
    back = ends[1] - head[:, None] * along
    wings = np.stack([back + 0.45 * head[:, None] * across, ends[1], back - 0.45 * head[:, None] * across], axis=1)
    panel.add_collection(LineCollection(list(wings[long]), colors=colour, linewidths=1.2, zorder=2))


def _space(report: ReconstructionReport, positions: FloatArray, kinds: NDArray[Any], theme: Theme) -> Any:
    """Space, as the first camera looks and from the side; of two bodies, each for itself."""
    from mpl_toolkits.mplot3d.art3d import Line3DCollection

    halves = ["body 1", "body 2"] if report.bodies > 1 else ["", ""]
    wide = WIDTH / 2
    figure = new_figure(WIDTH, 4.9)
    for i, (half, side) in enumerate(zip(halves, SIDES, strict=True)):
        elevation, azimuth, zoom, name = SIDES[1] if half else side
        panel = figure.add_axes((i * wide / WIDTH, 0.07, wide / WIDTH, 0.86), projection="3d", proj_type="ortho")
        shown = positions[:, kinds == half] if half else positions[:, np.isin(kinds, ("static", "moving"))]
        low, high = box = around(shown, STRAYS)
        for kind in ("static", "moving", "body 1", "body 2"):
            mine = positions[:, (kinds == kind) & np.isin(kind, [half or kind])][:, :SHOWN]
            if not mine.shape[1]:
                continue
            colour = colour_of(kind, theme)
            panel.scatter(*mine[0].T, s=size_of(positions.shape[1]), c=colour, linewidth=0, depthshade=not half)
            if kind == "moving":
                mine = mine[:, sample(mine, box)]
                panel.add_collection3d(Line3DCollection(list(mine.transpose(1, 0, 2)), colors=colour, linewidths=1.0, alpha=0.75))
        middle, reach = (low + high) / 2, float((high - low).max()) / 2
        panel.set(**{f"{axis}lim": (middle[j] - reach, middle[j] + reach) for j, axis in enumerate("xyz")})
        panel.set(xticklabels=[], yticklabels=[], zticklabels=[])
        panel.set_box_aspect((1, 1, 1), zoom=zoom)
        for axis in (panel.xaxis, panel.yaxis, panel.zaxis):
            axis.set_pane_color(theme.paper)
            axis._axinfo["grid"].update(color=theme.line, linewidth=0.5)
        panel.view_init(elev=elevation, azim=azimuth)
        panel.set_title(half or name + _sampled(positions, kinds, box), fontsize=9, loc="left", y=1.0)
    return figure
