"""Keypoint files of videos: what is written, what is reused, and what an interruption leaves."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from indexing import ClipSet
from indexing.pose import PoseOptions, detect, keypoint_file
from indexing.pose.options import PieceOptions
from indexing.readers import read
from indexing.readers.clipset import read_clip_set
from tests.indexing.pose.scene import drawn, joints_of, written
from tests.indexing.pose.test_detection import HEIGHT, WIDTH, film, person, walk

SHORT = PoseOptions(pieces=PieceOptions(seconds=0.5, lead=0.1))


def same(one: ClipSet, other: ClipSet) -> bool:
    """Bit for bit."""
    return len(one) == len(other) and all(
        a.joints.tobytes() == b.joints.tobytes()
        and a.times.tobytes() == b.times.tobytes()
        and a.confidence.tobytes() == b.confidence.tobytes()
        for a, b in zip(one, other, strict=True)
    )


def test_the_file_holds_what_was_found(tmp_path, seeing):
    path = film(tmp_path, [[walk(i)] for i in range(12)], fps=25)
    made = keypoint_file(path, tmp_path / "pose", json=True)
    assert not made.reused and made.path == tmp_path / "pose" / "a.npz" and made.folder == tmp_path / "pose" / "a_json"
    assert sorted(entry.name for entry in (tmp_path / "pose").iterdir()) == ["a.npz", "a_json"]
    clips = read_clip_set(made.path)
    assert same(clips, made.clips) and clips[0].up == "-y" and clips[0].skeleton.joints[0] == "nose"
    assert clips[0].meta["followed"] == "position" and list(clips[0].meta["size"]) == [WIDTH, HEIGHT]


def test_a_file_per_frame_as_openpose_has_them(tmp_path, seeing):
    scenes = [[walk(i, speed=2.0)] if i != 4 else [] for i in range(9)]
    made = keypoint_file(film(tmp_path, scenes, fps=10), tmp_path, every=2, json=True)
    files = sorted(made.folder.iterdir())
    assert [file.name for file in files] == [f"a_{number:012d}_keypoints.json" for number in (0, 2, 4, 6, 8)]
    frames = [json.loads(file.read_text()) for file in files]
    assert [frame["time"] for frame in frames] == pytest.approx([0, 0.2, 0.4, 0.6, 0.8])
    assert [len(frame["people"]) for frame in frames] == [1, 1, 0, 1, 1]
    (one,) = frames[1]["people"]
    table = np.reshape(one["pose_keypoints_2d"], (33, 3))
    assert one["person_id"] == [-1]
    np.testing.assert_allclose(table[:, :2], joints_of(*scenes[2][0]), atol=2)
    (clip,) = read(made.folder, fps=10)
    assert clip.joints.shape == (5, 33, 2) and np.isnan(clip.joints[2]).all()
    np.testing.assert_allclose(clip.joints[1], made.clips[0].joints[1], atol=1e-3)


def test_several_people_have_ids_in_both_files(tmp_path, seeing):
    scenes = [[person(60, 180, 40), *([person(200 + i, 160, 80)] if i > 5 else [])] for i in range(30)]
    made = keypoint_file(film(tmp_path, scenes), tmp_path, people=3, json=True)
    frames = [json.loads(file.read_text()) for file in sorted(made.folder.iterdir())]
    assert [one["person_id"] for one in frames[0]["people"]] == [[2]]
    assert [one["person_id"] for one in frames[-1]["people"]] == [[1], [2]]
    everyone = read(made.folder, fps=30, person="everyone")
    assert {clip.meta["person"] for clip in everyone} == {1, 2}
    assert {clip.meta["person"] for clip in read(made.path, person="everyone")} == {1, 2}
    assert len(read(made.path, person="largest")) == 1


def test_what_is_there_is_not_made_again(tmp_path, seeing):
    path = film(tmp_path, [[walk(i)] for i in range(12)])
    first = keypoint_file(path, tmp_path / "pose", json=True)
    again = keypoint_file(path, tmp_path / "pose", json=True)
    assert again.reused and again.found is None and same(first.clips, again.clips) and len(seeing) == 1
    moved = tmp_path / "elsewhere" / "a.mp4"
    moved.parent.mkdir()
    moved.write_bytes(path.read_bytes())
    assert keypoint_file(moved, tmp_path / "pose").reused


@pytest.mark.parametrize("how", [{"people": 2}, {"every": 2}, {"model": "full"}, {"options": SHORT}])
def test_other_arguments_make_another_file(tmp_path, seeing, how):
    path = film(tmp_path, [[walk(i)] for i in range(12)])
    keypoint_file(path, tmp_path / "pose")
    again = keypoint_file(path, tmp_path / "pose", **how)
    assert not again.reused and same(again.clips, read_clip_set(again.path))
    assert not keypoint_file(path, tmp_path / "pose").reused


def test_another_video_of_the_same_name_makes_another_file(tmp_path, seeing):
    path = film(tmp_path, [[walk(i)] for i in range(12)])
    keypoint_file(path, tmp_path / "pose")
    film(tmp_path, [[walk(i + 1)] for i in range(12)])
    assert not keypoint_file(path, tmp_path / "pose").reused


def test_a_folder_of_json_that_is_gone_comes_back(tmp_path, seeing):
    path = film(tmp_path, [[walk(i)] for i in range(12)])
    made = keypoint_file(path, tmp_path / "pose", json=True)
    before = {file.name: file.read_text() for file in made.folder.iterdir()}
    for file in made.folder.iterdir():
        file.unlink()
    made.folder.rmdir()
    assert keypoint_file(path, tmp_path / "pose", json=True).reused
    assert {file.name: file.read_text() for file in made.folder.iterdir()} == before


def test_files_of_others_are_left_alone(tmp_path, seeing):
    path = film(tmp_path, [[walk(i)] for i in range(12)])
    np.savez(tmp_path / "a.npz", joints=np.ones((3, 2, 2)))
    with pytest.raises(ValueError, match=r"a\.npz: is there, and no keypoint file of 'dyntorch pose'; move it away"):
        keypoint_file(path, tmp_path)
    (tmp_path / "pose" / "a_json").mkdir(parents=True)
    with pytest.raises(ValueError, match="a_json: is there, and not of this video"):
        keypoint_file(path, tmp_path / "pose", json=True)


def test_an_interrupted_video_goes_on_where_it_was_and_comes_out_the_same(tmp_path, seeing):
    path = film(tmp_path, [[walk(i), person(280, 200, 45)] for i in range(50)])
    expected = detect(path, people=2, options=SHORT)

    def interrupt(share):
        if share > 0.7:
            raise KeyboardInterrupt

    folder = tmp_path / "pose"
    with pytest.raises(KeyboardInterrupt):
        keypoint_file(path, folder, people=2, options=SHORT, progress=interrupt)
    assert not (folder / "a.npz").exists() and len(list((folder / ".a.parts").iterdir())) == 2
    before = len(seeing)
    made = keypoint_file(path, folder, people=2, options=SHORT)
    assert same(made.clips, expected) and same(read_clip_set(made.path), expected)
    assert sum(one.looks["landmarks"] for one in seeing[before:]) < 2 * 30  # of a hundred
    assert [entry.name for entry in folder.iterdir()] == ["a.npz"]


def test_what_was_killed_before_the_clip_set_was_written_goes_on(tmp_path, seeing, monkeypatch):
    path = film(tmp_path, [[walk(i)] for i in range(12)])
    with monkeypatch.context() as patch:
        patch.setattr(ClipSet, "save", lambda self, path: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            keypoint_file(path, tmp_path / "pose", json=True)
    assert (tmp_path / "pose" / "a_json").is_dir() and not (tmp_path / "pose" / "a.npz").exists()
    keypoint_file(path, tmp_path / "pose", json=True)
    assert sorted(entry.name for entry in (tmp_path / "pose").iterdir()) == ["a.npz", "a_json"]


def test_kept_pieces_of_other_arguments_or_cut_off_ones_are_not_used(tmp_path, seeing):
    path = film(tmp_path, [[walk(i)] for i in range(50)])

    def interrupt(share):
        if share > 0.7:
            raise KeyboardInterrupt

    for every in (2, 1):
        with pytest.raises(KeyboardInterrupt):
            keypoint_file(path, tmp_path / "pose", options=SHORT, every=every, progress=interrupt)
    kept = sorted((tmp_path / "pose" / ".a.parts").iterdir())
    assert len({file.name.partition("-")[0] for file in kept}) == 1
    kept[0].write_bytes(kept[0].read_bytes()[:200])
    made = keypoint_file(path, tmp_path / "pose", options=SHORT)
    assert same(made.clips, detect(path, options=SHORT))


def test_a_video_without_anybody_writes_nothing(tmp_path, seeing):
    path = film(tmp_path, [[]] * 5)
    with pytest.raises(ValueError, match="no person was found"):
        keypoint_file(path, tmp_path / "pose", json=True)
    assert not (tmp_path / "pose").exists()


def test_untimed_files_are_one_piece(tmp_path, seeing):
    frames = [drawn([walk(i)], WIDTH, HEIGHT) for i in range(30)]
    path = written(tmp_path / "raw.h264", frames)
    made = keypoint_file(Path(path), tmp_path / "pose", fps=15, options=SHORT)
    assert len(made.clips[0]) in (29, 30) and any("no timestamps" in note for note in made.found.notes)
    np.testing.assert_allclose(np.diff(made.clips[0].times), 1 / 15, atol=1e-9)
