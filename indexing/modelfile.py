"""The container of every model file: safetensors, with what is no tensor as JSON in its header.  Nothing in it can run.

A file is believed where its parts have the types, shapes and ranges that a fitted estimator has: :class:`Parts` takes each of them
so, and :func:`usable` says in one line that the rest cannot be.  What is loaded can be used.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any, get_args, get_type_hints

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from indexing.files import write_bytes
from indexing.opening import VALUE, clip_text, error, parse_json, quote, size_of
from indexing.skeleton import Skeleton

HEADER = "dyntorch"  # the metadata entry that holds the JSON
AGAIN = "fit on the examples again and save with this version"
LARGE = 1e10  # of a number in a model: coordinates are at most a tenth of it, and squares of it still fit 32 bits
LETTERS = 1000  # of a label
# whatever values of the wrong kind, or that do not belong together, may raise on the way to an estimator
MISFITS = (ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RuntimeError, AssertionError, MemoryError)


def write_model(
    path: str | Path,
    kind: str,
    version: int,
    parameters: Mapping[str, Any],
    about: Mapping[str, Any],
    tensors: Mapping[str, Tensor],
) -> None:
    """Write a fitted estimator, atomically."""
    from safetensors.torch import save as to_bytes

    stored = {name: _to_plain(value) for name, value in parameters.items() if name != "device"}
    for name, value in stored.items():
        try:
            json.dumps(value)
        except TypeError as problem:
            what = f"a model file holds text, numbers and lists only ({problem})"
            raise ValueError(f"{name}: {what}; set it to one of these") from None
    header = json.dumps({"format": kind, "version": version, "parameters": stored, **about})
    alone = {name: value.detach().cpu().contiguous().clone() for name, value in tensors.items()}
    write_bytes(Path(path), to_bytes(alone, metadata={HEADER: header}))


def read_model(path: str | Path, kind: str, version: int) -> tuple[dict[str, Any], Parts]:
    """What :func:`write_model` wrote: the header, and the tensors."""
    header, tensors = _open(Path(path), with_tensors=True)
    if header.get("format") != kind:
        actual = header.get("format", "nothing that dyntorch wrote")
        message = f"is {actual if isinstance(actual, str) and len(actual) < VALUE else quote(actual)}, but {kind} is expected"
        raise error(path, message, "give the file that was saved from such an indexer")
    if header.get("version") != version:
        raise error(path, f"model version {quote(header.get('version'))}, this program reads {version}", AGAIN)
    return header, Parts(tensors)


def model_kind(path: str | Path) -> str:
    """What kind of model a file holds, empty where it does not say."""
    return str(_open(Path(path), with_tensors=False)[0].get("format", ""))


def labels_to_json(classes: NDArray[Any]) -> dict[str, Any]:
    """Class labels for the header."""
    if classes.dtype.kind not in "Uiufb" and not (classes.dtype.kind == "O" and all(isinstance(c, str) for c in classes)):
        raise ValueError(f"labels of type {classes.dtype} cannot be saved; use text or numbers")
    return {"values": classes.tolist(), "dtype": classes.dtype.str}


def labels_from_json(stored: Mapping[str, Any]) -> NDArray[Any]:
    """What :func:`labels_to_json` made, in the dtype it had."""
    values, dtype = stored["values"], np.dtype(stored["dtype"])
    text = dtype.kind in "UO"
    one_kind = all(isinstance(v, str) if text else isinstance(v, (int, float)) and abs(v) < np.inf for v in values)
    if dtype.kind not in "UiufbO" or dtype.itemsize > 4 * LETTERS or not one_kind or len(set(values)) < len(values) or not values:
        raise ValueError(f"classes: {quote(values)} of type {dtype} are no labels")
    classes = np.array(values, dtype=dtype)
    if classes.tolist() != values:
        raise ValueError(f"classes: {quote(values)} do not fit their type {dtype}")
    return classes


def skeleton_to_json(skeleton: Skeleton | None) -> list[Any] | None:
    """A skeleton for the header."""
    return None if skeleton is None else [skeleton.name, list(skeleton.joints), [list(bone) for bone in skeleton.bones]]


def skeleton_from_json(stored: Any, joints: int) -> Skeleton | None:
    """What :func:`skeleton_to_json` made."""
    if stored is None:
        return None
    name, names, bones = stored
    if not isinstance(name, str) or len(names) != joints or not all(isinstance(joint, str) for joint in names):
        raise ValueError(f"skeleton: {len(names)} names for {joints} joints")
    return Skeleton(name, tuple(names), tuple((int(a), int(b)) for a, b in bones))


def number(value: Any, name: str, least: float = -LARGE, most: float = LARGE) -> float:
    """A number of the header."""
    if not isinstance(value, (int, float)) or isinstance(value, bool) or not least <= value <= most:
        raise ValueError(f"{name}: expected a number from {least:g} to {most:g}, got {quote(value)}")
    return float(value)


def read_integer(value: Any, name: str, least: int, most: int) -> int:
    """A whole number of the header."""
    if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= most:
        raise ValueError(f"{name}: expected a whole number from {least} to {most}, got {quote(value)}")
    return value


@contextmanager
def usable(path: str | Path) -> Iterator[None]:
    """Whatever does not belong together in a file is said in one line."""
    try:
        yield
    except MISFITS as problem:
        message = f"not a model that can be used ({type(problem).__name__}: {clip_text(problem, 3 * VALUE)})"
        raise error(path, message, AGAIN) from None


class Parts:
    """The tensors of a model file, taken with the type, the shape and the range that each must have."""

    def __init__(self, tensors: Mapping[str, Tensor]) -> None:
        self.tensors = tensors

    def __contains__(self, name: str) -> bool:
        return name in self.tensors

    def real(self, name: str, *shape: int | None, least: float = -LARGE, most: float = LARGE) -> Tensor:
        """Finite numbers of 32 or 64 bits; ``None`` in ``shape`` stands for any number."""
        values = self._require_shape(name, shape, torch.float32, torch.float64)
        if not bool(((values >= least) & (values <= most)).all()):
            raise ValueError(f"{name}: expected numbers from {least:g} to {most:g}")
        return values

    def integers(self, name: str, *shape: int | None, below: int = 2**62) -> Tensor:
        """Whole numbers from 0, and below a limit."""
        values = self._require_shape(name, shape, torch.int64)
        if not bool(((values >= 0) & (values < below)).all()):
            raise ValueError(f"{name}: expected whole numbers from 0 to {below - 1}")
        return values

    def every(self, name: str, *shape: int | None, below: int) -> Tensor:
        """Whole numbers below a limit, each of which comes."""
        values = self.integers(name, *shape, below=below)
        if len(values.unique()) != below:
            raise ValueError(f"{name}: expected each of the numbers from 0 to {below - 1}")
        return values

    def truth(self, name: str, *shape: int | None) -> Tensor:
        """Truth values."""
        return self._require_shape(name, shape, torch.bool).view(torch.uint8) != 0  # a file may hold other bytes than 0 and 1

    def _require_shape(self, name: str, shape: tuple[int | None, ...], *kinds: torch.dtype) -> Tensor:
        values = self.tensors[name]
        fits = values.ndim == len(shape) and all(side in (None, n) for side, n in zip(shape, values.shape, strict=False))
        if not fits or values.dtype not in kinds:
            wanted = ", ".join("any" if side is None else str(side) for side in shape)
            got = f"{values.dtype} {tuple(values.shape)}".replace("torch.", "")
            raise ValueError(f"{name}: expected {str(kinds[0]).removeprefix('torch.')} ({wanted}), got {got}")
        return values


@dataclass(frozen=True)
class Stored:
    """How a field of a model is kept in its file, and what is believed when it is read: see :func:`store` and :func:`part`."""

    kind: str
    shape: tuple[int | str | None, ...] = ()
    limits: Mapping[str, Any] = field(default_factory=dict)
    name: str | None = None


def store(kind: str, *shape: int | str | None, name: str | None = None, **limits: float | str) -> dict[str, Stored]:
    """The metadata of a dataclass's field that is a tensor of the model's file."""
    return {"stored": Stored(kind, shape, limits, name)}


def part(name: str | None = None, **sizes: int | str) -> dict[str, Stored]:
    """The metadata of a field that is a dataclass with such fields itself; theirs stand behind ``name.``, or beside the
    others."""
    return {"stored": Stored("part", (), sizes, name)}


def tensors_of(model: Any, before: str = "") -> dict[str, Tensor]:
    """All stored fields of a model, by their names in the file."""
    out: dict[str, Tensor] = {}
    for name, each, _, how in _stored_fields(model, before):
        value = getattr(model, each)
        if value is not None:
            out |= tensors_of(value, name) if how.kind == "part" else {name: torch.as_tensor(value)}
    return out


def read_fields(kind: type, parts: Parts, sizes: dict[str, int], before: str = "") -> dict[str, Any]:
    """The stored fields of a model, as its file has them; those that may be None are where the file lacks them."""
    out: dict[str, Any] = {}
    for name, each, hint, how in _stored_fields(kind, before):
        kinds = get_args(hint) or (hint,)
        if type(None) in kinds and not any(other == name or other.startswith(name) for other in parts.tensors):
            out[each] = None
        elif how.kind == "part":
            given = {own: sizes.get(size) if isinstance(size, str) else size for own, size in how.limits.items()}
            inner = {own: size for own, size in {**sizes, **given}.items() if size is not None}
            made: Any = next(one for one in kinds if is_dataclass(one))
            out[each] = made(**read_fields(made, parts, inner, name))
            outer = {own: how.limits.get(own, own) for own in inner}
            sizes |= {size: inner[own] for own, size in outer.items() if isinstance(size, str)}
        else:
            shape = [sizes.get(size) if isinstance(size, str) else size for size in how.shape]
            limits = {key: sizes[value] if isinstance(value, str) else value for key, value in how.limits.items()}
            value = getattr(parts, how.kind)(name, *shape, **limits)
            sizes |= {size: n for size, n in zip(how.shape, value.shape, strict=True) if isinstance(size, str)}
            out[each] = float(value) if hint is float else value
    return out


def _stored_fields(model: Any, before: str) -> Iterator[tuple[str, str, Any, Stored]]:
    """Name in the file, name, type and storage of every stored field."""
    hints = get_type_hints(model if isinstance(model, type) else type(model))
    for each in fields(model):
        how = each.metadata.get("stored")
        if how is not None:
            name = each.name if how.name is None else how.name
            yield f"{before}{name}{'.' if how.kind == 'part' and name else ''}", each.name, hints[each.name], how


def _open(path: Path, with_tensors: bool) -> tuple[dict[str, Any], dict[str, Tensor]]:
    from safetensors import SafetensorError, safe_open

    path = path.expanduser()
    size_of(path, f"make one with 'dyntorch index fit ... -o {path.name}'", "model file")
    try:
        with safe_open(path, framework="pt") as file:
            text = (file.metadata() or {}).get(HEADER)
            # cloned, since tensors of the file lie at odd addresses, where products may be rounded otherwise in the last bit
            tensors = {name: file.get_tensor(name).clone() for name in file.keys()} if with_tensors else {}  # noqa: SIM118
    except (SafetensorError, OSError, *MISFITS) as problem:
        message = f"not a model file (safetensors says: {clip_text(problem, 2 * VALUE)})"
        raise error(path, message, "give the file that 'index fit' wrote") from None
    header = parse_json(path, text or "{}", AGAIN, "its header is damaged")
    if not isinstance(header, dict):
        raise error(path, "its header is damaged (no table of values)", AGAIN)
    return header, tensors


def _to_plain(value: Any) -> Any:
    """numpy scalars become Python's, arrays and tuples lists."""
    if isinstance(value, (np.generic, np.ndarray)):
        return value.tolist()
    return list(value) if isinstance(value, tuple) else value
