"""Errors: blind to the gauges they claim, equal to closed forms, sensitive to everything else; of segmentations the least over all
ways to name the bodies."""

import math
from itertools import permutations

import pytest
import torch

from dyntorch.geometry.homogeneous import apply, similarity, skew
from dyntorch.geometry.lift import gauge_algebra
from dyntorch.metrics import (
    affine_gauge,
    body_error,
    grid_transfer_error,
    label_scores,
    lifted_error,
    misclassification,
    point_error,
    relative_error,
    rotation_error,
    translation_error,
)
from dyntorch.scenes import constant_velocity, lifted_points, planar
from tests.draws import random, seeded
from tests.grid import assert_refused, grid

MOTIONS = [
    "constant_direction_2d", "constant_velocity_2d", "constant_acceleration_2d", "constant_direction_3d",
    "constant_velocity_planes_3d", "constant_velocity_3d", "constant_velocity_3d_sensors", "static_2d", "static_3d",
]  # fmt: skip


def rigid(*batch, seed=0, spread=0.5):
    """Rigid motions, their rotation vectors and translations."""
    w, t = spread * random(*batch, 3, seed=seed), random(*batch, 3, seed=seed + 1)
    upper = torch.cat([torch.linalg.matrix_exp(skew(w)), t[..., None]], dim=-1)
    last = torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=torch.float64).expand(*batch, 1, 4)
    return torch.cat([upper, last], dim=-2), w, t


@grid((("shape", "dims"), [((5,), 1), ((3, 3), 2), ((4, 4, 3), 3)]))
def test_relative_error_ignores_scale_and_sign_only(shape, dims):
    a = random(6, *shape)
    for scale in (1.0, -1e-100, 1e100):
        assert relative_error(scale * a, a, dims=dims).max() < 1e-15
    noise = random(6, *shape, seed=1)
    unit_noise = noise / noise.flatten(1).norm(dim=-1).reshape(-1, *(1 for _ in shape)) * a.flatten(1).norm(dim=-1).max()
    small = relative_error(a + 1e-12 * unit_noise, a, dims=dims)
    assert (small > 1e-14).all() and (small < 1e-11).all()
    angle = torch.tensor([0.0, 0.1, math.pi / 2, 3.0], dtype=torch.float64)
    e = torch.stack([angle.cos(), angle.sin()], -1)
    torch.testing.assert_close(relative_error(e, e[0], dims=1), 2 * torch.minimum(angle, math.pi - angle).div(2).sin())


def test_grid_transfer_error_against_a_loop():
    a, b = planar(5, batch=2, generator=seeded(1)).motion
    points = torch.tensor([[x, y] for x in (0.0, 320.0, 640.0) for y in (0.0, 240.0, 480.0)], dtype=torch.float64)
    for i in range(2):
        far = torch.stack([(apply(a[i], p[None]) - apply(b[i], p[None])).norm() for p in points])
        torch.testing.assert_close(grid_transfer_error(a[i], b[i], 640, 480, count=3), far.square().mean().sqrt())
    torch.testing.assert_close(
        grid_transfer_error(-3 * a, b, 640, 480),
        torch.stack([grid_transfer_error(x, y, 640, 480) for x, y in zip(a, b, strict=True)]),
    )
    assert grid_transfer_error(-7 * a, a, 640, 480).max() < 1e-9


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
    # the nearest rotation counts
    noisy = true.clone()
    noisy[:, :3, :3] += 1e-3 * random(50, 3, 3, seed=3)
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


@grid(("seed", range(4)))
def test_affine_gauge_absorbs_affinity_and_common_velocity(seed):
    scene = constant_velocity(10, batch=5, generator=seeded(seed))
    true = torch.stack(scene.motion, dim=-3)
    scale = random(5, 3, 1, 1, seed=seed)
    aligned, error = affine_gauge(scale * true @ gauge(5, seed), true)
    assert error.shape == (5,) and error.max() < 1e-11
    torch.testing.assert_close(aligned, true, rtol=0, atol=1e-11)
    noisy = true + 1e-3 * random(5, 3, 4, 4, seed=4)
    first, second = affine_gauge(noisy, true)[1], affine_gauge(noisy @ gauge(5, 8), true)[1]
    torch.testing.assert_close(first, second, rtol=1e-9, atol=0)
    assert first.max() < 0.02
    # x + t v in the gauge is an affine image of x + t v plus t times one velocity
    x, v = scene.extras["points"], scene.extras["velocities"]
    y = [apply(torch.linalg.inv(gauge(5, seed)[:, t]), x + t * v) for t in range(3)]
    torch.testing.assert_close(y[0] - 2 * y[1] + y[2], torch.zeros_like(x), rtol=0, atol=1e-9)


@pytest.mark.parametrize("wrong", ["acceleration", "affinity of one sensor", "projective world"])
def test_affine_gauge_does_not_absorb_more(wrong):
    true = torch.stack(constant_velocity(10, batch=5, generator=seeded(0)).motion, dim=-3)
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


def test_label_scores_against_counting():
    generator = seeded(0)
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
    absent = label_scores(torch.tensor([1, 1, 1]), torch.tensor([1, 1, 2]))
    assert absent.recall.tolist() == [1.0, 1.0, 0.0] and absent.precision.tolist() == [1.0, pytest.approx(2 / 3), 1.0]


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
        assert float(far[1]) == math.inf
        image = torch.eye(3, dtype=torch.float64).repeat(3, 1, 1)
        image[1] = failure
        assert grid_transfer_error(image, torch.eye(3, dtype=torch.float64), 640, 480).tolist() == [0.0, math.inf, 0.0]
    aligned, _ = affine_gauge(estimated[:, None].expand(3, 3, 4, 4), true[:, None].expand(3, 3, 4, 4))
    assert aligned.isfinite().all()


# Segmentations: the least error over all ways to name the bodies.


def least(labels, truth):
    """Over all one-to-one assignments of the bodies found, by trying every one; 0 stays 0."""
    size = max(*labels, *truth, 1)
    return min(
        sum((0, *names)[given] != true for given, true in zip(labels, truth, strict=True))
        for names in permutations(range(1, size + 1))
    ) / len(labels)


@grid((("found", "true"), [(2, 2), (3, 3), (5, 3), (3, 6), (1, 4), (4, 1), (1, 1)]))
def test_it_is_the_least_over_all_assignments(found, true):
    labels, truth = (
        torch.randint(0, found, (3, 4, 25), generator=seeded(1)),
        torch.randint(0, true, (3, 4, 25), generator=seeded(2)),
    )
    error = misclassification(labels, truth)
    assert error.shape == (3, 4) and error.dtype == torch.float64
    expected = [[least(a.tolist(), b.tolist()) for a, b in zip(*rows, strict=True)] for rows in zip(labels, truth, strict=True)]
    torch.testing.assert_close(error, torch.tensor(expected, dtype=torch.float64))
    # one problem by itself
    assert float(misclassification(labels[1, 2], truth[1, 2])) == pytest.approx(expected[1][2])


def test_names_of_bodies_do_not_matter_but_outliers_are_no_body():
    truth = torch.randint(0, 4, (60,), generator=seeded())
    assert float(misclassification(torch.tensor([0, 3, 1, 2])[truth], truth)) == 0
    swapped = torch.tensor([1, 0, 2, 3])[truth]
    assert float(misclassification(swapped, truth)) == pytest.approx(float((truth < 2).double().mean()))
    # numbers that are not used change nothing
    assert float(misclassification(7 * truth, truth)) == 0
    # empty batches and other integers
    assert misclassification(torch.zeros(0, 5, dtype=torch.long), torch.zeros(0, 5, dtype=torch.long)).shape == (0,)
    assert float(misclassification(torch.tensor([1, 1], dtype=torch.uint8), torch.tensor([2, 2]))) == 0


# Lifted reconstructions: blind to exactly what the lifts leave open, proportional to everything else.


def gauges(lifts, batch, seed=0, spread=1.0):
    """Random invertible elements of the algebra: near the identity for a small spread."""
    basis = gauge_algebra(lifts)
    eye = torch.eye(basis.shape[-1], dtype=torch.float64)
    mix = torch.einsum("bd,dij->bij", random(batch, len(basis), seed=seed), basis)
    return (1 if spread < 1 else 0) * eye + spread * mix


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("spread", [0.1, 1.0])
def test_errors_are_blind_to_the_gauge(motion, spread):
    scene = lifted_points(motion, 60, batch=6, generator=seeded(0))
    scale = random(6, 60, 1, seed=3)
    estimate = scale * (scene.structure @ gauges(scene.lifts, 6, spread=spread).mT)
    error = lifted_error(estimate, scene.structure, scene.lifts)
    assert error.position.shape == error.velocity.shape == (6,)
    # a random gauge itself costs digits
    assert error.position.max() < (1e-13 if spread < 1 else 1e-11) and error.position.median() < 1e-12
    assert error.velocity.max() < (1e-12 if spread < 1 else 1e-10)
    # nor does that of a noisy one; problem by problem
    noisy = scene.structure + 1e-3 * random(*scene.structure.shape)
    error = lifted_error(noisy, scene.structure, scene.lifts)
    alone = lifted_error(noisy[1], scene.structure[1], scene.lifts)
    other = lifted_error(noisy @ gauges(scene.lifts, 6, spread=spread).mT, scene.structure, scene.lifts)
    torch.testing.assert_close((error.position[1], error.velocity[1]), (alone.position, alone.velocity), rtol=1e-6, atol=0)
    torch.testing.assert_close((error.position, error.velocity), (other.position, other.velocity), rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize("motion", ["constant_velocity_2d", "constant_acceleration_2d", "constant_velocity_3d"])
@pytest.mark.parametrize("unit", [1e-3, 1e4])
def test_conditioning_does_not_matter(motion, unit):
    # other units of length, and times far from 0: a shift of time by 100 is a change of the lifted space
    near, far = ([start + s for s in (0.0, 1.0, 2.5, 4.0, 5.0)] for start in (0.0, 100.0))
    scene, later = (lifted_points(motion, 60, times=t, batch=5, generator=seeded(0)) for t in (near, far))
    shift = torch.linalg.lstsq(later.lifts.flatten(0, 1), scene.lifts.flatten(0, 1)).solution.round()
    torch.testing.assert_close(later.lifts @ shift, scene.lifts)
    structure = scene.structure.clone()
    structure[..., scene.points.shape[-1]] /= unit
    estimate = structure @ gauges(scene.lifts, 5).mT
    error = lifted_error(estimate @ shift.mT, structure @ shift.mT, later.lifts)
    # both structures are rounded after the change of the lifted space, which magnifies that by its condition number
    lost = 10 * torch.linalg.cond(shift) * torch.finfo(torch.float64).eps
    assert error.position.max() < max(1e-8, lost) and error.velocity.max() < max(1e-7, lost)


@pytest.mark.parametrize("motion", MOTIONS)
def test_errors_are_blind_to_nothing_else(motion):
    scene = lifted_points(motion, 60, generator=seeded(0))
    size = scene.structure.shape[-1]
    change = torch.eye(size, dtype=torch.float64) + 0.1 * random(20, size, size, seed=5)
    flat = gauge_algebra(scene.lifts).flatten(1)
    outside = change.flatten(1) - change.flatten(1) @ flat.mT @ flat
    error = lifted_error(scene.structure @ change.mT, scene.structure, scene.lifts)
    if len(flat) == size**2:
        assert error.position.max() < 1e-12
    else:
        assert outside.norm(dim=-1).min() > 0.05 and error.position.median() > 3e-3
    # in proportion to what is wrong
    small = lifted_error(scene.structure + 1e-7 * random(20, 60, size), scene.structure, scene.lifts)
    assert 1e-8 < small.position.median() < 1e-6


def test_position_error_is_that_of_the_best_affinity():
    # static planar points have the collineations as their gauge; constant velocity from many views the affinities
    scene = lifted_points("constant_velocity_2d", 400, 5, generator=seeded(0))
    noise = torch.cat([0.01 * random(400, 2), torch.zeros(400, 1), 0.004 * random(400, 2, seed=1)], dim=-1)
    estimate = (scene.structure + noise) @ gauges(scene.lifts, 1)[0].mT
    error = lifted_error(estimate, scene.structure, scene.lifts)
    away = (noise @ scene.lifts.mT)[..., :2].norm(dim=-1)
    placed = (scene.structure @ scene.lifts.mT)[..., :2]
    radius = (placed - placed.mean(1, keepdim=True)).square().sum(-1).mean().sqrt()
    assert float(error.position) == pytest.approx(float(away.median() / radius), rel=0.05)
    speed = scene.velocities.square().sum(-1).mean().sqrt()
    assert float(error.velocity) == pytest.approx(float(noise[:, 3:].norm(dim=-1).median() / speed), rel=0.05)


def test_gross_errors_and_failures():
    scene = lifted_points("constant_velocity_3d", 60, batch=4, generator=seeded(0))
    estimate = scene.structure @ gauges(scene.lifts, 4, spread=0.3).mT
    clean = lifted_error(estimate, scene.structure, scene.lifts)
    wrong = estimate.clone()
    wrong[:, :15] = random(4, 15, 7)
    wrong[1, 20] = torch.nan
    error = lifted_error(wrong, scene.structure, scene.lifts)
    assert error.position.max() < 1e-11
    # only the masked ones count, alone or together
    mask = torch.arange(60) >= 15
    assert lifted_error(wrong, scene.structure, scene.lifts, mask).position.max() < 1e-11
    some = lifted_error(estimate[:, mask], scene.structure[:, mask], scene.lifts)
    torch.testing.assert_close(lifted_error(estimate, scene.structure, scene.lifts, mask), some, rtol=0, atol=1e-12)
    failed = estimate.clone()
    failed[2] = torch.nan
    failed[3] = 0.0
    error = lifted_error(failed, scene.structure, scene.lifts)
    assert error.position[2:].tolist() == error.velocity[2:].tolist() == [torch.inf] * 2
    torch.testing.assert_close(error.position[:2], clean.position[:2], rtol=0, atol=1e-12)


@pytest.mark.parametrize("motion", ["two_bodies_2d", "two_bodies_3d"])
def test_body_error_is_blind_to_one_affinity_per_body(motion):
    scene = lifted_points(motion, 60, batch=4, outliers=0.1, generator=seeded(0))
    d = scene.points.shape[-1]
    maps, shifts = 1e3 * random(4, 3, d, d), 1e5 * random(4, 3, 1, d, seed=1)
    body = scene.labels[..., None, None]
    each = [scene.points @ maps[:, b].mT + shifts[:, b] for b in range(3)]
    moved = torch.where(body[..., 0] == 1, each[1], torch.where(body[..., 0] == 2, each[2], each[0]))
    error = body_error(moved, scene.points, scene.labels)
    assert error.shape == (4, 2) and error.max() < 1e-11
    # one affinity for both is not enough to hide that the bodies were swapped
    assert body_error(moved, scene.points, 1 + (torch.arange(60) % 2).expand(4, 60)).median() > 0.05


def test_body_error_of_known_noise_and_of_failures():
    x, noise = random(3, 1000, 3), 0.01 * random(3, 1000, 3, seed=1)
    labels = 1 + (torch.arange(1000) % 2).expand(3, 1000)
    noise[:, ::10] *= 1e4
    error = body_error(x + noise, x, labels)
    for b in range(2):
        inside = slice(b, None, 2)
        expected = (
            noise[:, inside].norm(dim=-1).median(dim=-1).values
            / (x - x.mean(1, keepdim=True))[:, inside].square().sum(-1).mean(-1).sqrt()
        )
        torch.testing.assert_close(error[:, b], expected, rtol=0.05, atol=0)
    failed = x.clone()
    failed[1] = torch.nan
    failed[2, 7] = torch.nan
    error = body_error(failed, x, labels)
    assert error[1].tolist() == [torch.inf] * 2 and error[[0, 2]].max() < 1e-12


LABELS = torch.tensor([0, 1])


def test_misuse_is_named():
    assert_refused(
        (lambda: relative_error(random(3, 3), random(4, 4)), "one shape"),
        (lambda: grid_transfer_error(torch.eye(3), torch.eye(3), 640, 480, count=1), "count must be >= 2"),
        (lambda: rotation_error(torch.eye(3), torch.eye(3)), "rigid motion"),
        (lambda: affine_gauge(random(2, 4, 4), random(2, 4, 4)), "sensors must be"),
        (lambda: label_scores(torch.zeros(3), torch.zeros(4)), "one shape"),
        (lambda: misclassification(LABELS, torch.tensor([0, 1, 2])), "one shape"),
        (lambda: misclassification(LABELS[:0], LABELS[:0]), "n >= 1"),
        (lambda: misclassification(LABELS.float(), LABELS), "labels must be integers"),
        (lambda: misclassification(LABELS, -LABELS), "truth must not be negative"),
        (lambda: lifted_error(torch.ones(5, 4), torch.ones(5, 4), torch.eye(3).expand(2, 3, 3)), "for these lifts"),
        (lambda: body_error(torch.ones(5, 2), torch.ones(5, 3), torch.ones(5)), "points and true"),
    )
