"""Interpolation between frames against the function that was sampled, and which frames both cameras show."""

import math

import pytest
import torch

from dyntorch.tasks.pair.tracks import interpolate, overlap

NAN = math.nan


def wave(times):
    return torch.stack([torch.sin(5 * times), torch.cos(3 * times)], dim=-1)[:, None]


def test_between_frames_of_any_spacing():
    times = torch.arange(50, dtype=torch.float64) / 30
    times = times + 0.004 * torch.rand(50, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    at = torch.linspace(float(times[0]), float(times[-1]), 333, dtype=torch.float64)
    assert float((interpolate(wave(times), times, at) - wave(at)).abs().max()) < 1e-4


def test_frames_that_are_met_need_no_neighbours():
    times = torch.arange(9, dtype=torch.float64)
    x = wave(times)
    x[[3, 5]] = NAN
    found = interpolate(x, times, times)
    assert torch.equal(found.isnan(), x.isnan())
    torch.testing.assert_close(found, x, equal_nan=True, atol=1e-12, rtol=0)
    assert interpolate(x, times, times + 0.5).isnan().all(-1).flatten().nonzero().flatten().tolist() == [2, 3, 4, 5, 8]


def test_gaps_in_time_and_ends_are_missing():
    times = torch.tensor([0.0, 1, 2, 6, 7, 8], dtype=torch.float64)
    at = torch.tensor([-0.1, 1.5, 3.0, 7.5, 8.1], dtype=torch.float64)
    assert interpolate(wave(times), times, at).isnan().all(-1).flatten().tolist() == [True, False, True, False, True]


@pytest.mark.parametrize(("shift", "first", "last"), [(0.0, 0, 29), (5 / 30, 0, 24), (-5 / 30, 5, 29), (0.1 / 30, 0, 28)])
def test_overlap_keeps_frames_that_both_show(shift, first, last):
    x = torch.zeros(30, 2, 2, dtype=torch.float64)
    seen = overlap(x, x, shift, fps=30.0)
    assert (seen.times * 30).round().long().tolist() == list(range(first, last + 1))
    assert seen.a.shape == seen.b.shape and bool(seen.b.isfinite().all())


def test_no_overlap():
    x = torch.zeros(30, 2, 2, dtype=torch.float64)
    assert len(overlap(x, x, 7.0, fps=30.0).times) == len(overlap(x, x[:0], 0.0, fps=30.0).times) == 0
