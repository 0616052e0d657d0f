"""``dyntorch calibrate`` on a real recording: Pose2Sim's balancing person, against Pose2Sim's own calibration."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from indexing import ClipSet
from indexing.cli import main

DATA = os.environ.get("DYNTORCH_DATA")
FILE = Path(DATA or ".") / "pose2sim" / "pose2sim_balancing.npz"
LATE = (0, 7, 3, 12)
"""Frames of 60 a second that each camera starts late."""
pytestmark = pytest.mark.skipif(DATA is None or not FILE.is_file(), reason="DYNTORCH_DATA is not set: no real data")


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict, Path]:
    """What was written, of the four cameras with focal lengths known to half a percent."""
    folder = tmp_path_factory.mktemp("balancing")
    for camera, (frames, late) in enumerate(zip(np.load(FILE)["keypoints"], LATE, strict=True), start=1):
        own = folder / "pose" / f"cam{camera:02d}_json"
        own.mkdir(parents=True)
        for number, frame in enumerate(frames[late:].astype(float)):
            people = [{"person_id": [-1], "pose_keypoints_2d": frame.ravel().tolist()}]
            (own / f"cam{camera:02d}_{number:06d}_keypoints.json").write_text(json.dumps({"version": 1.3, "people": people}))
    line = (
        f"calibrate {folder / 'pose'} --fps 60 --size 1088x1920 --focal 1678 --height 1.72 --layout BODY_25B --out {folder / 'out'}"
    )
    assert main(line.split()) == 0
    return json.loads((folder / "out" / "calibration.json").read_text()), folder / "out"


@pytest.mark.slow
def test_the_cameras_are_those_of_the_board(calibrated):
    said, _ = calibrated
    known = np.load(FILE)
    true = Rotation.from_rotvec(known["rvec"]).as_matrix()
    found = Rotation.from_rotvec([camera["rotation"] for camera in said["cameras"]]).as_matrix()
    world = Rotation.from_matrix(np.stack([b.T @ a for a, b in zip(true, found, strict=True)])).mean().as_matrix()
    off = [np.degrees(Rotation.from_matrix(a @ world.T @ b.T).magnitude()) for a, b in zip(true, found, strict=True)]
    assert np.median(off) < 2.0, off  # 1.0 as measured; the reference itself is good to 9 to 18 pixels
    assert [60 * camera["offset"] for camera in said["cameras"]] == pytest.approx([-late for late in LATE], abs=0.5)
    centers = -np.einsum("cji,cj->ci", true, known["t"])
    mine = np.array([camera["center"] for camera in said["cameras"]])
    apart = [np.linalg.norm(a[i] - a[j]) for a in (centers, mine) for i in range(4) for j in range(i)]
    assert np.median(np.array(apart[6:]) / apart[:6]) == pytest.approx(1.0, abs=0.1)  # 1.05: nobody stands straight on the beam


def test_the_movement_is_that_of_its_triangulation(calibrated):
    _, folder = calibrated
    known, clip = np.load(FILE), ClipSet.load(folder / "keypoints_3d.trc")[0]
    names = {
        f"{side[0].upper()}{part}": f"{side}_{part.lower()}" for part in ("Knee", "Ankle", "Shoulder") for side in ("right", "left")
    }
    del names["LShoulder"]
    theirs = known["trc_filt"][:, [list(known["trc_names"]).index(name) for name in names]]
    ours = clip.joints[:, [clip.skeleton.joints.index(name) for name in names.values()]]
    rows = np.rint(clip.times * 60).astype(int)
    both = np.stack([theirs[rows].reshape(-1, 3), ours.reshape(-1, 3)])
    a, b = both[:, np.isfinite(both).all(axis=(0, 2))]
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    turn, _ = Rotation.align_vectors(a, b)
    scale = np.sqrt(np.square(a).sum() / np.square(b).sum())
    assert np.median(np.linalg.norm(a - scale * turn.apply(b), axis=1)) < 0.06
