"""From clips of several actions to their courses: phases found or given, mirror images counted where an action is its own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from indexing.clip import Clip
from indexing.phase.calibration import wrong_scores
from indexing.phase.course import Course, learn_course
from indexing.phase.cycle import followed, in_step
from indexing.phase.frames import Learned, training_frames
from indexing.phase.model import PhaseModel
from indexing.shape.bank import Windows, stack

MOST = 1500  # frames that an action's course is learned from: 600 costs .9 degrees of phase
KEPT = 1000  # frames of an action that others are compared with, every one as all the cards below
CARDS = (1.0, -1.0, 0.6, -0.6)  # widths of the image: a flat card turned about the vertical, and seen from behind; the turned ones
# take the AUC from one view per take from .970 to .982, 1.6 and .4 to .978
ROUNDS = (2, 3, 4)  # harmonics while phases are found: 58, 16, 20 and 11 degrees from the truth after none to three of them
FIRST = 600  # frames for those
TWIN = 0.35  # of the way from the frames' own residual to that at any phase, on a log scale: CMU
# gait .17-.2, punching, washing, bending .9-1.0; where all views are from one side gait too has .9-1 (nothing tells)

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
) -> tuple[PhaseModel, list[bool]]:
    """The model, and which classes are their own mirror image half a cycle later.

    Args:
        clips: images; label: ``(clips,)``; phases: of each clip, or ``None``; swap: the joints' mirror images from windows and the
            joints seen.
    """
    learned = training_frames(clips)
    twin = swap(learned.frames.values[:500], learned.frames.seen[:500]) if mirror else None
    if mirror is True and twin is None:
        raise ValueError("mirror=True: the joints' mirror images are not known; give clips a skeleton with names, or mirror='auto'")
    courses, banks, labels, kept, mirrored = [], [], [], [], []
    for c in range(int(label.max()) + 1):
        mine = [k for k in range(len(clips)) if int(label[k]) == c]
        of = [learned.clip == k for k in mine]
        parts = [Learned(learned.frames[at], learned.clip[at], learned.times[at]) for at in of]
        given = [phases[k] for k in mine]
        found, repeats = _phases(parts, given, course)
        one = _joined(parts, found)
        if repeats and twin is not None and (mirror is True or _own_mirror(one, twin)):
            one = _with_mirror(one, twin)
            mirrored.append(True)
        else:
            mirrored.append(False)
        courses.append(_course(one, MOST, harmonics, repeats))
        part = _spread(one, KEPT * (1 + mirrored[-1]))
        banks += [_card(part[0].frames, width) for width in CARDS]
        kept += [part[1]] * len(CARDS)
        labels.append(torch.full((len(CARDS) * len(part[1]),), c))
    model = PhaseModel(stack(banks), torch.cat(labels), torch.cat(kept), tuple(courses), torch.zeros(0))
    return replace(model, wrong=wrong_scores(model, learned, label)), mirrored


Phased = tuple[Learned, Tensor]


def _phases(parts: Sequence[Learned], given: Sequence[Tensor | None], course: str) -> tuple[list[Tensor], bool]:
    """Phases of the frames of every clip, and whether the action repeats."""
    known = [values for values in given if values is not None]
    if len(known) == len(given):
        repeats = course == "periodic" or (course == "auto" and _wraps(known))
        return [values.remainder(1.0) if repeats else values.clamp(0, 1) for values in known], repeats
    stepped = None if course == "once" else in_step([(part.frames.values[:, 0], part.times) for part in parts])
    if stepped is None:
        if course == "periodic":
            raise ValueError("course='periodic': no period was found in the clips; give longer ones, or phases")
        return [_once(part.times) for part in parts], False
    for harmonics in ROUNDS:
        found = _course(_joined(parts, stepped), FIRST, harmonics, True)
        stepped = [
            followed(found, part.frames.values[:, 0], part.frames.seen, part.times, phase)
            for part, phase in zip(parts, stepped, strict=True)
        ]
    return stepped, True


def _wraps(known: Sequence[Tensor]) -> bool:
    """Whether phases go beyond [0, 1], or jump back from one frame to the next."""
    steps = torch.cat([values[values.isfinite()].diff() for values in known])
    values = torch.cat(list(known))
    return bool((values.nan_to_num(0.5) > 1).any() or (values.nan_to_num(0.5) < 0).any() or (steps < -0.5).any())


def _once(seconds: Tensor) -> Tensor:
    return (seconds - seconds[0]) / (seconds[-1] - seconds[0])


def _joined(parts: Sequence[Learned], phases: Sequence[Tensor]) -> Phased:
    """All frames of an action whose phase is known."""
    phase = torch.cat(list(phases))
    known = phase.isfinite()
    frames = stack([part.frames for part in parts])
    clip, times = (torch.cat([getattr(part, name) for part in parts]) for name in ("clip", "times"))
    return Learned(frames[known], clip[known], times[known]), phase[known]


def _spread(one: Phased, most: int) -> Phased:
    learned, phase = one
    if len(phase) <= most:
        return one
    at = torch.linspace(0, len(phase) - 1, most).round().long()
    return Learned(learned.frames[at], learned.clip[at], learned.times[at]), phase[at]


def _course(one: Phased, most: int, harmonics: int, repeats: bool) -> Course:
    learned, phase = _spread(one, most)
    return learn_course(
        learned.frames.values[:, 0], learned.frames.seen, phase, learned.clip, harmonics=harmonics, periodic=repeats
    )


def _twins(frames: Windows, swap: Tensor) -> Windows:
    """The mirror images of people: the image mirrored, left and right joints exchanged."""
    return Windows(_card(frames, -1.0).values[:, :, swap], frames.seen[:, swap])


def _card(frames: Windows, width: float) -> Windows:
    """What a far upright camera sees from elsewhere, were the people flat; at width -1, from behind, they need not be."""
    return Windows(frames.values * torch.tensor([width, 1.0], dtype=frames.values.dtype), frames.seen)


def _with_mirror(one: Phased, swap: Tensor) -> Phased:
    learned, phase = one
    twice = (torch.cat([part, part]) for part in (learned.clip, learned.times))
    return Learned(stack([learned.frames, _twins(learned.frames, swap)]), *twice), torch.cat([phase, (phase + 0.5).remainder(1.0)])


def _own_mirror(one: Phased, swap: Tensor) -> bool:
    """Whether the mirrored frames fit the course half a cycle later."""
    learned, phase = _spread(one, FIRST)
    found = _course((learned, phase), FIRST, ROUNDS[1], True)

    def left(frames: Windows, at: Tensor) -> tuple[Tensor, Tensor]:
        curve = found.curve(frames)
        count = curve.shape[1]
        return curve.gather(1, (at * count).round().long().remainder(count)[:, None]).mean().log(), curve.mean().log()

    own, _ = left(learned.frames, phase)
    other, anywhere = left(_twins(learned.frames, swap), phase + 0.5)
    return bool(other - own < TWIN * (anywhere - own))
