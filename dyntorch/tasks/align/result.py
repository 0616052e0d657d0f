"""What the alignment tasks return: the motion of the sensor, a label for every match, and what should be known about them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from dyntorch.core.solution import Solution, Status, agreed
from dyntorch.tasks.outcome import Notice, NoticeCode, check_results

OUTLIER, STATIC, MOVING = 0, 1, 2


@dataclass(frozen=True, eq=False, repr=False)
class Alignment:
    """Result of ``align_planar``, ``align_points`` and ``align_lines``.

    Attributes:
        A: ``(*batch, d + 1, d + 1)`` motion of the sensor, view 2 to view 1, :math:`p_1 \\sim A\\,p_2` for static points;
            Frobenius norm 1; zero where the status says that there is none, the best one found for ``NO_CONSENSUS``.
        B: the same for view 3; None with two views.
        labels: ``(*batch, n)`` 0 outlier, 1 static, 2 moving; all 0 where the status is neither OK nor AMBIGUOUS.
        status: ``(*batch,)`` of :class:`dyntorch.Status`.
        sigma: ``(*batch,)`` noise of one coordinate that the inliers show, in the unit of the matches; 0 where there are none.
        covariance: ``(*batch, p, p)`` of the entries of A, then those of B, row by row.
        ambiguity: a sentence: what the data cannot tell, even without noise.
        warnings: notices on single problems of the batch, in its order.
        velocities: ``(*batch, n, d)``, where the model has them.
        unverified: ``(*batch, n)`` matches that stand still between two of three views: moving by geometry, but a static point
            mismatched in one view looks the same.
        solution: the fitted invariant behind it.
    """

    A: Tensor
    B: Tensor | None
    labels: Tensor
    status: Tensor
    sigma: Tensor
    covariance: Tensor
    ambiguity: str
    warnings: tuple[Notice, ...] = ()
    velocities: Tensor | None = None
    unverified: Tensor | None = None
    solution: Solution | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        """Where the matches do not agree, no label, velocity or noise says otherwise."""
        good = agreed(self.status)
        for name in ("labels", "sigma", "velocities", "unverified"):
            value = getattr(self, name)
            if value is not None:
                kept = good[(..., *[None] * (value.ndim - good.ndim))]
                object.__setattr__(self, name, torch.where(kept, value, torch.zeros_like(value)))

    def flagged(self, code: NoticeCode | str) -> Tensor:
        """Which problems have a notice of this code, ``(*batch,)`` bool.

        Raises:
            ValueError: there is no such code.
        """
        known = [c.value for c in NoticeCode]
        if code not in known:
            raise ValueError(f"code must be one of {', '.join(known)}, got {code!r}")
        result = torch.zeros(self.status.shape, dtype=torch.bool)
        for notice in self.warnings:
            if notice.code == code:
                result[notice.problem] = True
        return result.to(self.status.device)

    def check(self) -> Alignment:
        """Raise where any problem failed.

        Raises:
            ValueError: says which problems failed, how, and what to do.
        """
        if self.solution is not None:
            self.solution.check()
        check_results("align", self.status, self.warnings)
        return self

    def __repr__(self) -> str:
        counts = self._counts()
        shape = tuple(self.status.shape)
        lines = [
            f"Alignment(matches={self.labels.shape[-1]}, batch={shape}: {_listed(counts['status'])})",
            f"  labels: {_listed(counts['labels'])}",
        ]
        if self.sigma.numel():
            lines.append(f"  noise: {_median(self.sigma):.3g} per coordinate" + (" (median)" if shape else ""))
        if shape:
            seen = Counter(notice.code.value for notice in self.warnings)
            lines += [f"  warning {code}: {count} of {self.status.numel()} problems" for code, count in sorted(seen.items())]
        else:
            lines += [f"  warning {notice}" for notice in self.warnings]
        return "\n".join(lines)

    def _counts(self) -> dict[str, Mapping[str, int]]:
        states = Counter(Status(s).name for s in self.status.reshape(-1).tolist())
        flat = self.labels.reshape(-1)
        names = {"static": STATIC, "moving": MOVING, "outlier": OUTLIER}
        return {"status": states, "labels": {name: int((flat == label).sum()) for name, label in names.items()}}


def _listed(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {name}" for name, count in counts.items()) or "empty"


def _median(values: Tensor) -> float:
    return float(values.reshape(-1).double().nan_to_num().median())
