"""Factorization of constant velocity: exact scenes up to the gauge, the optimum from the truth, degenerate scenes, misuse."""

import pytest
import torch

from dyntorch.tasks.reconstruct import factorization
from dyntorch.tasks.reconstruct.factorization import velocity_factorization

TIMES = torch.tensor([3.0, 3.5, 4.5, 5.0, 6.5, 7.0, 8.5, 9.0], dtype=torch.float64)


def scene(*batch, views, n, dim, seed=0):
    """Tracks in pixels of points at constant velocity, by affine cameras, and all that made them."""
    g = torch.Generator().manual_seed(seed)

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
    """Residual of the best (X, V) -> (G X + a, G V + b), relative to the scene."""
    left, right = (torch.cat([p - p.mean(-2, keepdim=True), v - v.mean(-2, keepdim=True)], -2) for p, v in (found, true))
    return (left @ torch.linalg.lstsq(left, right).solution - right).norm(dim=(-2, -1)) / right.norm(dim=(-2, -1))


@pytest.mark.parametrize(("dim", "views", "n"), [(3, 5, 7), (3, 5, 30), (3, 8, 20), (2, 3, 5), (2, 3, 30), (2, 7, 20)])
def test_exact_scenes_up_to_an_affinity_and_a_common_velocity(dim, views, n):
    tracks, _, _, points, velocities = scene(4, views=views, n=n, dim=dim)
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


def test_the_rank_that_it_uses():
    for dim in (2, 3):
        tracks = scene(views=8, n=20, dim=dim)[0]
        values = torch.linalg.svdvals((tracks - tracks.mean(-2, keepdim=True)).mT.flatten(0, 1))
        assert values[2 * dim] < 1e-12 * values[0] < values[2 * dim - 1]


def test_nothing_changes_with_the_gauge_of_the_world_or_the_unit_of_time():
    tracks, cameras, offsets, points, velocities = scene(views=6, n=15, dim=3)
    times = TIMES[:6]
    found = velocity_factorization(tracks, times)
    affinity = torch.randn(3, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    shift, drift = torch.tensor([[1.0, 2.0, 3.0], [0.5, -1.0, 0.2]], dtype=torch.float64)
    # the world drifts, and the offsets undo it
    back = torch.linalg.inv(affinity)
    moved_offsets = offsets - (cameras @ (shift + times[:, None] * drift)[..., None])[..., 0]
    same = images(cameras @ back, moved_offsets, (points + shift) @ affinity.mT, (velocities + drift) @ affinity.mT, times)
    torch.testing.assert_close(same, tracks)
    later = velocity_factorization(tracks, 60 * times - 7.0)
    assert gauge((later.points, later.velocities), (points - 7 / 60 * -velocities, velocities / 60)) < 1e-9
    scaled = velocity_factorization(0.01 * tracks - 3.0, times)
    torch.testing.assert_close(images(*parts(scaled), times), 0.01 * images(*parts(found), times) - 3.0)


def optimum(tracks, times, truth):
    """Reference: root mean square after Gauss-Newton on the image distances from the truth."""
    theta, sizes = torch.cat([p.flatten() for p in truth]), [p.numel() for p in truth]

    def residuals(theta):
        parts = [part.reshape(p.shape) for part, p in zip(theta.split(sizes), truth, strict=True)]
        return (images(*parts, times) - tracks).flatten()

    for _ in range(5):
        jacobian = torch.func.jacfwd(residuals)(theta)
        scale = jacobian.norm(dim=0)  # cameras and structure have other units
        theta = theta - torch.linalg.lstsq(jacobian / scale, residuals(theta)[:, None], driver="gelsd").solution[:, 0] / scale
    return (residuals(theta).square().sum() / tracks[..., 0].numel()).sqrt()


@pytest.mark.slow
@pytest.mark.parametrize(("dim", "views"), [(3, 6), (2, 4)])
def test_noise_ends_in_the_optimum_of_the_image_distances(dim, views, monkeypatch):
    tracks, *truth = scene(5, views=views, n=30, dim=dim)
    tracks = tracks + torch.randn(tracks.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
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
        best = optimum(tracks[i], times, [p[i] for p in truth])
        torch.testing.assert_close(found.residual[i], best, rtol=1e-4, atol=0)
    unknown = views * 2 * (dim + 1) + 30 * 2 * dim - dim * (dim + 2)
    expected = (2 - unknown / (views * 30)) ** 0.5  # px, of one pixel of noise per coordinate
    torch.testing.assert_close(found.residual.mean(), torch.tensor(expected, dtype=torch.float64), rtol=0.1, atol=0)


def test_a_batch_is_its_problems_and_a_bad_one_stays_alone():
    tracks = scene(3, views=6, n=15, dim=3)[0]
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


def test_points_that_are_not_seen_everywhere_are_left_out():
    tracks, _, _, points, velocities = scene(2, views=6, n=15, dim=3)
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
    _, _, offsets, points, velocities = scene(views=views, n=20, dim=3)
    cameras = cameras_looking(directions)
    found = velocity_factorization(images(cameras, offsets, points, velocities, TIMES[:views]), TIMES[:views])
    assert bool(found.status) == degenerate
    assert all(part.isfinite().all() for part in (*parts(found), found.residual))
    if not degenerate:
        assert gauge((found.points, found.velocities), (points, velocities)) < 1e-8


@pytest.mark.parametrize("kind", ["static", "direction", "planes", "flat", "same"])
def test_motions_that_decide_nothing(kind):
    _, cameras, offsets, points, velocities = scene(views=8, n=20, dim=3)
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
    _, cameras, offsets, points, velocities = scene(views=4, n=20, dim=2)
    tracks = images(cameras[:1].expand(4, 2, 2), offsets[:1].expand(4, 2), points, velocities, TIMES[:4])
    found = velocity_factorization(tracks, TIMES[:4], 2)
    assert found.status == 0 and gauge((found.points, found.velocities), (points, velocities)) < 1e-9


@pytest.mark.parametrize(
    ("shape", "times", "dim", "message"),
    [
        ((4, 20, 2), TIMES[:4], 3, "needs at least 5 affine views, got 4"),
        ((2, 20, 2), TIMES[:2], 2, "needs at least 3 affine views, got 2"),
        ((5, 6, 2), TIMES[:5], 3, "needs at least 7 points, got 6"),
        ((5, 20, 3), TIMES[:5], 3, "tracks must be"),
        ((5, 20, 2), TIMES[:5], 4, "dim must be 3, space, or 2"),
        ((5, 20, 2), TIMES[:4], 3, "times must be finite"),
        ((5, 20, 2), TIMES[:5] * torch.nan, 3, "times must be finite"),
        ((5, 20, 2), TIMES[[0, 0, 1, 1, 1]], 3, "at least 3 different ones, got 2"),
    ],
)
def test_misuse_is_refused(shape, times, dim, message):
    with pytest.raises(ValueError, match=message):
        velocity_factorization(torch.zeros(shape), times, dim)


def test_weights_of_another_shape_are_refused():
    with pytest.raises(ValueError, match="weights must be"):
        velocity_factorization(torch.zeros(5, 20, 2), TIMES[:5], weights=torch.ones(20))
    with pytest.raises(ValueError, match=r"weights must be .* = \(5, 20\), got \(2, 5, 20\)"):
        velocity_factorization(torch.zeros(5, 20, 2), TIMES[:5], weights=torch.ones(2, 5, 20))
