"""Two translating bodies: exact cameras and affine shapes from any projective frame, what scale is observable, thin bodies."""

import pytest
import torch

from dyntorch.geometry.homogeneous import homogeneous, inhomogeneous
from dyntorch.geometry.pairs import hyperplane_pair, two_bodies

N, FIRST = 20, 12
LABELS = torch.where(torch.arange(N) < FIRST, 1, 2)


def random(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


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


CASES = [(2, 2), (2, 5), (3, 3), (3, 6)]


@pytest.mark.parametrize(("d", "views"), CASES)
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


def test_the_relative_size_is_seen_in_a_plane_and_not_in_space():
    for d, views in CASES:
        projections, structure, points, _ = scene(10, d=d, views=views)
        fits = affinities(solved(projections, structure)[0], points)[0][..., :d, :]
        sizes = torch.linalg.det(fits).abs() ** (1 / d)
        assert ((sizes[:, 1] / sizes[:, 0] - 1).abs().max() < 1e-9) == (d == 2)


def test_relative_size_in_space_changes_no_image():
    # M' of the second body grown by 2 about the origin, with the translation that hides it
    projections, structure, _, images = scene(d=3)
    bodies, _ = solved(projections, structure)
    grown = bodies.cameras[1].clone()
    grown[..., 3] *= 2
    member = LABELS == 2
    seen = homogeneous(2 * bodies.points[None, member]) @ grown.mT
    assert (inhomogeneous(seen) - images[:, member]).abs().max() < 1e-9
    torch.testing.assert_close(grown[..., :3], bodies.cameras[0, ..., :3])


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


def test_batch_is_loop():
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


def test_float32_in_float32_out():
    projections, structure, _, _ = scene()
    pair = hyperplane_pair(structure)
    bodies = two_bodies(projections, structure.float(), pair.hyperplanes, pair.labels)
    assert {bodies.points.dtype, bodies.cameras.dtype} == {torch.float32}


def test_refusals():
    projections, structure, _, _ = scene()
    planes = random(2, 5)
    with pytest.raises(ValueError, match="projections must be"):
        two_bodies(projections[..., :4], structure, planes, LABELS)
    with pytest.raises(ValueError, match="hyperplanes must be"):
        two_bodies(projections, structure, planes[:1], LABELS)
    with pytest.raises(ValueError, match="got 1 to 3"):
        two_bodies(projections, structure, planes, LABELS + (LABELS == 2))
    with pytest.raises(ValueError, match="got shape"):
        two_bodies(projections, structure, planes, LABELS[:-1])
    with pytest.raises(ValueError, match="structure must be"):
        two_bodies(projections, LABELS, planes, LABELS)
