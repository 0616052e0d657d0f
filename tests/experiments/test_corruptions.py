"""Corruptions of clips strike as much as they are asked to."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.recognition import corruptions, protocol
from indexing import Clip

LONG = Clip(np.random.default_rng(0).normal(size=(1000, 12, 2)), fps=30.0)


def changed(change, amount: float, clip: Clip = LONG, seed: int = 0) -> Clip:
    return change(clip, amount, np.random.default_rng(seed))


def test_amount_zero_changes_nothing_and_the_seed_decides() -> None:
    for change, _, amounts in corruptions.KINDS.values():
        assert amounts[0] == 0 and list(amounts) == sorted(amounts) and changed(change, 0.0) is LONG
        first, again, other = (changed(change, amounts[-1], seed=seed) for seed in (1, 1, 2))
        np.testing.assert_array_equal(first.joints, again.joints)
        assert not np.array_equal(first.joints, other.joints)


def test_joints_are_missing_or_wrong_as_often_as_asked() -> None:
    for change in (corruptions.missing, corruptions.missing_bursts):
        found = changed(change, 0.3)
        assert np.mean(~found.seen) == pytest.approx(0.3, abs=0.03)
        np.testing.assert_array_equal(found.joints[found.seen], LONG.joints[found.seen])
    for change in (corruptions.astray, corruptions.astray_bursts, corruptions.mistaken):
        found = changed(change, 0.1)
        assert np.mean((found.joints != LONG.joints).any(axis=2)) == pytest.approx(0.1, abs=0.02)
        assert found.joints.min() >= LONG.joints.min() and found.joints.max() <= LONG.joints.max()  # near the person
    exchanged = changed(corruptions.mistaken, 0.5)  # all still there
    np.testing.assert_array_equal(np.sort(exchanged.joints, axis=1), np.sort(LONG.joints, axis=1))
    joints = LONG.joints[:30, :4].copy()
    joints[:, 1] = np.nan  # what was not seen is not seen wrongly
    assert not changed(corruptions.astray, 0.9, Clip(joints)).seen[:, 1].any()


@pytest.mark.parametrize("fps", [10.0, 60.0])
def test_bursts_last_as_long_as_asked_at_any_frame_rate(fps: float) -> None:
    struck = corruptions.bursts(Clip(LONG.joints, fps=fps), 0.2, 0.5, np.random.default_rng(0))
    lengths = np.concatenate([[b - a for a, b in protocol.runs(one) if one[a]] for one in struck.T])
    assert lengths.mean() / fps == pytest.approx(0.5, rel=0.2)


def test_dropped_frames_keep_their_times_and_something_stays_to_compare() -> None:
    found = changed(corruptions.dropped, 0.5)
    where = np.searchsorted(LONG.times, found.times)
    assert len(found) == 500
    np.testing.assert_array_equal(LONG.joints[where], found.joints)
    short = Clip(np.zeros((5, 4, 2)))
    assert changed(corruptions.missing, 1.0, short).seen.sum() == len(changed(corruptions.dropped, 1.0, short)) == 2
