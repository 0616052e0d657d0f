"""Motions of a sensor, projective or affine, among points at constant velocity."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyntorch.core.fit import fit_matches
from dyntorch.core.limits import MIN_INFORMATION, median, three_sigma
from dyntorch.core.matches import Matches
from dyntorch.core.normalize import denormalize_motion, normalize_motion
from dyntorch.core.outcome import Notice, Status, in_order, is_failure, noting
from dyntorch.core.refine import Problem
from dyntorch.core.residual import residual_derivative
from dyntorch.core.robust import robust_fit
from dyntorch.core.solution import NOISY
from dyntorch.geometry.homogeneous import apply, unit
from dyntorch.invariants.constant_velocity_tensor import ConstantVelocityTensor, resting_residual
from dyntorch.numerics.blocks import map_blocks, uniform
from dyntorch.numerics.least_squares import LeastSquaresOptions, derivatives, minimize
from dyntorch.numerics.nullspace import spectrum
from dyntorch.tasks.align.labelling import ROUGH_LABEL_FACTOR, Evidence
from dyntorch.tasks.align.result import (
    MOVING,
    OUTLIER,
    STATIC,
    Alignment,
    AlignNotice,
    AlignOptions,
    agrees_too_little,
    alignment_of,
    labels_of,
    status_of_alignment,
)

# ----------------------------------------------------------------------------------------------------------------------
# Points at constant velocity before projective or affine sensors: refinement, the static gauge, labels, the sensor's motion.


DESCENT = LeastSquaresOptions(iterations=15, stuck_damping=1e5, tolerance=1e-10)
GAUGE = 3  # degrees of freedom of the common velocity
DOF = {False: 30, True: 21}
"""Of three projective (affine) maps up to an affinity of the world and the common velocity."""
ENTRIES = (12, 13, 14)  # of a 4 x 4 matrix: zero for an affine map


NUM_VELOCITY_ROUNDS = 4  # of labelling and least squares
NUM_VELOCITY_CANDIDATES = 64  # tried as the common one: of 10 % static matches six or seven are among them
NUM_AFFINE_SAMPLES = 150  # 40 % outliers leave 1.7 % of samples of eight clean, 92 % to draw one
AFFINE_SAMPLE_SIZE = 8  # one above the minimum
MAX_DEGENERATE_EIGENVALUE = 1e-9  # over the largest: 3e-5 of the size of the data, far below any real noise
MAX_VELOCITY_DEVIATION = 0.5  # of the worst direction of maps of norm 1, above which they are not known at all
MIN_SPARE_VELOCITY = 6  # conditions beyond the degrees of freedom that inliers must fulfil
VELOCITY_BLOCK = 8  # problems of a batch that are sampled together
MIN_VELOCITY_SINGULAR_VALUE = 3.0  # over the noise, to count


@dataclass(frozen=True)
class Velocities:
    """Maps, labels and noise of a flat batch."""

    theta: Tensor  # ``(b, 48)`` the three maps in normalized coordinates
    labels: Tensor  # ``(b, n)``
    sigma: Tensor  # ``(b,)`` in the unit of the matches
    grounded: Tensor  # ``(b,)`` bool, whether static matches fix the common velocity


class VelocityProblem(Problem):
    """The least squares of the maps."""

    def subset(self, keep: Tensor) -> VelocityProblem:
        """Only some of the problems."""
        return VelocityProblem(**vars(super().subset(keep)))

    def linearize_static(self, theta: Tensor, views: tuple[Tensor, ...], free: int = 1) -> tuple[Tensor, Tensor]:
        """By way of the inverses, which all matches share, as of those that move."""
        maps, slope = ConstantVelocityTensor._inverses(self.parts(theta))
        value, derivative = residual_derivative(resting_residual, maps, views, self.scales)
        return value, slope @ derivative


def _problem(evidence: Evidence, labels: Tensor) -> VelocityProblem:
    return VelocityProblem(**vars(evidence.problem(labels)))


def refine_maps(evidence: Evidence, theta: Tensor, labels: Tensor, affine: bool) -> Tensor:
    """The maps ``(b, 48)`` that minimize the residuals of the labelled matches, by Levenberg-Marquardt; affine maps stay affine."""
    problem = replace(_problem(evidence, labels), free=_free(theta, affine))
    if not bool((labels == STATIC).any()):
        problem = replace(problem, static=None)  # half of the work
    return minimize(problem, problem.evaluate((theta,)), DESCENT).theta[0]


def settle(evidence: Evidence, theta: Tensor, sigma: Tensor, affine: bool, estimate: bool, options: AlignOptions) -> Velocities:
    """Label and refine in turns: first without a gauge, then with the static matches, if there are such. theta ``(b, 48)``,
    sigma ``(b,)``."""
    known = evidence.data.static
    grounded = torch.zeros_like(sigma, dtype=torch.bool) if known is None else (known & (evidence.data.weights > 0)).any(-1)
    if known is not None:
        theta = _fix_gauge(evidence, theta, known & (evidence.data.weights > 0))
    state = _label_and_fit(
        evidence, Velocities(theta, _labels(evidence, theta, sigma, grounded), sigma, grounded), affine, estimate
    )
    theta, standing = _find_background(evidence, state, options)
    standing = standing & ~grounded
    state = replace(state, theta=theta)
    if not bool(standing.any()):
        return state
    grounded = grounded | standing
    labels = _labels(evidence, theta, state.sigma, grounded)
    return _label_and_fit(evidence, Velocities(theta, labels, state.sigma, grounded), affine, estimate)


def information(evidence: Evidence, state: Velocities, affine: bool) -> tuple[Tensor, Tensor, Tensor]:
    """What the inliers tell about the sensor."""
    _, _, matrix = _problem(evidence, state.labels).normal_equations(state.theta)
    free = _free(state.theta, affine)
    values, vectors = spectrum(matrix * free * free[:, None])
    dof = DOF[affine] + GAUGE * state.grounded.long()
    used = torch.arange(48, device=dof.device) >= 48 - dof[:, None]
    least = values.gather(-1, 48 - dof[:, None])[:, 0]
    floor = 1e-12 * values[:, -1:].clamp(min=torch.finfo(values.dtype).tiny)
    root = vectors * torch.where(used, values.clamp(min=floor).rsqrt(), 0.0)[:, None]
    motions, spread = derivatives(lambda t: _between(evidence, t).flatten(-3), state.theta, root.movedim(-1, 0))
    return torch.stack([least, values[:, -1]], dim=-1), motions.unflatten(-1, (2, 4, 4)), spread.mT @ spread


def world_velocities(evidence: Evidence, theta: Tensor) -> Tensor:
    r"""Velocity ``(b, n, 3)`` of each match as sensor 1 would see its next step, :math:`\pi(A_0 (y + v)) - \pi(A_0 y)`."""
    motion = _maps(evidence, theta)
    y = ConstantVelocityTensor.positions(motion, *evidence.views)
    v = (y[..., 2, :] - y[..., 0, :]) / 2
    start = y.mean(-2) - v
    return (apply(motion[0], start + v) - apply(motion[0], start)) / evidence.norm.scales[0][:, None, None]


def residuals(evidence: Evidence, theta: Tensor) -> tuple[Tensor, Tensor]:
    """Squared residuals ``(b, n)`` of each match as a moving point and as a static one, in the unit of the matches."""
    model, motion, scales = ConstantVelocityTensor(), _maps(evidence, theta), evidence.norm.scales
    moving = model.whitened_residual(motion, evidence.views, scales).square().sum(-1)
    return moving, model.whitened_static_residual(motion, evidence.views, scales).square().sum(-1)


def _label_and_fit(evidence: Evidence, state: Velocities, affine: bool, estimate: bool) -> Velocities:
    theta, labels, sigma = state.theta, state.labels, state.sigma
    for _ in range(NUM_VELOCITY_ROUNDS):
        theta = refine_maps(evidence, theta, labels, affine)
        if estimate:
            sigma = _noise(evidence, theta, labels, sigma, DOF[affine] + GAUGE * state.grounded.long())
        new = _labels(evidence, theta, sigma, state.grounded)
        if bool((new == labels).all()):
            break
        labels = new
    return Velocities(theta, labels, sigma, state.grounded)


def _labels(evidence: Evidence, theta: Tensor, sigma: Tensor, grounded: Tensor) -> Tensor:
    moving, resting = residuals(evidence, theta)
    variance = sigma.square()[:, None]
    still = (resting <= three_sigma(6) * variance) & grounded[:, None]
    return labels_of(still, moving <= three_sigma(3) * variance, evidence.data)


def _noise(evidence: Evidence, theta: Tensor, labels: Tensor, before: Tensor, dof: Tensor) -> Tensor:
    moving, resting = residuals(evidence, theta)
    square = torch.where(labels == STATIC, resting, moving)
    spare = (6 * (labels == STATIC) + 3 * (labels == MOVING)).sum(-1) - dof
    shown = (torch.where(labels == OUTLIER, 0.0, square).sum(-1) / spare.clamp(min=1)).sqrt()
    return torch.where(spare >= 6, shown, before).maximum(evidence.floor)


def _find_background(evidence: Evidence, state: Velocities, options: AlignOptions) -> tuple[Tensor, Tensor]:
    """Maps in the gauge in which the most matches stand still, and where these are enough; else the mean velocity is 0."""
    inliers = state.labels != OUTLIER
    limit = three_sigma(6) * state.sigma.square()[:, None]
    n = inliers.shape[-1]
    chosen = torch.arange(0, n, max(1, -(-n // NUM_VELOCITY_CANDIDATES)), device=inliers.device)
    motion, views = _maps(evidence, state.theta), evidence.views
    several = tuple(m[:, None].expand(-1, len(chosen), -1, -1) for m in motion)
    one = tuple(x[:, chosen, None] for x in views)
    tried = ConstantVelocityTensor.fix_gauge((several[0], several[1], several[2]), *one)
    scales = tuple(s[:, None] for s in evidence.norm.scales)
    resting = ConstantVelocityTensor().whitened_static_residual(tried, tuple(x[:, None] for x in views), scales).square().sum(-1)
    # the noise of the one match that chose the velocity is in these residuals, too
    near = (resting <= ROUGH_LABEL_FACTOR**2 * limit[:, None]) & inliers[:, None]
    best = (near.sum(-1) * inliers[:, chosen]).argmax(-1)
    members = near[torch.arange(len(best), device=best.device), best]
    theta = _fix_gauge(evidence, state.theta, members)
    members = (residuals(evidence, theta)[1] <= limit) & inliers
    count = members.sum(-1)
    enough = (count >= 3) & (count >= options.min_static_share * inliers.sum(-1))
    free = torch.where(state.grounded[:, None], False, torch.where(enough[:, None], members, inliers))
    return _fix_gauge(evidence, state.theta, free), enough


def _fix_gauge(evidence: Evidence, theta: Tensor, members: Tensor) -> Tensor:
    x1, x2, x3 = evidence.views
    motion = ConstantVelocityTensor.fix_gauge(_maps(evidence, theta), x1, x2, x3, weights=members.to(theta))
    return torch.cat([part.flatten(1) for part in motion], dim=-1)


def _maps(evidence: Evidence, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    first, second, third = theta.unflatten(-1, (3, 4, 4)).unbind(-3)
    return first, second, third


def _between(evidence: Evidence, theta: Tensor) -> Tensor:
    """A and B ``(b, 2, 4, 4)`` in the coordinates of the matches, of norm 1."""
    first, second, third = denormalize_motion(evidence.invariant, _maps(evidence, theta), evidence.norm.transforms)
    return torch.stack([unit(first @ torch.linalg.inv_ex(other)[0]) for other in (second, third)], dim=-3)


def _free(theta: Tensor, affine: bool) -> Tensor:
    """``(48,)``, 0 for the entries that affine maps do not vary."""
    free = torch.ones_like(theta[0]) if len(theta) else theta.new_ones(48)
    if affine:
        free[[16 * part + entry for part in range(3) for entry in ENTRIES]] = 0.0
    return free


MINIMAL = {False: 21, True: 7}
RANKS = ((36, AlignNotice.EQUAL_VELOCITIES), (49, AlignNotice.LINEAR_VELOCITIES), (58, AlignNotice.PLANAR_VELOCITIES))
"""Ranks of the estimation matrix for degenerate velocities (of 63)."""

AMBIGUITY = (
    "A velocity common to all points cannot be told from a motion of the sensor: the largest group of matches of one velocity (at "
    "least 3 and a tenth of all) is taken as static; without it the mean velocity is taken as zero, in a world that is known up to "
    "an affinity. A and B are known up to scale."
)


def align_velocity(
    data: Matches, threshold: float | None, affine: bool, generator: torch.Generator | None, options: AlignOptions
) -> Alignment:
    """:func:`dyntorch.align_points` with a model of constant velocity, for checked matches."""
    evidence = Evidence.of(ConstantVelocityTensor(), data)
    given = evidence.given_noise(threshold)
    start = (
        _affine_start(evidence, given, generator, options) if affine else _projective_start(evidence, given, threshold, generator)
    )
    theta, sigma, found = start
    state = settle(evidence, theta, sigma, affine, given is None, options)
    extent, motions, covariance = information(evidence, state, affine)
    covariance = covariance * state.sigma.square()[:, None, None]
    # singular maps have no motion between them to be known
    covariance = torch.where(covariance.isfinite().flatten(1).all(-1)[:, None, None], covariance, torch.inf)
    worst = state.sigma * extent[:, 0].clamp(min=torch.finfo(theta.dtype).tiny).rsqrt()
    present = (data.weights > 0).sum(-1)
    least = DOF[affine] + GAUGE * state.grounded.long() + MIN_SPARE_VELOCITY * (present > MINIMAL[affine] + 1)
    accident = agrees_too_little(state.labels, data.weights, (6, 3), least)
    accident = accident | (state.sigma * torch.stack(evidence.norm.scales).amax(0) > NOISY)
    undetermined, few = (extent[:, 0] <= MIN_INFORMATION * extent[:, 1]) & ~accident, present < MINIMAL[affine]
    status = status_of_alignment(worst > MAX_VELOCITY_DEVIATION, accident, undetermined, few)
    status = torch.where((found != Status.OK) & ~few, found.to(status), status)
    none = is_failure(status)
    return alignment_of(
        data,
        status,
        motions.unbind(1),
        state.labels,
        state.sigma,
        covariance,
        ambiguity=AMBIGUITY,
        notices=_notices(evidence, state, worst, none, affine, data.batch, options),
        velocities=world_velocities(evidence, state.theta),
    )


def _projective_start(
    evidence: Evidence, given: Tensor | None, threshold: float | None, generator: torch.Generator | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Maps ``(b, 48)`` of the tensor by robust estimation, the noise, and the status of those that failed."""
    data = evidence.data
    found = robust_fit(ConstantVelocityTensor(), *data.views, threshold=threshold, weights=data.weights, generator=generator)
    parts = normalize_motion(evidence.invariant, [part.reshape(-1, 4, 4) for part in found.motion], evidence.norm.transforms)
    theta = torch.cat([part.flatten(1) for part in parts], dim=-1)
    usable = theta.isfinite().all(-1) & ~is_failure(found.status)
    theta = torch.where(usable[:, None], theta, torch.eye(4).to(theta).flatten().repeat(3) / 2)
    return theta, _starting_noise(evidence, theta, given), torch.where(usable, int(Status.OK), found.status)


def _affine_start(
    evidence: Evidence, given: Tensor | None, generator: torch.Generator | None, options: AlignOptions
) -> tuple[Tensor, Tensor, Tensor]:
    """The same for affine maps: the consensus of small samples in the 9 coordinates of a match, which lie in a space of 6."""
    data = evidence.data
    # the normalization may stretch the views differently; a common one leaves the noise alike in all nine coordinates
    scale = torch.stack(evidence.norm.scales)
    nine = torch.cat([x / s[:, None, None] for x, s in zip(evidence.views, scale / scale.mean(0), strict=True)], dim=-1)
    size = scale.mean(0)
    present = data.weights > 0
    draws = uniform(len(nine), options.num_samples or NUM_AFFINE_SAMPLES, nine.shape[1], generator=generator, device=nine.device)
    order = (draws + 2.0 * ~present[:, None]).argsort(-1)[..., :AFFINE_SAMPLE_SIZE]
    noise = None if given is None else given * size

    null, mean, ok = map_blocks(_affine_consensus, nine, data.weights, order, noise, size=VELOCITY_BLOCK)
    theta = _affine_maps(null, mean, ok)
    parts = theta.unflatten(-1, (3, 4, 4)).clone()
    parts[..., :3, :] *= (scale / size).mT[..., None, None]
    theta = (parts.flatten(-2) / parts.flatten(-2).norm(dim=-1, keepdim=True)).flatten(1)
    status = torch.where(ok, int(Status.OK), int(Status.DEGENERATE))
    return theta, _starting_noise(evidence, theta, given), status


def _affine_consensus(points: Tensor, weights: Tensor, index: Tensor, sigma: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Conditions ``(b, 3, 9)`` on the centred coordinates, their centre ``(b, 9)``, and whether the matches decide."""
    present = weights > 0
    sample = points[:, None].expand(-1, index.shape[1], -1, -1).gather(2, index[..., None].expand(-1, -1, -1, 9))
    null, mean, _ = _conditions(sample, torch.ones_like(sample[..., 0]))
    # the last start is of all matches, which is the best one where there are no outliers
    own, centre, _ = _conditions(points, weights)
    null, mean = torch.cat([null, own[:, None]], dim=1), torch.cat([mean, centre[:, None]], dim=1)
    square = ((points[:, None] - mean[:, :, None]) @ null.mT).square().sum(-1)
    if sigma is None:
        score = torch.where(present[:, None], square, torch.nan).nanmedian(-1).values
        spare = (1 - DOF[True] / (3 * present.sum(-1)).clamp(min=22)).clamp(min=0.1)
        limit = three_sigma(3) * score.amin(-1) / (median(3) * spare)
    else:
        limit = three_sigma(3) * sigma.square()
        score = (square.minimum(limit[:, None, None]) * present[:, None]).sum(-1)
    best = score.argmin(-1)
    first = torch.arange(len(best), device=best.device)
    # as much again for the noise of the sample
    inside = (square[first, best] <= 4 * limit[:, None]) & present
    floor = torch.finfo(points.dtype).eps
    inside = inside | ((square[first, best] <= floor) & present)
    return _conditions(points, weights * inside)


def _conditions(points: Tensor, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    total = weights.sum(-1, keepdim=True).clamp(min=torch.finfo(weights.dtype).tiny)
    mean = (weights[..., None] * points).sum(-2) / total
    centred = (points - mean[..., None, :]) * weights.sqrt()[..., None]
    values, vectors = spectrum(centred.mT @ centred)
    ok = (values[..., 3] > MAX_DEGENERATE_EIGENVALUE * values[..., 8]) & ((weights > 0).sum(-1) >= MINIMAL[True])
    return vectors[..., :3].mT, mean, ok


def _affine_maps(null: Tensor, mean: Tensor, ok: Tensor) -> Tensor:
    """Maps ``(b, 48)`` with N (L_0, L_1, L_2) v = 0 for all moving points: (N_0, N_1, N_2) = G (L_0^-1, -2 L_1^-1, L_2^-1)."""
    blocks = null.unflatten(-1, (3, 3)).movedim(-2, -3) * torch.tensor([1.0, -0.5, 1.0]).to(null)[:, None, None]
    eye = torch.eye(3, dtype=null.dtype, device=null.device)
    linear, _ = torch.linalg.inv_ex(torch.where(ok[:, None, None, None], blocks, eye))
    linear = torch.where(linear.isfinite(), linear, 0.0)
    upper = torch.cat([linear / linear.flatten(1).norm(dim=-1)[:, None, None, None], mean.unflatten(-1, (3, 3))[..., None]], dim=-1)
    last = torch.eye(4, dtype=null.dtype, device=null.device)[3:].expand(len(null), 3, 1, 4)
    return torch.cat([upper, last], dim=-2).flatten(1)


def _starting_noise(evidence: Evidence, theta: Tensor, given: Tensor | None) -> Tensor:
    if given is not None:
        return given
    moving, _ = residuals(evidence, theta)
    middle = torch.where(evidence.data.weights > 0, moving, torch.nan).nanmedian(dim=-1).values.nan_to_num()
    return (middle / median(3)).sqrt().maximum(evidence.floor)


def _notices(
    evidence: Evidence, state: Velocities, worst: Tensor, none: Tensor, affine: bool, batch: tuple[int, ...], options: AlignOptions
) -> tuple[Notice, ...]:
    found, note = noting(batch)
    enough = (evidence.data.weights > 0).sum(-1) >= MINIMAL[affine]
    if evidence.data.count >= MINIMAL[False]:
        rank = _rank(evidence, state, none)
        least = 0
        for most, code in RANKS:
            note(code, rank, enough & (rank > least) & (rank <= most), most=most)
            least = most
    note(AlignNotice.COMMON_VELOCITY, worst, ~none & ~state.grounded)
    note(AlignNotice.UNCERTAIN, worst, ~none & (worst > options.max_deviation), case="matches", what="maps")
    return in_order(found)


def _rank(evidence: Evidence, state: Velocities, none: Tensor) -> Tensor:
    """Singular values ``(b,)`` of the estimation matrix of the inliers (of all matches where there is no motion) above noise."""
    inliers = torch.where(none[:, None], torch.ones_like(state.labels, dtype=torch.bool), state.labels != OUTLIER)
    kept = evidence.data.restrict(inliers)
    values = fit_matches(ConstantVelocityTensor(), kept).singular_values
    noise = state.sigma * torch.stack(evidence.norm.scales).mean(0) * kept.weights.square().sum(-1).sqrt()
    return (values > torch.maximum(MIN_VELOCITY_SINGULAR_VALUE * noise[:, None], 1e-9 * values[:, :1])).sum(-1)
