r"""How far the points of each view are from the nearest image of a known shape, with the camera of the view eliminated.

A camera is to the points of a view what a point is to the cameras of several views, so it is eliminated in the same way: point i
sees the unknown camera :math:`P^k \to P^l` through :math:`X_i^T \otimes I`.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.geometry.homogeneous import unit_vectors
from dyntorch.invariants.agreement import Linearization, linearize
from dyntorch.numerics.blocks import constant
from dyntorch.shapes.static import local


@dataclass(frozen=True)
class CameraKind:
    """The cameras that each view may have: all projections :math:`P^k \\to P^l`, or the affine ones among them."""

    k: int = 3
    l: int = 2  # noqa: E741 - its name in the literature
    affine: bool = False

    @property
    def freedom(self) -> int:
        """Degrees of freedom."""
        return self.l * (self.k + 1) if self.affine else (self.k + 1) * (self.l + 1) - 1


def reprojection_residual(structure: Tensor, x: Tensor, scale: Tensor, cameras: CameraKind) -> Tensor:
    r"""Reprojection error that no camera takes away, in standard deviations of noise, to first order. structure
    ``(*batch, n, k + 1)``, x ``(*batch, views, n, l + 1)``, scale ``(*batch,)`` -> ``(*batch, views, l n)``."""
    at, known, _ = _linearize(structure, x, scale, cameras)
    error = at.error - (at.slope @ (at.inverse @ (at.slope.mT @ at.error[..., None])))[..., 0]
    return torch.where(known[..., None], error[..., 0, :], torch.nan)


def reprojection_derivative(structure: Tensor, x: Tensor, scale: Tensor, cameras: CameraKind) -> tuple[Tensor, Tensor]:
    """The residual and its derivative ``(*batch, views, l n, n, k + 1)`` by the points; both 0 where a view says nothing."""
    at, known, length = _linearize(structure, x, scale, cameras)
    known = known[..., None, None]
    project = torch.eye(at.error.shape[-1], dtype=x.dtype, device=x.device) - (at.slope @ at.inverse @ at.slope.mT)[..., 0, :, :]
    error = (project @ at.error.mT)[..., 0]
    n, size = x.shape[-2], cameras.l
    # the image of each point by its own coordinates
    moved = torch.einsum("...k,ark->...ra", at.structure[..., 0, :], _maps(cameras, x.device))  # (.., l + 1, k + 1): the camera
    image, depth, weight = (
        part[..., 0, :].unflatten(-1, (n, size)) for part in (at.image, at.depth, at.weight.expand_as(at.image))
    )
    own = (moved[..., None, :size, :] - image[..., None] * moved[..., None, size:, :]) * (weight / depth)[..., None]
    seen = looked_at(x)[..., None, None]
    own = torch.where(seen, own / length[..., None, None], 0.0)
    derivative = -torch.einsum("...cni,...nia->...cna", project.unflatten(-1, (n, size)), own)
    return torch.where(known[..., 0], error, 0.0), torch.where(known[..., None], derivative, 0.0)


def looked_at(x: Tensor) -> Tensor:
    """Which points of measurements ``(..., n, l + 1)`` are seen."""
    return x[..., -1] > 0


def _linearize(structure: Tensor, x: Tensor, scale: Tensor, cameras: CameraKind) -> tuple[Linearization, Tensor, Tensor]:
    """Cameras and images of all views; which views say something; the lengths ``(*batch, views | 1, n)`` of the points."""
    if structure.ndim < x.ndim:
        structure = structure[..., None, :, :]
    seen = looked_at(x)
    # zero measurements where missing, and zero points there, give zero equations
    p, factor = local(torch.cat([torch.where(seen[..., None], x[..., :-1], 0.0), seen[..., None].to(x)], dim=-1))
    noise = scale[..., None] * factor
    length = structure.norm(dim=-1)
    points = unit_vectors(structure) * seen[..., None]
    looks = torch.einsum("...na,ark->...nrk", points, _maps(cameras, x.device))
    n = x.shape[-2]
    at = linearize(looks.unbind(-3), [p[..., i, None, :-1] for i in range(n)], [noise] * n)
    return at, cameras.l * seen.sum(-1) > cameras.freedom, torch.where(length > 0, length, 1.0)


@constant
def _maps(cameras: CameraKind, device: torch.device) -> Tensor:
    """What point coordinate a shows of camera entry j in image coordinate r: ``(k + 1, l + 1, entries)``."""
    points, images = cameras.k + 1, cameras.l + 1
    maps = torch.einsum("ab,rs->arsb", torch.eye(points), torch.eye(images)).flatten(-2).double()
    if cameras.affine:
        # the last row of the camera is (0, ..., 0, s)
        maps = maps[..., [*range(points * cameras.l), points * images - 1]]
    return maps.to(device)
