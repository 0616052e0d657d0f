"""How well noise leaves the points of a lifted scene determined, cameras and all."""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.blocks import map_blocks
from dyntorch.eigenspace import spectrum

BLOCK = 1 << 17
"""Entries of the largest array per block of the batch: 200 problems of 3 views and 60 points of P^4 take 0.10 s, 2^21 0.17 s."""
ROUNDING = 1e-10
"""Of the largest eigenvalue of the information on the cameras: what rounding leaves of a zero.  Sound scenes of 60 points: 3e-6 to
0.1; the gauge itself: up to 1e-11."""


def point_uncertainty(
    cameras: Tensor, structure: Tensor, lifts: Tensor, depth: Tensor, weights: Tensor, gauge: int, metric: Tensor, step: int = 1
) -> Tensor:
    r"""Standard deviation of each point per unit of noise, when cameras and points are both unknown.

    With the information on cameras :math:`U`, on a point :math:`V_j`, and between them :math:`W_j`, of the images,

    .. math:: \mathrm{cov}(Y_j) = V_j^{+} + V_j^{+} W_j^T S^{+} W_j V_j^{+}, \qquad S = U - \sum_j W_j V_j^{+} W_j^T,

    where :math:`S^{+}` leaves out the dimensions that no image can tell (``gauge``, scales, views without images): cameras as near
    as possible to those given.

    Args:
        cameras: ``(b, views, m, a + 1)``.
        structure: ``(b, n, K)``, zero where a point is not determined.
        lifts: ``(b, views, a + 1, K)``.
        depth: ``(K,)`` or ``(b, n, K)`` linear function of a point that gives it its scale.
        weights: ``(b, views, n)``, 0 = missing.
        gauge: dimension of what is open, without the scales of the cameras.
        metric: ``(b, K, K)`` from these coordinates, best ones that the points fill, to those in which errors are measured.
        step: distance of the points that are asked for; all of them tell about the cameras.

    Returns:
        ``(b, n)`` (fewer with ``step``): root of the trace of the covariance of a point scaled to depth 1, in the unit
        of ``metric`` times ``structure`` over that of the images; infinite where a point, or the cameras, are not determined.

    Source: Triggs et al. 2000, Bundle adjustment, section 9; Hartley and Zisserman, appendix A6.
    """
    b, views, n = weights.shape
    wide = structure.shape[-1] * cameras.shape[-2] * cameras.shape[-1] * views
    value = (structure * depth).sum(-1, keepdim=True)
    known = (structure != 0).any(-1) & (value[..., 0].abs() > 1e-12)
    unit = torch.where(known[..., None], structure / torch.where(known[..., None], value, 1.0), 0.0)
    functional = depth.expand(b, n, -1)

    def run(*block: Tensor) -> Tensor:
        return _uncertainty(block, gauge, step)

    found = map_blocks(
        run, cameras, unit, functional, weights * known[:, None], lifts, metric, size=max(1, BLOCK // (n * wide + 1))
    )
    return torch.where(known[:, ::step] & found.isfinite(), found, torch.inf)


def _uncertainty(block: tuple[Tensor, ...], gauge: int, step: int) -> Tensor:
    cameras, structure, depth, weights, lifts, metric = block
    by_camera, by_point = _derivatives(cameras, structure, weights, lifts)
    information = torch.einsum("bvnlk,bvnlj->bnkj", by_point, by_point)
    trace = information.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    along = torch.nn.functional.normalize(structure, dim=-1)
    eye = torch.eye(structure.shape[-1], dtype=structure.dtype, device=structure.device)
    # the scale of a point is nobody's business: an equation of its own keeps it
    held = information + trace * along[..., :, None] * along[..., None, :] + torch.where(trace > 0, 1e-14 * trace, 1.0) * eye
    factor = torch.linalg.cholesky_ex(held)[0]
    between = torch.einsum("bvnlp,bvnlk->bnkvp", by_camera, by_point).flatten(-2)
    whitened = torch.linalg.solve_triangular(factor, between, upper=False)  # L^-1 W^T
    blocks = torch.einsum("bvnlp,bvnlq->bvpq", by_camera, by_camera)
    whole = torch.diag_embed(blocks.permute(0, 2, 3, 1)).permute(0, 3, 1, 4, 2).flatten(3).flatten(1, 2)
    reduced = whole - whitened.flatten(1, 2).mT @ whitened.flatten(1, 2)
    values, vectors = spectrum(reduced)
    seen = (weights > 0).any(-1).sum(-1)
    open_ = seen + gauge + (weights.shape[1] - seen) * cameras.shape[-2] * cameras.shape[-1]
    free = torch.arange(values.shape[-1], device=values.device) >= open_[:, None]
    rounding = torch.where(free, -torch.inf, values).amax(-1, keepdim=True)
    told = values > torch.maximum(ROUNDING * values[:, -1:], 100 * rounding)
    spread = vectors * torch.where(free & told, values.clamp(min=torch.finfo(values.dtype).tiny).rsqrt(), 0.0)[:, None]
    factor, whitened, structure, depth = factor[:, ::step], whitened[:, ::step], structure[:, ::step], depth[:, ::step]
    inverse = torch.linalg.solve_triangular(factor, eye.expand_as(factor), upper=False)
    moved = torch.cat([inverse.mT, inverse.mT @ (whitened @ spread[:, None])], dim=-1)
    # at depth 1: what only changes the scale does not count
    moved = moved - structure[..., None] * (depth[..., None, :] @ moved)
    moved = metric[:, None] @ moved
    return torch.where((told | ~free).all(-1, keepdim=True), moved.square().sum((-2, -1)).sqrt(), torch.inf)


def _derivatives(cameras: Tensor, structure: Tensor, weights: Tensor, lifts: Tensor) -> tuple[Tensor, Tensor]:
    """Of the weighted images by the entries of their cameras ``(b, v, n, l, m (a + 1))`` and by the points ``(b, v, n, l, K)``."""
    world = structure[:, None] @ lifts.mT
    image = world @ cameras.mT
    below = image[..., -1:]
    seen = (weights > 0)[..., None] & (below.abs() > 1e-12)
    below = torch.where(seen, below, 1.0)
    eye = torch.eye(image.shape[-1] - 1, dtype=image.dtype, device=image.device).expand(*image.shape[:-1], -1, -1)
    slope = torch.cat([eye, -(image[..., :-1] / below)[..., None]], dim=-1) / below[..., None]
    slope = slope * torch.where(seen, weights[..., None].sqrt(), 0.0)[..., None]
    return (slope[..., None] * world[..., None, None, :]).flatten(-2), slope @ (cameras @ lifts)[:, :, None]
