"""How much the segmentation depends on its own constants, and whether they were fitted to the pairs that they are judged by.

    DYNTORCH_DATA=../shared/data python -m experiments.segmentation.sensitivity
    DYNTORCH_DATA=../shared/data python -m experiments.segmentation.sensitivity --quick

One constant at a time is changed, the others keep their values (25 minutes).  Errors are misclassifications as in
``experiments.segmentation.segmentation``.  Those of :func:`dyntorch.segment` were chosen while looking at these recordings, as one
set for both; the last rows say what that is worth: for every pair of AdelaideRMF the setting with the least mean error on the
*other* pairs is taken, and for every sequence of Hopkins155 that with the least on the other sequences (a sequence and its pairs
of bodies are one).
"""

from __future__ import annotations

from statistics import fmean
from types import ModuleType
from unittest.mock import patch

from dyntorch.tasks.segment import coherence, labels, search
from dyntorch.tasks.segment import segment as two_views
from experiments.common.runner import SceneConfig, Tables, Words, experiment
from experiments.common.tables import Row
from experiments.segmentation.data import hopkins_pairs, motion_pairs
from experiments.segmentation.segmentation import left_out, segmented

VARIED: tuple[tuple[ModuleType, str, tuple[float, float]], ...] = (
    (labels, "OUTLIER_COST", (0.7, 1.4)),
    (labels, "NONCONFORMITY_COST", (1.5, 4.0)),
    (labels, "FREE_CONFORMITY", (0.15, 0.35)),
    (labels, "ASSIGNMENT_GAIN", (3.0, 9.0)),
    (coherence, "SAMPSON_NOISE_PIXELS", (0.5, 1.0)),
    (coherence, "ENERGY_MAX_SQUARED_DISTANCE", (3.0, 6.0)),
    (coherence, "CUT_COST", (3.0, 5.0)),
    (coherence, "PARALLAX_WEIGHT", (0.1, 0.3)),
    (two_views, "BODY_PENALTY", (3.5, 5.5)),
    (search, "POOL_CUT_COST", (2.0, 4.5)),
    (search, "DESCENT_NOISE_PIXELS", (0.35, 0.7)),
    (two_views, "MATCH_NOISE_PIXELS", (2.0, 4.5)),
    (two_views, "MIN_LINK_WEIGHT", (0.2, 0.4)),
    (coherence, "DEVIATION_TOLERANCE", (0.5, 0.9)),
    (coherence, "EDGE_TOLERANCE", (0.35, 0.7)),
)
"""Module, constant, and the values that it takes besides its own."""
DEFAULT = "as shipped"


Errors = dict[str, float]
"""Percent by the name of a pair."""


def adelaide(seeds: int) -> Errors:
    """Mean errors of the pairs, number of bodies unknown."""
    return {pair.name: fmean(segmented(pair, seed=seed).error for seed in range(seeds)) for pair in motion_pairs()}


def hopkins() -> tuple[Errors, float]:
    """Mean errors of every other sequence, number of bodies known, by sequence; and how often the number is found."""
    pairs = hopkins_pairs()[::2]
    errors: dict[str, list[float]] = {}
    for pair in pairs:
        errors.setdefault(pair.name.split("_g")[0], []).append(segmented(pair, pair.bodies).error)
    right = fmean(segmented(pair).bodies == pair.bodies for pair in pairs)
    return {name: fmean(found) for name, found in errors.items()}, 100 * right


@experiment(SceneConfig(scenes=3))
def tables(config: SceneConfig) -> Tables:
    """The constants of the segmentation, one at a time; quick: three of them.  Scenes are seeds per pair of AdelaideRMF."""
    module, name, _ = VARIED[0]
    settings = [(DEFAULT, module, name, getattr(module, name))]
    for module, name, values in VARIED[:: 5 if config.quick else 1]:
        settings += [(f"{name} {value:g}", module, name, value) for value in values]
    first, second, shares = {}, {}, {}
    for setting, module, name, value in settings:
        with patch.object(module, name, value):
            first[setting] = adelaide(config.scenes)
            second[setting], shares[setting] = hopkins()
    mean = {setting: (fmean(first[setting].values()), fmean(second[setting].values()), shares[setting]) for setting in first}
    lines = [(setting, *(f"{figure:.2f}" for figure in figures)) for setting, figures in mean.items()]
    head = ("constant", "AdelaideRMF, K unknown, %", "Hopkins155, K known, %", "Hopkins155, K right, %")
    yield "The constants of the segmentation, one at a time", Words(head, lines)
    rows = []
    for column, (task, goal) in enumerate((("AdelaideRMF, K unknown", 1.0), ("Hopkins155, K known", 2.0))):
        figures = [found[column] for found in mean.values()]
        left = left_out((first, second)[column])
        rows += [
            Row(task, DEFAULT, mean[DEFAULT][column], goal, at_most=True, unit=" %"),
            Row(task, f"least of {len(figures)} settings", min(figures), unit=" %"),
            Row(task, f"greatest of {len(figures)} settings", max(figures), goal, at_most=True, unit=" %"),
            Row(task, "setting chosen on the others", left, goal, at_most=True, unit=" %"),
        ]
    yield "Beside the goals", rows
