"""Errors of lifted reconstructions: blind to exactly what the lifts leave open, proportional to everything else."""

import pytest
import torch

from dyntorch.geometry.lift import gauge_algebra
from dyntorch.metrics import body_error, lifted_error
from dyntorch.scenes import lifted

DIMENSIONS = {
    "constant_direction_2d": 9,
    "constant_velocity_2d": 9,
    "constant_acceleration_2d": 11,
    "constant_direction_3d": 16,
    "constant_velocity_planes_3d": 16,
    "constant_velocity_3d": 16,
    "constant_velocity_3d_sensors": 16,
    "static_2d": 9,
    "static_3d": 16,
}


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def random(*shape, seed=0):
    return torch.randn(*shape, generator=seeded(seed), dtype=torch.float64)


def gauges(lifts, batch, seed=0, spread=1.0):
    """Random invertible elements of the algebra: near the identity for a small spread."""
    basis = gauge_algebra(lifts)
    eye = torch.eye(basis.shape[-1], dtype=torch.float64)
    mix = torch.einsum("bd,dij->bij", random(batch, len(basis), seed=seed), basis)
    return (1 if spread < 1 else 0) * eye + spread * mix


@pytest.mark.parametrize("motion", DIMENSIONS)
@pytest.mark.parametrize("times", [None, [0.0, 1.0, 2.5, 3.0, 7.0], [1000.0, 1001.0, 1002.0, 1004.0, 1005.0]])
def test_dimensions_of_the_algebra_are_those_of_the_theory(motion, times):
    scene = lifted(motion, 5, times=times, generator=seeded())
    basis = gauge_algebra(scene.lifts)
    assert len(basis) == DIMENSIONS[motion]
    torch.testing.assert_close(basis.flatten(1) @ basis.flatten(1).mT, torch.eye(len(basis), dtype=torch.float64))
    for lift in scene.lifts:
        null = torch.linalg.svd(lift).Vh[lift.shape[0] :].mT
        assert ((lift / lift.norm()) @ basis @ null).abs().amax() < 1e-10 if null.shape[-1] else True


def test_an_algebra_is_closed_and_contains_a_common_velocity():
    lifts = lifted("constant_velocity_2d", 5, 4, generator=seeded()).lifts
    basis = gauge_algebra(lifts)
    products = (basis[:, None] @ basis).flatten(0, 1).flatten(1)
    flat = basis.flatten(1)
    torch.testing.assert_close(products @ flat.mT @ flat, products)
    common = torch.zeros(5, 5, dtype=torch.float64)
    common[3, 2] = 1.0
    torch.testing.assert_close((flat @ common.flatten()) @ flat, common.flatten())


def test_fewer_views_leave_more_open():
    for motion, views, expected in (("constant_velocity_planes_3d", 3, 16), ("constant_direction_3d", 2, 17)):
        assert len(gauge_algebra(lifted(motion, 5, views, generator=seeded()).lifts)) == expected


@pytest.mark.parametrize("motion", DIMENSIONS)
@pytest.mark.parametrize("spread", [0.1, 1.0])
def test_errors_are_blind_to_the_gauge(motion, spread):
    scene = lifted(motion, 60, batch=6, generator=seeded())
    scale = random(6, 60, 1, seed=3)
    estimate = scale * (scene.structure @ gauges(scene.lifts, 6, spread=spread).mT)
    error = lifted_error(estimate, scene.structure, scene.lifts)
    assert error.position.shape == error.velocity.shape == (6,)
    # a random gauge itself costs digits
    assert error.position.max() < (1e-13 if spread < 1 else 1e-11) and error.position.median() < 1e-12
    assert error.velocity.max() < (1e-12 if spread < 1 else 1e-10)


@pytest.mark.parametrize("motion", ["constant_velocity_2d", "constant_acceleration_2d", "constant_velocity_3d"])
@pytest.mark.parametrize("unit", [1e-3, 1e4])
def test_conditioning_does_not_matter(motion, unit):
    # other units of length, and times far from 0: a shift of time by 100 is a change of the lifted space
    near, far = ([start + s for s in (0.0, 1.0, 2.5, 4.0, 5.0)] for start in (0.0, 100.0))
    scene, later = (lifted(motion, 60, times=t, batch=5, generator=seeded()) for t in (near, far))
    shift = torch.linalg.lstsq(later.lifts.flatten(0, 1), scene.lifts.flatten(0, 1)).solution.round()
    torch.testing.assert_close(later.lifts @ shift, scene.lifts)
    structure = scene.structure.clone()
    structure[..., scene.points.shape[-1]] /= unit
    estimate = structure @ gauges(scene.lifts, 5).mT
    error = lifted_error(estimate @ shift.mT, structure @ shift.mT, later.lifts)
    # both structures are rounded after the change of the lifted space, which magnifies that by its condition number
    lost = 10 * torch.linalg.cond(shift) * torch.finfo(torch.float64).eps
    assert error.position.max() < max(1e-8, lost) and error.velocity.max() < max(1e-7, lost)


@pytest.mark.parametrize("motion", DIMENSIONS)
def test_errors_are_blind_to_nothing_else(motion):
    scene = lifted(motion, 60, generator=seeded())
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
    scene = lifted("constant_velocity_2d", 400, 5, generator=seeded())
    noise = torch.cat([0.01 * random(400, 2), torch.zeros(400, 1), 0.004 * random(400, 2, seed=1)], dim=-1)
    estimate = (scene.structure + noise) @ gauges(scene.lifts, 1)[0].mT
    error = lifted_error(estimate, scene.structure, scene.lifts)
    away = (noise @ scene.lifts.mT)[..., :2].norm(dim=-1)
    placed = (scene.structure @ scene.lifts.mT)[..., :2]
    radius = (placed - placed.mean(1, keepdim=True)).square().sum(-1).mean().sqrt()
    assert float(error.position) == pytest.approx(float(away.median() / radius), rel=0.05)
    speed = scene.velocities.square().sum(-1).mean().sqrt()
    assert float(error.velocity) == pytest.approx(float(noise[:, 3:].norm(dim=-1).median() / speed), rel=0.05)


@pytest.mark.parametrize("motion", ["constant_velocity_2d", "constant_direction_3d", "constant_velocity_3d"])
def test_the_gauge_of_a_noisy_estimate_does_not_matter(motion):
    scene = lifted(motion, 60, 5, batch=5, generator=seeded())
    noisy = scene.structure + 1e-3 * random(*scene.structure.shape)
    first = lifted_error(noisy, scene.structure, scene.lifts)
    second = lifted_error(noisy @ gauges(scene.lifts, 5).mT, scene.structure, scene.lifts)
    torch.testing.assert_close(first.position, second.position, rtol=1e-4, atol=0)
    torch.testing.assert_close(first.velocity, second.velocity, rtol=1e-4, atol=0)


def test_gross_errors_and_failures():
    scene = lifted("constant_velocity_3d", 60, batch=4, generator=seeded())
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


def test_batch_is_the_loop():
    scene = lifted("constant_direction_3d", 40, 4, batch=(2, 3), generator=seeded())
    noisy = scene.structure + 1e-2 * random(*scene.structure.shape)
    error = lifted_error(noisy, scene.structure, scene.lifts)
    for i in range(2):
        for j in range(3):
            single = lifted_error(noisy[i, j], scene.structure[i, j], scene.lifts)
            torch.testing.assert_close(error.position[i, j], single.position, rtol=1e-6, atol=0)
            torch.testing.assert_close(error.velocity[i, j], single.velocity, rtol=1e-6, atol=0)


@pytest.mark.parametrize("motion", ["two_bodies_2d", "two_bodies_3d"])
def test_body_error_is_blind_to_one_affinity_per_body(motion):
    scene = lifted(motion, 60, batch=4, outliers=0.1, generator=seeded())
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
    assert body_error(x, x, labels, bodies=3)[:, 2].tolist() == [torch.inf] * 3


def test_misuse_is_named():
    eye = torch.eye(3).expand(2, 3, 3)
    with pytest.raises(ValueError, match="lifts must be"):
        gauge_algebra(torch.eye(3)[:, :2].expand(2, 3, 2))
    with pytest.raises(ValueError, match="for these lifts"):
        lifted_error(torch.ones(5, 4), torch.ones(5, 4), eye)
    with pytest.raises(ValueError, match="points and true"):
        body_error(torch.ones(5, 2), torch.ones(5, 3), torch.ones(5))
