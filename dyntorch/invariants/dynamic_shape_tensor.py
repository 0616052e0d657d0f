"""Dynamic shape tensors: what single affine views of a moving shape have in common, whatever the cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal

import torch
from torch import Tensor

from dyntorch.core.invariant import Estimate, Frame, Invariant, on_class, unknown_argument
from dyntorch.core.matches import constellations, option
from dyntorch.core.outcome import Status
from dyntorch.core.primitives import Equations
from dyntorch.invariants.reprojection import CameraKind, reprojection_derivative, reprojection_residual
from dyntorch.numerics.blocks import constant, select
from dyntorch.numerics.nullspace import null_space
from dyntorch.shapes.basis import Polynomial, Trajectory, extremes, times_of_views
from dyntorch.shapes.moving import (
    MAX_UNCERTAINTY,
    ProjectedShapes,
    canonical_frame,
    centred_views,
    fit_shapes,
    followed_shapes,
    project,
    shapes_at,
    shapes_through,
    slopes,
)
from dyntorch.shapes.projective import fit_perspective_shapes, gauge, recover_perspective_times
from dyntorch.shapes.static import centring_basis, general_rows
from dyntorch.shapes.times import Recovery, recover_times

# ----------------------------------------------------------------------------------------------------------------------
# Rows of moving shapes: what one affine view of n points at a known time says, linear in the unknowns.


Base = tuple[int, int, int, int]


@constant
def basis_points_first(n: int, base: Base, device: torch.device) -> Tensor:
    """Indices of the four basis points, then of all others in order."""
    return torch.tensor([*base, *(i for i in range(n) if i not in base)], device=device)


def graph_rows(measured: Tensor, trajectory: Trajectory, base: Base) -> Tensor:
    r"""Rows of :math:`D(t) x_j = \sum_{i=1}^4 N_{ij}(t) x_i` with :math:`\sum_i N_{ij} = D` eliminated. measured
    ``(*batch, views, n, 4)`` -> ``(*batch, views, 2 (n - 4), K (1 + 3 (n - 4)))``."""
    n = measured.shape[-2]
    order = basis_points_first(n, base, measured.device)
    seen = measured[..., order, 2] > 0
    points = centred_views(measured[..., :2], measured[..., 2]).x[..., order, :]
    use = (seen[..., 4:] & seen[..., :4].all(-1, keepdim=True)).to(points.dtype)[..., None]
    y = points[..., :3, :] - points[..., 3:4, :]
    z = (points[..., 4:, :] - points[..., 3:4, :]) * use
    powers = trajectory.power(3).rows(measured[..., 0, 3])  # (.., K)
    first = z[..., None] * powers[..., None, None, :]  # (.., m, 2, K)
    own = torch.eye(n - 4, dtype=z.dtype, device=z.device)[:, None, :, None, None] * use[..., None, None, None]
    rest = -y.mT[..., None, :, None, :, None] * powers[..., None, None, None, None, :]  # (.., 1, 2, 1, 3, K)
    return torch.cat([first, (own * rest).flatten(-3)], dim=-1).flatten(-3, -2)


def span_rows(measured: Tensor) -> Tensor:
    """The two centred coordinates of each view, ``(*batch, views, 2, n - 1)``; 0 where a point is missing."""
    n = measured.shape[-2]
    complete = (measured[..., 2] > 0).all(-1)[..., None, None]
    return torch.where(complete, centred_views(measured[..., :2]).x.mT @ centring_basis(n, measured.device).mT, 0.0)


def span_residual(measured: Tensor, basis: Tensor) -> Tensor:
    """Part of the energy of each view ``(*batch, views, n, 3)`` in the directions ``basis (*batch, k, n - 1)``; 1 for no view."""
    rows = span_rows(measured)
    energy = rows.square().sum((-2, -1))
    left = (rows @ basis.mT[..., None, :, :]).square().sum((-2, -1))
    return torch.where(energy > 0, left / torch.where(energy > 0, energy, 1.0), 1.0)


def annihilator(unknowns: Tensor, n: int, base: Base) -> Tensor:
    r"""The polynomial matrix N(t) with :math:`N(t)^T x = 0` and :math:`N(t)^T 1 = 0`. unknowns ``(*batch, K (1 + 3 m))`` ->
    ``(*batch, K, n, m)``."""
    m = n - 4
    scale, slopes = _split(unknowns, m)
    size = scale.shape[-1]
    eye = torch.eye(m, dtype=unknowns.dtype, device=unknowns.device)
    above = slopes.movedim(-1, -3).mT  # (.., K, 3, m)
    fourth = scale[..., None, None] - above.sum(-2, keepdim=True)
    matrix = torch.cat([above, fourth, -scale[..., None, None] * eye], dim=-2)
    order = basis_points_first(n, base, unknowns.device).argsort()
    return matrix[..., order, :].reshape(*unknowns.shape[:-1], size, n, m)


def unknowns_of(matrix: Tensor, base: Base) -> Tensor:
    """The inverse of :func:`annihilator`."""
    n = matrix.shape[-2]
    ordered = matrix[..., basis_points_first(n, base, matrix.device), :]
    scale = -ordered[..., 4:, :].diagonal(dim1=-2, dim2=-1).mean(-1)
    return torch.cat([scale, ordered[..., :3, :].mT.movedim(-3, -1).flatten(-3)], dim=-1)


def _split(unknowns: Tensor, m: int) -> tuple[Tensor, Tensor]:
    """D ``(*batch, K)`` and N ``(*batch, m, 3, K)``."""
    size = unknowns.shape[-1] // (1 + 3 * m)
    return unknowns[..., :size], unknowns[..., size:].unflatten(-1, (m, 3, size))


def graph_of(shapes: Tensor, trajectory: Trajectory, base: Base) -> Tensor:
    """The unknowns ``(*batch, K (1 + 3 m))`` of :func:`graph_rows`, of any scale, of shapes ``(*batch, B, n, 3)``: brackets."""
    n = shapes.shape[-2]
    rows, inverse = _samples(trajectory, shapes.device)
    every = torch.einsum("gb,...bnk->...gnk", rows, shapes)[..., basis_points_first(n, base, shapes.device), :]
    y, z = every[..., :3, :] - every[..., 3:4, :], every[..., 4:, :] - every[..., 3:4, :]
    sides = torch.linalg.cross(y[..., [1, 2, 0], :], y[..., [2, 0, 1], :])
    scale = (y[..., 0, :] * sides[..., 0, :]).sum(-1)  # (.., g)
    slopes = (z @ sides.mT).flatten(-2)  # (.., g, 3 m)
    scale, slopes = (inverse @ scale[..., None])[..., 0], inverse @ slopes
    return torch.cat([scale, slopes.mT.flatten(-2)], dim=-1)


def shapes_of_graph(unknowns: Tensor, n: int, trajectory: Trajectory, base: Base) -> Tensor:
    """The shapes ``(*batch, B, n, 3)`` nearest to the unknowns of :func:`graph_rows`, centroids 0."""
    rows, _ = _samples(trajectory, unknowns.device)
    m = n - 4
    scale, slopes = _split(unknowns.reshape(-1, unknowns.shape[-1]), m)
    powers = trajectory.power(3).rows(_nodes(trajectory, unknowns.device))
    eye = torch.eye(4, 3, dtype=unknowns.dtype, device=unknowns.device)
    above = (scale @ powers.mT)[..., None, None] * eye
    below = torch.einsum("gk,xmik->xgmi", powers, slopes)
    points = torch.cat([above, below], dim=-2)[..., basis_points_first(n, base, unknowns.device).argsort(), :]
    helmert = centring_basis(n, unknowns.device)
    problems = len(points)
    shapes = shapes_through(helmert @ points, rows.expand(problems, *rows.shape), points.new_ones(problems, len(rows)))
    return (helmert.mT @ shapes).reshape(*unknowns.shape[:-1], trajectory.size, n, 3)


def concatenate_shapes(shapes: Tensor) -> Tensor:
    """``(*batch, B, n, 3)`` to ``(*batch, n, 3 B)``."""
    return shapes.transpose(-3, -2).flatten(-2)


def split_shapes(shapes: Tensor) -> Tensor:
    """``(*batch, n, 3 B)`` to ``(*batch, B, n, 3)``."""
    return shapes.unflatten(-1, (shapes.shape[-1] // 3, 3)).transpose(-3, -2)


def concatenate_framed(shapes: Tensor) -> Tensor:
    """Shapes ``(*batch, B, n, 3)`` in their canonical frame, side by side."""
    return concatenate_shapes(canonical_frame(shapes.reshape(-1, *shapes.shape[-3:])).reshape(shapes.shape))


@constant
def _nodes(trajectory: Trajectory, device: torch.device) -> Tensor:
    return trajectory.nodes(2 * trajectory.power(3).size).to(device)


@constant
def _samples(trajectory: Trajectory, device: torch.device) -> tuple[Tensor, Tensor]:
    """Values of the functions at the nodes ``(g, B)``, and from values at the nodes to coefficients of products ``(K, g)``."""
    nodes = _nodes(trajectory, device)
    return trajectory.rows(nodes), torch.linalg.pinv(trajectory.power(3).rows(nodes))


def perspective_rows(measured: Tensor, trajectory: Trajectory, places: tuple[int, ...]) -> Tensor:
    r"""Rows of :math:`p_5^T F(t)\, p_6 = 0` of six of the points, ``(*batch, views, 1, 5 K)``; zero where one is missing."""
    row = general_rows(measured[..., list(places), :3])
    return (trajectory.power(9).rows(measured[..., 0, 3])[..., None, :, None] * row[..., None, :]).flatten(-2)


PERSPECTIVE = CameraKind()
MIN_PERSPECTIVE_POINTS = 6
"""Any five points go anywhere by a camera of the plane."""
Form = Literal["joint", "basis", "span"]
Camera = Literal["affine", "projective"]


@dataclass(frozen=True, repr=False)
class DynamicShapeTensor(Invariant):
    r"""The shape and the motion of n points from single affine views, each by another camera.

    The points move as :math:`P(t) = \sum_b c_b(t)\, P_b`, and a view at time t lies in the span of :math:`[1, P(t)]`, whatever
    its camera.  A match is a view; the arguments of ``fit``, ``sampson`` and ``refine`` are the points :math:`p_1, \dots, p_n`,
    each ``(*batch, views, 2)``, NaN = missing, with ``times (*batch, views)`` or ``(views,)``.

    ==========  =========================================================================================================
    form        tensor
    ==========  =========================================================================================================
    ``joint``   ``(n, 3 B)``: the shapes :math:`P_0, P_1, \dots` side by side, up to a constant affine frame, of least squares:
                all points count alike.
    ``basis``   ``(K, n, n - 4)``: coefficients of N(t) with :math:`N(t)^T x = 0`, from
                :math:`D(t)\, x_j = \sum_{i \le 4} N_{ij}(t)\, x_i`: linear; 1.2 to 10 times the error in t.
    ``span``    ``(n - 1 - 3 B, n)``: what vanishes on all :math:`P_b` at once; linear, needs no times and tells none, n > 3 B + 1.
    ==========  =========================================================================================================

    ``camera="projective"`` is for views of near things: any cameras of the plane, from six points on, in the form ``joint`` only
    (``singular_values`` are those of the linear form :math:`p_5^T F(t)\, p_6 = 0` of six points, which takes 49 views at constant
    velocity, 8 where four points stand still in a plane: ``dyntorch count dynamic_shape``).  At a distance of 4 (10, 30) times
    the RMS extent of the points, and noise of 1 %, times are .005 off (.005, .005) on [-1, 1], of affine cameras .070 (.022, .009).

    All forms are differentiable with respect to points, times and weights, ``joint`` by the implicit function theorem at its
    minimum; with ``camera="projective"`` the fit carries no gradients, but ``refine`` does.

    Args:
        trajectory: :class:`~dyntorch.shapes.basis.Polynomial` (constant velocity by default) or ``Fourier``.
        form: ``joint``, ``basis`` or ``span``.
        base: the four basis points of the form ``basis``.
        points: n, which ``fit`` infers.
        camera: ``affine``, or ``projective`` for perspective views.
        interval: ``(2,)`` or ``(*batch, 2)`` times that polynomials map to [-1, 1]; ``fit`` takes the first and last one, which
            ``solution.invariant`` keeps: take it for ``sampson``, ``recover`` and ``score`` of other views.

    Raises:
        ValueError: another form, or basis points that are not four different ones.

    Source: thesis chapter 4; Levin, Wolf and Shashua, "Time-varying shape tensors for scenes with multiply moving points", 2001.

    Example:
        >>> import torch, dyntorch as dyn
        >>> g = torch.Generator().manual_seed(0)
        >>> t = torch.linspace(0, 3, 20).double()
        >>> start, velocity = torch.randn(2, 8, 3, generator=g).double()
        >>> x = (start + t[:, None, None] * velocity) @ torch.randn(20, 3, 2, generator=g).double()
        >>> solution = dyn.fit(dyn.DynamicShapeTensor, *x[:15].unbind(1), times=t[:15])
        >>> solution
        Solution(DynamicShapeTensor(Polynomial(degree=1)), matches=15, batch=(): 1 OK)
        >>> found = solution.invariant.recover(solution.tensor, *x[15:].unbind(1), reach=2.0)
        >>> bool((found.times - t[15:]).abs().max() < 1e-9)
        True
    """

    trajectory: Trajectory = field(default_factory=Polynomial)
    form: Form = "joint"
    base: Base = (0, 1, 2, 3)
    points: int = 5
    interval: Tensor | None = field(default=None, compare=False)
    camera: Camera = "affine"

    intrinsic = True
    motion = (Frame(None),)

    def __post_init__(self) -> None:
        if not isinstance(self.trajectory, Trajectory):
            raise ValueError(f"trajectory must be dyntorch.Polynomial or dyntorch.Fourier, got {self.trajectory!r}")
        if self.form not in ("joint", "basis", "span"):
            raise ValueError(f"form must be 'joint', 'basis' or 'span', got {self.form!r}")
        if self.camera not in ("affine", "projective"):
            raise ValueError(f"camera must be 'affine' or 'projective', got {self.camera!r}")
        if self.camera == "projective" and (self.form != "joint" or self.trajectory.size < 2):
            remedy = "use form='joint'" if self.form != "joint" else "use ShapeTensor for points that do not move"
            raise ValueError(f"projective cameras take the form 'joint' and points that move, got {self!r}; {remedy}")
        if len(set(self.base)) != 4 or len(self.base) != 4 or min(self.base) < 0:
            raise ValueError(f"base must be four different points, counted from 0, got {self.base!r}")

    def bind_arguments(
        self, views: Sequence[Tensor], weights: Tensor | None = None, **given: Tensor
    ) -> tuple[Invariant, tuple[Tensor, ...]]:
        """The invariant of so many points and of this interval, and ``(*batch, views, n, 4)``: x, y, 1 (0 where missing), time."""
        points = constellations(self, views)
        n = points.shape[-2]
        times = given.pop("times", None)
        for name in given:
            raise unknown_argument(self, name, "times")
        self.check_points(n)
        if times is None:
            if self.form != "span":
                raise ValueError(f"{self!r} needs times=, the time of each view (*batch, views); form='span' needs none")
            times = points.new_zeros(points.shape[:-2])
        times = times_of_views(times, points)
        interval = self.interval
        if interval is None:
            weight = option("weights", weights, tuple(times.shape[:-1]), times.shape[-1], points)
            interval = extremes(times if weight is None else torch.where(weight.reshape(times.shape) > 0, times, torch.nan))
        unit = self.trajectory.unit(times, interval.to(times)).to(points)
        unit = torch.where(self._is_informative(points[..., 2] > 0), unit, torch.nan)  # such a view is no match
        measured = torch.cat([points, unit[..., None, None].expand(*points.shape[:-1], 1)], dim=-1)
        return replace(self, points=n, interval=interval), (measured,)

    def check_points(self, n: int) -> None:
        least = 3 * self.trajectory.size + 2 if self.form == "span" else (MIN_PERSPECTIVE_POINTS if self.projective else 5)
        if n < least:
            raise ValueError(f"{self!r} needs at least {least} points, got {n}; add points, or use fewer functions of the time")
        if max(self.base) >= n:
            raise ValueError(f"base must name four of {n} points, counted from 0, got {self.base!r}")

    @property
    def projective(self) -> bool:
        """Whether the cameras are any of the plane."""
        return self.camera == "projective"

    def _is_informative(self, seen: Tensor) -> Tensor:
        """Whether views that see these points say anything, ``(*batch, views)``."""
        if self.form == "span":
            return seen.all(-1)
        basis = seen[..., list(self.base)].all(-1)
        return (seen.sum(-1) > 4 + self.projective) & (basis if self.form == "basis" else True)

    @property
    def primitives(self) -> tuple[Equations, ...]:  # type: ignore[override]
        """One slot: a whole view and its time."""
        n, trajectory, base = self.points, self.trajectory, self.base
        if self.projective:
            # the linear form of the four basis points and the next two
            places = (*base, *(i for i in range(n) if i not in base))[:6]
            rows = partial(perspective_rows, trajectory=trajectory, places=places)
            return (Equations((n, 4), 5 * trajectory.power(9).size, rows),)
        if self.form == "span":
            return (Equations((n, 4), n - 1, span_rows, rows=2),)
        width = trajectory.power(3).size * (1 + 3 * (n - 4))
        return (Equations((n, 4), width, partial(graph_rows, trajectory=trajectory, base=base), rows=2 * (n - 4)),)

    @property
    def nullity(self) -> int:  # type: ignore[override]
        """Dimension of the null space of the rows: 1, or the codimension of the span of all positions."""
        return self.points - 1 - 3 * self.trajectory.size if self.form == "span" else 1

    @property
    def dof(self) -> int:  # type: ignore[override]
        """Numbers behind the tensor: positions of all functions up to translation, less what the gauge takes."""
        size = 3 * self.trajectory.size
        if self.projective:
            # positions of all functions up to translation, less the affine frame of the world
            return size * (self.points - 1) - gauge(self.trajectory.size)
        return size * (self.points - 1 - size) if self.form == "span" else size * (self.points - 1) - 9

    @property
    def codim(self) -> int:  # type: ignore[override]
        """Conditions on one view."""
        if self.projective:
            return 2 * self.points - PERSPECTIVE.freedom
        return 2 * (self.nullity if self.form == "span" else self.points - 4)

    @on_class
    def minimal(self) -> int:
        """Fewest views: of the linear form, or for projective cameras by what the points leave open."""
        return -(-self.dof // self.codim) if self.projective else -(-(self.width() - self.nullity) // self.rows())

    @on_class
    def shape(self) -> tuple[int, ...]:
        """Shape of one tensor (for ``span`` of one row of it)."""
        n, size = self.points, self.trajectory
        return {"joint": (n, 3 * size.size), "basis": (size.power(3).size, n, n - 4), "span": (n,)}[self.form]

    def tensor_of(self, basis: Tensor) -> Tensor:
        """The tensor of a null space of the rows."""
        if self.form == "span":
            rows = basis @ centring_basis(self.points, basis.device)
            return rows[..., 0, :] if self.nullity == 1 else rows
        if self.form == "basis":
            return annihilator(basis[..., 0, :], self.points, self.base)
        return concatenate_framed(shapes_of_graph(basis[..., 0, :], self.points, self.trajectory, self.base))

    def basis_of(self, tensor: Tensor) -> Tensor:
        """The inverse of :meth:`tensor_of`."""
        if self.form == "span":
            return (tensor if self.nullity > 1 else tensor[..., None, :]) @ centring_basis(self.points, tensor.device).mT
        if self.form == "joint":
            unknowns = graph_of(split_shapes(tensor), self.trajectory, self.base)
            return (unknowns / unknowns.norm(dim=-1, keepdim=True).clamp(min=1e-300))[..., None, :]
        return unknowns_of(tensor, self.base)[..., None, :]

    def estimate_tensor(self, views: tuple[Tensor, ...], weights: Tensor) -> Estimate | None:
        """The form ``joint`` by least squares over all points; the others are the null space of the rows."""
        if self.form != "joint":
            return None
        measured = views[0]
        rows = self.trajectory.rows(measured[..., 0, 3])
        with torch.no_grad():
            estimate = (fit_perspective_shapes if self.projective else fit_shapes)(
                measured[..., :2], rows, measured[..., 2], share=weights
            )
        ambiguous = estimate.uncertainty > MAX_UNCERTAINTY
        shapes = estimate.shapes
        if not self.projective and torch.is_grad_enabled() and (measured.requires_grad or weights.requires_grad):
            shapes = select(estimate.status == Status.OK, followed_shapes(shapes, measured, rows, weights), shapes)
        return Estimate(concatenate_shapes(shapes), estimate.underdetermined, estimate.degenerate, ambiguous, estimate.uncertainty)

    @on_class
    def compose(self, shapes: Tensor) -> Tensor:
        r"""The tensor of known trajectories, of norm 1 (several rows of a span: orthonormal).

        Args:
            shapes: ``(*batch, n, 3 B)`` the shapes :math:`[P_0, P_1, \dots]` of the functions of the trajectory, at times in
                [-1, 1] for polynomials.
        """
        return replace(self, points=shapes.shape[-2])._compose(shapes.double()).to(shapes.dtype)

    def _compose(self, shapes: Tensor) -> Tensor:
        n = self.points
        if self.form == "span":
            rows = (shapes - shapes.mean(-2, keepdim=True)).mT @ centring_basis(n, shapes.device).mT
            return self.tensor_of(null_space(rows, n - 1 - shapes.shape[-1]))
        if self.form == "joint":
            return concatenate_framed(split_shapes(shapes)) * 3**-0.5  # of three orthonormal columns
        tensor = annihilator(graph_of(split_shapes(shapes), self.trajectory, self.base), n, self.base)
        size = tensor.flatten(-3).norm(dim=-1)[..., None, None, None]
        return tensor / torch.where(size > 0, size, 1.0)

    @on_class
    def decompose(self, tensor: Tensor) -> Tensor:
        """The shapes ``(*batch, n, 3 B)`` of the trajectories up to a constant affine frame; for the span some basis of it."""
        if self.form == "joint":
            return tensor
        double = tensor.double()
        if self.form == "basis":
            return concatenate_framed(self.shapes(double)).to(tensor.dtype)
        rows = double if self.nullity > 1 else double[..., None, :]
        rows = torch.cat([rows, torch.ones_like(rows[..., :1, :])], dim=-2)
        return null_space(rows, 3 * self.trajectory.size).mT.to(tensor.dtype)

    def shapes(self, tensor: Tensor) -> Tensor:
        """The shape of every function of the trajectory, ``(*batch, B, n, 3)``."""
        if self.form == "span":
            raise ValueError("form='span' knows the positions of all times together, no shape of any; use 'joint' or 'basis'")
        if self.form == "joint":
            return split_shapes(tensor)
        return shapes_of_graph(unknowns_of(tensor, self.base), tensor.shape[-2], self.trajectory, self.base)

    def whitened_residual(self, motion: tuple[Tensor, ...], views: tuple[Tensor, ...], scales: tuple[Tensor, ...]) -> Tensor | None:
        """The distance of each view from the images of its shape, point by point: ``(*batch, views, 2 n)``."""
        if self.projective:
            structure, _ = self._structure(motion[0].double(), views[0].double())
            error = reprojection_residual(structure, views[0][..., :3].double(), scales[0].double(), PERSPECTIVE)
            return error.to(views[0].dtype)
        residual = self._project(motion[0].double(), views[0].double())[0].residual.flatten(-2)
        return (residual / scales[0][..., None, None]).to(views[0].dtype)

    def linearize(
        self, motion: tuple[Tensor, ...], views: tuple[Tensor, ...], scales: tuple[Tensor, ...]
    ) -> tuple[Tensor, Tensor] | None:
        """:meth:`whitened_residual` and its derivative by the shapes."""
        if self.projective:
            structure, rows = self._structure(motion[0], views[0])
            error, slope = reprojection_derivative(structure, views[0][..., :3], scales[0], PERSPECTIVE)
            derivative = torch.einsum("bvcnk,bvf->bnfkvc", slope[..., :3], rows)
            return error.flatten(-2), derivative.flatten(1, 3).flatten(2)
        if self.form == "span":
            return None
        projected, rows = self._project(motion[0], views[0])
        derivative = slopes(projected, views[0][..., 2], rows).flatten(-2).flatten(-4, -2)  # (b, v, n 3 B, 2 n)
        scale = scales[0][:, None]
        return projected.residual.flatten(1) / scale, derivative.transpose(1, 2).flatten(2) / scale[..., None]

    def _structure(self, shapes: Tensor, measured: Tensor) -> tuple[Tensor, Tensor]:
        """Homogeneous points ``(*batch, views, n, 4)`` at the times of the views, and the functions of the time."""
        rows = self.trajectory.rows(measured[..., 0, 3])
        return torch.nn.functional.pad(shapes_at(split_shapes(shapes), rows), (0, 1), value=1.0), rows

    def _project(self, shapes: Tensor, measured: Tensor) -> tuple[ProjectedShapes, Tensor]:
        """Views ``(*batch, views, n, 4)`` beside their shapes, and the functions of the time."""
        x, seen = measured[..., :2], measured[..., 2].detach()
        centre = (x * seen[..., None]).sum(-2, keepdim=True) / seen.sum(-1)[..., None, None].clamp(min=1.0)
        rows = self.trajectory.rows(measured[..., 0, 3])
        shape = shapes[..., None, :, :] if self.form == "span" else shapes_at(split_shapes(shapes), rows)
        return project((x - centre) * seen[..., None], seen, shape), rows

    @on_class
    def recover(
        self, tensor: Tensor, *points: Tensor, weights: Tensor | None = None, grid: int = 64, reach: float = 1.2
    ) -> Recovery:
        """When new views were taken, and what the shape at that time leaves unexplained.

        Args:
            tensor: of the form ``joint`` or ``basis``, ``(*batch, *shape)``.
            *points: ``(*batch, views, 2)`` each.
            weights: ``(*batch, views, n)``, 0 = ignore.
            grid: times tried before refinement.
            reach: polynomial trajectories: times tried, in half lengths of the interval of the training from its middle.

        Returns:
            :class:`~dyntorch.shapes.times.Recovery`, times in the unit and dtype of the training (without
            ``interval``: in [-1, 1]).  The mean of its ``residual`` over 2 n - 9 (projective: 2 n - 12) is the square
            of the noise that ``sigma`` and ``ambiguous`` ask for.
        """
        measured = constellations(self, points)
        seen = measured[..., 2] if weights is None else measured[..., 2] * weights
        shapes = self.shapes(tensor.double())
        if reach < 0:
            raise ValueError(f"reach must be 0 or more half lengths of the interval, got {reach!r}")
        recover = recover_perspective_times if self.projective else recover_times
        recovery = recover(shapes, self.trajectory, measured[..., :2], seen, grid=grid, interval=(-reach, reach))
        if self.interval is None:
            return recovery
        # the times of the training say how many digits they need: seconds since 1970 have more than the points
        interval = self.interval.to(recovery.times.device)
        scale = 1.0 if self.trajectory.period is not None else (interval[..., 1:] - interval[..., :1]).clamp(min=0) / 2
        times, second = (self.trajectory.time(t.to(interval), interval) for t in (recovery.times, recovery.second))
        return replace(recovery, times=times, second=second, sigma=recovery.sigma * scale)

    @on_class
    def score(self, tensor: Tensor, *points: Tensor, weights: Tensor | None = None) -> Tensor:
        """Part of the energy of each view that the tensor leaves unexplained at the best time, ``(*batch, views)`` in [0, 1]."""
        if self.form != "span":
            return self.recover(tensor, *points, weights=weights).residual
        basis = replace(self, points=len(points)).basis_of(tensor.double())
        return span_residual(constellations(self, points).double(), basis).to(tensor.dtype)

    def __repr__(self) -> str:
        form = "" if self.form == "joint" else f", form={self.form!r}"
        camera = ", camera='projective'" if self.projective else ""
        return f"DynamicShapeTensor({self.trajectory!r}{form}{camera})"
