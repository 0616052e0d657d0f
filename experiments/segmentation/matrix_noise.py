"""What the segmentation matrix is worth under noise: two interleaved bodies, no wrong matches, no hint which match is whose.

    python -m experiments.segmentation.matrix_noise
    python -m experiments.segmentation.matrix_noise --quick

Scenes of :func:`dyntorch.scenes.bodies`; each cell is the mean share of matches (percent) that the two fundamental matrices found
attribute to the wrong body, each match going to the one with the smaller Sampson distance.

- linear, kernels: the linear fit of S, split by its kernels (in normalized coordinates, as the motion of the solution is);
- linear, derivatives: the same S, split by its derivatives at the matches;
- reweighted: S by iteratively reweighted least squares, split by its kernels;
- reweighted, assigned: then fundamental matrices (8 points) of the matches of each body, and labels by these, in turns;
- reweighted, refined: instead the 14 parameters of both motions refined (:func:`dyntorch.refine`), no labels in between;
- derivatives, refined: the same from the second row;
- segment: :func:`dyntorch.segment` with ``spatial=False``, which samples seven matches at a time;
- true labels: refined fundamental matrices of the true bodies, what no method can undercut for long.

The prototype's figures are means over 20 scenes of its own: good to a third or so.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import torch
import tyro
from torch import Tensor

import dyntorch as dyn
from dyntorch import scenes
from dyntorch.core.normalize import normalize_motion
from dyntorch.metrics import misclassification
from dyntorch.scenes import Scene
from experiments.common.tables import NoiseConfig, Row, command, measured

NOISE = (0.1, 0.5, 1.0)
"""px."""
REWEIGHTINGS, TURNS = 10, 15
PROTOTYPE: dict[int, dict[str, tuple[float, float, float]]] = {
    25: {
        "linear, kernels": (3.4, 12, 19),
        "linear, derivatives": (2.5, 12, 26),
        "reweighted": (2.2, 8.3, 16),
        "reweighted, assigned": (2.1, 5.1, 13),
        "segment": (0.2, 0.5, 3.4),
        "true labels": (0, 0.2, 0.2),
    },
    50: {
        "linear, kernels": (11, 20, 25),
        "linear, derivatives": (5.8, 16, 24),
        "reweighted": (6.5, 17, 25),
        "reweighted, assigned": (8.8, 17, 21),
        "segment": (0.1, 0.5, 2.0),
        "true labels": (0, 0.4, 1.1),
    },
    150: {
        "linear, kernels": (1.4, 10, 25),
        "linear, derivatives": (0.3, 9.7, 23),
        "reweighted": (0.4, 4.8, 22),
        "reweighted, assigned": (0, 1.7, 18),
        "segment": (0, 0.4, 0.8),
        "true labels": (0, 0.2, 0.5),
    },
}
"""Percent, by matches per body and method, for each noise."""

Pair = tuple[Tensor, Tensor]


@dataclass(frozen=True)
class Config(NoiseConfig):
    """Two bodies under noise: ways to estimate and to split the segmentation matrix, and to do without it."""

    quick: bool = False
    """20 scenes, 50 matches per body."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")] = Path("results/segmentation_matrix_noise.json")
    """Where the results and this configuration are written as JSON."""


def methods(scene: Scene) -> dict[str, Callable[[], Pair]]:
    """The fundamental matrices of both bodies, ``(*batch, 3, 3)`` each, by every method."""
    x1, x2 = scene.views
    matrix = dyn.SegmentationMatrix
    linear = dyn.fit(matrix, x1, x2)
    reweighted = linear
    for _ in range(REWEIGHTINGS):
        reweighted = dyn.fit(matrix, x1, x2, weights=matrix.reweight(reweighted.tensor, x1, x2))
    derivatives = matrix.decompose_by_derivatives(linear.tensor, x1, x2)
    return {
        "linear, kernels": lambda: fundamentals(linear),
        "linear, derivatives": lambda: derivatives,
        "reweighted": lambda: fundamentals(reweighted),
        "reweighted, assigned": lambda: assigned(scene, fundamentals(reweighted)),
        "reweighted, refined": lambda: refined(scene, reweighted),
        "derivatives, refined": lambda: refined(scene, started(linear, derivatives)),
        "segment": lambda: segment(scene),
        "true labels": lambda: told(scene),
    }


def fundamentals(solution: dyn.Solution) -> Pair:
    """Those of the motion of a segmentation matrix."""
    first, e, second, f = solution.motion
    return dyn.FundamentalMatrix.compose(first, e), dyn.FundamentalMatrix.compose(second, f)


def started(solution: dyn.Solution, pair: Pair) -> dyn.Solution:
    """The solution with the motion of these fundamental matrices, for a refinement from there."""
    motion = [part for F in pair for part in dyn.FundamentalMatrix.decompose(F)]
    return replace(solution, refined=normalize_motion(solution.invariant, tuple(motion), solution.normalization.transforms))


def refined(scene: Scene, solution: dyn.Solution) -> Pair:
    """Least Sampson distances from the product of both forms; the weights of the fit are no part of the noise."""
    return fundamentals(dyn.refine(solution, *scene.views, weights=torch.ones_like(scene.views[0][..., 0])))


def assigned(scene: Scene, pair: Pair) -> Pair:
    """Labels by the smaller distance and fundamental matrices of the matches of each body, in turns."""
    x1, x2 = scene.views
    for _ in range(TURNS):
        labels = dyn.SegmentationMatrix.labels(*pair, x1, x2)
        found = [dyn.fit(dyn.FundamentalMatrix, x1, x2, weights=(labels == k).to(x1)) for k in (1, 2)]
        first, second = (
            torch.where((new.status == dyn.Status.OK)[..., None, None], new.tensor, old)
            for new, old in zip(found, pair, strict=True)
        )
        pair = first, second
    return pair


def segment(scene: Scene) -> Pair:
    """By sampling, at a threshold that all but 0.3 % of the matches keep."""
    draw = torch.Generator().manual_seed(0)
    found = dyn.segment(*scene.views, bodies=2, threshold=3 * scene.sigma, spatial=False, generator=draw)
    first, second = found.fundamentals.unbind(-3)
    return first, second


def told(scene: Scene) -> Pair:
    """By the true labels."""
    x1, x2 = scene.views

    def of(body: int) -> Tensor:
        solution = dyn.fit(dyn.FundamentalMatrix, x1, x2, weights=(scene.labels == body).to(x1))
        return dyn.refine(solution, x1, x2).tensor

    return of(1), of(2)


def table(count: int, config: Config) -> list[Row]:
    """All methods over the noise, for so many matches per body."""
    rows = []
    for index, sigma in enumerate(NOISE):
        draw = torch.Generator().manual_seed(config.seed)
        batch = 20 if config.quick else config.scenes
        scene = scenes.bodies((count, count), batch=batch, sigma=sigma, interleaved=True, generator=draw)
        for name, solve in methods(scene).items():
            labels = dyn.SegmentationMatrix.labels(*solve(), *scene.views)
            error = 100 * float(misclassification(labels, scene.labels).mean())
            known = PROTOTYPE[count].get(name)
            rows.append(Row(name, f"{sigma:g} px" + (f" (prototype {known[index]:g} %)" if known else ""), error, unit=" %"))
    return rows


def run(config: Config) -> None:
    """Print every table, then write the file.

    Raises:
        ValueError: no scenes, or a file that cannot be written.
    """
    target = config.target()
    titles = {f"{count} matches per body": count for count in ((50,) if config.quick else PROTOTYPE)}
    measured(list(titles), lambda name: table(titles[name], config), target, vars(config))


if __name__ == "__main__":
    command(lambda: run(tyro.cli(Config, prog="python -m experiments.segmentation.matrix_noise")))
