"""Scenes of 3D points measured by 3D sensors in different poses: on straight lines, and at constant velocity."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from dyntorch.geometry.homogeneous import apply, skew
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
    views: int = 3,
    generator: torch.Generator | None = None,
    dtype: torch.dtype = torch.float64,
) -> Scene:
    r"""Points of space on straight lines at changing speed, seen from three poses or more: :math:`P_1, A P_2, B P_3` are collinear.

    Points within 2 of the origin in each coordinate at the second instant; steps along the line go forwards or backwards.

    Args:
        n: number of matches.
        batch: shape of the batch of independent scenes.
        sigma: noise, in the unit of the scene.
        static: share of static points.
        outliers: share of matches of which view 2 or 3 is replaced by a random point.
        sensors: ``"projective"``, ``"affine"`` (both near rigid) or ``"rigid"``.
        step: least and greatest distance of the other views from where a point is in the second.
        views: their number.
        generator: source of all randomness.
        dtype: of the result; the scene is made in float64.

    Returns:
        Scene with ``views`` of ``(*batch, n, 3)``; ``motion`` (A, B, ...) from view 2, 3, ... to view 1; ``extras["points"]``
        ``(*batch, n, 3)`` at the second instant in the frame of the world, ``extras["sensors"]`` ``(*batch, views, 4, 4)``.

    Raises:
        ValueError: shares outside 0 to 1, negative sigma, n < 1, unknown sensors.

    Source: thesis section 8.1 (join tensors).

    Example:
        >>> scene = moving_points(7, batch=4, sigma=0.01, static=0.3)
        >>> scene.views[2].shape, scene.motion[0].shape
        (torch.Size([4, 7, 3]), torch.Size([4, 4, 4]))
    """
    draw = Draw(n, batch, sigma, static, outliers, generator, dtype)
    maps = draw.sensors(views, sensors)
    points = draw.uniform(n, 3, low=-2.0, high=2.0)
    # half of the points turn back: near constant speed would leave a family of B almost undetermined
    signs = torch.where(draw.uniform(views - 1, n, 1) < 0.5, -1.0, 1.0)
    directions = torch.where(draw.moving[..., None], draw.directions(n, 3), 0.0)
    steps = signs * draw.uniform(views - 1, n, 1, low=step[0], high=step[1]) * directions[..., None, :, :]
    placed = (points - steps[..., 0, :, :], points, *(points + way for way in steps[..., 1:, :, :].unbind(-3)))
    exact = [apply(maps[..., v, :, :], x) for v, x in enumerate(placed)]
    to_first = [maps[..., 0, :, :] @ torch.linalg.inv(maps[..., v, :, :]) for v in range(1, views)]
    return draw.scene(exact, to_first, points=points, sensors=maps)


def dynamic(
    dim: int = 3,
    views: int = 3,
    step: int = 2,
    n: int = 200,
    *,
    batch: int | Sequence[int] = (),
    sigma: float = 0.0,
    static: float = 0.0,
    outliers: float = 0.0,
    mixed: bool = False,
    generator: torch.Generator | None = None,
    dtype: torch.dtype = torch.float64,
) -> Scene:
    r"""Points of a space of any dimension in any number of views, each moving within a linear subspace of dimension ``step``.

    Points within 2 of the origin in each coordinate at the second instant, and .5 to 2 away from there, in a random direction of
    their flat, at the others.

    Args:
        dim: of the space.
        views: their number.
        step: 1 stands still, 2 moves on a line, 3 in a plane.
        n: number of matches.
        batch: shape of the batch of independent scenes.
        sigma: noise, in the unit of the scene.
        static: share of static points.
        outliers: share of matches of which one view is replaced by a random point.
        mixed: matches stay within subspaces of all dimensions from 1 to ``step``, in turn.
        generator: source of all randomness.
        dtype: of the result; the scene is made in float64.

    Returns:
        Scene with ``views`` of ``(*batch, n, dim)``; ``motion`` the collineations from view 2, 3, ... to view 1;
        ``extras["dimensions"]`` ``(*batch, n)`` of the subspaces, ``extras["points"]`` ``(*batch, n, dim)`` at the second instant.

    Raises:
        ValueError: dim, views or step < 1, shares outside 0 to 1, negative sigma, n < 1.

    Source: thesis section 9.3.

    Example:
        >>> scene = dynamic(3, 4, 3, 7, batch=2)  # in planes
        >>> len(scene.views), scene.views[0].shape, scene.motion[2].shape
        (4, torch.Size([2, 7, 3]), torch.Size([2, 4, 4]))
    """
    if min(dim, views, step) < 1:
        raise ValueError(f"dim, views and step must be 1 or more, got {dim}, {views}, {step}")
    draw = Draw(n, batch, sigma, static, outliers, generator, dtype)
    eye = torch.eye(dim + 1, dtype=torch.float64)
    maps = eye + 0.2 * draw.normal(views, dim + 1, dim + 1)
    # a bounded last row keeps the scene in front of the hyperplane at infinity
    last = torch.cat([draw.uniform(views, 1, dim, low=-0.18 / dim, high=0.18 / dim), torch.ones_like(maps[..., :1, :1])], dim=-1)
    maps = torch.cat([maps[..., :dim, :], last], dim=-2)
    points = draw.uniform(n, dim, low=-2.0, high=2.0)
    turn = torch.arange(n, device=points.device) % step + 1 if mixed else torch.full((n,), step, device=points.device)
    dimensions = torch.where(draw.moving, turn, 1)
    flats = draw.directions(n, max(1, step - 1), dim)
    used = torch.arange(1, max(2, step), device=points.device) < dimensions[..., None]
    along = torch.nn.functional.normalize(draw.normal(views, n, max(1, step - 1)) * used[..., None, :, :], dim=-1)
    way = (along[..., None, :] @ flats[..., None, :, :, :])[..., 0, :] * draw.uniform(views, n, 1, low=0.5, high=2.0)
    present = (torch.arange(views, device=points.device) != 1)[:, None, None]
    placed = points[..., None, :, :] + torch.where(present, way, 0.0)
    exact = [apply(maps[..., v, :, :], placed[..., v, :, :]) for v in range(views)]
    to_first = [maps[..., 0, :, :] @ torch.linalg.inv(maps[..., v, :, :]) for v in range(1, views)]
    return draw.scene(exact, to_first, points=points, dimensions=dimensions)


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


# ----------------------------------------------------------------------------------------------------------------------
# Static scenes for the baselines: two views of a rigid scene, matches by a collineation.


def two_view(
    n: int = 100,
    *,
    batch: int | Sequence[int] = (),
    sigma: float = 0.0,
    outliers: float = 0.0,
    generator: torch.Generator | None = None,
    dtype: torch.dtype = torch.float64,
) -> Scene:
    r"""Static points of space in two views: :math:`x_2^T F x_1 = 0`.

    Two views of 640 x 480 pixels, focal length 700; depths of 4 to 12, baseline 1, rotation of about 0.1 rad.

    Args:
        n: number of matches.
        batch: shape of the batch of independent scenes.
        sigma: noise, pixels.
        outliers: share of matches of which view 2 is replaced by a random point.
        generator: source of all randomness.
        dtype: of the result; the scene is made in float64.

    Returns:
        Scene with ``views`` two ``(*batch, n, 2)``; ``motion`` (F,); ``extras["rotation"]`` and ``extras["translation"]``
        take the frame of camera 1 to that of camera 2, ``extras["points"]`` ``(*batch, n, 3)`` is in the frame of camera 1.

    Raises:
        ValueError: share outside 0 to 1, negative sigma, n < 1.

    Source: Hartley and Zisserman, Multiple View Geometry, chapter 9.

    Example:
        >>> scene = two_view(8, batch=3, sigma=0.5, outliers=0.25)
        >>> tuple(scene.views[0].shape), tuple(scene.motion[0].shape), int((scene.labels == 0).sum())
        ((3, 8, 2), (3, 3, 3), 6)
    """
    draw = Draw(n, batch, sigma, 1.0, outliers, generator, dtype)
    pixel = torch.cat([draw.uniform(n, 1, high=640.0), draw.uniform(n, 1, high=480.0)], dim=-1)
    k = pixel.new_tensor([[700.0, 0.0, 320.0], [0.0, 700.0, 240.0], [0.0, 0.0, 1.0]])
    inverse = torch.linalg.inv(k)
    depth = draw.uniform(n, 1, low=4.0, high=12.0)
    points = torch.cat([apply(inverse, pixel), torch.ones_like(depth)], dim=-1) * depth
    rotation = draw.rotations(spread=0.1)
    # mostly sideways: a baseline along the axis would put the epipole into the image of every scene
    translation = torch.nn.functional.normalize(draw.normal(3) * pixel.new_tensor([1.0, 1.0, 0.4]), dim=-1)
    second = apply(k @ torch.cat([rotation, translation[..., None]], dim=-1), points)
    fundamental = inverse.mT @ skew(translation) @ rotation @ inverse
    return draw.scene((pixel, second), (fundamental,), points=points, rotation=rotation, translation=translation)


def collineation(
    dim: int = 2,
    n: int = 100,
    *,
    batch: int | Sequence[int] = (),
    sigma: float = 0.0,
    outliers: float = 0.0,
    generator: torch.Generator | None = None,
    dtype: torch.dtype = torch.float64,
) -> Scene:
    r"""Matches by a collineation of projective space: :math:`p_1 \sim A p_2`.

    Args:
        dim: dimension of the space; 2 is a homography.
        n: number of matches.
        batch: shape of the batch of independent scenes.
        sigma: noise, in the unit of the points (within 1 of the origin in each coordinate).
        outliers: share of matches of which view 2 is replaced by a random point.
        generator: source of all randomness.
        dtype: of the result; the scene is made in float64.

    Returns:
        Scene with ``views`` two ``(*batch, n, dim)``; ``motion`` (A,) of size ``dim + 1``, from view 2 to view 1.

    Raises:
        ValueError: dim < 1, share outside 0 to 1, negative sigma, n < 1.

    Example:
        >>> scene = collineation(3, 10, batch=2)
        >>> bool(torch.allclose(apply(scene.motion[0], scene.views[1]), scene.views[0]))
        True
    """
    if dim < 1:
        raise ValueError(f"dim must be >= 1, got {dim}")
    draw = Draw(n, batch, sigma, 1.0, outliers, generator, dtype)
    second = draw.uniform(n, dim, low=-1.0, high=1.0)
    matrix = torch.eye(dim + 1, dtype=second.dtype, device=second.device) + 0.2 * draw.normal(dim + 1, dim + 1)
    # a bounded last row keeps the cube of points in front of the hyperplane at infinity
    last = draw.uniform(1, dim + 1, low=-0.5 / dim, high=0.5 / dim)
    last[..., -1] = 1.0
    matrix = torch.cat([matrix[..., :dim, :], last], dim=-2)
    return draw.scene((apply(matrix, second), second), (matrix,))
