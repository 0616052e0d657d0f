"""How many bodies there are, and which of the segmentations into them is the best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import log1p

import torch
from torch import Tensor

from dyntorch.tasks.segment.search import one_hot
from dyntorch.tasks.segment_tracks.descent import Candidates, TrackEvidence, descended, energy
from dyntorch.tasks.segment_tracks.exchange import Exchanges
from dyntorch.tasks.segment_tracks.merging import Judge, merged, weakest_separation
from dyntorch.tasks.segment_tracks.options import TrackSegmentOptions


@dataclass(frozen=True)
class Start:
    """What the search for bodies starts from."""

    evidence: TrackEvidence  # links and pairs of frames
    judge: Judge  # of groups of tracks
    cuts: Sequence[Tensor]  # labels ``(n,)`` of the pieces, once for each number of pieces

    @cached_property
    def trees(self) -> list[dict[int, Tensor]]:
        """Labels ``(n,)`` with any number of bodies, for each of the cuts."""
        most = max(int(cut.max()) + 1 for cut in self.cuts)
        return [merged(self.judge, cut, range(1, most + 1)) for cut in self.cuts]

    def best(self, bodies: int, options: TrackSegmentOptions, thorough: bool = False) -> Candidates | None:
        """The best segmentation into so many bodies: separate, and of little cost; None where there is none."""
        starts = [tree[bodies] for tree in self.trees if bodies in tree]
        if not starts:
            return None
        if thorough and bodies > 1:
            for cut, tree in zip(self.cuts, self.trees, strict=True):
                if bodies in tree:
                    exchanges = Exchanges(self.evidence, cut, options)
                    starts += [exchanges.improved(tree[bodies], weight) for weight in options.exchange.weights]
        distinct = [x for place, x in enumerate(starts) if not any(torch.equal(x, other) for other in starts[:place])]
        found = descended(self.evidence, torch.stack(distinct), bodies, options)
        values = [self._value(found.of(which), options, thorough) for which in range(len(distinct))]
        best = max(range(len(values)), key=values.__getitem__)
        return found.of(best) if values[best] > float("-inf") else None

    def _value(self, one: Candidates, options: TrackSegmentOptions, thorough: bool) -> float:
        """How good a segmentation is beside others into as many bodies."""
        if not bool(one.energy.isfinite()):
            return float("-inf")
        apart = weakest_separation(self.judge, one, options.choice.links) if one.bodies > 1 else 0.0
        count = len(self.evidence.count)
        if not thorough:
            return apart - options.choice.energy * float(one.energy) / count
        plain = replace(options, descent=replace(options.descent, relief=options.exchange.relief))
        cost = energy(self.evidence, one.geometry, one.labels, one.scale, plain)
        cut = self.evidence.links.cut(one_hot(one.labels, one.bodies).double())
        return options.exchange.apart * apart - float(cost + (options.exchange.links - 1) * cut) / count


@dataclass(frozen=True)
class Chosen:
    """The segmentation that was chosen, and whether one body less would do."""

    candidate: Candidates
    spare: bool = False


def bodies_of(start: Start, bodies: int | None, options: TrackSegmentOptions) -> Chosen | None:
    """The best segmentation into ``bodies``, or fewer where there are no so many; for None into as many as there are."""
    if bodies is not None:
        for number in range(bodies, 0, -1):
            found = start.best(number, options, thorough=len(start.evidence.pairs) >= options.exchange.pairs)
            if found is not None:
                fewer = start.best(number - 1, options) if number > 1 else None
                return Chosen(found, fewer is not None and evidence_of_another(start, fewer, found, options) < 0)
        return None
    chosen = start.best(1, options)
    if chosen is None:
        return None
    for number in range(2, options.merge.bodies + 1):
        more = start.best(number, options)
        if more is None or evidence_of_another(start, chosen, more, options) < 0:
            break
        chosen = more
    return Chosen(chosen)


def evidence_of_another(start: Start, fewer: Candidates, more: Candidates, options: TrackSegmentOptions) -> float:
    r"""Logarithm of the odds that there is one body more,"""
    how = options.choice
    member = one_hot(more.labels[0], more.bodies) > 0
    before = one_hot(fewer.labels[0], fewer.bodies) > 0
    apart = start.judge.separation(member)
    # the two bodies whose union is most like a body of the other segmentation
    union = (member[apart.first] | member[apart.second]).double()
    shared = union @ before.double().mT
    likeness = shared / (union.sum(-1, keepdim=True) + before.double().sum(-1) - shared)
    split = int(likeness.amax(-1).argmax())
    ratio, links = apart.ratio(options.merge)[split], apart.links[split] + options.merge.unlinked
    saved = float(fewer.energy - more.energy) / len(start.evidence.count) ** 0.5
    return float(how.base + how.ratio * ratio - how.unlinked * links.log() + how.saved * log1p(max(saved, 0.0)))
