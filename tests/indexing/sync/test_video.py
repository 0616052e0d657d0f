"""Tracks and brightness, each a check of the other."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from indexing.sync.synchronize import combine_methods, synchronize
from tests.indexing.sync.scene import FPS, shift, told

# torch's own, when it first loads its transforms; hidden outside of tests
pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated")


def test_two_methods_that_agree_decide_and_two_that_do_not_refuse():
    tracks, bright = shift(0.5, method="subspace", confidence=0.9), shift(0.52, method="brightness", confidence=0.8)
    unsure = dataclasses.replace(bright, **told({"ok": False, "reason": "halves differ"}))
    away = shift(2.5, method="brightness", confidence=0.99)
    assert (
        combine_methods(tracks, bright).ok
        and combine_methods(tracks, bright).method == "subspace"
        and combine_methods(tracks, bright).offset == 0.5
    )
    assert (
        combine_methods(tracks, unsure).ok
        and combine_methods(dataclasses.replace(tracks, **told({"ok": False})), bright).method == "brightness"
    )
    refused = combine_methods(tracks, away)
    assert not refused.ok and "tracks say +0.500 s (sure), brightness says +2.500 s (sure)" in refused.reason
    assert refused.peaks[:, 0].tolist() == pytest.approx([0.5, 1.6, 2.5, 3.6])
    assert not combine_methods(tracks, dataclasses.replace(away, **told({"ok": False}))).ok
    both = combine_methods(dataclasses.replace(tracks, **told({"ok": False, "reason": "too still"})), unsure)
    assert not both.ok and both.reason == "neither tracks nor brightness decide: too still; halves differ"


@pytest.fixture
def methods(monkeypatch, library):
    """Tracks and brightness, known: tracks of the values' first ``n`` points, brightness at +0.5 s."""
    import indexing.sync.brightness
    import indexing.video

    asked: dict = {"tracks": [], "brightness": [], "count": 12}

    def tracks(source, **_):
        asked["tracks"].append(source)
        points = torch.zeros(60, asked["count"], 2, dtype=torch.float64)
        return SimpleNamespace(points=points, times=torch.arange(60) / FPS, notes=("camera stands still",))

    def bright(a, b, **options):
        asked["brightness"].append((a, b, options))
        if asked.get("short"):
            raise ValueError("a: 5 frames are too few")
        return shift(-0.41, method="brightness", notes=("b: dark",), ok=not asked.get("dark"), reason="halves differ")

    monkeypatch.setattr(indexing.video, "track_points", tracks, raising=False)
    monkeypatch.setattr(indexing.sync.brightness, "brightness_shift", bright, raising=False)
    return asked


GRAY = np.random.default_rng(0).uniform(size=(60, 24, 32))


def test_gray_frames_by_every_method(methods, library):
    found = synchronize(GRAY, GRAY[5:] * 255, "tracks", fps=FPS, max_shift=1.0)
    assert found.notes == ("a: camera stands still", "b: camera stands still") and not library[0]["correspondence"]
    assert library[0]["a"].shape == (60, 12, 2) and library[0]["max_shift"] == 1.0 and not methods["brightness"]
    [chunk] = methods["tracks"][0]
    assert chunk.frames.dtype == np.uint8 and np.array_equal(chunk.times, np.arange(60) / FPS)
    assert np.array_equal(chunk.frames[5:], methods["tracks"][1][0].frames)  # 0 to 1 and 0 to 255 are the same picture
    found = synchronize(GRAY, GRAY[5:], "brightness", fps=FPS, max_shift=1.0)
    assert found.method == "brightness" and found.notes == ("b: dark",) and methods["brightness"][0][2]["max_shift"] == 1.0
    assert len(next(methods["brightness"][0][0]).frames) == 60
    found = synchronize(GRAY, GRAY[5:], fps=FPS)
    assert found.ok and found.offset == -0.4 and "brightness says -0.410 s (sure)" in found.notes[0]


def test_brightness_that_is_too_short_leaves_the_tracks_unconfirmed(methods, library):
    methods["short"] = True
    found = synchronize(GRAY, GRAY[5:], fps=FPS)
    assert not found.ok and "brightness says" in found.reason
    with pytest.raises(ValueError, match=r"too few"):
        synchronize(GRAY, GRAY[5:], "brightness", fps=FPS)


def test_keypoints_and_a_video_are_different_points(methods, library, cameras):
    found = synchronize(cameras[0], GRAY, fps=FPS)
    assert not library[0]["correspondence"] and library[0]["a"].shape[1] == 17 and library[0]["b"].shape[1] == 12
    assert found.ok and not methods["brightness"] and len(methods["tracks"]) == 1
    with pytest.raises(ValueError, match=r"b: is a video, and method='keypoints' needs keypoints"):
        synchronize(cameras[0], GRAY, "keypoints", fps=FPS)


def test_too_few_tracks_are_a_refusal(methods, library):
    methods["count"] = 3
    found = synchronize(GRAY, GRAY[5:], "tracks", fps=FPS)
    assert not found.ok and "fewer than 4 moving points could be followed in a and b" in found.reason and not library
    assert len(found.peaks) == len(found.scores) == 0 and found.confidence == 0
