"""Points and lines as numpy arrays: ``.npy`` with one view or several, ``.npz`` with all views of the matches."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from indexing.opening import error, listed, shown
from indexing.readers.npz import Archive
from indexing.readers.npz import read_npy as read_npy_file
from indexing.readers.points.pointset import PointSet, as_view
from indexing.readers.points.sequence import Sequence

KEYS = "keys are x1, x2, x3 (2D), P1, P2, P3 (3D) or l1, l2 (lines), also ids, weights, static, and with lines static1, static2"
EXTRA = ("ids", "weights", "static", "static1", "static2")


def read_npy(path: Path) -> PointSet | Sequence:
    """One view ``(n, d)``, lines ``(n, 2, 3)`` or ``(n, 6)``, or several views ``(views, n, d)``.

    Raises:
        ValueError: no such array.
    """
    array = read_npy_file(path)
    if array.ndim == 3 and array.shape[1:] != (2, 3) and array.shape[-1] in (2, 3):
        return Sequence(str(path), as_view(array.reshape(-1, array.shape[-1]), path).reshape(array.shape))
    lines = array.ndim == 3 or array.shape[-1:] == (6,)
    return PointSet(str(path), as_view(array, path, lines))


def read_npz(path: Path) -> tuple[list[PointSet], list[PointSet]]:
    """All views, and for lines the static points of both.

    Raises:
        ValueError: no known keys, a view is missing, or arrays that do not fit.
    """
    archive = Archive(path)
    names = list(archive)
    prefix = next((prefix for prefix in ("x", "P", "l") if f"{prefix}1" in names), None)
    if prefix is None:
        raise error(path, f"its arrays are {listed(names)}", KEYS)
    unknown = [name for name in names if name not in EXTRA and not (name[:1] == prefix and name[1:] in ("1", "2", "3"))]
    if unknown:
        raise error(path, f"has an array {shown(unknown[0])}, which is not known", KEYS)
    wanted = [f"{prefix}{i}" for i in ((1, 2) if prefix == "l" else (1, 2, 3))]
    missing = [name for name in wanted if name not in names]
    if missing:
        raise error(path, f"has {wanted[0]} but no {missing[0]}", KEYS)
    extra = {name: archive[name] for name in EXTRA if name in names}
    views = []
    for name in wanted:
        where = f"{path} {name}"
        values = as_view(archive[name], where, lines=prefix == "l")
        for field in ("ids", "weights", "static"):
            if field in extra and extra[field].shape != (len(values),):
                raise error(path, f"{field} has shape {extra[field].shape}, {name} has {len(values)} rows", "give one per row")
        ids = tuple(map(str, extra["ids"].tolist())) if "ids" in extra else None
        views.append(PointSet(where, values, ids, _weights(path, extra), _static(path, extra)))
    resting = [
        PointSet(f"{path} {name}", as_view(extra[name], f"{path} {name}")) for name in ("static1", "static2") if name in extra
    ]
    return views, resting


def _weights(path: Path, extra: dict[str, Any]) -> Any:
    if "weights" not in extra:
        return None
    if extra["weights"].dtype.kind not in "fiub":
        raise error(path, f"weights are of type {extra['weights'].dtype}", "give real numbers")
    return extra["weights"].astype(np.float64)


def _static(path: Path, extra: dict[str, Any]) -> Any:
    if "static" not in extra:
        return None
    if not np.isin(extra["static"], (0, 1)).all():
        raise error(path, "static holds other values than 0 and 1", "use 1 for matches known to be static")
    return extra["static"].astype(bool)
