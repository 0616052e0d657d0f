"""What becomes of everything that is given to an archive: each source one outcome, and the archive as if nothing else had been."""

from __future__ import annotations

import json
import os
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from indexing import Archive, ArchiveOptions, Clip, ClipSet
from indexing.archive import sources
from indexing.archive.sources import gather, reading_key
from indexing.skeleton import Skeleton
from tests.indexing.cli.footage import write_coco


def said(done) -> dict[str, str]:
    """What became of each source, by the last part of its name."""
    return {os.path.basename(one.source): one.outcome for one in done.sources}


def reason(done, name: str) -> str:
    """The one line of a source."""
    (found,) = [one.reason for one in done.sources if os.path.basename(one.source) == name]
    assert "\n" not in found
    return found


def names(archive: Archive) -> list[str]:
    return [os.path.basename(row.source) for row in archive.recordings()]


def frames(folder: Path, clip: Clip) -> Path:
    """A folder as OpenPose writes it: a JSON file for each frame."""
    folder.mkdir(parents=True)
    for i, pose in enumerate(clip.joints):
        values = np.concatenate([pose, np.full((len(pose), 1), 0.9)], axis=1).ravel().round(2).tolist()
        (folder / f"clip_{i:06d}_keypoints.json").write_text(
            json.dumps({"version": 1.3, "people": [{"pose_keypoints_2d": values}]})
        )
    return folder


# ---- what is known, what has changed -------------------------------------------------------------------------------------
def test_what_is_known_is_left_alone(archive: Archive, saved, moves) -> None:
    given = [saved("a.npz", 0), saved("b.npz", 1), moves(2, name="c")]
    assert set(said(archive.add(given)).values()) == {"added"}
    segments, windows = archive.info().segments, len(archive)
    assert said(archive.add(given)) == {"a.npz": "known", "b.npz": "known", "c": "known"}
    assert said(archive.add([saved("d.npz", 3), *given])) == {"d.npz": "added", "a.npz": "known", "b.npz": "known", "c": "known"}
    assert archive.info().segments == segments + 1 and len(archive) > windows


def test_a_changed_file_is_replaced_and_a_touched_one_is_not(archive: Archive, saved, moves) -> None:
    path = saved("a.npz", 0)
    archive.add([path, moves(5, name="other")])
    before = archive.clip(str(path))
    os.utime(path, ns=(1, 1))
    assert said(archive.add(path)) == {"a.npz": "known"}
    assert archive.info().dead == 0
    saved("a.npz", 1)
    assert said(archive.add(path)) == {"a.npz": "replaced"}
    assert names(archive) == ["other", "a.npz"] and archive.verify().ok
    assert not np.allclose(archive.clip(str(path)).joints, before.joints)
    assert archive.search(moves(1), k=1)[0].source == str(path)
    assert said(archive.add(path)) == {"a.npz": "known"}


def test_a_file_is_known_by_where_it_is(archive: Archive, saved, tmp_path: Path, monkeypatch) -> None:
    path = saved("a.npz")
    (tmp_path / "link.npz").symlink_to(path)
    monkeypatch.chdir(tmp_path)
    assert [one.outcome for one in archive.add(["a.npz", path, "./a.npz", "link.npz"]).sources] == ["added"]
    assert said(archive.add(path)) == {"a.npz": "known"}


def test_the_same_files_read_otherwise_are_replaced(archive: Archive, saved, moves) -> None:
    path = saved("a.npz", confidence=np.full((90, 8), 0.9))
    archive.add([path, moves(1, name="clip")])
    usual = {"person": "everyone", "fps": None, "min_confidence": 0.0, "format": None, "size": None}
    assert said(archive.add(path, reading=usual)) == {"a.npz": "known"}  # as the command line says it
    done = archive.add([path, moves(1, name="clip")], reading={"min_confidence": 0.3})
    assert said(done) == {"a.npz": "replaced", "clip": "known"}  # clips are as they are
    with pytest.raises(ValueError, match=r"reading: nothing is known of 'fsp'; give some of format, fps"):
        archive.add(path, reading={"fsp": 25.0})
    assert reading_key({"size": (4.0, 3.0)}) == '{"size": [4.0, 3.0]}'


def test_clips_are_known_by_name_and_content(archive: Archive, moves) -> None:
    archive.add([moves(0, name="a"), moves(1, name="b"), moves(2)])
    assert said(archive.add([moves(0, name="a"), moves(3, name="b")])) == {"a": "known", "b": "replaced"}
    assert [one.outcome for one in archive.add(moves(2)).sources] == ["known"]  # without a name, by content
    assert len(archive.recordings()) == 3
    turned = moves(0, name="a").replace(up="-y")
    assert said(archive.add(turned)) == {"a": "replaced"}
    named = turned.replace(skeleton=Skeleton("mine", tuple("abcdefgh")))
    assert said(archive.add(named)) == {"a": "replaced"}
    assert said(archive.add(named.replace(confidence=np.full((90, 8), 0.5)))) == {"a": "replaced"}


def test_the_same_name_twice_is_two(archive: Archive, moves) -> None:
    clip = moves(0, name="a")
    given = ClipSet([clip, moves(1, name="a"), moves(2, name="a")])
    assert list(said(archive.add([given, clip]))) == ["a", "a (2)", "a (3)"]  # the very same clip is one
    assert set(said(archive.add(given)).values()) == {"known"}
    assert archive.search(moves(1), k=1)[0].source == "a (2)"


# ---- folders -------------------------------------------------------------------------------------------------------------
def test_folders_are_walked(archive: Archive, saved, moves, tmp_path: Path) -> None:
    saved("week/monday/b.npz", 0)
    saved("week/monday/a.npz", 1)
    saved("week/.hidden/c.npz", 2)
    (tmp_path / "week" / "notes.txt").write_text("nothing")
    (tmp_path / "week" / "film.mp4").touch()
    frames(tmp_path / "week" / "openpose", moves(3, seconds=2.0, joints=25))
    nested = Archive(tmp_path / "week" / "old.archive")
    nested.add(moves(4, name="old"))
    assert list(said(archive.add(tmp_path / "week"))) == ["a.npz", "b.npz", "openpose"]
    assert names(archive) == ["a.npz", "b.npz", "openpose"] and archive.recordings()[-1].layout == "BODY_25"
    assert names(nested) == ["old"]
    with pytest.raises(ValueError, match="nothing to add"):
        archive.add(nested.path)


def test_folders_of_frames_and_links_are_one_recording(archive: Archive, moves, tmp_path: Path, saved) -> None:
    folder = frames(tmp_path / "openpose", moves(3, seconds=2.0, joints=25))
    assert said(archive.add(folder)) == {"openpose": "added"}
    assert said(archive.add(folder)) == {"openpose": "known"}
    next(folder.iterdir()).unlink()
    assert said(archive.add(folder)) == {"openpose": "replaced"}
    one = tmp_path / "single"
    one.mkdir()
    (one / "a_000000_keypoints.json").write_bytes(next(folder.iterdir()).read_bytes())
    assert [source.path for source in gather(one)] == [one / "a_000000_keypoints.json"]  # one file is no sequence of frames
    saved("week/a.npz")
    (tmp_path / "week" / "again").symlink_to(tmp_path / "week")
    (tmp_path / "week" / "and_again").symlink_to(tmp_path / "week")
    assert said(archive.add(tmp_path / "week")) == {"a.npz": "added"}


# ---- what cannot be read -------------------------------------------------------------------------------------------------
def test_whatever_cannot_be_read_is_said_and_the_others_are_added(archive: Archive, saved, tmp_path: Path) -> None:
    good = saved("good.npz")
    (tmp_path / "empty.json").touch()
    (tmp_path / "half.npz").write_bytes(good.read_bytes()[:-200])
    (tmp_path / "cut.json").write_text('[{"image_id": 0, "keyp')
    (tmp_path / "other.json").write_text('{"a": 1}')
    (tmp_path / "loop.json").symlink_to(tmp_path / "loop.json")
    (tmp_path / "dangling.json").symlink_to(tmp_path / "nowhere.json")
    os.mkfifo(tmp_path / "pipe.json")
    wrong = ["empty.json", "half.npz", "cut.json", "other.json", "loop.json", "dangling.json", "pipe.json", "none.json", "n" * 300]
    done = archive.add([*(tmp_path / name for name in wrong), good, "null\0.json"])
    assert said(done) == {**dict.fromkeys(wrong, "failed"), "good.npz": "added", "null\0.json": "failed"}
    for name in wrong:
        assert name[:40] in reason(done, name), name
    assert "null" in reason(done, "null\0.json")
    assert "no such file" in reason(done, "none.json") and "is a pipe" in reason(done, "pipe.json")
    assert names(archive) == ["good.npz"] and archive.verify().ok
    assert [one.windows for one in done.failures] == [0] * 10 and done.windows == len(archive)


def test_what_cannot_be_read_any_more_stays(archive: Archive, saved) -> None:
    gone, broken = saved("gone.npz", 0), saved("broken.npz", 1)
    archive.add([gone, broken])
    gone.unlink()
    broken.write_bytes(b"PK\x03\x04 nothing")
    done = archive.add([gone, broken])
    assert said(done) == {"gone.npz": "failed", "broken.npz": "failed"}
    assert reason(done, "gone.npz").endswith("what is in the archive of it stays") and "gone.npz" in reason(done, "gone.npz")
    assert names(archive) == ["gone.npz", "broken.npz"] and archive.verify().ok


def test_a_file_that_is_written_meanwhile_is_not_taken_for_whole(archive: Archive, saved, monkeypatch) -> None:
    path, read = saved("a.npz", 0), sources._people

    def slow(*given):
        people = read(*given)
        saved("a.npz", 1)
        return people

    monkeypatch.setattr(sources, "_people", slow)
    done = archive.add(path)
    assert said(done) == {"a.npz": "failed"} and "was written to while it was read" in reason(done, "a.npz")
    monkeypatch.undo()
    assert said(archive.add(path)) == {"a.npz": "added"}


def test_whatever_a_reader_raises_is_one_failure(archive: Archive, saved, monkeypatch) -> None:
    read = sources._people

    def broken(source, reading):
        if source.name.endswith("b.npz"):
            raise RuntimeError("two\nlines")
        return read(source, reading)

    monkeypatch.setattr(sources, "_people", broken)
    done = archive.add([saved("a.npz", 0), saved("b.npz", 1), saved("c.npz", 2)])
    assert said(done) == {"a.npz": "added", "b.npz": "failed", "c.npz": "added"}
    assert reason(done, "b.npz").endswith("b.npz: RuntimeError: two lines")


def test_a_name_that_is_no_text_is_a_name(archive: Archive, saved, moves) -> None:
    odd = os.fsencode(saved("odd.npz", 0))
    os.rename(odd, odd.replace(b"odd", b"\xff"))
    path = os.fsdecode(odd.replace(b"odd", b"\xff"))
    skeleton = Skeleton("s\ud800", ("a\ud800", "b", "c"))
    given = [path, moves(1, name="clip\ud800"), moves(2, joints=3, name="named", skeleton=skeleton)]
    assert set(said(archive.add(given)).values()) == {"added"}
    assert set(said(archive.add(given)).values()) == {"known"}
    assert archive.verify().ok
    for clip, hit in ((moves(0), path), (moves(1), "clip\ud800"), (moves(2, joints=3, skeleton=skeleton), "named")):
        found = archive.search(clip, k=1)[0].source
        assert found == sources.storable(hit) and archive.clip(found).joints.shape[1] == clip.joints.shape[1]
    assert archive.remove(sources.storable("clip\ud800")) == 1


def test_what_is_nothing_to_add(archive: Archive, tmp_path: Path) -> None:
    for given, message in (
        ([], "nothing to add"), ([3], "got int"), ([None], "got NoneType"), (ClipSet([]), "nothing to add"),
        (tmp_path, "nothing to add"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            archive.add(given)
    assert not archive.path.exists()


# ---- who is in it --------------------------------------------------------------------------------------------------------
def test_nobody_in_view_is_left_out(archive: Archive, moves, tmp_path: Path) -> None:
    empty = moves(0, name="empty").replace(joints=np.full((90, 8, 2), np.nan))
    short = moves(1, seconds=0.5, name="short")
    (tmp_path / "none.json").write_text("[]")
    (tmp_path / "frames.json").write_text(
        json.dumps([{"image_id": 1, "category_id": 1, "keypoints": [0.0] * 51, "score": 0.0}] * 9)
    )
    done = archive.add([empty, short, tmp_path / "none.json", tmp_path / "frames.json", moves(2, name="good")])
    assert said(done) == {
        "empty": "left out", "short": "left out", "none.json": "failed", "frames.json": "left out", "good": "added",
    }  # fmt: skip
    assert "nobody is in view" in reason(done, "empty") and "nobody is in view" in reason(done, "frames.json")
    assert names(archive) == ["good"] and archive.verify().ok
    assert said(archive.add([empty, short])) == {"empty": "known", "short": "known"}
    assert said(archive.add(moves(3, name="empty"))) == {"empty": "replaced"}


def test_everybody_in_view_is_a_recording(archive: Archive, moves, tmp_path: Path) -> None:
    left, right = moves(0, joints=17), moves(1, joints=17)
    right = right.replace(joints=right.joints + np.array([3000.0, 0.0]))
    path = write_coco(tmp_path / "two.json", left, right, ids=True)
    assert said(archive.add(path)) == {"two.json": "added"}
    rows = archive.recordings()
    assert [row.source for row in rows] == [str(path)] * 2 and len({row.person for row in rows}) == 2
    assert reason(archive.add(path), "two.json") == "30 frames per second assumed"
    hits = archive.search(right, k=1)
    assert hits[0].person == rows[1 if rows[1].person == hits[0].person else 0].person
    stored = archive.clip(str(path), person=hits[0].person)
    assert np.nanmean(stored.joints[..., 0]) > 1500
    assert archive.remove(str(path)) == 2 and archive.recordings() == []


def test_clip_sets_are_one_recording_each(archive: Archive, moves, tmp_path: Path) -> None:
    path = tmp_path / "set.npz"
    ClipSet([moves(i, name=f"trial {i // 2}") for i in range(3)]).save(path)
    done = archive.add(path)
    assert names(archive) == ["set.npz: trial 0", "set.npz: trial 0 (2)", "set.npz: trial 1"] and archive.verify().ok
    assert archive.info().sources == 1 and done.windows == len(archive)
    assert archive.search(moves(2), k=1)[0].source == f"{path}: trial 1"
    assert archive.clip(f"{path}: trial 1").name == f"{path}: trial 1"
    assert archive.remove(str(path)) == 3


def test_layouts_live_side_by_side(archive: Archive, moves) -> None:
    shared = ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")
    one, two = Skeleton("one", shared), Skeleton("two", (*reversed(shared), "nose"))
    flipped = moves(0, joints=6, name="flipped")
    wide = np.concatenate([flipped.joints[:, ::-1], flipped.joints[:, :1]], axis=1)
    archive.add(
        [
            moves(0, joints=6, name="first", skeleton=one), Clip(wide, fps=30.0, name="second", skeleton=two),
            moves(1, joints=6, name="without names"), moves(2, joints=9, name="nine"),
        ]
    )  # fmt: skip
    assert [(name, joints) for name, joints, _ in archive.info().layouts] == [
        ("one", 6), ("two", 7), ("6 joints", 6), ("9 joints", 9),
    ]  # fmt: skip
    hits = archive.search(moves(0, joints=6, skeleton=one), k=2)
    assert {hit.source for hit in hits} == {"first", "second"}  # by the joints that they share
    assert archive.search(moves(2, joints=9), k=1)[0].source == "nine"
    with pytest.raises(ValueError, match="4 joints without names has too few in common"):
        archive.search(moves(2, joints=4))


def test_what_leaves_and_returns_is_one_recording(archive: Archive, moves) -> None:
    clip = moves(0, seconds=20.0, name="twice")
    kept = np.r_[0:150, 450:600]
    archive.add(clip.replace(joints=clip.joints[kept], times=clip.times[kept]))
    (row,) = archive.recordings()
    assert row.start == 0.0 and row.end == pytest.approx(clip.times[-1], abs=0.1) and 9.0 < row.seconds < 10.1
    assert len(archive.clip("twice", 5.5, 20.0)) == len(archive.clip("twice", 14.0))
    assert archive.verify().ok


# ---- batches -------------------------------------------------------------------------------------------------------------
def test_batches_are_committed_as_they_fill(tmp_path: Path, moves) -> None:
    clips = [moves(i, name=f"{i}") for i in range(6)]
    once = Archive(tmp_path / "once")
    once.add(clips)
    windows = len(once) // 6
    small = Archive(tmp_path / "small", ArchiveOptions(max_segment_windows=2 * windows, relearn_factor=np.inf))
    small.add(clips)
    assert once.info().segments == 1 and small.info().segments == 3
    assert names(small) == names(once) and len(small) == len(once)
    shares: list[float] = []
    eager = ArchiveOptions(commit_seconds=0.0, relearn_factor=np.inf)
    Archive(tmp_path / "timed", eager).add(clips, progress=shares.append)
    assert Archive(tmp_path / "timed").info().segments == 6
    assert shares == [pytest.approx((i + 1) / 6) for i in range(6)]


def test_a_failing_batch_leaves_what_was_committed(tmp_path: Path, moves, monkeypatch) -> None:
    from indexing.archive import writer

    archive, write = Archive(tmp_path / "a", ArchiveOptions(commit_seconds=0.0)), writer.write_segment
    count = iter(range(10))

    def full(folder: Path, *given):
        if next(count) == 2:
            (folder / "half.safetensors").write_bytes(b"x")
            raise ValueError("cannot write 'x' (No space left on device); free the name or the disk")
        return write(folder, *given)

    monkeypatch.setattr(writer, "write_segment", full)
    with pytest.raises(ValueError, match="No space left"):
        archive.add([moves(i, name=f"{i}") for i in range(5)])
    assert names(archive) == ["0", "1"] and archive.verify().ok and not archive.verify().orphans
    monkeypatch.undo()
    assert said(archive.add([moves(i, name=f"{i}") for i in range(5)])) == {
        "0": "known", "1": "known", "2": "added", "3": "added", "4": "added",
    }  # fmt: skip


def test_a_dataset_is_a_source_for_each_of_its_people(tmp_path: Path, moves) -> None:
    both = moves(1), moves(2)
    position = np.stack([clip.joints.transpose(0, 2, 1) for clip in both], axis=3)
    coords = {"individuals": SimpleNamespace(values=np.array(["a", "b"]), dims=("individuals",))}
    found = SimpleNamespace(
        position=SimpleNamespace(values=position, dims=("time", "space", "keypoints", "individuals")),
        attrs={"fps": 30.0, "source_file": "two.h5"}, coords=coords,
    )  # fmt: skip
    done = Archive(tmp_path / "lab").add(found)
    assert said(done) == {"two.h5#a": "added", "two.h5#b": "added"}


def test_keypoints_are_those_of_a_video_by_their_name() -> None:
    names = {"cam1.json": True, "cam1_json": True, "cam1DLC_resnet.csv": True, "cam10.json": False, "cam.json": False}
    assert {name: sources._begins(name, "cam1") for name in names} == names
