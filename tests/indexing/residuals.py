"""The residual of windows to exemplars that nobody keeps: what banks are held against."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from indexing.action.bank import Bank, Copy, JointMetric, Windows, fused_residuals, planes_of


def fused_residual(query: Windows, copies: Sequence[Windows], metric: JointMetric, terms: tuple[str, ...] = ("epi",)) -> Tensor:
    """``(Q, N)``, the best over an exemplar's copies."""
    return fused_residuals(query, [Bank([Copy(windows) for windows in copies], planes_of(metric))], [terms])[0]
