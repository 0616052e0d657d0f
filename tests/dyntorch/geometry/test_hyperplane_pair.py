"""Pairs of hyperplanes: exact pairs in any frame, noise with and without covariances, minimal counts, degenerate points."""

import pytest
import torch
from torch.nn.functional import normalize

from dyntorch.geometry.pairs import hyperplane_pair


def random(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def pairs(*batch, n=30, size=5, first=0.6, seed=0):
    """Points (*batch, n, size) of random scale on two random hyperplanes, those, and labels."""
    planes = normalize(random(*batch, 2, size, seed=seed), dim=-1)
    points = random(*batch, n, size, seed=seed + 1)
    labels = torch.where(torch.arange(n) < round(first * n), 1, 2).expand(*batch, n)
    own = planes.gather(-2, (labels - 1)[..., None].expand(*batch, n, size))
    points = points - (points * own).sum(-1, keepdim=True) * own
    return points * random(*batch, n, 1, seed=seed + 2), planes, labels


def sine(a, b):
    a, b = normalize(a, dim=-1), normalize(b, dim=-1)
    return (a - (a * b).sum(-1, keepdim=True) * b).norm(dim=-1)


@pytest.mark.parametrize("size", [3, 4, 5, 7])
def test_exact_pairs(size):
    points, planes, labels = pairs(20, size=size, n=60)
    found = hyperplane_pair(points)
    assert (found.labels == labels).all()
    assert sine(found.hyperplanes, planes).max() < 1e-10
    torch.testing.assert_close(found.hyperplanes.norm(dim=-1), torch.ones(20, 2).double())
    own = found.distances.gather(-2, (labels - 1)[:, None])[:, 0]
    assert own.max() < 1e-20
    assert not found.degenerate.any()


@pytest.mark.parametrize(("size", "least", "first"), [(4, 9, 6), (4, 9, 5), (5, 14, 10), (5, 14, 7)])
def test_minimal_counts(size, least, first):
    points, planes, labels = pairs(50, n=least, size=size, first=first / least)
    found = hyperplane_pair(points)
    assert sine(found.hyperplanes, planes).amax(-1).median() < 1e-10
    assert (found.labels == labels).all(-1).double().mean() >= 0.96
    with pytest.raises(ValueError, match=f"take {least} points, structure has {least - 1}: add 1"):
        hyperplane_pair(points[:, 1:])


def test_two_bodies_that_hardly_separate():
    # affine points with the last coordinate 0 or 0.1, in a frame of condition 1000
    points = torch.cat([random(40, 2), torch.ones(40, 1), 0.1 * (torch.arange(40) >= 25)[:, None]], -1).double()
    frame = torch.linalg.qr(random(4, 4, seed=4)).Q * torch.tensor([1.0, 10.0, 100.0, 1000.0]).double()
    found = hyperplane_pair(points @ frame.mT)
    assert found.labels.tolist() == [1] * 25 + [2] * 15
    expected = torch.tensor([[0.0, 0.0, 0.0, 1.0], [0.0, 0.0, -0.1, 1.0]]).double() @ torch.linalg.inv(frame)
    assert sine(found.hyperplanes, expected).max() < 1e-9


def noisy(batch, seed=0, level=0.03):
    """Pairs whose points are far more exact in some directions than in others, different for every point."""
    points, planes, labels = pairs(batch, n=40, size=4, seed=seed)
    points = normalize(points, dim=-1)
    root = level * random(batch, 40, 4, 4, seed=seed + 5) * torch.tensor([3.0, 1.0, 0.1, 0.1]).double()
    across = torch.eye(4).double() - points[..., :, None] * points[..., None, :]
    covariance = across @ root @ root.mT @ across
    moved = points + (across @ root @ random(batch, 40, 4, 1, seed=seed + 6))[..., 0]
    return moved, planes, labels, torch.linalg.pinv(covariance, rtol=1e-9, hermitian=True)


def wrong(found, labels):
    error = (found.labels != labels).double().mean(-1)
    return torch.minimum(error, 1 - error)


def test_information_makes_hyperplanes_better():
    points, planes, _, information = noisy(60, level=0.01)
    plain, informed = hyperplane_pair(points), hyperplane_pair(points, information=information)
    assert sine(informed.hyperplanes, planes).median() < 0.7 * sine(plain.hyperplanes, planes).median()


def test_distances_are_in_standard_deviations():
    points, _, _, information = noisy(60, level=0.003)
    found = hyperplane_pair(points, information=information)
    # 40 squared normal deviates less the 6 parameters of two planes
    assert 0.8 * 34 < found.distances.amin(-2).sum(-1).mean() < 1.2 * 34


def test_information_commutes_with_collineations_and_scales():
    points, _, _, information = noisy(5, level=0.003)
    found = hyperplane_pair(points, information=information)
    frame, scale = random(4, 4, seed=30), random(5, 40, 1, seed=31)
    back = torch.linalg.inv(frame)
    moved = hyperplane_pair((points * scale) @ frame.mT, information=back.mT @ information @ back / scale[..., None].square())
    assert (moved.labels == found.labels).all()
    assert sine(moved.hyperplanes, found.hyperplanes @ back).max() < 1e-3
    torch.testing.assert_close(moved.distances.amin(-2), found.distances.amin(-2), atol=0.1, rtol=0.1)


def test_noise_without_information():
    points, planes, labels = pairs(50, n=40, size=5)
    found = hyperplane_pair(normalize(points, dim=-1) + 0.003 * random(50, 40, 5, seed=9))
    # only points next to both hyperplanes can be wrong
    assert wrong(found, labels).mean() < 0.02
    assert sine(found.hyperplanes, planes).median() < 0.01


def test_weights_zero_and_nan_are_absent():
    points, planes, labels = pairs(3, n=30, size=4)
    weights = torch.ones(3, 30).double()
    weights[:, 4] = 0
    points[:, 4] = 5 * random(4, seed=40)
    points[:, 9] = torch.nan
    found = hyperplane_pair(points, weights)
    keep = torch.tensor([i for i in range(30) if i not in (4, 9)])
    assert (found.labels[:, keep] == labels[:, keep]).all()
    assert (found.labels[:, [4, 9]] == 0).all()
    assert sine(found.hyperplanes, planes).max() < 1e-10
    assert found.distances.isfinite().all()
    assert (hyperplane_pair(points[:, keep]).labels == found.labels[:, keep]).all()


def test_degenerate_points_are_said_to_be():
    points, planes, labels = pairs(6, n=20, size=4)
    points[1] -= (points[1] @ planes[1, 0])[:, None] * planes[1, 0]  # one body
    points[2] = 0
    points[3, 2:] = torch.nan
    points[4, labels[4] == 2] = torch.where(torch.arange(8)[:, None] < 2, points[4, labels[4] == 2], torch.nan)  # two points
    found = hyperplane_pair(points)
    assert found.degenerate.tolist() == [False, True, True, True, True, False]
    assert (found.hyperplanes.isfinite().all(-1) & found.distances.isfinite().all(-1)).all()
    assert (found.labels[[0, 5]] == labels[[0, 5]]).all()


def test_batch_is_loop():
    points, _, _, information = noisy(6, level=0.01)
    batch = hyperplane_pair(points.view(2, 3, 40, 4), information=information.view(2, 3, 40, 4, 4))
    for k in range(6):
        alone = hyperplane_pair(points[k], information=information[k])
        assert (batch.labels.view(6, 40)[k] == alone.labels).all()
        assert sine(batch.hyperplanes.view(6, 2, 4)[k], alone.hyperplanes).max() < 1e-9


def test_order_and_larger_body():
    points, _, labels = pairs(n=30, size=4, first=0.3)
    found = hyperplane_pair(points)
    assert (found.labels == 3 - labels).all()  # the larger body is the first
    order = torch.randperm(30, generator=torch.Generator().manual_seed(0))
    assert (hyperplane_pair(points[order]).labels == found.labels[order]).all()
    even = pairs(n=30, size=4, first=0.5)[0]
    assert hyperplane_pair(even).labels[0] == 1


@pytest.mark.slow
def test_gradients():
    points = pairs(n=20, size=4)[0] + 0.01 * random(20, 4, seed=3)

    def of_points(y):
        h = hyperplane_pair(y).hyperplanes
        return h[..., :, None] * h[..., None, :]

    assert torch.autograd.gradcheck(of_points, points.requires_grad_(), atol=1e-5)


def test_float32_in_float32_out():
    found = hyperplane_pair(pairs(n=30, size=4)[0].float())
    assert (found.hyperplanes.dtype, found.distances.dtype, found.labels.dtype) == (torch.float32, torch.float32, torch.int64)


def test_refusals():
    points = random(20, 4)
    with pytest.raises(ValueError, match="structure must be"):
        hyperplane_pair(torch.ones(20, 4, dtype=torch.int64))
    with pytest.raises(ValueError, match="weights must be"):
        hyperplane_pair(points, torch.ones(19))
    with pytest.raises(ValueError, match="weights must not be negative"):
        hyperplane_pair(points, -torch.ones(20))
    with pytest.raises(ValueError, match="information must be"):
        hyperplane_pair(points, information=torch.ones(20, 4))
