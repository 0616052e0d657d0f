"""Exact ranks of the motion models against every rank of the theory, the library's models, samplers and closed forms."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from dyntorch.counting import CONFIGURATIONS, count, options_of
from dyntorch.invariants.grassmann_tensor import GrassmannTensor
from dyntorch.tasks.reconstruct.motions import MOTIONS
from tests.grid import assert_refused

TABLE = [  # of all applications: profile, unknowns, matches and equations per match, dof of the tensor; ranks are one less
    ("constant_direction_2d", (2, 2), 9, 8, 1, 7),
    ("constant_direction_2d", (2, 1, 1), 27, 7, 4, 18),
    ("constant_velocity_2d", (2, 2, 1), 27, 13, 2, 18),
    ("constant_velocity_2d", (2, 1, 1, 1), 81, 10, 8, 32),
    ("constant_acceleration_2d", (2, 2, 2, 1), 81, 40, 2, 32),
    ("constant_direction_3d", (2, 2, 1), 27, 13, 2, 18),
    ("constant_velocity_planes_3d", (2, 2, 2), 27, 26, 1, 16),
    ("constant_velocity_planes_3d", (2, 2, 1, 1), 81, 20, 4, 33),
    ("constant_velocity_3d", (2, 2, 2, 1), 81, 40, 2, 32),
    ("constant_velocity_3d", (2, 2, 1, 1, 1), 243, 31, 8, 52),
    ("constant_velocity_3d_sensors", (3, 3, 1), 64, 21, 3, 33),
    ("two_bodies_2d", (2, 2), 9, 8, 1, 7),
    ("two_bodies_3d", (2, 2, 1), 27, 13, 2, 18),
    ("two_bodies_3d", (2, 1, 1, 1), 81, 10, 8, 32),
    ("static_2d", (2, 1), 9, 4, 2, 8),
    ("static_3d", (2, 2), 9, 8, 1, 7),
    ("static_3d", (2, 1, 1), 27, 7, 4, 18),
    ("static_3d", (1, 1, 1, 1), 81, 6, 16, 29),
]


@pytest.mark.parametrize(("name", "profile", "width", "matches", "equations", "dof"), TABLE)
def test_rank_of_every_application(name, profile, width, matches, equations, dof):
    counted = count(name, profile=profile)
    assert (counted.width, counted.rank, counted.nullity) == (width, width - 1, 1)
    assert (counted.minimal, counted.profile[0]) == (matches, equations)
    assert (counted.full, counted.missing, counted.agreed) == (width - 1, 0, True)
    assert GrassmannTensor(sum(profile) - 1, profile, 3 if 3 in profile else 2).dof == dof


def test_smaller_sensor_tensor_and_trajectory_lines():
    smaller = count(6, profile=(3, 3, 1), views=[3, 3, 2])
    assert (smaller.width, smaller.rank, smaller.minimal, smaller.profile[0]) == (48, 47, 24, 2)
    assert count(3, views=[2] * 6).rank == 78  # static points of six views


@pytest.mark.parametrize(
    ("name", "profile", "rank", "missing"),
    [
        ("constant_direction_2d", (2, 2), 6, 2),
        ("constant_velocity_2d", (2, 2, 1), 15, 6),
        ("constant_velocity_2d", (2, 1, 1, 1), 54, 5),
        ("constant_direction_3d", (2, 2, 1), 22, 2),
        ("constant_velocity_planes_3d", (2, 2, 2), 17, 9),
        ("constant_velocity_planes_3d", (2, 2, 1, 1), 59, 6),
        ("constant_velocity_3d", (2, 2, 2, 1), 44, 18),
        ("constant_acceleration_2d", (2, 2, 2, 1), 24, 28),
    ],
)
def test_moving_points_needed_besides_many_static_ones(name, profile, rank, missing):
    counted = count(name, static=100, profile=profile)
    assert (counted.rank, counted.missing, counted.usual) == (rank, missing, "moving")
    assert counted.full == counted.width - 1
    assert count(name, static=100, moving=missing, profile=profile).missing == 0
    assert count(name, static=100, moving=missing - 1, profile=profile).missing == 1


@pytest.mark.parametrize(
    ("name", "options", "rank"),
    [
        ("constant_direction_3d", {"camera": "fixed"}, 22),
        ("constant_velocity_planes_3d", {"camera": "fixed"}, 74),
        ("constant_velocity_planes_3d", {"camera": "fixed", "profile": (2, 2, 2)}, 23),
        ("constant_velocity_3d", {"camera": "fixed"}, 75),
        ("constant_velocity_3d", {"camera": "constant_velocity"}, 75),
        ("constant_velocity_3d", {"camera": "along"}, 75),
        ("constant_velocity_3d", {"camera": "fixed", "times": (0, 1, 3, 4)}, 75),
        # only a camera that moves along with the points degenerates these
        ("constant_direction_3d", {"camera": "constant_velocity"}, 26),
        ("constant_direction_3d", {"camera": "along"}, 22),
        ("constant_velocity_planes_3d", {"camera": "constant_velocity"}, 80),
        ("constant_velocity_planes_3d", {"camera": "along"}, 74),
        # planes are seen through collineations wherever the camera is
        ("constant_direction_2d", {"camera": "fixed"}, 26),
        ("constant_velocity_2d", {"camera": "fixed"}, 26),
        ("constant_velocity_2d", {"camera": "constant_velocity"}, 26),
        ("constant_acceleration_2d", {"camera": "fixed"}, 80),
        ("static_3d", {"camera": "fixed"}, 6),
        ("two_bodies_2d", {"camera": "fixed"}, 8),
        ("two_bodies_3d", {"camera": "fixed"}, 22),
        ("two_bodies_3d", {"camera": "constant_velocity"}, 26),
        # even times are no special case, simultaneous views are
        ("constant_velocity_2d", {"times": (0, 1, 2)}, 26),
        ("constant_acceleration_2d", {"times": (0, 1, 2, 3)}, 80),
        ("constant_velocity_planes_3d", {"times": (0, 1, 2, 3)}, 80),
        ("constant_velocity_3d", {"times": (0, 1, 2, 3)}, 80),
        ("constant_velocity_3d", {"times": (0, 0, 1, 2)}, 72),
        ("constant_velocity_3d", {"times": (1, 1, 1, 1)}, 44),
        # velocities of fewer dimensions than the model has; a common one is as good as none
        ("constant_velocity_2d", {"equal_velocity": 60}, 15),
        ("constant_velocity_3d", {"equal_velocity": 100}, 44),
        ("constant_velocity_3d", {"linear_velocity": 100}, 63),
        ("constant_velocity_3d", {"planar_velocity": 100}, 75),
    ],
)
def test_rank_of_degenerate_views_and_motions(name, options, rank):
    counted = count(name, **options)
    assert counted.rank == rank and counted.agreed
    assert counted.full == (rank if "velocity" not in "".join(options) else counted.width - 1)


@pytest.mark.slow
def test_points_that_move_in_fewer_dimensions_need_others():
    for kind, missing in (("equal", 18), ("linear", 9), ("planar", 3)):
        assert count("constant_velocity_3d", **{f"{kind}_velocity": 100}).missing == missing
    for kind in ("static", "equal_velocity", "linear_velocity", "planar_velocity"):
        one, other = (count(name, **{kind: 60}) for name in ("constant_velocity_3d_sensors", "constant_velocity"))
        assert (one.rank, one.missing) == (other.rank, other.missing)


@pytest.mark.parametrize(
    ("name", "profile", "alone"),
    [("two_bodies_2d", (2, 2), 6), ("two_bodies_3d", (2, 2, 1), 22), ("two_bodies_3d", (2, 1, 1, 1), 73)],
)
def test_second_body_needs_two_points(name, profile, alone):
    counted = [count(name, objects=[60, number], profile=profile) for number in (0, 1, 2, 3)]
    full = counted[0].width - 1
    assert counted[0].rank == alone == count(name, objects=[0, 60], profile=profile).rank
    assert [one.rank == full for one in counted] == [False, False, True, True]
    assert [kind.name for kind in counted[3].kinds] == ["object", "object"]


@pytest.mark.slow
def test_models_and_profiles_are_those_of_the_library():
    times = [0.0, 1.0, 3.0, 4.0, 6.0, 7.0, 9.0]
    for name, motion in MOTIONS.items():
        if name not in CONFIGURATIONS:
            continue
        views, matches = motion.minimal(times)
        assert options_of(name)["profile"] == motion.profile(views), name
        assert count(name).minimal == matches, name


# ------------------------------------------------------------------------------------- Grassmann tensors by numbers


@pytest.mark.slow
@pytest.mark.parametrize(
    ("k", "profile", "l"),
    [
        (2, (1, 1, 1), 1), (3, (1, 1, 1, 1), 1), (3, (1, 1, 1, 1), 2), (3, (2, 2), 3), (4, (2, 2, 1), 3), (5, (3, 2, 1), 3),
        (5, (2, 2, 2), 3), (4, (2, 2, 1), (2, 3, 1)), (6, (2, 2, 1, 1, 1), 2), (5, (3, 3), 4), (7, (3, 3, 2), 3),
    ],
)  # fmt: skip
def test_grassmann_tensor_by_numbers_takes_the_matches_of_its_closed_form(k, profile, l):  # noqa: E741
    engine = GrassmannTensor(k, profile, l)
    counted = count(k, profile=profile, views=engine.dims)
    assert (counted.width, counted.rank, counted.minimal) == (engine.width(), engine.width() - 1, engine.minimal())


@pytest.mark.slow
def test_profile_has_measures_as_its_limits():
    for profile, measure in (((2, 2), "join"), ((1,) * 4, "hyper"), ((2, 1, 1), ["join", "hyper", "hyper"])):
        k = 3
        assert count(k, profile=profile).profile == count(k, views=[2] * len(profile), measure=measure).profile
    assert count(2, profile=(2, 2, 2), r=2).rank == count("homography").rank == 26  # moving points: join of each view
    assert count(5, profile=(2, 2, 1)).nullity == 0 < count(3, profile=(2, 2, 1)).nullity  # sums other than k + 1
    lines = count(3, profile=(1, 1, 1), views=[2, 2, 2], m=2, r=2)
    assert lines.profile == count(3, views=[2, 2, 2], m=2, r=2, measure="hyper").profile


def constant_velocity(dim, used, moving):
    """Points X + tV through explicit hyperplanes x_j - x'_j = 0, nothing of the library's model in it."""

    def sampler(field):
        cameras, times = field.random(len(used), 3, dim + 1), field.random(len(used)).tolist()
        while True:
            place, velocity = field.random(dim), field.random(dim) * moving
            rows = []
            for camera, time, alpha in zip(cameras, times, used, strict=True):
                seen = field.product(camera, np.append((place + time * velocity) % field.prime, 1))
                lines = np.array([[seen[2], 0, -seen[0]], [0, seen[2], -seen[1]]])
                rows.append(field.reduce(lines) if alpha == 1 else field.join(lines)[None])
            yield field.kron(*rows)

    return sampler


@pytest.mark.parametrize(
    ("name", "dim", "used"), [("constant_velocity_2d", 2, (2, 2, 1)), ("constant_velocity_3d", 3, (2, 2, 2, 1))]
)
def test_models_equal_samplers_of_their_scenes(name, dim, used):
    assert count(constant_velocity(dim, used, 1), matches=45).profile == count(name, moving=45).profile
    assert count(constant_velocity(dim, used, 0), matches=45).profile == count(name, static=45).profile


def test_misuse():
    cases = [
        ("constant_velocity_2d", {"profile": (2, 2, 2)}, r"each from 1 to 2, that add up to k \+ 1 = 5, got \[2, 2, 2\]"),
        ("constant_velocity_2d", {"profile": (3, 2)}, "each from 1 to 2"),
        ("constant_velocity_2d", {"profile": (2, 2, 1, 0)}, "each from 1 to 2"),
        ("constant_velocity_2d", {"profile": 5}, "profile must be a list of numbers"),
        ("constant_velocity_2d", {"times": (0, 1)}, "times must be one for each of 3 views, got 2"),
        ("constant_velocity_2d", {"camera": "rotating"}, "camera must be one of generic, fixed, constant_velocity, along"),
        ("constant_velocity_2d", {"planar_velocity": 3}, "no option planar_velocity"),
        ("static_3d", {"camera": "along"}, "camera must be one of generic, fixed, constant_velocity, got"),
        ("two_bodies_2d", {"objects": (3, 3, 3)}, "two bodies, got 3 numbers"),
        ("constant_velocity_3d_sensors", {"camera": "fixed"}, "no option camera"),
        (4, {"profile": (2, 2, 1), "measure": "hyper"}, "profile and measure exclude each other"),
        (4, {"profile": (2, 2, 1), "views": [2, 2]}, "one number for each of 2 views, got 3"),
        (4, {"profile": (2, 3)}, "1 points lie in 2 hyperplanes of a view of dimension 2, got 3"),
        (3, {"profile": (2, 2), "m": 2, "r": 2}, "2 points lie in 1 hyperplanes"),
        (3, {"profile": ()}, "views is empty"),
        (3, {}, "needs views"),
    ]
    assert_refused(*((partial(count, what, **options), message) for what, options, message in cases))
