"""The archive: recordings of a laboratory, kept as movement, and asked where else anybody did *this*."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from indexing.archive import writer
from indexing.archive.catalogue import Catalogue, drop_recordings, storable
from indexing.archive.search import Hit, Shortlist, Snapshot, check_example, queries_of, search
from indexing.archive.segments import ArchiveSegment
from indexing.archive.sources import SourceInput, assign_pose_folders, gather, poses_of
from indexing.archive.writer import MAX_ATTEMPTS, Addition, ArchiveOptions, Verification, verify
from indexing.clip import Clip

if TYPE_CHECKING:
    from indexing.action.indexer import ActionIndexer
    from indexing.archive.actions import ArchivedEvent

Progress = Callable[[float], None] | None
T = TypeVar("T")


@dataclass(frozen=True)
class ArchivedRecording:
    """One person of a recording in an archive."""

    source: str
    path: str
    person: str
    start: float
    end: float
    seconds: float
    layout: str


@dataclass(frozen=True)
class ArchiveInfo:
    """What is in an archive."""

    sources: int
    recordings: int
    windows: int
    seconds: float
    segments: int
    dead: int
    size: int
    layouts: tuple[tuple[str, int, float], ...]
    version: int


class Archive:
    """Movement of many recordings on disk, searched by example from any viewpoint.

    Args:
        path: a folder; made by the first :meth:`add`.
        options: how it stores, grows and searches; None: the defaults.

    Raises:
        ValueError: the folder is there and no archive, or one of a newer version.

    Example:
        >>> import tempfile
        >>> from indexing.actors import Person, detect, perform
        >>> def filmed(action, person, azimuth):
        ...     clip = detect(perform(action, Person.random(person), rng=person), azimuth=azimuth, rng=person)
        ...     return clip.replace(name=f"{action} {person}")
        >>> archive = Archive(tempfile.mkdtemp())
        >>> clips = [filmed(action, person, 40.0) for action in ("squat", "kick", "wave") for person in (1, 2)]
        >>> len(archive.add(clips).of("added"))
        6
        >>> hits = archive.search(filmed("kick", 3, 0.0), k=2)
        >>> sorted(hit.source for hit in hits)
        ['kick 1', 'kick 2']
        >>> archive.verify().ok
        True
    """

    def __init__(self, path: str | os.PathLike[str], options: ArchiveOptions | None = None) -> None:
        self.path, self.options = Path(path).expanduser(), options or ArchiveOptions()
        self._snapshot: Snapshot | None = None
        if self.path.exists() and not self.path.is_dir():
            raise ValueError(f"{self.path}: is a file; an archive is a folder")
        if self.path.is_dir() and any(self.path.iterdir()):
            Catalogue(self.path)  # says what is wrong with it, if anything

    def __len__(self) -> int:
        """Windows: poses from which one of the shortest duration lasts."""
        return self._catalogue().contents().windows if self._exists() else 0

    def __repr__(self) -> str:
        return f"Archive({str(self.path)!r}, {len(self):,} windows)"

    # ---- what is in it -----------------------------------------------------------------------------------------------
    def add(
        self,
        sources: SourceInput | Iterable[SourceInput],
        executor: Executor | None = None,
        progress: Progress = None,
        reading: Mapping[str, Any] | None = None,
    ) -> Addition:
        """Add recordings: what is known is left alone, what has changed is replaced.

        Whatever happens, the archive holds what was committed before, whole: killed at any moment nothing is lost of it and nothing
        is there twice.

        Args:
            sources: files, folders (walked), clips, sets of clips, datasets as ``movement`` has them; one or many.  Videos, too,
                where a pose model is there; their keypoints are kept in the archive's folder ``poses``.
            executor: anything with the interface of ``concurrent.futures``, such as a process pool or
                ``dask.distributed.Client(...).get_executor()``; by default this process reads one source after the other.
            progress: told the share done.
            reading: arguments of :func:`indexing.readers.read`, such as ``fps``; everybody in view by default.

        Returns:
            what became of each source; one that cannot be read is no exception.

        Raises:
            ValueError: another process adds, or the archive cannot be written.
        """
        listed = assign_pose_folders(gather(sources), self.path)
        catalogue = Catalogue.make(self.path, self.options.storage)
        return writer.add(catalogue, listed, self.options, executor, dict(reading or {}), progress)

    def remove(self, source: str | os.PathLike[str]) -> int:
        """Take a source out: a file by its path or name, a clip by its name.  How many recordings it had.

        Raises:
            ValueError: there is none of this name, or another process writes.
        """
        catalogue, name = self._catalogue(), storable(os.fspath(source))
        with catalogue.write_lock():
            resolved = storable(str(Path(source).expanduser().resolve()))
            mine = [row for row in catalogue.sources().values() if name in (row.name, row.path) or resolved == row.path != ""]
            if not mine:
                raise ValueError(f"{self.path}: has no source {name!r}; dyntorch archive info --sources lists them")
            count = 0
            with catalogue.writing() as connection:
                for row in mine:
                    count += drop_recordings(connection, row.id)
                    connection.execute("DELETE FROM sources WHERE id = ?", (row.id,))
            writer.tidy(catalogue, self.options)
            for row in mine:
                shutil.rmtree(poses_of(self.path, row.key), ignore_errors=True)
        return count

    def recordings(self) -> list[ArchivedRecording]:
        """Everybody in every recording, in the order of their addition."""
        contents, rows, sources = self._catalogue().moment()
        layouts = {row.id: contents.layouts[row.layout].name for row in contents.segments}
        paths = {row.id: row.path for row in sources}
        return [
            ArchivedRecording(
                row.name, paths[row.source], row.person, row.begins, row.ends, row.seconds, layouts[row.segment]
            )
            for row in rows
        ]  # fmt: skip

    def info(self) -> ArchiveInfo:
        """How much is in it."""
        catalogue = self._catalogue()
        contents, rows, sources = catalogue.moment()
        layouts = {row.id: row.layout for row in contents.segments}
        seconds = dict.fromkeys(contents.layouts, 0.0)
        for row in rows:
            seconds[layouts[row.segment]] += row.seconds
        return ArchiveInfo(
            sources=len(sources),
            recordings=len(rows),
            windows=contents.windows,
            seconds=sum(seconds.values()),
            segments=len(contents.segments),
            dead=sum(row.dead for row in contents.segments),
            size=sum(row.size for row in contents.segments) + catalogue.path.stat().st_size,
            layouts=tuple((one.name, one.joints, seconds[number]) for number, one in contents.layouts.items()),
            version=catalogue.version,
        )

    def clip(self, source: str, start: float | None = None, end: float | None = None, person: str = "") -> Clip:
        """What is stored of a recording: y up, NaN where not seen.

        Args:
            source: its name, as hits have it; start, end: seconds on its clock; person: who, where several are in view.

        Raises:
            ValueError: there is none of this name, or nothing of it in that time.
        """
        clip = self._retry(lambda: self._read_recording(source, person))
        lowest = -np.inf if start is None else start - 0.5 / (clip.fps or 1.0)
        return clip.between(lowest, np.inf if end is None else end + 0.5 / (clip.fps or 1.0))

    def _read_recording(self, source: str, person: str) -> Clip:
        """All of a recording's first image."""
        snapshot = self._open_snapshot()
        rows = [row for row in self._catalogue().by_name(storable(source)) if person in ("", row.person)]
        if not rows:
            who = f" with a person {person!r}" if person else ""
            raise ValueError(f"{self.path}: has no recording {source!r}{who}; dyntorch archive info --sources lists them")
        row, numbers = rows[0], {one.id: i for i, one in enumerate(snapshot.contents.segments)}
        if row.segment not in numbers:
            raise FileNotFoundError(errno.ENOENT, "segment of another moment", str(self.path))
        number = numbers[row.segment]
        segment = snapshot.segments[number]
        mine = np.flatnonzero((segment.tracks[:, 0] == row.id) & (segment.tracks[:, 1] == 0))
        mine = mine[np.argsort(segment.starts[mine])]
        rate = segment.rate
        joints = np.concatenate([segment.positions(i) for i in mine.tolist()])
        times = np.concatenate([segment.starts[i] + np.arange(int(segment.tracks[i, 3])) / rate for i in mine.tolist()])
        layout = snapshot.contents.layouts[snapshot.contents.segments[number].layout]
        return Clip(joints, times=times, fps=rate, name=row.name, skeleton=layout.skeleton, up="y", meta={"person": row.person})

    # ---- asking it ---------------------------------------------------------------------------------------------------
    def search(
        self, clip: Clip, k: int = 10, executor: Executor | None = None, progress: Progress = None, mirror: bool = False
    ) -> list[Hit]:
        """Where else anybody did this, best first.

        Args:
            clip: one performance, from any viewpoint; with 3D joints it is asked from two sides.
            k: hits at most; executor: as in :meth:`add`, over segments on a file system that all see; mirror: whether its mirror
                image counts, too.

        Raises:
            ValueError: nothing is in the archive, or the example is too short, too long, or has too few joints in common with it.
        """
        if isinstance(k, bool) or not isinstance(k, (int, np.integer)) or k < 1:
            raise ValueError(f"k must be a whole number of hits, 1 or more, got {k!r}")
        return self._retry(lambda: self._search(clip, int(k), executor, progress, mirror))

    def _search(self, clip: Clip, k: int, executor: Executor | None, progress: Progress, mirror: bool) -> list[Hit]:
        snapshot = self._open_snapshot()
        if not snapshot.contents.windows:
            raise ValueError(f"{self.path}: holds no movement yet; add recordings first")
        example = check_example(clip, snapshot.contents.storage.min_duration)
        queries = queries_of(example, snapshot.contents, mirror)
        return self._hits(snapshot, search(snapshot, queries, k, self.options.num_candidates, executor, progress))

    def _hits(self, snapshot: Snapshot, found: Shortlist) -> list[Hit]:
        where = [
            (snapshot.segments[i], int(t)) for i, t in zip(found.places.segment.tolist(), found.places.track.tolist(), strict=True)
        ]
        names = self._catalogue().recordings_by_id([int(segment.tracks[track, 0]) for segment, track in where])
        hits: list[Hit] = []
        for i, (segment, track) in enumerate(where):
            row = names.get(int(segment.tracks[track, 0]))
            if row is None:
                continue  # removed meanwhile
            start, last = float(segment.starts[track]), (int(segment.tracks[track, 3]) - 1) / segment.rate
            begin, end = max(0.0, float(found.places.begin[i])), min(last, float(found.places.end[i]))
            hits.append(Hit(row.name, row.person, start + begin, start + end, float(found.score[i]), bool(found.mirrored[i])))
        return hits

    def find(
        self, model: ActionIndexer | str | os.PathLike[str], executor: Executor | None = None, progress: Progress = None
    ) -> list[ArchivedEvent]:
        """All learned actions in everything, by recording, person and time.

        Args:
            model: fitted, or its file; executor: as in :meth:`add`.

        Raises:
            ValueError: the model has too few joints in common with what is in the archive.
        """
        from indexing.archive.actions import find

        return self._retry(lambda: find(self._open_snapshot(), self._catalogue(), model, executor, progress))

    def verify(self) -> Verification:
        """Whether every window of the catalogue is there, whole, and once; reads everything."""
        return verify(self._catalogue())

    # ---- inside ------------------------------------------------------------------------------------------------------
    def _exists(self) -> bool:
        return self.path.is_dir() and any(self.path.iterdir())

    def _catalogue(self) -> Catalogue:
        if not self._exists():
            raise ValueError(f"{self.path}: is no archive yet; add recordings first")
        return Catalogue(self.path)

    def _retry(self, question: Callable[[], T]) -> T:
        """The answer to a question; asked again where segments were put together meanwhile."""
        for _ in range(MAX_ATTEMPTS - 1):
            with contextlib.suppress(FileNotFoundError):
                return question()
            self._snapshot = None
        try:
            return question()
        except FileNotFoundError as problem:
            raise ValueError(f"{problem.filename}: is missing; dyntorch archive verify says what is lost") from None

    def _open_snapshot(self) -> Snapshot:
        """As it is now; what was mapped before and has not changed stays mapped."""
        catalogue = self._catalogue()
        if self._snapshot is not None and self._snapshot.contents.generation == catalogue.generation():
            return self._snapshot
        contents, left = catalogue.searchable()
        known = {} if self._snapshot is None else {one.path.name: one for one in self._snapshot.segments}
        folder = catalogue.segments_folder
        segments = tuple(known.get(row.file) or ArchiveSegment.open(folder / row.file) for row in contents.segments)
        dead = tuple(
            frozenset(segment.tracks[:, 0].tolist()) - left[row.id] if row.id in left else frozenset()
            for row, segment in zip(contents.segments, segments, strict=True)
        )
        self._snapshot = Snapshot(folder, contents, segments, dead)
        return self._snapshot
