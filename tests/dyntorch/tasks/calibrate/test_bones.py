"""Distances that stay the same tie the points of a body together."""

import pytest
import torch

from dyntorch.tasks.calibrate.bones import bodies, rigid_pairs
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
    known = torch.ones(50, 4, dtype=torch.bool)
    assert len(rigid_pairs(points, known, 0.06)[0]) == 0
    assert bodies(torch.zeros(0, 2, dtype=torch.long), 4) == []
    assert len(rigid_pairs(points[:, :1], known[:, :1], 0.1)[0]) == 0
