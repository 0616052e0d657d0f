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
    """Labels of all matches.

    Attributes:
        probabilities: ``(K + 1, n)``, the first of an outlier.
        fundamentals: ``(K, 3, 3)``.
    """

    probabilities: Tensor
    fundamentals: Tensor

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
    r"""Labels and geometries in turns: a mean field of the costs

    .. math:: \min(r_{ik}^2 / T^2, 9) + s\,(1 - c_{ik} / c_0)_+ - b\,[i \text{ found in } k],
        \qquad \text{outlier: } 1 + \tfrac14 \log \tfrac{1 - \pi}{4 \pi},

    with the conformity :math:`c_{ik}` of match i to body k and the share :math:`\pi` of outliers
    (at most a fifth), and of labels that differ from those of the neighbours.

    Args:
        view: all matches.
        found: ``(n,)`` bodies 1..K of the search, 0 elsewhere.
        fundamentals: ``(K, 3, 3)`` of the search.
        weights: ``(n,)`` of the matches in the fits.
        threshold: T, in the coordinates of ``view``.
        scale: as of :func:`~dyntorch.tasks.segment.coherence.coherence`; None: neighbours do not matter.
        share: of outliers, roughly.
    """
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
    """Models of K bodies.

    Attributes:
        homographies: ``(K, 3, 3)`` of norm 1, best fits, whatever the choice.
        planar: ``(K,)`` bool, the homography explains the body.
    """

    homographies: Tensor
    planar: Tensor


def choose(view: View, fundamentals: Tensor, members: Tensor, options: SegmentOptions) -> Models:
    r"""The model with the smaller robust information criterion,

    .. math:: \sum_i \min\!\Big(\frac{e_i^2}{\sigma^2},\ 2 (4 - d)\Big) + n\,d \log 4 + k \log 4n,

    with dimension d = 3 and k = 7 parameters of a fundamental matrix, d = 2 and k = 8 of a homography.  The noise
    :math:`\sigma` is that of all bodies.  The sum bears a few matches off the plane; but a body is no plane if more than
    ``options.models.off_plane_share`` of it are farther than ``options.models.off_plane`` thresholds.

    Args:
        view: matches.
        fundamentals: ``(K, 3, 3)``.
        members: ``(K, n)`` weights, of any scale.

    Source: Torr, Geometric motion segmentation and model selection, 1998.
    """
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
    """Variance ``()`` of a coordinate by the distances ``(K, n)`` from the epipolar lines of all bodies.

    The homographies would overestimate it where there is depth.  The median alone is too uncertain (a plane of 100 matches was
    recognized in 7 of 10 cases): it starts a truncated mean.
    """
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
    r"""Which bodies are no accident, ``(K,)`` bool: their expected number in random matches,

    .. math:: (n - 7) \binom{n}{k} \binom{k}{7}\, p^{\,k - 7}, \qquad p = 2 T D / A,

    is below ``options.models.false_alarms``, for k of n matches within T of their epipolar lines in an image of area A and
    diagonal D.  What other bodies explain is left out.

    Args:
        view: matches, outliers among them.
        fundamentals: ``(K, 3, 3)``.
        labels: ``(n,)``, 0 outlier, 1..K.

    Source: Moisan and Stival, A probabilistic criterion to detect rigid point matches, IJCV 2004.
    """
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
