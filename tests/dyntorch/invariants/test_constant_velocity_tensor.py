"""Constant velocity: against Cramer's rule in P^6, brute-force ranks, finite differences and the truth of synthetic scenes."""

import numpy as np
import pytest
import torch

from dyntorch.geometry.extensors import wedge
from dyntorch.geometry.homogeneous import apply, homogeneous, unit
from dyntorch.invariants.constant_velocity_tensor import ConstantVelocityTensor, infinity_planes
from dyntorch.metrics import relative_error
from dyntorch.scenes import constant_velocity
from tests.draws import random, seeded

CV = ConstantVelocityTensor
ONES = (torch.ones((), dtype=torch.float64),) * 3


def test_counts():
    assert (CV.minimal(), CV.width(), CV.rows(), CV.shape()) == (21, 64, 3, (4, 4, 4))
    camera = CV("image")
    assert (camera.minimal(), camera.width(), camera.rows(), camera.shape()) == (24, 48, 2, (4, 4, 3))
    assert (CV().codim, camera.codim) == (3, 2)
    with pytest.raises(ValueError, match="'space' or 'image'"):
        CV("plane")


@pytest.mark.parametrize("height", [4, 3])
def test_compose_is_cramers_rule_in_p6(height):
    maps = [random(4, 4, seed=1).numpy(), random(4, 4, seed=2).numpy(), random(height, 4, seed=3).numpy()]
    tensor = CV.compose(*(torch.tensor(m) for m in maps)).numpy()
    lifted = [np.hstack([m, t * m[:, :3]]) for t, m in enumerate(maps)]
    for seed in range(5):
        p0, p1 = random(2, 4, seed=10 + seed).numpy()
        zero = np.zeros((4, 1))
        system = np.vstack([np.hstack([lifted[0], p0[:, None], zero]), np.hstack([lifted[1], zero, p1[:, None]])])
        minors = [(-1) ** c * np.linalg.det(np.delete(system, c, axis=1)) for c in range(9)]
        p2 = lifted[2] @ np.array(minors[:7])
        found = np.einsum("ijk,i,j->k", tensor, p0, p1)
        cosine = abs(p2 @ found) / np.linalg.norm(p2) / np.linalg.norm(found)
        assert cosine == pytest.approx(1, abs=1e-12)


def test_epipoles_are_fourfold_defective_eigenvalues():
    tensor = CV.compose(*constant_velocity(5, generator=seeded(4)).motion)
    alpha, _ = infinity_planes(tensor)
    a, b = random(2, 4, seed=5)
    first, second = (torch.einsum("i,ijk->kj", c, tensor) for c in (a, b))
    pencil = first @ torch.linalg.inv(second)
    ratio = (a @ alpha) / (b @ alpha)
    left = pencil - ratio * torch.eye(4, dtype=pencil.dtype)
    assert torch.linalg.matrix_rank(left, rtol=1e-9) == 1
    assert (left @ left).abs().max() < 1e-10 * left.abs().max()
    # the eigenvalues may keep half of the digits only, their mean keeps all
    assert abs(pencil.trace() / 4 - ratio) < 1e-11 * ratio.abs()
    # hence the determinant of a slice is the fourth power of a linear form
    slices = torch.einsum("ni,ijk->nkj", random(20, 4, seed=6), tensor)
    power = (random(20, 4, seed=6) @ alpha) ** 4
    assert torch.allclose(torch.linalg.det(slices) / power, torch.linalg.det(first) / (a @ alpha) ** 4, rtol=1e-8)


@pytest.mark.parametrize("camera", [False, True])
def test_maps_are_the_true_ones_up_to_an_affinity_and_a_velocity(camera):
    scene = constant_velocity(30, batch=5, camera=camera, generator=seeded(10))
    found = CV.decompose(CV.compose(*scene.motion))
    x, v = scene.extras["points"], scene.extras["velocities"]
    y = CV.positions(found, *scene.views)
    # an affinity of space-time: y_t = L x + t (L v + u) + c
    truth = torch.cat([homogeneous(x + t * v) for t in range(3)], -2)
    design = torch.cat([truth, torch.cat([torch.full((5, 30, 1), float(t), dtype=x.dtype) for t in range(3)], -2)], -1)
    target = torch.cat([y[..., t, :] for t in range(3)], -2)
    solution = torch.linalg.lstsq(design, target).solution
    assert (design @ solution - target).abs().max() < 1e-8 * target.abs().max()


@pytest.mark.parametrize("camera", [False, True])
def test_gauge_changes_nothing(camera):
    scene = constant_velocity(10, camera=camera, generator=seeded(12))
    affinity = torch.eye(4, dtype=torch.float64)
    affinity[:3] += 0.3 * random(3, 4, seed=13)
    moved = []
    for t, m in enumerate(scene.motion):
        drift = torch.eye(4, dtype=torch.float64)
        drift[:3, 3] = t * random(3, seed=14)
        moved.append((t + 2.0) * m @ drift @ affinity)
    assert relative_error(CV.compose(*moved), CV.compose(*scene.motion), dims=3) < 1e-13
    noisy = tuple(x + 0.01 * random(*x.shape, seed=15 + i) for i, x in enumerate(scene.views))
    invariant = CV("image" if camera else "space")
    before, after = (invariant.whitened_residual(m, noisy, ONES).norm(dim=-1) for m in (scene.motion, tuple(moved)))
    assert torch.allclose(before, after, rtol=1e-9)


@pytest.mark.parametrize("camera", [False, True])
def test_static_points_fix_the_common_velocity(camera):
    scene = constant_velocity(40, batch=3, static=0.2, camera=camera, generator=seeded(16))
    still = ~scene.extras["moving"]
    broken = torch.where(still[..., None], scene.views[0], scene.views[0].clone().fill_(float("nan")))
    maps = CV.fix_gauge(CV.decompose(CV.compose(*scene.motion)), broken, *scene.views[1:], weights=still.double())
    velocity = CV.velocities(maps, *scene.views)
    assert velocity[still].abs().max() < 1e-9
    # the rest is one affinity: its linear part takes the true velocities to the found ones
    true = scene.extras["velocities"]
    linear = torch.linalg.lstsq(true, velocity).solution
    assert (true @ linear - velocity).abs().max() < 1e-9
    if not camera:
        relations = torch.stack([unit(torch.linalg.inv(a) @ b) for a, b in zip(scene.motion, maps, strict=True)])
        assert (relations - relations[:1]).abs().max() < 1e-9
    assert CV.static_distance(maps, *scene.views)[still].max() < 1e-9
    assert CV.static_distance(maps, *scene.views)[~still].min() > 0.05
    unchanged = CV.fix_gauge(maps, *scene.views, weights=torch.zeros_like(still, dtype=torch.float64))
    assert all(torch.allclose(a, b) for a, b in zip(maps, unchanged, strict=True))
    with pytest.raises(ValueError, match="no matches"):
        CV.fix_gauge(maps, *(x[..., :0, :] for x in scene.views))


def test_transfer_between_all_views():
    scene = constant_velocity(30, batch=2, generator=seeded(17))
    tensor = CV.compose(*scene.motion)
    x1, x2, x3 = scene.views
    assert (CV.transfer(tensor, x1, x2) - x3).abs().max() < 1e-10
    assert (CV.transfer(tensor, x1=x1, x3=x3) - x2).abs().max() < 1e-9
    assert (CV.transfer(tensor, x2=x2, x3=x3) - x1).abs().max() < 1e-9
    with pytest.raises(ValueError, match="two of x1, x2, x3"):
        CV.transfer(tensor, x1)
    seen = constant_velocity(30, camera=True, generator=seeded(17))
    assert (CV.transfer(CV.compose(*seen.motion), *seen.views[:2]) - seen.views[2]).abs().max() < 1e-9
    with pytest.raises(ValueError, match="does not determine"):
        CV.transfer(CV.compose(*seen.motion), x2=seen.views[1], x3=seen.views[2])


@pytest.mark.parametrize("camera", [False, True])
def test_trajectories_pass_through_the_positions(camera):
    scene = constant_velocity(12, camera=camera, generator=seeded(18))
    for view in (1, 2, 3):
        line = CV.trajectory(scene.motion, *scene.views, view=view)
        for time in (-1.0, 0.0, 3.0):
            point = homogeneous(apply(scene.motion[view - 1], scene.extras["points"] + time * scene.extras["velocities"]))
            missed = (point * line).sum(-1) if line.shape[-1] == 3 else wedge(line, point, 4, (2, 1))
            assert missed.abs().max() < 1e-10
    with pytest.raises(ValueError, match="view must be"):
        CV.trajectory(scene.motion, *scene.views, view=0)


def test_camera_of_space_points_gives_the_third_sensor():
    """The image tensor sees only M A_2; the predicted positions and the points in space give A_2 itself."""
    scene = constant_velocity(40, generator=seeded(19))
    m = random(3, 4, seed=20)
    first, second, seen = CV.decompose(CV.compose(scene.motion[0], scene.motion[1], m @ scene.motion[2]))
    y = CV.positions((first, second, seen), *scene.views[:2], apply(m, scene.views[2]))[..., 2, :]
    planes = torch.linalg.svd(homogeneous(scene.views[2])[:, None, :]).Vh[:, 1:]
    system = torch.einsum("nrk,nj->nrkj", planes, homogeneous(y)).flatten(2).flatten(0, 1)
    third = torch.linalg.svd(system).Vh[-1].reshape(4, 4)
    assert relative_error(CV.compose(first, second, third), CV.compose(*scene.motion), dims=3) < 1e-9
    assert torch.minimum((unit(m @ third) - seen).norm(), (unit(m @ third) + seen).norm()) < 1e-9


def reference_square(residual, views, scales):
    """e^T (sum s^2 J J^T)^-1 e of one match, with automatic derivatives."""
    e = residual(*views)
    jacobians = [j.flatten(1) for j in torch.autograd.functional.jacobian(residual, views)]
    q = sum(s**2 * j @ j.mT for s, j in zip(scales, jacobians, strict=True))
    return e @ torch.linalg.solve(q, e)


@pytest.mark.parametrize("camera", [False, True])
def test_whitened_residuals_against_automatic_derivatives(camera):
    scene = constant_velocity(6, camera=camera, static=0.5, sigma=0.02, generator=seeded(21))
    scales = (1.0, 0.5, 2.0)
    inverse = [torch.linalg.inv(m) for m in scene.motion[:2]]

    def world(t, x):
        return apply(inverse[t], x[None])[0]

    def last(y0, y1, x3, y):
        return apply(scene.motion[2], y[None])[0] - x3 if camera else apply(torch.linalg.inv(scene.motion[2]), x3[None])[0] - y

    def moving(x1, x2, x3):
        y0, y1 = world(0, x1), world(1, x2)
        return last(y0, y1, x3, 2 * y1 - y0)

    def static(x1, x2, x3):
        y0, y1 = world(0, x1), world(1, x2)
        return torch.cat([y1 - y0, last(y0, y1, x3, y1)])

    invariant = CV("image" if camera else "space")
    tensors = tuple(torch.tensor(s, dtype=torch.float64) for s in scales)
    for method, residual in ((invariant.whitened_residual, moving), (invariant.whitened_static_residual, static)):
        found = method(scene.motion, scene.views, tensors).square().sum(-1)
        expected = torch.stack([reference_square(residual, tuple(x[n] for x in scene.views), scales) for n in range(6)])
        assert torch.allclose(found, expected, rtol=1e-9)


def test_nothing_spoils_a_batch():
    tensor = CV.compose(*constant_velocity(1, batch=6, generator=seeded(31)).motion)
    bad = tensor.clone()
    bad[1], bad[2], bad[3] = 0.0, float("nan"), random(4, 4, 4, seed=40)
    bad[4] = torch.einsum("i,j,k->ijk", *random(3, 4, seed=41))
    bad.requires_grad_()
    found = CV.decompose(bad)
    assert all(m.isfinite().all() for m in found)
    assert relative_error(CV.compose(*found)[[0, 5]], tensor[[0, 5]], dims=3).max() < 1e-9
    assert (found[2][1:3] == 0).all()
    assert relative_error(CV.compose(*CV.decompose(bad[4:]))[1], CV.compose(*found)[5], dims=3) < 1e-12
    (gradient,) = torch.autograd.grad(sum(m[[0, 5]].square().sum() + m[[0, 5], 0].sum() for m in CV.decompose(bad)), bad)
    assert gradient.isfinite().all()
    with pytest.raises(ValueError, match="tensor must be"):
        CV.decompose(tensor[0, 0])
    assert CV.decompose(tensor.float())[0].dtype == torch.float32
    assert relative_error(CV.compose(*CV.decompose(tensor.float())).double(), tensor, dims=3).max() < 1e-3
    assert CV.decompose(tensor[:0])[0].shape == (0, 4, 4)
