"""Who is who, and left and right, in a real recording; skipped where DYNTORCH_DATA names no folder."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from indexing.calibrate.people import associate
from indexing.clip import Clip
from indexing.skeleton import BODY25B

pytestmark = pytest.mark.skipif(not os.environ.get("DYNTORCH_DATA"), reason="DYNTORCH_DATA is not set: no real data")


def recording() -> tuple[list[list[Clip]], np.ndarray]:
    """The people of four cameras as OpenPose numbers them, and who the balancing one is in each frame, ``(4, 100, 25, 2)``."""
    with np.load(Path(os.environ["DYNTORCH_DATA"]) / "pose2sim" / "pose2sim_balancing.npz") as data:
        everyone, one = data["keypoints_all"].astype(float), data["keypoints"][..., :2].astype(float)
    cameras = []
    for number, people in enumerate(everyone):
        clips = []
        for person in range(people.shape[1]):
            seen = people[:, person].copy()
            seen[seen[..., 2] <= 0.1] = np.nan
            if np.isfinite(seen[..., 0]).any():
                trust = np.nan_to_num(seen[..., 2])
                clips.append(Clip(seen[..., :2], fps=60.0, confidence=trust, skeleton=BODY25B, up="-y", name=f"cam{number + 1}"))
        cameras.append(clips)
    return cameras, one


@pytest.mark.slow
def test_the_balancing_person_is_one_in_all_cameras() -> None:
    cameras, one = recording()
    found = associate(cameras, [0.0] * 4)
    assert found.ok and found.people == 2  # one stands aside, and two cameras show him
    for own, true in zip(found.joints, one, strict=True):
        known = np.isfinite(own[:, 0]).all(2)
        assert known.mean() > 0.8
        assert np.mean(np.abs(own[:, 0] - true).max(-1)[known] < 1.0) > 0.98
