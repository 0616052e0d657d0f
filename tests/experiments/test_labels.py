"""The experiments on labels: whoever labels, what labels teach, and the story of an hour in small."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from experiments.labels import story, suggesting
from experiments.recognition.detection import Recording
from indexing import Clip
from indexing.cli import main
from indexing.labels import Label


def recording(labels: list[str], step: float = 0.1) -> Recording:
    times = np.arange(len(labels)) * step
    return Recording(Clip(np.ones((len(labels), 3, 2)), times=times), [], times, np.array(labels, dtype="U8"))


def test_a_part_is_labelled_with_what_fills_it_from_begin_to_end() -> None:
    one = recording(["", "", "", *["a"] * 10, *["b"] * 30, "", "", ""])
    assert suggesting.annotated(one, 4, 0.4, 1.0) == (4, "a", pytest.approx(0.3), pytest.approx(1.2))
    number, label, start, end = suggesting.annotated(one, 0, 2.0, 3.0)  # half of its length beyond it, at most
    assert (number, label) == (0, "b") and (start, end) == (pytest.approx(1.4, abs=0.11), pytest.approx(3.6, abs=0.11))
    assert suggesting.annotated(one, 0, 0.0, 0.25)[1] == "" and suggesting.annotated(one, 0, 7.0, 8.0)[1] == ""


@pytest.mark.slow
def test_all_ways_begin_alike_and_label_as_many(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    monkeypatch.setattr(suggesting, "ACTIONS", ("squat", "wave", "kick"))
    whole = suggesting.performed(rng)
    part = whole.times <= 16.0
    one = replace(whole, clip=whole.clip.between(0.0, 16.0), times=whole.times[part], labels=whole.labels[part])
    monkeypatch.setattr(suggesting, "recordings", lambda name, seed: ([one], [one]))
    for way in ("any", "suggested"):
        shares, kinds = suggesting.course("actors", way, (2, 3), 0)
        assert kinds[0] == 2.0 and len(shares) == 2 and 0 < min(shares) <= max(shares) <= 1


def test_corrections_are_the_true_labels() -> None:
    truth = [Label(1, 3, "squat"), Label(5, 7, "wave")]
    found = [Label(1, 3, "wave", score=0.5), Label(5, 6, "wave", score=2.0), Label(9, 10, "kick", score=0.1)]
    assert story.corrected(found, truth, 2) == [Label(1, 3, "squat")]
    assert story.agreement(truth, truth, 10.0) == [1.0, 1.0, 1.0, pytest.approx(1.0)]


@pytest.mark.slow
def test_the_story_of_a_minute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(story, "ACTIONS", ("squat", "wave"))
    monkeypatch.setattr(story, "BESIDES", ("kick",))
    monkeypatch.setattr(story, "FPS", 15.0)
    monkeypatch.setattr(story, "timed", lambda *words: (float(main([str(word) for word in words])), 0.0))
    story.run(story.Config(minutes=0.5, corrections=2, out=tmp_path))
    tables = json.loads((tmp_path / "figures.json").read_text())["tables"]
    assert len(tables) == 2
    found = tables["what is found"]["lines"]
    assert found["five labels"][0] == 2 and found["and the corrections"][0] >= 2


def test_bad_settings_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="minutes must be positive"):
        story.run(story.Config(minutes=0, out=tmp_path))
    with pytest.raises(ValueError, match="counts grow from 3 on"):
        suggesting.run(suggesting.Config(counts=(8, 4), out=tmp_path))
