"""Where labels are written, and what is known of their recording."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Target:
    """A file to write labels into; the arguments are those of :func:`indexing.labels.write_labels`.

    Args:
        media: the recordings that are written, also those without labels.
        into: a file whose content is taken over; None where there is none.
        name: how that file calls the recording, where somebody says so.
    """

    path: Path
    media: tuple[str, ...] = ()
    into: Path | None = None
    tier: str = "dyntorch"
    duration: float | None = None
    fps: float | None = None
    annotator: str = ""
    name: str | None = None
