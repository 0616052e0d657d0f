"""Speed of the scores of all shifts between two takes, beside one decomposition per shift, and the goals.  Needs no data.

    python -m experiments.benchmarks.synchronization            # a minute
    python -m experiments.benchmarks.synchronization --quick    # does it run at all

Same points: 60 s at 30 frames per second of 17 joints in both cameras, a fifth of them missing; the moments of the epipolar
constraint at all shifts, and the smallest eigenvalue of each, beside the singular values of the constraints at every shift.
Different points: 14 joints in each camera; the logarithms of the determinants.  Long takes: 10,000 frames of 20 rows each that
are combinations of 9 motions; the sum of the squared canonical correlations at 2001 shifts, beside the singular vectors of both
overlaps at every shift.  All on one thread; candidates take turns and the figure is the median over the rounds.  What takes one
shift after the other runs at one of 50, once, and its time is that of all.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch import synchronize
from dyntorch.geometry.epipolar import epipolar_variance
from dyntorch.geometry.homogeneous import homogeneous
from dyntorch.numerics import lags
from dyntorch.numerics.lags import Lags
from dyntorch.tasks.synchronize.subspace import subspace_curve
from experiments.common.runner import BaseConfig, Tables, experiment
from experiments.common.tables import Row
from experiments.common.timing import interleaved

GOALS = {"same": 0.05, "different": 0.3, "ratio": 200.0}
"""Seconds, seconds, and times the speed of a decomposition per shift."""
RANK = 9
LEAST = 0.3
"""Of the largest overlap: shifts with less are not scored."""


@dataclass(frozen=True)
class Config(BaseConfig):
    """Speed of the scores of all shifts."""

    rounds: int = 9
    """How often every candidate runs."""


@dataclass(frozen=True)
class Takes:
    """Two sequences; frame i of the first is the moment of frame i + shift of the second."""

    a: Tensor
    b: Tensor
    shift: int


def motion(frames: int, channels: int, generator: torch.Generator) -> Tensor:
    """``(frames, channels)`` smooth motions of size 1."""
    noise = torch.randn(frames + 60, channels, generator=generator, dtype=torch.float64)
    smooth = torch.nn.functional.avg_pool1d(noise.T[None], 31, 1)[0].T[:frames]
    return (smooth - smooth.mean(0)) / smooth.std(0)


def people(frames: int, joints: int, shift: int, missing: float = 0.2) -> Takes:
    """The same joints of a moving person in two perspective cameras, normalized, with noise, NaN where missing."""
    generator = torch.Generator().manual_seed(0)
    body = torch.rand(joints, 3, generator=generator, dtype=torch.float64) - 0.5
    space = body + 0.3 * motion(frames + shift, 3 * joints, generator).unflatten(-1, (joints, 3))
    views = []
    for turn in (0.0, 1.0):
        cosine, sine = torch.tensor(turn, dtype=torch.float64).cos(), torch.tensor(turn, dtype=torch.float64).sin()
        x, y, z = space.unbind(-1)
        depth = 4.5 - sine * x + cosine * z
        view = torch.stack([(cosine * x + sine * z) / depth, y / depth], dim=-1)
        view = (view - view.mean((0, 1))) / view.std()
        view = view + 0.01 * torch.randn(view.shape, generator=generator, dtype=torch.float64)
        view[torch.rand(view.shape[:-1], generator=generator) < missing] = torch.nan
        views.append(view)
    return Takes(views[0][shift:], views[1][:frames], shift)


def combinations(frames: int, rows: int, rank: int, shift: int, noise: float = 0.05) -> Takes:
    """Rows that are combinations of the same few motions, with noise."""
    generator = torch.Generator().manual_seed(1)
    common = motion(frames + shift, rank, generator)
    found = []
    for begin in (shift, 0):
        mixing = torch.randn(rank, rows, generator=generator, dtype=torch.float64)
        error = noise * torch.randn(frames, rows, generator=generator, dtype=torch.float64)
        found.append(common[begin : begin + frames] @ mixing + error)
    return Takes(found[0], found[1], shift)


def epipolar_scores(takes: Takes, window: Lags | None) -> Tensor:
    """Minus the variance of the epipolar residual at every shift."""
    moments, counts = lags.epipolar_moments(takes.a, takes.b, window)
    kept = enough(counts)
    return _placed(-epipolar_variance(moments[kept])[0], kept)


def subspace_scores(takes: Takes, window: Lags | None) -> Tensor:
    """The library's score of different points at every shift."""
    a, b = takes.a.unflatten(1, (-1, 2)), takes.b.unflatten(1, (-1, 2))
    window = window or (1 - len(a), len(b) - 1)
    scores = subspace_curve(a, b, torch.ones(a.shape[:2]), torch.ones(b.shape[:2]), window).scores
    return scores.nan_to_num(-torch.inf)


def epipolar_by_svd(takes: Takes, window: Lags) -> Tensor:
    """The same, shift by shift: the smallest singular value of the constraints of the overlap."""
    found = []
    for s in range(window[0], window[1] + 1):
        begin, end = max(0, -s), min(len(takes.a), len(takes.b) - s)
        x1, x2 = (homogeneous(x.flatten(0, 1)) for x in (takes.a[begin:end], takes.b[begin + s : end + s]))
        seen = (x1 + x2).isfinite().all(-1)
        constraints = (x2[seen, :, None] * x1[seen, None, :]).flatten(1)
        found.append(-torch.linalg.svdvals(constraints)[-1].square() / len(constraints))
    return torch.stack(found)


def log_determinants(takes: Takes, window: Lags | None, noise: float) -> Tensor:
    """Gaussian mutual information of the rows at every shift."""
    *covariances, counts = lags.lag_covariances(takes.a, takes.b, window)
    kept = enough(counts)
    aa, bb, ab = (c[kept] for c in covariances)
    lower_a, lower_b = (torch.linalg.cholesky(_loaded(c, noise)) for c in (aa, bb))
    across = torch.linalg.solve_triangular(lower_b, torch.linalg.solve_triangular(lower_a, ab, upper=False).mT, upper=False)
    rest = torch.linalg.cholesky(_loaded(-across @ across.mT, 1.0))
    return _placed(-rest.diagonal(dim1=-2, dim2=-1).log().sum(-1), kept)


def enough(counts: Tensor) -> Tensor:
    """Shifts of enough overlap to score them."""
    return counts > LEAST * counts.amax()


def _placed(scores: Tensor, kept: Tensor) -> Tensor:
    return scores.new_full(kept.shape, -torch.inf).masked_scatter(kept, scores)


def _loaded(covariance: Tensor, noise: float) -> Tensor:
    return covariance + noise**2 * torch.eye(covariance.shape[-1], dtype=covariance.dtype)


def canonical_sums(takes: Takes, window: Lags, rank: int) -> Tensor:
    """Sum of the squared canonical correlations at every shift, from all covariances at once."""
    first, second = lags.compress(takes.a, rank=rank), lags.compress(takes.b, rank=rank)
    aa, bb, ab, _ = lags.lag_covariances(first, second, window)
    lower_a, lower_b = torch.linalg.cholesky(aa), torch.linalg.cholesky(bb)
    across = torch.linalg.solve_triangular(lower_b, torch.linalg.solve_triangular(lower_a, ab, upper=False).mT, upper=False)
    return across.square().sum((-2, -1))


def canonical_by_svd(takes: Takes, window: Lags, rank: int) -> Tensor:
    """The same, shift by shift: leading singular vectors of both overlaps, and what is common to them."""
    a, b, found = takes.a, takes.b, []
    for s in range(window[0], window[1] + 1):
        begin, end = max(0, -s), min(len(a), len(b) - s)
        bases = []
        for part in (a[begin:end], b[begin + s : end + s]):
            bases.append(torch.linalg.svd(part - part.mean(0), full_matrices=False)[0][:, :rank])
        found.append((bases[0].mT @ bases[1]).square().sum())
    return torch.stack(found)


def same_points(config: Config) -> list[Row]:
    """All shifts of a take of 60 s, and those up to 30 s."""
    frames = 120 if config.quick else 1800
    takes, rows, name = people(frames, 17, 7 if config.quick else 137), [], "moments by FFT"
    for window in ((-(frames // 2), frames // 2), None):
        run = _of(epipolar_scores, takes, window)
        seconds = interleaved({name: run}, config.rounds)[name]
        title = f"same points, {frames} frames, 17 joints, {_number(takes, window)} shifts"
        rows.append(Row(f"{title}, time", name, seconds, None if config.quick else GOALS["same"], at_most=True, unit=" s"))
        rows.append(_error(title, name, run(), takes, window))
    whole = interleaved({"synchronize": lambda: synchronize(takes.a, takes.b, fps=30.0)}, config.rounds)["synchronize"]
    rows.append(Row(f"same points, {frames} frames, 17 joints, the whole verb, time", "dyntorch.synchronize", whole, unit=" s"))
    reach = frames // 2
    reference = sampled(lambda near: epipolar_by_svd(takes, near), reach)
    rows.append(
        Row(f"same points, {frames} frames, 17 joints, {2 * reach + 1} shifts, time", "SVD per shift", reference, unit=" s")
    )
    return rows


DIFFERENT: dict[str, Callable[[Takes, Lags | None], Tensor]] = {
    "covariances by FFT, Cholesky": lambda takes, window: log_determinants(takes, window, 0.05),
    "dyntorch's score": subspace_scores,
}
"""Scores of all shifts of points that do not correspond: whatever is here is timed and has to find the shift."""


def different_points(config: Config) -> list[Row]:
    """All shifts of a take of 60 s, 14 joints in each camera."""
    frames = 120 if config.quick else 1800
    takes, rows = combinations(frames, 28, RANK, 7 if config.quick else 137), []
    for window in ((-(frames // 2), frames // 2), None):
        candidates = {name: _of(score, takes, window) for name, score in DIFFERENT.items()}
        seconds = interleaved(candidates, config.rounds)
        title = f"different points, {frames} frames, 28 + 28 rows, {_number(takes, window)} shifts"
        for name, run in candidates.items():
            goal = None if config.quick else GOALS["different"]
            rows.append(Row(f"{title}, time", name, seconds[name], goal, at_most=True, unit=" s"))
            rows.append(_error(title, name, run(), takes, window))
    return rows


def long_takes(config: Config) -> list[Row]:
    """Canonical correlations at 2001 shifts of 10,000 frames; the singular values of each shift as the reference."""
    frames, reach = (300, 20) if config.quick else (10_000, 1000)
    takes, window = combinations(frames, 20, RANK, reach // 3), (-reach, reach)
    title = f"{frames} frames, 20 + 20 rows, {2 * reach + 1} shifts"
    fast = _of(canonical_sums, takes, window, RANK)
    seconds = interleaved({"dyntorch": fast}, config.rounds)["dyntorch"]
    reference = sampled(lambda near: canonical_by_svd(takes, near, RANK), reach)
    return [
        Row(f"{title}, time", "compressed, covariances by FFT", seconds, unit=" s"),
        Row(f"{title}, time", "SVD per shift", reference, unit=" s"),
        Row(f"{title}, faster", "SVD per shift / ours", reference / seconds, None if config.quick else GOALS["ratio"]),
        _error(title, "compressed, covariances by FFT", fast(), takes, window),
        _error(title, "SVD per shift", near(takes), takes, (takes.shift - 5, takes.shift + 5)),
    ]


def near(takes: Takes) -> Tensor:
    """The reference at the shifts around the true one."""
    return canonical_by_svd(takes, (takes.shift - 5, takes.shift + 5), RANK)


def sampled(run: Callable[[Lags], Tensor], reach: int, every: int = 50) -> float:
    """Seconds of the shifts up to ``reach`` by what takes them one by one, from one of ``every`` on, spread evenly."""
    shifts = list(range(-reach, reach + 1, every))
    start = time.perf_counter()
    for s in shifts:
        run((s, s))
    return (time.perf_counter() - start) / len(shifts) * (2 * reach + 1)


def _of(function: Callable[..., Tensor], *arguments: object) -> Callable[[], Tensor]:
    return lambda: function(*arguments)


def _number(takes: Takes, window: Lags | None) -> int:
    return len(takes.a) + len(takes.b) - 1 if window is None else window[1] - window[0] + 1


def _error(title: str, name: str, scores: Tensor, takes: Takes, window: Lags | None) -> Row:
    """Frames between the best shift and the true one."""
    first = 1 - len(takes.a) if window is None else window[0]
    return Row(f"{title}, error", name, abs(int(scores.argmax()) + first - takes.shift), 0.0, at_most=True, unit=" frames")


@experiment(Config(), quick={"rounds": 1})
def tables(config: Config) -> Tables:
    """Quick: short takes."""
    yield "same points", same_points(config)
    yield "different points", different_points(config)
    yield "long takes", long_takes(config)
