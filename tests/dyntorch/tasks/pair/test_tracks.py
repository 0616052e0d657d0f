"""Interpolation between frames against the function that was sampled, and which frames both cameras show."""

import math

import torch

from dyntorch.tasks.pair.tracks import Prior, cosines, fill_gaps, interpolate, inverse_cosines, motion_spectrum, overlap

NAN = math.nan


def wave(times):
    return torch.stack([torch.sin(5 * times), torch.cos(3 * times)], dim=-1)[:, None]


def test_between_frames_of_any_spacing():
    times = torch.arange(50, dtype=torch.float64) / 30
    times = times + 0.004 * torch.rand(50, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    at = torch.linspace(float(times[0]), float(times[-1]), 333, dtype=torch.float64)
    assert float((interpolate(wave(times), times, at) - wave(at)).abs().max()) < 1e-4
    # frames that are met need no neighbours
    times = torch.arange(9, dtype=torch.float64)
    x = wave(times)
    x[[3, 5]] = NAN
    torch.testing.assert_close(interpolate(x, times, times), x, equal_nan=True, atol=1e-12, rtol=0)
    assert interpolate(x, times, times + 0.5).isnan().all(-1).flatten().nonzero().flatten().tolist() == [2, 3, 4, 5, 8]
    # gaps in time and ends are missing
    times = torch.tensor([0.0, 1, 2, 6, 7, 8], dtype=torch.float64)
    at = torch.tensor([-0.1, 1.5, 3.0, 7.5, 8.1], dtype=torch.float64)
    assert interpolate(wave(times), times, at).isnan().all(-1).flatten().tolist() == [True, False, True, False, True]


def test_overlap_keeps_frames_that_both_show():
    x = torch.zeros(30, 2, 2, dtype=torch.float64)
    for shift, first, last in ((0.0, 0, 29), (5 / 30, 0, 24), (-5 / 30, 5, 29), (0.1 / 30, 0, 28)):
        seen = overlap(x, x, shift, fps=30.0)
        assert (seen.times * 30).round().long().tolist() == list(range(first, last + 1))
        assert seen.a.shape == seen.b.shape and bool(seen.b.isfinite().all())
    assert len(overlap(x, x, 7.0, fps=30.0).times) == len(overlap(x, x[:0], 0.0, fps=30.0).times) == 0


def normal(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def rms(x):
    return float(x.square().mean().sqrt())


def motion(frames=90, points=8, modes=3):
    """Few smooth modes."""
    times = torch.arange(frames, dtype=torch.float64) / 30
    waves = torch.sin(2 * math.pi * times[:, None, None] * (0.4 + normal(modes, 2).abs()) + 3 * normal(modes, 2, seed=1))
    return 20 * torch.einsum("nk,tkd->tnd", normal(points, modes, seed=2), waves)


def test_cosines_are_the_orthonormal_transform_and_show_the_motion():
    for frames in (7, 12):
        x = normal(frames, 3, 2)
        t, k = torch.arange(frames, dtype=torch.float64), torch.arange(1, frames, dtype=torch.float64)
        basis = (2 / frames) ** 0.5 * torch.cos(math.pi / frames * k[:, None] * (t + 0.5))
        torch.testing.assert_close(cosines(x), torch.einsum("kt,tnd->knd", basis, x))
        torch.testing.assert_close(inverse_cosines(cosines(x)), x - x.mean(0))
    z = cosines(motion() + 2.0 * normal(90, 8, 2))
    spectrum = motion_spectrum(z, 4.0)
    clean = cosines(motion()).square().mean((1, 2))
    assert float(spectrum[:12].sum() / clean[:12].sum() - 1) < 0.1 and float(spectrum[40:].mean()) < 0.5


def test_noise_goes_and_motion_stays():
    x = motion() - motion().mean(0)
    for sigma in (0.5, 3.0):
        noisy = x + sigma * normal(90, 8, 2, seed=5)
        z = cosines(noisy - noisy.mean(0))
        assert rms(inverse_cosines(Prior.of(z, sigma**2).denoise(z)) - x) < 0.55 * sigma
    z = cosines(x)
    torch.testing.assert_close(inverse_cosines(Prior.of(z, 1e-20).denoise(z)), x, atol=1e-6, rtol=0)


def test_gaps_are_filled_from_the_other_points():
    x = motion()
    gaps = x.clone()
    for point in range(8):
        gaps[9 * point : 9 * point + 15, point] = torch.nan
    found = fill_gaps(gaps, 0.0)
    seen = gaps.isfinite()
    assert torch.equal(found[seen], x[seen]) and rms((found - x)[~seen]) < 1e-2 * rms(x)
    assert fill_gaps(x, 0.0) is x
    # of points that no other tells of they are bridged
    times = torch.arange(60, dtype=torch.float64)[:, None]
    x = torch.stack([0.5 * times.expand(60, 2), torch.sin(times / 4).expand(60, 2)], dim=1)
    gaps = x.clone()
    gaps[20:24, 1] = torch.nan
    assert rms((fill_gaps(gaps, 1e-6) - x)[20:24, 1]) < 0.15
