"""segment(): which matches of two views move together, which are wrong, and how each body moved."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from math import inf, nan
from typing import Any

import torch
from torch import Tensor

from dyntorch.core.limits import median
from dyntorch.core.matches import matches
from dyntorch.core.outcome import Notice, Status, stack_results
from dyntorch.geometry.epipolar import sampson_squared
from dyntorch.geometry.homogeneous import similarity, unit
from dyntorch.geometry.homography import homography_sampson_squared
from dyntorch.geometry.pairs import order_of_bodies
from dyntorch.invariants.fundamental_matrix import FundamentalMatrix
from dyntorch.numerics.arguments import check_options, check_threshold, on_cpu
from dyntorch.numerics.blocks import one_thread
from dyntorch.numerics.messages import Message
from dyntorch.tasks.segment.coherence import THRESHOLD_PIXELS, Links, View, coherence
from dyntorch.tasks.segment.labels import Labelling, label_matches, select_models, significant
from dyntorch.tasks.segment.result import Segmentation, SegmentNotice, count_notices
from dyntorch.tasks.segment.search import MIN_BODY_MATCHES, Candidate, draw_subset, one_hot, search, search_samples


@dataclass(frozen=True)
class SegmentOptions:
    """What :func:`dyntorch.segment` takes and risks."""

    max_bodies: int = 12
    """Largest number of bodies tried where ``bodies`` is None."""
    outlier_share: float = 0.3
    """Share of wrong matches that is expected where ``spatial=False``: neighbours do not tell it then."""
    false_alarms: float = 1e-2
    """Bodies expected in random matches below which a body is believed where ``spatial=False``."""
    max_searched: int = 1500
    """Matches that the search looks at (time, memory); the others are labelled by what it finds."""
    num_starts: int = 16
    """Random starts for each number of bodies (time); twice as many where at most two numbers are tried."""
    max_samples: int = 24000
    """Samples of seven matches drawn at most where ``spatial=False`` (time)."""


# ----------------------------------------------------------------------------------------------------------------------
# How many bodies: the segmentation of least cost with a penalty for each body, or with the number that was asked for.


Search = Callable[[Sequence[int]], dict[int, list[Candidate]]]


THRESHOLD_SIGMAS = 5.0  # an estimated threshold, in standard deviations of a coordinate
FIRST_THRESHOLD = 0.003  # over the diagonal of the image: where the estimation of the threshold starts
MATCH_NOISE_PIXELS = 3.0  # noise of the differences of matches
MIN_COHERENCE = 0.2  # from which a match belongs to a group
MIN_LINK_WEIGHT = 0.3  # from which a link joins two matches to one group
NUM_FIRST_COUNTS = 4  # numbers of bodies tried at first: one to so many
NUM_FURTHER_COUNTS = 2  # tried further, each time that the largest one is the cheapest
BODY_PENALTY = 4.5  # in units of the root of the number of matches
BODY_PENALTY_GEOMETRY_ONLY = 6.2  # spurious bodies explain up to 4.9, true ones 7.6 and more
SAME_SEGMENTATION_SHARE = 0.9  # share of equal labels from which two segmentations are one
MIN_RUNNER_UP_COST = 1.0  # beyond the least cost, in units of the root of the number of matches
FAR_DISTANCE = 20.0  # from the middle, over the median one: garbage where neighbours do not matter
MAX_DISTANCE = 1e3  # from the middle of the matches, over the median one, to which farther ones are moved
MAX_RELATIVE_THRESHOLD = 0.2  # over the spread of the points, from which the problem is refused
MAX_NOISE_RATIO = 2.5  # noise of a body over that of the threshold: rigid ones up to .96 px at 2.5 px, bending sheets from 2.3
MAX_REPEATED_SHARE = 0.1  # of the matches, without a notice
MIN_LINKED_SHARE = 0.3  # of the matches, without a notice


@dataclass(frozen=True)
class Request:
    """What was asked for, as in :func:`dyntorch.segment`."""

    bodies: int | None
    threshold: float | None
    spatial: bool
    generator: torch.Generator | None
    options: SegmentOptions


@dataclass(frozen=True)
class CountSelection:
    """The segmentation that was chosen."""

    candidate: Candidate  # itself
    spare: bool = False  # whether fewer bodies than were asked for cost less, penalties included
    rival: float = inf
    """What the best other segmentation into as many costs more, in units of the root of the number of matches."""
    gain: float = 0.0
    """What one body more costs less before its penalty, in the same units, where the number was not asked for."""


def select_count(search: Search, matches: int, bodies: int | None, penalty: float, max_bodies: int) -> CountSelection | None:
    """The best segmentation of so many matches into ``bodies``, or, for None, into the number of least penalized cost."""
    room = max(1, matches // MIN_BODY_MATCHES)
    best_by_count: dict[int, Candidate] = {}
    rivals: dict[int, float] = {}

    def penalized_cost(count: int) -> float:
        return best_by_count[count].energy + penalty * count * matches**0.5

    def cheapest(counts: Sequence[int]) -> dict[int, Candidate]:
        results = {count: candidates for count, candidates in search(counts).items() if candidates}
        rivals.update({count: _runner_up_cost(candidates) / matches**0.5 for count, candidates in results.items()})
        return {count: candidates[0] for count, candidates in results.items()}

    if bodies is not None:
        for count in range(min(bodies, room), 0, -1):
            # one body fewer tells whether so many were needed
            best_by_count |= cheapest(range(max(1, count - 1), count + 1))
            if count in best_by_count:
                spare = count > 1 and count - 1 in best_by_count and penalized_cost(count - 1) < penalized_cost(count)
                return CountSelection(best_by_count[count], spare, rival=rivals[count])
        return None
    top = 0
    while top < min(room, max_bodies):
        last, top = top, min(top + (NUM_FURTHER_COUNTS if top else NUM_FIRST_COUNTS), room, max_bodies)
        best_by_count |= cheapest(range(last + 1, top + 1))
        chosen = min(best_by_count, key=penalized_cost, default=0)
        if chosen < top:
            break
    if not best_by_count:
        return None
    count = min(best_by_count, key=penalized_cost)
    further = best_by_count.get(count + 1, best_by_count[count])
    return CountSelection(
        best_by_count[count], rival=rivals[count], gain=(best_by_count[count].energy - further.energy) / matches**0.5
    )


def _runner_up_cost(candidates: Sequence[Candidate]) -> float:
    """What the best segmentation costs more that is another one than the best of all, not the same with a few other labels."""
    best = candidates[0]
    member = one_hot(best.labels, len(best.fundamentals))
    for other in candidates[1:]:
        shared = member @ one_hot(other.labels, len(other.fundamentals)).mT
        if float(shared.amax(0).sum()) < SAME_SEGMENTATION_SHARE * len(best.labels):
            return other.energy - best.energy
    return inf


# ----------------------------------------------------------------------------------------------------------------------
# What one problem of segment() gives, in the coordinates and the order of its input.


@dataclass(frozen=True)
class PreparedMatches:
    """The matches of one problem, ready for the search."""

    weights: Tensor  # ``(n,)`` of all matches, 0 = missing
    present: Tensor  # ``(m,)`` indices of those that are there
    view: View  # these, normalized
    first: Tensor  # the similarities that did it, from the input
    second: Tensor
    scale: float  # of both
    coherence: Tensor  # ``(m,)`` in [0, 1]
    keep: Tensor  # indices among the m of those that may belong to a body
    searched: Tensor  # indices among the kept ones of those that the search looks at

    @property
    def linked_share(self) -> float:
        """Share of the matches that may belong to a body."""
        return len(self.keep) / max(1, len(self.present))

    def spread(self, values: Tensor) -> Tensor:
        """Values of the present matches among all, 0 elsewhere."""
        full = values.new_zeros(len(self.weights), *values.shape[1:])
        full[self.present] = values
        return full


def _no_bodies(weights: Tensor, threshold: float, status: Status, notices: Sequence[Notice]) -> Segmentation:
    """No bodies: all matches ``(n,)`` are outliers, those with weight surely."""
    none = torch.zeros(0, 3, 3, dtype=torch.float64)
    return Segmentation(
        labels=torch.zeros_like(weights, dtype=torch.long),
        bodies=torch.tensor(0),
        homographies=none,
        planar=torch.zeros(0, dtype=torch.bool),
        probabilities=(weights > 0).double()[:, None],
        residuals=torch.zeros_like(weights),
        threshold=weights.new_tensor(threshold),
        fundamentals=none,
        coherence=torch.zeros_like(weights),
        status=torch.tensor(int(status)),
        notices=tuple(notices),
    )


def _describe_bodies(
    given: PreparedMatches, labelled: Labelling, threshold: float, request: Request, chosen: CountSelection, notices: list[Notice]
) -> Segmentation:
    """The labels in order of size, with the model of every body."""
    labelled = _sort_bodies(labelled)
    labels, fundamentals = labelled.labels, labelled.fundamentals
    count = len(fundamentals)
    rival = [Notice(SegmentNotice.UNDECIDED, chosen.rival)] if count > 1 and chosen.rival < MIN_RUNNER_UP_COST else []
    limit = MAX_NOISE_RATIO * threshold / THRESHOLD_SIGMAS
    worst = max((_noise_of_bodies(given.view, labels, fundamentals) / given.scale).tolist(), default=0.0)
    misfit = [Notice(SegmentNotice.MISFIT, worst, {"limit": limit})] if worst > limit else []
    # no probability: lenses bend recordings of one body as much as small motions of a second one (half of them are noted)
    if count == 1 and chosen.gain > 0:
        penalty = BODY_PENALTY if request.spatial else BODY_PENALTY_GEOMETRY_ONLY
        rival = [Notice(SegmentNotice.UNDECIDED, chosen.gain, {"case": "one", "penalty": penalty})]
    notices = [*misfit, *count_notices(count, request.bodies, chosen.spare), *rival, *notices]
    if not count:
        return _no_bodies(given.weights, threshold, Status.NO_CONSENSUS, notices)
    homographies, planar = select_models(given.view, fundamentals, one_hot(labels - 1, count) * given.weights[given.present])
    residuals = _residuals(given.view, labels, fundamentals, homographies, planar) / given.scale
    homographies = unit(torch.linalg.inv(given.second) @ homographies @ given.first)
    return Segmentation(
        labels=given.spread(labels),
        bodies=torch.tensor(count),
        homographies=torch.where(planar[:, None, None], homographies, 0.0),
        planar=planar,
        probabilities=given.spread(labelled.probabilities.mT),
        residuals=given.spread(residuals),
        threshold=given.weights.new_tensor(threshold),
        fundamentals=unit(given.second.mT @ fundamentals @ given.first),
        coherence=given.spread(given.coherence),
        status=torch.tensor(int(Status.OK if request.bodies in (None, count) and not misfit else Status.NO_CONSENSUS)),
        notices=tuple(notices),
    )


def _noise_of_bodies(view: View, labels: Tensor, fundamentals: Tensor) -> Tensor:
    """Standard deviations ``(K,)`` of a coordinate that the median distances from each body's epipolar lines show."""
    square = sampson_squared(fundamentals, view.x1, view.x2)
    own = labels == torch.arange(1, len(fundamentals) + 1, device=labels.device)[:, None]
    return (torch.where(own, square, torch.nan).nanmedian(-1).values / median(1)).sqrt()


def _sort_bodies(labelled: Labelling) -> Labelling:
    """The bodies that kept enough matches, numbered by the rule."""
    members = one_hot(labelled.labels - 1, len(labelled.fundamentals)) > 0
    order = order_of_bodies(members)
    return labelled.of(order[members.sum(-1)[order] >= MIN_BODY_MATCHES])


def _residuals(view: View, labels: Tensor, fundamentals: Tensor, homographies: Tensor, planar: Tensor) -> Tensor:
    """Distances ``(n,)`` from the own body, of outliers from the nearest one."""
    epipolar = sampson_squared(fundamentals, view.x1, view.x2)
    square = torch.where(planar[:, None], homography_sampson_squared(homographies, view.x1, view.x2), epipolar)
    own = square.gather(0, (labels - 1).clamp(min=0)[None])[0]
    return torch.where(labels > 0, own, square.amin(0)).sqrt()


# ----------------------------------------------------------------------------------------------------------------------
# One problem of segment(): from matches of two views to labelled bodies, through what moves alike.


def solve(x1: Tensor, x2: Tensor, weights: Tensor, request: Request) -> Segmentation:
    """Segment one problem of matches ``(n, 2)`` with weights ``(n,)``, 0 = missing."""
    if request.threshold is not None:
        return _solve(x1, x2, weights, request, request.threshold)
    size = _diagonal(x1[weights > 0])
    first = _solve(x1, x2, weights, request, FIRST_THRESHOLD * size if size > 0 else 1.0)
    if not int(first.bodies):
        return first
    # the median distance in standard deviations: in one dimension from epipolar lines, in two from the points of a plane
    medians = x1.new_tensor([median(1), median(2)])[first.planar.long()].sqrt()
    inlier = first.labels > 0
    noise = float((first.residuals[inlier] / medians[first.labels[inlier] - 1]).median())
    return _solve(x1, x2, weights, request, max(THRESHOLD_SIGMAS * noise, 1e-6 * size))


def _diagonal(x: Tensor) -> float:
    """Of the image, by most of its points ``(n, 2)``: some may be garbage."""
    if not len(x):
        return 0.0
    low, high = x.quantile(x.new_tensor([0.05, 0.95]), dim=0)
    return float((high - low).norm()) / 0.9


def _solve(x1: Tensor, x2: Tensor, weights: Tensor, request: Request, threshold: float) -> Segmentation:
    options = request.options
    present = (weights > 0).nonzero().flatten()
    distinct, *places = (len(torch.unique(x[present], dim=0)) for x in (torch.cat([x1, x2], dim=-1), x1, x2))
    # points that are all in one place of a view fit any motion of that place
    distinct = min(places) if min(places) < MIN_BODY_MATCHES + 1 else distinct
    repeated = 1 - distinct / len(present) if len(present) else 0.0
    notices = [Notice(SegmentNotice.REPEATED, repeated)] if repeated > MAX_REPEATED_SHARE else []
    if distinct < MIN_BODY_MATCHES + 1:
        return _no_bodies(weights, threshold, Status.TOO_FEW, notices)
    given = _prepare_matches(x1[present], x2[present], weights, present, threshold, request)
    coarse = THRESHOLD_PIXELS * given.view.pixel
    if coarse > MAX_RELATIVE_THRESHOLD:
        return _no_bodies(weights, threshold, Status.AMBIGUOUS, [Notice(SegmentNotice.COARSE, coarse), *notices])
    notices += [Notice(SegmentNotice.INCOHERENT, given.linked_share)] if given.linked_share < MIN_LINKED_SHARE else []
    part = given.view.subset(given.keep[given.searched])

    def find_candidates(counts: Sequence[int]) -> dict[int, list[Candidate]]:
        if not request.spatial:
            return search_samples(part, counts, request.generator, options.max_samples)
        return search(part, counts, request.generator, options.num_starts)

    penalty = BODY_PENALTY if request.spatial else BODY_PENALTY_GEOMETRY_ONLY
    chosen = (
        select_count(find_candidates, len(part.x1), request.bodies, penalty, options.max_bodies)
        if len(part.x1) > MIN_BODY_MATCHES
        else None
    )
    if chosen is None:
        return _no_bodies(weights, threshold, Status.NO_CONSENSUS, [*count_notices(0, request.bodies, False), *notices])
    labelled = _label_all(given, chosen.candidate, request)
    return _describe_bodies(given, labelled, threshold, request, chosen, notices)


def _label_all(given: PreparedMatches, candidate: Candidate, request: Request) -> Labelling:
    """Labels of all matches by a segmentation of those that were searched."""
    labels = torch.zeros_like(given.present)
    labels[given.keep[given.searched]] = candidate.labels + 1
    pixel = given.view.pixel
    near, share = (MATCH_NOISE_PIXELS * pixel, 1 - given.linked_share) if request.spatial else (None, request.options.outlier_share)
    labelled = label_matches(
        given.view, labels, candidate.fundamentals, given.weights[given.present], THRESHOLD_PIXELS * pixel, near, share
    )
    if request.spatial:
        return labelled
    # nothing but the geometry speaks for these bodies: those that random matches would show as well are none
    return labelled.of(significant(given.view, labelled.fundamentals, labelled.labels, request.options.false_alarms))


def _prepare_matches(
    x1: Tensor, x2: Tensor, weights: Tensor, present: Tensor, threshold: float, request: Request
) -> PreparedMatches:
    """The present matches ``(m, 2)`` around 0 and of about unit size, by one scale: distances stay comparable."""
    centres = x1.median(0).values, x2.median(0).values
    # squares of tiny coordinates would underflow: a view without extent would not count
    distance = torch.hypot(*torch.cat([x1 - centres[0], x2 - centres[1]]).unbind(-1))
    # copies of one match that are the majority have no spread
    spread = distance[distance > 0].median() if bool(distance.any()) else torch.ones_like(distance[0])
    scale = 1 / spread.clamp(min=torch.finfo(spread.dtype).tiny)
    first, second = (similarity(scale, centre) for centre in centres)
    a, b = (((x - centre) * scale).clamp(-MAX_DISTANCE, MAX_DISTANCE) for x, centre in zip((x1, x2), centres, strict=True))
    pixel = threshold / THRESHOLD_PIXELS * float(scale)
    values = torch.zeros_like(a[:, 0])
    some = draw_subset(len(a), request.options.max_searched, request.generator, a.device)
    if request.spatial:
        values, links = coherence(a, b, MATCH_NOISE_PIXELS * pixel, some)
        # in linked groups large enough for a body
        component = links.components(MIN_LINK_WEIGHT, values > MIN_COHERENCE)
        keep = (torch.bincount(component)[component] >= MIN_BODY_MATCHES).nonzero().flatten()
    else:
        links = Links(torch.zeros(len(a), 0, dtype=torch.long, device=a.device), a.new_zeros(len(a), 0))
        # without neighbours nothing but the place tells garbage, one of which can spoil the depth of a whole body
        keep = (torch.cat([a, b], dim=-1).norm(dim=-1) < FAR_DISTANCE).nonzero().flatten()
    view = View(a, b, pixel, links)
    searched = some[keep].nonzero().flatten()
    return PreparedMatches(weights, present, view, first, second, float(scale), values, keep, searched)


MIN_MATCHES = 8
"""Fewest matches: seven determine a fundamental matrix, and one has to agree with it."""


@one_thread
@on_cpu
def segment(
    x1: Tensor,
    x2: Tensor,
    bodies: int | None = None,
    threshold: float | None = 2.5,
    *,
    weights: Tensor | None = None,
    spatial: bool = True,
    generator: torch.Generator | None = None,
    options: SegmentOptions | None = None,
) -> Segmentation:
    r"""Bodies that moved independently between two views, and the matches that belong to none.

    Each body has a fundamental matrix of its own, :math:`x_2^T F_k\, x_1 = 0` (a plane, or a body seen under a pure rotation, a
    homography).  Matches that move like their neighbours in both images are linked; the linked ones are divided among bodies by
    least cost: truncated Sampson distances, links cut, and the smoothness of each body's depth.  Starts are robust affine flows,
    the epipolar geometries of which form a pool that bodies are chosen from; the best starts descend to maximum likelihood
    fits and labels in turns.  The number of bodies is the one of least cost with a penalty for each body.  Then all matches are
    labelled, the outliers among them.

    A search: it computes on the CPU wherever its tensors are, and the result returns to their device.

    Args:
        x1: ``(*batch, n, 2)`` points of view 1, pixels; NaN = missing.
        x2: the same points in view 2.
        bodies: how many; None finds out.
        threshold: Sampson distance in the unit of the points, about five standard deviations of the noise of a coordinate, at which
            a match may as well be an outlier; one that moves like its neighbours may be up to three times as far from its body.
            All scales follow it; a body whose distances show a noise of half of it and more is none (``NO_CONSENSUS``, notice
            ``misfit``).  None estimates it from the matches, in twice the time.
        weights: ``(*batch, n)`` not negative; 0 leaves a match out, others weigh it in the last fits of the bodies, not in the
            search for them.
        spatial: whether bodies are regions of the images.  False for bodies that interleave, such as transparent motions or
            sparse points of a crowd: then only the geometry decides, which takes more matches and bears fewer outliers.
        generator: source of all randomness; None is torch's global one.
        options: what the search takes and risks; None is :class:`dyntorch.SegmentOptions` as it is.

    Returns:
        A :class:`~dyntorch.tasks.segment.result.Segmentation`, without gradients.

    Raises:
        ValueError: fewer than eight matches or than seven for each body, shapes, dtypes or devices that do not agree, a
            threshold or a number of bodies that is not positive.

    Source: thesis chapter 6; Torr 1998 (models); Isack and Boykov, Energy-based geometric multi-model fitting, 2012.

    Example:
        >>> import torch, dyntorch as dyn
        >>> from dyntorch import scenes
        >>> draw = torch.Generator().manual_seed(0)
        >>> scene = scenes.bodies(160, bodies=2, sigma=0.5, outliers=0.2, generator=draw)
        >>> result = dyn.segment(*scene.views, generator=draw)
        >>> int(result.bodies), tuple(result.fundamentals.shape)
        (2, (2, 3, 3))
    """
    check_threshold(threshold)
    options = SegmentOptions() if options is None else options
    check_options(options, SegmentOptions)
    data = matches(FundamentalMatrix(), (x1, x2), weights)
    check_search(bodies, generator)
    if data.count == 1 and len(x1) >= MIN_MATCHES:
        raise ValueError(
            f"x1 is {tuple(x1.shape)}: problems of one match each; for points as OpenCV gives them, use x1[:, 0], x2[:, 0]"
        )
    _check_counts(bodies, data.count)
    request = Request(bodies, threshold, spatial, generator, options)
    with torch.no_grad():
        results = [solve(a, b, w, request) for a, b, w in zip(*data.views, data.weights, strict=True)]
    if results:
        return stack_results(results, data.batch).in_dtype(x1.dtype) if data.batch else results[0].in_dtype(x1.dtype)
    none = _no_bodies(torch.zeros(data.count, dtype=torch.float64), nan, Status.OK, ())
    tensors: dict[str, Any] = {one.name: getattr(none, one.name) for one in fields(none) if one.name != "notices"}
    return replace(none, **{name: x.new_zeros(*data.batch, *x.shape) for name, x in tensors.items()}).in_dtype(x1.dtype)


def check_search(bodies: int | None, generator: torch.Generator | None) -> None:
    """Refuse what is no number of bodies or no source of randomness."""
    if bodies is not None and (isinstance(bodies, bool) or not isinstance(bodies, int) or bodies < 1):
        raise ValueError(f"bodies must be a positive whole number, or None to find out, got {bodies!r}")
    if generator is not None and not isinstance(generator, torch.Generator):
        raise ValueError(f"generator must be a torch.Generator or None, got {generator!r}; use torch.Generator().manual_seed(0)")


def _check_counts(bodies: int | None, count: int) -> None:
    if count < MIN_MATCHES:
        raise ValueError(f"segment needs at least {MIN_MATCHES} matches, got {count}: add {MIN_MATCHES - count}")
    if bodies is not None and bodies * MIN_BODY_MATCHES > count:
        text = (
            "{arg:bodies={bodies}} take at least {least} matches each, {all} in all, got {count}: "
            "add {more}, or ask for at most {most}"
        )
        whole = bodies * MIN_BODY_MATCHES
        values = {
            "bodies": bodies,
            "least": MIN_BODY_MATCHES,
            "all": whole,
            "count": count,
            "more": whole - count,
            "most": count // MIN_BODY_MATCHES,
        }
        raise ValueError(Message(text, **values))
