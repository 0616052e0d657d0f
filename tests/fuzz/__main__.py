"""A long run: ``python -m tests.fuzz --files 100000``.  Prints a table of outcomes per format, and what must not be by its place.

A file can be made and read again: ``python -m tests.fuzz --only OpenPose --number 17``.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
import tempfile
import time
import traceback
from collections import Counter, defaultdict
from collections.abc import Callable
from functools import partial
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("OMP_NUM_THREADS", "1")

from tests.fuzz.running import BAD, GOOD, Outcome, capped, command, damaged, process, tried
from tests.fuzz.seeds import Seed, make


def drawn(seeds: list[Seed], count: int) -> list[tuple[Seed, int]]:
    """So many files, fewer of the formats that take long; the numbers of a format count from 0."""
    total = sum(1 / seed.slow for seed in seeds)  # such as 33 for all formats
    return [(seed, number) for seed in seeds for number in range(round(count / seed.slow / total))]


def table(found: list[Outcome]) -> str:
    """Outcomes by format."""
    counts = defaultdict(Counter)
    for one in found:
        counts[one.seed][one.kind] += 1
        counts["all"][one.kind] += 1
    kinds = (*GOOD, *BAD)
    names = [*sorted(counts.keys() - {"all"}), "all"]
    lines = [f"{'format':24}" + "".join(f"{kind:>10}" for kind in ("files", *kinds))]
    lines += [
        f"{name:24}" + f"{sum(counts[name].values()):10}" + "".join(f"{counts[name][kind]:10}" for kind in kinds) for name in names
    ]
    return "\n".join(lines)


def places(found: list[Outcome]) -> str:
    """What must not be, the most frequent first, with one file each to begin with."""
    groups = defaultdict(list)
    for one in found:
        if one.kind in BAD:
            groups[one.kind, one.where, one.said.split(":")[0].split("|")[0][:60]].append(one)
    lines = []
    for (kind, where, _), ones in sorted(groups.items(), key=lambda item: -len(item[1])):
        formats = ", ".join(f"{name} {count}" for name, count in Counter(one.seed for one in ones).most_common(4))
        lines.append(f"[{kind}] x{len(ones)} {where} ({formats})")
        lines.append(f"      --only {ones[0].seed} --number {ones[0].number}: {ones[0].said[:300]!r}")
    return "\n".join(lines)


def main() -> int:
    """Run, and say what became of the files: exit code 1 where something was that must not be."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--files", type=int, default=20_000, help="how many are read")
    parser.add_argument("--commands", type=int, default=0, help="how many besides go through the command line, in this process")
    parser.add_argument("--processes", type=int, default=0, help="how many besides, each by a process of its own")
    parser.add_argument("--only", default="", help="formats whose name holds this")
    parser.add_argument("--number", type=int, help="read this one file of --only, and show what happens")
    parser.add_argument("--first", type=int, default=0, help="number of the first file of each format")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="fuzz-") as name:
        folder = Path(name)
        seeds = [seed for seed in make(folder / "seeds") if asked.only in seed.name]
        for seed in seeds:
            seed.read(seed.path)
        if asked.number is not None:
            return again(seeds[0], asked.number, folder)
        capped()
        found = [run(drawn(seeds, asked.files), asked.first, folder, None)]
        talking = [seed for seed in seeds if seed.words]
        for title, count, how in (("in this process", asked.commands, command), ("as processes", asked.processes, process)):
            if count:
                print(table(found[-1]), places(found[-1]), f"through the command line, {title}:", sep="\n", flush=True)
                found.append(run(drawn(talking, count), asked.first, folder, how))
        print(table(found[-1]), places(found[-1]), sep="\n")
    return int(any(one.kind in BAD for ones in found for one in ones))


def run(files: list[tuple[Seed, int]], first: int, folder: Path, how: Callable[[list[str]], str | None] | None) -> list[Outcome]:
    """Read all, format by format, and say how far it is."""
    found, begun, said = [], time.time(), time.time()
    os.chdir(folder)
    with contextlib.suppress(KeyboardInterrupt):  # what was read until then is reported
        for seed, number in files:
            found.append(tried(seed, first + number, folder / "in", None if how is None else partial(spoken, seed, how)))
            if time.time() - said > 60:
                said = time.time()
                bad = dict(Counter(one.kind for one in found if one.kind in BAD))
                print(f"{len(found)} of {len(files)} in {said - begun:.0f} s: {bad}, at {seed.name}", file=sys.stderr, flush=True)
    return found


def spoken(seed: Seed, how: Callable[[list[str]], str | None], path: Path) -> str | None:
    """What is wrong with the answer of the command line."""
    return how([word.replace("{}", str(path)) for word in seed.words or ()])


def again(seed: Seed, number: int, folder: Path) -> int:
    """One file, with all that is said about it."""
    path, damage = damaged(seed, number, folder / "in")
    kept = Path(tempfile.gettempdir()) / f"fuzz-{number}-{path.name}"
    if path.is_file() and not path.is_symlink():
        kept.write_bytes(path.read_bytes())
        print(f"kept as {kept}")
    print(f"{seed.name} {number}: {damage}")
    try:
        seed.read(path)
    except Exception:
        traceback.print_exc()
    print(tried(seed, number, folder / "in"))
    return 0


if __name__ == "__main__":
    sys.exit(main())
