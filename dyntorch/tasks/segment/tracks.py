"""segment_tracks(): which tracks of a video move together, how each body moved, and which one stands still."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import log, log1p

import torch
from torch import Tensor

from dyntorch.core.outcome import Notice, Status, select_problem, solve_one_by_one, status_from
from dyntorch.geometry.pairs import order_of_bodies
from dyntorch.numerics.arguments import check_options, check_threshold, on_cpu
from dyntorch.numerics.blocks import one_thread
from dyntorch.tasks.segment.agglomeration import (
    MIN_KERNEL_TRACKS,
    NEGLIGIBLE_LINKS,
    GroupCosts,
    NearPairs,
    cut_into_pieces,
    keep_strongest,
    links_of,
    merge_pieces,
    preference_kernel,
)
from dyntorch.tasks.segment.coherence import THRESHOLD_PIXELS
from dyntorch.tasks.segment.frame_pairs import FramePair, TrackSet, find_scene_cut, select_frame_pairs, select_near_pairs
from dyntorch.tasks.segment.labels import distances, distances_from_cameras, find_static_body, motions, outliers
from dyntorch.tasks.segment.result import SegmentNotice, TrackSegmentation, count_notices
from dyntorch.tasks.segment.search import draw_subset, one_hot
from dyntorch.tasks.segment.segment import MIN_MATCHES, check_search
from dyntorch.tasks.segment.track_energy import (
    MIN_BODY_TRACKS,
    Candidates,
    Exchanges,
    TrackEvidence,
    costs,
    descend_labels,
    energy,
    no_links,
)


@dataclass(frozen=True)
class TrackSegmentOptions:
    """What :func:`dyntorch.segment_tracks` takes and expects."""

    max_bodies: int = 8
    """Largest number of bodies tried where ``bodies`` is None."""
    min_motion: float = 1.0
    """Extent of the tracks, in 19 of 20 cases, below which nothing moves; pixels at a threshold of 2.5, and follows it."""
    max_frame_pairs: int = 64
    """Pairs of frames compared at most (time, memory)."""
    num_hypotheses: int = 200
    """Motions drawn of each kind (affine, homography, fundamental matrix) for a pair of frames (time)."""
    max_searched: int = 1200
    """Tracks that the search looks at (time, memory); the others are labelled by what it finds."""


# ----------------------------------------------------------------------------------------------------------------------
# How many bodies there are, and which of the segmentations into them is the best.

MIN_EXCHANGE_PAIRS = 4  # pairs of frames: two views alone allow wrong exchanges
EXCHANGE_CUT_WEIGHTS = (1.0, 3.0)  # over that in the descent, one search each: either finds what the other misses
COMPARISON_CUT_WEIGHT = 3.0  # at 1, bodies that share an epipolar geometry swallow parts of each other
SEPARATION_WEIGHT = 0.5  # of the least separate bodies, beside the cost per track
COMPARISON_RELIEF_WEIGHT = 0.04  # on streets relief prefers halves of what rests to bodies
SEPARATION_LINK_WEIGHT = 0.1  # of the links cut between the least separate bodies
ENERGY_WEIGHT = 0.5  # of the cost of a segmentation, for each of its tracks
ANOTHER_BODY_LOGIT = -5.7  # logistic regression on 104 sequences of KT3DMoSeg, MTPV62 and Hopkins155: constant,
ANOTHER_BODY_RATIO = 0.4  # what one motion of both costs beside two,
ANOTHER_BODY_UNLINKED = 1.6  # logarithm of the links between them, for each track of the smaller one,
ANOTHER_BODY_SAVED = 2.2  # logarithm of the cost saved, in units of the root of the number of tracks


@dataclass(frozen=True)
class Start:
    """What the search for bodies starts from."""

    evidence: TrackEvidence  # links and pairs of frames
    judge: GroupCosts  # of groups of tracks
    cuts: Sequence[Tensor]  # labels ``(n,)`` of the pieces, once for each number of pieces

    @cached_property
    def trees(self) -> list[dict[int, Tensor]]:
        """Labels ``(n,)`` with any number of bodies, for each of the cuts."""
        most = max(int(cut.max()) + 1 for cut in self.cuts)
        return [merge_pieces(self.judge, cut, range(1, most + 1)) for cut in self.cuts]

    def select_best(self, bodies: int, thorough: bool = False) -> Candidates | None:
        """The best segmentation into so many bodies: separate, and of little cost; None where there is none."""
        starts = [tree[bodies] for tree in self.trees if bodies in tree]
        if not starts:
            return None
        if thorough and bodies > 1:
            for cut, tree in zip(self.cuts, self.trees, strict=True):
                if bodies in tree:
                    exchanges = Exchanges(self.evidence, cut)
                    starts += [exchanges.improve(tree[bodies], weight) for weight in EXCHANGE_CUT_WEIGHTS]
        distinct = [x for place, x in enumerate(starts) if not any(torch.equal(x, other) for other in starts[:place])]
        candidates = descend_labels(self.evidence, torch.stack(distinct), bodies)
        values = [self._value(candidates.of(which), thorough) for which in range(len(distinct))]
        best = max(range(len(values)), key=values.__getitem__)
        return candidates.of(best) if values[best] > float("-inf") else None

    def _value(self, one: Candidates, thorough: bool) -> float:
        """How good a segmentation is beside others into as many bodies."""
        if not bool(one.energy.isfinite()):
            return float("-inf")
        member, count = one_hot(one.labels, one.bodies), len(self.evidence.count)
        least = self.judge.separation(member[0] > 0).value(SEPARATION_LINK_WEIGHT).min() if one.bodies > 1 else 0.0
        separation = float(least)
        if not thorough:
            return separation - ENERGY_WEIGHT * float(one.energy) / count
        cost = energy(self.evidence, one.geometry, one.labels, one.scale, COMPARISON_RELIEF_WEIGHT)
        cut = self.evidence.links.cut_weight(member)
        return SEPARATION_WEIGHT * separation - float(cost + (COMPARISON_CUT_WEIGHT - 1) * cut) / count


def select_bodies(start: Start, bodies: int | None, max_bodies: int) -> tuple[Candidates, bool] | None:
    """The best segmentation into ``bodies``, or fewer where there are no so many, and whether one body less would do; for None into
    as many as there are."""
    if bodies is not None:
        for number in range(bodies, 0, -1):
            candidate = start.select_best(number, thorough=len(start.evidence.pairs) >= MIN_EXCHANGE_PAIRS)
            if candidate is not None:
                fewer = start.select_best(number - 1) if number > 1 else None
                return candidate, fewer is not None and evidence_of_another(start, fewer, candidate) < 0
        return None
    chosen = start.select_best(1)
    if chosen is None:
        return None
    for number in range(2, max_bodies + 1):
        more = start.select_best(number)
        if more is None or evidence_of_another(start, chosen, more) < 0:
            break
        chosen = more
    return chosen, False


def evidence_of_another(start: Start, fewer: Candidates, more: Candidates) -> float:
    r"""Logarithm of the odds that there is one body more,"""
    member = one_hot(more.labels[0], more.bodies) > 0
    before = one_hot(fewer.labels[0], fewer.bodies) > 0
    separation = start.judge.separation(member)
    # the two bodies whose union is most like a body of the other segmentation
    union = (member[separation.first] | member[separation.second]).double()
    shared = union @ before.double().mT
    likeness = shared / (union.sum(-1, keepdim=True) + before.double().sum(-1) - shared)
    split = int(likeness.amax(-1).argmax())
    ratio, links = separation.ratio()[split], separation.links[split] + NEGLIGIBLE_LINKS
    saved = float(fewer.energy - more.energy) / len(start.evidence.count) ** 0.5
    return float(
        ANOTHER_BODY_LOGIT
        + ANOTHER_BODY_RATIO * ratio
        - ANOTHER_BODY_UNLINKED * links.log()
        + ANOTHER_BODY_SAVED * log1p(max(saved, 0.0))
    )


# ----------------------------------------------------------------------------------------------------------------------
# The verb.


NUM_TRACK_NEIGHBOURS = 10  # those with the most common preferences
MIN_COMMON_PREFERENCES = 0.04  # share in common with the five most alike, for one track, and ...
MIN_COMMON_PREFERENCES_GROWTH = 0.0435  # ... per unit of the logarithm of their number
TRACK_CUT_COST = 18.0  # of cutting all links of a track
PIECE_COUNTS = (10, 14)  # one start of the search for each; fewer where a piece would have too few tracks
MIN_PIECE_TRACKS = 6  # on average
MERGE_GAPS = (1, 2, 5)  # frames between those of the pairs by which pieces merge: near ones, where linear fits do
MERGE_PAIRS_PER_GAP = 10  # in a video as long as its tracks; longer ones have more
MAX_CAMERA_DISTANCE = 0.4  # median, in thresholds, of a body that agrees with declared cameras


@dataclass(frozen=True)
class TrackRequest:
    """What was asked for, as in :func:`dyntorch.segment_tracks`."""

    bodies: int | None
    threshold: float
    generator: torch.Generator | None
    options: TrackSegmentOptions

    @property
    def pixel(self) -> float:
        """A pixel of the options in the unit of the tracks: all of them follow the threshold."""
        return self.threshold / THRESHOLD_PIXELS


@one_thread
@on_cpu
def segment_tracks(
    tracks: Tensor,
    bodies: int | None = None,
    threshold: float = 2.5,
    *,
    cameras: Tensor | None = None,
    generator: torch.Generator | None = None,
    options: TrackSegmentOptions | None = None,
) -> TrackSegmentation:
    r"""Bodies that move independently through a video, from tracks that live in any part of it.

    Between any two frames a and b each body has a fundamental matrix of its own, :math:`x_b^T F_k^{ab} x_a = 0`.  Tracks that
    prefer the same hypotheses about the motion, in many pairs of frames, are linked; the graph of the links is cut into more
    pieces than there are bodies, and pieces are joined as long as one motion explains two of them.  Labels and the most likely
    geometries of near and far pairs of frames then descend in turns to the least cost

    .. math:: \sum_i \frac{m}{|P_i|} \sum_{(a, b) \in P_i} \Big[\rho\Big(\frac{r_{i k_i ab}^2}{\sigma^2\, v_{iab}}\Big) + \mu\,
        \text{relief}_{i k_i ab}\Big] + \sum_{ij:\ k_i \ne k_j} L_{ij},

    with Sampson distances r, the noise :math:`\sigma` found from the tracks, and the growth v of its variance with the motion of a
    track.  Cost grows with the number of tracks times that of pairs of frames; of very many tracks a part is searched, and the
    others follow.

    A search: it computes on the CPU wherever its tensors are, and the result returns to their device.

    Args:
        tracks: ``(*batch, frames, n, 2)`` pixels; NaN where a track is not seen.
        bodies: how many, those that stand still included; None finds out.
        threshold: greatest usual distance of a track from the epipolar lines of its body, in the unit of the tracks; all scales
            follow it.
        cameras: ``(*batch, frames, 3, 4)`` projections that the camera is known to have had, up to scale; the body that agrees
            with them stands still.
        generator: source of all randomness; None is torch's global one.
        options: what the search takes and expects; None is :class:`dyntorch.TrackSegmentOptions` as it is.

    Returns:
        A :class:`~dyntorch.tasks.segment.result.TrackSegmentation`, without gradients.

    Raises:
        ValueError: fewer than eight tracks or two frames, shapes or dtypes that do not fit, a threshold or a number of bodies that
            is not positive.

    Source: thesis chapter 6, for many views; Chin, Wang and Suter 2009 (preferences); Xu, Cheong and Li 2018 (several models).

    Example:
        >>> import torch, dyntorch as dyn
        >>> from dyntorch import scenes
        >>> draw = torch.Generator().manual_seed(0)
        >>> street = scenes.streets(bodies=2, frames=10, tracks=150, sigma=0.1, generator=draw)
        >>> found = dyn.segment_tracks(street.tracks, bodies=2, generator=draw)
        >>> tuple(found.labels.shape), int(found.bodies)
        ((150,), 2)
    """
    check_threshold(threshold, estimated=False)
    options = TrackSegmentOptions() if options is None else options
    check_options(options, TrackSegmentOptions)
    _check(tracks, bodies, cameras, generator)
    batch = tracks.shape[:-3]
    request = TrackRequest(bodies, threshold, generator, options)

    def solve(place: int) -> TrackSegmentation:
        own = None if cameras is None else select_problem(cameras, place, batch, 3)
        return _solve(select_problem(tracks, place, batch, 3).double(), own, request)

    with torch.no_grad():
        if batch:
            result = solve_one_by_one(batch, solve, lambda said: _no_bodies(tracks.shape[-2], request, [], Status.TOO_FEW))
        else:
            result = solve(0)
    return result.in_dtype(tracks.dtype)


def _check(tracks: Tensor, bodies: int | None, cameras: Tensor | None, generator: torch.Generator | None) -> None:
    if not isinstance(tracks, Tensor) or tracks.ndim < 3 or tracks.shape[-1] != 2 or not tracks.is_floating_point():
        kind = f"{tuple(tracks.shape)} {tracks.dtype}" if isinstance(tracks, Tensor) else type(tracks).__name__
        raise ValueError(f"tracks must be a floating-point tensor (*batch, frames, n, 2), NaN = missing, got {kind}")
    if tracks.shape[-3] < 2:
        raise ValueError(f"tracks hold {tracks.shape[-3]} frame, and motion needs two; give (frames, n, 2)")
    if tracks.shape[-2] < MIN_MATCHES:
        raise ValueError(
            f"segment_tracks needs at least {MIN_MATCHES} tracks, got {tracks.shape[-2]}: add {MIN_MATCHES - tracks.shape[-2]}"
        )
    check_search(bodies, generator)
    shapes = [(*batch, tracks.shape[-3], 3, 4) for batch in ((), tracks.shape[:-3])]
    if cameras is not None and (not isinstance(cameras, Tensor) or tuple(cameras.shape) not in shapes):
        shape = tuple(cameras.shape) if isinstance(cameras, Tensor) else type(cameras).__name__
        raise ValueError(f"cameras must be (*batch, {tracks.shape[-3]}, 3, 4), a projection for every frame, got {shape}")
    if cameras is not None and not bool(cameras.isfinite().all()):
        raise ValueError("cameras hold numbers that are not finite; give the projection of every frame, or none")


# ----------------------------------------------------------------------------------------------------------------------
# One problem, stage by stage.


def _solve(tracks: Tensor, cameras: Tensor | None, request: TrackRequest) -> TrackSegmentation:
    options, count = request.options, tracks.shape[1]
    seen = tracks.isfinite().all(-1)
    # 1. what is there: tracks in two frames at least, frames with tracks in common, motion, one scene
    if not bool((seen.sum(0) > 1).any()):
        return _no_bodies(count, request, [Notice(SegmentNotice.SHORT)])
    film = TrackSet.of(torch.where((seen.sum(0) > 1)[:, None], tracks, torch.nan), request.pixel)
    refused = _refusal(film, request)
    frames = [] if refused else select_frame_pairs(film, options.max_frame_pairs)
    if refused or not frames:
        common = int((film.seen[:-1] & film.seen[1:]).sum(-1).max())
        few = Notice(SegmentNotice.FEW_COMMON, float(common), {"least": MIN_MATCHES})
        return _no_bodies(count, request, [refused or few])
    # 2. which tracks move alike, and the bodies of those that are searched
    alive = film.seen.any(0).nonzero().flatten()
    searched = alive[draw_subset(len(alive), options.max_searched, request.generator, alive.device)]
    kernel = preference_kernel(film, searched, request.generator, options.num_hypotheses)
    # what the usual track has in common with the five that move most like it
    alike = float(kernel[searched].topk(min(5, len(searched)), dim=-1).values.mean(-1).median())
    if alike < MIN_COMMON_PREFERENCES + MIN_COMMON_PREFERENCES_GROWTH * log(len(searched)):
        return _no_bodies(count, request, [Notice(SegmentNotice.UNRELATED, alike)])
    start = _start(film, frames, kernel, searched, request)
    chosen = select_bodies(start, request.bodies, options.max_bodies)
    if chosen is None:
        return _no_bodies(count, request, [], Status.NO_CONSENSUS)
    # 3. all tracks follow, and what belongs to no body is told
    pairs = [film.pair(pair) for pair in frames]
    member = _label_all(film, pairs, kernel, searched, chosen[0])
    return _outcome(tracks, cameras, film, pairs, kernel, searched, member, chosen, request)


def _refusal(film: TrackSet, request: TrackRequest) -> Notice | None:
    """Why there is nothing to segment."""
    cut = find_scene_cut(film)
    if cut is not None:
        values = {"frame": cut.frame, "case": "jump" if cut.jump else ""}
        return Notice(SegmentNotice.CUT, cut.jump or cut.share, values)
    low = torch.where(film.seen[..., None], film.x, torch.inf).amin(0)
    high = torch.where(film.seen[..., None], film.x, -torch.inf).amax(0)
    way = (high - low).norm(dim=-1)[film.seen.any(0)] / film.pixel
    farthest, least = float(way.quantile(0.95)), request.options.min_motion
    if farthest < least:
        return Notice(SegmentNotice.STILL, farthest * request.pixel, {"least": least * request.pixel})
    return None


def _start(film: TrackSet, frames: Sequence[tuple[int, int]], kernel: Tensor, searched: Tensor, request: TrackRequest) -> Start:
    """What the search for bodies starts from: links, pairs of frames and pieces of the searched tracks."""
    part = TrackSet(film.x[:, searched], film.seen[:, searched], film.pixel, film.change)
    inner = kernel[searched]
    inner = (inner + inner.mT) / 2
    sparse = keep_strongest(inner, NUM_TRACK_NEIGHBOURS)
    pairs = [part.pair(pair) for pair in frames]
    evidence = TrackEvidence.of(pairs, links_of(sparse, TRACK_CUT_COST))
    beside = select_near_pairs(part, MERGE_GAPS, MERGE_PAIRS_PER_GAP, MIN_KERNEL_TRACKS)
    near = NearPairs(part, beside or frames)
    least, most = request.bodies or 1, max(1, len(searched) // MIN_PIECE_TRACKS)
    cuts = [cut_into_pieces(sparse, max(min(number, most), min(least, most))) for number in PIECE_COUNTS]
    judge = GroupCosts.of(near, inner, one_hot(cuts[0], int(cuts[0].max()) + 1) > 0)
    return Start(evidence, judge, cuts)


def _label_all(film: TrackSet, pairs: list[FramePair], kernel: Tensor, searched: Tensor, candidate: Candidates) -> Tensor:
    """Probabilities ``(K, n)`` of all tracks: those searched have theirs, the others those of what they move like."""
    count = film.x.shape[1]
    member = torch.zeros(candidate.bodies, count, dtype=torch.float64, device=film.x.device)
    member[:, searched] = candidate.member[0].double()
    rest = film.seen.any(0)
    rest[searched] = False
    rest = rest.nonzero().flatten()
    if len(rest):
        near = kernel[rest].topk(min(NUM_TRACK_NEIGHBOURS, len(searched)), dim=-1)
        weight = near.values.double() / near.values.double().sum(-1, keepdim=True).clamp(min=1e-9)
        pulled = (member[:, searched][:, near.indices] * weight).sum(-1) * TRACK_CUT_COST
        evidence = TrackEvidence.of(pairs, no_links(count, film.x.device))
        cost = costs(evidence, candidate.geometry, candidate.scale, member[None])[0][:, rest]
        member[:, rest] = torch.softmax(pulled - cost, dim=0)
    return member


def _outcome(
    tracks: Tensor,
    cameras: Tensor | None,
    film: TrackSet,
    pairs: list[FramePair],
    kernel: Tensor,
    searched: Tensor,
    member: Tensor,
    chosen: tuple[Candidates, bool],
    request: TrackRequest,
) -> TrackSegmentation:
    """Labels by size, with motions, the body that stands still, and what limits all that."""
    count = tracks.shape[1]
    alive = film.seen.any(0)
    labels = member.argmax(0)
    geometry, spare = chosen[0].geometry, chosen[1]
    far = distances(pairs, geometry, count)
    wrong = outliers(far, labels, _support(kernel, labels[searched], labels)) | ~alive
    hard = one_hot(labels, len(member)) * ~wrong
    order = order_of_bodies(hard > 0)
    order = order[(hard.sum(-1) >= MIN_BODY_TRACKS)[order]]
    member, hard, far = member[order], hard[order], far[:, order]
    if not len(order):
        return _no_bodies(count, request, [], Status.NO_CONSENSUS)
    named = torch.where(hard.any(0), hard.argmax(0) + 1, 0)
    own = far.gather(1, (named - 1).clamp(min=0).expand(len(far), 1, -1))[:, 0]
    nearest = torch.where(named > 0, own.square().nanmean(0), far.square().nanmean(0).nan_to_num(nan=torch.inf).amin(0))
    fundamentals, homographies, planar = motions(pairs, geometry[:, :, order], hard, film)
    static, notices = _static(tracks, cameras, film, hard, pairs, request)
    lone = [Notice(SegmentNotice.ONE_BODY, 1.0)] if request.bodies is None and len(order) == 1 else []
    notices = [*count_notices(len(order), request.bodies, spare, case="tracks"), *lone, *notices]
    bodies = member / member.sum(0).clamp(min=1e-12) * (named > 0)
    missing = (named == 0) & alive
    return TrackSegmentation(
        labels=named,
        bodies=torch.tensor(len(order)),
        static_body=torch.tensor(static),
        pairs=torch.tensor([pair.frames for pair in pairs]),
        geometries=fundamentals,
        homographies=homographies,
        planar=planar,
        probabilities=torch.cat([missing.double()[None], bodies]).mT,
        residuals=torch.where(nearest.isfinite(), nearest, 0.0).sqrt() * request.pixel,
        threshold=torch.tensor(request.threshold, dtype=torch.float64),
        status=status_from(notices) if request.bodies in (None, len(order)) else torch.tensor(int(Status.NO_CONSENSUS)),
        notices=tuple(notices),
    )


def _support(kernel: Tensor, searched: Tensor, labels: Tensor) -> Tensor:
    """``(n,)`` share of what a track is linked with that has its label: ``(n,)`` of all, ``(m,)`` of the searched ones."""
    top = kernel.topk(min(NUM_TRACK_NEIGHBOURS, kernel.shape[1]), dim=-1)
    same = (searched[top.indices] == labels[:, None]) * top.values
    return (same.sum(-1) / top.values.sum(-1).clamp(min=1e-9)).double()


def _static(
    tracks: Tensor, cameras: Tensor | None, film: TrackSet, hard: Tensor, pairs: list[FramePair], request: TrackRequest
) -> tuple[int, list[Notice]]:
    """The number of the body that stands still, 0 where it is not known, and why."""
    if cameras is not None:
        off = distances_from_cameras(tracks, hard, cameras.double(), pairs)
        best = int(off.argmin())
        if float(off[best]) <= MAX_CAMERA_DISTANCE * request.threshold:
            return best + 1, []
        return 0, [Notice(SegmentNotice.DISAGREEING, float(off[best]))]
    rests = find_static_body(film, hard)
    if rests is not None:
        return rests + 1, []
    return 0, [Notice(SegmentNotice.UNSURE_STATIC, float(hard.sum(-1).max() / hard.sum()))]


def _no_bodies(count: int, request: TrackRequest, notices: list[Notice], status: Status | None = None) -> TrackSegmentation:
    """No bodies: all tracks are outliers."""
    none = torch.zeros(0, 0, 3, 3, dtype=torch.float64)
    return TrackSegmentation(
        labels=torch.zeros(count, dtype=torch.long),
        bodies=torch.tensor(0),
        static_body=torch.tensor(0),
        pairs=torch.zeros(0, 2, dtype=torch.long),
        geometries=none,
        homographies=none,
        planar=torch.zeros(0, 0, dtype=torch.bool),
        probabilities=torch.ones(count, 1, dtype=torch.float64),
        residuals=torch.zeros(count, dtype=torch.float64),
        threshold=torch.tensor(request.threshold, dtype=torch.float64),
        status=status_from(notices) if status is None else torch.tensor(int(status)),
        notices=tuple(notices),
    )
