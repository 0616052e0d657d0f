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
    from dyntorch.blocks import one_thread as one_thread
    from dyntorch.devices import on_cpu as on_cpu

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
    "Invariant": "dyntorch.invariant",
    # from matches to the tensor and its motion
    "null_space": "dyntorch.nullspace",
    "fit": "dyntorch.fitting",
    "robust_fit": "dyntorch.robust",
    "constrain": "dyntorch.constrained",
    "refine": "dyntorch.refinement",
    "sampson": "dyntorch.residual",
    "algebraic": "dyntorch.residual",
    "Solution": "dyntorch.solution",
    "Status": "dyntorch.solution",
    # tasks
    "align_planar": "dyntorch.tasks.align_planar",
    "align_points": "dyntorch.tasks.align_points",
    "align_lines": "dyntorch.tasks.align_lines",
    "segment": "dyntorch.tasks.bodies",
    "translating_planes": "dyntorch.tasks.planes",
    "TranslatingPlanes": "dyntorch.tasks.planes_result",
    "Segmentation": "dyntorch.tasks.segmentation",
    "BodyModel": "dyntorch.tasks.segmentation",
    "reconstruct": "dyntorch.tasks.reconstruct",
    "synchronize": "dyntorch.tasks.synchronize",
    "Shift": "dyntorch.tasks.shift",
    "synchronize_cameras": "dyntorch.tasks.sync_cameras",
    "combine_shifts": "dyntorch.tasks.sync_cameras",
    "Clocks": "dyntorch.tasks.sync_clocks",
    "reconstruct_pair": "dyntorch.tasks.reconstruct_pair",
    "PairReconstruction": "dyntorch.tasks.pair_result",
    "undistort": "dyntorch.algebra.lens",
    "distort": "dyntorch.algebra.lens",
    "fit_distortion": "dyntorch.tasks.sync_lens",
    "Motion": "dyntorch.motions",
    "triangulate_trajectories": "dyntorch.tasks.trajectories",
    "LineStatus": "dyntorch.tasks.trajectories",
    "points_on_lines": "dyntorch.tasks.trajectories",
    "trajectory_cameras": "dyntorch.tasks.trajectory_tensor",
    "line_camera": "dyntorch.algebra.line_cameras",
    # projections P^k -> P^l of any k and l
    "triangulate": "dyntorch.algebra.triangulation",
    "resect": "dyntorch.algebra.triangulation",
    "reproject": "dyntorch.algebra.triangulation",
    "bundle_adjust": "dyntorch.bundle_adjustment",
    "structure_covariance": "dyntorch.bundle_information",
    "grassmann_tensor": "dyntorch.algebra.grassmann",
    "joint_epipoles": "dyntorch.algebra.joint_epipoles",
    "hyperplane_pair": "dyntorch.algebra.hyperplane_pair",
    "two_bodies": "dyntorch.algebra.two_bodies",
    "affine_segmentation": "dyntorch.algebra.affine_segmentation",
    "multibody_matrix": "dyntorch.invariants.multibody",
    "projective_factorization": "dyntorch.algebra.projective_factorization",
    "velocity_factorization": "dyntorch.algebra.velocity_factorization",
    # shapes that move: every view from another affine camera
    "fit_shapes": "dyntorch.algebra.dynamic_shape",
    "MovingShapes": "dyntorch.algebra.dynamic_shape",
    "recover_times": "dyntorch.algebra.dynamic_shape_time",
    "Recovery": "dyntorch.algebra.dynamic_shape_time",
    "Polynomial": "dyntorch.algebra.dynamic_shape_basis",
    "Fourier": "dyntorch.algebra.dynamic_shape_basis",
    # how a verb computes: on one thread, the caller's setting untouched; on the CPU, wherever its tensors are
    "one_thread": "dyntorch.blocks",
    "on_cpu": "dyntorch.devices",
    # subspaces and factorization
    "canonical_correlation": "dyntorch.algebra.subspaces",
    "orthonormal_basis": "dyntorch.algebra.subspaces",
    "affine_factorization": "dyntorch.algebra.factorization",
    "metric_upgrade": "dyntorch.algebra.factorization",
}
_MODULES = ("counting", "metrics", "motions", "scenes")
__all__ = sorted([*_HOME, *_MODULES])


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(import_module(_HOME[name]), name)
    if name in _MODULES:
        return import_module(f"dyntorch.{name}")
    raise AttributeError(f"module 'dyntorch' has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
