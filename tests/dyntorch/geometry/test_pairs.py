"""Pairs of hyperplanes: exact pairs in any frame, noise with and without covariances, minimal counts, degenerate points."""

import itertools
from itertools import combinations_with_replacement

import pytest
import torch
from torch.nn.functional import normalize

from dyntorch.geometry.homogeneous import homogeneous, inhomogeneous
from dyntorch.geometry.pairs import factor_product, hyperplane_pair, order_of_bodies, product_matrix, two_bodies
from dyntorch.metrics import relative_error
from dyntorch.scenes import bodies
from tests.draws import random, seeded
from tests.grid import assert_refused


def pairs(*batch, n=30, size=5, first=0.6, seed=0):
    """Points (*batch, n, size) of random scale on two random hyperplanes, those, and labels."""
    planes = normalize(random(*batch, 2, size, seed=seed), dim=-1)
    points = random(*batch, n, size, seed=seed + 1)
    labels = torch.where(torch.arange(n) < round(first * n), 1, 2).expand(*batch, n)
    own = planes.gather(-2, (labels - 1)[..., None].expand(*batch, n, size))
    points = points - (points * own).sum(-1, keepdim=True) * own
    return points * random(*batch, n, 1, seed=seed + 2), planes, labels


@pytest.mark.parametrize("size", [3, 4, 5, 7])
def test_exact_pairs(size):
    points, planes, labels = pairs(20, size=size, n=60)
    found = hyperplane_pair(points)
    assert (found.labels == labels).all()
    assert relative_error(found.hyperplanes, planes, dims=1).max() < 1e-10
    torch.testing.assert_close(found.hyperplanes.norm(dim=-1), torch.ones(20, 2).double())
    own = found.distances.gather(-2, (labels - 1)[:, None])[:, 0]
    assert own.max() < 1e-20
    assert not found.degenerate.any()


@pytest.mark.parametrize(("size", "least", "first"), [(4, 9, 6), (4, 9, 5), (5, 14, 10), (5, 14, 7)])
def test_minimal_counts(size, least, first):
    points, planes, labels = pairs(50, n=least, size=size, first=first / least)
    found = hyperplane_pair(points)
    assert relative_error(found.hyperplanes, planes, dims=1).amax(-1).median() < 1e-10
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
    assert relative_error(found.hyperplanes, expected, dims=1).max() < 1e-9


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
    assert (
        relative_error(informed.hyperplanes, planes, dims=1).median()
        < 0.7 * relative_error(plain.hyperplanes, planes, dims=1).median()
    )


def test_distances_with_information_and_their_changes_of_frame():
    points, _, _, information = noisy(60, level=0.003)
    found = hyperplane_pair(points, information=information)
    # distances are in standard deviations: 40 squared normal deviates less the 6 parameters of two planes
    assert 0.8 * 34 < found.distances.amin(-2).sum(-1).mean() < 1.2 * 34
    points, information = points[:6], information[:6]
    found = hyperplane_pair(points, information=information)
    batch = hyperplane_pair(points.view(2, 3, 40, 4), information=information.view(2, 3, 40, 4, 4))
    for k in range(6):
        alone = hyperplane_pair(points[k], information=information[k])
        assert (found.labels[k] == alone.labels).all() and (batch.labels.view(6, 40)[k] == alone.labels).all()
        assert relative_error(batch.hyperplanes.view(6, 2, 4)[k], alone.hyperplanes, dims=1).max() < 1e-9
    frame, scale = random(4, 4, seed=30), random(6, 40, 1, seed=31)
    back = torch.linalg.inv(frame)
    moved = hyperplane_pair((points * scale) @ frame.mT, information=back.mT @ information @ back / scale[..., None].square())
    assert (moved.labels == found.labels).all()
    assert relative_error(moved.hyperplanes, found.hyperplanes @ back, dims=1).max() < 1e-3
    torch.testing.assert_close(moved.distances.amin(-2), found.distances.amin(-2), atol=0.1, rtol=0.1)


def test_noise_without_information():
    points, planes, labels = pairs(50, n=40, size=5)
    found = hyperplane_pair(normalize(points, dim=-1) + 0.003 * random(50, 40, 5, seed=9))
    # only points next to both hyperplanes can be wrong
    assert wrong(found, labels).mean() < 0.02
    assert relative_error(found.hyperplanes, planes, dims=1).median() < 0.01


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
    assert relative_error(found.hyperplanes, planes, dims=1).max() < 1e-10
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


def test_order_and_larger_body():
    points, _, labels = pairs(n=30, size=4, first=0.3)
    found = hyperplane_pair(points)
    assert (found.labels == 3 - labels).all()  # the larger body is the first
    order = torch.randperm(30, generator=torch.Generator().manual_seed(0))
    assert (hyperplane_pair(points[order]).labels == found.labels[order]).all()
    even = pairs(n=30, size=4, first=0.5)[0]
    assert hyperplane_pair(even).labels[0] == 1
    single = hyperplane_pair(even.float())
    assert (single.hyperplanes.dtype, single.distances.dtype, single.labels.dtype) == (torch.float32, torch.float32, torch.int64)


@pytest.mark.slow
def test_gradients():
    points = pairs(n=20, size=4)[0] + 0.01 * random(20, 4, seed=3)

    def of_points(y):
        h = hyperplane_pair(y).hyperplanes
        return h[..., :, None] * h[..., None, :]

    assert torch.autograd.gradcheck(of_points, points.requires_grad_(), atol=1e-5)


# Products of two forms of rank two: the product point by point, both factors again, units, noise, failures, gradients.


def rank_two(*batch, seed=0):
    u, s, vh = torch.linalg.svd(random(*batch, 3, 3, seed=seed))
    form = u[..., :2] @ (s[..., :2, None] * vh[..., :2, :])
    return form / torch.linalg.matrix_norm(form, keepdim=True)


def pair_error(found, true):
    """The worse of both forms in the better order."""
    orders = [torch.maximum(relative_error(found[0], true[k]), relative_error(found[1], true[1 - k])) for k in (0, 1)]
    return torch.minimum(*orders)


def nu(p, degree=2):
    return torch.stack([p[..., list(c)].prod(-1) for c in combinations_with_replacement(range(3), degree)], dim=-1)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_product_is_the_product_at_every_pair_of_points(count):
    forms, p, q = random(count, 4, 3, 3), random(4, 3, seed=2), random(4, 3, seed=3)
    expected = torch.einsum("ni,knij,nj->kn", q, forms, p).prod(0)
    matrix = product_matrix(*forms)
    torch.testing.assert_close(torch.einsum("na,nab,nb->n", nu(q, count), matrix, nu(p, count)), expected)
    torch.testing.assert_close(matrix, product_matrix(*forms.flip(0)))


def test_rank_and_null_spaces_of_the_product():
    f, g = rank_two(5), rank_two(5, seed=1)
    matrix = product_matrix(f, g)
    values = torch.linalg.svdvals(matrix)
    assert (values[:, 4] < 1e-12).all() and (values[:, 3] > 1e-4).all()
    for form in (f, g):
        right, left = torch.linalg.svd(form).Vh[:, 2], torch.linalg.svd(form).U[..., 2]
        assert torch.einsum("nab,nb->na", matrix, nu(right)).abs().max() < 1e-12
        assert torch.einsum("nab,na->nb", matrix, nu(left)).abs().max() < 1e-12


def test_factors_of_a_product():
    f, g = rank_two(4, 50), rank_two(4, 50, seed=1)
    found = factor_product(-3.0 * product_matrix(f, g))
    assert found[0].shape == (4, 50, 3, 3)
    error = pair_error(found, (f, g))
    assert error.median() < 1e-12 and error.max() < 1e-9
    for form in found:
        torch.testing.assert_close(torch.linalg.matrix_norm(form), torch.ones(4, 50).double())
        assert torch.linalg.det(form).abs().max() < 1e-10
    # the order is that of the forms alone
    again = factor_product(product_matrix(2 * g, f))
    for one, other in zip(found, again, strict=True):
        assert relative_error(one, other).max() < 1e-8
    scene = bodies(20, batch=60, interleaved=True, generator=seeded())  # in pixels
    assert pair_error(factor_product(product_matrix(*scene.motion)), scene.motion).max() < 1e-8


def test_nearest_product_of_a_noisy_matrix():
    """Nearest in balanced units of the views, so about as near as the true one in the given units."""
    f, g = rank_two(30), rank_two(30, seed=1)
    exact = product_matrix(f, g)
    exact = exact / torch.linalg.matrix_norm(exact, keepdim=True)
    weight = torch.tensor([1.0, 2, 2, 1, 2, 1]).double().sqrt()
    for sigma in (1e-3, 1e-5):
        noisy = exact + sigma * random(30, 6, 6, seed=2)

        def rest(*forms, noisy=noisy):
            target, product = noisy / weight[:, None] / weight, product_matrix(*forms) / weight[:, None] / weight
            share = (target * product).sum((-2, -1), keepdim=True) / product.square().sum((-2, -1), keepdim=True)
            return torch.linalg.matrix_norm(target - share * product)

        found = factor_product(noisy)
        least = rest(*found)
        assert (least <= 2 * rest(f, g)).all() and least.mean() < rest(f, g).mean()
        assert pair_error(found, (f, g)).median() < 20 * sigma


def test_failures_leave_the_others_alone():
    good = product_matrix(rank_two(), rank_two(seed=1))
    bad = torch.stack([good, torch.zeros(6, 6).double(), torch.full((6, 6), torch.nan).double(), torch.ones(6, 6).double(), good])
    bad.requires_grad_()
    found = factor_product(bad)
    assert all(f.isfinite().all() for f in found)
    assert all(f[1:3].abs().max() == 0 for f in found)
    sum(f.square().sum((-2, -1)).sum() + f[0].sum() for f in found).backward()
    assert bad.grad[[0, 1, 3, 4]].isfinite().all()
    for one, other in zip(found, factor_product(good), strict=True):
        torch.testing.assert_close(one[0], other)
        torch.testing.assert_close(one[4], other)
    double = factor_product(product_matrix(rank_two(), rank_two()))
    assert all(f.isfinite().all() for f in double)


@pytest.mark.slow
def test_gradients_of_product():
    f, g = rank_two(2), rank_two(2, seed=1)

    assert torch.autograd.gradcheck(product_matrix, (f.requires_grad_(), g.requires_grad_()))

    # up to its sign, which is free: the projection
    def outer(m):
        flat = product_matrix(*factor_product(m)).flatten(1)
        return flat[:, :, None] * flat[:, None, :5]

    for sigma in (1e-3, 0.0):  # of an exact product, too
        matrix = (product_matrix(f, g) + sigma * random(2, 6, 6, seed=4)).detach().requires_grad_()
        assert torch.autograd.gradcheck(outer, matrix, fast_mode=True, eps=1e-7, atol=1e-4)


# Two translating bodies: exact cameras and affine shapes from any projective frame, what scale is observable, thin bodies.


N, FIRST = 20, 12
LABELS = torch.where(torch.arange(N) < FIRST, 1, 2)


def scene(*batch, d=3, views=3, seed=0):
    """Projections, structure in any frame with any scales and signs, body points (*batch, N, d), images."""
    points = random(*batch, N, d, seed=seed)
    cameras = torch.eye(3, d + 1).double() + 0.15 * random(*batch, views, 3, d + 1, seed=seed + 1)
    cameras[..., 2, :d] *= 0.3
    cameras[..., 2, d] += 4 - cameras[..., 2, d]  # in front of every camera
    motion = 0.3 * random(*batch, views, d, 1, seed=seed + 2)
    projections = torch.cat([cameras, cameras[..., :d] @ motion], -1)
    structure = torch.cat([homogeneous(points), (LABELS == 2).double()[:, None].expand(*batch, N, 1)], -1)
    images = inhomogeneous(structure[..., None, :, :] @ projections.mT)
    frame = random(*batch, d + 2, d + 2, seed=seed + 3)
    projections = random(*batch, views, 1, 1, seed=seed + 4) * (projections @ torch.linalg.inv(frame)[..., None, :, :])
    structure = random(*batch, N, 1, seed=seed + 5) * (structure @ frame.mT)
    return projections, structure, points, images


def solved(projections, structure):
    pair = hyperplane_pair(structure)
    return two_bodies(projections, structure, pair.hyperplanes, pair.labels), pair.labels


def affinities(bodies, points):
    """Best affinities (*batch, 2, d + 1, d) from the found to the true points, and the largest relative error."""
    found, error = [], []
    for member in (LABELS == 1, LABELS == 2):
        fit = torch.linalg.lstsq(homogeneous(bodies.points[..., member, :]), points[..., member, :]).solution
        found.append(fit)
        error.append((homogeneous(bodies.points[..., member, :]) @ fit - points[..., member, :]).abs().max())
    return torch.stack(found, -3), max(error)


@pytest.mark.parametrize(("d", "views"), [(2, 2), (2, 5), (3, 3), (3, 6)])
def test_exact_data(d, views):
    projections, structure, points, images = scene(10, d=d, views=views)
    bodies, labels = solved(projections, structure)
    assert (labels == LABELS).all()
    assert bodies.determined.all()
    fits, error = affinities(bodies, points)
    assert error < 1e-9
    # every point by the cameras of its own body, in front of them
    for body in (0, 1):
        member = body + 1 == LABELS
        seen = homogeneous(bodies.points[:, None, member]) @ bodies.cameras[:, body].mT
        assert (inhomogeneous(seen) - images[:, :, member]).abs().max() < 1e-9
        assert (seen[..., 2] > 0).all()
    # one linear part, up to a positive size
    first, second = fits[:, 0, :d], fits[:, 1, :d]
    size = (first * second).sum((-2, -1)) / first.square().sum((-2, -1))
    assert (size > 0).all()
    torch.testing.assert_close(second, size[:, None, None] * first, atol=1e-9, rtol=1e-9)
    # which is seen in a plane and not in space: there the second body grows about the origin, its translation hides it
    assert ((size - 1).abs().max() < 1e-9) == (d == 2)
    if d == 3:
        grown, member = bodies.cameras[:, 1].clone(), LABELS == 2
        grown[..., 3] *= 2
        seen = homogeneous(2 * bodies.points[:, None, member]) @ grown.mT
        assert (inhomogeneous(seen) - images[:, :, member]).abs().max() < 1e-9
        torch.testing.assert_close(grown[..., :3], bodies.cameras[:, 0, ..., :3])
    single = two_bodies(projections, structure.float(), hyperplane_pair(structure).hyperplanes, labels)
    assert single.points.dtype == single.cameras.dtype == torch.float32


def test_gauge():
    for d in (2, 3):
        projections, structure, _, _ = scene(4, d=d)
        bodies, _ = solved(projections, structure)
        for body in (1, 2):
            own = bodies.points[:, body == LABELS]
            assert own.median(dim=-2).values.abs().max() < 1e-9
            if d == 3:
                torch.testing.assert_close(own.norm(dim=-1).median(dim=-1).values, torch.ones(4).double())
        # the collineation brings points and projections to the stated form
        canonical = structure @ bodies.collineation.mT
        marker = canonical[..., -1] / canonical[..., -2]
        torch.testing.assert_close(marker, (LABELS == 2).double().expand(4, N), atol=1e-9, rtol=0)
        blocks = projections @ torch.linalg.inv(bodies.collineation)[:, None]
        sign = torch.sign(blocks[..., :1, :1] * bodies.cameras[:, 0, ..., :1, :1])
        torch.testing.assert_close(sign * blocks[..., :-1], bodies.cameras[:, 0])
        torch.testing.assert_close(sign[..., 0] * (blocks[..., -2] + blocks[..., -1]), bodies.cameras[:, 1, ..., -1])


def test_frame_scales_and_signs_do_not_matter():
    for d in (2, 3):
        projections, structure, _, _ = scene(d=d)
        pair = hyperplane_pair(structure)
        first = two_bodies(projections, structure, pair.hyperplanes, pair.labels)
        scales = torch.tensor([[-3.0], [0.1]]).double()
        second = two_bodies(-projections, structure * random(N, 1, seed=9), scales * pair.hyperplanes, pair.labels)
        fits, error = affinities(second, first.points)
        assert error < 1e-8
        # a median point of an even number may be another one, and with it the size in space
        size = torch.linalg.det(fits[1, :d]) / torch.linalg.det(fits[0, :d])
        assert abs(size - 1) < 1e-8 if d == 2 else size > 0


def test_a_thin_body_is_said_to_be_undetermined_and_stays_finite():
    projections, structure, _, _ = scene(5, d=3)
    pair = hyperplane_pair(structure)
    labels = pair.labels.clone()
    labels[1] = 1  # no second body
    labels[2, FIRST + 3 :] = 0  # three points of it: one too few
    labels[3, FIRST + 4 :] = 0
    hyperplanes = pair.hyperplanes.clone()
    hyperplanes[4, 1] = -2 * hyperplanes[4, 0]
    structure[3, -1] = torch.nan
    bodies = two_bodies(projections, structure, hyperplanes, labels)
    assert bodies.determined.tolist() == [[True, True], [True, False], [True, False], [True, True], [False, False]]
    assert all(part.isfinite().all() for part in (bodies.cameras, bodies.points, bodies.collineation))


def test_batch_is_loop_of_bodies():
    for d in (2, 3):
        projections, structure, _, _ = scene(2, 3, d=d)
        pair = hyperplane_pair(structure)
        batch = two_bodies(projections, structure, pair.hyperplanes, pair.labels)
        for i in range(2):
            for j in range(3):
                alone = two_bodies(projections[i, j], structure[i, j], pair.hyperplanes[i, j], pair.labels[i, j])
                for part in ("cameras", "points", "collineation"):
                    torch.testing.assert_close(getattr(batch, part)[i, j], getattr(alone, part), atol=1e-8, rtol=1e-8)


@pytest.mark.slow
def test_gradients_of_the_images():
    projections, structure, _, _ = scene(d=3)
    pair = hyperplane_pair(structure)

    def of_structure(y, h):
        bodies = two_bodies(projections, y, h, pair.labels)
        seen = homogeneous(bodies.points)[:, None, None, :] @ bodies.cameras[pair.labels - 1].mT
        return inhomogeneous(seen)

    assert torch.autograd.gradcheck(
        of_structure, (structure.requires_grad_(), pair.hyperplanes.detach().requires_grad_()), atol=1e-4, rtol=1e-3
    )


def test_misuse():
    points, planes = random(20, 4), random(2, 5)
    projections, structure, _, _ = scene()
    assert_refused(
        (lambda: hyperplane_pair(points.long()), "structure must be"),
        (lambda: hyperplane_pair(points, torch.ones(19)), "weights must be"),
        (lambda: hyperplane_pair(points, -torch.ones(20)), "weights must not be negative"),
        (lambda: hyperplane_pair(points, information=torch.ones(20, 4)), "information must be"),
        (lambda: factor_product(torch.zeros(5, 6)), r"matrix must be \(\*batch, 6, 6\), got \(5, 6\)"),
        (lambda: two_bodies(projections[..., :4], structure, planes, LABELS), "projections must be"),
        (lambda: two_bodies(projections, structure, planes[:1], LABELS), "hyperplanes must be"),
        (lambda: two_bodies(projections, structure, planes, LABELS + (LABELS == 2)), "got 1 to 3"),
        (lambda: two_bodies(projections, structure, planes, LABELS[:-1]), "got shape"),
        (lambda: two_bodies(projections, LABELS, planes, LABELS), "structure must be"),
    )


# Numbers of bodies follow a rule, whatever order a search found them in.


def by_hand(labels, count):
    bodies = [[i for i, label in enumerate(labels) if label == k] for k in range(count)]
    return sorted(range(count), key=lambda k: (-len(bodies[k]), bodies[k][0] if bodies[k] else len(labels), k))


def test_all_partitions_of_six_matches_into_three_bodies():
    labels = torch.tensor(list(itertools.product(range(4), repeat=6)))  # 3: in no body
    members = labels[:, None, :] == torch.arange(3)[:, None]
    assert order_of_bodies(members).tolist() == [by_hand(row, 3) for row in labels.tolist()]
    assert order_of_bodies(torch.zeros(2, 3, 0, dtype=torch.bool)).tolist() == [[0, 1, 2]] * 2
    assert order_of_bodies(torch.zeros(0, 5, dtype=torch.bool)).shape == (0,)
