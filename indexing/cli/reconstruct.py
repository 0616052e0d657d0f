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

from dyntorch.numerics import worded
from indexing.cli.calibration import calibrated, calibration_files
from indexing.cli.console import check_report, count, ended, flags, say, table, tell
from indexing.cli.console import progress as progress_of
from indexing.cli.scenes import Asked, as_tracks, follow, inputs_of, is_scene, is_video, photographs, tracks_csv

if TYPE_CHECKING:
    from indexing.readers.tracks import TrackSet
    from indexing.report.reconstruction import ReconstructionReport

MotionName = Literal[
    "auto", "static_2d", "static_3d", "constant_direction_2d", "constant_velocity_2d", "constant_acceleration_2d",
    "constant_direction_3d", "constant_velocity_planes_3d", "constant_velocity_3d", "constant_velocity_3d_sensors",
    "two_bodies_2d", "two_bodies_3d",
]  # fmt: skip
WORDS = flags("times", "static", "threshold", "motion", "calibration")
UNFIXED = (
    "no point is known to stand still, so that a motion common to all is open and none can be told to rest; "
    "--static names some that do"
)


@dataclass(frozen=True)
class Reconstruct:
    """Find the cameras, the points and their velocities from tracks in which every point may move.

    dyntorch reconstruct tracks.csv --motion constant_velocity_2d --out out/

    dyntorch reconstruct tracks.csv --static parked.csv --fps 25 --out out/

    dyntorch reconstruct tracks.csv --motion constant_velocity_3d --calibration 1300,1300,640,360 --out out/

    dyntorch reconstruct view1.csv view2.csv view3.csv --times 0,0.5,1.2

    dyntorch reconstruct hopkins155.npz --key cars1 --frames 0,6,12,18

    dyntorch reconstruct street.mp4 --every 5 --motion constant_velocity_2d --out out/
    """

    files: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="FILE ...", help_behavior_hint="")]
    """a table with columns frame (or time), id, x, y; an npz with tracks (views, n, 2); npy, C3D; a file per view;
    or a video, a folder or pattern of pictures, whose points are followed, background included"""
    motion: MotionName = "auto"
    """how the points move; auto compares the models"""
    times: Annotated[str | None, tyro.conf.arg(metavar="T,T,...", help_behavior_hint="")] = None
    """of the views, any unit; by default those of the file, or the numbers of its frames"""
    fps: Annotated[float | None, tyro.conf.arg(metavar="F", help_behavior_hint="")] = None
    """frames per second, where the file numbers frames: times are then in seconds"""
    static: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="")] = None
    """names of points known to stand still, in a column id (or a column static, 0 or 1, in the table of the tracks)"""
    calibration: Annotated[str | None, tyro.conf.arg(metavar="FILE|FX,FY,CX,CY", help_behavior_hint="")] = None
    """of the camera: focal lengths and middle of the image in pixels, or a TOML file with matrix and distortions, one section
    for all views or one for each; the result is then metric"""
    threshold: Annotated[str, tyro.conf.arg(metavar="T|auto|none")] = "auto"
    """three times the noise of a coordinate, in the unit of the tracks; auto estimates it, none declares that all tracks fit"""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER", help_behavior_hint="")] = None
    """where to write report.html, reconstruction.npz, reconstruction.json, points.csv and pictures; without it, print only"""
    frames: Annotated[str | None, tyro.conf.arg(metavar="N,N,...", help_behavior_hint="")] = None
    """the views to take, by the number of their frame, or by their time where there is none; all by default.  Of a video, 8
    by default, evenly from the first to the last in which half of its points are still followed"""
    at: Annotated[str | None, tyro.conf.arg(metavar="S,S,...", help_behavior_hint="")] = None
    """of a video, seconds of the views instead: the first frame at or after each"""
    every: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")] = None
    """of a video, every so many frames instead; 1 takes all"""
    key: Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="")] = None
    """of an npz with several sequences or arrays, the one to take"""
    seed: int = 0
    """of the random samples"""

    def run(self) -> int:
        """Read, reconstruct, write, and say what was found."""
        given = (*self.files, *((self.static,) if self.static else ()), *calibration_files(self.calibration))
        inputs = [path.expanduser() for path in given]
        self._check()
        scene, asked = is_scene([path.expanduser() for path in self.files]), Asked(self.frames, self.at, self.every)
        self._check_scene(scene, asked)
        inputs = inputs_of(inputs) if scene else inputs
        from indexing.files import manifest
        from indexing.report.reconstruction import WRITTEN, ReconstructionReport, write_reconstruction

        folder = check_report(self.out, inputs, WRITTEN)
        started = time.perf_counter()
        with progress_of("reading", steps=False):
            from indexing.readers.tracks import read_tracks

            frames = None if self.frames is None else [word.strip() for word in self.frames.split(",")]
            followed = follow(self.files, asked, missing=True, fps=self.fps) if scene else None
            filmed = as_tracks(followed, self.files[0], self._filmed()) if followed else None
            tracks = self._timed(filmed or read_tracks(self.files, frames=frames, key=self.key, static=self.static))
        read = time.perf_counter()
        with progress_of(f"reconstructing {count(len(tracks.ids), 'track')}", steps=False):
            result = self._solve(tracks)
        timings = {"read": read - started, "reconstruct": time.perf_counter() - read}
        limit = self._limit()
        report = ReconstructionReport(
            result=result,
            tracks=tracks,
            threshold=None if limit == math.inf else limit,
            notes=[*tracks.notes, *unfixed(tracks, result)],
            words=WORDS,
            manifest=manifest({"command": "reconstruct", **dataclasses.asdict(self)}, inputs, self.seed, timings),
            photograph=photographs(followed)[0] if followed else None,
            besides={"tracks.csv": tracks_csv(followed)} if followed else {},
        )
        page = None
        if folder is not None:
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

    def _check_scene(self, scene: bool, asked: Asked) -> None:
        """Raise on flags that do not fit what is given."""
        asked.check(scene)
        for flag in ("key", "static"):
            if scene and getattr(self, flag) is not None:
                raise ValueError(f"--{flag} is of files of tracks, and a video or pictures are given; leave it out")
        if scene and self.fps is not None and self._filmed():
            raise ValueError(f"--fps {self.fps:g}: a video has the times of its frames; leave it out")

    def _filmed(self) -> bool:
        """Whether the frames have times of their own, or a rate that was given."""
        return is_video(self.files[0])

    def _limit(self) -> float | None:
        """The threshold as the library takes it: None = estimated, inf = all tracks fit."""
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
        """The tracks with times that begin at 0, and what to say about them."""
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
        """The reconstruction, by the library."""
        import torch

        import dyntorch

        values, matrices = calibrated(self.calibration, torch.from_numpy(tracks.values))
        try:
            return dyntorch.reconstruct(
                values,
                self.motion,
                torch.from_numpy(tracks.times),
                static=None if tracks.static is None else torch.from_numpy(tracks.static),
                threshold=self._limit(),
                weights=None if tracks.weights is None else torch.from_numpy(tracks.weights),
                calibration=matrices,
                generator=torch.Generator().manual_seed(self.seed),
            )
        except ValueError as problem:
            raise ValueError(f"{tracks.path}: {worded(problem, WORDS)}") from problem


def unfixed(tracks: TrackSet, result: Any) -> list[str]:
    """That a motion common to all points is open, where it is."""
    known = tracks.static is not None and bool(tracks.static.any())
    decided = int(result.status) == 0 and result.velocities is not None and not result.motion.static
    return [UNFIXED] if decided and not known else []


def numbers(text: str, expected: int) -> Any:
    """``0,0.5,1.2`` as numbers, one per view."""
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
    from indexing.report.reconstruction import left_out

    counts, candidates = report.counts, report.result.candidates
    known = report.solved
    cells = [number if known or name == "missing" else "" for name, number in counts.items()]
    row = [report.motion, len(report.tracks.views), len(report.tracks.ids), *cells]
    row += [f"{report.residual:.3g}" if known else "", report.state]
    table(["motion", "views ", "tracks ", *(f"{name} " for name in counts), "rms residual ", "status"], [row])
    if candidates:
        fitted = [[one.motion, f"{one.score:.6g}", f"{one.residual:.3g}"] for one in candidates if math.isfinite(one.score)]
        table(["model", "penalized cost ", "rms residual "], fitted)
        if failed := left_out(report):
            say(f"note: {failed}")
    tell(report)
    if known and report.ambiguity:
        say(f"open: {report.ambiguity}")
