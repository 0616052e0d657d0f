"""Lines that move in planes, static lines and static points between two views: residuals, refinement, labels."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from dyntorch.algebra.homogeneous import homogeneous, unit
from dyntorch.chi_square import three_sigma
from dyntorch.eigenspace import spectrum
from dyntorch.forward import by_match, derivatives
from dyntorch.invariants.agreement import point_error, static_residual
from dyntorch.invariants.translating_lines_matrix import TranslatingLinesMatrix
from dyntorch.least_squares import damped_step
from dyntorch.matches import Matches
from dyntorch.normalize import Normalization, denormalize_motion
from dyntorch.primitives import Line, direction
from dyntorch.residual import multilinear, multilinear_derivative
from dyntorch.tasks.alignment import MOVING, OUTLIER, STATIC

ROUNDS, STEPS = 4, 12
CONVERGED = 1e-10  # relative decrease of the cost
DOF = TranslatingLinesMatrix.dof


@dataclass(frozen=True)
class Lines:
    """Lines as two points each, and static points, in normalized coordinates; flat batch.

    Attributes:
        data: lines ``(b, n, 2, 3)`` as measured.
        views: normalized.
        points: normalized static points ``(b, k, 3)`` of both views, k may be 0.
        norm: the similarities of both views.
        floor: ``(b,)`` the least noise that the numbers allow, in the unit of the points.
    """

    data: Matches
    views: tuple[Tensor, ...]
    points: tuple[Tensor, ...]
    norm: Normalization
    floor: Tensor

    @classmethod
    def of(cls, data: Matches, points: tuple[Tensor, Tensor] | None, norm: Normalization) -> Lines:
        """From measured lines and points."""
        empty = data.views[0][:, :0, 0]
        pair = (empty, empty) if points is None else points
        moved = tuple(x @ t[:, :3, :3].mT + t[:, None, :3, 3] for x, t in zip(pair, norm.transforms, strict=True))
        floor = 100 * torch.finfo(torch.float64).eps / torch.stack(norm.scales).amin(0)
        return cls(data, norm.apply(TranslatingLinesMatrix(), data.views), moved, norm, floor)

    def moving(self, theta: Tensor) -> Tensor:
        """Signed Sampson residual ``(b, n)`` of each line that may move, in the unit of the points."""
        tensor = TranslatingLinesMatrix.compose(theta.unflatten(-1, (4, 4)))
        return multilinear(TranslatingLinesMatrix(), tensor, self.views, self.norm.scales)

    def still(self, theta: Tensor) -> Tensor:
        """Distances ``(b, n, 6)`` of both points of a line in view 2, carried into view 1, from the line there; 4 conditions."""
        return _still(theta, self.norm.scales, self.views)

    def at_points(self, theta: Tensor) -> Tensor:
        """Disagreement ``(b, k, 3)`` of static points."""
        return _at_points(theta, self.norm.scales, self.points)

    def residual(self, theta: Tensor, labels: Tensor) -> Tensor:
        """All weighted residuals ``(b, rows)`` of the labelled lines and the static points, in the unit of the points."""
        moving, still = self._roots(labels)
        return torch.cat(
            [self.moving(theta) * moving, self.still(theta).flatten(1) * still, self.at_points(theta).flatten(1)], dim=-1
        )

    def linearized(self, theta: Tensor, labels: Tensor) -> tuple[Tensor, Tensor]:
        """:meth:`residual` and its derivative ``(b, 16, rows)``."""
        model, scales = TranslatingLinesMatrix(), self.norm.scales
        tensor, slope = model.compose_derivative((theta.unflatten(-1, (4, 4)),))
        path, by_tensor = multilinear_derivative(model, tensor.unflatten(1, model.shape()), self.views, scales)
        parts = [(path, slope @ by_tensor.mT), by_match(_still, theta, scales, self.views)]
        roots = self._roots(labels)
        parts = [(value * root, slope * root[:, None]) for (value, slope), root in zip(parts, roots, strict=True)]
        parts.append(by_match(_at_points, theta, scales, self.points))
        return torch.cat([value for value, _ in parts], dim=-1), torch.cat([derivative for _, derivative in parts], dim=-1)

    def _roots(self, labels: Tensor) -> tuple[Tensor, Tensor]:
        """Roots of the weights of the moving lines ``(b, n)`` and of the static ones, six for each, ``(b, 6 n)``."""
        root = self.data.weights.sqrt()
        return torch.where(labels == MOVING, root, 0.0), torch.where(labels == STATIC, root, 0.0).repeat_interleave(6, dim=-1)


def _still(theta: Tensor, scales: tuple[Tensor, ...], views: tuple[Tensor, ...]) -> Tensor:
    first, second = views[0].unbind(-2)
    along = second - first
    square = along.square().sum(-1, keepdim=True).clamp(min=torch.finfo(theta.dtype).tiny)
    s1, s2 = (s[..., None, None] for s in scales)
    matrix = theta.unflatten(-1, (4, 4))
    parts = []
    for point in views[1].unbind(-2):
        error, slope = point_error(homogeneous(point) @ matrix.mT, matrix[..., None, :, :], first)
        place = (error * along).sum(-1, keepdim=True) / square
        across = error - place * along
        # isotropic: the noise of the line at this place, and that of the point, averaged over the plane across
        other = (slope.square().sum((-1, -2)) / 3)[..., None]
        variance = s1.square() * ((1 - place).square() + place.square()) + s2.square() * other
        parts.append(across * variance.rsqrt())
    return torch.cat(parts, dim=-1)


def _at_points(theta: Tensor, scales: tuple[Tensor, ...], points: tuple[Tensor, ...]) -> Tensor:
    return static_residual([theta.unflatten(-1, (4, 4))], points, scales)


def as_points(views: tuple[Tensor, ...], weights: Tensor) -> tuple[Tensor, ...]:
    """Lines ``(b, n, 2 3)`` or ``(b, n, 6)`` as two points each, of Pluecker lines near the centre of the scene."""
    return tuple(x if x.ndim == 4 else _two_points(x, (weights > 0).to(x)) for x in views)


def _two_points(line: Tensor, present: Tensor) -> Tensor:
    along = normalize(direction(line), dim=-1)
    foot = Line().points(line)[..., 0, :]
    share = (present / present.sum(-1, keepdim=True).clamp(min=1.0))[..., None]
    centre = (share * foot).sum(-2, keepdim=True)
    nearest = foot + along * (along * (centre - foot)).sum(-1, keepdim=True)
    size = ((nearest - centre).square() * share).sum((-2, -1)).sqrt()[:, None, None]
    size = torch.where(size > 0, size, 1.0)
    return torch.stack([nearest - size / 2 * along, nearest + size / 2 * along], dim=-2)


def settle(lines: Lines, theta: Tensor, sigma: Tensor, *, estimate: bool, plain: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Label and refine in turns: A ``(b, 16)`` in normalized coordinates, labels ``(b, n)``, noise ``(b,)``.

    Args:
        lines: the matches.
        theta: ``(b, 16)`` to start from.
        sigma: ``(b,)`` noise.
        estimate: whether the noise is estimated anew in every round.
        plain: whether no line is called an outlier before the first refinement.
    """
    present = lines.data.weights > 0
    labels = torch.where(present, MOVING, OUTLIER) if plain else _labels(lines, theta, sigma)
    for _ in range(ROUNDS):
        theta = refined(lines, theta, labels)
        if estimate:
            left = lines.residual(theta, labels).square().sum(-1)
            spare = (labels == MOVING).sum(-1) + 4 * (labels == STATIC).sum(-1) + 3 * lines.points[0].shape[1] - DOF
            sigma = torch.where(spare >= 4, (left / spare.clamp(min=1)).sqrt(), sigma).maximum(lines.floor)
        new = _labels(lines, theta, sigma)
        if bool((new == labels).all()):
            break
        labels = new
    return theta, labels, sigma


def refined(lines: Lines, theta: Tensor, labels: Tensor) -> Tensor:
    """A that minimizes the residuals of all labelled matches, by Levenberg-Marquardt."""
    cost, gradient, matrix = _equations(lines, theta, labels)
    damping = torch.full_like(cost, 1e-3)
    for _ in range(STEPS):
        trial = normalize(theta - damped_step(gradient, matrix, damping), dim=-1)
        fresh = _equations(lines, trial, labels)
        better = fresh[0] < cost
        done = (better & (cost - fresh[0] <= CONVERGED * cost)) | (~better & (damping > 1e5))
        theta, gradient = torch.where(better[:, None], trial, theta), torch.where(better[:, None], fresh[1], gradient)
        matrix, cost = torch.where(better[:, None, None], fresh[2], matrix), torch.where(better, fresh[0], cost)
        damping = torch.where(better, (damping * 0.1).clamp(min=1e-12), damping * 8)
        if bool(done.all()):
            break
    return theta


def spread(lines: Lines, theta: Tensor, labels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Extreme information ``(b, 2)`` on A, A ``(b, 4, 4)`` as measured, and its covariance ``(b, 16, 16)`` for noise 1."""
    _, _, matrix = _equations(lines, theta, labels)
    values, vectors = spectrum(matrix)
    values, vectors = values[:, -DOF:], vectors[..., -DOF:]
    root = vectors * values.clamp(min=1e-12 * values[:, -1:].clamp(min=1e-300)).rsqrt()[:, None]

    def measured(t: Tensor) -> Tensor:
        part = denormalize_motion(TranslatingLinesMatrix(), (t.unflatten(-1, (4, 4)),), lines.norm.transforms)[0]
        return unit(part).flatten(-2)

    place, moved = derivatives(measured, theta, root.movedim(-1, 0))
    return values[:, [0, -1]], place.unflatten(-1, (4, 4)), moved.mT @ moved


def _equations(lines: Lines, theta: Tensor, labels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Cost ``(b,)``, gradient ``(b, 16)`` and Gauss-Newton matrix."""
    value, slope = lines.linearized(theta, labels)
    cost = value.square().sum(-1)
    return torch.where(cost.isfinite(), cost, torch.inf), (slope @ value[..., None])[..., 0], slope @ slope.mT


def _labels(lines: Lines, theta: Tensor, sigma: Tensor) -> Tensor:
    square, known = sigma.square()[:, None], lines.data.static
    still = lines.still(theta).square().sum(-1) <= three_sigma(4) * square
    path = lines.moving(theta).square() <= three_sigma(1) * square
    path = path if known is None else path & ~known
    labels = torch.where(still, STATIC, torch.where(path, MOVING, OUTLIER))
    return torch.where(lines.data.weights > 0, labels, OUTLIER)
