"""Collineations: rank of the rows, round trip, transfer, residual, kornia and OpenCV's direction."""

import kornia
import pytest
import torch

from dyntorch import scenes
from dyntorch.invariants.collineation import Collineation
from tests.draws import random


def scene(n, matches, **options):
    return scenes.collineation(n, matches, generator=torch.Generator().manual_seed(0), **options)


def test_class_stands_for_the_plane_and_maps_view_two_to_view_one():
    assert Collineation.minimal() == 4
    assert Collineation().n == 2
    assert repr(Collineation(3)) == "Collineation(n=3)"
    with pytest.raises(ValueError, match="got 0"):
        Collineation(0)
    found = scene(3, 20, batch=4)
    torch.testing.assert_close(Collineation.transfer(-2 * found.motion[0], found.views[1]), found.views[0])


def test_kornia_and_opencv_map_their_first_points_to_their_second():
    cv2 = pytest.importorskip("cv2")
    x1, x2 = scene(2, 30).views
    theirs = kornia.geometry.find_homography_dlt(x2[None], x1[None])[0]
    torch.testing.assert_close(Collineation.transfer(theirs, x2), x1, rtol=1e-4, atol=1e-4)
    matrix, _ = cv2.findHomography(x2.numpy(), x1.numpy())
    torch.testing.assert_close(Collineation.transfer(torch.from_numpy(matrix), x2), x1, rtol=1e-6, atol=1e-6)


def test_zero_is_never_nan():
    zero = torch.zeros(2, 3, 3).double().requires_grad_()
    x = random(2, 4, 2)
    one = (torch.ones(2).double(),) * 2
    out = Collineation(2).whitened_residual((Collineation.compose(Collineation.decompose(zero)),), (x, x), one)
    out.sum().backward()
    assert out.isfinite().all()
    assert zero.grad.isfinite().all()
    assert torch.equal(Collineation.decompose(zero), zero)
