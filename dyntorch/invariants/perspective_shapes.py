"""Dynamic shape tensors of projective cameras: what :class:`~dyntorch.DynamicShapeTensor` does where views are perspective."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from dyntorch.core.invariant import Estimate
from dyntorch.core.primitives import Equations
from dyntorch.invariants.reprojected_shapes import CameraKind, reprojection_derivative, reprojection_residual
from dyntorch.shapes.basis import Trajectory
from dyntorch.shapes.moving import MAX_UNCERTAINTY, shapes_at
from dyntorch.shapes.projective import fit_perspective_shapes, gauge
from dyntorch.shapes.static import general_rows

Base = tuple[int, int, int, int]
CAMERA = CameraKind()
LEAST = 6
"""Points: any five go anywhere by a camera of the plane."""


def six_rows(measured: Tensor, trajectory: Trajectory, places: tuple[int, ...]) -> Tensor:
    r"""Rows of :math:`p_5^T F(t)\, p_6 = 0` of six of the points, ``(*batch, views, 1, 5 K)``; zero where one is missing."""
    row = general_rows(measured[..., list(places), :3])
    return (trajectory.power(9).rows(measured[..., 0, 3])[..., None, :, None] * row[..., None, :]).flatten(-2)


def equations(n: int, trajectory: Trajectory, base: Base) -> Equations:
    """The linear form of the four basis points and the next two."""
    others = [i for i in range(n) if i not in base]
    rows = partial(six_rows, trajectory=trajectory, places=(*base, *others[:2]))
    return Equations((n, 4), 5 * trajectory.power(9).size, rows)


def freedom(n: int, trajectory: Trajectory) -> int:
    """Numbers behind the tensor: positions of all functions up to translation, less the affine frame of the world."""
    return 3 * trajectory.size * (n - 1) - gauge(trajectory.size)


def estimate(measured: Tensor, weights: Tensor, trajectory: Trajectory) -> Estimate:
    """The shapes of least squares over all points, side by side."""
    with torch.no_grad():
        rows = trajectory.rows(measured[..., 0, 3])
        found = fit_perspective_shapes(measured[..., :2], rows, measured[..., 2], share=weights)
    ambiguous = found.uncertainty > MAX_UNCERTAINTY
    shapes = found.shapes.movedim(-3, -2).flatten(-2)
    return Estimate(shapes, found.few, found.degenerate, ambiguous, found.uncertainty)


def _structure(shapes: Tensor, measured: Tensor, trajectory: Trajectory) -> tuple[Tensor, Tensor]:
    """Homogeneous points ``(*batch, views, n, 4)`` of shapes ``(*batch, B, n, 3)`` at the times of the views, and the functions."""
    rows = trajectory.rows(measured[..., 0, 3])
    return torch.nn.functional.pad(shapes_at(shapes, rows), (0, 1), value=1.0), rows


def whitened_residual(shapes: Tensor, measured: Tensor, scale: Tensor, trajectory: Trajectory) -> Tensor:
    """Reprojection error ``(*batch, views, 2 n)`` of the points of each view at its time, whose camera is found first."""
    structure, _ = _structure(shapes, measured, trajectory)
    return reprojection_residual(structure, measured[..., :3], scale, CAMERA)


def linearize(shapes: Tensor, measured: Tensor, scale: Tensor, trajectory: Trajectory) -> tuple[Tensor, Tensor]:
    """:func:`whitened`, flat, and its derivative ``(b, n 3 B, views 2 n)`` by the shapes side by side."""
    structure, rows = _structure(shapes, measured, trajectory)
    error, slope = reprojection_derivative(structure, measured[..., :3], scale, CAMERA)
    derivative = torch.einsum("bvcnk,bvf->bnfkvc", slope[..., :3], rows)
    return error.flatten(-2), derivative.flatten(1, 3).flatten(2)
