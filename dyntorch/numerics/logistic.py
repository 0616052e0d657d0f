"""A decision from several figures: a logistic regression, kept as a small table beside the code that asks it."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path


@dataclass(frozen=True)
class DecisionModel:
    r"""The probability :math:`1 / (1 + e^{-(b + \sum_i w_i f_i)})` that an answer is right, of figures f that are named."""

    names: tuple[str, ...]
    coefficients: tuple[float, ...]  # w, per unit of the figure
    usual: tuple[float, ...]  # the figures' means over right answers: what :meth:`against` measures from
    ranges: tuple[tuple[float, float], ...]  # within which a figure counts: beyond, nothing was learned
    intercept: float
    source: str  # date, trials and the command that trained it

    @staticmethod
    @cache
    def load(path: Path, name: str) -> DecisionModel:
        """One of the models of a file (JSON), as :func:`experiments.common.decisions.write` leaves it."""
        table = json.loads(path.read_text(encoding="utf-8"))
        one = table["models"][name]
        figures = one["figures"]
        return DecisionModel(
            tuple(figures),
            tuple(float(part["coefficient"]) for part in figures.values()),
            tuple(float(part["usual"]) for part in figures.values()),
            tuple((float(part["range"][0]), float(part["range"][1])) for part in figures.values()),
            float(one["intercept"]),
            str(table["source"]),
        )

    def _within(self, figures: Mapping[str, float]) -> list[float]:
        """The figures in the order of the names, those beyond their range at its end; NaN counts as usual."""
        values = zip(self.names, self.ranges, self.usual, strict=True)
        return [usual if math.isnan(figures[name]) else min(max(figures[name], low), high) for name, (low, high), usual in values]

    def log_odds(self, figures: Mapping[str, float]) -> float:
        """Of being right."""
        return self.intercept + sum(w * value for value, w in zip(self._within(figures), self.coefficients, strict=True))

    def probability(self, figures: Mapping[str, float]) -> float:
        """Of being right."""
        return 1 / (1 + math.exp(-max(min(self.log_odds(figures), 700.0), -700.0)))

    def against(self, figures: Mapping[str, float]) -> list[str]:
        """Names of the figures that lower the odds, against those of right answers, the most harmful one first."""
        harm = [w * (value - usual) for value, w, usual in zip(self._within(figures), self.coefficients, self.usual, strict=True)]
        return [name for lost, name in sorted(zip(harm, self.names, strict=True)) if lost < 0]
