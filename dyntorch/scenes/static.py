"""Static scenes for the baselines: two views of a rigid scene, matches by a collineation."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from dyntorch.algebra.homogeneous import apply, skew
from dyntorch.scenes.scene import Draw, Scene


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
