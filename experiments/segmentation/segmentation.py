"""Segmentation of two views into bodies: AdelaideRMF's moved objects, and the first and last frame of Hopkins155 sequences.

    DYNTORCH_DATA=../shared/data python -m experiments.segmentation.segmentation
    DYNTORCH_DATA=../shared/data python -m experiments.segmentation.segmentation --quick

Errors are misclassifications: the share of matches, wrong ones included, whose label is not the true one under the best assignment
of the bodies found; a wrong match must be labelled so, and a good one must not.  :func:`dyntorch.segment` runs with its default
parameters, the same for both sets, on one thread.

**AdelaideRMF** does not say the number of bodies.  Each pair is segmented once per seed.  The threshold is the one parameter that
a user sets; the cross-validated row takes for every pair the threshold (of a few) with the least mean error on the other pairs.
Figures of other methods are published ones; nothing of theirs was run here (experiments.benchmarks.segmentation runs some).

**Hopkins155** has no wrong matches; a track that is labelled one counts as an error.  The groups: cars on roads filmed by hand, and
checkerboards on turning and shifted boards (1R*).
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, median, pstdev
from typing import Any

import torch

import dyntorch as dyn
from dyntorch.metrics import misclassification
from experiments.common.runner import BaseConfig, Tables, experiment
from experiments.common.tables import Row
from experiments.segmentation.data import Pair, hopkins_pairs, motion_pairs

THRESHOLDS = (2.0, 2.5, 3.0)
"""px."""
DEFAULT = 2.5
WORST = 5
PROGX = {
    "cube": 3.3,
    "book": 3.2,
    "biscuit": 0.6,
    "game": 3.4,
    "breadtoy": 3.1,
    "cubetoy": 1.2,
    "biscuitbookbox": 3.1,
    "breadcubechips": 1.3,
    "carchipscube": 13.9,
    "toycubecar": 25.5,
    "cubebreadtoychips": 36.7,
}
"""Percent.  Source: danini/progressive-x, adelaideF.ipynb (Barath and Matas, ICCV 2019); it does not list biscuitbook."""
PUBLISHED = """
Published figures, not run here (mean misclassification, %): read off a plot (BengisuOzbay/TwoViewMotSeg, ECCV 2022), +-0.5,
  AdelaideRMF, all 19 pairs: Christoffel 5, CBS 5, RPA 5.5, RCM 8, Prog-X 11.5, MultiLink 13, T-linkage 25;
  Hopkins155, all 156 sequences, two views: RPA 6, Christoffel 8.5, CBS 10, Prog-X 17.5, T-linkage 33;
AdelaideRMF, Prog-X by its own notebook: 10.9 over 18 pairs, in brackets above per pair."""


@dataclass(frozen=True)
class Config(BaseConfig):
    """Segmentation into bodies on the recordings in the folder DYNTORCH_DATA."""

    seeds: int = 5
    """Runs per pair of AdelaideRMF; Hopkins155 has one."""


@dataclass(frozen=True)
class Outcome:
    """One run: percent misclassified, number of bodies, seconds."""

    error: float
    bodies: int
    seconds: float


def segmented(
    pair: Pair,
    bodies: int | None = None,
    threshold: float = DEFAULT,
    seed: int = 0,
) -> Outcome:
    """Segment a pair and compare with the truth."""
    clock = time.perf_counter()
    generator = torch.Generator().manual_seed(seed)
    found = dyn.segment(pair.x1, pair.x2, bodies=bodies, threshold=threshold, generator=generator)
    seconds = time.perf_counter() - clock
    return Outcome(100 * float(misclassification(found.labels, pair.labels)), int(found.bodies), seconds)


def adelaide(config: Config) -> list[Row]:
    """Every pair, and their mean."""
    pairs, seeds = motion_pairs()[:: 4 if config.quick else 1], config.seeds
    runs = {
        threshold: {pair.name: [segmented(pair, None, threshold, seed) for seed in range(seeds)] for pair in pairs}
        for threshold in (DEFAULT, *(t for t in THRESHOLDS if t != DEFAULT))
    }
    rows = [_pair_row(pair, runs[DEFAULT][pair.name]) for pair in pairs]
    every = [run for name in runs[DEFAULT] for run in runs[DEFAULT][name]]
    right = [run.bodies == pair.bodies for pair in pairs for run in runs[DEFAULT][pair.name]]
    means = [fmean(runs[DEFAULT][pair.name][seed].error for pair in pairs) for seed in range(seeds)]
    mean = {t: {name: fmean(run.error for run in found) for name, found in runs[t].items()} for t in THRESHOLDS}
    return [
        *rows,
        Row("mean", f"{len(pairs)} pairs, K unknown", fmean(means), 1.0, pstdev(means), at_most=True, unit=" %"),
        Row("mean, cross-validated", "threshold chosen on the other pairs", left_out(mean), 1.0, at_most=True, unit=" %"),
        *(Row("mean", f"threshold {t:g} px", fmean(mean[t].values()), unit=" %") for t in THRESHOLDS if t != DEFAULT),
        Row("K right", "share of all runs", 100 * fmean(right), unit=" %"),
        Row("time per pair", "median", median(run.seconds for run in every), 0.3, at_most=True, unit=" s"),
        Row("time per pair", "worst", max(run.seconds for run in every), unit=" s"),
    ]


def _pair_row(pair: Pair, runs: Sequence[Outcome]) -> Row:
    errors = [run.error for run in runs]
    right, seconds = sum(run.bodies == pair.bodies for run in runs), median(run.seconds for run in runs)
    wrong = f"{100 * float((pair.labels == 0).double().mean()):.0f} % wrong"
    what = f"{pair.bodies} bodies" if pair.bodies > 1 else "1 body"
    other = f" (published: Prog-X {PROGX[pair.name]} %)" if pair.name in PROGX else ""
    setting = f"{what}, {len(pair.labels)} matches, {wrong}; K right {right}/{len(runs)}; {seconds:.2f} s{other}"
    return Row(pair.name, setting, fmean(errors), spread=pstdev(errors), unit=" %")


def left_out(errors: Mapping[Any, Mapping[str, float]]) -> float:
    """Mean error over the pairs, each with the parameter that has the least mean error on the others.

    Args:
        errors: by parameter and pair.
    """
    names = list(next(iter(errors.values())))

    def of(name: str) -> float:
        others = [other for other in names if other != name]
        return errors[min(errors, key=lambda value: sum(errors[value][other] for other in others))][name]

    return fmean(map(of, names))


def hopkins(config: Config) -> list[Row]:
    """First and last frame, with the number of bodies and without."""
    pairs = hopkins_pairs()[:: 8 if config.quick else 1]
    known = {pair.name: segmented(pair, pair.bodies) for pair in pairs}
    unknown = {pair.name: segmented(pair) for pair in pairs}
    groups = {"all": pairs, "cars": [p for p in pairs if p.name.startswith("cars")], "1R*": [p for p in pairs if p.name[0] == "1"]}
    rows = []
    for name, chosen in ((name, chosen) for name, chosen in groups.items() if chosen):
        goal = 2.0 if name == "all" else None
        errors, open_errors = ([found[p.name].error for p in chosen] for found in (known, unknown))
        right = [unknown[p.name].bodies == p.bodies for p in chosen]
        setting = f"{name}, {len(chosen)} sequences"
        rows += [
            Row("K known, mean error", setting, fmean(errors), goal, at_most=True, unit=" %"),
            Row("K known, median error", setting, median(errors), unit=" %"),
            Row("K unknown, mean error", setting, fmean(open_errors), unit=" %"),
            Row("K unknown, K right", setting, 100 * fmean(right), 85.0 if name == "all" else None, unit=" %"),
        ]
    for title, found in (("K known", known), ("K unknown", unknown)):
        rows.append(Row(f"{title}, time per pair", "median", median(run.seconds for run in found.values()), unit=" s"))
    worst = sorted(pairs, key=lambda pair: -known[pair.name].error)[:WORST]
    return rows + [Row(f"worst, K known: {p.name}", f"{p.bodies} bodies", known[p.name].error, unit=" %") for p in worst]


@experiment(Config(), quick={"seeds": 1})
def tables(config: Config) -> Tables:
    """Recordings of the folder DYNTORCH_DATA; quick: every fourth pair of AdelaideRMF, every eighth sequence of Hopkins155."""
    yield "AdelaideRMF, two views of moved objects", adelaide(config)
    yield "Hopkins155, first and last frame", hopkins(config)
    yield "", PUBLISHED
