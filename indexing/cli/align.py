"""``dyntorch align``: how a sensor moved among things that move, and what stood still."""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from dyntorch.numerics import worded
from indexing.cli.calibration import calibrated, calibration_files
from indexing.cli.console import check_report, count, ended, flags, names, progress, say, table, tell
from indexing.cli.scenes import Asked, as_matches, follow, inputs_of, is_scene, photographs, tracks_csv

if TYPE_CHECKING:
    from indexing.readers.matches import Matched
    from indexing.report.alignment import AlignmentReport
    from indexing.video.scene import SceneTracks

Model = Literal["planar", "join", "minimal_join", "constant_velocity", "affine_constant_velocity", "rigid", "lines"]
SEVERAL = ("planar", "join", "minimal_join")
"""Models that take more than three views."""
WORDS = flags("model", "threshold", "motion", "calibration", static="a column static", static_points="--static-points FILE FILE")


@dataclass(frozen=True)
class Align:
    """Find how a sensor moved while points move, too, and which of them stand still.

    dyntorch align a.csv b.csv c.csv --model planar --threshold 1.5 --out out/

    dyntorch align scan1.ply scan2.ply scan3.ply --model rigid

    dyntorch align walk.c3d --frames 10,20,30,40,50 --model join

    dyntorch align l1.csv l2.csv --model lines --static-points p1.csv p2.csv

    dyntorch align street.mp4 --frames 0,20,40 --calibration 1300,1300,640,360 --out out/
    """

    files: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="FILE ...", help_behavior_hint="")]
    """a file per view (CSV with columns x,y or x,y,z and perhaps id; npy; PLY), or one for all (npz with x1, x2, x3; C3D); planar,
    join and minimal_join take three or more views; or a video, a folder or pattern of pictures, whose points are followed,
    background included"""
    model: Annotated[Model | None, tyro.conf.arg(help_behavior_hint="")] = None
    """how points may move, and the sensor; by default planar for 2D points, rigid for 3D points, lines for lines"""
    threshold: Annotated[float | Literal["auto"] | None, tyro.conf.arg(metavar="T|auto", help_behavior_hint="")] = None
    """greatest distance of an inlier in the unit of the files: three times the noise of a coordinate; auto estimates it (the
    default but for videos, where it is one pixel)"""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER", help_behavior_hint="")] = None
    """where to write report.html, alignment.json, labels.csv, alignment.png (and tracks.csv of a video); without it, print only"""
    frames: Annotated[str | None, tyro.conf.arg(metavar="N,N,N", help_behavior_hint="")] = None
    """of a file with many frames (C3D, npy) or a video, those that are the views; of a video by default the first, the last in
    which half of its points are still followed, and the one between"""
    at: Annotated[str | None, tyro.conf.arg(metavar="S,S,S", help_behavior_hint="")] = None
    """of a video, seconds of the views instead: the first frame at or after each"""
    motion: Literal["straight", "constant_velocity"] = "straight"
    """of rigid: points move on straight lines at any speed, or at constant velocity"""
    static_points: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="FILE FILE", help_behavior_hint="")] = ()
    """of lines: points that are known to stand still, a file for each view"""
    calibration: Annotated[str | None, tyro.conf.arg(metavar="FILE|FX,FY,CX,CY", help_behavior_hint="")] = None
    """of the camera (planar): focal lengths and middle of the image in pixels, or a TOML file with matrix and distortions, one
    section for all views or one for each; rotations, translations and the normal of the plane are then found, too"""
    seed: int = 0
    """of the random samples"""

    def run(self) -> int:
        """Read, align, write, and say what was found."""
        inputs = [path.expanduser() for path in (*self.files, *self.static_points)]
        self._check()
        scene, asked = is_scene(inputs), Asked(self.frames, self.at)
        asked.check(scene)
        inputs = [*(inputs_of(inputs) if scene else inputs), *calibration_files(self.calibration)]
        from indexing.files import manifest
        from indexing.report.alignment import WRITTEN, AlignmentReport, write_alignment

        folder = check_report(self.out, inputs, WRITTEN)
        started = time.perf_counter()
        with progress("reading", steps=False):
            matched, tracks = self._read(asked if scene else None)
        model, notes = self._model(matched)
        threshold = self._limit(tracks)
        if self.threshold is None and threshold is not None:
            notes.append(f"threshold {threshold:.3g} px, that of points followed through videos; --threshold says otherwise")
        read = time.perf_counter()
        with progress(f"aligning {count(len(matched.ids), 'match', 'matches')}", steps=False):
            result = self._solve(matched, model, threshold)
        timings = {"read": read - started, "align": time.perf_counter() - read}
        arguments = {"command": "align", **dataclasses.asdict(self), "model": model}
        report = AlignmentReport(
            result=result,
            read=matched,
            model=model,
            threshold=threshold,
            notes=[*notes, *matched.notes],
            words=WORDS,
            manifest=manifest(arguments, inputs, self.seed, timings),
            photographs=photographs(tracks) if tracks else (),
            besides={"tracks.csv": tracks_csv(tracks)} if tracks else {},
        )
        page = None
        if folder is not None:
            with progress("drawing the report", steps=False):
                page = write_alignment(folder, report)
        show(report)
        return ended(page, None if report.status == "OK" else report.reason)

    def _check(self) -> None:
        """Raise on flags that make no sense by themselves, before any file is read."""
        if not self.files:
            raise ValueError("no files; give a file of points for each view, or one .npz or .c3d with all of them")
        if self.threshold not in ("auto", None) and not 0 < float(self.threshold) < float("inf"):
            raise ValueError(f"--threshold must be a positive distance in the unit of the files or auto, got {self.threshold}")
        if self.seed < 0:
            raise ValueError(f"--seed must be a whole number from 0, got {self.seed}")

    def _read(self, asked: Asked | None) -> tuple[Matched, SceneTracks | None]:
        """The matches, and the tracks that they are where ``asked`` says frames of a video."""
        from indexing.readers.matches import read_matches

        if asked is None:
            return read_matches(self.files, frames=frame_numbers(self.frames), static_points=self.static_points), None
        if self.static_points:
            raise ValueError("--static-points are of lines, and a video has points; leave it out")
        if self.model not in (None, "planar"):
            raise ValueError(f"--model {self.model} needs 3D points or lines, and a video has 2D points; use --model planar")
        tracks = follow(self.files, asked, views=3, more=True)
        return as_matches(tracks), tracks

    def _model(self, matched: Matched) -> tuple[str, list[str]]:
        """The model, and what to say about it."""
        dims, kind = matched.dims, "lines" if matched.lines else f"{matched.dims[0]}D points"
        given = self.model or ("lines" if matched.lines else "planar" if dims[0] == 2 else "rigid")
        odd = next((i for i, d in enumerate(dims) if d != dims[0]), None)
        if odd is not None:
            raise ValueError(f"{matched.names[odd]}: holds {dims[odd]}D points, {matched.names[0]} {dims[0]}D; give one kind")
        needed = {"planar": "2D points", "lines": "lines"}.get(given, "3D points")
        if needed != kind:
            fitting = "lines" if matched.lines else "planar" if dims[0] == 2 else "rigid, join or another of 3D points"
            raise ValueError(f"{matched.names[0]}: holds {kind}, --model {given} needs {needed}; use --model {fitting}")
        views = 2 if given == "lines" else 3
        if len(dims) != views and not (given in SEVERAL and len(dims) > views):
            have = f"{count(len(dims), 'view')} ({names(matched.names)})"
            raise ValueError(f"--model {given} needs {views} views, got {have}; give {views} files, or {views} frames of one")
        if self.motion != "straight" and given != "rigid":
            raise ValueError(f"--motion {self.motion} belongs to --model rigid, got {given}; use --model constant_velocity")
        if self.calibration is not None and given != "planar":
            raise ValueError(f"--calibration is of cameras, and --model {given} of 3D sensors, which need none; leave it out")
        if self.model is not None:
            return given, []
        from indexing.report.alignment import PURPOSE

        others = ", ".join(name for name in PURPOSE if name not in ("planar", "lines", given))
        hint = f"; if their scale or axes are not to be trusted, say --model with one of {others}" if given == "rigid" else ""
        return given, [f"model {given}, because the files hold {kind}{hint}"]

    def _limit(self, tracks: SceneTracks | None) -> float | None:
        """The threshold as the library takes it; None = estimated."""
        if self.threshold is None and tracks is not None:
            from indexing.video.options import SceneOptions

            options = SceneOptions()
            return options.threshold * max(1.0, max(tracks.size) / options.follow.working)
        return None if self.threshold in ("auto", None) else float(self.threshold)

    def _solve(self, matched: Matched, model: str, threshold: float | None) -> Any:
        """The alignment, by the library."""
        import torch

        import dyntorch

        views = [torch.from_numpy(view) for view in matched.views]
        options: dict[str, Any] = {
            "threshold": threshold,
            "weights": None if matched.weights is None else torch.from_numpy(matched.weights),
            "generator": torch.Generator().manual_seed(self.seed),
        }
        if matched.static is not None:
            options["static"] = torch.from_numpy(matched.static)
        try:
            if model == "planar":
                straight, matrices = calibrated(self.calibration, torch.stack(views))
                return dyntorch.align_planar(*straight, calibration=matrices, **options)
            if model == "lines":
                points = tuple(torch.from_numpy(part) for part in matched.static_points)
                return dyntorch.align_lines(*views, static_points=points or None, **options)
            return dyntorch.align_points(*views, model=model, motion=self.motion, **options)
        except ValueError as problem:
            raise ValueError(f"{names(matched.names)}: {worded(problem, WORDS)}") from problem


def frame_numbers(text: str | None) -> tuple[int, ...] | None:
    """``10,20,30`` as numbers."""
    if text is None:
        return None
    try:
        return tuple(int(word) for word in text.split(","))
    except ValueError:
        raise ValueError(f"--frames {text!r}: expected whole numbers with commas between them, such as --frames 10,20,30") from None


def show(report: AlignmentReport) -> None:
    """Print the result."""
    counts = report.counts
    known = report.solved
    row = [len(report.ids), *(counts[name] if known or name == "missing" else "" for name in counts)]
    row += [f"{report.sigma:.3g}" if known else "", report.state]
    table(["matches ", "static ", "moving ", "outliers ", "missing ", "noise ", "status"], [row])
    for name, view, rows, scaled in report.shown:
        heading = f"{name}: view {view} to view 1" + ("" if scaled else ", norm 1")
        cells = [[f"row {i}", *(" ± ".join(filter(None, cell)) for cell in row[1:])] for i, row in enumerate(rows, start=1)]
        table([heading, *(f"column {j} " for j in range(1, len(cells[0])))], cells)
    if report.poses:
        cells = [[f"view {v}", f"{turn:.4g}°", *(f"{x:.4g}" for x in shift)] for v, turn, shift in report.poses]
        table(["camera against view 1", "turn ", "x ", "y ", "z "], cells)
        normal = ", ".join(f"{x:.4g}" for x in report.found.normal)
        say(f"plane: normal ({normal}) before view 1; shifts in units of its distance")
    tell(report)
    if known and report.ambiguity:
        say(f"open: {report.ambiguity}")
