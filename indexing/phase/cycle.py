"""Where in its action every training frame is, found from the clips themselves: no view, joint or action is special.

An action that repeats looks like itself a period later, in any one view.  Pieces of clips, each as long as two periods, become
mean cycles; two cycles seen from different viewpoints are brought into step where they share a direction (the epipolar residual
of their motion, :func:`dyntorch.canonical_correlation`, least over all shifts).  An action that does not repeat goes from the
start of its clip to the end.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor

from dyntorch import canonical_correlation, orthonormal_basis
from indexing.phase.course import Course
from indexing.phase.frames import standardized
from indexing.shape.bank import Windows

RATE = 25.0  # samples per second
SHORTEST, LONGEST = 0.3, 4.0  # seconds that a period lasts
DEEP = 0.65  # an action repeats where the best piece of half its clips comes back to 1 - this correlation of the changes of pose:
# CMU walks .12-.3 and on uneven ground .3-.6, punches .2-.3, bending .2-.4; jumps on one leg .63-.78
LOOSE = 0.8  # pieces of such an action count their own period up to this
SAME = 1.3  # lags almost as good as the best one are periods too; the shortest counts
REACH = 3  # samples to either side that a change of pose is measured over: slow turns of the person are none
BINS = 24  # of a mean cycle
PIECE = 2.0  # periods
LOCAL = 5.0  # seconds over which one period may hold
SLOW, FAST = 0.5, 1.6  # of the mean rate, while a clip is followed through its cycle
STEPS = 64  # phases of that path


def period(x: Tensor, seconds: Tensor) -> tuple[float, float]:
    """Seconds after which frames ``(F, n, 2)`` come back, and how far from it they remain (1 = they do not)."""
    x = _sampled(standardized(x, x.new_ones(x.shape[:2])), seconds).flatten(1)
    low, high = round(SHORTEST * RATE), min(round(LONGEST * RATE), 2 * len(x) // 3)
    if high <= low + 2 or len(x) <= 4 * REACH:
        return 0.0, 1.0
    x = x[2 * REACH :] - x[: -2 * REACH]
    lags = range(min(high, len(x) - 2) + 1)
    energy = x.square().sum(1)
    apart = torch.stack(
        [
            1 - 2 * (x[lag:] * x[: len(x) - lag]).sum() / (energy[lag:].sum() + energy[: len(x) - lag].sum()).clamp(min=1e-30)
            for lag in lags
        ]
    )
    dip = (apart[1:-1] <= apart[:-2]) & (apart[1:-1] < apart[2:])
    dip[: low - 1] = False
    if not bool(dip.any()):
        return 0.0, 1.0
    found = dip.nonzero()[:, 0] + 1
    depth = apart[found]
    first = int((depth <= max(SAME * float(depth.min()), 0.5 * DEEP)).nonzero()[0, 0])
    at = int(found[first])
    before, here, after = (float(apart[at + k]) for k in (-1, 0, 1))
    shift = (before - after) / (2 * max(before + after - 2 * here, 1e-12))
    return (at + max(-0.5, min(0.5, shift))) / RATE, float(depth[first])


def _sampled(x: Tensor, seconds: Tensor) -> Tensor:
    """Frames at :data:`RATE`, by linear interpolation."""
    wanted = torch.arange(float(seconds[0]), float(seconds[-1]) + 1e-9, 1 / RATE, dtype=seconds.dtype)
    right = torch.searchsorted(seconds, wanted, right=True).clamp(1, len(seconds) - 1)
    share = ((wanted - seconds[right - 1]) / (seconds[right] - seconds[right - 1])).clamp(0, 1)[:, None, None].to(x)
    return x[right - 1] + share * (x[right] - x[right - 1])


def _local(x: Tensor, seconds: Tensor) -> list[tuple[slice, float, float]]:
    """Pieces of a clip of about :data:`LOCAL` seconds, with the period and its depth in each."""
    count = max(1, round(float(seconds[-1] - seconds[0]) / LOCAL))
    parts = _cut(seconds, slice(0, len(seconds)), count)
    return [(part, *period(x[part], seconds[part])) for part in parts]


def in_step(clips: list[tuple[Tensor, Tensor]]) -> list[Tensor] | None:
    """Phases in [0, 1) of the frames of clips of one action that repeats; ``None`` where it does not.

    Args:
        clips: frames ``(F, n, 2)`` and seconds ``(F,)`` of each.
    """
    local = [_local(*clip) for clip in clips]
    depths = sorted(min(depth for _, _, depth in parts) for parts in local)
    if depths[len(depths) // 2] > DEEP:
        return None
    sure = sorted(seconds for parts in local for _, seconds, depth in parts if depth <= DEEP)
    usual = sure[len(sure) // 2]
    cycles, owner = [], []
    for k, ((x, t), parts) in enumerate(zip(clips, local, strict=True)):
        for part, seconds, depth in parts:
            tempo = seconds if depth <= LOOSE and 0.6 < seconds / usual < 1.6 else usual
            for piece in _cut(t, part, max(1, round(float(t[part][-1] - t[part][0]) / (PIECE * tempo)))):
                cycles.append(_mean_cycle(x[piece], t[piece], tempo))
                owner.append((k, piece, tempo))
    shifts = _shifts(torch.stack(cycles))
    phases = [torch.zeros_like(t) for _, t in clips]
    for (k, piece, tempo), shift in zip(owner, shifts, strict=True):
        phases[k][piece] = (clips[k][1][piece] / tempo + shift).remainder(1.0)
    return phases


def _cut(seconds: Tensor, part: slice, count: int) -> list[slice]:
    """A part of a clip in so many parts of the same duration."""
    inside = seconds[part]
    edges = torch.linspace(float(inside[0]), float(inside[-1]), count + 1, dtype=seconds.dtype)
    cuts = [part.start, *(part.start + torch.searchsorted(inside, edges[1:-1])).tolist(), part.stop]
    return [slice(a, b) for a, b in pairwise(cuts) if b > a + 1]


def _mean_cycle(x: Tensor, seconds: Tensor, period_: float) -> Tensor:
    """``(BINS, n, 2)`` mean frame around every phase; the phase is time over period."""
    x = standardized(x, x.new_ones(x.shape[:2]))
    phase = seconds / period_
    apart = (phase[:, None] - torch.arange(BINS, dtype=phase.dtype) / BINS + 0.5).remainder(1.0) - 0.5
    weight = torch.exp(-0.5 * (apart * BINS).square()) + 1e-12  # a phase that a short clip misses takes the nearest frames
    return torch.einsum("fg,fnd->gnd", weight / weight.sum(0), x)


def _shifts(cycles: Tensor) -> list[float]:
    """What to add to each cycle's own phase, so that all are in step with the one that fits the others best."""
    moving = cycles - cycles.mean(1, keepdim=True)
    count = len(moving)
    turned = torch.stack([moving.roll(-k, dims=1) for k in range(BINS)], 1)  # cycle at phase + k
    basis = orthonormal_basis((turned - turned.mean(2, keepdim=True)).flatten(2, 3).flatten(0, 1))
    apart = 1 - canonical_correlation(basis[::BINS], basis)
    apart = (apart + 1e-3).log().unflatten(1, (count, BINS))  # (cycle, other, shift of the other)
    rise = (apart.mean(2) - apart.amin(2)).fill_diagonal_(0)
    done, shifts = [int(rise.sum(1).argmax())], [0] * count
    while len(done) < count:
        rest = [k for k in range(count) if k not in done]
        # one known to lag by s against the first sees the others s bins off
        total = torch.stack([apart[d, rest].roll(shifts[d], 1) for d in done]).sum(0)
        best = int((total.mean(1) - total.amin(1)).argmax())
        shifts[rest[best]] = int(total[best].argmin())
        done.append(rest[best])
    return [-shift / BINS for shift in shifts]


def followed(course: Course, x: Tensor, seen: Tensor, seconds: Tensor, phase: Tensor) -> Tensor:
    """Phases of one clip's frames that go forward at about the clip's rate and leave least, by dynamic programming.

    Args:
        phase: ``(F,)`` where each frame was thought to be; only its mean rate is used.
    """
    if len(x) < 3:
        return phase
    curve = (course.curve(Windows(x[:, None], seen), STEPS) + 1e-3).log()
    steps = (phase.diff() + 0.5).remainder(1.0) - 0.5
    rate = float(steps.median() / seconds.diff().median())
    least = (SLOW * rate * seconds.diff() * STEPS).floor().long().clamp(min=0)
    most = torch.maximum((FAST * rate * seconds.diff() * STEPS).ceil().long(), least + 1)
    cost, back = curve[0], []
    for f in range(1, len(curve)):
        moves = torch.arange(int(least[f - 1]), int(most[f - 1]) + 1)
        came = torch.stack([cost.roll(int(move)) for move in moves])
        best = came.min(0)
        back.append(moves[best.indices])
        cost = best.values + curve[f]
    at = [int(cost.argmin())]
    for move in reversed(back):
        at.append((at[-1] - int(move[at[-1]])) % STEPS)
    return torch.tensor(at[::-1], dtype=phase.dtype) / STEPS
