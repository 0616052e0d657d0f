"""The promises of :mod:`tests.indexing.estimators` for every indexer."""

from __future__ import annotations

import inspect

import pytest

from tests.indexing.estimators import CASES, CHECKS


@pytest.mark.parametrize(
    ("case", "check"),
    [pytest.param(case, check, id=f"{case.name}-{check.__name__}") for case in CASES for check, applies in CHECKS if applies(case)],
)
def test_promise(case, check, tmp_path):
    needs_a_folder = "path" in inspect.signature(check).parameters
    check(case, tmp_path) if needs_a_folder else check(case)
