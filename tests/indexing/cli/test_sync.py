"""``dyntorch sync``: from keypoint folders to shifted folders, and what is refused and how."""

from __future__ import annotations

import json
import re
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
import torch

import dyntorch
from dyntorch.numerics import Message
from dyntorch.tasks.synchronize.cameras import synchronize_cameras
from indexing.clip import Clip, ClipSet
from tests.indexing.sync.footage import microphone, noises, numbers_of, write_film
from tests.indexing.sync.scene import FPS, SKIPPED, cut, filmed, shift, write_openpose

COMMAND = "sync"
NAMES = ["cam01", "cam02", "cam03"]
DRAWN = b"\x89PNG".ljust(16, b"\0") + (100).to_bytes(4, "big") * 2  # what the page reads of a picture
ONE_FRAME = "@/pose/cam02_json/cam02_json_000000000003_keypoints.json"


@lru_cache
def short() -> list[Clip]:
    """Two seconds of each camera, of lengths that tell them apart."""
    return [cut(clip, 0, 60 - i) for i, clip in enumerate(filmed())]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``pose/cam01_json`` ... ``cam03_json`` as Pose2Sim has them, the second also as ``cam02.npz``; ``empty``."""
    folder = tmp_path_factory.mktemp("cameras")
    for name, clip in zip(NAMES, short(), strict=True):
        write_openpose(folder / "pose" / f"{name}_json", [clip])
    ClipSet([short()[1].replace(label=None, meta={})]).save(folder / "cam02.npz")
    np.save(folder / "bare.npy", short()[1].joints[0])
    write_openpose(folder / "empty", [clip.replace(joints=np.full(clip.joints.shape, np.nan), confidence=None)])
    return folder


@pytest.fixture
def library(monkeypatch):
    """What the library says of pairs of cameras, by the number of frames of both; records how it was asked."""
    lengths = [len(clip) for clip in short()]
    said: dict = {"asked": []}

    def answer(a, b, correspondence=True, **options):
        said["asked"].append({"correspondence": correspondence, **options})
        i, j = (lengths.index(len(points)) for points in (a, b))
        offset = (SKIPPED[i] - SKIPPED[j]) / FPS + 0.01
        points = torch.arange(a.shape[1]) != 10
        return shift(**{"offset": offset, "points": points, **said.get((i, j), {})})

    monkeypatch.setattr(dyntorch, "synchronize", answer, raising=False)
    monkeypatch.setattr(dyntorch, "synchronize_cameras", synchronize_cameras, raising=False)
    monkeypatch.setattr("indexing.report.sync.picture_of", lambda report: DRAWN)  # half of a run's time
    return said


def read(folder: str | Path = "out") -> dict:
    return json.loads((Path(folder) / "sync.json").read_text())


def listed(folder: str) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in Path(folder).rglob("*") if path.is_file())


# ---- what is found -------------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_two_folders(run, library, data):
    code, out, err = run("@/pose/cam01_json @/pose/cam02_json --fps 30 --out out/")
    assert (code, err) == (0, "") and "report: out/report.html" in out and len(out.splitlines()) <= 10
    assert "cam02 began 0.3900 s after cam01: time of cam02 = time of cam01 - 0.3900 s" in out
    assert re.search(r"cam01 → cam02 +-0\.3900 +0\.0020 +-11\.70 +0 +0\.990 +\+0\.710 +ok", out)
    assert "inconsistent joints of cam01 and cam02: right_wrist (joint 10)" in out and "assumed" not in out
    assert "shifted files: out/pose-sync/ (cam01, cam02), within 10.0 ms of cam01" in out
    found = read()
    assert found["ok"] and found["reason"] is None and found["reference"] == "cam01" and found["cycle_error"] is None
    assert [camera["offset"] for camera in found["cameras"]] == [0.0, pytest.approx(-0.39)]
    assert found["cameras"][1]["shifted"] == {
        "folder": "pose-sync/cam02_json", "files": found["cameras"][1]["frames"], "shift": -12, "rest": pytest.approx(0.01),
        "repeated": 0, "left_out": 0,
    }  # fmt: skip
    [pair] = found["pairs"]
    assert pair["wrong_points"] == ["right_wrist (joint 10)"] and len(pair["peaks"]) == 2 and pair["method"] == "epipolar"
    assert {"versions", "inputs", "timings", "arguments"} <= found["manifest"].keys() and len(found["manifest"]["inputs"]) == 2
    files = listed("out")
    assert [name for name in files if "/" not in name] == ["curve.png", "report.html", "sync.json"]
    late = [name for name in files if "cam02_json/" in name]
    assert late[0] == "pose-sync/cam02_json/cam02_json_000000000012_keypoints.json"
    assert Path("out", late[0]).read_text() == (data / "pose/cam02_json/cam02_json_000000000000_keypoints.json").read_text()
    assert len([name for name in files if "cam01_json/" in name]) == found["cameras"][0]["frames"]
    assert Path("out/curve.png").read_bytes()[:4] == b"\x89PNG" and "cam02" in Path("out/report.html").read_text()


@pytest.mark.slow
def test_one_folder_of_all_and_a_file(run, library):
    code, out, _ = run("@/pose --fps 30,30,30 --out out --title Kitchen")
    assert code == 0 and "cycle error: 10.00 ms" in out and "clock against cam01" in out
    assert len(read()["pairs"]) == 3 and read()["cameras"][2]["offset"] == pytest.approx(-25 / FPS + 0.01, abs=0.01)
    assert "<h1>Kitchen</h1>" in Path("out/report.html").read_text() and len(list(Path("out/pose-sync").iterdir())) == 3
    code, out, _ = run("@/pose/cam01_json @/cam02.npz --fps 30 --out two")
    assert code == 0 and (Path("two/pose-sync/cam02_json/cam02_000012.json")).is_file()


@pytest.mark.slow
def test_flags_reach_the_library(run, library, tmp_path):
    section = "[{}]\nmatrix = [[900, 0, 320], [0, 900, 240], [0, 0, 1]]\ndistortions = [-0.1, 0, 0, 0]\n"
    Path("c.toml").write_text(section.format("cam01") + section.format("cam02"))
    code, out, _ = run("@/pose/cam01_json @/pose/cam02_json --fps 60 --max-shift 2 --calibration c.toml --no-rate")
    asked = library["asked"][0]
    assert code == 0 and asked["max_shift"] == 2 and asked["times"][0][1].item() == pytest.approx(1 / 60)
    assert asked["calibration"][0][1].tolist() == [-0.1, 0, 0, 0] and asked["rate"] == 1.0 and "report" not in out


def test_rates_that_nobody_said_are_mentioned(run, library):
    out = run("@/pose/cam01_json @/pose/cam02_json")[1]
    assert "note: 30 frames per second assumed for cam01, cam02; --fps says otherwise" in out


@pytest.mark.slow
def test_a_pair_that_contradicts_the_others_is_named(run, library):
    library[0, 2] = {"offset": 1.5, "peaks": torch.tensor([[1.5, 9.0]], dtype=torch.float64), "confidence": 0.6}
    code, out, _ = run("@/pose --fps 30 --out out")
    found = read()
    assert found["outlier_pair"] == ["cam01", "cam03"] and "cam01-cam03 is sure of itself but contradicts the others" in out
    assert code in (0, 3) and (code == 0) == found["ok"] == Path("out/pose-sync").exists()


@pytest.mark.slow
def test_check_videos(run, library):
    pytest.importorskip("av")
    code, out, _ = run("@/pose/cam01_json @/pose/cam02_json --fps 30 --check --out out")
    assert code == 0 and "check.mp4" in listed("out") and "check.mp4" in Path("out/report.html").read_text()
    from indexing.video import probe

    assert probe("out/check.mp4").duration == pytest.approx(47 / FPS, abs=0.1)
    library[0, 1] = {"offset": 500.0, "ok": False, "reason": "periodic"}
    code, out, _ = run("@/pose/cam01_json @/pose/cam02_json --fps 30 --check --out out")
    assert "note: check.mp4 was not written: " in out and "no moment in common" in out and code == 3
    assert run("@/pose --fps 30 --check --out out")[0] in (0, 3) and "check-cam03.mp4" in listed("out")
    Path("out/check-mine.mp4").write_text("of somebody else")
    del library[0, 1]
    assert run("@/pose/cam01_json @/pose/cam02_json --fps 30 --out out")[0] == 0  # those of an earlier run are removed
    assert [name for name in listed("out") if name.startswith("check")] == ["check-mine.mp4"]


@pytest.mark.slow
def test_frames_before_the_reference_are_mentioned(run, library):
    code, out, _ = run("@/pose/cam02_json @/pose/cam01_json --fps 30 --out out")
    assert code == 0 and "note: 12 frames of cam01 left out of pose-sync: taken before number 0 of cam02" in out
    library[1, 0] = {"offset": 500.0}
    assert run("@/pose/cam02_json @/pose/cam01_json --fps 30 --out out")[0] == 0 and not Path("out/pose-sync/cam01_json").exists()


# ---- what is refused -----------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_what_does_not_decide_is_refused_and_writes_no_files(run, library):
    line = "@/pose/cam01_json @/pose/cam02_json --fps 30 --out out"
    assert run(line)[0] == 0 and Path("out/pose-sync").is_dir()
    library[0, 1] = {"ok": False, "reason": Message("the motion is periodic: record a single move, or give {arg:max_shift=0.5}")}
    code, out, err = run(line)
    assert code == 3 and err == "dyntorch: refused: the motion is periodic: record a single move, or give --max-shift 0.5\n"
    assert "refused" in out and "note: pose-sync of an earlier run was removed" in out
    assert listed("out") == ["curve.png", "report.html", "sync.json"]
    found, page = read(), Path("out/report.html").read_text()
    assert "or give --max-shift 0.5" in found["pairs"][0]["reason"] and "max_shift" not in page
    assert not found["ok"] and "periodic" in found["reason"] and found["pairs"][0]["peaks"] and not found["pairs"][0]["ok"]
    assert "do not decide" in page and "not to be relied on" in page


@pytest.mark.slow
def test_what_is_there_is_not_lost(run, library, data, tmp_path):
    line = "@/pose/cam01_json @/pose/cam02_json --fps 30 --out out"
    Path("out/pose-sync").mkdir(parents=True)
    Path("out/pose-sync/mine.txt").write_text("mine")
    code, _, err = run(line)
    assert code == 2 and "pose-sync: is there, and not from this command; move it away" in err
    assert listed("out") == ["pose-sync/mine.txt"]
    assert run("@/pose/cam01_json @/pose/cam02_json --fps 30 --out first")[0] == 0
    code, _, err = run("first/pose-sync --fps 30 --out first")
    assert code == 2 and "is an input, and first/pose-sync would be replaced" in err
    code, _, err = run("@/pose/cam01_json @/pose/cam02_json --fps 30 --out @/pose/cam01_json")
    assert code == 2 and "cam01_json: is an input, and files of the report among its frames would spoil it" in err


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("", "no cameras given, two are needed"),
        ("@/pose/cam01_json", "cam01_json: is one camera, two are needed"),
        ("@/pose/cam01_json @/pose/cam01_json", "cam01_json: given twice; name every camera once"),
        ("no/", "no: no such file or folder; check the path"),
        ("@/pose/cam01_json no/", "no: no such file or folder; check the path"),
        (f"@/pose/cam01_json {ONE_FRAME}", "1 frame, 12 are needed at least; give the folder"),
        ("@/pose/cam01_json @/empty --min-confidence 0.5", "threshold and --min-confidence"),
        ("@/pose/cam01_json @/bare.npy", "np.savez(file, joints=array, fps=...)"),
        ("@/pose/cam01_json @/empty", "empty: no person was detected"),
        ("@/pose --fps 30,29", "--fps gives 2 numbers for 3 cameras"),
        ("@/pose --fps 0", "--fps must be a positive number of frames per second, or one per camera as in 60,59.94, got 0"),
        ("@/pose --fps fast", "--fps must be a positive number"),
        ("@/pose --max-shift -1", "--max-shift must be a positive number of seconds, got -1"),
        ("@/pose --check", "--check writes a video; say where with --out"),
        ("@/pose --videos", "--videos writes videos; say where with --out"),
        ("@/pose --videos --out out", "cam01_json: no video of this camera is known: give the video itself, or put it beside"),
        ("@/pose --videos --videos-fps 0 --out out", "--videos-fps must be a positive number of frames per second, got 0"),
        ("@/pose --videos-fps 25", "--videos-fps is of the videos that --videos writes; add --videos"),
        ("@/pose --by sound", "cam01_json: is no video, and --method sound needs their sound; give the videos, or use --method k"),
        ("@/pose --by sound --method tracks", "--by sound: --method tracks compares the pixels of videos; leave --by out"),
        ("@/pose --by pixels --method sound", "--by pixels: --method sound compares the sound of videos; leave --by out"),
        ("@/pose --method brightness", "holds keypoints, and --method brightness needs videos"),
        ("@/pose --method guess", "see dyntorch sync --help"),
        ("@/pose --calibration no.toml", "no.toml: no such file"),
        ("@/pose --out @/cam02.npz", "is a file; choose another folder"),
    ],
)
def test_bad_input_is_one_line_and_code_2(refuse, library, line, says):
    refuse(line, says=(says,))


# ---- videos with sound -----------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def films(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``left.mp4`` and ``right.mp4``, which began 1.4 s later; ``mute.mp4``; and ``other.mp4`` of another place."""
    pytest.importorskip("av")
    folder, scene = tmp_path_factory.mktemp("films"), noises(25.0, 2)
    for i, (name, start) in enumerate((("left", 1.0), ("right", 2.4))):
        numbers = np.round((start + np.arange(int(20 * FPS)) / FPS) * 100).astype(np.int64)
        write_film(folder / f"{name}.mp4", numbers, FPS, microphone(scene, start, 20.0, i))
    write_film(folder / "other.mp4", np.arange(600), FPS, microphone(noises(25.0, 7), 0.0, 20.0, 5))
    write_film(folder / "mute.mp4", np.arange(60), FPS)
    return folder


@pytest.mark.slow
def test_sound_alone_and_videos_of_equal_frames(run, films):
    code, out, err = run(f"{films}/left.mp4 {films}/right.mp4 --by sound --videos --out out")
    assert (code, err) == (0, "") and "right began 1.4" in out
    [pair] = read()["pairs"]
    assert pair["method"] == "sound" and pair["offset"] == pytest.approx(-1.4, abs=0.003) and pair["sound"]["later"] == 0
    videos = read()["videos"]
    first, second = (np.array(numbers_of(Path("out") / one["file"])) for one in videos["cameras"].values())
    assert len(first) == len(second) == videos["frames"] and abs(videos["frames"] - 18.6 * FPS) <= 2
    assert np.abs(first - second).max() <= 0.5 / FPS * 100 + 1
    assert f"videos: out/synchronized_videos/, 2 videos of {videos['frames']} frames, 30 per second, within" in out
    assert "frame k of every file is one moment" in Path("out/report.html").read_text()
    assert run(f"{films}/left.mp4 {films}/right.mp4 --method sound --out out")[0] == 0
    assert read()["videos"] is None and not Path("out/synchronized_videos").exists()
    assert "videos of an earlier run in synchronized_videos were removed" in Path("out/report.html").read_text()


def test_sound_that_does_not_decide(run, films):
    code, _, err = run(f"{films}/left.mp4 {films}/other.mp4 --by sound --videos --out out")
    assert code == 3 and "no shift of the sound stands out" in err and not Path("out/synchronized_videos").exists()
    assert "mute has no sound" in run(f"{films}/left.mp4 {films}/mute.mp4 --by sound")[2]


@pytest.mark.slow
def test_sound_is_a_witness(run, films, monkeypatch):
    said: dict = {"offset": -1.39}
    monkeypatch.setattr("indexing.sync.synchronize.synchronize_videos", lambda *_, **__: shift(**said))
    line = f"{films}/left.mp4 {films}/right.mp4 --by pixels --out out"
    code, out, _ = run(line)
    assert code == 0 and "note: sound agrees: -0.010 s" in out and read()["pairs"][0]["sound"]["ok"]
    said["offset"] = -0.9
    code, out, err = run(line)
    assert code == 3 and "the sound says -1.400 ± 0.017 s, and the pictures say -0.900 ± 0.002 s" in err
    assert "--method sound takes the word of the sound, --no-sound that of the pictures" in err
    assert run(f"{line} --no-sound")[0] == 0 and read()["pairs"][0]["sound"] is None
    code, out, _ = run(f"{films}/left.mp4 {films}/other.mp4 --by pixels")
    assert code == 0 and "note: the sound does not decide: no shift of the sound stands out" in out
    code, out, _ = run(f"{films}/left.mp4 {films}/mute.mp4 --by pixels")
    assert code == 0 and "sound" not in out
    said.update(ok=False, reason="too still")
    code, out, err = run(line)
    assert code == 3 and "too still" in err and "the sound says -1.400 ± 0.017 s; --method sound takes its word" in out


# ---- the library itself --------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_three_cameras_from_files_to_files(run):
    for name, clip in zip(NAMES, filmed(), strict=True):
        write_openpose(Path("pose") / f"{name}_json", [cut(clip, 0, 130)])
    code, _, err = run("pose --fps 30 --out out")
    assert (code, err) == (0, "") and [camera["shifted"]["shift"] for camera in read()["cameras"]] == [0, -12, -25]
    assert Path("out/curve.png").stat().st_size > 10_000
