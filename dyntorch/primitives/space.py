"""Lines of space, and points of space seen through given cameras."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.algebra.extensors import compound, join, plucker, plucker_form
from dyntorch.algebra.homogeneous import homogeneous
from dyntorch.primitives.base import Primitive, inverse


def direction(line: Tensor) -> Tensor:
    """Direction ``(..., 3)`` from the first to the second point of Pluecker lines ``(..., 6)``: P3 Q - Q3 P."""
    # one by one: a list of indices would have to be copied to an accelerator
    return -torch.stack([line[..., 2], line[..., 4], line[..., 5]], dim=-1)


@dataclass(frozen=True, repr=False)
class Line(Primitive):
    """A line of space: two points on it ``(*batch, n, 2, 3)``, or Pluecker coordinates ``(*batch, n, 6)`` (01,02,03,12,13,23)."""

    dim: int = 3
    width: int = 6

    def shapes(self) -> tuple[tuple[int, ...], ...]:
        return ((2, 3), (6,))

    def raw(self, x: Tensor) -> Tensor:
        return plucker(x) if self._as_points(x) else x

    def components(self, x: Tensor) -> Tensor:
        """Scaled by the length of the segment: a longer one is a better line (its square root is best, measured: 1.2 to 0.8)."""
        line = self.raw(x)
        length = direction(line).norm(dim=-1, keepdim=True).clamp(min=torch.finfo(x.dtype).eps)
        return (line / (length.sqrt() if self._as_points(x) else length)).mT

    def freedom(self) -> int:
        return 2 * (self.dim - 1)

    def free(self, x: Tensor) -> Tensor:
        """A line that lies still may be replaced by any line that meets it."""
        dual = torch.nn.functional.normalize(self.raw(x) @ plucker_form(dtype=x.dtype, device=x.device), dim=-1)
        eye = torch.eye(6, dtype=x.dtype, device=x.device)
        return eye - dual[..., :, None] * dual[..., None, :]

    def action(self, transform: Tensor) -> Tensor:
        return compound(transform, 2)

    def pullback(self, x: Tensor, gradient: Tensor) -> Tensor:
        if not self._as_points(x):
            return gradient
        # l = P ^ Q is bilinear: with the skew matrix W of the gradient, dh/dP = W Q and dh/dQ = -W P
        skew = torch.zeros(*gradient.shape[:-1], 4, 4, dtype=gradient.dtype, device=gradient.device)
        rows, columns = torch.triu_indices(4, 4, 1, device=gradient.device)
        skew[..., rows, columns] = gradient
        skew = skew - skew.mT
        first, second = homogeneous(x).unbind(-2)
        return torch.cat([(skew @ second[..., None])[..., :3, 0], -(skew @ first[..., None])[..., :3, 0]], dim=-1)

    def pushforward(self, x: Tensor, change: Tensor) -> Tensor:
        if not self._as_points(x):
            return change
        first, second = homogeneous(x).unbind(-2)
        moved = torch.nn.functional.pad(change.unflatten(-1, (2, 3)), (0, 1))
        return join(moved[..., 0, :], second) + join(first, moved[..., 1, :])

    def points(self, x: Tensor, weights: Tensor | None = None) -> Tensor:
        return x if self._as_points(x) else _feet(x).unsqueeze(-2)

    def move(self, x: Tensor, transform: Tensor) -> Tensor:
        if self._as_points(x):
            return torch.addcmul(transform[..., None, None, :-1, -1], x, transform[..., None, :1, :1])
        return x @ compound(transform, 2).mT

    def _as_points(self, x: Tensor) -> bool:
        return x.ndim >= 3 and tuple(x.shape[-2:]) == (2, 3)


def _feet(line: Tensor) -> Tensor:
    """Foot of the perpendicular from the origin of each Pluecker line: direction x moment / |direction|^2."""
    along = direction(line)
    moment = torch.stack([line[..., 3], -line[..., 1], line[..., 0]], dim=-1)
    return torch.linalg.cross(along, moment) / along.square().sum(-1, keepdim=True).clamp(min=torch.finfo(line.dtype).tiny)


@dataclass(frozen=True, repr=False, eq=False)
class Projected(Primitive):
    """A measured point of space seen through given cameras M ``(cameras, 3, 4)``: the vector M (x, 1).

    The cameras are a batch dimension: one estimation problem per camera, from the same matches.
    """

    cameras: Tensor
    dim: int = 3
    width: int = 3

    def shapes(self) -> tuple[tuple[int, ...], ...]:
        return ((self.dim,),)

    def raw(self, x: Tensor) -> Tensor:
        return homogeneous(x) @ self.cameras.to(x).mT

    def normalized(self, transform: Tensor) -> Primitive:
        return Projected(self._split(transform)[1])

    def action(self, transform: Tensor) -> Tensor:
        return inverse(self._split(transform)[0])

    def pullback(self, x: Tensor, gradient: Tensor) -> Tensor:
        return (gradient @ self.cameras.to(x))[..., :3]

    def pushforward(self, x: Tensor, change: Tensor) -> Tensor:
        return change @ self.cameras.to(x)[..., :3].mT

    def _split(self, transform: Tensor) -> tuple[Tensor, Tensor]:
        """M T^-1 = L Q with orthonormal rows Q, the well-conditioned camera of the normalized points."""
        q, r = torch.linalg.qr((self.cameras.to(transform) @ inverse(transform)).mT)
        return r.mT, q.mT
