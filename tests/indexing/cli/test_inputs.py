"""What commands say of recordings that are read without an error and still are not what they seem."""

import csv
import dataclasses
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from indexing import ActionIndexer, ActionOptions, Clip, ClipSet, synchronize
from indexing.actors import Person, dataset
from indexing.cli import main
from indexing.cli.flags.shared import Reading
from indexing.cli.inputs import clip_notes
from indexing.recordings.decoding import Withheld
from indexing.skeleton import BODY25, COCO17, Skeleton
from tests.indexing.cli.footage import write_coco
from tests.indexing.sync.scene import cut, write_openpose

ORDER = np.random.default_rng(0).permutation(17)


@pytest.fixture(scope="module")
def clips():
    return {clip.label: clip for clip in dataset([Person.random(0)], ("squat", "wave", "kick"), azimuth=0.0, rng=0)}


@pytest.fixture(scope="module")
def data(tmp_path_factory, clips):
    """Folders ``squat``, ``wave`` and ``kick``, and the model ``m.safetensors`` of all three."""
    folder = tmp_path_factory.mktemp("remarks")
    for name, clip in clips.items():
        openpose(folder / name, [clip])
    examples = [f"{name}={folder / name}" for name in clips]
    assert main(["index", "fit", *examples, "--fps", "30", "-o", str(folder / "m.safetensors")]) == 0
    return folder


@pytest.fixture
def run(tmp_path, monkeypatch, capsys, data):
    shutil.copytree(data, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    capsys.readouterr()

    def call(words):
        code = main(words.split())
        said = capsys.readouterr()
        return code, " ".join(said.out.split()), said.err

    return call


def body25(clip, scale=1.0):
    """The same with the joints of OpenPose's layout."""
    joints, trust = np.full((len(clip), 25, 2), np.nan), np.zeros((len(clip), 25))
    places = [BODY25.joints.index(name) for name in COCO17.joints]
    joints[:, places], trust[:, places] = clip.joints * scale, clip.seen
    return Clip(joints, times=clip.times, confidence=trust)


def openpose(folder, people, start=0, scale=1.0):
    write_openpose(folder, [body25(clip, scale) for clip in people], start)


@pytest.mark.slow
def test_examples(run, clips):
    openpose(Path("still"), [clips["wave"].replace(joints=np.repeat(clips["wave"].joints[:1], len(clips["wave"]), axis=0))])
    code, out, _ = run("index fit squat=squat@0.5-99 wave=wave still=still --fps 30 -o m.safetensors")
    end = clips["squat"].times[-1]
    assert code == 0 and f"note: squat@0.5-99: the recording runs from 0 to {end:.6g} s; {end - 0.5:.3g} s of it is used" in out
    assert "still: nobody moves there; a pose is learned, not an action" in out
    assert "8 of 25 joints are never seen in squat, wave; what they do is not learned" in out
    assert "add examples" not in out and "people in view" not in out and "coordinates" not in out
    code, out, _ = run("index fit squat=squat wave=wave --fps 30 -o two.safetensors")
    assert "squat and wave are all that is known" in out and "add examples of ordinary movement" in out
    code, _, err = run("index fit a=squat b=squat -o m.safetensors")
    assert code == 2 and "squat: is given as a and as b; correct a label, or give the seconds of each" in err
    shutil.copytree("squat", "copy")
    code, _, err = run("index fit a=squat b=copy -o m.safetensors")
    assert code == 2 and "clips 0 ('squat') and 1 ('copy') are the same recording, but one is a and the other b" in err
    code, out, err = run("index fit a=squat a=copy b=wave -o m.safetensors")
    assert code == 0 and "warning: clips 0 ('squat') and 1 ('copy') are the same recording, which counts twice" in err
    code, out, _ = run("index fit a=squat@0-1 b=squat@1-9 --fps 30 -o m.safetensors")  # two parts of one recording may differ
    assert code == 0 and "count both as" not in out
    code, out, _ = run("index fit a=squat@0-1 b=./squat@0.5-2 c=squat@1.8- --fps 30 -o m.safetensors")
    assert code == 0 and "squat: 0.5 to 1 s count both as a and as b; correct the ranges" in out
    assert "squat: 1.8 to 2 s count both as b and as c" in out


RANGES = {
    **dict.fromkeys(
        ("1,5-4", "abc", "-", "1", "1:05-1:10", "-1-4", "1.5-4s", "", "1- 2", "1.5\u20134"), "is no range; write @start-end in"
    ),
    **dict.fromkeys(("4-2", "1-1"), "it ends at"),
    "35-99": "no frame between 35 s and 99 s; it runs from 0 s to",
    "35-": "no frame between 35 s and its end; it runs from 0 s to",
    "-0.01": "squat@-0.01: one frame only lies in these seconds (0 s); give more of them",
}


@pytest.mark.parametrize("seconds", RANGES)
def test_seconds_that_are_none(run, capsys, seconds):
    main(["index", "fit", f"a=squat@{seconds}", "b=wave", "--fps", "30", "-o", "none.safetensors"])
    err = capsys.readouterr().err
    assert RANGES[seconds] in err and err.count("\n") == 1 and not Path("none.safetensors").exists()


@pytest.mark.slow
@pytest.mark.parametrize("command", ["index scan wave@1-2 -m m.safetensors", "sync wave@1-2 squat", "convert wave@1-2 -o a.trc"])
def test_seconds_of_recordings(run, command):
    code, _, err = run(command)
    assert code == 2 and "wave@1-2: seconds (@1-2) are for examples, and recordings are read as a whole; give wave" in err


def test_one_tracked_point_is_no_person(run):
    times = np.arange(90)
    rows = "\n".join(f"{i},{300 + 90 * np.sin(i / 9):.2f},{200 + 60 * np.cos(i / 5):.2f}" for i in times)
    Path("ball.csv").write_text(f"frame,x,y\n{rows}\n")
    clip = Clip.load("ball.csv", fps=30)
    assert clip.joints.shape == (90, 1, 2) and clip.skeleton.joints == ("point",) and np.array_equal(clip.times, times / 30)
    code, _, err = run("index fit ball=ball.csv wave=wave -o m.safetensors")
    assert code == 2 and "ball.csv: one tracked point, but an action is of joints that move against each other" in err
    with pytest.raises(ValueError, match=r"clip 0 .*: joints: one tracked point"):
        ActionIndexer().fit([clip.joints + 0, clip.joints[::-1]], ["a", "b"])


def test_notes_of_readers(clips):
    wave = clips["wave"].replace(up="-y", meta={"layout": "guessed: BODY_25, not BODY_25B", "may_lag": True}, name="a")
    other = wave.replace(meta={"layout": "recognized: BODY_25B"}, name="b")
    said = clip_notes([wave, wave.replace(name="c"), other], Reading())
    assert said == [
        "a, c: its joints are taken for BODY_25 by their number, though as many joints may be BODY_25B; --layout says otherwise",
        "b: its joints are taken for BODY_25B, which is how the body looks; --layout says otherwise",
        "a, c: may be smoothed by MediaPipe, whose tracking lags by up to 2.4 frames where movement is quick; 'dyntorch pose' does "
        "not",
    ]
    assert clip_notes([clips["wave"]], Reading()) == []
    notices = [one.text for one in synchronize(wave, clips["wave"]).notices]
    assert any("taken for BODY_25 by their number" in text and "layout= says" in text for text in notices)
    assert any("may be smoothed by MediaPipe" in text for text in notices)


@pytest.mark.slow
def test_recordings(run, clips):
    wave = clips["wave"]
    openpose(Path("two"), [wave, clips["kick"].replace(joints=clips["kick"].joints + np.array([900.0, 0.0]))])
    openpose(Path("small"), [wave], scale=1 / 2000)
    openpose(Path("gap"), [cut(wave, 0, 40)])
    openpose(Path("gap"), [cut(wave, 40)], start=2_600_000_040)
    Path("truth.csv").write_text("label,start,end\nwave,0,1\nkick,50,60\n")
    scan = "index scan {} -m m.safetensors --fps 30"
    code, out, _ = run(scan.format("wave --truth truth.csv"))
    assert code == 0 and out.count("note:") == 1
    assert f"wave runs from 0 to {wave.times[-1]:.6g} s: 1 known event outside of it cannot be found (kick at 50" in out
    two = run(scan.format("two"))[1]
    assert "two: 2 people in view, told apart by position, as the file has no ids to rely on; each is scanned by itself" in two
    one = run(scan.format("two --person largest"))[1]
    assert "two: 2 people in view; followed is the largest; --person says otherwise" in one
    assert "small: coordinates from 0 to 1, so the shape of the image is not known" in run(scan.format("small"))[1]
    assert "coordinates" not in run(scan.format("small --size 2000 2000"))[1]
    code, out, _ = run(scan.format("gap"))
    assert code == 0 and "gap: no frames for a while after 1.3 s; its 2 parts are searched by themselves" in out
    assert "--fps 1000: the longest clip lasts" in run("index scan wave -m m.safetensors --fps 1000")[1]
    for fps in ("1e-300", "1e300"):
        code, _, err = run(f"index scan wave -m m.safetensors --fps {fps}")
        assert code == 2 and "fps must be frames per second, from 0.001 to 1,000,000" in err
    openpose(Path("far"), [cut(wave, 0, -1)])
    openpose(Path("far"), [cut(wave, -1)], start=9_000_000_000_000_000)
    code, _, err = run(scan.format("far"))
    assert code == 2 and "clip 'far': times reach 3e+14 s, where numbers are" in err and err.count("\n") == 1


@pytest.mark.slow
def test_joints_by_name_and_a_recording_by_its_file(run, clips):
    ClipSet([clip.replace(name=name) for name, clip in clips.items()]).save("all.npz")
    assert run("index fit all.npz -o m.safetensors")[0] == 0
    wave = clips["wave"].replace(label=None, meta={}, name="stream", confidence=None)
    ClipSet([wave]).save("plain.npz")
    mixed = Skeleton("mine", tuple(COCO17.joints[i] for i in ORDER))
    ClipSet([wave.replace(joints=wave.joints[:, ORDER], skeleton=mixed)]).save("mixed.npz")
    ClipSet([wave.replace(skeleton=None)]).save("bare.npz")
    code, plain, _ = run("index scan plain.npz -m m.safetensors --report out")
    assert code == 0 and "plain.npz" in Path("out/events.csv").read_text() and "stream" not in Path("out/events.csv").read_text()
    code, again, _ = run("index scan mixed.npz -m m.safetensors")
    rows = [text.split(" in 1 recording")[0] for text in (plain, again)]
    assert code == 0 and rows[0] == rows[1]
    code, out, _ = run("index scan wave -m m.safetensors --fps 30")
    assert code == 0 and "wave: of its 25 joints (BODY_25) the 17 learned (COCO-17) are used" in out


@pytest.mark.slow
def test_everybody_in_view_is_scanned(run, clips):
    left = np.concatenate([clips["wave"].joints, clips["wave"].joints[::-1]])
    right, ghost = np.full((2, *left.shape), np.nan)
    there = np.r_[0:60, 100 : 2 * len(clips["squat"]) + 40]
    right[there] = np.concatenate([clips["squat"].joints] * 2) + np.array([700.0, 0.0])
    ghost[20] = left[0] + 3000
    write_coco(Path("both.json"), Clip(left), Clip(right), Clip(ghost), ids=True)
    code, out, _ = run("index scan both.json -m m.safetensors --fps 30 --report out")
    assert code == 0
    assert "both.json: 2 people in view, told apart by the file's ids; each is scanned by itself" in out
    assert "both.json: 1 track left out, as of no person (1 too short)" in out
    assert "both.json: person 2 is out of view from 2.0 to 3.3 s; that it is the same person says the file's id" in out
    with open("out/events.csv", newline="") as file:
        found = list(csv.DictReader(file))
    assert {row["person"] for row in found} == {"1", "2"} and {row["file"] for row in found} == {"both.json"}
    with open("out/repetitions.csv", newline="") as file:
        counted = list(csv.DictReader(file))
    assert list(counted[0]) == ["file", "person", "label", "unit", "number", "start", "end", "seconds", "pause_before", "range"]
    assert {(row["person"], row["label"]) for row in counted} == {(row["person"], row["label"]) for row in found}
    page = Path("out/report.html").read_text()
    assert "Actions in both.json" in page and "<h3>Person 1</h3>" in page and "<h3>Person 2</h3>" in page
    assert page.count('class="player"') == 1 and "timeline-2.png" in {path.name for path in Path("out").iterdir()}


@pytest.mark.slow
def test_whose_the_known_events_are(run, clips):
    write_coco(Path("both.json"), Clip(clips["wave"].joints[:69]), Clip(clips["squat"].joints * 0.5 + 900.0), ids=True)
    scan = "index scan both.json -m m.safetensors --fps 30 --truth "
    Path("plain.csv").write_text("label,start,end\nwave,0,2\n")
    code, out, _ = run(scan + "plain.csv")
    assert code == 0 and "plain.csv: does not say whose some labels of both.json are; they count for person 1, the largest" in out
    assert "1 of 1 known action found" in out
    Path("whose.csv").write_text("label,start,end,person\nwave,0,2,1\nsquat,0,2,2\n")
    code, out, _ = run(scan + "whose.csv")
    assert code == 0 and "2 of 2 known actions found" in out
    Path("odd.csv").write_text("label,start,end,person\nwave,0,2,Anna\n")
    code, _, err = run(scan + "odd.csv")
    assert code == 2 and "odd.csv: subject 'Anna' is none of the people of both.json (1, 2)" in err


@pytest.mark.slow
def test_what_is_held_back_is_said_with_its_reason(run):
    code, out, _ = run("index scan wave -m m.safetensors --fps 30 --reject 100 --report out")
    assert code == 0 and "no action found" in out and re.search(r"held back, below the level: 1 wave \(\d\.\d\d s\)", out)
    page = Path("out/report.html").read_text()
    assert "Held back" in page and "below the level" in page and json.loads(Path("out/metrics.json").read_text())["withheld"]


@pytest.mark.slow
def test_how_strictly_rest_is_judged(run, monkeypatch):
    original, asked = ActionIndexer.decode, []

    def decode(self, clip, progress=None):
        asked.append(self.options.rest_weight)
        told = original(self, clip, progress)
        held = [Withheld(event, "at rest") for event in told.events]
        return dataclasses.replace(told, events=[], withheld=held)

    monkeypatch.setattr(ActionIndexer, "decode", decode)
    for rest in ("strict", "usual", "off"):
        out = run(f"index scan wave -m m.safetensors --fps 30 --rest {rest}")[1]
        assert re.search(r"held back, at rest: \d+ wave", out) and "no action found" in out
    usual = ActionOptions().rest_weight
    assert asked == [2 * usual, usual, 0.0]
    code, _, err = run("index scan wave -m m.safetensors --rest often")
    assert code == 2 and "--rest often: " in err and "off, strict, usual" in err


@pytest.mark.slow
def test_nobody_in_view_is_an_answer(run, tmp_path):
    openpose(Path("empty"), [Clip(np.full((40, 17, 2), np.nan))])
    code, out, err = run("index scan empty -m m.safetensors --fps 30 --report out")
    assert code == 0 and err == "" and "empty: nobody is in view in any of its 40 frames" in out
    assert "no action found in 1 recording (1.3 s long)" in out
    assert (tmp_path / "out" / "events.csv").read_text().count("\n") == 1 and (tmp_path / "out" / "report.html").exists()
    ClipSet([Clip(np.full((20, 17, 2), np.nan), name=name, skeleton=COCO17) for name in "ab"]).save("set.npz")
    code, out, _ = run("index scan set.npz -m m.safetensors")
    assert code == 0 and "set.npz: nobody is in view in any frame of" in out and "no action found in 2 recordings" in out
