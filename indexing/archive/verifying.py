"""Verifying: whether every window of the catalogue is there, whole, and once."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

from indexing.archive.adding import orphans
from indexing.archive.catalogue import Catalogue, Contents, RecordingRow, SegmentRow, SourceRow
from indexing.archive.options import SearchOptions
from indexing.archive.results import Verification
from indexing.archive.segments import ArchiveSegment, intact
from indexing.archive.tracks import windows_of
from indexing.opening import count, listed


def verify(catalogue: Catalogue) -> Verification:
    """Every segment read and compared with the catalogue; again where somebody changed the archive meanwhile."""
    for attempt in range(SearchOptions.attempts):
        contents, recordings, sources = catalogue.moment(checked=True)
        problems = _problems(catalogue.segments_folder, contents, recordings, sources)
        if not problems or attempt == SearchOptions.attempts - 1 or catalogue.generation() == contents.generation:
            break
    left = tuple(path.name for path in orphans(catalogue))
    # whoever adds right now has files that are no leftovers
    return Verification(contents.windows, len(contents.segments), tuple(problems), () if catalogue.held() else left)


def _problems(folder: Path, contents: Contents, recordings: Sequence[RecordingRow], sources: Sequence[SourceRow]) -> list[str]:
    problems: list[str] = []
    by_segment: dict[int, list[RecordingRow]] = {row.id: [] for row in contents.segments}
    for one in recordings:
        if one.segment in by_segment:
            by_segment[one.segment].append(one)
        else:
            problems.append(f"{one.name}: its segment is not in the catalogue; remove its source and add it again")
    names = {row.id: row.name for row in sources}
    for row in contents.segments:
        if row.layout not in contents.layouts:
            problems.append(f"{folder / row.file}: its joint layout is not in the catalogue; {_lost(by_segment[row.id], names)}")
            continue
        problems += _segment_problems(folder, row, by_segment[row.id], contents, names)
    twice = [key for key, count in Counter((one.source, one.name, one.person) for one in recordings).items() if count > 1]
    problems += [f"{name}{f', {who}' * bool(who)}: is there twice; remove its source and add it again" for _, name, who in twice]
    problems += [
        f"{one.name}: belongs to no source; restore the catalogue from a copy, or add the recordings to a new archive"
        for one in recordings
        if one.source not in names
    ]
    return problems


def _segment_problems(
    folder: Path, row: SegmentRow, recordings: Sequence[RecordingRow], contents: Contents, names: Mapping[int, str]
) -> list[str]:
    path, lost = folder / row.file, _lost(recordings, names)
    try:
        if path.stat().st_size != row.size or not intact(path, row.sha256):
            return [f"{path}: is not what was written; {lost}"]
        segment = ArchiveSegment.open(path)
    except OSError as problem:
        return [f"{path}: {problem.strerror or problem}; {lost}"]
    except ValueError as problem:
        return [f"{problem}; {lost}"]
    if segment.joints.shape[1] != contents.layouts[row.layout].joints or segment.rate != contents.options.rate:
        return [f"{path}: has other joints or another rate than the catalogue says; {lost}"]
    live = {one.id: one for one in recordings}
    windows: Counter[int] = Counter()
    held: dict[int, list[tuple[float, float]]] = {number: [] for number in live}  # first and last second of each track
    for (recording, view, _, rows), start in zip(segment.tracks.tolist(), segment.starts.tolist(), strict=True):
        windows[recording] += windows_of(rows, contents.options)
        if recording in live and view == 0:
            held[recording].append((start, start + (rows - 1) / segment.rate))
    found = [
        f"{path}: does not hold what the catalogue says of {one.name}; remove {names.get(one.source, one.name)} and add it again"
        for one in recordings
        if windows[one.id] != one.windows or not _same_times(held[one.id], one)
    ]
    total = sum(windows.values())
    dead = total - sum(windows[number] for number in live)
    if (row.windows, row.dead) != (total, dead):
        found.append(
            f"{path}: has {total} windows, {dead} of them removed; the catalogue says {row.windows} and {row.dead}; {lost}"
        )
    return found


def _same_times(spans: Sequence[tuple[float, float]], row: RecordingRow) -> bool:
    """Whether a recording begins, ends and lasts as the catalogue says, to a thousandth of a second."""
    if not spans:
        return row.seconds == 0  # movement in 3D that only the second image shows
    told = min(begin for begin, _ in spans), max(end for _, end in spans), sum(end - begin for begin, end in spans)
    return all(abs(a - b) <= 1e-3 for a, b in zip(told, (row.begins, row.ends, row.seconds), strict=True))


def _lost(recordings: Sequence[RecordingRow], names: Mapping[int, str]) -> str:
    """What a segment takes with it, and what to do."""
    if not recordings:
        return "nothing of it is used"
    sources = sorted({names.get(one.source, one.name) for one in recordings})
    return f"{count(len(recordings), 'recording')} lost: remove and add again {listed(sources)}"
