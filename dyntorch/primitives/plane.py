"""Points and hyperplanes of a space of any dimension."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from math import comb

import torch
from torch import Tensor

from dyntorch.algebra.extensors import compound
from dyntorch.algebra.homogeneous import homogeneous
from dyntorch.constants import constant
from dyntorch.primitives.base import Primitive, inverse


@dataclass(frozen=True, repr=False)
class Point(Primitive):
    """A point of P^d, measured as d inhomogeneous coordinates: one vector (x, 1)."""

    dim: int = 2

    @property
    def width(self) -> int:  # type: ignore[override]
        return self.dim + 1

    def shapes(self) -> tuple[tuple[int, ...], ...]:
        return ((self.dim,),)

    def raw(self, x: Tensor) -> Tensor:
        return homogeneous(x)

    def components(self, x: Tensor) -> Tensor:
        return torch.cat([x.mT, torch.ones_like(x.mT[..., :1, :])], dim=-2)

    def packed(self, x: Tensor) -> Tensor:
        moved = x.mT
        # the products with the last coordinate, 1, are there already
        rows = [part for i in range(self.dim) for part in (moved[..., i:, :] * moved[..., i : i + 1, :], moved[..., i : i + 1, :])]
        return torch.cat([*rows, torch.ones_like(moved[..., :1, :])], dim=-2)

    def action(self, transform: Tensor) -> Tensor:
        return transform

    def pullback(self, x: Tensor, gradient: Tensor) -> Tensor:
        return gradient[..., :-1]

    def pushforward(self, x: Tensor, change: Tensor) -> Tensor:
        return torch.cat([change, torch.zeros_like(change[..., :1])], dim=-1)


@dataclass(frozen=True, repr=False)
class HyperplanesThrough(Primitive):
    r"""A measured point of P^d, through the meets of ``order`` of the d hyperplanes :math:`[I \mid -x]` that contain it.

    The vectors are the rows of the compound matrix :math:`C_a([I \mid -x])`, linear in x.  Of order 1 they are the
    hyperplanes: their incidence with an image point w (y, 1) is w times the difference y - x, the geometric error up to its
    depth.  Of order d there is one, the point itself up to the order and signs of its coordinates: (1, -y, x) in the plane.
    """

    dim: int = 2
    order: int = 1

    @property
    def width(self) -> int:  # type: ignore[override]
        return comb(self.dim + 1, self.order)

    @property
    def rows(self) -> int:  # type: ignore[override]
        return comb(self.dim, self.order)

    def shapes(self) -> tuple[tuple[int, ...], ...]:
        return ((self.dim,),)

    def raw(self, x: Tensor) -> Tensor:
        self._check_single()
        return self.components(x).mT

    def components(self, x: Tensor) -> Tensor:
        self._check_single()
        coordinates, sign = self._moving(x)[1:]
        return torch.cat([torch.ones_like(x[..., :1]), (x[..., coordinates] * sign).flip(-1)], dim=-1).mT

    def vectors(self, x: Tensor) -> Tensor:
        eye = torch.eye(self.dim, dtype=x.dtype, device=x.device)
        hyperplanes = torch.cat([eye.expand(*x.shape, self.dim), -x[..., None]], dim=-1)
        return compound(hyperplanes, self.order)

    def packed(self, x: Tensor) -> Tensor:
        if self.order > 1:
            return super().packed(x)
        moved = x.mT
        one, zero = torch.ones_like(moved[..., :1, :]), torch.zeros_like(moved)
        rows = [torch.cat([one, zero[..., i + 1 :, :], -moved[..., i : i + 1, :]], dim=-2) for i in range(self.dim)]
        return torch.cat([*rows, moved.square().sum(-2, keepdim=True)], dim=-2)

    def action(self, transform: Tensor) -> Tensor:
        return compound(inverse(transform).mT, self.order)

    def pullback(self, x: Tensor, gradient: Tensor) -> Tensor:
        self._check_single()
        place, _, sign = self._moving(gradient)
        return gradient[..., place] * sign

    def pushforward(self, x: Tensor, change: Tensor) -> Tensor:
        self._check_single()
        return torch.cat([torch.zeros_like(change[..., :1]), (change * self._moving(change)[2]).flip(-1)], dim=-1)

    def slopes(self, gradient: Tensor) -> Tensor:
        """Derivatives ``(.., rows * order, n)`` of the forms of all rows by the coordinates on which each depends.

        Args:
            gradient: ``(.., width, n)`` of the form by the vector.
        """
        place, _, sign = self._moving(gradient)
        return gradient.index_select(-2, place) * sign[:, None]

    def _moving(self, like: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        place, coordinates, sign = _moving_minors(self.dim, self.order, like.device)
        return place, coordinates, sign.to(like.dtype)

    def _check_single(self) -> None:
        if self.rows > 1:
            raise NotImplementedError(f"a point of P^{self.dim} lies on {self.dim} hyperplanes: it has no single vector")


@constant
def _moving_minors(dim: int, order: int, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """The minors of [I | -x] that are a coordinate up to sign, row by row of the compound: their places, coordinates, signs."""
    columns = {s: i for i, s in enumerate(combinations(range(dim + 1), order))}
    found = [
        (columns[(*(i for i in row if i != j), dim)], j, (-1) ** (p + order))
        for row in combinations(range(dim), order)
        for p, j in enumerate(row)
    ]
    place, coordinates, sign = torch.tensor(found, device=device).unbind(-1)
    return place, coordinates, sign


@dataclass(frozen=True, repr=False)
class Hyperplane(Primitive):
    """A measured hyperplane of P^d (a line of an image, a plane in space), homogeneous, of any scale."""

    dim: int = 2

    @property
    def width(self) -> int:  # type: ignore[override]
        return self.dim + 1

    def shapes(self) -> tuple[tuple[int, ...], ...]:
        return ((self.dim + 1,),)

    def raw(self, x: Tensor) -> Tensor:
        """The hyperplane with a unit normal: its last coordinate is then a distance."""
        # a hyperplane at infinity has no normal: the floor keeps it finite
        floor = torch.finfo(x.dtype).eps * x.detach().abs().amax(-1, keepdim=True)
        return x / torch.maximum(x[..., :-1].norm(dim=-1, keepdim=True), torch.where(floor > 0, floor, 1.0))

    def action(self, transform: Tensor) -> Tensor:
        return inverse(transform).mT

    def pullback(self, x: Tensor, gradient: Tensor) -> Tensor:
        # noise turns the unit normal (tangentially) and shifts the offset
        normal = self.raw(x)[..., :-1]
        turn = gradient[..., :-1] - (gradient[..., :-1] * normal).sum(-1, keepdim=True) * normal
        return torch.cat([turn, gradient[..., -1:]], dim=-1)

    def pushforward(self, x: Tensor, change: Tensor) -> Tensor:
        return change

    def points(self, x: Tensor, weights: Tensor | None = None) -> Tensor:
        """The feet of the perpendiculars from the point that is nearest to all hyperplanes: a shift of the view shifts them."""
        normal, offset = self.raw(x).split([self.dim, 1], dim=-1)
        weighted = (normal if weights is None else normal * weights[..., None]).mT
        eye = torch.eye(self.dim, dtype=x.dtype, device=x.device)
        square = weighted @ normal
        # parallel hyperplanes have no nearest point: a ridge takes the one next to the origin
        ridge = 1e-9 * square.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None] + torch.finfo(x.dtype).tiny
        nearest = -torch.linalg.solve_ex(square + ridge * eye, weighted @ offset)[0]
        distance = normal @ nearest + offset
        return (nearest.mT - distance * normal).unsqueeze(-2)

    def move(self, x: Tensor, transform: Tensor) -> Tensor:
        return x @ inverse(transform)
