"""Two views of several rigid bodies that move, each in its own way, before a moving camera."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import normalize

from dyntorch.geometry.homogeneous import apply, homogeneous, inhomogeneous, skew, unit
from dyntorch.scenes.scene import OUTLIER, Draw, Scene, calibration, convert

WIDTH, HEIGHT, FOCAL = 640.0, 480.0, 800.0
SPACING = 0.15
"""Share of a cell that stays empty at each side: bodies side by side are 30 % of a cell apart."""


def bodies(
    n: int | Sequence[int] = 100,
    bodies: int | None = None,
    *,
    batch: int | Sequence[int] = (),
    sigma: float = 0.0,
    outliers: float = 0.0,
    interleaved: bool = False,
    planar: Collection[int] = (),
    rotating: Collection[int] = (),
    generator: torch.Generator | None = None,
    dtype: torch.dtype = torch.float64,
) -> Scene:
    r"""Points of several rigid bodies in two views: :math:`x_2^T F_k x_1 = 0` for the points of body k.

    Two views of 640 x 480 pixels, focal length 800, bodies at depths of 5 to 9.  Body 1 stands still, the others turn by about
    0.15 rad about their middle and move by about 50 pixels; so does the camera.  Each body has a cell of the image of its own.

    Args:
        n: number of matches, divided evenly among the bodies; or the numbers of matches of the bodies.
        bodies: how many; 2 where ``n`` does not say it.
        batch: shape of the batch of independent scenes.
        sigma: noise, pixels.
        outliers: share of matches of which view 2 is replaced by a random point; they count for ``n``.
        interleaved: all bodies fill the same part of space and the whole image, like transparent ones.
        planar: bodies, from 1, whose points lie in a plane.
        rotating: bodies, from 1, that turn about the centre of the camera and do not move otherwise.
        generator: source of all randomness.
        dtype: of the result; the scene is made in float64.

    Returns:
        Scene with ``views`` two ``(*batch, n, 2)``, in random order; ``labels`` 0 outlier, 1..K the bodies; ``motion`` one F per
        body, 0 where it is ``rotating``.  ``extras``: ``homographies`` ``(*batch, K, 3, 3)`` of norm 1, view 1 to view 2, 0
        where the body is neither planar nor rotating; ``rotations`` ``(*batch, K, 3, 3)`` and ``translations`` ``(*batch, K,
        3)`` take points of the body from the frame of camera 1 to that of camera 2, ``points`` ``(*batch, n, 3)`` is in the
        frame of camera 1, ``bodies`` ``(*batch, n)`` what a match was before an outlier replaced it.

    Raises:
        ValueError: fewer matches than bodies, numbers that disagree, a body that does not exist, share outside 0 to 1, negative
            sigma.

    Source: thesis chapter 6 (segmentation of two bodies).

    Example:
        >>> import torch
        >>> scene = bodies(9, 3, batch=2, planar=(2,), generator=torch.Generator().manual_seed(0))
        >>> [int((scene.labels == k).sum()) for k in (1, 2, 3)], [tuple(F.shape) for F in scene.motion]
        ([6, 6, 6], [(2, 3, 3), (2, 3, 3), (2, 3, 3)])
        >>> x1, x2 = (homogeneous(x) for x in scene.views)
        >>> bool(((x2 @ scene.motion[0] * x1).sum(-1)[scene.labels == 1]).abs().max() < 1e-9)
        True
    """
    counts = _counts(n, bodies)
    flat, still = (_select_bodies(name, k, len(counts)) for name, k in (("planar", planar), ("rotating", rotating)))
    draw = Draw(sum(counts), batch, sigma, 0.0, outliers, generator, dtype)
    body = _of_match(draw, counts)
    flat, still = flat.to(body.device), still.to(body.device)
    calibration = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64, device=body.device)
    inverse = torch.linalg.inv(calibration)

    pixel, middle = _pixels(draw, body, len(counts), interleaved)
    middle = homogeneous(apply(inverse, middle)) * draw.uniform(len(counts), 1, low=6.0, high=8.0)
    normals = homogeneous(draw.uniform(len(counts), 2, low=-0.6, high=0.6))
    normals = normals / (normals * middle).sum(-1, keepdim=True)  # the plane n^T X = 1 through the middle
    rays = homogeneous(apply(inverse, pixel))
    within = 1 / (_pick(normals, body) * rays).sum(-1)
    around = _pick(middle, body)[..., 2] * draw.uniform(draw.n, low=0.75, high=1.25)
    points = rays * torch.where(flat[body - 1], within, around)[..., None]

    turn, shift = _motions(draw, middle, still)
    moved = (_pick(turn, body) @ points[..., None])[..., 0] + _pick(shift, body)
    homographies = calibration @ (turn + shift[..., :, None] * normals[..., None, :]) @ inverse
    found = draw.scene(
        (pixel, apply(calibration, moved[..., :2] / moved[..., 2:])),
        (inverse.mT @ skew(shift) @ turn @ inverse).unbind(-3),
        homographies=unit(homographies) * (flat | still)[:, None, None],
        rotations=turn,
        translations=shift,
        points=points,
        bodies=body,
    )
    labels = torch.where(found.labels == OUTLIER, OUTLIER, body)
    return replace(found, labels=labels, extras={**found.extras, "moving": body > 1})


def _counts(n: int | Sequence[int], bodies: int | None) -> list[int]:
    """Matches per body."""
    if isinstance(n, int):
        count = 2 if bodies is None else bodies
        counts = [n // count + (k < n % count) for k in range(count)] if count > 0 else []
    else:
        counts = list(n)
    if not counts or min(counts) < 1 or bodies not in (None, len(counts)):
        raise ValueError(
            f"every body needs at least one match, got n={n} for bodies={bodies}; give more matches, or one n per body"
        )
    return counts


def _select_bodies(name: str, chosen: Collection[int], count: int) -> Tensor:
    """``(K,)`` which bodies were named."""
    if not all(1 <= k <= count for k in chosen):
        raise ValueError(f"{name} must name bodies from 1 to {count}, got {tuple(chosen)}")
    return torch.tensor([k in chosen for k in range(1, count + 1)])


def _of_match(draw: Draw, counts: Sequence[int]) -> Tensor:
    """``(*batch, n)`` the body of every match, from 1, in random order."""
    place = draw.uniform(draw.n).argsort(dim=-1)
    bodies = torch.arange(1, len(counts) + 1, device=place.device)
    return bodies.repeat_interleave(torch.tensor(counts, device=place.device))[place]


def _pick(per_body: Tensor, body: Tensor) -> Tensor:
    """``(*batch, n, *item)`` what belongs to the body of every match, of ``(*batch, K, *item)``."""
    item = per_body.shape[body.ndim :]
    index = (body - 1).reshape(*body.shape, *(1 for _ in item)).expand(*body.shape, *item)
    return per_body.gather(body.ndim - 1, index)


def _pixels(draw: Draw, body: Tensor, count: int, interleaved: bool) -> tuple[Tensor, Tensor]:
    """Points in view 1 ``(*batch, n, 2)`` and the middles of the bodies ``(*batch, K, 2)``."""
    columns = 1 if interleaved else math.ceil(math.sqrt(count))
    rows = 1 if interleaved else math.ceil(count / columns)
    cell = torch.zeros_like(body[..., :1]).expand(*draw.batch, count) if interleaved else draw.uniform(count).argsort(dim=-1)
    place = torch.stack([cell % columns, cell // columns], dim=-1)
    size = torch.tensor([WIDTH / columns, HEIGHT / rows], dtype=torch.float64, device=body.device)
    middle = (place + 0.5) * size
    within = draw.uniform(draw.n, 2, low=SPACING, high=1 - SPACING) - 0.5
    return _pick(middle, body) + within * size, middle


def _motions(draw: Draw, middle: Tensor, still: Tensor) -> tuple[Tensor, Tensor]:
    """Rotations ``(*batch, K, 3, 3)`` and translations ``(*batch, K, 3)`` from the frame of camera 1 to that of camera 2."""
    count = middle.shape[-2]
    camera, place = draw.rotations(1, spread=0.03), draw.uniform(1, 3, low=-0.5, high=0.5)
    others = torch.arange(count, device=middle.device)[:, None] > 0
    turn = torch.where(
        others[..., None], draw.rotations(count, spread=0.15), torch.eye(3, dtype=middle.dtype, device=middle.device)
    )
    sideways = middle.new_tensor([1.0, 1.0, 0.4])  # mostly: along the axis, points of view 1 and view 2 would hardly differ
    step = normalize(draw.normal(count, 3) * sideways, dim=-1) * draw.uniform(count, 1, low=0.4, high=0.7) * others
    moved = step + middle - (turn @ middle[..., None])[..., 0]
    shift = (camera @ moved[..., None])[..., 0] + place
    about = draw.rotations(count, spread=0.06)
    return torch.where(still[:, None, None], about, camera @ turn), torch.where(still[:, None], 0.0, shift)


# ----------------------------------------------------------------------------------------------------------------------
# Two views of a static scene in which points of a plane move on lines through one of its points: a road and its traffic.


CONVERGENT_FOCAL, CENTRE = 700.0, (320.0, 240.0)
NORMAL, CONVERGENT_HEIGHT = (0.0, 0.85, 0.53), 3.25
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
    k = pixel.new_tensor([[CONVERGENT_FOCAL, 0.0, CENTRE[0]], [0.0, CONVERGENT_FOCAL, CENTRE[1]], [0.0, 0.0, 1.0]])
    inverse = torch.linalg.inv(k)
    depth = draw.uniform(n, 1, low=4.0, high=12.0)
    still = homogeneous(apply(inverse, pixel)) * depth

    normal = (draw.rotations(spread=0.05) @ pixel.new_tensor(NORMAL)[:, None])[..., 0]
    # on the ground n . X = HEIGHT: across and ahead are free
    flat = torch.cat([depth * draw.uniform(n, 1, low=-0.4, high=0.4), depth], dim=-1)
    side, ahead = draw.uniform(2, 1, low=-8.0, high=8.0), draw.uniform(2, 1, low=12.0, high=30.0)
    flat = torch.cat([flat, torch.cat([side, ahead], dim=-1)], dim=-2)  # and two more points of it
    height = (CONVERGENT_HEIGHT - (flat * normal[..., None, [0, 2]]).sum(-1)) / normal[..., None, 1]
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
    homography = k @ (rotation + translation[..., :, None] * normal[..., None, :] / CONVERGENT_HEIGHT) @ inverse
    image = k @ torch.cat([rotation, translation[..., None]], dim=-1)
    weight = torch.full_like(vertex[..., :1], 0.0 if parallel else 1.0)
    v2 = (image @ torch.cat([vertex, weight], dim=-1).mT)[..., 0]
    e2 = (k @ translation[..., None])[..., 0]
    forms = [skew(e) @ homography for e in (e2, v2)]
    truth = {"homography": homography, "epipole": e2, "vertex": v2, "calibration": k.expand_as(homography)}
    return draw.scene((apply(torch.nn.functional.pad(k, (0, 1)), first), apply(image, after)), forms, **truth)


# ----------------------------------------------------------------------------------------------------------------------
# Two views of planes and bodies that translate independently: all have one rotation relative to the cameras.


SIZE = 800.0  # px, the side of the images
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
        return convert(self, dtype, device)


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
