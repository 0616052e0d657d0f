"""What is measured in one view: points, hyperplanes, lines.  The vectors each of them puts into the estimation matrix.

A multilinear invariant is a form :math:`T(u, v, w)` on vectors that the measured things give, one slot per view.  A slot is
described by its :class:`Primitive`: how a measurement becomes vectors, how these change under a collineation of the view, and
what replaces them where the invariant holds for *every* vector in the slot (a match known to be static).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations
from math import comb

import torch
from torch import Tensor

from dyntorch.geometry.extensors import compound, join, plucker, plucker_form
from dyntorch.geometry.homogeneous import collecting, factors, homogeneous, monomial_derivatives, monomials, multiplicity
from dyntorch.numerics.blocks import constant


@constant
def triangle(width: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Rows and columns of the upper triangle of a square matrix, in the order in which symmetric matrices are packed."""
    rows, columns = torch.triu_indices(width, width, device=device)
    return rows, columns


def inverse(matrix: Tensor) -> Tensor:
    """Without the check of ``torch.linalg.inv``, for which an accelerator would wait."""
    return torch.linalg.inv_ex(matrix)[0]


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

    def raw(self, x: Tensor) -> Tensor:
        """The vector of a measurement, ``(*batch, n, width)``: a polynomial of the measured coordinates (``rows == 1`` only)."""
        return self.components(x).mT

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

    def pullback(self, x: Tensor, gradient: Tensor) -> Tensor:
        r"""Chain rule :math:`J^T g` from the (unscaled) vector back to the measured coordinates.

        Args:
            x: measurements.
            gradient: ``(*batch, n, width)`` derivative of a scalar with respect to :meth:`raw`.

        Returns:
            ``(*batch, n, coordinates)`` derivative with respect to the measured coordinates.
        """
        raise NotImplementedError(f"{self!r} gives its rows as a whole: it has no single vector")

    def pushforward(self, x: Tensor, change: Tensor) -> Tensor:
        r"""The other way: the change :math:`J c` of the raw vector, ``(*batch, n, width)``, for a change of the coordinates."""
        raise NotImplementedError(f"{self!r} gives its rows as a whole: it has no single vector")

    def pack(self, x: Tensor) -> Tensor:
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

    def add_noise(self, x: Tensor, noise: Tensor) -> Tensor:
        """The measurement with noise of the same shape, in units of normalized coordinates."""
        return x + noise

    @property
    def copies(self) -> int | None:
        """Vectors of one measurement that belong to problems of their own; None: it has one."""
        return None

    def normalize(self, transform: Tensor) -> Primitive:
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
        expected = " or ".join(f"(*batch, n, {', '.join(map(str, shape))})" for shape in self.shapes())
        raise ValueError(f"expected {expected}, got {tuple(x.shape)}")

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.dim})"


# ----------------------------------------------------------------------------------------------------------------------
# A match whose rows are not products of slots: one slot that holds all of it, and the function that gives its rows.


@dataclass(frozen=True, repr=False)
class Equations(Primitive):
    """All that one match measures, and the rows that it puts into the estimation matrix.

    For invariants from which something that belongs to each match (its camera) is eliminated: see
    :attr:`dyntorch.Invariant.intrinsic`.

    Args:
        measured: shape of one measurement, ``(points, 2 + ...)``: image coordinates, and what is known of each point without noise.
        width: columns of the estimation matrix.
        make: measurements ``(*batch, n, *measured)`` to rows ``(*batch, n, r, width)``, r of any size, differentiable; 0 where
            a measurement says nothing.
        rows: independent rows of one match.
    """

    measured: tuple[int, ...]
    width: int
    make: Callable[[Tensor], Tensor]
    rows: int = 1
    dim = 0

    def shapes(self) -> tuple[tuple[int, ...], ...]:
        return (self.measured,)

    def vectors(self, x: Tensor) -> Tensor:
        return self.make(x)

    def add_noise(self, x: Tensor, noise: Tensor) -> Tensor:
        # matches are not normalized: the size of each is its own unit
        xy = x[..., :2]
        size = (xy - xy.mean(-2, keepdim=True)).square().mean((-2, -1), keepdim=True).sqrt()
        return torch.cat([xy + noise[..., :2] * size, x[..., 2:]], dim=-1)

    def action(self, transform: Tensor) -> Tensor:
        return transform

    def move(self, x: Tensor, transform: Tensor) -> Tensor:
        return x


# ----------------------------------------------------------------------------------------------------------------------
# Monomials of the coordinates of a point: what polynomial constraints on points are linear in.


@dataclass(frozen=True, repr=False)
class Monomials(Primitive):
    r"""The monomials :math:`\nu(p)` of one degree of a point p = (x, 1) of P^d, in lexicographic order: 00, 01, 02, 11, 12, 22.

    A form :math:`\nu(p)^T c` is a curve (of degree 2 a conic) through the point.  A collineation T acts on them linearly,
    :math:`\nu(T p) = T_\nu\, \nu(p)`.

    Example:
        >>> import torch
        >>> Monomials().raw(torch.tensor([[2.0, 3.0]])).tolist()
        [[4.0, 6.0, 2.0, 9.0, 3.0, 1.0]]
    """

    degree: int = 2
    dim: int = 2
    isometric: bool = False
    r"""Whether each is scaled by the root of how often it occurs in :math:`p \otimes \dots \otimes p`, so that rotations of p
    rotate them."""

    @property
    def width(self) -> int:  # type: ignore[override]
        return comb(self.dim + self.degree, self.degree)

    def shapes(self) -> tuple[tuple[int, ...], ...]:
        return ((self.dim,),)

    def components(self, x: Tensor) -> Tensor:
        product = monomials(torch.cat([x.mT, torch.ones_like(x.mT[..., :1, :])], dim=-2), self.degree)
        return product * self.scale(x.device).to(x.dtype)[:, None] if self.isometric else product

    def normalize(self, transform: Tensor) -> Primitive:
        """The isometric ones: what is least squares must not depend on how the axes lie."""
        return Monomials(self.degree, self.dim, isometric=True)

    def scale(self, device: torch.device) -> Tensor:
        """The factors ``(width,)`` of the isometric ones."""
        return multiplicity(self.degree, self.dim, device).sqrt()

    def action(self, transform: Tensor) -> Tensor:
        # row by row: the product of linear forms, whose coefficients add up by monomial
        product = torch.ones_like(transform[..., :1, :1])
        for factor in factors(self.degree, self.dim, transform.device).unbind(-1):
            product = (product[..., :, None] * transform[..., factor, None, :]).flatten(-2)
        lifted = product @ collecting(self.degree, self.dim, transform.device).to(transform.dtype).mT
        if not self.isometric:
            return lifted
        scale = self.scale(transform.device).to(transform.dtype)
        return scale[:, None] * lifted / scale

    def pullback(self, x: Tensor, gradient: Tensor) -> Tensor:
        return (gradient[..., None, :] @ self._derivative(x))[..., 0, :]

    def pushforward(self, x: Tensor, change: Tensor) -> Tensor:
        return (self._derivative(x) @ change[..., None])[..., 0]

    def _derivative(self, x: Tensor) -> Tensor:
        """``(*batch, n, width, dim)``."""
        total = monomial_derivatives(homogeneous(x), self.degree, self.dim)
        return total * self.scale(x.device).to(x.dtype)[:, None] if self.isometric else total


# ----------------------------------------------------------------------------------------------------------------------
# Points and hyperplanes of a space of any dimension.


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

    def pack(self, x: Tensor) -> Tensor:
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

    def components(self, x: Tensor) -> Tensor:
        coordinates, sign = self._linear_minors(x)[1:]
        return torch.cat([torch.ones_like(x[..., :1]), (x[..., coordinates] * sign).flip(-1)], dim=-1).mT

    def vectors(self, x: Tensor) -> Tensor:
        eye = torch.eye(self.dim, dtype=x.dtype, device=x.device)
        hyperplanes = torch.cat([eye.expand(*x.shape, self.dim), -x[..., None]], dim=-1)
        return compound(hyperplanes, self.order)

    def pack(self, x: Tensor) -> Tensor:
        if self.order > 1:
            return super().pack(x)
        moved = x.mT
        one, zero = torch.ones_like(moved[..., :1, :]), torch.zeros_like(moved)
        rows = [torch.cat([one, zero[..., i + 1 :, :], -moved[..., i : i + 1, :]], dim=-2) for i in range(self.dim)]
        return torch.cat([*rows, moved.square().sum(-2, keepdim=True)], dim=-2)

    def action(self, transform: Tensor) -> Tensor:
        return compound(inverse(transform).mT, self.order)

    def pullback(self, x: Tensor, gradient: Tensor) -> Tensor:
        place, _, sign = self._linear_minors(gradient)
        return gradient[..., place] * sign

    def pushforward(self, x: Tensor, change: Tensor) -> Tensor:
        return torch.cat([torch.zeros_like(change[..., :1]), (change * self._linear_minors(change)[2]).flip(-1)], dim=-1)

    def slopes(self, gradient: Tensor) -> Tensor:
        """Derivatives ``(.., rows * order, n)`` of the forms of all rows by the coordinates on which each depends.

        Args:
            gradient: ``(.., width, n)`` of the form by the vector.
        """
        place, _, sign = self._linear_minors(gradient)
        return gradient.index_select(-2, place) * sign[:, None]

    def _linear_minors(self, like: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        place, coordinates, sign = _linear_minor_tables(self.dim, self.order, like.device)
        return place, coordinates, sign.to(like.dtype)


@constant
def _linear_minor_tables(dim: int, order: int, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
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


# ----------------------------------------------------------------------------------------------------------------------
# Lines of space, and points of space seen through given cameras.


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
        skew = torch.nn.functional.pad(gradient, (0, 1))[..., _above_the_diagonal(gradient.device)]
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


@constant
def _above_the_diagonal(device: torch.device) -> Tensor:
    """Which of six numbers each entry of a strictly upper triangular 4 x 4 matrix is, ``(4, 4)``; 6 is none of them."""
    index = torch.full((4, 4), 6)
    rows, columns = torch.triu_indices(4, 4, 1)
    index[rows, columns] = torch.arange(6)
    return index.to(device)


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

    @property
    def copies(self) -> int:
        return int(self.cameras.shape[-3])

    def raw(self, x: Tensor) -> Tensor:
        return homogeneous(x) @ self.cameras.to(x).mT

    def normalize(self, transform: Tensor) -> Primitive:
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
