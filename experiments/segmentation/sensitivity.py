"""How much the segmentation depends on its own constants, and whether they were fitted to the pairs that they are judged by.

    DYNTORCH_DATA=../shared/data python -m experiments.segmentation.sensitivity
    DYNTORCH_DATA=../shared/data python -m experiments.segmentation.sensitivity --quick

One constant at a time is changed, the others keep their values (25 minutes).  Errors are misclassifications as in
``experiments.segmentation.segmentation``.  The constants of :func:`dyntorch.segment` were chosen while looking at these
recordings, as one set
for both; the last rows say what that is worth: for every pair of AdelaideRMF the setting with the least mean error on the *other*
pairs is taken, and for every sequence of Hopkins155 that with the least on the other sequences (a sequence and its pairs of bodies
are one).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Annotated, Any
from unittest.mock import patch

import tyro

from dyntorch.tasks.segment import coherence
from dyntorch.tasks.segment import energy as bodies_energy
from dyntorch.tasks.segment import labels as bodies_labels
from dyntorch.tasks.segment import search as bodies_descent
from dyntorch.tasks.segment import search as bodies_pool
from dyntorch.tasks.segment import segment as bodies_count
from dyntorch.tasks.segment import segment as bodies_problem
from experiments.benchmarks.interleaved import threads
from experiments.common.tables import NoiseConfig, Row, aligned, command, measured
from experiments.recognition.protocol import data_folder
from experiments.segmentation.data import hopkins_pairs, motion_pairs
from experiments.segmentation.segmentation import left_out, segmented

VARIED: tuple[tuple[Any, str, tuple[float, ...]], ...] = (
    (bodies_labels, "OUTLIER", (0.7, 1.4)),
    (bodies_labels, "STRANGE", (1.5, 4.0)),
    (bodies_labels, "CONFORMING", (0.15, 0.35)),
    (bodies_labels, "FOUND", (3.0, 9.0)),
    (bodies_energy, "NOISE", (0.5, 1.0)),
    (bodies_energy, "CAP", (3.0, 6.0)),
    (bodies_energy, "CUT", (3.0, 5.0)),
    (bodies_energy, "PARALLAX", (0.1, 0.3)),
    (bodies_count, "PENALTY", (3.5, 5.5)),
    (bodies_pool, "SMOOTH", (2.0, 4.5)),
    (bodies_descent, "FINE", (0.35, 0.7)),
    (bodies_problem, "NEIGHBOURLY", (2.0, 4.5)),
    (bodies_problem, "LINKED", (0.2, 0.4)),
    (coherence, "TOLERANCE", (0.5, 0.9)),
    (coherence, "EDGE_TOLERANCE", (0.35, 0.7)),
)
USED = {"SMOOTH": (bodies_pool, bodies_descent), "CUT": (bodies_energy,), "PENALTY": (bodies_count, bodies_problem)}
"""Modules that hold a constant under its name, where they are several."""
DEFAULT = "as shipped"


@dataclass(frozen=True)
class Config(NoiseConfig):
    """The constants of the segmentation, one at a time, on the recordings in the folder DYNTORCH_DATA."""

    scenes: int = 3
    """Seeds per pair of AdelaideRMF."""
    quick: bool = False
    """Three constants."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")] = Path("results/segmentation_sensitivity.json")
    """Where the results and this configuration are written as JSON."""


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


def changed(module: Any, name: str, value: float) -> tuple[Any, ...]:
    """Patches that change a constant everywhere it is used."""
    return tuple(patch.object(where, name, value) for where in USED.get(name, (module,)))


def sensitivity(config: Config) -> list[Row]:
    """Every setting, and what choosing among them on other recordings gives."""
    first, second = {DEFAULT: adelaide(config.scenes)}, {}
    second[DEFAULT], share = hopkins()
    shares = {DEFAULT: share}
    for module, name, values in VARIED[:: 5 if config.quick else 1]:
        for value in values:
            setting = f"{name.lower()} {value:g}"
            patches = changed(module, name, value)
            for each in patches:
                each.start()
            first[setting] = adelaide(config.scenes)
            second[setting], shares[setting] = hopkins()
            for each in patches:
                each.stop()
    mean = {setting: (fmean(first[setting].values()), fmean(second[setting].values()), shares[setting]) for setting in first}
    lines = [(setting, *(f"{figure:.2f}" for figure in figures)) for setting, figures in mean.items()]
    print(aligned(("constant", "AdelaideRMF, K unknown, %", "Hopkins155, K known, %", "Hopkins155, K right, %"), lines))
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
    return rows


def run(config: Config) -> None:
    """Print the table, then write the file.

    Raises:
        ValueError: no data folder, or a file that cannot be written.
    """
    data_folder()
    target = config.target()
    with threads(1):
        measured(["The constants of the segmentation, one at a time"], lambda _: sensitivity(config), target, vars(config))


if __name__ == "__main__":
    command(lambda: run(tyro.cli(Config, prog="python -m experiments.segmentation.sensitivity")))
