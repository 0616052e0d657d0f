"""Takes of two cameras without a point in common, drawn anew from the models of the thesis's chapter 7, with the true clocks.

Points of the second camera are fixed affine combinations of points of the first at every moment: bodies that turn and travel,
chains of such bodies, bodies that stay in one plane, and points between free ones.  Motion is a sum of sines, known at any
moment, so that clocks may differ by fractions of frames and in their rates.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Generator, Tensor

from experiments.synchronization.data import Pair, draw, seeded

KINDS = ("rigid", "articulated", "planar", "mixed")
CAMERAS = ("affine", "affine_moving", "perspective")
HARMONICS = 12
SLOWEST, FASTEST = 0.1, 0.85
"""Hz."""

Course = Callable[[Tensor], Tensor]
"""From seconds ``(T,)`` to ``(T, ...)``."""


@dataclass(frozen=True)
class Scene:
    """What is filmed and how.

    Attributes:
        kind: of the motion: ``"rigid"``, ``"articulated"`` (bodies hinged to the one before), ``"planar"`` (all in one plane), or
            ``"mixed"``: points between three to six free ones.
        motions: bodies.
        camera: ``"affine"``, ``"affine_moving"`` (both pan and zoom while they film) or ``"perspective"``.
        noise: px.
        seconds: of both films.
        fps: of a and b.
        points: of a and of b.
        foreign: points of b, of those, that move by themselves.
        reach: largest offset, seconds.
        near: perspective: distance of the nearest and farthest camera, in sizes of the scene.
    """

    kind: str = "rigid"
    motions: int = 1
    camera: str = "affine"
    noise: float = 0.5
    seconds: float = 8.0
    fps: tuple[float, float] = (25.0, 25.0)
    points: tuple[int, int] = (10, 9)
    foreign: int = 0
    reach: float = 1.2
    near: tuple[float, float] = (4.0, 9.0)


def take(scene: Scene, generator: Generator) -> Pair:
    """Both films."""
    offset = draw(-scene.reach, scene.reach, generator)
    counts = scene.points[0], scene.points[1] - scene.foreign
    film = _points(scene, counts, generator)
    own = wave((scene.foreign, 3), generator)
    at_a = torch.arange(round(scene.seconds * scene.fps[0]), dtype=torch.float64) / scene.fps[0]
    at_b = torch.arange(round(scene.seconds * scene.fps[1]), dtype=torch.float64) / scene.fps[1]
    first = film(at_a)[:, : counts[0]]
    second = torch.cat([film(at_b - offset)[:, counts[0] :], 0.7 * own(at_b)], dim=1)
    both = torch.cat([first, second], dim=1).flatten(0, 1) if len(first) == len(second) else first.flatten(0, 1)
    middle, size = both.mean(0), float((both - both.mean(0)).square().sum(-1).mean().sqrt())
    a, b = (_filmed((x - middle) / size, times, scene, generator) for x, times in ((first, at_a), (second, at_b)))
    wrong = torch.arange(scene.points[1]) >= counts[1]
    order = torch.randperm(scene.points[1], generator=generator)
    return Pair(f"{scene.kind} {scene.motions}", a, b[:, order], scene.fps, offset, 1.0, wrong[order], (scene.noise, scene.noise))


def drawn(scene: Scene, count: int, seed: int = 0) -> list[Pair]:
    """Takes of all kinds and of one to four motions in turn, each with a generator of its own."""
    found = []
    for index in range(count):
        kind, motions = KINDS[index % len(KINDS)], 1 + index // len(KINDS) % 4
        found.append(take(replace(scene, kind=kind, motions=motions), seeded(seed, index)))
    return found


def wave(shape: tuple[int, ...], generator: Generator) -> Course:
    """Smooth motion of about unit size in every coordinate."""
    pace = SLOWEST + (FASTEST - SLOWEST) * torch.rand(HARMONICS, *shape, generator=generator, dtype=torch.float64)
    size = torch.randn(HARMONICS, *shape, generator=generator, dtype=torch.float64) * math.sqrt(2 / HARMONICS)
    phase = 2 * math.pi * torch.rand(HARMONICS, *shape, generator=generator, dtype=torch.float64)

    def course(times: Tensor) -> Tensor:
        return (size * torch.sin(2 * math.pi * pace * times.reshape(-1, 1, *[1] * len(shape)) + phase)).sum(1)

    return course


def _points(scene: Scene, counts: tuple[int, int], generator: Generator) -> Course:
    """All points ``(T, n, 3)``, those of a first."""
    total = sum(counts)
    if scene.kind == "mixed":
        free = wave((2 + scene.motions, 3), generator)
        share = torch.softmax(2 * torch.randn(total, 2 + scene.motions, generator=generator, dtype=torch.float64), dim=1)
        return lambda times: torch.einsum("pk,tkd->tpd", share, free(times))
    whose = torch.cat([torch.arange(count) % scene.motions for count in counts])
    if scene.kind == "planar":
        turn, travel = wave((scene.motions,), generator), wave((scene.motions, 2), generator)
        place = torch.randn(total, 2, generator=generator, dtype=torch.float64)

        def planar(times: Tensor) -> Tensor:
            angle = 0.8 * turn(times)[:, whose]
            c, s = angle.cos(), angle.sin()
            rotated = torch.stack([c * place[:, 0] - s * place[:, 1], s * place[:, 0] + c * place[:, 1]], dim=-1)
            return torch.nn.functional.pad(0.7 * rotated + travel(times)[:, whose], (0, 1))

        return planar
    turn, travel = wave((scene.motions, 3), generator), wave((scene.motions, 3), generator)
    place = 0.7 * torch.randn(total, 3, generator=generator, dtype=torch.float64)
    hinge = torch.randn(scene.motions, 3, generator=generator, dtype=torch.float64)

    def bodies(times: Tensor) -> Tensor:
        rotation = rotations(0.6 * turn(times))
        origin = travel(times)
        if scene.kind == "articulated":
            for k in range(1, scene.motions):
                before = rotation[:, k - 1]
                at = origin[:, k - 1] + before @ hinge[k]
                rotation = torch.cat([rotation[:, :k], (before @ rotation[:, k])[:, None], rotation[:, k + 1 :]], dim=1)
                origin = torch.cat([origin[:, :k], at[:, None], origin[:, k + 1 :]], dim=1)
        return torch.einsum("tpij,pj->tpi", rotation[:, whose], place) + origin[:, whose]

    return bodies


def rotations(vector: Tensor) -> Tensor:
    """``(..., 3, 3)`` of rotation vectors ``(..., 3)``."""
    zero = torch.zeros_like(vector[..., 0])
    x, y, z = vector.unbind(-1)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
    return torch.linalg.matrix_exp(skew)


def _filmed(x: Tensor, times: Tensor, scene: Scene, generator: Generator) -> Tensor:
    """Px ``(T, n, 2)`` of points of unit size about the origin."""
    azimuth, elevation = draw(0, 2 * math.pi, generator), draw(-0.3, 0.6, generator)
    turned = rotations(torch.tensor([elevation, 0.0, 0.0]).double()) @ rotations(torch.tensor([0.0, azimuth, 0.0]).double())
    seen = x @ turned.T
    if scene.kind == "planar":  # the plane is seen from the side on which it is a plane
        seen = x @ (rotations(torch.tensor([0.5 + 0.6 * draw(0, 1, generator), 0.0, 0.0]).double()) @ turned[:, [0, 2, 1]]).T
    pixels = 200 * seen[..., :2] + torch.tensor([960.0, 540.0], dtype=torch.float64)
    if scene.camera == "perspective":
        distance = max(draw(*scene.near, generator), 1.0 - float(seen[..., 2].min()))
        pixels = 200 * distance * seen[..., :2] / (seen[..., 2:] + distance) + torch.tensor([960.0, 540.0], dtype=torch.float64)
    if scene.camera == "affine_moving":
        zoom, pan = 0.2 * wave((), generator)(0.2 * times), 100 * wave((2,), generator)(times)
        pixels = pixels * zoom.exp()[:, None, None] + pan[:, None]
    return pixels + scene.noise * torch.randn(pixels.shape, generator=generator, dtype=torch.float64)
