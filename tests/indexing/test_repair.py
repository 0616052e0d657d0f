"""Wrong joints against planted ones and a slow reference; clean, coarse and holed recordings stay as they are."""

from itertools import combinations

import numpy as np
import pytest

from indexing import ActionIndexer, Clip, windows
from indexing.actors import Person, dataset
from indexing.windows import (
    MAX_SPREADS,
    MAX_USUAL_FACTOR,
    MIN_SIGHTINGS,
    NOISE_FLOOR,
    NUM_COMPARED,
    USUAL_SHARE,
    concatenate_clips,
    wrong_joints,
)


def walk(frames=80, joints=6, seed=0):
    """Smooth paths at an irregular frame rate."""
    times = np.cumsum(np.random.default_rng(seed).uniform(0.01, 0.09, frames))
    t = 2.5 * times[:, None]
    phase, size = np.linspace(0, 3, joints), np.linspace(0.2, 1, joints)
    places = np.stack([np.sin(t + phase) * size + np.arange(joints), np.cos(t + phase) * size], axis=2)
    return places.astype(np.float32), times


def wrong_in(joints, times, stride=1):
    return wrong_joints(joints, times, np.array([0, len(joints)]), stride)


def slow(joints, times):
    """One pass over one clip, sighting by sighting."""
    there = np.isfinite(joints).all(axis=2)
    extent = np.nanmax(joints, axis=1) - np.nanmin(joints, axis=1)
    floor = NOISE_FLOOR * np.median(extent, axis=0).max()
    found = {}
    for j in range(joints.shape[1]):
        seen = np.flatnonzero(there[:, j])
        if len(seen) < MIN_SIGHTINGS:
            continue
        for k, f in enumerate(seen):
            first = max(0, min(k - NUM_COMPARED // 2, len(seen) - NUM_COMPARED))
            at = seen[first : first + NUM_COMPARED]
            x, t = joints[at, j].astype(float), times[at] - times[f]
            slopes = [(x[b] - x[a]) / (t[b] - t[a]) for a, b in combinations(range(len(at)), 2) if b - a > 1]
            rest = x - np.quantile(slopes, 0.5, axis=0, method="lower") * t[:, None]
            middle = np.quantile(rest, 0.5, axis=0, method="lower")
            spread = 1.4826 * np.quantile(np.abs(rest - middle), 0.5, axis=0, method="lower")
            found[f, j] = np.abs(joints[f, j] - middle), spread
    far = np.sort([one.max() for one, _ in found.values()])
    usual = MAX_USUAL_FACTOR * far[min(int(USUAL_SHARE * len(far)), len(far) - 1)]
    return {at for at, (one, spread) in found.items() if (one > MAX_SPREADS * spread + usual + floor).any()}


def places(mask):
    return {(int(f), int(j)) for f, j in np.argwhere(mask)}


@pytest.mark.parametrize("frames", [7, 30])
def test_one_pass_against_the_definition(frames, monkeypatch):
    monkeypatch.setattr(windows, "NUM_PASSES", 1)
    rng = np.random.default_rng(frames)
    joints, times = walk(frames)
    joints += rng.normal(scale=0.02, size=joints.shape).astype(np.float32)
    joints[rng.random(joints.shape[:2]) < 0.2] = np.nan
    joints[rng.random(joints.shape[:2]) < 0.1] += 1.0
    assert places(wrong_in(joints, times)) == slow(joints, times) != set()


def test_planted_jumps_are_found_and_only_those():
    joints, times = walk()
    jumps = {(0, 4), (10, 2), (11, 2), (12, 2), (40, 0), (41, 5), (70, 3), (79, 1)}
    for frame, joint in jumps:
        joints[frame, joint] += [4.0, -3.0]
    before = joints.copy()
    assert places(wrong_in(joints, times)) == jumps
    np.testing.assert_array_equal(joints, before)


@pytest.mark.parametrize("change", [lambda j: j, lambda j: np.repeat(j[:1], len(j), axis=0), lambda j: j[:4], lambda j: j[::4]])
def test_right_joints_are_left_alone(change):
    joints, times = walk()
    rows = change(np.arange(80)[:, None])[:, 0]
    assert not wrong_in(change(joints), times[: len(rows)] if len(rows) == 80 else times[rows]).any()


def test_gaps_and_frame_rate_do_not_make_a_movement_look_wrong():
    steps = np.sort(np.random.default_rng(1).permutation(200)[:40])
    times = steps / 60.0
    joints = (times[:, None, None] * np.array([[[3.0, 1.0]], [[-2.0, 0.0]], [[0.1, 0.2]]]).transpose(1, 0, 2)).astype(np.float32)
    joints[12:20, 1] = np.nan
    assert not wrong_in(joints, times).any()
    joints[25, 0] += 0.5
    assert places(wrong_in(joints, times)) == {(25, 0)}


def test_unit_and_other_clips_do_not_matter():
    joints, times = walk()
    joints[20, 1] += 5
    joints[:, 4] = np.nan
    short, clock = walk(3)
    apart = wrong_in(joints, times)
    for unit in (1e-3, 1.0, 700.0):
        both = np.concatenate([short, joints * np.float32(unit), 9 * short, short * np.nan])
        starts = np.array([0, 3, 83, 86, 89])
        together = wrong_joints(both, np.concatenate([clock, times + 50, clock, clock]), starts)
        np.testing.assert_array_equal(together[3:83], apart)
        assert together.sum() == apart.sum() == 1


def test_repair_interpolates_what_was_wrong():
    clean, times = walk()
    joints = clean.copy()
    joints[33, 2] = 50
    source = concatenate_clips([Clip(joints, times=times), Clip(clean, times=times)], repair=True)
    np.testing.assert_allclose(source.joints[:80], clean, atol=0.02)
    assert np.abs(concatenate_clips([Clip(joints, times=times)]).joints - clean).max() > 40


def test_repair_helps_where_joints_jump():
    few, rng = ("squat", "wave", "kick", "bow"), np.random.default_rng(0)
    train, test = (dataset([Person.random(seed)], few, azimuth=60.0 * seed, rng=seed) for seed in (0, 1))
    jumpy = [c.replace(joints=c.joints + 400 * (rng.random(c.joints.shape[:2]) < 0.05)[..., None]) for c in test]
    assert ActionIndexer(scorer="nearest", repair=True).fit(train).score(jumpy, test.labels) == 1.0


def test_long_recordings_are_mended_in_parts(monkeypatch):
    from indexing.clip import Clip
    from indexing.windows import repair_clip

    rng = np.random.default_rng(5)
    walk = np.linspace(0, 3, 400)[:, None, None] + np.arange(4.0)[:, None] + 0.005 * rng.normal(size=(400, 4, 2))
    clean = Clip(walk, fps=30.0)
    assert repair_clip(clean) is clean
    walk[[30, 199, 200, 350], [0, 1, 2, 3]] += 2.0
    broken = Clip(walk, fps=30.0)
    whole = repair_clip(broken)
    assert np.argwhere(~whole.seen).tolist() == [[30, 0], [199, 1], [200, 2], [350, 3]]
    monkeypatch.setattr(windows, "MAX_FRAMES_JUDGED", 100)
    assert np.array_equal(repair_clip(broken).seen, whole.seen)
