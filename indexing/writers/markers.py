"""A recording as programs of motion capture have it: named points in 3D over the same frames, of one person or of several."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dyntorch.numerics import Message
from indexing.opening import clip_text, error, first_duplicate

if TYPE_CHECKING:
    from indexing.clip import Clip

FloatArray = NDArray[np.floating]
UNIT = re.compile(r"[^\W\d_]{1,12}")  # a word, as the headers of files have a place for
ONE = "give the clips of one recording, or a folder for a file of each"


MAX_METRES = 10.0  # a body that extends over less is in metres, where nobody says
MAX_CENTIMETRES = 500.0  # one over less than this, and no less than that, in centimetres; else in millimetres
MAX_UNEVENNESS = 0.01
"""Of the step between frames, by which times are off an even grid at most, in a format with a rate and no times."""


@dataclass(frozen=True)
class Writer:
    """A format that is written, declared as ``FORMAT`` in the file of ``indexing/writers/formats`` that has its suffix as name."""

    programs: tuple[str, ...]
    """That read it."""
    encode: Callable[[Sequence[Clip], Path, str | None], tuple[bytes, list[str]]]
    """From the clips of a recording, the path, and the units or None: what the file holds, and what the format has no place for."""
    has_units: bool = False
    """Whether a file says what its coordinates are in."""
    order: int = 50


@dataclass(frozen=True, eq=False)
class Markers:
    """Points over time."""

    names: tuple[str, ...]  # of the points, each once; of several people ``person:joint``
    times: FloatArray  # ``(frames,)`` seconds
    places: FloatArray  # ``(frames, points, 3)``, NaN = not seen
    rate: float  # frames per second; of uneven times, the usual
    numbered: float  # frames per second by which frames are numbered, where some are left out
    units: str  # of the places; up: as of a clip
    up: str
    notes: tuple[str, ...] = field(default=())  # what a reader should know, a sentence each


def markers_of(clips: Sequence[Clip], path: Path, units: str | None = None) -> Markers:
    """The people of one recording as points; 2D at z = 0."""
    clips = list(clips)
    people = people_of(clips, path)
    first = clips[0]
    names: list[str] = []
    for clip, who in zip(clips, people, strict=True):
        names += [f"{who}:{joint}" if who else joint for joint in joint_names(clip)]
    twice = first_duplicate(names)
    if twice is not None:
        raise error(path, f"there are two points {twice!r}", "give every joint a name of its own (Clip.skeleton)")
    times, places = align_clips(clips)
    notes = []
    if first.dims == 2:
        places = np.concatenate([places, np.where(np.isnan(places[..., :1]), np.nan, 0.0).astype(places.dtype)], axis=2)
        notes.append("the clip is 2D: written with z = 0")
    if len(clips) > 1:
        notes.append(f"{len(clips)} people, their points named {names[0]} and so on; other programs read them as one set")
    if first.up != "y":
        notes.append(f"up is {first.up}, and coordinates are written as they are; programs may take y for up")
    if any(clip.confidence is not None for clip in clips):
        notes.append("confidences are left out, which the format has no place for")
    if any(clip.fps_assumed for clip in clips):
        notes.append(f"{float(first.fps or 30.0):g} frames per second are assumed, as nobody said how many")
    unit, guessed = _units(clips, units)
    if guessed:
        notes.append(Message("the units are not known: by the size of the body, {units}; {arg:units} says otherwise", units=unit))
    stated_fps = float(first.fps or 30.0)
    return Markers(tuple(names), times, places, _rate(times, stated_fps), stated_fps, unit, first.up, tuple(notes))


def _rate(times: FloatArray, stated: float) -> float:
    """Frames per second: as they are told, where the times agree."""
    usual = 1 / float(np.median(np.diff(times))) if len(times) > 1 else stated
    return stated if abs(usual / stated - 1) < MAX_UNEVENNESS else usual


def people_of(clips: Sequence[Clip], path: Path) -> list[str]:
    """What each clip's person is called; empty where there is one alone."""
    if not clips:
        raise error(path, "there are no clips to write", "give at least one")
    if len(clips) == 1:
        return [""]
    lacking = [clip for clip in clips if clip.meta.get("person") is None]
    if lacking:
        what = f"{len(clips)} clips ({clip_text(lacking[0].name, 40)}, ...) are not the people of one recording (meta 'person')"
        raise error(path, what, ONE)
    people = [str(clip.meta["person"]) for clip in clips]
    twice = first_duplicate(people)
    if twice is not None:
        raise error(path, f"two clips are of person {twice}, so they are of several recordings", ONE)
    if len({(clip.dims, clip.up) for clip in clips}) > 1:
        raise error(path, "the clips differ in dimensions, or in which way is up", "write a file of each")
    return people


def joint_names(clip: Clip) -> list[str]:
    """The joints by name; those without are numbered, and what is no text in UTF-8 is written as ``\\udcXX``."""
    if clip.skeleton is None:
        return [f"joint{i}" for i in range(clip.joints.shape[1])]
    plain = [" ".join(joint.encode("utf-8", "backslashreplace").decode().split()) for joint in clip.skeleton.joints]
    return [joint or f"joint{i}" for i, joint in enumerate(plain)]


def align_clips(clips: Sequence[Clip]) -> tuple[FloatArray, FloatArray]:
    """All frames of the clips, and ``(frames, joints of all, d)``; NaN where a person has no such frame."""
    times = np.unique(np.concatenate([clip.times for clip in clips]))
    dtype = np.result_type(*(clip.joints.dtype for clip in clips))
    parts = []
    for clip in clips:
        part = np.full((len(times), *clip.joints.shape[1:]), np.nan, dtype)
        part[np.searchsorted(times, clip.times)] = clip.joints
        parts.append(part)
    return times, np.concatenate(parts, axis=1)


def _units(clips: Sequence[Clip], asked: str | None) -> tuple[str, bool]:
    """What coordinates are in, and whether that is a guess."""
    stated = clips[0].meta.get("units") if asked is None else asked
    if isinstance(stated, str) and UNIT.fullmatch(stated):
        return stated, False
    if clips[0].dims == 2:
        return "px", False
    sizes = []
    for clip in clips:
        joints = clip.joints[clip.seen.any(axis=1)]
        low, high = (edge(np.where(np.isnan(joints), fill, joints), axis=1) for edge, fill in ((np.min, np.inf), (np.max, -np.inf)))
        sizes += [float(np.median((high - low).max(axis=1)))] if len(joints) else []
    size = max(sizes, default=1.0)
    return "m" if size < MAX_METRES else "cm" if size < MAX_CENTIMETRES else "mm", True
