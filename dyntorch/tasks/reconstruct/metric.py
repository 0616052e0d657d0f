r"""From the scene that the tracks tell to the metric one that known calibrations tell: rotations, and points up to a similarity.

A lift leaves open a linear space of changes S of the constants, each of which changes the world at view i by a collineation
:math:`T_i(S)`, :math:`B_i S = T_i(S) B_i`.  The metric frames are the S after which every camera is one of its calibration,

.. math:: K_i^{-1} P_i\\, T_i(S)\\, \begin{pmatrix} I_d \\ 0 \end{pmatrix} \sim R_{i,:d},

whatever the motion: the columns of the left are orthogonal and of one length.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from dyntorch.geometry.homogeneous import nonzero_sign
from dyntorch.numerics.least_squares import LeastSquaresOptions, NormalEquations, minimize
from dyntorch.numerics.nullspace import eigenvalues

CONDITION_ROUNDING = 1e-9
"""Relative singular value below which a condition on changes of the world, made of lifts alone, is none."""


class WorldChanges(NamedTuple):
    """What a lift leaves open, as the calibrations see it."""

    algebra: Tensor
    """``(dim, K, K)`` the changes S of the constants."""
    worlds: Tensor
    """``(views, dim, a + 1, a + 1)`` the collineations of the world at each view."""
    similar: Tensor
    """``(m, dim)`` orthonormal coordinates of the changes that are similarities of the world at all views."""
    dim: int
    """d of the world."""

    @classmethod
    def of(cls, lifts: Tensor, algebra: Tensor, dim: int) -> WorldChanges:
        """Of lifts ``(views, a + 1, K)`` of a world of some dimension."""
        worlds = torch.einsum("vak,dkj,vjb->vdab", lifts, algebra, torch.linalg.pinv(lifts))
        inner, below = worlds[..., :dim, :dim], worlds[..., dim:, :dim]
        eye = torch.eye(dim, dtype=lifts.dtype, device=lifts.device)
        even = inner + inner.mT
        length = inner.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None]
        against = torch.cat([(even - 2 * length * eye).flatten(2), below.flatten(2)], dim=-1).permute(0, 2, 1).flatten(0, 1)
        _, values, vh = torch.linalg.svd(against, full_matrices=True)
        rank = int((values > CONDITION_ROUNDING * values[:1].clamp(min=1.0)).sum())
        return cls(algebra, worlds, vh[rank:], dim)

    @property
    def orbits(self) -> Tensor:
        """``(m, dim, dim)`` coordinates of :math:`S G` by those of S, for the similarities G."""
        products = torch.einsum("pij,mjk->mpik", self.algebra, self.metric).flatten(2)
        return (products @ torch.linalg.pinv(self.algebra.flatten(1))).mT

    @property
    def metric(self) -> Tensor:
        """``(m, K, K)`` the changes of the constants that are similarities of the world."""
        return torch.einsum("md,dij->mij", self.similar, self.algebra)


class MetricFrames(NamedTuple):
    """The metric frame of each problem of a flat batch."""

    change: Tensor
    """``(b, K, K)`` S."""
    misfit: Tensor
    """``(b,)`` rms of the entries by which the cameras, their columns brought to length 1, miss being rotations."""
    weakness: Tensor
    """``(b,)`` least singular value of the derivative of these entries, over the largest, but for the similarities: 0 where a
    family of frames is metric."""
    several: Tensor
    """``(b,)`` number of different frames that do as well and show as many points before the cameras."""


@dataclass(frozen=True)
class _Calibrating(NormalEquations):
    """The conditions of rotations in coordinates ``(b, dim)`` of the change."""

    derivatives: Tensor
    """``(b, v, dim, m, d)``."""
    share: Tensor
    """``(b, v)`` 1 for views that count."""
    orbits: Tensor
    """``(m, dim, dim)``: times theta, what similarities of the world change of it, which no condition holds."""

    def subset(self, keep: Tensor) -> _Calibrating:
        """Some of the problems."""
        return _Calibrating(self.derivatives[keep], self.share[keep], self.orbits)

    def linear(self, theta: Tensor) -> tuple[Tensor, Tensor]:
        """Residuals ``(b, v, r)`` and their derivatives ``(b, v, dim, r)``."""
        turned = torch.einsum("bvpmd,bp->bvmd", self.derivatives, theta)
        head, slope = turned[..., :3, :], self.derivatives[..., :3, :]
        gram, d = head.mT @ head, head.shape[-1]
        size = gram.diagonal(dim1=-2, dim2=-1).mean(-1).clamp(min=1e-300)
        eye = torch.eye(d, dtype=gram.dtype, device=gram.device)
        half = slope.mT @ head[:, :, None]
        by = half + half.mT
        by_size = by.diagonal(dim1=-2, dim2=-1).mean(-1)
        unit = gram / size[..., None, None]
        value = (unit - eye).flatten(2)
        change = ((by - by_size[..., None, None] * unit[:, :, None]) / size[..., None, None, None]).flatten(3)
        if turned.shape[-2] > 3:  # a sensor sees the infinite at infinity
            root = size.sqrt()[..., None]
            last = turned[..., 3, :] / root
            of_last = self.derivatives[..., 3, :] / root[..., None]
            of_last = of_last - last[:, :, None] * (by_size / (2 * size[..., None]))[..., None]
            value, change = torch.cat([value, last], -1), torch.cat([change, of_last], -1)
        counts = self.share[..., None]
        return value * counts, change * counts[..., None]

    def normal_equations(self, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Cost, gradient and matrix."""
        value, change = self.linear(theta)
        by = change.permute(0, 2, 1, 3).flatten(2)
        flat = value.flatten(1)
        cost = flat.square().sum(-1)
        matrix = by @ by.mT
        # along the orbit of the similarities every step would be rounding, and as long as the damping allows
        orbit = torch.linalg.qr(torch.einsum("mpq,bq->bpm", self.orbits, theta))[0]
        size = matrix.diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None]
        return torch.where(cost.isfinite(), cost, torch.inf), (by @ flat[..., None])[..., 0], matrix + size * orbit @ orbit.mT


DESCENT_ITERATIONS = 40  # of each descent
MAX_COST_RATIO = 4.0  # over the least, up to which a frame fits as well
COST_ROUNDING = 1e-16  # cost that is rounding
MAX_EXTRA_BEHIND = 0.02  # share of points behind cameras beyond the least


def metric_frames(
    cameras: Tensor, structure: Tensor, lifts: Tensor, changes: WorldChanges, world: Tensor, weights: Tensor
) -> MetricFrames:
    """The change of frame after which cameras, divided by their calibrations, are rotations and translations. cameras
    ``(b, views, m, a + 1)``, structure ``(b, n, K)``, lifts ``(views, a + 1, K)``, world ``(K,)``, weights
    ``(b, views, n)``."""
    b, d = len(cameras), changes.dim
    share = (cameras != 0).flatten(2).any(-1).to(cameras.dtype)
    derivatives = torch.einsum("bvma,vpad->bvpmd", cameras, changes.worlds[..., :d])
    row = torch.arange(b, device=cameras.device)
    starts = _calibrated_first(derivatives[row, share.argmax(-1)][..., :3, :], changes, _targets(d).to(cameras))
    starts = torch.where(starts.isfinite(), starts, 1.0)
    count = starts.shape[1]
    whole = _Calibrating(derivatives, share, changes.orbits)
    wide = whole.subset(row.repeat_interleave(count))
    found = minimize(wide, wide.evaluate((starts.flatten(0, 1),)), LeastSquaresOptions(iterations=DESCENT_ITERATIONS))
    theta, cost = found.theta[0].view(b, count, -1), found.cost.view(b, count)
    change = torch.einsum("bsp,pij->bsij", theta, changes.algebra)
    wrong = _behind(cameras, structure, lifts, change, derivatives, theta, world, weights)
    least = cost.amin(-1, keepdim=True)
    fits = cost <= MAX_COST_RATIO * least + COST_ROUNDING
    fewest = torch.where(fits, wrong, torch.inf).amin(-1, keepdim=True)
    fits = fits & (wrong <= fewest + MAX_EXTRA_BEHIND)
    best = torch.where(fits, cost, torch.inf).argmin(-1)
    several = _num_different(theta, changes, d, fits, best)
    # what is open by itself, and the derivative of the conditions across it
    value, slope = whole.linear(theta[row, best])
    slope = slope.permute(0, 2, 1, 3).flatten(2)
    values = eigenvalues(slope @ slope.mT).clamp(min=0).sqrt()
    weak = values[:, len(changes.similar)] if values.shape[-1] > len(changes.similar) else torch.full_like(values[:, 0], torch.inf)
    views = share.sum(-1)
    rows = (d * (d + 1) // 2 - 1) * views + (d * views if cameras.shape[-2] > 3 else 0)
    return MetricFrames(
        change[row, best],
        (value.square().sum((1, 2)) / rows.clamp(min=1)).sqrt(),
        weak / values[:, -1].clamp(min=torch.finfo(values.dtype).tiny),
        several,
    )


MIN_METRIC_DISTANCE = 0.03  # relative, points of unit variance, from which on two metrics are different


def _num_different(theta: Tensor, changes: WorldChanges, d: int, fits: Tensor, best: Tensor) -> Tensor:
    """How many of the starts that fit lead to different metrics, ``(b,)``."""
    turned = torch.einsum("bsp,vpad->bsvad", theta, changes.worlds[..., :d])
    metric = (turned @ turned.mT).flatten(2)
    metric = metric / metric.norm(dim=-1, keepdim=True).clamp(min=1e-300)
    row = torch.arange(len(theta), device=theta.device)
    number, left = torch.zeros_like(best), fits.clone()
    chosen = best
    while bool(left.any()):
        some = left.any(-1)
        number = number + some
        near = (metric - metric[row, chosen][:, None]).norm(dim=-1) < MIN_METRIC_DISTANCE
        left = left & ~near & some[:, None]
        left[row, chosen] = False
        chosen = left.to(torch.int8).argmax(-1)
    return number


def _behind(
    cameras: Tensor,
    structure: Tensor,
    lifts: Tensor,
    change: Tensor,
    derivatives: Tensor,
    theta: Tensor,
    world: Tensor,
    weights: Tensor,
) -> Tensor:
    """Share ``(b, s)`` of the points behind a camera or beyond infinity, and of cameras that are mirrored against the others."""
    inverse, bad = torch.linalg.inv_ex(change)
    points = structure[:, None] @ inverse.mT  # (b, s, n, K)
    known = (structure != 0).any(-1)[:, None]
    world = world.reshape(-1, world.shape[-1])
    sign = (points @ world.mT).sum(-1).sign()
    mirrored = torch.zeros_like(theta[..., 0])
    if cameras.shape[-2] == 3:
        depth = torch.einsum("bvk,bskj,bsnj->bsvn", (cameras @ lifts)[..., -1, :], change, points)
        seen = (weights > 0)[:, None] & known[..., None, :]
        side = depth.sign() * sign[..., None, :] * seen
        view = nonzero_sign(side.sum(-1))  # the camera may have either sign
        wrong = ((side * view[..., None] < 0) & seen).any(-2)
        if derivatives.shape[-1] == 3:
            turned = torch.einsum("bvpmd,bsp->bsvmd", derivatives, theta)
            hand = torch.linalg.det(turned).sign() * view
            there = (weights > 0).any(-1)[:, None]
            mirrored = 1 - (hand * there).sum(-1).abs() / there.sum(-1).clamp(min=1)
    else:
        major = nonzero_sign((sign * known).sum(-1, keepdim=True))
        wrong = (sign * major < 0) & known
    share = wrong.to(theta.dtype).sum(-1) / known.sum(-1).clamp(min=1)
    return torch.where(bad != 0, 2.0, share + mirrored)


# ----------------------------------------------------------------------------------------------------------------------
# Where the descent starts: frames in which one camera already is calibrated.


PLANE_TILTS = (0.6, 1.15)  # radians between the normal of a plane and the first camera's axis, next to 0
NUM_AZIMUTHS = 6  # normals around the axis at each of these


def _targets(d: int) -> Tensor:
    """First columns ``(s, 3, d)`` of rotations: of a plane with normals over the half sphere, of space the identity."""
    if d == 3:
        return torch.eye(3, dtype=torch.float64)[None]
    tilts = [(0.0, 0.0)]
    tilts += [(tilt, 2 * torch.pi * k / NUM_AZIMUTHS) for tilt in PLANE_TILTS for k in range(NUM_AZIMUTHS)]
    angle, around = torch.tensor(tilts, dtype=torch.float64).unbind(-1)
    normal = torch.stack([angle.sin() * around.cos(), angle.sin() * around.sin(), angle.cos()], dim=-1)
    # any two directions across the normal
    across = torch.linalg.qr(torch.cat([normal[..., None], torch.eye(3, dtype=torch.float64).expand(len(normal), 3, 3)], -1))[0]
    return across[..., 1:3]


NUM_INFINITY_DRAWS = 7  # planes at infinity around that of the given frame
DRAW_SPREAD = 0.5  # of these draws, over the change of frame
ALTERNATIONS = 20  # between the turn of the first camera and the changes that the motion allows
START_RIDGE = 1e-3  # weight with which a start stays where the frame is


def _calibrated_first(first: Tensor, changes: WorldChanges, targets: Tensor) -> Tensor:
    """The changes ``(b, s, dim)`` next to the identity that make a camera ``(b, dim, 3, d)`` that of each target, up to a turn."""
    eye = torch.eye(changes.algebra.shape[-1], dtype=first.dtype, device=first.device)
    same = torch.linalg.pinv(changes.algebra.flatten(1).mT) @ eye.flatten()  # coordinates of the identity
    now = torch.einsum("bpmd,p->bmd", first, same)
    length = (now.square().sum((-2, -1)) / now.shape[-1]).sqrt()[:, None, None, None]
    rows = first.flatten(2).mT
    ridge = START_RIDGE * rows.square().sum((-2, -1)) / rows.shape[-1]
    normal = rows.mT @ rows + ridge[:, None, None] * torch.eye(len(same), dtype=first.dtype, device=first.device)
    target = targets[None]
    turned = target @ _polar(target.mT @ now[:, None])
    for _ in range(ALTERNATIONS):
        right = torch.einsum("bpr,bsr->bsp", rows.mT, (length * turned).flatten(2)) + ridge[:, None, None] * same
        theta = torch.linalg.solve_ex(normal[:, None], right[..., None])[0][..., 0]
        turned = target @ _polar(target.mT @ torch.einsum("bpmd,bsp->bsmd", first, theta))
    if target.shape[-1] == 2:
        return theta
    # of space the plane at infinity is open: some further ones
    draw = torch.randn(NUM_INFINITY_DRAWS, len(same), generator=torch.Generator().manual_seed(0), dtype=torch.float64).to(first)
    around = theta + DRAW_SPREAD * theta.norm(dim=-1, keepdim=True) / len(same) ** 0.5 * draw
    return torch.cat([theta, around], dim=1)


def _polar(matrix: Tensor) -> Tensor:
    """The orthogonal matrix next to a square one, of either determinant."""
    u, _, vh = torch.linalg.svd(torch.where(matrix.isfinite(), matrix, 0.0))
    return u @ vh
