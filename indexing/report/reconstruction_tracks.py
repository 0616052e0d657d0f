"""The picture of the tracks: as they were measured, and as the first camera would have seen them had it stood still."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from indexing.report.canvas import Theme, png, shorten, style
from indexing.report.reconstruction_look import SHOWN, colour_of, finish, kinds_of, layout, legend, limits, size_of

if TYPE_CHECKING:
    from indexing.report.reconstruction import ReconstructionReport

FloatArray = NDArray[np.float64]
GAP, LEFT, TALL = 0.55, 0.45, 5.2  # inches; the last is the greatest height of a panel
STRAYS = 0.995  # of the positions, those that a panel shows


def tracks_picture(report: ReconstructionReport, theme: Theme) -> bytes:
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
    boxes = [limits(points, STRAYS) for points in kept]
    down = report.tracks.values.shape[-1] == 2
    with style(theme):
        figure, places = layout(boxes, TALL, LEFT, GAP)
        for panel, (points, title), box in zip(places, panels, boxes, strict=True):
            _draw(panel, points, kinds, theme)
            finish(panel, *box, down, title)
        legend(figure, kinds, theme)
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
    camera = report.cameras[0]
    rays = report.positions @ camera[:, :-1].T + camera[:, -1]
    with np.errstate(divide="ignore", invalid="ignore"):
        seen: FloatArray = rays[..., :-1] / rays[..., -1:]
    # past infinity: behind the camera
    return np.where(rays[..., -1:] * rays[:1, :, -1:] > 0, seen, np.nan)


def _draw(panel: Any, points: FloatArray, kinds: NDArray[Any], theme: Theme) -> None:
    """Paths ``(views, n, 2)`` with a dot where they begin."""
    from matplotlib.collections import LineCollection

    size = size_of(points.shape[1])
    for kind in ("unlabelled", "outlier", "static", "moving", "body 1", "body 2"):  # what matters most on top
        mine = points[:, kinds == kind][:, :SHOWN]
        if not mine.shape[1]:
            continue
        colour = colour_of(kind, theme)
        paths = [path[np.isfinite(path).all(axis=1)] for path in mine.transpose(1, 0, 2)]
        paths = [path for path in paths if len(path)]
        quiet = 0.35 if kind == "outlier" else 0.7
        panel.add_collection(LineCollection([path for path in paths if len(path) > 1], colors=colour, linewidths=1.0, alpha=quiet))
        starts = np.array([path[0] for path in paths]).reshape(-1, 2)
        mark = {"marker": "x", "linewidth": 1.1} if kind == "outlier" else {"marker": "o", "linewidth": 0}
        panel.scatter(*starts.T, s=size, c=colour, zorder=3, **mark)
