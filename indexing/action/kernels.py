"""The kernels that scorer B learns with: what a turn about the vertical leaves alone, and what is bound to the view."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from indexing.action.bank import (
    CHANNELS,
    TINY,
    Bank,
    Copy,
    Description,
    Windows,
    entries,
    epipolar_correlation,
    factorize,
    flatten_channel,
    min_over_copies,
    order_free_moments,
)

KERNEL_WIDTH = 0.5  # over the median distance; 1 costs 1-2 %
MAX_SCALE_WINDOWS = 600  # that set the kernel scales: their median is stable to 1 % from 300 on


@dataclass
class Kernels:
    r"""Mean of Gaussian-like kernels :math:`K = \tfrac1k \sum_k \exp(-d_k / s_k)` on cosine distances :math:`d_k`."""

    one_side: bool = False
    scales: Tensor | None = None

    @property
    def count(self) -> int:
        """How many distances there are."""
        return (4 * len(CHANNELS) + 6) if self.one_side else (2 * len(CHANNELS) + 3)

    def fit(self, windows: Windows) -> Tensor:
        """Set the scales from training windows and return their ``(N, N)`` kernel matrix."""
        chosen = windows[torch.arange(0, len(windows), max(1, len(windows) // MAX_SCALE_WINDOWS))]
        tables = min_over_copies(
            chosen, [self.bank(chosen)], lambda left, right: list(self._distances(left, right)), [1.0] * self.count
        )
        off = ~torch.eye(len(chosen), dtype=torch.bool, device=chosen.values.device)
        self.scales = KERNEL_WIDTH * torch.stack([table[off].median() for table in tables]).clamp(min=1e-6 / KERNEL_WIDTH)
        return self(windows, windows)

    def bank(self, windows: Windows) -> Bank:
        """Windows that queries are compared with again and again."""
        return Bank([Copy(windows)], lambda _: self._describe)

    def __call__(self, query: Windows, bank: Windows | Bank) -> Tensor:
        """``(Q, E)`` kernel matrix."""
        if self.scales is None:
            raise ValueError("the kernels have no scales yet; fit them first")
        slopes = (-1.0 / self.scales).tolist()

        def total(left: Description, right: Description) -> list[Tensor]:
            kernels = (distance.mul_(slope).exp_() for slope, distance in zip(slopes, self._distances(left, right), strict=True))
            out = next(kernels)
            for kernel in kernels:
                out.add_(kernel)
            return [out.div_(len(slopes))]

        return min_over_copies(query, [bank if isinstance(bank, Bank) else self.bank(bank)], total, [0.0])[0]

    def _describe(self, values: Tensor) -> Description:
        """Unit images and how much larger they are than their heights, where bases are compared these; then moments."""
        parts = []
        for name in CHANNELS:
            image = flatten_channel(values, name, None)
            unit = unit_rows(image).view_as(image)
            parts += [unit, 1 / unit[:, 1].norm(dim=1, keepdim=True).clamp(min=TINY)]
            parts += [factorize(image)[0]] if self.one_side else []
        for whole_image in (False, True)[: 1 + self.one_side]:
            parts += [unit_rows(moment) for moment in order_free_moments(values, whole_image)]
        return Description(tuple(parts))

    def _distances(self, left: Description, right: Description) -> Iterator[Tensor]:
        """``(Q, E)`` distances, one kernel after the other."""
        each = 3 if self.one_side else 2
        pairs = list(zip(left.parts, right.parts, strict=True))
        for i in range(0, each * len(CHANNELS), each):
            (a, b), (ratio, other) = pairs[i], pairs[i + 1]
            heights = a[:, 1] @ b[:, 1].mT
            whole = (a[:, 0] @ b[:, 0].mT).add_(heights)
            yield _distance(heights.mul_(ratio).mul_(other.T))
            yield _distance(whole)
            if self.one_side:
                c = entries(*pairs[i + 2])
                yield _distance(epipolar_correlation(c))
                norm = sum((x.square() for x in c[1:]), start=c[0].square())
                yield _distance(norm.mul_(0.5).sqrt_())
        for a, b in pairs[each * len(CHANNELS) :]:
            yield _distance(a @ b.mT)


def _distance(correlation: Tensor) -> Tensor:
    return correlation.neg_().add_(1.0).clamp_(min=0.0)


def cosine_distance(a: Tensor, b: Tensor) -> Tensor:
    """``(Q, E)`` 1 - cosine of the angle between rows."""
    return _distance(unit_rows(a) @ unit_rows(b).mT)


def unit_rows(x: Tensor) -> Tensor:
    return torch.nn.functional.normalize(x.flatten(1), dim=1)
