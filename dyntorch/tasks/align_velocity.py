"""Motions of a sensor, projective or affine, among points at constant velocity."""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.blocks import map_blocks
from dyntorch.chi_square import median, three_sigma
from dyntorch.eigenspace import spectrum
from dyntorch.fitting import fit_matches
from dyntorch.invariants.constant_velocity_tensor import ConstantVelocityTensor
from dyntorch.matches import Matches
from dyntorch.robust import robust_fit
from dyntorch.sampling import uniform
from dyntorch.solution import NOISY, Status, failed
from dyntorch.tasks.alignment import OUTLIER, STATIC, Alignment
from dyntorch.tasks.labelling import SIGMAS, Evidence
from dyntorch.tasks.notices import Notice, NoticeCode, notices
from dyntorch.tasks.velocity_model import DOF, GAUGE, Velocities, information, residuals, settle, world_velocities

MINIMAL = {False: 21, True: 7}
SAMPLES, SAMPLE = 150, 8
"""Affine samples, one match above the minimum: 40 % outliers leave 1.7 % of such samples clean, 92 % to draw one."""
HELD = 1e-9  # eigenvalue over the largest: 3e-5 of the size of the data, far below any real noise
INDETERMINATE = 1e-13  # information on the worst direction over that on the best: rounding error below it
AMBIGUOUS, UNCERTAIN = 0.5, 0.05
"""Standard deviation of the worst direction of the maps, of norm 1, above which they are not known at all; or hardly."""
CONSENSUS, SPARE = 0.4, 6
PROBLEMS = 8
RANKS = ((36, NoticeCode.EQUAL_VELOCITIES), (49, NoticeCode.LINEAR_VELOCITIES), (58, NoticeCode.PLANAR_VELOCITIES))
"""Ranks of the estimation matrix for degenerate velocities (of 63)."""
ABOVE = 3.0  # a singular value counts from so many times the noise on

AMBIGUITY = (
    "A velocity common to all points cannot be told from a motion of the sensor: the largest group of matches of one velocity (at "
    "least 3 and a tenth of all) is taken as static; without it the mean velocity is taken as zero, in a world that is known up to "
    "an affinity. A and B are known up to scale."
)


def align_velocity(data: Matches, threshold: float | None, affine: bool, generator: torch.Generator | None) -> Alignment:
    """:func:`dyntorch.align_points` with a model of constant velocity, for checked matches."""
    evidence = Evidence.of(ConstantVelocityTensor(), data)
    given = None if threshold is None else torch.full_like(evidence.floor, threshold / SIGMAS).maximum(evidence.floor)
    start = _affine_start(evidence, given, generator) if affine else _projective_start(evidence, given, threshold, generator)
    theta, sigma, found = start
    state = settle(evidence, theta, sigma, affine, given is None)
    extent, motions, covariance = information(evidence, state, affine)
    covariance = covariance * state.sigma.square()[:, None, None]
    # singular maps have no motion between them to be known
    covariance = torch.where(covariance.isfinite().flatten(1).all(-1)[:, None, None], covariance, torch.inf)
    worst = state.sigma * extent[:, 0].clamp(min=torch.finfo(theta.dtype).tiny).rsqrt()
    status = _status(evidence, state, worst, extent[:, 0] <= INDETERMINATE * extent[:, 1], found, affine)
    none = failed(status)
    labels = torch.where(none[:, None], OUTLIER, state.labels)
    zero = none[:, None, None]
    velocities = world_velocities(evidence, state.theta)
    velocities = torch.where((labels == OUTLIER)[..., None], 0.0, velocities)
    return Alignment(
        A=data.back(torch.where(zero, 0.0, motions[:, 0])),
        B=data.back(torch.where(zero, 0.0, motions[:, 1])),
        labels=data.back(labels),
        status=data.back(status),
        sigma=data.back(torch.where(none, 0.0, state.sigma)),
        covariance=data.back(torch.where(zero, 0.0, covariance)),
        ambiguity=AMBIGUITY,
        warnings=_notices(evidence, state, worst, none, affine, data.batch),
        velocities=data.back(velocities),
    )


def _projective_start(
    evidence: Evidence, given: Tensor | None, threshold: float | None, generator: torch.Generator | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Maps ``(b, 48)`` of the tensor by robust estimation, the noise, and the status of those that failed."""
    data = evidence.data
    found = robust_fit(ConstantVelocityTensor(), *data.views, threshold=threshold, weights=data.weights, generator=generator)
    theta = evidence.parameters(tuple(part.reshape(-1, 4, 4) for part in found.motion))
    usable = theta.isfinite().all(-1) & ~failed(found.status)
    theta = torch.where(usable[:, None], theta, _identity(theta))
    return theta, _starting_noise(evidence, theta, given), torch.where(usable, int(Status.OK), found.status)


def _affine_start(evidence: Evidence, given: Tensor | None, generator: torch.Generator | None) -> tuple[Tensor, Tensor, Tensor]:
    """The same for affine maps: the consensus of small samples in the 9 coordinates of a match, which lie in a space of 6."""
    data = evidence.data
    # the normalization may stretch the views differently; a common one leaves the noise alike in all nine coordinates
    scale = torch.stack(evidence.norm.scales)
    nine = torch.cat([x / s[:, None, None] for x, s in zip(evidence.views, scale / scale.mean(0), strict=True)], dim=-1)
    size = scale.mean(0)
    present = data.weights > 0
    draws = uniform(len(nine), SAMPLES, nine.shape[1], generator=generator, device=nine.device)
    order = (draws + 2.0 * ~present[:, None]).argsort(-1)[..., :SAMPLE]
    noise = torch.zeros_like(size) if given is None else given * size

    def run(points: Tensor, weights: Tensor, index: Tensor, sigma: Tensor) -> tuple[Tensor, ...]:
        return _affine_consensus(points, weights, index, None if given is None else sigma)

    null, mean, ok = map_blocks(run, nine, data.weights, order, noise, size=PROBLEMS)
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
        count = present.sum(-1)
        ranked = torch.where(present[:, None], square, torch.inf).sort(-1).values
        middle = ((count - 1) // 2).clamp(min=0)[:, None, None].expand(-1, square.shape[1], 1)
        score = ranked.gather(-1, middle)[..., 0]
        spare = (1 - DOF[True] / (3 * count).clamp(min=22)).clamp(min=0.1)
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
    ok = (values[..., 3] > HELD * values[..., 8]) & ((weights > 0).sum(-1) >= MINIMAL[True])
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


def _identity(theta: Tensor) -> Tensor:
    return torch.eye(4, dtype=theta.dtype, device=theta.device).flatten().repeat(3) / 2


def _status(evidence: Evidence, state: Velocities, worst: Tensor, undetermined: Tensor, found: Tensor, affine: bool) -> Tensor:
    present = (evidence.data.weights > 0).sum(-1)
    still = (state.labels == STATIC).sum(-1)
    moving = (state.labels != OUTLIER).sum(-1) - still
    dof = DOF[affine] + GAUGE * state.grounded.long()
    accident = (still + moving < CONSENSUS * present) | (6 * still + 3 * moving < dof + SPARE * (present > MINIMAL[affine] + 1))
    accident = accident | (state.sigma * torch.stack(evidence.norm.scales).amax(0) > NOISY)
    status = torch.where(worst > AMBIGUOUS, int(Status.AMBIGUOUS), torch.zeros_like(present))
    status = torch.where(accident, int(Status.NO_CONSENSUS), status)
    status = torch.where(undetermined & ~accident, int(Status.DEGENERATE), status)
    status = torch.where(found != Status.OK, found.to(status), status)
    return torch.where(present < MINIMAL[affine], int(Status.TOO_FEW), status)


def _notices(
    evidence: Evidence, state: Velocities, worst: Tensor, none: Tensor, affine: bool, batch: tuple[int, ...]
) -> tuple[Notice, ...]:
    found: list[Notice] = []
    enough = (evidence.data.weights > 0).sum(-1) >= MINIMAL[affine]
    if evidence.data.count >= MINIMAL[False]:
        rank = _rank(evidence, state, none)
        least = 0
        for most, code in RANKS:
            text = f"the estimation matrix has rank {{value:g}} of 63 above the noise, {most} for velocities that are "
            kind = code.removesuffix("_velocities") if code != NoticeCode.LINEAR_VELOCITIES else "along a line"
            kind = "in a plane" if code == NoticeCode.PLANAR_VELOCITIES else kind
            text += f"{kind}; add points that move in other directions, or use model='rigid'"
            found += notices(code, text, rank, enough & (rank > least) & (rank <= most), batch)
            least = most
    text = "no static match fixes the velocity common to all points, so their mean is taken as zero; label static ones (static=)"
    found += notices(NoticeCode.COMMON_VELOCITY, text, worst, ~none & ~state.grounded, batch)
    text = "the worst direction of the maps, of norm 1, has a standard deviation of {value:.2g}; add matches or lower the noise"
    found += notices(NoticeCode.UNCERTAIN, text, worst, ~none & (worst > UNCERTAIN), batch)
    return tuple(sorted(found, key=lambda notice: notice.problem))


def _rank(evidence: Evidence, state: Velocities, none: Tensor) -> Tensor:
    """Singular values ``(b,)`` of the estimation matrix of the inliers (of all matches where there is no motion) above noise."""
    inliers = torch.where(none[:, None], torch.ones_like(state.labels, dtype=torch.bool), state.labels != OUTLIER)
    kept = evidence.data.restricted(inliers)
    values = fit_matches(ConstantVelocityTensor(), kept).singular_values
    noise = state.sigma * torch.stack(evidence.norm.scales).mean(0) * kept.weights.square().sum(-1).sqrt()
    return (values > torch.maximum(ABOVE * noise[:, None], 1e-9 * values[:, :1])).sum(-1)
