"""One problem of segment(): from matches of two views to labelled bodies, through what moves alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyntorch.algebra.homogeneous import similarity
from dyntorch.chi_square import median
from dyntorch.sampling import uniform
from dyntorch.solution import Status
from dyntorch.tasks.bodies_count import ALONE, MOST, PENALTY, best
from dyntorch.tasks.bodies_descent import Candidate
from dyntorch.tasks.bodies_energy import View
from dyntorch.tasks.bodies_labels import Labelling, label
from dyntorch.tasks.bodies_outcome import Given, Outcome, nothing, outcome
from dyntorch.tasks.bodies_pool import LEAST
from dyntorch.tasks.bodies_samples import search_samples
from dyntorch.tasks.bodies_search import search
from dyntorch.tasks.bodies_significance import significant
from dyntorch.tasks.coherence import Links, coherence
from dyntorch.tasks.segmentation import BodyModel

SIGMAS = 5.0
"""Threshold over the noise of a coordinate."""
PIXELS = 2.5
"""The default threshold: what the figures in pixels refer to."""
NEIGHBOURLY = 3.0
"""Noise of the differences of matches, pixels."""
COHERENT, LINKED = 0.2, 0.3
"""Coherence of a match, and strength of a link, that put it into a group."""
UNKNOWN = 0.3
"""Share of outliers where nothing says what it is."""
FAR, FARTHEST = 20.0, 1e3
"""Distance from the middle of the matches, in units of the median one, from which a match is garbage, and where it is put then."""
SEARCHED = 1500
"""Matches that the search looks at, and that are neighbours; the others are labelled by what it finds."""
COARSE = 0.2
"""Threshold over the spread of the points from which everything is near everything."""
LEFT, LEFT_SHARE = 10, 0.08
"""Linked matches without a body, and their share of all linked ones, from which one body more is tried."""
GUESS = 0.003
"""Threshold over the diagonal of the image, where it has to be estimated."""
MEDIANS = {BodyModel.FUNDAMENTAL: median(1) ** 0.5, BodyModel.HOMOGRAPHY: median(2) ** 0.5}
"""Median Sampson distance of inliers, in units of the noise of a coordinate."""


@dataclass(frozen=True)
class Request:
    """What was asked for, as in :func:`dyntorch.segment`."""

    bodies: int | None
    threshold: float | None
    spatial: bool
    generator: torch.Generator | None


def solve(x1: Tensor, x2: Tensor, weights: Tensor, request: Request) -> Outcome:
    """Segment one problem of matches ``(n, 2)`` with weights ``(n,)``, 0 = missing."""
    if request.threshold is not None:
        return _solve(x1, x2, weights, request, request.threshold)
    size = _diagonal(x1[weights > 0])
    first = _solve(x1, x2, weights, request, GUESS * size if size > 0 else 1.0)
    if not first.count:
        return first
    # the median distance in standard deviations: in one dimension from epipolar lines, in two from the points of a plane
    medians = first.labels.new_tensor([MEDIANS[model] for model in first.models], dtype=x1.dtype)
    inlier = first.labels > 0
    noise = float((first.residuals[inlier] / medians[first.labels[inlier] - 1]).median())
    return _solve(x1, x2, weights, request, max(SIGMAS * noise, 1e-6 * size))


def _diagonal(x: Tensor) -> float:
    """Of the image, by most of its points ``(n, 2)``: some may be garbage."""
    if not len(x):
        return 0.0
    low, high = x.quantile(x.new_tensor([0.05, 0.95]), dim=0)
    return float((high - low).norm()) / 0.9


def _solve(x1: Tensor, x2: Tensor, weights: Tensor, request: Request, threshold: float) -> Outcome:
    present = (weights > 0).nonzero().flatten()
    distinct, *places = (len(torch.unique(x[present], dim=0)) for x in (torch.cat([x1, x2], dim=-1), x1, x2))
    # points that are all in one place of a view fit any motion of that place
    distinct = min(places) if min(places) < LEAST + 1 else distinct
    repeated = 1 - distinct / len(present) if len(present) else 0.0
    if distinct < LEAST + 1:
        return nothing(weights, threshold, Status.TOO_FEW, repeated)
    given = _given(x1[present], x2[present], weights, present, threshold, request, repeated)
    if PIXELS * given.view.pixel > COARSE:
        refused = nothing(weights, threshold, Status.AMBIGUOUS, repeated, given.linked)
        return replace(refused, coarse=PIXELS * given.view.pixel)
    part = given.view.subset(given.keep[given.searched])

    def searched(counts: Sequence[int]) -> dict[int, list[Candidate]]:
        if not request.spatial:
            return search_samples(part, counts, request.generator)
        groups = given.groups[given.searched]
        extra = [groups] if int(groups.max()) < MOST else []
        return search(part, counts, request.generator, extra)

    penalty = PENALTY if request.spatial else ALONE
    chosen = best(searched, len(part.x1), request.bodies, penalty) if len(part.x1) > LEAST else None
    if chosen is None:
        return nothing(weights, threshold, Status.NO_CONSENSUS, repeated, given.linked)
    labelled = _labelled(given, chosen.candidate, request)
    left = _left(given, labelled)
    if chosen.further is not None and left >= max(LEFT, LEFT_SHARE * len(given.keep)):
        # matches that move like their neighbours and fit no body: there is another one, which the truncated distances hid
        other = _labelled(given, chosen.further, request)
        labelled = other if _left(given, other) < 0.5 * left else labelled
    return outcome(given, labelled, threshold, request.bodies, chosen.spare)


def _labelled(given: Given, candidate: Candidate, request: Request) -> Labelling:
    """Labels of all matches by a segmentation of those that were searched."""
    found = torch.zeros_like(given.present)
    found[given.keep[given.searched]] = candidate.labels + 1
    pixel = given.view.pixel
    near, share = (NEIGHBOURLY * pixel, 1 - given.linked) if request.spatial else (None, UNKNOWN)
    labelled = label(given.view, found, candidate.fundamentals, given.weights[given.present], PIXELS * pixel, near, share)
    if request.spatial:
        return labelled
    # nothing but the geometry speaks for these bodies: those that random matches would show as well are none
    return labelled.of(significant(given.view, labelled.fundamentals, labelled.labels))


def _left(given: Given, labelled: Labelling) -> int:
    """How many of the kept matches became outliers."""
    return int((labelled.labels[given.keep] == 0).sum()) if len(given.groups) else 0


def _given(x1: Tensor, x2: Tensor, weights: Tensor, present: Tensor, threshold: float, request: Request, repeated: float) -> Given:
    """The present matches ``(m, 2)`` around 0 and of about unit size, by one scale: distances stay comparable."""
    centres = x1.median(0).values, x2.median(0).values
    # squares of tiny coordinates would underflow: a view without extent would not count
    distance = torch.hypot(*torch.cat([x1 - centres[0], x2 - centres[1]]).unbind(-1))
    # copies of one match that are the majority have no spread
    spread = distance[distance > 0].median() if bool(distance.any()) else torch.ones_like(distance[0])
    scale = 1 / spread.clamp(min=torch.finfo(spread.dtype).tiny)
    first, second = (similarity(scale, centre) for centre in centres)
    a, b = (((x - centre) * scale).clamp(-FARTHEST, FARTHEST) for x, centre in zip((x1, x2), centres, strict=True))
    pixel = threshold / PIXELS * float(scale)
    values = torch.zeros_like(a[:, 0])
    some = _some(len(a), request.generator, a.device)
    if request.spatial:
        graph = coherence(a, b, NEIGHBOURLY * pixel, some)
        values, links = graph.values, graph.links
        keep, groups = _groups(values, links)
    else:
        links = Links(torch.zeros(len(a), 0, dtype=torch.long, device=a.device), a.new_zeros(len(a), 0))
        # without neighbours nothing but the place tells garbage, one of which can spoil the depth of a whole body
        keep = (torch.cat([a, b], dim=-1).norm(dim=-1) < FAR).nonzero().flatten()
        groups = keep[:0]
    view = View(a, b, pixel, links)
    searched = some[keep].nonzero().flatten()
    return Given(weights, present, view, first, second, float(scale), values, keep, groups, searched, repeated)


def _some(count: int, generator: torch.Generator | None, device: torch.device) -> Tensor:
    """``(m,)`` bool: all matches, or a random part of very many: what is dense beside the noise shows no motion of its own."""
    if count <= SEARCHED:
        return torch.ones(count, dtype=torch.bool, device=device)
    return uniform(count, generator=generator, device=device).argsort().argsort() < SEARCHED


def _groups(values: Tensor, links: Links) -> tuple[Tensor, Tensor]:
    """The matches in linked groups large enough for a body, and these groups, from 0."""
    component = links.components(LINKED, values > COHERENT)
    _, group, size = component.unique(return_inverse=True, return_counts=True)
    keep = (size[group] >= LEAST).nonzero().flatten()
    return keep, torch.unique(group[keep], return_inverse=True)[1]
