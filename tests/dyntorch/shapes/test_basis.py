"""Moving shapes of few points and projective cameras: degrees, counts, the resultant."""

import pytest
import torch

from dyntorch.invariants.dynamic_shape_tensor import annihilator, graph_of
from dyntorch.numerics.nullspace import null_space
from dyntorch.shapes.basis import Polynomial, moving_point, reference_plane_rows, resultant, six_point_rows
from tests.dyntorch.shapes.moving_views import LINEAR, SQUARE, draw, moving_views


def projected(start, velocity, t, g):
    """Views ``(v, n, 2)`` of moving points by random projective cameras."""
    points = torch.cat([start + t[:, None, None] * velocity, torch.ones(len(t), len(start), 1).double()], dim=-1)
    p = points @ draw(len(t), 4, 3, g=g)
    return p[..., :2] / p[..., 2:]


def rank(rows, tolerance=1e-12):
    values = torch.linalg.svdvals(rows / rows.norm(dim=-1, keepdim=True))
    return int((values > tolerance * values[0]).sum())


@pytest.fixture
def g():
    return torch.Generator().manual_seed(0)


def test_six_points_of_constant_velocity_have_degree_nine_and_49_frames(g):
    t = 2 * torch.rand(80, generator=g, dtype=torch.float64) - 1
    x = projected(draw(6, 3, g=g), draw(6, 3, g=g), t, g)
    rows = six_point_rows(x, t)
    assert rows.shape == (80, 50)
    assert [rank(rows[:k]) for k in (48, 49, 70)] == [48, 49, 49]
    found = null_space((rows / rows.norm(dim=-1, keepdim=True))[:60])[0]
    assert (rows[60:] @ found).abs().max() < 1e-10
    # the wrong time does not fulfil it
    assert (six_point_rows(x[60:], t[60:] + 0.1) @ found).abs().median() > 1e-8


def test_a_static_plane_and_two_moving_points_need_eight_frames(g):
    t = 2 * torch.rand(30, generator=g, dtype=torch.float64) - 1
    start, velocity = draw(6, 3, g=g), draw(6, 3, g=g)
    start[3], velocity[:4] = torch.tensor([0.3, 0.5, 0.2], dtype=torch.float64) @ start[:3], 0.0
    rows = reference_plane_rows(projected(start, velocity, t, g), t)
    assert [rank(rows[:k], 1e-10) for k in (7, 8, 30)] == [7, 8, 8]
    assert (rows @ null_space(rows[:8])[0]).abs().max() < 1e-10
    # the closed form: in the frame of the plane the direction between the two points
    frame = torch.cat([start, torch.ones(6, 1).double()], dim=-1)
    speed = torch.cat([velocity, torch.zeros(6, 1).double()], dim=-1)
    corners = torch.stack([frame[0], frame[1], frame[2], draw(4, g=g)])
    corners = corners * torch.linalg.solve(corners.T, frame[3])[:, None].where(torch.arange(4)[:, None] < 3, torch.ones(1).double())
    places = torch.linalg.solve(corners.T, (frame[4:, None] + t[:, None] * speed[4:, None]).mT).mT  # (2, v, 4)
    across = places[0, :, :3] * places[1, :, 3:] - places[1, :, :3] * places[0, :, 3:]
    coefficients = null_space(rows[:8])[0].unflatten(0, (3, 3))
    direction = Polynomial(2).rows(t) @ coefficients
    cosine = (direction * across).sum(-1) / direction.norm(dim=-1) / across.norm(dim=-1)
    torch.testing.assert_close(cosine.abs(), torch.ones_like(cosine), atol=1e-9, rtol=0)


def test_four_static_points_and_a_moving_one_need_three_frames(g):
    t = draw(3, g=g)
    still, weights, change = draw(2, 4, 3, g=g), draw(2, 4, g=g), draw(2, 4, g=g)
    weights = weights + (1 - weights.sum(-1, keepdim=True)) / 4
    change = change - change.mean(-1, keepdim=True)
    moving = torch.einsum("bvi,bik->bvk", weights[:, None] + t[:, None] * change[:, None], still)
    points = torch.cat([still[:, None].expand(2, 3, 4, 3), moving[:, :, None]], dim=-2)
    found = moving_point(points @ draw(2, 3, 3, 2, g=g), t.expand(2, 3))
    torch.testing.assert_close(found, torch.stack([weights, change], dim=1), atol=1e-9, rtol=1e-9)
    torch.testing.assert_close(found.sum(-1), torch.tensor([[1.0, 0.0]] * 2).double())
    with pytest.raises(ValueError, match="views >= 3"):
        moving_point(torch.rand(2, 5, 2), torch.rand(2))


@pytest.mark.parametrize(("functions", "degree"), [(LINEAR, 1), (SQUARE, 2)])
def test_five_points_at_an_unknown_time_fulfil_one_condition_the_resultant(functions, degree, g):
    t = 2 * torch.rand(12, generator=g, dtype=torch.float64) - 1
    x, shapes = moving_views(functions, t, n=5, seed=3)
    base = (0, 1, 2, 3)
    matrix = annihilator(graph_of(shapes, Polynomial(degree), base), 5, base)
    found, time = resultant(matrix, x)
    torch.testing.assert_close(time, t, atol=1e-6, rtol=0)
    other, _ = resultant(matrix, x + 0.3 * draw(12, 5, 2, g=g))
    assert found.abs().max() < 1e-6 * other.abs().median()  # not an identity: it tells other views apart
    # whatever the camera: the polynomials change by the 2 x 2 matrix, the resultant by a power of its determinant
    moved, same = resultant(matrix, x @ draw(12, 2, 2, g=g))
    torch.testing.assert_close(same, t, atol=1e-5, rtol=0)
    assert moved.abs().max() < 1e-6 * other.abs().median()


def test_shapes_of_points_are_checked():
    with pytest.raises(ValueError, match="6, 2"):
        six_point_rows(torch.rand(3, 5, 2), torch.rand(3))
    with pytest.raises(ValueError, match="five points"):
        resultant(torch.rand(4, 6, 2), torch.rand(6, 2))
