"""Labels of any one kind: put together, compared, and replaced where an answer is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def same_label(a: Any, b: Any) -> bool:
    """Whether two labels are equal and of one type: 1 is not True."""
    return type(a) is type(b) and bool(a == b)


def joined(first: Array, second: Array) -> Array:
    """Labels of both, refusing to mix kinds that numpy would silently turn into strings."""
    if first.dtype.kind != second.dtype.kind and {first.dtype.kind, second.dtype.kind} & {"U", "S", "O"}:
        raise ValueError(
            f"labels: the fitted labels are of type {first.dtype}, the new ones {second.dtype}; give one kind of label"
        )
    return np.concatenate([first, second])


def refuse(labels: Array, refused: NDArray[np.bool_], none_label: Any) -> Array:
    """The labels with ``none_label`` where refused; the dtype stays where it can hold both."""
    if not refused.any():
        return np.asarray(labels)
    wide = np.asarray(none_label).dtype.kind == labels.dtype.kind
    out = labels.astype(np.result_type(labels.dtype, np.asarray(none_label).dtype) if wide else object)
    out[refused] = none_label
    return np.asarray(out)
