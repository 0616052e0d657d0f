"""Two views of several moving bodies in the folder DYNTORCH_DATA: matches of photographs, and tracks cut to two frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from experiments.recognition.protocol import Array, data_folder


@dataclass(frozen=True)
class Pair:
    """Matches of two images: ``x1``, ``x2 (n, 2)`` px and ``labels (n,)``, 0 wrong match, 1..K the bodies."""

    name: str
    x1: Tensor
    x2: Tensor
    labels: Tensor

    @property
    def bodies(self) -> int:
        """How many bodies there are."""
        return int(self.labels.max())


def motion_pairs() -> list[Pair]:
    """The pairs of AdelaideRMF in which objects moved between the photographs: 27 to 73 % of the matches are wrong.

    Source: Wong, Chin, Yu and Suter, ICCV 2011.
    """
    with np.load(data_folder() / "adelaidermf.npz") as file:
        names = [str(name) for name in file["names"] if str(file[f"{name}/type"]) == "F"]
        return [_pair(name, file[f"{name}/x1"], file[f"{name}/x2"], file[f"{name}/label"]) for name in names]


def hopkins_pairs() -> list[Pair]:
    """The first and the last frame of the Hopkins155 sequences: every track belongs to one of two or three bodies.

    Source: Tron and Vidal, CVPR 2007.
    """
    with np.load(data_folder() / "hopkins155.npz") as file:
        tracks = {str(name): file[f"{name}/y"] for name in file["names"]}
        return [_pair(name, y[0], y[-1], file[f"{name}/s"]) for name, y in tracks.items()]


def _pair(name: str, x1: Array, x2: Array, labels: Array) -> Pair:
    return Pair(name, torch.from_numpy(x1.astype(float)), torch.from_numpy(x2.astype(float)), torch.from_numpy(labels.astype(int)))
