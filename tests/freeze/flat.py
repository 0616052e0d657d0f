"""Any result as a flat table of arrays, numbers and texts: written to one file, and compared with another."""

from __future__ import annotations

import dataclasses
import enum
import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

import dyntorch as dyn

Flat = dict[str, Any]  # name -> array, number, text or None
TEXTS = "__texts__"
COPIES = {"matches", "normalization"}  # fields that only repeat what the verb was given
MANIFEST = {"time", "timings", "versions", "platform"}  # of a run, not of its result
NUMBER = re.compile(r"(?<![\w.])[-+\u2212]?\d[\d,]*(?:\.\d+)?(?:e[-+]?\d+)?")
NORMAL = [
    (re.compile(r"\b(in|took) \d[\d.,]* (m?s|seconds)\b"), r"\1 {time}"),
    (re.compile(r"\b(clips|searching) \d[\d.]* s\b"), r"\1 {time}"),
    (re.compile(r"\btimings\.(\w+) [\d.e-]+"), r"timings.\1 {time}"),
    (re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d)?(\+00:00|Z| UTC)?"), "{date}"),
    (re.compile(r"0x[0-9a-f]{6,}"), "{address}"),
    (re.compile(rf"\b{re.escape(dyn.__version__)}\b"), "{version}"),
]


def plain_text(text: str, folders: tuple[str, ...]) -> str:
    """A text without what is another in every run: temporary folders, running times, dates, addresses, the version."""
    for folder in folders:
        text = text.replace(folder, "{folder}")
    for pattern, instead in NORMAL:
        text = pattern.sub(instead, text)
    return text


def flatten(value: Any, name: str, folders: tuple[str, ...] = ()) -> Iterator[tuple[str, Any]]:
    """Names and leaves of a result: public fields and properties of dataclasses, items of tuples, lists and dicts."""
    if isinstance(value, enum.Enum):
        yield name, value.name
    elif value is None or isinstance(value, (bool, int, float)):
        yield name, value
    elif isinstance(value, (str, Path)):
        yield name, plain_text(str(value), folders)
    elif isinstance(value, torch.Tensor):
        yield name, value.detach().resolve_conj().resolve_neg().cpu().contiguous().numpy()
    elif isinstance(value, np.generic):
        yield name, value.item()
    elif isinstance(value, np.ndarray) and value.dtype.kind in "biufcSUmM":
        yield name, value
    elif isinstance(value, dyn.Invariant):
        yield name, repr(value)
    elif callable(value) and not dataclasses.is_dataclass(value):
        yield name, "<function>"
    else:
        parts = list(_parts(value))
        if not hasattr(value, "_fields") and not dataclasses.is_dataclass(value):
            yield f"{name}/#", len(parts)
        for key, part in parts:
            yield from flatten(part, f"{name}/{key}", folders)


def _parts(value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, Mapping):
        drop = MANIFEST if set(value) >= MANIFEST else set()
        yield from ((str(key).replace("/", "|"), part) for key, part in value.items() if key not in drop)
    elif hasattr(value, "_fields"):
        yield from ((key, getattr(value, key)) for key in value._fields)
    elif dataclasses.is_dataclass(value):
        yield from ((key, part) for key, part in _attributes(value) if key not in COPIES)
    elif isinstance(value, (set, frozenset)):
        yield from ((str(i), part) for i, part in enumerate(sorted(value, key=str)))
    elif hasattr(value, "__iter__"):
        yield from ((str(i), part) for i, part in enumerate(value))
    else:
        yield "repr", repr(value)


def _attributes(value: Any) -> Iterator[tuple[str, Any]]:
    """Public fields and properties; a field that becomes a property later keeps its name."""
    names = [field.name for field in dataclasses.fields(value)]
    names += [key for kind in type(value).__mro__ for key, at in vars(kind).items() if hasattr(at, "__get__") and not callable(at)]
    for key in dict.fromkeys(names):
        if not key.startswith("_") and not isinstance(vars(type(value)).get(key), (staticmethod, classmethod)):
            try:
                yield key, getattr(value, key)
            except (ValueError, RuntimeError) as problem:
                yield key, f"{type(problem).__name__}: {problem}"


def save(path: Path, flat: Flat) -> None:
    """One npz: arrays by name, everything else as JSON."""
    texts = {name: value for name, value in flat.items() if not isinstance(value, np.ndarray)}
    arrays = {name: value for name, value in flat.items() if isinstance(value, np.ndarray)}
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, **arrays, **{TEXTS: np.frombuffer(json.dumps(texts).encode(), np.uint8)})


def load(path: Path) -> Flat:
    """What :func:`save` wrote."""
    with np.load(path, allow_pickle=False) as file:
        flat: Flat = {name: file[name] for name in file.files if name != TEXTS}
        return {**flat, **json.loads(file[TEXTS].tobytes())}


def differs(old: Any, new: Any, tolerance: float) -> str:
    """How two leaves differ; empty where they do not.

    Args:
        tolerance: 0 compares bit by bit; otherwise the greatest difference beside the largest entry of the leaf.  Numbers in texts
            are compared likewise.
    """
    if isinstance(old, np.ndarray) and isinstance(new, np.ndarray):
        return _arrays(old, new, tolerance)
    if type(old) is not type(new) and not (tolerance and isinstance(old, (int, float)) and isinstance(new, (int, float))):
        return f"{_short(old)} -> {_short(new)}"
    if isinstance(old, float) or isinstance(new, float):
        return "" if repr(old) == repr(new) else _arrays(np.array(float(old)), np.array(float(new)), tolerance)
    if old == new:
        return ""
    if isinstance(old, str) and tolerance and NUMBER.sub("0", old) == NUMBER.sub("0", new):
        both = zip(NUMBER.findall(old), NUMBER.findall(new), strict=True)
        pairs = [[float(number.replace(",", "").replace("\u2212", "-")) for number in pair] for pair in both]
        wrong = [difference for a, b in pairs if (difference := _arrays(np.array(a), np.array(b), tolerance))]
        return f"{len(wrong)} numbers in a text, {wrong[0]}" if wrong else ""
    if isinstance(old, str):
        at = next((i for i, (a, b) in enumerate(zip(old, new, strict=False)) if a != b), min(len(old), len(new)))
        return f"{_short(old[max(0, at - 30) :])} -> {_short(new[max(0, at - 30) :])}"
    return f"{_short(old)} -> {_short(new)}"


def _arrays(old: np.ndarray, new: np.ndarray, tolerance: float) -> str:
    if old.shape != new.shape or (old.dtype != new.dtype and not (tolerance and {old.dtype.kind, new.dtype.kind} <= set("biuf"))):
        return f"{old.dtype} {old.shape} -> {new.dtype} {new.shape}"
    if old.dtype == new.dtype and old.tobytes() == new.tobytes():
        return ""
    if old.dtype.kind not in "biufc":
        return f"{int((old != new).sum())} of {old.size} differ"
    a, b = (x.astype(complex if x.dtype.kind == "c" else float) for x in (old, new))
    same = (a == b) | (np.isnan(a) & np.isnan(b))
    if same.all() and tolerance:
        return ""
    off = float(np.abs(np.where(same, 0, a - b)).max())
    scale = max((float(np.abs(x[np.isfinite(x)]).max(initial=0.0)) for x in (a, b)), default=0.0)
    relative = off / scale if scale else 0.0
    if relative <= tolerance and tolerance:
        return ""
    return f"largest difference {off:.3g}, {relative:.2e} of the largest entry; {int((~same).sum())} of {old.size} entries"


def _short(value: Any) -> str:
    text = f"array {value.dtype} {value.shape}" if isinstance(value, np.ndarray) else repr(value)
    return text if len(text) <= 90 else text[:87] + "..."
