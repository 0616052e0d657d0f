"""The study of silent errors, on invented takes and with a synchronization that is told the answer."""

import dataclasses
import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from experiments.common.results import RESULTS
from experiments.recognition import protocol
from experiments.synchronization import silent
from tests.experiments.test_synchronization import takes


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A data folder with six takes of two kinds, and streams of two exercises."""
    people = takes(6, 700).numpy()
    known = {"names": np.array([f"01_0{k}" for k in range(6)]), "description": np.repeat(["walk", "run"], 3)}
    np.savez(tmp_path / "cmu_mocap_60fps.npz", joints=people.reshape(-1, 31, 3), offsets=np.arange(7) * 700, **known)
    labels = np.repeat([0, 1, 2], 40)  # the last one has no name
    streams = {f"{name}/label_10fps": labels for name in ("13_29", "14_14", "13_30", "13_31", "14_20")}
    streams |= {name.replace("label_10fps", "joints_30fps"): takes(1, 360, k)[0].numpy() for k, name in enumerate(streams)}
    np.savez(tmp_path / "mocap6_exercises.npz", action_names=np.array(["Jog", "Twist"]), **streams)
    monkeypatch.setenv(protocol.DATA, str(tmp_path))
    silent._takes.cache_clear()
    silent._exercises.cache_clear()
    yield
    silent._takes.cache_clear()
    silent._exercises.cache_clear()


def answered(index=0, kind="good", points="same", ok=True, confidence=0.9, error=0.1):
    return silent.Answer(index, kind, points, ok, confidence, error, "" if ok else "repeated", 0.5)


def test_trials_are_the_same_every_time(folder):
    for index in range(2 * len(silent.KINDS)):
        kind, points, pair = silent.trial(index, True)
        assert kind == silent.KINDS[index % len(silent.KINDS)]
        assert torch.equal(pair.b, silent.trial(index, True)[2].b)
        assert pair.a.shape[1] == (17 if points == "same" else 14)
        decidable = kind in ("good", "mirrored", "periodic", "still")
        assert math.isfinite(pair.offset) == decidable


def test_training_has_other_takes(folder):
    one, other = (silent._takes(training) for training in (True, False))
    assert not {take.name for take in one} & {take.name for take in other}
    assert {take.what for take in silent._exercises(True)} == {"Jog", "Twist"}


def test_mirrored_films_show_left_as_right(folder):
    assert sorted(silent.SWAPPED) == list(range(17))
    assert [silent.SWAPPED[k] for k in silent.SWAPPED] == list(range(17))


@pytest.mark.slow
def test_a_run_goes_on_where_it_stopped(folder, tmp_path, monkeypatch, capsys):
    asked = []

    def told(a, b, **given):
        asked.append(a)
        return SimpleNamespace(ok=True, confidence=0.97, offset=0.0, rate=1.0, notices=())

    monkeypatch.setattr(silent.dyn, "synchronize", told)
    config = silent.Config(trials=14, training=True, workers=1, out=tmp_path / "out")
    before = (RESULTS / silent.PICTURE).read_bytes() if (RESULTS / silent.PICTURE).exists() else None
    silent.run(config)
    assert len(asked) == 16
    silent.run(config)
    assert len(asked) == 16
    said = capsys.readouterr().out
    assert "| different | other person" in said
    assert (config.out / silent.PICTURE).read_bytes().startswith(b"\x89PNG")
    assert len(json.loads((config.out / "silent.json").read_text())["answers"]) == 16
    after = (RESULTS / silent.PICTURE).read_bytes() if (RESULTS / silent.PICTURE).exists() else None
    assert before == after
    config.kept.write_text("{}\n")
    with pytest.raises(ValueError, match="line 1: no answer"):
        silent.run(config)


def test_what_counts_as_silent():
    every = [
        answered(),
        answered(ok=False, confidence=0.3),
        answered(kind="backwards", error=math.inf),
        answered(kind="mirrored", error=0.5),
        answered(kind="periodic", error=30.0, ok=False, confidence=0.2),
        answered(kind="still", error=2.0, ok=False, confidence=0.95),
    ]
    assert silent.shares(every, lambda one: one.ok) == (0.5, 0.25)
    table = {(points, kind): rest for points, kind, *rest in silent.table(every)}
    assert table["same", "backwards"] == ["1", "0", "1", "0.50"]
    assert table["same", "mirrored"] == ["1", "1", "0", "0.50"]
    levels = {level: rest for level, *rest in silent.curve(every)}
    assert levels[0.0] == [0.0, 0.75]
    assert levels[0.95] == [1.0, 0.25]
    assert levels[1.0] == [1.0, 0.0]
    assert answered(error=math.nan).wrong


def test_bad_settings_are_one_line():
    for change in ({"trials": 0}, {"workers": 0}):
        with pytest.raises(ValueError, match="must be at least 1"):
            silent.run(dataclasses.replace(silent.Config(), **change))
