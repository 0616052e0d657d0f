"""What a recording holds, as it is told to people: scores of every frame, events, and what was held back and why.  Plain data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from numpy.typing import NDArray

from indexing.scoring import Event

Array = NDArray[Any]
Reason = Literal["at rest", "nobody there", "below the level", "other movement"]


@dataclass(frozen=True)
class Withheld:
    """Something that looked like an action and is not reported: what it would have been, and why it is not."""

    event: Event
    reason: Reason


@dataclass(frozen=True, eq=False)
class Explanation:
    """A recording of one person as segments."""

    times: Array
    classes: tuple[Any, ...]
    scores: Array
    events: Sequence[Event] = ()
    withheld: Sequence[Withheld] = ()
    background: Array | None = None

    def seconds(self, label: Any) -> float:
        """How long one action lasts in all."""
        return sum(event.end - event.start for event in self.events if event.label == label)
