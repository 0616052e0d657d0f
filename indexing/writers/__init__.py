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
    """Write one recording, of one person or of several, in the format that the suffix says.

    Args:
        clips: the people of one recording.
        path: ending in a suffix of :data:`FORMATS`; an older file of this name is replaced, whole or not at all.
        units: of the coordinates, for ``.trc`` and ``.c3d``, of :data:`UNITS`; they are written as they are.  By default what the
            clips say (``meta["units"]``), ``px`` in 2D, and in 3D what the size of the body speaks for.

    Returns:
        what a reader should know of what was lost or assumed, a sentence each.

    Raises:
        ValueError: another suffix, several recordings, or what the format cannot hold; nothing is written then.

    Example:
        >>> import pathlib, tempfile, numpy as np
        >>> from indexing import Clip
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "a.trc"
        >>> write([Clip(np.ones((4, 3, 3)) * np.arange(3)[:, None], fps=50.0)], path)
        ['the units are not known: by the size of the body, m; units says otherwise']
        >>> path.read_text().splitlines()[2].split()[:5]
        ['50.0', '50.0', '4', '3', 'm']
    """
    path = Path(path).expanduser()
    if not path.parent.is_dir():
        raise error(path, f"the folder {path.parent} does not exist", "create it first")
    data, notes = encode(clips, path, units)
    write_bytes(path, data)
    return notes


def encode(clips: Sequence[Clip], path: Path, units: str | None = None) -> tuple[bytes, list[str]]:
    """What :func:`write` would write to a path, and its notes; nothing is written.

    Raises:
        ValueError: as :func:`write`.
    """
    module = FORMATS.get(path.suffix.lower())
    if module is None:
        raise error(path, f"no format ends in {path.suffix!r}", f"end the name in one of .npz, {', '.join(FORMATS)}")
    if units is not None and units not in UNITS:
        raise error(path, f"units {units!r} are not known", f"give one of {', '.join(UNITS)}")
    found: tuple[bytes, list[str]] = import_module(f"{__name__}.{module}").encode(clips, path, units)
    return found
