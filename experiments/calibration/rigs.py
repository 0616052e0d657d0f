"""Virtual rigs: real motion (CMU) before virtual cameras on tripods, with everything known that `dyn.calibrate` has to find."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dyntorch.geometry import distort
from dyntorch.geometry.rigid import nearest_rotation, rigid_alignment
from experiments.recognition.protocol import data_folder

BODY = (
    "head", "upperneck", "lhumerus", "rhumerus", "lradius", "rradius", "lwrist", "rwrist", "lfemur", "rfemur", "ltibia", "rtibia",
    "lfoot", "rfoot", "ltoes", "rtoes", "thorax",
)  # fmt: skip
"""17 joints of the motion capture, as many as pose networks of COCO give."""


@dataclass(frozen=True)
class RigSpec:
    """What is drawn; ranges are uniform."""

    cameras: int = 4
    frames: int = 300
    fps: tuple[float, ...] = (30.0,)
    """Of all cameras, or of each."""
    rates: tuple[float, ...] = (1.0,)
    """Seconds of a camera's clock per second, of all or of each."""
    focal: tuple[float, float] = (1100.0, 1800.0)
    """Pixels."""
    size: tuple[int, int] = (1920, 1080)
    distance: tuple[float, float] = (4.0, 6.0)
    """Metres from the middle of the motion."""
    height: tuple[float, float] = (0.8, 2.2)
    """Metres above the ground."""
    apart: float = 25.0
    """Degrees between the directions of any two cameras, at least."""
    shift: float = 25 / 60
    """Seconds: the largest offset of a clock."""
    noise: float = 6.0
    """Pixels: standard deviation of Student's t with ``freedom`` degrees of freedom."""
    freedom: float = 3.0
    missing: float = 0.1
    """Share of positions."""
    k1: tuple[float, float] = (0.0, 0.0)
    """First radial term of the lens."""
    joints: tuple[str, ...] = BODY


@dataclass(frozen=True)
class Rig:
    """What the cameras saw, and the truth behind it."""

    tracks: list[Tensor]
    """Per camera ``(frames, n, 2)`` px, NaN = missing."""
    fps: tuple[float, ...]
    sizes: list[tuple[int, int]]
    K: Tensor
    R: Tensor
    t: Tensor
    distortion: Tensor
    offsets: Tensor
    """Against the first camera's clock, seconds."""
    rates: Tensor
    motion: Motion
    start: float
    """The motion's time when the first camera's clock says 0."""

    @property
    def centers(self) -> Tensor:
        """``(c, 3)`` metres."""
        return -(self.R.mT @ self.t[..., None])[..., 0]

    def points(self, times: Tensor) -> Tensor:
        """True joints ``(T, n, 3)`` at times of the first camera's clock."""
        return self.motion.at(self.start + times)


@dataclass(frozen=True)
class Motion:
    """Joints over time, ``(F, n, 3)`` metres, z up; between frames cubic."""

    joints: Tensor
    fps: float

    def at(self, times: Tensor) -> Tensor:
        """``(T, n, 3)``; Catmull-Rom between frames."""
        place = times * self.fps
        left = place.floor().long().clamp(1, len(self.joints) - 3)
        u = (place - left)[:, None, None]
        p0, p1, p2, p3 = (self.joints[left + k] for k in (-1, 0, 1, 2))
        return p1 + 0.5 * u * (p2 - p0 + u * (2 * p0 - 5 * p1 + 4 * p2 - p3 + u * (3 * (p1 - p2) + p3 - p0)))


def motions(names: Sequence[str] = BODY) -> list[Motion]:
    """The recordings of motion capture that are long enough, z up."""
    with np.load(data_folder() / "cmu_mocap_60fps.npz") as data:
        joints, offsets = data["joints"].astype(np.float64), data["offsets"]
        chosen = [list(data["joint_names"]).index(name) for name in names]
    turned = joints[:, chosen][..., [0, 2, 1]] * np.array([1.0, -1.0, 1.0])
    clips = [turned[a:b] for a, b in pairwise(offsets) if b - a >= 1000]
    return [Motion(torch.from_numpy(clip), 60.0) for clip in clips]


def virtual_rig(seed: int, spec: RigSpec = RigSpec(), bodies: Sequence[Motion] | None = None) -> Rig:
    """A rig drawn by its seed.

    Args:
        seed: of everything that is drawn.
        spec: what is drawn.
        bodies: the recordings to choose from; by default those of :func:`motions`.
    """
    rng = np.random.default_rng(seed)
    c = spec.cameras
    fps, rates = (tuple(np.resize(values, c).tolist()) for values in (spec.fps, spec.rates))
    every = motions(spec.joints) if bodies is None else bodies
    motion = every[int(rng.integers(len(every)))]
    offsets = rng.uniform(-spec.shift, spec.shift, c)
    offsets[0] = 0.0
    # the first camera's time 0 is somewhere in the recording, with room for the clocks on both sides
    longest = spec.frames / min(fps)
    room = len(motion.joints) / motion.fps - longest - 4 * spec.shift - 0.2
    start = 2 * spec.shift + 0.1 + rng.uniform(0, max(room, 0.0))
    seen = motion.at(start + torch.linspace(0, longest, 50, dtype=torch.float64))
    middle = seen.mean((0, 1)).numpy()
    ground = float(seen[..., 2].min())
    R, t = _poses(rng, spec, middle, ground)
    K = torch.eye(3, dtype=torch.float64).repeat(c, 1, 1)
    K[:, 0, 0] = K[:, 1, 1] = torch.from_numpy(rng.uniform(*spec.focal, c))
    K[:, 0, 2], K[:, 1, 2] = spec.size[0] / 2, spec.size[1] / 2
    dist = torch.zeros(c, 5, dtype=torch.float64)
    dist[:, 0] = torch.from_numpy(rng.uniform(*spec.k1, c))
    tracks = []
    for i in range(c):
        moments = (torch.arange(spec.frames, dtype=torch.float64) / fps[i] - offsets[i]) / rates[i]
        x = project(K[i], R[i], t[i], dist[i], motion.at(start + moments))
        tracks.append(_detected(rng, spec, x))
    return Rig(
        tracks,
        fps,
        [spec.size] * c,
        K,
        R,
        t,
        dist,
        torch.from_numpy(offsets),
        torch.tensor(rates, dtype=torch.float64),
        motion,
        start,
    )


def project(K: Tensor, R: Tensor, t: Tensor, dist: Tensor, points: Tensor) -> Tensor:
    """Images ``(..., 2)`` of points ``(..., 3)``, NaN behind the camera."""
    seen = points @ R.mT + t
    x = torch.where(seen[..., 2:] > 0.1, seen[..., :2] / seen[..., 2:], torch.nan)
    x = x @ K[:2, :2].mT + K[:2, 2]
    return distort(x, K, dist) if bool(dist.any()) else x


def _poses(rng: np.random.Generator, spec: RigSpec, middle: np.ndarray, ground: float) -> tuple[Tensor, Tensor]:
    """Tripods around the motion, no two in nearly the same direction, each about upright."""
    while True:
        azimuth = rng.uniform(0, 2 * math.pi, spec.cameras)
        gaps = np.abs((azimuth[:, None] - azimuth + math.pi) % (2 * math.pi) - math.pi) + 10 * np.eye(spec.cameras)
        if gaps.min() > math.radians(spec.apart):
            break
    R, t = [], []
    for angle in azimuth:
        far, high = rng.uniform(*spec.distance), ground + rng.uniform(*spec.height)
        center = np.array([middle[0] + far * math.cos(angle), middle[1] + far * math.sin(angle), high])
        ahead = middle + rng.normal(0, 0.15, 3) - center
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        down, roll = np.cross(ahead, right), rng.normal(0, math.radians(2))
        rows = np.stack([math.cos(roll) * right + math.sin(roll) * down, math.cos(roll) * down - math.sin(roll) * right, ahead])
        R.append(torch.from_numpy(rows))
        t.append(torch.from_numpy(-rows @ center))
    return torch.stack(R), torch.stack(t)


def _detected(rng: np.random.Generator, spec: RigSpec, x: Tensor) -> Tensor:
    """As a detector finds them: with heavy-tailed noise, some missing, none outside of the picture."""
    spread = spec.noise / math.sqrt(spec.freedom / (spec.freedom - 2))
    noisy = x + torch.from_numpy(rng.standard_t(spec.freedom, x.shape)) * spread
    inside = (x > 0).all(-1) & (x < torch.tensor(spec.size)).all(-1)
    lost = torch.from_numpy(rng.uniform(size=tuple(x.shape[:2])) < spec.missing)
    return torch.where((inside & ~lost)[..., None], noisy, torch.nan)


@dataclass(frozen=True)
class RigErrors:
    """How far a calibration is from the truth, after the similarity that fits its cameras best."""

    rotation: float
    """Degrees, median over the cameras."""
    worst: float
    """Degrees, of the worst camera."""
    focal: float
    """Share, median."""
    center: float
    """Share of the distance of the cameras from the people, median."""
    joints: float
    """Millimetres: median distance of joints from the truth, after a similarity of their own."""
    clock: float
    """Seconds, median over the cameras but the first."""


def errors(found: Any, rig: Rig) -> RigErrors:
    """Of a `dyn.Calibration` against a rig.

    The similarity between both worlds: the rotation is the mean of those that the cameras ask for, scale and shift are those
    that carry the true centres onto the found ones.
    """
    turn, angle = turned(found.R, rig.R)
    true, got = rig.centers, found.centers @ turn.mT
    a, b = true - true.mean(0), got - got.mean(0)
    scale = (a * b).sum() / b.square().sum()
    middle = rig.points(torch.linspace(0, 5, 20, dtype=torch.float64)).mean((0, 1))
    away = (scale * b - a).norm(dim=-1) / (true - middle).norm(dim=-1)
    focal = (found.K[:, 0, 0] / rig.K[:, 0, 0] - 1).abs()
    points, truth = found.points, rig.points(found.times)
    seen = points.isfinite().all(-1)
    motion = rigid_alignment(truth[seen], points[seen], scale=True)
    joints = (points[seen] @ motion[:3, :3].mT + motion[:3, 3] - truth[seen]).norm(dim=-1)
    clock = (found.clocks.offsets - rig.offsets).abs()[1:]
    return RigErrors(
        *(float(v) for v in (angle.median(), angle.max(), focal.median(), away.median(), 1e3 * joints.median(), clock.median()))
    )


def turned(found: Tensor, true: Tensor) -> tuple[Tensor, Tensor]:
    """The rotation ``(3, 3)`` of the true world that the cameras found ask for in the mean, and what is left: degrees ``(c,)``."""
    turn = nearest_rotation((true.mT @ found).mean(0))
    relative = (found @ turn.mT @ true.mT).diagonal(dim1=-2, dim2=-1).sum(-1)
    return turn, torch.rad2deg(((relative - 1) / 2).clamp(-1, 1).arccos())
