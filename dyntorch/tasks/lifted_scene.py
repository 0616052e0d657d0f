"""From projections of P^k to the scene: the upgrade by the lifts, structured bundle adjustment, and the frame that is shown."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.algebra.lift import balanced, gauge_algebra, upgrade
from dyntorch.algebra.lift_frames import centred, finite, moved, steady
from dyntorch.algebra.triangulation import reproject, triangulate
from dyntorch.bundle_adjustment import bundle_adjust
from dyntorch.motions import Motion
from dyntorch.tasks.lifted_projections import Projections, Tracks

STRUCTURED = 60
"""Steps of structured bundle adjustment."""


@dataclass(frozen=True)
class Lifting:
    """A motion model at the times of the views, in coordinates of :math:`P^k` in which neither the unit nor the origin of time
    matters."""

    motion: Motion
    lifts: Tensor
    """``(views, a + 1, K)`` with orthonormal columns in all."""
    root: Tensor
    """``(K, K)``: Y of the model is ``root^-1`` times Y in these coordinates."""
    start: Tensor
    """``(a + 1, K)`` the lift at time 0 in these coordinates."""
    slope: Tensor
    """``(a + 1, K)`` its derivative."""
    algebra: Tensor
    """``(dim, K, K)`` the ambiguity."""

    @classmethod
    def of(cls, motion: Motion, times: Tensor, like: Tensor) -> Lifting:
        """The motion at these times, on the device of ``like``."""
        span = float(times.max() - times.min()) / max(1, len(times) - 1)
        lifts, root = balanced(motion.lifts(times))
        inverse = torch.linalg.inv(root)
        start, slope = motion.lifts([0.0])[0] @ inverse, motion.slope(0.0, span or 1.0) @ inverse
        return cls(motion, *(part.to(like) for part in (lifts, root, start, slope, gauge_algebra(lifts))))


@dataclass(frozen=True)
class Scene:
    """Cameras and points of a scene, normalized images."""

    cameras: Tensor
    """``(b, views, l + 1, a + 1)``."""
    structure: Tensor
    """``(b, n, K)``, zero where a point is not determined."""
    cost: Tensor
    """``(b,)``."""


def scene_of(tracks: Tracks, found: Projections, lifting: Lifting, scale: Tensor | None = None) -> Scene:
    """Cameras and points from projections in a projective frame.

    Args:
        tracks: flat batch.
        found: projections and points.
        lifting: the model.
        scale: ``(b,)`` robust scale of normalized, weighted images; None: least squares.
    """
    failed = (found.projections == 0).flatten(1).all(-1)
    projections = torch.where(failed[:, None, None, None], torch.ones_like(found.projections), found.projections)
    cameras = upgrade(projections, lifting.lifts)[1]
    structure = triangulate(cameras @ lifting.lifts, tracks.x, tracks.weights)
    structure = torch.where((found.structure == 0).all(-1, keepdim=True), 0.0, structure)
    return adjusted(tracks, Scene(cameras, structure, torch.zeros_like(tracks.x[:, 0, 0, 0])), lifting, scale)


def adjusted(tracks: Tracks, scene: Scene, lifting: Lifting, scale: Tensor | None = None) -> Scene:
    """Structured bundle adjustment."""
    done = bundle_adjust(
        tracks.x, tracks.weights, scene.cameras, scene.structure, lifting.lifts, iterations=STRUCTURED, scale=scale
    )
    return Scene(done.cameras, done.structure, done.cost)


def framed(tracks: Tracks, scene: Scene, lifting: Lifting, static: Tensor | None) -> Scene:
    """The scene in its frame: finite, with no motion common to all points (to the static ones), centred, of unit size.

    Args:
        tracks: flat batch.
        scene: of :func:`scene_of`.
        lifting: the model.
        static: ``(b, n)`` bool, or None.
    """
    lifts = lifting.lifts
    known = (scene.structure != 0).any(-1)
    G, cameras, structure = finite(scene.cameras, scene.structure, lifts, lifting.algebra, tracks.weights)
    cameras, structure = moved(G, cameras, structure, lifts)
    weights = known if static is None else torch.where((known & static).any(-1, keepdim=True), known & static, known)
    G = steady(structure, lifts, lifting.start, lifting.algebra, weights.to(structure.dtype))
    cameras, structure = moved(G, cameras, structure, lifts)
    G = centred(structure, lifts, known.to(structure.dtype))
    cameras, structure = moved(G, cameras, structure, lifts)
    norm = cameras.flatten(-2).norm(dim=-1)[..., None, None]
    depth = structure @ lifts[0, -1]
    structure = structure / torch.where(depth.abs() > 1e-12, depth, 1.0)[..., None]
    return Scene(cameras / norm.clamp(min=torch.finfo(norm.dtype).tiny), structure, scene.cost)


def positions(structure: Tensor, lift: Tensor) -> Tensor:
    """Inhomogeneous positions ``(b, n, d)`` under one lift; NaN where a point is not determined."""
    homogeneous = structure @ lift.mT
    known = (structure != 0).any(-1, keepdim=True)
    return torch.where(known, homogeneous[..., :-1] / homogeneous[..., -1:], torch.nan)


def velocities(structure: Tensor, lift: Tensor, slope: Tensor) -> Tensor:
    """Their derivative by the time, by the quotient rule, ``(b, n, d)``."""
    place, change = structure @ lift.mT, structure @ slope.mT
    known = (structure != 0).any(-1, keepdim=True)
    moving = (change[..., :-1] - place[..., :-1] / place[..., -1:] * change[..., -1:]) / place[..., -1:]
    return torch.where(known, moving, torch.nan)


def distances(tracks: Tracks, projections: Tensor, structure: Tensor) -> Tensor:
    """Reprojection distances ``(b, views, n)`` in the unit of the measurements; NaN where missing or not determined."""
    error = (tracks.x - reproject(projections, structure)).norm(dim=-1) / tracks.scales[..., None]
    known = (structure != 0).any(-1)[:, None] & (tracks.weights > 0)
    return torch.where(known, error, torch.nan)
