"""The estimation matrix of weighted matches and its Gram, for any invariant."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations

import numpy as np
import torch
from torch import Tensor

from dyntorch.core.primitives import Primitive, triangle
from dyntorch.numerics.blocks import constant
from dyntorch.numerics.nullspace import eigh

CHUNK = 1 << 18
"""Numbers per temporary of the Gram (2 MB, best of 1 to 16 MB): further matches are added in pieces, and memory does not grow."""


def estimation_matrix(
    primitives: Sequence[Primitive], views: Sequence[Tensor], weights: Tensor, static: Tensor | None = None
) -> Tensor:
    r"""Rows :math:`\sqrt w\; u_1 \otimes u_2 \otimes \dots` of all matches, with the vectors u of the primitives. views
    ``(*batch, n, ...)``, weights ``(*batch, n)``, static ``(*batch, n)`` -> ``(*batch, rows, width)``."""
    vectors = [p.vectors(x) for p, x in zip(primitives, views, strict=True)]
    if static is None:
        return _kronecker(vectors, weights)
    blocks = [_kronecker(vectors, weights * (static == 0))]
    # a projector is its own Gram, so its rows serve as the vectors
    free = [p.free(x) for p, x in zip(primitives, views, strict=True)]
    for slots in _free_slots(len(views), static):
        chosen = [free[v] if v in slots else u for v, u in enumerate(vectors)]
        blocks.append(_kronecker(chosen, weights * (static == len(slots))))
    lead = np.broadcast_shapes(*(block.shape[:-2] for block in blocks))
    return torch.cat([block.expand(*lead, -1, -1) for block in blocks], dim=-2)


def _kronecker(vectors: Sequence[Tensor], weights: Tensor) -> Tensor:
    # no root of 0, whose derivative is not finite
    root = torch.where(weights > 0, weights, 1.0).sqrt() * (weights > 0) if weights.requires_grad else weights.sqrt()
    rows = vectors[0] * root[..., None, None]
    for u in vectors[1:]:
        rows = torch.einsum("...ra,...sb->...rsab", rows, u).flatten(-2).flatten(-3, -2)
    return rows.flatten(-3, -2)


def triangular_factor(
    primitives: Sequence[Primitive], views: Sequence[Tensor], weights: Tensor, static: Tensor | None = None
) -> Tensor:
    """Triangular factor R of :func:`estimation_matrix`, ``(*batch, at most width, width)``, whose Gram is the same."""
    width, n = math.prod(p.width for p in primitives), weights.shape[-1]
    per_match = width * math.prod(p.rows for p in primitives) * max(1, weights.numel() // max(1, n))
    step = max(2 * width, CHUNK // per_match)
    factor: Tensor | None = None
    for start in range(0, max(1, n), step):
        count = min(step, n - start)
        part = [x.narrow(p.match_axis(x), start, count) for p, x in zip(primitives, views, strict=True)]
        label = None if static is None else static.narrow(-1, start, count)
        rows = estimation_matrix(primitives, part, weights.narrow(-1, start, count), label)
        stacked = rows if factor is None else torch.cat([factor, rows], dim=-2)
        factor = torch.linalg.qr(stacked, mode="r")[1] if stacked.shape[-2] > width else stacked
    assert factor is not None
    return factor


def gram(primitives: Sequence[Primitive], views: Sequence[Tensor], weights: Tensor, static: Tensor | None = None) -> Tensor:
    r"""Gram matrix of :func:`estimation_matrix` without building it: views ``(*batch, n, ...)``, weights ``(*batch, n)``,
    static ``(*batch, n)`` -> ``(*batch, width, width)``."""
    if len(primitives) == 1:
        # nothing to multiply: a match gives its rows as they are
        if torch.is_grad_enabled() and weights.requires_grad:  # weights of 0 have derivatives, but their roots do not
            matrix = estimation_matrix(primitives, views, torch.ones_like(weights))
            shared = weights[..., None].expand(*weights.shape, matrix.shape[-2] // max(1, weights.shape[-1])).flatten(-2)
            return (matrix * shared[..., None]).mT @ matrix
        matrix = estimation_matrix(primitives, views, weights)
        return matrix.mT @ matrix
    n, width = weights.shape[-1], math.prod(p.width * (p.width + 1) // 2 for p in primitives[1:])
    shapes = [x.shape[: p.match_axis(x)] for p, x in zip(primitives, views, strict=True)]
    lead = math.prod(np.broadcast_shapes(*shapes, weights.shape[:-1]))
    if weights.ndim == 2 and lead * n * width > CHUNK and len(weights) > 1:
        # a few problems at a time, so that their products stay in the cache (copies have primitives of each problem)
        size = max(1, CHUNK * len(weights) // max(1, lead * n * width))
        label = [None] * len(weights.split(size)) if static is None else static.split(size)
        parts = zip(*(x.split(size) for x in views), weights.split(size), label, strict=True)
        return torch.cat([gram(primitives, part[:-2], part[-2], part[-1]) for part in parts])
    step = max(256, CHUNK // max(1, lead * width))
    total: Tensor | None = None
    for start in range(0, max(n, 1), step):
        count = min(step, n - start)
        piece = [x.narrow(p.match_axis(x), start, count) for p, x in zip(primitives, views, strict=True)] if count < n else views
        some = None if static is None else static.narrow(-1, start, count)
        part = _moments(primitives, piece, weights.narrow(-1, start, count), some)
        total = part if total is None else total + part
    assert total is not None
    return unpack(total, tuple(p.width for p in primitives))


def _moments(primitives: Sequence[Primitive], views: Sequence[Tensor], weights: Tensor, static: Tensor | None) -> Tensor:
    """Packed Gram of one piece of the matches."""
    packed = [p.pack(x) for p, x in zip(primitives, views, strict=True)]
    if static is None:
        return moment(packed, weights)
    moments = moment(packed, weights * (static == 0))
    free = [_pack(p.free(x)) for p, x in zip(primitives, views, strict=True)]
    for slots in _free_slots(len(views), static):
        chosen = [free[v] if v in slots else m for v, m in enumerate(packed)]
        moments = moments + moment(chosen, weights * (static == len(slots)))
    return moments


def _free_slots(views: int, static: Tensor) -> list[tuple[int, ...]]:
    """Which slots are free at once in some match."""
    max_free = 1 if static.dtype == torch.bool else int(static.max()) if static.numel() else 0
    return [slots for count in range(1, max_free + 1) for slots in combinations(range(views), count)]


def labelled_rows(primitives: Sequence[Primitive]) -> list[int]:
    """Rows of a match with 1, 2, ... free slots, as many as there are views less one."""
    widths = [p.width for p in primitives]
    return [sum(math.prod(chosen) for chosen in combinations(widths, count)) for count in range(1, max(2, len(widths)))]


def _pack(form: Tensor) -> Tensor:
    rows, columns = triangle(form.shape[-1], form.device)
    return form[..., rows, columns].mT


def moment(packed: Sequence[Tensor], weights: Tensor) -> Tensor:
    """Sums of the products of packed forms over the matches, ``(*batch, m1 m2 ...)``."""
    right = packed[1]
    for m in packed[2:]:
        right = (right[..., :, None, :] * m[..., None, :, :]).flatten(-3, -2)
    return ((packed[0] * weights[..., None, :]) @ right.mT).flatten(-2)


def unpack(moments: Tensor, widths: tuple[int, ...]) -> Tensor:
    """The Gram ``(*batch, D, D)`` of packed moments ``(*batch, m1 m2 ...)``."""
    size = math.prod(widths)
    index = _unpacking(widths, moments.device)
    # gather takes a quarter of the time of index_select along the last dimension
    return moments.gather(-1, index.expand(*moments.shape[:-1], -1)).unflatten(-1, (size, size))


@constant
def _unpacking(widths: tuple[int, ...], device: torch.device) -> Tensor:
    """Where entry (i1 i2 .., j1 j2 ..) of the Gram lies among the packed moments."""
    index = torch.zeros(1, 1, dtype=torch.long)
    for width in widths:
        rows, columns = torch.triu_indices(width, width)
        place = torch.zeros(width, width, dtype=torch.long)
        place[rows, columns] = place[columns, rows] = torch.arange(len(rows))
        packed = width * (width + 1) // 2
        index = (index[:, None, :, None] * packed + place[None, :, None, :]).flatten(0, 1).flatten(1)
    return index.flatten().to(device)


# ----------------------------------------------------------------------------------------------------------------------
# Whether a second tensor explains noisy matches as well as the first one, although its residual is larger.


STEP = 1e-4
"""Size of the changes that probe the noise, in normalized coordinates."""
ENOUGH = 1000
"""Matches that the noise is read off."""
MARGIN = 6.0
"""Energy of the second tensor over what the noise alone gives it, below which nothing but noise speaks against it.  Measured: 0.3
to 4.5 where velocities lie in a plane or all lines belong to one rigid body; for general motion 10 to 25 at noise of 0.5 % of the
scene (60 matches), and four times as much at half of it."""
TURN = 0.08
"""Ratio of the residuals of the best tensor and the second, the angle by which noise turns one to the other, up to which an
invariant that resolves noise keeps its best.  Measured for the homography tensor at 0.5 px: 0.004 to 0.02 where all points stand
still, 0.02 to 0.1 for general motion (30 to 300 matches), 0.15 to 0.7 where all make equal steps of 40 px (80 and 300 matches,
errors of 4 to 32 px)."""


def within_noise(
    primitives: Sequence[Primitive],
    views: Sequence[Tensor],
    weights: Tensor,
    static: Tensor | None,
    basis: Tensor,
    resolves: bool,
    second: Tensor | None = None,
) -> Tensor:
    r"""Whether the residual of the second best tensor is explained by the noise that the best one shows. views ``(b, n, ...)``,
    weights ``(b, n)``, static ``(b, n)``, basis ``(b, nullity, D)``, second ``(b, 1, D)`` -> ``(b,)``."""
    if second is None:
        g = gram(primitives, views, weights, static)
        # the null space at the other end of the spectrum: where its eigenvalue and the next one are both lost in rounding, an
        # eigenvector beside it is one beside it all the same
        away = g + g.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None] * (basis.mT @ basis)
        second = eigh(away)[1][..., :1].mT
    # a part of very many matches tells as much about the noise
    step = -(-weights.shape[1] // ENOUGH)
    views, weights = [x[:, ::step] for x in views], weights[:, ::step]
    static = None if static is None else static[:, ::step]
    # a generator of its own: the same matches get the same answer, on any device and beside any others, and the caller's random
    # numbers stay
    draw = torch.Generator().manual_seed(0)
    shifts = [STEP * torch.randn(x.shape[1:], generator=draw, dtype=x.dtype).to(x.device).expand_as(x) for x in views]
    moved = [p.add_noise(x, change) for p, x, change in zip(primitives, views, shifts, strict=True)]
    forms = torch.cat([basis, second], dim=-2)
    values = _values(primitives, views, weights, static, forms)
    changes = (_values(primitives, moved, weights, static, forms) - values).square()
    energy, change = values.square().mean(-2), changes.mean(-2).clamp(min=1e-300)
    left, other = energy[:, :-1].mean(-1), energy[:, -1]
    noise, following = left / change[:, :-1].mean(-1), other / change[:, -1]
    near = following <= MARGIN * noise
    return near & (left > TURN**2 * other) if resolves else near


def _values(
    primitives: Sequence[Primitive], views: Sequence[Tensor], weights: Tensor, static: Tensor | None, forms: Tensor
) -> Tensor:
    """Products of the estimation matrix with forms ``(b, k, D)``, slot by slot where it has slots: ``(b, rows, k)``."""
    if static is not None or len(primitives) == 1:
        return estimation_matrix(primitives, views, weights, static) @ forms.mT
    values = forms.mT  # (b, D, k), then (b, n, rows, columns that are left, k)
    for p, x in zip(primitives, views, strict=True):
        vectors = p.vectors(x)
        folded = values.unflatten(-2, (p.width, -1))
        if values.ndim == 3:
            values = torch.einsum("bnrw,bwdk->bnrdk", vectors, folded)
        else:
            values = torch.einsum("bnrw,bnswdk->bnsrdk", vectors, folded).flatten(2, 3)
    return (values[..., 0, :] * weights.sqrt()[..., None, None]).flatten(1, 2)
