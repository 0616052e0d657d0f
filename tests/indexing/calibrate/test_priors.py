"""What is known of lenses and clocks: focal lengths, files, what phones write, and what is done with them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from indexing.actors import Person, perform
from indexing.calibrate.priors import DIAGONAL, check_height, focal_35, given_clocks, known_lenses, standing_extent
from indexing.skeleton import BODY25, BODY25B, COCO17, HAND21, MEDIAPIPE33
from indexing.sync.recordings import take_of
from tests.indexing.calibrate.scene import SIZE, clocks_of, filmed, write_cameras

SIZES = [SIZE] * 3
TAKES = [take_of(own, name=f"cam{i}") for i, own in enumerate(filmed(), start=1)]


def section(name, fx=1500.0, fy=1480.0, cx=950.0, cy=545.0, bent="[-0.1, 0.02, 0.001, -0.002]", more=""):
    return f"[{name}]\nmatrix = [[{fx}, 0, {cx}], [0, {fy}, {cy}], [0, 0, 1]]\ndistortions = {bent}\n{more}\n"


def test_focal_lengths():
    assert known_lenses(TAKES, SIZES).focals is None and known_lenses(TAKES, SIZES, focal=1500).focals == (1500,) * 3
    several = known_lenses(TAKES, SIZES, focal=[1, 1500, 1600])
    assert several.focals == (1, 1500, 1600) and "cam1 (1 px" in several.notes[0] and "cam2" not in several.notes[0]
    assert known_lenses(TAKES, SIZES, one_lens=True).one_lens
    with pytest.raises(ValueError, match="focal must be positive, in pixels, got 0"):
        known_lenses(TAKES, SIZES, focal=0)
    with pytest.raises(ValueError, match="focal gives 2 focal lengths for 3 cameras"):
        known_lenses(TAKES, SIZES, focal=[1500, 1600])
    with pytest.raises(ValueError, match="focal and one_lens both say what the focal lengths are"):
        known_lenses(TAKES, SIZES, focal=1500, one_lens=True)


def test_a_calibration_file_is_matched_by_names(tmp_path):
    file = tmp_path / "Calib.toml"
    file.write_text(section("Cam_3", 1600) + section("Cam_1") + section("Cam_2", 1700, more=f"size = [{SIZE[0]}.0, {SIZE[1]}.0]"))
    known = known_lenses(TAKES, SIZES, calibration=file)
    assert known.focals == pytest.approx([np.sqrt(f * 1480) for f in (1500, 1700, 1600)])
    (K, bent), *_ = known.calibration
    assert K.tolist() == [[1500, 0, 950], [0, 1480, 545], [0, 0, 1]] and bent.tolist() == [-0.1, 0.02, 0.001, -0.002]
    assert [float(K[0, 0]) for K, _ in known.calibration] == [1500, 1700, 1600] and known.source == "given by Calib.toml, and held"
    assert known_lenses(TAKES, SIZES).calibration is None


def test_files_that_do_not_fit(tmp_path):
    file, two = tmp_path / "Calib.toml", section("cam1") + section("cam2")
    for content, said in (
        ("", r"its cameras are cam1, cam2, and cam1, cam2, cam3"),
        (section("cam3", more="fisheye = true"), r"\[cam3\] has a fisheye lens"),
        (section("cam3", more="size = [640, 480]"), r"cam3 \(640x480, its pictures 1920x1080\)"),
        (section("cam3", fx=0), "with positive focal lengths"),
    ):
        file.write_text(two + content)
        with pytest.raises(ValueError, match=said):
            known_lenses(TAKES, SIZES, calibration=file)


@pytest.mark.slow
def test_what_a_phone_wrote_into_a_photo(tmp_path):
    image = pytest.importorskip("PIL.Image")
    folders = [write_cameras(tmp_path) / f"cam{i}" for i in (1, 2)]
    takes = [take_of(folder, fps=30.0) for folder in folders]
    with pytest.raises(ValueError, match="cam1, cam2: no 35 mm equivalent is written in its video, nor in a photo"):
        known_lenses(takes, SIZES[:2], exif=True)
    for folder in folders:
        exif = image.Exif()
        exif.get_ifd(0x8769)[41989] = 26
        image.new("RGB", (8, 8)).save(folder / "room.jpg", exif=exif)
        Path(folder / "broken.jpeg").write_bytes(b"no picture")
    assert focal_35(takes[0]) == (26.0, "room.jpg") and focal_35(TAKES[0]) is None
    found = known_lenses(takes, SIZES[:2], exif=True)
    assert (
        found.focals == pytest.approx([26 * np.hypot(*SIZE) / DIAGONAL] * 2) and "cam1 26 mm (room.jpg): 1324 px" in found.notes[0]
    )


def test_what_a_phone_wrote_into_a_video(tmp_path):
    av = pytest.importorskip("av")
    path = tmp_path / "a.mov"
    with av.open(str(path), "w", options={"movflags": "use_metadata_tags"}) as container:
        container.metadata["com.apple.quicktime.camera.focal_length.35mm_equivalent"] = "24"
        stream = container.add_stream("mpeg4", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for _ in range(3):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.zeros((48, 64), np.uint8), format="gray")))
        container.mux(stream.encode())
    take = type(TAKES[0])(**{**vars(TAKES[0]), "path": path, "video": TAKES[0]})
    assert focal_35(take) == (24.0, "com.apple.quicktime.camera.focal_length.35mm_equivalent of a.mov")


def test_what_is_given():
    assert given_clocks(None, ["a"]) is None and given_clocks("known", ["a", "b"]).tolist() == [[0, 1], [0, 1]]
    assert given_clocks([1.0, 1.5], ["a", "b"]).tolist() == [[0, 1], [0.5, 1]]
    found = given_clocks(torch.tensor([[1.0, 2.0], [5.0, 1.0]]), ["a", "b"])
    t = 7.0  # of the common clock: a says 15, b says 12
    assert found[0].tolist() == [0, 1] and float(found[1, 1] * (1 + 2 * t) + found[1, 0]) == pytest.approx(5 + t)
    assert given_clocks(clocks_of(torch.tensor([0.0, -0.4])), ["a", "b"]).tolist() == [[0, 1], [pytest.approx(-0.4), 1]]
    with pytest.raises(ValueError, match="clocks must be offset and rate of 2 cameras"):
        given_clocks([1.0, 2.0, 3.0], ["a", "b"])
    with pytest.raises(ValueError, match="rates positive"):
        given_clocks([[0.0, 1.0], [0.0, 0.0]], ["a", "b"])


def test_what_sync_wrote(tmp_path):
    file = tmp_path / "sync.json"
    cameras = [{"name": "b", "offset": 0.0, "rate": 1.0}, {"name": "a", "offset": -0.5, "rate": 1.00001}]
    file.write_text(json.dumps({"ok": True, "cameras": cameras}))
    found = given_clocks(file, ["a", "b"])
    assert found[1].tolist() == [pytest.approx(0.5 / 1.00001), pytest.approx(1 / 1.00001)]
    assert given_clocks(str(file), ["b", "a"])[1].tolist() == [-0.5, 1.00001]
    with pytest.raises(ValueError, match=r"sync.json: has no clock of c \(it has b, a\)"):
        given_clocks(file, ["a", "c"])
    for content, said in (
        ({"ok": False, "cameras": cameras}, "did not decide on these clocks"), ({"ok": True}, "has no list of cameras"),
        ([1], "no list"),
        ({"ok": True, "cameras": [{"name": "a", "offset": None, "rate": 1}, cameras[0]]}, "a: offset and rate are no numbers"),
    ):  # fmt: skip
        file.write_text(json.dumps(content))
        with pytest.raises(ValueError, match=said):
            given_clocks(file, ["a", "b"])
    with pytest.raises(ValueError, match=r"no.json: no such file"):
        given_clocks(tmp_path / "no.json", ["a", "b"])


def test_the_extent_is_that_of_winters_table_and_heights_are_of_people():
    assert standing_extent(COCO17.joints, 2.0).extent == pytest.approx(2.0 * (0.936 - 0.039))
    assert standing_extent(BODY25B.joints, 1.8).extent == pytest.approx(1.8 * (1.0 - 0.01)) and standing_extent(
        BODY25B.joints, 1.8
    ).tops == ("head_top",)
    assert standing_extent(MEDIAPIPE33.joints, 1.8).bottoms == ("left_foot_index", "right_foot_index")
    no_face = [joint for joint in COCO17.joints if "shoulder" in joint or "ankle" in joint]
    assert standing_extent(no_face, 1.0).extent == pytest.approx(0.818 - 0.039) and standing_extent(no_face, 1.0).sigma > 0.01
    assert standing_extent(["LAnkle", "REye", "hip"], 1.7).tops == ("REye",)
    tall = np.ptp(perform("wave", Person(), fps=30.0, rng=0).joints[0, :, 1])  # a synthetic person, of lengths of its own
    assert standing_extent(COCO17.joints, 1.7).extent == pytest.approx(tall, rel=0.12)
    for layout in (COCO17, BODY25):
        one = standing_extent(layout.joints, 1.75)
        assert 0.005 < one.sigma / one.extent < 0.025 and f"{one.height:g} m" in one.note and "Drillis" in one.note
    for height, said in (
        (0.0, "got 0"), (17.0, "got 17"), (-1.7, "got -1.7"), (float("nan"), "got nan"),
        (175.0, "got 175; in centimetres? give 1.75"),
        (1750.0, "got 1750; in millimetres? give 1.75"), (5.9, "got 5.9; in feet? give 1.8"),
        (69.0, "got 69; in inches? give 1.75"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match="height must be that of a standing person in metres") as problem:
            check_height(height)
        assert str(problem.value).endswith(said)
    for joints in (HAND21.joints, ()):
        with pytest.raises(ValueError, match="do not reach from the head or the shoulders to the feet"):
            standing_extent(joints, 1.75)
