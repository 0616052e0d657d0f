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
from indexing.windows import ragged

NUM_TURNS = 8  # views of a clip in 3D
ELEVATIONS = (0.05, 0.3)  # radians, of their cameras, in turn

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


def images(clip: Clip) -> list[Clip]:
    """An image itself; of 3D joints, views from all around."""
    if clip.dims == 2:
        return [clip]
    return [virtual(clip, 360 / NUM_TURNS * i, ELEVATIONS[i % len(ELEVATIONS)]) for i in range(NUM_TURNS)]


def normalize_frames(x: Tensor, seen: Tensor) -> Tensor:
    """Frames ``(F, n, 2)`` about the middle of the joints seen ``(F, n)``, Frobenius norm 1; zero where nothing is seen."""
    weight = seen[..., None].to(x)
    x = (x - (x * weight).sum(1, keepdim=True) / weight.sum(1, keepdim=True).clamp(min=1.0)) * weight
    return x / x.flatten(1).norm(dim=1).clamp(min=1e-300)[:, None, None]


def image_distance(query: Windows, bank: Windows) -> Tensor:
    """``(Q, E)`` 1 - cosine between frames, each about its middle: place and size in the image are free, the viewpoint is not."""

    def compare(a: Tensor, b: Tensor, _: Tensor | slice) -> Tensor:
        return cosine_distance(centre(a).flatten(1), centre(b).flatten(1))

    return between(query, bank, compare, worst=1.0)


def shape_distance(query: Windows, shapes: Windows) -> Tensor:
    r""":math:`\|(I - \Pi_g)\bar x\|^2`: the part of each frame ``(Q, shapes)`` that no affine image of a shape explains."""

    def compare(a: Tensor, b: Tensor, joints: Tensor | slice) -> Tensor:
        if a.shape[2] < LEAST:
            return a.new_ones(len(a), len(b))
        basis = orthonormal_basis(centre(b)[:, 0])
        x = centre(a)[:, 0]
        x = x / x.flatten(1).norm(dim=1).clamp(min=1e-300)[:, None, None]
        inner = x.mT.flatten(0, 1) @ basis.permute(1, 0, 2).flatten(1)
        return (1 - inner.square().reshape(len(a), 2, len(b), 3).sum((1, 3))).clamp(0, 1)

    return between(query, shapes, compare, worst=1.0)


def centre(x: Tensor) -> Tensor:
    return x - x.mean(-2, keepdim=True)


# ----------------------------------------------------------------------------------------------------------------------
# Frames of people near a camera: what perspective does to an affine image of their shape, to first order.
#
# A camera sees joint i at :math:`x_i = (A^T X_i + b) / (1 + m^T X_i)`; :math:`m^T X_i` is how much further than the middle of the
# body the joint is, in parts of the distance.  With the affine image :math:`\hat x` that explains most, the rest is
#
# .. math:: x - \hat x \approx -\Pi^\perp\, \hat x_i\,(m^T X_i), \qquad \min_m |x - \hat x + \Pi^\perp G m|^2 + \kappa |m|^2,
#
# three numbers for a frame.  :math:`\kappa` is the variance of what a frame leaves anyway, over that of relative depths: where
# people are far, m stays at 0 and the image affine.


PAIR_BLOCK = 200_000  # frames times shapes at once: bounds memory


def leaning(x: Tensor, basis: Tensor, kappa: float) -> Tensor:
    r"""What images of shapes by leaning cameras leave of frames, ``(Q, E)``, with what the prior adds."""
    n, count = x.shape[1], len(basis)
    pairs = (basis[..., :, None] * basis[..., None, :]).flatten(-2)  # (E, n, 9)
    third = (basis.mT @ pairs).unflatten(-1, (3, 3))  # (E, 3, 3, 3) of U_a U_b U_c
    fourth = (pairs.mT @ pairs).unflatten(-1, (3, 3)).unflatten(1, (3, 3))
    bent = n * (fourth - torch.einsum("eabj,eack->ebcjk", third, third)).flatten(3).flatten(1, 2)
    flat = x.mT.flatten(0, 1)  # (2 Q, n)
    inner = (flat @ basis.permute(1, 0, 2).flatten(1)).unflatten(0, (-1, 2)).unflatten(-1, (count, 3)).transpose(1, 2)
    seen = (flat @ pairs.permute(1, 0, 2).flatten(1)).unflatten(0, (-1, 2)).unflatten(-1, (count, 3, 3)).transpose(1, 2)
    square = inner.mT @ inner  # (Q, E, 3, 3): c c^T
    own = square.flatten(-2)
    gram = ((own.transpose(0, 1) @ bent).transpose(0, 1) - own).unflatten(-1, (3, 3))
    known = (own.transpose(0, 1) @ third.flatten(2).unflatten(-1, (3, 3)).flatten(1, 2)).transpose(0, 1)
    right = n**0.5 * ((inner[..., None, :] @ seen)[..., 0, :].sum(-2) - known)
    left = 1 - square.diagonal(dim1=-2, dim2=-1).sum(-1)
    return (left - _energy(gram, right, kappa)).clamp(min=0.0)


def _energy(gram: Tensor, right: Tensor, kappa: float) -> Tensor:
    r""":math:`r^T (G + \kappa)^{-1} r` of symmetric 3 x 3 matrices, by elimination: millions of them at once."""
    a, b, c = (gram[..., i, i] + kappa for i in range(3))
    d, e, f = gram[..., 0, 1], gram[..., 0, 2], gram[..., 1, 2]
    x, y, z = right.unbind(-1)
    b, c, f = b - d * d / a, c - e * e / a, f - d * e / a
    y, z = y - d * x / a, z - e * x / a
    energy = x * x / a + y * y / b
    c, z = c - f * f / b, z - f * y / b
    return energy + z * z / c


def perspective_distance(query: Windows, shapes: Windows, kappa: float) -> Tensor:
    """As :func:`~indexing.phase.frames.shape_distance`, ``(Q, shapes)``, by cameras that may lean."""

    def compare(a: Tensor, b: Tensor, joints: Tensor | slice) -> Tensor:
        if a.shape[2] < LEAST + 1:
            return a.new_ones(len(a), len(b))
        basis = orthonormal_basis(centre(b)[:, 0])
        x = centre(a)[:, 0]
        x = x / x.flatten(1).norm(dim=1).clamp(min=1e-300)[:, None, None]
        step = max(1, PAIR_BLOCK // max(1, len(b)))
        return torch.cat([leaning(part, basis, kappa) for part in x.split(step)]).clamp(0, 1)

    return between(query, shapes, compare, worst=1.0)
