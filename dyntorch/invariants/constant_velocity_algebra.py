r"""Three sensors that watch points at constant velocity: the tensor of their maps, and back.

A point at :math:`x + t v` is seen as :math:`P_t \sim A_t (x + t v, 1)`, t = 0, 1, 2.  With the world position
:math:`y_t = \pi(A_t^{-1} P_t)` and the plane at infinity of each frame, the last row of :math:`A_t^{-1}`, called
:math:`\alpha, \beta, \gamma`, the prediction :math:`y_2 = 2 y_1 - y_0` is bilinear in the first two measurements:

.. math:: P_2 \sim A_2\left(2\,(\alpha \cdot P_0)\, A_1^{-1} P_1 - (\beta \cdot P_1)\, A_0^{-1} P_0\right)
    \qquad T_{ijk} = \alpha_i Q_{kj} + K_{ki} \beta_j, \quad Q = 2 A_2 A_1^{-1}, \quad K = -A_2 A_0^{-1}.

The third sensor may be a camera: :math:`A_2` is then 3 x 4.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize

from dyntorch.geometry.extensors import adjugate
from dyntorch.geometry.homogeneous import unit
from dyntorch.numerics.nullspace import null_space, spectrum

# 300 scenes each: with 24 matches and noise of 2e-3 of the scene the global minimum is found always (camera: always), with 21
# matches and 5e-3 in 98 %; 3 and 3 steps leave 2 % unconverged, 30 alternations gain nothing
ALTERNATIONS = 10
NEWTON_STEPS = 4


def constant_velocity_tensor(first: Tensor, second: Tensor, third: Tensor) -> Tensor:
    r"""The tensor of three maps from the world, :math:`T(P_0, P_1, \cdot) \sim P_2`, of norm 1. first ``(*batch, 4, 4)``,
    second ``(*batch, 4, 4)``, third ``(*batch, 4, 4)`` -> ``(*batch, 4, 4, 4)``."""
    back0, back1 = adjugate(first), adjugate(second)
    moved = torch.einsum("...i,...kj->...ijk", back0[..., 3, :], 2 * third @ back1)
    return _unit(moved - torch.einsum("...ki,...j->...ijk", third @ back0, back1[..., 3, :]))


def infinity_planes(tensor: Tensor) -> tuple[Tensor, Tensor]:
    r"""The planes at infinity of the first two frames: :math:`T \approx \alpha \otimes Q + K \otimes \beta`, least squares.
    tensor ``(*batch, 4, 4, m)`` -> ``(*batch, 4)``."""
    with torch.no_grad():
        alpha = _common_column(tensor)
        beta = spectrum(_gram(tensor.transpose(-2, -3), alpha))[1][..., -1]
        for _ in range(ALTERNATIONS):
            alpha = _step(_gram(tensor, beta), alpha)
            beta = _step(_gram(tensor.transpose(-2, -3), alpha), beta)
        for _ in range(NEWTON_STEPS):
            alpha, beta = _newton(tensor, alpha, beta)
        alpha, beta = _upright(alpha), _upright(beta)
    # one step has the first derivative of the minimum, two have the second
    alpha, beta = _newton(tensor, alpha, beta)
    return _newton(tensor, alpha, beta) if tensor.requires_grad else (alpha, beta)


def structure(tensor: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    r"""The parts of :math:`T_{ijk} \approx \alpha_i Q_{kj} + K_{ki} \beta_j` with :math:`K \alpha = 0`. tensor
    ``(*batch, 4, 4, m)`` -> ``(*batch, 4)``."""
    alpha, beta = infinity_planes(tensor)
    q = torch.einsum("...ijk,...i->...kj", tensor, alpha)
    k = torch.einsum("...ijk,...j->...ki", tensor, beta)
    return alpha, beta, q, k - (k @ alpha[..., None]) * alpha[..., None, :]


def third_infinity(alpha: Tensor, beta: Tensor, q: Tensor, k: Tensor) -> Tensor:
    r"""The equations of the plane at infinity of the third frame: :math:`\gamma^T Q \sim \beta^T, \gamma^T K \sim \alpha^T`."""
    rest = q - (q @ beta[..., None]) * beta[..., None, :]
    return torch.cat([rest.mT, (k - (k @ alpha[..., None]) * alpha[..., None, :]).mT], dim=-2)


def constant_velocity_maps(tensor: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    r"""The maps :math:`A_0, A_1, A_2` of a tensor in closed form, up to an affinity of the world and a common velocity. tensor
    ``(*batch, 4, 4, 4)`` -> ``(*batch, 4, 4)``."""
    alpha, beta, q, k = structure(tensor)
    first = complement_frame(alpha)
    if tensor.shape[-1] == 3:
        third = -k @ first  # [M | 0]: the camera is at the origin
        world = torch.cat([torch.cat([third[..., :3], torch.zeros_like(third[..., 3:])], dim=-1), _last_row(third)], dim=-2)
        second = adjugate(torch.cat([q / 2, beta[..., None, :]], dim=-2)) @ world
        return unit(first), unit(second), unit(third)
    gamma = null_space(third_infinity(alpha, beta, q, k))[..., 0, :]
    shift = (gamma[..., None, :] @ q @ beta[..., None])[..., 0] * gamma
    q = q + shift[..., :, None] * beta[..., None, :]
    k = k - shift[..., :, None] * alpha[..., None, :]
    third = -k @ first
    return unit(first), unit(adjugate(q) @ third), unit(third)


def unit_tensor(tensor: Tensor) -> Tensor:
    """The tensor in float64 and of norm 1, with 0 in place of one that is not finite."""
    if tensor.ndim < 3 or tuple(tensor.shape[-3:]) not in ((4, 4, 4), (4, 4, 3)):
        raise ValueError(f"tensor must be (*batch, 4, 4, 4), or (*batch, 4, 4, 3) of a camera, got {tuple(tensor.shape)}")
    good = tensor.isfinite().flatten(-3).all(-1)[..., None, None, None]
    exact = torch.where(good, tensor, torch.zeros_like(tensor)).double()
    return _unit(exact)


def balance_views(tensor: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor]]:
    r"""Bring each view to a unit in which its points are of order 1: :math:`T_{ijk} = \hat T_{ijk}\, d_i e_j f_k`."""
    scales = []
    for axis, like in ((-3, 13**-0.5), (-2, 1.0), (-1, 5**0.5)):
        size = torch.linalg.vector_norm(tensor, dim=[a for a in (-3, -2, -1) if a != axis]).square()
        inner, last = size[..., :-1].mean(-1, keepdim=True), size[..., -1:]
        usable = (inner > 0) & (last > 0)
        scale = torch.where(usable, (inner / torch.where(usable, last, 1.0)).clamp(min=1e-300).sqrt() / like, 1.0)
        factor = torch.cat([scale.expand_as(size[..., :-1]), torch.ones_like(last)], dim=-1)
        tensor = tensor / factor.unflatten(-1, [-1 if a == axis else 1 for a in (-3, -2, -1)])
        scales.append(factor)
    return _unit(tensor), (scales[0], scales[1], scales[2])


def complement_frame(plane: Tensor) -> Tensor:
    """The orthogonal matrix [R^T, plane]: a Householder reflection, smooth where the last coordinate is not negative."""
    eye = torch.eye(4, dtype=plane.dtype, device=plane.device)
    w = plane + eye[3]
    reflection = eye - w[..., :, None] * w[..., None, :] / (1 + plane[..., 3, None, None])
    return torch.cat([reflection[..., :3], plane[..., None]], dim=-1)


def _common_column(tensor: Tensor) -> Tensor:
    """The vector that all slices of the third axis, of rank 2, have in their column space."""
    slices = tensor.movedim(-1, -3)
    complement = spectrum(slices @ slices.mT)[1][..., :2]
    return spectrum((complement @ complement.mT).sum(-3))[1][..., 0]


def _gram(tensor: Tensor, plane: Tensor) -> Tensor:
    """The Gram matrix of the first axis once the second is projected to the complement of ``plane``."""
    rest = tensor - torch.einsum("...ilk,...l,...j->...ijk", tensor, plane, plane)
    return torch.einsum("...ijk,...ljk->...il", rest, rest)


def _step(gram: Tensor, vector: Tensor) -> Tensor:
    """One power step towards the leading vector of a Gram matrix that is nearly of rank 1; the vector itself if it is 0."""
    moved = (gram @ vector[..., None])[..., 0]
    return torch.where(moved.norm(dim=-1, keepdim=True) > 0, normalize(moved, dim=-1), vector)


def _newton(tensor: Tensor, alpha: Tensor, beta: Tensor) -> tuple[Tensor, Tensor]:
    """One Newton step of the least squares problem on the two unit spheres; no step where it has no strict minimum."""
    flipped = tensor.transpose(-2, -3)
    grams = (_gram(tensor, beta), _gram(flipped, alpha))
    gradient = torch.cat([_off(g @ v[..., None], v) for g, v in zip(grams, (alpha, beta), strict=True)], dim=-2)
    with torch.no_grad():
        diagonal = []
        for gram, v in zip(grams, (alpha, beta), strict=True):
            column = v[..., None]
            value = column.mT @ gram @ column
            inner = _off(_off(gram, v).mT, v)
            eye = torch.eye(4, dtype=gram.dtype, device=gram.device)
            diagonal.append(value * eye - inner)
        right = torch.einsum("...ijk,...j->...ik", tensor, beta)
        left = torch.einsum("...ijk,...i->...jk", tensor, alpha)
        both = torch.einsum("...ik,...i->...k", right, alpha)
        cross = torch.einsum("...ijk,...k->...ij", tensor, both) + right @ left.mT
        cross = _off(_off(cross, alpha).mT, beta).mT
        hessian = torch.cat([torch.cat([diagonal[0], cross], dim=-1), torch.cat([cross.mT, diagonal[1]], dim=-1)], dim=-2)
        factor, info = torch.linalg.cholesky_ex(hessian)
        strict = (info == 0)[..., None, None]
        inverse = torch.where(
            strict, torch.cholesky_inverse(torch.where(strict, factor, torch.eye(8, dtype=factor.dtype, device=factor.device))), 0.0
        )
    step = (inverse @ gradient)[..., 0]
    return normalize(alpha + step[..., :4], dim=-1), normalize(beta + step[..., 4:], dim=-1)


def _off(matrix: Tensor, vector: Tensor) -> Tensor:
    """The columns without their part along a unit vector."""
    column = vector[..., None]
    return matrix - column @ (column.mT @ matrix)


def _upright(plane: Tensor) -> Tensor:
    """The sign for which the last coordinate is not negative."""
    return torch.where(plane[..., 3:] < 0, -plane, plane)


def _last_row(matrix: Tensor) -> Tensor:
    """The row (0, 0, 0, 1)."""
    return torch.eye(4, dtype=matrix.dtype, device=matrix.device)[3:].expand(*matrix.shape[:-2], 1, 4)


def _unit(tensor: Tensor) -> Tensor:
    """Norm 1; zero stays zero."""
    norm = tensor.flatten(-3).norm(dim=-1)[..., None, None, None]
    return tensor / torch.where(norm > 0, norm, torch.ones_like(norm))


# ----------------------------------------------------------------------------------------------------------------------
# The thesis's way from the constant velocity tensor to the maps of the sensors, over a projective reconstruction in P^6.
