"""The report room: files that are whole or absent, pictures that can be drawn, and numbers that are right."""

from __future__ import annotations

import hashlib
import io
import json
import re
import struct
import subprocess
import sys
import time
from pathlib import Path

import cv2
import matplotlib.image
import numpy as np
import pytest

from indexing.clip import Clip
from indexing.report import (
    EvaluationResult,
    RecognitionReport,
    RecordingResult,
    manifest,
    pictures,
    prepare,
    write_json,
    write_text,
)
from indexing.report.canvas import letters_without_font, shorten_all, strip
from indexing.report.results import measure, overlapping
from tests.indexing.report.people import STICK, Hit, person, recording


def size(png):
    assert png.startswith(b"\x89PNG")
    return struct.unpack(">II", png[16:24])


def test_prepare_makes_parents_and_names_what_is_in_the_way(tmp_path):
    assert prepare(tmp_path / "a" / "b").is_dir()
    assert prepare(tmp_path / "a" / "b") == tmp_path / "a" / "b"
    (tmp_path / "file").write_text("x")
    assert write_text(tmp_path / "ours", "").stat().st_mode == (tmp_path / "file").stat().st_mode  # colleagues can read it
    for folder in (tmp_path / "file", tmp_path / "file" / "deeper"):
        with pytest.raises(ValueError, match=r"file' is a file; choose another folder") as caught:
            prepare(folder)
        assert str(folder) in str(caught.value)
    assert (tmp_path / "file").read_text() == "x"


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs a folder that even root cannot write")
def test_prepare_refuses_a_folder_that_cannot_be_written():
    for folder in ("/proc/out", "/proc/self"):
        with pytest.raises(ValueError, match=r"cannot be written .* choose a folder you may write to"):
            prepare(folder)


def test_a_value_that_is_no_json_leaves_no_file(tmp_path):
    write_json(tmp_path / "ok.json", {"nan": np.nan, 2: np.array([1.5, np.inf]), "set": {"b", "a"}, "at": Path("x"), "no": None})
    expected = {"nan": None, "2": [1.5, None], "set": ["a", "b"], "at": "x", "no": None}
    assert json.loads((tmp_path / "ok.json").read_text()) == expected
    loop = []
    loop.append(loop)
    with pytest.raises(RecursionError):
        write_json(tmp_path / "loop.json", loop)
    assert not (tmp_path / "loop.json").exists()
    write_text(tmp_path / "name.txt", "caf\udce9")  # a file name in Latin-1, as Python reads it
    assert (tmp_path / "name.txt").read_bytes() == b"caf\\udce9"


def test_manifest_hashes_files_and_folders(tmp_path):
    folder = tmp_path / "in"
    (folder / "b").mkdir(parents=True)
    (folder / "b" / "x").write_bytes(b"x")
    (folder / "a").write_bytes(b"a")
    made = manifest({"fps": np.float32(30), "out": tmp_path}, [folder, folder / "a"], seed=3, timings={"scan": 0.5})
    digest = hashlib.sha256(b"a").hexdigest()
    assert made["inputs"] == {str(folder): {"a": digest, "b/x": hashlib.sha256(b"x").hexdigest()}, str(folder / "a"): digest}
    assert made["versions"]["numpy"] == np.__version__ and made["versions"]["torch"] and made["time"].endswith("+00:00")
    assert made["arguments"] == {"fps": 30.0, "out": str(tmp_path)} and made["seed"] == 3 and made["timings"] == {"scan": 0.5}
    json.dumps(made, allow_nan=False)
    with pytest.raises(ValueError, match="missing"):
        manifest({}, [tmp_path / "missing"])


@pytest.mark.slow
def test_importing_reports_is_light_and_pictures_need_no_pyplot():
    code = (
        "import sys, indexing.report as r; r.manifest({}); print({'torch', 'sklearn', 'matplotlib'} & set(sys.modules)); "
        "from indexing.report import pictures; pictures.confusion([[1]], ['a']); print('matplotlib.pyplot' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=Path(__file__).parents[3], check=True)
    assert done.stdout.split() == ["set()", "False"]


@pytest.mark.slow
@pytest.mark.parametrize("number", [1, 2, 60])
def test_confusion_draws_any_number_of_classes(number):
    counts = np.eye(number, dtype=int) * 1234
    counts[0, -1] = 7
    names = [f"a very long name of an action, number {i}" for i in range(number - 1)] + ["$\\frac"]
    width, height = size(pictures.confusion(counts, names))
    assert 300 < width < 3200 and 300 < height < 3200
    with pytest.raises(ValueError, match="counts must be"):
        pictures.confusion(counts, [*names, "more"])


def test_downsampling_keeps_short_peaks_and_real_gaps():
    times = np.concatenate([np.arange(0, 1000), np.arange(1500, 2000)]) / 10.0
    scores = np.zeros((len(times), 2))
    scores[333, 0] = 9.0
    scores[5] = [np.nan, -np.inf]
    drawn = pictures.downsample(times, scores, np.linspace(0, 200, 101))
    assert drawn.shape == (100, 2) and np.nanargmax(drawn[:, 0]) == 16 and np.nanmax(drawn) == 9.0
    assert np.isnan(drawn[51:75]).all() and not np.isnan(drawn[:50]).any() and not np.isnan(drawn[75:]).any()
    slow = pictures.downsample(np.arange(5.0), np.arange(5.0)[:, None], np.linspace(0, 4, 41))
    assert slow[:39, 0].tolist() == [0.0] * 10 + [1.0] * 10 + [2.0] * 10 + [3.0] * 9 and slow[39, 0] == 4.0


def test_an_hour_is_drawn_in_time():
    rng = np.random.default_rng(0)
    times, scores = np.arange(108_000) / 30, rng.normal(size=(108_000, 12))
    events = [Hit(f"action {i % 12}", 18.0 * i, 18.0 * i + 2) for i in range(200)]
    pictures.timeline([0.0, 1.0], np.zeros((2, 1)), ["warm up: imports and fonts"])
    begin = time.process_time()
    png = pictures.timeline(times, scores, [f"action {i}" for i in range(12)], events, [("other", 5, 9)])
    assert time.process_time() - begin < 3.0 and len(png) < 1_000_000


@pytest.mark.slow
def test_events_and_truth_change_what_is_drawn_and_bars_say_what_they_are(tmp_path):
    times, scores = np.arange(100) / 10, np.zeros((100, 2))
    event = Hit("a", 2, 4)
    variants = [((), None), ((event,), None), ((event,), [("a", 2.0, 4.0)]), ((Hit("b", 2, 4),), None)]
    drawn = [pictures.timeline(times, scores, ["a", "b"], events, truth) for events, truth in variants]
    assert len(set(drawn)) == 4
    assert size(drawn[2])[1] > size(drawn[1])[1]  # the row of known actions
    (tmp_path / "t.png").write_bytes(drawn[1])
    image = matplotlib.image.imread(tmp_path / "t.png")[..., :3]
    colour = np.array([int(pictures.PALETTE[0][i : i + 2], 16) for i in (1, 3, 5)]) / 255
    bar = (np.abs(image - colour).max(axis=2) < 0.02).any(axis=0)
    assert 0.1 < bar.mean() < 0.4  # two of ten seconds, and the chip beside the name
    times, events, truth = np.arange(100) / 10, [Hit("stand_up", 2, 2.1), Hit("squat", 4, 6)], [("squat", 4.5, 6.0)]
    tips = pictures.timeline_tips(times, ["squat", "stand_up"], events, truth)
    said = ["found: stand_up, 2.00 to 2.10 s", "found: squat, 4.00 to 6.00 s", "known: squat, 4.50 to 6.00 s"]
    assert [tip.text for tip in tips] == said
    assert all(0 < tip.left < tip.left + tip.width < 1 and 0 < tip.top < tip.top + tip.height < 1 for tip in tips)
    assert tips[2].top > tips[1].top + tips[1].height
    image = matplotlib.image.imread(io.BytesIO(pictures.timeline(times, np.zeros((100, 2)), ["squat", "stand_up"], events, truth)))
    found = tips[1]
    x, y = found.left + 0.1 * found.width, found.top + 0.15 * found.height  # inside the bar, beside its name
    pixel = image[int(y * image.shape[0]), int(x * image.shape[1]), :3]
    assert np.abs(pixel - [int(pictures.PALETTE[0][i : i + 2], 16) / 255 for i in (1, 3, 5)]).max() < 0.02


@pytest.mark.slow
def test_odd_timelines_are_drawn():
    size(pictures.timeline([0.0], np.full((1, 1), np.nan), ["深蹲 🏋"], [Hit("$\\frac{", 0, 0)], []))
    size(pictures.timeline([0.0, 1.0], np.zeros((2, 0)), []))
    size(pictures.timeline(np.arange(9.0), np.full((9, 40), np.inf), [f"movement {i} of many, left" for i in range(40)]))
    size(pictures.timeline(np.arange(9.0), np.zeros((9, 1)), ["a"], [Hit("a", 0, i) for i in range(1, 9)]))  # overlapping
    with pytest.raises(ValueError, match="scores must be"):
        pictures.timeline([0.0, 1.0], np.zeros((3, 1)), ["a"])


def test_shortened_names_stay_different():
    names = [f"movement number {i} with a long tail, variant {'AB'[i % 2]}" for i in range(40)]
    for limit in (12, 22):
        short = shorten_all(names, limit)
        assert len(set(short)) == 40 and max(map(len, short)) <= limit
    assert shorten_all(["深蹲深蹲深蹲深蹲深蹲深蹲深蹲"], 10) == ["深蹲…深蹲"]  # as wide as its letters
    assert letters_without_font(["\U00013000 squat приседание"]) == "\U00013000"  # a hieroglyph, which none of the fonts has
    assert shorten_all(["x" * 50 + "0" + "y" * 50, "x" * 50 + "1" + "y" * 50], 9) == ["1 xxx…yyy", "2 xxx…yyy"]


def bones(svg):
    """(bones, ends, xy) drawn in the middle, on the right and on the left."""
    paths = "".join(re.findall(r'<path class="[mrl]" d="([^"]*)"', svg))
    return np.array([[float(v) for v in point.split()] for point in re.findall(r"[ML]([-\d.]+ [-\d.]+)", paths)]).reshape(-1, 2, 2)


def test_strips_stand_upright_in_either_image_direction():
    assert strip(person(up="y")) == strip(person(up="-y"))
    drawn = bones(strip(person(), frames=1))
    assert len(drawn) == 5 and drawn[0, 0, 1] < drawn[0, 1, 1]  # the nose is drawn above the hip
    assert np.ptp(drawn[..., 0]) / np.ptp(drawn[..., 1]) == pytest.approx(1.2 / 1.7, rel=0.02)  # equal aspect
    assert len(bones(strip(person(), 0.5, 1.0, frames=4))) == 20


def test_joints_that_were_not_seen_or_are_in_the_wrong_place_are_left_out():
    clip = person()
    joints = clip.joints.copy()
    joints[:, 1] = np.nan
    assert len(bones(strip(clip.replace(joints=joints)))) == 20
    joints[:] = np.nan
    assert strip(clip.replace(joints=joints)) == ""
    joints = clip.joints.copy()
    joints[0, 1] = 1e6  # a stray joint must not shrink the person to a dot
    drawn = bones(strip(clip.replace(joints=joints)))
    assert len(drawn) == 24 and np.ptp(drawn[..., 1]) > 40
    assert 'class="d"' in strip(Clip(np.random.default_rng(0).random((9, 7, 3))))  # no bones known: dots
    assert strip(Clip(np.zeros((1, 6, 2)), skeleton=STICK), alt='"<x>').count("&#34;&lt;x&gt;") == 1
    clip = person()
    joints = clip.joints.copy()
    joints[30, 1] += [0.9, -0.8]  # a hand across the body in one frame: not far enough to be stray
    spoiled = clip.replace(joints=joints)
    at = (float(clip.times[30]), float(clip.times[30]))
    assert len(bones(strip(clip, *at, frames=1))) == 5 and len(bones(strip(spoiled, *at, frames=1))) == 4


def test_measures_against_numbers_counted_by_hand():
    first = EvaluationResult(["a", "b"], ["a", "a", "b", "b"], ["a", "b", "b", "b"], "azimuth 0")
    second = EvaluationResult(["a", "b"], np.array(["a", "b"]), np.array(["none", "b"]), "azimuth 90")
    out = measure(RecognitionReport("t", evaluations=[first, second], metrics={"seconds_per_clip": 0.1}))
    assert out["accuracy"] == pytest.approx(4 / 6) and out["clips"] == 6 and out["seconds_per_clip"] == 0.1
    assert out["accuracy_by_setting"] == {"azimuth 0": 0.75, "azimuth 90": 0.5}
    assert out["confusion"] == {"labels": ["a", "b", "none"], "counts": [[1, 1, 1], [0, 3, 0], [0, 0, 0]]}
    assert out["per_class"]["a"] == pytest.approx({"precision": 1.0, "recall": 1 / 3, "f1": 0.5, "clips": 3})
    assert out["per_class"]["b"] == pytest.approx({"precision": 0.75, "recall": 1.0, "f1": 6 / 7, "clips": 3})
    assert np.isnan(out["per_class"]["none"]["recall"]) and out["macro_f1"] == pytest.approx((0.5 + 6 / 7) / 2)
    truth = [("a", 0.0, 2.0), ("b", 1.0, 5.0)]
    spans = ((0, 1.5), (1, 4), (6, 7), (5, 6), (0.5, 2))
    assert [overlapping(Hit("a", *span), truth) for span in spans] == ["a", "b", None, None, "a"]
    out = measure(RecognitionReport("t", recordings=[recording([Hit("a", 1, 4), Hit("a", 8, 9)], truth), recording([])]))
    assert (out["known_events"], out["missed_events"], out["events"], out["recordings"]) == (2, 1, 2, 2)
    events = [Hit("a", 0, 1), Hit("a", 3, 4), Hit("b", 6, 7)]
    out = measure(RecognitionReport("t", recordings=[recording(events, [("a", 0.5, 2.0), ("b", 3.0, 4.0)])]))
    assert out["false_events"] == 2 and out["missed_events"] == 1
    assert "false_events" not in measure(RecognitionReport("t", recordings=[recording(events)]))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: EvaluationResult(["a"], ["a"], [], "x"), "one label per clip"),
        (lambda: EvaluationResult(["a"], [], [], "x"), "at least one"),
        (lambda: RecordingResult("r", None, np.arange(3.0), ["a"], np.zeros((2, 1))), "scores must be"),
        (lambda: RecordingResult("r", None, np.array([1.0, 0.0]), ["a"], np.zeros((2, 1))), "increasing"),
        (lambda: recording([Hit("a", 3, 2)]), "no interval"),
        (lambda: recording([], [("a", 0, np.nan)]), "no interval"),
    ],
)
def test_misuse_is_named(make, words):
    with pytest.raises(ValueError, match=words):
        make()


def test_twenty_actions_have_twenty_colours_that_names_read_on():
    light = np.array([[int(colour[i : i + 2], 16) for i in (1, 3, 5)] for colour in pictures.PALETTE], dtype=np.float32) / 255
    left = 1 - light
    dark = np.clip(2 * left @ [[0.213], [0.715], [0.072]] - left, 0, 1).astype(np.float32)  # as the style sheet turns them
    for palette in (light, dark):
        colours = cv2.cvtColor(palette[None], cv2.COLOR_RGB2LAB)[0]
        apart = np.linalg.norm(colours[:, None] - colours, axis=2)
        assert len(colours) >= 20 and apart[~np.eye(len(colours), dtype=bool)].min() > 15
        luminance = ((colours[:, 0] + 16) / 116) ** 3
        white = palette is light  # on white paper names are white, on dark paper black
        assert (1.05 / (luminance.max() + 0.05) if white else (luminance.min() + 0.05) / 0.05) > 4.5
    assert len(set(pictures.colours([f"action {i}" for i in range(20)]).values())) == 20
