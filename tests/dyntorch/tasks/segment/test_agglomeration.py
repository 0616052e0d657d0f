"""Linear fits of groups, pieces of the graph of links, and how pieces become bodies."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import cv2
import pytest
import torch

from dyntorch.geometry.epipolar import sampson_squared
from dyntorch.geometry.homogeneous import apply, homogeneous, unit
from dyntorch.metrics import relative_error
from dyntorch.tasks.segment import agglomeration
from dyntorch.tasks.segment.agglomeration import (
    CHANCE_PREFERENCE_SHARE,
    PIECE_LINK_WEIGHT,
    GroupCosts,
    NearPairs,
    affine_map,
    cut_into_pieces,
    fundamental_of_eight,
    homography_of_four,
    keep_strongest,
    links_of,
    merge_pieces,
    preference_kernel,
)
from dyntorch.tasks.segment.frame_pairs import DOUBLED_VARIANCE_MOTION, select_near_pairs
from dyntorch.tasks.segment.search import one_hot
from dyntorch.tasks.segment.tracks import MERGE_GAPS, MERGE_PAIRS_PER_GAP
from tests.dyntorch.tasks.segment.videos import F64, Shot, draw, shot


@pytest.fixture(autouse=True)
def few_pairs(monkeypatch):
    """A kernel of few pairs of frames is enough here."""
    monkeypatch.setattr(agglomeration, "KERNEL_PAIRS_PER_GAP", 5)


def near_of(scene: Shot) -> NearPairs:
    film = scene.film()
    return NearPairs(film, select_near_pairs(film, MERGE_GAPS, MERGE_PAIRS_PER_GAP, 16))


def groups_of(labels: torch.Tensor) -> torch.Tensor:
    return one_hot(labels, int(labels.max()) + 1) > 0


def kernel_of(scene: Shot, searched: torch.Tensor | None = None) -> torch.Tensor:
    everything = torch.arange(len(scene.labels)) if searched is None else searched
    return preference_kernel(scene.film(), everything, draw(), HYPOTHESES)


def halves(scene: Shot) -> torch.Tensor:
    """Labels ``(n,)`` from 0: two for every body, 2 k and 2 k + 1."""
    return 2 * (scene.labels - 1) + torch.arange(len(scene.labels)) % 2


def judge_of(scene: Shot, labels: torch.Tensor) -> GroupCosts:
    return GroupCosts.of(near_of(scene), kernel_of(scene), groups_of(labels))


def test_groups_that_move_as_one_are_on_their_epipolar_lines():
    scene = shot((40, 30), sigma=0.0)
    scene.tracks[:5, :10] = torch.nan
    near = near_of(scene)
    body, whole = scene.labels == 1, scene.labels > 0
    (pure, seen), (mixed, both) = (near.squared_distances(group[None], 0.15) for group in (body, whole))
    assert bool(mixed.isfinite().all()) and float(pure[seen].mean().sqrt()) < 1e-4 < 1e-2 < float(mixed[both].mean().sqrt())
    # as often as pairs of frames show them
    assert int(seen.sum()) == int(near.seen[:, body].sum()) and int(both.sum()) == int(near.seen.sum())
    separate, _ = near.squared_distances(torch.stack([whole, body]), 0.15)
    torch.testing.assert_close(separate[:, 1:], pure)
    torch.testing.assert_close(separate[:, :1], mixed)
    assert near.count.tolist() == near.seen.sum(0).tolist() and float(near.count[0]) < float(near.count[20])


def test_distances_are_those_of_the_motion_that_most_tracks_have(monkeypatch):
    monkeypatch.setattr(agglomeration, "NUM_GROUP_REWEIGHTS", 8)
    scene = shot((60, 30), sigma=0.0)
    scene.tracks[:, 0] += torch.linspace(0, 9, 10, dtype=F64)[:, None]  # one goes astray
    film = scene.film()
    pairs = select_near_pairs(film, (5,), 3, 16)
    near = NearPairs(film, pairs)
    own = scene.labels == 1
    for row, (a, b) in zip(near.squared_distances(own[None], 0.15)[0][:, 0, own], pairs, strict=True):  # all see all
        exact = sampson_squared(scene.fundamental(0, a, b), scene.tracks[a][own], scene.tracks[b][own])
        known = exact / (1 + (scene.tracks[b] - scene.tracks[a])[own].norm(dim=-1) / DOUBLED_VARIANCE_MOTION)
        assert float(row[1:].max()) < 0.05 < 0.3 * float(known[0])
        torch.testing.assert_close(row[0], known[0], rtol=0.3, atol=0)


def test_pieces_of_two_bodies_are_pure():
    scene = shot((40, 40), sigma=0.05)
    sparse = keep_strongest(kernel_of(scene), 8)
    for count in (2, 6):
        found = cut_into_pieces(sparse, count)
        assert found.shape == (80,) and sorted(found.unique().tolist()) == list(range(count))
        for piece in range(count):
            inside = scene.labels[found == piece]
            assert float((inside == inside.mode().values).double().mean()) > 0.9
        assert found.tolist() == cut_into_pieces(sparse, count).tolist()
    graph = torch.zeros(25, 25)  # of two components and tracks without links
    graph[:10, :10], graph[10:20, 10:20] = 0.5, 0.5
    graph.fill_diagonal_(0.0)
    found = cut_into_pieces(graph[:20, :20], 2)
    assert bool((found[:10] == found[0]).all()) and bool((found[10:] == found[10]).all()) and found[0] != found[10]
    assert cut_into_pieces(graph, 2).shape == (25,)


def test_true_bodies_are_farther_apart_than_halves_of_one():
    scene = shot((40, 40, 40), sigma=0.1)
    kernel, groups = kernel_of(scene), groups_of(halves(scene))
    judge = GroupCosts.of(near_of(scene), kernel, groups)
    apart = judge.separation(groups)
    same = apart.first // 2 == apart.second // 2
    assert len(same) == 15 and int(same.sum()) == 3
    for value in (apart.value(PIECE_LINK_WEIGHT), apart.excess, -apart.links, apart.ratio()):
        assert float(value[same].max()) < float(value[~same].min())
    place = 1  # groups 0 and 2, by the definitions
    one, other = groups[0], groups[2]
    assert (int(apart.first[place]), int(apart.second[place])) == (0, 2)
    cost = judge.cost(torch.stack([one, other, one | other])).tolist()
    seen = [float(judge.near.count[some].sum()) for some in (one, other)]
    assert float(apart.excess[place]) == pytest.approx((cost[2] - cost[0] - cost[1]) / min(seen), rel=1e-6)
    assert float(apart.own[place]) == pytest.approx((cost[0] + cost[1]) / sum(seen), rel=1e-6)
    links = float((kernel - CHANCE_PREFERENCE_SHARE).clamp(min=0)[one][:, other].sum())
    assert float(apart.links[place]) == pytest.approx(links / min(int(one.sum()), int(other.sum())), rel=1e-4)


def test_merged_labels_are_nested_and_end_at_the_bodies():
    scene = shot((40, 40, 40), sigma=0.1)
    judge, truth = judge_of(scene, halves(scene)), scene.labels[:, None] == scene.labels
    found = merge_pieces(judge, halves(scene), range(1, 7))
    assert sorted(found) == [1, 2, 3, 4, 5, 6]
    assert all(sorted(labels.unique().tolist()) == list(range(count)) for count, labels in found.items())
    for count in range(1, 6):
        coarse, fine = found[count], found[count + 1]
        assert all(len(coarse[fine == piece].unique()) == 1 for piece in range(count + 1))
    assert bool(((found[3][:, None] == found[3]) == truth).all())
    assert sorted(merge_pieces(judge, halves(scene), [2, 4])) == [2, 4]
    scene = shot((40, 40, 40), frames=12, sigma=0.1)
    scene.tracks[6:, 40:80] = torch.nan
    scene.tracks[:6, 80:] = torch.nan  # body 3 comes when body 2 has gone: they are joined last
    found = merge_pieces(judge_of(scene, halves(scene)), halves(scene), [2, 3])
    assert bool(((found[3][:, None] == found[3]) == truth).all())
    assert bool((found[2][:40] == found[2][0]).all())


SOLVERS = ((affine_map, 3), (homography_of_four, 4), (fundamental_of_eight, 8))
HYPOTHESES = 100


def points(*size: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(*size, 2, generator=draw(seed), dtype=F64) - 0.5


def test_solvers_of_few_matches():
    for seed in range(3):
        x1, x2 = points(3, seed=seed), points(3, seed=seed + 10)
        found = affine_map(x1, x2)
        torch.testing.assert_close(found[:2], torch.linalg.solve(homogeneous(x1), x2).mT, rtol=1e-8, atol=1e-8)
        torch.testing.assert_close(found[2], torch.tensor([0.0, 0, 1], dtype=F64), rtol=0, atol=1e-9)
        square = torch.tensor([[0.0, 0], [1, 0], [1, 1], [0, 1]], dtype=F64)
        x1, x2 = square + 0.4 * points(4, seed=seed), square + 0.4 * points(4, seed=seed + 10)
        found = homography_of_four(x1, x2)
        known = torch.from_numpy(cv2.getPerspectiveTransform(x1.float().numpy(), x2.float().numpy()))
        assert float(found.norm()) == pytest.approx(1.0)
        torch.testing.assert_close(unit(found), unit(known), rtol=0, atol=1e-4)
        torch.testing.assert_close(apply(found, x1), x2, rtol=0, atol=1e-8)
        scene = shot((30,), sigma=0.0, seed=seed)
        film = scene.film()
        found = fundamental_of_eight(film.x[0][::3][:8], film.x[-1][::3][:8])
        back = film.change.inverse()
        assert float(found.norm()) == pytest.approx(1.0)
        assert float(relative_error(found, back.mT @ scene.fundamental(0, 0, 9) @ back)) < 1e-4


@pytest.mark.parametrize(("solver", "count"), SOLVERS)
def test_batches_of_samples_are_loops_and_degenerate_ones_finite(solver, count):
    x1, x2 = points(2, 5, count), points(2, 5, count, seed=1)
    found = solver(x1, x2)
    for i, j in product(range(2), range(5)):
        torch.testing.assert_close(found[i, j], solver(x1[i, j], x2[i, j]), rtol=1e-6, atol=1e-8)
    line = torch.stack([x1[..., 0], 2 * x1[..., 0] + 0.25], -1)
    for a, b in ((x1[..., :1, :].expand_as(x1), x2), (line, x2), (x1, x1), (0 * x1, 0 * x2)):
        assert bool(solver(a, b).isfinite().all())


def test_the_kernel_knows_the_bodies_and_tracks_that_never_meet_have_nothing_in_common():
    scene = shot((40, 30, 20))
    kernel = kernel_of(scene)
    assert kernel.shape == (90, 90) and kernel.dtype == torch.float32
    assert bool((kernel >= 0).all()) and bool((kernel <= 1 + 1e-6).all()) and bool((kernel.diagonal() == 0).all())
    torch.testing.assert_close(kernel, kernel.mT, rtol=0, atol=1e-6)
    alike = scene.labels[:, None] == scene.labels
    for body in (1, 2, 3):
        own = scene.labels == body
        count = int(own.sum())
        inside = float(kernel[own][alike[own]].sum()) / (count * (count - 1))
        assert inside > 1.4 * float(kernel[own][~alike[own]].mean())
    top = kernel.topk(3).indices
    assert float((scene.labels[top] == scene.labels[:, None]).double().mean()) > 0.9
    searched = torch.arange(0, 90, 2)  # a column for each of these
    some = kernel_of(scene, searched)
    assert some.shape == (90, 45) and bool((some[searched, torch.arange(45)] == 0).all())
    assert bool((some[1::2].sum(-1) > 0).all())  # those that are not searched are compared, too
    assert float((scene.labels[searched][some.argmax(-1)] == scene.labels).double().mean()) > 0.9
    scene = shot((50,), frames=8)
    scene.tracks[4:, :25] = torch.nan
    scene.tracks[:4, 25:] = torch.nan
    kernel = kernel_of(scene)
    assert bool((kernel[:25, 25:] == 0).all()) and bool((kernel[25:, :25] == 0).all())
    assert bool(kernel.isfinite().all()) and float(kernel[:25, :25].sum()) > 0 and float(kernel[25:, 25:].sum()) > 0


def twins(frames: int):
    """A scene in which track 32 goes beside track 0."""
    scene = shot((20, 12), frames=frames)
    copy = scene.tracks[:, :1] + 3.0
    return replace(scene, tracks=torch.cat([scene.tracks, copy], 1), labels=torch.cat([scene.labels, scene.labels[:1]]))


def test_the_strongest_of_every_row_or_column_are_kept():
    draws = torch.rand(30, 30, generator=draw())
    kernel = (draws + draws.mT) / 2
    kernel.fill_diagonal_(0.0)
    sparse = keep_strongest(kernel, 4)
    assert bool((sparse == sparse.mT).all())
    assert bool(((sparse == 0) | (sparse == kernel)).all())
    rank = kernel.argsort(-1, descending=True).argsort(-1) < 4
    assert bool(((sparse > 0) == (rank | rank.mT)).all())
    assert bool((keep_strongest(kernel[:3, :3], 10) == kernel[:3, :3]).all())  # fewer tracks than neighbours
    # links weigh about the total for each track
    sparse = keep_strongest(kernel_of(shot((40, 30))), 10)
    links = links_of(sparse, 18.0)
    dense = torch.zeros_like(sparse, dtype=F64).scatter_add_(1, links.index, links.weight)
    torch.testing.assert_close(dense, dense.mT, rtol=0, atol=1e-5)
    assert bool(((dense > 0) == (sparse > 0)).all())
    torch.testing.assert_close(dense.sum(-1).mean(), torch.tensor(18.0, dtype=F64), rtol=0.1, atol=0)
    degree = sparse.sum(-1)
    torch.testing.assert_close(dense[0], (18 * sparse[0] / (degree[0] * degree).sqrt()).double(), rtol=1e-4, atol=1e-6)
    doubled = links_of(sparse, 36.0)
    torch.testing.assert_close(doubled.weight, 2 * links.weight, rtol=1e-5, atol=0)
