"""The table of mistakes fits the code as it stands."""

from tests.mutants.__main__ import ROOT
from tests.mutants.table import MUTANTS


def test_every_mistake_can_be_made_once():
    counts = {(mutant.file, mutant.text): (ROOT / mutant.file).read_text(encoding="utf-8").count(mutant.text) for mutant in MUTANTS}
    assert {place: count for place, count in counts.items() if count != 1} == {}
    assert len(MUTANTS) >= 60 and all((ROOT / test).exists() for mutant in MUTANTS for test in mutant.tests)
