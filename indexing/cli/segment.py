"""``dyntorch segment``: what moves together, between two images or through a whole video, and how each body moves."""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from dyntorch.numerics import worded
from indexing.cli.bodies import LEAST, BodiesJob, Given, read_given, run_bodies, unit_notes
from indexing.cli.console import check_report, count, ended, flags, progress, say, table, tell
from indexing.cli.scenes import (
    LEFT_OUT,
    PICTURE_FILES,
    Asked,
    as_pair,
    follow,
    inputs_of,
    is_scene,
    photographs,
    tracks_csv,
)

if TYPE_CHECKING:
    from indexing.readers.pairs import MatchedPair, Photograph
    from indexing.report.segmentation import SegmentationReport
    from indexing.video.scene import SceneTracks

WORDS = flags("bodies", "threshold", "spatial")
OUTSIDE = 0.02  # of the matches, beyond which an image is hardly the one they were found in


@dataclass(frozen=True)
class Segment:
    """Find what moves together, what is wrong, how each body moves and which stands still: tracks through a video, or matches of
    two images.

    dyntorch segment street.mp4 --out out/

    dyntorch segment tracks.csv --images street.mp4 --out out/

    dyntorch segment hopkins155.npz --key cars1 --bodies 3

    dyntorch segment matches.npz --out out/

    dyntorch segment matches.csv --images left.jpg right.jpg --out out/

    dyntorch segment adelaidermf.npz --pair breadtoy --bodies 2 --threshold auto

    dyntorch segment street.mp4 --at 0.4,1.2 --out out/

    dyntorch segment --colmap database.db --out static.db
    """

    files: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="FILE", help_behavior_hint="")]
    """a video, a folder, pattern or list of pictures, whose points are followed, background included; tracks: a table with columns
    frame (or time), id, x, y, npz with tracks (frames, n, 2), npy; or matches of two images: npz with x1, x2 (n, 2), or NAME/x1,
    NAME/x2 of several pairs, npy (n, 4), CSV with columns x1,y1,x2,y2"""
    bodies: Annotated[int | Literal["auto"], tyro.conf.arg(metavar="K|auto")] = "auto"
    """how many bodies there are"""
    threshold: Annotated[float | Literal["auto"], tyro.conf.arg(metavar="PX|auto")] = 2.5
    """greatest distance of an inlier in pixels: about five times the noise of a coordinate; auto estimates it, of two
    images"""
    spatial: bool = True
    """of two images, neighbours tend to move with one body; --no-spatial where bodies are transparent or interleaved"""
    pair: Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="")] = None
    """of an npz with several pairs, the one to take"""
    key: Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="")] = None
    """of an npz with several sequences or arrays of tracks, the one to take"""
    frames: Annotated[str | None, tyro.conf.arg(metavar="N,N,...|N-N", help_behavior_hint="")] = None
    """of a video, of pictures or of tracks, the frames to take, 0,20,40 or 0-99; two are compared as two images.  All by default,
    of more than 200 every so many"""
    at: Annotated[str | None, tyro.conf.arg(metavar="S,S,...", help_behavior_hint="")] = None
    """of a video, seconds of the frames instead: the first frame at or after each"""
    every: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")] = None
    """of a video or of pictures, every so many frames instead; 1 takes all"""
    images: Annotated[tuple[Path, ...] | None, tyro.conf.arg(metavar="IMAGE ...", help_behavior_hint="")] = None
    """what to draw on: of matches both images (png, jpg, ...), of a file of tracks the video, or a folder, pattern or list of its
    pictures"""
    size: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="W H", help_behavior_hint="")] = None
    """width and height of the images in pixels, for the picture without --images"""
    colmap: Annotated[Path | None, tyro.conf.arg(metavar="DATABASE", help_behavior_hint="")] = None
    """a database of COLMAP, whose matches that stand still are written into another one, --out static.db; --images is the folder of
    its images then"""
    masks: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER", help_behavior_hint="")] = None
    """with --colmap, where to write a mask per image around what moves; by default beside --out"""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER", help_behavior_hint="")] = None
    """where to write report.html, segmentation.npz, segmentation.json, labels.csv and segmentation.png, of videos segmentation.mp4,
    too; without it, print only"""
    title: Annotated[str | None, tyro.conf.arg(metavar="TEXT", help_behavior_hint="")] = None
    """heading of the report"""
    seed: int = 0
    """of the random samples"""

    def run(self) -> int:
        """Read, segment, write, and say what was found."""
        self._check()
        if self.colmap is not None or self.masks is not None:
            return self._from_colmap()
        files = [path.expanduser() for path in self.files]
        scene, asked = is_scene(files), Asked(self.frames, self.at, self.every)
        whole = self._is_whole(files, scene, asked)
        self._check_kind(scene, whole, asked)
        started = time.perf_counter()
        given = None
        if whole:
            job = self._job(files)
            check_report(self.out, job.inputs, ())
            with progress("reading", steps=False):
                given = read_given(files, scene, asked, self.key)
            if len(given.tracks.views) > 2:
                return run_bodies(job, given, time.perf_counter() - started, dataclasses.asdict(self))
        return self._two_views(files, scene, asked, given)

    def _from_colmap(self) -> int:
        """The static matches of a database."""
        from indexing.cli.colmap import ColmapJob, run_colmap

        if self.colmap is None:
            raise ValueError(f"--masks {self.masks}: it is for --colmap DATABASE; leave it out")
        if self.files:
            raise ValueError(f"{self.files[0]}: --colmap {self.colmap} gives the matches; leave one out")
        for flag in ("pair", "key", "frames", "at", "every", "size"):
            if getattr(self, flag) is not None:
                raise ValueError(f"--{flag} does not go with --colmap; leave it out")
        if self.bodies != "auto":
            raise ValueError(f"--bodies {self.bodies} does not go with --colmap, whose pairs differ; leave it out")
        if self.images is not None and len(self.images) != 1:
            raise ValueError(f"--images: {len(self.images)} are given; with --colmap, give the folder of the images")
        job = ColmapJob(
            database=self.colmap,
            out=self.out,
            images=None if self.images is None else self.images[0],
            masks=self.masks,
            threshold=None if self.threshold == "auto" else float(self.threshold),
            spatial=self.spatial,
            seed=self.seed,
            title=self.title or "",
        )
        return run_colmap(job, dataclasses.asdict(self))

    def _job(self, files: list[Path]) -> BodiesJob:
        """What is asked for of whole videos and of tracks."""
        return BodiesJob(
            files=files,
            images=[path.expanduser() for path in self.images or ()],
            bodies=None if self.bodies == "auto" else int(self.bodies),
            threshold=float(self.threshold),
            size=self.size,
            out=self.out,
            title=self.title or "",
            seed=self.seed,
        )

    def _two_views(self, files: list[Path], scene: bool, asked: Asked, given: Given | None) -> int:
        """The same of matches of two images, or of tracks through two frames."""
        inputs = [*files, *(path.expanduser() for path in self.images or ())]
        inputs = inputs_of(inputs) if scene else inputs
        from indexing.files import manifest
        from indexing.report.segmentation import WRITTEN, SegmentationReport, write_segmentation

        folder = check_report(self.out, inputs, WRITTEN)
        started = time.perf_counter()
        with progress("reading", steps=False):
            pair, tracks = self._pair(files, scene, asked, given)
            shown = photographs(tracks) if tracks else self._images(given is not None)
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

    def _pair(self, files: list[Path], scene: bool, asked: Asked, given: Given | None) -> tuple[MatchedPair, SceneTracks | None]:
        """The matches, and the two frames where they were followed."""
        from indexing.readers.pairs import read_pair

        if given is not None:
            return given.as_pair(), given.followed
        if scene:
            tracks = follow(files, asked, views=2)
            return as_pair(tracks, files[0]), tracks
        return read_pair(files[0], self.pair), None

    def _images(self, tracked: bool) -> list[Photograph]:
        """Both images."""
        from indexing.readers.pairs import read_image

        images = self.images or ()
        if images and len(images) != 2:
            of = "tracks through two frames" if tracked else "matches"
            raise ValueError(f"--images: {count(len(images), 'is', 'are')} given, and {of} are drawn on two; give both images")
        return [read_image(path) for path in images]

    def _is_whole(self, files: list[Path], scene: bool, asked: Asked) -> bool:
        """Whether the inputs are tracks, or a video or pictures of which more than two frames are taken."""
        if not scene:
            from indexing.readers.tracks import holds_tracks

            return self.pair is None and len(files) == 1 and (self.key is not None or holds_tracks(files[0]))
        if asked.span() is not None:
            return True
        named = asked.numbers() or asked.moments()
        pictures = len(files) == 2 and all(path.suffix.lower() in PICTURE_FILES for path in files)
        return len(named) != 2 if named is not None else not pictures

    def _check(self) -> None:
        """Raise on flags that make no sense by themselves, before any file is read."""
        if self.bodies != "auto" and int(self.bodies) < 1:
            raise ValueError(f"--bodies must be a whole number from 1, or auto, got {self.bodies}")
        if self.threshold != "auto" and not 0 < float(self.threshold) < float("inf"):
            raise ValueError(f"--threshold must be a positive distance in pixels or auto, got {self.threshold}")
        if self.size is not None and not all(0 < side < float("inf") for side in self.size):
            raise ValueError(f"--size must be width and height in pixels, such as 640 480, got {self.size[0]:g} {self.size[1]:g}")
        if self.images is not None and not self.images:
            raise ValueError("--images: its value is missing; give both images of matches, or the video or pictures of tracks")
        if self.size is not None and self.images is not None:
            raise ValueError("--size and --images both say how large the images are; leave one out")
        if self.seed < 0:
            raise ValueError(f"--seed must be a whole number from 0, got {self.seed}")

    def _check_kind(self, scene: bool, whole: bool, asked: Asked) -> None:
        """Raise on flags that do not fit what is given."""
        if not self.files:
            raise ValueError("no input; give a video, a file of tracks, or a file of matches with x1, x2")
        if self.pair is not None and self.key is not None:
            raise ValueError("--pair is of files of matches and --key of files of tracks; leave one out")
        if not scene and len(self.files) > 1:
            raise ValueError(f"{len(self.files)} files; give one file of tracks or of matches, or pictures alone")
        if not scene and not whole and self.frames is not None:
            raise ValueError(f"--frames {self.frames}: {LEFT_OUT}, or for a file of tracks; leave it out")
        asked.check(scene)
        for flag in ("pair", "images", "size", "key"):
            if scene and getattr(self, flag) is not None:
                of = "files of tracks" if flag == "key" else "files of matches" if flag == "pair" else "files of matches or tracks"
                raise ValueError(f"--{flag} is of {of}, and a video or pictures are given; leave it out")
        if whole and self.threshold == "auto":
            said = "--threshold auto is of two images, and more frames are given; their noise is found from the tracks"
            raise ValueError(f"{said}, give the usual distance in pixels, such as --threshold 2.5")
        if whole and not self.spatial:
            raise ValueError("--no-spatial is of two images, and more frames are given; leave it out")

    def _notes(self, pair: MatchedPair, shown: list[Photograph]) -> list[str]:
        """What to say about the input."""
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
        notes += unit_notes(pair.path, reach, None if self.threshold == "auto" else float(self.threshold))
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
        """The segmentation, by the library."""
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
