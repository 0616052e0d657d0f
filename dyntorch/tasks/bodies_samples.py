"""Segmentations by geometry alone, from samples of seven matches: bodies that interleave, outliers among them."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from dyntorch.tasks.bodies_energy import View
from dyntorch.tasks.bodies_search import Candidate


def search_samples(view: View, counts: Sequence[int], generator: torch.Generator | None) -> dict[int, list[Candidate]]:
    """Segmentations into each number of bodies, the cheapest first."""
    raise NotImplementedError
