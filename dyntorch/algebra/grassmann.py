"""Grassmann tensors: the determinants of rows chosen from several projections P^k -> P^l."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import torch
from torch import Tensor

from dyntorch.algebra.extensors import compound, dual
from dyntorch.algebra.exterior import wedge
from dyntorch.constants import constant


def grassmann_tensor(projections: Sequence[Tensor], profile: Sequence[int]) -> Tensor:
    r"""The Grassmann tensor of projections: :math:`A_{I_1 \dots I_n} = \det(\text{rows } I_1 \text{ of } M_1, \dots, I_n
    \text{ of } M_n)`, with :math:`|I_i| = \alpha_i` and :math:`\sum \alpha_i = k + 1`.

    With hyperplanes :math:`S_i\ (\alpha_i \times m_i)` through the images of one point,
    :math:`\langle A, \bigotimes_i C_{\alpha_i}(S_i) \rangle = \det(S_1 M_1; \dots; S_n M_n) = 0`.

    Args:
        projections: :math:`M_i`, ``(*batch, m_i, k + 1)``; batch dimensions broadcast.
        profile: :math:`\alpha_i`, from 1 to :math:`m_i`.

    Returns:
        ``(*batch, binomial(m_1, alpha_1), ..., binomial(m_n, alpha_n))``, subsets in lexicographic order, not scaled.
        Joins of the compound matrices: a polynomial, with exact derivatives also where minors are singular.

    Raises:
        ValueError: another number of projections than the profile has entries, of different widths, or a profile whose sum
            is not their width.

    Source: Hartley and Schaffalitzky 2004; thesis chapter 3.

    Example:
        >>> import torch
        >>> P = torch.rand(2, 3, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        >>> F = grassmann_tensor(P, (2, 2))  # the fundamental matrix, lines of both views by their two rows
        >>> F.shape, bool(torch.isclose(F[0, 2], torch.linalg.det(torch.cat([P[0, [0, 1]], P[1, [1, 2]]]))))
        (torch.Size([3, 3]), True)
    """
    size = _check(projections, profile)
    parts = [compound(m, a) for m, a in zip(projections, profile, strict=True)]
    # two halves of about the same step, whose last product is one matrix product
    cut = 1 + next(i for i in range(len(profile)) if 2 * sum(profile[: i + 1]) >= size)
    cut = min(cut, len(profile) - 1)
    left, step = _joined(parts[:cut], profile[:cut], size)
    right, _ = _joined(parts[cut:], profile[cut:], size)
    sign = -1 if step * (size - step) % 2 else 1  # of (I, I^c) against (I^c, I)
    tensor = left @ (sign * dual(right, size, size - step)).mT
    return tensor.flatten(-2).unflatten(-1, [int(p.shape[-2]) for p in parts])


def _joined(parts: Sequence[Tensor], steps: Sequence[int], size: int) -> tuple[Tensor, int]:
    """The joins of one row of each part, ``(*batch, rows, binomial(size, total step))``, and the step."""
    total, step = parts[0], steps[0]
    for part, more in zip(parts[1:], steps[1:], strict=True):
        total = wedge(total[..., :, None, :], part[..., None, :, :], size, (step, more)).flatten(-3, -2)
        step += more
    return total, step


def grassmann_derivative(projections: Sequence[Tensor], profile: Sequence[int]) -> tuple[Tensor, Tensor]:
    r"""The Grassmann tensor and its derivative by the entries of all projections, several times cheaper than forward mode.

    With W the join of all other views, :math:`A = C_{\alpha_i}(M_i)\, W^T`, and minors have minors as derivatives.

    Args:
        projections: ``(*batch, m_i, k + 1)``.
        profile: as in :func:`grassmann_tensor`.

    Returns:
        ``(*batch, D)`` and ``(*batch, p, D)``, p the entries of the first projection, the second, and so on, row by row.

    Example:
        >>> import torch
        >>> M = torch.rand(2, 3, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        >>> value, derivative = grassmann_derivative(M, (2, 2))
        >>> bool(torch.allclose(derivative[:12].T @ M[0].flatten(), 2 * value))  # homogeneous, of degree two in each view
        True
    """
    size = _check(projections, profile)
    parts = [compound(m, a) for m, a in zip(projections, profile, strict=True)]
    derivatives, lengths = [], [int(p.shape[-2]) for p in parts]
    value: Tensor | None = None
    for i, (matrix, order) in enumerate(zip(projections, profile, strict=True)):
        others, step = _joined([*parts[:i], *parts[i + 1 :]], [*profile[:i], *profile[i + 1 :]], size)
        # the rows of this view stand before those of the later ones
        sign = -1 if order * sum(profile[i + 1 :]) % 2 else 1
        weight = sign * dual(others, size, step)
        if value is None:
            value = (parts[0] @ weight.mT).flatten(-2)
        slope = _minor_slopes(matrix, order, weight).unflatten(-1, lengths[:i] + lengths[i + 1 :])
        # (.., r c, I_i, other views) to the order of the views
        derivatives.append(slope.movedim(-len(lengths), i - len(lengths)).flatten(-len(lengths)))
    assert value is not None
    return value, torch.cat(derivatives, dim=-2)


def _check(projections: Sequence[Tensor], profile: Sequence[int]) -> int:
    size = sum(profile)
    if len(projections) != len(profile) or len(profile) < 2 or {int(m.shape[-1]) for m in projections} != {size}:
        shapes = [tuple(m.shape[-2:]) for m in projections]
        raise ValueError(f"a profile {tuple(profile)} takes {max(2, len(profile))} projections of {size} columns, got {shapes}")
    return size


def _minor_slopes(matrix: Tensor, order: int, weight: Tensor) -> Tensor:
    r"""Derivative ``(*batch, rows * K, sets I, rest)`` of :math:`C_a(M) W^T` by the entries of M, for W ``(*batch, rest, sets S)``.

    :math:`\partial \det M_{IS} / \partial M_{rc} = \pm \det M_{I \setminus r, S \setminus c}` for r in I and c in S.
    """
    rows, columns = matrix.shape[-2:]
    place, sign = _removals(columns, order, matrix.device)
    taken = (weight[..., place] * sign.to(matrix.dtype)).movedim(-3, -1)  # (.., c, T, rest)
    smaller = compound(matrix, order - 1) if order > 1 else torch.ones_like(matrix[..., :1, :1])
    inner = smaller[..., None, :, :] @ taken  # (.., c, U, rest)
    place, sign = _insertions(rows, order, matrix.device)
    # (.., c, r, I, rest): the sets without a row that they have; sign 0 where they do not
    slope = inner[..., place, :] * sign.to(matrix.dtype)[..., None]
    return slope.movedim(-4, -3).flatten(-4, -3)


@constant
def _removals(size: int, order: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """For every element c and set T of ``order - 1`` others: the place of c with T among the sets, and the sign; 0 if c is in T."""
    place = {s: i for i, s in enumerate(combinations(range(size), order))}
    smaller = list(combinations(range(size), order - 1))
    found = [[place.get(tuple(sorted((c, *t))), 0) for t in smaller] for c in range(size)]
    signs = [[0 if c in t else (-1) ** sum(i < c for i in t) for t in smaller] for c in range(size)]
    return torch.tensor(found, device=device), torch.tensor(signs, device=device)


@constant
def _insertions(size: int, order: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """For every element r and set I: the place of I without r among the smaller sets, and the sign; 0 if r is not in I."""
    place = {s: i for i, s in enumerate(combinations(range(size), order - 1))}
    sets = list(combinations(range(size), order))
    found = [[place.get(tuple(i for i in s if i != r), 0) for s in sets] for r in range(size)]
    signs = [[(-1) ** s.index(r) if r in s else 0 for s in sets] for r in range(size)]
    return torch.tensor(found, device=device), torch.tensor(signs, device=device)
