"""What people use today for the same job: nearest neighbours among normalized 2D poses.  For comparison only."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, Self

import numpy as np
import torch
from numpy.typing import NDArray

from indexing import Clip
from indexing.shape.channels import channel
from indexing.windows import ragged, whole

Array = NDArray[Any]


class ImageNearest:
    r"""Nearest neighbour of whole images, bound to the view: :math:`\sum_c \log(1 - \cos(X_c, E_c) + \epsilon)`.

    The channels c (clip, frame, motion) and the way they are fused are those of the action indexer.
    """

    CHANNELS = ("clip", "frame", "motion")
    EPSILON = 1e-3
    LENGTH = 12

    def fit(self, clips: Sequence[Clip], labels: Array) -> Self:
        """Keep the exemplars."""
        self.labels, self.bank = np.asarray(labels), self._unit(clips)
        return self

    def predict(self, clips: Sequence[Clip]) -> Array:
        """The label of the nearest exemplar."""
        pairs = zip(self._unit(clips), self.bank, strict=True)
        total = sum((1 - query @ exemplar.mT + self.EPSILON).clamp(min=1e-9).log() for query, exemplar in pairs)
        return np.asarray(self.labels[torch.as_tensor(total).argmin(dim=1).numpy()])

    def _unit(self, clips: Sequence[Clip]) -> list[torch.Tensor]:
        windows = whole(ragged(clips), self.LENGTH)
        return [torch.nn.functional.normalize(channel(windows, name).flatten(1), dim=1) for name in self.CHANNELS]


class WarpedNearest:
    """Nearest neighbour by dynamic time warping (aeon, compiled): every joint coordinate is a channel, warped together.

    Poses are centred on the clip's mean (``"clip"``: the path of the body counts) or on each frame's (``"frame"``: it does
    not), divided by the person's median height, and resampled to 32 steps; the Sakoe-Chiba band is 10 % of them.
    """

    LENGTH = 32
    BAND = 0.1

    def __init__(self, centre: Literal["clip", "frame"] = "clip", jobs: int = 1) -> None:
        from aeon.distances import dtw_pairwise_distance

        self.distance, self.centre, self.jobs = dtw_pairwise_distance, centre, jobs

    def fit(self, clips: Sequence[Clip], labels: Array) -> Self:
        """Keep the exemplars."""
        self.labels, self.bank = np.asarray(labels), self._series(clips)
        return self

    def predict(self, clips: Sequence[Clip]) -> Array:
        """The label of the nearest exemplar."""
        series, threads = self._series(clips), torch.get_num_threads()
        table = self.distance(series, self.bank, window=self.BAND, n_jobs=self.jobs)
        torch.set_num_threads(threads)  # numba and torch share one OpenMP: aeon's call changes torch's number of threads
        return np.asarray(self.labels[table.argmin(axis=1)])

    def _series(self, clips: Sequence[Clip]) -> Array:
        """``(clips, channels, steps)``."""
        windows = whole(ragged(clips), self.LENGTH)
        heights = windows[..., 1]
        tall = (heights.amax(dim=2) - heights.amin(dim=2)).median(dim=1).values.clamp(min=1e-9)
        poses = channel(windows, self.centre) / tall[:, None, None, None]
        return np.ascontiguousarray(poses.flatten(2).mT.double().numpy())
