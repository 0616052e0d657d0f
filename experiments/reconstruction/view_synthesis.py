"""Views of a moving scene that nobody took: another camera, another time (the use of the tensors of moving points by Wexler and
Shashua, 2000).

    python -m experiments.reconstruction.view_synthesis

A crossroads with eight cars (``experiments.reconstruction.view_synthesis``: drawn from formulas, flat, everything in one plane) is
seen in four
images by a flying, uncalibrated camera.  ``reconstruct`` finds the cameras and the velocities of the corners of the cars from
their tracks, with noise; tracks on the ground are known to stand still.  In its frame the plane is seen through the collineations
of the cameras, and a car at another time is the same car, shifted: the new view is every image warped by P_new inv(P_i), and for
a car by P_new T(v (t_new - t_i)) inv(P_i).  Where the new camera is, is said by where it sees the points at rest.

Compared, by peak signal to noise ratio, with the image that this camera would have taken then.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import torch
import tyro
from kornia.geometry.transform import warp_perspective
from torch import Tensor

import dyntorch as dyn
from dyntorch.geometry.homogeneous import apply, homogeneous, inhomogeneous
from dyntorch.scenes.scene import looking_at
from dyntorch.tasks.reconstruct.result import Reconstruction
from experiments.common.runner import BaseConfig, Tables, Words, experiment
from experiments.common.tables import note
from indexing.files import prepare

WIDTH, HEIGHT, FOCAL = 320, 240, 330.0  # pixels
SAMPLES = 2  # per pixel and axis: what a lens does against aliasing
ROAD, WALK = 6.0, 8.2  # metres from the middle of a road to its edge, and to the end of the pavement
GLASS = (0.13, 0.17, 0.22)
TREES = (
    (-13, 12, 2.6), (-19, 17, 3.1), (-12, 20, 2.2), (14, 13, 3.0), (21, 11, 2.3), (16, 21, 2.7), (-15, -13, 2.9), (-22, -12, 2.4),
    (-12, -20, 2.5), (12, -14, 2.3), (19, -20, 3.2), (27, -13, 2.6), (-27, 12, 2.5), (28, 18, 2.9), (-28, -20, 3.0),
)  # fmt: skip
"""x, y and radius of their crowns, metres."""


@dataclass(frozen=True)
class Car:
    """A moving patch of the plane.

    Attributes:
        middle: where its middle is at time 0, metres.
        velocity: metres per unit of time; it points where the car does.
        colour: of its paint.
        size: length and width, metres.
    """

    middle: tuple[float, float]
    velocity: tuple[float, float]
    colour: tuple[float, float, float]
    size: tuple[float, float] = (5.0, 2.3)

    @property
    def heading(self) -> tuple[float, float]:
        """Unit vector along the car."""
        speed = math.hypot(*self.velocity)
        return self.velocity[0] / speed, self.velocity[1] / speed

    def corners(self, time: float) -> Tensor:
        """``(4, 2)`` at a time, in order around the car."""
        (cos, sin), (length, width) = self.heading, self.size
        turn = torch.tensor([[cos, -sin], [sin, cos]], dtype=torch.float64)
        box = torch.tensor([[1, 1], [1, -1], [-1, -1], [-1, 1]], dtype=torch.float64) * torch.tensor([length / 2, width / 2])
        return box @ turn.mT + self.place(time)

    def place(self, time: float) -> Tensor:
        """``(2,)`` its middle at a time."""
        start, way = (torch.tensor(v, dtype=torch.float64) for v in (self.middle, self.velocity))
        return start + time * way

    def paint(self, plane: Tensor, time: float) -> tuple[Tensor, Tensor]:
        """Colours ``(..., 3)`` at points ``(..., 2)`` of the plane, and where the car covers them."""
        (cos, sin), (length, width) = self.heading, self.size
        away = plane - self.place(time)
        along, across = away[..., 0] * cos + away[..., 1] * sin, away[..., 1] * cos - away[..., 0] * sin
        inside = (along.abs() < length / 2) & (across.abs() < width / 2)
        colour = torch.tensor(self.colour, dtype=torch.float64) * (1.06 - 0.16 * (2 * across / width).square())[..., None]
        panes = ((along - 0.13 * length).abs() < 0.07 * length) | ((along + 0.3 * length).abs() < 0.06 * length)
        pane = (across.abs() < 0.42 * width) & panes
        lamp = (along > 0.44 * length) & (across.abs() > 0.26 * width)
        brake = (along < -0.46 * length) & (across.abs() > 0.24 * width)
        for where, value in ((pane, GLASS), (lamp, (1.0, 0.97, 0.8)), (brake, (0.75, 0.08, 0.08))):
            colour = torch.where(where[..., None], torch.tensor(value, dtype=torch.float64), colour)
        return colour, inside


CARS = (
    Car((-17.0, -1.6), (5.5, 0.0), (0.84, 0.16, 0.13)),
    Car((-9.0, -4.4), (4.4, 0.0), (0.95, 0.95, 0.93), (7.4, 2.6)),
    Car((13.0, 1.6), (-5.0, 0.0), (0.13, 0.38, 0.78)),
    Car((21.0, 4.3), (-6.5, 0.0), (0.97, 0.74, 0.12)),
    Car((1.6, -18.5), (0.0, 2.3), (0.20, 0.62, 0.42)),
    Car((4.3, 9.5), (0.0, 3.4), (0.93, 0.48, 0.12)),
    Car((-1.6, -7.5), (0.0, -2.4), (0.52, 0.24, 0.62)),
    Car((-4.4, 22.5), (0.0, -2.4), (0.16, 0.70, 0.78)),
)


def noise(plane: Tensor, cell: float, seed: int) -> Tensor:
    """``(...)`` smooth random values from -1 to 1 over points ``(..., 2)``, that change from cell to cell of a lattice."""
    lattice = torch.rand(64, 64, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * 2 - 1
    place = plane / cell
    low = place.floor()
    share = (place - low).square() * (3 - 2 * (place - low))
    i, j = (low.long() % 64).unbind(-1)
    k, m = (i + 1) % 64, (j + 1) % 64
    first = torch.lerp(lattice[i, j], lattice[k, j], share[..., 0])
    return torch.lerp(first, torch.lerp(lattice[i, m], lattice[k, m], share[..., 0]), share[..., 1])


def ground(plane: Tensor) -> Tensor:
    """Colours ``(..., 3)`` of the ground at points ``(..., 2)``: lawns, trees, pavements, and two roads with their marks."""
    x, y = plane.unbind(-1)
    near, far = torch.minimum(x.abs(), y.abs()), torch.maximum(x.abs(), y.abs())  # from the road, and from the crossing
    along = torch.where(x.abs() < y.abs(), y, x)
    grain = noise(plane, 0.6, 1)

    def laid(under: Tensor, where: Tensor, colour: Sequence[float], rough: float = 0.0) -> Tensor:
        over = torch.tensor(colour, dtype=torch.float64) + rough * grain[..., None]
        return torch.where(where[..., None], over, under)

    lawn = torch.tensor((0.50, 0.63, 0.36), dtype=torch.float64) + 0.06 * noise(plane, 3.1, 2)[..., None] + 0.015 * grain[..., None]
    out = lawn
    for left, bottom, radius in TREES:
        away = (plane - torch.tensor((left, bottom), dtype=torch.float64)).norm(dim=-1) + 0.35 * noise(plane, 1.1, 3)
        out = laid(out, away < radius, (0.22, 0.42, 0.24), 0.03)
        out = laid(out, away < 0.55 * radius, (0.30, 0.51, 0.29), 0.03)
    out = laid(out, near < WALK, (0.80, 0.77, 0.71), 0.015)
    out = laid(out, (near < WALK) & (near > ROAD) & ((along % 2.2) < 0.18), (0.70, 0.67, 0.62))
    out = laid(out, near < ROAD, (0.43, 0.45, 0.48), 0.012)
    out = laid(out, (near < 0.16) & (far > 12.2), (0.95, 0.82, 0.35))
    out = laid(out, ((near - 3.0).abs() < 0.13) & (far > 12.2) & ((along % 4.0) < 2.2), (0.93, 0.93, 0.91))
    crossing = (near < ROAD - 0.4) & (far > WALK) & (far < WALK + 2.8) & ((torch.where(x.abs() < y.abs(), x, y) % 1.5) < 0.8)
    return laid(out, crossing, (0.93, 0.93, 0.91))


def camera(position: Sequence[float], target: Sequence[float] = (0.0, 0.0)) -> Tensor:
    """``(3, 3)`` from the plane, in metres, to pixels, for a camera above it that looks at a point of it."""
    K = torch.tensor([[FOCAL, 0.0, (WIDTH - 1) / 2], [0.0, FOCAL, (HEIGHT - 1) / 2], [0.0, 0.0, 1.0]], dtype=torch.float64)
    centre, aim = torch.tensor(position, dtype=torch.float64), torch.tensor((*target, 0.0), dtype=torch.float64)
    return (K @ looking_at(centre, aim, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)))[:, [0, 1, 3]]


def render(view: Tensor, time: float) -> Tensor:
    """The image ``(3, HEIGHT, WIDTH)`` that a camera takes at a time, values from 0 to 1; the middle of a pixel is whole."""
    inside = (torch.arange(SAMPLES, dtype=torch.float64) + 0.5) / SAMPLES - 0.5
    u, v = ((torch.arange(size, dtype=torch.float64)[:, None] + inside).flatten() for size in (WIDTH, HEIGHT))
    pixels = torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1)
    plane = apply(torch.linalg.inv(view), pixels)
    out = ground(plane)
    for car in CARS:
        colour, covered = car.paint(plane, time)
        out = torch.where(covered[..., None], colour, out)
    return out.clamp(0, 1).reshape(HEIGHT, SAMPLES, WIDTH, SAMPLES, 3).mean(dim=(1, 3)).permute(2, 0, 1)


def observe(views: Tensor, times: Sequence[float], still: Tensor, sigma: float, generator: torch.Generator) -> Tensor:
    """Tracks ``(views, 4 cars + n, 2)`` of the cars' corners and of points ``(n, 2)`` at rest; NaN where they are not seen."""
    seen = []
    for view, time in zip(views, times, strict=True):
        plane = torch.cat([*(car.corners(time) for car in CARS), still])
        pixels = inhomogeneous(homogeneous(plane) @ view.mT)
        pixels = pixels + sigma * torch.randn(pixels.shape, generator=generator, dtype=torch.float64)
        size = torch.tensor([WIDTH - 1.0, HEIGHT - 1.0], dtype=torch.float64)
        hidden = torch.zeros(len(plane), dtype=torch.bool)
        for car in CARS:
            hidden[4 * len(CARS) :] |= car.paint(still, time)[1]
        lost = hidden | ((pixels < 0) | (pixels > size)).any(-1)
        seen.append(torch.where(lost[:, None], torch.nan, pixels))
    return torch.stack(seen)


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
