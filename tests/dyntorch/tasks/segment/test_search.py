"""The search for segmentations among matches without outliers: exact bodies, further starts, energies, too few matches."""

from __future__ import annotations

from itertools import product
from math import inf

import pytest
import torch

import dyntorch as dyn
from dyntorch import scenes
from dyntorch.geometry.epipolar import sampson_squared
from dyntorch.metrics import misclassification
from dyntorch.tasks.segment import segment
from dyntorch.tasks.segment.coherence import coherence, energy, mean_field
from dyntorch.tasks.segment.search import Candidate, affine_flows, search
from dyntorch.tasks.segment.segment import select_count
from tests.dyntorch.tasks.segment.videos import F64, draw, view_of

SCALE = 1 / 200


def scene_view(n, bodies=None, seed: int = 0, **options):
    """Matches of a scene around 0 at unit size, and their labels from 1."""
    scene = scenes.bodies(n, bodies, generator=draw(seed), **options)
    return view_of(scene), scene.labels


@pytest.mark.parametrize("bodies", [1, 2, 3])
@pytest.mark.parametrize("sigma", [0.0, 0.5])
def test_bodies_are_all_right(bodies, sigma):
    view, truth = scene_view(50 * bodies, bodies, seed=3, sigma=sigma)
    best = search(view, [bodies], draw(), num_starts=16)[bodies][0]
    assert float(misclassification(best.labels + 1, truth)) <= (0.0 if sigma == 0 else 0.01)
    square = sampson_squared(best.fundamentals, view.x1, view.x2).gather(0, best.labels[None])[0]
    assert float(square.sqrt().max()) / SCALE < (0.01 if sigma == 0 else 5 * sigma)


def test_several_numbers_of_bodies_at_once():
    view, truth = scene_view(120, 2, seed=1, sigma=0.3)
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


def test_too_few_matches_for_so_many_bodies():
    for n, count in ((20, 3), (13, 2), (8, 2)):
        view, _ = scene_view(n, 2, sigma=0.3)
        assert search(view, [count], draw(), num_starts=16).get(count, []) == []
    view, _ = scene_view(8, 1, sigma=0.3)
    (best, *_) = search(view, [1], draw(), num_starts=16)[1]
    assert bool((best.labels == 0).all()) and bool(best.fundamentals.isfinite().all())


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


@pytest.mark.parametrize(("margin", "said"), [(inf, True), (0.0, False)])
def test_two_views_that_hardly_decide_say_so(monkeypatch, margin, said):
    monkeypatch.setattr(segment, "MIN_RUNNER_UP_COST", margin)
    scene = scenes.bodies(60, 2, sigma=0.5, generator=draw(4))
    monkeypatch.setattr(segment, "_runner_up_cost", lambda candidates: 1.0)
    assert ("through more frames" in repr(dyn.segment(*scene.views, 2, generator=draw()))) is said


NOISE = 0.005


def two_flows(interleaved: bool = False):
    """Matches, their links and labels: a half of the image turns, the other shrinks and moves."""
    x1 = 2 * torch.rand(120, 2, generator=draw(), dtype=F64) - 1
    labels = torch.arange(120) % 2 if interleaved else (x1[:, 0] > 0.1).long()
    first = x1 @ torch.tensor([[0.98, -0.2], [0.2, 0.98]], dtype=F64).mT + torch.tensor([0.1, 0.0], dtype=F64)
    second = 0.9 * x1 + torch.tensor([-0.3, 0.35], dtype=F64)
    x2 = torch.where(labels[:, None] == 0, first, second) + NOISE * torch.randn(120, 2, generator=draw(1), dtype=F64)
    return x1, x2, coherence(x1, x2, 3 * NOISE)[1], labels


def agreement(found, labels):
    same = (found == labels).double().mean(-1)
    return torch.maximum(same, 1 - same)


@pytest.mark.parametrize(("interleaved", "share"), [(False, 0.9), (True, 0.5)])
def test_two_flows_are_recovered(interleaved, share):
    x1, x2, links, labels = two_flows(interleaved)
    found = affine_flows(x1, x2, links, torch.full((16,), 2), NOISE, draw(2))
    assert found.shape == (16, 120) and found.dtype == torch.long
    right = agreement(found, labels)
    assert float(right.max()) == 1.0 and float((right > 0.97).double().mean()) >= share


def test_runs_have_their_own_number_of_flows_and_few_and_equal_matches():
    x1, x2, links, _ = two_flows()
    bodies = torch.tensor([1, 2, 3, 4, 2, 1])
    found = affine_flows(x1, x2, links, bodies, NOISE, draw())
    assert bool((found >= 0).all()) and bool((found.amax(-1) < bodies).all())
    for n in (4, 8):
        x = torch.rand(n, 2, generator=draw(), dtype=F64)
        for x1, x2 in ((x, x), (x[:1].expand(n, 2), x[:1].expand(n, 2)), (x, x[:1].expand(n, 2))):
            found = affine_flows(x1, x2, coherence(x1, x2, NOISE)[1], bodies[:3], NOISE, draw())
            assert found.shape == (3, n) and bool((found.amax(-1) < bodies[:3]).all())


def test_mean_field_one_match_at_a_time():
    _, _, links, _ = two_flows()
    cost = 3 * torch.rand(2, 3, 120, generator=draw(3), dtype=F64)
    found = mean_field(cost, links, 2.0, 3)
    member = torch.softmax(-cost, 1)
    for _ in range(3):
        fresh = torch.zeros_like(member)
        for i in range(120):
            pull = (member[..., links.index[i]] * links.weight[i]).sum(-1)
            fresh[..., i] = torch.softmax(2.0 * pull - cost[..., i], -1)
        member = (member + fresh) / 2
    torch.testing.assert_close(found, member)
    torch.testing.assert_close(found.sum(1), torch.ones(2, 120, dtype=F64))
    # from a start, without links, it goes half of the way to the softmax each time
    start = torch.full_like(cost, 1 / 3)
    alone = mean_field(cost, links, 0.0, 2, start)
    torch.testing.assert_close(alone, (start + 3 * torch.softmax(-cost, 1)) / 4)
    # what is absent is nowhere
    absent = cost.clone()
    absent[0, 2] = torch.inf
    assert bool((mean_field(absent, links, 2.0, 3)[0, 2] == 0).all())


TWO = ((60, 60), 2, 0.0), ((60, 60), None, 0.2), ((100, 100), 2, 0.4)


@pytest.mark.slow
@pytest.mark.parametrize(("n", "bodies", "outliers"), [((100,), None, 0.0), ((100,), None, 0.3), *TWO, ((60, 60, 60), 3, 0.2)])
def test_interleaved_bodies_are_found(n, bodies, outliers):
    scene = scenes.bodies(n, sigma=0.3, outliers=outliers, interleaved=True, generator=draw())
    found = dyn.segment(*scene.views, bodies=bodies, spatial=False, generator=draw())
    assert int(found.bodies) == len(n) and int(found.status) == dyn.Status.OK
    assert float(misclassification(found.labels, scene.labels)) < 0.06


def test_few_matches_matches_without_bodies_and_at_rest_are_answered():
    for count, bodies in product((8, 12, 20), (1, None)):
        found = dyn.segment(*random_points(count), bodies=bodies, spatial=False, generator=draw())
        assert found.labels.shape == (count,) and bool(found.fundamentals.isfinite().all())
    x = random_points(60)[0]
    found = dyn.segment(x, x, spatial=False, generator=draw())
    assert int(found.bodies) <= 1 and bool(found.fundamentals.isfinite().all())


def random_points(count):
    return 500 * torch.rand(2, count, 2, generator=draw(6), dtype=F64)
