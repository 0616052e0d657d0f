"""A person before cameras on tripods, with everything known: what the cameras see, their files, and the truth as a result."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch

from dyntorch import Calibration, Clocks, Status
from dyntorch.core import Notice, NoticeCode, status_from
from indexing.actors import Person, stream
from indexing.calibrate.camera_views import make_view, select_common_joints
from indexing.calibrate.priors import standing_extent
from indexing.calibrate.rig import CameraRig
from indexing.clip import Clip
from indexing.skeleton import COCO17
from indexing.sync.recordings import take_of
from tests.indexing.sync.scene import write_openpose

FPS, SIZE, FOCAL = 30.0, (1920, 1080), 1500.0
LATE = (0, 12, 25)
"""Frames that each camera starts late."""
PLACES = ((4.0, -1.0, 1.4), (0.5, 4.2, 1.7), (-3.8, 1.5, 1.2))
"""Metres, z up; the person stands at the origin."""
AIM = (0.0, 0.0, 0.9)


@dataclass(frozen=True)
class Truth:
    """Cameras, and the joints in space."""

    R: torch.Tensor
    t: torch.Tensor
    K: torch.Tensor
    points: np.ndarray
    """``(frames, n, 3)`` metres, z up."""


def looking(place: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and translation of a camera that looks at the person, its picture upright."""
    centre = np.array(place)
    ahead = np.array(AIM) - centre
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(ahead, right), ahead])
    return R, -R @ centre


@lru_cache
def truth(people: int = 1) -> Truth:
    """The rig of the tests, people side by side two metres apart."""
    poses = [looking(place) for place in PLACES]
    K = torch.tensor([[FOCAL, 0, SIZE[0] / 2], [0, FOCAL, SIZE[1] / 2], [0, 0, 1]], dtype=torch.float64).repeat(3, 1, 1)
    bodies = []
    for who in range(people):
        solid, _ = stream(["squat", "wave"], Person.random(1 + who), fps=FPS, rng=1 + who)
        body = np.asarray(solid.joints, dtype=np.float64)[:110, :, [2, 0, 1]]  # x right, y up, z front: z up
        bodies.append(body + np.array([0.0, 1.3 * who, 0.0]))
    R, t = (torch.from_numpy(np.stack(part)) for part in zip(*poses, strict=True))
    return Truth(R, t, K, np.concatenate(bodies, axis=1))


def seen(people: int = 1, noise: float = 1.0) -> list[np.ndarray]:
    """What each camera sees from its first frame on: ``(frames, n, 2)`` px."""
    found, rng = truth(people), np.random.default_rng(0)
    out = []
    for R, t, K, late in zip(found.R.numpy(), found.t.numpy(), found.K.numpy(), LATE, strict=True):
        x = (found.points[late:] @ R.T + t) @ K.T
        out.append(x[..., :2] / x[..., 2:] + rng.normal(0, noise, x[..., :2].shape))
    return out


def filmed(people: int = 1) -> list[list[Clip]]:
    """The people of each camera as clips."""
    return [
        [Clip(part, fps=FPS, skeleton=COCO17, up="-y", name=f"cam{i}") for part in np.split(tracks, people, axis=1)]
        for i, tracks in enumerate(seen(people), start=1)
    ]


def write_cameras(folder: Path, people: int = 1) -> Path:
    """``cam1`` to ``cam3`` as OpenPose writes them."""
    for i, clips in enumerate(filmed(people), start=1):
        write_openpose(folder / f"cam{i}", clips)
    return folder


class Asked(NoticeCode):
    NOTE = "note", "{text}"
    PLANAR = "planar", "cameras in a line: {camera:1} tells nothing new; move one of them, or give {arg:focal=}", Status.DEGENERATE


def solved(people: int = 1, ok: bool = True, metric: bool = True, upright: bool = True, **changes: object) -> Calibration:
    """The truth as :func:`dyntorch.calibrate` would say it."""
    found = truth(people)
    cameras, frames, n = len(PLACES), *found.points.shape[:2]
    notices = (() if ok else (Notice(Asked.PLANAR),)) + (Notice(Asked.NOTE, 0.0, {"text": "lenses have no distortion"}),)
    sigmas = torch.tensor([0.002] * 3 + [0.004] * 3 + [0.01, 0.005, 0.0, 0.0005, 1e-6], dtype=torch.float64)
    covariance = torch.diag(sigmas.square()).repeat(cameras, 1, 1)
    for part in (covariance[0, 9:], covariance[0, :, 9:], covariance[:, 8], covariance[:, :, 8]):
        part.zero_()  # the reference clock
    residuals = torch.linspace(1, 6, cameras * n, dtype=torch.float64).reshape(cameras, n)
    residuals[1, 3] = torch.nan
    values: dict = {
        "status": status_from(notices), "notices": notices, "K": found.K, "R": found.R, "t": found.t,
        "distortion": torch.zeros(cameras, 5, dtype=torch.float64), "sizes": torch.tensor([SIZE] * cameras),
        "clocks": clocks_of(-torch.tensor(LATE, dtype=torch.float64) / FPS),
        "times": torch.arange(frames, dtype=torch.float64) / FPS,
        "points": torch.from_numpy(found.points.copy()), "sigmas": torch.full((frames, n), 0.006),
        "metric": metric, "upright": upright, "covariance": covariance,
        "residuals": residuals, "inliers": torch.full((cameras,), 0.97, dtype=torch.float64), "fps": (FPS,) * cameras,
    }  # fmt: skip
    return Calibration(**{**values, **changes})


def clocks_of(offsets: torch.Tensor) -> Clocks:
    """Clocks of equal rates."""
    one, zero = torch.ones_like(offsets), torch.zeros_like(offsets)
    return Clocks(
        status=torch.tensor(0), offsets=offsets, rates=one, sigmas=zero, rate_sigmas=zero, confidence=0.99, pairs=(),
        cycle_error=0.0, worst_cycle=None, outliers=[], reference=0, center=1.0, shifts={},
    )  # fmt: skip


def rig(people: int = 1, metric: bool = True, **changes: object) -> CameraRig:
    """The truth as :func:`indexing.calibrate.calibrate` would return it."""
    clips = filmed(people)
    takes = [take_of(own, name=f"cam{i}") for i, own in enumerate(clips, start=1)]
    views = [make_view(take, own, SIZE) for take, own in zip(takes, clips, strict=True)]
    stature = standing_extent(COCO17.joints, 1.75) if metric else None
    return CameraRig(
        solved(people, metric=metric, **changes), views, select_common_joints([own[0] for own in clips], []), stature=stature
    )
