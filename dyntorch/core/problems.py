"""A batch of problems that a search solves one after the other: results stacked, and one bad problem that spoils no other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields, is_dataclass, replace
from math import prod
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from dyntorch.core.outcome import Notice, in_order

Result = TypeVar("Result")


def solve_one_by_one(batch: Sequence[int], solve: Callable[[int], Result], spare: Callable[[str], Result]) -> Result:
    """The results of all problems, as :func:`stack_results` makes one of them."""
    if not prod(batch):
        raise ValueError(f"the batch {tuple(batch)} holds no problem; give one at least")
    found: list[Result | str] = []
    errors = []
    for place in range(prod(batch)):
        try:
            found.append(solve(place))
        except ValueError as problem:
            errors.append(problem)
            found.append(str(problem))
    if len(errors) == len(found):
        raise errors[0]
    return stack_results([spare(one) if isinstance(one, str) else one for one in found], batch)


def stack_results(found: Sequence[Result], batch: Sequence[int]) -> Result:
    """One result of several: tensors with the batch in front, numbers as tensors ``(*batch,)``, the notices of all problems."""
    first = next((one for one in found if one is not None), None)
    if first is None:
        return found[0]
    if isinstance(first, Tensor):
        return _pad_and_stack([one if isinstance(one, Tensor) else first.new_full((0,) * first.ndim, 0) for one in found], batch)  # type: ignore[return-value]
    if isinstance(first, bool | int | float):
        kind = torch.bool if isinstance(first, bool) else torch.float64 if isinstance(first, float) else torch.int64
        return torch.tensor(found, dtype=kind).reshape(*batch)  # type: ignore[return-value]
    if is_dataclass(first) and not isinstance(first, type):
        parts: dict[str, Any] = {}
        for one in fields(first):
            values = [getattr(result, one.name) for result in found]
            parts[one.name] = _place_notices(values, batch) if one.name == "notices" else stack_results(values, batch)
        return replace(first, **parts)
    tuples = isinstance(first, tuple) and all(isinstance(one, tuple) and len(one) == len(first) for one in found)
    # tensors say no single word on whether they are equal
    plain = not isinstance(first, tuple) or not any(isinstance(part, Tensor) for one in found for part in one)  # type: ignore[attr-defined]
    if plain and all(one == first for one in found):
        return first
    if tuples:
        return tuple(stack_results(part, batch) for part in zip(*found, strict=True))  # type: ignore[return-value]
    return tuple(found)  # type: ignore[return-value]


def _pad_and_stack(tensors: Sequence[Tensor], batch: Sequence[int]) -> Tensor:
    shape = [max(sizes) for sizes in zip(*(x.shape for x in tensors), strict=True)]
    like = tensors[0]
    blank = float("nan") if like.is_floating_point() else 0 if like.dtype == torch.bool else -1
    whole = like.new_full((len(tensors), *shape), blank)
    for place, x in enumerate(tensors):
        whole[place][tuple([slice(size) for size in x.shape])] = x
    return whole.reshape(*batch, *shape)


def _place_notices(found: Sequence[Sequence[Notice]], batch: Sequence[int]) -> tuple[Notice, ...]:
    """Notices with the places of their problems."""
    places = [tuple(int(i) for i in np.unravel_index(place, tuple(batch))) for place in range(len(found))]
    return in_order(replace(notice, problem=place) for place, some in zip(places, found, strict=True) for notice in some)


def trim_padding(x: Tensor) -> Tensor:
    """Tracks ``(frames, n, 2)`` without the last frames that show no point: those fill a batch of takes of different lengths."""
    shown = x.isfinite().all(-1).any(-1).nonzero()
    return x[: int(shown[-1, 0]) + 1] if len(shown) else x[:0]


def select_problem(value: Any, place: int, batch: Sequence[int], own: int) -> Any:
    """The part of a value that belongs to a problem: a tensor with more than ``own`` dimensions has those of the batch in front."""
    if not isinstance(value, Tensor) or value.ndim <= own:
        return value
    return value.expand(*batch, *value.shape[value.ndim - own :]).reshape(prod(batch), *value.shape[value.ndim - own :])[place]
