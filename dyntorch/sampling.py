"""Random numbers from the caller's generator, wherever it lives."""

from __future__ import annotations

import torch
from torch import Tensor


class Draws:
    """A stream of random numbers for each problem of a batch: what one gets does not depend on how the others fare.

    Args:
        count: problems.
        generator: source of the seeds, one for each problem in their order; None is torch's global one.
        device: of the results.

    Example:
        >>> import torch
        >>> def draws():
        ...     return Draws(3, torch.Generator().manual_seed(0), torch.device("cpu"))
        >>> bool(torch.equal(draws()(torch.arange(3), 4)[2], draws()(torch.tensor([2]), 4)[0]))
        True
    """

    def __init__(self, count: int, generator: torch.Generator | None, device: torch.device) -> None:
        home, self.device = device if generator is None else generator.device, device
        seeds = torch.randint(2**62, (count,), generator=generator, device=home).tolist()
        self.streams = [torch.Generator(device=home).manual_seed(seed) for seed in seeds]

    def __call__(self, where: Tensor, *shape: int) -> Tensor:
        """The next numbers in [0, 1) of some problems, ``(problems, *shape)`` float64."""
        drawn = [
            torch.rand(*shape, generator=self.streams[i], dtype=torch.float64, device=self.streams[i].device)
            for i in where.tolist()
        ]
        return torch.stack(drawn).to(self.device) if drawn else torch.zeros(0, *shape, dtype=torch.float64, device=self.device)


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
