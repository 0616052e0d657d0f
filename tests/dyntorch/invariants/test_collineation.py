"""Collineations: rank of the rows, round trip, transfer, residual, kornia and OpenCV's direction."""

import kornia
import pytest
import torch

from dyntorch import scenes
from dyntorch.geometry.homogeneous import apply
from dyntorch.invariants.collineation import Collineation


def random(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def scene(n, matches, **options):
    return scenes.collineation(n, matches, generator=torch.Generator().manual_seed(0), **options)


def rows(invariant, views):
    first, second = (p.vectors(x) for p, x in zip(invariant.primitives, views, strict=True))
    return torch.einsum("nra,nsb->nrsab", first, second).reshape(-1, invariant.width())


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_minimal_matches_determine_it(n):
    invariant = Collineation(n)
    assert (invariant.minimal(), invariant.rows(), invariant.dof, invariant.codim) == (n + 2, n, (n + 1) ** 2 - 1, n)
    found = scene(n, invariant.minimal())
    matrix = rows(invariant, found.views)
    assert torch.linalg.matrix_rank(matrix) == invariant.width() - 1
    assert torch.linalg.matrix_rank(matrix[: (n + 1) * n]) == (n + 1) * n < invariant.width() - 1
    assert (matrix @ Collineation.compose(*found.motion).flatten()).abs().max() < 1e-12


def test_class_stands_for_the_plane():
    assert Collineation.minimal() == 4
    assert Collineation().n == 2
    assert repr(Collineation(3)) == "Collineation(n=3)"
    with pytest.raises(ValueError, match="got 0"):
        Collineation(0)


@pytest.mark.parametrize("n", [1, 2, 3])
def test_round_trip(n):
    matrix = random(40, n + 1, n + 1)
    back = Collineation.decompose(-7 * Collineation.compose(matrix))
    torch.testing.assert_close(back.flatten(1).norm(dim=1), torch.ones(40).double())
    parallel = (back.flatten(1) * Collineation.compose(matrix).flatten(1)).sum(1).abs()
    torch.testing.assert_close(parallel, torch.ones(40).double())
    torch.testing.assert_close(Collineation.decompose(back), back)


def test_transfer_maps_view_two_to_view_one():
    found = scene(3, 20, batch=4)
    torch.testing.assert_close(Collineation.transfer(-2 * found.motion[0], found.views[1]), found.views[0])


def test_kornia_and_opencv_map_their_first_points_to_their_second():
    cv2 = pytest.importorskip("cv2")
    x1, x2 = scene(2, 30).views
    theirs = kornia.geometry.find_homography_dlt(x2[None], x1[None])[0]
    torch.testing.assert_close(Collineation.transfer(theirs, x2), x1, rtol=1e-4, atol=1e-4)
    matrix, _ = cv2.findHomography(x2.numpy(), x1.numpy())
    torch.testing.assert_close(Collineation.transfer(torch.from_numpy(matrix), x2), x1, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("n", [1, 2, 3])
def test_residual_is_chi_square_and_vanishes_on_exact_matches(n):
    sigma = 1e-3
    found = scene(n, 8000, sigma=sigma)
    scales = (torch.tensor(sigma).double(),) * 2
    w = Collineation(n).whitened_residual(found.motion, found.views, scales)
    assert abs(float(w.square().sum(-1).mean()) / n - 1) < 0.06
    assert Collineation(n).whitened_residual(found.motion, found.exact, scales).abs().max() < 1e-8


def test_residual_agrees_with_finite_differences():
    found = scene(2, 5, sigma=0.1)
    (A,), (x1, x2) = found.motion, found.views
    step, s1, s2 = 1e-6, 0.5, 2.0
    covariance = s1**2 * torch.eye(2).double().repeat(5, 1, 1)
    for c in range(2):
        shift = step * torch.eye(2).double()[c]
        column = (apply(A, x2 + shift) - apply(A, x2 - shift)) / (2 * step) * s2
        covariance = covariance + column[:, :, None] * column[:, None, :]
    e = apply(A, x2) - x1
    square = (e[:, None] @ torch.linalg.inv(covariance) @ e[..., None]).flatten()
    w = Collineation(2).whitened_residual((A,), (x1, x2), (torch.tensor(s1).double(), torch.tensor(s2).double()))
    torch.testing.assert_close(w.square().sum(-1), square, rtol=1e-6, atol=1e-10)


def test_zero_is_never_nan():
    zero = torch.zeros(2, 3, 3).double().requires_grad_()
    x = random(2, 4, 2)
    one = (torch.ones(2).double(),) * 2
    out = Collineation(2).whitened_residual((Collineation.compose(Collineation.decompose(zero)),), (x, x), one)
    out.sum().backward()
    assert out.isfinite().all()
    assert zero.grad.isfinite().all()
    assert torch.equal(Collineation.decompose(zero), zero)


def test_gradients():
    matrix, x = random(2, 3, 3).requires_grad_(), (0.1 * random(2, 4, 2, seed=1)).requires_grad_()
    assert torch.autograd.gradcheck(Collineation.transfer, (matrix, x))
    assert torch.autograd.gradcheck(lambda m: Collineation.decompose(Collineation.compose(m)), matrix)
