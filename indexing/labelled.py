"""A list of recordings that can be selected by what is known of them: the part that sets of clips and of films share."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Protocol, Self, TypeVar, overload

import numpy as np
from numpy.typing import NDArray


class Labelled(Protocol):
    """What every recording in a set has: its action, if known, and whatever else is known of it."""

    @property
    def label(self) -> Hashable | None: ...
    @property
    def meta(self) -> Mapping[str, Any]: ...


T = TypeVar("T", bound=Labelled)


class LabelledSet(Sequence[T]):
    """Recordings, their labels, and selection by field.

    Args:
        clips: the recordings; name: what to call the set in messages.
    """

    def __init__(self, clips: Iterable[T], name: str = "") -> None:
        self.clips: tuple[T, ...] = tuple(clips)
        self.name = name

    @overload
    def __getitem__(self, index: int) -> T: ...

    @overload
    def __getitem__(self, index: slice | Sequence[int] | NDArray[Any]) -> Self: ...

    def __getitem__(self, index: int | slice | Sequence[int] | NDArray[Any]) -> T | Self:
        if isinstance(index, (int, np.integer)):
            return self.clips[index]
        if isinstance(index, slice):
            return type(self)(self.clips[index], self.name)
        chosen = np.asarray(index)
        if chosen.dtype == bool:
            if len(chosen) != len(self):
                raise ValueError(f"set {self.name!r}: a mask of {len(chosen)} values cannot select from {len(self)} clips")
            chosen = np.flatnonzero(chosen)
        return type(self)((self.clips[int(i)] for i in chosen), self.name)

    def __len__(self) -> int:
        return len(self.clips)

    def __iter__(self) -> Iterator[T]:
        return iter(self.clips)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.name!r}, {len(self)} clips, fields: {', '.join(self.fields) or 'none'})"

    @property
    def labels(self) -> NDArray[Any]:
        """``(clips,)`` the actions; ``None`` where unknown."""
        values = [clip.label for clip in self.clips]
        if any(value is None or isinstance(value, tuple) for value in values):
            out = np.empty(len(values), dtype=object)
            out[:] = values
            return out
        return np.asarray(values)

    @property
    def fields(self) -> tuple[str, ...]:
        """Names that :meth:`select` and :meth:`column` accept."""
        names: dict[str, None] = {}
        for clip in self.clips:
            names.update(dict.fromkeys(clip.meta))
        return tuple(names)

    def column(self, name: str) -> NDArray[Any]:
        """``(clips, ...)`` one field of every clip; ``"action"`` or ``"label"`` gives the labels.

        Raises:
            ValueError: the field is unknown to some clip; the message lists the known ones.
        """
        if name in ("action", "label") and name not in self.fields:
            return self.labels
        missing = [i for i, clip in enumerate(self.clips) if name not in clip.meta]
        if missing or not self.clips:
            raise ValueError(f"clip set {self.name!r}: no field {name!r}; known fields: {', '.join(self.fields) or 'none'}")
        return np.asarray([clip.meta[name] for clip in self.clips])

    def select(self, **criteria: Any) -> Self:
        """The clips whose fields equal the given value, or one of the given values.

        Raises:
            ValueError: an unknown field.
        """
        keep = np.ones(len(self), dtype=bool)
        for name, wanted in criteria.items():
            column = self.column(name)
            if column.ndim != 1:
                raise ValueError(f"clip set {self.name!r}: field {name!r} has several columns; select one of them, e.g. {name}0")
            values = [wanted] if isinstance(wanted, str) or not isinstance(wanted, Iterable) else list(wanted)
            keep &= np.array([any(_same(entry, value) for value in values) for entry in column.tolist()], dtype=bool)
        return self[keep]


def _same(entry: Any, value: Any) -> bool:
    """Whether a field equals a value that may come as text (command line): 60 == 60.0 == "60"."""
    if entry == value or str(entry) == str(value):
        return True
    try:
        return float(entry) == float(value)
    except (TypeError, ValueError):
        return False
