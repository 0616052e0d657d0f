"""Clips as files of other programs, one file per format; clip sets are written by :mod:`indexing.readers.clipset`.

======== ============================= =====================================================================================
``.trc`` OpenSim, Pose2Sim, Sports2D   joints of everybody in a recording, exact times; 2D with z = 0
``.c3d`` motion capture (Mokka, Vicon) joints of everybody in a recording, one frame rate; 2D with z = 0
``.nc``  movement (netCDF of xarray)   joints, confidence, exact times, names; needs xarray
``.npz`` clip set                      everything
======== ============================= =====================================================================================

A new format is a file with ``encode(clips, path, units) -> (bytes, notes)``, and a line in :data:`FORMATS`.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from indexing.files import write_bytes
from indexing.opening import error

if TYPE_CHECKING:
    from indexing.clip import Clip

FORMATS = {".trc": "trc", ".c3d": "c3d", ".nc": "netcdf"}
"""Suffix and module; the clip set ``.npz`` besides."""
UNITS = ("m", "cm", "mm", "px")


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
    module = FORMATS.get(path.suffix.lower())
    if module is None:
        raise error(path, f"no format ends in {path.suffix!r}", f"end the name in one of .npz, {', '.join(FORMATS)}")
    if units is not None and units not in UNITS:
        raise error(path, f"units {units!r} are not known", f"give one of {', '.join(UNITS)}")
    found: tuple[bytes, list[str]] = import_module(f"{__name__}.{module}").encode(clips, path, units)
    return found
