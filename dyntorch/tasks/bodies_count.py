"""How many bodies: the segmentation of least cost with a penalty for each body, or with the number that was asked for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from dyntorch.tasks.bodies_descent import Candidate
from dyntorch.tasks.bodies_pool import LEAST

FIRST, NEXT, MOST = 4, 2, 12
"""Numbers of bodies tried at first, tried further each time that the largest was the best, and tried at all."""
PENALTY, ALONE = 4.5, 6.2
"""Of a body, in units of the root of the number of matches: what models leave unexplained grows with the matches.  The second where
geometry decides alone (spurious bodies explain up to 4.9, true ones 7.6 and more)."""

Search = Callable[[Sequence[int]], dict[int, list[Candidate]]]


@dataclass(frozen=True)
class Best:
    """The segmentation that was chosen.

    Attributes:
        candidate: itself.
        spare: whether fewer bodies than were asked for cost less, penalties included.
    """

    candidate: Candidate
    spare: bool = False
    further: Candidate | None = None
    """The best segmentation into one body more, where their number was open."""


def best(search: Search, matches: int, bodies: int | None, penalty: float) -> Best | None:
    """The best segmentation of so many matches into ``bodies``, or, for None, into the number of least penalized cost.

    Fewer than were asked for where there are no segmentations into as many; None where there are none at all.  The penalty of a
    body is in units of the root of the number of matches.
    """
    room = max(1, matches // LEAST)
    known: dict[int, Candidate] = {}

    def penalized(count: int) -> float:
        return known[count].energy + penalty * count * matches**0.5

    if bodies is not None:
        for count in range(min(bodies, room), 0, -1):
            # one body fewer tells whether so many were needed
            known |= _cheapest(search(range(max(1, count - 1), count + 1)))
            if count in known:
                return Best(known[count], count > 1 and count - 1 in known and penalized(count - 1) < penalized(count))
        return None
    top = 0
    while top < min(room, MOST):
        last, top = top, min(top + (NEXT if top else FIRST), room, MOST)
        known |= _cheapest(search(range(last + 1, top + 1)))
        chosen = min(known, key=penalized, default=0)
        if chosen < top:
            break
    if not known:
        return None
    count = min(known, key=penalized)
    return Best(known[count], further=known.get(count + 1))


def _cheapest(found: dict[int, list[Candidate]]) -> dict[int, Candidate]:
    return {count: candidates[0] for count, candidates in found.items() if candidates}
