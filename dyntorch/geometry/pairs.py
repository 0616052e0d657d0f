"""Points of P^k on two hyperplanes: the pair, and which of the two every point lies on."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.geometry.extensors import meet
from dyntorch.geometry.homogeneous import (
    collecting,
    factors,
    inhomogeneous,
    multiplicity,
    nonzero_sign,
    null_vectors,
    rank_one,
    symmetric,
    unit_vectors,
)
from dyntorch.numerics.blocks import constant, one_thread
from dyntorch.numerics.least_squares import Iterate, LeastSquares, LeastSquaresOptions, Tensors, minimize
from dyntorch.numerics.nullspace import gram_null_space, null_space, spectrum

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
    weights, finite = _check_weights(structure, weights, information)
    points = torch.where(finite[..., None], structure.double(), 0.0)
    unit, frame, scale = _whiten(points, weights)
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


def _check_weights(structure: Tensor, weights: Tensor | None, information: Tensor | None) -> tuple[Tensor, Tensor]:
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


def _whiten(points: Tensor, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
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


# ----------------------------------------------------------------------------------------------------------------------
# Products of two bilinear forms: the 6 x 6 matrix of :math:`(p_2^T F_1 p_1)(p_2^T F_2 p_1)`, and the two forms in it.
#
# The matrix takes monomials of the points, :math:`\nu(p_2)^T S\, \nu(p_1)`, in the order 00, 01, 02, 11, 12, 22.


DESCENT = LeastSquaresOptions(iterations=12, damping=1e-4, increase=10.0, least_damping=0.0, tolerance=None)
"""Steps to the nearest product.  Without any, 1 of 40 noisy scenes (100 matches, .01 px, epipoles 2 degrees apart) is useless."""
EXACT = 1e-10  # of the norm of the matrix: what rounding leaves of an exact product
FULL = 1e-12  # damping that is none
PAIRS_RIDGE = 1e-15  # of the trace: leaves equations of coinciding epipoles solvable


def product_matrix(*forms: Tensor) -> Tensor:
    r"""The matrix S of the product of bilinear forms, for two of them :math:`S_{\{ac\}\{bd\}} = \sum F_{ab} G_{cd}`, not
    scaled. forms ``(*batch, 3, 3)`` -> ``(*batch, M, M)``."""
    product = forms[0]
    for form in forms[1:]:
        product = (product[..., :, None, :, None] * form[..., None, :, None, :]).flatten(-4, -3).flatten(-2)
    collect = collecting(len(forms), 2, product.device).to(product.dtype)
    return collect @ product @ collect.mT


def factor_product(matrix: Tensor) -> tuple[Tensor, Tensor]:
    r"""The two matrices of rank two whose product a 6 x 6 matrix is, through its null spaces: the epipoles. matrix
    ``(*batch, 6, 6)`` -> ``(*batch, 3, 3)``."""
    if matrix.shape[-2:] != (6, 6):
        raise ValueError(f"matrix must be (*batch, 6, 6), got {tuple(matrix.shape)}")
    size = torch.linalg.matrix_norm(matrix.detach(), keepdim=True)
    sound = size.isfinite() & (size > 0)
    # any product in place of what is none, so that nothing is NaN
    stand_in = product_matrix(*torch.diag_embed(matrix.new_tensor([[1.0, -1.0, 0.0], [1.0, 0.0, 2.0]])).unbind(0))
    flat = torch.where(sound, matrix / torch.where(sound, size, 1.0), stand_in).reshape(-1, 6, 6)
    scale = multiplicity(2, 2, flat.device).to(flat.dtype).sqrt()
    flat, second, first = _balance(flat / scale[:, None] / scale)
    found = _nearest(flat, _pair_epipoles(flat, _epipoles(null_space(flat.mT, 2)), _epipoles(null_space(flat, 2))))
    found = second[:, None, :, None] * found * first[:, None, None, :]
    found = unit_vectors(found.flatten(-2))
    found = _order_factors(found).unflatten(-1, (3, 3)).reshape(*matrix.shape[:-2], 2, 3, 3)
    found = torch.where(sound[..., None], found, 0.0)
    return found[..., 0, :, :], found[..., 1, :, :]


def _balance(matrix: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The isometric matrix in units in which the points of both views are of order 1, and the scales ``(b, 3)`` of the forms'
    axes."""
    scales = []
    for axis in (2, 1):
        square = matrix.square().sum(axis)
        # monomials that are quadratic, linear and constant in the measured coordinates
        two, one, none = square[:, [0, 1, 3]].sum(-1), square[:, [2, 4]].sum(-1), square[:, 5]
        unit = (two.square() / (none * two + one.square()).clamp(min=1e-300)).clamp(min=1e-60)
        scale = unit ** (-0.25)
        scales.append(torch.stack([scale, scale, torch.ones_like(scale)], dim=-1))
    index = factors(2, 2, matrix.device)
    left, right = (s[:, index[:, 0]] * s[:, index[:, 1]] for s in scales)
    matrix = left[:, :, None] * matrix * right[:, None, :]
    matrix = matrix / torch.linalg.matrix_norm(matrix, keepdim=True).clamp(min=1e-300)
    return matrix, 1 / scales[0], 1 / scales[1]


def _epipoles(kernel: Tensor) -> Tensor:
    """The two vectors ``(b, 2, 3)`` whose outer squares span a plane of symmetric matrices, isometric monomials ``(b, 2, 6)``."""
    plain = kernel / multiplicity(2, 2, kernel.device).to(kernel.dtype).sqrt()
    form = plain[..., symmetric(2, kernel.device)]
    # both forms vanish on the vector across both epipoles; what is left are 2 x 2 matrices
    common = null_space(form.flatten(1, 2))
    across = null_space(common, 2)
    a, b = (across[:, None] @ form @ across[:, None].mT).unbind(1)
    # p a + q b is of rank one
    first, last = (m[:, 0, 0] * m[:, 1, 1] - m[:, 0, 1].square() for m in (a, b))
    middle = a[:, 0, 0] * b[:, 1, 1] + a[:, 1, 1] * b[:, 0, 0] - 2 * a[:, 0, 1] * b[:, 0, 1]
    discriminant = middle.square() - 4 * first * last
    real = discriminant > 0
    root = torch.where(real, torch.where(real, discriminant, 1.0).sqrt(), 0.0)
    large = -0.5 * (middle + torch.where(middle < 0, -root, root))
    roots = torch.stack([torch.stack([large, first], -1), torch.stack([last, large], -1)], dim=1)
    squares = torch.einsum("bkr,brij->bkij", roots, torch.stack([a, b], dim=1))
    longest = squares.detach().diagonal(dim1=-2, dim2=-1).abs().argmax(-1)
    column = squares.gather(-1, longest[..., None, None].expand(-1, -1, 2, 1))[..., 0]
    return unit_vectors(unit_vectors(column) @ across)


def _pair_epipoles(matrix: Tensor, second: Tensor, first: Tensor) -> Tensor:
    """The forms ``(b, 2, 2, 3, 3)`` for epipoles ``(b, 2, 3)`` of view 2 and view 1, paired in both ways."""
    bases = [null_space(e.flatten(0, 1)[:, None], 2).reshape(-1, 2, 2, 3) for e in (second, first)]
    return torch.stack([_forms(matrix, bases[0], chosen) for chosen in (bases[1], bases[1].flip(1))], dim=1)


def _forms(matrix: Tensor, second: Tensor, first: Tensor) -> Tensor:
    """Forms ``(b, 2, 3, 3)`` of norm 1 within given bases ``(b, 2, 2, 3)``."""
    collect = collecting(2, 2, matrix.device).to(matrix.dtype)
    collect = collect / collect.norm(dim=-1, keepdim=True)
    inner = matrix
    for basis in (second, first):
        pairs = (basis[:, 0, :, None, :, None] * basis[:, 1, None, :, None, :]).flatten(3).flatten(1, 2) @ collect.mT  # (b, 4, 6)
        gram = pairs @ pairs.mT
        ridge = PAIRS_RIDGE * gram.diagonal(dim1=-2, dim2=-1).sum(-1)
        gram = gram + torch.diag_embed(ridge[:, None].expand(-1, 4))
        inner = (torch.linalg.solve_ex(gram, pairs)[0] @ inner).mT
    # rows by the pairs of basis vectors of view 2, columns by those of view 1: (i j, k l) -> (i k, j l)
    kron = inner.unflatten(-1, (2, 2)).unflatten(-3, (2, 2)).transpose(-3, -2).flatten(-2).flatten(-3, -2)
    left, right = rank_one(kron)
    forms = second.mT @ torch.stack([left, right], dim=1).unflatten(-1, (2, 2)) @ first
    return forms / torch.linalg.matrix_norm(forms, keepdim=True).clamp(min=1e-300)


def _nearest(matrix: Tensor, tries: Tensor) -> Tensor:
    """The forms ``(b, 2, 3, 3)`` of rank two whose product is nearest, by damped Gauss-Newton steps from ``(b, 2, 2, 3, 3)``."""
    rest = _product_distance(matrix.repeat_interleave(2, 0), tries.flatten(0, 1))[0].unflatten(0, (-1, 2))
    forms = _lower_cost(tries, rest)
    chosen = (rest.detach().amin(-1) > EXACT).nonzero()[:, 0]
    if len(chosen):
        forms = forms.index_copy(0, chosen, _descent(matrix[chosen], tries[chosen]))
    # a full step at the end gives exact products the gradient of the nearest one, too
    problem = ProductProblem(matrix)
    at = problem.evaluate((forms,))
    trial = problem.advance(at, problem.step(at, torch.full_like(at.cost, FULL)))
    better = trial.cost <= at.cost.clamp(min=EXACT)
    return torch.where(better[:, None, None, None], trial.theta[0], forms)


def _descent(matrix: Tensor, tries: Tensor) -> Tensor:
    """:func:`_nearest` of matrices that are no product."""
    problem = ProductProblem(matrix.repeat_interleave(2, 0))
    found = minimize(problem, problem.evaluate((tries.flatten(0, 1),)), DESCENT)
    return _lower_cost(found.theta[0].unflatten(0, (-1, 2)), found.cost.unflatten(0, (-1, 2)))


def _lower_cost(tries: Tensor, rest: Tensor) -> Tensor:
    """Those of two tries that leave less."""
    return tries.gather(1, rest.detach().argmin(-1)[:, None, None, None, None].expand(-1, 1, 2, 3, 3))[:, 0]


def _product_distance(matrix: Tensor, forms: Tensor) -> tuple[Tensor, Tensor]:
    """Distance ``(b,)`` of the matrix to the multiples of the product, and the best factor."""
    product = (_with(forms[:, 1]) @ forms[:, 0].flatten(1)[..., None])[..., 0]
    flat = matrix.flatten(1)
    scale = (flat * product).sum(-1) / product.square().sum(-1).clamp(min=1e-300)
    return (flat - scale[:, None] * product).norm(dim=-1), scale


@dataclass(frozen=True)
class ProductProblem(LeastSquares):
    """Two forms ``(b, 2, 3, 3)`` of rank two and norm 1 whose product is nearest to a matrix ``(b, 6, 6)``."""

    matrix: Tensor

    def evaluate(self, theta: Tensors) -> Iterate:
        """The distance, which falls with its square, and the best factor of the product."""
        rest, scale = _product_distance(self.matrix, theta[0])
        return Iterate(theta, rest, (scale,))

    def step(self, at: Iterate, damping: Tensor) -> Tensors:
        """Along the forms of norm 1 and rank two."""
        forms, scale = at.theta[0], at.terms[0]
        flat = forms.flatten(2)
        first, second = (_with(forms[:, 1 - k]) * scale[:, None, None] for k in (0, 1))
        value = self.matrix.flatten(1) - (first @ flat[:, 0, :, None])[..., 0]
        jacobian = torch.cat([first, second], dim=-1)
        # the scale of the second form is that of the first, and the rank stays two
        left, right = null_vectors(forms)
        across = (left[..., :, None] * right[..., None, :]).flatten(2)
        zero = torch.zeros_like(across[:, 0])
        fixed = [[across[:, 0], zero], [zero, across[:, 1]], [zero, flat[:, 1]]]
        rows = torch.stack([torch.cat(pair, dim=-1) for pair in fixed], dim=1)
        system = jacobian.mT @ jacobian + rows.mT @ rows + torch.diag_embed(damping[:, None].expand(-1, 18))
        step = torch.linalg.solve_ex(system, jacobian.mT @ value[..., None])[0].nan_to_num(nan=0.0, posinf=0.0, neginf=0.0)
        return (-step[..., 0].unflatten(-1, (2, 3, 3)),)

    def retract(self, theta: Tensors, step: Tensors) -> Tensors:
        """The nearest forms of norm 1 and rank two."""
        moved = theta[0] - step[0]
        right = null_vectors(moved)[1]
        moved = moved - (moved @ right[..., None]) * right[..., None, :]
        return (moved / torch.linalg.matrix_norm(moved, keepdim=True).clamp(min=1e-300),)


def _with(form: Tensor) -> Tensor:
    """The isometric product with a given form ``(b, 3, 3)`` as a map ``(b, 36, 9)`` of the other."""
    table = _product_table(form.device).to(form.dtype)
    return (form.flatten(1) @ table).unflatten(-1, (36, 9))


@constant
def _product_table(device: torch.device) -> Tensor:
    """Coefficients ``(9, 36 * 9)`` of the isometric product of two forms."""
    collect = collecting(2, 2, torch.device("cpu"))
    collect = (collect / collect.norm(dim=-1, keepdim=True)).unflatten(-1, (3, 3))
    return torch.einsum("iac,jbd->cdijab", collect, collect).reshape(9, 36 * 9).to(device)


def _order_factors(forms: Tensor) -> Tensor:
    """Both vectors ``(b, 2, 9)``, whose product does not know their order, in the one that a fixed measure gives them."""
    measure = forms.detach().square() @ torch.linspace(1, 2, 9, dtype=forms.dtype, device=forms.device)
    return torch.where((measure[:, 0] < measure[:, 1])[:, None, None], forms.flip(1), forms)


# ----------------------------------------------------------------------------------------------------------------------
# Two bodies in relative translation: from points on two hyperplanes of P^k to the cameras and the affine shape of each.


PARALLEL = 1e-12
"""1 - cos^2 of the angle between hyperplanes below which they are one."""


@dataclass(frozen=True)
class TwoBodies:
    """Cameras and affine points of two bodies with a common linear part; all but ``determined`` carry gradients."""

    cameras: Tensor
    """``(*batch, 2, v, m, d + 1)``: :math:`[Q_i | q_i]` of body 1, :math:`[Q_i | q_i + r_i]` of body 2; depths are positive."""
    points: Tensor
    """``(*batch, n, d)`` affine coordinates, each point in the frame of its own body; X / w where the label is 0."""
    collineation: Tensor
    """``(*batch, K, K)`` G, with :math:`G\\,Y \\sim (X, 1, 0)` on body 1 and :math:`(X, 1, 1)` on body 2."""
    determined: Tensor
    """``(*batch, 2)`` bool: the body has K - 1 points, so that its hyperplane is known, and the hyperplanes differ."""


@one_thread
def two_bodies(projections: Tensor, structure: Tensor, hyperplanes: Tensor, labels: Tensor) -> TwoBodies:
    r"""The collineation that makes two hyperplanes those of two translating bodies, and with it the bodies.

    Every view sees :math:`x \sim Q_i X + q_i` of body 1 and :math:`x \sim Q_i (X + d_i) + q_i` of body 2, that is
    :math:`M_i = [Q_i | q_i | Q_i d_i]` and points :math:`Y = (X, w, \lambda)` with :math:`\lambda = 0` or
    :math:`\lambda = w`.  In any projective frame, :math:`\lambda = h_1 \cdot Y`, :math:`w = (h_1 + h_2) \cdot Y`, and X are
    d = K - 2 coordinates that vanish nowhere on :math:`h_1 \cap h_2` (where infinity is):

    .. math:: G = \begin{bmatrix} N \\ h_1^T + h_2^T \\ h_1^T \end{bmatrix}, \qquad M_i G^{-1} = [Q_i | q_i | r_i].

    The signs of :math:`h_1, h_2` are those for which w has the sign of the depth.  What remains is an affinity of both bodies
    with one linear part, a translation of each, and the size of one body against the other.  Nothing observes the last one where
    :math:`m < K - 1` (bodies in space): here either body gets its median at the origin and median radius 1.  Where
    :math:`m = K - 1` (bodies that translate in one plane), the centre :math:`(d_i, 0, -1)` of every view has w = 0, which gives
    the ratio of :math:`h_1` and :math:`h_2`; then only the common size is a matter of gauge, and the median radius over both is
    1.  The gauge is held constant in derivatives.

    Args:
        projections: ``(*batch, v, m, K)``, :math:`M_i` of any scale and sign, the last row that of the depth.
        structure: ``(*batch, n, K)`` homogeneous points of any scale and sign.
        hyperplanes: ``(*batch, 2, K)`` of any scale and sign: :func:`~dyntorch.geometry.pairs.hyperplane_pair`.
        labels: ``(*batch, n)`` 1 or 2; 0 for a point of neither.

    Returns:
        cameras, points, collineation and determined.  A point that noise leaves beside its hyperplane keeps the coordinates
        X / w; a bundle adjustment with the cameras is what moves it to where its images want it.

    Raises:
        ValueError: shapes that do not fit, or labels outside 0 to 2.

    Source: thesis chapter 3 (two bodies in relative translation).

    Example:
        >>> import torch
        >>> from dyntorch.geometry.pairs import hyperplane_pair
        >>> rand = torch.Generator().manual_seed(1)
        >>> Y = torch.rand(12, 4, generator=rand, dtype=torch.float64)
        >>> Y[:, 2], Y[:, 3] = 1.0, torch.arange(12) >= 7  # seven points of body 1
        >>> P = torch.rand(2, 3, 3, generator=rand, dtype=torch.float64)
        >>> d = torch.tensor([[0.3, 0.2], [0.1, -0.4]], dtype=torch.float64)
        >>> M = torch.cat([P, P[:, :, :2] @ d[..., None]], -1)
        >>> pair = hyperplane_pair(Y)
        >>> bodies = two_bodies(M, Y, pair.hyperplanes, pair.labels)
        >>> bodies.cameras.shape, bodies.points.shape, bodies.determined.tolist()
        (torch.Size([2, 2, 3, 3]), torch.Size([12, 2]), [True, True])
    """
    _check(projections, structure, hyperplanes, labels)
    views, points, pair = (torch.nan_to_num(t.double()) for t in (projections, structure, hyperplanes))
    bodies = torch.stack([labels == 1, labels == 2], dim=-2)
    views, points = _positive_depths(views, points, labels > 0)
    pair, apart = _orient_hyperplanes(pair, points, bodies)
    if views.shape[-2] == views.shape[-1] - 1:
        pair = pair * _ratio(views, pair)[..., None]
    size = points.shape[-1]
    frame = null_space(pair, size - 2)  # orthonormal rows across h_1 and h_2
    centres, sizes = _gauge(points, frame, pair, bodies, together=views.shape[-2] == size - 1)
    pair = pair * sizes.flip(-1)[..., None]  # X / w of body 1 has h_2 below, and the other way round
    linear = frame - centres.mT @ pair.flip(-2)
    collineation = torch.cat([linear, pair.sum(-2, keepdim=True), pair[..., :1, :]], dim=-2)
    # the columns of G^-1: across the pencil, and in it where h_2 = 1 on body 1, h_1 = 1 on body 2
    gram = torch.where(apart[..., None, None], pair @ pair.mT, torch.eye(2, dtype=pair.dtype, device=pair.device))
    origins = centres @ frame + (torch.linalg.inv_ex(gram)[0] @ pair).flip(-2)
    back = torch.cat([frame[..., None, :, :].expand(*pair.shape[:-1], *frame.shape[-2:]), origins[..., None, :]], dim=-2)
    cameras = views[..., None, :, :, :] @ back.mT[..., None, :, :]
    coordinates = inhomogeneous(points @ collineation[..., :-1, :].mT)
    determined = (bodies.sum(-1) >= size - 1) & apart[..., None]
    dtype = structure.dtype
    return TwoBodies(cameras.to(dtype), coordinates.to(dtype), collineation.to(dtype), determined)


def _check(projections: Tensor, structure: Tensor, hyperplanes: Tensor, labels: Tensor) -> None:
    if structure.ndim < 2 or not structure.is_floating_point() or structure.shape[-1] < 3:
        raise ValueError(
            f"structure must be a floating point tensor (*batch, n, K), got {tuple(structure.shape)} {structure.dtype}"
        )
    size = structure.shape[-1]
    if projections.ndim < 3 or projections.shape[-1] != size:
        raise ValueError(f"projections must be (*batch, v, m, {size}) for this structure, got {tuple(projections.shape)}")
    if hyperplanes.shape[-2:] != (2, size):
        raise ValueError(f"hyperplanes must be (*batch, 2, {size}) for this structure, got {tuple(hyperplanes.shape)}")
    if labels.shape != structure.shape[:-1] or bool(((labels < 0) | (labels > 2)).any()):
        got = (
            f"shape {tuple(labels.shape)}"
            if labels.shape != structure.shape[:-1]
            else f"{int(labels.min())} to {int(labels.max())}"
        )
        raise ValueError(f"labels must be 0, 1 or 2 for each of the points {tuple(structure.shape[:-1])}, got {got}")


def _positive_depths(views: Tensor, points: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
    """Projections and unit points with the signs for which the last coordinate of M_i Y_n is positive."""
    points = unit_vectors(points)
    depth = (views[..., -1, :] @ points.mT).detach().sign() * known[..., None, :]
    of_view = nonzero_sign((depth * depth[..., :1, :]).sum(-1))
    of_point = nonzero_sign((depth * of_view[..., None]).sum(-2))
    return views * of_view[..., None, None], points * of_point[..., None]


def _orient_hyperplanes(pair: Tensor, points: Tensor, bodies: Tensor) -> tuple[Tensor, Tensor]:
    """Unit hyperplanes, each positive on the points of the other body, and whether they are two."""
    pair = unit_vectors(pair)
    sign = nonzero_sign(((pair @ points.mT).detach() * bodies.flip(-2)).sum(-1))
    cosine = (pair[..., 0, :] * pair[..., 1, :]).sum(-1)
    nonzero = (pair != 0).any(-1).all(-1)
    return pair * sign[..., None], nonzero & (1 - cosine.square() > PARALLEL)


def _ratio(views: Tensor, pair: Tensor) -> Tensor:
    """Scales ``(*batch, 2)`` of the hyperplanes for which h_1 + h_2 vanishes at the centre of every view."""
    at_centres = meet(*unit_vectors(views).unbind(-2)) @ pair.mT
    rows = unit_vectors(at_centres)
    # a positive pair: the signs are those of the depths
    scales = gram_null_space(rows.mT @ rows).basis[..., 0, :].abs()
    return torch.where((scales > 0).all(-1, keepdim=True), scales, 1.0)


@torch.no_grad()
def _gauge(points: Tensor, frame: Tensor, pair: Tensor, bodies: Tensor, *, together: bool) -> tuple[Tensor, Tensor]:
    """Median point ``(*batch, 2, d)`` of either body in units of its size, and the sizes ``(*batch, 2)``: of both if together."""
    across = (points @ frame.mT)[..., None, :, :]
    depth = (points @ pair.mT).mT.flip(-2)[..., None]
    position = inhomogeneous(torch.cat([across.expand(*depth.shape[:-1], -1), depth], dim=-1))
    member = bodies[..., None]
    centre = position.masked_fill(~member, torch.nan).nanmedian(dim=-2, keepdim=True).values.nan_to_num()
    radius = (position - centre).norm(dim=-1).masked_fill(~bodies, torch.nan)
    if together:
        size = radius.flatten(-2).nanmedian(dim=-1, keepdim=True).values.expand(radius.shape[:-1])
    else:
        size = radius.nanmedian(dim=-1).values
    size = torch.where(size > 0, size, 1.0)
    return centre[..., 0, :] / size[..., None], size


# ----------------------------------------------------------------------------------------------------------------------
# The one rule by which bodies get their numbers.


def order_of_bodies(members: Tensor) -> Tensor:
    r"""Order in which bodies are numbered: the larger first, of equally large ones that of the earliest match. members
    ``(*batch, K, n)`` -> ``(*batch, K)``."""
    count = members.shape[-1]
    places = torch.arange(count, device=members.device)
    first = torch.where(members, places, count).amin(-1) if count else members.new_zeros(members.shape[:-1], dtype=torch.long)
    # size and first match in one integer: (size, count - first) in the order of digits
    return (members.sum(-1) * (count + 1) + count - first).argsort(dim=-1, descending=True, stable=True)
