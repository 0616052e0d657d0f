r"""Least squares on translating planes and bodies: :math:`H_i = d_i H_\infty + e_i n_i^T,\ F_k = [e_k]_\times H_\infty`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from dyntorch.core.limits import quantile
from dyntorch.core.normalize import hartley
from dyntorch.core.residual import multilinear_derivative
from dyntorch.geometry.homogeneous import null_vectors, similarity, skew, unit_vectors
from dyntorch.invariants.agreement import static_residual
from dyntorch.invariants.fundamental_matrix import FundamentalMatrix
from dyntorch.numerics.blocks import constant, each
from dyntorch.numerics.least_squares import LeastSquaresOptions, NormalEquations, by_match, jacobian, minimize
from dyntorch.numerics.nullspace import spectrum
from dyntorch.tasks.planes.closed_forms import (
    infinity_closed_form,
    infinity_from_fundamentals,
    infinity_from_mixed,
    infinity_linear,
    infinity_thesis,
    plane_parts,
    unit_determinant,
)

# ----------------------------------------------------------------------------------------------------------------------
# What a user of translating_planes() may know of his data, or pays with.


@dataclass(frozen=True)
class PlanesOptions:
    """What :func:`dyntorch.translating_planes` takes and risks."""

    body_weight: float = 100.0
    """Inverse variance of a fundamental matrix against that of a homography: a body with depth is seen larger than a plane's patch.
    At 5 planes and 2 bodies 10 to 10000 do alike."""
    max_steps: int = 100
    """Steps of least squares on the matches at most (time)."""
    num_refined: int = 4
    """Solutions on the matrices that are refined on the matches (time).  Of 4 planes at 0.5 px the best minimum is reached in 98 %;
    with 2 in 90 %."""
    risk: float = 0.1
    """Share of problems whose noise is underestimated; a larger one calls more solutions wrong."""
    max_error: float = 0.5
    """Expected relative error of the homography at infinity, in normalized coordinates, from which on nothing is known of it."""


# ----------------------------------------------------------------------------------------------------------------------
# Least squares on translating planes and bodies: :math:`H_i = d_i H_\infty + e_i n_i^T,\ F_k = [e_k]_\times H_\infty`.


FOCAL_PER_HALF_IMAGE = 2.0  # focal lengths per half image; at 1 the error of H alone is 1.3 times as large, at 3 the same
# where the middle of the image may be, in focal lengths: the origin, or pixels counted from a corner
IMAGE_CENTRES = ((0.0, 0.0), (0.5, 0.4))
MIN_LOG10_FOCAL = -1.0  # least focal length that is tried, its decimal logarithm
MAX_LOG10_FOCAL = 4.5  # largest focal length that is tried, its decimal logarithm
NUM_FOCALS = 56  # focal lengths that are tried
MAX_STATIC_TRIALS = 5  # planes up to which each is tried as static
MAX_STEPS_ON_MATRICES = 40  # steps on the matrices, at most
SAME_SOLUTION_TOLERANCE = 1e-6  # one minus the cosine of homographies at infinity that are one solution
MIN_SOLUTION_SINE = 0.3  # of homographies at infinity that are two solutions: a camera that turns by 20 degrees moves them as far
MAX_EQUIVALENT_COST = 4.0  # in noise variances beyond the least
COST_ROUNDING = 1e-20  # over one and the least cost
MAX_OPEN_VARIANCE_RATIO = 1e12  # of the homography at infinity; three planes 1e3 to 1e9, degenerate ones 1e14 and more


class Normal(NamedTuple):
    """Least squares in the entries of each of c matrices."""

    cost: Tensor
    """``(b, c)``."""
    gradient: Tensor
    """``(b, c, 9)``."""
    matrix: Tensor
    """``(b, c, 9, 9)``, of Gauss and Newton."""


@dataclass(frozen=True)
class Layout:
    r"""Parameters ``(*, size)`` of p planes and m bodies: :math:`H_\infty`, all epipoles, the planes :math:`(n_i, d_i)`."""

    planes: int
    bodies: int

    @property
    def shared_size(self) -> int:
        """Size of the part that has one scale: the homography at infinity and the epipoles."""
        return 9 + 3 * (self.planes + self.bodies)

    @property
    def size(self) -> int:
        """Number of parameters."""
        return self.shared_size + 4 * self.planes

    @staticmethod
    def pack(infinity: Tensor, epipoles: Tensor, planes: Tensor) -> Tensor:
        """The inverse of :meth:`unpack`."""
        return torch.cat([infinity.flatten(-2), epipoles.flatten(-2), planes.flatten(-2)], dim=-1)

    def unpack(self, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """``(*, 3, 3)`` homography at infinity, ``(*, p + m, 3)`` epipoles, ``(*, p, 4)`` planes."""
        infinity, epipoles, planes = theta.split([9, self.shared_size - 9, 4 * self.planes], dim=-1)
        count = self.planes + self.bodies
        return infinity.unflatten(-1, (3, 3)), epipoles.unflatten(-1, (count, 3)), planes.unflatten(-1, (self.planes, 4))

    def parts(self, theta: Tensor) -> tuple[Tensor, ...]:
        r"""The parts of any scale: each plane is homogeneous, and all projections :math:`[H_\infty \mid e_i]` share one scale."""
        return theta.split([self.shared_size] + [4] * self.planes, dim=-1)

    def models(self, theta: Tensor) -> Tensor:
        """``(*, p + m, 3, 3)`` homographies of the planes, then fundamental matrices of the bodies."""
        return self.models_of(pad(theta, (0, 1))[..., _parameter_places(self.planes, self.bodies, theta.device)])

    def models_of(self, entries: Tensor) -> Tensor:
        """The same from the parameters ``(*, p + m, 16)`` of each: homography at infinity, epipole, plane (0 for a body)."""
        infinity, epipoles, planes = entries.split([9, 3, 4], dim=-1)
        infinity, p = infinity.unflatten(-1, (3, 3)), self.planes
        along, moving = epipoles[..., :p, :], epipoles[..., p:, :]
        homographies = planes[..., :p, 3, None, None] * infinity[..., :p, :, :] + along[..., :, None] * planes[..., :p, None, :3]
        return torch.cat([homographies, skew(moving) @ infinity[..., p:, :, :]], dim=-3)


@dataclass(frozen=True)
class Matrices:
    r"""Measured matrices: the residual of M is what :math:`M / \langle M, G \rangle` differs from the given matrix G of norm 1."""

    given: Tensor  # ``(b, c, 3, 3)`` of norm 1; zero where one is missing
    weights: Tensor  # ``(b, c)`` inverse variances

    def normal(self, models: Tensor) -> Normal:
        """Cost and derivatives by the entries of the models ``(b, c, 3, 3)``."""
        m, g = models.flatten(-2), self.given.flatten(-2)
        along = (m * g).sum(-1, keepdim=True)
        there = (g != 0).any(-1)
        along = torch.where(there[..., None], torch.where(along == 0, torch.finfo(m.dtype).tiny, along), 1.0)
        image = m / along
        eye = torch.eye(9, dtype=m.dtype, device=m.device)
        weight = there * self.weights
        # transposed derivative of the residual
        slope = (eye - g[..., :, None] * image[..., None, :]) / along[..., None]
        weighted = weight[..., None] * (image - g)
        cost = (weighted * (image - g)).sum(-1)
        return Normal(cost, (slope @ weighted[..., None])[..., 0], weight[..., None, None] * (slope @ slope.mT))


@dataclass(frozen=True)
class PlaneMatches:
    """Matches in normalized coordinates: Sampson distances in the unit of the measured points."""

    planes: tuple[Tensor, Tensor]  # two views ``(b, p, n, 2)`` of the points of the planes, finite
    plane_weights: Tensor  # ``(b, p, n)``, 0 = missing
    bodies: tuple[Tensor, Tensor]  # two views ``(b, m, n', 2)`` of the points of the bodies
    body_weights: Tensor  # ``(b, m, n')``
    scales: tuple[Tensor, Tensor]  # two views ``(b,)``, the unit of the measured points in normalized coordinates

    def normal(self, models: Tensor) -> Normal:
        """Cost and derivatives by the entries of the models ``(b, p + m, 3, 3)``."""
        p = self.plane_weights.shape[1]
        rows = (self._homographies(models[:, :p]), self._fundamentals(models[:, p:]))
        found = [((value.square()).sum(-1), (slope @ value[..., None])[..., 0], slope @ slope.mT) for value, slope in rows]
        return Normal(*(torch.cat(parts, dim=1) for parts in zip(*found, strict=True)))

    def _homographies(self, models: Tensor) -> tuple[Tensor, Tensor]:
        """Whitened residuals ``(b, p, 2 n)`` and their derivatives ``(b, p, 9, 2 n)``."""
        (x1, x2), (s1, s2), (b, p, n) = self.planes, self.scales, self.plane_weights.shape
        if not p:
            return models.new_zeros(b, 0, 2 * n), models.new_zeros(b, 0, 9, 2 * n)
        views = x2.flatten(0, 1), x1.flatten(0, 1)
        scales = s2.repeat_interleave(p), s1.repeat_interleave(p)

        def residual(entries: Tensor, scales: tuple[Tensor, ...], views: tuple[Tensor, ...]) -> Tensor:
            return static_residual([entries.unflatten(-1, (3, 3))], views, scales)

        value, slope = by_match(residual, models.reshape(b * p, 9), scales, views)
        root = self.plane_weights.sqrt().repeat_interleave(2, dim=-1)
        return value.reshape(b, p, 2 * n) * root, slope.reshape(b, p, 9, 2 * n) * root[..., None, :]

    def _fundamentals(self, models: Tensor) -> tuple[Tensor, Tensor]:
        """Sampson residuals ``(b, m, n')`` and their derivatives ``(b, m, 9, n')``."""
        scales = self.scales[0][:, None], self.scales[1][:, None]
        value, slope = multilinear_derivative(FundamentalMatrix(), models, self.bodies, scales)
        root = self.body_weights.sqrt()
        return value * root, (slope * root[..., None]).mT


@dataclass(frozen=True)
class PlanesProblem(NormalEquations):
    """Least squares over a block of problems."""

    layout: Layout
    evidence: Matrices | PlaneMatches

    def parts(self, theta: Tensor) -> tuple[Tensor, ...]:
        """The parts of parameters ``(b, size)`` that have a scale each."""
        return self.layout.parts(theta)

    def subset(self, keep: Tensor) -> PlanesProblem:
        """Only some of the problems."""
        return replace(self, evidence=each(lambda x: x[keep], self.evidence))

    def repeat(self, count: int) -> PlanesProblem:
        """All problems ``count`` times, one round after the other."""
        return replace(self, evidence=each(lambda x: x.repeat(count, *[1] * (x.ndim - 1)), self.evidence))

    def normal_equations(self, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Cost ``(b,)``, gradient ``(b, size)`` and Gauss-Newton matrix ``(b, size, size)``."""
        own, size = _parameter_places(self.layout.planes, self.layout.bodies, theta.device), self.layout.size
        # a plane or body depends on 16 parameters: its share has that size, whatever their number
        entries = pad(theta, (0, 1))[:, own]
        flat, slopes = jacobian(lambda each: self.layout.models_of(each).flatten(-2), entries)
        models, slope = flat.unflatten(-1, (3, 3)), slopes  # (b, c, 16, 9)
        normal = self.evidence.normal(models)
        gradient = theta.new_zeros(len(theta), size + 1)
        gradient.index_add_(1, own.flatten(), (slope @ normal.gradient[..., None]).flatten(1))
        matrix = theta.new_zeros(len(theta), (size + 1) ** 2)
        place = own[:, :, None] * (size + 1) + own[:, None]
        matrix.index_add_(1, place.flatten(), (slope @ normal.matrix @ slope.mT).flatten(1))
        cost = normal.cost.sum(1)
        square = matrix.unflatten(1, (size + 1, size + 1))[:, :size, :size]
        return torch.where(cost.isfinite(), cost, torch.inf), gradient[:, :size], square


@constant
def _parameter_places(planes: int, bodies: int, device: torch.device) -> Tensor:
    """Where the 16 parameters of every plane and body are, ``(p + m, 16)``; a body has no plane, and points behind the end."""
    count = planes + bodies
    shared = torch.arange(9, device=device).expand(count, 9)
    epipoles = 9 + torch.arange(3 * count, device=device).reshape(count, 3)
    own = 9 + 3 * count + torch.arange(4 * planes, device=device).reshape(planes, 4)
    none = torch.full((bodies, 4), 9 + 3 * count + 4 * planes, device=device)
    return torch.cat([shared, epipoles, torch.cat([own, none])], dim=1)


# ----------------------------------------------------------------------------------------------------------------------
# Where the fit of translating planes starts: coordinates of order 1, and homographies at infinity in closed form.


LEAST = {"linear": (4, 0), "closed_form": (3, 0), "thesis": (5, 0), "mixed": (2, 1), "fundamentals": (0, 2)}
"""Planes and bodies with a known fundamental matrix that each method takes."""
AUTOMATIC = ("closed_form", "linear", "mixed", "fundamentals")


def frames_of_matches(views: tuple[Tensor, Tensor], weights: Tensor) -> tuple[Tensor, Tensor]:
    """One similarity for all points of each view ``(b, n, 2)``."""
    first, second = (hartley(x[..., None, :], weights) for x in views)
    return first, second


def frames_of_calibration(calibration: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Similarities, but for skew, in which known cameras have images of size about 1."""
    first, second = (torch.linalg.inv_ex(k)[0] for k in calibration)
    size = torch.tensor([FOCAL_PER_HALF_IMAGE, FOCAL_PER_HALF_IMAGE, 1.0], dtype=first.dtype, device=first.device)[:, None]
    return size * first, size * second


def frames_of_matrices(homographies: Tensor, fundamentals: Tensor) -> tuple[Tensor, Tensor]:
    r"""Similarities for images that nothing is known of, from what homographies between them look like. homographies
    ``(b, p, 3, 3)``, fundamentals ``(b, m, 3, 3)`` -> ``(b, 3, 3)``."""
    if not homographies.shape[1]:
        square = fundamentals.square()
        near, far = square[..., :2, :2].sum((-3, -2, -1)), square[..., :2, 2].sum((-2, -1)) + square[..., 2, :2].sum((-2, -1))
        scale = torch.where((near > 0) & (far > 0), near / far, 1.0).sqrt()
        frame = similarity(scale, torch.zeros_like(fundamentals[:, 0, 0, :2]))
        return frame, frame
    frames, inverses = _frames(homographies.device)
    scaled = unit_determinant(homographies)
    size = torch.stack([(frame @ scaled @ inverse).square().sum((-2, -1)) for frame, inverse in zip(frames, inverses, strict=True)])
    best = torch.where(size > 0, size, 1.0).log().sum(-1).argmin(0)
    frame = (
        frames[best]
        * torch.tensor([FOCAL_PER_HALF_IMAGE, FOCAL_PER_HALF_IMAGE, 1.0], dtype=frames.dtype, device=frames.device)[:, None]
    )
    return frame, frame


@constant
def _frames(device: torch.device) -> tuple[Tensor, Tensor]:
    """All similarities that are tried, and their inverses."""
    focal = torch.logspace(MIN_LOG10_FOCAL, MAX_LOG10_FOCAL, NUM_FOCALS, dtype=torch.float64, device=device)
    centres = torch.tensor(IMAGE_CENTRES, dtype=torch.float64, device=device)
    frames = similarity((1 / focal)[:, None].expand(-1, len(centres)), focal[:, None, None] * centres).flatten(0, 1)
    return frames, torch.linalg.inv(frames)


def starts(method: str, homographies: Tensor, fundamentals: Tensor, several: bool = True) -> list[Tensor]:
    """Homographies at infinity ``(b, 3, 3)`` of norm about 1 by one method, or by all that the numbers of planes and bodies
    allow."""
    planes, bodies = homographies.shape[1], fundamentals.shape[1]
    filled, known = _fill_missing(homographies), _fill_missing(fundamentals)
    chosen = AUTOMATIC if method == "auto" else (method,)
    found = []
    for name in chosen:
        if planes < LEAST[name][0] or bodies < LEAST[name][1]:
            continue
        if name == "mixed":
            found.append(infinity_from_mixed(known[:, 0], filled)[0])
        elif name == "fundamentals":
            found.append(infinity_from_fundamentals(known)[0])
        else:
            linear = {"linear": infinity_linear, "thesis": infinity_thesis}
            found.append((linear[name](filled) if name in linear else infinity_closed_form(filled))[0])
    if method == "auto" and several and bodies < 2 and planes <= MAX_STATIC_TRIALS:
        found += unit_determinant(filled).unbind(1)
    eye = torch.eye(3, dtype=homographies.dtype, device=homographies.device)
    return [
        torch.where((x.isfinite() & (x.abs().amax((-2, -1), True) > 0)).flatten(1).all(-1)[:, None, None], x, eye) for x in found
    ]


def _fill_missing(matrices: Tensor) -> Tensor:
    """The first matrix that is there in the place of each missing one: the same plane again says nothing new."""
    if not matrices.shape[1]:
        return matrices
    there = (matrices != 0).flatten(2).any(-1)
    first = there.double().argmax(-1)
    again = matrices.gather(1, first[:, None, None, None].expand(-1, 1, 3, 3))
    return torch.where(there[..., None, None], matrices, again)


def parameters(homographies: Tensor, fundamentals: Tensor, infinity: Tensor) -> Tensor:
    """The parameters ``(b, size)`` of :class:`Layout` with a given homography at infinity."""
    parts = plane_parts(homographies, infinity) if homographies.shape[1] else None
    epipoles = null_vectors(fundamentals)[0]
    planes = infinity.new_zeros(len(infinity), 0, 4)
    if parts is not None:
        epipoles = torch.cat([parts.epipole, epipoles], dim=-2)
        planes = torch.cat([parts.normal, torch.ones_like(parts.scale)[..., None]], dim=-1)
    return Layout.pack(infinity, epipoles, planes)


# ----------------------------------------------------------------------------------------------------------------------
# The fit of translating planes: every start refined on the matrices, then on the matches; the best one, and its covariance.


EIGENVALUE_EPSILON = 1e-15
"""Eigenvalue of a Gauss-Newton matrix with the diagonal 1 that is rounding error."""


def solve(
    homographies: Tensor,
    fundamentals: Tensor,
    matches: PlaneMatches | None,
    spare: Tensor,
    method: str,
    refine: bool,
    options: PlanesOptions,
) -> tuple[Tensor, ...]:
    """The best fit to a block of problems.

    Args:
        homographies: ``(b, p, 3, 3)`` of norm 1 in normalized coordinates, zero where one is missing.
        fundamentals: ``(b, m, 3, 3)``.
        matches: None fits the matrices alone.
        spare: ``(b,)`` residuals beyond the degrees of freedom.
        method: see :func:`~dyntorch.tasks.planes.problem.starts`.
        refine: False leaves a start as it is.
        options: time and risk.

    Returns:
        theta ``(b, size)`` of :class:`Layout`, cost ``(b,)``, the covariance ``(b, size, size)`` of theta for residuals of
        variance 1, gauges held, whether the data leave the homography at infinity open ``(b,)``, exactly, and whether another one
        fits them as well ``(b,)``.
    """
    layout, b = Layout(homographies.shape[1], fundamentals.shape[1]), len(homographies)
    weights = homographies.new_tensor([1.0] * layout.planes + [options.body_weight] * layout.bodies)
    matrices = PlanesProblem(layout, Matrices(torch.cat([homographies, fundamentals], dim=1), weights.expand(b, -1)))
    first = starts(method, homographies, fundamentals, several=refine)
    theta = torch.cat([parameters(homographies, fundamentals, infinity) for infinity in first])
    rounds = matrices.repeat(len(first))
    if refine:
        start = rounds.evaluate((theta,))
        theta = minimize(rounds, start, LeastSquaresOptions(iterations=MAX_STEPS_ON_MATRICES)).theta[0]
    cost = rounds.normal_equations(theta)[0]
    theta, cost = _select_distinct(theta.unflatten(0, (len(first), b)), cost.unflatten(0, (len(first), b)), options.num_refined)
    problem = matrices if matches is None else PlanesProblem(layout, matches)
    if matches is not None:
        chosen = cost.flatten().isfinite().nonzero()[:, 0]
        again = problem.repeat(len(cost)).subset(chosen)
        if refine:
            start = again.evaluate((theta.flatten(0, 1)[chosen],))
            found = minimize(again, start, LeastSquaresOptions(iterations=options.max_steps))
            theta, value = theta.flatten(0, 1).index_copy(0, chosen, found.theta[0]).unflatten(0, cost.shape), found.cost
        else:
            value = again.normal_equations(theta.flatten(0, 1)[chosen])[0]
        cost = cost.flatten().index_copy(0, chosen, value).unflatten(0, cost.shape)
    best = cost.argmin(0)
    everyone = torch.arange(b, device=best.device)
    other = (
        _has_alternatives(theta[..., :9], cost, best, spare, options.risk) if refine else torch.zeros_like(spare, dtype=torch.bool)
    )
    theta, cost = theta[best, everyone], cost[best, everyone]
    covariance, undetermined = _covariance(problem, theta)
    if matches is not None:
        undetermined = _covariance(matrices, theta)[1]
    return theta, cost, covariance, undetermined, other


def _select_distinct(theta: Tensor, cost: Tensor, num_refined: int) -> tuple[Tensor, Tensor]:
    """The best few of several results ``(rounds, b, *)``; the cost of one that was found before is infinite."""
    cost, order = cost.nan_to_num(torch.inf).sort(dim=0, stable=True)
    theta = theta.gather(0, order[..., None].expand_as(theta))
    directions = unit_vectors(theta[..., :9])
    cosine = torch.einsum("kbi,lbi->klb", directions, directions).abs()
    again = cosine > 1 - SAME_SOLUTION_TOLERANCE
    before = torch.ones(len(cost), len(cost), dtype=torch.bool, device=cost.device).tril(-1)[..., None]
    cost = torch.where((again & before).any(1), torch.inf, cost)
    cost, order = cost.sort(dim=0, stable=True)
    return theta.gather(0, order[..., None].expand_as(theta))[:num_refined], cost[:num_refined]


def _has_alternatives(infinity: Tensor, cost: Tensor, best: Tensor, spare: Tensor, risk: float) -> Tensor:
    """Where another homography at infinity ``(k, b, 9)`` has about the cost of the best."""
    directions = unit_vectors(infinity)
    everyone = torch.arange(len(best), device=best.device)
    least = cost[best, everyone]
    sine = (1 - (directions * directions[best, everyone]).sum(-1).square()).clamp(min=0).sqrt()
    limit = least + MAX_EQUIVALENT_COST * noise_variance(least, spare, risk) + COST_ROUNDING * (least + 1)
    return ((cost <= limit) & (sine > MIN_SOLUTION_SINE)).any(0)


def noise_variance(cost: Tensor, spare: Tensor, risk: float) -> Tensor:
    r"""Variance of the noise, :math:`c / q` with the lower quantile q of :math:`\chi^2`, which is near the number of residuals
    to spare where that is large; 0 where none is. cost ``(b,)``, spare ``(b,)``."""
    degrees = spare.clamp(min=1).flatten().tolist()
    limits = spare.new_tensor([quantile(risk, free) for free in degrees]).reshape(spare.shape)
    return torch.where(spare > 0, cost / limits, 0.0)


def _covariance(problem: PlanesProblem, theta: Tensor) -> tuple[Tensor, Tensor]:
    """Inverse of the Gauss-Newton matrix with the gauges held, and whether the homography at infinity has an open direction."""
    matrix = problem.normal_equations(theta)[2]
    size = matrix.diagonal(dim1=-2, dim2=-1).sqrt()
    # parameters that nothing depends on (of a missing plane) are held
    none = size <= EIGENVALUE_EPSILON * size.amax(-1, keepdim=True)
    unit = torch.where(none, torch.inf, size)
    gauges = unit_vectors(_gauges(problem.layout, theta) * torch.where(none, 0.0, size)[:, None]).mT
    scaled = matrix / (unit[:, :, None] * unit[:, None]) + gauges @ gauges.mT + torch.diag_embed(none.to(matrix.dtype))
    values, vectors = spectrum(scaled)
    inverse = (vectors / values.clamp(min=EIGENVALUE_EPSILON)[:, None, :]) @ vectors.mT / (unit[:, :, None] * unit[:, None])
    spread = project_covariance(inverse[:, :9, :9], theta[:, :9]).diagonal(dim1=-2, dim2=-1).sum(-1)
    least = 1 / matrix[:, :9, :9].diagonal(dim1=-2, dim2=-1).mean(-1).clamp(min=torch.finfo(matrix.dtype).tiny)
    return inverse, spread > MAX_OPEN_VARIANCE_RATIO * least


def project_covariance(covariance: Tensor, vector: Tensor) -> Tensor:
    """Covariance ``(*, k, k)`` of the direction of a vector ``(*, k)`` of any length."""
    length = vector.norm(dim=-1)[..., None, None].clamp(min=torch.finfo(vector.dtype).tiny)
    unit = unit_vectors(vector)
    across = (torch.eye(vector.shape[-1], dtype=unit.dtype, device=unit.device) - unit[..., :, None] * unit[..., None, :]) / length
    return across @ covariance @ across


def _gauges(layout: Layout, theta: Tensor) -> Tensor:
    """Directions ``(b, k, size)`` that change no matrix: scales of the common part, of every plane and of every epipole."""
    infinity, epipoles, planes = layout.unpack(theta)
    p = layout.planes
    directions = [torch.cat([theta[:, : layout.shared_size], torch.zeros_like(theta[:, layout.shared_size :])], dim=-1)[:, None]]
    which = torch.eye(p + layout.bodies, dtype=theta.dtype, device=theta.device)
    along = which[None, :, :, None] * epipoles[:, None]
    across = which[None, :, :p, None] * planes[:, None]
    none = torch.zeros_like(infinity)[:, None].expand(-1, p + layout.bodies, -1, -1)
    normal = across * planes.new_tensor([1.0, 1.0, 1.0, 0.0])
    directions.append(layout.pack(none, along, -normal))
    directions.append(layout.pack(none[:, :p], torch.zeros_like(along[:, :p]), across[:, :p]))
    return torch.cat(directions, dim=1)
