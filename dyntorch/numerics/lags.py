"""Moments, correlations and Grams of two sequences at all time lags, by FFT.

Lag s pairs frame i of the first sequence with frame i + s of the second.  Missing data have weight 0, so all sums are exact
whatever is missing.  Where the lags span much less than the sequences, these go through in blocks, whose memory does not
grow with the length.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from scipy.fft import next_fast_len
from torch import Tensor

from dyntorch.numerics.blocks import constant

# ----------------------------------------------------------------------------------------------------------------------
# Correlations of two sequences by FFT: exact at the lags asked for, in memory that does not grow with the length.


Lags = tuple[int, int]
Lift = Callable[[Tensor], Tensor]

ROUNDING = 64 * torch.finfo(torch.float64).eps  # of the product of the norms: what an FFT leaves of a sum that is zero
ELEMENTS = 2**24  # numbers in one piece of work: 128 MB


def correlate(a: Tensor, b: Tensor, lags: Lags, lift: Lift, per_point: bool = False) -> Tensor:
    r"""Products of two lifted sequences, summed over the frames that overlap and over points, at all lags. a ``(b, T1, n, c)``,
    b ``(b, T2, n, c')``, lift ``(b, t, n, c)`` -> ``(b, [n,] p, q, L)``."""
    frames1, frames2 = a.shape[1], b.shape[1]
    lo, hi = max(lags[0], 1 - frames1), min(lags[1], frames2 - 1)
    p, q = lift(a[:1, :1]).shape[2], lift(b[:1, :1]).shape[2]
    points = a.shape[2] if per_point else 1
    result = a.new_zeros(len(a), points, p, q, lags[1] - lags[0] + 1)
    if lo <= hi:
        # frames that no lag pairs with anything are left out
        early, late = max(0, -hi), max(0, lo)
        first, second = a[:, early : frames2 - lo], b[:, late : frames1 + hi]
        inside = result[..., lo - lags[0] : hi - lags[0] + 1]
        _fill(inside, first, second, lo + early - late, lift, per_point)
    return result if per_point else result[:, 0]


def _fill(target: Tensor, a: Tensor, b: Tensor, lo: int, lift: Lift, per_point: bool) -> None:
    """Problems, and rows of the first sequence, in pieces that fit into memory."""
    count, points, p, q, lags = target.shape
    length, block = _lengths(a.shape[1], b.shape[1], lo, lo + lags - 1)
    for problem in range(count):
        rows = max(1, ELEMENTS // (points * q * length))
        for row in range(0, p, rows):
            chosen = slice(row, row + rows)
            lifts = (lambda x, chosen=chosen: lift(x)[:, :, chosen]), lift
            spectrum = _spectrum(a[problem], b[problem], (lo, lo + lags - 1), (length, block), lifts, per_point)
            correlations = torch.fft.irfft(spectrum, n=length)
            # in one block the lags count from the first frame, and negative ones from the end; in several from the first lag
            negative = -lo if block >= a.shape[1] else 0
            target[problem, :, chosen, :, :negative] = correlations[..., length - negative :]
            target[problem, :, chosen, :, negative:] = correlations[..., : lags - negative]


def _spectrum(a: Tensor, b: Tensor, lags: Lags, sizes: tuple[int, int], lifts: tuple[Lift, Lift], per_point: bool) -> Tensor:
    """Transform of the correlations, ``(n or 1, p, q, frequencies)``: the blocks add up before the way back."""
    (lo, hi), (length, block) = lags, sizes
    single = block >= len(a)
    total = a.new_zeros(0, dtype=torch.complex128)
    for begin in range(0, len(a), block):
        first = torch.fft.rfft(lifts[0](a[None, begin : begin + block])[0], n=length).conj()
        early = 0 if single else begin + lo
        other = lifts[1](b[None, max(early, 0) : begin + block + hi])[0]
        second = torch.fft.rfft(other if early >= 0 else torch.nn.functional.pad(other, (-early, 0)), n=length)
        if begin == 0:
            points, p, frequencies = first.shape
            total = second.new_zeros(points if per_point else 1, p, second.shape[1], frequencies)
        for point in range(len(first)):
            total[point if per_point else 0].addcmul_(first[point, :, None], second[point, None])
    return total


def _lengths(frames1: int, frames2: int, lo: int, hi: int) -> tuple[int, int]:
    """Length of the transforms, and of the blocks of the first sequence."""
    # milliseconds for 2001 lags by transforms of 2, 3, 4, 8 times as many frames, and of all: 10,000 frames of 20 + 20 rows
    # 22, 33, 52, 93, 65; 100,000 frames of 4 + 4 rows 16, 9, 8, 9, 24
    full_length = max(frames2 - lo, frames1 + hi)
    width = hi - lo
    length = max(3 * (width + 1), 2048)
    if 2 * full_length <= 3 * length:
        return _fft_length(full_length), frames1
    length = _fft_length(length)
    return length, length - width


def _fft_length(least: int) -> int:
    """The next length of the form 2^a 3^b 5^c, even."""
    return 2 * int(next_fast_len(-(-least // 2), real=True))


# ----------------------------------------------------------------------------------------------------------------------
# Covariances of sequences: of windows by running sums, and compressed to their leading directions.


MIN_PIECE = 64  # frames in one piece of running sums


def compress(rows: Tensor, rank: int | None = None, noise: float | None = None) -> Tensor:
    r"""Coordinates of frames in the leading principal directions of their rows: fewer and uncorrelated. rows ``(*batch, T, p)``
    -> ``(*batch, T, r)``."""
    p = rows.shape[-1]
    if (rank is None) == (noise is None):
        raise ValueError(f"compress needs either rank or noise, got rank {rank} and noise {noise}: give one")
    if rank is not None and not 1 <= rank <= p:
        raise ValueError(f"rank must be from 1 to the {p} rows, got {rank}")
    centred = rows.double() - rows.double().mean(-2, keepdim=True)
    values, directions = torch.linalg.eigh(centred.mT @ centred / rows.shape[-2])
    if noise is not None:
        rank = max(int((values > noise**2).sum(-1).max()), 1)
    return centred @ directions[..., p - (rank or 1) :].flip(-1)


def window_covariances(x: Tensor, start: Tensor, end: Tensor) -> tuple[Tensor, Tensor]:
    r"""Covariances and means of the frames of a window, for many windows, by running sums. x ``(b, T, p)``, start ``(L,)``, end
    ``(L,)`` -> ``(b, L, p, p)``."""
    p = x.shape[-1]
    both = _sums_before(torch.cat([x.new_ones(*x.shape[:-1], 1), x], dim=-1), torch.cat([start, end]))
    sums = both[..., len(start) :] - both[..., : len(start)]
    sums *= 1 / sums[:, :1].clone().round().clamp(min=1.0)
    mean, packed = sums[:, 1 : p + 1], sums[:, p + 1 :]
    row = 0
    for i in range(p):  # row by row: the cache holds what is read again
        packed[:, row : row + p - i] -= mean[:, i : i + 1] * mean[:, i:]
        row += p - i
    whole = packed.index_select(1, _packing(p, x.device).flatten())
    return whole.unflatten(1, (p, p)).movedim(-1, 1), mean.mT


def _sums_before(x: Tensor, at: Tensor) -> Tensor:
    """Products of the coordinates j >= i, added up over the frames before each of ``at``: ``(b, pairs, len(at))``."""
    b, frames, p = x.shape
    pairs = p * (p + 1) // 2
    result = x.new_zeros(b, pairs, len(at))
    carry = x.new_zeros(b, pairs, 1)
    rows, columns = torch.triu_indices(p, p, device=x.device).unbind()
    size = max(ELEMENTS // (8 * b * pairs), MIN_PIECE)
    at = at.to(x.device).clamp(max=frames)
    for begin in range(0, frames, size):
        block = x[:, begin : begin + size]
        asked = ((at > begin) & (at <= begin + size)).nonzero()[:, 0]
        if len(asked):
            sums = _products(block).cumsum_(-1).add_(carry)
            result[..., asked] = sums.index_select(-1, at[asked] - begin - 1)
            carry = sums[..., -1:]
        else:
            carry = carry + (block.mT @ block)[:, rows, columns, None]
    return result


def _products(x: Tensor) -> Tensor:
    """Products ``(b, pairs, t)`` of the coordinates j >= i of frames ``(b, t, p)``."""
    channels = x.mT.contiguous()
    return torch.cat([channels[:, i : i + 1] * channels[:, i:] for i in range(x.shape[-1])], dim=1)


@constant
def _packing(size: int, device: torch.device) -> Tensor:
    """Which pair j >= i each entry of a symmetric matrix is."""
    rows, columns = torch.triu_indices(size, size)
    table = torch.zeros(size, size, dtype=torch.long)
    table[rows, columns] = table[columns, rows] = torch.arange(len(rows))
    return table.to(device)


def lag_products(a: Tensor, b: Tensor, lags: Lags | None = None) -> Tensor:
    r"""Products of two sequences of vectors, summed over the frames that overlap, at all lags. a ``(*batch, T1, p)``, b
    ``(*batch, T2, q)`` -> ``(*batch, L, p, q)``."""
    span = _span(a, b, lags, 2)
    shape, first, second = _flat(a, b, 2)
    return _restore_batch(correlate(first[:, :, None], second[:, :, None], span, lambda x: x.movedim(1, -1)).movedim(-1, 1), shape)


def epipolar_moments(
    x1: Tensor, x2: Tensor, lags: Lags | None = None, weights: tuple[Tensor, Tensor] | None = None, per_point: bool = False
) -> tuple[Tensor, Tensor]:
    r"""Moment matrices of the epipolar constraint of the same points in two cameras, at all lags. x1 ``(*batch, T1, n, 2)``, x2
    ``(*batch, T2, n, 2)``, weights ``(*batch, T1, n)`` -> ``(*batch, [n,] L, 9, 9)``."""
    if x1.ndim < 3 or x2.ndim < 3 or x1.shape[-2:] != x2.shape[-2:] or x1.shape[-1] != 2:
        raise ValueError(
            f"the same points in both cameras are (*batch, frames, n, 2) each, got {tuple(x1.shape)} and {tuple(x2.shape)}"
        )
    products, counts = _lifted_moments(x1, x2, _span(x1, x2, lags, 3), weights, _monomials, per_point)
    return _place_products(products, _epipolar_places(products.device)), counts


def resection_moments(
    x: Tensor, points: Tensor, lags: Lags | None = None, weights: tuple[Tensor, Tensor] | None = None, per_point: bool = False
) -> tuple[Tensor, Tensor]:
    r"""Moment matrices of the projection of the same points in space into one camera, at all lags. x ``(*batch, T1, n, 2)``,
    points ``(*batch, T2, n, 3)``, weights ``(*batch, T1, n)`` -> ``(*batch, [n,] L, 4, 4, 4)``."""
    if x.ndim < 3 or points.ndim < 3 or x.shape[-2] != points.shape[-2] or (x.shape[-1], points.shape[-1]) != (2, 3):
        raise ValueError(
            f"the same points are (*batch, frames, n, 2) in a camera and (*batch, frames, n, 3) in space, got {tuple(x.shape)} and "
            f"{tuple(points.shape)}"
        )
    span = _span(x, points, lags, 3)
    products, counts = _lifted_moments(x, points, span, weights, _of_camera_and_space, per_point)
    return _place_products(products, _resection_places(products.device)), counts


def lag_covariances(
    a: Tensor, b: Tensor, lags: Lags | None = None, weights: tuple[Tensor, Tensor] | None = None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    r"""Covariances of two sequences of vectors over the frames that overlap, about the means there, at all lags. a
    ``(*batch, T1, p)``, b ``(*batch, T2, q)``, weights ``(*batch, T1)`` -> ``(*batch, L, p, p)``."""
    lo, hi = _span(a, b, lags, 2)
    shape, first, second = _flat(a, b, 2)
    if weights is not None:
        w1, w2 = (_frame_weights(w, x, shape) for w, x in zip(weights, (first, second), strict=True))
        aa, bb, ab, counts = (_restore_batch(x, shape) for x in _weighted_covariances(first, second, (lo, hi), w1, w2))
        return aa, bb, ab, counts
    first, second = first - first.mean(1, keepdim=True), second - second.mean(1, keepdim=True)
    start, end = _overlap(a.shape[-2], b.shape[-2], (lo, hi))
    lag = torch.arange(lo, hi + 1)
    counts = (end - start).double().to(a.device)
    aa, mean_a = window_covariances(first, start, end)
    bb, mean_b = window_covariances(second, start + lag, end + lag)
    ab = lag_products(first, second, (lo, hi)) / counts.clamp(min=1.0)[:, None, None]
    ab -= mean_a[..., :, None] * mean_b[..., None, :]
    return _restore_batch(aa, shape), _restore_batch(bb, shape), _restore_batch(ab, shape), counts


def _monomials(x: Tensor) -> Tensor:
    """Points with weights ``(b, t, n, 3)`` to w xx, w xy, w yy, w x, w y, w: ``(b, n, 6, t)``."""
    x, y, w = x.movedim(1, -1).unbind(2)
    x, y = (torch.where(w > 0, value, 0.0) for value in (x, y))
    wx, wy = w * x, w * y
    return torch.stack([wx * x, wx * y, wy * y, wx, wy, w], dim=2)


def _of_camera_and_space(x: Tensor) -> Tensor:
    """Of a camera ``(b, t, n, 3)`` w (xx + yy), w x, w y, w; of space ``(b, t, n, 4)`` the ten products of X, Y, Z, 1, w last."""
    *place, w = x.movedim(1, -1).unbind(2)
    place = [torch.where(w > 0, value, 0.0) for value in place]
    weighted = [w * value for value in place]
    if len(place) == 2:
        return torch.stack([weighted[0] * place[0] + weighted[1] * place[1], *weighted, w], dim=2)
    return torch.stack([*(weighted[i] * place[j] for i in range(3) for j in range(i, 3)), *weighted, w], dim=2)


def _lifted_moments(
    x1: Tensor, x2: Tensor, span: Lags, weights: tuple[Tensor, Tensor] | None, lift: Lift, per_point: bool
) -> tuple[Tensor, Tensor]:
    """Sums of products of a monomial of each ``(*b, [n,] p q, L)``, whose last are the weights alone, and counts."""
    given: tuple[Tensor | None, Tensor | None] = weights or (None, None)
    x1, x2 = (torch.cat([x.double(), _point_weights(x, w)[..., None]], dim=-1) for x, w in zip((x1, x2), given, strict=True))
    shape, first, second = _flat(x1, x2, 3)
    products = correlate(first, second, span, lift, per_point).flatten(-3, -2)
    one, two = (x[..., -1] if per_point else x[..., -1].flatten(1)[..., None] for x in (first, second))
    counts = _counts(products[..., -1, :], one, two, per_point)
    products = torch.where(counts[..., None, :] > 0, products, 0.0)
    return _restore_batch(products, shape), _restore_batch(counts, shape)


def _counts(sums: Tensor, w1: Tensor, w2: Tensor, per_point: bool) -> Tensor:
    """Correlations ``(b, [n,] L)`` of weights ``(b, frames, n or 1)`` without the rounding that FFT leaves."""
    # what has no overlap sums to rounding, and has to be 0
    norms = w1.square().sum(1).sqrt() * w2.square().sum(1).sqrt()
    counts = torch.where(sums > ROUNDING * (norms[..., None] if per_point else norms), sums, 0.0)
    binary = all(bool(((w == 0) | (w == 1)).all()) for w in (w1, w2))
    return counts.round() if binary else counts


def _point_weights(x: Tensor, weights: Tensor | None) -> Tensor:
    seen = x.isfinite().all(-1).double()
    if weights is None:
        return seen
    if weights.shape != x.shape[:-1]:
        raise ValueError(f"weights must be {tuple(x.shape[:-1])} for points {tuple(x.shape)}, got {tuple(weights.shape)}")
    return _valid(weights) * seen


def _frame_weights(weights: Tensor, x: Tensor, shape: tuple[int, ...]) -> Tensor:
    if weights.ndim < 1 or weights.shape[-1] != x.shape[1]:
        raise ValueError(f"weights must be (*batch, {x.shape[1]}), one per frame, got {tuple(weights.shape)}")
    return _valid(weights).expand(*shape, -1).reshape(-1, x.shape[1], 1)


def _valid(weights: Tensor) -> Tensor:
    if not bool((weights.isfinite() & (weights >= 0)).all()):
        raise ValueError("weights must be finite and not negative: give 0 where a point is missing")
    return weights.double()


def _place_products(found: Tensor, place: Tensor) -> Tensor:
    """Matrices ``(*, L, ..., d, d)`` of the sums ``(*, p q, L)``; the lags stay last in memory."""
    return found.index_select(-2, place.flatten()).unflatten(-2, place.shape).movedim(-1, -1 - place.ndim)


@constant
def _epipolar_places(device: torch.device) -> Tensor:
    """Which of the 6 x 6 sums each entry of a ``(9, 9)`` moment matrix is: row and column are 3 (entry of x2~) + entry of x1~."""
    entry = torch.tensor([[0, 1, 3], [1, 2, 4], [3, 4, 5]])  # of xx, xy, yy, x, y, 1
    return (6 * entry[None, :, None, :] + entry[:, None, :, None]).reshape(9, 9).to(device)


@constant
def _resection_places(device: torch.device) -> Tensor:
    """Which of the 4 x 10 sums each entry of the ``(4, 4, 4)`` moments is."""
    entry = torch.tensor([[0, 1, 2, 6], [1, 3, 4, 7], [2, 4, 5, 8], [6, 7, 8, 9]])  # of XX, XY, XZ, YY, YZ, ZZ, X, Y, Z, 1
    return (10 * torch.tensor([3, 1, 2, 0])[:, None, None] + entry).to(device)


def _span(a: Tensor, b: Tensor, lags: Lags | None, dims: int) -> Lags:
    if a.ndim < dims or b.ndim < dims or a.shape[-dims] == 0 or b.shape[-dims] == 0:
        raise ValueError(f"sequences need at least one frame each, got {tuple(a.shape)} and {tuple(b.shape)}")
    lo, hi = (1 - a.shape[-dims], b.shape[-dims] - 1) if lags is None else lags
    if lo > hi:
        raise ValueError(f"lags must be (first, last) with first <= last, got {lags}")
    return lo, hi


def _flat(a: Tensor, b: Tensor, dims: int) -> tuple[tuple[int, ...], Tensor, Tensor]:
    """The common batch shape, and both sequences in float64 with one batch dimension."""
    shape = np.broadcast_shapes(a.shape[:-dims], b.shape[:-dims])
    first, second = (x.double().expand(*shape, *x.shape[-dims:]).reshape(-1, *x.shape[-dims:]) for x in (a, b))
    return tuple(shape), first, second


def _restore_batch(x: Tensor, shape: tuple[int, ...]) -> Tensor:
    return x.reshape(*shape, *x.shape[1:])


def _overlap(frames1: int, frames2: int, lags: Lags) -> tuple[Tensor, Tensor]:
    """First frame of the first sequence in the overlap, and the one past the last."""
    lag = torch.arange(lags[0], lags[1] + 1)
    start = (-lag).clamp(min=0, max=frames1)
    return start, torch.maximum((frames2 - lag).clamp(max=frames1), start)


def _weighted_covariances(a: Tensor, b: Tensor, span: Lags, w1: Tensor, w2: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Everything is a product of a weighted monomial of one sequence with one of the other; weights are ``(b, frames, 1)``."""
    a, b = _subtract_mean(a, w1), _subtract_mean(b, w2)
    sums = lag_products(torch.cat([w1 * a, w1], dim=-1), torch.cat([w2 * b, w2], dim=-1), span)
    counts = _counts(sums[..., -1, -1], w1, w2, per_point=False)
    share = torch.where(counts > 0, 1 / torch.where(counts > 0, counts, 1.0), 0.0)[..., None, None]
    mean_a, mean_b = sums[..., :-1, -1:] * share, sums[..., -1:, :-1].mT * share
    aa = lag_products(_squares(a, w1), w2, span).unflatten(2, (a.shape[-1], -1))[..., 0]
    bb = lag_products(w1, _squares(b, w2), span).unflatten(3, (b.shape[-1], -1))[:, :, 0]
    ab = sums[..., :-1, :-1]
    return aa * share - mean_a * mean_a.mT, bb * share - mean_b * mean_b.mT, ab * share - mean_a * mean_b.mT, counts


def _squares(x: Tensor, weights: Tensor) -> Tensor:
    return ((weights * x)[..., :, None] * x[..., None, :]).flatten(-2)


def _subtract_mean(x: Tensor, weights: Tensor) -> Tensor:
    x = torch.where(weights > 0, x, 0.0)
    total = weights.sum(1, keepdim=True)
    mean = (weights * x).sum(1, keepdim=True) / torch.where(total > 0, total, 1.0)
    return torch.where(weights > 0, x - mean, 0.0)
