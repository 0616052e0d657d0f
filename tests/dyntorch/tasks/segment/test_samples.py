"""Segmentation by geometry alone: bodies that share the whole image, and outliers."""

import pytest
import torch

import dyntorch as dyn
from dyntorch import scenes
from dyntorch.geometry.epipolar import sampson_squared
from dyntorch.metrics import misclassification
from dyntorch.tasks.segment.coherence import ENERGY_MAX_SQUARED_DISTANCE, SAMPSON_NOISE_PIXELS, Links, View
from dyntorch.tasks.segment.search import MIN_BODY_MATCHES, matrix_pairs, search_samples


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def view_of(scene, pixel=0.005):
    """In units of 200 pixels around the middle."""
    x1, x2 = ((x - torch.tensor([320.0, 240.0], dtype=x.dtype)) / 200 for x in scene.views)
    return View(x1, x2, pixel, Links(torch.zeros(len(x1), 0, dtype=torch.long), x1.new_zeros(len(x1), 0)))


def segmented(scene, bodies):
    found = dyn.segment(*scene.views, bodies=bodies, spatial=False, generator=generator())
    return found, float(misclassification(found.labels, scene.labels))


@pytest.mark.slow
@pytest.mark.parametrize(("n", "bodies", "outliers"), [((60, 60), 2, 0.0), ((60, 60), None, 0.2), ((60, 60, 60), 3, 0.2)])
def test_interleaved_bodies_are_found(n, bodies, outliers):
    scene = scenes.bodies(n, sigma=0.3, outliers=outliers, interleaved=True, generator=generator())
    found, error = segmented(scene, bodies)
    assert int(found.bodies) == len(n)
    assert int(found.status) == dyn.Status.OK
    assert error < 0.06


@pytest.mark.slow
def test_two_fifths_of_outliers_do_no_harm():
    scene = scenes.bodies((100, 100), sigma=0.3, outliers=0.4, interleaved=True, generator=generator(1))
    assert segmented(scene, 2)[1] < 0.06


@pytest.mark.parametrize("outliers", [0.0, 0.3])
def test_one_body_is_one(outliers):
    scene = scenes.bodies((100,), sigma=0.3, outliers=outliers, interleaved=True, generator=generator(2))
    assert int(segmented(scene, None)[0].bodies) == 1


@pytest.mark.slow
def test_the_same_numbers_give_the_same_bodies():
    scene = scenes.bodies((30, 30), sigma=0.3, interleaved=True, generator=generator(3))
    first, second = (segmented(scene, 2)[0] for _ in range(2))
    assert torch.equal(first.labels, second.labels)
    assert torch.equal(first.fundamentals, second.fundamentals)


@pytest.mark.slow
def test_candidates_are_ordered_and_cost_their_distances():
    scene = scenes.bodies((40, 40), sigma=0.3, outliers=0.2, interleaved=True, generator=generator(4))
    view = view_of(scene)
    found = search_samples(view, [1, 2, 3], generator(), max_samples=24000)
    assert sorted(found) == [1, 2, 3]
    for count, candidates in found.items():
        energies = [candidate.energy for candidate in candidates]
        assert energies == sorted(energies)
        square = torch.stack([sampson_squared(x.fundamentals, view.x1, view.x2).amin(0) for x in candidates])
        cost = (square / (SAMPSON_NOISE_PIXELS * view.pixel) ** 2).clamp(max=ENERGY_MAX_SQUARED_DISTANCE).sum(-1).min()
        assert energies[0] == pytest.approx(float(cost))
        for candidate in candidates:
            square = sampson_squared(candidate.fundamentals, view.x1, view.x2)
            near = square.argmin(0)[square.amin(0) < ENERGY_MAX_SQUARED_DISTANCE * (SAMPSON_NOISE_PIXELS * view.pixel) ** 2]
            assert int(torch.bincount(near, minlength=count).min()) >= MIN_BODY_MATCHES


def test_the_pair_of_the_segmentation_matrix_is_exact_without_noise():
    scene = scenes.bodies((40, 40), interleaved=True, generator=generator(5))
    view = view_of(scene)
    groups = torch.stack([torch.ones(80, dtype=torch.float64), (torch.arange(80) < 20).double()])
    for rounds in (0, 2):
        pair = matrix_pairs(view, groups, rounds)
        assert pair.shape == (2, 3, 3)  # the second group is too small
        assert float(sampson_squared(pair, view.x1, view.x2).amin(0).max()) < 1e-12
        assert matrix_pairs(view, groups[1:], rounds).shape == (0, 3, 3)


@pytest.mark.parametrize("count", [8, 12, 20])
def test_few_matches_and_matches_without_bodies_are_answered(count):
    x = 500 * torch.rand(2, count, 2, generator=generator(6), dtype=torch.float64)
    for bodies in (1, None):
        found = dyn.segment(x[0], x[1], bodies=bodies, spatial=False, generator=generator())
        assert found.labels.shape == (count,)
        assert bool(found.fundamentals.isfinite().all())


def test_matches_at_rest_are_answered():
    x = 500 * torch.rand(60, 2, generator=generator(7), dtype=torch.float64)
    found = dyn.segment(x, x, spatial=False, generator=generator())
    assert int(found.bodies) <= 1
    assert bool(found.fundamentals.isfinite().all())
