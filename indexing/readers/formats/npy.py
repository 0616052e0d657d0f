"""Bare arrays (``.npy``) of one recording: ``(frames, joints, 2 | 3)``, NaN = not seen.

Which joint is which, and in 3D which way is up, the body shows where it does (:mod:`indexing.joints`); ``layout=`` names
the joints otherwise.  A third number from 0 to 1 beside pixels is the confidence.  The file has neither times nor names.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from indexing.clip import SURE_PIXELS, ClipSet, FloatArray
from indexing.joints import choose_layout
from indexing.opening import error
from indexing.readers.files import Format, Options, Source
from indexing.readers.npz import read_npy
from indexing.readers.recording import Recording, to_clips
from indexing.skeleton import candidates, usual_layout

REMEDY = "save (frames, joints, 2 or 3), or a clip set: np.savez(file, joints=array, fps=...)"


def read(source: Source, options: Options) -> ClipSet:
    """Read an array of joints over time; times are frame number / fps."""
    values = read_npy(source.path)
    if values.dtype.kind not in "fiu" or values.ndim != 3 or values.shape[2] not in (2, 3) or not values.size:
        raise error(source.path, f"is an array {values.shape} of {values.dtype}, not joints over time", REMEDY)
    joints, confidence = split_confidence(source.path, values.astype(np.float64))
    return to_clips(source.path, recording_of(joints, confidence), options)


def recording_of(joints: FloatArray, confidence: FloatArray | None = None) -> Recording:
    """A recording of one body of unknown layout, and the direction that is up in it where the body shows that."""
    usual, flat = usual_layout(joints.shape[1]), joints.shape[2] == 2
    could = candidates(joints.shape[1])
    layout, message, up = choose_layout(joints, usual, could, "-y" if flat else None)
    if layout is not None and not message:  # the file says nothing of it
        message = {"layout": f"recognized: {layout.name}"}
    frames = np.arange(len(joints))
    return Recording(frames, frames, joints, confidence, skeleton=layout, up=up or ("-y" if flat else "y"), meta=message)


def split_confidence(path: Path, values: FloatArray) -> tuple[FloatArray, FloatArray | None]:
    """Joints, and their confidence where that is what the third number is."""
    if values.shape[2] == 2:
        return values, None
    third, rest = values[..., 2], values[..., :2]
    finite, flat = third[np.isfinite(third)], rest[np.isfinite(rest)]
    if not (finite.size and flat.size) or finite.min() < 0 or finite.max() > 1:
        return values, None
    if float(flat.max()) - float(flat.min()) > SURE_PIXELS:
        return rest, np.where(np.isfinite(third), third, 0.0)
    if flat.min() >= 0 and flat.max() <= 1:
        message = "x, y and the third number are all from 0 to 1: it may be depth or confidence"
        raise error(path, message, "save array[..., :2], or a clip set with confidence")
    return values, None


FORMAT = Format((), ("npy",), read)
