"""Projections and structure from many views at once: the factorization of scaled measurements, P^k -> P^l."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, prod

import torch
from torch import Tensor

from dyntorch.core.outcome import Outcome, Status, status_of
from dyntorch.geometry.homogeneous import homogeneous, similarity
from dyntorch.numerics.arguments import check_weights, on_cpu
from dyntorch.numerics.blocks import map_blocks, one_thread
from dyntorch.numerics.nullspace import gram_null_space, null_space, spectrum

# earlier steps that are mixed; planar constant velocity, 8 views, exact: 100 iterations leave 2e-12 px, with 5 steps 2e-7 px,
# and 300 iterations without mixing 2e-2 px
MEMORY = 10
PLAIN = 5  # iterations before the mixing starts
WORSE = 2.0  # times the smallest residual so far: there a mixed step is given up
MAX_ITERATIONS, DEPTH_TOLERANCE = 300, 1e-6  # of the depths: steps, and their change in one as a part of the residual
EXACT = 1e-12  # residual of an exact solution; rounding alone leaves up to 1e-14, and more where structure is shallow
BLOCK = 2**20  # depths per block


@dataclass(frozen=True, eq=False, repr=False)
class ProjectiveFactorization(Outcome):
    """Projections and structure up to a collineation of P^k; ``AMBIGUOUS`` where the depths still changed at the end."""

    projections: Tensor
    """``(*batch, views, l + 1, K)``, Frobenius norm 1."""
    structure: Tensor
    """``(*batch, n, K)`` homogeneous, norm 1; 0 for points that were left out."""
    residual: Tensor
    """``(*batch,)`` part of the norm of the scaled measurements beyond rank K, from 0 (exact) to 1 (nothing was found)."""

    TASK = "projective_factorization"

    def __repr__(self) -> str:
        return self.head(views=self.projections.shape[-3], points=self.structure.shape[-2])


@one_thread
@on_cpu
def projective_factorization(tracks: Tensor, rank: int, weights: Tensor | None = None) -> ProjectiveFactorization:
    r"""Depths with which the measurements have rank K: :math:`[\lambda_{ip}\,(x_{ip}, 1)] \approx [M_i]\,[Y_p]`.

    Alternates the best subspace of dimension K for the depths with the best depths for the subspace, on normalized views and
    rays of length 1, with rows and columns balanced so that nothing vanishes; Anderson mixing makes that fast.  It minimizes
    an algebraic error, and a local minimum of it: a start or a cross-check for bundle adjustment, not its substitute.  Planar
    points at constant velocity, seen obliquely from near (depths differ by a factor of 2 to 3), end in a wrong minimum in 10
    to 20 % of scenes, as they do without mixing; the residual then stands out (1e-2 instead of 3e-3 at one pixel of noise).

    A search: it computes on the CPU wherever its tensors are, and the result returns to their device.

    Args:
        tracks: ``(*batch, views, n, l)`` in any unit.  **Only points measured in every view are used.**
        rank: K = k + 1: 4 for a static scene in space, 5 for planar points at constant velocity, 7 for those in space.
        weights: ``(*batch, views, n)``; a point with a 0, or a NaN coordinate, in any view is left out, all others count alike.

    Returns:
        Projections, structure and residual; without gradients.  A problem with too few complete points, or whose squared
        coordinates leave the range of float64, has projections and structure 0 and residual 1, and is not OK.

    Raises:
        ValueError: shapes that do not fit, or fewer views or points than a reconstruction of this rank needs.

    Source: Sturm and Triggs 1996; Heyden, Berthilsson and Sparr 1999; Walker and Ni 2011 (the mixing).

    Example:
        >>> import torch
        >>> g = torch.Generator().manual_seed(0)
        >>> M, Y = torch.randn(5, 3, 4, generator=g, dtype=torch.float64), torch.randn(20, 4, generator=g, dtype=torch.float64)
        >>> M[:, 2], Y[:, 3] = torch.tensor([0.0, 0.0, 0.1, 1.0]), 1.0  # in front of all cameras
        >>> images = Y @ M.mT
        >>> found = projective_factorization(images[..., :2] / images[..., 2:], 4)
        >>> again = found.structure @ found.projections.mT
        >>> bool(found.status == 0), bool(torch.allclose(again[..., :2] / again[..., 2:], images[..., :2] / images[..., 2:]))
        (True, True)
    """
    least = _check(tracks, rank, weights)
    batch, (views, n, size) = tracks.shape[:-3], tracks.shape[-3:]
    x, complete = _complete_points(tracks, weights, least)

    def block(x: Tensor, complete: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        return _factorize(x, complete, rank)

    count = prod(batch)
    problems = (x.reshape(count, views, n, size), complete.reshape(count, n))
    found = map_blocks(block, *problems, size=max(1, ceil(BLOCK / (views * n * MEMORY))))
    projections, structure, residual, converged = (part.reshape(batch + part.shape[1:]) for part in found)
    dtype = tracks.dtype
    status = torch.where(converged, int(Status.OK), int(Status.AMBIGUOUS))
    return ProjectiveFactorization(projections.to(dtype), structure.to(dtype), residual.to(dtype), status=status)


def _complete_points(tracks: Tensor, weights: Tensor | None, least: int) -> tuple[Tensor, Tensor]:
    """Tracks in float64, 0 for all that are not seen everywhere, and which are ``(*batch, n)``; none where they are too few."""
    x = tracks.detach().double()
    complete = torch.isfinite(x).all(-1).all(-2)
    if weights is not None:
        complete = complete & (weights > 0).all(-2)
    complete = complete & (complete.sum(-1, keepdim=True) >= least)
    return torch.where(complete[..., None, :, None], x, 0.0), complete


def _check_weights(tracks: Tensor, weights: Tensor | None) -> None:
    if weights is not None and weights.shape != tracks.shape[:-1]:
        raise ValueError(f"weights must be (*batch, views, n) = {tuple(tracks.shape[:-1])}, got {tuple(weights.shape)}")
    check_weights(weights, "a point")


def _check(tracks: Tensor, rank: int, weights: Tensor | None) -> int:
    """The number of points that decide the projections."""
    if tracks.ndim < 3 or not tracks.is_floating_point():
        raise ValueError(f"tracks must be floating point (*batch, views, n, l), got {tuple(tracks.shape)} {tracks.dtype}")
    views, n, size = tracks.shape[-3:]
    _check_weights(tracks, weights)
    if rank <= size + 1:
        raise ValueError(f"rank must exceed l + 1 = {size + 1}, or one view decides everything; got {rank}")
    # every point has rank - 1 unknowns, and must leave equations for the projections
    if views * size < rank:
        raise ValueError(f"a factorization of rank {rank} needs at least {ceil(rank / size)} views, got {views}: add views")
    least = max(rank + 1, ceil((views * ((size + 1) * rank - 1) - rank**2 + 1) / (views * size - rank + 1)))
    if n < least:
        raise ValueError(f"a factorization of rank {rank} from {views} views needs at least {least} points, got {n}: add points")
    return least


def _factorize(x: Tensor, complete: Tensor, rank: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """One block of problems ``(b, views, n, l)``, and which points ``(b, n)`` count."""
    share = complete.to(x.dtype) / complete.sum(-1, keepdim=True).clamp(min=1)
    rays, back = _rays(x, share[:, None, :, None])
    columns = share.sqrt()[:, None, :]
    depths, converged = _solve(rays, columns, rank)
    scaled, basis, residual = _subspace(depths, rays, rank)
    projections = back @ basis.unflatten(-2, (x.shape[1], x.shape[3] + 1))
    projections = projections / torch.linalg.matrix_norm(projections, keepdim=True)
    structure = torch.nn.functional.normalize(scaled.mT @ basis, dim=-1)
    # squares of coordinates may leave the range
    finite = projections.flatten(1).isfinite().all(-1) & structure.flatten(1).isfinite().all(-1) & residual.isfinite()
    known = complete.any(-1) & finite
    found = [torch.where(known[:, *[None] * (part.ndim - 1)], part, 0.0) for part in (projections, structure)]
    return found[0], found[1], torch.where(known, residual, 1.0), converged & known


def _rays(x: Tensor, part: Tensor) -> tuple[Tensor, Tensor]:
    """Rays of length 1 in normalized views ``(b, views, n, l + 1)``, 0 for points left out, and the way back from them."""
    centre = (x * part).sum(-2)
    spread = ((x - centre[..., None, :]).square() * part).sum((-2, -1))
    scale = torch.where(spread > 0, (x.shape[-1] / torch.where(spread > 0, spread, 1.0)).sqrt(), 1.0)
    rays = torch.nn.functional.normalize(homogeneous((x - centre[..., None, :]) * scale[..., None, None]), dim=-1)
    return rays * (part > 0), similarity(1 / scale, -centre * scale[..., None])


def _solve(rays: Tensor, columns: Tensor, rank: int) -> tuple[Tensor, Tensor]:
    """Depths ``(b, views, n)`` of the smallest residual that was met, and whether they no longer change ``(b,)``."""
    best = _balance((columns > 0).to(rays.dtype).expand(rays.shape[:-1]), columns, sweeps=10)
    smallest = torch.full_like(rays[:, 0, 0, 0], torch.inf)
    converged = torch.zeros_like(smallest, dtype=torch.bool)
    left = torch.arange(len(rays), device=rays.device)  # problems that still change
    depths, images, steps = best, best.new_empty(*best.shape, 0), best.new_empty(*best.shape, 0)
    best = best.clone()
    for i in range(MAX_ITERATIONS):
        image, residual = _next(depths, rays[left], columns[left], rank)
        step = image - depths
        better = residual < smallest[left]
        done = (step.square().sum((-2, -1)).sqrt() <= DEPTH_TOLERANCE * residual) | (residual <= EXACT)
        best[left[better | done]], smallest[left[better]] = depths[better | done], residual[better]
        converged[left[done]] = True
        if bool(done.all()):
            break
        left, residual = left[~done], residual[~done]
        images = torch.cat([images[..., -MEMORY:], image[..., None]], -1)[~done]
        steps = torch.cat([steps[..., -MEMORY:], step[..., None]], -1)[~done]
        depths = images[..., -1]
        if i >= PLAIN:
            given_up = (residual > WORSE * smallest[left])[:, None, None]
            depths = torch.where(given_up, depths, _balance(_mix(images, steps), columns[left], sweeps=1))
    return best, converged


def _next(depths: Tensor, rays: Tensor, columns: Tensor, rank: int) -> tuple[Tensor, Tensor]:
    """The best depths for the best subspace of these depths, and the residual of that subspace."""
    _, basis, residual = _subspace(depths, rays, rank)
    seen = rays.transpose(1, 2)[..., None, :] @ basis.unflatten(-2, rays.shape[1::2])[:, None]  # (b, n, views, 1, K)
    seen = seen.squeeze(-2)
    new = spectrum(seen @ seen.mT)[1][..., -1].mT
    new = new * torch.where((new * depths).sum(1, keepdim=True) < 0, -1.0, 1.0)
    return _balance(new, columns), residual


def _subspace(depths: Tensor, rays: Tensor, rank: int) -> tuple[Tensor, Tensor, Tensor]:
    """Scaled measurements ``(b, views (l + 1), n)``, the basis ``(b, views (l + 1), K)`` of their best subspace, the residual."""
    scaled = (depths[..., None] * rays).mT.flatten(1, 2)
    basis = spectrum(scaled @ scaled.mT)[1][..., -rank:]
    # from the difference itself: the Gram matrix only knows it to half the digits
    rest = torch.linalg.matrix_norm(scaled - basis @ (basis.mT @ scaled))
    return scaled, basis, rest / torch.linalg.matrix_norm(scaled).clamp(min=1e-300)


def _balance(depths: Tensor, columns: Tensor, sweeps: int = 3) -> Tensor:
    """Sinkhorn sweeps: the same norm for all views, the same for all points, 1 for everything."""
    row = depths.shape[1] ** -0.5
    depths = torch.where(columns > 0, depths, 0.0)
    for _ in range(sweeps):
        depths = torch.nn.functional.normalize(depths, dim=2) * row
        depths = torch.nn.functional.normalize(depths, dim=1) * columns
    return depths


def _mix(images: Tensor, steps: Tensor) -> Tensor:
    """Anderson mixing: the combination of the last images whose steps cancel best."""
    shape = images.shape[:-1]
    images, steps = images.flatten(1, 2), steps.flatten(1, 2)
    slopes, moves = steps.diff(dim=-1), images.diff(dim=-1)
    gram = slopes.mT @ slopes
    ridge = 1e-10 * gram.diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None] + 1e-300
    eye = torch.eye(gram.shape[-1], dtype=gram.dtype, device=gram.device)
    factors, pivots, _ = torch.linalg.lu_factor_ex(gram + ridge * eye)
    share: Tensor = torch.linalg.lu_solve(factors, pivots, slopes.mT @ steps[..., -1:])
    return (images[..., -1:] - moves @ share).reshape(shape)


# ----------------------------------------------------------------------------------------------------------------------
# Structure and velocities from many affine views at once: the factorization of constant velocity.


MAX_SWEEPS, SWEEP_TOLERANCE = 100, 1e-8  # of the alternation, and the relative gain of one that ends it
FLAT = 1e-9  # of the largest singular value: below it the measurements have no further dimension
VELOCITY_BLOCK = 2**20  # measurements per block


@dataclass(frozen=True, eq=False, repr=False)
class VelocityFactorization(Outcome):
    r"""Cameras, points and velocities up to :math:`(X, V) \mapsto (G X + a, G V + b)`; points and velocities have mean 0."""

    cameras: Tensor
    """``(*batch, views, 2, d)``, with :math:`\\sum_i A_i^T A_i` = (2 views / d) I: the world is in the unit of the tracks."""
    offsets: Tensor
    """``(*batch, views, 2)``, the mean of the tracks in each view."""
    points: Tensor
    """``(*batch, n, d)`` at time 0; 0 for points that were left out."""
    velocities: Tensor
    """``(*batch, n, d)`` per unit of time; 0 for points that were left out."""
    residual: Tensor
    """``(*batch,)`` root mean square of the image distances, in the unit of the tracks."""

    TASK = "velocity_factorization"

    def __repr__(self) -> str:
        return self.head(views=self.cameras.shape[-3], points=self.points.shape[-2])


@one_thread
def velocity_factorization(tracks: Tensor, times: Tensor, dim: int = 3, weights: Tensor | None = None) -> VelocityFactorization:
    r"""Affine cameras and points at constant velocity: :math:`x_{ip} = A_i (X_p + t_i V_p) + b_i`.

    Without the mean of each view, the measurements have rank 2 d: :math:`W = [A_i,\ t_i A_i]\,[X_p; V_p]`.  A basis U of their
    columns differs from the first factor by a matrix :math:`[T_1, T_2]`, and each of its d columns solves

    .. math:: U_i (t_2 - \tau_i\, t_1) = 0 \qquad \text{for all views,}

    so that it spans a null space of dimension d of a matrix of 2 views rows and 4 d columns.  From there alternating least
    squares over cameras and structure reach the optimum of the image distances.

    The null space is larger, and the result ambiguous, iff there are :math:`v_0, v_1, v_2`, not all 0, with
    :math:`A_i (v_0 + t_i v_1 + t_i^2 v_2) = 0` in all views.  For d = 2 and invertible :math:`A_i` three times exclude that.
    For d = 3 it says that the viewing directions move along a curve that is quadratic in time: always so with four views; with
    five if all are orthogonal to one axis (a turntable takes six); for a fixed camera with any number.

    Args:
        tracks: ``(*batch, views, n, 2)`` in any unit.  **Only points measured in every view are used**, of which at least
            2 d + 1 with positions and velocities in general position are needed: not all static, nor in one direction, nor
            (d = 3) all velocities in parallel planes.
        times: ``(views,)`` or ``(*batch, views)``, three different ones at least; several views may share one.
        dim: d, 3 for space or 2 for a plane.
        weights: ``(*batch, views, n)``; a point with a 0, or a NaN coordinate, in any view is left out.

    Returns:
        Cameras, offsets, points, velocities and residual; without gradients, and finite also where the status is not OK and the
        tracks do not decide the result.

    Raises:
        ValueError: shapes that do not fit, fewer views (5 for d = 3, 3 for d = 2), points or times than needed.

    Source: Han and Kanade 2000, "Reconstruction of a scene with multiple linearly moving objects"; thesis chapter 3.

    Example:
        >>> import torch
        >>> g = torch.Generator().manual_seed(0)
        >>> A, X, V = (torch.randn(*s, generator=g, dtype=torch.float64) for s in ((6, 2, 3), (12, 3), (12, 3)))
        >>> times = torch.tensor([0.0, 1.0, 2.0, 4.0, 5.0, 7.0], dtype=torch.float64)
        >>> tracks = (X + times[:, None, None] * V) @ A.mT
        >>> found = velocity_factorization(tracks, times)
        >>> again = (found.points + times[:, None, None] * found.velocities) @ found.cameras.mT + found.offsets[:, None]
        >>> bool(torch.allclose(again, tracks)), bool(found.status == 0)
        (True, True)
    """
    _check_moving(tracks, times, dim, weights)
    batch, (views, n, _) = tracks.shape[:-3], tracks.shape[-3:]
    x, complete = _complete_points(tracks, weights, 2 * dim + 1)
    t = times.detach().to(x).expand(*batch, views)

    def block(x: Tensor, t: Tensor, complete: Tensor) -> tuple[Tensor, ...]:
        return _factorize_moving(x, t, complete, dim)

    count = prod(batch)
    problems = (x.reshape(count, views, n, 2), t.reshape(count, views), complete.reshape(count, n))
    found = map_blocks(block, *problems, size=max(1, ceil(VELOCITY_BLOCK / (2 * views * n))))
    *parts, degenerate = (part.reshape(batch + part.shape[1:]) for part in found)
    cameras, offsets, points, velocities, residual = (part.to(tracks.dtype) for part in parts)
    return VelocityFactorization(cameras, offsets, points, velocities, residual, status=status_of(degenerate))


def _check_moving(tracks: Tensor, times: Tensor, dim: int, weights: Tensor | None) -> None:
    if tracks.ndim < 3 or tracks.shape[-1] != 2 or not tracks.is_floating_point():
        raise ValueError(f"tracks must be floating point (*batch, views, n, 2), got {tuple(tracks.shape)} {tracks.dtype}")
    if dim not in (2, 3):
        raise ValueError(f"dim must be 3, space, or 2, a plane, got {dim}")
    views, n = tracks.shape[-3:-1]
    _check_weights(tracks, weights)
    least = 5 if dim == 3 else 3
    if views < least:
        raise ValueError(f"constant velocity in {dim} dimensions needs at least {least} affine views, got {views}: add views")
    if n <= 2 * dim:
        raise ValueError(f"constant velocity in {dim} dimensions needs at least {2 * dim + 1} points, got {n}: add points")
    if times.shape[-1:] != (views,) or not bool(torch.isfinite(times).all()):
        raise ValueError(f"times must be finite (views,) or (*batch, views) with views = {views}, got {tuple(times.shape)}")
    different = 1 + (times.sort(-1).values.diff(dim=-1) > 0).sum(-1).min()
    if different < 3:
        raise ValueError(f"times must hold at least 3 different ones, got {int(different)}: velocities need views over time")


def _factorize_moving(x: Tensor, t: Tensor, complete: Tensor, dim: int) -> tuple[Tensor, ...]:
    """One block of problems ``(b, views, n, 2)``, in normalized images and times, and back."""
    share = complete.to(x.dtype) / complete.sum(-1, keepdim=True).clamp(min=1)
    offsets = (x * share[:, None, :, None]).sum(-2)
    x = torch.where(complete[:, None, :, None], x - offsets[:, :, None], 0.0)
    measured = complete.sum(-1) * x.shape[1]
    scale = (x.square().sum((1, 2, 3)) / (2 * measured.clamp(min=1))).sqrt()
    scale = torch.where(scale > 0, scale, 1.0)[:, None, None, None]
    start = t.mean(-1)
    unit = (t - start[:, None]).square().mean(-1).sqrt()
    tau = (t - start[:, None]) / unit[:, None]
    images = (x / scale).mT  # (b, views, 2, n)
    cameras, degenerate = _upgrade(images, tau, dim)
    cameras, points, velocities, error = _alternate(images, tau, cameras)
    # the gauge: orthogonal cameras of the size of a scaled orthography with scale 1
    gram = (cameras.mT @ cameras).mean(1) * (dim / 2)
    factor, failed = torch.linalg.cholesky_ex(gram)
    degenerate = degenerate | (failed > 0) | ~torch.isfinite(error)
    eye = torch.eye(dim, dtype=x.dtype, device=x.device)
    factor = torch.where(degenerate[:, None, None], eye, factor)
    cameras = torch.linalg.solve_triangular(factor[:, None], cameras.mT, upper=False).mT
    points, velocities = ((factor.mT @ part).mT * scale[:, 0] for part in (points, velocities))
    velocities = velocities / unit[:, None, None]
    points = points - start[:, None, None] * velocities
    residual = (error / measured.clamp(min=1)).sqrt() * scale[:, 0, 0, 0]
    found = (cameras, offsets, points, velocities, residual)
    return *(torch.where(torch.isfinite(part), part, 0.0) for part in found), degenerate


def _upgrade(images: Tensor, tau: Tensor, dim: int) -> tuple[Tensor, Tensor]:
    """Cameras ``(b, views, 2, d)`` whose space-time extension [A, tau A] has the columns of the measurements, and doubt."""
    stacked = images.flatten(1, 2)
    vectors, values = torch.linalg.svd(stacked, full_matrices=False)[:2]
    # in units of the singular values the noise of all columns is the same
    basis = (vectors * values[:, None])[..., : 2 * dim].unflatten(1, images.shape[1:3])  # (b, views, 2, 2 d)
    rows = torch.cat([-tau[:, :, None, None] * basis, basis], -1).flatten(1, 2)
    ambiguous = gram_null_space(rows.mT @ rows, dim).degenerate
    first, second = (basis @ part.mT[:, None] for part in null_space(rows, dim).chunk(2, dim=-1))
    weight = tau[:, :, None, None]
    cameras = (first + weight * second) / (1 + weight.square())
    return cameras, ambiguous | (values[:, 2 * dim - 1] <= FLAT * values[:, 0])


def _alternate(images: Tensor, tau: Tensor, cameras: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Least squares in turn: structure ``(b, d, n)`` each for the cameras, cameras for the structure; and the squared error."""
    stacked, weight, dim = images.flatten(1, 2), tau[:, :, None, None], cameras.shape[-1]
    infinite = cameras.new_full((len(cameras),), torch.inf)
    result = [cameras.clone(), cameras.new_zeros(len(cameras), 2 * dim, images.shape[-1]), infinite]
    left = torch.arange(len(cameras), device=cameras.device)
    before = infinite.clone()
    for _ in range(MAX_SWEEPS):
        motion = torch.cat([cameras, weight[left] * cameras], -1).flatten(1, 2)
        structure = _least_squares(motion, stacked[left])
        error = (stacked[left] - motion @ structure).square().sum((1, 2))
        for part, value in zip(result, (cameras, structure, error), strict=True):
            part[left] = value
        more = (before - error > SWEEP_TOLERANCE * error) & (error > 1e-28 * stacked[left].square().sum((1, 2)))
        left, before = left[more], error[more]
        if not len(left):
            break
        points, velocities = structure[more].chunk(2, dim=-2)
        moved = points[:, None] + weight[left] * velocities[:, None]  # (b, views, d, n)
        cameras = _least_squares(moved.mT, images[left].mT).mT
    points, velocities = result[1].chunk(2, dim=-2)
    return result[0], points, velocities, result[2]


def _least_squares(matrix: Tensor, right: Tensor) -> Tensor:
    """Solutions by QR, not finite where the matrix is singular."""
    q, r = torch.linalg.qr(matrix)
    solution: Tensor = torch.linalg.solve_triangular(r, q.mT @ right, upper=True)
    return solution
