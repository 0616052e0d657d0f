"""The Grassmann tensor of any projections P^k -> P^l: moving points as static points of a higher projective space."""

from __future__ import annotations

from dataclasses import dataclass
from math import comb, prod

from torch import Tensor

from dyntorch.core.invariant import Frame, Invariant
from dyntorch.core.normalize import unit_tensors
from dyntorch.core.primitives import HyperplanesThrough, Point, Primitive
from dyntorch.geometry.grassmann import candidates, grassmann_derivative, grassmann_tensor
from dyntorch.geometry.grassmann_nearest import projections_of
from dyntorch.invariants import reprojection
from dyntorch.numerics.least_squares import normalized_derivative


@dataclass(frozen=True, repr=False)
class GrassmannTensor(Invariant):
    r"""Points Y of :math:`P^k` seen by uncalibrated projections :math:`x_i \sim M_i Y`, each :math:`P^k \to P^l`.

    With :math:`\alpha_i` hyperplanes :math:`S_i` through the image in view i, :math:`\sum_i \alpha_i = k + 1`,

    .. math:: \det(S_1 M_1; \dots; S_n M_n) = \langle A, C_{\alpha_1}(S_1) \otimes \dots \otimes C_{\alpha_n}(S_n) \rangle = 0,

    where A holds the determinants of :math:`\alpha_i` rows of each :math:`M_i`
    (:func:`~dyntorch.geometry.grassmann.grassmann_tensor`).
    A moving point whose position is linear in some parameters is a static point of a higher space: ``(4, (2, 2, 1))`` are
    points of a plane at constant velocity, ``(6, (2, 2, 2, 1))`` points of space at constant velocity, ``(3, (2, 1, 1))`` is
    the trifocal and ``(3, (2, 2))`` the fundamental tensor; :func:`dyntorch.reconstruct` goes on to the scene.

    The motion, :math:`M_1, \dots, M_n`, is found up to a collineation of :math:`P^k`.  From noisy tensors ``decompose`` gives
    the projections of the nearest Grassmann tensor; :func:`dyntorch.constrain` those of least algebraic error.

    Args:
        k: dimension of the space of the points.
        profile: :math:`\alpha_i`, hyperplanes per view, 1 to :math:`l_i`.
        l: dimension of the views, one for all or one each.
        dual: the views measure, by points (x, 1), hyperplanes that contain the images: lines L of space on which points
            move, :math:`p_i^T M_i L = 0` (``GrassmannTensor(5, (1,) * 6, dual=True)``); the profile is then all ones.

    Source: thesis chapter 3; Hartley and Schaffalitzky 2004 (Grassmann tensors determine their projections).

    Example:
        >>> GrassmannTensor(4, (2, 2, 1)).minimal(), GrassmannTensor(6, (2, 2, 2, 1)).minimal(), GrassmannTensor(5, (2, 2, 2)).dof
        (13, 40, 16)
    """

    k: int
    profile: tuple[int, ...]
    l: int | tuple[int, ...] = 2  # noqa: E741 - its name in the literature
    dual: bool = False

    nullity = 1

    def __post_init__(self) -> None:
        profile = tuple(int(a) for a in self.profile)
        views = len(profile)
        dims = (self.l,) * views if isinstance(self.l, int) else tuple(self.l)
        object.__setattr__(self, "profile", profile)
        if len(dims) != views:
            raise ValueError(f"l must be one dimension or one per view, {views}, got {self.l!r}")
        if views < 2 or sum(profile) != self.k + 1:
            raise ValueError(f"the profile must have two entries or more, of sum k + 1 = {self.k + 1}, got {profile}")
        if any(not 1 <= a <= d for a, d in zip(profile, dims, strict=True)):
            raise ValueError(f"entries of the profile must be 1 to the dimension of their view {dims}, got {profile}")
        if self.dual and max(profile) > 1:
            raise ValueError(f"dual views take one hyperplane each, got the profile {profile}; use all ones")

    @property
    def dims(self) -> tuple[int, ...]:
        """Dimension of each view."""
        return (self.l,) * len(self.profile) if isinstance(self.l, int) else tuple(self.l)

    @property
    def sizes(self) -> tuple[int, ...]:
        """Rows of each projection."""
        return tuple(d + 1 for d in self.dims)

    @property
    def primitives(self) -> tuple[Primitive, ...]:  # type: ignore[override]
        if self.dual:
            return tuple(Point(d) for d in self.dims)
        return tuple(HyperplanesThrough(d, a) for d, a in zip(self.dims, self.profile, strict=True))

    @property
    def motion(self) -> tuple[Frame, ...]:  # type: ignore[override]
        return tuple(Frame(view, dual=self.dual) for view in range(len(self.profile)))

    @property
    def dof(self) -> int:  # type: ignore[override]
        """Entries of the projections up to scale, less a collineation of :math:`P^k`."""
        return sum(m * (self.k + 1) - 1 for m in self.sizes) - (self.k + 1) ** 2 + 1

    @property
    def codim(self) -> int:  # type: ignore[override]
        """Coordinates of all views, less those of the point; hyperplanes fulfil one condition each."""
        return (len(self.profile) if self.dual else sum(self.dims)) - self.k

    def minimal(self) -> int:
        r"""Fewest matches that determine the tensor linearly.

        The rows of j matches have in common what their common hyperplanes give, :math:`\prod_i \binom{l_i + 1 - j}{\alpha_i}`
        dimensions, so n matches have rank :math:`\sum_j (-1)^{j+1} \binom{n}{j} \prod_i \binom{l_i + 1 - j}{\alpha_i}`.
        """
        if self.dual:
            return self.width() - 1
        orders = range(1, min(self.dims) + 1)
        shared = [prod(comb(d + 1 - j, a) for d, a in zip(self.dims, self.profile, strict=True)) for j in orders]
        n, rank = 0, 0
        while rank < self.width() - 1:
            n += 1
            rank = sum((-1) ** j * comb(n, j + 1) * common for j, common in enumerate(shared))
        return n

    def compose(self, *projections: Tensor) -> Tensor:
        """The Grassmann tensor of projections ``(*batch, l_i + 1, k + 1)``, norm 1; zero for projections of a common null vector.

        Example:
            >>> import torch
            >>> P = torch.rand(2, 3, 4, generator=torch.Generator().manual_seed(0))
            >>> GrassmannTensor(3, (2, 2)).compose(*P).norm().round(decimals=4)
            tensor(1.)
        """
        return unit_tensors(grassmann_tensor(projections, self.profile), len(self.profile))

    def decompose(self, tensor: Tensor) -> tuple[Tensor, ...]:
        r"""The projections of the nearest Grassmann tensor, in closed form for a tensor that is one.

        Args:
            tensor: ``(*batch, binomial(l_1 + 1, alpha_1), ...)`` of any scale.

        Returns:
            :math:`M_i`, ``(*batch, l_i + 1, k + 1)``, norm 1, in a frame of :math:`P^k` in which their stack is balanced; zero
            for a zero tensor.  Differentiable, up to that frame.

        Example:
            >>> import torch
            >>> engine = GrassmannTensor(4, (2, 2, 1))
            >>> M = torch.rand(3, 3, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
            >>> A = engine.compose(*M)
            >>> bool(torch.allclose(engine.compose(*engine.decompose(A)).abs(), A.abs()))
            True
        """
        projections = projections_of(tensor.double(), self.profile, self.sizes)
        return tuple(part.to(tensor.dtype) for part in projections)

    def starts(self, tensor: Tensor) -> tuple[Tensor, ...]:
        """Projections of the tensor in closed form, ``(tries, *batch, l_i + 1, k + 1)``, which noise moves apart.

        Robust estimation is not guided by motions then.  Measured at 5 to 40 % outliers: as many successes without, in a fifth
        (:math:`P^6`) to a twentieth (:math:`P^4`) of the time.
        """
        return candidates(tensor, self.profile, self.sizes)

    def compose_derivative(self, motion: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
        return normalized_derivative(*grassmann_derivative(motion, self.profile))

    def whitened_residual(self, motion: tuple[Tensor, ...], views: tuple[Tensor, ...], scales: tuple[Tensor, ...]) -> Tensor | None:
        """The reprojection error that is left when the point is eliminated; None where one condition is all there is."""
        return None if self.single() else reprojection.residual(motion, views, scales)

    def linearize(
        self, motion: tuple[Tensor, ...], views: tuple[Tensor, ...], scales: tuple[Tensor, ...]
    ) -> tuple[Tensor, Tensor] | None:
        return None if self.single() else reprojection.residual_derivative(motion, views, scales)

    def __repr__(self) -> str:
        dims = "" if set(self.dims) == {2} else f", l={self.l}"
        return f"GrassmannTensor({self.k}, {self.profile}{dims}{', dual=True' if self.dual else ''})"
