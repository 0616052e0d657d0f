"""What became of a damaged file: read, refused in one clear line, or something that must not be."""

from __future__ import annotations

import contextlib
import io
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

from tests.fuzz.mutations import mutate
from tests.fuzz.seeds import Seed

LONGEST = 400  # characters of a message, less the path
SLOW = 10.0  # seconds of one core
STUCK = 120  # seconds by the clock, after which waiting is hanging
MEMORY = 500  # MB above the file's size
GOOD = ("read", "refused")
BAD = ("poor", "warning", "uncaught", "slow", "memory")


class Hang(BaseException):
    """Raised into a reading that takes too long; no reader catches it."""


@dataclass(frozen=True)
class Outcome:
    """What one file did."""

    kind: str
    seed: str
    number: int
    damage: str
    said: str = ""
    where: str = ""


@contextlib.contextmanager
def limited() -> Iterator[None]:
    """An end to what takes too long, by the processor's time and by the clock."""

    def stop(*_: Any) -> None:
        raise Hang

    before = [(kind, signal.signal(kind, stop)) for kind in (signal.SIGPROF, signal.SIGALRM)]
    signal.setitimer(signal.ITIMER_PROF, SLOW)
    signal.setitimer(signal.ITIMER_REAL, STUCK)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.setitimer(signal.ITIMER_REAL, 0)
        for kind, handler in before:
            signal.signal(kind, handler)


def capped(megabytes: int = 4000) -> None:
    """Keep a file that asks for the whole memory from taking it: that is a MemoryError, and reported."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + megabytes * 2**20, resource.RLIM_INFINITY))


def peak(reset: bool = False) -> float:
    """The most memory that the process had since the last reset, in MB; 0 where the system does not tell."""
    try:
        if reset:
            Path("/proc/self/clear_refs").write_text("5")
        found = re.search(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text())
        return int(found[1]) / 1024 if found else 0.0
    except OSError:
        return 0.0


def damaged(seed: Seed, number: int, folder: Path) -> tuple[Path, str]:
    """A damaged copy of a seed in an emptied folder, and what was done to it: the same for the same number."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    path = folder / seed.path.name
    if seed.path.is_dir():
        shutil.copytree(seed.path, path)
    else:
        shutil.copyfile(seed.path, path)
    rng = Random(f"{seed.name} {number}")
    return path, mutate(path, rng)


def size_of(path: Path) -> float:
    files = path.iterdir() if path.is_dir() else [path]
    with contextlib.suppress(OSError):
        return sum(os.lstat(file).st_size for file in files) / 2**20
    return 0.0


def tried(seed: Seed, number: int, folder: Path, action: Callable[[Path], str | None] | None = None) -> Outcome:
    """Read one damaged copy, and say what became of it.

    Args:
        action: what is done with it instead of ``seed.read``; the text that it returns is a complaint.
    """
    path, damage = damaged(seed, number, folder)
    size, before, begun = size_of(path), peak(reset=True), time.process_time()
    heard: list[Any] = []

    def outcome(kind: str, said: str = "", where: str = "") -> Outcome:
        return Outcome(kind, seed.name, number, damage, said, where)

    try:
        with warnings.catch_warnings(record=True) as heard, limited():
            warnings.simplefilter("always")
            warnings.filterwarnings("ignore", "`torch.jit.script` is deprecated")  # torch's own, when it first loads its transforms
            complaint = action(path) if action else None
            if not action:
                seed.read(path)
        result = outcome("poor", complaint) if complaint else outcome("read")
    except Hang as problem:
        return outcome("slow", "", _place(problem))
    except ValueError as problem:
        wrong = poor(problem, path)
        result = outcome("poor", f"{', '.join(wrong)} | {problem}", _place(problem)) if wrong else outcome("refused", str(problem))
    except BaseException as problem:
        if isinstance(problem, KeyboardInterrupt):
            raise
        result = outcome("uncaught", f"{type(problem).__name__}: {problem}"[:300], _place(problem))
    if result.kind in GOOD and heard:
        first = heard[0]
        result = outcome("warning", f"{first.category.__name__}: {first.message}"[:200], f"{first.filename}:{first.lineno}")
    more = peak() - before - size
    if more > MEMORY:
        result = outcome("memory", f"{more:.0f} MB", result.where)
    if time.process_time() - begun > SLOW:
        result = outcome("slow", f"{time.process_time() - begun:.0f} s")
    return result


def poor(problem: ValueError, path: Path) -> list[str]:
    """What is wrong with a message."""
    said = str(problem)
    names = [path.name, *([file.name for file in path.iterdir()] if path.is_dir() else [])]
    rest = said.replace(str(path), "")
    faults = {
        "no file name": not any(name in said for name in names),
        "no remedy": ";" not in rest,
        "long": len(rest) > LONGEST,
        "several lines": "\n" in said.strip() or "\r" in said,
        type(problem).__name__: type(problem) is not ValueError,
    }
    return [fault for fault, there in faults.items() if there]


def _place(problem: BaseException) -> str:
    every = traceback.extract_tb(problem.__traceback__)
    frames = [frame for frame in every if "/indexing/" in frame.filename or "/dyntorch/" in frame.filename]
    return f"{frames[-1].filename.split('/indexing/')[-1]}:{frames[-1].lineno} {frames[-1].name}" if frames else ""


def command(argv: list[str]) -> str | None:
    """Run ``dyntorch`` with these words in this process: what is wrong with its answer, if anything."""
    from indexing.cli import main

    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main(argv)
    return judged(code, err.getvalue())


def process(argv: list[str]) -> str | None:
    """The same in a process of its own."""
    here = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    words = [sys.executable, "-m", "indexing.cli", *argv]
    done = subprocess.run(words, capture_output=True, text=True, errors="replace", check=False, timeout=STUCK, env=here)
    return judged(done.returncode, done.stderr)


def judged(code: int, said: str) -> str | None:
    """What is wrong with an exit code and what stood on stderr: 0 done, 2 bad input, 3 refused, and one line where not done."""
    lines = said.splitlines()
    if code not in (0, 2, 3):
        return f"exit {code}: {said[-300:]}"
    if len(lines) != (code != 0) or "warning:" in said:
        return f"exit {code}, {len(lines)} lines: {said[:300]}"
    if code == 2 and ("; " not in said or len(said) > LONGEST + 100):
        return f"exit {code}, no remedy or long: {said[:600]}"
    return None
