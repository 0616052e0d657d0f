"""What commands print: tables and notes on stdout, complaints and progress on stderr.

Everything that comes from files (labels, names) is printed as plain text: rich's markup is off, control characters are dropped.
"""

from __future__ import annotations

import contextlib
import difflib
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dyntorch.numerics import as_python
from indexing.opening import count as count  # by this name for all commands

if TYPE_CHECKING:
    from indexing.report.summary import Summary

PLAIN_WIDTH = 132  # columns where the output is no terminal
REFUSED = 3  # exit code: the data cannot decide
SHOWN = 3  # names listed before "and N more"

Progress = Callable[[float], None]


def one_line(text: object) -> str:
    """Text without line breaks and control characters."""
    return " ".join("".join(c if c.isprintable() or c.isspace() else "?" for c in str(text)).split())


def complain(text: str) -> None:
    """One line on stderr."""
    print(f"dyntorch: {one_line(text)}", file=sys.stderr)


def say(text: str = "") -> None:
    """One line on stdout, not wrapped."""
    print(one_line(text))


def finish(page: object, refusal: str | None) -> int:
    """Say where the report is, and why the data cannot decide, if so: the exit code."""
    if page is not None:
        say(f"report: {page}")
    if refusal is None:
        return 0
    complain(f"refused: {refusal}")
    return REFUSED


def flag_words(*names: str, **own: str) -> Callable[[str, str | None], str]:
    """What the command line calls the arguments that a message of the library speaks of."""

    def name_flag(name: str, value: str | None) -> str:
        if name in own:
            return own[name]
        if name not in names:
            return as_python(name, value)
        flag = name.replace("_", "-")
        given = {None: "", "None": "auto", "True": ""}.get(value, (value or "").strip("'"))
        return f"--no-{flag}" if value == "False" else f"--{flag} {given}".rstrip()

    return name_flag


def names(values: Sequence[object]) -> str:
    """The first few, and how many more."""
    more = f" and {len(values) - SHOWN} more" if len(values) > SHOWN else ""
    return ", ".join(map(str, values[:SHOWN])) + more


def table(columns: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    """Print a table; columns of numbers (their headings end in a space) are aligned right."""
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    class Quiet(Console):
        """A console that leaves a broken pipe to :func:`indexing.cli.main`."""

        def on_broken_pipe(self) -> None:
            raise BrokenPipeError

    drawn = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for name in columns:
        drawn.add_column(Text(name.strip()), justify="right" if name.endswith(" ") else "left", overflow="fold")
    for row in rows:
        drawn.add_row(*(Text(one_line(cell)) for cell in row))
    terminal = sys.stdout.isatty()
    Quiet(file=sys.stdout, width=None if terminal else PLAIN_WIDTH, highlight=False).print(drawn)


def show(summary: Summary) -> None:
    """Print a result: its tables with what is said below them, notes and warnings, and what is to be said last."""
    for line in summary.opening:
        say(line)
    for one in summary.tables:
        table(one.columns, one.rows)
        for sentence in one.below:
            say(sentence)
    for note in summary.notes:
        say(note if note.startswith("warning: ") else f"note: {note}")
    for line in summary.closing:
        say(line)


def present(report: Any, folder: Path | None, *further: str) -> int:
    """Write a report where a folder is given, and print its summary and further lines: the exit code."""
    from indexing.report.summary import summarize, write_report  # which draws: not needed for --help

    summary, page = summarize(report), None
    if folder is not None:
        with progress("drawing the report", steps=False):
            page = write_report(folder, report, summary)
    show(summary)
    for line in further:
        say(line)
    return finish(page, getattr(report, "refusal", None))


@contextmanager
def progress(what: str, steps: bool = True) -> Iterator[Progress]:
    """A bar on the terminal, moved by calling what this yields with the share done; nothing where stderr is no terminal."""
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


def of_total(tell: Progress) -> Callable[[int, int], None]:
    """The same, told how many of how many are done."""
    return lambda done, total: tell(done / max(1, total))


# ----------------------------------------------------------------------------------------------------------------------
# Where commands write: checked before the work begins, and never over their own inputs.


def check_folder(folder: Path) -> Path:
    """The folder, if files can be written in it; it is not made yet, so that a failure later leaves nothing behind."""
    folder = folder.expanduser()
    there = next((part for part in (folder, *folder.absolute().parents) if part.exists()), Path.cwd())
    if not there.is_dir():
        raise ValueError(f"output folder {str(folder)!r}: {str(there)!r} is a file; choose another folder, or move it away")
    probe = there / f".dyntorch-{os.urandom(8).hex()}.tmp"
    try:
        os.close(os.open(probe, os.O_CREAT | os.O_EXCL | os.O_WRONLY))
    except OSError as error:
        raise ValueError(
            f"output folder {str(folder)!r}: {str(there)!r} cannot be written ({error.strerror or error}); "
            "choose a folder you may write to"
        ) from None
    finally:
        with contextlib.suppress(OSError):
            probe.unlink()
    return folder


def check_file(path: Path, inputs: Iterable[Path]) -> Path:
    """The file to write, if it can be written."""
    path = path.expanduser()
    if path.is_dir():
        raise ValueError(f"{path}: is a folder; name the file to write in it, e.g. -o {path / 'moves.safetensors'}")
    check_folder(path.parent)
    keep(inputs, [path])
    return path


def check_report(folder: Path | None, inputs: Iterable[Path], files: Iterable[str]) -> Path | None:
    """The folder of a report, if it can be written and no file of the report would replace an input."""
    if folder is None:
        return None
    folder = check_folder(folder)
    keep(inputs, [folder / name for name in files])
    return folder


def check_seed(seed: int) -> None:
    """Raise where a seed is none."""
    if seed < 0:
        raise ValueError(f"--seed must be a whole number from 0, got {seed}")


def keep(inputs: Iterable[Path], outputs: Iterable[Path]) -> None:
    """Raise where an output would replace an input."""
    written = {path.resolve() for path in outputs}
    lost = [path for path in inputs if path.expanduser().resolve() in written]
    if lost:
        listed = ", ".join(map(str, lost[:SHOWN]))
        raise ValueError(f"{listed}: is an input, and the output would replace it; choose another name for the output")


# ----------------------------------------------------------------------------------------------------------------------
# What the parser of the command line says, in our words: one line that names the flag, what was given and what is expected.


def reword_parser_message(text: str, command: str) -> str:
    """The parser's message, which it draws in a box with rules between the parts, as one line in our words.

    Args:
        command: that explains more.
    """
    parts = [""]
    lines = text.splitlines()
    if len(lines) > 1 and lines[1].strip() and not lines[1].strip().strip("-"):  # no box, but a title above a rule: drop it, too
        lines = lines[2:]
    for line in lines:
        words = line.strip().strip("│|").strip()
        if not words.strip("─-╰╯+"):
            parts.append("")
        elif not words.startswith(("╭", "+")):  # the box's title says what its text says
            parts[-1] += f" {words}"
    kept = [part.strip().removesuffix(".") for part in parts if part.strip() and "Argument helptext:" not in part]
    said = one_line("; ".join(kept)).replace("[bold]", "").replace("[/bold]", "")
    said = re.sub(r"(; )?For full helptext,? .*", "", said)
    for pattern, reword in REWORDED:
        said = re.sub(pattern, reword, said)
    return f"{said.strip() or 'the command line makes no sense'}; see {command}".replace("?; see", "? see")


def _kind(types: str) -> str:
    """What a flag expects, from the parser's names of types: ``INT|{auto}`` is a whole number or auto."""
    words = types.strip("{}").replace("{", "").replace("}", "")
    if " " in words and "|" not in words:
        return f"{len(words.split())} numbers"
    names = {"INT": "a whole number", "FLOAT": "a number", "PATH": "a file or folder", "STR": "a word"}
    return " or ".join(names.get(word.strip(), word.strip()) for word in words.split("|"))


def _no_such_type(found: re.Match[str]) -> str:
    return f"{found['flag']} {found['given']}: expected {_kind(found['types'])}"


def _no_number(found: re.Match[str]) -> str:
    return f"{found['flag']} {found['given']}: expected {'a whole number' if found['kind'] == 'int' else 'a number'}"


def _no_choice(found: re.Match[str]) -> str:
    """The choices in alphabetical order (the parser's own differs from run to run), the nearest one first."""
    choices = sorted(set(re.findall(r"'([^']*)'", found["choices"])) - {"None"})
    near = difflib.get_close_matches(found["given"], choices, 1)
    return (
        f"{found['flag']} {found['given']}: " + (f"did you mean {near[0]}? " if near else "") + f"choose from {', '.join(choices)}"
    )


def _no_option(found: re.Match[str]) -> str:
    given = found["given"].split(", ")
    wrong = next((word for word in given if word.startswith("-")), given[0])
    near = re.search(r"Perhaps you meant:?.*?(--[\w-]+)", found["more"] or "")
    if near and wrong.startswith("-"):
        return f"unknown option {wrong}; did you mean {near[1]}?"
    among = re.search(r"Available subcommands: ([^;]*)", found["more"] or "")
    if among:
        near_word = difflib.get_close_matches(wrong, among[1].split(", "), 1)
        meant = f"did you mean {near_word[0]}? " if near_word else ""
        return f"unknown command {wrong}; {meant}choose from {among[1]}"
    return f"unknown option {wrong}" if wrong.startswith("-") else f"unexpected {wrong!r}; leave it out"


def _no_value(found: re.Match[str]) -> str:
    return f"{found['flag']}: " + ("its value is missing" if found["number"] == "1" else f"expected {found['number']} values")


def _missing(found: re.Match[str]) -> str:
    name = re.match(r"(?:--[\w-]+ )?[A-Z]+", found["what"])
    return f"missing: {name[0]} ({found['what'][name.end() :].strip()})" if name else f"missing: {found['what']}"


REWORDED: tuple[tuple[str, Callable[[re.Match[str]], str]], ...] = (
    (
        r"Error parsing (?P<flag>\S+): no type matching (?P<types>.*?) could be instantiated from \[(?P<given>.*?)\]; Got errors:"
        r".*",
        _no_such_type,
    ),
    (
        r"Error parsing (?P<flag>\S+): (?:invalid literal for |could not convert string to )(?P<kind>int|float)\b"
        r".*?(?P<given>'[^']*')",
        _no_number,
    ),
    (
        r"invalid choice '(?P<given>.*?)' for argument '(?P<flag>.*?)'\. Expected one of (?P<choices>\(.*?\))",
        _no_choice,
    ),
    (r"Unrecognized options: (?P<given>[^;]*)(?P<more>;.*)?", _no_option),
    (r"Missing value for argument '(?:\(')?(?P<flag>[^',]*).*?'\. Expected (?P<number>\d+) values", _no_value),
    (r"Missing from dyntorch[^:]*: (?:-\w [A-Z]+, )?(?P<what>.*?) \(required\)", _missing),
)
"""What the parser says -> what we say."""
