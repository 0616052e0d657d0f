"""A pretend accelerator: tensors of the device type "pretend" hold CPU data and obey the rules of an accelerator.

No accelerator has to be at hand to find what breaks on one.  On it

- ``x.device.type`` is not "cpu": the branches that CUDA takes are the ones that run;
- tensors of two devices never meet (RuntimeError, as on CUDA): only numbers (CPU tensors without dimensions) and the indices of an
  indexing may come from the CPU;
- random numbers cannot be drawn there from a generator of the CPU;
- everything that makes the host wait for the device is written down with the line of ours that did it: a value read
  (``float(x)``, ``bool(x)``, ``x.item()``), a copy to the host, a shape that depends on values (``nonzero``, a mask as index,
  ``unique``), and factorizations that check for failure (``inv``, ``solve``, ``cholesky``; not their ``_ex`` forms).

What it cannot show: rounding (the kernels are those of the CPU), speed, memory, and kernels that a device lacks.

A tensor of the device is a wrapper subclass beside a CPU tensor of the same strides; ``__torch_dispatch__`` runs every operation on
the CPU tensors.  torch's backend for devices written in Python supplies the rest.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, partial
from pathlib import Path
from typing import Any, ClassVar

import pytest
import torch
from torch import Tensor
from torch.utils import backend_registration

from dyntorch.numerics import arguments as devices

NAME, KEY = "pretend", "PrivateUse1"
CPU = torch.device("cpu")
OURS = tuple(str(Path(__file__).parent.parent / package) for package in ("dyntorch", "indexing"))

COPIES = {"aten::_to_copy", "aten::copy_", "aten::_copy_from"}
INDEXING = {"aten::index", "aten::index_put", "aten::index_put_", "aten::_index_put_impl_", "aten::_unsafe_index"}
VALUES = {"aten::_local_scalar_dense", "aten::item", "aten::equal", "aten::is_nonzero", "aten::allclose"}
SHAPES = {f"aten::{name}" for name in ("nonzero", "masked_select", "_unique2", "unique_dim", "unique_consecutive", "bincount")}
CHECKS = {"aten::_linalg_check_errors"}
EAGER = {"aten::_conj": torch.ops.aten.conj_physical.default, "aten::_neg_view": torch.ops.aten.neg.default}
"""What torch puts off by a mark on the tensor, which nobody reads below ``__torch_dispatch__``."""
FACTORIES = (
    *("arange", "empty", "empty_strided", "eye", "full", "linspace", "logspace", "ones", "zeros", "scalar_tensor"),
    *("rand", "randint", "randn", "randperm", "normal", "tril_indices", "triu_indices"),
)


class Traffic(list[tuple[str, str]]):
    """What made the host wait for the device: kind and line of ours of each."""

    current: ClassVar[Traffic]
    """What is being counted."""

    @staticmethod
    def note(kind: str) -> None:
        Traffic.current.append((kind, _our_line()))

    def __str__(self) -> str:
        places = Counter(self).most_common(12)
        return f"{len(self)} waits: " + "; ".join(f"{n} {kind} at {line}" for (kind, line), n in places)


Traffic.current = Traffic()


class PretendTensor(Tensor):
    """A tensor of the pretend device."""

    raw: Tensor
    """Its values, on the CPU."""
    __torch_function__ = torch._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls, raw: Tensor) -> PretendTensor:
        with torch.inference_mode(False):  # torch makes no views of subclasses that were made in inference mode
            wrapper: PretendTensor = torch.Tensor._make_wrapper_subclass(  # type: ignore[attr-defined]
                cls, raw.shape, strides=raw.stride(), storage_offset=raw.storage_offset(), dtype=raw.dtype, device=_device()
            )
        wrapper.raw = raw
        return wrapper

    @classmethod
    def __torch_dispatch__(cls, op: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(op, args, kwargs or {})

    # torch refuses the next three to subclasses
    def tolist(self) -> Any:
        return self.cpu().tolist()

    def __repr__(self, **_: Any) -> str:  # type: ignore[override]
        return f"{self.cpu()!r}, on {NAME}"

    def __format__(self, spec: str) -> str:
        return format(self.item(), spec) if self.dim() == 0 else object.__format__(self, spec)


def pretend_device() -> torch.device:
    """The device; skips the test where torch cannot have it."""
    if not _LIBRARIES:
        pytest.skip("a real accelerator is here, or a torch without backends written in Python")
    return _device()


def accelerators() -> list[str]:
    """Names of the devices that are at hand, the pretend one among them; skips the test where there is none."""
    found = [NAME] * bool(_LIBRARIES) + ["cuda"] * torch.cuda.is_available()
    return found or pytest.skip("no CUDA device, and a torch without backends written in Python")


@contextmanager
def counted() -> Iterator[Traffic]:
    """What makes the host wait inside the block."""
    outer, Traffic.current = Traffic.current, Traffic()
    try:
        yield Traffic.current
    finally:
        Traffic.current = outer


def moved(value: Any, device: torch.device | str) -> Any:
    """The tensors of a value on another device, whatever holds them."""
    return devices.move_to_device(value, torch.device(device))


# ---- one operation -----------------------------------------------------------------------------------------------------
def _run(op: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    there: list[PretendTensor] = []
    foreign: list[Tensor] = []
    raw_args = _sorted_out(args, there, foreign)
    raw_kwargs = {key: _sorted_out(value, there, foreign) for key, value in kwargs.items()}
    name, asked = op._schema.name, kwargs.get("device")
    result_there = bool(there) if asked is None else _is_ours(asked)
    if name in COPIES:
        _note_copy(name, args, result_there)
    else:
        _check_one_device(name, args, foreign if there else [], kwargs)
        _note_wait(op, name, args)
    if _is_ours(asked):
        raw_kwargs["device"] = CPU
    raw_kwargs.pop("pin_memory", None)
    out = EAGER.get(name, op)(*raw_args, **raw_kwargs)
    if not result_there:
        return out
    if torch.Tag.inplace_view in op.tags:
        return _like_its_values(args[0])
    # an operation in place, or into out=, returns the tensor that it was given
    return _wrapped(out, {id(part.raw): part for part in there})


def _sorted_out(value: Any, there: list[PretendTensor], foreign: list[Tensor]) -> Any:
    """The value with CPU tensors instead of ours, which are listed, as are those of the CPU."""
    if isinstance(value, PretendTensor):
        there.append(value)
        return value.raw
    if isinstance(value, Tensor):
        foreign.append(value)
    elif isinstance(value, (list, tuple)):
        return type(value)([_sorted_out(part, there, foreign) for part in value])
    return value


def _wrapped(value: Any, known: dict[int, PretendTensor]) -> Any:
    if isinstance(value, Tensor):
        return known.get(id(value)) if id(value) in known else PretendTensor(value)
    if isinstance(value, (list, tuple)):
        return type(value)([_wrapped(part, known) for part in value])
    return value


def _check_one_device(name: str, args: Any, foreign: list[Tensor], kwargs: dict[str, Any]) -> None:
    """Raise where an accelerator would: operands of two devices, or a generator of another."""
    generator = kwargs.get("generator")
    if generator is not None and generator.device.type != NAME:
        raise RuntimeError(f"Expected a '{NAME}' device type for generator but found '{generator.device.type}' ({_our_line()})")
    # numbers, and the indices of one of ours, may come from the CPU
    indices = {id(part) for part in args[1]} if name in INDEXING and isinstance(args[0], PretendTensor) else ()
    if any(part.dim() and id(part) not in indices for part in foreign):
        raise RuntimeError(f"Expected all tensors to be on the same device, but {name} found {NAME} and cpu ({_our_line()})")


def _note_copy(name: str, args: Any, result_there: bool) -> None:
    if name == "aten::_to_copy":
        down = isinstance(args[0], PretendTensor) and not result_there
    else:
        target, source = (args[1], args[0]) if name == "aten::_copy_from" else args[:2]
        down = isinstance(source, PretendTensor) and not isinstance(target, PretendTensor)
    if down:
        Traffic.note("copy")


def _note_wait(op: Any, name: str, args: Any) -> None:
    mask = name in INDEXING and any(part is not None and part.dtype == torch.bool for part in args[1])
    if name in VALUES:
        Traffic.note("value")
    elif name in SHAPES or mask or (name == "aten::repeat_interleave" and op._overloadname == "Tensor"):
        Traffic.note("shape")
    elif name in CHECKS:
        Traffic.note("check")


def _like_its_values(wrapper: PretendTensor) -> PretendTensor:
    """The wrapper, with the shape and strides that its values got in place."""
    with torch._C._DisableTorchDispatch():  # type: ignore[attr-defined]
        torch.ops.aten.as_strided_(wrapper, wrapper.raw.shape, wrapper.raw.stride(), wrapper.raw.storage_offset())
    return wrapper


def _is_ours(device: Any) -> bool:
    return device is not None and torch.device(device).type == NAME


def _our_line() -> str:
    """The innermost line of the packages on the stack."""
    frame = sys._getframe(1)
    while frame is not None:
        if frame.f_code.co_filename.startswith(OURS):
            return f"{Path(frame.f_code.co_filename).name}:{frame.f_lineno}"
        frame = frame.f_back  # type: ignore[assignment]
    return "outside"


# ---- registration, once a process --------------------------------------------------------------------------------------
class _Module:
    """What torch asks of ``torch.<device>``."""

    is_available = is_initialized = staticmethod(lambda: True)
    _is_in_bad_fork = staticmethod(lambda: False)
    device_count = staticmethod(lambda: 1)
    current_device = staticmethod(lambda: 0)
    _lazy_init = manual_seed_all = staticmethod(lambda *_: None)
    get_amp_supported_dtype = staticmethod(list)


_LIBRARIES: list[torch.library.Library] = []  # their kernels last as long as they do


def register() -> None:
    """Make the device known, before the first backward pass of the process: autograd counts the devices then.

    Not beside CUDA: autograd takes the streams of one accelerator, and a backward pass on the other fails inside torch.
    """
    setup: Callable[..., None] | None = getattr(backend_registration, "_setup_privateuseone_for_python_backend", None)
    if setup is None or _LIBRARIES or torch.cuda.is_available():
        return
    setup(NAME, backend_module=_Module)
    library = torch.library.Library("aten", "IMPL")
    for op in _factories():
        library.impl(op.name().removeprefix("aten::"), partial(_run_factory, op), KEY)
    # torch.tensor(values, device=) fills a new tensor behind the back of __torch_dispatch__
    library.impl("_copy_from", lambda source, target, _=False: _run(torch.ops.aten.copy_.default, (target, source), {}), KEY)
    # the tangents of forward mode that are 0 need no memory elsewhere
    library.impl("_efficientzerotensor", partial(_run_factory, torch.ops.aten.zeros.default), KEY)
    _LIBRARIES.append(library)


def _factories() -> Iterator[Any]:
    """Operations that make a tensor out of none: nothing but their device says where they belong."""
    for packet in (getattr(torch.ops.aten, name) for name in FACTORIES):
        for op in (getattr(packet, overload) for overload in packet.overloads()):
            kinds = [str(argument.type) for argument in op._schema.arguments]
            if "Tensor" not in kinds and any(argument.name == "device" for argument in op._schema.arguments):
                yield op


def _run_factory(op: Any, *args: Any, **kwargs: Any) -> Any:
    return _run(op, args, {**kwargs, "device": _device()})


@cache
def _device() -> torch.device:
    return torch.device(NAME, 0)
