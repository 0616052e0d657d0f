"""Some hundred damaged files of every format: read, or refused in one clear line; ``python -m tests.fuzz`` reads more of them."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.fuzz.running import GOOD, command, damaged, judged, poor, tried
from tests.fuzz.seeds import Seed, make

FILES = 12  # per format, fewer of those that take long
COMMANDS = (
    *("COCO annotations", "OpenPose", "DeepLabCut CSV", "truth.csv", "Calib.toml", "points.csv", "pair.npz"),
    "phase.safetensors",
)
pytestmark = [
    pytest.mark.filterwarnings("default::RuntimeWarning"),  # caught, and an outcome
    pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes and links to devices are part of what is tried"),
]


@pytest.fixture(scope="session")
def seeds(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Seed]:
    return {seed.name: seed for seed in make(tmp_path_factory.mktemp("fuzz") / "seeds")}


@pytest.mark.slow
def test_sound_files_are_read(seeds: dict[str, Seed]) -> None:
    for seed in seeds.values():
        seed.read(seed.path)


@pytest.mark.slow
def test_damaged_files_are_read_or_refused(seeds: dict[str, Seed], tmp_path: Path) -> None:
    tries = [tried(seed, number, tmp_path / "in") for seed in seeds.values() for number in range(FILES // seed.slow)]
    assert [one for one in tries if one.kind not in GOOD] == []
    assert {one.kind for one in tries} == set(GOOD)


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_commands_say_one_line_about_damaged_files(name: str, seeds: dict[str, Seed], tmp_path: Path, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    seed = seeds[name]
    monkeypatch.chdir(tmp_path)

    def spoken(path: Path) -> str | None:
        return command([word.replace("{}", str(path)) for word in seed.words or ()])

    tries = [tried(seed, number, tmp_path / "in", spoken) for number in range(2)]
    assert [one for one in tries if one.kind not in GOOD] == []


def test_a_number_always_makes_the_same_file(seeds: dict[str, Seed], tmp_path: Path) -> None:
    for name in ("COCO annotations", "pair.npz", "phase.safetensors", "OpenPose"):
        made = []
        for folder in ("a", "b"):
            path, damage = damaged(seeds[name], 3, tmp_path / folder)
            files = sorted(path.iterdir()) if path.is_dir() else [path]
            made.append((damage, [(file.name, file.read_bytes()) for file in files if file.is_file()]))
        assert made[0] == made[1]


@pytest.mark.slow
def test_what_must_not_be_is_seen(seeds: dict[str, Seed], tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    assert poor(ValueError(f"{path}: the file is empty; export it again"), path) == []
    assert poor(ValueError("the file is empty; export it again"), path) == ["no file name"]
    assert poor(ValueError(f"{path}: the file is empty"), path) == ["no remedy"]
    assert poor(ValueError(f"{path}: {'9' * 500}; export\nit again"), path) == ["long", "several lines"]
    assert poor(UnicodeDecodeError("utf-8", b"a", 0, 1, "a.csv; x"), path) == ["UnicodeDecodeError"]
    assert judged(2, "dyntorch: a.csv: the file is empty; export it again\n") is None
    assert judged(2, "dyntorch: a\ndyntorch: b; c\n") is not None
    assert judged(1, "Traceback\n") is not None
    seed = seeds["points.csv"]

    def fails(path: Path) -> None:
        raise KeyError(path.name)

    def takes(path: Path) -> None:
        assert len(bytearray(700 * 2**20))  # zeros that are written

    assert tried(seed, 0, tmp_path / "in", fails).kind == "uncaught"
    if Path("/proc/self/clear_refs").exists():
        assert tried(seed, 0, tmp_path / "in", takes).kind == "memory"
