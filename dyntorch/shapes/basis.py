r"""How points move with the time: the functions :math:`c_b(t)` of :math:`P(t) = \sum_b c_b(t)\,P_b`, the first of them constant."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor


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
