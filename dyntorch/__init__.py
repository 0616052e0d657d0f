"""Geometry of scenes in which everything moves, batched in PyTorch.

Views of points, lines, planes and bodies that all move, from cameras or 3D sensors that move, too; nobody says what stands still.
What a view measures fulfils multilinear invariants; every one of them is estimated on the same path:

- :func:`fit`, :func:`robust_fit`, :func:`refine` and :func:`sampson` take an invariant (:class:`HomographyTensor`,
  :class:`JoinTensor`, :class:`GrassmannTensor`, :class:`ShapeTensor`, ...) and the matches, and give a :class:`Solution`;
- :func:`align_planar`, :func:`align_points`, :func:`align_lines` find the motion of the camera or sensor, and what stood still;
- :func:`segment`, :func:`segment_tracks`, :func:`translating_planes` find which points move together, and how;
- :func:`reconstruct`, :func:`triangulate_trajectories` find cameras, points and velocities from tracks;
- :func:`synchronize`, :func:`synchronize_cameras`, :func:`reconstruct_pair` put cameras on one clock, and the scene in space;
  :func:`calibrate` finds the cameras themselves.

Points are ``(*batch, n, d)``, as measured; a batch gives what a loop would; NaN is missing; a failed problem has a
:class:`Status` and never spoils its batch.  ``dyntorch.scenes`` makes scenes with known truth to try things on,
``dyntorch.metrics`` measures errors, ``dyntorch.counting`` counts how many matches anything takes, ``dyntorch.motions`` holds the
motion models of :func:`reconstruct`.  The parts that these stand on are in the rooms ``dyntorch.geometry``, ``dyntorch.shapes`` and
``dyntorch.numerics``.

The public names are imported lazily, so that ``import dyntorch`` costs nothing before one of them is used.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any

__version__ = "0.1.0"

_HOME = {
    # invariants: what is measured, and the tensor behind it
    "Collineation": "dyntorch.invariants.collineation",
    "FundamentalMatrix": "dyntorch.invariants.fundamental_matrix",
    "HomographyTensor": "dyntorch.invariants.homography_tensor",
    "DualHomographyTensor": "dyntorch.invariants.dual_homography_tensor",
    "JoinTensor": "dyntorch.invariants.join_tensor",
    "DynamicTensor": "dyntorch.invariants.dynamic_tensor",
    "MinimalJoinTensor": "dyntorch.invariants.minimal_join_tensor",
    "ConstantVelocityTensor": "dyntorch.invariants.constant_velocity_tensor",
    "TranslatingLinesMatrix": "dyntorch.invariants.translating_lines_matrix",
    "SegmentationMatrix": "dyntorch.invariants.segmentation_matrix",
    "ConvergentMotionMatrix": "dyntorch.invariants.convergent_motion_matrix",
    "GrassmannTensor": "dyntorch.invariants.grassmann_tensor",
    "ShapeTensor": "dyntorch.invariants.shape_tensor",
    "LiftedShapeTensor": "dyntorch.invariants.lifted_shape_tensor",
    "DynamicShapeTensor": "dyntorch.invariants.dynamic_shape_tensor",
    "Invariant": "dyntorch.core.invariant",
    # from matches to the tensor and its motion
    "null_space": "dyntorch.numerics.nullspace",
    "fit": "dyntorch.core.fit",
    "robust_fit": "dyntorch.core.robust",
    "constrain": "dyntorch.core.refine",
    "refine": "dyntorch.core.refine",
    "sampson": "dyntorch.core.residual",
    "Solution": "dyntorch.core.solution",
    "Status": "dyntorch.core.outcome",
    # tasks
    "Alignment": "dyntorch.tasks.align.result",
    "align_planar": "dyntorch.tasks.align.planar",
    "align_points": "dyntorch.tasks.align.points",
    "align_lines": "dyntorch.tasks.align.lines",
    "segment": "dyntorch.tasks.segment.segment",
    "segment_tracks": "dyntorch.tasks.segment.tracks",
    "translating_planes": "dyntorch.tasks.planes.planes",
    "TranslatingPlanes": "dyntorch.tasks.planes.planes",
    "Segmentation": "dyntorch.tasks.segment.result",
    "TrackSegmentation": "dyntorch.tasks.segment.result",
    "Reconstruction": "dyntorch.tasks.reconstruct.result",
    "reconstruct": "dyntorch.tasks.reconstruct.reconstruct",
    "synchronize": "dyntorch.tasks.synchronize.synchronize",
    "Shift": "dyntorch.tasks.synchronize.result",
    "synchronize_cameras": "dyntorch.tasks.synchronize.cameras",
    "combine_shifts": "dyntorch.tasks.synchronize.cameras",
    "Clocks": "dyntorch.tasks.synchronize.result",
    "calibrate": "dyntorch.tasks.calibrate.calibrate",
    "Calibration": "dyntorch.tasks.calibrate.result",
    "reconstruct_pair": "dyntorch.tasks.pair.pair",
    "PairReconstruction": "dyntorch.tasks.pair.result",
    "Motion": "dyntorch.tasks.reconstruct.motions",
    "triangulate_trajectories": "dyntorch.tasks.trajectories.trajectories",
    "trajectory_cameras": "dyntorch.tasks.trajectories.trajectories",
    # how a shape moves
    "Polynomial": "dyntorch.shapes.basis",
    "Fourier": "dyntorch.shapes.basis",
    # the numbers that decide in a task
    "AlignOptions": "dyntorch.tasks.align.result",
    "CalibrateOptions": "dyntorch.tasks.calibrate.calibrate",
    "PairOptions": "dyntorch.tasks.pair.pair",
    "PlanesOptions": "dyntorch.tasks.planes.problem",
    "ReconstructOptions": "dyntorch.tasks.reconstruct.result",
    "SegmentOptions": "dyntorch.tasks.segment.segment",
    "SynchronizeOptions": "dyntorch.tasks.synchronize.result",
    "TrackSegmentOptions": "dyntorch.tasks.segment.tracks",
    "TrajectoryOptions": "dyntorch.tasks.trajectories.trajectories",
}
_ROOMS = ("core", "counting", "geometry", "invariants", "metrics", "numerics", "scenes", "shapes", "tasks")
_MODULES = {**{name: f"dyntorch.{name}" for name in _ROOMS}, "motions": "dyntorch.tasks.reconstruct.motions"}
__all__ = sorted([*_HOME, *_MODULES])


def __getattr__(name: str) -> Any:
    return import_module(_MODULES[name]) if name in _MODULES else _lazily(__name__, _HOME, name)


def _lazily(package: str, home: Mapping[str, str], name: str) -> Any:
    """A public name of a package, imported when it is first used."""
    if name in home:
        return getattr(import_module(home[name]), name)
    raise AttributeError(f"module {package!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
