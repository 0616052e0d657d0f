"""Whether so many matches would agree by chance."""

from __future__ import annotations

from math import comb, log

import pytest
import torch

import dyntorch as dyn
from dyntorch import scenes
from dyntorch.core.outcome import Status
from dyntorch.tasks.segment.coherence import THRESHOLD_PIXELS, Links, View
from dyntorch.tasks.segment.labels import _alarms, _chance, significant


def draw(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def noise(n: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    size = torch.tensor([640.0, 480.0], dtype=torch.float64)
    first, second = torch.rand(2, n, 2, generator=draw(seed), dtype=torch.float64)
    return first * size, second * size


@pytest.mark.parametrize(("n", "k", "p"), [(8, 8, 0.02), (50, 20, 0.015), (400, 60, 0.3)])
def test_expected_number_of_false_alarms(n, k, p):
    assert _alarms(n, k, p) == pytest.approx(log((n - 7) * comb(n, k) * comb(k, 7) * p ** (k - 7)))


def test_chance_is_the_share_of_random_points_near_a_line_at_most():
    x, _ = noise(20000, 0)
    lines = torch.randn(200, 2, generator=draw(1), dtype=torch.float64)
    lines = lines / lines.norm(dim=-1, keepdim=True)
    middle = torch.tensor([320.0, 240.0], dtype=torch.float64)
    near = ((x - middle) @ lines.mT).abs() < THRESHOLD_PIXELS
    # the bound is the longest line, along the diagonal
    assert float(near.double().mean()) < _chance(x, THRESHOLD_PIXELS) < 2 * float(near.double().mean(0).max())


def test_bodies_are_believed_and_accidents_are_not():
    scene = scenes.bodies(60, interleaved=True, sigma=0.5, outliers=0.2, generator=draw(2))
    none = Links(torch.zeros(60, 0, dtype=torch.long), torch.zeros(60, 0, dtype=torch.float64))
    view = View(*scene.views, 1.0, none)
    fundamentals = torch.stack(scene.motion)
    assert significant(view, fundamentals, scene.labels, false_alarms=1e-2).all()
    random = torch.randn(2, 3, 3, generator=draw(3), dtype=torch.float64)
    assert not significant(view, random, scene.labels, false_alarms=1e-2).any()


@pytest.mark.slow
@pytest.mark.parametrize("n", [8, 20, 60])
@pytest.mark.parametrize("bodies", [None, 1])
def test_random_matches_have_no_bodies(n, bodies):
    found = dyn.segment(*noise(n, n), bodies, spatial=False, generator=draw())
    assert int(found.bodies) == 0 and not found.labels.any()
    assert int(found.status) == Status.NO_CONSENSUS
