"""Keypoint files of any common pose estimator -> clips.  A format is a file in ``formats/``, and registers itself there."""

from __future__ import annotations

from collections.abc import Hashable
from pathlib import Path
from typing import Any

import numpy as np

from indexing.clip import Clip, ClipSet
from indexing.opening import error, quote, without_garbage_collection
from indexing.readers.files import Options, Source, WatchOptions, detect, open_source, registered_formats
from indexing.readers.recording import NobodySeen, merge_people, to_clips
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
        raise ValueError(f"{path}: unknown format={quote(format)}; use one of {', '.join(FORMATS)}, or leave it out to detect it")
    with without_garbage_collection():
        source = open_source(path)
        name = format or detect(source)
        if name == "video":
            return read_video(source, options)
        source.require_kind(name, *registered_formats()[name].kinds)
        return registered_formats()[name].read(source, options)


def read_clip(path: str | Path, **options: Any) -> Clip:
    """Read one recording; the arguments are those of :func:`read`."""
    clips = read(path, **options)
    if len(clips) != 1:
        raise error(path, f"holds {len(clips)} clips where one is expected", "use ClipSet.load, or dyntorch index evaluate")
    return clips[0]


# ----------------------------------------------------------------------------------------------------------------------
# Videos: the people in them are found by a pose model (:mod:`indexing.pose`), where one is there.


def read_video(source: Source, options: Options) -> ClipSet:
    """Find the people in a video; ``person`` says who of them is meant, as for files of keypoints."""
    from indexing.pose import available, detect
    from indexing.pose.models import FETCH

    if options.size is not None:
        raise error(source.path, "size= does not apply to a video", "leave size out")
    if available() is None:
        raise error(source.path, "is a video, and there is no pose model to find the people in it", f"{FETCH}, or give keypoints")
    how = options.watching or WatchOptions()
    recording = merge_people(detect(source.path, how.people, model=how.model, every=how.every, fps=options.fps).clips)
    if recording is None:
        raise NobodySeen(source.path, np.zeros(0, dtype=np.int64))
    return to_clips(source.path, recording, options)
