"""``dyntorch archive add | search | find | info | verify | remove``: where else anybody did this."""

from __future__ import annotations

import contextlib
import dataclasses
import multiprocessing
import os
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import torch

from indexing import Archive
from indexing.action.indexer import ActionIndexer
from indexing.archive.archive import ArchiveInfo
from indexing.archive.sources import ArchiveSource, gather, stamp
from indexing.archive.workers import QuietProcesses
from indexing.archive.writer import Addition
from indexing.cli.commands.scan import exemplars, within_label
from indexing.cli.console import (
    check_report,
    complain,
    count,
    names,
    one_line,
    present,
    progress,
    say,
    show,
    table,
)
from indexing.cli.flags.recognition import Add, Find, Info, Remove, Search, Verify
from indexing.cli.flags.shared import Example, Following, Reading
from indexing.cli.inputs import assumed_rate_notes, clip_notes, crop_example, parse_example, read_clips, watch_videos
from indexing.cli.protocol import choose, field_values
from indexing.cli.videos import watch_options
from indexing.clip import Clip, ClipSet
from indexing.files import manifest, to_json_types
from indexing.modelfile import model_kind
from indexing.report.archive import FILES, FindReport, SearchReport, size_text, summarize_info, summarize_verification
from indexing.report.recognition import duration

PROBLEMS, INTERRUPTED = 2, 130  # exit codes
# up to these one process is done before others, which take some 8 s to start on two cores, could have helped
MAX_SOURCES_ALONE = 1000  # recordings to add
MAX_BYTES_ALONE = 2**28  # of recordings to add
MAX_SECONDS_ALONE = 5400.0  # of recordings in which actions are searched
CLUSTER_TIMEOUT = 5  # seconds for a cluster to answer
SHUTDOWN_TIMEOUT = 1.0  # seconds for a process to end by itself after an interruption


def add(flags: Add) -> int:
    """Read what is new, and say what became of it."""
    if not flags.sources:
        raise ValueError("no sources; give keypoint files, clip sets, or folders that hold them")
    check_workers(flags.workers, flags.dask)
    with progress("looking for recordings", steps=False):
        archive = Archive(_absolute(flags.archive) if flags.dask else flags.archive)
        given = [_absolute(path) if flags.dask else path for path in flags.sources]
        found = gather(given)
        alone = flags.workers is None and _soon(found)
    before, started = len(archive), time.perf_counter()
    try:
        with workforce(1 if alone else flags.workers, flags.dask, len(found)) as executor, progress("adding") as bar:
            done = archive.add(given, executor, bar, _options(flags.reading))
    except KeyboardInterrupt:
        complain(f"interrupted; {_kept_text(archive, before)}")
        return INTERRUPTED
    _added_show(done)
    say(f"{archive.path}: {size_text(archive.info())}; took {time.perf_counter() - started:.1f} s")
    for failure in done.failures:
        complain(f"failed: {failure.reason or failure.source}")
    fine = bool(done.of("added") or done.of("replaced")) and not flags.strict
    return PROBLEMS if done.failures and not fine else 0


def search(flags: Search) -> int:
    """Search, print the hits, write the report."""
    check_workers(flags.workers, flags.dask)
    example = _example(flags.example)
    folder = check_report(flags.report, [example.path], FILES)
    with progress("loading", steps=False):
        archive = Archive(_absolute(flags.archive) if flags.dask else flags.archive)
        reading = watch_videos(flags.reading, [example.path], flags.report)
        clip, notes = read_query(example, reading, flags.select)
        notes = [*reading.watched.notes, *notes]
    started = time.perf_counter()
    with workforce(flags.workers, flags.dask, threads=True) as executor, progress("searching") as bar:
        hits = archive.search(clip, flags.k, executor, bar, flags.mirror)
    seconds, info = time.perf_counter() - started, archive.info()
    about = {} if folder is None else _manifest("search", flags, [example.path], archive, info, {"search": seconds})
    return present(SearchReport(clip, hits, archive, info, notes, seconds, flags.mirror, about), folder)


def find(flags: Find) -> int:
    """Search everything, count, write the report."""
    check_workers(flags.workers, flags.dask)
    folder = check_report(flags.report, [flags.model], FILES)
    with progress("loading", steps=False):
        archive = Archive(_absolute(flags.archive) if flags.dask else flags.archive)
        info = archive.info()
        if model_kind(flags.model) == "dyntorch.brightness-indexer":
            raise ValueError(f"{flags.model}: was learned from videos, and archives hold keypoints; learn from keypoint files")
        indexer = ActionIndexer.load(flags.model.expanduser())
    if flags.reject is not None:
        indexer.set_params(reject=flags.reject)
    started = time.perf_counter()
    workers = 1 if flags.workers is None and info.seconds <= MAX_SECONDS_ALONE else flags.workers
    with workforce(workers, flags.dask, info.recordings) as executor, progress("searching") as bar:
        events = archive.find(indexer, executor, bar)
    seconds = time.perf_counter() - started
    about = {} if folder is None else _manifest("find", flags, [flags.model], archive, info, {"find": seconds})
    named = [dataclasses.replace(event, exemplar=within_label(indexer, event.exemplar)) for event in events]
    classes = [str(label) for label in indexer.classes_]
    examples = {} if folder is None else exemplars(indexer)
    recordings = archive.recordings()
    report = FindReport(classes, named, recordings, archive, info, examples, seconds=seconds, manifest=about)
    return present(report, folder)


def info(flags: Info) -> int:
    """Count, and list."""
    with progress("counting", steps=False):
        archive = Archive(flags.archive)
        summary = summarize_info(archive.info(), archive.recordings() if flags.sources else None)
    show(summary)
    return 0


def verify(flags: Verify) -> int:
    """Check, and say what is wrong, with what to do about it."""
    with progress("reading everything", steps=False):
        found = Archive(flags.archive).verify()
    for problem in found.problems:
        complain(problem)
    show(summarize_verification(found))
    return 0 if found.ok else PROBLEMS


def remove(flags: Remove) -> int:
    """Remove one after the other; what is not there is said, and the others are removed all the same."""
    if not flags.sources:
        raise ValueError("no sources; give the names or paths of those to remove")

    archive, code = Archive(flags.archive), 0
    archive.info()  # says what is wrong with the archive, before its sources are blamed
    for source in flags.sources:
        try:
            say(f"{source}: {count(archive.remove(source), 'recording')} removed")
        except ValueError as problem:
            complain(str(problem))
            code = PROBLEMS
    return code


# ---- who does the work ---------------------------------------------------------------------------------------------------
def check_workers(workers: int | None, dask: str | None) -> None:
    """Raise where the flags contradict each other or make no sense."""
    if workers is not None and workers < 1:
        raise ValueError(f"--workers {workers}: expected 1 or more; leave it out for as many as there are cores")
    if workers is not None and dask is not None:
        raise ValueError("--workers and --dask: a cluster has its own workers; leave one of them out")


def workforce(
    workers: int | None, dask: str | None, tasks: int | None = None, threads: bool = False
) -> AbstractContextManager[Executor | None]:
    """Who does the work: a cluster, threads or processes; ``None`` where this process is as quick by itself."""
    if dask is not None:
        return _cluster(dask)
    if threads:
        return (
            contextlib.nullcontext()
            if workers is None
            else ThreadPoolExecutor(workers, initializer=torch.set_num_threads, initargs=(1,))
        )
    number = min(workers or os.cpu_count() or 1, tasks or 1)
    return contextlib.nullcontext() if number == 1 else _processes(number)


@contextmanager
def _processes(workers: int) -> Iterator[Executor]:
    """A pool that ends with the work, or soon after an interruption."""
    others = set(multiprocessing.active_children())
    pool = QuietProcesses(workers)
    try:
        yield pool
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        for child in set(multiprocessing.active_children()) - others:
            child.join(SHUTDOWN_TIMEOUT)  # a pool must have dropped what nobody began before its processes are ended, or it hangs
            child.terminate()
        raise
    pool.shutdown()


@contextmanager
def _cluster(address: str) -> Iterator[Executor]:
    """The workers of a Dask cluster."""
    try:
        from dask.distributed import Client
    except ImportError:
        raise ValueError(f'--dask {address}: needs Dask, which is not installed: pip install "dyntorch[cluster]"') from None
    try:
        client: Any = Client(address, timeout=CLUSTER_TIMEOUT)
    except Exception as problem:  # whatever answers at an address where no scheduler runs: a web server's answer is taken for sizes
        said = one_line(problem) or type(problem).__name__
        raise ValueError(f"--dask {address}: {said}; give the address of a scheduler that runs, such as tcp://head:8786") from None
    try:
        if not client.scheduler_info()["workers"]:
            raise ValueError(f"--dask {address}: the cluster has no workers; start some with dask worker {address}")
        yield client.get_executor()
    finally:
        client.close(timeout=CLUSTER_TIMEOUT)


# ---- what is read --------------------------------------------------------------------------------------------------------
def _absolute(path: Path) -> Path:
    """As whoever works elsewhere finds it."""
    return path.expanduser().absolute()


def _soon(sources: Sequence[ArchiveSource]) -> bool:
    """Whether one process has read all before others could have helped."""
    size = 0
    for source in sources:
        with contextlib.suppress(OSError, ValueError):  # said when it is read
            size += stamp(source).size
    return len(sources) <= MAX_SOURCES_ALONE and size <= MAX_BYTES_ALONE


def _options(reading: Following) -> dict[str, Any]:
    """The flags that were given, as arguments of :func:`indexing.readers.read`: whoever adds without them reads alike."""
    usual = Following()
    if reading.footage.by == "pixels" or reading.footage.poses is not None:
        flag = "--by pixels" if reading.footage.by == "pixels" else f"--poses {reading.footage.poses}"
        raise ValueError(f"{flag}: an archive holds keypoints, and keeps those of videos itself; leave it out")
    names_of = [each.name for each in dataclasses.fields(reading) if each.name not in ("footage", "watched")]
    found = {name: getattr(reading, name) for name in names_of if getattr(reading, name) != getattr(usual, name)}
    return found if reading.footage == usual.footage else {**found, "watching": watch_options(reading.footage)}


def _example(text: str) -> Example:
    """``file`` or ``file@2.1-3.0``; a label, as ``dyntorch index fit`` wants one, is no hindrance."""
    found = parse_example(text)
    whole = Path(f"{found.label}={found.path}")
    return dataclasses.replace(found, path=whole) if found.label is not None and whole.expanduser().exists() else found


def read_query(example: Example, reading: Reading, select: Sequence[str]) -> tuple[Clip, list[str]]:
    """The one clip that is asked for, named as it was given, and what a reader should know of it."""
    clips = every = read_clips(reading, example.path)
    named, fields = [word[5:] for word in select if word[:5] == "name="], [word for word in select if word[:5] != "name="]
    if named:
        clips = clips[[i for i, clip in enumerate(every) if clip.name in named]]
        if not clips:
            have = names([clip.name for clip in every])
            raise ValueError(f"--select name={named[0]}: {example.path} has no such clip; it holds {have}")
    if fields:
        clips = clips[choose(clips, fields, "--select")]
    if len(clips) != 1:
        several = f"{example.path}: holds {count(len(clips), 'clip')}, and one is asked for"
        raise ValueError(f"{several}; choose it with --select name=NAME, or by a field; {field_values(clips)}")
    name = example.path.name if len(every) == 1 else f"{example.path.name}: {clips[0].name}"
    clip = clips[0].replace(name=name)
    notes = clip_notes([clip], reading) + assumed_rate_notes([clip])
    if example.start is None and example.end is None:
        return clip, notes
    (part,), cut = crop_example(ClipSet([clip]), example)
    return part.replace(name=f"{name}, {part.times[0]:.6g} to {part.times[-1]:.6g} s"), notes + cut


# ---- what is printed -----------------------------------------------------------------------------------------------------
def _kept_text(archive: Archive, before: int) -> str:
    """What an interrupted addition leaves."""
    again = "the same command goes on from there"
    try:
        info = archive.info()
    except ValueError:
        return f"nothing was added yet; {again}"
    new = max(0, info.windows - before)
    return f"the archive is whole: {size_text(info)}, {count(new, 'window')} of it new; {again}"


def _added_show(done: Addition) -> None:
    rows = []
    for outcome in ("added", "replaced", "known", "left out", "failed"):
        some = done.of(outcome)
        if some:
            fresh = outcome in ("added", "replaced")
            windows, seconds = sum(one.windows for one in some), sum(one.seconds for one in some)
            rows.append([outcome, f"{len(some):,}", f"{windows:,}" if fresh else "", duration(seconds) if fresh else ""])
    table(["", "sources ", "windows ", "time "], rows)
    reasons: dict[str, list[str]] = {}
    for one in done.sources:
        if one.reason and one.outcome in ("added", "replaced", "left out"):
            reasons.setdefault(f"{one.reason}{', left out' * (one.outcome == 'left out')}", []).append(one.source)
    for reason, sources in reasons.items():
        say(f"note: {reason}: {names(sources)}")


def _manifest(
    verb: str, command: Any, inputs: Sequence[Path], archive: Archive, info: ArchiveInfo, timings: dict[str, float]
) -> dict[str, Any]:
    """How a report came about; of the archive what it held, not the hash of gigabytes."""
    made = manifest(
        {"command": f"archive {verb}", **dataclasses.asdict(command)}, [path.expanduser() for path in inputs], timings=timings
    )
    return {**made, "archive": {"path": str(archive.path), **to_json_types(info)}}
