"""A recording explained by the actions of a model: as segments, one per performance, and frame by frame.

The stages: short windows say what each moment looks like (:mod:`indexing.action.stream`); windows of every duration that the
actions have say what a whole performance looks like (:mod:`indexing.recordings.evidence`); the best segments that do not overlap
are found by dynamic programming, in which rest and other movement have a value, too (:mod:`indexing.recordings.tiling`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from indexing.action.bank import Windows
from indexing.action.exemplars import moment_window
from indexing.action.model import ShapeModel
from indexing.action.stream import Progress, Stream, StreamScan, motion_levels, scan, wrong_contrast
from indexing.action.symmetry import mirror
from indexing.clip import Clip
from indexing.recordings.evidence import Array, Durations, Lattice, level, machine_scores, whole_scores
from indexing.recordings.explanation import Explanation, Reason, Withheld
from indexing.recordings.options import ExplanationOptions
from indexing.recordings.tiling import TiledSegment, best_tiling, posterior, through
from indexing.scoring import Event, event_levels
from indexing.windows import Ragged, ragged


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

    def cut(self, chosen: Array, length: int) -> Windows:
        """Some windows, resampled."""
        return self.lattice.cut(self.source, 0, chosen, length)


def explain(
    model: ShapeModel, clip: Clip, stream: Stream, classes: Sequence[Any], rate: float | None, progress: Progress = None
) -> Explanation:
    """The segments of a recording, and what they say of its frames."""
    options = model.options.recordings
    stream = dataclasses.replace(stream, window=moment_window(stream.window, model.exemplars.seconds, model.options.exemplars))
    durations = Durations.of(model, stream.window, 0.3 * stream.window, options)
    events = dataclasses.replace(model.options.events, step=min(model.options.events.step, stream.window / 4))
    finer = model.with_options(dataclasses.replace(model.options, events=events))
    moments = scan(finer, clip, stream, None if progress is None else lambda share: progress(0.5 * share))
    stretches = _stretches(model, clip, moments, durations, stream, progress)
    wholes = level(np.concatenate([one.whole.ravel() for one in stretches]) if stretches else np.zeros(0))
    scores = np.full((len(clip), model.classes), log_scores(np.zeros(1), options)[0])
    background = np.ones(len(clip))
    found: list[Event] = []
    held: list[Withheld] = []
    for one in stretches:
        values, calm, absent = segment_values(model, one, durations, wholes, stream.length, options)
        segments, _ = best_tiling(one.lattice.windows, values, calm)
        inside = posterior(one.lattice.windows, values, calm, options.temperature)
        first, end = one.frames
        cell = np.searchsorted(one.lattice.edges, clip.times[first:end] + options.edge, side="right") - 1
        cell = np.clip(cell, 0, len(inside) - 1)
        scores[first:end] = log_scores(inside, options)[cell]
        background[first:end] = 1.0 - inside.sum(axis=1).clip(0.0, 1.0)[cell]
        mine = _joined(model, one, segments, durations, stream.length)
        found += told_events(model, one, mine, values, classes, stream.length)
        # what would be there, did rest and absence count as movement, and is not
        awake = np.minimum(calm, options.background * _unit(one, durations))
        restless, _ = best_tiling(one.lattice.windows, values + absent, awake)
        silent = [part for part in _joined(model, one, restless, durations, stream.length) if not _meets(part, mine)]
        reasons: list[Reason] = ["nobody there" if not one.present[part.first : part.last].any() else "at rest" for part in silent]
        told = told_events(model, one, silent, values, classes, stream.length)
        held += [Withheld(event, reason) for event, reason in zip(told, reasons, strict=True)]
    found, low = _levelled(model, found, rate)
    if progress is not None:
        progress(1.0)
    held = sorted([*held, *low], key=lambda each: each.event.start)
    return Explanation(clip.times, tuple(classes), scores, found, held, background)


def log_scores(likely: Array, options: ExplanationOptions) -> Array:
    """Logarithms of likelihoods; below the least ones a shade tells classes apart."""
    return np.asarray(np.log(np.maximum(likely, options.least)) + options.shade * np.log(np.maximum(likely, options.faint)))


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
        lattice = Lattice.over(float(times[0]), float(times[-1]), durations, model.options.recordings)
        middle, at = (lattice.edges[1:] + lattice.edges[:-1]) / 2, moments.times[part]
        cells = np.stack([np.interp(middle, at, column) for column in contrast[part].T], axis=1)
        motion = np.interp(middle, at, moments.motion[part])
        present = np.interp(middle, at, moments.present[part].astype(float)) > 0.5
        source = ragged([clip.replace(joints=clip.joints[frames], times=times, confidence=None)])

        def cut(chosen: Array, lattice: Lattice = lattice, source: Ragged = source) -> Windows:
            return lattice.cut(source, 0, chosen, stream.length)

        whole = whole_scores(model, lattice, cut, durations, model.options.recordings)
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


def _worth(
    model: ShapeModel, one: Stretch, durations: Durations, wholes: tuple[float, float], options: ExplanationOptions
) -> _Worth:
    """A segment is worth its quality times its duration in ordinary exemplars, the likelihood of its duration, less what it costs
    to begin one."""
    lattice, cyclic = one.lattice, durations.cyclic[None].astype(np.float32)
    whole = np.nan_to_num((one.whole - wholes[0]) / wholes[1], nan=-2.0)
    unseen = options.absent * ~one.present
    rest = _rest(model, one)
    lasts = (lattice.seconds / durations.unit).astype(np.float32)[:, None]
    absent = lasts * lattice.mean(unseen[:, None])
    quality = options.moments * (1 + options.cyclic_moments * cyclic) * lattice.mean(one.contrast)
    # what moments say of cyclic actions counts more, so rest must, too
    quality -= options.rest * options.cyclic_moments * cyclic * lattice.mean(rest.clip(min=0.0)[:, None])
    weight = 1 - options.cyclic_whole * cyclic
    quality += options.whole * weight * whole
    prior = durations.likelihoods(lattice.seconds, model.labels.cpu().numpy(), options)
    told = lasts * quality + options.duration * prior - options.entry - absent
    share = options.machine * lasts * weight
    proxy = whole - whole.mean(axis=1, keepdims=True)
    proxy /= np.maximum(proxy.std(axis=1, keepdims=True), 1e-9)
    background = (options.background + options.rest * rest + unseen) * _unit(one, durations)
    return _Worth(told + share * proxy, told, share, background, absent)


def segment_values(
    model: ShapeModel, one: Stretch, durations: Durations, wholes: tuple[float, float], length: int, options: ExplanationOptions
) -> tuple[Array, Array, Array]:
    """``(W, classes)`` what windows are worth as segments of each class, ``(cells,)`` what background is worth, ``(W, 1)``
    what absence takes off."""
    worth = _worth(model, one, durations, wholes, options)
    if model.kernels is not None:
        total = through(one.lattice.windows, worth.values, worth.background)
        survivors = np.flatnonzero(total >= total.max() - options.survive)
        machine = machine_scores(model, lambda chosen: one.cut(chosen, length), survivors)
        worth.values[survivors] = worth.told[survivors] + worth.share[survivors] * machine
    return worth.values, worth.background, worth.absent


def _rest(model: ShapeModel, one: Stretch) -> Array:
    """``(cells,)`` -1 where a person moves e times more than calm moments of what it looks like, 1 where e times less."""
    still, calm = motion_levels(model)
    own = np.minimum(still, calm[one.contrast.argmax(axis=1)])
    return np.asarray(np.log(np.maximum(own, 1e-30) / np.maximum(one.motion, 1e-30)).clip(-1.0, 1.0))


def _joined(model: ShapeModel, one: Stretch, segments: list[TiledSegment], durations: Durations, length: int) -> list[TiledSegment]:
    """Segments of one action that touch become one where it is a cycle, or where the performance has not ended there."""
    options = model.options.recordings
    out: list[TiledSegment] = []
    for part in segments:
        before = out[-1] if out else None
        touch = before is not None and before.last == part.first and before.label == part.label
        cycle = durations.cyclic[part.label] > options.joined
        if before is not None and touch and (cycle or _goes_on(model, one, before, part, length)):
            longer = part.window if part.last - part.first > before.last - before.first else before.window
            out[-1] = TiledSegment(before.first, part.last, part.label, before.value + part.value, longer)
        else:
            out.append(part)
    return out


def _goes_on(model: ShapeModel, one: Stretch, before: TiledSegment, after: TiledSegment, length: int) -> bool:
    """Whether the pose between two segments is one from within the action, and not one that it begins or ends with."""
    seen = _heights(one.cut(np.array([before.window, after.window]), length).values.to(model.labels.device))
    mine = (model.labels == before.label).nonzero()[:, 0]
    shown = model.exemplars.crop(0)[mine].values
    if model.symmetry is not None:
        shown = torch.cat([shown, mirror(shown, model.symmetry)])
    known = _heights(shown)
    exemplar = known[(seen[:, None] - known).square().mean(dim=(0, 2, 3)).argmin()]
    apart = ((seen[0, -1] + seen[1, 0]) / 2 - exemplar).square().mean(dim=1).sqrt()
    ends, within = (apart[0] + apart[-1]) / 2, apart[2:-2].min() if len(apart) > 4 else apart.max()
    return bool(ends > model.options.recordings.seam * within)


def _heights(windows: torch.Tensor) -> torch.Tensor:
    """``(N, length, joints)`` above the middle of the body, in units of their deviation in the window."""
    up = windows[..., 1] - windows[..., 1].mean(dim=-1, keepdim=True)
    return up / up.square().mean(dim=(1, 2), keepdim=True).sqrt().clamp(min=1e-9)


def told_events(
    model: ShapeModel, one: Stretch, parts: Sequence[TiledSegment], values: Array, classes: Sequence[Any], length: int
) -> list[Event]:
    """Segments as they are told: score: mean contrast of their moments; margin: what they are worth above the next class."""
    if not parts:
        return []
    windows = one.cut(np.array([part.window for part in parts]), length).to(model.labels.device)
    residual = model.whole_residuals(windows, torch.arange(len(model.labels), device=model.labels.device))
    others = model.labels[None] != torch.tensor([part.label for part in parts], device=model.labels.device)[:, None]
    nearest = residual.masked_fill(others, torch.inf).argmin(dim=1).tolist()
    found = []
    for part, exemplar in zip(parts, nearest, strict=True):
        score = float(one.raw[part.first : part.last, part.label].mean())
        next_best = np.delete(values[part.window], part.label).max(initial=-np.inf)
        margin = float(values[part.window, part.label] - next_best) if np.isfinite(next_best) else 0.0
        start, end = one.lattice.edges[part.first], one.lattice.edges[part.last]
        found.append(Event(classes[part.label], float(start), float(end), score, margin, exemplar))
    return found


def _meets(part: TiledSegment, others: Sequence[TiledSegment]) -> bool:
    """Whether a segment shares any cell with some others."""
    return any(min(part.last, other.last) > max(part.first, other.first) for other in others)


def _levelled(model: ShapeModel, found: list[Event], rate: float | None) -> tuple[list[Event], list[Withheld]]:
    """Those events that reach the level that was asked for, and those that do not."""
    if rate is None:
        return found, []
    _, floor = event_levels(wrong_contrast(model), rate, 1.0, (-np.inf, -np.inf))
    high = [event for event in found if event.score >= floor]
    return high, [Withheld(event, "below the level") for event in found if event.score < floor]
