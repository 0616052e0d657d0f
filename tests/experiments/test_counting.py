"""Ways of counting repetitions on courses whose number is known, and the experiment on one action."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from experiments.recognition import counting
from indexing import Event


def swings(count: int) -> np.ndarray:
    """A course that goes and comes ``count`` times, 1.2 s each, in six coordinates."""
    time = np.arange(round(count * 1.2 * counting.RATE)) / counting.RATE
    return np.sin(2 * np.pi * time / 1.2)[:, None] * np.array([1.0, -0.5, 0.2, 0.0, 0.7, 0.1])


@pytest.mark.parametrize("count", [5, 12, 30])
def test_peers_count_plain_swings(count: int) -> None:
    assert abs(counting.peaks(swings(count)) - count) <= 1
    assert abs(counting.autocorrelated(swings(count)) - count) <= 1


def test_events_that_follow_each_other_are_one_span() -> None:
    events = [Event("a", start, start + 1.0, 1.0, 1.0) for start in (0.0, 2.0, 9.0)]
    assert counting.merged_spans(events) == [(0.0, 3.0), (9.0, 10.0)]


def test_the_share_within_one() -> None:
    errors = np.array([[0.0, 2.0, np.nan], [1.0, -1.0, np.nan]])
    shares = counting.within_one(errors)
    assert shares[:2] == [1.0, 0.5] and np.isnan(shares[2])


@pytest.mark.slow
def test_sets_of_squats_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(counting, "MOST", 6)
    few = {"people": (1,), "seeds": 1, "actions": ("squat", "bow")}
    counting.run(counting.Config(**few, out=tmp_path))
    tables = json.loads((tmp_path / "figures.json").read_text())["tables"]
    lines = tables["share of the sets counted to within one, learned from one person"]["lines"]
    assert set(lines) == {f"{kind}, {turn}°" for kind in counting.KINDS for turn in counting.TURNS}
    assert min(line[counting.WAYS.index("counted")] for line in lines.values()) == 1.0


def test_what_cannot_be_counted_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="actions: give two or more"):
        counting.run(counting.Config(actions=("squat",), out=tmp_path))
    with pytest.raises(ValueError, match="at least 1"):
        counting.run(counting.Config(sets=0, out=tmp_path))
