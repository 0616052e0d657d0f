"""Photographs behind a picture: any file that Pillow reads -> gray values."""

from __future__ import annotations

import struct
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from indexing.opening import error, size_of

PLENTY = 2**24, 10_000  # pixels from which on there must not be so many in a byte: of one colour, a photograph has a hundred
# what Pillow raises over a file that is damaged
DAMAGED = (OSError, ValueError, SyntaxError, TypeError, LookupError, ArithmeticError, MemoryError, struct.error, EOFError)
SIDE = 1600  # pixels kept along the longer side: a panel of a report shows fewer


@dataclass(frozen=True, eq=False)
class Photograph:
    """A photograph.

    Attributes:
        name: of the file.
        gray: ``(h, w)`` in [0, 1], perhaps smaller than the file's.
        size: width and height in pixels of the file, in which points are measured.
    """

    name: str
    gray: NDArray[np.float32]
    size: tuple[float, float]


def read_image(path: str | Path) -> Photograph:
    """Read a photograph, turned as its EXIF entry says (as OpenCV does).

    Raises:
        ValueError: no such file, or none that can be read.
    """
    from PIL import Image, ImageOps

    path = Path(path).expanduser()
    length = size_of(path, "give an image, such as png or jpg")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that it is large is no reason to worry: it is made smaller
            with Image.open(path) as opened:
                if opened.width * opened.height > max(PLENTY[0], PLENTY[1] * length):
                    raise ValueError(f"{opened.width} x {opened.height} pixels in {length} bytes")
                turned = ImageOps.exif_transpose(opened)
                size = (float(turned.width), float(turned.height))
                gray = _gray(turned)
    except (*DAMAGED, Image.DecompressionBombError) as problem:
        said = f"cannot be read as an image ({type(problem).__name__})"
        raise error(path, said, "save it again as png or jpg") from None
    return Photograph(path.name, gray, size)


def _gray(image: object) -> NDArray[np.float32]:
    from PIL import Image

    assert isinstance(image, Image.Image)
    if image.mode.startswith(("I", "F")):  # 16 bits and more: from the least value to the greatest
        deep = np.asarray(image, dtype=np.float32)
        low, high = float(np.nanmin(deep)), float(np.nanmax(deep))
        image = Image.fromarray(np.uint8(255 * np.nan_to_num((deep - low) / max(high - low, 1e-9))))
    image = image.convert("L")
    image.thumbnail((SIDE, SIDE))
    return np.asarray(image, dtype=np.float32) / np.float32(255)
