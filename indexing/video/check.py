"""A video to check a synchronization by: both recordings side by side, each frame of a beside the frame of b of the same moment."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from indexing.clip import Clip
from indexing.files import write_bytes
from indexing.skeleton import usual_layout
from indexing.video.overlay import encode
from indexing.video.reading import cv2, read_video

Image = NDArray[np.uint8]

STRIP = 32  # pixels above the pictures, for the times
PAPER, INK, BONE, JOINT = (255, 255, 255), (27, 33, 38), (42, 118, 170), (184, 67, 60)  # as in the reports' pictures
SMOOTHEST = 30.0  # frames per second of the check video at most


class Clocks(Protocol):
    """What is needed of a shift; ``dyntorch.Shift`` has it."""

    def at(self, times: Any) -> Any:
        """b's times of a's."""

    def inverse(self, times: Any) -> Any:
        """a's times of b's."""


Recording = str | Path | Clip


def write_check_video(
    path: str | Path,
    a: Recording,
    b: Recording,
    shift: Clocks,
    *,
    names: tuple[str, str] = ("a", "b"),
    height: int = 480,
    fps: float | None = None,
    span: tuple[float, float] | None = None,
) -> Path:
    """Write both recordings side by side, b's frame being the one nearest to ``shift.at(t)`` of a's frame at ``t``.

    Above each picture stands the time of the frame shown, on its own clock.  H.264 where FFmpeg has it (else MPEG-4) in yuv420p and
    even sizes: plays everywhere.  Written whole or not at all.

    Args:
        path: of the file, ``.mp4``.
        a: a video, or a :class:`Clip` of 2D keypoints, drawn as a stick figure on plain ground.
        b: likewise.
        shift: of :func:`dyntorch.synchronize`.
        names: what to call the two.
        height: pixels of the pictures.
        fps: frames per second; default: those of a, at most 30.
        span: first and last second of a's clock; default: all that both recorded.

    Returns:
        the path.

    Raises:
        ValueError: the two have no moment in common at this shift, a video cannot be read, or the file cannot be written.
    """
    if height < 64:
        raise ValueError(f"write_check_video: height must be at least 64 pixels, got {height!r}")
    left, right = _panel(a, height - height % 2), _panel(b, height - height % 2)
    start = max(left.first, float(shift.inverse(right.first)), -math.inf if span is None else span[0])
    stop = min(left.last, float(shift.inverse(right.last)), math.inf if span is None else span[1])
    if start > stop:
        raise ValueError(
            f"write_check_video: no moment in common: a runs from {left.first:.2f} to {left.last:.2f} s, b on a's clock from "
            f"{float(shift.inverse(right.first)):.2f} to {float(shift.inverse(right.last)):.2f} s; check the shift and span"
        )
    rate = min(left.fps, SMOOTHEST) if fps is None else fps
    moments = start + np.arange(1 + math.floor((stop - start) * rate + 1e-6)) / rate
    pictures = zip(left.shown(moments), right.shown(np.asarray(shift.at(moments), np.float64)), strict=True)
    frames = (_compose(*pair, names) for pair in pictures)
    return write_bytes(path, encode(frames, rate))


class _Film:
    """A video as a panel."""

    def __init__(self, path: str | Path, height: int):
        self.video = read_video(path)
        info = self.video.info
        self.size = (_even(info.width * height / info.height), height)
        self.fps, self.first, self.last = info.fps, 0.0, info.duration

    def shown(self, moments: NDArray[np.float64]) -> Iterator[tuple[Image, float]]:
        """Of each moment (in order), the nearest frame and its time; holds a few frames at a time."""
        start = max(0.0, float(moments[0]) - 1.0)
        video = read_video(self.video.path, gray=False, size=self.size, start=start, chunk=8)
        source = ((image, float(time)) for chunk in video for image, time in zip(*chunk, strict=True))
        here = next(source)
        ahead = next(source, None)
        for moment in moments.tolist():
            while ahead is not None and abs(ahead[1] - moment) <= abs(here[1] - moment):
                here, ahead = ahead, next(source, None)
            yield here


class _Figure:
    """Keypoints as a panel: a stick figure on plain ground."""

    def __init__(self, clip: Clip, height: int):
        if clip.dims != 2:
            raise ValueError(f"write_check_video: clip {clip.name!r} is 3D; give 2D keypoints, or the video")
        points = clip.joints * [1.0, -1.0 if clip.up == "y" else 1.0]
        if np.isnan(points).all():
            raise ValueError(f"write_check_video: clip {clip.name!r} has no joint in any frame; nothing can be drawn")
        low, high = np.nanpercentile(points.reshape(-1, 2), [1, 99], axis=0)
        box = np.maximum(high - low, 1e-9)
        scale = 0.8 * height / max(box[1], box[0] / 2, 1e-9)
        self.size = (_even(min(2 * height, max(0.6 * height, 1.25 * scale * box[0]))), height)
        self.points = (points - (low + high) / 2) * scale + np.array(self.size) / 2
        self.times, self.fps = clip.times, float(clip.fps or SMOOTHEST)
        self.first, self.last = float(clip.times[0]), float(clip.times[-1])
        skeleton = clip.skeleton or usual_layout(clip.joints.shape[1])
        self.bones = skeleton.bones if skeleton else ()

    def shown(self, moments: NDArray[np.float64]) -> Iterator[tuple[Image, float]]:
        """Of each moment, the nearest frame drawn, and its time."""
        for moment in moments.tolist():
            i = int(np.argmin(np.abs(self.times - moment)))
            yield self._draw(self.points[i]), float(self.times[i])

    def _draw(self, joints: NDArray[np.floating[Any]]) -> Image:
        width, height = self.size
        image = np.full((height, width, 3), PAPER, np.uint8)
        seen = np.isfinite(joints).all(1)
        # OpenCV's coordinates are 16 bit in places; far outside of the picture nothing is to be seen
        spots = [(round(x), round(y)) for x, y in np.nan_to_num(joints).clip(-2 * height, 4 * height).tolist()]
        for i, j in self.bones:
            if seen[i] and seen[j]:
                cv2().line(image, spots[i], spots[j], BONE, max(2, height // 160), cv2().LINE_AA)
        for i in np.flatnonzero(seen).tolist():
            cv2().circle(image, spots[i], max(3, height // 120), JOINT, -1, cv2().LINE_AA)
        return image


def _panel(recording: Recording, height: int) -> _Film | _Figure:
    return _Figure(recording, height) if isinstance(recording, Clip) else _Film(recording, height)


def _compose(left: tuple[Image, float], right: tuple[Image, float], names: tuple[str, str]) -> Image:
    """Both pictures with their times above."""
    panels = []
    for (image, time), name in zip((left, right), names, strict=True):
        strip = np.full((STRIP, image.shape[1], 3), PAPER, np.uint8)
        # OpenCV's letters are ASCII, and the time must fit beside the name
        text = f"{name.encode('ascii', 'replace').decode()[: max(1, image.shape[1] // 12 - 11)]}  {time:.3f} s"
        cv2().putText(strip, text, (8, STRIP - 10), cv2().FONT_HERSHEY_SIMPLEX, 0.55, INK, 1, cv2().LINE_AA)
        panels.append(np.concatenate([strip, image]))
    gap = np.full((panels[0].shape[0], 4, 3), INK, np.uint8)
    return np.concatenate([panels[0], gap, panels[1]], axis=1)


def _even(pixels: float) -> int:
    return max(2, 2 * round(pixels / 2))
