"""Where labels are written, and what is known of their recording."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

from indexing.opening import error


@dataclass(frozen=True)
class Target:
    """A file to write labels into; the arguments are those of :func:`indexing.labels.write_labels`."""

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
    """A mark of what was written into a tier or an observation: it stands beside it, and tells whether somebody changed it
    since."""
    text = "\x1f".join(" ".join(str(part).split()) for part in parts)
    return hashlib.sha256(text.encode("utf-8", "backslashreplace")).hexdigest()[:8]


def changed(target: Target, what: str) -> ValueError:
    """What was found is corrected where it stands: nobody loses that without a word."""
    said = f"{what} is not as dyntorch wrote it: somebody has corrected it"
    return error(target.into or target.path, said, "rename it to take it over, delete it, or write to another file")
