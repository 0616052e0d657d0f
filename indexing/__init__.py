"""Learn actions from one to a few example clips and find them in other clips, from other viewpoints, by other people.

- :class:`Clip`, :class:`ClipSet`: joints over time, read from what pose estimators write (``Clip.load``, ``ClipSet.load``);
- :class:`ActionIndexer`: learns from clips, recognizes clips, finds actions in long recordings; :class:`Event` is what it finds;
- :class:`PhaseIndexer`: the same from single frames, and how far the action has got;
- :class:`BrightnessIndexer`: the same from pixels alone;
- :class:`Archive`: recordings kept as movement, searched by example or by a learned model; :class:`Hit` is what it finds;
- :func:`synchronize`: how far two cameras' clocks are apart;
- :class:`ActionOptions`, :class:`ArchiveOptions`, :class:`BrightnessOptions`, :class:`PhaseOptions`, :class:`SyncOptions`: every
  number that decides in these, by stage.

The indexers follow scikit-learn.  Times are seconds.  The public names are imported lazily, as in ``dyntorch``.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from indexing.action.indexer import ActionIndexer as ActionIndexer
    from indexing.action.stream import ActionOptions as ActionOptions
    from indexing.archive.archive import Archive as Archive
    from indexing.archive.search import Hit as Hit
    from indexing.archive.writer import ArchiveOptions as ArchiveOptions
    from indexing.brightness.descriptors import BrightnessOptions as BrightnessOptions
    from indexing.brightness.indexer import BrightnessIndexer as BrightnessIndexer
    from indexing.clip import Clip as Clip
    from indexing.clip import ClipSet as ClipSet
    from indexing.phase.indexer import PhaseIndexer as PhaseIndexer
    from indexing.phase.model import PhaseOptions as PhaseOptions
    from indexing.scoring import Event as Event
    from indexing.sync.recordings import SyncOptions as SyncOptions
    from indexing.sync.synchronize import synchronize as synchronize

_HOME = {
    "Clip": "indexing.clip",
    "ClipSet": "indexing.clip",
    "ActionIndexer": "indexing.action.indexer",
    "Archive": "indexing.archive.archive",
    "Hit": "indexing.archive.search",
    "BrightnessIndexer": "indexing.brightness.indexer",
    "PhaseIndexer": "indexing.phase.indexer",
    "Event": "indexing.scoring",
    "synchronize": "indexing.sync.synchronize",
    # the numbers that decide in a verb
    "ActionOptions": "indexing.action.stream",
    "ArchiveOptions": "indexing.archive.writer",
    "BrightnessOptions": "indexing.brightness.descriptors",
    "PhaseOptions": "indexing.phase.model",
    "SyncOptions": "indexing.sync.recordings",
}
__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(import_module(_HOME[name]), name)
    raise AttributeError(f"module 'indexing' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
