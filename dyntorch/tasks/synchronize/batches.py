"""Many pairs of takes in one call: each by itself, one result with the batch in front."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from dyntorch.core.outcome import Notice, status_from
from dyntorch.core.problems import of_problem, one_by_one, without_filling
from dyntorch.numerics.arguments import check_together
from dyntorch.tasks.synchronize.result import Shift, ShiftNotice


def synchronize_batch(
    verb: Callable[..., Shift],
    a: Tensor,
    b: Tensor,
    *,
    times: tuple[Any, Any] | None,
    weights: tuple[Any, Any] | None,
    **more: Any,
) -> Shift:
    """The shifts of all problems, one after the other: a search shares nothing between takes. a ``(*batch, frames_a, n, 2)``,
    b ``(*batch, frames_b, m, 2)``, times ``(frames,)``, weights ``(*batch, frames, n)``."""
    batch = check_together(a=(a, 3), b=(b, 3))

    def solve(place: int) -> Shift:
        takes = [without_filling(of_problem(x, place, batch, 3)) for x in (a, b)]
        clocks = None if times is None else _own(times, takes, place, batch, 1)
        trust = None if weights is None else _own(weights, takes, place, batch, 2)
        return verb(*takes, times=clocks, weights=trust, **more)

    def spare(said: str) -> Shift:
        none = torch.zeros(0, dtype=torch.float64, device=a.device)
        limits = (Notice(ShiftNotice.UNUSABLE, 0.0, {"said": said}),)
        return Shift(
            0.0, math.inf, 1.0, 0.0, 0.0, none.reshape(0, 2), "none", (math.nan, math.nan), 0.0, none, none,
            status=status_from(limits), notices=limits,
        )  # fmt: skip

    return one_by_one(batch, solve, spare)


def _own(values: tuple[Any, Any], takes: list[Tensor], place: int, batch: Any, own: int) -> tuple[Any, Any]:
    """What belongs to a problem, of the frames that its takes have."""
    parts = [of_problem(value, place, batch, own) for value in values]
    return tuple(None if x is None else x[: len(take)] for x, take in zip(parts, takes, strict=True))  # type: ignore[return-value]
