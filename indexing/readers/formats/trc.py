"""TRC, the marker files of OpenSim: what Pose2Sim, OpenCap and motion capture systems write, 3D over time.

A first line ``PathFileType``, then two lines with ``DataRate``, ``NumFrames``, ``NumMarkers``, ``Units`` and their values, a line
with the names of the markers (``Frame#``, ``Time``, a name over every three columns), a line ``X1 Y1 Z1 ...``, and the frames.
Cells are separated by tabs; empty ones, and a marker exactly at the origin, were not seen.  Lengths become metres; of pixels
(``px``, as Sports2D has them) x and y are read.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from indexing.clip import COARSEST, FINEST, ClipSet, FloatArray
from indexing.opening import WIDEST, error, first_duplicate, listing, quote, read_text
from indexing.readers.files import Format, Options, Source
from indexing.readers.points import number as parse_cell
from indexing.readers.recording import IntArray, build_marker_recording, frame_numbers, to_clips

HEAD = "PathFileType"
UNITS = ("m", "cm", "mm", "px", "in", "meters", "metres", "millimeters", "inches", "pixels", "unknown")
REMEDY = "export it again as TRC, with tabs between the cells"
MAX_ROUNDING = 0.05
"""Of the step between frames, by which times that were rounded are off a steady rate: three digits at 60 to 100 frames per second
by .03 to .05."""
MIN_ROUNDING = 1e-6  # of the step: times with all their digits are kept


def read(source: Source, options: Options) -> ClipSet:
    """Read a marker file; times are those of its column ``Time``, or frame number / ``DataRate``."""
    path = source.path
    lines = [line.rstrip("\r") for line in read_text(path, REMEDY).split("\n")]
    about = _about(path, lines)
    names, at = _names(path, lines, about.get("nummarkers", ""))
    rows = [(i + 1, line) for i, line in enumerate(lines[at:], at) if line.strip()]
    if rows and rows[0][1].strip().lower().startswith("x1"):
        rows = rows[1:]
    if not rows:
        raise error(path, "has a header but no frames", "export it again")
    values = np.array([_row(path, number, line, names) for number, line in rows])
    points = values[:, 2:].reshape(len(values), -1, 3)
    points[(points == 0).all(axis=2)] = np.nan
    frames = frame_numbers(path, values[:, 0])
    rate = _rate(path, about)
    stamps = values[:, 1]
    times: FloatArray | None = stamps
    if np.isnan(stamps).all():
        fps = options.fps or rate
        times = None if fps is None else (frames - frames[0]) / fps
    elif rate is not None:
        times = restore_steady_times(stamps, frames, rate)
    return to_clips(path, build_marker_recording(path, points, names, frames, times, about["units"], ""), options)


def restore_steady_times(times: FloatArray, frames: IntArray, rate: float) -> FloatArray:
    """Times that are those of frames at a steady rate but for the digits that were written, exactly so; others as they are."""
    even = times[0] + (frames - frames[0]) / rate
    rounding = np.abs(times - even).max() * rate if np.isfinite(times).all() else np.inf
    return even if MIN_ROUNDING < rounding <= MAX_ROUNDING else times


def _about(path: Path, lines: list[str]) -> dict[str, str]:
    """The header's words and their values, in lower case."""
    if len(lines) < 4 or not lines[0].startswith(HEAD):
        raise error(path, f"does not begin with {HEAD} and three lines of header", REMEDY)
    about = dict(zip((word.strip().lower() for word in lines[1].split()), lines[2].split(), strict=False))
    about["units"] = about.get("units", "m").lower()
    if about["units"] not in UNITS:
        raise error(path, f"line 3: Units is {quote(about['units'])}", f"write one of {', '.join(UNITS[:5])}")
    return about


def _names(path: Path, lines: list[str], count: str) -> tuple[list[str], int]:
    """Names of the markers, and the line after theirs."""
    at = next((i for i, line in enumerate(lines[:8]) if line.lower().lstrip().startswith("frame#")), None)
    if at is None:
        raise error(path, "has no line that begins with Frame# and Time", REMEDY)
    cells = lines[at].split("\t") if "\t" in lines[at] else lines[at].split()
    if len(cells) > WIDEST:
        raise error(path, f"line {at + 1} has {len(cells)} cells", REMEDY)
    names = [cell.strip() for cell in cells[2:] if cell.strip()]
    twice = first_duplicate(names)
    if not names or twice is not None:
        message = "names no markers" if not names else f"names the marker {quote(twice)} twice"
        raise error(path, f"line {at + 1} {message}", "name every marker once")
    if count.isdecimal() and count != str(len(names)):
        raise error(path, f"NumMarkers is {count[:9]}, but line {at + 1} names {len(names)} ({listing(names)})", REMEDY)
    return names, at + 1


def _row(path: Path, number: int, line: str, names: list[str]) -> FloatArray:
    """Frame, time and coordinates of a line."""
    cells = line.split("\t") if "\t" in line else line.split()
    width = 2 + 3 * len(names)
    if len(cells) > width and any(cell.strip() for cell in cells[width:]):
        raise error(path, f"line {number} has {len(cells)} cells, but there are {len(names)} markers", REMEDY)
    if len(cells) < 2:
        raise error(path, f"line {number} has no frame and time", "the file may be truncated: export it again")
    values = np.full(width, np.nan)
    for column, cell in enumerate(cells[:width]):
        value = parse_cell(cell)
        if value is None:
            what = "Frame#" if column == 0 else "Time" if column == 1 else names[(column - 2) // 3]
            raise error(path, f"line {number}, {quote(what)}: {quote(cell)} is no number", "correct it or leave it empty")
        values[column] = value
    return values


def _rate(path: Path, about: dict[str, str]) -> float | None:
    try:
        rate = float(about.get("datarate", ""))
    except ValueError:
        return None
    if not COARSEST <= rate <= FINEST:
        raise error(path, f"line 3: DataRate is {quote(about['datarate'])}", "write frames per second")
    return rate


FORMAT = Format(("OpenSim",), ("trc",), read)
