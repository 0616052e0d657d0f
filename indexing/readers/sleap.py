"""SLEAP analysis CSV: ``track, frame_idx, instance.score``, then ``<node>.x, <node>.y, <node>.score`` per node.

One row per animal and frame; animals that are not tracked have an empty ``track``.  SLEAP's own files (``.slp``, analysis
``.h5``) are HDF5: export CSV from them.
"""

from __future__ import annotations

import numpy as np

from indexing.clip import ClipSet
from indexing.opening import error, shown
from indexing.readers.files import Options, Source, read_columns
from indexing.readers.recording import Recording, frame_numbers, to_clips
from indexing.skeleton import Skeleton


def read(source: Source, options: Options) -> ClipSet:
    """Read a SLEAP analysis CSV; times are ``frame_idx`` / fps.

    Raises:
        ValueError: no ``frame_idx``, no nodes, or a node without y.
    """
    source.need("sleap", "csv")
    header = [cell.strip() for cell in source.data[0]]
    index = {name: i for i, name in enumerate(header)}
    nodes = [name[:-2] for name in header if name.endswith(".x")]
    lacking = ["frame_idx"] * ("frame_idx" not in index) + [f"{node}.y" for node in nodes if f"{node}.y" not in index]
    if lacking or not nodes:
        raise error(
            source.path, f"has no column {shown((lacking or ['<node>.x'])[0])}", "export with SLEAP's File > Export Analysis CSV"
        )
    scored = all(f"{node}.score" in index for node in nodes)
    kinds = ("x", "y", "score") if scored else ("x", "y")
    columns = [index["frame_idx"], *(index[f"{node}.{kind}"] for node in nodes for kind in kinds)]
    values, texts = read_columns(source.path, 1, columns, [index["track"]] if "track" in index else [])
    frames, at = np.unique(frame_numbers(source.path, values[:, 0]), return_inverse=True)
    table = values[:, 1:].reshape(len(values), len(nodes), len(kinds))
    confidence = None
    if scored and not np.isnan(table[..., 2]).all():  # labels made by hand have empty scores
        seen = ~np.isnan(table[..., :2]).any(axis=2)
        confidence = np.where(seen & np.isnan(table[..., 2]), 1.0, table[..., 2])
    recording = Recording(
        frames=frames,
        at=at,
        joints=table[..., :2],
        confidence=confidence,
        tracks=[track or None for track in texts[0]] if texts else None,
        skeleton=Skeleton(source.path.stem, tuple(nodes)),
    )
    return to_clips(source.path, recording, options)
