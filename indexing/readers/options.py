"""What a caller may ask of a reader, checked once."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from typing import Any

import numpy as np

from indexing.clip import check_fps

PEOPLE = ("largest", "confident", "tracked", "all", "everyone")


@dataclass(frozen=True)
class Options:
    """The arguments of :func:`indexing.readers.read` that the format modules share.

    Raises:
        ValueError: a value that no file could satisfy.
    """

    fps: float | None = None
    person: str = "largest"
    min_confidence: float = 0.0
    label: Hashable | None = None
    size: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if self.fps is not None:
            check_fps(self.fps)
        if self.person not in PEOPLE:
            raise ValueError(f"unknown person={self.person!r}; use one of {', '.join(PEOPLE)}")
        if not _is_number(self.min_confidence):
            raise ValueError(f"min_confidence must be a number (0 keeps every joint), got {self.min_confidence!r}")
        if self.size is not None:
            size = np.asarray(self.size, dtype=float)
            if size.shape != (2,) or not (np.isfinite(size).all() and (size > 0).all()):
                raise ValueError(f"size must be (width, height) of the image in pixels, got {self.size!r}")


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool) and bool(np.isfinite(value))
