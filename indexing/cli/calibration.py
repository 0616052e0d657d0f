"""``--calibration FX,FY,CX,CY|FILE.toml``: K of the cameras, as ``dyntorch align`` and ``dyntorch reconstruct`` take it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor


def calibration_files(given: str | None) -> list[Path]:
    """The file that ``--calibration`` names, if it does."""
    return [] if given is None or _inner(given) is not None else [Path(given)]


def _inner(given: str) -> list[float] | None:
    """The four numbers of ``FX,FY,CX,CY``, or None for anything else."""
    try:
        found = [float(word) for word in given.split(",")]
    except ValueError:
        return None
    if len(found) != 4 or not all(math.isfinite(x) for x in found) or min(found[:2]) <= 0:
        raise ValueError(f"--calibration {given!r}: expected fx,fy,cx,cy in pixels, focal lengths positive, or a TOML file")
    return found


def calibrated(given: str | None, tracks: Tensor) -> tuple[Tensor, Tensor | None]:
    """Tracks ``(views, n, 2)`` without lens distortion, and K of all views or of each; None without a calibration."""
    import torch

    if given is None:
        return tracks, None
    if tracks.shape[-1] != 2:
        raise ValueError(f"--calibration is of cameras, and the tracks are of sensors that measure {tracks.shape[-1]} coordinates")
    numbers = _inner(given)
    if numbers is not None:
        fx, fy, cx, cy = numbers
        return tracks, torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], dtype=torch.float64)
    from dyntorch.geometry import undistort
    from indexing.sync.calibration import read_calibration

    lenses = read_calibration(given)
    if len(lenses) not in (1, len(tracks)):
        raise ValueError(f"--calibration {given}: {len(lenses)} cameras for {len(tracks)} views; give one for all, or one for each")
    if any(lens.fisheye for lens in lenses):
        raise ValueError(f"--calibration {given}: a fisheye lens is not modelled; undistort the points first")
    every = lenses * (len(tracks) // len(lenses))
    K = torch.stack([lens.matrix for lens in every]).double()
    straight = [
        undistort(x, k, lens.distortions.double()) if len(lens.distortions) else x
        for x, k, lens in zip(tracks.double(), K, every, strict=True)
    ]
    return torch.stack(straight), K
