"""Scenes of 3D points measured by 3D sensors in different poses: on straight lines, and at constant velocity."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from dyntorch.algebra.homogeneous import apply
from dyntorch.scenes.scene import Draw, Scene

# world to image of the optional third camera: focal length 12 at distance 12 gives coordinates of the scale of the scene
CAMERA = ((12.0, 0.0, 0.0, 0.0), (0.0, 12.0, 0.0, 0.0), (0.0, 0.0, 1.0, 12.0))


def moving_points(
    n: int = 200,
    *,
    batch: int | Sequence[int] = (),
    sigma: float = 0.0,
    static: float = 0.0,
    outliers: float = 0.0,
    sensors: str = "projective",
    step: tuple[float, float] = (0.5, 2.0),
    generator: torch.Generator | None = None,
    dtype: torch.dtype = torch.float64,
) -> Scene:
    r"""Points of space on straight lines at changing speed, seen from three poses: :math:`P_1, A P_2, B P_3` are collinear.

    Points within 2 of the origin in each coordinate at the second instant; steps along the line go forwards or backwards.

    Args:
        n: number of matches.
        batch: shape of the batch of independent scenes.
        sigma: noise, in the unit of the scene.
        static: share of static points.
        outliers: share of matches of which view 2 or 3 is replaced by a random point.
        sensors: ``"projective"``, ``"affine"`` (both near rigid) or ``"rigid"``.
        step: least and greatest motion between views.
        generator: source of all randomness.
        dtype: of the result; the scene is made in float64.

    Returns:
        Scene with ``views`` three ``(*batch, n, 3)``; ``motion`` (A, B) from view 2 and 3 to view 1; ``extras["points"]``
        ``(*batch, n, 3)`` at the second instant in the frame of the world, ``extras["sensors"]`` ``(*batch, 3, 4, 4)``.

    Raises:
        ValueError: shares outside 0 to 1, negative sigma, n < 1, unknown sensors.

    Source: thesis section 8.1 (join tensors).

    Example:
        >>> scene = moving_points(7, batch=4, sigma=0.01, static=0.3)
        >>> scene.views[2].shape, scene.motion[0].shape
        (torch.Size([4, 7, 3]), torch.Size([4, 4, 4]))
    """
    draw = Draw(n, batch, sigma, static, outliers, generator, dtype)
    maps = draw.sensors(3, sensors)
    points = draw.uniform(n, 3, low=-2.0, high=2.0)
    # half of the points turn back: near constant speed would leave a family of B almost undetermined
    signs = torch.where(draw.uniform(2, n, 1) < 0.5, -1.0, 1.0)
    directions = torch.where(draw.moving[..., None], draw.directions(n, 3), 0.0)
    steps = signs * draw.uniform(2, n, 1, low=step[0], high=step[1]) * directions[..., None, :, :]
    placed = (points - steps[..., 0, :, :], points, points + steps[..., 1, :, :])
    exact = [apply(maps[..., v, :, :], x) for v, x in enumerate(placed)]
    to_first = [maps[..., 0, :, :] @ torch.linalg.inv(maps[..., v, :, :]) for v in (1, 2)]
    return draw.scene(exact, to_first, points=points, sensors=maps)


def constant_velocity(
    n: int = 200,
    *,
    batch: int | Sequence[int] = (),
    sigma: float = 0.0,
    static: float = 0.0,
    outliers: float = 0.0,
    sensors: str = "projective",
    velocities: str = "general",
    camera: bool = False,
    generator: torch.Generator | None = None,
    dtype: torch.dtype = torch.float64,
) -> Scene:
    r"""Points of space at constant velocity, seen from three poses: :math:`P_t \sim A_t (x + t v)`, t = 0, 1, 2.

    Points within 2 of the origin at t = 1 in each coordinate, speeds of 0.3 to 1.

    Args:
        n: number of matches.
        batch: shape of the batch of independent scenes.
        sigma: noise, in the unit of the scene.
        static: share of static points.
        outliers: share of matches of which view 2 or 3 is replaced by a random point.
        sensors: ``"projective"``, ``"affine"`` (both near rigid) or ``"rigid"``.
        velocities: ``"general"`` directions, or those of one ``"planar"`` ground, along one ``"linear"`` road, or all
            ``"equal"``; all but the first are degenerate for the tensor.
        camera: the third sensor is a camera with 2D images, :math:`A_2` of size 3 x 4.
        generator: source of all randomness.
        dtype: of the result; the scene is made in float64.

    Returns:
        Scene with ``views`` three ``(*batch, n, 3)``, the last ``(*batch, n, 2)`` with a camera; ``motion`` (A_0, A_1, A_2)
        world to sensor; ``extras["points"]`` x and ``extras["velocities"]`` v ``(*batch, n, 3)``.

    Raises:
        ValueError: shares outside 0 to 1, negative sigma, n < 1, unknown sensors or velocities.

    Source: thesis section 8.3 (constant velocity).

    Example:
        >>> scene = constant_velocity(30, batch=(2,), velocities="planar", camera=True)
        >>> [tuple(view.shape) for view in scene.views], tuple(scene.motion[2].shape)
        ([(2, 30, 3), (2, 30, 3), (2, 30, 2)], (2, 3, 4))
    """
    draw = Draw(n, batch, sigma, static, outliers, generator, dtype)
    maps = list(draw.sensors(3, sensors).unbind(-3))
    v = torch.where(draw.moving[..., None], _velocities(draw, velocities), 0.0)
    x = draw.uniform(n, 3, low=-2.0, high=2.0) - v
    if camera:
        # the camera looks along a sensor that stays near the origin, so that its depths stay positive
        maps[2] = maps[2].new_tensor(CAMERA) @ maps[2]
    exact = [apply(maps[t], x + t * v) for t in range(3)]
    return draw.scene(exact, maps, points=x, velocities=v)


def _velocities(draw: Draw, kind: str) -> Tensor:
    """``(*batch, n, 3)`` velocities of the moving points."""
    speed = draw.uniform(draw.n, 1, low=0.3, high=1.0)
    if kind == "general":
        return speed * draw.directions(draw.n, 3)
    if kind == "planar":
        ground = draw.rotations(1, spread=1.0)[..., :2, :]
        return speed * (draw.directions(draw.n, 2) @ ground[..., 0, :, :])
    if kind == "linear":
        return speed * draw.directions(1, 3)
    if kind == "equal":
        return speed[..., :1, :] * draw.directions(1, 3).expand(*draw.batch, draw.n, 3)
    raise ValueError(f"velocities must be 'general', 'planar', 'linear' or 'equal', got {kind!r}")
