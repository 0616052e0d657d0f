"""The battery over all invariants."""

from pathlib import Path

import pytest

import dyntorch as dyn
from dyntorch.core.invariant import Invariant
from tests.battery import on_input, on_noise  # noqa: F401 - they add to the list
from tests.battery.cases import CASES
from tests.battery.properties import CHECKS
from tests.battery.shape_cases import LIFTED_CASES, SHAPE_CASES

PAIRS = [pytest.param(check, case, id=f"{check.__name__}-{case!r}") for check, applies in CHECKS for case in CASES if applies(case)]


@pytest.mark.parametrize(("check", "case"), PAIRS)
def test_property(check, case):
    check(case)


def test_every_property_is_on_the_list():
    written = sum(text.count("\n@prop(") for path in Path(__file__).parent.glob("*.py") if (text := path.read_text()))
    assert len(CHECKS) == written >= 40


def test_every_public_invariant_has_a_case():
    public = {getattr(dyn, name) for name in dyn.__all__ if name[0].isupper()}
    invariants = {x for x in public if isinstance(x, type) and issubclass(x, Invariant) and x is not Invariant}
    assert len(invariants) >= 8
    # those whose matches are whole views have properties of their own: tests/dyntorch/invariants/test_shape_tensor.py
    missing = invariants - {type(case.invariant) for case in [*CASES, *SHAPE_CASES, *LIFTED_CASES]}
    assert not missing, (
        f"neither tests/battery/cases.py nor tests/battery/shape_cases.py has a case for {sorted(x.__name__ for x in missing)}"
    )


def test_cases_are_different():
    assert len({repr(case) for case in CASES}) == len(CASES)
