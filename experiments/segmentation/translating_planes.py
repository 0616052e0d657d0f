"""Noise table of translating planes: error of the homography at infinity by each method, beside reference figures.

    python -m experiments.segmentation.translating_planes --quick

Scenes of :func:`dyntorch.scenes.translating_planes` (patches of 120 pixels, 40 matches each), homographies by the direct linear
transformation.  Each cell is the median relative error of the homography at infinity in normalized coordinates, in brackets the
reference, which is of other scenes of the same kind.  "thesis", "linear" and "closed form" are the starts alone; "matrices" is what
:func:`dyntorch.translating_planes` makes of the homographies alone, "matches" what it makes of the matches; "from truth" starts
the latter at the true parameters.  The second table has bodies with depth, whose fundamental matrices are known from 40 matches.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

import dyntorch as dyn
from dyntorch.geometry.homogeneous import unit
from dyntorch.metrics import relative_error
from dyntorch.numerics.least_squares import LeastSquaresOptions, minimize
from dyntorch.scenes import TranslatingScene, translating_planes
from dyntorch.tasks.planes.input import GivenPlanes
from dyntorch.tasks.planes.planes import translating_planes as solve
from dyntorch.tasks.planes.problem import Layout, PlaneMatches, PlanesProblem, parameters
from experiments.common.runner import SceneConfig, Tables, Words, experiment
from experiments.common.tables import note

COLUMNS = ("thesis", "linear", "closed form", "matrices", "matches", "from truth")
NONE = float("nan")
REFERENCE: dict[tuple[int, float], tuple[float, ...]] = {
    (3, 0.1): (0.66, NONE, 0.079, 0.020, 0.024, 0.017),
    (3, 0.5): (0.74, NONE, 0.26, 0.26, 0.29, 0.22),
    (3, 1.0): (0.76, NONE, 0.21, 0.25, 0.25, 0.26),
    (4, 0.1): (0.69, 0.026, 0.020, 0.008, 0.008, 0.008),
    (4, 0.5): (0.65, 0.094, 0.11, 0.043, 0.038, 0.038),
    (4, 1.0): (0.70, 0.097, 0.12, 0.078, 0.091, 0.056),
    (5, 0.1): (0.080, 0.025, 0.033, 0.010, 0.004, 0.004),
    (5, 0.5): (0.31, 0.070, 0.086, 0.073, 0.037, 0.024),
    (5, 1.0): (0.28, 0.075, 0.17, 0.13, 0.053, 0.045),
    (8, 0.1): (0.022, 0.010, 0.019, 0.005, 0.002, 0.002),
    (8, 0.5): (0.069, 0.039, 0.042, 0.027, 0.011, 0.011),
    (8, 1.0): (0.10, 0.062, 0.13, 0.053, 0.025, 0.021),
}
BODIES: dict[tuple[int, int, float], float] = {
    (0, 2, 0.1): 0.0012,
    (0, 2, 0.5): 0.006,
    (0, 2, 1.0): 0.012,
    (0, 5, 0.1): 0.0007,
    (0, 5, 0.5): 0.0035,
    (0, 5, 1.0): 0.007,
    (2, 1, 0.5): NONE,
    (5, 1, 0.5): NONE,
    (5, 2, 0.5): NONE,
}
"""Planes, bodies and noise: the linear method on the fundamental matrices."""
KINDS: dict[str, dict[str, Any]] = {
    "general": {},
    "collinear epipoles": {"collinear_epipoles": True},
    "coplanar normals": {"coplanar_normals": True},
    "both": {"collinear_epipoles": True, "coplanar_normals": True},
    "two planes on one body": {"shared": 2},
    "a static plane": {"static": True},
}


def frames(scene: TranslatingScene, H: Tensor, F: Tensor) -> GivenPlanes:
    """The problem in normalized coordinates, with the matches."""
    return GivenPlanes.of(H, F, (scene.x1, scene.x2), (scene.body_x1, scene.body_x2), None)


def error(found: Tensor, scene: TranslatingScene, given: GivenPlanes) -> float:
    """Median relative error in the coordinates that Hartley's normalization of the matches gives."""
    first, second = given.frames[0], given.frames[1]
    pair = [unit(second @ h @ torch.linalg.inv(first)) for h in (found, scene.infinity)]
    return float(relative_error(*pair).median())


def from_truth(scene: TranslatingScene, given: GivenPlanes) -> Tensor:
    """The maximum likelihood estimate next to the truth."""
    first, second = given.frames
    layout = Layout(given.homographies.shape[1], given.fundamentals.shape[1])
    infinity = unit(second @ scene.infinity @ torch.linalg.inv(first))
    seen, body = given.planes, given.bodies
    matches = PlaneMatches(seen.views, seen.weights, body.views, body.weights, (first[:, 0, 0], second[:, 0, 0]))
    theta = parameters(given.homographies, given.fundamentals, infinity)
    problem = PlanesProblem(layout, matches)
    found, _, _ = layout.unpack(minimize(problem, problem.evaluate((theta,)), LeastSquaresOptions(iterations=100)).theta[0])
    back: Tensor = torch.linalg.inv(second)
    return back @ found @ first


def estimates(scene: TranslatingScene) -> dict[str, float]:
    """Errors of all methods that the planes allow."""
    H = dyn.fit(dyn.Collineation(2), scene.x2, scene.x1).tensor
    given = frames(scene, H, scene.body_fundamentals)
    # the starts in the coordinates of the matches: what the methods differ in, not what the normalization does
    first, second = (frame[:, None] for frame in given.frames)
    moved = second @ H @ torch.linalg.inv(first)
    result = {}
    for name, method, least in (("thesis", "thesis", 5), ("linear", "linear", 4), ("closed form", "closed_form", 3)):
        if H.shape[1] >= least:
            start = solve(moved, method=method, refine=False).homography_at_infinity
            result[name] = error(torch.linalg.inv(given.frames[1]) @ start @ given.frames[0], scene, given)
    result["matrices"] = error(solve(H).homography_at_infinity, scene, given)
    result["matches"] = error(solve(H, x1=scene.x1, x2=scene.x2).homography_at_infinity, scene, given)
    result["from truth"] = error(from_truth(scene, given), scene, given)
    return result


def with_bodies(planes: int, bodies: int, sigma: float, scenes: int, draw: torch.Generator) -> dict[str, float]:
    """Errors from the matrices alone and from the matches."""
    scene = translating_planes(planes, bodies, batch=scenes, sigma=sigma, generator=draw)
    F = dyn.fit(dyn.FundamentalMatrix, scene.body_x1, scene.body_x2)
    F = dyn.refine(F, scene.body_x1, scene.body_x2).tensor
    H = dyn.fit(dyn.Collineation(2), scene.x2, scene.x1).tensor if planes else scene.homographies
    given = frames(scene, H, F)
    alone = solve(H, fundamentals=F)
    full = solve(H, fundamentals=F, x1=scene.x1, x2=scene.x2, body_matches=(scene.body_x1, scene.body_x2))
    return {
        "matrices": error(alone.homography_at_infinity, scene, given),
        "matches": error(full.homography_at_infinity, scene, given),
    }


def degenerate(kind: str, planes: int, scenes: int, draw: torch.Generator) -> tuple[str, str]:
    """What the result says of exact homographies of a kind: statuses and notices."""
    scene = translating_planes(planes, batch=scenes, generator=draw, **KINDS[kind])
    found = solve(scene.homographies)
    good = found.status == dyn.Status.OK
    worst = float(relative_error(found.homography_at_infinity, scene.infinity)[good].max()) if bool(good.any()) else NONE
    counts: dict[str, int] = {}
    for notice in found.warnings:
        counts[notice.code.value] = counts.get(notice.code.value, 0) + 1
    named = ", ".join(f"{code} {count}" for code, count in sorted(counts.items())) or "nothing"
    return f"{int(good.sum())} of {scenes}" + (f", error at most {worst:.0e}" if bool(good.any()) else ""), named


def cell(value: float | None, reference: float) -> str:
    """A figure and its reference."""
    shown = "" if value is None else f"{value:.2g}"
    return shown + (f" ({reference:.2g})" if reference == reference else "")


@experiment(SceneConfig(scenes=60), quick={"scenes": 30})
def tables(config: SceneConfig) -> Tables:
    """Error of the homography at infinity over the number of planes and the noise; quick: 0.5 px."""
    lines = []
    for (n, sigma), reference in REFERENCE.items():
        if not config.quick or sigma == 0.5:
            note(f"{n} planes, {sigma:g} px")
            draw = torch.Generator().manual_seed(config.seed)
            measured = estimates(translating_planes(n, batch=config.scenes, sigma=sigma, generator=draw))
            cells = [cell(measured.get(name), known) for name, known in zip(COLUMNS, reference, strict=True)]
            lines.append([str(n), f"{sigma:g}", *cells])
    title = f"relative error of the homography at infinity (reference), medians of {config.scenes} scenes"
    yield title, Words(("planes", "noise px", *COLUMNS), lines)
    lines = []
    for (n, m, sigma), linear in BODIES.items():
        if not config.quick or sigma == 0.5:
            measured = with_bodies(n, m, sigma, config.scenes, torch.Generator().manual_seed(config.seed))
            lines.append([str(n), str(m), f"{sigma:g}", cell(measured["matrices"], linear), cell(measured["matches"], NONE)])
    yield "with bodies of known fundamental matrix", Words(("planes", "bodies", "noise px", "matrices", "matches"), lines)
    lines = []
    for kind in KINDS:
        for n in (3, 4, 5):
            draw = torch.Generator().manual_seed(config.seed)
            lines.append([kind, str(n), *degenerate(kind, n, min(config.scenes, 20), draw)])
    yield "exact homographies in special position", Words(("position", "planes", "status OK", "said"), lines)
