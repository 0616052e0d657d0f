"""Random numbers from the caller's generator, wherever it lives."""

from __future__ import annotations

import torch
from torch import Tensor


def uniform(*shape: int, generator: torch.Generator | None, device: torch.device) -> Tensor:
    """Numbers in [0, 1), float64, drawn on the device of the generator (None: on ``device``) and moved to ``device``.

    Args:
        *shape: of the result.
        generator: source of the numbers; None is torch's global one.
        device: of the result.

    Example:
        >>> import torch
        >>> uniform(2, 3, generator=torch.Generator().manual_seed(0), device=torch.device("cpu")).shape
        torch.Size([2, 3])
    """
    home = device if generator is None else generator.device
    return torch.rand(*shape, generator=generator, dtype=torch.float64, device=home).to(device)
