"""Recordings of motion capture: C3D (Vicon, Qualisys, OptiTrack), and tables of points in space."""

from __future__ import annotations

import numpy as np

from indexing.clip import ClipSet
from indexing.readers.c3d import read as read_c3d
from indexing.readers.files import Options, Source
from indexing.readers.markers import of_markers
from indexing.readers.recording import to_clips
from indexing.readers.spatial import read_spatial


def read(source: Source, options: Options) -> ClipSet:
    """Read the markers of a C3D file, or of a table (:mod:`indexing.readers.spatial`)."""
    source.need("mocap", "c3d", "csv")
    if source.kind == "csv":
        return read_spatial(source, options)
    found = read_c3d(source.path)
    frames = np.arange(len(found.values)) + max(found.first - 1, 0)
    rate = options.fps or found.rate
    times = frames / rate if rate > 0 else None
    recording = of_markers(source.path, found.values, list(found.ids or ()), frames, times, found.units, found.up)
    return to_clips(source.path, recording, options)
