"""``dyntorch align | segment | reconstruct`` of videos and pictures: from pixels to the report, and what is refused and how."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from tests.indexing.cli.footage import write_film, write_video


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """``wall.mp4`` and the pictures ``wall/f0.png`` ...: a poster that slides over a wall before a camera that goes and turns;
    ``still.mp4``, ``one.mp4`` and ``text.mp4``, of which nothing can be told."""
    folder = tmp_path_factory.mktemp("videos")
    frames = write_film(folder, "wall", 10)
    write_video(folder / "still.mp4", frames[[0] * 4])
    write_video(folder / "one.mp4", frames[:1])
    (folder / "text.mp4").write_text("no video")
    (folder / "none").mkdir()
    np.savez(folder / "m.npz", x1=np.zeros((9, 2)), x2=np.zeros((9, 2)))
    return folder


def table(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
def test_align_a_video(run):
    code, out, err = run("align @/wall.mp4 --frames 0,4,9 --out out")
    assert code == 3 and "refused: other motions fit as well" in err  # a wall and one thing before it: either may stand still
    assert "note: frames 0, 4, 9 of the 10 that were read (0.00 to 0.36 s)" in out
    rows = table("out/tracks.csv")
    assert {row["frame"] for row in rows} == {"0", "4", "9"} and rows[0].keys() == {"frame", "time", "id", "x", "y"}
    found = json.loads(Path("out/alignment.json").read_text())
    assert found["views"] == ["frame 0", "frame 4", "frame 9"] and found["matches"] * 3 == len(rows)
    assert found["counts"]["static"] > 40 and found["counts"]["moving"] > 5
    page = Path("out/report.html").read_text()
    assert page.count("data:image/png") == 2  # on white paper and on dark: a photograph must not become a negative
    code, out, _ = run("align @/wall --frames 0,4,9")
    assert code in (0, 3) and "frames 0, 4, 9 of the 10" in out and "0.36 s" not in out


@pytest.mark.slow
def test_segment_a_video(run, data):
    code, out, _ = run("segment @/wall.mp4 --at 0,0.3 --out out")
    assert code in (0, 3) and "frames 0, 8 of the" in out
    found = json.loads(Path("out/segmentation.json").read_text())
    assert found["matches"] > 50 and Path("out/tracks.csv").is_file()
    assert str(data / "wall.mp4") in json.dumps(found["manifest"])


@pytest.mark.slow
def test_reconstruct_pictures(run):
    line = "reconstruct @/wall/*.png --every 2 --fps 25 --motion constant_velocity_2d"
    code, out, _ = run(f"{line} --out out")
    assert code in (0, 3) and "frames 0 to 8, every 2 of the 10 that were read (0.00 to 0.32 s)" in out
    found = json.loads(Path("out/reconstruction.json").read_text())
    assert found["times"] == pytest.approx([0, 0.08, 0.16, 0.24, 0.32]) and found["residual"] < 0.5
    again, out, _ = run("reconstruct out/tracks.csv --motion constant_velocity_2d")
    assert again == code and f"{found['tracks']}" in out


BAD = {
    "align @/text.mp4": "text.mp4': the file cannot be read as video",
    "align @/no.mp4": "no.mp4': no such file",
    "align @/one.mp4": "one.mp4: has 1 frame, and motion needs at least 2",
    "align @/still.mp4": "still.mp4: nothing moves:",
    "align @/none": "none: holds no pictures; give a folder or a pattern of png, jpg, jpeg files, or a video",
    "align @/none/*.png": "no picture has such a name",
    "align @/wall.mp4 --frames 0,4": "--frames 0,4: 2 given, at least 3 are needed",
    "align @/wall.mp4 --frames 0,4,90": "wall.mp4: has no frame 90; its 10 frames are 0 to 9",
    "align @/wall.mp4 --frames 9,4,0": "--frames '9,4,0': numbers are from 0 and increase",
    "align @/wall.mp4 --frames a,b,c": "--frames 'a,b,c': expected numbers with commas between them",
    "align @/wall.mp4 --at 0,1,9": "wall.mp4: has no frame at 1 s; its last one is at 0.36 s",
    "align @/wall.mp4 --at 0,0.1,0.2 --frames 0,1,2": "--frames and --at both say which frames to take",
    "align @/wall --at 0,1,2": "--at 0,1,2: pictures have no times",
    "align @/wall.mp4 --model rigid": "--model rigid needs 3D points or lines, and a video has 2D points",
    "align @/wall.mp4 @/m.npz": "wall.mp4: is a video, and 2 inputs are given",
    "segment @/wall.mp4 --frames 4": "--frames 4: 1 given, at least 2 are needed",
    "segment @/wall.mp4 --frames 0,4,90": "wall.mp4: has no frame 90; its 10 frames are 0 to 9",
    "segment @/wall.mp4 --every 30": "so every 30 is one frame",
    "segment @/wall.mp4 --no-spatial": "--no-spatial is of two images, and more frames are given",
    "segment @/wall.mp4 --key a": "--key is of files of tracks",
    "segment @/wall --at 0,1,2": "--at 0,1,2: pictures have no times",
    "segment @/still.mp4": "still.mp4: nothing moves:",
    "segment @/one.mp4": "one.mp4: has 1 frame, and motion needs at least 2",
    "segment @/m.npz --at 0,1": "--at 0,1: it is for a video or a sequence of pictures",
    "segment @/m.npz --frames 0,1": "--frames 0,1: it is for a video or a sequence of pictures",
    "segment @/wall.mp4 --pair a": "--pair is of files of matches",
    "segment": "no input; give a video, a file of tracks, or a file of matches with x1, x2",
    "reconstruct @/wall.mp4 --every 0": "--every must be a whole number from 1, got 0",
    "reconstruct @/wall.mp4 --every 30": "so every 30 is one frame",
    "reconstruct @/wall.mp4 --fps 25": "--fps 25: a video has the times of its frames",
    "reconstruct @/wall.mp4 --key a": "--key is of files of tracks",
    "reconstruct @/m.npz --every 2": "--every 2: it is for a video",
}


@pytest.mark.parametrize("line", BAD)
def test_bad_input_is_one_line_and_code_2(refuse, line):
    refuse(line, says=(BAD[line],))


def test_without_the_extra(run, monkeypatch):
    def missing(name):
        raise ImportError(f"No module named {name!r}")

    monkeypatch.setattr("indexing.video.reading.import_module", missing)
    for line in ("align @/wall.mp4", "segment @/wall"):
        code, _, err = run(line)
        assert code == 2 and "cannot be imported" in err and "install 'dyntorch[video]'" in err and err.count("\n") == 1
