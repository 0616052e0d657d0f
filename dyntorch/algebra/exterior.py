"""The exterior algebra of R^n: products of extensors of any step, and the subspaces they stand for.

The Hodge star is :func:`dyntorch.algebra.extensors.dual`.
"""

from __future__ import annotations

from itertools import combinations

import torch
from torch import Tensor

from dyntorch.algebra.extensors import check_extensor, dual, join
from dyntorch.constants import constant
from dyntorch.nullspace import null_space


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

    which is associative, agrees without a sign with :func:`~dyntorch.algebra.extensors.meet` of hyperplanes, and for c = 0 is
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
