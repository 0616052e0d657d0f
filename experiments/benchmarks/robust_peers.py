"""Robust fundamental matrices and homographies against OpenCV, PoseLib and kornia.  Needs no recordings.

    python -m experiments.benchmarks.robust_peers

64 problems of 500 matches with 0.5 px noise, 30 to 50 % outliers, threshold 1.5 px.  The peers take one problem per call and are
called in a loop; dyntorch takes the batch, and for the speed of one call the first problem alone.  Beside the time: the median
over problems of the RMS distance of the noise-free inliers from the estimate.  All candidates of a row take turns; the figures
are medians.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

import dyntorch as dyn
from dyntorch import scenes
from dyntorch.geometry.homogeneous import homogeneous
from experiments.common.runner import BaseConfig, Tables, experiment
from experiments.common.tables import Row, note
from experiments.common.timing import interleaved

THRESHOLD = 1.5
Estimate = Callable[[], Tensor]


@dataclass(frozen=True)
class Config(BaseConfig):
    """Robust two-view fits against OpenCV, PoseLib and kornia."""

    rounds: int = 3
    """How often every candidate runs."""


def loop(x1: Tensor, x2: Tensor, solve: Callable[[Any, Any], Any]) -> Tensor:
    """One problem after the other; an estimate that fails counts as zero."""
    found = []
    for a, b in zip(x1, x2, strict=True):
        result = solve(a, b)
        found.append(torch.zeros(3, 3, dtype=torch.float64) if result is None else torch.as_tensor(result, dtype=torch.float64))
    return torch.stack(found)


def peers(kind: str, x1: Tensor, x2: Tensor) -> dict[str, Estimate]:
    """The other libraries that are installed: F with x2^T F x1 = 0, or H with x1 ~ H x2."""
    found: dict[str, Estimate] = {}
    fundamental = kind == "fundamental matrix"
    try:
        import cv2

        def magsac(a: Tensor, b: Tensor) -> Any:
            if fundamental:
                return cv2.findFundamentalMat(a.numpy(), b.numpy(), cv2.USAC_MAGSAC, THRESHOLD, 0.999, 10_000)[0]
            return cv2.findHomography(b.numpy(), a.numpy(), cv2.USAC_MAGSAC, THRESHOLD, maxIters=10_000, confidence=0.999)[0]

        found["OpenCV USAC_MAGSAC"] = lambda: loop(x1, x2, magsac)
    except ImportError:
        note("OpenCV is not installed (extra `video`): left out")
    try:
        import poselib

        def pose(a: Tensor, b: Tensor) -> Any:
            if fundamental:
                return poselib.estimate_fundamental(a.numpy(), b.numpy(), {"max_epipolar_error": THRESHOLD})[0]
            return poselib.estimate_homography(b.numpy(), a.numpy(), {"max_reproj_error": THRESHOLD})[0]

        found["PoseLib"] = lambda: loop(x1, x2, pose)
    except ImportError:
        note("PoseLib is not installed (extra `experiments`): left out")
    from kornia.geometry.ransac import RANSAC

    def kornia(a: Tensor, b: Tensor) -> Any:
        ransac = RANSAC(model_type="fundamental" if fundamental else "homography", inl_th=THRESHOLD, confidence=0.999)
        return ransac(a, b)[0] if fundamental else ransac(b, a)[0]

    found["kornia RANSAC"] = lambda: loop(x1, x2, kornia)
    return found


def error(kind: str, estimate: Tensor, exact: tuple[Tensor, Tensor], inlier: Tensor) -> float:
    """Median over problems of the RMS distance in view 2 (epipolar) or view 1 (transfer) of noise-free inliers."""
    x1, x2 = exact
    if kind == "fundamental matrix":
        lines = homogeneous(x1) @ estimate.mT
        square = (homogeneous(x2) * lines).sum(-1).square() / lines[..., :2].square().sum(-1).clamp(min=1e-300)
    else:
        image = homogeneous(x2) @ estimate.mT
        square = (image[..., :2] / image[..., 2:] - x1).square().sum(-1)
    return float(((square * inlier).sum(-1) / inlier.sum(-1)).sqrt().median())


def measure(kind: str, share: float, config: Config) -> list[Row]:
    """All candidates on the same problems."""
    batch, n = (4, 200) if config.quick else (64, 500)
    generator = torch.Generator().manual_seed(0)
    if kind == "fundamental matrix":
        scene = scenes.two_view(n=n, batch=batch, sigma=0.5, outliers=share, generator=generator)
        invariant: Any = dyn.FundamentalMatrix
    else:
        scene = scenes.planar(n=n, batch=batch, sigma=0.5, static=1.0, outliers=share, generator=generator)
        invariant = dyn.Collineation(2)
    x1, x2 = scene.views[:2]
    inlier = (scene.labels > 0).double()
    if kind == "homography":
        # an outlier of the scene may be wrong in view 3 only
        inlier = ((scene.views[1] - scene.exact[1]).norm(dim=-1) < 4).double()

    def ours() -> Tensor:
        draw = torch.Generator().manual_seed(1)
        return dyn.robust_fit(invariant, x1, x2, threshold=THRESHOLD, generator=draw).tensor

    def one() -> Tensor:
        draw = torch.Generator().manual_seed(1)
        return dyn.robust_fit(invariant, x1[0], x2[0], threshold=THRESHOLD, generator=draw).tensor

    candidates: dict[str, Estimate] = {"dyntorch, one batch": ours, **peers(kind, x1, x2)}
    note(f"... {kind}, {share:.0%} outliers")
    seconds = interleaved(candidates, config.rounds)
    rows = []
    for name, run in candidates.items():
        setting = f"{share:.0%} outliers, {batch} x {n}"
        goal = 1.0 if name.startswith("dyntorch") else None
        rows.append(Row(f"{kind}: {name}", setting, seconds[name] / batch * 1e3, goal, at_most=True, unit=" ms"))
        rows.append(Row(f"{kind}: {name}, rms", setting, error(kind, run(), (scene.exact[0], scene.exact[1]), inlier), unit=" px"))
    alone, goal = interleaved({"one": one}, 10 * config.rounds)["one"], 5.0 if kind == "fundamental matrix" else 4.0
    return [*rows, Row(f"{kind}: dyntorch, one call", f"{share:.0%} outliers, {n}", alone * 1e3, goal, at_most=True, unit=" ms")]


@experiment(Config(), quick={"rounds": 1}, one_thread=False)
def tables(config: Config) -> Tables:
    """Against OpenCV, PoseLib and kornia; quick: few problems, the figures mean nothing."""
    settings = [(kind, share) for kind in ("fundamental matrix", "homography") for share in (0.3, 0.4, 0.5)]
    yield "Robust two-view fits", [row for setting in settings for row in measure(*setting, config)]
