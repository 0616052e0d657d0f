"""Make one mistake after the other in a copy of the packages and see which tests notice it.

``python -m tests.mutants`` runs the fast tests of the mistake's rooms; what they miss is tried against the slow ones, too, and told
apart: *fast* killed by ``make test``, *slow* only by ``make test-all``, *lives* by neither.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

from tests.mutants.table import MUTANTS, Mutant

ROOT = Path(__file__).resolve().parents[2]
COPIED = ("dyntorch", "indexing", "experiments", "tests", "docs", "pyproject.toml", "README.md", "CONTRIBUTING.md", "Makefile")


def notice(folder: Path, tests: tuple[str, ...], marks: str) -> str:
    """The first test that fails, or nothing; a mistake that hangs counts as noticed."""
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-n", "0", "-p", "no:cacheprovider", "-m", marks, *tests]
    environment = {**os.environ, "PYTHONPATH": str(folder), "OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=1200, check=False)
    except subprocess.TimeoutExpired:
        return "hangs"
    if done.returncode in (0, 5):
        return ""
    lines = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return lines[0] if lines else f"exit code {done.returncode}"


def fate(folder: Path, mutant: Mutant) -> tuple[str, str]:
    """``fast``, ``slow`` or ``lives``, and the test that noticed."""
    path = folder / mutant.file
    original = path.read_text(encoding="utf-8")
    path.write_text(original.replace(mutant.text, mutant.mistake), encoding="utf-8")
    try:
        for marks in ("not slow", "slow"):
            for tests in mutant.tests:
                by = notice(folder, (tests,), marks)
                if by:
                    return ("slow" if marks == "slow" else "fast"), by
    finally:
        path.write_text(original, encoding="utf-8")
    return "lives", ""


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=__doc__)
    parser.add_argument("--only", nargs="+", type=int, help="numbers of mutants, from 0")
    given = parser.parse_args()
    fates: Counter[str] = Counter()
    with tempfile.TemporaryDirectory(prefix="mutants-") as made:
        folder = Path(made)
        for name in COPIED:
            source = ROOT / name
            copy = shutil.copytree if source.is_dir() else shutil.copy
            copy(source, folder / name)
        for number in given.only or range(len(MUTANTS)):
            mutant = MUTANTS[number]
            kind, by = fate(folder, mutant)
            fates[kind] += 1
            print(f"{number:3d}  {kind:5}  {mutant.kind:6}  {mutant.file}: {mutant.text.strip()[:60]!r}  {by[:110]}", flush=True)
    killed = f"{fates['fast']} killed by the fast tests, {fates['slow']} by the slow ones alone"
    print(f"{sum(fates.values())} mutants: {killed}, {fates['lives']} live")
    return 0


if __name__ == "__main__":
    sys.exit(main())
