"""The choice of a motion model by penalized cost."""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.tasks.lifted_projections import Tracks
from dyntorch.tasks.reconstruction import Reconstruction


def choose(
    tracks: Tracks, static: Tensor | None, limit: float | None, generator: torch.Generator | None, batch: tuple[int, ...]
) -> Reconstruction:
    """Reconstruct with the declared model of least penalized cost; the others are listed in ``candidates``."""
    raise NotImplementedError
