"""Whitened disagreement of static points: covariance by finite differences, true geometric distance, chi-square, infinity."""

import pytest
import torch

from dyntorch.core.residual import whiten
from dyntorch.geometry.homogeneous import apply
from dyntorch.invariants.agreement import static_residual


def random(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def collineations(count, d, *batch, seed=0):
    noise = random(count, *batch, d + 1, d + 1, seed=seed) * 0.15
    noise[..., -1, :-1] *= 0.5
    return list(torch.eye(d + 1).double() + noise)


def static_views(motion, n, d, sigma, seed=1):
    first = random(*motion[0].shape[:-2], n, d, seed=seed)
    exact = [first, *(apply(torch.linalg.inv(m), first) for m in motion)]
    return [x + sigma * random(*x.shape, seed=seed + 1 + v) for v, x in enumerate(exact)]


def error(motion, views):
    return torch.cat([apply(m, x) - views[0] for m, x in zip(motion, views[1:], strict=True)], -1)


@pytest.mark.parametrize("d", [1, 2, 3])
@pytest.mark.parametrize("count", [1, 2, 3])
def test_covariance_agrees_with_finite_differences(d, count):
    motion = collineations(count, d)
    views = static_views(motion, 4, d, 0.1)
    scales = [torch.tensor(s).double() for s in (0.7, 1.3, 0.4, 2.0)[: count + 1]]
    e, step = error(motion, views), 1e-6
    covariance = torch.zeros(4, d * count, d * count).double()
    for v in range(count + 1):
        for c in range(d):
            moved = [x.clone() for x in views]
            moved[v][:, c] += step
            upper = error(motion, moved)
            moved[v][:, c] -= 2 * step
            column = (upper - error(motion, moved)) / (2 * step) * scales[v]
            covariance += column[:, :, None] * column[:, None, :]
    torch.testing.assert_close(static_residual(motion, views, scales), whiten(e, covariance), rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("d", [2, 3])
def test_norm_is_the_true_geometric_distance(d):
    motion = collineations(2, d)
    views = static_views(motion, 30, d, 0.01)
    ones = [torch.ones(()).double()] * 3
    start = torch.cat(views, -1)

    def constraint(z):
        return error(motion, [x[None] for x in z.split(d)])[0]

    # least squares under the constraint: project onto its linearization until nothing changes
    moved = start.clone()
    for _ in range(20):
        jacobian = torch.func.vmap(torch.func.jacrev(constraint))(moved)
        value = torch.func.vmap(constraint)(moved) + (jacobian @ (start - moved)[..., None])[..., 0]
        moved = start - (torch.linalg.pinv(jacobian) @ value[..., None])[..., 0]
    assert torch.func.vmap(constraint)(moved).abs().max() < 1e-10
    truth = (moved - start).norm(dim=-1)
    found = static_residual(motion, views, ones).norm(dim=-1)
    assert ((found - truth) / truth).abs().max() < 0.02


def test_square_follows_chi_square():
    motion = collineations(2, 2)
    sigma = 1e-3
    w = static_residual(motion, static_views(motion, 20000, 2, sigma), [torch.tensor(sigma).double()] * 3)
    assert abs(float(w.square().sum(-1).mean()) - 4) < 0.08
    torch.testing.assert_close(w.T @ w / len(w), torch.eye(4).double(), rtol=0, atol=0.04)


def test_points_at_infinity_stay_finite_in_value_and_gradient():
    matrix = torch.eye(3).double()
    matrix[2] = torch.tensor([1.0, 0.0, 0.0])
    x1, x2 = random(3, 2), random(3, 2, seed=1)
    x2[0, 0] = 0.0
    x2.requires_grad_()
    w = static_residual([matrix, matrix], [x1, x2, x2], [torch.ones(()).double()] * 3)
    w.sum().backward()
    assert w.isfinite().all()
    assert x2.grad.isfinite().all()
