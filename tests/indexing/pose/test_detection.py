"""Videos of made-up people to clips: who is found, where, when, and who is who."""

from __future__ import annotations

import numpy as np
import pytest

from indexing.pose import NobodyInVideo, PoseOptions, detect, detection, keypoint_file
from indexing.pose.chunks import plan
from indexing.recordings.people import of_recording, tracked_people
from tests.indexing.pose.scene import SceneNetworks, drawn, joints_of, written

WIDTH, HEIGHT = 320, 240
SHORT = PoseOptions(chunk_seconds=0.5, lead_seconds=0.1)


def person(x, y, height, lean=0.0):
    """Hips and circle."""
    return np.array([x, y]), np.array([x + height * np.sin(lean), y - height * np.cos(lean)])


def walk(i, start=60.0, speed=4.0, height=60.0):
    """One who walks and sways."""
    return person(start + speed * i, 150 + 10 * np.sin(0.3 * i), height, 0.3 * np.sin(0.2 * i))


def film(tmp_path, scenes, name="a.mp4", **how):
    return written(tmp_path / name, [drawn(people, WIDTH, HEIGHT) for people in scenes], **how)


def error_of(clip, truth):
    """Largest distance of any joint, pixels."""
    return float(np.linalg.norm(clip.joints - np.stack([joints_of(*one) for one in truth]), axis=2).max())


def test_one_person_is_found_where_and_when_it_is(tmp_path, seeing):
    truth = [walk(i) for i in range(46)]
    clips = detect(film(tmp_path, [[one] for one in truth], fps=25))
    assert len(clips) == 1 and len(clips[0]) == 46
    (networks,) = seeing
    assert networks.looks == {"detector": 4, "landmarks": 46 + 1}  # every half second; a new person is looked at twice
    assert error_of(clips[0], truth) < 2.0
    np.testing.assert_allclose(clips[0].times, np.arange(46) / 25, atol=1e-9)
    clip = clips[0]
    assert clip.up == "-y" and clip.skeleton.name == "blazepose33" and clip.name == "a.mp4"
    assert tuple(clip.meta["size"]) == (WIDTH, HEIGHT) and clip.meta["model"] == "heavy" and "people" not in clip.meta
    np.testing.assert_allclose(clip.confidence, 1 / (1 + np.exp(-2)), atol=1e-6)
    assert of_recording(clips) and [one.name for one in tracked_people(list(clips), "a.mp4").people] == [""]


@pytest.mark.parametrize("rotation", [90, 180, -90])
def test_phone_videos_are_seen_upright(tmp_path, seeing, rotation):
    av = pytest.importorskip("av")
    if not hasattr(av.VideoStream, "set_display_rotation"):
        pytest.skip("this PyAV cannot write rotated videos")
    truth = [person(100 + i, 120, 60) for i in range(6)]
    turns = rotation // 90  # what the file asks for, counter-clockwise
    frames = [np.ascontiguousarray(np.rot90(drawn([one], WIDTH, HEIGHT), -turns)) for one in truth]
    (clip,) = detect(written(tmp_path / "phone.mp4", frames, rotation=rotation))
    assert error_of(clip, truth) < 2.0 and tuple(clip.meta["size"]) == (WIDTH, HEIGHT)


def test_variable_frame_rates_keep_their_times(tmp_path, seeing):
    stamps = [0, 33, 67, 150, 160, 400, 433, 900, 933, 1400, 1410, 1420]
    truth = [walk(i) for i in range(len(stamps))]
    (clip,) = detect(film(tmp_path, [[one] for one in truth], stamps=stamps), options=SHORT)
    np.testing.assert_allclose(clip.times, np.array(stamps) / 1000, atol=1e-6)
    assert error_of(clip, truth) < 2.0


def test_every_third_frame_is_every_third_frame_of_the_file(tmp_path, seeing):
    truth = [walk(i) for i in range(41)]
    (clip,) = detect(film(tmp_path, [[one] for one in truth]), every=3, options=SHORT)
    np.testing.assert_allclose(clip.times, np.arange(0, 41, 3) / 30, atol=1e-4)
    assert error_of(clip, truth[::3]) < 2.0 and clip.meta["every"] == 3


@pytest.mark.slow
def test_the_result_does_not_depend_on_who_works_nor_much_on_the_pieces(tmp_path, seeing):
    path = film(tmp_path, [[walk(i, speed=2.0), person(280, 200, 45)] for i in range(60)], gop=7)
    shares: list[float] = []
    one = detect(path, people=2, options=SHORT)
    other = detect(path, people=2, workers=3, options=SHORT, progress=shares.append)
    assert len(one) == len(other) == 2
    for a, b in zip(one, other, strict=True):
        assert a.joints.tobytes() == b.joints.tobytes() and a.times.tobytes() == b.times.tobytes() and a.meta == b.meta
    assert len(one[0]) == 60 and shares == sorted(shares) and shares[-1] == 1.0
    for whole, cut in zip(detect(path, people=2), one, strict=True):
        np.testing.assert_array_equal(whole.times, cut.times)
        np.testing.assert_allclose(whole.joints, cut.joints, atol=1.5)


@pytest.mark.parametrize("people", [1, 2])
def test_joints_outside_of_the_picture_are_nobodys(tmp_path, seeing, people):
    truth = [person(12 + i, 150, 70) for i in range(10)]
    (clip,) = detect(film(tmp_path, [[one] for one in truth]), people=people)
    places = np.stack([joints_of(*one) for one in truth])
    inside, outside = places[..., 0] > 2, places[..., 0] < -2
    assert inside.any(axis=1).all() and outside.any(axis=1).all()
    assert np.isnan(clip.joints[outside]).all() and (clip.confidence[outside] == 0).all()
    assert np.linalg.norm((clip.joints - places)[inside], axis=1).max() < 2 and (clip.confidence[inside] > 0.5).all()


def test_work_side_by_side_gives_the_threads_of_opencv_back(monkeypatch):
    class Counting:
        threads = 8

        def getNumThreads(self):
            return self.threads

        def setNumThreads(self, number):
            self.threads = number

    counting = Counting()
    monkeypatch.setattr(detection, "cv2", lambda: counting)
    alone = type(detection.SINGLE_THREADED)()  # that of the process may be kept by work that another test left
    one, other = alone.hold(), alone.hold()
    one.__enter__()
    other.__enter__()
    assert counting.threads == 1
    one.__exit__(None, None, None)
    assert counting.threads == 1  # the other one works on
    other.__exit__(None, None, None)
    assert counting.threads == 8


@pytest.mark.slow
def test_several_people_are_the_largest_first_and_each_once(tmp_path, seeing):
    scenes = [[person(50 + i, 180, 40), person(160, 160, 80 + 0.1 * i), person(280 - i, 190, 50)] for i in range(30)]
    clips = detect(film(tmp_path, scenes), people=5)
    assert len(clips) == 3 and [clip.meta["person"] for clip in clips] == [1, 2, 3]
    for clip, which in zip(clips, (1, 2, 0), strict=True):
        assert error_of(clip, [scene[which] for scene in scenes]) < 2.5
    crowd = tracked_people(list(clips), "a.mp4")
    assert [one.name for one in crowd.people] == ["1", "2", "3"] and crowd.by_ids


def test_one_of_several_is_the_largest_and_the_others_are_said(tmp_path, seeing):
    scenes = [[person(60, 180, 40), person(200 + i, 160, 80)] for i in range(30)]
    (clip,) = detect(film(tmp_path, scenes))
    assert error_of(clip, [scene[1] for scene in scenes]) < 2.5
    assert clip.meta["people"] == 2


@pytest.mark.slow
def test_a_larger_person_who_comes_later_takes_over(tmp_path, seeing):
    scenes = [[person(60, 180, 40)] + ([person(320 - 3 * i, 170, 90)] if i >= 20 else []) for i in range(80)]
    (clip,) = detect(film(tmp_path, scenes))
    assert np.linalg.norm(clip.joints[5] - joints_of(*scenes[5][0]), axis=1).max() < 2
    assert error_of(clip.between(40 / 30, 9), [scene[1] for scene in scenes[40:]]) < 3


@pytest.mark.slow
def test_people_who_pass_each_other_keep_their_names(tmp_path, seeing):
    scenes = [[person(30 + 5 * i, 80, 40), person(290 - 5 * i, 210, 50)] for i in range(50)]
    clips = detect(film(tmp_path, scenes), people=2)
    assert len(clips) == 2
    assert error_of(clips[0], [scene[1] for scene in scenes]) < 2.5
    assert error_of(clips[1], [scene[0] for scene in scenes]) < 2.5


@pytest.mark.slow
@pytest.mark.parametrize(("gone", "back", "names"), [(10, 140, 1), (80, 140, 2), (10, 280, 2)])
def test_who_is_lost_is_the_same_where_it_returns_soon_and_nearby(tmp_path, seeing, gone, back, names):
    still = person(40, 200, 40)
    scenes = [[still] + ([person(140 if i < 20 else back, 150, 60)] if not 20 <= i < 20 + gone else []) for i in range(40 + gone)]
    clips = detect(film(tmp_path, scenes), people=2)
    assert len(clips) == 1 + names
    with_all = next(clip for clip in clips if len(clip) == len(scenes) and abs(np.nanmean(clip.joints[..., 0]) - 40) < 25)
    assert error_of(with_all, [scene[0] for scene in scenes]) < 2.5
    if names == 1:
        (other,) = (clip for clip in clips if clip is not with_all)
        assert np.isnan(other.joints[21:29]).all() and (other.confidence[21:29] == 0).all() and len(other) == 50


@pytest.mark.slow
def test_two_tracks_never_sit_on_one_person(tmp_path, seeing):
    """Two people become one: the front one hides the other."""
    scenes = [[person(100 + 2 * i, 150, 60), *([person(200, 150, 60)] if i < 20 else [])] for i in range(60)]
    clips = detect(film(tmp_path, scenes), people=2)
    times = [set(np.round(clip.times[clip.seen.any(axis=1)], 4)) for clip in clips]
    assert len(clips) == 2 and max(times[0] & times[1]) < 21 / 30


def test_small_people_are_found_by_looking_closer(tmp_path, seeing, monkeypatch):
    seen = SceneNetworks.detector

    def blind_to_small(self, image):
        raw, logits = seen(self, image)
        tiny = np.linalg.norm(raw[:, 6:8] - raw[:, 4:6], axis=1) < 25  # pixels of what the network sees
        return raw, np.where(tiny, -20, logits)

    monkeypatch.setattr(SceneNetworks, "detector", blind_to_small)
    truth = [person(200 + i, 150, 30) for i in range(20)]
    path = film(tmp_path, [[one] for one in truth])
    (clip,) = detect(path)
    assert error_of(clip, truth) < 2.5
    with pytest.raises(NobodyInVideo):
        detect(path, options=PoseOptions(zooms=(1,), farther_zooms=()))


def test_nobody_in_a_video_is_one_line(tmp_path, seeing):
    path = film(tmp_path, [[]] * 12)
    with pytest.raises(NobodyInVideo, match=r"a\.mp4: no person was found in any of its 12 frames; ") as caught:
        detect(path)
    assert "\n" not in str(caught.value) and isinstance(caught.value, ValueError) and len(caught.value.times) == 12
    path = film(tmp_path, [[walk(i)] for i in range(10)])
    with pytest.raises(NobodyInVideo):
        detect(path, options=PoseOptions(min_score=0.99, min_closer_score=0.99))


@pytest.mark.slow
def test_a_file_that_ends_early_gives_what_is_there(tmp_path, seeing):
    pytest.importorskip("av")
    path = film(tmp_path, [[walk(i)] for i in range(90)], name="a.mkv")
    whole = path.read_bytes()
    cut = tmp_path / "cut.mkv"
    cut.write_bytes(whole[: int(0.6 * len(whole))])
    (clip,) = detect(cut, options=SHORT)
    assert 20 < len(clip) < 80 and clip.seen.all()


def test_what_is_no_video_is_said(tmp_path, seeing):
    path = tmp_path / "a.mp4"
    for content, said in ((None, "no such file"), (b"", "is empty"), (b"no" * 999, "cannot be read as video|has no video stream")):
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(ValueError, match=said) as caught:
            detect(path)
        assert "a.mp4" in str(caught.value) and "\n" not in str(caught.value)


def test_numbers_that_make_no_sense(tmp_path, seeing):
    for name, value in (("people", 0), ("people", 1.5), ("every", 0), ("workers", 0), ("people", True)):
        with pytest.raises(ValueError, match=f"detect: {name} must be a whole number from 1"):
            detect("a.mp4", **{name: value})
    path = film(tmp_path, [[walk(i)] for i in range(5)])
    for fps in (0, -1, float("nan"), float("inf"), "30", True):
        for verb in (detect, lambda path, **how: keypoint_file(path, tmp_path / "pose", **how)):
            with pytest.raises(ValueError, match="detect: fps must be a positive number of frames per second, got") as caught:
                verb(path, fps=fps)
            assert "\n" not in str(caught.value)
        with pytest.raises(ValueError, match=r"a\.mp4: fps must be a positive number"):
            plan(path, 1, 1, fps, "heavy", SHORT)
    assert not seeing and not (tmp_path / "pose").exists()


def test_an_interruption_ends_the_work(tmp_path, seeing):
    def interrupt(share):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        detect(film(tmp_path, [[walk(i)] for i in range(60)]), options=SHORT, progress=interrupt)
