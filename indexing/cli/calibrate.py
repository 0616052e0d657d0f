"""``dyntorch calibrate``: cameras on tripods and the movement in 3D, from the people in view."""

from __future__ import annotations

import dataclasses
import math
import re
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from dyntorch.numerics import worded
from indexing.cli.console import check_folder, count, ended, flags, progress, say, table
from indexing.cli.films import Watched, Watching
from indexing.cli.inputs import Format, refuse_range

if TYPE_CHECKING:
    from indexing.calibrate import CameraRig, RigPriors
    from indexing.report.calibration import CalibrationReport
    from indexing.sync.recordings import Take

WORDS = flags(
    "fps", "size", "focal", "one_lens", "exif", "height", "length", "clocks", "rate", "max_shift", "person", "people",
    "min_confidence", "format", "layout", sizes="--size", lengths="--length", calibration="--calibration FILE.toml",
)  # fmt: skip


@dataclass(frozen=True)
class Calibrate:
    """Find where cameras stand, their focal lengths and clocks, and the movement in 3D: from the people in view, without a board.

    dyntorch calibrate cam1/ cam2/ cam3/ --size 1920x1080 --height 1.75 --out calib/

    dyntorch calibrate pose/ --fps 60 --size 1080x1920 --focal 1680 --synchronized --out calib/

    dyntorch calibrate left.mp4 middle.mp4 right.mp4 --one-lens --length left_hip left_knee 0.42 --out calib/
    """

    cameras: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="CAMERA ...", help_behavior_hint="")]
    """per camera a keypoint file, a folder with one file per frame, or a video; or one folder that holds those of all"""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER", help_behavior_hint="")] = None
    """where to write Calib_dyntorch.toml, keypoints_3d.trc, .c3d and .npz, calibration.json and report.html; without it, print"""
    fps: Annotated[str | None, tyro.conf.arg(metavar="N|N,N,...", help_behavior_hint="")] = None
    """frames per second of all cameras, or of each, for files that do not say (30 is assumed then, and the output says so)"""
    size: Annotated[str | None, tyro.conf.arg(metavar="WxH|WxH,WxH,...", help_behavior_hint="")] = None
    """width and height of the pictures in pixels, of all cameras or of each; by default as videos and files say"""
    focal: Annotated[str | None, tyro.conf.arg(metavar="PX|PX,PX,...", help_behavior_hint="")] = None
    """focal length in pixels, of all cameras or of each, where it is known; by default it is found"""
    one_lens: bool = False
    """all cameras have the same focal length: phones of one kind, not zoomed"""
    exif: bool = False
    """take focal lengths from the 35 mm equivalent that phones write into videos, or into a photo beside the keypoints"""
    calibration: Annotated[Path | None, tyro.conf.arg(metavar="TOML", help_behavior_hint="")] = None
    """known lenses: a file with matrix and distortions of each camera, as Pose2Sim writes it; where it puts them is not used"""
    height: Annotated[float | None, tyro.conf.arg(metavar="M", help_behavior_hint="")] = None
    """metres, how tall the person is (of several, the tallest): gives the result its scale"""
    length: Annotated[tuple[tuple[str, str, float], ...], tyro.conf.arg(metavar="JOINT JOINT M", help_behavior_hint="")] = ()
    """metres between two joints, where that is known better: gives the scale as well"""
    clocks: Annotated[str | None, tyro.conf.arg(metavar="JSON|known", help_behavior_hint="")] = None
    """how the clocks run: sync.json of dyntorch sync, or known where equal frame numbers are equal moments; else it is found"""
    synchronized: bool = False
    """the same as --clocks known"""
    rate: bool = True
    """clocks may run at different rates; --no-rate where one clock drives all cameras"""
    max_shift: Annotated[float | None, tyro.conf.arg(metavar="S", help_behavior_hint="")] = None
    """seconds, the largest offset that is searched; by default as far as the recordings overlap enough"""
    person: Literal["everyone", "largest", "confident", "tracked"] = "everyone"
    """who is used where several people are in view: all who are found in several cameras (at most --people), or one"""
    min_confidence: Annotated[float, tyro.conf.arg(metavar="C")] = 0.0
    """joints that the detector trusts less are taken as not seen"""
    format: Annotated[Format | None, tyro.conf.arg(help_behavior_hint="")] = None
    """of the keypoint files; by default their content decides"""
    layout: Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="")] = None
    """which joint is which, such as BODY_25B; by default as the files say, or as the body looks"""
    footage: Watching = field(default_factory=Watching)
    title: Annotated[str | None, tyro.conf.arg(metavar="TEXT", help_behavior_hint="")] = None
    """heading of the report"""

    def run(self) -> int:
        """Read, calibrate, write, and say what was found."""
        clocks = self._check()
        for path in self.cameras:
            refuse_range(path)
        from indexing.files import manifest
        from indexing.report.calibration import CalibrationReport, check_folder_of, write_calibration
        from indexing.sync.recordings import find_cameras

        found = find_cameras([path.expanduser() for path in self.cameras])
        files = [self.calibration] if self.calibration is not None else []
        files += [Path(clocks)] if clocks not in (None, "known") else []
        inputs = [*found.values(), *(path.expanduser() for path in files)]
        folder = None if self.out is None else check_folder(self.out)
        if folder is not None:
            check_folder_of(folder, inputs, self.footage.people)
        started = time.perf_counter()
        watched = self.footage.watch(found.values(), folder, self._numbers("fps", len(found))[0])
        with progress("reading", steps=False):
            takes = self._read(found, watched)
        read = time.perf_counter()
        with progress(f"calibrating {count(len(takes), 'camera')}", steps=False):
            rig = self._solve(takes, clocks, watched)
        timings = {"read": read - started, "calibrate": time.perf_counter() - read}
        report = CalibrationReport(rig, self.title or "")
        page: Path | None = None
        if folder is not None:
            with progress("writing", steps=False):
                made = manifest({"command": "calibrate", **dataclasses.asdict(self)}, inputs, None, timings)
                report = dataclasses.replace(report, manifest=made)
                page, report = write_calibration(folder, report)
        show(report, folder)
        return ended(page, None if rig.ok else rig.reason)

    def _check(self) -> str | None:
        """Raise on flags that make no sense by themselves, before any file is read; the clocks that were given."""
        from indexing.calibrate.body_height import check_height

        if self.max_shift is not None and not 0 < self.max_shift < math.inf:
            raise ValueError(f"--max-shift must be a positive number of seconds, got {self.max_shift:g}")
        if self.synchronized and self.clocks not in (None, "known"):
            raise ValueError(f"--synchronized and --clocks {self.clocks} both say how the clocks run; give one of them")
        clocks = "known" if self.synchronized else self.clocks
        if clocks is not None and self.max_shift is not None:
            raise ValueError("--max-shift is of clocks that are searched, and they are given; leave it out")
        if self.height is not None:
            try:
                check_height(self.height)
            except ValueError as problem:
                raise ValueError(worded(problem, WORDS)) from None
        if self.footage.by == "pixels":
            raise ValueError("--by pixels: cameras are calibrated from the joints of people; leave it out")
        self._numbers("fps", None), self._numbers("focal", None), self._sizes(None)
        return clocks

    def _numbers(self, flag: str, cameras: int | None) -> list[float | None]:
        """One number for each camera."""
        given: str | None = getattr(self, flag)
        if given is None:
            return [None] * (cameras or 0)
        try:
            values: list[float | None] = [float(word) for word in given.split(",")]
        except ValueError:
            values = []
        if not values or not all(value is not None and 0 < value < math.inf for value in values):
            unit, example = ("frames per second", "60,59.94") if flag == "fps" else ("pixels", "1510,1495,1502")
            raise ValueError(f"--{flag} must be a positive number of {unit}, or one per camera as in {example}, got {given}")
        if cameras is not None and len(values) not in (1, cameras):
            raise ValueError(f"--{flag} gives {len(values)} numbers for {cameras} cameras; give one, or one per camera")
        return values * ((cameras or 1) if len(values) == 1 else 1)

    def _sizes(self, cameras: int | None) -> list[tuple[int, int]] | None:
        """Width and height of each camera's pictures; None where they are not given."""
        if self.size is None:
            return None
        words = [re.fullmatch(r"\s*(\d{1,6})\s*[xX*]\s*(\d{1,6})\s*", word) for word in self.size.split(",")]
        sizes = [(int(word[1]), int(word[2])) for word in words if word]
        if len(sizes) < len(words) or any(min(size) < 1 for size in sizes):
            raise ValueError(f"--size must be width x height in pixels, as in 1920x1080, or one per camera, got {self.size}")
        if cameras is not None and len(sizes) not in (1, cameras):
            raise ValueError(f"--size gives {len(sizes)} sizes for {cameras} cameras; give one, or one per camera")
        return sizes * ((cameras or 1) if len(sizes) == 1 else 1)

    def _read(self, found: dict[str, Path], watched: Watched) -> list[Take]:
        from indexing.sync.recordings import take_of

        options: dict[str, Any] = {"person": "auto" if self.person == "everyone" else self.person, "format": self.format}
        options |= {"min_confidence": self.min_confidence, "layout": self.layout, "by": "keypoints"}
        rates = self._numbers("fps", len(found))
        try:
            return [
                take_of(path, name=name, fps=rate, keypoints=watched.files.get(path), **options)
                for (name, path), rate in zip(found.items(), rates, strict=True)
            ]
        except ValueError as problem:
            raise ValueError(worded(problem, WORDS)) from problem

    def _known(self, cameras: int, clocks: str | None) -> RigPriors:
        from indexing.calibrate import RigPriors

        focal = self._numbers("focal", cameras)
        return RigPriors(
            focal=None if self.focal is None else [value for value in focal if value is not None],
            one_lens=self.one_lens,
            calibration=None if self.calibration is None else self.calibration.expanduser(),
            exif=self.exif,
            clocks=clocks,
            rate=self.rate,
            max_shift=self.max_shift,
            height=self.height,
            lengths={(a, b): metres for a, b, metres in self.length},
        )

    def _solve(self, takes: list[Take], clocks: str | None, watched: Watched) -> CameraRig:
        from indexing.calibrate import calibrate_recordings

        people = self.footage.people if self.person == "everyone" else 1
        try:
            rig = calibrate_recordings(
                takes, self._known(len(takes), clocks), sizes=self._sizes(len(takes)), people=people, words=WORDS
            )
        except ValueError as problem:
            raise ValueError(worded(problem, WORDS)) from problem
        return dataclasses.replace(rig, remarks=(*watched.notes, *rig.remarks))


def show(report: CalibrationReport, folder: Path | None = None) -> None:
    """Print the result."""
    from indexing.report.calibration import agrees_text, focal_text, offset_text, place_text

    rig = report.rig
    unit = "m" if rig.calibration.metric else "no unit"
    pixels = [f"{value:.1f}" if math.isfinite(value) else "none" for value in report.residual]
    rows = [
        [
            name, focal_text(report, i), place_text(report, i), offset_text(report, i), pixels[i],
            agrees_text(report, i),
        ]
        for i, name in enumerate(rig.names)
    ]  # fmt: skip
    table(["camera", "focal length px ", f"position {unit} ", "clock s ", "residual px ", "agrees "], rows)
    for note in report.notes:
        say(f"note: {note}")
    for text in rig.unknown if rig.ok else []:
        say(f"open: {text}")
    if folder is not None:
        from indexing.report.calibration import earlier

        kept = sorted(name for name in earlier(folder) if not name.endswith((".png", ".html", ".json")))
        say(f"written to {folder}/: {', '.join(kept)}" if kept else f"written to {folder}/: the report alone, and no calibration")
