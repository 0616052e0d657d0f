"""Whole fits, points in and tensor out, against the ways people do it now.  Needs no recordings.

    python -m experiments.benchmarks.fits

1. Every large invariant, 1024 problems of 200 matches in float64, against building the rows and ``torch.linalg.svd``.
2. Fundamental matrices and homographies, 1000 problems of 50 matches, against kornia and a loop over OpenCV, with the error.
3. How time and memory grow with the number of matches and of problems.

All candidates of a row take turns; the figures are medians, the ratios are within the row.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import dyntorch as dyn
from dyntorch import scenes
from dyntorch.core.invariant import as_invariant
from dyntorch.core.matrix import estimation_matrix
from dyntorch.geometry.homogeneous import homogeneous
from dyntorch.scenes import Scene
from experiments.common.runner import BaseConfig, Tables, experiment
from experiments.common.tables import Row, note
from experiments.common.timing import interleaved, threads


def noisy_bodies(**options: Any) -> Scene:
    """Two bodies at 0.4 px: noise below the rounding of the Gram takes another pass over the rows."""
    return scenes.bodies(bodies=2, **{**options, "sigma": 0.4})


SCENES: dict[str, tuple[Any, Callable[..., Scene]]] = {
    "HomographyTensor": (dyn.HomographyTensor, scenes.planar),
    "TranslatingLinesMatrix": (dyn.TranslatingLinesMatrix, scenes.translating_lines),
    "ConstantVelocityTensor": (dyn.ConstantVelocityTensor, scenes.constant_velocity),
    "JoinTensor": (dyn.JoinTensor, scenes.moving_points),
    "SegmentationMatrix": (dyn.SegmentationMatrix, noisy_bodies),
}
GOALS = {"HomographyTensor": 25.0, "JoinTensor": 8.0, "SegmentationMatrix": 4.0}
"""Times faster than rows + SVD on a CPU."""


@dataclass(frozen=True)
class Config(BaseConfig):
    """Whole fits against rows + SVD, kornia and OpenCV."""

    rounds: int = 7
    """How often every candidate runs."""


def rows_and_svd(invariant: Any, views: tuple[Tensor, ...]) -> Tensor:
    """What one would write today: all rows of the (normalized) matches, then the SVD of every problem."""
    solver = as_invariant(invariant)
    weights = torch.ones(views[0].shape[:2], dtype=views[0].dtype, device=views[0].device)
    matrix = estimation_matrix(solver.primitives, views, weights)
    return torch.linalg.svd(matrix, full_matrices=False)[2][..., -solver.nullity :, :]


def large(config: Config, device: str) -> list[Row]:
    """Section 1."""
    (batch, n), rounds = (16, 80) if config.quick else (1024, 200), config.rounds
    rows = []
    for name, (invariant, scene) in SCENES.items():
        note(f"... {name} on {device}")
        views = scene(n=n, batch=batch, sigma=1e-3, generator=torch.Generator().manual_seed(0)).to(device=device).views

        def ours(invariant: Any = invariant, views: tuple[Tensor, ...] = views) -> object:
            return dyn.fit(invariant, *views)

        def theirs(invariant: Any = invariant, views: tuple[Tensor, ...] = views) -> object:
            return rows_and_svd(invariant, views)

        with threads(1):
            found = interleaved({"dyntorch": ours, "rows + svd": theirs}, rounds)
        goal = GOALS.get(name) if device == "cpu" else None
        setting = f"{batch} x {n}, {device}, one core"
        rows.append(Row(f"{name}: dyn.fit", setting, found["dyntorch"] / batch * 1e6, unit=" us"))
        rows.append(Row(f"{name}: rows + svd", setting, found["rows + svd"] / batch * 1e6, unit=" us"))
        rows.append(Row(f"{name}: times faster", setting, found["rows + svd"] / found["dyntorch"], goal))
    return rows


def small(config: Config) -> list[Row]:
    """Section 2."""
    import kornia.geometry.epipolar as epipolar
    from kornia.geometry.homography import find_homography_dlt

    batch, n, rounds = (20, 50, 1) if config.quick else (1000, 50, 3 * config.rounds)
    generator = torch.Generator().manual_seed(0)
    pair = scenes.two_view(n=n, batch=batch, sigma=0.5, generator=generator)
    plane = scenes.planar(n=n, batch=batch, sigma=0.5, static=1.0, generator=generator)
    f1, f2, h1, h2 = *pair.views, *plane.views[:2]
    ones = torch.ones(batch, n, dtype=torch.float64)
    fundamental: dict[str, Callable[[], Any]] = {
        "dyntorch": lambda: dyn.fit(dyn.FundamentalMatrix, f1, f2).tensor,
        "kornia": lambda: epipolar.find_fundamental(f1, f2, ones, method="8POINT"),
    }
    homography: dict[str, Callable[[], Any]] = {
        "dyntorch": lambda: dyn.fit(dyn.Collineation(2), h1, h2).tensor,
        "kornia": lambda: find_homography_dlt(h2, h1, ones),
        "kornia, solver=svd": lambda: find_homography_dlt(h2, h1, ones, solver="svd"),
    }
    fundamental.update(_opencv(f1, f2, homography=False))
    homography.update(_opencv(h1, h2, homography=True))
    rows = []
    for title, candidates, exact, error in (
        ("fundamental matrix", fundamental, pair.exact[:2], _epipolar_error),
        ("homography", homography, plane.exact[:2], _transfer_error),
    ):
        note(f"... {title}")
        with threads(1):
            found = interleaved(candidates, rounds)
        setting = f"{batch} x {n}, float64, one core"
        for name, run in candidates.items():
            rows.append(Row(f"{title}: {name}", setting, found[name] / batch * 1e6, unit=" us"))
            rows.append(Row(f"{title}: {name}, rms", "0.5 px, exact points", error(run(), *exact), unit=" px"))
        for name in [name for name in candidates if name != "dyntorch"]:
            goal = 12.0 if name == "kornia" else None
            rows.append(Row(f"{title}: times faster than {name}", setting, found[name] / found["dyntorch"], goal))
    lone = scenes.planar(n=4 * n, sigma=0.5, generator=generator).views
    for name, run in {
        "FundamentalMatrix": partial(dyn.fit, dyn.FundamentalMatrix, f1[0], f2[0]),
        "HomographyTensor": partial(dyn.fit, dyn.HomographyTensor, *lone),
    }.items():
        with threads(1):
            seconds = interleaved({name: run}, 10 * rounds)[name]
        rows.append(Row(f"{name}: dyn.fit of one", "one core", seconds * 1e3, 0.25, at_most=True, unit=" ms"))
    return rows


def _opencv(x1: Tensor, x2: Tensor, *, homography: bool) -> dict[str, Callable[[], Any]]:
    try:
        import cv2
    except ImportError:
        note("OpenCV is not installed (extra `video`): left out")
        return {}

    def solve(p: Any, q: Any) -> Any:
        return cv2.findHomography(q, p, 0)[0] if homography else cv2.findFundamentalMat(p, q, cv2.FM_8POINT)[0]

    pairs = list(zip(x1.numpy(), x2.numpy(), strict=True))
    return {"OpenCV loop": lambda: torch.stack([torch.as_tensor(solve(p, q)) for p, q in pairs])}


def _epipolar_error(fundamental: Tensor, x1: Tensor, x2: Tensor) -> float:
    """Median over the problems of the RMS distance of exact points to their epipolar lines in view 2."""
    lines = homogeneous(x1) @ fundamental.mT
    distance = (homogeneous(x2) * lines).sum(-1) / lines[..., :2].norm(dim=-1)
    return float(distance.square().mean(-1).sqrt().median())


def _transfer_error(homography: Tensor, x1: Tensor, x2: Tensor) -> float:
    """Median over the problems of the RMS distance between exact points and their images from view 2."""
    image = homogeneous(x2) @ homography.mT
    return float((image[..., :2] / image[..., 2:] - x1).square().sum(-1).mean(-1).sqrt().median())


def growth(config: Config) -> list[Row]:
    """Section 3."""
    rows = []
    sizes = (1_000, 10_000) if config.quick else (10_000, 100_000, 1_000_000)
    for name, (invariant, scene) in SCENES.items():
        note(f"... growth of {name}")
        views = {n: scene(n=n, sigma=1e-3, generator=torch.Generator().manual_seed(0)).views for n in sizes}
        runs = {str(n): (lambda v=v, i=invariant: dyn.fit(i, *v)) for n, v in views.items()}
        with threads(1):
            found = interleaved(runs, 1 if config.quick else 3)
        for small_n, large_n in pairwise(sizes):
            ratio, setting = found[str(large_n)] / found[str(small_n)], f"N = {small_n}, one problem"
            rows.append(Row(f"{name}: time(10 N) / time(N)", setting, ratio, 12.0, at_most=True))
        largest = views[sizes[-1]]
        with threads(1):
            peak = _peak(runs[str(sizes[-1])])
        if peak is not None:
            limit = 3 * sum(x.nbytes for x in largest) / 2**20 + 200
            rows.append(Row(f"{name}: peak memory", f"N = {sizes[-1]}", peak, limit, at_most=True, unit=" MB"))
    return rows


def _peak(run: Callable[[], object]) -> float | None:
    """Megabytes above the present state while ``run`` works; None where the system does not say."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return None
    before, _ = _memory("VmRSS"), run()
    return max(0.0, _memory("VmHWM") - before)


def _memory(field: str) -> float:
    return int(Path("/proc/self/status").read_text().split(f"{field}:")[1].split()[0]) / 1024


@experiment(Config(), quick={"rounds": 1}, one_thread=False)
def tables(config: Config) -> Tables:
    """Whole fits against rows + SVD, kornia and OpenCV; quick: small batches, the figures mean nothing."""
    yield "Large invariants", large(config, "cpu")
    yield "Small invariants", small(config)
    yield "Growth", growth(config)
    if torch.cuda.is_available():
        yield "Large invariants on the GPU", large(config, "cuda")
