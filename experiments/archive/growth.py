"""An archive that grows from 10 to 3,000 hours: seconds per query, bytes per hour, and memory beside the mapped files.

    DYNTORCH_DATA=../shared/data python -m experiments.archive.growth

Ten hours of different people (:mod:`experiments.archive.scenes`: captured takes and distractors, 20 joints), added as usual; then
the archive is multiplied on disk: segments of as many windows as a grown archive has, each with the ten hours several times over,
under other names and numbers, their sketches with noise of their own.  Queries are moments of takes by other cameras, asked of an
archive that is opened in a process of its own, with as many threads as there are cores.

*Warm*: median over queries, after some that do not count.  *Cold*: the same where each is the first question to a newly opened
archive after its files were dropped from the page cache.  *Linear*: what the first column's seconds at 10 hours would grow to.
*All cores*: processor time of the same queries, which others at work change less.  *Memory*: most anonymous pages (RssAnon) above
those after the imports, during all of that.
"""

from __future__ import annotations

import gc
import multiprocessing
import os
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from statistics import median
from typing import Annotated, Any

import numpy as np
import torch
import tyro
from safetensors import safe_open
from safetensors.numpy import load_file, save

from experiments.archive.scenes import Question, captured, distractors, every_take, questions
from experiments.common.runner import BaseConfig, Grid, Tables, experiment
from experiments.common.tables import COLOURS, MARKS, Row, note
from experiments.recognition.protocol import Array
from indexing import Archive, ArchiveOptions, ClipSet
from indexing.archive.catalogue import Catalogue, RecordingRow, SegmentRow, SourceRow
from indexing.files import replacing
from indexing.report.canvas import LIGHT, new_figure, png, style

HOUR = 3600.0
NOISE = 3.0  # of 127, on the sketches of copies: none is the same as another
PICTURE = "archive-growth.png"
WARM, COLD, MEGABYTE = 3.0, 10.0, 10.0  # goals at 1,000 hours: seconds, seconds, MB per hour
MEMORY = 1000.0  # MB
LARGEST = 1000  # hours for which the goals are
WAIT = 0.005  # seconds between two looks at the memory


@dataclass(frozen=True)
class Config(BaseConfig):
    """Time and space of an archive that grows, made of captured and invented people of the folder DYNTORCH_DATA."""

    hours: tuple[int, ...] = (10, 30, 100, 300, 1000, 3000)
    """Sizes, growing; the first is recorded, the others are copies of it."""
    durations: tuple[float, ...] = (1.0, 3.0)
    """Seconds of the queries."""
    queries: int = 5
    """Of each duration, warm."""
    cold: int = 3
    """Of each duration, cold."""
    threads: int = 2
    """Cores."""
    folder: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Where the archive grows: 17 GB; by default a temporary folder."""


# ---- an archive multiplied ---------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Original:
    """The recorded part of an archive: what is copied.

    path, tensors, about: of its segment; step: numbers to the next copy's recordings.
    """

    catalogue: Catalogue
    segment: SegmentRow
    tensors: dict[str, Array]
    about: dict[str, str]
    recordings: tuple[RecordingRow, ...]
    sources: tuple[SourceRow, ...]

    @classmethod
    def of(cls, archive: Archive) -> Original:
        """Of an archive that was just made.

        Raises:
            ValueError: it has several segments: fewer recordings are to be copied.
        """
        catalogue = Catalogue(archive.path)
        segments = catalogue.contents().segments
        if len(segments) != 1:
            raise ValueError(f"{archive.path}: has {len(segments)} segments, one is copied; record fewer hours first")
        path = catalogue.segments_folder / segments[0].file
        with safe_open(path, framework="numpy") as file:
            about = dict(file.metadata())
        return cls(
            catalogue, segments[0], load_file(path), about, tuple(catalogue.moment()[1]), tuple(catalogue.sources().values())
        )

    @property
    def step(self) -> int:
        """From the numbers of one copy to those of the next."""
        return max(max(row.id for row in self.recordings), max(row.id for row in self.sources))

    def copies(self, numbers: Sequence[int], rng: np.random.Generator) -> dict[str, Array]:
        """The tensors of one segment that holds the recordings several times over, each time under other numbers."""
        tensors = {name: np.concatenate([one] * len(numbers)) for name, one in self.tensors.items() if name != "layout"}
        for place, (number, part) in enumerate(zip(numbers, np.split(tensors["tracks"], len(numbers)), strict=True)):
            part[:, 0] += number * self.step
            part[:, 2] += place * len(self.tensors["joints"])  # the first row of each track
        noise = rng.normal(0.0, NOISE, tensors["codes"].shape).astype(np.float32)
        tensors["codes"] = np.clip(np.round(tensors["codes"] + noise), -127, 127).astype(np.int8)
        return {**tensors, "layout": self.tensors["layout"]}

    def write(self, numbers: Sequence[int], rng: np.random.Generator) -> None:
        """One more segment, and its rows in the catalogue.

        Args:
            numbers: of the copies, from 1.
        """
        data = save(self.copies(numbers, rng), self.about)
        file = f"copy{numbers[0]:06d}.safetensors"
        with replacing(self.catalogue.segments_folder / file) as stream:
            stream.write(data)
        entry = (file, self.segment.layout, len(numbers) * self.segment.windows, len(data), sha256(data).hexdigest())
        with self.catalogue.writing() as connection:
            made = connection.execute("INSERT INTO segments (file, layout, windows, size, sha256) VALUES (?, ?, ?, ?, ?)", entry)
            for number in numbers:
                shift, named = number * self.step, f" copy {number}"
                connection.executemany(
                    "INSERT INTO sources VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)",
                    [
                        (row.id + shift, row.key + named, row.name + named, row.path, row.size, row.modified, row.sha256,
                         row.reading, row.note)
                        for row in self.sources
                    ],
                )  # fmt: skip
                connection.executemany(
                    "INSERT INTO recordings VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)",
                    [
                        (row.id + shift, row.source + shift, made.lastrowid, row.name + named, row.person, row.begins, row.ends,
                         row.seconds, row.windows)
                        for row in self.recordings
                    ],
                )  # fmt: skip


def recorded(path: Path, hours: float, seed: int) -> Archive:
    """An archive of takes and invented people."""
    people, rng = captured(), np.random.default_rng([seed, 0])
    clips = every_take(people, rng)
    clips += distractors(people, hours * HOUR - sum(clip.duration for clip in clips), rng)
    archive = Archive(path)
    archive.add(ClipSet(clips))
    return archive


def grow(original: Original, done: int, wanted: int, seed: int) -> int:
    """Copies until there are so many parts in all; how many there are then."""
    each = max(1, ArchiveOptions().max_segment_windows // original.segment.windows)
    while done < wanted:
        numbers = range(done, min(done + each, wanted))
        original.write(numbers, np.random.default_rng([seed, 1, done]))
        done += len(numbers)
    with_them = original.catalogue.contents().windows
    note(f"... {done} times {original.segment.windows:,} windows: {with_them:,}")
    return done


# ---- questions, in a process of their own --------------------------------------------------------------------------------
@dataclass
class Memory:
    """Anonymous memory of this process in MB: what it was, and the most that it has been since."""

    before: float
    most: float = 0.0
    _stop: threading.Event = field(default_factory=threading.Event)

    def watch(self) -> None:
        """Look again and again, until told to stop."""
        while not self._stop.wait(WAIT):
            self.most = max(self.most, anonymous())

    @property
    def grown(self) -> float:
        """MB above what it was."""
        return max(0.0, self.most - self.before)


def anonymous() -> float:
    """MB of anonymous pages: everything but mapped files (Linux; NaN elsewhere)."""
    status = Path("/proc/self/status")
    if not status.is_file():
        return float("nan")
    line = next((line for line in status.read_text().splitlines() if line.startswith("RssAnon:")), "RssAnon: nan kB")
    return float(line.split()[1]) / 1024


@contextmanager
def watched() -> Iterator[Memory]:
    """The memory while the block runs."""
    memory = Memory(anonymous())
    thread = threading.Thread(target=memory.watch, daemon=True)
    thread.start()
    try:
        yield memory
    finally:
        memory._stop.set()
        thread.join()


def forget(folder: Path) -> None:
    """Drop all files of a folder from the page cache; nobody may have them mapped."""
    gc.collect()
    os.sync()
    for path in folder.rglob("*"):
        if path.is_file() and hasattr(os, "posix_fadvise"):
            descriptor = os.open(path, os.O_RDONLY)
            try:
                os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
            finally:
                os.close(descriptor)


def timed(archive: Archive, question: Question) -> tuple[float, float]:
    """Seconds until ten hits are there, by the clock and of all cores together."""
    begin, worked = time.perf_counter(), time.process_time()
    found = archive.search(question.clip, k=10)
    seconds = time.perf_counter() - begin, time.process_time() - worked
    assert found
    return seconds


def asked(folder: Path, asking: Sequence[Sequence[Question]], cold: int, threads: int) -> dict[str, Any]:
    """Seconds of every query, warm and cold, by duration, and memory.

    Args:
        asking: queries of each duration; cold: how many of them are asked cold.
    """
    torch.set_num_threads(threads)
    with watched() as memory:
        archive = Archive(folder)
        for same in asking:
            timed(archive, same[0])
        warm = [[timed(archive, one) for one in same] for same in asking]
        del archive
        icy: list[list[float]] = []
        for same in asking:
            icy.append([])
            for one in same[:cold]:
                unmap()
                forget(folder)
                begin = time.perf_counter()
                archive = Archive(folder)
                opened = time.perf_counter() - begin
                icy[-1].append(opened + timed(archive, one)[0])
                del archive
    clock, worked = ([[one[i] for one in times] for times in warm] for i in range(2))
    return {"warm": clock, "worked": worked, "cold": icy, "memory": memory.grown}


def unmap() -> None:
    """Let go of the files that this process has mapped."""
    from indexing.archive import search

    search._open_segment.cache_clear()
    gc.collect()


def measured(folder: Path, config: Config) -> dict[str, Any]:
    """The same, by a new process."""
    people = captured()
    asking = [
        questions(people, duration, max(config.queries, config.cold), np.random.default_rng([config.seed, 2]))
        for duration in config.durations
    ]
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        found = pool.submit(asked, folder, asking, config.cold, config.threads).result()
    for kind in ("warm", "worked"):
        found[kind] = [times[: config.queries] for times in found[kind]]
    return found


# ---- tables ------------------------------------------------------------------------------------------------------------
def drawn(hours: Sequence[int], seconds: dict[str, list[float]], megabytes: list[float]) -> bytes:
    """PNG: seconds per query and megabytes against hours, both with what is linear."""
    with style(LIGHT):
        figure = new_figure(8.4, 3.4)
        left, right = figure.subplots(1, 2)
        for which, (name, values) in enumerate(seconds.items()):
            left.plot(hours, values, color=COLOURS[which % 6], marker=MARKS[which % 6], markersize=4, linewidth=1.4, label=name)
        first = max(values[0] for values in seconds.values())
        left.plot(hours, [first * one / hours[0] for one in hours], color=LIGHT.muted, linestyle=":", linewidth=1.0, label="linear")
        left.set_ylabel("seconds per query")
        left.legend(frameon=False, fontsize=7)
        right.plot(hours, megabytes, color=COLOURS[0], marker=MARKS[0], markersize=4, linewidth=1.4)
        right.set_ylabel("MB on disk")
        for axes in (left, right):
            axes.set_xscale("log")
            axes.set_yscale("log")
            axes.set_xlabel("hours in the archive")
            axes.grid(color=LIGHT.line, linewidth=0.5)
        figure.tight_layout()
        return png(figure)


def grown(config: Config, folder: Path) -> tuple[Grid, bytes]:
    """Grow and ask: the table, and the picture."""
    archive = recorded(folder, config.hours[0], config.seed)
    original, done = Original.of(archive), 1
    names = [f"{kind}, query of {one:g} s" for kind in ("warm", "cold") for one in config.durations]
    seconds: dict[str, list[float]] = {name: [] for name in names}
    lines: dict[str, list[Any]] = {}
    sizes: list[float] = []
    rows: list[Row] = []
    for hours in config.hours:
        done = grow(original, done, round(hours / config.hours[0]), config.seed)
        info = archive.info()
        real = info.seconds / HOUR
        found = measured(folder, config)
        figures = [median(times) for kind in ("warm", "cold") for times in found[kind]]
        for name, value in zip(names, figures, strict=True):
            seconds[name].append(value)
        sizes.append(info.size / 1e6)
        linear = seconds[names[0]][0] * hours / config.hours[0]
        worked = median(found["worked"][0])
        lines[f"{hours} hours"] = [f"{info.windows:,}", *figures, linear, worked, found["memory"], sizes[-1], sizes[-1] / real]
        note(f"... {hours} hours: " + ", ".join(f"{name} {value:.2f} s" for name, value in zip(names, figures, strict=True)))
        if hours == LARGEST:
            at = f"{hours} hours"
            kinds = [WARM] * len(config.durations) + [COLD] * len(config.durations)
            rows += [
                Row(name, at, value, goal, at_most=True, unit=" s") for name, value, goal in zip(names, figures, kinds, strict=True)
            ]
            rows.append(Row("memory beside the mapped files", at, found["memory"], MEMORY, at_most=True, unit=" MB"))
            rows.append(Row("on disk, an hour", at, sizes[-1] / real, MEGABYTE, at_most=True, unit=" MB"))
    columns = [
        "windows",
        *(f"{name} (s)" for name in names),
        "linear (s)",
        "all cores (s)",
        "memory (MB)",
        "on disk (MB)",
        "MB an hour",
    ]
    return Grid(columns, lines, rows), drawn(config.hours, seconds, sizes)


@experiment(Config(), quick={"hours": (1, 2), "queries": 1, "cold": 1}, one_thread=False)
def tables(config: Config) -> Tables:
    """Time and space of an archive that grows.

    Raises:
        ValueError: no data folder, sizes that do not grow, or a folder that holds something.
    """
    if list(config.hours) != sorted(set(config.hours)) or not config.hours or config.hours[0] < 1:
        raise ValueError(f"hours must grow, from 1 or more, got {config.hours}")
    with tempfile.TemporaryDirectory(dir=config.folder) as folder:
        table, picture = grown(config, Path(folder) / "growing.archive")
    yield f"an archive that grows, {config.threads} cores", table
    yield "archive-growth", picture
