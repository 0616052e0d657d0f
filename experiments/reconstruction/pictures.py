"""Pictures of reconstructed motion.  ``python -m experiments.reconstruction.pictures`` draws docs/reconstruct.png from a scene of
our own; pictures of other people's recordings only ever go under results/."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import torch
from matplotlib.tri import Triangulation
from torch import Tensor

import dyntorch as dyn
from dyntorch.geometry.homogeneous import homogeneous, inhomogeneous
from dyntorch.geometry.lift import gauge_algebra
from dyntorch.numerics.nullspace import null_space
from dyntorch.scenes.scene import calibration, looking_at
from dyntorch.tasks.reconstruct.result import Reconstruction
from experiments.alignment.real.pictures import LINES, MARKS, save
from experiments.reconstruction.data import CENTRE, World

MOVING, STATIC, CAMERA = "#e07b39", "#8a949e", "#2f5d8a"
SIZE = 2 * CENTRE


def aligned(found: Reconstruction, true: Tensor) -> tuple[Tensor, Tensor]:
    """Lifted points ``(n, K)`` and projections of a reconstruction, moved within what it leaves open to lie on the true points."""
    algebra = gauge_algebra(found.motion.lifts(found.times))
    z = torch.nn.functional.normalize(true, dim=-1)
    moved = torch.einsum("sij,nj->nis", algebra, torch.nn.functional.normalize(found.structure, dim=-1))
    rows = moved - z[..., None] * (z[:, None] @ moved)
    weights = torch.ones_like(z[:, 0])
    for _ in range(20):
        c = null_space((rows * weights[:, None, None]).flatten(0, 1))[0]
        off = (rows @ c).norm(dim=-1) / (moved @ c).norm(dim=-1)
        weights = 1 / ((moved @ c).norm(dim=-1) * (1 + off / off.median()))
    change = torch.einsum("s,sij->ij", c, algebra)
    return found.structure @ change.mT, found.projections @ torch.linalg.inv(change)


def places(structure: Tensor, found: Reconstruction, time: float) -> Tensor:
    """Positions ``(n, d)`` of aligned points."""
    return inhomogeneous(structure @ found.motion.lifts([time])[0].mT)


# ---- the picture of the README -----------------------------------------------------------------------------------------
def birds(draw: torch.Generator) -> tuple[World, Tensor, Tensor]:
    """A flock over hills, every bird at its own constant velocity: the world, its cameras ``(views, 3, 4)``, and the tracks."""
    east, north = torch.meshgrid(torch.linspace(-1.3, 1.3, 12), torch.linspace(-1.3, 1.3, 12), indexing="ij")
    ground = torch.stack([east.flatten(), north.flatten()], dim=-1).double()
    ground = ground + 0.06 * torch.randn(ground.shape, generator=draw, dtype=ground.dtype)
    height = 0.1 * (2.6 * ground[:, :1]).sin() + 0.1 * (2.2 * ground[:, 1:] + 0.6).cos() - 0.6
    count = 48
    angle, far = 2 * torch.pi * torch.rand(count, generator=draw).double(), 0.35 + 0.85 * torch.rand(count, generator=draw).double()
    up = 0.1 + 1.1 * torch.rand(count, generator=draw).double()
    bird = torch.stack([far * angle.cos(), far * angle.sin(), up], dim=-1)
    wind = 0.13 * torch.stack([-angle.sin(), angle.cos(), 0.35 * (2 * angle).sin()], dim=-1)
    wind = wind * (0.5 + torch.rand(count, 1, generator=draw).double()) + 0.035 * torch.randn(count, 3, generator=draw).double()
    times = torch.arange(6, dtype=torch.float64)
    start = torch.cat([torch.cat([ground, height], dim=-1), bird - 2.5 * wind])
    speed = torch.cat([torch.zeros_like(ground[:, :1]).expand(-1, 3), wind])
    world = World(start + times[:, None, None] * speed, times, speed.norm(dim=-1) > 0)
    turn = torch.tensor([-0.95, -0.68, -0.42, -0.12, 0.1, 0.42], dtype=torch.float64)
    climb = torch.tensor([0.9, 1.75, 1.1, 2.1, 1.2, 1.5], dtype=torch.float64)
    away = torch.tensor([3.3, 2.9, 3.5, 3.0, 3.4, 2.9], dtype=torch.float64)
    position = torch.stack([away * turn.sin(), -away * turn.cos(), climb], dim=-1)
    target = torch.tensor([0.0, 0.0, 0.05]).double() + 0.08 * torch.randn(6, 3, generator=draw).double()
    pose = looking_at(position, target, torch.tensor([0.0, 0.0, 1.0]).double().expand(6, 3))
    cameras = calibration(torch.full((6,), 820.0, dtype=torch.float64), CENTRE) @ pose
    exact = inhomogeneous(homogeneous(world.places) @ cameras.mT)
    return world, cameras, exact + 0.5 * torch.randn(exact.shape, generator=draw, dtype=exact.dtype)


def readme_picture(path: Path) -> None:
    """Left: what a camera sees; right: the scene that ``reconstruct`` makes of six such views."""
    world, _, tracks = birds(torch.Generator().manual_seed(4))
    found = dyn.reconstruct(tracks, "constant_velocity_3d", world.times, static=~world.moving).check()
    structure, projections = aligned(found, world.structure("constant_velocity_3d"))
    figure = plt.figure(figsize=(13.5, 6.3))
    left = figure.add_axes((0.012, 0.07, 0.385, 0.80))
    _views(left, tracks[[0, 2, 4]], world.moving)
    right = figure.add_axes((0.365, -0.05, 0.63, 1.06), projection="3d", computed_zorder=False)
    _space(right, world, found, structure, projections)
    figure.text(0.205, 0.905, "Given: tracks in uncalibrated views (three of six)", ha="center", fontsize=13)
    figure.text(0.70, 0.905, "Found: cameras, points and velocities", ha="center", fontsize=13)
    _finish(figure, path)


def _finish(figure: Any, path: Path) -> None:
    figure.savefig(path, dpi=100, facecolor="white")
    plt.close(figure)


def _views(axis: Any, tracks: Tensor, moving: Tensor) -> None:
    """Tracks of three views in one image, the first view faint, the last one full."""
    for mine, colour in ((~moving, STATIC), (moving, MOVING)):
        axis.plot(*tracks[:, mine].unbind(-1), color=colour, lw=0.9, alpha=0.45, zorder=1)
        for k, x in enumerate(tracks):
            axis.plot(*x[mine].T, ".", color=colour, ms=(3, 4, 6.5)[k], alpha=(0.45, 0.65, 1.0)[k], mec="none", zorder=2 + k)
    low, high = tracks.flatten(0, 1).amin(0) - 25, tracks.flatten(0, 1).amax(0) + 25
    axis.set(xlim=(float(low[0]), float(high[0])), ylim=(float(high[1]), float(low[1])), aspect="equal", xticks=[], yticks=[])
    for spine in axis.spines.values():
        spine.set_color("0.75")
    axis.set_xlabel("0.5 px of noise; everything moves in the image", fontsize=10, color="0.35")


def _space(axis: Any, world: World, found: Reconstruction, structure: Tensor, projections: Tensor) -> None:
    """Points at the last time with their velocities from the first on, and the cameras."""
    first, last = float(world.times[0]), float(world.times[-1])
    start, end = places(structure, found, first), places(structure, found, last)
    still, moving = ~world.moving, world.moving
    ground = Triangulation(*world.places[0][still, :2].T.numpy()).triangles
    axis.plot_trisurf(
        *start[still].T.numpy(), triangles=ground, color="#c9cfd4", alpha=0.45, edgecolor="white", linewidth=0.3, zorder=0
    )
    axis.scatter(*start[still].T, s=9, color=STATIC, alpha=0.9, linewidths=0, zorder=1)
    axis.quiver(*start[moving].T, *(end - start)[moving].T, color=MOVING, lw=1.5, arrow_length_ratio=0.22, zorder=3)
    axis.scatter(*world.places[-1][moving].T, s=26, facecolors="none", edgecolors="0.25", linewidths=0.6, zorder=4)
    cameras = projections @ torch.linalg.pinv(found.motion.lifts(found.times))
    centres = torch.stack(
        [_frustum(axis, camera, structure, found, float(t)) for camera, t in zip(cameras, world.times, strict=True)]
    )
    axis.plot(*centres.T, ":", color=CAMERA, lw=0.9, alpha=0.8)
    axis.scatter([], [], s=14, color=STATIC, label="static points")
    axis.plot([], [], color=MOVING, lw=1.6, label="velocities, first view to last")
    axis.scatter([], [], s=26, facecolors="none", edgecolors="0.25", label="true positions, last view")
    axis.plot([], [], color=CAMERA, lw=1.2, label="cameras")
    axis.legend(loc="lower right", bbox_to_anchor=(0.36, 0.09), fontsize=9.5, frameon=False)
    everything = torch.cat([start, end, centres])
    low, high = everything.amin(0), everything.amax(0)
    axis.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axis.set_box_aspect((high - low).tolist(), zoom=1.4)
    axis.view_init(elev=24, azim=-22)
    axis.set_proj_type("ortho")
    for artist in (*axis.collections, *axis.lines):
        artist.set_clip_on(False)
    axis.set_axis_off()


def _frustum(axis: Any, camera: Tensor, structure: Tensor, found: Reconstruction, time: float, size: float = 0.42) -> Tensor:
    """Draw an uncalibrated camera of the aligned world as a pyramid; its centre."""
    inverse = torch.linalg.inv(camera[:, :3])
    centre = -inverse @ camera[:, 3]
    corners = torch.tensor([[0.0, 0.0, 1.0], [SIZE, 0.0, 1.0], [SIZE, SIZE, 1.0], [0.0, SIZE, 1.0]], dtype=camera.dtype)
    rays = corners @ inverse.mT
    middle = places(structure, found, time).median(0).values - centre
    rays = rays * torch.sign(rays.sum(0) @ middle)
    axes = torch.nn.functional.normalize(rays.sum(0), dim=-1)
    ends = centre + size * rays / (rays @ axes)[:, None]
    loop = torch.cat([ends, ends[:1]])
    axis.plot(*loop.T, color=CAMERA, lw=1.1)
    for end in ends:
        axis.plot(*torch.stack([centre, end]).T, color=CAMERA, lw=1.1)
    axis.scatter(*centre[:, None], s=12, color=CAMERA)
    return centre


# ---- recordings --------------------------------------------------------------------------------------------------------
def traffic_picture(
    tracks: Tensor,
    frames: Sequence[int],
    found: Reconstruction,
    background: Tensor,
    errors: Mapping[str, Sequence[float]],
    steps: Sequence[int],
    path: Path,
) -> None:
    """Left: tracks as filmed; middle: the recovered motion as the first camera would see it, standing still; right: errors."""
    figure, axes = plt.subplots(1, 3, figsize=(19, 5), layout="constrained", width_ratios=(1, 1, 1.1))
    still = torch.stack([found.image(found.cameras[0], float(t)) for t in found.times])
    titles = "as filmed, five frames (colours: true groups)", "recovered, seen by a camera that stands still"
    for axis, paths, title in zip(axes[:2], (tracks[list(frames)], still), titles, strict=True):
        for mine, colour, name in ((background, STATIC, "background"), (~background, MOVING, "cars")):
            axis.plot(*paths[:, mine].unbind(-1), color=colour, lw=0.9)
            axis.plot(*paths[-1][mine].T, ".", color=colour, ms=3.5, label=f"{name} ({int(mine.sum())})")
        low, high = tracks[frames[0]].amin(0) - 20, tracks[frames[0]].amax(0) + 20
        axis.set(xlim=(float(low[0]), float(high[0])), ylim=(float(high[1]), float(low[1])), aspect="equal", xticks=[], yticks=[])
        axis.set_title(title, fontsize=10)
    axes[0].legend(fontsize=9)
    names = [name for name in errors if name.endswith("between")]
    for k, name in enumerate(names):
        for place, style in (("between", "-"), ("after", ":")):
            values = errors[name.removesuffix("between") + place]
            label = name.removesuffix(", between") if place == "between" else None
            axes[2].plot(steps, values, style, color=f"C{k}", marker=MARKS[k % 4], lw=2, label=label)
    axes[2].set(
        yscale="log", xlabel="frames between the views", xticks=list(steps), ylabel="error of the cars in a held-out frame, px"
    )
    axes[2].set_title("solid: between the views; dotted: after them", fontsize=10)
    axes[2].grid(alpha=0.25)
    axes[2].legend(fontsize=9)
    save(figure, path)


def people_picture(
    world: World, found: Reconstruction, curves: Mapping[str, Sequence[float]], shares: Sequence[float], path: Path
) -> None:
    """Left: people and the velocities of their joints, true and recovered; right: errors against the way off straight lines."""
    structure, _ = aligned(found, world.structure(found.motion.name))
    figure = plt.figure(figsize=(15, 6.4))
    axis: Any = figure.add_axes((0.0, 0.0, 0.55, 0.95), projection="3d")
    start, end = places(structure, found, float(world.times[0])), places(structure, found, float(world.times[-1]))
    axis.quiver(*start.T, *(end - start).T, color=MOVING, lw=1, arrow_length_ratio=0.2)
    axis.scatter(*world.places[-1].T, s=7, color="0.3", linewidths=0, label="true, last view")
    axis.plot([], [], color=MOVING, label="recovered, first view to last")
    low, high = world.places.flatten(0, 1).amin(0) - 0.1, world.places.flatten(0, 1).amax(0) + 0.1
    axis.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axis.set_box_aspect((high - low).tolist())
    axis.view_init(elev=14, azim=-60)
    axis.legend(fontsize=9)
    right = figure.add_axes((0.62, 0.12, 0.35, 0.78))
    for k, (name, values) in enumerate(curves.items()):
        right.plot([100 * s for s in shares], values, color=LINES[k], marker=MARKS[k], lw=2, label=name)
    right.set(yscale="log", xlabel="share of the joints' way off straight lines, %", ylabel="relative error")
    right.set_xscale("symlog", linthresh=3)
    right.set_xlim(-0.3, 115)
    right.set_xticks([100 * s for s in shares], [f"{100 * s:g}" for s in shares])
    right.grid(alpha=0.25)
    right.legend(fontsize=9)
    save(figure, path)


def drive_picture(world: World, found: Reconstruction, path: Path) -> None:
    """Corners of boxes from above: true ways, and recovered ones."""
    structure, _ = aligned(found, world.structure(found.motion.name))
    paths = torch.stack([places(structure, found, float(t)) for t in world.times])
    figure, axes = plt.subplots(1, 2, figsize=(9, 7), sharex=True, sharey=True, layout="constrained")
    for axis, those, title in zip(axes, (world.places, paths), ("true", f"recovered, {found.motion.name}"), strict=True):
        for mine, colour, name in ((~world.moving, STATIC, "parked"), (world.moving, MOVING, "moving")):
            axis.plot(*those[:, mine, :2].unbind(-1), color=colour, lw=0.8)
            axis.plot(*those[-1, mine, :2].T, ".", color=colour, ms=3, label=f"{name} ({int(mine.sum()) // 8} boxes)")
        low, high = world.places.flatten(0, 1).amin(0), world.places.flatten(0, 1).amax(0)
        axis.set(xlim=(low[0] - 5, high[0] + 5), ylim=(low[1] - 5, high[1] + 5), aspect="equal", xlabel="m", title=title)
        axis.grid(alpha=0.2)
    axes[0].legend(fontsize=9)
    save(figure, path)


if __name__ == "__main__":
    readme_picture(Path("docs/reconstruct.png"))
