"""People who move as nobody ever did, before cameras that are known: the truth that associations are compared with."""

from dataclasses import dataclass

import numpy as np
import torch

from dyntorch import Clocks
from dyntorch.geometry import distort
from indexing.clip import Clip
from indexing.skeleton import Skeleton
from tests.indexing.calibrate.scene import clocks_of, looking

NAMES = (
    "nose", "left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist", "left_hip", "right_hip",
    "left_knee", "right_knee", "left_ankle", "right_ankle",
)  # fmt: skip
STANDING = np.array(
    [
        [0, 0.1, 1.6], [-0.2, 0, 1.4], [0.2, 0, 1.4], [-0.35, 0, 1.15], [0.35, 0, 1.15], [-0.35, 0.1, 0.9], [0.35, 0.1, 0.9],
        [-0.12, 0, 0.9], [0.12, 0, 0.9], [-0.13, 0.05, 0.5], [0.13, 0.05, 0.5], [-0.13, 0, 0.08], [0.13, 0, 0.08],
    ]
)  # fmt: skip
LAYOUT = Skeleton("thirteen", NAMES)


@dataclass
class Cameras:
    """Known cameras: what a calibration has."""

    K: torch.Tensor
    R: torch.Tensor
    t: torch.Tensor
    distortion: torch.Tensor
    clocks: Clocks


def cameras(azimuths, distance=5.0, focal=1400.0, offsets=None, k1=0.0):
    """Tripods at 1.2 to 1.8 m, aimed at a man's middle."""
    count = len(azimuths)
    K = torch.eye(3, dtype=torch.float64).repeat(count, 1, 1)
    K[:, 0, 0] = K[:, 1, 1] = focal
    K[:, 0, 2], K[:, 1, 2] = 960.0, 540.0
    heights = [1.2 + 0.3 * (k % 3) for k in range(count)]
    poses = [looking((distance * np.cos(a), distance * np.sin(a), up)) for a, up in zip(azimuths, heights, strict=True)]
    R, t = (torch.from_numpy(np.stack(part)) for part in zip(*poses, strict=True))
    lens = torch.zeros(count, 5, dtype=torch.float64)
    lens[:, 0] = k1
    return Cameras(K, R, t, lens, clocks_of(torch.tensor(offsets or [0.0] * count, dtype=torch.float64)))


class Person:
    """A body whose joints wander smoothly about their places, on a way to and fro over the floor."""

    def __init__(self, rng, start, way):
        self.rates = rng.uniform(0.2, 1.1, (len(NAMES), 3, 3))
        self.phases = rng.uniform(0, 2 * np.pi, (len(NAMES), 3, 3))
        self.sizes = rng.uniform(0.02, 0.08, (len(NAMES), 3, 3))
        self.start, self.way, self.speed = np.array(start), np.array(way), rng.uniform(0.12, 0.16)

    def at(self, times):
        """``(T, joints, 3)`` metres."""
        waves = self.sizes * np.sin(2 * np.pi * self.rates * times[:, None, None, None] + self.phases)
        place = np.zeros((len(times), 3))
        place[:, :2] = self.start + self.way * np.sin(2 * np.pi * self.speed * times)[:, None]
        return STANDING + waves.sum(-1) + place[:, None]


def filmed(people, rig, frames=150, fps=30.0, noise=2.0, seed=0):
    """Per camera ``(frames, people, joints, 2)`` px."""
    rng = np.random.default_rng(seed)
    out = []
    for k in range(len(rig.K)):
        times = 5.0 + np.arange(frames) / fps - float(rig.clocks.offsets[k])
        points = torch.from_numpy(np.stack([person.at(times) for person in people], axis=1))
        seen = points @ rig.R[k].mT + rig.t[k]
        x = seen[..., :2] / seen[..., 2:] @ rig.K[k, :2, :2].mT + rig.K[k, :2, 2]
        if bool(rig.distortion[k].any()):
            x = distort(x.reshape(1, -1, 2), rig.K[k][None], rig.distortion[k][None]).reshape(x.shape)
        out.append(x.numpy() + noise * rng.standard_normal(x.shape))
    return out


def crossing(rng, count=2):
    """People on ways that cross, half a metre apart at least."""
    ways = [([0.0, 0.35], [1.3, 0.3]), ([0.1, -0.35], [-1.2, 0.4]), ([0.9, 0.2], [0.1, 1.2])]
    return [Person(rng, *ways[k]) for k in range(count)]


def clips(tracks, fps=30.0, name="", layout=LAYOUT):
    """``(frames, tracks, joints, 2)`` as a tracker's clips."""
    return [Clip(tracks[:, k], fps=fps, name=name, skeleton=layout, up="-y") for k in range(tracks.shape[1])]
