"""What the command line says about a word that it cannot take: which one, what is expected, and what was probably meant."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from indexing import Clip
from indexing.cli import main
from tests.indexing.sync.scene import write_openpose


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
        ("synchronise", "unknown command synchronise"),
        ("archive serch a b", "unknown command serch; did you mean search? choose from add, search, find, info, verify, remove"),
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
    err = capsys.readouterr().err
    assert err.startswith(f"dyntorch: {said}") and err.count("\n") == 1 and "--help" in err


def test_examples_that_cannot_be_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    write_openpose(Path("take"), [Clip(np.ones((3, 25, 2)))])
    Path("x.json").write_text('{"some": "thing"}')
    for words, said in {
        "a=b=take b=take": "example 'a=b=take': two labels for take; give one, as in a=take\n",
        "a=take/take_000000000001_keypoints.json b=take": "or give the folder take if every frame is a file of its own",
        "a=x.json b=take": "export what AlphaPose, COCO, DeepLabCut, FreeMoCap, MediaPipe, MMPose, movement, ",
    }.items():
        assert main(["index", "fit", *words.split(), "-o", "m.safetensors"]) == 2
        err = capsys.readouterr().err
        assert said in err and "indexing.readers" not in err
