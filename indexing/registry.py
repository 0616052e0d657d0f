"""Formats that register themselves: a file in ``indexing/<room>/formats`` is a format of its name, declared there as ``FORMAT``.

Nothing else lists them: detection, ``--format``, ``--help``, the errors that say what there is and the seeds of the fuzzer are made
from these folders.  The names alone cost no import.
"""

from __future__ import annotations

from collections.abc import Iterable
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import Any


def format_names(room: str) -> tuple[str, ...]:
    """The formats of a room (``"readers"``, ``"writers"``, ``"labels"``), sorted."""
    return tuple(sorted(module.name for module in iter_modules([str(Path(__file__).parent / room / "formats")])))


def load_formats(room: str) -> dict[str, Any]:
    """What each file declares, by name, in the order in which the formats are asked whether a file is theirs."""
    formats = {name: import_module(f"indexing.{room}.formats.{name}").FORMAT for name in format_names(room)}
    return dict(sorted(formats.items(), key=lambda item: item[1].order))


def import_modules(package: str) -> None:
    """Import all modules of a package, so that what registers itself in them is known."""
    for module in iter_modules(import_module(package).__path__):
        import_module(f"{package}.{module.name}")


def list_programs(formats: Iterable[Any]) -> list[str]:
    """The programs that write some formats, each once, sorted without regard to capitals."""
    return sorted({program for each in formats for program in each.programs}, key=str.casefold)
