"""What the command line says about a word that it cannot take: which one, what is expected, and what was probably meant."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from indexing.cli import main


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("index fit a=x.json --fps abc -o m", "--fps 'abc': expected a number; see dyntorch index fit --help"),
        ("index scan x -m m --reject foo", "--reject 'foo': expected a number; see dyntorch index scan --help"),
        ("segment x.npz --bodies two", "--bodies 'two': expected a whole number or auto; see dyntorch segment --help"),
        ("align a b c --threshold x", "--threshold 'x': expected a number or auto; see dyntorch align --help"),
        ("demo --seed 1.5", "--seed '1.5': expected a whole number; see dyntorch demo --help"),
        ("index fit a=b -o m --size 6 x", "--size '6', 'x': expected 2 numbers; see dyntorch index fit --help"),
        ("demo --people", "--people: its value is missing; see dyntorch demo --help"),
        (
            "index scan x -m m --format openpos",
            "--format openpos: did you mean openpose? choose from clipset, coco, deeplabcut, freemocap, mediapipe, mmpose, mocap, "
            "movement, npy, openpose, pyskl, sleap, trc, ultralytics; see dyntorch index scan --help",
        ),
        (
            "index scan x -m m --person zz",
            "--person zz: choose from all, confident, everyone, largest, tracked; see dyntorch index scan --help",
        ),
        ("index scan x -m m --persn all", "unknown option --persn; did you mean --person? see dyntorch index scan --help"),
        ("sync a b --fps 30 x", "unexpected 'x'; leave it out; see dyntorch sync --help"),
        ("index scan x", "missing: --model FILE (what 'dyntorch index fit' wrote); see dyntorch index scan --help"),
        (
            "index scam x",
            "unknown command scam; did you mean scan? choose from fit, scan, evaluate, suggest; see dyntorch index --help",
        ),
    ],
)
def test_one_clear_line(line: str, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(line.split()) == 2
    assert capsys.readouterr().err == f"dyntorch: {said}\n"


def openpose(folder: Path, frames: int = 3) -> Path:
    folder.mkdir()
    for i in range(frames):
        people = [{"pose_keypoints_2d": [1.0 + i, 2.0, 0.9] * 25}]
        (folder / f"{folder.name}_{i:012d}_keypoints.json").write_text(json.dumps({"people": people}))
    return folder


def test_two_labels_are_one_too_many(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    openpose(tmp_path / "take")
    assert main(["index", "fit", "a=b=take", "b=take", "-o", "m.safetensors"]) == 2
    assert capsys.readouterr().err == "dyntorch: example 'a=b=take': two labels for take; give one, as in a=take\n"


def test_a_frame_given_as_a_recording_is_told_its_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    file = next(openpose(tmp_path / "take").relative_to(tmp_path).iterdir())
    assert main(["index", "fit", f"a={file}", "b=take", "-o", "m.safetensors"]) == 2
    assert "or give the folder take if every frame is a file of its own" in capsys.readouterr().err


def test_a_file_of_no_known_format_is_answered_without_python(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "x.json").write_text('{"some": "thing"}')
    assert main(["index", "fit", f"a={tmp_path / 'x.json'}", "b=take", "-o", f"{tmp_path / 'm'}"]) == 2
    said = capsys.readouterr().err
    assert "export what AlphaPose, COCO, DeepLabCut, FreeMoCap, MediaPipe, MMPose, movement, " in said
    assert "indexing.readers" not in said
