"""The compiled kernel: loaded once, for the instruction set of this processor, and called with tensors."""

from __future__ import annotations

import ctypes
import math
import os
from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

from dyntorch.native.build import LIBRARY, source_digest

if TYPE_CHECKING:
    from torch import Tensor

INSTRUCTIONS = {"avx512": (8, "AVX-512"), "avx2": (4, "AVX2"), "base": (2, "SSE2 or NEON")}
"""Problems per register, and the name, the widest first."""
MIN_SIZE, MAX_SIZE, MAX_DIM = 4, 160, 5
"""Columns, and dimensions of the null space, that the kernel solves."""
_POINTER, _SIZE, _INT = ctypes.c_void_p, ctypes.c_ssize_t, ctypes.c_int
_ARGUMENTS = {
    "null_of_grams": (_POINTER, _SIZE, _INT, _INT, *[_POINTER] * 5),
    "null_of_rows": (_POINTER, _SIZE, _SIZE, *[_INT] * 3, *[_POINTER] * 4),
    "fit_points": (_INT, *[_POINTER] * 5, _SIZE, _SIZE, *[_INT] * 5, *[_POINTER] * 9),
    "robust_deviations": (*[_POINTER] * 4, _SIZE, _INT, _POINTER, _POINTER),
    "lower_residuals": (_INT, *[_POINTER] * 5, _SIZE, _SIZE, _INT, _POINTER, ctypes.c_float, _POINTER, _SIZE, _POINTER),
    "score_windows": (_POINTER, _POINTER, _INT, _POINTER, _SIZE, _SIZE, _INT, _INT, _POINTER, _INT, ctypes.c_float, _POINTER),
    "null_vectors": (_POINTER, _SIZE, _POINTER, _POINTER),
    "distances": (_INT, *[_POINTER] * 6, _SIZE, _SIZE, _POINTER),
    "refine": (_INT, *[_POINTER] * 6, _SIZE, _SIZE, _INT, _INT, *[_POINTER] * 6),
    "polish": (_INT, *[_POINTER] * 6, _SIZE, _SIZE, _INT, _INT, *[_POINTER] * 9),
    "search": (_INT, *[_POINTER] * 8, _SIZE, _SIZE, *[_INT] * 5, *[_POINTER] * 7),
}
MAX_SLOTS, MAX_SPACE = 6, 8
"""Views, and dimensions of what is measured in them, that :func:`fit_points` takes."""
POINT, HYPERPLANES_THROUGH, CONIC_MONOMIALS, VECTORS = range(4)
"""What a measured point puts into a slot, as the kernel numbers it; the last: the vector itself, of normalized matches."""
MAX_SEARCHED_SLOTS, MAX_SEARCHED_SPACE = 3, 3
"""The same of :func:`search`."""
FROM_ALL, FROM_SAMPLES, FROM_SUBSETS, LEAST_MEDIAN, AS_GIVEN = range(5)
"""What :func:`search` starts from."""
UNDECIDED, WEAK = 1, 2
"""Flags of a fit: left to torch, and with a second tensor that may fit as well within the noise."""


@cache
def load() -> tuple[dict[str, Any], str]:
    """The functions of the kernel by name, none where the torch path computes; and what computes, with the reason.

    ``DYNTORCH_NATIVE``: 0 for the torch path, or the instruction set (``avx512``, ``avx2``, ``base``); empty: the best.
    """
    wanted = os.environ.get("DYNTORCH_NATIVE", "")
    if wanted == "0":
        return {}, "torch (DYNTORCH_NATIVE=0)"
    if not LIBRARY.exists():
        return {}, "torch (the kernel was not compiled: python -m dyntorch.native.build says why)"
    try:
        library = ctypes.CDLL(str(LIBRARY))
        library.made_from.restype = ctypes.c_char_p
        made_from = library.made_from().decode()
    except (OSError, AttributeError) as error:
        return {}, f"torch ({LIBRARY.name} cannot be loaded: {' '.join(str(error).split())})"
    if made_from != source_digest():
        return {}, f"torch ({LIBRARY.name} was made from another version: python -m dyntorch.native.build)"
    for level, (lanes, name) in INSTRUCTIONS.items():
        if wanted in ("", level) and library.has_instructions(lanes) and hasattr(library, f"null_of_grams_{level}"):
            functions = {function: getattr(library, f"{function}_{level}") for function in _ARGUMENTS}
            for function, arguments in _ARGUMENTS.items():
                functions[function].argtypes = arguments
            return functions, f"native ({name})"
    return {}, f"torch (DYNTORCH_NATIVE={wanted} is none of 0, {', '.join(INSTRUCTIONS)} that this processor has)"


def native() -> str:
    """What computes null spaces: ``native (AVX-512)``, ``native (AVX2)`` or ``torch`` and why.

    Example:
        >>> import dyntorch as dyn
        >>> dyn.numerics.native().split()[0] in ("native", "torch")
        True
    """
    return load()[1]


def solves(size: int, dim: int) -> bool:
    """Whether the kernel finds null spaces of this dimension of matrices of so many columns, on the host."""
    return MIN_SIZE <= size <= MAX_SIZE and dim <= MAX_DIM and dim < size and bool(load()[0])


def null_of_grams(gram: Tensor, dim: int) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Null spaces of Grams ``(b, D, D)`` float64: basis ``(b, dim, D)``, values ``(b, dim)``, sum of 1 / eigenvalue over the
    others, next eigenvalue over the trace, whether certified ``(b,)``; what is not certified is not to be used."""
    gram = gram.contiguous()
    batch, size = gram.shape[:2]
    basis, values = gram.new_empty(batch, dim, size), gram.new_empty(batch, dim)
    total, following, certified = gram.new_empty(batch), gram.new_empty(batch), gram.new_empty(batch, dtype=_torch().bool)
    out = (basis, values, total, following, certified)
    call("null_of_grams", gram.data_ptr(), batch, size, dim, *(part.data_ptr() for part in out))
    return out


def null_of_rows(matrix: Tensor, dim: int, *, always: bool, keep: bool) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Null spaces of rows ``(b, rows, D)`` float64: basis, next eigenvalue of the Gram over its trace, whether certified, and the
    Grams where they are to be kept (else empty).  ``always``: corrected by the rows however large the next eigenvalue is."""
    matrix = matrix.contiguous()
    batch, rows, size = matrix.shape
    basis, following = matrix.new_empty(batch, dim, size), matrix.new_empty(batch)
    certified, gram = matrix.new_empty(batch, dtype=_torch().bool), matrix.new_empty(batch, *([size] * 2 if keep else [0, 0]))
    out = (basis.data_ptr(), following.data_ptr(), certified.data_ptr(), gram.data_ptr() if keep else None)
    call("null_of_rows", matrix.data_ptr(), batch, rows, size, dim, always, *out)
    return basis, following, certified, gram


class PointFits(NamedTuple):
    """What the kernel says of the fits of a batch; see ``fit.h``."""

    transforms: list[Tensor]  # (b, d + 1, d + 1) of each view
    basis: Tensor  # (b, dim, D), of the normalized matches
    second: Tensor  # (b, D): vector of the next eigenvalue
    normalized: Tensor  # (b, *widths): of dim 1, with its internal constraint; else empty
    tensor: Tensor  # (b, *widths) in measured coordinates
    uncertainty: Tensor  # (b,)
    status: Tensor  # (b,)
    flags: Tensor  # (b,): UNDECIDED, WEAK or 0


def fit_points(
    kinds: Sequence[int],
    views: Sequence[Tensor],
    weights: Tensor,
    widths: Sequence[int],
    *,
    dim: int,
    normalized: bool,
    rows: int,
    minimal: int,
    constraint: int | None,
    limits: Sequence[float],
) -> PointFits:
    """Similarities, moments of the products of slots, null spaces, judgement and the way back in one pass: views ``(b, n, d)`` of
    any strides, weights ``(b, n)``, float64; slots of so many columns, so many rows per match; constraint None: only the null
    spaces."""
    weights = weights.contiguous()
    (batch, matches), count, new = weights.shape, len(views), weights.new_empty
    shape = (batch, *widths) if constraint is not None else (0,)
    fits = PointFits(
        [new(batch, *(0, 0) if kind == VECTORS else (x.shape[-1] + 1,) * 2) for kind, x in zip(kinds, views, strict=True)],
        new(batch, dim, math.prod(widths)),
        new(batch, math.prod(widths)),
        new(shape),
        new(shape),
        new(batch),
        new(batch, dtype=_torch().int64),
        new(batch, dtype=_torch().uint8),
    )
    places = (_POINTER * count)(*(x.data_ptr() for x in fits.transforms))
    # of an empty tensor the address is null, which the kernel takes for "not wanted"
    out = [part.data_ptr() or None for part in (fits.basis, fits.second, fits.normalized, fits.tensor)]
    out += [part.data_ptr() for part in (fits.uncertainty, fits.status, fits.flags)]
    bounds = _doubles(limits)
    given = (weights.data_ptr(), batch, matches, dim, normalized, rows, minimal, constraint or 0)
    call("fit_points", *_slots(kinds, views), *given, bounds, places, *out)
    return fits


class Finds(NamedTuple):
    """What a search found, one tensor per problem; see ``search.h`` and ``consensus.py``."""

    basis: Tensor  # (b, D)
    score: Tensor  # (b,)
    evidence: Tensor  # (b,)
    doubt: Tensor  # (b,) bool
    agreeing: Tensor  # (b,)
    inliers: Tensor  # (b, n) bool


def search(
    kinds: Sequence[int],
    views: Sequence[Tensor],
    weights: Tensor,
    scales: Tensor,
    limits: Tensor,
    *,
    minimal: int,
    rules: Sequence[float],
    starts: int = 1,
    keep: int = 1,
    iterations: int = 0,
    mode: int = FROM_ALL,
    seeds: Tensor | None = None,
    given: Tensor | None = None,
) -> Finds:
    """Tensors that most matches agree with: views ``(b, n, d)`` normalized, weights ``(b, n)`` of at most 1, scales ``(b, views)``,
    limits ``(b,)`` of squared distances; from all matches, with seeds ``(b,)`` from so many minimal samples or larger subsets, or
    as given ``(b, D)``.  Of the least median there is only the score."""
    weights, scales, limits = weights.contiguous(), scales.contiguous(), limits.contiguous()
    seeds = None if seeds is None else seeds.contiguous()
    (batch, matches), new = weights.shape, weights.new_empty
    width = math.prod(x.shape[-1] + 1 for x in views)
    basis = new(batch, width) if given is None else given.clone(memory_format=_torch().contiguous_format)
    flags = new(batch, dtype=_torch().bool), new(batch, matches, dtype=_torch().bool)
    finds = Finds(basis, new(batch), new(batch), flags[0], new(batch), flags[1])
    mode = mode if given is None else AS_GIVEN
    data = (weights.data_ptr(), scales.data_ptr(), limits.data_ptr(), None if seeds is None else seeds.data_ptr())
    numbers = (batch, matches, mode, starts, keep, iterations, minimal, _doubles(rules))
    call("search", *_slots(kinds, views), *data, *numbers, *(part.data_ptr() for part in finds))
    return finds


def null_vectors(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Left and right null vectors ``(b, 3)`` of matrices ``(b, 3, 3)`` float64 of rank two."""
    matrix = matrix.contiguous()
    left, right = matrix.new_empty(matrix.shape[:-1]), matrix.new_empty(matrix.shape[:-1])
    call("null_vectors", matrix.data_ptr(), matrix.numel() // 9, left.data_ptr(), right.data_ptr())
    return left, right


def distances(kinds: Sequence[int], views: Sequence[Tensor], scales: Tensor, tensors: Tensor) -> Tensor:
    """Sampson distances ``(b, n)`` from tensors ``(b, D)``: views and scales as :func:`search` takes them."""
    scales, tensors = scales.contiguous(), tensors.contiguous()
    out = tensors.new_empty(views[0].shape[:2])
    call("distances", *_slots(kinds, views), scales.data_ptr(), tensors.data_ptr(), *out.shape, out.data_ptr())
    return out


def refine(
    kinds: Sequence[int],
    views: Sequence[Tensor],
    weights: Tensor,
    scales: Tensor,
    motion: Tensor,
    *,
    constraint: int,
    iterations: int,
    rules: Sequence[float],
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Motions ``(b, p)`` of least squared Sampson distances, from given ones; data as in :func:`search` -> motion, cost
    ``(b,)``, gradient ``(b, p)``, Gauss-Newton matrix ``(b, p, p)``, steps ``(b,)``."""
    weights, scales = weights.contiguous(), scales.contiguous()
    motion = motion.clone(memory_format=_torch().contiguous_format)
    (batch, size), new = motion.shape, motion.new_empty
    found = (motion, new(batch), new(batch, size), new(batch, size, size), new(batch, dtype=_torch().int64))
    data = (
        weights.data_ptr(),
        scales.data_ptr(),
        batch,
        weights.shape[1],
        constraint,
        iterations,
        _doubles(rules),
    )
    call("refine", *_slots(kinds, views), *data, *(part.data_ptr() for part in found))
    return found


def polish(
    kinds: Sequence[int],
    views: Sequence[Tensor],
    weights: Tensor,
    scales: Tensor,
    limits: Tensor,
    tensors: Tensor,
    *,
    parameters: int,
    constraint: int,
    rounds: Sequence[int],
    rules: Sequence[float],
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Tensors ``(b, D)`` that a search found, refined on their inliers, chosen again after each round: data as in :func:`search`
    -> tensors, weights of the inliers ``(b, n)``, motion ``(b, p)``, cost, gradient, Gauss-Newton matrix, distances ``(b, n)``."""
    scales, limits = scales.contiguous(), limits.contiguous()
    batch, new = len(weights), weights.new_empty
    tensors, weights = (x.clone(memory_format=_torch().contiguous_format) for x in (tensors, weights))
    square = (batch, parameters, parameters)
    found = (tensors, weights, new(square[:2]), new(batch), new(square[:2]), new(square), _torch().empty_like(weights))
    steps, numbers = (_INT * len(rounds))(*rounds), _doubles(rules)
    data = (scales.data_ptr(), limits.data_ptr(), *weights.shape, constraint, len(rounds), steps, numbers)
    call("polish", *_slots(kinds, views), *data, *(part.data_ptr() for part in found))
    return found


def _doubles(numbers: Sequence[float]) -> Any:
    return (ctypes.c_double * len(numbers))(*numbers)


def _slots(kinds: Sequence[int], views: Sequence[Tensor]) -> tuple[Any, ...]:
    """Slots as the functions of the kernel take them: how many, kinds, dimensions, places and strides in memory."""
    count = len(views)
    sizes = (_INT * count)(*(x.shape[-1] for x in views))
    places = (_POINTER * count)(*(x.data_ptr() for x in views))
    return count, (_INT * count)(*kinds), sizes, places, (_SIZE * (3 * count))(*(stride for x in views for stride in x.stride()))


def call(name: str, *arguments: Any) -> None:
    """A function of the kernel, which is there."""
    if load()[0][name](*arguments):
        raise MemoryError("no memory for the workspace of the kernel: fewer problems at once")


def _torch() -> Any:
    """Not needed by what only asks which kernel there is."""
    import torch

    return torch
