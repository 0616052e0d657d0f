"""Clocks of more than two cameras: all pairs, the readings of their peaks that agree, and the least squares of those."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from math import exp, isfinite, log, nan
from typing import Any

import torch
from torch import Tensor

from dyntorch.core.outcome import Notice, status_from
from dyntorch.numerics.arguments import check_options, on_cpu
from dyntorch.numerics.blocks import one_thread
from dyntorch.tasks.synchronize.breaks import camera_breaks, of_pair, per_camera
from dyntorch.tasks.synchronize.result import Clocks, ClocksNotice, Pair, Shift, SynchronizeOptions
from dyntorch.tasks.synchronize.synchronize import synchronize

# ----------------------------------------------------------------------------------------------------------------------
# The shifts of pairs of cameras as numbers: candidates, times from the middle of what a camera shares with others, and costs.


@dataclass(frozen=True)
class Network:
    """The pairs as numbers: E pairs, K candidates each."""

    cameras: int
    ends: Tensor  # ``(E, 2)`` long
    times: Tensor  # ``(E, K + 1)``: u_i of the moment, then the candidates' u_j; NaN = no such candidate
    means: Tensor  # ``(cameras,)``: the times that all are counted from
    sigma: Tensor  # ``(E,)`` seconds
    slack: Tensor  # ``(E,)`` seconds: what a right peak may be off by, with ``sigma``
    rate: Tensor  # ``(E,)`` logarithms
    rate_sigma: Tensor
    cost: Tensor  # ``(E, K)``: -log of the probability that a candidate is the right one; infinite where there is none
    none: Tensor  # ``(E,)``: the same of none, times the density of a shift anywhere by that of a right one
    saving: Tensor  # ``(cameras,)``: -log of that density, once: a camera without a clock has no place to be explained
    weight: Tensor  # ``(E,)`` of the squared residual: the probability that the best peak is right

    @property
    def has_rates(self) -> bool:
        """Whether some pair searched its rate."""
        return bool((self.rate_sigma > FIXED_RATE_SIGMA).any())


PEAK_ERROR_FRAMES = 0.25  # Error of a right peak that the sigma of a pair does not include (view-dependent keypoints), frames.
UNSEARCHED_RATE_SIGMA = 5e-5  # Sigma of the rate of a pair that did not search it, next to pairs that did: quartz clocks.
FIXED_RATE_SIGMA = 1e-9  # The same where no pair searched it.


def network(shifts: Mapping[tuple[int, int], Shift], cameras: int) -> Network:
    """The pairs' candidates, times and costs."""
    ends, every = torch.tensor(list(shifts)).reshape(-1, 2), list(shifts.values())
    candidates = [_candidates(shift) for shift in every]
    offsets = torch.stack([offset for offset, _ in candidates])
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
    slack = torch.tensor([PEAK_ERROR_FRAMES / min(shift.fps) for shift in every], dtype=torch.float64)
    rate_sigma = torch.tensor([_finite(shift.rate_sigma, 1.0) for shift in every], dtype=torch.float64)
    rate_sigma = torch.where(
        rate_sigma > 0, rate_sigma, UNSEARCHED_RATE_SIGMA if bool((rate_sigma > 0).any()) else FIXED_RATE_SIGMA
    )
    gain = torch.tensor([_span(shift) for shift in every], dtype=torch.float64) / (2.5 * torch.hypot(sigma, slack))
    gain = gain.clamp(min=1).log()
    cost = torch.stack([cost for _, cost in candidates])
    none = torch.tensor([_wrong(shift) for shift in every], dtype=torch.float64)
    rate = torch.tensor([_finite(shift.rate, 1.0) for shift in every], dtype=torch.float64).log()
    weight = torch.tensor([_trust(shift) for shift in every], dtype=torch.float64)
    saving = torch.tensor([float(gain[(ends == one).any(-1)].min()) if (ends == one).any() else 0.0 for one in range(cameras)])
    return Network(cameras, ends, moments, means, sigma, slack, rate, rate_sigma, cost, gain + none, saving, weight)


NUM_CANDIDATES = 8  # Candidates per pair.


def _candidates(shift: Shift) -> tuple[Tensor, Tensor]:
    """Shifts at ``center`` of the best candidate and the other peaks, ``(PEAKS,)``, and their costs."""
    best = _finite(shift.center, 0.0) * (_finite(shift.rate, 1.0) - 1) + shift.offset
    others = shift.peaks[:, 0].double()
    # the best one is refined, and its own peak no other candidate
    others = others[others.isfinite() & ((others - best).abs() > 1 / min(shift.fps))][: NUM_CANDIDATES - 1]
    share = 1 / torch.arange(1, len(others) + 1, dtype=torch.float64)
    left = 0.5 * (1 - _trust(shift))
    cost = torch.cat([torch.tensor([-log(_trust(shift))], dtype=torch.float64), -(left * share / share.sum()).log()])
    offsets = torch.cat([torch.tensor([best], dtype=torch.float64), others])
    cost, empty = torch.where(offsets.isfinite(), cost, torch.inf), NUM_CANDIDATES - len(offsets)
    return torch.nn.functional.pad(offsets, (0, empty), value=torch.nan), torch.nn.functional.pad(cost, (0, empty), value=torch.inf)


def _finite(value: float, other: float) -> float:
    """A pair that failed may know nothing of itself."""
    return value if isfinite(value) else other


ACCEPTED_PROBABILITY_RANGE = (0.95, 0.99)  # Range of the probability that the best peak of an accepted pair is right.
REFUSED_PROBABILITY_RANGE = (0.05, 0.5)  # The same of a refused pair.


def _trust(shift: Shift) -> float:
    low, high = ACCEPTED_PROBABILITY_RANGE if shift.ok else REFUSED_PROBABILITY_RANGE
    return min(max(_finite(shift.confidence, 0.0), low), high)


def _wrong(shift: Shift) -> float:
    """-log of the probability that no candidate is right; at most that of the best one, by which a camera may have to hang."""
    return -log(min((0.5 if len(shift.peaks) > 1 else 1.0) * (1 - _trust(shift)), _trust(shift)))


UNKNOWN_RANGE_SECONDS = 10.0  # Range of the offset of a pair without a curve.


def _span(shift: Shift) -> float:
    lags = shift.lags[shift.lags.isfinite()]
    return float(lags.max() - lags.min()) if len(lags) > 1 else UNKNOWN_RANGE_SECONDS


# ----------------------------------------------------------------------------------------------------------------------
# Clocks of many cameras from shifts of pairs: which peak of which pair is right, and the least squares of those.
#
# In clock times :math:`u_i = t_i - \bar t_i` from the middle of what camera i shares with others, a clock is
# :math:`u_i = r_i (U + b_i)`, and the moment that a pair saw at :math:`u_i` and :math:`u_j` gives one equation in the b and one
# in the logarithms of the rates:
#
# .. math:: (u_j / r_j - b_j) - (u_i / r_i - b_i) = 0 \pm \sigma_{ij}, \qquad \log r_{ij} = \log r_j - \log r_i \pm \sigma^r_{ij}.


@dataclass(frozen=True)
class Reading:
    """One way to read the pairs: which candidate each of them is right with, and the clocks of that."""

    labels: tuple[int, ...]  # Candidate per pair, -1 = none
    logs: Tensor  # ``(cameras,)`` logarithms of the rates
    starts: Tensor  # ``(cameras,)``: b; NaN = no clock
    cost: float
    covariance: Tensor  # ``(2 cameras, 2 cameras)`` of logs and starts; 0 for the reference, infinite where there is no clock


def readings(net: Network, reference: int) -> list[Reading]:
    """The likeliest readings that differ in some clock, best first."""
    logs, starts = _search(net, reference)
    refined: dict[tuple[int, ...], Reading] = {}
    for one_log, one_start in zip(logs, starts, strict=True):
        reading = refine_reading(net, reference, one_log, one_start)
        if reading.labels not in refined or reading.cost < refined[reading.labels].cost:
            refined[reading.labels] = reading
    different: list[Reading] = []
    for reading in sorted(refined.values(), key=lambda one: one.cost):
        if all(differing_cameras(net, reading, other) for other in different):
            different.append(reading)
    return different


def differing_cameras(net: Network, one: Reading, other: Reading) -> list[int]:
    """Cameras whose clocks differ by more than a frame and four standard deviations, or have none in one of the two."""
    variance = torch.minimum(one.covariance.diagonal(), other.covariance.diagonal())[net.cameras :]
    allowed = torch.maximum(4 * variance.sqrt(), net.slack.max() / PEAK_ERROR_FRAMES)
    apart = (one.starts - other.starts).abs()
    return ((apart > allowed) | (one.starts.isnan() != other.starts.isnan())).nonzero().flatten().tolist()


NUM_REFINED_STATES = 30  # States that are refined in the end.


def _search(net: Network, reference: int) -> tuple[Tensor, Tensor]:
    """Beam search: cameras join one by one, by any candidate of any pair with those before, or without a clock."""
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
        logs, starts = _add_camera(net, logs, starts, camera, ties)
        within = torch.tensor([set(ends) <= set(joined) for ends in net.ends.tolist()])
        saved = (starts[:, joined].isnan() * net.saving[joined]).sum(-1)
        cost = _costs(net, logs, starts, within)[0].sum(-1) - saved
        keep = _distinct(starts, cost, allowed)
        logs, starts = logs[keep], starts[keep]
    # in the order of _distinct, cheap and complete ones take turns
    return logs[:NUM_REFINED_STATES], starts[:NUM_REFINED_STATES]


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


def _add_camera(net: Network, logs: Tensor, starts: Tensor, camera: int, ties: Tensor) -> tuple[Tensor, Tensor]:
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


MAX_RATE_COST = 8.0  # Cap of the cost of contradicting rates.


def _costs(net: Network, logs: Tensor, starts: Tensor, pairs: Tensor) -> tuple[Tensor, Tensor]:
    """Cost ``(S, chosen)`` of the pairs chosen ``(E,)`` in states ``(S, cameras)``, and the candidate behind it, -1 = none."""
    i, j = net.ends[pairs].unbind(-1)
    here = net.times[pairs, :1] / logs[:, i, None].exp() - starts[:, i, None]
    away = net.times[pairs, 1:] / logs[:, j, None].exp() - starts[:, j, None] - here
    spread = torch.hypot(net.sigma, net.slack)[pairs, None]
    fit, label = torch.nan_to_num(0.5 * (away / spread).square() + net.cost[pairs], nan=torch.inf).min(-1)
    # rates are compared more loosely than they were measured, like shifts
    loose = torch.hypot(net.rate_sigma, torch.tensor(UNSEARCHED_RATE_SIGMA if net.has_rates else FIXED_RATE_SIGMA))[pairs]
    drift = (net.rate[pairs] - logs[:, j] + logs[:, i]) / loose
    fit = fit + (0.5 * drift.square()).clamp(max=MAX_RATE_COST)
    return torch.minimum(fit, net.none[pairs]), torch.where(fit <= net.none[pairs], label, -1)


BEAM_WIDTH = 100  # States that stay when a camera is added.


def _distinct(starts: Tensor, cost: Tensor, allowed: float) -> Tensor:
    """States that differ in some clock, at most BEAM: in turns the cheapest, and the cheapest of those with the most clocks."""
    cheap = cost.argsort(stable=True)[: 5 * BEAM_WIDTH]
    complete = (starts.isnan().sum(-1) * (cost.max() - cost.min() + 1) + cost).argsort(stable=True)[: 5 * BEAM_WIDTH]
    order = torch.stack([cheap, complete], dim=1).flatten()
    filled = torch.nan_to_num(starts[order], nan=1e15)
    close = torch.cdist(filled, filled, p=torch.inf) <= allowed
    selected: list[int] = []
    free = torch.ones(len(order), dtype=torch.bool)
    for index in range(len(order)):
        if free[index] and len(selected) < BEAM_WIDTH:
            selected.append(index)
            free &= ~close[index]
    return order[selected]


MAX_REWEIGHTINGS = 5  # Reweighted least squares of a state.


def refine_reading(net: Network, reference: int, logs: Tensor, starts: Tensor) -> Reading:
    """The weighted least squares of the candidates that a state agrees with, and these chosen again, until they stay."""
    every = torch.ones(len(net.ends), dtype=torch.bool)
    labels: tuple[int, ...] = ()
    for _ in range(MAX_REWEIGHTINGS):
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
    for _ in range(MAX_REWEIGHTINGS):
        v_i, v_j = t_i / state[here].exp(), t_j / state[there].exp()
        jacobian[rows, here], jacobian[rows, there] = weight * v_i, -weight * v_j
        away = (v_j - state[n + there]) - (v_i - state[n + here])
        value = torch.cat([weight * away, rate_weight * (net.rate[used] - state[there] + state[here])])
        A = jacobian[:, free]
        # the default driver gives other last digits in every run (pytorch issue 187411)
        state = state.index_add(0, free, -torch.linalg.lstsq(A, value, driver="gelsd").solution)
    inverse = torch.linalg.pinv(A, rtol=1e-15)
    excess = value.unflatten(0, (2, -1)).square().sum(-1).max() / max(1, len(used) - len(free) // 2)
    spread = inverse @ inverse.mT * excess.clamp(min=1)
    covariance[free[:, None], free] = spread
    return state[:n], state[n:], covariance


@one_thread
@on_cpu
def synchronize_cameras(
    tracks: Sequence[Any],
    correspondence: bool = True,
    *,
    fps: float | Sequence[float] | None = None,
    times: Sequence[Tensor] | None = None,
    max_shift: float | None = None,
    calibration: Sequence[Any] | None = None,
    weights: Sequence[Tensor] | None = None,
    reference: int = 0,
    pairs: Sequence[tuple[int, int]] | None = None,
    pair: Callable[..., Shift] | None = None,
    breaks: bool = False,
    options: SynchronizeOptions | None = None,
    **further: Any,
) -> Clocks:
    """The clocks of several cameras that filmed the same motion: :func:`dyntorch.synchronize` on the pairs, then
    :func:`combine_shifts`.

    A search: it computes on the CPU wherever its tensors are, and the result returns to their device.

    Args:
        tracks: per camera ``(frames, n, 2)`` px, NaN = missing; frames may differ, n too without correspondence.  (Or whatever
            ``pair`` compares.)
        correspondence: whether point k is the same in all cameras.
        fps: frames per second, of all cameras or of each.
        times: per camera ``(frames,)`` seconds, instead of ``fps``.
        max_shift: seconds.
        calibration: per camera None or ``(K, dist)``.
        weights: per camera ``(frames, n)``, 0 = ignore.
        reference: the camera whose clock the others are told in.
        pairs: which pairs of cameras to compare; all, by default.
        pair: what compares two cameras, with the arguments of ``dyntorch.synchronize`` (the default).
        breaks: whether to look for frames that a camera lost or wrote twice; the clocks are those of ``clocks.breaks.times``.
        options: as of ``dyntorch.synchronize``.
        further: arguments of ``pair``.

    Returns:
        The clocks; a pair that refuses, contradicts the others or leaves a camera undecided is data there, not an exception.

    Raises:
        ValueError: fewer than two cameras, lists of other lengths, no such camera, or a pair's own complaint with its cameras.

    Source: thesis, chapter 7, pair by pair.

    Example:
        >>> import torch
        >>> def pair(a, b, correspondence, **given):  # stands in for dyntorch.synchronize
        ...     shift = float(b[0, 0, 0] - a[0, 0, 0])
        ...     peaks, none = torch.tensor([[shift, 1.0]]), torch.zeros(0)
        ...     return Shift(shift, 0.01, 1.0, 0.0, 0.99, peaks, "epipolar", (30.0, 30.0), 0.0, none, none, status=torch.tensor(0))
        >>> tracks = [torch.full((9, 4, 2), start) for start in (0.0, 2.0, -0.5)]
        >>> synchronize_cameras(tracks, fps=30.0, pair=pair).offsets.round(decimals=6).tolist()
        [0.0, 2.0, -0.5]
    """
    options = SynchronizeOptions() if options is None else options
    check_options(options, SynchronizeOptions)
    count = len(tracks)
    if count < 2:
        raise ValueError(f"tracks: {count} camera given, two are needed at least")
    if breaks and not correspondence:
        raise ValueError("breaks are told by corresponding points: give correspondence=True, or leave breaks out")
    every = per_camera(count, fps=fps, times=times, calibration=calibration, weights=weights)
    if pair is None:
        pair = partial(synchronize, options=options)
    shifts = {}
    for i, j in combinations(range(count), 2) if pairs is None else pairs:
        _check_pair((i, j), count)
        try:
            shifts[i, j] = pair(tracks[i], tracks[j], correspondence, max_shift=max_shift, **of_pair(every, i, j), **further)
        except ValueError as error:
            raise ValueError(f"cameras {i} and {j}: {error}") from error
    clocks = combine_shifts(shifts, count, reference)
    if not breaks:
        return clocks
    broken = camera_breaks(tracks, clocks, max_shift=max_shift, options=options, **every)
    given: dict[str, Any] = {name: values for name, values in every.items() if name not in ("fps", "times")}
    again = partial(synchronize_cameras, max_shift=max_shift, reference=reference, pairs=pairs, pair=pair, options=options)
    return replace(again(tracks, times=broken.times, **given, **further) if broken.breaks else clocks, breaks=broken)


@on_cpu
def combine_shifts(shifts: Mapping[tuple[int, int], Shift], cameras: int, reference: int = 0) -> Clocks:
    r"""All cameras' clocks from the shifts of pairs: weighted least squares over the peaks that agree.

    .. math:: \min \sum_{ij} \frac{w_{ij}}{\sigma_{ij}^2} \bigl(T_j(t_j) - T_i(t_i)\bigr)^2
              + \frac{1}{(\sigma^r_{ij})^2} \bigl(\log r_{ij} - \log r_j + \log r_i\bigr)^2, \qquad T_i(t) = (t - o_i) / r_i,

    where camera j showed at :math:`t_j` what camera i showed at :math:`t_i`, the middle of the pair's overlap, and w is the
    pair's confidence.  Which peak of a pair is the right one, or none, is part of the search: a reading costs the squared
    residuals plus -log of the probabilities of the peaks (the confidence for the best one, the rest shared by the others), and a
    pair without a right peak costs what a shift anywhere does.  So a pair that is sure and wrong is found by the cycles it
    breaks, and a periodic motion that two cameras cannot decide is decided by a third.

    Args:
        shifts: ``(i, j)`` to the shift of camera j's clock against camera i's.
        cameras: how many there are.
        reference: the camera whose clock the others are told in.

    Returns:
        The clocks; ``ok`` is false where a camera is tied to the others by no pair, or another reading is not 10 times less likely.

    Raises:
        ValueError: fewer than two cameras, no shift, a pair of cameras or a reference that does not exist.

    Example:
        >>> import torch
        >>> def shift(offset, *more):
        ...     peaks = torch.tensor([[value, 1.0] for value in (offset, *more)])
        ...     none, status = torch.zeros(0), torch.tensor(3 if more else 0)  # periodic motion is ambiguous
        ...     return Shift(offset, 0.01, 1.0, 0.0, 0.9, peaks, "epipolar", (30.0, 30.0), 0.0, none, none, status=status)
        >>> clocks = combine_shifts({(0, 1): shift(1.0), (0, 2): shift(3.0), (1, 2): shift(0.9, 2.0, 3.1)}, 3)
        >>> clocks.offsets.round(decimals=3).tolist(), clocks.ok
        ([0.0, 1.0, 3.0], True)
    """
    if cameras < 2 or not 0 <= reference < cameras:
        raise ValueError(
            f"cameras = {cameras}, reference = {reference}: at least two cameras are needed, the reference one of them"
        )
    if not shifts:
        raise ValueError("shifts: no pair of cameras is given; give one per camera but the reference at least")
    for ends in shifts:
        _check_pair(ends, cameras)
    net = network(shifts, cameras)
    ranked = readings(net, reference)
    # the answer gives every camera a clock that can have one; whether it decides is another question
    best = min(ranked, key=lambda one: (int(one.starts.isnan().sum()), one.cost))
    rivals = [one for one in ranked if one is not best]
    confidence = 1 / (1 + sum(exp(min(best.cost - one.cost, 50.0)) for one in rivals))
    rates = best.logs.exp()
    offsets = net.means + rates * (best.starts - net.means[reference])
    used = [edge for edge, label in enumerate(best.labels) if label >= 0]
    here = net.ends[used, 0]
    center = float((net.times[used, 0] / rates[here] - best.starts[here]).mean()) if used else 0.0
    table = _pairs(net, shifts, best)
    cycles = _cycles(net, shifts, table)
    refusal = _refusal(net, shifts, best, rivals, reference)
    limits = (*(() if refusal is None else (refusal,)), *_notices(table, cameras, shifts))
    return Clocks(
        offsets=offsets,
        rates=rates,
        sigmas=_sigmas(best, rates, center),
        rate_sigmas=best.covariance.diagonal()[:cameras].sqrt() * rates * float(net.has_rates),
        confidence=confidence,
        pairs=table,
        cycle_error=(sum(error**2 for _, error in cycles) / len(cycles)) ** 0.5 if cycles else nan,
        worst_cycle=max(cycles, key=lambda one: abs(one[1]), default=None),
        outliers=[row.cameras for row in table if row.outlier],
        reference=reference,
        center=center + float(net.means[reference]),
        shifts=dict(shifts),
        status=status_from(limits),
        notices=limits,
    )


def _check_pair(ends: tuple[int, int], cameras: int) -> None:
    i, j = ends
    if i == j or not (0 <= i < cameras and 0 <= j < cameras):
        raise ValueError(f"pair ({i}, {j}): give two different cameras out of 0..{cameras - 1}")


def _sigmas(best: Reading, rates: Tensor, center: float) -> Tensor:
    """Standard deviations of the clocks at ``center``."""
    n = len(rates)
    (logs, mixed), (_, starts) = (row.split(n, dim=1) for row in best.covariance.split(n))
    away = center + best.starts
    variance = away.square() * logs.diagonal() + 2 * away * mixed.diagonal() + starts.diagonal()
    return torch.where(best.starts.isnan(), torch.inf, rates * variance.clamp(min=0).sqrt())


def _pairs(net: Network, shifts: Mapping[tuple[int, int], Shift], best: Reading) -> tuple[Pair, ...]:
    """The table: what each pair says, and by how much it differs."""
    rows = []
    for edge, (ends, shift) in enumerate(shifts.items()):
        i, j = ends
        label = best.labels[edge]
        at, seen = net.times[edge, 0], net.times[edge, 1 + max(label, 0)]
        expected = best.logs[j].exp() * (at / best.logs[i].exp() - best.starts[i] + best.starts[j])
        value = float(seen + net.means[j] - at - net.means[i])
        rows.append(Pair(ends, value, shift.sigma, float(seen - expected), label, shift.ok))
    return tuple(rows)


def _cycles(
    net: Network, shifts: Mapping[tuple[int, int], Shift], table: Sequence[Pair]
) -> list[tuple[tuple[int, int, int], float]]:
    """What is missing after going round each triangle of pairs that are used, in seconds."""
    step: dict[tuple[int, int], tuple[float, float]] = {}  # rate and offset of one clock against another
    for row in table:
        if row.is_used:
            (i, j), shift = row.cameras, shifts[row.cameras]
            offset = row.shift - shift.center * (shift.rate - 1)
            step[i, j], step[j, i] = (shift.rate, offset), (1 / shift.rate, -offset / shift.rate)
    errors = []
    for triple in combinations(range(net.cameras), 3):
        way = [(triple[k], triple[(k + 1) % 3]) for k in range(3)]
        if all(ends in step for ends in way):
            start = time = float(net.means[triple[0]])
            for ends in way:
                rate, offset = step[ends]
                time = rate * time + offset
            errors.append((triple, time - start))
    return errors


MIN_LOG_ODDS = log(10)  # Log odds of the best reading over another that differs in cameras tied by accepted pairs.
MIN_LOG_ODDS_OF_REFUSED = log(300)  # The same where they differ in others: refused pairs of one camera often fail together.


def _refusal(
    net: Network, shifts: Mapping[tuple[int, int], Shift], best: Reading, rivals: Sequence[Reading], reference: int
) -> Notice | None:
    """Why the pairs do not decide; None where they do."""
    lost = best.starts.isnan().nonzero().flatten().tolist()
    if lost:
        return Notice(ClocksNotice.LOST, float(len(lost)), {"lost": tuple(lost)})
    ends, sure = list(shifts), _surely_tied(shifts, best, reference)
    margins = [MIN_LOG_ODDS if sure.issuperset(differing_cameras(net, best, one)) else MIN_LOG_ODDS_OF_REFUSED for one in rivals]
    close = [one for one, margin in zip(rivals, margins, strict=True) if one.cost - best.cost < margin]
    if not close:
        return None
    rival = min(close, key=lambda one: one.cost)
    undecided = tuple(differing_cameras(net, best, rival))
    lost = rival.starts.isnan().nonzero().flatten().tolist()
    refused = [pair for pair, shift in shifts.items() if not shift.ok and (not lost or set(lost) & set(pair))]
    if refused:
        values = {"cameras": undecided, "refused": tuple(refused), "first": shifts[refused[0]].reason}
        case = "pairs" if len(shifts) > 1 else "pair"
        return Notice(ClocksNotice.REFUSED, float(len(refused)), {"case": case, **values})
    torn = [pair for pair, one, other in zip(ends, best.labels, rival.labels, strict=True) if one != other]
    return Notice(ClocksNotice.CONTRADICTION, float(len(torn)), {"cameras": undecided, "torn": tuple(torn)})


def _surely_tied(shifts: Mapping[tuple[int, int], Shift], best: Reading, reference: int) -> set[int]:
    """Cameras tied to the reference by pairs that decide on their own, and are used so."""
    ties = [ends for (ends, shift), label in zip(shifts.items(), best.labels, strict=True) if shift.ok and label == 0]
    tied = {reference}
    for _ in ties:
        tied |= {camera for ends in ties if tied & set(ends) for camera in ends}
    return tied


def _notices(table: Sequence[Pair], cameras: int, shifts: Mapping[tuple[int, int], Shift]) -> tuple[Notice, ...]:
    """What to know besides."""
    notices = []
    degree = [sum(row.is_used and camera in row.cameras for row in table) for camera in range(cameras)]
    alone = tuple(camera for camera in range(cameras) if degree[camera] == 1)
    if cameras == 2:
        notices.append(Notice(ClocksNotice.TWO))
    elif alone:
        notices.append(Notice(ClocksNotice.ALONE, float(len(alone)), {"cameras": alone}))
    for row in table:
        values = {"pair": (row.cameras,), "peak": _place(row.peak)}
        if row.outlier and row.is_used:
            notices.append(Notice(ClocksNotice.OUTLIER, row.shift, {"case": "used", **values}))
        elif row.outlier:
            notices.append(Notice(ClocksNotice.OUTLIER, row.residual, {"case": "unused", **values}))
        elif row.is_used and not row.ok and cameras > 2:
            notices.append(Notice(ClocksNotice.CONFIRMED, row.shift, values))
    of_pairs = [(ends, note) for ends, shift in shifts.items() for note in shift.notes]
    return (*notices, *(Notice(ClocksNotice.OF_PAIR, 0.0, {"pair": (ends,), "note": note}) for ends, note in of_pairs))


def _place(peak: int) -> str:
    return "best peak" if peak == 0 else f"peak number {peak + 1}"
