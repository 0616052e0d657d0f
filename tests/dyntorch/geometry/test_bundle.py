"""Bundle adjustment against autograd, dense normal equations and the noise-free scene."""

from __future__ import annotations

import pytest
import torch

from dyntorch.geometry.bundle import BundleProblem, bundle_adjust, point_information
from dyntorch.geometry.triangulation import reproject
from dyntorch.numerics.least_squares import Iterate
from dyntorch.scenes import lifted_points
from tests.grid import assert_refused


def lift(dim, moving, views):
    """B_i = [I | t e_1, ..., t e_moving]."""
    lifts = torch.zeros(views, dim + 1, dim + 1 + moving, dtype=torch.float64)
    lifts[:, :, : dim + 1] = torch.eye(dim + 1)
    for e in range(moving):
        lifts[:, e, dim + 1 + e] = torch.arange(views)
    return lifts


CASES = {  # lifts or k, l, views, points
    "plane, constant velocity": (lift(2, 2, 3), 2, 3, 24),
    "space, constant velocity": (lift(3, 3, 5), 2, 5, 40),
    "static": (3, 2, 3, 16),
    "3D sensors": (lift(3, 3, 3), 3, 3, 30),
}


def scene(name, batch=(), noise=0.0, off=0.01, seed=0):
    """Images, a start, and the lifts."""
    lifts, size_x, views, n = CASES[name]
    size, width = (lifts + 1, lifts + 1) if isinstance(lifts, int) else lifts.shape[-2:]
    lifts = None if isinstance(lifts, int) else lifts
    g = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*batch, *shape, generator=g, dtype=torch.float64)

    cameras, structure = normal(views, size_x + 1, size), normal(n, width) / 3
    cameras[..., -1, :] /= 6
    cameras[..., -1, -1] = 2.0
    structure[..., size - 1] = 1.0
    x = reproject(cameras if lifts is None else cameras @ lifts, structure)
    x = x + noise * normal(*x.shape[len(batch) :])
    cameras, structure = cameras / cameras.norm(dim=(-2, -1), keepdim=True), structure / structure.norm(dim=-1, keepdim=True)
    return x, cameras + off * normal(views, size_x + 1, size), structure + off * normal(n, width), lifts


def errors(x, cameras, structure, lifts):
    return reproject(cameras if lifts is None else cameras @ lifts, structure) - x


@pytest.mark.parametrize("name", CASES)
def test_without_noise_every_start_nearby_leads_to_the_images(name):
    x, cameras, structure, lifts = scene(name, (4,))
    found = bundle_adjust(x, None, cameras, structure, lifts)
    assert errors(x, found.cameras, found.structure, lifts).abs().max() < 1e-10
    assert (found.cost < 1e-20).all() and (found.iterations < 50).all()
    torch.testing.assert_close(found.structure.norm(dim=-1), torch.ones_like(found.structure[..., 0]))
    torch.testing.assert_close(found.cameras.norm(dim=(-2, -1)), torch.ones_like(found.cameras[..., 0, 0]))


@pytest.mark.parametrize("name", CASES)
def test_the_gradient_of_the_cost_vanishes(name):
    x, cameras, structure, lifts = scene(name, noise=0.005)
    weights = torch.rand(x.shape[:-1], generator=torch.Generator().manual_seed(1), dtype=torch.float64) + 0.5
    found = bundle_adjust(x, weights, cameras, structure, lifts, tolerance=1e-14)
    at = [t.clone().requires_grad_() for t in (found.cameras, found.structure)]
    cost = (errors(x, *at, lifts).square().sum(-1) * weights).sum()
    torch.testing.assert_close(cost.detach(), found.cost)
    cost.backward()
    assert max(float(t.grad.abs().max()) for t in at) < 1e-5 * cost.sqrt()


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("robust", [True, False])
def test_a_step_solves_the_dense_damped_equations(name, robust):
    """The Schur complement against the whole normal equations; the gradient of the robust cost by autograd."""
    x, cameras, structure, lifts = scene(name, (1,), noise=0.05)
    structure = structure / structure.norm(dim=-1, keepdim=True)
    weights = torch.rand(x.shape[:-1], generator=torch.Generator().manual_seed(1), dtype=torch.float64) + 0.5
    weights[:, 0, 3] = 0
    scale = torch.tensor([0.05]).double() if robust else None
    problem = BundleProblem(x.mT, weights, None if lifts is None else lifts[None], scale)
    at = Iterate((cameras, structure.mT.contiguous()), torch.zeros(1).double(), ())
    camera_step, point_step, gain = problem.step(at, torch.tensor([0.1]).double())
    split, theta = cameras.numel(), torch.cat([cameras.flatten(), structure.flatten()])
    root = problem.robust(reproject(cameras if lifts is None else cameras @ lifts, structure).mT)[1].sqrt()[..., None]

    def parts(t):
        return t[:split].view_as(cameras), t[split:].view_as(structure)

    jacobian = torch.func.jacfwd(lambda t: (errors(x, *parts(t), lifts) * root).flatten())(theta)
    gradient = torch.func.grad(lambda t: problem.costs(parts(t)[0], parts(t)[1].mT).sum() / 2)(theta)
    matrix = jacobian.T @ jacobian
    model = matrix.clone()
    # what is damped: the diagonals of the point blocks, then that of the Schur complement; the points stay on the sphere
    points = matrix[split:, split:]
    held = torch.block_diag(
        *(y[:, None] * y * points.diagonal().view_as(structure[0])[j].sum() for j, y in enumerate(structure[0]))
    )
    points += held + 0.1 * torch.diag(points.diagonal())
    schur = matrix[:split, :split] - matrix[:split, split:] @ torch.linalg.solve(points, matrix[split:, :split])
    floor = 0.1 * (schur.diagonal() + 1e-9 * schur.diagonal().max())
    matrix[:split, :split] += torch.diag(floor)
    expected = torch.linalg.solve(matrix, gradient)
    torch.testing.assert_close(torch.cat([camera_step.flatten(), point_step.mT.flatten()]), expected, rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(gain[0], 2 * gradient @ expected - expected @ model @ expected)


@pytest.mark.slow
def test_outliers_do_not_move_the_robust_minimum():
    x, cameras, structure, lifts = scene("static", noise=1e-3)
    clean = bundle_adjust(x, None, cameras, structure)
    x[0, 0] += 3.0
    plain = bundle_adjust(x, None, cameras, structure)
    robust = bundle_adjust(x, None, clean.cameras, clean.structure, scale=5e-3, tolerance=1e-13, iterations=300)
    good = errors(x, robust.cameras, robust.structure, lifts)[:, 1:].abs().max()
    assert good < 0.2 * errors(x, plain.cameras, plain.structure, lifts)[:, 1:].abs().max()
    at = [t.clone().requires_grad_() for t in (robust.cameras, robust.structure)]
    square = errors(x, *at, lifts).square().sum(-1)
    c = 5e-3
    rho = c * c * square / (c * c + square)
    torch.testing.assert_close(rho.sum().detach(), robust.cost)
    rho.sum().backward()
    assert max(float(t.grad.abs().max()) for t in at) < 1e-5


def test_missing_images_are_like_absent_ones():
    x, cameras, structure, lifts = scene("space, constant velocity", noise=0.005)
    weights = torch.ones(x.shape[:-1], dtype=torch.float64)
    weights[1, :6] = 0
    holes = x.clone()
    holes[2, 6:9] = torch.nan
    structure[3], holes[:3, 3] = 0.0, torch.nan  # unknown, and seen in two views only
    weights[:3, 4] = 0  # seen in two views only
    found = bundle_adjust(holes, weights, cameras, structure, lifts, tolerance=1e-13)
    assert (found.structure[3] == 0).all() and (found.structure[4] == structure[4]).all()
    keep = [j for j in range(len(structure)) if j not in (3, 4)]
    mask = weights * holes.isfinite().all(-1)
    other = bundle_adjust(x[:, keep], mask[:, keep], cameras, structure[keep], lifts, tolerance=1e-13)
    torch.testing.assert_close(found.cost, other.cost, rtol=1e-9, atol=0)
    torch.testing.assert_close(found.structure[keep], other.structure, rtol=1e-5, atol=1e-5)


def test_a_view_without_images_stays():
    x, cameras, structure, lifts = scene("static", noise=0.005)
    x, cameras = torch.cat([x, x[:1]]), torch.cat([cameras, 7 * cameras[:1]])
    x[-1], cameras[-1, 0, 0] = torch.nan, torch.inf
    found = bundle_adjust(x, None, cameras, structure, lifts)
    assert (found.cameras[-1] == cameras[-1].nan_to_num(posinf=0.0)).all()  # 0 where it was not finite
    torch.testing.assert_close(found.cost, bundle_adjust(x[:-1], None, cameras[:-1], structure, lifts).cost)


def test_batch_is_loop_and_a_bad_start_is_kept():
    x, cameras, structure, lifts = scene("plane, constant velocity", (2, 3), noise=0.005)
    cameras[0, 1, 0, 0, 0], structure[1, 2, 5, 0] = torch.nan, torch.inf
    scale = torch.tensor([[0.01, 0.02, 0.03], [0.04, 0.05, 0.06]])
    found = bundle_adjust(x, None, cameras, structure, lifts.expand(2, 3, *lifts.shape), scale=scale)
    assert found.cost.isinf().tolist() == [[False, True, False], [False, False, True]]
    for i in range(2):
        for j in range(3):
            one = bundle_adjust(x[i, j], None, cameras[i, j], structure[i, j], lifts, scale=float(scale[i, j]))
            torch.testing.assert_close(found.cost[i, j], one.cost, rtol=1e-6, atol=0)
            torch.testing.assert_close(found.cameras[i, j], one.cameras, rtol=1e-4, atol=1e-5)
    assert torch.equal(found.structure[1, 2], structure[1, 2].nan_to_num(posinf=0.0))
    assert torch.equal(found.cameras[0, 1], cameras[0, 1].nan_to_num())


def test_the_cost_never_rises_and_no_step_is_the_start():
    x, cameras, structure, lifts = scene("plane, constant velocity", (20,), noise=0.01, off=0.3)
    before = bundle_adjust(x, None, cameras, structure, lifts, iterations=0)
    torch.testing.assert_close(before.cost, errors(x, cameras, structure, lifts).square().sum((-1, -2, -3)))
    for iterations in (1, 3, 10):
        after = bundle_adjust(x, None, cameras, structure, lifts, iterations=iterations)
        assert (after.cost <= before.cost * (1 + 1e-12)).all() and (after.iterations <= iterations).all()
        torch.testing.assert_close(after.cost, errors(x, after.cameras, after.structure, lifts).square().sum((-1, -2, -3)))
        before = after


def test_units_precision_degenerate_problems_and_an_empty_batch():
    x, cameras, structure, lifts = scene("space, constant velocity", noise=0.005)
    pixels = torch.tensor([[1000.0, 0, 800], [0, 1000, 600], [0, 0, 1]]).double()
    plain = bundle_adjust(x, None, cameras, structure, lifts, tolerance=1e-12)
    found = bundle_adjust(1000 * x + pixels[:2, 2], None, pixels @ cameras, structure, lifts, tolerance=1e-12)
    torch.testing.assert_close(found.cost, 1e6 * plain.cost, rtol=1e-6, atol=0)
    x, cameras, structure, lifts = scene("static", (3,), noise=0.005)
    cameras[0], structure[1], x[2] = cameras[0, :1], structure[1, :1], 0.0  # one camera, one point, one image
    found = bundle_adjust(x, None, cameras, structure)
    assert found.cameras.isfinite().all() and found.structure.isfinite().all() and found.cost.isfinite().all()
    x, cameras, structure, lifts = scene("static", (2,))
    found = bundle_adjust(x.float(), None, cameras.float(), structure.float())
    assert found.cameras.dtype == found.structure.dtype == found.cost.dtype == torch.float32
    assert (found.cost < 1e-10).all()
    assert bundle_adjust(x[:0], None, cameras[:0], structure[:0], lifts).cameras.shape == (0, 3, 3, 4)


def test_the_information_is_the_gram_of_the_jacobian_of_each_point():
    x, cameras, structure, _ = scene("static", (2,))
    weights = torch.rand(x.shape[:-1], generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    weights[0, 1:, 4] = 0
    structure = structure / structure.norm(dim=-1, keepdim=True)
    found = point_information(cameras, 3 * structure, weights)
    for b, j in ((0, 0), (1, 7)):
        jacobian = torch.func.jacrev(lambda y, b=b: reproject(cameras[b], y[None])[:, 0])(structure[b, j])
        expected = torch.einsum("v,vlk,vlm->km", weights[b, :, j], jacobian, jacobian)
        torch.testing.assert_close(found[b, j], expected)


def test_confined_points_stay_in_their_subspace_and_cost_least_there():
    scene = lifted_points("constant_velocity_2d", 30, 5, static=0.5, sigma=0.5, generator=torch.Generator().manual_seed(7))
    assert scene.lifts is not None
    x, still = (scene.tracks - 500) / 300, torch.eye(5, dtype=torch.float64)[:, :3]
    frame = torch.tensor([[1 / 300, 0, -5 / 3], [0, 1 / 300, -5 / 3], [0, 0, 1]], dtype=torch.float64)
    cameras, resting = frame @ scene.cameras, scene.labels == 1
    start = scene.structure + 0.01 * torch.randn(30, 5, generator=torch.Generator().manual_seed(8), dtype=torch.float64)
    found = bundle_adjust(x, None, cameras, start, scene.lifts, confined=resting, subspace=still, tolerance=1e-14)
    assert found.structure[resting][:, 3:].abs().max() < 1e-12
    assert found.structure[~resting][:, 3:].abs().max() > 1e-3
    # the same by points of their own space: resting ones are points of the plane for every view
    free = bundle_adjust(x[:, resting], None, cameras, start[resting][:, :3], tolerance=1e-14)
    alone = bundle_adjust(
        x[:, resting], None, cameras, start[resting], scene.lifts, confined=resting[resting], subspace=still, tolerance=1e-14
    )
    torch.testing.assert_close(alone.cost, free.cost, rtol=1e-8, atol=0)
    assert found.cost > bundle_adjust(x, None, cameras, start, scene.lifts, tolerance=1e-14).cost


def test_misuse():
    x, cameras, structure, lifts = scene("plane, constant velocity")
    assert_refused(
        (lambda: bundle_adjust(x, None, cameras, structure), "give lifts"),
        (lambda: bundle_adjust(x, None, cameras, structure, lifts[:2]), "lifts must be"),
        (lambda: bundle_adjust(x, None, cameras[:, :2], structure, lifts), "cameras must be"),
        (lambda: bundle_adjust(x, None, cameras, structure[1:], lifts), "structure must be"),
        (lambda: bundle_adjust(x, torch.ones(3), cameras, structure, lifts), "weights must be"),
        (lambda: bundle_adjust(x[0], None, cameras, structure, lifts), "x must be"),
        (lambda: bundle_adjust(x, None, cameras, structure, lifts, scale=0.0), "scale must be positive"),
        (
            lambda: bundle_adjust(x, None, cameras, structure, lifts, confined=torch.ones(24, dtype=torch.bool)),
            r"confined points need a subspace \(5, r\)",
        ),
    )
