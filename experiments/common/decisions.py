"""Training of decisions: a logistic regression of figures, cross-validated over groups, and how well its probabilities hold."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.linear_model import LogisticRegression
from sklearn.model_selection import GroupKFold, cross_val_predict
from sklearn.pipeline import Pipeline, make_pipeline
from sklearn.preprocessing import StandardScaler

from experiments.common.tables import COLOURS
from indexing.report.canvas import LIGHT, new_figure, png, style

Floats = NDArray[np.float64]

FOLDS = 5
"""Of the cross-validation."""
TAIL = 0.005
"""Share of the trials at either end of a figure that counts no more than the trial at that end."""
BINS = 10
"""Of the reliability diagram, of equal width."""


@dataclass(frozen=True)
class Trained:
    """A model, and what it says of trials that it was not trained on.

    Attributes:
        table: of a file for :class:`dyntorch.numerics.logistic.DecisionModel`.
        probabilities: ``(trials,)`` each by a model of the other groups.
    """

    table: dict[str, Any]
    probabilities: Floats


def train(
    names: Sequence[str], figures: Floats, right: NDArray[np.bool_], groups: Sequence[Any], weights: Floats | None = None, *,
    strength: float = 1.0,
) -> Trained:  # fmt: skip
    """Figures ``(trials, k)``, whether each answer is right, and the person or recording of each; ``strength`` is 1 / ridge."""
    ranges = np.nanquantile(np.where(np.isfinite(figures), figures, np.nan), (TAIL, 1 - TAIL), axis=0)
    usual = np.nanmean(figures[right].clip(*ranges), axis=0)
    figures = np.where(np.isnan(figures), usual, figures).clip(*ranges)
    model = make_pipeline(StandardScaler(), LogisticRegression(C=strength, max_iter=2000))
    more = {"logisticregression__sample_weight": weights}
    told = cross_val_predict(model, figures, right, groups=groups, cv=GroupKFold(FOLDS), method="predict_proba", params=more)
    return Trained(_table(model.fit(figures, right, **more), names, usual, ranges), told[:, 1])


def _table(model: Pipeline, names: Sequence[str], usual: Floats, ranges: Floats) -> dict[str, Any]:
    """Coefficients per unit of each figure."""
    scaler, regression = model[0], model[1]
    per_unit = regression.coef_[0] / scaler.scale_
    intercept = float(regression.intercept_[0] - per_unit @ scaler.mean_)
    parts = {
        name: {"coefficient": round(float(w), 6), "usual": round(float(mean), 6), "range": [round(float(x), 6) for x in ends]}
        for name, w, mean, ends in zip(names, per_unit, usual, ranges.T, strict=True)
    }
    return {"intercept": round(intercept, 6), "figures": parts}


def write(path: Path, source: str, models: Mapping[str, dict[str, Any]]) -> None:
    """A file of models; ``source`` is date, trials and command."""
    path.write_text(json.dumps({"source": source, "models": dict(models)}, indent=1) + "\n", encoding="utf-8")


def reliability(told: Floats, right: NDArray[np.bool_], weights: Floats | None = None) -> list[tuple[float, float, float]]:
    """Mean probability, frequency and weight of each bin that holds trials."""
    weights = np.ones(len(told)) if weights is None else weights
    place = np.minimum((told * BINS).astype(int), BINS - 1)
    found = []
    for one in range(BINS):
        w = weights * (place == one)
        if w.sum() > 0:
            found.append((float(w @ told / w.sum()), float(w @ right / w.sum()), float(w.sum())))
    return found


def calibration_error(told: Floats, right: NDArray[np.bool_], weights: Floats | None = None) -> float:
    """Mean difference of probability and frequency over the bins, by the trials in each."""
    rows = reliability(told, right, weights)
    return sum(w * abs(p - f) for p, f, w in rows) / sum(w for *_, w in rows)


def reliability_diagram(curves: Mapping[str, tuple[Floats, NDArray[np.bool_]]]) -> bytes:
    """PNG: frequency beside probability, a curve per name; marks grow with the trials behind them."""
    with style(LIGHT):
        figure = new_figure(5.0, 4.2)
        axes = figure.subplots()
        axes.plot([0, 1], [0, 1], color=LIGHT.line, linewidth=1.0)
        for colour, (name, (told, right)) in zip(COLOURS, curves.items(), strict=False):
            rows = reliability(told, right)
            axes.plot([p for p, _, _ in rows], [f for _, f, _ in rows], color=colour, linewidth=1.0, label=name)
            axes.scatter([p for p, _, _ in rows], [f for _, f, _ in rows], s=[8 + 4 * w**0.5 for *_, w in rows], color=colour)
        axes.set_xlabel("probability told")
        axes.set_ylabel("share that is right")
        axes.grid(color=LIGHT.line, linewidth=0.5)
        axes.legend(frameon=False, fontsize=8)
        figure.tight_layout()
        return png(figure)
