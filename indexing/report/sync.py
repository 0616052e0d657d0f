"""The report on a synchronization: how the clocks of the cameras run against each other, and how sure that is."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dyntorch.numerics import as_python, with_words
from indexing.opening import count
from indexing.report.canvas import LIGHT, new_figure, png, shorten, style
from indexing.report.page import markup, notes_with_names, quiet, sentence
from indexing.report.summary import Summary, Table, register_page
from indexing.sync.people import Pairing, joint_names, person_label
from indexing.sync.recordings import Take, accepted_notices
from indexing.sync.synchronize import RepairedClocks

if TYPE_CHECKING:
    from dyntorch import Shift

FloatArray = NDArray[np.float64]
FILES = ("report.html", "sync.json", "curve.png")
METHODS = {
    "epipolar": "same points, epipolar",
    "affine": "same points, affine",
    "camera": "a camera and the same points in space",
    "subspace": "different points, subspaces",
    "brightness": "brightness",
    "sound": "sound",
}
PPM = 1e6
REFUSALS = 3  # pairs whose refusals the terminal prints
UNKNOWN = 1e3  # seconds of standard deviation that say nothing


@dataclass(frozen=True, eq=False)
class Clock:
    """One camera: its clock is the reference's times ``rate`` plus ``offset``."""

    take: Take
    offset: float
    sigma: float
    rate: float = 1.0
    rate_sigma: float = 0.0
    shifted: Mapping[str, Any] | None = None

    @property
    def name(self) -> str:
        """The camera's."""
        return self.take.name

    @property
    def start(self) -> float:
        """Seconds, the first frame on its own clock."""
        return float(self.take.times[0])

    def at(self, times: Any) -> Any:
        """Times of this clock, of the moments at ``times`` of the reference's."""
        return times * self.rate + self.offset

    def inverse(self, times: Any) -> Any:
        """Times of the reference's clock, of the moments at ``times`` of this one."""
        return (times - self.offset) / self.rate

    def against(self, first: Clock) -> Clock:
        """The same clock, told on another camera's than the reference's."""
        rate = self.rate / first.rate
        return dataclasses.replace(self, offset=self.offset - rate * first.offset, rate=rate)


@dataclass(frozen=True, eq=False)
class Compared:
    """Two cameras, and what their comparison says."""

    a: Take
    b: Take
    pairing: Pairing
    residual: float = math.nan
    reason: str = ""

    @property
    def shift(self) -> Shift:
        """Of b's clock against a's."""
        return self.pairing.shift

    @property
    def people(self) -> tuple[str, str]:
        """Which person of each was compared, where there are several."""
        several = len(self.a.people) > 1 or len(self.b.people) > 1
        if not several or not self.a.people or not self.b.people:
            return "", ""
        return person_label(self.a, self.pairing.people[0]), person_label(self.b, self.pairing.people[1])

    @property
    def offset_at_center(self) -> float:
        """Seconds between the clocks in the middle of the overlap."""
        return self.pairing.offset_at_center

    @property
    def wrong(self) -> list[str]:
        """Names of points that are never consistent with the others."""
        if self.shift.points is None:
            return []
        names = joint_names(self.a, self.b, self.pairing.people)
        bad = [i for i, good in enumerate(self.shift.points.tolist()) if not good]
        return [f"{names[i]} (joint {i})" if i < len(names) else f"joint {i}" for i in bad]

    @property
    def runner_up(self) -> tuple[float, float] | None:
        """Offset and score of the next best peak."""
        peaks = self.shift.peaks.tolist()
        return (float(peaks[1][0]), float(peaks[1][1])) if len(peaks) > 1 else None


@dataclass(frozen=True, eq=False, kw_only=True)
class SyncReport:
    """Everything that the report on two cameras says, from their pair, or on more, from the clocks of all. compared
    ``(i, j)``."""

    takes: Sequence[Take]
    compared: Mapping[tuple[int, int], Pairing]
    together: Any = None
    remarks: Sequence[str] = ()
    afterwards: Sequence[str] = ()
    shifted: Mapping[int, Mapping[str, Any]] = field(default_factory=dict)
    videos: Mapping[str, Any] = field(default_factory=dict)
    mended: RepairedClocks | None = None
    checks: Sequence[str] = ()
    """Names of the check videos."""
    folder: Path | None = None
    """Where it was written."""
    heading: str = ""
    words: Callable[[str, str | None], str] = as_python
    manifest: Mapping[str, Any] = field(default_factory=dict)

    @functools.cached_property
    def names(self) -> list[str]:
        """Of the cameras."""
        return [take.name for take in self.takes]

    @functools.cached_property
    def pairs(self) -> list[Compared]:
        """All that were compared."""
        residuals = {} if self.together is None else {row.cameras: row.residual for row in self.together.pairs}
        return [
            Compared(self.takes[i], self.takes[j], found, residuals.get((i, j), math.nan), found.shift.refusal(self.words))
            for (i, j), found in self.compared.items()
        ]

    @functools.cached_property
    def clocks(self) -> list[Clock]:
        """Of the cameras, the reference first."""
        if self.together is None:
            shift = self.pairs[0].shift
            values = [(0.0, 0.0, 1.0, 0.0), (shift.offset, shift.sigma, shift.rate, shift.rate_sigma)]
        else:
            columns = (self.together.offsets, self.together.sigmas, self.together.rates, self.together.rate_sigmas)
            values = list(zip(*(column.tolist() for column in columns), strict=True))
        return [Clock(self.takes[i], *value, self.shifted.get(i)) for i, value in enumerate(values)]

    @property
    def reference(self) -> Clock:
        """The camera whose clock the others are told on."""
        return self.clocks[0]

    @property
    def ok(self) -> bool:
        """Whether the data decide."""
        return bool(self.pairs[0].shift.ok if self.together is None else self.together.ok)

    @property
    def num_decided(self) -> int:
        """How many pairs decide by themselves."""
        return sum(bool(pair.shift.ok) for pair in self.pairs)

    @property
    def refusal(self) -> str | None:
        """Why the data do not decide, and what to do; None where they do."""
        return None if self.ok else self.reason

    @property
    def reason(self) -> str:
        """Why not, and what to do."""
        return self.pairs[0].reason if self.together is None else str(self.spoken.refusal(self.words))

    @functools.cached_property
    def spoken(self) -> Any:
        """The clocks of all cameras, whose notices call them by name."""
        names = {str(number): name for number, name in enumerate(self.names)}
        return dataclasses.replace(self.together, notices=tuple(notice.with_names(names) for notice in self.together.notices))

    @property
    def cycle(self) -> float | None:
        """Seconds, root mean square of what the pairs of more than two cameras are off their common solution; None for two."""
        return None if self.together is None else float(self.together.cycle_error)

    @property
    def outlier(self) -> tuple[str, str] | None:
        """The pair that contradicts the others, if one does."""
        found = [] if self.together is None else self.together.outliers
        return (self.names[found[0][0]], self.names[found[0][1]]) if found else None

    @property
    def title(self) -> str:
        """Heading of the page."""
        said = "Cameras on one clock" if len(self.pairs) > 1 else f"{self.names[0]} and {self.names[1]} on one clock"
        return self.heading or (said if self.ok else "The recordings do not decide")

    @functools.cached_property
    def notes(self) -> list[str]:
        """What a user should know besides, a sentence each."""
        own = []
        for one in self.pairs:
            for notice in accepted_notices(one.shift):
                if notice.code == "left_out" and one.wrong:  # these points are named beside their pair
                    continue
                alone = len(self.pairs) == 1 or notice.values.get("camera")  # or it names the camera that it is about
                said = notice.with_words(self.words).text
                own.append(str(said) if alone else f"{one.a.name} and {one.b.name}: {said}")
        if self.together is not None:  # what the pairs say is told with them
            more = [notice for notice in accepted_notices(self.spoken) if notice.code != "of_pair"]
            own = [str(notice.with_words(self.words).text) for notice in more] + own
        broke = [] if self.mended is None else [str(notice.with_words(self.words).text) for notice in self.mended.found.notices]
        broke += ["offsets, rates and written files are as if no frame had been lost or doubled"] * bool(broke)
        return [*dict.fromkeys([*(with_words(note, self.words) for note in self.remarks), *broke, *own]), *self.afterwards]


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
        drift = f", and its clock gains {drift_of(other.rate)} s in an hour" if other.rate != 1 else ""
        frames = f"{abs(began) * first.take.fps:.2f} frames"
        return f"{other.name} began {abs(began):.3f} ± {other.sigma:.3f} s {way} {first.name} ({frames}){drift}."
    return (
        f"The clocks of {len(report.clocks)} cameras, told on the clock of {report.reference.name}, from {len(report.pairs)} pairs."
    )


@register_page(SyncReport, "sync", FILES)
def summarize(report: SyncReport) -> Summary:
    """Everything that is said of a synchronization, and of what was written of it."""
    tables, closing = [_pairs_table(report)], []
    if len(report.clocks) > 2:
        tables.append(_clocks_table(report))
    elif report.ok:
        closing.append(_clock_sentence(report))
    for pair in report.pairs:
        if pair.wrong and pair.shift.ok:
            closing.append(f"inconsistent joints of {pair.a.name} and {pair.b.name}: {', '.join(pair.wrong)}")
    refused = [pair for pair in report.pairs if not pair.shift.ok] if len(report.pairs) > 1 else []
    closing += [f"{pair.a.name} and {pair.b.name} refused: {pair.reason}" for pair in refused[:REFUSALS]]
    closing += [f"and {len(refused) - REFUSALS} more pairs refused"] if len(refused) > REFUSALS else []
    closing += [*(f"note: {note}" for note in report.notes), *_written_sentences(report)]
    return Summary(
        headline=describe(report), tables=tables, closing=closing, pictures={"curve.png": lambda theme: picture_of(report)},
        files={"sync.json": partial(as_json, report)}, values=partial(page_values, report),
    )  # fmt: skip


def _clock_sentence(report: SyncReport) -> str:
    """When the second of two cameras began, and how its clock runs."""
    first, other = report.clocks
    began = float(other.inverse(other.start)) - first.start
    factor = "" if other.rate == 1 else f" * {other.rate:.6f}"
    when = f"{abs(began):.4f} s {'after' if began >= 0 else 'before'}"
    sign = "-" if other.offset < 0 else "+"
    clock = f"time of {other.name} = time of {first.name}{factor} {sign} {abs(other.offset):.4f} s"
    return f"{other.name} began {when} {first.name}: {clock}"


def _pairs_table(report: SyncReport) -> Table:
    """The pairs as the terminal prints them."""

    rows: list[list[object]] = []
    for pair in report.pairs:
        shift, rival = pair.shift, pair.runner_up
        numbers = [
            f"{pair.offset_at_center:+.4f}" if len(shift.peaks) else "none",
            f"{shift.sigma:.4f}" if shift.sigma < UNKNOWN else "unknown",
            f"{pair.offset_at_center * shift.fps[1]:+.2f}" if len(shift.peaks) else "none",
            ppm(shift.rate, shift.rate_sigma),
            f"{shift.confidence:.3f}",
        ]
        rows.append(
            [f"{pair.a.name} → {pair.b.name}", *numbers, f"{rival[0]:+.3f}" if rival else "none", "ok" if shift.ok else "refused"]
        )
    where = "offset s (mid) " if any(pair.shift.rate != 1 for pair in report.pairs) else "offset s "
    return Table(["pair", where, "± s ", "frames ", "rate ppm ", "confidence ", "next peak s ", "status"], rows)


def _clocks_table(report: SyncReport) -> Table:
    """The clocks of all cameras as the terminal prints them."""

    rows = [
        [
            clock.name,
            f"{clock.offset:+.4f}",
            f"{clock.sigma:.4f}" if clock.sigma < UNKNOWN else "unknown",
            f"{clock.offset * clock.take.fps:+.2f}",
            ppm(clock.rate),
        ]
        for clock in report.clocks
    ]
    below = []
    if report.cycle is not None and math.isfinite(report.cycle):
        out = f"; {report.outlier[0]} - {report.outlier[1]} contradicts the others" if report.outlier else ""
        below.append(f"cycle error: {1000 * report.cycle:.2f} ms{out}")
    return Table([f"clock against {report.reference.name}", "offset s ", "± s ", "frames ", "rate ppm "], rows, below)


def _written_sentences(report: SyncReport) -> list[str]:
    """What was written besides the report, a sentence each."""
    out, folder = [], report.folder or Path()
    for clock in (clock for clock in report.clocks if clock.take.spatial and clock.shifted is not None):
        assert clock.shifted is not None
        where = folder / clock.shifted["folder"]
        out.append(
            f"motion capture: {where}, on the clock of {report.reference.name}, within {1000 * clock.shifted['rest']:.1f} ms"
        )
    moved = [clock for clock in report.clocks if clock.shifted is not None and not clock.take.spatial]
    if moved:
        rest = 1000 * max(clock.shifted["rest"] for clock in moved if clock.shifted is not None)
        written = ", ".join(clock.name for clock in moved)
        out.append(f"shifted files: {folder / 'pose-sync'}/ ({written}), within {rest:.1f} ms of {report.reference.name}")
    if report.videos:
        rest = 1000 * max(one["rest"] for one in report.videos["cameras"].values())
        where = folder / report.videos["folder"]
        said = f"{count(len(report.videos['cameras']), 'video')} of {count(report.videos['frames'], 'frame')}"
        most = f"{rest:.1f} ms of {report.reference.name}{'' if report.mended is None else ' where frames were lost'}"
        out.append(f"videos: {where}/, {said}, {report.videos['fps']:.6g} per second, within {most}")
    return out


def drift_of(rate: float) -> str:
    """Seconds that a clock of this rate gains on the reference in an hour."""
    return f"{3600 * (rate - 1):+.3g}"


def sigma_text(seconds: float) -> str:
    """A standard deviation in seconds."""
    return f"{seconds:.4f}" if seconds < UNKNOWN else "unknown"


def ppm(rate: float, sigma: float | None = None) -> str:
    """How much faster a clock runs than another, in millionths."""
    much = round(PPM * (rate - 1))
    return "0" if rate == 1 or not (much or sigma) else f"{much:+d}" + ("" if sigma is None else f" ± {PPM * sigma:.0f}")


def clock_rows(report: SyncReport) -> list[list[Any]]:
    """The page's table of clocks."""
    rows = []
    for clock in report.clocks:
        first, known, fps = clock is report.reference, clock.sigma < UNKNOWN, clock.take.fps
        rows.append([
            quiet(clock.name, clock.take.path or ""),
            f"{fps:.6g}{' (assumed)' if clock.take.fps_assumed else ''}",
            "reference" if first else f"{clock.offset:+.4f} ± {sigma_text(clock.sigma)}" if known else "unknown",
            "" if first or not known else f"{clock.offset * fps:+.2f}",
            "" if first else ppm(clock.rate, clock.rate_sigma),
        ])  # fmt: skip
        if report.shifted:
            shift = None if clock.shifted is None else clock.shifted["shift"]
            moved = "nearest frames" if shift is None else f"{-shift:+d}" if shift else "unchanged"
            rows[-1] += ["", ""] if clock.shifted is None else [moved, f"{1000 * clock.shifted['rest']:.1f} ms"]
    return rows


def video_rows(report: SyncReport) -> list[list[Any]]:
    """The page's table of videos that were cut."""
    return [
        [
            quiet(name, one["file"]), one["frames"], f"{one['first']} to {one['last']}", one["repeated"], one["left_out"],
            f"{1000 * one['rest']:.1f} ms",
        ]
        for name, one in report.videos.get("cameras", {}).items()
    ]  # fmt: skip


def pair_rows(report: SyncReport) -> list[list[Any]]:
    """The page's table of pairs; of two cameras there is nothing else that the pair could be off."""
    rows = []
    for pair in report.pairs:
        shift, rival = pair.shift, pair.runner_up
        off = f"{1000 * pair.residual:+.1f}" if np.isfinite(pair.residual) else ""
        rows.append([
            quiet(f"{pair.a.name} → {pair.b.name}", METHODS.get(shift.method, shift.method)),
            f"{pair.offset_at_center:+.4f} ± {sigma_text(shift.sigma)}" if len(shift.peaks) else "none",
            ppm(shift.rate),
            f"{shift.confidence:.3g}",
            "none" if rival is None else f"{rival[0]:+.3f}",
            *([] if report.together is None else [off]),
            _state(pair),
        ])  # fmt: skip
    return rows


def _state(pair: Compared) -> Any:
    good, bad = markup('<span class="good">ok</span>'), markup('<span class="bad">refused</span>: {why}', why=pair.reason)
    people = f"compared: {pair.people[0]} with {pair.people[1]}" if any(pair.people) else ""
    wrong = f"inconsistent: {', '.join(pair.wrong)}" if pair.wrong and pair.shift.ok else ""
    return markup("{state}{people}{wrong}", state=good if pair.shift.ok else bad, **{
        name: quiet("", text) if text else "" for name, text in (("people", people), ("wrong", wrong))
    })  # fmt: skip


def page_values(report: SyncReport) -> dict[str, Any]:
    """Rows of the page's tables, and how it writes numbers."""
    return {
        "noted": notes_with_names(report.names, report.reason, report.notes),
        "clock_rows": clock_rows(report), "pair_rows": pair_rows(report),
        "video_rows": video_rows(report), "max_pairs": DRAWN, "drift_of": drift_of, "ppm": ppm, "sigma": sigma_text,
    }  # fmt: skip


def as_json(report: SyncReport) -> dict[str, Any]:
    """The result as numbers; ``camera time = reference time * rate + offset``, in seconds."""
    return {
        "ok": report.ok,
        "reason": report.reason or None,
        "reference": report.reference.name,
        "cameras": [
            {
                "name": clock.name, "path": str(clock.take.path or ""),
                "fps": clock.take.fps, "fps_assumed": clock.take.fps_assumed,
                "frames": clock.take.count or None, "start": clock.start, "end": float(clock.take.times[-1]),
                "offset": clock.offset, "offset_frames": clock.offset * clock.take.fps, "sigma": clock.sigma,
                "rate": clock.rate, "rate_sigma": clock.rate_sigma, "shifted": clock.shifted,
            }
            for clock in report.clocks
        ],
        "pairs": [_pair_json(pair) for pair in report.pairs],
        "videos": report.videos or None,
        "breaks": [] if report.mended is None else report.mended.as_json(),
        "cycle_error": report.cycle,
        "outlier_pair": list(report.outlier) if report.outlier else None,
        "notes": report.notes,
        "manifest": report.manifest,
    }  # fmt: skip


def _pair_json(pair: Compared) -> dict[str, Any]:
    shift = pair.shift
    fundamental = None if shift.fundamental is None else shift.fundamental.tolist()
    return {
        "a": pair.a.name, "b": pair.b.name, "ok": shift.ok, "reason": pair.reason or None,
        "method": shift.method, "offset": shift.offset,
        "offset_frames": shift.frames, "sigma": shift.sigma, "rate": shift.rate, "rate_sigma": shift.rate_sigma,
        "confidence": shift.confidence, "center": shift.center, "offset_at_center": pair.offset_at_center, "fps": list(shift.fps),
        "peaks": [{"offset": offset, "score": score} for offset, score in shift.peaks.tolist()],
        "wrong_points": pair.wrong, "people": list(pair.people) if any(pair.people) else None, "residual": pair.residual,
        "fundamental": fundamental, "projection": None if shift.projection is None else shift.projection.tolist(),
        "sound": _sound_json(pair), "notes": list(shift.notes),
    }  # fmt: skip


def _sound_json(pair: Compared) -> dict[str, Any] | None:
    """What the sound of both cameras says by itself; None where there is none, or none was asked."""
    heard = pair.pairing.sound
    if heard is None:
        return None
    return {
        "ok": heard.ok, "reason": heard.reason or None, "offset": heard.offset, "sigma": heard.sigma, "rate": heard.rate,
        "rate_sigma": heard.rate_sigma, "confidence": heard.confidence,
        "later": float(heard.at(pair.shift.center)) - float(pair.shift.at(pair.shift.center)),
    }  # fmt: skip


# ----------------------------------------------------------------------------------------------------------------------
# The picture of a synchronization: the score over the shift, with its peaks, of every pair of cameras.


WIDTH, TOP, ROW, GAP, FOOT = 10.2, 0.28, 1.75, 0.56, 0.5  # inches
LEFT, MIDDLE, CLOSE, EDGE = 0.55, 0.55, 2.6, 0.15  # inches: the left edge, between curve and close-up, the close-up, the right
DRAWN = 12  # pairs
NEAR = 12.0  # frames to both sides in the close-up
CURVE, BEST, OTHER = "#2f7fb8", "#e8741e", "#8b949c"
LISTED = 5  # peaks with a dot


def picture_of(report: SyncReport) -> bytes:
    """PNG: a row for every pair, with the whole curve at the left and the peak close up at the right."""
    pairs = report.pairs[:DRAWN]
    height = TOP + len(pairs) * (ROW + GAP) - GAP + FOOT
    with style():
        figure = new_figure(WIDTH, height)
        wide = WIDTH - LEFT - MIDDLE - CLOSE - EDGE
        for i, pair in enumerate(pairs):
            bottom = 1 - (TOP + ROW + i * (ROW + GAP)) / height
            whole = figure.add_axes((LEFT / WIDTH, bottom, wide / WIDTH, ROW / height))
            close = figure.add_axes(((LEFT + wide + MIDDLE) / WIDTH, bottom, CLOSE / WIDTH, ROW / height))
            _draw_curve(whole, pair)
            _draw_close(close, pair)
            if i == len(pairs) - 1:
                whole.set_xlabel("shift, seconds", fontsize=8.5)
                close.set_xlabel("frames from the best shift", fontsize=8.5)
        return png(figure)


def title_of(pair: Compared) -> str:
    """What a pair's curve says, in a line."""
    names = f"{shorten(pair.a.name, 24)} → {shorten(pair.b.name, 24)}: "
    return names + (f"{pair.offset_at_center:+.4f} ± {pair.shift.sigma:.4f} s" if pair.shift.ok else "refused")


def _draw_curve(panel: Any, pair: Compared) -> None:
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
    panel.axvline(pair.offset_at_center, color=BEST, linewidth=0.8, alpha=0.6, zorder=2)
    _finish(panel, title_of(pair))
    panel.set_ylabel("score", fontsize=8.5)
    panel.set_xlim(lags[0], lags[-1] if lags[-1] > lags[0] else lags[0] + 1)


def _draw_close(panel: Any, pair: Compared) -> None:
    lags, scores = _curve(pair)
    if not len(lags):
        panel.set_axis_off()
        return
    frame = 1.0 / pair.shift.fps[1]
    at = (lags - pair.offset_at_center) / frame
    near = np.abs(at) <= NEAR
    panel.plot(at[near], scores[near], color=CURVE, linewidth=1.0, marker=".", markersize=4, zorder=3)
    spread = pair.shift.sigma / frame
    if np.isfinite(spread):
        panel.axvspan(-min(spread, NEAR), min(spread, NEAR), color=BEST, alpha=0.25, linewidth=0, zorder=1)
    panel.axvline(0.0, color=BEST, linewidth=0.8, alpha=0.6, zorder=2)
    _finish(panel, f"close up, ± {spread:.2g} frames" if np.isfinite(spread) else "close up")
    panel.set_xlim(-NEAR, NEAR)


def _curve(pair: Compared) -> tuple[FloatArray, FloatArray]:
    """The finite part of the curve."""
    lags, scores = (np.asarray(values.detach().cpu().numpy(), dtype=np.float64) for values in (pair.shift.lags, pair.shift.scores))
    finite = np.isfinite(scores)
    return lags[finite], scores[finite]


def _finish(panel: Any, title: str) -> None:
    panel.set_title(title, fontsize=9, loc="left", parse_math=False)
    panel.grid(color=LIGHT.line, linewidth=0.5, zorder=0)
    panel.set_axisbelow(True)
    panel.tick_params(length=2.5, labelsize=7.5)
    panel.margins(y=0.12)
    for name, side in panel.spines.items():
        side.set_linewidth(0.8)
        side.set_visible(name in ("left", "bottom"))
