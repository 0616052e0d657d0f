"""Clip sets: everything the format can say, round trips, and files that contradict themselves."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from indexing.clip import Clip, ClipSet
from indexing.readers import read
from indexing.readers.formats.clipset import FilmSet, holds_frames, read_clip_set, read_film_set, write_clip_set
from indexing.skeleton import COCO17, Skeleton
from tests.indexing.readers.tools import refused


def contents(**changes: Any) -> dict[str, Any]:
    """Two clips of 4 and 5 frames; ``None`` drops a key."""
    data: dict[str, Any] = {
        "joints": np.random.default_rng(0).normal(size=(9, 3, 2)).astype(np.float32),
        "offsets": np.array([0, 4, 9]),
        "action": np.array([1, 0]),
        "action_names": np.array(["run", "sit"]),
        "subject": np.array([7, 8]),
        "split": np.array([[0, 1, 0], [1, 0, 0]], dtype=np.int8),
    }
    return {key: value for key, value in (data | changes).items() if value is not None}


@pytest.fixture
def save(tmp_path: Path):
    def write(**changes: Any) -> Path:
        path = tmp_path / "moves.npz"
        np.savez(path, **contents(**changes))
        return path

    return write


def test_clips_labels_names_and_fields(save) -> None:
    clips = read(save())
    assert [len(clip) for clip in clips] == [4, 5]
    assert clips.labels.tolist() == ["sit", "run"]
    assert all(type(clip.label) is str for clip in clips)
    assert [clip.name for clip in clips] == ["moves[0]", "moves[1]"]
    assert clips.name == "moves.npz"
    np.testing.assert_array_equal(clips[1].joints, contents()["joints"][4:])
    assert clips[0].joints.dtype == np.float32
    assert clips.column("subject").tolist() == [7, 8]
    assert clips.column("split").shape == (2, 3)
    assert clips.select(split1=0)[0].label == "run"
    assert clips[0].skeleton is None
    assert [len(clip) for clip in read(save(offsets=None, action=None, subject=None, split=None))] == [9]  # one clip


def test_times_are_those_of_the_file_or_of_a_rate(save) -> None:
    clip, given = read(save())[0], read(save(), fps=10.0)[0]
    assert (clip.fps_assumed, given.fps_assumed) == (True, False)
    assert (clip.times[1], given.times[1]) == pytest.approx((1 / 30, 0.1))
    for fps, rates in ((60.0, [60, 60]), (np.array([25.0, 50.0]), [25, 50])):
        clips = read(save(fps=fps), fps=10.0)
        assert [clip.fps for clip in clips] == rates and [clip.times[1] for clip in clips] == [1 / rate for rate in rates]
        assert not any(clip.fps_assumed for clip in clips)
    frame = np.array([252, 254, 260, 262, 0, 1, 2, 5, 9], dtype=np.uint16)
    for known in ({"file": 10.0, "asked": None}, {"file": None, "asked": 10.0}):
        clips = read(save(frame=frame, fps=known["file"]), fps=known["asked"])
        assert [clip.times.tolist() for clip in clips] == [[25.2, 25.4, 26.0, 26.2], [0.0, 0.1, 0.2, 0.5, 0.9]]
    times = np.array([0.0, 0.1, 0.25, 0.3, 5.0, 5.1, 5.2, 5.3, 5.4])
    clips = read(save(times=times, frame=np.arange(9)))
    np.testing.assert_array_equal(np.concatenate([clip.times for clip in clips]), times)
    assert not clips[0].fps_assumed


def test_labels(save) -> None:
    for changes, labels in (
        ({"action": None}, [None, None]),
        ({"action_names": None}, [1, 0]),
        ({"action": np.array([-1, 1])}, [None, "sit"]),
        ({"action": np.array([np.nan, 0.0])}, [None, "run"]),
        ({"action": np.array(["hop", "run"]), "action_names": None}, ["hop", "run"]),
    ):
        assert [clip.label for clip in read(save(**changes))] == labels
        assert [clip.label for clip in read(save(**changes), label="x")] == ["x", "x"]


def test_skeleton_up_names_and_confidence(save) -> None:
    confidence = np.linspace(0.1, 0.9, 27).reshape(9, 3)
    joints = {"parents": np.array([-1, 0, 1]), "joint_names": np.array(["hip", "knee", "foot"])}
    path = save(confidence=confidence, up="-y", names=np.array(["a", "b"]), **joints)
    clips = read(path, min_confidence=0.5)
    assert clips[0].skeleton == Skeleton("moves", ("hip", "knee", "foot"), ((0, 1), (1, 2)))
    assert [clip.up for clip in clips] == ["-y", "-y"]
    assert [clip.name for clip in clips] == ["a", "b"]
    assert clips[0].meta["names"] == "a"
    np.testing.assert_array_equal(clips[1].seen, confidence[4:] >= 0.5)
    np.testing.assert_array_equal(clips[1].confidence, confidence[4:])
    assert read(save(bones=np.array([[0, 2]], dtype=np.uint8)))[0].skeleton == Skeleton("moves", ("0", "1", "2"), ((0, 2),))


CONTRADICTIONS: list[tuple[dict[str, Any], tuple[str, ...]]] = [
    ({"joints": None}, ("no 'joints'", "offsets, action", "save joints (F, n, 2 or 3)")),
    ({"joints": np.ones((9, 3))}, ("joints must have 3 dimensions", "(9, 3)")),
    ({"joints": np.ones((9, 3, 4))}, ("(9, 3, 4)", "save x, y")),
    ({"joints": np.full((9, 3, 2), "a")}, ("joints must be numbers",)),
    ({"joints": np.full((9, 3, 2), np.inf)}, ("moves[0]", "infinite", "NaN")),
    ({"joints": np.array([[[None, 1]]] * 9, dtype=object)}, ("joints", "pickle", "dtype")),
    ({"subject": np.array([{}, None], dtype=object)}, ("subject", "pickle", "dtype")),
    ({"offsets": None}, ("2 actions but no offsets", "save offsets")),
    ({"offsets": np.array([0, 4, 8])}, ("offsets run from 0 to 8", "9 frames")),
    ({"offsets": np.array([1, 4, 9])}, ("offsets run from 1",)),
    ({"offsets": np.array([0, 9, 4, 9])}, ("offsets must increase", "offsets[1:3] = [9, 4]")),
    ({"offsets": np.array([0, 4, 4, 9])}, ("offsets must increase", "leave empty clips out")),
    ({"offsets": np.array([0.0, 4.5, 9.0])}, ("integers",)),
    ({"action": np.array([0, 1, 1])}, ("action has 3 values for 2 clips",)),
    ({"action": np.array([0, 2])}, ("action[1] = 2", "2 action_names")),
    ({"action": np.array([0.5, 1.0])}, ("action must be integers",)),
    ({"frame": np.array([0, 1, 1, 2, 0, 1, 2, 3, 4])}, ("moves[0]", "frame must increase", "row 2", "drop repeated")),
    ({"frame": np.array([0, 1, 2, 3, 5, 4, 6, 7, 8])}, ("moves[1]", "frame must increase", "row 5", "sort")),
    ({"frame": np.arange(8)}, ("frame must be 9 numbers", "(8,)")),
    ({"times": np.array([0, 1, np.nan, 2, 0, 1, 2, 3, 4])}, ("moves[0]", "times must increase", "row 2")),
    ({"fps": 0.0}, ("fps must be positive",)),
    ({"fps": np.array([25.0, 30.0, 50.0])}, ("fps must be one value or one per clip (2)", "(3,)")),
    ({"confidence": np.ones((9, 2))}, ("confidence", "(9, 3)", "(9, 2)")),
    ({"confidence": np.where(np.arange(27).reshape(9, 3) == 4, np.nan, 1.0)}, ("moves[0]", "NaN at frame 1, joint 1", "give 0")),
    ({"joint_names": np.array(["a", "b"])}, ("2 names for 3 joints",)),
    ({"bones": np.array([[0, 3]])}, ("bones", "(0, 3)")),
    ({"up": "left"}, ("up", "left")),
    ({"up": "z"}, ("up", "3D")),
]


def test_contradictions_and_options_that_a_set_cannot_take_are_refused(save):
    for changes, words in CONTRADICTIONS:
        refused(save(**changes), *words)
    refused(save(), "no confidence", "at 0", min_confidence=0.5)
    refused(save(), "size", "leave size out", size=(640, 480))


def varied() -> list[Clip]:
    """Clips that use every field of Clip."""
    rng = np.random.default_rng(3)
    joints = rng.normal(size=(5, 17, 2))
    joints[2, 4] = np.nan
    confidence = rng.uniform(size=(5, 17))
    meta = {"view": 2, "subject": "ann", "split": np.array([0, 1])}
    return [
        Clip(joints, times=np.array([0.0, 0.1, 0.4, 0.5, 0.9]), label="hop", name="one", skeleton=COCO17, up="-y", meta=meta),
        Clip(joints[:3], fps=12.5, confidence=confidence[:3], name="two", skeleton=COCO17, meta=meta | {"view": 3}),
        Clip(joints[1:], label="run", name="three", meta=meta),
    ]


def test_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "set.npz"
    ClipSet(varied()).save(path)
    for before, after in zip(varied(), ClipSet.load(path), strict=True):
        np.testing.assert_array_equal(before.joints, after.joints)
        np.testing.assert_array_equal(before.times, after.times)
        for field in ("label", "name", "fps", "fps_assumed", "up"):
            assert getattr(before, field) == getattr(after, field), field
        assert after.skeleton == COCO17
        assert (before.confidence is None) == (after.confidence is None)
        if before.confidence is not None:
            np.testing.assert_array_equal(before.confidence, after.confidence)
        assert {key: np.asarray(after.meta[key]).tolist() for key in before.meta} == {
            key: np.asarray(value).tolist() for key, value in before.meta.items()
        }
    again = tmp_path / "again.npz"
    write_clip_set(read_clip_set(path), again)
    first, second = np.load(path), np.load(again)
    assert all(np.array_equal(first[key], second[key], equal_nan=first[key].dtype.kind == "f") for key in first.files)
    write_clip_set([Clip(np.ones((2, 3, 2)), label=label) for label in (4, 0, None)], path)
    assert [clip.label for clip in read_clip_set(path)] == [4, 0, None]


UNWRITABLE: list[tuple[list[Clip], tuple[str, ...]]] = [
    ([], ("no clips",)),
    ([Clip(np.ones((2, 3, 2))), Clip(np.ones((2, 4, 2)))], ("(3, 2), (4, 2)", "one file per layout")),
    ([Clip(np.ones((2, 3, 2)), label="a"), Clip(np.ones((2, 3, 2)), label=1)], ("label 'a'", "text for all")),
    ([Clip(np.ones((2, 3, 2)), label=-1)], ("label -1", "from 0")),
    ([Clip(np.ones((2, 3, 2)), meta={"view": 1}), Clip(np.ones((2, 3, 2)), name="b")], ("'b'", "'view'", "to none")),
    ([Clip(np.ones((2, 3, 2)), meta={"owner": object()})], ("'owner'", "drop it")),
    (
        [Clip(np.ones((2, 2, 2)), skeleton=Skeleton(name, ("a", "b"))) for name in "pq"],
        ("different skeletons (p, q)", "one file per skeleton"),
    ),
]


def test_what_cannot_be_written_is_refused_and_nothing_is_left(tmp_path: Path) -> None:
    path = tmp_path / "set.npz"
    for clips, words in UNWRITABLE:
        refused(path, *words, action=lambda _, clips=clips: write_clip_set(clips, path))
    assert list(tmp_path.iterdir()) == []


# Film sets: frames in place of joints, everything else as in a clip set


FRAMES = np.arange(9 * 4 * 5, dtype=np.uint8).reshape(9, 4, 5)
WHOLE = {"frames": FRAMES, "offsets": [0, 4, 9], "action": [1, 0], "action_names": ["run", "sit"], "subject": [7, 8], "fps": 10.0}


def test_what_is_written_is_read(tmp_path):
    np.savez(tmp_path / "films.npz", **WHOLE)
    films = read_film_set(tmp_path / "films.npz")
    assert isinstance(films, FilmSet) and films.labels.tolist() == ["sit", "run"]
    assert np.array_equal(films[1].frames, FRAMES[4:]) and films[1].times.tolist() == pytest.approx([0, 0.1, 0.2, 0.3, 0.4])
    assert [film.label for film in films.select(subject=8)] == ["run"]
    assert films.fields == ("subject",) and films[0].duration == pytest.approx(0.3)
    np.savez(tmp_path / "a.npz", **WHOLE, frame=[3, 4, 6, 7, 0, 1, 2, 3, 5])
    assert read_film_set(tmp_path / "a.npz")[0].times.tolist() == pytest.approx([0, 0.1, 0.3, 0.4])  # from zero


def test_frames_are_told_from_joints(tmp_path):
    np.savez(tmp_path / "films.npz", **WHOLE)
    np.savez(tmp_path / "clips.npz", joints=np.ones((4, 3, 2)))
    (tmp_path / "broken.npz").write_bytes(b"PK nothing")
    found = [holds_frames(tmp_path / name) for name in ("films.npz", "clips.npz", "broken.npz", "absent.npz")]
    assert found == [True, False, False, False]


def test_bad_sets_are_refused(tmp_path):
    for change, says in (
        ({"frames": FRAMES.astype(float)}, "uint8"),
        ({"frames": FRAMES[0]}, "3 dimensions"),
        ({"offsets": [0, 4, 8]}, "frames has 9 frames"),
    ):
        np.savez(tmp_path / "films.npz", **(WHOLE | change))
        refused(tmp_path / "films.npz", says, action=read_film_set)
