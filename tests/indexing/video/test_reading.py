"""Reading videos: upright frames, exact times, and what is said of files that are damaged or no videos."""

from __future__ import annotations

import numpy as np
import pytest

from indexing.video import probe, read_video
from indexing.video.reading import Orientation, evenness, frame_times


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


@pytest.mark.parametrize(("start", "stop", "first", "last"), [(0.45, None, 5, 29), (None, 0.3, 0, 2), (1.0, 2.0, 10, 19)])
def test_a_stretch_of_a_video(write, start, stop, first, last):
    path = write("a.mp4", numbered(30), fps=10)
    _, times = gather(read_video(path, start=start, stop=stop))
    np.testing.assert_allclose(times, np.arange(first, last + 1) / 10, atol=1e-9)


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


def test_all_orientations_differ():
    corner = np.arange(6).reshape(2, 3).astype(np.uint8)
    flags = (False, True)
    seen = {Orientation(t, x, y)(corner).tobytes() + bytes([t]) for t in flags for x in flags for y in flags}
    assert len(seen) == 8


def test_variable_frame_rate_keeps_its_times(write):
    stamps = [0, 33, 67, 100, 200, 233, 267, 300, 333, 400]
    path = write("v.mp4", numbered(10), stamps=stamps)
    video = read_video(path)
    np.testing.assert_allclose(gather(video)[1], np.array(stamps) / 1000, atol=1e-3)
    assert video.info.variable and video.info.dropped == 3
    assert "variable frame rate" in video.info.notes[0]


@pytest.mark.parametrize(
    "stamps", [None, [0, 33, 67, 100, 200, 233, 267, 300, 333, 400], [500, 540, 580, 620, 660, 700, 740, 780, 820, 860]]
)
def test_times_are_known_before_anything_is_decoded(write, stamps):
    path = write("t.mkv", numbered(10), stamps=stamps)
    info, times = frame_times(path)
    video = read_video(path)
    np.testing.assert_allclose(times, gather(video)[1], atol=1e-9)
    assert info == probe(path) and info.timed
    stored = [(frame.width, time) for frame, time in video.stored_frames()]
    assert stored == [(64, time) for time in gather(video)[1].tolist()]


def test_times_start_at_zero_whatever_the_container_says(write):
    path = write("late.mkv", numbered(5), stamps=[500, 540, 580, 620, 660])
    assert gather(read_video(path))[1].tolist() == pytest.approx([0, 0.04, 0.08, 0.12, 0.16])
    assert probe(path).start == pytest.approx(0.5) and not probe(path).variable


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


def test_damage_midway_leaves_the_rest(write):
    rng = np.random.default_rng(0)
    path = write("hurt.avi", rng.integers(0, 255, (40, 48, 64), dtype=np.uint8), codec="png", pix_fmt="gray", fps=10)
    data = bytearray(path.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 60] = bytes(60)
    path.write_bytes(data)
    video = read_video(path)
    frames, times = gather(video)
    assert 30 < len(frames) < 40 and times[-1] == pytest.approx(3.9)
    assert any("damaged frames are left out" in note for note in video.notes)


def bad(tmp_path, name):
    path = tmp_path / name
    if name == "folder":
        path.mkdir()
    elif name != "nothing.mp4":
        noise = np.random.default_rng(0).integers(0, 256, 4000, dtype=np.uint8).tobytes()
        path.write_bytes({"empty.mp4": b"", "notes.txt": b"hello\n" * 100}.get(name, noise))
    return path


@pytest.mark.parametrize(
    ("name", "what"),
    [
        ("nothing.mp4", "no such file"),
        ("folder", "is a folder"),
        ("empty.mp4", "the file is empty"),
        ("noise.mp4", "cannot be read as video"),
        ("notes.txt", "no video stream"),
    ],
)
def test_what_is_no_video_is_named(tmp_path, name, what):
    pytest.importorskip("av")
    path = bad(tmp_path, name)
    for reader in (probe, read_video):
        with pytest.raises(ValueError, match=what) as caught:
            reader(path)
        assert name in str(caught.value) and "\n" not in str(caught.value)


def test_sound_alone_is_no_video(tmp_path):
    av = pytest.importorskip("av")
    path = tmp_path / "sound.wav"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=8000)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), layout="mono")
        frame.sample_rate = 8000
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    with pytest.raises(ValueError, match=r"no video stream \(it has: audio\)"):
        read_video(path)


def test_frames_that_cannot_be_decoded_are_an_error(write):
    path = write("a.mkv", numbered())
    data = path.read_bytes()
    path.write_bytes(data[: data.index(b"\x1f\x43\xb6\x75") + 20])  # up to Matroska's first cluster: a header without pictures
    with pytest.raises(ValueError, match=r"no frames: cut off\?"):
        list(read_video(path))
    with pytest.raises(ValueError, match=r"no frames: cut off\?"):
        probe(path)


def test_a_stretch_beyond_the_end_is_an_error(write):
    video = read_video(write("a.mp4", numbered(), fps=10), start=5)
    with pytest.raises(ValueError, match=r"no frame between 5 and inf s; its last frame is at 1\.10 s"):
        list(video)


@pytest.mark.parametrize(
    ("options", "what"),
    [
        ({"start": 2, "stop": 1}, "start and stop"),
        ({"start": -1}, "start and stop"),
        ({"chunk": 0}, "chunk"),
        ({"fps": 0.0}, "fps"),
        ({"size": 2}, "size"),
    ],
)
def test_options_that_make_no_sense(write, options, what):
    path = write("a.mp4", numbered())
    with pytest.raises(ValueError, match=f"read_video: {what}"):
        read_video(path, **options)


def test_without_the_extra_the_remedy_is_named(tmp_path, monkeypatch):
    (tmp_path / "a.mp4").write_bytes(b"x")
    monkeypatch.setitem(__import__("sys").modules, "av", None)
    with pytest.raises(ValueError, match=r"install 'dyntorch\[video\]'"):
        read_video(tmp_path / "a.mp4")


def test_evenness():
    rng = np.random.default_rng(0)
    even = np.arange(300) / 29.97
    assert evenness(np.round(even, 3), 0.001)[0] < 0.1  # Matroska's milliseconds are no variable rate
    off, dropped = evenness(np.delete(even, 150))
    assert off > 0.4 and dropped == 1
    assert evenness(np.cumsum(rng.uniform(0.02, 0.05, 100)))[0] > 0.1
    assert evenness(np.array([0.0, 1.0])) == (0.0, 0)


def test_tags_that_are_no_text_and_codecs_that_nobody_knows(write, tmp_path):
    film = np.tile(np.arange(64, dtype=np.uint8), (10, 48, 1))
    data = write("a.mp4", film).read_bytes()
    assert data.count(b"Lavf") and data.count(b"avc1")
    path = tmp_path / "tags.mp4"
    path.write_bytes(data.replace(b"Lavf", b"\xdf\xff\xfe\xc3"))
    assert probe(path).frames == 10
    path.write_bytes(data.replace(b"avc1", b"xxxx").replace(b"avcC", b"xxxC"))
    with pytest.raises(ValueError, match=r"tags\.mp4': .*; copy it again"):
        probe(path)


def test_a_playlist_opens_no_other_file(write, tmp_path):
    film = write("a.mp4", np.tile(np.arange(64, dtype=np.uint8), (10, 48, 1)))
    for text in (
        f"ffconcat version 1.0\nfile {film}\n",
        f"#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\nhttp://127.0.0.1:9/{film}\n",
    ):
        path = tmp_path / "list.mp4"
        path.write_text(text)
        with pytest.raises(ValueError, match=r"list\.mp4'"):
            probe(path)
