"""Covariances of sequences: of windows by running sums, and compressed to their leading directions."""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.algebra.correlation import ELEMENTS
from dyntorch.constants import constant

LEAST = 64  # frames in one piece of running sums


def compress(rows: Tensor, rank: int | None = None, noise: float | None = None) -> Tensor:
    r"""Coordinates of frames in the leading principal directions of their rows: fewer and uncorrelated.

    Args:
        rows: ``(*batch, T, p)`` finite.
        rank: how many directions; None to count those whose standard deviation is above ``noise``.
        noise: standard deviation of the noise in each row, in the unit of ``rows``.

    Returns:
        ``(*batch, T, r)`` float64 of mean 0; r is the largest count of the batch, at least 1.

    Raises:
        ValueError: neither or both of rank and noise, or a rank outside 1 to p.

    Example:
        >>> import torch
        >>> time = torch.linspace(0, 1, 20)[:, None]
        >>> compress(torch.cat([time, 2 * time, 3 * time + 1], dim=-1), noise=1e-3).shape
        torch.Size([20, 1])
    """
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
    r"""Covariances and means of the frames of a window, for many windows, by running sums.

    .. math:: C = \frac1m \sum_{start \le i < end} x_i x_i^T - \mu \mu^T, \qquad \mu = \frac1m \sum_{start \le i < end} x_i

    Args:
        x: ``(b, T, p)`` float64, best of mean 0: what lies before a window cancels.
        start: ``(L,)`` first frames.
        end: ``(L,)`` the frames past the last.

    Returns:
        ``(b, L, p, p)`` and ``(b, L, p)``, windows last in memory; 0 where a window is empty.

    Example:
        >>> import torch
        >>> x = torch.tensor([[[1.0], [3.0], [7.0]]])
        >>> window_covariances(x, torch.tensor([0, 1]), torch.tensor([2, 3]))[0].flatten().tolist()
        [1.0, 4.0]
    """
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
    size = max(ELEMENTS // (8 * b * pairs), LEAST)
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
