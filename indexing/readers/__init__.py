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
    """Read a keypoint file or folder, or find the people in a video; a single recording is a set of one clip.

    Args:
        path: a file, or a folder with one file per frame of one recording; or a video, where a pose model is there
            (:mod:`indexing.pose`).
        format: one of :data:`FORMATS`; by default the content decides.
        fps: frames per second where the file has no times of its own; without it 30 is assumed (``Clip.fps_assumed``).
        person: who is followed where a frame shows several people: ``"largest"``, ``"confident"``, ``"tracked"``, or
            ``"all"`` for one clip per tracked person (``"everyone"``: followed by position where the file has no ids); the
            rules are in :mod:`indexing.readers.recording`.
        min_confidence: joints below it become NaN; so do, in every pose file, joints with confidence 0.
        label: the action, given to every clip read.
        size: ``(width, height)`` in pixels of the image, for files with coordinates from 0 to 1 (MediaPipe, YOLO labels):
            brings them back to pixels.  Without it they stay stretched by the image's aspect ratio.
        linking: how people are followed from frame to frame where the file has no ids.
        layout: which joint is which, by the name of a layout (:data:`indexing.skeleton.LAYOUTS`, such as ``"BODY_25B"``); by
            default the file's own names, else the number of joints and what the body looks like
            (:mod:`indexing.readers.layouts`; ``Clip.meta["layout"]`` says where that was a guess).
        watching: how people are found in a video.

    Returns:
        clips with times in seconds (frame number / fps), NaN where a joint was not seen, and the detector's confidence.
        Frames that the file names without a person are NaN rows; frames it does not name are absent, with the times of
        the others unchanged.

    Raises:
        ValueError: one line with the file, the field, what is wrong and what to do.

    Example:
        >>> import json, pathlib, tempfile
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "squat.json"
        >>> person = {"category_id": 1, "keypoints": [10.0, 20.0, 0.9, 30.0, 40.0, 0.8], "score": 0.9}
        >>> _ = path.write_text(json.dumps([{"image_id": i, **person} for i in range(5)]))
        >>> read(path, fps=25.0, label="squat")[0]
        Clip('squat.json', label='squat', 5 frames x 2 joints x 2D, 0.16 s)
    """
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
    """Read one recording; the arguments are those of :func:`read`.

    Raises:
        ValueError: as :func:`read`; also where the file holds several clips.
    """
    clips = read(
        path, format=format, fps=fps, person=person, min_confidence=min_confidence, label=label, size=size, linking=linking,
        layout=layout, watching=watching,
    )  # fmt: skip
    if len(clips) != 1:
        raise error(path, f"holds {len(clips)} clips where one is expected", "use ClipSet.load, or dyntorch index evaluate")
    return clips[0]
