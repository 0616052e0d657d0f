"""What comes in: matches of several views, checked once, in float64, with missing ones weighing nothing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.core.invariant import Invariant
from dyntorch.core.primitives import Point, Primitive
from dyntorch.numerics.arguments import FARTHEST, check_tensor, check_weights, refuse_vmap
from dyntorch.numerics.blocks import select
from dyntorch.numerics.function_transforms import is_transformed, over_problems

WIDEST = 4096
"""Unknowns of a tensor; the Gram of one problem then takes 134 MB."""


@dataclass(frozen=True)
class Matches:
    """Checked matches with one flat batch dimension, ready to be cut into blocks."""

    views: tuple[Tensor, ...]
    """``(b, n, ...)`` float64 and finite, one per view."""
    weights: Tensor
    """``(b, n)``, 0 where the match is missing in any view."""
    static: Tensor | None
    """``(b, n)`` bool, or integers: slots of the form that hold anything, 1 for what True says (see ``Invariant.within``)."""
    batch: tuple[int, ...]
    """The leading dimensions that came in."""
    dtype: torch.dtype
    device: torch.device

    @property
    def count(self) -> int:
        """Matches per problem."""
        return int(self.weights.shape[-1])

    def back(self, result: Tensor) -> Tensor:
        """A float64 result with a flat batch, in the caller's shape, dtype and device."""
        result = result.reshape((*self.batch, *result.shape[1:]))
        return result.to(device=self.device, dtype=self.dtype if result.is_floating_point() else result.dtype)

    def restrict(self, keep: Tensor) -> Matches:
        """The same matches with weight 0 where ``keep (b, n)`` is False."""
        return Matches(self.views, self.weights * keep, self.static, self.batch, self.dtype, self.device)


def matches(
    invariant: Invariant,
    views: Sequence[Tensor],
    weights: Tensor | None = None,
    static: Tensor | None = None,
    dimensions: Tensor | None = None,
    *,
    mapped: bool = False,
) -> Matches:
    """Check the views of one invariant and put them into float64. weights ``(*batch, n)``, static ``(*batch, n)``, dimensions
    ``(*batch, n)``."""
    check_views(invariant, views)
    for v, x in enumerate(() if mapped else views, start=1):
        refuse_vmap(f"view {v}", x)
    if dimensions is not None:
        refuse_vmap("dimensions", dimensions, "give them as they are, from outside of the function that is mapped")
    if invariant.width() > WIDEST:
        raise ValueError(f"{invariant!r} has {invariant.width():,} unknowns; up to {WIDEST:,} are estimated")
    first = views[0]
    axis = invariant.primitives[0].match_axis(first)
    batch, n = tuple(first.shape[:axis]), int(first.shape[axis])
    if static is not None and not invariant.labels_static:
        raise ValueError(f"{invariant!r} has no rows for labelled static matches; leave out static=")
    # a device without float64 lends its data to the CPU and gets the result back
    home = torch.device("cpu") if first.device.type == "mps" else first.device
    # not reshape(-1): without matches any batch would do
    flat = [x.to(home, torch.float64).reshape(math.prod(batch), *x.shape[axis:]) for x in views]
    weight = _weights(option("weights", weights, batch, n, first), flat[0])
    label = option("static", static, batch, n, first)
    if dimensions is not None:
        label = _free_slots(invariant, option("dimensions", dimensions, batch, n, first), static is not None)
    elif label is not None:
        label = label.bool() if invariant.within == 2 else label.bool() * (invariant.within - 1)
    looked_at = home.type == "cpu" and not is_transformed(tuple(flat), weight)
    # two numbers per view say that nothing is missing, and then nothing is copied
    if not looked_at or not math.isfinite(weight.detach().sum().item()) or not all(map(_is_near, flat)):
        present = weight.isfinite()
        for x in flat:
            present = present & (x.abs() <= FARTHEST).flatten(2).all(-1)
        flat, weight = [select(present, x, 0.0) for x in flat], torch.where(present, weight, 0.0)
    return Matches(tuple(flat), weight, None if label is None else label.to(home), batch, first.dtype, first.device)


def _is_near(x: Tensor) -> bool:
    """Whether all coordinates are there and finite; a twelfth of the time of their largest norm."""
    low, high = torch.aminmax(x.detach()) if x.numel() else (torch.zeros(()),) * 2
    return low.item() >= -FARTHEST and high.item() <= FARTHEST


def check_plain(invariant: Invariant) -> None:
    """Raise a ``ValueError`` for an invariant whose own numbers are inside of a transformation of ``torch.func``."""
    tensors = [part for part in vars(invariant).values() if isinstance(part, Tensor)]
    tensors += [part for primitive in invariant.primitives for part in vars(primitive).values() if isinstance(part, Tensor)]
    if is_transformed(*tensors):
        raise ValueError(
            f"{invariant!r} holds numbers that torch.func transforms (cameras, an interval of times): make it from what is not "
            "transformed, or give all problems at once, in leading dimensions"
        )


def _weights(given: Tensor | None, like: Tensor) -> Tensor:
    """``(b, n)`` float64."""
    if given is None:
        return torch.ones(like.shape[:2], dtype=like.dtype, device=like.device)
    return over_problems(_refuse_negative, given).to(like)


def _refuse_negative(weights: Tensor) -> Tensor:
    check_weights(weights, "a match")
    return weights


def relative_weights(weights: Tensor) -> Tensor:
    """Weights ``(*batch, n)`` over the largest of each problem."""
    return weights / largest_weights(weights)[..., None].clamp(min=torch.finfo(weights.dtype).tiny)


def largest_weights(weights: Tensor) -> Tensor:
    """``(*batch,)``, 0 without matches."""
    return weights.amax(-1) if weights.shape[-1] else weights.sum(-1)


def _free_slots(invariant: Invariant, dimensions: Tensor | None, static: bool) -> Tensor:
    """Slots ``(b, n)`` that hold anything, for matches within subspaces of known dimensions."""
    assert dimensions is not None
    if not invariant.labels_static:
        raise ValueError(f"{invariant!r} has no rows for matches within fewer dimensions; leave out dimensions=")
    if static:
        raise ValueError("dimensions= says which matches are static, too (1); give it or static=, not both")
    if dimensions.is_floating_point() or dimensions.dtype == torch.bool:
        raise ValueError(f"dimensions must be integers, got {dimensions.dtype}; 1 stands still, 2 moves on a line, ...")
    if dimensions.numel() and not bool(((dimensions >= 1) & (dimensions <= invariant.within)).all()):
        low, high = int(dimensions.min()), int(dimensions.max())
        raise ValueError(f"dimensions must be 1 to {invariant.within} for {invariant!r}, got {low} to {high}; 1 stands still")
    freed = invariant.within - dimensions.long()
    return freed if invariant.within > 2 else freed == 1


def check_views(invariant: Invariant, views: Sequence[Tensor]) -> None:
    """Raise a ``ValueError`` for another number of views, shapes that do not agree, mixed dtypes or devices."""
    if len(views) != len(invariant.primitives):
        raise ValueError(f"{invariant!r} takes matches in {len(invariant.primitives)} views, got {len(views)}")
    _check_measured(invariant, invariant.primitives, views, "view")


def constellations(invariant: Invariant, points: Sequence[Tensor], dim: int = 2) -> Tensor:
    """Points p1, p2, ... ``(*batch, views, dim)``, each seen in the same views, as one measurement per view."""
    _check_measured(invariant, (Point(dim),) * len(points), points, "point")
    x = torch.stack(list(points), dim=-2)
    seen = x.isfinite().all(-1, keepdim=True)
    return torch.cat([torch.where(seen, x, 0.0), seen.to(x)], dim=-1)


def _check_measured(invariant: Invariant, primitives: Sequence[Primitive], views: Sequence[Tensor], what: str) -> None:
    leading: list[tuple[int, ...]] = []
    for v, (primitive, x) in enumerate(zip(primitives, views, strict=True), start=1):
        check_tensor(f"{what} {v}", x)
        try:
            axis = primitive.match_axis(x)
        except ValueError as error:
            raise ValueError(f"{what} {v} of {invariant!r}: {error}") from None
        leading.append(tuple(x.shape[: axis + 1]))
    if len(set(leading)) > 1:
        raise ValueError(f"all {what}s need the same (*batch, n), got {leading}; expand the smaller ones")
    if len({x.dtype for x in views}) > 1:
        raise ValueError(f"all {what}s need one dtype, got {[str(x.dtype) for x in views]}; use .to(dtype)")
    if len({x.device for x in views}) > 1:
        raise ValueError(f"all {what}s need one device, got {[str(x.device) for x in views]}; use .to(device)")


def option(name: str, value: Tensor | None, batch: tuple[int, ...], n: int, like: Tensor) -> Tensor | None:
    """``weights`` or ``static`` with the batch of the views, flat."""
    if value is None:
        return None
    if not isinstance(value, Tensor):
        raise ValueError(f"{name} must be a torch.Tensor, got {type(value).__name__}; use torch.as_tensor(...)")
    if value.device != like.device:
        raise ValueError(f"{name} is on {value.device}, the matches on {like.device}; use .to(device)")
    try:
        return value.expand(*batch, n).reshape(math.prod(batch), n) if batch else value.expand(1, n)
    except RuntimeError:
        raise ValueError(f"{name} must be (*batch, n) = {(*batch, n)}, got {tuple(value.shape)}") from None
