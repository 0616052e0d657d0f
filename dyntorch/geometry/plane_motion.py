"""The Euclidean motion behind the homographies of a plane between calibrated views, and the normal that all of them share."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from dyntorch.geometry.homogeneous import nonzero_sign
from dyntorch.geometry.rigid import nearest_rotation
from dyntorch.numerics.blocks import one_thread
from dyntorch.numerics.least_squares import NormalEquations

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

    def weighted(self, normal: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Conditions, their derivatives by turns, :math:`S^{-1}` and :math:`C J^T`, by which N follows the conditions."""
        r, turns, by = self.linear(normal)
        spread = self.covariance @ by.mT
        S = by @ spread
        eye = torch.eye(S.shape[-1], dtype=S.dtype, device=S.device)
        inverse = torch.linalg.inv_ex(S + self.floor**2 * eye)[0]
        return r, turns, torch.where(inverse.isfinite(), inverse, 0.0), spread

    def normal_equations(self, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Cost, gradient and matrix by the three entries of n; along n nothing changes."""
        r, turns, inverse, _ = self.weighted(theta)
        J = turns @ tangent_basis(theta).mT
        weighed = J.mT @ inverse
        matrix = weighed @ J
        along = (matrix.diagonal(dim1=-2, dim2=-1).sum(-1) + TINY)[:, None, None] * theta[:, :, None] * theta[:, None, :]
        return (r[:, None] @ inverse @ r[..., None])[:, 0, 0], (weighed @ r[..., None])[..., 0], matrix + along

    def correct_homographies(self, normal: Tensor) -> Tensor:
        """The homographies N next to the measured ones, in standard deviations, that fulfil the conditions."""
        r, _, inverse, spread = self.weighted(normal)
        return self.inverse - (spread @ inverse @ r[..., None])[..., 0].view_as(self.inverse)
