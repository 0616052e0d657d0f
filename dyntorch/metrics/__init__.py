"""Errors that do not depend on what an estimate leaves open: scale and sign, the affinity of the world, a common velocity.

A failed estimate (NaN, or no solution at all) has the worst error, not NaN, so that medians over a batch count it.
"""

from dyntorch.metrics.lifted import LiftedError, body_error, lifted_error
from dyntorch.metrics.matrices import (
    LabelScores,
    affine_gauge,
    grid_transfer_error,
    label_scores,
    point_error,
    relative_error,
    rotation_error,
    subspace_angle,
    translation_error,
)
from dyntorch.metrics.segmentation import misclassification

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
