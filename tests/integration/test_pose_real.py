"""Poses in real videos, by the real networks; skipped where DYNTORCH_DATA names no folder, or the model files are not there."""

from __future__ import annotations

import os
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

from indexing import synchronize
from indexing.pose import available, detect, keypoint_file, networks
from indexing.pose.models import VARIABLE, cache_folder, load_models
from indexing.pose.networks import LiteNetworks
from indexing.readers import read


def fetched() -> Path:
    """Where the model files are, whatever the tests of everything else are told."""
    if available() is not None:
        return cache_folder()
    with mock.patch.dict(os.environ):
        os.environ.pop(VARIABLE, None)
        return cache_folder()


MODELS = fetched()
DATA = Path(os.environ.get("DYNTORCH_DATA") or ".")
pytestmark = [
    pytest.mark.skipif(not os.environ.get("DYNTORCH_DATA"), reason="DYNTORCH_DATA is not set: no real data"),
    pytest.mark.skipif(available(MODELS) is None, reason="no pose model files: dyntorch pose --get-models fetches them"),
]


def test_two_videos_are_synchronized_by_what_the_sharp_network_sees() -> None:
    if available(MODELS) != "heavy":
        pytest.skip("the network heavy was not fetched")
    a, b = (detect(DATA / "pose2sim" / f"{name}.mp4", models=MODELS)[0] for name in ("cam01", "cam02"))
    assert a.seen.all() and b.seen.all() and len(a) == len(b) == 100
    late = b.between(float(b.times[12]) - 1e-6, 9)
    shift = synchronize(a, late.replace(times=late.times - late.times[0]))
    assert shift.ok and abs(shift.offset * 60 + 12) < 0.5


def test_the_person_and_the_bystander_are_two(tmp_path: Path) -> None:
    made = keypoint_file(DATA / "pose2sim" / "cam01.mp4", tmp_path, 3, model="full", models=MODELS, every=5, json=True)
    assert [clip.meta["person"] for clip in made.clips] == [1, 2] and all(clip.seen.any(axis=1).all() for clip in made.clips)
    large, small = (
        float((np.nanmax(y, axis=1) - np.nanmin(y, axis=1)).mean()) for y in (clip.joints[..., 1] for clip in made.clips)
    )
    assert large > 1.5 * small
    assert made.folder is not None and len(read(made.folder, fps=12.0, person="everyone")) == 2


def test_joints_are_where_another_detector_sees_them() -> None:
    with np.load(DATA / "pose2sim" / "pose2sim_balancing.npz") as file:
        theirs = file["keypoints"][0]
    (clip,) = detect(DATA / "pose2sim" / "cam01.mp4", model="full", models=MODELS, every=10)
    assert clip.skeleton is not None
    names = ("left_shoulder", "right_shoulder", "left_hip", "right_hip", "left_knee", "right_knee", "left_ankle", "right_ankle")
    body25b = dict(zip(names, (5, 6, 11, 12, 13, 14, 15, 16), strict=True))
    for name, index in body25b.items():
        joint = clip.joints[:, clip.skeleton.joints.index(name)]
        other = theirs[::10, index]
        apart = np.linalg.norm(joint - other[:, :2], axis=1)[other[:, 2] > 0.3]
        assert np.median(apart) < 60, name  # pixels, of a body of 850


@pytest.mark.parametrize("name", ["heavy", "full", "lite"])
def test_a_pruned_network_computes_the_same(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if not (MODELS / f"pose_landmark_{name}.tflite").exists():
        pytest.skip(f"the network {name} was not fetched")
    models = load_models(name, MODELS)
    image = np.random.default_rng(0).integers(0, 255, (256, 256, 3)).astype(np.uint8)
    short = LiteNetworks(models).landmarks(image)
    monkeypatch.setattr("indexing.pose.networks.prune", lambda model, wanted: model)
    whole = LiteNetworks(models).landmarks(image)
    assert len(networks.prune(models.landmarks, {1})) == len(models.landmarks)
    for a, b in zip(short, whole, strict=True):
        np.testing.assert_array_equal(a, b)


def test_signs_are_seen_in_every_frame() -> None:
    for name in ("again", "brother", "walk"):
        (clip,) = detect(DATA / "asl_gestures" / f"{name}.mkv", model="full", models=MODELS)
        assert clip.seen.any(axis=1).mean() >= 0.99
