"""Reading videos: upright frames, exact times, and what is said of files that are damaged or no videos."""

from __future__ import annotations

import numpy as np
import pytest

from indexing.video import probe, read_video
from indexing.video.reading import evenness, frame_times


def gather(video):
    chunks = list(video)
    return np.concatenate([c.frames for c in chunks]), np.concatenate([c.times for c in chunks])


def numbered(count=12, height=48, width=64):
    """Grey frames of brightness 8 i, with a white square in the upper left corner."""
    frames = np.stack([np.full((height, width), 8 * i, np.uint8) for i in range(count)])
    frames[:, :16, :16] = 255
    return frames


def test_frames_and_times_are_those_written(write):
    frames = numbered()
    video = read_video(write("a.mkv", frames, codec="ffv1", pix_fmt="gray", fps=10), chunk=5)
    got, times = gather(video)
    assert [len(c.times) for c in video] == [5, 5, 2]
    np.testing.assert_array_equal(got, frames)
    np.testing.assert_allclose(times, np.arange(12) / 10, atol=1e-9)
    assert video.notes == ()
    info = video.info
    assert (info.width, info.height, info.frames, info.rotation, info.variable, info.codec) == (64, 48, 12, 0, False, "ffv1")
    assert info.fps == pytest.approx(10) and info.duration == pytest.approx(1.1)


def test_a_stretch_of_a_video(write):
    path = write("a.mp4", numbered(30), fps=10)
    for start, stop, first, last in ((0.45, None, 5, 29), (None, 0.3, 0, 2), (1.0, 2.0, 10, 19)):
        _, times = gather(read_video(path, start=start, stop=stop))
        np.testing.assert_allclose(times, np.arange(first, last + 1) / 10, atol=1e-9)
    with pytest.raises(ValueError, match=r"no frame between 5 and inf s; its last frame is at 2\.90 s"):
        list(read_video(path, start=5))


@pytest.mark.parametrize("rotation", [0, 90, 180, -90])
@pytest.mark.parametrize("mirror", [False, True])
def test_phone_videos_are_shown_upright(write, rotation, mirror):
    frames = numbered()
    path = write("phone.mp4", frames, rotation=rotation, mirror=mirror)
    upright = np.rot90(frames, rotation // 90, axes=(1, 2))  # counter-clockwise, as PyAV's angle
    upright = upright[..., ::-1] if mirror else upright
    got, _ = gather(read_video(path))
    assert got.shape == upright.shape
    np.testing.assert_allclose(got, upright, atol=16)  # luma of video range, and compression
    info = probe(path)
    assert (info.width, info.height) == upright.shape[:0:-1] and info.mirrored == mirror
    if not mirror:
        assert info.rotation == -rotation % 360
    again = np.rot90(frames[..., ::-1] if info.mirrored else frames, -info.rotation // 90, axes=(1, 2))
    np.testing.assert_array_equal(again, upright)


@pytest.mark.parametrize("stamps", [None, [0, 33, 67, 100, 200, 233, 267, 300, 333, 400], range(500, 900, 40)])
def test_times_are_known_before_anything_is_decoded(write, stamps):
    path = write("t.mkv", numbered(10), stamps=stamps)
    info, times = frame_times(path)
    video = read_video(path)
    np.testing.assert_allclose(times, gather(video)[1], atol=1e-9)
    assert info == probe(path) == video.info and info.timed
    stored = [(frame.width, time) for frame, time in video.stored_frames()]
    assert stored == [(64, time) for time in gather(video)[1].tolist()]
    if stamps is not None:  # they start at zero whatever the container says
        np.testing.assert_allclose(times, (np.array(stamps) - stamps[0]) / 1000, atol=1e-3)
        assert info.start == pytest.approx(stamps[0] / 1000) and info.variable == (stamps[0] == 0)
    if info.variable:
        assert info.dropped == 3 and "variable frame rate" in info.notes[0]


@pytest.mark.parametrize(
    ("codec", "pix_fmt"), [("ffv1", "yuv420p10le"), ("ffv1", "bgra"), ("ffv1", "gray"), ("libx264", "yuv444p")]
)
def test_odd_sizes_deep_and_transparent_pictures(write, codec, pix_fmt):
    rng = np.random.default_rng(0)
    frames = np.repeat(np.repeat(rng.integers(30, 220, (3, 6, 8), dtype=np.uint8), 8, 1), 8, 2)[:, :47, :63]
    path = write("odd.mkv", np.repeat(frames[..., None], 3, 3), codec=codec, pix_fmt=pix_fmt)
    got, _ = gather(read_video(path))
    assert got.shape == frames.shape and got.dtype == np.uint8
    assert np.abs(got.astype(int) - frames).mean() < 3
    assert gather(read_video(path, gray=False))[0].shape == (3, 47, 63, 3)


def test_size_is_the_longest_side_or_exact(write):
    path = write("a.mp4", numbered(), rotation=-90)
    video = read_video(path, size=32)
    assert gather(video)[0].shape == (12, 32, 24) and video.scale == (0.5, 0.5)
    assert gather(read_video(path, size=500))[0].shape == (12, 64, 48)
    assert gather(read_video(path, size=(30, 20)))[0].shape == (12, 20, 30)


def test_a_file_without_times_gets_them_and_says_so(write):
    path = write("raw.h264", numbered())
    video = read_video(path, fps=25)
    np.testing.assert_allclose(gather(video)[1], np.arange(12) / 25)
    assert "no timestamps: 25 fps as given" in video.notes[0] and video.info.fps == pytest.approx(25)
    assert "30 fps assumed" in probe(path).notes[0]


@pytest.mark.parametrize("name", ["cut.mp4", "cut.mkv"])
def test_a_cut_off_file_gives_what_is_there(write, name):
    rng = np.random.default_rng(0)
    path = write(name, rng.integers(0, 255, (60, 48, 64), dtype=np.uint8), fps=10)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    video = read_video(path)
    frames, times = gather(video)
    assert 10 < len(frames) < 55 and (np.diff(times) > 0).all()
    assert any("cut off or damaged" in note for note in video.notes)
    assert any("cut off or damaged" in note for note in probe(path).notes)


def test_damage_midway_leaves_the_rest_and_evenness_is_measured(write):
    rng = np.random.default_rng(0)
    path = write("hurt.avi", rng.integers(0, 255, (40, 48, 64), dtype=np.uint8), codec="png", pix_fmt="gray", fps=10)
    data = bytearray(path.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 60] = bytes(60)
    path.write_bytes(data)
    video = read_video(path)
    frames, times = gather(video)
    assert 30 < len(frames) < 40 and times[-1] == pytest.approx(3.9)
    assert any("damaged frames are left out" in note for note in video.notes)
    even = np.arange(300) / 29.97
    assert evenness(np.round(even, 3), 0.001)[0] < 0.1  # Matroska's milliseconds are no variable rate
    off, dropped = evenness(np.delete(even, 150))
    assert off > 0.4 and dropped == 1
    assert evenness(np.cumsum(rng.uniform(0.02, 0.05, 100)))[0] > 0.1
    assert evenness(np.array([0.0, 1.0])) == (0.0, 0)


def test_what_is_no_video_is_named(write, tmp_path):
    av = pytest.importorskip("av")
    (tmp_path / "folder").mkdir()
    (tmp_path / "empty.mp4").write_bytes(b"")
    (tmp_path / "notes.txt").write_bytes(b"hello\n" * 100)
    (tmp_path / "noise.mp4").write_bytes(np.random.default_rng(0).integers(0, 256, 4000, dtype=np.uint8).tobytes())
    with av.open(str(tmp_path / "sound.wav"), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=8000)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), layout="mono")
        frame.sample_rate = 8000
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    data = write("whole.mkv", numbered()).read_bytes()
    (tmp_path / "head.mkv").write_bytes(data[: data.index(b"\x1f\x43\xb6\x75") + 20])  # up to Matroska's first cluster
    for name, what in (
        ("nothing.mp4", "no such file"),
        ("folder", "is a folder"),
        ("empty.mp4", "the file is empty"),
        ("noise.mp4", "cannot be read as video"),
        ("notes.txt", "no video stream"),
        ("sound.wav", r"no video stream \(it has: audio\)"),
        ("head.mkv", r"no frames: cut off\?"),
    ):
        for reader in (probe, lambda path: list(read_video(path))):
            with pytest.raises(ValueError, match=what) as caught:
                reader(tmp_path / name)
            assert name in str(caught.value) and "\n" not in str(caught.value)


def test_options_that_make_no_sense(write):
    path = write("a.mp4", numbered())
    for options, what in (
        ({"start": 2, "stop": 1}, "start and stop"),
        ({"start": -1}, "start and stop"),
        ({"chunk": 0}, "chunk"),
        ({"fps": 0.0}, "fps"),
        ({"size": 2}, "size"),
    ):
        with pytest.raises(ValueError, match=f"read_video: {what}"):
            read_video(path, **options)


def test_without_the_extra_the_remedy_is_named(tmp_path, monkeypatch):
    (tmp_path / "a.mp4").write_bytes(b"x")
    monkeypatch.setitem(__import__("sys").modules, "av", None)
    with pytest.raises(ValueError, match=r"install 'dyntorch\[video\]'"):
        read_video(tmp_path / "a.mp4")


def test_tags_that_are_no_text_and_codecs_that_nobody_knows(write, tmp_path):
    data = write("a.mp4", numbered()).read_bytes()
    assert data.count(b"Lavf") and data.count(b"avc1")
    path = tmp_path / "tags.mp4"
    path.write_bytes(data.replace(b"Lavf", b"\xdf\xff\xfe\xc3"))
    assert probe(path).frames == 12
    path.write_bytes(data.replace(b"avc1", b"xxxx").replace(b"avcC", b"xxxC"))
    with pytest.raises(ValueError, match=r"tags\.mp4': .*; copy it again"):
        probe(path)


def test_a_playlist_opens_no_other_file(write, tmp_path):
    film, path = write("a.mp4", numbered()), tmp_path / "list.mp4"
    for text in (
        f"ffconcat version 1.0\nfile {film}\n",
        f"#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\nhttp://127.0.0.1:9/{film}\n",
    ):
        path.write_text(text)
        with pytest.raises(ValueError, match=r"list\.mp4'"):
            probe(path)
