"""What the alignment tasks return: the motion of the sensor, a label for every match, and what should be known about them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

import torch
from torch import Tensor

from dyntorch.solution import REMEDY, Solution, Status

OUTLIER, STATIC, MOVING = 0, 1, 2


class NoticeCode(StrEnum):
    """What a :class:`Notice` is about."""

    DEGENERATE = "degenerate"
    """The matches leave several tensors, exactly; the motion rests on static matches alone."""
    NEAR_STATIC = "near_static"
    """So little moves that the noise decides between tensors; the motion rests on the static matches."""
    FEW_MOVING = "few_moving"
    """Fewer moving matches than determine the motion by themselves."""
    FEW_LINES = "few_lines"
    """The moving matches lie on fewer lines than determine the motion by themselves."""
    ONE_LINE = "one_line"
    """All moving matches lie on one line."""
    COLLINEAR = "collinear"
    """All matches of a view lie on one line."""
    UNVERIFIED = "unverified"
    """Matches that stand still between two views only: points that paused, or static points mismatched in one view."""
    PLANAR_VELOCITIES = "planar_velocities"
    """The velocities lie in a plane."""
    LINEAR_VELOCITIES = "linear_velocities"
    """The velocities lie along one line."""
    EQUAL_VELOCITIES = "equal_velocities"
    """All matches have one velocity, or all are static."""
    COMMON_VELOCITY = "common_velocity"
    """No static match fixes the velocity common to all points."""
    PURE_TRANSLATION = "pure_translation"
    """The lines only translate: the motion is known up to a family, unless static points fix it."""
    UNCERTAIN = "uncertain"
    """The noise leaves the motion so uncertain that it says little."""


def check_threshold(threshold: float | None) -> None:
    """Refuse what is not one distance.

    Raises:
        ValueError: not a number, not positive, or not finite.
    """
    try:
        value = 1.0 if threshold is None else float(threshold)
    except (TypeError, ValueError, RuntimeError):
        value = float("nan")
    if not 0 < value < float("inf"):
        raise ValueError(f"threshold must be a positive distance in the unit of the points, got {threshold!r}; None estimates it")


@dataclass(frozen=True)
class Notice:
    """Something about the data of one problem that limits what its result can be trusted for.

    Attributes:
        code: what it is about.
        value: the measured figure behind it.
        message: one sentence with the figure and the remedy.
        problem: index into the batch, () for a single problem.
    """

    code: NoticeCode
    value: float
    message: str
    problem: tuple[int, ...] = ()

    def __str__(self) -> str:
        place = f"problem {', '.join(map(str, self.problem))}: " if self.problem else ""
        return f"{place}{self.code}: {self.message}"


def notices(code: NoticeCode, message: str, values: Tensor, flagged: Tensor, batch: tuple[int, ...]) -> list[Notice]:
    """A notice for every flagged problem.

    Args:
        code: what it is about.
        message: a sentence with ``{value:g}`` in it.
        values: ``(b,)`` figures.
        flagged: ``(b,)`` bool.
        batch: shape that the flat dimension b comes from.
    """
    found = []
    for flat in flagged.nonzero().flatten().tolist():
        value = float(values[flat])
        place = tuple(int(i) for i in torch.unravel_index(torch.tensor(flat), batch)) if batch else ()
        found.append(Notice(code, value, message.format(value=value), place))
    return found


@dataclass(frozen=True, eq=False, repr=False)
class Alignment:
    """Result of ``align_planar``, ``align_points`` and ``align_lines``.

    Attributes:
        A: ``(*batch, d + 1, d + 1)`` motion of the sensor, view 2 to view 1, :math:`p_1 \\sim A\\,p_2` for static points;
            Frobenius norm 1; zero where the status says that there is none.
        B: the same for view 3; None with two views.
        labels: ``(*batch, n)`` 0 outlier, 1 static, 2 moving.
        status: ``(*batch,)`` of :class:`dyntorch.Status`.
        sigma: ``(*batch,)`` noise of one coordinate that the inliers show, in the unit of the matches.
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
        for state in Status:
            where = (self.status.reshape(-1) == state).nonzero().flatten().tolist()
            if state != Status.OK and where:
                raise ValueError(f"problem {', '.join(map(str, where[:8]))}: {state.name}; {REMEDY[state]}")
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
