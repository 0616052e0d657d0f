"""The report on a reconstruction: what moves and how, from where it was seen, and how far that can be trusted."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dyntorch.numerics import with_words
from dyntorch.tasks import MOTION_MODELS
from indexing.readers.matches import Photograph
from indexing.readers.tracks import TrackSet
from indexing.report.canvas import (
    LIGHT,
    MAX_PATHS,
    PAGE_WIDTH,
    Theme,
    around,
    draw_photograph,
    finish,
    layout,
    legend,
    limits,
    new_figure,
    png,
    sample,
    shorten,
    style,
    widest_axes,
)
from indexing.report.page import ResultReport, markup, matrix, npz, safe_cell, sentence, table_csv
from indexing.report.summary import Summary, Table, register_page, warning_lines

FloatArray = NDArray[np.float64]
# the last one of videos
FILES = ("report.html", "reconstruction.npz", "reconstruction.json", "points.csv", "tracks.png", "scene.png", "tracks.csv")
ROUNDING = 1e-12
LABELS = (("outlier", "static", "moving"), ("outlier", "body 1", "body 2"))
ARRAYS = ("cameras", "points", "residuals", "inliers", "structure", "projections")
PURPOSE = {model.name: model.purpose for model in MOTION_MODELS}


@dataclass(frozen=True, eq=False, kw_only=True)
class ReconstructionReport(ResultReport):
    """Everything that the report on a reconstruction says."""

    tracks: TrackSet
    threshold: float | None = None
    photograph: Photograph | None = None

    TITLES = ("What moves, and how", "The tracks do not decide")

    @property
    def motion(self) -> str:
        """Name of the model."""
        return str(self.result.motion.name)

    @property
    def bodies(self) -> int:
        """1, or 2 of which one is shifted against the other."""
        return int(self.result.motion.bodies)

    @functools.cached_property
    def labels(self) -> NDArray[np.int64]:
        """``(n,)`` 0 outlier or not found, 1 static, 2 moving; of two bodies 1 and 2."""
        labels = self.arrays.labels
        return np.asarray(labels.clip(max=1) if self.result.motion.static and self.bodies == 1 else labels)

    @functools.cached_property
    def velocities(self) -> FloatArray | None:
        """``(n, d)`` per unit of the times; None = the model has none."""
        return suppress_rounding(self.arrays.velocities, self.arrays.points, float(np.ptp(self.arrays.times)))

    @functools.cached_property
    def positions(self) -> FloatArray:
        """``(views, n, d)`` at the times of the views; of two bodies the points, each in the frame of its body."""
        return np.stack([self.result.at(float(moment)).numpy() for moment in self.arrays.times])

    @property
    def residual(self) -> float:
        """Rms reprojection error."""
        return float(self.arrays.residual)

    @property
    def sigma(self) -> float:
        """Noise of one coordinate."""
        return float(self.arrays.sigma)

    @property
    def poses(self) -> dict[str, Any]:
        """Whether the scene is metric, and rotations and translations of the cameras; nothing without a calibration."""
        found = self.result
        if found.metric is None:
            return {}
        return {
            "metric": bool(found.metric),
            "rotations": found.rotations.numpy(),
            "translations": found.translations.numpy(),
            "calibration": found.calibration.numpy(),
        }

    @property
    def ambiguity(self) -> str:
        """What the tracks cannot tell, even without noise."""
        return with_words(self.result.ambiguity, self.words)

    @property
    def single(self) -> int:
        """How many observations of points that fit do not."""
        given = np.isfinite(self.tracks.values).all(axis=-1)
        return int((given & ~self.arrays.inliers)[:, self.labels > 0].sum())

    @property
    def has_scene(self) -> bool:
        """Whether there is a scene at all, good or doubtful."""
        return bool(np.isfinite(self.arrays.cameras).all() and np.abs(self.arrays.cameras).max() > 0 and self.has_position.any())

    @property
    def drawable(self) -> bool:
        """Whether there is a scene worth a picture: of one that the data do not decide, it would only mislead."""
        return self.has_scene and self.status == "OK"

    @property
    def has_position(self) -> NDArray[np.bool_]:
        """``(n,)`` points with a position."""
        return np.asarray(np.isfinite(self.arrays.points).all(axis=1))

    @property
    def times(self) -> FloatArray:
        """``(views,)`` from 0."""
        given = self.tracks.times
        return np.arange(len(self.tracks.views), dtype=np.float64) if given is None else given

    @property
    def kinds(self) -> list[str]:
        """What each point is: outlier, static, moving (or body 1, body 2), or missing, where too few views show it."""
        names = np.array(LABELS[self.bodies > 1])
        kinds = np.where(self.has_position, names[self.labels], "outlier")
        given = np.isfinite(self.tracks.values).all(axis=2)
        seen = (given if self.tracks.weights is None else given & (self.tracks.weights > 0)).sum(axis=0)
        # no more coordinates than the unknowns of a point fit any camera, and so place none
        few = seen * self.tracks.values.shape[2] <= self.arrays.structure.shape[1] - 1
        return [str(kind) for kind in np.where(few & ~self.has_position, "missing", kinds)]

    @property
    def counts(self) -> dict[str, int]:
        """How many points of each kind."""
        kinds = self.kinds
        return {name: kinds.count(name) for name in (*LABELS[self.bodies > 1][1:], "outlier", "missing")}


def left_out(report: ReconstructionReport) -> str:
    """Which models were not tried and why, and which were without success; empty where all were compared."""
    untried = [f"{one.motion} ({one.reason})" for one in report.result.candidates if one.reason]
    failed = [one.motion for one in report.result.candidates if not one.reason and not math.isfinite(one.score)]
    parts = (("not tried", untried), ("found no scene", failed))
    return "; ".join(f"{said}: {', '.join(names)}" for said, names in parts if names)


def describe(report: ReconstructionReport) -> str:
    """The result in plain words."""
    number, views, counts = len(report.tracks.ids), len(report.tracks.views), report.counts
    if report.status != "OK":
        said = any(message in report.reason for _, _, message in report.warnings)  # then it is in the list that follows
        start = f"The {number:,} tracks through {views} views do not decide what the scene is."
        start += "" if said else f" {sentence(report.reason)}"
        return start + " The numbers are those of the best scene found, and not to be relied on." * report.has_scene
    verbs = {"static": "stand still", "moving": "move", "outlier": "do not fit", "missing": "are seen too rarely"}
    parts = [f"{many:,} {verbs.get(name, f'are on {name}')}" for name, many in counts.items() if many]
    return f"Of {number:,} points tracked through {views} views, {', '.join(parts)}. {PURPOSE.get(report.motion, '')}"


@register_page(ReconstructionReport, "reconstruction", FILES)
def summarize(report: ReconstructionReport) -> Summary:
    """Everything that is said of a reconstruction."""
    counts, known, failed = report.counts, report.has_scene, left_out(report)
    row: list[object] = [report.motion, len(report.tracks.views), len(report.tracks.ids)]
    row += [number if known or name == "missing" else "" for name, number in counts.items()]
    row += [f"{report.residual:.3g}" if known else "", report.state]
    tables = [Table(["motion", "views ", "tracks ", *(f"{name} " for name in counts), "rms residual ", "status"], [row])]
    if report.result.candidates:
        fitted = [one for one in report.result.candidates if math.isfinite(one.score)]
        rows = [[one.motion, f"{one.score:.6g}", f"{one.residual:.3g}"] for one in fitted]
        tables.append(Table(["model", "penalized cost ", "rms residual "], rows, [f"note: {failed}"] if failed else []))
    return Summary(
        headline=describe(report), tables=tables, notes=warning_lines(report),
        closing=[f"open: {report.ambiguity}"] if known and report.ambiguity else [],
        pictures={
            "tracks.png": partial(tracks_picture, report),
            "scene.png": (lambda theme: scene_picture(report)) if report.drawable else None,
        },
        dark=report.photograph is not None,
        files={
            "points.csv": partial(points_csv, report), "reconstruction.npz": partial(as_npz, report),
            "reconstruction.json": partial(as_json, report), "tracks.csv": None,
        },
        values=partial(page_values, report),
    )  # fmt: skip


def page_values(report: ReconstructionReport) -> dict[str, Any]:
    """Rows of the page's tables: models, views and their cameras; and what to say about the models left out."""
    taken = markup('{name} <small class="none">taken</small>', name=report.motion)
    fitted = [one for one in report.result.candidates if math.isfinite(one.score)]
    models = [
        [taken if one.motion == report.motion else one.motion, f"{one.score:.6g}", f"{one.residual:.3g}".replace("nan", "")]
        for one in fitted
    ]
    views, cameras = [], []
    for i, name in enumerate(report.tracks.views if report.has_scene else ()):
        seen = np.isfinite(report.tracks.values[i]).all(axis=1)
        residuals = report.arrays.residuals[i]
        used = report.arrays.inliers[i] & np.isfinite(residuals)
        rms = f"{float(np.sqrt(np.mean(np.square(residuals[used])))):.3g}" if used.any() else ""
        views.append([name, f"{report.times[i]:.6g}", f"{seen.sum():,}", f"{(seen & ~used).sum():,}", rms])
        cameras.append([name, matrix(report.arrays.cameras[i])])
    return {"models": models, "views": views, "cameras": cameras, "left_out": left_out(report), "moves": moves(report)}


def moves(report: ReconstructionReport) -> bool:
    """Whether any point has a velocity."""
    return report.velocities is not None and bool(np.nan_to_num(report.velocities).any())


def as_npz(report: ReconstructionReport) -> bytes:
    """All arrays, without pickle: cameras, points, velocities, labels, residuals, inliers, structure, projections, times, ids, and
    ``first_time``, the time in the files of the first view, which ``times`` count from."""
    arrays: dict[str, Any] = {name: getattr(report.arrays, name) for name in ARRAYS}
    arrays |= {"labels": report.labels, "times": report.times, "tracks": report.tracks.values, "ids": np.array(report.tracks.ids)}
    arrays |= {} if report.velocities is None else {"velocities": report.velocities}
    arrays |= {name: np.asarray(value) for name, value in report.poses.items()}
    return npz({**arrays, "status": report.status, "first_time": report.tracks.start})


def as_json(report: ReconstructionReport) -> dict[str, Any]:
    """The result as numbers: cameras, residuals, status, warnings, and how it came about."""
    return {
        **report.outcome_json,
        "motion": report.motion,
        "views": list(report.tracks.views),
        "times": report.times,
        "first_time": report.tracks.start,
        "tracks": len(report.tracks.ids),
        "counts": report.counts,
        "residual": report.residual if report.has_scene else None,
        "sigma": report.sigma if report.has_scene else None,
        "threshold": report.threshold,
        "cameras": report.arrays.cameras if report.has_scene else None,
        "ambiguity": report.ambiguity,
        **report.poses,
        "candidates": [
            {"motion": one.motion, "score": one.score, "residual": one.residual, "not_tried": one.reason or None}
            for one in report.result.candidates
        ],
    }


def suppress_rounding(velocities: FloatArray | None, points: FloatArray, span: float) -> FloatArray | None:
    """Velocities without what is nothing but rounding: ways, from first to last view, that are no part of the scene's size."""
    if velocities is None:
        return None
    size = float(np.nan_to_num(np.abs(points)).max(initial=0.0))
    return np.where(np.abs(velocities) * span <= ROUNDING * size, 0.0, velocities)


def points_csv(report: ReconstructionReport) -> str:
    """``id, label, name``, position at the first view, velocity, number of views that count, and rms residual of every point."""
    points, residuals = report.arrays.points, report.arrays.residuals
    axes = "xyz"[: points.shape[1]]
    velocities = np.full_like(points, np.nan) if report.velocities is None else report.velocities
    counted = np.where(report.arrays.inliers & np.isfinite(residuals), residuals, np.nan)
    seen = np.isfinite(counted).sum(axis=0)
    rms = np.sqrt(np.nansum(np.square(counted), axis=0) / np.maximum(seen, 1))
    rows: list[list[Any]] = []
    for i, (name, kind) in enumerate(zip(report.tracks.ids, report.kinds, strict=True)):
        place = [f"{value:.9g}" if np.isfinite(value) else "" for value in (*points[i], *velocities[i])]
        rows.append([safe_cell(name), int(report.labels[i]), kind, *place, int(seen[i]), f"{rms[i]:.6g}" if seen[i] else ""])
    return table_csv(["id", "label", "name", *axes, *(f"v{axis}" for axis in axes), "views", "rms"], rows)


# ----------------------------------------------------------------------------------------------------------------------
# The pictures: the scene, a plan of a plane or space from two sides; and the tracks.


# apart for colour-blind eyes, too, on both papers; outliers are crosses besides
COLOURS = {"static": "#2f7fb8", "moving": "#e8741e", "body 1": "#2f7fb8", "body 2": "#e8741e", "outlier": "#8b949c",
           "unlabelled": LIGHT.muted}  # fmt: skip


def kinds_of(report: ReconstructionReport) -> NDArray[Any]:
    """What every track is drawn as: its kind, or ``unlabelled`` where no scene was decided on."""
    return np.array(report.kinds) if report.drawable else np.full(len(report.tracks.ids), "unlabelled")


def colour_of(kind: str) -> str:
    """The colour of a kind."""
    return COLOURS.get(kind, LIGHT.muted)


def size_of(count: int) -> float:
    """Area of a mark, smaller where there are many."""
    return float(np.clip(2500 / max(1, count), 4, 22))


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
        legend(figure, kinds, COLOURS)
        return png(figure, tight=True)


def nearest_frame(report: ReconstructionReport) -> FloatArray:
    """Positions ``(views, n, d)`` carried by the affinity that brings the first ones nearest to their images in the first
    view."""
    image = report.tracks.values[0, :, :2]
    fits = np.isfinite(image).all(axis=1) & report.has_position & (report.labels > 0)
    dim = report.arrays.points.shape[1]
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
    camera = report.arrays.cameras[0]
    w = report.arrays.points[fits] @ camera[-1, :-1] + camera[-1, -1]
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
            mine = positions[:, (kinds == kind) & np.isin(kind, [half or kind])][:, :MAX_PATHS]
            _arrows(panel, mine, kind, reach, size_of(positions.shape[1]), box)
        finish(panel, *box, True, half or "the plane, in a frame of its own" + _sampling_note(positions, kinds, box))
        panel.set(xticks=[], yticks=[])
    return figure


def _sampling_note(positions: FloatArray, kinds: NDArray[Any], box: Box) -> str:
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
    panel.add_collection(LineCollection(list(points.transpose(1, 0, 2)), colors=colour, linewidths=1.2, alpha=0.75, zorder=2))
    step = points[-1] - points[-2]
    long = np.linalg.norm(points[-1] - points[0], axis=-1) > 0.006 * reach
    look: Any = {"angles": "xy", "scale_units": "xy", "scale": 1, "units": "dots", "width": 2.0, "headwidth": 4.0}
    panel.quiver(*points[-2, long].T, *step[long].T, color=colour, zorder=2, **look)


def _space(report: ReconstructionReport, positions: FloatArray, kinds: NDArray[Any]) -> Any:
    """Space, as the first camera looks and from the side; of two bodies, each for itself."""
    from mpl_toolkits.mplot3d.art3d import Line3DCollection

    halves = ["body 1", "body 2"] if report.bodies > 1 else ["", ""]
    wide = PAGE_WIDTH / 2
    figure = new_figure(PAGE_WIDTH, 4.9)
    for i, (half, side) in enumerate(zip(halves, SIDES, strict=True)):
        elevation, azimuth, zoom, name = SIDES[1] if half else side
        panel = figure.add_axes((i * wide / PAGE_WIDTH, 0.07, wide / PAGE_WIDTH, 0.86), projection="3d", proj_type="ortho")
        shown = positions[:, kinds == half] if half else positions[:, np.isin(kinds, ("static", "moving"))]
        low, high = box = around(shown, STRAYS)
        for kind in ("static", "moving", "body 1", "body 2"):
            mine = positions[:, (kinds == kind) & np.isin(kind, [half or kind])][:, :MAX_PATHS]
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
        panel.set_title(half or name + _sampling_note(positions, kinds, box), fontsize=9, loc="left", y=1.0)
    return figure


# ----------------------------------------------------------------------------------------------------------------------
# The picture of the tracks: as they were measured, and as the first camera would have seen them had it stood still.


GAP, LEFT, TRACKS_TALL = 0.55, 0.45, 5.2  # inches; the last is the greatest height of a panel
TRACKS_STRAYS = 0.995  # of the positions, those that a panel shows


def tracks_picture(report: ReconstructionReport, theme: Theme = LIGHT) -> bytes:
    """PNG: the tracks through all views in the first one; beside them the same without the motion of the camera."""
    kinds = kinds_of(report)
    measured = report.tracks.values[..., widest_axes(report.tracks.values[0])]
    still = as_first_camera(report)
    panels: list[tuple[FloatArray, str]] = [
        (measured, f"as tracked, from {_view_heading(report.tracks.views[0], report.tracks.by_time)} on")
    ]
    if still is not None:
        panels.append((still[..., widest_axes(report.tracks.values[0])], "as the first camera would see it, standing still"))
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
        legend(figure, kinds, COLOURS, theme.ink)
        return png(figure, tight=True)


def _view_heading(view: str, by_time: bool) -> str:
    return f"{'time' if by_time else 'frame'} {view}" if view.lstrip("-").replace(".", "", 1).isdigit() else shorten(view, 40)


def as_first_camera(report: ReconstructionReport) -> FloatArray | None:
    """Where the first camera would have seen the points at the times of all views, ``(views, n, l)``; None for two bodies, or
    where no scene was decided on."""
    if not report.drawable or report.velocities is None:
        return None
    camera = report.arrays.cameras[0]
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
        mine = points[:, kinds == kind][:, :MAX_PATHS]
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
