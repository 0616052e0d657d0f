"""Errors: blind to the gauges they claim, equal to closed forms, and sensitive to everything else."""

import math

import pytest
import torch

from dyntorch.geometry.homogeneous import apply, similarity, skew
from dyntorch.metrics import (
    affine_gauge,
    grid_transfer_error,
    label_scores,
    point_error,
    relative_error,
    rotation_error,
    subspace_angle,
    translation_error,
)
from dyntorch.scenes import constant_velocity, planar


def random(*shape, seed=0, dtype=torch.float64):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def rigid(*batch, seed=0, spread=0.5):
    """Rigid motions, their rotation vectors and translations."""
    w, t = spread * random(*batch, 3, seed=seed), random(*batch, 3, seed=seed + 1)
    upper = torch.cat([torch.linalg.matrix_exp(skew(w)), t[..., None]], dim=-1)
    last = torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=torch.float64).expand(*batch, 1, 4)
    return torch.cat([upper, last], dim=-2), w, t


@pytest.mark.parametrize(("shape", "dims"), [((5,), 1), ((3, 3), 2), ((4, 4, 3), 3)])
def test_relative_error_ignores_scale_and_sign_only(shape, dims):
    a = random(6, *shape)
    for scale in (1.0, -1e-100, 1e100):
        assert relative_error(scale * a, a, dims=dims).max() < 1e-15
    noise = random(6, *shape, seed=1)
    unit_noise = noise / noise.flatten(1).norm(dim=-1).reshape(-1, *(1 for _ in shape)) * a.flatten(1).norm(dim=-1).max()
    small = relative_error(a + 1e-12 * unit_noise, a, dims=dims)
    assert (small > 1e-14).all() and (small < 1e-11).all()


def test_relative_error_of_known_angles():
    angle = torch.tensor([0.0, 0.1, math.pi / 2, 3.0], dtype=torch.float64)
    e = torch.stack([angle.cos(), angle.sin()], -1)
    expected = 2 * torch.minimum(angle, math.pi - angle).div(2).sin()
    torch.testing.assert_close(relative_error(e, e[0], dims=1), expected)
    assert float(relative_error(torch.zeros(3, 3), torch.eye(3))) == pytest.approx(1.0)
    with pytest.raises(ValueError, match="one shape"):
        relative_error(random(3, 3), random(4, 4))


def test_grid_transfer_error_against_a_loop():
    a, b = planar(5, batch=2, generator=torch.Generator().manual_seed(1)).motion
    points = torch.tensor([[x, y] for x in (0.0, 320.0, 640.0) for y in (0.0, 240.0, 480.0)], dtype=torch.float64)
    for i in range(2):
        far = torch.stack([(apply(a[i], p[None]) - apply(b[i], p[None])).norm() for p in points])
        for reduction, value in (("rms", far.square().mean().sqrt()), ("median", far.median()), ("max", far.max())):
            torch.testing.assert_close(grid_transfer_error(a[i], b[i], 640, 480, reduction=reduction, count=3), value)
    torch.testing.assert_close(
        grid_transfer_error(-3 * a, b, 640, 480),
        torch.stack([grid_transfer_error(x, y, 640, 480) for x, y in zip(a, b, strict=True)]),
    )
    assert grid_transfer_error(-7 * a, a, 640, 480).max() < 1e-9


def test_grid_transfer_error_refuses_other_reductions():
    with pytest.raises(ValueError, match="reduction 'rms'"):
        grid_transfer_error(torch.eye(3), torch.eye(3), 640, 480, reduction="mean")


def test_point_error_is_the_rms_distance():
    true, points = rigid(4)[0], random(4, 9, 3, seed=5)
    shifted = similarity(torch.ones(4, dtype=torch.float64), torch.tensor([[-3.0, 0.0, 4.0]]).double().expand(4, 3)) @ true
    torch.testing.assert_close(point_error(-2 * shifted, true, points), torch.full((4,), 5.0, dtype=torch.float64))
    assert point_error(true, true, points).max() == 0


def test_rotation_and_translation_errors_of_known_motions():
    true, _, t = rigid(50)
    for degrees in (1e-9, 1e-3, 1.0, 90.0, 179.0, 180.0):
        axis = torch.nn.functional.normalize(random(50, 3, seed=7), dim=-1)
        turn = torch.eye(4, dtype=torch.float64).repeat(50, 1, 1)
        turn[:, :3, :3] = torch.linalg.matrix_exp(skew(axis * math.radians(degrees)))
        expected = torch.full((50,), degrees, dtype=torch.float64)
        torch.testing.assert_close(rotation_error(-0.3 * true @ turn, true), expected, rtol=1e-6, atol=1e-13)
    other, _, s = rigid(50, seed=20)
    torch.testing.assert_close(translation_error(-0.3 * other, true), (s - t).norm(dim=-1))
    # the translation does not enter the rotation error
    moved = true.clone()
    moved[:, :3, 3] += 1.0
    assert rotation_error(moved, true).max() < 1e-12
    with pytest.raises(ValueError, match="rigid motion"):
        rotation_error(torch.eye(3), torch.eye(3))


def test_rotation_error_takes_the_nearest_rotation():
    true, _, _ = rigid(10)
    noisy = true.clone()
    noisy[:, :3, :3] += 1e-3 * random(10, 3, 3, seed=3)
    error = rotation_error(noisy, true)
    assert (error > 1e-4).all() and (error < math.degrees(5e-3)).all()
    stretched = true.clone()
    stretched[:, :3, :3] *= 1.5
    assert rotation_error(stretched, true).max() < 1e-12


def gauge(batch, seed):
    """An affinity of the world and a common velocity, as one matrix per instant."""
    g = torch.eye(4, dtype=torch.float64).repeat(batch, 3, 1, 1)
    t = torch.arange(3, dtype=torch.float64)[:, None]
    g[..., :3, :] = torch.eye(3, 4, dtype=torch.float64) + 0.4 * random(batch, 1, 3, 4, seed=seed)
    g[..., :3, 3] += t * random(batch, 1, 3, seed=seed + 1)
    return g


@pytest.mark.parametrize("seed", range(4))
def test_affine_gauge_absorbs_affinity_and_common_velocity(seed):
    scene = constant_velocity(10, batch=5, generator=torch.Generator().manual_seed(seed))
    true = torch.stack(scene.motion, dim=-3)
    scale = random(5, 3, 1, 1, seed=seed)
    aligned, error = affine_gauge(scale * true @ gauge(5, seed), true)
    assert error.shape == (5,) and error.max() < 1e-11
    torch.testing.assert_close(aligned, true, rtol=0, atol=1e-11)


def test_affine_gauge_keeps_the_equations_it_claims():
    # x + t v in the gauge is an affine image of x + t v plus t times one velocity
    scene = constant_velocity(20, generator=torch.Generator().manual_seed(1))
    x, v = scene.extras["points"], scene.extras["velocities"]
    inverse = torch.linalg.inv(gauge(1, 2)[0])
    y = [apply(inverse[t], x + t * v) for t in range(3)]
    torch.testing.assert_close(y[0] - 2 * y[1] + y[2], torch.zeros_like(x), rtol=0, atol=1e-10)


@pytest.mark.parametrize("wrong", ["acceleration", "affinity of one sensor", "projective world"])
def test_affine_gauge_does_not_absorb_more(wrong):
    true = torch.stack(constant_velocity(10, batch=5, generator=torch.Generator().manual_seed(0)).motion, dim=-3)
    change = torch.eye(4, dtype=torch.float64).repeat(5, 3, 1, 1)
    if wrong == "acceleration":
        change[:, :, 0, 3] = 0.1 * torch.tensor([0.0, 1.0, 4.0], dtype=torch.float64)
    elif wrong == "affinity of one sensor":
        change[:, 1, 0, 1] = 0.1
    else:
        change[:, :, 3, 0] = 0.1
    assert affine_gauge(true @ change, true)[1].min() > 5e-3
    # in proportion to what is wrong
    error = affine_gauge(true @ (torch.eye(4) + 1e-6 * (change - torch.eye(4))), true)[1]
    assert error.max() < 1e-6 and error.min() > 1e-9


def test_affine_gauge_error_does_not_depend_on_the_gauge_of_the_estimate():
    true = torch.stack(constant_velocity(10, batch=5, generator=torch.Generator().manual_seed(0)).motion, dim=-3)
    noisy = true + 1e-3 * random(5, 3, 4, 4, seed=4)
    first, second = affine_gauge(noisy, true)[1], affine_gauge(noisy @ gauge(5, 8), true)[1]
    torch.testing.assert_close(first, second, rtol=1e-9, atol=0)
    assert first.max() < 0.02
    with pytest.raises(ValueError, match="sensors must be"):
        affine_gauge(true[:, :2], true[:, :2])


def test_subspace_angle_of_known_spaces():
    for degrees in (0.0, 1e-10, 0.5, 45.0, 89.9999999, 90.0):
        a = math.radians(degrees)
        u = torch.tensor([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0], [0.0, 0.0]], dtype=torch.float64)
        v = torch.tensor([[1.0, 0.0], [0.0, math.cos(a)], [0.0, math.sin(a)], [0.0, 0.0]], dtype=torch.float64)
        mix = random(3, 2, 2, seed=1)
        value = subspace_angle(u @ mix, v @ random(3, 2, 2, seed=2))
        torch.testing.assert_close(value, torch.full((3,), degrees, dtype=torch.float64), rtol=1e-9, atol=1e-13)
    assert float(subspace_angle(u, u[:, :1])) < 1e-13 and float(subspace_angle(u[:, :1], u)) < 1e-13


def test_subspace_angle_agrees_with_projectors():
    u, v = random(6, 10, 3), random(6, 10, 3, seed=1)
    projectors = [x @ torch.linalg.pinv(x) for x in (u, v)]
    sine = torch.linalg.matrix_norm(projectors[0] - projectors[1], ord=2)
    torch.testing.assert_close(subspace_angle(u, v), torch.rad2deg(sine.clamp(max=1).asin()), rtol=1e-6, atol=1e-6)
    with pytest.raises(ValueError, match="rows"):
        subspace_angle(random(4, 2), random(5, 2))


def test_label_scores_against_counting():
    generator = torch.Generator().manual_seed(0)
    given, true = (torch.randint(0, 3, (2, 4, 50), generator=generator) for _ in range(2))
    scores = label_scores(given, true)
    assert scores.recall.shape == (2, 4, 3)
    for i in range(2):
        for j in range(4):
            for k in range(3):
                pairs = list(zip(given[i, j].tolist(), true[i, j].tolist(), strict=True))
                right = sum(a == b == k for a, b in pairs)
                assert float(scores.recall[i, j, k]) == pytest.approx(right / sum(b == k for _, b in pairs))
                assert float(scores.precision[i, j, k]) == pytest.approx(right / sum(a == k for a, _ in pairs))


def test_label_scores_of_absent_labels():
    scores = label_scores(torch.tensor([1, 1, 1]), torch.tensor([1, 1, 2]))
    assert scores.recall.tolist() == [1.0, 1.0, 0.0]
    assert scores.precision.tolist() == [1.0, pytest.approx(2 / 3), 1.0]
    with pytest.raises(ValueError, match="one shape"):
        label_scores(torch.zeros(3), torch.zeros(4))


@pytest.mark.parametrize("failure", [math.nan, 0.0, math.inf])
def test_a_failed_estimate_has_the_worst_error_and_leaves_the_others_alone(failure):
    true, _, _ = rigid(3)
    estimated = true.clone()
    estimated[1] = failure
    points = random(3, 5, 3)
    for error, worst in (
        (relative_error(estimated, true), 1.0),
        (rotation_error(estimated, true), 180.0),
        (translation_error(estimated, true), math.inf),
        (affine_gauge(estimated[:, None].expand(3, 3, 4, 4), true[:, None].expand(3, 3, 4, 4))[1], 1.0),
    ):
        assert float(error[1]) == pytest.approx(worst) and error[[0, 2]].max() < 1e-12
    far = point_error(estimated, true, points)
    assert far[1] > 0.1 and not far.isnan().any() and far[[0, 2]].max() == 0
    if failure:
        spaces = estimated[..., :2]
        assert float(subspace_angle(spaces, true[..., :2])[1]) == 90.0
        assert float(far[1]) == math.inf
        image = torch.eye(3, dtype=torch.float64).repeat(3, 1, 1)
        image[1] = failure
        assert grid_transfer_error(image, torch.eye(3, dtype=torch.float64), 640, 480).tolist() == [0.0, math.inf, 0.0]
    aligned, _ = affine_gauge(estimated[:, None].expand(3, 3, 4, 4), true[:, None].expand(3, 3, 4, 4))
    assert aligned.isfinite().all()
