"""Chapter 7 for projective cameras ("briefly described"): different points of one moving body, from the definition alone.

A fixed camera sees a point X of a body that moves by M(t) at P M(t) X.  Everything here is written from that line.
"""

import math
from itertools import chain

import pytest
import torch

import dyntorch as dyn
from dyntorch.geometry.rigid import rotation_exponential
from tests.thesis.test_minimal_conditions import PRIME, rank

D = torch.float64
FPS = 30.0


def cayley(a, b, c):
    """The rotation (I - S)^-1 (I + S) over the field."""
    n = pow(1 + a * a + b * b + c * c, -1, PRIME)
    rows = [
        [1 + a * a - b * b - c * c, 2 * (a * b - c), 2 * (a * c + b)],
        [2 * (a * b + c), 1 - a * a + b * b - c * c, 2 * (b * c - a)],
        [2 * (a * c - b), 2 * (b * c + a), 1 - a * a - b * b + c * c],
    ]
    return [[v * n % PRIME for v in row] for row in rows]


def test_exact_ranks_of_measurements_scaled_by_depth():
    g = torch.Generator().manual_seed(0)

    def draw(*shape):
        return torch.randint(1, PRIME, shape, generator=g).tolist()

    frames, n = 40, 8
    motions = [[[*row, t] for row, t in zip(cayley(*draw(3)), draw(3), strict=True)] for _ in range(frames)]

    def filmed(camera):  # points of its own: all rows of the body in time, scaled by the depth
        points = [[*draw(3), 1] for _ in range(n)]
        table = []
        for motion in motions:
            placed = [[sum(m * x for m, x in zip(row, point, strict=True)) % PRIME for row in motion] + [1] for point in points]
            table.append([sum(p * x for p, x in zip(row, point, strict=True)) for point in placed for row in camera])
        return table

    def joined(*parts):
        return rank([[*chain(*row)] for row in zip(*parts, strict=True)])

    a, b, one = filmed(draw(3, 4)), filmed(draw(3, 4)), [[1]] * frames
    # a camera's 12 rows are combinations of the 12 entries of the motion and of 1: each a space of 12 dimensions
    assert joined(a) == joined(b) == 12 and joined(a, one) == joined(b, one) == 13
    # at the right shift both lie in the 13 dimensions of the motion, and meet in 11; at a wrong one they meet in nothing
    assert joined(a, b) == joined(a, b, one) == 13 and 12 + 12 - 13 == 11
    wrong = b[7:] + b[:7]
    assert joined(a, wrong) == 24 and joined(a, wrong, one) == 25
    # four points show all of it, three rows each; three points 9 of the 12
    assert joined([row[:12] for row in a]) == 12 and joined([row[:9] for row in a]) == 9


class Scene:
    """A body that turns and wanders before two cameras of any calibration, each of which tracks points of its own."""

    def __init__(self, seed, n=7, m=8, foreign=0):
        g = torch.Generator().manual_seed(seed)
        self.waves = self.drawn(g, 6)
        self.points = [0.3 * torch.randn(count, 3, generator=g, dtype=D) for count in (n, m)]
        self.foreign = foreign
        inner = torch.tensor([[[900.0, 3, 640], [0, 880, 470], [0, 0, 1]], [[1300.0, 0, 500], [0, 1300, 520], [0, 0, 1]]], dtype=D)
        seats = rotation_exponential(torch.tensor([[0.2, 0.1, 0.0], [0.3, 1.1, 0.2]], dtype=D))
        place = torch.tensor([0.1, 0.2, 4.0], dtype=D).expand(2, 3)[..., None]
        self.cameras = inner @ torch.cat([seats, place], -1)

    @staticmethod
    def drawn(g, count):
        return *(torch.rand(4, count, generator=g, dtype=D) for _ in range(2)), torch.randn(4, count, generator=g, dtype=D)

    @staticmethod
    def waved(t, waves):
        pace, phase, size = waves
        angle = 2 * math.pi * ((0.15 + 0.5 * pace) * t[:, None, None] + phase)
        return (size * angle.sin()).sum(1) / 2

    def placed(self, camera, t):
        way = self.waved(t, self.waves)
        x = self.points[camera] @ rotation_exponential(0.8 * way[:, :3]).mT + 0.3 * way[:, None, 3:]
        g = torch.Generator().manual_seed(100 + camera)
        for k in range(self.foreign):  # the first ones go their own way
            x[:, k] = 0.3 * self.waved(t, self.drawn(g, 3))
        return x

    def film(self, camera, t, noise=0.0):
        x = self.placed(camera, t)
        image = torch.cat([x, torch.ones_like(x[..., :1])], -1) @ self.cameras[camera].T
        image = image[..., :2] / image[..., 2:]
        return image + noise * torch.randn(image.shape, generator=torch.Generator().manual_seed(camera), dtype=D)


def clock(frames):
    return torch.arange(frames, dtype=D) / FPS


def pair(scene, frames, offset=0.0, noise=0.0):
    return scene.film(0, clock(frames), noise), scene.film(1, clock(frames) - offset, noise)


@pytest.mark.slow
@pytest.mark.parametrize(("noise", "within"), [(0.0, 1e-4), (0.5, 0.1)])
def test_synchronized_by_the_motion_that_both_have_seen(noise, within):
    a, b = pair(Scene(1), 70, offset=0.217, noise=noise)
    shift = dyn.synchronize(a, b, correspondence=False, fps=FPS, camera="projective")
    assert shift.ok and shift.method == "projective"
    assert abs(shift.offset - 0.217) * FPS < within and shift.sigma * FPS < 0.1


@pytest.mark.slow
def test_another_motion_is_refused():
    a, b = Scene(1).film(0, clock(60), 0.5), Scene(2).film(1, clock(60), 0.5)
    shift = dyn.synchronize(a, b, correspondence=False, fps=FPS, camera="projective")
    assert not shift.ok and "one motion" in shift.reason


def affine_error(found, truth):
    """Rms over the spread of the truth after the best affinity: the plane at infinity is found as well."""
    x = found[..., :3] / found[..., 3:]
    x = torch.cat([x, torch.ones_like(x[..., :1])], -1).flatten(0, -2)
    y = truth.flatten(0, -2)
    return float((x @ torch.linalg.lstsq(x, y).solution - y).square().mean().sqrt() / y.std())


@pytest.mark.slow
@pytest.mark.parametrize(("noise", "within"), [(0.0, 1e-6), (1.0, 0.03)])
def test_both_point_sets_in_one_frame(noise, within):
    scene, frames = Scene(3), 50
    a, b = pair(scene, frames, noise=noise)
    found = dyn.reconstruct_pair(a, b, 0.0, fps=FPS, camera="projective").check()
    truth = torch.cat([scene.placed(0, clock(frames)), scene.placed(1, clock(frames))], 1)
    assert found.points.shape == (frames, 15, 4)
    assert bool((found.labels == 1).all()) and found.source.tolist() == [0] * 7 + [1] * 8
    assert affine_error(found.points, truth) < within
    # where the points of b are before a, which never saw them
    other = torch.cat([truth[:, 7:], torch.ones(frames, 8, 1, dtype=D)], -1) @ scene.cameras[0].T
    missed = (found.images()[0, :, 7:] - other[..., :2] / other[..., 2:]).norm(dim=-1)
    assert float(missed.median()) < 1e-3 + 4 * noise and found.residual <= 1e-3 + 1.5 * noise
    # the cameras are those of the fundamental matrix
    seen = torch.cat([found.images(), torch.ones(2, frames, 15, 1, dtype=D)], -1)
    assert float((seen[1] @ found.fundamental * seen[0]).sum(-1).abs().max()) < 1e-6


@pytest.mark.slow
def test_points_of_something_else_are_told():
    scene, frames = Scene(4, n=9, m=8, foreign=1), 60
    a, b = pair(scene, frames, noise=0.5)
    found = dyn.reconstruct_pair(a, b, 0.0, fps=FPS, camera="projective").check()
    assert found.labels.tolist() == [0, *[1] * 8, 0, *[1] * 7]
    truth = torch.cat([scene.placed(0, clock(frames)), scene.placed(1, clock(frames))], 1)
    good = found.labels > 0
    assert affine_error(found.points[:, good], truth[:, good]) < 0.03
    assert bool((found.residuals[~good] > 5).all()) and bool(found.points[:, ~good].isnan().all())
