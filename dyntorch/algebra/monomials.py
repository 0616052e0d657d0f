"""Monomials of the coordinates of vectors, and where they are in symmetric matrices and products of linear forms."""

from __future__ import annotations

from itertools import combinations_with_replacement

import torch
from torch import Tensor

from dyntorch.constants import constant


def monomials(p: Tensor, degree: int) -> Tensor:
    """All monomials ``(*batch, width, n)`` of one degree of vectors ``(*batch, d + 1, n)``, which need not end in 1.

    Example:
        >>> import torch
        >>> monomials(torch.tensor([[2.0], [3.0], [-1.0]]), 2).flatten().tolist()
        [4.0, 6.0, -2.0, 9.0, -3.0, 1.0]
    """
    table = factors(degree, p.shape[-2] - 1, p.device).unbind(-1)
    product = p.index_select(-2, table[0])
    for factor in table[1:]:
        product = product * p.index_select(-2, factor)
    return product


def monomial_derivatives(p: Tensor, degree: int, count: int) -> Tensor:
    r"""Derivatives ``(*batch, n, width, count)`` of the monomials of vectors ``(*batch, n, d + 1)`` by their first coordinates.

    Example:
        >>> import torch
        >>> monomial_derivatives(torch.tensor([[2.0, 3.0, -1.0]]), 2, 3)[0, 1].tolist()  # of x y
        [3.0, 2.0, 0.0]
    """
    table = factors(degree, p.shape[-1] - 1, p.device)
    eye = torch.eye(p.shape[-1], count, dtype=p.dtype, device=p.device)
    total = torch.zeros_like(p[..., :1, None])
    # one factor at a time replaced by its derivative
    for i in range(degree):
        term = eye[table[:, i]]
        for j in range(degree):
            term = term if j == i else term * p[..., table[:, j], None]
        total = total + term
    return total


@constant
def symmetric(dim: int, device: torch.device) -> Tensor:
    """Where the monomials of degree two are in a symmetric matrix, ``(dim + 1, dim + 1)``."""
    table = torch.tensor(list(combinations_with_replacement(range(dim + 1), 2)))
    place = torch.zeros(dim + 1, dim + 1, dtype=torch.long)
    place[table[:, 0], table[:, 1]] = place[table[:, 1], table[:, 0]] = torch.arange(len(table))
    return place.to(device)


@constant
def factors(degree: int, dim: int, device: torch.device) -> Tensor:
    """The coordinates in each monomial, ``(width, degree)``, ascending."""
    return torch.tensor(list(combinations_with_replacement(range(dim + 1), degree)), device=device)


@constant
def collecting(degree: int, dim: int, device: torch.device) -> Tensor:
    r"""Which products of coordinates are which monomial: C with :math:`p \otimes \dots \otimes p = C^T \nu(p)`, 0 and 1.

    The coefficients of a product of linear forms are :math:`C (a \otimes b \otimes \dots)`.  ``(width, (dim + 1)^degree)``.
    """
    grids = torch.meshgrid(*[torch.arange(dim + 1)] * degree, indexing="ij")
    every = torch.stack([grid.flatten() for grid in grids], dim=-1).sort(-1).values
    table = torch.tensor(list(combinations_with_replacement(range(dim + 1), degree)))
    return (table[:, None] == every).all(-1).double().to(device)


@constant
def multiplicity(degree: int, dim: int, device: torch.device) -> Tensor:
    """How many products of coordinates are each monomial, ``(width,)``."""
    return collecting(degree, dim, torch.device("cpu")).sum(-1).to(device)
