"""C3D, the binary format of motion capture: points as 32-bit reals of an Intel file.

The layout is that of the C3D user guide (c3d.org): a header, groups of parameters, and of each frame x, y, z and a word that is
negative where the point was not seen.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from indexing.opening import error
from indexing.writers.markers import MAX_UNEVENNESS, FloatArray, Markers, Writer, markers_of

if TYPE_CHECKING:
    from indexing.clip import Clip

BLOCK, KEY, INTEL = 512, 0x50, 84
WORD = 65535  # the largest number that the header holds
LETTERS, LABELS = 127, 255  # of a name, and names of a parameter
BLOCKS = 255  # of parameters
SCREEN = {"y": ("+X", "+Y"), "-y": ("+X", "-Y"), "z": ("+X", "+Z"), "-z": ("+X", "-Z")}
"""Which axes point right and up on a screen."""
MAX_GRID_RATIO, MAX_GAP_FRAMES = 10.0, 10_000
"""The grid of a recording: times its frames at most, and frames that it may have in any case."""
KEEP_TIMES = "write .trc, .nc or .npz, which keep times"


def encode(clips: Sequence[Clip], path: Path, units: str | None = None) -> tuple[bytes, list[str]]:
    """The people of one recording, frame by frame at one rate, and what the format has no place for."""
    markers = markers_of(clips, path, units)
    spaced, first = _resample_evenly(markers, path)
    frames, count = spaced.places.shape[:2]
    if count > WORD // 4:
        raise error(path, f"has {count} points, and C3D holds {WORD // 4}", "write .npz")
    parameters = _parameters(spaced, first, path)
    start = 2 + len(parameters) // BLOCK
    header = bytearray(BLOCK)
    struct.pack_into(
        "<BBHHHHHfHHf", header, 0, 2, KEY, count, 0, min(first, WORD), min(first + frames - 1, WORD), 0, -1.0, start, 0, spaced.rate
    )
    table = np.zeros((frames, count, 4), "<f4")
    seen: NDArray[np.bool_] = np.asarray(~np.isnan(spaced.places).any(axis=2))
    with np.errstate(over="ignore"):
        table[..., :3] = np.where(seen[..., None], spaced.places, 0.0)
    table[..., 3] = np.where(seen, 0.0, -1.0)
    body = table.tobytes()
    body += bytes(-len(body) % BLOCK)
    return bytes(header) + parameters + body, list(spaced.notes)


def _resample_evenly(markers: Markers, path: Path) -> tuple[Markers, int]:
    """All frames of a grid of even times, and the number of the first, from 1."""
    rate, steps, off = _grid(markers.times, markers.rate)
    if off.max() > MAX_UNEVENNESS:  # frames left out of a faster recording, as of one of which every fifth is kept, or so
        alternative = _grid(markers.times, markers.numbered)
        rate, steps, off = alternative if alternative[2].max() <= MAX_UNEVENNESS else (rate, steps, off)
    if off.max() > MAX_UNEVENNESS:
        at = int(off.argmax())
        what = f"times are uneven (frame {at} at {markers.times[at]:.6g} s is {off[at]:.2g} frames off {rate:.6g} per second)"
        raise error(path, f"{what}, and C3D has a rate only", KEEP_TIMES)
    if steps[-1] + 1 > max(MAX_GRID_RATIO * len(steps), MAX_GAP_FRAMES):
        raise error(path, f"is nearly all gap: {len(steps)} of {steps[-1] + 1} frames are there", KEEP_TIMES)
    first = round(float(markers.times[0]) * rate) + 1
    notes = list(markers.notes)
    if not 1 <= first <= WORD or abs((first - 1) / rate - float(markers.times[0])) > MAX_UNEVENNESS / rate:
        first = 1
        notes.append(f"it begins at {markers.times[0]:.6g} s, which is 0 in the file")
    absent = int(steps[-1]) + 1 - len(steps)
    if absent:
        notes.append(f"{absent} of {absent + len(steps)} frames are not there, and are written as if nothing was seen in them")
    places = np.full((int(steps[-1]) + 1, *markers.places.shape[1:]), np.nan, markers.places.dtype)
    places[steps] = markers.places
    return replace(markers, places=places, rate=rate, notes=tuple(notes)), first


def _grid(times: FloatArray, about: float) -> tuple[float, NDArray[np.int64], FloatArray]:
    """The even grid of about so many frames per second: its rate, the number of each frame, and how far that is off, in frames."""
    # step by step: of rounded times the usual step is off a little, which adds up
    steps = np.cumsum([0, *np.rint(np.diff(times) * about).astype(np.int64).tolist()])
    rate = float(steps[-1] / (times[-1] - times[0])) if len(steps) > 1 and steps[-1] > 0 else about
    rate = about if abs(rate / about - 1) < 1e-6 else rate
    off = np.abs((times - times[0]) * rate - steps)
    off[1:][np.diff(steps) < 1] = 1.0  # two frames of one number
    return rate, steps, off


def _parameters(markers: Markers, first: int, path: Path) -> bytes:
    """The groups POINT, TRIAL, ANALOG and MANUFACTURER, filled to whole blocks."""
    frames, count = markers.places.shape[:2]
    last = first + frames - 1
    right, upwards = SCREEN[markers.up]
    names = [_name(name, path) for name in markers.names]
    points = [_integers("USED", [count]), _reals("SCALE", [-1.0]), _reals("RATE", [markers.rate])]
    # as many as a word says; of longer recordings programs look at LONG_FRAMES, or at the fields of TRIAL
    points += [_integers("FRAMES", [min(frames, WORD)]), _reals("LONG_FRAMES", [float(frames)])]
    points += [_texts("UNITS", [markers.units]), _texts("X_SCREEN", [right]), _texts("Y_SCREEN", [upwards])]
    for begin in range(0, count, LABELS):
        more = "" if not begin else str(begin // LABELS + 1)
        held = names[begin : begin + LABELS]
        points += [_texts(f"LABELS{more}", held), _texts(f"DESCRIPTIONS{more}", [""] * len(held))]
    fields = (("ACTUAL_START_FIELD", first), ("ACTUAL_END_FIELD", last))
    trial = [_integers(name, [number & WORD, number >> 16]) for name, number in fields]
    analog = [_integers("USED", [0]), _reals("RATE", [0.0]), _reals("GEN_SCALE", [1.0])]

    def groups(data_start: int) -> bytes:
        filled = {"POINT": [*points, _integers("DATA_START", [data_start])], "TRIAL": trial, "ANALOG": analog}
        filled["MANUFACTURER"] = [_texts("COMPANY", ["dyntorch"])]
        records = []
        for number, (group, values) in enumerate(filled.items(), start=1):
            records.append(_record(group, -number, b"\0"))
            records += [_record(name, number, value + b"\0") for name, value in values]
        return b"".join(records) + bytes(2)

    blocks = -(-(4 + len(groups(0))) // BLOCK)
    if blocks > BLOCKS:
        what = f"the names of its {count} points take {blocks} blocks, and C3D holds {BLOCKS}"
        raise error(path, what, "give shorter names, or write .npz")
    body = bytes([1, KEY, blocks, INTEL]) + groups(2 + blocks)
    return body + bytes(-len(body) % BLOCK)


Parameter = tuple[str, bytes]


def _record(name: str, number: int, value: bytes) -> bytes:
    """A group (negative number) or a parameter: its name, how far the next one is, and what it holds."""
    return struct.pack("<bb", len(name), number) + name.encode("ascii") + struct.pack("<h", 2 + len(value)) + value


def _integers(name: str, values: Sequence[int]) -> Parameter:
    return name, struct.pack(f"<b{_shape(values)}{len(values)}H", 2, *_sides(values), *values)


def _reals(name: str, values: Sequence[float]) -> Parameter:
    return name, struct.pack(f"<b{_shape(values)}{len(values)}f", 4, *_sides(values), *values)


def _texts(name: str, values: Sequence[str]) -> Parameter:
    """Texts of one length, filled with blanks."""
    encoded = [value.encode("utf-8") for value in values]
    width = max(1, *(len(value) for value in encoded))
    return name, struct.pack("<bBBB", -1, 2, width, len(values)) + b"".join(value.ljust(width) for value in encoded)


def _shape(values: Sequence[float]) -> str:
    """The format of the number of dimensions and their sizes: none of a single value."""
    return "B" if len(values) == 1 else "BB"


def _sides(values: Sequence[float]) -> list[int]:
    return [0] if len(values) == 1 else [1, len(values)]


def _name(name: str, path: Path) -> str:
    if len(name.encode("utf-8")) > LETTERS:
        raise error(path, f"the name of the point {name[:20]!r}... is longer than {LETTERS} letters", "give it a shorter one")
    return name


FORMAT = Writer(("Mokka", "Vicon"), encode, has_units=True)
