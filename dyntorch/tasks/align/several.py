"""More than three views: the motion of three views carried on to all others, and what is asked of all choices of views."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations

import torch
from torch import Tensor

from dyntorch.core.invariant import Invariant
from dyntorch.core.limits import median, three_sigma
from dyntorch.core.matches import Matches
from dyntorch.core.normalize import normalize_motion
from dyntorch.core.outcome import is_failure
from dyntorch.core.solution import Solution
from dyntorch.geometry.homogeneous import homogeneous, unit
from dyntorch.invariants.dynamic_tensor import DynamicMotion, flat_residual, nearest_flats
from dyntorch.invariants.homography_tensor import HomographyTensor
from dyntorch.invariants.join_tensor import JoinTensor
from dyntorch.numerics.blocks import select, uniform
from dyntorch.numerics.nullspace import null_space
from dyntorch.tasks.align.labelling import ROUGH_LABEL_FACTOR, Evidence

NUM_RESECTION_SAMPLES = 256  # per view: 99.9 % to draw a clean one at 30 % wrong points
RESECTION_SAMPLE_SIZE = 10  # 8 determine a collineation of the plane or of space
NUM_RESECTION_ROUNDS = 4  # reweighted fits to all matches after that


def moving_points(dim: int, views: int) -> Invariant:
    """The invariant of points on straight lines of a plane or of space: for three views its tensor, for more the motion."""
    if views > 3:
        return DynamicMotion(dim, views, 2)
    return HomographyTensor() if dim == 2 else JoinTensor()


def motion_of_all(
    evidence: Evidence, solve: Callable[[tuple[Tensor, ...]], Solution], given: Tensor | None, generator: torch.Generator | None
) -> tuple[tuple[Tensor, ...], Solution]:
    """The normalized collineations ``(b, d + 1, d + 1)`` from every view to the first, and the solution of three views behind
    them."""
    count = len(evidence.views)
    three = (0, count // 2, count - 1)
    found = solve(tuple(evidence.data.views[v] for v in three))
    parts = tuple(part.reshape(-1, *part.shape[-2:]) for part in found.motion)
    parts = normalize_motion(moving_points(parts[0].shape[-1] - 1, 3), parts, [evidence.norm.transforms[v] for v in three])
    if count == 3:
        return parts, found
    sound = ~is_failure(found.status.reshape(-1))
    eye = torch.eye(parts[0].shape[-1], dtype=parts[0].dtype, device=parts[0].device).expand_as(parts[0])
    known = dict(zip(three, (eye, *(select(sound & p.isfinite().flatten(1).all(-1), p, eye) for p in parts)), strict=True))
    planes, weights, noise = _flats_of(evidence, three, torch.stack([known[v] for v in three], dim=-3), given)
    for v in range(1, count):
        if v not in known:
            known[v] = resect_view(planes, evidence.views[v], evidence.norm.scales[v] * noise, weights, generator)
    return tuple(known[v] for v in range(1, count)), found


def _flats_of(evidence: Evidence, three: tuple[int, ...], maps: Tensor, given: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Hyperplanes ``(b, n, d, d + 1)`` of view 1 that meet in the line or the point of each match, weights, and the noise
    ``(b,)``."""
    points = torch.stack([evidence.views[v] for v in three], dim=-2)
    scales = torch.stack([evidence.norm.scales[v] for v in three], dim=-1)
    dim = points.shape[-1]
    line, point = (nearest_flats(maps, points, scales, step) for step in (2, 1))
    moving, still = (at.residual.square().sum((-2, -1)) for at in (line, point))
    present = evidence.data.weights > 0
    middle = torch.where(present, moving, torch.nan).nanmedian(-1).values.nan_to_num(nan=1.0)
    noise = (middle / median(dim - 1)).sqrt().maximum(evidence.floor) if given is None else given
    square = noise.square()[:, None]
    rests = still <= three_sigma(2 * dim) * square
    if evidence.data.static is not None:
        rests = rests | evidence.data.static
    good = present & (rests | (moving <= three_sigma(dim - 1) * square))
    thin = torch.nn.functional.pad(line.hyperplanes, (0, 0, 0, 1))
    planes = torch.where(rests[..., None, None], point.hyperplanes, thin)
    return planes, evidence.data.weights * good, noise


def resect_view(planes: Tensor, x: Tensor, sigma: Tensor, weights: Tensor, generator: torch.Generator | None) -> Tensor:
    r"""The collineation A of a view whose points lie on known flats of view 1: :math:`L_i A (x_i, 1) = 0`, robustly. planes
    ``(b, n, d, d + 1)``, x ``(b, n, d)``, sigma ``(b,)``, weights ``(b, n)`` -> ``(b, d + 1, d + 1)``."""
    b, n, _, size = planes.shape
    p = homogeneous(x)
    rows = (planes[..., :, None] * p[..., None, None, :]).flatten(-2)  # (b, n, d, N N)
    drawn = uniform(b, NUM_RESECTION_SAMPLES, n, generator=generator, device=x.device).masked_fill(weights[:, None] <= 0, 2.0)
    chosen = drawn.argsort(-1)[..., : min(n, RESECTION_SAMPLE_SIZE)]
    problem = torch.arange(b, device=x.device)[:, None, None]
    maps = null_space(rows[problem, chosen].flatten(2, 3))[..., 0, :].unflatten(-1, (size, size))
    limit = (ROUGH_LABEL_FACTOR * sigma).square()[:, None] * three_sigma(size - 1)
    best = ((_squares(planes, maps, p) / limit[..., None]).clamp(max=1.0) * weights[:, None]).sum(-1).argmin(-1)
    found = maps[torch.arange(b, device=x.device), best]
    for _ in range(NUM_RESECTION_ROUNDS):
        square, length = _squares(planes, found[:, None], p)[:, 0], _lengths(planes, found[:, None])[:, 0]
        trust = weights * (limit / (limit + square)).square()
        scaled = rows * (trust.sqrt() / length)[..., None, None]
        found = null_space(scaled.flatten(1, 2))[..., 0, :].unflatten(-1, (size, size))
    return unit(found)


def _lengths(planes: Tensor, maps: Tensor) -> Tensor:
    """Size ``(b, maps, n)`` of the normals of the hyperplanes in the view."""
    normals = (planes[:, None] @ maps[:, :, None])[..., :-1]
    return normals.square().sum((-2, -1)).sqrt().clamp(min=torch.finfo(normals.dtype).tiny ** 0.25)


def _squares(planes: Tensor, maps: Tensor, p: Tensor) -> Tensor:
    """Squares ``(b, maps, n)`` of the distances of points from the hyperplanes, as if these were orthogonal."""
    h = planes[:, None] @ maps[:, :, None]
    normals = h[..., :-1].square().sum(-1).clamp(min=torch.finfo(h.dtype).tiny)
    return ((h @ p[:, None, :, :, None])[..., 0].square() / normals).sum(-1)


def three_of(data: Matches) -> list[Matches]:
    """The matches of three views that may tell by themselves whether the motion is unique: of neighbours, and of the ends."""
    count = len(data.views)
    pairs = [(1, 2)] if count == 3 else [*((v, v + 1) for v in range(1, count - 1)), (1, count - 1)]
    return [
        Matches((data.views[0], data.views[a], data.views[b]), data.weights, data.static, data.batch, data.dtype, data.device)
        for a, b in pairs
    ]


def still_but_one(motion: Sequence[Tensor], views: Sequence[Tensor], scales: Sequence[Tensor], limit: Tensor) -> Tensor:
    """Matches ``(b, n)`` that stand still in all views but one, by squares of distances up to ``limit (b, 1)``."""
    eye = torch.eye(motion[0].shape[-1], dtype=motion[0].dtype, device=motion[0].device).expand_as(motion[0])
    maps = torch.stack([eye, *motion], dim=-3)
    agree = []
    for chosen in combinations(range(len(views)), len(views) - 1):
        part = flat_residual(maps[:, list(chosen)], [views[v] for v in chosen], [scales[v] for v in chosen], 1)
        agree.append(part.square().sum(-1) <= limit)
    return torch.stack(agree).any(0)
