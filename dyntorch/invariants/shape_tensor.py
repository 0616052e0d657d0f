"""Shape tensors: what one image says about the shape of n points, whatever the camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.core.invariant import Invariant, on_class
from dyntorch.core.primitives import Equations
from dyntorch.geometry.homogeneous import unit_vectors
from dyntorch.invariants.reprojection import CameraKind, PointShape, looked_at, reprojection_residual
from dyntorch.shapes import static
from dyntorch.shapes.static import AFFINE, GENERAL, PLANE, canonical, dual_cameras, lines_through, local, reference_cameras

"""The camera that each frame leaves open."""


def view_score(structure: Tensor, x: Tensor, frame: str) -> Tensor:
    r"""How nearly the equations of the camera of each view are dependent, ``(*batch, views)`` in [0, 1]."""
    seen = looked_at(x).to(x)
    x = torch.cat([torch.where(seen[..., None] > 0, x[..., :2], 0.0), seen[..., None]], dim=-1)
    if frame == AFFINE:
        factor, ones = local(x)[1], torch.ones_like(structure[..., 0, 0])
        return (
            reprojection_residual(structure, x, ones, CameraKind(affine=True)).norm(dim=-1)
            * factor
            / seen.sum(-1).clamp(min=1.0).sqrt()
        )
    others = unit_vectors(structure[..., 4:, :])
    cameras = torch.stack(dual_cameras(others) if frame == GENERAL else reference_cameras(others), dim=-3)
    q = canonical(x)[0] * seen[..., :4].amin(-1)[..., None, None]
    equations = (lines_through(q) @ cameras[..., None, :, :, :]).flatten(-3, -2)
    finite = equations.isfinite().flatten(-2).all(-1)  # a shape that could not be fitted has no cameras
    values = torch.linalg.svdvals(torch.where(finite[..., None, None], equations, 0.0))
    informative = finite & ((q != 0).any(-1).sum(-1) > 1)
    return torch.where(informative, values[..., 3] / values.norm(dim=-1).clamp(min=1e-300), torch.nan)


LEAST = {GENERAL: 6, PLANE: 6, AFFINE: 5}
LARGEST = max(static.PROFILES)
"""Points of the largest multilinear form: of more, four lines and four points already fulfil all conditions."""
ROWS = dict(zip(LEAST, (static.general_rows, static.plane_rows, static.affine_rows), strict=True))


@dataclass(frozen=True, repr=False)
class ShapeTensor(PointShape):
    r"""The shape of n points from which the camera is eliminated; a match is one view of all of them.

    The arguments of :func:`dyntorch.fit` are the points, ``p1, ..., pn``, each ``(*batch, views, 2)``.  Views are of uncalibrated
    cameras, each its own; an own homography (affinity) of every view changes nothing.  Three frames:

    - ``general``: p1 to p4 are the basis, any camera, n = 6, 7 or 8.  With lines l through a point, in the frame of the basis,

      .. math:: T_{ab}\, p_5^a p_6^b = 0, \; T_a^{bc}\, p_5^a l_{6b} l_{7c} = 0, \; T^{abcd}\, l_{5a} l_{6b} l_{7c} l_{8d} = 0,

      of 9, 27, 81 coefficients; 4, 16, 58 synthetic constraints, which hold for all shapes, are fulfilled exactly.
    - ``plane``: P1 to P4 lie in a plane, any camera, n from 6 on.  Points :math:`v_i` beside the plane and the cameras
      :math:`c` of all views are found at once from :math:`p_i \times (v_i + c) = 0`.  For n = 6, 7, 8 the tensor is the
      multilinear form, a linear function of v that fulfils all 6, 21, 72 synthetic constraints; beyond it is v itself, of sum 0.
    - ``affine``: affine cameras, n from 5 on, no basis points.  The tensor is the annihilator :math:`N x = 0, N 1 = 0` of all
      coordinates x of any view, orthonormal, ``(n - 4, n)``.

    A missing point (NaN) of the basis, or of the general forms, makes its view missing; any other loses only its own rows.
    The tensor of noisy views is a start; :func:`dyntorch.refine` finds the one of least distances (8 general points, 20 views,
    1 px of noise: new views 4.5 and 2.2 px off, 2.0 by the true shape).
    The motion is the structure, homogeneous points ``(*batch, n, 4)`` in the frame of the basis (general: also P5 = (1, 1, 1, 1)),
    up to a shift and a scale of v (plane) or an affinity (affine).  :func:`dyntorch.sampson` measures a new view: the least
    distance (to first order) of its points to an image of the structure, NaN where it shows no more than its camera takes.

    Args:
        frame: ``"general"``, ``"plane"`` or ``"affine"``.
        points: n; None takes it from the arguments.

    Source: Carlsson and Weinshall 1998; Rother and Carlsson 2001; thesis sections 4 and 9.2 (72 is dim V(3, 4, 2)).

    Example:
        >>> import torch, dyntorch as dyn
        >>> draw = torch.Generator().manual_seed(0)
        >>> P = torch.randn(7, 4, generator=draw, dtype=torch.float64)
        >>> seen = P @ torch.randn(5, 4, 3, generator=draw, dtype=torch.float64)
        >>> points = (seen[..., :2] / seen[..., 2:]).unbind(-2)
        >>> solution = dyn.fit(dyn.ShapeTensor, *(p[:3] for p in points)).check()
        >>> solution
        Solution(ShapeTensor('general', 7), matches=3, batch=(): 1 OK)
        >>> bool(dyn.sampson(dyn.ShapeTensor, solution.tensor, *(p[3:] for p in points)).max() < 1e-6)
        True
    """

    frame: str = GENERAL
    points: int | None = None

    k = 3
    l = 2  # noqa: E741 - its name in the literature

    def __post_init__(self) -> None:
        if self.frame not in LEAST:
            raise ValueError(f"frame must be one of {', '.join(LEAST)}, got {self.frame!r}")
        if self.points is not None:
            self.check_points(self.points)

    def check_points(self, n: int) -> None:
        if n < LEAST[self.frame]:
            remedy = "add points" if self.frame == AFFINE else "add points, or take ShapeTensor('affine') from 5 points on"
            raise ValueError(f"frame {self.frame!r} needs at least {LEAST[self.frame]} points, got {n}; {remedy}")
        if self.frame == GENERAL and n > LARGEST:
            raise ValueError(
                f"frame 'general' takes 6, 7 or 8 points, got {n}; take eight of them, or ShapeTensor('plane') or ('affine')"
            )

    @property
    def multilinear(self) -> bool:
        """Whether the tensor is a multilinear form of the points of a view."""
        return self.frame != AFFINE and self.n <= LARGEST

    def bind_arguments(
        self, views: Sequence[Tensor], weights: Tensor | None = None, **given: Tensor
    ) -> tuple[Invariant, tuple[Tensor, ...]]:
        invariant, (x,) = super().bind_arguments(views, weights, **given)
        needed = x[..., 2] if self.frame == GENERAL else x[..., :4, 2]
        if self.frame != AFFINE:
            # a fit takes the view as missing, while the points that it shows can still be measured
            gone = (needed == 0).any(-1)[..., None, None] & (x[..., 2:] == 0)
            x = torch.cat([torch.where(gone, torch.nan, x[..., :2]), x[..., 2:]], dim=-1)
        return invariant, (x,)

    def fill_missing(self, views: tuple[Tensor, ...], weights: Tensor) -> tuple[tuple[Tensor, ...], Tensor]:
        """Affine views with their missing points filled in, which must show at least five; other frames leave out rows."""
        x = views[0]
        if self.frame != AFFINE or not len(x) or bool(((x[..., 2] > 0) | (weights <= 0)[..., None]).all()):
            return views, weights
        near, factor = static.local(x)
        filled, complete = static.complete_points(near[..., :2], x[..., 2] > 0, weights)
        back = (filled - near[..., :2]) / factor[..., None, None]
        centre = (x[..., :2] * x[..., 2:]).sum(-2, keepdim=True) / x[..., 2:].sum(-2, keepdim=True).clamp(min=1.0)
        missing = torch.where(x[..., 2:] > 0, x[..., :2], centre + back)
        return (torch.cat([missing, x[..., 2:]], dim=-1),), weights * complete

    @property
    def primitives(self) -> tuple[Equations]:  # type: ignore[override]
        m = self.n - 4
        if self.frame == GENERAL:
            width, rows = {2: (5, 1), 3: (11, 4), 4: (23, 12)}[m]
        else:
            width, rows = (3 * (m - 1), 2 * m - 3) if self.frame == PLANE else (self.n - 1, 2)
        return (Equations((self.n, 3), width, ROWS[self.frame], rows),)

    def shape(self) -> tuple[int, ...]:
        if self.frame == AFFINE:
            return (self.n,)
        return (3,) * (self.n - 4) if self.multilinear else (self.n - 4, 3)

    def tensor_of(self, basis: Tensor) -> Tensor:
        """The tensor of a null space of the estimation matrix, whose columns are the coordinates that constraints leave free."""
        device = basis.device
        if self.frame == AFFINE:
            tensor = basis @ static.centring_basis(self.n, device)
        elif self.frame == GENERAL:
            tensor = basis @ static.free(self.n, device)
        else:
            v = (basis.unflatten(-1, (-1, 3)).mT @ static.centring_basis(self.n - 4, device)).mT.flatten(-2)
            tensor = v @ static.plane_map(self.n, device).mT if self.multilinear else v
        tensor = tensor.unflatten(-1, self.shape())
        return tensor.squeeze(-1 - len(self.shape())) if self.nullity == 1 else tensor

    def basis_of(self, tensor: Tensor) -> Tensor:
        device = tensor.device
        flat = tensor.flatten(-len(self.shape()))
        if self.frame == AFFINE:
            basis = flat @ static.centring_basis(self.n, device).mT
        elif self.frame == GENERAL:
            basis = flat @ static.free(self.n, device).mT
        else:
            basis = (self._plane_points(flat).mT @ static.centring_basis(self.n - 4, device).mT).mT.flatten(-2)
        return basis.unsqueeze(-2) if self.nullity == 1 else basis

    @on_class
    def compose(self, points: Tensor) -> Tensor:
        """The tensor of known points of space.

        Args:
            points: ``(*batch, n, 3)``, or ``(*batch, n, 4)`` homogeneous.  Of a plane the fourth is moved onto that of the first
                three.

        Returns:
            ``(*batch, [n - 4,] *shape)`` of norm 1 (affine: orthonormal); zero where the basis points have no frame.

        Example:
            >>> import torch
            >>> P = torch.eye(3, dtype=torch.float64)[[0, 0, 1, 1, 2]] * torch.tensor([1, -1, 1, -1, 1])[:, None]
            >>> (ShapeTensor("affine").compose(P) * 2).abs().round(decimals=6).tolist()  # the diagonals of a square meet
            [1.0, 1.0, 1.0, 1.0, 0.0]
        """
        return self.compose_points(points)

    def compose_standard(self, points: Tensor) -> Tensor:
        if not self.multilinear:
            return super().compose_standard(points)
        cameras = (static.dual_cameras if self.frame == GENERAL else static.reference_cameras)(points[..., 4:, :])
        return static.form(cameras).unflatten(-1, self.shape())

    @on_class
    def decompose(self, tensor: Tensor) -> Tensor:
        """The points behind a tensor, homogeneous ``(*batch, n, 4)``, in the frame that it leaves open; zero for a zero tensor.

        Example:
            >>> import torch
            >>> P = torch.randn(7, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
            >>> family = ShapeTensor("general", 7)
            >>> T = family.compose(P)
            >>> bool(torch.allclose(family.compose(family.decompose(T)).abs(), T.abs()))
            True
        """
        flat = tensor.double()
        if self.frame == AFFINE:
            points = static.affine_points(flat[..., None, :] if self.nullity == 1 else flat)
        elif self.frame == GENERAL:
            points = static.general_points(flat, self.n - 4)
        else:
            points = static.plane_points(self._plane_points(flat.flatten(-len(self.shape()))))
        return points.to(tensor.dtype)

    def _plane_points(self, flat: Tensor) -> Tensor:
        """The points v ``(*batch, n - 4, 3)``, of sum 0, of flat tensors of a reference plane."""
        v = flat @ static.plane_inverse(self.n, flat.device).mT if self.multilinear else flat
        return v.unflatten(-1, (self.n - 4, 3))

    def score(self, tensor: Tensor, *points: Tensor) -> Tensor:
        r"""Algebraic score of views: how nearly the equations of the camera, given the shape, are dependent.

        :math:`\sigma_4 / \|E\|_F` of :math:`E = (l^T \hat P_i)` with two lines l through each point in the frame of the basis;
        for affine cameras the share :math:`|N x| / |x|` of the centred coordinates.  It is no distance (see
        :func:`dyntorch.sampson`), but takes no resection.

        Args:
            tensor: ``(*batch, ...)`` as fitted.
            *points: p1, ..., pn, ``(*batch, views, 2)``.

        Returns:
            ``(*batch, views)`` in [0, 1], 0 for a view of the shape; NaN where the view says nothing.

        Example:
            >>> import torch
            >>> draw = torch.Generator().manual_seed(0)
            >>> P, A = (torch.randn(*size, generator=draw, dtype=torch.float64) for size in ((6, 3), (3, 2)))
            >>> view = (P @ A)[:, None]
            >>> family = ShapeTensor("affine")
            >>> bool(family.score(family.compose(P), *view) < 1e-12), bool(family.score(family.compose(P), *view.flip(0)) > 0.1)
            (True, True)
        """
        invariant, (x,) = self.bind_arguments(points)
        assert isinstance(invariant, ShapeTensor)
        structure = static.standard(invariant.decompose(tensor.double()), self.frame)
        return view_score(structure, x.double(), self.frame).to(x.dtype)

    def __repr__(self) -> str:
        return f"ShapeTensor({self.frame!r}{'' if self.points is None else f', {self.points}'})"
