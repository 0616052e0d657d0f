"""How much two cameras' rows share at a lag: the measures of the thesis's chapter 7, of the covariances at all lags at once.

Points of the second camera are fixed linear combinations of those of the first at every moment.  At the right lag, and only
there, the row spaces of the two matrices of tracks :math:`A` and :math:`B` meet, so that

* ``"rank"``: the rank of :math:`[A; B]` is least.  With noise no rank is: what lies beyond it is measured.
* ``"log_determinant"``: :math:`\\tfrac12 \\log |C_{aa} + I| |C_{bb} + I| / |C + I|`, in units of noise, is largest: the rank
  counted smoothly, and the information that Gaussian rows have about each other.
* ``"principal_angles"``: most angles between the spaces are zero: the sum of their squared cosines is largest.

Source: thesis, chapter 7; Wolf and Zomet 2006, Wide baseline matching between unsynchronized video sequences; Björck and Golub
1973.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from dyntorch.numerics.lags import lag_covariances
from dyntorch.tasks.synchronize.options import RowSpaceOptions

Measure = Literal["auto", "rank", "log_determinant", "principal_angles"]
MEASURES: tuple[Measure, ...] = ("auto", "rank", "log_determinant", "principal_angles")


@dataclass(frozen=True)
class LagCovariances:
    """Covariances of a's and b's rows over the overlap of every lag, about its mean."""

    aa: Tensor  # ``(L, p, p)``
    bb: Tensor  # ``(L, q, q)``
    ab: Tensor  # ``(L, p, q)``
    counts: Tensor  # ``(L,)`` frames

    @staticmethod
    def of(a: Tensor, b: Tensor, lags: tuple[int, int]) -> LagCovariances:
        """Of rows ``(Ta, p)`` and ``(Tb, q)`` at the lags from the first to the last."""
        return LagCovariances(*lag_covariances(a, b, lags, None))

    def scaled(self, variances: tuple[float, float]) -> LagCovariances:
        """In units of these variances of a's and of b's noise."""
        va, vb = variances
        return LagCovariances(self.aa / va, self.bb / vb, self.ab / math.sqrt(va * vb), self.counts)

    def combined(self, a: Tensor, b: Tensor) -> LagCovariances:
        """Of combinations ``(p', p)`` of a's rows and ``(q', q)`` of b's."""
        return LagCovariances(a @ self.aa @ a.mT, b @ self.bb @ b.mT, a @ self.ab @ b.mT, self.counts)

    @property
    def joint(self) -> Tensor:
        """``(L, p + q, p + q)``."""
        return torch.cat([torch.cat([self.aa, self.ab], dim=-1), torch.cat([self.ab.mT, self.bb], dim=-1)], dim=-2)


def shared(moments: LagCovariances, judged: Tensor, measure: Measure, above: float = RowSpaceOptions().above) -> Tensor:
    r"""How much the rows share at every lag ``(L,)``, more is better; in units of noise of variance 1."""
    if measure == "rank":
        return _beyond_rank(moments, judged, above)
    if measure == "principal_angles":
        return _angles(moments, judged, above)
    if measure not in MEASURES:
        raise ValueError(f"measure must be one of {', '.join(MEASURES)}, got {measure!r}")
    return 0.5 * (_log_determinant(moments.aa) + _log_determinant(moments.bb) - _log_determinant(moments.joint))


def _log_determinant(c: Tensor) -> Tensor:
    low = torch.linalg.cholesky_ex(c + torch.eye(c.shape[-1], dtype=c.dtype, device=c.device)).L
    return 2 * low.diagonal(dim1=-2, dim2=-1).log().sum(-1)


def _beyond_rank(moments: LagCovariances, judged: Tensor, above: float) -> Tensor:
    """Less of what the least rank at any lag leaves is better."""
    values = torch.linalg.eigvalsh(moments.joint).clamp(min=0.0).flip(-1)
    ranks = (values > above).sum(-1)
    rank = int(ranks[judged].min()) if bool(judged.any()) else 0
    rest = values[:, rank:].sum(-1) if rank < values.shape[1] else values.new_zeros(len(values))
    return -0.5 * (rest + 1).log()


def _angles(moments: LagCovariances, judged: Tensor, above: float) -> Tensor:
    """Sum of squared cosines between the spaces of most motion, of as many dimensions as rise above the noise."""
    one, two = (_basis(c, judged, above) for c in (moments.aa, moments.bb))
    return (one.mT @ moments.ab @ two).square().sum((-2, -1))


def _basis(c: Tensor, judged: Tensor, above: float) -> Tensor:
    """``(L, p, k)`` combinations of rows that are orthonormal over time."""
    values, vectors = torch.linalg.eigh(c)
    rank = int((values[judged] > above).sum(-1).max()) if bool(judged.any()) else 0
    return vectors[..., c.shape[-1] - rank :] * values[..., None, c.shape[-1] - rank :].clamp(min=1e-12).rsqrt()
