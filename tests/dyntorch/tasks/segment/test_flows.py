"""Affine flows: two of them recovered, what is random, what is absent; the mean field against a loop."""

from __future__ import annotations

import pytest
import torch

from dyntorch.tasks.segment.coherence import coherence, mean_field
from dyntorch.tasks.segment.search import affine_flows

F64 = torch.float64
NOISE = 0.005


def draw(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def two_flows(interleaved: bool = False):
    """Matches, their links and labels: a half of the image turns, the other shrinks and moves."""
    x1 = 2 * torch.rand(120, 2, generator=draw(), dtype=F64) - 1
    labels = torch.arange(120) % 2 if interleaved else (x1[:, 0] > 0.1).long()
    first = x1 @ torch.tensor([[0.98, -0.2], [0.2, 0.98]], dtype=F64).mT + torch.tensor([0.1, 0.0], dtype=F64)
    second = 0.9 * x1 + torch.tensor([-0.3, 0.35], dtype=F64)
    x2 = torch.where(labels[:, None] == 0, first, second) + NOISE * torch.randn(120, 2, generator=draw(1), dtype=F64)
    return x1, x2, coherence(x1, x2, 3 * NOISE).links, labels


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


def test_runs_have_their_own_number_of_flows():
    x1, x2, links, _ = two_flows()
    bodies = torch.tensor([1, 2, 3, 4, 2, 1])
    found = affine_flows(x1, x2, links, bodies, NOISE, draw())
    assert bool((found >= 0).all()) and bool((found.amax(-1) < bodies).all())


def test_randomness_comes_from_the_generator():
    x1, x2, links, _ = two_flows()
    bodies = torch.full((12,), 3)
    runs = [affine_flows(x1, x2, links, bodies, NOISE, draw(seed)) for seed in (5, 5, 6)]
    assert torch.equal(runs[0], runs[1]) and not torch.equal(runs[0], runs[2])
    # the runs themselves differ too
    assert len(runs[0].unique(dim=0)) > 1


def test_few_and_equal_matches():
    for n in (4, 8):
        x = torch.rand(n, 2, generator=draw(), dtype=F64)
        for x1, x2 in ((x, x), (x[:1].expand(n, 2), x[:1].expand(n, 2)), (x, x[:1].expand(n, 2))):
            found = affine_flows(
                x1,
                x2,
                coherence(x1, x2, NOISE).links,
                torch.tensor([1, 2, 3]),
                NOISE,
                draw(),
            )
            assert found.shape == (3, n) and bool((found.amax(-1) < torch.tensor([1, 2, 3])).all())


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
