"""What tensors a function takes, checked in one place and said in one form."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

PRECISE = (torch.float32, torch.float64)
"""Types of numbers with the digits that measurements have; three digits (float16) or two (bfloat16) are fewer than pixels need."""

FARTHEST = 1e60
"""Largest coordinate that is taken for a measurement, larger ones are as infinite: their products leave the range of float64."""


def check_tensor(name: str, value: object, *shape: int | str, precise: bool = True) -> None:
    """Raise a ``ValueError`` unless ``value`` is a real floating point tensor ``(*batch, *shape)``.

    Args:
        name: of the argument.
        value: what was given.
        *shape: trailing dimensions: a number is the size that is needed, a name stands for any.
        precise: whether float16 and bfloat16 are refused.
    """
    if not isinstance(value, Tensor):
        raise ValueError(f"{name} must be a torch.Tensor, got {type(value).__name__}; use torch.as_tensor(...)")
    check_precision(name, value.dtype, precise=precise)
    if value.ndim < len(shape) or any(isinstance(n, int) and n != m for n, m in zip(shape[::-1], value.shape[::-1], strict=False)):
        raise ValueError(f"{name} must be (*batch, {', '.join(map(str, shape))}), got {tuple(value.shape)}")


def check_precision(name: str, dtype: torch.dtype, *, precise: bool = True) -> None:
    """Raise a ``ValueError`` unless ``dtype`` is a real floating point type, with the digits that measurements need."""
    if not dtype.is_floating_point:
        raise ValueError(f"{name} must be of floating point, got {dtype}; use .double()")
    if precise and dtype not in PRECISE:
        raise ValueError(f"{name} must be float32 or float64, got {dtype}, which has too few digits; use .float()")


def refuse_vmap(name: str, value: Tensor) -> None:
    """Raise a ``ValueError`` for a tensor inside of ``torch.func.vmap``: which way to go depends on values."""
    functorch = torch._C._functorch
    while functorch.is_functorch_wrapped_tensor(value):
        if functorch.is_batchedtensor(value):
            raise ValueError(f"{name} is mapped over by torch.func.vmap; give all problems at once, in leading dimensions")
        value = functorch.get_unwrapped(value)


def check_together(**tensors: tuple[Tensor, int]) -> torch.Size:
    """The batch of several tensors: raise a ``ValueError`` unless they have one dtype, one device and batches that agree.

    Args:
        **tensors: by name, each with the number of its trailing dimensions.

    Returns:
        The leading dimensions, broadcast.
    """
    names = ", ".join(tensors)
    for what, kinds in (("dtype", [x.dtype for x, _ in tensors.values()]), ("device", [x.device for x, _ in tensors.values()])):
        if len(set(kinds)) > 1:
            raise ValueError(f"{names} need one {what}, got {', '.join(map(str, kinds))}; use .to({what})")
    batches = [x.shape[: x.ndim - trailing] for x, trailing in tensors.values()]
    try:
        # not torch's, which imports sympy (0.5 s)
        return torch.Size(np.broadcast_shapes(*batches))
    except ValueError:
        raise ValueError(f"{names} need the same *batch, got {', '.join(str(tuple(b)) for b in batches)}") from None
