"""Flags that several commands share: how files are read, what of videos is looked at, whose labels count."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from indexing.registry import format_names

if TYPE_CHECKING:
    Format = str
    WrittenFormat = str
else:
    Format = Literal[format_names("readers")]
    WrittenFormat = Literal["npz", *format_names("writers")]
People = Literal["largest", "confident", "tracked", "all", "everyone"]
Named = Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="")]
FOLDER = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DIR", help_behavior_hint="")]
REPORT = Annotated[Path | None, tyro.conf.arg(metavar="FOLDER", help_behavior_hint="")]
WORKERS = Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")]
DASK = Annotated[str | None, tyro.conf.arg(metavar="ADDRESS", help_behavior_hint="")]


@dataclass(frozen=True)
class Pixels:
    """How videos are compared where no keypoints are given."""

    region: Annotated[str, tyro.conf.arg(metavar="REGION")] = "motion"
    """of videos: motion (the box about what moves), all (the whole image), or x0,y0,x1,y1 in pixels"""


@dataclass(frozen=True)
class Watching:
    """What of videos is looked at."""

    by: Literal["auto", "keypoints", "pixels"] = "auto"
    """of videos: the keypoints of the people in them, or the pixels alone; auto: keypoints where a pose model is there"""
    pose_model: Literal["auto", "heavy", "full", "lite"] = "auto"
    """of videos: which network finds the keypoints; auto: the sharpest that is there"""
    people: Annotated[int, tyro.conf.arg(metavar="N")] = 4
    """of videos: how many people are looked for at most"""
    every: Annotated[int, tyro.conf.arg(metavar="N")] = 1
    """of videos: look for keypoints in one frame of so many"""
    poses: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER", help_behavior_hint="")] = None
    """where the keypoints of videos are kept; by default in the folder pose beside the output"""


@dataclass(frozen=True)
class Watched:
    """The keypoint file of each video, or why it has none: it shows nobody."""

    files: Mapping[Path, Path | ValueError]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Reading:
    """How keypoint files are read."""

    fps: Annotated[float | None, tyro.conf.arg(metavar="N", help_behavior_hint="")] = None
    """frames per second, for files that do not say (30 is assumed then, and the output says so)"""
    person: People = "largest"
    """who is followed where a frame shows several people"""
    min_confidence: Annotated[float, tyro.conf.arg(metavar="C")] = 0.0
    """joints that the detector trusts less are taken as not seen"""
    format: Annotated[Format | None, tyro.conf.arg(help_behavior_hint="")] = None
    """of the keypoint files; by default their content decides"""
    size: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="W H", help_behavior_hint="")] = None
    """width and height of the image in pixels, for files with coordinates from 0 to 1"""
    layout: Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="")] = None
    """which joint is which, such as BODY_25B; by default as the file says, or as the body looks"""
    footage: Watching = field(default_factory=Watching)
    watched: Annotated[Watched, tyro.conf.Suppress] = field(default_factory=lambda: Watched({}))


@dataclass(frozen=True)
class Following(Reading):
    """How recordings are read that may show several people."""

    person: People = "everyone"
    """who is scanned where several people are in view: everyone by itself, or the one who is followed"""


@dataclass(frozen=True)
class Labelling:
    """What a person has marked in the recordings, and which of it counts."""

    labels: Annotated[tyro.conf.UseAppendAction[tuple[Path, ...]], tyro.conf.arg(metavar="FILE")] = ()
    """what a person marked in the recordings: a file of BORIS, ELAN, Label Studio, VIA or ActivityNet, or a table with the columns
    label,start,end (repeat the option for further files)"""
    observation: Named = None
    """of the labels, only this observation (BORIS)"""
    tier: Named = None
    """of the labels, only this tier (ELAN) or row"""
    subject: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="NAME")] = ()
    """of the labels, only those of this subject; NAME=PERSON says which person of the recording it is, e.g. Ann=2"""
    media: Named = None
    """what the recording is called in the file of labels, where it has another name there"""

    @property
    def people(self) -> dict[str, str]:
        """Subject -> which person of the recording it is; empty text where that was not said."""
        said = [text.partition("=") for text in self.subject]
        return {subject.strip(): person.strip() for subject, _, person in said}


@dataclass(frozen=True)
class Example:
    """One word of ``dyntorch index fit``: a file, its label unless it is a labelled clip set, and the seconds that count."""

    path: Path
    label: str | None = None
    start: float | None = None
    end: float | None = None
