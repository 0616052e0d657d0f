"""Courses against shapes that are known, periods and steps against motions that are known."""

import numpy as np
import pytest
import torch

from indexing.action.bank import Windows
from indexing.phase.indexer import smooth_phases
from indexing.phase.learning import period, synchronize_cycles
from indexing.phase.model import PhaseOptions, learn_course


def moving(phase, seed=0, periodic=True):
    """Ten joints that move, ``(F, 10, 3)``."""
    g = torch.Generator().manual_seed(seed)
    still, first, second = torch.randn(3, 10, 3, generator=g, dtype=torch.float64)
    turn = 2 * np.pi * phase[:, None, None]
    if periodic:
        return still + 0.4 * first * turn.cos() + 0.4 * second * turn.sin()
    return still + first * phase[:, None, None] + 0.5 * second * phase[:, None, None] ** 2


def filmed(points, seed):
    """Each frame by an affine camera of its own."""
    g = torch.Generator().manual_seed(seed)
    cameras = torch.randn(len(points), 3, 2, generator=g, dtype=torch.float64)
    return points @ cameras + torch.randn(len(points), 1, 2, generator=g, dtype=torch.float64)


@pytest.mark.parametrize("periodic", [True, False])
def test_a_course_tells_the_phase_of_new_views(periodic):
    phase = torch.rand(120, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    seen = torch.ones(120, 10, dtype=torch.bool)
    seen[::7, 3] = False
    x = filmed(moving(phase, periodic=periodic), 2) * seen[..., None]
    course = learn_course(x, seen, phase, torch.arange(120) % 3, harmonics=1, periodic=periodic)
    asked = torch.tensor([0.1, 0.3, 0.55, 0.8], dtype=torch.float64)
    curve = course.curve(Windows(filmed(moving(asked, periodic=periodic), 5)[:, None], torch.ones(4, 10, dtype=torch.bool)), 101)
    grid = torch.arange(101) / (101 if periodic else 100)
    assert (grid[curve.argmin(1)] - asked).abs().max() < 0.02
    assert curve.amin(1).max() < 1e-2 * curve.mean()


def test_a_period_is_found_in_a_view_that_drifts_and_none_where_nothing_repeats():
    seconds = torch.arange(0, 5, 1 / 30, dtype=torch.float64)
    camera = torch.tensor([[1.0, 0.0], [0.0, 1.0], [0.4, 0.1]], dtype=torch.float64)
    found, depth = period(moving(seconds / 1.2) @ camera * (1 + 0.1 * seconds)[:, None, None], seconds, PhaseOptions())
    assert abs(found - 1.2) < 0.02 and depth < 0.1
    assert synchronize_cycles([(moving(seconds / 5, periodic=False) @ camera, seconds)], PhaseOptions()) is None


def test_two_views_are_brought_into_step():
    seconds = torch.arange(0, 4, 1 / 25, dtype=torch.float64)
    cameras = torch.randn(2, 3, 2, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    clips = [
        (moving(seconds / tempo + start) @ camera, seconds)
        for camera, tempo, start in zip(cameras, (1.0, 1.3), (0.0, 0.4), strict=True)
    ]
    first, second = synchronize_cycles(clips, PhaseOptions())
    apart = (first - seconds) - (second - seconds / 1.3 - 0.4)
    apart = apart - apart.mean().round()
    assert torch.exp(2j * np.pi * apart).mean().angle().abs() / (2 * np.pi) < 0.05


def test_neighbours_lower_the_noise_of_a_phase_and_skip_what_is_not_known():
    t = np.arange(60) / 30
    true = (0.9 * t + 0.7) % 1
    noisy = (true + np.random.default_rng(0).normal(scale=0.05, size=60)) % 1
    noisy[10] = np.nan
    found = smooth_phases(np.stack([noisy, true], 1), t, 0.5, np.array([True, False]))
    off = np.abs((found[:, 0] - true + 0.5) % 1 - 0.5)
    assert off.mean() < 0.6 * np.nanmean(np.abs((noisy - true + 0.5) % 1 - 0.5))
    assert found[10, 1] == np.median(true[3:18])
