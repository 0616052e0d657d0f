"""What segment() returns: which match moves with which body, how each body moved, and how sure that is."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from dyntorch.solution import Status
from dyntorch.tasks.notices import Notice, NoticeCode, check_results, notices

if TYPE_CHECKING:
    from dyntorch.tasks.bodies_outcome import Outcome

OUTLIER = 0
REPEATED = 0.1
"""Share of repeated matches that deserves a notice."""
SPARSE = 0.3
"""Share of matches that move like their neighbours below which geometry alone may do better."""


class BodyModel(StrEnum):
    """What two views say of the motion of one body."""

    FUNDAMENTAL = "fundamental"
    """A rigid body with depth: a fundamental matrix."""
    HOMOGRAPHY = "homography"
    """A plane, or a body seen under a rotation alone: a homography, and no unique fundamental matrix."""


@dataclass(frozen=True, eq=False, repr=False)
class Segmentation:
    """Bodies in two views.

    Where problems of a batch have different numbers of bodies, K is the largest; what is behind ``bodies`` is 0.

    Attributes:
        labels: ``(*batch, n)`` int64, 0 outlier, 1..K the bodies: the larger first, of equally large ones that of
            the earliest match.
        bodies: ``(*batch,)`` int64, how many bodies.
        fundamentals: ``(*batch, K, 3, 3)`` of norm 1, :math:`x_2^T F x_1 = 0`.  Where ``models`` says homography, F is one of the
            family :math:`[e]_\\times H` that fit the matches alike.
        homographies: ``(*batch, K, 3, 3)`` of norm 1, view 1 to view 2; 0 where ``models`` says fundamental.
        models: for one problem a tuple of K :class:`BodyModel`, for a batch nested tuples.
        probabilities: ``(*batch, n, K + 1)``: column 0 outlier, then the bodies; rows sum to 1 (0 for missing matches).
        residuals: ``(*batch, n)`` Sampson distance from the own body's model, for outliers from the nearest body's, in the unit of
            the points; 0 where there is no body.  Labels are found by the fundamental matrices: where ``models`` says homography,
            a few matches of the body may be far from its plane.
        coherence: ``(*batch, n)`` in [0, 1]: how well a match moves like its neighbours in both images; 0 where ``spatial=False``.
        status: ``(*batch,)`` of :class:`dyntorch.Status`.
        threshold: ``(*batch,)`` Sampson distance that divides inliers from outliers where nothing else is known, as in
            :func:`dyntorch.segment`, in the unit of the points.
        warnings: notices.
    """

    labels: Tensor
    bodies: Tensor
    fundamentals: Tensor
    homographies: Tensor
    models: tuple[Any, ...]
    probabilities: Tensor
    residuals: Tensor
    coherence: Tensor
    status: Tensor
    threshold: Tensor
    warnings: tuple[Notice, ...]

    def check(self) -> Segmentation:
        """Raise where any problem failed.

        Raises:
            ValueError: says which problems failed, how, and what to do.
        """
        check_results("segment", self.status, self.warnings)
        return self

    def __repr__(self) -> str:
        shape = tuple(self.status.shape)
        states = ", ".join(f"{int((self.status == s).sum())} {s.name}" for s in Status if bool((self.status == s).any()))
        lines = [f"Segmentation(matches={self.labels.shape[-1]}, batch={shape}: {states or 'empty'})"]
        if not shape:
            lines += [
                f"  body {number}: {int((self.labels == number).sum())} matches, {model}"
                for number, model in enumerate(self.models, start=1)
            ]
            lines.append(f"  outliers: {int((self.labels == OUTLIER).sum())}")
            lines += [f"  warning {notice}" for notice in self.warnings]
        elif self.bodies.numel():
            lines.append(f"  bodies: {int(self.bodies.min())} to {int(self.bodies.max())}")
            lines.append(f"  warnings: {len(self.warnings)}")
        return "\n".join(lines)


def segmentation_notices(found: list[Outcome], bodies: int | None, batch: tuple[int, ...]) -> tuple[Notice, ...]:
    """What limits the results of a batch."""
    if not found:
        return ()
    count = torch.tensor([float(outcome.count) for outcome in found])
    repeated = torch.tensor([outcome.repeated for outcome in found])
    linked = torch.tensor([outcome.linked for outcome in found])
    tried = torch.tensor([outcome.status != Status.TOO_FEW for outcome in found])
    spatial = linked < 1.0  # where neighbours do not matter, all matches count
    said = []
    coarse = torch.tensor([outcome.coarse for outcome in found])
    tried = tried & (coarse == 0)
    message = "the threshold is {value:.2g} of the spread of the points, and everything is near everything; give it in their unit"
    said += notices(NoticeCode.COARSE, message, coarse, coarse > 0, batch)
    if bodies is not None:
        message = f"{bodies} bodies were asked for, the matches carry {{value:g}}; ask for fewer, or add matches of the others"
        said += notices(NoticeCode.FEWER_BODIES, message, count, tried & (count < bodies), batch)
        # where a body got lost, the notice above says so
        spare = torch.tensor([outcome.spare for outcome in found]) & (count == bodies)
        message = f"{{value:g}} bodies explain the matches no worse than {bodies}: one may be a part of another; ask for fewer"
        said += notices(NoticeCode.SPARE_BODY, message, count - 1, spare, batch)
    message = "a share of {value:.2g} of the matches repeats others and says nothing new; remove repeated matches"
    said += notices(NoticeCode.REPEATED, message, repeated, repeated > REPEATED, batch)
    message = "the share of matches that move like their neighbours is {value:.2g}; try spatial=False if bodies interleave"
    said += notices(NoticeCode.INCOHERENT, message, linked, tried & spatial & (linked < SPARSE), batch)
    return tuple(said)
