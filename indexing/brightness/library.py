"""What the brightness indexer keeps of the exemplars, and how it is laid out for matching."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from indexing.brightness.sight import mirror_rows
from indexing.modelfile import store

FRAMES = 2**31  # of a video, at most
LONGEST = 1.001  # of the entries of a unit vector, with rounding
GAP = 2  # empty rows before each track: no step leads from one track into the next


@dataclass(frozen=True)
class VideoExemplars:
    """Learned videos, one after the other."""

    motion: Tensor = field(metadata=store("real", "frames", "descriptor", least=-LONGEST, most=LONGEST))
    lengths: Tensor = field(metadata=store("whole", "videos", below=FRAMES))  # ``(videos,)`` frames
    labels: Tensor = field(metadata=store("every", "videos", below="classes"))  # ``(videos,)`` numbers of classes

    @classmethod
    def of(cls, videos: list[Tensor], labels: Tensor) -> VideoExemplars:
        """Of the descriptors of each video."""
        return cls(torch.cat(videos), torch.tensor([len(one) for one in videos]), labels)

    def extended(self, others: VideoExemplars, labels: Tensor) -> VideoExemplars:
        """With further videos; ``labels`` are those of all."""
        return VideoExemplars(torch.cat([self.motion, others.motion]), torch.cat([self.lengths, others.lengths]), labels)

    def videos(self) -> list[Tensor]:
        """Descriptors of each video."""
        return list(self.motion.split(self.lengths.tolist()))

    def to(self, device: str) -> VideoExemplars:
        """The same on another device."""
        return replace(self, motion=self.motion.to(device))


@dataclass(frozen=True)
class Library:
    """Exemplar frames, track after track, tracks of one class together; GAP rows of zeros before each track."""

    rows: Tensor  # ``(M, K)`` coordinates of rows of at most unit length
    gaps: Tensor  # ``(2 tracks,)`` rows of zeros
    bounds: tuple[int, ...]  # ``(classes + 1,)`` where each class begins
    basis: Tensor  # ``(D, K)`` directions in which the exemplars differ most, orthonormal


def library(exemplars: VideoExemplars, classes: int, flip: bool, num_directions: int = 96) -> Library:
    """Lay out the tracks of all exemplars, mirrored ones too where ``flip``, in so many directions."""
    videos, labels = exemplars.videos(), exemplars.labels.tolist()
    rows, gaps, bounds, at = [], [], [0] * (classes + 1), 0
    for i in sorted(range(len(videos)), key=labels.__getitem__):
        for track in [videos[i], mirror_rows(videos[i])] if flip else [videos[i]]:
            rows += [track.new_zeros(GAP, track.shape[1]), track]
            gaps += [at, at + 1]
            at += GAP + len(track)
        bounds[labels[i] + 1] = at
    every = torch.cat(rows)
    basis = principal(every, num_directions)
    return Library(every @ basis, torch.tensor(gaps), tuple(bounds), basis)


def principal(rows: Tensor, count: int) -> Tensor:
    """``(D, count)`` orthonormal directions that hold most of the energy of ``rows (M, D)``; all where there are no more."""
    if rows.shape[1] <= count:
        return torch.eye(rows.shape[1]).to(rows)
    exact = rows.double()
    return torch.linalg.eigh(exact.mT @ exact).eigenvectors[:, -count:].to(rows)
