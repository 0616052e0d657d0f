"""Poses as the toolbox ``movement`` saves them in netCDF 4, which is HDF5: ``position`` (time, space, keypoints, individuals).

``confidence`` has the same axes less ``space``; times are the coordinate ``time``, in seconds or frames (``time_unit``, ``fps``).
Individuals are tracks.  Axes may come in any order: each has a name.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from indexing.clip import COARSEST, FINEST, UP_AXES, ClipSet
from indexing.opening import error, listing, quote
from indexing.readers.files import Format, Options, Source
from indexing.readers.hdf import Array, Hdf5, open_hdf5
from indexing.readers.recording import Recording, dense_recording, to_clips

AXES = ("time", "individuals", "keypoints", "space")
USUAL = ("time", "space", "keypoints", "individuals")
REMEDY = "save it again from movement, with dataset.to_netcdf(path)"


def read(source: Source, options: Options) -> ClipSet:
    """Read a data set of poses."""
    with open_hdf5(source.path) as file:
        recording = _recording(file, options)
    return to_clips(source.path, recording, options)


def _recording(file: Hdf5, options: Options) -> Recording:
    position, there = _axes(file, "position", AXES)
    joints = file.texts("keypoints")
    animals = file.texts("individuals") if "individuals" in there else [""]
    space = file.texts("space") if "space" in file else ["x", "y", "z"][: position.shape[3]]
    frames = len(position)
    fits = position.size and position.shape[1:] == (len(animals), len(joints), len(space))
    if not fits or space not in (["x", "y"], ["x", "y", "z"]):
        message = f"{len(animals)} individuals, {len(joints)} keypoints and the axes {listing(space)}"
        raise error(file.path, f"position is {position.shape} for {message}", REMEDY)
    confidence = None
    if "confidence" in file:
        confidence, _ = _axes(file, "confidence", AXES[:3])
        if confidence.shape != position.shape[:3]:
            raise error(file.path, f"confidence is {confidence.shape} for position {position.shape}", REMEDY)
        confidence = None if np.isnan(confidence).all() else confidence.reshape(-1, len(joints)).astype(np.float64)
    numbers, times = _times(file, frames, options)
    table = position.reshape(-1, len(joints), len(space)).astype(np.float64)
    if confidence is not None:  # a hand-made label has none
        confidence = np.where(np.isnan(confidence) & ~np.isnan(table).any(axis=2), 1.0, confidence)
    people = animals if len(animals) > 1 else None
    up = file.text("/", "up")  # as Clip.to_movement notes it, else as of pixels, and of rooms
    up = up if up in UP_AXES[: 2 * (len(space) - 1)] else "-y" if len(space) == 2 else "z"
    return dense_recording(file.path, table, confidence, numbers, people, joints, times=times, up=up)


def _axes(file: Hdf5, name: str, wanted: tuple[str, ...]) -> tuple[Array, list[str]]:
    """An array with its axes in the order wanted, one of length 1 for each that it lacks, and the axes that it has."""
    values, there = file.array(name, None, "fiu"), _names(file, name)
    unknown = [axis for axis in there if axis not in wanted]
    if unknown or len(set(there)) < len(there) or len(there) != values.ndim or not {"time", "keypoints"} <= set(there):
        raise error(file.path, f"{name} has the axes {listing(there)}, not {', '.join(wanted)}", REMEDY)
    values = values.transpose([there.index(axis) for axis in wanted if axis in there])
    for i, axis in enumerate(wanted):
        if axis not in there:
            values = np.expand_dims(values, i)
    return values, there


def _names(file: Hdf5, name: str) -> list[str]:
    """What the axes of an array are called: by the numbers that netCDF gives them, else in the order in which movement has
    them."""
    numbers = file.attribute(name, "_Netcdf4Coordinates")
    ids = {axis: file.attribute(axis, "_Netcdf4Dimid") for axis in AXES if axis in file}
    axes = {number if isinstance(number, int | np.integer) else None: axis for axis, number in ids.items()}
    if isinstance(numbers, np.ndarray) and numbers.ndim == 1 and numbers.dtype.kind in "iu" and None not in axes:
        found = [axes.get(int(number), str(number)) for number in numbers[: len(AXES) + 1]]
        if len(found) == len(file.shape(name)):
            return found
    usual = [axis for axis in USUAL if axis != "space" or name == "position"]
    return [axis for axis in usual if axis in file or axis in ("time", "space")]


def _times(file: Hdf5, frames: int, options: Options) -> tuple[Array, Array | None]:
    """Frame numbers and, where they are known, seconds."""
    fps, unit = _number(file.attribute("/", "fps")), file.text("/", "time_unit")
    stamps = file.array("time", 1, "fiu") if "time" in file else np.arange(frames)
    if stamps.shape != (frames,):
        raise error(file.path, f"time has {len(stamps)} values for {frames} frames", REMEDY)
    if unit == "seconds" and "time" in file:
        return np.arange(frames), stamps.astype(np.float64)
    whole = np.rint(stamps).astype(np.float64)
    if not (np.abs(whole) < 2**53).all() or (np.diff(whole) <= 0).any():
        raise error(file.path, f"time ({quote(unit)}) must be frame numbers that increase", REMEDY)
    rate = options.fps or fps
    return whole.astype(np.int64), whole / rate if rate is not None else None


def _number(value: Any) -> float | None:
    """A frame rate, where it is one."""
    try:
        number = float(np.asarray(value, dtype=np.float64).reshape(()).item() if np.size(value) == 1 else "nan")
    except (TypeError, ValueError):
        return None
    return number if COARSEST <= number <= FINEST else None


def matches(source: Source) -> bool:
    """A data set of poses."""
    return {"position", "keypoints"} <= set(source.data.names())


FORMAT = Format(("movement",), ("hdf5",), read, matches, order=30)
