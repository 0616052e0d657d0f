"""Noise table of the homography tensor: linear, refined and segmented estimates beside the goals.

    python -m experiments.alignment.planar_noise --quick

Scenes of :func:`dyntorch.scenes.planar`, medians; each cell is relative Frobenius error / grid transfer error in pixels, of
the worse one of A and B: the first in normalized coordinates, the second over a grid on the image.  "segmented" is
:func:`dyntorch.align_planar`, which is told the noise but no label.
"""

from __future__ import annotations

import torch
from torch import Tensor

import dyntorch as dyn
from dyntorch.core.normalize import normalize_motion
from dyntorch.metrics import grid_transfer_error, label_scores, relative_error
from dyntorch.scenes import Scene, planar
from dyntorch.tasks.align.planar import align_planar
from experiments.common.runner import SceneConfig, Tables, Words, experiment
from experiments.common.tables import note

COLUMNS = ("linear", "refined", "static: linear", "static: refined", "static: segmented")
STATIC = 0.4
Cell = tuple[float, float]
GOALS: dict[tuple[int, float], tuple[Cell, ...]] = {
    (26, 0.1): ((0.0077, 2.0), (0.0012, 0.33), (0.0083, 2.5), (0.0022, 0.60), (0.0009, 0.27)),
    (26, 0.5): ((0.041, 12), (0.0066, 1.8), (0.036, 8.6), (0.0082, 2.4), (0.0035, 0.93)),
    (26, 1.0): ((0.099, 26), (0.014, 3.7), (0.10, 26), (0.020, 5.5), (0.0092, 2.5)),
    (26, 2.0): ((0.14, 38), (0.028, 8.0), (0.12, 35), (0.040, 12), (0.022, 7.2)),
    (50, 0.1): ((0.0011, 0.29), (0.0006, 0.17), (0.0015, 0.39), (0.0007, 0.19), (0.0004, 0.10)),
    (50, 0.5): ((0.0054, 1.5), (0.0029, 0.79), (0.0075, 1.9), (0.0036, 1.0), (0.0019, 0.48)),
    (50, 1.0): ((0.012, 3.0), (0.0064, 1.6), (0.015, 4.1), (0.0076, 2.0), (0.0037, 1.0)),
    (50, 2.0): ((0.022, 5.9), (0.013, 3.3), (0.028, 7.2), (0.014, 4.1), (0.0076, 2.0)),
    (100, 0.5): ((0.0038, 1.0), (0.0020, 0.51), (0.0047, 1.2), (0.0024, 0.60), (0.0012, 0.32)),
    (100, 1.0): ((0.0073, 2.0), (0.0040, 0.98), (0.010, 2.6), (0.0047, 1.2), (0.0026, 0.63)),
    (100, 2.0): ((0.013, 3.6), (0.0068, 2.0), (0.019, 5.3), (0.0085, 2.2), (0.0049, 1.3)),
    (500, 0.5): ((0.0016, 0.41), (0.0008, 0.20), (0.0020, 0.51), (0.0008, 0.22), (0.0005, 0.13)),
    (500, 1.0): ((0.0026, 0.76), (0.0014, 0.42), (0.0039, 1.1), (0.0017, 0.49), (0.0011, 0.31)),
    (500, 2.0): ((0.0062, 1.7), (0.0033, 0.91), (0.0089, 2.4), (0.0035, 0.94), (0.0025, 0.60)),
}


def errors(motion: tuple[Tensor, Tensor], solution: dyn.Solution, scene: Scene) -> Cell:
    """Medians over the scenes."""
    frames = tuple(t.reshape(*scene.labels.shape[:-1], 3, 3) for t in solution.normalization.transforms)
    pairs = [normalize_motion(solution.invariant, m, frames) for m in (motion, scene.motion)]
    relative = torch.stack([relative_error(a, b) for a, b in zip(*pairs, strict=True)]).amax(0)
    grid = torch.stack([grid_transfer_error(a, b, 640, 480) for a, b in zip(motion, scene.motion, strict=True)]).amax(0)
    return float(relative.median()), float(grid.median())


def row(n: int, sigma: float, scenes: int, seed: int) -> tuple[list[Cell], float]:
    """All cells of one row, and the share of right labels."""
    draw = torch.Generator().manual_seed(seed)
    cells = []
    for static in (0.0, STATIC):
        scene = planar(n, batch=scenes, sigma=sigma, static=static, generator=draw)
        linear = dyn.fit(dyn.HomographyTensor, *scene.views)
        refined = dyn.refine(linear, *scene.views)
        for found in (linear, refined):
            A, B = found.motion
            cells.append(errors((A, B), linear, scene))
    aligned = align_planar(*scene.views, threshold=3 * sigma, generator=draw)
    assert aligned.B is not None
    cells.append(errors((aligned.A, aligned.B), linear, scene))
    recall = label_scores(aligned.labels, scene.labels).recall[..., 1:].mean()
    return cells, float(recall)


def table(measured: dict[tuple[int, float], tuple[list[Cell], float]]) -> Words:
    """Measured, in brackets the goal, and the ratio of the two, per cell."""
    head: tuple[str, ...] = ("N", "noise px", *COLUMNS, "recall of labels")
    lines = []
    for (n, sigma), (cells, recall) in measured.items():
        texts = []
        for (relative, grid), (goal, pixels) in zip(cells, GOALS[n, sigma], strict=True):
            texts.append(f"{relative:.2g}/{grid:.2g} ({goal:.2g}/{pixels:.2g}) x{relative / goal:.2f}/{grid / pixels:.2f}")
        lines.append((str(n), f"{sigma:g}", *texts, f"{recall:.3f}"))
    return Words(head, lines)


@experiment(SceneConfig(), quick={"scenes": 60})
def tables(config: SceneConfig) -> Tables:
    """Errors of the homography tensor over the number of matches and the noise; quick: up to 100 matches, 0.5 px."""
    measured = {}
    for n, sigma in [key for key in GOALS if not config.quick or (key[0] <= 100 and key[1] == 0.5)]:
        measured[n, sigma] = row(n, sigma, config.scenes, config.seed)
        note(f"{n} matches, {sigma:g} px")
    title = (
        f"relative error / pixels (goal) and their ratios, medians of {config.scenes} scenes; static: {STATIC:.0%} of the points"
    )
    yield title, table(measured)
