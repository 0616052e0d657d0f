"""From recordings to a rig: whatever is given, who is who, and where the metres come from."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import dyntorch
from dyntorch.core import Notice, status_from
from indexing.calibrate import CameraRig, calibrate
from indexing.calibrate import pipeline as verb
from indexing.calibrate.people import PeopleNotice
from indexing.calibrate.priors import scale_calibration, scale_to_metres, standing_extent
from indexing.report.calibration import CalibrationReport, write_calibration
from indexing.skeleton import COCO17
from tests.indexing.calibrate.scene import FPS, LATE, SIZE, Asked, filmed, solved, truth, write_cameras


@pytest.fixture
def library(monkeypatch):
    """The truth in another unit; records how it was asked."""
    asked: list[dict] = []

    def answer(tracks, **options):
        asked.append({"tracks": tracks, **options})
        n = tracks[0].shape[1] // 17
        return replace(scale_calibration(solved(n, notices=(Notice(Asked.NOTE, 0.0, {"text": "x"}),)), 0.2), metric=False)

    monkeypatch.setattr(dyntorch, "calibrate", answer, raising=False)
    return asked


@pytest.mark.slow
def test_folders_clips_and_arrays_are_the_same(library, tmp_path):
    folder = write_cameras(tmp_path)
    clips = [own[0] for own in filmed()]
    arrays = [np.asarray(clip.joints) for clip in clips]
    rigs = [calibrate(one, fps=FPS, sizes=SIZE) for one in (folder, [folder / f"cam{i}" for i in (1, 2, 3)], clips, arrays)]
    assert all(isinstance(one, CameraRig) and one.ok and one.names == ["cam1", "cam2", "cam3"] for one in rigs)
    for asked in library:
        assert asked["fps"] == (FPS,) * 3 and asked["sizes"] == [SIZE] * 3
        for x, y, times, late in zip(asked["tracks"], arrays, asked["times"], LATE, strict=True):
            assert np.allclose(x, y) and np.allclose(times, np.arange(110 - late) / FPS)
    assert rigs[2].check() is rigs[2] and rigs[2].people[0].joints.shape == (110, 17, 3) and not rigs[2].calibration.metric
    assert rigs[3].joints.skeleton is not None  # 17 joints are COCO's


def test_a_height_gives_metres(library):
    clips, asked = [own[0] for own in filmed()], dyntorch.CalibrateOptions()
    rig = calibrate(clips, sizes=SIZE, height=1.62, options=asked)
    assert library[0]["options"] is asked
    head, feet = truth().points[:, 1:3, 2].mean(axis=1), truth().points[:, 15:, 2].min(axis=1)
    factor = (0.936 - 0.039) * 1.62 / np.quantile(head - feet, 0.75)
    assert rig.calibration.metric and rig.units == "m" and rig.stature.height == 1.62
    assert torch.allclose(rig.calibration.points, factor * torch.from_numpy(truth().points), rtol=0.02)
    exact = float(rig.calibration.t[0].norm() / solved().t[0].norm())
    assert torch.allclose(rig.calibration.centers, exact * solved().centers)
    assert torch.allclose(rig.calibration.covariance[:, 3:6, 3:6], exact**2 * solved().covariance[:, 3:6, 3:6])
    assert torch.equal(rig.calibration.covariance[:, 6:, 6:], solved().covariance[:, 6:, 6:])
    assert "frames in which the body is straight" in rig.stature.note and any(rig.stature.note in note for note in rig.notes)


def test_somebody_who_never_stands_straight_is_measured_by_trunk_and_legs():
    base, stature = solved(), standing_extent(COCO17.joints, 1.75)

    def scaled(points, joints=COCO17.joints):
        return scale_to_metres(replace(base, points=points, metric=False), stature, joints)

    tall = scaled(base.points)[0]
    up = base.points.clone()
    up[:, 9:11, 2] += 3.0  # wrists above the head do not make anybody smaller
    assert torch.allclose(scaled(up)[0].t, tall.t)
    low = (base.points[:, 5, 2] < base.points[:, 5, 2].median() - 0.1).nonzero()[:, 0]
    assert len(low) >= 10
    short, how = scaled(base.points[low])  # the knees bent
    assert "trunk and legs" in how.measured and how.sigma == pytest.approx(0.03 * stature.extent)
    assert float(short.t[0].norm()) == pytest.approx(float(tall.t[0].norm()), rel=0.12)
    gone = base.points.clone()
    gone[5:, 15:] = torch.nan
    none = scaled(gone)[1]
    assert none is None or "trunk" in none.measured
    gone[:, 11:] = torch.nan
    same, none = scaled(gone)
    assert none is None and not same.metric
    kept = [i for i, name in enumerate(COCO17.joints) if "hip" not in name]
    assert "farthest apart" in scaled(base.points[:, kept], [COCO17.joints[i] for i in kept])[1].measured


@pytest.mark.slow
def test_two_people_are_matched_whatever_their_order(library):
    cameras = filmed(2)
    rig = calibrate([cameras[0], cameras[1][::-1], cameras[2]], sizes=SIZE, clocks=[-late / FPS for late in LATE])
    assert rig.persons == 2 and rig.identities.ok and len(rig.people) == 2
    [asked] = library
    first = asked["tracks"][0][0, 0] - torch.from_numpy(cameras[0][0].joints[0, 0].copy())
    order = 1 if float(first.abs().max()) < 1e-6 else -1
    for tracks, own in zip(asked["tracks"], cameras, strict=True):
        expected = np.concatenate([clip.joints for clip in own[::order]], axis=1)
        known = ~torch.isnan(tracks)
        assert known.double().mean() > 0.95 and np.allclose(tracks[known], torch.from_numpy(expected)[known])
    assert [clip.meta["person"] for clip in rig.people] == ["1", "2"] and "1:nose" in rig.point_names
    one = calibrate([cameras[0], cameras[1][::-1], cameras[2]], sizes=SIZE, people=1)
    assert one.persons == 1 and one.identities is None


@pytest.mark.slow
def test_left_taken_for_right_is_mended_before_the_last_word(library, tmp_path):
    clips = [own[0] for own in filmed()]
    swapped = np.array(clips[1].joints)
    left, right = np.arange(5, 17, 2), np.arange(6, 17, 2)
    swapped[30:60, np.r_[left, right]] = swapped[30:60, np.r_[right, left]]
    swapped[30:60, 1:5] = swapped[30:60, [2, 1, 4, 3]]
    rig = calibrate([clips[0], clips[1].replace(joints=swapped), clips[2]], sizes=SIZE, clocks=[-late / FPS for late in LATE])
    assert len(library) == 2 and {one.camera for one in rig.exchanges} == {1}
    first, last = (np.asarray(asked["tracks"][1]) for asked in library)
    assert np.allclose(first, swapped) and (np.abs(last - clips[1].joints).max(axis=(1, 2)) < 1e-6).mean() > 0.95
    assert any(note.startswith("cam2: left and right exchanged 1 times (body; ") for note in rig.notes), rig.notes
    assert np.allclose(rig.views[1].people[0].joints, last)
    write_calibration(tmp_path, CalibrationReport(rig))
    [said] = json.loads((tmp_path / "calibration.json").read_text())["exchanges"]
    assert said["camera"] == "cam2" and said["person"] == 1 and said["start"] == pytest.approx(1.0, abs=0.1)


def test_what_the_library_says_names_people_and_cameras(library, monkeypatch):
    notices = (Notice(PeopleNotice.NOBODY, 0.0),)
    found = SimpleNamespace(ok=False, status=status_from(notices), notices=notices, notes=())
    monkeypatch.setattr(verb, "associate", lambda *_, **__: found)
    rig = calibrate(filmed(2), sizes=SIZE)
    assert not rig.ok and str(notices[0].text) in rig.reason and library == []
    assert any("person='largest' uses the largest person" in note for note in rig.notes) and rig.people == ()

    def answer(tracks, **_):
        raise ValueError("camera 1: no point is seen; check the detections")

    monkeypatch.setattr(dyntorch, "calibrate", answer, raising=False)
    with pytest.raises(ValueError, match=r"camera 1: no point is seen; .* \(camera 0 is cam1, 1 is cam2, 2 is cam3\)"):
        calibrate([own[0] for own in filmed()], sizes=SIZE)


def test_bad_arguments(library):
    for more, said in (
        ({"fps": [30, 25]}, "fps= gives 2 values for 3 cameras"),
        ({"sizes": [(1920, 1080)] * 2}, "size= gives 2 sizes for 3 cameras"),
        ({"sizes": (0, 1080)}, "size= must be width and height of the picture in pixels"),
        ({"sizes": None}, "cam1: the size of its picture is not known"),
        ({"height": 1.75, "lengths": {("nose", "left_hip"): 0.5}}, "height and length both fix the scale"),
        ({"lengths": {("nose", "left_hip"): 420.0}}, "length nose left_hip: expected two joints and the metres .*, got 420"),
        ({"clocks": [0.0, 100.0, 0.0]}, "cam2 recorded from -100.000 to -96.767 s"),
        ({"person": "nobody"}, "person must be one of"),
    ):
        with pytest.raises(ValueError, match=said):
            calibrate(filmed(), **{"sizes": SIZE, **more})
    assert library == []
