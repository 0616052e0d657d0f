"""Linear fits by the kernel in C: matches of points -> similarities, moments, null spaces and what they are judged by, in one pass.

What the kernel does not certify, or whose Gram does not carry its digits, is left to :mod:`dyntorch.core.fit`, so statuses are the
same with and without the kernel.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from dyntorch.core.invariant import Constraint, Invariant
from dyntorch.core.matches import Matches
from dyntorch.core.primitives import HyperplanesThrough, Monomials, Point, Primitive
from dyntorch.native import library
from dyntorch.numerics.function_transforms import is_plain


def slot_kinds(invariant: Invariant, views: Sequence[Tensor], weights: Tensor, static: Tensor | None) -> list[int]:
    """What each view of the invariant puts into its slot, as the kernel numbers it; none where the kernel does not fit it."""
    if static is not None or invariant.copies is not None or invariant.intrinsic:
        return []
    if type(invariant).estimate_tensor is not Invariant.estimate_tensor or not 2 <= len(views) <= library.MAX_SLOTS:
        return []
    if invariant.constraint is None or not library.solves(invariant.width(), invariant.nullity):
        return []
    data = (*views, weights)
    if not is_plain(*data) or any(part.dtype != torch.float64 for part in data):
        return []
    kinds = [_kind(primitive) for primitive in invariant.primitives]
    if None in kinds and all(primitive.rows == 1 and primitive.width <= library.MAX_SPACE for primitive in invariant.primitives):
        return [library.VECTORS] * len(kinds)
    return [] if None in kinds else [kind for kind in kinds if kind is not None]


def searched_kinds(invariant: Invariant, views: Sequence[Tensor], weights: Tensor) -> list[int]:
    """The same of a robust search, which takes forms of two or three points, and points predicted from those of another view."""
    kinds = slot_kinds(invariant, views, weights, None)
    if invariant.nullity > 1 or len(views) > library.MAX_SEARCHED_SLOTS or {library.CONIC_MONOMIALS, library.VECTORS} & {*kinds}:
        return []
    if max((primitive.dim for primitive in invariant.primitives), default=0) > library.MAX_SEARCHED_SPACE:
        return []
    through = kinds.count(library.HYPERPLANES_THROUGH)
    return kinds if through == 0 or (through == 1 and len(kinds) == 2) else []


def refined_kinds(invariant: Invariant, data: Matches) -> list[int]:
    """The same of refinement, which knows the motions of fundamental matrices, collineations and homography tensors."""
    known = invariant.constraint not in (None, Constraint.NONE) and data.static is None
    return searched_kinds(invariant, data.views, data.weights) if known else []


def _kind(primitive: Primitive) -> int | None:
    if isinstance(primitive, Point) and primitive.dim <= library.MAX_SPACE:
        return library.POINT
    if isinstance(primitive, HyperplanesThrough) and primitive.order == 1 and primitive.dim <= library.MAX_SPACE:
        return library.HYPERPLANES_THROUGH
    if isinstance(primitive, Monomials) and (primitive.degree, primitive.dim) == (2, 2):
        return library.CONIC_MONOMIALS
    return None
