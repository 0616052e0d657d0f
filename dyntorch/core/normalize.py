"""Well-conditioned matches and the way back: one similarity per view, and what it does to tensors and motions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.core.invariant import Frame, Invariant
from dyntorch.core.primitives import Primitive
from dyntorch.geometry.homogeneous import canonical_sign, similarity, unit
from dyntorch.numerics.least_squares import normalized_derivative

LETTERS = "abcdefghijkl"
SPREAD = 1e-120
"""Mean square distance below which points are one: squares of lesser distances leave the range of float64."""


@dataclass(frozen=True)
class Normalization:
    """Similarities of all views, ``(*batch, d + 1, d + 1)`` each, and what they do to the vectors of the primitives."""

    transforms: tuple[Tensor, ...]
    primitives: tuple[Primitive, ...]
    actions: tuple[Tensor, ...]

    @classmethod
    def of(cls, invariant: Invariant, transforms: Sequence[Tensor]) -> Normalization:
        """What similarities of the views do to what the invariant measures in them."""
        pairs = tuple(zip(invariant.primitives, transforms, strict=True))
        return cls(tuple(transforms), tuple(p.normalize(t) for p, t in pairs), tuple(p.action(t) for p, t in pairs))

    @property
    def scales(self) -> tuple[Tensor, ...]:
        """Size of one unit of each view in normalized coordinates."""
        return tuple(t[..., 0, 0] for t in self.transforms)

    def apply(self, invariant: Invariant, views: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """Measurements in normalized coordinates."""
        return tuple(p.move(x, t) for p, x, t in zip(invariant.primitives, views, self.transforms, strict=True))


def normalization(invariant: Invariant, views: Sequence[Tensor], weights: Tensor) -> Normalization:
    r"""Hartley's similarity of each view: the weighted centroid goes to 0, the RMS distance from it to :math:`\sqrt d`. views
    ``(*batch, n, ...)``, weights ``(*batch, n)``."""
    points = [p.points(x, weights) for p, x in zip(invariant.primitives, views, strict=True)]
    if len({x.shape for x in points}) == 1:
        # all views in one pass: a copy costs less than two more rounds of small operations
        return Normalization.of(invariant, hartley(torch.stack(points), weights).unbind(0))
    return Normalization.of(invariant, [hartley(x, weights) for x in points])


def relative(scales: Sequence[Tensor]) -> tuple[tuple[Tensor, ...], Tensor]:
    """Scales ``(*batch,)`` of the views over the largest of them, and that one: distances then do not depend on the unit."""
    unit = torch.stack(list(scales)).amax(0)
    return tuple(s / unit for s in scales), unit


def hartley(points: Tensor, weights: Tensor) -> Tensor:
    """Similarity of points ``(*batch, n, k, d)``; k points of one match share its weight."""
    d = points.shape[-1]
    total = weights.sum(-1, keepdim=True).clamp(min=torch.finfo(weights.dtype).tiny)
    share = (weights / (total * points.shape[-2]))[..., None]
    flat = points.flatten(-2)  # (*batch, n, k d)
    centre = (flat * share).sum(-2).unflatten(-1, points.shape[-2:]).sum(-2)
    shifted = flat - centre.repeat(*([1] * (centre.ndim - 1)), points.shape[-2])[..., None, :]
    spread = (shifted.square() * share).sum((-2, -1))
    # points that are equal to rounding have no scale: 1 keeps everything finite, and the rank says that they decide nothing
    extended = spread > (1e-28 * centre.detach().square().sum(-1)).clamp(min=SPREAD)
    scale = torch.where(extended, (d / torch.where(extended, spread, 1.0)).sqrt(), 1.0)
    return similarity(scale, centre)


def denormalize(invariant: Invariant, tensor: Tensor, actions: Sequence[Tensor]) -> Tensor:
    r"""The tensor of the measured coordinates, :math:`T_{ijk} = \hat T_{abc} (M_1)_{ai} (M_2)_{bj} (M_3)_{ck}`, norm 1. tensor
    ``(*batch, *axes)``, actions ``(*batch, width, width)``."""
    if invariant.motion_alone:
        return torch.stack(denormalize_motion(invariant, tensor.unbind(-3), actions), dim=-3)
    rank = len(invariant.shape())
    result = tensor if invariant.intrinsic else _moved_axes(invariant, tensor, actions)
    if invariant.nullity == 1:
        result = _largest_to_one(result, rank)
    return unit_tensors(result, rank, invariant.nullity)


def _moved_axes(invariant: Invariant, tensor: Tensor, actions: Sequence[Tensor]) -> Tensor:
    axes = [int(v) for v in invariant.axes()]
    small = "".join(LETTERS[i] for i in range(len(axes)))
    large = small.upper()
    maps = ",".join(f"...{small[i]}{large[i]}" for i in range(len(axes)))
    # only ratios count, and products of so many entries must not leave the range
    ordered = [actions[v] / actions[v].detach().abs().amax((-2, -1), keepdim=True) for v in axes]
    if invariant.nullity > 1:
        ordered = [a.unsqueeze(-3) for a in ordered]
    return torch.einsum(f"...{small},{maps}->...{large}", tensor, *ordered)


def _largest_to_one(result: Tensor, axes: int) -> Tensor:
    """Tensors whose largest entry over so many last axes is 1: the squares of all stay within the range of numbers."""
    largest = result.detach().flatten(-axes).abs().amax(-1)
    return result / torch.where(largest > 0, largest, 1.0)[(..., *([None] * axes))]


def unit_tensors(result: Tensor, rank: int, nullity: int = 1) -> Tensor:
    """Tensors of so many axes at norm 1, several of them orthonormal; zero ones stay zero."""
    if nullity == 1:
        # a third of the time of torch's norm of a few entries
        total = result.flatten(-rank).square().sum(-1)[(..., *([None] * rank))]
        return result / torch.where(total > 0, total, 1.0).sqrt()
    result = _largest_to_one(result, rank + 1)
    flat = result.flatten(-rank)
    # the derivative of the triangular factorization of a failed (zero) problem would be NaN: any basis stands in for it
    none = flat.abs().amax((-2, -1), keepdim=True) == 0
    other = torch.eye(*flat.shape[-2:], dtype=flat.dtype, device=flat.device)
    basis = torch.linalg.qr(torch.where(none, other, flat).mT)[0].mT
    return torch.where(none, torch.zeros_like(basis), basis).unflatten(-1, result.shape[-rank:])


def denormalize_motion(invariant: Invariant, motion: Sequence[Tensor], transforms: Sequence[Tensor]) -> tuple[Tensor, ...]:
    r"""The motion of the measured coordinates: :math:`A = T_{target}^{-1} \hat A\, T_{source}`, canonical scale and sign."""
    return tuple(
        _change_frame(part, frame, transforms, forward=False) for part, frame in zip(motion, invariant.motion, strict=True)
    )


def normalize_motion(invariant: Invariant, motion: Sequence[Tensor], transforms: Sequence[Tensor]) -> tuple[Tensor, ...]:
    r"""The inverse of :func:`denormalize_motion`: :math:`\hat A = T_{target} A\, T_{source}^{-1}`."""
    return tuple(_change_frame(part, frame, transforms, forward=True) for part, frame in zip(motion, invariant.motion, strict=True))


def denormalization_derivative(invariant: Invariant, motion: Sequence[Tensor], transforms: Sequence[Tensor]) -> Tensor:
    """Derivative ``(b, p, p)`` of all entries of :func:`denormalize_motion` (last) by those of the motion ``(b, ...)``."""
    blocks = []
    for part, frame in zip(motion, invariant.motion, strict=True):
        sizes = (part.shape[1], part.shape[-1])
        maps = _maps_of_frame(frame, transforms, forward=False)
        left, right = (_eye(part, size) if matrix is None else matrix for matrix, size in zip(maps, sizes, strict=True))
        if frame.vector:
            value, slope = (left @ part[..., None])[..., 0], left.mT
        else:
            value = (left @ part @ right).flatten(1)
            slope = (left.mT[:, :, None, :, None] * right[:, None, :, None, :]).flatten(3).flatten(1, 2)
        value, slope = normalized_derivative(value, slope)
        blocks.append(slope if frame.vector else slope * canonical_sign(value.unflatten(1, part.shape[1:])))
    size = sum(block.shape[1] for block in blocks)
    total, start = blocks[0].new_zeros(len(blocks[0]), size, size), 0
    for block in blocks:
        end = start + block.shape[1]
        total[:, start:end, start:end] = block
        start = end
    return total


def _change_frame(part: Tensor, frame: Frame, transforms: Sequence[Tensor], *, forward: bool) -> Tensor:
    left, right = _maps_of_frame(frame, transforms, forward=forward)
    matrix = part[..., None] if frame.vector else part
    matrix = matrix if left is None else left @ matrix
    matrix = matrix if right is None else matrix @ right
    if frame.vector:
        norm = matrix.norm(dim=(-2, -1))[..., None]
        return matrix[..., 0] / torch.where(norm > 0, norm, 1.0)
    return unit(matrix)


def _maps_of_frame(frame: Frame, transforms: Sequence[Tensor], *, forward: bool) -> tuple[Tensor | None, Tensor | None]:
    """What a part of the motion is multiplied by from the left and from the right; None: nothing."""
    maps: list[Tensor | None] = []
    for view, left in ((frame.target, True), (frame.source, False)):
        if view is None:
            maps.append(None)
            continue
        # dual images change by the inverse transposed, which is the other way round
        transform = transforms[view] if (left == forward) != (left and frame.dual) else torch.linalg.inv_ex(transforms[view])[0]
        maps.append(transform.mT if left and frame.dual else transform)
    return maps[0], maps[1]


def _eye(part: Tensor, size: int) -> Tensor:
    return torch.eye(size, dtype=part.dtype, device=part.device).expand(len(part), size, size)
