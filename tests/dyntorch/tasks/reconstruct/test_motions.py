"""Motion models: what follows from a lift, against the table of the theory, the scenes, and derivatives by hand."""

import math
from typing import get_args

import pytest
import torch

import dyntorch as dyn
from dyntorch import scenes
from dyntorch.tasks.reconstruct.motion_models import MotionName
from dyntorch.tasks.reconstruct.motions import MOTIONS, Motion, as_motion, motion_table, polynomial, smaller_motion
from dyntorch.tasks.reconstruct.result import ReconstructNotice
from indexing.report.reconstruction import PURPOSE

# k, profile of the fewest views that determine the scene, those views and matches, dimension of the ambiguity
TABLE = {
    "static_2d": (2, (2, 1), 2, 4, 8),
    "static_3d": (3, (2, 2), 2, 8, 15),
    "constant_direction_2d": (3, (2, 1, 1), 3, 7, 8),
    "constant_velocity_2d": (4, (2, 2, 1), 3, 13, 8),
    "constant_acceleration_2d": (6, (2, 2, 2, 1), 4, 40, 10),
    "constant_direction_3d": (4, (2, 2, 1), 3, 13, 15),
    "constant_velocity_planes_3d": (5, (2, 2, 1, 1), 4, 20, 15),
    "constant_velocity_3d": (6, (2, 2, 2, 1), 4, 40, 15),
    "constant_velocity_3d_sensors": (6, (3, 3, 1), 3, 21, 15),
    "two_bodies_2d": (3, (2, 2), 2, 8, 15),
    "two_bodies_3d": (4, (2, 2, 1), 3, 13, 24),
}
TIMES = (0.0, 1.0, 2.5, 4.0, 7.0)


def test_a_declaration_is_all_that_others_read():
    """Names, words, smaller models and their sentences, the command line and the report are made from the declarations."""
    wrong = []
    lines = motion_table().splitlines()
    for (name, motion), line in zip(MOTIONS.items(), lines, strict=True):
        views, tracks = motion.min_views_and_tracks(range(12))
        smaller = [smaller_motion(entry) for entry in motion.smaller]
        facts = {
            "name": name == motion.name,
            "words": motion.leaves_open and motion.metric_open and motion.purpose.endswith("."),
            "table": line.split()[:4] == [name, str(views), "views", str(tracks)] and line.endswith(motion.purpose),
            "scene": name in scenes.lifts.KINDS,
            "command line": name in get_args(MotionName),
            "report": PURPOSE[name] == motion.purpose,
            "smaller have fewer unknowns": all(one.k < motion.k or one.dim < motion.dim for one in smaller),
            "smaller of the same sensor": all(one.sensor == motion.sensor for one in smaller),
            "sentences": all(entry.case in ReconstructNotice[entry.notice.upper()].templates for entry in motion.smaller),
        }
        wrong += [(name, fact) for fact, holds in facts.items() if not holds]
    assert wrong == []


@pytest.mark.slow
def test_declared_models_take_the_matches_that_exact_ranks_of_their_lifts_take():
    wrong = {}
    for name, motion in MOTIONS.items():
        if motion.lift is not None and motion.tensor(motion.views(range(6))).width() <= 128:
            counted = Motion(motion.lift, "counted", motion.sensor, static=motion.static).minimal(range(6))
            wrong |= {} if counted == motion.minimal(range(6)) else {name: counted}
    assert wrong == {}


@pytest.mark.parametrize("name", MOTIONS)
def test_counts_of_the_theory(name):
    k, profile, views, matches, ambiguity = TABLE[name]
    motion = as_motion(name)
    assert motion.k == k and motion.views(TIMES) == views and motion.minimal(TIMES) == (views, matches)
    assert motion.profile(views) == profile and motion.ambiguity(TIMES) == ambiguity
    invariant = motion.tensor(views)
    assert invariant == dyn.GrassmannTensor(k, profile, motion.sensor) and invariant.minimal() == matches
    assert motion.dim == (3 if "3d" in name else 2) and repr(motion) == f"Motion({name})"


@pytest.mark.parametrize("name", [name for name in TABLE if "bodies" not in name])
def test_lifts_are_those_of_the_scenes(name):
    scene = scenes.lifted_points(name, 3, times=TIMES, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(as_motion(name).lifts(TIMES), scene.lifts)


def test_profiles_of_many_views_and_times_of_any_origin_and_unit():
    motion = as_motion("constant_velocity_3d")
    times = [200.0 + 3.0 * t for t in TIMES]
    assert motion.minimal(times) == (4, 40) and motion.ambiguity(times) == 15
    assert as_motion("constant_velocity_2d").views((0.0, 0.0, 0.0)) == 4
    assert [motion.profile(n) for n in (4, 5, 6, 7)] == [(2, 2, 2, 1), (2, 2, 1, 1, 1), (2, 1, 1, 1, 1, 1), (1,) * 7]
    sensors = as_motion("constant_velocity_3d_sensors")
    assert [sensors.profile(n) for n in (3, 4, 5)] == [(3, 3, 1), (3, 2, 1, 1), (3, 1, 1, 1, 1)]
    for n in (4, 5, 6):
        assert sum(motion.profile(n)) == motion.k + 1


def test_lifts_of_polynomials_and_of_ones_own():
    torch.testing.assert_close(polynomial(3, 0)(torch.tensor(5.0)), torch.eye(4, dtype=torch.float64))
    B = polynomial(2, 2, 3)(torch.tensor(2.0))
    rigid = Motion(polynomial(2, 0), "rigid")
    assert rigid.k == rigid.dim == 2 and rigid.minimal((0.0, 1.0)) == (2, 4) and rigid.ambiguity((0.0, 1.0)) == 8
    assert Motion(polynomial(2, 2), leaves_open="little").open_text(TIMES) == "little"
    assert Motion(None, k=4, bodies=2).open_text(TIMES) == ""
    for degree in (1, 2):  # far from 0
        motion = Motion(polynomial(2, 2, degree))
        assert motion.lifts([1.7e9, 1.7e9 + 1]).isfinite().all() and len(motion.centred_lifts([1.7e9])[0]) == 1
    assert B.shape == (3, 9) and B[0].tolist() == [1, 0, 0, 2, 0, 4, 0, 8, 0] and B[2].tolist() == [0, 0, 1, 0, 0, 0, 0, 0, 0]

    def lift(t):
        # one common direction, with speeds that change as the square root of the time
        return torch.cat([torch.eye(3, dtype=t.dtype), torch.stack([t.sqrt(), t * 0, t * 0])[:, None]], dim=1).float()

    motion = Motion(lift, "braking", leaves_open="little")
    assert (motion.k, motion.dim, motion.sensor, motion.bodies) == (3, 2, 2, 1)
    found = motion.lifts(torch.tensor([1.0, 4.0]))
    assert found.shape == (2, 3, 4) and found.dtype == torch.float64 and found[:, 0, 3].tolist() == [1.0, 2.0]
    assert as_motion(motion) is motion and motion.minimal((1.0, 4.0, 9.0)) == (3, 7)
    for name in ("constant_velocity_2d", "constant_acceleration_2d"):
        motion = as_motion(name)
        expected = torch.zeros(3, motion.k + 1, dtype=torch.float64)
        expected[0, 3] = expected[1, 4] = 1.0
        if motion.k == 6:
            expected[0, 5] = expected[1, 6] = 2 * 1.7
        for spacing in (1.0, 0.1):
            torch.testing.assert_close(motion.slope(1.7, spacing), expected, rtol=1e-8, atol=1e-8)

    def turning(t):
        return torch.stack([torch.stack([t.cos(), t.sin(), t * 0]), torch.stack([t * 0, t * 0, t * 0 + 1])])

    own = Motion(turning, "turning")
    assert own.dim == 1 and own.k == 2
    expected = torch.tensor([-math.sin(0.3), math.cos(0.3), 0.0], dtype=torch.float64)
    torch.testing.assert_close(own.slope(0.3)[0], expected, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Motion(), r"takes a lift, or k >= 2 for bodies without one, got k=0"),
        (lambda: Motion(lambda t: torch.zeros(4, 3), "tall"), r"lift of 'tall' must return a tensor \(d \+ 1, K\) .*got \(4, 3\)"),
        (lambda: Motion(lambda t: [1.0]), r"lift of 'custom' .*got list"),
        (lambda: Motion(lambda t: t), r"got \(\)"),
        (lambda: Motion("x"), r"lift must be a function of one time, got 'x'"),
        (lambda: Motion(lambda t: torch.full((3, 4), math.nan), "lost"), r"lift of 'lost' is not finite at time 0"),
        (lambda: Motion(lambda t: torch.zeros(3, 4), "none"), r"lift of 'none' must have rank d \+ 1 = 3, got 0 at time 0"),
        (lambda: Motion(lambda t: torch.eye(3, 4) + 0j, "turn"), r"lift of 'turn' must be real, got torch.complex"),
        (lambda: Motion(lambda t: torch.eye(3, 4 + int(t)), "grow").lifts((0.0, 1.0)), r"'grow' has another shape, \(3, 5\)"),
        (lambda: as_motion("constant_jerk"), r"motion must be .*constant_velocity_3d.*got 'constant_jerk'"),
        (lambda: MOTIONS["two_bodies_3d"].lifts((0.0, 1.0)), r"'two_bodies_3d' has no lift"),
    ],
)
def test_misuse(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_tracks_of_other_lifts_are_counted_exactly():
    """Accelerations along one direction: the centres of the views lie in one plane, and general projections would take one less."""

    def accelerated(t):
        B = torch.zeros(3, 5, dtype=torch.float64)
        B[:, :3] = torch.eye(3)
        B[0, 3], B[0, 4] = t, t**2
        return B

    model = Motion(accelerated, "accelerated")
    for times in ([0.0, 1.0, 2.0, 3.0], [0.1, 0.7, 1.9, 3.3]):
        views, tracks = model.minimal(times)
        assert (views, tracks) == (4, 11) and model.tensor(views).minimal() == 10
    # declared ones are known
    assert MOTIONS["constant_velocity_3d"].minimal(range(8)) == (4, 40)
