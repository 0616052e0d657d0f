"""Lens distortion: of calibrated lenses, put on and removed, and the one-parameter model of lenses that nobody calibrated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import prod
from typing import Any

import torch
from torch import Tensor

from dyntorch.geometry.epipolar import TINY, eight_point
from dyntorch.geometry.epipolar_fit import Frames
from dyntorch.geometry.homogeneous import homogeneous
from dyntorch.numerics.arguments import check_together, check_weights, on_cpu
from dyntorch.numerics.blocks import one_thread
from dyntorch.numerics.least_squares import Iterate, LeastSquares, LeastSquaresOptions, Minimum, Tensors, damped_step, minimize
from dyntorch.numerics.messages import Message

COEFFICIENTS = (4, 5, 8)
"""Lengths of OpenCV's vectors k1, k2, p1, p2 [, k3 [, k4, k5, k6]]."""
CONTINUATION, NEWTON, SAMPLES = 4, 12, 8
"""Parts of the way from the principal point, Newton steps at its end, and points of the way at which the lens must not fold."""
SOLVED = 1e-10
"""Largest misfit of a solution, in focal lengths."""


def distort(x: Tensor, K: Tensor, dist: Tensor) -> Tensor:
    r"""Pixels of the real camera, of pixels of the ideal one with the same K: the lens of Brown and Conrady.

    .. math:: u' = u\,\frac{1 + k_1 r^2 + k_2 r^4 + k_3 r^6}{1 + k_4 r^2 + k_5 r^4 + k_6 r^6}
              + \begin{pmatrix} 2 p_1 u_1 u_2 + p_2 (r^2 + 2 u_1^2) \\ p_1 (r^2 + 2 u_2^2) + 2 p_2 u_1 u_2 \end{pmatrix},
              \qquad u = K^{-1} x,\ r = \|u\|.

    Args:
        x: ``(*batch, n, 2)`` px.
        K: ``(*batch, 3, 3)`` with last row (0, 0, 1).
        dist: ``(*batch, k)``, k = 4, 5 or 8: OpenCV's k1, k2, p1, p2, k3, k4, k5, k6.

    Returns:
        ``(*batch, n, 2)`` px.

    Raises:
        ValueError: other shapes.

    Source: Brown 1966, Decentering distortion of lenses; OpenCV's ``projectPoints``.

    Example:
        >>> import torch
        >>> K = torch.tensor([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]])
        >>> distort(torch.tensor([[820.0, 240.0]]), K, torch.tensor([-0.25, 0.0, 0.0, 0.0])).round(decimals=2).tolist()
        [[695.0, 240.0]]
    """
    _check(x, K, dist)
    return _to_pixels(_distort_ideal(_from_pixels(x, K), _pad_coefficients(dist))[0], K)


def undistort(x: Tensor, K: Tensor, dist: Tensor) -> Tensor:
    r"""Pixels of the ideal camera with the same K, of pixels of the real one: the inverse of :func:`distort`, by Newton's method.

    A lens polynomial folds back far outside the image.  The solution is the one on the near side of the fold: no fold lies
    between it and the principal point.  Derivatives in all arguments are those of the exact inverse.

    Args:
        x: ``(*batch, n, 2)`` px, NaN = missing.
        K: ``(*batch, 3, 3)`` with last row (0, 0, 1).
        dist: ``(*batch, k)``, k = 4, 5 or 8, as for :func:`distort`.

    Returns:
        ``(*batch, n, 2)`` px; NaN where no point of the near side is imaged at x (and where x is NaN).

    Raises:
        ValueError: other shapes (12 and 14 coefficients, fisheye lenses: not supported).

    Source: what ``cv2.undistortPoints(x, K, dist, P=K)`` approximates by five fixed-point steps.

    Example:
        >>> import torch
        >>> K = torch.tensor([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
        >>> dist = torch.tensor([-0.25, 0.0, 0.0, 0.0], dtype=torch.float64)
        >>> undistort(torch.tensor([[695.0, 240.0], [2000.0, 240.0]], dtype=torch.float64), K, dist).round(decimals=6).tolist()
        [[820.0, 240.0], [nan, nan]]
    """
    _check(x, K, dist)
    dtype, x, K, dist = x.dtype, x.double(), K.double(), dist.double()
    target, k = _from_pixels(x, K), _pad_coefficients(dist)
    with torch.no_grad():
        u, solved = _invert(target, k)
    # what has no solution stays out of the derivatives: the principal point, a solution of every lens, stands in for it
    solved = solved[..., None]
    u, target = torch.where(solved, u, 0.0), _from_pixels(torch.where(solved, x, K[..., None, :2, 2]), K)
    # one more step from the solution: it moves nothing, and its derivative is that of the implicit function
    value, jacobian = _distort_ideal(u, k)
    u = u + _solve(jacobian.detach(), target - value)
    return torch.where(solved, _to_pixels(u, K), torch.nan).to(dtype)


def undistort_points(x: Tensor, calibration: Any) -> Tensor:
    """A camera's points without the distortion of its lens: :func:`undistort` for what a user hands over. x
    ``(*batch, n, 2)``, calibration ``(K, dist)``."""
    if calibration is None:
        return x
    if not isinstance(calibration, Sequence) or len(calibration) != 2:
        raise ValueError(f"calibration of a camera must be None or (K, dist), got {type(calibration).__name__}")
    K = torch.as_tensor(calibration[0], dtype=torch.float64, device=x.device)
    if K.shape != (3, 3) or not K.isfinite().all() or K[2].tolist() != [0, 0, 1] or K[0, 0] <= 0 or K[1, 1] <= 0:
        raise ValueError(f"calibration: K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels, got {K.tolist()}")
    if calibration[1] is None:
        return x
    dist = torch.as_tensor(calibration[1], dtype=torch.float64, device=x.device).flatten()
    if not dist.isfinite().all():
        raise ValueError(f"calibration: dist must be finite, got {dist.tolist()}")
    return undistort(x, K, dist)


@dataclass(frozen=True)
class Division:
    r"""The division model: one parameter for the lens of a camera that nobody calibrated."""

    strength: float
    centre: Tensor
    radius: float

    @staticmethod
    def of(x: Tensor, size: Sequence[float] | None = None, strength: float = 0.0) -> Division:
        """Centre and radius of a picture of ``size`` (width, height), or of the box around points ``(..., 2)``, NaN = missing."""
        if size is not None:
            corner = torch.tensor([float(size[0]), float(size[1])], dtype=x.dtype, device=x.device)
            return Division(strength, corner / 2, float(corner.norm()) / 2)
        seen = x.reshape(-1, 2)
        seen = seen[seen.isfinite().all(-1)]
        if not len(seen):
            raise ValueError("no point is seen: the picture's size cannot be guessed; give sizes=((width, height), ...)")
        low, high = seen.amin(0), seen.amax(0)
        return Division(strength, (low + high) / 2, max(float((high - low).norm()) / 2, torch.finfo(x.dtype).tiny))

    def undistort(self, x: Tensor) -> Tensor:
        """Points ``(..., 2)`` without distortion; NaN where the model ends (far outside the picture)."""
        u = (x - self.centre) / self.radius
        bend = self.strength * u.square().sum(-1, keepdim=True)
        # the picture ends where the denominator does (barrel) or where it folds (pincushion)
        return torch.where(bend.abs() < 1, self.centre + self.radius * u / (1 + bend), torch.nan)

    def distort(self, x: Tensor) -> Tensor:
        """The inverse of :meth:`undistort`; NaN where nothing is imaged."""
        u = (x - self.centre) / self.radius
        root = 1 - 4 * self.strength * u.square().sum(-1, keepdim=True)
        return torch.where(root > 0, self.centre + self.radius * 2 * u / (1 + root.clamp(min=0).sqrt()), torch.nan)


def _check(x: Tensor, K: Tensor, dist: Tensor) -> None:
    if x.ndim < 2 or x.shape[-1] != 2:
        raise ValueError(f"points must be (*batch, n, 2), got {tuple(x.shape)}")
    if K.shape[-2:] != (3, 3):
        raise ValueError(f"K must be (*batch, 3, 3), got {tuple(K.shape)}")
    if not dist.ndim or dist.shape[-1] not in COEFFICIENTS:
        raise ValueError(
            f"dist must have 4, 5 or 8 coefficients (OpenCV's k1, k2, p1, p2, k3, k4, k5, k6), got shape {tuple(dist.shape)}: "
            "fisheye, thin prism and tilted lenses are not supported, undistort their points first"
        )


def _pad_coefficients(dist: Tensor) -> Tensor:
    """``(*batch, 1, 8)``."""
    return torch.nn.functional.pad(dist, (0, 8 - dist.shape[-1]))[..., None, :]


def _from_pixels(x: Tensor, K: Tensor) -> Tensor:
    return (homogeneous(x) @ torch.linalg.inv_ex(K)[0].mT)[..., :2]


def _to_pixels(u: Tensor, K: Tensor) -> Tensor:
    return (homogeneous(u) @ K.mT)[..., :2]


def _distort_ideal(u: Tensor, k: Tensor) -> tuple[Tensor, Tensor]:
    """Where the lens images ``u (*batch, n, 2)``, in focal lengths, and the symmetric derivative ``(*batch, n, 2, 2)``."""
    k1, k2, p1, p2, k3, k4, k5, k6 = k.unbind(-1)
    x, y = u.unbind(-1)
    s = x * x + y * y
    above, below = 1 + s * (k1 + s * (k2 + s * k3)), 1 + s * (k4 + s * (k5 + s * k6))
    gain = above / below
    slope = (k1 + s * (2 * k2 + s * 3 * k3) - gain * (k4 + s * (2 * k5 + s * 3 * k6))) / below
    cross = p1 * y + p2 * x
    value = torch.stack([x * gain + 2 * x * cross + p2 * s, y * gain + 2 * y * cross + p1 * s], dim=-1)
    mixed = 2 * slope * x * y + 2 * (p1 * x + p2 * y)
    first = gain + 2 * slope * x * x + 2 * cross + 4 * p2 * x
    second = gain + 2 * slope * y * y + 2 * cross + 4 * p1 * y
    return value, torch.stack([torch.stack([first, mixed], dim=-1), torch.stack([mixed, second], dim=-1)], dim=-2)


def _solve(jacobian: Tensor, misfit: Tensor) -> Tensor:
    """``J^-1 misfit`` of 2 x 2 matrices."""
    (a, b), (c, d) = (row.unbind(-1) for row in jacobian.unbind(-2))
    x, y = misfit.unbind(-1)
    return torch.stack([d * x - b * y, a * y - c * x], dim=-1) / (a * d - b * c)[..., None]


def _invert(target: Tensor, k: Tensor) -> tuple[Tensor, Tensor]:
    """The points imaged at ``target``, and which of them are solutions on the near side of the fold."""
    u = torch.zeros_like(target)
    for step in range(1, CONTINUATION + NEWTON):
        value, jacobian = _distort_ideal(u, k)
        u = u + _solve(jacobian, min(1.0, step / CONTINUATION) * target - value)
    value, _ = _distort_ideal(u, k)
    solved = (value - target).abs().amax(-1) <= SOLVED * (1 + target.abs().amax(-1))
    way = torch.linspace(1 / SAMPLES, 1, SAMPLES, dtype=u.dtype, device=u.device)[:, *([None] * u.ndim)]
    jacobian = _distort_ideal(way * u, k)[1]
    # positive definite: neither folded once (determinant) nor twice (trace)
    first, mixed, _, second = jacobian.flatten(-2).unbind(-1)
    upright = (first * second > mixed.square()) & (first + second > 0)
    return u, solved & upright.all(0)


# ----------------------------------------------------------------------------------------------------------------------
# Lens distortion of two cameras that nobody calibrated, from what they see of the same points at the same moments.
#
# With the division model, a point :math:`u` (from the picture's centre, in half diagonals) is the ray
# :math:`\hat u = (u, 1 + \lambda \|u\|^2)`, and the epipolar constraint stays bilinear in rays:
# :math:`\hat u_b^T F\, \hat u_a = 0`.  Its first-order (Sampson) distance is measured in the pixels as they were seen: a distance
# in straightened pixels would reward shrinking the picture.


RANGE = (-0.8, 0.4)
"""Of lambda: from a fisheye of 150 degrees across the diagonal to more pincushion than any lens sold."""
DESCENT = LeastSquaresOptions(increase=10.0, least_damping=1e-10, stuck_damping=1e3, tolerance=1e-6)
NEAR = 1e-5
"""Of a parameter: the step of a difference."""
STARTS = ((0.0, 0.0), (-0.15, -0.15), (-0.4, -0.4), (-0.3, 0.0), (0.0, -0.3))
"""Strengths of distortion (lambda) of both lenses that the descent starts from; the first is that of no lenses."""
START_ITERATIONS = 4
"""Reweighted fits of the fundamental matrix of each start."""
MAX_MATCHES = 1500
"""Matches that are used: lambda is known to 1e-3 long before."""
NUM_START_MATCHES = 300
"""Matches that choose among the starts."""
MIN_MATCHES = 40
"""Matches below which nothing is said of lenses."""
MAX_SQUARED_DISTANCE = 9.0
"""Squared distance, over the squared scale, up to which it counts."""
NUM_FOLDS = 4
"""Parts of the matches, each of which lenses fitted to the others must explain better than no lenses do."""
MIN_F_RATIO = 12.0
"""F ratio of 2 and n - 9 degrees of freedom from which on distortion is there: 1e-5 of ideal cameras exceed it."""


@dataclass(frozen=True)
class LensFit:
    """Lenses of two cameras."""

    lenses: tuple[Division, Division]  # the division models of a and b, which straighten points
    sigmas: tuple[float, float]  # standard deviations of the two lambda, as if errors were independent
    gain: float  # share of the median Sampson distance that distortion explains, in [0, 1]
    significant: bool  # whether distortion is really there

    @property
    def lambda_a(self) -> float:
        """Of the first camera; negative = barrel.  Of a batch ``(*batch,)``."""
        return _number(self.lenses[0].strength)

    @property
    def lambda_b(self) -> float:
        """Of the second camera."""
        return _number(self.lenses[1].strength)

    @property
    def note(self) -> str:
        """What a user should know where the fit is used."""
        text = "lens distortion fitted, lambda = {a:+.3f} and {b:+.3f}: an approximation; give "
        return Message(text + "{arg:calibration=((K, dist), (K, dist))}", a=self.lambda_a, b=self.lambda_b)


def _number(value: Any) -> Any:
    """A number, or those of a batch ``(*batch, 1, 1)`` as ``(*batch,)``."""
    return value[..., 0, 0] if isinstance(value, Tensor) else value


def _fit_batch(a: Tensor, b: Tensor, weights: Tensor | None, sizes: Sequence[Sequence[float] | None] | None) -> LensFit:
    """All pairs of cameras one after the other: their descents share nothing."""
    batch = check_together(a=(a, 2), b=(b, 2))
    if not prod(batch) or a.shape[-2:] != b.shape[-2:] or a.shape[-1] != 2:
        raise ValueError(f"matches must be (*batch, N, 2) in both cameras, got {tuple(a.shape)} and {tuple(b.shape)}")
    if weights is not None and weights.shape[-1:] != a.shape[-2:-1]:
        raise ValueError(f"weights must be (*batch, {a.shape[-2]}), one per match, got {tuple(weights.shape)}")
    x, y = (part.expand(*batch, *part.shape[-2:]).flatten(0, -3) for part in (a, b))
    w = torch.ones_like(x[..., 0]) if weights is None else weights.expand(*batch, a.shape[-2]).flatten(0, -2)
    seen = (x.isfinite() & y.isfinite()).all(-1) & (w > 0)
    if not bool(seen.any()):
        raise ValueError("no point is seen in any problem: the picture's size cannot be guessed; give matches")
    # where a pair shows nothing its lenses change nothing
    none = Division(0.0, x.new_zeros(2, dtype=torch.float64), 1.0)
    bare = LensFit((none, none), (torch.inf, torch.inf), 0.0, False)
    found = [fit_distortion(p, q, v, sizes) if bool(some.any()) else bare for p, q, v, some in zip(x, y, w, seen, strict=True)]

    def numbers(values: Sequence[Any]) -> Any:
        return torch.tensor(values, dtype=torch.bool if isinstance(values[0], bool) else torch.float64, device=a.device).reshape(
            batch
        )

    lenses = []
    for pair in zip(*(one.lenses for one in found), strict=True):
        strength, radius = (numbers([getattr(lens, name) for lens in pair])[..., None, None] for name in ("strength", "radius"))
        lenses.append(Division(strength, torch.stack([lens.centre for lens in pair]).reshape(*batch, 1, 2), radius))
    sigmas = [numbers(part) for part in zip(*(one.sigmas for one in found), strict=True)]
    gain, significant = numbers([one.gain for one in found]), numbers([one.significant for one in found])
    return LensFit((lenses[0], lenses[1]), (sigmas[0], sigmas[1]), gain, significant)


@one_thread
@on_cpu
def fit_distortion(
    a: Tensor,
    b: Tensor,
    weights: Tensor | None = None,
    sizes: Sequence[Sequence[float] | None] | None = None,
) -> LensFit:
    r"""One parameter of radial distortion per camera, and whether it is there:

    .. math:: \min_{\lambda_a, \lambda_b, \operatorname{rank} F = 2} \sum_k w_k \min(d_k^2 / s^2,\, 9), \qquad
              d = \frac{\hat u_b^T F\, \hat u_a}{\|\partial / \partial(x_a, x_b)\|}, \quad \hat u = (u, 1 + \lambda \|u\|^2),

    with the robust scale s.  Distortion is significant where an F-test says so, and where lenses fitted without a quarter of the
    matches (in the order given: time) explain that quarter better than no lenses do, for each of the four.

    A search: it computes on the CPU wherever its tensors are, and the result returns to their device.

    Args:
        a, b: ``(*batch, N, 2)`` px, matches in the order of time; NaN = none.
        weights: ``(*batch, N)``, 0 = ignore.
        sizes: (width, height) of the pictures; without, the boxes of the points stand in for them.

    Returns:
        Lenses that straighten the two cameras' points; lambda = 0 and not significant where there are too few matches.  Of a batch
        all numbers are tensors ``(*batch,)``, each pair of cameras is fitted by itself, and the lenses straighten points ``(*batch,
        n, 2)``.

    Raises:
        ValueError: other shapes, negative weights, or no match at all.

    Source: Fitzgibbon 2001, Simultaneous linear estimation of multiple view geometry and lens distortion; the Sampson distance
        in measured pixels, as in Barreto and Daniilidis 2005.

    Example:
        >>> import torch
        >>> from dyntorch.scenes import two_view
        >>> views = two_view(200, generator=torch.Generator().manual_seed(0)).views
        >>> lens = Division.of(views[0], (640, 480), strength=-0.2)
        >>> seen = [lens.distort(x) for x in views]
        >>> fit = fit_distortion(*seen, sizes=((640, 480), (640, 480)))
        >>> round(fit.lambda_a, 4), round(fit.lambda_b, 4), fit.significant
        (-0.2, -0.2, True)
    """
    if a.ndim > 2 or b.ndim > 2:
        return _fit_batch(a, b, weights, sizes)
    if a.ndim != 2 or a.shape[-1] != 2 or a.shape != b.shape:
        raise ValueError(f"matches must be (N, 2) in both cameras, got {tuple(a.shape)} and {tuple(b.shape)}")
    weights = torch.ones(len(a)) if weights is None else weights
    if weights.shape != a.shape[:1]:
        raise ValueError(f"weights must be ({len(a)},), one per match, got {tuple(weights.shape)}")
    check_weights(weights, "a match")
    sizes = (None, None) if sizes is None else sizes
    chosen = (a.isfinite().all(-1) & b.isfinite().all(-1) & (weights > 0)).nonzero().flatten()
    ideal = Division.of(a[chosen].double(), sizes[0]), Division.of(b[chosen].double(), sizes[1])
    if len(chosen) < MIN_MATCHES:
        return LensFit(ideal, (torch.inf, torch.inf), 0.0, False)
    data = LensMatches.of(a[chosen].double(), b[chosen].double(), weights[chosen].double(), ideal).subset(MAX_MATCHES)
    plain, full = _fit_lenses(data)
    scale = _scale(data, full)
    plain, full = plain.descend(data, scale, lens=False), full.descend(data, scale, lens=True)
    before, after = (float(fit.cost(data, scale)) for fit in (plain, full))
    free = float((data.weights / data.weights.max()).sum()) - 9
    strength = full.lens[0]
    inside = bool(((strength > RANGE[0]) & (strength < RANGE[1])).all())
    clear = inside and free > 0 and (before - after) / 2 > MIN_F_RATIO * max(after, TINY) / free
    significant = clear and all(_holds(data, plain, full, scale, fold) for fold in range(NUM_FOLDS))
    lenses = tuple(Division(float(value), one.centre, one.radius) for value, one in zip(strength, ideal, strict=True))
    sigma = full.sigmas(data, scale) * max(after / max(free, 1.0), 0.0) ** 0.5
    gain = 1 - float(_median(full.distances(data), data.weights) / _median(plain.distances(data), data.weights))
    return LensFit((lenses[0], lenses[1]), (float(sigma[0]), float(sigma[1])), max(0.0, gain), significant)


@dataclass(frozen=True)
class LensMatches:
    """Points from the centres of their pictures, in half diagonals."""

    a: Tensor
    """``(N, 2)``."""
    b: Tensor
    weights: Tensor
    """``(N,)``."""
    radii: tuple[float, float]
    """px."""

    @staticmethod
    def of(a: Tensor, b: Tensor, weights: Tensor, ideal: tuple[Division, Division]) -> LensMatches:
        """Of pixels."""
        first, second = ((x - lens.centre) / lens.radius for x, lens in zip((a, b), ideal, strict=True))
        return LensMatches(first, second, weights, (ideal[0].radius, ideal[1].radius))

    def subset(self, count: int) -> LensMatches:
        """As many of them, evenly spread."""
        n = len(self.a)
        chosen = torch.arange(min(count, n), device=self.a.device) * n // min(count, n)
        return LensMatches(self.a[chosen], self.b[chosen], self.weights[chosen], self.radii)

    def with_weights(self, weights: Tensor) -> LensMatches:
        """The same matches with other weights."""
        return LensMatches(self.a, self.b, weights, self.radii)

    def distances(self, F: Tensor, lens: Tensor) -> Tensor:
        """Signed Sampson distances ``(B, N)`` in px, of F ``(B, 3, 3)`` and lambda ``(B, 2)``."""
        strength_a, strength_b = lens[:, None, :1], lens[:, None, 1:]
        p, q = _rays(self.a, strength_a), _rays(self.b, strength_b)
        onto_b, onto_a = p @ F.mT, q @ F
        value = (q * onto_b).sum(-1)
        by_a = (onto_a[..., :2] + 2 * strength_a * self.a * onto_a[..., 2:]) / self.radii[0]
        by_b = (onto_b[..., :2] + 2 * strength_b * self.b * onto_b[..., 2:]) / self.radii[1]
        return value / (by_a.square().sum(-1) + by_b.square().sum(-1)).clamp(min=TINY).sqrt()


def _rays(u: Tensor, strength: Tensor) -> Tensor:
    third = 1 + strength * u.square().sum(-1, keepdim=True)
    return torch.cat([u.expand(*third.shape[:-1], 2), third], dim=-1)


@dataclass(frozen=True)
class LensDescent:
    """Fundamental matrices of rays and the lenses, B of them."""

    frames: Frames
    lens: Tensor
    """``(B, 2)``."""

    def retract(self, step: Tensor) -> LensDescent:
        """After a step ``(B, 9)``: seven parameters of F, two lambda."""
        return LensDescent(self.frames.retract(step[:, :7]), self.lens + step[:, 7:])

    def distances(self, data: LensMatches) -> Tensor:
        """``(B, N)`` px."""
        return data.distances(self.frames.matrix().unflatten(-1, (3, 3)), self.lens)

    def cost(self, data: LensMatches, scale: Tensor) -> Tensor:
        """Truncated squared distances ``(B,)`` in units of ``scale``."""
        return ((self.distances(data) / scale).square().clamp(max=MAX_SQUARED_DISTANCE) * data.weights).sum(-1)

    def lowest_cost(self, data: LensMatches, scale: Tensor) -> LensDescent:
        """The one with the least cost."""
        k = int(self.cost(data, scale).argmin())
        return LensDescent(Frames(self.frames.turns[k : k + 1], self.frames.core[k : k + 1]), self.lens[k : k + 1])

    def descend(self, data: LensMatches, scale: Tensor, *, lens: bool) -> LensDescent:
        """At the minimum next to it, with the lenses or without."""
        free = torch.ones_like(self.lens[0]).repeat_interleave(5)[:9]
        free[7:] = float(lens)
        problem = LensProblem(data, scale.expand(len(self.lens), 1), free)
        return LensProblem.lenses(minimize(problem, problem.evaluate((self.frames.turns, self.frames.core, self.lens)), DESCENT))

    def normal_equations(self, data: LensMatches, scale: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient ``(B, 9)`` and Gauss-Newton matrix ``(B, 9, 9)`` of half the cost."""
        away = self.distances(data) / scale
        # central differences: exact to 1e-10, and four times faster than jacfwd
        near = NEAR * torch.eye(9, dtype=away.dtype, device=away.device)
        turns, core, lens = (part.repeat_interleave(18, dim=0) for part in (self.frames.turns, self.frames.core, self.lens))
        moved = LensDescent(Frames(turns, core), lens).retract(torch.cat([near, -near]).repeat(len(away), 1))
        ahead, behind = moved.distances(data).unflatten(0, (-1, 2, 9)).unbind(1)
        jacobian = ((ahead - behind) / (2 * NEAR)).mT / scale[..., None]
        weighted = (data.weights * (away.square() < MAX_SQUARED_DISTANCE))[..., None] * jacobian
        return (weighted * away[..., None]).sum(1), weighted.mT @ jacobian

    def sigmas(self, data: LensMatches, scale: Tensor) -> Tensor:
        """Standard deviations ``(2,)`` of lambda for errors of one ``scale``."""
        matrix = self.normal_equations(data, scale)[1][0]
        if not bool(matrix.isfinite().all()):
            return matrix.new_full((2,), torch.inf)
        return torch.linalg.pinv(matrix, hermitian=True).diagonal()[7:].clamp(min=0).sqrt()


@dataclass(frozen=True)
class LensProblem(LeastSquares):
    """Truncated distances in the turns, the core of :class:`Frames` and the lenses of a :class:`LensDescent`."""

    data: LensMatches
    scale: Tensor
    """``(B, 1)`` px."""
    free: Tensor
    """``(9,)``, 0 for parameters that stay as they are."""

    @staticmethod
    def lenses(at: Iterate | Minimum) -> LensDescent:
        """As matrices and lenses."""
        return LensDescent(Frames(*at.theta[:2]), at.theta[2])

    def subset(self, keep: Tensor) -> LensProblem:
        """Only some of the starts."""
        return LensProblem(self.data, self.scale[keep], self.free)

    def evaluate(self, theta: Tensors) -> Iterate:
        """With lenses that are sold."""
        at = Iterate((*theta[:2], theta[2].clamp(*RANGE)), self.scale[:, 0], ())
        return at._replace(cost=self.lenses(at).cost(self.data, self.scale))

    def step(self, at: Iterate, damping: Tensor) -> Tensors:
        """Of the nine parameters."""
        return (damped_step(*self.lenses(at).normal_equations(self.data, self.scale), damping, self.free),)

    def retract(self, theta: Tensors, step: Tensors) -> Tensors:
        """The frames turned, the lenses changed."""
        fresh = LensDescent(Frames(*theta[:2]), theta[2]).retract(-step[0])
        return fresh.frames.turns, fresh.frames.core, fresh.lens


def _fit_lenses(data: LensMatches) -> tuple[LensDescent, LensDescent]:
    """The best fits without and with lenses."""
    few = data.subset(NUM_START_MATCHES)
    lens = torch.tensor(STARTS, dtype=data.a.dtype, device=data.a.device)
    F = torch.cat([_start(few, one) for one in lens])
    every = LensDescent(Frames.of(F), lens)
    scale = _scale(few, every).min()
    plain = LensDescent(Frames.of(F[:1]), lens[:1]).descend(few, scale, lens=False)
    # what explains the points without lenses is a start, too
    every = LensDescent(Frames.of(torch.cat([F, plain.frames.matrix().unflatten(-1, (3, 3))])), torch.cat([lens, lens[:1]]))
    return plain, every.descend(few, scale, lens=True).lowest_cost(few, scale)


def _start(data: LensMatches, lens: Tensor) -> Tensor:
    """F ``(1, 3, 3)`` of straightened points, weighed again by the distances a few times."""
    p, q = _rays(data.a, lens[:1]), _rays(data.b, lens[1:])
    weights = data.weights[None]
    for _ in range(START_ITERATIONS):
        F = eight_point(p[:, :2] / p[:, 2:], q[:, :2] / q[:, 2:], weights, rounds=1)
        away = data.distances(F, lens[None])
        weights = data.weights / (1 + (away / _median(away, data.weights)[:, None]).square())
    return F


def _median(away: Tensor, weights: Tensor) -> Tensor:
    return away[:, weights > 0].abs().median(-1).values.clamp(min=1e-9)


def _scale(data: LensMatches, fit: LensDescent) -> Tensor:
    """Robust standard deviation of the distances, ``(B, 1)`` px."""
    return 1.4826 * _median(fit.distances(data), data.weights)[:, None]


def _holds(data: LensMatches, plain: LensDescent, full: LensDescent, scale: Tensor, fold: int) -> bool:
    """Whether lenses fitted without one part of the matches explain that part better than no lenses do."""
    place = torch.arange(len(data.weights), device=data.weights.device) * NUM_FOLDS // len(data.weights)
    rest, part = (data.with_weights(data.weights * own) for own in (place != fold, place == fold))
    costs = [fit.descend(rest, scale, lens=lens).cost(part, scale) for fit, lens in ((plain, False), (full, True))]
    return bool(costs[1] < costs[0])
