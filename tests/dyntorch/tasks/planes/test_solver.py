"""The noise that the fit of translating planes shows."""

from __future__ import annotations

import pytest
import torch

from dyntorch.tasks.planes.problem import noise_variance

F64 = torch.float64


@pytest.mark.parametrize("spare", [1, 4, 16, 200])
def test_the_noise_is_underestimated_one_time_in_ten(spare):
    cost = torch.randn(40000, spare, generator=torch.Generator().manual_seed(24), dtype=F64).square().sum(-1)
    found = noise_variance(cost, torch.tensor(float(spare), dtype=F64), risk=0.1)
    assert float((found < 1).double().mean()) == pytest.approx(0.1, abs=0.01)
    assert noise_variance(cost[:1], torch.zeros(1, dtype=F64), risk=0.1).tolist() == [0.0]
