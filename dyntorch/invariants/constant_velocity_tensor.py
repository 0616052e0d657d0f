r"""The constant velocity tensor: points of space that move at constant velocity, each with its own, seen by three moving sensors.

A point at :math:`x + t v` is seen as :math:`P_t \sim A_t (x + t v, 1)`, t = 0, 1, 2.  With the world position
:math:`y_t = \pi(A_t^{-1} P_t)` and the plane at infinity of each frame, the last row of :math:`A_t^{-1}`, called
:math:`\alpha, \beta, \gamma`, the prediction :math:`y_2 = 2 y_1 - y_0` is bilinear in the first two measurements:

.. math:: P_2 \sim A_2\left(2\,(\alpha \cdot P_0)\, A_1^{-1} P_1 - (\beta \cdot P_1)\, A_0^{-1} P_0\right)
    \qquad T_{ijk} = \alpha_i Q_{kj} + K_{ki} \beta_j, \quad Q = 2 A_2 A_1^{-1}, \quad K = -A_2 A_0^{-1}.

The third sensor may be a camera: :math:`A_2` is then 3 x 4.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor
from torch.nn.functional import normalize, pad

from dyntorch.core.invariant import Frame, Invariant
from dyntorch.core.normalize import unit_tensors
from dyntorch.core.primitives import HyperplanesThrough, Point, Primitive
from dyntorch.core.residual import residual_derivative, whiten
from dyntorch.geometry.extensors import adjugate, back_project, compound, dual, join, project
from dyntorch.geometry.homogeneous import homogeneous, inhomogeneous, unit
from dyntorch.numerics.arguments import check_weights
from dyntorch.numerics.least_squares import jacobian
from dyntorch.numerics.nullspace import null_space, spectrum

# ----------------------------------------------------------------------------------------------------------------------
# Residuals of points at constant velocity before three sensors, whitened by the noise of all three.


def inverses(motion: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    r"""Sensor to world: :math:`A_0^{-1}, A_1^{-1}, A_2^{-1}` up to scale; a camera, ``(*batch, 3, 4)``, stays as it is."""
    return tuple(adjugate(part) if part.shape[-2] == part.shape[-1] else part for part in motion)


def moving_residual(inverses: tuple[Tensor, ...], views: tuple[Tensor, ...], scales: tuple[Tensor, ...]) -> Tensor:
    r"""The second difference :math:`e = y_0 - 2 y_1 + y_2` of the world positions :math:`y_t = \pi(A_t^{-1} P_t)`, whitened.
    views ``(*batch, n, 3)``, scales ``(*batch,)`` -> ``(*batch, n, 3)``."""
    (y0, j0), (y1, j1) = project(inverses[0], views[0]), project(inverses[1], views[1])
    j0, j1 = scales[0][..., None, None, None] * j0, 2 * scales[1][..., None, None, None] * j1
    if views[2].shape[-1] == 3:
        y2, j2 = project(inverses[2], views[2])
        j2 = scales[2][..., None, None, None] * j2
        return whiten(y0 - 2 * y1 + y2, j0 @ j0.mT + j1 @ j1.mT + j2 @ j2.mT)
    seen, j = project(inverses[2], 2 * y1 - y0)
    noise = torch.eye(2, dtype=seen.dtype, device=seen.device) * scales[2][..., None, None, None].square()
    return whiten(seen - views[2], j @ (j0 @ j0.mT + j1 @ j1.mT) @ j.mT + noise)


def resting_residual(inverses: tuple[Tensor, ...], views: tuple[Tensor, ...], scales: tuple[Tensor, ...]) -> Tensor:
    r"""The differences :math:`(y_1 - y_0, y_2 - y_1)` of points that stand still, whitened; with a camera the second in the
    image."""
    (y0, j0), (y1, j1) = project(inverses[0], views[0]), project(inverses[1], views[1])
    q0 = scales[0][..., None, None, None].square() * (j0 @ j0.mT)
    q1 = scales[1][..., None, None, None].square() * (j1 @ j1.mT)
    if views[2].shape[-1] == 3:
        y2, j2 = project(inverses[2], views[2])
        last, cross, corner = y2 - y1, -q1, q1 + scales[2][..., None, None, None].square() * (j2 @ j2.mT)
    else:
        seen, j = project(inverses[2], y1)
        noise = torch.eye(2, dtype=seen.dtype, device=seen.device) * scales[2][..., None, None, None].square()
        last, cross, corner = seen - views[2], j @ q1, j @ q1 @ j.mT + noise
    covariance = torch.cat([torch.cat([q0 + q1, cross.mT], dim=-1), torch.cat([cross, corner], dim=-1)], dim=-2)
    return whiten(torch.cat([y1 - y0, last], dim=-1), covariance)


Motion = tuple[Tensor, Tensor, Tensor]


@dataclass(frozen=True)
class ConstantVelocityTensor(Invariant):
    r"""Constant velocity tensor, :math:`T(P_0, P_1, \cdot) \sim P_2` with :math:`P_t \sim A_t (x + t v, 1)`.

    21 matches between three sensors in space, or 24 with a camera as the third view.  The motion, three maps from the world
    to the sensors at the times 0, 1, 2, is found up to an affinity of the world and a velocity u common to all points (which
    no measurement tells from a motion of the sensors; static points do, see :meth:`fix_gauge`).

    Matches that are all static or of one velocity (rank 36 of 63), or with velocities along a line (49) or in a plane (58,
    cars on a road), do not determine the tensor.

    Args:
        third: ``"space"``, the third view measures points of space ``(*batch, n, 3)``; ``"image"``, it is a camera
            ``(*batch, n, 2)`` with a finite centre, and :math:`A_2` is 3 x 4.

    Source: thesis section 8.3.

    Example:
        >>> ConstantVelocityTensor.minimal(), ConstantVelocityTensor("image").minimal()
        (21, 24)
        >>> from dyntorch.scenes import constant_velocity
        >>> scene = constant_velocity(30)
        >>> T = ConstantVelocityTensor.compose(*scene.motion)
        >>> bool((ConstantVelocityTensor.transfer(T, *scene.views[:2]) - scene.views[2]).abs().max() < 1e-9)
        True
    """

    third: Literal["space", "image"] = "space"

    nullity = 1
    motion = (Frame(0), Frame(1), Frame(2))
    resolves_noise = False

    def __post_init__(self) -> None:
        if self.third not in ("space", "image"):
            raise ValueError(f"third must be 'space' or 'image', got {self.third!r}")

    @property
    def primitives(self) -> tuple[Primitive, ...]:  # type: ignore[override]
        return (Point(3), Point(3), HyperplanesThrough(self.codim))

    @property
    def codim(self) -> int:  # type: ignore[override]
        return 3 if self.third == "space" else 2

    @property
    def dof(self) -> int:  # type: ignore[override]
        """Parameters of three maps up to scale, less 12 of the affinity of the world and 3 of the common velocity."""
        return 30 if self.third == "space" else 26

    @staticmethod
    def compose(first: Tensor, second: Tensor, third: Tensor) -> Tensor:
        r"""The tensor of the maps :math:`A_0, A_1, A_2`.

        Args:
            first, second: ``(*batch, 4, 4)`` of any scale.
            third: ``(*batch, 4, 4)``, or ``(*batch, 3, 4)`` of a camera.

        Returns:
            ``(*batch, 4, 4, 4)``, or ``(*batch, 4, 4, 3)`` where :math:`A_2` is that of a camera; of norm 1.
        """
        back0, back1 = adjugate(first), adjugate(second)
        moved = torch.einsum("...i,...kj->...ijk", back0[..., 3, :], 2 * third @ back1)
        return unit_tensors(moved - torch.einsum("...ki,...j->...ijk", third @ back0, back1[..., 3, :]), 3)

    @staticmethod
    def decompose(tensor: Tensor) -> Motion:
        r"""The maps of a tensor in closed form; see :func:`~dyntorch.invariants.constant_velocity_tensor.constant_velocity_maps`.

        Differentiable (first derivatives), up to the gauge: take gradients of functions that neither an affinity of the world
        nor a common velocity changes, such as ``compose(*decompose(T))``.

        Args:
            tensor: ``(*batch, 4, 4, 4)``, or ``(*batch, 4, 4, 3)`` of a camera.

        Returns:
            :math:`A_0, A_1, A_2` of norm 1.  Zero matrices for a tensor that is 0 or not finite.

        Example:
            >>> from dyntorch.scenes import constant_velocity
            >>> scene = constant_velocity(5)
            >>> maps = ConstantVelocityTensor.decompose(ConstantVelocityTensor.compose(*scene.motion))
            >>> y = ConstantVelocityTensor.positions(maps, *scene.views)
            >>> bool((y[:, 0] - 2 * y[:, 1] + y[:, 2]).abs().max() < 1e-9)
            True
        """
        # in float64 and in coordinates of order 1
        even, (first, second, third) = balance_views(unit_tensor(tensor))
        maps = constant_velocity_maps(even)
        scaled = (maps[0] / first[..., None], maps[1] / second[..., None], maps[2] * third[..., None])
        first, second, third = (unit(m).to(tensor.dtype) for m in scaled)
        return first, second, third

    @staticmethod
    def transfer(tensor: Tensor, x1: Tensor | None = None, x2: Tensor | None = None, x3: Tensor | None = None) -> Tensor:
        r"""The point of one view from those of the other two, without the motion.

        The third view is :math:`T(P_0, P_1, \cdot)`; the first solves :math:`T(\cdot, P_1, \cdot)\, P_0 \sim P_2`, the second
        likewise (with a camera as the third view only the third can be predicted).

        Args:
            tensor: ``(*batch, 4, 4, 4)``, or ``(*batch, 4, 4, 3)`` of a camera.
            x1, x2, x3: two of the three views, ``(*batch, n, 3)`` or ``(*batch, n, 2)``.

        Returns:
            ``(*batch, n, 3)`` or ``(*batch, n, 2)``, the view that was not given.

        Raises:
            ValueError: not exactly two views, or one that a camera cannot predict.

        Example:
            >>> from dyntorch.scenes import constant_velocity
            >>> scene = constant_velocity(5)
            >>> T = ConstantVelocityTensor.compose(*scene.motion)
            >>> found = ConstantVelocityTensor.transfer(T, x2=scene.views[1], x3=scene.views[2])
            >>> bool((found - scene.views[0]).abs().max() < 1e-9)
            True
        """
        given = [None if x is None else homogeneous(x) for x in (x1, x2, x3)]
        if sum(p is None for p in given) != 1:
            raise ValueError(f"transfer takes two of x1, x2, x3 and returns the third, got {sum(p is not None for p in given)}")
        if given[2] is None:
            return inhomogeneous(torch.einsum("...ijk,...ni,...nj->...nk", tensor, given[0], given[1]))
        if tensor.shape[-1] == 3:
            raise ValueError("an image as the third view does not determine a point of space: give x1 and x2")
        terms, point = ("...ijk,...nj->...nki", given[1]) if given[0] is None else ("...ijk,...ni->...nkj", given[0])
        return inhomogeneous((adjugate(torch.einsum(terms, tensor, point)) @ given[2][..., None])[..., 0])

    @staticmethod
    def positions(motion: Motion, x1: Tensor, x2: Tensor, x3: Tensor) -> Tensor:
        r"""World positions :math:`y_t = \pi(A_t^{-1} P_t)` of the matches at the three times.

        Args:
            motion: the three maps.
            x1, x2: ``(*batch, n, 3)``.
            x3: ``(*batch, n, 3)``; of an image only the first two views are used, :math:`y_2 = 2 y_1 - y_0`.

        Returns:
            ``(*batch, n, 3, 3)``: times, then coordinates, in the world of the motion.
        """
        y0, y1 = back_project(motion[0], x1)[0], back_project(motion[1], x2)[0]
        y2 = back_project(motion[2], x3)[0] if x3.shape[-1] == 3 else 2 * y1 - y0
        return torch.stack([y0, y1, y2], dim=-2)

    @staticmethod
    def velocities(motion: Motion, x1: Tensor, x2: Tensor, x3: Tensor) -> Tensor:
        """World velocities of the matches per step of time, ``(*batch, n, 3)``, up to the common one that the gauge chooses."""
        y = ConstantVelocityTensor.positions(motion, x1, x2, x3)
        return (y[..., 2, :] - y[..., 0, :]) / 2

    @staticmethod
    def fix_gauge(motion: Motion, x1: Tensor, x2: Tensor, x3: Tensor, weights: Tensor | None = None) -> Motion:
        r"""Choose the common velocity u such that the given matches stand still.

        .. math:: A_t \to A_t \begin{pmatrix} I & t u \\ 0 & 1 \end{pmatrix}

        Args:
            motion: the three maps.
            x1, x2, x3: matches known to be static, ``(*batch, n, 3 | 2)``, one or more.
            weights: ``(*batch, n)``, 0 for a match that moves or is not known to be static.

        Returns:
            the maps in the new gauge, of norm 1; unchanged where all weights are 0.

        Raises:
            ValueError: no matches, or negative weights.

        Example:
            >>> from dyntorch.scenes import constant_velocity
            >>> scene = constant_velocity(5, static=0.4)
            >>> maps = ConstantVelocityTensor.decompose(ConstantVelocityTensor.compose(*scene.motion))
            >>> maps = ConstantVelocityTensor.fix_gauge(maps, *scene.views, weights=(scene.labels == 1).double())
            >>> int((ConstantVelocityTensor.static_distance(maps, *scene.views) < 1e-9).sum())
            2
        """
        if x1.shape[-2] == 0:
            raise ValueError("x1 has no matches; the common velocity takes one static match or more")
        check_weights(weights, "a match")
        velocity = ConstantVelocityTensor.velocities(motion, x1, x2, x3)
        weight = torch.ones_like(velocity[..., 0]) if weights is None else weights.to(velocity)
        total = weight.sum(-1, keepdim=True)
        # a match of weight 0 may be anything, also not a number
        used = torch.where(weight[..., None] > 0, velocity, torch.zeros_like(velocity))
        common = (weight[..., None] * used).sum(-2) / torch.where(total > 0, total, torch.ones_like(total))
        first, second, third = (unit(_drift(matrix, t * common)) for t, matrix in enumerate(motion))
        return first, second, third

    @staticmethod
    def trajectory(motion: Motion, x1: Tensor, x2: Tensor, x3: Tensor, *, view: int = 1) -> Tensor:
        r"""The line on which each point moves, as the given view sees it; it depends on the common velocity (:meth:`fix_gauge`).

        Args:
            motion: the three maps.
            x1, x2, x3: matches.
            view: 1, 2 or 3: in whose frame.

        Returns:
            ``(*batch, n, 6)`` Pluecker coordinates (01, 02, 03, 12, 13, 23); ``(*batch, n, 3)`` in an image.  0 for a point
            that does not move.

        Raises:
            ValueError: another view.
        """
        if view not in (1, 2, 3):
            raise ValueError(f"view must be 1, 2 or 3, got {view!r}")
        y = ConstantVelocityTensor.positions(motion, x1, x2, x3)
        velocity = (y[..., 2, :] - y[..., 0, :]) / 2
        direction = torch.cat([velocity, torch.zeros_like(velocity[..., :1])], dim=-1)
        line = join(homogeneous(y.mean(-2)), direction) @ compound(motion[view - 1], 2).mT
        return line if line.shape[-1] == 6 else dual(line, 3, 2)

    @staticmethod
    def static_distance(motion: Motion, x1: Tensor, x2: Tensor, x3: Tensor) -> Tensor:
        r"""How far each match is from standing still, ``(*batch, n)``, once the gauge is fixed.

        With noise of standard deviation s in every coordinate the square divided by :math:`s^2` follows :math:`\chi^2` with 6
        degrees of freedom for a static match, 5 with an image as the third view.
        """
        one = torch.ones((), dtype=x1.dtype, device=x1.device)
        return resting_residual(inverses(motion), (x1, x2, x3), (one, one, one)).norm(dim=-1)

    def whitened_residual(self, motion: tuple[Tensor, ...], views: tuple[Tensor, ...], scales: tuple[Tensor, ...]) -> Tensor:
        r"""The residual :math:`e = y_0 - 2 y_1 + y_2`, whitened; in an image :math:`e = \pi(A_2 (2 y_1 - y_0, 1)) - x_3`.

        Returns:
            ``(*batch, n, 3)``, or ``(*batch, n, 2)`` with an image.
        """
        return moving_residual(inverses(motion), views, scales)

    def linearize(self, motion: tuple[Tensor, ...], views: tuple[Tensor, ...], scales: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
        """By way of the inverses, which the residuals of all matches share: computed once per motion."""
        maps, slope = self._inverses(motion)
        value, derivative = residual_derivative(moving_residual, maps, views, scales)
        return value, slope @ derivative

    @staticmethod
    def _inverses(motion: tuple[Tensor, ...]) -> tuple[tuple[Tensor, ...], Tensor]:
        """:func:`inverses` and their derivative ``(b, p, q)`` by all entries of the motion ``(b, ...)``."""
        square = [part for part in motion if part.shape[-2] == part.shape[-1]]
        b, count = len(motion[0]), len(square)
        # every inverse depends on its own matrix: the derivatives of all of them in one pass
        value, slope = jacobian(lambda t: adjugate(t.unflatten(-1, (4, 4))).flatten(-2), torch.cat(square).flatten(1))
        blocks = list(slope.unflatten(0, (count, b)))
        if count < len(motion):  # a camera stays as it is
            blocks.append(torch.eye(12, dtype=value.dtype, device=value.device).expand(b, 12, 12))
        sizes = [block.shape[-1] for block in blocks]
        rows = [pad(block, (sum(sizes[:i]), sum(sizes[i + 1 :]))) for i, block in enumerate(blocks)]
        return (*value.unflatten(-1, (4, 4)).unflatten(0, (count, b)), *motion[count:]), torch.cat(rows, dim=-2)

    def whitened_static_residual(self, motion: tuple[Tensor, ...], views: tuple[Tensor, ...], scales: tuple[Tensor, ...]) -> Tensor:
        r"""Residual of matches that stand still, :math:`(y_1 - y_0, y_2 - y_1)`, whitened; it holds the common velocity at 0.

        Returns:
            ``(*batch, n, 6)``, or ``(*batch, n, 5)`` with an image.
        """
        return resting_residual(inverses(motion), views, scales)


def _drift(matrix: Tensor, shift: Tensor) -> Tensor:
    r"""The map after a translation of the world, :math:`A \begin{pmatrix} I & s \\ 0 & 1 \end{pmatrix}`."""
    return torch.cat([matrix[..., :3], matrix[..., 3:] + matrix[..., :3] @ shift[..., None]], dim=-1)


# ----------------------------------------------------------------------------------------------------------------------
# The algebra of the tensor: its slices, the planes at infinity behind it, and the maps of the sensors.


# 300 scenes each: with 24 matches and noise of 2e-3 of the scene the global minimum is found always (camera: always), with 21
# matches and 5e-3 in 98 %; 3 and 3 steps leave 2 % unconverged, 30 alternations gain nothing
ALTERNATIONS = 10
NEWTON_STEPS = 4


def infinity_planes(tensor: Tensor) -> tuple[Tensor, Tensor]:
    r"""The planes at infinity of the first two frames: :math:`T \approx \alpha \otimes Q + K \otimes \beta`, least squares.
    tensor ``(*batch, 4, 4, m)`` -> ``(*batch, 4)``."""
    with torch.no_grad():
        alpha = _common_column(tensor)
        beta = spectrum(_gram(tensor.transpose(-2, -3), alpha))[1][..., -1]
        for _ in range(ALTERNATIONS):
            alpha = _step(_gram(tensor, beta), alpha)
            beta = _step(_gram(tensor.transpose(-2, -3), alpha), beta)
        for _ in range(NEWTON_STEPS):
            alpha, beta = _newton(tensor, alpha, beta)
        alpha, beta = _upright(alpha), _upright(beta)
    # one step has the first derivative of the minimum, two have the second
    alpha, beta = _newton(tensor, alpha, beta)
    return _newton(tensor, alpha, beta) if tensor.requires_grad else (alpha, beta)


def constant_velocity_maps(tensor: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    r"""The maps :math:`A_0, A_1, A_2` of a tensor in closed form, up to an affinity of the world and a common velocity. tensor
    ``(*batch, 4, 4, 4)`` -> ``(*batch, 4, 4)``."""
    # T_ijk ~ alpha_i Q_kj + K_ki beta_j with K alpha = 0
    alpha, beta = infinity_planes(tensor)
    q, k = torch.einsum("...ijk,...i->...kj", tensor, alpha), torch.einsum("...ijk,...j->...ki", tensor, beta)
    k = k - (k @ alpha[..., None]) * alpha[..., None, :]
    first = complement_frame(alpha)
    if tensor.shape[-1] == 3:
        third = -k @ first  # [M | 0]: the camera is at the origin
        world = torch.cat([torch.cat([third[..., :3], torch.zeros_like(third[..., 3:])], dim=-1), _last_row(third)], dim=-2)
        second = adjugate(torch.cat([q / 2, beta[..., None, :]], dim=-2)) @ world
        return unit(first), unit(second), unit(third)
    # the plane at infinity of the third frame: gamma^T Q ~ beta^T, gamma^T K ~ alpha^T
    rest = q - (q @ beta[..., None]) * beta[..., None, :]
    k_rest = k - (k @ alpha[..., None]) * alpha[..., None, :]  # once more: what rounding left of K alpha
    gamma = null_space(torch.cat([rest.mT, k_rest.mT], dim=-2))[..., 0, :]
    shift = (gamma[..., None, :] @ q @ beta[..., None])[..., 0] * gamma
    q = q + shift[..., :, None] * beta[..., None, :]
    k = k - shift[..., :, None] * alpha[..., None, :]
    third = -k @ first
    return unit(first), unit(adjugate(q) @ third), unit(third)


def unit_tensor(tensor: Tensor) -> Tensor:
    """The tensor in float64 and of norm 1, with 0 in place of one that is not finite."""
    if tensor.ndim < 3 or tuple(tensor.shape[-3:]) not in ((4, 4, 4), (4, 4, 3)):
        raise ValueError(f"tensor must be (*batch, 4, 4, 4), or (*batch, 4, 4, 3) of a camera, got {tuple(tensor.shape)}")
    good = tensor.isfinite().flatten(-3).all(-1)[..., None, None, None]
    exact = torch.where(good, tensor, torch.zeros_like(tensor)).double()
    return unit_tensors(exact, 3)


def balance_views(tensor: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor]]:
    r"""Bring each view to a unit in which its points are of order 1: :math:`T_{ijk} = \hat T_{ijk}\, d_i e_j f_k`."""
    scales = []
    for axis, like in ((-3, 13**-0.5), (-2, 1.0), (-1, 5**0.5)):
        size = torch.linalg.vector_norm(tensor, dim=[a for a in (-3, -2, -1) if a != axis]).square()
        inner, last = size[..., :-1].mean(-1, keepdim=True), size[..., -1:]
        usable = (inner > 0) & (last > 0)
        scale = torch.where(usable, (inner / torch.where(usable, last, 1.0)).clamp(min=1e-300).sqrt() / like, 1.0)
        factor = torch.cat([scale.expand_as(size[..., :-1]), torch.ones_like(last)], dim=-1)
        tensor = tensor / factor.unflatten(-1, [-1 if a == axis else 1 for a in (-3, -2, -1)])
        scales.append(factor)
    return unit_tensors(tensor, 3), (scales[0], scales[1], scales[2])


def complement_frame(plane: Tensor) -> Tensor:
    """The orthogonal matrix [R^T, plane]: a Householder reflection, smooth where the last coordinate is not negative."""
    eye = torch.eye(4, dtype=plane.dtype, device=plane.device)
    w = plane + eye[3]
    reflection = eye - w[..., :, None] * w[..., None, :] / (1 + plane[..., 3, None, None])
    return torch.cat([reflection[..., :3], plane[..., None]], dim=-1)


def _common_column(tensor: Tensor) -> Tensor:
    """The vector that all slices of the third axis, of rank 2, have in their column space."""
    slices = tensor.movedim(-1, -3)
    complement = spectrum(slices @ slices.mT)[1][..., :2]
    return spectrum((complement @ complement.mT).sum(-3))[1][..., 0]


def _gram(tensor: Tensor, plane: Tensor) -> Tensor:
    """The Gram matrix of the first axis once the second is projected to the complement of ``plane``."""
    rest = tensor - torch.einsum("...ilk,...l,...j->...ijk", tensor, plane, plane)
    return torch.einsum("...ijk,...ljk->...il", rest, rest)


def _step(gram: Tensor, vector: Tensor) -> Tensor:
    """One power step towards the leading vector of a Gram matrix that is nearly of rank 1; the vector itself if it is 0."""
    moved = (gram @ vector[..., None])[..., 0]
    return torch.where(moved.norm(dim=-1, keepdim=True) > 0, normalize(moved, dim=-1), vector)


def _newton(tensor: Tensor, alpha: Tensor, beta: Tensor) -> tuple[Tensor, Tensor]:
    """One Newton step of the least squares problem on the two unit spheres; no step where it has no strict minimum."""
    flipped = tensor.transpose(-2, -3)
    grams = (_gram(tensor, beta), _gram(flipped, alpha))
    gradient = torch.cat([_off(g @ v[..., None], v) for g, v in zip(grams, (alpha, beta), strict=True)], dim=-2)
    with torch.no_grad():
        diagonal = []
        for gram, v in zip(grams, (alpha, beta), strict=True):
            column = v[..., None]
            value = column.mT @ gram @ column
            inner = _off(_off(gram, v).mT, v)
            eye = torch.eye(4, dtype=gram.dtype, device=gram.device)
            diagonal.append(value * eye - inner)
        right = torch.einsum("...ijk,...j->...ik", tensor, beta)
        left = torch.einsum("...ijk,...i->...jk", tensor, alpha)
        both = torch.einsum("...ik,...i->...k", right, alpha)
        cross = torch.einsum("...ijk,...k->...ij", tensor, both) + right @ left.mT
        cross = _off(_off(cross, alpha).mT, beta).mT
        hessian = torch.cat([torch.cat([diagonal[0], cross], dim=-1), torch.cat([cross.mT, diagonal[1]], dim=-1)], dim=-2)
        factor, info = torch.linalg.cholesky_ex(hessian)
        strict = (info == 0)[..., None, None]
        inverse = torch.where(
            strict, torch.cholesky_inverse(torch.where(strict, factor, torch.eye(8, dtype=factor.dtype, device=factor.device))), 0.0
        )
    step = (inverse @ gradient)[..., 0]
    return normalize(alpha + step[..., :4], dim=-1), normalize(beta + step[..., 4:], dim=-1)


def _off(matrix: Tensor, vector: Tensor) -> Tensor:
    """The columns without their part along a unit vector."""
    column = vector[..., None]
    return matrix - column @ (column.mT @ matrix)


def _upright(plane: Tensor) -> Tensor:
    """The sign for which the last coordinate is not negative."""
    return torch.where(plane[..., 3:] < 0, -plane, plane)


def _last_row(matrix: Tensor) -> Tensor:
    """The row (0, 0, 0, 1)."""
    return torch.eye(4, dtype=matrix.dtype, device=matrix.device)[3:].expand(*matrix.shape[:-2], 1, 4)
