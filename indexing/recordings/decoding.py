"""A recording explained by the actions of a model: as segments, one per performance, and frame by frame.

The stages: short windows say what each moment looks like (:mod:`indexing.action.stream`); windows of every duration that the
actions have say what a whole performance looks like (:mod:`indexing.recordings.evidence`); the best segments that do not overlap
are found by dynamic programming, in which rest and other movement have a value, too (:func:`best_tiling`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch

from indexing.action.bank import Windows, mirror
from indexing.action.exemplars import moment_window
from indexing.action.model import ShapeModel
from indexing.action.stream import ActionOptions, Progress, Stream, StreamScan, motion_levels, scan, wrong_contrast
from indexing.clip import Clip
from indexing.recordings.evidence import MIN_CYCLIC, Array, Durations, Lattice, level, machine_scores, whole_scores
from indexing.scoring import Event, event_levels
from indexing.windows import Ragged, concatenate_clips

WHOLE_WEIGHT = 1.0  # of the nearest whole exemplars
MACHINE_WEIGHT = 0.8  # of the kernel machine (UTKinect without it: .813 for .843)
MOMENT_WEIGHT = 1.25  # of short windows of the exemplars
DURATION_WEIGHT = 0.5  # of the log likelihood of a duration; 0 costs .02 on UTKinect
SEGMENT_COST = 1.0  # of beginning a segment
ABSENCE_COST = 8.0  # where nobody is seen
TEMPERATURE = 0.15  # of the posterior of frames; the best segments alone (0) are as good on most sets
MAX_VALUE_GAP = 3.0  # to the best explanation, for a window to be asked of the kernel machine
CYCLIC_MOMENT_GAIN = 2.0  # more weight of short windows for cyclic actions, which have no begin and end to be aligned
CYCLIC_WHOLE_LOSS = 0.75  # share of the weight of whole exemplars that they lose
# pose between two segments, from the ends over from within the exemplar: bows, squats .3 to 1.2, punches in a row 3.7 to 3.9
MIN_SEAM_RATIO = 2.0
MIN_LIKELIHOOD = 1e-6  # whose logarithm is the least score of a frame
MIN_RANKED_LIKELIHOOD = 1e-16  # down to which classes are still ranked: the rounding of sums
RANKING_WEIGHT = 1e-3  # of the logarithm of such likelihoods
EDGE_TOLERANCE = 1e-6  # seconds: a frame on an edge belongs to the cell behind it, however its time was rounded

Reason = Literal["at rest", "nobody there", "below the level", "other movement"]


@dataclass(frozen=True)
class Withheld:
    """Something that looked like an action and is not reported: what it would have been, and why it is not."""

    event: Event
    reason: Reason


@dataclass(frozen=True, eq=False)
class Explanation:
    """A recording of one person as segments."""

    times: Array
    classes: tuple[Any, ...]
    scores: Array
    events: Sequence[Event] = ()
    withheld: Sequence[Withheld] = ()
    background: Array | None = None

    def seconds(self, label: Any) -> float:
        """How long one action lasts in all."""
        return sum(event.end - event.start for event in self.events if event.label == label)


@dataclass(frozen=True)
class Stretch:
    """One stretch of a recording without gaps: its lattice, and what is known of its cells."""

    source: Ragged
    lattice: Lattice
    raw: Array
    contrast: Array
    motion: Array
    present: Array
    whole: Array
    frames: tuple[int, int]

    def resample(self, chosen: Array, length: int) -> Windows:
        """Some windows, resampled."""
        return self.lattice.resample(self.source, 0, chosen, length)


def decode(
    model: ShapeModel, clip: Clip, stream: Stream, classes: Sequence[Any], rate: float | None, progress: Progress = None
) -> Explanation:
    """The segments of a recording, and what they say of its frames."""
    window = moment_window(stream.window, model.exemplars.seconds)
    options = dataclasses.replace(stream.options, window_step=min(stream.options.window_step, window / 4))
    stream = dataclasses.replace(stream, window=window, options=options)
    durations = Durations.of(model, stream.window, 0.3 * stream.window)
    moments = scan(model, clip, stream, None if progress is None else lambda share: progress(0.5 * share))
    stretches = _stretches(model, clip, moments, durations, stream, progress)
    wholes = level(np.concatenate([one.whole.ravel() for one in stretches]) if stretches else np.zeros(0))
    scores = np.full((len(clip), model.classes), log_scores(np.zeros(1))[0])
    background = np.ones(len(clip))
    events: list[Event] = []
    held: list[Withheld] = []
    for one in stretches:
        values, calm, absent = segment_values(model, one, durations, wholes, stream.length, options)
        segments, _ = best_tiling(one.lattice.windows, values, calm)
        inside = posterior(one.lattice.windows, values, calm, TEMPERATURE)
        first, end = one.frames
        cell = np.searchsorted(one.lattice.edges, clip.times[first:end] + EDGE_TOLERANCE, side="right") - 1
        cell = np.clip(cell, 0, len(inside) - 1)
        scores[first:end] = log_scores(inside)[cell]
        background[first:end] = 1.0 - inside.sum(axis=1).clip(0.0, 1.0)[cell]
        mine = _merge_segments(model, one, segments, durations, stream.length)
        events += events_of(model, one, mine, values, classes, stream.length)
        # what would be there, did rest and absence count as movement, and is not
        awake = np.minimum(calm, options.min_quality * _unit(one, durations))
        restless, _ = best_tiling(one.lattice.windows, values + absent, awake)
        silent = [
            part
            for part in _merge_segments(model, one, restless, durations, stream.length)
            if not any(min(part.last, other.last) > max(part.first, other.first) for other in mine)
        ]
        reasons: list[Reason] = ["nobody there" if not one.present[part.first : part.last].any() else "at rest" for part in silent]
        silent_events = events_of(model, one, silent, values, classes, stream.length)
        held += [Withheld(event, reason) for event, reason in zip(silent_events, reasons, strict=True)]
    events, low = _apply_level(model, events, rate)
    if progress is not None:
        progress(1.0)
    held = sorted([*held, *low], key=lambda each: each.event.start)
    return Explanation(clip.times, tuple(classes), scores, events, held, background)


def log_scores(likely: Array) -> Array:
    """Logarithms of likelihoods; below the least ones a shade tells classes apart."""
    return np.asarray(
        np.log(np.maximum(likely, MIN_LIKELIHOOD)) + RANKING_WEIGHT * np.log(np.maximum(likely, MIN_RANKED_LIKELIHOOD))
    )


def _unit(one: Stretch, durations: Durations) -> float:
    """How long a cell lasts, in ordinary exemplars."""
    return float((one.lattice.edges[1] - one.lattice.edges[0]) / durations.unit)


def _stretches(
    model: ShapeModel, clip: Clip, moments: StreamScan, durations: Durations, stream: Stream, progress: Progress
) -> list[Stretch]:
    """What is known of every stretch before anything is decided."""
    contrast = moments.scores - moments.scores.mean(axis=1, keepdims=True)
    _, spread = level(contrast[moments.present])
    out: list[Stretch] = []
    for number, (part, frames) in enumerate(moments.parts()):
        times = clip.times[frames]
        lattice = Lattice.over(float(times[0]), float(times[-1]), durations, stream.options.num_durations)
        middle, at = (lattice.edges[1:] + lattice.edges[:-1]) / 2, moments.times[part]
        cells = np.stack([np.interp(middle, at, column) for column in contrast[part].T], axis=1)
        motion = np.interp(middle, at, moments.motion[part])
        present = np.interp(middle, at, moments.present[part].astype(float)) > 0.5
        source = concatenate_clips([clip.replace(joints=clip.joints[frames], times=times, confidence=None)])

        def resample(chosen: Array, lattice: Lattice = lattice, source: Ragged = source) -> Windows:
            return lattice.resample(source, 0, chosen, stream.length)

        whole = whole_scores(model, lattice, resample, durations)
        out.append(Stretch(source, lattice, cells, cells / spread, motion, present, whole, (frames.start, frames.stop)))
        if progress is not None:
            progress(0.5 + 0.4 * (number + 1) / len(moments.stretches))
    return out


@dataclass(frozen=True)
class _Worth:
    """What windows are worth as segments of each class ``(W, classes)``, while nearest exemplars speak for the kernel machine."""

    values: Array
    told: Array
    share: Array
    background: Array
    absent: Array


def _worth(model: ShapeModel, one: Stretch, durations: Durations, wholes: tuple[float, float], options: ActionOptions) -> _Worth:
    """A segment is worth its quality times its duration in ordinary exemplars, the likelihood of its duration, less what it costs
    to begin one."""
    lattice, cyclic = one.lattice, durations.cyclic[None].astype(np.float32)
    whole = np.nan_to_num((one.whole - wholes[0]) / wholes[1], nan=-2.0)
    unseen = ABSENCE_COST * ~one.present
    rest = _rest_evidence(model, one)
    lasts = (lattice.seconds / durations.unit).astype(np.float32)[:, None]
    absent = lasts * lattice.mean(unseen[:, None])
    quality = MOMENT_WEIGHT * (1 + CYCLIC_MOMENT_GAIN * cyclic) * lattice.mean(one.contrast)
    # what moments say of cyclic actions counts more, so rest must, too
    quality -= options.rest_weight * CYCLIC_MOMENT_GAIN * cyclic * lattice.mean(rest.clip(min=0.0)[:, None])
    weight = 1 - CYCLIC_WHOLE_LOSS * cyclic
    quality += WHOLE_WEIGHT * weight * whole
    prior = durations.likelihoods(lattice.seconds, model.labels.cpu().numpy())
    without_machine = lasts * quality + DURATION_WEIGHT * prior - SEGMENT_COST - absent
    share = MACHINE_WEIGHT * lasts * weight
    proxy = whole - whole.mean(axis=1, keepdims=True)
    proxy /= np.maximum(proxy.std(axis=1, keepdims=True), 1e-9)
    background = (options.min_quality + options.rest_weight * rest + unseen) * _unit(one, durations)
    return _Worth(without_machine + share * proxy, without_machine, share, background, absent)


def segment_values(
    model: ShapeModel, one: Stretch, durations: Durations, wholes: tuple[float, float], length: int, options: ActionOptions
) -> tuple[Array, Array, Array]:
    """``(W, classes)`` what windows are worth as segments of each class, ``(cells,)`` what background is worth, ``(W, 1)``
    what absence takes off."""
    worth = _worth(model, one, durations, wholes, options)
    if model.kernels is not None:
        total = through(one.lattice.windows, worth.values, worth.background)
        survivors = np.flatnonzero(total >= total.max() - MAX_VALUE_GAP)
        machine = machine_scores(model, lambda chosen: one.resample(chosen, length), survivors)
        worth.values[survivors] = worth.told[survivors] + worth.share[survivors] * machine
    return worth.values, worth.background, worth.absent


def _rest_evidence(model: ShapeModel, one: Stretch) -> Array:
    """``(cells,)`` -1 where a person moves e times more than calm moments of what it looks like, 1 where e times less."""
    still, calm = motion_levels(model)
    reference = np.minimum(still, calm[one.contrast.argmax(axis=1)])
    return np.asarray(np.log(np.maximum(reference, 1e-30) / np.maximum(one.motion, 1e-30)).clip(-1.0, 1.0))


def _merge_segments(
    model: ShapeModel, one: Stretch, segments: list[TiledSegment], durations: Durations, length: int
) -> list[TiledSegment]:
    """Segments of one action that touch become one where it is a cycle, or where the performance has not ended there."""
    out: list[TiledSegment] = []
    for part in segments:
        before = out[-1] if out else None
        touch = before is not None and before.last == part.first and before.label == part.label
        cycle = durations.cyclic[part.label] > MIN_CYCLIC
        if before is not None and touch and (cycle or _continues(model, one, before, part, length)):
            longer = part.window if part.last - part.first > before.last - before.first else before.window
            out[-1] = TiledSegment(before.first, part.last, part.label, before.value + part.value, longer)
        else:
            out.append(part)
    return out


def _continues(model: ShapeModel, one: Stretch, before: TiledSegment, after: TiledSegment, length: int) -> bool:
    """Whether the pose between two segments is one from within the action, and not one that it begins or ends with."""
    seam = _heights(one.resample(np.array([before.window, after.window]), length).values.to(model.labels.device))
    mine = (model.labels == before.label).nonzero()[:, 0]
    shown = model.exemplars.crop(0)[mine].values
    if model.symmetry is not None:
        shown = torch.cat([shown, mirror(shown, model.symmetry)])
    exemplars = _heights(shown)
    exemplar = exemplars[(seam[:, None] - exemplars).square().mean(dim=(0, 2, 3)).argmin()]
    distance = ((seam[0, -1] + seam[1, 0]) / 2 - exemplar).square().mean(dim=1).sqrt()
    ends, within = (distance[0] + distance[-1]) / 2, distance[2:-2].min() if len(distance) > 4 else distance.max()
    return bool(ends > MIN_SEAM_RATIO * within)


def _heights(windows: torch.Tensor) -> torch.Tensor:
    """``(N, length, joints)`` above the middle of the body, in units of their deviation in the window."""
    up = windows[..., 1] - windows[..., 1].mean(dim=-1, keepdim=True)
    return up / up.square().mean(dim=(1, 2), keepdim=True).sqrt().clamp(min=1e-9)


def events_of(
    model: ShapeModel, one: Stretch, parts: Sequence[TiledSegment], values: Array, classes: Sequence[Any], length: int
) -> list[Event]:
    """Segments as they are told: score: mean contrast of their moments; margin: what they are worth above the next class."""
    if not parts:
        return []
    windows = one.resample(np.array([part.window for part in parts]), length).to(model.labels.device)
    residual = model.whole_residuals(windows, torch.arange(len(model.labels), device=model.labels.device))
    others = model.labels[None] != torch.tensor([part.label for part in parts], device=model.labels.device)[:, None]
    nearest = residual.masked_fill(others, torch.inf).argmin(dim=1).tolist()
    events = []
    for part, exemplar in zip(parts, nearest, strict=True):
        score = float(one.raw[part.first : part.last, part.label].mean())
        next_best = np.delete(values[part.window], part.label).max(initial=-np.inf)
        margin = float(values[part.window, part.label] - next_best) if np.isfinite(next_best) else 0.0
        start, end = one.lattice.edges[part.first], one.lattice.edges[part.last]
        events.append(Event(classes[part.label], float(start), float(end), score, margin, exemplar))
    return events


def _apply_level(model: ShapeModel, events: list[Event], rate: float | None) -> tuple[list[Event], list[Withheld]]:
    """Those events that reach the level that was asked for, and those that do not."""
    if rate is None:
        return events, []
    _, floor = event_levels(wrong_contrast(model), rate, 1.0, (-np.inf, -np.inf))
    high = [event for event in events if event.score >= floor]
    return high, [Withheld(event, "below the level") for event in events if event.score < floor]


# ----------------------------------------------------------------------------------------------------------------------
# The best explanation as segments that do not overlap, and how likely each frame belongs to each class.
#
# A recording is a row of ``n`` cells between ``n + 1`` edges.  A window is a run of cells that may be one segment of one class; a
# cell that lies in none is background.  An explanation's value is the sum of its segments' and of its background cells', so that
# dynamic programming over the edges finds the best one, a hidden semi-Markov model whose states are the classes:
# V_e = max(V_{e-1} + b_{e-1}, max_{(s,e),c} V_s + S_{(s,e),c}).
#
# Source: Ostendorf et al. 1996 (segment models); Sarawagi and Cohen 2004 (semi-Markov fields).


@dataclass(frozen=True)
class TiledSegment:
    """A run of cells, from edge ``first`` to edge ``last``, of one class (its number), what it is worth, and which window it is."""

    first: int
    last: int
    label: int
    value: float
    window: int


def best_tiling(windows: Array, values: Array, background: Array) -> tuple[list[TiledSegment], float]:
    """The segments of the best explanation, in order, and its value. windows ``(W, 2)``."""
    label = values.argmax(axis=1) if len(values) else np.empty(0, dtype=np.intp)
    best = values.max(axis=1) if len(values) else np.empty(0)
    total, chosen = _forward(windows, best, background)
    segments: list[TiledSegment] = []
    edge = len(background)
    while edge > 0:
        window = int(chosen[edge])
        if window < 0:
            edge -= 1
            continue
        segments.append(TiledSegment(int(windows[window, 0]), edge, int(label[window]), float(best[window]), window))
        edge = int(windows[window, 0])
    return segments[::-1], float(total[-1])


def through(windows: Array, values: Array, background: Array) -> Array:
    """``(W,)`` the value of the best explanation that holds each window."""
    best = values.max(axis=1)
    before, _ = _forward(windows, best, background)
    after = _backward(windows, best, background, soft=False)
    return np.asarray(before[windows[:, 0]] + best + after[windows[:, 1]])


def posterior(windows: Array, values: Array, background: Array, temperature: float) -> Array:
    r"""``(cells, classes)`` how likely each cell belongs to each class, 0..1; what is left to 1 is background."""
    cells, classes = len(background), values.shape[1]
    if not len(windows):
        return np.zeros((cells, classes))
    scaled, calm = values / temperature, background / temperature
    each = np.logaddexp.reduce(scaled, axis=1)
    before = _backward(cells - windows[::-1, ::-1], each[::-1], calm[::-1], soft=True)[::-1]
    after = _backward(windows, each, calm, soft=True)
    likely = np.exp(np.minimum(before[windows[:, 0], None] + scaled + after[windows[:, 1], None] - after[0], 0.0))
    change = np.zeros((cells + 1, classes))
    np.add.at(change, windows[:, 0], likely)
    np.add.at(change, windows[:, 1], -likely)
    return np.asarray(np.clip(np.cumsum(change, axis=0)[:cells], 0.0, 1.0))


def _forward(windows: Array, best: Array, background: Array) -> tuple[Array, Array]:
    """``(edges,)`` value of the best explanation up to each edge, and the window that ends it there (-1: a background cell)."""
    cells = len(background)
    bounds = np.searchsorted(windows[:, 1], np.arange(cells + 2))
    first = windows[:, 0]
    total, chosen = np.zeros(cells + 1), np.full(cells + 1, -1)
    for edge in range(1, cells + 1):
        total[edge] = total[edge - 1] + background[edge - 1]
        low, high = bounds[edge], bounds[edge + 1]
        if high > low:
            value = total[first[low:high]] + best[low:high]
            at = int(value.argmax())
            if value[at] > total[edge]:
                total[edge], chosen[edge] = value[at], low + at
    return total, chosen


def _backward(windows: Array, best: Array, background: Array, soft: bool) -> Array:
    """``(edges,)`` the value of the best explanation from each edge on; ``soft``: the logarithm of the sum of all."""
    cells = len(background)
    order = np.argsort(windows[:, 0], kind="stable")
    bounds = np.searchsorted(windows[order, 0], np.arange(cells + 2))
    last, best = windows[order, 1], best[order]
    total = np.zeros(cells + 1)
    for edge in range(cells - 1, -1, -1):
        low, high = bounds[edge], bounds[edge + 1]
        values = np.append(total[last[low:high]] + best[low:high], total[edge + 1] + background[edge])
        top = values.max()
        total[edge] = top + np.log(np.exp(values - top).sum()) if soft else top
    return total
