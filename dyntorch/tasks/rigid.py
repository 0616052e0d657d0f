r"""Two rigid motions from points that move: :math:`x_1, A x_2, B x_3` on a straight line, or at equal steps on it.

With equal noise in all coordinates, and :math:`y_1 = x_1, y_2 = A x_2, y_3 = B x_3`, the two orthonormal combinations

.. math:: u = (y_1 - y_3) / \sqrt 2, \qquad v = (y_1 - 2 y_2 + y_3) / \sqrt 6

hold everything: a static point has :math:`\|u\|^2 + \|v\|^2 = \chi^2_6 \sigma^2`, one of constant velocity
:math:`\|v\|^2 = \chi^2_3 \sigma^2`, and one on a straight line the smaller eigenvalue of the Gram matrix of u and v,
:math:`\chi^2_2 \sigma^2`.  No covariance is needed, because a rigid motion leaves noise as it is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.algebra.homogeneous import skew
from dyntorch.algebra.rigid import moved_by
from dyntorch.least_squares import damped_step

MOTIONS = {"straight": 2, "constant_velocity": 3}
"""Conditions that a moving point fulfils."""
CONVERGED = 1e-9  # relative decrease of the cost


@dataclass(frozen=True)
class Sightings:
    """Points of three poses in one common unit; leading dimensions broadcast against those of the motions.

    Attributes:
        x1, x2, x3: ``(..., n, 3)``.
        weights: ``(..., n)``.
        motion: one of :data:`MOTIONS`.
    """

    x1: Tensor
    x2: Tensor
    x3: Tensor
    weights: Tensor
    motion: str

    @property
    def conditions(self) -> int:
        """Degrees of freedom of the residual of one moving point."""
        return MOTIONS[self.motion]

    def sample(self, index: Tensor) -> Sightings:
        """The matches ``index (b, k, m)`` of sightings ``(b, 1, n, 3)``: k small problems for each."""
        k = index.shape[1]

        def pick(x: Tensor) -> Tensor:
            return x.expand(-1, k, -1, -1).gather(2, index[..., None].expand(-1, -1, -1, 3))

        weights = self.weights.expand(-1, k, -1).gather(2, index)
        return Sightings(pick(self.x1), pick(self.x2), pick(self.x3), weights, self.motion)

    def flat(self, lead: torch.Size) -> Sightings:
        """Expanded to the leading dimensions and flattened to one."""

        def spread(x: Tensor, tail: int) -> Tensor:
            return x.expand(*lead, *x.shape[-tail:]).reshape(-1, *x.shape[-tail:])

        return Sightings(spread(self.x1, 2), spread(self.x2, 2), spread(self.x3, 2), spread(self.weights, 1), self.motion)


def combinations(motions: Tensor, data: Sightings) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The combinations u and v of each match, and the points y2 and y3 in the frame of view 1, ``(..., n, 3)`` each.

    Args:
        motions: ``(..., 2, 4, 4)``, A and B.
        data: the matches.
    """
    y2, y3 = (x @ motions[..., i, :3, :3].mT + motions[..., i, None, :3, 3] for i, x in ((0, data.x2), (1, data.x3)))
    return (data.x1 - y3) / math.sqrt(2), (data.x1 - 2 * y2 + y3) / math.sqrt(6), y2, y3


def turn(u: Tensor, v: Tensor, motion: str) -> tuple[Tensor, Tensor]:
    """Cosine and sine ``(..., n, 1)`` of the turn after which the second combination is the residual of a moving point."""
    if motion == "constant_velocity":
        return torch.ones_like(u[..., :1]), torch.zeros_like(u[..., :1])
    double = torch.stack([u.square().sum(-1) - v.square().sum(-1), 2 * (u * v).sum(-1)], dim=-1)
    angle = 0.5 * torch.atan2(double[..., 1], double[..., 0])[..., None]
    return angle.cos(), angle.sin()


def squares(motions: Tensor, data: Sightings) -> tuple[Tensor, Tensor]:
    """Squared residuals ``(..., n)`` of each match as a moving point, and as a static one."""
    u, v, _, _ = combinations(motions, data)
    cos, sin = turn(u, v, data.motion)
    return (cos * v - sin * u).square().sum(-1), u.square().sum(-1) + v.square().sum(-1)


def normal_equations(motions: Tensor, data: Sightings, weights: Tensor, still: Tensor | None) -> tuple[Tensor, Tensor]:
    r"""Gradient ``(..., 12)`` and Gauss-Newton matrix in the tangents :math:`(\omega_A, \tau_A, \omega_B, \tau_B)`.

    The turn of u and v is held (variable projection): the gradient stays exact, because the residual is normal to the line.

    Args:
        motions: ``(..., 2, 4, 4)``.
        data: the matches.
        weights: ``(..., n)`` in place of those of the data.
        still: ``(..., n)`` bool, static points.
    """
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
        direction = torch.nn.functional.normalize(along, dim=-1, eps=torch.finfo(u.dtype).tiny)
        normal = jacobian - direction[..., :, None] * (direction[..., None, :] @ jacobian)
        jacobian = torch.where((free > 0)[..., None], normal, jacobian)
    rows, values = (root[..., None] * jacobian).flatten(-3, -2), (root * error).flatten(-2)
    if rest is not None and still is not None:
        held = torch.where(still[..., None], root, 0.0)
        rows = torch.cat([rows, (held[..., None] * rest).flatten(-3, -2)], dim=-2)
        values = torch.cat([values, (held * along).flatten(-2)], dim=-1)
    return (rows.mT @ values[..., None])[..., 0], rows.mT @ rows


def descend(
    motions: Tensor, data: Sightings, *, scale: Tensor | None = None, still: Tensor | None = None, iterations: int = 20
) -> tuple[Tensor, Tensor]:
    r"""Levenberg-Marquardt over two rigid motions, for a whole batch of problems.

    Args:
        motions: ``(*lead, 2, 4, 4)`` to start from.
        data: matches with leading dimensions that broadcast to ``lead``.
        scale: ``(*lead,)``: residuals r count :math:`r^2 / (1 + r^2 / c^2)` (Geman and McClure); None: :math:`r^2`.
        still: ``(*lead, n)`` bool, points held static.
        iterations: steps.

    Returns:
        motions of a cost that is not higher, and the cost ``(*lead,)``.
    """
    lead = motions.shape[:-3]
    flat = data.flat(lead)
    pose = motions.reshape(-1, 2, 4, 4)
    square = None if scale is None else scale.expand(lead).reshape(-1, 1).square()
    held = None if still is None else still.expand(*lead, -1).reshape(flat.weights.shape)

    def residual(at: Tensor) -> Tensor:
        moving, static = squares(at, flat)
        return moving if held is None else torch.where(held, static, moving)

    def cost_of(r: Tensor) -> Tensor:
        return (flat.weights * (r if square is None else r * square / (square + r))).sum(-1)

    r = residual(pose)
    cost, damping = cost_of(r), torch.full(pose.shape[:1], 1e-3, dtype=pose.dtype, device=pose.device)
    done = torch.zeros_like(cost, dtype=torch.bool)
    for _ in range(iterations):
        weights = flat.weights if square is None else flat.weights * (square / (square + r)).square()
        gradient, matrix = normal_equations(pose, flat, weights, held)
        trial = _step(pose, gradient, matrix, damping)
        fresh = residual(trial)
        new = cost_of(fresh)
        better = (new < cost) & ~done
        done = done | (better & (cost - new <= CONVERGED * cost)) | (~better & (damping > 1e5))
        pose, r = torch.where(better[:, None, None, None], trial, pose), torch.where(better[:, None], fresh, r)
        cost = torch.where(better, new, cost)
        damping = torch.where(better, (damping * 0.1).clamp(min=1e-10), damping * 8)
        if bool(done.all()):
            break
    return pose.reshape(motions.shape), cost.reshape(lead)


def _step(pose: Tensor, gradient: Tensor, matrix: Tensor, damping: Tensor) -> Tensor:
    """The motions after a damped Gauss-Newton step."""
    step = damped_step(gradient, matrix, damping)
    # half a radian is as far as the linearization of a rotation can be trusted
    length = step.unflatten(-1, (2, 2, 3))[:, :, 0].norm(dim=-1).amax(-1)
    step = step / (2 * length).clamp(min=1.0)[:, None]
    return moved_by(pose, -step.unflatten(-1, (2, 6)))
