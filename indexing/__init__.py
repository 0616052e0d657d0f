"""Learn actions from one to a few example clips and find them in other clips, from other viewpoints, by other people."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from indexing.brightness.indexer import BrightnessIndexer as BrightnessIndexer
    from indexing.clip import Clip as Clip
    from indexing.clip import ClipSet as ClipSet
    from indexing.feature_indexer import FeatureIndexer as FeatureIndexer
    from indexing.indexer import ActionIndexer as ActionIndexer
    from indexing.phase.indexer import PhaseIndexer as PhaseIndexer
    from indexing.scoring import Event as Event
    from indexing.synchronization import synchronize as synchronize

_HOME = {
    "Clip": "indexing.clip",
    "ClipSet": "indexing.clip",
    "ActionIndexer": "indexing.indexer",
    "BrightnessIndexer": "indexing.brightness.indexer",
    "FeatureIndexer": "indexing.feature_indexer",
    "PhaseIndexer": "indexing.phase.indexer",
    "Event": "indexing.scoring",
    "synchronize": "indexing.synchronization",
}
__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(import_module(_HOME[name]), name)
    raise AttributeError(f"module 'indexing' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
