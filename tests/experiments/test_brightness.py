"""The table of synchronization by brightness, on a tiny motion capture file and with a method that is told the answer."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from experiments.common.tables import Row
from experiments.recognition import protocol
from experiments.synchronization import brightness as experiment
from indexing.actors import Person, stream


@pytest.fixture
def data(tmp_path, monkeypatch):
    """A data folder with two takes at 60 frames per second: one stays, one walks."""
    joints = np.concatenate([stream(["squat", "wave"], Person(), fps=60.0, rng=seed)[0].joints for seed in (1, 2)])
    takes = [joints[:400], joints[:400] + np.linspace(0, 4, 400)[:, None, None] * [1, 0, 0]]
    np.savez(
        tmp_path / "cmu_mocap_60fps.npz",
        joints=np.concatenate(takes).astype(np.float32),
        offsets=np.array([0, 400, 800]),
        joint_names=np.array([f"joint {i}" for i in range(17)]),
        parents=np.array([-1, 0, 0, 1, 2, 0, 0, 5, 6, 7, 8, 5, 6, 11, 12, 13, 14]),
    )
    monkeypatch.setenv(protocol.DATA, str(tmp_path))
    return tmp_path


def test_cuts_stay_in_place_or_cross(data):
    rng = np.random.default_rng(0)
    still, across = (experiment.captured(kind)(rng, 120).joints for kind in (False, True))
    assert still.shape == (120, 17, 3)
    assert np.ptp(still[:, 0, 0]) < 0.5 and np.ptp(across[:, 0, 0]) > 1.5


@pytest.mark.slow
def test_pairs_show_the_same_moment_at_the_shift():
    pairs = experiment.pairs(experiment.acted, 40, 0.0, 0.0, 3.4, 3, seed=4)
    for pair in pairs:
        assert pair.a.shape == pair.b.shape == (40, 120, 160)
        assert pair.turn == 0.0 and abs(pair.shift) <= 16
    still = [pair for pair in pairs if experiment.activity(pair.a, pair.b) == pair.shift]
    assert len(still) >= 2  # one direction, no noise: even activity tells


def test_figures_count_right_believed_and_wrong(data, monkeypatch):
    answers = iter([(0, True), (1, True), (2, False), (0, True), (0, False), (0, False), (0, False), (0, True), (0, False)])

    def told(a, b, measure):
        by, ok = next(answers)
        return SimpleNamespace(frames=truth[id(a)] + by, ok=ok)

    real, truth = experiment.pairs, {}

    def remembered(*args):
        made = real(*args)
        made = [pair._replace(take=str(k)) for k, pair in enumerate(made)]
        truth.update({id(pair.a): pair.shift for pair in made})
        return made

    monkeypatch.setattr(experiment, "pairs", remembered)
    monkeypatch.setattr(experiment, "shifted", told)
    monkeypatch.setattr(experiment, "activity", lambda a, b: truth[id(a)])
    monkeypatch.setattr(experiment, "SETS", (("tiny", "place", 30, 2.0, 60.0),))
    rows = experiment.figures(experiment.Config(scenes=3), "tiny")
    assert [row.measured for row in rows] == pytest.approx([2 / 3, 1.0, 2 / 3, 0.0, 1.0, 1.0])
    assert rows[0].goal == 0.95 and rows[3].reached and not rows[4].reached


@pytest.mark.slow
def test_everything_is_written(data, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(experiment, "figures", lambda config, name: [Row(name, "", 1.0)])
    monkeypatch.setattr(experiment, "recorded", lambda path: (np.zeros((60, 20, 20), np.uint8), 30.0))
    config = replace(experiment.Config(), quick=True, out=tmp_path / "out.json")
    experiment.run(config)
    tables = json.loads(config.out.read_text())["tables"]
    assert list(tables) == [*(each[0] for each in experiment.SETS), experiment.REAL]
    assert tables[experiment.REAL][2]["measured"] == 0.0
    assert "nothing moves in a" in capsys.readouterr().out


def test_no_data_folder_is_said(monkeypatch, tmp_path):
    monkeypatch.delenv(protocol.DATA, raising=False)
    with pytest.raises(ValueError, match="DYNTORCH_DATA"):
        experiment.run(experiment.Config(out=tmp_path / "out.json"))
