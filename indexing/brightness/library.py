"""What the brightness indexer keeps of the exemplars, and how it is laid out for matching."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import normalize

from indexing.brightness.pooling import mirrored
from indexing.brightness.profile import inverse_root
from indexing.brightness.sight import Seen

GAP = 2  # empty rows before each track: no step leads from one track into the next
KEPT = 96
"""Principal directions in which frames are compared: all of 560 cost 4.3 ms per frame and 20,000 rows, these .2 ms.
Frames named rightly (shares .3 .1 .5 .1), exercises at 0 / 60, arm raises: 560: .822 .744 .962, 128: .821 .746 .962,
64: .821 .745 .960, 32: .821 .745 .950."""
RIDGE = 0.02  # of the whitening of window kernels (theory)


@dataclass(frozen=True)
class Exemplars:
    """Learned videos, one after the other.

    Attributes:
        motion: ``(M, 560)`` descriptors.
        kernels: ``(M, 121)`` window kernels, or ``(M, 0)``.
        lengths: ``(videos,)`` frames.
        labels: ``(videos,)`` numbers of classes.
    """

    motion: Tensor
    kernels: Tensor
    lengths: Tensor
    labels: Tensor

    @classmethod
    def of(cls, seen: list[Seen], labels: Tensor) -> Exemplars:
        """Of the descriptors of each video."""
        lengths = torch.tensor([len(one) for one in seen])
        return cls(torch.cat([one.motion for one in seen]), torch.cat([one.kernels for one in seen]), lengths, labels)

    def extended(self, others: Exemplars, labels: Tensor) -> Exemplars:
        """With further videos; ``labels`` are those of all."""
        motion, kernels, lengths = (torch.cat([getattr(self, n), getattr(others, n)]) for n in ("motion", "kernels", "lengths"))
        return Exemplars(motion, kernels, lengths, labels)

    def videos(self) -> list[Seen]:
        """Descriptors of each video."""
        parts = (rows.split(self.lengths.tolist()) for rows in (self.motion, self.kernels))
        return [Seen(*pair) for pair in zip(*parts, strict=True)]

    def to(self, device: str) -> Exemplars:
        """The same on another device."""
        return replace(self, motion=self.motion.to(device), kernels=self.kernels.to(device))


@dataclass(frozen=True)
class Library:
    """Exemplar frames, track after track, tracks of one class together; GAP rows of zeros before each track.

    Attributes:
        rows: ``(M, K)`` coordinates of rows of at most unit length.
        gaps: ``(2 tracks,)`` rows of zeros.
        bounds: ``(classes + 1,)`` where each class begins.
        basis: ``(D, K)`` directions in which the exemplars differ most, orthonormal.
    """

    rows: Tensor
    gaps: Tensor
    bounds: tuple[int, ...]
    basis: Tensor


@dataclass(frozen=True)
class Matcher:
    """Turns descriptors into rows whose inner products are likenesses.

    .. math:: <r, r'> = (1 - w) <f, f'> + w\\,|f|\\,|f'|\\,<k, k'>

    with descriptors f and whitened window kernels k of norm 1.

    Attributes:
        weight: w, share of the window kernels.
        mean, root: ``(121,)`` and ``(11, 11)`` of the exemplars' kernels, by which kernels are centred and whitened.
    """

    weight: float
    mean: Tensor
    root: Tensor

    @classmethod
    def of(cls, exemplars: Exemplars, weight: float) -> Matcher:
        """Learned from exemplars; frames where nothing moves do not count."""
        side = math.isqrt(exemplars.kernels.shape[1])
        kernels = exemplars.kernels.double().unflatten(1, (side, side)) if side else torch.zeros(0, 0, 0)
        moving = kernels.diagonal(dim1=1, dim2=2).sum(1) > 0
        if weight == 0 or not bool(moving.any()):
            return cls(0.0, torch.zeros(0), torch.zeros(0, 0))
        root = inverse_root(kernels[moving].mean(0), RIDGE)
        return cls(weight, (root @ kernels[moving] @ root).mean(0).flatten().float(), root.float())

    def rows(self, seen: Seen) -> Tensor:
        """``(n, D)`` rows of n frames."""
        if self.weight == 0:
            return seen.motion
        root, mean = self.root.to(seen.kernels), self.mean.to(seen.kernels)
        white = (root @ seen.kernels.unflatten(1, root.shape) @ root).flatten(1) - mean
        still = seen.kernels.abs().amax(1, keepdim=True) == 0
        kernel = normalize(white, dim=1).masked_fill(still, 0.0) * seen.motion.norm(dim=1, keepdim=True)
        return torch.cat([math.sqrt(1 - self.weight) * seen.motion, math.sqrt(self.weight) * kernel], dim=1)


def library(exemplars: Exemplars, matcher: Matcher, classes: int, flip: bool) -> Library:
    """Lay out the tracks of all exemplars, mirrored ones too where ``flip``."""
    videos, labels = exemplars.videos(), exemplars.labels.tolist()
    rows, gaps, bounds, at = [], [], [0] * (classes + 1), 0
    for i in sorted(range(len(videos)), key=labels.__getitem__):
        copies = [videos[i], replace(videos[i], motion=mirrored(videos[i].motion))] if flip else [videos[i]]
        for copy in copies:
            track = matcher.rows(copy)
            rows += [track.new_zeros(GAP, track.shape[1]), track]
            gaps += [at, at + 1]
            at += GAP + len(track)
        bounds[labels[i] + 1] = at
    every = torch.cat(rows)
    basis = principal(every)
    return Library(every @ basis, torch.tensor(gaps), tuple(bounds), basis)


def principal(rows: Tensor, count: int = KEPT) -> Tensor:
    """``(D, count)`` orthonormal directions that hold most of the energy of ``rows (M, D)``; all where there are no more."""
    if rows.shape[1] <= count:
        return torch.eye(rows.shape[1]).to(rows)
    exact = rows.double()
    return torch.linalg.eigh(exact.mT @ exact).eigenvectors[:, -count:].to(rows)
