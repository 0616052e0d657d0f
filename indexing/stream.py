"""Untrimmed recordings: a score for every frame, and the events they form."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from indexing.clip import Clip
from indexing.scoring import Event, event_levels, events, smooth
from indexing.shape.bank import Windows, stack
from indexing.shape.channels import channel
from indexing.shape.model import MOMENT_SAMPLE, ShapeModel
from indexing.windows import Ragged, ragged, sample

Array = NDArray[Any]
Progress = Callable[[float], None] | None

STEP = 0.1  # seconds between the windows of a recording
# Of `find`, on streams of 13 synthetic actions, other people, other views: recall .94 at 13 % false finds with short rests,
# .91 at 13 % with long ones (rate .1: .62 at 11 %; .5: .9 at 40 %; still .1: 35 % false in long rests; .3: recall .89).
FALSE_ALARMS = 0.3  # rate at which a wrong action may reach an event's peak
EXTENT = 1.7  # times that rate for the level that an event's ends reach
LEAST = (1.0, 0.6)  # of peak and floor: among two or three classes the calibration has little or nothing to compare
SHOWN = 0.3  # of a window's frames must show the person
EVENT_POOL = 0.7  # of `pool`: events need sharper ends than frames
CONVINCING = 0.99  # quantile of the contrast of wrong actions above which a person may stand still
STILL = 0.25  # quantile of the exemplars' motion below which a person is at rest
MARGIN = 2.0  # seconds of frames on both sides of a block, from which missing joints are interpolated
BLOCK = 1200  # windows compared at once: bounds memory whatever the length of the recording


@dataclass(frozen=True)
class Stream:
    """How a recording is scanned; seconds, and speed factors."""

    length: int
    window: float
    tempi: tuple[float, ...]
    pool: float
    device: str


def centres(clip: Clip) -> Array:
    """``(T,)`` times at which windows are centred."""
    return np.asarray(clip.times[0] + STEP * np.arange(max(2, int(np.ceil(clip.duration / STEP)) + 1)))


@dataclass(frozen=True)
class Scan:
    """What the windows along a recording say, not pooled.

    times ``(T,)``, class scores ``(T, classes)``, motion ``(T,)``, and whether anybody was there ``(T,)``.
    """

    times: Array
    scores: Array
    motion: Array
    present: Array


def scan(model: ShapeModel, clip: Clip, stream: Stream, progress: Progress = None) -> Scan:
    """Score the windows along a recording, block by block: memory does not grow with its length."""
    at = centres(clip)
    scores, motion = np.empty((len(at), model.classes)), np.empty(len(at))
    for begin in range(0, len(at), BLOCK):
        part = slice(begin, begin + BLOCK)
        source = _around(clip, at[part][0], at[part][-1], stream)
        # all tempi at once: the exemplars are described once for all of them
        queries = stack([_windows(source, at[part], stream.window * tempo, stream.length) for tempo in stream.tempi])
        found = model.moment_scores(queries.to(stream.device)).unflatten(0, (len(stream.tempi), -1))
        scores[part] = found.amax(dim=0).cpu().numpy()
        motion[part] = _motion(_windows(source, at[part], stream.window, stream.length))
        if progress is not None:
            progress(min(1.0, (begin + BLOCK) / len(at)))
    present = _present(clip, at, stream)
    # where nobody is seen nothing is said: the same for every class, and no better than the worst moment
    scores[~present] = scores[present].min() if present.any() else 0.0
    return Scan(at, scores, motion, present)


def _present(clip: Clip, at: Array, stream: Stream) -> Array:
    """Whether enough frames around each time show the person: interpolated poses are no evidence."""
    shown = clip.times[clip.seen.any(axis=1)]
    span = min(stream.window, clip.duration)
    middle = np.clip(at, clip.times[0] + span / 2, clip.times[-1] - span / 2)
    low, high = np.searchsorted(shown, middle - span / 2 - 1e-6), np.searchsorted(shown, middle + span / 2 + 1e-6)
    rate = 1.0 / float(np.median(np.diff(clip.times)))
    return np.asarray(high - low >= max(2.0, SHOWN * span * rate))


def _around(clip: Clip, begin: float, end: float, stream: Stream) -> Ragged:
    """The frames that windows centred between two times can touch, and some more to interpolate missing joints from."""
    margin = max(stream.tempi) * stream.window + MARGIN
    first = max(0, min(int(np.searchsorted(clip.times, begin - margin)), len(clip) - 2))
    last = max(int(np.searchsorted(clip.times, end + margin, side="right")), first + 2)
    return ragged([clip.replace(joints=clip.joints[first:last], times=clip.times[first:last], confidence=None)])


def _windows(source: Ragged, middle: Array, seconds: float, length: int) -> Windows:
    owner = np.zeros(len(middle), dtype=np.intp)
    # windows at the ends are shifted inwards rather than padded with a frozen pose
    room = max(0.0, float(source.times[-1] - source.times[0]) - seconds)
    start = np.clip(middle - seconds / 2, source.times[0], source.times[0] + room)
    values = sample(source, owner, start, np.minimum(start + seconds, source.times[-1]), length)
    return Windows(values, torch.from_numpy(source.seen).expand(len(middle), -1))


def frame_scores(clip: Clip, stream: Stream, found: Scan) -> Array:
    """``(frames, classes)``: the window scores, pooled and read off at the clip's own frames."""
    pooled = smooth(found.scores, found.times, stream.pool)
    return np.stack([np.interp(clip.times, found.times, column) for column in pooled.T], axis=1)


def find_events(
    model: ShapeModel, clip: Clip, stream: Stream, windows: Scan, classes: Sequence[Any] | Array, rate: float | None
) -> list[Event]:
    """Events of a recording, each with the exemplar that fits its middle best.

    Found on the contrast: how far the best class stands above the mean of all.  Unlike the score itself it hardly changes
    with the viewpoint, so levels calibrated among the exemplars hold for other views.  A person who moves less than the
    exemplars do is at rest, unless the contrast is convincing (a wave moves one hand only).

    Args:
        windows: of :func:`scan`.
        rate: at which the contrast of wrong actions may reach the level that an event needs (0.3 by default); a number
            outside 0..1 is that level itself.
    """
    at = windows.times
    scores = smooth(windows.scores, at, EVENT_POOL * stream.pool)
    contrast = scores - scores.mean(axis=1, keepdims=True)
    wrong, moving = _levels(model)
    resting = smooth(windows.motion[:, None], at, stream.window)[:, 0] < moving
    resting &= contrast.max(axis=1) < np.quantile(wrong, CONVINCING)
    resting |= ~windows.present
    peak, floor = event_levels(wrong, FALSE_ALARMS if rate is None else rate, EXTENT, LEAST)
    found = events(contrast, np.minimum(at, clip.times[-1]), list(classes), peak, floor, resting)
    if not found:
        return []
    numbers = {label: i for i, label in enumerate(classes)}
    middles = np.array([(event.start + event.end) / 2 for event in found])
    blocks = np.split(middles, np.flatnonzero(np.diff(middles // (BLOCK * STEP))) + 1)
    queries = [_windows(_around(clip, some[0], some[-1], stream), some, stream.window, stream.length) for some in blocks]
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


def _levels(model: ShapeModel) -> tuple[Array, float]:
    """The contrast that short windows of one class reach with other classes, and the least motion of an exemplar."""
    moments, labels = model.exemplars.moments, model.labels[model.exemplars.owner]
    chosen = torch.arange(0, len(moments), max(1, len(moments) // MOMENT_SAMPLE))
    scores = model.moment_scores(moments[chosen]).cpu().numpy()
    scores[np.arange(len(chosen)), labels[chosen].cpu().numpy()] = np.nan
    return np.nanmax(scores, axis=1) - np.nanmean(scores, axis=1), float(np.quantile(_motion(moments), STILL))
