"""Sums and scores at all lags against loops."""

import pytest
import torch

from indexing.sync.brightness import OVERLAP_POWER, Curve, lag_sums, part_curve, score_curve


def unit(rows, seed):
    values = torch.randn(rows, 40, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return torch.nn.functional.normalize(values, dim=1)


def test_lag_sums_are_sums_over_diagonals():
    a, b = unit(9, 0), unit(13, 1)
    products = a @ b.T
    want = [products.diagonal(lag).sum().item() for lag in range(-8, 13)]
    assert lag_sums(a, b).tolist() == pytest.approx(want, abs=1e-12)


def test_scores_leave_out_missing_frames_and_short_overlaps():
    a, b = unit(30, 0), unit(25, 1)
    a[4:9] = 0
    curve = score_curve(a, b, 10)
    products = a @ b.T
    for lag in range(-29, 25):
        pairs = [(i, i + lag) for i in range(30) if 0 <= i + lag < 25 and not 4 <= i < 9]
        if len(pairs) < 10:
            assert curve.at(lag) == -torch.inf
        else:
            mean = sum(products[i, j].item() for i, j in pairs) / len(pairs)
            assert curve.at(lag) == pytest.approx(mean * (len(pairs) / float(curve.counts.max())) ** OVERLAP_POWER, abs=1e-12)


def test_part_of_the_first_keeps_the_lags():
    a = unit(60, 3)
    b = torch.cat([unit(11, 5), a])
    assert score_curve(a, b, 20).best == 11
    assert part_curve(a, b, slice(35, 50)).best == 11
    assert part_curve(a, b, slice(35, 50)).within(-5, 5).best != 11


def test_peaks_and_parabola():
    lags = torch.arange(-20, 21)
    x = lags.double()
    scores = torch.exp(-((x - 3.3) ** 2) / 20) + 0.5 * torch.exp(-((x + 12) ** 2) / 20)
    curve = Curve(lags, scores, torch.ones(41))
    assert curve.lags[curve.peaks(4)].tolist() == [3, -12]
    assert curve.best + curve.offset(curve.best) == pytest.approx(3.3, abs=0.01)
    assert curve.offset(-20) == 0.0
    assert curve.within(-20, 3).offset(3) == 0.0
