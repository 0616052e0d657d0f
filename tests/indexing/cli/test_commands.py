"""The command line: every command on small synthetic data, and every bad input as one line and exit code 2."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
import warnings
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from indexing.action.indexer import ActionIndexer
from indexing.actors import Person, dataset, detect, perform, stream
from indexing.cli import main
from indexing.cli.commands.scan import exemplars, within_label
from indexing.cli.flags.shared import Example, Format, People
from indexing.cli.inputs import parse_example
from indexing.cli.protocol import Cameras, choose, draw_shots, splits
from indexing.clip import Clip, ClipSet
from indexing.readers import FORMATS
from indexing.readers.files import PEOPLE
from tests.indexing.cli.footage import write_coco

ACTIONS = ("squat", "wave", "kick")


@pytest.fixture(scope="session")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``squat.json``..., a session with its truth, clip sets in 2D and 3D, and a model."""
    folder = tmp_path_factory.mktemp("cli")
    person = Person.random(1)
    for i, action in enumerate(ACTIONS):
        write_coco(folder / f"{action}.json", detect(perform(action, person, rng=i), azimuth=0, rng=i))
    solid, truth = stream(["kick", "wave", "squat"], Person.random(5), rng=3)
    write_coco(folder / "session.json", detect(solid, azimuth=45, rng=3))
    lines = [f"{label},{start:.2f},{end:.2f}" for label, start, end in truth]
    (folder / "truth.csv").write_text("\n".join(["label,start,end", *lines]) + "\n")
    dataset(3, ACTIONS, azimuth=(0.0, 90.0), rng=2).save(folder / "set.npz")
    dataset(3, ACTIONS, azimuth=None, rng=2).save(folder / "solid.npz")
    other = detect(perform("wave", person, rng=9), azimuth=0, rng=9)
    write_coco(folder / "other.json", Clip(other.joints[:, :15], confidence=other.confidence[:, :15]))
    words = [f"{action}={folder / action}.json" for action in ACTIONS]
    assert main(["index", "fit", *words, "-o", str(folder / "moves.safetensors")]) == 0
    return folder


# ---- the program ---------------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_help_starts_without_the_heavy_libraries_in_half_a_second() -> None:
    code = """
import sys, time
from indexing.cli import main
main(["index", "--help"])
assert time.process_time() < 0.5
from indexing.cli.flags import commands
lines = ["", "--help", "index", "archive", "--version", *(f"{command.words} --help" for command in commands())]
codes = {main(line.split()) for line in lines}
heavy = {"torch", "numpy", "sklearn", "matplotlib", "scipy", "PIL", "dask"} & set(sys.modules)
print("RESULT", codes, heavy, main(["count", "join"]), {"torch", "sklearn"} & set(sys.modules))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "RESULT {0} set() 0 set()" and done.stderr == ""
    words = "evaluate", "dyntorch 0.", "--no-spatial", "tcp://head:8786", "affine_constant_velocity", "velocity_planes_3d"
    assert [word for word in words if word not in done.stdout] == []


def test_a_broken_pipe_is_quiet() -> None:
    with subprocess.Popen(
        [sys.executable, "-m", "indexing.cli", "--help"], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as child:
        child.stdout.close()  # nobody reads
        err = child.stderr.read()
        assert child.wait() == 141
    assert err == b""


def test_interrupted_leaves_nothing(run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(ActionIndexer, "fit", stop)
    code, out, err = run("index", "fit", "@/set.npz", "-o", "deep/m.safetensors")
    assert code == 130 and out == "" and err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_choices_are_those_of_the_readers() -> None:
    assert get_args(Format) == FORMATS
    assert get_args(People) == PEOPLE


# ---- fit -----------------------------------------------------------------------------------------------------------------
def test_fit_says_what_it_learned_of_examples_and_of_a_selection(run, data: Path) -> None:
    code, out, err = run(
        "index", "fit", "squat=@/squat.json", "squat=@/wave.json@0.5-1.5", "[red] kick=@/kick.json", "-o", "new/m.safetensors",
        "--no-mirror", "--reject", "0.1", "--seed", "3",
    )  # fmt: skip
    assert code == 0 and err == ""
    assert "[red] kick" in out and "17 in 2D" in out and "m.safetensors" in out
    assert "30 frames per second assumed for squat.json" in out
    model = ActionIndexer.load("new/m.safetensors")
    assert model.classes_.tolist() == ["[red] kick", "squat"] and model.model_.labels.tolist() == [1, 1, 0]
    assert (model.mirror, model.reject, model.random_state) == (False, 0.1, 3)
    code, out, _ = run("index", "fit", "@/set.npz", "--select", "azimuth=0", "--select", "subject=0,1", "-o", "m.safetensors")
    assert code == 0 and "assumed" not in out
    assert len(ActionIndexer.load("m.safetensors").model_.labels) == 2 * len(ACTIONS)


def test_examples_are_read_from_words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert parse_example("a b=c=d.json") == Example(Path("c=d.json"), "a b")
    assert parse_example("a=x.json@1.5-") == Example(Path("x.json"), "a", 1.5, None)
    assert parse_example("a=x.json@-2") == Example(Path("x.json"), "a", None, 2.0)
    assert parse_example("a=x@home.json") == Example(Path("x@home.json"), "a")
    for name in ("take@1-2", "lr=3.npz"):  # files that only look like more
        Path(name).touch()
    assert parse_example("a=take@1-2") == Example(Path("take@1-2"), "a")
    assert parse_example("lr=3.npz") == Example(Path("lr=3.npz"))


@pytest.mark.slow
def test_fit_refuses_bad_input(refuse, data: Path, tmp_path: Path) -> None:
    (tmp_path / "empty.json").touch()
    (tmp_path / "clip.mp4").write_bytes(b"x" * 99)
    (tmp_path / "cut.npz").write_bytes((data / "set.npz").read_bytes()[:2000])
    (tmp_path / "file").touch()
    frame = [{"image_id": 0, "category_id": 1, "keypoints": [1.0, 2.0, 0.9] * 17, "score": 1.0}]
    (tmp_path / "one.json").write_text(json.dumps(frame))
    to, ok = ("-o", "m.safetensors"), "b=@/squat.json"
    fit = ("index", "fit")
    refuse(*fit, "a=nope.json", ok, *to, says=("nope.json", "no such file"))
    refuse(*fit, "a=clip.mp4", ok, *to, says=("clip.mp4", "video", "keypoint"))
    refuse(*fit, "a=empty.json", ok, *to, says=("empty.json", "empty"))
    refuse(*fit, "a=one.json", ok, *to, says=("one.json", "one frame", "leave it out"))
    refuse(*fit, "cut.npz", *to, says=("cut.npz", "truncated"))
    refuse(*fit, ok, *to, "--background", "nope.json", says=("nope.json", "no such file"))
    refuse(*fit, ok, *to, "--background", "@/other.json", says=("background: clip 0", "15", "17"))
    refuse(*fit, "a=@/other.json", ok, *to, says=("other.json", "15", "squat.json", "17"))
    refuse(*fit, "@/squat.json", *to, says=("squat.json", "squat="))
    refuse(*fit, "a=", ok, *to, says=("'a='", "label=file"))
    refuse(*fit, "a=@/wave.json@2-1", ok, *to, says=("wave.json@2-1", "start"))
    refuse(*fit, "a=@/wave.json@50-60", ok, *to, says=("wave.json", "no frame between"))
    refuse(*fit, "@/set.npz", "--select", "vew=1", *to, says=("'vew'", "azimuth (0.0, 90.0)", "subject (0, 1, 2)"))
    refuse(*fit, "@/set.npz", "--select", "azimuth=30", *to, says=("azimuth=30", "0.0, 90.0"))
    refuse(*fit, *to, says=("no examples",))
    refuse(*fit, "a=@/wave.json", ok, "-o", "file/m.safetensors", says=("'file' is a file", "another folder"))
    refuse(*fit, "a=@/wave.json", ok, "-o", ".", says=("is a folder",))
    refuse(*fit, "a=@/wave.json", ok, "-o", "@/wave.json", says=("wave.json", "input"))
    assert json.loads((data / "wave.json").read_text())


# ---- scan ----------------------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_scan_prints_hits_and_writes_the_report(run, tmp_path: Path) -> None:
    code, out, err = run(
        "index", "scan", "@/session.json", "-m", "@/moves.safetensors", "--report", "a/out", "--truth", "@/truth.csv"
    )
    assert code == 0 and err == ""
    assert "action" in out and "margin" in out and "30 frames per second assumed for session.json" in out
    folder = tmp_path / "a" / "out"
    names = {path.name for path in folder.iterdir()}
    assert names == {"report.html", "events.csv", "repetitions.csv", "timeline.png", "metrics.json", "manifest.json"}
    rows = list(csv.DictReader((folder / "events.csv").open()))
    assert rows and {row["label"] for row in rows} <= set(ACTIONS)
    measured = json.loads((folder / "metrics.json").read_text())
    assert f"{3 - measured['missed_events']} of 3 known actions found" in out
    assert f"(precision {measured['precision']:.3f}, recall {measured['recall']:.3f})" in out
    counted = list(csv.DictReader((folder / "repetitions.csv").open()))
    assert {row["label"] for row in counted} == {row["label"] for row in rows} and "pause (s)" in out
    assert sum(measured["repetitions"].values()) == len(counted) and {row["person"] for row in rows} == {""}
    assert measured["known_events"] == 3 and 0.5 < measured["frame_accuracy"] <= 1
    assert "assumed" in measured["notes"][0]
    made = json.loads((folder / "manifest.json").read_text())
    assert made["arguments"]["command"] == "index scan" and made["seed"] == 0 and made["timings"]["scan"] > 0
    assert {Path(name).name for name in made["inputs"]} == {"session.json", "moves.safetensors", "truth.csv"}


@pytest.mark.slow
def test_scan_of_several_recordings_tells_them_apart(run, data: Path, tmp_path: Path) -> None:
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "session.json").write_bytes((data / "session.json").read_bytes())
    code, out, _ = run("index", "scan", "@/session.json", "b/session.json", "-m", "@/moves.safetensors", "--fps", "30")
    assert code == 0 and "2 recordings" in out and "b/session.json" in out and "assumed" not in out
    assert sorted(path.name for path in tmp_path.iterdir()) == ["b"]


@pytest.mark.slow
def test_scan_refuses_bad_input(refuse, run, data: Path, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "bad.csv").write_text("label,start,end\nsquat,2,1\n")
    (tmp_path / "odd.csv").write_text("label,start,end\nsquat,soon,1\n")
    (tmp_path / "no.csv").write_text("squat,1,2\n")
    (tmp_path / "elsewhere.csv").write_text("file,label,start,end\nx.json,squat,1,2\n")
    model = ("-m", "@/moves.safetensors")
    scan = ("index", "scan")
    refuse(*scan, *model, says=("no recordings",))
    refuse(*scan, "nope.json", *model, says=("nope.json", "no such file"))
    refuse(*scan, "@/other.json", *model, says=("other.json", "15 joints", "moves.safetensors", "17"))
    refuse(*scan, "@/moves.safetensors", *model, says=("is a model file",))
    refuse(*scan, "@/session.json", "-m", "@/wave.json", says=("wave.json", "not a model file"))
    refuse(*scan, "@/session.json", "-m", "nope.safetensors", says=("nope.safetensors", "index fit"))
    refuse(*scan, "@/session.json", *model, "--report", "file", says=("'file' is a file", "another folder"))
    refuse(*scan, "@/session.json", *model, "--report", "file/deep", says=("is a file",))
    refuse(*scan, "@/session.json", *model, "--truth", "nope.csv", says=("nope.csv", "no such file"))
    refuse(*scan, "@/session.json", *model, "--truth", "bad.csv", says=("bad.csv", "line 2", "start first"))
    refuse(*scan, "@/session.json", *model, "--truth", "odd.csv", says=("line 2", "'start'", "'soon'"))
    refuse(*scan, "@/session.json", *model, "--truth", "no.csv", says=("no.csv", "'label'"))
    refuse(*scan, "@/session.json", *model, "--truth", "elsewhere.csv", says=("x.json", "session.json", "--media NAME"))
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "events.csv").write_text("label,start,end\nsquat,1,2\n")
    refuse(*scan, "@/session.json", *model, "--truth", "out/events.csv", "--report", "out", says=("events.csv", "input"))


def test_hits_name_the_exemplar_within_its_label(data: Path) -> None:
    clips = ClipSet.load(data / "set.npz")
    indexer = ActionIndexer(scorer="nearest").fit(clips, clips.labels)
    shown = exemplars(indexer)
    for number, label in enumerate(clips.labels):
        clip = shown[label][within_label(indexer, number)]
        assert np.array_equal(clip.joints, indexer.exemplar(number).joints, equal_nan=True)
    assert within_label(indexer, None) is None


# ---- evaluate ------------------------------------------------------------------------------------------------------------
def test_evaluate_writes_accuracy(run, tmp_path: Path) -> None:
    code, out, err = run("index", "evaluate", "@/set.npz", "--train", "azimuth=0", "--test", "azimuth=90", "--report", "out")
    assert code == 0 and err == "" and "accuracy" in out and "squat" in out
    assert {path.name for path in Path("out").iterdir()} == {"report.html", "confusion.png", "metrics.json", "manifest.json"}
    measured = json.loads(Path("out/metrics.json").read_text())
    assert measured["clips"] == 9 and measured["accuracy"] > 0.8 and set(measured["per_class"]) == set(ACTIONS)
    assert f"accuracy {measured['accuracy']:.3f}" in out


@pytest.mark.slow
def test_evaluate_through_virtual_cameras_leaving_groups_out(run) -> None:
    code, out, _ = run(
        "index", "evaluate", "@/solid.npz", "--leave-out", "subject", "--camera", "virtual", "--azimuth", "0,90",
        "--shots", "1", "--report", "out",
    )  # fmt: skip
    measured = json.loads(Path("out/metrics.json").read_text())
    assert code == 0 and measured["clips"] == 18 and np.sum(measured["confusion"]["counts"]) == 18
    assert set(measured["accuracy_by_setting"]) == {"azimuth 0", "azimuth 90"}
    assert set(measured["accuracy_by_group"]) == {"subject 0", "subject 1", "subject 2"}
    assert measured["accuracy"] > 0.8 and "subject 2" in out
    again = run("index", "evaluate", "@/solid.npz", "--leave-out", "subject", "--camera", "virtual", "--exemplars", "3d")
    assert again[0] == 0 and "accuracy 1.000" in again[1]


def test_evaluate_in_camera_coordinates(run, data: Path, tmp_path: Path) -> None:
    clips = ClipSet.load(data / "solid.npz")
    ClipSet(clip.replace(joints=clip.joints + np.array([0.0, 0.0, 4.5])) for clip in clips).save(tmp_path / "camera.npz")
    code, out, _ = run("index", "evaluate", "camera.npz", "--camera", "perspective", "--test", "subject=2")
    assert code == 0 and "(3 clips" in out  # learned from all others


@pytest.mark.slow
def test_evaluate_says_what_makes_the_numbers_wrong(run, data: Path, tmp_path: Path) -> None:
    clips = [
        clip.replace(label="bow") if clip.meta["subject"] == 2 and clip.label == "kick" else clip
        for clip in ClipSet.load(data / "set.npz")
    ]
    clips[0] = clips[0].replace(joints=np.zeros_like(clips[0].joints), confidence=None)
    ClipSet(clips).save(tmp_path / "odd.npz")
    code, out, _ = run(
        "index", "evaluate", "odd.npz", "--train", "subject=0,1", "--test", "subject=1,2", "--shots", "4", "--reject", "1e9"
    )
    assert code == 0
    assert "1 clip of odd.npz left out" in out and clips[0].name in out
    assert "warning: 6 clips in both --train and --test" in out
    assert "2 test clips of actions that were not learned (bow) count as wrong" in out
    assert "fewer than 4 examples of squat" in out
    assert "accuracy 0.000" in out and "(rejected)" in out


@pytest.mark.slow
def test_evaluate_refuses_bad_input(refuse, data: Path, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    evaluate = ("index", "evaluate")
    refuse(*evaluate, "nope.npz", "--leave-out", "subject", says=("nope.npz", "no such file"))
    refuse(*evaluate, "@/set.npz", says=("--train", "--leave-out", "subject (0, 1, 2)"))
    refuse(*evaluate, "@/set.npz", "--train", "subjct=1", says=("'subjct'", "subject (0, 1, 2)"))
    refuse(*evaluate, "@/set.npz", "--train", "subject=7", says=("subject=7", "0, 1, 2"))
    refuse(*evaluate, "@/set.npz", "--train", "subject", says=("field=value",))
    refuse(*evaluate, "@/set.npz", "--test", "subject=1", "--test", "names=squat-0-0-0", says=("--test",))
    refuse(*evaluate, "@/set.npz", "--train", "subject=0,1,2", says=("--test", "all 18 clips"))
    refuse(*evaluate, "@/set.npz", "--train", "action=kick", says=("only one action (kick)",))
    refuse(*evaluate, "@/set.npz", "--leave-out", "take", says=("take", "all clips"))
    refuse(*evaluate, "@/set.npz", "--leave-out", "subject", "--train", "take=0", says=("--leave-out", "leave --train"))
    refuse(*evaluate, "@/set.npz", "--leave-out", "subject", "--camera", "virtual", says=("3D", "2D", "--camera"))
    refuse(*evaluate, "@/solid.npz", "--leave-out", "subject", "--camera", "perspective", says=("camera coordinates",))
    refuse(*evaluate, "@/set.npz", "--leave-out", "subject", "--exemplars", "3d", says=("--exemplars",))
    refuse(*evaluate, "@/set.npz", "--leave-out", "subject", "--azimuth", "90", says=("--camera virtual",))
    refuse(*evaluate, "@/solid.npz", "--leave-out", "subject", "--camera", "virtual", "--azimuth", "x", says=("0,45,90",))
    refuse(*evaluate, "@/set.npz", "--leave-out", "subject", "--shots", "0", says=("--shots", "1 or more"))
    refuse(*evaluate, "@/set.npz", "--leave-out", "subject", "--report", "file", says=("'file' is a file",))
    refuse(*evaluate, "@/squat.json", "--leave-out", "subject", says=("squat.json", "action"))


def sample(count: int = 12, **fields: list[object]) -> ClipSet:
    meta = [{name: values[i % len(values)] for name, values in fields.items()} for i in range(count)]
    return ClipSet([Clip(np.ones((3, 2, 2)), label=f"move {i % 2}", meta=known) for i, known in enumerate(meta)], "some.npz")


def test_values_are_found_whatever_their_form_and_split() -> None:
    clips = sample(view=[1, 2, 3], turn=[0.0, 90.0], place=["a, b", "c"])
    assert choose(clips, ["view=1, 3"], "--train").tolist() == [0, 2, 3, 5, 6, 8, 9, 11]
    assert choose(clips, ["turn=90", "view=2"], "--train").tolist() == [1, 7]
    assert choose(clips, ["place=a, b"], "--train").tolist() == [0, 2, 4, 6, 8, 10]
    assert choose(clips, ["action=move 1"], "--train").tolist() == [1, 3, 5, 7, 9, 11]
    with pytest.raises(ValueError, match=r"no clip of some\.npz meets all"):
        choose(sample(view=[1, 2]), ["view=1", "action=move 1"], "--train")
    clips = sample(view=[1, 2, 3])
    (fold,), notes = splits(clips, ["view=1,2"], ["view=2,3"], None)
    assert np.intersect1d(fold.train, fold.test).tolist() == [1, 4, 7, 10] and "4 clips" in notes[0]
    folds, notes = splits(clips, [], [], "view")
    assert [(fold.name, len(fold.train), len(fold.test)) for fold in folds] == [(f"view {v}", 8, 4) for v in (1, 2, 3)]
    labels = clips.labels.astype(str)
    few, notes = draw_shots(folds[0], labels, 2, seed=0)
    assert sorted(labels[few.train].tolist()) == ["move 0"] * 2 + ["move 1"] * 2 and not notes
    assert few.test is folds[0].test
    assert not np.array_equal(few.train, draw_shots(folds[0], labels, 2, seed=1)[0].train)


def test_virtual_cameras_depend_on_the_seed_and_nothing_else(data: Path) -> None:
    clip = ClipSet.load(data / "solid.npz")[0]
    cameras = Cameras("virtual", (0.0, 90.0), False, 0)
    assert np.array_equal(cameras.query(clip, 3, 1).joints, cameras.query(clip, 3, 1).joints)
    assert not np.allclose(cameras.query(clip, 3, 1).joints, cameras.query(clip, 4, 1).joints)
    assert not np.allclose(cameras.query(clip, 3, 0).joints, cameras.exemplar(clip, 3).joints)
    assert Cameras("virtual", (0.0,), True, 0).exemplar(clip, 0) is clip


# ---- demo ----------------------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_demo_reports_recognition_from_other_viewpoints(run) -> None:
    code, out, err = run("demo", "--out", "shown", "--people", "2")
    assert code == 0 and err == ""
    assert "turned 90°" in out and "2D nearest neighbour" in out and "known actions found" in out
    names = {path.name for path in Path("shown").iterdir()}
    assert names == {"report.html", "events.csv", "timeline.png", "confusion.png", "metrics.json", "manifest.json"}
    measured = json.loads(Path("shown/metrics.json").read_text())
    assert measured["accuracy"] > 0.85 and len(measured["accuracy_by_setting"]) == 4
    assert measured["accuracy"] > measured["baseline"]["accuracy"] + 0.2
    assert 0 <= measured["frame_accuracy"] <= 1 and measured["known_events"] > 9
    page = Path("shown/report.html").read_text()
    assert "Frames right" in page and "2D nearest neighbour" in page
    made = json.loads(Path("shown/manifest.json").read_text())
    assert {"learn", "recognize", "search"} <= set(made["timings"])


def test_what_libraries_tell_programmers_is_not_shown(run, monkeypatch: pytest.MonkeyPatch) -> None:
    def warn(*_: object) -> str:
        warnings.warn("old", DeprecationWarning, stacklevel=1)
        warnings.warn("this matters", UserWarning, stacklevel=1)
        return "1"

    monkeypatch.setattr("indexing.cli._version", warn)
    code, _, err = run("--version")
    assert (code, err) == (0, "dyntorch: warning: this matters\n")
