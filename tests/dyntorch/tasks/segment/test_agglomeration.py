"""Linear fits of groups, pieces of the graph of links, and how pieces become bodies."""

from __future__ import annotations

import pytest
import torch

from dyntorch.core.limits import MAX_SQUARED_DISTANCE
from dyntorch.geometry.epipolar import sampson_squared
from dyntorch.tasks.segment import agglomeration
from dyntorch.tasks.segment.agglomeration import (
    CHANCE_PREFERENCE_SHARE,
    COST_SCALE_FACTOR,
    MIN_PIECE_NOISE_PIXELS,
    PIECE_LINK_WEIGHT,
    GroupCosts,
    NearPairs,
    merge_pieces,
    pieces,
    preference_kernel,
    strongest,
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


def kernel_of(scene: Shot) -> torch.Tensor:
    return preference_kernel(scene.film(), torch.arange(len(scene.labels)), draw(), 100)


def halves(scene: Shot) -> torch.Tensor:
    """Labels ``(n,)`` from 0: two for every body, 2 k and 2 k + 1."""
    return 2 * (scene.labels - 1) + torch.arange(len(scene.labels)) % 2


def judge_of(scene: Shot, labels: torch.Tensor) -> GroupCosts:
    return GroupCosts.of(near_of(scene), kernel_of(scene), groups_of(labels))


def rms(near: NearPairs, group: torch.Tensor) -> float:
    square, seen = near.squares(group, 0.15)
    return float(square[seen].mean().sqrt())


def test_groups_that_move_as_one_are_on_their_epipolar_lines():
    scene = shot((40, 30), sigma=0.0)
    near = near_of(scene)
    square, seen = near.squares(scene.labels == 1, 0.15)
    assert square.shape == seen.shape == (len(near.seen), 40)
    pure = [rms(near, scene.labels == body) for body in (1, 2)]
    assert max(pure) < 1e-4 and rms(near, scene.labels > 0) > 100 * max(pure)


def test_distances_are_those_of_the_motion_that_most_tracks_have():
    scene = shot((60, 30), sigma=0.0)
    scene.tracks[:, 0] += torch.linspace(0, 9, 10, dtype=F64)[:, None]  # one goes astray
    film = scene.film()
    pairs = select_near_pairs(film, (5,), 3, 16)
    near = NearPairs(film, pairs)
    own = scene.labels == 1
    for row, (a, b) in zip(near.squares(own, 0.15, rounds=8)[0], pairs, strict=True):
        exact = sampson_squared(scene.fundamental(0, a, b), scene.tracks[a][own], scene.tracks[b][own])
        known = exact / (1 + (scene.tracks[b] - scene.tracks[a])[own].norm(dim=-1) / DOUBLED_VARIANCE_MOTION)
        assert float(row[1:].max()) < 0.05 < 0.3 * float(known[0])
        torch.testing.assert_close(row[0], known[0], rtol=0.3, atol=0)


def test_costs_count_sightings_up_to_a_cap():
    scene = shot((40, 30))
    judge = judge_of(scene, scene.labels - 1)
    groups = torch.stack([scene.labels == 1, scene.labels == 2, scene.labels > 0])
    cost = judge.cost(groups)
    for found, group in zip(cost.tolist(), groups, strict=True):
        square, seen = judge.near.squares(group, judge.scale)
        known = (square / judge.scale**2).clamp(max=MAX_SQUARED_DISTANCE)[seen].sum()
        assert found == pytest.approx(float(known), rel=1e-9)
        assert found <= MAX_SQUARED_DISTANCE * float(judge.near.count[group].sum())
    assert float(cost[2]) > 2 * float(cost[0] + cost[1])


def test_sightings_are_those_of_the_pairs_of_frames():
    scene = shot((40,))
    scene.tracks[:5, :10] = torch.nan
    near = near_of(scene)
    square, seen = near.squares(torch.ones(40, dtype=torch.bool), 0.15)
    assert bool(square.isfinite().all()) and int(seen.sum()) == int(near.seen.sum())
    assert near.count.tolist() == near.seen.sum(0).tolist() and float(near.count[0]) < float(near.count[20])


@pytest.mark.parametrize("count", [2, 6])
def test_pieces_of_two_bodies_are_pure(count):
    scene = shot((40, 40), sigma=0.05)
    found = pieces(strongest(kernel_of(scene), 8), count)
    assert found.shape == (80,) and sorted(found.unique().tolist()) == list(range(count))
    for piece in range(count):
        inside = scene.labels[found == piece]
        assert float((inside == inside.mode().values).double().mean()) > 0.9
    again = pieces(strongest(kernel_of(scene), 8), count)
    assert found.tolist() == again.tolist()


def test_pieces_of_a_graph_of_two_components():
    sparse = torch.zeros(20, 20)
    sparse[:10, :10], sparse[10:, 10:] = 0.5, 0.5
    sparse.fill_diagonal_(0.0)
    found = pieces(sparse, 2)
    assert bool((found[:10] == found[0]).all()) and bool((found[10:] == found[10]).all()) and found[0] != found[10]
    lonely = torch.zeros(25, 25)
    lonely[:20, :20] = sparse
    assert pieces(lonely, 2).shape == (25,)  # tracks without links get a label, too


def test_true_bodies_are_farther_apart_than_halves_of_one():
    scene = shot((40, 40, 40), sigma=0.1)
    judge = judge_of(scene, halves(scene))
    apart = judge.separation(groups_of(halves(scene)))
    value = apart.value(PIECE_LINK_WEIGHT)
    same = apart.first // 2 == apart.second // 2
    assert len(value) == 15 and int(same.sum()) == 3
    assert float(value[same].max()) < float(value[~same].min())
    assert float(apart.excess[same].max()) < float(apart.excess[~same].min())
    assert float(apart.links[same].min()) > float(apart.links[~same].max())
    assert float(apart.ratio()[same].max()) < float(apart.ratio()[~same].min())


def test_separation_says_what_it_says():
    scene = shot((40, 30))
    judge, groups = judge_of(scene, halves(scene)), groups_of(halves(scene))
    apart = judge.separation(groups)
    place = 1  # groups 0 and 2
    one, other = groups[0], groups[2]
    assert (int(apart.first[place]), int(apart.second[place])) == (0, 2)
    cost = judge.cost(torch.stack([one, other, one | other])).tolist()
    seen = [float(judge.near.count[some].sum()) for some in (one, other)]
    assert float(apart.excess[place]) == pytest.approx((cost[2] - cost[0] - cost[1]) / min(seen), rel=1e-6)
    assert float(apart.own[place]) == pytest.approx((cost[0] + cost[1]) / sum(seen), rel=1e-6)
    links = float((kernel_of(scene) - CHANCE_PREFERENCE_SHARE).clamp(min=0)[one][:, other].sum())
    assert float(apart.links[place]) == pytest.approx(links / min(int(one.sum()), int(other.sum())), rel=1e-4)


def test_groups_that_never_meet_are_joined_last():
    scene = shot((40, 40, 40), frames=12, sigma=0.1)
    scene.tracks[6:, 40:80] = torch.nan
    scene.tracks[:6, 80:] = torch.nan  # body 3 comes when body 2 has gone
    judge = judge_of(scene, halves(scene))
    found = merge_pieces(judge, halves(scene), [2, 3])
    truth = scene.labels[:, None] == scene.labels
    assert bool(((found[3][:, None] == found[3]) == truth).all())
    assert bool((found[2][:40] == found[2][0]).all())


def test_the_judge_knows_the_noise_and_remembers_costs():
    scene = shot((40, 30), sigma=0.5)
    judge = judge_of(scene, scene.labels - 1)
    quiet = judge_of(shot((40, 30), sigma=0.0), scene.labels - 1)
    assert quiet.scale == pytest.approx(COST_SCALE_FACTOR * MIN_PIECE_NOISE_PIXELS)
    assert judge.scale > 1.5 * quiet.scale
    groups = groups_of(scene.labels - 1)
    first = judge.cost(groups)
    judge.near = None  # nothing is fitted twice
    assert judge.cost(groups.flip(0)).tolist() == first.flip(0).tolist()


def test_merged_labels_are_nested_and_end_at_the_bodies():
    scene = shot((40, 40, 40), sigma=0.1)
    judge = judge_of(scene, halves(scene))
    found = merge_pieces(judge, halves(scene), range(1, 7))
    assert sorted(found) == [1, 2, 3, 4, 5, 6]
    assert all(sorted(labels.unique().tolist()) == list(range(count)) for count, labels in found.items())
    for count in range(1, 6):
        coarse, fine = found[count], found[count + 1]
        assert all(len(coarse[fine == piece].unique()) == 1 for piece in range(count + 1))
    truth = scene.labels[:, None] == scene.labels
    assert bool(((found[3][:, None] == found[3]) == truth).all())
    assert sorted(merge_pieces(judge, halves(scene), [2, 4])) == [2, 4]
