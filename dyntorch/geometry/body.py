"""A rigid body that moves before fixed cameras which nobody calibrated: calibration, motion and points by least squares."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from dyntorch.geometry.homogeneous import skew
from dyntorch.geometry.rigid import rotation_exponential
from dyntorch.numerics.blocks import each
from dyntorch.numerics.least_squares import Iterate, LeastSquares, LeastSquaresOptions, Tensors, damped_step, minimize

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
