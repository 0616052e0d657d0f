"""What is said of a result, once: the terminal, the page and the files of a report are all drawn from its :class:`Summary`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from indexing.report.canvas import DARK, LIGHT, Theme
from indexing.report.page import Picture, ResultReport, heading, render, write_files


@dataclass(frozen=True)
class Table:
    """Rows of plain cells, and the sentences below them; headings of numbers end in a space."""

    columns: Sequence[str]
    rows: Sequence[Sequence[object]]
    below: Sequence[str] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class Summary:
    """A result in words, tables, pictures and files.

    Pictures and the contents of files are made when they are written: bytes, text, or values as JSON; None removes the file that an
    earlier report left.
    """

    headline: str
    opening: Sequence[str] = ()
    tables: Sequence[Table] = ()
    notes: Sequence[str] = ()
    closing: Sequence[str] = ()
    pictures: Mapping[str, Callable[[Theme], bytes] | None] = field(default_factory=dict)
    dark: bool = False
    files: Mapping[str, Callable[[], Any] | None] = field(default_factory=dict)


def notes_of(report: ResultReport) -> list[str]:
    """The notes and warnings of a report as the terminal prints them, a line each."""
    notes = [f"note: {note}" for note in report.notes]
    return notes + [f"warning: {heading(code)}: {message}" for code, _, message in report.warnings]


def write_summary(folder: str | Path, template: str, report: Any, summary: Summary, **values: Any) -> Path:
    """Write pictures, files and ``report.html``, each whole or not at all; ``values`` are what the template wants besides."""
    drawn = {
        name: None if draw is None else Picture(draw(LIGHT), dark=draw(DARK) if summary.dark else None)
        for name, draw in summary.pictures.items()
    }
    contents: dict[str, Any] = {name: None if picture is None else picture.png for name, picture in drawn.items()}
    contents |= {name: None if make is None else make() for name, make in summary.files.items()}
    contents |= getattr(report, "besides", {})
    html = render(template, report, summary=summary.headline, picture=next(iter(drawn.values()), None), drawn=drawn, **values)
    return write_files(folder, {**contents, "report.html": html})
