"""What is said of a result, once (:class:`Summary`): the terminal, the page and the files of a report are all drawn from it.

A module of this package registers its page with :func:`register_page`, and has a template beside it; nothing else lists pages.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from indexing import files
from indexing.registry import import_modules
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
    """A result in words, numbers, tables, pictures and files.

    Pictures, the contents of files (bytes, text, or values as JSON) and what the template shows besides are made when they are
    written; None removes the file that an earlier report left.
    """

    headline: str = ""
    cards: Sequence[tuple[str, str, str]] = ()
    """Headline numbers of the page: name, value, and how to read it."""
    opening: Sequence[str] = ()
    tables: Sequence[Table] = ()
    notes: Sequence[str] = ()
    closing: Sequence[str] = ()
    pictures: Mapping[str, Callable[[Theme], bytes | Picture | None] | None] = field(default_factory=dict)
    dark: bool = False
    files: Mapping[str, Callable[[], Any] | None] = field(default_factory=dict)
    values: Callable[[], Mapping[str, Any]] = dict


@dataclass(frozen=True)
class Page:
    """A page: the class of its reports, its template, what is said of a report, and the files that it may write."""

    report: type
    template: str
    summarize: Callable[[Any], Summary]
    files: tuple[str, ...]
    stale: str
    """Pattern of the files of an earlier report, by its manifest, that a new one without them removes."""


_PAGES: dict[type, Page] = {}


def register_page(
    report: type, template: str, files: Sequence[str] = (), stale: str = ""
) -> Callable[[Callable[[Any], Summary]], Callable[[Any], Summary]]:
    """Register what summarizes a class of reports (which has a ``title`` and a ``manifest``) as its page, drawn with the template
    ``NAME.html.j2``."""

    def register(summarize: Callable[[Any], Summary]) -> Callable[[Any], Summary]:
        _PAGES[report] = Page(report, template, summarize, tuple(files), stale)
        return summarize

    return register


def registered_pages() -> list[Page]:
    """All pages, by their templates."""
    import_modules("indexing.report")
    return sorted(_PAGES.values(), key=lambda page: page.template)


def summarize(report: Any) -> Summary:
    """What is said of a report."""
    return _PAGES[type(report)].summarize(report)


def warning_lines(report: ResultReport) -> list[str]:
    """The notes and warnings of a report as the terminal prints them, a line each."""
    return [*report.notes, *(f"warning: {heading(code)}: {message}" for code, _, message in report.warnings)]


def write_report(folder: str | Path, report: Any, summary: Summary | None = None) -> Path:
    """Write a report into a folder: its pictures and files, each whole or not at all, ``report.html`` last.

    Returns:
        the path of ``report.html``.

    Raises:
        ValueError: the folder or a file in it cannot be written.
    """
    page, summary = _PAGES[type(report)], summary or summarize(report)
    where = files.prepare(folder)
    drawn = {name: None if draw is None else _draw(draw, summary.dark) for name, draw in summary.pictures.items()}
    contents: dict[str, Any] = {name: None if picture is None else picture.png for name, picture in drawn.items()}
    contents |= {name: None if make is None else make() for name, make in summary.files.items()}
    contents |= getattr(report, "besides", {})
    if files.MANIFEST in contents:
        names = sorted([*(name for name, content in contents.items() if content is not None), "report.html"])
        contents[files.MANIFEST] = {**contents[files.MANIFEST], "files": names}
        files.remove_stale(where, names, page.stale)
    picture = next(iter(drawn.values()), None)
    html = render(page.template, report, summary=summary, picture=picture, drawn=drawn, **summary.values())
    return write_files(where, {**contents, "report.html": html})


def _draw(draw: Callable[[Theme], Any], dark: bool) -> Picture | None:
    picture = draw(LIGHT)
    if picture is None or isinstance(picture, Picture):
        return picture
    return Picture(picture, dark=draw(DARK) if dark else None)
