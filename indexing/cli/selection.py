"""Clips chosen by what is known of them: ``field=value,value``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from indexing.labelled import LabelledSet

IntArray = NDArray[np.int64]
LISTED = 20  # values named in a message


def choose(clips: LabelledSet[Any], criteria: Sequence[str], flag: str) -> IntArray:
    """Indices of the clips that meet all criteria.

    Args:
        criteria: ``"view=1,2"``; numbers match whatever their form (``90`` finds ``90.0``).
        flag: the option they came from, for messages.

    Raises:
        ValueError: an unknown field or value, or no clip meets them all; what is known is listed.

    Example:
        >>> import numpy as np
        >>> from indexing.clip import Clip, ClipSet
        >>> clips = ClipSet([Clip(np.zeros((5, 3, 2)), label="walk", meta={"view": v}) for v in (1, 2, 3)])
        >>> choose(clips, ["view=1,3"], "--train").tolist()
        [0, 2]
    """
    keep = np.ones(len(clips), dtype=bool)
    for text in criteria:
        field, equals, wanted = text.partition("=")
        if not equals or not field.strip() or not wanted.strip():
            raise ValueError(f"{flag} {text!r}: expected field=value, such as view=1,2; {known(clips)}")
        values = column(clips, field.strip(), flag)
        found = _matching(values, wanted)
        if found is None:
            listed = ", ".join(sorted({str(v) for v in values}, key=_natural)[:LISTED])
            raise ValueError(f"{flag} {text!r}: no clip of {clips.name} has such a value; {field.strip()!r} is one of {listed}")
        keep &= found
    if not keep.any():
        raise ValueError(f"{flag} {' '.join(criteria)}: no clip of {clips.name} meets all of it; {known(clips)}")
    return np.flatnonzero(keep)


def column(clips: LabelledSet[Any], field: str, flag: str) -> NDArray[Any]:
    """One value per clip.

    Raises:
        ValueError: the field is unknown, or has several values per clip.
    """
    if field not in (*clips.fields, "action", "label"):
        raise ValueError(f"{flag}: {clips.name} has no field {field!r}; {known(clips)}")
    values = clips.column(field)
    if values.ndim != 1:
        raise ValueError(f"{flag}: field {field!r} of {clips.name} has {values.shape[1]} columns; name one of them, e.g. {field}0")
    return values


def known(clips: LabelledSet[Any]) -> str:
    """What may be asked for: the fields and their values."""
    parts = []
    for field in (*clips.fields, "action"):
        try:
            values = clips.column(field)
        except ValueError:
            continue  # some clips lack it
        if values.ndim == 1:
            several = sorted({str(value) for value in values}, key=_natural)
            parts.append(f"{field} ({', '.join(several) if len(several) <= LISTED else f'{len(several)} values'})")
    return f"known fields: {', '.join(parts) or 'none'}"


def _matching(values: NDArray[Any], wanted: str) -> NDArray[np.bool_] | None:
    """Which values are among those wanted; ``None`` where one of these does not occur at all."""
    texts = values.astype(str)
    whole = texts == wanted.strip()  # a value may hold a comma itself
    if whole.any():
        return np.asarray(whole)
    keep = np.zeros(len(values), dtype=bool)
    for word in wanted.split(","):
        hit = texts == word.strip()
        if not hit.any() and values.dtype.kind in "fiu":
            try:
                hit = values.astype(float) == float(word)
            except ValueError:
                return None
        if not hit.any():
            return None
        keep |= hit
    return keep


def _natural(text: str) -> tuple[float, str]:
    """Numbers in the order of numbers."""
    try:
        return float(text), text
    except ValueError:
        return float("inf"), text
