"""Markers of motion capture as recordings: what C3D, TRC and tables of points share.

Markers of several people are told apart by what stands before a colon, ``Anna:LKNE``, where all people have the same markers.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from indexing.clip import FloatArray
from indexing.readers.layouts import estimate_up
from indexing.readers.recording import IntArray, Recording
from indexing.skeleton import Skeleton

UNITS = {
    "m": ("m", "meter", "meters", "metre", "metres"), "cm": ("cm", "centimeters", "centimetres"),
    "mm": ("mm", "millimeter", "millimeters", "millimetre", "millimetres"), "in": ("in", "inch", "inches"), "px": ("px", "pixels"),
}  # fmt: skip
METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}


def build_marker_recording(
    path: Path, points: FloatArray, names: list[str], frames: IntArray, times: FloatArray | None, units: str, up: str
) -> Recording:
    """A recording of named markers. points ``(frames, markers, 3)``."""
    people, joints = split_people(names)
    unit = next((unit for unit, words in UNITS.items() if units.lower() in words), "")
    values = METRES.get(unit, 1.0) * points.reshape(len(points) * len(people), len(joints), 3)
    depth = values[..., 2]
    if unit == "px" or not depth[np.isfinite(depth)].any():
        values, up = values[..., :2], up if not up.endswith("z") else ""
    usual = "-y" if unit == "px" else "y" if values.shape[2] == 2 or path.suffix.lower() == ".trc" else "z"
    return Recording(
        frames=frames,
        at=np.repeat(np.arange(len(frames)), len(people)),
        joints=values,
        confidence=None,
        tracks=people * len(frames) if len(people) > 1 else None,
        times=times,
        skeleton=Skeleton(path.stem, tuple(joints)),
        up=up or estimate_up(values, joints, usual),
        meta={"units": "m" if unit in METRES else unit} if unit else {},
    )


def split_people(names: Sequence[str]) -> tuple[list[str], list[str]]:
    """Who is in a file of markers, and the markers of each."""
    parts = [name.partition(":") for name in names]
    if not all(before and colon and after for before, colon, after in parts):
        return [""], list(names)
    people = list(dict.fromkeys(before for before, _, _ in parts))
    joints = [after for before, _, after in parts if before == people[0]]
    if [f"{who}:{joint}" for who in people for joint in joints] != list(names):
        return [""], list(names)
    return people if len(people) > 1 else [""], joints
