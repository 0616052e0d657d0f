"""Two views of planes and bodies that translate independently: all have one rotation relative to the cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize

from dyntorch.geometry.homogeneous import apply, homogeneous, inhomogeneous, skew, unit
from dyntorch.scenes.scene import Draw, calibration

SIZE, FOCAL = 800.0, 800.0
MARGIN = 100.0  # from the border of view 1 to the centres of the patches
BODY = (300.0, 0.15)  # side of a body in view 1, pixels, and its half depth over its distance
MOTION = 0.4  # translation over distance, standard deviation of each coordinate
TURN, SLANT = 0.1, 0.7  # radians; standard deviation of the normals about the line of sight


@dataclass(frozen=True)
class TranslatingScene:
    """Matches of p planes and m bodies, each with its own translation, and the ground truth.

    Attributes:
        x1: ``(*batch, p, n, 2)`` points of the planes in view 1, with noise, pixels.
        x2: the same points in view 2.
        body_x1: ``(*batch, m, n, 2)`` points of the bodies in view 1, with noise.
        body_x2: the same points in view 2.
        homographies: ``(*batch, p, 3, 3)`` of norm 1, view 1 to view 2.
        body_fundamentals: ``(*batch, m, 3, 3)`` of norm 1.
        infinity: ``(*batch, 3, 3)`` of norm 1, homography at infinity, view 1 to view 2.
        epipoles: ``(*batch, p + m, 3)`` in view 2, of the planes first; norm 1, zero where nothing moves.
        normals: ``(*batch, p, 3)``, inverse depth :math:`1/z = n^T x` in view 1.
        rotation: ``(*batch, 3, 3)``, camera 1 to camera 2.
        translations: ``(*batch, p + m, 3)``.
        calibration: ``(3, 3)`` of both cameras.
        sigma: noise, pixels.
    """

    x1: Tensor
    x2: Tensor
    body_x1: Tensor
    body_x2: Tensor
    homographies: Tensor
    body_fundamentals: Tensor
    infinity: Tensor
    epipoles: Tensor
    normals: Tensor
    rotation: Tensor
    translations: Tensor
    calibration: Tensor
    sigma: float

    def to(self, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> TranslatingScene:
        """The scene in another floating point type or on another device."""

        def moved(x: Any) -> Any:
            return x.to(device=device, dtype=dtype) if isinstance(x, Tensor) else x

        return TranslatingScene(**{field.name: moved(getattr(self, field.name)) for field in fields(self)})


def translating_planes(
    planes: int = 5,
    bodies: int = 0,
    n: int = 40,
    *,
    batch: int | Sequence[int] = (),
    sigma: float = 0.0,
    patch: float = 120.0,
    collinear_epipoles: bool = False,
    coplanar_normals: bool = False,
    shared: int = 1,
    static: bool = False,
    generator: torch.Generator | None = None,
    dtype: torch.dtype = torch.float64,
) -> TranslatingScene:
    r"""Planes and bodies that translate independently: :math:`H_i \sim H_\infty + e_i n_i^T,\ F_k = [e_k]_\times H_\infty`.

    Two views of 800 x 800 pixels, focal length 800, rotation of about 0.17 rad.  Each plane is seen in a square patch of view 1,
    at a distance of 4 to 8.

    Args:
        planes: number of planes p.
        bodies: number of bodies m with depth, 300 pixels wide.
        n: matches of each plane and body.
        batch: shape of the batch of independent scenes.
        sigma: noise of both views, pixels.
        patch: side of the patches, pixels.
        collinear_epipoles: all motion is parallel to the ground.
        coplanar_normals: all planes are vertical.
        shared: so many planes, the first ones, are on one body.
        static: the last plane does not move: :math:`e = 0`.
        generator: source of all randomness.
        dtype: of the result; the scene is made in float64.

    Returns:
        A :class:`TranslatingScene`.

    Raises:
        ValueError: negative counts or sigma, a patch that is not positive, ``shared`` not in 1 to ``planes``.

    Source: thesis chapter 5.

    Example:
        >>> import torch
        >>> scene = translating_planes(3, generator=torch.Generator().manual_seed(0))
        >>> bool(torch.allclose(apply(scene.homographies, scene.x1), scene.x2))
        True
    """
    if planes < 0 or bodies < 0 or not patch > 0 or not 1 <= shared <= max(planes, 1):
        raise ValueError(
            f"expected planes, bodies >= 0, patch > 0 and shared in 1 to planes, got {planes}, {bodies}, {patch} and {shared}"
        )
    draw, count = Draw(n, batch, sigma, 0.0, 0.0, generator, torch.float64), planes + bodies
    device = draw.labels.device
    flat = torch.tensor([1.0, 0.0, 1.0], dtype=torch.float64, device=device)  # without the vertical
    k = calibration(torch.tensor(FOCAL, dtype=torch.float64, device=device), SIZE / 2)
    inverse = torch.linalg.inv(k)
    centre = draw.uniform(count, 2, low=MARGIN, high=SIZE - MARGIN)
    distance = draw.uniform(count, 1, low=4.0, high=8.0)
    translation = MOTION * distance * draw.normal(count, 3) * (flat if collinear_epipoles else 1.0)
    if shared > 1:
        translation = torch.cat([translation[..., :1, :].expand(*draw.batch, shared, 3), translation[..., shared:, :]], dim=-2)
    if static and planes:
        translation[..., planes - 1, :] = 0.0
    rotation = draw.rotations(spread=TURN)
    ray = homogeneous(apply(inverse, centre))
    normal = normalize(ray, dim=-1) + SLANT * draw.normal(count, 3)
    # a plane seen edge on would be no plane: the normal is turned to within 60 degrees of the line of sight
    normal = normalize(normal * (flat if coplanar_normals else 1.0), dim=-1)
    facing = normal + normalize(ray * (flat if coplanar_normals else 1.0), dim=-1) * (
        (normal * normalize(ray, dim=-1)).sum(-1, keepdim=True) < 0.5
    )
    normal = facing / (facing * ray * distance).sum(-1, keepdim=True)
    across = torch.where(torch.arange(count, device=device) < planes, patch, BODY[0])[:, None, None]
    x1 = centre[..., None, :] + across * (draw.uniform(count, n, 2) - 0.5)
    rays = homogeneous(apply(inverse, x1))
    depth = (distance * (1 + BODY[1] * (2 * draw.uniform(count, n) - 1)))[..., None]
    depth = torch.cat([1 / (rays @ normal[..., None])[..., :planes, :, :], depth[..., planes:, :, :]], dim=-3)
    x2 = inhomogeneous((rays * depth @ rotation[..., None, :, :].mT + translation[..., None, :]) @ k.mT)
    infinity = k @ rotation @ inverse
    epipoles = translation @ k.mT
    normals = (normal @ inverse)[..., :planes, :]
    x1, x2 = (x + sigma * draw.normal(*x.shape[len(draw.batch) :]) for x in (x1, x2))
    found = TranslatingScene(
        x1=x1[..., :planes, :, :],
        x2=x2[..., :planes, :, :],
        body_x1=x1[..., planes:, :, :],
        body_x2=x2[..., planes:, :, :],
        homographies=unit(infinity[..., None, :, :] + epipoles[..., :planes, :, None] * normals[..., None, :]),
        body_fundamentals=unit(skew(epipoles[..., planes:, :]) @ infinity[..., None, :, :]),
        infinity=unit(infinity),
        epipoles=normalize(epipoles, dim=-1),
        normals=normals,
        rotation=rotation,
        translations=translation,
        calibration=k,
        sigma=sigma,
    )
    return found.to(dtype=dtype)
