"""Extensors: joins of points, meets of hyperplanes, Pluecker coordinates of lines, compound matrices, the Levi-Civita tensor."""

from __future__ import annotations

import math
from itertools import combinations, permutations
from math import comb

import torch
from torch import Tensor

from dyntorch.geometry.homogeneous import finite_depth, unit
from dyntorch.numerics.blocks import constant
from dyntorch.numerics.nullspace import eigh, null_space


def levi_civita(n: int, *, dtype: torch.dtype = torch.float64, device: torch.device | str | None = None) -> Tensor:
    r"""The alternating tensor :math:`\epsilon_{i_1 \dots i_n}`: the sign of the permutation, 0 where an index repeats."""
    if not 1 <= n <= 6:
        raise ValueError(f"n must be 1 to 6, got {n}")
    return _levi_civita(n, dtype, torch.empty(0, device=device).device)


@constant
def _levi_civita(n: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    tensor = torch.zeros((n,) * n, dtype=dtype)
    for order in permutations(range(n)):
        tensor[order] = _parity(order)
    return tensor.to(device)


def _parity(order: tuple[int, ...]) -> int:
    """Sign of the permutation that sorts the indices: +1 or -1."""
    return -1 if sum(a > b for a, b in combinations(order, 2)) % 2 else 1


def compound(matrix: Tensor, order: int) -> Tensor:
    r"""The compound matrix :math:`C_k(A)`: all minors of order k, rows and columns in lexicographic order. matrix
    ``(*batch, r, c)`` -> ``(*batch, binomial(r, k), binomial(c, k))``."""
    if matrix.ndim < 2 or not 1 <= order <= min(matrix.shape[-2:]):
        raise ValueError(f"order must be 1 to min(rows, columns) of the matrix, got {order} for {tuple(matrix.shape)}")
    result = matrix
    for k in range(2, order + 1):
        result = _expand(matrix, result, k)
    return result


def _expand(matrix: Tensor, smaller: Tensor, order: int) -> Tensor:
    """Minors of one order from those of the order below, by Laplace expansion along the first row."""
    rows, columns = matrix.shape[-2:]
    (first, *_), (rest, *_) = _laplace(rows, order, matrix.device)
    columns_of = zip(*_laplace(columns, order, matrix.device), strict=True)
    terms = (
        (-1) ** j * matrix[..., first[:, None], c] * smaller[..., rest[:, None], left] for j, (c, left) in enumerate(columns_of)
    )
    return torch.stack(list(terms)).sum(0)


@constant
def _laplace(n: int, order: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Index tables of a Laplace expansion of the minors of ``order`` among ``n`` lines."""
    place = {c: i for i, c in enumerate(combinations(range(n), order - 1))}
    sets = list(combinations(range(n), order))
    taken = [[c[j] for c in sets] for j in range(order)]
    left = [[place[c[:j] + c[j + 1 :]] for c in sets] for j in range(order)]
    return torch.tensor(taken, device=device), torch.tensor(left, device=device)


def join(*points: Tensor) -> Tensor:
    r"""The extensor :math:`p_1 \wedge \dots \wedge p_k` that the points span: their k-minors in lexicographic order. points
    ``(*batch, d + 1)`` -> ``(*batch, binomial(d + 1, k))``."""
    sizes = sorted({p.shape[-1] for p in points})
    if len(sizes) != 1 or len(points) > sizes[0]:
        raise ValueError(f"join takes 1 to d + 1 points (*batch, d + 1), got {len(points)} of sizes {sizes}")
    return compound(torch.stack(torch.broadcast_tensors(*points), dim=-2), len(points))[..., 0, :]


def dual(extensor: Tensor, size: int, step: int) -> Tensor:
    r"""The complementary extensor: :math:`e_S \mapsto \pm e_{\bar S}`, with the sign of the permutation :math:`(S, \bar S)`.
    extensor ``(*batch, binomial(size, step))`` -> ``(*batch, binomial(size, size - step))``."""
    check_extensor(extensor, size, step)
    # lexicographic order reverses under taking complements
    return (extensor * _dual_signs(size, step, extensor.device).to(extensor.dtype)).flip(-1)


def check_extensor(extensor: Tensor, size: int, step: int) -> None:
    """Raise a ``ValueError`` for an extensor whose length is not the binomial coefficient."""
    if not 0 <= step <= size or extensor.shape[-1] != comb(size, step):
        entries = comb(size, step) if 0 <= step <= size else "no"
        raise ValueError(f"an extensor of step {step} among {size} coordinates has {entries} entries, got {extensor.shape[-1]}")


@constant
def _dual_signs(size: int, step: int, device: torch.device) -> Tensor:
    signs = [_parity(s + tuple(i for i in range(size) if i not in s)) for s in combinations(range(size), step)]
    return torch.tensor(signs, device=device)


def meet(*hyperplanes: Tensor) -> Tensor:
    r"""The extensor of the intersection of hyperplanes: :math:`h_1 \cap \dots \cap h_k = *(h_1 \wedge \dots \wedge h_k)`.
    hyperplanes ``(*batch, d + 1)`` -> ``(*batch, binomial(d + 1, d + 1 - k))``."""
    sizes = sorted({h.shape[-1] for h in hyperplanes})
    if len(sizes) != 1 or len(hyperplanes) >= sizes[0]:
        raise ValueError(f"meet takes 1 to d hyperplanes (*batch, d + 1), got {len(hyperplanes)} of sizes {sizes}")
    return dual(join(*hyperplanes), sizes[0], len(hyperplanes))


def plucker(points: Tensor) -> Tensor:
    r"""Pluecker coordinates of lines given by two points: :math:`l = (P, 1) \wedge (Q, 1)`, order 01, 02, 03, 12, 13, 23.
    points ``(*batch, n, 2, 3)`` -> ``(*batch, n, 6)``."""
    if points.shape[-2:] != (2, 3):
        raise ValueError(f"points must be (*batch, n, 2, 3), two points of each line, got {tuple(points.shape)}")
    # minor by minor: a seventh of the time of join()
    (a, b, c), (d, e, f) = (point.unbind(-1) for point in points.unbind(-2))
    return torch.stack([a * e - b * d, a * f - c * d, a - d, b * f - c * e, b - e, c - f], dim=-1)


def plucker_form(*, dtype: torch.dtype = torch.float64, device: torch.device | str | None = None) -> Tensor:
    r"""The symmetric form J of lines: :math:`l_1^T J l_2 = \det[P_1, Q_1, P_2, Q_2]`, 0 iff the two lines meet."""
    signs = torch.tensor([1.0, -1.0, 1.0, 1.0, -1.0, 1.0], dtype=dtype, device=device)
    return torch.diag(signs).flip(-1)


# ----------------------------------------------------------------------------------------------------------------------
# The exterior algebra of R^n: products of extensors of any step, and the subspaces they stand for.
#
# The Hodge star is :func:`dyntorch.geometry.extensors.dual`.


def wedge(left: Tensor, right: Tensor, size: int, steps: tuple[int, int]) -> Tensor:
    r"""The join of two extensors, :math:`(A \vee B)_K = \sum_{I \cup J = K} \mathrm{sign}(I, J)\, A_I B_J`. left
    ``(*batch, binomial(size, a))``, right ``(*batch, binomial(size, b))`` -> ``(*batch, binomial(size, a + b))``."""
    for extensor, step in zip((left, right), steps, strict=True):
        check_extensor(extensor, size, step)
    if sum(steps) > size:
        raise ValueError(f"steps {steps} do not fit into {size} coordinates: their join is 0")
    first, second, sign = _splits(size, *steps, left.device)
    return (left[..., first] * right[..., second] * sign.to(left.dtype)).sum(-1)


def extensor_of(basis: Tensor) -> Tensor:
    r"""The extensor of a subspace: the join of its basis, all minors of order a. basis ``(*batch, a, n)`` ->
    ``(*batch, binomial(n, a))``."""
    if basis.ndim < 2 or not 1 <= basis.shape[-2] <= basis.shape[-1]:
        raise ValueError(f"basis must be (*batch, a, n) with 1 <= a <= n, got {tuple(basis.shape)}")
    return join(*basis.unbind(-2))


def subspace_of(extensor: Tensor, size: int, step: int) -> Tensor:
    r"""The subspace of an extensor: all u with :math:`A \vee u = 0`, in the least squares sense where A is no join. extensor
    ``(*batch, binomial(size, step))`` -> ``(*batch, step, size)``."""
    if not 1 <= step <= size:
        raise ValueError(f"step must be 1 to {size}, the number of coordinates, got {step}")
    check_extensor(extensor, size, step)
    eye = torch.eye(size, dtype=extensor.dtype, device=extensor.device)
    if step == size:
        return eye.expand(*extensor.shape[:-1], size, size)
    return null_space(wedge(extensor[..., None, :], eye, size, (step, 1)).mT, step)


@constant
def _splits(size: int, a: int, b: int, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """For every set of a + b coordinates, all ways to cut it: places of both parts and the sign, ``(sets, ways)`` each."""
    place = {step: {s: i for i, s in enumerate(combinations(range(size), step))} for step in (a, b)}
    first, second, sign = [], [], []
    for whole in combinations(range(size), a + b):
        parts = [(part, tuple(i for i in whole if i not in part)) for part in combinations(whole, a)]
        first.append([place[a][part] for part, _ in parts])
        second.append([place[b][rest] for _, rest in parts])
        sign.append([-1 if sum(i > j for i in part for j in rest) % 2 else 1 for part, rest in parts])
    return torch.tensor(first, device=device), torch.tensor(second, device=device), torch.tensor(sign, device=device)


# ----------------------------------------------------------------------------------------------------------------------
# Projections and their inverses on points, with Jacobians, finite at any rank.


def adjugate(matrix: Tensor) -> Tensor:
    r"""The adjugate, :math:`A\,\mathrm{adj}(A) = \det(A)\, I`: the inverse up to scale, finite and smooth at any rank. matrix
    ``(*batch, n, n)`` -> ``(*batch, n, n)``."""
    n = matrix.shape[-1]
    # minors in lexicographic order: the last one is without the first row
    minors = compound(matrix, n - 1).flip(-1, -2)
    signs = 1.0 - 2.0 * (torch.arange(n, device=matrix.device) % 2).to(matrix.dtype)
    return (minors * (signs[:, None] * signs)).mT


def project(matrix: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    r"""Images :math:`y = \pi(A (x, 1))` of points, and the Jacobian :math:`\partial y / \partial x` of each. matrix
    ``(*batch, e + 1, d + 1)``, points ``(*batch, n, d)`` -> ``(*batch, n, e)``."""
    return dehomogenize(points @ matrix[..., :-1].mT + matrix[..., None, :, -1], matrix[..., None, :, :-1])


def dehomogenize(p: Tensor, derivative: Tensor) -> tuple[Tensor, Tensor]:
    r"""Points :math:`\pi(p)` and the derivative of their coordinates. p ``(*batch, n, e + 1)``, derivative
    ``(*batch, n, e + 1, d)`` -> ``(*batch, n, e)``."""
    depth = finite_depth(p)
    y = p[..., :-1] / depth
    return y, (derivative[..., :-1, :] - y[..., :, None] * derivative[..., -1:, :]) / depth[..., None]


def back_project(matrix: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    r"""Positions :math:`\pi(A^{-1} (x, 1))` of what a sensor measured, and their Jacobians, by way of the adjugate. matrix
    ``(*batch, d + 1, d + 1)``, x ``(*batch, n, d)`` -> ``(*batch, n, d)``."""
    return project(adjugate(matrix), x)


# ----------------------------------------------------------------------------------------------------------------------
# Collineations as they act on lines: from a map of Pluecker coordinates back to the map of points.


PAIRS = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))  # rows of the second compound matrix, as in Pluecker coordinates
TRIPLES = ((0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3))


def compound_root(matrix: Tensor) -> Tensor:
    r"""The collineation whose second compound matrix is given up to scale: :math:`\Lambda = c\, C_2(A)`. matrix
    ``(*batch, 6, 6)`` -> ``(*batch, 4, 4)``."""
    if matrix.ndim < 2 or matrix.shape[-2:] != (6, 6):
        raise ValueError(f"matrix must be (*batch, 6, 6), got {tuple(matrix.shape)}")
    good = (matrix.isfinite().flatten(-2).all(-1) & (matrix.abs().amax((-1, -2)) > 0))[..., None, None]
    safe = torch.where(good, matrix, torch.eye(6, dtype=matrix.dtype, device=matrix.device)).double()
    lines = safe / torch.linalg.matrix_norm(safe, keepdim=True)
    rows, ratio = compound_rows(lines, 4)
    return torch.where(good, unit(_scales(ratio)[..., None] * rows), torch.zeros_like(rows)).to(matrix.dtype)


def compound_rows(lines: Tensor, size: int) -> tuple[Tensor, Tensor]:
    r"""The rows of a matrix, up to a scale each, from its second compound matrix, up to scale as well. lines
    ``(*batch, size (size - 1) / 2, 6)`` -> ``(*batch, size, 4)``."""
    pairs = list(combinations(range(size), 2))
    shared = torch.tensor([[p for p, pair in enumerate(pairs) if i in pair] for i in range(size)], device=lines.device)
    rows = common_point(lines[..., shared, :])
    first, second = torch.tensor(pairs, device=lines.device).unbind(-1)
    joined = join(rows[..., first, :], rows[..., second, :])
    square = joined.square().sum(-1)
    return rows, (joined * lines).sum(-1) / torch.where(square > 0, square, 1.0)


def common_point(lines: Tensor) -> Tensor:
    """The point ``(..., 4)`` of norm 1 that is nearest to all lines ``(..., k, 6)``."""
    # p lies on l iff the dual skew matrix takes it to 0
    return null_space(skew_line(lines @ plucker_form(dtype=lines.dtype, device=lines.device)).flatten(-3, -2))[..., 0, :]


def skew_line(lines: Tensor) -> Tensor:
    """The skew matrix P Q^T - Q P^T of each line, ``(..., 4, 4)``."""
    p01, p02, p03, p12, p13, p23 = lines.unbind(-1)
    o = torch.zeros_like(p01)
    entries = (o, p01, p02, p03, -p01, o, p12, p13, -p02, -p12, o, p23, -p03, -p13, -p23, o)
    return torch.stack(entries, dim=-1).unflatten(-1, (4, 4))


def _scales(ratio: Tensor) -> Tensor:
    r"""The scales :math:`\rho_i` of the rows from :math:`k_{ij} = c \rho_i \rho_j`, ``(*batch, 4)``, up to a common one."""
    place = {pair: p for p, pair in enumerate(PAIRS)}
    sign = torch.where(ratio < 0, -1.0, 1.0).to(ratio.dtype)
    triples = [sign[..., place[i, j]] * sign[..., place[j, k]] * sign[..., place[i, k]] for i, j, k in TRIPLES]
    common = torch.where(torch.stack(triples).sum(0) < 0, -1.0, 1.0).to(ratio.dtype)
    # least squares of log|rho_i| + log|rho_j| = log|k_ij|
    logs = ratio.abs().clamp(min=torch.finfo(ratio.dtype).tiny).log()
    sums = torch.stack([logs[..., [p for p, pair in enumerate(PAIRS) if i in pair]].sum(-1) for i in range(4)], dim=-1)
    size = ((sums - sums.sum(-1, keepdim=True) / 6) / 2).exp()
    turned = [torch.ones_like(common)] + [common * sign[..., place[0, j]] for j in range(1, 4)]
    return size * torch.stack(turned, dim=-1)


# ----------------------------------------------------------------------------------------------------------------------
# Line cameras: how a camera maps the lines of space to the lines of its image, and back from such maps to cameras of points.


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
