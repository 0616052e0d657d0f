"""Correlations of two sequences by FFT: exact at the lags asked for, in memory that does not grow with the length."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

Lags = tuple[int, int]
Lift = Callable[[Tensor], Tensor]

ROUNDING = 64 * torch.finfo(torch.float64).eps  # of the product of the norms: what an FFT leaves of a sum that is zero
ELEMENTS = 2**24  # numbers in one piece of work: 128 MB


def correlate(a: Tensor, b: Tensor, lags: Lags, lift: Lift, per_point: bool = False) -> Tensor:
    r"""Products of two lifted sequences, summed over the frames that overlap and over points, at all lags.

    .. math:: C_{pq}(s) = \sum_{ij} u_{jp}(a_i)\, u_{jq}(b_{i+s})

    Frames of one block of the first sequence meet the frames of the second within the lags; the transforms of the blocks add up
    before the one way back.

    Args:
        a: ``(b, T1, n, c)`` float64.
        b: ``(b, T2, n, c')``.
        lags: first and last lag, in frames.
        lift: takes frames ``(b, t, n, c)`` to what is multiplied, ``(b, n, p, t)``: of one block at a time.
        per_point: no sum over the points.

    Returns:
        ``(b, [n,] p, q, L)``, 0 where nothing overlaps.  Rounding is relative to the norms of whole sequences.

    Source: the correlation theorem; overlap-save for long sequences.

    Example:
        >>> import torch
        >>> a = torch.tensor([1.0, 2.0], dtype=torch.float64)[None, :, None, None]
        >>> correlate(a, a, (-1, 2), lambda x: x.movedim(1, -1)).flatten().abs().round(decimals=9).tolist()
        [2.0, 5.0, 2.0, 0.0]
    """
    frames1, frames2 = a.shape[1], b.shape[1]
    lo, hi = max(lags[0], 1 - frames1), min(lags[1], frames2 - 1)
    p, q = lift(a[:1, :1]).shape[2], lift(b[:1, :1]).shape[2]
    points = a.shape[2] if per_point else 1
    result = a.new_zeros(len(a), points, p, q, lags[1] - lags[0] + 1)
    if lo <= hi:
        # frames that no lag pairs with anything are left out
        early, late = max(0, -hi), max(0, lo)
        first, second = a[:, early : frames2 - lo], b[:, late : frames1 + hi]
        found = result[..., lo - lags[0] : hi - lags[0] + 1]
        _fill(found, first, second, lo + early - late, lift, per_point)
    return result if per_point else result[:, 0]


def _fill(found: Tensor, a: Tensor, b: Tensor, lo: int, lift: Lift, per_point: bool) -> None:
    """Problems, and rows of the first sequence, in pieces that fit into memory."""
    count, points, p, q, lags = found.shape
    length, block = _lengths(a.shape[1], b.shape[1], lo, lo + lags - 1)
    for problem in range(count):
        rows = max(1, ELEMENTS // (points * q * length))
        for row in range(0, p, rows):
            chosen = slice(row, row + rows)
            upper = partial(_rows_of, lift, chosen)
            spectrum = _spectrum(a[problem], b[problem], (lo, lo + lags - 1), (length, block), (upper, lift), per_point)
            whole = torch.fft.irfft(spectrum, n=length)
            # in one block the lags count from the first frame, and negative ones from the end; in several from the first lag
            negative = -lo if block >= a.shape[1] else 0
            found[problem, :, chosen, :, :negative] = whole[..., length - negative :]
            found[problem, :, chosen, :, negative:] = whole[..., : lags - negative]


def _rows_of(lift: Lift, chosen: slice, x: Tensor) -> Tensor:
    return lift(x)[:, :, chosen]


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
    whole = max(frames2 - lo, frames1 + hi)
    width = hi - lo
    length = max(3 * (width + 1), 2048)
    if 2 * whole <= 3 * length:
        return _good(whole), frames1
    length = _good(length)
    return length, length - width


def _good(least: int) -> int:
    """The next length of the form 2^a 3^b 5^c, even."""
    best = 2 ** max((least - 1).bit_length(), 1)
    five = 1
    while five < best:
        three = five
        while three < best:
            two = three * 2 ** max((-(-least // three) - 1).bit_length(), 1)
            best = min(best, two)
            three *= 3
        five *= 5
    return best
