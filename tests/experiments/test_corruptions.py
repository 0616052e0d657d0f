"""Corruptions of clips strike as much as they are asked to."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.recognition import corruptions, protocol
from indexing import Clip


@pytest.fixture(scope="module")
def long_clip() -> Clip:
    return Clip(np.random.default_rng(0).normal(size=(1000, 12, 2)), fps=30.0)


def test_amount_zero_changes_nothing_and_the_seed_decides(long_clip: Clip) -> None:
    for change, _, amounts in corruptions.KINDS.values():
        assert amounts[0] == 0 and list(amounts) == sorted(amounts)
        assert change(long_clip, 0.0, np.random.default_rng(0)) is long_clip
        first, again, other = (change(long_clip, amounts[-1], np.random.default_rng(seed)) for seed in (1, 1, 2))
        np.testing.assert_array_equal(first.joints, again.joints)
        assert not np.array_equal(first.joints, other.joints)


@pytest.mark.parametrize("change", [corruptions.missing, corruptions.missing_bursts])
def test_joints_are_missing_as_often_as_asked(long_clip: Clip, change) -> None:
    changed = change(long_clip, 0.3, np.random.default_rng(0))
    assert np.mean(~changed.seen) == pytest.approx(0.3, abs=0.03)
    np.testing.assert_array_equal(changed.joints[changed.seen], long_clip.joints[changed.seen])


def test_bursts_last_as_long_as_asked_at_any_frame_rate(long_clip: Clip) -> None:
    for fps in (10.0, 60.0):
        clip = Clip(long_clip.joints, fps=fps)
        struck = corruptions.bursts(clip, 0.2, 0.5, np.random.default_rng(0))
        lengths = np.concatenate([[b - a for a, b in protocol.runs(one) if one[a]] for one in struck.T])
        assert lengths.mean() / fps == pytest.approx(0.5, rel=0.2)


def test_something_stays_to_compare() -> None:
    clip = Clip(np.zeros((5, 4, 2)))
    assert corruptions.missing(clip, 1.0, np.random.default_rng(0)).seen.sum() == 2
    assert len(corruptions.dropped(clip, 1.0, np.random.default_rng(0))) == 2


def test_dropped_frames_keep_their_times(long_clip: Clip) -> None:
    changed = corruptions.dropped(long_clip, 0.5, np.random.default_rng(0))
    where = np.searchsorted(long_clip.times, changed.times)
    assert len(changed) == 500
    np.testing.assert_array_equal(long_clip.joints[where], changed.joints)


@pytest.mark.parametrize("change", [corruptions.astray, corruptions.astray_bursts, corruptions.mistaken])
def test_joints_are_wrong_as_often_as_asked_and_near_the_person(long_clip: Clip, change) -> None:
    changed = change(long_clip, 0.1, np.random.default_rng(0))
    assert np.mean((changed.joints != long_clip.joints).any(axis=2)) == pytest.approx(0.1, abs=0.02)
    assert changed.joints.min() >= long_clip.joints.min() and changed.joints.max() <= long_clip.joints.max()


def test_exchanged_joints_are_all_still_there(long_clip: Clip) -> None:
    changed = corruptions.mistaken(long_clip, 0.5, np.random.default_rng(0))
    np.testing.assert_array_equal(np.sort(changed.joints, axis=1), np.sort(long_clip.joints, axis=1))


def test_a_joint_that_was_not_seen_is_not_seen_wrongly() -> None:
    joints = np.random.default_rng(0).normal(size=(30, 4, 2))
    joints[:, 1] = np.nan
    assert not corruptions.astray(Clip(joints), 0.9, np.random.default_rng(0)).seen[:, 1].any()
