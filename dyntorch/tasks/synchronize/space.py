"""A camera against motion capture: one camera matrix explains what is seen at the right shift, and at no other.

What the camera sees of points in space is :math:`x \\sim P X`, whatever the unit and the axes of the space: P is unknown, 3 x 4,
and the same in all frames.  Where both hold the same points, P is fitted to all frames at every shift, by moments that FFT gives
(:func:`dyntorch.numerics.lags.resection_moments`), and then, with the shift and the clock rate, to the distances in the image.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor

from dyntorch.geometry.epipolar import RIDGE, least_ratio
from dyntorch.numerics.lags import resection_moments
from dyntorch.tasks.synchronize.epipolar import Matched, PairModel, Residuals, Samples, ShiftDescent
from dyntorch.tasks.synchronize.options import SynchronizeOptions
from dyntorch.tasks.synchronize.tracks import Tracks, image_of, smoothed

# ----------------------------------------------------------------------------------------------------------------------
# The camera of least residual from moments, at all shifts at once.


def camera_variance(moments: Tensor, noise: float = 1.0) -> tuple[Tensor, Tensor]:
    r"""The least variance of what a camera leaves of its images, and the camera that has it. moments ``(*batch, 4, 4, 4)`` ->
    ``(*batch,)``."""
    total = moments[..., 0, 3, 3]
    present = total > 0
    unit = torch.eye(4, dtype=moments.dtype, device=moments.device)
    mean = moments / torch.where(present, total, 1.0)[..., None, None, None]
    whole = torch.where(present[..., None, None], mean[..., 0, :, :], unit)
    ridge = RIDGE * whole.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None] * unit
    factor, failed = torch.linalg.cholesky_ex(whole + ridge)
    present = present & (failed == 0)
    factor = torch.where(present[..., None, None], factor, unit)
    across, down = (torch.cholesky_solve(mean[..., k, :, :], factor) for k in (1, 2))
    left = mean[..., 3, :, :] - mean[..., 1, :, :] @ across - mean[..., 2, :, :] @ down
    left = (left + left.mT) / 2
    # in a direction that no point leaves, both forms are zero; the ridge of the numerator alone keeps it from being the answer
    ridge = RIDGE * mean[..., 3, :, :].diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None] * unit
    left = torch.where(present[..., None, None], left + ridge, unit)
    ratio, third = least_ratio(left, 2 * noise**2 * whole, present)
    camera = torch.stack([(across @ third[..., None])[..., 0], (down @ third[..., None])[..., 0], third], dim=-2)
    bad = ~ratio.isfinite()[..., None, None]
    norm = torch.linalg.matrix_norm(camera, keepdim=True)
    return ratio, torch.where(bad, 0.0, camera / torch.where(bad, 1.0, norm))


@dataclass(frozen=True, eq=False)
class SpaceSamples(Samples):
    """Smoothed, normalized points of a camera ``(m, n, 2)`` and the same points in space ``(m, n, 3)``, in either order."""

    @classmethod
    def of(cls, a: Tracks, b: Tracks, step: float, rate: float = 1.0, *, options: SynchronizeOptions) -> Self:
        """As of two cameras; the noise is that of the camera alone."""
        found = super().of(a, b, step, rate, options=options)
        unit = float(image_of(a, b).change[0, 0])
        return replace(found, noise=(unit, unit))

    def moments(self, lags: tuple[int, int], per_point: bool = False) -> tuple[Tensor, Tensor]:
        """Moments ``([n,] L, 4, 4, 4)`` at lags, and counts ``([n,] L)``."""
        if self.x1.shape[-1] == 2:
            return resection_moments(self.x1, self.x2, lags, (self.w1, self.w2), per_point)
        moments, counts = resection_moments(self.x2, self.x1, (-lags[1], -lags[0]), (self.w2, self.w1), per_point)
        return moments.flip(-4), counts.flip(-1)

    def solved(self, moments: Tensor) -> tuple[Tensor, Tensor]:
        """Variances ``(L,)``, px^2, and cameras ``(L, 3, 4)``."""
        return camera_variance(moments, self.noise[0])

    def variances_by(self, geometry: Tensor, moments: Tensor) -> Tensor:
        """``(n,)`` each point's residual variance by one camera; NaN where it is never seen."""
        first, second, third = geometry
        plain, across, down, square = moments.unbind(1)
        above = torch.einsum("i,nij,j->n", third, square, third)
        for row, mixed in ((first, across), (second, down)):
            above = above + torch.einsum("i,nij,j->n", row, plain, row) - 2 * torch.einsum("i,nij,j->n", row, mixed, third)
        below = 2 * self.noise[0] ** 2 * torch.einsum("i,nij,j->n", third, plain, third)
        return torch.where(below > 0, above / torch.where(below > 0, below, 1.0), torch.nan)


# ----------------------------------------------------------------------------------------------------------------------
# Offset, clock rate and camera at once: robust least squares of the distances in the image.


class SpaceDescent(ShiftDescent):
    """The problem for a camera and points in space, in either order; the geometry is the camera ``(3, 4)``, of norm 1."""

    def __init__(self, a: Tracks, b: Tracks, width: float, rows: int | None = None, *, options: SynchronizeOptions) -> None:
        super().__init__(a, b, width, rows, options=options)
        unit = float(image_of(a, b).change[0, 0])
        self.noise = (unit, unit)
        # velocities of the space are as good as exact, those of a camera are not
        self.speed = None if image_of(a, b) is a else smoothed(a, self.times, width, options)[1]

    def _matched(self, offset: float, rate: float, every: int = 1) -> Matched | None:
        """As of two cameras, the image as p and the space as q; the speed is that of the space by the offset."""
        found = super()._matched(offset, rate, every)
        if found is None or self.speed is None:
            return found
        # b shows later what it would show without the offset: as if a were earlier
        speed = torch.nn.functional.pad(self.speed[::every][found.both], (0, 1)) @ self.changes[0].mT / -rate
        return replace(found, p=found.q, q=found.p, speed=speed)

    def _moment_fit(self, matched: Matched) -> tuple[Tensor, Tensor]:
        """Variance and camera by the moments alone."""
        x = matched.p[:, :2]
        of_image = torch.cat([torch.ones_like(x[:, :1]), x, x.square().sum(-1, keepdim=True)], dim=-1) * matched.sure[:, None]
        moments = of_image.mT @ (matched.q[:, :, None] * matched.q[:, None]).flatten(1)
        return camera_variance(moments.unflatten(1, (4, 4)), self.noise[0])

    @staticmethod
    def _nearest(matrix: Tensor) -> Tensor:
        return matrix / matrix.norm().clamp(min=1e-300)

    @staticmethod
    def _tangent(matrix: Tensor) -> Tensor:
        """``(11, 12)`` orthonormal directions that keep the norm."""
        return torch.linalg.qr(matrix.reshape(12, 1), mode="complete")[0][:, 1:].mT

    def _residuals(self, F: Tensor, matched: Matched, times: Tensor) -> SpaceRows:
        """Distances from the images, across and down, px."""
        images, speed = matched.q @ F.mT, matched.speed @ F.mT
        depth = images[:, 2]
        side = 1.0 if float(depth.sum()) >= 0 else -1.0
        # a point near the camera's own plane, or behind, has no image: as if it were close, it is far off and weighs nothing
        depth = side * (side * depth).clamp(min=self.options.descent.nearest * float(depth.abs().median()))
        seen = images[:, :2] / depth[:, None]
        residual = (seen - matched.p[:, :2]) / self.noise[0]
        along = (speed[:, :2] - seen * speed[:, 2:]) / (depth[:, None] * self.noise[0])
        rays = matched.q / (depth[:, None] * self.noise[0])
        products = rays.new_zeros(len(rays), 2, 3, 4)
        products[:, 0, 0] = products[:, 1, 1] = rays
        products[:, :, 2] = -seen[..., None] * rays[:, None]
        return SpaceRows(
            residual.flatten(), products.flatten(0, 1).flatten(1), along.flatten(), times.repeat_interleave(2), matched.both,
            matched.sure, options=self.options,
        )  # fmt: skip

    def _given(self, F: Tensor) -> Tensor:
        image, space = self.changes if self.speed is None else self.changes[::-1]
        return torch.linalg.solve(image, F @ space)


@dataclass(frozen=True, eq=False)
class SpaceRows(Residuals):
    """Two residuals for every position, ``(2 m,)``."""

    @property
    def distances(self) -> Tensor:
        """``(m,)`` in the image, so that their median is that of the absolute value of one coordinate."""
        # a normal coordinate has the median .6745, the distance of two 1.1774
        return 0.6745 / 1.1774 * self.residual.unflatten(0, (-1, 2)).norm(dim=-1)

    @property
    def frames(self) -> Tensor:
        """Frame of every residual."""
        return super().frames.repeat_interleave(2)

    def weights(self) -> Tensor:
        """Of Geman and McClure, one for both coordinates."""
        return super().weights().repeat_interleave(2)


CAMERA = PairModel("camera", SpaceSamples, SpaceDescent)
"""A camera, and the same points in space."""
