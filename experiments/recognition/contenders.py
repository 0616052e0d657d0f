"""The methods that are compared, by name: the action indexer as it is configured, and what people use today."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Literal, Self
from unittest import mock

import torch
from torch import Tensor

from experiments.recognition.baselines import Array, ImageNearest, Nearest, WarpedNearest
from experiments.recognition.protocol import Classifier
from experiments.recognition.short_windows import ShortWindows
from indexing import ActionIndexer, ActionOptions, Clip
from indexing.action.bank import Windows
from indexing.action.model import ShapeModel
from indexing.recordings import decoding
from indexing.scoring import Event

Part = Literal["short windows", "whole exemplars", "kernel machine", "durations", "priors", "rest", "background"]
Method = Literal["equal", "learned", "unrepaired", "windows", "image", "dtw"]
NAMES: dict[Method, str] = {
    "equal": "ours",
    "learned": "ours, learned weights",
    "unrepaired": "ours, joints not repaired",
    "windows": "short windows alone",
    "image": "2D nearest neighbour",
    "dtw": "DTW",
}
OPTIONS: dict[Method, dict[str, Any]] = {"equal": {}, "learned": {"weights": "learned"}, "unrepaired": {"repair": False}}


# what the decoding of a recording is without one of its parts: options, or a constant of it
WITHOUT: dict[Part, ActionOptions | tuple[str, float]] = {
    "short windows": ("MOMENT_WEIGHT", 0.0),
    "whole exemplars": ("WHOLE_WEIGHT", 0.0),
    "kernel machine": ("MACHINE_WEIGHT", 0.0),
    "durations": ActionOptions(num_durations=2),  # the shortest and the longest alone
    "priors": ("DURATION_WEIGHT", 0.0),
    "rest": ActionOptions(rest_weight=0.0),
    "background": ActionOptions(min_quality=-100.0),
}


def contender(method: Method, seed: int = 0, **options: Any) -> Callable[[], Classifier]:
    """A way to make a new one; ``options`` are those of the action indexer, and no baseline has any."""
    if method == "image":
        return ImageNearest
    if method == "dtw":
        return WarpedNearest
    return partial(ActionIndexer, random_state=seed, **OPTIONS[method], **options)


def sliding(method: Method, seed: int = 0, without: Part | None = None) -> ActionIndexer | WithoutPart | Sliding | ShortWindows:
    """A new scorer of the frames of a stream; of ours also without one part of the explanation."""
    if method == "windows":
        return ShortWindows(seed)
    if method == "image":
        return Sliding(ImageNearest())
    if method == "dtw":
        return Sliding(WarpedNearest())
    change = None if without is None else WITHOUT[without]
    if isinstance(change, tuple):
        return WithoutPart(ActionIndexer(random_state=seed, **OPTIONS[method]), *change)
    return ActionIndexer(random_state=seed, options=change, **OPTIONS[method])


def check_methods(methods: Sequence[Method]) -> None:
    """Raise before anything is measured where a method cannot be made.

    Raises:
        ValueError: no method, or aeon is not installed.
    """
    if not methods:
        raise ValueError(f"methods: give at least one of {', '.join(NAMES)}")
    if "dtw" in methods:
        try:
            WarpedNearest()
        except ImportError:
            raise ValueError("aeon is not installed; pip install 'dyntorch[experiments]', or leave dtw out of --methods") from None


@dataclasses.dataclass(frozen=True)
class _Nearest(ShapeModel):
    """A model whose windows are compared by a baseline."""

    nearest: Nearest | None = None
    bank: Any = None

    def moment_residuals(self, query: Windows) -> Tensor:
        """``(Q, M)`` the baseline's distances."""
        assert self.nearest is not None
        return torch.from_numpy(self.nearest.between(self.nearest.describe(query.values), self.bank)).float()

    def whole_residuals(self, query: Windows, chosen: Tensor) -> Tensor:
        """``(Q, chosen)`` the same to whole exemplars."""
        assert self.nearest is not None
        bank = self.nearest.describe(self.exemplars.crop(0)[chosen].values)
        return torch.from_numpy(self.nearest.between(self.nearest.describe(query.values), bank)).float()


class WithoutPart:
    """The action indexer, its recordings decoded with another value of one constant."""

    def __init__(self, indexer: ActionIndexer, constant: str, value: float) -> None:
        self.indexer, self.constant, self.value = indexer, constant, value

    def fit(self, clips: Sequence[Clip], labels: Array) -> Self:
        """Learn as it does."""
        self.indexer.fit(clips, labels)
        self.classes_: Array = self.indexer.classes_
        return self

    def scan(self, clip: Clip) -> tuple[Array, list[Event]]:
        """Scores of frames, and events."""
        with mock.patch.object(decoding, self.constant, self.value):
            return self.indexer.scan(clip)

    def score_frames(self, clip: Clip) -> Array:
        """``(frames, classes)``."""
        return self.scan(clip)[0]

    def find(self, clip: Clip) -> list[Event]:
        """Events."""
        return self.scan(clip)[1]


class Sliding:
    """A baseline on a stream: everything is done as the action indexer does it (short windows of the exemplars at several tempi,
    windows of every duration, the best segments), only the distance between two windows is the baseline's."""

    def __init__(self, nearest: Nearest) -> None:
        self.nearest = nearest

    def fit(self, clips: Sequence[Clip], labels: Array) -> Self:
        """Keep the exemplars' short windows."""
        self.indexer = ActionIndexer(scorer="nearest", search=False, mirror=False, virtual_views=0).fit(clips, labels)
        model = self.indexer.model_
        same = {field.name: getattr(model, field.name) for field in dataclasses.fields(model) if field.init}
        bank = self.nearest.describe(model.exemplars.moments.values)
        self.indexer.model_ = _Nearest(**same, nearest=self.nearest, bank=bank)
        self.classes_: Array = self.indexer.classes_
        return self

    def score_frames(self, clip: Clip) -> Array:
        """``(frames, classes)``."""
        return self.indexer.score_frames(clip)

    def find(self, clip: Clip) -> list[Event]:
        """Events."""
        return self.indexer.find(clip)

    def scan(self, clip: Clip) -> tuple[Array, list[Event]]:
        """Both in one pass."""
        return self.indexer.scan(clip)
