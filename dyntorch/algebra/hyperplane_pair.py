"""Points of P^k on two hyperplanes: the pair, and which of the two every point lies on."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.algebra.homogeneous import unit_vectors
from dyntorch.blocks import one_thread
from dyntorch.eigenspace import spectrum
from dyntorch.nullspace import gram_null_space

REWEIGHTINGS, CANDIDATES = 3, 4
"""Fits of the quadric, and how many null vectors of each are split.  Two bodies of 20 points, 2 views of a plane, little motion
(a tenth of the radius), 1 px, 40 scenes: wrong labels 1.1 % from the last quadric alone, 0.9 % from all twelve (with
information; 30 and 10 points: 1.2 and 0.6 %; 3D, 3 views, 20 points: 1.2 and 0.0 %), 0.6 % from 100 random pairs."""
ITERATIONS = 10
"""Turns of labels and hyperplanes; 30 change nothing in those scenes."""
RIDGE = 1e-13  # of the trace: rounding, and what keeps a flat moment matrix invertible


@dataclass(frozen=True)
class HyperplanePair:
    """Two hyperplanes and the points on each; ``hyperplanes`` and ``distances`` carry gradients."""

    hyperplanes: Tensor
    """``(*batch, 2, K)`` unit vectors, :math:`h_1 \\cdot Y = 0` or :math:`h_2 \\cdot Y = 0`; the first has more points."""
    labels: Tensor
    """``(*batch, n)`` 1 or 2: the nearer hyperplane; 0 where the weight is 0."""
    distances: Tensor
    """``(*batch, 2, n)`` squared distances to both: in standard deviations with ``information``, else sines of angles after
    whitening."""
    degenerate: Tensor
    """``(*batch,)`` bool: a hyperplane with fewer than K - 1 points in general position, twice the same, or several pairs that
    fit exactly."""


@one_thread
def hyperplane_pair(structure: Tensor, weights: Tensor | None = None, *, information: Tensor | None = None) -> HyperplanePair:
    r"""Two hyperplanes through points: :math:`(h_1 \cdot Y)(h_2 \cdot Y) = Y^T Q\, Y = 0`.

    The quadric Q is linear in what is known of it; its eigenvectors of the two signs give
    :math:`h_{1,2} = \sqrt{w_+}\, v_+ \pm \sqrt{-w_-}\, v_-`.  Labels and hyperplanes then follow in turn: every point belongs
    to the nearer hyperplane, a hyperplane minimizes the sum of squared distances of its points.  With the information
    :math:`C_n^{-1}` of the points, the distance is the one that does not depend on the projective frame,

    .. math:: d_n(h)^2 = \frac{(h \cdot Y_n)^2}{h^T C_n\, h},

    and without it :math:`C_n = I` for unit vectors in coordinates that whiten the points.

    Args:
        structure: ``(*batch, n, K)`` homogeneous points of any scale; a row that is not finite weighs 0.
        weights: ``(*batch, n)``, not negative, 0 = ignore.
        information: ``(*batch, n, K, K)`` inverse covariance of every row of ``structure``: the block :math:`J^T J` of the point
            in a bundle adjustment (in units of the noise).  What it says along the row itself does not matter.

    Returns:
        hyperplanes, labels, distances and degenerate.

    Raises:
        ValueError: fewer than :math:`K(K+1)/2 - 1` points, or shapes that do not fit.

    Source: thesis chapter 3 (segmentation of two bodies); the pair of hyperplanes is a quadric of rank two (Vidal, Ma and
    Sastry 2005).

    Example:
        >>> import torch
        >>> Y = torch.rand(12, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        >>> Y[:7, 3], Y[7:, 3] = 0.0, Y[7:, 2]
        >>> pair = hyperplane_pair(Y)
        >>> pair.labels.tolist(), bool(pair.distances.amin(-2).max() < 1e-20)
        ([1, 1, 1, 1, 1, 1, 1, 2, 2, 2, 2, 2], True)
    """
    weights, finite = _checked(structure, weights, information)
    points = torch.where(finite[..., None], structure.double(), 0.0)
    unit, frame, scale = _whitened(points, weights)
    covariance = None
    if information is not None:
        covariance = _covariance(torch.where(finite[..., None, None], information.double(), 0.0), unit, frame, scale)
    with torch.no_grad():
        planes, several = _best_start(unit, weights, covariance)
        planes = _larger_first(planes, unit, weights, covariance)
    # the last turn alone carries gradients: at the optimum, the labels are constant
    planes, lost = _turn(unit, weights, covariance, planes)
    distances = _distances(unit, covariance, planes)
    labels = torch.where(weights > 0, 1 + distances.detach().argmin(dim=-2), 0)
    same = 1 - (planes[..., 0, :] * planes[..., 1, :]).sum(-1).square() < RIDGE
    hyperplanes = unit_vectors(planes @ frame)  # z = frame Y
    dtype = structure.dtype
    return HyperplanePair(hyperplanes.to(dtype), labels, distances.to(dtype), lost.any(-1) | same | several)


def _checked(structure: Tensor, weights: Tensor | None, information: Tensor | None) -> tuple[Tensor, Tensor]:
    """Weights in float64, 0 for what is not finite, and which points are finite."""
    if structure.ndim < 2 or not structure.is_floating_point() or structure.shape[-1] < 2:
        raise ValueError(
            f"structure must be a floating point tensor (*batch, n, K), got {tuple(structure.shape)} {structure.dtype}"
        )
    n, size = structure.shape[-2:]
    least = size * (size + 1) // 2 - 1
    if n < least:
        raise ValueError(f"two hyperplanes of P^{size - 1} take {least} points, structure has {n}: add {least - n}")
    if weights is not None and weights.shape != structure.shape[:-1]:
        raise ValueError(f"weights must be (*batch, n) = {tuple(structure.shape[:-1])}, got {tuple(weights.shape)}")
    if information is not None and information.shape != (*structure.shape, size):
        raise ValueError(f"information must be (*batch, n, K, K) = {(*structure.shape, size)}, got {tuple(information.shape)}")
    finite = structure.isfinite().all(-1)
    given = finite.double() if weights is None else weights.double()
    if information is not None:
        finite = finite & information.isfinite().flatten(-2).all(-1)
    if not bool((given >= 0).all()):
        raise ValueError(f"weights must not be negative or NaN, got {float(given.min())}: use 0 for points to ignore")
    return given * finite, finite


def _whitened(points: Tensor, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Unit vectors z_n = scale_n frame Y_n, whose second moment is about the same in all directions; frame; scale."""
    unit = unit_vectors(points)
    moment = (unit * weights[..., None]).mT @ unit
    size = points.shape[-1]
    eye = torch.eye(size, dtype=points.dtype, device=points.device)
    ridge = RIDGE * moment.detach().diagonal(dim1=-2, dim2=-1).sum(-1) + torch.finfo(points.dtype).tiny
    factor, _ = torch.linalg.cholesky_ex(moment + ridge[..., None, None] * eye)
    frame = torch.linalg.solve_triangular(factor, eye.expand_as(factor), upper=False)
    frame = frame / torch.linalg.matrix_norm(frame.detach(), keepdim=True)
    raw = points @ frame.mT
    norm = raw.norm(dim=-1)
    scale = torch.where(norm > 0, 1 / torch.where(norm > 0, norm, 1.0), 0.0)
    return raw * scale[..., None], frame, scale


def _covariance(information: Tensor, unit: Tensor, frame: Tensor, scale: Tensor) -> Tensor:
    """Covariances ``(*batch, n, K, K)`` of the unit vectors, orthogonal to them."""
    eye = torch.eye(unit.shape[-1], dtype=unit.dtype, device=unit.device)
    back = torch.linalg.inv_ex(frame)[0][..., None, :, :] / torch.where(scale > 0, scale, 1.0)[..., None, None]
    ray = unit[..., :, None] * unit[..., None, :]
    across = eye - ray
    inner = across @ (back.mT @ information @ back) @ across
    size = inner.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    size = torch.where(size > 0, size, 1.0)
    # along the ray anything invertible, which the projection takes away again
    return across @ torch.linalg.inv_ex(inner / size + ray + RIDGE * eye)[0] @ across / size


def _best_start(unit: Tensor, weights: Tensor, covariance: Tensor | None) -> tuple[Tensor, Tensor]:
    """The pair ``(*batch, 2, K)`` that the turns reach with the least sum of squared distances; whether several are exact."""
    quadrics, several = _quadrics(unit, weights, covariance)
    planes = _split(quadrics)
    # one more batch dimension, of the starts
    unit, weights = unit[..., None, :, :], weights[..., None, :]
    covariance = None if covariance is None else covariance[..., None, :, :, :]
    for _ in range(ITERATIONS - 1):
        planes, lost = _turn(unit, weights, covariance, planes)
    cost = (_distances(unit, covariance, planes).amin(dim=-2) * weights).sum(-1)
    best = cost.masked_fill(lost.any(-1), torch.inf).argmin(dim=-1)[..., None, None, None]
    return planes.take_along_dim(best, dim=-3)[..., 0, :, :], several


def _quadrics(unit: Tensor, weights: Tensor, covariance: Tensor | None) -> tuple[Tensor, Tensor]:
    """Symmetric Q ``(*batch, starts, K, K)`` with z^T Q z about 0, each point by its own first-order variance; if not one alone."""
    size = unit.shape[-1]
    row, column = torch.triu_indices(size, size, device=unit.device)
    monomials = unit[..., row] * unit[..., column] * weights.sqrt()[..., None]
    deviation = torch.ones_like(weights)
    found, several = [], torch.zeros_like(weights[..., 0], dtype=torch.bool)
    for _ in range(REWEIGHTINGS):
        scaled = monomials / deviation[..., None]
        null = gram_null_space(scaled.mT @ scaled, min(CANDIDATES, len(row)))
        several = several | (null.residual[..., 1] <= RIDGE * scaled.square().sum((-2, -1)))
        vectors = null.basis
        upper = vectors.new_zeros(*vectors.shape[:-1], size, size)
        upper[..., row, column] = vectors / 2
        found.append(upper + upper.mT)
        variance = _variance(unit @ found[-1][..., 0, :, :], covariance)
        # a point on both hyperplanes has none
        deviation = torch.maximum(variance, 1e-3 * _mean(variance, weights)[..., None]).sqrt()
        deviation = torch.where(deviation > 0, deviation, 1.0)
    return torch.cat(found, dim=-3), several


def _split(quadric: Tensor) -> Tensor:
    """The pairs ``(*batch, 2, K)`` of quadrics of rank two and mixed signs."""
    values, vectors = spectrum(quadric)
    plus = vectors[..., -1] * values[..., -1:].clamp(min=0).sqrt()
    # noise can make it definite; a pair that is one plane would never part
    minus = vectors[..., 0] * (-values[..., :1]).clamp(min=0).sqrt()
    floor = 1e-3 * torch.maximum(plus.norm(dim=-1), minus.norm(dim=-1))[..., None]
    plus = torch.where(plus.norm(dim=-1, keepdim=True) < floor, vectors[..., -1] * floor, plus)
    minus = torch.where(minus.norm(dim=-1, keepdim=True) < floor, vectors[..., 0] * floor, minus)
    return unit_vectors(torch.stack([plus + minus, plus - minus], dim=-2))


def _turn(unit: Tensor, weights: Tensor, covariance: Tensor | None, planes: Tensor) -> tuple[Tensor, Tensor]:
    """Points to the nearer hyperplane, then hyperplanes from their points; which were kept for want of points."""
    nearer = _distances(unit, covariance, planes).argmin(dim=-2)
    member = torch.stack([nearer == 0, nearer == 1], dim=-2) & (weights > 0)[..., None, :]
    weight = member * weights[..., None, :] / _variances(unit, covariance, planes.detach())
    gram = (unit[..., None, :, :] * weight[..., None]).mT @ unit[..., None, :, :]
    found = gram_null_space(gram)
    lost = (member.sum(-1) < unit.shape[-1] - 1) | found.degenerate
    return torch.where(lost[..., None], planes, found.basis[..., 0, :]), lost


def _distances(unit: Tensor, covariance: Tensor | None, planes: Tensor) -> Tensor:
    """Squared distances ``(*batch, 2, n)``."""
    return (planes @ unit.mT).square() / _variances(unit, covariance, planes)


def _variances(unit: Tensor, covariance: Tensor | None, planes: Tensor) -> Tensor:
    """h^T C_n h for both hyperplanes, ``(*batch, 2, n)``."""
    if covariance is None:
        return planes.square().sum(-1, keepdim=True).expand(*planes.shape[:-1], unit.shape[-2])
    variance = ((covariance[..., None, :, :, :] @ planes[..., None, :, None])[..., 0] * planes[..., None, :]).sum(-1)
    return torch.where(variance > 0, variance, 1.0)


def _variance(gradient: Tensor, covariance: Tensor | None) -> Tensor:
    """g_n^T C_n g_n, ``(*batch, n)``."""
    if covariance is None:
        return gradient.square().sum(-1)
    return ((covariance @ gradient[..., None])[..., 0] * gradient).sum(-1)


def _larger_first(planes: Tensor, unit: Tensor, weights: Tensor, covariance: Tensor | None) -> Tensor:
    """The hyperplane with more points first, of equal ones that of the first point."""
    vote = (1 - 2 * _distances(unit, covariance, planes).argmin(dim=-2)) * (weights > 0)
    leading = vote.gather(-1, (weights > 0).to(torch.int8).argmax(dim=-1, keepdim=True))[..., 0]
    swap = 2 * vote.sum(-1) + leading < 0
    return torch.where(swap[..., None, None], planes.flip(-2), planes)


def _mean(values: Tensor, weights: Tensor) -> Tensor:
    total = weights.sum(-1)
    return (values * weights).sum(-1) / torch.where(total > 0, total, 1.0)
