"""Two views of a static scene in which points of a plane move on lines through one of its points: a road and its traffic."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch.nn.functional import normalize

from dyntorch.algebra.homogeneous import apply, homogeneous, skew
from dyntorch.scenes.scene import Draw, Scene

FOCAL, CENTRE = 700.0, (320.0, 240.0)
NORMAL, HEIGHT = (0.0, 0.85, 0.53), 3.25
"""Of the ground in the frame of camera 1, which looks down: points at depths of 4 to 12 fill the image."""


def convergent_motions(
    n: int = 100,
    *,
    batch: int | Sequence[int] = (),
    sigma: float = 0.0,
    static: float = 0.5,
    outliers: float = 0.0,
    parallel: bool = False,
    generator: torch.Generator | None = None,
    dtype: torch.dtype = torch.float64,
) -> Scene:
    r"""Static points of space, and points that move on lines of a plane through a vertex: :math:`x_2^T [e_2]_\times H x_1 = 0`
    or :math:`x_2^T [v_2]_\times H x_1 = 0`.

    Two views of 640 x 480 pixels, focal length 700, of points at depths of 4 to 12; the cameras look down at
    a ground 3.25 away; baseline 1, rotation of about 0.1 rad.  A point that moves goes 0.5 to 2 towards the vertex or away from it.

    Args:
        n: number of matches.
        batch: shape of the batch of independent scenes.
        sigma: noise, pixels.
        static: share of static points.
        outliers: share of matches of which view 2 is replaced by a random point.
        parallel: the lines are parallel, their vertex is at infinity; else it is a point 12 to 30 away.
        generator: source of all randomness.
        dtype: of the result; the scene is made in float64.

    Returns:
        Scene with ``views`` two ``(*batch, n, 2)``; ``motion`` the fundamental matrices of the static points and of the moving
        ones; ``labels`` 0 outlier, 1 static, 2 moving.  ``extras``: ``homography`` ``(*batch, 3, 3)`` of the plane, view 1 to
        view 2, ``epipole`` and ``vertex`` ``(*batch, 3)`` in view 2, ``calibration`` ``(*batch, 3, 3)`` of both views.

    Raises:
        ValueError: share outside 0 to 1, negative sigma, n < 1.

    Source: Bartoli, The geometry of dynamic scenes, 2005.

    Example:
        >>> scene = convergent_motions(8, batch=3)
        >>> tuple(scene.views[0].shape), int((scene.labels == 2).sum())
        ((3, 8, 2), 12)
    """
    draw = Draw(n, batch, sigma, static, outliers, generator, dtype)
    pixel = torch.cat([draw.uniform(n, 1, high=640.0), draw.uniform(n, 1, high=480.0)], dim=-1)
    k = pixel.new_tensor([[FOCAL, 0.0, CENTRE[0]], [0.0, FOCAL, CENTRE[1]], [0.0, 0.0, 1.0]])
    inverse = torch.linalg.inv(k)
    depth = draw.uniform(n, 1, low=4.0, high=12.0)
    still = homogeneous(apply(inverse, pixel)) * depth

    normal = (draw.rotations(spread=0.05) @ pixel.new_tensor(NORMAL)[:, None])[..., 0]
    # on the ground n . X = HEIGHT: across and ahead are free
    flat = torch.cat([depth * draw.uniform(n, 1, low=-0.4, high=0.4), depth], dim=-1)
    side, ahead = draw.uniform(2, 1, low=-8.0, high=8.0), draw.uniform(2, 1, low=12.0, high=30.0)
    flat = torch.cat([flat, torch.cat([side, ahead], dim=-1)], dim=-2)  # and two more points of it
    height = (HEIGHT - (flat * normal[..., None, [0, 2]]).sum(-1)) / normal[..., None, 1]
    ground = torch.stack([flat[..., 0], height, flat[..., 1]], dim=-1)
    before, vertex = ground[..., :n, :], ground[..., n:, :]
    if parallel:
        vertex = normalize(vertex[..., 1:, :] - vertex[..., :1, :], dim=-1)
        way = vertex.expand_as(before)
    else:
        vertex = vertex[..., :1, :]
        way = normalize(vertex - before, dim=-1)
    step = draw.uniform(n, 1, low=0.5, high=2.0) * torch.where(draw.uniform(n, 1) < 0.5, -1.0, 1.0)

    moving = draw.moving[..., None]
    first, after = torch.where(moving, before, still), torch.where(moving, before + step * way, still)
    rotation = draw.rotations(spread=0.1)
    # mostly sideways: a baseline along the axis would put the epipole into the image of every scene
    translation = normalize(draw.normal(3) * pixel.new_tensor([1.0, 1.0, 0.4]), dim=-1)
    homography = k @ (rotation + translation[..., :, None] * normal[..., None, :] / HEIGHT) @ inverse
    image = k @ torch.cat([rotation, translation[..., None]], dim=-1)
    weight = torch.full_like(vertex[..., :1], 0.0 if parallel else 1.0)
    v2 = (image @ torch.cat([vertex, weight], dim=-1).mT)[..., 0]
    e2 = (k @ translation[..., None])[..., 0]
    forms = [skew(e) @ homography for e in (e2, v2)]
    truth = {"homography": homography, "epipole": e2, "vertex": v2, "calibration": k.expand_as(homography)}
    return draw.scene((apply(torch.nn.functional.pad(k, (0, 1)), first), apply(image, after)), forms, **truth)
