"""The homography at infinity in closed form, how many planes it takes, and what is left free with fewer."""

import pytest
import torch

from dyntorch.geometry.homogeneous import skew
from dyntorch.tasks.planes.closed_forms import infinity_closed_form, infinity_linear
from tests.dyntorch.tasks.planes.test_rank_one_pencils import error, normal, planes


@pytest.mark.parametrize(
    ("kind", "least"),
    [("generic", 3), ("collinear", 3), ("coplanar", 3), ("both", 5), ("pair", 4), ("triple", 5), ("static", 4)],
)
def test_exact_planes(kind, least):
    for n in (least, least + 1, 8):
        homographies, infinity, *_ = planes(60, n=n, kind=kind, seed=n)
        found, residual = infinity_closed_form(homographies)
        # almost parallel planes, or almost equal epipoles, are among them
        assert error(found, infinity).quantile(0.95) < 1e-6 and error(found, infinity).max() < 1e-3
        assert residual.max() < 1e-4 and residual.median() < 1e-9
        torch.testing.assert_close(torch.linalg.det(found), torch.ones(60).double())


def test_more_planes_than_can_be_tried_exhaustively():
    homographies, infinity, *_ = planes(5, n=14)
    assert error(infinity_closed_form(homographies)[0], infinity).max() < 1e-8


def free_dimensions(n, f, kind, seed=0):
    """Of the homography at infinity, given n planes and f fundamental matrices: by ranks of the Jacobian."""
    _, infinity, e, v, _ = planes(n=max(n, 1), kind=kind, seed=seed)
    bodies = {"pair": [0, 0, *range(2, n)], "triple": [0, 0, 0, *range(3, n)]}.get(kind, list(range(n)))
    shapes = [(3, 3), (n, 3), (n, 3), (n + f,), (f, 3)]
    parts = [infinity, e[:n], v[:n], normal(n + f, seed=3), normal(f, 3, seed=4)]

    def measured(theta):
        pieces = theta.split([torch.Size(s).numel() for s in shapes])
        h, e, v, scales, moving = (piece.reshape(s) for piece, s in zip(pieces, shapes, strict=True))
        seen = scales[:n, None, None] * (h + e[bodies, :, None] * v[:, None, :])
        known = scales[n:, None, None] * (skew(moving) @ h)
        return torch.cat([seen.flatten(), known.flatten()])

    jacobian = torch.func.jacfwd(measured)(torch.cat([part.flatten() for part in parts]))
    values = [torch.linalg.svdvals(m) for m in (jacobian, jacobian[:, 9:])]
    whole, others = (int((s > 1e-10 * s[0]).sum()) for s in values)
    return 9 - (whole - others) - 1  # the scale


TABLE = {(1, 0): 5, (2, 0): 2, (3, 0): 0, (4, 0): 0, (0, 1): 3, (0, 2): 0, (1, 1): 1, (2, 1): 0, (1, 2): 0}


@pytest.mark.parametrize("kind", ["generic", "collinear", "coplanar", "both"])
def test_local_dimensions(kind):
    for (n, f), expected in TABLE.items():
        assert free_dimensions(n, f, kind) == expected + (kind == "both" and (n, f) == (3, 0)), (n, f)


def test_local_dimensions_with_planes_of_one_body():
    assert [free_dimensions(n, 0, "pair") for n in (2, 3, 4)] == [3, 1, 0]
    assert [free_dimensions(n, 0, "triple") for n in (3, 4, 5)] == [3, 1, 0]


def test_noise():
    for kind in ("generic", "collinear"):
        homographies, infinity, *_ = planes(60, n=5, kind=kind)
        noisy = homographies + 1e-3 * normal(60, 5, 3, 3, seed=8)
        closed, linear = (error(method(noisy)[0], infinity).median() for method in (infinity_closed_form, infinity_linear))
        assert closed < 1.5 * linear and closed < 0.01


def test_scales_and_order_do_not_matter():
    homographies = planes(10, n=5)[0] + 1e-3 * normal(10, 5, 3, 3, seed=8)
    found, residual = infinity_closed_form(homographies)
    again, same = infinity_closed_form(homographies * (5 * normal(10, 5, 1, 1, seed=2)))
    torch.testing.assert_close(found, again, atol=1e-6, rtol=1e-6)
    torch.testing.assert_close(residual, same, atol=1e-6, rtol=1e-4)


def test_batch_is_loop_and_bad_problems_stay_alone():
    homographies, infinity, *_ = planes(2, 3, n=5)
    homographies = homographies + 1e-4 * normal(2, 3, 5, 3, 3, seed=8)
    homographies[0, 1, 0] = torch.nan
    homographies[1, 0] = 0.0
    homographies[1, 1] = homographies[1, 1, :1]  # five times the same
    homographies[1, 2] = homographies[1, 2, :, :, :1] * torch.ones(3).double()  # all of rank one
    found, residual = infinity_closed_form(homographies)
    assert found.isfinite().all() and residual.isfinite().all()
    assert error(found, infinity)[0].max() < 0.05
    for j in range(3):
        alone = infinity_closed_form(homographies[0, j, 1:] if j == 1 else homographies[0, j])
        torch.testing.assert_close(found[0, j], alone[0], atol=1e-7, rtol=1e-7)
        torch.testing.assert_close(residual[0, j], alone[1], atol=1e-7, rtol=1e-7)


def test_no_problems_and_too_few_planes():
    found, residual = infinity_closed_form(torch.zeros(0, 3, 3, 3))
    assert found.shape == (0, 3, 3) and residual.shape == (0,)
    with pytest.raises(ValueError, match="at least 3: add 1"):
        infinity_closed_form(torch.rand(2, 3, 3))
