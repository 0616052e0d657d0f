"""Keypoint files of videos: what is written, what is reused, and what an interruption leaves."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from indexing import ClipSet
from indexing.pose import PoseOptions, detect, keypoint_file
from indexing.pose.chunks import Store
from indexing.pose.detection import VideoTask
from indexing.pose.models import ModelSet
from indexing.pose.writing import keypoint_files, write_json_folder
from indexing.readers import read
from indexing.readers.formats.clipset import read_clip_set
from indexing.video.reading import Video
from tests.indexing.pose.scene import drawn, joints_of, written
from tests.indexing.pose.test_detection import HEIGHT, WIDTH, film, person, walk

SHORT = PoseOptions(chunk_seconds=0.5, lead_seconds=0.1)


def same(one: ClipSet, other: ClipSet) -> bool:
    """Bit for bit."""
    return len(one) == len(other) and all(
        a.joints.tobytes() == b.joints.tobytes()
        and a.times.tobytes() == b.times.tobytes()
        and a.confidence.tobytes() == b.confidence.tobytes()
        for a, b in zip(one, other, strict=True)
    )


def frames_in(folder: Path) -> dict[str, str]:
    """What a folder of JSON holds that others read, by name."""
    return {file.name: file.read_text() for file in sorted(folder.iterdir()) if not file.name.startswith(".")}


def interrupted(path: Path, folder: Path, **how) -> None:
    """A run that ends when two of four pieces or more are kept."""

    def interrupt(share):
        if share > 0.7:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        keypoint_file(path, folder, options=SHORT, progress=interrupt, **how)


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
    files = frames_in(made.folder)
    assert list(files) == [f"a_{number:012d}_keypoints.json" for number in (0, 2, 4, 6, 8)]
    assert not (made.folder / ".dyntorch").suffix  # Pose2Sim takes hidden files that end with .json for frames
    assert [file.name for file in made.folder.iterdir() if file.name not in files] == [".dyntorch"]
    frames = [json.loads(text) for text in files.values()]
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
    frames = [json.loads(text) for text in frames_in(made.folder).values()]
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
    before = frames_in(first.folder)
    shutil.rmtree(first.folder)  # a folder of JSON that is gone comes back
    assert keypoint_file(path, tmp_path / "pose", json=True).reused and frames_in(first.folder) == before


def test_other_arguments_make_another_file_and_own_folders_follow_the_video(tmp_path, seeing):
    path = film(tmp_path, [[walk(i)] for i in range(12)])
    for how in ({}, {"people": 2}, {"every": 2}, {"model": "full"}, {"options": SHORT}):
        made = keypoint_file(path, tmp_path / "pose", **how)
        assert not made.reused and same(made.clips, read_clip_set(made.path))
    keypoint_file(path, tmp_path / "pose", own=True)
    film(tmp_path, [[walk(i + 1)] for i in range(14)])
    again = keypoint_file(path, tmp_path / "pose", own=True)
    assert not again.reused and len(read_clip_set(again.path)[0]) == 14


def test_another_video_of_the_same_name_is_refused_before_any_work(tmp_path, seeing):
    path, folder = film(tmp_path, [[walk(i)] for i in range(12)]), tmp_path / "pose"
    made = keypoint_file(path, folder, json=True)
    before = made.path.read_bytes(), frames_in(made.folder), len(seeing)
    film(tmp_path, [[walk(i + 1)] for i in range(12)])
    said = r"a\.npz: holds the keypoints of another video of this name; move it away, or write to another folder"
    for how in ({}, {"json": True}, {"every": 2}):
        with pytest.raises(ValueError, match=said) as caught:
            keypoint_file(path, folder, **how)
        assert "\n" not in str(caught.value)
    assert (made.path.read_bytes(), frames_in(made.folder), len(seeing)) == before
    made.path.rename(tmp_path / "moved.npz")
    with pytest.raises(ValueError, match="a_json: holds the keypoints of another video of this name"):
        keypoint_file(path, folder, json=True)
    assert frames_in(made.folder) == before[1] and len(seeing) == before[2]
    made.folder.rename(tmp_path / "moved_json")
    assert not keypoint_file(path, folder, json=True).reused


def test_other_arguments_leave_no_stale_json(tmp_path, seeing):
    path, folder = film(tmp_path, [[walk(i)] for i in range(12)]), tmp_path / "pose"
    keypoint_file(path, folder, json=True)
    for every, asked in ((3, True), (4, False)):
        made = keypoint_file(path, folder, every=every, json=asked)
        assert not made.reused and made.folder == folder / "a_json" and len(frames_in(made.folder)) == 12 // every
        again = keypoint_file(path, folder, every=every, json=asked)
        assert again.reused and again.folder == made.folder


def test_json_and_clip_set_agree_after_a_kill_between_them(tmp_path, seeing, monkeypatch):
    path, folder = film(tmp_path, [[walk(i)] for i in range(12)]), tmp_path / "pose"

    def killed(**how):
        with monkeypatch.context() as patch:
            patch.setattr(ClipSet, "save", lambda self, path: (_ for _ in ()).throw(KeyboardInterrupt))
            with pytest.raises(KeyboardInterrupt):
                keypoint_file(path, folder, json=True, **how)

    killed()
    assert (folder / "a_json").is_dir() and not (folder / "a.npz").exists()
    before = frames_in(keypoint_file(path, folder, json=True).folder)
    assert sorted(entry.name for entry in folder.iterdir()) == ["a.npz", "a_json"]
    killed(every=3)
    assert frames_in(folder / "a_json") != before
    assert keypoint_file(path, folder).reused and frames_in(folder / "a_json") == before


def test_files_of_others_are_left_alone(tmp_path, seeing):
    path = film(tmp_path, [[walk(i)] for i in range(12)])
    np.savez(tmp_path / "a.npz", joints=np.ones((3, 2, 2)))
    with pytest.raises(ValueError, match=r"a\.npz: is there, and no keypoint file of 'dyntorch pose'; move it away"):
        keypoint_file(path, tmp_path)
    clips = detect(path)
    (tmp_path / "none").touch()
    with pytest.raises(ValueError, match=r"cannot write '.*a_json' \(Not a directory\); free the name or the disk"):
        write_json_folder(clips, np.arange(12), clips[0].times, tmp_path / "none" / "a_json")
    with pytest.raises(ValueError, match="no person was found"):
        keypoint_file(film(tmp_path, [[]] * 5, "b.mp4"), tmp_path / "pose", json=True)
    assert not (tmp_path / "pose").exists()


@pytest.mark.slow
@pytest.mark.parametrize("marked", ["", "{", "[]", "3", '{"made_from": "x"}'])
def test_a_folder_of_others_is_never_replaced(tmp_path, seeing, marked):
    path, folder = film(tmp_path, [[walk(i)] for i in range(50)]), tmp_path / "pose"
    theirs = folder / "a_json" / "mine.json"
    theirs.parent.mkdir(parents=True)
    theirs.write_text("mine")
    if marked:
        (theirs.parent / ".dyntorch").write_text(marked)
    said = r"a_json: is there, and no folder of 'dyntorch pose'; move it away, or write to another folder"
    with pytest.raises(ValueError, match=said):
        keypoint_file(path, folder, json=True)
    interrupted(path, folder)
    looks = len(seeing)
    with pytest.raises(ValueError, match=said):  # kept pieces say nothing of the folder
        keypoint_file(path, folder, json=True, options=SHORT)
    assert len(seeing) == looks
    assert keypoint_file(path, folder, options=SHORT).folder is None
    for how in ({"options": SHORT}, {"every": 2}):
        with pytest.raises(ValueError, match=said):
            keypoint_file(path, folder, json=True, **how)
    assert keypoint_file(path, folder, every=2).folder is None and theirs.read_text() == "mine"


@pytest.mark.slow
def test_a_folder_that_somebody_makes_meanwhile_is_not_replaced(tmp_path, seeing):
    path, folder = film(tmp_path, [[walk(i)] for i in range(50)]), tmp_path / "pose"

    def meanwhile(share):
        (folder / "a_json").mkdir(exist_ok=True)

    with pytest.raises(ValueError, match="a_json: is there, and no folder of 'dyntorch pose'"):
        keypoint_file(path, folder, json=True, options=SHORT, progress=meanwhile)
    (folder / "a_json").rmdir()
    before = len(seeing)
    assert same(keypoint_file(path, folder, json=True, options=SHORT).clips, detect(path, options=SHORT))
    assert len(seeing) == before + 1  # for detect: every piece was kept


def test_what_somebody_keeps_in_our_folder_is_not_lost(tmp_path, seeing):
    path, folder = film(tmp_path, [[walk(i)] for i in range(12)]), tmp_path / "pose"
    made = keypoint_file(path, folder, json=True)
    (made.folder / "notes.txt").write_text("mine")
    assert keypoint_file(path, folder, json=True).reused
    for asked in (True, False):
        with pytest.raises(ValueError, match=r"notes\.txt: is no file of 'dyntorch pose', and its folder is to be written again"):
            keypoint_file(path, folder, every=2, json=asked)
    assert (made.folder / "notes.txt").exists() and keypoint_file(path, folder).reused


@pytest.mark.slow
def test_an_interrupted_video_goes_on_where_it_was_and_comes_out_the_same(tmp_path, seeing):
    path = film(tmp_path, [[walk(i), person(280, 200, 45)] for i in range(50)])
    expected, folder = detect(path, people=2, options=SHORT), tmp_path / "pose"
    interrupted(path, folder, people=2)
    assert not (folder / "a.npz").exists() and len(list((folder / ".a.parts").iterdir())) == 2
    before = len(seeing)
    made = keypoint_file(path, folder, people=2, options=SHORT)
    assert same(made.clips, expected) and same(read_clip_set(made.path), expected)
    assert sum(one.looks["landmarks"] for one in seeing[before:]) < 2 * 30  # of a hundred
    assert [entry.name for entry in folder.iterdir()] == ["a.npz"]


@pytest.mark.slow
def test_a_piece_that_cannot_be_kept_ends_the_video_and_the_next_run_completes_it(tmp_path, seeing, monkeypatch):
    path, folder = film(tmp_path, [[walk(i)] for i in range(50)]), tmp_path / "pose"
    expected, put, failed = detect(path, options=SHORT), Store.save, []

    def full_once(self, piece, seen):
        if piece.number == 1 and not failed:
            failed.append(piece)
            raise ValueError("cannot write 'x' (No space left on device); free the disk")
        put(self, piece, seen)

    monkeypatch.setattr(Store, "save", full_once)
    with pytest.raises(ValueError, match="No space left on device"):
        keypoint_file(path, folder, json=True, options=SHORT)
    assert [entry.name for entry in folder.iterdir()] == [".a.parts"] and len(list((folder / ".a.parts").iterdir())) == 1
    made = keypoint_file(path, folder, json=True, options=SHORT)
    assert not made.reused and same(made.clips, expected) and not made.found.notes


@pytest.mark.slow
def test_a_run_that_fails_keeps_the_pieces_of_the_one_before_but_not_of_others(tmp_path, seeing, monkeypatch):
    path, folder = film(tmp_path, [[walk(i)] for i in range(50)]), tmp_path / "pose"
    for every in (2, 1):
        interrupted(path, folder, every=every)
    pieces = sorted((folder / ".a.parts").iterdir())
    assert len({file.name.partition("-")[0] for file in pieces}) == 1
    pieces[0].write_bytes(pieces[0].read_bytes()[:200])  # cut off: not used

    def fails(said):
        with pytest.raises(ValueError, match=said):
            keypoint_file(path, folder, options=SHORT, workers=2)
        assert [entry.name for entry in folder.iterdir()] == [".a.parts"] and len(list((folder / ".a.parts").iterdir())) == 2

    with monkeypatch.context() as patch:
        patch.setattr("indexing.pose.detection.LiteNetworks", lambda models: (_ for _ in ()).throw(ValueError("no such network")))
        fails("no such network")
    kept = path.rename(tmp_path / "elsewhere.mp4")
    fails("no such file")
    kept.rename(path)
    assert same(keypoint_file(path, folder, options=SHORT).clips, detect(path, options=SHORT))


@pytest.mark.slow
@pytest.mark.parametrize("becomes", [None, b"another"])
def test_a_video_that_is_gone_or_changed_meanwhile_makes_nothing_final(tmp_path, seeing, becomes):
    path, folder = film(tmp_path, [[walk(i)] for i in range(50)]), tmp_path / "pose"
    content, expected, gone = path.read_bytes(), detect(path, options=SHORT), []

    def meanwhile(share):
        if share > 0.5 and not gone:
            gone.append(share)
            path.unlink()
            if becomes is not None:
                path.write_bytes(becomes)

    with pytest.raises(ValueError, match=r"a\.mp4: (no such file|has changed while it was worked)"):
        keypoint_file(path, folder, options=SHORT, progress=meanwhile)
    assert not (folder / "a.npz").exists()
    path.write_bytes(content)
    assert same(keypoint_file(path, folder, options=SHORT).clips, expected)


def test_pieces_that_cannot_be_decoded_are_left_out_and_said(tmp_path, seeing, monkeypatch):
    path, stored = film(tmp_path, [[walk(i)] for i in range(50)]), Video.stored_frames

    def damaged(self):
        if 0.8 < self.span[0] < 1.2:
            raise ValueError("nothing can be decoded")
        return stored(self)

    monkeypatch.setattr(Video, "stored_frames", damaged)
    made = keypoint_file(path, tmp_path / "pose", options=SHORT, json=True)
    assert made.found.notes == ("1 part of it cannot be decoded (nothing can be decoded)",)
    assert len(made.clips[0]) == 35 and len(frames_in(made.folder)) == 35
    assert keypoint_file(path, tmp_path / "pose", options=SHORT).reused


@pytest.mark.slow
def test_a_clip_set_that_cannot_be_written_ends_only_its_video(tmp_path, seeing, monkeypatch):
    paths = [film(tmp_path, [[walk(i)] for i in range(50)], name) for name in ("a.mp4", "b.mp4")]
    save, folder = ClipSet.save, tmp_path / "pose"

    def full(self, path):
        if path.name == "a.npz":
            raise ValueError("cannot write 'a.npz'")
        save(self, path)

    monkeypatch.setattr(ClipSet, "save", full)
    tasks = [VideoTask(path, 1, 1, None, "heavy", SHORT) for path in paths]
    (_, one), (_, two) = keypoint_files(tasks, folder, ModelSet("heavy", b"", b"", ()), json=False)
    assert str(one) == "cannot write 'a.npz'" and two.path == folder / "b.npz"
    assert sorted(entry.name for entry in folder.iterdir()) == [".a.parts", "b.npz"]


def test_untimed_files_are_one_piece(tmp_path, seeing):
    frames = [drawn([walk(i)], WIDTH, HEIGHT) for i in range(30)]
    path = written(tmp_path / "raw.h264", frames)
    made = keypoint_file(Path(path), tmp_path / "pose", fps=15, options=SHORT)
    assert len(made.clips[0]) in (29, 30) and any("no timestamps" in note for note in made.found.notes)
    np.testing.assert_allclose(np.diff(made.clips[0].times), 1 / 15, atol=1e-9)
