r"""Distances between points that stay the same while everything moves: the lengths of limbs, of any animal, learned from the data.

A distance has a spread :math:`s_{ab} = q_{.9}\bigl| |X_a - X_b| - \mathrm{med} \bigr| / 1.645`.  Of all pairs whose
:math:`s_{ab}` is a small share of the distance, those of a spanning forest with the least shares are bones; people stand side by
side in one set of points and fall apart into trees of their own.
"""

from __future__ import annotations

from itertools import combinations

import torch
from torch import Tensor


def rigid_pairs(points: Tensor, known: Tensor, spread: float) -> tuple[Tensor, Tensor, Tensor]:
    """The pairs of a spanning forest whose distances vary least. points ``(T, n, 3)``, known ``(T, n)`` -> ``(B, 2)``."""
    n = points.shape[1]
    if n < 2:
        return torch.zeros(0, 2, dtype=torch.long), points.new_zeros(0), points.new_zeros(0)
    one, other = torch.tensor(list(combinations(range(n), 2))).unbind(-1)
    both = known[:, one] & known[:, other]
    far = torch.where(both, (points[:, one] - points[:, other]).norm(dim=-1), torch.nan)
    length = far.nanmedian(0).values
    # two people may keep their distance for half of the time: nine tenths of it count
    away = (far - length).abs().nanquantile(0.9, dim=0) / 1.645
    share = (away / length).nan_to_num(torch.inf)
    root = list(range(n))

    def find(place: int) -> int:
        while root[place] != place:
            place = root[place]
        return place

    chosen = []
    for k in share.argsort(stable=True).tolist():
        a, b = find(int(one[k])), find(int(other[k]))
        if share[k] > spread:
            break
        if a != b:
            root[a] = b
            chosen.append(k)
    kept = torch.tensor(sorted(chosen), dtype=torch.long)
    return torch.stack([one[kept], other[kept]], dim=-1), length[kept], share[kept]


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
