"""Film sets: one ``.npz`` with the grey frames of many short videos, laid out like a clip set (:mod:`indexing.readers.clipset`).

``frames (F, height, width)`` uint8 takes the place of ``joints``; ``offsets``, ``action``, ``action_names``, ``times`` or
``frame``, ``fps``, ``names`` and whatever else is known of each film are the same.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from indexing.labelled import LabelledSet
from indexing.opening import error
from indexing.readers.npz import Archive
from indexing.readers.sets import clip_labels, clip_meta, clip_names, clip_offsets, frame_times, need, per_clip, plain


@dataclass(frozen=True, eq=False)
class Film:
    """A short grey video in memory.

    Args:
        frames: ``(F, height, width)`` uint8; times: ``(F,)`` seconds; label, name, meta: as of a :class:`indexing.Clip`.
    """

    frames: NDArray[np.uint8]
    times: NDArray[np.float64]
    label: Hashable | None = None
    name: str = ""
    meta: Mapping[str, Any] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def duration(self) -> float:
        """Seconds from the first frame to the last."""
        return float(self.times[-1] - self.times[0])


class FilmSet(LabelledSet[Film]):
    """A list of films that can be selected by what is known of them."""


def holds_frames(path: str | Path) -> bool:
    """Whether a file is an ``.npz`` of frames, not of joints; looks at its table of contents only."""
    path = Path(path).expanduser()
    if path.suffix.lower() != ".npz":
        return False
    try:
        names = set(Archive(path))
    except ValueError:
        return False  # whoever reads it says what is wrong
    return "frames" in names and "joints" not in names


def read_film_set(path: str | Path, *, fps: float | None = None) -> FilmSet:
    """Read a film set, without pickle.

    Args:
        fps: frames per second where the file has neither ``times`` nor ``fps``; without it 30 is assumed.

    Raises:
        ValueError: not such a file, truncated, or inconsistent; the message names the file, the key and the film.

    Example:
        >>> import pathlib, tempfile
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "films.npz"
        >>> films = np.zeros((9, 24, 32), np.uint8)
        >>> np.savez(path, frames=films, offsets=[0, 4, 9], action=["run", "sit"], subject=[1, 2], fps=10.0)
        >>> found = read_film_set(path)
        >>> holds_frames(path), found.labels.tolist(), len(found.select(subject=2)[0])
        (True, ['run', 'sit'], 5)
    """
    path = Path(path).expanduser()
    data = Archive(path)
    frames = need(path, data, "frames", 3)
    if frames.dtype != np.uint8:
        raise error(path, f"frames must be uint8 grey, got {frames.dtype}", "save grey values from 0 to 255")
    offsets = clip_offsets(path, data, "frames")
    count = len(offsets) - 1
    labels, names = clip_labels(path, data, count), clip_names(path, data, count)
    rate = per_clip(path, data, "fps", count, 30.0 if fps is None else fps)
    times = frame_times(path, data, offsets, rate, names)
    meta = clip_meta(data, count, "frames")
    films = []
    for i, (start, end) in enumerate(pairwise(offsets.tolist())):
        clock = np.arange(end - start) / float(rate[i]) if times is None else times[start:end] - times[start]
        films.append(Film(frames[start:end], clock, labels[i], names[i], {key: plain(values[i]) for key, values in meta.items()}))
    return FilmSet(films, path.name)
