r"""The thesis's window kernel in rank-free form: how the patches of a short window move, whatever they look like.

Patch :math:`k` of a reference frame :math:`\tau` has the brightness differences

.. math:: h_k(t) = \sum_{patch_k} (I_x, I_y)(\tau)\,(B(t) - B(\tau)) = -G_k\,(u, v)_k(t) + \dots,\qquad |t - \tau| \le w

with :math:`G_k` the patch's own constant 2x2 matrix of gradients.  So the rows of :math:`H_\tau` (2 patches x L, L = 2w + 1) lie in
the space of the motions' rows, which two cameras share: :math:`K_\tau = J H^T H J / tr` (:math:`J` centres) compares those spaces
with no rank to choose.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize

from indexing.brightness.features import blur
from indexing.brightness.profile import inverse_root

SIGMA = 2.0  # px: motion within a window must be small against it
HALF = 10  # frames on either side of the reference
PATCH = 10  # px
ROWS = 80  # kept: those of most energy
BLOCK = 4  # reference frames at once


def window_kernels(crops: Tensor, half: int = HALF, patch: int = PATCH, rows: int = ROWS) -> Tensor:
    """``(T - 2 half, L, L)`` float64 of crops ``(T, s, s)``, trace 1 (0 if nothing moves); the first is frame ``half``."""
    frames = blur(crops, SIGMA)
    gx, gy = (torch.zeros_like(frames) for _ in range(2))
    gx[:, :, 1:-1] = (frames[:, :, 2:] - frames[:, :, :-2]) / 2
    gy[:, 1:-1] = (frames[:, 2:] - frames[:, :-2]) / 2
    cells, slope = _patches(frames, patch), torch.stack([_patches(gx, patch), _patches(gy, patch)], dim=2)
    length = 2 * half + 1
    out = frames.new_zeros(max(len(frames) - 2 * half, 0), length, length, dtype=torch.float64)
    for begin in range(0, len(out), BLOCK):
        count = min(BLOCK, len(out) - begin)
        windows = cells[begin : begin + count + 2 * half].unfold(0, length, 1)  # (count, patches, px, L)
        steep = slope[begin + half : begin + half + count]  # (count, patches, 2, px)
        h = steep @ windows
        h = h - h[..., half : half + 1]
        energy = steep.square().sum(-1, keepdim=True)
        h = h / (energy + 0.05 * energy.amax((1, 2, 3), keepdim=True)).clamp(min=1e-12).sqrt()
        out[begin : begin + count] = _kernel(h.flatten(1, 2).double(), rows)
    return out


def _patches(frames: Tensor, patch: int) -> Tensor:
    """``(T, patches, patch * patch)``; what does not fill a patch at the right and lower border is left out."""
    tiles = frames.unfold(1, patch, patch).unfold(2, patch, patch)
    return tiles.flatten(3).flatten(1, 2)


def _kernel(h: Tensor, rows: int) -> Tensor:
    """Kernels ``(n, L, L)`` of the strongest rows of ``(n, rows, L)``."""
    energy = h.square().sum(-1)
    best = energy.topk(min(rows, h.shape[1]), dim=1).indices
    h = h.gather(1, best[..., None].expand(-1, -1, h.shape[-1]))
    h = h - h.mean(-1, keepdim=True)
    kernel = h.mT @ h
    trace = kernel.diagonal(dim1=1, dim2=2).sum(1)
    return kernel / trace.clamp(min=1e-12)[:, None, None]


def kernel_descriptors(first: Tensor, second: Tensor, ridge: float = 0.02) -> tuple[Tensor, Tensor]:
    """Both cameras' kernels ``(n, L, L)`` as unit vectors ``(n, L * L)``: whitened by the mean kernel, the mean removed.

    Kernels that hold NaN (missing frames) become 0.
    """
    kernels = torch.cat([first, second])
    known = kernels.isfinite().all(-1).all(-1)
    root = inverse_root(kernels[known].mean(0), ridge)
    white = root @ kernels @ root
    flat = (white - white[known].mean(0)).flatten(1).nan_to_num(0.0)
    flat = normalize(flat, dim=1, eps=1e-9)
    return flat[: len(first)], flat[len(first) :]
