"""read and read_clip: detection, options, and inputs that no format can take."""

from __future__ import annotations

import gc
from pathlib import Path

import numpy as np
import pytest

from indexing import readers
from indexing.clip import Clip, ClipSet
from indexing.readers.files import frame_number


def refused(path: Path, *words: str, **options: object) -> None:
    """Reading fails with one line that names the file and has all the words."""
    with pytest.raises(ValueError) as caught:  # noqa: PT011  (the words are the match)
        readers.read(path, **options)  # type: ignore[arg-type]
    message = str(caught.value)
    assert "\n" not in message
    assert path.name in message
    for word in words:
        assert word in message, message


@pytest.mark.parametrize("name", ["a.mp4", "a.MOV", "a.avi", "a.mkv", "a.webm"])
def test_a_video_without_a_pose_model_is_refused(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("indexing.pose.available", lambda *_: None)
    path = tmp_path / name
    path.write_bytes(b"\x00\x00\x00\x18ftypmp42")
    refused(path, "is a video", "no pose model", "or give keypoints")


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("empty.json", b"", ("empty", "export it again")),
        ("blank.json", b" \n ", ("empty", "export it again")),
        ("cut.json", b'[{"image_id": 1, "keypoints": [1.0, 2.', ("not valid JSON at line 1, column", "truncated")),
        ("model.safetensors", b"\x10\0\0\0\0\0\0\0{}", ("model file", "-m")),
        ("renamed.json", b'\x40\0\0\0\0\0\0\0{"__metadata__":{}}', ("model file", "-m")),
        ("labels.slp", b"\x89HDF\r\n\x1a\n" + bytes(20), ("cannot be read as HDF5", "truncated", "export or copy it again")),
        ("poses.pkl", b"\x80\x04\x95", ("the pickle cannot be read", "truncated", "nothing in it but numpy arrays")),
        ("weights.pt", b"\x80\x04\x95", ("is a pickle", "JSON, CSV")),
        ("array.npy", b"\x93NUMPY\x01\x00", ("no array of numpy", "truncated", "write it again")),
        ("photo.jpg", b"\xff\xd8\xff\xe0\x00\x10JFIF\x00", ("binary file", "JSON, CSV")),
        ("latin.csv", b"\xff\xfe\xe9x,y\n", ("UTF-8", "JSON, CSV")),
        ("prices.csv", b"date,price\n1,2\n", ("without keypoint columns", "date, price", "format=")),
        ("set.npz", b"this is not a zip archive", ("not an .npz", "truncated")),
        ("set.npz", b"PK\x03\x04 cut off", ("not an .npz", "truncated")),
        ("object.json", b'{"version": 1}', ("without keypoints", "version", "format=")),
        ("numbers.json", b"[1, 2, 3]", ("without keypoints", "format=")),
        ("boxes.json", b'[{"bbox": [1, 2]}]', ("without keypoints", "bbox")),
        ("nobody.json", b"[]", ("no person was detected", "threshold")),
        ("nobody.json", b"[[], [], []]", ("no person was detected", "threshold")),
    ],
)
def test_what_is_no_keypoint_file_is_refused(tmp_path: Path, name: str, content: bytes, words: tuple[str, ...]) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    refused(path, *words)


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    refused(tmp_path / "nowhere.json", "no such file", "check the path")


@pytest.mark.parametrize(
    ("names", "words"),
    [
        ([], ("no .json or .txt", "nothing")),
        (["a.mkv", "b.mkv"], ("no .json or .txt", "a.mkv")),
        (["squat.json"], ("squat.json", "no frame number")),
        (["a_001.json", "b_001.json"], ("a_001.json", "b_001.json", "frame 1", "folder of its own")),
    ],
)
def test_a_folder_that_is_not_one_recording_is_refused(tmp_path: Path, names: list[str], words: tuple[str, ...]) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    for name in names:
        (folder / name).write_text('{"people": []}')
    refused(folder, *words)


def test_a_truncated_file_of_a_folder_is_named(openpose_folder, person: np.ndarray) -> None:  # type: ignore[no-untyped-def]
    folder = openpose_folder({i: [person[i]] for i in range(3)})
    broken = folder / "clip2_000000000001_keypoints.json"
    broken.write_text(broken.read_text()[:80])
    refused(broken.parent, broken.name, "not valid JSON", "truncated")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"format": "bvh"}, ("unknown format='bvh'", "openpose")),
        ({"person": "tallest"}, ("unknown person='tallest'", "largest")),
        ({"fps": 0}, ("fps must be a positive number", "0")),
        ({"fps": float("nan")}, ("fps", "nan")),
        ({"min_confidence": float("inf")}, ("min_confidence", "inf")),
        ({"size": (640, 0)}, ("size", "(640, 0)")),
        ({"size": 640}, ("size", "640")),
    ],
)
def test_unknown_options_are_refused(tmp_path: Path, options: dict[str, object], words: tuple[str, ...]) -> None:
    path = tmp_path / "a.json"
    path.write_text("[]")
    with pytest.raises(ValueError) as caught:  # noqa: PT011
        readers.read(path, **options)  # type: ignore[arg-type]
    assert all(word in str(caught.value) for word in words)


def test_naming_the_wrong_format_says_what_the_file_is(tmp_path: Path) -> None:
    path = tmp_path / "set.npz"
    np.savez(path, joints=np.ones((3, 2, 2)))
    for name in set(readers.FORMATS) - {"clipset"}:
        refused(path, "is a npz", name, "leave format= out", format=name)


def test_reading_leaves_the_collector_of_cycles_as_it_was(tmp_path: Path) -> None:
    for before in (True, False):
        (gc.enable if before else gc.disable)()
        try:
            refused(tmp_path / "nothing.json", "no such file")
            assert gc.isenabled() == before
        finally:
            gc.enable()


def test_read_clip_wants_one_clip(tmp_path: Path) -> None:
    path = tmp_path / "set.npz"
    np.savez(path, joints=np.ones((6, 3, 2)), offsets=[0, 2, 6])
    with pytest.raises(ValueError, match=r"set.npz: holds 2 clips .*ClipSet.load.*index evaluate"):
        readers.read_clip(path)


def test_clip_and_clipset_load_through_the_readers(openpose_folder, person: np.ndarray) -> None:  # type: ignore[no-untyped-def]
    folder = openpose_folder({i: [one] for i, one in enumerate(person)})
    clip = Clip.load(folder, fps=50.0, label="squat")
    assert (clip.label, clip.fps, clip.fps_assumed, clip.name) == ("squat", 50.0, False, "take")
    clips = ClipSet.load(folder)
    assert len(clips) == 1
    assert clips[0].fps_assumed
    assert clips[0].times.tolist() == [i / 30 for i in range(6)]


@pytest.mark.parametrize(
    ("name", "number"),
    [("video_000000000012_keypoints.json", 12), ("0.jpg", 0), ("img7_002.png", 2), ("12_rgb.json", 12), ("a.json", None), ("3", 3)],
)
def test_frame_number(name: str, number: int | None) -> None:
    assert frame_number(name) == number
