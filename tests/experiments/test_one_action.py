"""One action learned alone: how the figures are counted."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.recognition import one_action
from indexing import Clip
from indexing.scoring import Event


def event(label: str, start: float, end: float) -> Event:
    return Event(label, start, end, 1.0, 1.0)


def test_figures_by_hand() -> None:
    clip = Clip(np.zeros((301, 3, 2)), fps=5.0)
    truth = [event("squat", 0.0, 2.0), event("wave", 3.0, 5.0), event("squat", 10.0, 12.0), event("kick", 20.0, 22.0)]
    tally = one_action.Tally()
    tally.add(
        "squat", [event("squat", 0.2, 2.0), event("squat", 3.0, 4.5), event("squat", 40.0, 41.0)], one_action.Joined(clip, truth)
    )
    assert (tally.known, tally.found, tally.others, tally.taken, tally.wrong) == (2, 1, 2, 1, 2)
    assert tally.row == pytest.approx([0.5, 0.5, 1 / 3, 2.0])
    tally.add("squat", [], one_action.Joined(clip, truth[:1]))
    assert (tally.known, tally.found, tally.wrong) == (3, 1, 2)


def test_clips_are_joined_where_the_last_one_stood() -> None:
    rng = np.random.default_rng(0)
    clips = [Clip(rng.normal(size=(20, 4, 2)) + place, fps=10.0) for place in (0.0, 50.0)]
    one = one_action.joined(clips, np.array(["a", "b"]))
    assert [(e.label, round(e.start, 2), round(e.end, 2)) for e in one.truth] == [("a", 0.0, 1.9), ("b", 2.0, 3.9)]
    assert (np.diff(one.clip.times) > 0).all() and np.abs(np.median(one.clip.joints[20:])) < 1.0


@pytest.mark.parametrize("config", [{"sets": ()}, {"rates": (1.5,)}, {"recordings": 0}])
def test_bad_settings(config, tmp_path) -> None:
    with pytest.raises(ValueError, match=r"sets|rates"):
        one_action.run(one_action.Config(**{"out": tmp_path, **config}))
