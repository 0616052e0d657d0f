"""Lengths that stay the same: found, with what noise adds to them; bodies apart."""

import pytest
import torch

from dyntorch.tasks.calibrate.bones import bodies, learned, noise_excess, rigid_pairs
from dyntorch.tasks.calibrate.options import RigAdjustOptions
from tests.dyntorch.tasks.calibrate.rigs import exponential

F64 = torch.float64


def two_bodies(frames=80):
    """``(frames, 7, 3)``: points 0 2 4 of one rigid body, 1 3 5 of another, and 6 of none."""
    g = torch.Generator().manual_seed(0)
    t = torch.linspace(0, 5, frames, dtype=F64)
    shapes = torch.randn(2, 3, 3, generator=g, dtype=F64)
    turns = torch.stack(
        [
            torch.stack([exponential(torch.tensor([s, 0.4 * s, -0.7 * s])) for s in t]),
            torch.stack([exponential(torch.tensor([-s, s, 0.2])) for s in t]),
        ]
    )
    ways = torch.stack([torch.stack([t.sin(), t.cos(), t], -1), torch.stack([2 * t, 3 - t, t.cos()], -1)])
    points = torch.empty(frames, 7, 3, dtype=F64)
    for k in range(2):
        points[:, k:6:2] = shapes[k] @ turns[k].mT + ways[k, :, None]
    points[:, 6] = 4 * torch.stack([(3 * t).sin(), t.cos(), (2 * t).sin()], -1)
    return points, shapes


@pytest.mark.slow
def test_noise_lengthens_as_it_says():
    g = torch.Generator().manual_seed(1)
    points = torch.tensor([[[0.0, 0.0, 0.0], [1.0, 0.2, -0.3], [0.1, 0.9, 0.5]]], dtype=F64)
    half = 0.015 * torch.randn(1, 3, 3, 3, generator=g, dtype=F64) * torch.tensor([1.0, 0.3, 2.0], dtype=F64)
    covariance = half @ half.mT
    one, other = torch.tensor([0, 0, 1]), torch.tensor([1, 2, 2])
    noise = half[0] @ torch.randn(400_000, 3, 3, 1, generator=g, dtype=F64)
    noisy = points + torch.cat([noise, -noise])[..., 0]  # in pairs, so that what is linear in noise cancels

    def logs(x):
        return (x[:, one] - x[:, other]).norm(dim=-1).log()

    drawn = (logs(noisy) - logs(points)).mean(0)
    found = noise_excess(points, covariance, one, other)[0]
    assert torch.allclose(found, drawn, rtol=0.1, atol=3e-5)
    assert float(found.abs().max()) > 3e-4


@pytest.mark.parametrize("along", [True, False])
def test_noise_along_a_bone_shortens_and_across_lengthens(along):
    points = torch.tensor([[[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]]], dtype=F64)
    spread = torch.diag(torch.tensor([0.04, 0.0, 0.0] if along else [0.0, 0.0, 0.04], dtype=F64)).expand(1, 2, 3, 3)
    found = float(noise_excess(points, spread, torch.tensor([0]), torch.tensor([1])))
    assert found == pytest.approx(-0.01 if along else 0.01)


def test_bodies_fall_apart():
    points, shapes = two_bodies()
    known = torch.ones(80, 7, dtype=torch.bool)
    known[3:9, 4] = False
    points[3:9, 4] = 1e3  # what is not known has no say
    ends, lengths, spreads = rigid_pairs(points, known, 0.1)
    assert bodies(ends, 7) == [[0, 2, 4], [1, 3, 5]] and len(ends) == 4
    assert float(spreads.max()) < 1e-9
    for (a, b), length in zip(ends.tolist(), lengths.tolist(), strict=True):
        assert length == pytest.approx(float((shapes[a % 2, a // 2] - shapes[b % 2, b // 2]).norm()), rel=1e-9)


def test_points_that_all_go_their_own_ways_have_no_bones():
    g = torch.Generator().manual_seed(2)
    points = torch.randn(50, 4, 3, generator=g, dtype=F64)
    known, covariance = torch.ones(50, 4, dtype=torch.bool), torch.zeros(50, 4, 3, 3, dtype=F64)
    assert learned(points, known, covariance, RigAdjustOptions()) is None
    assert bodies(torch.zeros(0, 2, dtype=torch.long), 4) == []
    assert len(rigid_pairs(points[:, :1], known[:, :1], 0.1)[0]) == 0


def test_bones_forget_moments_whose_noise_is_as_long_as_they_are():
    points, _ = two_bodies()
    covariance = torch.zeros(80, 7, 3, 3, dtype=F64)
    covariance[10, 2] = 9.0 * torch.eye(3, dtype=F64)
    bones = learned(points, torch.ones(80, 7, dtype=torch.bool), covariance, RigAdjustOptions())
    touched = (bones.ends == 2).any(-1)
    assert bool((bones.seen[0, 10, touched] == 0).all()) and int((bones.seen == 0).sum()) == int(touched.sum())
    away, along = bones.stretched(points[None], bones.lengths)
    assert float(away[:, :10].abs().max()) < 1e-9 and along.shape == (1, 80, 4, 3)
