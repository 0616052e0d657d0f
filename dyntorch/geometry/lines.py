r"""Line cameras: how a camera maps the lines of space to the lines of its image, and back from such maps to cameras of points."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dyntorch.geometry.extensors import common_point, compound, compound_rows, dual, plucker_form, skew_line
from dyntorch.geometry.homogeneous import unit
from dyntorch.numerics.nullspace import eigh, null_space

# ----------------------------------------------------------------------------------------------------------------------
# The Klein quadric :math:`L^T J L = 0`: which vectors of R^6 are lines of space, and where a collineation of P^5 has put them.


VIEWS = 5
"""Line cameras that determine the quadric: the planes of the lines through their centres meet two by two in a point, so v of
them lay 6 v - v (v - 1) / 2 independent conditions on its 21 coefficients: 18 from four, 20 from five (measured ranks)."""
INDEPENDENT = 1e-10  # smallest over largest entry on the diagonal of the stack's triangular factor


def nearest_line(vector: Tensor) -> Tensor:
    r"""The line that is nearest to a vector of R^6, of norm 1. vector ``(*batch, 6)`` -> ``(*batch, 6)``."""
    turned = vector @ plucker_form(dtype=vector.dtype, device=vector.device)
    plus, minus = vector + turned, vector - turned
    size, other = plus.norm(dim=-1, keepdim=True), minus.norm(dim=-1, keepdim=True)
    some = (size > 0) & (other > 0)
    line = plus / torch.where(some, size, 1.0) + minus / torch.where(some, other, 1.0)
    return torch.where(some, line / math.sqrt(2), 0.0)


def lines_of_pencil(first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
    r"""The two lines among :math:`\cos\theta\, e_1 + \sin\theta\, e_2`: where a line of P^5 meets the Klein quadric. first
    ``(*batch, 6)``, second ``(*batch, 6)`` -> ``(*batch, 2, 6)``."""
    form = plucker_form(dtype=first.dtype, device=first.device)
    q11, q12, q22 = (((a @ form) * b).sum(-1) for a, b in ((first, first), (first, second), (second, second)))
    middle, half = (q11 + q22) / 2, (q11 - q22) / 2
    radius = (half.square() + q12.square()).sqrt()
    ratio = -middle / torch.where(radius > 0, radius, 1.0)
    # the derivative of acos at 1 is infinite
    spread = ratio.clamp(1e-15 - 1, 1 - 1e-15).acos()
    angle = (torch.atan2(q12, half)[..., None] + torch.stack([spread, -spread], dim=-1)) / 2
    vectors = angle.cos()[..., None] * first[..., None, :] + angle.sin()[..., None] * second[..., None, :]
    return nearest_line(vectors), middle.abs() <= radius


def klein_frame(projections: Tensor) -> Tensor:
    r"""The collineation G of P^5 that makes line cameras of projections known up to one: :math:`M_i G`. projections
    ``(*batch, views, 3, 6)`` -> ``(*batch, 6, 6)``."""
    if projections.ndim < 3 or projections.shape[-2:] != (3, 6) or projections.shape[-3] < VIEWS:
        raise ValueError(
            f"projections must be (*batch, views, 3, 6) with {VIEWS} or more views, got {tuple(projections.shape)}; "
            "fewer leave a family of quadrics, give more views"
        )
    stack, upper, good = _balance(projections.double())
    symmetric = _quadric(stack)
    values, vectors = eigh(symmetric)
    form = plucker_form(device=projections.device)
    # the eigenvectors of J, ascending as those of S: the isometry between them is one of many, and any will do
    turn = torch.linalg.eigh(form).eigenvectors
    frame = vectors * values.abs().sqrt()[..., None, :] @ turn.mT
    rays = stack @ frame[..., None, :, :]
    frame = torch.where((_concurrence(rays @ form) <= _concurrence(rays))[..., None, None], frame, frame @ form)
    found = torch.linalg.solve_triangular(upper, frame, upper=True)
    return torch.where(good, found, 0.0).to(projections.dtype)


def _balance(projections: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Projections in a frame of P^5 where their stack is orthonormal, the triangular change of frame, and where there is one."""
    size = torch.linalg.matrix_norm(projections, keepdim=True)
    scaled = projections / torch.where(size > 0, size, 1.0)
    whole = scaled.isfinite().flatten(-3).all(-1)[..., None, None]
    eye = torch.eye(6, dtype=scaled.dtype, device=scaled.device)
    other = eye.repeat(scaled.shape[-3], 1)[: 3 * scaled.shape[-3]]
    orthonormal, upper = torch.linalg.qr(torch.where(whole, scaled.flatten(-3, -2), other))
    diagonal = upper.diagonal(dim1=-2, dim2=-1).abs()
    good = whole & (diagonal.amin(-1) > INDEPENDENT * diagonal.amax(-1))[..., None, None]
    return orthonormal.unflatten(-2, (-1, 3)), torch.where(good, upper, eye), good


def _quadric(stack: Tensor) -> Tensor:
    """Symmetric S of norm 1 with M S M^T = 0 for all views, ``(*batch, 6, 6)``."""
    i, j = torch.triu_indices(6, 6, device=stack.device)
    r, s = torch.triu_indices(3, 3, device=stack.device)
    # in an orthonormal basis of the symmetric matrices an entry off the diagonal counts twice
    twice = torch.where(i == j, 1.0, math.sqrt(2)).to(stack)
    left, right = stack[..., r, :], stack[..., s, :]
    rows = (left[..., i] * right[..., j] + left[..., j] * right[..., i]) * torch.where(i == j, 0.5, twice.reciprocal())
    entries = null_space(rows.flatten(-3, -2))[..., 0, :] / twice
    place = torch.zeros(6, 6, dtype=torch.long, device=stack.device)
    place[i, j] = place[j, i] = torch.arange(len(i), device=stack.device)
    return entries[..., place]


def _concurrence(lines: Tensor) -> Tensor:
    """How far the lines ``(*batch, views, 3, 6)`` of the views are from having a common point each, ``(*batch,)``."""
    planes = skew_line(lines @ plucker_form(dtype=lines.dtype, device=lines.device))
    points = common_point(lines)
    return (planes @ points[..., None, :, None]).square().sum((-3, -2, -1)).div(lines.square().sum((-2, -1))).sum(-1)


def line_camera(camera: Tensor) -> Tensor:
    r"""The projection of lines, :math:`l \sim M L`, of a projection of points: :math:`M (A \wedge B) = (P A) \times (P B)`.

    Its rows are the 2-minors of pairs of rows of P, the "meets" of the planes that these rows stand for: a line L meets the
    ray of the image point x iff :math:`x^T M L = 0`.

    Args:
        camera: ``(*batch, 3, 4)`` P, points of space to points of the image, of any scale.

    Returns:
        ``(*batch, 3, 6)`` M, of the square of that scale; lines in the order 01, 02, 03, 12, 13, 23.

    Raises:
        ValueError: another shape.

    Source: thesis section 1.3; Avidan and Shashua 2000, "Trajectory triangulation".

    Example:
        >>> import torch
        >>> line_camera(torch.eye(3, 4)).int().tolist()
        [[0, 0, 0, 1, 0, 0], [0, -1, 0, 0, 0, 0], [1, 0, 0, 0, 0, 0]]
    """
    if camera.ndim < 2 or camera.shape[-2:] != (3, 4):
        raise ValueError(f"camera must be (*batch, 3, 4), points of space to points of the image, got {tuple(camera.shape)}")
    return dual(compound(camera, 2).mT, 3, 2).mT


def camera_of_lines(matrix: Tensor) -> Tensor:
    r"""The camera of points whose line camera is given up to scale: the inverse of :func:`line_camera`. matrix
    ``(*batch, 3, 6)`` -> ``(*batch, 3, 4)``."""
    if matrix.ndim < 2 or matrix.shape[-2:] != (3, 6):
        raise ValueError(f"matrix must be (*batch, 3, 6), lines of space to lines of the image, got {tuple(matrix.shape)}")
    good = (matrix.isfinite().flatten(-2).all(-1) & (matrix.abs().amax((-1, -2)) > 0))[..., None, None]
    standard = line_camera(torch.eye(3, 4, dtype=torch.float64, device=matrix.device))
    safe = torch.where(good, matrix.double(), standard)
    lines = dual((safe / torch.linalg.matrix_norm(safe, keepdim=True)).mT, 3, 1).mT
    rows, ratio = compound_rows(lines, 3)
    k01, k02, k12 = ratio.unbind(-1)
    scale = torch.stack([k01 * k02, k01 * k12, k02 * k12], dim=-1)
    return torch.where(good, unit(scale[..., None] * rows), 0.0).to(matrix.dtype)


def cameras_of_lines(projections: Tensor) -> Tensor:
    r"""Cameras from projections P^5 to P^2 of lines that are known up to one collineation of P^5, as a tensor gives them.
    projections ``(*batch, views, 3, 6)`` -> ``(*batch, views, 3, 4)``."""
    return camera_of_lines(projections @ klein_frame(projections)[..., None, :, :])
