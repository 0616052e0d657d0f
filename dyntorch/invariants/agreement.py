"""Matches that do not move: how far their views are from agreeing under the collineations between them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from dyntorch.core.residual import whiten, whiten_entries
from dyntorch.geometry.extensors import dehomogenize, levi_civita
from dyntorch.geometry.homogeneous import cofactors, homogeneous, null_vectors, unit
from dyntorch.numerics.nullspace import null_space


def static_residual(motion: Sequence[Tensor], views: Sequence[Tensor], scales: Sequence[Tensor]) -> Tensor:
    r"""Whitened disagreement of the views of static points, in view 1: motion ``(*batch, d + 1, d + 1)``, views
    ``(*batch, n, d)``, scales ``(*batch,)`` -> ``(*batch, n, d * collineations)``."""
    # coordinate by coordinate: four times faster than matrices of size 2 or 3 (measured, forward mode over 18 parameters)
    first = views[0].unbind(-1)
    shared = scales[0].square()[..., None]
    errors: list[Tensor] = []
    covariance: list[list[Tensor | float]] = []
    for a, (matrix, x, scale) in enumerate(zip(motion, views[1:], scales[1:], strict=True)):
        image, slopes = _image(matrix, x.unbind(-1), scale[..., None])
        errors += [y - z for y, z in zip(image, first, strict=True)]
        for i, row in enumerate(slopes):
            others = [shared if j == i else 0.0 for _ in range(a) for j in range(len(image))]
            own = [_dot(row, slopes[j]) + (shared if j == i else 0.0) for j in range(i + 1)]
            covariance.append([*others, *own])
    return torch.stack(whiten_entries(errors, covariance), dim=-1)


def _image(matrix: Tensor, x: Sequence[Tensor], scale: Tensor) -> tuple[list[Tensor], list[list[Tensor]]]:
    """Coordinates ``(*batch, n)`` of the images of points, and their derivatives by the coordinates of x, times ``scale``."""
    d = len(x)
    entry = [[matrix[..., i, k, None] for k in range(d + 1)] for i in range(d + 1)]
    y = [sum((e * c for e, c in zip(row[:d], x, strict=True)), start=row[d]) for row in entry]
    # at infinity the same finite stand-in as in inhomogeneous()
    floor = torch.finfo(matrix.dtype).eps * torch.stack([c.detach().abs() for c in y]).amax(0)
    depth = torch.where(y[d].abs() > floor, y[d], torch.where(floor > 0, torch.copysign(floor, y[d].detach()), 1.0))
    image = [c / depth for c in y[:d]]
    unit = scale / depth
    return image, [[(entry[i][k] - image[i] * entry[d][k]) * unit for k in range(d)] for i in range(d)]


def _dot(first: Sequence[Tensor], second: Sequence[Tensor]) -> Tensor:
    products = [a * b for a, b in zip(first, second, strict=True)]
    return sum(products[1:], start=products[0])


def point_error(image: Tensor, derivative: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    r"""Difference :math:`\pi(y) - x` and the derivative of :math:`\pi(y)` with respect to the coordinates that y came from.

    Args:
        image: ``(*batch, n, d + 1)`` homogeneous points y, any scale.
        derivative: ``(*batch, n, d + 1, d + 1)`` derivative of y with respect to the homogeneous source point, at the same
            scale; multiples of y in it do not matter.
        x: ``(*batch, n, d)``.

    Returns:
        ``(*batch, n, d)`` and ``(*batch, n, d, d)``.
    """
    y, jacobian = dehomogenize(image, derivative[..., :-1])
    return y - x, jacobian


def whitened_agreement(parts: Sequence[tuple[Tensor, Tensor]], scales: Sequence[Tensor]) -> Tensor:
    """Whiten errors that share the noise of view 1. parts ``(*batch, n, d)``, scales ``(*batch,)`` ->
    ``(*batch, n, d * parts)``."""
    variances = [s.square()[..., None, None, None] for s in scales]
    covariances = [variance * _outer(jacobian) for (_, jacobian), variance in zip(parts, variances[1:], strict=True)]
    eye = torch.eye(covariances[0].shape[-1], dtype=covariances[0].dtype, device=covariances[0].device)
    shared = (variances[0] * eye).expand_as(covariances[0])
    rows = [torch.cat([shared + own if b == a else shared for b in range(len(parts))], dim=-1) for a, own in enumerate(covariances)]
    return whiten(torch.cat([error for error, _ in parts], dim=-1), torch.cat(rows, dim=-2))


def _outer(jacobian: Tensor) -> Tensor:
    """J J^T entry by entry: one pass, where a product of matrices would loop over them."""
    return (jacobian[..., :, None, :] * jacobian[..., None, :, :]).sum(-1)


# ----------------------------------------------------------------------------------------------------------------------
# What a three-view tensor of the form eps(A, B) tells by contraction alone: static maps between views, and the third vector.


AXES = "ijk"


def static_map(tensor: Tensor, vectors: Tensor, source: int, target: int) -> Tensor:
    """Static homogeneous vectors ``(*batch, n, 3)`` of one view carried to another, in float64."""
    return null_vectors(_contraction(tensor, vectors, source, target))[0]


def static_map_derivative(tensor: Tensor, vectors: Tensor, source: int, target: int) -> tuple[Tensor, Tensor]:
    r"""Image y of :func:`static_map` and its derivative ``(*batch, n, 3, 3)`` by the source vector, up to multiples of y."""
    matrix = _contraction(tensor, vectors, source, target)
    left, right = null_vectors(matrix)
    size = torch.linalg.matrix_norm(matrix, keepdim=True)
    full = matrix + size * left[..., :, None] * right[..., None, :]
    cofactor = cofactors(full)
    det = (cofactor[..., 0] * full[..., 0]).sum(-1)[..., None, None]
    # a determinant of zero means a tensor of zeros, or of lower rank: it maps nothing
    inverse = cofactor / torch.where(det == 0, torch.ones_like(det), det)
    other = AXES[6 - source - target - 1]
    change = torch.einsum(f"...{AXES},...n{AXES[target - 1]}->...n{other}{AXES[source - 1]}", tensor.double(), left)
    return left, -inverse @ change


def third_vector(tensor: Tensor, a: Tensor, b: Tensor, view: int) -> Tensor:
    """Contract the two views other than ``view`` with vectors ``(*batch, n, 3)``, in float64."""
    if view not in (1, 2, 3):
        raise ValueError(f"view must be 1, 2 or 3, got {view}")
    first, second = (axis for axis in AXES if axis != AXES[view - 1])
    return torch.einsum(f"...{AXES},...n{first},...n{second}->...n{AXES[view - 1]}", tensor.double(), a.double(), b.double())


def _contraction(tensor: Tensor, vectors: Tensor, source: int, target: int) -> Tensor:
    """``(*batch, n, 3, 3)``: axes of the target view and of the remaining one, in float64."""
    if {source, target} - {1, 2, 3} or source == target:
        raise ValueError(f"source and target must be two different views of 1, 2, 3, got {source} and {target}")
    to, other = AXES[target - 1], AXES[6 - source - target - 1]
    return torch.einsum(f"...{AXES},...n{AXES[source - 1]}->...n{to}{other}", tensor.double(), vectors.double())


def unit_normal(line: Tensor) -> Tensor:
    """The line with a unit normal; the line at infinity, which has none, is kept finite, and zero stays zero."""
    floor = torch.finfo(line.dtype).eps * line.detach().abs().amax(dim=-1, keepdim=True)
    size = torch.maximum(torch.linalg.vector_norm(line[..., :2], dim=-1, keepdim=True), floor)
    return line / torch.where(size > 0, size, torch.ones_like(size))


# ----------------------------------------------------------------------------------------------------------------------
# Three points on one straight line of space, seen from three poses: the mathematics that all join tensors share.


def join_forms(a: Tensor, b: Tensor, v: Tensor) -> Tensor:
    r"""The forms :math:`J_{ijk} = \epsilon_{ilmu} A_{lj} B_{mk} V_u`, that is :math:`J(p, q, r) = \det[p, A q, B r, V]`. a
    ``(*batch, 4, columns of A)``, b ``(*batch, 4, columns of B)``, v ``(*batch, 4)`` ->
    ``(*batch, 4, columns of A, columns of B)``."""
    epsilon = levi_civita(4, dtype=a.dtype, device=a.device)
    return torch.einsum("ilmu,...u,...lj,...mk->...ijk", epsilon, v, a, b)


def motion_of_forms(forms: Tensor) -> tuple[Tensor, Tensor]:
    r"""The motion (A, B) behind several forms :math:`\det[p, A q, B r, V_c]`, linearly and uniquely. forms
    ``(*batch, c, 4, 4, 4)`` -> ``(*batch, 4, 4)``."""
    slices = torch.stack([forms.movedim(-1, -3), forms.movedim(-2, -3)])
    A, B = skew_partner(slices.flatten(-4, -3)).unbind(0)
    return A, B


def skew_partner(slices: Tensor) -> Tensor:
    """The matrix X ``(*batch, N, N)`` for which X^T S is skew, for all S in ``(*batch, slices, N, N)``; norm 1, canonical sign."""
    size = slices.shape[-1]
    rows, columns = torch.triu_indices(size, size, device=slices.device)
    s = slices.mT  # column n of S is s[n]
    eye = torch.eye(size, dtype=slices.dtype, device=slices.device)
    # entry (m, n) of X^T S + S^T X as a function of X[l, x]: S[l, n] where x = m, and S[l, m] where x = n
    system = s[..., columns, :, None] * eye[rows, None, :] + s[..., rows, :, None] * eye[columns, None, :]
    # an equation off the diagonal stands for two: with its weight a rotation of the coordinates changes nothing
    system = system * torch.where(rows == columns, 1.0, 2**0.5).to(s)[:, None, None]
    return unit(null_space(system.flatten(-2).flatten(-3, -2))[..., 0, :].unflatten(-1, (size, size)))


def collinearity(motion: tuple[Tensor, ...], views: tuple[Tensor, ...], scales: tuple[Tensor, ...]) -> Tensor:
    r"""Whitened distance of each match from lying on one straight line: 3 coordinates of a vector normal to that line. motion
    ``(*batch, 4, 4)``, views ``(*batch, n, 3)``, scales ``(*batch,)`` -> ``(*batch, n, 3)``."""
    # x2 - x1 and x3 - x1 in view 1, with their derivatives by the coordinates of view 2 and 3
    (two, ja), (three, jb) = (
        point_error(homogeneous(x) @ matrix.mT, matrix[..., None, :, :], views[0])
        for matrix, x in zip(motion, views[1:], strict=True)
    )
    u, v = -three / math.sqrt(2), (three - 2 * two) / math.sqrt(6)
    cos, sin = _principal(u, v)
    along, error = cos * u + sin * v, cos * v - sin * u
    weights = (cos / math.sqrt(6) - sin / math.sqrt(2), -2 * cos / math.sqrt(6), cos / math.sqrt(6) + sin / math.sqrt(2))
    w1, w2, w3 = ((w * s[..., None, None]).square()[..., None] for w, s in zip(weights, scales, strict=True))
    eye = torch.eye(3, dtype=ja.dtype, device=ja.device)
    return _whiten_normal(error, _direction(along), w1 * eye + w2 * (ja @ ja.mT) + w3 * (jb @ jb.mT))


def _principal(u: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
    """Cosine and sine of the turn that makes two vectors orthogonal, the first one the longer; no turn if both are 0."""
    double = torch.stack([u.square().sum(-1) - v.square().sum(-1), 2 * (u * v).sum(-1)], dim=-1)
    none = (double == 0).all(-1)
    angle = 0.5 * torch.atan2(torch.where(none, 0.0, double[..., 1]), torch.where(none, 1.0, double[..., 0]))[..., None]
    return angle.cos(), angle.sin()


def _direction(vector: Tensor) -> Tensor:
    """Unit vector; the first axis for the zero vector."""
    square = vector.square().sum(-1, keepdim=True)
    none = square < torch.finfo(vector.dtype).tiny
    axis = torch.eye(3, dtype=vector.dtype, device=vector.device)[0]
    return torch.where(none, axis, vector * torch.where(none, 1.0, square).rsqrt())


def _whiten_normal(error: Tensor, direction: Tensor, covariance: Tensor) -> Tensor:
    """The symmetric root of the inverse covariance within the plane normal to the direction, times an error in that plane."""

    def apply(x: Tensor) -> Tensor:
        return (covariance @ x[..., None])[..., 0]

    def dot(x: Tensor, y: Tensor) -> Tensor:
        return (x * y).sum(-1, keepdim=True)

    r0, r1, r2 = covariance.unbind(-2)
    adjugate = torch.stack([torch.linalg.cross(r1, r2), torch.linalg.cross(r2, r0), torch.linalg.cross(r0, r1)], dim=-2)
    # not negative but for rounding, where the line passes through infinity
    trace = (covariance.diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True) - dot(direction, apply(direction))).clamp(min=0.0)
    det = dot(direction, (adjugate @ direction[..., None])[..., 0]).clamp(min=0.0)
    info = torch.finfo(error.dtype)
    root = (det + (info.eps * trace).square() + info.tiny).sqrt()  # a singular motion leaves a large residual, not an infinite one
    moved = apply(error)
    moved = moved - dot(direction, moved) * direction
    return ((trace + root) * error - moved) / (root * (trace + 2 * root).sqrt())
