"""Hypotheses from few tracks against what is known, and how alike tracks move."""

from __future__ import annotations

from dataclasses import replace

import cv2
import pytest
import torch

from dyntorch.geometry.homogeneous import apply, homogeneous, unit
from dyntorch.metrics import relative_error
from dyntorch.tasks.segment import agglomeration
from dyntorch.tasks.segment.agglomeration import (
    affine_map,
    fundamental_of_eight,
    homography_of_four,
    links_of,
    preference_kernel,
    strongest,
)
from dyntorch.tasks.segment.frame_pairs import select_near_pairs
from tests.dyntorch.tasks.segment.videos import F64, draw, shot

SOLVERS = ((affine_map, 3), (homography_of_four, 4), (fundamental_of_eight, 8))
HYPOTHESES = 60


@pytest.fixture(autouse=True)
def few_pairs(monkeypatch):
    """Few pairs of frames are enough here."""
    monkeypatch.setattr(agglomeration, "KERNEL_PAIRS_PER_GAP", 3)


def points(*size: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(*size, 2, generator=draw(seed), dtype=F64) - 0.5


def kernel_of(scene, searched=None, seed: int = 0):
    everything = torch.arange(len(scene.labels)) if searched is None else searched
    return preference_kernel(scene.film(), everything, draw(seed), HYPOTHESES)


@pytest.mark.parametrize("seed", range(3))
def test_affine_maps_take_three_points_to_three(seed):
    x1, x2 = points(3, seed=seed), points(3, seed=seed + 10)
    found = affine_map(x1, x2)
    known = torch.linalg.solve(homogeneous(x1), x2).mT
    torch.testing.assert_close(found[:2], known, rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(found[2], torch.tensor([0.0, 0, 1], dtype=F64), rtol=0, atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_homographies_of_four_points_are_those_of_opencv(seed):
    square = torch.tensor([[0.0, 0], [1, 0], [1, 1], [0, 1]], dtype=F64)
    x1, x2 = square + 0.4 * points(4, seed=seed), square + 0.4 * points(4, seed=seed + 10)
    found = homography_of_four(x1, x2)
    known = torch.from_numpy(cv2.getPerspectiveTransform(x1.float().numpy(), x2.float().numpy()))
    assert float(found.norm()) == pytest.approx(1.0)
    torch.testing.assert_close(unit(found), unit(known), rtol=0, atol=1e-4)
    torch.testing.assert_close(apply(found, x1), x2, rtol=0, atol=1e-8)


@pytest.mark.parametrize("seed", range(3))
def test_matrices_of_eight_matches_are_the_null_vectors_and_the_truth(seed):
    scene = shot((30,), sigma=0.0, seed=seed)
    film = scene.film()
    x1, x2 = film.x[0][::3][:8], film.x[-1][::3][:8]
    found = fundamental_of_eight(x1, x2)
    rows = (homogeneous(x2)[:, :, None] * homogeneous(x1)[:, None]).flatten(1)
    known = torch.linalg.svd(rows)[2][-1].reshape(3, 3)
    assert float(found.norm()) == pytest.approx(1.0)
    assert float(relative_error(found, known)) < 1e-5
    back = film.change.inverse()
    true = back.mT @ scene.fundamental(0, 0, 9) @ back
    assert float(relative_error(found, true)) < 1e-4


@pytest.mark.parametrize(("solver", "count"), SOLVERS)
def test_batches_are_loops(solver, count):
    x1, x2 = points(2, 5, count), points(2, 5, count, seed=1)
    found = solver(x1, x2)
    assert found.shape == (2, 5, 3, 3)
    for i in range(2):
        for j in range(5):
            torch.testing.assert_close(found[i, j], solver(x1[i, j], x2[i, j]), rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize(("solver", "count"), SOLVERS)
@pytest.mark.parametrize("case", ["one point", "a line", "nothing moves", "zero"])
def test_degenerate_samples_are_finite(solver, count, case):
    x1, x2 = points(4, count), points(4, count, seed=1)
    if case == "one point":
        x1 = x1[:, :1].expand_as(x1).clone()
    elif case == "a line":
        x1 = torch.stack([x1[..., 0], 2 * x1[..., 0] + 0.25], -1)
    elif case == "nothing moves":
        x2 = x1.clone()
    else:
        x1, x2 = torch.zeros_like(x1), torch.zeros_like(x2)
    assert bool(solver(x1, x2).isfinite().all())


def test_the_kernel_is_symmetric_between_0_and_1_and_knows_the_bodies():
    scene = shot((40, 30, 20))
    kernel = kernel_of(scene)
    assert kernel.shape == (90, 90) and kernel.dtype == torch.float32
    assert bool((kernel >= 0).all()) and bool((kernel <= 1 + 1e-6).all()) and bool((kernel.diagonal() == 0).all())
    torch.testing.assert_close(kernel, kernel.mT, rtol=0, atol=1e-6)
    alike = scene.labels[:, None] == scene.labels
    alike.fill_diagonal_(False)
    others = scene.labels[:, None] != scene.labels
    for body in (1, 2, 3):
        own = scene.labels == body
        assert float(kernel[own][alike[own]].mean()) > 1.4 * float(kernel[own][others[own]].mean())
    top = kernel.topk(3).indices
    assert float((scene.labels[top] == scene.labels[:, None]).double().mean()) > 0.9


def test_a_kernel_of_some_tracks_has_a_column_for_each():
    scene = shot((40, 30))
    searched = torch.arange(0, 70, 2)
    kernel = kernel_of(scene, searched)
    assert kernel.shape == (70, 35)
    assert bool((kernel[searched, torch.arange(35)] == 0).all())
    assert bool((kernel[1::2].sum(-1) > 0).all())  # those that are not searched are compared, too
    best = kernel.argmax(-1)
    assert float((scene.labels[searched][best] == scene.labels).double().mean()) > 0.9


def twins(frames: int):
    """A scene in which track 32 goes beside track 0."""
    scene = shot((20, 12), frames=frames)
    copy = scene.tracks[:, :1] + 3.0
    return replace(scene, tracks=torch.cat([scene.tracks, copy], 1), labels=torch.cat([scene.labels, scene.labels[:1]]))


def test_a_track_has_most_in_common_with_one_beside_it(monkeypatch):
    monkeypatch.setattr(agglomeration, "KERNEL_GAPS", (1,))
    kernel = kernel_of(twins(frames=2))
    assert float(kernel[0, 32]) > 0.5 and int(kernel[0].argmax()) == 32
    # one pair of frames: the share of preferences is a multiple of 1 / (3 h)
    few = 3 * round(agglomeration.PREFERRED_SHARE * HYPOTHESES)
    torch.testing.assert_close(kernel * few, (kernel * few).round(), rtol=0, atol=1e-3)


def test_the_kernel_is_the_mean_over_the_pairs_that_show_both():
    scene = twins(frames=6)
    scene.tracks[4:, 32] = torch.nan  # it counts by what is there
    assert float(kernel_of(scene)[0, 32]) > 0.7


def test_tracks_that_never_meet_have_nothing_in_common():
    scene = shot((50,), frames=8)
    tracks = scene.tracks.clone()
    tracks[4:, :25] = torch.nan
    tracks[:4, 25:] = torch.nan
    apart = replace(scene, tracks=tracks)
    assert select_near_pairs(apart.film(), agglomeration.KERNEL_GAPS, 3, agglomeration.MIN_KERNEL_TRACKS)
    kernel = kernel_of(apart)
    assert bool((kernel[:25, 25:] == 0).all()) and bool((kernel[25:, :25] == 0).all())
    assert bool(kernel.isfinite().all()) and float(kernel[:25, :25].sum()) > 0 and float(kernel[25:, 25:].sum()) > 0


def test_the_strongest_of_every_row_or_column_are_kept():
    draws = torch.rand(30, 30, generator=draw())
    kernel = (draws + draws.mT) / 2
    kernel.fill_diagonal_(0.0)
    sparse = strongest(kernel, 4)
    assert bool((sparse == sparse.mT).all())
    assert bool(((sparse == 0) | (sparse == kernel)).all())
    rank = kernel.argsort(-1, descending=True).argsort(-1) < 4
    assert bool(((sparse > 0) == (rank | rank.mT)).all())
    assert bool((strongest(kernel[:3, :3], 10) == kernel[:3, :3]).all())  # fewer tracks than neighbours


def test_links_weigh_about_the_total_for_each_track():
    kernel = kernel_of(shot((40, 30)))
    sparse = strongest(kernel, 10)
    links = links_of(sparse, 18.0)
    dense = torch.zeros_like(sparse, dtype=F64).scatter_add_(1, links.index, links.weight)
    torch.testing.assert_close(dense, dense.mT, rtol=0, atol=1e-5)
    assert bool(((dense > 0) == (sparse > 0)).all())
    torch.testing.assert_close(dense.sum(-1).mean(), torch.tensor(18.0, dtype=F64), rtol=0.1, atol=0)
    degree = sparse.sum(-1)
    torch.testing.assert_close(dense[0], (18 * sparse[0] / (degree[0] * degree).sqrt()).double(), rtol=1e-4, atol=1e-6)
    doubled = links_of(sparse, 36.0)
    torch.testing.assert_close(doubled.weight, 2 * links.weight, rtol=1e-5, atol=0)
