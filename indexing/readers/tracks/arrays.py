"""Tracks as the arrays of an ``.npz``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from indexing.opening import VALUE, clipped, error, listed, shown
from indexing.readers.npz import Archive
from indexing.readers.points.pointset import FloatArray, as_view
from indexing.readers.tracks.trackset import TrackSet, numbered

KEYS = "give 'tracks' (views, n, 2 or 3) or 'y' (frames, points, 2), and perhaps 'times', 'ids', 'static', 'weights'"
EXTRA = ("times", "ids", "static", "weights")


def read_arrays(path: Path, key: str | None) -> TrackSet:
    """Tracks of an ``.npz``.

    Raises:
        ValueError: no tracks in it, several without a key, arrays that do not fit.
    """
    archive = Archive(path)
    before, name = _chosen(path, list(archive), key)
    values, extra = archive[name], {kind: archive[before + kind] for kind in EXTRA if before + kind in archive}
    if values.ndim != 3 or values.shape[-1] not in (2, 3):
        raise error(path, f"{name} has shape {values.shape}", KEYS)
    flat = as_view(values.reshape(-1, values.shape[-1]), f"{path} {name}")
    views, n = values.shape[:2]
    for kind, shape in (("times", (views,)), ("ids", (n,)), ("static", (n,)), ("weights", (views, n))):
        if kind in extra and extra[kind].shape != shape:
            raise error(path, f"{kind} has shape {extra[kind].shape}, {name} has {values.shape}", f"expected {shape}")
    ids = tuple(map(str, extra["ids"].tolist())) if "ids" in extra else numbered(n)
    return TrackSet(
        str(path), flat.reshape(values.shape), ids, tuple(map(str, range(views))), _reals(path, extra, "times"),
        _reals(path, extra, "weights", 0.0), None if "static" not in extra else extra["static"].astype(bool),
    )  # fmt: skip


def _chosen(path: Path, names: list[str], key: str | None) -> tuple[str, str]:
    """What the names of the arrays begin with, and the name of the tracks."""
    several = [name[:-2] for name in names if name.endswith("/y")]
    if key is not None and key in names:
        return "", key
    if key is not None and key not in several:
        known = f"its sequences are {listed(several)}" if several else f"its arrays are {listed(names)}"
        raise error(path, f"has no {'sequence' if several else 'array'} {shown(key)}", known)
    if key is None and several:
        raise error(
            path, f"holds {len(several)} sequences ({listed(several, 4)})", f"say which: --key {clipped(several[0], VALUE)}"
        )
    before = "" if key is None else f"{key}/"
    name = next((f"{before}{kind}" for kind in ("tracks", "y") if f"{before}{kind}" in names), None)
    if name is None:
        others = [other for other in names if other not in EXTRA]
        choice = f"; or say which array has the tracks: --key {clipped(others[0], VALUE)}" if others else ""
        raise error(path, f"its arrays are {listed(names)}", KEYS + choice)
    return before, name


def _reals(path: Path, extra: dict[str, Any], kind: str, least: float = -np.inf) -> FloatArray | None:
    if kind not in extra:
        return None
    values = extra[kind]
    if values.dtype.kind not in "fiub" or not np.isfinite(values).all() or (values < least).any():
        of = "" if np.isinf(least) else f" of {least:g} or more"
        raise error(path, f"{kind} holds values that are no finite numbers{of}", "correct them")
    return np.asarray(values, dtype=np.float64)
