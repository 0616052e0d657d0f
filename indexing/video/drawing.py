"""Videos of our own: tracks drawn over a video, two recordings side by side, and how they are encoded."""

from __future__ import annotations

import io
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from indexing.clip import Clip
from indexing.files import write_bytes
from indexing.skeleton import usual_layout
from indexing.video.motion import Floats
from indexing.video.reading import Source, av, cv2, read_video
from indexing.video.sequence import chunks, select_frames

Image = NDArray[np.uint8]
Colour = tuple[int, int, int]

WIDEST = 960  # pixels of the longer side
LARGER = 2.0  # times that small videos are enlarged at most
TAIL = 12  # frames that a track's tail is long
SLOWEST, FASTEST = 8.0, 30.0  # frames per second
CALM = (0.55, 26.0)  # factor and offset of the grey values: colours must stand out from black and from white
LIGHTER = 0.22  # white that is mixed into the colours, which are made for white paper
STRAY: Colour = (206, 210, 214)  # of points of no group
STRIP = 28  # pixels below the picture, for the legend
PAPER, INK, MUTED = (24, 28, 31), (232, 236, 239), (163, 173, 182)
SUBPIXEL = 4  # bits: OpenCV draws at sixteenths of a pixel


@dataclass(frozen=True, eq=False)
class Overlay:
    """What is drawn over a video."""

    points: Floats  # ``(views, n, 2)`` pixels of the video as shown, NaN = not seen
    frames: Sequence[int]  # ``views`` numbers of the frames, which increase
    size: tuple[float, float]  # width and height of the video as shown, pixels
    groups: NDArray[np.int64]  # ``(n,)`` of each track: 0 = none of them, or 1.. into ``names``
    names: Sequence[str]  # of the groups, for the legend
    colours: Sequence[Colour]  # of the groups, RGB
    captions: Sequence[str]  # ``views`` texts, one for each frame


def write_overlay(source: Source | Sequence[str | Path], overlay: Overlay, fps: float = 25.0) -> bytes:
    """The frames in calm grey with the tracks over them, dots with short tails, as an MP4 of at most 960 pixels."""
    return encode(_draw_frames(source, overlay), float(np.clip(fps, SLOWEST, FASTEST)))


def _draw_frames(source: Source | Sequence[str | Path], overlay: Overlay) -> Iterator[Image]:
    """One picture for each of the frames."""
    order = [
        (0, STRAY),
        *enumerate(map(_brighten, overlay.colours), start=1),
    ]  # the small ones on top: dense bodies would hide them otherwise
    view = 0
    for image in select_frames(chunks(source, size=WIDEST), overlay.frames):
        image = _fit_size(image)
        height, width = image.shape
        scale = np.array([width / overlay.size[0], height / overlay.size[1]])
        calm = (CALM[0] * image.astype(np.float32) + CALM[1]).astype(np.uint8)
        canvas = np.ascontiguousarray(np.repeat(calm[: height // 2 * 2, : width // 2 * 2, None], 3, axis=2))
        part = (overlay.points[max(0, view - TAIL) : view + 1] + 0.5) * scale - 0.5
        for group, colour in order:
            _draw(canvas, part[:, overlay.groups == group], colour, group > 0, max(1.0, width / 480))
        yield np.concatenate([canvas, _legend(canvas.shape[1], overlay, overlay.captions[view])])
        view += 1
    if view < len(overlay.frames):
        missing = overlay.frames[view]
        raise ValueError(f"the video has no frame {missing}, in which points are to be drawn; give the one they were found in")


def _fit_size(image: Image) -> Image:
    """A large picture made smaller, a small one larger, up to twice: dots of a few pixels are no dots."""
    by = min(LARGER, WIDEST / max(image.shape))
    if by == 1:
        return image
    size = (round(by * image.shape[1]), round(by * image.shape[0]))
    return np.asarray(cv2().resize(image, size, interpolation=cv2().INTER_CUBIC if by > 1 else cv2().INTER_AREA), np.uint8)


def _draw(canvas: Image, paths: Floats, colour: Colour, tails: bool, size: float) -> None:
    """Paths ``(views, n, 2)`` that end in the picture now: a dot, and where they came from."""
    now = np.isfinite(paths[-1, :, 0])
    paths = paths[:, now]
    if tails and len(paths) > 1:
        ways = [path[np.isfinite(path[:, 0])] for path in paths.transpose(1, 0, 2)]
        lines = [_to_fixed_point(way) for way in ways if len(way) > 1]
        cv2().polylines(canvas, lines, False, colour, max(1, round(0.8 * size)), cv2().LINE_AA, SUBPIXEL)
    radius = round((1.5 if tails else 0.8) * size * (1 << SUBPIXEL))
    for x, y in _to_fixed_point(paths[-1]).tolist():
        if tails:
            cv2().circle(canvas, (x, y), radius + (1 << SUBPIXEL) * 2 // 3, PAPER, -1, cv2().LINE_AA, SUBPIXEL)
        cv2().circle(canvas, (x, y), radius, colour, -1, cv2().LINE_AA, SUBPIXEL)


def _brighten(colour: Colour) -> Colour:
    """A colour of a page on a dark ground."""
    red, green, blue = (round(part + LIGHTER * (255 - part)) for part in colour)
    return red, green, blue


def _to_fixed_point(points: Floats) -> NDArray[np.int32]:
    """Pixels in OpenCV's fixed point; far outside of the picture nothing is to be seen."""
    return np.rint(np.clip(points, -4096, 4096) * (1 << SUBPIXEL)).astype(np.int32)


def _legend(width: int, overlay: Overlay, caption: str) -> Image:
    """The strip below the picture: which colour is what, as far as there is room, and which frame this is."""
    strip = np.full((STRIP, width, 3), PAPER, np.uint8)
    font, scale = cv2().FONT_HERSHEY_SIMPLEX, 0.42
    caption = caption.encode("ascii", "replace").decode()
    wide = cv2().getTextSize(caption, font, scale, 1)[0][0]
    x, end = 10, width - wide - 10
    cv2().putText(strip, caption, (max(2, end), STRIP - 10), font, scale, MUTED, 1, cv2().LINE_AA)
    strays = [("no body", STRAY)] if (overlay.groups == 0).any() else []
    for name, colour in [*zip(overlay.names, map(_brighten, overlay.colours), strict=True), *strays]:
        text = name.encode("ascii", "replace").decode()
        room = cv2().getTextSize(text, font, scale, 1)[0][0]
        if x + room + 30 > end:
            break
        cv2().circle(strip, (x + 4, STRIP // 2), 4, colour, -1, cv2().LINE_AA)
        cv2().putText(strip, text, (x + 13, STRIP - 10), font, scale, INK, 1, cv2().LINE_AA)
        x += room + 30
    return strip


def encode(frames: Iterable[Image], fps: float) -> bytes:
    """An MP4 file of RGB frames of even size: H.264 where FFmpeg has it, else MPEG-4, in yuv420p, which plays everywhere."""
    data = io.BytesIO()
    with av().open(data, "w", format="mp4") as container:
        stream = add_video_stream(container, Fraction(fps).limit_denominator(1001), "23", "4")
        for i, frame in enumerate(frames):
            if i == 0:
                stream.height, stream.width = frame.shape[:2]
            container.mux(stream.encode(av().VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")))
        container.mux(stream.encode())
    return data.getvalue()


def add_video_stream(container: Any, fps: Fraction, crf: str, qscale: str) -> Any:
    """A stream in yuv420p, which plays everywhere: H.264 of quality ``crf`` where FFmpeg has it, else MPEG-4 of ``qscale``."""
    codec, options = "mpeg4", {"qscale": qscale}
    if "libx264" in av().codecs_available:
        codec, options = "libx264", {"crf": crf, "preset": "veryfast"}
    stream = container.add_stream(codec, rate=fps, options=options)
    stream.pix_fmt = "yuv420p"
    return stream


# ----------------------------------------------------------------------------------------------------------------------
# Two recordings side by side, to check a synchronization by.


TIME_STRIP = 32  # pixels above the pictures, for the times
WHITE, BLACK, BONE, JOINT = (255, 255, 255), (27, 33, 38), (42, 118, 170), (184, 67, 60)  # as in the reports' pictures
CHECK_HEIGHT = 480  # pixels of its pictures


class ClockRelation(Protocol):
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
    shift: ClockRelation,
    *,
    names: tuple[str, str] = ("a", "b"),
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

    Returns:
        the path.

    Raises:
        ValueError: the two have no moment in common at this shift, a video cannot be read, or the file cannot be written.
    """
    left, right = (_Figure(each, CHECK_HEIGHT) if isinstance(each, Clip) else _Film(each, CHECK_HEIGHT) for each in (a, b))
    start, stop = max(left.first, float(shift.inverse(right.first))), min(left.last, float(shift.inverse(right.last)))
    if start > stop:
        raise ValueError(
            f"write_check_video: no moment in common: a runs from {left.first:.2f} to {left.last:.2f} s, b on a's clock from "
            f"{float(shift.inverse(right.first)):.2f} to {float(shift.inverse(right.last)):.2f} s; check the shift"
        )
    rate = min(left.fps, FASTEST)
    moments = start + np.arange(1 + math.floor((stop - start) * rate + 1e-6)) / rate
    pictures = zip(left.nearest_frames(moments), right.nearest_frames(np.asarray(shift.at(moments), np.float64)), strict=True)
    frames = (_compose(*pair, names) for pair in pictures)
    return write_bytes(path, encode(frames, rate))


class _Film:
    """A video as a panel."""

    def __init__(self, path: str | Path, height: int):
        self.video = read_video(path)
        info = self.video.info
        self.size = (_even(info.width * height / info.height), height)
        self.fps, self.first, self.last = info.fps, 0.0, info.duration

    def nearest_frames(self, moments: NDArray[np.float64]) -> Iterator[tuple[Image, float]]:
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
        self.times, self.fps = clip.times, float(clip.fps or FASTEST)
        self.first, self.last = float(clip.times[0]), float(clip.times[-1])
        skeleton = clip.skeleton or usual_layout(clip.joints.shape[1])
        self.bones = skeleton.bones if skeleton else ()

    def nearest_frames(self, moments: NDArray[np.float64]) -> Iterator[tuple[Image, float]]:
        """Of each moment, the nearest frame drawn, and its time."""
        for moment in moments.tolist():
            i = int(np.argmin(np.abs(self.times - moment)))
            yield self._draw(self.points[i]), float(self.times[i])

    def _draw(self, joints: NDArray[np.floating[Any]]) -> Image:
        width, height = self.size
        image = np.full((height, width, 3), WHITE, np.uint8)
        seen = np.isfinite(joints).all(1)
        # OpenCV's coordinates are 16 bit in places; far outside of the picture nothing is to be seen
        spots = [(round(x), round(y)) for x, y in np.nan_to_num(joints).clip(-2 * height, 4 * height).tolist()]
        for i, j in self.bones:
            if seen[i] and seen[j]:
                cv2().line(image, spots[i], spots[j], BONE, max(2, height // 160), cv2().LINE_AA)
        for i in np.flatnonzero(seen).tolist():
            cv2().circle(image, spots[i], max(3, height // 120), JOINT, -1, cv2().LINE_AA)
        return image


def _compose(left: tuple[Image, float], right: tuple[Image, float], names: tuple[str, str]) -> Image:
    """Both pictures with their times above."""
    panels = []
    for (image, time), name in zip((left, right), names, strict=True):
        strip = np.full((TIME_STRIP, image.shape[1], 3), WHITE, np.uint8)
        # OpenCV's letters are ASCII, and the time must fit beside the name
        text = f"{name.encode('ascii', 'replace').decode()[: max(1, image.shape[1] // 12 - 11)]}  {time:.3f} s"
        cv2().putText(strip, text, (8, TIME_STRIP - 10), cv2().FONT_HERSHEY_SIMPLEX, 0.55, BLACK, 1, cv2().LINE_AA)
        panels.append(np.concatenate([strip, image]))
    gap = np.full((panels[0].shape[0], 4, 3), BLACK, np.uint8)
    return np.concatenate([panels[0], gap, panels[1]], axis=1)


def _even(pixels: float) -> int:
    return max(2, 2 * round(pixels / 2))
