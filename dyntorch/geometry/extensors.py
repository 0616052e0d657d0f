"""Extensors: joins of points, meets of hyperplanes, Pluecker coordinates of lines, compound matrices, the Levi-Civita tensor."""

from __future__ import annotations

from itertools import combinations, permutations
from math import comb

import torch
from torch import Tensor

from dyntorch.geometry.homogeneous import finite_depth, homogeneous, unit
from dyntorch.numerics.blocks import constant
from dyntorch.numerics.nullspace import null_space


def levi_civita(n: int, *, dtype: torch.dtype = torch.float64, device: torch.device | str | None = None) -> Tensor:
    r"""The alternating tensor :math:`\epsilon_{i_1 \dots i_n}`: the sign of the permutation, 0 where an index repeats.

    Args:
        n: its order and size, 1 to 6.

    Returns:
        ``(n, ..., n)`` with ``n`` dimensions.  The tensor is cached and shared: do not write into it.

    Raises:
        ValueError: ``n`` outside 1 to 6 (n^n entries).

    Example:
        >>> e = levi_civita(3)
        >>> float(e[0, 1, 2]), float(e[1, 0, 2]), float(e[0, 0, 2])
        (1.0, -1.0, 0.0)
    """
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
    r"""The compound matrix :math:`C_k(A)`: all minors of order k, rows and columns in lexicographic order.

    It is how a collineation acts on extensors, :math:`C_k(A)\,(p_1 \wedge \dots \wedge p_k) = A p_1 \wedge \dots \wedge A p_k`,
    so that :math:`C_k(AB) = C_k(A)\,C_k(B)` (Cauchy-Binet).

    Args:
        matrix: ``(*batch, r, c)``.
        order: k, from 1 to ``min(r, c)``.

    Returns:
        ``(*batch, binomial(r, k), binomial(c, k))``.  Polynomials of the entries (Laplace), so gradients are exact at any rank.

    Raises:
        ValueError: an order for which there are no minors.

    Source: thesis section 8.4 (the compound of A maps lines).

    Example:
        >>> import torch
        >>> compound(torch.tensor([[1.0, 2.0], [3.0, 4.0]]), 2).tolist()
        [[-2.0]]
    """
    if matrix.ndim < 2 or not 1 <= order <= min(matrix.shape[-2:]):
        raise ValueError(f"order must be 1 to min(rows, columns) of the matrix, got {order} for {tuple(matrix.shape)}")
    result = matrix
    for k in range(2, order + 1):
        result = _expand(matrix, result, k)
    return result


def _expand(matrix: Tensor, smaller: Tensor, order: int) -> Tensor:
    """Minors of one order from those of the order below, by Laplace expansion along the first row."""
    rows, columns = matrix.shape[-2:]
    first, rest, _, _ = _laplace(rows, order, matrix.device)
    _, _, taken, left = _laplace(columns, order, matrix.device)
    terms = (
        (-1) ** j * matrix[..., first[:, None], taken[j][None, :]] * smaller[..., rest[:, None], left[j][None, :]]
        for j in range(order)
    )
    return torch.stack(list(terms)).sum(0)


@constant
def _laplace(n: int, order: int, device: torch.device) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Index tables of a Laplace expansion of the minors of ``order`` among ``n`` lines.

    For every combination: its first line, where the rest stands among the smaller combinations, and, for each j, its j-th
    line ``(order, count)`` and where the combination without it stands ``(order, count)``.
    """
    place = {c: i for i, c in enumerate(combinations(range(n), order - 1))}
    sets = list(combinations(range(n), order))
    taken = [[c[j] for c in sets] for j in range(order)]
    left = [[place[c[:j] + c[j + 1 :]] for c in sets] for j in range(order)]
    chosen, place_left = torch.tensor(taken, device=device), torch.tensor(left, device=device)
    return chosen[0], place_left[0], chosen, place_left


def join(*points: Tensor) -> Tensor:
    r"""The extensor :math:`p_1 \wedge \dots \wedge p_k` that the points span: their k-minors in lexicographic order.

    Two points give the Pluecker coordinates :math:`p_i q_j - p_j q_i` of their line, in space in the order 01, 02, 03, 12,
    13, 23; ``d + 1`` points give their determinant.  It is 0 where the points are dependent.

    Args:
        points: k tensors ``(*batch, d + 1)``, homogeneous, k from 1 to ``d + 1``; batch dimensions broadcast.

    Returns:
        ``(*batch, binomial(d + 1, k))``.

    Raises:
        ValueError: no points, more than ``d + 1``, or of different dimensions.

    Example:
        >>> import torch
        >>> join(torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 1.0, 0.0])).tolist()
        [1.0, 0.0, 0.0]
    """
    sizes = sorted({p.shape[-1] for p in points})
    if len(sizes) != 1 or len(points) > sizes[0]:
        raise ValueError(f"join takes 1 to d + 1 points (*batch, d + 1), got {len(points)} of sizes {sizes}")
    return compound(torch.stack(torch.broadcast_tensors(*points), dim=-2), len(points))[..., 0, :]


def dual(extensor: Tensor, size: int, step: int) -> Tensor:
    r"""The complementary extensor: :math:`e_S \mapsto \pm e_{\bar S}`, with the sign of the permutation :math:`(S, \bar S)`.

    Args:
        extensor: ``(*batch, binomial(size, step))``, lexicographic.
        size: number of homogeneous coordinates, ``d + 1``.
        step: number of points (or hyperplanes) the extensor was joined from, 0 to ``size``.

    Returns:
        ``(*batch, binomial(size, size - step))``.

    Raises:
        ValueError: a step outside 0 to ``size``, or the length is not the binomial coefficient.

    Example:
        >>> import torch
        >>> dual(torch.tensor([1.0, 2.0, 3.0]), 3, 2).tolist()
        [3.0, -2.0, 1.0]
    """
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

    Two lines of the plane give their common point (the cross product), two planes of space the Pluecker coordinates of
    their line, three planes their point.  It is 0 where the hyperplanes are dependent.

    Args:
        hyperplanes: k tensors ``(*batch, d + 1)``, k from 1 to ``d``; batch dimensions broadcast.

    Returns:
        ``(*batch, binomial(d + 1, d + 1 - k))``, up to scale a :func:`join` of points of the intersection.

    Raises:
        ValueError: no hyperplanes, more than ``d``, or of different dimensions.

    Example:
        >>> import torch
        >>> meet(torch.tensor([1.0, 0.0, -2.0]), torch.tensor([0.0, 1.0, -3.0])).tolist()
        [2.0, 3.0, 1.0]
    """
    sizes = sorted({h.shape[-1] for h in hyperplanes})
    if len(sizes) != 1 or len(hyperplanes) >= sizes[0]:
        raise ValueError(f"meet takes 1 to d hyperplanes (*batch, d + 1), got {len(hyperplanes)} of sizes {sizes}")
    return dual(join(*hyperplanes), sizes[0], len(hyperplanes))


def plucker(points: Tensor) -> Tensor:
    r"""Pluecker coordinates of lines given by two points: :math:`l = (P, 1) \wedge (Q, 1)`, order 01, 02, 03, 12, 13, 23.

    Args:
        points: ``(*batch, n, 2, 3)`` inhomogeneous.

    Returns:
        ``(*batch, n, 6)``; the direction of the line, negated, is in 03, 13, 23.

    Raises:
        ValueError: not two points of space per line.

    Example:
        >>> import torch
        >>> plucker(torch.tensor([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]])).tolist()
        [[0.0, 0.0, -1.0, 0.0, 0.0, 0.0]]
    """
    if points.shape[-2:] != (2, 3):
        raise ValueError(f"points must be (*batch, n, 2, 3), two points of each line, got {tuple(points.shape)}")
    first, second = homogeneous(points).unbind(-2)
    return join(first, second)


def plucker_form(*, dtype: torch.dtype = torch.float64, device: torch.device | str | None = None) -> Tensor:
    r"""The symmetric form J of lines: :math:`l_1^T J l_2 = \det[P_1, Q_1, P_2, Q_2]`, 0 iff the two lines meet.

    Returns:
        ``(6, 6)``, its own inverse; :math:`C_2(A)^T J\, C_2(A) = \det(A)\, J`.

    Example:
        >>> import torch
        >>> l = plucker(torch.rand(1, 2, 3, dtype=torch.float64))[0]
        >>> abs(float(l @ plucker_form() @ l)) < 1e-12
        True
    """
    signs = torch.tensor([1.0, -1.0, 1.0, 1.0, -1.0, 1.0], dtype=dtype, device=device)
    return torch.diag(signs).flip(-1)


# ----------------------------------------------------------------------------------------------------------------------
# The exterior algebra of R^n: products of extensors of any step, and the subspaces they stand for.
#
# The Hodge star is :func:`dyntorch.geometry.extensors.dual`.


def wedge(left: Tensor, right: Tensor, size: int, steps: tuple[int, int]) -> Tensor:
    r"""The join of two extensors, :math:`(A \vee B)_K = \sum_{I \cup J = K} \mathrm{sign}(I, J)\, A_I B_J`.

    It spans both subspaces, and is 0 iff they meet.  :math:`A \vee B = (-1)^{ab} B \vee A`.

    Args:
        left: ``(*batch, binomial(size, a))``, lexicographic.
        right: ``(*batch, binomial(size, b))``; batch dimensions broadcast.
        size: number of homogeneous coordinates n.
        steps: a and b, with :math:`a + b \le n`.

    Returns:
        ``(*batch, binomial(size, a + b))``.  A polynomial of the entries: derivatives of any order and mode exist everywhere.

    Raises:
        ValueError: steps that do not fit into the space, or extensors of another length.

    Source: Barnabei, Brini and Rota 1985.

    Example:
        >>> import torch
        >>> point, line = torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 0.0, 1.0])  # e_0, and e_1 v e_2
        >>> wedge(point, line, 3, (1, 2)).tolist()
        [1.0]
    """
    for extensor, step in zip((left, right), steps, strict=True):
        check_extensor(extensor, size, step)
    if sum(steps) > size:
        raise ValueError(f"steps {steps} do not fit into {size} coordinates: their join is 0")
    first, second, sign = _splits(size, *steps, left.device)
    return (left[..., first] * right[..., second] * sign.to(left.dtype)).sum(-1)


def regressive(left: Tensor, right: Tensor, size: int, steps: tuple[int, int]) -> Tensor:
    r"""The meet of two extensors, the regressive product: :math:`*(A \wedge B) = *A \vee *B`.

    It spans the intersection of both subspaces where together they span the space, and is 0 where they do not: planes of
    P^4 that share a line, say.  With :math:`c = a + b - n`

    .. math:: A \wedge B = (-1)^{c (n - c)}\, {*({*A} \vee {*B})} = (-1)^{(n - a)(n - b)}\, B \wedge A,

    which is associative, agrees without a sign with :func:`~dyntorch.geometry.extensors.meet` of hyperplanes, and for c = 0 is
    the scalar :math:`A \vee B`.

    Args:
        left: ``(*batch, binomial(size, a))``, lexicographic.
        right: ``(*batch, binomial(size, b))``; batch dimensions broadcast.
        size: number of homogeneous coordinates n.
        steps: a and b, with :math:`a + b \ge n`.

    Returns:
        ``(*batch, binomial(size, a + b - size))``, a polynomial of the entries.

    Raises:
        ValueError: steps too small to meet in general position, or extensors of another length.

    Source: Barnabei, Brini and Rota 1985.

    Example:
        >>> import torch
        >>> floor, wall = torch.tensor([1.0, 0.0, 0.0, 0.0]), torch.tensor([0.0, 0.0, 0.0, 1.0])  # e_0 e_1 e_2 and e_1 e_2 e_3
        >>> regressive(floor, wall, 4, (3, 3)).int().tolist()  # the line e_1 v e_2
        [0, 0, 0, 1, 0, 0]
    """
    for extensor, step in zip((left, right), steps, strict=True):
        check_extensor(extensor, size, step)
    c = sum(steps) - size
    if c < 0:
        raise ValueError(f"steps {steps} do not meet in general position among {size} coordinates: their sum must reach {size}")
    first, second = (dual(x, size, step) for x, step in zip((left, right), steps, strict=True))
    product = dual(wedge(first, second, size, (size - steps[0], size - steps[1])), size, size - c)
    return -product if c * (size - c) % 2 else product


def extensor_of(basis: Tensor) -> Tensor:
    r"""The extensor of a subspace: the join of its basis, all minors of order a.

    Args:
        basis: ``(*batch, a, n)``, one vector per row, a from 1 to n.

    Returns:
        ``(*batch, binomial(n, a))``, lexicographic; another basis of the subspace only scales it, and it is 0 where the rows
        are dependent.

    Raises:
        ValueError: no rows, or more rows than columns.

    Example:
        >>> import torch
        >>> extensor_of(torch.tensor([[1.0, 2.0, 0.0], [0.0, 1.0, 3.0]])).tolist()
        [1.0, 3.0, 6.0]
    """
    if basis.ndim < 2 or not 1 <= basis.shape[-2] <= basis.shape[-1]:
        raise ValueError(f"basis must be (*batch, a, n) with 1 <= a <= n, got {tuple(basis.shape)}")
    return join(*basis.unbind(-2))


def subspace_of(extensor: Tensor, size: int, step: int) -> Tensor:
    r"""The subspace of an extensor: all u with :math:`A \vee u = 0`, in the least squares sense where A is no join.

    Args:
        extensor: ``(*batch, binomial(size, step))``, lexicographic, of any scale; not 0, for which every subspace would do.
        size: number of homogeneous coordinates n.
        step: dimension of the subspace, 1 to ``size``.

    Returns:
        ``(*batch, step, size)`` orthonormal rows, NaN where the extensor is not finite.  Differentiable.  Rounding may decide
        which of the bases it is.

    Raises:
        ValueError: a step that is no dimension of a subspace, or an extensor of another length.

    Example:
        >>> import torch
        >>> line = extensor_of(torch.tensor([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 2.0, 0.0]], dtype=torch.float64))
        >>> subspace_of(line, 4, 2).square().sum(-2).round(decimals=6).tolist()
        [1.0, 0.0, 1.0, 0.0]
    """
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
    r"""The adjugate, :math:`A\,\mathrm{adj}(A) = \det(A)\, I`: the inverse up to scale, finite and smooth at any rank.

    Args:
        matrix: ``(*batch, n, n)``, n from 2 to 4 in this library.

    Returns:
        ``(*batch, n, n)``, polynomials of the entries.

    Example:
        >>> import torch
        >>> adjugate(torch.tensor([[1.0, 2.0], [3.0, 4.0]])).tolist()
        [[4.0, -2.0], [-3.0, 1.0]]
    """
    n = matrix.shape[-1]
    # minors in lexicographic order: the last one is without the first row
    minors = compound(matrix, n - 1).flip(-1, -2)
    signs = 1.0 - 2.0 * (torch.arange(n, device=matrix.device) % 2).to(matrix.dtype)
    return (minors * (signs[:, None] * signs)).mT


def project(matrix: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    r"""Images :math:`y = \pi(A (x, 1))` of points, and the Jacobian :math:`\partial y / \partial x` of each.

    Args:
        matrix: ``(*batch, e + 1, d + 1)`` collineation or projection of any scale and sign.
        points: ``(*batch, n, d)``.

    Returns:
        ``(*batch, n, e)``, images at infinity as in :func:`~dyntorch.geometry.homogeneous.inhomogeneous`, and
        ``(*batch, n, e, d)``.

    Example:
        >>> import torch
        >>> camera = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
        >>> image, jacobian = project(camera, torch.tensor([[6.0, 2.0]]))
        >>> image.tolist(), jacobian.tolist()
        ([[3.0]], [[[0.5, -1.5]]])
    """
    return dehomogenized(points @ matrix[..., :-1].mT + matrix[..., None, :, -1], matrix[..., None, :, :-1])


def dehomogenized(p: Tensor, derivative: Tensor) -> tuple[Tensor, Tensor]:
    r"""Points :math:`\pi(p)` and the derivative of their coordinates.

    Args:
        p: ``(*batch, n, e + 1)`` homogeneous points of any scale.
        derivative: ``(*batch, n, e + 1, d)`` of p, at the same scale; multiples of p in it do not matter.

    Returns:
        ``(*batch, n, e)`` and ``(*batch, n, e, d)``.
    """
    depth = finite_depth(p)
    y = p[..., :-1] / depth
    return y, (derivative[..., :-1, :] - y[..., :, None] * derivative[..., -1:, :]) / depth[..., None]


def back_project(matrix: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    r"""Positions :math:`\pi(A^{-1} (x, 1))` of what a sensor measured, and their Jacobians, by way of the adjugate.

    Args:
        matrix: ``(*batch, d + 1, d + 1)`` world to sensor, of any scale and sign.
        x: ``(*batch, n, d)`` measurements.

    Returns:
        ``(*batch, n, d)`` and ``(*batch, n, d, d)``.

    Example:
        >>> import torch
        >>> back_project(torch.diag(torch.tensor([2.0, 4.0, 1.0])), torch.tensor([[2.0, 4.0]]))[0].tolist()
        [[1.0, 1.0]]
    """
    return project(adjugate(matrix), x)


# ----------------------------------------------------------------------------------------------------------------------
# Collineations as they act on lines: from a map of Pluecker coordinates back to the map of points.


PAIRS = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))  # rows of the second compound matrix, as in Pluecker coordinates
TRIPLES = ((0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3))


def compound_root(matrix: Tensor) -> Tensor:
    r"""The collineation whose second compound matrix is given up to scale: :math:`\Lambda = c\, C_2(A)`.

    Row (i, j) of the compound matrix is the line through the rows i and j of A, taken as points.  Row i of A is thus the
    common point :math:`a_i` of three lines, up to a scale :math:`\rho_i`.  These scales follow from

    .. math:: k_{ij} = \langle a_i \wedge a_j, \Lambda_{ij} \rangle / \|a_i \wedge a_j\|^2 = c\, \rho_i \rho_j :

    the sign of c is that of :math:`k_{ij} k_{jl} k_{il}`, the rest is linear in the logarithms.

    Args:
        matrix: ``(*batch, 6, 6)`` of any scale and sign; with noise least squares in each step.

    Returns:
        ``(*batch, 4, 4)`` A of norm 1 and canonical sign; 0 for a matrix that is 0 or not finite.

    Raises:
        ValueError: another shape.

    Source: thesis section 8.4; the scales and signs, without which the rows are no collineation, are derived here.

    Example:
        >>> import torch
        >>> compound_root(-3 * torch.eye(6)).diagonal().tolist()
        [0.5, 0.5, 0.5, 0.5]
    """
    if matrix.ndim < 2 or matrix.shape[-2:] != (6, 6):
        raise ValueError(f"matrix must be (*batch, 6, 6), got {tuple(matrix.shape)}")
    good = (matrix.isfinite().flatten(-2).all(-1) & (matrix.abs().amax((-1, -2)) > 0))[..., None, None]
    safe = torch.where(good, matrix, torch.eye(6, dtype=matrix.dtype, device=matrix.device)).double()
    lines = safe / torch.linalg.matrix_norm(safe, keepdim=True)
    rows, ratio = compound_rows(lines, 4)
    return torch.where(good, unit(_scales(ratio)[..., None] * rows), torch.zeros_like(rows)).to(matrix.dtype)


def compound_rows(lines: Tensor, size: int) -> tuple[Tensor, Tensor]:
    r"""The rows of a matrix, up to a scale each, from its second compound matrix, up to scale as well.

    Args:
        lines: ``(*batch, size (size - 1) / 2, 6)``, the lines that pairs of rows span, in lexicographic order.
        size: number of rows.

    Returns:
        rows :math:`a_i` of norm 1 ``(*batch, size, 4)``, and :math:`k_{ij} = \langle a_i \wedge a_j, \Lambda_{ij} \rangle /
        \|a_i \wedge a_j\|^2`, one for each line.
    """
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
