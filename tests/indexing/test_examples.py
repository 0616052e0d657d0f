"""Example files: they are there, they can be read, and the commands that are printed beside them are the README's."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

from indexing.cli import main
from indexing.clip import ClipSet

README = Path(__file__).parents[2] / "README.md"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    where = tmp_path_factory.mktemp("examples")
    assert main(["demo", "--examples", str(where)]) == 0
    return where


def test_the_commands_name_files_that_are_there(folder: Path) -> None:
    lines = (folder / "commands.txt").read_text().splitlines()
    made = {"three.safetensors", "moves.safetensors"}
    for line in lines:
        program, *words = shlex.split(line)
        assert program == "dyntorch"
        files = [word.partition("=")[2] or word for word in words if not word.startswith("-")]
        files = [
            word.partition("@")[0] for word in files if word.partition("@")[0].endswith((".csv", ".npz", ".json", ".safetensors"))
        ]
        assert files or "cam1/" in words
        for name in files:
            assert (folder / name).exists() or name in made, line
    verbs = {" ".join(word for word in line.split()[1:3] if word.isalpha() and word not in ("a", "b")) for line in lines}
    assert {"align", "segment", "reconstruct", "sync", "index fit", "index scan", "index evaluate"} <= verbs


def test_every_command_of_the_readme_that_names_files_can_be_typed(folder: Path) -> None:
    """Lines that begin with ``$ dyntorch`` use files that ``demo --examples`` writes, or that an earlier line wrote."""
    there = {path.name for path in folder.iterdir()} | {"moves.safetensors", "three.safetensors"}
    for line in README.read_text(encoding="utf-8").splitlines():
        if line.startswith("$ dyntorch"):
            words = [word.rstrip("/").split("=")[-1].split("@")[0] for word in shlex.split(line.partition("#")[0])[2:]]
            for word in words:
                if word.endswith((".csv", ".npz", ".json")) or word in ("cam1", "cam2", "cam3", "a.mp4"):
                    assert word in there, line


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
