"""The finite field and its echelon form against Python integers and floating point."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from dyntorch.counting import Field
from dyntorch.counting.exact import Echelon
from dyntorch.counting.ranks import PRIMES
from tests.grid import assert_refused


@pytest.mark.parametrize("prime", [7, *PRIMES])
def test_field_arithmetic_equals_python_integers(prime):
    assert all(prime % divisor for divisor in [2, *range(3, int(prime**0.5) + 1, 2)])
    field = Field(prime, seed=3)
    for inner in (3, 2100):  # few and many entries go different ways
        a, b = field.random(5, inner), field.random(inner, 4)
        expected = [[sum(x * y for x, y in zip(row, column, strict=True)) % prime for column in b.T.tolist()] for row in a.tolist()]
        assert field.product(a, b).tolist() == expected
        assert field.product(a, b[:, 0]).tolist() == [row[0] for row in expected]
        assert field.product(a[0], b).tolist() == expected[0]
    largest = np.full((2, 2048), prime - 1)
    assert (field.product(largest, largest.T) == 2048 % prime).all()  # (-1)(-1), 2048 times
    x, y = field.random(2, 3), field.random(2, 2)
    rows = [[i * j % prime for i in p for j in q] for p in x.tolist() for q in y.tolist()]
    assert field.kron(x, y).tolist() == rows


def test_join_has_the_order_and_signs_of_minors():
    field = Field(PRIMES[0])
    assert field.join([[1, 0, 0, 0], [0, 1, 0, 0]]).tolist() == [1, 0, 0, 0, 0, 0]
    points = np.array([[2, 3, 5, 7], [11, 13, 17, 19], [23, 29, 31, 37]])
    for size in (1, 2, 3):
        chosen = [round(np.linalg.det(points[:size][:, list(columns)])) for columns in combinations(range(4), size)]
        signed = field.join(points[:size])
        assert np.where(signed > PRIMES[0] // 2, signed - PRIMES[0], signed).tolist() == chosen


def test_null_space_and_inverse():
    field = Field(PRIMES[1], seed=1)
    matrix = field.product(field.random(5, 2), field.random(2, 6))
    basis = field.null(matrix)
    assert basis.shape == (4, 6)
    assert not field.product(matrix, basis.T).any()
    square = field.random(5, 5)
    assert (field.product(square, field.inverse(square)) == np.eye(5)).all()
    assert_refused((lambda: field.inverse([[1, 2], [2, 4]]), "no inverse"), (lambda: Field(2**31 + 11), "prime must lie"))


def test_echelon_says_which_rows_raise_the_rank_however_they_are_grouped():
    field = Field(11, seed=5)
    rows = field.product(field.random(30, 6), field.random(6, 9))
    rows[3], rows[4] = 0, rows[1]
    one, many = Echelon(field, 9), Echelon(field, 9)
    singly = np.concatenate([one.add(row[None]) for row in rows])
    assert (many.add(rows) == singly).all()
    assert singly.sum() == one.rank == many.rank <= 6
    for i in range(len(rows)):  # the first rows up to i, counted anew
        fresh = Echelon(field, 9)
        fresh.add(rows[: i + 1])
        assert fresh.rank == singly[: i + 1].sum()
    identity = many.basis[:, many.pivots]
    assert (identity == np.eye(many.rank)).all()
    generator = np.random.default_rng(0)
    matrix = generator.integers(-3, 4, (6, 4)) @ generator.integers(-3, 4, (4, 7))
    small = Echelon(Field(PRIMES[0]), 7)
    small.add(small.field.reduce(matrix))
    assert small.rank == np.linalg.matrix_rank(matrix.astype(float))
