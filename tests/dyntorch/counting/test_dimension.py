"""Dimensions of V(n, m, k): the literature, closed forms, brute force, tableaux by enumeration."""

from __future__ import annotations

from itertools import product
from math import comb

import pytest

from dyntorch.counting import count, dim_v, dim_v_closed_form, partitions, semistandard_tableaux, standard_tableaux
from tests.grid import assert_refused


def test_dimensions_are_those_of_the_literature_and_of_the_limits():
    quoted = [(3, 3, 2), (4, 3, 2), (3, 3, 1), (4, 3, 1), (3, 4, 2), (2, 3, 2), (2, 3, 1), (4, 4, 3), (4, 4, 2)]
    assert [dim_v(n, m, k) for n, m, k in quoted] == [26, 60, 10, 20, 72, 8, 4, 255, 210]
    for n, m in product(range(1, 6), range(1, 6)):
        assert dim_v(n, m, 0) == 0
        assert dim_v(n, m, 1) == comb(n + m - 1, m)  # symmetric tensors
        assert dim_v(n, m, m) == dim_v(n, m, m + 3) == n**m
        assert dim_v(n, m, n) == n**m  # n vectors span everything
    # the thesis asks n >= m >= k and uses V(2,3,2) and V(3,4,2)
    assert dim_v(2, 3, 2) == count(1, views=[1, 1, 1], r=2).rank == 8
    assert dim_v(3, 4, 2) == count(2, views=[2] * 4, r=2).rank == 72


def test_closed_forms_equal_the_sum_and_tableaux_fill_the_space():
    checked = 0
    for n, m, codim in product(range(1, 7), range(1, 7), (1, 2, 3)):
        if m >= codim:
            assert dim_v_closed_form(n, m, codim) == dim_v(n, m, m - codim)
            checked += 1
    assert checked == 6 * (6 + 5 + 4)
    for n, m in product(range(1, 6), range(1, 8)):
        assert sum(standard_tableaux(shape) * semistandard_tableaux(shape, n) for shape in partitions(m)) == n**m
    assert dim_v(3, 100, 1) == comb(102, 2)  # short partitions only, of 190 million


@pytest.mark.slow
@pytest.mark.parametrize("n", range(1, 6))
def test_dimension_equals_brute_force_rank(n):
    for m in range(1, 6):
        for k in range(1, m + 1):
            if n**m <= 700:
                assert count(n - 1, views=[n - 1] * m, r=min(k, n)).rank == dim_v(n, m, k), (n, m, k)


def tableaux(shape, n, strict_rows):
    """Fillings by 1..n with increasing columns, by trying them all."""
    boxes = [(i, j) for i, length in enumerate(shape) for j in range(length)]
    good = 0
    for values in product(range(n), repeat=len(boxes)):
        at = dict(zip(boxes, values, strict=True))
        columns = all(at[i, j] < at[i + 1, j] for i, j in boxes if (i + 1, j) in at)
        rows = all(at[i, j] + strict_rows <= at[i, j + 1] for i, j in boxes if (i, j + 1) in at)
        good += columns and rows and (not strict_rows or len(set(values)) == len(boxes))
    return good


@pytest.mark.parametrize("m", [1, 2, 3, 4, 5])
def test_hook_lengths_equal_enumeration(m):
    for shape in partitions(m):
        assert standard_tableaux(shape) == tableaux(shape, m, 1)
        assert semistandard_tableaux(shape, 3) == tableaux(shape, 3, 0)


def test_excluded_partitions_are_those_of_smaller_numbers_only_up_to_2k_plus_2():
    """The thesis states it for all m."""
    number = [len(list(partitions(size))) for size in range(9)]
    for m in range(1, 9):
        for k in range(1, m + 1):
            excluded = sum(len(shape) > k for shape in partitions(m))
            assert (excluded == sum(number[: m - k])) == (m <= 2 * k + 2), (m, k)
    assert sum(len(shape) > 1 for shape in partitions(5)) == 6 != sum(number[:4])


def test_dimension_misuse():
    assert_refused(
        (lambda: dim_v(0, 3, 2), "n must be an integer of at least 1, got 0"),
        (lambda: dim_v(3, 3, -1), "k must be"),
        (lambda: dim_v(3, 2.5, 1), "m must be"),
        (lambda: dim_v(True, 3, 1), "n must be"),
        (lambda: dim_v_closed_form(3, 3, 4), "codim must be 1, 2 or 3, got 4"),
        (lambda: dim_v_closed_form(3, 2, 3), "m must be an integer of at least 3"),
    )
