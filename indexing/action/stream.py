"""Untrimmed recordings: a score for every frame, and the events they form."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from indexing.action.bank import Windows, channel, stack
from indexing.action.model import ShapeModel
from indexing.action.options import ActionOptions
from indexing.clip import Clip, stretches
from indexing.scoring import Event, event_levels, events, smooth
from indexing.windows import Ragged, ragged, sample

Array = NDArray[Any]
Progress = Callable[[float], None] | None

BLOCK = 1200  # windows compared at once: bounds memory whatever the length of the recording


@dataclass(frozen=True)
class Stream:
    """How a recording is scanned; seconds, and speed factors."""

    length: int
    window: float
    tempi: tuple[float, ...]
    pool: float
    device: str


@dataclass(frozen=True)
class StreamScan:
    """What the windows along a recording say, not pooled.

    times ``(T,)``, class scores ``(T, classes)``, motion ``(T,)``, whether anybody was there ``(T,)``, and in which of the
    stretches ``(S, 2)``, first frame and end, a window lies ``(T,)``.
    """

    times: Array
    scores: Array
    motion: Array
    present: Array
    stretches: Array
    owner: Array

    @property
    def nothing(self) -> float:
        """The score of every class where nobody is seen: no better than the worst moment."""
        return float(self.scores[self.present].min()) if self.present.any() else 0.0

    def parts(self) -> list[tuple[slice, slice]]:
        """The windows and the frames of every stretch."""
        ends = np.searchsorted(self.owner, np.arange(len(self.stretches) + 1))
        return [
            (slice(a, b), slice(first, end))
            for a, b, (first, end) in zip(ends[:-1], ends[1:], self.stretches.tolist(), strict=True)
        ]


def _centres(clip: Clip, stretches: Array, options: ActionOptions) -> tuple[Array, Array]:
    """``(T,)`` times at which windows are centred, a step apart inside each stretch, and whose they are."""
    begin, end = clip.times[stretches[:, 0]], clip.times[stretches[:, 1] - 1]
    counts = np.maximum(2, np.ceil((end - begin) / options.events.step).astype(np.intp) + 1)
    owner = np.repeat(np.arange(len(counts)), counts)
    step = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    return np.asarray(begin[owner] + options.events.step * step), owner


def check_rate(clip: Clip, window: float) -> None:
    """Raise where no window of a recording can hold two frames.

    Raises:
        ValueError: naming the clip, how far its frames are apart, and what to do.
    """
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
    at, owner = _centres(clip, cuts, model.options)
    scores, motion = np.empty((len(at), model.classes)), np.empty(len(at))
    for begin in range(0, len(at), BLOCK):
        part = slice(begin, begin + BLOCK)
        source, own = _around(clip, cuts, at[part], owner[part], stream, model.options)
        scores[part], motion[part] = moments(model, source, own, at[part], stream)
        if progress is not None:
            progress(min(1.0, (begin + BLOCK) / len(at)))
    found_ = StreamScan(at, scores, motion, presence(clip, cuts, at, owner, stream, model.options), cuts, owner)
    scores[~found_.present] = found_.nothing  # where nobody is seen nothing is said
    return found_


def moments(model: ShapeModel, source: Ragged, owner: Array, at: Array, stream: Stream) -> tuple[Array, Array]:
    """Class scores ``(T, classes)`` and motion ``(T,)`` of windows centred at some times, the best of all tempi."""
    # all tempi at once: the exemplars are described once for all of them
    queries = stack([_windows(source, owner, at, stream.window * tempo, stream.length) for tempo in stream.tempi])
    found = model.moment_scores(queries.to(stream.device)).unflatten(0, (len(stream.tempi), -1))
    return found.amax(dim=0).cpu().numpy(), _motion(_windows(source, owner, at, stream.window, stream.length))


def presence(clip: Clip, cuts: Array, at: Array, owner: Array, stream: Stream, options: ActionOptions) -> Array:
    """Whether enough frames around each time show the person: interpolated poses are no evidence."""
    shown = clip.times[clip.seen.any(axis=1)]
    begin, end = clip.times[cuts[owner, 0]], clip.times[cuts[owner, 1] - 1]
    span = np.minimum(stream.window, end - begin)
    middle = np.clip(at, begin + span / 2, end - span / 2)
    low, high = np.searchsorted(shown, middle - span / 2 - 1e-6), np.searchsorted(shown, middle + span / 2 + 1e-6)
    rate = 1.0 / float(np.median(np.diff(clip.times)))
    return np.asarray(high - low >= np.maximum(2.0, options.events.shown * span * rate))


def _around(clip: Clip, cuts: Array, at: Array, owner: Array, stream: Stream, options: ActionOptions) -> tuple[Ragged, Array]:
    """The frames that windows centred at some times can touch, and some more to interpolate missing joints from.

    Returns:
        the frames, stretch by stretch; and for each window, in which of these it lies.
    """
    margin = max(stream.tempi) * stream.window + options.events.margin
    used, own = np.unique(owner, return_inverse=True)
    pieces = []
    for number, (low, high) in enumerate(cuts[used].tolist()):
        mine = at[own == number]
        first = max(low, min(int(np.searchsorted(clip.times, mine[0] - margin)), high - 2))
        last = min(high, max(int(np.searchsorted(clip.times, mine[-1] + margin, side="right")), first + 2))
        pieces.append(clip.replace(joints=clip.joints[first:last], times=clip.times[first:last], confidence=None))
    return ragged(pieces), own


def _windows(source: Ragged, owner: Array, middle: Array, seconds: float, length: int) -> Windows:
    # windows at the ends are shifted inwards rather than padded with a frozen pose
    begin, end = source.times[source.starts[:-1]][owner], source.times[source.starts[1:] - 1][owner]
    start = np.clip(middle - seconds / 2, begin, begin + np.maximum(0.0, end - begin - seconds))
    values = sample(source, owner, start, np.minimum(start + seconds, end), length)
    return Windows(values, torch.from_numpy(source.seen[owner]))


def frame_scores(clip: Clip, stream: Stream, found: StreamScan) -> Array:
    """``(frames, classes)``: the window scores, pooled and read off at the clip's own frames."""
    scores = np.full((len(clip), found.scores.shape[1]), found.nothing)
    for windows, frames in found.parts():
        at = found.times[windows]
        pooled = smooth(found.scores[windows], at, stream.pool)
        scores[frames] = np.stack([np.interp(clip.times[frames], at, column) for column in pooled.T], axis=1)
    return scores


def find_events(
    model: ShapeModel, clip: Clip, stream: Stream, windows: StreamScan, classes: Sequence[Any] | Array, rate: float | None
) -> list[Event]:
    """Events of a recording, each with the exemplar that fits its middle best.

    Found on the contrast: how far the best class stands above the mean of all.  Unlike the score itself it hardly changes
    with the viewpoint, so levels calibrated among the exemplars hold for other views.  A person who moves less than the calm
    moments of that class is at rest, unless the contrast is convincing (:func:`at_rest`).

    Args:
        windows: of :func:`scan`.
        rate: at which the contrast of wrong actions may reach the level that an event needs (0.3 by default); a number
            outside 0..1 is that level itself.
    """
    wrong, (still, calm) = wrong_contrast(model), motion_levels(model)
    peak, floor = event_levels(
        wrong, model.options.events.false_alarms if rate is None else rate, model.options.events.extent, model.options.events.least
    )
    convincing = max(peak, float(np.quantile(wrong, model.options.events.convincing)))
    found: list[Event] = []
    for part, frames in windows.parts():
        at = windows.times[part]
        scores = smooth(windows.scores[part], at, model.options.events.pool * stream.pool)
        contrast = scores - scores.mean(axis=1, keepdims=True)
        motion = smooth(windows.motion[part, None], at, stream.window)[:, 0]
        resting = at_rest(contrast, motion, still, calm, (floor, convincing), options=model.options) | ~windows.present[part]
        ends = np.minimum(at, clip.times[frames][-1])
        found += events(contrast, ends, list(classes), peak, floor, resting, model.options.decisions)
    return _with_exemplars(model, clip, stream, windows.stretches, classes, found)


def at_rest(
    contrast: Array, motion: Array, still: float, calm: Array, levels: tuple[float, float], options: ActionOptions = ActionOptions()
) -> Array:
    """``(T,)`` whether a person rests, whatever action it looks like.

    The less a person moves, the more contrast it takes: between the level that every event needs and the convincing one.

    Args:
        contrast: ``(T, classes)``; motion: ``(T,)``.
        still: motion below which most actions do not go; calm: ``(classes,)`` motion of the calm moments of each.
        levels: the contrast of an event, and the convincing one.

    Example:
        >>> contrast, calm = np.array([[2.0, -2.0]] * 4), np.array([0.1, 0.5])
        >>> at_rest(contrast, np.array([0.4, 0.2, 0.09, 0.01]), 0.3, calm, (1.0, 4.0)).tolist()
        [False, True, True, True]
        >>> at_rest(contrast + 1, np.array([0.4, 0.2, 0.09, 0.01]), 0.3, calm, (1.0, 4.0)).tolist()
        [False, False, False, True]
    """
    own = np.minimum(still, calm[contrast.argmax(axis=1)])
    less = np.log(np.maximum(own, 1e-30) / np.maximum(motion, 1e-30)) / np.log(options.events.hush)
    way = np.maximum(np.clip(less, 0.0, 1.0), options.events.doubt * (motion < still))
    return np.asarray(contrast.max(axis=1) < levels[0] + (levels[1] - levels[0]) * way)


def _with_exemplars(
    model: ShapeModel, clip: Clip, stream: Stream, cuts: Array, classes: Sequence[Any] | Array, found: list[Event]
) -> list[Event]:
    """Each event with the number of the exemplar of its class that fits its middle best."""
    if not found:
        return []
    numbers = {label: i for i, label in enumerate(classes)}
    middles = np.array([(event.start + event.end) / 2 for event in found])
    owner = np.searchsorted(clip.times[cuts[:, 0]], middles, side="right") - 1
    queries = []
    for some in np.split(np.arange(len(found)), np.flatnonzero(np.diff(middles // (BLOCK * model.options.events.step))) + 1):
        source, own = _around(clip, cuts, middles[some], owner[some], stream, model.options)
        queries.append(_windows(source, own, middles[some], stream.window, stream.length))
    residual = model.moment_residuals(stack(queries).to(stream.device))
    owners = model.labels[model.exemplars.owner]
    mine = torch.tensor([numbers[event.label] for event in found], device=owners.device)[:, None] == owners
    nearest = model.exemplars.owner[torch.where(mine, residual, torch.inf).argmin(dim=1)].tolist()
    return [dataclasses.replace(event, exemplar=exemplar) for event, exemplar in zip(found, nearest, strict=True)]


def _motion(windows: Windows) -> Array:
    """``(N,)`` share of a window's energy that is change: 0 = a still pose."""
    known = windows.seen[:, None, :, None]
    whole = (channel(windows.values, "clip") * known).square().sum(dim=(1, 2, 3))
    moving = (channel(windows.values, "motion") * known).square().sum(dim=(1, 2, 3))
    return (moving / whole.clamp(min=1e-30)).sqrt().cpu().numpy()


def wrong_contrast(model: ShapeModel) -> Array:
    """The contrast that short windows of one class reach with other classes."""
    moments, labels = model.exemplars.moments, model.labels[model.exemplars.owner]
    chosen = torch.arange(0, len(moments), max(1, len(moments) // model.options.nearest.moments))
    scores = model.moment_scores(moments[chosen]).cpu().numpy()
    scores[np.arange(len(chosen)), labels[chosen].cpu().numpy()] = np.nan
    return np.asarray(np.nanmax(scores, axis=1) - np.nanmean(scores, axis=1))


def motion_levels(model: ShapeModel) -> tuple[float, Array]:
    """The motion of calm moments: of all classes together, and of each ``(classes,)``."""
    motion, labels = _motion(model.exemplars.moments), model.labels[model.exemplars.owner].cpu().numpy()
    each = np.array([np.quantile(motion[labels == c], model.options.events.calm) for c in range(model.classes)])
    return float(np.quantile(motion, model.options.events.still)), each
