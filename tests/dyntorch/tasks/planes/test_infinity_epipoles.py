"""The homography at infinity where the fundamental matrix of one body, or of several, is known."""

import pytest
import torch

from dyntorch.geometry.homogeneous import skew
from dyntorch.tasks.planes.closed_forms import infinity_from_fundamentals, infinity_from_mixed, infinity_linear
from tests.dyntorch.tasks.planes.test_rank_one_pencils import error, normal, planes


def mixed(*batch, **options):
    homographies, infinity, e, v, fundamentals = planes(*batch, f=1, **options)
    return fundamentals[..., 0, :, :], homographies, infinity, e, v


def test_from_fundamental_matrices():
    for f in (2, 3, 6):
        *_, infinity, _, _, fundamentals = planes(50, f=f, seed=f)
        found, spectrum = infinity_from_fundamentals(fundamentals)
        assert error(found, infinity).max() < 1e-9
        torch.testing.assert_close(torch.linalg.det(found), torch.ones(50).double())
        assert (spectrum[..., 8] < 1e-12).all() and (spectrum[..., 7] > 1e-4).all()


def test_rank_of_one_body_and_of_one_epipole():
    *_, fundamentals = planes(10, f=1)
    twice = torch.cat([fundamentals, -2 * fundamentals], -3)
    _, spectrum = infinity_from_fundamentals(twice)
    assert ((spectrum > 1e-10).sum(-1) == 5).all()


def test_weights_and_bad_fundamental_matrices():
    *_, infinity, _, _, fundamentals = planes(5, f=4)
    fundamentals[:, 1] = normal(5, 3, 3, seed=9)
    weights = torch.tensor([1.0, 0.0, 0.3, 2.0]).expand(5, 4)
    assert error(infinity_from_fundamentals(fundamentals, weights)[0], infinity).max() < 1e-9
    fundamentals[:, 1] = torch.nan
    fundamentals[3] = torch.inf
    found, spectrum = infinity_from_fundamentals(fundamentals)
    assert found.isfinite().all() and spectrum.isfinite().all()
    assert error(found, infinity)[[0, 1, 2, 4]].max() < 1e-9


def test_gradients_of_fundamental_matrices():
    *_, fundamentals = planes(f=3)
    noisy = (fundamentals + 0.01 * normal(3, 3, 3, seed=7)).requires_grad_()
    assert torch.autograd.gradcheck(lambda f: infinity_from_fundamentals(f)[0], (noisy,), atol=1e-5)


@pytest.mark.parametrize("n", [2, 3, 5])
@pytest.mark.parametrize("kind", ["generic", "collinear", "coplanar", "both"])
def test_one_fundamental_matrix_and_planes(n, kind):
    if kind in {"coplanar", "both"} and n > 2:
        n += 1  # more than two coplanar normals still have two directions
    f, homographies, infinity, *_ = mixed(300, n=n, kind=kind, seed=n)
    found, residual = infinity_from_mixed(f, homographies)
    assert (error(found, infinity) < 1e-6).all()
    assert residual.max() < 1e-7


def test_two_planes_and_a_fundamental_matrix_have_one_solution():
    # each scale is a common root of three quadrics, whose coefficients have rank two; and two lines meet once
    f, homographies, *_ = mixed(100, n=2)
    left = torch.linalg.svd(f).U[..., 2]
    across = torch.linalg.svd(left[..., None, :]).Vh[..., 1:, :]
    base = across @ skew(left) @ f

    def minors(m):
        return torch.linalg.cross(m[..., 0, :], m[..., 1, :])

    for i in (0, 1):
        plane = across @ homographies[:, i]
        quadrics = torch.stack([minors(plane + s * base) for s in (-1.0, 0.0, 1.0)], -1)
        values = torch.linalg.svdvals(quadrics)
        assert (values[:, 2] < 1e-10 * values[:, 0]).all() and (values[:, 1] > 1e-6 * values[:, 0]).all()


def test_a_plane_of_the_known_body_says_nothing():
    f, homographies, infinity, *_ = mixed(50, n=2)
    epipole = torch.linalg.svd(f).U[..., 2]
    own = infinity + epipole[..., :, None] * normal(50, 1, 3, seed=8)
    static = 2 * infinity
    more = torch.cat([own[:, None], homographies, static[:, None]], -3)
    assert error(infinity_from_mixed(f, more)[0], infinity).max() < 1e-6
    # with one plane of another body a line of solutions is left, of which one comes out
    assert infinity_from_mixed(f, more[:, :2])[0].isfinite().all()


def test_noise_like_that_of_the_linear_solution():
    for n in (2, 4):
        f, homographies, infinity, *_ = mixed(100, n=n)
        f = f / torch.linalg.matrix_norm(f, keepdim=True) + 1e-4 * normal(100, 3, 3, seed=5)
        noisy = homographies + 1e-3 * normal(100, n, 3, 3, seed=6)
        closed = error(infinity_from_mixed(f, noisy)[0], infinity).median()
        linear = error(infinity_linear(noisy, fundamentals=f[:, None])[0], infinity).median()
        assert closed < 1.2 * linear and closed < 3e-3


def test_batch_is_loop_and_a_bad_problem_stays_alone():
    f, homographies, infinity, *_ = mixed(2, 3, n=3)
    homographies = homographies + 1e-3 * normal(2, 3, 3, 3, 3, seed=6)
    f[0, 1] = torch.nan
    homographies[0, 2] = 0
    homographies[1, 1, 0] = torch.inf
    found, residual = infinity_from_mixed(f, homographies)
    assert found.isfinite().all() and residual.isfinite().all()
    assert error(found, infinity)[[0, 1, 1], [0, 0, 2]].max() < 0.1
    torch.testing.assert_close(found[1, 1], infinity_from_mixed(f[1, 1], homographies[1, 1, 1:])[0])
    for i in range(2):
        for j in range(3):
            alone = infinity_from_mixed(f[i, j], homographies[i, j])
            torch.testing.assert_close(found[i, j], alone[0], atol=1e-8, rtol=1e-8)
            torch.testing.assert_close(residual[i, j], alone[1], atol=1e-8, rtol=1e-8)


def test_refusals():
    with pytest.raises(ValueError, match="m >= 2"):
        infinity_from_fundamentals(torch.rand(1, 3, 3))
    with pytest.raises(ValueError, match="weights must be"):
        infinity_from_fundamentals(torch.rand(2, 3, 3), torch.ones(3))
    with pytest.raises(ValueError, match="at least 2: add 1"):
        infinity_from_mixed(torch.rand(3, 3), torch.rand(1, 3, 3))
    with pytest.raises(ValueError, match="F must be"):
        infinity_from_mixed(torch.rand(3, 2), torch.rand(2, 3, 3))
