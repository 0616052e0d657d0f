"""Several moving bodies in the folder DYNTORCH_DATA: matches of photographs, tracks of videos, and these cut to two frames."""

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


@dataclass(frozen=True)
class Tracks:
    """Points of a video: ``tracks (frames, n, 2)`` px, NaN where not seen, and ``labels (n,)``, 0 outlier, 1..K the bodies."""

    name: str
    tracks: Tensor
    labels: Tensor

    @property
    def bodies(self) -> int:
        """How many bodies there are."""
        return int(self.labels.max())

    def pair(self, first: int = 0, second: int = -1) -> Pair:
        """The tracks that two frames show; bodies that they do not show are left out of the labels, which have no gaps."""
        seen = self.tracks[[first, second]].isfinite().all(-1).all(0)
        labels = self.labels[seen]
        there = torch.unique(torch.cat([labels.new_zeros(1), labels]))
        return Pair(self.name, self.tracks[first, seen], self.tracks[second, seen], torch.searchsorted(there, labels))


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


def hopkins_tracks() -> list[Tracks]:
    """Whole Hopkins155 sequences of the ``cars*`` and ``1R*``: 86, every track is in all frames.

    Source: Tron and Vidal, CVPR 2007.
    """
    return _sequences("hopkins155.npz")


def kt3d_tracks() -> list[Tracks]:
    """12 of the 22 street sequences of KT3DMoSeg: 10 to 20 frames of KITTI, most tracks are short; body 1 is the street.

    Source: Xu, Cheong and Li, CVPR 2018; Geiger, Lenz and Urtasun, CVPR 2012.
    """
    return _sequences("kt3dmoseg_half.npz")


def mtpv_tracks() -> list[Tracks]:
    """6 sequences of MTPV62 with missing tracks: 5 to 110 frames, two bodies each, some tracks are outliers.

    Source: Li, Guo, Cheong and Zhou, ICCV 2013.
    """
    return _sequences("mtpv62_half.npz")


def _sequences(file_name: str) -> list[Tracks]:
    found = []
    with np.load(data_folder() / file_name) as file:
        for name in map(str, file["names"]):
            tracks = torch.from_numpy(file[f"{name}/y"].astype(float))
            if f"{name}/vis" in file:
                # the files hold 0 where a point is not seen
                tracks[~torch.from_numpy(file[f"{name}/vis"])] = torch.nan
            found.append(Tracks(name, tracks, torch.from_numpy(file[f"{name}/s"].astype(int))))
    return found


def _pair(name: str, x1: Array, x2: Array, labels: Array) -> Pair:
    return Pair(name, torch.from_numpy(x1.astype(float)), torch.from_numpy(x2.astype(float)), torch.from_numpy(labels.astype(int)))
