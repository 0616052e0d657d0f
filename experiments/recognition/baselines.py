"""What people use today for the same job: nearest neighbours among normalized 2D poses.  For comparison only."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, Literal, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from indexing import Clip
from indexing.action.bank import channel
from indexing.windows import concatenate_clips, resample_clips

Array = NDArray[Any]


class Nearest(ABC):
    """A nearest neighbour among windows of joints: a description of windows, and distances between two of them."""

    LENGTH: int  # steps that a clip is resampled to

    @abstractmethod
    def describe(self, windows: Tensor) -> Any:
        """What is compared of windows ``(N, length, joints, 2)``."""

    @abstractmethod
    def between(self, queries: Any, bank: Any) -> Array:
        """``(Q, E)`` distances between two descriptions."""

    def fit(self, clips: Sequence[Clip], labels: Array) -> Self:
        """Keep the exemplars."""
        self.labels = np.asarray(labels)
        self.bank = self.describe(resample_clips(concatenate_clips(clips), self.LENGTH))
        return self

    def distances(self, clips: Sequence[Clip]) -> Array:
        """``(clips, exemplars)``."""
        return self.between(self.describe(resample_clips(concatenate_clips(clips), self.LENGTH)), self.bank)

    def predict(self, clips: Sequence[Clip]) -> Array:
        """The label of the nearest exemplar."""
        return np.asarray(self.labels[self.distances(clips).argmin(axis=1)])

    def evidence(self, clips: Sequence[Clip]) -> Array:
        """``(clips,)`` minus the distance to the nearest exemplar."""
        return np.asarray(-self.distances(clips).min(axis=1))


class ImageNearest(Nearest):
    r"""Nearest neighbour of whole images, bound to the view: :math:`\sum_c \log(1 - \cos(X_c, E_c) + \epsilon)`.

    The channels c (clip, frame, motion) and the way they are fused are those of the action indexer.
    """

    CHANNELS = ("clip", "frame", "motion")
    EPSILON = 1e-3
    LENGTH = 12

    def describe(self, windows: Tensor) -> list[Tensor]:
        """Unit vectors ``(N, length * joints * 2)`` of every channel."""
        return [torch.nn.functional.normalize(channel(windows, name).flatten(1), dim=1) for name in self.CHANNELS]

    def between(self, queries: list[Tensor], bank: list[Tensor]) -> Array:
        """``(Q, E)`` sum of log residuals."""
        pairs = zip(queries, bank, strict=True)
        total = sum((1 - query @ exemplar.mT + self.EPSILON).clamp(min=1e-9).log() for query, exemplar in pairs)
        return torch.as_tensor(total).numpy()


class WarpedNearest(Nearest):
    """Nearest neighbour by dynamic time warping (aeon, compiled): every joint coordinate is a channel, warped together.

    Poses are centred on the clip's mean (``"clip"``: the path of the body counts) or on each frame's (``"frame"``: it does
    not), divided by the person's median height, and resampled to 32 steps; the Sakoe-Chiba band is 10 % of them.
    """

    LENGTH = 32
    BAND = 0.1

    def __init__(self, centre: Literal["clip", "frame"] = "clip", jobs: int = 1) -> None:
        from aeon.distances import dtw_pairwise_distance

        self.distance, self.centre, self.jobs = dtw_pairwise_distance, centre, jobs

    def describe(self, windows: Tensor) -> Array:
        """``(N, channels, steps)``."""
        heights = windows[..., 1]
        tall = (heights.amax(dim=2) - heights.amin(dim=2)).median(dim=1).values.clamp(min=1e-9)
        poses = channel(windows, self.centre) / tall[:, None, None, None]
        return np.ascontiguousarray(poses.flatten(2).mT.double().numpy())

    def between(self, queries: Array, bank: Array) -> Array:
        """``(Q, E)`` warped distances."""
        threads = torch.get_num_threads()
        table = self.distance(queries, bank, window=self.BAND, n_jobs=self.jobs)
        torch.set_num_threads(threads)  # numba and torch share one OpenMP: aeon's call changes torch's number of threads
        return np.asarray(table)
