"""The ways from three views of points of space to A and B that the experiments on real recordings compare."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

import dyntorch as dyn
from dyntorch import metrics
from dyntorch.geometry.homogeneous import apply
from dyntorch.geometry.rigid import rigid_alignment

Matrices = tuple[Tensor, Tensor]
Solver = Callable[[list[Tensor], Matrices], tuple[Matrices, str]]
"""Views and true motion (for the gauge only) to A, B and a status."""


def gap(found: Matrices, true: Matrices, views: list[Tensor]) -> float:
    """Median distance between the points of view 2 and 3 as two motions carry them to view 1; the worse view."""
    pairs = zip(found, true, views[1:], strict=True)
    return float(max((apply(a, x) - apply(b, x)).norm(dim=-1).nan_to_num(nan=torch.inf).median() for a, b, x in pairs))


def up_to_gauge(motion: tuple[Tensor, ...], true: Matrices) -> Matrices:
    """A and B of three sensors known up to an affinity of the world and a common velocity."""
    eye = torch.eye(4, dtype=torch.float64)
    sensors = torch.stack([eye, torch.linalg.inv(true[0]), torch.linalg.inv(true[1])])
    aligned, _ = metrics.affine_gauge(torch.stack(motion), sensors)
    return aligned[0] @ torch.linalg.pinv(aligned[1]), aligned[0] @ torch.linalg.pinv(aligned[2])


def tensor(invariant: type[dyn.Invariant]) -> Solver:
    def solve(views: list[Tensor], true: Matrices) -> tuple[Matrices, str]:
        found = dyn.fit(invariant, *views)
        pair = (found.motion[0], found.motion[1]) if len(found.motion) == 2 else up_to_gauge(found.motion, true)
        return pair, dyn.Status(int(found.status)).name

    return solve


def aligned(model: str) -> Solver:
    def solve(views: list[Tensor], true: Matrices) -> tuple[Matrices, str]:
        one = dyn.align_points(*views, model=model, generator=torch.Generator().manual_seed(0))
        assert one.B is not None
        pair = one.A, one.B
        if model == "constant_velocity":
            eye = torch.eye(4, dtype=torch.float64)
            pair = up_to_gauge((eye, torch.linalg.pinv(one.A), torch.linalg.pinv(one.B)), true)
        codes = ", ".join(sorted({notice.code.value for notice in one.warnings}))
        return pair, dyn.Status(int(one.status)).name + (f" ({codes})" if codes else "")

    return solve


def rigid_ransac(first: Tensor, second: Tensor, threshold: float, generator: torch.Generator, samples: int = 500) -> Tensor:
    """Rigid motion of view 2 to view 1 on which the most points agree, refitted to them: whatever moves is an outlier."""
    order = torch.rand(samples, len(first), generator=generator).argsort(-1)[:, :3]
    candidates = rigid_alignment(first[order], second[order])
    distance = (second @ candidates[:, :3, :3].mT + candidates[:, None, :3, 3] - first).norm(dim=-1)
    limit = threshold * 2**0.5  # both points have noise
    found = candidates[distance.clamp(max=limit).square().sum(-1).argmin()]
    for _ in range(5):
        inside = (apply(found, second) - first).norm(dim=-1) < limit
        if int(inside.sum()) < 3:
            break
        found = rigid_alignment(first[inside], second[inside])
    return found


def median(values: Sequence[float]) -> float:
    """The middle value (the lower one of two)."""
    return float(torch.tensor(list(values)).median())


def listed(counts: Counter[str]) -> str:
    """Counts in words."""
    return ", ".join(f"{count} {name}" for name, count in sorted(counts.items()))
