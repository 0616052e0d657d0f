"""Extensors: joins of points, meets of hyperplanes, Pluecker coordinates of lines, compound matrices, the Levi-Civita tensor."""

from __future__ import annotations

from itertools import combinations, permutations
from math import comb

import torch
from torch import Tensor

from dyntorch.algebra.homogeneous import homogeneous
from dyntorch.constants import constant


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
