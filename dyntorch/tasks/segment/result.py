"""What segment() returns: which match moves with which body, how each body moved, and how sure that is."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from torch import Tensor

from dyntorch.core.solution import Status
from dyntorch.tasks.outcome import Notice, check_results

OUTLIER = 0


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
