"""Chapter 7 on data of its own definition: every point of the second camera is a fixed affine combination of those of the first.

Fixed cameras, exact and at half a pixel, planar scenes and points that have no part: :mod:`experiments.thesis.chapter7`.
"""

import math

import pytest
import torch

import dyntorch as dyn
from tests.draws import seeded

FPS = 25.0


class Waves:
    """Smooth motion at any moment, from its definition: sums of sines of unit size."""

    def __init__(self, g, *shape):
        uniform = lambda: torch.rand(8, *shape, generator=g, dtype=torch.float64)  # noqa: E731
        self.pace, self.phase = 2 * math.pi * (0.1 + 0.7 * uniform()), 2 * math.pi * uniform()
        self.size = torch.randn(8, *shape, generator=g, dtype=torch.float64) / 2

    def __call__(self, t):
        return (self.size * torch.sin(self.pace * t.reshape(-1, 1, *[1] * (self.pace.ndim - 1)) + self.phase)).sum(1)


def films(seed, offset, *, moving=False, planar=False, seconds=7.0):
    """Ten points of a and nine others of b, between three free ones, in two affine cameras; b is ``offset`` behind."""
    g = seeded(seed)
    free = Waves(g, 3, 3)
    t = torch.arange(round(seconds * FPS), dtype=torch.float64) / FPS
    shares = [torch.softmax(2 * torch.randn(n, 3, generator=g, dtype=torch.float64), 1) for n in (10, 9)]
    found = []
    for share, times in zip(shares, (t, t - offset), strict=True):
        X = torch.einsum("pk,tkd->tpd", share, free(times))
        if planar:
            X[..., 2] = 0.2 * X[..., 0] - 0.1 * X[..., 1]
        x = 60 * X @ torch.linalg.qr(torch.randn(3, 3, generator=g, dtype=torch.float64))[0][:, :2] + 300
        if moving:  # a pan of any course, and a zoom in or out by up to a fifth
            zoom = 1 + 0.2 * torch.sin(0.7 * times + 3 * len(found))
            x = x * zoom[:, None, None] + 40 * Waves(g, 1, 2)(times)
        found.append(x)
    return found[0], found[1]


def shift(a, b, **different):
    return dyn.synchronize(a, b, correspondence=False, fps=FPS, max_shift=1.4, options=dyn.SynchronizeOptions(**different))


@pytest.mark.slow
def test_cameras_that_pan_and_zoom():
    """A ratio of zooms is found with the shift: without, exact data would be off by a quarter of a frame."""
    found = shift(*films(3, 0.37, moving=True))
    assert abs(found.offset - 0.37) * FPS < 0.1


@pytest.mark.parametrize("measure", ["rank", "log_determinant", "principal_angles"])
def test_measures_by_name(measure):
    """Of a plane both cameras show the same six rows: at the shift of exact data the rank is least and all angles are zero.

    In space each camera shows six of nine, and the sum of the cosines may be larger elsewhere.
    """
    found = shift(*films(4, 0.48, planar=True, seconds=5.0), measure=measure, camera_model="affine")
    assert abs(found.offset - 0.48) * FPS < 0.02


def test_films_of_different_events_are_refused():
    assert not shift(films(30, 0.0)[0], films(40, 0.0)[1]).ok


def test_unknown_measures_are_named():
    with pytest.raises(ValueError, match="measure must be one of auto, rank"):
        shift(*films(1, 0.0, seconds=2.0), measure="trace")
    with pytest.raises(ValueError, match="camera_model must be one of auto, affine"):
        shift(*films(1, 0.0, seconds=2.0), camera_model="fisheye")
