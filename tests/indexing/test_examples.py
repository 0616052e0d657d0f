"""Example files: they are there, they can be read, and the commands that are printed beside them use them."""

from __future__ import annotations

import shlex
from importlib.util import find_spec
from pathlib import Path

import pytest

from indexing.cli import main
from indexing.clip import ClipSet


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    where = tmp_path_factory.mktemp("examples")
    assert main(["demo", "--examples", str(where)]) == 0
    return where


@pytest.mark.slow
def test_the_commands_name_files_that_are_there(folder: Path) -> None:
    lines = (folder / "commands.txt").read_text().splitlines()
    made = {"three.safetensors", "moves.safetensors", "learned.safetensors", "seen.safetensors"}
    verbs = set()
    for line in lines:
        if line.startswith("#"):
            continue  # no videos: PyAV is not installed
        program, *words = shlex.split(line)
        assert program == "dyntorch"
        named = [word.partition("=")[2] or word for word in words if not word.startswith("-")]
        named = [word.partition("@")[0].rstrip("/") for word in named]
        inputs = [
            word for word in named if word.endswith((".csv", ".npz", ".json", ".mp4", ".safetensors")) or word.startswith("cam")
        ]
        assert inputs, line
        for name in inputs:
            assert any(folder.glob(name)) or name in made, line
        verbs.add(" ".join(words[:2]) if words[0] == "index" else words[0])
    assert verbs == {"align", "segment", "reconstruct", "sync", "index fit", "index scan", "index evaluate"}


def test_videos_are_written_where_they_can_be(folder: Path) -> None:
    commands = (folder / "commands.txt").read_text()
    assert (".mp4" in commands) == (find_spec("av") is not None) == (folder / "filmed.mp4").exists()


@pytest.mark.slow
def test_the_examples_can_be_read(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    assert main(["align", "a.csv", "b.csv", "c.csv"]) == 0
    assert "120       41       68         11" in capsys.readouterr().out
    words = ["squat=squat.json", "lunge=lunge.json", "kick=kick.json@0.2-1.4"]
    assert main(["index", "fit", *words, "-o", str(tmp_path / "three.safetensors")]) == 0
    solid, flat = ClipSet.load("solid.npz"), ClipSet.load("people.npz")
    assert (solid[0].dims, flat[0].dims, len(flat)) == (3, 2, 2 * len(solid))
    assert len(ClipSet.load("cam2")[0]) == len(ClipSet.load("cam1")[0]) - 17
