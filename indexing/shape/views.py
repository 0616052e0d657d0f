"""Virtual views of the exemplars: what they would look like to cameras placed elsewhere.

Where an exemplar has 3D joints they are rendered (:func:`indexing.cameras.virtual`).  Where it has one image only, the
person is taken for a flat card and the card is turned: a random horizontal squeeze or mirror image with a slight pitch.
Measured, that gives 65-85 % of the gain of true 3D to a view-bound kernel and nearly all of it once heights are compared
too; it needs no weights, no training and no particular joints.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from indexing.cameras import rotation
from indexing.clip import FloatArray

PITCH = 0.1  # radians, standard deviation over the virtual cameras


def turn(windows: Tensor, azimuth: FloatArray, pitch: FloatArray) -> Tensor:
    """Flat cards turned about the vertical and pitched, seen orthographically.

    Args:
        windows: ``(N, length, joints, 2)``, y up.
        azimuth, pitch: ``(N,)`` radians.

    Returns:
        ``(N, length, joints, 2)``.
    """
    rotations = torch.tensor(np.stack([rotation(a, p) for a, p in zip(azimuth, pitch, strict=True)]), dtype=windows.dtype)
    centred = windows - windows.mean(dim=(1, 2), keepdim=True)
    return torch.einsum("nij,ntkj->ntki", rotations[:, :2, :2], centred)


def mirror(windows: Tensor, permutation: Tensor) -> Tensor:
    """The same action done by the other side of the body: image mirrored, left and right joints exchanged."""
    flipped = windows[:, :, permutation].clone()
    flipped[..., 0].neg_()
    return flipped
