"""Probabilities of labels that neighbours share: the mean field of costs and links."""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.tasks.coherence import Links


def mean_field(cost: Tensor, links: Links, cut: float, turns: int, start: Tensor | None = None) -> Tensor:
    """Probabilities of labels ``(*batch, K, n)`` that cost so much, with ``cut`` times the links between different labels.

    Turns are damped by half, from ``start`` or from the labels of each match alone.
    """
    member = torch.softmax(-cost, -2) if start is None else start
    for _ in range(turns):
        member = 0.5 * (member + torch.softmax(cut * links.pull(member) - cost, -2))
    return member
