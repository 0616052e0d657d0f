"""Candidates compared exactly: the action indexer's residual between views, of windows resampled from the stored joints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from indexing.action.bank import NEAREST, Bank, Copy, JointMetric, Windows, fused_residuals, fusion, planes_of
from indexing.archive.segments import ArchiveSegment
from indexing.clip import FloatArray
from indexing.windows import bridged, sample

AROUND = 2  # poses read beyond both ends of a window: what the first and last of its steps are averaged from


@dataclass(frozen=True, eq=False)
class Places:
    """Where windows are: tracks of segments and seconds from the first pose of these, each window a row of all arrays."""

    segment: NDArray[np.intp]
    track: NDArray[np.int64]
    begin: FloatArray
    end: FloatArray

    def __len__(self) -> int:
        return len(self.segment)

    def __getitem__(self, index: NDArray[np.intp] | slice) -> Places:
        return Places(self.segment[index], self.track[index], self.begin[index], self.end[index])


def residuals(
    example: Windows, image: NDArray[np.intp], places: Places, segments: Sequence[ArchiveSegment], metric: JointMetric, length: int
) -> FloatArray:
    """``(places,)`` fused residual between each window and the image of the example that it is compared with."""
    if not len(places):
        return np.zeros(0)
    windows = cut(places, segments, length)
    (table,) = fused_residuals(example, [Bank([Copy(windows)], planes_of(metric))], [fusion(("epi",), NEAREST)])
    found = table.double().numpy()[image, np.arange(len(places))]
    # a window that shows none of the joints fits everything
    return np.asarray(np.where(windows.seen.any(dim=1).numpy(), found, np.inf))


def cut(places: Places, segments: Sequence[ArchiveSegment], length: int) -> Windows:
    """Windows resampled from the stored joints, gaps bridged in time, as the indexer cuts them from a clip."""
    joints = segments[int(places.segment[0])].joints.shape[1]
    values = torch.empty(len(places), length, joints, 2)
    seen = torch.empty(len(places), joints, dtype=torch.bool)
    for number in np.unique(places.segment).tolist():
        mine = np.flatnonzero(places.segment == number)
        segment, track = segments[number], places.track[mine]
        begin, end = places.begin[mine], places.end[mine]
        rows = segment.tracks[track, 3]
        # a window that hangs over an end repeats the pose there
        first = np.clip(np.floor(begin * segment.rate).astype(np.intp) - AROUND, 0, rows - 2)
        last = np.clip(np.ceil(end * segment.rate).astype(np.intp) + AROUND + 1, first + 2, rows)
        counts = last - first
        starts = np.concatenate([[0], np.cumsum(counts)])
        step = np.arange(starts[-1]) - np.repeat(starts[:-1], counts) + np.repeat(first, counts)
        source = bridged(segment.poses(np.repeat(track, counts), step), step / segment.rate, starts)
        values[mine] = sample(source, np.arange(len(mine)), begin, end, length)
        seen[mine] = torch.from_numpy(source.seen)
    return Windows(values, seen)
