"""The contract of one multilinear invariant: what is measured, how large the null space is, and the motion behind the tensor.

An invariant states only its mathematics.  A match puts the rows

.. math:: u_1 \\otimes u_2 \\otimes \\dots \\otimes u_n

into the estimation matrix, one for every choice of a vector :math:`u_v` of its measurement in view v; the tensor spans the
null space of that matrix.  Minimal counts, rows, normalization, robust estimation and refinement follow from the declaration.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import partial, update_wrapper
from typing import Any, Concatenate, Generic, ParamSpec, TypeVar, cast

from torch import Tensor

from dyntorch.core.primitives import Primitive
from dyntorch.numerics.least_squares import flatten_parts, jacobian, parts_of

P = ParamSpec("P")
R = TypeVar("R")

ARGUMENTS = ("weights", "static", "dimensions", "normalize", "threshold", "generator", "starts", "polish", "iterations")
"""What ``fit``, ``robust_fit``, ``refine`` and ``sampson`` take by name for every invariant."""


class on_class(Generic[P, R]):
    """A method that may also be called on the class, which then stands for its instance with default parameters."""

    def __init__(self, function: Callable[Concatenate[Any, P], R]) -> None:
        self.function = function
        update_wrapper(cast("Callable[..., R]", self), function)

    def __get__(self, instance: Any, owner: type) -> Callable[P, R]:
        return partial(self.function, owner() if instance is None else instance)


@dataclass(frozen=True)
class Frame:
    """Between which coordinates one part of the motion maps: a matrix from ``source`` to ``target``, or a vector in ``target``.

    Views count from 0; None is the world, whose coordinates normalization leaves alone.
    """

    target: int | None
    source: int | None = None
    vector: bool = False
    dual: bool = False
    """Whether the images are hyperplanes of the target, which change by the inverse transposed."""


class Constraint(IntEnum):
    """What :meth:`Invariant.constrain` does, as the kernel numbers it."""

    NONE = 0
    RANK_TWO = 1
    """To the nearest matrix of rank two."""
    NONSINGULAR = 2
    """0 in place of singular matrices."""
    HOMOGRAPHIES = 3
    """None; the kernel knows the motion, two collineations."""


@dataclass(frozen=True)
class Estimate:
    """Tensors of flat problems that an invariant finds in a way of its own, and how sure they are."""

    tensor: Tensor
    """``(b, *axes)``, ``(b, nullity, *axes)`` where the nullity is above 1."""
    few: Tensor
    """``(b,)`` bool: fewer matches than determine it."""
    degenerate: Tensor
    """``(b,)`` bool: others fulfil all matches exactly."""
    ambiguous: Tensor
    """``(b,)`` bool: others fit as well within the noise."""
    uncertainty: Tensor
    """``(b,)`` expected relative error."""


class Invariant:
    """Base of all invariants.  A subclass sets the attributes and writes ``compose`` and ``decompose``.

    A family with parameters is a frozen dataclass; where all parameters have defaults the class itself can be used like an
    instance: ``dyn.HomographyTensor.minimal()``.
    """

    primitives: tuple[Primitive, ...]
    """What is measured in each view."""
    nullity: int = 1
    """Dimension of the null space that general matches leave."""
    motion: tuple[Frame, ...] = ()
    """The parts of the motion, in the order in which ``compose`` takes them."""
    dof: int = 0
    """Degrees of freedom of the motion (what refinement divides by, and the rank of its information matrix)."""
    codim: int = 1
    """Conditions that the true positions of one moving match fulfil."""
    layout: tuple[int, ...] | None = None
    """Which view each axis of the tensor belongs to; None: in the order of the views."""
    constraint: Constraint | None = Constraint.NONE
    """The internal constraint; None: one that only :meth:`constrain` knows."""
    resolves_noise: bool = True
    """Whether, among tensors that nearly all matches fulfil, the one with the least residual under noise is the true one."""
    labels_static: bool = False
    """Whether a match known to be static says more than one that may move (the argument ``static``)."""
    within: int = 2
    """Dimension of the linear subspace that a moving match stays in, 2 for a line.  One that is known to stay in fewer (the
    argument ``dimensions``; a static one in 1) fulfils the form with so many slots less, whatever stands in them."""
    intrinsic: bool = False
    """Whether the tensor is free of the coordinates of the views, each match being brought into a frame of its own: matches are
    then not normalized, and the tensor is the same in all coordinates."""

    motion_alone: bool = False
    """Whether the collineations themselves, ``(*batch, parts, rows, columns)``, stand for the tensor: for matches of so many views
    that the forms they fulfil would be too many to hold.  There is nothing to fit linearly; a motion found otherwise is refined."""

    compose: Callable[..., Tensor]
    """The tensor of a motion, ``(*batch, *axes)`` (with ``(*batch, nullity, *axes)`` where nullity > 1)."""
    decompose: Callable[..., Any]
    """The motion of a tensor: one part alone, or the tuple of the parts."""
    starts: Callable[[Tensor], tuple[Tensor, ...]] | None = None
    """Motions ``(tries, *batch, ...)`` from which to look for that of a noisy tensor, where what it decomposes into may be far off:
    refinement then minimizes the algebraic error first, and no motion guides robust estimation.  None: decomposing is enough."""

    def bind_arguments(
        self, views: Sequence[Tensor], weights: Tensor | None = None, **given: Tensor
    ) -> tuple[Invariant, tuple[Tensor, ...]]:
        """The invariant that the arguments of a call belong to, and what they measure in the slot of every primitive.

        By default both as they are.  A family that infers parameters from its arguments, or takes them otherwise than by view,
        says so here; all that follows sees the result.

        Args:
            views: positional arguments of ``fit``, ``refine``, ``sampson``.
            weights: of ``fit``, as they were given: what matches of weight 0 say has no part in what is inferred.
            **given: further ones by name.
        """
        for name in given:
            raise unknown_argument(self, name)
        return self, tuple(views)

    def fill_missing(self, views: tuple[Tensor, ...], weights: Tensor) -> tuple[tuple[Tensor, ...], Tensor]:
        """Measurements ``(b, n, ...)`` and weights ``(b, n)`` of a fit with what they lack filled in; by default as they are."""
        return views, weights

    def estimate_tensor(self, views: tuple[Tensor, ...], weights: Tensor) -> Estimate | None:
        """Tensors of ``views (b, n, ...)``, ``weights (b, n)`` in a way of its own; by default None: the null space of the rows."""
        return None

    def constrain(self, tensor: Tensor) -> Tensor:
        """The nearest tensor that fulfils the internal constraints, in normalized coordinates, 0 for that of no motion; by default
        the tensor itself."""
        return tensor

    def whitened_residual(self, motion: tuple[Tensor, ...], views: tuple[Tensor, ...], scales: tuple[Tensor, ...]) -> Tensor | None:
        r"""Whitened geometric residual :math:`Q^{-1/2} e` of each match, :math:`Q = \sum_v s_v^2 J_v J_v^T`.

        Args:
            motion: parts as in :attr:`motion`.
            views: matches.
            scales: ``(*batch,)`` standard deviation of the noise of each view, in the unit of these coordinates.

        Returns:
            ``(*batch, n, c)`` with expected square sum ``codim``; None for the Sampson residual of the multilinear form itself.
        """
        return None

    def linearize(
        self, motion: tuple[Tensor, ...], views: tuple[Tensor, ...], scales: tuple[Tensor, ...]
    ) -> tuple[Tensor, Tensor] | None:
        """:meth:`whitened_residual`, flat ``(b, n c)``, and its derivative by the entries of the motion ``(b, p, n c)``, where
        there is a shorter way than automatic differentiation match by match; by default None, there is not."""
        return None

    def compose_derivative(self, motion: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
        """The tensor, flat ``(b, D)``, and its derivative ``(b, p, D)`` by all entries of the motion ``(b, ...)``."""
        shapes = [part.shape[1:] for part in motion]
        return jacobian(lambda t: self.compose(*parts_of(t, shapes)).flatten(t.ndim - 1), flatten_parts(motion))

    def whitened_static_residual(self, motion: tuple[Tensor, ...], views: tuple[Tensor, ...], scales: tuple[Tensor, ...]) -> Tensor:
        """The same for matches that do not move: all their views agree under the motion.  ``(*batch, n, c)``."""
        raise ValueError(f"{self!r} has no separate residual for static matches; leave out static=")

    def confine(self, free: int) -> Invariant | None:
        """The invariant of matches that stay in a subspace of ``free`` dimensions less; None where that is a static point, whose
        residual is :meth:`whitened_static_residual`."""
        return None

    def normalize(self, transforms: tuple[Tensor, ...]) -> Invariant:
        """The invariant that the tensor of normalized matches belongs to: the same one, unless it depends on coordinates."""
        return self

    def motion_of(self, tensor: Tensor) -> tuple[Tensor, ...]:
        """The parts of the motion that :meth:`decompose` finds."""
        motion = self.decompose(tensor)
        return motion if isinstance(motion, tuple) else (motion,)

    @property
    def copies(self) -> int | None:
        """Tensors per problem, where a view measures through several given cameras; None: one, without an axis of its own."""
        return next((primitive.copies for primitive in self.primitives if primitive.copies is not None), None)

    @on_class
    def shape(self) -> tuple[int, ...]:
        """Shape of one tensor."""
        widths = tuple(p.width for p in self.primitives)
        return tuple(widths[v] for v in self.axes())

    @on_class
    def axes(self) -> tuple[int, ...]:
        """Which view each axis of the tensor belongs to."""
        return self.layout if self.layout is not None else tuple(range(len(self.primitives)))

    def tensor_of(self, basis: Tensor) -> Tensor:
        """The tensor of a null space ``(*batch, nullity, width)``, whose columns are in the order of the views."""
        tensor = basis.unflatten(-1, tuple(p.width for p in self.primitives))
        lead = basis.ndim - 1
        tensor = tensor.permute(*range(lead), *(lead + v for v in self.axes()))
        return tensor.squeeze(lead - 1) if self.nullity == 1 else tensor

    def basis_of(self, tensor: Tensor) -> Tensor:
        """The inverse of :meth:`tensor_of`: ``(*batch, nullity, width)``."""
        axes = self.axes()
        lead = tensor.ndim - len(axes)
        basis = tensor.permute(*range(lead), *(lead + axes.index(v) for v in range(len(axes)))).flatten(lead)
        return basis.unsqueeze(-2) if self.nullity == 1 else basis

    @on_class
    def width(self) -> int:
        """Columns of the estimation matrix."""
        return math.prod(p.width for p in self.primitives)

    @on_class
    def rows(self) -> int:
        """Independent rows that one match gives."""
        return math.prod(p.rows for p in self.primitives)

    @on_class
    def minimal(self) -> int:
        """Fewest matches that determine the tensor linearly: (width - nullity) / rows, rounded up."""
        return -(-(self.width() - self.nullity) // self.rows())

    def single(self) -> bool:
        """Whether a match fulfils one condition, the multilinear form of its slots."""
        return self.codim == 1 and self.rows() == 1 and not self.intrinsic

    def __repr__(self) -> str:
        return type(self).__name__


def as_invariant(invariant: Invariant | type[Invariant]) -> Invariant:
    """The invariant itself, or the default instance of a class.

    Raises:
        ValueError: anything else, or a family whose parameters were not given.
    """
    if isinstance(invariant, Invariant):
        return invariant
    if isinstance(invariant, type) and issubclass(invariant, Invariant):
        try:
            return invariant()
        except TypeError as error:
            raise ValueError(
                f"{invariant.__name__} is a family: give its parameters, {invariant.__name__}(...) ({error})"
            ) from None
    raise ValueError(f"expected an invariant such as dyntorch.HomographyTensor, got {invariant!r}")


def unknown_argument(invariant: Invariant, name: str, *also: str) -> TypeError:
    """The complaint about an argument that nothing takes, with the one that was probably meant.

    Args:
        also: arguments that this invariant takes beside those of every one.

    Example:
        >>> from dyntorch.invariants.collineation import Collineation
        >>> print(unknown_argument(Collineation(2), "weigths"))
        Collineation(n=2) takes no argument 'weigths'; did you mean 'weights'?
    """
    near = difflib.get_close_matches(name, {*ARGUMENTS, *also} - {name}, 1)
    return TypeError(f"{invariant!r} takes no argument {name!r}; " + (f"did you mean {near[0]!r}?" if near else "leave it out"))
