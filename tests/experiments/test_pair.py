"""The table of reconstructions from two cameras, on a made-up person of few joints' motions."""

import json

import numpy as np
import pytest
import torch

from experiments.recognition import protocol
from experiments.reconstruction import pair as pair_reconstruction


@pytest.fixture
def data(tmp_path, monkeypatch):
    """A take of 31 joints that swing about their places."""
    rng = np.random.default_rng(0)
    times = np.arange(300)[:, None, None] / 60
    rest = rng.normal(size=(31, 3)) * (0.3, 0.6, 0.3)
    swing = sum(np.sin(2 * np.pi * (0.5 + 0.4 * k) * times + k) * rng.normal(size=(31, 3)) * 0.06 for k in range(4))
    joints = (rest + swing).astype(np.float32)
    np.savez(
        tmp_path / "cmu_mocap_60fps.npz",
        joints=joints,
        offsets=np.array([0, 300]),
        names=np.array(["01_01"]),
        description=np.array(["swing"]),
    )
    monkeypatch.setenv(protocol.DATA, str(tmp_path))
    return joints


@pytest.mark.slow
def test_tables_are_written(data, tmp_path, capsys):
    config = pair_reconstruction.Config(scenes=1, quick=True, out=tmp_path / "out.json")
    pair_reconstruction.run(config)
    tables = json.loads((tmp_path / "out.json").read_text())["tables"]
    rows = {row["task"]: row["measured"] for row in tables["affine"]}
    assert rows["transfer, mean"] == rows["transfer, median"] >= rows["transfer up to scale, mean"] > 0
    assert {row["task"].split(",")[0] for row in tables["perspective"]} == {
        "transferable",
        "error",
        "motion",
        "explained",
        "corresponding",
    }
    assert "goals reached" in capsys.readouterr().out


def test_parts_move_as_asked(data):
    parts = pair_reconstruction.parts()
    assert parts and all(0.1 < pair_reconstruction.rms(part) < 0.2 and part.shape == (120, 31, 3) for part in parts)


def test_cameras_are_orthographic_and_apart():
    first, second = pair_reconstruction.cameras(torch.Generator().manual_seed(0))
    for camera in (first, second):
        torch.testing.assert_close(camera @ camera.T, torch.eye(2, dtype=torch.float64))
        assert float(camera[0, 1]) == 0 and float(camera[1, 1]) < -0.8
    assert torch.linalg.matrix_rank(torch.cat([first, second])) == 3
