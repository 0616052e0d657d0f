"""Rigid motions of a metric sensor among points that move, as few as there are, up to all of them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import normalize, pad

from dyntorch.core.limits import median, three_sigma
from dyntorch.core.matches import Matches
from dyntorch.core.outcome import Notice, Status, in_order, is_failure, noting
from dyntorch.core.solution import NOISY
from dyntorch.geometry.homogeneous import similarity, skew
from dyntorch.geometry.rigid import moved_by, rigid_alignment
from dyntorch.numerics.blocks import each, map_blocks, uniform
from dyntorch.numerics.least_squares import Iterate, LeastSquares, LeastSquaresOptions, Tensors, damped_step, minimize
from dyntorch.numerics.nullspace import spectrum
from dyntorch.tasks.align.labelling import ROUGH_LABEL_FACTOR, THRESHOLD_SIGMAS
from dyntorch.tasks.align.result import (
    MIN_STATIC_SUPPORT,
    MOVING,
    OUTLIER,
    STATIC,
    Alignment,
    AlignNotice,
    AlignOptions,
    agrees_too_little,
    alignment_of,
    contradicts,
    count_rival_static,
    labels_of,
    status_of_alignment,
)

# ----------------------------------------------------------------------------------------------------------------------
# Two rigid motions from points that move: :math:`x_1, A x_2, B x_3` on a straight line, or at equal steps on it.
#
# With equal noise in all coordinates, and :math:`y_1 = x_1, y_2 = A x_2, y_3 = B x_3`, the two orthonormal combinations
#
# .. math:: u = (y_1 - y_3) / \sqrt 2, \qquad v = (y_1 - 2 y_2 + y_3) / \sqrt 6
#
# hold everything: a static point has :math:`\|u\|^2 + \|v\|^2 = \chi^2_6 \sigma^2`, one of constant velocity
# :math:`\|v\|^2 = \chi^2_3 \sigma^2`, and one on a straight line the smaller eigenvalue of the Gram matrix of u and v,
# :math:`\chi^2_2 \sigma^2`.  No covariance is needed, because a rigid motion leaves noise as it is.


MOTIONS = {"straight": 2, "constant_velocity": 3}
"""Conditions that a moving point fulfils."""
DESCENT = LeastSquaresOptions(iterations=20, least_damping=1e-10, stuck_damping=1e5)


NUM_STATIC_SAMPLES = 60  # of 3: 40 % static points without outliers are met by 98 % of 60 such samples
NUM_MOVING_SAMPLES = 60  # of matches taken as moving
NUM_REFINED_STARTS = 5  # of least cost
NUM_RIGID_ROUNDS = 4  # of labelling and least squares
RIGID_BLOCK = 16  # problems of a batch that are solved together
NUM_RIGID_VELOCITY_CANDIDATES = 512  # tried as the common one
RIGID_INFORMATION_RATIO = 1e-10  # worst over best direction, below which it is rounding error
MAX_RIGID_DEVIATION = 0.3  # of the worst direction, radians or sizes of the scene, above which the motion is not known at all
MIN_SPARE_RIGID = 4  # conditions beyond the degrees of freedom that inliers must fulfil: a minimal set fulfils those


@dataclass(frozen=True)
class RigidSightings:
    """Points of three poses in one common unit; leading dimensions broadcast against those of the motions."""

    x1: Tensor  # ``(..., n, 3)``
    x2: Tensor
    x3: Tensor
    weights: Tensor  # ``(..., n)``
    motion: str  # one of :data:`MOTIONS`

    @property
    def conditions(self) -> int:
        """Degrees of freedom of the residual of one moving point."""
        return MOTIONS[self.motion]

    def sample(self, index: Tensor) -> RigidSightings:
        """The matches ``index (b, k, m)`` of sightings ``(b, 1, n, 3)``: k small problems for each."""
        k = index.shape[1]

        def pick(x: Tensor) -> Tensor:
            return x.expand(-1, k, -1, -1).gather(2, index[..., None].expand(-1, -1, -1, 3))

        weights = self.weights.expand(-1, k, -1).gather(2, index)
        return RigidSightings(pick(self.x1), pick(self.x2), pick(self.x3), weights, self.motion)

    def flat(self, lead: torch.Size) -> RigidSightings:
        """Expanded to the leading dimensions and flattened to one."""

        def spread(x: Tensor, tail: int) -> Tensor:
            return x.expand(*lead, *x.shape[-tail:]).reshape(-1, *x.shape[-tail:])

        return RigidSightings(spread(self.x1, 2), spread(self.x2, 2), spread(self.x3, 2), spread(self.weights, 1), self.motion)


def combinations(motions: Tensor, data: RigidSightings) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The combinations u and v of each match, and the points y2 and y3 in the frame of view 1, ``(..., n, 3)`` each."""
    y2, y3 = (x @ motions[..., i, :3, :3].mT + motions[..., i, None, :3, 3] for i, x in ((0, data.x2), (1, data.x3)))
    return (data.x1 - y3) / math.sqrt(2), (data.x1 - 2 * y2 + y3) / math.sqrt(6), y2, y3


def turn(u: Tensor, v: Tensor, motion: str) -> tuple[Tensor, Tensor]:
    """Cosine and sine ``(..., n, 1)`` of the turn after which the second combination is the residual of a moving point."""
    if motion == "constant_velocity":
        return torch.ones_like(u[..., :1]), torch.zeros_like(u[..., :1])
    double = torch.stack([u.square().sum(-1) - v.square().sum(-1), 2 * (u * v).sum(-1)], dim=-1)
    angle = 0.5 * torch.atan2(double[..., 1], double[..., 0])[..., None]
    return angle.cos(), angle.sin()


def squares(motions: Tensor, data: RigidSightings) -> tuple[Tensor, Tensor]:
    """Squared residuals ``(..., n)`` of each match as a moving point, and as a static one."""
    u, v, _, _ = combinations(motions, data)
    cos, sin = turn(u, v, data.motion)
    return (cos * v - sin * u).square().sum(-1), u.square().sum(-1) + v.square().sum(-1)


def normal_equations(motions: Tensor, data: RigidSightings, weights: Tensor, still: Tensor | None) -> tuple[Tensor, Tensor]:
    r"""Gradient ``(..., 12)`` and Gauss-Newton matrix in the tangents :math:`(\omega_A, \tau_A, \omega_B, \tau_B)`."""
    u, v, y2, y3 = combinations(motions, data)
    cos, sin = turn(u, v, data.motion)
    error, along = cos * v - sin * u, cos * u + sin * v
    eye = torch.eye(3, dtype=u.dtype, device=u.device)
    d2, d3 = (torch.cat([-skew(y), eye.expand(*y.shape, 3)], dim=-1) for y in (y2, y3))
    one, two, three = 1 / math.sqrt(2), 2 / math.sqrt(6), 1 / math.sqrt(6)
    jacobian = torch.cat([(-two * cos)[..., None] * d2, (three * cos + one * sin)[..., None] * d3], dim=-1)
    rest = None if still is None else torch.cat([(-two * sin)[..., None] * d2, (three * sin - one * cos)[..., None] * d3], dim=-1)
    root = weights.sqrt()[..., None]
    if data.motion == "straight":
        free = root if still is None else torch.where(still[..., None], 0.0, root)
        direction = normalize(along, dim=-1, eps=torch.finfo(u.dtype).tiny)
        normal = jacobian - direction[..., :, None] * (direction[..., None, :] @ jacobian)
        jacobian = torch.where((free > 0)[..., None], normal, jacobian)
    rows, values = (root[..., None] * jacobian).flatten(-3, -2), (root * error).flatten(-2)
    if rest is not None and still is not None:
        held = torch.where(still[..., None], root, 0.0)
        rows = torch.cat([rows, (held[..., None] * rest).flatten(-3, -2)], dim=-2)
        values = torch.cat([values, (held * along).flatten(-2)], dim=-1)
    return (rows.mT @ values[..., None])[..., 0], rows.mT @ rows


def descend(
    motions: Tensor, data: RigidSightings, *, scale: Tensor | None = None, still: Tensor | None = None, iterations: int = 20
) -> tuple[Tensor, Tensor]:
    r"""Levenberg-Marquardt over two rigid motions, for a whole batch of problems. motions ``(*lead, 2, 4, 4)``, scale
    ``(*lead,)``, still ``(*lead, n)`` -> ``(*lead,)``."""
    lead = motions.shape[:-3]
    flat = data.flat(lead)
    square = None if scale is None else scale.expand(lead).reshape(-1, 1).square()
    held = None if still is None else still.expand(*lead, -1).reshape(flat.weights.shape)
    problem = RigidProblem(flat, square, held)
    found = minimize(problem, problem.evaluate((motions.reshape(-1, 2, 4, 4),)), replace(DESCENT, iterations=iterations))
    return found.theta[0].reshape(motions.shape), found.cost.reshape(lead)


@dataclass(frozen=True)
class RigidProblem(LeastSquares):
    """Least squares in motions ``(b, 2, 4, 4)``, robust with the squared ``scale (b, 1)``; ``still (b, n)`` points are static."""

    data: RigidSightings
    square: Tensor | None
    still: Tensor | None

    def subset(self, keep: Tensor) -> RigidProblem:
        """Only some of the problems."""
        return each(lambda x: x[keep], self)

    def evaluate(self, theta: Tensors) -> Iterate:
        """With the squared residuals ``(b, n)``."""
        moving, static = squares(theta[0], self.data)
        r = moving if self.still is None else torch.where(self.still, static, moving)
        loss = r if self.square is None else r * self.square / (self.square + r)
        return Iterate(theta, (self.data.weights * loss).sum(-1), (r,))

    def step(self, at: Iterate, damping: Tensor) -> Tensors:
        """Turns and shifts ``(b, 12)``."""
        weights = self.data.weights
        if self.square is not None:
            weights = weights * (self.square / (self.square + at.terms[0])).square()
        step = damped_step(*normal_equations(at.theta[0], self.data, weights, self.still), damping)
        # half a radian is as far as the linearization of a rotation can be trusted
        length = step.unflatten(-1, (2, 2, 3))[:, :, 0].norm(dim=-1).amax(-1)
        return (step / (2 * length).clamp(min=1.0)[:, None],)

    def retract(self, theta: Tensors, step: Tensors) -> Tensors:
        """The motions after them."""
        return (moved_by(theta[0], -step[0].unflatten(-1, (2, 6))),)


# ----------------------------------------------------------------------------------------------------------------------
# Robust estimation of two rigid motions: many starts from small samples, the best few annealed over all matches.


SAMPLE = {"straight": 7, "constant_velocity": 5}
"""Matches per moving sample, one or two above the minimum (6 and 3): at the minimum itself local minima abound."""
BITS = three_sigma(2) / 2
"""Cost, in units of 2 log likelihood, of one free coordinate: a match is an outlier (6 free ones) rather than a point on a
straight line (4) above the limit of chi-square with 2 degrees of freedom."""


@dataclass(frozen=True)
class Rigid:
    """What the search found, in the coordinates it was given."""

    motions: Tensor  # ``(b, 2, 4, 4)``
    sigma: Tensor  # ``(b,)`` noise of one coordinate
    information: Tensor  # ``(b, 12, 12)`` Gauss-Newton matrix of the matches that belong to the model, per unit of noise
    inliers: Tensor  # ``(b, n)`` bool
    still: Tensor  # ``(b, n)`` bool
    grounded: Tensor
    """``(b,)`` bool: whether static matches fix the common velocity (always, for straight lines)."""


def search(
    data: RigidSightings,
    sigma: Tensor | None,
    still: Tensor | None,
    starts: Tensor,
    generator: torch.Generator | None,
    floor: float = 1e-13,
    *,
    options: AlignOptions,
) -> Rigid:
    """The two rigid motions that most matches agree with.

    Args:
        data: ``(b, n, 3)`` matches of size about 1, centred.
        sigma: ``(b,)`` noise of one coordinate; None estimates it (least median of squares).
        still: ``(b, n)`` bool, matches known to be static.
        starts: ``(b, k, 2, 4, 4)`` motions to begin with, besides those of samples.
        generator: of the samples.
        floor: least noise that is believed.
    """
    b, n = data.weights.shape
    draws = uniform(b, NUM_STATIC_SAMPLES + NUM_MOVING_SAMPLES, n, generator=generator, device=data.x1.device)
    # matches of weight 0 come last, so that they are drawn only where there is nothing else
    order = (draws + 2.0 * (data.weights <= 0)[:, None]).argsort(-1)[..., : SAMPLE[data.motion]]
    flags = torch.zeros(b, n, dtype=torch.bool, device=data.x1.device) if still is None else still

    def run(data: RigidSightings, sigma: Tensor | None, held: Tensor, order: Tensor, given: Tensor) -> Rigid:
        return _search(each(lambda x: x[:, None], data), sigma, held, order, given, floor, options)

    return map_blocks(run, data, sigma, flags, order, starts, size=RIGID_BLOCK)


def _search(
    data: RigidSightings, sigma: Tensor | None, held: Tensor, order: Tensor, given: Tensor, floor: float, options: AlignOptions
) -> Rigid:
    """One block: sightings ``(b, 1, n, 3)``."""
    candidates = torch.cat([given, static_motions(data, data.weights), *_samples(data, order)], dim=1)
    moving, static = squares(candidates, data)
    noise = _scales(moving, data, floor) if sigma is None else sigma[:, None].expand(candidates.shape[:2]).clamp(min=floor)
    score = noise if sigma is None else _score(moving, static, held, data, noise)
    best = score.topk(min(NUM_REFINED_STARTS, score.shape[1]), dim=1, largest=False).indices
    # the given starts run as well: they rest on all matches, which no small sample does
    chosen = torch.cat([torch.arange(given.shape[1] + 1, device=best.device).expand(len(best), -1), best], dim=1)
    motions = candidates.gather(1, chosen[..., None, None, None].expand(-1, -1, 2, 4, 4))
    noise = noise.gather(1, chosen)
    noise = noise if sigma is not None else noise.amin(1, keepdim=True).expand_as(noise)
    resting = _descend_static(motions, noise, data)
    for stretch in (8.0, 3.0, 1.0):
        motions, _ = descend(motions, data, scale=noise * stretch * three_sigma(data.conditions) ** 0.5, iterations=12)
        noise = noise if sigma is not None else _scales(squares(motions, data)[0], data, floor)
    # one noise for all, or the worse motion would be forgiven more
    noise = noise if sigma is not None else noise.amin(1, keepdim=True).expand_as(noise)
    motions, noise = torch.cat([motions, resting], dim=1), noise.repeat(1, 2)
    winner = _score(*squares(motions, data), held, data, noise).argmin(1)
    first = torch.arange(len(winner), device=winner.device)
    flat = each(lambda x: x[:, 0], data)
    grounded = held.any(-1) if data.motion == "constant_velocity" else torch.ones_like(held[:, 0])
    found = _iterate_labels(motions[first, winner], flat, noise[first, winner], sigma is None, held, grounded, floor)
    if data.motion == "straight":
        return found
    common, members, present = *common_velocity(found, flat, options), (flat.weights > 0).sum(-1)
    standing = ~grounded & (members >= 3) & (members >= options.min_static_share * present)
    # in the gauge in which points of the common velocity stand still
    shift = torch.where(grounded[:, None], 0.0, common)[:, None] * common.new_tensor([[1.0], [2.0]])
    found = replace(found, motions=found.motions - pad(shift[..., None], (3, 0, 0, 1)))
    if not bool(standing.any()):
        return found
    return _iterate_labels(found.motions, flat, found.sigma, sigma is None, held, grounded | standing, floor)


def static_motions(data: RigidSightings, weights: Tensor) -> Tensor:
    """The motions ``(..., 2, 4, 4)`` that carry matches onto each other, as if none moved."""
    return torch.stack([rigid_alignment(data.x1, x, weights) for x in (data.x2, data.x3)], dim=-3)


def _descend_static(motions: Tensor, noise: Tensor, data: RigidSightings) -> Tensor:
    """Motions ``(b, k, 2, 4, 4)`` refined by what nearly stands still: as movers these would follow others along their lines."""
    still = squares(motions, data)[1] <= (ROUGH_LABEL_FACTOR * noise[..., None]).square() * three_sigma(6)
    return descend(motions, replace(data, weights=data.weights * still), still=still, iterations=12)[0]


def _samples(data: RigidSightings, order: Tensor) -> tuple[Tensor, Tensor]:
    """Motions from samples of 3 static matches, and of a few moving ones."""
    still, moving = data.sample(order[:, :NUM_STATIC_SAMPLES, :3]), data.sample(order[:, NUM_STATIC_SAMPLES:])
    return static_motions(still, still.weights), descend(static_motions(moving, moving.weights), moving, iterations=12)[0]


def _scales(moving: Tensor, data: RigidSightings, floor: float) -> Tensor:
    """Noise ``(b, k)`` from the median of squared residuals, less the parameters that these have absorbed."""
    present = data.weights > 0
    spare = (1 - 12 / (data.conditions * present.sum(-1)).clamp(min=13)).clamp(min=0.1)
    middle = torch.where(present, moving.nan_to_num(nan=torch.inf), torch.nan).nanmedian(-1).values.nan_to_num(nan=0.0, posinf=0.0)
    return (middle / (median(data.conditions) * spare)).sqrt().clamp(min=floor)


def _score(moving: Tensor, static: Tensor, held: Tensor, data: RigidSightings, sigma: Tensor) -> Tensor:
    """Description length ``(b, k)``: every match is static, moving or an outlier, whichever is cheapest."""
    square = sigma.square()[..., None]
    free = 6 - data.conditions
    cost = (moving / square + BITS * free).clamp(max=BITS * 6)
    # the common velocity is still open in the other model, so that nothing stands still yet
    resting = static / square if data.motion == "straight" else torch.full_like(cost, torch.inf)
    cost = torch.where(held[:, None], (static / square).clamp(max=BITS * 6), torch.minimum(cost, resting))
    # a motion against most of what is known to stand still is worse than any other
    against = contradicts(static / square < BITS * 6, held[:, None], data.weights)
    return ((cost + BITS * 6 * against[..., None]) * (data.weights > 0)).sum(-1)


def _iterate_labels(
    motions: Tensor,
    data: RigidSightings,
    sigma: Tensor,
    estimate: bool,
    held: Tensor,
    grounded: Tensor,
    floor: float,
) -> Rigid:
    """Least squares over the matches that belong to the model, static ones as such, until they do not change."""
    present = data.weights > 0
    for _ in range(NUM_RIGID_ROUNDS):
        moving, static = squares(motions, data)
        square = sigma.square()[:, None]
        resting = static <= three_sigma(6) * square
        still = resting & (held | grounded[:, None]) & present
        inliers = (still | (~held & (moving <= three_sigma(data.conditions) * square))) & present
        subset = replace(data, weights=data.weights * inliers)
        motions, _ = descend(motions, subset, still=still, iterations=15)
        if estimate:
            sigma = _noise(motions, subset, inliers, still, grounded, sigma).clamp(min=floor)
    _, information = normal_equations(motions, subset, subset.weights, still)
    return Rigid(motions, sigma, information, inliers, still, grounded)


def _noise(motions: Tensor, data: RigidSightings, inliers: Tensor, still: Tensor, grounded: Tensor, before: Tensor) -> Tensor:
    """Noise of one coordinate from the residuals of the inliers; as before where too few are left."""
    moving, static = squares(motions, data)
    total = torch.where(inliers, torch.where(still, static, moving), 0.0).sum(-1)
    conditions = torch.where(still, 6, data.conditions) * inliers
    spare = conditions.sum(-1) - torch.where(grounded, 12, 9)
    return torch.where(spare >= 4, (total / spare.clamp(min=1)).sqrt(), before)


def common_velocity(found: Rigid, data: RigidSightings, options: AlignOptions) -> tuple[Tensor, Tensor]:
    """The velocity ``(b, 3)`` that most matches share, in the frame of view 1 and per step, and how many do, ``(b,)``."""
    u, v, _, _ = combinations(found.motions, data)
    velocity = -u / 2**0.5
    step = max(1, velocity.shape[-2] // NUM_RIGID_VELOCITY_CANDIDATES)
    # of a static point |u|^2 + |v|^2 is within the limit, with u counted from the common velocity
    room = (three_sigma(6) * found.sigma.square()[:, None] - v.square().sum(-1)).clamp(min=0.0) / 2
    near = (torch.cdist(velocity[:, ::step], velocity).square() <= 2 * room[:, None]) & found.inliers[:, None]
    best = (near.sum(-1) * found.inliers[:, ::step]).argmax(-1)
    members = near[torch.arange(len(best), device=best.device), best]
    mean = _mean(velocity, members)
    members = ((velocity - mean[:, None]).square().sum(-1) <= room) & found.inliers
    count = members.sum(-1)
    enough = (count >= 3) & (count >= options.min_static_share * found.inliers.sum(-1))
    return _mean(velocity, torch.where(enough[:, None], members, found.inliers)), count


def _mean(x: Tensor, members: Tensor) -> Tensor:
    return torch.where(members[..., None], x, 0.0).sum(-2) / members.sum(-1, keepdim=True).clamp(min=1)


MINIMAL = {"straight": 6, "constant_velocity": 3}
"""Moving matches for the 12 (9) degrees of freedom, at 2 (3) conditions each; static ones give 6."""

AMBIGUITY = {
    "straight": (
        "A and B are unique with their scale, unless all points keep one ratio of their two steps (constant velocity): then the "
        "translations are known up to a velocity common to all points."
    ),
    "constant_velocity": (
        "A velocity common to all points cannot be told from a motion of the sensor: the largest group of matches of one velocity "
        "(at least 3 and a tenth of all) is taken as static; without it the mean velocity is taken as zero."
    ),
}


def align_rigid(
    data: Matches, threshold: float | None, motion: str, generator: torch.Generator | None, options: AlignOptions
) -> Alignment:
    """:func:`dyntorch.align_points` with ``model="rigid"``, for checked matches."""
    weights = data.weights / data.weights.amax(-1, keepdim=True).clamp(min=torch.finfo(torch.float64).tiny)
    centres, scale = _frame(data.views, weights)
    x1, x2, x3 = ((x - c[:, None]) * scale[:, None, None] for x, c in zip(data.views, centres, strict=True))
    sightings = RigidSightings(x1, x2, x3, weights, motion)
    sigma = None if threshold is None else threshold / THRESHOLD_SIGMAS * scale
    none = x1.new_zeros(len(x1), 0, 2, 4, 4)
    starts = none if data.static is None else _from_static(sightings, data.static & (weights > 0))
    found = search(sightings, sigma, data.static, starts, generator, floor=100 * torch.finfo(data.dtype).eps, options=options)
    rival = _other_background(data, sightings, found, generator, options)
    return _result(data, sightings, found, rival, centres, scale, options)


def _other_background(
    data: Matches, sightings: RigidSightings, found: Rigid, generator: torch.Generator | None, options: AlignOptions
) -> Tensor:
    """Matches ``(b,)`` that move, and stand still by a rival motion that explains the matches as well; 0 where there is none."""
    labels = _labels(sightings, found)
    moving = (labels == MOVING) & ((labels == MOVING).sum(-1) >= MIN_STATIC_SUPPORT)[:, None]
    if not bool(moving.any()):
        return torch.zeros_like(moving[:, 0], dtype=torch.long)
    movers = replace(sightings, weights=sightings.weights * moving)
    none = found.motions.new_zeros(len(moving), 0, 2, 4, 4)
    # as if the movers were known to stand still: those that do so by one motion
    rival = search(movers, found.sigma, moving, none, generator, options=options)
    path, still = squares(rival.motions, sightings)
    square = found.sigma.square()[:, None]
    rests, moves = still <= three_sigma(6) * square, path <= three_sigma(sightings.conditions) * square
    return count_rival_static(labels, labels_of(rests, moves, data), data, options.min_static_share)


def _frame(views: tuple[Tensor, ...], weights: Tensor) -> tuple[list[Tensor], Tensor]:
    """Medians of each view ``(b, 3)``, and one scale ``(b,)`` for all views that makes their spread about 1."""
    hidden = torch.where(weights[..., None] > 0, torch.stack(views), torch.nan)
    centres = hidden.nanmedian(dim=-2, keepdim=True).values.nan_to_num()
    spread = (hidden - centres).abs().amax(-1).nanmedian(dim=-1).values.nan_to_num().amax(0)
    return list(centres[..., 0, :]), torch.where(spread > 0, 1 / torch.where(spread > 0, spread, 1.0), 1.0)


def _from_static(data: RigidSightings, known: Tensor) -> Tensor:
    """``(b, 1, 2, 4, 4)`` motions of the labelled static matches, of all where there are fewer than three."""
    return static_motions(data, torch.where((known.sum(-1) >= 3)[:, None], data.weights * known, data.weights))[:, None]


def _result(
    data: Matches,
    sightings: RigidSightings,
    found: Rigid,
    rival: Tensor,
    centres: list[Tensor],
    scale: Tensor,
    options: AlignOptions,
) -> Alignment:
    motion = sightings.motion
    labels = _labels(sightings, found)
    dof = torch.where(found.grounded, 12, 9)
    values, root = _root_of_inverse(found.information, dof)
    worst = found.sigma * values.clamp(min=torch.finfo(values.dtype).tiny).rsqrt()
    top = found.information.diagonal(dim1=-2, dim2=-1).amax(-1)
    noisy = found.sigma.isfinite() & (found.sigma > NOISY)
    accident = noisy | agrees_too_little(labels, sightings.weights, (6, MOTIONS[motion]), dof + MIN_SPARE_RIGID)
    undetermined, few = (values <= RIGID_INFORMATION_RATIO * top) & ~accident, (sightings.weights > 0).sum(-1) < 3
    status = status_of_alignment(worst > MAX_RIGID_DEVIATION, accident, undetermined, few)
    rival = torch.where(status == Status.OK, rival, 0)
    status = torch.where(rival > 0, int(Status.AMBIGUOUS), status)
    none = is_failure(status)
    labels = torch.where(none[:, None], OUTLIER, labels)
    matrices, entries = _to_point_units(found.motions, root * found.sigma[:, None, None], centres, scale)
    # a noise beyond the range of the numbers is not known, and nor is the covariance
    known = found.sigma.isfinite() & entries.isfinite().flatten(1).all(-1)
    entries = torch.where(known[:, None, None], entries, torch.inf)
    velocities = None
    if motion == "constant_velocity":
        u, _, _, _ = combinations(found.motions, sightings)
        velocities = -u / 2**0.5 / scale[:, None, None]
    return alignment_of(
        data,
        status,
        matrices.unbind(1),
        labels,
        found.sigma / scale,
        entries,
        ambiguity=AMBIGUITY[motion],
        notices=_notices(labels, worst, found.grounded, rival, none, motion, data.batch, options),
        velocities=velocities,
    )


def _labels(data: RigidSightings, found: Rigid) -> Tensor:
    moving, static = squares(found.motions, data)
    square = found.sigma.square()[:, None]
    still = found.still & (static <= three_sigma(6) * square)
    path = found.inliers & (moving <= three_sigma(data.conditions) * square)
    return torch.where(still, STATIC, torch.where(path, MOVING, OUTLIER))


def _root_of_inverse(information: Tensor, dof: Tensor) -> tuple[Tensor, Tensor]:
    """Least eigenvalue ``(b,)`` of the degrees of freedom, and R ``(b, 12, 12)``, R R^T the pseudo-inverse on them."""
    values, vectors = spectrum(torch.where(information.isfinite().flatten(1).all(-1)[:, None, None], information, 0.0))
    used = torch.arange(12, device=dof.device) >= 12 - dof[:, None]
    floor = 1e-14 * values[:, -1:].clamp(min=torch.finfo(values.dtype).tiny)
    root = vectors * torch.where(used, values.clamp(min=floor).rsqrt(), 0.0)[:, None]
    return values.gather(-1, 12 - dof[:, None])[:, 0], root


def _to_point_units(motions: Tensor, root: Tensor, centres: list[Tensor], scale: Tensor) -> tuple[Tensor, Tensor]:
    """Motions ``(b, 2, 4, 4)`` in the unit of the points, and the covariance ``(b, 32, 32)`` of their entries, by a root
    ``(b, 12, 12)`` of that of the tangents."""
    first, *others = centres
    result = motions.clone()
    back = torch.stack(others, dim=1)
    result[..., :3, 3] = motions[..., :3, 3] / scale[:, None, None] + first[:, None]
    result[..., :3, 3] -= (motions[..., :3, :3] @ back[..., None])[..., 0]
    # a tangent turns and shifts about the centre of view 1, in normalized size
    turned, shifted = root.mT.unflatten(-1, (2, 2, 3)).unbind(-2)
    tangents = pad(torch.cat([skew(turned), shifted[..., None]], dim=-1), (0, 0, 0, 1))  # (b, 12, 2, 4, 4)
    outward, inward = similarity(1 / scale, -first * scale[:, None]), similarity(scale, first)
    moved = (outward[:, None, None] @ tangents @ inward[:, None, None] @ result[:, None]).flatten(2)
    return result, moved.mT @ moved


def _notices(
    labels: Tensor, worst: Tensor, grounded: Tensor, rival: Tensor, none: Tensor, motion: str, batch: tuple[int, ...],
    options: AlignOptions,
) -> tuple[Notice, ...]:  # fmt: skip
    moving, solved = (labels == MOVING).sum(-1), ~none
    found, note = noting(batch)
    note(AlignNotice.OTHER_BACKGROUND, rival, rival > 0, still=(labels == STATIC).sum(-1))
    note(AlignNotice.UNCERTAIN, worst, solved & (worst > options.max_deviation), case="rigid")
    note(AlignNotice.COMMON_VELOCITY, worst, solved & ~grounded)
    few = solved & (moving < MINIMAL[motion]) & ((labels == STATIC).sum(-1) < 3)
    note(AlignNotice.FEW_MOVING, moving, few, least=f"{MINIMAL[motion]}")
    return in_order(found)
