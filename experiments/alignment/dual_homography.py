"""Dual homography tensor under noise: the motion of a camera over a plane from lines through points, each view its own lines.

    python -m experiments.alignment.dual_homography --quick

Scenes of :func:`dyntorch.scenes.lines_concurrent`: a line of each view passes through the image of one static point, nothing else
is shared. Medians of the transfer error over the image, of the worse of A and B, in pixels; the noise is of the two points that
measure a line. "four points" is the tensor of the four static points that suffice where points are seen at all: what lines cost.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

import dyntorch as dyn
from dyntorch.metrics import grid_transfer_error
from dyntorch.scenes import Scene, lines_concurrent
from experiments.common.runner import SceneConfig, Tables, Words, experiment

SETTINGS = tuple((n, sigma) for n in (30, 60, 120, 300) for sigma in (0.1, 0.5, 1.0))
OUTLIERS = 0.2
DUAL = dyn.DualHomographyTensor
HEAD = ("lines", "noise px", "linear px", "refined px", "robust, 20 % outliers px", "inliers kept", "four points px")


def error(motion: Sequence[Tensor], scene: Scene) -> float:
    """Median over the scenes of the error over the image."""
    worst = torch.stack([grid_transfer_error(a, b, 640, 480) for a, b in zip(motion, scene.motion, strict=True)]).amax(0)
    return float(worst.median())


def spoilt_error(n: int, sigma: float, scenes: int, draw: torch.Generator) -> tuple[str, str]:
    """Error and share of inliers kept where some matches are outliers."""
    scene = lines_concurrent(n, batch=scenes, sigma=sigma, outliers=OUTLIERS, generator=draw)
    found = dyn.robust_fit(DUAL, *scene.views, threshold=3 * sigma, generator=draw)
    kept = found.inliers[scene.labels > 0].double().mean()
    found = dyn.refine(found, *scene.views, weights=found.inliers.double())
    return f"{error(found.motion, scene):.2g}", f"{kept:.3f}"


def line(n: int, sigma: float, scenes: int, seed: int) -> Sequence[str]:
    """One row of the table."""
    draw = torch.Generator().manual_seed(seed)
    scene = lines_concurrent(n, batch=scenes, sigma=sigma, generator=draw)
    linear = dyn.fit(DUAL, *scene.views)
    refined = dyn.refine(linear, *scene.views)
    kept, third = "-", "-"
    if n * (1 - OUTLIERS) > DUAL.minimal():
        third, kept = spoilt_error(n, sigma, scenes, draw)
    points = scene.extras["points"][..., :4, :]
    points = points + sigma * torch.randn(points.shape, generator=draw, dtype=points.dtype)
    four = dyn.fit(DUAL("points"), *points.unbind(-3))
    errors = [f"{error(found.motion, scene):.2g}" for found in (linear, refined)]
    return str(n), f"{sigma:g}", *errors, third, kept, f"{error(DUAL.decompose(four.tensor), scene):.2g}"


@experiment(SceneConfig(scenes=40), quick={"scenes": 20})
def tables(config: SceneConfig) -> Tables:
    """Errors over the number of lines and the noise."""
    chosen = [setting for setting in SETTINGS if not config.quick or setting[1] == 0.5]
    lines = [line(*setting, config.scenes, config.seed) for setting in chosen]
    yield f"error over an image of 640 x 480, medians of {config.scenes} scenes", Words(HEAD, lines)
