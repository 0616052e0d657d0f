"""What one problem of segment() gives, in the coordinates and the order of its input."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.algebra.epipolar import sampson_squared
from dyntorch.algebra.homogeneous import unit
from dyntorch.algebra.partition import order_of_bodies
from dyntorch.algebra.plane_homography import homography_sampson_squared
from dyntorch.solution import Status
from dyntorch.tasks.bodies_energy import View
from dyntorch.tasks.bodies_labels import Labelling
from dyntorch.tasks.bodies_models import Models, choose
from dyntorch.tasks.bodies_pool import LEAST, one_hot
from dyntorch.tasks.notices import Notice, NoticeCode, notices
from dyntorch.tasks.segmentation import BodyModel

REPEATED = 0.1
"""Share of repeated matches that deserves a notice."""
SPARSE = 0.3
"""Share of matches that move like their neighbours below which geometry alone may do better."""


@dataclass(frozen=True)
class Given:
    """The matches of one problem, ready for the search.

    Attributes:
        weights: ``(n,)`` of all matches, 0 = missing.
        present: ``(m,)`` indices of those that are there.
        view: these, normalized.
        first, second: the similarities that did it, from the input.
        scale: of both.
        coherence: ``(m,)`` in [0, 1].
        keep: indices among the m of those that may belong to a body.
        groups: ``(k,)`` of the kept ones, linked groups from 0; empty where neighbours do not matter.
        searched: indices among the kept ones of those that the search looks at.
        repeated: share of matches that repeat others.
    """

    weights: Tensor
    present: Tensor
    view: View
    first: Tensor
    second: Tensor
    scale: float
    coherence: Tensor
    keep: Tensor
    groups: Tensor
    searched: Tensor
    repeated: float

    @property
    def linked(self) -> float:
        """Share of the matches that may belong to a body."""
        return len(self.keep) / max(1, len(self.present))

    def spread(self, values: Tensor) -> Tensor:
        """Values of the present matches among all, 0 elsewhere."""
        full = values.new_zeros(len(self.weights), *values.shape[1:])
        full[self.present] = values
        return full


@dataclass(frozen=True)
class Outcome:
    """Result of one problem of n matches with K = ``count`` bodies.

    Attributes:
        labels: ``(n,)``.
        probabilities: ``(n, K + 1)``.
        fundamentals, homographies: ``(K, 3, 3)``.
        models: K of them.
        residuals, coherence: ``(n,)``.
        threshold: ``()``.
        status: of the problem.
        repeated: share of matches that repeat others.
        linked: share of matches that move like neighbours of theirs.
        spare: whether fewer bodies than were asked for explain the matches as well.
        coarse: the threshold over the spread of the points, where it is too large to tell anything; else 0.
    """

    labels: Tensor
    probabilities: Tensor
    fundamentals: Tensor
    homographies: Tensor
    models: tuple[BodyModel, ...]
    residuals: Tensor
    coherence: Tensor
    threshold: Tensor
    status: Status
    repeated: float
    linked: float
    spare: bool = False
    coarse: float = 0.0

    @property
    def count(self) -> int:
        """Bodies."""
        return len(self.models)


def nothing(weights: Tensor, threshold: float, status: Status, repeated: float, linked: float = 0.0) -> Outcome:
    """No bodies: all matches ``(n,)`` are outliers, those with weight surely."""
    none = torch.zeros(0, 3, 3, dtype=torch.float64, device=weights.device)
    return Outcome(
        labels=torch.zeros_like(weights, dtype=torch.long),
        probabilities=(weights > 0).double()[:, None],
        fundamentals=none,
        homographies=none,
        models=(),
        residuals=torch.zeros_like(weights),
        coherence=torch.zeros_like(weights),
        threshold=weights.new_tensor(threshold),
        status=status,
        repeated=repeated,
        linked=linked,
    )


def outcome(given: Given, labelled: Labelling, threshold: float, bodies: int | None, spare: bool) -> Outcome:
    """The labels in order of size, with the model of every body."""
    labelled = _sorted(labelled)
    labels, fundamentals = labelled.labels, labelled.fundamentals
    count = len(fundamentals)
    if not count:
        return nothing(given.weights, threshold, Status.NO_CONSENSUS, given.repeated, given.linked)
    models = choose(given.view, fundamentals, one_hot(labels - 1, count) * given.weights[given.present])
    planar = unit(torch.linalg.inv(given.second) @ models.homographies @ given.first)
    return Outcome(
        labels=given.spread(labels),
        probabilities=given.spread(labelled.probabilities.mT),
        fundamentals=unit(given.second.mT @ fundamentals @ given.first),
        homographies=torch.where(models.planar[:, None, None], planar, 0.0),
        models=tuple(BodyModel.HOMOGRAPHY if flat else BodyModel.FUNDAMENTAL for flat in models.planar.tolist()),
        residuals=given.spread(_residuals(given.view, labels, fundamentals, models) / given.scale),
        coherence=given.spread(given.coherence),
        threshold=given.weights.new_tensor(threshold),
        status=Status.OK if bodies is None or count == bodies else Status.NO_CONSENSUS,
        repeated=given.repeated,
        linked=given.linked,
        spare=spare,
    )


def _sorted(labelled: Labelling) -> Labelling:
    """The bodies that kept enough matches, numbered by the rule."""
    members = one_hot(labelled.labels - 1, len(labelled.fundamentals)) > 0
    order = order_of_bodies(members)
    return labelled.of(order[members.sum(-1)[order] >= LEAST])


def _residuals(view: View, labels: Tensor, fundamentals: Tensor, models: Models) -> Tensor:
    """Distances ``(n,)`` from the own body, of outliers from the nearest one."""
    epipolar = sampson_squared(fundamentals, view.x1, view.x2)
    planar = homography_sampson_squared(models.homographies, view.x1, view.x2)
    square = torch.where(models.planar[:, None], planar, epipolar)
    own = square.gather(0, (labels - 1).clamp(min=0)[None])[0]
    return torch.where(labels > 0, own, square.amin(0)).sqrt()


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
