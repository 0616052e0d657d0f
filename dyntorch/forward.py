"""Derivatives of batched functions in forward mode, for threads as well."""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock

import torch
from torch import Tensor

LOCK = Lock()
"""Forward mode differentiates in one thread at a time: the level of its dual numbers belongs to the whole process."""


def derivatives(function: Callable[[Tensor], Tensor], theta: Tensor, tangents: Tensor) -> tuple[Tensor, Tensor]:
    """Value and directional derivatives by one vectorized pass over the tangents.

    Args:
        function: ``(b, p)`` to ``(b, rows)``; it must not call this module itself.
        theta: ``(b, p)``.
        tangents: ``(k, b, p)``.

    Returns:
        ``(b, rows)`` and ``(b, k, rows)``.

    Example:
        >>> import torch
        >>> derivatives(torch.square, torch.tensor([[3.0, 4.0]]), torch.tensor([[[1.0, 0.5]]]))[1].tolist()
        [[[6.0, 4.0]]]
    """

    def along(tangent: Tensor) -> tuple[Tensor, Tensor]:
        value, column = torch.func.jvp(function, (theta,), (tangent,))[:2]
        return value, column

    with LOCK:
        values, columns = torch.func.vmap(along)(tangents)
    return values[0], columns.transpose(0, 1)


def jacobian(function: Callable[[Tensor], Tensor], theta: Tensor) -> tuple[Tensor, Tensor]:
    """Value ``(b, rows)`` and transposed Jacobian ``(b, p, rows)`` of a function of ``theta (b, p)``."""
    count = theta.shape[-1]
    tangents = torch.eye(count, dtype=theta.dtype, device=theta.device)[:, None, :].expand(count, *theta.shape)
    return derivatives(function, theta, tangents)
