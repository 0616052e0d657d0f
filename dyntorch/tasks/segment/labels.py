"""Labels of all matches, outliers among them, given the bodies found among the coherent ones."""

from __future__ import annotations

from dataclasses import dataclass
from math import lgamma, log

import torch
from torch import Tensor

from dyntorch.geometry.epipolar import sampson_squared
from dyntorch.geometry.epipolar_fit import descend
from dyntorch.geometry.homography import homography, homography_sampson_squared
from dyntorch.numerics.chi_square import median
from dyntorch.tasks.segment.coherence import Links, conformity
from dyntorch.tasks.segment.energy import View, mean_field
from dyntorch.tasks.segment.options import SegmentOptions


@dataclass(frozen=True)
class Labelling:
    """Labels of all matches."""

    probabilities: Tensor  # ``(K + 1, n)``, the first of an outlier
    fundamentals: Tensor  # ``(K, 3, 3)``

    @property
    def labels(self) -> Tensor:
        """``(n,)``, 0 outlier."""
        return self.probabilities.argmax(0)

    def of(self, bodies: Tensor) -> Labelling:
        """With these bodies alone (indices or bool): what belonged to others belongs to none."""
        kept = self.probabilities[1:][bodies]
        return Labelling(torch.cat([1 - kept.sum(0, keepdim=True), kept]).clamp(min=0), self.fundamentals[bodies])


def label(
    view: View,
    found: Tensor,
    fundamentals: Tensor,
    weights: Tensor,
    threshold: float,
    scale: float | None,
    share: float,
    options: SegmentOptions,
) -> Labelling:
    r"""Labels and geometries in turns: a mean field of the costs found ``(n,)``, fundamentals ``(K, 3, 3)``, weights ``(n,)``."""
    numbers = torch.arange(1, len(fundamentals) + 1, device=found.device)[:, None]
    members = found == numbers
    gain = options.labels.found * members.to(weights.dtype) if scale is not None else 0.0
    strange = _strange(view, members, scale, options)
    links = _normalized(view.links)
    odds = [
        (1 - p) / p
        for p in (min(max(share, options.labels.few_outliers), options.labels.many_outliers), options.labels.many_outliers)
    ]
    outlier = options.labels.outlier + log(odds[0] / odds[1]) / options.labels.sharpness

    def probabilities(bodies: Tensor) -> Tensor:
        square = sampson_squared(bodies, view.x1, view.x2) / threshold**2
        return field(square.clamp(max=options.labels.cap) + strange - gain, outlier, links, options)

    bodies = fundamentals
    member = probabilities(bodies)
    for turn in range(options.labels.rounds):
        members = member.argmax(0) == numbers
        # a descent never raises its own truncated cost, so geometries cannot drift away from their members
        bodies = descend(bodies, view.x1, view.x2, members * weights, options.labels.fit_scale * threshold)
        strange = _strange(view, members, scale, options) if turn == 0 else strange
        member = probabilities(bodies)
    return Labelling(member, bodies)


def field(cost: Tensor, outlier: float, links: Links, options: SegmentOptions) -> Tensor:
    """Mean field ``(K + 1, n)`` of the costs ``(K, n)`` of bodies, the first of an outlier."""
    every = torch.cat([torch.full_like(cost[:1], outlier), cost])
    return mean_field(options.labels.sharpness * every, links, options.labels.sharpness, options.labels.turns)


def _strange(view: View, members: Tensor, scale: float | None, options: SegmentOptions) -> Tensor:
    """Cost ``(K, n)`` of moving unlike the neighbours."""
    if scale is None:
        return torch.zeros_like(members, dtype=view.x1.dtype)
    value = conformity(view.x1, view.x2, members, scale, options)
    # members of deep bodies move less like each other
    usual = torch.where(members, value, torch.nan).nanmedian(-1, keepdim=True).values.nan_to_num(nan=1.0)
    return options.labels.strange * (
        1 - value / (options.labels.conforming * usual).clamp(min=options.labels.least_conforming)
    ).clamp(min=0)


def _normalized(links: Links) -> Links:
    """Links whose sum is 1 for every match."""
    return Links(links.index, links.weight / links.weight.sum(-1, keepdim=True).clamp(min=1e-9))


# ----------------------------------------------------------------------------------------------------------------------
# Whether two views show a body as one with depth, or as a plane: a fundamental matrix or a homography.


TINY = 1e-30


@dataclass(frozen=True)
class Models:
    """Models of K bodies."""

    homographies: Tensor  # ``(K, 3, 3)`` of norm 1, best fits, whatever the choice
    planar: Tensor  # ``(K,)`` bool, the homography explains the body


def choose(view: View, fundamentals: Tensor, members: Tensor, options: SegmentOptions) -> Models:
    r"""The model with the smaller robust information criterion,"""
    # weights are relative: they count as so many equal ones
    members = members * (members.sum(-1) / members.square().sum(-1).clamp(min=TINY))[:, None]
    epipolar = sampson_squared(fundamentals, view.x1, view.x2)
    noise = _noise(epipolar, members, options).clamp(min=(options.models.least_noise * view.pixel) ** 2)
    plane = homography(view.x1, view.x2, members, scale=3 * view.pixel, steps=8)[0]
    planar = homography_sampson_squared(plane, view.x1, view.x2)
    first = _criterion(epipolar / noise, members, 3, 7)
    second = _criterion(planar / noise, members, 2, 8)
    off = ((planar > (options.models.off_plane * options.units.threshold_in_pixels * view.pixel) ** 2) * members).sum(
        -1
    ) / members.sum(-1).clamp(min=TINY)
    return Models(plane, (second < first) & (off <= options.models.off_plane_share))


def _noise(square: Tensor, members: Tensor, options: SegmentOptions) -> Tensor:
    """Variance ``()`` of a coordinate by the distances ``(K, n)`` from the epipolar lines of all bodies."""
    every, weight = square.flatten(), members.flatten()
    order = every.argsort()
    share = weight[order].cumsum(0)
    total = share[-1].clamp(min=TINY)
    variance = every[order[(share >= 0.5 * total).to(torch.int8).argmax()]] / median(1)
    for _ in range(options.models.noise_rounds):
        variance = (every.minimum(options.models.truncated * variance) * weight).sum() / (options.models.kept * total)
    count = members.sum(-1)
    # the best F of a plane is the luckiest of a family: measured with 15 to 100 matches, its squares lack sqrt(2n) beyond 7
    freedom = (count - 7 - (2 * count).sqrt()).clamp(min=0).sum().clamp(min=1)
    return variance * total / freedom


def _criterion(square: Tensor, members: Tensor, dimension: int, parameters: int) -> Tensor:
    count = members.sum(-1)
    fit = (square.clamp(max=2.0 * (4 - dimension)) * members).sum(-1)
    return fit + dimension * count * log(4) + parameters * (4 * count).clamp(min=1.0).log()


# ----------------------------------------------------------------------------------------------------------------------
# Whether so many matches would agree with an epipolar geometry by chance.


SAMPLE = 7
"""Matches that determine a fundamental matrix."""


def significant(view: View, fundamentals: Tensor, labels: Tensor, options: SegmentOptions) -> Tensor:
    r"""Which bodies are no accident, ``(K,)`` bool: their expected number in random matches,"""
    threshold = options.units.threshold_in_pixels * view.pixel
    near = sampson_squared(fundamentals, view.x1, view.x2) <= threshold**2
    chance = max(_chance(x, threshold) for x in (view.x1, view.x2))
    found = []
    for number, close in enumerate(near, start=1):
        own = labels == number
        count, among = int((own & close).sum()), int((own | (labels == 0)).sum())
        found.append(count > SAMPLE and _alarms(among, count, chance) < log(options.models.false_alarms))
    return torch.tensor(found, dtype=torch.bool, device=labels.device)


def _chance(x: Tensor, threshold: float) -> float:
    """Probability p that a random match is near the line of another point, in the box that holds nearly all ``(n, 2)``."""
    low, high = torch.quantile(x, x.new_tensor([0.02, 0.98]), dim=0)
    width, height = (high - low).clamp(min=threshold).tolist()
    return float(min(1.0, 2 * threshold * (width**2 + height**2) ** 0.5 / (width * height)))


def _alarms(n: int, k: int, chance: float) -> float:
    """Logarithm of the expected number of bodies of k among n random matches."""
    return log(max(1, n - SAMPLE)) + _choose(n, k) + _choose(k, SAMPLE) + (k - SAMPLE) * log(chance)


def _choose(n: int, k: int) -> float:
    """Logarithm of the binomial coefficient."""
    return lgamma(n + 1) - lgamma(k + 1) - lgamma(n - k + 1)
