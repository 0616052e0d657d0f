"""The command line ``dyntorch demo | pose | index fit | index scan | archive add | ... | align | reconstruct | ...``.

Each has a file of its own: a dataclass whose fields are its flags, with ``run() -> exit code``.  Only what parsing needs is
imported here, so that ``--help`` answers at once; a command imports its tools when it runs.

A new command is a new file, and a line in :data:`COMMANDS` (or :data:`INDEX` for a verb of
``dyntorch index``, :data:`ARCHIVE` of ``dyntorch archive``).
"""

from __future__ import annotations

import contextlib
import io
import os
import sys
import warnings
from collections.abc import Iterator, Sequence
from typing import Annotated, Any, Protocol, cast, get_args

import tyro

from indexing.cli.align import Align
from indexing.cli.archive import Add, Find, Info, Remove, Search, Verify
from indexing.cli.calibrate import Calibrate
from indexing.cli.console import complain, reworded
from indexing.cli.convert import Convert
from indexing.cli.count import Count
from indexing.cli.demo import Demo
from indexing.cli.evaluate import Evaluate
from indexing.cli.index import Fit, Scan
from indexing.cli.pose import Pose
from indexing.cli.reconstruct import Reconstruct
from indexing.cli.segment import Segment
from indexing.cli.suggest import Suggest
from indexing.cli.sync import Sync

DONE, BAD_INPUT, REFUSED, INTERRUPTED, BROKEN_PIPE = 0, 2, 3, 130, 141

Command = tyro.conf.subcommand
INDEX: Any = (
    Annotated[Fit, Command("fit")]
    | Annotated[Scan, Command("scan")]
    | Annotated[Evaluate, Command("evaluate")]
    | Annotated[Suggest, Command("suggest")]
)
ARCHIVE: Any = (
    Annotated[Add, Command("add")]
    | Annotated[Search, Command("search")]
    | Annotated[Find, Command("find")]
    | Annotated[Info, Command("info")]
    | Annotated[Verify, Command("verify")]
    | Annotated[Remove, Command("remove")]
)
COMMANDS: Any = (
    Annotated[Demo, Command("demo")]
    | Annotated[INDEX, Command("index", description="Learn actions from one clip each and find them elsewhere.")]
    | Annotated[ARCHIVE, Command("archive", description="Keep recordings as movement, and ask where else anybody did this.")]
    | Annotated[Pose, Command("pose")]
    | Annotated[Align, Command("align")]
    | Annotated[Reconstruct, Command("reconstruct")]
    | Annotated[Segment, Command("segment")]
    | Annotated[Sync, Command("sync")]
    | Annotated[Calibrate, Command("calibrate")]
    | Annotated[Convert, Command("convert")]
    | Annotated[Count, Command("count")]
)
GROUPS = ("index", "archive")  # words that need another one behind them
DESCRIPTION = """Geometry of scenes in which everything moves: find people in videos (pose); learn actions from one clip each and
find them in other clips, from other viewpoints (index); keep thousands of recordings and ask where else anybody did this
(archive); put cameras that nobody synchronized on one clock (sync); find where they stand, and the movement in 3D, from the people
in view (calibrate); write recordings as other programs read them (convert); find how a camera or 3D sensor moved among things that
move, and what stood still (align); find cameras, points and velocities from tracks through several views (reconstruct); find which
matches of two images move together (segment); count how many matches such a problem takes (count).

dyntorch COMMAND --help explains a command, dyntorch --version says the version."""


class Runnable(Protocol):
    """What parsing gives: a command with its flags."""

    def run(self) -> int: ...


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command."""
    words = list(sys.argv[1:] if argv is None else argv)
    # Threads that wait must not spin: where other programs use the cores, the demo takes 12 s instead of 52 s (two cores, two
    # other programs), and nothing changes where it is alone.  Read by OpenMP when torch is loaded.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    try:
        with _output():
            if words in (["--version"], ["-V"]):
                print(f"dyntorch {_version()}")
                return DONE
            command = parse(words)
            code = command if isinstance(command, int) else command.run()
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


def parse(words: list[str]) -> Runnable | int:
    """The command that the words ask for, or the exit code where they ask for help or for what does not exist."""
    if not words or (len(words) == 1 and words[0] in GROUPS):
        words = [*words, "--help"]
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            parsed = tyro.cli(
                COMMANDS,
                prog="dyntorch",
                description=DESCRIPTION,
                args=words,
                config=(tyro.conf.OmitSubcommandPrefixes, tyro.conf.OmitArgPrefixes, tyro.conf.DisallowNone),
            )
    except SystemExit as stop:
        if stop.code in (None, 0):
            return DONE
        complain(reworded(said.getvalue(), f"{_asked(words)} --help"))
        return BAD_INPUT
    return cast("Runnable", parsed)


def _asked(words: list[str]) -> str:
    """The command that the words begin with, as far as there is one: whose help says what is wrong with the others."""
    found, level = ["dyntorch"], COMMANDS
    for word in words:
        known = {choice.__metadata__[0].name: choice.__origin__ for choice in get_args(level)}
        if word not in known:
            break
        found.append(word)
        level = known[word]
    return " ".join(found)


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
