"""Lens distortion: against OpenCV, finite differences and closed forms."""

import pytest
import torch

from dyntorch.geometry.epipolar_fit import Frames
from dyntorch.geometry.lens import Division, LensDescent, LensMatches, distort, fit_distortion, undistort, undistort_points
from dyntorch.scenes import two_view
from tests.grid import assert_refused

K = torch.tensor([[1100.0, 0.0, 950.0], [0.0, 1080.0, 530.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
LENSES = {
    "four": [-0.31, 0.11, 8e-4, -6e-4],
    "five": [-0.28, 0.13, -5e-4, 9e-4, -0.03],
    "eight": [0.35, 0.02, 5e-4, -3e-4, 0.001, 0.5, 0.02, 0.001],
    "pincushion": [0.12, 0.02, 0.0, 0.0],
}


def pixels(n=200, seed=0):
    share = torch.rand(n, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return share * torch.tensor([1920.0, 1080.0], dtype=torch.float64)


def lens(name):
    return torch.tensor(LENSES[name], dtype=torch.float64)


@pytest.mark.parametrize("name", LENSES)
def test_removal_and_distortion_equal_opencv_and_are_inverse_inside_the_image(name):
    cv2 = pytest.importorskip("cv2")
    x, dist = pixels(), lens(name)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-13)
    iterated = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)  # a name of its own up to OpenCV 4
    given = {"R": None, "P": K.numpy(), "criteria": criteria}
    expected = iterated(x.numpy()[:, None], K.numpy(), dist.numpy(), **given)[:, 0]
    assert (undistort(x, K, dist) - torch.from_numpy(expected)).abs().max() < 1e-6
    rays = torch.cat([(x - K[:2, 2]) / K[[0, 1], [0, 1]], torch.ones(200, 1, dtype=torch.float64)], dim=1)
    expected = cv2.projectPoints(rays.numpy(), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), K.numpy(), dist.numpy())[0][:, 0]
    assert torch.allclose(distort(x, K, dist), torch.from_numpy(expected), rtol=0, atol=1e-9)
    assert torch.allclose(distort(undistort(x, K, dist), K, dist), x, rtol=0, atol=1e-8)


def test_batches_equal_loops_and_float32_keeps_its_type():
    x, dist = torch.stack([pixels(seed=1), pixels(seed=2)]), torch.stack([lens("five"), -0.5 * lens("five")])
    cameras = torch.stack([K, K + torch.diag(torch.tensor([50.0, -20.0, 0.0], dtype=torch.float64))])
    together = undistort(x, cameras, dist)
    assert torch.allclose(together, torch.stack([undistort(*one) for one in zip(x, cameras, dist, strict=True)]), atol=1e-9)
    single = undistort(x[0].float(), K.float(), dist[0].float())
    assert single.dtype == torch.float32
    assert torch.allclose(single.double(), together[0], atol=1e-2)


def test_derivatives_of_removal_in_points_camera_and_lens():
    x, dist = pixels(4).requires_grad_(), lens("eight").requires_grad_()
    upper = K.clone().requires_grad_()

    def removed(x, f, dist):
        return undistort(x, torch.cat([f, K[2:]]), dist)

    assert torch.autograd.gradcheck(removed, (x, upper[:2], dist), eps=1e-6, atol=1e-5)


def test_beyond_the_fold_there_is_no_solution():
    # k1 = -0.25 alone: r - r^3 / 4 has its maximum at r = 2 / sqrt(3), where it is 4 / (3 sqrt 3)
    dist, edge = torch.tensor([-0.25, 0, 0, 0], dtype=torch.float64), 4 / (3 * 3**0.5)
    r = torch.tensor([0.0, 0.5 * edge, 0.999 * edge, 1.001 * edge, 3 * edge], dtype=torch.float64)
    x = torch.stack([r, torch.zeros_like(r)], dim=-1)
    found = undistort(x, torch.eye(3, dtype=torch.float64), dist)
    assert found.isnan().any(-1).tolist() == [False, False, False, True, True]
    assert float(found[2, 0]) < 2 / 3**0.5


def test_missing_points_stay_missing_and_out_of_the_derivatives():
    x = pixels(5)
    x[2] = torch.nan
    dist = lens("four").requires_grad_()
    found = undistort(x, K, dist)
    assert found.isnan().any(-1).tolist() == [False, False, True, False, False]
    found[[0, 1, 3, 4]].sum().backward()
    assert dist.grad.isfinite().all()


@pytest.mark.parametrize("strength", [-0.6, -0.1, 0.0, 0.3])
def test_division_model_and_its_inverse(strength):
    x = pixels()
    lens = Division.of(x, (1920, 1080), strength)
    assert lens.radius == pytest.approx(0.5 * (1920**2 + 1080**2) ** 0.5)
    straight = lens.undistort(x)
    assert torch.allclose(lens.distort(straight), x, atol=1e-8)
    corner = torch.tensor([[1920.0, 1080.0]], dtype=torch.float64)
    assert torch.allclose(lens.undistort(corner) - lens.centre, (corner - lens.centre) / (1 + strength))


def test_the_division_model_ends_where_it_folds():
    barrel = Division(-0.25, torch.zeros(2, dtype=torch.float64), 1.0)
    x = torch.tensor([[1.99, 0.0], [2.01, 0.0]], dtype=torch.float64)
    assert barrel.undistort(x).isnan().any(-1).tolist() == [False, True]
    pincushion = Division(0.25, torch.zeros(2, dtype=torch.float64), 1.0)
    assert pincushion.distort(x / 2).isnan().any(-1).tolist() == [False, True]
    x = torch.tensor([[[0.0, 0.0], [torch.nan, 9.0]], [[6.0, 2.0], [3.0, 8.0]]])
    lens = Division.of(x)
    assert (lens.centre.tolist(), lens.radius) == ([3.0, 4.0], 5.0)


def test_calibrations_as_users_write_them():
    x = pixels(6).reshape(2, 3, 2)
    assert undistort_points(x, None) is x
    assert torch.equal(undistort_points(x, (K.tolist(), None)), x)
    expected = undistort(x, K, lens("five"))
    assert torch.equal(undistort_points(x, (K.numpy(), [LENSES["five"]])), expected)


# Lenses fitted to matches: against scenes seen through known lenses, and finite differences.


SIZE = (640.0, 480.0)


def inside(views):
    """The matches within both pictures."""
    within = torch.stack([((x > 0) & (x < torch.tensor(SIZE))).all(-1) for x in views]).all(0)
    return [x[within] for x in views]


def seen(strengths, n=400, noise=0.0, seed=0):
    """Matches as lenses of the given lambda show them, with noise on what is measured."""
    generator = torch.Generator().manual_seed(seed)
    views = inside(two_view(n, generator=generator).views)
    bent = [Division.of(x, SIZE, value).distort(x) for x, value in zip(views, strengths, strict=True)]
    return [x + noise * torch.randn(x.shape, generator=generator, dtype=x.dtype) for x in bent]


@pytest.mark.slow
@pytest.mark.parametrize("strengths", [(-0.2, -0.1), (0.0, -0.3), (-0.5, -0.45), (0.1, 0.05)])
def test_exact_matches_give_the_lenses(strengths):
    fit = fit_distortion(*seen(strengths), sizes=(SIZE, SIZE))
    assert (fit.lambda_a, fit.lambda_b) == pytest.approx(strengths, abs=1e-4)
    assert fit.significant and fit.gain > 0.9
    assert fit.note.startswith("lens distortion fitted, lambda = ") and "give calibration" in fit.note


@pytest.mark.slow
def test_noisy_matches_give_the_lenses_within_their_sigmas():
    truth = torch.tensor([-0.15, -0.08], dtype=torch.float64)
    fits = [fit_distortion(*seen(truth.tolist(), noise=1.0, seed=seed), sizes=(SIZE, SIZE)) for seed in range(5)]
    errors = torch.stack([torch.tensor([fit.lambda_a, fit.lambda_b], dtype=torch.float64) for fit in fits]) - truth
    sigmas = torch.tensor([fit.sigmas for fit in fits], dtype=torch.float64)
    assert 0.4 < float((errors / sigmas).square().mean().sqrt()) < 2
    assert all(fit.significant for fit in fits)
    # ideal cameras are left alone
    fits = [fit_distortion(*seen((0.0, 0.0), noise=1.0, seed=seed), sizes=(SIZE, SIZE)) for seed in range(6)]
    assert not any(fit.significant or fit.gain >= 0.05 for fit in fits)


def test_wrong_matches_missing_ones_and_too_few():
    fit = fit_distortion(*seen((-0.3, -0.3), n=30), sizes=(SIZE, SIZE))
    assert (fit.lambda_a, fit.gain, fit.significant) == (0.0, 0.0, False)
    a, b = seen((-0.2, -0.1), noise=0.5)
    generator = torch.Generator().manual_seed(5)
    b[::7] += 60 * torch.randn(len(b[::7]), 2, generator=generator, dtype=b.dtype)
    a[3], b[10] = torch.nan, torch.nan
    weights = torch.ones(len(a))
    weights[20:40] = 0
    b[20:40] = 0
    fit = fit_distortion(a, b, weights, (SIZE, SIZE))
    assert fit.significant
    assert (fit.lambda_a, fit.lambda_b) == pytest.approx((-0.2, -0.1), abs=0.02)


def test_without_sizes_the_points_own_box_stands_in():
    a, b = seen((-0.25, -0.25))
    fit = fit_distortion(a, b)
    assert fit.significant and fit.gain > 0.4
    # what weighs nothing may lie anywhere
    anywhere = torch.full((1, 2), -5000.0, dtype=a.dtype)
    weights = torch.cat([torch.ones(len(a)), torch.zeros(1)])
    same = fit_distortion(torch.cat([a, anywhere]), torch.cat([b, anywhere]), weights)
    assert (same.lambda_a, same.lenses[0].radius) == pytest.approx((fit.lambda_a, fit.lenses[0].radius))
    straight = [lens.undistort(x) for lens, x in zip(fit.lenses, (a, b), strict=True)]
    assert all(x.isfinite().all() for x in straight)


def test_a_lens_of_another_model_is_approximated():
    views = inside(two_view(400, generator=torch.Generator().manual_seed(2)).views)
    K = torch.tensor([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    bent = [distort(x, K, torch.tensor([-0.25, 0.08, 0.0, 0.0], dtype=torch.float64)) for x in views]
    fit = fit_distortion(*bent, sizes=(SIZE, SIZE))
    assert fit.significant and fit.gain > 0.8 and fit.lambda_a < -0.05


def test_distances_are_the_constraint_by_its_gradient_in_measured_pixels():
    a, b = seen((-0.2, -0.1), n=6, noise=3.0)
    ideal = Division.of(a, SIZE), Division.of(b, SIZE)
    F = torch.randn(1, 3, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    lens = torch.tensor([[-0.2, -0.1]], dtype=torch.float64)

    def constraint(x):
        first, second = (
            torch.cat([u, 1 + value * u.square().sum(-1, keepdim=True)], dim=-1)
            for u, value in (((x[:, :2] - ideal[0].centre) / 400, -0.2), ((x[:, 2:] - ideal[1].centre) / 400, -0.1))
        )
        return torch.einsum("ni,ij,nj->n", second, F[0], first)

    x, step = torch.cat([a, b], dim=1), 1e-4
    moves = step * torch.eye(4, dtype=torch.float64)
    gradient = torch.stack([(constraint(x + move) - constraint(x - move)) / (2 * step) for move in moves], dim=-1)
    found = LensMatches.of(a, b, torch.ones(6), ideal).distances(F, lens)[0]
    assert torch.allclose(found, constraint(x) / gradient.norm(dim=-1), rtol=1e-6)


def test_the_descent_never_rises_and_keeps_fixed_lenses():
    a, b = seen((-0.2, -0.1), noise=1.0)
    data = LensMatches.of(a, b, torch.ones(len(a), dtype=torch.float64), (Division.of(a, SIZE), Division.of(b, SIZE)))
    F = torch.randn(3, 3, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    start = LensDescent(Frames.of(F), torch.tensor([[-0.1, 0.0]] * 3, dtype=torch.float64))
    scale = torch.full((3, 1), 5.0, dtype=torch.float64)
    for lens in (False, True):
        found = start.descend(data, scale, lens=lens)
        assert (found.cost(data, scale) <= start.cost(data, scale)).all()
        assert torch.equal(found.lens, start.lens) != lens


def test_misuse():
    five, gone = torch.zeros(5, 2), torch.full((5, 2), torch.nan)
    fisheye = "fisheye, thin prism and tilted lenses are not supported"
    assert_refused(
        (lambda: undistort_points(pixels(3), K), r"None or \(K, dist\), got Tensor"),
        (lambda: undistort_points(pixels(3), (K[:2], [0.0] * 4)), r"K must be \[\[fx"),
        (lambda: undistort_points(pixels(3), (K.mT, [0.0] * 4)), r"K must be \[\[fx"),
        (lambda: undistort_points(pixels(3), (K, [0.0] * 14)), fisheye),
        (lambda: undistort_points(pixels(3), (K, [float("nan")] * 4)), "dist must be finite"),
        (lambda: distort(torch.zeros(3), K, lens("four")), r"points must be \(\*batch, n, 2\), got \(3,\)"),
        (lambda: fit_distortion(five, five[:4]), r"matches must be \(N, 2\) in both cameras, got \(5, 2\) and \(4, 2\)"),
        (lambda: fit_distortion(five, five, torch.ones(4)), r"weights must be \(5,\), one per match, got \(4,\)"),
        (lambda: fit_distortion(gone, five), "no point is seen"),
        (lambda: Division.of(gone), "no point is seen"),
    )
