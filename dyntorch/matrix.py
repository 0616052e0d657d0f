"""The estimation matrix of weighted matches and its Gram, for any invariant."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import torch
from torch import Tensor

from dyntorch.primitives import Primitive

CHUNK = 1 << 21
"""Numbers per temporary of the Gram (16 MB): matches beyond it are added up in pieces, so that memory does not grow with n."""


def estimation_matrix(
    primitives: Sequence[Primitive], views: Sequence[Tensor], weights: Tensor, static: Tensor | None = None
) -> Tensor:
    r"""Rows :math:`\sqrt w\; u_1 \otimes u_2 \otimes \dots` of all matches, with unit vectors u.

    A match labelled static puts, for every slot in turn, all the vectors that a static match allows there.

    Args:
        primitives: one per view.
        views: ``(*batch, n, ...)`` finite matches.
        weights: ``(*batch, n)``.
        static: ``(*batch, n)`` bool.

    Returns:
        ``(*batch, rows, width)``.
    """
    vectors = [p.vectors(x) for p, x in zip(primitives, views, strict=True)]
    if static is None:
        return _kronecker(vectors, weights)
    blocks = [_kronecker(vectors, weights * ~static)]
    for v, (primitive, x) in enumerate(zip(primitives, views, strict=True)):
        # a projector is its own Gram, so its rows serve as the vectors
        blocks.append(_kronecker([*vectors[:v], primitive.free(x), *vectors[v + 1 :]], weights * static))
    return torch.cat(blocks, dim=-2)


def _kronecker(vectors: Sequence[Tensor], weights: Tensor) -> Tensor:
    rows = vectors[0] * weights.sqrt()[..., None, None]
    for u in vectors[1:]:
        rows = torch.einsum("...ra,...sb->...rsab", rows, u).flatten(-2).flatten(-3, -2)
    return rows.flatten(-3, -2)


def gram(primitives: Sequence[Primitive], views: Sequence[Tensor], weights: Tensor, static: Tensor | None = None) -> Tensor:
    r"""Gram matrix of :func:`estimation_matrix` without building it:

    .. math:: G = \sum_n w_n\, S_1(n) \otimes S_2(n) \otimes \dots, \qquad S_v = \sum_r u_r u_r^T .

    Each :math:`S_v` is symmetric, so the sum is one product of its packed entries: 216 numbers instead of 729 for three
    points of P^2, and no row of the estimation matrix is ever written.

    Args:
        primitives: one per view.
        views: ``(*batch, n, ...)`` finite matches.
        weights: ``(*batch, n)``.
        static: ``(*batch, n)`` bool.

    Returns:
        ``(*batch, width, width)``.
    """
    packed, norms = zip(*(packed_form(p, x) for p, x in zip(primitives, views, strict=True)), strict=True)
    for norm in norms:
        weights = weights if norm is None else weights / norm
    if static is None:
        moments = moment(packed, weights)
    else:
        moments = moment(packed, weights * ~static)
        for v, (primitive, x) in enumerate(zip(primitives, views, strict=True)):
            free, norm = _pack(primitive.free(x)), norms[v]
            kept = weights * static if norm is None else weights * static * norm
            moments = moments + moment([*packed[:v], free, *packed[v + 1 :]], kept)
    return unpack(moments, tuple(p.width for p in primitives))


def packed_form(primitive: Primitive, x: Tensor) -> tuple[Tensor, Tensor | None]:
    """Upper triangle of each measurement's form, component first: ``(*batch, width (width + 1) / 2, n)``.

    The form of a single vector is left unscaled; the second result is its squared norm ``(*batch, n)``, by which the weight
    of the match is divided instead (one pass over n numbers, not over all components).
    """
    if primitive.rows > 1:
        return _pack(primitive.form(x)), None
    vector = primitive.components(x)
    rows, columns = _triangle(primitive.width, x.device)
    packed = vector.index_select(-2, rows) * vector.index_select(-2, columns)
    return packed, vector.square().sum(-2).clamp(min=torch.finfo(x.dtype).tiny)


def _pack(form: Tensor) -> Tensor:
    rows, columns = _triangle(form.shape[-1], form.device)
    return form[..., rows, columns].mT


def moment(packed: Sequence[Tensor], weights: Tensor) -> Tensor:
    """Sums of the products of packed forms over the matches, ``(*batch, m1 m2 ...)``."""
    sizes = [m.shape[-2] for m in packed]
    per_match = math.prod(sizes[1:]) * max(1, math.prod(torch.broadcast_shapes(*(m.shape[:-2] for m in packed))))
    n = weights.shape[-1]
    step = max(256, CHUNK // max(1, per_match))
    total: Tensor | None = None
    for start in range(0, max(n, 1), step):
        piece = slice(start, start + step)
        left = packed[0][..., piece] * weights[..., None, piece]
        right = packed[1][..., piece]
        for m in packed[2:]:
            right = (right[..., :, None, :] * m[..., None, :, piece]).flatten(-3, -2)
        part = (left @ right.mT).flatten(-2)
        total = part if total is None else total + part
    assert total is not None
    return total


def unpack(moments: Tensor, widths: tuple[int, ...]) -> Tensor:
    """The Gram ``(*batch, D, D)`` of packed moments ``(*batch, m1 m2 ...)``."""
    size = math.prod(widths)
    return moments.index_select(-1, _unpacking(widths, moments.device)).unflatten(-1, (size, size))


@lru_cache(maxsize=64)
def _triangle(width: int, device: torch.device) -> tuple[Tensor, Tensor]:
    # an inference tensor left in the cache would break every later gradient
    with torch.inference_mode(False):
        rows, columns = torch.triu_indices(width, width, device=device)
    return rows, columns


@lru_cache(maxsize=64)
def _unpacking(widths: tuple[int, ...], device: torch.device) -> Tensor:
    """Where entry (i1 i2 .., j1 j2 ..) of the Gram lies among the packed moments."""
    with torch.inference_mode(False):
        index = torch.zeros(1, 1, dtype=torch.long)
        for width in widths:
            rows, columns = torch.triu_indices(width, width)
            place = torch.zeros(width, width, dtype=torch.long)
            place[rows, columns] = place[columns, rows] = torch.arange(len(rows))
            packed = width * (width + 1) // 2
            index = (index[:, None, :, None] * packed + place[None, :, None, :]).flatten(0, 1).flatten(1)
        return index.flatten().to(device)
