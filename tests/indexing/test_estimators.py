"""The promises of :mod:`tests.indexing.estimators` for every indexer, and scikit-learn's own battery where it truly runs."""

from __future__ import annotations

import inspect
from collections import Counter

import pytest
from sklearn.utils.estimator_checks import check_estimator

from indexing.feature_indexer import FeatureIndexer
from tests.indexing.estimators import CASES, CHECKS


@pytest.mark.parametrize(
    ("case", "check"),
    [pytest.param(case, check, id=f"{case.name}-{check.__name__}") for case in CASES for check, applies in CHECKS if applies(case)],
)
def test_promise(case, check, tmp_path):
    needs_a_folder = "path" in inspect.signature(check).parameters
    check(case, tmp_path) if needs_a_folder else check(case)


def test_the_table_form_passes_the_checks_of_scikit_learn():
    results = check_estimator(FeatureIndexer(), on_skip=None)
    ran = Counter(result["status"] for result in results)
    assert ran["passed"] > 40
    assert {r["status"] for r in results} <= {"passed", "skipped"}
    # these need an opt-in of scipy, and pandas
    optional = {"check_array_api_input", "check_classifier_data_not_an_array"}
    assert {r["check_name"] for r in results if r["status"] == "skipped"} <= optional
