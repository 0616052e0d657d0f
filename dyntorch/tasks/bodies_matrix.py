"""Pairs of geometries by the segmentation matrix, among the starts of a segmentation."""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.fitting import fit
from dyntorch.invariants.segmentation_matrix import SegmentationMatrix
from dyntorch.tasks.bodies_energy import View

MATRIX = 40
"""Matches that a segmentation matrix takes."""


def matrix_pairs(view: View, groups: Tensor, rounds: int) -> Tensor:
    """Geometries ``(2 g, 3, 3)`` of the segmentation matrices of groups ``(b, n)``, 0 and 1; those too small are left out.

    The linear fits are weighed again by their gradients so many times.
    """
    groups = groups[groups.sum(-1) >= MATRIX]
    x1, x2 = (x.expand(len(groups), -1, -1) for x in (view.x1, view.x2))
    weights = groups
    for _ in range(rounds if len(groups) else 0):
        tensor = fit(SegmentationMatrix, x1, x2, weights=weights).tensor
        weights = groups * SegmentationMatrix.reweighted(tensor, x1, x2)
    if not len(groups):
        return view.x1.new_zeros(0, 3, 3)
    found = torch.cat(SegmentationMatrix.fundamentals(fit(SegmentationMatrix, x1, x2, weights=weights).tensor))
    return found[found.isfinite().all((-2, -1)) & (found != 0).any((-2, -1))]
