"""What the pictures of a reconstruction share: colours, how much of the data is shown, and the legend."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from indexing.report.canvas import LIGHT, Theme, draw_photograph, new_figure, png, shorten, style

if TYPE_CHECKING:
    from indexing.report.reconstruction import ReconstructionReport

FloatArray = NDArray[np.float64]
# apart for colour-blind eyes, too, on both papers; outliers are crosses besides
COLOURS = {"static": "#2f7fb8", "moving": "#e8741e", "body 1": "#2f7fb8", "body 2": "#e8741e", "outlier": "#8b949c"}
WIDTH, FOOT, TITLE, TICKS = 10.2, 0.4, 0.3, 0.25  # inches
SHOWN = 1500  # tracks drawn; more are a blot
TANGLE, LONG = 60, 0.06  # paths drawn where half of them are longer than this share of the picture
ROOM = 0.06  # around the points, of their extent


def kinds_of(report: ReconstructionReport) -> NDArray[Any]:
    """What every track is drawn as: its kind, or ``unlabelled`` where no scene was decided on."""
    return np.array(report.kinds) if report.drawable else np.full(len(report.tracks.ids), "unlabelled")


def layout(boxes: list[tuple[FloatArray, FloatArray]], tall: float, edge: float, gap: float) -> tuple[Any, list[Any]]:
    """A figure of panels side by side, as wide as they need to be, and the panels."""
    wide = (WIDTH - edge - gap * (len(boxes) - 1)) / len(boxes)
    ratios = [float(np.clip((high - low)[1] / (high - low)[0], 0.05, 20)) for low, high in boxes]
    sizes = [(min(wide, tall / ratio), min(tall, wide * ratio)) for ratio in ratios]
    width = edge + sum(size for size, _ in sizes) + gap * (len(boxes) - 1)
    highest = max(size for _, size in sizes)
    height = TITLE + highest + TICKS + FOOT
    figure, left, panels = new_figure(width, height), edge, []
    for across, down in sizes:
        panels.append(figure.add_axes((left / width, 1 - (TITLE + down) / height, across / width, down / height)))
        left += across + gap
    return figure, panels


def colour_of(kind: str) -> str:
    """The colour of a kind."""
    return COLOURS.get(kind, LIGHT.muted)


def size_of(count: int) -> float:
    """Area of a mark, smaller where there are many."""
    return float(np.clip(2500 / max(1, count), 4, 22))


def limits(points: FloatArray, share: float = 1.0) -> tuple[FloatArray, FloatArray]:
    """Low and high ``(d,)`` around the points ``(..., d)``, but for a share of strays, with room around."""
    flat = points.reshape(-1, points.shape[-1])
    flat = flat[np.isfinite(flat).all(axis=1)]
    if not len(flat):
        return np.zeros(points.shape[-1]), np.ones(points.shape[-1])
    low, high = np.percentile(flat, 100 * (1 - share), axis=0), np.percentile(flat, 100 * share, axis=0)
    room = max(ROOM * float((high - low).max()), 1e-3 * float(np.abs(flat).max()), 1e-6)
    return low - room, high + room


def around(paths: FloatArray, share: float) -> tuple[FloatArray, FloatArray]:
    """Low and high ``(d,)`` around whole paths ``(views, n, d)``, from dot to arrow head, but for those that stray far away."""
    low, high = limits(paths, share)
    with np.errstate(invalid="ignore"):
        near = ((paths > low - (high - low)) & (paths < high + (high - low))).all(axis=(0, 2))
    return limits(paths[:, near]) if near.any() else (low, high)


def sample(paths: FloatArray, box: tuple[FloatArray, FloatArray]) -> NDArray[np.intp]:
    """Of paths ``(views, n, d)`` those to be drawn: all, or where long ones would tangle, every so many."""
    count = paths.shape[1]
    if count <= TANGLE:
        return np.arange(count)
    ways = np.linalg.norm(paths[-1] - paths[0], axis=-1)
    long = float(np.nanmedian(ways)) > LONG * float((box[1] - box[0]).max()) if np.isfinite(ways).any() else False
    return np.linspace(0, count - 1, TANGLE).round().astype(np.intp) if long else np.arange(min(count, SHOWN))


def legend(figure: Any, kinds: NDArray[Any], ink: str = LIGHT.ink) -> None:
    """How many tracks of every kind, at the foot of the figure."""
    from matplotlib.lines import Line2D

    handles = []
    for kind in (*COLOURS, "unlabelled"):
        number = int((kinds == kind).sum())
        if number:
            name = f"{number:,} {kind}{'s' * (kind == 'outlier' and number > 1)}" if " " not in kind else f"{kind}: {number:,}"
            mark = "x" if kind == "outlier" else "o"
            handles.append(Line2D([], [], color=colour_of(kind), marker=mark, linestyle="", markersize=5, label=name))
    foot(figure, handles, ink=ink)


def foot(figure: Any, handles: list[Any], columns: int = 4, ink: str = LIGHT.ink) -> None:
    """The legend at the foot of the figure."""
    anchor = (0.5, 0.28 / figure.get_figheight())
    figure.legend(handles=handles, loc="upper center", bbox_to_anchor=anchor, ncols=columns, frameon=False, labelcolor=ink)


def finish(panel: Any, low: FloatArray, high: FloatArray, down: bool, title: str) -> None:
    """Limits, equal axes and a title."""
    panel.set(xlim=(low[0], high[0]), ylim=(high[1], low[1]) if down else (low[1], high[1]))
    panel.set_aspect("equal", adjustable="box", anchor="N")
    panel.tick_params(length=2.5, labelsize=7.5)
    panel.locator_params(nbins=6)
    panel.ticklabel_format(useOffset=False)
    panel.set_title(title, fontsize=9, loc="left", parse_math=False)
    for side in panel.spines.values():
        side.set_linewidth(0.8)


# ----------------------------------------------------------------------------------------------------------------------
# The picture of the scene: a plan of a plane, or space from two sides, with the way of every point from first to last view.


Box = tuple[FloatArray, FloatArray]
TALL = 6.2  # inches, the greatest height of a plan
STRAYS = 0.99  # of the positions, those that a panel shows
SIDES = ((90.0, -90.0, 1.6, "as the first camera looks"), (24.0, -62.0, 1.2, "from the side"))  # elevation, azimuth, zoom, name


def scene_picture(report: ReconstructionReport) -> bytes:
    """PNG of the scene in the frame nearest to the first view: the tracks fix it only up to an affinity or less."""
    kinds = kinds_of(report)
    positions = nearest_frame(report)
    with style():
        draw = _plan if positions.shape[-1] == 2 else _space
        figure = draw(report, positions, kinds)
        legend(figure, kinds)
        return png(figure, tight=True)


def nearest_frame(report: ReconstructionReport) -> FloatArray:
    """Positions ``(views, n, d)`` carried by the affinity that brings the first ones nearest to their images in the first
    view."""
    image = report.tracks.values[0, :, :2]
    fits = np.isfinite(image).all(axis=1) & report.placed & (report.labels > 0)
    dim = report.found.points.shape[1]
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
    camera = report.found.cameras[0]
    w = report.found.points[fits] @ camera[-1, :-1] + camera[-1, -1]
    return float(np.nan_to_num(np.sign(w.mean()) * np.cov(w, depth)[0, 1]))


def _plan(report: ReconstructionReport, positions: FloatArray, kinds: NDArray[Any]) -> Any:
    """The plane, with an arrow from the first to the last view for every moving point."""
    halves = ["body 1", "body 2"] if report.bodies > 1 else [""]
    shown = [positions[:, kinds == half] if half else positions[:, np.isin(kinds, ("static", "moving"))] for half in halves]
    boxes = [around(points, STRAYS) for points in shown]
    figure, panels = layout(boxes, TALL, 0.1, 0.5)
    for panel, half, box in zip(panels, halves, boxes, strict=True):
        reach = float(np.max(box[1] - box[0]))
        for kind in ("outlier", "static", "moving", "body 1", "body 2"):
            mine = positions[:, (kinds == kind) & np.isin(kind, [half or kind])][:, :SHOWN]
            _arrows(panel, mine, kind, reach, size_of(positions.shape[1]), box)
        finish(panel, *box, True, half or "the plane, in a frame of its own" + _sampled(positions, kinds, box))
        panel.set(xticks=[], yticks=[])
    return figure


def _sampled(positions: FloatArray, kinds: NDArray[Any], box: Box) -> str:
    """That only some ways are drawn, where that is so."""
    moving = positions[:, kinds == "moving"]
    drawn = len(sample(moving, box))
    return f"; the ways of {drawn} of {moving.shape[1]:,}" if drawn < moving.shape[1] else ""


def _arrows(panel: Any, points: FloatArray, kind: str, reach: float, size: float, box: Box) -> None:
    """Where points ``(views, n, 2)`` begin, their ways, and the heads of those long enough to have one."""
    from matplotlib.collections import LineCollection

    if not points.shape[1] or kind == "outlier":
        return
    colour = colour_of(kind)
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


def _space(report: ReconstructionReport, positions: FloatArray, kinds: NDArray[Any]) -> Any:
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
            colour = colour_of(kind)
            panel.scatter(*mine[0].T, s=size_of(positions.shape[1]), c=colour, linewidth=0, depthshade=not half)
            if kind == "moving":
                mine = mine[:, sample(mine, box)]
                panel.add_collection3d(Line3DCollection(list(mine.transpose(1, 0, 2)), colors=colour, linewidths=1.0, alpha=0.75))
        middle, reach = (low + high) / 2, float((high - low).max()) / 2
        panel.set(**{f"{axis}lim": (middle[j] - reach, middle[j] + reach) for j, axis in enumerate("xyz")})
        panel.set(xticklabels=[], yticklabels=[], zticklabels=[])
        panel.set_box_aspect((1, 1, 1), zoom=zoom)
        for axis in (panel.xaxis, panel.yaxis, panel.zaxis):
            axis.set_pane_color(LIGHT.paper)
            axis._axinfo["grid"].update(color=LIGHT.line, linewidth=0.5)
        panel.view_init(elev=elevation, azim=azimuth)
        panel.set_title(half or name + _sampled(positions, kinds, box), fontsize=9, loc="left", y=1.0)
    return figure


# ----------------------------------------------------------------------------------------------------------------------
# The picture of the tracks: as they were measured, and as the first camera would have seen them had it stood still.


GAP, LEFT, TRACKS_TALL = 0.55, 0.45, 5.2  # inches; the last is the greatest height of a panel
TRACKS_STRAYS = 0.995  # of the positions, those that a panel shows


def tracks_picture(report: ReconstructionReport, theme: Theme = LIGHT) -> bytes:
    """PNG: the tracks through all views in the first one; beside them the same without the motion of the camera."""
    kinds = kinds_of(report)
    measured = report.tracks.values[..., shown_axes(report.tracks.values)]
    still = as_first_camera(report)
    panels: list[tuple[FloatArray, str]] = [
        (measured, f"as tracked, from {_named(report.tracks.views[0], report.tracks.by_time)} on")
    ]
    if still is not None:
        panels.append((still[..., shown_axes(report.tracks.values)], "as the first camera would see it, standing still"))
    kept = [points[:, kinds != "missing"] for points, _ in panels]
    boxes = [limits(points, TRACKS_STRAYS) for points in kept]
    if report.photograph is not None:
        boxes[0] = np.array([-0.5, -0.5]), np.array(report.photograph.size) - 0.5
    down = report.tracks.values.shape[-1] == 2
    with style(theme):
        figure, places = layout(boxes, TRACKS_TALL, LEFT, GAP)
        for panel, (points, title), box in zip(places, panels, boxes, strict=True):
            if report.photograph is not None and panel is places[0]:
                draw_photograph(panel, report.photograph, theme)
            _draw(panel, points, kinds)
            finish(panel, *box, down, title)
        legend(figure, kinds, theme.ink)
        return png(figure, tight=True)


def _named(view: str, by_time: bool) -> str:
    return f"{'time' if by_time else 'frame'} {view}" if view.lstrip("-").replace(".", "", 1).isdigit() else shorten(view, 40)


def shown_axes(values: FloatArray) -> list[int]:
    """The two coordinates in which the first view extends most."""
    if values.shape[-1] == 2:
        return [0, 1]
    first = values[0]
    seen = first[np.isfinite(first).all(axis=1)]
    spread = np.ptp(seen, axis=0) if len(seen) else np.ones(3)
    return sorted(np.argsort(-spread, kind="stable")[:2].tolist())


def as_first_camera(report: ReconstructionReport) -> FloatArray | None:
    """Where the first camera would have seen the points at the times of all views, ``(views, n, l)``; None for two bodies, or
    where no scene was decided on."""
    if not report.drawable or report.velocities is None:
        return None
    camera = report.found.cameras[0]
    rays = report.positions @ camera[:, :-1].T + camera[:, -1]
    with np.errstate(divide="ignore", invalid="ignore"):
        seen: FloatArray = rays[..., :-1] / rays[..., -1:]
    # past infinity: behind the camera
    return np.where(rays[..., -1:] * rays[:1, :, -1:] > 0, seen, np.nan)


def _draw(panel: Any, points: FloatArray, kinds: NDArray[Any]) -> None:
    """Paths ``(views, n, 2)`` with a dot where they begin."""
    from matplotlib.collections import LineCollection

    size = size_of(points.shape[1])
    for kind in ("unlabelled", "outlier", "static", "moving", "body 1", "body 2"):  # what matters most on top
        mine = points[:, kinds == kind][:, :SHOWN]
        if not mine.shape[1]:
            continue
        colour = colour_of(kind)
        paths = [path[np.isfinite(path).all(axis=1)] for path in mine.transpose(1, 0, 2)]
        paths = [path for path in paths if len(path)]
        quiet = 0.35 if kind == "outlier" else 0.7
        panel.add_collection(LineCollection([path for path in paths if len(path) > 1], colors=colour, linewidths=1.0, alpha=quiet))
        starts = np.array([path[0] for path in paths]).reshape(-1, 2)
        mark = {"marker": "x", "linewidth": 1.1} if kind == "outlier" else {"marker": "o", "linewidth": 0}
        panel.scatter(*starts.T, s=size, c=colour, zorder=3, **mark)
