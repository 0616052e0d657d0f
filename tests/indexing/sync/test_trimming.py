"""Videos cut to equal frames: a number painted in every picture says which moment it shows."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from indexing.report.sync import Clock
from indexing.sync.recordings import Take, take_of
from indexing.sync.trimming import (
    FOLDER,
    CameraVideo,
    check_videos,
    drop_videos,
    find_video,
    frame_clock,
    trim,
    trim_as_json,
    video_of,
    write_videos,
)
from tests.indexing.sync.footage import numbers_of, write_film

pytest.importorskip("av")

SCENE = 100  # numbers that the scene counts per second
CAMERAS = {"a": (30.0, 0.5, 1.0), "b": (30.0, 1.37, 1.001), "c": (25.0, 0.0, 1.0)}  # frames per second, start, rate


def moments(fps: float, start: float, rate: float, seconds: float = 3.0) -> np.ndarray:
    """Numbers of the scene at which a camera takes its frames."""
    return np.round((start + np.arange(int(seconds * fps)) / fps / rate) * SCENE).astype(np.int64)


@pytest.fixture(scope="module")
def films(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("films")
    for name, (fps, start, rate) in CAMERAS.items():
        write_film(folder / f"{name}.mp4", moments(fps, start, rate), fps)
    return folder


@pytest.fixture(scope="module")
def takes(films: Path) -> list[Take]:
    return [take_of(films / f"{name}.mp4", by="pixels") for name in CAMERAS]


def clocks(takes: list[Take]) -> list[Clock]:
    """As they are: camera time = (scene time - start) * rate, told on a's."""
    begin = CAMERAS["a"][1]
    return [Clock(take, (begin - CAMERAS[take.name][1]) * CAMERAS[take.name][2], 0.0, CAMERAS[take.name][2]) for take in takes]


def test_equal_frames_at_equal_moments(takes, tmp_path):
    films = [video_of(take) for take in takes]
    chosen = trim(films, clocks(takes))
    done: list[float] = []
    target = write_videos(tmp_path, chosen, done.append)
    shown = {name: np.array(numbers_of(target / f"{name}.mp4")) for name in CAMERAS}
    assert {len(numbers) for numbers in shown.values()} == {chosen.frames} and chosen.frames == 49
    assert (np.diff(shown["a"]) > 0).all()  # the reference's own frames
    for name, (fps, _, _) in CAMERAS.items():  # the painted numbers are rounded
        assert np.abs(shown[name] - shown["a"]).max() <= 0.5 * SCENE / fps + 1.5
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["a.mp4", "b.mp4", "c.mp4", FOLDER]
    assert done == sorted(done) and 0 < done[-1] <= 1
    said = trim_as_json(chosen)
    assert said["fps"] == 30 and said["frames"] == 49 and said["cameras"]["a"]["repeated"] == said["cameras"]["a"]["left_out"] == 0
    assert said["cameras"]["c"]["repeated"] > 0 and said["cameras"]["c"]["rest"] <= 0.5 / 25 + 1e-6
    slow = trim(films, clocks(takes), fps=15)
    write_videos(tmp_path / "slow", slow)
    numbers = [np.array(numbers_of(tmp_path / "slow" / FOLDER / f"{name}.mp4")) for name in CAMERAS]
    assert slow.fps == 15 and slow.frames in (24, 25) and {len(one) for one in numbers} == {slow.frames}
    assert np.allclose(np.diff(numbers[0]), SCENE / 15, atol=4)
    away = clocks(takes)
    away[1] = dataclasses.replace(away[1], offset=-50.0)
    with pytest.raises(ValueError, match=r"^[ac] ended 4\d\.\d\d s before b began, so no moment is in the videos of all cameras"):
        trim(films, away)


def test_a_rate_that_drifts_leaves_a_frame_out_now_and_then():
    times = np.arange(3000) / 30
    films = [CameraVideo(name, Path(name), times, times) for name in "ab"]
    a = Clock(Take("a", "video"), 0.0, 0.0)
    faster, slower = (trim(films, [a, Clock(Take("b", "video"), 0.0, 0.0, rate)]) for rate in (1.001, 0.999))
    assert faster.cuts[0].left_out == 0 and faster.cuts[1].left_out == 3 and faster.cuts[1].num_repeated == 0
    assert slower.cuts[1].num_repeated == 3 and max(cut.rest for cut in slower.cuts) <= 0.5 / 30 + 1e-9
    exact = trim([CameraVideo("a", Path("a"), times * 1.001, times * 1.001)], [a])
    assert (exact.fps.numerator, exact.fps.denominator) == (30000, 1001) and np.array_equal(exact.cuts[0].rows, np.arange(3000))


def test_a_turned_video_of_odd_size_is_written_upright(tmp_path):
    import av

    path = tmp_path / "odd.mkv"
    with av.open(str(path), "w") as file:
        stream = file.add_stream("ffv1", rate=10)
        stream.width, stream.height, stream.pix_fmt = 33, 17, "bgr0"
        for shade in range(0, 200, 20):
            image = np.full((17, 33, 3), shade, np.uint8)
            file.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        file.mux(stream.encode())
    take = take_of(path, by="pixels")
    write_videos(tmp_path, trim([video_of(take)], [Clock(take, 0.0, 0.0)]))
    with av.open(str(tmp_path / FOLDER / "odd.mp4")) as file:
        shades = [int(frame.to_ndarray(format="gray").mean()) for frame in file.decode(video=0)]
        assert (file.streams.video[0].width, file.streams.video[0].height) == (32, 16)
    assert len(shades) == 10 and np.allclose(np.diff(shades), 20, atol=5)


# ---- keypoints and the videos beside them ----------------------------------------------------------------------------------
def keypoints(films: Path, name: str = "a", fps: float = 30.0, frames: int = 80) -> Take:
    clip = take_of(np.random.default_rng(0).uniform(size=(frames, 5, 2)), name=name, fps=fps)
    return dataclasses.replace(clip, path=films / f"{name}_json")


def test_the_video_beside_keypoints_is_found(films, tmp_path):
    assert find_video(keypoints(films)) == films.resolve() / "a.mp4" and video_of(keypoints(films)).path.name == "a.mp4"
    pose = tmp_path / "pose"
    write_film(tmp_path / "videos" / "a.mp4", np.arange(3), 30)
    assert find_video(keypoints(pose)) == (tmp_path / "videos" / "a.mp4").resolve()
    with pytest.raises(ValueError, match=r"nowhere_json: no video of this camera is known: give the video itself"):
        video_of(keypoints(films, "nowhere"))


def test_the_clock_of_keypoints_counts(films):
    take = keypoints(films, fps=30.0)
    assert np.allclose(video_of(take).times, np.arange(90) / 30)
    slow = keypoints(films, fps=60.0)  # somebody said so: numbers are the clock
    film = video_of(slow)
    assert np.allclose(film.times, np.arange(90) / 60) and np.allclose(film.stamps, np.arange(90) / 30)
    with pytest.raises(ValueError, match=r"a\.mp4: has 90 frames, but there are keypoints of a up to frame 119; give the video"):
        video_of(keypoints(films, frames=120))
    lost = take.times + np.where(np.arange(80) >= 40, 0.2, 0.0)
    mended = frame_clock(take, films / "a.mp4", video_of(take).stamps, lost)
    assert np.allclose(mended - np.arange(90) / 30, np.where(np.arange(90) >= 40, 0.2, 0.0))


# ---- what is there ---------------------------------------------------------------------------------------------------------
def test_files_of_others_are_never_replaced(takes, tmp_path):
    check_videos(tmp_path, [])
    chosen = trim([video_of(take) for take in takes], clocks(takes))
    write_videos(tmp_path, chosen)
    with pytest.raises(ValueError, match=r"synchronized_videos/a\.mp4: is there, and not from this command"):
        check_videos(tmp_path, [])
    said = {"manifest": {"arguments": {"command": "sync"}}, "videos": trim_as_json(chosen)}
    (tmp_path / "sync.json").write_text(json.dumps(said))
    check_videos(tmp_path, [])
    with pytest.raises(ValueError, match=r"is an input, and .*synchronized_videos would be replaced"):
        check_videos(tmp_path, [tmp_path / FOLDER / "a.mp4"])
    (tmp_path / FOLDER / "mine.txt").write_text("mine")
    with pytest.raises(ValueError, match=r"mine\.txt: is there, and not from this command"):
        check_videos(tmp_path, [])
    assert not drop_videos(tmp_path) and (tmp_path / FOLDER / "mine.txt").exists()
    (tmp_path / FOLDER / "mine.txt").unlink()
    assert drop_videos(tmp_path) and not (tmp_path / FOLDER).exists()


def test_nothing_is_left_of_what_fails(takes, tmp_path, monkeypatch):
    chosen = trim([video_of(take) for take in takes], clocks(takes))
    monkeypatch.setattr("indexing.sync.trimming._frames", lambda cut: iter(()))
    with pytest.raises(ValueError, match=r"reading stopped at frame 0 of 49; copy it again"):
        write_videos(tmp_path, chosen)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match=r"cannot write .*synchronized_videos"):
        write_videos(tmp_path / "file", chosen)
