"""Rigid motions of space: rotations nearest to a matrix, least squares alignment of point sets, small motions."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from dyntorch.geometry.homogeneous import nonzero_sign, skew
from dyntorch.numerics.blocks import each, one_thread
from dyntorch.numerics.least_squares import (
    Iterate,
    LeastSquares,
    LeastSquaresOptions,
    NormalEquations,
    Tensors,
    damped_step,
    minimize,
)


def nearest_rotation(matrix: Tensor) -> Tensor:
    r"""The rotation R that maximizes :math:`\operatorname{tr}(R^T M)`: the polar factor, with determinant +1. matrix
    ``(*batch, 3, 3)`` -> ``(*batch, 3, 3)``."""
    u, _, vt = torch.linalg.svd(matrix)
    flip = torch.ones_like(u[..., 0])
    flip[..., 2] = torch.where(torch.linalg.det(u @ vt) < 0, -1.0, 1.0).to(u.dtype)
    return (u * flip[..., None, :]) @ vt


def rigid_alignment(target: Tensor, source: Tensor, weights: Tensor | None = None, *, scale: bool = False) -> Tensor:
    r"""The rigid motion that carries one point set onto another, :math:`\min \sum_n w_n \|x_n - s R y_n - t\|^2`. target
    ``(*batch, n, 3)``, source ``(*batch, n, 3)``, weights ``(*batch, n)`` -> ``(*batch, 4, 4)``."""
    if target.shape != source.shape or target.shape[-1:] != (3,):
        raise ValueError(f"target and source must be (*batch, n, 3) and alike, got {tuple(target.shape)}, {tuple(source.shape)}")
    weight = torch.ones_like(target[..., 0]) if weights is None else weights
    share = (weight / weight.sum(-1, keepdim=True).clamp(min=torch.finfo(target.dtype).tiny))[..., None]
    to, of = (share * target).sum(-2), (share * source).sum(-2)
    x, y = target - to[..., None, :], source - of[..., None, :]
    moment = (share * x).mT @ y
    rotation = nearest_rotation(moment)
    if scale:
        spread = (share * y.square()).sum((-2, -1)).clamp(min=torch.finfo(target.dtype).tiny)
        rotation = rotation * ((rotation * moment).sum((-2, -1)) / spread)[..., None, None]
    return rigid_motion(rotation, to - (rotation @ of[..., None])[..., 0])


def rigid_motion(rotation: Tensor, translation: Tensor) -> Tensor:
    """The matrix [R t; 0 1], ``(*batch, 4, 4)``, of ``(*batch, 3, 3)`` and ``(*batch, 3)``."""
    upper = torch.cat([rotation, translation[..., None]], dim=-1)
    last = torch.eye(4, dtype=rotation.dtype, device=rotation.device)[3:].expand(*upper.shape[:-2], 1, 4)
    return torch.cat([upper, last], dim=-2)


def rotation_exponential(vector: Tensor) -> Tensor:
    r"""The rotation by :math:`\|\omega\|` about the axis :math:`\omega`, Rodrigues' formula. vector ``(*batch, 3)`` ->
    ``(*batch, 3, 3)``."""
    angle = vector.norm(dim=-1)[..., None, None]
    turn = skew(vector)
    # sinc(x) = sin(pi x) / (pi x): no division by a vanishing angle
    half = torch.sinc(angle / (2 * torch.pi))
    eye = torch.eye(3, dtype=vector.dtype, device=vector.device)
    return eye + torch.sinc(angle / torch.pi) * turn + 0.5 * half.square() * (turn @ turn)


def moved_by(motion: Tensor, tangent: Tensor) -> Tensor:
    r"""A rigid motion after a small one: :math:`y \mapsto y + \omega \times y + \tau` to first order. motion
    ``(*batch, 4, 4)``, tangent ``(*batch, 6)`` -> ``(*batch, 4, 4)``."""
    return rigid_motion(rotation_exponential(tangent[..., :3]), tangent[..., 3:]) @ motion


# ----------------------------------------------------------------------------------------------------------------------
# The Euclidean motion behind the homographies of a plane between calibrated views, and the normal that all of them share.


TINY = 1e-300


class PlaneMotion(NamedTuple):
    r"""A plane :math:`n^T X = 1` in the frame of view 1, and how views stand to it: :math:`X_v = R_v X + t_v`."""

    rotations: Tensor
    """``(*batch, views, 3, 3)``."""
    translations: Tensor
    """``(*batch, views, 3)`` in units of the distance of the plane from view 1."""
    normal: Tensor
    """``(*batch, 3)`` of length 1, away from view 1."""


@one_thread
def plane_motions(H: Tensor) -> PlaneMotion:
    r"""The two motions and planes behind the homography of a plane between two calibrated views,

    .. math:: H \sim R + t\,n^T, \qquad X_2 = R X_1 + t, \quad n^T X_1 = 1.

    H keeps the length of what lies in the plane, so that its middle singular value is 1, and two planes through the middle
    singular vector have that property: each is one solution (the same with -t, -n is left out: of each pair the normal with
    :math:`n_3 \ge 0` is given).  Where the camera only turns, t is 0 and n means nothing.

    Args:
        H: ``(*batch, 3, 3)`` view 1 to view 2 in calibrated coordinates :math:`K^{-1} p`, of the sign with which points before
            camera 1 come to lie before camera 2; of any size.

    Returns:
        Rotations ``(*batch, 2, 3, 3)``, translations ``(*batch, 2, 3)`` and normals ``(*batch, 2, 3)``: the two solutions.

    Source: Faugeras and Lustman 1988; Ma, Soatto, Kosecka and Sastry, An Invitation to 3-D Vision, section 5.3.3.

    Example:
        >>> import torch
        >>> n, t = torch.tensor([0.0, 0.6, 0.8]), torch.tensor([0.3, 0.1, -0.2])
        >>> found = plane_motions(3 * (torch.eye(3) + t[:, None] * n))
        >>> bool((found.normal - n).norm(dim=-1).amin() < 1e-5)
        True
        >>> bool((found.translations - t).norm(dim=-1).amin() < 1e-5)
        True
    """
    _, s, vh = torch.linalg.svd(H)
    unit = H / s[..., 1, None, None].clamp(min=TINY)
    ratio = s / s[..., 1:2].clamp(min=TINY)
    above, below = (ratio[..., 0].square() - 1).clamp(min=0).sqrt(), (1 - ratio[..., 2].square()).clamp(min=0).sqrt()
    length = torch.hypot(above, below)
    turned = length <= torch.finfo(H.dtype).tiny
    share = torch.where(turned, 1.0, below / length.clamp(min=TINY))[..., None]
    other = torch.where(turned, 0.0, above / length.clamp(min=TINY))[..., None]
    first, middle, last = vh.unbind(-2)
    across = torch.stack([share * first + other * last, share * first - other * last], dim=-2)
    normal = torch.linalg.cross(middle[..., None, :].expand_as(across), across)
    normal = normal * nonzero_sign(normal[..., 2:])
    rotation, translation = motion_over(unit[..., None, :, :], normal)
    return PlaneMotion(rotation, translation, normal)


def motion_over(H: Tensor, normal: Tensor) -> tuple[Tensor, Tensor]:
    """The rotation and translation ``(*batch, 3, 3)``, ``(*batch, 3)`` next to homographies of a plane of known normal."""
    within = tangent_basis(normal)
    seen = H @ within
    size = (seen.square().sum((-2, -1)) / 2).sqrt().clamp(min=TINY)[..., None, None]
    seen = seen / size
    third = torch.linalg.cross(seen[..., 0], seen[..., 1])
    rotation = nearest_rotation(torch.cat([seen, third[..., None]], dim=-1) @ torch.cat([within, normal[..., None]], dim=-1).mT)
    return rotation, ((H / size - rotation) @ normal[..., None])[..., 0]


def tangent_basis(normal: Tensor) -> Tensor:
    """Two directions ``(*batch, 3, 2)`` of length 1 across each other and the normal ``(*batch, 3)``: right-handed with it."""
    axis = torch.zeros_like(normal).scatter(-1, normal.abs().argmin(-1, keepdim=True), 1.0)
    first = torch.linalg.cross(axis, normal)
    first = first / first.norm(dim=-1, keepdim=True).clamp(min=TINY)
    return torch.stack([first, torch.linalg.cross(normal, first)], dim=-1)


@dataclass(frozen=True)
class CommonPlane(NormalEquations):
    r"""The normal n ``(b, 3)`` of one plane behind homographies :math:`H_v` from view 1 to each of ``v`` others."""

    inverse: Tensor
    """``(b, v, 3, 3)``: N, the inverses of H (view v to view 1)."""
    covariance: Tensor
    """``(b, 9 v, 9 v)`` of their entries, row by row."""
    floor: float
    """Standard deviation of the conditions that is rounding."""

    def subset(self, keep: Tensor) -> CommonPlane:
        """Some of the problems."""
        return replace(self, inverse=self.inverse[keep], covariance=self.covariance[keep])

    def linear(self, normal: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Conditions ``(b, 2 v)``, their derivatives by turns of n ``(b, 2 v, 2)`` and by entries of N ``(b, 2 v, 9 v)``."""
        H = torch.linalg.inv_ex(self.inverse)[0]
        H = torch.where(H.isfinite(), H, 0.0)
        b, v = H.shape[:2]
        E = tangent_basis(normal)[:, None]
        seen, ahead = H @ E, (H @ normal[:, None, :, None])[..., 0]
        g = seen.mT @ seen
        # n turns by E delta, and E by -n delta^T
        mixed = (ahead[..., None, :] @ seen)[..., 0, :]
        eye = torch.eye(2, dtype=H.dtype, device=H.device)
        turned = -(eye[:, :, None] * mixed[:, :, None, None, :] + eye[:, None, :] * mixed[:, :, None, :, None])
        # d H = -H dN H
        left = H.mT @ seen  # (b, v, 3, 2)
        product = -left[:, :, :, None, :, None] * seen[:, :, None, :, None, :]  # by N_ij: entries p of i, q of j
        by = (product + product.mT).flatten(2, 3)
        mean = (g.diagonal(dim1=-2, dim2=-1).sum(-1) / 2).clamp(min=TINY)

        def conditions(change: Tensor) -> Tensor:
            return torch.stack([(change[..., 0, 0] - change[..., 1, 1]) / 2, change[..., 0, 1]], dim=-1)

        r = conditions(g) / mean[..., None]

        def slopes(change: Tensor) -> Tensor:
            half = change.diagonal(dim1=-2, dim2=-1).sum(-1) / 2
            return (conditions(change) - r[:, :, None] * half[..., None]) / mean[..., None, None]

        own = slopes(by).mT  # (b, v, 2, 9)
        wide = torch.einsum("bvcp,vw->bvcwp", own, torch.eye(v, dtype=H.dtype, device=H.device))
        return r.flatten(1), slopes(turned).mT.reshape(b, 2 * v, 2), wide.reshape(b, 2 * v, 9 * v)

    def whiten_conditions(self, normal: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Conditions, their derivatives by turns, :math:`S^{-1}` and :math:`C J^T`, by which N follows the conditions."""
        r, turns, by = self.linear(normal)
        spread = self.covariance @ by.mT
        S = by @ spread
        eye = torch.eye(S.shape[-1], dtype=S.dtype, device=S.device)
        inverse = torch.linalg.inv_ex(S + self.floor**2 * eye)[0]
        return r, turns, torch.where(inverse.isfinite(), inverse, 0.0), spread

    def normal_equations(self, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Cost, gradient and matrix by the three entries of n; along n nothing changes."""
        r, turns, inverse, _ = self.whiten_conditions(theta)
        J = turns @ tangent_basis(theta).mT
        weighed = J.mT @ inverse
        matrix = weighed @ J
        along = (matrix.diagonal(dim1=-2, dim2=-1).sum(-1) + TINY)[:, None, None] * theta[:, :, None] * theta[:, None, :]
        return (r[:, None] @ inverse @ r[..., None])[:, 0, 0], (weighed @ r[..., None])[..., 0], matrix + along

    def correct_homographies(self, normal: Tensor) -> Tensor:
        """The homographies N next to the measured ones, in standard deviations, that fulfil the conditions."""
        r, _, inverse, spread = self.whiten_conditions(normal)
        return self.inverse - (spread @ inverse @ r[..., None])[..., 0].view_as(self.inverse)


# ----------------------------------------------------------------------------------------------------------------------
# A rigid body that moves before fixed cameras which nobody calibrated: calibration, motion and points by least squares.


INTRINSICS = 5
"""Of a camera: the entries of the upper triangle of K but for the last."""


class FilmedBody(NamedTuple):
    r"""What images show of a moving body: :math:`x_{tj} \simeq K_c\,(R_c\,(R_t X_j + T_t) + t_c)`, up to a similarity of space."""

    calibrations: Tensor
    """``(b, c, 3, 3)`` upper triangular K, the last entry 1."""
    sights: Tensor
    """``(b, c, 3, 4)`` of the cameras, [R t]; the first is [I 0]."""
    motions: Tensor
    """``(b, frames, 3, 4)`` [R T] from the body to the first camera."""
    points: Tensor
    """``(b, n, 3)`` on the body."""

    @property
    def projections(self) -> Tensor:
        """``(b, c, 3, 4)`` of the cameras."""
        return self.calibrations @ self.sights

    def points_in_camera(self) -> Tensor:
        """``(b, frames, n, 3)`` points before the first camera."""
        return self.points[:, None] @ self.motions[..., :3].mT + self.motions[..., None, :, 3]

    def images(self, camera: Tensor) -> tuple[Tensor, Tensor]:
        """Images ``(b, frames, n, 2)`` and depths ``(b, frames, n)`` of points that the cameras ``(n,)`` see."""
        own = self.projections[:, camera]  # (b, n, 3, 4)
        seen = torch.einsum("bnij,btnj->btni", own[..., :3], self.points_in_camera()) + own[:, None, :, :, 3]
        return seen[..., :2] / seen[..., 2:], seen[..., 2]


@dataclass(frozen=True)
class BodyProblem(LeastSquares):
    r"""Minimize :math:`\sum w_{tj} |x_{tj} - \pi(\ldots)|^2` over a block of problems, the motions of the frames eliminated."""

    x: Tensor
    """``(b, frames, n, 2)`` of order 1, any finite value where the weight is 0."""
    weights: Tensor
    """``(b, frames, n)``."""
    camera: Tensor
    """``(n,)`` which camera a point is seen by."""

    def subset(self, keep: Tensor) -> BodyProblem:
        """Only some of the problems."""
        return replace(self, x=self.x[keep], weights=self.weights[keep])

    def evaluate(self, theta: Tensors) -> Iterate:
        """The cost; infinite where a point that counts is behind its camera."""
        images, depth = FilmedBody(*theta).images(self.camera)
        seen = self.weights > 0
        square = torch.where(seen, (images - self.x).square().sum(-1), 0.0)
        cost = (square * self.weights).sum((1, 2))
        front = ((depth > 0) | ~seen).all(-1).all(-1)
        return Iterate(theta, torch.where(front & cost.isfinite(), cost, torch.inf), ())

    def step(self, at: Iterate, damping: Tensor) -> Tensors:
        """Steps of the common parameters and of the motions."""
        error, common, own = self._linear(FilmedBody(*at.theta))
        gram = own.mT @ own
        diagonal = gram.diagonal(dim1=-2, dim2=-1)
        held = gram + torch.diag_embed(damping[:, None, None] * diagonal + 1e-12 * diagonal.amax(-1, keepdim=True) + 1e-300)
        factor, _ = torch.linalg.cholesky_ex(held)
        cross = own.mT @ torch.cat([common, error[..., None]], -1)  # (b, frames, 6, G + 1)
        solved = torch.cholesky_solve(cross, factor)
        tall = common.flatten(1, 2)
        matrix = tall.mT @ tall - (cross[..., :-1].mT @ solved[..., :-1]).sum(1)
        gradient = (tall.mT @ error.flatten(1)[..., None])[..., 0] - (cross[..., :-1].mT @ solved[..., -1:]).sum(1)[..., 0]
        # the gauge is free: the least ridge keeps the factorization alive on exact data
        step = damped_step(gradient, matrix, damping, ridge=1e-13)
        return step, solved[..., -1] - (solved[..., :-1] @ step[:, None, :, None])[..., 0]

    def retract(self, theta: Tensors, step: Tensors) -> Tensors:
        """Calibrations and points moved, the bodies turned."""
        at, (common, own) = FilmedBody(*theta), step
        cameras, n = at.calibrations.shape[1], at.points.shape[1]
        inner, turns, points = common.split([INTRINSICS * cameras, 6 * (cameras - 1), 3 * n], dim=-1)
        rows, columns = torch.triu_indices(3, 3, device=common.device)[:, :-1]
        calibrations = at.calibrations.clone()
        calibrations[..., rows, columns] -= inner.unflatten(-1, (cameras, INTRINSICS))
        sights = at.sights.clone()
        sights[:, 1:] = _move_cameras(at.sights[:, 1:], -turns.unflatten(-1, (cameras - 1, 6)))
        return calibrations, sights, _move_cameras(at.motions, -own), at.points - points.unflatten(-1, (n, 3))

    def information(self, at: FilmedBody) -> Tensor:
        """``(b, frames, 6, 6)`` of the motions, all else known: turns in radians about the origin, then moves."""
        own = self._linear(at)[2]
        return own.mT @ own

    def _linear(self, at: FilmedBody) -> tuple[Tensor, Tensor, Tensor]:
        """Weighted errors ``(b, frames, 2n)``, derivatives by what is common ``(..., G)`` and by a frame's motion ``(..., 6)``."""
        cameras, n = at.calibrations.shape[1], at.points.shape[1]
        turned = at.points[:, None] @ at.motions[..., :3].mT  # (b, frames, n, 3)
        placed = turned + at.motions[..., None, :, 3]
        sights, calibrations = at.sights[:, self.camera], at.calibrations[:, self.camera]
        before = torch.einsum("bnij,btnj->btni", sights[..., :3], placed)
        seen = before + sights[:, None, :, :, 3]
        image = torch.einsum("bnij,btnj->btni", calibrations, seen)
        x = image[..., :2] / image[..., 2:]
        root = self.weights.sqrt()
        error = torch.where(root[..., None] > 0, (x - self.x) * root[..., None], 0.0)
        eye = torch.eye(2, dtype=x.dtype, device=x.device).expand(*x.shape, 2)
        by_image = torch.cat([eye, -x[..., None]], -1) * (root / image[..., 2])[..., None, None]
        by_image = torch.where(root[..., None, None] > 0, by_image, 0.0)
        by_seen = by_image @ calibrations[:, None]
        by_placed = by_seen @ sights[:, None, ..., :3]
        own = torch.cat([by_placed @ -skew(turned), by_placed], -1).flatten(2, 3)
        rows, columns = torch.triu_indices(3, 3, device=x.device)[:, :-1]
        inner = by_image[..., rows] * seen[..., None, columns]
        sight = torch.cat([by_seen @ -skew(before), by_seen], -1)
        mine = torch.nn.functional.one_hot(self.camera, cameras).to(x)
        blocks = [
            (mine[:, None, :, None] * inner[..., None, :]).flatten(-2),
            (mine[:, None, 1:, None] * sight[..., None, :]).flatten(-2),
            (
                torch.eye(n, dtype=x.dtype, device=x.device)[:, None, :, None]
                * (by_placed @ at.motions[:, :, None, :, :3])[..., None, :]
            ).flatten(-2),
        ]
        return error.flatten(2), torch.cat(blocks, -1).flatten(2, 3), own


def _move_cameras(motion: Tensor, tangent: Tensor) -> Tensor:
    r"""[R T] with :math:`e^{[\omega]} R` and :math:`T + \tau`."""
    rotation = rotation_exponential(tangent[..., :3]) @ motion[..., :3]
    return torch.cat([rotation, (motion[..., 3] + tangent[..., 3:])[..., None]], -1)


def fit_body(problem: BodyProblem, start: FilmedBody, options: LeastSquaresOptions) -> tuple[FilmedBody, Tensor]:
    """The body next to a start, and its cost ``(b,)``, infinite where the start has points behind a camera."""
    least = minimize(problem, problem.evaluate(tuple(each(lambda part: part.contiguous(), start))), options)
    return FilmedBody(*least.theta), least.cost
