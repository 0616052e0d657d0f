"""The player of a recording: everybody in view as stick figures, the events as a strip, and beside each the example it resembles.

What it shows is packed into the page as text: poses some times a second on a grid, as differences from one to the next, and the
script beside this file (``player.js``) unpacks, fills in and draws them.  Nothing else is needed, on a server or without one.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from indexing.cameras import y_up
from indexing.clip import Clip
from indexing.report.canvas import FACE, side_of, words_of
from indexing.report.page import clean
from indexing.report.pictures import colours
from indexing.report.results import RecognitionReport, RecordingResult, ReportedEvent
from indexing.skeleton import usual_layout

Array = NDArray[Any]
PIECE = 6000  # frames that are searched at once for joints in wrong places: bounds memory
FOUND, KNOWN, HELD = range(3)  # kinds of bars of the strip

TYPICAL_SECONDS = 600.0  # of one person, or of all together, that the coordinates of a page are for
MAX_VALUES = 1_000_000  # coordinates of a page, whatever the length
TYPICAL_VALUES = 300_000  # of all players of a page of a typical length: about a byte each, 0.4 MB of text
FURTHER_VALUES = 100.0  # for each second beyond; as many as fit three poses a second of 17 joints
EVENT_MARGIN_SECONDS = 0.5  # before and after an event that count as at it
MAX_GAP_SECONDS = 0.5  # without a pose, more than lie between two on purpose, in which nobody is drawn
GRID_STEPS = 240.0  # in a person's height: a joint is shown within a fifth of a percent of it
MAX_EXAMPLES = 120  # of a page
MAX_EXAMPLE_POSES = 40
POSE_RATES = ((15.0, 15.0), (12.5, 12.5), (10.0, 10.0), (10.0, 5.0), (8.0, 3.0), (8.0, 1.0), (6.0, 0.5), (4.0, 0.2), (3.0, 0.1))
"""Poses per second at events and between them: the first that fit are used, and of the last as many as do."""
MAX_BARS = 3000  # of the strip of a recording
WIDE_SCENE = 4.0  # times a person's height, and twice what people need at one time: where it is wider, the picture follows them


@dataclass(frozen=True)
class Player:
    """What one recording's player shows."""

    data: str
    rates: tuple[float, float]
    unlisted: int


@dataclass(frozen=True)
class _Part:
    """The frames of one person that may be shown: their times, and whether something happens there."""

    recording: RecordingResult
    clip: Clip
    busy: Array

    @classmethod
    def of(cls, recording: RecordingResult, clip: Clip, spans: Sequence[tuple[float, float]], margin: float) -> _Part:
        first = np.searchsorted(clip.times, [start - margin for start, _ in spans])
        last = np.searchsorted(clip.times, [end + margin for _, end in spans], side="right")
        steps = np.zeros(len(clip) + 1, dtype=int)
        np.add.at(steps, first, 1)
        np.add.at(steps, last, -1)
        return cls(recording, clip, np.cumsum(steps[:-1]) > 0)

    def select_frames(self, rates: tuple[float, float]) -> Array:
        """The frames that are shown at these rates; the first and the last are."""
        rate = np.where(self.busy, *rates)
        steps = np.minimum(np.diff(self.clip.times) * rate[1:], 1.0)
        turns = np.floor(np.concatenate([[0.0], np.cumsum(steps)]) + 1e-6)
        kept = np.diff(turns, prepend=-1.0) > 0
        kept[-1] = True
        return np.flatnonzero(kept)

    @cached_property
    def joints(self) -> Array:
        """``(frames, joints, 2)`` as seen from the front, y up, in the clip's unit; NaN where a detector erred."""
        from indexing.windows import wrong_joints

        found = np.array(y_up(self.clip)[..., :2], dtype=np.float64)
        for at in range(0, len(found), PIECE):
            part = slice(at, at + PIECE)
            few = len(found[part])
            found[part][wrong_joints(self.clip.joints[part], self.clip.times[part], np.array([0, few]))] = np.nan
        found[np.isnan(found).any(axis=2)] = np.nan
        return found


def players(groups: Sequence[Sequence[RecordingResult]], report: RecognitionReport) -> list[Player | None]:
    """A player for each recording, person by person; ``None`` where there are no joints to show."""
    parts = [_parts(people) for people in groups]
    rates, share = _rates([part for several in parts for part in several])
    examples = _Examples(report)
    return [_player(several, rates, share, examples) if several else None for several in parts]


def _parts(people: Sequence[RecordingResult]) -> list[_Part]:
    spans = [(event.start, event.end) for one in people for event in one.events]
    spans += [(start, end) for one in people for _, start, end in one.truth or ()]
    shown = [(one, one.clip) for one in people if one.clip is not None and one.clip.seen.any()]
    return [_Part.of(one, clip, spans, EVENT_MARGIN_SECONDS) for one, clip in shown]


def _rates(parts: Sequence[_Part]) -> tuple[tuple[float, float], float]:
    """Poses per second that fit into a page, and the share of them that does where even the fewest are too many."""
    lasts = sum(float(np.minimum(np.diff(part.clip.times), 1.0).sum()) for part in parts)
    room = min(MAX_VALUES, TYPICAL_VALUES + FURTHER_VALUES * max(0.0, lasts - TYPICAL_SECONDS))
    for rates in POSE_RATES:
        needed = sum(2 * part.clip.joints.shape[1] * len(part.select_frames(rates)) for part in parts)
        if needed <= room:
            return rates, 1.0
    return POSE_RATES[-1], room / needed


def _player(parts: Sequence[_Part], rates: tuple[float, float], share: float, examples: _Examples) -> Player:
    kept = [part.select_frames(rates) for part in parts]
    if share < 1:
        kept = [frames[np.unique(np.linspace(0, len(frames) - 1, max(2, int(share * len(frames)))).astype(int))] for frames in kept]
    rates = (rates[0] * share, rates[1] * share)
    joints = [part.joints[frames] for part, frames in zip(parts, kept, strict=True)]
    unit = max(float(np.nanmedian([_height(one) for one in joints])), 1e-9) / GRID_STEPS
    view, middle = _view(joints, [part.clip.times[one] for part, one in zip(parts, kept, strict=True)], unit)
    people = []
    for part, frames, places in zip(parts, kept, joints, strict=True):
        times = np.round(1000 * part.clip.times[frames]).astype(np.int64)
        people.append({
            "name": str(clean(part.recording.person)),
            "first": int(times[0]), "times": _text(_varints(np.diff(times))),
            "joints": _text(pack_joints(places, unit, middle)), "skeleton": _skeleton(part.clip),
        })  # fmt: skip
    names = [name for part in parts for name in [*part.recording.classes, *(event.label for event, _ in _bars(part.recording))]]
    paint = colours(names)
    order = list(paint)
    bars = sorted(
        [
            (number, kind, order.index(str(event.label)), *_milliseconds(event), examples.number(event, kind))
            for number, part in enumerate(parts)
            for event, kind in _bars(part.recording)
        ],
        key=lambda bar: (bar[1], bar[3]),
    )
    usual = float(np.median([float(np.median(np.diff(part.clip.times))) for part in parts if len(part.clip) > 1] or [0.0]))
    data = {
        "people": people, "view": view, "actions": [[str(clean(name)), colour] for name, colour in paint.items()],
        "bars": bars[: MAX_BARS], "absent": 1000 * (MAX_GAP_SECONDS + max(1.5 / rates[1], 3 * usual)),
        "examples": {number: examples.drawn[number] for number in {bar[5] for bar in bars} if number >= 0},
    }  # fmt: skip
    unlisted = sum(bar[1] == FOUND for bar in bars[MAX_BARS:])
    return Player(json.dumps(data, ensure_ascii=False, separators=(",", ":")), rates, unlisted)


def _milliseconds(event: ReportedEvent) -> tuple[int, int]:
    return round(1000 * float(event.start)), round(1000 * float(event.end))


@dataclass(frozen=True)
class _Known:
    """A known action, as a bar of the strip."""

    label: Any
    start: float
    end: float


def _bars(recording: RecordingResult) -> list[tuple[Any, int]]:
    """What the strip shows of one person, with its kind."""
    return [
        *((event, FOUND) for event in recording.events),
        *((_Known(*known), KNOWN) for known in recording.truth or ()),
        *((one.event, HELD) for one in recording.withheld),
    ]


class _Examples:
    """The examples that events are shown beside, each packed once."""

    def __init__(self, report: RecognitionReport) -> None:
        self.report = report
        self.drawn: list[dict[str, Any]] = []
        self.numbers: dict[int, int] = {}

    def number(self, event: Any, kind: int) -> int:
        """Which one an event is shown beside; -1 = none."""
        clip = None if kind == KNOWN else self.report.exemplar(event)
        if clip is None or not clip.seen.any():
            return -1
        if id(clip) not in self.numbers and len(self.drawn) < MAX_EXAMPLES:
            self.numbers[id(clip)] = len(self.drawn)
            self.drawn.append(self._pack(clip))
        return self.numbers.get(id(clip), -1)

    def _pack(self, clip: Clip) -> dict[str, Any]:
        frames = np.unique(np.linspace(0, len(clip) - 1, min(len(clip), MAX_EXAMPLE_POSES)).round().astype(int))
        part = _Part(RecordingResult("", clip, clip.times, (), np.zeros((len(clip), 0))), clip, np.zeros(len(clip), bool))
        joints = part.joints[frames]
        unit = max(_height(joints), 1e-9) / GRID_STEPS
        view, middle = _view([joints], [clip.times[frames]], unit)
        lasts = 1000 * clip.duration * len(clip) / max(1, len(clip) - 1)
        return {
            "joints": _text(pack_joints(joints, unit, middle)), "skeleton": _skeleton(clip), "view": view,
            "lasts": 0 if clip.fps_assumed else round(lasts),
        }  # fmt: skip


# ---- packing -------------------------------------------------------------------------------------------------------------
def pack_joints(joints: Array, unit: float, middle: Array) -> bytes:
    """Places on a grid as bytes, frame by frame. joints ``(frames, joints, 2)``."""
    with np.errstate(invalid="ignore"):
        places = np.clip(np.round((joints - middle) / unit), -32000, 32000).reshape(len(joints), -1)
    seen = np.isfinite(places)
    rows = np.where(seen, np.arange(len(places))[:, None], -1)
    before = np.concatenate([np.full((1, places.shape[1]), -1), np.maximum.accumulate(rows, axis=0)[:-1]])
    last = np.where(before >= 0, np.take_along_axis(places, np.maximum(before, 0), axis=0), 0.0)
    steps = np.where(seen, places - last, 0.0).astype(np.int64)
    return _varints(np.where(seen, np.where(steps >= 0, 1 + 2 * steps, -2 * steps), 0).ravel())


def _varints(values: Array) -> bytes:
    """Whole numbers from 0 on, seven bits a byte, the lowest first; the eighth bit says that more follow."""
    values = np.asarray(values, dtype=np.int64)
    lengths = np.ones(len(values), dtype=int)
    for bits in range(7, 63, 7):
        lengths += values >> bits > 0
    out = np.zeros(int(lengths.sum()), dtype=np.uint8)
    place = np.cumsum(lengths) - lengths
    for k in range(int(lengths.max(initial=0))):
        some = lengths > k
        out[place[some] + k] = (values[some] >> (7 * k) & 127) | np.where(lengths[some] > k + 1, 128, 0)
    return out.tobytes()


def _text(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")


def _skeleton(clip: Clip) -> dict[str, Any]:
    """Bones as ``[joint, joint, side]``, and the joints of the face, which are drawn as a circle; without bones, dots."""
    skeleton = clip.skeleton or usual_layout(clip.joints.shape[1])
    if skeleton is None or not skeleton.bones:
        return {"joints": clip.joints.shape[1], "bones": [], "face": []}
    sides = [side_of(name) for name in skeleton.joints]
    face = [i for i, name in enumerate(skeleton.joints) if words_of(name) & FACE]
    bones = []
    for a, b in skeleton.bones:
        both = {sides[a], sides[b]} - {"m"}
        if not {a, b} <= set(face):
            bones.append([a, b, both.pop() if len(both) == 1 else "m"])
    return {"joints": clip.joints.shape[1], "bones": bones, "face": face}


# ---- what the picture shows ----------------------------------------------------------------------------------------------
def _height(joints: Array) -> float:
    """How tall a person is in the picture, or how wide where it lies: the median over the frames."""
    seen = joints[np.isfinite(joints).any(axis=(1, 2))]
    if not len(seen):
        return 1.0
    size = np.nanmax(seen, axis=1) - np.nanmin(seen, axis=1)
    return float(np.median(size.max(axis=1)))


def _view(joints: Sequence[Array], times: Sequence[Array], unit: float) -> tuple[list[float], Array]:
    """Width and height of the picture in steps of the grid, whether it follows people (1) or stands (0); and its middle."""
    every = np.concatenate([one.reshape(-1, 2) for one in joints])
    every = every[np.isfinite(every).all(axis=1)]
    inner = np.percentile(every, [1, 99], axis=0)
    room = 0.5 * unit * GRID_STEPS  # beyond which a joint is a mistake of the detector
    low, high = np.maximum(every.min(axis=0), inner[0] - room), np.minimum(every.max(axis=0), inner[1] + room)
    size, middle = (high - low) / unit, (low + high) / 2
    at_once = _at_once(np.concatenate(joints), np.concatenate(times)) / unit
    follows = bool(size[0] > WIDE_SCENE * GRID_STEPS and size[0] > 2 * at_once[0])
    shown = np.maximum(np.where([follows, False], np.minimum(at_once, size), size), 0.3 * GRID_STEPS)
    return [*(round(float(x), 1) for x in shown), int(follows)], middle


def _at_once(joints: Array, times: Array) -> Array:
    """``(2,)`` what everybody takes up within half a second, in all but one of twenty."""
    there = np.isfinite(joints).any(axis=(1, 2))
    joints, bins = joints[there], np.round(2 * times[there])
    order = np.argsort(bins, kind="stable")
    first = np.flatnonzero(np.diff(bins[order], prepend=np.nan) != 0)
    low = np.minimum.reduceat(np.nanmin(joints, axis=1)[order], first)
    high = np.maximum.reduceat(np.nanmax(joints, axis=1)[order], first)
    return np.asarray(np.percentile(high - low, 95, axis=0))
