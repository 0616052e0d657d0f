r"""A camera against motion capture, by one camera matrix: of the same points (resection), or of combinations of other points.

What the camera sees of points in space is :math:`x \sim P X`, whatever the unit and the axes of the space: P is unknown, 3 x 4,
and the same in all frames.  Where both hold the same points, P is fitted to all frames at every shift, by moments that FFT gives
(:func:`dyntorch.numerics.lags.resection_moments`), and then, with the shift and the clock rate, to the distances in the image.

A joint that a network finds is near a fixed combination of markers, :math:`X_i = \bar X + \sum_k w_{ik} Y_k`: of the mean of all
markers and of few orthonormal combinations :math:`Y_k` of them, those that move most.  Combinations, camera and shift are fitted
together to the distances in the image,

.. math:: \min_{s, P, w} \sum_{it} \rho\bigl(|x_{it} - P(\bar X + \textstyle\sum_k w_{ik} Y_k)(t + s)|^2\bigr)
          + \sigma^2 |w|^2 / \omega^2,

from the lag that the row spaces give: these know whole frames well, and places between them as well as an affine camera does.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor

from dyntorch.geometry.epipolar import RIDGE, least_ratio
from dyntorch.numerics.lags import resection_moments
from dyntorch.numerics.least_squares import Iterate, LeastSquares, LeastSquaresOptions, Tensors, minimize
from dyntorch.tasks.synchronize.epipolar import (
    MAX_CORRELATION_SECONDS,
    MIN_CORRELATION_BLOCKS,
    ROBUST_CUTOFF_SIGMAS,
    Grid,
    Matched,
    PairModel,
    Residuals,
    Samples,
    ShiftDescent,
    long_run_sigma,
)
from dyntorch.tasks.synchronize.subspace import fill_gaps, regress_missing
from dyntorch.tasks.synchronize.tracks import Tracks, image_of, smooth_at

# ----------------------------------------------------------------------------------------------------------------------
# The camera of least residual from moments, at all shifts at once.


def camera_variance(moments: Tensor, noise: float = 1.0) -> tuple[Tensor, Tensor]:
    r"""The least variance of what a camera leaves of its images, and the camera that has it. moments ``(*batch, 4, 4, 4)`` ->
    ``(*batch,)``."""
    total = moments[..., 0, 3, 3]
    present = total > 0
    unit = torch.eye(4, dtype=moments.dtype, device=moments.device)
    mean = moments / torch.where(present, total, 1.0)[..., None, None, None]
    whole = torch.where(present[..., None, None], mean[..., 0, :, :], unit)
    ridge = RIDGE * whole.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None] * unit
    factor, failed = torch.linalg.cholesky_ex(whole + ridge)
    present = present & (failed == 0)
    factor = torch.where(present[..., None, None], factor, unit)
    across, down = (torch.cholesky_solve(mean[..., k, :, :], factor) for k in (1, 2))
    left = mean[..., 3, :, :] - mean[..., 1, :, :] @ across - mean[..., 2, :, :] @ down
    left = (left + left.mT) / 2
    # in a direction that no point leaves, both forms are zero; the ridge of the numerator alone keeps it from being the answer
    ridge = RIDGE * mean[..., 3, :, :].diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None] * unit
    left = torch.where(present[..., None, None], left + ridge, unit)
    ratio, third = least_ratio(left, 2 * noise**2 * whole, present)
    camera = torch.stack([(across @ third[..., None])[..., 0], (down @ third[..., None])[..., 0], third], dim=-2)
    bad = ~ratio.isfinite()[..., None, None]
    norm = torch.linalg.matrix_norm(camera, keepdim=True)
    return ratio, torch.where(bad, 0.0, camera / torch.where(bad, 1.0, norm))


@dataclass(frozen=True, eq=False)
class SpaceSamples(Samples):
    """Smoothed, normalized points of a camera ``(m, n, 2)`` and the same points in space ``(m, n, 3)``, in either order."""

    @classmethod
    def of(cls, a: Tracks, b: Tracks, step: float, rate: float = 1.0) -> Self:
        """As of two cameras; the noise is that of the camera alone."""
        found = super().of(a, b, step, rate)
        unit = float(image_of(a, b).change[0, 0])
        return replace(found, noise=(unit, unit))

    def moments(self, lags: tuple[int, int], per_point: bool = False) -> tuple[Tensor, Tensor]:
        """Moments ``([n,] L, 4, 4, 4)`` at lags, and counts ``([n,] L)``."""
        if self.x1.shape[-1] == 2:
            return resection_moments(self.x1, self.x2, lags, (self.w1, self.w2), per_point)
        moments, counts = resection_moments(self.x2, self.x1, (-lags[1], -lags[0]), (self.w2, self.w1), per_point)
        return moments.flip(-4), counts.flip(-1)

    def solve(self, moments: Tensor) -> tuple[Tensor, Tensor]:
        """Variances ``(L,)``, px^2, and cameras ``(L, 3, 4)``."""
        return camera_variance(moments, self.noise[0])

    def variances_by(self, geometry: Tensor, moments: Tensor) -> Tensor:
        """``(n,)`` each point's residual variance by one camera; NaN where it is never seen."""
        first, second, third = geometry
        plain, across, down, square = moments.unbind(1)
        above = torch.einsum("i,nij,j->n", third, square, third)
        for row, mixed in ((first, across), (second, down)):
            above = above + torch.einsum("i,nij,j->n", row, plain, row) - 2 * torch.einsum("i,nij,j->n", row, mixed, third)
        below = 2 * self.noise[0] ** 2 * torch.einsum("i,nij,j->n", third, plain, third)
        return torch.where(below > 0, above / torch.where(below > 0, below, 1.0), torch.nan)


# ----------------------------------------------------------------------------------------------------------------------
# Offset, clock rate and camera at once: robust least squares of the distances in the image.


MIN_DEPTH_RATIO = 0.05  # Least depth before the camera, over the median one, that an image is computed from.


class SpaceDescent(ShiftDescent):
    """The problem for a camera and points in space, in either order; the geometry is the camera ``(3, 4)``, of norm 1."""

    def __init__(self, a: Tracks, b: Tracks, width: float, rows: int | None = None) -> None:
        super().__init__(a, b, width, rows)
        unit = float(image_of(a, b).change[0, 0])
        self.noise = (unit, unit)
        # velocities of the space are as good as exact, those of a camera are not
        self.speed = None if image_of(a, b) is a else smooth_at(a, self.times, width)[1]

    def _match(self, offset: float, rate: float, every: int = 1) -> Matched | None:
        """As of two cameras, the image as p and the space as q; the speed is that of the space by the offset."""
        found = super()._match(offset, rate, every)
        if found is None or self.speed is None:
            return found
        # b shows later what it would show without the offset: as if a were earlier
        speed = torch.nn.functional.pad(self.speed[::every][found.both], (0, 1)) @ self.changes[0].mT / -rate
        return replace(found, p=found.q, q=found.p, speed=speed)

    def _moments(self, matched: Matched) -> Tensor:
        """What variance and camera follow from, ``(4, 4, 4)``."""
        x = matched.p[:, :2]
        of_image = torch.cat([torch.ones_like(x[:, :1]), x, x.square().sum(-1, keepdim=True)], dim=-1) * matched.sure[:, None]
        moments = of_image.mT @ (matched.q[:, :, None] * matched.q[:, None]).flatten(1)
        return moments.unflatten(1, (4, 4))

    def _solve(self, moments: Tensor) -> tuple[Tensor, Tensor]:
        """Variance and camera by the moments alone, of several states."""
        return camera_variance(moments, self.noise[0])

    @staticmethod
    def _nearest(matrix: Tensor) -> Tensor:
        return matrix / matrix.norm().clamp(min=1e-300)

    @staticmethod
    def _tangent(matrix: Tensor) -> Tensor:
        """``(11, 12)`` orthonormal directions that keep the norm."""
        return torch.linalg.qr(matrix.reshape(12, 1), mode="complete")[0][:, 1:].mT

    def _residuals(self, F: Tensor, matched: Matched, times: Tensor) -> SpaceRows:
        """Distances from the images, across and down, px."""
        images, speed = matched.q @ F.mT, matched.speed @ F.mT
        depth = images[:, 2]
        side = 1.0 if float(depth.sum()) >= 0 else -1.0
        # a point near the camera's own plane, or behind, has no image: as if it were close, it is far off and weighs nothing
        depth = side * (side * depth).clamp(min=MIN_DEPTH_RATIO * float(depth.abs().median()))
        seen = images[:, :2] / depth[:, None]
        residual = (seen - matched.p[:, :2]) / self.noise[0]
        along = (speed[:, :2] - seen * speed[:, 2:]) / (depth[:, None] * self.noise[0])
        rays = matched.q / (depth[:, None] * self.noise[0])
        products = rays.new_zeros(len(rays), 2, 3, 4)
        products[:, 0, 0] = products[:, 1, 1] = rays
        products[:, :, 2] = -seen[..., None] * rays[:, None]
        return SpaceRows(
            residual.flatten(), products.flatten(0, 1).flatten(1), along.flatten(), times.repeat_interleave(2), matched.both,
            matched.sure,
        )  # fmt: skip

    def _denormalize(self, F: Tensor) -> Tensor:
        image, space = self.changes if self.speed is None else self.changes[::-1]
        return torch.linalg.solve(image, F @ space)


@dataclass(frozen=True, eq=False)
class SpaceRows(Residuals):
    """Two residuals for every position, ``(2 m,)``."""

    @property
    def distances(self) -> Tensor:
        """``(m,)`` in the image, so that their median is that of the absolute value of one coordinate."""
        # a normal coordinate has the median .6745, the distance of two 1.1774
        return 0.6745 / 1.1774 * self.residual.unflatten(0, (-1, 2)).norm(dim=-1)

    @property
    def frames(self) -> Tensor:
        """Frame of every residual."""
        return super().frames.repeat_interleave(2)

    def weights(self) -> Tensor:
        """Of Geman and McClure, one for both coordinates."""
        return super().weights().repeat_interleave(2)


CAMERA = PairModel("camera", SpaceSamples, SpaceDescent)
"""A camera, and the same points in space."""


@dataclass(frozen=True, eq=False)
class CombinedFit:
    """A minimum."""

    offset: float  # of the space's clock at time 0 of the camera's, seconds
    sigma: float  # its standard deviation, robust against what residuals have in common over time
    residual: float  # robust standard deviation of a coordinate, px
    camera: Tensor  # ``(3, 4)``, of normalized coordinates
    weights: Tensor  # ``(n, k)``


NUM_REWEIGHTINGS = 4  # Robust reweightings.
MAX_ITERATIONS = 30  # Steps of each.
COST_TOLERANCE = 1e-7  # Relative decrease of the cost that ends them.


def fit_combination(film: Tracks, space: Tracks, offset: float, rate: float) -> CombinedFit | None:
    """The shift near an offset at which combinations of the points in space are what the camera sees; None where none is
    found."""
    problem = _CombinationProblem.of(film, space, offset, rate)
    if problem is None:
        return None
    theta = problem.start()
    if theta is None:
        return None
    for _ in range(NUM_REWEIGHTINGS):
        start = problem.evaluate(theta)
        if not bool(start.cost.isfinite()):
            return None
        theta = minimize(problem, start, LeastSquaresOptions(iterations=MAX_ITERATIONS, tolerance=COST_TOLERANCE)).theta
        problem = problem.reweight(theta)
    return problem.fit(theta)


NUM_START_COMBINATIONS = 4  # Those of the first affine camera.
START_RIDGE = 1e-3  # Ridge of its regressions, mean squares of coordinates of order 1.
WEIGHT_SIGMA = 1.0  # Standard deviation of a combination's weights.
MAX_SHIFT_FRAMES = 3.0  # Range about the lag of the row spaces, frames.
MIN_FRAMES = 24  # Frames per point.
MAX_COMBINED_ROWS = 40_000  # Positions; of longer videos frames at equal distances.
MIN_RESIDUAL = 1e-6  # Residual of normalized coordinates that is rounding.
COMBINED_SIGMA_INFLATION = 3.0  # True errors over the sigma of the residuals: a joint is only nearly a combination.
MIN_COMBINED_SIGMA_FRAMES = 0.05  # Error at least, frames.


@dataclass(frozen=True, eq=False)
class _CombinationProblem(LeastSquares):
    """One problem: parameters are the camera ``(1, 3, 4)``, weights ``(1, n, k)`` and the shift from the start in frames."""

    x: Tensor  # (T, n, 2) normalized
    sure: Tensor  # (T, n) weights as given, 0 where not seen
    robust: Tensor  # (T, n)
    times: Tensor  # (T,) of the space's clock at the start
    grid: Grid  # of the middle and the combinations, (m, 1 + k, 3)
    frame: float
    offset: float
    width: float
    unit: float  # normalized per px
    ridge: float

    @staticmethod
    def of(film: Tracks, space: Tracks, offset: float, rate: float) -> _CombinationProblem | None:
        frame = max(film.step, space.step)
        stride = max(1, math.ceil(len(film.times) * film.x.shape[1] / MAX_COMBINED_ROWS))
        times = film.every(frame * stride)
        x, _, sure = smooth_at(film, times, frame)
        change = film.change
        x = torch.where((sure > 0)[..., None], x @ change[:2, :2].mT + change[:2, 2], 0.0)
        grid = Grid.of(_combinations(space, film.noise / max(film.scale, 1e-300)), frame)
        there = times * rate + offset
        reach = MAX_SHIFT_FRAMES * frame
        first, last = grid.start + reach, grid.start + (len(grid.x) - 1) * grid.step - reach
        sure = torch.where(((there >= first) & (there <= last))[:, None], sure, 0.0)
        if int((sure > 0).sum()) < MIN_FRAMES * film.x.shape[1]:
            return None
        unit = float(change[0, 0])
        return _CombinationProblem(x, sure, torch.ones_like(sure), there, grid, frame, offset, frame, unit, unit**2)

    def start(self) -> Tensors | None:
        """An affine camera and weights: regressions of all coordinates on those in space have the form :math:`w_i \\otimes A`."""
        places, _, _ = self.grid.at(self.times)
        kept = min(places.shape[1] - 1, NUM_START_COMBINATIONS)
        design = torch.cat([places[:, : 1 + kept].flatten(1), torch.ones_like(places[:, 0, :1])], 1)
        weights = self.sure.mT  # (n, T)
        normal = torch.einsum("nt,ti,tj->nij", weights, design, design)
        size = weights.sum(-1)[:, None, None] * torch.eye(design.shape[1], dtype=design.dtype, device=design.device)
        right = torch.einsum("nt,ti,tnc->nic", weights, design, self.x)
        found, failed = torch.linalg.solve_ex(normal + START_RIDGE * size, right)
        if bool(failed.any()) or not bool(found.isfinite().all()):
            return None
        own = found[:, :3].mean(0)  # (3, 2) of the middle
        block = found[:, 3 : 3 + 3 * kept].unflatten(1, (kept, 3))  # (n, k, 3, 2)
        left, values, right = torch.linalg.svd(block.flatten(2).flatten(0, 1), full_matrices=False)
        camera = right[0].unflatten(0, (3, 2))
        along = float((own * camera).sum())
        scale = along if abs(along) > 1e-9 else 1.0
        shares = (left[:, 0] * values[0] / scale).unflatten(0, (len(found), kept))
        P = self.x.new_zeros(3, 4)
        P[:2, :3] = scale * camera.mT
        P[2, 3] = 1.0
        W = self.x.new_zeros(len(found), places.shape[1] - 1)
        W[:, :kept] = shares
        whole = places[:, None, 0] + torch.einsum("nk,tkd->tnd", W, places[:, 1:])
        away = self.x - whole @ P[:2, :3].mT
        P[:2, 3] = (away * self.sure[..., None]).sum((0, 1)) / self.sure.sum()
        return P[None], W[None], self.x.new_zeros(1, 1)

    def _images(self, theta: Tensors) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Images ``(T, n, 2)``, depths, points ``(T, n, 3)``, their velocities, and the combinations ``(T, 1 + k, 3)``."""
        P, W, shift = (part[0] for part in theta)
        places, speeds, _ = self.grid.at(self.times + self.frame * shift)
        X = places[:, None, 0] + torch.einsum("nk,tkd->tnd", W, places[:, 1:])
        V = speeds[:, None, 0] + torch.einsum("nk,tkd->tnd", W, speeds[:, 1:])
        local = X @ P[:, :3].mT + P[:, 3]
        return local[..., :2] / local[..., 2:], local[..., 2], X, V, places

    def evaluate(self, theta: Tensors) -> Iterate:
        """The cost; infinite where a point is not before the camera, or the shift has left."""
        P, W, shift = theta
        P = P / P.flatten(1).norm(dim=-1)[:, None, None].clamp(min=1e-30)
        theta = (P, W, shift)
        images, depth, *_ = self._images(theta)
        weight = self.sure * self.robust
        # depths are of one sign; the camera may have either
        front = bool(((depth > 0) | (weight == 0)).all()) or bool(((depth < 0) | (weight == 0)).all())
        inside = float(shift.abs().max()) <= MAX_SHIFT_FRAMES
        cost = (weight * (images - self.x).square().sum(-1)).sum() + self.ridge * W.square().sum()
        return Iterate(theta, cost[None] if front and inside else torch.full_like(shift[:, 0], math.inf), ())

    def _derivatives(self, theta: Tensors) -> tuple[Tensor, Tensor, Tensor]:
        """Residuals ``(n, 2 T)``, and derivatives by the weights ``(n, 2 T, k)`` and by camera and shift ``(n, 2 T, 13)``."""
        P = theta[0][0]
        images, depth, X, V, places = self._images(theta)
        root = (self.sure * self.robust).sqrt()[..., None]
        rows = (P[:2, :3] - images[..., None] * P[2, :3]) / depth[..., None, None]  # (T, n, 2, 3) by the point
        by_weights = torch.einsum("tncd,tkd->tnck", rows, places[:, 1:])
        by_shift = self.frame * torch.einsum("tncd,tnd->tnc", rows, V)
        rays = torch.cat([X, torch.ones_like(depth)[..., None]], -1) / depth[..., None]
        by_camera = X.new_zeros(*images.shape, 3, 4)
        by_camera[..., 0, 0, :] = by_camera[..., 1, 1, :] = rays
        by_camera[..., 2, :] = -images[..., None] * rays[..., None, :]
        common = torch.cat([by_camera.flatten(-2), by_shift[..., None]], -1)
        residual = (images - self.x) * root
        return (
            residual.movedim(1, 0).flatten(1),
            (by_weights * root[..., None]).movedim(1, 0).flatten(1, 2),
            (common * root[..., None]).movedim(1, 0).flatten(1, 2),
        )

    def step(self, at: Iterate, damping: Tensor) -> Tensors:
        """The weights of each point are eliminated: what is left is camera and shift."""
        P, W, _ = at.theta
        residual, own, common = self._derivatives(at.theta)
        A = own.mT @ own
        unit = torch.eye(A.shape[-1], dtype=A.dtype, device=A.device)
        A = A + self.ridge * unit + damping * torch.diag_embed(A.diagonal(dim1=-2, dim2=-1))
        B, C = own.mT @ common, (common.mT @ common).sum(0)
        gradient = (own.mT @ residual[..., None])[..., 0] + self.ridge * W[0]
        shared = torch.einsum("nti,nt->i", common, residual)
        solved = torch.linalg.solve_ex(A, torch.cat([B, gradient[..., None]], -1))[0]
        inner = C + damping * torch.diag(C.diagonal()) - (B.mT @ solved[..., :-1]).sum(0)
        # the norm of the camera is free
        normal = torch.cat([P[0].flatten(), P.new_zeros(1)])
        inner = inner + inner.diagonal().abs().max() * torch.outer(normal, normal)
        move = torch.linalg.solve_ex(inner, shared - torch.einsum("nki,nk->i", B, solved[..., -1]))[0]
        weights = solved[..., -1] - solved[..., :-1] @ move
        return move[:12].unflatten(0, (1, 3, 4)), weights[None], move[12:][None]

    def subset(self, keep: Tensor) -> _CombinationProblem:
        """There is one."""
        return self

    def reweight(self, theta: Tensors) -> _CombinationProblem:
        """With robust weights at these parameters, and the ridge that the residual asks for."""
        distance = (self._images(theta)[0] - self.x).norm(dim=-1)
        scale = float(distance[self.sure > 0].median()) / 1.1774
        scale = max(scale, MIN_RESIDUAL)
        robust = (1 + (distance / (ROBUST_CUTOFF_SIGMAS * scale * math.sqrt(2))).square()).pow(-2)
        return dataclasses.replace(self, robust=robust, ridge=(scale / WEIGHT_SIGMA) ** 2)

    def fit(self, theta: Tensors) -> CombinedFit | None:
        """What is found, with the influence of every frame on the shift."""
        residual, own, common = self._derivatives(theta)
        A = own.mT @ own + self.ridge * torch.eye(own.shape[-1], dtype=own.dtype, device=own.device)
        free = common - own @ torch.linalg.solve_ex(A, own.mT @ common)[0]
        inner = (common.mT @ free).sum(0)
        inverse = torch.linalg.pinv((inner + inner.mT) / 2, hermitian=True, rtol=1e-10)
        influence = torch.einsum("nti,i->nt", free, inverse[:, 12]) * residual
        frames = influence.unflatten(1, (len(self.times), 2)).sum((0, 2))[:, None]
        step = float(self.times[1] - self.times[0])
        span = float(self.times[-1] - self.times[0])
        memory = round(min(MAX_CORRELATION_SECONDS, span / MIN_CORRELATION_BLOCKS) / step)
        sigma = self.frame * COMBINED_SIGMA_INFLATION * float(long_run_sigma(frames, memory)[0])
        if not math.isfinite(sigma):
            return None
        distance = (self._images(theta)[0] - self.x).norm(dim=-1)[self.sure > 0]
        shift = float(theta[2]) * self.frame
        return CombinedFit(
            offset=self.offset + shift,
            sigma=math.hypot(sigma, MIN_COMBINED_SIGMA_FRAMES * self.frame),
            residual=float(distance.median()) / 1.1774 / self.unit,
            camera=theta[0][0],
            weights=theta[1][0],
        )


MAX_COMBINATIONS = 8  # Combinations besides the mean: RMS error of 15 videos, 8 / 12 / 20: .25 / .26 / .26 frames.
MIN_MOTION_RATIO = 1.0  # Motion of a combination over the noise from which it counts: RMS error at .5 / 1 / 2: .26 / .26 / .42.


def _combinations(space: Tracks, noise: float) -> Tracks:
    """The middle of all points, then orthonormal combinations about it that move by more than the noise, in units of the size."""
    seen = space.weights > 0
    x = regress_missing(fill_gaps(space.x, seen), seen)
    middle = x.mean(1, keepdim=True)
    about = (x - middle) / max(float((x - middle).square().sum((1, 2)).mean().sqrt()), 1e-300)
    by_point = about.movedim(1, 0).flatten(1)
    values, vectors = torch.linalg.eigh(by_point @ by_point.mT / len(x))
    kept = int((values > (MIN_MOTION_RATIO * noise) ** 2).sum())
    kept = min(max(kept, NUM_START_COMBINATIONS), MAX_COMBINATIONS, len(values))
    parts = torch.einsum("tnd,nk->tkd", about, vectors[:, len(values) - kept :].flip(-1))
    scale = max(float((x - middle).square().sum((1, 2)).mean().sqrt()), 1e-300)
    whole = torch.cat([(middle - middle.mean(0)) / scale, parts], dim=1)
    return dataclasses.replace(space, x=whole, weights=torch.ones_like(whole[..., 0]))
