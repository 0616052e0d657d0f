"""Errors that do not depend on what an estimate leaves open: scale and sign, the affinity of the world, a common velocity.

A failed estimate (NaN, or no solution at all) has the worst error, not NaN, so that medians over a batch count it.
"""

from dyntorch.metrics.errors import (
    LabelScores,
    LiftedError,
    affine_gauge,
    body_error,
    grid_transfer_error,
    label_scores,
    lifted_error,
    misclassification,
    point_error,
    relative_error,
    rotation_error,
    subspace_angle,
    translation_error,
)

__all__ = [
    "LabelScores",
    "LiftedError",
    "affine_gauge",
    "body_error",
    "grid_transfer_error",
    "label_scores",
    "lifted_error",
    "misclassification",
    "point_error",
    "relative_error",
    "rotation_error",
    "subspace_angle",
    "translation_error",
]
