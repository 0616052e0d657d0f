"""Thesis 9.3: points on lines in any number of views, with labels; scenes are written out here."""

import pytest
import torch

import dyntorch as dyn
from dyntorch.metrics import relative_error
from tests.grid import assert_refused


def plane(views, n, sigma, *, static=0, wrong=0, seed=0):
    """Points of a plane in pixels: the first ones stand still, the last ones are wrong in one view; and the maps to view 1."""
    draw = torch.Generator().manual_seed(seed)

    def uniform(*shape):
        return 2 * torch.rand(*shape, generator=draw, dtype=torch.float64) - 1

    A = torch.eye(3) + torch.tensor([[0.1, 0.1, 30.0], [0.1, 0.1, 30.0], [1e-4, 1e-4, 0.0]]).double() * uniform(views, 3, 3)
    A[0] = torch.eye(3)
    start, way = 300 * uniform(n, 2), torch.nn.functional.normalize(uniform(n, 2), dim=-1)
    way[:static] = 0
    steps = (20 + 50 * uniform(views, n).abs()) * uniform(views, n).sign()
    world = torch.cat([start + steps[..., None] * way, torch.ones(views, n, 1)], dim=-1)
    p = torch.linalg.solve(A[:, None], world[..., None])[..., 0]
    x = p[..., :2] / p[..., 2:] + sigma * torch.randn(views, n, 2, generator=draw, dtype=torch.float64)
    for i in range(n - wrong, n):
        x[1 + i % (views - 1), i] = 300 * uniform(2)
    return x.unbind(0), A[1:]


def space(views, n, sigma, *, static=0, seed=0):
    draw = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=draw, dtype=torch.float64)

    A = torch.eye(4) + 0.15 * normal(views, 4, 4) * torch.tensor([1.0, 1.0, 1.0, 0.15]).double()[:, None]
    A[0] = torch.eye(4)
    way = torch.nn.functional.normalize(normal(n, 3), dim=-1)
    way[:static] = 0
    world = 1.2 * normal(n, 3) + (1.2 * normal(views, n, 1)) * way
    p = torch.linalg.solve(A[:, None], torch.cat([world, torch.ones(views, n, 1)], dim=-1)[..., None])[..., 0]
    return (p[..., :3] / p[..., 3:] + sigma * normal(views, n, 3)).unbind(0), A[1:]


@pytest.mark.slow
def test_a_plane_in_five_views_with_labels():
    sigma, still, wrong = 0.5, 20, 12
    views, A = plane(5, 80, sigma, static=still, wrong=wrong)
    result = dyn.align_planar(*views, threshold=3 * sigma, generator=torch.Generator().manual_seed(0)).check()
    assert result.collineations.shape == (4, 3, 3) and torch.equal(result.collineations[0], result.A)
    assert torch.equal(result.collineations[1], result.B) and result.covariance.shape == (36, 36)
    truth = torch.tensor([1] * still + [2] * (80 - still - wrong) + [0] * wrong)
    assert float((result.labels == truth)[: 80 - wrong].double().mean()) > 0.95 and not (result.labels[-wrong:] == 1).any()
    assert abs(float(result.sigma) / sigma - 1) < 0.15
    deviation = result.covariance.diagonal().sqrt().unflatten(-1, (4, 9)).norm(dim=-1)
    assert (relative_error(result.collineations, A) < 4 * deviation).all()


@pytest.mark.slow
def test_noise_falls_with_the_number_of_views():
    """Of the same first three views: the more views lie on the lines, the better these are known, and with them A and B."""
    takes = [plane(5, 210, 0.5, seed=seed) for seed in range(12)]
    views = torch.stack([torch.stack(seen) for seen, _ in takes], dim=1)
    A = torch.stack([maps for _, maps in takes], dim=1)
    errors = []
    for count in (3, 4, 5):
        some = [x / 300 for x in views[:count]]
        refined = dyn.refine(dyn.fit(dyn.DynamicTensor(2, count, 2), *some), *some)
        scale = torch.diag(torch.tensor([1 / 300, 1 / 300, 1.0]).double())
        true = scale @ A[:2] @ torch.linalg.inv(scale)
        errors.append(float(relative_error(torch.stack(refined.motion[:2]), true).square().mean().sqrt()))
    assert errors[0] > 1.03 * errors[1] > 1.03**2 * errors[2], errors


@pytest.mark.slow
def test_space_in_four_views_without_a_threshold():
    sigma = 2e-3
    views, A = space(4, 80, sigma, static=20)
    result = dyn.align_points(*views, generator=torch.Generator().manual_seed(0)).check()
    assert result.collineations.shape == (3, 4, 4)
    assert float(relative_error(result.collineations, A).max()) < 0.01
    assert float((result.labels[:20] == 1).double().mean()) > 0.9 and float((result.labels[20:] == 2).double().mean()) > 0.9
    assert abs(float(result.sigma) / sigma - 1) < 0.15
    # static ones known, in a batch of two beside a problem that is not there
    both = [torch.stack([x, x * torch.nan]) for x in views]
    known = torch.arange(80) < 20
    two = dyn.align_points(*both, model="join", threshold=3 * sigma, static=known, generator=torch.Generator().manual_seed(0))
    assert two.status.tolist() == [dyn.Status.OK, dyn.Status.TOO_FEW]
    assert float(relative_error(two.collineations[0], A).max()) < 0.01 and float(two.collineations[1].abs().max()) == 0


MODELS = ("constant_velocity", "affine_constant_velocity", "rigid")


def test_models_of_three_views_say_so():
    views, _ = space(4, 60, 0.0)
    three = "takes three views, got 4; model='join' takes any number"
    assert_refused(
        *((lambda m=m: dyn.align_points(*views, model=m), f"model='{m}' {three}") for m in MODELS),
        (lambda: dyn.align_points(*views[:3], model="bent"), "model must be one of"),
        (lambda: dyn.align_planar(*plane(4, 40, 0.5)[0]).solution.singular_values, "has no estimation matrix"),
    )
