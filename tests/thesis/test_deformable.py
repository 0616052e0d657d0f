"""Thesis 10.1: a deformable shape basis from a second camera; what determines one at all, by exact ranks.

The shapes are written here from the definition, S_t = R_t sum_b c_tb B_b before x = M S + o.
"""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from dyntorch.core.outcome import Status
from dyntorch.geometry.rigid import rotation_exponential
from dyntorch.shapes import deformable_shapes
from experiments.reconstruction.deformable_counts import KINDS, excess
from tests.draws import random as normal


def deforming(T: int, n: int, basis: int, seed: int) -> Tensor:
    """``(T, n, 3)`` about their mean in every frame."""
    points = torch.einsum("tb,bnj->tnj", normal(T, basis, seed=seed), normal(basis, n, 3, seed=seed + 50))
    return points - points.mean(1, keepdim=True)


def seen(points: Tensor, rig: Tensor, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Images in two cameras ``(2, 2, 3)``, with a translation of every frame."""
    x1, x2 = (points @ camera.mT + normal(len(points), 1, 2, seed=seed + i) for i, camera in enumerate(rig))
    return x1, x2


def affine_error(found: Tensor, true: Tensor) -> float:
    """After the best affinity of all frames together."""
    a, b = found.flatten(0, 1), true.flatten(0, 1)
    return float((a @ torch.linalg.lstsq(a, b).solution - b).norm() / b.norm())


def similar_error(found: Tensor, true: Tensor) -> float:
    """After the best similarity (and mirror) of all frames together."""
    u, s, vh = torch.linalg.svd((true.mT @ found).sum(0))
    return float((s.sum() / found.square().sum() * found @ (u @ vh).mT - true).norm() / true.norm())


def test_shapes_coefficients_and_cameras_of_exact_images() -> None:
    """x = M (sum c B) + o returns to the images; the points are right up to one affinity of all frames."""
    points, rig = deforming(25, 12, 3, 0), normal(2, 2, 3, seed=9)
    x1, x2 = seen(points, rig)
    found = deformable_shapes(x1, x2, 3).check()
    assert affine_error(found.points, points) < 1e-9 and not bool(found.metric)
    again = torch.einsum("tb,bnj->tnj", found.coefficients, found.shapes)
    for camera, offset, x in zip(found.cameras, found.offsets, (x1, x2), strict=True):
        assert float((again @ camera.mT + offset[:, None] - x).abs().max()) < 1e-7
    gram = found.coefficients.mT @ found.coefficients / 25
    assert float((gram - torch.eye(3)).abs().max()) < 1e-9 and float(found.shapes.mean(1).abs().max()) < 1e-9


def test_what_one_camera_misses_follows_from_the_basis_and_batch_is_loop() -> None:
    """A quarter of the images of each camera missing: every point at every time is found; float32 stays float32."""
    points = torch.stack([deforming(30, 14, 2, seed) for seed in (1, 2)])
    rig = normal(2, 2, 3, seed=3)
    x1, x2 = points @ rig[0].mT, points @ rig[1].mT
    gone = torch.rand(2, *x1.shape[:-1], generator=torch.Generator().manual_seed(0)) < 0.25
    x1, x2 = x1.masked_fill(gone[0][..., None], torch.nan), x2.masked_fill(gone[1][..., None], torch.nan)
    both = deformable_shapes(x1, x2, 2).check()
    for i in range(2):
        one = deformable_shapes(x1[i], x2[i], 2)
        assert affine_error(one.points, points[i]) < 1e-5 and affine_error(both.points[i], points[i]) < 1e-5
    assert deformable_shapes(x1[0].float(), x2[0].float(), 2).points.dtype == torch.float32


@pytest.mark.slow
@pytest.mark.parametrize("orthographic", [False, True])
def test_constant_lengths_make_it_metric_though_everything_turns(orthographic: bool) -> None:
    """Bones of constant length decide the metric; the basis then explains what is no rotation, and lowers the noise."""
    T, n = 40, 15
    shapes, share = normal(3, n, 3, seed=4), torch.cat([torch.ones(T, 1).double(), 0.3 * normal(T, 2, seed=5)], dim=1)
    shapes[1:, :6] = 0
    turn = rotation_exponential(0.6 * normal(T, 3, seed=6))
    points = torch.einsum("tb,bnj->tnj", share, shapes) @ turn.mT
    points = points - points.mean(1, keepdim=True)
    rig = rotation_exponential(torch.tensor([[0.0, 0.0, 0.0], [0.0, 1.1, 0.1]], dtype=torch.float64))[:, :2]
    pairs = torch.combinations(torch.arange(6))
    x1, x2 = seen(points, rig)
    found = deformable_shapes(x1, x2, 3, lengths=pairs, orthographic=orthographic).check()
    assert bool(found.metric) and similar_error(found.points, points) < 1e-3
    noisy = (x + 0.02 * normal(T, n, 2, seed=7 + i) for i, x in enumerate((x1, x2)))
    found = deformable_shapes(*noisy, 3, lengths=pairs, orthographic=orthographic).check()
    assert similar_error(found.points, points) < 0.02 and 0.015 < float(found.sigma) < 0.025


def test_what_cannot_be_found_has_a_status() -> None:
    """Two cameras that look the same way are one; a pair of points is too few."""
    points, rig = deforming(20, 10, 2, 0), normal(2, 2, 3, seed=1)
    same = torch.stack([rig[0], rig[0].flip(0)])
    found = deformable_shapes(*seen(points, same), 2)
    assert int(found.status) == Status.DEGENERATE and float(found.points.abs().max()) == 0
    with pytest.raises(ValueError, match="both cameras see one projection"):
        found.check()
    assert int(deformable_shapes(*seen(points[:, :3], rig), 2).status) == Status.TOO_FEW
    x1, x2 = seen(points, rig)
    with pytest.raises(ValueError, match="basis must be a whole number"):
        deformable_shapes(x1, x2, 0)
    with pytest.raises(ValueError, match="different points from 0 to 9"):
        deformable_shapes(x1, x2, 2, lengths=torch.tensor([[0, 10], [1, 2]]))


def test_what_determines_a_basis_by_exact_ranks() -> None:
    """A fixed camera leaves the depths of every point in every basis shape; a second camera, or symmetry, or motion, nothing."""
    kinds = {kind.name: kind for kind in KINDS}
    fixed = kinds["one affine camera, fixed"]
    assert excess(fixed, 2, 6, 9) - excess(fixed, 2, 6, 8) == 2
    assert excess(kinds["two affine cameras, fixed"], 2, 6, 8) == 0
    assert excess(kinds["symmetric shapes, one affine camera, fixed"], 2, 6, 8) == 0
    moving = kinds["one affine camera, another in every frame"]
    # 5 (B - 1) conditions of each frame on 8 (B^2 - 1) unknowns: 5 frames for two shapes
    assert excess(moving, 2, 5, 10) == 0 < excess(moving, 2, 4, 10)
