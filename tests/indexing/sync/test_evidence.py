"""Evidence of short windows: all agree, none agrees, nothing known."""

import math

import torch

from indexing.sync.brightness import OUTLIER_SHARE, SOFTMAX_SHARPNESS, WINDOW_FRAMES, WINDOW_LAG_RANGE, evidence, windows

REACH, WINDOW = WINDOW_LAG_RANGE, WINDOW_FRAMES


def walk(rows, seed):
    """Unit vectors that change within a few frames."""
    steps = torch.randn(rows + 8, 18, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return torch.nn.functional.normalize(steps.unfold(0, 8, 1).mean(-1)[:rows], dim=1)


def test_windows_are_means_about_the_lag():
    a, b = walk(60, 0), walk(70, 1)
    found = windows(a, b, 5)
    means = (a @ b.T).diagonal(5 + 2)[24 : 24 + WINDOW].mean()
    assert torch.allclose(found[3, REACH + 2], means)
    assert found[0, 0].isnan() and found[0, REACH].isfinite()  # the first rows have no partner 12 frames earlier


def test_agreement_adds_up_and_disagreement_too():
    a = walk(120, 0)
    b = torch.cat([walk(7, 2), a])
    right, beside, unrelated = evidence(a, b, 7), evidence(a, b, 13), evidence(a, walk(120, 3), 7)
    assert right > 20 and beside < -20 and -30 < unrelated < 5
    assert right > evidence(a[:60], b, 7) > 5


def test_one_window_by_hand():
    a, b = walk(WINDOW + 2 * REACH, 0)[REACH:-REACH], walk(WINDOW + 2 * REACH, 1)
    means = torch.stack([(a * b[REACH + d : REACH + d + WINDOW]).sum(1).mean() for d in range(-REACH, REACH + 1)])
    share = torch.softmax(SOFTMAX_SHARPNESS * means, dim=0)[REACH - 1 : REACH + 2].sum().item()
    assert math.isclose(evidence(a, b, REACH), math.log((1 - OUTLIER_SHARE) * share * 25 / 3 + OUTLIER_SHARE), rel_tol=1e-9)


def test_missing_frames_say_nothing():
    a = walk(80, 0)
    gone = torch.zeros_like(a)
    assert evidence(a, gone, 0) == 0.0
    assert evidence(a, a, 200) == 0.0
