"""One problem of segment(): from matches of two views to labelled bodies, through what moves alike."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.algebra.epipolar import sampson_squared
from dyntorch.algebra.homogeneous import similarity, unit
from dyntorch.algebra.plane_homography import homography_sampson_squared
from dyntorch.solution import Status
from dyntorch.tasks.bodies_descent import Candidate
from dyntorch.tasks.bodies_energy import View
from dyntorch.tasks.bodies_labels import Labelling, label
from dyntorch.tasks.bodies_models import Models, choose
from dyntorch.tasks.bodies_pool import LEAST, one_hot
from dyntorch.tasks.bodies_samples import search_samples
from dyntorch.tasks.bodies_search import search
from dyntorch.tasks.coherence import Links, coherence
from dyntorch.tasks.segmentation import BodyModel

SIGMAS = 5.0
"""Threshold over the noise of a coordinate."""
PIXELS = 2.5
"""The default threshold: what the figures in pixels refer to."""
NEIGHBOURLY = 3.0
"""Noise of the differences of matches, pixels."""
COHERENT, LINKED = 0.2, 0.3
"""Coherence of a match, and strength of a link, that put it into a fragment."""
FIRST, NEXT = 4, 2
"""Numbers of bodies tried at first, and each time that the largest one was the best."""
MOST = 12
PENALTY = 4.5
"""Of a body, in units of the root of the number of matches."""
UNKNOWN = 0.3
"""Share of outliers where nothing says what it is."""
GUESS = 0.003
"""Threshold over the diagonal of the image, where it has to be estimated."""


@dataclass(frozen=True)
class Outcome:
    """Result of one problem; all tensors in the coordinates and the order of the input, K = ``count`` bodies.

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

    @property
    def count(self) -> int:
        """Bodies."""
        return len(self.models)


def solve(
    x1: Tensor,
    x2: Tensor,
    weights: Tensor,
    bodies: int | None,
    threshold: float | None,
    spatial: bool,
    generator: torch.Generator | None,
) -> Outcome:
    """Segment one problem of matches ``(n, 2)`` with weights ``(n,)``, 0 = missing."""
    present = (weights > 0).nonzero().flatten()
    if threshold is not None:
        return _solve(x1, x2, weights, present, bodies, threshold, spatial, generator)
    extent = x1[present].amax(0) - x1[present].amin(0) if len(present) else x1.new_zeros(2)
    size = float(extent.norm())
    first = _solve(x1, x2, weights, present, bodies, GUESS * size if size > 0 else 1.0, spatial, generator)
    inliers = first.residuals[first.labels > 0]
    if not len(inliers):
        return first
    # the distances of one dimension that random matches would not show: their median is 0.67 standard deviations
    noise = float(inliers.median()) / 0.6745
    return _solve(x1, x2, weights, present, bodies, max(SIGMAS * noise, 1e-6 * size), spatial, generator)


def _solve(
    x1: Tensor,
    x2: Tensor,
    weights: Tensor,
    present: Tensor,
    bodies: int | None,
    threshold: float,
    spatial: bool,
    generator: torch.Generator | None,
) -> Outcome:
    first, second = x1[present], x2[present]
    distinct = len(torch.unique(torch.cat([first, second], dim=-1), dim=0))
    repeated = 1 - distinct / len(present) if len(present) else 0.0
    if distinct < LEAST + 1:
        return _nothing(x1, threshold, Status.TOO_FEW, repeated)
    one, two, scale = _normalizations(first, second)
    pixel = threshold / PIXELS * scale
    near = NEIGHBOURLY * pixel
    a, b = first * scale + one[:2, 2], second * scale + two[:2, 2]
    if spatial:
        graph = coherence(a, b, near)
        values, links = graph.values, graph.links
        keep, extra = _fragments(values, links)
    else:
        values, links = torch.zeros_like(a[:, 0]), _no_links(a)
        keep, extra = torch.arange(len(a), device=a.device), []
    view = View(a, b, pixel, links)
    linked = len(keep) / len(a)
    best = _best(view.subset(keep), bodies, extra, spatial, generator) if len(keep) > LEAST else None
    if best is None:
        return _nothing(x1, threshold, Status.NO_CONSENSUS, repeated, linked)
    found = torch.zeros_like(present)
    found[keep] = best.labels + 1
    labelled = label(
        view,
        found,
        best.fundamentals,
        weights[present],
        pixel * PIXELS,
        near if spatial else None,
        1 - linked if spatial else UNKNOWN,
    )
    return _outcome(view, labelled, values, (one, two, scale), present, weights, threshold, bodies, repeated, linked)


def _normalizations(x1: Tensor, x2: Tensor) -> tuple[Tensor, Tensor, float]:
    """Similarities of both views to coordinates around 0 of about unit size, by one scale: distances stay comparable."""
    centres = x1.median(0).values, x2.median(0).values
    spread = torch.cat([x1 - centres[0], x2 - centres[1]]).norm(dim=-1).median()
    scale = 1 / spread if bool(spread > 0) else torch.ones_like(spread)
    one, two = (similarity(scale, centre) for centre in centres)
    return one, two, float(scale)


def _fragments(values: Tensor, links: Links) -> tuple[Tensor, list[Tensor]]:
    """The matches in linked groups large enough for a body, and the groups as a labelling of them."""
    component = links.components(LINKED, values > COHERENT)
    _, group, size = component.unique(return_inverse=True, return_counts=True)
    keep = (size[group] >= LEAST).nonzero().flatten()
    labels = torch.unique(group[keep], return_inverse=True)[1]
    return keep, [labels] if len(keep) else []


def _no_links(a: Tensor) -> Links:
    """A graph without neighbours."""
    return Links(torch.zeros(len(a), 0, dtype=torch.long, device=a.device), a.new_zeros(len(a), 0))


def _best(
    view: View, bodies: int | None, extra: list[Tensor], spatial: bool, generator: torch.Generator | None
) -> Candidate | None:
    """The best segmentation into so many bodies, or into the number of least penalized cost; fewer bodies where there are no more."""
    extra = [labels for labels in extra if int(labels.max()) < MOST]

    def candidates(counts: list[int]) -> dict[int, Candidate]:
        found = search(view, counts, generator, extra) if spatial else search_samples(view, counts, generator)
        return {count: those[0] for count, those in found.items() if those}

    room = max(1, len(view.x1) // LEAST)
    if bodies is not None:
        for count in range(min(bodies, room), 0, -1):
            found = candidates([count])
            if found:
                return found[count]
        return None
    penalty = PENALTY * len(view.x1) ** 0.5
    known: dict[int, Candidate] = {}
    top = 0
    while top < min(room, MOST):
        last, top = top, min(top + (NEXT if top else FIRST), room, MOST)
        known |= candidates(list(range(last + 1, top + 1)))
        best = min(known, key=lambda count: known[count].energy + penalty * count, default=0)
        if best < top:
            break
    return known[best] if known else None


def _outcome(
    view: View,
    labelled: Labelling,
    values: Tensor,
    frames: tuple[Tensor, Tensor, float],
    present: Tensor,
    weights: Tensor,
    threshold: float,
    bodies: int | None,
    repeated: float,
    linked: float,
) -> Outcome:
    """The labels in order of size, with the models, in the coordinates of the input."""
    one, two, scale = frames
    labels, probabilities, fundamentals = _sorted(labelled)
    count = len(fundamentals)
    if not count:
        return _nothing(weights[:, None].expand(-1, 2), threshold, Status.NO_CONSENSUS, repeated, linked)
    members = one_hot(labels - 1, count) * weights[present]
    models = choose(view, fundamentals, members)
    residuals = _residuals(view, labels, fundamentals, models) / scale

    def spread(values: Tensor) -> Tensor:
        """Values of the present matches among all."""
        full = values.new_zeros(len(weights), *values.shape[1:])
        full[present] = values
        return full

    planar = models.planar[:, None, None]
    return Outcome(
        labels=spread(labels),
        probabilities=spread(probabilities.mT),
        fundamentals=unit(two.mT @ fundamentals @ one),
        homographies=torch.where(planar, unit(torch.linalg.inv(two) @ models.homographies @ one), 0.0),
        models=tuple(BodyModel.HOMOGRAPHY if flat else BodyModel.FUNDAMENTAL for flat in models.planar.tolist()),
        residuals=spread(residuals),
        coherence=spread(values),
        threshold=torch.tensor(threshold, dtype=torch.float64),
        status=Status.OK if bodies is None or count == bodies else Status.NO_CONSENSUS,
        repeated=repeated,
        linked=linked,
    )


def _sorted(labelled: Labelling) -> tuple[Tensor, Tensor, Tensor]:
    """Labels, probabilities ``(K + 1, n)`` and fundamental matrices of the bodies that kept enough matches, the largest first."""
    size = torch.bincount(labelled.labels, minlength=len(labelled.fundamentals) + 1)[1:]
    order = size.argsort(descending=True, stable=True)
    order = order[size[order] >= LEAST]
    probabilities = torch.cat([labelled.probabilities[:1], labelled.probabilities[1:][order]])
    # what belonged to a body that was given up belongs to none
    probabilities = torch.cat([1 - probabilities[1:].sum(0, keepdim=True), probabilities[1:]]).clamp(min=0)
    return probabilities.argmax(0), probabilities, labelled.fundamentals[order]


def _residuals(view: View, labels: Tensor, fundamentals: Tensor, models: Models) -> Tensor:
    """Distances ``(n,)`` from the own body, of outliers from the nearest one."""
    epipolar = sampson_squared(fundamentals, view.x1, view.x2)
    planar = homography_sampson_squared(models.homographies, view.x1, view.x2)
    square = torch.where(models.planar[:, None], planar, epipolar)
    own = square.gather(0, (labels - 1).clamp(min=0)[None])[0]
    return torch.where(labels > 0, own, square.amin(0)).sqrt()


def _nothing(x1: Tensor, threshold: float, status: Status, repeated: float, linked: float = 0.0) -> Outcome:
    """No bodies: all matches are outliers."""
    count = len(x1)
    none = torch.zeros(0, 3, 3, dtype=torch.float64, device=x1.device)
    return Outcome(
        labels=torch.zeros(count, dtype=torch.long, device=x1.device),
        probabilities=torch.ones(count, 1, dtype=torch.float64, device=x1.device),
        fundamentals=none,
        homographies=none,
        models=(),
        residuals=torch.zeros(count, dtype=torch.float64, device=x1.device),
        coherence=torch.zeros(count, dtype=torch.float64, device=x1.device),
        threshold=torch.tensor(threshold, dtype=torch.float64),
        status=status,
        repeated=repeated,
        linked=linked,
    )
