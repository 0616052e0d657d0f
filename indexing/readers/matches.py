"""Files of points -> views whose rows correspond: by name where all rows have one, otherwise by row."""

from __future__ import annotations

import os
from collections.abc import Sequence as Several
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from indexing.opening import VALUE, clip_text, error, head_of, shown
from indexing.readers import c3d, ply, points
from indexing.readers.points import BoolArray, FloatArray, PointSequence, PointSet

SHOWN = 5  # names listed in a message


@dataclass(frozen=True, eq=False)
class Matched:
    """Views whose rows correspond."""

    views: tuple[FloatArray, ...]  # ``(n, 2 | 3)`` points or ``(n, 2, 3)`` or ``(n, 6)`` lines each, float64, NaN = missing
    ids: tuple[str, ...]  # ``n`` names; numbers of the rows, from 1, where the files have none
    names: tuple[str, ...]  # where each view comes from
    weights: FloatArray | None = None  # ``(n,)``; None = all equal
    static: BoolArray | None = None  # ``(n,)`` known not to move; None = not known of any
    static_points: tuple[FloatArray, ...] = ()  # static points ``(m, 3)`` of both views of lines; empty = none
    notes: tuple[str, ...] = ()  # what a reader should know, a sentence each

    @property
    def lines(self) -> bool:
        """Whether the matches are lines."""
        return self.views[0].ndim == 3 or self.views[0].shape[-1] == 6

    @property
    def dims(self) -> tuple[int, ...]:
        """Coordinates of the points of each view, 2 or 3."""
        return tuple(3 if self.lines else int(view.shape[-1]) for view in self.views)


def read_matches(
    paths: Several[str | Path], *, frames: tuple[int, ...] | None = None, static_points: Several[str | Path] = ()
) -> Matched:
    """Read the views of an alignment."""
    if not paths:
        raise ValueError("no files; give a file of points for each view, or one .npz or .c3d with all of them")
    views, resting = _views([Path(path).expanduser() for path in paths], frames)
    if static_points:
        if resting:
            raise error(paths[0], "holds static points, too", "leave --static-points out")
        resting, _ = _views([Path(path).expanduser() for path in static_points], None)
    matched = match(views)
    if not resting:
        return matched
    if not matched.lines:
        raise error(resting[0].path, "static points are for lines", "mark static matches by a column static instead")
    points = match(resting)
    if points.lines or points.dims != (3,) * len(matched.views):
        raise error(
            resting[0].path, f"{len(points.views)} files of {points.dims[0]}D static points", "give 3D points for each view"
        )
    notes = matched.notes + tuple(f"static points: {note}" for note in points.notes)
    seen = np.isfinite(np.concatenate(points.views, axis=1)).all(axis=1)
    if not seen.all():
        notes += (f"static points: {int((~seen).sum())} missing in a view were left out",)
    return replace(matched, static_points=tuple(view[seen] for view in points.views), notes=notes)


def open_points(path: Path) -> PointSet | PointSequence:
    """One file of points, by its content."""
    head = opening(path)
    if head.startswith(b"ply"):
        return ply.read(path)
    if head.startswith(b"\x93NUMPY"):
        return points.read_npy(path)
    if len(head) > 1 and head[1] == 0x50 and (path.suffix.lower() == ".c3d" or b"\0" in head):
        return c3d.read(path)
    if b"\0" in head:
        raise error(path, "is a binary file of no known format", "give points as CSV, npz, npy, PLY or C3D")
    return points.read(path)


def opening(path: Path) -> bytes:
    """The first bytes of a file of points."""
    if os.path.isdir(path):
        raise error(path, "is a folder", "give a file of points")
    return head_of(path)


def _views(paths: Several[Path], frames: tuple[int, ...] | None) -> tuple[list[PointSet], list[PointSet]]:
    """The views, and the static points that came with them."""
    if len(paths) == 1 and opening(paths[0]).startswith(b"PK"):
        if frames is not None:
            raise error(paths[0], "an .npz has no frames", "leave --frames out")
        return points.read_npz(paths[0])
    views: list[PointSet] = []
    for path in paths:
        if opening(path).startswith(b"PK"):
            raise error(path, "an .npz holds all views", "give it alone")
        found = open_points(path)
        if isinstance(found, PointSequence):
            if len(paths) > 1:
                raise error(path, f"holds {len(found.values)} frames", "give one such file alone, with --frames")
            return found.views(frames), []
        views.append(found)
    if frames is not None:
        raise error(paths[0], "has no frames", "leave --frames out; it is for .c3d, and .npy of shape (frames, n, d)")
    return views, []


def match(views: Several[PointSet]) -> Matched:
    """Rows that correspond: by name where all views have names, otherwise by row."""
    first = views[0]
    other = next((view for view in views if view.lines != first.lines), None)
    if other is not None:
        points, lines = (first, other) if other.lines else (other, first)
        raise error(lines.path, f"holds lines, but {points.path} points", "give one kind")
    names = tuple(view.path for view in views)
    if all(view.ids is not None for view in views):
        return _by_name(views, names)
    notes = []
    named = [view.path for view in views if view.ids is not None]
    if named:
        bare = next(view.path for view in views if view.ids is None)
        notes.append(f"rows were matched by their order, not by name, because {bare} has no column of names")
    longer = next((view for view in views if len(view.values) != len(first.values)), None)
    if longer is not None:
        said = f"has {len(longer.values)} rows, {first.path} {len(first.values)}"
        raise error(longer.path, said, "give a row per match in every file, or a column id to match the rows by")
    ids = next((view.ids for view in views if view.ids is not None), None) or tuple(str(i + 1) for i in range(len(first.values)))
    weights, static = _marks(views)
    return Matched(tuple(view.values for view in views), ids, names, weights, static, (), tuple(notes))


def _by_name(views: Several[PointSet], names: tuple[str, ...]) -> Matched:
    places = [{name: i for i, name in enumerate(view.ids or ())} for view in views]
    shared = [name for name in places[0] if all(name in place for place in places[1:])]
    if not shared:
        mine, theirs = next(iter(places[0])), next(iter(places[1]))
        said = f"no name is in all of {', '.join(names)} (it has {shown(mine)}, where {names[1]} has {shown(theirs)})"
        raise error(names[0], said, "name the same match the same, or leave the column out to match rows by their order")
    notes = []
    lost = sorted({name for place in places for name in place} - set(shared))
    if lost:
        more = f" and {len(lost) - SHOWN} more" if len(lost) > SHOWN else ""
        left = "name is not in every view and was" if len(lost) == 1 else "names are not in every view and were"
        notes.append(f"{len(lost)} {left} left out: {', '.join(clip_text(name, VALUE) for name in lost[:SHOWN])}{more}")
    order = [np.array([place[name] for name in shared]) for place in places]
    sorted_views = [
        PointSet(
            view.path, view.values[rows], tuple(shared), None if view.weights is None else view.weights[rows],
            None if view.static is None else view.static[rows],
        )
        for view, rows in zip(views, order, strict=True)
    ]  # fmt: skip
    weights, static = _marks(sorted_views)
    return Matched(tuple(view.values for view in sorted_views), tuple(shared), names, weights, static, (), tuple(notes))


def _marks(views: Several[PointSet]) -> tuple[FloatArray | None, BoolArray | None]:
    """Weights and static matches of the first view that has any."""
    weights = next((view for view in views if view.weights is not None), None)
    static = next((view.static for view in views if view.static is not None), None)
    if weights is None or weights.weights is None:
        return None, static
    values = np.nan_to_num(weights.weights)
    if (values < 0).any() or not np.isfinite(values).all():
        at = int(np.flatnonzero((values < 0) | ~np.isfinite(values))[0])
        raise error(weights.path, f"match {at + 1}: the weight is {values[at]:g}", "weights are 0 or more")
    return values, static
