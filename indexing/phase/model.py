"""What is learned of all actions, and the evidence that one frame gives for each of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from indexing.phase.course import GRID, Course, curves
from indexing.phase.frames import LEAST, image_distance
from indexing.shape.bank import EPSILON, Windows

NEAREST = 5  # frames of other actions that an action is held against: 1 costs .004 of the AUC
NEAR = 4  # steps of the grid, .04 of the course: frames this near in phase stand for a phase; twice as many cost .3 degrees
MIX = 0.5  # weight of the shape beside the nearest images: 0 / .5 / 1 give .867 / .957 / .946 AUC from one view per take

PAIRS = 4_000_000  # of frames compared at once: bounds memory whatever the length of a recording


@dataclass(frozen=True)
class PhaseModel:
    """Training frames of all classes and the courses of their shapes.

    bank: frames ``(E, 1, n, 2)``; label ``(E,)``; phase ``(E,)`` in [0, 1]; courses: one per class; wrong: ``(seconds,)`` the best
    score of training seconds whose class was left out, empty where there are fewer than three classes.
    """

    bank: Windows
    label: Tensor
    phase: Tensor
    courses: tuple[Course, ...]
    wrong: Tensor

    def to(self, device: torch.device | str) -> PhaseModel:
        """The same on another device."""
        courses = tuple(Course(c.shapes.to(device), c.periodic, c.seen.to(device)) for c in self.courses)
        return PhaseModel(self.bank.to(device), self.label.to(device), self.phase.to(device), courses, self.wrong)

    def without(self, c: int) -> PhaseModel:
        """As if a class had never been learned."""
        kept = self.label != c
        label = self.label[kept]
        return replace(
            self,
            bank=self.bank[kept],
            label=label - (label > c).long(),
            phase=self.phase[kept],
            courses=(*self.courses[:c], *self.courses[c + 1 :]),
        )

    def evidence(self, query: Windows) -> tuple[Tensor, Tensor]:
        r"""Score and phase of every frame for every class, ``(Q, classes)`` each.

        .. math:: s_c = \max_\phi\big[-\tfrac12\log r_c(\phi) - \tfrac12 \log d_c(\phi)\big] + \log d_{\bar c}

        with r the residual outside span[1, X(phi)], d the distance from the nearest training image at that phase, and the last
        term that from the nearest images of the other actions.  A frame that shows fewer than six joints scores 0 everywhere, at
        phase NaN.
        """
        step = max(1, PAIRS // max(1, len(self.bank)))
        parts = [self._evidence(query[at : at + step]) for at in range(0, len(query), step)]
        return torch.cat([scores for scores, _ in parts]), torch.cat([phase for _, phase in parts])

    def _evidence(self, query: Windows) -> tuple[Tensor, Tensor]:
        distance = image_distance(query, self.bank)
        scores, found = [], []
        for c, (course, shapes) in enumerate(zip(self.courses, curves(query, self.courses), strict=True)):
            mine = self.label == c
            images = _by_phase(distance[:, mine], self.phase[mine], course.periodic)
            curve = MIX * _log(shapes) + (1 - MIX) * _log(images)
            best, phase = _lowest(curve, course.periodic)
            others = distance[:, ~mine]
            rival = _log(others.topk(min(NEAREST, others.shape[1]), largest=False).values.mean(1)) if others.shape[1] else 0.0
            scores.append(rival - best)
            found.append(phase)
        told = (query.seen.sum(1) >= LEAST)[:, None]
        return torch.where(told, torch.stack(scores, 1), 0.0), torch.where(told, torch.stack(found, 1), torch.nan)


def _log(residual: Tensor) -> Tensor:
    return (residual + EPSILON).log()


def _by_phase(distance: Tensor, phase: Tensor, periodic: bool) -> Tensor:
    """``(Q, GRID)`` distance from the nearest frame within ``NEAR`` steps of every phase, 1 where there is none."""
    at = (phase * (GRID if periodic else GRID - 1)).round().long().remainder(GRID)
    nearest = distance.new_ones(len(distance), GRID).scatter_reduce(1, at.expand(distance.shape), distance, "amin")
    sides = nearest[:, -NEAR:], nearest[:, :NEAR]
    if not periodic:
        sides = torch.ones_like(sides[0]), torch.ones_like(sides[1])
    return torch.cat([sides[0], nearest, sides[1]], 1).unfold(1, 2 * NEAR + 1, 1).amin(2)


def _lowest(curve: Tensor, periodic: bool) -> tuple[Tensor, Tensor]:
    """Least value ``(Q,)`` and its phase, between grid points by a parabola."""
    value, at = curve.min(1)
    last = curve.shape[1] - 1
    sides = [(at + step).remainder(last + 1) if periodic else (at + step).clamp(0, last) for step in (-1, 1)]
    before, after = (curve.gather(1, side[:, None])[:, 0] for side in sides)
    bend = before + after - 2 * value
    shift = torch.where(bend > 1e-12, (before - after) / (2 * bend.clamp(min=1e-12)), 0.0).clamp(-0.5, 0.5)
    if not periodic:
        return value, ((at + torch.where((at > 0) & (at < last), shift, 0.0)) / last).clamp(0, 1)
    phase = ((at + shift) / (last + 1)).remainder(1.0)
    return value, torch.where(phase < 1.0, phase, 0.0)
