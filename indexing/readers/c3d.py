"""Markers of C3D files, the format of motion capture: point data of Intel, MIPS and DEC files, integers or reals.

Analog channels, events and force plates are left where they are.  The layout is that of the C3D user guide (c3d.org).
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from indexing.clip import COARSEST, FINEST, UP_AXES
from indexing.opening import error, read_bytes
from indexing.readers.points import FloatArray, PointSequence

BLOCK = 512
INTEL, DEC, MIPS = 84, 85, 86
SIZES = {-1: 1, 1: 1, 2: 2, 4: 4}  # bytes of a value by the type code: text, bytes, integers, reals
MOST = 2**31  # frames
WORD = 65535  # frame numbers beyond it do not fit the header


@dataclass(frozen=True)
class Parameters:
    """Byte order and the parameters by ``GROUP:NAME``."""

    processor: int
    values: dict[str, Any] = field(default_factory=dict)

    @property
    def order(self) -> str:
        return ">" if self.processor == MIPS else "<"

    def reals(self, data: bytes) -> FloatArray:
        """32-bit reals; those of DEC have their halves swapped and are four times as large."""
        if self.processor == DEC:
            swapped = np.frombuffer(data, "<u2").reshape(-1, 2)[:, ::-1].tobytes()
            return _reals(swapped, "<f4") / 4
        return _reals(data, f"{self.order}f4")

    def labels(self, count: int) -> tuple[str, ...]:
        """Names of the markers; those without one, or with that of another, are numbered."""
        names = _texts(self.values.get("POINT:LABELS"))
        more = 2
        while f"POINT:LABELS{more}" in self.values:  # a parameter holds 255 names
            names += _texts(self.values[f"POINT:LABELS{more}"])
            more += 1
        names = [str(names[i]) if i < len(names) else "" for i in range(count)]
        times = Counter(names)
        return tuple(name if name and times[name] == 1 else f"{name or 'marker'}#{i + 1}" for i, name in enumerate(names))


def read(path: Path) -> PointSequence:
    """The markers of all frames; NaN where a marker was not seen."""
    data = read_bytes(path)
    if len(data) < 2 * BLOCK or data[1] != 0x50 or not data[0]:
        raise error(path, "has no C3D header", "the file may be truncated: export it again")
    at = (data[0] - 1) * BLOCK
    try:
        parameters = _parameters(data, at)
        order = parameters.order
        count, analog, first, last = struct.unpack_from(f"{order}4H", data, 2)
        start = struct.unpack_from(f"{order}H", data, 16)[0]
        scale = float(parameters.reals(data[12:16])[0])
    except (struct.error, IndexError, ValueError):
        raise error(path, "its C3D parameters make no sense", "the file may be damaged: export it again") from None
    if parameters.processor not in (INTEL, DEC, MIPS):
        raise error(path, f"was written for the processor {parameters.processor}, not 84, 85 or 86", "export it again")
    if not count:
        raise error(path, "has no markers, only analog channels", "export markers")
    real = scale < 0
    width = (4 * count + analog) * (4 if real else 2)
    body = data[(start - 1) * BLOCK :]
    frames = last - first + 1
    if last == WORD or last < first:  # longer than the header can say
        frames = max(frames, *(_parse_count(parameters.values.get(f"POINT:{name}")) for name in ("FRAMES", "LONG_FRAMES")))
    frames = min(frames, len(body) // width) if last == WORD else frames
    if frames < 1 or len(body) < frames * width:
        raise error(path, f"has {len(body) // width} of {frames} frames", "the file may be truncated: export it again")
    body = body[: frames * width]
    values = parameters.reals(body) if real else np.frombuffer(body, f"{order}i2").astype(np.float64)
    points = values.reshape(frames, -1)[:, : 4 * count].reshape(frames, count, 4)
    places = points[..., :3] * (1.0 if real else scale)
    places[points[..., 3] < 0] = np.nan  # a negative residual: not seen
    places[~np.isfinite(places).all(axis=-1)] = np.nan
    units = "".join(_texts(parameters.values.get("POINT:UNITS"))[:1]).lower()
    upward = "".join(_texts(parameters.values.get("POINT:Y_SCREEN"))[:1]).lower().lstrip("+")
    up = upward if upward in UP_AXES else ""
    return PointSequence(str(path), places, parameters.labels(count), int(first), _frequency(parameters, data), units, up)


def _frequency(parameters: Parameters, data: bytes) -> float:
    """Frames per second, of the parameter or of the header; 0 where neither is one."""
    stated = parameters.values.get("POINT:RATE")
    rates = [*(stated.ravel()[:1].tolist() if isinstance(stated, np.ndarray) else []), *parameters.reals(data[20:24]).tolist()]
    return next((float(rate) for rate in rates if COARSEST <= rate <= FINEST), 0.0)


def _reals(data: bytes, kind: str) -> FloatArray:
    with np.errstate(invalid="ignore"):  # of bytes that are no number of any kind, but NaN
        return np.frombuffer(data, kind).astype(np.float64)


def _parameters(data: bytes, at: int) -> Parameters:
    """All parameters: groups (negative numbers) and their values, one record after the other."""
    parameters = Parameters(data[at + 3])
    groups: dict[int, str] = {}
    records: list[tuple[int, str, Any]] = []
    at += 4
    while True:
        length, group = struct.unpack_from("bb", data, at)
        if not length or not group:
            break
        name = data[at + 2 : at + 2 + abs(length)].decode("ascii", "replace").strip().upper()  # negative: locked
        link = at + 2 + abs(length)
        step = struct.unpack_from(f"{parameters.order}h", data, link)[0]
        if group < 0:
            groups[-group] = name
        else:
            records.append((group, name, _value(parameters, data, link + 2)))
        if step <= 0:
            break
        at = link + step
    parameters.values.update({f"{groups.get(group, group)}:{name}": value for group, name, value in records})
    return parameters


def _texts(value: Any) -> list[str]:
    return [text for text in value if isinstance(text, str)] if isinstance(value, list) else []


def _parse_count(value: Any) -> int:
    """A parameter that is one number; 0 where it is none."""
    number = value.ravel()[0] if isinstance(value, np.ndarray) and value.size else 0
    return int(number) if 0 <= number < MOST else 0


def _value(parameters: Parameters, data: bytes, at: int) -> Any:
    code, dimensions = struct.unpack_from("bB", data, at)
    shape = list(data[at + 2 : at + 2 + dimensions])
    size = SIZES.get(code, 1)
    total = math.prod(shape)
    raw = data[at + 2 + dimensions :][: total * size]
    if len(raw) < total * size:
        raise ValueError("a parameter is longer than the file")
    if code == -1:
        letters = shape[0] if shape else 1
        return [raw[i : i + letters].decode("utf-8", "replace").strip(" \0") for i in range(0, total, max(1, letters))]
    if code == 4:
        return parameters.reals(raw)
    return np.frombuffer(raw, {1: "u1", 2: f"{parameters.order}u2"}.get(code, "u1")).astype(np.int64)
