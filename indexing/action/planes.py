r"""Windows as planes of space-time, and what all pairs of them have in common.

The image of a window in one channel is a tall matrix X with two columns, x and y of all joints over all frames.  With the
factorization :math:`X / \|X\| = U L^T`, U orthonormal and L lower triangular, the 2x2 product :math:`C = U_q^T U_e` of two windows
gives every evidence there is of the pair: the four entries for all pairs are two GEMMs, and the rest is elementwise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

GRAM_EPSILON = 1e-6  # of a 2x2 Gram, relative to its trace: as in dyntorch.numerics.orthonormal_basis
FEW_BLOCK = 8  # queries up to which one product that reads all windows once is faster: one query 6.2 ms for 10.2

Entries = tuple[Tensor, Tensor, Tensor, Tensor]  # 00, 01, 10, 11 of 2x2 matrices


def factorize(images: Tensor) -> tuple[Tensor, Tensor]:
    r"""Orthonormal rows and triangular factor of each image: :math:`X / \|X\| = U L^T`. images ``(N, 2, rows)`` ->
    ``(N, 2, rows)``."""
    # the unit is that of the largest entry: no square of it leaves the range
    largest = images.abs().amax((1, 2), keepdim=True)
    usable = largest.isfinite()
    if not bool(usable.all()):
        images, largest = torch.where(usable, images, 0.0), torch.where(usable, largest, 0.0)
    x = images / torch.where(largest > 0, largest, 1.0)
    g00, g01, _, g11 = (x @ x.mT).flatten(1).unbind(1)
    scale = (g00 + g11).clamp(min=torch.finfo(x.dtype).tiny).rsqrt()
    l00 = (g00 * scale**2 + GRAM_EPSILON).sqrt()
    l10 = g01 * scale**2 / l00
    l11 = (g11 * scale**2 + GRAM_EPSILON - l10**2).clamp(min=GRAM_EPSILON / 2).sqrt()
    inverse = torch.stack([1 / l00, torch.zeros_like(l00), -l10 / (l00 * l11), 1 / l11], dim=1).unflatten(1, (2, 2))
    return (inverse * scale[:, None, None]) @ x, torch.stack([l00, l10, l11], dim=1)


def entries(left: Tensor, right: Tensor) -> Entries:
    """``(Q, E)`` the four entries of C of all pairs, from U ``(Q, 2, rows)`` and ``(E, 2, rows)``."""
    count = len(left)
    both = left.transpose(0, 1).flatten(0, 1)
    if count <= FEW_BLOCK:
        c = (right.flatten(0, 1) @ both.mT).view(len(right), 2, 2, count).permute(2, 1, 3, 0).contiguous()
        return c[0, 0], c[0, 1], c[1, 0], c[1, 1]
    first, second = both @ right[:, 0].mT, both @ right[:, 1].mT
    return first[:count], second[:count], first[count:], second[count:]


def epipolar_correlation(c: Entries) -> Tensor:
    r"""``(Q, E)`` the largest singular value of C, the correlation of two images of one shape: 1 whatever the viewpoints."""
    c00, c01, c10, c11 = c
    one, other = c00 + c11, c01 - c10
    total = one.square_().addcmul_(other, other).sqrt_()
    one, other = c00 - c11, c01 + c10
    return total.add_(one.square_().addcmul_(other, other).sqrt_()).mul_(0.5)


def _products(c: Entries, left: Tensor, right: Tensor) -> tuple[Tensor, Tensor]:
    """Of x with x and of y with y of unit images, from L of both: ``X_q^T X_e = L_q C L_e^T``."""
    c00, c01, c10, c11 = c
    (l00, l10, l11), (m00, m10, m11) = left.T[..., None], right.T
    heights = (c00 * l10).addcmul_(c10, l11).mul_(m10)
    rest = (c01 * l10).addcmul_(c11, l11)
    heights.addcmul_(rest, m11)
    return torch.mul(c00, l00, out=rest).mul_(m00), heights


def _image_correlation(c: Entries, left: Tensor, right: Tensor) -> Tensor:
    across, heights = _products(c, left, right)
    return across.add_(heights)


def _card_correlation(c: Entries, left: Tensor, right: Tensor) -> Tensor:
    """A turn of a flat card scales its x by -1 to 1: the best one takes the product of the x without its sign."""
    across, heights = _products(c, left, right)
    return across.abs_().add_(heights)


# Evidence of a pair of windows in one channel: a correlation, 1 where they are the same.
TERMS: dict[str, Callable[[Entries, Tensor, Tensor], Tensor]] = {
    "epi": lambda c, left, right: epipolar_correlation(c),
    "nn": _image_correlation,
    "turned": _card_correlation,
}


@dataclass(frozen=True)
class Fusion:
    """What a residual is made of: terms that all channels have, and the power of each channel."""

    terms: tuple[str, ...]
    powers: tuple[float, ...]


def fuse_terms(left: Sequence[Tensor], right: Sequence[Tensor], fusions: Sequence[Fusion], epsilon: float) -> list[Tensor]:
    r"""``(Q, E)`` products :math:`\prod_c \prod_{\text{terms}} (r_c + \epsilon)^{w_c}` of residuals, of each fusion."""
    found: list[Tensor | None] = [None] * len(fusions)
    for i in range(len(left) // 2):
        (u, own), (v, other) = left[2 * i : 2 * i + 2], right[2 * i : 2 * i + 2]
        c = entries(u, v)
        for number, fusion in enumerate(fusions):
            for term in fusion.terms:
                residual = TERMS[term](c, own, other).neg_().add_(1.0 + epsilon).clamp_(min=epsilon)
                if fusion.powers[i] != 1:
                    residual.pow_(fusion.powers[i])
                before = found[number]
                found[number] = residual if before is None else before.mul_(residual)
    return [table for table in found if table is not None]
