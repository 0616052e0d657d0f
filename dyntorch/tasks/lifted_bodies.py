"""Two bodies in relative translation: labels, cameras of each, and their points."""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.algebra.hyperplane_pair import hyperplane_pair
from dyntorch.algebra.triangulation import triangulate
from dyntorch.algebra.two_bodies import two_bodies
from dyntorch.bundle_adjustment import bundle_adjust
from dyntorch.bundle_information import point_information
from dyntorch.tasks.lifted_projections import Tracks
from dyntorch.tasks.lifted_scene import Scene

STEPS = 60
"""Of bundle adjustment."""


def bodies_of(tracks: Tracks, scene: Scene) -> tuple[Tensor, Tensor, Tensor, Scene]:
    """Labels by the two hyperplanes of the points, and the affine structure of each body.

    Args:
        tracks: flat batch.
        scene: projections (as cameras) and points in any projective frame.

    Returns:
        cameras of both bodies ``(b, 2, views, m, d + 1)``, points ``(b, n, d)``, labels ``(b, n)``, and the adjusted scene with
        every point on the hyperplane of its body.
    """
    done = bundle_adjust(tracks.x, tracks.weights, scene.cameras, scene.structure, iterations=STEPS)
    known = (done.structure != 0).any(-1)
    information = point_information(done.cameras, done.structure, tracks.weights)
    pair = hyperplane_pair(done.structure, known.to(done.structure.dtype), information=information)
    structure = _on_hyperplanes(tracks, done.cameras, pair.hyperplanes, pair.labels)
    bodies = two_bodies(done.cameras, structure, pair.hyperplanes, pair.labels)
    points = torch.where(known[..., None], bodies.points, torch.nan)
    return bodies.cameras, points, pair.labels, Scene(done.cameras, structure, done.cost)


def _on_hyperplanes(tracks: Tracks, cameras: Tensor, hyperplanes: Tensor, labels: Tensor) -> Tensor:
    """The points, each triangulated within the hyperplane of its body."""
    total = torch.zeros_like(labels[..., None] * hyperplanes[:, :1, :])
    for body in (1, 2):
        # an orthonormal basis of the hyperplane: the last columns of a complete QR
        basis = torch.linalg.qr(hyperplanes[:, body - 1, :, None], mode="complete")[0][..., 1:]
        mine = (labels == body)[..., None]
        inside = triangulate(cameras @ basis[:, None], tracks.x, tracks.weights * mine.mT, steps=2)
        total = torch.where(mine, inside @ basis.mT, total)
    return total
