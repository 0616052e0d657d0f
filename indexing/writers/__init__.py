"""Clips as files of other programs, one file per format; clip sets are written by :mod:`indexing.readers.formats.clipset`.

======== ============================= =====================================================================================
``.trc`` OpenSim, Pose2Sim, Sports2D   joints of everybody in a recording, exact times; 2D with z = 0
``.c3d`` motion capture (Mokka, Vicon) joints of everybody in a recording, one frame rate; 2D with z = 0
``.nc``  movement (netCDF of xarray)   joints, confidence, exact times, names; needs xarray
``.npz`` clip set                      everything
======== ============================= =====================================================================================

A format is a file in ``formats/`` with the name of its suffix, and registers itself there as :class:`markers.Writer`.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from dyntorch.numerics import Message
from indexing.files import write_bytes
from indexing.opening import error
from indexing.registry import format_names, load_formats
from indexing.writers.markers import Writer

if TYPE_CHECKING:
    from indexing.clip import Clip

FORMATS = tuple(f".{name}" for name in format_names("writers"))
"""Suffixes; the clip set ``.npz`` besides."""
UNITS = ("m", "cm", "mm", "px")


@cache
def registered_formats() -> dict[str, Writer]:
    """The formats by name, which is the suffix without its dot."""
    return load_formats("writers")


def suffixes_with_units() -> list[str]:
    """Of the formats that say what their coordinates are in."""
    return [f".{name}" for name, writer in sorted(registered_formats().items(), reverse=True) if writer.has_units]


def write(clips: Sequence[Clip], path: str | Path, units: str | None = None) -> list[str]:
    """Write one recording, of one person or of several, in the format that the suffix says."""
    path = Path(path).expanduser()
    if not path.parent.is_dir():
        raise error(path, f"the folder {path.parent} does not exist", "create it first")
    data, notes = encode(clips, path, units)
    write_bytes(path, data)
    return notes


def encode(clips: Sequence[Clip], path: Path, units: str | None = None) -> tuple[bytes, list[str]]:
    """What :func:`write` would write to a path, and its notes; nothing is written."""
    if path.suffix.lower() not in FORMATS:
        raise error(path, f"no format ends in {path.suffix!r}", f"end the name in one of .npz, {', '.join(FORMATS)}")
    if units is not None and units not in UNITS:
        raise error(path, f"units {units!r} are not known", f"give one of {', '.join(UNITS)}")
    writer = registered_formats()[path.suffix.lower()[1:]]
    if units is not None and not writer.has_units:
        raise error(path, Message("{arg:units} is for {suffixes}", suffixes=" and ".join(suffixes_with_units())), "leave it out")
    return writer.encode(clips, path, units)
