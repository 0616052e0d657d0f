"""Untrimmed recordings by short windows alone, as the action indexer once did it: pooled scores, runs above a level.

What the segments of :mod:`indexing.recordings` are compared with: windows of one second at three speeds, averaged over 2.1 seconds
for frames and over .7 of that for events, and a level of the contrast for all actions that is calibrated among the exemplars.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self
from unittest import mock

import numpy as np
import torch

from experiments.recognition.protocol import Array
from indexing import ActionIndexer, ActionOptions, Clip
from indexing.action import exemplars
from indexing.action.bank import stack
from indexing.action.model import ShapeModel
from indexing.action.stream import BLOCK, Stream, StreamScan, frames_around, motion_levels, scan, windows_at, wrong_contrast
from indexing.scoring import Event, event_levels, events, smooth
from indexing.windows import repair_clip

BLOCK_STEP = 0.2  # seconds between the windows of which BLOCK are described at once


@dataclass(frozen=True)
class ShortWindowOptions:
    """Levels that events reach, and when a person rests, chosen on synthetic actors and exercises."""

    step: float = 0.1
    """Seconds between windows."""
    frames: float = 2.1
    """Seconds over which the scores of frames are averaged."""
    pool: float = 0.7
    """Of that, over which scores are averaged for events: they need sharper ends than frames."""
    false_alarms: float = 0.3
    """Rate at which a wrong action may reach an event's peak."""
    extent: float = 1.7
    """Times that rate for the level that an event's ends reach."""
    least: tuple[float, float] = (1.0, 0.6)
    """Least level of the peak and of the ends."""
    doubt: float = 0.5
    """Part of the way to a convincing contrast that being still takes."""
    hush: float = 1.2
    """Times less motion than an action's calm moments, from which a person rests whatever the contrast, unless it is convincing."""
    convincing: float = 0.99
    """Quantile of the contrast of wrong actions that is convincing."""


class ShortWindows:
    """An action indexer whose recordings are read by short windows alone."""

    def __init__(self, seed: int = 0, options: ShortWindowOptions = ShortWindowOptions()) -> None:
        self.seed, self.options = seed, options

    def fit(self, clips: Sequence[Clip], labels: Array) -> Self:
        """Learn as the action indexer does, with windows of a second however long the actions last."""
        with mock.patch.object(exemplars, "MAX_SHORT_WINDOW", np.inf):
            self.indexer = ActionIndexer(random_state=self.seed).fit(clips, labels)
        self.classes_: Array = self.indexer.classes_
        return self

    def scan(self, clip: Clip) -> tuple[Array, list[Event]]:
        """Scores of frames, and events."""
        clip = repair_clip(clip)
        model, options = self.indexer.model_, ActionOptions(window_step=self.options.step)
        stream = Stream(self.indexer.length, self.indexer.window, tuple(self.indexer.tempi), "cpu", options)
        found = scan(model, clip, stream)
        scores = frame_scores(clip, found, self.options.frames)
        return scores, find_events(model, clip, stream, found, self.classes_.tolist(), self.options)

    def score_frames(self, clip: Clip) -> Array:
        """``(frames, classes)``."""
        return self.scan(clip)[0]


def frame_scores(clip: Clip, found: StreamScan, pool: float) -> Array:
    """``(frames, classes)``: the window scores, pooled and read off at the clip's own frames."""
    scores = np.full((len(clip), found.scores.shape[1]), found.floor_score)
    for windows, frames in found.parts():
        at = found.times[windows]
        pooled = smooth(found.scores[windows], at, pool)
        scores[frames] = np.stack([np.interp(clip.times[frames], at, column) for column in pooled.T], axis=1)
    return scores


def find_events(
    model: ShapeModel,
    clip: Clip,
    stream: Stream,
    windows: StreamScan,
    classes: Sequence[Any] | Array,
    options: ShortWindowOptions = ShortWindowOptions(),
) -> list[Event]:
    """Events of a recording, each with the exemplar that fits its middle best.

    Found on the contrast: how far the best class stands above the mean of all.  Unlike the score itself it hardly changes
    with the viewpoint, so levels calibrated among the exemplars hold for other views.  A person who moves less than the calm
    moments of that class is at rest, unless the contrast is convincing (:func:`at_rest`).

    Args:
        windows: of :func:`scan`.
    """
    wrong, (still, calm) = wrong_contrast(model), motion_levels(model)
    peak, floor = event_levels(wrong, options.false_alarms, options.extent, options.least)
    convincing = max(peak, float(np.quantile(wrong, options.convincing)))
    found: list[Event] = []
    for part, frames in windows.parts():
        at = windows.times[part]
        scores = smooth(windows.scores[part], at, options.pool * options.frames)
        contrast = scores - scores.mean(axis=1, keepdims=True)
        motion = smooth(windows.motion[part, None], at, stream.window)[:, 0]
        resting = at_rest(contrast, motion, still, calm, (floor, convincing), options=options) | ~windows.present[part]
        ends = np.minimum(at, clip.times[frames][-1])
        found += events(contrast, ends, list(classes), peak, floor, resting)
    return _with_exemplars(model, clip, stream, windows.stretches, classes, found)


def at_rest(
    contrast: Array,
    motion: Array,
    still: float,
    calm: Array,
    levels: tuple[float, float],
    options: ShortWindowOptions = ShortWindowOptions(),
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
    less = np.log(np.maximum(own, 1e-30) / np.maximum(motion, 1e-30)) / np.log(options.hush)
    way = np.maximum(np.clip(less, 0.0, 1.0), options.doubt * (motion < still))
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
    for some in np.split(np.arange(len(found)), np.flatnonzero(np.diff(middles // (BLOCK * BLOCK_STEP))) + 1):
        source, own = frames_around(clip, cuts, middles[some], owner[some], stream)
        queries.append(windows_at(source, own, middles[some], stream.window, stream.length))
    residual = model.moment_residuals(stack(queries).to(stream.device))
    owners = model.labels[model.exemplars.owner]
    mine = torch.tensor([numbers[event.label] for event in found], device=owners.device)[:, None] == owners
    nearest = model.exemplars.owner[torch.where(mine, residual, torch.inf).argmin(dim=1)].tolist()
    return [dataclasses.replace(event, exemplar=exemplar) for event, exemplar in zip(found, nearest, strict=True)]
