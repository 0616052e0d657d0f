"""ELAN annotation files (``.eaf``, XML): tiers of annotations, with times of their own or those of the annotations they belong to.

Times are milliseconds on the clock of the document; a medium that was shifted has a ``TIME_ORIGIN``: what its own clock shows when
that of the document shows 0.  Slots without a time lie between their neighbours, evenly, as ELAN draws them; annotations of
symbolic tiers take the time of their parent, or their share of it.

Source: the EAF schema 2.7 to 3.0 (https://www.mpi.nl/tools/elan/EAF_Annotation_Format_3.0_and_ELAN.pdf).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any
from xml.etree.ElementTree import Element

from indexing.labels.format import Gathering, Request, parse_whole
from indexing.labels.formats.elan.times import MACHINE, REMEDY, Annotation, Tier, place, take_over
from indexing.labels.label import LabelFile
from indexing.labels.markup import Placed, parse_xml
from indexing.labels.media import base_name, of_recording
from indexing.opening import clip_text, error, first_duplicate, listing, read_bytes, shown


def read(_: Any, asked: Request) -> LabelFile:
    """Read an ELAN file."""
    out = Gathering(asked, "elan")
    parts = TierParts(asked)
    root, _ = parse_xml(asked.path, read_bytes(asked.path), parts.collect_part)
    if root.tag != "ANNOTATION_DOCUMENT":
        raise error(asked.path, f"is XML, but no ELAN file (its root is {clip_text(root.tag, 40)})", "export an .eaf from ELAN")
    units = next((head.get("TIME_UNITS", "milliseconds") for head in root.iterfind("HEADER")), "milliseconds")
    if units != "milliseconds":
        raise error(asked.path, f"TIME_UNITS is {shown(units)}, not milliseconds", "save it again in a newer ELAN")
    tiers = _tiers(asked, root, parts)
    place(out, tiers, parts.slots)
    take_over(asked, tiers, constraints(root))
    media, origin = _medium(out, root)
    for tier in tiers:
        out.tiers.setdefault(tier.plain_name)
        out.watched.setdefault((tier.plain_name, media))
        if tier.machine:
            out.machine.setdefault(tier.plain_name)
        if tier.participant:
            out.subjects.setdefault(tier.participant)
        for one in tier.annotations:
            if one.time is None:
                continue
            begin, end = one.time
            if tier.kind == MACHINE and end - begin <= 1:  # ELAN has no moments: one is written as a millisecond
                end = begin
            where = f"tier {tier.name!r}, annotation {one.name}"
            start, stop = (round((time + origin) / 1000, 6) for time in (begin, end))
            out.add(one.value, start, stop, where, subject=tier.participant, tier=tier.plain_name, media=media)
    return out.finish()


# ---- what the file has ---------------------------------------------------------------------------------------------------
class TierParts:
    """Time slots and annotations, taken out of the tree while it is read: elements of a million would take gigabytes."""

    def __init__(self, asked: Request) -> None:
        self.asked = asked
        self.slots: dict[str, float | None] = {}
        self.annotations: dict[Element, list[Annotation]] = {}

    def collect_part(self, placed: Placed, parent: Element) -> bool:
        """See :data:`indexing.labels.markup.Taken`."""
        if parent.tag == "TIME_ORDER":
            self._slot(placed.element)
        elif parent.tag == "TIER" and placed.element.tag == "ANNOTATION":
            found = self.annotations.setdefault(parent, [])
            found += [_annotation(self.asked, parent.get("TIER_ID", ""), one) for one in placed.element]
        else:
            return False
        return True

    def _slot(self, slot: Element) -> None:
        name, value = slot.get("TIME_SLOT_ID", ""), slot.get("TIME_VALUE")
        if name in self.slots:
            raise error(self.asked.path, f"time slot {shown(name)} is there twice", REMEDY)
        number = None if value is None else parse_whole(value)
        if value is not None and number is None:
            said = f"time slot {shown(name)}: TIME_VALUE {shown(value)} is no whole number of milliseconds"
            raise error(self.asked.path, said, REMEDY)
        self.slots[name] = number


def vocabulary(root: Element) -> dict[str, str]:
    """Values of the entries of controlled vocabularies, by id."""
    found = {}
    for entry in root.iter("CV_ENTRY_ML"):
        value = entry.find("CVE_VALUE")
        if value is not None and value.text:
            found[entry.get("CVE_ID", "")] = value.text
    return found


def constraints(root: Element) -> dict[str, str]:
    """What each linguistic type asks of its annotations, empty where it asks nothing."""
    return {kind.get("LINGUISTIC_TYPE_ID", ""): kind.get("CONSTRAINTS", "") for kind in root.iterfind("LINGUISTIC_TYPE")}


def _tiers(asked: Request, root: Element, parts: TierParts) -> list[Tier]:
    """All tiers; their names and the ids of their annotations differ, their parents are there."""
    values = vocabulary(root)
    found = []
    for element in root.iterfind("TIER"):
        tier = tier_of(element)
        tier.annotations = parts.annotations.get(element, [])
        for one in tier.annotations:
            if not one.value.strip():
                one.value = values.get(one.entry, "")
        found.append(tier)
    twice = first_duplicate(tier.name for tier in found)
    if twice is not None:
        raise error(asked.path, f"two tiers are called {shown(twice)}", "rename one (ELAN: Tier > Change Tier Attributes)")
    _check_parents(asked, found)
    kinds = constraints(root)
    lost = next((tier for tier in found if tier.kind and tier.kind not in kinds), None)
    if lost is not None:
        said = f"tier {shown(lost.name)}: its linguistic type {shown(lost.kind)} is not there"
        raise error(asked.path, said, "give it another one (ELAN: Tier > Change Tier Attributes)")
    same = first_duplicate(one.name for tier in found for one in tier.annotations)
    if same is not None:
        raise error(asked.path, f"two annotations have the id {shown(same)}", REMEDY)
    return found


def tier_of(element: Element) -> Tier:
    """A tier without its annotations."""
    name, kind, parent, annotator = (element.get(key, "") for key in ("TIER_ID", "LINGUISTIC_TYPE_REF", "PARENT_REF", "ANNOTATOR"))
    return Tier(name, kind, element.get("PARTICIPANT", "").strip(), parent, annotator)


def _check_parents(asked: Request, tiers: Sequence[Tier]) -> None:
    """Parents are there, and no tier is above itself."""
    above = {tier.name: tier.parent for tier in tiers}
    fine = {""}
    for name in above:
        seen: dict[str, None] = {}
        while name not in fine:
            if name not in above:
                raise error(asked.path, f"tier {shown(next(reversed(seen)))}: its parent tier {shown(name)} is not there", REMEDY)
            if name in seen:
                raise error(asked.path, f"tier {shown(name)} is its own parent, by way of {listing(seen, 4)}", REMEDY)
            seen[name] = None
            name = above[name]
        fine.update(seen)


def _annotation(asked: Request, tier: str, element: Element) -> Annotation:
    name, entry = element.get("ANNOTATION_ID", ""), element.get("CVE_REF", "")
    value = element.find("ANNOTATION_VALUE")
    text = (value.text or "") if value is not None else ""
    if element.tag == "ALIGNABLE_ANNOTATION":
        return Annotation(name, text, (element.get("TIME_SLOT_REF1", ""), element.get("TIME_SLOT_REF2", "")), entry=entry)
    if element.tag == "REF_ANNOTATION":
        return Annotation(name, text, None, element.get("ANNOTATION_REF", ""), element.get("PREVIOUS_ANNOTATION", ""), entry)
    raise error(asked.path, f"tier {shown(tier)}: holds {clip_text(element.tag, 40)}, which is no annotation", REMEDY)


def media_of(root: Element) -> list[tuple[str, str, float]]:
    """Name, address and origin (milliseconds) of each medium; the whole address is the name where two files have the same."""
    found = []
    for one in root.iterfind("HEADER/MEDIA_DESCRIPTOR"):
        address = one.get("MEDIA_URL") or one.get("RELATIVE_MEDIA_URL") or ""
        found.append((base_name(address), address, float(parse_whole(one.get("TIME_ORIGIN", "0")) or 0)))
    if not found:
        old = next((head.get("MEDIA_FILE", "") for head in root.iterfind("HEADER")), "")
        found = [(base_name(old), old, 0.0)] if old else []
    names = [name for name, *_ in found]
    return [(name if names.count(name) == 1 else address, address, origin) for name, address, origin in found]


def _medium(out: Gathering, root: Element) -> tuple[str, float]:
    """The medium that is the recording, or the first, and its origin in milliseconds."""
    known = media_of(root)
    out.media.update(dict.fromkeys(name for name, *_ in known))
    mine = of_recording(out.media, out.asked)
    name, _, origin = next((one for one in known if mine is None or one[0] in mine), ("", "", 0.0))
    if mine is None and len({origin for *_, origin in known}) > 1:
        out.note(f"has media that begin at other times ({listing(out.media)}); times are those of {name}")
    if not known and out.asked.recording is not None:
        out.note(f"names no media file; its clock is taken for that of {out.asked.recording}")
    return name, origin
