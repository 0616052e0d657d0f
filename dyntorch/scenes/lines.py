"""Scenes of 3D lines that move sideways between two sensor poses."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from dyntorch.algebra.homogeneous import apply
from dyntorch.scenes.scene import Draw, Scene


def translating_lines(
    n: int = 100,
    *,
    batch: int | Sequence[int] = (),
    sigma: float = 0.0,
    static: float = 0.0,
    outliers: float = 0.0,
    motion: str = "in_plane",
    objects: int = 2,
    static_points: int = 0,
    sensors: str = "projective",
    generator: torch.Generator | None = None,
    dtype: torch.dtype = torch.float64,
) -> Scene:
    r"""Lines of space, each of which stays in a plane, seen from two poses: :math:`l_1` meets :math:`C_2(A)\, l_2`.

    A line is measured by two of its points, within 2 of the origin in each coordinate in view 1; view 2 measures two other
    points of it.  Motions of 0.5 to 2.

    Args:
        n: number of lines.
        batch: shape of the batch of independent scenes.
        sigma: noise of the points, in the unit of the scene.
        static: share of static lines.
        outliers: share of lines of which view 2 is replaced by a random line.
        motion: ``"in_plane"``, the points of a line move in one direction at different speeds; ``"translation"``, each line
            by its own vector; ``"objects"``, lines of a few rigid translating bodies.
        objects: number of bodies for ``motion="objects"``; a line belongs to body i modulo their number.
        static_points: number of additional static points.
        sensors: ``"projective"``, ``"affine"`` (both near rigid) or ``"rigid"``.
        generator: source of all randomness.
        dtype: of the result; the scene is made in float64.

    Returns:
        Scene with ``views`` (l1, l2), two points of each line ``(*batch, n, 2, 3)``; ``motion`` (A,) from view 2 to view 1;
        ``extras["points1"]`` and ``extras["points2"]`` ``(*batch, static_points, 3)`` with noise.

    Raises:
        ValueError: shares outside 0 to 1, negative sigma, n < 1, unknown motion or sensors, no objects.

    Source: thesis section 8.4 (translating lines).

    Example:
        >>> scene = translating_lines(35, batch=2, static_points=3)
        >>> tuple(scene.views[1].shape), tuple(scene.extras["points1"].shape)
        ((2, 35, 2, 3), (2, 3, 3))
    """
    draw = Draw(n, batch, sigma, static, outliers, generator, dtype)
    if objects < 1 or static_points < 0:
        raise ValueError(f"objects must be >= 1 and static_points >= 0, got {objects} and {static_points}")
    maps = draw.sensors(2, sensors)
    ends = draw.uniform(n, 2, 3, low=-2.0, high=2.0)
    moved = ends + torch.where(draw.moving[..., None, None], _motion(draw, motion, objects), 0.0)
    # other points of the moved line, so that the ends of the two views do not correspond
    slide = draw.uniform(n, 2, 1, low=-0.3, high=0.3) + torch.tensor([[0.0], [1.0]], dtype=ends.dtype, device=ends.device)
    other = moved[..., :1, :] + slide * (moved[..., 1:, :] - moved[..., :1, :])
    points = draw.uniform(static_points, 3, low=-2.0, high=2.0)
    seen = [apply(maps[..., v, :, :], points) + sigma * draw.normal(static_points, 3) for v in (0, 1)]
    exact = [_apply_ends(maps[..., v, :, :], x) for v, x in enumerate((ends, other))]
    to_first = maps[..., 0, :, :] @ torch.linalg.inv(maps[..., 1, :, :])
    return draw.scene(exact, (to_first,), points1=seen[0], points2=seen[1])


def _apply_ends(collineation: Tensor, ends: Tensor) -> Tensor:
    """Map the two points ``(*batch, n, 2, 3)`` of each line."""
    return apply(collineation, ends.flatten(-3, -2)).unflatten(-2, ends.shape[-3:-1])


def _motion(draw: Draw, kind: str, objects: int) -> Tensor:
    """``(*batch, n, 2, 3)`` what the two points of each line move by."""
    n = draw.n
    if kind == "in_plane":
        return draw.uniform(n, 2, 1, low=0.5, high=2.0) * draw.directions(n, 1, 3)
    if kind == "translation":
        return draw.uniform(n, 1, 1, low=0.5, high=2.0) * draw.directions(n, 1, 3)
    if kind == "objects":
        shift = draw.uniform(objects, 1, 1, low=0.5, high=2.0) * draw.directions(objects, 1, 3)
        return shift[..., torch.arange(n) % objects, :, :]
    raise ValueError(f"motion must be 'in_plane', 'translation' or 'objects', got {kind!r}")
