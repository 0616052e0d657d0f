"""Windows against slow references: interpolation joint by joint with np.interp, and what is refused."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
import torch

from indexing import ActionIndexer, Clip, windows
from indexing.actors import Person, dataset
from indexing.windows import (
    MAX_SPREADS,
    MAX_USUAL_FACTOR,
    MIN_SIGHTINGS,
    NOISE_FLOOR,
    NUM_COMPARED,
    SUBSAMPLES,
    USUAL_SHARE,
    check_clips,
    concatenate_clips,
    describe_unusable,
    repair_clip,
    resample_clips,
    sample,
    wrong_joints,
)


def irregular(seed, frames=17, joints=5, dims=2, start=0.0):
    rng = np.random.default_rng(seed)
    times = start + np.cumsum(rng.uniform(0.01, 0.2, frames))
    return Clip(rng.normal(size=(frames, joints, dims)), times=times)


def with_holes(clip, share=0.4, seed=0):
    joints = clip.joints.copy()
    joints[np.random.default_rng(seed).random(joints.shape[:2]) < share] = np.nan
    return clip.replace(joints=joints)


def slow_window(clip, start, end, length):
    """Box average of SUBSAMPLES linear interpolations per step, joint by joint; missing joints do not count as samples."""
    at = start + (end - start) * (np.arange(length * SUBSAMPLES) + 0.5) / (length * SUBSAMPLES)
    out = np.zeros((length * SUBSAMPLES, *clip.joints.shape[1:]))
    for j in range(clip.joints.shape[1]):
        ok = clip.seen[:, j]
        for d in range(clip.dims):
            if ok.any():
                filled = np.interp(clip.times, clip.times[ok], clip.joints[ok, j, d])
                out[:, j, d] = np.interp(at, clip.times, filled)
    return out.reshape(length, SUBSAMPLES, *clip.joints.shape[1:]).mean(axis=1)


CLIPS = [irregular(0), irregular(1, frames=2), irregular(2, frames=60, start=1e5), irregular(3, start=-7.0)]


def test_clips_and_crops_against_interpolation():
    for crop in ((0.0, 1.0), (0.0, 0.7), (0.15, 1.0), (0.3, 0.4)):
        got = resample_clips(concatenate_clips(CLIPS), 9, crop)
        assert got.shape == (4, 9, 5, 2) and got.dtype == torch.float32
        for clip, window in zip(CLIPS, got, strict=True):
            low, high = (clip.times[0] + share * clip.duration for share in crop)
            np.testing.assert_allclose(window, slow_window(clip, low, high, 9), atol=2e-5)
    joints = CLIPS[0].joints.copy()
    joints[:, 3] = np.nan  # never seen: marked, and zero
    source = concatenate_clips([CLIPS[1], CLIPS[0].replace(joints=joints), CLIPS[2]])
    assert source.seen.tolist() == [[True] * 5, [True, True, True, False, True], [True] * 5]
    assert (source.joints[source.starts[1] : source.starts[2], 3] == 0).all()
    assert torch.isfinite(resample_clips(source, 6)).all()


def test_windows_anywhere_also_beyond_the_ends_in_any_chunks(monkeypatch):
    clips = [with_holes(clip, seed=i) for i, clip in enumerate(CLIPS)]
    owner = np.array([2, 0, 0, 3, 1, 2])
    start = np.array([clips[i].times[0] for i in owner]) + np.array([-0.5, 0.1, -9.0, 0.3, 0.0, 3.0])
    end = start + np.array([1.0, 0.4, 2.0, 1.5, 5.0, 90.0])
    got = sample(concatenate_clips(clips), owner, start, end, 8)
    for i, window in enumerate(got):
        # the first and last frame are repeated outside: that is what np.interp does too
        np.testing.assert_allclose(window, slow_window(clips[owner[i]], start[i], end[i], 8), atol=2e-5)
    monkeypatch.setattr("indexing.windows.CHUNK", 6 * SUBSAMPLES * 5 * 2 * 5)
    assert torch.equal(sample(concatenate_clips(clips), owner, start, end, 8), got)


def test_missing_joints_are_interpolated_in_time_and_y_points_up():
    clips = [with_holes(clip, seed=i) for i, clip in enumerate(CLIPS)]
    half = clips[0].joints.copy()
    half[np.isfinite(half).all(axis=2).argmax(axis=0), np.arange(5), 0] = np.nan  # one coordinate missing: the joint is
    clips[0] = clips[0].replace(joints=half, up="-y")
    source = concatenate_clips(clips)
    for i, clip in enumerate(clips):
        part = source.joints[source.starts[i] : source.starts[i + 1]]
        for j in range(5):
            ok = clip.seen[:, j]
            assert source.seen[i, j] == ok.any()
            for d in range(2):
                expected = np.interp(clip.times, clip.times[ok], clip.joints[ok, j, d]) if ok.any() else np.zeros(len(clip))
                np.testing.assert_allclose(part[:, j, d], expected * (-1 if d and clip.up == "-y" else 1), atol=1e-5)


# ---- refusals ----------------------------------------------------------------------------------------------------------
GOOD = Clip(np.random.default_rng(0).normal(size=(5, 4, 2)), name="good")


def test_unusable_clips_and_other_joint_counts_are_named():
    for bad, message in (
        (GOOD.joints[:1], "one frame only"),
        (np.full((5, 4, 2), np.nan), r"no joint was seen in any frame \(all NaN\)"),
        (np.zeros((5, 4, 2)), r"all joints are at one place in all frames \(all 0\)"),
        (np.full((5, 4, 2), 3.5), r"all joints are at one place.*all 3.5"),
    ):
        with pytest.raises(ValueError, match=r"clip 1 \('bad'\): joints: " + message + ".*; leave the clip out"):
            check_clips([GOOD, Clip(bad, name="bad")])
    joints = GOOD.joints.copy()
    joints[1:] = np.nan
    for usable in (GOOD.joints, joints, np.repeat(GOOD.joints[:1], 4, axis=0)):
        assert describe_unusable(Clip(usable)) is None
    with pytest.raises(ValueError, match=r"clip 1: joints: 3 joints, but clip 0 has 4"):
        check_clips([GOOD, Clip(GOOD.joints[:, :3])])
    with pytest.raises(ValueError, match=r"clip 0 \('good'\): joints: 4 joints, but the fitted clips have 17"):
        check_clips([GOOD], joints=17)


# Wrong joints against planted ones and a slow reference


def walk(frames=80, joints=6, seed=0):
    """Smooth paths at an irregular frame rate."""
    times = np.cumsum(np.random.default_rng(seed).uniform(0.01, 0.09, frames))
    t = 2.5 * times[:, None]
    phase, size = np.linspace(0, 3, joints), np.linspace(0.2, 1, joints)
    places = np.stack([np.sin(t + phase) * size + np.arange(joints), np.cos(t + phase) * size], axis=2)
    return places.astype(np.float32), times


def wrong_in(joints, times, stride=1):
    return wrong_joints(joints, times, np.array([0, len(joints)]), stride)


def slow(joints, times, limit=None):
    """One pass over one clip, sighting by sighting, and what a deviation is compared with, which a second pass keeps."""
    there = np.isfinite(joints).all(axis=2)
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
    if limit is None:
        extent = np.nanmax(joints, axis=1) - np.nanmin(joints, axis=1)
        far = np.sort([one.max() for one, _ in found.values()])
        usual = MAX_USUAL_FACTOR * far[min(int(USUAL_SHARE * len(far)), len(far) - 1)]
        limit = usual + NOISE_FLOOR * np.median(extent, axis=0).max()
    return {at for at, (one, spread) in found.items() if (one > MAX_SPREADS * spread + limit).any()}, limit


def places(mask):
    return {(int(f), int(j)) for f, j in np.argwhere(mask)}


@pytest.mark.parametrize(("frames", "seed"), [(7, 7), (30, 30), (100, 5)])
def test_both_passes_against_the_definition(frames, seed, monkeypatch):
    if frames == 30:
        monkeypatch.setattr(windows, "native_deviations", lambda *_: False)  # torch
    rng = np.random.default_rng(seed)
    joints, times = walk(frames)
    joints += rng.normal(scale=0.02, size=joints.shape).astype(np.float32)
    joints[rng.random(joints.shape[:2]) < 0.2] = np.nan
    joints[rng.random(joints.shape[:2]) < 0.1] += 1.0
    first, limit = slow(joints, times)
    rest = joints.copy()
    rest[tuple(np.array(sorted(first)).T)] = np.nan
    assert places(wrong_in(joints, times)) == first | slow(rest, times, limit)[0]
    monkeypatch.setattr(windows, "NUM_PASSES", 1)
    assert places(wrong_in(joints, times)) == first != set()


def test_planted_jumps_are_found_whatever_the_unit_and_the_other_clips():
    joints, times = walk()
    jumps = {(0, 4), (10, 2), (11, 2), (12, 2), (40, 0), (41, 5), (70, 3), (79, 1)}
    for frame, joint in jumps:
        joints[frame, joint] += [4.0, -3.0]
    before = joints.copy()
    assert places(wrong_in(joints, times)) == jumps
    np.testing.assert_array_equal(joints, before)
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


@pytest.mark.parametrize("rows", [np.arange(80), np.zeros(80, int), np.arange(4), np.arange(0, 80, 4)])
def test_right_joints_are_left_alone(rows):
    joints, times = walk()
    assert not wrong_in(joints[rows], times[: len(rows)] if len(rows) == 80 else times[rows]).any()


def test_many_clips_at_once_are_each_judged_by_itself_in_torch_and_in_the_kernel(monkeypatch):
    rng, lengths = np.random.default_rng(3), [40, 9, 3, 25, 60]
    clips = [walk(frames, seed=frames) for frames in lengths]
    for i, (joints, _) in enumerate(clips):
        joints += rng.normal(scale=0.01 * i, size=joints.shape).astype(np.float32)
        joints[rng.random(joints.shape[:2]) < 0.05 * i] += 1.0
    joints, times = (np.concatenate(parts) for parts in zip(*clips, strict=True))
    starts = np.concatenate([[0], np.cumsum(lengths)])
    together = wrong_joints(joints, times, starts)
    assert together.sum() > 10
    np.testing.assert_array_equal(together, np.concatenate([wrong_in(*clip) for clip in clips]))
    monkeypatch.setattr(windows, "native_deviations", lambda *_: False)
    np.testing.assert_array_equal(wrong_joints(joints, times, starts), together)
    np.testing.assert_array_equal(wrong_joints(joints.astype(float), times, starts), together)


def test_gaps_and_frame_rate_do_not_make_a_movement_look_wrong():
    steps = np.sort(np.random.default_rng(1).permutation(200)[:40])
    times = steps / 60.0
    joints = (times[:, None, None] * np.array([[[3.0, 1.0]], [[-2.0, 0.0]], [[0.1, 0.2]]]).transpose(1, 0, 2)).astype(np.float32)
    joints[12:20, 1] = np.nan
    assert not wrong_in(joints, times).any()
    joints[25, 0] += 0.5
    assert places(wrong_in(joints, times)) == {(25, 0)}


def test_repair_interpolates_what_was_wrong_and_helps_to_recognize():
    clean, times = walk()
    joints = clean.copy()
    joints[33, 2] = 50
    source = concatenate_clips([Clip(joints, times=times), Clip(clean, times=times)], repair=True)
    np.testing.assert_allclose(source.joints[:80], clean, atol=0.02)
    assert np.abs(concatenate_clips([Clip(joints, times=times)]).joints - clean).max() > 40
    few, rng = ("squat", "wave", "kick", "bow"), np.random.default_rng(0)
    train, test = (dataset([Person.random(seed)], few, azimuth=60.0 * seed, rng=seed) for seed in (0, 1))
    jumpy = [c.replace(joints=c.joints + 400 * (rng.random(c.joints.shape[:2]) < 0.05)[..., None]) for c in test]
    assert ActionIndexer(scorer="nearest", repair=True).fit(train).score(jumpy, test.labels) == 1.0


def test_long_recordings_are_mended_in_parts(monkeypatch):
    rng = np.random.default_rng(5)
    joints = np.linspace(0, 3, 400)[:, None, None] + np.arange(4.0)[:, None] + 0.005 * rng.normal(size=(400, 4, 2))
    clean = Clip(joints, fps=30.0)
    assert repair_clip(clean) is clean
    joints[[30, 199, 200, 350], [0, 1, 2, 3]] += 2.0
    whole = repair_clip(Clip(joints, fps=30.0))
    assert np.argwhere(~whole.seen).tolist() == [[30, 0], [199, 1], [200, 2], [350, 3]]
    monkeypatch.setattr(windows, "MAX_FRAMES_JUDGED", 100)
    assert np.array_equal(repair_clip(Clip(joints, fps=30.0)).seen, whole.seen)
