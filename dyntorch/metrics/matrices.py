"""Errors of matrices, tensors, subspaces and labels, blind to scale, sign and the affine gauge of constant velocity."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from dyntorch.algebra.homogeneous import apply, unit
from dyntorch.algebra.rigid import nearest_rotation


def relative_error(estimated: Tensor, true: Tensor, *, dims: int = 2) -> Tensor:
    r"""Distance of two matrices or tensors given up to scale and sign: :math:`\min_\pm \|E/\|E\| \mp T/\|T\|\,\|_F`.

    Args:
        estimated: ``(*batch, ...)`` with ``dims`` trailing dimensions.
        true: the same; batch dimensions broadcast.
        dims: dimensions of one item: 1 for a vector, 2 for a matrix, 3 for a three-view tensor.

    Returns:
        ``(*batch,)``, 0 to :math:`\sqrt 2`; 1 where one of the two is zero or NaN.

    Raises:
        ValueError: items of different sizes.

    Example:
        >>> import torch
        >>> a = torch.rand(5, 3, 3, 3, dtype=torch.float64)
        >>> bool(relative_error(-7 * a, a, dims=3).max() < 1e-12)
        True
    """
    if dims < 1 or estimated.ndim < dims or estimated.shape[-dims:] != true.shape[-dims:]:
        raise ValueError(f"items of {dims} dimensions must have one shape, got {tuple(estimated.shape)} and {tuple(true.shape)}")
    e, t = (torch.nn.functional.normalize(x.flatten(-dims), dim=-1, eps=0.0).nan_to_num() for x in (estimated, true))
    # the difference, not 1 - cosine, which could not tell errors below 1e-8 from 0
    return torch.minimum((e - t).norm(dim=-1), (e + t).norm(dim=-1))


def grid_transfer_error(
    estimated: Tensor, true: Tensor, width: float, height: float, *, reduction: str = "rms", count: int = 10
) -> Tensor:
    r"""How far two homographies carry the points of an image apart: :math:`\|\pi(A x) - \pi(A_{true} x)\|` over a grid.

    Args:
        estimated: ``(*batch, 3, 3)`` of any scale and sign.
        true: ``(*batch, 3, 3)``.
        width: of the image the grid covers, pixels.
        height: of the image, pixels.
        reduction: ``"rms"``, ``"median"`` or ``"max"`` over the grid.
        count: points per row and column of the grid, borders included.

    Returns:
        ``(*batch,)`` pixels; infinite for NaN.

    Raises:
        ValueError: unknown reduction, count < 2.

    Example:
        >>> import torch
        >>> shift = torch.eye(3, dtype=torch.float64)
        >>> shift[0, 2] = 3.0
        >>> round(float(grid_transfer_error(-2 * shift, torch.eye(3, dtype=torch.float64), 640, 480)), 6)
        3.0
    """
    if count < 2 or reduction not in ("rms", "median", "max"):
        raise ValueError(f"count must be >= 2 and reduction 'rms', 'median' or 'max', got {count} and {reduction!r}")
    x, y = (torch.linspace(0, extent, count, dtype=true.dtype, device=true.device) for extent in (width, height))
    grid = torch.cartesian_prod(x, y)
    distance = (apply(estimated, grid) - apply(true, grid)).norm(dim=-1).nan_to_num(nan=torch.inf, posinf=torch.inf)
    if reduction == "max":
        return distance.amax(-1)
    return distance.median(dim=-1).values if reduction == "median" else distance.square().mean(-1).sqrt()


def point_error(estimated: Tensor, true: Tensor, points: Tensor) -> Tensor:
    r"""RMS distance between the images of points under two collineations (or projections).

    Args:
        estimated: ``(*batch, e, d + 1)`` of any scale and sign.
        true: ``(*batch, e, d + 1)``.
        points: ``(*batch, n, d)`` in the frame the maps take, for instance of view 2.

    Returns:
        ``(*batch,)`` in the unit of the images; infinite for NaN.

    Example:
        >>> import torch
        >>> float(point_error(torch.eye(4), -torch.eye(4), torch.rand(5, 3)))
        0.0
    """
    error = (apply(estimated, points) - apply(true, points)).square().sum(-1).mean(-1).sqrt()
    return error.nan_to_num(nan=torch.inf, posinf=torch.inf)


def rotation_error(estimated: Tensor, true: Tensor) -> Tensor:
    r"""Angle of :math:`R_{true}^T R` between the rotations of two rigid motions, degrees.

    Args:
        estimated: ``(*batch, 4, 4)`` of any scale and sign; its upper left block is replaced by the nearest rotation.
        true: ``(*batch, 4, 4)``.

    Returns:
        ``(*batch,)``, 0 to 180; 180 for NaN or a last entry 0.

    Raises:
        ValueError: matrices that are not 4 x 4.

    Example:
        >>> import torch
        >>> turn = torch.eye(4, dtype=torch.float64)
        >>> turn[:2, :2] = torch.tensor([[0.0, -1.0], [1.0, 0.0]])
        >>> round(float(rotation_error(-3 * turn, torch.eye(4, dtype=torch.float64))), 6)
        90.0
    """
    (first, valid), (second, also) = _rigid_scale(true), _rigid_scale(estimated)
    difference = nearest_rotation(first[..., :3, :3]).mT @ nearest_rotation(second[..., :3, :3])
    axis = torch.stack([difference[..., i, j] - difference[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0))], dim=-1)
    trace = difference.diagonal(dim1=-2, dim2=-1).sum(-1)
    # both the sine and the cosine, for the arc cosine alone loses half of the digits near 0
    angle = torch.rad2deg(torch.atan2(axis.norm(dim=-1), trace - 1))
    return torch.where(valid & also, angle, 180.0)


def translation_error(estimated: Tensor, true: Tensor) -> Tensor:
    r"""Distance :math:`\|t - t_{true}\|` of the translations of two rigid motions.

    Args:
        estimated: ``(*batch, 4, 4)`` of any scale and sign.
        true: ``(*batch, 4, 4)``.

    Returns:
        ``(*batch,)`` in the unit of the points; infinite for NaN or a last entry 0.

    Raises:
        ValueError: matrices that are not 4 x 4.

    Example:
        >>> import torch
        >>> shift = torch.eye(4)
        >>> shift[0, 3] = 2.0
        >>> float(translation_error(-3 * shift, torch.eye(4)))
        2.0
    """
    (first, valid), (second, also) = _rigid_scale(true), _rigid_scale(estimated)
    return torch.where(valid & also, (first[..., :3, 3] - second[..., :3, 3]).norm(dim=-1), torch.inf)


def _rigid_scale(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """The representative with 1 in the last entry, and whether there is one (else the identity)."""
    if matrix.shape[-2:] != (4, 4):
        raise ValueError(f"a rigid motion must be (*batch, 4, 4), got {tuple(matrix.shape)}")
    scaled = matrix / matrix[..., 3:, 3:]
    valid = scaled.isfinite().flatten(-2).all(dim=-1)
    eye = torch.eye(4, dtype=matrix.dtype, device=matrix.device)
    return torch.where(valid[..., None, None], scaled, eye), valid


def affine_gauge(estimated: Tensor, true: Tensor) -> tuple[Tensor, Tensor]:
    r"""Align constant-velocity sensors to the truth by what they leave open: an affinity of the world, a common velocity.

    Constant velocity fixes :math:`A_t` only up to :math:`A_t \begin{pmatrix} I & t u \\ 0 & 1 \end{pmatrix} G` with one
    affinity G and one velocity u for all t.  Both follow from the affine parts of :math:`D_t = A_t^{-1} A_t^{true}`: G has
    their mean linear part, and :math:`g + t u` is the regression line of their translations.

    Args:
        estimated: ``(*batch, 3, 4, 4)`` world to sensor at t = 0, 1, 2, each of any scale and sign.
        true: ``(*batch, 3, 4, 4)``.

    Returns:
        the aligned sensors ``(*batch, 3, 4, 4)``, of Frobenius norm 1, and ``(*batch,)`` the largest of their three
        :func:`relative_error`; sensors without an inverse give zeros and the error 1.

    Raises:
        ValueError: not three 4 x 4 matrices.

    Source: thesis section 8.3.

    Example:
        >>> import torch
        >>> true = torch.eye(4).repeat(3, 1, 1)
        >>> moved = true.clone()
        >>> moved[1, 0, 3], moved[2, 0, 3] = 1.0, 2.0
        >>> float(affine_gauge(moved, true)[1])
        0.0
    """
    if estimated.shape[-3:] != (3, 4, 4) or true.shape[-3:] != (3, 4, 4):
        raise ValueError(f"sensors must be (*batch, 3, 4, 4), got {tuple(estimated.shape)} and {tuple(true.shape)}")
    between, _ = torch.linalg.solve_ex(estimated, true)
    between = between / between[..., 3:, 3:]
    shift = between[..., :3, 3]
    # D = [L g; 0 1] [I 0; a 1]: splitting off the projective part on the side of the truth makes the result exactly
    # independent of the gauge of the estimate; dropping the last row would not
    linear = between[..., :3, :3] - shift[..., :, None] * between[..., 3:, :3]
    gauge = torch.zeros_like(between)
    gauge[..., :3, :3] = linear.mean(dim=-3, keepdim=True)
    t = torch.tensor([-1.0, 0.0, 1.0], dtype=true.dtype, device=true.device)[:, None]
    gauge[..., :3, 3] = shift.mean(dim=-2, keepdim=True) + t * (shift[..., 2:, :] - shift[..., :1, :]) / 2
    gauge[..., 3, 3] = 1.0
    aligned = estimated @ gauge
    usable = aligned.isfinite().flatten(-3).all(dim=-1)[..., None, None, None]
    aligned = unit(torch.where(usable, aligned, 0.0))
    return aligned, relative_error(aligned, true).amax(dim=-1)


def subspace_angle(first: Tensor, second: Tensor) -> Tensor:
    r"""Largest principal angle between two column spaces, of the smaller one to the larger one, degrees.

    Args:
        first: ``(*batch, rows, k)`` of full column rank.
        second: ``(*batch, rows, m)`` of full column rank.

    Returns:
        ``(*batch,)``, 0 to 90; 0 iff one space contains the other, 90 for NaN.

    Raises:
        ValueError: vectors of different lengths.

    Example:
        >>> import torch
        >>> round(float(subspace_angle(torch.eye(3)[:, :2], torch.tensor([[1.0], [0.0], [1.0]]))), 3)
        45.0
    """
    if first.ndim < 2 or second.ndim < 2 or first.shape[-2] != second.shape[-2]:
        raise ValueError(f"expected (*batch, rows, k) and (*batch, rows, m), got {tuple(first.shape)} and {tuple(second.shape)}")
    valid = first.isfinite().flatten(-2).all(dim=-1) & second.isfinite().flatten(-2).all(dim=-1)
    # the decompositions refuse NaN for the whole batch
    u, v = (torch.linalg.qr(torch.where(valid[..., None, None], x, 0.0)).Q for x in (first, second))
    if v.shape[-1] > u.shape[-1]:
        u, v = v, u
    inside = u.mT @ v
    sine = torch.linalg.matrix_norm(v - u @ inside, ord=2)
    cosine = torch.linalg.svdvals(inside)[..., -1]
    # sine and cosine together are accurate for small angles and for large ones
    return torch.where(valid, torch.rad2deg(torch.atan2(sine, cosine)), 90.0)


class LabelScores(NamedTuple):
    """Per label 0 (outlier), 1 (static), 2 (moving): ``recall`` and ``precision``, each ``(*batch, 3)``."""

    recall: Tensor
    precision: Tensor


def label_scores(labels: Tensor, true: Tensor) -> LabelScores:
    r"""Recall and precision of each label of a segmentation into outliers, static and moving points.

    Args:
        labels: ``(*batch, n)`` estimated, 0, 1 or 2.
        true: ``(*batch, n)``.

    Returns:
        LabelScores; a label that does not occur has recall 1 (nothing was missed), one that was not given precision 1.

    Raises:
        ValueError: labels of different shapes.

    Example:
        >>> import torch
        >>> scores = label_scores(torch.tensor([1, 1, 2, 0]), torch.tensor([1, 2, 2, 0]))
        >>> scores.recall.tolist(), scores.precision.tolist()
        ([1.0, 1.0, 0.5], [1.0, 0.5, 1.0])
    """
    if labels.shape != true.shape:
        raise ValueError(f"labels must have one shape, got {tuple(labels.shape)} and {tuple(true.shape)}")
    kinds = torch.arange(3, device=true.device)
    given, actual = labels[..., None] == kinds, true[..., None] == kinds
    right = (given & actual).sum(-2)

    def share(of: Tensor) -> Tensor:
        return torch.where(of > 0, right / of.clamp(min=1), 1.0)

    return LabelScores(share(actual.sum(-2)), share(given.sum(-2)))
