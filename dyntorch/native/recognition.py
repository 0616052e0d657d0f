"""The compiled kernel of recognition: robust lines through sightings, residuals of all pairs, sketches slid along codes."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from dyntorch.native.library import call, load

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from torch import Tensor

WIDTH = 9
"""Neighbours that a line goes through."""
_TERMS = {"epi": 1, "nn": 2, "turned": 4}
_SIZE, _INT, _POINTER = ctypes.c_ssize_t, ctypes.c_int, ctypes.c_void_p


def native_deviations(
    places: NDArray[Any],
    times: NDArray[Any],
    rows: NDArray[Any],
    cuts: NDArray[Any],
    width: int,
    out: tuple[NDArray[Any], NDArray[Any]],
) -> bool:
    """Fill ``out``, both ``(rows, dims)`` float32: distance of sightings from the robust line through their neighbours, the
    neighbours' spread; whether there is a kernel for it.

    Args:
        places, times: ``(n, dims)``, ``(n,)``; rows: ``(rows,)`` of these, ascending.
        cuts: ``(paths + 1,)`` between which a path lies; width: neighbours on it, itself one of them.
    """
    if not load()[0] or width != WIDTH:
        return False
    arrays = [
        one.astype(kind, order="C", copy=False)
        for one, kind in zip((places, times, rows, cuts), ("f8", "f8", "i8", "i8"), strict=True)
    ]
    given = [one.ctypes.data for one in arrays]
    call("robust_deviations", *given, len(rows), places.shape[1], *(one.ctypes.data for one in out))
    return True


def native_residuals(
    left: Sequence[Tensor],
    right: Sequence[Tensor],
    fusions: Sequence[Sequence[str]],
    epsilon: float,
    tables: Sequence[Tensor],
    columns: Tensor | None = None,
) -> bool:
    """Lower tables ``(Q, width)`` to products of the residuals of planes, where these are less; whether there is a kernel for it.

    The least instruction set has none: torch's products are twice as fast.

    Args:
        left, right: for each channel U ``(N, 2, size)`` and L ``(N, 3)`` (:func:`indexing.action.bank.factorize`).
        fusions: terms of each table; columns: ``(E,)`` where the exemplars stand in the tables.
    """
    parts = [*left, *right, *tables]
    if "AVX" not in load()[1] or any(one.device.type != "cpu" or one.dtype.itemsize != 4 for one in parts):
        return False
    left, right = [one.contiguous() for one in left], [one.contiguous() for one in right]
    if not all(table.is_contiguous() for table in tables):
        return False

    def pointers(some: Sequence[Tensor]) -> Any:
        return (_POINTER * len(some))(*(one.data_ptr() for one in some))

    sides = [pointers(some) for some in (left[::2], left[1::2], right[::2], right[1::2])]
    sizes = (_INT * len(left[::2]))(*(one.shape[2] for one in left[::2]))
    terms = (_INT * len(fusions))(*(sum(_TERMS[term] for term in some) for some in fusions))
    columns = None if columns is None else columns.contiguous()
    numbers = None if columns is None else columns.data_ptr()
    about = (len(left[0]), len(right[0]), len(tables), terms, epsilon, pointers(tables), tables[0].shape[1], numbers)
    call("lower_residuals", len(left[::2]), *sides, sizes, *about)
    return True


def native_correlations(
    codes: NDArray[Any],
    scales: NDArray[Any],
    axes: NDArray[Any],
    stride: int,
    first: NDArray[Any] | int,
    ridge: float,
    out: NDArray[Any],
) -> bool:
    """Fill ``out (probes, windows)``, float32: squared canonical correlations of windows; whether there is a kernel for it.

    Args:
        codes, scales: ``(rows, 2, k)`` int8, ``(rows,)`` float32; axes: ``(probes, 2, samples, k)`` float32, orthonormal.
        stride: rows between samples; first: rows at which windows begin, or of the first of them, a stride apart.
    """
    arrays = (codes, scales, axes, out)
    kinds = ("int8", "float32", "float32", "float32")
    if not load()[0] or any(one.dtype != kind or not one.flags.c_contiguous for one, kind in zip(arrays, kinds, strict=True)):
        return False
    samples, k = axes.shape[2:]
    rows = None if isinstance(first, int) else first.astype("i8", order="C", copy=False)
    where = (None, first, out.shape[1]) if rows is None else (rows.ctypes.data, 0, len(rows))
    given = (codes.ctypes.data, scales.ctypes.data, k, *where, stride, samples, axes.ctypes.data, len(axes), ridge)
    call("score_windows", *given, out.ctypes.data)
    return True
