"""What the battery knows of each invariant: one entry per invariant, written from its definition and not from the library."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

import dyntorch as dyn
from dyntorch import metrics, scenes
from dyntorch.core.invariant import Invariant
from dyntorch.core.primitives import Hyperplane, Line
from dyntorch.scenes import Scene
from tests.battery.epipolar import (
    Motion,
    epipolar_error,
    epipolar_truth,
    lift,
    on_either_epipolar_line,
    on_either_line_in_plane,
    on_epipolar_line,
    parts_error,
    traffic,
    two_bodies,
    two_centres_errors,
    two_epipolar_errors,
    two_epipolar_truths,
)
from tests.battery.projections import collinear_images, in_a_flat, lifted, on_image_lines, seen, tensor_error

PIXELS = (1 / 250.0, (320.0, 240.0))
"""Scale and centre that bring the pictures of the planar scenes to order 1."""


LINES = (1 / 120.0, (320.0, 240.0))
"""The same for lines, whose distances from the centre are less than those of points; noise in the angle is in these units."""

IMAGE = (1 / 350.0, (500.0, 500.0))
"""The same for pictures of lifted scenes."""


@dataclass(frozen=True)
class Case:
    """One invariant and its ground truth."""

    invariant: Invariant
    make: Callable[..., Scene]
    """A scene with n=, batch=, sigma=, outliers=, generator= (and static=, where ``moves``)."""
    nullity: int
    """Dimension of the null space of the estimation matrix, by the theory."""
    error: Callable[[Motion, Motion], Tensor]
    """Error ``(*batch,)`` of an estimated motion against the true one, blind to what the invariant leaves open."""
    conditions: Callable[..., Tensor]
    """What the exact coordinates of one match fulfil: conditions(motion, *measurements) -> (c,)."""
    minimal: int
    """Fewest matches, by the theory."""
    noise: float = 2e-3
    """Typical standard deviation, where the scene is of order 1."""
    moves: bool = False
    """Whether the matches may move; then all static ones are degenerate."""
    labelled: dict[int, int] = field(default_factory=dict)
    """By the theory: moving matches needed beside so many that are labelled static."""
    outliers: float = 0.3
    """Share that robust estimation has to stand."""
    draw: int = 0
    """Seed of the random starts of robust estimation."""
    units: tuple[float, tuple[float, ...]] | None = None
    """Scale and centre that bring the scene to order 1."""
    truth: Callable[[Motion], Motion] = lambda motion: motion
    """The motion of a scene in the parts that the invariant has."""
    projected: bool = False
    """Whether distances are those to the nearest exact match itself, not the first order of it."""
    follows: Callable[[Invariant, tuple[Tensor, ...]], Invariant] = lambda invariant, frames: invariant
    """The invariant after a change of coordinates of every view."""

    def raw(self, n: int, *, seed: int = 0, **options: object) -> Scene:
        """A scene in the coordinates in which it is measured."""
        scene = self.make(n=n, generator=torch.Generator().manual_seed(seed), **options)
        return replace(scene, motion=self.truth(scene.motion))

    def scene(self, n: int, **options: object) -> Scene:
        """A scene with coordinates of order 1."""
        scene = self.raw(n, **options)
        if self.units is None:
            return scene
        scale, centre = self.units
        frame = torch.diag(torch.tensor([scale] * len(centre) + [1.0], dtype=torch.float64))
        frame[:-1, -1] = -scale * torch.tensor(centre, dtype=torch.float64)
        frames = (frame,) * len(scene.views)
        move = partial(moved_views, self.invariant, frames=frames)
        return replace(
            scene, views=move(scene.views), exact=move(scene.exact), motion=carried(self.invariant, scene.motion, frames)
        )

    def __repr__(self) -> str:
        return (
            repr(self.invariant).replace("third=", "").replace("measure=", "").replace("n=", "").replace("'", "").replace(" ", "")
        )


def project(p: Tensor) -> Tensor:
    return p[..., :-1] / p[..., -1:]


def times(matrix: Tensor, x: Tensor) -> Tensor:
    """Points ``(..., d)`` mapped by one matrix or by one each."""
    return project((matrix @ lift(x)[..., None])[..., 0])


def moved(primitive: object, x: Tensor, frame: Tensor) -> Tensor:
    """A measurement ``(*batch, n, ...)`` after a collineation ``(*batch, d+1, d+1)`` of its view."""
    if isinstance(primitive, Hyperplane):
        image = x @ torch.linalg.inv(frame)
        return image / image[..., :-1].norm(dim=-1, keepdim=True)
    if x.shape[-2:] == (2, 3) and isinstance(primitive, Line):
        return times(frame[..., None, None, :, :], x)
    return times(frame[..., None, :, :], x)


def moved_views(invariant: Invariant, views: tuple[Tensor, ...], frames: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    return tuple(moved(p, x, g) for p, x, g in zip(invariant.primitives, views, frames, strict=True))


def carried(invariant: Invariant, motion: Motion, frames: tuple[Tensor, ...]) -> Motion:
    """The motion after a change of coordinates of every view; what each part maps is checked against true motions elsewhere."""
    parts = []
    for part, frame in zip(motion, invariant.motion, strict=True):
        matrix = part[..., None] if frame.vector else part
        if frame.target is not None:
            matrix = (torch.linalg.inv(frames[frame.target]).mT if frame.dual else frames[frame.target]) @ matrix
        if frame.source is not None:
            matrix = matrix @ torch.linalg.inv(frames[frame.source])
        matrix = matrix / matrix.norm(dim=(-2, -1), keepdim=True)
        parts.append(matrix[..., 0] if frame.vector else matrix)
    return tuple(parts)


def affine_error(estimated: Motion, true: Motion) -> Tensor:
    """Up to an affinity of the world and a common velocity."""
    return metrics.affine_gauge(torch.stack(estimated, dim=-3), torch.stack(true, dim=-3))[1]


def prediction_error(estimated: Motion, true: Motion) -> Tensor:
    """How far the prediction of the third view of some points of the world is off, which is all that an image can tell."""
    points = torch.randn(2, 40, 3, generator=torch.Generator().manual_seed(1), dtype=true[0].dtype).to(true[0].device)
    p0, p1 = (times(m[..., None, :, :], x) for m, x in zip(true, points, strict=False))
    off = predicted(estimated, p0, p1) - predicted(true, p0, p1)
    return off.square().sum(-1).mean(-1).sqrt().nan_to_num(nan=torch.inf)


def predicted(motion: Motion, p0: Tensor, p1: Tensor) -> Tensor:
    y0, y1 = (times(torch.linalg.inv(m)[..., None, :, :], p) for m, p in zip(motion, (p0, p1), strict=False))
    return times(motion[2][..., None, :, :], 2 * y1 - y0)


def agree(motion: Motion, x1: Tensor, *others: Tensor) -> Tensor:
    return torch.cat([times(m, x) - x1 for m, x in zip(motion, others, strict=True)])


def collinear_in_plane(motion: Motion, x1: Tensor, x2: Tensor, x3: Tensor) -> Tensor:
    return torch.linalg.det(torch.stack([lift(x1), motion[0] @ lift(x2), motion[1] @ lift(x3)]))[None]


def concurrent(motion: Motion, l1: Tensor, l2: Tensor, l3: Tensor) -> Tensor:
    back = [torch.linalg.inv(m).mT for m in motion]
    return torch.linalg.det(torch.stack([l1, back[0] @ l2, back[1] @ l3]))[None]


def collinear_in_space(motion: Motion, x1: Tensor, x2: Tensor, x3: Tensor) -> Tensor:
    return torch.linalg.cross(times(motion[0], x2) - x1, times(motion[1], x3) - x1)


def constant_velocity(motion: Motion, x1: Tensor, x2: Tensor, x3: Tensor) -> Tensor:
    y = [times(torch.linalg.inv(m), x) for m, x in zip(motion, (x1, x2, x3), strict=True)]
    return y[0] - 2 * y[1] + y[2]


def seen_at_constant_velocity(motion: Motion, x1: Tensor, x2: Tensor, x3: Tensor) -> Tensor:
    return predicted(motion, x1[None], x2[None])[0] - x3


def coplanar(motion: Motion, l1: Tensor, l2: Tensor) -> Tensor:
    return torch.linalg.det(torch.cat([lift(l1), lift(l2) @ motion[0].mT]))[None]


def other_cameras(invariant: Invariant, frames: tuple[Tensor, ...]) -> Invariant:
    """The same cameras of view 3 in other coordinates of it."""
    cameras = invariant.primitives[2].cameras  # type: ignore[attr-defined]
    return dyn.MinimalJoinTensor(cameras @ torch.linalg.inv(frames[2]))


def still_points(**options: object) -> Scene:
    return scenes.planar(**options, static=1.0)  # type: ignore[arg-type]


def grassmann(k: int, profile: tuple[int, ...], make: Callable[..., Scene], minimal: int, *, dims: int = 2, **options: Any) -> Case:
    """A Grassmann tensor; distances are the first order of one condition, or those to the nearest exact match."""
    projected = dims * len(profile) - k > 1
    error, units = partial(tensor_error, profile), None if dims == 3 else IMAGE
    return Case(dyn.GrassmannTensor(k, profile, dims), make, 1, error, seen, minimal, projected=projected, units=units, **options)


def dynamic(n: int, views: int, step: int, minimal: int, **options: Any) -> Case:
    """Points that move within flats; distances are those to the nearest exact match, where one equation is not all there is."""
    invariant = dyn.DynamicTensor(n, views, step)
    make = partial(scenes.dynamic, n, views, step)
    several = (n + 1) ** views - minimal
    projected = (views - step) * (n + 1 - step) > 1
    moves = {"moves": step > 1, **options}
    return Case(invariant, renamed(make), several, parts_error, partial(in_a_flat, step), minimal, projected=projected, **moves)


def renamed(make: Callable[..., Scene]) -> Callable[..., Scene]:
    """``n`` is the dimension of the space there, and the number of matches here."""

    def made(n: int, **options: Any) -> Scene:
        return make(n, **options)

    return made


JOIN_LABELLED = {0: 60, 1: 50, 2: 40, 3: 30, 4: 20, 5: 10, 6: 4, 7: 0}
PLANE = {"moves": True, "labelled": {0: 26, 1: 19, 2: 12, 3: 5, 4: 0}}
SPACE = {"moves": True, "outliers": 0.2}
CASES = (
    Case(dyn.FundamentalMatrix(), scenes.two_view, 1, epipolar_error, on_epipolar_line, 8, units=PIXELS, truth=epipolar_truth),
    *(Case(dyn.Collineation(n), partial(scenes.collineation, n), 1, parts_error, agree, n + 2) for n in (1, 2, 3)),
    Case(dyn.HomographyTensor(), scenes.planar, 1, parts_error, collinear_in_plane, 26, units=PIXELS, **PLANE),
    Case(dyn.DualHomographyTensor(), scenes.lines_concurrent, 1, parts_error, concurrent, 26, units=LINES, **PLANE),
    Case(dyn.DualHomographyTensor("points"), still_points, 1, parts_error, agree, 4, units=PIXELS),
    Case(dyn.JoinTensor(), scenes.moving_points, 4, parts_error, collinear_in_space, 60, labelled=JOIN_LABELLED, **SPACE),
    Case(dyn.MinimalJoinTensor(), scenes.moving_points, 1, parts_error, collinear_in_space, 47, follows=other_cameras, **SPACE),
    Case(dyn.ConstantVelocityTensor(), scenes.constant_velocity, 1, affine_error, constant_velocity, 21, **SPACE),
    Case(
        dyn.ConstantVelocityTensor("image"),
        partial(scenes.constant_velocity, camera=True),
        1,
        prediction_error,
        seen_at_constant_velocity,
        24,
        **SPACE,
    ),
    Case(
        dyn.TranslatingLinesMatrix(),
        scenes.translating_lines,
        1,
        parts_error,
        coplanar,
        35,
        moves=True,
        draw=1,  # six draws of sixteen find both motions; the others say NO_CONSENSUS
    ),
    Case(
        dyn.SegmentationMatrix(),
        two_bodies,
        1,
        two_epipolar_errors,
        on_either_epipolar_line,
        35,
        noise=2e-4,
        outliers=0.03,
        units=PIXELS,
        truth=two_epipolar_truths,
    ),
    Case(
        dyn.ConvergentMotionMatrix(),
        traffic,
        1,
        two_centres_errors,
        on_either_line_in_plane,
        35,
        noise=2e-4,
        outliers=0.03,
        draw=1,  # three draws of 24 find both motions of the first scene; most of the others say AMBIGUOUS
        units=PIXELS,
    ),
    grassmann(3, (2, 2), lifted("static_3d", (0, 1), jitter=1.0), 8),
    grassmann(3, (2, 1, 1), lifted("static_3d", (0, 1, 2)), 7),
    grassmann(3, (1, 1, 1, 1), lifted("static_3d", (0, 1, 2, 3)), 6),
    grassmann(4, (2, 2, 1), lifted("constant_velocity_2d", (0, 4, 9)), 13, moves=True),
    grassmann(5, (2, 2, 2), lifted("constant_velocity_planes_3d", (0, 4, 9)), 26, moves=True),
    grassmann(5, (2, 2, 1, 1), lifted("constant_velocity_planes_3d", (0, 4, 9, 13)), 20, moves=True),
    grassmann(6, (2, 2, 2, 1), lifted("constant_velocity_3d", (0, 4, 9, 13)), 40, moves=True),
    grassmann(6, (3, 3, 1), lifted("constant_velocity_3d_sensors", (0, 4, 9)), 21, dims=3, moves=True),
    dynamic(1, 3, 1, 4),
    dynamic(2, 4, 2, 72, outliers=0.2),
    Case(dyn.GrassmannTensor(2, (1, 1, 1), dual=True), collinear_images, 1, partial(tensor_error, (1, 1, 1)), on_image_lines, 26),
)
