"""The residual of windows to exemplars that nobody keeps: what banks are held against."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from indexing.action.bank import Bank, Copy, JointMetric, Windows, fused_residuals, planes_of
from indexing.action.joint_weights import JointWeights


def fused_residual(
    query: Windows,
    copies: Sequence[Windows],
    metric: JointMetric,
    terms: tuple[str, ...] = ("epi",),
    powers: Sequence[float] = (1.0, 1.0, 1.0),
) -> Tensor:
    """``(Q, N)``, the best over an exemplar's copies."""
    bank = Bank([Copy(windows) for windows in copies], planes_of(metric))
    return fused_residuals(query, [bank], [terms], powers=powers)[0]


def weighted_residual(
    query: Windows, copies: Sequence[Windows], metric: JointMetric, labels: Tensor, weights: JointWeights | None
) -> Tensor:
    """``(Q, N)`` the same of the epipolar residual under weights of joints; each class's exemplars under its own."""
    if weights is None:
        return fused_residual(query, copies, metric)
    (banks,) = weights.banks([[Copy(windows) for windows in copies]], metric, labels)
    return fused_residuals(query, banks, [("epi",)], powers=weights.channels.tolist())[0]
