"""Dimension of the span of all tensor products of m vectors that lie in a common k-dimensional space."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from fractions import Fraction
from math import comb, factorial, prod

DIGITS, HOOKS = 1_000_000, 10_000_000
"""Bits of a dimension, and hooks (m for each partition) multiplied within half a minute, at most."""


def dim_v(n: int, m: int, k: int) -> int:
    r"""Dimension of :math:`V(n,m,k) = \mathrm{Span}\{v_1\otimes\cdots\otimes v_m : \dim\mathrm{Span}\{v_i\} \le k\}`.

    With :math:`f_\lambda` standard and :math:`d_\lambda(n)` semi-standard tableaux of a partition, counted by hook lengths,

    .. math:: \dim V(n,m,k) = \sum_{\lambda \vdash m,\ \mathrm{len}\,\lambda \le k} f_\lambda\, d_\lambda(n),\qquad
        f_\lambda = \frac{m!}{\prod h_{ij}},\quad d_\lambda(n) = \prod_{(i,j)} \frac{n - i + j}{h_{ij}}.

    It is the rank that points of :math:`P^{n-1}` reach in ``m`` views when each moves within its own extensor of step ``k``
    (1 stays fixed, 2 moves on a line, 3 in a plane).  Any ``n`` and ``m`` do; the thesis's condition n >= m is not needed.

    Args:
        n: dimension of the space, at least 1.
        m: number of vectors, at least 1.
        k: dimension of the common span, at least 0; ``k >= m`` gives ``n**m``.

    Returns:
        The dimension.

    Raises:
        ValueError: a number that is too small or not an integer, or numbers so large that the sum would not end.

    Source: thesis sections 9.1 and 9.4 (claim 1, where "s_lambda" must read d_lambda(n)).

    Example:
        >>> dim_v(3, 3, 2), dim_v(4, 3, 2), dim_v(3, 4, 2)
        (26, 60, 72)
    """
    _check(n=(n, 1), m=(m, 1), k=(k, 0))
    if n.bit_length() * m > DIGITS:
        raise ValueError(f"the dimension of V({n}, {m}, {k}) may have more than {DIGITS:,} bits; take a smaller n or m")
    if k >= m:
        return int(n**m)
    if _has_many_hooks(m, min(k, n)):
        raise ValueError(
            f"{m} has too many partitions into up to {min(k, n)} parts, more than {HOOKS // m:,}; take a smaller m, or n or k"
        )
    # more than n parts have no semi-standard tableau: left out, m = 100 takes no time in small spaces
    return sum(standard_tableaux(shape) * semistandard_tableaux(shape, n) for shape in partitions(m, min(k, n)))


def dim_v_closed_form(n: int, m: int, codim: int) -> int:
    r"""Dimension of :math:`V(n,m,m-c)` for ``c`` = 1, 2, 3 without a sum over partitions.

    .. math:: n^m - \tbinom nm,\qquad n^m - \tbinom nm - (m-1)^2\tbinom{n+1}m,\qquad
        n^m - \tbinom nm - (m-1)^2\tbinom{n+1}m - \tbinom{m-1}2^2\tbinom{n+2}m - \tfrac{m(m-3)^2 n}4 \tbinom{n+1}{m-1}.

    Binomials outside their range are 0, and so is the last term at m = 3.

    Args:
        n: dimension of the space, at least 1.
        m: number of vectors, at least ``codim``.
        codim: 1, 2 or 3: how much smaller than ``m`` the common span is.

    Returns:
        The dimension, equal to ``dim_v(n, m, m - codim)``.

    Raises:
        ValueError: another ``codim``, or a number that is too small.

    Source: thesis section 9.4.1.

    Example:
        >>> dim_v_closed_form(3, 3, 1), dim_v_closed_form(3, 4, 2), dim_v_closed_form(4, 3, 2)
        (26, 72, 20)
    """
    if isinstance(codim, bool) or codim not in (1, 2, 3):
        raise ValueError(f"codim must be 1, 2 or 3, got {codim!r}; dim_v(n, m, k) takes any k")
    _check(n=(n, 1), m=(m, codim))
    if n.bit_length() * m > DIGITS:
        raise ValueError(f"n**m has more than {DIGITS:,} bits for n = {n}, m = {m}; take a smaller n or m")
    missing = Fraction(comb(n, m))
    if codim >= 2:
        missing += (m - 1) ** 2 * comb(n + 1, m)
    if codim == 3:
        missing += comb(m - 1, 2) ** 2 * comb(n + 2, m) + Fraction(m * (m - 3) ** 2 * n * comb(n + 1, m - 1), 4)
    return int(n**m - missing)


def partitions(m: int, parts: int | None = None, largest: int | None = None) -> Iterator[tuple[int, ...]]:
    """Partitions of ``m`` into non-increasing parts: at most so many of them, none above ``largest``.

    Example:
        >>> list(partitions(4)), list(partitions(5, parts=2))
        ([(4,), (3, 1), (2, 2), (2, 1, 1), (1, 1, 1, 1)], [(5,), (4, 1), (3, 2)])
    """
    if m == 0:
        yield ()
    elif parts != 0:
        for first in range(m if largest is None else min(m, largest), 0, -1):
            for rest in partitions(m - first, None if parts is None else parts - 1, first):
                yield (first, *rest)


def _has_many_hooks(m: int, parts: int) -> bool:
    """Whether the partitions of m into so many parts have more than HOOKS hooks."""
    ways = [1] + [0] * m  # by parts of sizes up to the current one, as many as of up to so many parts
    for size in range(1, min(parts, m) + 1):
        for total in range(size, m + 1):
            ways[total] += ways[total - size]
        if ways[m] * m > HOOKS:
            return True
    return False


def standard_tableaux(shape: Sequence[int]) -> int:
    """Number of fillings by 1..m with rows and columns increasing (hook length formula).

    Example:
        >>> standard_tableaux((2, 1))
        2
    """
    return factorial(sum(shape)) // prod(_hooks(shape))


def semistandard_tableaux(shape: Sequence[int], n: int) -> int:
    """Number of fillings by 1..n with rows non-decreasing and columns increasing (hook content formula).

    Example:
        >>> semistandard_tableaux((2, 1), 3)
        8
    """
    contents = (n - i + j for i, length in enumerate(shape) for j in range(length))
    return prod(contents) // prod(_hooks(shape))


def _hooks(shape: Sequence[int]) -> list[int]:
    columns = [sum(length > j for length in shape) for j in range(max(shape, default=0))]
    return [length - j + columns[j] - i - 1 for i, length in enumerate(shape) for j in range(length)]


def _check(**least: tuple[int, int]) -> None:
    for name, (value, lowest) in least.items():
        if isinstance(value, bool) or not isinstance(value, int) or value < lowest:
            raise ValueError(f"{name} must be an integer of at least {lowest}, got {value!r}")
