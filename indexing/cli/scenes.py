"""Videos and pictures as inputs of align, reconstruct and segment, and the cameras that ``--calibration`` gives."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dyntorch.geometry import undistort
from indexing.readers.files import VIDEOS
from indexing.readers.matches import Matched, MatchedPair, Photograph
from indexing.readers.tracks import TrackSet
from indexing.report.page import table_csv
from indexing.sync.calibration import read_calibration
from indexing.video.scene import RECONSTRUCTION_FRAMES, SceneTrackOptions, SceneTracks, track_scene, track_whole
from indexing.video.sequence import PictureSequence, in_order, is_pattern, pictures_of

PICTURE_FILES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
LEFT_OUT = "it is for a video or a sequence of pictures"


def is_scene(paths: Sequence[Path]) -> bool:
    """Whether the inputs are pixels: a video, a folder, a pattern, or nothing but pictures."""
    kinds = [_kind(path) for path in paths]
    if not any(kinds):
        return False
    if set(kinds) != {"picture"} and len(paths) > 1:
        odd = next(path for path, kind in zip(paths, kinds, strict=True) if kind != "")
        what = "is a folder" if odd.is_dir() else "is a video" if _kind(odd) == "video" else "is a picture"
        raise ValueError(
            f"{odd}: {what}, and {len(paths)} inputs are given; give one video, one folder of pictures, or pictures alone"
        )
    return True


def is_video(path: Path) -> bool:
    """Whether a file's name says that it is a video."""
    return path.suffix.lower() in VIDEOS


def _kind(path: Path) -> str:
    if path.is_dir() or (any(sign in str(path) for sign in "*?[") and not path.exists()):
        return "sequence"
    return "video" if is_video(path) else "picture" if path.suffix.lower() in PICTURE_FILES else ""


@dataclass(frozen=True)
class Asked:
    """Which frames the flags ask for."""

    frames: str | None = None
    at: str | None = None
    every: int | None = None

    def check(self, scene: bool) -> None:
        """Raise on flags that contradict each other, or that belong to videos where none is given."""
        given = [name for name in ("frames", "at", "every") if getattr(self, name) is not None]
        wrong = [name for name in given if name != "frames"]
        if wrong and not scene:
            raise ValueError(f"--{wrong[0]} {getattr(self, wrong[0])}: {LEFT_OUT}; leave it out")
        if scene and len(given) > 1:
            raise ValueError(f"--{given[0]} and --{given[1]} both say which frames to take; leave one out")
        if self.every is not None and self.every < 1:
            raise ValueError(f"--every must be a whole number from 1, got {self.every}")

    def span(self) -> tuple[int, int] | None:
        """The first and the last frame, where ``--frames`` is ``FIRST-LAST``."""
        found = re.fullmatch(r"\s*(\d+)\s*-\s*(\d+)\s*", self.frames or "")
        if found is None:
            return None
        first, last = int(found[1]), int(found[2])
        if last <= first:
            raise ValueError(f"--frames {self.frames}: the last frame must come after the first, such as --frames 0-99")
        return first, last

    def numbers(self) -> list[int] | None:
        """Those of ``--frames``."""
        return None if self.frames is None else [int(value) for value in _increasing("frames", self.frames, int, "0,20,40")]

    def moments(self) -> list[float] | None:
        """Those of ``--at``, in seconds."""
        return None if self.at is None else [float(value) for value in _increasing("at", self.at, float, "0,0.8,1.6")]


def _increasing(flag: str, text: str, kind: Any, example: str) -> list[Any]:
    try:
        found = [kind(word) for word in text.split(",")]
    except ValueError:
        raise ValueError(f"--{flag} {text!r}: expected numbers with commas between them, such as --{flag} {example}") from None
    if found != sorted(set(found)) or not all(0 <= value < float("inf") for value in found):
        raise ValueError(f"--{flag} {text!r}: numbers are from 0 and increase, such as --{flag} {example}")
    return found


def follow(
    paths: Sequence[Path],
    asked: Asked,
    *,
    views: int | None = None,
    more: bool = False,
    missing: bool = False,
    fps: float | None = None,
) -> SceneTracks:
    """Points of a video or of pictures, in the frames asked for."""
    numbers, moments = asked.numbers(), asked.moments()
    for flag, given in (("frames", numbers), ("at", moments)):
        least, exactly = views or 2, views is not None and not more
        if given is not None and (len(given) < least or (exactly and len(given) > least)):
            needed = f"{'' if exactly else 'at least '}{least} are needed"
            raise ValueError(f"--{flag} {getattr(asked, flag)}: {len(given)} given, {needed}")
    source = source_of(paths)
    if fps is None:
        _check_moments(paths, source, asked)
    few = None if numbers or moments or asked.every else views or RECONSTRUCTION_FRAMES
    return track_scene(source, frames=numbers, at=moments, every=asked.every, views=few, missing=missing, fps=fps)


def follow_whole(paths: Sequence[Path], asked: Asked) -> SceneTracks:
    """Points of a whole video or of all pictures, from where they appear to where they are lost."""
    span = asked.span()
    numbers, moments = _frame_range(*span) if span else asked.numbers(), asked.moments()
    for flag, given in (("frames", numbers), ("at", moments)):
        if given is not None and len(given) < 2:
            raise ValueError(f"--{flag} {getattr(asked, flag)}: {len(given)} given, at least 2 are needed")
    source = source_of(paths)
    _check_moments(paths, source, asked)
    return track_whole(source, frames=numbers, at=moments, every=asked.every)


def _frame_range(first: int, last: int) -> list[int]:
    """Frames from the first to the last, of many every so many, as of a whole video."""
    return list(range(first, last + 1, -(-(last + 1 - first) // SceneTrackOptions().max_frames)))


def source_of(paths: Sequence[Path]) -> Any:
    """A video, a folder or a pattern; or pictures in the order of their numbers."""
    files = [path.expanduser() for path in paths]
    return files[0] if len(files) == 1 else in_order(files)


def _check_moments(paths: Sequence[Path], source: Any, asked: Asked) -> None:
    """Raise where moments of pictures are asked for."""
    if asked.at is not None and _kind(paths[0].expanduser()) != "video":
        frames = len(PictureSequence(source))
        raise ValueError(f"--at {asked.at}: pictures have no times; give their numbers, --frames with some of 0 to {frames - 1}")


def inputs_of(paths: Sequence[Path]) -> list[Path]:
    """The files that are read, for the manifest."""
    files = []
    for path in (path.expanduser() for path in paths):
        files += pictures_of(path) if path.is_dir() or is_pattern(path) else [path]
    return files


def photographs(tracks: SceneTracks) -> list[Photograph]:
    """The frames taken, to draw on, or those of them that were kept."""
    size = (float(tracks.size[0]), float(tracks.size[1]))
    kept = tracks.frames if tracks.pictured is None else [tracks.frames[i] for i in tracks.pictured]
    gray = [np.divide(image, 255, dtype=np.float32) for image in tracks.pictures]
    return [Photograph(f"frame {k}", image, size) for k, image in zip(kept, gray, strict=True)]


def names_of(tracks: SceneTracks) -> tuple[str, ...]:
    """Names of the points: their numbers, from 1."""
    return tuple(str(i + 1) for i in range(tracks.points.shape[1]))


def as_matches(tracks: SceneTracks) -> Matched:
    """As files of points for each view would give them."""
    views = tuple(view.numpy() for view in tracks.points)
    return Matched(views, names_of(tracks), tuple(f"frame {k}" for k in tracks.frames), notes=tracks.notes)


def as_pair(tracks: SceneTracks, path: Path) -> MatchedPair:
    """As a file of matches would give them."""
    x1, x2 = (view.numpy() for view in tracks.points)
    size = (float(tracks.size[0]), float(tracks.size[1]))
    return MatchedPair(str(path), path.name, x1, x2, names_of(tracks), size=size)


def as_tracks(tracks: SceneTracks, path: Path, timed: bool) -> TrackSet:
    """As a table of tracks would give them."""
    times = tracks.times.numpy() if timed else None
    return TrackSet(str(path), tracks.points.numpy(), names_of(tracks), tuple(map(str, tracks.frames)), times, notes=tracks.notes)


def tracks_csv(tracks: SceneTracks) -> str:
    """``frame, time, id, x, y`` of every point in every frame that shows it: what ``dyntorch reconstruct`` reads, too."""
    rows: list[list[object]] = []
    for k, moment, view in zip(tracks.frames, tracks.times.tolist(), tracks.points.numpy(), strict=True):
        for i in np.flatnonzero(np.isfinite(view[:, 0])).tolist():
            rows.append([k, f"{moment:.6g}", i + 1, f"{view[i, 0]:.4f}", f"{view[i, 1]:.4f}"])
    return table_csv(["frame", "time", "id", "x", "y"], rows)


# ----------------------------------------------------------------------------------------------------------------------
# ``--calibration FX,FY,CX,CY|FILE.toml``.


def calibration_files(given: str | None) -> list[Path]:
    """The file that ``--calibration`` names, if it does."""
    return [] if given is None or _inner(given) is not None else [Path(given)]


def _inner(given: str) -> list[float] | None:
    """The four numbers of ``FX,FY,CX,CY``, or None for anything else."""
    try:
        numbers = [float(word) for word in given.split(",")]
    except ValueError:
        return None
    if len(numbers) != 4 or not all(math.isfinite(x) for x in numbers) or min(numbers[:2]) <= 0:
        raise ValueError(f"--calibration {given!r}: expected fx,fy,cx,cy in pixels, focal lengths positive, or a TOML file")
    return numbers


def undistort_views(given: str | None, tracks: Tensor) -> tuple[Tensor, Tensor | None]:
    """Tracks ``(views, n, 2)`` without lens distortion, and K of all views or of each; None without a calibration."""
    if given is None:
        return tracks, None
    if tracks.shape[-1] != 2:
        raise ValueError(f"--calibration is of cameras, and the tracks are of sensors that measure {tracks.shape[-1]} coordinates")
    numbers = _inner(given)
    if numbers is not None:
        fx, fy, cx, cy = numbers
        return tracks, torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], dtype=torch.float64)

    lenses = read_calibration(given)
    if len(lenses) not in (1, len(tracks)):
        raise ValueError(f"--calibration {given}: {len(lenses)} cameras for {len(tracks)} views; give one for all, or one for each")
    if any(lens.fisheye for lens in lenses):
        raise ValueError(f"--calibration {given}: a fisheye lens is not modelled; undistort the points first")
    every = lenses * (len(tracks) // len(lenses))
    K = torch.stack([lens.matrix for lens in every]).double()
    straight = [
        undistort(x, k, lens.distortions.double()) if len(lens.distortions) else x
        for x, k, lens in zip(tracks.double(), K, every, strict=True)
    ]
    return torch.stack(straight), K
