"""Lens distortion: against OpenCV, finite differences and closed forms."""

import pytest
import torch

from dyntorch.geometry.lens import Division, distort, undistort, undistort_points

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
def test_removal_equals_opencv_inside_the_image(name):
    cv2 = pytest.importorskip("cv2")
    x, dist = pixels(), lens(name)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-13)
    iterated = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)  # a name of its own up to OpenCV 4
    given = {"R": None, "P": K.numpy(), "criteria": criteria}
    expected = iterated(x.numpy()[:, None], K.numpy(), dist.numpy(), **given)[:, 0]
    assert (undistort(x, K, dist) - torch.from_numpy(expected)).abs().max() < 1e-6


@pytest.mark.parametrize("name", LENSES)
def test_distortion_equals_opencv(name):
    cv2 = pytest.importorskip("cv2")
    rays = torch.cat([(pixels() - K[:2, 2]) / K[[0, 1], [0, 1]], torch.ones(200, 1, dtype=torch.float64)], dim=1)
    expected = cv2.projectPoints(rays.numpy(), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), K.numpy(), lens(name).numpy())[0][:, 0]
    assert torch.allclose(distort(pixels(), K, lens(name)), torch.from_numpy(expected), rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", LENSES)
def test_removal_inverts_distortion(name):
    x = pixels()
    assert torch.allclose(distort(undistort(x, K, lens(name)), K, lens(name)), x, rtol=0, atol=1e-8)


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


def test_division_model_ends_where_it_folds():
    barrel = Division(-0.25, torch.zeros(2, dtype=torch.float64), 1.0)
    x = torch.tensor([[1.99, 0.0], [2.01, 0.0]], dtype=torch.float64)
    assert barrel.undistort(x).isnan().any(-1).tolist() == [False, True]
    pincushion = Division(0.25, torch.zeros(2, dtype=torch.float64), 1.0)
    assert pincushion.distort(x / 2).isnan().any(-1).tolist() == [False, True]


def test_division_without_a_size_uses_the_box_of_the_points():
    x = torch.tensor([[[0.0, 0.0], [torch.nan, 9.0]], [[6.0, 2.0], [3.0, 8.0]]])
    lens = Division.of(x)
    assert (lens.centre.tolist(), lens.radius) == ([3.0, 4.0], 5.0)
    with pytest.raises(ValueError, match="no point is seen"):
        Division.of(torch.full((3, 2), torch.nan))


def test_calibrations_as_users_write_them():
    x = pixels(6).reshape(2, 3, 2)
    assert undistort_points(x, None) is x
    assert torch.equal(undistort_points(x, (K.tolist(), None)), x)
    expected = undistort(x, K, lens("five"))
    assert torch.equal(undistort_points(x, (K.numpy(), [LENSES["five"]])), expected)


@pytest.mark.parametrize(
    ("calibration", "words"),
    [
        (K, r"None or \(K, dist\), got Tensor"),
        ((K[:2], [0.0] * 4), r"K must be \[\[fx"),
        ((K.mT, [0.0] * 4), r"K must be \[\[fx"),
        ((K, [0.0] * 14), "fisheye, thin prism and tilted lenses are not supported"),
        ((K, [float("nan")] * 4), "dist must be finite"),
    ],
)
def test_calibrations_that_are_none(calibration, words):
    with pytest.raises(ValueError, match=words):
        undistort_points(pixels(3), calibration)


def test_points_of_a_wrong_shape():
    with pytest.raises(ValueError, match=r"points must be \(\*batch, n, 2\), got \(3,\)"):
        distort(torch.zeros(3), K, lens("four"))
