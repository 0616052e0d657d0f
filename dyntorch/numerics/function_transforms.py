"""Batches of independent problems as ``torch.func`` sees them: one operation with all its derivatives, and a rule for ``vmap``.

A solver looks at values to decide how to go on, which no function that is mapped over may do: there a tensor stands for all the
problems at once.  But what is mapped over is one more dimension of a batch, and a solver takes batches.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.autograd import forward_ad, grad

from dyntorch.numerics.blocks import rebuilt, tensors_of

Record = TypeVar("Record")
Tensors = tuple[Tensor, ...]


def is_transformed(*data: Any) -> bool:
    """Whether a tensor of some records is inside of a transformation of ``torch.func``, so that its values are not at hand."""
    wrapped = torch._C._functorch.is_functorch_wrapped_tensor
    return any(wrapped(tensor) for tensor in tensors_of(data))


def needs_gradient(x: Tensor) -> bool:
    """Whether somebody wants a derivative of it."""
    return (torch.is_grad_enabled() and x.requires_grad) or forward_ad.unpack_dual(x).tangent is not None


def needs_autograd(*data: Tensor) -> bool:
    """Whether autograd has to know what is done with tensors."""
    return is_transformed(*data) or any(map(needs_gradient, data))


def is_plain(*data: Tensor) -> bool:
    """Whether tensors are numbers in the memory of this machine and nobody wants a derivative: what compiled code may read."""
    return not needs_autograd(*data) and all(x.device.type == "cpu" for x in data)


def mapped_over(value: Tensor) -> bool:
    """Whether ``torch.func.vmap`` maps over a tensor, be it inside of other transformations."""
    functorch = torch._C._functorch
    while functorch.is_functorch_wrapped_tensor(value):
        if functorch.is_batchedtensor(value):
            return True
        value = functorch.get_unwrapped(value)
    return False


def over_problems(function: Callable[..., Record], *data: Any) -> Record:
    """``function(*data)`` of batches of independent problems; within ``torch.func`` too, in whatever order it is transformed.
    function ``(b, ...)``."""
    if not is_transformed(*data):
        return function(*data)
    results_of: list[Record] = []

    def flat(*tensors: Tensor) -> Tensors:
        given = iter(tensors)
        results_of[:] = [function(*(rebuilt(record, given) for record in data))]
        return tuple(tensors_of(results_of[0]))

    results = _OverProblems.apply(flat, *tensors_of(data))  # type: ignore[no-untyped-call]
    return rebuilt(results_of[0], iter(results))


class _OverProblems(torch.autograd.Function):
    """A function of tensors ``(b, ...)`` to a tuple of such."""

    @staticmethod
    def forward(function: Callable[..., Tensors], *inputs: Tensor) -> Tensors:
        # what comes in may not go out as it is, nor the same twice
        return tuple(part.clone() for part in function(*inputs))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensors) -> None:
        ctx.function = inputs[0]
        ctx.save_for_backward(*inputs[1:])
        ctx.save_for_forward(*inputs[1:])
        ctx.mark_non_differentiable(*(part for part in output if not part.is_floating_point()))

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor | None, ...]:
        inputs = ctx.saved_tensors
        pulled = iter(_OverProblems.apply(partial(_pulled_back, ctx.function, len(inputs)), *inputs, *cotangents))  # type: ignore[no-untyped-call]
        return None, *(next(pulled) if x.is_floating_point() else None for x in inputs)

    @staticmethod
    def jvp(ctx: Any, _: None, *tangents: Tensor | None) -> tuple[Tensor | None, ...]:
        inputs = ctx.saved_tensors
        along = [torch.zeros_like(x) if t is None else t for x, t in zip(inputs, tangents, strict=True) if x.is_floating_point()]
        pushed = _OverProblems.apply(partial(_pushed_forward, ctx.function, len(inputs)), *inputs, *along)  # type: ignore[no-untyped-call]
        return tuple(part if part.is_floating_point() else None for part in pushed)

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple[int | None, ...], function: Callable[..., Tensors], *inputs: Tensor
    ) -> tuple[Tensors, tuple[int, ...]]:
        merged = (merge_mapped_dimension(info, axis, x) for axis, x in zip(in_dims[1:], inputs, strict=True))
        parts = tuple(split_again(info, part) for part in _OverProblems.apply(function, *merged))  # type: ignore[no-untyped-call]
        return parts, (0,) * len(parts)


def _pulled_back(function: Callable[..., Tensors], count: int, *data: Tensor) -> Tensors:
    """Gradients by the inputs of floating point, given those by all outputs; differentiable where gradients are recorded."""
    create_graph, cotangents = torch.is_grad_enabled(), data[count:]
    with torch.enable_grad():
        inputs, floating = _leaves(data[:count])
        pairs = [(value, c) for value, c in zip(function(*inputs), cotangents, strict=True) if _is_differentiable(value)]
        values, along = [value for value, _ in pairs], [c for _, c in pairs]
        gradients = (
            grad(values, floating, along, create_graph=create_graph, allow_unused=True) if pairs else (None,) * len(floating)
        )
    return tuple(torch.zeros_like(x) if part is None else part for x, part in zip(floating, gradients, strict=True))


def _pushed_forward(function: Callable[..., Tensors], count: int, *data: Tensor) -> Tensors:
    """Changes of all outputs, given those of the inputs of floating point: what is pulled back is linear in the cotangents."""
    create_graph, tangents = torch.is_grad_enabled(), data[count:]
    with torch.enable_grad():
        inputs, floating = _leaves(data[:count])
        values = function(*inputs)
        moving = [value for value in values if _is_differentiable(value)]
        cotangents = [torch.zeros_like(value, requires_grad=True) for value in moving]
        pulled = grad(moving, floating, cotangents, create_graph=True, allow_unused=True) if moving else ()
        pairs = [(p, t) for p, t in zip(pulled, tangents, strict=False) if p is not None and p.requires_grad]
        slopes, along = [p for p, _ in pairs], [t for _, t in pairs]
        changes = grad(slopes, cotangents, along, create_graph=create_graph, allow_unused=True) if pairs else ()
    pushed = {id(value): part for value, part in zip(moving, changes, strict=False) if part is not None}
    return tuple(pushed.get(id(value), torch.zeros_like(value)) for value in values)


def _is_differentiable(value: Tensor) -> bool:
    return value.is_floating_point() and value.requires_grad


def _leaves(inputs: Tensors) -> tuple[Tensors, Tensors]:
    """The inputs as variables, each of its own, and those of floating point."""
    recorded = torch.is_grad_enabled()

    def variable(x: Tensor) -> Tensor:
        if not x.is_floating_point():
            return x
        return x.view_as(x) if recorded and x.requires_grad else x.detach().requires_grad_()

    every = tuple(variable(x) for x in inputs)
    return every, tuple(x for x in every if x.is_floating_point())


def merge_mapped_dimension(info: Any, axis: int | None, tensor: Tensor) -> Tensor:
    """The dimension that vmap maps over as part of the batch."""
    mapped = tensor.expand(info.batch_size, *tensor.shape) if axis is None else tensor.movedim(axis, 0)
    return mapped.flatten(0, 1)


def split_again(info: Any, part: Tensor) -> Tensor:
    """The inverse of :func:`merge_mapped_dimension` for what comes out."""
    return part.reshape(info.batch_size, len(part) // max(1, info.batch_size), *part.shape[1:])
