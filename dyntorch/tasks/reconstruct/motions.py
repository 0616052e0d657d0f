"""How a moving point of the scene is a static point of a higher projective space: motions, and what follows from their lifts."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import lru_cache
from math import comb

import torch
from torch import Tensor

from dyntorch import counting
from dyntorch.counting.exact import IntArray, Views
from dyntorch.geometry.lift import gauge_algebra, least_views
from dyntorch.invariants.grassmann_tensor import GrassmannTensor
from dyntorch.tasks.reconstruct.motion_models import AUXILIARY_MODELS, MOTION_MODELS, MotionModel, SmallerModel

Lift = Callable[[Tensor], Tensor]

STENCIL = ((-2, 1 / 12), (-1, -2 / 3), (1, 2 / 3), (2, -1 / 12))
"""Central differences of fourth order, exact for motions that are polynomials of the time."""
STEP = 1e-2
"""Step of these differences over the mean spacing of the views."""
COUNTED = 1024
"""Unknowns of a tensor up to which its matches are counted exactly: 0.1 s for 81, 10 s for 1000."""
SPARE = 8
"""Matches beyond those of general projections that are looked at."""
RANK = 1e-13
"""Relative singular value below which a row of a lift depends on the others."""


@dataclass(frozen=True)
class Motion:
    r"""A motion model: the position at time t is :math:`X(t) \sim B(t)\,Y`, linear in the unknown constants Y of a point.

    Everything else follows from the lift B: the space :math:`P^k` of the constants, the Grassmann tensor, how many views and
    matches are needed, and what no view can tell.

    Args:
        lift: B, takes one time (a scalar tensor) and returns ``(d + 1, K)``; the world has dimension d, the last row gives its
            homogeneous coordinate.  K = d + 1 leaves nothing to see in the motion: a static model, of points that stand still or
            move in one known way.
        name: for messages.
        sensor: dimension of what a view measures, 2 for images, 3 for 3D sensors.
        leaves_open: the ambiguity that remains, in words; by default :meth:`open_text` counts its dimensions.
        bodies: 2 for two bodies in relative translation at arbitrary steps, which need no lift (``k`` instead).
        k: dimension of the space of the constants, where there is no lift.
        static: whether the points do not move at all: the times do not matter, no frame is chosen in which they move least.
        shift: takes c and returns :math:`R(c)`, ``(K, K)`` float64, with :math:`B(t + c) = B(t)\,R(c)` for all t, where there is
            one (for polynomials: :func:`polynomial_shift`): then times far from 0 lose no digits.
        metric_open: the ambiguity that remains with calibrated cameras, in words.
        purpose: what the points do, one sentence.
        smaller: models of fewer unknowns that make this one degenerate where they explain the tracks.

    Raises:
        ValueError: a lift that does not return, at time 0, a finite real matrix of full rank with no fewer columns than rows, or
            neither lift nor k.

    Source: thesis chapter 3.

    Example:
        >>> import torch
        >>> def falling(t):  # in a plane, the same unknown acceleration direction e_2 for all, each with its own strength
        ...     B = torch.zeros(3, 4, dtype=torch.float64)
        ...     B[:, :3] = torch.eye(3)
        ...     B[1, 3] = t**2
        ...     return B
        >>> Motion(falling, "falling").minimal([0.0, 1.0, 2.0])
        (3, 7)
    """

    lift: Lift | None = None
    name: str = "custom"
    sensor: int = 2
    leaves_open: str = ""
    bodies: int = 1
    k: int = 0
    static: bool = False
    shift: Callable[[float], Tensor] | None = None
    metric_open: str = ""
    purpose: str = ""
    smaller: tuple[SmallerModel, ...] = ()

    def __post_init__(self) -> None:
        if self.lift is None and self.k < 2:
            raise ValueError(f"Motion takes a lift, or k >= 2 for bodies without one, got k={self.k}")
        if self.lift is not None:
            if not callable(self.lift):
                raise ValueError(f"lift must be a function of one time, got {self.lift!r}")
            matrix = self.lift(torch.zeros((), dtype=torch.float64))
            if not isinstance(matrix, Tensor) or matrix.ndim != 2 or not 2 <= matrix.shape[0] <= matrix.shape[1]:
                got = tuple(matrix.shape) if isinstance(matrix, Tensor) else type(matrix).__name__
                raise ValueError(f"the lift of {self.name!r} must return a tensor (d + 1, K) with K >= d + 1 > 1, got {got}")
            if matrix.is_complex():
                raise ValueError(f"the lift of {self.name!r} must be real, got {matrix.dtype}")
            object.__setattr__(self, "k", int(matrix.shape[1]) - 1)
            self.centred_lifts([0.0])

    @property
    def dim(self) -> int:
        """Dimension d of the world."""
        return self.k - 1 if self.lift is None else int(self._at(0.0).shape[0]) - 1

    def lifts(self, times: Tensor | Sequence[float]) -> Tensor:
        """The lifts ``(views, d + 1, K)`` at these times, float64.

        Raises:
            ValueError: no lift, or one that changes its shape or is not finite.
        """
        if self.lift is None:
            raise ValueError(f"{self.name!r} has no lift")
        found = [self._at(float(t)) for t in times]
        for time, matrix in zip(times, found, strict=True):
            where = f"at time {float(time):g}; the positions at time 0 and the views need it"
            if matrix.shape != found[0].shape:
                raise ValueError(f"the lift of {self.name!r} has another shape, {tuple(matrix.shape)}, {where}")
            if not bool(matrix.isfinite().all()):
                raise ValueError(f"the lift of {self.name!r} is not finite {where}")
        return torch.stack(found)

    def centred_lifts(self, times: Tensor | Sequence[float]) -> tuple[Tensor, Tensor, float]:
        """Lifts at times counted from c, ``(views, d + 1, K)``, the R with ``lifts(times) = centred @ R``, and c.

        c is the mean time where the motion has a :attr:`shift`, else 0.

        Raises:
            ValueError: a lift that loses a dimension of the world at one of these times.
        """
        moments = [float(t) for t in times]
        origin = 0.0 if self.shift is None else sum(moments) / max(1, len(moments))
        lifts = self.lifts([t - origin for t in moments])
        # rows of norm 1: the unit of time does not matter
        ranks = torch.linalg.matrix_rank(torch.nn.functional.normalize(lifts, dim=-1), rtol=RANK)
        for time, rank in zip(moments, ranks.tolist(), strict=True):
            if rank < lifts.shape[1]:
                raise ValueError(f"the lift of {self.name!r} must have rank d + 1 = {lifts.shape[1]}, got {rank} at time {time:g}")
        return lifts, torch.eye(self.k + 1, dtype=torch.float64) if self.shift is None else self.shift(origin), origin

    def slope(self, time: float, spacing: float = 1.0) -> Tensor:
        """The derivative of the lift by the time, ``(d + 1, K)``."""
        if self.shift is not None and time != 0:
            return self.slope(0.0, spacing) @ self.shift(time)  # differences of large numbers would lose digits
        step = STEP * spacing
        return sum((c * self._at(time + i * step) for i, c in STENCIL), torch.zeros(())) / step

    def profile(self, views: int) -> tuple[int, ...]:
        """The profile of so many views: one hyperplane each, then more for the first ones, up to all of a point's."""
        left = self.k + 1 - views
        found = []
        for _ in range(views):
            more = min(self.sensor - 1, left)
            found.append(1 + more)
            left -= more
        return tuple(found)

    def tensor(self, views: int) -> GrassmannTensor:
        """The invariant of so many views, of which at most k + 1 can be used at once."""
        return GrassmannTensor(self.k, self.profile(views), self.sensor)

    def views(self, times: Tensor | Sequence[float]) -> int:
        """Fewest views that determine the scene up to its ambiguity; one more than there are times where they do not suffice."""
        enough = -(-(self.k + 1) // self.sensor)
        if self.lift is None or self.static:
            return max(2, enough)
        return max(2, enough, least_views(self.centred_lifts(times)[0], self.sensor + 1))

    def minimal(self, times: Tensor | Sequence[float]) -> tuple[int, int]:
        """Fewest views, and fewest matches in them.

        Of the declared models the matches are those of general projections, which is what exact ranks of each of them say, too.  Of
        any other lift the ranks are counted, exactly: its views may have centres in special position, and then it takes more.
        """
        views = self.views(times)
        tensor = self.tensor(min(views, self.k + 1))
        if self.lift is None or MOTIONS.get(self.name) is self or tensor.width() > COUNTED:
            return views, tensor.minimal()
        lifts = self.centred_lifts(times)[0][: len(tensor.profile)]
        return views, _count_matches(tensor.profile, self.sensor, tuple(tuple(map(tuple, lift)) for lift in lifts.tolist()))

    def min_views_and_tracks(self, times: Tensor | Sequence[float]) -> tuple[int, int]:
        """Fewest views and tracks of a reconstruction: :meth:`minimal`, and what tells two bodies apart."""
        views, matches = self.minimal(times)
        return views, max(matches, (self.k + 1) * (self.k + 2) // 2 - 1 if self.bodies > 1 else 0)

    def ambiguity(self, times: Tensor | Sequence[float]) -> int:
        """Dimension of the ambiguity from views at these times; without a lift that of the projections, all collineations."""
        return (self.k + 1) ** 2 - 1 if self.lift is None else len(gauge_algebra(self.centred_lifts(times)[0])) - 1

    def open_text(self, times: Tensor | Sequence[float]) -> str:
        """The ambiguity from views at these times in words: :attr:`leaves_open`, or its dimension.

        Example:
            >>> Motion(polynomial(2, 1)).open_text([0.0, 1.0, 2.0])
            'an ambiguity of 8 dimensions that the lift leaves open'
        """
        if self.leaves_open or self.lift is None:
            return self.leaves_open
        return f"an ambiguity of {self.ambiguity(times)} dimensions that the lift leaves open"

    def _at(self, time: float) -> Tensor:
        assert self.lift is not None
        return self.lift(torch.tensor(time, dtype=torch.float64)).to(torch.float64)

    def __repr__(self) -> str:
        return f"Motion({self.name})"


@lru_cache(maxsize=64)
def _count_matches(profile: tuple[int, ...], sensor: int, lifts: tuple[tuple[tuple[float, ...], ...], ...]) -> int:
    """Matches that determine the tensor of views at random places with these lifts; what general ones take where none do."""
    k = len(lifts[0][0]) - 1
    tensor = GrassmannTensor(k, profile, sensor)

    def points(field: counting.Field) -> Iterator[IntArray]:
        # a number of the machine is a fraction, and that has a place in every field
        parts = [[[Fraction(x) for x in row] for row in lift] for lift in lifts]
        known = [[[f.numerator * pow(f.denominator, -1, field.prime) % field.prime for f in row] for row in lift] for lift in parts]
        cameras = [field.product(field.random(sensor + 1, len(lift)), lift) for lift in known]
        views = Views(field, k, (sensor,) * len(profile), profile, cameras)
        while True:
            yield views.static_rows(field.random(k + 1)[None])

    least = tensor.minimal()
    found = counting.count(points, matches=least + SPARE)
    return found.minimal if found.rank == tensor.width() - 1 else least


def polynomial(dim: int, directions: int, degree: int = 1) -> Lift:
    """The lift of points of a world of some dimension whose first coordinates are polynomials of the time."""
    eye = torch.eye(dim + 1, dtype=torch.float64)

    def lift(time: Tensor) -> Tensor:
        return torch.cat([eye, *(eye[:, :directions] * time.to(eye) ** n for n in range(1, degree + 1))], dim=1)

    return lift


def polynomial_shift(dim: int, directions: int, degree: int = 1) -> Callable[[float], Tensor]:
    """The shift of :func:`polynomial`: the coefficients of a polynomial of t + c."""
    eye = torch.eye(dim + 1, dtype=torch.float64)[:, :directions]

    def shift(c: float) -> Tensor:
        size = dim + 1 + degree * directions
        matrix = torch.eye(size, dtype=torch.float64)
        place = [dim + 1 + (n - 1) * directions for n in range(1, degree + 1)]
        for n, column in enumerate(place, start=1):
            matrix[: dim + 1, column : column + directions] = c**n * eye
            for m, row in enumerate(place[: n - 1], start=1):
                block = comb(n, m) * c ** (n - m) * torch.eye(directions, dtype=torch.float64)
                matrix[row : row + directions, column : column + directions] = block
        return matrix

    return shift


def _make_motion(model: MotionModel) -> Motion:
    """The motion of an entry of :mod:`~dyntorch.tasks.reconstruct.motion_models`."""
    shape = model.dim, model.directions, model.degree
    if model.bodies > 1:
        motion = Motion(None, model.name, model.sensor, bodies=model.bodies, k=model.dim + 1)
    elif (rows := model.lift) is not None:
        motion = Motion(lambda time: torch.tensor(rows(float(time)), dtype=torch.float64), model.name, model.sensor)
    else:
        static = model.directions == 0
        motion = Motion(polynomial(*shape), model.name, model.sensor, static=static, shift=polynomial_shift(*shape))
    return replace(
        motion, leaves_open=model.leaves_open, metric_open=model.metric_open, purpose=model.purpose, smaller=model.smaller
    )


MOTIONS: dict[str, Motion] = {model.name: _make_motion(model) for model in MOTION_MODELS}
"""The declared models, see :mod:`~dyntorch.tasks.reconstruct.motion_models`.  ``constant_direction``: all points move along one
common, unknown direction; ``planes``: within parallel planes."""
_ALL = MOTIONS | {model.name: _make_motion(model) for model in AUXILIARY_MODELS}


def smaller_motion(smaller: SmallerModel) -> Motion:
    """The motion that a larger one is compared with."""
    return _ALL[smaller.name]


def motion_table() -> str:
    """The declared models with the views and tracks that they take at least, and what the points do.

    Example:
        >>> print(motion_table().splitlines()[3])
        constant_velocity_2d            3 views   13 tracks   The points move in a plane, each at its own constant velocity.
    """
    needs = {motion.name: motion.min_views_and_tracks(range(12)) for motion in MOTIONS.values()}
    return "\n".join(
        f"{name:<30}{needs[name][0]:>3} views{needs[name][1]:>5} tracks   {motion.purpose}" for name, motion in MOTIONS.items()
    )


def as_motion(motion: str | Motion) -> Motion:
    """The declared model of that name, or the model itself."""
    if isinstance(motion, Motion):
        return motion
    if motion not in MOTIONS:
        raise ValueError(f"motion must be 'auto', a dyntorch.Motion or one of {', '.join(MOTIONS)}, got {motion!r}")
    return MOTIONS[motion]
