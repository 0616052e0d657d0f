"""Exact rank of the estimation matrix of any configuration of matches."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, overload

import numpy as np

from dyntorch.counting.configurations import CONFIGURATIONS, by_numbers
from dyntorch.counting.exact import Configuration, Field, IntArray, Kind, Measure, Step, Tally
from dyntorch.counting.lifted import SETTINGS

PRIMES = (2**31 - 1, 2**31 - 19)  # the second one rules out a rank that only the first one lowers
SAMPLER_PATIENCE = 1000  # a sampler's matches need not be in general position: many on one line may add nothing
MOST = 1_000_000  # matches of one kind; their profile is 8 MB

Sampler = Callable[[Field], Iterable[Any]]


@dataclass(frozen=True)
class Count:
    """Exact rank of an estimation matrix.

    Args:
        name: of the configuration.
        width: number of unknowns, the length of a row.
        rank: of the matrix.
        nullity: ``width - rank``, the number of independent tensors that satisfy all matches.
        minimal: number of matches that this rank takes: those, in the order given, that raise it.
        profile: rank after each match.
        kinds: what each kind of matches adds, in the order counted.
        usual: the kind of match that the configuration is usually estimated from.
        full: rank that more matches of the usual kind reach; None for a sampler, which says nothing about other matches.
        missing: how many more of them that takes (0: these matches determine as much as any do); None for a sampler.
        agreed: whether two primes gave the same rank; if not, this is the larger one, as a sample never exceeds the truth.
    """

    name: str
    width: int
    rank: int
    nullity: int
    minimal: int
    profile: tuple[int, ...] = dataclasses.field(repr=False)
    kinds: tuple[Kind, ...] = dataclasses.field(repr=False)
    usual: str
    full: int | None
    missing: int | None
    agreed: bool

    def __str__(self) -> str:
        given = len(self.profile)
        taken = f"{self.minimal}" if self.minimal == given else f"{self.minimal} of {given}"
        text = f"{self.name}: rank {self.rank} of {self.width}, nullity {self.nullity}, from {taken} matches"
        if len(self.kinds) > 1:
            parts = (f"{kind.useful} of {kind.matches} {kind.name} (rank {kind.rank})" for kind in self.kinds)
            text += ": " + ", ".join(parts)
        if self.missing:
            text += f"; rank {self.full} takes {self.missing} more {self.usual}"
        return text


@overload
def count(what: str, /, *, seed: int = 0, **options: int | str | Sequence[int] | None) -> Count: ...
@overload
def count(
    what: int, /, *, views: Sequence[int] = (), m: int = 1, r: int = 1, measure: Measure | Sequence[Measure] = "join",
    matches: int | None = None, profile: Sequence[int] = (), static: int = 0, on_plane: int = 0, on_line: int = 0, seed: int = 0,
) -> Count: ...  # fmt: skip
@overload
def count(what: Sampler, /, *, matches: int | None = None, seed: int = 0) -> Count: ...
def count(what: str | int | Sampler, /, *, seed: int = 0, **options: Any) -> Count:
    r"""Exact rank, nullity and minimal number of matches of a configuration, over a prime field.

    Random matches in :math:`GF(2^{31}-1)` have the rank of general position with probability at least
    :math:`1 - \mathrm{rank} \cdot \mathrm{degree} / p` (Schwartz-Zippel, above 0.99999 here); a second prime confirms it.

    **A name** of :data:`CONFIGURATIONS`, with the number of matches of each kind, such as ``moving=30, static=2``.  Of the first
    kind, None means as many as raise the rank, and so does no number at all.  Lists give the number of points on each of several
    ``lines``, or of lines on each of several translating ``objects``.  ``labelled_static`` are known to be static, ``static``
    are not.  Of points, ``on_plane`` and ``on_line`` say how many stay on one plane or line, wherever they move in it, and
    ``static_on_plane``, ``static_on_line`` how many stand still there.  The motion models of :func:`dyntorch.reconstruct` also take
    the ``profile`` of their tensor, the ``times`` of the views (by default random) and the path of the ``camera``: ``"generic"``,
    ``"fixed"``, ``"constant_velocity"``, or ``"along"`` the motion.

    **Numbers**: ``count(k, views=[l1, l2, ...], m=, r=, measure=)``, and ``count(k, profile=[a1, a2, ...])`` for the
    Grassmann tensor of points in views of the plane, or in ``views=``.  A primitive spanned by ``m`` points is, in every view
    anew, anywhere within a random extensor of ``r`` points of :math:`P^k` (r = m: it stays; m = 1, r = 2: a point on a line), and
    seen through random projections :math:`P^k \to P^{l_v}`.  A view measures its Pluecker coordinates (``"join"``) or the
    hyperplanes that contain it (``"hyper"``); one word for all views, or one for each.  A profile says how many of these
    hyperplanes are taken at once.  Some primitives may be ``static``, or stay ``on_line``, or ``on_plane`` (in one hyperplane).

    **A sampler** for anything else: a function that takes a :class:`Field` and returns an iterable, usually a generator, of the
    rows of each match, ``(width,)`` or ``(rows, width)`` integers, taken modulo ``field.prime``.  It is called once per prime.
    What it draws before the first ``yield`` is common to all matches: cameras (given ones, too: any integers), a trajectory
    line, a translation.  Counting stops after ``matches`` of them or, without this number, where it ends or after 1000 in a
    row that add nothing.  A labelled static point gives ``field.kron`` of two images and an identity matrix, in each order.

    Args:
        what: name of a configuration, dimension ``k`` of the space, or sampler.
        views: projective dimension of each view.
        m: points that span the measured primitive: 1 for points, 2 for lines.
        r: points that span the extensor in which it moves.
        measure: ``"join"`` or ``"hyper"``, for all views or for each.
        matches: how many; by default as many as raise the rank.
        profile: hyperplanes through the primitive in each view, instead of ``measure``; constraints need k + 1 in all.
        seed: of the random matches.
        **options: of a named configuration, the number of matches of each kind.

    Returns:
        A :class:`Count`.

    Raises:
        ValueError: an unknown name or option, numbers that make no sense, or rows that are no integers or differ in width.

    Source: thesis chapter 9; the ranks quoted in its chapters 3 and 8.

    Example:
        >>> print(count("homography", static=12, moving=30))
        homography: rank 26 of 27, nullity 1, from 26 of 42 matches: 10 of 12 static (rank 10), 16 of 30 moving (rank 26)
        >>> count("join").minimal, count("homography", labelled_static=2).missing
        (60, 12)
        >>> count("constant_velocity_3d", static=100).missing, count("constant_velocity_3d", camera="fixed").rank
        (18, 75)
        >>> count(3, views=[2, 2]).rank, count(6, profile=[2, 2, 1, 1, 1]).minimal  # points seen by two cameras, by five
        (8, 31)
        >>> def one_line(field):  # all points on one line of the plane
        ...     line, cameras = field.random(2, 3), field.random(3, 3, 3)
        ...     while True:
        ...         points = field.product(field.random(3, 2), line)
        ...         yield field.kron(*(field.product(camera, point) for camera, point in zip(cameras, points)))
        >>> count(one_line).rank
        8
    """
    name, configure, main = _configuration(what, options)
    if callable(what):
        options["sampler"] = what
    elif not isinstance(what, str):
        options["k"] = what
    _check(name, configure, options)
    if not _is_number(seed):
        raise ValueError(f"seed must be a number from 0 to {MOST:,}, got {seed!r}")
    if isinstance(what, str) and main not in options and any(_counts(name, value) for name, value in options.items()):
        options[main] = 0
    found = [_count(name, configure, Field(prime, [seed, prime]), options) for prime in PRIMES]
    best = max(found, key=lambda result: result.rank)
    return dataclasses.replace(best, agreed=len({result.rank for result in found}) == 1)


@dataclass(frozen=True)
class Capacity:
    """What matches of one kind can tell at most, however many there are.

    Args:
        option: that says how many there are.
        matches: how many of them count.
        rank: that they reach by themselves.
        missing: matches of the usual kind that are needed beside them.
        full: rank that these reach together; less than that of the usual kind alone only if something is wrong.
    """

    option: str
    matches: int
    rank: int
    missing: int
    full: int


def capacities(name: str, *, only: Sequence[str] = (), seed: int = 0, **settings: Any) -> tuple[Capacity, ...]:
    """How many matches of each kind count at most in a named configuration, and what is missing beside them.

    Thesis section 10.1 asks for such conditions on the measurements, "up to 10 points on one hyperplane".

    Args:
        name: one of :data:`CONFIGURATIONS`.
        only: some of its options; all of them by default.
        seed: of the random matches.
        **settings: options that are no matches, such as ``profile`` or ``points``.

    Raises:
        ValueError: an unknown name or option.

    Example:
        >>> {c.option: (c.matches, c.rank, c.missing) for c in capacities("homography")}["static"]
        (10, 10, 16)
        >>> [(c.option, c.matches, c.missing) for c in capacities("fundamental")]
        [('static', 8, 0), ('coplanar', 6, 2), ('on_plane', 6, 2), ('on_line', 3, 5)]
    """
    name, configure, usual = _configuration(name, dict(settings))
    _check(name, configure, settings)
    result = []
    for option, default in _defaults(configure).items():
        if option in SETTINGS or isinstance(default, bool | str) or (only and option not in only):
            continue
        given: dict[str, Any] = {option: (1,) if isinstance(default, tuple) else 1}
        if option != usual:
            given[usual] = None
        result.append(max((_capacity(configure, prime, option, given | settings, seed) for prime in PRIMES), key=lambda c: c.rank))
    return tuple(result)


def _capacity(configure: Configuration, prime: int, option: str, given: dict[str, Any], seed: int) -> Capacity:
    steps = configure(Field(prime, [seed, prime]), **given)
    usual = steps[-1]
    # of defaults, such as the other body's matches, none
    chosen = (
        usual
        if option == next(iter(_defaults(configure)))
        else next(step for step in steps if step.kind.replace(" ", "_") in (option, option.removesuffix("s")))
    )
    tally = Tally(Field(prime, [seed, prime]))
    tally.add_step(dataclasses.replace(chosen, matches=None))
    alone = tally.rank
    matches = sum(kind.useful for kind in tally.kinds)
    others = [step for step in steps if step is not chosen and step is not usual and step.matches]
    for step in (*others, usual):
        if step is not chosen:
            tally.add_step(dataclasses.replace(step, matches=None) if step is usual else step)
    missing = sum(kind.useful for kind in tally.kinds) - matches
    return Capacity(option, matches, alone, missing, tally.rank)


def _counts(option: str, value: Any) -> bool:
    """Whether an option asks for matches."""
    return option not in SETTINGS and value is not True and bool(value)


def _configuration(what: str | int | Sampler, options: dict[str, Any]) -> tuple[str, Configuration, str]:
    """Name, function and usual kind of what is to be counted."""
    if isinstance(what, str):
        if what not in CONFIGURATIONS:
            raise ValueError(f"unknown configuration {what!r}; known are {', '.join(CONFIGURATIONS)}; or pass numbers or a sampler")
        return what, CONFIGURATIONS[what], next(iter(options_of(what)))
    if callable(what):
        return getattr(what, "__name__", "sampler"), _sample, "matches"
    if isinstance(what, bool) or not isinstance(what, int) or what < 0:
        raise ValueError(f"expected the name of a configuration, the dimension of a space or a sampler, got {what!r}")
    if not {"views", "profile"} & options.keys():
        raise ValueError(f"count({what}) needs views, the projective dimension of each, such as views=[2, 2, 2], or a profile")
    return f"P^{what}", by_numbers, "matches"


def options_of(name: str) -> dict[str, Any]:
    """The options of a named configuration with their defaults, the usual kind of match (None: as many as help) first.

    Example:
        >>> options_of("fundamental")
        {'static': None, 'coplanar': 0, 'on_plane': 0, 'on_line': 0}
    """
    return _defaults(CONFIGURATIONS[name])


def _defaults(configure: Configuration) -> dict[str, Any]:
    return {name: option.default for name, option in inspect.signature(configure).parameters.items() if name != "field"}


def _check(name: str, configure: Configuration, options: dict[str, Any]) -> None:
    defaults = _defaults(configure)
    for option, value in options.items():
        if option not in defaults:
            names = [other for other in defaults if other not in ("k", "sampler")]
            raise ValueError(f"{name} has no option {option}; it has {', '.join(names)}")
        if isinstance(defaults[option], tuple):
            if isinstance(value, str) or not isinstance(value, Sequence) or not all(map(_is_number, value)):
                raise ValueError(f"{option} must be a list of numbers from 0 to {MOST:,}, got {value!r}")
        elif isinstance(defaults[option], bool):
            if not isinstance(value, bool):
                raise ValueError(f"{option} must be True or False, got {value!r}")
        elif option == "camera":
            continue  # checked with the others of the views
        elif option not in ("sampler", "measure") and not (value is None is defaults[option]) and not _is_number(value):
            raise ValueError(f"{option} must be a number from 0 to {MOST:,}, got {value!r}")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool) and bool(0 <= value <= MOST)


def _sample(field: Field, *, sampler: Sampler, matches: int | None = None) -> list[Step]:
    rows = iter(sampler(field))

    def draw() -> IntArray:
        return np.atleast_2d(field.reduce(next(rows)))

    return [Step("matches", matches, draw, patience=SAMPLER_PATIENCE if matches is None else matches + 1)]


def _count(name: str, configure: Configuration, field: Field, options: dict[str, Any]) -> Count:
    steps, tally = configure(field, **options), Tally(field)
    for step in steps:
        tally.add_step(step)
    rank, usual = tally.rank, steps[-1]
    more: int | None = 0
    if configure is _sample:
        more = None
    elif usual.matches is not None:
        more = len(set(tally.ranks(dataclasses.replace(usual, matches=None))) - {rank})
    if tally.echelon is None:
        raise ValueError(f"{name} gave no matches, so there is nothing to count")
    return Count(
        name, tally.echelon.width, rank, tally.echelon.width - rank, sum(kind.useful for kind in tally.kinds),
        tuple(tally.profile), tuple(tally.kinds), usual.kind, None if more is None else tally.rank, more, True,
    )  # fmt: skip
