"""From clips of several actions to their courses: phases found or given, mirror images counted where an action is its own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

import torch
from torch import Tensor

from dyntorch.numerics import canonical_correlation, on_cpu, orthonormal_basis
from indexing.action.bank import Windows, stack
from indexing.clip import Clip
from indexing.phase.model import (
    Course,
    PhaseModel,
    PhaseOptions,
    TrainingFrames,
    learn_course,
    normalize_frames,
    training_frames,
    wrong_scores,
)

MAX_MIRROR_FRAMES = 500  # by which the joints' mirror images are recognized
COMPARED_RATE = 25.0  # samples per second at which clips are compared with themselves
# 1 - correlation of changes of pose a period later, of half the clips: CMU walks .12-.6, punches .2-.3, jumps on one leg .63-.78
MAX_PERIODIC_DEPTH = 0.65
MAX_OWN_PERIOD_DEPTH = 0.8  # the same up to which pieces of such an action count their own period
MAX_DEPTH_RATIO = 1.3  # to the best lag, up to which lags are periods too; the shortest counts
CHANGE_REACH = 3  # samples to either side that a change of pose is measured over: slow turns of the person are none
CYCLE_BINS = 24  # of a mean cycle
PIECE_PERIODS = 2.0  # of the pieces that become mean cycles
LOCAL_SECONDS = 5.0  # over which one period may hold
MIN_RATE = 0.5  # of the mean, while a clip is followed through its cycle
MAX_RATE = 1.6  # the same
PATH_STEPS = 64  # phases of that path
# of a flat card turned about the vertical, and seen from behind: AUC from one view per take .970 -> .982
CARD_WIDTHS = (1.0, -1.0, 0.6, -0.6)
COARSE_HARMONICS = (2, 3, 4)  # while phases are estimated: 58, 16, 20 and 11 degrees from the truth after none to three of them
MAX_COARSE_FRAMES = 600  # for those
MIRROR_HARMONICS = 3  # by which an action is compared with its own mirror image
# of the way from the frames' own residual to that at any phase, log scale: CMU gait .17-.2, punching, bending .9-1.0
MAX_MIRROR_SHARE = 0.35

# ----------------------------------------------------------------------------------------------------------------------
# Where in its action every training frame is, found from the clips themselves: no view, joint or action is special.
#
# An action that repeats looks like itself a period later, in any one view.  Pieces of clips, each as long as two periods, become
# mean cycles; two cycles seen from different viewpoints are brought into step where they share a direction (the epipolar residual
# of their motion, :func:`dyntorch.numerics.canonical_correlation`, least over all shifts).  An action that does not repeat goes
# from the start of its clip to the end.


def period(x: Tensor, seconds: Tensor, options: PhaseOptions) -> tuple[float, float]:
    """Seconds after which frames ``(F, n, 2)`` come back, and how far from it they remain (1 = they do not)."""
    x = _resample(normalize_frames(x, x.new_ones(x.shape[:2])), seconds).flatten(1)
    low, high = round(options.min_period * COMPARED_RATE), min(round(options.max_period * COMPARED_RATE), 2 * len(x) // 3)
    if high <= low + 2 or len(x) <= 4 * CHANGE_REACH:
        return 0.0, 1.0
    x = x[2 * CHANGE_REACH :] - x[: -2 * CHANGE_REACH]
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
    first = int((depth <= max(MAX_DEPTH_RATIO * float(depth.min()), 0.5 * MAX_PERIODIC_DEPTH)).nonzero()[0, 0])
    at = int(found[first])
    before, here, after = (float(apart[at + k]) for k in (-1, 0, 1))
    shift = (before - after) / (2 * max(before + after - 2 * here, 1e-12))
    return (at + max(-0.5, min(0.5, shift))) / COMPARED_RATE, float(depth[first])


def _resample(x: Tensor, seconds: Tensor) -> Tensor:
    """Frames at the rate of the options, by linear interpolation."""
    wanted = torch.arange(float(seconds[0]), float(seconds[-1]) + 1e-9, 1 / COMPARED_RATE, dtype=seconds.dtype)
    right = torch.searchsorted(seconds, wanted, right=True).clamp(1, len(seconds) - 1)
    share = ((wanted - seconds[right - 1]) / (seconds[right] - seconds[right - 1])).clamp(0, 1)[:, None, None].to(x)
    return x[right - 1] + share * (x[right] - x[right - 1])


def _local(x: Tensor, seconds: Tensor, options: PhaseOptions) -> list[tuple[slice, float, float]]:
    """Pieces of a clip of a few seconds, with the period and its depth in each."""
    count = max(1, round(float(seconds[-1] - seconds[0]) / LOCAL_SECONDS))
    parts = _split_times(seconds, slice(0, len(seconds)), count)
    return [(part, *period(x[part], seconds[part], options=options)) for part in parts]


@on_cpu
def synchronize_cycles(clips: list[tuple[Tensor, Tensor]], options: PhaseOptions) -> list[Tensor] | None:
    """Phases in [0, 1) of the frames of clips of one action that repeats; ``None`` where it does not. clips ``(F, n, 2)``."""
    local = [_local(*clip, options=options) for clip in clips]
    depths = sorted(min(depth for _, _, depth in parts) for parts in local)
    if depths[len(depths) // 2] > MAX_PERIODIC_DEPTH:
        return None
    sure = sorted(seconds for parts in local for _, seconds, depth in parts if depth <= MAX_PERIODIC_DEPTH)
    usual = sure[len(sure) // 2]
    cycles, owner = [], []
    for k, ((x, t), parts) in enumerate(zip(clips, local, strict=True)):
        for part, seconds, depth in parts:
            tempo = seconds if depth <= MAX_OWN_PERIOD_DEPTH and 0.6 < seconds / usual < 1.6 else usual
            for piece in _split_times(t, part, max(1, round(float(t[part][-1] - t[part][0]) / (PIECE_PERIODS * tempo)))):
                cycles.append(_mean_cycle(x[piece], t[piece], tempo))
                owner.append((k, piece, tempo))
    shifts = _shifts(torch.stack(cycles))
    phases = [torch.zeros_like(t) for _, t in clips]
    for (k, piece, tempo), shift in zip(owner, shifts, strict=True):
        phases[k][piece] = (clips[k][1][piece] / tempo + shift).remainder(1.0)
    return phases


def _split_times(seconds: Tensor, part: slice, count: int) -> list[slice]:
    """A part of a clip in so many parts of the same duration."""
    inside = seconds[part]
    edges = torch.linspace(float(inside[0]), float(inside[-1]), count + 1, dtype=seconds.dtype)
    cuts = [part.start, *(part.start + torch.searchsorted(inside, edges[1:-1])).tolist(), part.stop]
    return [slice(a, b) for a, b in pairwise(cuts) if b > a + 1]


def _mean_cycle(x: Tensor, seconds: Tensor, period_: float) -> Tensor:
    """``(bins, n, 2)`` mean frame around every phase; the phase is time over period."""
    x = normalize_frames(x, x.new_ones(x.shape[:2]))
    phase = seconds / period_
    apart = (phase[:, None] - torch.arange(CYCLE_BINS, dtype=phase.dtype) / CYCLE_BINS + 0.5).remainder(1.0) - 0.5
    # a phase that a short clip misses takes the nearest frames
    weight = torch.exp(-0.5 * (apart * CYCLE_BINS).square()) + 1e-12
    return torch.einsum("fg,fnd->gnd", weight / weight.sum(0), x)


def _shifts(cycles: Tensor) -> list[float]:
    """What to add to each cycle's own phase, so that all are in step with the one that fits the others best."""
    moving = cycles - cycles.mean(1, keepdim=True)
    count = len(moving)
    turned = torch.stack([moving.roll(-k, dims=1) for k in range(CYCLE_BINS)], 1)  # cycle at phase + k
    basis = orthonormal_basis((turned - turned.mean(2, keepdim=True)).flatten(2, 3).flatten(0, 1))
    apart = 1 - canonical_correlation(basis[::CYCLE_BINS], basis)
    apart = (apart + 1e-3).log().unflatten(1, (count, CYCLE_BINS))  # (cycle, other, shift of the other)
    rise = (apart.mean(2) - apart.amin(2)).fill_diagonal_(0)
    done, shifts = [int(rise.sum(1).argmax())], [0] * count
    while len(done) < count:
        rest = [k for k in range(count) if k not in done]
        # one known to lag by s against the first sees the others s bins off
        total = torch.stack([apart[d, rest].roll(shifts[d], 1) for d in done]).sum(0)
        best = int((total.mean(1) - total.amin(1)).argmax())
        shifts[rest[best]] = int(total[best].argmin())
        done.append(rest[best])
    return [-shift / CYCLE_BINS for shift in shifts]


def track_phases(course: Course, x: Tensor, seen: Tensor, seconds: Tensor, phase: Tensor) -> Tensor:
    """Phases of one clip's frames that go forward at about the clip's rate and leave least, by dynamic programming. phase
    ``(F,)``."""
    if len(x) < 3:
        return phase
    # one comparison of all frames at once, and then one step after the other, which only the CPU is quick at
    curve = (course.curve(Windows(x[:, None], seen), PATH_STEPS) + 1e-3).log().cpu()
    home, seconds, phase = phase.device, seconds.cpu(), phase.cpu()
    steps = (phase.diff() + 0.5).remainder(1.0) - 0.5
    rate = float(steps.median() / seconds.diff().median())
    least = (MIN_RATE * rate * seconds.diff() * PATH_STEPS).floor().long().clamp(min=0)
    most = torch.maximum((MAX_RATE * rate * seconds.diff() * PATH_STEPS).ceil().long(), least + 1)
    cost, back = curve[0], []
    for f in range(1, len(curve)):
        moves = torch.arange(int(least[f - 1]), int(most[f - 1]) + 1)
        came = torch.stack([cost.roll(int(move)) for move in moves])
        best = came.min(0)
        back.append(moves[best.indices])
        cost = best.values + curve[f]
    at = [int(cost.argmin())]
    for move in reversed(back):
        at.append((at[-1] - int(move[at[-1]])) % PATH_STEPS)
    return (torch.tensor(at[::-1], dtype=phase.dtype) / PATH_STEPS).to(home)


Swap = Callable[[Tensor, Tensor], Tensor | None]


def learn_model(
    clips: Sequence[Clip],
    label: Tensor,
    phases: Sequence[Tensor | None],
    *,
    harmonics: int,
    course: str,
    mirror: str | bool,
    swap: Swap,
    device: torch.device | str,
    camera: str,
    options: PhaseOptions,
) -> tuple[PhaseModel, list[bool]]:
    """The model, on the CPU, and which classes are their own mirror image half a cycle later. clips ``(clips,)``."""
    learned = training_frames(clips)
    some = learned.frames[:MAX_MIRROR_FRAMES]
    twin = swap(some.values, some.seen) if mirror else None
    learned, phases = learned.to(device), [None if values is None else values.to(device) for values in phases]
    if mirror is True and twin is None:
        raise ValueError("mirror=True: the joints' mirror images are not known; give clips a skeleton with names, or mirror='auto'")
    courses, banks, labels, kept, mirrored = [], [], [], [], []
    for c in range(int(label.max()) + 1):
        mine = [k for k in range(len(clips)) if int(label[k]) == c]
        of = [learned.clip == k for k in mine]
        parts = [TrainingFrames(learned.frames[at], learned.clip[at], learned.times[at]) for at in of]
        given = [phases[k] for k in mine]
        found, repeats = _phases(parts, given, course, options)
        one = _concatenate(parts, found)
        if repeats and twin is not None and (mirror is True or _is_own_mirror(one, twin, options)):
            one = _with_mirror(one, twin)
            mirrored.append(True)
        else:
            mirrored.append(False)
        courses.append(_fit_course(one, options.max_training_frames, harmonics, repeats))
        part = _spread(one, options.max_kept_frames * (1 + mirrored[-1]))
        banks += [_card(part[0].frames, width) for width in CARD_WIDTHS]
        kept += [part[1]] * len(CARD_WIDTHS)
        labels.append(torch.full((len(CARD_WIDTHS) * len(part[1]),), c, device=part[1].device))
    model = PhaseModel(stack(banks), torch.cat(labels), torch.cat(kept), tuple(courses), torch.zeros(0), options, camera)
    return replace(model, wrong=wrong_scores(model, learned, label.to(learned.clip.device))).to("cpu"), mirrored


Phased = tuple[TrainingFrames, Tensor]


def _phases(
    parts: Sequence[TrainingFrames], given: Sequence[Tensor | None], course: str, options: PhaseOptions
) -> tuple[list[Tensor], bool]:
    """Phases of the frames of every clip, and whether the action repeats."""
    known = [values for values in given if values is not None]
    if len(known) == len(given):
        repeats = course == "periodic" or (course == "auto" and _wraps(known))
        return [values.remainder(1.0) if repeats else values.clamp(0, 1) for values in known], repeats
    stepped = (
        None
        if course == "once"
        else synchronize_cycles([(part.frames.values[:, 0], part.times) for part in parts], options=options)
    )
    if stepped is None:
        if course == "periodic":
            raise ValueError("course='periodic': no period was found in the clips; give longer ones, or phases")
        return [_phase_by_time(part.times) for part in parts], False
    for harmonics in COARSE_HARMONICS:
        found = _fit_course(_concatenate(parts, stepped), MAX_COARSE_FRAMES, harmonics, True)
        stepped = [
            track_phases(found, part.frames.values[:, 0], part.frames.seen, part.times, phase)
            for part, phase in zip(parts, stepped, strict=True)
        ]
    return stepped, True


def _wraps(known: Sequence[Tensor]) -> bool:
    """Whether phases go beyond [0, 1], or jump back from one frame to the next."""
    steps = torch.cat([values[values.isfinite()].diff() for values in known])
    values = torch.cat(list(known))
    return bool((values.nan_to_num(0.5) > 1).any() or (values.nan_to_num(0.5) < 0).any() or (steps < -0.5).any())


def _phase_by_time(seconds: Tensor) -> Tensor:
    return (seconds - seconds[0]) / (seconds[-1] - seconds[0])


def _concatenate(parts: Sequence[TrainingFrames], phases: Sequence[Tensor]) -> Phased:
    """All frames of an action whose phase is known."""
    phase = torch.cat(list(phases))
    known = phase.isfinite()
    frames = stack([part.frames for part in parts])
    clip, times = (torch.cat([getattr(part, name) for part in parts]) for name in ("clip", "times"))
    return TrainingFrames(frames[known], clip[known], times[known]), phase[known]


def _spread(one: Phased, most: int) -> Phased:
    learned, phase = one
    if len(phase) <= most:
        return one
    at = torch.linspace(0, len(phase) - 1, most).round().long()
    return TrainingFrames(learned.frames[at], learned.clip[at], learned.times[at]), phase[at]


def _fit_course(one: Phased, most: int, harmonics: int, repeats: bool) -> Course:
    learned, phase = _spread(one, most)
    return learn_course(
        learned.frames.values[:, 0],
        learned.frames.seen,
        phase,
        learned.clip,
        harmonics=harmonics,
        periodic=repeats,
    )


def _twins(frames: Windows, swap: Tensor) -> Windows:
    """The mirror images of people: the image mirrored, left and right joints exchanged."""
    return Windows(_card(frames, -1.0).values[:, :, swap], frames.seen[:, swap])


def _card(frames: Windows, width: float) -> Windows:
    """What a far upright camera sees from elsewhere, were the people flat; at width -1, from behind, they need not be."""
    return Windows(frames.values * frames.values.new_tensor([width, 1.0]), frames.seen)


def _with_mirror(one: Phased, swap: Tensor) -> Phased:
    learned, phase = one
    twice = (torch.cat([part, part]) for part in (learned.clip, learned.times))
    return TrainingFrames(stack([learned.frames, _twins(learned.frames, swap)]), *twice), torch.cat(
        [phase, (phase + 0.5).remainder(1.0)]
    )


def _is_own_mirror(one: Phased, swap: Tensor, options: PhaseOptions) -> bool:
    """Whether the mirrored frames fit the course half a cycle later."""
    learned, phase = _spread(one, MAX_COARSE_FRAMES)
    found = _fit_course((learned, phase), MAX_COARSE_FRAMES, MIRROR_HARMONICS, True)

    def mean_residuals(frames: Windows, at: Tensor) -> tuple[Tensor, Tensor]:
        curve = found.curve(frames, options.num_phases)
        count = curve.shape[1]
        return curve.gather(1, (at * count).round().long().remainder(count)[:, None]).mean().log(), curve.mean().log()

    own, _ = mean_residuals(learned.frames, phase)
    other, anywhere = mean_residuals(_twins(learned.frames, swap), phase + 0.5)
    return bool(other - own < MAX_MIRROR_SHARE * (anywhere - own))
