"""Thesis 1.2 and chapter 2: what calibrated cameras make of the homographies of a plane with moving points.

The scenes are written here from the definitions: points on a plane in space, still or on straight lines, cameras K [R | t].
"""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

import dyntorch as dyn
from dyntorch.core.outcome import Status
from dyntorch.geometry.rigid import CommonPlane, plane_motions, rotation_exponential
from dyntorch.tasks.align.result import Alignment
from tests.grid import assert_refused

F64 = torch.float64
K = torch.tensor([[900.0, 0.0, 320.0], [0.0, 880.0, 240.0], [0.0, 0.0, 1.0]], dtype=F64)


def normal_numbers(seed: int, *size: int) -> Tensor:
    return torch.randn(*size, generator=torch.Generator().manual_seed(seed), dtype=F64)


def filmed(
    seed: int, n: int = 60, views: int = 3, sigma: float = 0.0, inner: Tensor = K, still: float = 0.4, turn: float = 0.15,
    move: Tensor | None = None,
) -> tuple[tuple[Tensor, ...], Tensor, Tensor, Tensor]:  # fmt: skip
    """Views ``(n, 2)``, R and t of every one, and the normal of the plane, whose distance from view 1 is 1."""
    n_ = torch.tensor([0.3, -0.5, 1.0], dtype=F64) + 0.1 * normal_numbers(seed, 3)
    n_ = n_ / n_.norm()
    across = torch.linalg.qr(torch.cat([n_[:, None], torch.eye(3, dtype=F64)[:, :2]], 1))[0][:, 1:]
    # the foot of the axis of camera 1, and what moves around it
    centre = torch.tensor([0.0, 0.0, 1.0], dtype=F64) / n_[2]
    plane = 0.2 * normal_numbers(seed + 1, n, 2)
    speed = 0.1 * normal_numbers(seed + 2, n, 2) * (torch.arange(n) >= still * n)[:, None]
    pace = torch.cat([torch.zeros(n, 1, dtype=F64), normal_numbers(seed + 3, n, views - 1).abs() + 0.3], 1).cumsum(1)
    R = rotation_exponential(turn * normal_numbers(seed + 4, views, 3))
    R[0] = torch.eye(3, dtype=F64)
    t = 0.25 * normal_numbers(seed + 5, views, 3) if move is None else move
    t = torch.cat([torch.zeros(1, 3, dtype=F64), t[1:]])
    X = centre + (plane[:, None] + pace[..., None] * speed[:, None]) @ across.mT  # (n, views, 3)
    assert float((X @ n_ - 1).abs().max()) < 1e-12
    image = (X.transpose(0, 1) @ R.mT + t[:, None]) @ inner.mT
    seen = image[..., :2] / image[..., 2:]
    assert float(image[..., 2].min()) > 0
    return tuple(seen + sigma * normal_numbers(seed + 6, views, n, 2)), R, t, n_


def aligned(views: tuple[Tensor, ...], inner: Tensor = K, sigma: float = 0.5) -> Alignment:
    return dyn.align_planar(*views, threshold=3 * sigma, calibration=inner, generator=torch.Generator().manual_seed(0))


def error(found: Alignment, R: Tensor, t: Tensor, n: Tensor) -> float:
    assert found.rotations is not None and found.translations is not None and found.normal is not None
    parts = (found.rotations - R, found.translations - t, found.normal - n)
    return max(float(part.abs().max()) for part in parts)


@pytest.mark.slow
@pytest.mark.parametrize("views", [3, 5])
def test_exact_views_give_rotations_translations_and_the_normal(views: int) -> None:
    """To rounding, in units of the distance of the plane; each camera with its own K."""
    zoom = torch.diag_embed(torch.tensor([[1.0, 1.0, 1.0], [1.2, 1.2, 1.0], [0.8, 0.9, 1.0], [1.1, 1.1, 1.0], [1.0, 1.3, 1.0]]))
    inner = K @ zoom[:views].double()
    for seed in (0, 10):
        seen, R, t, n = filmed(seed, views=views, inner=inner)
        found = aligned(seen, inner)
        assert found.status == Status.OK and error(found, R, t, n) < 1e-8
        assert not {"two_planes", "plane_open", "calibration"} & {str(x.code) for x in found.notices}
        assert found.other_motion is not None and float(found.other_motion.normal.abs().max()) == 0


@pytest.mark.slow
def test_labels_and_homographies_are_those_without_a_calibration() -> None:
    """Bit for bit."""
    seen, *_ = filmed(3, sigma=0.5)
    plain = dyn.align_planar(*seen, generator=torch.Generator().manual_seed(0))
    found = aligned(seen)
    assert torch.equal(plain.collineations, found.collineations) and torch.equal(plain.labels, found.labels)
    assert torch.equal(plain.covariance, found.covariance) and plain.notices == found.notices
    assert plain.rotations is None and plain.translations is None and plain.normal is None and plain.other_motion is None


@pytest.mark.slow
def test_the_error_falls_with_the_matches_and_their_noise() -> None:
    """Medians of three scenes: about as the root of n, and as the noise."""

    def median(n: int, sigma: float) -> float:
        scenes = (filmed(20 * seed, n=n, sigma=sigma) for seed in range(3))
        return sorted(error(aligned(seen, sigma=sigma), R, t, normal) for seen, R, t, normal in scenes)[1]

    rough, many, fine = median(40, 0.5), median(160, 0.5), median(40, 0.05)
    assert rough < 0.03 and many < 0.8 * rough and fine < 0.2 * rough


def test_both_solutions_of_one_homography_compose_it_and_one_is_true() -> None:
    """H = R + t n^T for both, at either side of the plane."""
    R, t, n = rotation_exponential(0.4 * normal_numbers(0, 20, 3)), 0.5 * normal_numbers(1, 20, 3), normal_numbers(2, 20, 3)
    n = n / n.norm(dim=-1, keepdim=True) * n[:, 2:].sign()
    H = R + t[..., None] * n[:, None]
    found = plane_motions(1.7 * H)
    again = found.rotations + found.translations[..., None] * found.normal[..., None, :]
    assert float((again - H[:, None]).abs().max()) < 1e-10
    assert float((found.rotations @ found.rotations.mT - torch.eye(3)).abs().max()) < 1e-12
    near = (found.normal - n[:, None]).norm(dim=-1).amin(-1)
    assert float(near.max()) < 1e-7
    still = plane_motions(R)
    assert float(still.translations.abs().max()) < 1e-12 and float((still.rotations - R[:, None]).abs().max()) < 1e-7


def test_derivatives_of_the_conditions_against_differences() -> None:
    """By turns of the normal and by the entries of the homographies."""
    N, n = torch.eye(3, dtype=F64) + 0.2 * normal_numbers(0, 2, 3, 3, 3), normal_numbers(1, 2, 3)
    n = n / n.norm(dim=-1, keepdim=True)
    C = torch.eye(27, dtype=F64).expand(2, 27, 27)

    def cost(N: Tensor, n: Tensor) -> Tensor:
        """Squares of the conditions, which do not depend on the basis."""
        return CommonPlane(N, C, 0.0).linear(n)[0].square().sum()

    r, turns, by = CommonPlane(N, C, 0.0).linear(n)
    free, direction = N.clone().requires_grad_(), n.clone().requires_grad_()
    slope, turn = torch.autograd.grad(cost(free, direction / direction.norm(dim=-1, keepdim=True)), (free, direction))
    torch.testing.assert_close(slope.flatten(1), 2 * (by.mT @ r[..., None])[..., 0])
    from_turns = 2 * (turns.mT @ r[..., None])[..., 0]
    torch.testing.assert_close(turn.norm(dim=-1), from_turns.norm(dim=-1))


@pytest.mark.slow
def test_a_batch_is_its_loop() -> None:
    """With a calibration for each problem and view; a problem without motion says nothing."""
    scenes = [filmed(seed, sigma=0.3) for seed in (0, 40)]
    seen = tuple(torch.stack([*pair, torch.full_like(pair[0], 5.0)]) for pair in zip(*(s[0] for s in scenes), strict=True))
    both = aligned(seen, K.expand(3, 3, 3, 3), 0.3)
    assert both.rotations is not None and both.translations is not None and both.normal is not None
    for i, (views, *_) in enumerate(scenes):
        one = aligned(views, K, 0.3)
        assert error(one, both.rotations[i], both.translations[i], both.normal[i]) < 1e-2
        assert error(one, *scenes[i][1:]) < 0.03
    assert both.status[2] != Status.OK and all(float(x[2].abs().max()) == 0 for x in (both.rotations, both.normal))
    assert all(bool(x.isfinite().all()) for x in (both.rotations, both.translations, both.normal))


@pytest.mark.parametrize("sigma", [0.0, 0.5])
def test_a_camera_that_only_turns_tells_rotations_and_no_plane(sigma: float) -> None:
    seen, R, _, _ = filmed(1, sigma=sigma, move=torch.zeros(3, 3, dtype=F64))
    found = aligned(seen)
    assert [str(x.code) for x in found.notices] == ["plane_open"] and "move the camera" in found.notices[0].text
    assert found.rotations is not None and float((found.rotations - R).abs().max()) < (1e-7 if sigma == 0 else 0.02)
    assert found.normal is not None and found.translations is not None
    assert float(found.normal.abs().max()) == float(found.translations.abs().max()) == 0


def test_a_camera_at_two_places_leaves_two_planes() -> None:
    """The products of linear forms H^T H - 1 = n w^T + w n^T are the same from one place: n and w may change roles."""
    ahead = torch.tensor([0.03, 0.01, -0.25], dtype=F64)
    _, R, _, _ = filmed(2)
    seen, R, t, n = filmed(2, move=R @ ahead)
    found = aligned(seen)
    assert [str(x.code) for x in found.notices] == ["two_planes"] and found.status == Status.OK
    other = found.other_motion
    assert other is not None and found.normal is not None and found.translations is not None
    w = -(ahead + ahead.square().sum() / 2 * n)
    for truth in (n, w / w.norm()):
        assert min(float((x - truth).norm()) for x in (found.normal, other.normal)) < 1e-6
    assert min(float((x - t).norm()) for x in (found.translations, other.translations)) < 1e-6
    # a third place decides
    move = R @ ahead
    move[2] = torch.tensor([0.2, -0.2, 0.1])
    seen, R, t, n = filmed(2, move=move)
    assert error(aligned(seen), R, t, n) < 1e-8


@pytest.mark.slow
def test_a_wrong_calibration_is_told() -> None:
    """The homographies of two motions have more conditions than unknowns."""
    seen, *_ = filmed(0, n=100, sigma=0.2, views=4)
    assert "calibration" not in {str(x.code) for x in aligned(seen, sigma=0.2).notices}
    wrong = torch.diag(torch.tensor([2.5, 0.6, 1.0], dtype=F64)) @ K
    assert "calibration" in {str(x.code) for x in aligned(seen, wrong, 0.2).notices}


def test_calibrations_of_another_shape_are_refused() -> None:
    seen, *_ = filmed(0)
    assert_refused(
        (lambda: aligned(seen, K[:2]), r"calibration must be a tensor K \(3, 3\) or \(3, 3, 3\), got \(2, 3\)"),
        (lambda: aligned(seen, K.mT), "last row"),
        (lambda: aligned(seen, 0 * K), "invertible"),
    )
