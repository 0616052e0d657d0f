"""An archive that is killed: adders and workers at random moments, full disks, several adders at once, and what is left of it.

    python -m experiments.archive.killed --kills 50

Every addition begins from the same archive of a few recordings, in a process of its own that commits after every source and puts
small segments together, so that a random moment often meets a commit.  Afterwards the archive is verified, asked for what it held
before, and the same addition is run again, undisturbed.  Then it must be what one is that nobody disturbed: the same recordings,
each once, with the same windows, and the same hits, bit for bit.

*Lost*, *twice*: windows, after the second addition.  *Unreadable*: archives that did not verify, or did not find a recording that
they held before, right after the disturbance.
"""

from __future__ import annotations

import errno
import multiprocessing
import os
import shutil
import signal
import subprocess
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cached_property
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common.runner import BaseConfig, Grid, Tables, experiment
from experiments.common.tables import Row, note
from indexing import Archive, ArchiveOptions, Clip, ClipSet
from indexing.archive.catalogue import Catalogue
from indexing.archive.search import Hit
from indexing.archive.workers import QuietProcesses

OPTIONS = ArchiveOptions(commit_seconds=0.0, max_small_segments=3)  # commits after every source, and puts four segments together
PATIENCE = 120.0  # seconds for a process that is not killed
TRIES = 4  # for each adder to be signalled before it has ended
PAGE = 4096  # bytes of a disk that are written at once
COLUMNS = ("times", "disturbed", "sources kept", "leftovers", "unreadable", "lost", "twice", "other hits")


@dataclass(frozen=True)
class Config(BaseConfig):
    """What is left of an archive whose adders are killed."""

    kills: int = 50
    """Adders that are killed (-9); a fifth as many of each of the others."""
    sources: int = 24
    """That are added each time."""
    seconds: float = 8.0
    """Of each."""


# ---- what is added -------------------------------------------------------------------------------------------------------
def movement(seed: int, seconds: float, name: str = "") -> Clip:
    """Seventeen joints that swing, each in its way."""
    rng = np.random.default_rng([seed, 7])
    t = np.arange(int(seconds * 30))[:, None, None] / 30
    still, size, phase, pace = (rng.normal(size=(1, 17, 2)) for _ in range(4))
    joints = 300 * still + 60 * size * np.sin(2 * np.pi * t * (0.6 + 0.2 * pace) + 3 * phase) + 20 * t
    return Clip(joints, fps=30.0, name=name or f"movement {seed}", up="-y")


class Deadly(Clip):
    """A clip that kills whoever is sent it."""

    def __reduce__(self) -> Any:
        return signal.raise_signal, (signal.SIGKILL,)


@dataclass(frozen=True)
class Stage:
    """Files to add, an archive that holds others already, and what it is like when nobody disturbs it."""

    folder: Path
    seconds: float

    @classmethod
    def build(cls, folder: Path, sources: int, seconds: float) -> Stage:
        """Written once, copied for every trial."""
        (folder / "new").mkdir(parents=True)
        for number in range(sources):
            ClipSet([movement(number, seconds)]).save(folder / "new" / f"{number:03d}.npz")
        stage = cls(folder, seconds)
        for number, name in enumerate(stage.earlier):
            Archive(folder / "base", OPTIONS).add(movement(1000 + number, seconds, name))
        shutil.copytree(folder / "base", folder / "whole")
        Archive(folder / "whole", OPTIONS).add(stage.new)
        return stage

    @property
    def new(self) -> Path:
        """The folder that is added."""
        return self.folder / "new"

    @property
    def earlier(self) -> tuple[str, ...]:
        """Names of what the archive holds already."""
        return "monday", "tuesday"

    def copy(self, folder: Path | None = None) -> Path:
        """An archive to disturb, in the place of the last one."""
        target = (folder or self.folder) / "disturbed"
        shutil.rmtree(target, ignore_errors=True)
        shutil.copytree(self.folder / "base", target)
        return target

    def questions(self) -> list[Clip]:
        """One for each earlier recording, and one for the first of the new ones."""
        moments = [movement(1000 + number, self.seconds) for number in range(len(self.earlier))]
        return [clip.between(2.0, 3.5) for clip in (*moments, movement(0, self.seconds))]

    @cached_property
    def expected(self) -> tuple[Counter[tuple[str, int]], list[list[Hit]]]:
        """Of the archive that nobody disturbed: windows of every recording, and all hits."""
        return contents(self.folder / "whole"), self.hits(self.folder / "whole")

    def hits(self, folder: Path) -> list[list[Hit]]:
        """The best five of every question."""
        return [Archive(folder).search(clip, k=5) for clip in self.questions()]


def contents(folder: Path) -> Counter[tuple[str, int]]:
    """Every recording with its windows."""
    return Counter((row.name, row.windows) for row in Catalogue(folder).moment()[1])


# ---- what is left --------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Trial:
    """One disturbance.

    disturbed: whether it came while sources were added; kept: new sources in the archive right after it; leftovers: files that
    belong to nothing; problems: what was wrong right after it; lost, twice: windows after adding again; changed: whether hits
    differ then.
    """

    disturbed: bool
    kept: int
    leftovers: int
    problems: tuple[str, ...]
    lost: int
    twice: int
    changed: bool


def aftermath(stage: Stage, folder: Path, disturbed: bool, problems: Sequence[str] = ()) -> Trial:
    """Look at what is left, add again, and look again."""
    found = [*problems, *readable(stage, folder)]
    checked, kept = Archive(folder).verify(), len(contents(folder)) - len(stage.earlier)
    done = Archive(folder, OPTIONS).add(stage.new)
    found += [one.reason for one in done.failures]
    after = Archive(folder).verify()
    found += [f"after adding again: {problem}" for problem in (*after.problems, *after.orphans)]
    (expected, hits), now = stage.expected, contents(folder)
    lost, twice = (sum(windows * count for (_, windows), count in some.items()) for some in (expected - now, now - expected))
    return Trial(disturbed, kept, len(checked.orphans), tuple(found), lost, twice, stage.hits(folder) != hits)


def readable(stage: Stage, folder: Path) -> list[str]:
    """What is wrong with an archive, and with its answers about what it held before."""
    try:
        archive = Archive(folder)
        found = list(archive.verify().problems)
        for name, clip in zip(stage.earlier, stage.questions(), strict=False):
            best = archive.search(clip, k=1)[0]
            if best.source != name:
                found.append(f"{best.source} instead of {name}")
        return found
    except (ValueError, OSError, KeyError, IndexError) as problem:
        return [f"{type(problem).__name__}: {problem}"]


# ---- adders in processes of their own ------------------------------------------------------------------------------------
def forkserver() -> Any:
    """Where processes come from: one that has imported everything, and has no threads."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(
        ["experiments.common.runner", "indexing.archive.archive", "indexing.readers.formats.clipset", "indexing.recordings.people"]
    )
    return context


def adding(folder: Path, sources: Sequence[Any], say: Connection) -> None:
    """What an adder does: say that it is there, wait until it may, add, say how it went."""
    say.send("ready")
    try:
        say.recv()
        done = Archive(folder, OPTIONS).add(sources)
        say.send([one.outcome for one in done.sources])
    except ValueError as problem:
        say.send(f"ValueError: {problem}")
    except KeyboardInterrupt:
        say.send("interrupted")


@dataclass(frozen=True, eq=False)
class Adder:
    """A process that adds."""

    process: Any
    heard: Connection

    @classmethod
    def start(cls, folder: Path, sources: Sequence[Any], wait: bool = False) -> Adder:
        """It begins when this returns, or waits until it may go."""
        context = forkserver()
        heard, say = context.Pipe()
        process = context.Process(target=adding, args=(folder, sources, say))
        process.start()
        say.close()
        assert heard.recv() == "ready"
        made = cls(process, heard)
        if not wait:
            made.go()
        return made

    def go(self) -> None:
        """Add."""
        self.heard.send("go")

    def end(self) -> Any:
        """What it said last; nothing where it was killed before."""
        said = None
        with suppress(EOFError, ConnectionResetError):
            while self.heard.poll(PATIENCE):
                said = self.heard.recv()
        self.process.join(PATIENCE)
        return said


def span(stage: Stage) -> float:
    """Seconds of an addition that nobody disturbs, its process already warm."""
    times = []
    for _ in range(2):
        adder, began = Adder.start(stage.copy(), [stage.new]), time.perf_counter()
        adder.end()
        times.append(time.perf_counter() - began)
    return min(times)


def signalled(stage: Stage, times: int, rng: np.random.Generator, number: signal.Signals) -> list[Trial]:
    """Adders that get a signal at a random moment; one that had ended by then counts for nothing."""
    lasts, trials = span(stage), list[Trial]()
    for _ in range(TRIES * times):
        if len(trials) == times:
            break
        folder = stage.copy()
        adder = Adder.start(folder, [stage.new])
        time.sleep(float(rng.uniform(0, lasts)))
        with suppress(ProcessLookupError):
            os.kill(adder.process.pid, number)
        if adder.end() in (None, "interrupted"):
            trials.append(aftermath(stage, folder, disturbed=True))
    return trials


def interrupted(stage: Stage, times: int, rng: np.random.Generator) -> list[Trial]:
    """Ctrl-C."""
    return signalled(stage, times, rng, signal.SIGINT)


def killed(stage: Stage, times: int, rng: np.random.Generator) -> list[Trial]:
    """SIGKILL."""
    return signalled(stage, times, rng, signal.SIGKILL)


def at_once(stage: Stage, times: int, rng: np.random.Generator) -> list[Trial]:
    """Two adders of the same sources; the one that comes second is told so in one line, or finds all of them known."""
    lasts, trials = span(stage), []
    for _ in range(times):
        folder = stage.copy()
        first, second = (Adder.start(folder, [stage.new], wait=True) for _ in range(2))
        first.go()
        time.sleep(float(rng.uniform(0, 0.8 * lasts)))
        second.go()
        said = [first.end(), second.end()]
        refused = [one for one in said if isinstance(one, str)]
        wrong = [one for one in refused if "is locked" not in one or "\n" in one]
        trials.append(aftermath(stage, folder, disturbed=bool(refused), problems=wrong))
    return trials


def asked_meanwhile(stage: Stage, times: int, rng: np.random.Generator) -> list[Trial]:
    """Somebody asks and verifies all the time while others add."""
    trials = []
    for _ in range(times):
        folder, problems = stage.copy(), list[str]()
        time.sleep(float(rng.uniform(0, 0.01)))
        adder = Adder.start(folder, [stage.new])
        while adder.process.is_alive():
            problems += readable(stage, folder)
        said = adder.end()
        problems += [] if isinstance(said, list) else [f"who adds said {said!r}"]
        trials.append(aftermath(stage, folder, disturbed=True, problems=problems))
    return trials


# ---- workers -------------------------------------------------------------------------------------------------------------
def workers_killed(stage: Stage, times: int, rng: np.random.Generator) -> list[Trial]:
    """One of two workers is killed at a random moment."""
    lasts, trials = span(stage), []
    for _ in range(times):
        folder = stage.copy()
        with QuietProcesses(2) as pool:
            for ready in [pool.submit(time.sleep, 0.2) for _ in range(2)]:
                ready.result()
            victim = int(rng.choice(sorted(pool._processes)))
            timer = threading.Timer(float(rng.uniform(0, lasts)), os.kill, (victim, signal.SIGKILL))
            timer.start()
            done = Archive(folder, OPTIONS).add(stage.new, executor=pool)
            timer.cancel()
            disturbed = bool(getattr(pool, "_broken", False))
        problems = [one.reason for one in done.failures]
        trials.append(aftermath(stage, folder, disturbed, problems))
    return trials


def deadly_sources(stage: Stage, times: int, rng: np.random.Generator) -> list[Trial]:
    """A source kills every worker that reads it: it is reported, the others are all there."""
    trials = []
    for _ in range(times):
        folder = stage.copy()
        files = sorted(stage.new.iterdir())
        deadly = Deadly(movement(9, 2.0).joints, name="deadly")
        given: list[Any] = [*files]
        given.insert(int(rng.integers(len(files) + 1)), deadly)
        with QuietProcesses(2) as pool:
            done = Archive(folder, OPTIONS).add(given, executor=pool)
        failed = [one.source for one in done.failures]
        problems = [] if failed == ["deadly"] else [f"failed: {failed}"]
        kept = len(contents(folder)) - len(stage.earlier)
        trial = aftermath(stage, folder, True, problems)
        trials.append(replace(trial, problems=trial.problems if kept == len(files) else (*trial.problems, "others are missing")))
    return trials


# ---- a full disk ---------------------------------------------------------------------------------------------------------
@contextmanager
def disk(folder: Path, size: int) -> Iterator[Path]:
    """A small file system in memory.

    Raises:
        PermissionError: this user may mount nothing.
    """
    folder.mkdir(exist_ok=True)
    words = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
    if not shutil.which("mount") or subprocess.run(words, capture_output=True, check=False).returncode:
        raise PermissionError(errno.EPERM, "may not mount a file system")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


def fill(path: Path, free: int) -> None:
    """Take all of a disk but some bytes."""
    with open(path, "wb", buffering=0) as stream, suppress(OSError):
        while stream.write(b"\0" * PAGE):
            pass
    os.truncate(path, max(0, path.stat().st_size - free))


def disk_full(stage: Stage, times: int, rng: np.random.Generator) -> list[Trial]:
    """The disk is full at some moment of the addition: one line, and what was there can be read."""
    needed = sum(one.stat().st_size for one in (stage.folder / "whole").rglob("*") if one.is_file())
    trials = []
    for number in range(times):
        with disk(stage.folder / "disk", 4 * needed) as mounted:
            folder = stage.copy(mounted)
            fill(mounted / "others", int(rng.uniform(0, 1.2 * needed)) * (number > 0))
            said = Adder.start(folder, [stage.new]).end()
            problems = [] if isinstance(said, list) or (said and "\n" not in said) else [f"said {said!r}"]
            problems += readable(stage, folder)
            (mounted / "others").unlink()
            trials.append(aftermath(stage, folder, isinstance(said, str), problems))
    return trials


# ---- the table -----------------------------------------------------------------------------------------------------------
DISTURBANCES: Mapping[str, Callable[[Stage, int, np.random.Generator], list[Trial]]] = {
    "adder killed (-9)": killed,
    "adder interrupted (Ctrl-C)": interrupted,
    "one of two workers killed": workers_killed,
    "a source that kills its workers": deadly_sources,
    "disk full": disk_full,
    "two adders at once": at_once,
    "asked while somebody adds": asked_meanwhile,
}


def summed(trials: Sequence[Trial]) -> list[Any]:
    """The line of a disturbance."""
    kept = sorted(trial.kept for trial in trials)
    return [
        len(trials), sum(trial.disturbed for trial in trials), f"{kept[0]} to {kept[-1]}", sum(trial.leftovers for trial in trials),
        sum(bool(trial.problems) for trial in trials), sum(trial.lost for trial in trials), sum(trial.twice for trial in trials),
        sum(trial.changed for trial in trials),
    ]  # fmt: skip


@experiment(Config(), quick={"kills": 2, "sources": 4}, one_thread=False)
def tables(config: Config) -> Tables:
    """What is left of an archive whose adders are killed."""
    lines, rows = dict[str, list[Any]](), list[Row]()
    with tempfile.TemporaryDirectory() as folder:
        stage = Stage.build(Path(folder), config.sources, config.seconds)
        for place, (name, disturb) in enumerate(DISTURBANCES.items()):
            times = config.kills if place == 0 else -(-config.kills // 5)
            try:
                trials = disturb(stage, times, np.random.default_rng([config.seed, place]))
            except PermissionError as problem:
                lines[name] = [f"not tried: {problem.strerror}", *[""] * (len(COLUMNS) - 1)]
                continue
            for line in dict.fromkeys(one for trial in trials for one in trial.problems):
                note(f"{name}: {line}")
            lines[name] = summed(trials)
            note(f"... {name}: {lines[name]}")
            wrong = sum(trial.lost + trial.twice + len(trial.problems) + trial.changed for trial in trials)
            rows.append(Row(name, "windows lost or twice, archives unreadable, hits that differ", wrong, 0, at_most=True))
    yield f"{config.sources} sources added to an archive, disturbed at random moments", Grid(COLUMNS, lines, rows)
