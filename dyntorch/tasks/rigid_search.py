"""Robust estimation of two rigid motions: many starts from small samples, the best few annealed over all matches."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyntorch.algebra.rigid import rigid_alignment
from dyntorch.blocks import map_blocks
from dyntorch.chi_square import median, three_sigma
from dyntorch.sampling import uniform
from dyntorch.tasks.rigid import Sightings, combinations, descend, normal_equations, squares

STATIC_STARTS = 60
"""Samples of 3 matches taken as static: 40 % static points without outliers are met by 98 % of 60 such samples."""
MOVING_STARTS = 60
SAMPLE = {"straight": 7, "constant_velocity": 5}
"""Matches per moving sample, one or two above the minimum (6 and 3): at the minimum itself local minima abound."""
FINALISTS = 5
BITS = three_sigma(2) / 2
"""Cost, in units of 2 log likelihood, of one free coordinate: a match is an outlier (6 free ones) rather than a point on a
straight line (4) above the limit of chi-square with 2 degrees of freedom."""
ROUNDS = 4  # of labelling and least squares
PROBLEMS = 16  # of a batch solved together
SEEDS = 512  # velocities tried as the common one
STANDING = 0.1
"""Least share of the matches that must have one velocity before they are taken for the static background (and at least 3)."""


@dataclass(frozen=True)
class Rigid:
    """What the search found, in the coordinates it was given.

    Attributes:
        motions: ``(b, 2, 4, 4)``.
        sigma: ``(b,)`` noise of one coordinate.
        information: ``(b, 12, 12)`` Gauss-Newton matrix of the matches that belong to the model, per unit of noise.
        inliers: ``(b, n)`` bool.
        still: ``(b, n)`` bool.
    """

    motions: Tensor
    sigma: Tensor
    information: Tensor
    inliers: Tensor
    still: Tensor
    grounded: Tensor
    """``(b,)`` bool: whether static matches fix the common velocity (always, for straight lines)."""


def search(
    data: Sightings,
    sigma: Tensor | None,
    still: Tensor | None,
    starts: Tensor,
    generator: torch.Generator | None,
    floor: float = 1e-13,
) -> Rigid:
    """The two rigid motions that most matches agree with.

    Args:
        data: ``(b, n, 3)`` matches of size about 1, centred.
        sigma: ``(b,)`` noise of one coordinate; None estimates it (least median of squares).
        still: ``(b, n)`` bool, matches known to be static.
        starts: ``(b, k, 2, 4, 4)`` motions to begin with, besides those of samples.
        generator: of the samples.
        floor: least noise that is believed.
    """
    b, n = data.weights.shape
    draws = uniform(b, STATIC_STARTS + MOVING_STARTS, n, generator=generator, device=data.x1.device)
    # matches of weight 0 come last, so that they are drawn only where there is nothing else
    order = (draws + 2.0 * (data.weights <= 0)[:, None]).argsort(-1)[..., : SAMPLE[data.motion]]
    known = torch.zeros(b, dtype=data.x1.dtype, device=data.x1.device) if sigma is None else sigma
    flags = torch.zeros(b, n, dtype=torch.bool, device=data.x1.device) if still is None else still

    def run(*block: Tensor) -> tuple[Tensor, ...]:
        x1, x2, x3, weights, held, noise, picked, given = block
        part = Sightings(x1[:, None], x2[:, None], x3[:, None], weights[:, None], data.motion)
        found = _search(part, None if sigma is None else noise, held, picked, given, floor)
        return found.motions, found.sigma, found.information, found.inliers, found.still, found.grounded

    return Rigid(*map_blocks(run, data.x1, data.x2, data.x3, data.weights, flags, known, order, starts, size=PROBLEMS))


def _search(data: Sightings, sigma: Tensor | None, held: Tensor, order: Tensor, given: Tensor, floor: float) -> Rigid:
    """One block: sightings ``(b, 1, n, 3)``."""
    candidates = torch.cat([given, _all(data)[:, None], *_samples(data, order)], dim=1)
    moving, static = squares(candidates, data)
    noise = _scales(moving, data, floor) if sigma is None else sigma[:, None].expand(candidates.shape[:2]).clamp(min=floor)
    score = noise if sigma is None else _score(moving, static, held, data, noise)
    best = score.topk(min(FINALISTS, score.shape[1]), dim=1, largest=False).indices
    # the given starts run as well: they rest on all matches, which no small sample does
    chosen = torch.cat([torch.arange(given.shape[1] + 1, device=best.device).expand(len(best), -1), best], dim=1)
    motions = candidates.gather(1, chosen[..., None, None, None].expand(-1, -1, 2, 4, 4))
    noise = noise.gather(1, chosen)
    noise = noise if sigma is not None else noise.amin(1, keepdim=True).expand_as(noise)
    for stretch in (8.0, 3.0, 1.0):
        motions, _ = descend(motions, data, scale=noise * stretch * three_sigma(data.conditions) ** 0.5, iterations=12)
        noise = noise if sigma is not None else _scales(squares(motions, data)[0], data, floor)
    # one noise for all, or the worse motion would be forgiven more
    noise = noise if sigma is not None else noise.amin(1, keepdim=True).expand_as(noise)
    winner = _score(*squares(motions, data), held, data, noise).argmin(1)
    first = torch.arange(len(winner), device=winner.device)
    flat = Sightings(data.x1[:, 0], data.x2[:, 0], data.x3[:, 0], data.weights[:, 0], data.motion)
    grounded = held.any(-1) if data.motion == "constant_velocity" else torch.ones_like(held[:, 0])
    found = _settle(motions[first, winner], flat, noise[first, winner], sigma is None, held, grounded, floor)
    if data.motion == "straight":
        return found
    common, members, present = *common_velocity(found, flat), (flat.weights > 0).sum(-1)
    standing = ~grounded & (members >= 3) & (members >= STANDING * present)
    found = replace(found, motions=drifted(found.motions, torch.where(grounded[:, None], 0.0, common)))
    if not bool(standing.any()):
        return found
    return _settle(found.motions, flat, found.sigma, sigma is None, held, grounded | standing, floor)


def _all(data: Sightings) -> Tensor:
    """The motions that carry all matches onto each other, as if none moved, ``(b, 2, 4, 4)``."""
    x1, w = data.x1[:, 0], data.weights[:, 0]
    return torch.stack([rigid_alignment(x1, data.x2[:, 0], w), rigid_alignment(x1, data.x3[:, 0], w)], dim=1)


def _samples(data: Sightings, order: Tensor) -> tuple[Tensor, Tensor]:
    """Motions from samples of 3 static matches, and of a few moving ones."""
    found = []
    for index, still in ((order[:, :STATIC_STARTS, :3], True), (order[:, STATIC_STARTS:], False)):
        sample = data.sample(index)
        start = torch.stack([rigid_alignment(sample.x1, x, sample.weights) for x in (sample.x2, sample.x3)], dim=2)
        found.append(start if still else descend(start, sample, iterations=12)[0])
    return found[0], found[1]


def _scales(moving: Tensor, data: Sightings, floor: float) -> Tensor:
    """Noise ``(b, k)`` from the median of squared residuals, less the parameters that these have absorbed."""
    present = data.weights > 0
    count = present.sum(-1)
    spare = (1 - 12 / (data.conditions * count).clamp(min=13)).clamp(min=0.1)
    ranked = torch.where(present, moving, torch.inf).sort(-1).values
    middle = ranked.gather(-1, ((count - 1) // 2).clamp(min=0).expand(ranked.shape[:-1])[..., None])[..., 0]
    middle = torch.where(middle.isfinite(), middle, 0.0)
    return (middle / (median(data.conditions) * spare)).sqrt().clamp(min=floor)


def _score(moving: Tensor, static: Tensor, held: Tensor, data: Sightings, sigma: Tensor) -> Tensor:
    """Description length ``(b, k)``: every match is static, moving or an outlier, whichever is cheapest."""
    square = sigma.square()[..., None]
    free = 6 - data.conditions
    cost = (moving / square + BITS * free).clamp(max=BITS * 6)
    # the common velocity is still open in the other model, so that nothing stands still yet
    resting = static / square if data.motion == "straight" else torch.full_like(cost, torch.inf)
    cost = torch.where(held[:, None], (static / square).clamp(max=BITS * 6), torch.minimum(cost, resting))
    return (cost * (data.weights > 0)).sum(-1)


def _settle(motions: Tensor, data: Sightings, sigma: Tensor, estimate: bool, held: Tensor, grounded: Tensor, floor: float) -> Rigid:
    """Least squares over the matches that belong to the model, static ones as such, until they do not change."""
    present = data.weights > 0
    for _ in range(ROUNDS):
        moving, static = squares(motions, data)
        square = sigma.square()[:, None]
        resting = static <= three_sigma(6) * square
        still = resting & (held | grounded[:, None]) & present
        inliers = (still | (~held & (moving <= three_sigma(data.conditions) * square))) & present
        subset = replace(data, weights=data.weights * inliers)
        motions, _ = descend(motions, subset, still=still, iterations=15)
        if estimate:
            sigma = _noise(motions, subset, inliers, still, grounded, sigma).clamp(min=floor)
    _, information = normal_equations(motions, subset, subset.weights, still)
    return Rigid(motions, sigma, information, inliers, still, grounded)


def _noise(motions: Tensor, data: Sightings, inliers: Tensor, still: Tensor, grounded: Tensor, before: Tensor) -> Tensor:
    """Noise of one coordinate from the residuals of the inliers; as before where too few are left."""
    moving, static = squares(motions, data)
    total = torch.where(inliers, torch.where(still, static, moving), 0.0).sum(-1)
    conditions = torch.where(still, 6, data.conditions) * inliers
    spare = conditions.sum(-1) - torch.where(grounded, 12, 9)
    return torch.where(spare >= 4, (total / spare.clamp(min=1)).sqrt(), before)


def drifted(motions: Tensor, velocity: Tensor) -> Tensor:
    """Motions ``(b, 2, 4, 4)`` in the gauge in which points of this velocity ``(b, 3)`` stand still."""
    steps = torch.tensor([1.0, 2.0], dtype=motions.dtype, device=motions.device)
    shift = torch.zeros_like(motions)
    shift[..., :3, 3] = steps[:, None] * velocity[:, None]
    return motions - shift


def common_velocity(found: Rigid, data: Sightings) -> tuple[Tensor, Tensor]:
    """The velocity ``(b, 3)`` that most matches share, in the frame of view 1 and per step, and how many do, ``(b,)``.

    Where fewer than 3 share one it is the mean velocity of the inliers.
    """
    u, v, _, _ = combinations(found.motions, data)
    velocity = -u / 2**0.5
    step = max(1, velocity.shape[-2] // SEEDS)
    # of a static point |u|^2 + |v|^2 is within the limit, with u counted from the common velocity
    room = (three_sigma(6) * found.sigma.square()[:, None] - v.square().sum(-1)).clamp(min=0.0) / 2
    near = (torch.cdist(velocity[:, ::step], velocity).square() <= 2 * room[:, None]) & found.inliers[:, None]
    best = (near.sum(-1) * found.inliers[:, ::step]).argmax(-1)
    members = near[torch.arange(len(best), device=best.device), best]
    mean = _mean(velocity, members)
    members = ((velocity - mean[:, None]).square().sum(-1) <= room) & found.inliers
    count = members.sum(-1)
    enough = (count >= 3) & (count >= STANDING * found.inliers.sum(-1))
    return _mean(velocity, torch.where(enough[:, None], members, found.inliers)), count


def _mean(x: Tensor, members: Tensor) -> Tensor:
    return torch.where(members[..., None], x, 0.0).sum(-2) / members.sum(-1, keepdim=True).clamp(min=1)
