"""Parameters of the brightness indexer, checked once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from indexing.brightness.sight import SMALLEST


def check_parameters(indexer: Any) -> None:
    """Raise on parameters that make no sense, naming the parameter and what it accepts."""
    for name in ("fps", "window"):
        value = getattr(indexer, name)
        if not _number(value) or value <= 0:
            raise ValueError(f"{name} must be a positive number, got {value!r}")
    if not _number(indexer.pool) or indexer.pool < 0:
        raise ValueError(f"pool must be seconds, 0 or more, got {indexer.pool!r}")
    _check_region(indexer.region)
    if indexer.flip not in (True, False, "auto"):
        raise ValueError(f"flip must be 'auto', True or False, got {indexer.flip!r}")
    if not (_number(indexer.temporal_weight) and 0 <= indexer.temporal_weight <= 1):
        raise ValueError(f"temporal_weight must be a share from 0 to 1, got {indexer.temporal_weight!r}")
    if indexer.reject is not None and not _number(indexer.reject):
        raise ValueError(f"reject must be None, a rate between 0 and 1 or a threshold, got {indexer.reject!r}")
    if not isinstance(indexer.size, (int, np.integer)) or isinstance(indexer.size, bool) or indexer.size < SMALLEST:
        raise ValueError(f"size must be a whole number of pixels from {SMALLEST}, got {indexer.size!r}")
    try:
        torch.empty(0, device=indexer.device)
    except (RuntimeError, AssertionError) as error:
        raise ValueError(f"device {indexer.device!r} is not there: {str(error).splitlines()[0]}; use device='cpu'") from None


def _check_region(region: Any) -> None:
    if region is None or (isinstance(region, str) and region == "motion"):
        return
    fine = isinstance(region, (Sequence, np.ndarray)) and not isinstance(region, str) and len(region) == 4
    if not (fine and all(_number(v) for v in region) and region[2] > region[0] and region[3] > region[1]):
        raise ValueError(f"region must be 'motion', None or (x0, y0, x1, y1) in pixels with x0 < x1 and y0 < y1, got {region!r}")


def _number(value: Any) -> bool:
    return isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool) and bool(np.isfinite(value))
