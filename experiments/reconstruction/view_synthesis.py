"""Views of a moving scene that nobody took: another camera, another time (the use of the tensors of moving points by Wexler and
Shashua, 2000).

    python -m experiments.reconstruction.view_synthesis

A crossroads with eight cars (``experiments.reconstruction.crossroads``: drawn from formulas, flat, everything in one plane) is
seen in four
images by a flying, uncalibrated camera.  ``reconstruct`` finds the cameras and the velocities of the corners of the cars from
their tracks, with noise; tracks on the ground are known to stand still.  In its frame the plane is seen through the collineations
of the cameras, and a car at another time is the same car, shifted: the new view is every image warped by P_new inv(P_i), and for
a car by P_new T(v (t_new - t_i)) inv(P_i).  Where the new camera is, is said by where it sees the points at rest.

Compared, by peak signal to noise ratio, with the image that this camera would have taken then.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import torch
import tyro
from kornia.geometry.transform import warp_perspective
from torch import Tensor

import dyntorch as dyn
from dyntorch.geometry.homogeneous import apply
from dyntorch.tasks.reconstruct.result import Reconstruction
from experiments.common.runner import BaseConfig, Tables, Words, experiment
from experiments.common.tables import note
from experiments.reconstruction.crossroads import CARS, HEIGHT, SAMPLES, WIDTH, camera, observe, render
from indexing.files import prepare

TIMES = (0.0, 1.0, 2.3, 3.0)
FLIGHT = ((-17.0, -24.0, 37.0), (-8.0, -31.0, 35.0), (4.0, -30.0, 36.0), (13.0, -25.0, 39.0))
"""Where the camera was at these times, metres."""
UNSEEN = ((0.5, (-12.0, -29.0, 38.0)), (1.6, (1.0, -24.0, 40.0)), (4.0, (9.0, -31.0, 35.0)))
"""Times and places of the new views: the last is after all images."""
MARGIN = 1.2  # the ground is not taken from so many sizes of a car around its middle


@dataclass(frozen=True)
class Config(BaseConfig):
    """Synthesis of unseen views of a crossroads."""

    sigma: float = 0.3
    """Noise of a coordinate of the tracks, pixels."""
    still: int = 40
    """Tracks on the ground."""
    picture: Annotated[Path, tyro.conf.arg(metavar="FILE")] = Path("docs/view_synthesis.png")
    """Where the picture is written."""


class Scene(NamedTuple):
    """What is known of the scene in one frame of the plane: cameras ``(views, 3, 3)``, outlines of the moving patches at time 0
    ``(patches, 4, 2)``, and their velocities ``(patches, 2)``."""

    cameras: Tensor
    outlines: Tensor
    velocities: Tensor


class Synthesis(NamedTuple):
    """An image ``(3, HEIGHT, WIDTH)``, which of its pixels any image shows, and which show moving patches."""

    image: Tensor
    covered: Tensor
    moving: Tensor


# ---- the method ----------------------------------------------------------------------------------------------------------
def synthesize(images: Tensor, times: Sequence[float], scene: Scene, view: Tensor, time: float) -> Synthesis:
    """What a camera ``(3, 3)`` sees at a time, from images ``(views, 3, HEIGHT, WIDTH)`` that others took at other times."""
    back = torch.linalg.inv(scene.cameras)
    seen = torch.ones(len(images), 1, HEIGHT, WIDTH, dtype=images.dtype)
    cars = [_covers(P, scene.outlines + t * scene.velocities[:, None], MARGIN) for P, t in zip(scene.cameras, times, strict=True)]
    bare = (1 - torch.stack(cars)[:, None]).floor()
    near = 1 / (0.05 + (torch.tensor(times, dtype=images.dtype) - time).square())
    image, covered = _blend(images, bare, view @ back, near)
    moving = torch.zeros_like(covered)
    for outline, velocity in zip(scene.outlines, scene.velocities, strict=True):
        shifts = torch.eye(3, dtype=images.dtype).repeat(len(times), 1, 1)
        shifts[:, :2, 2] = velocity * (time - torch.tensor(times, dtype=images.dtype))[:, None]
        patch, there = _blend(images, seen, view @ shifts @ back, near)
        cover = _cover(view, outline + time * velocity) * there
        image = torch.lerp(image, patch, cover)
        moving, covered = torch.maximum(moving, cover), torch.maximum(covered, (cover > 0).to(covered))
    return Synthesis(image, covered > 0, moving > 0.5)


def _blend(images: Tensor, usable: Tensor, maps: Tensor, near: Tensor) -> tuple[Tensor, Tensor]:
    """Mean of all images after collineations ``(views, 3, 3)``, nearer times first, and where there is any, 0 or 1."""
    # align_corners: whole numbers are the middles of pixels, in both images
    warped = warp_perspective(torch.cat([images * usable, usable], dim=1), maps, (HEIGHT, WIDTH), align_corners=True)
    weight = near[:, None, None, None] * (warped[:, 3:] > 0.999)
    total = weight.sum(0)
    image = (weight * warped[:, :3]).sum(0) / total.clamp(min=1e-9)
    return torch.where(total > 0, image, 0.85), (total[0] > 0).to(images)


def _cover(view: Tensor, outline: Tensor, grown: float = 1.0) -> Tensor:
    """Share ``(HEIGHT, WIDTH)`` of every pixel that a convex outline ``(4, 2)`` of the plane covers."""
    middle = outline.mean(0)
    corners = middle + grown * (outline - middle)
    inside = (torch.arange(SAMPLES, dtype=view.dtype) + 0.5) / SAMPLES - 0.5
    u, v = ((torch.arange(size, dtype=view.dtype)[:, None] + inside).flatten() for size in (WIDTH, HEIGHT))
    plane = apply(torch.linalg.inv(view), torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1))
    side = corners.roll(-1, 0) - corners
    away = plane[..., None, :] - corners
    turn = side[:, 0] * away[..., 1] - side[:, 1] * away[..., 0]
    within = (turn > 0).all(-1) | (turn < 0).all(-1)
    return within.to(view).reshape(HEIGHT, SAMPLES, WIDTH, SAMPLES).mean(dim=(1, 3))


def _covers(view: Tensor, outlines: Tensor, grown: float = 1.0) -> Tensor:
    """The same of several outlines ``(patches, 4, 2)``, of which one covers most."""
    return torch.stack([_cover(view, outline, grown) for outline in outlines]).amax(0)


def scene_of(found: Reconstruction) -> Scene:
    """The patches of a reconstruction whose tracks begin with four corners of every car."""
    count = 4 * len(CARS)
    assert found.velocities is not None
    return Scene(found.cameras, found.points[:count].unflatten(0, (-1, 4)), found.velocities[:count].unflatten(0, (-1, 4)).mean(1))


def resected(plane: Tensor, pixels: Tensor) -> Tensor:
    """The camera ``(3, 3)`` that sees points ``(n, 2)`` of the plane at these pixels."""
    return dyn.fit(dyn.Collineation(2), pixels, plane).check().tensor


# ---- the comparison ------------------------------------------------------------------------------------------------------
METHODS = ("nearest image", "cross-fade", "plane alone", "synthesized", "true scene")
"""The image nearest in time as it is; the two around the time mixed; the nearest one warped as if nothing moved; ours; and ours
with the true cameras and velocities, which is what sampling of pixels leaves."""


def compare(images: Tensor, found: Scene, true: Scene, view: Tensor, place: Tensor, time: float) -> dict[str, Any]:
    """All methods for one new view: images and figures.

    Args:
        images: ``(views, 3, HEIGHT, WIDTH)``.
        found: as reconstructed.
        true: as it is.
        view: the new camera in the frame of ``found``.
        place: the new camera in the frame of ``true``.
        time: of the new view.
    """
    truth = render(place, time)
    ours, best = synthesize(images, TIMES, found, view, time), synthesize(images, TIMES, true, place, time)
    nearest = min(range(len(TIMES)), key=lambda i: abs(TIMES[i] - time))
    one = images[nearest : nearest + 1]
    flat, _ = _blend(one, torch.ones_like(one[:, :1]), view @ torch.linalg.inv(found.cameras[nearest])[None], torch.ones(1))
    shown = dict(zip(METHODS, (images[nearest], _faded(images, time), flat, ours.image, best.image), strict=True))
    cars = ours.covered & (_covers(place, true.outlines + time * true.velocities[:, None]) > 0)
    return {
        "time": time,
        "covered": float(ours.covered.double().mean()),
        "psnr": {name: psnr(image, truth, ours.covered) for name, image in shown.items()},
        "psnr_cars": {name: psnr(image, truth, cars) for name, image in shown.items()},
        "image": ours.image,
        "truth": truth,
    }


def psnr(image: Tensor, truth: Tensor, where: Tensor) -> float:
    """Peak signal to noise ratio in dB over some pixels ``(HEIGHT, WIDTH)``."""
    return float(-10 * (image - truth)[:, where].square().mean().log10())


def _faded(images: Tensor, time: float) -> Tensor:
    """The images before and after a time, mixed; the last one after all."""
    after = next((i for i, t in enumerate(TIMES) if t >= time), len(TIMES) - 1)
    before = max(0, after - 1)
    return torch.lerp(images[before], images[after], min(1.0, (time - TIMES[before]) / (TIMES[after] - TIMES[before])))


def table(rows: Sequence[dict[str, Any]]) -> Words:
    """The figures in words."""
    lines = []
    for row in rows:
        name = f"t = {row['time']:g}, {100 * row['covered']:.0f} % covered"
        lines.append([name, *(f"{row['psnr'][m]:.1f} / {row['psnr_cars'][m]:.1f}" for m in METHODS)])
    return Words(["PSNR in dB: all / cars", *METHODS], lines)


def picture(images: Tensor, tracks: Tensor, rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Images with the tracks, new views, and what is true."""
    from io import BytesIO

    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from PIL import Image

    count, gap = len(images), 0.14
    small, large = (9.4 - gap * (count - 1)) / count, (9.4 - gap * (len(rows) - 1)) / len(rows)
    first = 0.28 + 0.75 * small + 0.36
    second = first + 0.75 * large + 0.32
    tall = second + 0.75 * large + 0.1
    figure = Figure(figsize=(10.0, tall), dpi=96)
    FigureCanvasAgg(figure)

    def panel(left: float, top: float, width: float, image: Tensor, title: str, colour: str = "#59636d") -> Any:
        axes = figure.add_axes((left / 10, 1 - (top + 0.75 * width) / tall, width / 10, 0.75 * width / tall))
        axes.imshow(image.permute(1, 2, 0).numpy(), interpolation="lanczos")
        axes.set(xticks=[], yticks=[], xlim=(-0.5, WIDTH - 0.5), ylim=(HEIGHT - 0.5, -0.5))
        axes.set_title(title, fontsize=9, loc="left", color="#1b2126", pad=3)
        for spine in axes.spines.values():
            spine.set(color=colour, linewidth=1.4)
        return axes

    for i, (image, time) in enumerate(zip(images, TIMES, strict=True)):
        axes = panel(0.5 + i * (small + gap), 0.28, small, image, f"image {i + 1}, t = {time:g}")
        cars = 4 * len(CARS)
        axes.scatter(*tracks[i, cars:].T, s=5, color="white", linewidth=0)
        axes.scatter(*tracks[i, :cars].T, s=5, color="#ff2fa0", linewidth=0)
    for j, row in enumerate(rows):
        figures = row["psnr"]
        title = f"t = {row['time']:g}:  {figures['synthesized']:.1f} dB   (nearest image {figures['nearest image']:.1f})"
        panel(0.5 + j * (large + gap), first, large, row["image"], title, "#e8741e")
        panel(0.5 + j * (large + gap), second, large, row["truth"], f"t = {row['time']:g}, as it would be seen")
    for text, top, height in (("given, with tracks", 0.28, small), ("synthesized", first, large), ("true", second, large)):
        figure.text(0.03, 1 - (top + 0.375 * height) / tall, text, rotation=90, va="center", fontsize=10, color="#1b2126")
    stream = BytesIO()
    figure.savefig(stream, facecolor="white", metadata={"Software": None})
    prepare(path.parent)
    # few colours, chosen to cover all that occur: the bright cars are few pixels
    few = Image.open(stream).convert("RGB").quantize(200, method=Image.Quantize.MAXCOVERAGE, kmeans=4, dither=Image.Dither.NONE)
    few.save(path, optimize=True)


@experiment(Config())
def tables(config: Config) -> Tables:
    """Draw, reconstruct, synthesize, compare."""
    generator = torch.Generator().manual_seed(config.seed)
    cameras = torch.stack([camera(place) for place in FLIGHT])
    still = (torch.rand(config.still, 2, generator=generator, dtype=torch.float64) - 0.5) * torch.tensor([40.0, 34.0])
    tracks = observe(cameras, TIMES, still, config.sigma, generator)
    kept = tracks.isfinite().all(-1).sum(0) > 1
    tracks, still = tracks[:, kept], still[kept[4 * len(CARS) :]]
    static = torch.arange(tracks.shape[1]) >= 4 * len(CARS)
    found = dyn.reconstruct(tracks, "constant_velocity_2d", TIMES, static=static, threshold=torch.inf).check()
    note(f"{found!r}")
    images = torch.stack([render(P, t) for P, t in zip(cameras, TIMES, strict=True)])
    true = Scene(
        cameras, torch.stack([c.corners(0.0) for c in CARS]), torch.tensor([c.velocity for c in CARS], dtype=torch.float64)
    )
    rows = []
    known = found.points.isfinite().all(-1) & static
    for time, place in UNSEEN:
        view = resected(found.points[known], apply(camera(place), still[known[static]]))
        rows.append(compare(images, scene_of(found), true, view, camera(place), time))
    yield "PSNR of views that nobody took", table(rows)
    picture(images, tracks, rows, config.picture)
