"""Three points on one straight line of space, seen from three poses: the mathematics that all join tensors share."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dyntorch.algebra.extensors import levi_civita
from dyntorch.algebra.homogeneous import homogeneous, unit
from dyntorch.invariants.agreement import point_error
from dyntorch.nullspace import null_space


def join_forms(a: Tensor, b: Tensor, v: Tensor) -> Tensor:
    r"""The forms :math:`J_{ijk} = \epsilon_{ilmu} A_{lj} B_{mk} V_u`, that is :math:`J(p, q, r) = \det[p, A q, B r, V]`.

    Args:
        a: ``(*batch, 4, columns of A)``.
        b: ``(*batch, 4, columns of B)``.
        v: ``(*batch, 4)``; all batch dimensions broadcast.

    Returns:
        ``(*batch, 4, columns of A, columns of B)``.

    Source: thesis section 8.2 (join tensors).

    Example:
        >>> eye = torch.eye(4, dtype=torch.float64)
        >>> float(join_forms(eye, eye, eye[3])[0, 1, 2])
        1.0
    """
    epsilon = levi_civita(4, dtype=a.dtype, device=a.device)
    return torch.einsum("ilmu,...u,...lj,...mk->...ijk", epsilon, v, a, b)


def motion_of_forms(forms: Tensor) -> tuple[Tensor, Tensor]:
    r"""The motion (A, B) behind several forms :math:`\det[p, A q, B r, V_c]`, linearly and uniquely.

    A slice :math:`S = J_c(\cdot, \cdot, e_k)` is a skew matrix times A, and :math:`J_c(\cdot, e_j, \cdot)` one times B, so that

    .. math:: A^T S + S^T A = 0

    is 10 linear equations on A for each slice.  Two points :math:`V_c` suffice; one leaves A + V w^T for every w.

    Args:
        forms: ``(*batch, c, 4, 4, 4)``, two or more of about equal norm.

    Returns:
        (A, B), each ``(*batch, 4, 4)``, Frobenius norm 1, canonical sign.

    Source: thesis section 8.2.

    Example:
        >>> A, B = torch.randn(2, 4, 4, dtype=torch.float64)
        >>> found, _ = motion_of_forms(join_forms(A, B, torch.eye(4, dtype=torch.float64)))
        >>> bool(torch.allclose(found, unit(A)))
        True
    """
    A, B = _skew_partner(torch.stack([forms.movedim(-1, -3), forms.movedim(-2, -3)])).unbind(0)
    return A, B


def _skew_partner(slices: Tensor) -> Tensor:
    """The matrix X for which X^T S is skew, for all slices S in ``(*batch, c, 4, 4, 4)``."""
    rows, columns = torch.triu_indices(4, 4, device=slices.device)
    s = slices.flatten(-4, -3).mT  # column n of S is s[n]
    eye = torch.eye(4, dtype=slices.dtype, device=slices.device)
    # entry (m, n) of X^T S + S^T X as a function of X[l, x]: S[l, n] where x = m, and S[l, m] where x = n
    system = s[..., columns, :, None] * eye[rows, None, :] + s[..., rows, :, None] * eye[columns, None, :]
    # an equation off the diagonal stands for two: with its weight a rotation of the coordinates changes nothing
    system = system * torch.where(rows == columns, 1.0, 2**0.5).to(s)[:, None, None]
    return unit(null_space(system.flatten(-2).flatten(-3, -2))[..., 0, :].unflatten(-1, (4, 4)))


def collinearity(motion: tuple[Tensor, ...], views: tuple[Tensor, ...], scales: tuple[Tensor, ...]) -> Tensor:
    r"""Whitened distance of each match from lying on one straight line: 3 coordinates of a vector normal to that line.

    With :math:`x_1, x_2, x_3` carried into view 1, the combinations :math:`u = (x_1 - x_3) / \sqrt 2` and
    :math:`v = (x_1 - 2 x_2 + x_3) / \sqrt 6` are turned until they are orthogonal: the longer one is along the line (unit
    vector d), the shorter one is the error :math:`e = \sum_v w_v x_v`.  To first order its noise is
    :math:`K = \sum_v w_v^2 s_v^2 J_v J_v^T`, of which the plane normal to d sees :math:`Q = P K P`, and

    .. math:: Q^{-1/2} e = \frac{(\operatorname{tr} Q + \delta)\,e - P K e}{\delta \sqrt{\operatorname{tr} Q + 2 \delta}},
              \qquad \delta^2 = \det Q = d^T \operatorname{adj}(K)\, d .

    The symmetric root needs no basis of the plane, so the residual is smooth in motion and matches but for its sign (which
    turns over where a point comes back to where it was) and where the three points have no direction at all.

    Args:
        motion: (A, B), each ``(*batch, 4, 4)``.
        views: three ``(*batch, n, 3)``.
        scales: three ``(*batch,)`` standard deviations of the noise.

    Returns:
        ``(*batch, n, 3)``; the square sum follows :math:`\chi^2_2` for moving points and has half its mean for static ones.

    Example:
        >>> eye, one = torch.eye(4), torch.ones(())
        >>> x = torch.tensor([[0.0, 0.0, 0.0]])
        >>> collinearity((eye, eye), (x, x + 1, x + 2), (one, one, one)).abs().max().item() < 1e-6
        True
    """
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
