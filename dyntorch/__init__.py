"""Geometry of scenes in which everything moves, batched in PyTorch.

Views of points, lines, planes and bodies that all move, from cameras or 3D sensors that move, too; nobody says what stands still.
What a view measures fulfils multilinear invariants; every one of them is estimated on the same path:

- :func:`fit`, :func:`robust_fit`, :func:`refine` and :func:`sampson` take an invariant (:class:`HomographyTensor`,
  :class:`JoinTensor`, :class:`GrassmannTensor`, :class:`ShapeTensor`, ...) and the matches, and give a :class:`Solution`;
- :func:`align_planar`, :func:`align_points`, :func:`align_lines` find the motion of the camera or sensor, and what stood still;
- :func:`segment`, :func:`translating_planes` find which matches move together, and how;
- :func:`reconstruct`, :func:`triangulate_trajectories` find cameras, points and velocities from tracks;
- :func:`synchronize`, :func:`synchronize_cameras`, :func:`reconstruct_pair` put cameras on one clock, and the scene in space.

Points are ``(*batch, n, d)``, as measured; a batch gives what a loop would; NaN is missing; a failed problem has a
:class:`Status` and never spoils its batch.  ``dyntorch.scenes`` makes scenes with known truth to try things on,
``dyntorch.metrics`` measures errors, ``dyntorch.counting`` counts how many matches anything takes, ``dyntorch.motions`` holds the
motion models of :func:`reconstruct`.

The public names are imported lazily, so that ``import dyntorch`` costs nothing before one of them is used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # decorators keep the types of what they decorate only if theirs are known
    from dyntorch.numerics.arguments import on_cpu as on_cpu
    from dyntorch.numerics.blocks import one_thread as one_thread

__version__ = "0.1.0"

_HOME = {
    # invariants: what is measured, and the tensor behind it
    "Collineation": "dyntorch.invariants.collineation",
    "FundamentalMatrix": "dyntorch.invariants.fundamental_matrix",
    "HomographyTensor": "dyntorch.invariants.homography_tensor",
    "DualHomographyTensor": "dyntorch.invariants.dual_homography_tensor",
    "JoinTensor": "dyntorch.invariants.join_tensor",
    "MinimalJoinTensor": "dyntorch.invariants.minimal_join_tensor",
    "ConstantVelocityTensor": "dyntorch.invariants.constant_velocity_tensor",
    "TranslatingLinesMatrix": "dyntorch.invariants.translating_lines_matrix",
    "SegmentationMatrix": "dyntorch.invariants.segmentation_matrix",
    "ConvergentMotionMatrix": "dyntorch.invariants.convergent_motion_matrix",
    "GrassmannTensor": "dyntorch.invariants.grassmann_tensor",
    "ShapeTensor": "dyntorch.invariants.shape_tensor",
    "DynamicShapeTensor": "dyntorch.invariants.dynamic_shape_tensor",
    "Invariant": "dyntorch.core.invariant",
    # from matches to the tensor and its motion
    "null_space": "dyntorch.numerics.nullspace",
    "fit": "dyntorch.core.fit",
    "robust_fit": "dyntorch.core.robust",
    "constrain": "dyntorch.core.refine",
    "refine": "dyntorch.core.refine",
    "sampson": "dyntorch.core.residual",
    "algebraic": "dyntorch.core.residual",
    "Solution": "dyntorch.core.solution",
    "Status": "dyntorch.core.solution",
    # tasks
    "align_planar": "dyntorch.tasks.align.planar",
    "align_points": "dyntorch.tasks.align.points",
    "align_lines": "dyntorch.tasks.align.lines",
    "segment": "dyntorch.tasks.segment.segment",
    "translating_planes": "dyntorch.tasks.planes.planes",
    "TranslatingPlanes": "dyntorch.tasks.planes.planes",
    "Segmentation": "dyntorch.tasks.segment.result",
    "BodyModel": "dyntorch.tasks.segment.result",
    "reconstruct": "dyntorch.tasks.reconstruct.reconstruct",
    "synchronize": "dyntorch.tasks.synchronize.synchronize",
    "Shift": "dyntorch.tasks.synchronize.result",
    "synchronize_cameras": "dyntorch.tasks.synchronize.cameras",
    "combine_shifts": "dyntorch.tasks.synchronize.cameras",
    "Clocks": "dyntorch.tasks.synchronize.result",
    "reconstruct_pair": "dyntorch.tasks.pair.pair",
    "PairReconstruction": "dyntorch.tasks.pair.result",
    "undistort": "dyntorch.geometry.lens",
    "distort": "dyntorch.geometry.lens",
    "fit_distortion": "dyntorch.geometry.lens",
    "Motion": "dyntorch.tasks.reconstruct.motions",
    "triangulate_trajectories": "dyntorch.tasks.trajectories.trajectories",
    "LineStatus": "dyntorch.tasks.trajectories.trajectories",
    "points_on_lines": "dyntorch.tasks.trajectories.trajectories",
    "trajectory_cameras": "dyntorch.tasks.trajectories.trajectories",
    "line_camera": "dyntorch.geometry.lines",
    # projections P^k -> P^l of any k and l
    "triangulate": "dyntorch.geometry.triangulation",
    "resect": "dyntorch.geometry.triangulation",
    "reproject": "dyntorch.geometry.triangulation",
    "bundle_adjust": "dyntorch.geometry.bundle",
    "structure_covariance": "dyntorch.geometry.bundle",
    "grassmann_tensor": "dyntorch.geometry.grassmann",
    "joint_epipoles": "dyntorch.geometry.joint_epipoles",
    "hyperplane_pair": "dyntorch.geometry.pairs",
    "two_bodies": "dyntorch.geometry.pairs",
    "affine_segmentation": "dyntorch.tasks.segment.affine",
    "multibody_matrix": "dyntorch.invariants.multibody",
    "projective_factorization": "dyntorch.tasks.reconstruct.factorization",
    "velocity_factorization": "dyntorch.tasks.reconstruct.factorization",
    # shapes that move: every view from another affine camera
    "fit_shapes": "dyntorch.shapes.moving",
    "MovingShapes": "dyntorch.shapes.moving",
    "recover_times": "dyntorch.shapes.times",
    "Recovery": "dyntorch.shapes.times",
    "Polynomial": "dyntorch.shapes.basis",
    "Fourier": "dyntorch.shapes.basis",
    # how a verb computes: on one thread, the caller's setting untouched; on the CPU, wherever its tensors are
    "one_thread": "dyntorch.numerics.blocks",
    "on_cpu": "dyntorch.numerics.arguments",
    # subspaces and factorization
    "canonical_correlation": "dyntorch.numerics.subspaces",
    "orthonormal_basis": "dyntorch.numerics.subspaces",
    "affine_factorization": "dyntorch.numerics.subspaces",
    "metric_upgrade": "dyntorch.numerics.subspaces",
}
_MODULES = {
    "counting": "dyntorch.counting",
    "metrics": "dyntorch.metrics",
    "motions": "dyntorch.tasks.reconstruct.motions",
    "scenes": "dyntorch.scenes",
}
__all__ = sorted([*_HOME, *_MODULES])


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(import_module(_HOME[name]), name)
    if name in _MODULES:
        return import_module(_MODULES[name])
    raise AttributeError(f"module 'dyntorch' has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
