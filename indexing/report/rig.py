"""A rig of cameras and the people before it as pictures: a scene in space that turns and plays (``rig.js``), plans, residuals."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from indexing.report.canvas import LIGHT, cmap, new_figure, png, shorten, side_of, style
from indexing.report.page import clean

if TYPE_CHECKING:
    from indexing.calibrate.rig import CameraRig

FloatArray = NDArray[np.float64]
MISSING = -32768  # rig.js knows it, too

MAX_GAP_SECONDS = 0.25  # without a frame, beyond which nothing is filled in
MAX_VALUES = 240_000  # coordinates of a page: two bytes each, .64 MB of text
MAX_RATE = 30.0  # frames per second of a page
GRID_STEPS = 30_000  # of the grid to either side: coordinates are 16-bit numbers


def array_of(value: Any) -> FloatArray:
    """A tensor as an array."""
    return np.asarray(value.detach().cpu().numpy(), dtype=np.float64)


# ----------------------------------------------------------------------------------------------------------------------
# The scene in space, packed into the page; rig.js draws it.


def scene(rig: CameraRig) -> tuple[str, str]:
    """JSON for the script, and what to say about it; empty where there is nothing to draw."""
    found, world, times = rig.calibration, rig.points, rig.moments
    centers = array_of(found.centers)
    if not len(times) or not np.isfinite(centers).all():
        return "", ""
    step = float(np.median(np.diff(times))) if len(times) > 1 else 1 / MAX_RATE
    every = _every(len(times), step, world.shape[1])
    frames = np.arange(0, len(times), every)
    points, kept = world[frames], np.round(1000 * times[frames]).astype(int)
    known = points[np.isfinite(points).all(axis=2)]
    if not len(known):
        return "", ""
    inner = np.percentile(known, [1, 99], axis=0)
    middle = inner.mean(axis=0)
    low, high = np.minimum(inner[0], centers.min(axis=0)), np.maximum(inner[1], centers.max(axis=0))
    reach = max(0.5 * float(np.linalg.norm(high - low)), 1e-6)
    unit = 4 * reach / GRID_STEPS
    codes = np.clip(np.round((points - middle) / unit), -GRID_STEPS, GRID_STEPS)
    packed = np.where(np.isfinite(points).all(axis=2, keepdims=True), codes, MISSING).astype("<i2")
    bones = rig.joints.skeleton.bones if rig.joints.skeleton is not None else ()
    first = centers[0] - middle
    data = {
        "cameras": [_camera_scene(rig, i) for i in range(len(rig.names))],
        "people": rig.persons, "joints": rig.joints.count, "bones": [[a, b, _side(rig, a, b)] for a, b in bones],
        "times": kept.tolist(), "points": base64.b64encode(packed.tobytes()).decode("ascii"),
        "unit": unit, "middle": middle.tolist(),
        "gap": 1000 * max(MAX_GAP_SECONDS, 1.5 * step * every), "ground": _ground(low, high, reach),
        "target": ((low + high) / 2).tolist(), "reach": reach, "turn": round(math.atan2(first[1], first[0]) + 0.5, 4),
    }  # fmt: skip
    grid = f" The lines on the ground are {data['ground']['step']:g} m apart." if found.metric else ""
    said = f"{1 / step / every:.3g} of {1 / step:.3g} frames a second are kept in the page.{grid}"
    return json.dumps(data, ensure_ascii=False, separators=(",", ":")), said


def _every(frames: int, step: float, joints: int) -> int:
    """One frame of so many is in the page: as many a second as were recorded, or as fit."""
    most = max(2, MAX_VALUES // (3 * joints))
    return max(1, math.ceil(1 / step / MAX_RATE - 0.01), math.ceil(frames / most))


def _side(rig: CameraRig, a: int, b: int) -> str:
    both = {side_of(rig.joint_names[a]), side_of(rig.joint_names[b])} - {"m"}
    return both.pop() if len(both) == 1 else "m"


def _camera_scene(rig: CameraRig, i: int) -> dict[str, Any]:
    found, view = rig.calibration, rig.views[i]
    K = array_of(found.K[i])
    return {
        "name": str(clean(view.name)), "size": list(view.size), "K": [K[0, 0], K[1, 1], K[0, 2], K[1, 2]],
        "R": array_of(found.R[i]).tolist(), "t": array_of(found.t[i]).tolist(),
        "center": array_of(found.centers[i]).tolist(), "k": array_of(found.distortion[i])[:2].tolist(),
    }  # fmt: skip


def _ground(low: FloatArray, high: FloatArray, reach: float) -> dict[str, Any]:
    """A grid of lines: a metre apart, or as many units of a round number as look like it."""
    step = 10.0 ** math.floor(math.log10(reach / 2)) if reach > 20 or reach < 2 else 1.0
    begin, end = np.floor(low[:2] / step) * step, np.ceil(high[:2] / step) * step
    return {"from": begin.round(9).tolist(), "to": end.round(9).tolist(), "step": step}


# ----------------------------------------------------------------------------------------------------------------------
# The pictures: the rig from above and from the side, and the residuals.


WIDTH, TALL, BESIDE, EDGE, FOOT = 10.2, 4.6, 0.7, 0.55, 0.5  # inches
CELL, LEFT, ROOF = 0.34, 1.3, 1.25  # inches: of a heat cell, and beside and above them
CAMERA, WAYS = "#0f6b85", ("#e8741e", "#7a4fb5", "#3a9a4f", "#b8355f")
LONGEST = 60  # joints that a heat map has columns for


def plan_picture(rig: CameraRig) -> bytes | None:
    """PNG: cameras with what they look at and how sure their places are, and the people's ways."""
    found = rig.calibration
    centers = array_of(found.centers)
    if not np.isfinite(centers).all():
        return None
    ways = [_way(joints) for joints in np.split(rig.points, rig.persons, axis=1)]
    looks = np.stack([array_of(found.R[i])[2] for i in range(len(centers))])
    with style():
        figure = new_figure(WIDTH, TALL)
        wide = (WIDTH - 2 * EDGE - BESIDE) / 2
        for k, (axes, title) in enumerate((((0, 1), "from above"), ((0, 2), "from the side"))):
            panel = figure.add_axes(((EDGE + k * (wide + BESIDE)) / WIDTH, FOOT / TALL, wide / WIDTH, 1 - (FOOT + 0.35) / TALL))
            _draw_plan(panel, rig, list(axes), centers, looks, ways)
            unit = "m" if found.metric else "units of the rig"
            panel.set_title(f"{title}, {unit}", fontsize=9, loc="left")
        return png(figure)


def _way(joints: FloatArray) -> FloatArray:
    """``(frames, 3)`` where a person is: the median of the joints."""
    out = np.full((len(joints), 3), np.nan)
    there = np.isfinite(joints).all(axis=2).sum(axis=1) > 0
    out[there] = np.nanmedian(joints[there], axis=1)
    return out


def _draw_plan(
    panel: Any,
    rig: CameraRig,
    axes: list[int],
    centers: FloatArray,
    looks: FloatArray,
    ways: Sequence[FloatArray],
) -> None:
    from matplotlib.patches import Ellipse

    reach = float(np.ptp(centers, axis=0).max()) or 1.0
    for way, colour in zip(ways, [WAYS[i % len(WAYS)] for i in range(len(ways))], strict=True):
        panel.plot(way[:, axes[0]], way[:, axes[1]], color=colour, linewidth=1.2, zorder=3)
    for i, name in enumerate(rig.names):
        at, to = centers[i][axes], centers[i][axes] + 0.18 * reach * looks[i][axes]
        panel.plot(*zip(at, to, strict=True), color=CAMERA, linewidth=1.6, zorder=4)
        panel.plot(*at, marker="s", markersize=5, color=CAMERA, zorder=5)
        panel.annotate(shorten(name, 18), at, (4, 5), textcoords="offset points", fontsize=8, color=CAMERA, parse_math=False)
        spread = np.nan_to_num(array_of(rig.calibration.covariance[i]))[3:6, 3:6][np.ix_(axes, axes)]
        values, vectors = np.linalg.eigh(spread)
        if rig.ok and values[-1] > 0:
            angle = math.degrees(math.atan2(vectors[1, -1], vectors[0, -1]))
            sides = 6 * np.sqrt(np.maximum(values[::-1], 0.0))
            panel.add_patch(Ellipse(at, *sides, angle=angle, facecolor=CAMERA, alpha=0.2, linewidth=0, zorder=2))
    if axes[1] == 2:
        panel.axhline(0.0, color=LIGHT.muted, linewidth=0.8, zorder=1)
    panel.set_aspect("equal", adjustable="datalim")
    panel.margins(0.12)
    panel.grid(color=LIGHT.line, linewidth=0.5, zorder=0)
    panel.set_axisbelow(True)
    panel.tick_params(length=2.5, labelsize=7.5)
    for side in panel.spines.values():
        side.set_linewidth(0.6)


def heat_picture(rig: CameraRig) -> bytes | None:
    """PNG: a cell for each camera and joint; of very many joints, those with the largest residuals."""
    table = array_of(rig.calibration.residuals)
    if not np.isfinite(table).any():
        return None
    names = rig.point_names
    shown = np.arange(len(names))
    if len(names) > LONGEST:
        worst = np.where(np.isfinite(table), table, -1.0).max(axis=0)
        shown = np.sort(np.argsort(-worst, kind="stable")[:LONGEST])
    cells = table[:, shown]
    width, height = LEFT + CELL * len(shown) + 0.2, ROOF + CELL * len(cells) + 0.15
    with style():
        figure = new_figure(max(width, 4.0), height)
        panel = figure.add_axes(
            (LEFT / max(width, 4.0), 0.15 / height, CELL * len(shown) / max(width, 4.0), CELL * len(cells) / height)
        )
        top = float(np.nanpercentile(cells, 98)) or 1.0
        panel.imshow(cells, cmap=cmap(), vmin=0, vmax=top, aspect="auto")
        for i, j in np.ndindex(cells.shape):
            value = cells[i, j]
            ink = LIGHT.paper if math.isfinite(value) and value > 0.55 * top else LIGHT.ink
            said = f"{value:.0f}" if math.isfinite(value) and value >= 9.95 else f"{value:.1f}" if math.isfinite(value) else "-"
            panel.text(j, i, said, ha="center", va="center", fontsize=6.5, color=ink)
        panel.set_xticks(
            range(len(shown)), [shorten(names[j].replace("_", " "), 20) for j in shown], rotation=55, ha="left", parse_math=False
        )
        panel.xaxis.tick_top()
        panel.set_yticks(range(len(cells)), [shorten(name, 20) for name in rig.names], parse_math=False)
        panel.tick_params(length=0, labelsize=7.5)
        for side in panel.spines.values():
            side.set_visible(False)
        return png(figure, tight=True)
