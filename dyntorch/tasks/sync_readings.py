r"""Clocks of many cameras from shifts of pairs: which peak of which pair is right, and the least squares of those.

In clock times :math:`u_i = t_i - \bar t_i` from the middle of what camera i shares with others, a clock is
:math:`u_i = r_i (U + b_i)`, and the moment that a pair saw at :math:`u_i` and :math:`u_j` gives one equation in the b and one
in the logarithms of the rates:

.. math:: (u_j / r_j - b_j) - (u_i / r_i - b_i) = 0 \pm \sigma_{ij}, \qquad \log r_{ij} = \log r_j - \log r_i \pm \sigma^r_{ij}.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.tasks.sync_network import FIXED, FRAME, RATE, Network

BEAM, FINAL = 100, 30
"""States that are kept when a camera joins, and that are refined in the end."""
STEPS = 5
DRIFT = 8.0
"""Cost at which a contradiction of the rates stops growing: the pair is wrong, by whatever."""


@dataclass(frozen=True)
class Reading:
    """One way to read the pairs: which candidate each of them is right with, and the clocks of that."""

    labels: tuple[int, ...]
    """Candidate per pair, -1 = none."""
    logs: Tensor
    """``(cameras,)`` logarithms of the rates."""
    starts: Tensor
    """``(cameras,)``: b; NaN = no clock."""
    cost: float
    covariance: Tensor
    """``(2 cameras, 2 cameras)`` of logs and starts; 0 for the reference, infinite where there is no clock."""


def readings(net: Network, reference: int) -> list[Reading]:
    """The likeliest readings that differ in some clock, best first."""
    logs, starts = _search(net, reference)
    found: dict[tuple[int, ...], Reading] = {}
    for one_log, one_start in zip(logs, starts, strict=True):
        reading = refined(net, reference, one_log, one_start)
        if reading.labels not in found or reading.cost < found[reading.labels].cost:
            found[reading.labels] = reading
    different: list[Reading] = []
    for reading in sorted(found.values(), key=lambda one: one.cost):
        if all(differing(net, reading, other) for other in different):
            different.append(reading)
    return different


def differing(net: Network, one: Reading, other: Reading) -> list[int]:
    """Cameras whose clocks differ by more than a frame and four standard deviations, or have none in one of the two."""
    variance = torch.minimum(one.covariance.diagonal(), other.covariance.diagonal())[net.cameras :]
    allowed = torch.maximum(4 * variance.sqrt(), net.slack.max() / FRAME)
    apart = (one.starts - other.starts).abs()
    return ((apart > allowed) | (one.starts.isnan() != other.starts.isnan())).nonzero().flatten().tolist()


def _search(net: Network, reference: int) -> tuple[Tensor, Tensor]:
    """Beam search: cameras join one by one, by any candidate of any pair with those before, or without a clock.

    A second round lets each camera move to where any candidate of any of its pairs puts it: in the first, a camera could only
    join by its pairs with those before, which may be the wrong ones.

    Returns:
        logs and starts ``(S, cameras)``.
    """
    logs = torch.zeros(1, net.cameras, dtype=torch.float64)
    starts = torch.full_like(logs, torch.nan)
    starts[:, reference] = 0.0
    placed = [reference]
    while (camera := _next(net, placed)) is not None:
        placed.append(camera)
    allowed = 2 * float(torch.hypot(net.sigma, net.slack).median())
    joined = [reference]
    for camera in placed[1:] * 2:
        joined += [camera] if camera not in joined else []
        ties = torch.tensor([camera in ends and set(ends) <= set(joined) for ends in net.ends.tolist()])
        logs, starts = _joined(net, logs, starts, camera, ties)
        within = torch.tensor([set(ends) <= set(joined) for ends in net.ends.tolist()])
        saved = (starts[:, joined].isnan() * net.saving[joined]).sum(-1)
        cost = _costs(net, logs, starts, within)[0].sum(-1) - saved
        keep = _distinct(starts, cost, allowed)
        logs, starts = logs[keep], starts[keep]
    # in the order of _distinct, cheap and complete ones take turns
    return logs[:FINAL], starts[:FINAL]


def _between(ends: list[int], camera: int, placed: list[int]) -> bool:
    i, j = ends
    return (i == camera and j in placed) or (j == camera and i in placed)


def _next(net: Network, placed: list[int]) -> int | None:
    """The camera that is tied best to those placed."""
    best = {
        camera: sum(float(w) for w, ends in zip(net.weight, net.ends.tolist(), strict=True) if _between(ends, camera, placed))
        for camera in set(range(net.cameras)) - set(placed)
    }
    camera = max(best, key=lambda one: (best[one], -one), default=None)
    return camera if camera is not None and best[camera] > 0 else None


def _joined(net: Network, logs: Tensor, starts: Tensor, camera: int, ties: Tensor) -> tuple[Tensor, Tensor]:
    """Every state as it is, then with the camera where each candidate of each tie puts it: ``(S (1 + ties K), cameras)``."""
    new_logs, new_starts = [logs], [starts]
    for edge in ties.nonzero().flatten().tolist():
        i, j = net.ends[edge].tolist()
        sign, old = (1.0, i) if j == camera else (-1.0, j)
        turned = logs[:, old] + sign * net.rate[edge]
        log_i, log_j = (logs[:, i], turned) if j == camera else (turned, logs[:, j])
        for k in net.cost[edge].isfinite().nonzero().flatten().tolist():
            # b_j - b_i
            step = net.times[edge, 1 + k] / log_j.exp() - net.times[edge, 0] / log_i.exp()
            new_logs.append(logs.index_copy(1, torch.tensor([camera]), turned[:, None]))
            new_starts.append(starts.index_copy(1, torch.tensor([camera]), (starts[:, old] + sign * step)[:, None]))
    return torch.cat(new_logs), torch.cat(new_starts)


def _costs(net: Network, logs: Tensor, starts: Tensor, pairs: Tensor) -> tuple[Tensor, Tensor]:
    """Cost ``(S, chosen)`` of the pairs chosen ``(E,)`` in states ``(S, cameras)``, and the candidate behind it, -1 = none."""
    i, j = net.ends[pairs].unbind(-1)
    here = net.times[pairs, :1] / logs[:, i, None].exp() - starts[:, i, None]
    away = net.times[pairs, 1:] / logs[:, j, None].exp() - starts[:, j, None] - here
    spread = torch.hypot(net.sigma, net.slack)[pairs, None]
    fit, label = torch.nan_to_num(0.5 * (away / spread).square() + net.cost[pairs], nan=torch.inf).min(-1)
    # rates are compared more loosely than they were measured, like shifts
    loose = torch.hypot(net.rate_sigma, torch.tensor(RATE if net.searched else FIXED))[pairs]
    drift = (net.rate[pairs] - logs[:, j] + logs[:, i]) / loose
    fit = fit + (0.5 * drift.square()).clamp(max=DRIFT)
    return torch.minimum(fit, net.none[pairs]), torch.where(fit <= net.none[pairs], label, -1)


def _distinct(starts: Tensor, cost: Tensor, allowed: float) -> Tensor:
    """States that differ in some clock, at most BEAM: in turns the cheapest, and the cheapest of those with the most clocks."""
    cheap = cost.argsort(stable=True)[: 5 * BEAM]
    complete = (starts.isnan().sum(-1) * (cost.max() - cost.min() + 1) + cost).argsort(stable=True)[: 5 * BEAM]
    order = torch.stack([cheap, complete], dim=1).flatten()
    filled = torch.nan_to_num(starts[order], nan=1e15)
    close = torch.cdist(filled, filled, p=torch.inf) <= allowed
    kept: list[int] = []
    free = torch.ones(len(order), dtype=torch.bool)
    for index in range(len(order)):
        if free[index] and len(kept) < BEAM:
            kept.append(index)
            free &= ~close[index]
    return order[kept]


def refined(net: Network, reference: int, logs: Tensor, starts: Tensor) -> Reading:
    """The weighted least squares of the candidates that a state agrees with, and these chosen again, until they stay."""
    every = torch.ones(len(net.ends), dtype=torch.bool)
    labels: tuple[int, ...] = ()
    for _ in range(STEPS):
        cost, chosen = _costs(net, logs[None], starts[None], every)
        if tuple(chosen[0].tolist()) == labels:
            break
        labels = tuple(chosen[0].tolist())
        logs, starts, covariance = _least_squares(net, reference, labels, logs, starts)
    saved = float((starts.isnan() * net.saving).sum())
    return Reading(labels, logs, starts, float(cost.sum()) - saved, covariance)


def _least_squares(
    net: Network, reference: int, labels: tuple[int, ...], logs: Tensor, starts: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Gauss-Newton from a state: logs, starts and their covariance, scaled up where the residuals exceed their sigmas."""
    n, used = net.cameras, [edge for edge, label in enumerate(labels) if label >= 0]
    covariance = torch.diag(torch.zeros_like(starts).masked_fill(starts.isnan(), torch.inf).repeat(2))
    if not used:
        return logs, starts, covariance
    here, there = net.ends[used].unbind(-1)
    t_i, t_j = net.times[used, 0], net.times[used, [1 + labels[edge] for edge in used]]
    weight = net.weight[used].sqrt() / torch.hypot(net.sigma, 0.1 * net.slack)[used]
    rate_weight = 1 / net.rate_sigma[used]
    placed = starts.isfinite()
    placed[reference] = False
    free = torch.cat([placed, placed]).nonzero().flatten()
    rows = torch.arange(len(used))
    jacobian = torch.zeros(2 * len(used), 2 * n, dtype=torch.float64)
    jacobian[rows, n + here], jacobian[rows, n + there] = weight, -weight
    jacobian[len(used) + rows, here], jacobian[len(used) + rows, there] = rate_weight, -rate_weight
    state = torch.cat([logs, starts])
    for _ in range(STEPS):
        v_i, v_j = t_i / state[here].exp(), t_j / state[there].exp()
        jacobian[rows, here], jacobian[rows, there] = weight * v_i, -weight * v_j
        away = (v_j - state[n + there]) - (v_i - state[n + here])
        value = torch.cat([weight * away, rate_weight * (net.rate[used] - state[there] + state[here])])
        A = jacobian[:, free]
        state = state.index_add(0, free, -torch.linalg.lstsq(A, value).solution)
    inverse = torch.linalg.pinv(A, rtol=1e-15)
    excess = value.unflatten(0, (2, -1)).square().sum(-1).max() / max(1, len(used) - len(free) // 2)
    spread = inverse @ inverse.mT * excess.clamp(min=1)
    covariance[free[:, None], free] = spread
    return state[:n], state[n:], covariance
