"""All pairs of windows compared at once: residuals between views, fused, and the similarity kernels for learning.

``nearest`` is what scorer A stands on (the epipolar residual, free of the viewpoint), ``Kernels`` what scorer B stands on
(heights, which a turn about the vertical leaves alone, and the whole image, which is bound to the view).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch import canonical_correlation, orthonormal_basis
from indexing.shape.channels import CHANNELS, JointMetric, order_free

NEAREST = ("clip", "frame", "motion")  # channels of the epipolar residual; velocity adds nothing there
EPSILON = 1e-3  # added to residuals before the log: the noise floor (1e-4 gives the same accuracy)
PAIRS_AT_ONCE = 2_000_000  # pairs of windows in flight: bounds memory, and keeps the intermediate matrices in cache


@dataclass(frozen=True)
class Windows:
    """Batched windows and the joints that were seen in each.

    values: ``(N, length, joints, dims)`` float32 without NaN; seen: ``(N, joints)`` bool.
    """

    values: Tensor
    seen: Tensor

    def __len__(self) -> int:
        return len(self.values)

    def __getitem__(self, index: Tensor | slice) -> Windows:
        return Windows(self.values[index], self.seen[index])

    def to(self, device: torch.device | str) -> Windows:
        """The same windows on another device."""
        return Windows(self.values.to(device), self.seen.to(device))

    def patterns(self) -> Iterator[tuple[Tensor, Tensor]]:
        """``(indices, joints seen)`` of every group of windows with the same joints seen."""
        if bool(self.seen.all()):
            yield torch.arange(len(self), device=self.values.device), self.seen.new_ones(self.seen.shape[1])
            return
        rows, group = self.seen.unique(dim=0, return_inverse=True)
        for i, joints in enumerate(rows):
            yield (group == i).nonzero()[:, 0], joints


def stack(parts: list[Windows]) -> Windows:
    """Windows end to end."""
    return Windows(torch.cat([part.values for part in parts]), torch.cat([part.seen for part in parts]))


COMMON = 3  # joints that two windows must share: two always fit one another


def between(query: Windows, bank: Windows, compare: Callable[[Tensor, Tensor, Tensor | slice], Tensor], worst: float) -> Tensor:
    """Fill a ``(queries, bank)`` table from ``compare(query values, bank values, joints)``, on the joints both sides saw.

    Windows are grouped by which joints were seen, so that a comparison is always exact on the joints it has; pairs that
    share fewer than three joints get the value ``worst``.
    """
    groups = list(bank.patterns())
    out = query.values.new_empty(len(query), len(bank))
    for rows, seen in query.patterns():
        for columns, known in groups:
            both = seen & known
            if int(both.sum()) < min(COMMON, len(both)):
                out[rows[:, None], columns] = worst
                continue
            joints: Tensor | slice = slice(None) if bool(both.all()) else both.nonzero()[:, 0]
            right = bank.values[columns][:, :, joints]
            step = max(1, PAIRS_AT_ONCE // max(1, len(columns)))
            for at in range(0, len(rows), step):
                part = rows[at : at + step]
                out[part[:, None], columns] = compare(query.values[part][:, :, joints], right, joints)
    return out


def fused_residual(
    query: Windows,
    copies: list[Windows],
    metric: JointMetric,
    channels: tuple[str, ...] = NEAREST,
    weights: Tensor | None = None,
    terms: tuple[str, ...] = ("epi",),
) -> Tensor:
    r"""Residual of every query to every exemplar, the best over the exemplar's copies (crops, mirror images).

    .. math:: D(q, e) = \min_{\text{copies}} \sum_{c} w_c \sum_{\text{terms}} \log(r_c(q, e) + \epsilon)

    Terms: ``epi`` :math:`1 - s_1(U_q, U_e)`, the largest canonical correlation between the channel spaces under the joint
    metric (any viewpoint); ``up`` :math:`1 - \cos(y_q, y_e)`, heights only (upright cameras, turned about the vertical);
    ``nn`` :math:`1 - \cos(X_q, X_e)`, the whole image (one viewpoint).

    Args:
        query: ``Q`` windows of images; copies: each with the same ``E`` exemplars; weights: ``(channels,)``, 1 by default.

    Returns:
        ``(Q, E)``; very negative = the two can be views of one action.

    Source: thesis chapter 7 (rank of stacked measurements).
    """

    def product(left: Tensor, right: Tensor, joints: Tensor | slice) -> Tensor:
        total = left.new_ones(len(left), len(right))
        for i, name in enumerate(channels):
            a, b = metric.apply(left, name, joints), metric.apply(right, name, joints)
            for term in terms:
                residual = _TERMS[term](a, b).add_(EPSILON)
                if weights is not None and weights[i] != 1:
                    residual = residual.pow_(float(weights[i]))
                total.mul_(residual)
        return total

    total_weight = len(channels) if weights is None else float(weights.sum())
    worst = (1.0 + EPSILON) ** (len(terms) * total_weight)
    best: Tensor | None = None
    for copy in copies:
        one = between(query, copy, product, worst)
        best = one if best is None else torch.minimum(best, one)
    if best is None:
        raise ValueError("no exemplar to compare with")
    return best.log_()


def _epipolar(a: Tensor, b: Tensor) -> Tensor:
    return canonical_correlation(orthonormal_basis(a), orthonormal_basis(b)).neg_().add_(1.0)


def _heights(a: Tensor, b: Tensor) -> Tensor:
    return _cosine_distance(a[..., 1], b[..., 1])


def _images(a: Tensor, b: Tensor) -> Tensor:
    return _cosine_distance(a.flatten(1), b.flatten(1))


_TERMS: dict[str, Callable[[Tensor, Tensor], Tensor]] = {"epi": _epipolar, "up": _heights, "nn": _images}


@dataclass
class Kernels:
    r"""Mean of Gaussian-like kernels :math:`K = \tfrac1k \sum_k \exp(-d_k / s_k)` on cosine distances :math:`d_k`.

    The distances: heights in each channel, the whole image in each channel, and the order-free moments of the heights; all
    are one GEMM of unit vectors, and the kernel is positive definite.  ``one_side`` adds what helps where all cameras stand
    on one side: the moments of the whole image, and the (indefinite) epipolar and affine-invariant distances (JHMDB .81 ->
    .87).  :math:`s_k` is half the median distance between training windows (twice that costs 1-2 %).
    """

    metric: JointMetric
    one_side: bool = False
    scales: Tensor | None = None

    def fit(self, windows: Windows) -> Tensor:
        """Set the scales from training windows and return their ``(N, N)`` kernel matrix."""
        chosen = windows[torch.arange(0, len(windows), max(1, len(windows) // SCALE_SAMPLE))]
        off = ~torch.eye(len(chosen), dtype=torch.bool, device=chosen.values.device)
        count = len(list(self._distances(chosen.values[:2], chosen.values[:2], slice(None))))
        scales = []
        for k in range(count):

            def one(left: Tensor, right: Tensor, joints: Tensor | slice, k: int = k) -> Tensor:
                return next(d for i, d in enumerate(self._distances(left, right, joints)) if i == k)

            scales.append(0.5 * between(chosen, chosen, one, worst=1.0)[off].median().clamp(min=1e-6))
        self.scales = torch.stack(scales)
        return self(windows, windows)

    def __call__(self, query: Windows, bank: Windows) -> Tensor:
        """``(Q, E)`` kernel matrix."""
        scales = self.scales
        if scales is None:
            raise ValueError("the kernels have no scales yet; fit them first")

        def total(left: Tensor, right: Tensor, joints: Tensor | slice) -> Tensor:
            out = left.new_zeros(len(left), len(right))
            for scale, distance in zip(scales, self._distances(left, right, joints), strict=True):
                out.add_(distance.div_(-scale).exp_())
            return out.div_(len(scales))

        return between(query, bank, total, worst=0.0)

    def _distances(self, left: Tensor, right: Tensor, joints: Tensor | slice) -> Iterator[Tensor]:
        """``(Q, E)`` distances between windows restricted to some joints, one kernel after the other."""
        for name in CHANNELS:
            a, b = (self.metric.apply(x, name, joints) for x in (left, right))
            yield _heights(a, b)
            yield _images(a, b)
            if self.one_side:
                u, v = orthonormal_basis(a), orthonormal_basis(b)
                yield 1 - canonical_correlation(u, v)
                yield 1 - canonical_correlation(u, v, shared=2)
        for whole_image in (False, True)[: 1 + self.one_side]:
            for a, b in zip(order_free(left, whole_image), order_free(right, whole_image), strict=True):
                yield _cosine_distance(a, b)


SCALE_SAMPLE = 600  # windows whose distances set the kernel scales: their median is stable to 1 % from 300 on


def _cosine_distance(a: Tensor, b: Tensor) -> Tensor:
    """``(Q, E)`` 1 - cosine of the angle between rows."""
    unit = torch.nn.functional.normalize
    return (unit(a, dim=1) @ unit(b, dim=1).mT).neg_().add_(1.0).clamp_(min=0.0)
