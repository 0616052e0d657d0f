"""Two bodies between affine views: ``affine_segmentation`` beside the projective segmentation matrix and ``segment``.

    python -m experiments.segmentation.affine_bodies --quick

Bodies of about 100 pixels, each under its own affine motion between two affine views, half of the matches on each. Wrong labels,
under the better naming, means over the scenes. 14 matches are the least (7 on each body); the segmentation matrix takes 35.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch

import dyntorch as dyn
from dyntorch.metrics import misclassification
from experiments.common.runner import SceneConfig, Tables, Words, experiment
from experiments.thesis.definitions import normal, seeded

SETTINGS = tuple((n, sigma) for n in (14, 20, 60, 200) for sigma in (0.0, 0.5, 1.0, 2.0))
SIZE = 50.0
"""Pixels: standard deviation of the image of a body."""
LEAST = 35
S = dyn.SegmentationMatrix
HEAD = ("matches", "noise px", "affine", "segmentation matrix", "segment")


def line(n: int, sigma: float, scenes: int, seed: int) -> Sequence[str]:
    """One row of the table."""
    draw = seeded(seed)
    labels = (torch.arange(n) >= n // 2).long() + 1
    X = normal(scenes, n, 3, draw=draw)
    # every body has an affine camera of its own in each view: the motion of body and camera together
    cameras = SIZE * normal(scenes, 2, 2, 3, 2, draw=draw) / 3**0.5
    shifts = 2 * SIZE * normal(scenes, 2, 2, 1, 2, draw=draw)
    body = labels - 1
    seen = [(X[:, :, None] @ cameras[:, v][:, body])[:, :, 0] + shifts[:, v][:, body, 0] for v in (0, 1)]
    x1, x2 = (view + sigma * normal(*view.shape, draw=draw) for view in seen)
    wrong = [misclassification(dyn.tasks.affine_segmentation(x1, x2).labels, labels.expand(scenes, n)).mean()]
    cells = [f"{wrong[0]:.1%}"]
    if n >= LEAST:
        found = dyn.fit(S, x1, x2)
        matrix = S.labels(*S.fundamentals(found.tensor), x1, x2)
        general = dyn.segment(x1, x2, bodies=2, threshold=max(3 * sigma, 0.5), spatial=False, generator=draw).labels
        cells += [f"{misclassification(given, labels.expand(scenes, n)).mean():.1%}" for given in (matrix, general)]
    return str(n), f"{sigma:g}", *cells, *["-"] * (3 - len(cells))


@experiment(SceneConfig(scenes=40), quick={"scenes": 20})
def tables(config: SceneConfig) -> Tables:
    """Wrong labels of two bodies in affine views over the matches and the noise."""
    chosen = [setting for setting in SETTINGS if not config.quick or setting[1] == 0.5]
    lines = [line(*setting, config.scenes, config.seed) for setting in chosen]
    yield f"wrong labels, means of {config.scenes} scenes", Words(HEAD, lines)
