"""Batched bundle adjustment for projections P^k -> P^l: cameras and points that minimize the reprojection error."""

from __future__ import annotations

from dataclasses import dataclass
from math import prod

import torch
from torch import Tensor
from torch.nn.functional import normalize

from dyntorch.algebra.triangulation import observed
from dyntorch.arguments import check_tensor, check_together
from dyntorch.blocks import map_blocks, one_thread, workers
from dyntorch.bundle_problem import BundleProblem

BLOCK = 1 << 20
"""Entries of the largest arrays per block of the batch.  1000 problems of 3 views and 60 points take 0.15 ms per step each with
2^20, 0.21 ms with 2^18 (a few slow problems at the end of a block cost as many calls as all of them) and 0.19 ms with 2^21."""
LOSSES = ("geman_mcclure", "huber")


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
    loss: str = "geman_mcclure",
    tolerance: float = 1e-9,
    confined: Tensor | None = None,
    subspace: Tensor | None = None,
) -> Adjusted:
    r"""Cameras and points that minimize the reprojection error :math:`\sum_{ij} w_{ij}\, \rho(|x_{ij} - \pi(P_i B_i Y_j)|^2)`.

    Batched Levenberg-Marquardt; the points are eliminated by the Schur complement.  Every camera and point is kept at norm 1;
    the gauge (collineations of P^k, or what the lifts leave of them) is free, and damping handles it.  The cost never rises.
    :math:`\rho(s) = s`, or with a scale c

    .. math:: \rho(s) = \frac{c^2 s}{c^2 + s} \quad \text{(Geman-McClure)}, \qquad
        \rho(s) = \min(s,\; 2 c \sqrt{s} - c^2 \text{ where } s > c^2) \quad \text{(Huber)}.

    Points seen in too few views (fewer than k equations), zero points and views without an image that counts stay as they are.

    Args:
        x: ``(*batch, views, n, l)`` images, best normalized; NaN = missing.
        weights: ``(*batch, views, n)``, 0 = missing, or None.
        cameras: ``(*batch, views, l + 1, a + 1)`` start :math:`P_i`, of any scale.
        structure: ``(*batch, n, k + 1)`` start :math:`Y_j`, of any scale; 0 where unknown.
        lifts: :math:`B_i`, ``(views, a + 1, k + 1)`` or ``(*batch, views, a + 1, k + 1)``; None: the identity (a = k).
        iterations: at most so many steps.
        scale: error beyond which an image counts as an outlier, in the unit of ``x``, one or ``(*batch,)``; None: none does.
        loss: ``"geman_mcclure"`` or ``"huber"``, used with a scale.
        tolerance: done where a step lowers the cost by less than this fraction.
        confined: ``(*batch, n)`` bool: points kept within a subspace of the constants, such as those known to stand still.
        subspace: ``(k + 1, r)`` orthonormal columns that span it.

    Returns:
        Adjusted, in the dtype of ``x``, without gradients.  A problem whose start is not finite is not adjusted and has cost
        infinity; what of it is not finite comes back as 0.

    Raises:
        ValueError: shapes that do not fit each other, another loss, or a scale that is not positive.

    Source: Triggs et al. 2000, Bundle adjustment, a modern synthesis; cameras P^k -> P^l of thesis chapter 3.

    Example:
        >>> import torch
        >>> from dyntorch.algebra.triangulation import reproject
        >>> g = torch.Generator().manual_seed(0)
        >>> P, Y = torch.eye(3, 4) + torch.rand(3, 3, 4, generator=g).double() / 4, torch.rand(12, 4, generator=g).double() + 1
        >>> x = reproject(P, Y)
        >>> start = P + 0.01 * torch.rand(P.shape, generator=g), Y + 0.01 * torch.rand(Y.shape, generator=g)
        >>> bool(bundle_adjust(x, None, *start).cost < 1e-20)
        True
    """
    batch = check(x, weights, cameras, structure, lifts, loss)
    count, (views, n, size) = prod(batch), x.shape[-3:]

    def flat(tensor: Tensor, *shape: int) -> Tensor:
        return tensor.detach().double().expand(*batch, *shape).reshape(count, *shape)

    images, w = observed(x, weights)
    start = flat(cameras, *cameras.shape[-3:]), flat(structure, *structure.shape[-2:])
    w, moves, seen = _counted(flat(w, views, n), start[1], size)
    extra: tuple[Tensor, ...] = () if lifts is None else (flat(lifts, *lifts.shape[-3:]),)
    extra += () if scale is None else (_scales(scale, batch, x.device),)
    if confined is not None:
        start, outside = _inside(*start, confined.expand(*batch, n).reshape(count, n), subspace)
        extra += (outside,)

    def run(*block: Tensor) -> tuple[Tensor, ...]:
        rest = list(block[4:])
        lift = None if lifts is None else rest.pop(0)
        limit = None if scale is None else rest.pop(0)
        outside = rest.pop(0).permute(0, 2, 3, 1) if rest else None
        problem = BundleProblem(block[0].mT.contiguous(), block[1], lift, limit, loss, outside)
        return _minimize(problem, block[2], block[3].mT.contiguous(), iterations, tolerance)

    a, k = cameras.shape[-1], structure.shape[-1]
    width = n * (views**2 * ((size + 1) ** 2 + a**2) + (k + views * size) * k)
    problems = max(1, min(BLOCK // max(1, width), -(-count // workers())))
    clean = tuple(torch.where(part.isfinite(), part, 0.0) for part in start)
    with torch.no_grad():
        found = map_blocks(run, flat(images, views, n, size), w, *clean, *extra, size=problems)
    # what counts has to be finite; the rest stays as it is
    sound = (start[0].isfinite().flatten(2).all(-1) | ~seen).all(-1) & (start[1].isfinite().all(-1) | ~moves).all(-1)
    sound = (sound & found[2].isfinite())[:, None]
    return Adjusted(
        torch.where((sound & seen)[..., None, None], found[0], clean[0]).reshape(*batch, *cameras.shape[-3:]).to(x.dtype),
        torch.where((sound & moves)[..., None], found[1], clean[1]).reshape(*batch, *structure.shape[-2:]).to(x.dtype),
        torch.where(sound[:, 0], found[2], torch.inf).reshape(batch).to(x.dtype),
        found[3].reshape(batch),
    )


def _counted(weights: Tensor, structure: Tensor, size: int) -> tuple[Tensor, Tensor, Tensor]:
    """Weights of what counts, the points ``(b, n)`` that are seen often enough, and the views ``(b, v)`` that see any of them."""
    moves = ((weights > 0).sum(1) * size >= structure.shape[-1] - 1) & (structure != 0).any(-1)
    weights = weights * moves[:, None]
    return weights, moves, (weights > 0).any(-1)


def _minimize(
    problem: BundleProblem, cameras: Tensor, points: Tensor, iterations: int, tolerance: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Cameras, points ``(b, n, k + 1)``, cost and steps tried at the minimum of every problem of a block."""
    cameras, points = _unit_cameras(cameras), normalize(points, dim=1)
    state = [cameras, points, problem.costs(cameras, points).sum(-1), torch.full_like(cameras[:, 0, 0, 0], 1e-3)]
    # errors of the size of the rounding of the images are no errors
    floor = 1e-30 * (problem.x.square().sum(2) * problem.weights).sum((1, 2))
    result = [*state[:3], torch.zeros_like(state[2], dtype=torch.long)]
    left = torch.arange(len(cameras), device=cameras.device)
    done = ~state[2].isfinite()
    for count in range(1, iterations + 1):
        keep = (~done).nonzero().flatten()
        if not len(keep):
            break
        if len(keep) < len(left):
            left, floor, problem, state = left[keep], floor[keep], problem.subset(keep), [part[keep] for part in state]
        state, done = _step(problem, state, tolerance, floor)
        # problems that are done leave: the slow ones do not make the others wait
        for whole, part in zip(result[:3], state[:3], strict=True):
            whole[left] = part
        result[3][left] = count
    return result[0], result[1].mT, result[2], result[3]


def _step(problem: BundleProblem, state: list[Tensor], tolerance: float, floor: Tensor) -> tuple[list[Tensor], Tensor]:
    """One damped step of every problem: the new state, and which problems are done."""
    cameras, points, cost, damping = state
    camera_step, point_step, gain = problem.step(cameras, points, damping)
    cameras_, points_ = _unit_cameras(cameras - camera_step), normalize(points - point_step, dim=1)
    points_, fresh = problem.settled(cameras_, points_)
    better = fresh < cost
    # done: hardly a gain any more, none expected, or no way down even by the shortest steps
    small = tolerance * cost
    done = torch.where(better, (cost - fresh <= small) | (fresh <= floor), (gain <= small) | (damping > 1e6))
    damping = torch.where(better, (damping * 0.1).clamp(min=1e-12), damping * 8)
    chosen = better[:, None, None]
    cameras, points = torch.where(chosen[..., None], cameras_, cameras), torch.where(chosen, points_, points)
    return [cameras, points, torch.where(better, fresh, cost), damping], done


def _inside(cameras: Tensor, structure: Tensor, confined: Tensor, subspace: Tensor | None) -> tuple[tuple[Tensor, Tensor], Tensor]:
    """The start with the confined points within the subspace, and the projectors ``(b, n, K, K)`` onto what is forbidden."""
    size = structure.shape[-1]
    if subspace is None or subspace.shape[0] != size:
        got = None if subspace is None else tuple(subspace.shape)
        raise ValueError(f"confined points need a subspace ({size}, r) of orthonormal columns, got {got}")
    basis = subspace.to(structure)
    away = torch.eye(size, dtype=basis.dtype, device=basis.device) - basis @ basis.mT
    outside = away * confined[..., None, None]
    return (cameras, structure - (structure[..., None, :] @ outside)[..., 0, :]), outside


def _unit_cameras(cameras: Tensor) -> Tensor:
    return normalize(cameras.flatten(2), dim=-1).view_as(cameras)


def _scales(scale: Tensor | float, batch: torch.Size, device: torch.device) -> Tensor:
    """``(b,)``."""
    given = torch.as_tensor(scale, dtype=torch.float64, device=device)
    if not bool((given > 0).all()):
        raise ValueError(f"scale must be positive, in the unit of x, got {given.min().item():g}; give None for least squares")
    return given.expand(batch).reshape(prod(batch))


def check(x: Tensor, weights: Tensor | None, cameras: Tensor, structure: Tensor, lifts: Tensor | None, loss: str) -> torch.Size:
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
    if loss not in LOSSES:
        raise ValueError(f"loss must be one of {', '.join(LOSSES)}, got {loss!r}")
    for name, part, last in (("cameras", cameras, 3), ("structure", structure, 2)):
        if check_together(x=(x.double(), 3), **{name: (part.double(), last)}) != x.shape[:-3]:
            raise ValueError(f"{name} have batch {tuple(part.shape[:-last])}, x has {tuple(batch)}; expand x")
    return torch.Size(batch)
