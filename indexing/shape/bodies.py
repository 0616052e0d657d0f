"""Bodies whose depth was guessed, compared whichever way they are turned: the evidence that a lifter gives beyond virtual views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import torch

from indexing.clip import Clip
from indexing.shape.bank import Windows
from indexing.shape.lifting import Lifter, layout_of, solid
from indexing.skeleton import Skeleton
from indexing.windows import ragged, whole

SHOWN, STEPS = 50, 12  # clips, and steps of each, from which the layout is told


@dataclass(frozen=True)
class Layout:
    """Whose joints these are: their names, and whether x grows as in a photograph (:mod:`indexing.shape.lifting`)."""

    joints: tuple[str, ...]
    photograph: bool = False


def told_layout(clips: Sequence[Clip], skeleton: Skeleton | None) -> Layout | None:
    """Whose joints the clips show, from their names or from the data; ``None`` where these do not tell."""
    source = ragged(clips[:SHOWN])
    names = layout_of(skeleton, whole(source, STEPS), torch.from_numpy(source.seen))
    return None if names is None else Layout(names, any(clip.up == "-y" for clip in clips))


@lru_cache(maxsize=4)
def lifter_for(layout: Layout, length: int) -> Lifter:
    """The lifter of a joint layout: made on the fly from a fixed seed, so that a model file need not hold it."""
    return Lifter.fit(layout.joints, length, photograph=layout.photograph)


def lifted(windows: Windows, layout: Layout) -> Windows:
    """The windows with guessed depth as a third coordinate."""
    lifter = lifter_for(layout, windows.values.shape[1])
    return solid(windows.to("cpu"), lifter).to(windows.values.device)


@dataclass(frozen=True)
class Bodies:
    """The copies of the exemplars with depth, ``(copies * N, length, joints, 3)``, and whose joints they are."""

    windows: Windows
    layout: Layout
