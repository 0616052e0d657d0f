"""Projective factorization: moving planar scenes and static ones, against the truth and a bundle of the truth; misuse."""

from functools import partial

import pytest
import torch

from dyntorch import scenes
from dyntorch.tasks.reconstruct import factorization
from dyntorch.tasks.reconstruct.factorization import projective_factorization, velocity_factorization
from tests.draws import seeded

TIMES = torch.tensor([3.0, 3.5, 4.5, 5.0, 6.5, 7.0, 8.5, 9.0], dtype=torch.float64)


MODELS = {"planar": "constant_velocity_2d", "static": "static_3d", "space": "constant_velocity_3d"}


def scene(*batch, views, n, motion="planar", seed=0):
    """Images ``(*batch, views, n, 2)``, the projections P^k -> P^2 and the structure."""
    found = scenes.lifted_points(MODELS[motion], n, views=views, batch=batch, generator=seeded(seed))
    return found.tracks, found.projections, found.structure


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


def optimum(tracks, seen, truth):
    """Reference: root mean square after Gauss-Newton on the image distances from the truth, whose images ``seen`` gives."""
    theta, sizes = torch.cat([p.flatten() for p in truth]), [p.numel() for p in truth]

    def residuals(theta):
        parts = [part.reshape(p.shape) for part, p in zip(theta.split(sizes), truth, strict=True)]
        return (seen(*parts) - tracks).flatten()

    for _ in range(5):
        jacobian = torch.func.jacfwd(residuals)(theta)
        scale = jacobian.norm(dim=0)  # cameras and structure have other units
        theta = theta - torch.linalg.lstsq(jacobian / scale, residuals(theta)[:, None], driver="gelsd").solution[:, 0] / scale
    return (residuals(theta).square().sum() / tracks[..., 0].numel()).sqrt()


@pytest.mark.slow
def test_noise_leaves_little_more_than_the_best_reprojection():
    exact, projections, structure = scene(2, views=5, n=60)
    tracks = exact + torch.randn(exact.shape, generator=seeded(1), dtype=torch.float64)
    found = projective_factorization(tracks, 5)
    assert found.status.eq(0).all()
    # below the error of the truth itself: structure and projections take their share of the noise
    assert (rms(found, tracks) < (exact - tracks).square().sum(-1).mean((1, 2)).sqrt()).all()
    for i in range(2):
        truth = normal(projections[i]), torch.nn.functional.normalize(structure[i], dim=-1)
        assert rms(found, tracks)[i] < 1.1 * optimum(tracks[i], reproject, truth)


@pytest.mark.parametrize(("motion", "rank", "views"), [("static", 4, 4), ("space", 7, 12)])
def test_other_ranks(motion, rank, views):
    tracks = scene(2, views=views, n=50, motion=motion, seed=1)[0]  # one scene in a dozen ends in a wrong minimum
    found = projective_factorization(tracks, rank)
    assert found.status.eq(0).all() and (rms(found, tracks) < 1e-7).all()


def test_sensors_and_image_coordinates_of_any_kind():
    g = seeded(3)
    projections, structure = (torch.rand(*s, generator=g, dtype=torch.float64) for s in ((5, 4, 7), (40, 7)))
    p = structure @ projections.mT
    tracks = p[..., :3] / p[..., 3:]  # P^6 -> P^3
    found = projective_factorization(tracks, 7)
    q = found.structure @ found.projections.mT
    torch.testing.assert_close(q[..., :3] / q[..., 3:], tracks, rtol=1e-7, atol=1e-7)
    tracks = scene(views=6, n=30)[0]
    tracks = tracks + torch.randn(tracks.shape, generator=seeded(1), dtype=torch.float64)
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
    ("shape", "rest", "message"),
    [
        ((2, 20, 2), (5,), "needs at least 3 views, got 2"),
        ((5, 7, 2), (5,), "from 5 views needs at least 8 points, got 7"),
        ((5, 20, 2), (3,), "rank must exceed"),
        ((20, 2), (4,), "tracks must be"),
        ((5, 20, 2), (5, torch.ones(20)), "weights must be"),
        ((5, 20, 2), (5, torch.ones(2, 5, 20)), r"weights must be .* = \(5, 20\), got \(2, 5, 20\)"),
        ((4, 20, 2), (TIMES[:4],), "needs at least 5 affine views, got 4"),
        ((2, 20, 2), (TIMES[:2], 2), "needs at least 3 affine views, got 2"),
        ((5, 6, 2), (TIMES[:5],), "needs at least 7 points, got 6"),
        ((5, 20, 3), (TIMES[:5],), "tracks must be"),
        ((5, 20, 2), (TIMES[:5], 4), "dim must be 3, space, or 2"),
        ((5, 20, 2), (TIMES[:4],), "times must be finite"),
        ((5, 20, 2), (TIMES[:5] * torch.nan,), "times must be finite"),
        ((5, 20, 2), (TIMES[[0, 0, 1, 1, 1]],), "at least 3 different ones, got 2"),
        ((5, 20, 2), (TIMES[:5], 3, torch.ones(20)), "weights must be"),
        ((5, 20, 2), (TIMES[:5], 3, torch.ones(2, 5, 20)), r"weights must be .* = \(5, 20\), got \(2, 5, 20\)"),
    ],
)
def test_misuse_is_refused(shape, rest, message):
    with pytest.raises(ValueError, match=message):
        (projective_factorization if isinstance(rest[0], int) else velocity_factorization)(torch.zeros(shape), *rest)


def scene_velocity(*batch, views, n, dim, seed=0):
    """Tracks in pixels of points at constant velocity, by affine cameras, and all that made them."""
    g = seeded(seed)

    def random(*shape):
        return torch.randn(*batch, *shape, generator=g, dtype=torch.float64)

    cameras, offsets = 300 * random(views, 2, dim), 500 + 100 * random(views, 2)
    points, velocities = random(n, dim), 0.3 * random(n, dim)
    return images(cameras, offsets, points, velocities, TIMES[:views]), cameras, offsets, points, velocities


def images(cameras, offsets, points, velocities, times):
    moved = points[..., None, :, :] + times[:, None, None] * velocities[..., None, :, :]
    return moved @ cameras.mT + offsets[..., None, :]


def parts(found):
    return found.cameras, found.offsets, found.points, found.velocities


def gauge(found, true):
    """Residual of the best (X, V) -> (G X + a, G V + b), relative to the scene_velocity."""
    left, right = (torch.cat([p - p.mean(-2, keepdim=True), v - v.mean(-2, keepdim=True)], -2) for p, v in (found, true))
    return (left @ torch.linalg.lstsq(left, right).solution - right).norm(dim=(-2, -1)) / right.norm(dim=(-2, -1))


@pytest.mark.parametrize(("dim", "views", "n"), [(3, 5, 7), (3, 5, 30), (3, 8, 20), (2, 3, 5), (2, 3, 30), (2, 7, 20)])
def test_exact_scenes_up_to_an_affinity_and_a_common_velocity(dim, views, n):
    tracks, _, _, points, velocities = scene_velocity(4, views=views, n=n, dim=dim)
    found = velocity_factorization(tracks, TIMES[:views], dim)
    assert found.cameras.shape == (4, views, 2, dim) and found.offsets.shape == (4, views, 2)
    assert found.points.shape == found.velocities.shape == (4, n, dim)
    assert found.status.eq(0).all() and (found.residual < 1e-6).all()
    torch.testing.assert_close(images(*parts(found), TIMES[:views]), tracks, rtol=0, atol=1e-6)
    error = gauge((found.points, found.velocities), (points, velocities))
    assert error.median() < 1e-9 and error.max() < 1e-6
    # the gauge that the docstring promises
    zero = torch.zeros(4, dim, dtype=torch.float64)
    torch.testing.assert_close(found.points.mean(-2), zero, rtol=0, atol=1e-9)
    torch.testing.assert_close(found.velocities.mean(-2), zero, rtol=0, atol=1e-9)
    gram = (found.cameras.mT @ found.cameras).sum(1)
    torch.testing.assert_close(gram, 2 * views / dim * torch.eye(dim, dtype=torch.float64).expand_as(gram))


def test_nothing_changes_with_the_units_of_time_and_image():
    tracks, _, _, points, velocities = scene_velocity(views=6, n=15, dim=3)
    times = TIMES[:6]
    found = velocity_factorization(tracks, times)
    later = velocity_factorization(tracks, 60 * times - 7.0)
    assert gauge((later.points, later.velocities), (points + 7 / 60 * velocities, velocities / 60)) < 1e-9
    scaled = velocity_factorization(0.01 * tracks - 3.0, times)
    torch.testing.assert_close(images(*parts(scaled), times), 0.01 * images(*parts(found), times) - 3.0)


@pytest.mark.slow
@pytest.mark.parametrize(("dim", "views"), [(3, 6), (2, 4)])
def test_noise_ends_in_the_optimum_of_the_image_distances(dim, views, monkeypatch):
    tracks, *truth = scene_velocity(5, views=views, n=30, dim=dim)
    tracks = tracks + torch.randn(tracks.shape, generator=seeded(1), dtype=torch.float64)
    times = TIMES[:views]
    monkeypatch.setattr(factorization, "SWEEP_TOLERANCE", 1e-12)
    monkeypatch.setattr(factorization, "MAX_SWEEPS", 1000)
    found = velocity_factorization(tracks, times, dim)
    monkeypatch.setattr(factorization, "MAX_SWEEPS", 1)
    first = velocity_factorization(tracks, times, dim)
    assert (found.residual <= first.residual).all()
    again = (images(*parts(found), times) - tracks).square().sum(-1).mean((1, 2)).sqrt()
    torch.testing.assert_close(found.residual, again)
    for i in range(3):
        best = optimum(tracks[i], partial(images, times=times), [p[i] for p in truth])
        torch.testing.assert_close(found.residual[i], best, rtol=1e-4, atol=0)
    unknown = views * 2 * (dim + 1) + 30 * 2 * dim - dim * (dim + 2)
    expected = (2 - unknown / (views * 30)) ** 0.5  # px, of one pixel of noise per coordinate
    torch.testing.assert_close(found.residual.mean(), torch.tensor(expected, dtype=torch.float64), rtol=0.1, atol=0)


def test_a_batch_is_its_problems_and_a_bad_one_stays_alone_of_velocity():
    tracks = scene_velocity(3, views=6, n=15, dim=3)[0]
    clean = velocity_factorization(tracks, TIMES[:6])
    spoilt = tracks.clone()
    spoilt[1, 2] = torch.nan
    found = velocity_factorization(spoilt, TIMES[:6].expand(3, 6))
    assert found.status.ne(0).tolist() == [False, True, False]
    for part, reference in zip((*parts(found), found.residual), (*parts(clean), clean.residual), strict=True):
        assert part.isfinite().all()
        torch.testing.assert_close(part[[0, 2]], reference[[0, 2]])
    one = velocity_factorization(tracks[2], TIMES[:6])
    torch.testing.assert_close(images(*parts(one), TIMES[:6]), images(*parts(clean), TIMES[:6])[2])
    assert velocity_factorization(tracks.float(), TIMES[:6]).points.dtype == torch.float32
    assert velocity_factorization(tracks[:0], TIMES[:6]).points.shape == (0, 15, 3)


def test_points_that_are_not_seen_everywhere_are_left_out_of_velocity():
    tracks, _, _, points, velocities = scene_velocity(2, views=6, n=15, dim=3)
    weights = torch.ones(2, 6, 15)
    weights[0, 3, 4] = 0
    tracks[0, 3, 4] = 1e6
    tracks[1, 2, 7, 1] = torch.nan
    found = velocity_factorization(tracks, TIMES[:6], weights=weights)
    assert found.status.eq(0).all() and (found.residual < 1e-8).all()
    for i, gone in enumerate((4, 7)):
        keep = [p for p in range(15) if p != gone]
        assert not found.points[i, gone].any() and not found.velocities[i, gone].any()
        assert gauge((found.points[i, keep], found.velocities[i, keep]), (points[i, keep], velocities[i, keep])) < 1e-8


def cameras_looking(directions):
    """Affine cameras whose null vectors are the directions ``(views, 3)``."""
    return 300 * torch.linalg.svd(directions[:, None, :], full_matrices=True).Vh[:, 1:]


def turntable(views):
    angle = torch.tensor([0.0, 0.4, 0.7, 1.3, 1.6, 2.4, 2.5], dtype=torch.float64)[:views]
    return torch.stack([angle.cos(), torch.zeros_like(angle), angle.sin()], -1)


def quadratic(views):
    powers = TIMES[:views, None] ** torch.arange(3)
    return powers @ torch.tensor([[1.0, 0.0, 0.3], [0.1, 0.2, -0.1], [0.02, -0.1, 0.05]], dtype=torch.float64)


def fixed(views):
    return torch.tensor([[0.2, 0.3, 1.0]], dtype=torch.float64).repeat(views, 1)


@pytest.mark.parametrize(
    ("directions", "degenerate"), [(turntable(5), True), (turntable(6), False), (quadratic(8), True), (fixed(8), True)]
)
def test_viewing_directions_that_decide_nothing(directions, degenerate):
    views = len(directions)
    _, _, offsets, points, velocities = scene_velocity(views=views, n=20, dim=3)
    cameras = cameras_looking(directions)
    found = velocity_factorization(images(cameras, offsets, points, velocities, TIMES[:views]), TIMES[:views])
    assert bool(found.status) == degenerate
    assert all(part.isfinite().all() for part in (*parts(found), found.residual))
    if not degenerate:
        assert gauge((found.points, found.velocities), (points, velocities)) < 1e-8


@pytest.mark.parametrize("kind", ["static", "direction", "planes", "flat", "same"])
def test_motions_that_decide_nothing(kind):
    _, cameras, offsets, points, velocities = scene_velocity(views=8, n=20, dim=3)
    velocities = velocities.clone()
    if kind == "static":
        velocities[:] = velocities[:1]  # a common velocity is no motion
    elif kind == "direction":
        velocities = velocities[:, :1] * velocities[:1]
    elif kind == "planes":
        velocities[:, 2] = 0.1
    elif kind == "flat":
        points, velocities = points * torch.tensor([1.0, 1.0, 0.0]), velocities * torch.tensor([1.0, 1.0, 0.0])
    else:
        points, velocities = points[:1].repeat(20, 1), velocities[:1].repeat(20, 1)
    found = velocity_factorization(images(cameras, offsets, points, velocities, TIMES), TIMES)
    assert bool(found.status) and all(part.isfinite().all() for part in (*parts(found), found.residual))


def test_a_fixed_camera_is_enough_for_a_plane():
    _, cameras, offsets, points, velocities = scene_velocity(views=4, n=20, dim=2)
    tracks = images(cameras[:1].expand(4, 2, 2), offsets[:1].expand(4, 2), points, velocities, TIMES[:4])
    found = velocity_factorization(tracks, TIMES[:4], 2)
    assert found.status == 0 and gauge((found.points, found.velocities), (points, velocities)) < 1e-9
