"""Affine factorization and metric upgrade: exact on exact views, and honest where the views do not decide."""

import math

import pytest
import torch

from dyntorch.numerics import affine_factorization, metric_upgrade
from tests.grid import grid


def random(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def orthographic(azimuth, elevation=0.0, scale=1.0):
    """``(3, 2)``: an upright camera turned about the vertical (y), then about its horizontal axis; degrees."""
    a, e = math.radians(azimuth), math.radians(elevation)
    x = [math.cos(a), 0.0, math.sin(a)]
    y = [math.sin(e) * math.sin(a), math.cos(e), -math.sin(e) * math.cos(a)]
    return scale * torch.tensor([x, y], dtype=torch.float64).T


def film(shape, cameras, offset_seed=1):
    """``(views, points, 2)``: every view has its own origin."""
    return shape @ torch.stack(cameras) + 10 * random(len(cameras), 1, 2, seed=offset_seed)


CAMERAS = [orthographic(0, 5, 1.0), orthographic(50, -5, 2.0), orthographic(110, 10, 0.7), orthographic(200, 0, 1.3)]


def solved(shape, cameras):
    affine, fitted, _ = affine_factorization(film(shape, cameras))
    return metric_upgrade(affine, fitted)


@pytest.mark.parametrize("views", [2, 3, 5])
def test_affine_views_are_rank_three(views):
    images = random(30, 3, seed=2) @ random(views, 3, 2, seed=3) + random(views, 1, 2, seed=4)
    shape, cameras, left = affine_factorization(images)
    assert shape.shape == (30, 3)
    assert cameras.shape == (views, 3, 2)
    assert left < 1e-20
    torch.testing.assert_close(shape @ cameras, images - images.mean(dim=1, keepdim=True), atol=1e-10, rtol=0)
    gram = shape.mT @ shape
    torch.testing.assert_close(gram, torch.diag(gram.diagonal()), atol=1e-9, rtol=0)


def test_unexplained_part_is_the_energy_beyond_rank_three():
    images = random(25, 3, seed=5) @ random(4, 3, 2, seed=6) + 0.1 * random(4, 25, 2, seed=7)
    _, _, left = affine_factorization(images)
    centred = images - images.mean(dim=1, keepdim=True)
    s = torch.linalg.svdvals(torch.cat(list(centred), dim=1))
    torch.testing.assert_close(left, s[3:].square().sum() / s.square().sum(), atol=1e-12, rtol=0)
    assert 0 < left < 0.05


def test_different_shapes_leave_much_unexplained():
    images = torch.stack([random(30, 3, seed=seed) @ orthographic(40 * seed) for seed in range(4)])
    assert affine_factorization(images)[2] > 0.2


def test_a_batch_is_factored_like_each_of_its_members():
    images = random(2, 3, 4, 20, 2, seed=8)
    shape, cameras, left = affine_factorization(images)
    assert shape.shape == (2, 3, 20, 3) and cameras.shape == (2, 3, 4, 3, 2) and left.shape == (2, 3)
    for i in range(2):
        for j in range(3):
            one_shape, one_cameras, one_left = affine_factorization(images[i, j])
            torch.testing.assert_close(shape[i, j] @ cameras[i, j], one_shape @ one_cameras, atol=1e-9, rtol=0)
            torch.testing.assert_close(left[i, j], one_left)


def test_float32_stays_float32_and_points_at_one_place_explain_nothing():
    shape, cameras, left = affine_factorization(torch.ones(3, 10, 2))
    assert shape.dtype == cameras.dtype == left.dtype == torch.float32
    assert float(left) == 1.0
    assert torch.isfinite(shape).all() and torch.isfinite(cameras).all()


@pytest.mark.parametrize("shape", [(1, 10, 2), (10, 2), (3, 10, 3)])
def test_wrong_views_are_refused(shape):
    with pytest.raises(ValueError, match="views must be"):
        affine_factorization(torch.zeros(shape))


@pytest.mark.parametrize("seed", range(4))
def test_metric_upgrade_recovers_distances_up_to_scale(seed):
    shape = random(25, 3, seed=seed)
    metric, decided = solved(shape, CAMERAS)
    assert bool(decided)
    truth, got = torch.cdist(shape, shape), torch.cdist(metric, metric)
    scale = truth.sum() / got.sum()
    torch.testing.assert_close(got * scale, truth, atol=1e-8, rtol=0)


def test_three_views_are_enough():
    shape = random(25, 3, seed=9)
    metric, decided = solved(shape, CAMERAS[:3])
    assert bool(decided)
    truth, got = torch.cdist(shape, shape), torch.cdist(metric, metric)
    torch.testing.assert_close(got * (truth.sum() / got.sum()), truth, atol=1e-7, rtol=0)


def test_noise_moves_the_result_only_a_little():
    shape = random(60, 3, seed=10)
    images = film(shape, CAMERAS) + 0.01 * random(4, 60, 2, seed=11)
    affine, cameras, left = affine_factorization(images)
    metric, decided = metric_upgrade(affine, cameras)
    assert bool(decided) and 0 < left < 1e-3
    truth, got = torch.cdist(shape, shape), torch.cdist(metric, metric)
    assert ((got * (truth.sum() / got.sum()) - truth).abs().max() / truth.max()) < 0.05


def test_vertical_is_that_of_the_images():
    shape = random(25, 3, seed=12)
    cameras = [orthographic(a, 0, s) for a, s in ((0, 1.0), (60, 1.5), (130, 0.8))]
    # upright cameras at one height leave Q undetermined in no direction only if their elevations differ, so tilt them evenly
    cameras += [orthographic(a, e, 1.0) for a, e in ((0, 10), (180, 10))]
    metric, decided = solved(shape, cameras)
    assert bool(decided)
    y = metric[:, 1] - metric[:, 1].mean()
    true = shape[:, 1] - shape[:, 1].mean()
    assert (y @ true) / (y.norm() * true.norm()) > 0.999  # and it points up, not down


def test_two_views_are_undecided_and_come_back_unchanged():
    affine, cameras, _ = affine_factorization(film(random(20, 3, seed=13), CAMERAS[:2]))
    metric, decided = metric_upgrade(affine, cameras)
    assert not bool(decided)
    assert torch.equal(metric, affine)


@pytest.mark.parametrize("count", [3, 5])
def test_identical_views_are_undecided(count):
    images = film(random(20, 3, seed=14), CAMERAS[:1]).repeat(count, 1, 1)
    affine, cameras, _ = affine_factorization(images)
    metric, decided = metric_upgrade(affine, cameras)
    assert not bool(decided)
    assert torch.equal(metric, affine)


def test_two_distinct_cameras_are_undecided_however_often_repeated():
    affine, cameras, _ = affine_factorization(film(random(20, 3, seed=15), [CAMERAS[0], CAMERAS[1]] * 3))
    assert not bool(metric_upgrade(affine, cameras)[1])


@grid(("seed", range(8)))
def test_a_flat_shape_is_undecided(seed):
    # the third row of every camera is then any vector of the null space, and nothing that it says can be believed
    shape = random(25, 3, seed=seed) * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)
    assert not bool(solved(shape, CAMERAS)[1])
