"""Straight trajectories against the truth: five and more views, four views, static points, missing views, noise, the tensor."""

import math

import pytest
import torch

from dyntorch import TrajectoryOptions
from dyntorch.core.outcome import Status
from dyntorch.geometry.extensors import plucker
from dyntorch.geometry.homogeneous import apply, homogeneous, inhomogeneous
from dyntorch.scenes.scene import calibration, looking_at
from dyntorch.tasks.trajectories.trajectories import LineStatus, points_on_lines, trajectory_cameras, triangulate_trajectories
from tests.draws import seeded


def scene(views, n, batch=(), *, sigma=0.0, centres=None, seed=0):
    """Cameras at 5 units around points that jump along lines: cameras, images, points ``(*batch, views, n, 3)`` and lines."""
    g = seeded(seed)

    def random(*shape):
        return torch.randn(*batch, *shape, generator=g, dtype=torch.float64)

    def normalize(v):
        return torch.nn.functional.normalize(v, dim=-1)

    c = 5 * normalize(random(views, 3))
    c = c if centres is None else c[..., torch.arange(views) % centres, :]
    up = torch.tensor([0.1, 0.2, 1.0]).double().expand_as(c)
    cameras = calibration(torch.tensor(1300.0).double(), 500.0) @ looking_at(c, torch.zeros_like(c), up)
    start, heading = 0.6 * random(n, 3), normalize(random(n, 3))
    place = 2 * torch.rand(*batch, views, n, 1, generator=g, dtype=torch.float64) - 1
    points = start[..., None, :, :] + place * heading[..., None, :, :]
    x = apply(cameras, points) + sigma * random(views, n, 2)
    return cameras, x, points, normalize(plucker(torch.stack([start, start + heading], dim=-2)))


def still(cameras, x, points, count):
    """The same with the first points at rest."""
    points = points.clone()
    points[..., :count, :] = points[..., :1, :count, :]
    return torch.cat([apply(cameras, points)[..., :count, :], x[..., count:, :]], dim=-2), points


def gap(lines, truth):
    return (1 - (lines * truth).sum(-1).abs()).max()


@pytest.mark.parametrize("views", [5, 6, 8])
def test_lines_points_and_static_points_are_exact(views):
    cameras, x, points, lines = scene(views, 60)
    x, points = still(cameras, x, points, 10)
    found = triangulate_trajectories(cameras, x)
    assert found.kinds.tolist() == [LineStatus.STATIC] * 10 + [LineStatus.OK] * 50
    assert gap(found.lines[10:], lines[10:]) < 1e-13
    assert not found.lines[:10].any()
    assert not found.second.any()
    torch.testing.assert_close(found.points, points, rtol=0, atol=1e-9)
    assert found.residual.max() < 1e-9


def test_four_views_have_two_lines_and_one_is_true():
    cameras, x, points, lines = scene(4, 60)
    x, points = still(cameras, x, points, 10)
    found = triangulate_trajectories(cameras, x)
    assert found.kinds.tolist() == [LineStatus.STATIC] * 10 + [LineStatus.TWO_FOLD] * 50
    either = torch.stack([found.lines, found.second])
    first = (either * lines).sum(-1).abs().argmax(0)[10:]
    assert 0 < first.double().mean() < 1
    assert gap(either[first, torch.arange(10, 60)], lines[10:]) < 1e-9
    assert found.residual.max() < 1e-8  # the wrong ones fulfil all views as well
    other = points_on_lines(cameras, x, found.second)
    error = torch.stack([found.points, other])[first, :, torch.arange(10, 60)] - points[:, 10:].transpose(0, 1)
    assert error.abs().max() < 1e-7


@pytest.mark.parametrize("centres", [2, 3])
def test_static_cameras_need_not_be_many(centres):
    # two centres: the rows have rank 4, and the second line in their null space joins the centres
    cameras, x, points, lines = scene(8, 40, centres=centres)
    found = triangulate_trajectories(cameras, x)
    assert not found.kinds.any()
    assert gap(found.lines, lines) < 1e-12
    torch.testing.assert_close(found.points, points, rtol=0, atol=1e-8)
    alone = triangulate_trajectories(cameras[:1].expand(8, 3, 4), apply(cameras[:1].expand(8, 3, 4), points))
    assert (alone.kinds == LineStatus.AMBIGUOUS).all()  # one centre: all lines of a plane


@pytest.mark.slow
def test_noise_is_estimated_and_the_uncertainty_is_honest():
    cameras, x, points, lines = scene(8, 100, (5,), sigma=0.5)
    found = triangulate_trajectories(cameras, x)
    assert not found.kinds.any()
    torch.testing.assert_close(found.sigma, torch.full((5,), 0.5).double(), rtol=0.15, atol=0)
    assert (1 - (found.lines * lines).sum(-1).abs()).median() < 1e-5
    assert (found.points - points).norm(dim=-1).median() < 0.005
    told = triangulate_trajectories(cameras, x, sigma=0.5)
    torch.testing.assert_close(told.lines, found.lines)
    x, _ = still(cameras, x, points, 30)
    resting = x[..., :30, :] + 0.5 * torch.randn(5, 8, 30, 2, generator=seeded(1), dtype=torch.float64)
    kinds = triangulate_trajectories(cameras, resting, sigma=0.5).kinds
    assert (kinds == LineStatus.STATIC).double().mean() > 0.98


@pytest.mark.slow
@pytest.mark.parametrize("sigma", [0.5, None])
def test_noise_makes_one_problem_in_a_thousand_a_misfit(sigma):
    cameras, x, _, _ = scene(7, 12, (1000,), sigma=0.5)
    found = triangulate_trajectories(cameras, x, sigma=sigma)
    # 5 or more of 1000 at a rate of 1: 4 in 1000
    assert (found.kinds == LineStatus.MISFIT).any(-1).sum() < 5
    assert (found.kinds == LineStatus.OK).double().mean() > 0.98


@pytest.mark.parametrize("sigma", [0.5, None])
def test_curved_paths_and_wrong_sightings_are_no_lines(sigma):
    cameras, x, points, _ = scene(9, 40, (5,), sigma=0.5)
    angle = 0.6 * torch.arange(9).double()
    circle = torch.stack([angle.cos(), angle.sin(), 0.3 * (2 * angle).sin()], dim=-1)[:, None]
    x = x.clone()
    x[..., :4, :] = apply(cameras, (points[..., :1, :4, :] + circle))
    x[..., 4, 4:8, :] += 60.0
    found = triangulate_trajectories(cameras, x, sigma=sigma)
    assert (found.kinds[..., :8] == LineStatus.MISFIT).double().mean() > 0.9
    # what a path does along the line of sight, and a shift along an image line, shows in no residual
    assert (found.status[..., :8] == Status.OK).double().mean() < 0.1 and (
        found.kinds[..., 8:] == LineStatus.OK
    ).double().mean() > 0.95
    with pytest.raises(ValueError, match=r"NO_CONSENSUS.*curved paths"):
        found.check()


def test_refinement_is_a_minimum_and_options_decide():
    cameras, x, _, _ = scene(6, 20, sigma=0.5)
    found = triangulate_trajectories(cameras, x)

    def cost(lines):
        image = torch.einsum("vni,vij->vnj", homogeneous(points_on_lines(cameras, x, lines)), cameras.mT)
        return (inhomogeneous(image) - x).square().sum((0, -1))

    torch.testing.assert_close((cost(found.lines) / 6).sqrt(), found.residual)
    g = seeded(3)
    ends = found.points[[0, -1]].movedim(0, 1)  # two points of each line
    for _ in range(50):
        moved = ends + 1e-4 * torch.randn(ends.shape, generator=g, dtype=torch.float64)
        assert (cost(plucker(moved)) >= cost(found.lines) * (1 - 1e-9)).all()
    assert (found.status == LineStatus.OK).any()
    strict = triangulate_trajectories(cameras, x, options=TrajectoryOptions(max_uncertainty=0.0))
    assert (strict.status == LineStatus.AMBIGUOUS).all()
    lax = triangulate_trajectories(cameras, x, options=TrajectoryOptions(max_static_sigmas=1e6))
    assert (lax.status == LineStatus.STATIC).all()


def test_gradients_and_changes_of_the_world_commute():
    cameras, x, _, _ = scene(6, 20, sigma=0.5)
    T = torch.eye(4).double() + 0.05 * torch.randn(4, 4, generator=seeded(4), dtype=torch.float64)
    shift = torch.tensor([[0.0, -2.0, 10.0], [2.0, 0.0, -30.0], [0.0, 0.0, 1.0]]).double()  # a similarity of scale 2
    one, two = triangulate_trajectories(cameras, x), triangulate_trajectories(shift @ cameras @ T, apply(shift.expand(6, 3, 3), x))
    torch.testing.assert_close(apply(T.expand(6, 4, 4), two.points), one.points, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(two.residual, 2 * one.residual, rtol=1e-6, atol=1e-8)
    cameras, x, _, _ = scene(6, 2, sigma=0.5)
    w = torch.randn(6, 2, 3, generator=seeded(5), dtype=torch.float64)

    def value(x):
        return (triangulate_trajectories(cameras, x, sigma=0.5).points * w).sum()

    x = x.requires_grad_()
    (gradient,) = torch.autograd.grad(value(x), x)
    for index in ((0, 0, 0), (3, 1, 1), (5, 0, 1)):
        step = torch.zeros_like(x)
        step[index] = 1e-2
        numeric = (value(x + step) - value(x - step)) / 2e-2
        torch.testing.assert_close(gradient[index], numeric.detach(), rtol=1e-5, atol=1e-9)


def tensors(result):
    return {name: value for name, value in vars(result).items() if isinstance(value, torch.Tensor)}


def test_missing_views_weights_batches_and_failures():
    cameras, x, _, _ = scene(8, 12, (2, 3), sigma=0.2)
    x = x.clone()
    x[..., :2, 0, :] = torch.nan
    x[..., :5, 1, :] = torch.nan
    weights = torch.ones(2, 3, 8, 12).double()
    weights[..., 6:, 2] = 0
    cameras = cameras.clone()
    cameras[0, 0, 7] = torch.nan
    found = triangulate_trajectories(cameras, x, weights, sigma=0.2)
    assert (found.kinds[..., 1] == LineStatus.TOO_FEW).all()
    assert (found.kinds[0, 1:, [0, *range(2, 12)]] == LineStatus.OK).all()
    for name, value in tensors(found).items():
        assert value.isfinite().all(), name
    assert not found.points[..., :2, 0, :].any()
    assert not found.points[0, 0, 7].any()
    for i, j in ((0, 0), (1, 2)):
        one = triangulate_trajectories(cameras[i, j], x[i, j], weights[i, j], sigma=0.2)
        for name, value in tensors(one).items():
            torch.testing.assert_close(value, vars(found)[name][i, j], rtol=1e-7, atol=1e-9)
    without = triangulate_trajectories(cameras[1, 2, :6], x[1, 2, :6, 2:3], sigma=0.2)
    torch.testing.assert_close(without.points, found.points[1, 2, :6, 2:3], rtol=1e-5, atol=1e-6)
    assert triangulate_trajectories(cameras[1, 1].float(), x[1, 1].float()).lines.dtype == torch.float32


SIX = torch.zeros(6, 10, 2)


@pytest.mark.parametrize(
    ("verb", "change", "message"),
    [
        (triangulate_trajectories, {"cameras": torch.zeros(5, 4, 3)}, "cameras must be"),
        (triangulate_trajectories, {"x": torch.zeros(6, 2, 2)}, r"x must be \(\*batch, views, n, 2\)"),
        (triangulate_trajectories, {"cameras": torch.zeros(3, 3, 4), "x": torch.zeros(3, 2, 2)}, "4 or more views, got 3"),
        (triangulate_trajectories, {"weights": torch.ones(5)}, "weights must be"),
        (triangulate_trajectories, {"weights": -torch.ones(5, 2)}, "must not be negative, got -1"),
        *(
            (triangulate_trajectories, {"sigma": bad}, "sigma must be .* None estimates it")
            for bad in (0.0, -1.0, "wide", math.nan)
        ),
        *(
            (triangulate_trajectories, {"x": bad}, "x must be .*got")
            for bad in ([[1.0]], None, "x", SIX.cfloat(), SIX.int(), SIX.bool())
        ),
        (triangulate_trajectories, {"cameras": None}, r"cameras must be a torch.Tensor, got NoneType; use torch.as_tensor"),
        (triangulate_trajectories, {"x": torch.zeros(5, 0, 2)}, r"x must hold a point at least, got \(5, 0, 2\)"),
        (triangulate_trajectories, {"weights": [1.0]}, r"weights must be a tensor .*got \[1.0\]"),
        (trajectory_cameras, {"x": SIX[:5]}, r"x must be \(\*batch, 6, n, 2\), got \(5, 10, 2\)"),
        (
            trajectory_cameras,
            {"x": SIX, "weights": torch.ones(6, 10)},
            r"weights must be .* = \(10,\), one per point, got \(6, 10\)",
        ),
        (trajectory_cameras, {"x": SIX, "options": {}}, r"options must be TrajectoryOptions, got \{\}; use dataclasses\.replace"),
    ],
)
def test_misuse(verb, change, message):
    given = {"cameras": torch.zeros(5, 3, 4), "x": torch.zeros(5, 2, 2)} if verb is triangulate_trajectories else {}
    with pytest.raises(ValueError, match=message):
        verb(**given | change)


def collineation(points, truth):
    """Reference: the collineation of space that takes points to the truth, by the cross products of all pairs of coordinates."""
    p, q = homogeneous(points.reshape(-1, 3)), homogeneous(truth.reshape(-1, 3))
    p = p / p.norm(dim=-1, keepdim=True)
    rows = [
        torch.einsum("ni,nj->nij", (q[:, a, None] * torch.eye(4)[b] - q[:, b, None] * torch.eye(4)[a]).double(), p).flatten(1)
        for a in range(4)
        for b in range(a)
    ]
    return torch.linalg.svd(torch.cat(rows), full_matrices=False).Vh[-1].view(4, 4)


@pytest.mark.slow
def test_six_uncalibrated_views_from_728_trajectories():
    _, x, points, _ = scene(6, 728)
    linear = trajectory_cameras(x, bundle=False)
    assert int(linear.status) == 0
    assert not linear.trajectories.kinds.any()
    assert linear.trajectories.residual.max() < 1e-6
    found = inhomogeneous(
        homogeneous(linear.trajectories.points) @ collineation(linear.trajectories.points[:, ::10], points[:, ::10]).mT
    )
    assert (found - points).abs().max() < 1e-7


@pytest.mark.slow
def test_bundle_adjustment_reaches_the_noise():
    _, x, _, _ = scene(6, 1000, sigma=0.05)
    best = trajectory_cameras(x)
    assert best.trajectories.residual.median() < 0.05
    torch.testing.assert_close(best.trajectories.sigma, torch.tensor(0.05).double(), rtol=0.2, atol=0)
