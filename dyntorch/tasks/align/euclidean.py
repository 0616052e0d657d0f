r"""align_planar(calibration=): how calibrated cameras turned and moved, and the plane below the points.

The homographies :math:`N_v = K_1^{-1} A_v K_v` of a plane :math:`n^T X = 1` are inverse to :math:`R_v + t_v n^T`, but for scale.
Two planes explain each of them; the one that explains all is looked for by least squares, from either plane of every view.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from dyntorch.core.limits import three_sigma
from dyntorch.core.matches import Matches
from dyntorch.core.normalize import denormalize_motion
from dyntorch.core.outcome import Notice, has_inliers, noting
from dyntorch.core.solution import Solution
from dyntorch.geometry.homogeneous import homogeneous, nonzero_sign
from dyntorch.geometry.plane_motion import CommonPlane, PlaneMotion, motion_over, plane_motions
from dyntorch.numerics.least_squares import LeastSquaresOptions, minimize
from dyntorch.numerics.nullspace import eigenvalues
from dyntorch.tasks.align.result import OUTLIER, AlignNotice

MAX_NORMAL_STEPS = 30  # of each descent on the normal of the plane
LENGTH_ROUNDING = 1e-9  # relative deviation from equal lengths: homographies of pixels lose 6 of 16 digits
MAX_EQUIVALENT_CHI_SQUARE = 9.0  # beyond the least, up to which a plane explains as well: three standard deviations
MAX_HIDDEN_SHARE = 0.02  # of points behind cameras, beyond the least, up to which a plane shows them as well
MIN_NORMAL_ANGLE = 0.03  # radians from which two normals are two
MIN_NORMAL_DEVIATIONS = 3.0  # and besides so many standard deviations
MAX_NORMAL_DEVIATION = 0.3  # radians; a camera that only turns leaves 1 and more
MAX_CALIBRATION_MISFIT = 5.0  # chi-square over its quantile of three standard deviations
MIN_LENGTH_DEVIATION = 0.003  # relative, that a calibration to two or three digits leaves


class CalibratedViews(NamedTuple):
    """Homographies between calibrated views of a plane, flat batch, and what was seen of it."""

    inverse: Tensor
    """``(b, v, 3, 3)`` N, every further view to view 1, of middle singular value 1 and the sign that keeps depths positive."""
    covariance: Tensor
    """``(b, 9 v, 9 v)`` of its entries; 0 where it is not known."""
    known: Tensor
    """``(b,)`` where it is."""
    fine: Tensor
    """``(b,)`` where there is a motion."""
    rays: Tensor
    """``(b, v + 1, n, 3)`` in calibrated coordinates, the first ones of view 1."""
    counts: Tensor
    """``(b, n)`` bool: matches that are inliers."""

    @classmethod
    def of(cls, solution: Solution, data: Matches, labels: Tensor, K: Tensor) -> CalibratedViews:
        """Of a solution and its labels ``(b, n)``, with K ``(b, v + 1, 3, 3)``."""
        back = torch.linalg.inv(K)
        motion = denormalize_motion(solution.invariant, solution.normalized_motion(), solution.normalization.transforms)
        solved = has_inliers(solution.status.reshape(-1))
        A = torch.stack(list(motion), dim=1)
        N = back[:, :1] @ A @ K[:, 1:]
        fine = solved & N.isfinite().flatten(1).all(-1) & (torch.linalg.det(N) != 0).all(-1)
        eye = torch.eye(3, dtype=N.dtype, device=N.device)
        N = torch.where(fine[:, None, None, None], N, eye)
        b, v = N.shape[:2]
        # the entries of X A Y, row by row, are those of A times kron(X, Y^T)
        by = torch.einsum("bij,bvlk->bvikjl", back[:, 0], K[:, 1:]).reshape(b, v, 9, 9)
        rays = homogeneous(torch.stack(data.views, dim=1)) @ back.mT
        counts = (labels != OUTLIER) & (data.weights > 0)
        mapped = (N @ rays[:, 1:].mT)[..., 2, :]
        sign = nonzero_sign((mapped.sign() * counts[:, None]).sum(-1))
        scale = sign / torch.linalg.svdvals(N)[..., 1]
        by = by * scale[..., None, None]
        assert solution.covariance is not None
        C = solution.covariance
        known = fine & C.isfinite().flatten(1).all(-1)
        C = torch.einsum("bvkp,bvpwq,bwlq->bvkwl", by, torch.where(C.isfinite(), C, 0.0).view(b, v, 9, v, 9), by)
        C = torch.where(known[:, None, None], C.reshape(b, 9 * v, 9 * v), 0.0)
        return cls(scale[..., None, None] * N, C, known, fine, rays, counts)

    def repeated(self, count: int) -> CalibratedViews:
        """Every problem so many times in a row."""
        return CalibratedViews(*(part.repeat_interleave(count, 0) for part in self))

    def plane(self) -> CommonPlane:
        """The least squares problem of the normal."""
        return CommonPlane(inverse=self.inverse, covariance=self.covariance, floor=LENGTH_ROUNDING)

    def oriented(self, normal: Tensor) -> Tensor:
        """The normals ``(b, 3)`` or their opposites, such that most of the plane that view 1 sees lies before it."""
        depth = (self.rays[:, 0] @ normal[..., None])[..., 0]
        return normal * nonzero_sign((depth.sign() * self.counts).sum(-1, keepdim=True))

    def behind(self, normal: Tensor) -> Tensor:
        """Greatest share over the views ``(b,)`` of matches whose ray meets the plane behind the camera."""
        mapped = torch.cat([self.rays[:, :1], self.rays[:, 1:] @ self.inverse.mT], dim=1)
        wrong = ((mapped @ normal[:, None, :, None])[..., 0] <= 0) & self.counts[:, None]
        return (wrong.sum(-1) / self.counts.sum(-1).clamp(min=1)[:, None]).amax(-1)

    def motion(self, normal: Tensor) -> PlaneMotion:
        """Rotations and translations ``(b, v + 1, ...)`` of all views, the first included, above the plane of a normal."""
        H = torch.linalg.inv_ex(self.plane().correct_homographies(normal))[0]
        rotation, translation = motion_over(torch.where(H.isfinite(), H, 0.0), normal[:, None].expand(*H.shape[:2], 3))
        eye = torch.eye(3, dtype=H.dtype, device=H.device).expand(len(H), 1, 3, 3)
        return PlaneMotion(
            torch.cat([eye, rotation], dim=1), torch.cat([torch.zeros_like(translation[:, :1]), translation], dim=1), normal
        )


class PlaneChoice(NamedTuple):
    """The normal of each problem, and what speaks for it."""

    normal: Tensor
    """``(b, 3)``."""
    other: Tensor
    """``(b, 3)`` one that explains the homographies as well; 0 where there is none."""
    cost: Tensor
    """``(b,)`` chi-square of ``2 v - 2`` degrees of freedom."""
    misfit: Tensor
    """``(b,)`` rms of the conditions."""
    deviation: Tensor
    """``(b,)`` standard deviation of the normal in its worst direction, radians."""


def chosen_plane(views: CalibratedViews) -> PlaneChoice:
    """The plane that explains the homographies best, and before the cameras, from either solution of every view."""
    inverse = views.inverse
    b = len(inverse)
    starts = plane_motions(torch.linalg.inv(inverse)).normal.flatten(1, 2)
    count = starts.shape[1]
    wide = views.repeated(count)
    problem = wide.plane()
    found = minimize(problem, problem.evaluate((starts.flatten(0, 1),)), LeastSquaresOptions(iterations=MAX_NORMAL_STEPS))
    flat = wide.oriented(found.theta[0])
    normal, cost, wrong = flat.view(b, count, 3), found.cost.view(b, count), wide.behind(flat).view(b, count)
    fits = cost <= cost.amin(-1, keepdim=True) + MAX_EQUIVALENT_CHI_SQUARE
    fits = fits & (wrong <= torch.where(fits, wrong, torch.inf).amin(-1, keepdim=True) + MAX_HIDDEN_SHARE)
    best = torch.where(fits, cost, torch.inf).argmin(-1)
    row = torch.arange(b, device=best.device)
    chosen = normal[row, best]
    r, turns, weight, _ = views.plane().weighted(chosen)
    deviation = eigenvalues(turns.mT @ weight @ turns)[:, 0].clamp(min=torch.finfo(r.dtype).tiny).rsqrt()
    apart = fits & ((normal - chosen[:, None]).norm(dim=-1) > MIN_NORMAL_ANGLE + MIN_NORMAL_DEVIATIONS * deviation[:, None])
    second = normal[row, torch.where(apart, cost, torch.inf).argmin(-1)]
    return PlaneChoice(
        chosen,
        torch.where(apart.any(-1)[:, None], second, 0.0),
        cost[row, best],
        r.square().mean(-1).sqrt(),
        deviation,
    )


def euclidean(solution: Solution, data: Matches, labels: Tensor, K: Tensor) -> tuple[PlaneMotion, PlaneMotion, list[Notice]]:
    """Motion of calibrated cameras above a plane, another that explains the matches as well, and what limits both. labels
    ``(b, n)``, K ``(b, views, 3, 3)``."""
    views = CalibratedViews.of(solution, data, labels, K)
    choice = chosen_plane(views)
    free = views.fine & (choice.deviation > MAX_NORMAL_DEVIATION)
    several = views.fine & ~free & (choice.other != 0).any(-1)
    degrees = 2 * views.inverse.shape[1] - 2
    odd = views.known & (choice.cost > MAX_CALIBRATION_MISFIT * three_sigma(degrees)) & (choice.misfit > MIN_LENGTH_DEVIATION)
    notices, note = noting(data.batch)
    note(AlignNotice.PLANE_OPEN, choice.deviation.clamp(max=9.9), free)
    note(AlignNotice.TWO_PLANES, _angle(choice.normal, choice.other), several)
    note(AlignNotice.CALIBRATION, choice.misfit, odd & ~free)
    first = views.motion(choice.normal)
    second = views.motion(torch.where(several[:, None], choice.other, choice.normal))
    return _to_batch(first, views.fine, ~free, data), _to_batch(second, several, several, data), notices


def _angle(first: Tensor, second: Tensor) -> Tensor:
    """Degrees between directions ``(b, 3)``."""
    return torch.rad2deg(torch.atan2(torch.linalg.cross(first, second).norm(dim=-1), (first * second).sum(-1)))


def _to_batch(motion: PlaneMotion, turned: Tensor, determined: Tensor, data: Matches) -> PlaneMotion:
    """Zero where there is no rotation, and where the plane, in units of whose distance translations are, is not determined."""
    both = turned & determined
    return PlaneMotion(
        data.back(torch.where(turned[:, None, None, None], motion.rotations, 0.0)),
        data.back(torch.where(both[:, None, None], motion.translations, 0.0)),
        data.back(torch.where(both[:, None], motion.normal, 0.0)),
    )
