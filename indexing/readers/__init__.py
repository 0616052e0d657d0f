"""Keypoint files of any common pose estimator -> clips: one file per format, chosen here by name.

Adding a format is one new module with ``read(source, options) -> ClipSet``, its name below, and a line in ``detect.py``.
"""

from __future__ import annotations

from collections.abc import Hashable
from importlib import import_module
from pathlib import Path

from indexing.clip import Clip, ClipSet
from indexing.opening import error, shown, uncollected
from indexing.readers.detect import detect
from indexing.readers.files import LinkOptions, Options, WatchOptions, open_source

FORMATS = (
    *("clipset", "openpose", "coco", "mediapipe", "deeplabcut", "mmpose", "ultralytics", "sleap"),
    *("trc", "mocap", "freemocap", "npy", "pyskl", "movement"),
)


def read(
    path: str | Path,
    *,
    format: str | None = None,  # noqa: A002  (the word users type)
    fps: float | None = None,
    person: str = "largest",
    min_confidence: float = 0.0,
    label: Hashable | None = None,
    size: tuple[float, float] | None = None,
    linking: LinkOptions = LinkOptions(),
    layout: str | None = None,
    watching: WatchOptions = WatchOptions(),
) -> ClipSet:
    """Read a keypoint file or folder, or find the people in a video; a single recording is a set of one clip. size
    ``(width, height)``."""
    options = Options(
        fps=fps, person=person, min_confidence=min_confidence, label=label, size=size, linking=linking, layout=layout,
        watching=watching,
    )  # fmt: skip
    if format is not None and format not in FORMATS:
        raise ValueError(f"{path}: unknown format={shown(format)}; use one of {', '.join(FORMATS)}, or leave it out to detect it")
    with uncollected():
        source = open_source(path)
        module = import_module(f"{__name__}.{format or detect(source)}")
        clips: ClipSet = module.read(source, options)
    return clips


def read_clip(
    path: str | Path,
    *,
    format: str | None = None,  # noqa: A002
    fps: float | None = None,
    person: str = "largest",
    min_confidence: float = 0.0,
    label: Hashable | None = None,
    size: tuple[float, float] | None = None,
    linking: LinkOptions = LinkOptions(),
    layout: str | None = None,
    watching: WatchOptions = WatchOptions(),
) -> Clip:
    """Read one recording; the arguments are those of :func:`read`."""
    clips = read(
        path, format=format, fps=fps, person=person, min_confidence=min_confidence, label=label, size=size, linking=linking,
        layout=layout, watching=watching,
    )  # fmt: skip
    if len(clips) != 1:
        raise error(path, f"holds {len(clips)} clips where one is expected", "use ClipSet.load, or dyntorch index evaluate")
    return clips[0]
