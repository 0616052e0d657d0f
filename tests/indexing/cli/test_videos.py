"""Videos in the place of keypoint files: by a pose model where one is there, by their pixels where not, and it is said which."""

from __future__ import annotations

import dataclasses
import importlib

import numpy as np
import pytest

from dyntorch.core import Notice, status_from
from indexing import Archive, ClipSet
from indexing.cli import main
from indexing.readers import read
from indexing.readers.files import WatchOptions
from indexing.sync.people import Pairing
from indexing.sync.recordings import SyncNotice, take_of
from tests.indexing.pose.conftest import seeing as seeing
from tests.indexing.pose.test_detection import film, person


def nod(i: int, x: float = 150.0) -> tuple[np.ndarray, np.ndarray]:
    """One who bends to the side and back."""
    return person(x, 170, 70, 0.9 * np.sin(0.35 * i))


def hop(i: int) -> tuple[np.ndarray, np.ndarray]:
    """One who jumps."""
    return person(150, 170 - 40 * abs(np.sin(0.3 * i)), 70)


@pytest.fixture
def model(seeing, monkeypatch):
    """A pose model is there."""
    for place in ("indexing.pose.available", "indexing.archive.sources.available"):
        monkeypatch.setattr(place, lambda models=None: "heavy")
    monkeypatch.setattr("indexing.pose.models.load_models", __import__("indexing.pose.writing").pose.writing.load_models)
    return seeing


@pytest.fixture
def films(tmp_path):
    """Two actions, and a recording of both."""
    film(tmp_path, [[nod(i)] for i in range(36)], "nod.mp4", fps=30)
    film(tmp_path, [[hop(i)] for i in range(36)], "hop.mp4", fps=30)
    film(tmp_path, [[nod(i) if i < 40 else hop(i)] for i in range(80)], "session.mp4", fps=30)
    return tmp_path


def fit(where, *more: str) -> int:
    return main(["index", "fit", f"nod={where / 'nod.mp4'}", f"hop={where / 'hop.mp4'}", "-o", str(where / "m.safetensors"), *more])


@pytest.mark.slow
def test_learned_and_found_by_the_people_in_videos(films, model, capsys):
    assert fit(films) == 0
    said = capsys.readouterr().out
    assert "33 in 2D" in said and "people in 2 videos found by BlazePose heavy, not smoothed, kept in" in said
    assert sorted(one.name for one in (films / "pose").iterdir()) == ["hop.npz", "nod.npz"]
    looks = len(model)
    assert fit(films) == 0
    assert "2 videos: the keypoints that were kept in" in capsys.readouterr().out and len(model) == looks
    assert fit(films, "--people", "1") == 0
    assert "people in 2 videos found" in capsys.readouterr().out and len(model) > looks
    out = films / "out"
    assert main(["index", "scan", str(films / "session.mp4"), "-m", str(films / "m.safetensors"), "--report", str(out)]) == 0
    said = capsys.readouterr().out
    assert "1 recording" in said and "nod" in said and "person " not in said.split("note")[0]
    assert (out / "pose" / "session.npz").exists() and "session.mp4" in (out / "events.csv").read_text()


@pytest.mark.slow
def test_pixels_where_they_are_asked_for_or_no_model_is_there(films, seeing, monkeypatch, capsys):
    monkeypatch.setattr("indexing.pose.available", lambda models=None: None)
    assert fit(films) == 0
    said = capsys.readouterr().out
    assert "no pose model" in said and "dyntorch pose --get-models" in said and "learned from pixels" in said
    assert not (films / "pose").exists()
    monkeypatch.setattr("indexing.pose.available", lambda models=None: "heavy")
    assert fit(films, "--by", "pixels") == 0
    said = capsys.readouterr().out
    assert "learned from pixels" in said and "no pose model" not in said and not (films / "pose").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--by", "keypoints"], "nod.mp4: is a video, and its keypoints cannot be found"),
        (["--by", "sound"], "choose from auto, keypoints, pixels"),
        (["--by", "keypoints", "--region", "all"], "add --by pixels"),
        (["--by", "keypoints", "--people", "0"], "--people 0: expected 1 or more"),
        (["--by", "keypoints", "--every", "-1"], "--every -1: expected 1 or more"),
    ],
)
def test_what_is_asked_for_and_cannot_be(films, capsys, monkeypatch, words, said):
    monkeypatch.setattr("indexing.pose.models.missing_parts", list)
    assert fit(films, *words) == 2
    error = capsys.readouterr().err
    assert said in error and len(error.splitlines()) == 1
    assert not (films / "m.safetensors").exists() and not (films / "pose").exists()


@pytest.mark.slow
def test_a_model_and_a_recording_of_two_kinds(films, model, monkeypatch, capsys):
    session, keypoints, pixels = films / "session.mp4", films / "m.safetensors", films / "p.safetensors"
    assert fit(films) == 0
    assert main(["index", "fit", f"nod={films / 'nod.mp4'}", f"hop={films / 'hop.mp4'}", "-o", str(pixels), "--by", "pixels"]) == 0
    capsys.readouterr()
    for words, said in (
        ([str(session), "-m", str(keypoints), "--by", "pixels"], "was learned from keypoints"),
        ([str(session), "-m", str(pixels), "--by", "keypoints"], "was learned from the pixels of videos"),
        ([str(films / "pose" / "nod.npz"), "-m", str(pixels)], "give videos to search"),
    ):
        assert main(["index", "scan", *words]) == 2
        assert said in capsys.readouterr().err
    assert main(["index", "scan", str(session), str(films / "pose" / "nod.npz"), "-m", str(keypoints)]) == 0


@pytest.mark.slow
def test_videos_of_one_name_are_kept_apart(films, model):
    for name in ("one", "two"):
        (films / name).mkdir()
        film(films / name, [[nod(i) if name == "one" else hop(i)] for i in range(30)], "cam.mp4", fps=30)
    words = [f"nod={films / 'one' / 'cam.mp4'}", f"hop={films / 'two' / 'cam.mp4'}", "-o", str(films / "m.safetensors")]
    assert main(["index", "fit", *words]) == 0
    assert (films / "pose" / "one" / "cam.npz").exists() and (films / "pose" / "two" / "cam.npz").exists()


@pytest.mark.slow
def test_nobody_in_a_recording_is_an_answer(films, model, capsys):
    assert fit(films) == 0
    empty = film(films, [[]] * 20, "empty.mp4", fps=30)
    capsys.readouterr()
    assert main(["index", "scan", str(empty), "-m", str(films / "m.safetensors")]) == 0
    assert "nobody is in view in any of its 20 frames" in capsys.readouterr().out
    assert main(["index", "fit", f"a={empty}", f"b={films / 'nod.mp4'}", "-o", str(films / "n.safetensors")]) == 2
    assert "empty.mp4: no person was found" in capsys.readouterr().err and not (films / "n.safetensors").exists()


@pytest.mark.slow
def test_the_reader_of_videos(films, model):
    two = film(films, [[nod(i, 80), person(250, 170, 40)] for i in range(20)], "two.mp4", fps=30)
    assert len(read(two, person="everyone")) == 2 and len(read(two, person="everyone", watching=WatchOptions(people=1))) == 1
    (largest,) = read(two, label="nod")
    assert largest.label == "nod" and largest.meta["people"] == 2 and largest.name == "two.mp4"
    np.testing.assert_allclose(largest.times, np.arange(20) / 30, atol=1e-9)
    for wrong, said in (({"size": (4, 3)}, "size= does not apply"), ({"format": "coco"}, "is a video")):
        with pytest.raises(ValueError, match=said):
            read(two, **wrong)
    with pytest.raises(ValueError, match="watching must be WatchOptions"):
        read(two, watching=3)


@pytest.mark.slow
def test_who_is_meant_of_the_people_in_a_set(films, model):
    two = film(films, [[nod(i, 80), person(250, 170, 40)] for i in range(20)], "two.mp4", fps=30)
    everyone = read(two, person="everyone")
    everyone.save(films / "two.npz")
    (largest,) = read(films / "two.npz", person="largest")
    assert np.array_equal(largest.joints, read(two)[0].joints, equal_nan=True) and largest.meta["people"] == 2
    assert [clip.meta["person"] for clip in read(films / "two.npz", person="everyone")] == [1, 2]
    apart = ClipSet([clip.replace(label=str(i)) for i, clip in enumerate(everyone)])
    apart.save(films / "set.npz")  # clips of several actions are no people of one recording
    assert len(read(films / "set.npz")) == 2


@pytest.mark.slow
def test_cameras_are_compared_by_the_people_in_them(films, model, capsys):
    code = main(["sync", str(films / "nod.mp4"), str(films / "session.mp4"), "--out", str(films / "sync")])
    said = capsys.readouterr()
    assert code in (0, 3) and "nod.mp4: compared by the people that BlazePose heavy finds in it" in said.out
    assert {one.name for one in (films / "sync" / "pose").iterdir()} == {"nod.npz", "session.npz"}
    assert main(["sync", str(films / "nod.mp4"), str(films / "session.mp4"), "--by", "keypoints", "--method", "tracks"]) == 2
    assert "--by keypoints: --method tracks compares the pixels" in capsys.readouterr().err


@pytest.mark.slow
def test_takes_of_videos(films, model):
    path = films / "session.mp4"
    take = take_of(path)
    assert take.kind == "keypoints" and take.video is not None and take.video.kind == "video" and take.path == path
    assert take_of(path, by="pixels").kind == "video"
    empty = film(films, [[]] * 20, "empty.mp4", fps=30)
    seen = take_of(empty)
    assert seen.kind == "video" and "nobody is seen in it, so it is compared by its pixels" in seen.notes[-1]
    with pytest.raises(ValueError, match="no person was found"):
        take_of(empty, by="keypoints")


@pytest.mark.slow
def test_what_pixels_say_where_keypoints_do_not_decide(films, model, monkeypatch):
    verb = importlib.import_module("indexing.sync.synchronize")
    a, b = (take_of(films / name) for name in ("nod.mp4", "session.mp4"))
    open_ = verb.undecided_shift((a.fps, b.fps), "subspace", Notice(SyncNotice.FEW_TRACKS, 0.0, {"needed": 9, "names": "both"}))
    monkeypatch.setattr(verb, "match_people", lambda *args, **how: Pairing(open_, (0, 0)))
    monkeypatch.setattr(verb, "synchronize_videos", lambda *args, **how: open_)
    told = verb.pair(a, b).shift
    assert not told.ok and [one.code for one in told.notices] == [SyncNotice.FEW_TRACKS, SyncNotice.NEITHER]
    sure = dataclasses.replace(open_, notices=(), status=status_from(()), offset=0.25)
    monkeypatch.setattr(verb, "synchronize_videos", lambda *args, **how: sure)
    told = verb.pair(a, b).shift
    assert told.ok and told.offset == 0.25 and [one.code for one in told.notices] == [SyncNotice.BY_PIXELS]
    assert not verb.pair(a, b, "keypoints").shift.ok


@pytest.mark.slow
def test_an_archive_takes_videos_and_keeps_their_keypoints(films, model, capsys):
    folder, archive = films / "recordings", films / "lab"
    folder.mkdir()
    for name in ("nod.mp4", "hop.mp4"):
        (films / name).rename(folder / name)
    (folder / "hop.csv").write_text("no keypoints\n")  # what begins as the video's name counts as its keypoints
    assert main(["archive", "add", str(archive), str(folder), str(films / "session.mp4"), "--workers", "1"]) == 0
    kept = sorted(one.name for one in (archive / "poses").rglob("*.npz"))
    assert kept == ["nod.npz", "session.npz"] and len(list(Archive(archive).recordings())) == 2
    capsys.readouterr()
    assert main(["archive", "search", str(archive), f"{films / 'session.mp4'}@0-1.2"]) == 0
    assert "session.mp4" in capsys.readouterr().out
    Archive(archive).remove(films / "session.mp4")
    assert [one.name for one in (archive / "poses").rglob("*.npz")] == ["nod.npz"]
    assert main(["archive", "add", str(archive), str(films / "session.mp4"), "--by", "pixels"]) == 2
    assert "an archive holds keypoints" in capsys.readouterr().err


@pytest.mark.slow
def test_an_archive_without_a_model_leaves_videos_out(films, seeing, monkeypatch, capsys):
    for place in ("indexing.pose.available", "indexing.archive.sources.available"):
        monkeypatch.setattr(place, lambda models=None: None)
    assert main(["archive", "add", str(films / "lab"), str(films / "nod.mp4"), "--workers", "1"]) == 2
    error = capsys.readouterr().err
    assert "nod.mp4: is a video, and there is no pose model" in error and "dyntorch pose --get-models" in error


@pytest.mark.slow
def test_an_archive_takes_a_video_anew_that_has_changed(films, model):
    archive = Archive(films / "lab")
    archive.add(films / "nod.mp4")
    (films / "hop.mp4").replace(films / "nod.mp4")
    (done,) = archive.add(films / "nod.mp4").sources
    assert done.outcome == "replaced" and len(list((films / "lab" / "poses").rglob("*.npz"))) == 1
