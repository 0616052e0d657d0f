r"""Distances between points that stay the same while everything moves: the lengths of limbs, of any animal, learned from the data.

A distance has a spread :math:`s_{ab} = 1.4826\, \mathrm{med}_t\, \bigl| |X_a - X_b| - \mathrm{med} \bigr|`.  Of all pairs whose
:math:`s_{ab}` is a small share of the distance, those of a spanning forest with the least shares are bones; people stand side by
side in one set of points and fall apart into trees of their own.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import torch
from torch import Tensor

from dyntorch.tasks.calibrate.options import RigAdjustOptions


@dataclass(frozen=True)
class Bones:
    """Pairs of points whose distance stays the same, of b adjustments."""

    ends: Tensor
    """``(B, 2)`` long."""
    lengths: Tensor
    """``(b, B)`` logarithms, a start."""
    sigma: Tensor
    """``(b, B)``: how much their logarithms vary."""
    seen: Tensor
    """``(b, T, B)``, 1 where both ends are seen by two cameras."""

    def subset(self, keep: Tensor) -> Bones:
        """Of some of the adjustments."""
        return replace(self, lengths=self.lengths[keep], sigma=self.sigma[keep], seen=self.seen[keep])

    def stretched(self, points: Tensor, lengths: Tensor) -> tuple[Tensor, Tensor]:
        """Logarithms ``(b, T, B)`` of bones over their lengths ``(b, B)``, and their derivatives by the first end ``(b, T, B, 3)``.

        Logarithms do not change with the scale of the world: differences would make it shrink.
        """
        one, other = self.ends.unbind(-1)
        along = points[:, :, one] - points[:, :, other]
        square = along.square().sum(-1).clamp(min=1e-24)
        return 0.5 * square.log() - lengths[:, None], along / square[..., None]


def learned(points: Tensor, known: Tensor, options: RigAdjustOptions) -> Bones | None:
    """The bones of points; None where no distance stays the same.

    Args:
        points: ``(T, n, 3)``.
        known: ``(T, n)`` bool.
        options: see :class:`RigAdjustOptions`.

    Example:
        >>> import torch
        >>> turn = torch.linspace(0, 6, 100, dtype=torch.float64)
        >>> hip, knee = torch.zeros(100, 3, dtype=torch.float64), torch.stack([turn.cos(), turn.sin(), 0 * turn], dim=-1)
        >>> points = torch.stack([hip, knee, knee * turn[:, None]], dim=1)
        >>> found = learned(points, torch.ones(100, 3, dtype=torch.bool), RigAdjustOptions())
        >>> found.ends.tolist(), round(float(found.lengths.exp()), 3)
        ([[0, 1]], 1.0)
    """
    n = points.shape[1]
    one, other = torch.tensor(list(combinations(range(n), 2))).unbind(-1) if n > 1 else torch.zeros(2, 0, dtype=torch.long)
    both = known[:, one] & known[:, other]
    far = torch.where(both, (points[:, one] - points[:, other]).norm(dim=-1), torch.nan)
    length = far.nanmedian(0).values
    spread = 1.4826 * (far - length).abs().nanmedian(0).values
    share = (spread / length).nan_to_num(torch.inf)
    root = list(range(n))

    def find(place: int) -> int:
        while root[place] != place:
            place = root[place]
        return place

    chosen = []
    for k in share.argsort(stable=True).tolist():
        a, b = find(int(one[k])), find(int(other[k]))
        if share[k] > options.length_spread:
            break
        if a != b:
            root[a] = b
            chosen.append(k)
    if not chosen:
        return None
    kept = torch.tensor(sorted(chosen))
    # exact data have no spread
    sigma = options.length_sigma * share[kept].clamp(min=1e-3)
    return Bones(torch.stack([one[kept], other[kept]], dim=-1), length[None, kept].log(), sigma[None], both[None, :, kept].double())


def bodies(ends: Tensor, points: int) -> list[list[int]]:
    """Points that bones ``(B, 2)`` tie together, largest body first; those without bones in none.

    Example:
        >>> import torch
        >>> bodies(torch.tensor([[0, 1], [3, 4], [1, 2]]), 6)
        [[0, 1, 2], [3, 4]]
    """
    label = list(range(points))
    for a, b in ends.tolist():
        label = [label[a] if one == label[b] else one for one in label]
    groups = [[k for k in range(points) if label[k] == one] for one in dict.fromkeys(label)]
    return sorted((group for group in groups if len(group) > 1), key=lambda group: -len(group))
