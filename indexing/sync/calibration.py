"""Calibration files: the inner matrix and the lens distortion of every camera, as Pose2Sim, Caliscope and AniPose write them."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from indexing.opening import VALUE, clip_text, error, listing, parse_toml, quote, read_text

LARGEST = 1e7  # pixels: focal lengths and centres have some thousand
REMEDY = "give a .toml with matrix (3, 3) and distortions for every camera, as Pose2Sim writes it"


@dataclass(frozen=True, eq=False)
class Lens:
    """One camera of a calibration file. matrix ``(3, 3)``, distortions ``(k,)``."""

    name: str
    matrix: Tensor
    distortions: Tensor
    fisheye: bool = False
    size: tuple[float, float] | None = None


@dataclass(frozen=True, eq=False)
class Lenses:
    """The lenses of the cameras asked for, as :func:`dyntorch.synchronize` takes them, and what to say about it."""

    values: Any
    notes: tuple[str, ...] = ()


def lenses(calibration: Any, names: Sequence[str]) -> Lenses | None:
    """The lens of each camera; None where nothing is given."""
    if calibration is None:
        return None
    path = Path(calibration) if isinstance(calibration, (str, Path)) else None
    cameras = read_calibration(path) if path is not None else calibration
    if not (isinstance(cameras, list) and all(isinstance(camera, Lens) for camera in cameras)):
        return Lenses(calibration)
    chosen, notes = match(cameras, names, path or "calibration")
    fish = [lens.name for lens in chosen if lens.fisheye]
    if fish:
        raise error(path or "calibration", f"[{fish[0]}] has a fisheye lens, which is not modelled", "undistort the points first")
    return Lenses(tuple((lens.matrix, lens.distortions if len(lens.distortions) else None) for lens in chosen), notes)


def read_calibration(path: str | Path) -> list[Lens]:
    """The cameras of a calibration file, in its order."""
    path = Path(path).expanduser()
    content = parse_toml(path, read_text(path, REMEDY), REMEDY)
    found = []
    for key, values in content.items():
        section = clip_text(key, VALUE)
        if isinstance(values, dict) and "matrix" in values:
            matrix = _numbers(path, section, "matrix", values["matrix"])
            if not _is_inner(matrix):
                form = "3 x 3 with positive focal lengths, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels"
                raise error(path, f"[{section}] matrix: expected {form}", REMEDY)
            distortions = _numbers(path, section, "distortions", values.get("distortions", values.get("dist", []))).flatten()
            if len(distortions) not in (0, 4, 5, 8):
                raise error(path, f"[{section}] distortions: expected 4, 5 or 8 numbers, got {len(distortions)}", REMEDY)
            name = values.get("name", key)
            name = name if isinstance(name, str) else quote(name)
            lens = Lens(name, matrix / matrix[2, 2], distortions, bool(values.get("fisheye", False)), _size(values.get("size")))
            found.append(lens)
    if not found:
        raise error(path, "has no camera: no section with a 'matrix'", REMEDY)
    return found


def named_lenses(path: str | Path, names: Sequence[str]) -> tuple[list[Lens], tuple[str, ...]]:
    """The lens of each camera by its own name, whatever its section is called, and what to say about it."""
    chosen, notes = match(read_calibration(path), names, path)
    return [dataclasses.replace(lens, name=name) for lens, name in zip(chosen, names, strict=True)], notes


def match(cameras: Sequence[Lens], names: Sequence[str], path: str | Path) -> tuple[list[Lens], tuple[str, ...]]:
    """The lens of each name: the section of this name, else the only one whose name contains it, else by order."""
    chosen: list[Lens | None] = []
    for name in names:
        sections = [(lens, _normalize_name(lens.name)) for lens in cameras]
        plain = _normalize_name(name)
        equal = [lens for lens in cameras if lens.name == name] or [lens for lens, said in sections if said == plain]
        equal = equal or [lens for lens, said in sections if plain and plain in said]
        equal = equal or [lens for lens, said in sections if said and said in plain]
        chosen.append(equal[0] if len(equal) == 1 else None)
    known = [lens for lens in chosen if lens is not None]
    if len(known) == len(names) and len({id(lens) for lens in known}) == len(names):
        return known, ()
    known_names = listing(lens.name for lens in cameras)
    if len(cameras) == len(names):
        return list(cameras), (f"calibration taken in the order of its file ({known_names}), because names differ",)
    raise error(path, f"its cameras are {known_names}, and {listing(names)} are asked for", "name sections as the cameras")


def _normalize_name(name: str) -> str:
    """A name without what people write in two ways."""
    words = re.findall(r"[^\W\d_]+|\d+", name.lower())
    return " ".join(word.lstrip("0") or "0" if word.isdigit() else word for word in words)


def _is_inner(matrix: Tensor) -> bool:
    """Whether a matrix can be that of a camera."""
    if matrix.shape != (3, 3):
        return False
    scaled = matrix / matrix[2, 2]
    return bool((scaled.abs() < LARGEST).all() and (scaled.diagonal() > 0).all() and (scaled[2, :2] == 0).all())


def _size(value: Any) -> tuple[float, float] | None:
    """Width and height, where they are two positive numbers: nothing else of a file hangs on them."""
    numbers = [x for x in value if isinstance(x, (int, float)) and 0 < x < LARGEST] if isinstance(value, list) else []
    return (float(numbers[0]), float(numbers[1])) if len(numbers) == len(value or ()) == 2 else None


def _numbers(path: Path, section: str, key: str, value: Any) -> Tensor:
    try:
        found = torch.tensor(value, dtype=torch.float64)
    except (TypeError, ValueError, OverflowError, RuntimeError, RecursionError):
        found = torch.tensor([math.nan])
    if not bool(torch.isfinite(found).all()):
        raise error(path, f"[{section}] {key}: expected finite numbers", REMEDY)
    return found
