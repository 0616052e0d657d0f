"""Where labels are written, and what is known of their recording."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

from indexing.opening import error


@dataclass(frozen=True)
class Target:
    """A file to write labels into; the arguments are those of :func:`indexing.labels.write_labels`.

    Args:
        media: the recordings that are written, also those without labels.
        into: a file whose content is taken over; None where there is none.
        name: how that file calls the recording, where somebody says so.
        dry: whether nothing is written, and only said what would be refused.
    """

    path: Path
    media: tuple[str, ...] = ()
    into: Path | None = None
    tier: str = "dyntorch"
    duration: float | None = None
    fps: float | None = None
    annotator: str = ""
    name: str | None = None
    dry: bool = False


def seal(*parts: object) -> str:
    """A mark of what was written into a tier or an observation: it stands beside it, and tells whether somebody changed it since.

    Spaces count as one, so that what an annotation program saves again is the same.

    Example:
        >>> seal(1000, "a  squat"), seal(1000, "a squat"), seal(1001, "a squat")
        ('5d30b6f2', '5d30b6f2', '34602cf8')
    """
    text = "\x1f".join(" ".join(str(part).split()) for part in parts)
    return hashlib.sha256(text.encode("utf-8", "backslashreplace")).hexdigest()[:8]


def changed(target: Target, what: str) -> ValueError:
    """What was found is corrected where it stands: nobody loses that without a word."""
    said = f"{what} is not as dyntorch wrote it: somebody has corrected it"
    return error(target.into or target.path, said, "rename it to take it over, delete it, or write to another file")
