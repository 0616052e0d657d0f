"""Points from projections and projections from points, against the SVD, closed forms and finite differences."""

from __future__ import annotations

import pytest
import torch

from dyntorch.geometry.triangulation import mask_missing, reproject, resect, triangulate
from dyntorch.metrics import relative_error
from tests.draws import random, seeded
from tests.grid import assert_refused

CASES = [(3, 2, 3), (4, 2, 3), (5, 2, 4), (6, 2, 5), (6, 3, 3), (2, 1, 4), (3, 1, 5)]  # k, dim, views


def scene(k, dim, views, n=40, batch=(), seed=0):
    g = seeded(seed)
    projections = torch.randn(*batch, views, dim + 1, k + 1, generator=g, dtype=torch.float64) / 4
    projections[..., -1, -1] += 2.0
    structure = torch.rand(*batch, n, k + 1, generator=g, dtype=torch.float64) * 2 - 1
    structure[..., -1] = 1.0
    return projections, structure, reproject(projections, structure)


def apart(a, b, dims=1):
    """Largest distance of matrices or vectors up to scale and sign."""
    return relative_error(a, b, dims=dims).max()


def test_reproject_is_the_division_by_the_depth_of_what_is_observed():
    projections, structure, x = scene(4, 2, 3, batch=(2,))
    image = torch.einsum("bvmk,bnk->bvnm", projections, structure)
    torch.testing.assert_close(x, image[..., :-1] / image[..., -1:])
    assert (reproject(projections, torch.zeros_like(structure)) == 0).all()
    x = torch.tensor([[[1.0, 2.0], [float("nan"), 0.0], [3.0, 4.0]]])
    images, weights = mask_missing(x, torch.tensor([[2.0, 1.0, float("nan")]]))
    assert images.tolist() == [[[1.0, 2.0], [0.0, 0.0], [0.0, 0.0]]] and weights.tolist() == [[2.0, 0.0, 0.0]]


@pytest.mark.parametrize(("k", "dim", "views"), CASES)
def test_points_and_projections_come_back(k, dim, views):
    projections, structure, x = scene(k, dim, views)
    found = triangulate(-3 * projections, x)
    torch.testing.assert_close(found.norm(dim=-1), torch.ones(40, dtype=torch.float64))
    assert apart(found, structure) < 1e-8
    assert apart(triangulate(projections, x, steps=2), structure) < 1e-11
    back = resect(5 * structure, x)
    torch.testing.assert_close(back.flatten(-2).norm(dim=-1), torch.ones(views, dtype=torch.float64))
    assert apart(back, projections, 2) < 1e-8


@pytest.mark.parametrize(("k", "dim", "views"), [(4, 2, 3), (6, 3, 3)])
def test_with_noise_they_are_the_last_singular_vectors_of_the_weighted_equations(k, dim, views):
    projections, structure, x = scene(k, dim, views)
    g = torch.Generator().manual_seed(1)
    x = x + 0.01 * torch.randn(x.shape, generator=g, dtype=torch.float64)
    weights = torch.rand(x.shape[:-1], generator=g, dtype=torch.float64) + 0.1
    found = triangulate(projections, x, weights)
    for j in (0, 17):
        rows = [
            weights[i, j].sqrt() * torch.cat([torch.eye(dim, dtype=torch.float64), -x[i, j, :, None]], 1) @ m / m.norm()
            for i, m in enumerate(projections)
        ]
        assert apart(found[j], torch.linalg.svd(torch.cat(rows)).Vh[-1]) < 1e-9
    back, points = resect(structure, x, weights), structure / structure.norm(dim=-1, keepdim=True)
    for i in range(views):
        rows = [
            weights[i, j].sqrt()
            * torch.kron(torch.cat([torch.eye(dim, dtype=torch.float64), -x[i, j, :, None]], 1), points[j][None])
            for j in range(len(points))
        ]
        assert apart(back[i].flatten(), torch.linalg.svd(torch.cat(rows)).Vh[-1]) < 1e-9


def test_steps_find_the_minimum_of_the_reprojection_error():
    projections, _, x = scene(4, 2, 4)
    x = x + 0.02 * random(*x.shape, seed=2)
    found = triangulate(projections, x, steps=8).requires_grad_()
    before, after = (reproject(projections, s) - x for s in (triangulate(projections, x), found))
    assert (after.square().sum((0, -1)) <= before.square().sum((0, -1))).all()
    after.square().sum().backward()
    assert found.grad.abs().max() < 1e-8


def test_lifted_cameras_come_from_the_points_that_they_see():
    lifts, cameras, structure = random(3, 3, 5), random(2, 3, 3, 3, seed=1), random(2, 20, 5, seed=2)
    x = reproject(cameras @ lifts, structure)
    assert apart(resect(structure, x, lifts=lifts), cameras, 2) < 1e-7


def test_missing_images_are_like_absent_ones():
    projections, structure, x = scene(4, 2, 5, n=30)
    x = x + 0.01 * torch.randn(x.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    holes = x.clone()
    holes[1, :10] = torch.nan
    weights = torch.ones(x.shape[:-1])
    weights[3, 5:] = 0
    found = triangulate(projections, holes, weights)
    assert apart(found[:5], triangulate(projections[[0, 2, 3, 4]], x[[0, 2, 3, 4]][:, :5])) < 1e-9
    assert apart(found[10:], triangulate(projections[[0, 1, 2, 4]], x[[0, 1, 2, 4]][:, 10:])) < 1e-9
    assert apart(resect(structure, holes)[1], resect(structure[10:], x[1:2, 10:])[0], 2) < 1e-9


def test_what_is_not_determined_is_zero_and_spoils_nothing():
    projections, structure, x = scene(4, 2, 3, n=30, batch=(3,))
    x = x.clone()
    x[0, 1:, 4] = torch.nan  # one view left
    projections[1, 1:] = projections[1, :1]  # one centre
    projections[2, 0] = torch.nan
    found = triangulate(projections, x.requires_grad_(), steps=1)
    assert (found[0, 4] == 0).all() and (found[1] == 0).all()
    assert found.isfinite().all() and (found[0].norm(dim=-1) > 0.5).sum() == 29
    alone = triangulate(projections[2, 1:], x[2, 1:].detach(), steps=1)
    assert apart(found[2].detach(), alone) < 1e-9  # a broken projection is like a view that is missing
    found.square().sum().backward()
    assert x.grad.isfinite().all()
    seen = torch.zeros(1, 30)
    seen[0, :6] = 1  # 12 equations for 14 unknowns
    assert (resect(structure[0], scene(4, 2, 1)[2][:, :30].detach(), seen) == 0).all()
    flat = structure[0].clone()
    flat[:, 0] = 0
    assert (resect(flat, torch.rand(1, 30, 2, dtype=torch.float64)) == 0).all()


def test_batch_is_loop_and_dtype_stays():
    projections, structure, x = scene(5, 2, 4, batch=(2, 3))
    points, back = triangulate(projections, x, steps=1), resect(structure, x)
    for i in range(2):
        for j in range(3):
            assert apart(points[i, j], triangulate(projections[i, j], x[i, j], steps=1)) < 1e-9
            assert apart(back[i, j], resect(structure[i, j], x[i, j]), 2) < 1e-9
    assert apart(triangulate(projections[0, 0], x[0], steps=1)[0], points[0, 0]) < 1e-9  # one set of projections for a batch
    assert triangulate(projections.float(), x.float()).dtype == resect(structure.float(), x.float()).dtype == torch.float32


@pytest.mark.slow
@pytest.mark.parametrize("steps", [0, 1])
def test_gradients(steps):
    projections, structure, x = scene(3, 2, 3, n=7)
    x = x + 0.01 * torch.randn(x.shape, generator=torch.Generator().manual_seed(4), dtype=torch.float64)

    def images(m, y):
        return reproject(m, triangulate(m, y, steps=steps))

    assert torch.autograd.gradcheck(images, (projections.requires_grad_(), x.requires_grad_()), atol=1e-5)
    assert torch.autograd.gradcheck(lambda s, y: reproject(resect(s, y), s), (structure.requires_grad_(), x), atol=1e-5)


def test_misuse():
    projections, structure, x = scene(3, 2, 3)
    negative = torch.ones(3, 40).index_fill(0, torch.tensor([1]), -3.0)
    assert_refused(
        (lambda: mask_missing(x, negative), "weights must not be negative, got -3; use 0 to leave an image out"),
        (lambda: triangulate(projections[:2], x), "projections must be"),
        (lambda: resect(structure[:5], x), "structure must be"),
        (lambda: triangulate(projections, x, torch.ones(3, 2)), "weights must be"),
        (lambda: triangulate(projections, x[0]), "x must be"),
        (lambda: reproject(projections, structure[:, :3]), "projections must be"),
        (lambda: resect(structure, x, lifts=torch.ones(3, 3, 5)), "lifts must be"),
    )
