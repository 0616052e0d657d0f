"""Pictures of the experiments on real recordings.  They show other people's data: only ever under results/."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import torch
from torch import Tensor

from dyntorch.geometry.homogeneous import apply
from dyntorch.tasks.align.result import MOVING, OUTLIER, STATIC, Alignment
from experiments.common.real_data import Board

COLOURS = {STATIC: "#5a7d9a", MOVING: "#e07b39", OUTLIER: "#b3123a"}
NAMES = {STATIC: "static", MOVING: "moving", OUTLIER: "outlier"}
LINES = ("#e07b39", "#5a7d9a", "#6aa84f", "#8e5ea2")
MARKS = ("o", "s", "^", "D")


class Aligned(Protocol):
    """A sequence and its alignment."""

    @property
    def name(self) -> str: ...
    @property
    def views(self) -> tuple[Tensor, Tensor, Tensor]: ...
    @property
    def result(self) -> Alignment: ...
    @property
    def accuracy(self) -> float: ...


def save(figure: Any, path: Path) -> None:
    """Write and close a figure."""
    figure.savefig(path, dpi=110, bbox_inches="tight", facecolor="white")
    plt.close(figure)


def traffic_picture(shown: Sequence[Aligned], path: Path) -> None:
    """Every sequence: the points of view 1, and where moving ones go after the motion of the camera is taken out."""
    columns = min(5, len(shown))
    rows = -(-len(shown) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(3.8 * columns, 3.2 * rows), squeeze=False, layout="constrained")
    for axis in axes.flat:
        axis.axis("off")
    for axis, one in zip(axes.flat, shown, strict=False):
        axis.axis("on")
        A, B, labels = one.result.A, one.result.B, one.result.labels
        assert B is not None
        path_points = torch.stack([one.views[0], apply(A, one.views[1]), apply(B, one.views[2])])
        for label in (STATIC, OUTLIER, MOVING):
            mine = labels == label
            axis.plot(*one.views[0][mine].T, ".", color=COLOURS[label], ms=3, label=f"{NAMES[label]} ({int(mine.sum())})")
            if label == MOVING:
                axis.plot(*path_points[:, mine].unbind(-1), color=COLOURS[label], lw=0.5, alpha=0.7)
        top = one.views[0].amax(0) + 15
        axis.set(xlim=(-15, float(top[0])), ylim=(float(top[1]), -15), xticks=[], yticks=[])
        axis.set_title(f"{one.name}: {one.accuracy:.0%} of labels right", fontsize=10)
        axis.legend(loc="upper left", fontsize=7, framealpha=0.8, markerscale=2)
        axis.set_aspect("equal")
    figure.suptitle("Points of view 1; lines: where moving points go once the camera's own motion is taken out", fontsize=12)
    save(figure, path)


def shares_picture(curves: Mapping[str, Tensor], shares: Sequence[float], path: Path) -> None:
    """Error of the background as its points are taken away: medians, and every sequence as a dot."""
    figure, axis = plt.subplots(figsize=(7, 4.4), layout="constrained")
    for k, (name, values) in enumerate(curves.items()):
        place = torch.arange(len(shares), dtype=torch.float64)
        axis.plot(place, values.median(-1).values, color=LINES[k], marker=MARKS[k], lw=2, label=name)
        spread = (place + 0.08 * (2 * k - 1))[:, None].expand_as(values)
        axis.plot(spread.flatten(), values.flatten(), ".", color=LINES[k], alpha=0.45, ms=5)
    axis.set_xticks(range(len(shares)), [f"{share:.0%}" for share in shares])
    axis.set(yscale="log", xlabel="share of the background points that is kept", ylabel="error of all background points, px")
    axis.set_title("Cars on roads: the camera's motion with less and less that stands still", fontsize=11)
    axis.grid(alpha=0.25)
    axis.legend()
    save(figure, path)


def board_picture(seen: Board, errors: Mapping[str, Mapping[str, Sequence[float]]], path: Path) -> None:
    """The board as one camera sees it at three instants with some itineraries, and the errors of held-out corners."""
    figure, axes = plt.subplots(1, 1 + len(errors), figsize=(5 * (1 + len(errors)), 4.2), layout="constrained")
    _sightings(axes[0], seen)
    draw = torch.Generator().manual_seed(0)
    ways = ("all move", "moving, static and a fifth wrong", "identities given")
    for axis, (kind, found) in zip(axes[1:], errors.items(), strict=True):
        for k, way in enumerate(ways):
            values = torch.tensor(found[way])
            ok = values[values.isfinite()]
            axis.plot(k + 0.25 * (torch.rand(len(ok), generator=draw) - 0.5), ok, ".", color=LINES[k], alpha=0.6)
            if len(ok):
                median = float(ok.median())
                axis.plot([k - 0.25, k + 0.25], [median, median], color="black", lw=1.5)
                axis.annotate(f"{median:.2f} px", (k + 0.27, median), fontsize=9, va="center")
            axis.annotate(f"{len(ok)} of {len(values)} OK", (k, 0.97), xycoords=("data", "axes fraction"), ha="center", va="top")
        axis.set_xticks(range(3), ["all matches move", "moving, static,\na fifth wrong", "identities given\n(best possible)"])
        axis.set(yscale="log", xlim=(-0.5, 2.8), ylabel="error of held-out corners, px")
        axis.margins(y=0.25)
        axis.yaxis.set_major_formatter("{x:g}")
        axis.yaxis.set_minor_formatter("{x:g}")
        axis.set_title(kind, fontsize=11)
        axis.grid(alpha=0.25, axis="y")
    save(figure, path)


def _sightings(axis: Any, seen: Board) -> None:
    """Corners of one camera at three instants, joined by itineraries along a row, a column and a diagonal of the board."""
    full = [t for t, x in sorted(seen.seen[1].items()) if bool(x.isfinite().all())]
    views = [seen.seen[1][t] for t in (full[0], full[len(full) // 3], full[2 * len(full) // 3])]
    for k, x in enumerate(views):
        axis.plot(*x.T, MARKS[k], color=LINES[k], ms=5, label=f"instant {k + 1}")
    for stops in ((0, 1, 2), (11, 8, 5), (0, 4, 8), (9, 9, 3)):
        path = torch.stack([x[stop] for x, stop in zip(views, stops, strict=True)])
        axis.plot(*path.T, color="0.45", lw=1)
    axis.invert_yaxis()
    axis.set(aspect="equal", xticks=[], yticks=[])
    axis.set_title("A board moved by hand; grey: points that move on it", fontsize=11)
    axis.legend(fontsize=9)


def drive_picture(views: Sequence[Tensor], one: Alignment, path: Path) -> None:
    """Boxes from above at three sweeps: as the sensor measured them, and with its motion taken out."""
    assert one.B is not None
    placed = (torch.stack(list(views)), torch.stack([views[0], apply(one.A, views[1]), apply(one.B, views[2])]))
    figure, axes = plt.subplots(1, 2, figsize=(13, 5.6), sharex=True, sharey=True, layout="constrained")
    for axis, paths, title in zip(axes, placed, ("as measured by the moving sensor", "aligned to the first sweep"), strict=True):
        for label in (STATIC, OUTLIER, MOVING):
            mine = one.labels == label
            axis.plot(paths[:, mine, 0], paths[:, mine, 1], color=COLOURS[label], lw=1.4)
            name = f"{NAMES[label]} ({int(mine.sum())})"
            axis.plot(paths[0, mine, 0], paths[0, mine, 1], ".", color=COLOURS[label], ms=5, label=name)
        axis.plot(0, 0, "k^", ms=9, label="sensor")
        axis.set(aspect="equal", xlabel="forward, m", title=title)
        axis.grid(alpha=0.2)
    axes[0].set_ylabel("left, m")
    axes[1].legend(fontsize=9)
    save(figure, path)


def movers_picture(curves: Mapping[str, Tensor], shares: Sequence[float], path: Path) -> None:
    """Rotation and translation errors ``(shares, 3)`` of each method against the share of boxes that move."""
    labels = ("rotation error, degrees", "translation error, m", "translation error up to a common velocity, m")
    figure, axes = plt.subplots(1, 3, figsize=(14, 4.4), layout="constrained")
    for k, axis in enumerate(axes):
        for style, (name, values) in enumerate(curves.items()):
            axis.plot([100 * s for s in shares], values[:, k], color=LINES[style], marker=MARKS[style], lw=2, label=name)
        axis.set(yscale="log", xlabel="boxes that move, %", title=labels[k], xticks=[100 * s for s in shares])
        axis.grid(alpha=0.25)
    axes[0].legend(fontsize=9)
    figure.suptitle("Pose of a driving sensor from annotated boxes of traffic (medians over triples of sweeps)", fontsize=12)
    save(figure, path)


def bodies_picture(
    aligned: Tensor, labels: Tensor, curves: Mapping[str, Sequence[float]], spacings: Sequence[int], path: Path
) -> None:
    """Left: pooled bodies seen from the front with their labels; right: errors against the spacing of the frames."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(15, 4.8), layout="constrained", width_ratios=(1.25, 1))
    for label in (STATIC, OUTLIER, MOVING):
        mine = labels == label
        paths = aligned[:, mine]
        left.plot(paths[..., 0], paths[..., 1], color=COLOURS[label], lw=1)
        left.plot(paths[0, :, 0], paths[0, :, 1], ".", color=COLOURS[label], ms=4, label=f"{NAMES[label]} ({int(mine.sum())})")
    left.set(aspect="equal", xlabel="m", ylabel="m")
    left.set_title("Joints of pooled takes, three views aligned", fontsize=11)
    left.legend(fontsize=9)
    for style, (name, values) in enumerate(curves.items()):
        dashes = "-" if name.startswith("align") else ":" if name.startswith("all still") else "--"
        right.plot(spacings, [1000 * v for v in values], dashes, color=f"C{style}", marker=MARKS[style % 4], lw=2, label=name)
    right.set(yscale="log", xlabel="frames between views (60 per second)", xticks=list(spacings), ylabel="error of A and B, mm")
    right.set_title("Training takes: error against the spacing", fontsize=11)
    right.grid(alpha=0.25)
    right.legend(fontsize=9, loc="center left", bbox_to_anchor=(1.0, 0.5))
    save(figure, path)
