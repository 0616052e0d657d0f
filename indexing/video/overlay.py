"""A video with tracks drawn over it, each in the colour of its group, and how videos of our own are encoded."""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from indexing.video.motion import Floats
from indexing.video.reading import Source, av, cv2
from indexing.video.sequence import chunks

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
    for image in _read_frames(source, overlay.frames):
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


def _read_frames(source: Source | Sequence[str | Path], frames: Sequence[int]) -> Iterator[Image]:
    left, index = set(frames), 0
    for chunk in chunks(source, size=WIDEST):
        for image in chunk.frames:
            if index in left:
                yield image
            index += 1
        if index > frames[-1]:
            return


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
    codec, options = (
        ("libx264", {"crf": "23", "preset": "veryfast"}) if "libx264" in av().codecs_available else ("mpeg4", {"qscale": "4"})
    )
    data = io.BytesIO()
    with av().open(data, "w", format="mp4") as container:
        stream: Any = container.add_stream(codec, rate=Fraction(fps).limit_denominator(1001), options=options)
        stream.pix_fmt = "yuv420p"
        for i, frame in enumerate(frames):
            if i == 0:
                stream.height, stream.width = frame.shape[:2]
            container.mux(stream.encode(av().VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")))
        container.mux(stream.encode())
    return data.getvalue()
