"""What translating_planes() returns: the homography at infinity, how every body moved, and its reconstruction."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.algebra.homogeneous import finite_depth, homogeneous, inhomogeneous, unit_vectors
from dyntorch.algebra.triangulation import triangulate
from dyntorch.normalize import hartley
from dyntorch.solution import Status, failed
from dyntorch.tasks.notices import Notice, check_results

STEPS = 5  # of Gauss and Newton on the reprojection error of a point


@dataclass(frozen=True, eq=False, repr=False)
class TranslatingPlanes:
    r"""Result of :func:`dyntorch.translating_planes`, for p planes and m bodies with known fundamental matrices; c = p + m.

    Everything is zero where the status says that there is nothing, and for planes and bodies that were left out.

    Attributes:
        homography_at_infinity: :math:`H_\infty` ``(*batch, 3, 3)``, view 1 to view 2, Frobenius norm 1, determinant positive.
        epipoles: :math:`e_i` ``(*batch, c, 3)`` in view 2, homogeneous, norm 1, of the planes first.  Their signs: points of a
            plane have positive depth.
        fundamentals: :math:`F_i \sim [e_i]_\times H_\infty` ``(*batch, c, 3, 3)``, norm 1, :math:`x_2^T F x_1 = 0`.
        normals: :math:`n_i` ``(*batch, p, 3)``: a point of the plane at x in view 1 has the depth :math:`1 / (n_i^T (x, 1))`.
        scales: :math:`\lambda_i` ``(*batch, p)``, :math:`H_i = \lambda_i (H_\infty + e_i n_i^T)`.
        used: ``(*batch, c)`` bool, planes and bodies that counted.
        residual: ``(*batch,)`` rms Sampson distance of the matches (each coordinate counts), in their unit; without matches rms
            difference of the entries of matrices of norm 1 in normalized coordinates.
        covariance: ``(*batch, 9, 9)`` of the entries of the homography at infinity, row by row, from the noise that the residuals
            show, rather too large where few of them are to spare; 0 where nothing is left to judge by.
        uncertainty: ``(*batch,)`` expected relative error of the homography at infinity in normalized coordinates.
        status: ``(*batch,)`` of :class:`dyntorch.Status`.
        rotation: ``(*batch, 3, 3)`` camera 1 to camera 2, where the calibration was given.
        calibration: ``(*batch, 2, 3, 3)`` of both cameras, where it was given.
        warnings: notices on single problems of the batch.
        unit: of ``residual``: ``"px"``, as the matches, or ``"relative"`` without matches.
    """

    homography_at_infinity: Tensor
    epipoles: Tensor
    fundamentals: Tensor
    normals: Tensor
    scales: Tensor
    used: Tensor
    residual: Tensor
    covariance: Tensor
    uncertainty: Tensor
    status: Tensor
    rotation: Tensor | None = None
    calibration: Tensor | None = None
    warnings: tuple[Notice, ...] = ()
    unit: str = "relative"

    @property
    def translations(self) -> Tensor | None:
        r"""Unit translations ``(*batch, c, 3)`` of the bodies, :math:`X_2 = R X_1 + s_i t_i`, where the calibration was given."""
        if self.calibration is None:
            return None
        inverse = torch.linalg.inv_ex(self.calibration[..., 1, :, :])[0]
        return unit_vectors(self.epipoles @ inverse.mT)

    def cameras(self) -> tuple[Tensor, Tensor]:
        r"""Affine cameras of every body, :math:`P = [I \mid 0]` and :math:`P'_i = [H_\infty \mid e_i]`.

        All bodies share one affine frame; each has a scale of its own.  With the calibration the frame is a similarity:
        :math:`P = K_1 [I \mid 0]` and :math:`P'_i = K_2 [R \mid t_i]`.

        Returns:
            ``(*batch, 3, 4)`` and ``(*batch, c, 3, 4)``.

        Example:
            >>> import torch, dyntorch as dyn
            >>> from dyntorch import scenes
            >>> scene = scenes.translating_planes(4, generator=torch.Generator().manual_seed(0))
            >>> first, second = dyn.translating_planes(scene.homographies).cameras()
            >>> tuple(first.shape), tuple(second.shape)
            ((3, 4), (4, 3, 4))
        """
        infinity, epipoles = self.homography_at_infinity[..., None, :, :], self.epipoles
        eye = torch.eye(3, dtype=infinity.dtype, device=infinity.device).expand(self.homography_at_infinity.shape)
        translations = self.translations
        if self.calibration is not None and self.rotation is not None and translations is not None:
            eye, second = self.calibration.unbind(-3)
            infinity = (second @ self.rotation)[..., None, :, :]
            epipoles = translations @ second.mT
        first = torch.cat([eye, torch.zeros_like(eye[..., :1])], dim=-1)
        infinity = infinity.expand(*epipoles.shape, 3)
        return first, torch.cat([infinity, epipoles[..., None]], dim=-1)

    def reconstruct(self, body: int, x1: Tensor, x2: Tensor) -> Tensor:
        """Points of one body in the frame of :meth:`cameras`, from their images in both views.

        Args:
            body: index of the plane or body, from 0; the bodies come after the planes.
            x1: ``(*batch, n, 2)``.
            x2: ``(*batch, n, 2)``.

        Returns:
            ``(*batch, n, 3)``; NaN where the images do not determine the point.

        Raises:
            ValueError: no such body, shapes that do not fit.

        Example:
            >>> import torch, dyntorch as dyn
            >>> from dyntorch import scenes
            >>> scene = scenes.translating_planes(4, generator=torch.Generator().manual_seed(0))
            >>> found = dyn.translating_planes(scene.homographies)
            >>> X = found.reconstruct(0, scene.x1[0], scene.x2[0])
            >>> bool(torch.allclose(X[:, 2], found.depth(0, scene.x1[0])))
            True
        """
        self._check_body(body, self.epipoles.shape[-2])
        if x1.shape != x2.shape or x1.shape[-1:] != (2,) or x1.shape[:-2] != self.status.shape:
            batch = tuple(self.status.shape)
            raise ValueError(f"x1, x2 must be (*batch, n, 2) with batch {batch}, got {tuple(x1.shape)}, {tuple(x2.shape)}")
        first, second = self.cameras()
        cameras, views = torch.stack([first, second[..., body, :, :]], dim=-3), torch.stack([x1, x2], dim=-3)
        seen = views.isfinite().all(-1).to(views.dtype)
        frames = hartley(views.nan_to_num().unsqueeze(-2), seen)
        # the scale of a body is free: its points at a depth of order 1 keep the equations well conditioned
        moved = (views - _centre(frames)) * frames[..., 0, 0][..., None, None]
        points = triangulate(frames @ cameras.to(frames.dtype), moved.to(frames.dtype), seen, steps=STEPS)
        lost = (points == 0).all(-1, keepdim=True)
        return torch.where(lost, torch.nan, inhomogeneous(points))

    def depth(self, body: int, x1: Tensor) -> Tensor:
        r"""Depth of points of a plane, :math:`z = 1 / (n_i^T (x_1, 1))`, in units of the body's epipole.

        Args:
            body: index of the plane, from 0.
            x1: ``(*batch, n, 2)``.

        Returns:
            ``(*batch, n)``; in the affine frame of :meth:`cameras` the points are :math:`z\\,(x_1, 1)`.

        Raises:
            ValueError: no such plane.
        """
        self._check_body(body, self.normals.shape[-2])
        inverse = (homogeneous(x1) * self.normals[..., None, body, :]).sum(-1, keepdim=True)
        return 1 / finite_depth(torch.cat([torch.ones_like(inverse), inverse], dim=-1))[..., 0]

    def check(self) -> TranslatingPlanes:
        """Raise where any problem failed.

        Raises:
            ValueError: says which problems failed, how, and what to do.
        """
        check_results("translating_planes", self.status, self.warnings)
        return self

    def _check_body(self, body: int, count: int) -> None:
        if not 0 <= body < count:
            raise ValueError(f"body must be an index from 0 to {count - 1}, got {body}")

    def __repr__(self) -> str:
        states = Counter(Status(s).name for s in self.status.reshape(-1).tolist())
        planes, bodies = self.normals.shape[-2], self.epipoles.shape[-2] - self.normals.shape[-2]
        listed = ", ".join(f"{count} {name}" for name, count in states.items()) or "empty"
        lines = [f"TranslatingPlanes(planes={planes}, bodies={bodies}, batch={tuple(self.status.shape)}: {listed})"]
        good = ~failed(self.status)
        if bool(good.any()):
            middle = " (median)" if self.status.ndim else ""
            error, residual = (float(v[good].double().median()) for v in (self.uncertainty, self.residual))
            lines.append(f"  homography at infinity: relative error about {error:.2g}{middle}; residual {residual:.3g} {self.unit}")
        if self.status.ndim:
            seen = Counter(notice.code.value for notice in self.warnings)
            lines += [f"  warning {code}: {count} of {self.status.numel()} problems" for code, count in sorted(seen.items())]
        else:
            lines += [f"  warning {notice}" for notice in self.warnings]
        return "\n".join(lines)


def _centre(frames: Tensor) -> Tensor:
    """The point ``(*, 1, 2)`` that similarities ``(*, 3, 3)`` move to the origin."""
    return (-frames[..., :2, 2] / frames[..., :1, 0])[..., None, :]
