"""coherence: the graph of matches that move alike, against loops over the formula, and what it must not depend on."""

from __future__ import annotations

import math

import pytest
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from dyntorch.tasks.segment import coherence as module
from dyntorch.tasks.segment.coherence import (
    DEVIATION_TOLERANCE,
    EDGE_TOLERANCE,
    MIN_NEIGHBOUR_COHERENCE,
    NUM_EDGES,
    NUM_NEIGHBOURS,
    NUM_PASSES,
    RIDGE,
    Links,
    coherence,
    conformity,
)

F64 = torch.float64
SCALE = 0.01


def draw(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def points(n: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(n, 2, generator=draw(seed), dtype=F64)


def affine(x: torch.Tensor, noise: float = 0.0) -> torch.Tensor:
    matrix = torch.tensor([[1.1, 0.15], [-0.1, 0.9]], dtype=F64)
    return x @ matrix.mT + 0.3 + noise * torch.randn(x.shape, generator=draw(9), dtype=F64)


def mixed(n: int = 40) -> tuple[torch.Tensor, torch.Tensor]:
    """An affine field with noise, one match in four wrong, two repeated."""
    x1 = points(n)
    x2 = affine(x1, 0.01)
    x2[::4] = points(len(x2[::4]), 5)
    x1[1], x2[1] = x1[2], x2[2]
    return x1, x2


def similarity(zoom: float, angle: float) -> torch.Tensor:
    c, s = zoom * math.cos(angle), zoom * math.sin(angle)
    return torch.tensor([[c, -s], [s, c]], dtype=F64)


def deviations(a, b, i, neighbours):
    """The formula for one match, where the common motion is the identity."""
    size = [float((a[j] - a[i]).norm()) + SCALE for j in neighbours]
    moment, target = torch.zeros(2, 2, dtype=F64), torch.zeros(2, 2, dtype=F64)
    errors = [(b[j] - b[i]) - (a[j] - a[i]) for j in neighbours]
    for j, s, error in zip(neighbours, size, errors, strict=True):
        weight = math.exp(-((float(error.norm()) / s / DEVIATION_TOLERANCE) ** 2))
        moment += weight * torch.outer(a[j] - a[i], a[j] - a[i])
        target += weight * torch.outer(a[j] - a[i], error)
    moment += (RIDGE * moment.trace() + 4 * SCALE**2) * torch.eye(2, dtype=F64)
    local = torch.linalg.solve(moment, target)
    return [float((e - (a[j] - a[i]) @ local).norm()) / s for j, s, e in zip(neighbours, size, errors, strict=True)]


def brute_force(x1, x2):
    """Values and the dense matrix of links, one match at a time."""
    n = len(x1)
    joint = torch.cat([x1, x2], dim=-1)
    values = [1.0] * n

    def apart(i: int, j: int) -> bool:
        return bool((joint[i] - joint[j]).norm() >= SCALE / 6)

    for _ in range(NUM_PASSES):
        trusted, values, links = values, [0.0] * n, torch.zeros(n, n, dtype=F64)
        for a, b in ((x1, x2), (x2, x1)):
            for i in range(n):
                others = [
                    j
                    for j in range(n)
                    if apart(i, j) and trusted[j] > MIN_NEIGHBOUR_COHERENCE and all(apart(j, k) for k in range(j))
                ]
                others = sorted(others, key=lambda j: float((a[i] - a[j]).norm()))[:NUM_NEIGHBOURS]
                deviation = deviations(a, b, i, others)
                values[i] += sum(math.exp(-((d / DEVIATION_TOLERANCE) ** 2)) for d in deviation) / len(others) / 2
                for j, d in list(zip(others, deviation, strict=True))[:NUM_EDGES]:
                    weight = math.exp(-((d / EDGE_TOLERANCE) ** 2)) / 4
                    links[i, j] += weight
                    links[j, i] += weight
    return torch.tensor(values, dtype=F64), links


def dense(links: Links) -> torch.Tensor:
    return links.pull(torch.eye(len(links.index), dtype=F64)).mT


@pytest.mark.slow
def test_formula_one_match_at_a_time():
    x1, x2 = mixed(26)
    found = coherence(x1, x2, SCALE)
    values, links = brute_force(x1, x2)
    torch.testing.assert_close(found.values, values)
    torch.testing.assert_close(dense(found.links), links)
    assert bool((found.links.weight >= 0).all()) and bool((found.links.weight <= 1).all())


def test_links_are_symmetric_and_gathered_alike(monkeypatch):
    links = coherence(*mixed(), SCALE).links
    full = torch.zeros(40, 40, dtype=F64)
    for i in range(40):
        for j, weight in zip(links.index[i].tolist(), links.weight[i].tolist(), strict=True):
            full[i, j] += weight
    torch.testing.assert_close(full, full.mT)
    assert bool((full.diagonal() == 0).all())
    values = torch.randn(2, 3, 40, generator=draw(1), dtype=F64)
    torch.testing.assert_close(links.pull(values), values @ full)
    monkeypatch.setattr(module, "DENSE", 10)
    torch.testing.assert_close(Links(links.index, links.weight).pull(values), values @ full)


def test_cut_is_the_sum_over_pairs_in_different_bodies():
    links = coherence(*mixed(), SCALE).links
    full = dense(links)
    labels = torch.randint(0, 3, (2, 40), generator=draw(2))
    members = (labels[:, None] == torch.arange(3)[:, None]).to(F64)
    expected = [sum(full[i, j] for i in range(40) for j in range(i) if row[i] != row[j]) for row in labels]
    torch.testing.assert_close(links.cut(members), torch.stack(expected))


def test_subset_keeps_the_links_among_its_matches():
    links = coherence(*mixed(), SCALE).links
    keep = torch.randperm(40, generator=draw(3))[:23]
    torch.testing.assert_close(dense(links.subset(keep)), dense(links)[keep][:, keep])


@pytest.mark.parametrize("least", [0.05, 0.3, 0.6])
def test_components_are_those_of_the_graph(least):
    links = coherence(*mixed(90), SCALE).links
    among = torch.rand(90, generator=draw(4)) > 0.3
    full = dense(links)
    joined = (full > least) & among[:, None] & among
    count, expected = connected_components(coo_matrix(joined.numpy()), directed=False)
    found = links.components(least, among)
    assert len(found.unique()) == count
    # the name of a component is the least index in it
    assert all(int(found[i]) == int((torch.as_tensor(expected) == expected[i]).nonzero()[0, 0]) for i in range(90))


def test_components_of_a_chain_and_without_links():
    n = 50
    index = torch.stack([(torch.arange(n) - 1).clamp(min=0), (torch.arange(n) + 1).clamp(max=n - 1)], dim=-1)
    chain = Links(index, torch.ones(n, 2, dtype=F64))
    assert bool((chain.components(0.5, torch.ones(n, dtype=torch.bool)) == 0).all())
    split = torch.ones(n, dtype=torch.bool)
    split[20] = False
    assert chain.components(0.5, split).unique().tolist() == [0, 20, 21]
    none = Links(torch.zeros(n, 0, dtype=torch.long), torch.zeros(n, 0, dtype=F64))
    everything = torch.ones(n, dtype=torch.bool)
    assert torch.equal(none.components(0.5, everything), torch.arange(n))
    assert bool((none.pull(torch.ones(2, n, dtype=F64)) == 0).all())
    assert none.subset(torch.arange(7)).index.shape == (7, 0)


@pytest.mark.parametrize("angle", [0.0, 0.7])
def test_placing_and_turning_the_images_changes_nothing(angle):
    x1, x2 = mixed()
    turn, shift = similarity(1.0, angle), torch.tensor([30.0, -7.0], dtype=F64)
    found = coherence(x1, x2, SCALE)
    moved = coherence(x1 @ turn.mT + shift, x2 @ turn.mT - shift, SCALE)
    torch.testing.assert_close(moved.values, found.values, rtol=0, atol=1e-9)
    scaled = coherence(250 * x1, 250 * x2, 250 * SCALE)
    torch.testing.assert_close(scaled.values, found.values, rtol=0, atol=1e-9)
    torch.testing.assert_close(dense(scaled.links), dense(found.links), rtol=0, atol=1e-9)


def test_views_and_order_of_matches_do_not_matter():
    x1, x2 = mixed()
    found = coherence(x1, x2, SCALE)
    swapped = coherence(x2, x1, SCALE)
    torch.testing.assert_close(swapped.values, found.values)
    torch.testing.assert_close(dense(swapped.links), dense(found.links))
    order = torch.randperm(40, generator=draw(6))
    # not the two repeated ones, of which one or the other may be a neighbour
    torch.testing.assert_close(coherence(x1[order], x2[order], SCALE).values, found.values[order], rtol=0, atol=1e-9)


def test_affine_fields_are_coherent_and_random_matches_are_not():
    x1 = points(150)
    assert float(coherence(x1, affine(x1, 0.002), SCALE).values.min()) > 0.7
    found = coherence(x1, points(150, 1), SCALE)
    assert float(found.values.mean()) < 0.1
    assert int(found.links.components(0.3, found.values > 0.2).unique(return_counts=True)[1].max()) < 7
    # wrong matches among right ones
    x2 = affine(x1, 0.002)
    x2[:75] = points(75, 2)
    values = coherence(x1, x2, SCALE).values
    assert float((values[75:] > 0.35).double().mean()) > 0.97 and float((values[:75] < 0.2).double().mean()) > 0.9


def test_repeated_matches_confirm_nothing():
    # not the copies of random matches each other, nor those of a neighbour the local motion towards it
    for x1, x2 in ((points(60), points(60, 1)), mixed(60)):
        alone = coherence(x1, x2, SCALE)
        found = coherence(x1.repeat(6, 1), x2.repeat(6, 1), SCALE)
        torch.testing.assert_close(found.values, alone.values.repeat(6), rtol=0, atol=1e-9)
    same = coherence(x1[:1].expand(30, 2), x2[:1].expand(30, 2), SCALE)
    assert bool((same.values == 0).all()) and bool((same.links.weight == 0).all())


@pytest.mark.parametrize(("zoom", "angle"), [(2.0, 0.0), (0.5, 0.0), (1.0, math.pi / 2), (1.5, -2.0)])
def test_common_zoom_and_rotation_are_recognized(zoom, angle):
    x1 = points(200)
    x2 = x1 @ similarity(zoom, angle).mT + 0.5 + 0.002 * torch.randn(200, 2, generator=draw(7), dtype=F64)
    x2[:60] = zoom * points(60, 8)
    values = coherence(x1, x2, SCALE).values
    assert float((values[60:] > 0.35).double().mean()) > 0.97 and float((values[:60] < 0.2).double().mean()) > 0.9


@pytest.mark.parametrize("angle", [math.pi / 2, 2.0, math.pi])
def test_a_part_that_turns_far_is_as_coherent_as_the_rest(angle):
    x1 = points(200)
    right = x1[:, 0] > 0.7
    noise = 0.002 * torch.randn(200, 2, generator=draw(7), dtype=F64)
    x2 = torch.where(right[:, None], x1 @ similarity(1.0, angle).mT, x1 + 0.1) + noise
    found = coherence(x1, x2, SCALE)
    assert float(found.values[right].median()) > 0.7 and float(found.values[~right].median()) > 0.7
    assert float(found.links.cut(torch.stack([right, ~right]).double())) < 0.1 * float(found.links.weight.sum()) / 2


def test_conformity_asks_the_members_of_each_body_alone():
    x1 = points(120)
    right = x1[:, 0] > 0.5
    x2 = torch.where(right[:, None], x1 @ similarity(1.0, 0.3).mT, x1 + torch.tensor([0.2, -0.1], dtype=F64))
    found = conformity(x1, x2, torch.stack([~right, right]), SCALE)
    assert found.shape == (2, 120)
    assert float(found[0, ~right].min()) > 0.7 and float(found[1, right].min()) > 0.7
    assert float(found[0, right].mean()) < 0.4
    # all matches as one body: the coherence of one pass
    whole = conformity(x1, x2, torch.ones(1, 120, dtype=torch.bool), SCALE)[0]
    assert float((whole - coherence(x1, x2, SCALE).values).abs().max()) < 0.1
    assert bool((conformity(x1, x2, torch.zeros(1, 120, dtype=torch.bool), SCALE) == 0).all())


def test_few_matches():
    for n in (1, 2, 3, 9):
        found = coherence(points(n), affine(points(n)), SCALE)
        assert found.values.shape == (n,) and bool(found.values.isfinite().all())
        assert found.links.index.shape[0] == n
