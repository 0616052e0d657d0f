"""What a three-view tensor of the form eps(A, B) tells by contraction alone: static maps between views, and the third vector."""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.algebra.rank_two import cofactors, null_vectors

AXES = "ijk"


def static_map(tensor: Tensor, vectors: Tensor, source: int, target: int) -> Tensor:
    """Static homogeneous vectors ``(*batch, n, 3)`` of one view carried to another, in float64."""
    return null_vectors(_contraction(tensor, vectors, source, target))[0]


def static_map_derivative(tensor: Tensor, vectors: Tensor, source: int, target: int) -> tuple[Tensor, Tensor]:
    r"""Image y of :func:`static_map` and its derivative ``(*batch, n, 3, 3)`` by the source vector, up to multiples of y.

    From :math:`y^T M = 0`: :math:`dy^T M = -y^T dM`, solved with M completed to full rank by its null vectors.
    """
    matrix = _contraction(tensor, vectors, source, target)
    left, right = null_vectors(matrix)
    size = torch.linalg.matrix_norm(matrix, keepdim=True)
    full = matrix + size * left[..., :, None] * right[..., None, :]
    cofactor = cofactors(full)
    det = (cofactor[..., 0] * full[..., 0]).sum(-1)[..., None, None]
    # a determinant of zero means a tensor of zeros, or of lower rank: it maps nothing
    inverse = cofactor / torch.where(det == 0, torch.ones_like(det), det)
    other = AXES[6 - source - target - 1]
    change = torch.einsum(f"...{AXES},...n{AXES[target - 1]}->...n{other}{AXES[source - 1]}", tensor.double(), left)
    return left, -inverse @ change


def third_vector(tensor: Tensor, a: Tensor, b: Tensor, view: int) -> Tensor:
    """Contract the two views other than ``view`` with vectors ``(*batch, n, 3)``, in float64."""
    if view not in (1, 2, 3):
        raise ValueError(f"view must be 1, 2 or 3, got {view}")
    first, second = (axis for axis in AXES if axis != AXES[view - 1])
    return torch.einsum(f"...{AXES},...n{first},...n{second}->...n{AXES[view - 1]}", tensor.double(), a.double(), b.double())


def _contraction(tensor: Tensor, vectors: Tensor, source: int, target: int) -> Tensor:
    """``(*batch, n, 3, 3)``: axes of the target view and of the remaining one, in float64."""
    if {source, target} - {1, 2, 3} or source == target:
        raise ValueError(f"source and target must be two different views of 1, 2, 3, got {source} and {target}")
    to, other = AXES[target - 1], AXES[6 - source - target - 1]
    return torch.einsum(f"...{AXES},...n{AXES[source - 1]}->...n{to}{other}", tensor.double(), vectors.double())


def unit_normal(line: Tensor) -> Tensor:
    """The line with a unit normal; the line at infinity, which has none, is kept finite, and zero stays zero."""
    floor = torch.finfo(line.dtype).eps * line.detach().abs().amax(dim=-1, keepdim=True)
    size = torch.maximum(torch.linalg.vector_norm(line[..., :2], dim=-1, keepdim=True), floor)
    return line / torch.where(size > 0, size, torch.ones_like(size))
