"""``dyntorch sync``: cameras that nobody synchronized, put on one clock."""

from __future__ import annotations

import dataclasses
import math
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from dyntorch.numerics import Message, worded
from indexing.cli.console import SHOWN, check_report, count, ended, flags, names, progress, say, table
from indexing.cli.films import Watched, Watching
from indexing.cli.inputs import Format, refuse_range

if TYPE_CHECKING:
    from indexing.report.sync import SyncReport
    from indexing.sync.files import Plan
    from indexing.sync.people import Pairing
    from indexing.sync.takes import By, Take

WORDS = flags(
    "fps", "person", "method", "measure", "max_shift", "min_confidence", "format", "size", "layout", "rate",
    calibration="--calibration FILE.toml",
)  # fmt: skip


@dataclass(frozen=True)
class Sync:
    """Find how the clocks of cameras run that nobody synchronized, and write their keypoint files with common frame numbers.

    dyntorch sync cam1/ cam2/ cam3/ --out sync/

    dyntorch sync pose/ --fps 60 --calibration Calib.toml --out .

    dyntorch sync left.mp4 right.mp4 --check --out sync/
    """

    cameras: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="CAMERA ...", help_behavior_hint="")]
    """per camera a keypoint file, a folder with one file per frame, or a video; or one folder that holds those of all"""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER", help_behavior_hint="")] = None
    """where to write report.html, sync.json, curve.png and pose-sync/; without it, print only"""
    method: Literal["auto", "keypoints", "tracks", "brightness"] = "auto"
    """auto: keypoints where there are any, or a pose model finds them; of videos that they do not decide tracks and brightness,
    which must agree"""
    measure: Literal["profile", "window"] = "profile"
    """of --method brightness: what moves at which height, confirmed by the window kernel; or that kernel alone, as in the thesis"""
    fps: Annotated[str | None, tyro.conf.arg(metavar="N|N,N,...", help_behavior_hint="")] = None
    """frames per second of all cameras, or of each, for files that do not say (30 is assumed then, and the output says so)"""
    max_shift: Annotated[float | None, tyro.conf.arg(metavar="S", help_behavior_hint="")] = None
    """seconds, the largest offset that is searched; by default as far as the recordings overlap enough"""
    calibration: Annotated[Path | None, tyro.conf.arg(metavar="TOML", help_behavior_hint="")] = None
    """lenses of the cameras, as Pose2Sim writes them: matrix and distortions in a section for each"""
    person: Literal["auto", "largest", "confident", "tracked"] = "auto"
    """who is compared where several people are in view; auto tries the likely ones and says whom it took"""
    rate: bool = True
    """clocks may run at different rates; --no-rate where one clock drives all cameras"""
    check: bool = False
    """write check.mp4 as well (check-NAME.mp4 for more than two cameras), with the same moments side by side"""
    min_confidence: Annotated[float, tyro.conf.arg(metavar="C")] = 0.0
    """joints that the detector trusts less are taken as not seen"""
    format: Annotated[Format | None, tyro.conf.arg(help_behavior_hint="")] = None
    """of the keypoint files; by default their content decides"""
    size: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="W H", help_behavior_hint="")] = None
    """width and height of the image in pixels, for files with coordinates from 0 to 1"""
    layout: Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="")] = None
    """which joint is which, such as BODY_25B; by default as the files say, or as the body looks"""
    footage: Watching = field(default_factory=Watching)
    title: Annotated[str | None, tyro.conf.arg(metavar="TEXT", help_behavior_hint="")] = None
    """heading of the report"""

    def run(self) -> int:
        """Read, synchronize, write, and say what was found."""
        self._check()
        for path in self.cameras:
            refuse_range(path)
        from indexing.files import manifest
        from indexing.report.sync import FILES, names_of
        from indexing.sync.files import check_target
        from indexing.sync.takes import find_cameras

        found = find_cameras([path.expanduser() for path in self.cameras])
        inputs = [*found.values(), *([self.calibration.expanduser()] if self.calibration else [])]
        folder = check_report(self.out, inputs, [*FILES, *names_of(list(found))])
        if folder is not None:
            check_target(folder, inputs)
        started = time.perf_counter()
        by = self._by()
        watched = Watched({})
        if by != "pixels" and self.footage.wanted():
            watched = self.footage.watch(found.values(), folder, self._rates(len(found))[0])
        with progress("reading", steps=False):
            takes = self._read(found, by, watched)
        read = time.perf_counter()
        pairs = len(takes) * (len(takes) - 1) // 2
        with progress(f"comparing {count(pairs, 'pair')} of cameras") as done:
            report = self._solve(takes, done)
        timings = {"read": read - started, "synchronize": time.perf_counter() - read}
        page = None
        if folder is not None:
            with progress("writing", steps=False):
                made = manifest({"command": "sync", **dataclasses.asdict(self)}, inputs, None, timings)
                report, page = self._write(folder, dataclasses.replace(report, manifest=made))
        show(report, folder)
        return ended(page, None if report.ok else report.reason)

    def _check(self) -> None:
        """Raise on flags that make no sense by themselves, before any file is read."""
        if self.max_shift is not None and not 0 < self.max_shift < math.inf:
            raise ValueError(f"--max-shift must be a positive number of seconds, got {self.max_shift:g}")
        if self.check and self.out is None:
            raise ValueError("--check writes a video; say where with --out")
        if self.check:
            from indexing.video.reading import av, cv2

            av(), cv2()  # said now rather than when all is done
        self._rates(None)

    def _rates(self, cameras: int | None) -> list[float | None]:
        """Frames per second of each camera.

        Raises:
            ValueError: not positive numbers, or other than one per camera.
        """
        if self.fps is None:
            return [None] * (cameras or 0)
        try:
            rates: list[float | None] = [float(word) for word in self.fps.split(",")]
        except ValueError:
            rates = []
        if not rates or not all(rate is not None and 0 < rate < math.inf for rate in rates):
            raise ValueError(f"--fps must be one positive number, or one per camera as in 60,59.94, got {self.fps}")
        if cameras is not None and len(rates) not in (1, cameras):
            raise ValueError(f"--fps gives {len(rates)} rates for {cameras} cameras; give one, or one per camera")
        return rates * ((cameras or 1) if len(rates) == 1 else 1)

    def _by(self) -> By:
        """What of videos is compared.

        Raises:
            ValueError: --method and --by contradict each other.
        """
        from indexing.sync.synchronize import BY

        of_method, by = BY[self.method], self.footage.by
        if "auto" not in (by, of_method) and by != of_method:
            raise ValueError(f"--by {by}: --method {self.method} compares the {of_method} of videos; leave --by out")
        return of_method if by == "auto" else by

    def _read(self, found: dict[str, Path], by: By, watched: Watched) -> list[Take]:
        from indexing.sync.takes import take_of

        rates = self._rates(len(found))
        options: dict[str, Any] = {"person": self.person, "min_confidence": self.min_confidence, "by": by}
        options |= {"format": self.format, "size": self.size, "layout": self.layout}
        try:
            return [
                take_of(path, name=name, fps=rate, keypoints=watched.files.get(path), **options)
                for (name, path), rate in zip(found.items(), rates, strict=True)
            ]
        except ValueError as problem:
            raise ValueError(worded(problem, WORDS)) from problem

    def _solve(self, takes: list[Take], done: Any) -> SyncReport:
        """All pairs, and what they say together."""
        import dyntorch
        from indexing.report.sync import SyncReport
        from indexing.sync.calibration import named_lenses
        from indexing.sync.synchronize import pair, remarks

        lenses, told = (None, ()) if self.calibration is None else named_lenses(self.calibration, [take.name for take in takes])
        options: dict[str, Any] = {"max_shift": self.max_shift, "calibration": lenses, "rate": None if self.rate else 1.0}
        options["measure"] = self.measure
        total = len(takes) * (len(takes) - 1) // 2
        compared: dict[tuple[int, int], Pairing] = {}

        def compare(a: Take, b: Take, *_: Any, **__: Any) -> Any:
            try:
                found = pair(a, b, self.method, **options)
            except ValueError as problem:
                said = problem.args[0] if problem.args else str(problem)
                known = said.startswith(tuple(str(word) for take in (a, b) for word in (take.name, take.path or take.name)))
                both = Message("{a} and {b}: {said}", a=a.name, b=b.name, said=said)
                raise ValueError(said if known else both) from problem
            compared[takes.index(a), takes.index(b)] = found
            done(len(compared) / total)
            return found.shift

        try:
            clocks = dyntorch.synchronize_cameras(takes, pair=compare) if len(takes) > 2 else None
            if clocks is None:
                compare(takes[0], takes[1])
        except ValueError as problem:
            # that of a pair says which cameras it is about by name, and so not by number
            of_pair = problem.__cause__ if len(takes) > 2 and problem.__cause__ is not None else problem
            raise ValueError(worded(of_pair, WORDS)) from problem
        known: dict[str, Any] = {"remarks": [*(one.text for one in remarks(takes)), *told], "heading": self.title or ""}
        return SyncReport(takes=takes, compared=compared, together=clocks, words=WORDS, **known)

    def _write(self, folder: Path, report: SyncReport) -> tuple[SyncReport, Path]:
        """The shifted files where the data decide, the check video where asked for, and the report."""
        from indexing.files import prepare
        from indexing.report.sync import drop_checks, write_checks, write_sync
        from indexing.sync.files import drop_poses, plan, write_poses

        prepare(folder)
        notes, first = [], report.reference
        poses = {i: clock for i, clock in enumerate(report.clocks) if clock.take.kind == "keypoints"}
        if report.ok and poses:
            plans = {i: plan(clock.take, clock.offset, clock.rate, first.take.fps) for i, clock in poses.items()}
            write_poses(folder, list(plans.values()))
            notes += early(list(plans.values()), first.name)
            report = dataclasses.replace(report, shifted={i: _shifted(one) for i, one in plans.items()})
        elif drop_poses(folder):
            notes.append("pose-sync of an earlier run was removed, because this one does not decide")
        videos: list[str] = []
        if self.check and any(len(pair.shift.peaks) for pair in report.pairs):  # of the best candidate, sure or not
            videos, failed = write_checks(folder, report)
            notes += failed
        drop_checks(folder, videos)
        report = dataclasses.replace(report, afterwards=notes)
        return report, write_sync(folder, report, videos)


def early(plans: list[Plan], reference: str) -> list[str]:
    """Notes on frames that have no number, because they were taken before the reference's first."""
    said = [f"{count(one.before, 'frame')} of {one.take.name}" for one in plans if one.before]
    return [f"{names(said)} left out of pose-sync: taken before number 0 of {reference}"] if said else []


def _shifted(one: Plan) -> dict[str, Any]:
    return {
        "folder": f"pose-sync/{one.take.name}_json", "files": len(one.numbers), "shift": one.shift, "rest": one.rest,
        "repeated": one.repeated, "left_out": one.before,
    }  # fmt: skip


def show(report: SyncReport, folder: Path | None = None) -> None:
    """Print the result.

    Args:
        folder: that it was written to.
    """
    _show_pairs(report)
    if len(report.clocks) > 2:
        _show_clocks(report)
    elif report.ok:
        first, other = report.clocks
        began = float(other.inverse(other.start)) - first.start
        factor = "" if other.rate == 1 else f" * {other.rate:.6f}"
        when = f"{abs(began):.4f} s {'after' if began >= 0 else 'before'}"
        sign = "-" if other.offset < 0 else "+"
        clock = f"time of {other.name} = time of {first.name}{factor} {sign} {abs(other.offset):.4f} s"
        say(f"{other.name} began {when} {first.name}: {clock}")
    for pair in report.pairs:
        if pair.wrong and pair.shift.ok:
            say(f"inconsistent joints of {pair.a.name} and {pair.b.name}: {', '.join(pair.wrong)}")
    open_pairs = [pair for pair in report.pairs if not pair.shift.ok] if len(report.pairs) > 1 else []
    for pair in open_pairs[:SHOWN]:
        say(f"{pair.a.name} and {pair.b.name} refused: {pair.reason}")
    if len(open_pairs) > SHOWN:
        say(f"and {len(open_pairs) - SHOWN} more pairs refused")
    for note in report.notes:
        say(f"note: {note}")
    moved = [clock for clock in report.clocks if clock.shifted is not None]
    if moved:
        rest = 1000 * max(clock.shifted["rest"] for clock in moved if clock.shifted is not None)
        written = ", ".join(clock.name for clock in moved)
        where = Path("pose-sync") if folder is None else folder / "pose-sync"
        say(f"shifted files: {where}/ ({written}), within {rest:.1f} ms of {report.reference.name}")


def _show_pairs(report: SyncReport) -> None:
    from indexing.report.sync import UNKNOWN, ppm

    rows: list[list[object]] = []
    for pair in report.pairs:
        shift, rival = pair.shift, pair.runner_up
        numbers = [
            f"{pair.apart:+.4f}" if len(shift.peaks) else "none",
            f"{shift.sigma:.4f}" if shift.sigma < UNKNOWN else "unknown",
            f"{pair.apart * shift.fps[1]:+.2f}" if len(shift.peaks) else "none",
            ppm(shift.rate, shift.rate_sigma),
            f"{shift.confidence:.3f}",
        ]
        rows.append(
            [f"{pair.a.name} → {pair.b.name}", *numbers, f"{rival[0]:+.3f}" if rival else "none", "ok" if shift.ok else "refused"]
        )
    where = "offset s (mid) " if any(pair.shift.rate != 1 for pair in report.pairs) else "offset s "
    table(["pair", where, "± s ", "frames ", "rate ppm ", "confidence ", "next peak s ", "status"], rows)


def _show_clocks(report: SyncReport) -> None:
    from indexing.report.sync import UNKNOWN, ppm

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
    table([f"clock against {report.reference.name}", "offset s ", "± s ", "frames ", "rate ppm "], rows)
    if report.cycle is not None and math.isfinite(report.cycle):
        out = f"; {report.outlier[0]} - {report.outlier[1]} contradicts the others" if report.outlier else ""
        say(f"cycle error: {1000 * report.cycle:.2f} ms{out}")
