"""Lens distortion: of calibrated lenses, put on and removed, and the one-parameter model of lenses that nobody calibrated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dyntorch.algebra.homogeneous import homogeneous

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
    return _to_pixels(_bent(_from_pixels(x, K), _padded(dist))[0], K)


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
    target, k = _from_pixels(x, K), _padded(dist)
    with torch.no_grad():
        u, solved = _invert(target, k)
    # what has no solution stays out of the derivatives: the principal point, a solution of every lens, stands in for it
    solved = solved[..., None]
    u, target = torch.where(solved, u, 0.0), _from_pixels(torch.where(solved, x, K[..., None, :2, 2]), K)
    # one more step from the solution: it moves nothing, and its derivative is that of the implicit function
    value, jacobian = _bent(u, k)
    u = u + _solve(jacobian.detach(), target - value)
    return torch.where(solved, _to_pixels(u, K), torch.nan).to(dtype)


def undistorted(x: Tensor, calibration: Any) -> Tensor:
    """A camera's points without the distortion of its lens: :func:`undistort` for what a user hands over.

    Args:
        x: ``(*batch, n, 2)`` px, NaN = missing.
        calibration: None (x is returned), or ``(K, dist)``, tensors, arrays or lists: K ``(3, 3)``, dist ``(4,)``, ``(5,)`` or
            ``(8,)`` in OpenCV's order; dist may be None.

    Returns:
        The shape and dtype of x.

    Raises:
        ValueError: no such pair, or numbers that are no calibration.

    Example:
        >>> import torch
        >>> undistorted(torch.tensor([[3.0, 4.0]]), ([[100, 0, 3], [0, 100, 4], [0, 0, 1]], [-0.1, 0, 0, 0])).tolist()
        [[3.0, 4.0]]
    """
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
    r"""The division model: one parameter for the lens of a camera that nobody calibrated.

    .. math:: x_u = c + \frac{x_d - c}{1 + \lambda\,\|x_d - c\|^2 / R^2}

    Attributes:
        strength: :math:`\lambda`; negative = barrel.  At distance R from the centre the picture grows by 1 / (1 + lambda).
        centre: ``(2,)`` px.
        radius: R, px: half the picture's diagonal.

    Source: Fitzgibbon 2001, Simultaneous linear estimation of multiple view geometry and lens distortion.

    Example:
        >>> import torch
        >>> lens = Division(-0.2, torch.tensor([320.0, 240.0]), 400.0)
        >>> lens.undistort(torch.tensor([[720.0, 240.0]])).tolist()
        [[820.0, 240.0]]
    """

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


def _padded(dist: Tensor) -> Tensor:
    """``(*batch, 1, 8)``."""
    return torch.nn.functional.pad(dist, (0, 8 - dist.shape[-1]))[..., None, :]


def _from_pixels(x: Tensor, K: Tensor) -> Tensor:
    return (homogeneous(x) @ torch.linalg.inv_ex(K)[0].mT)[..., :2]


def _to_pixels(u: Tensor, K: Tensor) -> Tensor:
    return (homogeneous(u) @ K.mT)[..., :2]


def _bent(u: Tensor, k: Tensor) -> tuple[Tensor, Tensor]:
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
        value, jacobian = _bent(u, k)
        u = u + _solve(jacobian, min(1.0, step / CONTINUATION) * target - value)
    value, _ = _bent(u, k)
    solved = (value - target).abs().amax(-1) <= SOLVED * (1 + target.abs().amax(-1))
    way = torch.linspace(1 / SAMPLES, 1, SAMPLES, dtype=u.dtype, device=u.device)[:, *([None] * u.ndim)]
    jacobian = _bent(way * u, k)[1]
    # positive definite: neither folded once (determinant) nor twice (trace)
    first, mixed, _, second = jacobian.flatten(-2).unbind(-1)
    upright = (first * second > mixed.square()) & (first + second > 0)
    return u, solved & upright.all(0)
