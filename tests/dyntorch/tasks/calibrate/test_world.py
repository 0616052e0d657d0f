"""The world: up from bodies or cameras, the ground, and the scale."""

import pytest
import torch

from dyntorch.tasks.calibrate.input import Scale
from dyntorch.tasks.calibrate.world import world_of
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
    world = world_of(R, centers, x, scale)
    assert world.metric and world.by_people and world.upright > 0.9
    found = world.points(x)
    assert torch.allclose(found[:, :, 2].nan_to_num(), torch.where(x[..., 0].isnan(), 0.0, truth[:, :, 2]), atol=0.03)
    turned, t = world.cameras(R, -(R @ centers[..., None])[..., 0])
    assert torch.allclose(-(turned.mT @ t[..., None])[..., 0], world.points(centers), atol=1e-9)
    assert torch.allclose(world.points(centers)[:, 2], true_centers[:, 2], atol=0.1)
    far = torch.cdist(world.points(centers), world.points(centers))
    assert torch.allclose(far, torch.cdist(true_centers, true_centers), rtol=0.01)
    assert float(turned[0, 2, 0].abs()) < 1e-6 and float(turned[0, 2, 1]) > 0  # the second axis points ahead of the first camera


def test_without_a_length_the_cameras_are_one_away():
    R, centers, x, *_ = scene()
    world = world_of(R, centers, x, Scale())
    assert not world.metric
    middle = x.flatten(0, 1).median(0).values
    assert float((world.scale * (centers - middle)).norm(dim=-1).median()) == pytest.approx(1.0)


def test_lying_bodies_leave_up_to_the_cameras():
    R, centers, x, *_ = scene(lying=True)
    world = world_of(R, centers, x, Scale())
    assert not world.by_people
    turned, _ = world.cameras(R, R.new_zeros(4, 3))
    assert torch.allclose(turned[:, 1], torch.tensor([0.0, 0.0, -1.0], dtype=F64).expand(4, 3), atol=1e-9)
