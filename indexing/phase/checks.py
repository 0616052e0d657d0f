"""Parameters and phases that users hand in, checked once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from indexing.checks import check_device, is_number
from indexing.checks import check_reject as check_reject_number
from indexing.clip import Clip
from indexing.labels import same_label
from indexing.phase.calibration import FEWEST

_CHOICES: dict[str, tuple[Any, ...]] = {"course": ("auto", "periodic", "once"), "mirror": ("auto", True, False)}


def check_phase_parameters(indexer: Any) -> None:
    """Raise on parameters that make no sense, naming the parameter and what it accepts."""
    for name, accepted in _CHOICES.items():
        if getattr(indexer, name) not in accepted:
            raise ValueError(f"{name} must be one of {', '.join(map(repr, accepted))}, got {getattr(indexer, name)!r}")
    harmonics = indexer.harmonics
    if not isinstance(harmonics, (int, np.integer)) or isinstance(harmonics, bool) or not 1 <= harmonics <= 12:
        raise ValueError(f"harmonics must be a whole number from 1 to 12, got {harmonics!r}")
    for name, least in (("fps", 1e-9), ("window", 0.0)):
        value = getattr(indexer, name)
        if not (is_number(value) and value >= least):
            raise ValueError(f"{name} must be {'a positive number' if name == 'fps' else 'seconds, 0 or more'}, got {value!r}")
    check_reject_number(indexer.reject)
    check_device(indexer.device)


def check_reject(indexer: Any, classes: list[Any]) -> None:
    """Raise where a rate cannot be calibrated, or a refused clip would look like a known one."""
    if indexer.reject is None:
        return
    if any(same_label(value, indexer.none_label) for value in classes):
        raise ValueError(f"none_label={indexer.none_label!r} is one of the learned labels; choose another for rejected clips")
    if 0 < indexer.reject < 1 and len(classes) < FEWEST:
        raise ValueError(
            f"reject={indexer.reject!r} is calibrated by leaving a class out, which takes {FEWEST} classes, got {len(classes)}; "
            "give further ones, or a threshold outside 0..1"
        )


def check_phases(phases: Sequence[Any] | None, clips: list[Clip], owners: list[int]) -> list[Tensor | None]:
    """For each clip its phases ``(frames,)`` float64, or ``None``."""
    if phases is None:
        return [None] * len(clips)
    if len(phases) != owners[-1] + 1:
        raise ValueError(f"phases: expected one entry per clip ({owners[-1] + 1}), got {len(phases)}; give None for a clip without")
    out: list[Tensor | None] = []
    for clip, owner in zip(clips, owners, strict=True):
        if phases[owner] is None:
            out.append(None)
            continue
        values = np.asarray(phases[owner], dtype=np.float64)
        if values.shape != (len(clip),):
            raise ValueError(f"phases: clip {owner} has {len(clip)} frames, but its phases have shape {values.shape}")
        if not np.isfinite(values).any():
            raise ValueError(f"phases: no phase of clip {owner} is known; give None to have them found")
        out.append(torch.from_numpy(values))
    return out
