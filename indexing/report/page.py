"""The page that all reports share: one self-contained HTML file, readable in light, dark, narrow and printed.

Functions that take ``html`` expect markup; all others take plain text and escape it.  No script runs on the page and nothing
is loaded from outside; the content security policy in its head makes the browser enforce that.
"""

from __future__ import annotations

import base64
import hashlib
import html as _html
import math
import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from string import Template
from typing import Any

PIXEL_RATIO = 1.5  # picture pixels per CSS pixel: sharp on dense screens at twice the file size
_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\ufffe\uffff]")


@dataclass(frozen=True)
class Card:
    """A headline number: what it is called, what it is, and a few words on how to read it."""

    name: str
    value: str
    note: str = ""


@dataclass(frozen=True)
class Column:
    """A table column: its heading and the CSS class of its cells (``"number"`` aligns right)."""

    name: str
    css: str = ""


@dataclass(frozen=True)
class Tip:
    """A place on a picture and the words that belong to it; all as shares of the picture's width and height, from its top left."""

    left: float
    top: float
    width: float
    height: float
    text: str


def escape(value: object) -> str:
    """Any value as text that is safe between tags and in quoted attributes; control characters are dropped.

    Example:
        >>> escape('<b> & "c"')
        '&lt;b&gt; &amp; &quot;c&quot;'
    """
    return _html.escape(_CONTROL.sub("", str(value)))


def page(title: str, body: str, *, summary: str = "", kind: str = "Report", footer: str = "") -> str:
    """The whole HTML document.

    Args:
        title: heading and window title.
        body: html of the sections.
        summary: one paragraph in plain words.
        kind: what sort of report this is, shown above the title.
        footer: one line at the end.
    """
    folder = Path(__file__).parent
    return Template((folder / "page.html").read_text(encoding="utf-8")).substitute(
        title=escape(title),
        kind=escape(kind),
        summary=f'<p class="summary">{escape(summary)}</p>' if summary else "",
        style=(folder / "page.css").read_text(encoding="utf-8"),
        body=body,
        footer=escape(footer),
    )


def made_by(manifest: Mapping[str, Any]) -> str:
    """The footer's words, from a manifest (or an empty one)."""
    version = (manifest.get("versions") or {}).get("dyntorch")
    when = manifest.get("time")
    return " ".join(["Made by dyntorch", *([str(version)] if version else []), *([f"at {when}"] if when else [])]) + "."


def sentence(text: str) -> str:
    """Text with a capital letter and a full stop.

    Example:
        >>> sentence("no motion fits ")
        'No motion fits.'
    """
    text = text.strip()
    return text[:1].upper() + text[1:] + ("" if text.endswith((".", "?", "!")) else ".") if text else ""


def even(values: Sequence[float]) -> list[str]:
    """Numbers of one column with the same number of decimals: two, or more where all are small; n/a for what is no number.

    Example:
        >>> even([4.34, 3.4, 12.0]), even([0.0213, 0.4]), even([0.00123])
        (['4.34', '3.40', '12.00'], ['0.021', '0.400'], ['0.00123'])
    """
    largest = max((abs(value) for value in values if math.isfinite(value)), default=1.0)
    decimals = 2 if largest == 0 else min(max(2, 2 - math.floor(math.log10(largest))), 9)
    return [f"{value:,.{decimals if abs(value) < 1000 else 0}f}" if math.isfinite(value) else "n/a" for value in values]


def section(title: str, html: str, note: str = "") -> str:
    """A titled part of the page, with an optional sentence below the title."""
    lead = f'<p class="note">{escape(note)}</p>' if note else ""
    return f"<section><h2>{escape(title)}</h2>{lead}{html}</section>"


def cards(items: Sequence[Card]) -> str:
    """Headline numbers side by side; nothing where there are none."""
    if not items:
        return ""
    cells = "".join(
        f"<div><dt>{escape(item.name)}</dt><dd>{escape(item.value)}<small>{escape(item.note)}</small></dd></div>" for item in items
    )
    rows = math.ceil(len(items) / 6)  # rows of nearly equal length: 7 cards as 4 and 3, not as 6 and 1
    return f'<dl class="cards" style="--columns:{math.ceil(len(items) / rows)}">{cells}</dl>'


def table(columns: Sequence[Column], rows: Sequence[Sequence[str]], *, caption: str = "", css: str = "") -> str:
    """A table.

    Args:
        columns: the headings.
        rows: html of the cells; the first cell of a row is its header.
        caption: for screen readers.
        css: extra class; ``"stack"`` turns each row into a block on narrow screens.
    """
    head = "".join(f'<th scope="col" class="{column.css}">{escape(column.name)}</th>' for column in columns)
    lines = []
    for row in rows:
        cells = [
            f'<{tag} class="{column.css}" data-name="{escape(column.name)}">{cell}</{tag.split()[0]}>'
            for tag, column, cell in zip(['th scope="row"'] + ["td"] * len(row), columns, row, strict=False)
        ]
        lines.append(f"<tr>{''.join(cells)}</tr>")
    title = f'<caption class="unseen">{escape(caption)}</caption>' if caption else ""
    body = "\n".join(lines)
    return f'<div class="scroll"><table class="{css}">{title}<thead><tr>{head}</tr></thead><tbody>\n{body}\n</tbody></table></div>'


def picture(light: bytes, alt: str, *, dark: bytes | None = None, caption: str = "", tips: Sequence[Tip] = ()) -> str:
    """A PNG inside the page, with another one for dark screens where given; wide ones scroll rather than shrink to dust.

    Args:
        tips: places on the picture that say something when pointed at.
    """
    width, height = (round(side / PIXEL_RATIO) for side in struct.unpack(">II", light[16:24]))
    least = min(width, 680) if width <= 1100 else round(0.85 * width)  # pixels, below which its small print is lost
    shape = f'alt="{escape(alt)}" width="{width}" height="{height}" style="min-width:{least}px"'
    # Two images that the style sheet switches, not <picture>: browsers keep its dark source on paper.
    images = [("light", light), ("dark", dark)] if dark else [("", light)]
    shown = "".join(f'<img class="{theme}" src="{_data(png)}" {shape}>' for theme, png in images)
    text = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    scroll = f'<div class="scroll" tabindex="0" role="group" aria-label="{escape(alt)}">'  # reachable by keyboard where it scrolls
    if tips:
        shown = f'<div class="tipped" style="min-width:{least}px;max-width:{width}px">{shown}{_tips(tips)}</div>'
    hint = '<p class="swipe" aria-hidden="true">wider than this screen: move it sideways</p>' if least > 340 else ""
    return f"<figure>{scroll}{shown}</div>{hint}{text}</figure>"


def _tips(tips: Sequence[Tip]) -> str:
    places = ""
    for tip in tips:
        x, y, width, height = (f"{100 * share:.2f}" for share in (tip.left, tip.top, tip.width, tip.height))
        rect = f'<rect x="{x}" y="{y}" width="{width}" height="{height}"/>'
        places += f"<g><title>{escape(tip.text)}</title>{rect}</g>"
    return f'<svg class="tips" viewBox="0 0 100 100" preserveAspectRatio="none" aria-hidden="true">{places}</svg>'


def bar(fraction: float, mark: float | None = None) -> str:
    """A fraction between 0 and 1 as a thin bar, with a tick at ``mark``.  SVG, because printers drop CSS backgrounds."""
    tick = f'<rect class="mark" x="{100 * mark:.1f}" y="0" width=".6" height="8"/>' if mark is not None else ""
    filled = 100 * min(max(fraction, 0.0), 1.0)
    return (
        '<svg class="bar" viewBox="0 0 100 8" preserveAspectRatio="none" aria-hidden="true">'
        f'<rect class="track" width="100" height="8"/><rect class="fill" width="{filled:.1f}" height="8"/>{tick}</svg>'
    )


def details(title: str, html: str, *, open_: bool = False) -> str:
    """A block that opens on a click (and is open on paper)."""
    return f"<details{' open' if open_ else ''}><summary>{escape(title)}</summary><div>{html}</div></details>"


def listed(ids: Sequence[str], kinds: Sequence[str], order: Sequence[str], limit: int, file: str) -> str:
    """The names of each kind behind a click, at most ``limit`` of them; the rest is in a file."""
    blocks = []
    for kind in order:
        mine = [name for name, other in zip(ids, kinds, strict=True) if other == kind]
        if mine:
            more = f" and {len(mine) - limit:,} more, in {file}" if len(mine) > limit else ""
            count = f"{kind}: {len(mine):,}" if " " in kind else f"{len(mine):,} {kind}"
            blocks.append(details(count, f"<p>{escape(', '.join(mine[:limit]) + more)}</p>"))
    return "".join(blocks)


def provenance(manifest: Mapping[str, Any]) -> str:
    """The section on how the result was made; nothing without a manifest."""
    if not manifest:
        return ""
    note = "What was run, with which versions and on which files: enough to run it again."
    return section("How this was made", details("Settings, versions and inputs", settings(manifest)), note)


def settings(values: Mapping[str, Any], limit: int = 200) -> str:
    """Nested settings as a two-column table, ``a.b`` for ``b`` in ``a``; at most ``limit`` lines, and the rest counted.

    A folder's files and their hashes are one line: a recording may have a file for each of its frames.
    """
    lines = list(_flat(values))
    rows = [[f"<code>{escape(name)}</code>", f"<code>{escape(value)}</code>"] for name, value in lines[:limit]]
    more = f'<p class="note">{len(lines) - limit} more lines are in manifest.json.</p>' if len(lines) > limit else ""
    return table([Column("Setting"), Column("Value", "long")], rows, css="plain") + more


def _flat(values: Mapping[str, Any], before: str = "") -> list[tuple[str, object]]:
    lines: list[tuple[str, object]] = []
    for name, value in values.items():
        path = f"{before}{name}"
        if isinstance(value, Mapping) and len(value) > 3 and all(_is_hash(item) for item in value.values()):
            together = hashlib.sha256("".join(f"{file}:{value[file]}\n" for file in sorted(value)).encode()).hexdigest()
            lines.append((path, f"{len(value):,} files, each in manifest.json; sha256 of their names and hashes: {together}"))
        elif isinstance(value, Mapping) and value:
            lines += _flat(value, f"{path}.")
        elif isinstance(value, (list, tuple)):
            lines.append((path, " ".join(str(item) for item in value) or "none"))
        elif value is not None and not isinstance(value, Mapping):
            lines.append((path, value))
    return lines


def _is_hash(value: object) -> bool:
    return isinstance(value, str) and re.fullmatch(r"[0-9a-f]{64}", value) is not None


def _data(png: bytes) -> str:
    return f"data:image/png;base64,{base64.b64encode(png).decode('ascii')}"
