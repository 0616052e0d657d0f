"""Homography tensor: ranks, round trip, maps without A and B against those with them, distances, gradients, degenerate input."""

import pytest
import torch
from torch.nn.functional import normalize

from dyntorch import scenes
from dyntorch.geometry.homogeneous import apply, homogeneous, unit
from dyntorch.invariants.homography_tensor import HomographyTensor
from tests.draws import random, seeded
from tests.grid import assert_refused

ONES = (torch.ones(()).double(),) * 3


def scene(n, **options):
    return scenes.planar(n, generator=seeded(), **options)


def normalized(views):
    """A scene around 0 at size 1, with the map of each view that did it."""
    maps = torch.eye(3).double().repeat(3, 1, 1)
    for v, x in enumerate(views):
        scale = 1 / x.std()
        maps[v] = torch.diag(torch.stack([scale, scale, torch.ones(()).double()]))
        maps[v, :2, 2] = -scale * x.mean(0)
    return maps, [apply(m, x) for m, x in zip(maps, views, strict=True)]


def to_view(motion, view):
    """Homographies from view 1, 2, 3 to one of them."""
    A, B = motion
    first = (torch.eye(3).double().expand_as(A), A, B)
    return [torch.linalg.inv(first[view - 1]) @ m for m in first]


def test_composed_tensor_is_the_null_vector_and_the_determinant():
    found = scene(40)
    maps, views = normalized(found.views)
    A, B = (maps[0] @ m @ torch.linalg.inv(maps[v]) for v, m in zip((1, 2), found.motion, strict=True))
    H = HomographyTensor.compose(A, B)
    p1, p2, p3 = (normalize(homogeneous(x), dim=-1) for x in views)
    assert torch.einsum("ijk,ni,nj,nk->n", H, p1, p2, p3).abs().max() < 1e-13
    p, q, r = random(3, 50, 3)
    values = torch.einsum("ijk,ni,nj,nk->n", H, p, q, r)
    determinants = torch.linalg.det(torch.stack([p, q @ A.T, r @ B.T], dim=-1))
    torch.testing.assert_close(values / values.norm(), determinants / determinants.norm())
    torch.testing.assert_close(H.norm(), torch.ones(()).double())


def test_round_trip_in_pixels():
    A, B = scene(4, batch=100).motion
    for matrix, truth in zip(HomographyTensor.decompose(HomographyTensor.compose(A, B)), (A, B), strict=True):
        grid = torch.cartesian_prod(torch.linspace(0, 640, 5), torch.linspace(0, 480, 5)).double()
        assert (apply(matrix, grid) - apply(truth, grid)).norm(dim=-1).max() < 1e-7


@pytest.mark.parametrize(("source", "target"), [(2, 1), (3, 1), (1, 2), (3, 2), (1, 3), (2, 3)])
def test_static_transfer_is_that_of_the_homographies(source, target):
    found = scene(30, batch=4)
    H, x = HomographyTensor.compose(*found.motion), found.views[source - 1]
    truth = apply(to_view(found.motion, target)[source - 1], x)
    torch.testing.assert_close(HomographyTensor.transfer(-3 * H, x, source, target), truth, rtol=1e-9, atol=1e-7)
    single = HomographyTensor.transfer(H.float(), x.float(), source, target)
    assert single.dtype == torch.float32
    assert (single - truth).norm(dim=-1).median() < 0.1


@pytest.mark.parametrize("view", [1, 2, 3])
def test_trajectory_and_moving_transfer(view):
    found = scene(30, batch=4)
    H = HomographyTensor.compose(*found.motion)
    maps = to_view(found.motion, view)
    a, b = (v for v in (1, 2, 3) if v != view)
    x_a, x_b, truth = found.views[a - 1], found.views[b - 1], found.views[view - 1]
    line = HomographyTensor.trajectory(H, x_a, x_b, view=view)
    torch.testing.assert_close(line[..., :2].norm(dim=-1), torch.ones(4, 30).double())
    for x, m in ((x_a, maps[a - 1]), (x_b, maps[b - 1]), (truth, maps[view - 1])):
        assert (line * homogeneous(apply(m, x))).sum(-1).abs().max() < 1e-6
    across = torch.linalg.cross(homogeneous(truth), homogeneous(truth + random(4, 30, 2)))
    moved = HomographyTensor.transfer_moving(H, x_a, x_b, across, view=view)
    clear = torch.linalg.cross(normalize(across[..., :2], dim=-1)[..., [0, 1, 1]], line[..., [0, 1, 1]])[..., 2].abs() > 0.1
    assert clear.sum() > 60
    torch.testing.assert_close(moved[clear], truth[clear], rtol=1e-7, atol=1e-6)


def test_static_distance_is_the_whitened_disagreement_under_the_motion():
    found = scene(200, batch=3, static=0.5, sigma=0.5)
    H = HomographyTensor.compose(*found.motion)
    distance = HomographyTensor.static_distance(-2 * H, *found.views)
    residual = HomographyTensor().whitened_static_residual(found.motion, found.views, ONES)
    torch.testing.assert_close(distance, residual.norm(dim=-1), rtol=1e-6, atol=1e-7)
    still = found.labels == 1
    assert abs(float((distance[still] / 0.5).square().mean()) - 4) < 0.5
    assert distance[~still].min() > distance[still].median()


def test_degenerate_input_is_never_nan_and_never_a_motion():
    A, B = unit(random(2, 3, 3))
    good = HomographyTensor.compose(A, B)
    bad = torch.stack([torch.zeros(3, 3, 3).double(), torch.ones(3, 3, 3).double(), good])
    a, b = HomographyTensor.decompose(bad)
    assert a.isfinite().all() and b.isfinite().all()
    assert torch.equal(a[0], torch.zeros(3, 3).double())
    torch.testing.assert_close((a[2], b[2]), (A, B), rtol=1e-9, atol=1e-9)
    tensors, x = bad.requires_grad_(), random(3, 4, 2)
    outputs = [
        HomographyTensor.transfer(tensors, x),
        HomographyTensor.trajectory(tensors, x, x),
        HomographyTensor.transfer_moving(tensors, x, x, homogeneous(x)),
        HomographyTensor.static_distance(tensors, x, x, x),
    ]
    assert all(o.isfinite().all() for o in outputs)
    sum(o.sum() for o in outputs).backward()
    assert tensors.grad.isfinite().all()
    zero = torch.zeros(3, 3).double().requires_grad_()
    HomographyTensor.compose(zero, zero).sum().backward()
    assert torch.equal(zero.grad, torch.zeros(3, 3).double())


def test_static_points_have_no_trajectory():
    found = scene(5, static=1.0)
    maps, views = normalized(found.views)
    A, B = (maps[0] @ m @ torch.linalg.inv(maps[v]) for v, m in zip((1, 2), found.motion, strict=True))
    plain = torch.einsum("ijk,nj,nk->ni", HomographyTensor.compose(A, B), homogeneous(views[1]), homogeneous(views[2]))
    assert plain.abs().max() < 1e-13
    same = HomographyTensor.trajectory(HomographyTensor.compose(torch.eye(3), torch.eye(3)), torch.ones(1, 2), torch.ones(1, 2))
    assert torch.equal(same, torch.zeros(1, 3))


def test_misuse_is_refused():
    H, x = torch.zeros(3, 3, 3), torch.zeros(1, 2)
    assert_refused(
        (lambda: HomographyTensor.transfer(H, x, 2, 2), "got 2 and 2"),
        (lambda: HomographyTensor.transfer(H, x, 4), "got 4 and 1"),
        (lambda: HomographyTensor.trajectory(H, x, x, view=0), "got 0"),
        (lambda: HomographyTensor.decompose(torch.zeros(3, 3)), r"\(3, 3\)"),
    )
