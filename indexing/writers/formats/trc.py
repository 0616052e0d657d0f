"""Track Row Column, the text of OpenSim, Pose2Sim and Sports2D: a row per frame, three columns per marker, empty = not seen."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from indexing.writers.markers import FloatArray, Writer, markers_of

if TYPE_CHECKING:
    from indexing.clip import Clip


def encode(clips: Sequence[Clip], path: Path, units: str | None = None) -> tuple[bytes, list[str]]:
    """The people of one recording as text, and what it has no place for."""
    markers = markers_of(clips, path, units)
    numbers = frame_numbers(markers.times, markers.rate)
    frames, count = markers.places.shape[:2]
    rate = repr(round(markers.rate, 6))
    head = [
        ["PathFileType", "4", "(X/Y/Z)", path.name],
        ["DataRate", "CameraRate", "NumFrames", "NumMarkers", "Units", "OrigDataRate", "OrigDataStartFrame", "OrigNumFrames"],
        [rate, rate, str(frames), str(count), markers.units, rate, str(numbers[0]), str(frames)],
        ["Frame#", "Time", *(cell for name in markers.names for cell in (name.replace("\t", " "), "", ""))],
        ["", "", *(f"{axis}{i + 1}" for i in range(count) for axis in "XYZ")],
    ]
    lines = ["\t".join(row).rstrip("\t") if i < 4 else "\t".join(row) for i, row in enumerate(head)] + [""]
    for number, time, places in zip(numbers, markers.times.tolist(), markers.places, strict=True):
        lines.append("\t".join([str(number), repr(time), *_cells(places)]))
    return ("\n".join(lines) + "\n").encode("utf-8", "backslashreplace"), list(markers.notes)


def frame_numbers(times: FloatArray, rate: float) -> list[int]:
    """Numbers of frames, from 1 where a recording begins; where times are uneven, one after the other."""
    numbers = np.rint(times * rate).astype(np.int64) + 1
    if (np.diff(numbers) < 1).any() or numbers[0] < 1:
        numbers = np.arange(1, len(times) + 1)
    return [int(number) for number in numbers]


def _cells(places: FloatArray) -> list[str]:
    """``x, y, z`` of all markers of a frame with the digits that tell each number from its neighbours."""
    gone = np.isnan(places).any(axis=1, keepdims=True) | np.zeros_like(places, dtype=bool)
    values = places.ravel()
    text = [str(value) for value in (values if values.dtype == np.float32 else values.tolist())]
    return ["" if missing else cell for cell, missing in zip(text, gone.ravel().tolist(), strict=True)]


FORMAT = Writer(("OpenSim", "Pose2Sim", "Sports2D"), encode, has_units=True)
