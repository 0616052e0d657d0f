"""``dyntorch pose``: what it writes and says."""

from __future__ import annotations

import io

import pytest

from indexing.cli import main
from tests.indexing.pose.test_detection import film, person, walk


@pytest.mark.slow
def test_videos_become_files(tmp_path, seeing, capsys):
    one = film(tmp_path, [[walk(i)] for i in range(20)], "one.mp4")
    two = film(tmp_path, [[walk(i), person(280, 200, 30)] for i in range(20)], "two.mp4")
    out = tmp_path / "pose"
    assert main(["pose", str(one), str(two), "-o", str(out), "--workers", "2"]) == 0
    assert sorted(entry.name for entry in out.iterdir()) == ["one.npz", "one_json", "two.npz", "two_json"]
    said = capsys.readouterr()
    assert "one.mp4" in said.out and "100.0 %" in said.out and "raw: not smoothed" in said.out and "frames a second" in said.out
    assert "2 people in view at once; the largest is followed, --people 2 follows more" in said.out and not said.err
    assert main(["pose", str(one), str(two), "-o", str(out)]) == 0
    assert capsys.readouterr().out.count("there already") == 2


def test_files_of_others_are_refused_in_one_line_and_the_other_videos_go_on(tmp_path, seeing, capsys):
    paths = [str(film(tmp_path, [[walk(i)] for i in range(5)], name)) for name in ("a.mp4", "b.mp4")]
    theirs = tmp_path / "pose" / "a_json" / "mine.json"
    theirs.parent.mkdir(parents=True)
    theirs.write_text("{}")
    assert main(["pose", paths[0], "-o", str(tmp_path / "pose"), "--no-json"]) == 0
    assert sorted(entry.name for entry in (tmp_path / "pose").iterdir()) == ["a.npz", "a_json"]
    for more in ([], ["--every", "2"]):
        capsys.readouterr()
        assert main(["pose", *paths, "-o", str(tmp_path / "pose"), *more]) == 2
        said = capsys.readouterr()
        assert len(said.err.splitlines()) == 1 and "a_json: is there, and no folder of 'dyntorch pose'; move it away" in said.err
        assert "b.mp4" in said.out and "a.mp4" not in said.out and theirs.exists()


def test_one_bad_video_keeps_no_other_from_being_written(tmp_path, seeing, capsys):
    good, empty = film(tmp_path, [[walk(i)] for i in range(5)]), film(tmp_path, [[]] * 5, "empty.mp4")
    (tmp_path / "text.mp4").write_text("no video")
    words = [str(tmp_path / name) for name in ("text.mp4", "gone.mp4")]
    assert main(["pose", str(empty), words[0], str(good), words[1], "-o", str(tmp_path / "pose")]) == 2
    said = capsys.readouterr()
    assert (tmp_path / "pose" / "a.npz").exists() and not (tmp_path / "pose" / "empty.npz").exists()
    assert len(said.err.splitlines()) == 3
    assert "no person was found" in said.err and "text.mp4" in said.err and "gone.mp4" in said.err


def test_words_that_make_no_sense(tmp_path, seeing, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for words, said in (
        ([], "no videos"),
        (["a.mp4"], "-o is missing"),
        (["a.mp4", "-o", "pose", "--people", "0"], "--people 0: expected 1 or more"),
        (["a.mp4", "-o", "pose", "--every", "-1"], "--every -1: expected 1 or more"),
        (["a.mp4", "-o", "pose", "--workers", "0"], "--workers 0"),
        (["a.mp4", "-o", "pose", "--fps", "nan"], "--fps must be a positive number of frames per second, got nan"),
        (["a.mp4", "-o", "pose", "--model", "large"], "choose from full, heavy, lite"),
        (["a.mp4", "--get-models"], "leave the videos out"),
        (["a.mp4", "b/a.mov", "-o", "pose"], "rename one of them"),
    ):
        assert main(["pose", *words]) == 2
        error = capsys.readouterr().err
        assert said in error and len(error.splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_without_models_one_line_says_what_to_type(tmp_path, capsys):
    pytest.importorskip("av")
    pytest.importorskip("ai_edge_litert")
    assert main(["pose", "a.mp4", "-o", str(tmp_path / "pose"), "--models", str(tmp_path / "none")]) == 2
    error = capsys.readouterr().err
    assert "dyntorch pose --get-models" in error and "--models FOLDER" in error and len(error.splitlines()) == 1


def test_fetching_says_what_became_of_each_file(tmp_path, capsys, monkeypatch):
    from indexing.pose.models import Fetched

    done = [Fetched("pose_detection.tflite", "there"), Fetched("pose_landmark_heavy.tflite", "missing", "npm is not installed")]
    monkeypatch.setattr("indexing.pose.models.get_models", lambda folder: done)
    assert main(["pose", "--get-models", "--models", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "note: pose_landmark_heavy.tflite is not there: npm is not installed" in said and "1 model file" in said


def test_an_interruption_says_what_is_kept(tmp_path, seeing, capsys, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt
        yield

    monkeypatch.setattr("indexing.pose.writing.keypoint_files", interrupted)
    path = film(tmp_path, [[walk(i)] for i in range(5)])
    assert main(["pose", str(path), "-o", str(tmp_path / "pose")]) == 130
    assert "the same command goes on from there" in capsys.readouterr().err


class Terminal(io.StringIO):
    """A stream of errors that somebody looks at."""

    def isatty(self):
        return True
