"""Clocks of cameras that somebody gives: on one clock already, by what ``dyntorch sync`` wrote, or as numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dyntorch import Clocks
from dyntorch.numerics import Message
from indexing.opening import error, listed, parse_json, read_text

KNOWN = "known"
REMEDY = "give the sync.json of dyntorch sync, or the word known for recordings that are synchronized"


def given_clocks(value: Any, names: Sequence[str]) -> Tensor | None:
    """``(cameras, 2)`` offset in seconds and rate of each camera's clock against the first one's; None where nothing is given."""
    if value is None:
        return None
    if isinstance(value, str) and value == KNOWN:
        return torch.tensor([[0.0, 1.0]], dtype=torch.float64).repeat(len(names), 1)
    if isinstance(value, (str, Path)):
        return _of_sync(Path(value).expanduser(), names)
    if isinstance(value, Clocks):
        return _against_first(torch.stack([value.offsets, value.rates], dim=1).double(), len(names))
    numbers = torch.as_tensor(value, dtype=torch.float64)
    if numbers.ndim == 1:
        numbers = torch.stack([numbers, torch.ones_like(numbers)], dim=1)
    return _against_first(numbers, len(names))


def _against_first(clocks: Tensor, cameras: int) -> Tensor:
    """Clocks against that of the first camera: :math:`t_i = r_i (t_0 - o_0) / r_0 + o_i`."""
    if clocks.shape != (cameras, 2) or not bool(torch.isfinite(clocks).all()) or not bool((clocks[:, 1] > 0).all()):
        text = "{arg:clocks} must be offset and rate of {cameras} cameras, finite and rates positive, got shape {shape}"
        raise ValueError(Message(text, cameras=cameras, shape=tuple(clocks.shape)))
    rates = clocks[:, 1] / clocks[0, 1]
    return torch.stack([clocks[:, 0] - rates * clocks[0, 0], rates], dim=1)


def _of_sync(path: Path, names: Sequence[str]) -> Tensor:
    """What ``dyntorch sync`` wrote."""
    content = parse_json(path, read_text(path, REMEDY), REMEDY)
    cameras = content.get("cameras") if isinstance(content, dict) else None
    if not isinstance(cameras, list) or not all(isinstance(one, dict) and isinstance(one.get("name"), str) for one in cameras):
        raise error(path, "has no list of cameras with names", REMEDY)
    if not content.get("ok"):
        raise error(path, "the recordings did not decide on these clocks", "leave it out, or synchronize them in another way")
    known = {one["name"]: one for one in cameras}
    lacking = [name for name in names if name not in known]
    if lacking:
        raise error(path, f"has no clock of {listed(lacking)} (it has {listed(known)})", "synchronize the same recordings")
    rows = []
    for name in names:
        offset, rate = known[name].get("offset"), known[name].get("rate")
        numbers = all(isinstance(x, (int, float)) and math.isfinite(x) for x in (offset, rate))
        if not numbers or rate <= 0:
            raise error(path, f"{name}: offset and rate are no numbers", REMEDY)
        rows.append([float(offset), float(rate)])
    return _against_first(torch.tensor(rows, dtype=torch.float64), len(names))
