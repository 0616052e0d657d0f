"""ELAN files: ``reading`` reads them; written are tiers of their own, put in byte by byte, so that all else stays as it was.

Annotations of a tier may not overlap in ELAN, and a tier has one participant: each person has a tier (``dyntorch@Ann``), and so
have labels that overlap others of the same person (``dyntorch@Ann (2)``).
"""

from __future__ import annotations

import datetime
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element
from xml.sax.saxutils import escape, quoteattr

from indexing.files import write_bytes
from indexing.labels.format import LabelFormat, Request, Target, base_name, correction_error, of_recording, seal
from indexing.labels.formats.elan.reading import MACHINE, REMEDY, media_of, read, tier_of
from indexing.labels.label import Label, list_spots, sort_key
from indexing.labels.markup import Placed, parse_xml
from indexing.opening import count, error, listing, quote, read_bytes

ENCODING = re.compile(rb"<\?xml[^>]*?encoding\s*=\s*[\"']([^\"']*)")
NUMBERED = re.compile(r" \(\d+\)$")
LINE = "\n    "
EMPTY = """<?xml version="1.0" encoding="UTF-8"?>
<ANNOTATION_DOCUMENT AUTHOR="" DATE="{date}" FORMAT="3.0" VERSION="3.0" xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance"\
 xsi:noNamespaceSchemaLocation="http://www.mpi.nl/tools/elan/EAFv3.0.xsd">
    <HEADER MEDIA_FILE="" TIME_UNITS="milliseconds">{media}
        <PROPERTY NAME="lastUsedAnnotationId">0</PROPERTY>
    </HEADER>
    <TIME_ORDER/>
    <CONSTRAINT DESCRIPTION="Time subdivision of parent annotation's time interval, no time gaps allowed within this interval"\
 STEREOTYPE="Time_Subdivision"/>
    <CONSTRAINT DESCRIPTION="Symbolic subdivision of a parent annotation. Annotations refering to the same parent are ordered"\
 STEREOTYPE="Symbolic_Subdivision"/>
    <CONSTRAINT DESCRIPTION="1-1 association with a parent annotation" STEREOTYPE="Symbolic_Association"/>
    <CONSTRAINT DESCRIPTION="Time alignable annotations within the parent annotation's time interval, gaps are allowed"\
 STEREOTYPE="Included_In"/>
</ANNOTATION_DOCUMENT>
"""
MIME = dict.fromkeys((".mp4", ".m4v"), "video/mp4") | dict.fromkeys((".mpg", ".mpeg"), "video/mpeg")
MIME |= {".mov": "video/quicktime", ".wav": "audio/x-wav"}


@dataclass(frozen=True)
class Edit:
    """Bytes in place of ``data[first:last]``."""

    first: int
    last: int
    data: bytes = b""


@dataclass(frozen=True)
class TierRow:
    """Annotations that become one tier: begin and end in milliseconds on the clock of the document; base: its name without what
    tells people and overlapping rows apart."""

    base: str
    name: str
    participant: str
    annotations: list[tuple[int, int, str]]


class Document:
    """An ELAN file and where its parts stand."""

    def __init__(self, path: Path, data: bytes) -> None:
        self.path = path
        self.data = data
        encoding = ENCODING.match(data.removeprefix(b"\xef\xbb\xbf"))
        if encoding and encoding[1].lower() not in (b"utf-8", b"utf8", b"us-ascii"):
            raise error(path, f"is in the encoding {encoding[1].decode('ascii', 'replace')}", "save it again in ELAN, in UTF-8")
        self.slots: dict[str, tuple[int, int]] = {}
        self.uses: dict[Element, list[str]] = {}
        self.numbers: dict[Element, int] = {}
        self.times: dict[str, int] = {}
        self.ours: dict[Element, list[tuple[str, str, str]]] = {}
        self.properties: list[Placed] = []
        self.root, self.placed = parse_xml(path, data, self._collect_part)
        if self.root.tag != "ANNOTATION_DOCUMENT":
            raise error(path, "is XML, but no ELAN file", "write to another file")
        self.order = next((one for one in self.parts("TIME_ORDER")), None)

    def _collect_part(self, placed: Placed, parent: Element) -> bool:
        """Where time slots stand, and which of them each tier uses (:data:`indexing.labels.markup.Taken`)."""
        element = placed.element
        if parent.tag == "TIME_ORDER":
            self.slots[element.get("TIME_SLOT_ID", "")] = placed.first, placed.last
            self.times[element.get("TIME_SLOT_ID", "")] = _number("", element.get("TIME_VALUE", ""))
        elif parent.tag == "TIER":
            machine = tier_of(parent).machine
            for one in element:
                slots = one.get("TIME_SLOT_REF1", ""), one.get("TIME_SLOT_REF2", "")
                self.uses.setdefault(parent, []).extend(slots)
                if machine:
                    self.ours.setdefault(parent, []).append((*slots, one.findtext("ANNOTATION_VALUE", "")))
                number = max(self.numbers.get(parent, 0), _number("a", one.get("ANNOTATION_ID", "")))
                self.numbers[parent] = number
        else:
            if element.tag == "PROPERTY":
                self.properties.append(placed)
            return False
        return True

    def parts(self, tag: str) -> Iterator[Placed]:
        """Children of the root, of a kind."""
        return (one for one in self.placed if one.element.tag == tag)

    def remove_element(self, first: int, last: int) -> Edit:
        """Without an element, and the line that it stood on."""
        while self.data[first - 1 : first].isspace():
            first -= 1
        return Edit(first, last)


def write(labels: Sequence[Label], target: Target) -> list[str]:
    """Write an ELAN file, or tiers into one."""
    if len(target.media) > 1:
        message = f"an ELAN file is of one recording, and these labels are of {len(target.media)} ({listing(target.media)})"
        raise error(target.path, message, "write a file for each")
    media = target.media[0] if target.media else ""
    document = Document(target.into or target.path, _empty(target, media) if target.into is None else read_bytes(target.into))
    rows, notices = _rows(labels, target, _origin(document, target, media))
    edits = _edits(document, target, rows, {label.tier or target.tier for label in labels} or {target.tier})
    data, at = bytearray(), 0
    for edit in sorted(edits, key=lambda edit: (edit.first, edit.last)):
        data += document.data[at : edit.first] + edit.data
        at = max(at, edit.last)
    data += document.data[at:]
    parse_xml(target.path, bytes(data), lambda placed, parent: True)  # what was put together is sound, or nothing is written
    if not target.dry:
        write_bytes(target.path, bytes(data))
    fields = {"comment": "comments", "modifiers": "modifiers", "score": "scores", "observation": "observations"}
    lost = [what for name, what in fields.items() if any(getattr(label, name) not in ("", (), None) for label in labels)]
    return notices + [f"ELAN keeps no {' and no '.join(lost)}"] * bool(lost)


def _empty(target: Target, media: str) -> bytes:
    """A document without tiers."""
    held = ""
    if media:
        file = Path(os.path.expanduser(media))
        address = file.absolute().as_uri() if "://" not in media else media
        kind = MIME.get(file.suffix.lower(), "unknown")
        held = f"{LINE}    <MEDIA_DESCRIPTOR MEDIA_URL={quoteattr(address)} MIME_TYPE={quoteattr(kind)}"
        held += f" RELATIVE_MEDIA_URL={quoteattr('./' + base_name(media))}/>"
    date = datetime.datetime.now().astimezone().isoformat(timespec="seconds")
    return EMPTY.format(date=date, media=held).encode("utf-8", "backslashreplace")


def _origin(document: Document, target: Target, media: str) -> float:
    """What the recording's clock shows when that of the document shows 0, in milliseconds."""
    media_entries = media_of(document.root)
    mine = of_recording([name for name, *_ in media_entries], Request(document.path, media or None, target.name))
    return next((origin for name, _, origin in media_entries if mine is None or name in mine), 0.0)


def _rows(labels: Sequence[Label], target: Target, origin: float) -> tuple[list[TierRow], list[str]]:
    """The tiers to write: one a person, more where labels overlap."""
    rows: dict[tuple[str, str], list[TierRow]] = {}
    early = []
    for label in sorted(labels, key=sort_key):
        begin, end = (round(1000 * time - origin) for time in (label.start, label.end))
        if begin < 0:
            early.append(label)
            continue
        base = label.tier or target.tier
        group = rows.setdefault((base, label.subject), [])
        end = begin + 1 if label.point else max(end, begin + 2)  # a millisecond is a moment
        row = next((row for row in group if row.annotations[-1][1] <= begin), None)
        if row is None:
            name = base + f"@{label.subject}" * bool(label.subject)
            name += f" ({len(group) + 1})" * (bool(group) or NUMBERED.search(name) is not None)
            row = TierRow(base, name, label.subject, [])
            group.append(row)
        row.annotations.append((begin, end, label.label))
    if not labels:  # nothing was found: that is what the tier says
        rows[target.tier, ""] = [TierRow(target.tier, target.tier, "", [])]
    message = f"{count(len(early), 'label')} left out: before the time at which the ELAN file begins ({list_spots(early)})"
    return [row for group in rows.values() for row in group], [message] * bool(early)


# ---- edits ---------------------------------------------------------------------------------------------------------------
def _edits(document: Document, target: Target, rows: Sequence[TierRow], bases: set[str]) -> list[Edit]:
    """Take out the tiers of these names that dyntorch wrote, with their time slots, and put in the new ones."""
    if document.order is None:
        raise error(document.path, "is no sound ELAN file: it has no TIME_ORDER", REMEDY)
    tiers_there = list(document.parts("TIER"))
    old = [part for part in tiers_there if tier_of(part.element).machine and tier_of(part.element).plain_name in bases]
    _check_unchanged(document, target, old)
    _check_free(document, old, rows)
    gone = {part.element for part in old}
    used = {slot for part in tiers_there if part.element not in gone for slot in document.uses.get(part.element, ())}
    freed = {slot for element in gone for slot in document.uses.get(element, ()) if slot in document.slots} - used
    places = [(part.first, part.last) for part in old] + [document.slots[slot] for slot in freed]
    edits = [document.remove_element(*place) for place in places]
    slot = max((_number("ts", name) for name in document.slots if name not in freed), default=0)
    number = max((number for element, number in document.numbers.items() if element not in gone), default=0)
    order, tiers = [], []
    for row in rows:
        participant = f" PARTICIPANT={quoteattr(row.participant)}" * bool(row.participant)
        layers = sum((other.base, other.participant) == (row.base, row.participant) for other in rows)
        mark = f"{MACHINE} {_seal(row.name, row.participant, layers, row.annotations)}"
        head = f"TIER ANNOTATOR={quoteattr(mark)} LINGUISTIC_TYPE_REF={quoteattr(MACHINE)}{participant}"
        tiers.append(f"{LINE}<{head} TIER_ID={quoteattr(row.name)}{'>' if row.annotations else '/>'}")
        for begin, end, value in row.annotations:
            slot, number = slot + 2, number + 1
            for name, time in ((slot - 1, begin), (slot, end)):
                order.append(f'{LINE}    <TIME_SLOT TIME_SLOT_ID="ts{name}" TIME_VALUE="{time}"/>')
            tiers.append(_annotation(f"a{number}", f"ts{slot - 1}", f"ts{slot}", value))
        tiers.append(f"{LINE}</TIER>" * bool(row.annotations))
    edits += [_into_order(document, document.order, "".join(order)), *_counter(document, number)]
    last = max((part.last for part in document.parts("TIER")), default=document.order.last)
    edits.append(Edit(last, last, "".join(tiers).encode()))
    return edits + _linguistic_type(document, last)


def _annotation(name: str, begin: str, end: str, value: str) -> str:
    text = escape(value, {"\r": "&#13;"})
    return (
        f'{LINE}    <ANNOTATION>{LINE}        <ALIGNABLE_ANNOTATION ANNOTATION_ID="{name}" TIME_SLOT_REF1="{begin}" '
        f'TIME_SLOT_REF2="{end}">{LINE}            <ANNOTATION_VALUE>{text}</ANNOTATION_VALUE>'
        f"{LINE}        </ALIGNABLE_ANNOTATION>{LINE}    </ANNOTATION>"
    )


def _seal(name: str, participant: str, layers: int, annotations: Sequence[tuple[int, int, str]]) -> str:
    """The mark of a tier, one of several that were written of a person: what somebody may correct in it."""
    rows = sorted((begin, end, " ".join(value.split())) for begin, end, value in annotations)
    return seal(name, participant, layers, *(part for row in rows for part in row))


def _check_unchanged(document: Document, target: Target, old: Sequence[Placed]) -> None:
    """What dyntorch wrote is as it was."""
    tiers = [tier_of(part.element) for part in old]
    for part, tier in zip(old, tiers, strict=True):
        layers = sum((other.plain_name, other.participant) == (tier.plain_name, tier.participant) for other in tiers)
        ours = document.ours.get(part.element, ())
        there = [(document.times.get(begin, 0), document.times.get(end, 0), value) for begin, end, value in ours]
        if tier.annotator != f"{MACHINE} {_seal(tier.name, tier.participant, layers, there)}":
            raise correction_error(target, f"tier {quote(tier.name)}")


def _check_free(document: Document, old: Sequence[Placed], rows: Sequence[TierRow]) -> None:
    """No tier of a person has the name of a new one, or hangs on an old one."""
    gone = {part.element.get("TIER_ID") for part in old}
    for part in document.parts("TIER"):
        tier = tier_of(part.element)
        if tier.name not in gone and any(row.name == tier.name for row in rows):
            raise error(document.path, f"somebody's tier is called {quote(tier.name)}", "rename it, or write to another file")
        if tier.name not in gone and tier.parent in gone:
            message = f"tier {quote(tier.name)} hangs on {quote(tier.parent)}, which would be replaced"
            raise error(document.path, message, "free that tier in ELAN, or write to another file")


def _number(prefix: str, name: str) -> int:
    """The number of an id, which programs count up; 0 where it has none."""
    digits = name.removeprefix(prefix)
    return int(digits) if name.startswith(prefix) and digits.isascii() and digits.isdigit() and len(digits) < 18 else 0


def _into_order(document: Document, order: Placed, slots: str) -> Edit:
    """New time slots, after those that are there."""
    text = document.data[order.first : order.last]
    if text.endswith(b"/>"):
        element = text[:-2].rstrip() + f">{slots}{LINE}</TIME_ORDER>".encode() if slots else text
        return Edit(order.first, order.last, element)
    at = order.first + text.rindex(b"</")
    while document.data[at - 1 : at].isspace():
        at -= 1
    return Edit(at, at, slots.encode())


def _counter(document: Document, number: int) -> Iterator[Edit]:
    """ELAN goes on counting annotations from here."""
    for part in document.properties:
        value = (part.element.text or "").strip()
        if part.element.get("NAME") == "lastUsedAnnotationId" and value.isascii() and value.isdigit() and int(value[:18]) < number:
            text = document.data[part.first : part.last]
            new = text.replace(b">" + (part.element.text or "").encode() + b"<", f">{number}<".encode())
            yield Edit(part.first, part.last, new)


def _linguistic_type(document: Document, at: int) -> list[Edit]:
    """The type of our tiers, where it is not there yet."""
    for part in document.parts("LINGUISTIC_TYPE"):
        if part.element.get("LINGUISTIC_TYPE_ID") == MACHINE:
            if part.element.get("CONSTRAINTS") or part.element.get("TIME_ALIGNABLE") == "false":
                raise error(document.path, f"its linguistic type {MACHINE!r} has no times of its own", "rename that type in ELAN")
            return []
    types = [part.last for part in document.parts("LINGUISTIC_TYPE")]
    kind = f'{LINE}<LINGUISTIC_TYPE GRAPHIC_REFERENCES="false" LINGUISTIC_TYPE_ID={quoteattr(MACHINE)} TIME_ALIGNABLE="true"/>'
    last = max(types, default=at)
    return [Edit(last, last, kind.encode())]


FORMAT = LabelFormat("an ELAN .eaf", ("xml",), read, write=write, written={"elan": ".eaf"}, program="ELAN", one_recording=True)
