"""How sure an answer is: the probability that the best class of a query is the right one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dyntorch.numerics import DecisionModel
from indexing.action.bank import Windows
from indexing.action.model import NEAREST_WEIGHT, ShapeModel
from indexing.scoring import sharpen

Array = NDArray[Any]

TABLE = Path(__file__).with_suffix(".json")
FIGURES = ("margin", "gap", "kernel_gap")


def confidence_figures(model: ShapeModel, query: Windows, scores: Tensor, nearest: Tensor) -> Array:
    """``(Q, FIGURES)`` how far the best class stands above the next one: in the blended scores, and in what the nearest exemplars
    of each are away by residual and by kernel; NaN where a model has no such scorer. scores, nearest ``(Q, classes)``."""
    at = scores.argmax(dim=1, keepdim=True)

    def margin(table: Tensor) -> Array:
        return np.asarray((table.gather(1, at) - table.scatter(1, at, -torch.inf).amax(dim=1, keepdim=True))[:, 0].cpu().numpy())

    none = np.full(len(scores), np.nan)
    unit = (1.0 + NEAREST_WEIGHT) / max(model.blend.kernel + model.blend.nearest, 1e-9)
    blended = unit * margin(scores) if model.scorer == "both" else none
    return np.stack([blended, margin(nearest), none if model.kernels is None else margin(model.kernel_scores(query))], axis=1)


def class_probabilities(model: ShapeModel, query: Windows) -> Array:
    """``(Q, classes)`` of all classes, background too; rows sum to 1, and the best class is that of the scores."""
    nearest = model.nearest_scores(query)
    scores = model.scores(query, nearest)
    table = DecisionModel.load(TABLE, "answer")
    rows = confidence_figures(model, query, scores, nearest).tolist()
    sure = np.array([table.probability(dict(zip(FIGURES, row, strict=True))) for row in rows])
    return sharpen(scores.cpu().numpy().astype(float), sure)
