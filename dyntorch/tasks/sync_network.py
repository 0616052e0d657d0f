"""The shifts of pairs of cameras as numbers: candidates, times from the middle of what a camera shares with others, and costs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite, log

import torch
from torch import Tensor

from dyntorch.tasks.shift import Shift

PEAKS = 8
"""Candidates per pair."""
FRAME = 0.25
"""Of a frame: error of a right peak that no standard deviation of one pair knows of (view-dependent keypoints)."""
SURE, UNSURE = (0.95, 0.99), (0.05, 0.5)
"""Range of the probability that the best peak is right, of pairs that decide and that refused: their confidence within it."""
RATE = 5e-5
"""Standard deviation of the rate of a pair that did not search it, next to pairs that did: what quartz clocks differ by."""
FIXED = 1e-9
"""The same where no pair searched it: rates stay as given."""
RANGE = 10.0
"""Seconds that the offset of a pair without a curve may have."""


@dataclass(frozen=True)
class Network:
    """The pairs as numbers: E pairs, K candidates each."""

    cameras: int
    ends: Tensor
    """``(E, 2)`` long."""
    times: Tensor
    """``(E, K + 1)``: u_i of the moment, then the candidates' u_j; NaN = no such candidate."""
    means: Tensor
    """``(cameras,)``: the times that all are counted from."""
    sigma: Tensor
    """``(E,)`` seconds."""
    slack: Tensor
    """``(E,)`` seconds: what a right peak may be off by, with ``sigma``."""
    rate: Tensor
    """``(E,)`` logarithms."""
    rate_sigma: Tensor
    cost: Tensor
    """``(E, K)``: -log of the probability that a candidate is the right one; infinite where there is none."""
    none: Tensor
    """``(E,)``: the same of none, times the density of a shift anywhere by that of a right one."""
    saving: Tensor
    """``(cameras,)``: -log of that density, once: a camera without a clock has no place to be explained."""
    weight: Tensor
    """``(E,)`` of the squared residual: the probability that the best peak is right."""

    @property
    def searched(self) -> bool:
        """Whether some pair searched its rate."""
        return bool((self.rate_sigma > FIXED).any())


def network(shifts: Mapping[tuple[int, int], Shift], cameras: int) -> Network:
    """The pairs' candidates, times and costs."""
    ends, every = torch.tensor(list(shifts)).reshape(-1, 2), list(shifts.values())
    found = [_candidates(shift) for shift in every]
    offsets = torch.stack([offset for offset, _ in found])
    center = torch.tensor([_finite(shift.center, 0.0) for shift in every], dtype=torch.float64)
    moments = torch.cat([center[:, None], center[:, None] + offsets], dim=1)
    total, count = torch.zeros(2, cameras, dtype=torch.float64).unbind(0)
    for column in (0, 1):
        known = moments[:, column].isfinite().double()
        total = total.index_add(0, ends[:, column], moments[:, column].nan_to_num() * known)
        count = count.index_add(0, ends[:, column], known)
    means = total / count.clamp(min=1)
    moments = moments - torch.cat([means[ends[:, :1]], means[ends[:, 1:]].expand(-1, offsets.shape[1])], dim=1)
    sigma = torch.tensor([max(_finite(shift.sigma, _span(shift)), 0.0) for shift in every], dtype=torch.float64)
    slack = torch.tensor([FRAME / min(shift.fps) for shift in every], dtype=torch.float64)
    rate_sigma = torch.tensor([_finite(shift.rate_sigma, 1.0) for shift in every], dtype=torch.float64)
    rate_sigma = torch.where(rate_sigma > 0, rate_sigma, RATE if bool((rate_sigma > 0).any()) else FIXED)
    gain = torch.tensor([_span(shift) for shift in every], dtype=torch.float64) / (2.5 * torch.hypot(sigma, slack))
    gain = gain.clamp(min=1).log()
    cost, none = torch.stack([cost for _, cost in found]), torch.tensor([_wrong(shift) for shift in every], dtype=torch.float64)
    rate = torch.tensor([_finite(shift.rate, 1.0) for shift in every], dtype=torch.float64).log()
    weight = torch.tensor([_trust(shift) for shift in every], dtype=torch.float64)
    saving = torch.tensor([float(gain[(ends == one).any(-1)].min()) if (ends == one).any() else 0.0 for one in range(cameras)])
    return Network(cameras, ends, moments, means, sigma, slack, rate, rate_sigma, cost, gain + none, saving, weight)


def _candidates(shift: Shift) -> tuple[Tensor, Tensor]:
    """Shifts at ``center`` of the best candidate and the other peaks, ``(PEAKS,)``, and their costs."""
    best = _finite(shift.center, 0.0) * (_finite(shift.rate, 1.0) - 1) + shift.offset
    others = shift.peaks[:, 0].double()
    # the best one is refined, and its own peak no other candidate
    others = others[others.isfinite() & ((others - best).abs() > 1 / min(shift.fps))][: PEAKS - 1]
    share = 1 / torch.arange(1, len(others) + 1, dtype=torch.float64)
    left = 0.5 * (1 - _trust(shift))
    cost = torch.cat([torch.tensor([-log(_trust(shift))], dtype=torch.float64), -(left * share / share.sum()).log()])
    offsets = torch.cat([torch.tensor([best], dtype=torch.float64), others])
    cost, empty = torch.where(offsets.isfinite(), cost, torch.inf), PEAKS - len(offsets)
    return torch.nn.functional.pad(offsets, (0, empty), value=torch.nan), torch.nn.functional.pad(cost, (0, empty), value=torch.inf)


def _finite(value: float, other: float) -> float:
    """A pair that failed may know nothing of itself."""
    return value if isfinite(value) else other


def _trust(shift: Shift) -> float:
    low, high = SURE if shift.ok else UNSURE
    return min(max(_finite(shift.confidence, 0.0), low), high)


def _wrong(shift: Shift) -> float:
    """-log of the probability that no candidate is right; at most that of the best one, by which a camera may have to hang."""
    return -log(min((0.5 if len(shift.peaks) > 1 else 1.0) * (1 - _trust(shift)), _trust(shift)))


def _span(shift: Shift) -> float:
    lags = shift.lags[shift.lags.isfinite()]
    return float(lags.max() - lags.min()) if len(lags) > 1 else RANGE
