"""Cameras from a real recording: Pose2Sim's balancing person before four cameras, against their calibration by a board.

    DYNTORCH_DATA=../shared/data python -m experiments.calibration.real

The recording is cut so that the cameras' clocks differ, and neither these nor the focal lengths are told, or only these.  The
calibration that comes with it leaves 9 to 18 px between triangulated joints and detections: figures below a degree measure it as
much as this.  Errors are those after the similarity between both worlds; joints are compared with those that Pose2Sim triangulates.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

import dyntorch as dyn
from dyntorch.geometry.rigid import rotation_exponential
from experiments.calibration.rigs import turned
from experiments.common.runner import BaseConfig, Tables, Words, experiment
from experiments.common.tables import note
from experiments.recognition.protocol import data_folder

STARTS = ((0, 5, 3, 8), (0, 12, 7, 2), (9, 0, 4, 6), (0, 0, 0, 0))
"""First frames of the cameras: how late each was started."""
LENGTH = 88
"""Frames that are left of each."""
TRUSTED = 0.3
"""Confidence from which on a joint is taken as seen."""


@dataclass(frozen=True)
class Recording:
    """Keypoints ``(4, 100, 25, 2)`` and confidences, and the cameras as calibrated by a board."""

    x: Tensor
    confidence: Tensor
    sizes: Tensor
    K: Tensor
    R: Tensor
    t: Tensor


def balancing() -> Recording:
    """The recording; joints of little confidence are missing."""
    with np.load(data_folder() / "pose2sim" / "pose2sim_balancing.npz") as data:
        points = torch.from_numpy(data["keypoints"].astype(np.float64))
        turns = rotation_exponential(torch.from_numpy(data["rvec"]))
        x = torch.where(points[..., 2:] > TRUSTED, points[..., :2], torch.nan)
        size, K, t = (torch.from_numpy(data[name].astype(np.float64)) for name in ("size", "K", "t"))
    return Recording(x, points[..., 2], size, K, turns, t)


def row(recording: Recording, cameras: Sequence[int], starts: Sequence[int], told: str) -> list[str]:
    """Of one cut."""
    keep = list(cameras)
    tracks = [recording.x[i, starts[i] : starts[i] + LENGTH] for i in keep]
    focal = recording.K[keep, 0, 0].tolist() if "focal" in told else None
    clock = time.process_time()
    found = dyn.calibrate(tracks, 60.0, recording.sizes[keep], focal=focal, one_lens="one lens" in told)
    seconds = time.process_time() - clock
    _, away = turned(found.R, recording.R[keep])
    share = (found.focals / recording.K[keep, 0, 0] - 1).abs()
    late = torch.tensor([starts[keep[0]] - starts[i] for i in keep], dtype=torch.float64)
    frames = (60 * found.clocks.offsets - late).abs()[1:]
    said = "ok" if found.ok else f"refused: {found.reason.partition(';')[0][:60]}"
    values = [f"{float(v):.2f}" for v in (away.median(), away.max(), 100 * share.median(), frames.max())]
    return [", ".join(map(str, [i + 1 for i in keep])), str(tuple(starts)), told, *values, f"{seconds:.1f}", said]


@experiment(BaseConfig())
def tables(config: BaseConfig) -> Tables:
    """The balancing person against the board."""
    recording = balancing()
    lines = []
    for starts in STARTS[: 1 if config.quick else None]:
        for told in ("nothing", "one lens", "focal lengths"):
            note(f"... {starts}, {told}")
            lines.append(row(recording, range(4), starts, told))
    for cameras in ((0, 1), (0, 2), (1, 3), (0, 1, 2), (1, 2, 3)):
        lines.append(row(recording, cameras, STARTS[0], "focal lengths"))
    head = ["cameras", "first frames", "told", "rotation, deg", "worst, deg", "focal, %", "clock, frames", "CPU s", "said"]
    yield "Against the board", Words(head, lines)
