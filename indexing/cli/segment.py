"""``dyntorch segment``: which matches of two images move together, and how each body moved."""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from dyntorch.numerics import worded
from indexing.cli.console import check_report, count, ended, flags, progress, say, table, tell
from indexing.cli.scenes import LEFT_OUT, Asked, as_pair, follow, inputs_of, is_scene, photographs, tracks_csv

if TYPE_CHECKING:
    from indexing.readers.pairs import MatchedPair, Photograph
    from indexing.report.segmentation import SegmentationReport

WORDS = flags("bodies", "threshold", "spatial")
LEAST = 8  # matches
SMALL = 50  # thresholds across the points, below which these are hardly pixels
OUTSIDE = 0.02  # of the matches, beyond which an image is hardly the one they were found in


@dataclass(frozen=True)
class Segment:
    """Find which matches of two images move together, which are wrong, and how each body moved.

    dyntorch segment matches.npz --out out/

    dyntorch segment matches.csv --images left.jpg right.jpg --out out/

    dyntorch segment adelaidermf.npz --pair breadtoy --bodies 2 --threshold auto

    dyntorch segment street.mp4 --at 0.4,1.2 --out out/
    """

    files: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="MATCHES", help_behavior_hint="")]
    """npz with x1, x2 (n, 2), or NAME/x1, NAME/x2 of several pairs; npy (n, 4); CSV with columns x1,y1,x2,y2; or a video, a folder,
    pattern or list of pictures, whose points are followed, background included"""
    bodies: Annotated[int | Literal["auto"], tyro.conf.arg(metavar="K|auto")] = "auto"
    """how many bodies there are"""
    threshold: Annotated[float | Literal["auto"], tyro.conf.arg(metavar="PX|auto")] = 2.5
    """greatest distance of an inlier in pixels: about five times the noise of a coordinate; auto estimates it"""
    spatial: bool = True
    """neighbours tend to move with one body; --no-spatial where bodies are transparent or interleaved"""
    pair: Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="")] = None
    """of an npz with several pairs, the one to take"""
    frames: Annotated[str | None, tyro.conf.arg(metavar="N,N", help_behavior_hint="")] = None
    """of a video or of pictures, the two to compare; by default the first and the last in which half of its points are still
    followed"""
    at: Annotated[str | None, tyro.conf.arg(metavar="S,S", help_behavior_hint="")] = None
    """of a video, seconds of the two instead: the first frame at or after each"""
    images: Annotated[tuple[Path, Path] | None, tyro.conf.arg(metavar="LEFT RIGHT", help_behavior_hint="")] = None
    """both images (png, jpg, ...), to draw the matches on"""
    size: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="W H", help_behavior_hint="")] = None
    """width and height of the images in pixels, for the picture without --images"""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER", help_behavior_hint="")] = None
    """where to write report.html, segmentation.npz, segmentation.json, labels.csv and segmentation.png; without it, print only"""
    title: Annotated[str | None, tyro.conf.arg(metavar="TEXT", help_behavior_hint="")] = None
    """heading of the report"""
    seed: int = 0
    """of the random samples"""

    def run(self) -> int:
        """Read, segment, write, and say what was found."""
        inputs = [path.expanduser() for path in (*self.files, *(self.images or ()))]
        self._check()
        scene, asked = is_scene([path.expanduser() for path in self.files]), Asked(self.frames, self.at)
        self._check_scene(scene, asked)
        inputs = inputs_of(inputs) if scene else inputs
        from indexing.files import manifest
        from indexing.report.segmentation import WRITTEN, SegmentationReport, write_segmentation

        folder = check_report(self.out, inputs, WRITTEN)
        started = time.perf_counter()
        with progress("reading", steps=False):
            from indexing.readers.pairs import read_image, read_pair

            tracks = follow(self.files, asked, views=2) if scene else None
            pair = as_pair(tracks, self.files[0]) if tracks else read_pair(self.files[0], self.pair)
            shown = photographs(tracks) if tracks else [read_image(path) for path in self.images or ()]
        notes = [*(tracks.notes if tracks else ()), *self._notes(pair, shown)]
        read = time.perf_counter()
        with progress(f"segmenting {count(int(pair.seen.sum()), 'match', 'matches')}", steps=False):
            result = self._solve(pair)
        timings = {"read": read - started, "segment": time.perf_counter() - read}
        found = int(result.bodies)
        if self.bodies != "auto" and 0 < found < self.bodies:
            notes.append(f"--bodies asks for {self.bodies}, the matches carry {found}")
        report = SegmentationReport(
            result=result,
            pair=pair,
            photographs=shown,
            size=self.size or pair.size,
            heading=self.title or "",
            notes=notes,
            words=WORDS,
            manifest=manifest({"command": "segment", **dataclasses.asdict(self)}, inputs, self.seed, timings),
            besides={"tracks.csv": tracks_csv(tracks)} if tracks else {},
        )
        page = None
        if folder is not None:
            with progress("drawing the report", steps=False):
                page = write_segmentation(folder, report)
        show(report)
        return ended(page, None if report.status == "OK" else report.reason)

    def _check(self) -> None:
        """Raise on flags that make no sense by themselves, before any file is read."""
        if self.bodies != "auto" and int(self.bodies) < 1:
            raise ValueError(f"--bodies must be a whole number from 1, or auto, got {self.bodies}")
        if self.threshold != "auto" and not 0 < float(self.threshold) < float("inf"):
            raise ValueError(f"--threshold must be a positive distance in pixels or auto, got {self.threshold}")
        if self.size is not None and not all(0 < side < float("inf") for side in self.size):
            raise ValueError(f"--size must be width and height in pixels, such as 640 480, got {self.size[0]:g} {self.size[1]:g}")
        if self.size is not None and self.images is not None:
            raise ValueError("--size and --images both say how large the images are; leave one out")
        if self.seed < 0:
            raise ValueError(f"--seed must be a whole number from 0, got {self.seed}")

    def _check_scene(self, scene: bool, asked: Asked) -> None:
        """Raise on flags that do not fit what is given."""
        if not self.files:
            raise ValueError("no matches; give a file with x1, x2, or a video")
        if not scene and len(self.files) > 1:
            raise ValueError(f"{len(self.files)} files; give one file of matches, or pictures alone")
        if not scene and self.frames is not None:
            raise ValueError(f"--frames {self.frames}: {LEFT_OUT}; leave it out")
        asked.check(scene)
        for flag in ("pair", "images", "size"):
            if scene and getattr(self, flag) is not None:
                raise ValueError(f"--{flag} is of files of matches, and a video or pictures are given; leave it out")

    def _notes(self, pair: MatchedPair, shown: list[Photograph]) -> list[str]:
        """What to say about the input.

        Raises:
            ValueError: too few matches, or a threshold larger than all that they cover.
        """
        import numpy as np

        seen = pair.seen
        number, lost = int(seen.sum()), int((~seen).sum())
        if number < LEAST:
            said = f"{pair.path}: x1, x2 hold {number} complete matches{f' and {lost} with a missing coordinate' * (lost > 0)}"
            raise ValueError(f"{said}, {LEAST} are needed; give more matches")
        notes = []
        if lost:
            was = count(lost, "match lacks a coordinate and was", "matches lack a coordinate and were")
            notes.append(f"{was} left out")
        reach = float(np.ptp(np.concatenate([pair.x1[seen], pair.x2[seen]]), axis=0).max())
        if self.threshold != "auto" and reach < SMALL * float(self.threshold):
            said = f"the points lie within {reach:.3g}, and --threshold is {self.threshold:g}"
            if 0 < reach <= float(self.threshold):  # anything would fit anything
                raise ValueError(f"{pair.path}: {said}: give --threshold in the unit of the points, or --threshold auto")
            notes.append(f"{said}; if they are not in pixels, give --threshold in their unit, or auto")
        size = self.size or pair.size
        frames = [(photograph.name, photograph.size) for photograph in shown]
        frames = frames or [(f"image {i}", size) for i in (1, 2) if size is not None]
        for (name, (wide, tall)), points in zip(frames, (pair.x1[seen], pair.x2[seen]), strict=False):
            out = int(((points < -0.5) | (points > np.array([wide, tall]) - 0.5)).any(axis=1).sum())
            if out > OUTSIDE * number:
                said = f"{out:,} of {number:,} matches lie outside of {name} ({wide:g} by {tall:g})"
                what = "images" if shown else "size of the images"
                notes.append(f"{said}; give the {what} in which the matches were found, in their order, and x before y")
        return notes

    def _solve(self, pair: MatchedPair) -> Any:
        """The segmentation, by the library.

        Raises:
            ValueError: naming the file.
        """
        import torch

        import dyntorch

        try:
            return dyntorch.segment(
                torch.from_numpy(pair.x1),
                torch.from_numpy(pair.x2),
                bodies=None if self.bodies == "auto" else int(self.bodies),
                threshold=None if self.threshold == "auto" else float(self.threshold),
                weights=None if pair.weights is None else torch.from_numpy(pair.weights),
                spatial=self.spatial,
                generator=torch.Generator().manual_seed(self.seed),
            )
        except ValueError as problem:
            raise ValueError(f"{pair.path}: {worded(problem, WORDS)}") from problem


def show(report: SegmentationReport) -> None:
    """Print the result."""
    from indexing.report.page import even

    number, counts = report.seen, report.counts
    noise = even([report.rms(label) for label in range(1, len(report.models) + 1)])
    rows: list[list[object]] = []
    for label, model in enumerate(report.models, start=1):
        mine = counts[f"body {label}"]
        rows.append([f"body {label}", f"{mine:,}", f"{100 * mine / number:.1f} %", model, noise[label - 1] if mine else ""])
    rest = "outliers" if report.models else "unlabelled"
    rows.append([rest, f"{counts['outlier']:,}", f"{100 * counts['outlier'] / number:.1f} %", "", ""])
    table(["body", "matches ", "share ", "model", "noise rms px "], rows)
    if report.misclassified is not None:
        say(f"misclassified: {100 * report.misclassified:.2f} % against the labels of the file")
    tell(report)
