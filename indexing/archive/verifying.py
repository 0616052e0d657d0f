"""Verifying: whether every window of the catalogue is there, whole, and once."""

from __future__ import annotations

import hashlib
from collections import Counter
from pathlib import Path

from indexing.archive.adding import orphans
from indexing.archive.catalogue import Catalogue, RecordingRow, SegmentRow
from indexing.archive.options import StorageOptions
from indexing.archive.results import Verification
from indexing.archive.segments import ArchiveSegment
from indexing.archive.tracks import windows_of


def verify(catalogue: Catalogue) -> Verification:
    """Every segment read and compared with the catalogue."""
    contents, recordings = catalogue.contents(), catalogue.recordings()
    problems: list[str] = []
    by_segment: dict[int, list[RecordingRow]] = {row.id: [] for row in contents.segments}
    for one in recordings:
        if one.segment in by_segment:
            by_segment[one.segment].append(one)
        else:
            problems.append(f"{one.name}: its segment is not in the catalogue; add it again")
    for row in contents.segments:
        problems += _segment_problems(catalogue.segments_folder, row, by_segment[row.id], contents.options)
    twice = [key for key, count in Counter((one.source, one.name, one.person) for one in recordings).items() if count > 1]
    names = {one.source: one.name for one in recordings}
    problems += [
        f"{names[source]}: {name} {person} is there twice; remove the source and add it again" for source, name, person in twice
    ]
    known = {row.id for row in catalogue.sources().values()}
    problems += [f"{one.name}: belongs to no source; remove it" for one in recordings if one.source not in known]
    return Verification(contents.windows, len(contents.segments), tuple(problems), tuple(path.name for path in orphans(catalogue)))


def _segment_problems(folder: Path, row: SegmentRow, recordings: list[RecordingRow], options: StorageOptions) -> list[str]:
    path = folder / row.file
    lost = (
        f"{len(recordings)} recordings are lost: remove their sources and add them again" if recordings else "nothing of it is used"
    )
    try:
        segment = ArchiveSegment.open(path)
        if _sha256(path) != row.sha256:
            return [f"{path}: is not what was written; {lost}"]
    except (OSError, ValueError) as problem:
        return [f"{path}: {getattr(problem, 'strerror', None) or problem}; {lost}"]
    wrong = segment.check()
    if wrong is not None:
        return [f"{path}: {wrong}; {lost}"]
    windows: Counter[int] = Counter()
    for recording, rows in segment.tracks[:, [0, 3]].tolist():
        windows[recording] += windows_of(rows, options)
    found = [
        f"{path}: has {windows[one.id]} windows of {one.name}, the catalogue {one.windows}; remove it and add it again"
        for one in recordings
        if windows[one.id] != one.windows
    ]
    total, dead = sum(windows.values()), sum(windows.values()) - sum(one.windows for one in recordings)
    if (row.windows, row.dead) != (total, dead):
        found.append(f"{path}: has {total} windows, {dead} of them removed; the catalogue says {row.windows} and {row.dead}")
    return found


def _sha256(path: Path) -> str:
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
