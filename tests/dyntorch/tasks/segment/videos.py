"""Small videos of rigid bodies with the truth, and views of two, by which the stages of both verbs are tested."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.geometry.homogeneous import homogeneous, inhomogeneous, skew, unit
from dyntorch.geometry.rigid import rotation_exponential
from dyntorch.scenes.scene import Scene
from dyntorch.tasks.segment.coherence import View, coherence
from dyntorch.tasks.segment.frame_pairs import FramePair, TrackSet
from dyntorch.tasks.segment.track_energy import no_links

F64 = torch.float64
K = torch.tensor([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]], dtype=F64)
PLACES = ((150.0, 130.0), (490.0, 340.0), (480.0, 110.0), (160.0, 360.0))
"""Where bodies 2, 3, ... are in frame 0, pixels."""
STEPS = ((0.08, 0.0, 0.02), (-0.05, -0.07, 0.0), (0.0, 0.08, -0.03), (0.02, -0.08, 0.05))
"""How they go on, metres per frame."""
TURNS = ((0.0, 0.03, 0.01), (0.03, 0.0, -0.02), (0.0, -0.03, 0.0), (0.02, 0.0, 0.02))
"""How they turn about their middle, radians per frame."""


@dataclass(frozen=True)
class Shot:
    """Tracks ``(frames, n, 2)``, labels ``(n,)`` 1..K with 1 what rests, cameras ``(frames, 3, 4)``; motions ``(frames, K, 3, 4)``
    of the bodies as the camera sees them: from the world of frame 0 to pixels."""

    tracks: Tensor
    labels: Tensor
    cameras: Tensor
    projections: Tensor

    def fundamental(self, body: int, first: int, second: int) -> Tensor:
        """Of a body, from 0, between two frames."""
        a, b = self.projections[first, body], self.projections[second, body]
        centre = torch.linalg.svd(a)[2][-1]
        return unit(skew(b @ centre) @ b @ torch.linalg.pinv(a))

    def truth(self, pairs: Sequence[FramePair]) -> Tensor:
        """Of all bodies, ``(P, 1, K, 3, 3)``, in the coordinates of the film."""
        back = self.film().change.inverse()
        bodies = range(self.projections.shape[1])
        return torch.stack(
            [torch.stack([back.mT @ self.fundamental(k, *pair.frames) @ back for k in bodies])[None] for pair in pairs]
        )

    def film(self, pixel: float = 1.0) -> TrackSet:
        """As the stages see it."""
        return TrackSet.of(self.tracks, pixel)


def draw(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def view_of(scene: Scene, pixel: float = 1 / 200, linked: bool = True) -> View:
    """The matches of a scene around 0, at a pixel's size."""
    x1, x2 = (x * pixel - torch.tensor([320.0, 240.0], dtype=F64) * pixel for x in scene.views)
    return View(x1, x2, pixel, coherence(x1, x2, 3 * pixel)[1] if linked else no_links(len(x1), x1.device))


def true_view(scene: Scene, pixel: float, linked: bool = True) -> tuple[View, Tensor]:
    """The same, and the true fundamental matrices ``(K, 3, 3)`` of the bodies there."""
    back = torch.tensor([[1 / pixel, 0, 320.0], [0, 1 / pixel, 240.0], [0, 0, 1]], dtype=F64)
    return view_of(scene, pixel, linked), unit(back.mT @ torch.stack(scene.motion) @ back)


def shot(
    counts: Sequence[int] = (60, 40),
    frames: int = 10,
    sigma: float = 0.1,
    *,
    planar: Collection[int] = (),
    moves: float = 1.0,
    seed: int = 0,
) -> Shot:
    """What rests all over the picture, and compact bodies before it, in the order of their numbers."""
    generator = draw(seed)
    time = torch.arange(frames, dtype=F64)
    step = moves * torch.tensor([0.05, 0.01, 0.04], dtype=F64)
    camera = torch.cat(
        [
            rotation_exponential(time[:, None] * moves * torch.tensor([0.0, 0.004, 0.001], dtype=F64)),
            (time[:, None] * step)[..., None],
        ],
        -1,
    )
    cameras = K @ camera
    projections, tracks = [], []
    for body, count in enumerate(counts):
        uv = torch.rand(count, 2, generator=generator, dtype=F64)
        near = torch.rand(count, 1, generator=generator, dtype=F64)
        if body == 0:
            x, depth = 20 + uv * torch.tensor([600.0, 440.0], dtype=F64), 5 + 8 * near
        else:
            x, depth = torch.tensor(PLACES[body - 1], dtype=F64) + 130 * (uv - 0.5), 5.5 + 1.2 * (near - 0.5)
        if body + 1 in planar:
            depth = 5.5 + 0.01 * (x - x.mean(0)) @ torch.tensor([[0.4], [0.3]], dtype=F64)
        points = homogeneous(x) @ torch.linalg.inv(K).mT * depth
        motion = torch.eye(3, 4, dtype=F64).expand(frames, 3, 4)
        if body:
            turn = rotation_exponential(time[:, None] * moves * torch.tensor(TURNS[body - 1], dtype=F64))
            middle = points.mean(0)
            way = middle - turn @ middle + time[:, None] * moves * torch.tensor(STEPS[body - 1], dtype=F64)
            motion = torch.cat([turn, way[..., None]], -1)
        last = torch.tensor([[[0.0, 0.0, 0.0, 1.0]]], dtype=F64).expand(frames, 1, 4)
        seen_by = cameras @ torch.cat([motion, last], 1)
        projections.append(seen_by)
        tracks.append(inhomogeneous(homogeneous(points) @ seen_by.mT))
    exact = torch.cat(tracks, 1)
    noise = sigma * torch.randn(exact.shape, generator=generator, dtype=F64)
    labels = torch.arange(1, len(counts) + 1).repeat_interleave(torch.tensor(list(counts)))
    return Shot(exact + noise, labels, cameras, torch.stack(projections, 1))
