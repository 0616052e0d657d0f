"""Short windows along an untrimmed recording: what each moment looks like, and how much the person moves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from indexing.action.bank import Windows, channel, stack
from indexing.action.exemplars import MAX_SAMPLED_MOMENTS
from indexing.action.model import ShapeModel
from indexing.clip import Clip, stretches
from indexing.windows import Ragged, concatenate_clips, sample

MIN_SHOWN_SHARE = 0.3  # of a window's frames that must show the person
INTERPOLATION_MARGIN = 2.0  # seconds of frames on both sides of a block from which missing joints are interpolated
STILL_QUANTILE = 0.25  # of the motion of all exemplars' short windows: who moves less is still, as actions go
CALM_QUANTILE = 0.1  # of the motion of one action's short windows: who moves less than its calm ones rests

Array = NDArray[Any]
Progress = Callable[[float], None] | None

BLOCK = 1200  # windows compared at once: bounds memory whatever the length of the recording


@dataclass(frozen=True)
class ActionOptions:
    """How long recordings are read by :class:`indexing.ActionIndexer`, :meth:`~indexing.ActionIndexer.stream` too.

    Nothing of it is learned: options that are set on a loaded model count.
    """

    window_step: float = 0.2
    """Seconds between the short windows of a recording; .1 takes twice the time and is as good."""
    num_durations: int = 24
    """Durations of windows that are looked through, at most: what a scan costs grows with them."""
    min_quality: float = 3.0
    """Quality that a segment must exceed to be an action rather than none: more for recordings full of other movement."""
    rest_weight: float = 4.0
    """Quality taken off where a person moves e times less than calm moments of the action do: 0 where people do not rest between
    actions.  F1 of actors who rest 2 to 7 s, camera turned by 60 degrees: 3: .79, 4: .85, 6: .90, but then Florence3D loses .02."""


@dataclass(frozen=True)
class Stream:
    """How a recording is scanned; seconds, and speed factors."""

    length: int
    window: float
    tempi: tuple[float, ...]
    device: str
    options: ActionOptions


@dataclass(frozen=True)
class StreamScan:
    """What the windows along a recording say, not pooled."""

    times: Array
    scores: Array
    motion: Array
    present: Array
    stretches: Array
    owner: Array

    @property
    def floor_score(self) -> float:
        """The score of every class where nobody is seen: no better than the worst moment."""
        return float(self.scores[self.present].min()) if self.present.any() else 0.0

    def parts(self) -> list[tuple[slice, slice]]:
        """The windows and the frames of every stretch."""
        ends = np.searchsorted(self.owner, np.arange(len(self.stretches) + 1))
        return [
            (slice(a, b), slice(first, end))
            for a, b, (first, end) in zip(ends[:-1], ends[1:], self.stretches.tolist(), strict=True)
        ]


def _centres(clip: Clip, stretches: Array, window_step: float) -> tuple[Array, Array]:
    """``(T,)`` times at which windows are centred, a step apart inside each stretch, and whose they are."""
    begin, end = clip.times[stretches[:, 0]], clip.times[stretches[:, 1] - 1]
    counts = np.maximum(2, np.ceil((end - begin) / window_step).astype(np.intp) + 1)
    owner = np.repeat(np.arange(len(counts)), counts)
    step = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    return np.asarray(begin[owner] + window_step * step), owner


def check_rate(clip: Clip, window: float) -> None:
    """Raise where no window of a recording can hold two frames."""
    step = float(np.median(np.diff(clip.times)))
    if step > window:
        raise ValueError(
            f"clip {clip.name!r}: its frames are {step:.3g} s apart, and a window lasts {window:g} s; times are seconds: correct "
            "them, or fps"
        )


def scan(model: ShapeModel, clip: Clip, stream: Stream, progress: Progress = None) -> StreamScan:
    """Score the windows along a recording, block by block: memory does not grow with its length.

    Where frames are missing for longer than a window, the recording is cut, and no window reaches across: what it costs is
    told by its frames, not by its clock.

    Raises:
        ValueError: its frames are too far apart for any window.
    """
    check_rate(clip, stream.window)
    cuts = stretches(clip.times, stream.window)
    cuts = cuts[cuts[:, 1] - cuts[:, 0] > 1]  # a single frame says nothing of an action
    at, owner = _centres(clip, cuts, stream.options.window_step)
    scores, motion = np.empty((len(at), model.classes)), np.empty(len(at))
    for begin in range(0, len(at), BLOCK):
        part = slice(begin, begin + BLOCK)
        source, own = frames_around(clip, cuts, at[part], owner[part], stream)
        scores[part], motion[part] = moments(model, source, own, at[part], stream)
        if progress is not None:
            progress(min(1.0, (begin + BLOCK) / len(at)))
    found_ = StreamScan(at, scores, motion, presence(clip, cuts, at, owner, stream), cuts, owner)
    scores[~found_.present] = found_.floor_score  # where nobody is seen nothing is said
    return found_


def moments(model: ShapeModel, source: Ragged, owner: Array, at: Array, stream: Stream) -> tuple[Array, Array]:
    """Class scores ``(T, classes)`` and motion ``(T,)`` of windows centred at some times, the best of all tempi."""
    # all tempi at once: the exemplars are described once for all of them
    queries = stack([windows_at(source, owner, at, stream.window * tempo, stream.length) for tempo in stream.tempi])
    found = model.moment_scores(queries.to(stream.device)).unflatten(0, (len(stream.tempi), -1))
    return found.amax(dim=0).cpu().numpy(), motion_of(windows_at(source, owner, at, stream.window, stream.length))


def presence(clip: Clip, cuts: Array, at: Array, owner: Array, stream: Stream) -> Array:
    """Whether enough frames around each time show the person: interpolated poses are no evidence."""
    shown = clip.times[clip.seen.any(axis=1)]
    begin, end = clip.times[cuts[owner, 0]], clip.times[cuts[owner, 1] - 1]
    span = np.minimum(stream.window, end - begin)
    middle = np.clip(at, begin + span / 2, end - span / 2)
    low, high = np.searchsorted(shown, middle - span / 2 - 1e-6), np.searchsorted(shown, middle + span / 2 + 1e-6)
    rate = 1.0 / float(np.median(np.diff(clip.times)))
    return np.asarray(high - low >= np.maximum(2.0, MIN_SHOWN_SHARE * span * rate))


def frames_around(clip: Clip, cuts: Array, at: Array, owner: Array, stream: Stream) -> tuple[Ragged, Array]:
    """The frames that windows centred at some times can touch, and some more to interpolate missing joints from."""
    margin = max(stream.tempi) * stream.window + INTERPOLATION_MARGIN
    used, own = np.unique(owner, return_inverse=True)
    pieces = []
    for number, (low, high) in enumerate(cuts[used].tolist()):
        mine = at[own == number]
        first = max(low, min(int(np.searchsorted(clip.times, mine[0] - margin)), high - 2))
        last = min(high, max(int(np.searchsorted(clip.times, mine[-1] + margin, side="right")), first + 2))
        pieces.append(clip.replace(joints=clip.joints[first:last], times=clip.times[first:last], confidence=None))
    return concatenate_clips(pieces), own


def windows_at(source: Ragged, owner: Array, middle: Array, seconds: float, length: int) -> Windows:
    # windows at the ends are shifted inwards rather than padded with a frozen pose
    begin, end = source.times[source.starts[:-1]][owner], source.times[source.starts[1:] - 1][owner]
    start = np.clip(middle - seconds / 2, begin, begin + np.maximum(0.0, end - begin - seconds))
    values = sample(source, owner, start, np.minimum(start + seconds, end), length)
    return Windows(values, torch.from_numpy(source.seen[owner]))


def motion_of(windows: Windows) -> Array:
    """``(N,)`` share of a window's energy that is change: 0 = a still pose."""
    known = windows.seen[:, None, :, None]
    whole = (channel(windows.values, "clip") * known).square().sum(dim=(1, 2, 3))
    moving = (channel(windows.values, "motion") * known).square().sum(dim=(1, 2, 3))
    return (moving / whole.clamp(min=1e-30)).sqrt().cpu().numpy()


def wrong_contrast(model: ShapeModel) -> Array:
    """The contrast that short windows of one class reach with other classes."""
    moments, labels = model.exemplars.moments, model.labels[model.exemplars.owner]
    chosen = torch.arange(0, len(moments), max(1, len(moments) // MAX_SAMPLED_MOMENTS))
    scores = model.moment_scores(moments[chosen]).cpu().numpy()
    scores[np.arange(len(chosen)), labels[chosen].cpu().numpy()] = np.nan
    return np.asarray(np.nanmax(scores, axis=1) - np.nanmean(scores, axis=1))


def motion_levels(model: ShapeModel) -> tuple[float, Array]:
    """The motion of calm moments: of all classes together, and of each ``(classes,)``.  Kept: every stretch asks for it again."""

    def make() -> tuple[float, Array]:
        motion, labels = motion_of(model.exemplars.moments), model.labels[model.exemplars.owner].cpu().numpy()
        each = np.array([np.quantile(motion[labels == c], CALM_QUANTILE) for c in range(model.classes)])
        return float(np.quantile(motion, STILL_QUANTILE)), each

    levels: tuple[float, Array] = model.cache.get(("motion levels", STILL_QUANTILE, CALM_QUANTILE), make)
    return levels
