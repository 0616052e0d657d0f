"""Fundamental matrix: Hartley and Zisserman's orientation, rank, epipoles, decomposition, nearest rank two, kornia, gradients."""

import kornia
import torch

from dyntorch import scenes
from dyntorch.geometry.homogeneous import homogeneous
from dyntorch.invariants.fundamental_matrix import FundamentalMatrix
from dyntorch.metrics import relative_error
from tests.draws import random


def scene(n, **options):
    return scenes.two_view(n, generator=torch.Generator().manual_seed(0), **options)


def test_of_cameras_it_is_that_of_kornia():
    P1 = torch.cat([torch.eye(3), torch.zeros(3, 1)], -1).double()
    for seed in range(20):
        P2 = random(3, 4, seed=seed)
        theirs = kornia.geometry.epipolar.fundamental_from_projections(P1[None], P2[None])[0]
        # P1 = [I | 0], P2 = [A | e2]
        assert relative_error(FundamentalMatrix.compose(P2[:, :3], P2[:, 3]), theirs).max() < 1e-10


def test_kornia_finds_the_same_matrix():
    found = scene(20, batch=3)
    theirs = kornia.geometry.epipolar.find_fundamental(found.views[0], found.views[1], torch.ones(3, 20).double())
    residual = torch.einsum(
        "bna,bac,bnc->bn",
        homogeneous(found.views[1]),
        theirs / theirs.flatten(1).norm(dim=1)[:, None, None],
        homogeneous(found.views[0]),
    )
    assert residual.abs().max() < 1e-5
    assert relative_error(theirs, found.motion[0]).max() < 1e-6


def test_decomposition_composes_to_the_matrix_and_is_well_conditioned():
    F = FundamentalMatrix.compose(random(300, 3, 3), random(300, 3, seed=1))
    A, e2 = FundamentalMatrix.decompose(-5 * F)
    assert relative_error(FundamentalMatrix.compose(A, e2), F).max() < 1e-10
    torch.testing.assert_close(A.flatten(1).norm(dim=1), torch.ones(300).double())
    values, own = torch.linalg.svdvals(A), torch.linalg.svdvals(F)
    condition = values[:, 0] / values[:, 2]
    assert (condition < 1.01 * own[:, 0] / own[:, 1]).all()
    again = FundamentalMatrix.decompose(FundamentalMatrix.compose(A, e2))
    torch.testing.assert_close(again, (A, e2), rtol=1e-9, atol=1e-9)
    for i in range(5):
        torch.testing.assert_close(FundamentalMatrix.decompose(-5 * F[i]), (A[i], e2[i]))


def test_decomposition_in_pixels():
    found = scene(10, batch=50)
    F = found.motion[0]
    A, e2 = FundamentalMatrix.decompose(F)
    assert relative_error(FundamentalMatrix.compose(A, e2), F).max() < 1e-12
    lines = kornia.geometry.epipolar.compute_correspond_epilines(found.views[0], FundamentalMatrix.compose(A, e2))
    assert (lines * homogeneous(found.views[1])).sum(-1).abs().max() < 1e-7
    # the true epipoles: where each camera sees the centre of the other
    k = torch.tensor([[700.0, 0, 320], [0, 700, 240], [0, 0, 1]]).double()
    e1, e2 = FundamentalMatrix.epipoles(F)
    t, R = found.extras["translation"], found.extras["rotation"]
    for found_epipole, truth in ((e2, t @ k.T), (e1, (R.mT @ t[..., None])[..., 0] @ k.T)):
        sine = torch.linalg.cross(found_epipole, truth / truth.norm(dim=-1, keepdim=True)).norm(dim=-1)
        assert sine.max() < 1e-8


def test_nearest_rank_two_is_the_truncated_singular_value_decomposition():
    F = random(200, 3, 3)
    u, s, vt = torch.linalg.svd(F)
    clear = s[:, 2] < 0.6 * s[:, 1]
    truncated = u[..., :2] @ (s[..., :2, None] * vt[:, :2])
    found = FundamentalMatrix().constrain(F)
    torch.testing.assert_close(found[clear], truncated[clear], rtol=1e-8, atol=1e-8)
    assert torch.linalg.svdvals(found[clear])[:, 2].max() < 1e-8
    torch.testing.assert_close(FundamentalMatrix().constrain(found[clear]), found[clear], rtol=1e-8, atol=1e-8)
    assert FundamentalMatrix().constrain(torch.eye(3).double()).isfinite().all()


def test_degenerate_matrices_are_never_nan():
    bad = torch.stack([torch.zeros(3, 3), torch.ones(3, 3), torch.eye(3)]).double().requires_grad_()
    A, e2 = FundamentalMatrix.decompose(bad)
    back = FundamentalMatrix.compose(A, e2)
    (back.sum() + FundamentalMatrix().constrain(bad).sum()).backward()
    assert A.isfinite().all() and e2.isfinite().all() and back.isfinite().all() and bad.grad.isfinite().all()
    assert torch.equal(A[0], torch.zeros(3, 3).double())
    assert torch.equal(e2[0], torch.zeros(3).double())
