"""Clocks of more than two cameras: all pairs, the readings of their peaks that agree, and the least squares of those."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from math import exp, log, nan
from typing import Any

import torch
from torch import Tensor

from dyntorch.blocks import one_thread
from dyntorch.devices import on_cpu
from dyntorch.tasks.shift import Shift
from dyntorch.tasks.sync_clocks import Clocks, Pair
from dyntorch.tasks.sync_network import Network, network
from dyntorch.tasks.sync_readings import Reading, differing, readings
from dyntorch.tasks.synchronize import synchronize

DECIDED, CONFIRMED = log(10), log(300)
"""Odds of the best reading to another, as logarithms, from which it counts as the answer: where the two differ in cameras that
sure pairs tie to the reference, and in others.  Refused pairs often fail together, all of one camera."""


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
    **options: Any,
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
        options: further arguments of it.

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
        ...     return Shift(shift, 0.01, 1.0, 0.0, 0.99, peaks, True, "", "epipolar", (30.0, 30.0), 0.0, none, none)
        >>> tracks = [torch.full((9, 4, 2), start) for start in (0.0, 2.0, -0.5)]
        >>> synchronize_cameras(tracks, fps=30.0, pair=pair).offsets.round(decimals=6).tolist()
        [0.0, 2.0, -0.5]
    """
    count = len(tracks)
    if count < 2:
        raise ValueError(f"tracks: {count} camera given, two are needed at least")
    every: dict[str, Sequence[Any] | None] = {
        "fps": [float(fps)] * count if isinstance(fps, (int, float)) else fps,
        "times": times,
        "calibration": calibration,
        "weights": weights,
    }
    for name, values in every.items():
        if values is not None and len(values) != count:
            raise ValueError(f"{name}: {len(values)} values for {count} cameras; give one per camera")
    if pair is None:
        pair = synchronize
    shifts = {}
    for i, j in combinations(range(count), 2) if pairs is None else pairs:
        _check_pair((i, j), count)
        given: dict[str, Any] = {name: (values[i], values[j]) for name, values in every.items() if values is not None}
        try:
            shifts[i, j] = pair(tracks[i], tracks[j], correspondence, max_shift=max_shift, **given, **options)
        except ValueError as error:
            raise ValueError(f"cameras {i} and {j}: {error}") from error
    return combine_shifts(shifts, count, reference)


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
        ...     none, reason = torch.zeros(0), "periodic" if more else ""
        ...     return Shift(offset, 0.01, 1.0, 0.0, 0.9, peaks, not more, reason, "epipolar", (30.0, 30.0), 0.0, none, none)
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
    reason = _reason(net, shifts, best, rivals, reference)
    rates = best.logs.exp()
    offsets = net.means + rates * (best.starts - net.means[reference])
    used = [edge for edge, label in enumerate(best.labels) if label >= 0]
    here = net.ends[used, 0]
    center = float((net.times[used, 0] / rates[here] - best.starts[here]).mean()) if used else 0.0
    table = _pairs(net, shifts, best)
    cycles = _cycles(net, shifts, best, table)
    return Clocks(
        offsets=offsets,
        rates=rates,
        sigmas=_sigmas(best, rates, center),
        rate_sigmas=best.covariance.diagonal()[:cameras].sqrt() * rates * float(net.searched),
        confidence=confidence,
        pairs=table,
        cycle_error=(sum(error**2 for _, error in cycles) / len(cycles)) ** 0.5 if cycles else nan,
        worst_cycle=max(cycles, key=lambda one: abs(one[1]), default=None),
        outliers=[row.cameras for row in table if row.outlier],
        ok=not reason,
        reason=reason,
        reference=reference,
        center=center + float(net.means[reference]),
        shifts=dict(shifts),
        notes=_notes(table, cameras, shifts),
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
        said = best.logs[j].exp() * (at / best.logs[i].exp() - best.starts[i] + best.starts[j])
        value = float(seen + net.means[j] - at - net.means[i])
        rows.append(Pair(ends, value, shift.sigma, float(seen - said), label, shift.ok))
    return tuple(rows)


def _cycles(
    net: Network, shifts: Mapping[tuple[int, int], Shift], best: Reading, table: Sequence[Pair]
) -> list[tuple[tuple[int, int, int], float]]:
    """What is missing after going round each triangle of pairs that are used, in seconds."""
    step: dict[tuple[int, int], tuple[float, float]] = {}  # rate and offset of one clock against another
    for row in table:
        if row.used:
            (i, j), shift = row.cameras, shifts[row.cameras]
            offset = row.shift - shift.center * (shift.rate - 1)
            step[i, j], step[j, i] = (shift.rate, offset), (1 / shift.rate, -offset / shift.rate)
    found = []
    for triple in combinations(range(net.cameras), 3):
        way = [(triple[k], triple[(k + 1) % 3]) for k in range(3)]
        if all(ends in step for ends in way):
            start = time = float(net.means[triple[0]])
            for ends in way:
                rate, offset = step[ends]
                time = rate * time + offset
            found.append((triple, time - start))
    return found


def _reason(net: Network, shifts: Mapping[tuple[int, int], Shift], best: Reading, rivals: Sequence[Reading], reference: int) -> str:
    """Why the pairs do not decide; empty where they do."""
    lost = best.starts.isnan().nonzero().flatten().tolist()
    if lost:
        return f"no pair leads from the reference to {_named(lost)}: compare further pairs, or leave these cameras out"
    ends, sure = list(shifts), _surely_tied(shifts, best, reference)
    margins = [DECIDED if sure.issuperset(differing(net, best, one)) else CONFIRMED for one in rivals]
    close = [one for one, margin in zip(rivals, margins, strict=True) if one.cost - best.cost < margin]
    if not close:
        return ""
    rival = min(close, key=lambda one: one.cost)
    named = _named(differing(net, best, rival))
    lost = rival.starts.isnan().nonzero().flatten().tolist()
    refused = [pair for pair, shift in shifts.items() if not shift.ok and (not lost or set(lost) & set(pair))]
    if refused:
        first = shifts[refused[0]].reason
        return f"{named}: too few sure pairs, {_listed(refused)} refused ({first})" if len(shifts) > 1 else first
    torn = [pair for pair, one, other in zip(ends, best.labels, rival.labels, strict=True) if one != other]
    return (
        f"{named}: the pairs {_listed(torn)} contradict each other and nothing tells which is wrong; film longer, or add a camera"
    )


def _surely_tied(shifts: Mapping[tuple[int, int], Shift], best: Reading, reference: int) -> set[int]:
    """Cameras tied to the reference by pairs that decide on their own, and are used so."""
    ties = [ends for (ends, shift), label in zip(shifts.items(), best.labels, strict=True) if shift.ok and label == 0]
    tied = {reference}
    for _ in ties:
        tied |= {camera for ends in ties if tied & set(ends) for camera in ends}
    return tied


def _notes(table: Sequence[Pair], cameras: int, shifts: Mapping[tuple[int, int], Shift]) -> tuple[str, ...]:
    notes = []
    degree = [sum(row.used and camera in row.cameras for row in table) for camera in range(cameras)]
    alone = [camera for camera in range(cameras) if degree[camera] == 1]
    if cameras == 2:
        notes.append("two cameras: nothing checks the pair; a third one would")
    elif alone:
        notes.append(f"{_named(alone)}: tied by one pair alone, which nothing checks")
    for row in table:
        i, j = row.cameras
        if row.outlier:
            own = row if row.peak < 0 else None
            away = f" by {own.residual:+.3f} s" if own else f": the others confirm its {_place(row.peak)} at {row.shift:+.3f} s"
            notes.append(f"pair {i}-{j} is sure of itself but contradicts the others{away}")
        elif row.used and not row.ok and cameras > 2:
            notes.append(f"pair {i}-{j} refused on its own; the others confirm its {_place(row.peak)} at {row.shift:+.3f} s")
    notes += [f"pair {i}-{j}: {note}" for (i, j), shift in shifts.items() for note in shift.notes]
    return tuple(notes)


def _named(cameras: Sequence[int]) -> str:
    return f"camera{'s' if len(cameras) > 1 else ''} {', '.join(map(str, cameras))}"


def _listed(pairs: Sequence[tuple[int, int]]) -> str:
    return ", ".join(f"{i}-{j}" for i, j in pairs)


def _place(peak: int) -> str:
    return "best peak" if peak == 0 else f"peak number {peak + 1}"
