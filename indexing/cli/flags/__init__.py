"""What may be typed: a dataclass per command, whose fields are its flags, and the registry of all of them.

A command is two files: its flags here, in any module of this package, and its work in :mod:`indexing.cli.commands`, which is
imported once the command is asked for.  Modules of flags import nothing heavy, so that ``--help`` answers at once.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Annotated, Any, cast

import tyro

from indexing.registry import import_modules


@dataclass(frozen=True)
class Command:
    """A command: its words (``index fit``), its flags, its place in ``--help``, and the module and function that do the work."""

    words: str
    flags: type
    order: int
    module: str
    function: str

    @property
    def verb(self) -> str:
        """The last word."""
        return self.words.rpartition(" ")[2]

    def run(self, flags: Any) -> int:
        """Do the work: the exit code."""
        work = import_module(f"indexing.cli.commands.{self.module}")
        return cast("int", getattr(work, self.function)(flags))


@dataclass(frozen=True)
class Group:
    """Commands that share their first word."""

    order: int
    description: str


GROUPS = {
    "index": Group(2, "Learn actions from one clip each and find them elsewhere."),
    "archive": Group(3, "Keep recordings as movement, and ask where else anybody did this."),
}
_COMMANDS: dict[str, Command] = {}


def command(words: str, order: int, module: str | None = None) -> Callable[[type], Any]:
    """Register a dataclass of flags as a command.  Its work is ``run(flags)`` in ``commands/VERB.py``; or the function ``VERB`` in
    a ``module`` that several verbs share."""

    def register(flags: type) -> type:
        verb = words.rpartition(" ")[2]
        _COMMANDS[words] = Command(words, flags, order, module or verb, verb if module else "run")
        return flags

    return register


@functools.cache
def commands() -> tuple[Command, ...]:
    """All commands, in the order of ``--help``."""
    import_modules(__name__)
    return tuple(
        sorted(
            _COMMANDS.values(),
            key=lambda one: (GROUPS[one.words.partition(" ")[0]].order, one.order) if " " in one.words else (one.order, 0),
        )
    )


def find_command(flags: object) -> Command:
    """The command that some flags belong to."""
    return next(one for one in commands() if one.flags is type(flags))


@functools.cache
def grammar() -> Any:
    """All commands as the parser takes them: a union of their dataclasses, nested for groups."""
    out: dict[str, Any] = {}
    for one in commands():
        group, _, _ = one.words.rpartition(" ")
        out.setdefault(group or one.verb, []).append(Annotated[one.flags, tyro.conf.subcommand(one.verb)])
    parts = []
    for word, mine in out.items():
        union = functools.reduce(operator.or_, mine)
        parts.append(
            Annotated[union, tyro.conf.subcommand(word, description=GROUPS[word].description)] if word in GROUPS else union
        )
    return functools.reduce(operator.or_, parts)
