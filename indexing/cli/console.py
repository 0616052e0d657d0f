"""What commands print: tables and notes on stdout, complaints and progress on stderr.

Everything that comes from files (labels, names) is printed as plain text: rich's markup is off, control characters are dropped.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

PLAIN_WIDTH = 132  # columns where the output is no terminal
REFUSED = 3  # exit code: the data cannot decide
SHOWN = 3  # names listed before "and N more"

Progress = Callable[[float], None]


def one_line(text: object) -> str:
    """Text without line breaks and control characters.

    Example:
        >>> one_line("no such\\n  file")
        'no such file'
    """
    return " ".join("".join(c if c.isprintable() or c.isspace() else "?" for c in str(text)).split())


def complain(text: str) -> None:
    """One line on stderr."""
    print(f"dyntorch: {one_line(text)}", file=sys.stderr)


def say(text: str = "") -> None:
    """One line on stdout, not wrapped."""
    print(one_line(text))


def ended(page: object, refusal: str | None) -> int:
    """Say where the report is, and why the data cannot decide, if so: the exit code."""
    if page is not None:
        say(f"report: {page}")
    if refusal is None:
        return 0
    complain(f"refused: {refusal}")
    return REFUSED


def in_flags(message: str, *flags: str) -> str:
    """A message of the library in the words of the command line.

    Args:
        message: with arguments as ``name=`` or ``name=value``.
        flags: names of the arguments that are flags.

    Example:
        >>> in_flags("give times=, or motion='auto'; threshold=None estimates it", "times", "motion", "threshold")
        'give --times, or --motion auto; --threshold auto estimates it'
    """

    def flag(found: re.Match[str]) -> str:
        name, value = found[1].replace("_", "-"), {"None": "auto", "True": ""}.get(found[2], found[2])
        return f"--no-{name}" if value == "False" else f"--{name} {value or ''}".rstrip()

    return re.sub(rf"\b({'|'.join(flags)})=(?:'?(\w[\w.]*\b)'?)?", flag, message)


def names(values: Sequence[object]) -> str:
    """The first few, and how many more.

    Example:
        >>> names(["a", "b", "c", "d", "e"])
        'a, b, c and 2 more'
    """
    more = f" and {len(values) - SHOWN} more" if len(values) > SHOWN else ""
    return ", ".join(map(str, values[:SHOWN])) + more


def count(number: int, noun: str) -> str:
    """``1 clip``, ``2 clips``."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def table(columns: Sequence[str], rows: Sequence[Sequence[object]], title: str = "") -> None:
    """Print a table; columns of numbers (their headings end in a space) are aligned right."""
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    class Quiet(Console):
        """A console that leaves a broken pipe to :func:`indexing.cli.main`."""

        def on_broken_pipe(self) -> None:
            raise BrokenPipeError

    drawn = Table(box=box.SIMPLE_HEAD, title=Text(title) if title else None, title_justify="left", pad_edge=False)
    for name in columns:
        drawn.add_column(Text(name.strip()), justify="right" if name.endswith(" ") else "left", overflow="fold")
    for row in rows:
        drawn.add_row(*(Text(one_line(cell)) for cell in row))
    terminal = sys.stdout.isatty()
    Quiet(file=sys.stdout, width=None if terminal else PLAIN_WIDTH, highlight=False).print(drawn)


@contextmanager
def progress(what: str, steps: bool = True) -> Iterator[Progress]:
    """A bar on the terminal, moved by calling what this yields with the share done; nothing where stderr is no terminal.

    Args:
        steps: whether the share done will be told; otherwise the bar only shows that work goes on.
    """
    if not sys.stderr.isatty():
        yield lambda share: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
    from rich.progress import Progress as Bars

    columns = [TextColumn("{task.description}", markup=False), BarColumn(), TimeElapsedColumn()]
    columns += [TextColumn("left"), TimeRemainingColumn()] if steps else []
    with Bars(*columns, console=Console(stderr=True), transient=True) as bars:
        task = bars.add_task(one_line(what), total=1.0 if steps else None)
        yield lambda share: bars.update(task, completed=share)
