"""The report on a synchronization: how the clocks of the cameras run against each other, and how sure that is."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from indexing import files
from indexing.report.canvas import DARK, LIGHT
from indexing.report.page import made_by, page
from indexing.report.sync_page import body, describe
from indexing.report.sync_picture import picture_of

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
