"""The linear equations for the extensor of the homography at infinity: their ranks, and what they solve."""

import pytest
import torch

from dyntorch.geometry.extensors import extensor_of, wedge
from dyntorch.geometry.homogeneous import skew
from dyntorch.tasks.planes import closed_forms as infinity_extensors
from dyntorch.tasks.planes.closed_forms import infinity_linear, infinity_thesis
from tests.dyntorch.tasks.planes.test_rank_one_pencils import error, normal, planes

KINDS = ["generic", "collinear", "coplanar", "both", "pair", "triple", "static"]
LINEAR = {  # nullity for 4, 5, 6, 8 planes
    "generic": (1, 1, 1, 1),
    "collinear": (1, 1, 1, 1),
    "coplanar": (1, 1, 1, 1),
    "both": (6, 3, 2, 2),
    "pair": (1, 1, 1, 1),
    "triple": (4, 1, 1, 1),
    "static": (3, 1, 1, 1),
}
THESIS = {  # for 5, 6, 8 planes
    "generic": (1, 1, 1),
    "collinear": (9, 8, 7),
    "coplanar": (6, 1, 1),
    "both": (14, 11, 10),
    "pair": (1, 1, 1),
    "triple": (9, 1, 1),
    "static": (6, 1, 1),
}


def nullities(spectrum):
    assert (spectrum.diff() <= 0).all()
    return set((spectrum < 1e-11 * spectrum[..., :1]).sum(-1).tolist())


@pytest.mark.parametrize("kind", KINDS)
def test_ranks_of_degenerate_planes(kind):
    for n, linear in zip((4, 5, 6, 8), LINEAR[kind], strict=True):
        homographies, infinity, *_ = planes(3, n=n, kind=kind, seed=10 * n)
        found, spectrum = infinity_linear(homographies)
        assert nullities(spectrum) == {linear}, (n, spectrum[:, -8:])
        assert (error(found, infinity).max() < 1e-8) == (linear == 1)
    for n, full in zip((5, 6, 8), THESIS[kind], strict=True):
        homographies, infinity, *_ = planes(2, n=n, kind=kind, seed=10 * n)
        found, spectrum = infinity_thesis(homographies)
        assert nullities(spectrum) == {full}, (n, spectrum[:, -16:])
        assert (error(found, infinity).max() < 1e-7) == (full == 1)


def test_ranks_of_few_planes(monkeypatch):
    monkeypatch.setattr(infinity_extensors, "check_homographies", lambda *_: None)
    for n, linear, full in ((1, 20, 20), (2, 39, 39), (3, 56, 57), (4, 63, 74), (5, 63, 83)):
        homographies = planes(3, n=n, seed=n)[0]
        assert nullities(infinity_linear(homographies)[1]) == {64 - linear}
        assert nullities(infinity_thesis(homographies)[1]) == {84 - full}


def test_ranks_with_fundamental_matrices(monkeypatch):
    monkeypatch.setattr(infinity_extensors, "check_homographies", lambda *_: None)
    for n, f, nullity in ((0, 1, 10), (0, 2, 1), (0, 3, 1), (1, 1, 3), (2, 1, 1), (3, 1, 1), (1, 2, 1), (4, 2, 1)):
        homographies, infinity, _, _, fundamentals = planes(3, n=n, f=f, seed=7)
        found, spectrum = infinity_linear(homographies, fundamentals=fundamentals)
        assert nullities(spectrum) == {nullity}, (n, f)
        assert (error(found, infinity).max() < 1e-9) == (nullity == 1)


def test_the_invariant_basis_is_what_extensors_of_homographies_span():
    basis = infinity_extensors._invariant_basis(torch.device("cpu"))
    assert basis.shape == (64, 84)
    torch.testing.assert_close(basis @ basis.T, torch.eye(64).double())
    axes = skew(torch.eye(3).double())
    extensors = extensor_of((axes @ normal(90, 1, 3, 3)).flatten(-2))
    torch.testing.assert_close(extensors @ basis.T @ basis, extensors)
    assert torch.linalg.matrix_rank(extensors) == 64


def test_spaces_of_fundamental_matrices_meet():
    # the transversal: F_i = [e_i]x Hinf lies in S(H_i) and in S(Hinf)
    homographies, infinity, e, *_ = planes(n=4)
    axes = skew(torch.eye(3).double())
    of_planes = extensor_of((axes @ homographies[:, None]).flatten(-2))
    of_infinity = extensor_of((axes @ infinity).flatten(-2))
    body = (skew(e) @ infinity).flatten(-2)
    assert wedge(of_infinity, of_planes, 9, (3, 3)).abs().max() < 1e-12
    for extensor in (of_infinity, of_planes):
        assert wedge(extensor, body, 9, (3, 1)).abs().max() < 1e-12
    assert wedge(of_planes[0], of_planes[1], 9, (3, 3)).abs().max() > 1e-3


def test_scales_weights_and_bad_planes():
    homographies, infinity, *_ = planes(4, n=6)
    scaled = homographies * (10 * normal(4, 6, 1, 1, seed=3))
    torch.testing.assert_close(infinity_linear(homographies)[0], infinity_linear(scaled)[0])
    weights = torch.rand(4, 6, generator=torch.Generator().manual_seed(0)).double()
    homographies[:, 2], weights[:, 2] = normal(4, 3, 3, seed=4), 0.0
    assert error(infinity_linear(homographies, weights)[0], infinity).max() < 1e-9
    # a plane that is not finite is one fewer, and spoils nothing
    homographies[:, 2] = torch.nan
    found, spectrum = infinity_linear(homographies)
    assert error(found, infinity).max() < 1e-9
    homographies[1:3] = torch.inf
    found, spectrum = infinity_linear(homographies)
    assert found.isfinite().all() and spectrum.isfinite().all() and (spectrum[1:3] == 0).all()
    assert error(found, infinity)[[0, 3]].max() < 1e-9
    found, _ = infinity_thesis(homographies)
    assert found.isfinite().all() and error(found, infinity)[[0, 3]].max() < 1e-9


def test_batch_is_loop():
    homographies = (planes(2, 3, n=5)[0] + 0.01 * normal(2, 3, 5, 3, 3, seed=5)).requires_grad_(False)
    for method in (infinity_linear, infinity_thesis):
        found, spectrum = method(homographies)
        for i in range(2):
            for j in range(3):
                alone = method(homographies[i, j])
                torch.testing.assert_close(found[i, j], alone[0], atol=1e-7, rtol=1e-7)
                torch.testing.assert_close(spectrum[i, j], alone[1], atol=1e-9, rtol=1e-7)


@pytest.mark.slow
def test_gradients():
    homographies = planes(n=5)[0] + 0.01 * normal(5, 3, 3, seed=5)
    assert torch.autograd.gradcheck(lambda h: infinity_linear(h)[0], (homographies.requires_grad_(),), atol=1e-4, rtol=1e-3)


def test_noise_is_less_than_in_the_method_of_the_thesis():
    homographies, infinity, *_ = planes(30, n=5)
    noisy = homographies + 1e-3 * normal(30, 5, 3, 3, seed=8)
    assert error(infinity_linear(noisy)[0], infinity).median() < 0.7 * error(infinity_thesis(noisy)[0], infinity).median()


def test_refusals():
    with pytest.raises(ValueError, match="at least 4: add 1"):
        infinity_linear(torch.rand(3, 3, 3))
    with pytest.raises(ValueError, match="at least 5: add 1"):
        infinity_thesis(torch.rand(4, 3, 3))
    with pytest.raises(ValueError, match="at least 2: add 1"):
        infinity_linear(torch.rand(1, 3, 3), fundamentals=torch.rand(1, 3, 3))
    with pytest.raises(ValueError, match="weights must be"):
        infinity_linear(torch.rand(4, 3, 3), torch.ones(3))
