"""Segmentation matrix: product of two epipolar forms, both decompositions, labels, gradients, refinement, status."""

import pytest
import torch

import dyntorch as dyn
from dyntorch.geometry.homogeneous import homogeneous
from dyntorch.scenes import bodies
from tests.draws import random, seeded
from tests.dyntorch.geometry.test_pairs import pair_error

SM, FM = dyn.SegmentationMatrix, dyn.FundamentalMatrix


def scene(n=80, seed=0, **options):
    return bodies(n, options.pop("bodies", 2), interleaved=True, generator=seeded(seed), **options)


def wrong(labels, true):
    """Share of wrong labels, in the better order of the bodies."""
    share = (labels != true).double().mean(-1)
    return torch.minimum(share, 1 - share)


def epipolar(F, x1, x2):
    return torch.einsum("...na,...ab,...nb->...n", homogeneous(x2), F, homogeneous(x1))


def test_form_is_the_product_of_the_epipolar_forms():
    F1, F2 = random(3, 3, 3), random(3, 3, 3, seed=1)
    x1, x2 = random(3, 7, 2, seed=2), random(3, 7, 2, seed=3)
    S = SM.compose(F1, F2)
    product = epipolar(F1, x1, x2) * epipolar(F2, x1, x2)
    found = dyn.core.algebraic(SM, S, x1, x2)
    torch.testing.assert_close(found * (product[:, :1] / found[:, :1]), product)
    torch.testing.assert_close(torch.linalg.matrix_norm(S), torch.ones(3).double())
    # the first axis is of view 2: monomials 00, 01, 02, 11, 12, 22
    nu1, nu2 = (
        torch.stack([homogeneous(x)[..., i] * homogeneous(x)[..., j] for i in range(3) for j in range(i, 3)], -1) for x in (x1, x2)
    )
    torch.testing.assert_close(torch.einsum("bna,bac,bnc->bn", nu2, S, nu1), found)


def test_motion_of_four_parts_is_that_of_the_fundamental_matrices():
    A1, A2, e1, e2 = random(4, 3, 3), random(4, 3, 3, seed=1), random(4, 3, seed=2), random(4, 3, seed=3)
    S = SM.compose(A1, e1, A2, e2)
    torch.testing.assert_close(S, SM.compose(FM.compose(A1, e1), FM.compose(A2, e2)))
    parts = SM.decompose(S)
    assert [tuple(p.shape) for p in parts] == [(4, 3, 3), (4, 3), (4, 3, 3), (4, 3)]
    assert pair_error((FM.compose(*parts[:2]), FM.compose(*parts[2:])), (FM.compose(A1, e1), FM.compose(A2, e2))).max() < 1e-8
    with pytest.raises(ValueError, match="compose takes F1, F2, or A1, e1, A2, e2, got 3 parts"):
        SM.compose(A1, e1, A2)


def test_both_decompositions_of_exact_matches_agree_and_label_them():
    found = scene(80, batch=20)
    solution = dyn.fit(SM, *found.views).check()
    kernel = SM.fundamentals(solution.tensor)
    derivative = SM.decompose_by_derivatives(solution.tensor, *found.views)
    assert pair_error(kernel, found.motion).max() < 1e-6
    assert pair_error(derivative, found.motion).median() < 1e-6
    for pair in (kernel, derivative):
        labels = SM.labels(*pair, *found.views)
        assert labels.dtype == torch.int64 and set(labels.unique().tolist()) == {1, 2}
        assert wrong(labels, found.labels).max() == 0
        assert torch.linalg.det(torch.stack(pair)).abs().max() < 1e-12


def test_missing_matches_have_no_label_and_take_no_part():
    found = scene(60)
    x1 = found.views[0].clone()
    x1[[3, 9]] = torch.nan
    S = dyn.fit(SM, x1, found.views[1]).tensor
    labels = SM.labels(*SM.fundamentals(S), x1, found.views[1])
    assert (labels == 0).nonzero().flatten().tolist() == [3, 9]
    assert pair_error(SM.decompose_by_derivatives(S, x1, found.views[1]), found.motion) < 1e-6
    weights = SM.reweight(S, x1, found.views[1])
    assert weights[[3, 9]].tolist() == [0, 0] and (weights >= 0).all()


def test_labels_are_those_of_the_nearer_body():
    found = scene(50, sigma=2.0)
    F = torch.stack(found.motion)
    x1, x2 = found.views
    distances = []
    for f in F:
        line2, line1 = homogeneous(x1) @ f.mT, homogeneous(x2) @ f
        size = line1[:, :2].square().sum(-1) + line2[:, :2].square().sum(-1)
        distances.append(epipolar(f, x1, x2).abs() / size.sqrt())
    torch.testing.assert_close(SM.labels(*F, x1, x2), 1 + torch.stack(distances).argmin(0))


def test_reweighted_is_the_inverse_square_of_the_gradient():
    found = scene(60, sigma=0.5)
    S = dyn.fit(SM, *found.views).tensor
    x = torch.cat(found.views, dim=-1)

    def form(x):
        return dyn.core.algebraic(SM, S, x[None, :2], x[None, 2:])[0]

    square = torch.func.vmap(torch.func.grad(form))(x).square().sum(-1)
    expected = 1 / (square / square.median()).clamp(min=1e-3)
    torch.testing.assert_close(SM.reweight(S, *found.views), expected, rtol=1e-6, atol=1e-9)


@pytest.mark.slow
def test_reweighted_fit_and_refinement_label_better():
    found = scene(100, batch=12, sigma=0.3)
    linear = dyn.fit(SM, *found.views)
    refined = dyn.refine(linear, *found.views)
    weighted = linear
    for _ in range(4):
        weighted = dyn.fit(SM, *found.views, weights=SM.reweight(weighted.tensor, *found.views))

    def share(S):
        return wrong(SM.labels(*SM.fundamentals(S), *found.views), found.labels).mean()

    assert share(weighted.tensor) < share(linear.tensor)
    assert share(refined.tensor) < 0.3 * share(weighted.tensor)
    assert pair_error(SM.fundamentals(refined.tensor), found.motion).median() < 0.05


@pytest.mark.parametrize(("options", "nullity"), [({"planar": (1,)}, 3), ({"planar": (1, 2)}, 9), ({"bodies": 1}, 9)])
def test_degenerate_bodies_are_never_ok(options, nullity):
    exact = scene(80, batch=4, **options)
    solution = dyn.fit(SM, *exact.views)
    assert (solution.status == dyn.Status.DEGENERATE).all() and solution.tensor.abs().max() == 0
    values = solution.singular_values
    assert (values[:, 36 - nullity] < 1e-9 * values[:, 0]).all() and (values[:, 35 - nullity] > 1e-7 * values[:, 0]).all()
    noisy = scene(80, batch=4, sigma=0.3, **options)
    assert (dyn.fit(SM, *noisy.views).status == dyn.Status.AMBIGUOUS).all()
