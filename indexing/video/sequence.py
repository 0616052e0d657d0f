"""Pictures in a folder as a video, one file a frame, in the order of the numbers in their names; and the chunks of any source."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from indexing.opening import entries, error
from indexing.readers.matches import read_image
from indexing.video.reading import UNTIMED_FPS, Chunk, Source, cv2, read_video

PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
WILD = ("*", "?", "[")
SEQUENCE_CHUNK = 16  # pictures at once


def in_order(paths: Iterable[Path]) -> list[Path]:
    """Files by their names, numbers in these by their value."""

    def key(path: Path) -> list[tuple[int, int, str]]:
        parts = re.split(r"(\d+)", path.name.lower())
        return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in parts if part]

    return sorted(paths, key=key)


def is_picture(path: Path) -> bool:
    """Whether a file's name says that it is a picture."""
    return path.suffix.lower() in PICTURES


def is_pattern(path: str | Path) -> bool:
    """Whether a path stands for several, as ``frames/*.png`` does."""
    return any(sign in str(path) for sign in WILD) and not Path(path).exists()


def pictures_of(source: str | Path | Sequence[str | Path]) -> list[Path]:
    """The pictures of a folder, of a pattern such as ``frames/*.png``, or of a list, in order."""
    if not isinstance(source, (str, Path)):
        return [Path(path).expanduser() for path in source]
    path = Path(source).expanduser()
    if path.is_dir():
        found = [entry for entry in entries(path) if is_picture(entry)]
        what = "holds no pictures"
    else:
        root = Path(path.anchor) if path.is_absolute() else Path()
        pattern = str(path.relative_to(root)) if path.is_absolute() else str(path)
        found = [entry for entry in root.glob(pattern) if is_picture(entry) and not entry.name.startswith(".")]
        what = "no picture has such a name"
    if not found:
        raise error(
            path, what, f"give a folder or a pattern of {', '.join(ending[1:] for ending in PICTURES[:3])} files, or a video"
        )
    return in_order(found)


class PictureSequence:
    """Pictures as an iterable of chunks, as :class:`indexing.video.Video` is one; every ``for`` reads them from the beginning.

    Attributes:
        paths: of the pictures, in order.
        fps: how many a second has; None = nobody says.
        scale: pixels of these frames per pixel of the files, ``(x, y)``; known when reading has begun.
        notes: what was made up.
    """

    def __init__(self, source: str | Path | Sequence[str | Path], size: int | None = None, fps: float | None = None):
        self.paths = pictures_of(source)
        self.size, self.fps = size, fps
        self.scale = (1.0, 1.0)
        self.shown = (0, 0)
        self.notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.paths)

    def __iter__(self) -> Iterator[Chunk]:
        rate = self.fps or UNTIMED_FPS
        for first in range(0, len(self.paths), SEQUENCE_CHUNK):
            frames = [self._frame(path) for path in self.paths[first : first + SEQUENCE_CHUNK]]
            yield Chunk(np.stack(frames), np.arange(first, first + len(frames)) / rate)

    def _frame(self, path: Path) -> NDArray[np.uint8]:
        photograph = read_image(path)
        size = (round(photograph.size[0]), round(photograph.size[1]))
        if path == self.paths[0]:
            by = 1.0 if self.size is None else min(1.0, self.size / max(size))
            self.shown = size
            self.target = (max(1, round(by * size[0])), max(1, round(by * size[1])))
            self.scale = (self.target[0] / size[0], self.target[1] / size[1])
        if size != self.shown:
            said = f"has {size[0]} x {size[1]} pixels, {self.paths[0].name} {self.shown[0]} x {self.shown[1]}"
            raise error(path, said, "pictures of one sequence have one size; leave the others out")
        gray = photograph.gray
        if gray.shape[::-1] != self.target:
            gray = cv2().resize(gray, self.target, interpolation=cv2().INTER_AREA)
        return np.asarray(np.rint(255 * gray), np.uint8)


def chunks(source: Source | Sequence[str | Path], size: int | None = None, fps: float | None = None) -> Iterable[Chunk]:
    """The chunks of a video file, of a folder, a pattern or a list of pictures, or of what gives chunks by itself."""
    if isinstance(source, (str, Path)):
        path = Path(source).expanduser()
        if path.is_dir() or is_pattern(path) or is_picture(path):
            return PictureSequence(source if not is_picture(path) or is_pattern(path) else [path], size, fps)
        return read_video(path, size=size, fps=fps)
    if isinstance(source, Sequence) and source and all(isinstance(item, (str, Path)) for item in source):
        named: Any = source
        return PictureSequence(named, size, fps)
    given: Iterable[Chunk] = source  # type: ignore[assignment]
    return given


def select_frames(stream: Iterable[Chunk], numbers: Sequence[int]) -> Iterator[NDArray[np.uint8]]:
    """The frames of these numbers, which increase, one by one."""
    wanted, index = set(numbers), 0
    for chunk in stream:
        for image in chunk.frames:
            if index in wanted:
                yield image
            index += 1
        if index > numbers[-1]:
            return
