"""What a segmentation of tracks costs: distances from the epipolar geometry of many pairs of frames, links cut, and relief."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import log1p

import torch
from torch import Tensor

from dyntorch.geometry.epipolar import sampson_squared
from dyntorch.geometry.epipolar_fit import descend, fit_fundamental
from dyntorch.tasks.segment.coherence import Links
from dyntorch.tasks.segment.energy import mean_field, relief
from dyntorch.tasks.segment.search import one_hot
from dyntorch.tasks.segment_tracks.frames import FramePair
from dyntorch.tasks.segment_tracks.options import TrackDescentOptions, TrackSegmentOptions

Geometry = list[Tensor]
"""Fundamental matrices ``(B, K, 3, 3)`` for every pair of frames."""


@dataclass(frozen=True)
class TrackEvidence:
    """Tracks in many pairs of frames."""

    pairs: Sequence[FramePair]  # of frames
    links: Links  # between tracks that move alike
    count: Tensor  # ``(n,)`` pairs that each track is in

    @staticmethod
    def of(pairs: Sequence[FramePair], links: Links) -> TrackEvidence:
        """With the number of pairs of each track."""
        count = torch.zeros(len(links.index), dtype=torch.float64, device=links.index.device)
        for pair in pairs:
            count[pair.index] += 1
        return TrackEvidence(pairs, links, count)

    def share(self, options: TrackDescentOptions) -> Tensor:
        """``(n,)`` weight of what one pair says of a track: together they count as ``options.evidence`` pairs."""
        return options.evidence / self.count.clamp(min=1)


@dataclass(frozen=True)
class Candidates:
    """Segmentations into the same number of bodies."""

    labels: Tensor  # ``(B, n)`` from 0
    member: Tensor  # ``(B, K, n)`` probabilities
    geometry: Geometry  # of the bodies
    scale: Tensor  # ``(B,)`` standard deviation of a coordinate of a track at rest, pixels
    energy: Tensor  # ``(B,)``, infinite where a body has too few tracks

    @property
    def bodies(self) -> int:
        """How many bodies."""
        return self.geometry[0].shape[1]

    def of(self, which: int) -> Candidates:
        """One of them."""
        part = slice(which, which + 1)
        geometry = [F[part] for F in self.geometry]
        return Candidates(self.labels[part], self.member[part], geometry, self.scale[part], self.energy[part])


def unlinked(count: int, device: torch.device) -> Links:
    """No links between so many tracks."""
    return Links(torch.zeros(count, 0, dtype=torch.long, device=device), torch.zeros(count, 0, dtype=torch.float64, device=device))


def fitted(pairs: Sequence[FramePair], groups: Tensor, scales: Sequence[float], steps: int = 2) -> Geometry:
    """Fundamental matrices ``(B, 3, 3)`` of groups of tracks ``(B, n)``, weights, for every pair of frames."""
    return [
        fit_fundamental(
            pair.view.x1, pair.view.x2, pair.weighed(groups), [scale * pair.view.pixel for scale in scales], steps=steps
        )[0]
        for pair in pairs
    ]


def squares(pair: FramePair, fundamentals: Tensor) -> Tensor:
    """Squared Sampson distances ``(*batch, m)`` in pixels, as of tracks at rest."""
    return sampson_squared(fundamentals, pair.view.x1, pair.view.x2) * (pair.precision / pair.view.pixel**2)


def improbable(square: Tensor, options: TrackDescentOptions) -> Tensor:
    r"""Cost of squared distances over the variance, :math:`(\nu + 1) \log(1 + \min(z, c^2) / \nu)`."""
    worst = (options.freedom + 1) * log1p(options.cutoff**2 / options.freedom)
    return ((options.freedom + 1) * torch.log1p(square / options.freedom)).clamp(max=worst)


def noise(pairs: Sequence[FramePair], geometry: Geometry, member: Tensor, options: TrackDescentOptions) -> Tensor:
    """Standard deviations ``(B,)`` of a coordinate of a track at rest, for members ``(B, K, n)``: most likely for Student's
    distribution of all distances from the own body."""
    own, weight = [], []
    for pair, F in zip(pairs, geometry, strict=True):
        part = member[..., pair.index].double()
        own.append((squares(pair, F) * part).sum(-2))
        weight.append(part.sum(-2))
    square, present = torch.cat(own, dim=-1), torch.cat(weight, dim=-1)
    low, high = options.least_scale**2, options.most_scale**2
    variance = (2 * square.median(-1).values).clamp(low, high)
    total = present.sum(-1).clamp(min=1.0)
    for _ in range(4):
        heavy = (options.freedom + 1) / (options.freedom + square / variance[:, None])
        variance = ((heavy * square * present).sum(-1) / total).clamp(low, high)
    return variance.sqrt()


def costs(
    evidence: TrackEvidence, geometry: Geometry, scale: Tensor, member: Tensor | None, options: TrackSegmentOptions
) -> Tensor:
    """Cost ``(B, K, n)`` of every track in every body without links; with the relief of bodies of members ``(B, K, n)``."""
    how = options.descent
    B, K = geometry[0].shape[:2]
    total = torch.zeros(B, K, len(evidence.count), dtype=torch.float64, device=scale.device)
    for pair, F in zip(evidence.pairs, geometry, strict=True):
        cost = improbable(squares(pair, F) / scale.square()[:, None, None], how)
        if member is not None and how.relief > 0:
            cost = cost + how.relief * relief(pair.view, F, member[..., pair.index].double(), options.views)
        total[..., pair.index] += cost
    return total * evidence.share(how)


def descended(evidence: TrackEvidence, labels: Tensor, bodies: int, options: TrackSegmentOptions) -> Candidates:
    """Labels and epipolar geometries in turns, from several labellings ``(B, n)`` from 0."""
    how = options.descent
    count = len(labels)
    member = one_hot(labels, bodies).float()
    found = fitted(evidence.pairs, member.flatten(0, 1), how.first_fit_scales)
    geometry = [F.unflatten(0, (count, bodies)) for F in found]

    def turn(member: Tensor, geometry: Geometry) -> tuple[Tensor, Tensor]:
        scale = noise(evidence.pairs, geometry, member, how)
        cost = costs(evidence, geometry, scale, member, options).float()
        # links are scaled so that cutting one costs its weight
        return mean_field(cost, evidence.links, 1.0, how.turns, member), scale

    for _ in range(how.rounds):
        member, scale = turn(member, geometry)
        size = float(how.fit_scale * scale.median())
        geometry = [_refitted(pair, F, member, size, how) for pair, F in zip(evidence.pairs, geometry, strict=True)]
    member, scale = turn(member, geometry)
    found_labels = member.argmax(1)
    return Candidates(found_labels, member, geometry, scale, energy(evidence, geometry, found_labels, scale, options))


def _refitted(pair: FramePair, F: Tensor, member: Tensor, scale: float, options: TrackDescentOptions) -> Tensor:
    # the noise grows with the motion, and with it the scale
    size = max(scale * float(pair.precision.median()) ** -0.5, options.least_fit_scale) * pair.view.pixel
    weight = pair.weighed(member.flatten(0, 1))
    return descend(F.flatten(0, 1), pair.view.x1, pair.view.x2, weight, size, steps=2).unflatten(0, F.shape[:2])


def energy(evidence: TrackEvidence, geometry: Geometry, labels: Tensor, scale: Tensor, options: TrackSegmentOptions) -> Tensor:
    r"""Cost ``(B,)`` of labellings ``(B, n)`` from 0:"""
    member = one_hot(labels, geometry[0].shape[1])
    own = (costs(evidence, geometry, scale, member, options) * member).sum((-2, -1))
    seen = float((evidence.count > 0).sum())
    total = own + 2 * options.descent.evidence * seen * scale.log() + evidence.links.cut(member)
    return torch.where(member.sum(-1).amin(-1) >= options.descent.members, total, torch.inf)
