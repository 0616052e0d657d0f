"""Chapter 4 and section 9.2: shape tensors "for any kind of projection matrix", on data written from the definitions."""

import numpy as np
import pytest
import torch

import dyntorch as dyn


def camera(draw):
    """A 3 x 4 camera that looks at the origin from a distance of 6, turned at random."""
    turn = np.linalg.qr(draw.normal(size=(3, 3)))[0]
    return np.diag([900.0, 900.0, 1.0]) @ np.hstack([turn, [[0.0], [0.0], [6.0]]])


def images(points, draw):
    """Each ``(n, 4)`` by a camera of its own: ``(views, n, 2)``."""
    seen = [p @ camera(draw).T for p in points]
    return torch.from_numpy(np.stack([s[:, :2] / s[:, 2:] for s in seen]))


def moving(draw, n, times):
    """Points at constant velocity, homogeneous, at every time."""
    start, velocity = draw.normal(size=(n, 3)), 0.7 * draw.normal(size=(n, 3))
    return [np.hstack([start + t * velocity, np.ones((n, 1))]) for t in times]


@pytest.mark.slow
def test_points_of_constant_velocity_are_a_shape_of_p6_whatever_the_times_and_cameras():
    draw = np.random.default_rng(0)
    x = images(moving(draw, 12, draw.uniform(-1, 1, 80)), draw)
    solution = dyn.fit(dyn.LiftedShapeTensor(6), *x[:70].unbind(1)).check()
    new = dyn.sampson(solution.invariant, solution.tensor, *x[70:].unbind(1))
    assert new.max() < 1e-4  # px, of images 300 px wide
    other = images(moving(draw, 12, draw.uniform(-1, 1, 5)), draw)
    assert dyn.sampson(solution.invariant, solution.tensor, *other.unbind(1)).min() > 5.0


def test_a_shape_of_space_before_line_cameras():
    """P^3 -> P^1, 1D cameras: eight points, 13 views by the count; a view of 8 numbers fulfils one condition."""
    draw = np.random.default_rng(1)
    points = draw.normal(size=(8, 4))
    seen = np.stack([points @ draw.normal(size=(4, 2)) for _ in range(18)])
    x = torch.from_numpy(seen[..., :1] / seen[..., 1:])
    solution = dyn.fit(dyn.LiftedShapeTensor(3, 1), *x[:13].unbind(1)).check()
    # the determinant of the stacked incidences of the true points vanishes for the found ones as well
    found = solution.motion[0].numpy()
    for view in x[13:].numpy():
        lines = np.hstack([np.ones((8, 1)), -view])
        rows = np.stack([np.kron(line, point) for line, point in zip(lines, found, strict=True)])
        values = np.linalg.svd(rows / np.linalg.norm(rows, axis=1, keepdims=True), compute_uv=False)
        assert values[-1] < 1e-9 * values[0]
