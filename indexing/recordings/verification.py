"""Whether the events of a recording show the actions that they are told as, or other movement that was never learned.

Each event has log odds, those of a logistic regression of a few figures, and a recording has a share of events that are right,
which its events tell together: in a recording of squats a doubtful squat is one, in an hour of cooking it is none.

Source: Saerens, Latinne and Decaestecker 2002 (a classifier's outputs adjusted to new a priori probabilities).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from dyntorch.numerics import DecisionModel
from indexing.action.bank import Windows
from indexing.action.model import ShapeModel, class_scores, evidence

Array = NDArray[Any]

TABLE = Path(__file__).with_suffix(".json")
FIGURES = ("evidence", "gap", "gain", "motion")
PRIOR_EVENTS = 10.0  # of other movement that every recording counts as holding: what its own events must outweigh
NUM_STEPS = 50  # of expectation maximization
MAX_REFERENCES = 300  # exemplars that are asked as if they had not been learned
USUAL_DEVIATIONS = 5.0  # of wrong evidence, at which right one lies where no class has two exemplars
USUAL_GAP = 6.0  # between residuals to the own class and to the nearest other one, in the same case


@dataclass(frozen=True)
class References:
    """What events are measured by: evidence of wrong answers, how far above it right ones lie, and the same of residuals."""

    wrong: float
    evidence: float
    gap: float

    @classmethod
    def of(cls, model: ShapeModel) -> References:
        """From the exemplars, each asked without itself; kept."""
        found: References = model.cache.get("references", lambda: _references(model))
        return found


def _references(model: ShapeModel) -> References:
    known = (model.labels < model.num_known).nonzero()[:, 0]
    asked = known[:: -(-len(known) // MAX_REFERENCES)]
    query, own = model.exemplars.crop(0)[asked], model.labels[asked]
    each, rows = torch.arange(len(asked), device=asked.device), torch.arange(len(model.labels), device=asked.device)

    def scores(table: torch.Tensor) -> torch.Tensor:
        return class_scores(table.index_put((each, asked), table.new_tensor(torch.inf)), model.labels, model.classes)

    wrong, spread = float(model.evidence_out.mean()), float(model.evidence_out.std(correction=0))
    again = torch.bincount(model.labels, minlength=model.classes)[own] > 1  # only of these another exemplar is left
    if not bool(again.any()) or not np.isfinite(wrong):
        return References(wrong, max(USUAL_DEVIATIONS * spread, 1e-3), USUAL_GAP)
    near = scores(model.residuals(query))
    unusual = None
    if model.profiles is not None:
        alike = [scores(model.kernel_residuals(query))] if model.kernels is not None else []
        unusual = model.profiles.distance(torch.cat([near, *alike], dim=1), model.classes)
    right = evidence(near, model.classes, unusual, model.hidden)[again].mean()
    whole = scores(model.whole_residuals(query, rows))[again]
    mine = whole.gather(1, own[again, None])[:, 0]
    foreign = whole.scatter(1, own[again, None], -torch.inf).amax(dim=1)
    return References(wrong, max(float(right) - wrong, 3.0), max(float((mine - foreign).mean()), 1.0))


def figures_of(model: ShapeModel, windows: Windows, labels: Sequence[int], gain: Array, motion: Array) -> Array:
    """``(events, FIGURES)``, each event as if it had been cut out by hand.

    Args:
        labels: numbers of the events' classes; gain: what each is worth above background; motion: of its moments.
    """
    reference = References.of(model)
    said = (model.evidence(windows).cpu().numpy() - reference.wrong) / reference.evidence
    rows = torch.arange(len(model.labels), device=model.labels.device)
    scores = class_scores(model.whole_residuals(windows, rows), model.labels, model.classes)
    at = torch.tensor(labels, device=scores.device)[:, None]
    gap = scores.gather(1, at)[:, 0] - scores.scatter(1, at, -torch.inf).amax(dim=1)
    close = gap.cpu().numpy() / reference.gap
    return np.stack([said, close, np.log(np.maximum(gain, 0.1)), np.log(np.maximum(motion, 1e-3))], axis=1)


def log_odds(figures: Array) -> Array:
    """``(events,)`` that each is right, were half of all events right; other movement is above 0 once an hour, taken together
    with the rest of its recording (:func:`adapt`)."""
    model = DecisionModel.load(TABLE, "event")
    return np.array([model.log_odds(dict(zip(FIGURES, row, strict=True))) for row in figures.tolist()])


def adapt(odds: Array) -> Array:
    r"""``(events,)`` log odds of the events of one recording at the share :math:`\pi` of them that is right, which is estimated:
    :math:`\pi \leftarrow \sum_i p_i / (n + n_0)`, :math:`p_i` being the events' probabilities at the share before."""
    share = 0.5
    for _ in range(NUM_STEPS):
        likely = 1 / (1 + np.exp(-np.clip(odds + np.log(share / (1 - share)), -50.0, 50.0)))
        share = min(max(float(likely.sum()) / (len(odds) + PRIOR_EVENTS), 1e-6), 1 - 1e-6)
    return np.asarray(odds + np.log(share / (1 - share)))
