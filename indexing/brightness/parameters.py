"""Parameters of the brightness indexer, checked once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from indexing.brightness.sight import SMALLEST
from indexing.checks import check_device, check_reject, is_number
from indexing.opening import shown

LARGEST = 100_000  # px of the shorter side: films have some thousand


def check_parameters(indexer: Any) -> None:
    """Raise on parameters that make no sense, naming the parameter and what it accepts."""
    for name in ("fps", "window"):
        value = getattr(indexer, name)
        if not is_number(value) or value <= 0:
            raise ValueError(f"{name} must be a positive number, got {value!r}")
    if not is_number(indexer.pool) or indexer.pool < 0:
        raise ValueError(f"pool must be seconds, 0 or more, got {indexer.pool!r}")
    _check_region(indexer.region)
    if indexer.flip not in (True, False, "auto"):
        raise ValueError(f"flip must be 'auto', True or False, got {indexer.flip!r}")
    check_reject(indexer.reject)
    size = indexer.size
    if not isinstance(size, (int, np.integer)) or isinstance(size, bool) or not SMALLEST <= size <= LARGEST:
        raise ValueError(f"size must be a whole number of pixels from {SMALLEST} to {LARGEST}, got {shown(size)}")
    check_device(indexer.device)


def _check_region(region: Any) -> None:
    if region is None or (isinstance(region, str) and region == "motion"):
        return
    fine = isinstance(region, (Sequence, np.ndarray)) and not isinstance(region, str) and len(region) == 4
    if not (fine and all(is_number(v) for v in region) and region[2] > region[0] and region[3] > region[1]):
        raise ValueError(f"region must be 'motion', None or (x0, y0, x1, y1) in pixels with x0 < x1 and y0 < y1, got {region!r}")
