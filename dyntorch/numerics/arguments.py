"""What tensors a function takes, checked in one place and said in one form."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import numpy as np
import torch
from torch import Tensor

from dyntorch.numerics.function_transforms import mapped_over

PRECISE = (torch.float32, torch.float64)
"""Types of numbers with the digits that measurements have; three digits (float16) or two (bfloat16) are fewer than pixels need."""

FARTHEST = 1e60
"""Largest coordinate that is taken for a measurement, larger ones are as infinite: their products leave the range of float64."""


def check_tensor(name: str, value: object, *shape: int | str, precise: bool = True) -> None:
    """Raise a ``ValueError`` unless ``value`` is a real floating point tensor ``(*batch, *shape)``."""
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


def check_options(options: object, kind: type) -> None:
    """Raise a ``ValueError`` unless the options of a verb are of the kind that it takes."""
    if not isinstance(options, kind):
        name = kind.__name__
        raise ValueError(f"options must be {name}, got {options!r}; use dataclasses.replace({name}(), ...)")


def refuse_vmap(name: str, value: Tensor, remedy: str = "give all problems at once, in leading dimensions") -> None:
    """Raise a ``ValueError`` for a tensor inside of ``torch.func.vmap``: which way to go depends on values."""
    if mapped_over(value):
        raise ValueError(f"{name} is mapped over by torch.func.vmap; {remedy}")


def check_threshold(threshold: float | None, estimated: bool = True, name: str = "threshold") -> None:
    """Refuse what is not one distance, or None where that means that it is ``estimated``."""
    try:
        value = 1.0 if threshold is None and estimated else float(threshold)  # type: ignore[arg-type]
    except (TypeError, ValueError, RuntimeError):
        value = float("nan")
    if not 0 < value < float("inf"):
        remedy = "None estimates it" if estimated else "2.5 pixels are right for most"
        raise ValueError(f"{name} must be a positive distance in the unit of the points, got {threshold!r}; {remedy}")


def check_weights(weights: Tensor | None, what: str) -> None:
    """Raise a ``ValueError`` for a negative weight; within ``torch.func`` values are not at hand, and not looked at."""
    if weights is None or torch._C._functorch.is_functorch_wrapped_tensor(weights) or not bool((weights < 0).any()):
        return
    raise ValueError(f"weights must not be negative, got {float(weights[weights < 0].min()):g}; use 0 to leave {what} out")


def check_together(**tensors: tuple[Tensor, int]) -> torch.Size:
    """The batch of several tensors: raise a ``ValueError`` unless they have one dtype, one device and batches that agree."""
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


# ----------------------------------------------------------------------------------------------------------------------
# Where a verb computes: beside its tensors, or on the CPU for them.


CPU = torch.device("cpu")
Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def on_cpu(verb: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Let a verb compute on the CPU wherever its tensors are, and return its result to their device.

    For searches: hundreds of small problems one after the other, each of which depends on what the one before has found.  An
    accelerator would be asked after every one of them (``synchronize`` on one: 300 to 900 waits a call) and could not be
    kept busy in between.  What gains from an accelerator - batches of problems, as in ``fit`` - stays beside its tensors.

    Tensors are looked for in sequences, mappings and dataclasses too.  Gradients pass.  A ``torch.Generator`` of an accelerator
    gives the seed of one of the CPU.

    Raises:
        ValueError: tensors of two accelerators.

    Example:
        >>> import torch
        >>> @on_cpu
        ... def largest(values):
        ...     return max(values.tolist()), values.max()
        >>> largest(torch.tensor([1.0, 3.0, 2.0]))
        (3.0, tensor(3.))
    """

    @wraps(verb)
    def lent(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        homes = {x.device for x in _tensors((args, kwargs))} - {CPU}
        if not homes:
            return verb(*args, **kwargs)
        if len(homes) > 1:
            raise ValueError(f"{verb.__name__} got tensors of {', '.join(sorted(map(str, homes)))}; use .to(device)")
        args, kwargs = move_to_device((args, kwargs), CPU)
        result: Result = move_to_device(verb(*args, **kwargs), *homes)
        return result

    return lent


def move_to_device(value: Any, device: torch.device) -> Any:
    """The same value with its tensors on another device, whatever holds them."""
    if isinstance(value, Tensor):
        # a device without float64 gets float32
        return value.to(device, torch.float32 if device.type == "mps" and value.dtype == torch.float64 else value.dtype)
    if isinstance(value, torch.Generator):
        return value if device != CPU or value.device == CPU else torch.Generator().manual_seed(_draw_seed(value))
    if isinstance(value, Mapping):
        return {key: move_to_device(part, device) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        parts = [move_to_device(part, device) for part in value]
        return type(value)(*parts) if hasattr(value, "_fields") else type(value)(parts)
    if _holds_fields(value):
        values = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
        return dataclasses.replace(
            value, **{name: move_to_device(part, device) for name, part in values.items() if any(True for _ in _tensors(part))}
        )
    return value


def _tensors(value: Any) -> Iterator[Tensor]:
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, Mapping):
        yield from _tensors(list(value.values()))
    elif isinstance(value, (list, tuple)):
        for part in value:
            yield from _tensors(part)
    elif _holds_fields(value):
        yield from _tensors([getattr(value, field.name) for field in dataclasses.fields(value)])


def _holds_fields(value: Any) -> bool:
    return dataclasses.is_dataclass(value) and not isinstance(value, type)


def _draw_seed(generator: torch.Generator) -> int:
    """A number drawn from it: the next call draws another."""
    return int(torch.randint(2**31, (1,), generator=generator, device=generator.device))
