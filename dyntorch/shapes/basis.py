r"""How points move with the time: the functions :math:`c_b(t)` of :math:`P(t) = \sum_b c_b(t)\,P_b`, the first of them constant."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.numerics.blocks import constant
from dyntorch.numerics.nullspace import null_space
from dyntorch.shapes.static import canonical, general_rows


@dataclass(frozen=True)
class Polynomial:
    r"""Polynomial trajectories: Chebyshev polynomials :math:`T_0, \dots, T_r` of the time mapped to [-1, 1].

    Args:
        degree: r; 1 is constant velocity, 0 a static shape.

    Raises:
        ValueError: a negative degree.

    Source: Trefethen, Approximation Theory and Approximation Practice: the well-conditioned basis on an interval.

    Example:
        >>> import torch
        >>> Polynomial(2).rows(torch.tensor([-1.0, 0.0, 0.5])).tolist()
        [[1.0, -1.0, 1.0], [1.0, 0.0, -1.0], [1.0, 0.5, -0.5]]
    """

    degree: int = 1

    def __post_init__(self) -> None:
        if self.degree < 0:
            raise ValueError(f"degree must be 0 or more, got {self.degree}; 1 is constant velocity")

    @property
    def size(self) -> int:
        """Number of functions."""
        return self.degree + 1

    @property
    def period(self) -> float | None:
        """None: no time comes back."""
        return None

    def power(self, times: int) -> Polynomial:
        """The basis of all products of so many of these functions."""
        return Polynomial(times * self.degree)

    def rows(self, times: Tensor) -> Tensor:
        """Values ``(*batch, size)`` at times ``(*batch,)``, which are meant to be in [-1, 1]."""
        values = [torch.ones_like(times), times]
        for _ in range(2, self.size):
            values.append(2 * times * values[-1] - values[-2])
        return torch.stack(values[: self.size], dim=-1)

    def slopes(self, times: Tensor) -> Tensor:
        """Derivatives ``(*batch, size)`` by the time."""
        # T_b' = b U_{b-1}, with the polynomials U of the second kind
        values = [torch.ones_like(times), 2 * times]
        for _ in range(2, self.size):
            values.append(2 * times * values[-1] - values[-2])
        slopes = [torch.zeros_like(times), *(b * values[b - 1] for b in range(1, self.size))]
        return torch.stack(slopes[: self.size], dim=-1)

    def unit(self, times: Tensor, interval: Tensor) -> Tensor:
        """Times ``(*batch, n)`` at which ``interval (*batch, 2)`` is mapped to [-1, 1]."""
        low, high = interval[..., :1], interval[..., 1:]
        return (2 * times - low - high) / torch.where(high > low, high - low, 1.0)

    def time(self, unit: Tensor, interval: Tensor) -> Tensor:
        """The inverse of :meth:`unit`."""
        low, high = interval[..., :1], interval[..., 1:]
        return (low + high) / 2 + unit * torch.where(high > low, high - low, 1.0) / 2

    def nodes(self, count: int) -> Tensor:
        """So many times, float64, at which a polynomial is best sampled."""
        return (math.pi * (torch.arange(count, dtype=torch.float64) + 0.5) / count).cos()


@dataclass(frozen=True)
class Fourier:
    r"""Periodic trajectories: :math:`1, \cos k \omega t, \sin k \omega t` for k = 1 ... h, :math:`\omega = 2\pi/p`.

    Args:
        harmonics: h.
        period: p, in the unit of the times (2 pi: the times are phases in radians).

    Raises:
        ValueError: negative harmonics, or a period that is not positive and finite.

    Source: thesis chapter 4 (dynamic shape tensors of periodic motion).

    Example:
        >>> import torch
        >>> Fourier(1, period=4.0).rows(torch.tensor([0.0, 1.0])).round().tolist()
        [[1.0, 1.0, 0.0], [1.0, -0.0, 1.0]]
    """

    harmonics: int = 1
    period: float = 2 * math.pi

    def __post_init__(self) -> None:
        if self.harmonics < 0:
            raise ValueError(f"harmonics must be 0 or more, got {self.harmonics}")
        if not 0 < self.period < math.inf:
            raise ValueError(f"period must be positive, in the unit of the times, got {self.period}")

    @property
    def size(self) -> int:
        """Number of functions."""
        return 2 * self.harmonics + 1

    def power(self, times: int) -> Fourier:
        """The basis of all products of so many of these functions."""
        return Fourier(times * self.harmonics, self.period)

    def rows(self, times: Tensor) -> Tensor:
        """Values ``(*batch, size)`` at times ``(*batch,)``."""
        angles = self._angles(times)
        waves = torch.stack([angles.cos(), angles.sin()], dim=-1).flatten(-2)
        return torch.cat([torch.ones_like(times)[..., None], waves], dim=-1)

    def slopes(self, times: Tensor) -> Tensor:
        """Derivatives ``(*batch, size)`` by the time."""
        angles, speed = self._angles(times), self._speeds(times)
        waves = torch.stack([-speed * angles.sin(), speed * angles.cos()], dim=-1).flatten(-2)
        return torch.cat([torch.zeros_like(times)[..., None], waves], dim=-1)

    def unit(self, times: Tensor, interval: Tensor) -> Tensor:
        """The times brought to [0, period), in which they keep their digits."""
        return times.remainder(self.period)

    def time(self, unit: Tensor, interval: Tensor) -> Tensor:
        """The times brought to [0, period)."""
        return unit.remainder(self.period)

    def nodes(self, count: int) -> Tensor:
        """So many times, float64, over the period."""
        return torch.arange(count, dtype=torch.float64) * (self.period / count)

    def _speeds(self, like: Tensor) -> Tensor:
        return torch.arange(1, self.harmonics + 1, dtype=like.dtype, device=like.device) * (2 * math.pi / self.period)

    def _angles(self, times: Tensor) -> Tensor:
        return times[..., None] * self._speeds(times)


Trajectory = Polynomial | Fourier


def times_of_views(times: Tensor, points: Tensor) -> Tensor:
    """Times ``(*batch, views)`` of points ``(*batch, views, n, d)``, in the wider dtype of the two."""
    given = torch.as_tensor(times, device=points.device)
    try:
        return given.to(torch.promote_types(given.dtype, points.dtype)).expand(points.shape[:-2])
    except RuntimeError:
        shape = tuple(points.shape[:-2])
        raise ValueError(f"times must be (*batch, views) = {shape} or (views,), got {tuple(given.shape)}") from None


def extremes(times: Tensor) -> Tensor:
    """First and last finite time ``(*batch, 2)``."""
    known = times.isfinite()
    low = torch.where(known, times, torch.inf).amin(-1)
    high = torch.where(known, times, -torch.inf).amax(-1)
    some = known.any(-1)
    return torch.stack([torch.where(some, low, -1.0), torch.where(some, high, 1.0)], dim=-1)


# ----------------------------------------------------------------------------------------------------------------------
# Moving shapes that few points and projective cameras determine: for understanding and tests, too ill-conditioned for noise.


SIX_DEGREE = 9
"""Degree in the time of the dual fundamental matrix of six points of constant velocity."""


def six_point_rows(x: Tensor, times: Tensor) -> Tensor:
    r"""Rows of :math:`p_5^T F(t)\, p_6 = 0` for six points of constant velocity and projective cameras, F of degree 9 in t. x
    ``(*batch, views, 6, 2)``, times ``(*batch, views)`` -> ``(*batch, views, 50)``."""
    row = general_rows(_homogeneous(x, 6))[..., 0, :]
    return (Polynomial(SIX_DEGREE).rows(times)[..., None] * row[..., None, :]).flatten(-2)


def reference_plane_rows(x: Tensor, times: Tensor) -> Tensor:
    r"""Rows of :math:`(p_5 \times p_6)^T (e_0 + e_1 t + e_2 t^2) = 0`: four static coplanar points and two of constant
    velocity. x ``(*batch, views, 6, 2)``, times ``(*batch, views)`` -> ``(*batch, views, 9)``."""
    first, second = canonical(_homogeneous(x, 6))[0].unbind(-2)
    line = torch.linalg.cross(first, second)
    return (Polynomial(2).rows(times)[..., None] * line[..., None, :]).flatten(-2)


def moving_point(x: Tensor, times: Tensor) -> Tensor:
    r"""The affine coordinates of a point of constant velocity in four static ones:
    :math:`x_5 = \sum_i (\alpha_i + t \beta_i) x_i`. x ``(*batch, views, 5, 2)``, times ``(*batch, views)`` ->
    ``(*batch, 2, 4)``."""
    if x.shape[-2] != 5 or x.shape[-3] < 3:
        raise ValueError(f"x must be (*batch, views >= 3, 5, 2), got {tuple(x.shape)}")
    differences = x[..., [0, 1, 2, 4], :] - x[..., 3:4, :]
    known = (times[..., None, None, None] ** torch.arange(2, device=x.device)[:, None, None]) * differences[..., None, :3, :]
    matrix = known.flatten(-3, -2).mT.flatten(-3, -2)  # (.., 2 views, 6)
    right = differences[..., 3, :].flatten(-2)
    q, r = torch.linalg.qr(matrix)
    found = torch.linalg.solve_triangular(r, q.mT @ right[..., None], upper=True)[..., 0].unflatten(-1, (2, 3))
    total = torch.tensor([1.0, 0.0], dtype=x.dtype, device=x.device)
    return torch.cat([found, (total - found.sum(-1))[..., None]], dim=-1)


def resultant(annihilator: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    r"""The condition on a view of five points at an unknown time, and that time. annihilator ``(*batch, d + 1, 5, 1)``, x
    ``(*batch, 5, 2)`` -> ``(*batch,)``."""
    if x.shape[-2] != 5 or annihilator.shape[-2:] != (5, 1):
        raise ValueError(f"a resultant takes five points, got {tuple(annihilator.shape)} and {tuple(x.shape)}")
    centred = x - x.mean(-2, keepdim=True)
    chebyshev = torch.einsum("...ki,...id->...dk", annihilator[..., 0], centred)
    degree = chebyshev.shape[-1] - 1
    powers = chebyshev @ _to_powers(degree, x.device)  # (.., 2, d + 1), lowest first
    powers = powers / powers.norm(dim=-1, keepdim=True).clamp(min=torch.finfo(x.dtype).tiny)
    shifted = [torch.nn.functional.pad(powers, (k, degree - 1 - k)) for k in range(degree)]
    sylvester = torch.stack(shifted, dim=-2).flatten(-3, -2)  # rows t^k p, t^k q; columns 1, t, ..., t^{2 d - 1}
    null = null_space(sylvester)[..., 0, :]
    # all ratios of neighbours are the root: least squares
    low, high = null[..., :-1], null[..., 1:]
    root = (low * high).sum(-1) / low.square().sum(-1).clamp(min=torch.finfo(x.dtype).tiny)
    return torch.linalg.det(sylvester), root


@constant
def _to_powers(degree: int, device: torch.device) -> Tensor:
    """From Chebyshev coefficients to those of powers, ``(d + 1, d + 1)``."""
    nodes = Polynomial(degree).nodes(degree + 1)
    vandermonde = nodes[:, None] ** torch.arange(degree + 1)
    return torch.linalg.solve(vandermonde, Polynomial(degree).rows(nodes)).mT.to(device)


def _homogeneous(x: Tensor, count: int) -> Tensor:
    if x.shape[-2:] != (count, 2):
        raise ValueError(f"x must be (*batch, views, {count}, 2), got {tuple(x.shape)}")
    return torch.cat([x, torch.ones_like(x[..., :1])], dim=-1)
