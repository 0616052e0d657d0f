"""A recording explained while it is being recorded: frames go in, events and scores of frames come out a fixed time later.

The same evidence and the same dynamic programming as for complete recordings (:mod:`indexing.recordings.decoding`).
Every window is looked at once, when its last frame is there.  What begins at a moment is decided when so much of what follows is
known that every segment that may lie there is among what was compared; nothing that was decided changes later.  What is kept
are the frames and the windows of that time, whatever the length of the stream.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray

from dyntorch.numerics import one_thread
from indexing.action.background import event_level
from indexing.action.exemplars import moment_window
from indexing.action.model import NUM_NEIGHBOURS, ShapeModel
from indexing.action.stream import INTERPOLATION_MARGIN, Stream, moments, presence, wrong_contrast
from indexing.cameras import y_up
from indexing.clip import Clip, is_number
from indexing.joints import match_all
from indexing.recordings.decoding import (
    EDGE_TOLERANCE,
    TEMPERATURE,
    Stretch,
    TiledSegment,
    best_tiling,
    events_of,
    log_scores,
    posterior,
    segment_values,
)
from indexing.recordings.evidence import DURATION_REACH, MAX_TEMPO_FACTOR, MIN_CYCLIC, Durations, Lattice
from indexing.scoring import Event, event_levels
from indexing.skeleton import Skeleton
from indexing.windows import Ragged, concatenate_clips, repair_clip

# of the usual duration of the longest action, looked at after a moment before it is decided; of half of it long actions are missed
BLOCK_SECONDS = 0.5  # of frames that a stream looks at together: a part of its lag, and the fewer the more it costs
MEMORY_SECONDS = 300.0  # of the past by which a stream scales its scores: less where cameras and people change
HORIZON = 1.25
NUM_RECENT_STEPS = 30  # between the latest frames, which may be too far apart for any window

Array = NDArray[Any]


@dataclass(frozen=True, eq=False)
class LiveAnswer:
    """What became known with the latest frames."""

    times: Array
    scores: Array
    events: Sequence[Event] = ()


@dataclass(frozen=True)
class LiveSource:
    """All that a stream needs of its indexer: the model, its labels, how moments are looked at, which joints frames have."""

    model: ShapeModel
    classes: tuple[Any, ...]
    look: Stream
    rate: float | None
    least: float
    repair: bool
    joints: int
    skeleton: Skeleton | None
    fps: float


@dataclass(frozen=True)
class _Cells:
    """What is known of a run of cells: of its moment, and of the windows of every length that end with it."""

    raw: Array
    motion: Array
    present: Array
    whole: Array

    def __len__(self) -> int:
        return len(self.raw)

    def concatenate(self, other: Self) -> Self:
        """These and then others."""
        return replace(self, **{f.name: np.concatenate([getattr(self, f.name), getattr(other, f.name)]) for f in fields(self)})

    def skip(self, count: int) -> Self:
        """All but the first ones."""
        return replace(self, **{f.name: getattr(self, f.name)[count:] for f in fields(self)})


@dataclass(frozen=True)
class _Tiled:
    """Cells explained: what windows are worth ``(W, classes)``, the segments by the edge where they begin, posterior of cells."""

    one: Stretch
    values: Array
    segments: dict[int, TiledSegment]
    likely: Array


@dataclass(frozen=True)
class _Running:
    """An event that may go on: its class (number), and seconds of the longest of its segments."""

    event: Event
    label: int
    longest: float

    @classmethod
    def after(cls, before: Self | None, part: TiledSegment, event: Event) -> Self:
        """A segment, and those before it that it goes on from."""
        seconds = event.end - event.start
        if before is None:
            return cls(event, part.label, seconds)
        past = before.event
        score = float(np.average([past.score, event.score], weights=[past.end - past.start, seconds]))
        longer = event if seconds > before.longest else past
        return cls(replace(longer, start=past.start, end=event.end, score=score), part.label, max(seconds, before.longest))


class RunningLevel:
    """Mean and standard deviation of values as they come in; the latest ``memory`` values count most."""

    def __init__(self, memory: float) -> None:
        self.memory, self.count, self.mean, self.square = memory, 0.0, 0.0, 0.0

    def push(self, values: Array) -> None:
        """Count further values."""
        there = values[np.isfinite(values)]
        if len(there):
            weight = min(self.count, max(self.memory - len(there), 0.0))
            share = len(there) / (weight + len(there))
            self.mean += share * (float(there.mean()) - self.mean)
            self.square += share * (float(np.square(there, dtype=np.float64).mean()) - self.square)
            self.count = weight + len(there)

    def level(self) -> tuple[float, float]:
        """Mean and standard deviation; 1 where nothing differs."""
        spread = float(np.sqrt(max(self.square - self.mean**2, 0.0)))
        return self.mean, spread if spread > 1e-9 else 1.0


class ActionStream:
    """Actions in one person's recording, as its frames come in. Made by :meth:`indexing.ActionIndexer.stream`."""

    def __init__(self, source: LiveSource, lag: float | None, up: str, skeleton: Skeleton | None) -> None:
        self.source, self.up, self.skeleton, self.classes = source, up, skeleton, source.classes
        self._asked = source.joints if skeleton is None else len(skeleton.joints)  # joints of a frame
        model, options = source.model, source.look.options
        self._look = replace(source.look, window=moment_window(source.look.window, model.exemplars.seconds))
        self._durations = Durations.of(model, self._look.window, 0.3 * self._look.window)
        self._step, self._lengths = _grid(self._durations, options.num_durations)
        self._ahead = max(1.0, *self._look.tempi) * self._look.window / 2  # seconds that a moment looks ahead
        self._horizon, self.lag = self._horizon_of(lag)
        self._place = _places(source, up, skeleton)
        self._floor = _floor(model, source.rate)
        cells = MEMORY_SECONDS / self._step
        self._contrast = RunningLevel(cells * model.classes)
        self._wholes = RunningLevel(cells * model.classes * len(self._lengths))
        self._count, self._last, self._steps = 0, -np.inf, np.empty(0)
        self._open(0.0)

    def _horizon_of(self, lag: Any) -> tuple[int, float]:
        """How many cells that follow a moment decide about it, and the seconds after which an event is told then."""
        typical = float(self._durations.typical.max())
        known, edge = BLOCK_SECONDS + self._ahead + self._step, 1e-9  # seconds after a cell at which it is known at the latest
        if lag is None:
            cells = int(np.ceil(HORIZON * typical / self._step - edge))
        elif is_number(lag) and lag >= known + typical - edge:
            cells = int((float(lag) - known) / self._step + edge)
        else:
            least = f"{known + typical:.2f} or more, as the longest of these actions takes {typical:.2f}"
            raise ValueError(f"lag must be seconds, {least}; got {lag!r}")
        return max(cells, 1), known + max(cells, 1) * self._step

    def _open(self, begin: float) -> None:
        """Begin another stretch: nothing reaches across a gap."""
        joints, lengths, classes = self.source.joints, len(self._lengths), self.source.model.classes
        self._begin = begin
        self._raw = self._good = np.empty((0, joints, 2), dtype=np.float32)  # as pushed, and without wrong joints
        self._at, self._told = np.empty(0), 0  # seconds since the begin; how many of these frames are decided
        self._first = self._blocks = 0  # cells that are decided and forgotten; blocks that were looked at
        self._cells = _Cells(np.zeros((0, classes)), np.zeros(0), np.zeros(0, dtype=bool), np.zeros((0, lengths, classes)))
        self._running: _Running | None = None  # decided, and perhaps going on

    @property
    def num_frames(self) -> int:
        """Frames that are kept now."""
        return len(self._at)

    @one_thread
    def push(self, joints: Any, times: Any = None) -> LiveAnswer:
        """One more frame, or several. joints ``(joints, 2 | 3)``."""
        frames, at, steps = self._check_frames(joints, times)
        fresh = steps > self._look.window
        parts = np.concatenate([[0], np.flatnonzero(fresh[1:]) + 1, [len(at)]])
        answers: list[LiveAnswer] = []
        for begin, end in zip(parts[:-1].tolist(), parts[1:].tolist(), strict=True):
            if fresh[begin]:
                answers += self._end()
                self._open(float(at[begin]))
            answers += self._append_frames(frames[begin:end], at[begin:end] - self._begin)
        return self._merge_answers(answers)

    @one_thread
    def finish(self) -> LiveAnswer:
        """All that is left, decided as if nothing followed.  Frames that are pushed later begin anew."""
        answer = self._merge_answers(self._end())
        self._count, self._last, self._steps = 0, -np.inf, np.empty(0)
        self._open(0.0)
        return answer

    @one_thread
    def latest(self) -> LiveAnswer:
        """The frames that are not decided yet, and the events among them, as it looks now: later frames may change both."""
        return self._answer_remaining()[0]

    # ---- frames ------------------------------------------------------------------------------------------------------
    def _check_frames(self, joints: Any, times: Any) -> tuple[Array, Array, Array]:
        """Frames ``(F, joints, 2)`` in the layout of the exemplars and y up, their times, and how long after the one before."""
        frames = np.asarray(joints)
        frames = frames[None] if frames.ndim == 2 else frames
        if times is None:
            times = (self._count + np.arange(len(frames))) / self.source.fps
        clip = Clip(frames, times=np.atleast_1d(np.asarray(times)), up=self.up, name="stream")
        if clip.joints.shape[1] != self._asked:
            whose = "the fitted clips have" if self.skeleton is None else "the skeleton of the stream has"
            raise ValueError(
                f"stream: joints: {clip.joints.shape[1]} joints, but {whose} {self._asked}; push frames of one joint layout"
            )
        if clip.times[0] <= self._last:
            raise ValueError(f"stream: times: {clip.times[0]:.6g} s comes after {self._last:.6g} s; times must increase")
        steps = np.diff(clip.times, prepend=self._last)
        many = NUM_RECENT_STEPS
        recent = np.append(self._steps, steps[np.isfinite(steps)])[-many:]
        if len(recent) == many and float(np.median(recent)) > self._look.window:
            raise ValueError(
                f"stream: times: frames are {float(np.median(recent)):.3g} s apart, and a window lasts {self._look.window:g} s; "
                "times are seconds: correct them, or fps"
            )
        self._steps, self._last, self._count = recent, float(clip.times[-1]), self._count + len(clip)
        upright = y_up(clip)[..., :2].astype(np.float32)
        return np.where((self._place < 0)[:, None], np.float32(np.nan), upright[:, self._place]), clip.times, steps

    def _append_frames(self, frames: Array, at: Array) -> list[LiveAnswer]:
        """Frames of the stretch that goes on: blocks end where the clock says, however many frames come at once."""
        self._raw, self._good = np.concatenate([self._raw, frames]), np.concatenate([self._good, frames])
        self._at = np.concatenate([self._at, at])
        answers: list[LiveAnswer] = []
        block = BLOCK_SECONDS
        while self._at[-1] >= (self._blocks + 1) * block:
            self._blocks += 1
            known = self._blocks * block
            frames_ = int(np.searchsorted(self._at, known)) + 1
            cells = int((known - self._ahead) / self._step + 1e-9) - self._first - len(self._cells)
            if cells > 0:
                self._describe(frames_, cells)
            undecided = len(self._cells) - self._horizon
            if undecided >= 0:
                answers += self._decide(frames_, undecided + 1)
        return answers

    def _end(self) -> list[LiveAnswer]:
        """The rest of a stretch, after which nothing follows."""
        if len(self._at) > 1:  # a single frame says nothing of an action
            cells = max(1, round(float(self._at[-1]) / self._step)) - self._first - len(self._cells)
            if cells > 0:
                self._describe(len(self._at), cells)
        return self._answer_remaining()

    # ---- what frames say ---------------------------------------------------------------------------------------------
    def _describe(self, frames: int, count: int) -> None:
        """Look at ``count`` more cells, of which the first ``frames`` frames show all."""
        model, first = self.source.model, self._first + len(self._cells)
        since = first * self._step - self._ahead
        begin = int(np.searchsorted(self._at, since - INTERPOLATION_MARGIN))
        near = Clip(self._raw[begin:frames], times=self._at[begin:frames])
        if self.source.repair:  # judged with the frames before and after them
            fresh = int(np.searchsorted(self._at, since))
            self._good[fresh:frames] = repair_clip(near).joints[fresh - begin :]
            near = near.replace(joints=self._good[begin:frames])
        middle = (first + np.arange(count) + 0.5) * self._step
        owner = np.zeros(count, dtype=np.intp)
        scores, motion = moments(model, concatenate_clips([near]), owner, middle, self._look)
        present = presence(near, np.array([[0, len(near)]]), middle, owner, self._look)
        contrast = np.where(present[:, None], scores - scores.mean(axis=1, keepdims=True), 0.0)
        cells = _Cells(contrast, motion, present, self._whole_scores(frames, first, count))
        self._contrast.push(contrast[present])
        self._wholes.push(cells.whole)
        self._cells = self._cells.concatenate(cells)

    def _whole_scores(self, frames: int, first: int, count: int) -> Array:
        """``(count, lengths, classes)`` ``whole_scores`` of the windows that end in each cell, from one comparison."""
        model = self.source.model
        last = first + 1 + np.arange(count)
        begin = last[:, None] - self._lengths
        row, which = np.nonzero(begin >= self._first)
        out = np.full((count, len(self._lengths), model.classes), np.nan, dtype=np.float32)
        if not len(row):
            return out
        lattice = Lattice(np.arange(last[-1] + 1) * self._step, np.stack([begin[row, which], last[row]], axis=1))
        windows = lattice.resample(self._source(frames), 0, np.arange(len(row)), self._look.length).to(self._look.device)
        every = torch.arange(len(model.labels), device=model.labels.device)
        residual, labels = model.whole_residuals(windows, every).cpu().numpy(), model.labels.cpu().numpy()
        tempo = np.abs(np.log(self._durations.seconds / (self._lengths[:, None] * self._step)))
        near = (tempo <= np.log(MAX_TEMPO_FACTOR))[which]
        for c in range(model.classes):
            mine = np.sort(np.where(near[:, labels == c], residual[:, labels == c], np.inf), axis=1)[:, :NUM_NEIGHBOURS]
            there = np.isfinite(mine)
            mean = np.where(there, mine, 0.0).sum(axis=1) / np.maximum(there.sum(axis=1), 1)
            out[row, which, c] = np.where(there.any(axis=1), -mean, np.nan)
        return out

    def _source(self, frames: int) -> Ragged:
        return concatenate_clips([Clip(self._good[:frames], times=self._at[:frames])])

    # ---- what is decided ---------------------------------------------------------------------------------------------
    def _decode(self, frames: int) -> _Tiled:
        """The best explanation of all that is known and not decided."""
        model, cells = self.source.model, self._cells
        count = len(cells)
        begin = np.arange(1, count + 1)[:, None] - self._lengths
        row, which = np.nonzero(begin >= 0)
        edges = (self._first + np.arange(count + 1)) * self._step
        lattice = Lattice(edges, np.stack([begin[row, which], row + 1], axis=1))
        spread = self._contrast.level()[1]
        whole = cells.whole[row, which]
        one = Stretch(self._source(frames), lattice, cells.raw, cells.raw / spread, cells.motion, cells.present, whole, (0, frames))
        if not len(row):
            return _Tiled(one, np.zeros((0, model.classes)), {}, np.zeros((count, model.classes)))
        values, calm, _ = segment_values(model, one, self._durations, self._wholes.level(), self._look.length, self._look.options)
        segments, _ = best_tiling(lattice.windows, values, calm)
        likely = posterior(lattice.windows, values, calm, TEMPERATURE)
        return _Tiled(one, values, {each.first: each for each in segments}, likely)

    def _answer_remaining(self) -> list[LiveAnswer]:
        """All that is left, as if nothing followed."""
        if len(self._cells):
            return [self._select_decided(self._decode(len(self._at)), None)[0]]
        silent = self._unknown_scores(slice(self._told, None))
        return [silent if self._running is None else replace(silent, events=self._select_reported([self._running.event]))]

    def _decide(self, frames: int, count: int) -> list[LiveAnswer]:
        """Decide what begins in the first ``count`` cells, tell it, and forget what nothing needs any more."""
        answer, edge, self._running = self._select_decided(self._decode(frames), count)
        self._told += len(answer.times)
        self._first += edge
        self._cells = self._cells.skip(edge)
        reach = self._first * self._step - self._ahead - INTERPOLATION_MARGIN
        first = max(0, min(self._told, int(np.searchsorted(self._at, reach))))
        self._raw, self._good, self._at, self._told = self._raw[first:], self._good[first:], self._at[first:], self._told - first
        return [answer]

    def _select_decided(self, tiled: _Tiled, count: int | None) -> tuple[LiveAnswer, int, _Running | None]:
        """What begins in the first ``count`` cells, the edge that it reaches to, and the event that may go on there."""
        known, edge, running = len(self.classes), 0, self._running
        done: list[Event] = []
        while edge < (len(self._cells) if count is None else count):
            part = tiled.segments.get(edge)
            edge = edge + 1 if part is None else part.last
            mine = None if part is None or part.label >= known or not self._has_evidence(tiled, part) else part
            goes_on = mine is not None and running is not None and running.label == mine.label
            if running is not None and not (goes_on and self._durations.cyclic[running.label] > MIN_CYCLIC):
                done.append(running.event)
                running = None
            if mine is not None:
                running = _Running.after(running, mine, self._event(tiled, mine))
        if count is None and running is not None:
            done.append(running.event)
            running = None
        edges = tiled.one.lattice.edges
        last = len(self._at) if count is None else int(np.searchsorted(self._at, edges[edge] - EDGE_TOLERANCE))
        rows = slice(self._told, max(last, self._told))
        cell = np.searchsorted(edges, self._at[rows] + EDGE_TOLERANCE, side="right") - 1
        scores = log_scores(tiled.likely)[np.clip(cell, 0, len(tiled.likely) - 1), :known]
        return LiveAnswer(self._at[rows] + self._begin, scores, self._select_reported(done)), edge, running

    def _has_evidence(self, tiled: _Tiled, part: TiledSegment) -> bool:
        """Whether a segment has the evidence that is asked for where there is a background, as if it had been cut out by hand."""
        model = self.source.model
        if not model.hidden or not np.isfinite(self.source.least):
            return True
        windows = tiled.one.resample(np.array([part.window]), self._look.length).to(model.labels.device)
        return float(model.evidence(windows)[0]) >= self.source.least

    def _event(self, tiled: _Tiled, part: TiledSegment) -> Event:
        """As it is told, on the clock of the stream."""
        (event,) = events_of(self.source.model, tiled.one, [part], tiled.values, self.classes, self._look.length)
        last = float(self._at[-1])
        return replace(event, start=min(event.start, last) + self._begin, end=min(event.end, last) + self._begin)

    def _select_reported(self, events: list[Event]) -> list[Event]:
        """Those that reach the level that was asked for."""
        return [event for event in events if event.score >= self._floor]

    def _unknown_scores(self, rows: slice) -> LiveAnswer:
        """Frames of which nothing can be said."""
        at = self._at[rows]
        least = log_scores(np.zeros(1))[0]
        return LiveAnswer(at + self._begin, np.full((len(at), len(self.classes)), least))

    def _merge_answers(self, answers: list[LiveAnswer]) -> LiveAnswer:
        """One answer of several."""
        answers = [self._unknown_scores(slice(0, 0)), *answers]
        events = [event for one in answers for event in one.events]
        return LiveAnswer(np.concatenate([one.times for one in answers]), np.concatenate([one.scores for one in answers]), events)


def _grid(durations: Durations, num_durations: int) -> tuple[float, Array]:
    """Seconds of a cell, and ``(lengths,)`` of windows in cells, as in recordings that are there as a whole."""
    longest = 10 * float(np.nanmax(durations.seconds)) / DURATION_REACH  # a recording that is long enough for all windows
    lattice = Lattice.over(0.0, longest, durations, num_durations)
    lengths = np.unique(lattice.windows[:, 1] - lattice.windows[:, 0])
    return float(lattice.edges[1]), lengths


def _places(source: LiveSource, up: str, skeleton: Skeleton | None) -> Array:
    """``(joints,)`` where each joint that was learned stands in a frame, -1 where it is in none."""
    count = source.joints if skeleton is None else len(skeleton.joints)
    numbers = np.stack([np.arange(count), np.zeros(count), np.zeros(count)], axis=1)[None]
    (clip,) = match_all([Clip(numbers, up=up, skeleton=skeleton, name="stream")], source.skeleton)
    if clip.joints.shape[1] != source.joints:
        raise ValueError(
            f"skeleton: {clip.joints.shape[1]} joints, but the fitted clips have {source.joints}; use frames of one joint layout"
        )
    return np.asarray(np.nan_to_num(clip.joints[0, :, 0], nan=-1.0).astype(np.intp))


def _floor(model: ShapeModel, rate: float | None) -> float:
    """The least score of an event, as of a recording that is there as a whole."""
    if model.hidden:
        return event_level(model, rate)
    return -np.inf if rate is None else event_levels(wrong_contrast(model), rate, 1.0, (-np.inf, -np.inf))[1]
