r"""Which parts of recordings to label next: those that are unlike what is known.

The stages: recordings are cut into parts, one per performance that was found and of what lies between them (:func:`parts_of`);
each part is compared with all that is known and with all others, by the residual of the indexer, which does not see from where a
camera looks (:func:`compare_parts`); parts are chosen one after the other, each the one that would leave the least that is unlike
everything known (:func:`select_parts`). With :math:`r_{ij}` the residual between two parts, :math:`k_j` that of part :math:`j` to
the nearest example, :math:`C` what was chosen before, and :math:`D_j = \min(k_j, \min_{i \in C} r_{ij})`, the next one is

.. math:: \arg\max_i \sum_j \max(D_j - r_{ij}, 0) .

A part that nothing else is like counts for itself; one that is like ten others counts for all of them, once.

Source: Nemhauser, Wolsey and Fisher 1978 (greedy coverage is within 1 - 1/e of the best).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from dyntorch.numerics import one_thread
from indexing.action.bank import NEAREST, Bank, Copy, Windows, fused_residuals, planes_of, stack
from indexing.action.inputs import check_queries
from indexing.action.stream import motion_levels, motion_of
from indexing.clip import Clip, stretches
from indexing.recordings.evidence import Durations
from indexing.scoring import probabilities
from indexing.windows import concatenate_clips, repair_clip, sample

if TYPE_CHECKING:
    from indexing.action.indexer import ActionIndexer
    from indexing.recordings.decoding import Explanation

Array = NDArray[Any]
Span = tuple[float, float]
SuggestReason = Literal["unlike what is known", "either of two", "much else is like it"]


MAX_CANDIDATES = 600  # parts that are compared with each other, spread evenly over the recordings: some 2 s for all pairs
MIN_PART_SECONDS = 1.0  # of what nothing explains: of less nobody can say what it is
MAX_EVENT_LENGTH = 2.0  # ordinary examples, beyond which an event is cut: a wrong one may hold several actions
MAX_LABELLED_SHARE = 0.3  # of a part, from which on it is not suggested again
MIN_MOTION = 0.5  # times that of still moments of the examples
MIN_SHOWN_SHARE = 0.5  # of a part's frames that must show the person
# of that between examples of different actions: known actions of actors stand at .03 to .05, others at .45 to .6
MIN_UNLIKE_RESIDUAL = 0.33
MAX_DOUBT_MARGIN = 0.5  # difference of probabilities, below which a part may be either of two actions


@dataclass(frozen=True)
class Suggestion:
    """A part of a recording that is worth a label."""

    recording: int
    start: float
    end: float
    guess: Any
    other: Any
    margin: float
    unlike: float
    reason: SuggestReason


@dataclass(frozen=True, eq=False)
class RecordingParts:
    """RecordingParts of recordings, and what is known of them."""

    owner: Array
    spans: Array
    windows: Windows
    worth: Array


@one_thread
def suggest(
    indexer: ActionIndexer,
    clips: Sequence[Clip],
    number: int = 10,
    labelled: Sequence[Sequence[Span]] | None = None,
    progress: Callable[[float], None] | None = None,
) -> list[Suggestion]:
    """The parts of recordings that are worth a label most, in the order in which they were chosen.

    Args:
        indexer: fitted; clips: recordings of one person each; number: how many, at most.
        labelled: for each recording the spans (seconds) that are labelled already; they are not suggested again.
        progress: called with the share done, 0..1.

    Raises:
        ValueError: a number that is not positive, or recordings that the indexer cannot read.

    Example:
        >>> from indexing import ActionIndexer
        >>> from indexing.actors import Person, dataset, detect, stream
        >>> known = dataset([Person()], ["squat", "wave"], azimuth=0, rng=0)
        >>> scene, truth = stream(["squat", "kick", "wave"], Person(), rng=3)
        >>> found = suggest(ActionIndexer().fit(known, known.labels), [detect(scene, azimuth=0, rng=3)], 1)
        >>> _, start, end = truth[1]
        >>> min(found[0].end, end) - max(found[0].start, start) > 0.5, found[0].reason
        (True, 'unlike what is known')
    """
    if number < 1:
        raise ValueError(f"number={number}: suggests nothing; give 1 or more")
    pooled = []
    for index, clip in enumerate(clips):
        done = [] if labelled is None else labelled[index]
        pooled.append(parts_of(indexer, clip, done))
        if progress is not None:
            progress(0.9 * (index + 1) / len(clips))
    parts = _pool_parts(pooled)
    if parts is None:
        return []
    classes = indexer.classes_.tolist()
    likely, near, apart, usual = compare_parts(indexer, parts.windows)
    ranked = np.argsort(-likely, axis=1, kind="stable")
    best = np.take_along_axis(likely, ranked, axis=1)
    margin = best[:, 0] - best[:, 1] if best.shape[1] > 1 else np.ones(len(best))
    out = []
    for at in select_parts(near, apart, number):
        names = [classes[which] if which < len(classes) else None for which in ranked[at, :2].tolist()]
        reason: SuggestReason = "much else is like it"
        if near[at] >= MIN_UNLIKE_RESIDUAL * usual:
            reason = "unlike what is known"
        elif margin[at] < MAX_DOUBT_MARGIN and None not in names and len(names) > 1:
            reason = "either of two"
        start, end = parts.spans[at].tolist()
        other = names[1] if len(names) > 1 else None
        out.append(Suggestion(int(parts.owner[at]), start, end, names[0], other, float(margin[at]), float(near[at]), reason))
    return out


def parts_of(indexer: ActionIndexer, clip: Clip, labelled: Sequence[Span]) -> RecordingParts | None:
    """A recording cut into parts; None where there are none."""
    model = indexer.model_
    (image,) = check_queries([clip], indexer.fps, indexer.n_joints_, indexer.skeleton_, recordings=True)
    begin = float(image.times[0])
    image = image.replace(times=image.times - begin)
    unit = Durations.of(model, indexer.window, 0.3 * indexer.window).unit
    spans = np.array(_cut_parts(indexer.decode(clip), clip, max(unit, MIN_PART_SECONDS))).reshape(-1, 2)
    spans = spans[[_share(span, labelled) < MAX_LABELLED_SHARE for span in spans.tolist()]]
    if not len(spans):
        return None
    source = concatenate_clips([repair_clip(image) if indexer.repair else image])
    nobody = np.zeros(len(spans), dtype=np.intp)
    values = sample(source, nobody, spans[:, 0] - begin, spans[:, 1] - begin, indexer.length)
    windows = Windows(values, torch.from_numpy(source.seen[nobody]))
    still, _ = motion_levels(model)
    shown = np.concatenate([[0.0], np.cumsum(clip.seen.any(axis=1))])
    first, last = np.searchsorted(clip.times, spans[:, 0]), np.searchsorted(clip.times, spans[:, 1], side="right")
    seen = (shown[last] - shown[first]) / np.maximum(last - first, 1)
    worth = (motion_of(windows) > MIN_MOTION * still) & (seen >= MIN_SHOWN_SHARE) & (last - first > 1)
    return RecordingParts(nobody, spans, windows, worth)


def _cut_parts(explanation: Explanation, clip: Clip, unit: float) -> list[Span]:
    """Spans of what was found, and of what lies between, in seconds of the recording's clock."""
    out: list[Span] = []
    spans = sorted((event.start, event.end) for event in explanation.events)
    for first, end in stretches(clip.times).tolist():
        edge, last = float(clip.times[first]), float(clip.times[end - 1])
        inside = [(max(a, edge), min(b, last)) for a, b in spans if b > edge and a < last]
        for start, stop in [*inside, (last, last)]:
            if start - edge >= unit / 2:
                out += _pieces(edge, start, unit)
            if stop > start:
                out += _pieces(start, stop, unit) if stop - start > MAX_EVENT_LENGTH * unit else [(start, stop)]
            edge = max(edge, stop)
    return out


def _pieces(start: float, end: float, unit: float) -> list[Span]:
    """A span in parts of about the same length."""
    edges = np.linspace(start, end, max(1, round((end - start) / unit)) + 1).tolist()
    return list(pairwise(edges))


def _share(span: Sequence[float], others: Sequence[Span]) -> float:
    """Of a span, what others cover; those do not overlap much, as a rule."""
    start, end = span
    return sum(max(0.0, min(end, b) - max(start, a)) for a, b in others) / max(end - start, 1e-9)


def _pool_parts(recordings: Sequence[RecordingParts | None]) -> RecordingParts | None:
    """The parts of all recordings that are worth anything, thinned out evenly where they are too many to be compared."""
    several = [(number, parts) for number, parts in enumerate(recordings) if parts is not None and parts.worth.any()]
    if not several:
        return None
    owner = np.concatenate([np.full(int(parts.worth.sum()), number) for number, parts in several])
    spans = np.concatenate([parts.spans[parts.worth] for _, parts in several])
    windows = stack([parts.windows[torch.from_numpy(parts.worth)] for _, parts in several])
    selected = np.unique(np.linspace(0, len(owner) - 1, MAX_CANDIDATES).round().astype(np.intp))
    return RecordingParts(owner[selected], spans[selected], windows[torch.from_numpy(selected)], np.ones(len(selected), dtype=bool))


def compare_parts(indexer: ActionIndexer, windows: Windows) -> tuple[Array, Array, Array, float]:
    """``(N, classes)`` probabilities, ``(N,)`` residual to the nearest example, ``(N, N)`` residuals between parts, and how
    far examples of different actions are apart, which is far."""
    model = indexer.model_
    likely = probabilities(model.scores(windows).cpu().numpy())
    exemplars = model.exemplars.crop(0)
    everything = stack([exemplars, windows])
    copies = [Copy(everything)]
    if model.symmetry is not None and bool(model.mirrored.any()):
        copies.append(Copy(everything, None, model.symmetry))
    (table,) = fused_residuals(everything, [Bank(copies, planes_of(model.metric))], [("epi",)])
    residual = np.exp(table.cpu().numpy() / len(NEAREST))
    count = len(exemplars)
    labels = model.labels.cpu().numpy()
    others = np.where(labels[:, None] != labels[None], residual[:count, :count], np.inf).min(axis=1)
    finite = others[np.isfinite(others)]
    return likely, residual[count:, :count].min(axis=1), residual[count:, count:], float(np.median(finite)) if len(finite) else 1.0


def select_parts(near: Array, apart: Array, number: int) -> list[int]:
    """Numbers of parts, one after the other: each leaves the least that is unlike what is known and what was chosen before.
    near ``(N,)``."""
    distance, out = near.astype(np.float64), list[int]()
    while len(out) < min(number, len(near)):
        gain = np.maximum(distance[:, None] - apart, 0.0).sum(axis=0)
        gain[out] = -np.inf
        out.append(int(gain.argmax()))
        distance = np.minimum(distance, apart[:, out[-1]])
    return out
