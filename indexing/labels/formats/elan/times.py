"""When annotations of ELAN begin and end: by their slots, by their neighbours, or by the annotation that they belong to."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from indexing.labels.format import Gathering, Request
from indexing.labels.label import NUM_NAMED
from indexing.opening import count, error, listing, shown

REMEDY = "open it in ELAN, mend it and save it again"
MACHINE = (
    "dyntorch"  # the linguistic type of tiers that a program wrote, and how their annotator begins until a person takes them over
)


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


def place(out: Gathering, tiers: Sequence[Tier], slots: Mapping[str, float | None]) -> None:
    """Give annotations the times of their slots; those of slots without one lie evenly between their neighbours."""
    known = {name: time for name, time in slots.items() if time is not None}
    for tier in tiers:
        for one in tier.annotations:
            for slot in one.slots or ():
                if slot not in slots:
                    said = f"tier {shown(tier.name)}, annotation {one.name}: its time slot {shown(slot)} is not there"
                    raise error(out.asked.path, said, REMEDY)
    between = _fill(tiers, known, slots) if len(known) < len(slots) else 0
    nowhere = []
    for tier in tiers:
        for one in tier.annotations:
            if one.slots is None:
                continue
            if one.slots[0] in known and one.slots[1] in known:
                one.time = known[one.slots[0]], known[one.slots[1]]
            else:
                nowhere.append(f"{one.name} of {tier.name}")
    if between:
        out.note(f"{count(between, 'time')} that nobody set taken from the neighbours, as ELAN does")
    if nowhere:
        out.note(f"{count(len(nowhere), 'annotation')} left out: without a time ({listing(nowhere, NUM_NAMED)})")


def _fill(tiers: Sequence[Tier], known: dict[str, float], slots: Mapping[str, float | None]) -> int:
    """Times of slots that nobody set; of how many at which annotations begin or end."""
    for tier in tiers:
        _interpolate(tier, known)
    _between_neighbours(known, list(slots))
    used = {slot for tier in tiers for one in tier.annotations for slot in one.slots or ()}
    return sum(slots[slot] is None and slot in known for slot in used)


def _interpolate(tier: Tier, known: dict[str, float]) -> None:
    """Times of slots at which one annotation of a tier ends and the next begins."""
    following = {one.slots[0]: one.slots[1] for one in tier.annotations if one.slots is not None}
    for one in tier.annotations:
        if one.slots is None or one.slots[0] not in known or one.slots[1] in known:
            continue
        chain = [*one.slots]
        while chain[-1] not in known and chain[-1] in following and len(chain) <= len(following) + 1:
            chain.append(following[chain[-1]])
        if chain[-1] in known:
            first, last, parts = known[chain[0]], known[chain[-1]], len(chain) - 1
            for number, slot in enumerate(chain[1:-1], start=1):
                known[slot] = first + (last - first) * number / parts


def _between_neighbours(known: dict[str, float], order: Sequence[str]) -> None:
    """Times of slots that no chain of annotations leads to: evenly between those before and after them in the file."""
    last = -1
    for at, name in enumerate(order):
        if name not in known:
            continue
        if last >= 0 and at - last > 1 and known[order[last]] <= known[name]:
            first, step = known[order[last]], (known[name] - known[order[last]]) / (at - last)
            for number in range(last + 1, at):
                known[order[number]] = first + step * (number - last)
        last = at


def take_over(asked: Request, tiers: Sequence[Tier], asks: dict[str, str]) -> None:
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
        where = f"tier {shown(home[one.name].name)}, annotation {one.name}"
        if one.name in seen:
            raise error(asked.path, f"{where}: it is its own parent, by way of {listing(seen, 4)}", REMEDY)
        seen.add(one.name)
        yield one
        if one.parent not in by_name:
            raise error(asked.path, f"{where}: its parent {shown(one.parent)} is not there", REMEDY)
        one = by_name[one.parent]


def _shares(asked: Request, tier: Tier) -> dict[str, tuple[int, int]]:
    """Which part of its parent each annotation of a subdividing tier is, of how many."""
    families: dict[str, list[Annotation]] = {}
    for one in tier.annotations:
        families.setdefault(one.parent, []).append(one)
    found = {}
    for family in families.values():
        after = {one.previous: one for one in family if one.previous}
        chain: list[Annotation] = []
        for first in (one for one in family if not one.previous):
            link: Annotation | None = first
            while link is not None and len(chain) < len(family):
                chain.append(link)
                link = after.get(link.name)
        if len(chain) != len(family):
            told = {one.name for one in chain}
            lost = next(one for one in family if one.name not in told)
            where = f"tier {shown(tier.name)}, annotation {lost.name}"
            raise error(asked.path, f"{where}: that before it, {shown(lost.previous)}, is not of the same parent", REMEDY)
        found.update({one.name: (number, len(chain)) for number, one in enumerate(chain)})
    return found
