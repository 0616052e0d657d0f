"""What exemplars find in wrong actions: levels for rejecting and for events, and whether left and right are different here."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from indexing.brightness.library import Exemplars
from indexing.brightness.live import BrightnessStream, Recognizer
from indexing.brightness.pooling import mirrored
from indexing.scoring import Event, event_levels, events
from indexing.stream import EXTENT, FALSE_ALARMS

MOST = 64  # exemplars asked: bounds the time of calibration
QUIET = 0.7  # of a frame's energy: below, nothing moves
LEAST = 0.02  # contrast that an event needs: two or three classes have little to stand out from
CLEAR = 0.02  # of the score: mirrored exemplars that look that much more like another action make left and right matter

Array = NDArray[Any]


def wrong_evidence(source: Recognizer, exemplars: Exemplars) -> tuple[torch.Tensor, Array]:
    """What exemplars find in other actions: the evidence of each ``(videos,)``, the contrast of moving frames ``(frames,)``."""
    best, contrasts = [], []
    for i in _asked(exemplars):
        stream, seen = _fresh(source), exemplars.videos()[i]
        label = int(exemplars.labels[i])
        scores, energy = stream.compare(seen.to(source.optics.device))
        others = np.delete(scores, label, axis=1)[energy >= QUIET]
        contrasts.append(others.max(axis=1) - others.mean(axis=1))
        best.append(float(np.delete(stream.whole.mean(), label).max()))
    return torch.tensor(best), np.concatenate(contrasts)


def mirrors_matter(source: Recognizer, exemplars: Exemplars) -> bool:
    """Whether some exemplar's mirror image looks clearly more like another action than like its own.

    Args:
        source: without mirrored exemplars.
    """
    for i in _asked(exemplars):
        stream, seen = _fresh(source), exemplars.videos()[i]
        stream.compare(mirrored(seen).to(source.optics.device))
        scores = stream.whole.mean()
        label = int(exemplars.labels[i])
        if float(scores.max() - scores[label]) > CLEAR:
            return True
    return False


def found_events(scores: Array, times: Array, energy: Array, classes: Array, wrong: Array, rate: float | None) -> list[Event]:
    """Events of scored frames: where the contrast of the best class exceeds what wrong actions reach at a rate."""
    contrast = scores - scores.mean(axis=1, keepdims=True)
    peak, floor = event_levels(wrong, FALSE_ALARMS if rate is None else rate, EXTENT, (LEAST, LEAST))
    return events(contrast, times, classes.tolist(), peak, floor, energy < QUIET)


def _asked(exemplars: Exemplars) -> list[int]:
    """Exemplars to ask, spread over all of them."""
    count = len(exemplars.labels)
    return sorted({round(i) for i in np.linspace(0, count - 1, min(count, MOST))})


def _fresh(source: Recognizer) -> BrightnessStream:
    return BrightnessStream(source, len(source.library.bounds) - 1, "exemplar", None)
