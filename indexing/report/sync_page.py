"""The sections of the report on a synchronization, as HTML."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from indexing.report.page import Card, Column, cards, escape, picture, provenance, section, sentence, table
from indexing.report.sync_picture import DRAWN

if TYPE_CHECKING:
    from indexing.report.sync import Clock, Compared, SyncReport

METHODS = {
    "epipolar": "same points, epipolar",
    "affine": "same points, affine",
    "subspace": "different points, subspaces",
    "brightness": "brightness",
}
PPM = 1e6
UNKNOWN = 1e3  # seconds of standard deviation that say nothing


def body(report: SyncReport, drawn: tuple[bytes, bytes], videos: Sequence[str] = ()) -> str:
    """The page's sections: headline numbers, notes, curves, clocks, pairs, settings."""
    parts = [cards(_headline(report)), _notes(report), _curves(report, drawn), _clocks(report, videos), _pairs(report)]
    return "\n".join(part for part in [*parts, provenance(report.manifest)] if part)


def describe(report: SyncReport) -> str:
    """The result in plain words."""
    others = report.clocks[1:]
    if not report.ok:
        start = f"The recordings do not decide how the clocks of the cameras run. {sentence(report.reason)}"
        found = any(len(pair.shift.peaks) for pair in report.pairs)
        return f"{start} What follows is the best candidate, and not to be relied on." if found else start
    if len(others) == 1:
        first, other = report.reference, others[0]
        began = float(other.inverse(other.start)) - first.start
        way = "after" if began >= 0 else "before"
        drift = f", and its clock gains {drift_of(other)} s in an hour" if other.rate != 1 else ""
        frames = f"{abs(began) * first.fps:.2f} frames"
        return f"{other.name} began {abs(began):.3f} ± {other.sigma:.3f} s {way} {first.name} ({frames}){drift}."
    return (
        f"The clocks of {len(report.clocks)} cameras, told on the clock of {report.reference.name}, from {len(report.pairs)} pairs."
    )


def drift_of(clock: Clock) -> str:
    """Seconds that a clock gains on the reference in an hour.

    Example:
        >>> from indexing.report.sync import Clock
        >>> drift_of(Clock("b", "b", 30.0, False, 9, 0.0, 1.0, 0.0, 0.0, rate=1.00001))
        '+0.036'
    """
    return f"{3600 * (clock.rate - 1):+.3g}"


def _sigma(seconds: float) -> str:
    return f"{seconds:.4f}" if seconds < UNKNOWN else "unknown"


def ppm(rate: float, sigma: float | None = None) -> str:
    """How much faster a clock runs than another, in millionths.

    Example:
        >>> ppm(1.00002, 3e-6), ppm(1.0), ppm(1 - 1e-12)
        ('+20 ± 3', '0', '0')
    """
    much = round(PPM * (rate - 1))
    return "0" if rate == 1 or not (much or sigma) else f"{much:+d}" + ("" if sigma is None else f" ± {PPM * sigma:.0f}")


def _headline(report: SyncReport) -> list[Card]:
    items = [Card("Status", "Solved" if report.ok else "Refused", "the recordings decide" if report.ok else "they do not decide")]
    if len(report.clocks) == 2:
        clock, pair = report.clocks[1], report.pairs[0]
        value, note = f"{pair.apart:+.4f} s", f"± {_sigma(clock.sigma)} s; {pair.apart * clock.fps:+.2f} frames"
        value, note = (value, note) if len(pair.shift.peaks) else ("none", "there was nothing to compare")
        items.append(Card("Offset" if report.ok else "Best candidate", value, note))
        note = f"± {PPM * clock.rate_sigma:.0f}; {drift_of(clock)} s an hour" if clock.rate != 1 else "nothing speaks for a drift"
        items.append(Card("Rate", f"{ppm(clock.rate)} ppm", note))
        items.append(Card("Confidence", f"{pair.shift.confidence:.3g}", "that the offset is right to a frame"))
        return items
    items.append(Card("Cameras", str(len(report.clocks)), f"on the clock of {report.reference.name}"))
    sure = sum(pair.shift.ok for pair in report.pairs)
    items.append(Card("Pairs", f"{sure} of {len(report.pairs)}", "decide by themselves"))
    if report.cycle is not None and np.isfinite(report.cycle):
        note = f"between pairs; {' and '.join(report.outlier)} stands out" if report.outlier else "between pairs, root mean square"
        items.append(Card("Cycle error", f"{1000 * report.cycle:.1f} ms", note))
    return items


def _notes(report: SyncReport) -> str:
    names = tuple(clock.name for clock in report.clocks)
    said = [note[:1] * note.startswith(names) + sentence(note)[note.startswith(names) :] for note in report.notes]  # names stay
    lines = [f"<li>{escape(note)}</li>" for note in said]
    if report.reason:
        lines.insert(0, f'<li><b class="bad">Refused.</b> {escape(sentence(report.reason))}</li>')
    return section("Please note", f"<ul>{''.join(lines)}</ul>") if lines else ""


def _curves(report: SyncReport, drawn: tuple[bytes, bytes]) -> str:
    if not any(len(pair.shift.lags) for pair in report.pairs):
        return ""
    note = "How well two cameras agree at every shift: one peak that stands out decides, several of one height do not."
    more = f" The first {DRAWN} of {len(report.pairs)} pairs." if len(report.pairs) > DRAWN else ""
    caption = (
        "Orange: the best shift, with its standard deviation in the close-up at the right; gray: the next best peaks. "
        "Shifts are those in the middle of what both cameras recorded."
    )
    return section("Score over shift", picture(drawn[0], "Score over the shift", dark=drawn[1], caption=caption + more), note)


def _clocks(report: SyncReport, videos: Sequence[str]) -> str:
    rows, shifted = [], any(clock.shifted is not None for clock in report.clocks)
    for clock in report.clocks:
        first = clock is report.reference
        offset = f"{clock.offset:+.4f} ± {_sigma(clock.sigma)}" if clock.sigma < UNKNOWN else "unknown"
        numbers = [
            f"{clock.fps:.6g}{' (assumed)' if clock.fps_assumed else ''}",
            "reference" if first else offset,
            "" if first or clock.sigma >= UNKNOWN else f"{clock.offset * clock.fps:+.2f}",
            "" if first else ppm(clock.rate, clock.rate_sigma),
        ]
        rest = "" if clock.shifted is None else f"{1000 * clock.shifted['rest']:.1f} ms"
        numbers += [_moved(clock), rest] if shifted else []
        rows.append([f"{escape(clock.name)}<span class='quiet'>{escape(clock.path)}</span>", *map(escape, numbers)])
    names = ("Frames/s", "Offset, s", "Offset, frames", "Rate, ppm", *(("Frame numbers", "Greatest rest") if shifted else ()))
    shown = table([Column("Camera"), *(Column(name, "number") for name in names)], rows, caption="Clocks", css="stack")
    note = "A camera's time is the reference's time multiplied by its rate, plus its offset."
    if shifted:
        note += " Files in pose-sync have equal frame numbers for equal moments; what whole frames cannot say is the rest."
    seen = f'<p class="note">The same moments side by side: {escape(", ".join(videos))}.</p>' if videos else ""
    return section("Clocks", shown + seen, note)


def _moved(clock: Clock) -> str:
    if clock.shifted is None:
        return ""
    shift = clock.shifted["shift"]
    return "nearest frames" if shift is None else f"{-shift:+d}" if shift else "unchanged"


def _pairs(report: SyncReport) -> str:
    rows = []
    for pair in report.pairs:
        shift, rival = pair.shift, pair.runner_up
        state = '<span class="good">ok</span>' if shift.ok else f'<span class="bad">refused</span>: {escape(shift.reason)}'
        figures = [
            f"{pair.apart:+.4f} ± {_sigma(shift.sigma)}" if len(shift.peaks) else "none",
            ppm(shift.rate),
            f"{shift.confidence:.3g}",
            "none" if rival is None else f"{rival[0]:+.3f}",
            "" if not np.isfinite(pair.residual) else f"{1000 * pair.residual:+.1f}",
        ]
        wrong = f"<span class='quiet'>inconsistent: {escape(', '.join(pair.wrong))}</span>" if pair.wrong and shift.ok else ""
        name = f"{escape(pair.a)} → {escape(pair.b)}<span class='quiet'>{escape(METHODS.get(shift.method, shift.method))}</span>"
        rows.append([name, *figures, state + _people(pair) + wrong])
    heads = ["Offset, s", "Rate, ppm", "Confidence", "Next peak, s", "Residual, ms"]
    columns = [Column("Pair"), *(Column(name, "number") for name in heads), Column("Status", "long")]
    if len(report.clocks) == 2:  # there is nothing else that the pair could be off
        columns.pop(5)
        rows = [[*row[:5], row[6]] for row in rows]
    note = "Every pair by itself, in the middle of what both cameras recorded."
    note += " The residual is what it is off the clocks of all cameras." if len(report.clocks) > 2 else ""
    return section("Pairs", table(columns, rows, caption="Pairs", css="stack"), note)


def _people(pair: Compared) -> str:
    if not any(pair.people):
        return ""
    return f"<span class='quiet'>compared: {escape(pair.people[0])} with {escape(pair.people[1])}</span>"
