"""What is stored of a clip: a steady rate, whole numbers, nothing that was not seen; and the codes of its poses."""

import numpy as np
import pytest

from indexing import Archive
from indexing.archive.tracks import (
    CODE_FLOOR,
    CODE_WHITENING_POWER,
    MIDDLE_VARIANCE,
    MISSING,
    SIGHTING_VARIANCE,
    Layout,
    StorageFormat,
    images,
    layout_key,
    tracks_of,
)
from indexing.cameras import rotation
from indexing.clip import Clip
from indexing.skeleton import Skeleton

STORAGE = StorageFormat()


def swinging(t, joints=6, seed=0):
    """``(frames, joints, 2)`` smooth movement at any times, in pixels."""
    rng = np.random.default_rng(seed)
    rate, phase = rng.uniform(0.2, 0.8, (joints, 2)), rng.uniform(0, 6.3, (joints, 2))
    return rng.uniform(100, 600, (joints, 2)) + 40 * np.sin(2 * np.pi * rate * np.asarray(t)[:, None, None] + phase)


def test_stored_movement_is_the_movement_whatever_is_lost_or_slips():
    t = np.arange(300) / 30
    (track,) = tracks_of(Clip(swinging(t), times=t), STORAGE)
    at = track.start + np.arange(len(track)) / STORAGE.rate
    assert np.abs(track.positions()[1:-1] - swinging(at)[1:-1]).max() < 1.0  # a pose is the mean of a fifteenth of a second
    assert track.scale < 0.05 and track.joints.dtype == np.int16 and len(track) == 150
    t = np.cumsum(np.random.default_rng(1).uniform(0.01, 0.07, 400)) + 1000.0  # at a steady rate, whatever the clock
    (track,) = tracks_of(Clip(swinging(t - 1000), times=t), STORAGE)
    at = track.start + np.arange(len(track)) / STORAGE.rate
    assert track.start == t[0] and np.abs(track.positions()[1:-1] - swinging(at - 1000)[1:-1]).max() < 2.0
    t = np.arange(300) / 30
    joints = swinging(t)
    joints[60:75, 0] = np.nan  # half a second
    joints[60:180, 1] = np.nan
    joints[:, 2] = np.nan
    (track,) = tracks_of(Clip(joints, times=t), STORAGE)
    seen = (track.joints != MISSING).all(axis=2)
    assert seen[:, 0].all() and not seen[:, 2].any() and seen[:, 3:].all()
    assert not seen[35:85, 1].any() and seen[:29, 1].all() and seen[92:, 1].all()
    assert np.isnan(track.positions()[40, 1]).all()
    t = np.arange(300) / 30
    joints = swinging(t)
    joints[100:104, 0] = 1e8
    (track,) = tracks_of(Clip(joints, times=t), STORAGE)
    assert track.scale < 0.05
    assert np.nanmax(np.abs(track.positions()[10:40] - swinging(np.arange(10, 40) / 15))) < 1.0


def test_gaps_part_tracks_and_short_ones_are_left_out():
    t = np.concatenate([np.arange(60) / 30, 10 + np.arange(10) / 30, 20 + np.arange(90) / 30])
    tracks = tracks_of(Clip(swinging(t), times=t), STORAGE)
    assert [(track.start, len(track)) for track in tracks] == [(0.0, 30), (20.0, 45)]
    t = np.arange(300) / 30
    joints = swinging(t)
    joints[100:180] = np.nan  # nobody is in view
    assert [round(track.start, 2) for track in tracks_of(Clip(joints, times=t), STORAGE)] == [0.0, 6.0]


def test_movement_in_3d_is_kept_from_two_sides():
    rng = np.random.default_rng(2)
    points = rng.normal(size=(60, 5, 3))
    front, side = images(Clip(points, up="z"), STORAGE.views)
    assert np.allclose(front.joints, np.stack([points[..., 0], points[..., 2]], axis=2))
    turned = np.stack([points[..., 0], points[..., 2], -points[..., 1]], axis=2) @ rotation(np.pi / 2, 0.0).T
    assert np.allclose(side.joints, turned[..., :2])
    assert [track.view for track in tracks_of(Clip(points), STORAGE)] == [0, 1]


def test_nothing_is_kept_of_nothing_and_layouts_differ_by_names_or_bones():
    for joints in (np.zeros((60, 4, 2)), np.full((60, 4, 2), np.nan), np.ones((1, 4, 2))):
        assert tracks_of(Clip(joints), STORAGE) == []
    assert layout_key(3, Skeleton("a", ("x", "y", "z"))) == layout_key(3, Skeleton("b", ("x", "y", "z"), ((0, 1),)))
    assert layout_key(3, None) != layout_key(3, Skeleton("a", ("0", "1", "2"), ((0, 1),)))


# ---- layouts -------------------------------------------------------------------------------------------------------------


def learned(seed=0, joints=8, dimensions=5, **options):
    rng = np.random.default_rng(seed)
    mixing = rng.normal(size=(joints, joints))
    t = np.arange(900) / 30
    hidden = swinging(t, joints, seed)
    clip = Clip(np.einsum("ij,tjd->tid", mixing, hidden), times=t)
    storage = StorageFormat(dimensions=dimensions, **options)
    tracks = tracks_of(clip, storage)
    return Layout.learn(tracks, None, storage), tracks, storage


def test_the_basis_is_that_of_the_covariance_and_codes_are_its_coordinates():
    layout, tracks, _ = learned()
    x = tracks[0].positions().astype(float)
    x = x - x.mean(axis=1, keepdims=True)
    x = x / np.linalg.norm(x, axis=(1, 2))[:, None, None]
    sigma = np.einsum("tjd,tkd->jk", x, x)
    sigma *= len(sigma) / np.trace(sigma)
    values, vectors = np.linalg.eigh(sigma)
    for number in range(3):
        expected = vectors[:, -1 - number] * (values[-1 - number] + CODE_FLOOR) ** -CODE_WHITENING_POWER
        assert abs(expected @ layout.basis[:, number]) == pytest.approx(expected @ expected, rel=1e-3)
    poses = tracks[0].positions()
    codes, scales = layout.codes(poses)
    exact = layout.project(poses)
    assert np.abs(codes * scales[:, None, None] - exact).max() <= 0.5001 * scales.max()
    assert np.abs(codes).max() == 127
    assert np.allclose(layout.project(poses + np.array([1000.0, -500.0])), exact, atol=0.05)  # wherever they are in the image
    # against the conditional expectation of a Gaussian, written out
    poses = tracks[0].positions()[:20].copy()
    poses[:, 3] = np.nan
    seen = np.arange(8) != 3
    sigma = layout.covariance + MIDDLE_VARIANCE
    known = poses[:, seen] - poses[:, seen].mean(axis=1, keepdims=True)
    gain = sigma[:, seen] @ np.linalg.inv(sigma[np.ix_(seen, seen)] + SIGHTING_VARIANCE * np.eye(7))
    full = np.einsum("js,tsd->tjd", gain, known)
    full = full - full.mean(axis=1, keepdims=True)
    expected = np.einsum("tjd,jk->tdk", full, layout.basis)
    assert np.allclose(layout.project(poses), expected, atol=1e-2 * np.abs(expected).max())


def test_joints_are_met_by_name():
    layout, _, _ = learned(joints=4)
    named = Layout(4, Skeleton("body", ("hip", "knee", "foot", "hand")), layout.covariance, layout.basis, layout.metric)
    clip = Clip(swinging(np.arange(9), 5), skeleton=Skeleton("other", ("Hand", "foot", "nose", "hip", "eye")))
    facing = named.facing(clip)
    assert np.array_equal(facing.joints[:, [0, 2, 3]], clip.joints[:, [3, 1, 0]]) and np.isnan(facing.joints[:, 1]).all()
    assert named.facing(clip.replace(skeleton=Skeleton("none", tuple("abcde")))) is None
    assert layout.facing(clip) is None and layout.facing(Clip(swinging(np.arange(9), 4))) is not None


def test_what_was_learned_of_little_is_learned_again_of_more(tmp_path):
    """One second first: the directions are those of all that came later, and every code with them."""
    clips = [Clip(swinging(np.arange(600) / 30 + 40 * k, 8, seed=3), fps=30.0, name=f"clip {k}") for k in range(3)]
    grown = Archive(tmp_path / "grown")
    grown.add(clips[0].between(0.0, 1.0).replace(name="short"))
    before = grown._open_snapshot().contents.layouts[1]
    grown.add(clips)
    after = grown._open_snapshot()
    assert before.poses == 16 and after.contents.layouts[1].poses == 16 + 3 * 300
    assert not np.allclose(before.basis, after.contents.layouts[1].basis) and grown.verify().ok and len(after.segments) == 1
    for segment in after.segments:
        for i in range(len(segment)):
            codes, scales = after.contents.layouts[1].codes(segment.positions(i))
            rows = slice(int(segment.firsts[i]), int(segment.firsts[i]) + len(scales))
            assert np.array_equal(codes, segment.codes[rows]) and np.array_equal(scales, segment.scales[rows])
