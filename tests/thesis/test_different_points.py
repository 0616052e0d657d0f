"""Chapter 7 on data of its own definition: every point of the second camera is a fixed affine combination of those of the first."""

import math

import pytest
import torch

import dyntorch as dyn

FPS = 25.0


def generator(seed):
    return torch.Generator().manual_seed(seed)


class Waves:
    """Smooth motion at any moment, from its definition: sums of sines of unit size."""

    def __init__(self, g, *shape):
        uniform = lambda: torch.rand(8, *shape, generator=g, dtype=torch.float64)  # noqa: E731
        self.pace, self.phase = 2 * math.pi * (0.1 + 0.7 * uniform()), 2 * math.pi * uniform()
        self.size = torch.randn(8, *shape, generator=g, dtype=torch.float64) / 2

    def __call__(self, t):
        return (self.size * torch.sin(self.pace * t.reshape(-1, 1, *[1] * (self.pace.ndim - 1)) + self.phase)).sum(1)


def films(seed, offset, *, noise=0.0, planar=False, moving=False, foreign=0, seconds=7.0):
    """Ten points of a and nine others of b, between three free ones, in two affine cameras; b is ``offset`` behind."""
    g = generator(seed)
    free = Waves(g, 3, 3)
    t = torch.arange(round(seconds * FPS), dtype=torch.float64) / FPS
    shares = [torch.softmax(2 * torch.randn(n, 3, generator=g, dtype=torch.float64), 1) for n in (10, 9)]
    found = []
    for share, times in zip(shares, (t, t - offset), strict=True):
        X = torch.einsum("pk,tkd->tpd", share, free(times))
        if len(found) == 1 and foreign:
            X[:, :foreign] = Waves(g, foreign, 3)(times)
        if planar:
            X[..., 2] = 0.2 * X[..., 0] - 0.1 * X[..., 1]
        x = 60 * X @ torch.linalg.qr(torch.randn(3, 3, generator=g, dtype=torch.float64))[0][:, :2] + 300
        if moving:  # a pan of any course, and a zoom in or out by up to a fifth
            zoom = 1 + 0.2 * torch.sin(0.7 * times + 3 * len(found))
            x = x * zoom[:, None, None] + 40 * Waves(g, 1, 2)(times)
        found.append(x + noise * torch.randn(x.shape, generator=g, dtype=torch.float64))
    return found[0], found[1]


def shift(a, b, **different):
    return dyn.synchronize(a, b, correspondence=False, fps=FPS, max_shift=1.4, options=dyn.SynchronizeOptions(**different))


@pytest.mark.slow
@pytest.mark.parametrize(("planar", "offset"), [(False, 0.48), (False, -0.733), (True, 0.61)])
def test_fixed_affine_cameras_exact(planar, offset):
    found = shift(*films(1, offset, planar=planar))
    assert found.ok, found.reason
    assert abs(found.offset - offset) * FPS < 0.01


@pytest.mark.slow
def test_fixed_affine_cameras_with_noise():
    errors = []
    for seed in range(2):
        found = shift(*films(seed, 0.33, noise=0.5))
        assert found.ok, found.reason
        errors.append(abs(found.offset - 0.33) * FPS)
    assert max(errors) < 0.1


@pytest.mark.slow
def test_cameras_that_pan_and_zoom():
    """A ratio of zooms is found with the shift: without, exact data would be off by a quarter of a frame."""
    found = shift(*films(3, 0.37, moving=True))
    assert abs(found.offset - 0.37) * FPS < 0.1


@pytest.mark.parametrize(("measure", "within"), [("rank", 0.5), ("log_determinant", 0.02), ("principal_angles", 1.0)])
def test_measures_by_name(measure, within):
    """At whole frames every measure of the thesis finds exact data's shift; that of the angles is the bluntest."""
    found = shift(*films(4, 0.48), measure=measure, camera_model="affine")
    assert abs(found.offset - 0.48) * FPS < within


def test_the_rank_falls_at_the_right_lag_alone():
    """The least rank over lags, by SVD of the stacked rows, is at the lag that is found."""
    a, b = films(5, 0.4)
    ranks = []
    for lag in range(-20, 21):
        lo, hi = max(0, -lag), min(len(a), len(b) - lag)
        rows = torch.cat([a[lo:hi].flatten(1), b[lo + lag : hi + lag].flatten(1)], dim=1)
        values = torch.linalg.svdvals(rows - rows.mean(0))
        ranks.append(int((values > 1e-9 * values[0]).sum()))
    assert ranks.index(min(ranks)) - 20 == 10 and ranks.count(min(ranks)) == 1
    found = shift(a, b, measure="rank", camera_model="affine")
    assert abs(found.offset * FPS - 10) < 0.5


@pytest.mark.slow
def test_two_tracks_of_nine_that_have_no_part():
    for seed in range(1):
        found = shift(*films(20 + seed, 0.52, noise=0.5, foreign=2))
        assert abs(found.offset - 0.52) * FPS < 1
        assert found.ok, found.reason


def test_films_of_different_events_are_refused():
    for seed in range(1):
        a, b = films(30 + seed, 0.0)[0], films(40 + seed, 0.0)[1]
        assert not shift(a, b).ok


def test_unknown_measures_are_named():
    with pytest.raises(ValueError, match="measure must be one of auto, rank"):
        shift(*films(1, 0.0, seconds=2.0), measure="trace")
    with pytest.raises(ValueError, match="camera_model must be one of auto, affine"):
        shift(*films(1, 0.0, seconds=2.0), camera_model="fisheye")
