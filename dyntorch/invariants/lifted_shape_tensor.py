"""Lifted shape tensors: what one image P^k -> P^l says about the shape of n points of P^k, whatever the projection."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from dyntorch.core.primitives import Equations
from dyntorch.invariants.reprojection import PointShape, looked_at
from dyntorch.shapes import lifted, static
from dyntorch.shapes.lifted import Profile
from dyntorch.shapes.static import AFFINE, GENERAL, PLANE

FRAMES = (GENERAL, PLANE, AFFINE)


@dataclass(frozen=True, repr=False)
class LiftedShapeTensor(PointShape):
    r"""The shape of n points of :math:`P^k` from which projections :math:`P^k \to P^l` are eliminated; a match is one view.

    What :class:`~dyntorch.GrassmannTensor` is for points seen by given projections this is for projections of given points: its
    dual.  ``LiftedShapeTensor(3, 2)`` is :class:`~dyntorch.ShapeTensor`.  Points of constant velocity in space are static in
    :math:`P^6`: ``LiftedShapeTensor(6)`` knows them at all times and before all cameras, times unknown, from 63 views of twelve
    points (105 of eleven).  Points of constant velocity in a plane are degenerate for :math:`P^4`: their cameras are too special.
    The arguments of :func:`dyntorch.fit` are the points, ``p1, ..., pn``, each ``(*batch, views, l)``.

    - ``general``: any projections, n from :math:`\lceil (k + 1)(l + 1) / l \rceil` to 2 k + 2.  The first k + 1 points are the
      basis, B their images.  With :math:`\alpha_j` hyperplanes :math:`S_j` through further point j, :math:`\sum \alpha_j = k + 1`
      as even as can be,

      .. math:: \det(S_1 B\,\mathrm{diag}(X_1); \dots; S_m B\,\mathrm{diag}(X_m))
                = \sum_{(I_1, \dots, I_m)} \pm \prod_j \det (S_j B)_{I_j} \; T_{I_1 \dots I_m} = 0, \qquad
                T_{I_1 \dots I_m} = \prod_j \prod_{i \in I_j} X_{ji},

      over all ordered partitions of the basis.  Synthetic constraints, which every view of every shape fulfils, leave
      :math:`\sum_\lambda K_{\lambda' \alpha} f^\lambda` of the coefficients, over diagrams of k + 1 boxes in up to l + 1 rows.
    - ``plane``: k = l + 1, and the first l + 2 points lie in a hyperplane; n from l + 4 on.  The tensor is where the others are
      beside it, v of sum 0, ``(n - l - 2, l + 1)``: with the frame of these l + 2 in every view :math:`p_j \times (v_j + c) = 0`.
    - ``affine``: affine projections, n from k + 2 on; the tensor is the annihilator of all coordinates, ``(n - k - 1, n)``.

    =========  ========================================================================================
    k, l       n: unknowns, fewest views of the frame ``general``
    =========  ========================================================================================
    2, 1       6: 5, 4
    3, 2       6: 5, 4;     7: 11, 3;    8: 23, 2
    4, 2       8: 21, 10;   9: 47, 6;    10: 103, 4
    5, 2       9: 42, 41;   10: 98, 25;  11: 225, 14;  12: 513, 10
    6, 2       11: 210, 105;  12: 498, 63
    6, 3       10: 140, 16; 11: 496, 8
    =========  ========================================================================================

    A missing point (NaN) makes its view missing in a fit; :func:`dyntorch.sampson` measures the points that there are.
    The motion is the structure, homogeneous points ``(*batch, n, k + 1)``: the first k + 1 are the basis, the next one is
    (1, ..., 1) (``general``); see :class:`~dyntorch.ShapeTensor` for the others.

    Args:
        k: dimension of the space of the points.
        l: dimension of the views.
        frame: ``"general"``, ``"plane"`` or ``"affine"``.
        points: n; None takes it from the arguments.

    Raises:
        ValueError: dimensions or numbers of points for which there is no such tensor.

    Source: thesis chapter 4 ("any kind of projection matrix") and section 9.2; Carlsson and Weinshall 1998; Hartley and
    Schaffalitzky 2004, whose tensor is the dual; the widths by Schur and Weyl's duality.

    Example:
        >>> import torch, dyntorch as dyn
        >>> draw = torch.Generator().manual_seed(0)
        >>> Y = torch.randn(9, 5, generator=draw, dtype=torch.float64)
        >>> seen = Y @ torch.randn(9, 5, 3, generator=draw, dtype=torch.float64)
        >>> points = (seen[..., :2] / seen[..., 2:]).unbind(-2)
        >>> solution = dyn.fit(dyn.LiftedShapeTensor(4), *(p[:6] for p in points)).check()
        >>> solution
        Solution(LiftedShapeTensor(4, points=9), matches=6, batch=(): 1 OK)
        >>> bool(dyn.sampson(solution.invariant, solution.tensor, *(p[6:] for p in points)).max() < 1e-6)
        True
    """

    k: int
    l: int = 2  # noqa: E741 - its name in the literature
    frame: str = GENERAL
    points: int | None = None

    def __post_init__(self) -> None:
        if self.frame not in FRAMES:
            raise ValueError(f"frame must be one of {', '.join(FRAMES)}, got {self.frame!r}")
        if not 1 <= self.l < self.k:
            raise ValueError(f"projections lower the dimension: l must be 1 to k - 1, got k = {self.k}, l = {self.l}")
        if self.frame == PLANE and self.k != self.l + 1:
            raise ValueError(
                f"frame 'plane' takes k = l + 1, where a view fixes its camera up to one point, got k = {self.k}, l = {self.l}; "
                "use 'general' or 'affine'"
            )
        if self.points is not None:
            self.check_points(self.points)

    @property
    def min_points(self) -> int:
        """Fewest points of which a view says anything."""
        general = -(-(self.k + 1) * (self.l + 1) // self.l)
        beside = max(2, -(-(self.l + 2) // self.l))
        return {GENERAL: general, PLANE: self.l + 2 + beside, AFFINE: self.k + 2}[self.frame]

    def check_points(self, n: int) -> None:
        if n < self.min_points:
            raise ValueError(f"{self._name()} needs at least {self.min_points} points, got {n}; add points")
        if self.frame == GENERAL and n > 2 * self.k + 2:
            raise ValueError(f"{self._name()} takes up to {2 * self.k + 2} points, got {n}; take as many of them")

    @property
    def profile(self) -> Profile:
        """Hyperplanes through each point behind the basis (``general``)."""
        return lifted.profile_of(self.k, self.n - self.k - 1)

    def fill_missing(self, views: tuple[Tensor, ...], weights: Tensor) -> tuple[tuple[Tensor, ...], Tensor]:
        """Views that miss a point have no part in a fit, while the points that they show can still be measured."""
        return views, weights * looked_at(views[0]).all(-1)

    @property
    def primitives(self) -> tuple[Equations]:  # type: ignore[override]
        n, size = self.n, self.l + 1
        if self.frame == GENERAL:
            width = len(lifted.free(self.k, self.l, self.profile, torch.device("cpu")))
            rows, make = lifted.count_rows(self.k, self.l, self.profile)[0], partial(lifted.view_rows, profile=self.profile)
        elif self.frame == PLANE:
            m = n - size - 1
            width, rows, make = size * (m - 1), self.l * m - size, lifted.plane_rows  # type: ignore[assignment]
        else:
            width, rows, make = n - 1, self.l, static.affine_rows  # type: ignore[assignment]
        return (Equations((n, size), width, make, rows),)

    def minimal(self) -> int:
        """Fewest views that determine the tensor: in the frame ``general`` by the rank of views of a random shape."""
        if self.frame == GENERAL:
            return lifted.count_rows(self.k, self.l, self.profile)[1]
        return -(-(self.width() - self.nullity) // self.rows())

    def shape(self) -> tuple[int, ...]:
        if self.frame == AFFINE:
            return (self.n,)
        if self.frame == PLANE:
            return (self.n - self.l - 2, self.l + 1)
        return (lifted.partitions(self.k, self.profile, torch.device("cpu"))[0].shape[1],)

    def _free(self, device: torch.device) -> Tensor:
        """Orthonormal basis of what the estimation matrix says of a flat tensor."""
        if self.frame == AFFINE:
            return static.centring_basis(self.n, device)
        return lifted.free(self.k, self.l, self.profile, device)

    def tensor_of(self, basis: Tensor) -> Tensor:
        """The tensor of a null space of the estimation matrix, whose columns are the coordinates that constraints leave free."""
        if self.frame == PLANE:
            v = basis.unflatten(-1, (-1, self.l + 1))
            tensor = (v.mT @ static.centring_basis(v.shape[-2] + 1, basis.device)).mT
            return tensor[..., 0, :, :]
        tensor = basis @ self._free(basis.device)
        return tensor[..., 0, :] if self.nullity == 1 else tensor

    def basis_of(self, tensor: Tensor) -> Tensor:
        if self.frame == PLANE:
            return (tensor.mT @ static.centring_basis(tensor.shape[-2], tensor.device).mT).mT.flatten(-2)[..., None, :]
        basis = tensor @ self._free(tensor.device).mT
        return basis[..., None, :] if self.nullity == 1 else basis

    def compose(self, points: Tensor) -> Tensor:
        """The tensor of known points.

        Args:
            points: ``(*batch, n, k)``, or ``(*batch, n, k + 1)`` homogeneous.  Of a plane point l + 2 is moved onto that of the
                first l + 1.

        Returns:
            ``(*batch, [n - k - 1,] *shape)`` of norm 1 (affine: orthonormal); zero where the basis points have no frame.

        Example:
            >>> import torch
            >>> P = torch.randn(8, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
            >>> T = LiftedShapeTensor(4).compose(P)
            >>> T.shape, bool(torch.allclose(T, LiftedShapeTensor(4).compose(2 * P)))  # homogeneous: the scale means nothing
            (torch.Size([30]), True)
        """
        return self.compose_points(points)

    def compose_standard(self, points: Tensor) -> Tensor:
        if self.frame != GENERAL:
            return super().compose_standard(points)
        # the scale of each point is that of the tensor
        others = points[..., self.k + 1 :, :]
        size = others.abs().amax(-1, keepdim=True)
        tensor = lifted.compose_entries(others / torch.where(size > 0, size, 1.0), self.profile)
        # what no view tells is left out: tensors of one shape are then equal
        return self.tensor_of(self.basis_of(tensor))

    def decompose(self, tensor: Tensor) -> Tensor:
        """The points behind a tensor, homogeneous ``(*batch, n, k + 1)``, in the frame that it leaves open; zero for a zero tensor.

        In closed form for the tensor of a shape; of a noisy one the nearest Grassmann tensor is found first.

        Example:
            >>> import torch
            >>> P = torch.randn(9, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
            >>> family = LiftedShapeTensor(4, points=9)
            >>> T = family.compose(P)
            >>> bool(torch.allclose(family.compose(family.decompose(T)).abs(), T.abs()))
            True
        """
        double = tensor.double()
        if self.frame == AFFINE:
            points = static.affine_points(double[..., None, :] if self.nullity == 1 else double, self.k)
        elif self.frame == GENERAL:
            points = lifted.points_of(double, self.k, self.l, self.profile)
        else:
            points = static.plane_points(double)
        return points.to(tensor.dtype)

    def multilinear(self, tensor: Tensor, basis: Tensor) -> Tensor:
        r"""The form of the points behind the basis, for given images of it (``general``).

        Args:
            tensor: ``(*batch, *shape)``.
            basis: ``(k + 1, l + 1)`` homogeneous images of the first k + 1 points.

        Returns:
            ``(*batch, binomial(l + 1, alpha_1), ...)``, the :class:`~dyntorch.GrassmannTensor` of the dual projections
            :math:`B\,\mathrm{diag}(X_j)`; for k = 3, l = 2 and the basis :math:`e_1, e_2, e_3, (1, 1, 1)` that of
            :class:`~dyntorch.ShapeTensor` (with the lines of its two-line slots in the place of their meets).
        """
        if self.frame != GENERAL or basis.shape != (self.k + 1, self.l + 1):
            raise ValueError(
                f"frame 'general' and a basis ({self.k + 1}, {self.l + 1}) have a form, got {self!r}, {tuple(basis.shape)}"
            )
        return lifted.multilinear(tensor.double(), basis.double(), self.profile).to(tensor.dtype)

    def score(self, tensor: Tensor, *points: Tensor) -> Tensor:
        r"""Algebraic score of views: how nearly the equations of the camera, given the shape, are dependent.

        :math:`\sigma_{\min} / \|E\|_F` of the incidences :math:`E = (S_i\,M X_i)` of unit hyperplanes, linear in the entries of the
        camera M, over all points.  It is no distance (see :func:`dyntorch.sampson`).

        Args:
            tensor: ``(*batch, ...)`` as fitted.
            *points: p1, ..., pn, ``(*batch, views, l)``.

        Returns:
            ``(*batch, views)`` in [0, 1], 0 for a view of the shape; NaN where the view says nothing.
        """
        invariant, (x,) = self.bind_arguments(points)
        assert isinstance(invariant, LiftedShapeTensor)
        structure = static.standard(invariant.decompose(tensor.double()), self.frame)
        return lifted.camera_score(structure, x.double(), self.cameras.freedom, self.frame == AFFINE).to(x.dtype)

    def _name(self) -> str:
        dims = f"{self.k}" if self.l == 2 else f"{self.k}, {self.l}"
        return f"LiftedShapeTensor({dims}{'' if self.frame == GENERAL else f', frame={self.frame!r}'})"

    def __repr__(self) -> str:
        return self._name() if self.points is None else f"{self._name()[:-1]}, points={self.points})"
