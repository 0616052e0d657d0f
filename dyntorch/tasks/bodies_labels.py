"""Labels of all matches, outliers among them, given the bodies found among the coherent ones."""

from __future__ import annotations

from dataclasses import dataclass
from math import log

import torch
from torch import Tensor

from dyntorch.algebra.epipolar import sampson_squared
from dyntorch.algebra.epipolar_descent import descend
from dyntorch.tasks.bodies_energy import View
from dyntorch.tasks.bodies_field import mean_field
from dyntorch.tasks.coherence import Links, conformity

OUTLIER = 1.0
"""Cost of an outlier where many are: that of a match a threshold away from a body in which it moves like its neighbours."""
FEW, MANY = 0.005, 0.2
"""Share of outliers below which they are no rarer, and above which they cost no less."""
STRANGE, CONFORMING, LEAST = 2.5, 0.25, 0.02
"""Cost of a match that moves unlike all its neighbours of a body; the conformity from which it costs nothing, over that of most
members; and at least."""
FOUND = 6.0
"""What a match that the search assigned to a body gains there."""
SHARPNESS = 4.0
FAR = 9.0
TURNS, ROUNDS = 20, 3
FIT = 0.8
"""Scale of the fits, in thresholds."""


@dataclass(frozen=True)
class Labelling:
    """Labels of all matches.

    Attributes:
        probabilities: ``(K + 1, n)``, the first of an outlier.
        fundamentals: ``(K, 3, 3)``.
    """

    probabilities: Tensor
    fundamentals: Tensor

    @property
    def labels(self) -> Tensor:
        """``(n,)``, 0 outlier."""
        return self.probabilities.argmax(0)

    def of(self, bodies: Tensor) -> Labelling:
        """With these bodies alone (indices or bool): what belonged to others belongs to none."""
        kept = self.probabilities[1:][bodies]
        return Labelling(torch.cat([1 - kept.sum(0, keepdim=True), kept]).clamp(min=0), self.fundamentals[bodies])


def label(
    view: View, found: Tensor, fundamentals: Tensor, weights: Tensor, threshold: float, scale: float | None, share: float
) -> Labelling:
    r"""Labels and geometries in turns: a mean field of the costs

    .. math:: \min(r_{ik}^2 / T^2, 9) + s\,(1 - c_{ik} / c_0)_+ - b\,[i \text{ found in } k],
        \qquad \text{outlier: } 1 + \tfrac14 \log \tfrac{1 - \pi}{4 \pi},

    with the conformity :math:`c_{ik}` of match i to body k and the share :math:`\pi` of outliers
    (at most a fifth), and of labels that differ from those of the neighbours.

    Args:
        view: all matches.
        found: ``(n,)`` bodies 1..K of the search, 0 elsewhere.
        fundamentals: ``(K, 3, 3)`` of the search.
        weights: ``(n,)`` of the matches in the fits.
        threshold: T, in the coordinates of ``view``.
        scale: as of :func:`~dyntorch.tasks.coherence.coherence`; None: neighbours do not matter.
        share: of outliers, roughly.
    """
    numbers = torch.arange(1, len(fundamentals) + 1, device=found.device)[:, None]
    members = found == numbers
    gain = FOUND * members.to(weights.dtype) if scale is not None else 0.0
    strange = _strange(view, members, scale)
    links = _normalized(view.links)
    odds = [(1 - p) / p for p in (min(max(share, FEW), MANY), MANY)]
    outlier = OUTLIER + log(odds[0] / odds[1]) / SHARPNESS

    def probabilities(bodies: Tensor) -> Tensor:
        square = sampson_squared(bodies, view.x1, view.x2) / threshold**2
        return field(square.clamp(max=FAR) + strange - gain, outlier, links)

    bodies = fundamentals
    member = probabilities(bodies)
    for turn in range(ROUNDS):
        members = member.argmax(0) == numbers
        # a descent never raises its own truncated cost, so geometries cannot drift away from their members
        bodies = descend(bodies, view.x1, view.x2, members * weights, FIT * threshold)
        strange = _strange(view, members, scale) if turn == 0 else strange
        member = probabilities(bodies)
    return Labelling(member, bodies)


def field(cost: Tensor, outlier: float, links: Links) -> Tensor:
    """Mean field ``(K + 1, n)`` of the costs ``(K, n)`` of bodies, the first of an outlier."""
    every = torch.cat([torch.full_like(cost[:1], outlier), cost])
    return mean_field(SHARPNESS * every, links, SHARPNESS, TURNS)


def _strange(view: View, members: Tensor, scale: float | None) -> Tensor:
    """Cost ``(K, n)`` of moving unlike the neighbours."""
    if scale is None:
        return torch.zeros_like(members, dtype=view.x1.dtype)
    value = conformity(view.x1, view.x2, members, scale)
    # members of deep bodies move less like each other
    usual = torch.where(members, value, torch.nan).nanmedian(-1, keepdim=True).values.nan_to_num(nan=1.0)
    return STRANGE * (1 - value / (CONFORMING * usual).clamp(min=LEAST)).clamp(min=0)


def _normalized(links: Links) -> Links:
    """Links whose sum is 1 for every match."""
    return Links(links.index, links.weight / links.weight.sum(-1, keepdim=True).clamp(min=1e-9))
