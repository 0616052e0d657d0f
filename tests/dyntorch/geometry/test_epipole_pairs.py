"""Products of two forms of rank two: the product point by point, both factors again, units, noise, failures, gradients."""

from itertools import combinations_with_replacement

import pytest
import torch

from dyntorch.geometry.pairs import factor_product, product_matrix
from dyntorch.scenes import bodies


def random(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def rank_two(*batch, seed=0):
    u, s, vh = torch.linalg.svd(random(*batch, 3, 3, seed=seed))
    form = u[..., :2] @ (s[..., :2, None] * vh[..., :2, :])
    return form / torch.linalg.matrix_norm(form, keepdim=True)


def apart(first, second):
    """Distance of matrices up to scale."""
    a, b = (m / torch.linalg.matrix_norm(m, keepdim=True) for m in (first, second))
    return torch.minimum(torch.linalg.matrix_norm(a - b), torch.linalg.matrix_norm(a + b))


def pair_error(found, true):
    """The worse of both forms in the better order."""
    orders = [torch.maximum(apart(found[0], true[k]), apart(found[1], true[1 - k])) for k in (0, 1)]
    return torch.minimum(*orders)


def nu(p, degree=2):
    return torch.stack([p[..., list(c)].prod(-1) for c in combinations_with_replacement(range(3), degree)], dim=-1)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_product_is_the_product_at_every_pair_of_points(count):
    forms, p, q = random(count, 4, 3, 3), random(4, 3, seed=2), random(4, 3, seed=3)
    expected = torch.einsum("ni,knij,nj->kn", q, forms, p).prod(0)
    matrix = product_matrix(*forms)
    torch.testing.assert_close(torch.einsum("na,nab,nb->n", nu(q, count), matrix, nu(p, count)), expected)
    torch.testing.assert_close(matrix, product_matrix(*forms.flip(0)))


def test_rank_and_null_spaces_of_the_product():
    f, g = rank_two(5), rank_two(5, seed=1)
    matrix = product_matrix(f, g)
    values = torch.linalg.svdvals(matrix)
    assert (values[:, 4] < 1e-12).all() and (values[:, 3] > 1e-4).all()
    for form in (f, g):
        right, left = torch.linalg.svd(form).Vh[:, 2], torch.linalg.svd(form).U[..., 2]
        assert torch.einsum("nab,nb->na", matrix, nu(right)).abs().max() < 1e-12
        assert torch.einsum("nab,na->nb", matrix, nu(left)).abs().max() < 1e-12


def test_factors_of_a_product():
    f, g = rank_two(4, 50), rank_two(4, 50, seed=1)
    found = factor_product(-3.0 * product_matrix(f, g))
    assert found[0].shape == (4, 50, 3, 3)
    error = pair_error(found, (f, g))
    assert error.median() < 1e-12 and error.max() < 1e-9
    for form in found:
        torch.testing.assert_close(torch.linalg.matrix_norm(form), torch.ones(4, 50).double())
        assert torch.linalg.det(form).abs().max() < 1e-10
    # the order is that of the forms alone
    again = factor_product(product_matrix(2 * g, f))
    for one, other in zip(found, again, strict=True):
        assert apart(one, other).max() < 1e-8


def test_units_of_the_image_do_not_matter():
    scene = bodies(20, batch=60, interleaved=True, generator=torch.Generator().manual_seed(0))
    found = factor_product(product_matrix(*scene.motion))
    assert pair_error(found, scene.motion).max() < 1e-8


def test_nearest_product_of_a_noisy_matrix():
    """Nearest in balanced units of the views, so about as near as the true one in the given units."""
    f, g = rank_two(30), rank_two(30, seed=1)
    exact = product_matrix(f, g)
    exact = exact / torch.linalg.matrix_norm(exact, keepdim=True)
    weight = torch.tensor([1.0, 2, 2, 1, 2, 1]).double().sqrt()
    for sigma in (1e-3, 1e-5):
        noisy = exact + sigma * random(30, 6, 6, seed=2)

        def rest(*forms, noisy=noisy):
            target, product = noisy / weight[:, None] / weight, product_matrix(*forms) / weight[:, None] / weight
            share = (target * product).sum((-2, -1), keepdim=True) / product.square().sum((-2, -1), keepdim=True)
            return torch.linalg.matrix_norm(target - share * product)

        found = factor_product(noisy)
        least = rest(*found)
        assert (least <= 2 * rest(f, g)).all() and least.mean() < rest(f, g).mean()
        assert pair_error(found, (f, g)).median() < 20 * sigma


def test_failures_leave_the_others_alone():
    good = product_matrix(rank_two(), rank_two(seed=1))
    bad = torch.stack([good, torch.zeros(6, 6).double(), torch.full((6, 6), torch.nan).double(), torch.ones(6, 6).double(), good])
    bad.requires_grad_()
    found = factor_product(bad)
    assert all(f.isfinite().all() for f in found)
    assert all(f[1:3].abs().max() == 0 for f in found)
    sum(f.square().sum((-2, -1)).sum() + f[0].sum() for f in found).backward()
    assert bad.grad[[0, 1, 3, 4]].isfinite().all()
    for one, other in zip(found, factor_product(good), strict=True):
        torch.testing.assert_close(one[0], other)
        torch.testing.assert_close(one[4], other)
    double = factor_product(product_matrix(rank_two(), rank_two()))
    assert all(f.isfinite().all() for f in double)
    with pytest.raises(ValueError, match=r"matrix must be \(\*batch, 6, 6\), got \(5, 6\)"):
        factor_product(torch.zeros(5, 6))


@pytest.mark.slow
def test_gradients():
    f, g = rank_two(2), rank_two(2, seed=1)

    assert torch.autograd.gradcheck(product_matrix, (f.requires_grad_(), g.requires_grad_()))

    # up to its sign, which is free: the projection
    def outer(m):
        flat = product_matrix(*factor_product(m)).flatten(1)
        return flat[:, :, None] * flat[:, None, :5]

    for sigma in (1e-3, 0.0):  # of an exact product, too
        matrix = (product_matrix(f, g) + sigma * random(2, 6, 6, seed=4)).detach().requires_grad_()
        assert torch.autograd.gradcheck(outer, matrix, fast_mode=True, eps=1e-7, atol=1e-4)
