"""How much more than three views lower the error of the motion: planes before a camera, and 3D points before a sensor.

    python -m experiments.alignment.more_views --quick

Scenes of :func:`dyntorch.scenes.planar` and :func:`dyntorch.scenes.moving_points` in which everything moves, with outliers, and no
label given; :func:`dyntorch.align_planar` and :func:`dyntorch.align_points` get the first 3, 4, ... views of the same takes, and
the noise.  Errors are those of A and B, the motion of the same two views throughout: medians over the scenes of the worse one, over
a grid on the picture in pixels, or over the cube of the scene in units of it.
"""

from __future__ import annotations

import torch
from torch import Tensor

import dyntorch as dyn
from dyntorch import scenes
from dyntorch.geometry.homogeneous import apply
from dyntorch.metrics import grid_transfer_error
from experiments.common.runner import SceneConfig, Tables, Words, experiment
from experiments.common.tables import note

COUNTS = (3, 4, 5, 6, 8, 12)
OUTLIERS = 0.1
MATCHES = {"plane": 80, "space": 100}
NOISE = {"plane": 0.5, "space": 5e-3}


def cube_error(found: Tensor, true: Tensor) -> Tensor:
    """Root mean square distance ``(*batch,)`` of the corners of a cube of half side 2, and of its middle, under two maps."""
    corners = torch.cartesian_prod(*[torch.tensor([-2.0, 0.0, 2.0], dtype=torch.float64)] * 3)
    square = (apply(found, corners) - apply(true, corners)).square().sum(-1)
    return square.mean(-1).sqrt().nan_to_num(nan=torch.inf)


def measured(kind: str, counts: tuple[int, ...], number: int, seed: int) -> list[dict[str, float]]:
    """A row for each number of views."""
    draw = torch.Generator().manual_seed(seed)
    n, sigma = MATCHES[kind], NOISE[kind]
    make = scenes.planar if kind == "plane" else scenes.moving_points
    scene = make(n, batch=number, views=max(counts), sigma=sigma, generator=draw)
    # a wrong match is wrong in one of the first three views, whatever their number
    wrong = torch.arange(n) < round(OUTLIERS * n)
    views = list(scene.views)
    spread = views[2].std(-2, keepdim=True)
    views[2] = torch.where(
        wrong[:, None], views[2] + spread * torch.randn(views[2].shape, generator=draw, dtype=torch.float64), views[2]
    )
    rows = []
    for count in counts:
        solve = dyn.align_planar if kind == "plane" else dyn.align_points
        found = solve(*views[:count], threshold=3 * sigma, generator=torch.Generator().manual_seed(seed))
        assert found.B is not None
        pairs = list(zip((found.A, found.B), scene.motion[:2], strict=True))
        errors = [grid_transfer_error(a, b, 640, 480) if kind == "plane" else cube_error(a, b) for a, b in pairs]
        right = (found.labels == torch.where(wrong, 0, scene.labels))[..., ~wrong].double().mean(-1)
        rows.append(
            {
                "views": count,
                "error": float(torch.stack(errors).amax(0).median()),
                "labels": float(right.mean()),
                "outliers": float((found.labels[..., wrong] == 0).double().mean()),
                "ok": float((found.status == dyn.Status.OK).double().mean()),
            }
        )
        note(f"{kind}, {count} views")
    return rows


def table(rows: list[dict[str, float]], unit: str) -> Words:
    """The rows, with the error over that of three views."""
    head = ("views", f"error of A, B ({unit})", "over that of 3 views", "labels right", "outliers found", "OK")
    lines = [
        (
            f"{row['views']:.0f}",
            f"{row['error']:.3g}",
            f"{row['error'] / rows[0]['error']:.2f}",
            f"{row['labels']:.3f}",
            f"{row['outliers']:.2f}",
            f"{row['ok']:.2f}",
        )
        for row in rows
    ]
    return Words(head, lines)


@experiment(SceneConfig(scenes=12), quick={"scenes": 4})
def tables(config: SceneConfig) -> Tables:
    """Errors of the motion of two views over the number of views that are aligned together."""
    counts = (3, 4, 6) if config.quick else COUNTS
    shares = f"all of them move, {OUTLIERS:.0%} wrong in view 3, no label given; medians of {config.scenes} scenes"
    title = f"points of a plane on straight lines: {MATCHES['plane']} matches, {NOISE['plane']:g} px of noise; {shares}"
    yield title, table(measured("plane", counts, config.scenes, config.seed), "px over the image")
    title = f"points of space on straight lines: {MATCHES['space']} matches, noise {NOISE['space']:g}, scene +-2; {shares}"
    yield title, table(measured("space", counts, config.scenes, config.seed), "units over the scene")
