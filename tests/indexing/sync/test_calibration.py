"""Calibration files, and which camera is which section."""

from __future__ import annotations

import pytest

from indexing.sync.calibration import lenses, named_lenses, read_calibration
from indexing.sync.synchronize import synchronize

# torch's own, when it first loads its transforms; hidden outside of tests
pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated")


TOML = """
[int_cam{0}_img]
name = "int_cam{0}_img"
size = [ 1088.0, 1920.0]
matrix = [ [ 1671.5, 0.0, 564.6], [ 0.0, 1671.4, 933.0], [ 0.0, 0.0, 1.0]]
distortions = [ -0.05, 0.15, 0.0, 0.0]
rotation = [ 1.7, 1.0, -0.4]
fisheye = false
"""


def test_calibration_files_of_any_order_and_names(tmp_path, cameras, library):
    path = tmp_path / "Calib.toml"
    path.write_text(TOML.format(2) + TOML.format(1).replace("1671.5", "900.0") + "[metadata]\nerror = 0.0\n")
    assert [lens.name for lens in read_calibration(path)] == ["int_cam2_img", "int_cam1_img"]
    synchronize(cameras[0], cameras[1], calibration=path)
    (first, dist), (second, _) = library[0]["calibration"]
    assert first[0, 0] == 900 and second[0, 0] == 1671.5 and dist.tolist() == [-0.05, 0.15, 0, 0]
    by_order = lenses(path, ["left", "right"])
    assert by_order is not None and by_order.values[0][0][0, 0] == 1671.5 and "in the order of its file" in by_order.notes[0]
    assert lenses(None, ["a", "b"]) is None
    assert [lens.size for lens in read_calibration(path)] == [(1088.0, 1920.0)] * 2
    for odd in ("[1088]", "[0, 5]", '"large"', "[nan, 1]", "[]"):
        path.write_text(TOML.format(1).replace("[ 1088.0, 1920.0]", odd))
        assert read_calibration(path)[0].size is None  # nothing hangs on it
    path.write_text("".join(TOML.format(i).replace("1671.5", f"{900 + i}.0") for i in (1, 2, 3)))
    found, notes = named_lenses(path, ["left", "mid", "right"])
    assert "in the order of its file" in notes[0]
    pair = lenses(found, ["left", "right"])  # two of three, known by name
    assert pair is not None and [matrix[0, 0].item() for matrix, _ in pair.values] == [901, 903] and pair.notes == ()
    with pytest.raises(ValueError, match=r"Calib\.toml: its cameras are int_cam1_img, int_cam2_img, int_cam3_img, and a, b"):
        named_lenses(path, ["a", "b"])
    path.write_text(path.read_text().replace("int_cam1_img", "Cam_01").replace("int_cam3_img", "Cam_10"))
    found, notes = named_lenses(path, ["cam10", "cam1"])  # some of them, in another order, whoever wrote the names
    assert [lens.matrix[0, 0].item() for lens in found] == [903, 901] and notes == ()


def test_calibration_files_that_do_not_fit(tmp_path):
    for text, says in (
        ("{", r"is not a TOML file"),
        ("[metadata]\nerror = 0.0", r"has no camera: no section with a 'matrix'"),
        (TOML.format(1).replace("1671.5", "-1.0"), r"\[int_cam1_img\] matrix: expected 3 x 3 with positive focal lengths"),
        (TOML.format(1).replace("-0.05,", ""), r"distortions: expected 4, 5 or 8 numbers, got 3"),
        (TOML.format(1).replace("-0.05", "nan"), r"distortions: expected finite numbers"),
        (TOML.format(1), r"its cameras are int_cam1_img, and cam1, cam2 are asked for"),
        (TOML.format(1).replace("false", "true") + TOML.format(2), r"has a fisheye lens"),
    ):
        (tmp_path / "c.toml").write_text(text)
        with pytest.raises(ValueError, match=says):
            lenses(tmp_path / "c.toml", ["cam1", "cam2"])
