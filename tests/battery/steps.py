"""Points at constant velocity before a sensor at rest: what no camera over the plane can be told from."""

from __future__ import annotations

import torch
from torch import Tensor


def equal_steps(
    n: int, *, still: float, speed: float = 40.0, sigma: float = 0.5, generator: torch.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Three views ``(n, 2)`` of points that make the same step twice, in pixels; a share of them stands still."""
    places = torch.rand(n, 2, generator=generator, dtype=torch.float64) * torch.tensor([640.0, 480.0], dtype=torch.float64)
    step = speed * torch.randn(n, 2, generator=generator, dtype=torch.float64)
    step[: round(still * n)] = 0
    first, second, third = (
        places + k * step + sigma * torch.randn(n, 2, generator=generator, dtype=torch.float64) for k in range(3)
    )
    return first, second, third


def convoy(
    batch: int, n: int, *, still: int, step: tuple[float, ...], sigma: float, size: float, generator: torch.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Three views ``(batch, n, d)`` of points in a cube of which the first ``still`` stand still and all others make one step."""
    places = size * torch.rand(batch, n, len(step), generator=generator, dtype=torch.float64)
    moves = torch.tensor(step, dtype=torch.float64) * (torch.arange(n) >= still)[:, None]
    first, second, third = (
        places + k * moves + sigma * torch.randn(places.shape, generator=generator, dtype=torch.float64) for k in range(3)
    )
    return first, second, third
