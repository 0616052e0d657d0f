"""Batched bundle adjustment for projections P^k -> P^l: cameras and points that minimize the reprojection error."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from math import prod

import torch
from torch import Tensor
from torch.nn.functional import normalize

from dyntorch.geometry.triangulation import mask_missing
from dyntorch.numerics.arguments import check_tensor, check_together
from dyntorch.numerics.blocks import each, map_blocks, one_thread, select, workers
from dyntorch.numerics.least_squares import Iterate, LeastSquares, LeastSquaresOptions, Tensors, damped_step, minimize

# ----------------------------------------------------------------------------------------------------------------------
# Cameras of known calibration: the nearest ones to any matrices, and the steps that stay among them.


@dataclass(frozen=True)
class CalibratedCameras:
    r"""Cameras :math:`P \sim K\,[R_{:d} \mid *]` of known K: their first d columns are those of a rotation, the others are
    free."""

    matrices: Tensor
    """``(b, v, l + 1, l + 1)``."""
    turned: int
    """d."""

    def parts(self, cameras: Tensor) -> tuple[Tensor, Tensor]:
        """The orthonormal columns ``(b, v, 3, d)`` next to a camera and the others ``(b, v, 3, *)``, in units of the same
        scale."""
        seen = torch.linalg.solve_ex(self.matrices, cameras)[0]
        if cameras.shape[-2] == 4:
            last = seen[..., -1:, -1:]
            seen = seen / torch.where(last.abs() > TINY, last, 1.0)
        d = self.turned
        seen = torch.where(seen.isfinite(), seen, 0.0)[..., :3, :]
        u, s, vh = torch.linalg.svd(seen[..., :d], full_matrices=False)
        size = s.mean(-1)[..., None, None].clamp(min=TINY) if cameras.shape[-2] == 3 else torch.ones_like(s[..., :1, None])
        return u @ vh, seen[..., d:] / size

    def nearest(self, cameras: Tensor) -> Tensor:
        """The cameras of these calibrations next to any, ``(b, v, l + 1, a + 1)`` of any scale."""
        turn, rest = self.parts(cameras)
        found = torch.cat([turn, rest], dim=-1)
        if cameras.shape[-2] == 4:
            last = torch.eye(4, dtype=found.dtype, device=found.device)[3:, -found.shape[-1] :]
            found = torch.cat([found, last.expand(*found.shape[:-2], 1, -1)], dim=-2)
        return self.matrices @ found

    def tangents(self, cameras: Tensor) -> Tensor:
        """Changes of the entries of cameras of these calibrations, ``(b, v, (l + 1)(a + 1), p)``: turns, then the free columns."""
        turn, rest = self.parts(cameras)
        d, free = self.turned, rest.shape[-1]
        eye = torch.eye(3, dtype=cameras.dtype, device=cameras.device)
        size = torch.linalg.matrix_norm(torch.cat([turn, rest], dim=-1), keepdim=True)
        turns = torch.linalg.cross(eye[:, None, None, None, :], turn.mT[None], dim=-1).mT  # (3, b, v, 3, d)
        total = cameras.new_zeros(3 + 3 * free, *cameras.shape[:2], cameras.shape[-2], cameras.shape[-1])
        total[:3, :, :, :3, :d] = turns
        for column in range(free):
            for row in range(3):
                total[3 + 3 * column + row, :, :, row, d + column] = 1.0
        return (self.matrices @ total / size).flatten(-2).permute(1, 2, 3, 0)

    def step(self, cameras: Tensor, gradient: Tensor, matrix: Tensor, damping: Tensor) -> Tensor:
        """The damped step within these cameras, from the gradient by their entries and its matrix ``(b, p, p)``."""
        basis = self.tangents(cameras)
        b, v, entries, free = basis.shape
        inner = torch.einsum("bvep,bvewf,bwfq->bvpwq", basis, matrix.view(b, v, entries, v, entries), basis)
        slope = (basis.mT @ gradient.flatten(2)[..., None]).flatten(1)
        move = damped_step(slope, inner.reshape(b, v * free, v * free), damping).view(b, v, free, 1)
        return (basis @ move).view_as(cameras)


def calibrations(calibration: Tensor, batch: tuple[int, ...], views: int, like: Tensor, size: int = 2) -> Tensor:
    """K of every view, ``(b, views, size + 1, size + 1)``, from one for all, one for each view, or also for each problem."""
    want = (*batch, views, size + 1, size + 1)
    shapes = ((size + 1, size + 1), want[-3:], want)
    if not isinstance(calibration, Tensor) or tuple(calibration.shape) not in shapes:
        got = tuple(calibration.shape) if isinstance(calibration, Tensor) else type(calibration).__name__
        raise ValueError(f"calibration must be a tensor K {' or '.join(map(str, dict.fromkeys(shapes)))}, got {got}")
    K = calibration.detach().to(like).expand(want).reshape(prod(batch), views, size + 1, size + 1)
    if not bool(K.isfinite().all()) or bool((torch.linalg.det(K) == 0).any()):
        raise ValueError("calibration must be finite and invertible; a camera has K = [f 0 u; 0 f v; 0 0 1]")
    if size == 2 and bool((K[..., 2, :2] != 0).any()):
        raise ValueError(
            f"calibration must have the last row (0, 0, 1), got {K[..., 2, :].reshape(-1, 3)[0].tolist()}; transposed?"
        )
    return K


# ----------------------------------------------------------------------------------------------------------------------
# Batched bundle adjustment for projections P^k -> P^l: cameras and points that minimize the reprojection error.


# ----------------------------------------------------------------------------------------------------------------------
# The least squares problem of bundle adjustment: reprojection errors in cameras and points, and its damped step.
#
# The points are eliminated first, each by the Cholesky factorization of its :math:`K \times K` block, column by column for all
# points at once: their index is the last one of every array here.  (64 problems of 60 points of P^4: 0.09 us per point, LAPACK on
# one matrix after the other 0.28 us; a single problem loses 0.08 ms that way.)


TINY = 1e-300


@dataclass(frozen=True)
class BundleProblem(LeastSquares):
    r"""Minimize :math:`\sum_{ij} w_{ij}\, \rho(|x_{ij} - \pi(P_i B_i Y_j)|^2)` over a block of problems."""

    x: Tensor
    """``(b, v, l, n)``, any finite value where the weight is 0."""
    weights: Tensor
    """``(b, v, n)``."""
    lifts: Tensor | None
    """``(b, v, a + 1, k + 1)``, or None for the identity."""
    scale: Tensor | None
    """``(b,)`` the error beyond which one counts as an outlier, or None for least squares."""
    outside: Tensor | None = None
    """``(b, k + 1, k + 1, n)`` projector onto what is forbidden to each point, 0 for free points; None where all are free."""
    calibration: CalibratedCameras | None = None
    """Cameras that are confined to known calibrations; None where they are any matrices."""

    def subset(self, keep: Tensor) -> BundleProblem:
        """Only some of the problems."""
        return each(lambda part: part[keep], self)

    def world(self, points: Tensor) -> Tensor:
        """The points :math:`B_i Y_j` that the cameras see, ``(b, v, a + 1, n)``."""
        if self.lifts is None:
            return points[:, None].expand(-1, self.x.shape[1], -1, -1)
        return self.lifts @ points[:, None]

    def images(self, cameras: Tensor, world: Tensor) -> tuple[Tensor, Tensor]:
        """Images ``(b, v, l, n)`` and depths ``(b, v, n)``, which are 1 where a point is missing."""
        image = cameras @ world
        depth = torch.where(self.weights > 0, image[:, :, -1], 1.0)
        return image[:, :, :-1] / depth[:, :, None], depth

    def costs(self, cameras: Tensor, points: Tensor) -> Tensor:
        """The cost of each point, ``(b, n)``, infinite where it is not finite."""
        return self.robust(self.images(cameras, self.world(points))[0])[0]

    def robust(self, images: Tensor) -> tuple[Tensor, Tensor]:
        r"""The cost ``(b, n)`` of images, and their weights :math:`w \rho'` ``(b, v, n)`` in the quadratic model of it."""
        square = (images - self.x).square().sum(2)
        if self.scale is None:
            value, slope = square * self.weights, self.weights
        else:
            c = self.scale.square()[:, None, None]
            share = c / (c + square)
            value, slope = square * share * self.weights, share.square() * self.weights
        total = value.sum(1)
        return torch.where(total.isfinite(), total, torch.inf), slope

    def evaluate(self, theta: Tensors) -> Iterate:
        """The cost of cameras and points, of norm 1."""
        cameras, points = self._cameras(theta[0]), normalize(theta[1], dim=1)
        return Iterate((cameras, points), self.costs(cameras, points).sum(-1), ())

    def _cameras(self, cameras: Tensor) -> Tensor:
        """Cameras of norm 1, the nearest ones of their calibrations where these are known."""
        allowed = cameras if self.calibration is None else self.calibration.nearest(cameras)
        return normalize(allowed.flatten(2), dim=-1).view_as(cameras)

    def step(self, at: Iterate, damping: Tensor) -> Tensors:
        r"""The step of Levenberg and Marquardt, to be subtracted, by the Schur complement. at ``(b, v, l + 1, a + 1)``, damping
        ``(b,)`` -> ``(b,)``."""
        cameras, points = at.theta
        linear = self._linear(cameras, points)
        images, slope, error = linear.images, linear.slope, linear.error
        panel, pivots = _eliminate_points(_damp_blocks(_gram(linear.by_point), points, damping, self.outside), linear.by_point)
        reduced = panel[:, points.shape[1] :]
        whitened = (reduced * error.flatten(1, 2)[:, :, None]).sum(1)
        rest = error - (reduced * whitened[:, None]).sum(2).view_as(error)
        gradient = pull(rest, images, slope, 2) @ linear.world.mT
        matrix = _schur(reduced.unflatten(1, error.shape[1:3]), images, slope, linear.world)
        if self.calibration is None:
            camera_step = damped_step(gradient.flatten(1), matrix, damping).view_as(cameras)
        else:
            camera_step = self.calibration.step(cameras, gradient, matrix, damping)

        moved = push(camera_step @ linear.world, images, slope)
        whitened = whitened - (reduced * moved.flatten(1, 2)[:, :, None]).sum(1)
        point_step = _back_substituted(panel, pivots, whitened)
        moved = moved + (linear.by_point * point_step[:, None]).sum(2).view_as(moved)
        return camera_step, point_step, (moved * (2 * error - moved)).sum((1, 2, 3))

    def advance(self, at: Iterate, step: Tensors) -> Iterate:
        """After a step of cameras and points, and one more of each point, where that lowers its cost."""
        cameras = self._cameras(at.theta[0] - step[0])
        points = normalize(at.theta[1] - step[1], dim=1)
        linear = self._linear(cameras, points)
        gradient = (linear.by_point * linear.error.flatten(1, 2)[:, :, None]).sum(1, keepdim=True)
        blocks = _damp_blocks(_gram(linear.by_point), points, torch.full_like(points[:, 0, 0], 1e-9), self.outside)
        panel, pivots = _eliminate_points(blocks, gradient)
        settled = normalize(points - _back_substituted(panel, pivots, panel[:, -1]), dim=1)
        costs = self.costs(cameras, settled)
        better = costs < linear.costs
        points, costs = torch.where(better[:, None], settled, points), torch.where(better, costs, linear.costs)
        return Iterate((cameras, points), costs.sum(-1), ())

    def has_converged(self, at: Iterate, fresh: Iterate, step: Tensors, tolerance: float) -> Tensor:
        """Where nothing is left but rounding, or no gain was to be expected of a step that brought none."""
        return torch.where(fresh.cost < at.cost, fresh.cost <= self.rounding, step[2] <= tolerance * at.cost)

    @cached_property
    def rounding(self) -> Tensor:
        """Cost ``(b,)`` of errors of the size of the rounding of the images, which are no errors."""
        return 1e-30 * (self.x.square().sum(2) * self.weights).sum((1, 2))

    def _linear(self, cameras: Tensor, points: Tensor) -> _Linear:
        world = self.world(points)
        images, depth = self.images(cameras, world)
        costs, weights = self.robust(images)
        root = weights.sqrt()[:, :, None]
        slope = root / depth[:, :, None]
        return _Linear(costs, world, images, slope, (images - self.x) * root, self._by_point(cameras, images, slope))

    def information(self, cameras: Tensor, points: Tensor) -> Tensor:
        r"""The information :math:`J_j^T J_j` of the images about each point, ``(b, k + 1, k + 1, n)``."""
        images, depth = self.images(cameras, self.world(points))
        return _gram(self._by_point(cameras, images, (self.robust(images)[1].sqrt() / depth)[:, :, None]))

    def _by_point(self, cameras: Tensor, images: Tensor, slope: Tensor) -> Tensor:
        """Derivative of the weighted images by the points, ``(b, v l, k + 1, n)``."""
        projections = cameras if self.lifts is None else cameras @ self.lifts
        rows = push(projections[..., None], images[:, :, :, None], slope[:, :, :, None]).flatten(1, 2)
        if self.outside is None:
            return rows
        inside = rows.clone()
        for k in range(rows.shape[2]):
            inside.addcmul_(rows[:, :, k, None], self.outside[:, None, k], value=-1)
        return inside


@dataclass(frozen=True)
class _Linear:
    """The problem about cameras and points."""

    costs: Tensor  # (b, n)
    world: Tensor  # (b, v, a + 1, n)
    images: Tensor  # (b, v, l, n)
    slope: Tensor  # (b, v, 1, n) root of the weight / depth
    error: Tensor  # (b, v, l, n) weighted
    by_point: Tensor  # (b, v l, k + 1, n) its derivative


def push(value: Tensor, images: Tensor, slope: Tensor) -> Tensor:
    r"""What a change ``(b, v, l + 1, ..., n)`` of homogeneous images does to weighted ones: :math:`s\, [I \mid -x]\, \delta`."""
    return (value[:, :, :-1] - images * value[:, :, -1:]) * slope


def pull(value: Tensor, images: Tensor, slope: Tensor, dim: int) -> Tensor:
    r"""The transpose of :func:`push`: :math:`s\, [I \mid -x]^T v`, along the dimension ``dim`` of length l."""
    head = value * slope
    return torch.cat([head, -(head * images).sum(dim, keepdim=True)], dim)


def _gram(rows: Tensor) -> Tensor:
    """``(b, K, K, n)`` of rows ``(b, r, K, n)``."""
    total = rows[:, 0, :, None] * rows[:, 0, None]
    for r in range(1, rows.shape[1]):
        total.addcmul_(rows[:, r, :, None], rows[:, r, None])
    return total


def _damp_blocks(gram: Tensor, points: Tensor, damping: Tensor, outside: Tensor | None) -> Tensor:
    """The point blocks with damping, the free scale and the forbidden directions of every point held, and regular where nothing is
    known."""
    diagonal = gram.diagonal(dim1=1, dim2=2)
    extra, trace = diagonal * damping[:, None, None], diagonal.sum(-1)
    gram.addcmul_((points * trace[:, None])[:, :, None], points[:, None])
    if outside is not None:
        gram.addcmul_(outside, trace[:, None, None])
    gram.diagonal(dim1=1, dim2=2).add_(extra + (trace == 0)[..., None])
    return gram


def _eliminate_points(gram: Tensor, rows: Tensor) -> tuple[Tensor, list[Tensor]]:
    r"""The panel :math:`(L; J L^{-T})` of :math:`V = L L^T`, ``(b, K + r, K, n)``, and the reciprocal diagonal of L."""
    panel, pivots = torch.cat([gram, rows], dim=1), []
    size = gram.shape[1]
    for k in range(size):
        pivots.append(panel[:, k, k].clamp(min=TINY).rsqrt())
        panel[:, k:, k].mul_(pivots[-1][:, None])
        if k + 1 < size:
            panel[:, k + 1 :, k + 1 :].addcmul_(panel[:, k + 1 :, k, None], panel[:, None, k + 1 : size, k], value=-1)
    return panel, pivots


def _back_substituted(panel: Tensor, pivots: list[Tensor], right: Tensor) -> Tensor:
    r"""The solution of :math:`L^T \delta = h`, ``(b, K, n)``, in place of h."""
    for k in reversed(range(len(pivots))):
        right[:, k].mul_(pivots[k])
        if k:
            right[:, :k].addcmul_(panel[:, k, :k], right[:, k : k + 1], value=-1)
    return right


def _schur(reduced: Tensor, images: Tensor, slope: Tensor, world: Tensor) -> Tensor:
    r"""The matrix :math:`\sum_j J_P^T (I - E_j E_j^T) J_P`, ``(b, p, p)``, of ``reduced`` E ``(b, v, l, k + 1, n)``."""
    batch, v, size, columns, n = reduced.shape
    inner = torch.eye(v * size, dtype=reduced.dtype, device=reduced.device).view(v, size, v, size).transpose(1, 2)[..., None]
    inner = inner.expand(batch, v, v, size, size, n).contiguous()
    for k in range(columns):
        column = reduced[:, :, :, k]
        inner.addcmul_(column[:, :, None, :, None], column[:, None, :, None], value=-1)
    inner = pull(inner, images[:, :, None, :, None], slope[:, :, None, :, None], 3)
    inner = pull(inner, images[:, None, :, None], slope[:, None, :, None], 4)
    pairs = world[:, :, None, :, None] * world[:, None, :, None]
    blocks = inner.flatten(3, 4) @ pairs.flatten(3, 4).mT
    blocks = blocks.unflatten(4, (world.shape[2], -1)).unflatten(3, (size + 1, -1)).permute(0, 1, 3, 5, 2, 4, 6)
    matrix: Tensor = blocks.flatten(4).flatten(1, 3)
    return matrix


BLOCK = 1 << 20
"""Entries of the largest arrays per block of the batch.  1000 problems of 3 views and 60 points take 0.15 ms per step each with
2^20, 0.21 ms with 2^18 (a few slow problems at the end of a block cost as many calls as all of them) and 0.19 ms with 2^21."""


@dataclass(frozen=True)
class Adjusted:
    """Cameras and points at a minimum of the reprojection error."""

    cameras: Tensor
    """``(*batch, views, l + 1, a + 1)`` of norm 1; as they were where a view has no image that counts."""
    structure: Tensor
    """``(*batch, n, k + 1)`` of norm 1; as it was where a point is seen in too few views."""
    cost: Tensor
    """``(*batch,)`` sum of the weighted squared (or robust) errors; infinite where the start was not finite."""
    iterations: Tensor
    """``(*batch,)`` steps tried."""


@one_thread
def bundle_adjust(
    x: Tensor,
    weights: Tensor | None,
    cameras: Tensor,
    structure: Tensor,
    lifts: Tensor | None = None,
    *,
    iterations: int = 50,
    scale: Tensor | float | None = None,
    tolerance: float = 1e-9,
    confined: Tensor | None = None,
    subspace: Tensor | None = None,
    calibration: Tensor | None = None,
    turned: int = 3,
) -> Adjusted:
    r"""Cameras and points that minimize the reprojection error :math:`\sum_{ij} w_{ij}\, \rho(|x_{ij} - \pi(P_i B_i Y_j)|^2)`.

    Batched Levenberg-Marquardt; the points are eliminated by the Schur complement.  Every camera and point is kept at norm 1;
    the gauge (collineations of P^k, or what the lifts leave of them) is free, and damping handles it.  The cost never rises.
    :math:`\rho(s) = s`, or with a scale c that of Geman and McClure, :math:`\rho(s) = c^2 s / (c^2 + s)`.

    Points seen in too few views (fewer than k equations), zero points and views without an image that counts stay as they are.

    Args:
        x: ``(*batch, views, n, l)`` images, best normalized; NaN = missing.
        weights: ``(*batch, views, n)``, 0 = missing, or None.
        cameras: ``(*batch, views, l + 1, a + 1)`` start :math:`P_i`, of any scale.
        structure: ``(*batch, n, k + 1)`` start :math:`Y_j`, of any scale; 0 where unknown.
        lifts: :math:`B_i`, ``(views, a + 1, k + 1)`` or ``(*batch, views, a + 1, k + 1)``; None: the identity (a = k).
        iterations: at most so many steps.
        scale: error beyond which an image counts as an outlier, in the unit of ``x``, one or ``(*batch,)``; None: none does.
        tolerance: done where a step lowers the cost by less than this fraction.
        confined: ``(*batch, n)`` bool: points kept within a subspace of the constants, such as those known to stand still.  With
            several subspaces the number of each point's, from 1; 0 leaves it free.
        subspace: ``(k + 1, r)`` orthonormal columns that span it, or ``(s, k + 1, r)``.
        calibration: K ``(*batch, views, l + 1, l + 1)``: cameras stay :math:`P_i \\sim K_i\\,[R_i \\mid t_i]` (a start that is
            none is replaced by the nearest that is), and the gauge is a similarity.
        turned: number d of the first columns of a camera that are those of :math:`R_i`: 3 of space, 2 of a plane; all others are
            free.  Only with a calibration.

    Returns:
        Adjusted, in the dtype of ``x``, without gradients.  A problem whose start is not finite is not adjusted and has cost
        infinity; what of it is not finite comes back as 0.

    Raises:
        ValueError: shapes that do not fit each other, or a scale that is not positive.

    Source: Triggs et al. 2000, Bundle adjustment, a modern synthesis; cameras P^k -> P^l of thesis chapter 3.

    Example:
        >>> import torch
        >>> from dyntorch.geometry.triangulation import reproject
        >>> g = torch.Generator().manual_seed(0)
        >>> P, Y = torch.eye(3, 4) + torch.rand(3, 3, 4, generator=g).double() / 4, torch.rand(12, 4, generator=g).double() + 1
        >>> x = reproject(P, Y)
        >>> start = P + 0.01 * torch.rand(P.shape, generator=g), Y + 0.01 * torch.rand(Y.shape, generator=g)
        >>> bool(bundle_adjust(x, None, *start).cost < 1e-20)
        True
    """
    batch = check(x, weights, cameras, structure, lifts)
    count, (views, n, size) = prod(batch), x.shape[-3:]
    if calibration is not None and (calibration.shape[-3:] != (views, size + 1, size + 1) or turned not in (2, 3) or size < 2):
        want = f"(*batch, {views}, {size + 1}, {size + 1}) of images or 3D sensors, and turned 2 or 3"
        raise ValueError(f"calibration must be {want}, got {tuple(calibration.shape)} and {turned}")

    def flat(tensor: Tensor, *shape: int) -> Tensor:
        return tensor.detach().double().expand(*batch, *shape).reshape(count, *shape)

    images, w = mask_missing(x, weights)
    cameras_, points = flat(cameras, *cameras.shape[-3:]), flat(structure, *structure.shape[-2:])
    w, moves, seen = _count_observations(flat(w, views, n), points, size)
    lift = None if lifts is None else flat(lifts, *lifts.shape[-3:])
    limit = None if scale is None else _scales(scale, batch, x.device)
    outside: Tensor | None = None
    if confined is not None:
        points, outside = _inside(points, confined.expand(*batch, n).reshape(count, n), subspace)

    options = LeastSquaresOptions(iterations=iterations, tolerance=tolerance)

    def run(given: BundleProblem, cameras: Tensor, points: Tensor) -> Adjusted:
        problem = replace(given, x=given.x.contiguous())
        least = minimize(problem, problem.evaluate((cameras, points.mT.contiguous())), options)
        return Adjusted(least.theta[0], least.theta[1].mT, least.cost, least.steps)

    a, k = cameras.shape[-1], structure.shape[-1]
    width = n * (views**2 * ((size + 1) ** 2 + a**2) + (k + views * size) * k)
    problems = max(1, min(BLOCK // max(1, width), -(-count // workers())))
    clean = each(lambda part: torch.where(part.isfinite(), part, 0.0), (cameras_, points))
    known = None if calibration is None else CalibratedCameras(flat(calibration, views, size + 1, size + 1), turned)
    given = BundleProblem(flat(images, views, n, size).mT, w, lift, limit, outside, known)
    with torch.no_grad():
        found = map_blocks(run, given, *clean, size=problems)
    # what counts has to be finite; the rest stays as it is
    sound = (cameras_.isfinite().flatten(2).all(-1) | ~seen).all(-1) & (points.isfinite().all(-1) | ~moves).all(-1)
    sound = (sound & found.cost.isfinite())[:, None]
    return Adjusted(
        select(sound & seen, found.cameras, clean[0]).reshape(*batch, *cameras.shape[-3:]).to(x.dtype),
        select(sound & moves, found.structure, clean[1]).reshape(*batch, *structure.shape[-2:]).to(x.dtype),
        torch.where(sound[:, 0], found.cost, torch.inf).reshape(batch).to(x.dtype),
        found.iterations.reshape(batch),
    )


def _count_observations(weights: Tensor, structure: Tensor, size: int) -> tuple[Tensor, Tensor, Tensor]:
    """Weights of what counts, the points ``(b, n)`` that are seen often enough, and the views ``(b, v)`` that see any of them."""
    moves = ((weights > 0).sum(1) * size >= structure.shape[-1] - 1) & (structure != 0).any(-1)
    weights = weights * moves[:, None]
    return weights, moves, (weights > 0).any(-1)


def _inside(structure: Tensor, confined: Tensor, subspace: Tensor | None) -> tuple[Tensor, Tensor]:
    """Points, the confined ones within the subspace, and the projectors ``(b, K, K, n)`` onto what is forbidden."""
    size = structure.shape[-1]
    if subspace is None or subspace.ndim not in (2, 3) or subspace.shape[-2] != size:
        got = None if subspace is None else tuple(subspace.shape)
        raise ValueError(f"confined points need a subspace ({size}, r) of orthonormal columns, or several, got {got}")
    basis = subspace.to(structure).reshape(-1, *subspace.shape[-2:])
    away = torch.eye(size, dtype=basis.dtype, device=basis.device) - basis @ basis.mT
    outside = torch.cat([torch.zeros_like(away[:1]), away])[confined.long()]
    return structure - (structure[..., None, :] @ outside)[..., 0, :], outside.permute(0, 2, 3, 1)


def _scales(scale: Tensor | float, batch: torch.Size, device: torch.device) -> Tensor:
    """``(b,)``."""
    given = torch.as_tensor(scale, dtype=torch.float64, device=device)
    if not bool((given > 0).all()):
        raise ValueError(f"scale must be positive, in the unit of x, got {given.min().item():g}; give None for least squares")
    return given.expand(batch).reshape(prod(batch))


def check(x: Tensor, weights: Tensor | None, cameras: Tensor, structure: Tensor, lifts: Tensor | None) -> torch.Size:
    """The batch."""
    check_tensor("x", x, "views", "n", "l")
    check_tensor("cameras", cameras, "views", "l + 1", "a + 1")
    check_tensor("structure", structure, "n", "k + 1")
    if lifts is not None:
        check_tensor("lifts", lifts, "views", "a + 1", "k + 1")
    *batch, views, n, size = x.shape
    if cameras.shape[-3:-1] != (views, size + 1):
        raise ValueError(f"cameras must be (*batch, {views}, {size + 1}, a + 1) for x {tuple(x.shape)}, got {tuple(cameras.shape)}")
    if structure.shape[-2] != n:
        raise ValueError(f"structure must be (*batch, {n}, k + 1) for x {tuple(x.shape)}, got {tuple(structure.shape)}")
    if weights is not None and weights.shape != x.shape[:-1]:
        raise ValueError(f"weights must be (*batch, views, n) = {tuple(x.shape[:-1])}, got {tuple(weights.shape)}")
    wide = (views, cameras.shape[-1], structure.shape[-1])
    if lifts is None and wide[1] != wide[2]:
        raise ValueError(f"cameras have {wide[1]} columns for points of {wide[2]} coordinates; give lifts {wide}")
    if lifts is not None and lifts.shape[-3:] != wide:
        raise ValueError(f"lifts must be {wide} or (*batch, {wide[0]}, {wide[1]}, {wide[2]}), got {tuple(lifts.shape)}")
    for name, part, last in (("cameras", cameras, 3), ("structure", structure, 2)):
        if check_together(x=(x.double(), 3), **{name: (part.double(), last)}) != x.shape[:-3]:
            raise ValueError(f"{name} have batch {tuple(part.shape[:-last])}, x has {tuple(batch)}; expand x")
    return torch.Size(batch)


# ----------------------------------------------------------------------------------------------------------------------
# What images tell about each point of a bundle adjustment, and its covariance.


def point_information(cameras: Tensor, structure: Tensor, weights: Tensor | None = None) -> Tensor:
    r"""What the images tell about each point, given the cameras. cameras ``(*batch, views, l + 1, a + 1)``, structure
    ``(*batch, n, k + 1)``, weights ``(*batch, views, n)`` -> ``(*batch, n, k + 1, k + 1)``."""
    check_tensor("cameras", cameras, "views", "l + 1", "a + 1")
    check_tensor("structure", structure, "n", "k + 1")
    if not cameras.shape[-3] or cameras.shape[-2] < 2:
        raise ValueError(f"cameras must be (*batch, views >= 1, l + 1 >= 2, a + 1), got {tuple(cameras.shape)}")
    batch, views, n = cameras.shape[:-3], cameras.shape[-3], structure.shape[-2]
    x = cameras.new_zeros(*batch, views, n, cameras.shape[-2] - 1)
    check(x, weights, cameras, structure, None)
    count = prod(batch)

    def flat(tensor: Tensor, *shape: int) -> Tensor:
        return tensor.double().expand(*batch, *shape).reshape(count, *shape)

    w = flat(mask_missing(x, weights)[1], views, n)
    points = normalize(flat(structure, *structure.shape[-2:]), dim=-1).mT
    w = w * (points != 0).any(1)[:, None]
    problem = BundleProblem(flat(x, views, n, x.shape[-1]).mT, w, None, None)
    found = problem.information(flat(cameras, *cameras.shape[-3:]), points)
    return found.permute(0, 3, 1, 2).reshape(*batch, n, *found.shape[1:3]).to(cameras.dtype)
