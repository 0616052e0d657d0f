"""``dyntorch reconstruct``: cameras, points and velocities from tracks of points that all may move."""

from __future__ import annotations

import dataclasses
import math
import re
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from indexing.cli.console import check_report, count, ended, in_flags, say, table
from indexing.cli.console import progress as progress_of

if TYPE_CHECKING:
    from indexing.readers.tracks import TrackSet
    from indexing.report.reconstruction import ReconstructionReport

MotionName = Literal[
    "auto", "static_2d", "static_3d", "constant_direction_2d", "constant_velocity_2d", "constant_acceleration_2d",
    "constant_direction_3d", "constant_velocity_planes_3d", "constant_velocity_3d", "constant_velocity_3d_sensors",
    "two_bodies_2d", "two_bodies_3d",
]  # fmt: skip
PURPOSE = {
    "static_2d": "The points of a plane stand still.",
    "static_3d": "The points stand still.",
    "constant_direction_2d": "The points move in a plane along one common direction, each at its own speed.",
    "constant_velocity_2d": "The points move in a plane, each at its own constant velocity.",
    "constant_acceleration_2d": "The points move in a plane, each with its own constant acceleration.",
    "constant_direction_3d": "The points move in space along one common direction, each at its own speed.",
    "constant_velocity_planes_3d": "The points move in space, parallel to a plane, each at its own constant velocity.",
    "constant_velocity_3d": "The points move in space, each at its own constant velocity.",
    "constant_velocity_3d_sensors": "The points move in space, each at its own constant velocity, before a 3D sensor.",
    "two_bodies_2d": "The points of a plane belong to two bodies, one of which is shifted against the other.",
    "two_bodies_3d": "The points belong to two bodies, one of which is shifted against the other.",
}
REASONS = {
    "TOO_FEW": "too few tracks are seen in enough views; track more points, or for longer",
    "DEGENERATE": "the tracks leave several scenes, exactly; let camera and points move otherwise, or take a smaller --motion",
    "AMBIGUOUS": "other scenes fit as well; add views and tracks, let the camera move more, or take a smaller --motion",
    "NO_CONSENSUS": "no scene fits enough of the tracks; raise --threshold, take another --motion, or clean the tracks",
}
FLAGS = ("times", "static", "threshold", "motion")
UNFIXED = (
    "no point is known to stand still, so that a motion common to all is open and none can be told to rest; "
    "--static names some that do"
)


@dataclass(frozen=True)
class Reconstruct:
    """Find the cameras, the points and their velocities from tracks in which every point may move.

    dyntorch reconstruct tracks.csv --motion constant_velocity_2d --out out/

    dyntorch reconstruct tracks.csv --static parked.csv --fps 25 --out out/

    dyntorch reconstruct view1.csv view2.csv view3.csv --times 0,0.5,1.2

    dyntorch reconstruct hopkins155.npz --key cars1 --frames 0,6,12,18
    """

    files: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="FILE ...", help_behavior_hint="")]
    """a table with columns frame (or time), id, x, y; an npz with tracks (views, n, 2); npy, C3D; or a file per view"""
    motion: MotionName = "auto"
    """how the points move; auto compares the models"""
    times: Annotated[str | None, tyro.conf.arg(metavar="T,T,...", help_behavior_hint="")] = None
    """of the views, any unit; by default those of the file, or the numbers of its frames"""
    fps: Annotated[float | None, tyro.conf.arg(metavar="F", help_behavior_hint="")] = None
    """frames per second, where the file numbers frames: times are then in seconds"""
    static: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="")] = None
    """names of points known to stand still, in a column id (or a column static, 0 or 1, in the table of the tracks)"""
    threshold: Annotated[str, tyro.conf.arg(metavar="T|auto|none")] = "auto"
    """three times the noise of a coordinate, in the unit of the tracks; auto estimates it, none declares that all tracks fit"""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER", help_behavior_hint="")] = None
    """where to write report.html, reconstruction.npz, reconstruction.json, points.csv and pictures; without it, print only"""
    frames: Annotated[str | None, tyro.conf.arg(metavar="N,N,...", help_behavior_hint="")] = None
    """the views to take, by the number of their frame, or by their time where there is none; all by default"""
    key: Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="")] = None
    """of an npz with several sequences or arrays, the one to take"""
    seed: int = 0
    """of the random samples"""

    def run(self) -> int:
        """Read, reconstruct, write, and say what was found."""
        inputs = [path.expanduser() for path in (*self.files, *((self.static,) if self.static else ()))]
        self._check()
        from indexing.report.reconstruction import FILES

        folder = check_report(self.out, inputs, FILES)
        started = time.perf_counter()
        with progress_of("reading", steps=False):
            from indexing.readers.tracks import read_tracks

            frames = None if self.frames is None else [word.strip() for word in self.frames.split(",")]
            tracks = self._timed(read_tracks(self.files, frames=frames, key=self.key, static=self.static))
        read = time.perf_counter()
        with progress_of(f"reconstructing {count(len(tracks.ids), 'track')}", steps=False):
            result = self._solve(tracks)
        timings = {"read": read - started, "reconstruct": time.perf_counter() - read}
        report = self._report(tracks, result, inputs, timings)
        page = None
        if folder is not None:
            from indexing.report.reconstruction import write_reconstruction

            with progress_of("drawing the report", steps=False):
                page = write_reconstruction(folder, report)
        show(report)
        return ended(page, None if report.status == "OK" else report.reason)

    def _check(self) -> None:
        """Raise on flags that make no sense by themselves, before any file is read."""
        if not self.files:
            raise ValueError("no files; give a table of tracks with columns frame, id, x, y, an .npz, or a file for each view")
        self._limit()
        if self.fps is not None and not 0 < self.fps < float("inf"):
            raise ValueError(f"--fps must be a positive number of frames per second, got {self.fps:g}")
        if self.fps is not None and self.times is not None:
            raise ValueError("--fps and --times both give times; leave one out")
        if self.seed < 0:
            raise ValueError(f"--seed must be a whole number from 0, got {self.seed}")

    def _limit(self) -> float | None:
        """The threshold as the library takes it: None = estimated, inf = all tracks fit.

        Raises:
            ValueError: something else.
        """
        if self.threshold in ("auto", "none"):
            return None if self.threshold == "auto" else math.inf
        try:
            limit = float(self.threshold)
        except ValueError:
            limit = math.nan
        if not 0 < limit < math.inf:
            said = "--threshold must be a positive distance in the unit of the tracks, auto or none"
            raise ValueError(f"{said}, got {self.threshold}")
        return limit

    def _timed(self, tracks: TrackSet) -> TrackSet:
        """The tracks with times that begin at 0, and what to say about them.

        Raises:
            ValueError: other than one time per view.
        """
        import numpy as np

        from indexing.readers.tracks import exact

        notes = []
        if self.times is not None:
            times = numbers(self.times, len(tracks.views))
        elif tracks.times is not None and self.fps is None:
            times = tracks.times
        else:
            numbered = all(re.fullmatch(r"-?\d+(\.\d+)?", name) for name in tracks.views)
            times = np.array([float(name) for name in tracks.views]) if numbered else np.arange(float(len(tracks.views)))
            if self.fps is None:
                unit = "the numbers of the frames" if numbered else "0, 1, 2, ..., one per file"
                notes.append(f"times are {unit}, because the files have none; --times or --fps give others")
            else:
                times = times / self.fps
        timed = dataclasses.replace(tracks.seen(), times=times).since_first()
        if timed.start != 0:
            notes.append(f"time 0 of the result is the first view, at {exact(timed.start)}")
        return dataclasses.replace(timed, notes=(*timed.notes, *notes))

    def _solve(self, tracks: TrackSet) -> Any:
        """The reconstruction, by the library.

        Raises:
            ValueError: too few views or tracks, with the name of the file.
        """
        import torch

        import dyntorch

        try:
            return dyntorch.reconstruct(
                torch.from_numpy(tracks.values),
                self.motion,
                torch.from_numpy(tracks.times),
                static=None if tracks.static is None else torch.from_numpy(tracks.static),
                threshold=self._limit(),
                weights=None if tracks.weights is None else torch.from_numpy(tracks.weights),
                generator=torch.Generator().manual_seed(self.seed),
            )
        except ValueError as problem:
            raise ValueError(f"{tracks.path}: {in_flags(str(problem), *FLAGS)}") from problem

    def _report(self, tracks: TrackSet, result: Any, inputs: list[Path], timings: dict[str, float]) -> ReconstructionReport:
        import torch

        from dyntorch import Status
        from indexing.files import manifest
        from indexing.report.reconstruction import ReconstructionReport, one, rested

        status, name = Status(int(result.status)).name, result.motion.name
        warnings = [(notice.code.value, notice.value, one(in_flags(notice.message, *FLAGS))) for notice in result.warnings]
        notes = list(tracks.notes)
        if (
            status == "OK"
            and (tracks.static is None or not tracks.static.any())
            and result.velocities is not None
            and not result.motion.static
        ):
            notes.append(UNFIXED)
        # that nothing fits is no consequence of what a notice says of the scene that fits best
        because = "" if status == "NO_CONSENSUS" else "; ".join(message for _, _, message in warnings[:2])
        arrays = ("cameras", "points", "velocities", "labels", "residuals", "inliers", "structure", "projections")
        found: dict[str, Any] = {
            field: None if getattr(result, field) is None else getattr(result, field).numpy() for field in arrays
        }
        found["velocities"] = rested(found["velocities"], found["points"], float(result.times.max() - result.times.min()))
        if result.motion.static and result.motion.bodies == 1:
            found["labels"] = found["labels"].clip(max=1)
        limit = self._limit()
        return ReconstructionReport(
            title="What moves, and how" if status == "OK" else "The tracks do not decide",
            motion=(name, PURPOSE.get(name, "")),
            tracks=tracks,
            residual=float(result.residual),
            sigma=float(result.sigma),
            status=status,
            reason="" if status == "OK" else because or REASONS[status],
            ambiguity=in_flags(result.ambiguity, *FLAGS),
            warnings=warnings,
            notes=notes,
            candidates=[(tried.motion, tried.score, tried.residual, tried.reason) for tried in result.candidates],
            threshold=None if limit == math.inf else limit,
            manifest=manifest({"command": "reconstruct", **dataclasses.asdict(self)}, inputs, self.seed, timings),
            bodies=result.motion.bodies,
            positions=torch.stack([result.at(float(moment)) for moment in result.times]).numpy(),
            **found,
        )


def numbers(text: str, expected: int) -> Any:
    """``0,0.5,1.2`` as numbers, one per view.

    Raises:
        ValueError: something else.
    """
    import numpy as np

    try:
        found = np.array([float(word) for word in text.split(",")])
    except ValueError:
        raise ValueError(f"--times {text!r}: expected numbers with commas between them, such as --times 0,0.5,1.2") from None
    if len(found) != expected or not np.isfinite(found).all():
        raise ValueError(f"--times {text!r}: {len(found)} times for {expected} views; give one finite number per view")
    return found


def show(report: ReconstructionReport) -> None:
    """Print the result."""
    from indexing.report.reconstruction import heading, left_out

    counts = report.counts
    known = report.solved
    cells = [number if known or name == "missing" else "" for name, number in counts.items()]
    row = [report.motion[0], len(report.tracks.views), len(report.tracks.ids), *cells]
    row += [f"{report.residual:.3g}" if known else "", report.status.lower().replace("_", " ")]
    table(["motion", "views ", "tracks ", *(f"{name} " for name in counts), "rms residual ", "status"], [row])
    if report.candidates:
        fitted = [(name, score, residual) for name, score, residual, _ in report.candidates if math.isfinite(score)]
        table(["model", "penalized cost ", "rms residual "], [[name, f"{s:.6g}", f"{r:.3g}"] for name, s, r in fitted])
        if failed := left_out(report.candidates):
            say(f"note: {failed}")
    for note in report.notes:
        say(f"note: {note}")
    for code, _, message in report.warnings:
        say(f"warning: {heading(code)}: {message}")
    if known and report.ambiguity:
        say(f"open: {report.ambiguity}")
