"""Scenes in a plane seen by a moving calibrated camera: moving points, and lines through static points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import normalize

from dyntorch.geometry.homogeneous import apply, homogeneous
from dyntorch.scenes.scene import Draw, Scene

WIDTH, HEIGHT, FOCAL = 640, 480, 700.0


def planar(
    n: int = 100,
    *,
    batch: int | Sequence[int] = (),
    sigma: float = 0.0,
    static: float = 0.0,
    outliers: float = 0.0,
    step: tuple[float, float] = (25.0, 80.0),
    views: int = 3,
    generator: torch.Generator | None = None,
    dtype: torch.dtype = torch.float64,
) -> Scene:
    r"""Points of a plane that move on straight lines at changing speed: :math:`\det[p_1, A p_2, B p_3] = 0`.

    Three views or more of 640 x 480 pixels, focal length 700, of a plane seen at a slant; a point moves along its line from where
    it is in the second view by a random amount, forwards or backwards, in pixels of that view.

    Args:
        n: number of matches.
        batch: shape of the batch of independent scenes.
        sigma: noise, pixels.
        static: share of static points.
        outliers: share of matches of which view 2 or 3 is replaced by a random point.
        step: least and greatest motion between the second view and another, pixels.
        views: their number.
        generator: source of all randomness.
        dtype: of the result; the scene is made in float64.

    Returns:
        Scene with ``views`` of ``(*batch, n, 2)``; ``motion`` (A, B, ...), the homographies of the plane from view 2, 3, ... to
        view 1.  A single-view outlier of a static match still satisfies the equation: see ``extras["moving"]``.

    Raises:
        ValueError: shares outside 0 to 1, negative sigma, n < 1.

    Source: thesis chapter 2 (homography tensor).

    Example:
        >>> import torch
        >>> scene = planar(5, generator=torch.Generator().manual_seed(0))
        >>> p1, p2, p3 = (homogeneous(x) for x in scene.views)
        >>> A, B = scene.motion
        >>> cosine = normalize(p1) * normalize(torch.linalg.cross(p2 @ A.mT, p3 @ B.mT))
        >>> bool(cosine.sum(-1).abs().max() < 1e-10)
        True
    """
    draw = Draw(n, batch, sigma, static, outliers, generator, dtype)
    to_image = _plane_to_images(draw, views)
    angle = draw.uniform(n, high=2 * torch.pi)
    # half of the points turn back: near constant speed would leave a family of B undetermined (four times the error)
    signs = (n, views - 1, 1)
    steps = draw.uniform(*signs, low=step[0], high=step[1]) * torch.where(draw.uniform(*signs) < 0.5, -1.0, 1.0)
    path = torch.stack([angle.cos(), angle.sin()], dim=-1)[..., None, :] * steps
    path = torch.where(draw.moving[..., None, None], path, 0.0)
    middle = _in_image(draw)
    # the straight paths are drawn in the second view and carried over to the others by the plane
    from_second = to_image @ torch.linalg.inv(to_image[..., 1:2, :, :])
    placed = (middle - path[..., 0, :], middle, *(middle + way for way in path[..., 1:, :].unbind(-2)))
    exact = [apply(from_second[..., v, :, :], x) for v, x in enumerate(placed)]
    return draw.scene(exact, _to_first(to_image))


def lines_concurrent(
    n: int = 100,
    *,
    batch: int | Sequence[int] = (),
    sigma: float = 0.0,
    static: float = 0.0,
    outliers: float = 0.0,
    generator: torch.Generator | None = None,
    dtype: torch.dtype = torch.float64,
) -> Scene:
    r"""Three lines, one per view, through one static point of a plane: :math:`\det[l_1, A^{-T} l_2, B^{-T} l_3] = 0`.

    The dual of :func:`planar`, with its cameras.  A line is measured by two points 60 to 160 pixels apart, which carry the
    noise.

    Args:
        n: number of matches.
        batch: shape of the batch of independent scenes.
        sigma: noise of the two points, pixels.
        static: share of matches that are one and the same static line in all views (the dual of a static point).
        outliers: share of matches of which the line of view 2 or 3 is replaced by a random line.
        generator: source of all randomness.
        dtype: of the result; the scene is made in float64.

    Returns:
        Scene with ``views`` three ``(*batch, n, 3)``, lines with unit normals; ``motion`` (A, B) maps points from view 2 and
        3 to view 1; ``extras["segments"]`` ``(*batch, 3, n, 2, 2)`` the noisy points, ``extras["points"]`` ``(*batch, 3, n,
        2)`` the exact images of the static points.

    Raises:
        ValueError: shares outside 0 to 1, negative sigma, n < 1.

    Source: thesis chapter 2 (homography tensor, upper indices).

    Example:
        >>> import torch
        >>> scene = lines_concurrent(5, generator=torch.Generator().manual_seed(0))
        >>> bool((scene.views[0] * homogeneous(scene.extras["points"][0])).sum(-1).abs().max() < 1e-9)
        True
    """
    draw = Draw(n, batch, sigma, static, outliers, generator, dtype)
    to_image = _plane_to_images(draw)
    from_second = to_image @ torch.linalg.inv(to_image[..., 1:2, :, :])
    middle = _in_image(draw)
    angle = draw.uniform(3, n, high=torch.pi)
    reach = draw.uniform(3, n, 2, 1, low=30.0, high=80.0) * torch.tensor([[-1.0], [1.0]], dtype=torch.float64, device=angle.device)
    points, segments = [], []
    for v in range(3):
        to_view = from_second[..., v, :, :]
        # a moving match has its own direction in each view; a static line has that of the second, carried over
        direction = torch.stack([angle[..., v, :].cos(), angle[..., v, :].sin()], dim=-1)
        common = torch.stack([angle[..., 1, :].cos(), angle[..., 1, :].sin()], dim=-1)
        here = apply(to_view, middle)
        carried = normalize(apply(to_view, middle + common) - here, dim=-1)
        along = torch.where(draw.moving[..., None], direction, carried)
        points.append(here)
        segments.append(here[..., None, :] + reach[..., v, :, :, :] * along[..., None, :])
    found = draw.scene(segments, _to_first(to_image), points=torch.stack(points, dim=-3))
    return replace(
        found,
        views=tuple(map(_lines, found.views)),
        exact=tuple(map(_lines, found.exact)),
        extras={**found.extras, "segments": torch.stack(found.views, dim=-4)},
    )


def _lines(segments: Tensor) -> Tensor:
    """``(*batch, n, 3)`` lines with unit normals through the two points ``(*batch, n, 2, 2)``."""
    first, second = homogeneous(segments).unbind(-2)
    line = torch.linalg.cross(first, second)
    return line / line[..., :2].norm(dim=-1, keepdim=True)


def _in_image(draw: Draw) -> Tensor:
    """``(*batch, n, 2)`` points all over the image."""
    return torch.stack([draw.uniform(draw.n, high=WIDTH), draw.uniform(draw.n, high=HEIGHT)], dim=-1)


def _to_first(to_image: Tensor) -> list[Tensor]:
    """A, B, ..., from the second, the third, ... view to the first."""
    return [to_image[..., 0, :, :] @ torch.linalg.inv(to_image[..., v, :, :]) for v in range(1, to_image.shape[-3])]


def _plane_to_images(draw: Draw, views: int = 3) -> Tensor:
    r"""``(*batch, views, 3, 3)`` maps :math:`K R\,[e_1, e_2, -c]` of the plane z = 0 to views that look at its origin."""
    slant = draw.uniform(1, low=0.35, high=0.7) + draw.uniform(views, low=-0.15, high=0.15)
    around = draw.uniform(1, high=2 * torch.pi) + draw.uniform(views, low=-0.4, high=0.4)
    distance = draw.uniform(views, 1, low=6.0, high=8.0)
    ray = torch.stack([slant.sin() * around.cos(), slant.sin() * around.sin(), -slant.cos()], dim=-1)
    up = torch.zeros_like(ray)
    up[..., 1] = 1.0
    x = normalize(torch.linalg.cross(up, -ray), dim=-1)
    rotation = draw.rotations(views, spread=0.03) @ torch.stack([x, torch.linalg.cross(-ray, x), -ray], dim=-2)
    plane = torch.cat([torch.eye(3, 2, dtype=ray.dtype, device=ray.device).expand(*ray.shape, 2), -(ray * distance)[..., None]], -1)
    calibration = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], dtype=ray.dtype, device=ray.device)
    return calibration @ rotation @ plane


# ----------------------------------------------------------------------------------------------------------------------
# Scenes of 3D lines that move sideways between two sensor poses.


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
