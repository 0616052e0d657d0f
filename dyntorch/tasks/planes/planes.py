"""translating_planes(): the homography at infinity of planes and bodies that translate independently, and every body's motion."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from dyntorch.core.fit import fit
from dyntorch.core.normalize import hartley
from dyntorch.core.outcome import Outcome, Status, is_failure
from dyntorch.geometry.homogeneous import (
    finite_depth,
    homogeneous,
    inhomogeneous,
    nonzero_sign,
    skew,
    two_sided,
    unit,
    unit_vectors,
)
from dyntorch.geometry.rigid import nearest_rotation
from dyntorch.geometry.triangulation import triangulate
from dyntorch.invariants.collineation import Collineation
from dyntorch.invariants.fundamental_matrix import FundamentalMatrix
from dyntorch.numerics.arguments import check_options
from dyntorch.numerics.blocks import map_blocks, one_thread
from dyntorch.tasks.planes.input import GivenPlanes, Pair, Points, both, cameras, check_counts, enough, pad_matches
from dyntorch.tasks.planes.notices import (
    MAX_NEAR_ZERO,
    ROUNDING_ERROR,
    Figures,
    PlanesNotice,
    misfit,
    planes_notices,
    rotation_distance,
)
from dyntorch.tasks.planes.problem import Layout, PlaneMatches, PlanesOptions, noise_variance, project_covariance, solve

# ----------------------------------------------------------------------------------------------------------------------
# What translating_planes() returns: the homography at infinity, how every body moved, and its reconstruction.


STEPS = 5  # of Gauss and Newton on the reprojection error of a point


MAX_STATIC_DEVIATIONS = 3.0  # within which a plane does not move


@dataclass(frozen=True, eq=False, repr=False)
class TranslatingPlanes(Outcome):
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
        rotation: ``(*batch, 3, 3)`` camera 1 to camera 2, where the calibration was given.
        calibration: ``(*batch, 2, 3, 3)`` of both cameras, where it was given.
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
    rotation: Tensor | None = None
    calibration: Tensor | None = None
    unit: str = "relative"

    TASK = "translating_planes"

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
        moved = views * frames[..., 0, 0][..., None, None] + frames[..., None, :2, 2]
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

    def _check_body(self, body: int, count: int) -> None:
        if not 0 <= body < count:
            raise ValueError(f"body must be an index from 0 to {count - 1}, got {body}")

    def __repr__(self) -> str:
        planes, bodies = self.normals.shape[-2], self.epipoles.shape[-2] - self.normals.shape[-2]
        lines = [self.head(planes=planes, bodies=bodies)]
        good = ~is_failure(self.status)
        if bool(good.any()):
            middle = " (median)" if self.status.ndim else ""
            error, residual = (float(v[good].double().median()) for v in (self.uncertainty, self.residual))
            lines.append(f"  homography at infinity: relative error about {error:.2g}{middle}; residual {residual:.3g} {self.unit}")
        return "\n".join(lines + self.warning_lines())


# ----------------------------------------------------------------------------------------------------------------------
# From the parameters of the fit of translating planes to what the caller gets.


def outcome(given: GivenPlanes, found: tuple[Tensor, ...], method: str, refined: bool, options: PlanesOptions) -> TranslatingPlanes:
    """The result with a flat batch."""
    theta, cost, covariance, undetermined, other, separate = found
    layout = Layout(given.homographies.shape[1], given.fundamentals.shape[1])
    used = given.present()
    planes, bodies = used[:, : layout.planes].sum(-1), used[:, layout.planes :].sum(-1)
    rows, spare = given.rows()
    covariance = noise_variance(cost, spare, options.risk)[:, None, None] * covariance
    figures = _figures(layout, theta, covariance, used)
    against = misfit(given, cost, separate)
    # what one homography at infinity leaves beyond the noise is an error as well
    covariance = against.excess[:, None, None] * covariance
    uncertainty = project_covariance(covariance[:, :9, :9], theta[:, :9]).diagonal(dim1=-2, dim2=-1).sum(-1).sqrt()
    right = enough(planes, bodies, method)
    several = figures.several()
    # what moves alike, or not at all, differs by noise alone
    told = ~several & ~undetermined & right & refined
    vague = against.vague & told
    apart = (against.apart & told) | vague
    chance = against.chance & told & ~apart
    status = torch.where((uncertainty > options.max_error) | other | several | chance, Status.AMBIGUOUS, Status.OK)
    status = torch.where(apart, Status.NO_CONSENSUS, status)
    status = torch.where(undetermined, Status.DEGENERATE, status)
    status = torch.where(right, status, Status.TOO_FEW)
    distance, bent = rotation_distance(given, theta[:, :9], covariance[:, :9, :9], status)
    said = {
        PlanesNotice.NO_COMMON_INFINITY: (against.ratio, apart & ~vague),
        PlanesNotice.CHANCE: (against.ratio, chance),
        PlanesNotice.INCOHERENT: (against.vagueness, vague),
        PlanesNotice.CALIBRATION: (distance, bent),
        PlanesNotice.UNCERTAIN: (uncertainty, (uncertainty > options.max_error) & right & ~apart),
        PlanesNotice.OTHER_SOLUTION: (used.sum(-1), (other | several) & right & ~apart),
    }
    limits = planes_notices(figures, right, said, given)
    there = (~is_failure(status)).to(theta.dtype)
    infinity, epipoles, normals = _to_pixels(given, layout, theta)
    infinity = infinity * there[:, None, None]
    mask = (used & there.bool()[:, None]).to(theta.dtype)[..., None]
    epipoles, normals = epipoles * mask, normals * mask[:, : layout.planes]
    models = infinity[:, None] + epipoles[:, : layout.planes, :, None] * normals[..., None, :]
    size = models.square().sum((-2, -1))
    scales = (models * given.measured).sum((-2, -1)) / torch.where(size > 0, size, 1.0)
    rotation = None
    if given.calibration is not None:
        first, second = given.calibration.unbind(1)
        rotation = nearest_rotation(torch.linalg.inv_ex(second)[0] @ infinity @ first)
    return TranslatingPlanes(
        homography_at_infinity=infinity,
        epipoles=epipoles,
        fundamentals=unit(skew(epipoles) @ infinity[:, None]),
        normals=normals,
        scales=scales * mask[:, : layout.planes, 0],
        used=used,
        residual=(cost / rows.clamp(min=1)).sqrt() * there,
        covariance=_mask_missing(_transform_covariance(covariance[:, :9, :9], theta[:, :9], given.frames), there),
        uncertainty=_mask_missing(uncertainty, there),
        status=status,
        rotation=rotation,
        calibration=given.calibration,
        notices=limits,
        unit="px" if given.matched else "relative",
    )


def _figures(layout: Layout, theta: Tensor, covariance: Tensor, used: Tensor) -> Figures:
    """Directions of epipoles and normals with their covariances, and which planes move."""
    infinity, epipoles, planes = layout.unpack(theta)
    p = layout.planes
    at = 9 + 3 * torch.arange(p + layout.bodies, device=theta.device)[:, None] + torch.arange(3, device=theta.device)
    of_epipoles = covariance[:, at[:, :, None], at[:, None, :]]
    at = layout.shared_size + 4 * torch.arange(p, device=theta.device)[:, None] + torch.arange(3, device=theta.device)
    of_normals = covariance[:, at[:, :, None], at[:, None, :]]
    e, n, d = epipoles[:, :p], planes[..., :3], planes[..., 3].abs()
    size = torch.linalg.matrix_norm(infinity)[:, None] * d
    # of e n^T, to first order
    spread = (
        of_normals.diagonal(dim1=-2, dim2=-1).sum(-1) * e.square().sum(-1)
        + of_epipoles[:, :p].diagonal(dim1=-2, dim2=-1).sum(-1) * n.square().sum(-1)
    ).sqrt()
    length = e.norm(dim=-1) * n.norm(dim=-1)
    near = (length <= MAX_NEAR_ZERO * size) & (length <= MAX_STATIC_DEVIATIONS * spread)
    still = (length <= ROUNDING_ERROR * size) | near
    moving = torch.cat([used[:, :p] & ~still, used[:, p:]], dim=1)
    return Figures(
        epipoles=unit_vectors(epipoles),
        epipole_covariance=project_covariance(of_epipoles, epipoles),
        normals=unit_vectors(n),
        normal_covariance=project_covariance(of_normals, n),
        moving=moving,
        used=used,
    )


def _to_pixels(given: GivenPlanes, layout: Layout, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Homography at infinity of norm 1, unit epipoles and normals in measured coordinates."""
    infinity, epipoles, planes = layout.unpack(theta)
    first, back = given.frames[0], torch.linalg.inv_ex(given.frames[1])[0]
    moved = back @ infinity @ first
    found = unit(moved)
    size = (moved * found).sum((-2, -1))
    e = epipoles @ back.mT
    length = e.norm(dim=-1)
    depth = planes[..., 3]
    tiny = torch.finfo(depth.dtype).tiny
    depth = torch.where(depth == 0, tiny, depth)
    normals = planes[..., :3] @ first * (length[:, : layout.planes] / (depth * size[:, None]))[..., None]
    # points of a plane are in front of the camera: its matches, or without them the middle of the image
    points, weights = given.planes.views[0], given.planes.weights
    if not given.matched:
        points, weights = torch.zeros_like(planes[..., None, :2]), torch.ones_like(planes[..., :1])
    inverse = (homogeneous(points) @ planes[..., :3, None])[..., 0] / depth[..., None] / size[:, None, None]
    sign = nonzero_sign((inverse.sign() * weights).sum(-1))[..., None]
    e = unit_vectors(e)
    bodies = unit(e[:, layout.planes :, :, None])[..., 0]
    return found, torch.cat([e[:, : layout.planes] * sign, bodies], dim=1), normals * sign


def _mask_missing(value: Tensor, there: Tensor) -> Tensor:
    """Zero where there is no result, infinite where a number of it is beyond the range."""
    wide = (..., *[None] * (value.ndim - 1))
    finite = value.isfinite().flatten(1).all(-1) if value.ndim > 1 else value.isfinite()
    return torch.where(there.bool()[wide], torch.where(finite[wide], value, torch.inf), 0.0)


def _transform_covariance(covariance: Tensor, entries: Tensor, frames: tuple[Tensor, Tensor]) -> Tensor:
    """Covariance ``(b, 9, 9)`` of the entries of the homography at infinity in measured coordinates, at norm 1."""
    back = torch.linalg.inv_ex(frames[1])[0]
    lift = two_sided(back, frames[0])
    return project_covariance(lift @ covariance @ lift.mT, (lift @ entries[..., None])[..., 0])


BLOCK = 1 << 21
"""Numbers in the derivatives of one block of problems."""
STARTS_PER_BLOCK = 4
"""Starts that a problem has, about: the size of a block stands on it, nothing else."""


@one_thread
def translating_planes(
    H: Tensor | None = None,
    *,
    fundamentals: Tensor | None = None,
    x1: Points | None = None,
    x2: Points | None = None,
    body_matches: tuple[Points, Points] | None = None,
    method: str = "auto",
    refine: bool = True,
    calibration: Tensor | tuple[Tensor, Tensor] | None = None,
    options: PlanesOptions | None = None,
) -> TranslatingPlanes:
    r"""The homography at infinity from planes that translate independently, seen in two views.

    The cameras move, every body translates as it likes, and none rotates against the others.  A plane of body i, and a body k
    with depth, then have

    .. math:: H_i = \lambda_i (H_\infty + e_i n_i^T), \qquad F_k = [e_k]_\times H_\infty,

    with the homography at infinity common to all.  Three planes, two planes and a body, or two bodies determine it.  It gives
    every body's epipole and fundamental matrix, and reconstructs all bodies in one affine frame, each at a scale of its own.

    Closed forms start it (see ``method``); each start is refined by least squares on the matrices, then, where matches are given,
    on the Sampson distances of all of them, and the best is kept.  With matches the error is a third to a half of that without.

    Args:
        H: ``(*batch, p, 3, 3)`` homographies of the planes, view 1 to view 2, each of any scale; NaN = missing.  Those of OpenCV
            go in as ``torch.as_tensor(numpy.stack(list_of_H))``.  None fits them to the matches, or means no planes.
        fundamentals: ``(*batch, m, 3, 3)`` of bodies with depth, :math:`x_2^T F x_1 = 0`; None fits them to ``body_matches``.  One
            of them is worth many planes.
        x1: matches of every plane in view 1, ``(*batch, p, n, 2)``, NaN = missing, or p tensors ``(*batch, n_i, 2)``; pixels.
        x2: the same points in view 2.
        body_matches: two views of the matches of the bodies, in the same forms.
        method: the start: ``"linear"`` (extensors with 64 unknowns, 4 planes), ``"closed_form"`` (3 planes), ``"thesis"``
            (extensors with 84 unknowns, 5 planes), ``"mixed"`` (2 planes and a body), ``"fundamentals"`` (2 bodies); ``"auto"``
            tries all but the thesis's.
        refine: False returns the start as it is.
        calibration: K ``(3, 3)`` or ``(*batch, 3, 3)``, or a pair of them for the two views, upgrades the affine frame to a
            similarity: :math:`H_\infty \sim K_2 R K_1^{-1}`.
        options: what the fit takes and risks; None is :class:`dyntorch.PlanesOptions` as it is.

    Returns:
        A :class:`~dyntorch.tasks.planes.planes.TranslatingPlanes`.

    Raises:
        ValueError: too few planes and bodies, shapes that do not fit each other, an unknown method, matches of the planes
            without those of the bodies.

    Source: thesis chapter 5; Wolf and Shashua, ICCV 2001; the linear system of 64 unknowns and the closed forms are derived here.

    Example:
        >>> import torch, dyntorch as dyn
        >>> from dyntorch import scenes
        >>> scene = scenes.translating_planes(4, generator=torch.Generator().manual_seed(0))
        >>> found = dyn.translating_planes(scene.homographies)
        >>> bool(torch.allclose(found.homography_at_infinity, scene.infinity, atol=1e-6))
        True
        >>> print(repr(found).splitlines()[0])
        TranslatingPlanes(planes=4, bodies=0, batch=(): 1 OK)
    """
    options = PlanesOptions() if options is None else options
    check_options(options, PlanesOptions)
    planes = _views(x1, x2)
    bodies = None if body_matches is None else pad_matches("body_matches", body_matches)
    if H is None and planes is not None:
        H = fit(Collineation(2), planes[1], planes[0]).tensor
    if fundamentals is None and bodies is not None:
        fundamentals = fit(FundamentalMatrix, *bodies).tensor
    H, F = both(H, fundamentals)
    check_counts(H.shape[-3], F.shape[-3], method)
    if (planes is None and bodies is not None and H.shape[-3]) or (planes is not None and bodies is None and F.shape[-3]):
        raise ValueError("matches are given of the planes or of the bodies only: give both x1, x2 and body_matches, or neither")
    camera = None if calibration is None else cameras(calibration, tuple(H.shape[:-3]), H)
    with torch.no_grad():
        given = GivenPlanes.of(H, F, planes, bodies, camera)
        result = outcome(given, _solve_blocks(given, method, refine, options), method, refine, options)
        shaped: dict[str, Any] = {name: given.back(value) for name, value in vars(result).items() if isinstance(value, Tensor)}
    return replace(result, **shaped)


def _views(x1: Points | None, x2: Points | None) -> Pair | None:
    if x1 is None and x2 is None:
        return None
    if x1 is None or x2 is None:
        raise ValueError(f"x1 and x2 belong together, got only {'x2' if x1 is None else 'x1'}: give both views, or neither")
    return pad_matches("x1 and x2", (x1, x2))


def _solve_blocks(given: GivenPlanes, method: str, refine: bool, options: PlanesOptions) -> tuple[Tensor, ...]:
    """What :func:`~dyntorch.tasks.planes.problem.solve` says, block by block, and the cost under the given matrices."""
    seen, body = given.planes, given.bodies
    layout = Layout(given.homographies.shape[1], given.fundamentals.shape[1])

    matches: PlaneMatches | None = None
    if given.matched:
        first, second = (frame[:, 0, 0] for frame in given.frames)
        matches = PlaneMatches(seen.views, seen.weights, body.views, body.weights, (first, second))

    def block(h: Tensor, f: Tensor, spare: Tensor, matches: PlaneMatches | None) -> tuple[Tensor, ...]:
        separate = spare * 0 if matches is None else matches.normal(torch.cat([h, f], dim=1)).cost.nansum(1)
        return *solve(h, f, matches, spare, method, refine, options), separate

    numbers = 18 * seen.weights.shape[1] * seen.weights.shape[2] + layout.size * (9 * (layout.planes + layout.bodies) + layout.size)
    size = max(1, BLOCK // (STARTS_PER_BLOCK * numbers))
    return map_blocks(block, given.homographies, given.fundamentals, given.rows()[1], matches, size=size)
