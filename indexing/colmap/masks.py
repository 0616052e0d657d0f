"""Masks around what moves, as COLMAP reads them: ``<image name>.png``, black where no features are to be found."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path, PurePosixPath, PureWindowsPath

import numpy as np
from numpy.typing import NDArray

from indexing.colmap.static import StaticPoints
from indexing.files import prepare, write_bytes
from indexing.opening import clip_text, error

Mask = NDArray[np.uint8]
BLACK, WHITE = 0, 255

MIN_DISC_RADIUS = 0.008  # around a moving keypoint, of the diagonal of the image
MAX_DISC_RADIUS = 0.05  # of the diagonal
DISC_RADIUS_FACTOR = 2.0  # over the distance to the third nearest moving keypoint: discs of a body close up
MASK_SIDE = 1024  # pixels of the longer side at which a mask is drawn; then it is enlarged


def mask_name(path: Path, name: str) -> PurePosixPath:
    """Where the mask of an image stands, within the folder of masks."""
    parts = PurePosixPath(name.replace("\\", "/"))
    if parts.is_absolute() or PureWindowsPath(name).drive or ".." in parts.parts or not parts.name or "\0" in name:
        said = f"the name of image {clip_text(repr(name))} leads out of the folder of images"
        raise error(path, said, "extract the features again with --image_path at their folder")
    return parts.with_name(f"{parts.name}.png")


def draw_mask(moving: NDArray[np.float64], static: NDArray[np.float64], size: tuple[int, int]) -> Mask:
    """The mask ``(height, width)`` of one image: 0 around moving keypoints, 255 elsewhere."""
    from scipy.ndimage import distance_transform_edt

    width, height = size
    if not len(moving):
        return np.full((height, width), WHITE, dtype=np.uint8)
    scale = min(1.0, MASK_SIDE / max(size))
    wide, tall = max(1, round(width * scale)), max(1, round(height * scale))
    to_mask = np.array([wide / width, tall / height])

    def distance(points: NDArray[np.float64]) -> NDArray[np.float64]:
        free = np.ones((tall, wide), dtype=bool)
        at = np.floor(points * to_mask).astype(np.int64).clip(0, [wide - 1, tall - 1])
        free[at[:, 1], at[:, 0]] = False
        return np.asarray(distance_transform_edt(free)) if len(points) else np.full(free.shape, np.inf)

    from_moving = distance(moving)
    black = (from_moving <= _radius(moving, size) * scale) & (from_moving <= distance(static))
    small = np.where(black, BLACK, WHITE).astype(np.uint8)
    rows, columns = (np.arange(full) * part // full for full, part in ((height, tall), (width, wide)))
    return np.ascontiguousarray(small[np.ix_(rows, columns)])


def _radius(moving: NDArray[np.float64], size: tuple[int, int]) -> float:
    """Of the discs, pixels."""
    from scipy.spatial import cKDTree

    diagonal = float(np.hypot(*size))
    apart = 0.0
    if len(moving) > 3:
        apart = float(np.median(cKDTree(moving).query(moving, k=4)[0][:, 3]))
    return float(np.clip(DISC_RADIUS_FACTOR * apart, MIN_DISC_RADIUS * diagonal, MAX_DISC_RADIUS * diagonal))


def write_masks(folder: str | Path, found: StaticPoints) -> Path:
    """Write the mask of every image of a database, each whole or not at all."""
    images = found.database.images
    names = [mask_name(found.database.path, image.name) for image in images]
    where = prepare(folder)
    for image, name, kind in zip(images, names, found.keypoints, strict=True):
        size = (image.camera.width, image.camera.height)
        mask = draw_mask(image.points[kind < 0], image.points[kind > 0], size)
        prepare((where / name).parent)
        write_bytes(where / name, gray_png(mask))
    return where


def gray_png(mask: Mask) -> bytes:
    """Gray values ``(height, width)`` as a PNG."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    height, width = mask.shape
    rows = np.concatenate([np.zeros((height, 1), dtype=np.uint8), mask], axis=1)  # each begins with its filter: none
    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    parts = chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(rows.tobytes(), 6)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + parts
