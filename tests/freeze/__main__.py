"""Freeze what the public names answer on fixed seeds, and compare later: ``python -m tests.freeze write|compare FILE``.

For changes that must not change a result: write a file before, compare after.  Only public names are called, so that the file
stays comparable while what is behind them moves.  ``compare`` ends with 1 where a value differs, 3 where only names differ (a
result has another field), 0 where nothing does.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
import warnings
from collections import Counter
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch

from tests.freeze import geometry, learning
from tests.freeze.flat import Flat, differs, flatten, load, save

MANY = 40  # names of one side listed one by one; more are counted by field


def run(only: list[str], loud: bool = False) -> Flat:
    """Every case whose name begins with one of ``only``, each from the same state of the random numbers."""
    torch.set_num_threads(1)
    flat: Flat = {}
    with tempfile.TemporaryDirectory(prefix="freeze-") as made:
        folder = Path(made).resolve()
        os.chdir(folder)
        for name, case in (geometry.table() | learning.table(folder)).items():
            if only and not any(name.startswith(start) for start in only):
                continue
            torch.manual_seed(0)
            np.random.seed(0)  # noqa: NPY002  (the global state is what must not matter)
            started = time.perf_counter()
            with warnings.catch_warnings(record=True) as heard:
                warnings.simplefilter("always")
                try:
                    result = case()
                except Exception as problem:  # what a case raises is its result
                    result = f"raised {type(problem).__name__}: {problem}"
            flat |= dict(flatten(result, name, (str(folder),)))
            flat |= dict(flatten(sorted({f"{w.category.__name__}: {w.message}" for w in heard}), f"{name}/warned", (str(folder),)))
            if loud or isinstance(result, str):
                print(
                    f"{time.perf_counter() - started:6.1f} s  {name}  {result if isinstance(result, str) else ''}", file=sys.stderr
                )
        os.chdir("/")
    return flat


def listed(title: str, names: list[str]) -> None:
    """Names of one side: each, or where there are many, how many of each field."""
    if not names:
        return
    print(f"{title}: {len(names)}")
    if len(names) <= MANY:
        print("".join(f"  {name}\n" for name in names), end="")
        return
    fields = Counter(name.rsplit("/", 1)[-1] for name in names)
    first = {name.rsplit("/", 1)[-1]: name for name in reversed(names)}
    print("".join(f"  {number:5} x {field}, first {first[field]}\n" for field, number in fields.most_common()), end="")


def compare(old: Flat, new: Flat, tolerance: float) -> int:
    """Print what differs: the exit code."""
    both = [name for name in old if name in new]
    wrong = {name: difference for name in both if (difference := differs(old[name], new[name], tolerance))}
    for name, difference in wrong.items():
        print(f"{name}: {difference}")
    gone, come = [name for name in old if name not in new], [name for name in new if name not in old]
    listed("only in the file", gone)
    listed("only now", come)
    print(f"{len(both)} values compared, {len(wrong)} differ; {len(gone)} names only in the file, {len(come)} only now")
    return 1 if wrong else 3 if gone or come else 0


def main() -> int:
    """Write or compare."""
    parser = argparse.ArgumentParser(prog="python -m tests.freeze", description=__doc__)
    parser.add_argument("verb", choices=("write", "compare"))
    parser.add_argument("file", type=Path)
    parser.add_argument("--tolerance", type=float, default=0.0, help="0: bit by bit; else beside the largest entry of each value")
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="cases whose names begin so")
    parser.add_argument("--with", dest="other", type=Path, help="compare with this file instead of the present state")
    parser.add_argument("--times", action="store_true", help="print how long each case takes")
    given = parser.parse_args()
    path = given.file.resolve()
    other = given.other.resolve() if given.other else None
    if given.verb == "write":
        flat = run(given.only, given.times)
        save(path, flat)
        print(f"{path}: {len(flat)} values")
        return 0
    old = load(path)
    if given.only:
        old = {name: value for name, value in old.items() if any(name.startswith(start) for start in given.only)}
    return compare(old, load(other) if other else run(given.only, given.times), given.tolerance)


if __name__ == "__main__":
    sys.exit(main())
