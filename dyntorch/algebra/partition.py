"""The one rule by which bodies get their numbers."""

from __future__ import annotations

import torch
from torch import Tensor


def order_of_bodies(members: Tensor) -> Tensor:
    r"""Order in which bodies are numbered: the larger first, of equally large ones that of the earliest match.

    Two non-empty bodies never tie, since a match belongs to one of them at most; so the numbers depend on the partition alone and
    not on which start of a search happened to win by a last digit.

    Args:
        members: ``(*batch, K, n)`` bool, disjoint: whether match n belongs to body k.

    Returns:
        ``(*batch, K)`` int64: which body comes first, second, ...; empty ones last, in the order given.

    Example:
        >>> import torch
        >>> order_of_bodies(torch.tensor([[0, 0, 1, 0, 1], [1, 1, 0, 0, 0], [0, 0, 0, 1, 0]], dtype=torch.bool)).tolist()
        [1, 0, 2]
    """
    count = members.shape[-1]
    places = torch.arange(count, device=members.device)
    first = torch.where(members, places, count).amin(-1) if count else members.new_zeros(members.shape[:-1], dtype=torch.long)
    # size and first match in one integer: (size, count - first) in the order of digits
    return (members.sum(-1) * (count + 1) + count - first).argsort(dim=-1, descending=True, stable=True)
