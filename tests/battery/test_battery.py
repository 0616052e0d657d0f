"""The battery over all invariants."""

from pathlib import Path

import pytest

import dyntorch as dyn
from dyntorch.core.invariant import Invariant
from tests.battery import on_input, on_noise  # noqa: F401 - they add to the list
from tests.battery.cases import CASES
from tests.battery.properties import CHECKS
from tests.battery.shape_cases import LIFTED_CASES, SHAPE_CASES

DIFFERENT = {
    "FundamentalMatrix", "Collineation(2)", "DualHomographyTensor(lines)", "JoinTensor", "MinimalJoinTensor",
    "ConstantVelocityTensor(image)", "SegmentationMatrix", "GrassmannTensor(4,(2,2,1))", "DynamicTensor(2,4,2)",
}  # fmt: skip
"""Cases that differ in code: the others go the same ways with other shapes."""
ON_ALL = {
    "tensor_is_the_null_space_of_the_brute_force_matrix", "exact_matches_give_the_true_motion",
    "motion_of_composed_tensor_is_the_motion", "change_of_coordinates_commutes_with_exact_fit",
}  # fmt: skip
"""What catches a wrong row, factor, sign or order of views: fast, and run on every case."""
STATISTICS = {
    "covariance_is_calibrated", "neighbours_do_not_matter", "an_accelerator_agrees", "dof_and_codim_are_ranks_of_derivatives",
}  # fmt: skip
"""Draws, the whole of an invariant done twice, derivatives by autograd: slow on every case."""
SEARCHES = {
    "robust_fit_survives_outliers", "hostile_scales_stay_finite", "refinement_never_raises_the_distances",
    "refinement_finds_a_stationary_point",
}  # fmt: skip
"""Iterations: fast on the two smallest cases."""
SMALLEST = {"FundamentalMatrix", "Collineation(2)"}


def is_fast(check: str, case: str) -> bool:
    """Whether `make test` runs a property on a case; `make test-all` runs every property on every case."""
    if check in STATISTICS:
        return False
    return check in ON_ALL or case in (SMALLEST if check in SEARCHES else DIFFERENT)


def pairs():
    for check, applies in CHECKS:
        for case in filter(applies, CASES):
            slow = () if is_fast(check.__name__, repr(case)) else pytest.mark.slow
            yield pytest.param(check, case, id=f"{check.__name__}-{case!r}", marks=slow)


@pytest.mark.parametrize(("check", "case"), list(pairs()))
def test_property(check, case):
    check(case)


def test_every_property_is_on_the_list():
    written = sum(text.count("\n@prop(") for path in Path(__file__).parent.glob("*.py") if (text := path.read_text()))
    assert len(CHECKS) == written >= 37


def test_every_public_invariant_has_a_case():
    public = {getattr(dyn, name) for name in dyn.__all__ if name[0].isupper()}
    invariants = {x for x in public if isinstance(x, type) and issubclass(x, Invariant) and x is not Invariant}
    assert len(invariants) >= 8
    # those whose matches are whole views have properties of their own: tests/dyntorch/invariants/test_shape_tensor.py
    missing = invariants - {type(case.invariant) for case in [*CASES, *SHAPE_CASES, *LIFTED_CASES]}
    assert not missing, "neither cases.py nor shape_cases.py has a case for these"


def test_tiers_name_what_there_is():
    assert {repr(case) for case in CASES} >= DIFFERENT | SMALLEST and len({repr(case) for case in CASES}) == len(CASES)
    assert {check.__name__ for check, _ in CHECKS} >= ON_ALL | STATISTICS | SEARCHES
    fast = {check for check in (check.__name__ for check, _ in CHECKS) if any(is_fast(check, case) for case in DIFFERENT)}
    assert len(fast) >= len(CHECKS) - len(STATISTICS)
