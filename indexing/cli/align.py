"""``dyntorch align``: how a sensor moved among things that move, and what stood still."""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from indexing.cli import console
from indexing.cli.console import check_report, count, ended, names, progress, say, table

if TYPE_CHECKING:
    from indexing.readers.matches import Matched
    from indexing.report.alignment import AlignmentReport

Model = Literal["planar", "join", "minimal_join", "constant_velocity", "affine_constant_velocity", "rigid", "lines"]
PURPOSE = {
    "planar": "Points of a plane stand still or move on straight lines before a moving camera.",
    "join": "Points stand still or move on straight lines before an uncalibrated 3D sensor.",
    "minimal_join": "Points stand still or move on straight lines before an uncalibrated 3D sensor.",
    "constant_velocity": "Points move at constant velocity before an uncalibrated 3D sensor.",
    "affine_constant_velocity": "Points move at constant velocity before a 3D sensor that is known up to an affinity.",
    "rigid": "Points stand still or move on straight lines before a 3D sensor that moves rigidly.",
    "lines": "Lines stand still or stay in a plane while they move, before a 3D sensor.",
}
REASONS = {
    "TOO_FEW": "too few matches are present in all views; give more",
    "DEGENERATE": "several motions fit all matches exactly; add matches that move otherwise, or use a model with fewer unknowns",
    "AMBIGUOUS": "other motions fit as well; add matches that differ more, lower the noise, or use a model with fewer unknowns",
    "NO_CONSENSUS": "no motion fits enough of the matches; raise --threshold, or give matches of which more belong to the model",
}


@dataclass(frozen=True)
class Align:
    """Find how a sensor moved while points move, too, and which of them stand still.

    dyntorch align a.csv b.csv c.csv --model planar --threshold 1.5 --out out/

    dyntorch align scan1.ply scan2.ply scan3.ply --model rigid

    dyntorch align walk.c3d --frames 10,20,30 --model join

    dyntorch align l1.csv l2.csv --model lines --static-points p1.csv p2.csv
    """

    files: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="FILE ...", help_behavior_hint="")]
    """a file per view (CSV with columns x,y or x,y,z and perhaps id; npy; PLY), or one for all (npz with x1, x2, x3; C3D)"""
    model: Annotated[Model | None, tyro.conf.arg(help_behavior_hint="")] = None
    """how points may move, and the sensor; by default planar for 2D points, rigid for 3D points, lines for lines"""
    threshold: Annotated[float | Literal["auto"], tyro.conf.arg(metavar="T|auto")] = "auto"
    """greatest distance of an inlier in the unit of the files: three times the noise of a coordinate; auto estimates it"""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER", help_behavior_hint="")] = None
    """where to write report.html, alignment.json, labels.csv and alignment.png; without it, print only"""
    frames: Annotated[str | None, tyro.conf.arg(metavar="N,N,N", help_behavior_hint="")] = None
    """of a file with many frames (C3D, npy), those that are the views"""
    motion: Literal["straight", "constant_velocity"] = "straight"
    """of rigid: points move on straight lines at any speed, or at constant velocity"""
    static_points: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="FILE FILE", help_behavior_hint="")] = ()
    """of lines: points that are known to stand still, a file for each view"""
    seed: int = 0
    """of the random samples"""

    def run(self) -> int:
        """Read, align, write, and say what was found."""
        inputs = [path.expanduser() for path in (*self.files, *self.static_points)]
        self._check()
        from indexing.report.alignment import FILES

        folder = check_report(self.out, inputs, FILES)
        started = time.perf_counter()
        with progress("reading", steps=False):
            from indexing.readers.matches import read_matches

            matched = read_matches(self.files, frames=frame_numbers(self.frames), static_points=self.static_points)
        model, notes = self._model(matched)
        read = time.perf_counter()
        with progress(f"aligning {count(len(matched.ids), 'match').replace('matchs', 'matches')}", steps=False):
            result = self._solve(matched, model)
        timings = {"read": read - started, "align": time.perf_counter() - read}
        report = self._report(matched, model, result, [*notes, *matched.notes], inputs, timings)
        page = None
        if folder is not None:
            from indexing.report.alignment import write_alignment

            with progress("drawing the report", steps=False):
                page = write_alignment(folder, report)
        show(report)
        return ended(page, None if report.status == "OK" else report.reason)

    def _check(self) -> None:
        """Raise on flags that make no sense by themselves, before any file is read."""
        if not self.files:
            raise ValueError("no files; give a file of points for each view, or one .npz or .c3d with all of them")
        if self.threshold != "auto" and not 0 < float(self.threshold) < float("inf"):
            raise ValueError(f"--threshold must be a positive distance in the unit of the files or auto, got {self.threshold}")
        if self.seed < 0:
            raise ValueError(f"--seed must be a whole number from 0, got {self.seed}")

    def _model(self, matched: Matched) -> tuple[str, list[str]]:
        """The model, and what to say about it.

        Raises:
            ValueError: the files do not hold what it needs.
        """
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
        if len(dims) != views:
            have = f"{count(len(dims), 'view')} ({names(matched.names)})"
            raise ValueError(f"--model {given} needs {views} views, got {have}; give {views} files, or {views} frames of one")
        if self.motion != "straight" and given != "rigid":
            raise ValueError(f"--motion {self.motion} belongs to --model rigid, got {given}; use --model constant_velocity")
        if self.model is not None:
            return given, []
        others = ", ".join(name for name in PURPOSE if name not in ("planar", "lines", given))
        hint = f"; if their scale or axes are not to be trusted, say --model with one of {others}" if given == "rigid" else ""
        return given, [f"model {given}, because the files hold {kind}{hint}"]

    def _solve(self, matched: Matched, model: str) -> Any:
        """The alignment, by the library.

        Raises:
            ValueError: too few matches, with the files' names.
        """
        import torch

        import dyntorch

        views = [torch.from_numpy(view) for view in matched.views]
        options: dict[str, Any] = {
            "threshold": None if self.threshold == "auto" else float(self.threshold),
            "weights": None if matched.weights is None else torch.from_numpy(matched.weights),
            "generator": torch.Generator().manual_seed(self.seed),
        }
        if matched.static is not None:
            options["static"] = torch.from_numpy(matched.static)
        try:
            if model == "planar":
                return dyntorch.align_planar(*views, **options)
            if model == "lines":
                points = tuple(torch.from_numpy(part) for part in matched.static_points)
                return dyntorch.align_lines(*views, static_points=points or None, **options)
            return dyntorch.align_points(*views, model=model, motion=self.motion, **options)
        except ValueError as problem:
            raise ValueError(f"{names(matched.names)}: {in_flags(str(problem))}") from problem

    def _report(
        self, matched: Matched, model: str, result: Any, notes: list[str], inputs: list[Path], timings: dict[str, float]
    ) -> AlignmentReport:
        from dyntorch import Status
        from indexing.files import manifest
        from indexing.report.alignment import AlignmentReport, as_segments

        status = Status(int(result.status)).name
        parts = [part for part in (result.A, result.B) if part is not None]
        return AlignmentReport(
            title="What moved, and how the sensor did" if status == "OK" else "The matches do not decide",
            model=(model, PURPOSE[model]),
            views=[as_segments(view) if view.shape[1:] == (6,) else view for view in matched.views],
            names=[str(Path(name).name) for name in matched.names],
            ids=matched.ids,
            labels=result.labels.numpy(),
            motion=[part.numpy() for part in parts],
            covariance=result.covariance.numpy(),
            sigma=float(result.sigma),
            status=status,
            reason=REASONS.get(status, ""),
            ambiguity=in_flags(result.ambiguity),
            warnings=[(notice.code.value, notice.value, in_flags(notice.message)) for notice in result.warnings],
            notes=notes,
            velocities=None if result.velocities is None else result.velocities.numpy(),
            unverified=None if result.unverified is None else result.unverified.numpy(),
            metric=model == "rigid",
            threshold=None if self.threshold == "auto" else float(self.threshold),
            manifest=manifest({"command": "align", **dataclasses.asdict(self), "model": model}, inputs, self.seed, timings),
        )


def frame_numbers(text: str | None) -> tuple[int, ...] | None:
    """``10,20,30`` as numbers.

    Raises:
        ValueError: something else.
    """
    if text is None:
        return None
    try:
        return tuple(int(word) for word in text.split(","))
    except ValueError:
        raise ValueError(f"--frames {text!r}: expected whole numbers with commas between them, such as --frames 10,20,30") from None


def in_flags(message: str) -> str:
    """A message of the library in the words of the command line.

    Example:
        >>> in_flags("use model='rigid', or label static ones (static=)")
        'use --model rigid, or label static ones (a column static)'
    """
    message = message.replace("(static=)", "(a column static)").replace("(static=; then", "(a column static; then")
    return console.in_flags(message, "model", "static_points")


def show(report: AlignmentReport) -> None:
    """Print the result."""
    from indexing.report.alignment import display_scale, figures

    counts = report.counts
    known = report.solved
    rows = [[len(report.ids), *(counts[name] if known or name == "missing" else "" for name in counts)]]
    rows[0] += [f"{report.sigma:.3g}" if known else "", report.status.lower().replace("_", " ")]
    table(["matches ", "static ", "moving ", "outliers ", "missing ", "noise ", "status"], rows)
    start = 0
    for number, (name, matrix) in enumerate(zip("AB", report.motion, strict=False), start=2):
        block = report.covariance[start : start + matrix.size, start : start + matrix.size]
        start += matrix.size
        if known:
            values, spread, scaled = display_scale(matrix, block)
            cells = [
                [" ± ".join(filter(None, figures(float(v), float(s)))) for v, s in zip(*row, strict=True)]
                for row in zip(values, spread, strict=True)
            ]
            rows = [[f"row {i}", *row] for i, row in enumerate(cells, start=1)]
            heading = f"{name}: view {number} to view 1" + ("" if scaled else ", norm 1")
            table([heading, *(f"column {j} " for j in range(1, matrix.shape[1] + 1))], rows)
    for note in report.notes:
        say(f"note: {note}")
    for code, _, message in report.warnings:
        say(f"warning: {code.replace('_', ' ')}: {message}")
    if known and report.ambiguity:
        say(f"open: {report.ambiguity}")
