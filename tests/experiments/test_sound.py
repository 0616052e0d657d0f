"""The table of synchronization by sound, on few and short recordings."""

import json
from dataclasses import replace

import numpy as np
import pytest

from experiments.synchronization import sound as experiment
from indexing.sync.sound import sound_shift


@pytest.mark.parametrize("kind", experiment.SOURCES)
def test_sources_are_heard_all_along(kind):
    made = experiment.SOURCES[kind](np.random.default_rng(0), 12.0)
    loud = np.abs(made).reshape(12, -1).max(axis=1)
    assert len(made) == 12 * experiment.HERTZ and (loud[:9] > 0).sum() >= 6 and np.isfinite(made).all()


def test_the_truth_is_where_the_clocks_are():
    pair = experiment.pair("speech", 30, 3, 12.0)
    found = sound_shift(pair.a, pair.b)
    assert found.ok and abs(experiment.off(found, pair)) < 2e-3
    assert pair.a.rate == 48_000 and pair.b.rate == 44_100 and abs(pair.rate - 1) <= experiment.DRIFT


@pytest.mark.slow
def test_rows_count_believed_and_wrong(tmp_path, monkeypatch):
    monkeypatch.setattr(experiment, "LONG", 8.0)
    monkeypatch.setattr(experiment, "NOISES", (10,))
    monkeypatch.setattr(experiment, "SOURCES", {name: experiment.SOURCES[name] for name in ("speech", "claps", "steps")})
    original = experiment.pair
    monkeypatch.setattr(experiment, "pair", lambda kind, decibels, seed, seconds=8.0: original(kind, decibels, seed, 8.0))
    config = replace(experiment.Config(), scenes=2, out=tmp_path / "sound.json")
    rows = experiment.together(config, "speech")
    assert [row.task for row in rows][:2] == ["believed", "wrong among the believed"] and rows[1].measured == 0
    assert "2 pairs, +10 dB" in rows[0].setting
    assert all(row.measured == 0 and row.reached for row in experiment.unrelated(config))
    assert json.dumps([vars(row) for row in rows])
