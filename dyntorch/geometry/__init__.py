"""Geometry of homogeneous coordinates, with no invariant in it: points, lines, cameras, epipolar geometry, triangulation.

Functions of tensors that return tensors or small frozen records.  Stands on ``numerics`` alone.
"""

from __future__ import annotations

from typing import Any

from dyntorch import _lazily

_HOME = {
    "undistort": "dyntorch.geometry.lens",
    "distort": "dyntorch.geometry.lens",
    "fit_distortion": "dyntorch.geometry.lens",
    "line_camera": "dyntorch.geometry.extensors",
    "triangulate": "dyntorch.geometry.triangulation",
    "resect": "dyntorch.geometry.triangulation",
    "reproject": "dyntorch.geometry.triangulation",
    "bundle_adjust": "dyntorch.geometry.bundle",
    "grassmann_tensor": "dyntorch.geometry.grassmann",
    "joint_epipoles": "dyntorch.geometry.grassmann",
    "hyperplane_pair": "dyntorch.geometry.pairs",
    "plane_motions": "dyntorch.geometry.rigid",
    "two_bodies": "dyntorch.geometry.pairs",
}
__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    return _lazily(__name__, _HOME, name)


def __dir__() -> list[str]:
    return __all__
