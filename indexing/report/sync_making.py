"""From what the comparisons of cameras say to the report on them."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from indexing.report.sync import Clock, Compared, SyncReport
from indexing.syncing.people import Pairing, joint_names, who
from indexing.syncing.takes import Take

LEFT_OUT = "never agree with the others and were left out"  # of points: they are named beside their pair


def reported(
    takes: list[Take],
    compared: Mapping[tuple[int, int], Pairing],
    clocks: Any,
    notes: Sequence[str],
    title: str | None = None,
    words: Callable[[str], str] = str,
) -> SyncReport:
    """The report on two cameras, from their pair, or on more, from the clocks of all.

    Args:
        takes: what the cameras recorded, the reference first.
        compared: ``(i, j)`` to what the comparison of these two says.
        clocks: of :func:`dyntorch.synchronize_cameras`; None for two cameras.
        notes: on the recordings.
        title: heading; by default what was found.
        words: what brings messages of the library into the words of whoever reads the report.
    """
    names = [take.name for take in takes]
    residuals = {} if clocks is None else {row.cameras: row.residual for row in clocks.pairs}
    pairs = [_compared(takes, ends, found, residuals.get(ends, math.nan), words) for ends, found in compared.items()]
    several = len(pairs) > 1
    told = [(one, note) for one in pairs for note in one.shift.notes if LEFT_OUT not in note or not one.wrong]
    own = [
        f"{one.a} and {one.b}: {note}" if several and not note.startswith((f"{one.a}: ", f"{one.b}: ")) else note
        for one, note in told
    ]
    ok, reason, cycle, outlier = (pairs[0].shift.ok, pairs[0].shift.reason, None, None)
    if clocks is not None:
        ok, reason, cycle = bool(clocks.ok), named(clocks.reason, names), float(clocks.cycle_error)
        outlier = (names[clocks.outliers[0][0]], names[clocks.outliers[0][1]]) if clocks.outliers else None
        repeated = {f"pair {i}-{j}: {note}" for (i, j), found in compared.items() for note in found.shift.notes}
        own = [named(note, names) for note in clocks.notes if note not in repeated] + own
    said = "Cameras on one clock" if several else f"{names[0]} and {names[1]} on one clock"
    return SyncReport(
        title=title or (said if ok else "The recordings do not decide"),
        clocks=_clocks(takes, pairs, clocks),
        pairs=pairs,
        ok=ok,
        reason=words(reason),
        cycle=cycle,
        outlier=outlier,
        notes=list(dict.fromkeys(words(note) for note in [*notes, *own])),
    )


def _compared(takes: list[Take], ends: tuple[int, int], found: Pairing, residual: float, words: Callable[[str], str]) -> Compared:
    a, b = (takes[i] for i in ends)
    several = len(a.people) > 1 or len(b.people) > 1
    people = (who(a, found.people[0]), who(b, found.people[1])) if several and a.people and b.people else ("", "")
    shift = dataclasses.replace(found.shift, reason=words(found.shift.reason))
    return Compared(a.name, b.name, shift, joint_names(a, b, found.people), residual, people)


def _clocks(takes: list[Take], pairs: list[Compared], clocks: Any) -> list[Clock]:
    if clocks is None:
        shift = pairs[0].shift
        values = [(0.0, 0.0, 1.0, 0.0), (shift.offset, shift.sigma, shift.rate, shift.rate_sigma)]
    else:
        columns = (clocks.offsets, clocks.sigmas, clocks.rates, clocks.rate_sigmas)
        values = list(zip(*(column.tolist() for column in columns), strict=True))
    return [
        Clock(
            take.name, str(take.path or ""), take.fps, take.fps_assumed, take.count,
            float(take.times[0]), float(take.times[-1]), *value,
        )
        for take, value in zip(takes, values, strict=True)
    ]  # fmt: skip


def named(text: str, names: Sequence[str]) -> str:
    """A message of the library with the cameras' names for their numbers.

    Example:
        >>> named("cameras 1, 2: the pairs 0-2, 1-2 contradict each other by 0.1 s", ["left", "mid", "right"])
        'cameras mid, right: the pairs left-right, mid-right contradict each other by 0.1 s'
    """

    def name(number: str) -> str:
        return names[int(number)] if int(number) < len(names) else number

    def found(match: re.Match[str]) -> str:
        if match["list"]:
            return match["word"] + ", ".join(name(number) for number in match["list"].split(", "))
        return f"{name(match['a'])}-{name(match['b'])}"

    return re.sub(r"\b(?P<word>cameras? )(?P<list>\d+(?:, \d+)*)|\b(?P<a>\d+)-(?P<b>\d+)\b", found, text)
