"""The mistakes of ``table.toml``."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import NamedTuple


class Mutant(NamedTuple):
    """One mistake: what stands once in a file, what is made of it, and the folders whose tests should notice."""

    kind: str
    file: str
    text: str
    mistake: str
    tests: tuple[str, ...]


def read(path: Path) -> tuple[Mutant, ...]:
    rows = tomllib.loads(path.read_text(encoding="utf-8"))["mutant"]
    return tuple(Mutant(**{**row, "tests": tuple(row["tests"])}) for row in rows)


MUTANTS = read(Path(__file__).with_name("table.toml"))
