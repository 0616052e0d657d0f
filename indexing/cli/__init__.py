"""The command line ``dyntorch demo | pose | index fit | index scan | archive add | ... | align | reconstruct | ...``.

:mod:`indexing.cli.flags` says what may be typed, and is all that ``--help`` needs; :mod:`indexing.cli.commands` does the work.
"""

from __future__ import annotations

import contextlib
import io
import os
import sys
import warnings
from collections.abc import Iterator, Sequence
from typing import Any, get_args

import tyro

import dyntorch as dyn
from indexing.cli.console import complain, reword_parser_message
from indexing.cli.flags import GROUPS, find_command, grammar

DONE, BAD_INPUT, REFUSED, INTERRUPTED, BROKEN_PIPE = 0, 2, 3, 130, 141

DESCRIPTION = """Geometry of scenes in which everything moves: find people in videos (pose); learn actions from one clip each and
find them in other clips, from other viewpoints (index); keep thousands of recordings and ask where else anybody did this
(archive); put cameras that nobody synchronized on one clock (sync); find where they stand, and the movement in 3D, from the people
in view (calibrate); write recordings as other programs read them (convert); find how a camera or 3D sensor moved among things that
move, and what stood still (align); find cameras, points and velocities from tracks through several views (reconstruct); find which
matches of two images move together (segment); count how many matches such a problem takes (count).

dyntorch COMMAND --help explains a command, dyntorch --version says the version."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command."""
    words = list(sys.argv[1:] if argv is None else argv)
    # Threads that wait must not spin: where other programs use the cores, the demo takes 12 s instead of 52 s (two cores, two
    # other programs), and nothing changes where it is alone.  Read by OpenMP when torch is loaded.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    try:
        with _output():
            if words in (["--version"], ["-V"]):
                print(f"dyntorch {_version()}, {dyn.numerics.native()}")
                return DONE
            command = parse(words)
            code = command if isinstance(command, int) else find_command(command).run(command)
            sys.stdout.flush()
            return code
    except KeyboardInterrupt:
        complain("interrupted; nothing was left half-written")
        return INTERRUPTED
    except BrokenPipeError:
        _silence()
        return BROKEN_PIPE
    except OSError as error:
        where = f"{error.filename}: " if error.filename is not None else ""
        complain(f"{where}{error.strerror or error}; check the path and its permissions")
        return BAD_INPUT
    except ValueError as error:
        if os.environ.get("DYNTORCH_TRACEBACK"):
            raise  # for a report of a bug
        complain(str(error))
        return BAD_INPUT


def parse(words: list[str]) -> Any:
    """The flags of the command that the words ask for, or the exit code where they ask for help or for what does not exist."""
    if not words or (len(words) == 1 and words[0] in GROUPS):
        words = [*words, "--help"]
    message = io.StringIO()
    try:
        with contextlib.redirect_stderr(message):
            return tyro.cli(
                grammar(),
                prog="dyntorch",
                description=DESCRIPTION,
                args=words,
                config=(tyro.conf.OmitSubcommandPrefixes, tyro.conf.OmitArgPrefixes, tyro.conf.DisallowNone),
            )
    except SystemExit as stop:
        if stop.code in (None, 0):
            return DONE
        complain(reword_parser_message(message.getvalue(), f"{_command_of(words)} --help"))
        return BAD_INPUT


def _command_of(words: list[str]) -> str:
    """The command that the words begin with, as far as there is one: whose help says what is wrong with the others."""
    asked, level = ["dyntorch"], grammar()
    for word in words:
        choices = {choice.__metadata__[0].name: choice.__origin__ for choice in get_args(level)}
        if word not in choices:
            break
        asked.append(word)
        level = choices[word]
    return " ".join(asked)


def _version() -> str:
    from importlib import metadata

    try:
        return metadata.version("dyntorch")
    except metadata.PackageNotFoundError:
        return "(its source, not installed: pip install .)"


@contextlib.contextmanager
def _output() -> Iterator[None]:
    """Warnings as one line each, and no failure over a letter that the terminal cannot show."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="backslashreplace")
    with warnings.catch_warnings():
        # what libraries tell programmers is nothing that a user of the command could act on
        for kind in (DeprecationWarning, PendingDeprecationWarning, FutureWarning):
            warnings.simplefilter("ignore", kind)
        warnings.showwarning = lambda message, *_, **__: complain(f"warning: {message}")
        yield


def _silence() -> None:
    """Keep the interpreter from failing once more, at exit, over the pipe that nobody reads."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)
