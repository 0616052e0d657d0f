"""Motion models by name: moving points as static points of P^k, their Grassmann tensor, and cameras that degenerate it.

Each model takes, besides its matches, the ``profile`` of its tensor (hyperplanes used of each view, which add up to k + 1), the
``times`` of the views (by default random, that is in general position) and the path of the ``camera``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import cycle

import numpy as np

from dyntorch.counting.exact import Configuration, Field, IntArray, Step, Views

CAMERAS = {
    "generic": "anywhere in each view",
    "fixed": "in one place, it may rotate and zoom",
    "constant_velocity": "its centre moves at constant velocity",
    "along": "at constant velocity along the direction or plane of the motion",
}
PATIENCE = 4
"""Points in a row that add nothing before no more are drawn; one of each body tells."""
SETTINGS = ("profile", "times", "camera", "points", "space", "image", "degree", "dim", "poses", "within")
"""Options that are no matches."""


def static_2d(
    field: Field, *, static: int | None = None, on_line: int = 0, profile: Sequence[int] = (2, 1), camera: str = "generic"
) -> list[Step]:  # fmt: skip
    """Points of a plane: homography matrix, P^2 -> P^2."""
    return _Lifted(field, 2, (), profile, camera=camera).static(static, on_line=on_line)


def static_3d(
    field: Field, *, static: int | None = None, on_plane: int = 0, on_line: int = 0, profile: Sequence[int] = (2, 2),
    camera: str = "generic",
) -> list[Step]:  # fmt: skip
    """Points of space: fundamental matrix, or by profile the trifocal and quadrifocal tensors, P^3 -> P^2."""
    return _Lifted(field, 3, (), profile, camera=camera).static(static, on_plane, on_line)


def constant_direction_2d(
    field: Field, *, moving: int | None = None, static: int = 0, on_line: int = 0,
    profile: Sequence[int] = (2, 1, 1), times: Sequence[int] = (), camera: str = "generic",
) -> list[Step]:  # fmt: skip
    """Points of a plane at constant speeds along one direction: Grassmann tensor P^3 -> P^2."""
    return _Lifted(field, 2, (1,), profile, times, camera).steps(moving, static, on_line=on_line)


def constant_velocity_2d(
    field: Field, *, moving: int | None = None, static: int = 0, equal_velocity: int = 0, linear_velocity: int = 0,
    on_line: int = 0, profile: Sequence[int] = (2, 2, 1), times: Sequence[int] = (), camera: str = "generic",
) -> list[Step]:  # fmt: skip
    """Points of a plane with constant velocities: Grassmann tensor P^4 -> P^2."""
    return _Lifted(field, 2, (2,), profile, times, camera).steps(moving, static, equal_velocity, linear_velocity, on_line=on_line)


def constant_acceleration_2d(
    field: Field, *, moving: int | None = None, static: int = 0, on_line: int = 0,
    profile: Sequence[int] = (2, 2, 2, 1), times: Sequence[int] = (), camera: str = "generic",
) -> list[Step]:  # fmt: skip
    """Points of a plane with constant accelerations: Grassmann tensor P^6 -> P^2."""
    return _Lifted(field, 2, (2, 2), profile, times, camera).steps(moving, static, on_line=on_line)


def constant_direction_3d(
    field: Field, *, moving: int | None = None, static: int = 0, on_plane: int = 0, on_line: int = 0,
    profile: Sequence[int] = (2, 2, 1), times: Sequence[int] = (),
    camera: str = "generic",
) -> list[Step]:  # fmt: skip
    """3D points at constant speeds along one direction: Grassmann tensor P^4 -> P^2."""
    return _Lifted(field, 3, (1,), profile, times, camera).steps(moving, static, on_plane=on_plane, on_line=on_line)


def constant_velocity_planes_3d(
    field: Field, *, moving: int | None = None, static: int = 0, equal_velocity: int = 0, linear_velocity: int = 0,
    on_plane: int = 0, on_line: int = 0,
    profile: Sequence[int] = (2, 2, 1, 1), times: Sequence[int] = (), camera: str = "generic",
) -> list[Step]:  # fmt: skip
    """3D points with constant velocities in parallel planes: Grassmann tensor P^5 -> P^2."""
    return _Lifted(field, 3, (2,), profile, times, camera).steps(
        moving, static, equal_velocity, linear_velocity, on_plane=on_plane, on_line=on_line
    )


def constant_velocity_3d(
    field: Field, *, moving: int | None = None, static: int = 0, equal_velocity: int = 0, linear_velocity: int = 0,
    planar_velocity: int = 0, on_plane: int = 0, on_line: int = 0,
    profile: Sequence[int] = (2, 2, 2, 1), times: Sequence[int] = (), camera: str = "generic",
) -> list[Step]:  # fmt: skip
    """3D points with constant velocities: Grassmann tensor P^6 -> P^2."""
    return _Lifted(field, 3, (3,), profile, times, camera).steps(
        moving, static, equal_velocity, linear_velocity, planar_velocity, on_plane=on_plane, on_line=on_line
    )


def constant_velocity_3d_sensors(
    field: Field, *, moving: int | None = None, static: int = 0, equal_velocity: int = 0, linear_velocity: int = 0,
    planar_velocity: int = 0, on_plane: int = 0, on_line: int = 0,
    profile: Sequence[int] = (3, 3, 1), times: Sequence[int] = (),
) -> list[Step]:  # fmt: skip
    """3D points with constant velocities, 3D sensors: Grassmann tensor P^6 -> P^3."""
    model = _Lifted(field, 3, (3,), profile, times, sensor=3)
    return model.steps(moving, static, equal_velocity, linear_velocity, planar_velocity, on_plane=on_plane, on_line=on_line)


def two_bodies_2d(
    field: Field, *, moving: int | None = None, objects: Sequence[int] = (), profile: Sequence[int] = (2, 2),
    camera: str = "generic",
) -> list[Step]:  # fmt: skip
    """Points of two bodies in a plane that translate against each other: Grassmann tensor P^3 -> P^2."""
    return _Lifted(field, 2, (), profile, camera=camera, bodies=2).bodies(moving, objects)


def two_bodies_3d(
    field: Field, *, moving: int | None = None, objects: Sequence[int] = (), profile: Sequence[int] = (2, 2, 1),
    camera: str = "generic",
) -> list[Step]:  # fmt: skip
    """Points of two bodies in space that translate against each other: Grassmann tensor P^4 -> P^2."""
    return _Lifted(field, 3, (), profile, camera=camera, bodies=2).bodies(moving, objects)


MOTIONS: tuple[Configuration, ...] = (
    static_2d, static_3d, constant_direction_2d, constant_velocity_2d, constant_acceleration_2d, constant_direction_3d,
    constant_velocity_planes_3d, constant_velocity_3d, constant_velocity_3d_sensors, two_bodies_2d, two_bodies_3d,
)  # fmt: skip


class _Lifted:
    r"""Random views :math:`x_i \sim P_i B_i Y` of a motion model, uncalibrated, with the lift :math:`B_i` of each time."""

    def __init__(
        self, field: Field, dim: int, directions: Sequence[int], profile: Sequence[int], times: Sequence[int] = (),
        camera: str = "generic", sensor: int = 2, bodies: int = 1,
    ) -> None:  # fmt: skip
        self.field, self.dim, self.rates, self.directions = field, dim, sum(directions) + bodies - 1, directions
        _check(profile, sensor, dim + 1 + self.rates, times, camera, along=bool(directions))
        moments = field.reduce(times) if times else field.random(len(profile))
        course = np.zeros((dim, 1), dtype=np.int64)  # of the camera
        moved = {"constant_velocity": dim, "along": directions[0] if directions else 0}.get(camera, 0)
        course[:moved] = field.random(moved, 1)
        common, eye = field.random(sensor + 1, dim + 1), np.eye(dim + 1, dtype=np.int64)
        projections = []
        for time in moments.tolist():
            powers = [pow(time, n, field.prime) * eye[:, :count] for n, count in enumerate(directions, start=1)]
            translation = [np.append(field.random(dim), 0)[:, None]] * (bodies - 1)
            world = np.hstack([eye, *powers, *translation])
            if camera == "generic":
                seen = field.random(sensor + 1, dim + 1)
            else:  # cameras of one centre are collineations of one another; without a centre, all are
                follow = eye.copy()
                follow[:dim, dim:] = -time * course % field.prime
                seen = field.product(field.random(sensor + 1, sensor + 1), field.product(common, follow))
            projections.append(field.product(seen, world))
        self.views = Views(field, dim + self.rates, (sensor,) * len(profile), tuple(profile), projections)

    def step(self, kind: str, matches: int | None, rates: Callable[[int], IntArray]) -> Step:
        """Matches of random points whose rates of change are drawn given the last homogeneous coordinate of the point."""

        def draw() -> IntArray:
            point = self.field.random(self.dim + 1)
            return self.views.static_rows(np.append(point, rates(int(point[-1])) % self.field.prime)[None])

        return Step(kind, matches, draw, patience=PATIENCE)

    def static(self, static: int | None, on_plane: int = 0, on_line: int = 0) -> list[Step]:
        """Points that do not move, some of them on one plane or line."""
        still = self.step("static", static, lambda w: np.zeros(self.rates, dtype=np.int64))
        return [self.confine("on line", on_line, 1), *([self.confine("on plane", on_plane, 2)] if self.dim > 2 else []), still]

    def confine(self, kind: str, matches: int, size: int) -> Step:
        """Matches of points that stay on one line (size 1) or plane (2), which has as many directions of motion as can be."""
        field, free = self.field, self.directions[0] if self.directions else 0
        ways = field.random(min(size, free), free)
        axes = np.vstack(
            [np.hstack([ways, np.zeros((len(ways), self.dim - free), dtype=np.int64)]), field.random(size - len(ways), self.dim)]
        )
        origin = field.random(self.dim)

        def draw() -> IntArray:
            point = (origin + field.product(field.random(size), axes)) % field.prime
            rates = [field.product(field.random(len(ways)), ways) for _ in self.directions]
            return self.views.static_rows(np.concatenate([point, [1], *rates])[None])

        return Step(kind, matches, draw, patience=PATIENCE)

    def steps(
        self,
        moving: int | None,
        static: int,
        equal: int = 0,
        linear: int = 0,
        planar: int = 0,
        *,
        on_plane: int = 0,
        on_line: int = 0,
    ) -> list[Step]:
        """Points of all kinds."""
        field, common = self.field, self.field.random(self.rates)
        plane = field.random(min(2, self.rates), self.rates)
        return [
            *self.static(static, on_plane, on_line),
            self.step("equal velocity", equal, lambda w: w * common),
            self.step("linear velocity", linear, lambda w: field.random() * common),
            self.step("planar velocity", planar, lambda w: field.product(field.random(len(plane)), plane)),
            self.step("moving", moving, lambda w: field.random(self.rates)),
        ]

    def bodies(self, moving: int | None, objects: Sequence[int]) -> list[Step]:
        """Points of each body, and of both in turn; the further coordinate is 0 on the first one and w on the second one."""
        if len(objects) > 2:
            raise ValueError(f"objects must be the numbers of points of two bodies, got {len(objects)} numbers")

        def of(*bodies: int) -> Callable[[int], IntArray]:
            turns = cycle(bodies)
            return lambda w: np.array([w * next(turns)])

        return [
            *(self.step("object", number, of(body)) for body, number in enumerate(objects)),
            self.step("moving", moving, of(0, 1)),
        ]


def _check(profile: Sequence[int], sensor: int, size: int, times: Sequence[int], camera: str, along: bool) -> None:
    if len(profile) < 2 or sum(profile) != size or not all(1 <= used <= sensor for used in profile):
        raise ValueError(
            f"profile must be hyperplanes per view, each from 1 to {sensor}, that add up to k + 1 = {size}, got {list(profile)}"
        )
    if times and len(times) != len(profile):
        raise ValueError(f"times must be one for each of {len(profile)} views, got {len(times)}")
    allowed = [name for name in CAMERAS if along or name != "along"]
    if camera not in allowed:
        raise ValueError(f"camera must be one of {', '.join(allowed)}, got {camera!r}")
