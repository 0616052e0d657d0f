"""ELAN annotation files (``.eaf``, XML): tiers of annotations, with times of their own or those of the annotations they belong to.

Times are milliseconds on the clock of the document; a medium that was shifted has a ``TIME_ORIGIN``: what its own clock shows when
that of the document shows 0.  Slots without a time lie between their neighbours, evenly, as ELAN draws them; annotations of
symbolic tiers take the time of their parent, or their share of it.

Source: the EAF schema 2.7 to 3.0 (https://www.mpi.nl/tools/elan/EAF_Annotation_Format_3.0_and_ELAN.pdf).
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any
from xml.etree.ElementTree import Element

from indexing.labels.format import Gathering, Request, base_name, of_recording, parse_whole
from indexing.labels.label import NUM_NAMED, LabelFile
from indexing.labels.markup import Placed, parse_xml
from indexing.opening import clip_text, count, error, first_duplicate, listing, quote, read_bytes


def read(_: Any, asked: Request) -> LabelFile:
    """Read an ELAN file."""
    out = Gathering(asked, "elan")
    parts = TierParts(asked)
    root, _ = parse_xml(asked.path, read_bytes(asked.path), parts.collect_part)
    if root.tag != "ANNOTATION_DOCUMENT":
        raise error(asked.path, f"is XML, but no ELAN file (its root is {clip_text(root.tag, 40)})", "export an .eaf from ELAN")
    units = next((head.get("TIME_UNITS", "milliseconds") for head in root.iterfind("HEADER")), "milliseconds")
    if units != "milliseconds":
        raise error(asked.path, f"TIME_UNITS is {quote(units)}, not milliseconds", "save it again in a newer ELAN")
    tiers = _tiers(asked, root, parts)
    assign_times(out, tiers, parts.slots)
    inherit_times(asked, tiers, constraints(root))
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
            annotations = self.annotations.setdefault(parent, [])
            annotations += [_annotation(self.asked, parent.get("TIER_ID", ""), one) for one in placed.element]
        else:
            return False
        return True

    def _slot(self, slot: Element) -> None:
        name, value = slot.get("TIME_SLOT_ID", ""), slot.get("TIME_VALUE")
        if name in self.slots:
            raise error(self.asked.path, f"time slot {quote(name)} is there twice", REMEDY)
        number = None if value is None else parse_whole(value)
        if value is not None and number is None:
            message = f"time slot {quote(name)}: TIME_VALUE {quote(value)} is no whole number of milliseconds"
            raise error(self.asked.path, message, REMEDY)
        self.slots[name] = number


def vocabulary(root: Element) -> dict[str, str]:
    """Values of the entries of controlled vocabularies, by id."""
    values = {}
    for entry in root.iter("CV_ENTRY_ML"):
        value = entry.find("CVE_VALUE")
        if value is not None and value.text:
            values[entry.get("CVE_ID", "")] = value.text
    return values


def constraints(root: Element) -> dict[str, str]:
    """What each linguistic type asks of its annotations, empty where it asks nothing."""
    return {kind.get("LINGUISTIC_TYPE_ID", ""): kind.get("CONSTRAINTS", "") for kind in root.iterfind("LINGUISTIC_TYPE")}


def _tiers(asked: Request, root: Element, parts: TierParts) -> list[Tier]:
    """All tiers; their names and the ids of their annotations differ, their parents are there."""
    values = vocabulary(root)
    tiers = []
    for element in root.iterfind("TIER"):
        tier = tier_of(element)
        tier.annotations = parts.annotations.get(element, [])
        for one in tier.annotations:
            if not one.value.strip():
                one.value = values.get(one.entry, "")
        tiers.append(tier)
    twice = first_duplicate(tier.name for tier in tiers)
    if twice is not None:
        raise error(asked.path, f"two tiers are called {quote(twice)}", "rename one (ELAN: Tier > Change Tier Attributes)")
    _check_parents(asked, tiers)
    kinds = constraints(root)
    lost = next((tier for tier in tiers if tier.kind and tier.kind not in kinds), None)
    if lost is not None:
        message = f"tier {quote(lost.name)}: its linguistic type {quote(lost.kind)} is not there"
        raise error(asked.path, message, "give it another one (ELAN: Tier > Change Tier Attributes)")
    same = first_duplicate(one.name for tier in tiers for one in tier.annotations)
    if same is not None:
        raise error(asked.path, f"two annotations have the id {quote(same)}", REMEDY)
    return tiers


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
                raise error(asked.path, f"tier {quote(next(reversed(seen)))}: its parent tier {quote(name)} is not there", REMEDY)
            if name in seen:
                raise error(asked.path, f"tier {quote(name)} is its own parent, by way of {listing(seen, 4)}", REMEDY)
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
    raise error(asked.path, f"tier {quote(tier)}: holds {clip_text(element.tag, 40)}, which is no annotation", REMEDY)


def media_of(root: Element) -> list[tuple[str, str, float]]:
    """Name, address and origin (milliseconds) of each medium; the whole address is the name where two files have the same."""
    entries = []
    for one in root.iterfind("HEADER/MEDIA_DESCRIPTOR"):
        address = one.get("MEDIA_URL") or one.get("RELATIVE_MEDIA_URL") or ""
        entries.append((base_name(address), address, float(parse_whole(one.get("TIME_ORIGIN", "0")) or 0)))
    if not entries:
        old = next((head.get("MEDIA_FILE", "") for head in root.iterfind("HEADER")), "")
        entries = [(base_name(old), old, 0.0)] if old else []
    names = [name for name, *_ in entries]
    return [(name if names.count(name) == 1 else address, address, origin) for name, address, origin in entries]


def _medium(out: Gathering, root: Element) -> tuple[str, float]:
    """The medium that is the recording, or the first, and its origin in milliseconds."""
    entries = media_of(root)
    out.media.update(dict.fromkeys(name for name, *_ in entries))
    mine = of_recording(out.media, out.asked)
    name, _, origin = next((one for one in entries if mine is None or one[0] in mine), ("", "", 0.0))
    if mine is None and len({origin for *_, origin in entries}) > 1:
        out.note(f"has media that begin at other times ({listing(out.media)}); times are those of {name}")
    if not entries and out.asked.recording is not None:
        out.note(f"names no media file; its clock is taken for that of {out.asked.recording}")
    return name, origin


# ----------------------------------------------------------------------------------------------------------------------
# When annotations begin and end: by their slots, by their neighbours, or by the annotation that they belong to


REMEDY = "open it in ELAN, mend it and save it again"
MACHINE = "dyntorch"
"""The linguistic type of tiers that a program wrote, and how their annotator begins until a person takes them over."""


@dataclass(slots=True, eq=False)
class Annotation:
    """An annotation."""

    name: str
    value: str
    slots: tuple[str, str] | None = None
    parent: str = ""
    previous: str = ""
    entry: str = ""
    time: tuple[float, float] | None = None


@dataclass(eq=False)
class Tier:
    """A tier with its annotations, in order of the file."""

    name: str
    kind: str
    participant: str
    parent: str
    annotator: str = ""
    annotations: list[Annotation] = field(default_factory=list)

    @property
    def machine(self) -> bool:
        """Whether a program wrote it, and nobody else has put a name to it since."""
        return self.kind == MACHINE and self.annotator.split(" ")[0] == MACHINE

    @property
    def plain_name(self) -> str:
        """Its name without what ``writing`` puts behind it to tell people and overlapping rows apart."""
        if self.kind != MACHINE:
            return self.name
        plain = re.sub(r" \(\d+\)$", "", self.name)
        return plain.removesuffix(f"@{self.participant}") if self.participant else plain


def assign_times(out: Gathering, tiers: Sequence[Tier], slots: Mapping[str, float | None]) -> None:
    """Give annotations the times of their slots; those of slots without one lie evenly between their neighbours."""
    times = {name: time for name, time in slots.items() if time is not None}
    for tier in tiers:
        for one in tier.annotations:
            for slot in one.slots or ():
                if slot not in slots:
                    message = f"tier {quote(tier.name)}, annotation {one.name}: its time slot {quote(slot)} is not there"
                    raise error(out.asked.path, message, REMEDY)
    between = _fill(tiers, times, slots) if len(times) < len(slots) else 0
    nowhere = []
    for tier in tiers:
        for one in tier.annotations:
            if one.slots is None:
                continue
            if one.slots[0] in times and one.slots[1] in times:
                one.time = times[one.slots[0]], times[one.slots[1]]
            else:
                nowhere.append(f"{one.name} of {tier.name}")
    if between:
        out.note(f"{count(between, 'time')} that nobody set taken from the neighbours, as ELAN does")
    if nowhere:
        out.note(f"{count(len(nowhere), 'annotation')} left out: without a time ({listing(nowhere, NUM_NAMED)})")


def _fill(tiers: Sequence[Tier], times: dict[str, float], slots: Mapping[str, float | None]) -> int:
    """Times of slots that nobody set; of how many at which annotations begin or end."""
    for tier in tiers:
        _interpolate(tier, times)
    _between_neighbours(times, list(slots))
    used = {slot for tier in tiers for one in tier.annotations for slot in one.slots or ()}
    return sum(slots[slot] is None and slot in times for slot in used)


def _interpolate(tier: Tier, times: dict[str, float]) -> None:
    """Times of slots at which one annotation of a tier ends and the next begins."""
    following = {one.slots[0]: one.slots[1] for one in tier.annotations if one.slots is not None}
    for one in tier.annotations:
        if one.slots is None or one.slots[0] not in times or one.slots[1] in times:
            continue
        chain = [*one.slots]
        while chain[-1] not in times and chain[-1] in following and len(chain) <= len(following) + 1:
            chain.append(following[chain[-1]])
        if chain[-1] in times:
            first, last, parts = times[chain[0]], times[chain[-1]], len(chain) - 1
            for number, slot in enumerate(chain[1:-1], start=1):
                times[slot] = first + (last - first) * number / parts


def _between_neighbours(times: dict[str, float], order: Sequence[str]) -> None:
    """Times of slots that no chain of annotations leads to: evenly between those before and after them in the file."""
    last = -1
    for at, name in enumerate(order):
        if name not in times:
            continue
        if last >= 0 and at - last > 1 and times[order[last]] <= times[name]:
            first, step = times[order[last]], (times[name] - times[order[last]]) / (at - last)
            for number in range(last + 1, at):
                times[order[number]] = first + step * (number - last)
        last = at


def inherit_times(asked: Request, tiers: Sequence[Tier], asks: dict[str, str]) -> None:
    """Give annotations of symbolic tiers the time of their parent, or their share of it."""
    by_name = {one.name: one for tier in tiers for one in tier.annotations}
    home = {one.name: tier for tier in tiers for one in tier.annotations}
    shares: dict[str, tuple[int, int]] = {}
    for tier in tiers:
        if asks.get(tier.kind) == "Symbolic_Subdivision":
            shares.update(_shares(asked, tier))
    waiting = [one for tier in tiers for one in tier.annotations if one.slots is None]
    settled = {one.name for tier in tiers for one in tier.annotations if one.slots is not None}
    for one in waiting:
        for link in reversed(list(_upwards(asked, one, by_name, home, settled))):
            settled.add(link.name)
            parent = by_name[link.parent].time
            if parent is not None:
                number, parts = shares.get(link.name, (0, 1))
                part = (parent[1] - parent[0]) / parts
                link.time = parent[0] + number * part, parent[1] if number == parts - 1 else parent[0] + (number + 1) * part


def _upwards(
    asked: Request, one: Annotation, by_name: dict[str, Annotation], home: dict[str, Tier], settled: set[str]
) -> Iterator[Annotation]:
    """An annotation and those above it, up to one whose time is settled."""
    seen: set[str] = set()
    while one.name not in settled:
        where = f"tier {quote(home[one.name].name)}, annotation {one.name}"
        if one.name in seen:
            raise error(asked.path, f"{where}: it is its own parent, by way of {listing(seen, 4)}", REMEDY)
        seen.add(one.name)
        yield one
        if one.parent not in by_name:
            raise error(asked.path, f"{where}: its parent {quote(one.parent)} is not there", REMEDY)
        one = by_name[one.parent]


def _shares(asked: Request, tier: Tier) -> dict[str, tuple[int, int]]:
    """Which part of its parent each annotation of a subdividing tier is, of how many."""
    families: dict[str, list[Annotation]] = {}
    for one in tier.annotations:
        families.setdefault(one.parent, []).append(one)
    shares = {}
    for family in families.values():
        after = {one.previous: one for one in family if one.previous}
        chain: list[Annotation] = []
        for first in (one for one in family if not one.previous):
            link: Annotation | None = first
            while link is not None and len(chain) < len(family):
                chain.append(link)
                link = after.get(link.name)
        if len(chain) != len(family):
            chained = {one.name for one in chain}
            lost = next(one for one in family if one.name not in chained)
            where = f"tier {quote(tier.name)}, annotation {lost.name}"
            raise error(asked.path, f"{where}: that before it, {quote(lost.previous)}, is not of the same parent", REMEDY)
        shares.update({one.name: (number, len(chain)) for number, one in enumerate(chain)})
    return shares
