"""What seconds of an action find in the other actions, as if their own had never been learned: levels to refuse and to find by."""

from __future__ import annotations

from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from indexing import scoring
from indexing.phase.frames import Learned
from indexing.phase.model import PhaseModel
from indexing.stream import EXTENT

SECOND = 1.0  # seconds of a recording that scores are averaged over before events are cut from them
MOST, FRAMES = 120, 8  # seconds asked, spread over all clips, and frames of each: bounds the time of calibration
FEWEST = 3  # classes: among two, leaving one out leaves nothing to be nearer to
# Of `find`, on streams of synthetic actions by other people in other views, 13 / 6 of them learned from six clips each: recall
# .67 / .80 at 7 / 14 % false finds (rate .05: .58 / .80 at none; .3: .78 / .80 at 15 / 37 %)
FALSE_ALARMS = 0.1  # rate at which a wrong action may reach an event's peak
LEAST = (0.3, 0.0)  # of an event's peak and ends; at 0 a frame is as near to other actions' frames as to its own

Array = NDArray[Any]


def wrong_scores(model: PhaseModel, learned: Learned, label: Tensor) -> Tensor:
    """``(seconds,)`` the best mean score of training seconds in a model that their class was left out of.

    Args:
        learned: the frames of all clips; label: ``(clips,)``.
    """
    if len(model.courses) < FEWEST:
        return torch.zeros(0, dtype=torch.float64)
    whole = (learned.times / SECOND).floor().long()
    cuts = (learned.clip.diff() != 0) | (whole.diff() != 0)
    piece = torch.cat([cuts.new_zeros(1), cuts]).cumsum(0)
    found = []
    for c in range(len(model.courses)):
        mine = piece[label[learned.clip] == c].unique()
        asked = [_spread((piece == one).nonzero()[:, 0], FRAMES) for one in _spread(mine, max(1, MOST // len(model.courses)))]
        scores = model.without(c).evidence(learned.frames[torch.cat(asked)])[0]
        found += [part.mean(0).max() for part in scores.split([len(one) for one in asked])]
    return torch.stack(found)


def _spread(values: Tensor, most: int) -> Tensor:
    """At most so many, spread evenly."""
    return values[torch.linspace(0, len(values) - 1, min(most, len(values))).round().long()]


def event_levels(wrong: Tensor, rate: float | None) -> tuple[float, float]:
    """Scores that an event needs somewhere and throughout, for a rate of wrong actions that may reach them.

    Args:
        rate: 0.1 by default; a number outside 0..1 is the level itself.
    """
    return scoring.event_levels(wrong.cpu().numpy(), FALSE_ALARMS if rate is None else rate, EXTENT, LEAST)
