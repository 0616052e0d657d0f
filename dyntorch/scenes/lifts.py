"""Scenes of the motions that become static in a higher projective space, with lifts written down independently of the library."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from dyntorch.geometry.homogeneous import homogeneous, inhomogeneous
from dyntorch.scenes.scene import OUTLIER, Draw, calibration, convert, looking_at

CENTRE, FOCAL, DISTANCE = 500.0, 1300.0, 4.0
SPEED, ACCELERATION = 0.12, 0.03  # rms, scene units (the rms radius is 1) per unit of time and per its square
FAR_OFF = (100.0, 0.3)  # largest displacement of an outlier: pixels; scene units, which are as many pixels at the distance


class LiftedKind(NamedTuple):
    """One motion: coordinates of the world, of which the first ``axes`` move as polynomials of a degree in time."""

    dim: int
    axes: int
    degree: int
    views: int
    bodies: int = 1
    sensors: bool = False


KINDS = {
    "static_2d": LiftedKind(2, 0, 0, views=2),
    "static_3d": LiftedKind(3, 0, 0, views=2),
    "constant_direction_2d": LiftedKind(2, 1, 1, views=3),
    "constant_velocity_2d": LiftedKind(2, 2, 1, views=3),
    "constant_acceleration_2d": LiftedKind(2, 2, 2, views=4),
    "constant_direction_3d": LiftedKind(3, 1, 1, views=3),
    "constant_velocity_planes_3d": LiftedKind(3, 2, 1, views=4),
    "constant_velocity_3d": LiftedKind(3, 3, 1, views=4),
    "constant_velocity_3d_sensors": LiftedKind(3, 3, 1, views=3, sensors=True),
    "two_bodies_2d": LiftedKind(2, 0, 0, views=2, bodies=2),
    "two_bodies_3d": LiftedKind(3, 0, 0, views=3, bodies=2),
}


@dataclass(frozen=True)
class LiftedScene:
    """Tracks with their ground truth: K = k + 1 coordinates of the lifted points, world dimension d, images of dimension l.

    Attributes:
        tracks: ``(*batch, views, n, l)`` with noise and outliers, NaN where missing; pixels, for sensors scene units.
        exact: the same without noise, outliers and gaps.
        lifts: ``(views, d + 1, K)``, the world point at view i is ``lifts[i] @ structure``; None for two bodies.
        cameras: ``(*batch, views, l + 1, d + 1)``, of any scale.
        structure: ``(*batch, n, K)`` homogeneous lifted points; two bodies: (position, 1, 0 or 1).
        labels: ``(*batch, n)``: 0 outlier, 1 static, 2 moving; two bodies: 0 outlier, 1 and 2 the bodies.
        times: ``(views,)``.
        sigma: standard deviation of the noise, in the unit of the tracks.
        points: ``(*batch, n, d)`` positions at time 0; two bodies: in the coordinates of the body.
        velocities: ``(*batch, n, d)`` at time 0, per unit of time; None for two bodies.
        displacements: ``(*batch, views, d)`` of body 2 against body 1 at each view, two bodies only.
    """

    tracks: Tensor
    exact: Tensor
    lifts: Tensor | None
    cameras: Tensor
    structure: Tensor
    labels: Tensor
    times: Tensor
    sigma: float
    points: Tensor
    velocities: Tensor | None = None
    displacements: Tensor | None = None

    @property
    def projections(self) -> Tensor:
        r"""``(*batch, views, l + 1, K)``: :math:`M_i = P_i B_i`, for two bodies :math:`[Q_i \mid q_i \mid Q_i d_i]`."""
        if self.lifts is not None:
            return self.cameras @ self.lifts
        assert self.displacements is not None
        moved = self.cameras[..., :-1] @ self.displacements[..., None]
        return torch.cat([self.cameras, moved], dim=-1)

    def to(self, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> LiftedScene:
        """The scene in another floating point type or on another device; labels stay integers."""
        return convert(self, dtype, device)


def lifted_points(
    motion: str,
    n: int = 60,
    views: int | None = None,
    times: Sequence[float] | Tensor | None = None,
    *,
    sigma: float = 0.0,
    outliers: float = 0.0,
    static: float | None = None,
    missing: float = 0.0,
    batch: int | Sequence[int] = (),
    jitter: float = 0.5,
    drift: float = 0.5,
    generator: torch.Generator | None = None,
    dtype: torch.dtype = torch.float64,
) -> LiftedScene:
    r"""Tracks of moving points whose lifted points are static: :math:`x_i \sim P_i B_i Y`.

    The points fill a ball (a disc of the plane z = 0) of rms radius 1 at the mean time and move at 0.12 per unit of time
    (rms), with ``constant_acceleration_2d`` and :math:`t^2` times 0.03 as well.  Cameras of 1000 x 1000 pixels and focal
    lengths of about 1300, about 4 away, look at the scene, at a plane obliquely; their path is not uniform unless ``jitter``
    is 0, which is degenerate for some motions.

    Args:
        motion: a name in :data:`KINDS`.
        n: number of points.
        views: their number, by default as many as ``times`` has, or as the upgrade to the scene needs.
        times: of the views, equal ones allowed; 0, 1, 2, ... by default.
        sigma: noise, pixels (3D sensors: scene units, as everything of theirs).
        outliers: share of points displaced in one view, uniformly within 100 pixels (0.3) in each coordinate.
        static: share of static points among the others, 0 by default; two bodies: share of body 1, half by default.
        missing: probability that an observation is missing; every point keeps the views that triangulate it.
        batch: shape of the batch of independent scenes.
        jitter: standard deviation of the cameras' random displacements (3D sensors are always random).
        drift: length of their uniform motion from the first time to the last.
        generator: source of all randomness.
        dtype: of the result; the scene is made in float64.

    Returns:
        LiftedScene.

    Raises:
        ValueError: unknown motion, shares outside 0 to 1, negative sigma, n < 1, fewer than 1 view, ``views`` and ``times``
            that disagree.

    Source: thesis chapter 3 and section 8.3.

    Example:
        >>> import torch
        >>> scene = lifted_points("constant_velocity_2d", 20, views=5, batch=2, generator=torch.Generator().manual_seed(0))
        >>> tuple(scene.tracks.shape), tuple(scene.lifts.shape), tuple(scene.cameras.shape), tuple(scene.structure.shape)
        ((2, 5, 20, 2), (5, 3, 5), (2, 5, 3, 3), (2, 20, 5))
        >>> q = scene.structure[:, None] @ scene.projections.mT
        >>> bool((q[..., :2] / q[..., 2:] - scene.exact).abs().max() < 1e-9)
        True
    """
    if motion not in KINDS:
        raise ValueError(f"motion must be one of {', '.join(KINDS)}, got {motion!r}")
    if not 0 <= missing < 1:
        raise ValueError(f"missing is a share from 0 to below 1, got {missing}")
    kind = KINDS[motion]
    draw = Draw(n, batch, sigma, (kind.bodies - 1) / 2 if static is None else static, outliers, generator, dtype)
    t = _times(views, times, kind.views, draw)
    cameras = draw.sensors(len(t), "projective") if kind.sensors else _cameras(draw, t, jitter, drift, plane=kind.dim == 2)
    middle = _ball(draw, kind.dim)
    truth = _bodies(draw, t, cameras, middle) if kind.bodies > 1 else _polynomial_truth(draw, t, cameras, middle, kind)
    exact = inhomogeneous(truth.structure[..., None, :, :] @ truth.projections.mT)
    truth = replace(truth, exact=exact, tracks=_observe(draw, exact, missing, truth.structure.shape[-1] - 1))
    return truth.to(dtype)


def _times(views: int | None, times: Sequence[float] | Tensor | None, default: int, draw: Draw) -> Tensor:
    """``(views,)`` on the device of the generator."""
    device = draw.labels.device
    if times is None:
        count = default if views is None else views
        if count < 1:
            raise ValueError(f"a scene needs views >= 1, got {count}")
        return torch.arange(count, dtype=torch.float64, device=device)
    t = torch.as_tensor(times, dtype=torch.float64, device=device)
    if t.ndim != 1 or len(t) < 1 or views not in (None, len(t)):
        raise ValueError(f"times must be (views,), one per view, got shape {tuple(t.shape)} and views={views}")
    return t


def _fraction(t: Tensor) -> Tensor:
    """Times from their mean, in units of their range."""
    return (t - t.mean()) / (t.max() - t.min()).clamp(min=torch.finfo(t.dtype).tiny)


def _ball(draw: Draw, dim: int) -> Tensor:
    """``(*batch, n, dim)`` uniform in a ball of rms radius 1."""
    return draw.directions(draw.n, dim) * draw.uniform(draw.n, 1) ** (1 / dim) * ((dim + 2) / dim) ** 0.5


def _cameras(draw: Draw, t: Tensor, jitter: float, drift: float, plane: bool) -> Tensor:
    """``(*batch, views, 3, 4)``, of a plane ``(*batch, views, 3, 3)``: its collineations to the images."""
    views = len(t)
    from_axis = draw.uniform(1, low=0.35, high=0.8) if plane else draw.uniform(1, low=-1.0, high=1.0).acos()
    around = draw.uniform(1, high=2 * torch.pi)
    away = torch.stack([from_axis.sin() * around.cos(), from_axis.sin() * around.sin(), from_axis.cos()], dim=-1)
    side = torch.linalg.cross(away, draw.directions(1, 3))  # a camera that only approaches would see little
    path = drift * _fraction(t)[:, None] * torch.nn.functional.normalize(side, dim=-1)
    # bounded, so that no camera comes into the scene
    position = DISTANCE * away + path + jitter * draw.uniform(views, 3, low=-(3**0.5), high=3**0.5)
    up = torch.nn.functional.normalize(torch.linalg.cross(away, draw.directions(1, 3)), dim=-1) + 0.1 * draw.normal(views, 3)
    pose = looking_at(position, 0.1 * draw.normal(views, 3), up)
    cameras = calibration(FOCAL * draw.uniform(views, low=0.95, high=1.05), CENTRE) @ pose
    return cameras[..., [0, 1, 3]] if plane else cameras


def _polynomial_truth(draw: Draw, t: Tensor, cameras: Tensor, middle: Tensor, kind: LiftedKind) -> LiftedScene:
    """The truth of points that move as polynomials in time."""
    dim, axes = kind.dim, kind.axes
    eye = torch.eye(dim + 1, dtype=t.dtype, device=t.device)
    lifts = torch.stack([torch.cat([eye, *(s**power * eye[:, :axes] for power in range(1, kind.degree + 1))], -1) for s in t])
    moving = draw.moving[..., None]
    a = torch.where(moving, ACCELERATION / axes**0.5 * draw.normal(draw.n, axes), 0.0) if kind.degree > 1 else None
    v = torch.where(moving, SPEED / max(axes, 1) ** 0.5 * draw.normal(draw.n, axes), 0.0)
    # x + (t - m) v + (t - m)^2 a, expanded in powers of t
    m, x = t.mean(), middle.clone()
    x[..., :axes] += (0.0 if a is None else m**2 * a) - m * v
    v = v if a is None else v - 2 * m * a
    structure = torch.cat([homogeneous(x), *(part for part in (v, a)[: kind.degree] if part is not None)], dim=-1)
    velocities = torch.cat([v, torch.zeros_like(x[..., axes:])], dim=-1)
    return LiftedScene(x, x, lifts, cameras, structure, draw.labels, t, draw.sigma, x, velocities)


def _bodies(draw: Draw, t: Tensor, cameras: Tensor, points: Tensor) -> LiftedScene:
    """The truth of two bodies, of which the second moves against the first along a smooth path with jitter."""
    dim = points.shape[-1]
    path = _fraction(t)[:, None] * draw.directions(1, dim) + 0.2 * draw.normal(len(t), dim)
    structure = torch.cat([homogeneous(points), draw.moving[..., None].to(points.dtype)], dim=-1)
    return LiftedScene(points, points, None, cameras, structure, draw.labels, t, draw.sigma, points, None, path)


def _observe(draw: Draw, exact: Tensor, missing: float, k: int) -> Tensor:
    """Noise, outliers in one observed view of a point, and gaps that leave every point ``k / l`` views."""
    views, n, size = exact.shape[-3:]
    order = draw.uniform(views, n).argsort(dim=-2)
    seen = (draw.uniform(views, n) >= missing) | (order < -(-k // size))
    reach = FAR_OFF[size - 2]
    off = draw.uniform(n, size, low=-reach, high=reach)[..., None, :, :]
    hit = (draw.labels == OUTLIER)[..., None, :] & (order == 0)
    tracks = exact + draw.sigma * draw.normal(views, n, size) + torch.where(hit[..., None], off, 0.0)
    return torch.where(seen[..., None], tracks, torch.nan)
