"""Adding to an archive: seconds and bytes per hour of keypoints, and a cluster of two workers beside a pool of two processes.

    python -m experiments.benchmarks.archive

Needs no recordings: synthetic people, seen by a noisy detector, 17 joints at 30 fps.  *Adding*: one hour in one file, on one core,
from the file to the committed segment; where a detector writes a file for each frame, a part of an hour, scaled.  Processor time,
and the median over rounds in turns: others at work slow one core down.  *Two workers*: the same files added by a process pool and
by a Dask ``LocalCluster``, both running already, in turns, by the clock; and whether their archives answer all queries with the
same hits, bit for bit, whoever searches them.
"""

from __future__ import annotations

import contextlib
import json
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from experiments.common.runner import BaseConfig, Tables, experiment
from experiments.common.tables import Row, note
from experiments.common.timing import interleaved
from indexing import Archive, Clip, ClipSet
from indexing.actors import ACTIONS, Person, dataset, detect, stream
from indexing.archive.workers import QuietProcesses
from indexing.cameras import y_up

HOUR = 3600.0
FPS = 30.0
SECONDS, MEGABYTES, SHARE = 5.0, 10.0, 0.9  # goals: per hour, per hour, of the pool's speed
WORKERS = 2


@dataclass(frozen=True)
class Config(BaseConfig):
    """Speed of adding to an archive."""

    hours: float = 1.0
    """Of keypoints in a file."""
    frames: int = 5400
    """Of a recording with a file for each frame."""
    files: int = 12
    """For the two workers."""
    minutes: float = 10.0
    """Of each of these."""
    queries: int = 20
    """Asked of both archives."""
    rounds: int = 5
    """How often everything is timed."""
    dask: bool = True
    """Whether to measure a cluster, too."""


# ---- recordings --------------------------------------------------------------------------------------------------------
def recording(seconds: float, seed: int) -> Clip:
    """Somebody who does everything once, again and again; the noise is new each time."""
    rng = np.random.default_rng([seed, 0])
    solid, _ = stream([str(name) for name in rng.permutation(list(ACTIONS))], Person.random(rng), fps=FPS, rng=rng)
    seen, frames = detect(solid, azimuth=float(rng.uniform(0, 360)), rng=rng), max(2, round(seconds * FPS))
    joints = np.resize(seen.joints, (frames, *seen.joints.shape[1:]))
    joints = joints + rng.normal(0.0, 0.2, joints.shape)  # pixels
    return seen.replace(joints=joints, times=np.arange(frames) / FPS, confidence=None, label=None, name=f"recording {seed}")


def as_clip_set(clip: Clip, folder: Path) -> Path:
    """The project's own format."""
    path = folder / "hour.npz"
    ClipSet([clip]).save(path)
    return path


def _rows(clip: Clip) -> list[list[float]]:
    """x, y, confidence of all joints, a row for each frame; pixels with y down."""
    pixels = y_up(clip) * [1.0, -1.0]
    rows = np.concatenate([pixels, np.full((*pixels.shape[:2], 1), 0.9)], axis=2).reshape(len(clip), -1)
    rows[np.isnan(rows)] = 0.0
    return [[float(value) for value in row] for row in rows.round(2)]


def as_coco(clip: Clip, folder: Path) -> Path:
    """What COCO's results look like: one list of all detections."""
    path = folder / "hour.json"
    found = [{"image_id": i, "category_id": 1, "keypoints": row, "score": 0.9} for i, row in enumerate(_rows(clip))]
    path.write_text(json.dumps(found))
    return path


def as_openpose(clip: Clip, folder: Path) -> Path:
    """What OpenPose writes: a file for each frame."""
    path = folder / "hour"
    path.mkdir()
    for i, row in enumerate(_rows(clip)):
        people = [{"person_id": [-1], "pose_keypoints_2d": row}]
        (path / f"camera_{i:012d}_keypoints.json").write_text(json.dumps({"version": 1.3, "people": people}))
    return path


# ---- adding ------------------------------------------------------------------------------------------------------------
def added(folder: Path, sources: Any, executor: Executor | None = None) -> Archive:
    """A new archive.

    Raises:
        ValueError: something could not be added.
    """
    archive = Archive(folder)
    failed = archive.add(sources, executor=executor).failures
    if failed:
        raise ValueError(f"could not be added: {failed[0].reason}")
    return archive


def fresh(folder: Path) -> Iterator[Path]:
    """Folders that are not there yet, one after the other; of those before only the last stays."""
    last: Path | None = None
    for number in count():
        if last is not None:
            shutil.rmtree(last, ignore_errors=True)
        last = folder / f"{number}.archive"
        yield last


def adding(config: Config) -> list[Row]:
    """Seconds and megabytes per hour, on one core."""
    writers: dict[str, tuple[Callable[[Clip, Path], Path], int]] = {
        "clip set (.npz)": (as_clip_set, round(config.hours * HOUR * FPS)),
        "COCO results (one .json)": (as_coco, round(config.hours * HOUR * FPS)),
        "OpenPose (a .json for each frame)": (as_openpose, config.frames),
    }
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        paths: dict[str, Path] = {}
        hours: dict[str, float] = {}
        names: dict[str, Iterator[Path]] = {}
        for name, (write, frames) in writers.items():
            note(f"... writing {name}")
            where = Path(folder) / f"{len(paths)}"
            (where / "in").mkdir(parents=True)
            paths[name] = write(recording(frames / FPS, config.seed), where / "in")
            hours[name], names[name] = frames / FPS / HOUR, fresh(where)
        seconds: dict[str, list[float]] = {name: [] for name in paths}
        for number in range(config.rounds + 1):
            note(f"... adding, round {number} of {config.rounds}" + ", which does not count" * (number == 0))
            for name, path in paths.items():
                begin = time.process_time()
                added(next(names[name]), path)
                seconds[name].append((time.process_time() - begin) / hours[name])
        for name, values in seconds.items():
            rows.append(Row(name, "adding an hour, one core", median(values[1:]), SECONDS, at_most=True, unit=" s"))
        archive = added(Path(folder) / "size.archive", paths["clip set (.npz)"])
        info = archive.info()
    rows.append(Row("archive", "on disk, an hour", info.size / 1e6 / (info.seconds / HOUR), MEGABYTES, at_most=True, unit=" MB"))
    return rows


# ---- two workers -------------------------------------------------------------------------------------------------------
@contextlib.contextmanager
def cluster() -> Iterator[Executor]:
    """A Dask cluster on this machine, as an executor.

    Raises:
        ValueError: Dask is not installed.
    """
    try:
        from distributed import Client, LocalCluster
    except ImportError:
        raise ValueError("dask is not installed; pip install 'dyntorch[cluster]', or give --no-dask") from None
    with (
        LocalCluster(n_workers=WORKERS, threads_per_worker=1, processes=True, dashboard_address=None) as local,
        Client(local) as client,
        client.get_executor() as executor,
    ):
        yield executor


def two_workers(config: Config) -> list[Row]:
    """Adding by each kind of workers, and whether their archives answer alike."""
    with tempfile.TemporaryDirectory() as name, contextlib.ExitStack() as stack:
        folder = Path(name)
        (folder / "in").mkdir()
        note(f"... writing {config.files} files")
        for i in range(config.files):
            ClipSet([recording(60 * config.minutes, config.seed + 1 + i)]).save(folder / "in" / f"{i:03d}.npz")
        executors: dict[str, Executor] = {"process pool": stack.enter_context(QuietProcesses(WORKERS))}
        if config.dask:
            executors["Dask"] = stack.enter_context(cluster())
        for kind in executors:
            (folder / kind).mkdir()
        names = {kind: fresh(folder / kind) for kind in executors}
        runs = {kind: (lambda kind=kind: added(next(names[kind]), folder / "in", executors[kind])) for kind in executors}
        note("... adding")
        seconds = interleaved(runs, config.rounds)
        archives = {kind: added(folder / f"{kind}.archive", folder / "in", executor) for kind, executor in executors.items()}
        archives["this process"] = added(folder / "alone.archive", folder / "in")
        equal = agreement(archives, executors, config)
    setting = f"{config.files} files of {config.minutes:g} min, {WORKERS} workers"
    rows = [Row(f"adding, {kind}", setting, value, unit=" s") for kind, value in seconds.items()]
    if config.dask:
        rows.append(Row("adding, Dask", "speed, in that of the pool", seconds["process pool"] / seconds["Dask"], SHARE))
    rows.append(Row("the same hits, bit for bit", f"{config.queries} queries, whoever added and searches", equal, 1.0))
    return rows


def agreement(archives: dict[str, Archive], executors: dict[str, Executor], config: Config) -> float:
    """Share of the queries that every archive answers alike, searched by every kind of workers."""
    clips = dataset(max(1, -(-config.queries // len(ACTIONS))), azimuth=30.0, rng=config.seed + 99)[: config.queries]
    alike = 0
    for clip in clips:
        searchers = (None, *executors.values())
        answers = [archive.search(clip, executor=one) for archive in archives.values() for one in searchers]
        alike += bool(answers[0]) and all(answer == answers[0] for answer in answers)
    return alike / len(clips)


@experiment(Config(), quick={"hours": 0.05, "frames": 90, "files": 2, "minutes": 0.5, "queries": 2, "rounds": 1, "dask": False})
def tables(config: Config) -> Tables:
    """Adding by one process and by two workers."""
    yield "Adding to an archive", adding(config)
    yield "Two workers", two_workers(config)
