"""What all pages share: values put into the templates beside this file, so that each is one self-contained HTML file.

Whatever a template is given is escaped.  Nothing is loaded from outside, and no script runs but one of our own whose hash the page
names (:class:`Script`); the content security policy in its head makes the browser enforce that.
"""

from __future__ import annotations

import base64
import csv
import functools
import hashlib
import io
import math
import re
import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, ClassVar

from dyntorch.numerics import as_python
from indexing import files
from indexing.opening import count

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup

PIXEL_RATIO = 1.5  # picture pixels per CSS pixel: sharp on dense screens at twice the file size
LISTED = 300  # names that a page lists of each kind
LINES = 200  # settings that a page lists
_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\ufffe\uffff]")


@dataclass(frozen=True)
class Tip:
    """A place on a picture and the words that belong to it; all as shares of the picture's width and height, from its top left."""

    left: float
    top: float
    width: float
    height: float
    text: str


@dataclass(frozen=True)
class Picture:
    """A PNG on white paper, and places on it that say something when pointed at."""

    png: bytes
    dark: bytes | None = None
    tips: Sequence[Tip] = ()

    @property
    def images(self) -> list[tuple[str, str]]:
        """Class and address of each image that the style sheet chooses from (not <picture>: on paper its dark one is kept)."""
        named = [("light", self.png), ("dark", self.dark)] if self.dark else [("drawn", self.png)]
        return [(name, f"data:image/png;base64,{base64.b64encode(png).decode('ascii')}") for name, png in named if png]

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in CSS pixels."""
        width, height = struct.unpack(">II", self.png[16:24])
        return round(width / PIXEL_RATIO), round(height / PIXEL_RATIO)

    @property
    def min_width(self) -> int:
        """CSS pixels of its width below which its small print is lost: wide pictures scroll rather than shrink to dust."""
        width = self.size[0]
        return min(width, 680) if width <= 1100 else round(0.85 * width)


@dataclass(frozen=True)
class Script:
    """A script beside this file that a page holds, and the words of the policy that let it run, and it alone."""

    name: str

    @property
    def text(self) -> Markup:
        """The script as it stands in the page."""
        from markupsafe import Markup

        return Markup((Path(__file__).parent / self.name).read_text(encoding="utf-8"))

    @property
    def policy(self) -> str:
        """What the content security policy says of it."""
        digest = hashlib.sha256(self.text.encode("utf-8")).digest()
        return f"; script-src 'sha256-{base64.b64encode(digest).decode('ascii')}'"


@dataclass(frozen=True, eq=False, kw_only=True)
class ResultReport:
    """What the reports on a result of the library share."""

    result: Any
    heading: str = ""
    notes: Sequence[str] = ()
    words: Callable[[str, str | None], str] = as_python
    manifest: Mapping[str, Any] = field(default_factory=dict)
    besides: Mapping[str, Any] = field(default_factory=dict)

    TITLES: ClassVar[tuple[str, str]] = ("", "")
    """The heading where the data decide, and where they do not."""

    @functools.cached_property
    def arrays(self) -> SimpleNamespace:
        """The result's fields, tensors as numpy arrays."""
        values = {each.name: getattr(self.result, each.name) for each in fields(self.result)}
        return SimpleNamespace(**{name: value.numpy() if hasattr(value, "numpy") else value for name, value in values.items()})

    @property
    def title(self) -> str:
        """Heading of the page."""
        return self.heading or self.TITLES[self.status != "OK"]

    @property
    def status(self) -> str:
        """The status's name, ``"OK"`` where the data decide."""
        from dyntorch import Status

        return Status(int(self.result.status)).name

    @functools.cached_property
    def warnings(self) -> list[tuple[str, float, str]]:
        """Code, figure and sentence of every notice."""
        return [(notice.code.value, notice.value, notice.with_words(self.words).text) for notice in self.result.notices]

    @property
    def reason(self) -> str:
        """Why the data do not decide, and what to do; empty where they do."""
        from dyntorch import Status

        return str(self.result.refusal(self.words, Status[self.status]))

    @property
    def refusal(self) -> str | None:
        """The same; None where the data decide."""
        return None if self.status == "OK" else self.reason

    @property
    def state(self) -> str:
        """The status in small letters."""
        return self.status.lower().replace("_", " ")

    @property
    def outcome_json(self) -> dict[str, Any]:
        """Status, notices, notes and how the result came about, for a JSON file."""
        warnings = [{"code": code, "value": value, "message": message} for code, value, message in self.warnings]
        said = {"status": self.status, "reason": self.reason or None, "warnings": warnings, "notes": list(self.notes)}
        return {**said, "manifest": self.manifest}


MEANING = {
    "weak_stack": (
        "Where and how fast a point moves is found from the differences between the views; here they hardly differ in one respect, "
        "so that a small error of a track becomes a large error of its point."
    ),
    "behind": (
        "No camera sees what is behind it: the places found for these points, or for that camera, are wrong, however well they fit."
    ),
}
HEADINGS = {"weak_stack": "views too alike", "behind": "points behind a camera"}


def heading(code: str) -> str:
    """What a notice is about."""
    return HEADINGS.get(code, code.replace("_", " "))


def notes_of(reason: str, warnings: Iterable[tuple[str, float, str]] = (), notes: Iterable[str] = ()) -> list[tuple[str, str, str]]:
    """What a reader should note: CSS class and words of the heading (or none), and the sentence; refusals first."""
    warnings = list(warnings)
    told = [text for _, _, text in warnings if text in reason]
    out = [("bad", "Refused.", sentence(reason))] if reason and not told else []
    for code, _, text in sorted(warnings, key=lambda warning: warning[2] not in told):
        head = f"Refused: {heading(code)}." if text in told else f"{heading(code).capitalize()}."
        out.append(("bad" if text in told else "", head, f"{sentence(text)} {MEANING.get(code, '')}".strip()))
    return out + [("", "", sentence(note)) for note in notes]


def notes_with_names(names: Sequence[str], reason: str, notes: Iterable[str]) -> list[tuple[str, str, str]]:
    """The same where notes may begin with the name of a camera, which keeps its letters."""
    starts = tuple(names)
    sentences = [note[:1] * note.startswith(starts) + sentence(note)[note.startswith(starts) :] for note in notes]
    return [("bad", "Refused.", sentence(reason))] * bool(reason) + [("", "", text) for text in sentences]


def clean(value: object) -> object:
    """Any value without the control characters that a page cannot hold."""
    return value if hasattr(value, "__html__") or isinstance(value, (int, float)) else _CONTROL.sub("", str(value))


@functools.cache
def _environment() -> Environment:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    made = Environment(
        loader=FileSystemLoader(Path(__file__).parent), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True, finalize=clean,
    )  # fmt: skip
    made.filters |= {"form": lambda value, form: f"{value:{form}}", "sentence": sentence, "settings": settings}
    made.globals |= {
        "count": count,
        "remarks": notes_of,
        "listed": kinds_of,
        "ceil": math.ceil,
        "LISTED": LISTED,
        "LINES": LINES,
    }
    return made


def render(template: str, report: Any, **values: Any) -> str:
    """The page of a report, from the template ``NAME.html.j2``."""
    return _environment().get_template(f"{template}.html.j2").render(report=report, **values)


def markup(html: str, **values: object) -> Markup:
    """Markup with values in it, which are escaped, so that it may stand in a table's cell."""
    from markupsafe import Markup

    return Markup(html).format(**{name: clean(value) for name, value in values.items()})


def quiet(text: object, beside: object) -> Markup:
    """A table's cell with something in small print."""
    return markup("{text}<span class='quiet'>{beside}</span>", text=text, beside=beside)


def time_cell(start: float, end: float) -> Markup:
    """A table's cell with seconds, and in small print how many they are and what a clock shows then."""
    minutes, seconds = divmod(int(start), 60)
    clock = f"{minutes // 60}:{minutes % 60:02d}:{seconds:02d}" if end >= 3600 else f"{minutes}:{seconds:02d} min"
    small = f"{end - start:.1f} s long" + f" · at {clock}" * (end >= 60)
    return markup("{span}<small>{small}</small>", span=f"{start:.2f} to {end:.2f} s", small=small)


def matrix(values: Iterable[Iterable[float]]) -> Markup:
    """A matrix in a table's cell, row below row."""
    return markup("<code>{rows}</code>", rows=markup("<br>".join("&ensp;".join(f"{x:.6g}" for x in row) for row in values)))


def bar(fraction: float, mark: float | None = None) -> Markup:
    """A fraction between 0 and 1 as a thin bar, with a tick at ``mark``.  SVG, because printers drop CSS backgrounds."""
    tick = f'<rect class="mark" x="{100 * mark:.1f}" y="0" width=".6" height="8"/>' if mark is not None else ""
    filled = 100 * min(max(fraction, 0.0), 1.0)
    return markup(
        '<svg class="bar" viewBox="0 0 100 8" preserveAspectRatio="none" aria-hidden="true">'
        f'<rect class="track" width="100" height="8"/><rect class="fill" width="{filled:.1f}" height="8"/>{tick}</svg>'
    )


def kinds_of(
    ids: Sequence[str], kinds: Sequence[str], order: Sequence[str], several: Mapping[str, str] | None = None
) -> list[tuple[str, list[str]]]:
    """How many there are of each kind, and their names."""
    out = []
    for kind in order:
        mine = [name for name, other in zip(ids, kinds, strict=True) if other == kind]
        noun = (several or {}).get(kind, kind) if len(mine) > 1 else kind
        if mine:
            out.append((f"{noun}: {len(mine):,}" if " " in noun else f"{len(mine):,} {noun}", mine))
    return out


def sentence(text: str) -> str:
    """Text with a capital letter and a full stop."""
    text = text.strip()
    return text[:1].upper() + text[1:] + ("" if text.endswith((".", "?", "!")) else ".") if text else ""


def even(values: Sequence[float]) -> list[str]:
    """Numbers of one column with the same number of decimals: two, or more where all are small; n/a for what is no number."""
    largest = max((abs(value) for value in values if math.isfinite(value)), default=1.0)
    decimals = 2 if largest == 0 else min(max(2, 2 - math.floor(math.log10(largest))), 9)
    return [f"{value:,.{decimals if abs(value) < 1000 else 0}f}" if math.isfinite(value) else "n/a" for value in values]


def settings(values: Mapping[str, Any], before: str = "") -> list[tuple[str, object]]:
    """Nested settings as name and value, ``a.b`` for ``b`` in ``a``."""
    lines: list[tuple[str, object]] = []
    for name, value in values.items():
        path = f"{before}{name}"
        if isinstance(value, Mapping) and len(value) > 3 and all(_is_hash(item) for item in value.values()):
            together = hashlib.sha256("".join(f"{file}:{value[file]}\n" for file in sorted(value)).encode()).hexdigest()
            lines.append((path, f"{len(value):,} files, each in manifest.json; sha256 of their names and hashes: {together}"))
        elif isinstance(value, Mapping) and value:
            lines += settings(value, f"{path}.")
        elif isinstance(value, (list, tuple)):
            lines.append((path, " ".join(str(item) for item in value) or "none"))
        elif value is not None and not isinstance(value, Mapping):
            lines.append((path, value))
    return lines


def _is_hash(value: object) -> bool:
    return isinstance(value, str) and re.fullmatch(r"[0-9a-f]{64}", value) is not None


def table_csv(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table as CSV."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(head)
    writer.writerows(rows)
    return out.getvalue()


def safe_cell(name: str) -> str:
    """A name as a cell.  Spreadsheets run text that begins like a formula; an apostrophe keeps it text."""
    return f"'{name}" if name.lstrip(" ")[:1] in tuple("=+@\t\r\n") or (name[:1] == "-" and not name[1:2].isdigit()) else name


def npz(arrays: Mapping[str, Any]) -> bytes:
    """Arrays as an ``.npz`` file."""
    import numpy as np

    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


def write_files(folder: str | Path, contents: Mapping[str, Any]) -> Path:
    """Write the files of a report: bytes, text, or values as JSON, each whole or not at all, in the order given."""
    where = files.prepare(folder)
    for name, content in contents.items():
        if content is None:
            (where / name).unlink(missing_ok=True)
            continue
        if isinstance(content, bytes):
            path = files.write_bytes(where / name, content)
        elif isinstance(content, str):
            path = files.write_text(where / name, content)
        else:
            path = files.write_json(where / name, content)
    return path
