"""What is said of real recordings, and what is written of them; skipped where DYNTORCH_DATA names no folder."""

from __future__ import annotations

import os
import warnings
from pathlib import Path

import numpy as np
import pytest

from indexing.clip import Clip, ClipSet
from indexing.readers import read
from indexing.skeleton import Skeleton

FOLDER = os.environ.get("DYNTORCH_DATA")
pytestmark = pytest.mark.skipif(not FOLDER, reason="DYNTORCH_DATA is not set: no real data")
DATA = Path(FOLDER or ".")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["utkinect", "florence3d", "cmu_mocap_60fps"])
def test_depth_is_never_taken_for_confidence(name: str) -> None:
    """Nor where it goes from 0 to 1: brought to a cube, upright in metres, of a few joints, and far from the origin."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for clip in read(DATA / f"{name}.npz"):
            joints = clip.joints.astype(float) - clip.joints.min(axis=(0, 1))
            spans = np.ptp(joints, axis=(0, 1))
            floor = joints[..., [0, 2, 1]] / [1, 1, 2]
            far = floor + np.linspace(0, 80, len(joints))[:, None, None] * [1, 0, 0]
            for one in (joints, joints / spans.max(), joints / spans, floor, far, 1000 * joints, (joints / spans)[:, :1]):
                assert Clip(one).dims == 3


def test_confidence_of_pixels_is_seen() -> None:
    found = np.load(DATA / "pose2sim/pose2sim_balancing.npz")
    for joints, size in zip(found["keypoints"].astype(float), found["size"], strict=True):
        gone = np.where(joints[..., 2:] == 0, np.nan, joints)
        for one in (joints, gone, joints * [0.1, 0.1, 1]):
            with pytest.raises(ValueError, match="the confidence of pixels, not depth"):
                Clip(one)
        for one in (joints, gone):
            with pytest.warns(UserWarning, match="z goes from 0 to 1 as a confidence does"):
                Clip(one / [*size, 1])


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".trc", ".c3d"])
def test_markers_come_back(tmp_path: Path, suffix: str) -> None:
    found = np.load(DATA / "pose2sim/pose2sim_balancing.npz")
    clip = Clip(found["trc_raw"], fps=60.0, skeleton=Skeleton("markers", tuple(map(str, found["trc_names"]))))
    for given in (clip, ClipSet.load(DATA / "cmu_mocap_60fps.npz")[0]):
        given.save(tmp_path / f"a{suffix}", units="m")
        back = read(tmp_path / f"a{suffix}")[0]
        assert np.allclose(back.joints, given.joints, atol=1e-6, equal_nan=True) and np.allclose(back.times, given.times)
        assert given.skeleton is not None and back.skeleton is not None and back.skeleton.joints == given.skeleton.joints


def test_frame_numbers_of_a_file_are_its_times() -> None:
    with np.load(DATA / "utkinect.npz") as held:
        frames, offsets = held["frame"], held["offsets"]
    for clip, start, end in zip(read(DATA / "utkinect.npz"), offsets, offsets[1:], strict=False):
        assert np.allclose(clip.times, frames[start:end] / 30)
