"""The table of the guide, tool by tool: every row opens, on a file made the way the tool makes it, and keeps what it says."""

from __future__ import annotations

import gc
import json
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from indexing import readers
from indexing.clip import Clip, ClipSet
from indexing.readers import FORMATS, read
from indexing.readers.files import detect, detect_json, frame_number, open_source
from indexing.skeleton import COCO17, H36M17, HALPE26, MEDIAPIPE33, Skeleton
from tests.indexing.readers import test_formats as formats
from tests.indexing.readers import test_mocap, test_ultralytics, tools
from tests.indexing.readers.tools import Sample, refused

PAGE = Path(__file__).parents[3] / "docs" / "guide" / "formats.md"
CELLS = re.compile(r"^\| ([^|]+?) \| ([^|]*?) \| ([a-z]+) \| ([^|]*?) \|", re.MULTILINE)
SECTION = PAGE.read_text(encoding="utf-8").partition("## What tools write")[2].partition("\n## ")[0]
ROWS = {tool: (form, kept) for tool, _, form, kept in CELLS.findall(SECTION)}


def body(layout: Skeleton = COCO17, dims: int = 2, confidence: bool = True, seed: int = 0) -> np.ndarray:
    points = tools.standing(layout, dims=dims, seed=seed)
    return np.concatenate([points, np.full((*points.shape[:2], 1), 0.75)], axis=2) if confidence else points


def saved(path: Path, data: Any) -> Path:
    path.write_text(json.dumps(data))
    return path


def openpose(folder: Path) -> Sample:
    path = folder / "take"
    path.mkdir()
    for i, one in enumerate(formats.VARIANTS["openpose list"](body())):
        saved(path / f"take_{i:012d}_keypoints.json", one)
    return Sample(path)


def ultralytics(folder: Path) -> Sample:
    lines = test_ultralytics.lines(body() / [1000, 1000, 1], 3, False, 7)
    return Sample(test_ultralytics.write(folder / "labels", {i + 1: [line] for i, line in enumerate(lines)}), people=(7,))


def markers(folder: Path) -> Sample:
    (folder / "a.c3d").write_bytes(tools.c3d())
    return Sample(folder / "a.c3d", layout=None, dims=3)


def numpy_array(folder: Path) -> Sample:
    np.save(folder / "a.npy", body(H36M17, 3, confidence=False))
    return Sample(folder / "a.npy", layout=H36M17, dims=3)


def clip_set(folder: Path) -> Sample:
    clip = Clip(body()[..., :2], fps=25.0, confidence=body()[..., 2], skeleton=COCO17, up="-y", label="walk", name="a")
    ClipSet([clip]).save(folder / "a.npz")
    return Sample(folder / "a.npz", 25.0)


def trc(name: str, points: np.ndarray, dims: int = 3, **how: Any) -> Callable[[Path], Sample]:
    names = [
        "".join(word[0].upper() if word in ("left", "right") else word.title() for word in n.split("_")) for n in HALPE26.joints
    ]
    return lambda folder: Sample(tools.trc(folder / name, points, names, **how), 60.0, layout=None, dims=dims)


TWO = {"a": body(), "b": body(seed=1) + [300.0, 0.0, 0.0]}  # noqa: RUF005  (arrays)
IN_METRES = body(HALPE26, 3, confidence=False)
IN_PIXELS = np.insert(body(HALPE26, confidence=False), 2, 0.0, axis=2)
LANDMARKS = formats.wide(body(MEDIAPIPE33) / [1000, 1000, 1], lambda i, k: f"{MEDIAPIPE33.joints[i]}_{k}", "time")
LIFTED = 1000 * body(MEDIAPIPE33, 3, confidence=False)[..., [0, 2, 1]]
SAMPLES: dict[str, Callable[[Path], Sample]] = {
    "OpenPose": openpose,
    "MMPose, RTMPose": lambda f: Sample(saved(f / "a.json", formats.VARIANTS["mmpose demo"](body())), people=(4,), layout=None),
    "Ultralytics": ultralytics,
    "AlphaPose": lambda f: Sample(tools.alphapose(f / "alphapose-results.json", list(TWO.values())), people=(1, 2)),
    "COCO annotations": lambda f: Sample(saved(f / "person_keypoints.json", formats.coco_dataset(body())), people=(3,)),
    "MediaPipe": lambda f: Sample(formats.save_rows(f / "a.csv", LANDMARKS), 1.0, layout=MEDIAPIPE33),
    "DeepLabCut": lambda f: Sample(tools.deeplabcut(f / f"walk{tools.SCORER}.h5", TWO, COCO17.joints), people=("a", "b")),
    "DeepLabCut CSV": lambda f: Sample(
        formats.save_rows(f / "a.csv", formats.deeplabcut_animals({"mouse": body()})), people=("mouse",)
    ),
    "SLEAP": lambda f: Sample(tools.sleap_project(f / "a.slp", TWO, COCO17.joints, fps=25.0), 25.0, ("a", "b")),
    "SLEAP analysis": lambda f: Sample(tools.sleap_analysis(f / "a.analysis.h5", TWO, COCO17.joints), people=("a", "b")),
    "SLEAP CSV": lambda f: Sample(formats.save_rows(f / "a.csv", formats.sleap(body(), "m")), people=("m",)),
    "FreeMoCap": lambda f: Sample(tools.freemocap(f / "session", LIFTED), layout=MEDIAPIPE33, dims=3),
    "Pose2Sim": trc("a_0-11.trc", IN_METRES),
    "OpenSim, OpenCap": trc("walk.trc", 1000 * IN_METRES, units="mm"),
    "Sports2D": trc("a_px_person00.trc", IN_PIXELS, 2, units="px"),
    "Vicon, Qualisys, OptiTrack": markers,
    "points in space": lambda f: Sample(
        test_mocap.table(f / "a.csv", 1000 * body(dims=3, confidence=False), COCO17.joints), 50.0, dims=3
    ),
    "movement": lambda f: Sample(tools.movement(f / "a.nc", TWO, COCO17.joints), 25.0, ("a", "b")),
    "pyskl, mmaction2": lambda f: Sample(
        tools.pyskl(f / "ntu60_hrnet.pkl", {"x": np.stack(list(TWO.values()))}, [3], {"xsub_train": ["x"]}), people=("0", "1")
    ),
    "numpy": numpy_array,
    "clip set": clip_set,
}


def test_every_row_has_a_file_and_every_format_a_row() -> None:
    assert sorted(ROWS) == sorted(SAMPLES), "docs/guide/formats.md has a row for each sample of the readers' tests, by its name"
    assert sorted({name for name, _ in ROWS.values()}) == list(FORMATS), "docs/guide/formats.md has a row for each format"


@pytest.mark.slow
def test_the_output_of_every_tool_opens_and_keeps_what_the_table_says(tmp_path: Path) -> None:
    def check(number: int, tool: str) -> None:
        (tmp_path / str(number)).mkdir()
        check_sample(tool, SAMPLES[tool](tmp_path / str(number)))

    assert tools.list_failures({tool: partial(check, i, tool) for i, tool in enumerate(SAMPLES)}) == {}


def check_sample(tool: str, made: Sample) -> None:
    """One row of the table: what is detected, what is kept, and that the format can be said, and no other."""
    name, kept = ROWS[tool]
    assert detect(open_source(made.path)) == name
    clips = read(made.path)
    assert len(clips) == made.clips
    (clip,) = clips
    assert clip.dims == made.dims and clip.seen.mean() > 0.9
    if made.layout is not None:
        assert clip.skeleton is not None and tuple(joint.lower() for joint in clip.skeleton.joints) == made.layout.joints
    assert ("3D" in kept) == (made.dims == 3) or tool in ("numpy", "clip set")
    assert clip.confidence is None or np.allclose(clip.confidence[clip.seen], 0.75, atol=1e-3)
    assert (clip.confidence is not None) == ("confidence" in kept or tool == "clip set")
    if made.fps is not None:
        assert not clip.fps_assumed and round(float(clip.fps or 0), 3) == made.fps
        assert "times" in kept or "frame rate" in kept or tool == "clip set"
    if made.people:
        assert "ids" in kept
        assert [clip.meta["person"] for clip in read(made.path, person="all")] == list(made.people)
    if "joint names" in kept:
        assert clip.skeleton is not None and not clip.skeleton.joints[0].isdigit()
    if "labels" in kept:
        assert (clip.label, clip.meta["split"]) == (3, "xsub_train")
    assert len(read(made.path, format=name)) == made.clips


# read and read_clip: detection, options, and inputs that no format can take


def test_a_video_without_a_pose_model_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("indexing.pose.available", lambda *_: None)
    for name in ("a.mp4", "a.MOV", "a.webm"):
        (tmp_path / name).write_bytes(b"\x00\x00\x00\x18ftypmp42")
        refused(tmp_path / name, "is a video", "no pose model", "or give keypoints")


NO_KEYPOINTS: list[tuple[str, bytes, tuple[str, ...]]] = [
    ("empty.json", b"", ("empty", "export it again")),
    ("blank.json", b" \n ", ("empty", "export it again")),
    ("cut.json", b'[{"image_id": 1, "keypoints": [1.0, 2.', ("not valid JSON at line 1, column", "truncated")),
    ("model.safetensors", b"\x10\0\0\0\0\0\0\0{}", ("model file", "-m")),
    *((f"weights.{suffix}", b"\x80\x04N.", ("is a pickle",)) for suffix in ("pt", "pth", "joblib")),
    ("renamed.json", b'\x40\0\0\0\0\0\0\0{"__metadata__":{}}', ("model file", "-m")),
    ("photo.jpg", b"\xff\xd8\xff\xe0\x00\x10JFIF\x00", ("binary file", "JSON, CSV")),
    ("latin.csv", b"\xff\xfe\xe9x,y\n", ("UTF-8", "JSON, CSV")),
    ("prices.csv", b"date,price\n1,2\n", ("without keypoint columns", "date, price", "format=")),
    ("set.npz", b"this is not a zip archive", ("not an .npz", "truncated")),
    ("object.json", b'{"version": 1}', ("without keypoints", "version", "format=")),
    ("numbers.json", b"[1, 2, 3]", ("without keypoints", "format=")),
    ("boxes.json", b'[{"bbox": [1, 2]}]', ("without keypoints", "bbox")),
    ("nobody.json", b"[]", ("no person was detected", "threshold")),
    ("nobody.json", b"[[], [], []]", ("no person was detected", "threshold")),
]


def test_what_is_no_keypoint_file_is_refused(tmp_path: Path, openpose_folder, person: np.ndarray) -> None:
    for name, content, words in NO_KEYPOINTS:
        (tmp_path / name).write_bytes(content)
        refused(tmp_path / name, *words)
    folder = openpose_folder({i: [person[i]] for i in range(3)})
    broken = folder / "clip2_000000000001_keypoints.json"
    broken.write_text(broken.read_text()[:80])
    refused(broken.parent, broken.name, "not valid JSON", "truncated")
    values = ({}, [], [[]], ["[]"], [3], {"image_id": 3}, [[[[[{"image_id": 3}]]]]], {"a": {"b": 1}}, [{"name": "x"}], ["text"])
    assert [detect_json(tmp_path, value) for value in values] == [None] * 3 + ["ultralytics"] + [None] * 6
    assert detect_json(tmp_path, [[], [[{"image_id": 3}]]]) == "coco"
    names = ("video_000000000012_keypoints.json", "0.jpg", "img7_002.png", "12_rgb.json", "a.json", "3")
    assert list(map(frame_number, names)) == [12, 0, 2, 12, None, 3]


def test_a_folder_that_is_not_one_recording_is_refused(tmp_path: Path) -> None:
    for i, (names, *words) in enumerate(
        (
            ([], "no .json or .txt", "nothing"),
            (["a.mkv", "b.mkv"], "no .json or .txt", "a.mkv"),
            (["squat.json"], "squat.json", "no frame number"),
            (["a_001.json", "b_001.json"], "a_001.json", "b_001.json", "frame 1", "folder of its own"),
        )
    ):
        folder = tmp_path / f"folder{i}"
        folder.mkdir()
        for name in names:
            (folder / name).write_text('{"people": []}')
        refused(folder, *words)


def test_unknown_options_are_refused(tmp_path: Path) -> None:
    for options, said in (
        ({"format": "bvh"}, "unknown format='bvh'.*openpose"),
        ({"person": "tallest"}, "unknown person='tallest'.*largest"),
        ({"fps": 0}, "fps must be a positive number.*0"),
        ({"fps": float("nan")}, "fps.*nan"),
        ({"min_confidence": float("inf")}, "min_confidence.*inf"),
        ({"size": (640, 0)}, r"size.*\(640, 0\)"),
        ({"size": 640}, "size.*640"),
    ):
        with pytest.raises(ValueError, match=said):
            readers.read(tmp_path / "a.json", **options)  # type: ignore[arg-type]


def test_naming_the_wrong_format_says_what_the_file_is_and_one_clip_is_one(tmp_path: Path) -> None:
    path = tmp_path / "set.npz"
    np.savez(path, joints=np.ones((3, 2, 2)))
    for name in set(readers.FORMATS) - {"clipset"}:
        refused(path, "is a npz", name, "leave format= out", format=name)
    path = tmp_path / "set.npz"
    np.savez(path, joints=np.ones((6, 3, 2)), offsets=[0, 2, 6])
    with pytest.raises(ValueError, match=r"set.npz: holds 2 clips .*ClipSet.load.*index evaluate"):
        readers.read_clip(path)


def test_reading_leaves_the_collector_of_cycles_as_it_was(tmp_path: Path) -> None:
    for before in (True, False):
        (gc.enable if before else gc.disable)()
        try:
            refused(tmp_path / "nothing.json", "no such file")
            assert gc.isenabled() == before
        finally:
            gc.enable()


def test_clip_and_clipset_load_through_the_readers(openpose_folder, person: np.ndarray) -> None:  # type: ignore[no-untyped-def]
    folder = openpose_folder({i: [one] for i, one in enumerate(person)})
    clip = Clip.load(folder, fps=50.0, label="squat")
    assert (clip.label, clip.fps, clip.fps_assumed, clip.name) == ("squat", 50.0, False, "take")
    clips = ClipSet.load(folder)
    assert len(clips) == 1
    assert clips[0].fps_assumed
    assert clips[0].times.tolist() == [i / 30 for i in range(6)]
