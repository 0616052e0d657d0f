"""The player: what is packed is what was seen, pages stay small, and the script runs where there is a browser."""

from __future__ import annotations

import base64
import json

import numpy as np
import pytest

from indexing.clip import Clip
from indexing.recordings.decoding import Withheld
from indexing.report import RecognitionReport, RecordingResult, player, write_recognition
from indexing.report.player import players
from indexing.report.results import by_recording
from indexing.scoring import Event
from indexing.skeleton import COCO17
from tests.indexing.report.people import BROWSER, Hit, in_browser, person, recording


def numbers(text):
    """What the script's function of this name does."""
    out, value, bits = [], 0, 0
    for byte in base64.b64decode(text):
        value |= (byte & 127) << bits
        bits += 7
        if not byte & 128:
            out.append(value)
            value = bits = 0
    return out


def places(text, joints):
    codes = np.array(numbers(text)).reshape(-1, 2 * joints)
    out, last = np.full(codes.shape, np.nan), np.zeros(2 * joints)
    for row, code in zip(out, codes, strict=True):
        seen = code > 0
        last = last + np.where(seen, np.where(code % 2, (code - 1) / 2, -code / 2), 0)
        row[seen] = last[seen]
    return out.reshape(len(out), joints, 2)


def data(report):
    return [None if one is None else json.loads(one.data) for one in players(by_recording(report.recordings), report)]


def everybody(frames=120, apart=3.0):
    """Two people in one recording, of whom one comes later and is away for a while."""
    first, other, classes = person(frames), person(frames), ["squat", "lunge"]
    there = np.r_[30:60, 100:120]
    late = other.replace(joints=other.joints[there] + [apart, 0], times=other.times[there])
    scores = np.zeros((frames, 2))
    return [
        RecordingResult("both.json", first, first.times, classes, scores, [Hit("squat", 1, 2)], person="4"),
        RecordingResult("both.json", late, late.times, classes, scores[: len(there)], [Hit("lunge", 1.5, 2)], person="7"),
    ]


def test_what_is_packed_is_what_was_seen():
    rng = np.random.default_rng(0)
    joints = np.cumsum(rng.normal(0, 30, (50, 5, 2)), axis=0)
    joints[rng.random((50, 5)) < 0.2] = np.nan
    joints[:, 4] = np.nan
    joints[7, 0] = 1e9  # a detector's mistake stays on the grid
    back = places(base64.b64encode(player.pack_joints(joints, 2.0, np.array([5.0, -3.0]))), 5)
    expected = np.clip(np.round((joints - [5.0, -3.0]) / 2.0), -32000, 32000)
    assert np.array_equal(back, expected, equal_nan=True)
    large = np.array([0, 1, 127, 128, 300, 2**31, 10**12])
    assert numbers(base64.b64encode(player._varints(large))) == large.tolist() and player._varints(large[:0]) == b""


def test_a_recording_is_packed_with_its_people_events_and_examples():
    clip = person(90, up="-y")
    held = Withheld(Event("lunge", 2.0, 2.5, 1.0, 1.0, 0), "at rest")
    one = RecordingResult(
        "a", clip, clip.times, ["squat", "lunge"], np.zeros((90, 2)), [Hit("squat", 1, 2, exemplar=0)], [("squat", 1.0, 2.2)],
        withheld=[held],
    )  # fmt: skip
    (shown,) = data(RecognitionReport("t", recordings=[one], exemplars={"squat": [person(40)], "lunge": person(50)}))
    assert [bar[:5] for bar in shown["bars"]] == [[0, 0, 0, 1000, 2000], [0, 1, 0, 1000, 2200], [0, 2, 1, 2000, 2500]]
    assert [bar[5] for bar in shown["bars"]] == [0, -1, 1] and set(shown["examples"]) == {"0", "1"}
    assert [name for name, _ in shown["actions"]] == ["squat", "lunge"]
    assert shown["examples"]["0"]["lasts"] == pytest.approx(1333, abs=2)
    (who,) = shown["people"]
    times = who["first"] + np.cumsum([0, *numbers(who["times"])])
    assert times[0] == 0 and times[-1] == round(1000 * clip.times[-1]) and len(times) == pytest.approx(15 * 3, abs=2)
    drawn = places(who["joints"], 6)
    assert (drawn[:, 0, 1] > drawn[:, 3, 1]).all()  # upright, although the file's y points down
    assert np.median(np.ptp(drawn[..., 1], axis=1)) == pytest.approx(240, abs=20)
    assert who["skeleton"]["face"] == [0] and [0, 3, "m"] in who["skeleton"]["bones"]


def test_people_share_a_stage_and_who_is_away_is_not_drawn():
    (shown,) = data(RecognitionReport("t", recordings=everybody()))
    assert [one["name"] for one in shown["people"]] == ["4", "7"] and [bar[0] for bar in shown["bars"]] == [0, 1]
    first, late = shown["people"]
    assert late["first"] == 1000 and max(numbers(late["times"])) > shown["absent"] > max(numbers(first["times"]))
    left, right = places(first["joints"], 6), places(late["joints"], 6)
    assert np.nanmin(right[..., 0]) - np.nanmax(left[..., 0]) > 100  # they stand apart, in steps of the grid
    assert shown["view"][0] > 2 * 240 and shown["view"][2] == 0
    far, _ = everybody(apart=0.0)
    walk = far.clip.replace(joints=far.clip.joints + np.linspace(0, 12, 120)[:, None, None] * [1.0, 0.0])
    (shown,) = data(RecognitionReport("t", recordings=[RecordingResult("w", walk, walk.times, ["a"], np.zeros((120, 1)))]))
    assert shown["view"][2] == 1 and shown["view"][0] < 3 * 240  # the picture follows


def test_between_events_fewer_poses_are_kept_where_not_all_fit(monkeypatch):
    report = RecognitionReport("t", recordings=[recording([Hit("squat", 2, 4)], frames=900)])
    (whole,) = players(by_recording(report.recordings), report)
    assert whole.rates == (15.0, 15.0)
    monkeypatch.setattr(player, "FURTHER_VALUES", 0.0)
    monkeypatch.setattr(player, "TYPICAL_VALUES", 2400)
    (less,) = players(by_recording(report.recordings), report)
    at, between = less.rates
    assert at > between
    (who,) = json.loads(less.data)["people"]
    times = np.cumsum([0, *numbers(who["times"])]) / 1000
    busy = (times >= 1.5) & (times <= 4.5)
    assert busy.sum() / 3 == pytest.approx(at, rel=0.2) and (~busy).sum() / 27 == pytest.approx(between, rel=0.3)
    assert times[-1] == pytest.approx(899 / 30, abs=1e-3)
    monkeypatch.setattr(player, "TYPICAL_VALUES", 60)
    (least,) = players(by_recording(report.recordings), report)
    assert len(json.loads(least.data)["people"][0]["joints"]) < 300 and least.rates[0] < 3  # never more than fits


def test_there_is_no_player_without_joints_and_gaps_cost_nothing(tmp_path):
    unseen = RecordingResult("u", Clip(np.full((9, 6, 2), np.nan)), np.arange(9) / 30, ["a"], np.zeros((9, 1)))
    report = RecognitionReport("t", recordings=[recording(clip=False), unseen])
    assert data(report) == [None, None]
    text = write_recognition(tmp_path, report).read_text()
    assert "<script" not in text and "script-src" not in text and 'class="player"' not in text
    clip = person(60)
    clip = clip.replace(times=np.where(np.arange(60) < 30, clip.times, clip.times + 1e9))
    (shown,) = data(RecognitionReport("t", recordings=[RecordingResult("g", clip, clip.times, ["a"], np.zeros((60, 1)))]))
    steps = numbers(shown["people"][0]["times"])
    assert len(steps) < 40 and max(steps) == pytest.approx(1e12, rel=1e-6)


@pytest.mark.slow
def test_ten_minutes_stay_below_a_megabyte(tmp_path):
    rng, frames = np.random.default_rng(0), 18_000
    phase = np.arange(frames)[:, None, None] / 30 * rng.uniform(2, 6, (17, 1)) + rng.uniform(0, 6, (17, 2))
    joints = rng.uniform(0, 1, (17, 2)) * [0.5, 1.7] + 0.2 * np.sin(phase) + rng.normal(0, 0.01, (frames, 17, 2))
    clip = Clip(joints, fps=30.0, skeleton=COCO17)
    names = [f"action {i}" for i in range(20)]
    events = [Hit(names[i % 20], 5.0 * i, 5.0 * i + 3, exemplar=0) for i in range(119)]
    one = RecordingResult("ten", clip, clip.times, names, np.zeros((frames, 20)), events)
    shown = {name: [Clip(joints[30 * i : 30 * i + 12], skeleton=COCO17)] for i, name in enumerate(names)}
    text = write_recognition(tmp_path, RecognitionReport("t", recordings=[one], exemplars=shown)).read_text()
    assert len(text.encode()) < 1_000_000 and "poses a second" in text


# the browser's own frames come late, or not at all, where the machine is busy: here they come when the driver says
DRIVER = """
let waiting = null, clock = 0;
window.requestAnimationFrame = (draw) => { waiting = draw; };
const frame = (after) => { const draw = waiting; waiting = null; clock += after; draw(clock); };
const player = document.querySelector(".player"), bars = [...player.querySelectorAll(".found")];
const press = (key) => player.dispatchEvent(new KeyboardEvent("keydown", { key, bubbles: true, cancelable: true }));
const said = {};
const toggle = player.querySelector(".controls button:nth-child(2)");
const note = (name) => { said[name] = [Number(player.dataset.time), toggle.textContent]; };
note("begin"); press("ArrowRight"); note("step"); press("ArrowDown"); note("first"); press("ArrowDown"); note("second");
press("ArrowUp"); note("back"); press(" "); note("stopped");
bars[1].click(); frame(16); note("clicked"); frame(100); frame(200); note("played"); frame(240); note("again");
frame(5000); note("late"); press("Escape"); press(" ");
said.bars = bars.map((bar) => bar.getAttribute("aria-label"));
said.ink = [...player.querySelectorAll("canvas")].map((canvas) => {
  const pixels = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
  return pixels.some((value) => value > 0);
});
said.wide = document.documentElement.scrollWidth - window.innerWidth;
document.title = JSON.stringify(said);
"""


@pytest.mark.skipif(BROWSER is None, reason="needs a browser: chromium or chrome")
def test_it_plays_in_a_browser(tmp_path):
    report = RecognitionReport("t", recordings=everybody(), exemplars={"squat": person(40), "lunge": person(50)})
    text = write_recognition(tmp_path, report).read_text(encoding="utf-8")
    said = in_browser(text, DRIVER, tmp_path, "--window-size=600,900")
    assert said["begin"] == [0.0, "Play"] and said["step"] == [pytest.approx(1 / 15, abs=2e-3), "Play"]
    assert said["first"] == [1.0, "Pause"] and said["second"] == [1.5, "Pause"] and said["back"] == [1.0, "Pause"]
    assert said["stopped"] == [1.0, "Play"] and said["clicked"] == [1.5, "Pause"]
    assert said["played"] == [pytest.approx(1.8, abs=2e-3), "Pause"]
    assert said["again"] == [1.5, "Pause"]  # past its end the chosen event begins anew
    assert said["late"] == [pytest.approx(1.75, abs=2e-3), "Pause"]  # a frame that comes late skips no more than a quarter
    assert said["bars"] == ["found: squat, person 4, 1.00 to 2.00 s", "found: lunge, person 7, 1.50 to 2.00 s"]
    assert said["ink"] == [True, True] and said["wide"] <= 0
