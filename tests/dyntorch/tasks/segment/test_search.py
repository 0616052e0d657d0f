"""The search for segmentations among matches without outliers: exact bodies, further starts, energies, too few matches."""

from __future__ import annotations

from dataclasses import replace
from math import inf

import pytest
import torch

from dyntorch import scenes
from dyntorch.core.outcome import Status
from dyntorch.geometry.epipolar import sampson_squared
from dyntorch.metrics import misclassification
from dyntorch.tasks.segment.coherence import View, coherence, energy
from dyntorch.tasks.segment.result import BodyModel
from dyntorch.tasks.segment.search import Candidate, search
from dyntorch.tasks.segment.segment import no_bodies, segmentation_notices, select_count

F64 = torch.float64
SCALE = 1 / 200


def draw(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def view_of(n, bodies=None, seed: int = 0, **options):
    """Matches of a scene around 0 at unit size, and their labels from 1."""
    scene = scenes.bodies(n, bodies, generator=draw(seed), **options)
    x1, x2 = (x * SCALE - torch.tensor([1.6, 1.2], dtype=F64) for x in scene.views)
    return View(x1, x2, SCALE, coherence(x1, x2, 3 * SCALE).links), scene.labels


@pytest.mark.parametrize("bodies", [1, 2, 3])
@pytest.mark.parametrize("sigma", [0.0, 0.5])
def test_bodies_are_all_right(bodies, sigma):
    view, truth = view_of(50 * bodies, bodies, seed=3, sigma=sigma)
    best = search(view, [bodies], draw(), num_starts=16)[bodies][0]
    assert float(misclassification(best.labels + 1, truth)) <= (0.0 if sigma == 0 else 0.01)
    square = sampson_squared(best.fundamentals, view.x1, view.x2).gather(0, best.labels[None])[0]
    assert float(square.sqrt().max()) / SCALE < (0.01 if sigma == 0 else 5 * sigma)


def test_several_numbers_of_bodies_at_once():
    view, truth = view_of(120, 2, seed=1, sigma=0.3)
    found = search(view, [1, 2, 3], draw(), num_starts=16)
    assert sorted(found) == [1, 2, 3]
    for count, candidates in found.items():
        assert candidates
        costs = [candidate.energy for candidate in candidates]
        assert costs == sorted(costs)
        for candidate in candidates:
            assert candidate.labels.shape == (120,) and candidate.fundamentals.shape == (count, 3, 3)
            assert int(torch.bincount(candidate.labels, minlength=count).min()) >= 7
            member = (candidate.labels == torch.arange(count)[:, None]).to(F64)
            cost = energy(view, candidate.fundamentals[None], member[None])
            assert candidate.energy == pytest.approx(float(cost), rel=1e-6)
    # one body more lowers the cost a lot where there is one, and little where there is none
    one, two, three = (found[count][0].energy for count in (1, 2, 3))
    assert one - two > 10 * abs(two - three)
    assert float(misclassification(found[2][0].labels + 1, truth)) == 0.0


def test_further_labellings_are_starts():
    view, truth = view_of(90, 3, seed=2, sigma=0.3)
    found = search(view, [3], draw(), [truth - 1, torch.zeros_like(truth)], num_starts=16)[3]
    assert float(misclassification(found[0].labels + 1, truth)) == 0.0
    # nothing found is cheaper than what the truth leads to
    assert found[0].energy <= search(view, [3], draw(), num_starts=16)[3][0].energy + 1e-9


@pytest.mark.parametrize(("n", "count"), [(20, 3), (13, 2), (8, 2)])
def test_too_few_matches_for_so_many_bodies(n, count):
    view, _ = view_of(n, 2, sigma=0.3)
    assert search(view, [count], draw(), num_starts=16).get(count, []) == []


def test_few_matches_are_one_body():
    view, _ = view_of(8, 1, sigma=0.3)
    (best, *_) = search(view, [1], draw(), num_starts=16)[1]
    assert bool((best.labels == 0).all()) and bool(best.fundamentals.isfinite().all())


def test_randomness_comes_from_the_generator():
    view, _ = view_of(60, 2, seed=4, sigma=0.5)
    first, second = (search(view, [2, 3], draw(5), num_starts=16) for _ in range(2))
    for count in (2, 3):
        assert [c.energy for c in first[count]] == [c.energy for c in second[count]]
        assert all(torch.equal(a.labels, b.labels) for a, b in zip(first[count], second[count], strict=True))


@pytest.mark.parametrize(("moved", "costs", "rival"), [(0, 5.0, inf), (4, 5.0, inf), (40, 5.0, 0.5), (40, 30.0, 3.0)])
def test_another_segmentation_of_little_more_cost_is_a_rival(moved, costs, rival):
    """Not the same one with a few other labels; in units of the root of the number of matches."""
    labels = torch.arange(100) % 2
    other = torch.where(torch.arange(100) < moved, 1 - labels, labels)
    pair = torch.zeros(2, 3, 3, dtype=torch.float64)

    def search(counts):
        return {count: [Candidate(100.0, labels, pair), Candidate(100.0 + costs, other, pair)] for count in counts if count == 2}

    chosen = select_count(search, 100, 2, penalty=4.5, max_bodies=12)
    assert chosen is not None and chosen.rival == pytest.approx(rival)


@pytest.mark.parametrize(("rival", "said"), [(0.5, True), (3.0, False), (inf, False)])
def test_two_views_that_hardly_decide_say_so(rival, said):
    problem = no_bodies(torch.ones(30, dtype=F64), 2.5, Status.OK, 0.0, 1.0)
    problem = replace(problem, models=(BodyModel.FUNDAMENTAL,) * 2, rival=rival)
    told = [str(notice) for notice in segmentation_notices([problem], None, ())]
    assert any("through more frames" in text for text in told) is said
