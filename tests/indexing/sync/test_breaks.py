"""Clocks that broke: the recordings get the times at which their frames were taken, and the written files are in step."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import dyntorch
from dyntorch import Status
from dyntorch.core import Notice, NoticeCode
from indexing.cli import main
from indexing.sync.people import Pairing
from indexing.sync.recordings import take_of
from indexing.sync.synchronize import find_breaks, retime
from indexing.sync.trimming import FOLDER
from tests.indexing.sync.footage import numbers_of, write_film
from tests.indexing.sync.scene import FPS, cut, filmed, shift, write_openpose

LOST, AT = 6, 60  # frames, and the first that is later than its number says


class Broke(NoticeCode):
    LOST = "lost", "{camera:1} lost {value:g} frames"
    OPEN = "open", "not decided", Status.AMBIGUOUS


def told(times, jump=LOST / FPS):
    """What the library says: b lost frames."""
    later = [times[0], times[1] + jump * (torch.arange(len(times[1])) >= AT)]
    one = SimpleNamespace(
        camera=None, candidates=(1, 0), moments=(2.0, 2.1), sigma=0.02, jump=-jump, jump_sigma=0.001, frames=LOST, doubled=False,
        evidence=90.0, residuals=(9.0, 2.0),
    )  # fmt: skip
    notice = Notice(Broke.LOST, float(LOST))
    return dataclasses.replace(_Breaks(), breaks=(one,), times=tuple(later), notices=(notice,))


@dataclasses.dataclass(frozen=True)
class _Breaks:
    breaks: tuple = ()
    times: tuple = ()
    notices: tuple = ()
    ok: bool = True


@pytest.fixture
def library(monkeypatch):
    """A shift of nothing, and a break of b; records how it was asked."""
    asked: dict = {"times": []}

    def breaks(a, b, first=None, *, times, **given):
        asked.update(given, shapes=(a.shape, b.shape))
        return asked.get("says", told)(times)

    def answer(a, b, *, times, **_):
        asked["times"].append(times)
        return shift(0.0)

    monkeypatch.setattr(dyntorch.tasks, "breaks", breaks, raising=False)
    monkeypatch.setattr(dyntorch, "synchronize", answer, raising=False)
    return asked


@pytest.fixture(scope="module")
def clips():
    return [cut(clip, 0, 120) for clip in filmed()[:2]]


def test_takes_get_the_times_of_their_frames(library, clips):
    takes = [take_of(clip, name=name) for clip, name in zip(clips, ("left", "right"), strict=True)]
    found = find_breaks(takes, {(0, 1): Pairing(shift(0.0), (0, 0))}, max_shift=3.0)
    assert found is not None and library["max_shift"] == 3.0
    assert library["shapes"] == tuple(clip.joints.shape for clip in clips)
    left, right = found.takes
    assert left is takes[0] and np.allclose(np.diff(right.times)[AT - 1], (1 + LOST) / FPS)
    assert np.array_equal(right.people[0].times, right.times) and str(found.found.notices[0].text) == "right lost 6 frames"
    [said] = found.as_json()
    assert said["candidates"] == ["right", "left"] and said["camera"] is None and said["frames"] == LOST
    json.dumps(said)


def test_where_nothing_broke_or_nothing_tells(library, clips):
    takes = [take_of(clip, name=name) for clip, name in zip(clips, ("left", "right"), strict=True)]
    pairs = {(0, 1): Pairing(shift(0.0), (0, 0))}
    library["says"] = lambda times: _Breaks(times=tuple(times))
    assert find_breaks(takes, pairs) is None
    library["says"] = lambda times: dataclasses.replace(told(times), ok=False)
    assert find_breaks(takes, pairs) is None
    other = take_of(np.random.default_rng(0).uniform(size=(120, 7, 2)), name="other", fps=FPS)
    assert find_breaks([takes[0], other], pairs) is None
    assert find_breaks([takes[0], dataclasses.replace(other, kind="video", people=())], pairs) is None


def test_people_who_are_seen_in_some_frames_only(clips):
    take = take_of(clips[0], name="left")
    late = clips[0].replace(joints=clips[0].joints[30:], times=clips[0].times[30:], confidence=clips[0].confidence[30:])
    both = dataclasses.replace(take, people=(late,), everyone=(late, clips[0]))
    moved = retime(both, late.times, np.where(np.arange(90) >= 30, 0.5, 0.0))
    assert moved.people[0] is moved.everyone[0] and np.allclose(moved.times[[29, 59, 60]], [29 / FPS, 59 / FPS, 2.5])
    assert np.allclose(moved.everyone[1].times, moved.times)


@pytest.mark.slow
def test_what_is_written_is_in_step(library, clips, tmp_path, monkeypatch, capsys):
    pytest.importorskip("av")
    monkeypatch.setattr("indexing.report.sync.picture_of", lambda report: b"\x89PNG".ljust(16, b"\0") + bytes([0, 0, 0, 9]) * 2)
    kept = np.delete(np.arange(120 + LOST), np.arange(AT, AT + LOST))  # numbers of the scene that b took
    for name, numbers, clip in (("a", np.arange(120), clips[0]), ("b", kept, clips[1])):
        write_openpose(tmp_path / f"{name}_json", [clip])
        write_film(tmp_path / f"{name}.mp4", numbers, FPS)
    line = ["sync", str(tmp_path / "a_json"), str(tmp_path / "b_json"), "--fps", "30", "--videos", "--out", str(tmp_path / "out")]
    assert main(line) == 0
    out = capsys.readouterr().out
    assert "note: b lost 6 frames" in out and "as if no frame had been lost" in out and f"2 videos of 12{0} frames" in out
    assert [times[1][-1].item() for times in library["times"]] == pytest.approx([119 / FPS, 125 / FPS])  # compared again
    first, second = (numbers_of(tmp_path / "out" / FOLDER / f"{name}.mp4") for name in "ab")
    gap = set(range(AT, AT + LOST))
    assert first == list(range(120)) and [n for n in second if n not in (AT - 1, AT + LOST)] == [
        n for n in range(120) if n not in {AT - 1, AT + LOST} | gap
    ]
    names = {int(file.name.split("_")[2]): file for file in Path(tmp_path, "out/pose-sync/b_json").iterdir()}
    assert gap & set(names) <= {AT - 1, AT, AT + LOST - 1, AT + LOST} and AT + LOST in names
    source = tmp_path / "b_json" / f"b_json_{AT:012d}_keypoints.json"
    assert names[AT + LOST].read_text() == source.read_text()
    said = json.loads((tmp_path / "out" / "sync.json").read_text())
    assert [one["frames"] for one in said["breaks"]] == [LOST] and said["cameras"][1]["end"] == pytest.approx(119 / FPS)
    assert main([*line, "--no-breaks"]) == 0
    assert json.loads((tmp_path / "out" / "sync.json").read_text())["breaks"] == []


@pytest.fixture
def doubtful(library, monkeypatch):
    """Three cameras of which one pair alone sees a break."""

    def camera_breaks(tracks, clocks, *, times, **_):
        found = library.get("sees", told)(times)
        return dataclasses.replace(found, times=(*found.times, times[2]))

    monkeypatch.setattr(dyntorch.tasks, "camera_breaks", camera_breaks, raising=False)
    monkeypatch.setattr("indexing.report.sync.picture_of", lambda report: b"\x89PNG".ljust(16, b"\0") + bytes([0, 0, 0, 9]) * 2)
    return library


@pytest.mark.slow
def test_a_break_that_nothing_confirms_is_said_and_not_mended(doubtful, clips, tmp_path, monkeypatch, capsys):
    for name in "abc":
        write_openpose(tmp_path / "pose" / f"{name}_json", [clips[0]])
    line = ["sync", str(tmp_path / "pose"), "--fps", "30", "--out", str(tmp_path / "out")]
    assert main(line) == 0
    out = capsys.readouterr().out
    assert "note: doubtful, and not mended, as other pairs of these cameras see nothing of it: b lost 6 frames" in out
    assert json.loads((tmp_path / "out" / "sync.json").read_text())["breaks"] == [] and len(doubtful["times"]) == 3

    def known(times):
        found = told(times)
        found.breaks[0].camera, found.breaks[0].candidates, found.breaks[0].moments = 1, (1,), (2.0,)
        return found

    doubtful["sees"] = known
    assert main(line) == 0 and "note: b lost 6 frames" in capsys.readouterr().out
    [said] = json.loads((tmp_path / "out" / "sync.json").read_text())["breaks"]
    assert said["camera"] == "b" and len(doubtful["times"]) == 9
    decided = {True: 3, False: 1}  # before, and mended
    monkeypatch.setattr("indexing.report.sync.SyncReport.num_decided", property(lambda one: decided[one.takes[1].times[-1] < 4.1]))
    assert main(line) == 0 and "as fewer pairs decide when it is mended: b lost 6 frames" in capsys.readouterr().out
