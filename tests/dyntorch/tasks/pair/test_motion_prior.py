"""The cosine transform against its definition, denoising against the truth, gaps against what was there."""

import math

import torch

from dyntorch.tasks.pair.tracks import Prior, cosines, fill_gaps, inverse_cosines, motion_spectrum


def normal(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def rms(x):
    return float(x.square().mean().sqrt())


def motion(frames=90, points=8, modes=3):
    """Few smooth modes."""
    times = torch.arange(frames, dtype=torch.float64) / 30
    waves = torch.sin(2 * math.pi * times[:, None, None] * (0.4 + normal(modes, 2).abs()) + 3 * normal(modes, 2, seed=1))
    return 20 * torch.einsum("nk,tkd->tnd", normal(points, modes, seed=2), waves)


def test_cosines_are_the_orthonormal_transform():
    for frames in (7, 12):
        x = normal(frames, 3, 2)
        t, k = torch.arange(frames, dtype=torch.float64), torch.arange(1, frames, dtype=torch.float64)
        basis = (2 / frames) ** 0.5 * torch.cos(math.pi / frames * k[:, None] * (t + 0.5))
        torch.testing.assert_close(cosines(x), torch.einsum("kt,tnd->knd", basis, x))
        torch.testing.assert_close(inverse_cosines(cosines(x)), x - x.mean(0))


def test_spectrum_is_that_of_the_motion_not_of_the_noise():
    z = cosines(motion() + 2.0 * normal(90, 8, 2))
    spectrum = motion_spectrum(z, 4.0)
    clean = cosines(motion()).square().mean((1, 2))
    assert float(spectrum[:12].sum() / clean[:12].sum() - 1) < 0.1 and float(spectrum[40:].mean()) < 0.5


def test_noise_goes_and_motion_stays():
    x = motion() - motion().mean(0)
    for sigma in (0.5, 3.0):
        noisy = x + sigma * normal(90, 8, 2, seed=5)
        z = cosines(noisy - noisy.mean(0))
        assert rms(inverse_cosines(Prior.of(z, sigma**2).denoised(z)) - x) < 0.55 * sigma
    z = cosines(x)
    torch.testing.assert_close(inverse_cosines(Prior.of(z, 1e-20).denoised(z)), x, atol=1e-6, rtol=0)


def test_gaps_are_filled_from_the_other_points():
    x = motion()
    gaps = x.clone()
    for point in range(8):
        gaps[9 * point : 9 * point + 15, point] = torch.nan
    found = fill_gaps(gaps, 0.0)
    seen = gaps.isfinite()
    assert torch.equal(found[seen], x[seen]) and rms((found - x)[~seen]) < 1e-2 * rms(x)
    assert fill_gaps(x, 0.0) is x


def test_gaps_of_points_that_no_other_tells_of_are_bridged():
    times = torch.arange(60, dtype=torch.float64)[:, None]
    x = torch.stack([0.5 * times.expand(60, 2), torch.sin(times / 4) * torch.ones(2, dtype=torch.float64)], dim=1)
    gaps = x.clone()
    gaps[20:24, 1] = torch.nan
    assert rms((fill_gaps(gaps, 1e-6) - x)[20:24, 1]) < 0.15
