"""Labels and epipolar geometries in turns, from many starts at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.algebra.epipolar import sampson_squared
from dyntorch.algebra.epipolar_descent import descend
from dyntorch.tasks.bodies_energy import View, energy
from dyntorch.tasks.bodies_field import mean_field
from dyntorch.tasks.bodies_pool import LEAST, SMOOTH, TRUNCATED, Starts, one_hot

SCHEDULE = (2.0, 2.0, 1.5, 1.0, 1.0, 1.0, 1.0, 1.0)
"""Noise in the rounds, in units of :data:`FINE`."""
FINE = 0.5
"""Noise, pixels: finer than in the final energy, for small bodies to hold their own."""
TURNS = 3
SCALE = 2.0
"""Of the fits, pixels."""


@dataclass(frozen=True)
class Candidate:
    """A segmentation into bodies.

    Attributes:
        energy: its cost.
        labels: ``(n,)`` from 0.
        fundamentals: ``(K, 3, 3)``.
    """

    energy: float
    labels: Tensor
    fundamentals: Tensor


def descended(view: View, starts: Sequence[Starts]) -> dict[int, list[Candidate]]:
    """The segmentations that the starts lead to, by their number of bodies, the cheapest first.

    One with a body of fewer than :data:`LEAST` matches is given up.
    """
    device = view.x1.device
    bodies = torch.cat([torch.full((len(s.labels),), s.fundamentals.shape[1], device=device) for s in starts])
    width = int(bodies.max()) if len(bodies) else 1
    present = torch.arange(width, device=device) < bodies[:, None]
    # only bodies that exist are fitted; the others stay 0, at infinite cost
    rows = present.flatten().nonzero().flatten()
    geometry = torch.cat([s.fundamentals.flatten(0, 1) for s in starts])

    def distances(noise: float) -> Tensor:
        square = sampson_squared(geometry, view.x1, view.x2) / (noise * view.pixel) ** 2
        full = torch.full((present.numel(), len(view.x1)), torch.inf, device=device)
        full[rows] = square.clamp(max=TRUNCATED).float()
        return full.unflatten(0, present.shape)

    member = torch.cat([one_hot(s.labels, width) for s in starts]).float()
    for noise in SCHEDULE:
        member = mean_field(distances(noise * FINE), view.links, SMOOTH, TURNS, member)
        geometry = descend(geometry, view.x1, view.x2, member.flatten(0, 1)[rows].double(), SCALE * view.pixel, steps=2)
    member = mean_field(distances(FINE), view.links, SMOOTH, TURNS, member)
    labels = member.masked_fill(~present[..., None], -1.0).argmax(1)
    hard = one_hot(labels, width)
    fundamentals = geometry.new_zeros(present.numel(), 3, 3)
    fundamentals[rows] = geometry
    fundamentals = fundamentals.unflatten(0, present.shape)
    total = energy(view, fundamentals, hard)
    whole = ~((hard.sum(-1) < LEAST) & present).any(-1)
    found: dict[int, list[Candidate]] = {}
    for count in sorted({s.fundamentals.shape[1] for s in starts}):
        these = ((bodies == count) & whole).nonzero().flatten()
        these = these[total[these].argsort(stable=True)]
        found[count] = [Candidate(float(total[i]), labels[i], fundamentals[i, :count]) for i in these.tolist()]
    return found
