"""How recognition is measured: who is learned from, who is asked, and through which cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from indexing.cameras import perspective, virtual
from indexing.cli.console import count, names
from indexing.clip import Clip, LabelledSet

# ----------------------------------------------------------------------------------------------------------------------
# Clips chosen by what is known of them: ``field=value,value``.


if TYPE_CHECKING:
    from indexing.clip import LabelledSet

IntArray = NDArray[np.int64]
LISTED = 20  # values named in a message


def choose(clips: LabelledSet[Any], criteria: Sequence[str], flag: str) -> IntArray:
    """Indices of the clips that meet all criteria."""
    keep = np.ones(len(clips), dtype=bool)
    for text in criteria:
        field, equals, wanted = text.partition("=")
        if not equals or not field.strip() or not wanted.strip():
            raise ValueError(f"{flag} {text!r}: expected field=value, such as view=1,2; {field_values(clips)}")
        values = column(clips, field.strip(), flag)
        matching = _matching(values, wanted)
        if matching is None:
            listed = ", ".join(sorted({str(v) for v in values}, key=_natural)[:LISTED])
            raise ValueError(f"{flag} {text!r}: no clip of {clips.name} has such a value; {field.strip()!r} is one of {listed}")
        keep &= matching
    if not keep.any():
        raise ValueError(f"{flag} {' '.join(criteria)}: no clip of {clips.name} meets all of it; {field_values(clips)}")
    return np.flatnonzero(keep)


def column(clips: LabelledSet[Any], field: str, flag: str) -> NDArray[Any]:
    """One value per clip."""
    if field not in (*clips.fields, "action", "label"):
        raise ValueError(f"{flag}: {clips.name} has no field {field!r}; {field_values(clips)}")
    values = clips.column(field)
    if values.ndim != 1:
        raise ValueError(f"{flag}: field {field!r} of {clips.name} has {values.shape[1]} columns; name one of them, e.g. {field}0")
    return values


def field_values(clips: LabelledSet[Any]) -> str:
    """What may be asked for: the fields and their values."""
    parts = []
    for name in (*clips.fields, "action"):
        try:
            values = clips.column(name)
        except ValueError:
            continue  # some clips lack it
        if values.ndim == 1:
            several = sorted({str(value) for value in values}, key=_natural)
            parts.append(f"{name} ({', '.join(several) if len(several) <= LISTED else f'{len(several)} values'})")
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


ELEVATION, SPREAD = 0.1, 0.1  # radians: of virtual cameras, and how much a query's may differ either way


@dataclass(frozen=True)
class Fold:
    """Indices of the clips to learn from and to ask about; the name is the group left out, or empty."""

    name: str
    train: IntArray
    test: IntArray


class Viewing(Protocol):
    """How recordings become what is learned from and what is asked about; ``settings`` names the ways of asking."""

    def exemplar(self, clip: Any, number: int) -> Any:
        """A recording as it is learned from."""

    def query(self, clip: Any, number: int, view: int) -> Any:
        """A recording as it is asked about."""

    @property
    def settings(self) -> list[str]:
        """What the ways of asking are called; one without a name where there is just one."""


@dataclass(frozen=True)
class Cameras:
    """Through which cameras clips are seen: ``"none"`` (as they are), ``"perspective"`` or ``"virtual"``."""

    kind: str
    azimuths: tuple[float, ...]
    solid: bool
    seed: int

    def exemplar(self, clip: Clip, number: int) -> Clip:
        """A clip as it is learned from: seen from azimuth 0, unless it stays 3D."""
        if self.kind == "none" or self.solid:
            return clip
        if self.kind == "perspective":
            return perspective(clip)
        return virtual(clip, 0.0, ELEVATION, random_state=np.random.default_rng([self.seed, number]))

    def query(self, clip: Clip, number: int, view: int) -> Clip:
        """A clip as it is asked about, by the camera with this number."""
        if self.kind == "none":
            return clip
        if self.kind == "perspective":
            return perspective(clip)
        rng = np.random.default_rng([self.seed, number, view + 1])
        elevation = ELEVATION + float(rng.uniform(-SPREAD, SPREAD))
        return virtual(clip, self.azimuths[view], elevation, random_state=rng)

    @property
    def settings(self) -> list[str]:
        """What the cameras of queries are called; one without a name where there are no virtual ones."""
        return [f"azimuth {azimuth:g}" for azimuth in self.azimuths] if self.kind == "virtual" else [""]


def check_dims(clips: Sequence[Clip], cameras: Cameras) -> list[str]:
    """Raise where a camera needs 3D joints and there are none; a note where 3D joints have no camera."""
    flat = next((clip for clip in clips if clip.dims == 2), None)
    if flat is None:
        return ["3D joints without --camera: learned from all around, asked as seen along z"] if cameras.kind == "none" else []
    if cameras.kind != "none":
        raise ValueError(f"--camera {cameras.kind}: needs 3D joints, but clip {flat.name!r} is 2D; leave --camera out")
    if cameras.solid:
        raise ValueError(f"--exemplars 3d: clip {flat.name!r} is 2D; leave --exemplars out")
    return []


def splits(
    clips: LabelledSet[Any], train: Sequence[str], test: Sequence[str], leave_out: str | None
) -> tuple[list[Fold], list[str]]:
    """The folds that the options ask for, and what a person should know about them."""
    if leave_out is not None:
        if train or test:
            raise ValueError("--leave-out makes its own training and test sets; leave --train and --test out")
        return _leave_out(clips, leave_out), []
    if not train and not test:
        raise ValueError(
            f"say what to learn from and what to ask: --train view=1 --test view=2, or --leave-out field; {field_values(clips)}"
        )
    everything = np.arange(len(clips))
    asked = choose(clips, test, "--test") if test else np.setdiff1d(everything, choose(clips, train, "--train"))
    learned = choose(clips, train, "--train") if train else np.setdiff1d(everything, asked)
    for name, chosen, other in (("--test", asked, "--train"), ("--train", learned, "--test")):
        if not len(chosen):
            raise ValueError(f"{name}: {other} takes all {count(len(clips), 'clip')} of {clips.name}; {field_values(clips)}")
    both = np.intersect1d(asked, learned)
    notes = [f"warning: {count(len(both), 'clip')} in both --train and --test, so the accuracy is too good"] if len(both) else []
    return [Fold("", learned, asked)], notes


def _leave_out(clips: LabelledSet[Any], field: str) -> list[Fold]:
    values = column(clips, field, "--leave-out")
    groups = np.unique(values)
    if len(groups) < 2:
        raise ValueError(f"--leave-out {field}: all clips of {clips.name} have the value {groups[0]}; {field_values(clips)}")
    return [Fold(f"{field} {value}", np.flatnonzero(values != value), np.flatnonzero(values == value)) for value in groups]


def draw_shots(fold: Fold, labels: NDArray[np.str_], shots: int, seed: int) -> tuple[Fold, list[str]]:
    """The fold with at most ``shots`` training clips per class, drawn at random; classes with fewer keep all they have."""
    if shots < 1:
        raise ValueError(f"--shots must be 1 or more, got {shots}")
    rng = np.random.default_rng(seed)
    chosen, few = [], []
    for label in np.unique(labels[fold.train]):
        mine = fold.train[labels[fold.train] == label]
        chosen.append(rng.permutation(mine)[:shots])
        if len(mine) < shots:
            few.append(str(label))
    where = f" without {fold.name}" if fold.name else ""
    notes = [f"fewer than {count(shots, 'example')}{where} of {names(few)}"] if few else []
    return Fold(fold.name, np.sort(np.concatenate(chosen)), fold.test), notes


def check_classes(folds: Sequence[Fold], labels: NDArray[np.str_], name: str) -> None:
    """Raise where fewer than two actions are left to learn."""
    for fold in folds:
        classes = np.unique(labels[fold.train])
        if len(classes) < 2:
            where = f" without {fold.name}" if fold.name else ""
            raise ValueError(f"{name}: only one action ({classes[0]}) to learn from{where}; choose training clips of at least two")


def strangers(folds: Sequence[Fold], labels: NDArray[np.str_]) -> list[str]:
    """A note on test clips whose action was never learned."""
    unlearned = [label for fold in folds for label in labels[fold.test] if label not in set(labels[fold.train])]
    if not unlearned:
        return []
    return [
        f"{count(len(unlearned), 'test clip')} of actions that were not learned ({names(sorted(set(unlearned)))}) count as wrong"
    ]
