"""What is measured in one view: points, hyperplanes, lines.  The vectors each of them puts into the estimation matrix.

A multilinear invariant is a form :math:`T(u, v, w)` on vectors that the measured things give, one slot per view.  A slot is
described by its :class:`Primitive`: how a measurement becomes vectors, how these change under a collineation of the view, and
what replaces them where the invariant holds for *every* vector in the slot (a match known to be static).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from dyntorch.algebra.extensors import compound, join, plucker, plucker_form
from dyntorch.algebra.homogeneous import homogeneous


@lru_cache(maxsize=64)
def triangle(width: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Rows and columns of the upper triangle of a square matrix, in the order in which symmetric matrices are packed."""
    # an inference tensor left in the cache would break every later gradient
    with torch.inference_mode(False):
        rows, columns = torch.triu_indices(width, width, device=device)
    return rows, columns


def _inverse(matrix: Tensor) -> Tensor:
    """Without the check of ``torch.linalg.inv``, for which an accelerator would wait."""
    return torch.linalg.inv_ex(matrix)[0]


def direction(line: Tensor) -> Tensor:
    """Direction ``(..., 3)`` from the first to the second point of Pluecker lines ``(..., 6)``: P3 Q - Q3 P."""
    # one by one: a list of indices would have to be copied to an accelerator
    return -torch.stack([line[..., 2], line[..., 4], line[..., 5]], dim=-1)


class Primitive(ABC):
    """One slot of a multilinear invariant."""

    dim: int
    """Dimension d of the space that is measured."""
    width: int
    """Length of the vectors."""
    rows: int = 1
    """Independent vectors per measurement."""

    @abstractmethod
    def shapes(self) -> tuple[tuple[int, ...], ...]:
        """The trailing shapes of one measurement that are understood."""

    @abstractmethod
    def raw(self, x: Tensor) -> Tensor:
        """The vector of a measurement, ``(*batch, n, width)``: a polynomial of the measured coordinates (``rows == 1`` only)."""

    def components(self, x: Tensor) -> Tensor:
        """The vectors as the estimation matrix takes them, components first: ``(*batch, width, n)``.

        They are not scaled to unit length: that would let the matches in the middle outweigh those at the rim, which decide
        the tensor (measured: 1.3 to 2 times the error for points of the plane, 1.2 in space).
        """
        return self.raw(x).mT

    def vectors(self, x: Tensor) -> Tensor:
        """The same, one row each: ``(*batch, n, rows, width)``."""
        return self.components(x).mT[..., None, :]

    @abstractmethod
    def action(self, transform: Tensor) -> Tensor:
        r"""The matrix M with :math:`\mathrm{vector}(T x) \sim M\,\mathrm{vector}(x)`, ``(*batch, width, width)``."""

    @abstractmethod
    def pullback(self, x: Tensor, gradient: Tensor) -> Tensor:
        r"""Chain rule :math:`J^T g` from the (unscaled) vector back to the measured coordinates.

        Args:
            x: measurements.
            gradient: ``(*batch, n, width)`` derivative of a scalar with respect to :meth:`raw`.

        Returns:
            ``(*batch, n, coordinates)`` derivative with respect to the measured coordinates.
        """

    @abstractmethod
    def pushforward(self, x: Tensor, change: Tensor) -> Tensor:
        r"""The other way: the change :math:`J c` of the raw vector, ``(*batch, n, width)``, for a change of the coordinates."""

    def packed(self, x: Tensor) -> Tensor:
        r"""Upper triangle of :math:`\sum_r v_r v_r^T` of each measurement, component first: ``(*batch, w (w + 1) / 2, n)``."""
        rows, columns = triangle(self.width, x.device)
        if self.rows > 1:
            vectors = self.vectors(x)
            return (vectors.mT @ vectors)[..., rows, columns].mT
        components = self.components(x)
        return components.index_select(-2, rows) * components.index_select(-2, columns)

    def free(self, x: Tensor) -> Tensor:
        """The form of all vectors that a static match allows in this slot: every vector, unless the primitive says otherwise."""
        eye = torch.eye(self.width, dtype=x.dtype, device=x.device)
        return eye.expand(*x.shape[: self.match_axis(x) + 1], self.width, self.width)

    def points(self, x: Tensor, weights: Tensor | None = None) -> Tensor:
        """Points ``(*batch, n, k, d)`` that stand for the size and place of each measurement (for the normalization).

        Args:
            x: measurements.
            weights: ``(*batch, n)``; None for equal ones.
        """
        return x.unsqueeze(-2)

    def move(self, x: Tensor, transform: Tensor) -> Tensor:
        """The measurement after a similarity of its view (a scale and a shift), ``(*batch, d+1, d+1)``, in the same shape."""
        return torch.addcmul(transform[..., None, :-1, -1], x, transform[..., :1, :1])

    def normalized(self, transform: Tensor) -> Primitive:
        """The primitive that measures in normalized coordinates: the same one, unless it depends on the coordinates."""
        return self

    def freedom(self) -> int:
        """Degrees of freedom of one measurement, which is also how many conditions it fulfils where it is known."""
        return self.dim

    def match_axis(self, x: Tensor) -> int:
        """Axis of the matches in ``x``: the one before the shape of a measurement."""
        for shape in self.shapes():
            if tuple(x.shape[x.ndim - len(shape) :]) == shape and x.ndim > len(shape):
                return x.ndim - len(shape) - 1
        raise ValueError(f"expected (*batch, n, {' or '.join(str(s) for s in self.shapes())}), got {tuple(x.shape)}")

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.dim})"


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
class HyperplanesThrough(Point):
    """A measured point of P^d, through the d hyperplanes :math:`[I \\mid -x]` that contain it.

    Their incidence with an image point w (y, 1) is w times the difference y - x, the geometric error up to its depth.
    """

    @property
    def rows(self) -> int:  # type: ignore[override]
        return self.dim

    def raw(self, x: Tensor) -> Tensor:
        self._check_single()
        return torch.cat([torch.ones_like(x), -x], dim=-1)

    def components(self, x: Tensor) -> Tensor:
        return self.raw(x).mT

    def vectors(self, x: Tensor) -> Tensor:
        eye = torch.eye(self.dim, dtype=x.dtype, device=x.device)
        return torch.cat([eye.expand(*x.shape, self.dim), -x[..., None]], dim=-1)

    def packed(self, x: Tensor) -> Tensor:
        moved = x.mT
        one, zero = torch.ones_like(moved[..., :1, :]), torch.zeros_like(moved)
        rows = [torch.cat([one, zero[..., i + 1 :, :], -moved[..., i : i + 1, :]], dim=-2) for i in range(self.dim)]
        return torch.cat([*rows, moved.square().sum(-2, keepdim=True)], dim=-2)

    def action(self, transform: Tensor) -> Tensor:
        return _inverse(transform).mT

    def pullback(self, x: Tensor, gradient: Tensor) -> Tensor:
        self._check_single()
        return -gradient[..., 1:]

    def pushforward(self, x: Tensor, change: Tensor) -> Tensor:
        self._check_single()
        return torch.cat([torch.zeros_like(change), -change], dim=-1)

    def _check_single(self) -> None:
        if self.dim > 1:
            raise NotImplementedError(f"a point of P^{self.dim} lies on {self.dim} hyperplanes: it has no single vector")


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
        return _inverse(transform).mT

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
        return x @ _inverse(transform)


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
        return _inverse(self._split(transform)[0])

    def pullback(self, x: Tensor, gradient: Tensor) -> Tensor:
        return (gradient @ self.cameras.to(x))[..., :3]

    def pushforward(self, x: Tensor, change: Tensor) -> Tensor:
        return change @ self.cameras.to(x)[..., :3].mT

    def _split(self, transform: Tensor) -> tuple[Tensor, Tensor]:
        """M T^-1 = L Q with orthonormal rows Q, the well-conditioned camera of the normalized points."""
        q, r = torch.linalg.qr((self.cameras.to(transform) @ _inverse(transform)).mT)
        return r.mT, q.mT
