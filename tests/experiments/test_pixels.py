"""Recognition from pixels: films, baselines and figures on small synthetic videos."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from experiments.recognition import brightness_indexing, gestures, protocol
from experiments.recognition.brightness_baselines import BASELINES, FrameNearest
from indexing import Clip
from indexing.skeleton import Skeleton

FPS = 15.0


def blob(direction: tuple[float, float], seed: int = 0, frames: int = 24) -> np.ndarray:
    """A textured patch that goes one way over a textured background."""
    rng = np.random.default_rng(seed)
    video = np.tile(rng.integers(60, 120, (48, 64)), (frames, 1, 1))
    patch = np.kron(rng.integers(0, 255, (4, 4)), np.ones((4, 4)))
    for t in range(frames):
        x, y = (round(c + (t - frames / 2) * d) for c, d in zip((24, 16), direction, strict=True))
        video[t, y : y + 16, x : x + 16] = patch
    return video.astype(np.uint8)


WAYS = {"right": (1.5, 0.0), "left": (-1.5, 0.0), "down": (0.0, 1.2)}


@pytest.mark.parametrize("name", ["energy grid", "HOG", "activity correlation"])
def test_baselines_describe_every_frame_by_a_bounded_row(name: str) -> None:
    rows = BASELINES[name](blob(WAYS["right"]), FPS)
    assert len(rows) == 24
    assert bool(rows.isfinite().all()) and float(rows.norm(dim=1).max()) <= 1 + 1e-6
    assert float(BASELINES[name](np.full((24, 48, 64), 90, np.uint8), FPS).abs().max()) < 1e-3  # nothing moves


def test_tracks_tell_directions_apart() -> None:
    pytest.importorskip("cv2")
    rows = BASELINES["tracks"](blob(WAYS["right"]), FPS)
    share = rows.square().unflatten(1, (4, -1)).sum(2).sum(0)
    assert share.argmax() == 0 and float(share[0]) > 5 * float(share[1])  # right, not left
    assert not bool(BASELINES["tracks"](np.full((12, 48, 64), 90, np.uint8), FPS).any())


def test_nearest_frames_know_their_own_video() -> None:
    videos = [blob(way) for way in WAYS.values()]
    learned = FrameNearest(BASELINES["energy grid"], FPS).fit(videos, list(WAYS))
    whole, each = learned.answer(videos[2])
    assert learned.classes_[whole.argmax()] == "down" and each.shape == (24, 3)


def test_moving_frames_are_those_in_which_something_moves() -> None:
    video = np.concatenate([blob(WAYS["right"])[:12], np.tile(blob(WAYS["right"])[11], (12, 1, 1))])
    counted = brightness_indexing.moving(video)
    assert counted[9:11].all() and not counted[:8].any() and not counted[13:].any()


class Told:
    """Knows the answer from the brightness of the first pixel."""

    def fit(self, videos, labels):
        self.classes_ = np.unique(labels)
        return self

    def answer(self, video):
        scores = (self.classes_ == video[0, 0, 0]).astype(float)
        return scores, np.tile(scores, (len(video), 1))


def test_arm_figures_count_videos_frames_and_margins() -> None:
    videos, actions, people = [], np.array([1, 2, 1, 2]), np.array([1, 1, 2, 2])
    for action in actions:
        video = blob(WAYS["right"])
        video[:, 0, 0] = action
        videos.append(video)
    assert brightness_indexing.arms(Told, videos, actions, people) == (4, 1.0, 1.0)
    videos[0][:, 0, 0] = 2
    hits, frames, margin = brightness_indexing.arms(Told, videos, actions, people)
    assert (hits, margin) == (3, -1.0) and frames == pytest.approx(0.75)


def test_frames_of_unlearned_exercises_are_left_out() -> None:
    def stream(subject: str, labels: list[int]) -> brightness_indexing.Filmed:
        video = np.zeros((len(labels), 8, 8), np.uint8)
        video[:] = np.array(labels, np.uint8)[0]
        return brightness_indexing.Filmed(subject, {"learned": video, "0": video, "60": video}, np.array(labels))

    shares, count = brightness_indexing.exercises(Told, [stream("13", [1] * 9 + [2] * 9), stream("14", [1] * 9 + [3] * 9)])
    assert shares == [1.0, 1.0] and count == 18


def test_captured_joints_become_coco_ones_at_the_ends_of_the_bones(monkeypatch) -> None:
    names = tuple(dict.fromkeys(brightness_indexing.JOINTS))
    rng = np.random.default_rng(0)
    joints = rng.normal(size=(1, len(names), 3)) + np.zeros((24, 1, 1))
    clip = Clip(joints, fps=30.0, skeleton=Skeleton("captured", names, ((0, 1),)))
    coco = brightness_indexing.as_coco(clip)
    left = coco.skeleton.joints.index("left_knee")
    np.testing.assert_array_equal(coco.joints[:, left], joints[:, names.index("lfemur")])
    labels = np.repeat([1, 2], 4)
    monkeypatch.setattr(protocol, "load_exercises", lambda: [protocol.Exercise("13_1", clip, labels)])
    (film,) = brightness_indexing.films(0)
    assert film.labels.tolist() == [1] * 6 + [2] * 6
    assert set(film.views) == {"learned", "0", "60"} and len(film.views["0"]) == 12
    assert not np.array_equal(film.views["learned"], film.views["0"])  # own texture, own background


def test_changes_change_what_they_say() -> None:
    video, rng = blob(WAYS["right"]), np.random.default_rng(0)
    changed = {name: change(video, rng) for name, change in gestures.CHANGES.items()}
    assert all(one.dtype == np.uint8 and one.shape[1:] == video.shape[1:] for one in changed.values())
    assert {name: len(one) for name, one in changed.items() if len(one) != 24} == {
        "1.4 x faster": 17, "0.7 x as fast": 33, "middle 60 %": 14,
    }  # fmt: skip
    np.testing.assert_array_equal(changed["backwards"][0], video[-1])
    np.testing.assert_array_equal(changed["mirrored"][:, :, 0], video[:, :, -1])
    np.testing.assert_array_equal(gestures.tempo(video, rng, 2.0), video[:-1:2])
    assert changed["light"].mean() < video.mean() and changed["noise"].std() > video.std()


def test_signs_are_found_again(tmp_path: Path, monkeypatch, capsys) -> None:
    for name in WAYS:
        (tmp_path / "asl_gestures").mkdir(exist_ok=True)
        (tmp_path / "asl_gestures" / f"{name}.mkv").touch()
    monkeypatch.setenv(protocol.DATA, str(tmp_path))
    videos = [blob(way, seed) for seed, way in enumerate(WAYS.values())]
    monkeypatch.setattr(gestures, "signs", lambda count: (videos, np.array(list(WAYS))))
    monkeypatch.setattr(gestures, "CHANGES", {name: gestures.CHANGES[name] for name in ("none", "backwards")})
    monkeypatch.setattr(gestures, "heat", lambda *a: b"heat")
    gestures.run(gestures.Config(methods=("energy grid", "still image"), out=tmp_path / "out"))
    (table,) = json.loads((tmp_path / "out" / "figures.json").read_text())["tables"].values()
    assert table["lines"]["still image"][:3] == [1.0, 1.0, 1.0]  # the picture alone is the same backwards
    assert table["lines"]["energy grid"][0] == 1.0
    assert "backwards: less is better" in capsys.readouterr().out


def test_without_videos_one_line_says_so(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv(protocol.DATA, str(tmp_path))
    with pytest.raises(ValueError, match=r"at least two \.mkv files, found 0"):
        gestures.signs(20)
