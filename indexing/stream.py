"""Untrimmed recordings: a score for every frame, and the events they form."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from indexing.clip import Clip
from indexing.scoring import FALSE_ALARMS, Event, events, smooth
from indexing.shape.bank import Windows
from indexing.shape.model import MOMENT_SAMPLE, ShapeModel
from indexing.windows import Ragged, ragged, sample

Array = NDArray[Any]
Progress = Callable[[float], None] | None

STEP = 0.1  # seconds between the windows of a recording
BLOCK = 1200  # windows compared at once: bounds memory whatever the length of the recording


@dataclass(frozen=True)
class Stream:
    """How a recording is scanned; seconds, and speed factors."""

    length: int
    window: float
    tempi: tuple[float, ...]
    pool: float
    repair: bool
    device: str


def centres(clip: Clip) -> Array:
    """``(T,)`` times at which windows are centred."""
    return np.asarray(clip.times[0] + STEP * np.arange(max(2, int(np.ceil(clip.duration / STEP)) + 1)))


def window_scores(model: ShapeModel, clip: Clip, stream: Stream, progress: Progress = None) -> tuple[Array, Array]:
    """Times ``(T,)`` and pooled class scores ``(T, classes)`` along a recording."""
    source = ragged([clip], stream.repair)
    at = centres(clip)
    scores = np.empty((len(at), model.classes))
    for begin in range(0, len(at), BLOCK):
        part = at[begin : begin + BLOCK]
        best: Tensor | None = None
        for tempo in stream.tempi:
            query = _windows(source, part, stream.window * tempo, stream.length).to(stream.device)
            one = model.moment_scores(query)
            best = one if best is None else torch.maximum(best, one)
        if best is None:
            raise ValueError("tempi: give at least one speed factor")
        scores[begin : begin + len(part)] = best.cpu().numpy()
        if progress is not None:
            progress(min(1.0, (begin + len(part)) / len(at)))
    return at, smooth(scores, at, stream.pool)


def _windows(source: Ragged, middle: Array, seconds: float, length: int) -> Windows:
    owner = np.zeros(len(middle), dtype=np.intp)
    # windows at the ends are shifted inwards rather than padded with a frozen pose
    room = max(0.0, float(source.times[-1] - source.times[0]) - seconds)
    start = np.clip(middle - seconds / 2, source.times[0], source.times[0] + room)
    values = sample(source, owner, start, np.minimum(start + seconds, source.times[-1]), length)
    return Windows(values, torch.from_numpy(source.seen).expand(len(middle), -1))


def score_stream(model: ShapeModel, clip: Clip, stream: Stream, progress: Progress = None) -> Array:
    """``(frames, classes)``: the pooled scores, read off at the clip's own frames."""
    at, scores = window_scores(model, clip, stream, progress)
    return np.stack([np.interp(clip.times, at, column) for column in scores.T], axis=1)


def find_events(
    model: ShapeModel, clip: Clip, stream: Stream, classes: Sequence[Any] | Array, reject: float | None, progress: Progress = None
) -> list[Event]:
    """Events of a recording, each with the exemplar that fits its middle best."""
    at, scores = window_scores(model, clip, stream, progress)
    level = stream_threshold(model, stream, reject)
    found = events(scores, np.minimum(at, clip.times[-1]), list(classes), level)
    if not found:
        return []
    middle = np.array([(event.start + event.end) / 2 for event in found])
    query = _windows(ragged([clip], stream.repair), middle, stream.window, stream.length).to(stream.device)
    residual = model.moment_residuals(query)
    numbers = {label: i for i, label in enumerate(classes)}
    out = []
    for row, event in zip(residual, found, strict=True):
        mine = model.labels[model.exemplars.owner] == numbers[event.label]
        nearest = int(torch.where(mine, row, torch.inf).argmin())
        out.append(dataclasses.replace(event, exemplar=int(model.exemplars.owner[nearest])))
    return out


def stream_threshold(model: ShapeModel, stream: Stream, reject: float | None) -> float:
    """The score that windows of one class reach for other classes only at the accepted rate of false alarms."""
    if reject is not None and not 0 < reject < 1:
        return reject
    moments, labels = model.exemplars.moments, model.labels[model.exemplars.owner]
    sample = torch.arange(0, len(moments), max(1, len(moments) // MOMENT_SAMPLE))
    scores = model.moment_scores(moments[sample])
    scores[torch.arange(len(sample)), labels[sample]] = -torch.inf
    return float(torch.quantile(scores.max(dim=1).values, 1 - (FALSE_ALARMS if reject is None else reject)))
