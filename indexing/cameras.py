"""Cameras that look at 3D joints: the camera a recording came with, and virtual ones placed around the person."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from indexing.clip import Clip, FloatArray

DISTANCE = 4.5  # metres from the clip's mean to a virtual camera
HEIGHT = 1.5  # metres: 3D clips are scaled to this median height before they are rendered
NOISE = 0.015  # metres: standard deviation of the noise on every 3D joint coordinate


def y_up(clip: Clip) -> FloatArray:
    """``(frames, joints, dims)`` the clip's joints turned so that y points up (by a rotation: handedness is kept in 3D)."""
    joints = clip.joints
    if clip.up == "y":
        return joints
    if clip.dims == 2:
        return joints * np.array([1.0, -1.0], dtype=joints.dtype)
    x, y, z = np.moveaxis(joints, 2, 0)
    turned = {"-y": (x, -y, -z), "z": (x, z, -y), "-z": (x, -z, y)}[clip.up]
    return np.stack(turned, axis=2)


def perspective(clip: Clip) -> Clip:
    """The image of a clip whose 3D joints are in camera coordinates: ``(x / z, y / z)``."""
    _need_3d(clip, "a perspective camera")
    if clip.up.endswith("z"):
        raise ValueError(f"clip {clip.name!r}: camera coordinates have z along the optical axis, but the clip says up={clip.up!r}")
    depth = clip.joints[..., 2]
    if (depth <= 0).any():
        raise ValueError(
            f"clip {clip.name!r}: a joint has depth z = {np.nanmin(depth):g} <= 0, so the joints are not in camera coordinates; "
            "use a virtual camera instead"
        )
    return clip.replace(joints=clip.joints[..., :2] / depth[..., None])


def virtual(
    clip: Clip,
    azimuth: float,
    elevation: float = 0.1,
    *,
    distance: float = DISTANCE,
    height: float = HEIGHT,
    noise: float = NOISE,
    random_state: np.random.Generator | None = None,
) -> Clip:
    """The image of a 3D clip in a perspective camera turned about the person.

    Args:
        azimuth: degrees about the vertical; 0 keeps the viewing direction of the data (along z).
        elevation: radians of turn about the horizontal image axis.
        distance, height, noise: metres; the clip is scaled to ``height`` (median over frames of the vertical extent).
        random_state: source of the noise; ``None`` renders without noise.

    Returns:
        a 2D clip with y up.
    """
    _need_3d(clip, "a virtual camera")
    points = y_up(clip).astype(np.float64)
    seen: NDArray[np.bool_] = np.asarray(np.isfinite(points).all(axis=2))
    if not seen.any():
        raise ValueError(f"clip {clip.name!r}: no joint was seen in any frame; leave the clip out")
    with np.errstate(all="ignore"):
        extents = np.array([np.ptp(points[i, seen[i], 1]) for i in range(len(points)) if seen[i].sum() > 1])
    extent = float(np.median(extents)) if len(extents) else 0.0
    if not extent > 0:
        raise ValueError(f"clip {clip.name!r}: the joints have no vertical extent (all zero?); leave the clip out")
    points = (points - points[seen].mean(axis=0)) * (height / extent)
    if random_state is not None:
        points = points + random_state.normal(scale=noise, size=points.shape)
    points = points @ rotation(np.deg2rad(azimuth), elevation).T
    if np.nanmin(points[..., 2]) <= -distance:
        raise ValueError(
            f"clip {clip.name!r}: a joint lies behind the virtual camera at {distance:g} m; cut the clip where the person leaves, "
            "or move the camera away"
        )
    return clip.replace(joints=points[..., :2] / (points[..., 2:] + distance) * distance, up="y")


def rotation(azimuth: float, elevation: float) -> FloatArray:
    """``(3, 3)``: a turn about the vertical (y) by ``azimuth``, then about the horizontal (x) by ``elevation``, radians."""
    ca, sa, ce, se = np.cos(azimuth), np.sin(azimuth), np.cos(elevation), np.sin(elevation)
    about_y = np.array([[ca, 0.0, sa], [0.0, 1.0, 0.0], [-sa, 0.0, ca]])
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, ce, -se], [0.0, se, ce]])
    return about_x @ about_y


def _need_3d(clip: Clip, what: str) -> Any:
    if clip.dims != 3:
        raise ValueError(f"clip {clip.name!r}: {what} needs 3D joints, got {clip.dims}D")
