"""Single frames of clips, as windows of length one: nothing before or after a frame is looked at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dyntorch.numerics import orthonormal_basis
from indexing.action.bank import Windows, between, cosine_distance
from indexing.cameras import virtual, y_up
from indexing.clip import Clip
from indexing.phase.options import PhaseOptions
from indexing.windows import ragged

LEAST = 6  # joints: an affine camera takes any four anywhere, so five leave two numbers to judge by


@dataclass(frozen=True)
class Learned:
    """Training frames end to end: the frames, and for each its clip ``(F,)`` and its time in seconds ``(F,)``."""

    frames: Windows
    clip: Tensor
    times: Tensor

    def to(self, device: torch.device | str) -> Learned:
        """The same on another device."""
        return Learned(self.frames.to(device), self.clip.to(device), self.times.to(device))


def training_frames(clips: Sequence[Clip]) -> Learned:
    """All frames of images, missing joints interpolated in time (a joint that a clip never shows is not seen)."""
    source = ragged(clips)
    clip = torch.from_numpy(np.repeat(np.arange(len(clips)), np.diff(source.starts)))
    frames = Windows(torch.from_numpy(source.joints).double()[:, None], torch.from_numpy(source.seen)[clip])
    return Learned(frames, clip, torch.from_numpy(source.times))


def query_frames(clip: Clip) -> Windows:
    """The frames of an image with the joints that each of them shows."""
    joints = torch.from_numpy(np.nan_to_num(y_up(clip).astype(np.float64)))[:, None]
    return Windows(joints, torch.from_numpy(clip.seen))


def images(clip: Clip, options: PhaseOptions = PhaseOptions()) -> list[Clip]:
    """An image itself; of 3D joints, views from all around."""
    if clip.dims == 2:
        return [clip]
    return [
        virtual(clip, 360 / options.views.turns * i, options.views.elevations[i % len(options.views.elevations)])
        for i in range(options.views.turns)
    ]


def standardized(x: Tensor, seen: Tensor) -> Tensor:
    """Frames ``(F, n, 2)`` about the middle of the joints seen ``(F, n)``, Frobenius norm 1; zero where nothing is seen."""
    weight = seen[..., None].to(x)
    x = (x - (x * weight).sum(1, keepdim=True) / weight.sum(1, keepdim=True).clamp(min=1.0)) * weight
    return x / x.flatten(1).norm(dim=1).clamp(min=1e-300)[:, None, None]


def image_distance(query: Windows, bank: Windows) -> Tensor:
    """``(Q, E)`` 1 - cosine between frames, each about its middle: place and size in the image are free, the viewpoint is not."""

    def compare(a: Tensor, b: Tensor, _: Tensor | slice) -> Tensor:
        return cosine_distance(centred(a).flatten(1), centred(b).flatten(1))

    return between(query, bank, compare, worst=1.0)


def shape_distance(query: Windows, shapes: Windows) -> Tensor:
    r""":math:`\|(I - \Pi_g)\bar x\|^2`: the part of each frame ``(Q, shapes)`` that no affine image of a shape explains."""

    def compare(a: Tensor, b: Tensor, joints: Tensor | slice) -> Tensor:
        if a.shape[2] < LEAST:
            return a.new_ones(len(a), len(b))
        basis = orthonormal_basis(centred(b)[:, 0])
        x = centred(a)[:, 0]
        x = x / x.flatten(1).norm(dim=1).clamp(min=1e-300)[:, None, None]
        inner = x.mT.flatten(0, 1) @ basis.permute(1, 0, 2).flatten(1)
        return (1 - inner.square().reshape(len(a), 2, len(b), 3).sum((1, 3))).clamp(0, 1)

    return between(query, shapes, compare, worst=1.0)


def centred(x: Tensor) -> Tensor:
    return x - x.mean(-2, keepdim=True)
