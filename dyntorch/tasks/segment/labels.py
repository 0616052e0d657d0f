"""Labels of all matches, outliers among them, given the bodies found among the coherent ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import lgamma, log

import torch
from torch import Tensor

from dyntorch.core.limits import MAX_SQUARED_DISTANCE, median
from dyntorch.geometry.epipolar import sampson_squared
from dyntorch.geometry.epipolar_fit import descend
from dyntorch.geometry.homogeneous import skew, unit
from dyntorch.geometry.homography import homography, homography_sampson_squared
from dyntorch.tasks.segment.coherence import THRESHOLD_PIXELS, Links, View, conformity, mean_field
from dyntorch.tasks.segment.frame_pairs import FramePair, TrackSet
from dyntorch.tasks.segment.track_energy import MIN_BODY_TRACKS, Geometry

OUTLIER_COST = 1.0  # where many are
MIN_OUTLIER_SHARE = 0.005  # below which they are no rarer
MAX_OUTLIER_SHARE = 0.2  # above which they cost no less
NONCONFORMITY_COST = 2.5  # of a match that moves unlike all its neighbours of a body
FREE_CONFORMITY = 0.25  # over the median one of the members, from which a match costs nothing
MIN_FREE_CONFORMITY = 0.02  # the same conformity, at least
ASSIGNMENT_GAIN = 6.0  # of a match in the body that the search assigned it to
LABEL_SHARPNESS = 4.0  # inverse temperature of the probabilities, and weight of links between different labels
NUM_LABEL_UPDATES = 20  # of the mean field
NUM_LABEL_ROUNDS = 3  # of labels and fits
LABEL_FIT_SCALE = 0.8  # in thresholds
MAX_OFF_PLANE_SHARE = 0.02  # of a planar body: wrong matches that lie on its epipolar lines
OFF_PLANE_DISTANCE = 1.5  # in two dimensions, in thresholds
MIN_NOISE_PIXELS = 0.1  # of a coordinate: no detector is better, and exact data shows none
MAX_SQUARED_DEVIATION = 6.25  # over the variance, in the estimate of the noise
TRUNCATED_VARIANCE = 0.978  # E min(z^2, 6.25) of a normal z
NUM_NOISE_UPDATES = 10  # rounds of the estimate of the noise


@dataclass(frozen=True)
class Labelling:
    """Labels of all matches."""

    probabilities: Tensor  # ``(K + 1, n)``, the first of an outlier
    fundamentals: Tensor  # ``(K, 3, 3)``

    @property
    def labels(self) -> Tensor:
        """``(n,)``, 0 outlier."""
        return self.probabilities.argmax(0)

    def of(self, bodies: Tensor) -> Labelling:
        """With these bodies alone (indices or bool): what belonged to others belongs to none."""
        probabilities = self.probabilities[1:][bodies]
        return Labelling(torch.cat([1 - probabilities.sum(0, keepdim=True), probabilities]).clamp(min=0), self.fundamentals[bodies])


def label_matches(
    view: View, labels: Tensor, fundamentals: Tensor, weights: Tensor, threshold: float, scale: float | None, share: float
) -> Labelling:
    r"""Labels and geometries in turns: a mean field of the costs found ``(n,)``, fundamentals ``(K, 3, 3)``, weights ``(n,)``."""
    numbers = torch.arange(1, len(fundamentals) + 1, device=labels.device)[:, None]
    members = labels == numbers
    gain = ASSIGNMENT_GAIN * members.to(weights.dtype) if scale is not None else 0.0
    strange = _nonconformity_cost(view, members, scale)
    # the sum of the links of every match is 1
    links = Links(view.links.index, view.links.weight / view.links.weight.sum(-1, keepdim=True).clamp(min=1e-9))
    odds = [(1 - p) / p for p in (min(max(share, MIN_OUTLIER_SHARE), MAX_OUTLIER_SHARE), MAX_OUTLIER_SHARE)]
    outlier = OUTLIER_COST + log(odds[0] / odds[1]) / LABEL_SHARPNESS

    def probabilities(bodies: Tensor) -> Tensor:
        square = sampson_squared(bodies, view.x1, view.x2) / threshold**2
        cost = square.clamp(max=MAX_SQUARED_DISTANCE) + strange - gain
        every = torch.cat([torch.full_like(cost[:1], outlier), cost])
        return mean_field(LABEL_SHARPNESS * every, links, LABEL_SHARPNESS, NUM_LABEL_UPDATES)

    bodies = fundamentals
    member = probabilities(bodies)
    for turn in range(NUM_LABEL_ROUNDS):
        members = member.argmax(0) == numbers
        # a descent never raises its own truncated cost, so geometries cannot drift away from their members
        bodies = descend(bodies, view.x1, view.x2, members * weights, LABEL_FIT_SCALE * threshold)
        strange = _nonconformity_cost(view, members, scale) if turn == 0 else strange
        member = probabilities(bodies)
    return Labelling(member, bodies)


def _nonconformity_cost(view: View, members: Tensor, scale: float | None) -> Tensor:
    """Cost ``(K, n)`` of moving unlike the neighbours."""
    if scale is None:
        return torch.zeros_like(members, dtype=view.x1.dtype)
    value = conformity(view.x1, view.x2, members, scale)
    # members of deep bodies move less like each other
    usual = torch.where(members, value, torch.nan).nanmedian(-1, keepdim=True).values.nan_to_num(nan=1.0)
    return NONCONFORMITY_COST * (1 - value / (FREE_CONFORMITY * usual).clamp(min=MIN_FREE_CONFORMITY)).clamp(min=0)


# ----------------------------------------------------------------------------------------------------------------------
# Whether two views show a body as one with depth, or as a plane: a fundamental matrix or a homography.


TINY = 1e-30


def select_models(view: View, fundamentals: Tensor, members: Tensor) -> tuple[Tensor, Tensor]:
    """The best homographies ``(K, 3, 3)`` of K bodies, of norm 1, and whether they explain them, ``(K,)`` bool: their robust
    information criterion is smaller than that of the fundamental matrices."""
    # weights are relative: they count as so many equal ones
    members = members * (members.sum(-1) / members.square().sum(-1).clamp(min=TINY))[:, None]
    epipolar = sampson_squared(fundamentals, view.x1, view.x2)
    noise = _noise(epipolar, members).clamp(min=(MIN_NOISE_PIXELS * view.pixel) ** 2)
    plane = homography(view.x1, view.x2, members, scale=3 * view.pixel, steps=8)[0]
    planar = homography_sampson_squared(plane, view.x1, view.x2)
    first = _criterion(epipolar / noise, members, 3, 7)
    second = _criterion(planar / noise, members, 2, 8)
    off = ((planar > (OFF_PLANE_DISTANCE * THRESHOLD_PIXELS * view.pixel) ** 2) * members).sum(-1) / members.sum(-1).clamp(min=TINY)
    return plane, (second < first) & (off <= MAX_OFF_PLANE_SHARE)


def _noise(square: Tensor, members: Tensor) -> Tensor:
    """Variance ``()`` of a coordinate by the distances ``(K, n)`` from the epipolar lines of all bodies."""
    every, weight = square.flatten(), members.flatten()
    order = every.argsort()
    share = weight[order].cumsum(0)
    total = share[-1].clamp(min=TINY)
    variance = every[order[(share >= 0.5 * total).to(torch.int8).argmax()]] / median(1)
    for _ in range(NUM_NOISE_UPDATES):
        variance = (every.minimum(MAX_SQUARED_DEVIATION * variance) * weight).sum() / (TRUNCATED_VARIANCE * total)
    count = members.sum(-1)
    # the best F of a plane is the luckiest of a family: measured with 15 to 100 matches, its squares lack sqrt(2n) beyond 7
    freedom = (count - 7 - (2 * count).sqrt()).clamp(min=0).sum().clamp(min=1)
    return variance * total / freedom


def _criterion(square: Tensor, members: Tensor, dimension: int, parameters: int) -> Tensor:
    count = members.sum(-1)
    fit = (square.clamp(max=2.0 * (4 - dimension)) * members).sum(-1)
    return fit + dimension * count * log(4) + parameters * (4 * count).clamp(min=1.0).log()


# ----------------------------------------------------------------------------------------------------------------------
# Whether so many matches would agree with an epipolar geometry by chance.


SAMPLE = 7
"""Matches that determine a fundamental matrix."""


def significant(view: View, fundamentals: Tensor, labels: Tensor, false_alarms: float) -> Tensor:
    r"""Which bodies are no accident, ``(K,)`` bool: their expected number in random matches,"""
    threshold = THRESHOLD_PIXELS * view.pixel
    near = sampson_squared(fundamentals, view.x1, view.x2) <= threshold**2
    chance = max(_chance(x, threshold) for x in (view.x1, view.x2))
    believed = []
    for number, close in enumerate(near, start=1):
        own = labels == number
        count, among = int((own & close).sum()), int((own | (labels == 0)).sum())
        believed.append(count > SAMPLE and _alarms(among, count, chance) < log(false_alarms))
    return torch.tensor(believed, dtype=torch.bool, device=labels.device)


def _chance(x: Tensor, threshold: float) -> float:
    """Probability p that a random match is near the line of another point, in the box that holds nearly all ``(n, 2)``."""
    low, high = torch.quantile(x, x.new_tensor([0.02, 0.98]), dim=0)
    width, height = (high - low).clamp(min=threshold).tolist()
    return float(min(1.0, 2 * threshold * (width**2 + height**2) ** 0.5 / (width * height)))


def _alarms(n: int, k: int, chance: float) -> float:
    """Logarithm of the expected number of bodies of k among n random matches."""
    return log(max(1, n - SAMPLE)) + _choose(n, k) + _choose(k, SAMPLE) + (k - SAMPLE) * log(chance)


def _choose(n: int, k: int) -> float:
    """Logarithm of the binomial coefficient."""
    return lgamma(n + 1) - lgamma(k + 1) - lgamma(n - k + 1)


# ----------------------------------------------------------------------------------------------------------------------
# What belongs to no body, how each body moved between the frames that were compared, and which one stands still.


MAX_BODY_DISTANCE_PIXELS = 2.5  # median over the pairs of frames
MAX_SUPPORTED_DISTANCE_PIXELS = 7.5  # the same for a track that is linked with others of its body
MIN_SUPPORT = 0.5  # share of the links of a track that lead to its body
NUM_WIDTH_CELLS = 8  # of the grid, across and down, by which the width of bodies is measured
MIN_STATIC_RATIO = 1.5  # tracks of the static body over those of any other, if it is the widest, too
MIN_STATIC_SHARE = 0.4  # of the tracks that belong to a body


def distances(pairs: Sequence[FramePair], geometry: Geometry, count: int) -> Tensor:
    """Sampson distances ``(P, K, n)`` in pixels of all tracks from all bodies, whose geometry is ``(P, 1, K, 3, 3)``;
    NaN where a track is not in the pair, or the body's motion between its frames is not known."""
    result = torch.full((len(pairs), geometry.shape[2], count), torch.nan, dtype=torch.float64, device=geometry.device)
    for row, pair, F in zip(result, pairs, geometry, strict=True):
        square = sampson_squared(F[0], pair.view.x1, pair.view.x2)
        has_motion = (F[0] != 0).any(-1).any(-1)
        row[:, pair.index] = torch.where(has_motion[:, None], square.sqrt() / pair.view.pixel, torch.nan)
    return result


def outliers(distance: Tensor, labels: Tensor, support: Tensor) -> Tensor:
    """``(n,)`` bool: tracks that are usually farther from their body than a track of it may be."""
    own = distance.gather(1, labels.expand(len(distance), 1, -1))[:, 0]
    usual = own.nanquantile(0.5, dim=0).nan_to_num(nan=0.0)
    return usual > torch.where(support > MIN_SUPPORT, MAX_SUPPORTED_DISTANCE_PIXELS, MAX_BODY_DISTANCE_PIXELS)


def motions(pairs: Sequence[FramePair], geometry: Geometry, member: Tensor, film: TrackSet) -> tuple[Tensor, Tensor, Tensor]:
    """F and H ``(P, K, 3, 3)`` of bodies between the frames of P pairs, in the coordinates of the input, and which are planes
    ``(P, K)``: members ``(K, n)``, 0 or 1; 0 where two frames have too few of them in common."""
    back = torch.linalg.inv(film.change)
    fundamentals, homographies, planar = [], [], []
    for pair, F in zip(pairs, geometry, strict=True):
        some = member[:, pair.index]
        there = some.sum(-1) >= MIN_BODY_TRACKS
        planes, flat = select_models(pair.view, F[0], some)
        flat = there & flat
        fundamentals.append(torch.where(there[:, None, None], unit(film.change.mT @ F[0] @ film.change), 0.0))
        homographies.append(torch.where(flat[:, None, None], unit(back @ planes @ film.change), 0.0))
        planar.append(flat)
    return torch.stack(fundamentals), torch.stack(homographies), torch.stack(planar)


def widths(film: TrackSet, member: Tensor) -> Tensor:
    """How wide bodies of members ``(K, n)`` are: the share ``(K,)`` of the cells of a grid over the picture that they are seen in,
    of those that anything is seen in, in the mean over the frames."""
    there = film.x[film.seen]
    low, high = there.quantile(there.new_tensor([0.01, 0.99]), dim=0)
    cell = ((film.x - low) / (high - low).clamp(min=1e-12) * NUM_WIDTH_CELLS).long().clamp(0, NUM_WIDTH_CELLS - 1)
    place = cell[..., 0] * NUM_WIDTH_CELLS + cell[..., 1]
    shares = []
    for seen, where in zip(film.seen, place, strict=True):
        if not bool(seen.any()):
            continue
        grid = torch.zeros(len(member), NUM_WIDTH_CELLS**2, dtype=torch.float64, device=member.device)
        grid.index_add_(1, where[seen], member[:, seen].double())
        shares.append((grid > 0).sum(-1) / (grid > 0).any(0).sum())
    return torch.stack(shares).mean(0)


def find_static_body(film: TrackSet, member: Tensor) -> int | None:
    """Which body of members ``(K, n)`` must be what stands still: the largest, if it is the widest, too, and large enough."""
    size = member.sum(-1)
    largest = int(size.argmax())
    wide = widths(film, member)
    others = torch.arange(len(size), device=size.device) != largest
    clear = bool((size[largest] >= MIN_STATIC_RATIO * size[others]).all()) and bool((wide[largest] >= wide[others]).all())
    return largest if clear and float(size[largest]) >= MIN_STATIC_SHARE * float(size.sum()) else None


def distances_from_cameras(tracks: Tensor, member: Tensor, cameras: Tensor, pairs: Sequence[FramePair]) -> Tensor:
    """Median Sampson distances ``(K,)`` of bodies of members ``(K, n)`` from the motion of cameras ``(frames, 3, 4)``."""
    samples: list[list[Tensor]] = [[] for _ in member]
    for pair in pairs:
        first, second = cameras[pair.frames[0]], cameras[pair.frames[1]]
        centre = torch.linalg.svd(first)[2][-1]
        F = unit(skew(second @ centre) @ second @ torch.linalg.pinv(first))
        x1, x2 = (tracks[frame][pair.index] for frame in pair.frames)
        distance = sampson_squared(F, x1, x2).sqrt()
        for own, some in zip(samples, member[:, pair.index] > 0, strict=True):
            own.append(distance[some])
    none = tracks.new_tensor(torch.inf)
    return torch.stack([torch.cat(own).median() if sum(map(len, own)) else none for own in samples])
