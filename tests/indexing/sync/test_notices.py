"""Notices about a and b, or about cameras by number, in the names of the cameras and the words of the command line."""

from __future__ import annotations

import pytest

from dyntorch.core import Notice
from dyntorch.numerics import Message, with_names, with_words
from dyntorch.tasks.synchronize.result import ClocksNotice, ShiftNotice
from indexing.cli.commands.sync import WORDS
from indexing.sync.brightness import BrightnessNotice
from indexing.sync.recordings import SyncNotice

NAMES = {"a": "left-1", "b": "right", "0": "left-1", "1": "mid", "2": "right"}


@pytest.mark.parametrize(
    ("notice", "said"),
    [
        (Notice(ShiftNotice.NO_POINT, 0.0, {"which": "b"}), "no point is seen in right; check the detections"),
        (Notice(ShiftNotice.STRAIGHT), str(Notice(ShiftNotice.STRAIGHT).text)),  # an article stays what it is
        (Notice(BrightnessNotice.STILL, 0.0, {"which": "a"}), "nothing moves in left-1; choose a take with motion"),
        (Notice(ClocksNotice.ALONE, 1.0, {"cameras": (2,)}), "camera right: tied by one pair alone, which nothing checks"),
        (
            Notice(ClocksNotice.CONTRADICTION, 2.0, {"cameras": (1, 7), "torn": ((0, 2), (1, 2))}),
            "cameras mid, 7: the pairs left-1-right, mid-right contradict each other and nothing tells which is wrong; film "
            "longer, or "
            "add a camera",
        ),
    ],
)
def test_cameras_have_names(notice, said):
    assert notice.with_names(NAMES).text == said
    assert notice.text == notice.with_names({}).text


def test_names_and_flags_stand_in_for_numbers_and_arguments():
    nothing = Notice(ShiftNotice.NOTHING)
    for notice, end in (
        (Notice(ShiftNotice.LENS, 0.0, {"a": -0.1, "b": 0.2}), "an approximation; give --calibration FILE.toml"),
        (nothing, "film longer, or raise --max-shift"),
        (Notice(SyncNotice.ASSUMED, 30.0, {"names": "cam1"}), "assumed for cam1; --fps says otherwise"),
        (Notice(SyncNotice.UNDECIDED, 0.0, {"tracks": nothing.text, "brightness": "no"}), "raise --max-shift; no"),
    ):
        assert notice.with_words(WORDS).text.endswith(end)
    assert with_words(ValueError(Message("{arg:person='all'} needs more")), WORDS) == "--person all needs more"
    assert with_names(ValueError("a plain one"), NAMES) == "a plain one"
    inner = Message("{camera:a} has 8 frames").with_names({"a": "left"})
    assert (
        Message("{pair:pairs}: {note}", pair=((0, 1),), note=inner).with_names({"a": "other", "0": "x"}) == "x-1: left has 8 frames"
    )
