"""The report on a synchronization: how the clocks of the cameras run against each other, and how sure that is."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from indexing import files
from indexing.clip import Clip
from indexing.report.canvas import DARK, LIGHT, Theme, new_figure, png, shorten, style
from indexing.report.page import Card, Column, cards, escape, made_by, page, picture, provenance, section, sentence, table
from indexing.sync.people import Pairing, joint_names, who
from indexing.sync.takes import Take

# ----------------------------------------------------------------------------------------------------------------------
# The picture of a synchronization: the score over the shift, with its peaks, of every pair of cameras.


FloatArray = NDArray[np.float64]
WIDTH, TOP, ROW, GAP, FOOT = 10.2, 0.28, 1.75, 0.56, 0.5  # inches
LEFT, MIDDLE, CLOSE, EDGE = 0.55, 0.55, 2.6, 0.15  # inches: the left edge, between curve and close-up, the close-up, the right
DRAWN = 12  # pairs
NEAR = 12.0  # frames to both sides in the close-up
CURVE, BEST, OTHER = "#2f7fb8", "#e8741e", "#8b949c"
LISTED = 5  # peaks with a dot


def picture_of(report: SyncReport, theme: Theme) -> bytes:
    """PNG: a row for every pair, with the whole curve at the left and the peak close up at the right."""
    pairs = report.pairs[:DRAWN]
    height = TOP + len(pairs) * (ROW + GAP) - GAP + FOOT
    with style(theme):
        figure = new_figure(WIDTH, height)
        wide = WIDTH - LEFT - MIDDLE - CLOSE - EDGE
        for i, pair in enumerate(pairs):
            bottom = 1 - (TOP + ROW + i * (ROW + GAP)) / height
            whole = figure.add_axes((LEFT / WIDTH, bottom, wide / WIDTH, ROW / height))
            close = figure.add_axes(((LEFT + wide + MIDDLE) / WIDTH, bottom, CLOSE / WIDTH, ROW / height))
            _draw_curve(whole, pair, theme)
            _draw_close(close, pair, theme)
            if i == len(pairs) - 1:
                whole.set_xlabel("shift, seconds", fontsize=8.5)
                close.set_xlabel("frames from the best shift", fontsize=8.5)
        return png(figure)


def title_of(pair: Compared) -> str:
    """What a pair's curve says, in a line."""
    said = f"{shorten(pair.a, 24)} → {shorten(pair.b, 24)}: "
    return said + (f"{pair.apart:+.4f} ± {pair.shift.sigma:.4f} s" if pair.shift.ok else "refused")


def _draw_curve(panel: Any, pair: Compared, theme: Theme) -> None:
    lags, scores = _curve(pair)
    if not len(lags):
        panel.set_axis_off()
        panel.set_title(f"{title_of(pair)}, nothing to compare", fontsize=9, loc="left", parse_math=False)
        return
    panel.plot(lags, scores, color=CURVE, linewidth=1.0, zorder=3)
    peaks = np.array(pair.shift.peaks.tolist(), dtype=np.float64).reshape(-1, 2)[:LISTED]
    for rank, (offset, score) in reversed(list(enumerate(peaks.tolist()))):
        colour = BEST if rank == 0 else OTHER
        panel.plot([offset], [score], marker="o", markersize=5.5 if rank == 0 else 4, color=colour, zorder=5 - min(rank, 1))
    panel.axvline(pair.apart, color=BEST, linewidth=0.8, alpha=0.6, zorder=2)
    _finish(panel, title_of(pair), theme)
    panel.set_ylabel("score", fontsize=8.5)
    panel.set_xlim(lags[0], lags[-1] if lags[-1] > lags[0] else lags[0] + 1)


def _draw_close(panel: Any, pair: Compared, theme: Theme) -> None:
    lags, scores = _curve(pair)
    if not len(lags):
        panel.set_axis_off()
        return
    frame = 1.0 / pair.shift.fps[1]
    at = (lags - pair.apart) / frame
    near = np.abs(at) <= NEAR
    panel.plot(at[near], scores[near], color=CURVE, linewidth=1.0, marker=".", markersize=4, zorder=3)
    spread = pair.shift.sigma / frame
    if np.isfinite(spread):
        panel.axvspan(-min(spread, NEAR), min(spread, NEAR), color=BEST, alpha=0.25, linewidth=0, zorder=1)
    panel.axvline(0.0, color=BEST, linewidth=0.8, alpha=0.6, zorder=2)
    _finish(panel, f"close up, ± {spread:.2g} frames" if np.isfinite(spread) else "close up", theme)
    panel.set_xlim(-NEAR, NEAR)


def _curve(pair: Compared) -> tuple[FloatArray, FloatArray]:
    """The finite part of the curve."""
    lags, scores = (np.asarray(values.detach().cpu().numpy(), dtype=np.float64) for values in (pair.shift.lags, pair.shift.scores))
    known = np.isfinite(scores)
    return lags[known], scores[known]


def _finish(panel: Any, title: str, theme: Theme) -> None:
    panel.set_title(title, fontsize=9, loc="left", parse_math=False)
    panel.grid(color=theme.line, linewidth=0.5, zorder=0)
    panel.set_axisbelow(True)
    panel.tick_params(length=2.5, labelsize=7.5)
    panel.margins(y=0.12)
    for name, side in panel.spines.items():
        side.set_linewidth(0.8)
        side.set_visible(name in ("left", "bottom"))


# ----------------------------------------------------------------------------------------------------------------------
# The sections of the report on a synchronization, as HTML.


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


if TYPE_CHECKING:
    from dyntorch import Shift

FILES = ("report.html", "sync.json", "curve.png")


@dataclass(frozen=True, eq=False)
class Clock:
    """One camera: its clock is the reference's times ``rate`` plus ``offset``.

    Args:
        name: of the camera.
        path: of its file or folder.
        fps: frames per second.
        fps_assumed: nobody said how many.
        frames: how many; 0 where that is not known.
        start, end: seconds, the first and the last frame on its own clock.
        offset, sigma: seconds.
        rate, rate_sigma: of this clock against the reference's.
        shifted: what was written of it: folder, files, frame shift, rest in seconds, frames repeated and left out.
    """

    name: str
    path: str
    fps: float
    fps_assumed: bool
    frames: int
    start: float
    end: float
    offset: float
    sigma: float
    rate: float = 1.0
    rate_sigma: float = 0.0
    shifted: Mapping[str, Any] | None = None

    def at(self, times: Any) -> Any:
        """Times of this clock, of the moments at ``times`` of the reference's."""
        return times * self.rate + self.offset

    def inverse(self, times: Any) -> Any:
        """Times of the reference's clock, of the moments at ``times`` of this one."""
        return (times - self.offset) / self.rate


@dataclass(frozen=True, eq=False)
class Compared:
    """Two cameras, and what their comparison says.

    Args:
        a, b: names of the cameras; the shift is of b's clock against a's.
        shift: of :func:`dyntorch.synchronize`.
        names: of the corresponding points; empty where unknown.
        residual: seconds that the pair is off the common solution of all cameras; NaN for two cameras.
        people: which person of each was compared.
    """

    a: str
    b: str
    shift: Shift
    names: Sequence[str] = ()
    residual: float = math.nan
    people: tuple[str, str] = ("", "")

    @property
    def apart(self) -> float:
        """Seconds between the clocks in the middle of the overlap."""
        return float(self.shift.at(self.shift.center)) - self.shift.center

    @property
    def wrong(self) -> list[str]:
        """Names of points that are never consistent with the others."""
        if self.shift.points is None:
            return []
        bad = [i for i, good in enumerate(self.shift.points.tolist()) if not good]
        return [f"{self.names[i]} (joint {i})" if i < len(self.names) else f"joint {i}" for i in bad]

    @property
    def runner_up(self) -> tuple[float, float] | None:
        """Offset and score of the next best peak."""
        peaks = self.shift.peaks.tolist()
        return (float(peaks[1][0]), float(peaks[1][1])) if len(peaks) > 1 else None


@dataclass(frozen=True, eq=False)
class SyncReport:
    """Everything that the report on a synchronization says.

    Args:
        title: heading of the page.
        clocks: of the cameras, the reference first.
        pairs: all that were compared.
        ok: whether the data decide.
        reason: why not, and what to do.
        cycle: seconds, root mean square of what the pairs of more than two cameras are off their common solution; None for two.
        outlier: the pair that contradicts the others, if one does.
        notes: what a user should know besides, a sentence each.
        manifest: of :func:`indexing.files.manifest`.
    """

    title: str
    clocks: Sequence[Clock]
    pairs: Sequence[Compared]
    ok: bool
    reason: str = ""
    cycle: float | None = None
    outlier: tuple[str, str] | None = None
    notes: Sequence[str] = ()
    manifest: Mapping[str, Any] = field(default_factory=dict)

    @property
    def reference(self) -> Clock:
        """The camera whose clock the others are told on."""
        return self.clocks[0]


def write_sync(folder: str | Path, report: SyncReport, videos: Sequence[str] = ()) -> Path:
    """Write the report into a folder: ``curve.png``, ``sync.json`` and ``report.html``, each whole or not at all.

    Args:
        videos: names of the check videos in the folder.

    Returns:
        the path of ``report.html``.

    Raises:
        ValueError: the folder or a file in it cannot be written.
    """
    where = files.prepare(folder)
    drawn = picture_of(report, LIGHT), picture_of(report, DARK)
    html = page(
        report.title, body(report, drawn, videos), summary=describe(report), kind="Cameras on one clock",
        footer=made_by(report.manifest),
    )  # fmt: skip
    files.write_bytes(where / "curve.png", drawn[0])
    files.write_json(where / "sync.json", as_json(report))
    return files.write_text(where / "report.html", html)


def as_json(report: SyncReport) -> dict[str, Any]:
    """The result as numbers; ``camera time = reference time * rate + offset``, in seconds."""
    return {
        "ok": report.ok,
        "reason": report.reason or None,
        "reference": report.reference.name,
        "cameras": [
            {
                "name": clock.name, "path": clock.path, "fps": clock.fps, "fps_assumed": clock.fps_assumed,
                "frames": clock.frames or None, "start": clock.start, "end": clock.end,
                "offset": clock.offset, "offset_frames": clock.offset * clock.fps, "sigma": clock.sigma,
                "rate": clock.rate, "rate_sigma": clock.rate_sigma, "shifted": clock.shifted,
            }
            for clock in report.clocks
        ],
        "pairs": [_pair_json(pair) for pair in report.pairs],
        "cycle_error": report.cycle,
        "outlier_pair": list(report.outlier) if report.outlier else None,
        "notes": list(report.notes),
        "manifest": report.manifest,
    }  # fmt: skip


def _pair_json(pair: Compared) -> dict[str, Any]:
    shift = pair.shift
    fundamental = None if shift.fundamental is None else shift.fundamental.tolist()
    return {
        "a": pair.a, "b": pair.b, "ok": shift.ok, "reason": shift.reason or None, "method": shift.method, "offset": shift.offset,
        "offset_frames": shift.frames, "sigma": shift.sigma, "rate": shift.rate, "rate_sigma": shift.rate_sigma,
        "confidence": shift.confidence, "center": shift.center, "offset_at_center": pair.apart, "fps": list(shift.fps),
        "peaks": [{"offset": offset, "score": score} for offset, score in shift.peaks.tolist()],
        "wrong_points": pair.wrong, "people": list(pair.people) if any(pair.people) else None, "residual": pair.residual,
        "fundamental": fundamental, "notes": list(shift.notes),
    }  # fmt: skip


# ----------------------------------------------------------------------------------------------------------------------
# From what the comparisons of cameras say to the report on them.


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
        clocks=_making_clocks(takes, pairs, clocks),
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


def _making_clocks(takes: list[Take], pairs: list[Compared], clocks: Any) -> list[Clock]:
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


# ----------------------------------------------------------------------------------------------------------------------
# Videos to check a synchronization by: the reference camera beside each of the others, at the same moments.


if TYPE_CHECKING:
    from indexing.sync.people import Pairing


def names_of(cameras: Sequence[str]) -> list[str]:
    """The files' names: ``check.mp4`` for two cameras, one for each but the reference for more.

    Example:
        >>> names_of(["left", "right"]), names_of(["cam1", "cam2", "cam3"])
        (['check.mp4'], ['check-cam2.mp4', 'check-cam3.mp4'])
    """
    return ["check.mp4"] if len(cameras) == 2 else [f"check-{name}.mp4" for name in cameras[1:]]


def write_checks(
    folder: Path, takes: Sequence[Take], report: SyncReport, found: dict[tuple[int, int], Pairing]
) -> tuple[list[str], list[str]]:
    """Write the videos: the names of those written, and notes on those that could not be.

    Keypoints are drawn as stick figures.
    """
    from indexing.video import write_check_video

    written, notes = [], []
    for i, name in enumerate(names_of([take.name for take in takes]), start=1):
        people = found[0, i].people if (0, i) in found else (0, 0)
        first, other = (_shown(take, person) for take, person in zip((takes[0], takes[i]), people, strict=True))
        try:
            write_check_video(folder / name, first, other, report.clocks[i], names=(takes[0].name, takes[i].name))
            written.append(name)
        except ValueError as problem:
            notes.append(f"{name} was not written: {problem}")
    return written, notes


def drop_checks(folder: Path, written: Sequence[str]) -> None:
    """Remove the check videos of an earlier run that this one did not write again: they show cameras of other files."""
    try:
        known = json.loads((folder / "sync.json").read_text(encoding="utf-8"))
        asked = known["manifest"]["arguments"]
        ours = asked["command"] == "sync" and asked["check"]
        names = names_of([str(camera["name"]) for camera in known["cameras"]]) if ours else []
    except (OSError, ValueError, KeyError, TypeError):
        return
    for name in set(names) - set(written):
        if Path(name).name == name:
            with contextlib.suppress(OSError):
                (folder / name).unlink()


def _shown(take: Take, person: int) -> Path | Clip:
    if take.kind == "keypoints":
        return take.people[person]
    assert take.path is not None  # the command line has no frames without a file
    return take.path
