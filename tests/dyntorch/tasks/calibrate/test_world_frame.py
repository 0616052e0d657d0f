"""The world: up from bodies or cameras, the ground, and the scale."""

import pytest
import torch

from dyntorch.tasks.calibrate.input import Scale
from dyntorch.tasks.calibrate.world_frame import bodies, estimate_world, rigid_pairs
from tests.dyntorch.tasks.calibrate.rigs import exponential

F64 = torch.float64
BODY = torch.tensor(
    [[0.1, 0.0, 0.0], [-0.1, 0.0, 0.0], [0.15, 0.0, 0.9], [-0.15, 0.0, 0.9], [0.2, 0.0, 1.4], [-0.2, 0.0, 1.4], [0.0, 0.0, 1.75]],
    dtype=F64,
)
"""A body of 1.75 m that stands on its feet, z up."""


def scene(people=1, lying=False, frames=60):
    """Bodies ``(T, 7 people, 3)`` that walk about, and cameras at 1.5 m: z up, in metres; then all in a frame of its own."""
    t = torch.linspace(0, 4, frames, dtype=F64)
    every = []
    for k in range(people):
        turn = torch.stack([exponential(torch.tensor([0.0, 0.0, s + k])) for s in t.tolist()])
        body = BODY * (1 - 0.1 * k)
        body = body @ exponential(torch.tensor([1.5, 0.0, 0.0])).mT if lying else body
        every.append(body @ turn.mT + torch.stack([(-1) ** k * (1 + k) * 0.8 * (t - 2), (t + k).cos(), 0 * t], -1)[:, None])
    points = torch.cat(every, 1)
    centers, R = [], []
    for k in range(4):
        angle = torch.tensor(1.4 * k, dtype=F64)
        ahead = -torch.stack([angle.cos(), angle.sin(), 0 * angle])
        down = torch.tensor([0.0, 0.0, -1.0], dtype=F64)
        R.append(torch.stack([torch.linalg.cross(down, ahead), down, ahead]))
        centers.append(torch.tensor([0.0, 0.0, 1.5], dtype=F64) - 5 * ahead)
    R, centers = torch.stack(R), torch.stack(centers)
    own = exponential(torch.tensor([0.4, -1.1, 0.7]))
    return R @ own.mT, 0.3 * centers @ own.mT + 2.0, 0.3 * points @ own.mT + 2.0, centers, points


@pytest.mark.parametrize("people", [1, 3])
@pytest.mark.parametrize(
    "scale",
    [Scale(height=1.75), Scale(lengths={(0, 2): float((BODY[0] - BODY[2]).norm()), (2, 4): float((BODY[2] - BODY[4]).norm())})],
)
def test_metres_up_and_ground(people, scale):
    R, centers, x, true_centers, truth = scene(people)
    x = x.clone()
    x[5:9, 1] = torch.nan
    world = estimate_world(R, centers, x, scale)
    assert world.metric and world.by_people and world.upright > 0.9
    found = world.points(x)
    assert torch.allclose(found[:, :, 2].nan_to_num(), torch.where(x[..., 0].isnan(), 0.0, truth[:, :, 2]), atol=0.03)
    turned, t = world.cameras(R, -(R @ centers[..., None])[..., 0])
    assert torch.allclose(-(turned.mT @ t[..., None])[..., 0], world.points(centers), atol=1e-9)
    assert torch.allclose(world.points(centers)[:, 2], true_centers[:, 2], atol=0.1)
    far = torch.cdist(world.points(centers), world.points(centers))
    assert torch.allclose(far, torch.cdist(true_centers, true_centers), rtol=0.01)
    assert float(turned[0, 2, 0].abs()) < 1e-6 and float(turned[0, 2, 1]) > 0  # the second axis points ahead of the first camera


def test_world_frames_without_a_length_or_of_lying_bodies():
    R, centers, x, *_ = scene()
    world = estimate_world(R, centers, x, Scale())
    assert not world.metric
    middle = x.flatten(0, 1).median(0).values
    assert float((world.scale * (centers - middle)).norm(dim=-1).median()) == pytest.approx(1.0)
    R, centers, x, *_ = scene(lying=True)
    world = estimate_world(R, centers, x, Scale())
    assert not world.by_people
    turned, _ = world.cameras(R, R.new_zeros(4, 3))
    assert torch.allclose(turned[:, 1], torch.tensor([0.0, 0.0, -1.0], dtype=F64).expand(4, 3), atol=1e-9)


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


def test_bodies_fall_apart_and_points_of_their_own_ways_have_no_bones():
    points, shapes = two_bodies()
    known = torch.ones(80, 7, dtype=torch.bool)
    known[3:9, 4] = False
    points[3:9, 4] = 1e3  # what is not known has no say
    ends, lengths, spreads = rigid_pairs(points, known, 0.1)
    assert bodies(ends, 7) == [[0, 2, 4], [1, 3, 5]] and len(ends) == 4
    assert float(spreads.max()) < 1e-9
    for (a, b), length in zip(ends.tolist(), lengths.tolist(), strict=True):
        assert length == pytest.approx(float((shapes[a % 2, a // 2] - shapes[b % 2, b // 2]).norm()), rel=1e-9)
    g = torch.Generator().manual_seed(2)
    points = torch.randn(50, 4, 3, generator=g, dtype=F64)
    known = torch.ones(50, 4, dtype=torch.bool)
    assert len(rigid_pairs(points, known, 0.06)[0]) == 0
    assert bodies(torch.zeros(0, 2, dtype=torch.long), 4) == []
    assert len(rigid_pairs(points[:, :1], known[:, :1], 0.1)[0]) == 0
