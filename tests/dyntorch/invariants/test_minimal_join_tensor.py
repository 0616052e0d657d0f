"""Minimal join tensors: what one camera leaves open, what two determine; transfer against A and B; accuracy with noise."""

import pytest
import torch

from dyntorch.core.invariant import as_invariant
from dyntorch.geometry.extensors import levi_civita
from dyntorch.geometry.homogeneous import similarity, unit
from dyntorch.invariants.join_tensor import JoinTensor
from dyntorch.invariants.minimal_join_tensor import MinimalJoinTensor
from dyntorch.metrics import relative_error
from dyntorch.scenes import moving_points
from tests.draws import random, seeded
from tests.grid import assert_refused


def test_tensor_is_that_of_the_projected_definition():
    """N_ijk = eps_lmk W_li (W A)_mj with W = M B^-1."""
    a, b = random(5, 1, 4, 4, seed=5), random(5, 1, 4, 4, seed=6)
    invariant = MinimalJoinTensor(random(3, 3, 4, seed=7))
    w = invariant.cameras @ torch.linalg.inv(b)
    expected = torch.einsum("lmk,zcli,zcmj->zcijk", levi_civita(3), w, w @ a)
    tensor = invariant.compose(a[:, 0], b[:, 0])
    assert relative_error(tensor, expected, dims=3).max() < 1e-11
    torch.testing.assert_close(tensor.flatten(-3).norm(dim=-1), torch.ones(5, 3, dtype=torch.float64))


def test_one_camera_does_not_see_part_of_the_motion():
    """N stays the same for A -> (t I + B C v^T) A, where C is the centre of the camera."""
    a, b, camera = random(4, 4, seed=13), random(4, 4, seed=14), random(1, 3, 4, seed=15)
    invariant = MinimalJoinTensor(camera)
    centre = torch.linalg.svd(camera[0]).Vh[-1]
    other = (0.7 * torch.eye(4, dtype=torch.float64) + torch.outer(b @ centre, random(4, seed=16))) @ a
    assert relative_error(other, a) > 0.1
    assert relative_error(invariant.compose(other, b), invariant.compose(a, b), dims=3).max() < 1e-11
    x = torch.zeros(1, 3, dtype=torch.float64)
    assert_refused(
        (lambda: invariant.decompose(invariant.compose(a, b)), "at least two cameras with different centres"),
        (lambda: invariant.transfer(invariant.compose(a, b), x, 2, 1), "one camera"),
    )
    # the plane of a trajectory needs no more than one
    assert invariant.trajectory_planes(invariant.compose(a, b), x, x + 1).shape == (1, 1, 4)


def test_scale_of_the_cameras_does_not_matter():
    cameras, scales = random(3, 3, 4, seed=23), torch.tensor([2.0, -5.0, 1e3], dtype=torch.float64)[:, None, None]
    a, b = random(4, 4, seed=24), random(4, 4, seed=25)
    noisy = MinimalJoinTensor(cameras).compose(a, b) + 0.01 * random(3, 4, 4, 3, seed=26)
    expected = MinimalJoinTensor(cameras).decompose(noisy)
    for got, true in zip(MinimalJoinTensor(scales * cameras).decompose(noisy), expected, strict=True):
        torch.testing.assert_close(got, true, atol=1e-10, rtol=0)
    pixels = MinimalJoinTensor(torch.diag(torch.tensor([700.0, 700.0, 1.0], dtype=torch.float64)) @ cameras)
    for got, true in zip(pixels.decompose(pixels.compose(a, b)), (a, b), strict=True):
        assert relative_error(got, true) < 1e-9


def test_batch_equals_loop_with_cameras_of_each_problem():
    """After normalization every problem has cameras of its own."""
    frames = tuple(similarity(random(6, seed=s).abs() + 0.3, random(6, 3, seed=s + 1))[:, None] for s in (27, 29, 31))
    invariant = MinimalJoinTensor().normalize(frames)
    a, b = random(6, 4, 4, seed=33), random(6, 4, 4, seed=34)
    tensor = invariant.compose(a, b)
    assert tensor.shape == (6, 4, 4, 4, 3)
    x = random(6, 5, 3, seed=35)
    transferred, parts = invariant.transfer(tensor, x, 3, 1), invariant.decompose(tensor)
    for i in range(6):
        alone = MinimalJoinTensor().normalize(tuple(t[i] for t in frames))
        torch.testing.assert_close(alone.compose(a[i], b[i]), tensor[i], atol=1e-12, rtol=0)
        torch.testing.assert_close(alone.transfer(tensor[i], x[i], 3, 1), transferred[i], atol=1e-9, rtol=1e-9)
        for got, part in zip(alone.decompose(tensor[i]), parts, strict=True):
            torch.testing.assert_close(got, part[i], atol=1e-10, rtol=0)


@pytest.mark.parametrize(("source", "target"), [(1, 2), (1, 3), (2, 1), (2, 3), (3, 1), (3, 2)])
@pytest.mark.parametrize("count", [2, None])
def test_transfer_between_all_views(source, target, count):
    scene = moving_points(15, batch=2, static=1.0, generator=seeded(45))
    invariant = MinimalJoinTensor() if count is None else MinimalJoinTensor(random(count, 3, 4, seed=46))
    tensor = invariant.compose(*scene.motion)
    got = invariant.transfer(tensor, scene.exact[source - 1], source, target)
    torch.testing.assert_close(got, scene.exact[target - 1], atol=1e-9, rtol=0)


@pytest.mark.parametrize("view", [1, 2, 3])
def test_trajectories_are_those_of_the_join_tensor(view):
    scene = moving_points(15, batch=2, generator=seeded(47))
    given = [x for v, x in enumerate(scene.exact, start=1) if v != view]
    line = MinimalJoinTensor.trajectory(MinimalJoinTensor.compose(*scene.motion), *given, view)
    expected = JoinTensor.trajectory(JoinTensor.compose(*scene.motion), *given, view)
    assert relative_error(line, expected, dims=1).max() < 1e-9


def test_residuals_are_those_of_the_join_tensor():
    scene = moving_points(30, batch=2, sigma=0.01, static=0.5, generator=seeded(48))
    scales = tuple(torch.full((2,), s, dtype=torch.float64) for s in (0.01, 0.02, 0.03))
    one, other = as_invariant(MinimalJoinTensor), as_invariant(JoinTensor)
    for name in ("whitened_residual", "whitened_static_residual"):
        assert torch.equal(*(getattr(i, name)(scene.motion, scene.views, scales) for i in (one, other)))
    distance = one.static_distance(one.compose(*scene.motion), *scene.views)
    torch.testing.assert_close(distance, other.static_distance(other.compose(*scene.motion), *scene.views))


def test_degenerate_input_stays_finite():
    zero = torch.zeros(4, 4, dtype=torch.float64)
    a = torch.stack([zero, random(4, 4, seed=58)]).requires_grad_()
    b = torch.stack([zero, random(4, 4, seed=59)]).requires_grad_()
    tensor = MinimalJoinTensor.compose(a, b)
    assert (tensor[0] == 0).all()
    parts = MinimalJoinTensor.decompose(tensor)
    assert all(part.isfinite().all() for part in parts)
    torch.testing.assert_close(parts[1][1], unit(b[1]), atol=1e-10, rtol=0)
    (tensor * random(4, 4, 4, 3, seed=60)).sum().backward()
    assert a.grad.isfinite().all() and b.grad.isfinite().all()
    # no inverse of B is taken: a singular one is no exception
    singular = torch.diag(torch.tensor([1.0, 1.0, 1.0, 0.0], dtype=torch.float64))
    assert MinimalJoinTensor.compose(b.detach()[1], singular).isfinite().all()


def test_misuse_is_refused():
    M, eye = MinimalJoinTensor, torch.eye(4)
    assert repr(M(random(2, 3, 4))) == "MinimalJoinTensor(2 cameras)"
    assert_refused(
        *((lambda shape=shape: M(torch.zeros(shape)), r"\(c, 3, 4\)") for shape in ((3, 4), (0, 3, 4), (2, 4, 4))),
        (lambda: M(torch.ones(1, 3, 4)), "camera 0 is not"),
        (lambda: M(torch.zeros(2, 3, 4)), "camera 0 is not"),
        (lambda: M(torch.full((2, 3, 4), torch.nan)), "camera 0 is not"),
        (lambda: M(eye[:3].repeat(2, 1, 1) * torch.tensor([[[1.0]], [[-2.0]]])), "different centres"),
        (lambda: M.compose(torch.eye(3), eye), "A and B must be"),
        (lambda: M.decompose(torch.zeros(2, 4, 4, 3)), r"\(\*batch, 4, 4, 4, 3\)"),
        (lambda: M.transfer(M.compose(eye, eye), torch.zeros(1, 3), 3, 3), "two different views"),
    )
