"""Points at constant velocity before projective or affine sensors: refinement, the static gauge, labels, the sensor's motion."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyntorch.algebra.homogeneous import apply, unit
from dyntorch.chi_square import three_sigma
from dyntorch.eigenspace import spectrum
from dyntorch.forward import derivatives
from dyntorch.invariants.constant_velocity_tensor import ConstantVelocityTensor
from dyntorch.least_squares import damped_step
from dyntorch.normalize import denormalize_motion
from dyntorch.tasks.alignment import MOVING, OUTLIER, STATIC
from dyntorch.tasks.labelling import ROUGH, Evidence

ROUNDS = 4
STEPS = 15
CONVERGED = 1e-10  # relative decrease of the cost
SEEDS = 64
"""Velocities tried as the common one: of 10 % static matches six or seven are among them."""
STANDING = 0.1
"""Least share of the inliers that must have one velocity before they are taken for the static background (and at least 3)."""
GAUGE = 3  # degrees of freedom of the common velocity
DOF = {False: 30, True: 21}
"""Of three projective (affine) maps up to an affinity of the world and the common velocity."""
ENTRIES = (12, 13, 14)  # of a 4 x 4 matrix: zero for an affine map


@dataclass(frozen=True)
class Velocities:
    """Maps, labels and noise of a flat batch.

    Attributes:
        theta: ``(b, 48)`` the three maps in normalized coordinates.
        labels: ``(b, n)``.
        sigma: ``(b,)`` in the unit of the matches.
        grounded: ``(b,)`` bool, whether static matches fix the common velocity.
    """

    theta: Tensor
    labels: Tensor
    sigma: Tensor
    grounded: Tensor


def refined(evidence: Evidence, theta: Tensor, labels: Tensor, affine: bool) -> Tensor:
    """The maps ``(b, 48)`` that minimize the residuals of the labelled matches, by Levenberg-Marquardt; affine maps stay affine."""
    problem, free = evidence.problem(labels), _free(theta, affine)
    if not bool((labels == STATIC).any()):
        problem = replace(problem, static=None)  # half of the work
    cost, gradient, matrix = problem.normal_equations(theta)
    damping = torch.full_like(cost, 1e-3)
    for _ in range(STEPS):
        trial = _scaled(theta - damped_step(gradient, matrix, damping, free))
        fresh = problem.normal_equations(trial)
        better = fresh[0] < cost
        small = ~better | (cost - fresh[0] <= CONVERGED * cost)
        theta, gradient = torch.where(better[:, None], trial, theta), torch.where(better[:, None], fresh[1], gradient)
        matrix, cost = torch.where(better[:, None, None], fresh[2], matrix), torch.where(better, fresh[0], cost)
        finished = small & (better | (damping > 1e5))
        damping = torch.where(better, (damping * 0.1).clamp(min=1e-12), damping * 8)
        if bool(finished.all()):
            break
    return theta


def settle(evidence: Evidence, theta: Tensor, sigma: Tensor, affine: bool, estimate: bool) -> Velocities:
    """Label and refine in turns: first without a gauge, then with the static matches, if there are such.

    Args:
        evidence: the matches.
        theta: ``(b, 48)`` first maps.
        sigma: ``(b,)`` noise.
        affine: whether the maps are affine.
        estimate: whether the noise is estimated anew in every round.
    """
    known = evidence.data.static
    grounded = torch.zeros_like(sigma, dtype=torch.bool) if known is None else (known & (evidence.data.weights > 0)).any(-1)
    if known is not None:
        theta = _fixed(evidence, theta, known & (evidence.data.weights > 0))
    state = _rounds(evidence, Velocities(theta, _labels(evidence, theta, sigma, grounded), sigma, grounded), affine, estimate)
    theta, standing = _ground(evidence, state)
    standing = standing & ~grounded
    state = replace(state, theta=theta)
    if not bool(standing.any()):
        return state
    grounded = grounded | standing
    labels = _labels(evidence, theta, state.sigma, grounded)
    return _rounds(evidence, Velocities(theta, labels, state.sigma, grounded), affine, estimate)


def information(evidence: Evidence, state: Velocities, affine: bool) -> tuple[Tensor, Tensor, Tensor]:
    """What the inliers tell about the sensor.

    Returns:
        the eigenvalues ``(b, 2)`` least and greatest of the information on theta, per unit of variance; the motions A and B
        ``(b, 2, 4, 4)`` of the normalized matches, of norm 1; the covariance ``(b, 32, 32)`` of the entries of A and B in the
        coordinates of the matches, for noise 1.
    """
    _, _, matrix = evidence.problem(state.labels).normal_equations(state.theta)
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
    moving = model.whitened(motion, evidence.views, scales).square().sum(-1)
    return moving, model.whitened_static(motion, evidence.views, scales).square().sum(-1)


def _rounds(evidence: Evidence, state: Velocities, affine: bool, estimate: bool) -> Velocities:
    theta, labels, sigma = state.theta, state.labels, state.sigma
    for _ in range(ROUNDS):
        theta = refined(evidence, theta, labels, affine)
        if estimate:
            sigma = _noise(evidence, theta, labels, sigma, DOF[affine] + GAUGE * state.grounded.long())
        new = _labels(evidence, theta, sigma, state.grounded)
        if bool((new == labels).all()):
            break
        labels = new
    return Velocities(theta, labels, sigma, state.grounded)


def _labels(evidence: Evidence, theta: Tensor, sigma: Tensor, grounded: Tensor) -> Tensor:
    moving, resting = residuals(evidence, theta)
    variance, known = sigma.square()[:, None], evidence.data.static
    still = (resting <= three_sigma(6) * variance) & grounded[:, None]
    path = moving <= three_sigma(3) * variance
    path = path if known is None else path & ~known
    labels = torch.where(still, STATIC, torch.where(path, MOVING, OUTLIER))
    return torch.where(evidence.data.weights > 0, labels, OUTLIER)


def _noise(evidence: Evidence, theta: Tensor, labels: Tensor, before: Tensor, dof: Tensor) -> Tensor:
    moving, resting = residuals(evidence, theta)
    square = torch.where(labels == STATIC, resting, moving)
    spare = (6 * (labels == STATIC) + 3 * (labels == MOVING)).sum(-1) - dof
    shown = (torch.where(labels == OUTLIER, 0.0, square).sum(-1) / spare.clamp(min=1)).sqrt()
    return torch.where(spare >= 6, shown, before).maximum(evidence.floor)


def _ground(evidence: Evidence, state: Velocities) -> tuple[Tensor, Tensor]:
    """Maps in the gauge in which the most matches stand still, and where these are enough; else the mean velocity is 0."""
    inliers = state.labels != OUTLIER
    limit = three_sigma(6) * state.sigma.square()[:, None]
    n = inliers.shape[-1]
    chosen = torch.arange(0, n, max(1, -(-n // SEEDS)), device=inliers.device)
    motion, views = _maps(evidence, state.theta), evidence.views
    several = tuple(m[:, None].expand(-1, len(chosen), -1, -1) for m in motion)
    one = tuple(x[:, chosen, None] for x in views)
    tried = ConstantVelocityTensor.fix_gauge((several[0], several[1], several[2]), *one)
    scales = tuple(s[:, None] for s in evidence.norm.scales)
    resting = ConstantVelocityTensor().whitened_static(tried, tuple(x[:, None] for x in views), scales).square().sum(-1)
    # the noise of the one match that chose the velocity is in these residuals, too
    near = (resting <= ROUGH**2 * limit[:, None]) & inliers[:, None]
    best = (near.sum(-1) * inliers[:, chosen]).argmax(-1)
    members = near[torch.arange(len(best), device=best.device), best]
    theta = _fixed(evidence, state.theta, members)
    members = (residuals(evidence, theta)[1] <= limit) & inliers
    count = members.sum(-1)
    enough = (count >= 3) & (count >= STANDING * inliers.sum(-1))
    free = torch.where(state.grounded[:, None], False, torch.where(enough[:, None], members, inliers))
    return _fixed(evidence, state.theta, free), enough


def _fixed(evidence: Evidence, theta: Tensor, members: Tensor) -> Tensor:
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


def _scaled(theta: Tensor) -> Tensor:
    parts = theta.unflatten(-1, (3, 16))
    return (parts / parts.norm(dim=-1, keepdim=True).clamp(min=1e-30)).flatten(1)
