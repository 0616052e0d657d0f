"""Constants of the labels against the distributions they come from."""

import pytest
import torch

from dyntorch.tasks.labelling import CHI_SQUARE, MEDIAN

THREE_SIGMA = float(torch.special.erf(torch.tensor(3 / 2**0.5, dtype=torch.float64)))


@pytest.mark.parametrize(("table", "share"), [(CHI_SQUARE, THREE_SIGMA), (MEDIAN, 0.5)])
def test_quantiles_of_chi_square(table, share):
    for freedom, value in table.items():
        half = torch.tensor([freedom / 2, value / 2], dtype=torch.float64)
        below = float(torch.special.gammainc(half[0], half[1]))
        assert below == pytest.approx(share, abs=1e-3 * (1 - share)), freedom
