"""indexing.synchronize: what is read, who is compared, by which method, and what is said about it."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import dyntorch
from dyntorch import Status
from dyntorch.core import Notice, NoticeCode
from indexing.cameras import rotation
from indexing.cli import main
from indexing.clip import Clip, ClipSet
from indexing.skeleton import HALPE26, Skeleton
from indexing.sync.people import Pairing, common_joints
from indexing.sync.recordings import SyncOptions, take_of
from indexing.sync.synchronize import combine_methods, find_breaks, recording_notices, retime, synchronize
from indexing.sync.trimming import FOLDER
from tests.grid import grid
from tests.indexing.sync.footage import numbers_of, write_film
from tests.indexing.sync.scene import FPS, SKIPPED, cut, filmed, moved, shift, told, write_openpose

# torch's own, when it first loads its transforms; hidden outside of tests
pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated")


DEEP = Clip(np.zeros((3, 4, 3)), name="deep")


# ---- what goes in --------------------------------------------------------------------------------------------------------
def test_clips_arrays_and_files_ask_the_same(cameras, library, tmp_path):
    first, second = cameras[:2]
    folders = [write_openpose(tmp_path / f"cam{i}_json", [clip]) for i, clip in enumerate((first, second), start=1)]
    found = [synchronize(first, second), synchronize(*folders, fps=FPS), synchronize(first.joints, second.joints, fps=(FPS, FPS))]
    for i in (1, 2):
        for name in ("a", "b"):
            assert torch.allclose(library[0][name], library[i][name], equal_nan=True) and library[i][name].dtype == torch.float64
        assert all(torch.allclose(*times) for times in zip(library[0]["times"], library[i]["times"], strict=True))
        assert library[i]["correspondence"] and library[i]["max_shift"] is None and library[i]["calibration"] is None
    weights = library[1]["weights"]
    assert [w.shape for w in weights] == [first.joints.shape[:2], second.joints.shape[:2]] and library[2]["weights"] is None
    assert torch.equal(weights[0] > 0, torch.from_numpy(first.seen)) and torch.allclose(weights[0], library[0]["weights"][0])
    assert not any(one.notes for one in found)


def test_missing_frames_and_frames_without_a_person_keep_the_times_of_the_others(cameras, library, tmp_path):
    write_openpose(tmp_path / "a", [cameras[0]], missing=(3, 4, 5))
    notes = synchronize(tmp_path / "a", cameras[1], fps=FPS).notes
    assert notes == (f"a: 3 of {len(cameras[0])} frames are missing; the others keep their times",)
    times = library[0]["times"][0]
    assert len(times) == len(cameras[0]) - 3 and times[3].item() == pytest.approx(6 / FPS)
    every_second = np.where(np.arange(len(cameras[0]))[:, None, None] % 2, np.nan, cameras[0].joints)
    write_openpose(tmp_path / "b", [cameras[0].replace(joints=every_second, confidence=None)])
    assert synchronize(tmp_path / "b", cameras[1], fps=FPS).notes == ("b: 50 % of the frames show nobody",)


def test_rates_that_nobody_said_and_one_recording_twice_are_mentioned(cameras, library, tmp_path):
    folder = write_openpose(tmp_path / "cam1_json", [cameras[0]])
    notes = synchronize(folder, cameras[0].joints, fps=(None, 25.0)).notes
    assert notes[0] == "30 frames per second assumed for cam1; fps= says otherwise"
    takes = [take_of(np.full((5, 3, 2), float(i)), name=f"c{i}", fps=None if i else 25.0) for i in range(3)]
    assert [note.text for note in recording_notices(takes)] == ["30 frames per second assumed for c1, c2; fps= says otherwise"]
    assert synchronize(folder, folder, fps=FPS).notes == ("cam1 and cam1 are the same recording",)
    assert synchronize(cameras[0], cameras[0]).notes == ("cam1 and cam1 are the same recording",)
    assert synchronize(cameras[0].joints, cameras[0].joints.copy(), fps=FPS).notes == ("a and b are the same recording",)


def test_layouts_that_differ_and_options_reach_the_library(cameras, library):
    a, b = (clip.joints for clip in cameras[:2])
    more = np.concatenate([b, np.full((len(b), 9, 2), 5.0)], axis=1)
    halpe = Clip(more, fps=FPS, skeleton=HALPE26, name="halpe")
    note = "COCO-17 and Halpe-26 share 17 joints; these are compared"
    assert synchronize(cameras[0], halpe).notes == (note,) and library[0]["b"].shape[1] == 17 and library[0]["correspondence"]
    other = Clip(b[:, :7], fps=FPS, skeleton=Skeleton("dots", tuple("abcdefg")))
    notes = synchronize(cameras[0], other).notes
    assert not library[1]["correspondence"] and library[1]["a"].shape[1] == 17 and library[1]["b"].shape[1] == 7
    assert notes == ("different joints (COCO-17, dots): compared as different points, which needs longer takes",)
    with pytest.raises(ValueError, match=r"correspondence=True needs the same joints in both, got 17 and 7"):
        synchronize(cameras[0], other, correspondence=True)
    given = {"max_shift": 1.5, "calibration": (None, None), "correspondence": False}
    synchronize(a, b, fps=(30, 60), options=SyncOptions(min_margin=0.7), **given)
    assert library[2]["times"][1][1].item() == pytest.approx(1 / 60) and {name: library[2][name] for name in given} == given
    assert library[2]["options"] == dyntorch.SynchronizeOptions(min_margin=0.7)
    with pytest.raises(ValueError, match="30 frames, 40 are needed"):
        synchronize(a[:30], b, fps=30.0, options=SyncOptions(min_frames=40))
    with pytest.raises(ValueError, match="options must be SyncOptions"):
        synchronize(a, b, fps=30.0, options=dyntorch.SynchronizeOptions())


@pytest.fixture(scope="module")
def recorded(cameras, tmp_path_factory):
    """A folder of keypoints, one that shows nobody, and a broken video."""
    folder = tmp_path_factory.mktemp("recorded")
    write_openpose(folder / "cam1", [cameras[0]])
    write_openpose(folder / "empty", [cut(cameras[0], 0, 5).replace(joints=np.full((5, 17, 2), np.nan), confidence=None)])
    (folder / "broken.mp4").write_bytes(b"\0\0\0\x18ftypmp42" + bytes(200))
    return folder


@grid(
    (
        ("a", "options", "says"),
        [
            ("no.json", {}, r"no\.json: no such file or folder"),
            ("empty", {}, r"empty: no person was detected in any of 5 frames"),
            ("cam1", {"method": "brightness"}, r"cam1: holds keypoints, and method='brightness' needs videos"),
            ("cam1", {"method": "guess"}, r"method must be one of auto, keypoints, tracks, brightness, sound, got 'guess'"),
            ("cam1", {"fps": 0}, r"fps must be a positive number of frames per second, got 0"),
            ("cam1", {"fps": (1, 2, 3)}, r"fps must be one number, or one for each of two cameras"),
            ("cam1", {"person": "me"}, r"person must be one of auto, largest, confident, tracked, got 'me'"),
            ("no.mp4", {}, r"no\.mp4'?: no such file"),
            ("broken.mp4", {}, r"broken\.mp4"),
            (np.zeros((4, 5)), {}, r"a: expected keypoints \(frames, joints, 2\), motion capture \(frames, markers, 3\) or gray"),
            (np.zeros((4, 5, 3)), {}, r"a: 4 frames, 12 are needed"),
            ([["a"]], {}, r"a: expected a clip, a path or an array, got list"),
            (DEEP, {}, r"deep: 3 frames, 12 are needed"),
            ([DEEP, Clip(np.zeros((3, 4, 2)))], {}, r"a: holds 2D and 3D joints"),
        ],
    )
)
def test_bad_input_is_one_line(recorded, cameras, library, a, options, says):
    with pytest.raises(ValueError, match=says) as caught:
        synchronize(recorded / a if isinstance(a, str) else a, cameras[1], **options)
    assert "\n" not in str(caught.value) and not library


# What synchronize() says of recordings that are read without an error and still are not what they seem.


STRETCHED = "coordinates from 0 to 1, so the shape of the image is not known and people may be stretched; give size="


@pytest.mark.slow
def test_somebody_else_in_view_is_said_where_one_is_followed(cameras, tmp_path):
    small = cut(cameras[0], 0, 25)
    small = small.replace(joints=small.joints / 4 + 900.0)  # too short in view to be tried, and too long to be a ghost
    folder = write_openpose(tmp_path / "cam1_json", [cameras[0], small])
    said = "cam1: 2 people in view; compared is the largest; person= says otherwise"
    assert said in take_of(folder, fps=FPS).notes and said in take_of(folder, fps=FPS, person="largest").notes
    sure = take_of(folder, fps=FPS, person="confident").notes
    assert any("compared is the one that the detector trusts most" in note for note in sure)
    alone = write_openpose(tmp_path / "cam2_json", [cameras[0]])
    assert take_of(alone, fps=FPS).notes == take_of(alone, fps=FPS, person="largest").notes == ()
    both = take_of(write_openpose(tmp_path / "cam3_json", [cameras[0], moved(cameras[0], 900.0)]), fps=FPS)
    assert len(both.people) > 1 and not any("people in view" in note for note in both.notes)  # the pairing that is taken is said


def test_the_shape_of_the_image_is_not_known(cameras, tmp_path):
    a, b = ((clip.replace(joints=clip.joints / [1920, 1080], up="-y")) for clip in cameras[:2])
    found = synchronize(a, b)
    assert [one.text for one in found.notices if STRETCHED in one.text] == [f"{a.name}: {STRETCHED}", f"{b.name}: {STRETCHED}"]
    lens = (np.eye(3), np.zeros(5))
    with pytest.raises(ValueError, match=r"cam1: its coordinates go from 0 to 1, and calibration= is of pixels; give size="):
        synchronize(a, b, calibration=(lens, lens))
    ClipSet([a]).save(tmp_path / "a.npz")
    assert any(STRETCHED in note for note in take_of(tmp_path / "a.npz").notes)


def test_layouts_are_matched_by_what_joints_are_called_whatever_the_spelling_and_order(cameras):
    names = [f"{side}{part}" for part in ("Shoulder", "Elbow", "Wrist", "Hip", "Knee", "Ankle") for side in "LR"]
    other = [name for part in ("shoulder", "elbow", "wrist", "hip", "knee") for name in (f"right_{part}", f"left_{part}")]
    a = Clip(cameras[0].joints[:, :12], skeleton=Skeleton("short", tuple(names)))
    b = Clip(cameras[1].joints[:, :10], skeleton=Skeleton("long", tuple(other)))
    first, second, same, said = common_joints(a, b)
    assert same and said == "short and long share 10 joints; these are compared"
    assert first.skeleton == second.skeleton and first.skeleton.joints == tuple(names[:10])
    assert np.array_equal(first.joints, a.joints[:, :10], equal_nan=True)
    assert np.array_equal(second.joints, b.joints[:, [1, 0, 3, 2, 5, 4, 7, 6, 9, 8]], equal_nan=True)
    numbers = Skeleton("numbers", tuple(map(str, range(12))))
    assert common_joints(a, Clip(a.joints, skeleton=numbers))[2] is False


@pytest.mark.parametrize(("head", "row"), [("frame,x,y", "{i},"), ("time,x,y", "{t},"), ("frame,x,y,score", "{i},")])
def test_one_tracked_point_is_a_track(tmp_path, head, row):
    rng = np.random.default_rng(3)
    way = np.cumsum(np.cumsum(rng.normal(size=(420, 3)), axis=0) * 0.03, axis=0)
    way = 5 * (way - way.mean(axis=0)) / way.std() + [0, 0, 40]
    for name, turn, skip in (("a", 0.0, 0), ("b", 0.6, 24)):
        place = way @ rotation(-turn, 0.0).T + [0, 0, 40 * (turn > 0)]
        seen = 1000 * place[:, :2] / place[:, 2:] + 500 + rng.normal(size=(420, 2)) * 0.3
        last = ",0.9" if "score" in head else ""
        lines = [f"{row.format(i=i, t=i / 30)}{x:.3f},{y:.3f}{last}" for i, (x, y) in enumerate(seen[skip : skip + 390])]
        (tmp_path / f"{name}.csv").write_text("\n".join([head, *lines]))
    takes = [take_of(tmp_path / f"{name}.csv", fps=30.0) for name in "ab"]
    assert [take.count for take in takes] == [390, 390] and [len(take.people) for take in takes] == [1, 1]
    assert synchronize(*takes, rate=1.0).frames == pytest.approx(-24, abs=0.5)


def test_frame_numbers_of_a_file_are_its_times(cameras, tmp_path):
    a, b = cameras[:2]
    assert synchronize(a, b).ok and synchronize(a, b).frames == pytest.approx(SKIPPED[0] - SKIPPED[1], abs=0.5)
    kept = np.setdiff1d(np.arange(len(b)), np.arange(30, 50))
    np.savez(tmp_path / "b.npz", joints=b.joints[kept], frame=kept + 100, fps=FPS)
    take = take_of(tmp_path / "b.npz")
    assert np.allclose(take.times, (kept + 100) / FPS) and take.fps == pytest.approx(FPS)
    assert "b: 20 of" in take.notes[-1] and "frames are missing; the others keep their times" in take.notes[-1]
    found = synchronize(a, tmp_path / "b.npz")
    assert found.ok and found.offset == pytest.approx((100 - 12) / FPS, abs=0.5 / FPS)


# Tracks and brightness, each a check of the other.


def test_two_methods_that_agree_decide_and_two_that_do_not_refuse():
    def unsure(one, **said):
        return dataclasses.replace(one, **told({"ok": False, **said}))

    tracks, bright = shift(0.5, method="subspace", confidence=0.9), shift(0.52, method="brightness", confidence=0.8)
    away, differ = shift(2.5, method="brightness", confidence=0.99), unsure(bright, reason="halves differ")
    agreed = combine_methods(tracks, bright)
    assert agreed.ok and agreed.method == "subspace" and agreed.offset == 0.5
    assert combine_methods(tracks, differ).ok and combine_methods(unsure(tracks), bright).method == "brightness"
    refused = combine_methods(tracks, away)
    assert not refused.ok and "tracks say +0.500 s (sure), brightness says +2.500 s (sure)" in refused.reason
    assert refused.peaks[:, 0].tolist() == pytest.approx([0.5, 1.6, 2.5, 3.6])
    assert not combine_methods(tracks, unsure(away)).ok
    both = combine_methods(unsure(tracks, reason="too still"), differ)
    assert not both.ok and both.reason == "neither tracks nor brightness decide: too still; halves differ"


@pytest.fixture
def methods(monkeypatch, library):
    """Tracks and brightness, known: tracks of the values' first ``n`` points, brightness at +0.5 s."""
    asked: dict = {"tracks": [], "brightness": [], "count": 12}

    def tracks(source, **_):
        asked["tracks"].append(source)
        points = torch.zeros(60, asked["count"], 2, dtype=torch.float64)
        return SimpleNamespace(points=points, times=torch.arange(60) / FPS, notes=("camera stands still",))

    def bright(a, b, **options):
        asked["brightness"].append((a, b, options))
        if asked.get("short"):
            raise ValueError("a: 5 frames are too few")
        return shift(-0.41, method="brightness", notes=("b: dark",))

    monkeypatch.setattr("indexing.sync.synchronize.track_points", tracks)
    monkeypatch.setattr("indexing.sync.synchronize.brightness_shift", bright)
    return asked


GRAY = np.random.default_rng(0).uniform(size=(60, 24, 32))


def test_gray_frames_by_every_method(methods, library, cameras):
    found = synchronize(cameras[0], GRAY, fps=FPS)  # keypoints and a video are different points
    assert not library[0]["correspondence"] and library[0]["a"].shape[1] == 17 and library[0]["b"].shape[1] == 12
    assert found.ok and not methods["brightness"] and len(methods["tracks"]) == 1
    with pytest.raises(ValueError, match=r"b: is a video, and method='keypoints' needs keypoints"):
        synchronize(cameras[0], GRAY, "keypoints", fps=FPS)
    found = synchronize(GRAY, GRAY[5:] * 255, "tracks", fps=FPS, max_shift=1.0)
    assert found.notes == ("a: camera stands still", "b: camera stands still") and not library[1]["correspondence"]
    assert library[1]["a"].shape == (60, 12, 2) and library[1]["max_shift"] == 1.0 and not methods["brightness"]
    [chunk] = methods["tracks"][1]
    assert chunk.frames.dtype == np.uint8 and np.array_equal(chunk.times, np.arange(60) / FPS)
    assert np.array_equal(chunk.frames[5:], methods["tracks"][2][0].frames)  # 0 to 1 and 0 to 255 are the same picture
    found = synchronize(GRAY, GRAY[5:], "brightness", fps=FPS, max_shift=1.0)
    assert found.method == "brightness" and found.notes == ("b: dark",) and methods["brightness"][0][2]["max_shift"] == 1.0
    assert len(next(methods["brightness"][0][0]).frames) == 60
    found = synchronize(GRAY, GRAY[5:], fps=FPS)
    assert found.ok and found.offset == -0.4 and "brightness says -0.410 s (sure)" in found.notes[0]
    methods["short"] = True  # too short for brightness, which leaves the tracks unconfirmed
    found = synchronize(GRAY, GRAY[5:], fps=FPS)
    assert not found.ok and "brightness says" in found.reason
    with pytest.raises(ValueError, match=r"too few"):
        synchronize(GRAY, GRAY[5:], "brightness", fps=FPS)
    methods["count"] = 3
    found = synchronize(GRAY, GRAY[5:], "tracks", fps=FPS)
    assert not found.ok and "fewer than 4 moving points could be followed in a and b" in found.reason
    assert len(found.peaks) == len(found.scores) == 0 and found.confidence == 0


LOST, AT = 6, 60  # frames, and the first that is later than its number says


class Broke(NoticeCode):
    LOST = "lost", "{camera:1} lost {value:g} frames"
    OPEN = "open", "not decided", Status.AMBIGUOUS


def broken_clocks(times, jump=LOST / FPS):
    """What the breaks_library says: b lost frames."""
    later = [times[0], times[1] + jump * (torch.arange(len(times[1])) >= AT)]
    one = SimpleNamespace(
        camera=None, candidates=(1, 0), moments=(2.0, 2.1), sigma=0.02, jump=-jump, jump_sigma=0.001, frames=LOST, is_doubled=False,
        evidence=90.0, residuals=(9.0, 2.0),
    )  # fmt: skip
    notice = Notice(Broke.LOST, float(LOST))
    return dataclasses.replace(_Breaks(), breaks=(one,), times=tuple(later), notices=(notice,))


@dataclasses.dataclass(frozen=True)
class _Breaks:
    breaks: tuple = ()
    times: tuple = ()
    notices: tuple = ()
    ok: bool = True


@pytest.fixture
def breaks_library(monkeypatch):
    """A shift of nothing, and a break of b, of three cameras known by one pair alone; records how it was asked."""
    asked: dict = {"times": []}

    def breaks(a, b, first=None, *, times, **given):
        asked.update(given, shapes=(a.shape, b.shape))
        return asked.get("says", broken_clocks)(times)

    def camera_breaks(tracks, clocks, *, times, **_):
        found = asked.get("says", broken_clocks)(times)
        return dataclasses.replace(found, times=(*found.times, times[2]))

    def answer(a, b, *, times, **_):
        asked["times"].append(times)
        return shift(0.0)

    monkeypatch.setattr(dyntorch.tasks, "breaks", breaks, raising=False)
    monkeypatch.setattr(dyntorch.tasks, "camera_breaks", camera_breaks, raising=False)
    monkeypatch.setattr(dyntorch, "synchronize", answer, raising=False)
    monkeypatch.setattr("indexing.report.sync.picture_of", lambda report: b"\x89PNG".ljust(16, b"\0") + bytes([0, 0, 0, 9]) * 2)
    return asked


@pytest.fixture(scope="module")
def clips():
    return [cut(clip, 0, 120) for clip in filmed()[:2]]


def test_takes_get_the_times_of_their_frames(breaks_library, clips):
    takes = [take_of(clip, name=name) for clip, name in zip(clips, ("left", "right"), strict=True)]
    pairs = {(0, 1): Pairing(shift(0.0), (0, 0))}
    found = find_breaks(takes, pairs, max_shift=3.0)
    assert found is not None and breaks_library["max_shift"] == 3.0
    assert breaks_library["shapes"] == tuple(clip.joints.shape for clip in clips)
    left, right = found.takes
    assert left is takes[0] and np.allclose(np.diff(right.times)[AT - 1], (1 + LOST) / FPS)
    assert np.array_equal(right.people[0].times, right.times) and str(found.found.notices[0].text) == "right lost 6 frames"
    [said] = found.as_json()
    assert said["candidates"] == ["right", "left"] and said["camera"] is None and said["frames"] == LOST
    json.dumps(said)
    for says in (lambda times: _Breaks(times=tuple(times)), lambda times: dataclasses.replace(broken_clocks(times), ok=False)):
        breaks_library["says"] = says  # where nothing broke
        assert find_breaks(takes, pairs) is None
    other = take_of(np.random.default_rng(0).uniform(size=(120, 7, 2)), name="other", fps=FPS)
    for nothing in (other, dataclasses.replace(other, kind="video", people=())):  # nor where nothing tells
        assert find_breaks([takes[0], nothing], pairs) is None


def test_people_who_are_seen_in_some_frames_only(clips):
    take = take_of(clips[0], name="left")
    late = clips[0].replace(joints=clips[0].joints[30:], times=clips[0].times[30:], confidence=clips[0].confidence[30:])
    both = dataclasses.replace(take, people=(late,), everyone=(late, clips[0]))
    moved = retime(both, late.times, np.where(np.arange(90) >= 30, 0.5, 0.0))
    assert moved.people[0] is moved.everyone[0] and np.allclose(moved.times[[29, 59, 60]], [29 / FPS, 59 / FPS, 2.5])
    assert np.allclose(moved.everyone[1].times, moved.times)


@pytest.mark.slow
def test_what_is_written_is_in_step(breaks_library, clips, tmp_path, capsys):
    pytest.importorskip("av")
    kept = np.delete(np.arange(120 + LOST), np.arange(AT, AT + LOST))  # numbers of the scene that b took
    for name, numbers, clip in (("a", np.arange(120), clips[0]), ("b", kept, clips[1])):
        write_openpose(tmp_path / f"{name}_json", [clip])
        write_film(tmp_path / f"{name}.mp4", numbers, FPS)
    line = ["sync", str(tmp_path / "a_json"), str(tmp_path / "b_json"), "--fps", "30", "--videos", "--out", str(tmp_path / "out")]
    assert main(line) == 0
    out = capsys.readouterr().out
    assert "note: b lost 6 frames" in out and "as if no frame had been lost" in out and "2 videos of 120 frames" in out
    assert [times[1][-1].item() for times in breaks_library["times"]] == pytest.approx([119 / FPS, 125 / FPS])  # compared again
    first, second = (numbers_of(tmp_path / "out" / FOLDER / f"{name}.mp4") for name in "ab")
    gap, edges = set(range(AT, AT + LOST)), {AT - 1, AT + LOST}
    assert first == list(range(120)) and [n for n in second if n not in edges] == sorted(set(range(120)) - gap - edges)
    names = {int(file.name.split("_")[2]): file for file in Path(tmp_path, "out/pose-sync/b_json").iterdir()}
    assert gap & set(names) <= {AT, AT + LOST - 1}
    source = tmp_path / "b_json" / f"b_json_{AT:012d}_keypoints.json"
    assert names[AT + LOST].read_text() == source.read_text()
    said = json.loads((tmp_path / "out" / "sync.json").read_text())
    assert [one["frames"] for one in said["breaks"]] == [LOST] and said["cameras"][1]["end"] == pytest.approx(119 / FPS)
    assert main([*line, "--no-breaks"]) == 0
    assert json.loads((tmp_path / "out" / "sync.json").read_text())["breaks"] == []


@pytest.mark.slow
def test_a_break_that_nothing_confirms_is_said_and_not_mended(breaks_library, clips, tmp_path, monkeypatch, capsys):
    for name in "abc":
        write_openpose(tmp_path / "pose" / f"{name}_json", [clips[0]])
    line = ["sync", str(tmp_path / "pose"), "--fps", "30", "--out", str(tmp_path / "out")]
    assert main(line) == 0
    out = capsys.readouterr().out
    assert "note: doubtful, and not mended, as other pairs of these cameras see nothing of it: b lost 6 frames" in out
    assert json.loads((tmp_path / "out" / "sync.json").read_text())["breaks"] == [] and len(breaks_library["times"]) == 3

    def known(times):
        found = broken_clocks(times)
        found.breaks[0].camera, found.breaks[0].candidates, found.breaks[0].moments = 1, (1,), (2.0,)
        return found

    breaks_library["says"] = known
    assert main(line) == 0 and "note: b lost 6 frames" in capsys.readouterr().out
    [said] = json.loads((tmp_path / "out" / "sync.json").read_text())["breaks"]
    assert said["camera"] == "b" and len(breaks_library["times"]) == 9
    decided = {True: 3, False: 1}  # before, and mended
    monkeypatch.setattr("indexing.report.sync.SyncReport.num_decided", property(lambda one: decided[one.takes[1].times[-1] < 4.1]))
    assert main(line) == 0 and "as fewer pairs decide when it is mended: b lost 6 frames" in capsys.readouterr().out
