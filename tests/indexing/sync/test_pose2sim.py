"""Trial folders of Pose2Sim: what is read of them, and what its next steps find."""

from __future__ import annotations

import dataclasses
import json
import os
import re
from pathlib import Path

import numpy as np
import pytest

import dyntorch
from dyntorch.tasks.synchronize.cameras import synchronize_cameras
from indexing.cli import main
from indexing.sync.pose2sim import numbers, trial_of, trials_in
from tests.indexing.sync.footage import write_film
from tests.indexing.sync.scene import FPS, SKIPPED, cut, filmed, shift, write_openpose

pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated")
LENS = "[{}]\nmatrix = [[900, 0, 320], [0, 900, 240], [0, 0, 1]]\ndistortions = [0, 0, 0, 0]\nfisheye = {}\n"


def empty(folder: Path, *cameras: str) -> Path:
    """A trial with a frame of keypoints for each camera."""
    for name in cameras:
        (folder / "pose" / f"{name}_json").mkdir(parents=True)
        (folder / "pose" / f"{name}_json" / f"{name}_000000.json").write_text('{"people": []}')
    return folder


def test_what_is_read(tmp_path):
    pytest.importorskip("av")
    trial = empty(tmp_path / "trial", "cam10", "cam2", "cam1")
    assert trial_of(trial) is None  # no configuration
    (trial / "Config.toml").write_text("[project]\nframe_rate = 'auto'\n")
    write_film(trial / "videos" / "cam2.mp4", np.arange(6), 25)
    for age, name in enumerate(("old", "new")):
        (trial / "calibration").mkdir(exist_ok=True)
        (trial / "calibration" / f"{name}.toml").write_text("".join(LENS.format(f"cam{i}", "false") for i in (1, 2, 10)))
        os.utime(trial / "calibration" / f"{name}.toml", (age, age))
    found = trial_of(trial)
    assert found is not None and list(found.cameras) == ["cam1", "cam2", "cam10"] and found.fps is None
    assert list(found.films) == ["cam2"] and found.rates() == [None, 25.0, None]
    assert found.calibration is not None and found.calibration.name == "new.toml"
    lenses, notes = found.lenses(list(found.cameras))
    assert lenses is not None and [lens.name for lens in lenses] == list(found.cameras) and "lenses of" in notes[0]


def test_lenses_that_do_not_fit_are_said(tmp_path):
    trial = empty(tmp_path, "cam1", "cam2")
    (trial / "Config.toml").write_text("")
    assert dataclasses.replace(trial_of(trial), calibration=None).lenses(["cam1"]) == (None, ())
    (trial / "calibration").mkdir()
    file = trial / "calibration" / "Calib.toml"
    file.write_text(LENS.format("left", "false"))
    lenses, notes = trial_of(trial).lenses(["cam1", "cam2"])
    assert lenses is None and "lenses are not known" in notes[0] and "its cameras are left" in notes[0]
    file.write_text(LENS.format("cam1", "true") + LENS.format("cam2", "false"))
    assert "cam1 has a fisheye lens" in trial_of(trial).lenses(["cam1", "cam2"])[1][0]


def test_the_frame_rate_of_a_trial_or_of_its_session(tmp_path):
    trial = empty(tmp_path / "trial", "cam1", "cam2")
    for above, own, rate in (
        ("", "frame_rate = 60", 60),
        ("frame_rate = 120", "", 120),
        ("frame_rate = 120", "frame_rate = 60", 60),
        ("frame_rate = 120", "frame_rate = 'auto'", None),
    ):
        (trial / "Config.toml").write_text(f"[project]\n{own}\n")
        (tmp_path / "Config.toml").write_text(f"[project]\n{above}\n")
        assert trial_of(trial).fps == rate
    for wrong in ("0", "-1", "true", "'fast'", "nan"):
        (trial / "Config.toml").write_text(f"[project]\nframe_rate = {wrong}\n")
        with pytest.raises(ValueError, match=r"Config\.toml: \[project\] frame_rate: expected a positive number or 'auto', got"):
            trial_of(trial)


def test_a_session(tmp_path):
    for name in ("Trial_1", "Trial_2", "P1/Trial_3"):
        empty(tmp_path / name, "cam1", "cam2")
    assert trials_in(tmp_path) == []
    (tmp_path / "Config.toml").write_text("[project]\nexclude_from_batch = ['Trial_2']\n")
    (tmp_path / "P1" / "Config.toml").write_text("")
    assert [trial.name for trial in trials_in(tmp_path)] == ["Trial_3", "Trial_1"]
    assert numbers([]) == 0


# ---- the whole way --------------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("session")
    for seed in (1, 3):
        trial = folder / f"Trial_{seed}"
        for i, clip in enumerate(filmed(seed), start=1):
            write_openpose(trial / "pose" / f"cam0{i}_json", [cut(clip, 0, 100)] if i == 2 else [clip], missing=(40,))
        (trial / "Config.toml").write_text("# [project]\n")
    (folder / "Config.toml").write_text(f"[project]\nframe_rate = {FPS:g}\n")
    return folder


@pytest.fixture
def library(monkeypatch):
    """What the library says of pairs of cameras: the truth, by how many frames both have."""
    late = {}
    for seed in (1, 3):
        late |= {(100 if i == 1 else len(clip)) - 1: SKIPPED[i] for i, clip in enumerate(filmed(seed))}  # one frame is missing

    def answer(a, b, **_):
        return shift((late[len(a)] - late[len(b)]) / FPS)

    monkeypatch.setattr(dyntorch, "synchronize", answer, raising=False)
    monkeypatch.setattr(dyntorch, "synchronize_cameras", synchronize_cameras, raising=False)
    monkeypatch.setattr("indexing.report.sync.picture_of", lambda report: b"\x89PNG".ljust(16, b"\0") + bytes([0, 0, 0, 9]) * 2)


def pose2sim_sees(trial: Path) -> list[list[int]]:
    """Frame numbers of each camera, as Pose2Sim reads them: the last number of a name, of the folders that pose/ has."""
    folders = sorted(folder.name for folder in (trial / "pose").iterdir() if "json" in folder.name)
    return [sorted(int(re.split(r"(\d+)", file.name)[-2]) for file in (trial / "pose-sync" / name).iterdir()) for name in folders]


@pytest.mark.slow
def test_a_session_is_written_in_place_of_pose2sims_own_step(session, library, capsys):
    assert main(["sync", str(session), "--no-breaks"]) == 0
    out = capsys.readouterr().out
    assert "trial Trial_1:" in out and "trial Trial_3:" in out and "assumed" not in out
    assert "frame numbers in pose-sync are those of cam02, the shortest recording, as in Pose2Sim" in out
    trial = session / "Trial_1"
    seen = pose2sim_sees(trial)
    count = len(seen[0])
    assert all(one == list(range(count)) for one in seen) and count >= 100  # no number is missing in any camera
    said = json.loads((trial / "sync.json").read_text())
    assert [camera["shifted"]["shift"] for camera in said["cameras"]] == [SKIPPED[1], 0, SKIPPED[1] - SKIPPED[2]]
    for camera, moved in (("cam01", 12), ("cam02", 0), ("cam03", -13)):
        written, source = (f"{camera}_json/{camera}_json_{number:012d}_keypoints.json" for number in (20, 20 + moved))
        assert (trial / "pose-sync" / written).read_text() == (trial / "pose" / source).read_text()
    lost = trial / "pose-sync" / "cam02_json" / "cam02_json_000000000040_keypoints.json"
    assert json.loads(lost.read_text()) == {"version": 1.3, "people": []}
    assert main(["sync", str(session / "Trial_1"), "--no-breaks"]) == 0  # what this command wrote is written again


@pytest.mark.slow
def test_what_pose2sim_wrote_is_not_replaced(session, library, tmp_path, capsys):
    trial = session / "Trial_3"
    (trial / "sync.json").unlink(missing_ok=True)
    (trial / "pose-sync" / "cam01_json").mkdir(parents=True, exist_ok=True)
    assert main(["sync", str(trial)]) == 2
    assert "pose-sync: is there, and not from this command; move it away" in capsys.readouterr().err
    out = tmp_path / "elsewhere"
    assert main(["sync", str(trial), "--out", str(out), "--no-breaks"]) == 0 and (out / "pose-sync" / "cam01_json").is_dir()
