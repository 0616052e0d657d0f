"""The promises of :mod:`tests.indexing.estimators` for every indexer."""

from __future__ import annotations

import inspect

import pytest

from tests.indexing.estimators import CASES, CHECKS

SLOW = ("one_example_of_each_class_is_enough", "an_accelerator_answers_the_same")
"""Promises that take many fits."""


@pytest.mark.parametrize(
    ("case", "check"),
    [
        pytest.param(case, check, id=f"{case.name}-{check.__name__}", marks=pytest.mark.slow if check.__name__ in SLOW else ())
        for case in CASES
        for check, applies in CHECKS
        if applies(case)
    ],
)
def test_promise(case, check, tmp_path):
    needs_a_folder = "path" in inspect.signature(check).parameters
    check(case, tmp_path) if needs_a_folder else check(case)
