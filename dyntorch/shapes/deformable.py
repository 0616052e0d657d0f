r"""Shapes that deform in ways nobody knows, before two cameras: basis shapes, their share in every frame, and the cameras."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import prod
from typing import NamedTuple

import torch
from torch import Tensor

from dyntorch.core.limits import MAX_SQUARED_DISTANCE, Stop
from dyntorch.core.outcome import Outcome, Status, is_failure
from dyntorch.geometry.rigid import nearest_rotation
from dyntorch.numerics.arguments import check_tensor, check_together
from dyntorch.numerics.blocks import one_thread
from dyntorch.numerics.nullspace import eigh, spectrum

TINY = 1e-300
MAX_ITERATIONS = 150
"""Of alternating least squares; exact data with 20 % of the images missing need 20 to 100."""
STOP = Stop(MAX_ITERATIONS, tolerance=1e-7)
EXACT = 1e-26
"""Mean squared error, of images of rms 1, that is rounding."""
FILL_ITERATIONS = 30
"""Iterations in which coordinates that only one camera saw, or none, are filled in from the shapes, before the first descent."""
RIDGE = 1e-13
"""Ridge of the normal equations, of their mean diagonal entry: what no image shows stays finite."""
MIN_THIRD_VALUE = 1e-4
"""Third singular value of the joint images of both cameras, over the first, below which both see one projection only: cameras that
look the same way, or a flat scene."""
MIN_OVER_NOISE = 3.0
"""The same over the fourth, which is noise, below which the third may be noise as well."""
MIN_METRIC = 1e-3
"""Least eigenvalue of the metric that constant lengths give, over the largest, below which they decide none."""
METRIC_ITERATIONS = 8
"""Reweightings of the metric that constant lengths give; 4 leave up to 1 % of its entries."""
MAX_METRIC_ERROR = 0.3
"""Relative error of the metric within three standard deviations above which lengths decide none."""
MIN_COST_RISE = 0.2
"""Share of the cost by which a metric that is so far off has to cost more, too: the noise in the weights themselves makes some
per cent where bones are a few times as long as the noise and nothing moves."""
GRID = 120
"""Members of the family of metrics of two scaled orthographic cameras that are tried at once."""
NUM_ZOOMS = 5
"""Times that the grid is laid closer about the best one: the last one is 1e-7 wide."""
ROTATION_ITERATIONS = 5
"""Rotations of all frames to the mean shape before the shapes are estimated."""


@dataclass(frozen=True, eq=False, repr=False)
class DeformableShapes(Outcome):
    r"""Result of :func:`dyntorch.shapes.deformable_shapes`.

    .. math:: x_{vti} = M_v\, R_t \sum_b c_{tb}\, B_{bi} + o_{vt}

    Everything is zero where the status says that there is nothing.

    Attributes:
        shapes: basis shapes B, ``(*batch, basis, n, 3)``, centroids 0, the most important first.
        coefficients: c, ``(*batch, frames, basis)``, columns orthogonal, of mean square 1.
        cameras: M of both cameras, ``(*batch, 2, 2, 3)``.
        rotations: :math:`R_t`, ``(*batch, frames, 3, 3)``: of the metric result, from the frame of the basis to that of the
            cameras; the identity otherwise.
        offsets: o, ``(*batch, 2, frames, 2)`` in the unit of the images.
        points: :math:`R_t \sum_b c_{tb} B_{bi}`, ``(*batch, frames, n, 3)``, in the frame of the cameras.
        metric: ``(*batch,)`` bool: known up to a similarity (and the mirror image), by the constant lengths; else up to an
            affinity, the same for all frames.
        residual: ``(*batch,)`` rms of the residuals of one coordinate, in the unit of the images.
        sigma: ``(*batch,)`` noise that they show.
    """

    shapes: Tensor
    coefficients: Tensor
    cameras: Tensor
    rotations: Tensor
    offsets: Tensor
    points: Tensor
    metric: Tensor
    residual: Tensor
    sigma: Tensor

    TASK = "deformable_shapes"
    REMEDIES = {
        Status.TOO_FEW: "fewer images than unknowns: give more points or frames seen by both cameras, or fewer basis shapes",
        Status.DEGENERATE: "both cameras see one projection, or the scene is flat: let them look from different sides",
        Status.AMBIGUOUS: "the second direction of view is lost in the noise: let the cameras look from more different sides",
        Status.NO_CONSENSUS: "the images are no projections of few shapes",
    }

    def __repr__(self) -> str:
        basis, n = self.shapes.shape[-3:-1]
        first = self.head(frames=self.points.shape[-3], points=n, basis=basis)
        if bool(is_failure(self.status).all()):
            return first
        known = self.residual[~is_failure(self.status)]
        kind = "metric" if bool(self.metric.all()) else "affine" if not bool(self.metric.any()) else "metric or affine"
        return f"{first}\n  {kind}; residual {float(known.median()):.3g} rms"


class _Model(NamedTuple):
    """A flat batch of shapes in normalized images."""

    cameras: Tensor  # (b, 2, 2, 3)
    turns: Tensor  # (b, T, 3, 3)
    coefficients: Tensor  # (b, T, B)
    shapes: Tensor  # (b, B, n, 3)
    offsets: Tensor  # (b, 2, T, 2)

    @property
    def points(self) -> Tensor:
        """``(b, T, n, 3)`` in the frame of the cameras."""
        inside = torch.einsum("btk,bknj->btnj", self.coefficients, self.shapes)
        return inside @ self.turns.mT

    def images(self) -> Tensor:
        """``(b, 2, T, n, 2)``."""
        return self.points[:, None] @ self.cameras[:, :, None].mT + self.offsets[..., None, :]


@one_thread
def deformable_shapes(
    x1: Tensor,
    x2: Tensor,
    basis: int,
    *,
    lengths: Tensor | None = None,
    orthographic: bool = False,
    weights: Tensor | None = None,
    iterations: int = MAX_ITERATIONS,
) -> DeformableShapes:
    r"""Basis shapes of a deforming thing, their share in every frame, and both cameras, from the images of its points in two
    synchronized affine cameras that are fixed to each other.

    .. math:: x_{vti} = M_v\, S_{ti} + o_{vt}, \qquad S_t = R_t \sum_{b} c_{tb}\, B_b

    The joint images of both cameras, :math:`(x_{1ti}, x_{2ti})` about their mean in each frame, have rank 3 over all frames at
    once: one factorization gives the cameras and every point at every time up to one affinity.  All its shapes have rank
    ``basis``, which fills in what only one camera saw, and averages over the noise.  Least squares in turn over coefficients,
    shapes and cameras then count every image.

    Where ``lengths`` names pairs of points at constant distance (bones), these decide the metric, linear in
    :math:`Q = A^T A`: :math:`d_t^T Q\, d_t` is the same for all t; (with scaled orthographic cameras all but one
    parameter of it is known); the frames are then turned onto each other, so that the basis has
    to explain deformations alone, and a rig that moves around does not matter.

    A single camera that moves determines a shape basis too, by the counts, and so does the symmetry of the shapes even before a
    fixed camera; a fixed camera alone leaves every depth open (``python -m experiments.reconstruction.deformable_counts``).  Two
    cameras are the case that is linear and well conditioned.

    Args:
        x1: ``(*batch, frames, n, 2)`` images in the first camera, any unit; NaN = missing.
        x2: the same in the second.
        basis: number of basis shapes, 1 for a rigid thing (without lengths: one that only translates).
        lengths: ``(pairs, 2)`` integers, points whose distance does not change; at least 2 pairs that turn in space.
        orthographic: whether the cameras are scaled orthographic (square pixels, far away), rather than any affine ones: their rows
            are orthogonal and of one length, which leaves the metric one parameter for the lengths to decide.  Of walking people
            before noise of 2 px lengths alone leave errors of 2 to 30 %.
        weights: ``(*batch, 2, frames, n)`` not negative; 0 leaves an image out.
        iterations: of alternating least squares at most; 0 leaves the factorization as it is.

    Returns:
        A :class:`DeformableShapes`.

    Raises:
        ValueError: shapes that do not fit, basis below 1, or pairs that are none.

    Source: thesis 10.1 (open there: "a more tractable solution would be to add information such as a second camera"); Bregler,
    Hertzmann and Biermann 2000 (shape bases); Tomasi and Kanade 1992 (the factorization).

    Example:
        >>> import torch
        >>> g = torch.Generator().manual_seed(0)
        >>> shapes, share, rig = (torch.randn(*s, generator=g, dtype=torch.float64) for s in ((2, 12, 3), (15, 2), (2, 2, 3)))
        >>> points = torch.einsum("tb,bnj->tnj", share, shapes)
        >>> found = deformable_shapes(points @ rig[0].mT, points @ rig[1].mT, 2)
        >>> bool(found.residual < 1e-9)
        True
        >>> print(found.head(frames=15))
        DeformableShapes(frames=15, batch=(): 1 OK)
    """
    batch, pairs = _check(x1, x2, basis, lengths, weights)
    T, n = x1.shape[-3:-1]
    x = torch.stack([x1.detach().expand(*batch, T, n, 2), x2.detach().expand(*batch, T, n, 2)], dim=-4).double()
    seen = x.isfinite().all(-1)
    w = seen.double() if weights is None else weights.detach().double().expand(*batch, 2, T, n) * seen
    count = prod(batch)
    x, w = torch.where(w[..., None] > 0, x, 0.0).reshape(count, 2, T, n, 2), w.reshape(count, 2, T, n)
    with torch.no_grad():
        found = _fit_stages(x, w, basis, pairs, orthographic, replace(STOP, max_iterations=iterations))
    return _result(found, batch, x1)


def _check(x1: Tensor, x2: Tensor, basis: int, lengths: Tensor | None, weights: Tensor | None) -> tuple[torch.Size, Tensor | None]:
    """The batch, and the pairs."""
    check_tensor("x1", x1, "frames", "n", 2)
    check_tensor("x2", x2, "frames", "n", 2)
    batch = check_together(x1=(x1, 3), x2=(x2, 3))
    if x1.shape[-3:] != x2.shape[-3:]:
        raise ValueError(f"x1 and x2 must show the same frames and points, got {tuple(x1.shape)} and {tuple(x2.shape)}")
    if isinstance(basis, bool) or not isinstance(basis, int) or basis < 1:
        raise ValueError(f"basis must be a whole number of shapes, 1 or more, got {basis!r}")
    n = x1.shape[-2]
    if weights is not None and (weights.shape[-3:] != (2, *x1.shape[-3:-1]) or not bool((weights >= 0).all())):
        raise ValueError(f"weights must be (*batch, 2, frames, n) and not negative, got {tuple(weights.shape)}")
    if lengths is None:
        return batch, None
    pairs = torch.as_tensor(lengths)
    sound = pairs.ndim == 2 and pairs.shape[-1] == 2 and not pairs.is_floating_point() and len(pairs) > 1
    if not sound or bool((pairs < 0).any()) or bool((pairs >= n).any()) or bool((pairs[:, 0] == pairs[:, 1]).any()):
        raise ValueError(f"lengths must be (pairs >= 2, 2) different points from 0 to {n - 1}, got {pairs.tolist()}")
    return batch, pairs.long()


class _DeformableFit(NamedTuple):
    """What a flat batch ends as."""

    model: _Model
    metric: Tensor
    residual: Tensor
    sigma: Tensor
    status: Tensor
    scale: Tensor


def _fit_stages(x: Tensor, w: Tensor, basis: int, pairs: Tensor | None, orthographic: bool, stop: Stop) -> _DeformableFit:
    """The stages in their order: size, cameras and points, metric, shapes, least squares, frame."""
    scale = _size(x, w)
    x = x / scale[:, None, None, None, None]
    b, _, T, n, _ = x.shape
    cameras, points, both, values = _stereo(x, w)
    metric = torch.zeros(b, dtype=torch.bool, device=x.device)
    turns = torch.eye(3, dtype=x.dtype, device=x.device).expand(b, T, 3, 3).clone()
    if pairs is not None:
        noise = values[:, 0].clamp(min=0) / (both.sum((1, 2)) - both.any(-1).sum(-1)).clamp(min=1)
        change, metric = _metric_by_lengths(points, both, cameras, noise, pairs.to(x.device), orthographic)
        cameras, points = cameras @ torch.linalg.inv(change)[:, None], points @ change.mT
        turned = _rotate_to_mean_shape(points, both)
        turns = torch.where(metric[:, None, None, None], turned, turns)
    coefficients, shapes = _low_rank(points @ turns, both, basis)
    model = _Model(cameras, turns, coefficients, shapes, torch.zeros_like(x[:, :, :, 0]))
    model, cost = _alternate(x, w, model, metric, stop)
    images = (w > 0).sum((1, 2, 3))
    turning = 3 * T * metric
    free = 12 + basis * (T + 3 * n) + 4 * T + turning - basis * (basis + 3) - torch.where(metric, 7, 9)
    spare = 2 * images - free
    rms = (cost / (2 * images).clamp(min=1)).sqrt()
    sigma = (cost / spare.clamp(min=1)).sqrt()
    third = (values[:, 1].clamp(min=0) / values[:, 3].clamp(min=TINY)).sqrt()
    fourth = (values[:, 1] / values[:, 0].clamp(min=TINY)).sqrt()
    status = torch.full_like(images, int(Status.OK))
    status = torch.where(fourth < MIN_OVER_NOISE, int(Status.AMBIGUOUS), status)
    status = torch.where(third < MIN_THIRD_VALUE, int(Status.DEGENERATE), status)
    status = torch.where((spare < 0) | ((both.sum(-1) > 3).sum(-1) < 1) | (both.sum((1, 2)) < 4), int(Status.TOO_FEW), status)
    finite = torch.stack([part.isfinite().flatten(1).all(-1) for part in model]).all(0)
    status = torch.where(~finite & ~is_failure(status), int(Status.DEGENERATE), status)
    return _DeformableFit(_canonical_model(model), metric, rms * scale, sigma * scale, status, scale)


def _size(x: Tensor, w: Tensor) -> Tensor:
    """Rms distance of the images from their centre, ``(b,)``, 1 where there are none."""
    total = w.sum((1, 2, 3)).clamp(min=TINY)
    mean = (x * w[..., None]).sum((2, 3)) / w.sum((2, 3)).clamp(min=TINY)[..., None]
    square = ((x - mean[:, :, None, None]).square().sum(-1) * w).sum((1, 2, 3)) / total
    return torch.where(square > 0, square, 1.0).sqrt()


def _stereo(x: Tensor, w: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Cameras ``(b, 2, 2, 3)``, points ``(b, T, n, 3)``, where both see them ``(b, T, n)``, four squared singular values."""
    both = (w > 0).all(1)
    weight = both.to(x.dtype)
    joint = torch.cat([x[:, 0], x[:, 1]], dim=-1)
    mean = (joint * weight[..., None]).sum(2, keepdim=True) / weight.sum(2, keepdim=True).clamp(min=1)[..., None]
    joint = torch.where(both[..., None], joint - mean, 0.0)
    flat = joint.flatten(1, 2)
    values, vectors = spectrum(flat.mT @ flat)
    frame = vectors[..., -3:].flip(-1)
    return frame.unflatten(1, (2, 2)), joint @ frame[:, None], both, values


class _Differences(NamedTuple):
    """Differences of the pairs of constant length."""

    way: Tensor  # (b, T, k, 3)
    seen: Tensor  # (b, T, k)
    noise: Tensor  # (b,) variance of each coordinate of a difference

    def lengths(self, metric: Tensor) -> tuple[Tensor, Tensor]:
        """Squared lengths ``(b, s, T, k)`` in metrics ``(b, s, 3, 3)``, and one over their variances, second order too."""
        ahead = torch.einsum("btki,bsij->bstkj", self.way, metric)
        square = (ahead * self.way[:, None]).sum(-1)
        own = self.noise[:, None, None, None]
        variance = 4 * own * ahead.square().sum(-1) + 2 * own.square() * metric.square().sum((-2, -1))[..., None, None]
        return square, self.seen[:, None] / variance.clamp(min=TINY)

    def spread(self, metric: Tensor) -> Tensor:
        """How far the lengths are from constant ``(b, s)``, in variances."""
        square, weight = self.lengths(metric)
        mean = (square * weight).sum(2, keepdim=True) / weight.sum(2, keepdim=True).clamp(min=TINY)
        return ((square - mean).square() * weight).sum((2, 3))


def _metric_by_lengths(
    points: Tensor, both: Tensor, cameras: Tensor, noise: Tensor, pairs: Tensor, orthographic: bool
) -> tuple[Tensor, Tensor]:
    """The change of the world ``(b, 3, 3)`` that makes lengths constant, and whether they decide one ``(b,)``."""
    way = points[:, :, pairs[:, 0]] - points[:, :, pairs[:, 1]]
    seen = (both[:, :, pairs[:, 0]] & both[:, :, pairs[:, 1]]).to(points.dtype)
    size = way.square().sum(-1, keepdim=True).mean((1, 2))
    ways = _Differences(way, seen, 2 * noise + EXACT * size[:, 0])
    matrix, decided = _metric_of_orthographic_cameras(ways, cameras) if orthographic else _metric_of_any_cameras(ways)
    inner, axes = eigh(matrix)
    sound = decided & (inner[:, 0] > MIN_METRIC * inner[:, 2])
    root = (inner.clamp(min=0).sqrt()[:, None] * axes) @ axes.mT
    root = root / torch.linalg.det(root).abs().clamp(min=TINY).pow(1 / 3)[:, None, None]
    eye = torch.eye(3, dtype=points.dtype, device=points.device)
    return torch.where(sound[:, None, None], root, eye.expand_as(root)), sound


def _metric_of_any_cameras(ways: _Differences) -> tuple[Tensor, Tensor]:
    r"""The metric Q ``(b, 3, 3)`` by lengths alone: with the monomials :math:`m(d)`, :math:`d^T Q\, d = q \cdot m(d)`,"""
    way, seen = ways.way, ways.seen
    i, j = torch.triu_indices(3, 3, device=way.device)
    twice = torch.where(i == j, 1.0, 2.0).to(way)
    monomials = way[..., i] * way[..., j] * twice
    eye = torch.eye(3, dtype=way.dtype, device=way.device)
    slope = (way[..., i, None] * eye[j] + way[..., j, None] * eye[i]) * twice[:, None]  # (b, T, k, 6, 3)
    weight = seen / way.square().sum(-1).clamp(min=TINY) * (way.square().sum(-1) > TINY)
    best, least = eye.expand(len(way), 3, 3), torch.full_like(ways.noise, torch.inf)
    decided = torch.zeros_like(least, dtype=torch.bool)
    for _ in range(METRIC_ITERATIONS):
        share = weight / weight.sum(1, keepdim=True).clamp(min=TINY)
        off = (monomials - (monomials * share[..., None]).sum(1, keepdim=True)) * weight.sqrt()[..., None]
        flat, noise = off.flatten(1, 2), (slope * weight.sqrt()[..., None, None]).transpose(-2, -1).flatten(1, 3)
        spread = noise.mT @ noise
        size = spread.diagonal(dim1=-2, dim2=-1).mean(-1).clamp(min=TINY)[:, None, None]
        factor = torch.linalg.cholesky_ex(spread / size + RIDGE * torch.eye(6, dtype=flat.dtype, device=flat.device))[0]
        white = torch.linalg.solve_triangular(factor, flat.mT, upper=False)
        values, vectors = spectrum(white @ white.mT / size)
        q = torch.linalg.solve_triangular(factor.mT, vectors[..., :1], upper=True)[..., 0]
        matrix = torch.zeros_like(best).clone()
        matrix[:, i, j] = q
        matrix[:, j, i] = q
        matrix = matrix * matrix.diagonal(dim1=-2, dim2=-1).sum(-1).sign()[:, None, None]
        cost = ways.spread(matrix[:, None])[:, 0]
        better = (cost < least) & (eigh(matrix)[0][:, 0] > 0)
        best, least = torch.where(better[:, None, None], matrix, best), torch.where(better, cost, least)
        # another metric that far off has to cost more than the noise does
        clear = (values[:, 1] - values[:, 0]) * seen.sum((1, 2)) > MAX_SQUARED_DISTANCE / MAX_METRIC_ERROR**2 * values[:, 0]
        clear = clear & (values[:, 1] > (1 + MIN_COST_RISE) * values[:, 0])
        decided = torch.where(better, clear & (values[:, 1] > MIN_METRIC**2 * values[:, 5]), decided)
        weight = ways.lengths(matrix[:, None])[1][:, 0] * (weight > 0)
    return best, decided


def _metric_of_orthographic_cameras(ways: _Differences, cameras: Tensor) -> tuple[Tensor, Tensor]:
    r"""The metric Q ``(b, 3, 3)`` of scaled orthographic cameras: :math:`M_v Q^{-1} M_v^T \sim I` leaves a family of one parameter
    (Koenderink and van Doorn), of which the lengths choose one; and whether there is any, ``(b,)``."""
    i, j = torch.triu_indices(3, 3, device=cameras.device)
    first, second = cameras[:, :, 0], cameras[:, :, 1]
    twice = torch.where(i == j, 1.0, 2.0).to(cameras)

    def quadratic(a: Tensor, b: Tensor) -> Tensor:
        return (a[..., i] * b[..., j] + a[..., j] * b[..., i]) / 2 * twice

    rows = torch.cat([quadratic(first, second), (quadratic(first, first) - quadratic(second, second)) / 2], dim=1)
    _, _, vh = torch.linalg.svd(rows, full_matrices=True)
    pair = torch.zeros(len(cameras), 2, 3, 3, dtype=cameras.dtype, device=cameras.device)
    pair[:, :, i, j] = vh[:, 4:]
    pair[:, :, j, i] = vh[:, 4:]
    middle = torch.zeros_like(ways.noise)
    width = torch.pi
    steps = torch.linspace(-1, 1, GRID, dtype=cameras.dtype, device=cameras.device)
    decided = torch.zeros_like(ways.noise, dtype=torch.bool)
    for zoom in range(NUM_ZOOMS):
        angle = middle[:, None] + width * steps
        trial = angle.cos()[..., None, None] * pair[:, None, 0] + angle.sin()[..., None, None] * pair[:, None, 1]
        values, axes = eigh(trial)
        fine = values[..., 0] > MIN_METRIC * values[..., 2]
        inverse = (axes / values.clamp(min=TINY)[..., None, :]) @ axes.mT
        inverse = inverse / torch.linalg.matrix_norm(inverse, keepdim=True).clamp(min=TINY)
        cost = torch.where(fine, ways.spread(inverse), torch.inf)
        at = cost.argmin(-1, keepdim=True)
        middle, width = angle.gather(1, at)[:, 0], 2 * width / GRID
        best = inverse.gather(1, at[..., None, None].expand(-1, 1, 3, 3))[:, 0]
        if not zoom:  # how far off the metrics are that cost hardly more
            far = torch.linalg.matrix_norm(inverse - best[:, None])
            decided = fine.any(-1) & (
                torch.where(cost <= cost.amin(-1, keepdim=True) * (1 + MIN_COST_RISE) + MAX_SQUARED_DISTANCE, far, 0.0).amax(-1)
                <= MAX_METRIC_ERROR
            )
    return best, decided


def _rotate_to_mean_shape(points: Tensor, both: Tensor) -> Tensor:
    """Rotations ``(b, T, 3, 3)`` from a common frame to the frames, by turns with the mean shape."""
    weight = both.to(points.dtype)[..., None]
    shape = points.gather(1, both.sum(-1).argmax(-1)[:, None, None, None].expand(-1, 1, *points.shape[2:]))
    turn = nearest_rotation((points * weight).mT @ shape)
    for _ in range(ROTATION_ITERATIONS):
        shape = (points @ turn * weight).sum(1, keepdim=True) / weight.sum(1, keepdim=True).clamp(min=1)
        turn = nearest_rotation((points * weight).mT @ shape)
    return turn


def _low_rank(points: Tensor, both: Tensor, basis: int) -> tuple[Tensor, Tensor]:
    """Coefficients ``(b, T, B)`` and shapes ``(b, B, n, 3)`` nearest to points ``(b, T, n, 3)``, gaps filled from them in turns."""
    known = both[..., None].expand_as(points).flatten(2)
    rows = points.flatten(2)
    mean = (rows * known).sum(1, keepdim=True) / known.sum(1, keepdim=True).clamp(min=1)
    filled = torch.where(known, rows, mean)
    rank = min(basis, *filled.shape[1:])
    for _ in range(1 if bool(known.all()) else FILL_ITERATIONS):
        u, s, vh = torch.linalg.svd(filled, full_matrices=False)
        left, right = u[..., :rank] * s[:, None, :rank], vh[:, :rank]
        filled = torch.where(known, rows, left @ right)
    grown = basis - rank  # more shapes than frames or coordinates: empty ones
    left = torch.nn.functional.pad(left, (0, grown))
    right = torch.nn.functional.pad(right, (0, 0, 0, grown))
    return left, right.unflatten(-1, points.shape[2:])


# ----------------------------------------------------------------------------------------------------------------------
# Least squares in turn: every one of coefficients with offsets, rotations, shapes and cameras is linear given the others.


def _alternate(x: Tensor, w: Tensor, model: _Model, metric: Tensor, stop: Stop) -> tuple[_Model, Tensor]:
    """The model after least squares in turn, and its cost ``(b,)``, which never rises."""
    model = _update_coefficients(x, w, model)
    cost = _cost(x, w, model)
    left = torch.arange(len(x), device=x.device)
    floor = EXACT * w.sum((1, 2, 3))
    for _ in range(stop.max_iterations):
        some, images, weight, turning = _Model(*(part[left] for part in model)), x[left], w[left], metric[left]
        fresh = _update_shapes(images, weight, some)
        fresh = _update_cameras(images, weight, fresh, turning)
        fresh = _update_coefficients(images, weight, fresh)
        now = _cost(images, weight, fresh)
        better = now < cost[left]
        at = left[better]
        model = _Model(*(old.index_copy(0, at, new[better]) for old, new in zip(model, fresh, strict=True)))
        done = stop.has_converged(cost[left], now)
        cost = cost.index_copy(0, at, now[better])
        left = left[better & ~done & (now > floor[left])]
        if not len(left):
            break
    return model, cost


def _cost(x: Tensor, w: Tensor, model: _Model) -> Tensor:
    return ((x - model.images()).square().sum(-1) * w).sum((1, 2, 3))


def _solve(matrix: Tensor, right: Tensor) -> Tensor:
    size = matrix.diagonal(dim1=-2, dim2=-1).mean(-1).clamp(min=TINY)[..., None, None]
    eye = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
    return torch.linalg.solve_ex(matrix + RIDGE * size * eye, right[..., None])[0][..., 0]


def _update_coefficients(x: Tensor, w: Tensor, model: _Model) -> _Model:
    """The best coefficients and offsets of every frame."""
    b, _, T, n, _ = x.shape
    basis = model.coefficients.shape[-1]
    views = model.cameras[:, :, None] @ model.turns[:, None]  # (b, 2, T, 2, 3)
    design = torch.einsum("bvtij,bknj->btvnik", views, model.shapes)
    place = torch.eye(4, dtype=x.dtype, device=x.device).reshape(2, 1, 2, 4).expand(b, T, 2, n, 2, 4)
    weight = w.permute(0, 2, 1, 3)[..., None, None]
    rows = torch.cat([design, place], dim=-1)
    flat, scaled = rows.flatten(2, 4), (rows * weight).flatten(2, 4)
    target = x.permute(0, 2, 1, 3, 4).flatten(2)
    found = _solve(scaled.mT @ flat, (scaled.mT @ target[..., None])[..., 0])
    offsets = found[..., basis:].unflatten(-1, (2, 2)).transpose(1, 2)
    return model._replace(coefficients=found[..., :basis], offsets=offsets)


def _update_shapes(x: Tensor, w: Tensor, model: _Model) -> _Model:
    """The best place of every point in every basis shape."""
    basis = model.shapes.shape[1]
    views = model.cameras[:, :, None] @ model.turns[:, None]
    rows = (model.coefficients[:, None, :, None, :, None] * views[..., None, :]).flatten(-2)  # (b, 2, T, 2, 3 B)
    outer = (rows.mT @ rows).flatten(1, 2).flatten(2)  # (b, 2 T, (3 B)^2)
    weight = w.flatten(1, 2)  # (b, 2 T, n)
    size = rows.shape[-1]
    matrix = (weight.mT @ outer).unflatten(-1, (size, size))
    away = ((x - model.offsets[..., None, :]) * w[..., None]).permute(0, 3, 1, 2, 4).flatten(2)  # (b, n, 2 T 2)
    right = away @ rows.flatten(1, 3)
    found = _solve(matrix, right)
    return model._replace(shapes=found.unflatten(-1, (basis, 3)).transpose(1, 2))


def _update_cameras(x: Tensor, w: Tensor, model: _Model, turning: Tensor) -> _Model:
    """The best cameras; before a metric thing the best small turns of every frame, within cameras as they are."""
    points = model.points
    away = x - model.offsets[..., None, :]
    matrix = torch.einsum("bvtn,btni,btnj->bvij", w, points, points)
    right = torch.einsum("bvtn,btni,bvtnk->bvki", w, points, away)
    cameras = _solve(matrix[:, :, None], right)
    model = model._replace(cameras=torch.where(turning[:, None, None, None], model.cameras, cameras))
    if not bool(turning.any()):
        return model
    rest = away - points[:, None] @ model.cameras[:, :, None].mT
    eye = torch.eye(3, dtype=x.dtype, device=x.device)
    turned = torch.linalg.cross(eye[:, None, None, None], points[None], dim=-1)  # (3, b, T, n, 3)
    slope = torch.einsum("rbtnj,bvij->btvnir", turned, model.cameras)
    scaled = (slope * w.permute(0, 2, 1, 3)[..., None, None]).flatten(2, 4)
    step = _solve(scaled.mT @ slope.flatten(2, 4), (scaled.mT @ rest.permute(0, 2, 1, 3, 4).flatten(2)[..., None])[..., 0])
    skewed = torch.linalg.cross(step[..., None, :].expand(*step.shape[:-1], 3, 3), eye.expand(*step.shape[:-1], 3, 3), dim=-1).mT
    turns = nearest_rotation((eye + skewed) @ model.turns)
    return model._replace(turns=torch.where(turning[:, None, None, None], turns, model.turns))


def _canonical_model(model: _Model) -> _Model:
    """Shapes about their centroids, orthogonal coefficients of mean square 1, the most important shape first."""
    cameras, turns, coefficients, shapes, offsets = model
    middle = shapes.mean(2)
    inside = (torch.einsum("btk,bkj->btj", coefficients, middle)[..., None, :] @ turns.mT)[..., 0, :]
    offsets = offsets + inside[:, None] @ cameras.mT
    shapes = shapes - middle[:, :, None]
    T, basis = coefficients.shape[1:]
    finite = torch.where(coefficients.isfinite(), coefficients, 0.0)
    q, r = torch.linalg.qr(finite)
    flat = r @ torch.where(shapes.isfinite(), shapes, 0.0).flatten(2)
    u, s, vh = torch.linalg.svd(flat, full_matrices=False)
    size = min(T, basis)
    left = (q @ u)[..., :size] * T**0.5
    right = (s[..., None] * vh)[:, :size] / T**0.5
    # the sign: every shape is on the whole in what the frames are made of
    sign = torch.where(left.sum(1) < 0, -1.0, 1.0)
    left, right = left * sign[:, None], right * sign[..., None]
    left = torch.nn.functional.pad(left, (0, basis - left.shape[-1]))
    right = torch.nn.functional.pad(right, (0, 0, 0, basis - right.shape[1]))
    return _Model(cameras, turns, left, right.unflatten(-1, shapes.shape[2:]), offsets)


def _result(found: _DeformableFit, batch: torch.Size, like: Tensor) -> DeformableShapes:
    """In the caller's batch, unit and dtype; zero where nothing was found."""
    model, bad = found.model, is_failure(found.status)

    def to_caller(value: Tensor) -> Tensor:
        wide = bad[(..., *[None] * (value.ndim - 1))]
        return torch.where(wide, 0.0, value).reshape((*batch, *value.shape[1:])).to(like)

    size = found.scale[:, None, None, None]
    return DeformableShapes(
        shapes=to_caller(model.shapes * size),
        coefficients=to_caller(model.coefficients),
        cameras=to_caller(model.cameras),
        rotations=to_caller(model.turns),
        offsets=to_caller(model.offsets * size),
        points=to_caller(model.points * size),
        metric=(found.metric & ~bad).reshape(batch),
        residual=to_caller(found.residual),
        sigma=to_caller(found.sigma),
        status=found.status.reshape(batch),
    )
