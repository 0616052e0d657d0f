"""Keypoint files of any common pose estimator -> clips.  A format is a file in ``formats/``, and registers itself there."""

from __future__ import annotations

from collections.abc import Hashable
from pathlib import Path

from indexing.clip import Clip, ClipSet
from indexing.opening import error, shown, without_garbage_collection
from indexing.readers.detect import detect, registered_formats
from indexing.readers.files import Options, WatchOptions, open_source
from indexing.readers.video import read_video
from indexing.registry import format_names

FORMATS = format_names("readers")


def read(
    path: str | Path,
    *,
    format: str | None = None,  # noqa: A002  (the word users type)
    fps: float | None = None,
    person: str = "largest",
    min_confidence: float = 0.0,
    label: Hashable | None = None,
    size: tuple[float, float] | None = None,
    layout: str | None = None,
    watching: WatchOptions | None = None,
) -> ClipSet:
    """Read a keypoint file or folder, or find the people in a video; a single recording is a set of one clip. size
    ``(width, height)``."""
    options = Options(
        fps=fps, person=person, min_confidence=min_confidence, label=label, size=size, layout=layout,
        watching=watching,
    )  # fmt: skip
    if format is not None and format not in FORMATS:
        raise ValueError(f"{path}: unknown format={shown(format)}; use one of {', '.join(FORMATS)}, or leave it out to detect it")
    with without_garbage_collection():
        source = open_source(path)
        name = format or detect(source)
        if name == "video":
            return read_video(source, options)
        source.need(name, *registered_formats()[name].kinds)
        return registered_formats()[name].read(source, options)


def read_clip(
    path: str | Path,
    *,
    format: str | None = None,  # noqa: A002
    fps: float | None = None,
    person: str = "largest",
    min_confidence: float = 0.0,
    label: Hashable | None = None,
    size: tuple[float, float] | None = None,
    layout: str | None = None,
    watching: WatchOptions | None = None,
) -> Clip:
    """Read one recording; the arguments are those of :func:`read`."""
    clips = read(
        path, format=format, fps=fps, person=person, min_confidence=min_confidence, label=label, size=size,
        layout=layout, watching=watching,
    )  # fmt: skip
    if len(clips) != 1:
        raise error(path, f"holds {len(clips)} clips where one is expected", "use ClipSet.load, or dyntorch index evaluate")
    return clips[0]
