"""Label folders of YOLO pose: what a line holds is not written in it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from indexing.readers import read, read_clip
from tests.grid import grid
from tests.indexing.readers.tools import refused

FRAMES = 5


def lines(joints: np.ndarray, dims: int, confidence: bool, track: int | None) -> list[str]:
    """One line per frame of ``(frames, n, 3)`` normalized joints."""
    low, high = joints[..., :2].min(axis=1), joints[..., :2].max(axis=1)
    more = [0.871] * confidence + ([] if track is None else [track])
    rows = ([0, *(a + b) / 2, *(b - a), *one[:, :dims].ravel(), *more] for a, b, one in zip(low, high, joints, strict=True))
    return [" ".join(f"{x:g}" for x in row) for row in rows]


def write(folder: Path, frames: dict[int, list[str]]) -> Path:
    folder.mkdir(exist_ok=True)
    for number, people in frames.items():
        (folder / f"walk_{number}.txt").write_text("".join(f"{line}\n" for line in people))
    return folder


def person(n: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    joints = rng.uniform([0.3, 0.2], [0.4, 0.8], size=(n, 2)) + rng.normal(scale=0.005, size=(FRAMES, n, 2))
    return np.concatenate([joints, rng.uniform(0.4, 0.99, size=(FRAMES, n, 1))], axis=2)


@grid(("n", [17, 12, 21, 9]), ("dims", [2, 3]), ("confidence", [False, True]), ("track", [None, 4]))
def test_every_kind_of_line(tmp_path: Path, n: int, dims: int, confidence: bool, track: int | None) -> None:
    joints = person(n)
    folder = write(tmp_path / "labels", {i + 1: [line] for i, line in enumerate(lines(joints, dims, confidence, track))})
    clip = read_clip(folder)
    np.testing.assert_allclose(clip.joints, joints[..., :2], atol=1e-5)
    assert (clip.confidence is None) == (dims == 2)
    np.testing.assert_allclose(clip.times, np.arange(FRAMES) / 30)  # files count from 1, times from 0
    assert (clip.up, clip.name) == ("-y", "labels")
    if track is not None:
        assert read(folder, person="all")[0].meta["person"] == 4


def test_annotations_with_visibility_flags_and_hidden_joints(tmp_path: Path) -> None:
    joints = person(17)
    joints[..., 2] = 2.0
    joints[1:, 3] = 0.0
    rows = lines(joints, 3, confidence=False, track=None)
    # the box of an annotation is that of the joints seen
    rows = [" ".join([*rows[0].split()[:5], *row.split()[5:]]) for row in rows]
    clip = read_clip(write(tmp_path / "labels", dict(enumerate([[row] for row in rows]))), size=(640, 480))
    assert clip.seen.sum(axis=1).tolist() == [17, 16, 16, 16, 16]
    np.testing.assert_allclose(clip.joints[0], joints[0, :, :2] * [640, 480], atol=1e-2)
    assert clip.times[0] == 0.0


def test_frames_without_a_file_are_absent_and_empty_files_are_nan(tmp_path: Path) -> None:
    rows = lines(person(17), 3, True, None)
    clip = read_clip(write(tmp_path / "labels", {1: [rows[0]], 2: [], 7: [rows[2]]}))
    assert clip.seen.any(axis=1).tolist() == [True, False, True]
    np.testing.assert_allclose(clip.times, np.array([0, 1, 6]) / 30)


def test_several_people(tmp_path: Path) -> None:
    large, small = person(17), person(17, 1) * [0.5, 0.5, 1] + [0.5, 0, 0]
    both = zip(lines(small, 3, True, 2), lines(large, 3, True, 1), strict=True)
    folder = write(tmp_path / "labels", {i: list(two) for i, two in enumerate(both)})
    np.testing.assert_allclose(read_clip(folder).joints, large[..., :2], atol=1e-5)
    assert sorted(clip.meta["person"] for clip in read(folder, person="all")) == [1, 2]


def test_what_is_broken_is_named(tmp_path: Path) -> None:
    for i, (frames, words) in enumerate(
        (
            ({1: []}, ("", "no person was detected in any of 1 frames", "threshold")),
            ({1: ["0 0.5 0.5 0.1 0.1"]}, ("", "0 numbers after the box", "pose model")),
            ({1: ["0 0.5 x"]}, ("walk_1.txt", "line 1 is not a list of numbers", "save_txt=True")),
            ({1: ["0 .5 .5 .1 .1 .5 .5 .9"], 2: ["0 .5 .5 .1 .1 .5 .5"]}, ("walk_2.txt", "line 1 has 7 numbers", "same model")),
        )
    ):
        path = write(tmp_path / f"{i}", frames)
        refused(path / words[0], *words[1:], action=lambda _, path=path: read(path))
