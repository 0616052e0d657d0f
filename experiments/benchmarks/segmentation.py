"""Speed and error of the segmentation into bodies beside OpenCV's and kornia's RANSAC, run greedily.

    DYNTORCH_DATA=../shared/data python -m experiments.benchmarks.segmentation

The pairs of AdelaideRMF in which objects moved, or synthetic pairs where DYNTORCH_DATA is not set, and one synthetic pair of 1100
matches.  The peers know one fundamental matrix at a time: they fit one, take its inliers out, and go on with the rest - as often
as there are bodies where that is told, else until a fit has fewer inliers than 20 or 5 % of all matches.  They fit at 1 px and take
inliers at 2.5 px; these and the 20 were chosen for them on the pairs of AdelaideRMF (of 1, 1.5 and 2.5 px; 14, 20 and 28 inliers).
All candidates take turns, on one thread; seconds are medians over the rounds, errors the mean misclassification over rounds and
pairs, each round with a seed of its own.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

import dyntorch as dyn
from dyntorch import scenes
from dyntorch.metrics import misclassification
from experiments.common.runner import BaseConfig, Tables, experiment
from experiments.common.tables import Row, note
from experiments.common.timing import interleaved
from experiments.recognition.protocol import DATA
from experiments.segmentation.data import Pair, motion_pairs

MODEL, INLIER = 1.0, 2.5
"""px: what a peer fits at, and what it takes out."""
FEWEST, SHARE = 20, 0.05
"""A greedy search of unknown length ends at fewer inliers: so many of 300 or of n wrong matches fit some fundamental matrix."""
SAMPLE = 8
GOALS = {"real": 0.3, "large": 1.5, "batch": 1.0}
"""Seconds per pair, seconds for 1100 matches, milliseconds per problem of the batch."""

Estimate = Callable[[Tensor, Tensor], Any]
Segmenter = Callable[[Pair, int | None, int], Tensor]


@dataclass(frozen=True)
class Config(BaseConfig):
    """Segmentation into bodies beside greedy RANSAC."""

    rounds: int = 3
    """How often every candidate runs."""
    batch: int = 1000
    """Exact problems of two bodies in one batch."""


def ours(pair: Pair, bodies: int | None, seed: int) -> Tensor:
    """The labels of :func:`dyntorch.segment`."""
    return dyn.segment(pair.x1, pair.x2, bodies=bodies, generator=torch.Generator().manual_seed(seed)).labels


def greedy(estimate: Estimate) -> Segmenter:
    """One fundamental matrix after the other, each on the matches that none before it explains."""

    def segmented(pair: Pair, bodies: int | None, seed: int) -> Tensor:
        torch.manual_seed(seed)  # kornia has no generator
        labels = torch.zeros(len(pair.x1), dtype=torch.long)
        least = SAMPLE if bodies else max(FEWEST, SHARE * len(labels))
        body = 0
        while bodies is None or body < bodies:
            left = (labels == 0).nonzero()[:, 0]
            if len(left) < SAMPLE:
                break
            x1, x2 = pair.x1[left], pair.x2[left]
            found = estimate(x1, x2)
            if found is None:
                break
            fundamental = torch.as_tensor(found, dtype=torch.float64)[:3]  # OpenCV may stack several
            inliers = left[dyn.sampson(dyn.FundamentalMatrix, fundamental, x1, x2).abs() < INLIER]
            if len(inliers) < least:
                break
            body += 1
            labels[inliers] = body
        return labels

    return segmented


def peers() -> dict[str, Segmenter]:
    """The other libraries that are installed."""
    found: dict[str, Segmenter] = {}
    try:
        import cv2

        cv2.setNumThreads(1)

        def usac(method: int) -> Segmenter:
            return greedy(lambda x1, x2: cv2.findFundamentalMat(x1.numpy(), x2.numpy(), method, MODEL, 0.999, 10_000)[0])

        for name in ("USAC_MAGSAC", "USAC_ACCURATE"):
            found[f"OpenCV {name}, greedy"] = usac(getattr(cv2, name))
    except ImportError:
        note("OpenCV is not installed (extra `experiments`): left out")
    from kornia.geometry.ransac import RANSAC

    ransac = RANSAC(model_type="fundamental", inl_th=MODEL, confidence=0.999)
    found["kornia RANSAC, greedy"] = greedy(lambda a, b: ransac(a, b)[0])
    return found


@dataclass
class Candidate:
    """A way to segment, on one list of pairs: every call runs all pairs, with the next seed, and keeps what it found."""

    segmenter: Segmenter
    pairs: Sequence[Pair]
    known: bool
    found: list[list[Tensor]] = field(default_factory=list)

    def __call__(self) -> None:
        seed = len(self.found)
        self.found.append([self.segmenter(pair, pair.bodies if self.known else None, seed) for pair in self.pairs])

    def error(self) -> float:
        """Mean misclassification, percent."""
        errors = [float(misclassification(a, p.labels)) for run in self.found for a, p in zip(run, self.pairs, strict=True)]
        return 100 * sum(errors) / len(errors)

    def counted(self) -> float:
        """Share of the runs with the true number of bodies, percent."""
        right = [int(a.unique().count_nonzero()) == p.bodies for run in self.found for a, p in zip(run, self.pairs, strict=True)]
        return 100 * sum(right) / len(right)


def compared(title: str, pairs: Sequence[Pair], config: Config, goal: float, wrong: float | None) -> list[Row]:
    """All candidates on the same pairs, with the number of bodies told and not told."""
    segmenters: Mapping[str, Segmenter] = {"dyntorch": ours, **peers()}
    candidates = {
        f"{name}, K {'known' if known else 'unknown'}": Candidate(segmenter, pairs, known)
        for known in (True, False)
        for name, segmenter in segmenters.items()
    }
    seconds = interleaved(candidates, config.rounds)
    rows = []
    for name, candidate in candidates.items():
        mine = name.startswith("dyntorch")
        each = seconds[name] / len(pairs)
        rows += [
            Row(name, f"{title}, time per pair", each, goal if mine else None, at_most=True, unit=" s"),
            Row(
                name, f"{title}, error", candidate.error(), wrong if mine and not candidate.known else None, at_most=True, unit=" %"
            ),
        ]
        if not candidate.known:
            rows.append(Row(name, f"{title}, K right", candidate.counted(), unit=" %"))
    return rows


def synthetic(name: str, n: int, bodies: int, outliers: float, seed: int) -> Pair:
    """Bodies apart from each other, 0.5 px of noise."""
    scene = scenes.bodies(n, bodies, sigma=0.5, outliers=outliers, generator=torch.Generator().manual_seed(seed))
    x1, x2 = scene.views
    return Pair(name, x1, x2, scene.labels)


def real(config: Config) -> list[Row]:
    """Photographs where they are at hand."""
    if os.environ.get(DATA):
        title, pairs = "AdelaideRMF", motion_pairs()
    else:
        note(f"{DATA} is not set: synthetic pairs instead of AdelaideRMF")
        title, pairs = "synthetic", [synthetic(f"synthetic {k}", 300, 1 + k % 3, 0.4, k) for k in range(12)]
    return compared(title, pairs[3:5] if config.quick else pairs, config, GOALS["real"], 1.0 if title == "AdelaideRMF" else None)


def large(config: Config) -> list[Row]:
    """One pair of many matches."""
    return compared("1100 matches", [synthetic("large", 1100, 3, 0.3, 0)], config, GOALS["large"], None)


def batch(config: Config) -> list[Row]:
    """Many exact problems of two bodies at once, by the segmentation matrix: fit, split, label."""
    count = config.batch
    scene = scenes.bodies((40, 40), batch=count, interleaved=True, generator=torch.Generator().manual_seed(0))
    x1, x2 = scene.views
    labels = scene.labels

    def run() -> None:
        nonlocal labels
        first, e, second, f = dyn.fit(dyn.SegmentationMatrix, x1, x2).motion
        pair = dyn.FundamentalMatrix.compose(first, e), dyn.FundamentalMatrix.compose(second, f)
        labels = dyn.SegmentationMatrix.labels(*pair, x1, x2)

    each = interleaved({"batch": run}, config.rounds)["batch"] / count * 1e3
    error = 100 * float(misclassification(labels, scene.labels).mean())
    return [
        Row("segmentation matrix", f"{count} exact problems of 80 matches, each", each, GOALS["batch"], at_most=True, unit=" ms"),
        Row("segmentation matrix", "the same, error", error, unit=" %"),
    ]


@experiment(Config(), quick={"rounds": 1, "batch": 20})
def tables(config: Config) -> Tables:
    """Beside greedy RANSAC; quick: two pairs."""
    yield "Pairs of photographs", real(config)
    yield "Many matches", large(config)
    yield "Exact problems in a batch", batch(config)
