"""Primitives: vectors from their definitions, the action of a change of coordinates, derivatives by autograd, what is free."""

import pytest
import torch

from dyntorch.core.primitives import Hyperplane, HyperplanesThrough, Line, Point, Projected
from tests.battery.references import plucker, subdeterminants
from tests.draws import random

CAMERAS = random(2, 3, 4, seed=9)
ALL = [
    (Point(1), random(2, 5, 1)),
    (Point(2), random(2, 5, 2)),
    (Point(3), random(2, 5, 3)),
    (HyperplanesThrough(1), random(2, 5, 1)),
    (HyperplanesThrough(2), random(2, 5, 2)),
    (HyperplanesThrough(3), random(2, 5, 3)),
    (HyperplanesThrough(2, 2), random(2, 5, 2)),
    (HyperplanesThrough(3, 2), random(2, 5, 3)),
    (HyperplanesThrough(3, 3), random(2, 5, 3)),
    (HyperplanesThrough(4, 2), random(2, 5, 4)),
    (Hyperplane(2), random(2, 5, 3)),
    (Hyperplane(3), random(2, 5, 4)),
    (Line(), random(2, 5, 2, 3)),
    (Line(), plucker(random(2, 5, 2, 3))),
    (Projected(CAMERAS), random(1, 5, 3)),
]
SINGLE = [(p, x) for p, x in ALL if p.rows == 1]


def similar(d, seed=3):
    frame = torch.eye(d + 1, dtype=torch.float64) * 2.5
    frame[:d, d], frame[d, d] = random(d, seed=seed), 1.0
    return frame


def parallel(a, b, tolerance=1e-10):
    a, b = (torch.nn.functional.normalize(v, dim=-1) for v in torch.broadcast_tensors(a, b))
    return bool((torch.minimum((a - b).norm(dim=-1), (a + b).norm(dim=-1)) < tolerance).all())


@pytest.mark.parametrize(("primitive", "x"), ALL)
def test_shapes(primitive, x):
    assert primitive.match_axis(x) == 1
    vectors = primitive.vectors(x)
    assert vectors.shape[-3:] == (5, primitive.rows, primitive.width)
    assert torch.linalg.matrix_rank(vectors).eq(primitive.rows).all()
    rows, columns = torch.triu_indices(primitive.width, primitive.width)
    form = torch.einsum("...ri,...rj->...ij", vectors, vectors)[..., rows, columns]
    torch.testing.assert_close(primitive.pack(x), form.mT)
    assert repr(primitive).startswith(type(primitive).__name__)
    with pytest.raises(ValueError, match=r"expected \(\*batch, n, \d.*\), got \(2, 5, 17\)"):
        primitive.match_axis(torch.zeros(2, 5, 17))


def test_points_and_the_hyperplanes_through_them():
    for d in (1, 2, 3):
        x = random(7, d)
        point = torch.cat([x, torch.ones(7, 1)], dim=-1)
        assert torch.equal(Point(d).raw(x), point) and torch.equal(Point(d).components(x), point.T)
        planes = HyperplanesThrough(d).vectors(x)
        assert (planes @ point[..., None]).abs().max() < 1e-15 and planes.shape == (7, d, d + 1)
        # [I | -x] times another point is the difference
        other = random(7, d, seed=1)
        torch.testing.assert_close((planes @ torch.cat([other, torch.ones(7, 1)], -1)[..., None])[..., 0], other - x)
    x, one = random(6, 2), torch.ones(6, dtype=torch.float64)  # the meet of all of them is the point
    torch.testing.assert_close(HyperplanesThrough(2, 2).raw(x), torch.stack([one, -x[:, 1], x[:, 0]], dim=-1))


@pytest.mark.parametrize(("d", "order"), [(1, 1), (2, 1), (2, 2), (3, 1), (3, 2), (3, 3), (4, 2), (4, 3)])
def test_meets_of_hyperplanes_are_their_minors(d, order):
    x = random(4, d)
    primitive = HyperplanesThrough(d, order)
    expected = [subdeterminants(torch.cat([torch.eye(d, dtype=torch.float64), -y[:, None]], dim=1), order) for y in x]
    torch.testing.assert_close(primitive.vectors(x), torch.stack(expected))
    # linear in x: every row depends on so many coordinates, whose derivatives slopes() lists row by row
    gradient = random(primitive.width, 4, seed=2)
    jacobian = torch.stack([torch.func.jacrev(lambda y: primitive.vectors(y[None])[0])(y) for y in x])  # (n, rows, width, d)
    full = torch.einsum("nrwd,wn->rdn", jacobian, gradient)
    where = full.abs().amax(-1) > 0  # the entries that are not always zero
    assert (where.sum(1) == order).all()
    expected = full[where].unflatten(0, (len(full), order))
    found = primitive.slopes(gradient).unflatten(0, (primitive.rows, order))
    torch.testing.assert_close(found.sort(1).values, expected.sort(1).values)


def test_hyperplanes_of_any_scale_have_unit_normals():
    x = random(6, 3)
    raw = Hyperplane(2).raw(-7 * x)
    torch.testing.assert_close(raw[:, :2].norm(dim=-1), torch.ones(6).double())
    assert parallel(raw, x)
    at_infinity = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]], dtype=torch.float64, requires_grad=True)
    Hyperplane(2).raw(at_infinity).sum().backward()
    assert Hyperplane(2).raw(at_infinity).isfinite().all() and at_infinity.grad.isfinite().all()


def test_lines_as_points_and_as_pluecker_coordinates():
    ends = random(8, 2, 3)
    torch.testing.assert_close(Line().raw(ends), plucker(ends))
    coordinates = plucker(ends)
    assert parallel(Line().vectors(coordinates), Line().vectors(ends))
    foot = Line().points(coordinates)[:, 0]
    along = ends[:, 1] - ends[:, 0]
    assert ((foot * along).sum(-1)).abs().max() < 1e-12
    assert torch.linalg.cross(foot - ends[:, 0], along).norm(dim=-1).max() < 1e-11
    assert torch.equal(Line().points(ends), ends)


@pytest.mark.parametrize(("primitive", "x"), ALL)
def test_action_is_that_of_the_moved_measurement(primitive, x):
    frame = similar(primitive.dim)
    moved = primitive.move(x, frame)
    assert moved.shape == x.shape
    new = primitive.normalize(frame)
    action = primitive.action(frame)
    before, after = primitive.vectors(x), new.vectors(moved)
    # all vectors of a measurement together: their span
    image = before @ (action[..., None, :, :] if action.ndim > 2 else action).mT
    a, b = (torch.linalg.qr(v.mT).Q for v in (image, after))
    assert (b - a @ (a.mT @ b)).abs().max() < 1e-10
    # points of the plane by hand
    if isinstance(primitive, Point):
        torch.testing.assert_close(moved, 2.5 * x + frame[:-1, -1])


@pytest.mark.parametrize(("primitive", "x"), SINGLE)
def test_pullback_and_pushforward_are_the_derivative(primitive, x):
    x = x / x[..., :-1].norm(dim=-1, keepdim=True) if isinstance(primitive, Hyperplane) else x
    gradient = random(*torch.broadcast_shapes(primitive.raw(x).shape), seed=4)
    z = x.clone().requires_grad_()
    (primitive.raw(z) * gradient).sum().backward()
    expected = z.grad
    found = primitive.pullback(x, gradient)
    if isinstance(primitive, Projected):
        found = found.sum(0, keepdim=True)
    if isinstance(primitive, Hyperplane):
        # of the coordinates those count that keep the normal a unit vector; noise of the offset is separate
        turn = torch.zeros_like(x)
        turn[..., :-1] = random(*x[..., :-1].shape, seed=5)
        turn[..., :-1] -= (turn * x)[..., :-1].sum(-1, keepdim=True) * x[..., :-1]
        turn[..., -1] = 0.7
        torch.testing.assert_close((found * turn).sum(-1), (gradient * turn).sum(-1))
        assert torch.equal(primitive.pushforward(x, turn), turn)
        return
    torch.testing.assert_close(found.reshape(expected.shape), expected)
    change = random(*x.shape, seed=6)
    _, pushed = torch.func.jvp(primitive.raw, (x,), (change,))
    flat = change.flatten(-2) if change.shape[-2:] == (2, 3) and isinstance(primitive, Line) else change
    torch.testing.assert_close(primitive.pushforward(x, flat), pushed)


def test_cameras_of_normalized_points_are_well_conditioned():
    frame = similar(3)
    x = random(1, 6, 3)
    camera = Projected(CAMERAS)
    new = camera.normalize(frame)
    torch.testing.assert_close(new.cameras @ new.cameras.mT, torch.eye(3).double().expand(2, 3, 3))
    assert parallel(camera.raw(x) @ camera.action(frame).mT, new.raw(camera.move(x, frame)))


@pytest.mark.slow
@pytest.mark.parametrize(("primitive", "x"), ALL)
def test_freedom_is_the_rank_of_the_derivative_of_the_direction(primitive, x):
    """How many dimensions the vectors of all measurements have, up to scale."""
    if primitive.rows > 1 or isinstance(primitive, Projected):
        assert primitive.freedom() == primitive.dim
        return
    raw = lambda z: torch.nn.functional.normalize(primitive.raw(z[None])[0], dim=0)  # noqa: E731
    jacobian = torch.func.jacrev(raw)(x[0, 0])
    assert torch.linalg.matrix_rank(jacobian.flatten(1), rtol=1e-9) == primitive.freedom() + (x.shape[-1] == 6)
