"""The world that cameras and points are told in: up, the ground, and the scale."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from dyntorch.tasks.calibrate.bones import bodies, rigid_pairs
from dyntorch.tasks.calibrate.input import Scale
from dyntorch.tasks.calibrate.options import RigWorldOptions


@dataclass(frozen=True)
class World:
    """A similarity from the coordinates of the adjustment: :math:`X' = s (Q X) + o`."""

    turn: Tensor  # ``(3, 3)`` rotation Q
    scale: float  # s
    origin: Tensor  # ``(3,)`` o
    metric: bool  # whether s makes metres
    upright: float  # the share of the long axes of bodies that point up; NaN where there is none
    by_people: bool  # whether these decided

    def points(self, points: Tensor) -> Tensor:
        """Points ``(..., 3)`` in the world."""
        return self.scale * points @ self.turn.mT + self.origin

    def cameras(self, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """Cameras ``(c, 3, 3)``, ``(c, 3)`` of the world."""
        turned = R @ self.turn.mT
        return turned, self.scale * t - (turned @ self.origin[:, None])[..., 0]


def world_of(R: Tensor, centers: Tensor, points: Tensor, scale: Scale, options: RigWorldOptions) -> World:
    r"""Up from the long axes of upright bodies, the ground below them, the scale from a height or lengths. R ``(c, 3, 3)``,
    centers ``(c, 3)``, points ``(T, n, 3)``."""
    points = points[:: max(1, len(points) // options.moments)]
    n = points.shape[1]
    # several people stand side by side: what keeps its distances is one body
    ends, _, _ = rigid_pairs(points.nan_to_num(0.0), points.isfinite().all(-1), options.body_spread)
    groups = bodies(ends, n) or [list(range(n))]
    from_cameras = normalize(-R[:, 1].sum(0), dim=0)
    up, share = upward(points, groups, from_cameras, options)
    by_people = share >= options.upright_share
    up = up if by_people else from_cameras
    ahead = R[0, 2] - (R[0, 2] @ up) * up
    ahead = normalize(ahead, dim=0) if float(ahead.norm()) > 1e-6 else normalize(torch.linalg.cross(up, R[0, 0]), dim=0)
    turn = torch.stack([torch.linalg.cross(ahead, up), ahead, up])
    turned = points @ turn.mT
    size, metric = _scale(turned, centers, points, groups[0], scale, options)
    known = turned.flatten(0, 1)
    known = known[known.isfinite().all(-1)]
    if not len(known):
        return World(turn, size, torch.zeros(3, dtype=torch.float64), metric, share, by_people)
    low = torch.stack([*known[:, :2].median(0).values, known[:, 2].quantile(options.ground)])
    return World(turn, size, -size * low, metric, share, by_people)


def upward(points: Tensor, groups: list[list[int]], guess: Tensor, options: RigWorldOptions) -> tuple[Tensor, float]:
    """The direction ``(3,)`` that most long axes of bodies have, and the share of the axes that have it."""
    axes = []
    for group in groups:
        body = points[:, group]
        seen = body.isfinite().all(-1)
        enough = seen.sum(1) >= max(3, math.ceil(options.seen * len(group)))
        body, seen = body[enough].nan_to_num(0.0), seen[enough].double()[..., None]
        centred = (body - (body * seen).sum(1, keepdim=True) / seen.sum(1, keepdim=True)) * seen
        values, vectors = torch.linalg.eigh(centred.mT @ centred)
        long = values[:, 2].clamp(min=0).sqrt() > options.elongation * values[:, 1].clamp(min=1e-300).sqrt()
        axes.append(vectors[long, :, 2])
    every = torch.cat(axes)
    if not len(every):
        return guess, math.nan
    every = every * torch.where(every @ guess < 0, -1.0, 1.0)[:, None]
    up = normalize(every.median(0).values, dim=0)
    for _ in range(50):
        weight = 1 / (1 - every @ up).clamp(min=0).sqrt().clamp(min=1e-3)
        up = normalize((every * weight[:, None]).sum(0), dim=0)
    near = every @ up > math.cos(math.radians(options.upright))
    if float(up @ guess) < math.cos(math.radians(options.cameras)):
        return guess, 0.0
    return normalize(every[near].mean(0), dim=0) if bool(near.any()) else up, float(near.double().mean())


def _scale(
    turned: Tensor, centers: Tensor, points: Tensor, body: list[int], scale: Scale, options: RigWorldOptions
) -> tuple[float, bool]:
    """Units of the world per unit of the adjustment, and whether they are metres."""
    if scale.lengths:
        found = []
        for (a, b), length in scale.lengths.items():
            far = (points[:, a] - points[:, b]).norm(dim=-1)
            if bool(far.isfinite().any()):
                found.append(length / float(far.nanmedian()))
        if found:
            return float(torch.tensor(found).median()), True
    if scale.height is not None:
        up = turned[:, body, 2]
        share = up.isfinite().double().mean(1)
        whole = up[share >= min(options.whole, float(share.max()))]
        extent = whole.nan_to_num(-math.inf).amax(1) - whole.nan_to_num(math.inf).amin(1)
        if len(extent):
            return scale.height / float(extent.quantile(options.standing)), True
    seen = points.flatten(0, 1)
    seen = seen[seen.isfinite().all(-1)]
    middle = seen.median(0).values if len(seen) else centers.mean(0)
    return 1 / float((centers - middle).norm(dim=-1).median()), False
