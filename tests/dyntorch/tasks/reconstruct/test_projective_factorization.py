"""Projective factorization: moving planar scenes and static ones, against the truth and a bundle of the truth; misuse."""

import pytest
import torch

from dyntorch.tasks.reconstruct import factorization
from dyntorch.tasks.reconstruct.factorization import projective_factorization

CALIBRATION = torch.tensor([[1300.0, 0.0, 500.0], [0.0, 1300.0, 500.0], [0.0, 0.0, 1.0]], dtype=torch.float64)


def scene(*batch, views, n, motion="planar", seed=0):
    """Images ``(*batch, views, n, 2)`` of cameras around the origin, the projections P^k -> P^2 and the structure."""
    g = torch.Generator().manual_seed(seed)

    def random(*shape):
        return torch.randn(*batch, *shape, generator=g, dtype=torch.float64)

    # the factorization of a plane seen from near its side often ends in a wrong minimum
    centres = random(views, 3)
    centres = torch.cat([centres[..., :2], centres[..., 2:].abs() + 0.5], -1)
    centres = torch.nn.functional.normalize(centres, dim=-1) * (7 + 0.3 * random(views, 1))
    z = -torch.nn.functional.normalize(centres, dim=-1)
    x = torch.nn.functional.normalize(torch.linalg.cross(random(views, 3), z), dim=-1)
    rotation = torch.stack([x, torch.linalg.cross(z, x), z], -2)
    cameras = CALIBRATION @ torch.cat([rotation, -rotation @ centres[..., None]], -1)
    dim = 2 if motion == "planar" else 3
    structure = torch.cat([random(n, dim).clamp(-1.5, 1.5), torch.ones(*batch, n, 1, dtype=torch.float64)], -1)
    if dim == 2:
        cameras = cameras[..., [0, 1, 3]]
    if motion != "static":
        structure = torch.cat([structure, 0.5 / views * random(n, dim)], -1)
        times = torch.arange(views, dtype=torch.float64)
        cameras = torch.cat([cameras, times[:, None, None] * cameras[..., :dim]], -1)
    return reproject(cameras, structure), cameras, structure


def reproject(projections, structure):
    p = structure[..., None, :, :] @ projections.mT
    return p[..., :2] / p[..., 2:]


def rms(found, tracks):
    return (reproject(found.projections, found.structure) - tracks).square().sum(-1).mean((-2, -1)).sqrt()


@pytest.mark.parametrize("views", [5, 8, 12])
def test_constant_velocity_in_a_plane_exactly(views):
    tracks, projections, structure = scene(4, views=views, n=40)
    found = projective_factorization(tracks, 5)
    assert found.projections.shape == (4, views, 3, 5) and found.structure.shape == (4, 40, 5)
    assert found.status.eq(0).all() and (found.residual <= 1e-12).all()
    assert (rms(found, tracks) < 1e-7).all()
    # one collineation of P^4 takes the truth to the result
    collineation = torch.linalg.lstsq(normal(found.projections).flatten(1, 2), normal(projections).flatten(1, 2))
    assert collineation.solution.shape == (4, 5, 5)
    back = torch.nn.functional.normalize(structure @ align(structure, found.structure).mT, dim=-1)
    cosine = (back * found.structure).sum(-1).abs()
    torch.testing.assert_close(cosine, torch.ones_like(cosine), rtol=0, atol=1e-9)


def normal(projections):
    return projections / torch.linalg.matrix_norm(projections, keepdim=True)


def align(first, second):
    """Collineation ``(b, K, K)`` of homogeneous points, from :math:`y_i (H x)_j = y_j (H x)_i`."""
    size = first.shape[-1]
    i, j = torch.triu_indices(size, size, 1)
    eye = torch.eye(size, dtype=first.dtype)
    rows = (second[..., i, None] * eye[j] - second[..., j, None] * eye[i])[..., None] * first[..., None, None, :]
    return torch.linalg.svd(rows.flatten(-2).flatten(1, 2), full_matrices=False).Vh[:, -1].unflatten(-1, (size, size))


def optimum(tracks, projections, structure):
    """Reference: root mean square after Gauss-Newton on the image distances from the truth."""
    shapes = (projections.shape, structure.shape)
    theta = torch.cat([normal(projections).flatten(), torch.nn.functional.normalize(structure, dim=-1).flatten()])
    split = [projections.numel(), structure.numel()]

    def residuals(theta):
        parts = [p.reshape(s) for p, s in zip(theta.split(split), shapes, strict=True)]
        return (reproject(*parts) - tracks).flatten()

    for _ in range(4):
        step = torch.linalg.lstsq(torch.func.jacfwd(residuals)(theta), residuals(theta)[:, None], driver="gelsd").solution
        theta = theta - step[:, 0]
    return (residuals(theta).square().sum() / tracks[..., 0].numel()).sqrt()


@pytest.mark.slow
def test_noise_leaves_little_more_than_the_best_reprojection():
    exact, projections, structure = scene(2, views=5, n=60)
    tracks = exact + torch.randn(exact.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    found = projective_factorization(tracks, 5)
    assert found.status.eq(0).all()
    # below the error of the truth itself: structure and projections take their share of the noise
    assert (rms(found, tracks) < (exact - tracks).square().sum(-1).mean((1, 2)).sqrt()).all()
    for i in range(2):
        assert rms(found, tracks)[i] < 1.1 * optimum(tracks[i], projections[i], structure[i])


@pytest.mark.parametrize(("motion", "rank", "views"), [("static", 4, 4), ("space", 7, 12)])
def test_other_ranks(motion, rank, views):
    tracks = scene(2, views=views, n=50, motion=motion)[0]
    found = projective_factorization(tracks, rank)
    assert found.status.eq(0).all() and (rms(found, tracks) < 1e-7).all()


def test_sensors_of_other_dimensions():
    g = torch.Generator().manual_seed(3)
    projections, structure = (torch.rand(*s, generator=g, dtype=torch.float64) for s in ((5, 4, 7), (40, 7)))
    p = structure @ projections.mT
    tracks = p[..., :3] / p[..., 3:]  # P^6 -> P^3
    found = projective_factorization(tracks, 7)
    q = found.structure @ found.projections.mT
    torch.testing.assert_close(q[..., :3] / q[..., 3:], tracks, rtol=1e-7, atol=1e-7)


def test_any_coordinates_of_the_images_give_the_same():
    tracks = scene(views=6, n=30)[0]
    tracks = tracks + torch.randn(tracks.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    shift = torch.arange(6, dtype=torch.float64)[:, None, None] * 70 - 900
    scale = torch.tensor([0.001, 1.0, 5.0, 2.0, 30.0, 1.0], dtype=torch.float64)[:, None, None]
    found, moved = projective_factorization(tracks, 5), projective_factorization(scale * tracks + shift, 5)
    torch.testing.assert_close(moved.residual, found.residual, rtol=1e-5, atol=0)
    first, second = reproject(found.projections, found.structure), reproject(moved.projections, moved.structure)
    torch.testing.assert_close((second - shift) / scale, first, rtol=0, atol=1e-3)


@pytest.mark.slow
def test_a_batch_is_its_problems_and_a_bad_one_stays_alone(monkeypatch):
    tracks = scene(3, views=8, n=40)[0]
    clean = projective_factorization(tracks, 5)
    spoilt = tracks.clone()
    spoilt[1, 2] = torch.nan
    found = projective_factorization(spoilt, 5)
    assert found.status.eq(0).tolist() == [True, False, True]
    assert found.residual[1] == 1 and not found.projections[1].any() and not found.structure[1].any()
    for i in (0, 2):
        assert rms(projective_factorization(tracks[i], 5), tracks[i]) < 1e-7
        torch.testing.assert_close(found.structure[i], clean.structure[i], rtol=0, atol=1e-6)
    assert projective_factorization(tracks.float(), 5).structure.dtype == torch.float32
    assert projective_factorization(tracks[:0], 5).structure.shape == (0, 40, 5)
    monkeypatch.setattr(factorization, "MAX_ITERATIONS", 3)
    stopped = projective_factorization(tracks, 5)
    assert stopped.status.ne(0).all() and stopped.structure.isfinite().all() and (stopped.residual < 0.1).all()


def test_points_that_are_not_seen_everywhere_are_left_out():
    tracks = scene(2, views=6, n=30)[0]
    clean = tracks.clone()
    weights = torch.ones(2, 6, 30)
    weights[0, 3, 4] = 0
    tracks[0, 3, 4] = 1e6
    tracks[1, 2, 7, 1] = torch.nan
    found = projective_factorization(tracks, 5, weights)
    assert found.status.eq(0).all()
    for i, gone in enumerate((4, 7)):
        keep = [p for p in range(30) if p != gone]
        assert not found.structure[i, gone].any()
        torch.testing.assert_close(reproject(found.projections, found.structure)[i][:, keep], clean[i][:, keep], rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("shape", "rank", "message"),
    [
        ((2, 20, 2), 5, "needs at least 3 views, got 2"),
        ((5, 7, 2), 5, "from 5 views needs at least 8 points, got 7"),
        ((5, 20, 2), 3, "rank must exceed"),
        ((20, 2), 4, "tracks must be"),
    ],
)
def test_misuse_is_refused(shape, rank, message):
    with pytest.raises(ValueError, match=message):
        projective_factorization(torch.zeros(shape), rank)


def test_weights_of_another_shape_are_refused():
    with pytest.raises(ValueError, match="weights must be"):
        projective_factorization(torch.zeros(5, 20, 2), 5, torch.ones(20))
    with pytest.raises(ValueError, match=r"weights must be .* = \(5, 20\), got \(2, 5, 20\)"):
        projective_factorization(torch.zeros(5, 20, 2), 5, weights=torch.ones(2, 5, 20))
