"""Errors that do not depend on what an estimate leaves open: scale and sign, the affinity of the world, a common velocity.

A failed estimate (NaN, or no solution at all) has the worst error, not NaN, so that medians over a batch count it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor
from torch.nn.functional import normalize, one_hot

from dyntorch.geometry.homogeneous import apply, homogeneous, inhomogeneous, unit
from dyntorch.geometry.lift import balance_lifts, balanced_algebra
from dyntorch.geometry.rigid import nearest_rotation
from dyntorch.numerics.least_squares import damped_step
from dyntorch.numerics.nullspace import null_space


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


def grid_transfer_error(estimated: Tensor, true: Tensor, width: float, height: float, *, count: int = 10) -> Tensor:
    r"""How far two homographies carry the points of an image apart: :math:`\|\pi(A x) - \pi(A_{true} x)\|` over a grid.

    Args:
        estimated: ``(*batch, 3, 3)`` of any scale and sign.
        true: ``(*batch, 3, 3)``.
        width: of the image the grid covers, pixels.
        height: of the image, pixels.
        count: points per row and column of the grid, borders included.

    Returns:
        ``(*batch,)`` pixels, rms over the grid; infinite for NaN.

    Raises:
        ValueError: count < 2.

    Example:
        >>> import torch
        >>> shift = torch.eye(3, dtype=torch.float64)
        >>> shift[0, 2] = 3.0
        >>> round(float(grid_transfer_error(-2 * shift, torch.eye(3, dtype=torch.float64), 640, 480)), 6)
        3.0
    """
    if count < 2:
        raise ValueError(f"count must be >= 2, got {count}")
    x, y = (torch.linspace(0, extent, count, dtype=true.dtype, device=true.device) for extent in (width, height))
    grid = torch.cartesian_prod(x, y)
    return point_error(estimated, true, grid)


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


# ----------------------------------------------------------------------------------------------------------------------
# How wrong a segmentation into bodies is, whatever numbers the bodies were given.


OUTLIER = 0


def misclassification(labels: Tensor, truth: Tensor) -> Tensor:
    r"""Share of matches with the wrong label, under the best assignment of the bodies found to the true ones.

    .. math:: 1 - \frac 1n \max_\pi \Bigl(|\{i : l_i = t_i = 0\}| + \sum_k |\{i : l_i = \pi(k),\ t_i = k\}|\Bigr)

    with :math:`\pi` one-to-one.  Outliers are no body: label 0 is right only where the truth is 0, and all matches of a body
    found beyond the true ones are wrong.

    Args:
        labels: ``(*batch, n)`` integers, 0 outlier, 1.. the bodies found, in any order.
        truth: ``(*batch, n)`` integers, 0 outlier, 1.. the bodies; their number may differ from that of ``labels``.

    Returns:
        ``(*batch,)`` float64 share in [0, 1].

    Raises:
        ValueError: labels of different shapes, no matches, negative or not integers.

    Source: the misclassification error of Tron and Vidal, CVPR 2007, with an outlier class.

    Example:
        >>> import torch
        >>> misclassification(torch.tensor([2, 2, 1, 1, 0, 3]), torch.tensor([1, 1, 2, 2, 0, 0]))
        tensor(0.1667, dtype=torch.float64)
    """
    if labels.shape != truth.shape or labels.ndim == 0 or labels.shape[-1] == 0:
        raise ValueError(f"labels must have one shape (*batch, n), n >= 1, got {tuple(labels.shape)} and {tuple(truth.shape)}")
    for name, given in (("labels", labels), ("truth", truth)):
        if given.is_floating_point() or given.is_complex():
            raise ValueError(f"{name} must be integers, 0 outlier, 1.. the bodies, got {given.dtype}")
        if (given < OUTLIER).any():
            raise ValueError(f"{name} must not be negative (0 is an outlier), got {int(given.min())}")
    estimated, true = (_members(x.long().reshape(-1, x.shape[-1])) for x in (labels, truth))
    common = (estimated.mT @ true).cpu()
    best = [float(table[linear_sum_assignment(table.numpy(), maximize=True)].sum()) for table in common[:, 1:, 1:]]
    right = common[:, OUTLIER, OUTLIER] + common.new_tensor(best)
    return (1 - right / labels.shape[-1]).reshape(labels.shape[:-1]).to(labels.device)


def _members(labels: Tensor) -> Tensor:
    """``(problems, n, K + 1)``: 1 where a match has the label."""
    return one_hot(labels, int(labels.max()) + 1 if labels.numel() else 1).double()


# ----------------------------------------------------------------------------------------------------------------------
# Errors of lifted reconstructions, after the best alignment within what their lifts leave open.


STEPS = 15
"""Of the robust alignments, from a start that is nearly right."""


class LiftedError(NamedTuple):
    """``position`` and ``velocity``, each ``(*batch,)``, relative to the scene."""

    position: Tensor
    velocity: Tensor


def lifted_error(structure: Tensor, true: Tensor, lifts: Tensor, mask: Tensor | None = None) -> LiftedError:
    r"""Errors of lifted points after the best alignment that their lifts allow, in the positions of the world points.

    The S of :func:`~dyntorch.geometry.lift.gauge_algebra` that aligns them starts as the least-squares solution of
    :math:`Y_{true} \sim S\,Y` on whitened points and is refined on the positions :math:`\pi(B_i S Y)` at all views, gross errors
    weighing little.

    Args:
        structure: ``(*batch, n, K)`` estimated, homogeneous, in any gauge that the lifts leave open.
        true: ``(*batch, n, K)``; batch dimensions broadcast.
        lifts: ``(views, d + 1, K)``.
        mask: ``(*batch, n)`` bool, points that count; all by default.

    Returns:
        LiftedError: ``position``, the median over points and views of the distance to the true position, relative to the rms
        radius of the scene; ``velocity``, the median error of the displacement from the first view to the last, relative to
        its rms (to the radius, where nothing moves).  For constant velocity the latter is the error of the velocity relative
        to the rms speed.  Points that are NaN or 0 have infinite errors.

    Raises:
        ValueError: shapes that do not fit.

    Example:
        >>> import torch
        >>> from dyntorch.scenes import lifted_points
        >>> scene = lifted_points("constant_velocity_2d", 20, generator=torch.Generator().manual_seed(0))
        >>> gauge = torch.eye(5, dtype=torch.float64)
        >>> gauge[3, 2] = 0.7  # a common velocity
        >>> error = lifted_error(scene.structure @ gauge.mT, scene.structure, scene.lifts)
        >>> bool(error.position < 1e-12), bool(error.velocity < 1e-12)
        (True, True)
    """
    size = lifts.shape[-1]
    if structure.shape[-2:] != true.shape[-2:] or structure.shape[-1] != size:
        raise ValueError(
            f"structure and true must be (*batch, n, {size}) for these lifts, got {tuple(structure.shape)} and {tuple(true.shape)}"
        )
    batch = torch.Size(np.broadcast_shapes(structure.shape[:-2], true.shape[:-2]))
    n = true.shape[-2]
    y, z = (x.double().expand(*batch, n, size).reshape(-1, n, size) for x in (structure, true))
    counts = torch.ones_like(y[..., 0], dtype=torch.bool) if mask is None else mask.expand(*batch, n).reshape(-1, n)
    valid = y.isfinite().all(-1) & (y != 0).any(-1)
    weights = (valid & counts).to(y.dtype)
    z = torch.where(counts[..., None], z, 0.0)
    placed = inhomogeneous(z[:, None] @ lifts.double().mT)
    # both sides in coordinates in which they fill the space: whatever the gauges, the least squares are well conditioned
    even, back = balance_lifts(lifts)
    right, y = _balance(torch.where(weights[..., None] > 0, y, 0.0) @ back.mT)
    left, z = _balance(torch.where(weights[..., None] > 0, z, 0.0) @ back.mT)
    basis = torch.linalg.solve(left[:, None], balanced_algebra(even) @ right[:, None])
    basis = torch.linalg.qr(basis.flatten(2).mT).Q.mT.unflatten(-1, (size, size))
    image = (basis @ y.mT[:, None]).permute(0, 3, 2, 1)
    seen = (even @ left[:, None])[:, :, None] @ image[:, None]
    c = _refine(_algebraic(image, z, weights), seen, placed, weights)
    return _errors(inhomogeneous((seen @ c[:, None, None, :, None])[..., 0]), placed, counts, valid, batch)


def _errors(estimated: Tensor, placed: Tensor, counts: Tensor, valid: Tensor, batch: torch.Size) -> LiftedError:
    """Medians of the distances of positions ``(b, views, n, d)`` and of their displacements."""
    many = counts.sum(-1).clamp(min=1)
    inside = torch.where(counts[:, None, :, None], placed, 0.0)
    centre = inside.sum(-2, keepdim=True) / many[:, None, None, None]
    radius = torch.where(counts[:, None], (placed - centre).square().sum(-1), 0.0).sum((-2, -1)) / (many * placed.shape[1])
    moved, should = estimated[:, -1] - estimated[:, 0], placed[:, -1] - placed[:, 0]
    speed = torch.where(counts, should.square().sum(-1), 0.0).sum(-1) / many
    speed = torch.where(speed > 1e-18 * radius, speed, radius)
    far = torch.where(valid[:, None], (estimated - placed).norm(dim=-1), torch.inf)
    off = torch.where(valid, (moved - should).norm(dim=-1), torch.inf)
    position = _median(far.flatten(1), counts[:, None].expand_as(far).flatten(1)) / radius.sqrt()
    return LiftedError(position.reshape(batch), (_median(off, counts) / speed.sqrt()).reshape(batch))


def _median(x: Tensor, counts: Tensor) -> Tensor:
    """The (lower) median of the entries that count, infinite without any."""
    ordered = torch.where(counts & ~x.isnan(), x, torch.inf).sort(dim=-1).values
    middle = (counts.sum(-1, keepdim=True) - 1).clamp(min=0) // 2
    return ordered.gather(-1, middle)[..., 0]


def _balance(y: Tensor) -> tuple[Tensor, Tensor]:
    r"""A map A and unit points w with :math:`y \sim A w` for which :math:`\sum w w^T \sim I` (Tyler), for points ``(b, n, K)``."""
    size = y.shape[-1]
    spread = torch.eye(size, dtype=y.dtype, device=y.device).expand(len(y), -1, -1)
    w = normalize(y, dim=-1, eps=0.0).nan_to_num()
    for _ in range(5 if y.shape[-2] >= size else 0):
        _, s, vh = torch.linalg.svd(w, full_matrices=False)
        s = torch.where(s > 1e-14 * s[:, :1], s, 1.0)
        w = normalize(w @ vh.mT / s[:, None], dim=-1, eps=0.0).nan_to_num()
        spread = spread @ (vh.mT * s[:, None])
        spread = spread / torch.linalg.matrix_norm(spread, keepdim=True)
    return spread, w


def _trust(residual: Tensor, weights: Tensor) -> Tensor:
    """Geman and McClure's weights of residuals ``(b, n)``, near 1 up to three times their median."""
    scale = (3 * _median(residual, weights > 0)).nan_to_num(posinf=1.0).clamp(min=1e-12)
    return weights * (1 + (residual / scale[:, None]).square()).pow(-2).nan_to_num()


def _algebraic(image: Tensor, z: Tensor, weights: Tensor) -> Tensor:
    """Coefficients ``(b, dim)`` with which the images ``(b, n, K, dim)`` of the points are parallel to unit z ``(b, n, K)``."""
    rows = image - z[..., None] * (z[..., None, :] @ image)
    trusted = weights
    for _ in range(STEPS):
        c = null_space((rows * trusted.sqrt()[..., None, None]).flatten(1, 2))[:, 0]
        off, size = ((x @ c[:, None, :, None])[..., 0].norm(dim=-1) for x in (rows, image))
        off = off / size.clamp(min=torch.finfo(size.dtype).tiny)
        # least sum of angles, where Geman and McClure's weights would keep to a bad start: a quarter of the points replaced
        # by random ones does no harm in moderate gauges, in 8 of 10 extreme ones
        trusted = weights / (off + (0.1 * _median(off, weights > 0)).nan_to_num(posinf=1.0).clamp(min=1e-12)[:, None])
        trusted = trusted / size.square().clamp(min=1e-6)
        trusted = trusted / trusted.amax(-1, keepdim=True).clamp(min=torch.finfo(size.dtype).tiny)
    return c


def _refine(c: Tensor, seen: Tensor, placed: Tensor, weights: Tensor) -> Tensor:
    """Levenberg-Marquardt on the positions ``(b, views, n, d)``, seen as ``seen (b, views, n, d + 1, dim) @ c``."""

    def residual(c: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        q = (seen @ c[:, None, None, :, None])[..., 0]
        x = inhomogeneous(q)
        return x - placed, x, q[..., -1:]

    damping = torch.full_like(c[:, 0], 1e-4)
    for _ in range(STEPS):
        off, x, depth = residual(c)
        trusted = _trust(off.square().sum((1, 3)).sqrt(), weights)[:, None, :, None]
        slope = (seen[..., :-1, :] - x[..., None] * seen[..., -1:, :]) / depth[..., None]
        slope = torch.where(trusted[..., None] > 0, slope, 0.0)
        weighted = (slope * trusted[..., None]).flatten(1, 3).mT
        step = damped_step((weighted @ off.flatten(1)[..., None])[..., 0], weighted @ slope.flatten(1, 3), damping)
        trial = normalize(c - step, dim=-1)
        before, after = ((trusted * e.square()).sum((1, 2, 3)) for e in (off, residual(trial)[0]))
        better = after < before
        c = torch.where(better[:, None], trial, c)
        damping = (damping * torch.where(better, 0.1, 10.0)).clamp(1e-12, 1e6)
    return c


def body_error(points: Tensor, true: Tensor, labels: Tensor) -> Tensor:
    r"""Error of each body after its own best affine alignment, :math:`x_{true} \approx A x + a`, gross errors weighing little.

    Args:
        points: ``(*batch, n, d)`` estimated.
        true: ``(*batch, n, d)``.
        labels: ``(*batch, n)`` true bodies, 1 and 2; points of other labels do not count.

    Returns:
        ``(*batch, 2)`` median distance relative to the rms radius of the body; infinite for a body without points, and
        for more than half of its points NaN.

    Raises:
        ValueError: shapes that do not fit.

    Example:
        >>> import torch
        >>> x = torch.rand(20, 2, dtype=torch.float64)
        >>> labels = 1 + torch.arange(20) % 2
        >>> moved = x @ torch.tensor([[2.0, 1.0], [0.0, 3.0]], dtype=torch.float64) + labels[:, None]
        >>> bool(body_error(moved, x, labels).max() < 1e-12)
        True
    """
    if points.shape[-2:] != true.shape[-2:] or labels.shape[-1:] != true.shape[-2:-1]:
        raise ValueError(
            f"points and true must be (*batch, n, d) with labels (*batch, n), got {tuple(points.shape)}, {tuple(true.shape)} "
            f"and {tuple(labels.shape)}"
        )
    n, d = true.shape[-2:]
    batch = torch.Size(np.broadcast_shapes(points.shape[:-2], true.shape[:-2], labels.shape[:-1]))
    x, z = (p.double().expand(*batch, n, d)[..., None, :, :].expand(*batch, 2, n, d).reshape(-1, n, d) for p in (points, true))
    kinds = torch.arange(1, 3, device=labels.device)[:, None]
    counts = (labels.expand(*batch, n)[..., None, :] == kinds).reshape(-1, n)
    valid = x.isfinite().all(-1)
    weights = (counts & valid).to(x.dtype)
    # each coordinate about its median, in units of its median distance from it: runaway points leave the rest its digits
    x = torch.where(weights[..., None] > 0, x, 0.0)
    x = x - torch.stack([_median(column, weights > 0) for column in x.unbind(-1)], -1).nan_to_num(posinf=0.0)[:, None]
    unit = torch.stack([_median(column.abs(), weights > 0) for column in x.unbind(-1)], -1)
    x = homogeneous(x / torch.where((unit > 0) & unit.isfinite(), unit, 1.0)[:, None])
    trusted = weights / (1 + x.square().sum(-1) / 9).square()  # far away points would fit themselves
    for _ in range(STEPS):
        root = trusted.sqrt()[..., None]
        off = (x @ (torch.linalg.pinv(root * x) @ (root * torch.where(weights[..., None] > 0, z, 0.0))) - z).norm(dim=-1)
        trusted = _trust(off, weights)
    many = counts.sum(-1).clamp(min=1)
    z = torch.where(counts[..., None], z, 0.0)
    spread = torch.where(counts[..., None], z - (z.sum(-2) / many[:, None])[:, None], 0.0).square().sum((-2, -1)) / many
    error = _median(torch.where(valid, off, torch.inf), counts) / spread.sqrt()
    return torch.where(error.isnan(), torch.inf, error).reshape(*batch, 2)
