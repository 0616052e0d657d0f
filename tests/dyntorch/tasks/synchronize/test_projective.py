"""Different points of one body before projective cameras: attitudes at all lags, the rank test, what is refused and why."""

import math
from dataclasses import replace

import pytest
import torch

from dyntorch.core.outcome import Notice, Status
from dyntorch.geometry.rigid import rotation_exponential
from dyntorch.tasks.synchronize.projective import Poses, SharedMotion, attitude_curve, quaternions, rank_curve, rotations_of
from dyntorch.tasks.synchronize.result import SynchronizeOptions
from dyntorch.tasks.synchronize.rigid_body import body_motion
from dyntorch.tasks.synchronize.synchronize import synchronize
from dyntorch.tasks.synchronize.tracks import read_tracks
from tests.draws import random

D = torch.float64
FAST = SynchronizeOptions(focal_lengths=(9.0,), num_views=14)


def attitudes(frames, seed=0, size=0.08):
    return rotation_exponential(size * random(frames, 3, seed=seed).cumsum(0))


def test_quaternions_are_the_rotations_and_neighbours_stay_near():
    turns = attitudes(200, size=0.3)
    q = quaternions(turns)
    torch.testing.assert_close(rotations_of(3 * q), turns, atol=1e-12, rtol=0)
    assert bool(((q[1:] * q[:-1]).sum(-1) > 0).all())


@pytest.mark.slow
def test_attitudes_at_all_lags_are_those_of_a_search():
    x, y = (rotation_exponential(random(3, seed=seed)) for seed in (1, 2))
    a = attitudes(40)
    b = x @ a[4:] @ y
    angles, counts, _, _ = attitude_curve(quaternions(a), quaternions(b), torch.ones(40), torch.ones(36), (-10, 10))
    assert int(angles.argmin()) - 10 == -4 and float(angles.min()) < 1e-10
    # at another lag: alternating nearest rotations, from the definition
    for lag in (0, 3):
        own, other = a[: 36 - lag], b[lag:36]
        best = math.inf
        for start in range(6):
            left, right = rotation_exponential(random(3, seed=10 + start)), rotation_exponential(random(3, seed=20 + start))
            for _ in range(200):
                u, _, v = torch.linalg.svd((other @ (own @ right).mT).sum(0))
                left = u @ torch.diag(torch.tensor([1.0, 1.0, torch.det(u @ v)], dtype=D)) @ v
                u, _, v = torch.linalg.svd((own.mT @ left.mT @ other).sum(0))
                right = u @ torch.diag(torch.tensor([1.0, 1.0, torch.det(u @ v)], dtype=D)) @ v
            apart = ((left @ own @ right * other).sum((-2, -1)) - 1) / 2
            best = min(best, float(apart.clamp(-1, 1).acos().square().mean()))
        assert counts[lag + 10] == 36 - lag and float(angles[lag + 10]) == pytest.approx(best, rel=0.1)


def test_rank_test_is_exact_at_the_right_frame():
    poses = torch.cat([attitudes(160), random(160, 3, 1, seed=3).cumsum(0)], -1)
    turn, seat = random(3, 3, seed=4), torch.cat([random(3, 4, seed=5), torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=D)])
    b = (turn @ poses @ seat + torch.tensor([0.0, 0.0, 0.0, 2.0], dtype=D))[9:]
    left, counts = rank_curve(poses, b, torch.ones(160), torch.ones(151), (-40, 40))
    assert int(left.argmin()) - 40 == -9 and float(left.min()) < 1e-12 and float(left.sort().values[1]) > 1e-4
    gone = torch.ones(160)
    gone[50:60] = 0.0
    poses[50:60] = math.nan
    again, fewer = rank_curve(poses, b, gone, torch.ones(151), (-40, 40))
    assert int(again.argmin()) - 40 == -9 and float((counts - fewer).max()) == 10


def test_derivatives_of_the_shared_motion():
    def poses(seed, frames, scale):
        turns = rotation_exponential((0.1 * random(frames, 3, seed=seed)).cumsum(0))
        values = torch.cat([quaternions(turns), random(frames, 3, seed=seed + 1).cumsum(0)], -1)
        return Poses(torch.arange(frames, dtype=D) / 30, values, scale * torch.eye(6, dtype=D).expand(frames, 6, 6))

    # the weights are constants of a step: only b's, which do not turn with the parameters, are compared
    a, b = poses(1, 30, 0.0), poses(3, 34, 1.0)
    problem = SharedMotion(a, b, torch.tensor([[0.06, 1.0]], dtype=D), 0.05, torch.ones(15, dtype=D))
    turns = [rotation_exponential(random(1, 3, seed=seed)) for seed in (5, 6)]
    theta = (problem.start.clone(), *turns, random(1, 7, seed=7))
    slope = problem.linear(theta)[1]
    for k in range(15):
        near = 1e-6 if k else 1e-7
        step = torch.zeros(1, 15, dtype=D)
        step[0, k] = near
        ahead, behind = (problem.linear(problem.retract(theta, (sign * step,)))[0] for sign in (-1, 1))
        # the logarithm of a rotation is differentiated as where it is small: of the places all holds
        torch.testing.assert_close((ahead - behind)[..., 3:] / (2 * near), slope[..., 3:, k], atol=2e-2, rtol=2e-2)


def film(points, turns, place):
    x = points @ turns.mT + place[:, None]
    return 900 * x[..., :2] / (x[..., 2:] + 4) + 500


def body_tracks(points=None, frames=40, turning=1.0, noise=0.3, seed=0):
    points = 0.3 * random(7, 3, seed=seed) if points is None else points
    turns = rotation_exponential(turning * 0.06 * random(frames, 3, seed=seed + 1).cumsum(0))
    x = film(points, turns, 0.02 * random(frames, 3, seed=seed + 2).cumsum(0))
    return x + noise * random(*x.shape, seed=seed + 3)


def motion_of(x):
    return body_motion("a", read_tracks("a", x, 30.0, None, None), FAST)


def smooth(x):
    return torch.nn.functional.avg_pool1d(x.flatten(1).T[:, None], 9, 1, 4)[:, 0].T.unflatten(1, (-1, 2))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("tracks", "code"),
    [
        (lambda: body_tracks(0.3 * random(5, 3, seed=0)), "few_on_body"),
        (lambda: body_tracks(0.3 * random(8, 3, seed=0) * torch.tensor([1.0, 1.0, 0.0])), "flat_body"),
        (lambda: body_tracks(turning=0.0, noise=0.0), "no_turn"),
        (lambda: smooth(200 * random(40, 6, 2, seed=9)) + 100 * random(6, 2, seed=8), "no_body"),
    ],
)
def test_what_a_camera_alone_is_refused_for(tracks, code):
    found = motion_of(tracks())
    assert isinstance(found, Notice) and found.code == code and found.code.refuses not in (None, Status.OK)
    assert str(found.text)


@pytest.mark.slow
def test_gaps_and_lost_points_are_left_out():
    x = body_tracks(0.3 * random(8, 3, seed=0), frames=60)
    whole = motion_of(x)
    x[10:20, 0], x[30:36, 3:], x[:, 7] = math.nan, math.nan, math.nan
    found = motion_of(x)
    assert found.points.tolist() == [True] * 7 + [False] and not bool(found.seen[30:36].any())
    assert int(found.seen.sum()) == 54 and found.residual == pytest.approx(whole.residual, rel=0.1)


@pytest.mark.slow
def test_misuse_and_names():
    x = body_tracks()
    with pytest.raises(ValueError, match="camera='projective' is for different points"):
        synchronize(x, x, fps=30.0, camera="projective")
    refused = synchronize(x[:, :4], x, correspondence=False, fps=30.0, camera="projective")
    assert not refused.ok and refused.status == Status.TOO_FEW and "6 on one body" in refused.reason
    with pytest.raises(ValueError, match="attitude or rank"):
        synchronize(x, x, False, fps=30.0, camera="projective", options=replace(FAST, body_measure="any"))
