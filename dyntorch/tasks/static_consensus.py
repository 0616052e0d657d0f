"""Random sampling for scenes in which some points stand still: collineations from d + 2 matches, judged by their consensus."""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.algebra.homogeneous import apply, homogeneous
from dyntorch.blocks import map_blocks
from dyntorch.chi_square import median
from dyntorch.sampling import uniform

BLOCK = 1 << 19
"""Numbers in the largest temporary of one block of the batch (4 MB)."""
JUDGES = 256
"""Matches that judge a hypothesis: enough to tell 5 % of agreement from none."""


def static_consensus(
    views: tuple[Tensor, ...], pool: Tensor, limit: Tensor | None, samples: int, generator: torch.Generator | None
) -> tuple[tuple[Tensor, ...], Tensor]:
    r"""Collineations of view 2, 3, ... to view 1 on which the most matches agree, from samples of d + 2 matches.

    A collineation that takes the points :math:`q_k` to :math:`p_k` is :math:`P\, \mathrm{diag}(c_k / e_k)\, Q^{-1}` where the
    columns of P, Q are the first d + 1 of them and c, e the coordinates of the last one in these bases.

    Args:
        views: ``(b, n, d)`` each, of about unit size.
        pool: ``(b, n)`` bool, matches to sample from and to count.
        limit: ``(b,)`` square distance in view 1, summed over the other views, that is as bad as any larger one; None: least
            median of squares.
        samples: hypotheses per problem.
        generator: source of the samples.

    Returns:
        One ``(b, d + 1, d + 1)`` per view after the first, and ``(b,)`` the median square distance of the pool, halved for the
        noise of the two views that each distance has and divided by the median of :math:`\chi^2_4`: an estimate of the
        variance of the noise where more than half of the pool stands still.

    Source: Fischler and Bolles 1981; Rousseeuw 1984 (least median of squares); Hartley and Zisserman, section 4.7.
    """
    b, n, d = views[0].shape
    device = views[0].device
    shuffled = (uniform(b, n, generator=generator, device=device) + 2.0 * ~pool).argsort(dim=-1)
    count = pool.sum(-1)
    # distinct places: draw from ever fewer, and step over those already taken
    draws = uniform(b, samples, d + 2, generator=generator, device=device)
    taken: list[Tensor] = []
    for k in range(d + 2):
        place = (draws[..., k] * (count - k).clamp(min=1)[:, None]).long()
        for other in torch.stack(taken, -1).sort(dim=-1).values.unbind(-1) if taken else ():
            place = place + (place >= other)
        taken.append(place)
    chosen = torch.stack(taken, -1).clamp(max=n - 1)
    judges = shuffled[:, :JUDGES]
    limits = torch.full_like(views[0][:, 0, 0], torch.inf) if limit is None else limit

    def search(*block: Tensor) -> tuple[Tensor, ...]:
        return _search(block[: len(views)], *block[len(views) :], robust=limit is None)

    size = max(1, BLOCK // max(1, samples * judges.shape[-1] * (d + 1)))
    *found, variance = map_blocks(search, *views, shuffled, chosen, judges, count, limits, size=size)
    return tuple(found), variance


def _search(
    views: tuple[Tensor, ...], shuffled: Tensor, chosen: Tensor, judges: Tensor, count: Tensor, limit: Tensor, *, robust: bool
) -> tuple[Tensor, ...]:
    index = shuffled.gather(1, chosen.flatten(1)).unflatten(1, chosen.shape[1:])
    problem = torch.arange(len(index), device=index.device)
    sampled = [homogeneous(x[problem[:, None, None], index]) for x in views]
    maps = [_collineation(sampled[0], p) for p in sampled[1:]]
    seen = [x[problem[:, None], judges] for x in views]
    square = sum(
        ((apply(matrix, x[:, None]) - seen[0][:, None]).square().sum(-1) for matrix, x in zip(maps, seen[1:], strict=True)),
        start=torch.zeros((), dtype=seen[0].dtype, device=seen[0].device),
    )
    valid = torch.arange(judges.shape[-1], device=judges.device) < count[:, None]
    ordered = torch.where(valid[:, None], square, torch.inf)
    middle = ((valid.sum(-1) - 1) // 2).clamp(min=0)[:, None].expand(-1, square.shape[1])
    if robust:
        score = ordered.sort(dim=-1).values.gather(-1, middle[..., None])[..., 0]
    else:
        score = torch.where(valid[:, None], torch.minimum(square, limit[:, None, None]), 0.0).sum(-1)
    best = score.argmin(-1)
    chosen_square = ordered[problem, best].sort(dim=-1).values.gather(-1, middle[:, :1])[:, 0]
    return (*(matrix[problem, best] for matrix in maps), chosen_square / (2 * median(4)))


def _collineation(target: Tensor, source: Tensor) -> Tensor:
    """``(..., d + 1, d + 1)`` from d + 2 points ``(..., d + 2, d + 1)`` each; any matrix where three are on a line."""
    bases, coordinates = [], []
    for points in (target, source):
        inverse, _ = torch.linalg.inv_ex(points[..., :-1, :].mT)
        bases.append(inverse)
        coordinates.append((inverse @ points[..., -1, :, None])[..., 0])
    scaled = target[..., :-1, :].mT * (coordinates[0] / coordinates[1])[..., None, :]
    found = (scaled @ bases[1]).nan_to_num(nan=0.0, posinf=0.0, neginf=0.0)
    return found / torch.linalg.matrix_norm(found, keepdim=True).clamp(min=torch.finfo(found.dtype).tiny)
