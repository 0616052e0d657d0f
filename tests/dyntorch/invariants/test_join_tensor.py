"""Join tensors: the family and its motion, transfer and trajectories against A and B, accuracy with noise."""

import pytest
import torch

from dyntorch.core.invariant import as_invariant
from dyntorch.geometry.homogeneous import apply, homogeneous, unit
from dyntorch.invariants.join_tensor import JoinTensor
from dyntorch.scenes import moving_points
from tests.draws import random, seeded
from tests.grid import assert_refused

ONE = torch.ones((), dtype=torch.float64)


def test_family_holds_all_determinants_and_is_orthonormal():
    a, b = random(3, 4, 4, seed=7), random(3, 4, 4, seed=8)
    basis = JoinTensor.compose(a, b)
    assert basis.shape == (3, 4, 4, 4, 4)
    flat = basis.flatten(-3)
    torch.testing.assert_close(flat @ flat.mT, torch.eye(4, dtype=torch.float64).expand(3, 4, 4), atol=1e-12, rtol=0)
    p, v = random(3, 1, 4, seed=9), random(4, seed=10)
    q, r = random(3, 5, 4, seed=11), random(3, 5, 4, seed=12)
    columns = [p.expand(3, 5, 4), q @ a.mT, r @ b.mT, v.expand(3, 5, 4)]
    determinants = torch.linalg.det(torch.stack(columns, dim=-1))
    values = torch.einsum("zaijk,zni,znj,znk->zna", basis, p.expand(3, 5, 4), q, r)
    # the determinant with any V is one linear combination of the four forms
    weights = torch.linalg.lstsq(values, determinants[..., None]).solution
    torch.testing.assert_close((values @ weights)[..., 0], determinants, atol=1e-10, rtol=1e-10)


@pytest.mark.parametrize(("source", "target"), [(1, 2), (1, 3), (2, 1), (2, 3), (3, 1), (3, 2)])
def test_transfer_between_all_views(source, target):
    scene = moving_points(15, batch=2, static=1.0, generator=seeded(21))
    tensor = JoinTensor.compose(*scene.motion)
    got = JoinTensor.transfer(tensor, scene.exact[source - 1], source, target)
    torch.testing.assert_close(got, scene.exact[target - 1], atol=1e-9, rtol=0)


@pytest.mark.parametrize("view", [1, 2, 3])
def test_trajectory_joins_the_positions(view):
    scene = moving_points(15, batch=2, generator=seeded(22))
    others = [v for v in range(3) if v != view - 1]
    frames = [torch.eye(4, dtype=torch.float64).expand(2, 4, 4), *scene.motion]
    tensor = JoinTensor.compose(*scene.motion)
    given = [scene.exact[v] for v in others]
    positions = [homogeneous(apply(torch.linalg.inv(frames[view - 1]) @ frames[v], scene.exact[v])) for v in others]
    planes = JoinTensor.trajectory_planes(tensor, *given, view)
    assert planes.shape == (2, 15, 4, 4)
    for p in positions:
        assert (planes @ p[..., None]).abs().max() < 1e-10
    line = JoinTensor.trajectory(tensor, *given, view)
    p, q = positions
    expected = torch.stack([p[..., i] * q[..., j] - p[..., j] * q[..., i] for i in range(4) for j in range(i + 1, 4)], dim=-1)
    expected = expected / expected.norm(dim=-1, keepdim=True)
    assert torch.minimum((line - expected).norm(dim=-1), (line + expected).norm(dim=-1)).max() < 1e-8
    # the pencil has rank 2, and none is left where the point stays
    assert (torch.linalg.svdvals(planes)[..., 2] < 1e-10).all()
    still = moving_points(15, batch=2, static=1.0, generator=seeded(22))
    rest = JoinTensor.trajectory_planes(JoinTensor.compose(*still.motion), *(still.exact[v] for v in others), view)
    assert rest.abs().max() < 1e-10
    assert JoinTensor.trajectory(JoinTensor.compose(*still.motion), *(still.exact[v] for v in others), view).isfinite().all()


def test_static_residual_has_six_degrees_of_freedom():
    scene = moving_points(5000, batch=2, static=1.0, sigma=0.003, generator=seeded(24))
    residual = as_invariant(JoinTensor).whitened_static_residual(scene.motion, scene.views, (0.003 * ONE,) * 3)
    assert residual.shape == (2, 5000, 6)
    assert abs(residual.square().sum(-1).mean() / 6 - 1) < 0.02
    moving = as_invariant(JoinTensor).whitened_residual(scene.motion, scene.views, (0.003 * ONE,) * 3)
    assert abs(moving.square().sum(-1).mean() / 2 - 0.5) < 0.04
    # and so the distance without A and B tells static from moving
    scene = moving_points(400, static=0.5, sigma=0.005, generator=seeded(23))
    distance, still = JoinTensor.static_distance(JoinTensor.compose(*scene.motion), *scene.views) / 0.005, scene.labels == 1
    assert abs(distance[still].square().mean() - 6) < 0.8 and (distance[~still] > distance[still].max()).all()


def test_degenerate_input_stays_finite():
    zero = torch.zeros(4, 4, dtype=torch.float64)
    a = torch.stack([zero, random(4, 4, seed=31)]).requires_grad_()
    b = torch.stack([random(4, 4, seed=32), random(4, 4, seed=33)]).requires_grad_()
    tensor = JoinTensor.compose(a, b)
    assert (tensor[0] == 0).all()
    torch.testing.assert_close(tensor[1], JoinTensor.compose(a[1], b[1]))
    parts = JoinTensor.decompose(tensor)
    assert all(part.isfinite().all() for part in parts)
    torch.testing.assert_close(parts[0][1], unit(a[1]), atol=1e-10, rtol=0)
    sum(part.square().sum() for part in JoinTensor.decompose(tensor + 0.1 * random(4, 4, 4, 4, seed=34))).backward()
    assert a.grad.isfinite().all() and b.grad.isfinite().all()
    assert JoinTensor.transfer(torch.zeros(4, 4, 4, 4, dtype=torch.float64), random(3, 3), 2, 1).isfinite().all()


def test_misuse_is_refused():
    eye, x = torch.eye(4), torch.zeros(1, 3)
    tensor = JoinTensor.compose(eye, eye)
    assert_refused(
        (lambda: JoinTensor.compose(eye, torch.eye(3)), "A and B must be"),
        (lambda: JoinTensor.decompose(torch.zeros(4, 4, 4)), "the four tensors of a fit"),
        *((lambda pair=pair: JoinTensor.transfer(tensor, x, *pair), "two different views") for pair in ((1, 1), (0, 1), (2, 4))),
        (lambda: JoinTensor.trajectory(tensor, x, x, view=0), "view must be 1, 2 or 3, got 0"),
    )
