"""Points of any format: what is read, how rows are matched, and what is refused in one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from indexing.readers.matches import Matched, open_points, read_matches
from indexing.readers.points import PointSequence
from tests.grid import grid
from tests.indexing.readers.tools import c3d, refused

XYZ = np.array([[1.0, 2.0, 3.0], [-4.5, 5.0, 6.25], [7.0, 8.0, -9.0]])


def text(path: Path, content: str) -> Path:
    path.write_text(content, encoding="utf-8")
    return path


def ply(path: Path, order: str, rows: bytes, properties: str = "", count: int = 3, before: str = "") -> Path:
    properties = properties or "".join(f"property float {axis}\n" for axis in "xyz")
    head = f"ply\nformat {order} 1.0\ncomment made here\n{before}element vertex {count}\n{properties}"
    path.write_bytes(f"{head}element face 0\nproperty list uchar int vertex_indices\nend_header\n".encode() + rows)
    return path


# ---- CSV -----------------------------------------------------------------------------------------------------------------
def test_csv(tmp_path):
    for content, values, ids in (
        ("1,2\n3,4\n", [[1, 2], [3, 4]], None),
        ("x,y\n1,2\n3,\n", [[1, 2], [3, np.nan]], None),
        ("y, X ,quality\n2,1,.5\nNaN,3,.5\n", [[1, 2], [3, np.nan]], None),
        ("1,2,3\n", [[1, 2, 3]], None),
        ("id,x,y,z\n07,1,2,3\nb,4,5,6\n", [[1, 2, 3], [4, 5, 6]], ("07", "b")),
        ("left knee,1,2\nhead,n/a,4\n", [[1, 2], [np.nan, 4]], ("left knee", "head")),
        ("Name;x;y\na;1,5;2\n", [[1.5, 2]], ("a",)),
        ("\ufeffx\ty\n1e3\t-2\n\n", [[1000, -2]], None),
        ("x1,y1,z1,x2,y2,z2\n1,2,3,4,5,6\n", [[[1, 2, 3], [4, 5, 6]]], None),
        ("1,2,3,4,5,6\n", [[[1, 2, 3], [4, 5, 6]]], None),
    ):
        found = open_points(text(tmp_path / "a.csv", content))
        np.testing.assert_array_equal(found.values, np.array(values, dtype=float))
        assert found.values.dtype == np.float64 and found.ids == ids
        assert found.lines == (np.ndim(values) == 3)
    found = open_points(text(tmp_path / "a.csv", "x,y,weight,static\n1,2,.5,yes\n3,4,2,0\n5,6,1,\n"))
    assert found.weights.tolist() == [0.5, 2, 1] and found.static.tolist() == [True, False, False]


def test_csv_refused(tmp_path):
    for content, says in (
        ("", "the file is empty"),
        ("  \n\n", "the file is empty"),
        ("x,y\n", "a header but no rows"),
        ("x,y\n1,2\n3,abc\n", "row 3, column 'y': 'abc' is not a number; correct the cell"),
        ("1,2\n3,abc\n", "row 2, column 'y': 'abc' is not a number"),
        ("x,y\n1,inf\n", "row 2, column 'y': 'inf' is not finite"),
        ("x,y\n1,2\n3\n", "row 3 has 1 cells, the first row 2"),
        ("u,v\n1,2\n", "its columns are u, v; name the columns x,y or x,y,z"),
        ("1,2,3,4\n", "row 1 has 4 columns, and no row names them"),
        ("id,x,y\na,1,2\nb,1,2\na,3,4\n", "row 4, column 'id': 'a' was in row 2, too"),
        ("id,x,y\n,1,2\n", "row 2, column 'id': is empty"),
        ("x,x,y\n1,2,3\n", "two columns 'x'"),
        ("x,y,static\n1,2,3\n", "row 2, column 'static': 3 is neither 0 nor 1"),
        ("x,y,weight\n1,2,w\n", "row 2, column 'weight': 'w' is not a number"),
    ):
        refused(text(tmp_path / "a.csv", content), says, action=open_points)


def test_other_files_are_refused(tmp_path):
    (tmp_path / "x.bin").write_bytes(b"\x01\x02\x00\x03" * 10)
    (tmp_path / "latin.csv").write_bytes(b"id,x,y\nM\xfcller,1,2\n")
    for name, says in (("no.csv", "no such file"), (".", "is a folder"), ("x.bin", "no known format"), ("latin.csv", "UTF-8")):
        with pytest.raises(ValueError, match=says):
            open_points(tmp_path / name)


# ---- PLY -----------------------------------------------------------------------------------------------------------------
def test_ply_ascii(tmp_path):
    rows = "\n".join(" ".join(map(str, row)) for row in XYZ).encode() + b"\n"
    np.testing.assert_array_equal(open_points(ply(tmp_path / "a.ply", "ascii", rows)).values, XYZ)


@pytest.mark.parametrize(("order", "sign"), [("binary_little_endian", "<"), ("binary_big_endian", ">")])
def test_ply_binary_with_other_properties(tmp_path, order, sign):
    table = np.zeros(3, dtype=[("z", f"{sign}f8"), ("red", "u1"), ("x", f"{sign}f4"), ("y", f"{sign}f4"), ("id", f"{sign}i4")])
    table["x"], table["y"], table["z"] = XYZ.T
    table["id"] = 5, 3, 9
    properties = "property double z\nproperty uchar red\nproperty float x\nproperty float32 y\nproperty int id\n"
    skipped = np.array([(1, 2)], dtype=[("a", "u1"), ("b", f"{sign}i2")])
    before = "element camera 1\nproperty uchar a\nproperty short b\n"
    path = ply(tmp_path / "a.ply", order, skipped.tobytes() + table.tobytes() + b"rest", properties, before=before)
    found = open_points(path)
    np.testing.assert_array_equal(found.values, XYZ)
    assert found.ids == ("5", "3", "9")


def test_ply_refused(tmp_path):
    path = ply(tmp_path / "a.ply", "ascii", "\n".join(" ".join(map(str, row)) for row in XYZ).encode())
    sound, binary = path.read_bytes(), XYZ.astype("<f4").tobytes()
    for change, says in (
        ((b"end_header", b"end"), "no end_header"),
        ((b"ascii", b"morse"), "the line 'format morse 1.0'"),
        ((b"element vertex 3", b"element vertex many"), "the line 'element vertex many'"),
        ((b"element vertex", b"element corner"), "no element 'vertex'"),
        ((b"property float z", b"property float w"), "no property 'z' (they have x, y, w)"),
        ((b"property float z", b"property list uchar float z"), "list properties"),
        ((b"vertex 3", b"vertex 4"), "has 3 of 4 vertices"),
        ((b"vertex 3", b"vertex 0"), "has no vertices"),
        ((b"5.0", b"five"), "vertex 2, 'y': 'five' is not a number"),
        ((b" 5.0 ", b" "), "vertex 2 has 2 values, the header 3"),
        ((b"format ascii 1.0\n", b""), "no format"),
    ):
        path.write_bytes(sound.replace(*change))
        refused(path, says, action=open_points)
    refused(ply(path, "binary_little_endian", binary[:-1]), "has 2 of 3 vertices; the file may be truncated", action=open_points)
    ply(path, "binary_little_endian", binary, before="element strip 1\nproperty list uchar int i\n")
    refused(path, "the lists of 'strip' come before the vertices", action=open_points)


# ---- C3D -----------------------------------------------------------------------------------------------------------------
@grid(("order", ["<", ">"]), (("scale", "analog"), [(-0.1, 0), (-0.1, 3), (0.5, 0), (0.5, 4)]))
def test_c3d(tmp_path, order, scale, analog):
    places = np.stack([XYZ + 10 * frame for frame in range(5)])
    places[2, 1] = np.nan
    path = tmp_path / "walk.c3d"
    path.write_bytes(c3d(places, ["LKNE", "head", "head"], order=order, scale=scale, first=11, analog=analog))
    found = open_points(path)
    assert isinstance(found, PointSequence) and found.ids == ("LKNE", "head#2", "head#3") and found.first == 11
    np.testing.assert_allclose(found.values, places, atol=abs(scale) / 2 if scale > 0 else 0)
    matched = read_matches([path], frames=(11, 13, 15))
    np.testing.assert_array_equal(matched.views[1], found.values[2])
    assert matched.names[1].endswith("walk.c3d frame 13") and matched.ids == found.ids


def test_c3d_reals_of_dec_processors(tmp_path):
    """Such reals have their halves swapped and are four times as large."""
    data = bytearray(c3d(XYZ[None]))
    for at in (slice(1024, None), slice(12, 16)):
        data[at] = (np.frombuffer(bytes(data[at]), "<f4") * 4).view("<u2").reshape(-1, 2)[:, ::-1].tobytes()
    data[515] = 85
    (tmp_path / "a.c3d").write_bytes(bytes(data))
    np.testing.assert_array_equal(open_points(tmp_path / "a.c3d").values[0], XYZ)


def test_c3d_refused(tmp_path):
    path, whole = tmp_path / "a.c3d", c3d(np.stack([XYZ] * 5))
    path.write_bytes(whole)
    for paths, frames, says in (
        ([path], None, r"has 5 frames \(1 to 5\); say which are the views: --frames 1,3,5"),
        ([path], (1, 2, 6), "has no frame 6; its frames are 1 to 5"),
        ([path, path], None, "give one such file alone"),
    ):
        with pytest.raises(ValueError, match=says):
            read_matches(paths, frames=frames)
    for data, says in (
        (whole[:-1], "has 4 of 5 frames"),
        (whole[:600], "C3D header"),
        (whole[:2] + b"\0\0" + whole[4:], "no markers"),
        (whole[:515] + b"\x07" + whole[516:], "processor 7"),
        (b"\xf0" + whole[1:], "make no sense"),
    ):
        path.write_bytes(data)
        refused(path, says, action=open_points)


# ---- numpy ---------------------------------------------------------------------------------------------------------------
def test_npy(tmp_path):
    np.save(tmp_path / "a.npy", XYZ.astype(np.float32))
    np.save(tmp_path / "three.npy", np.stack([XYZ, XYZ + 1, XYZ + 2]))
    np.save(tmp_path / "lines.npy", np.arange(12).reshape(2, 2, 3))
    np.testing.assert_array_equal(open_points(tmp_path / "a.npy").values, XYZ)
    assert open_points(tmp_path / "lines.npy").lines
    three = read_matches([tmp_path / "three.npy"])
    np.testing.assert_array_equal(three.views[2], XYZ + 2)
    np.testing.assert_array_equal(read_matches([tmp_path / "three.npy"], frames=(2, 0)).views[0], XYZ + 2)


def test_npz(tmp_path):
    path = tmp_path / "m.npz"
    points = {f"P{i}": XYZ + i for i in (1, 2, 3)}
    np.savez(path, **points, weights=[1, 0, 2], static=[True, False, False], ids=["a", "b", "c"])
    found = read_matches([path])
    np.testing.assert_array_equal(found.views[1], XYZ + 2)
    assert found.ids == ("a", "b", "c") and found.weights.tolist() == [1, 0, 2] and found.static.tolist() == [1, 0, 0]
    np.savez(path, l1=np.zeros((4, 2, 3)), l2=np.ones((4, 6)), static1=XYZ, static2=XYZ + 1)
    lines = read_matches([path])
    assert lines.lines and lines.dims == (3, 3) and lines.static_points[1].tolist() == (XYZ + 1).tolist()


BAD_ARRAYS = [
    ({"a": XYZ}, "its arrays are a; keys are x1, x2, x3"),
    ({"x1": XYZ}, "has x1 but no x2"),
    ({"x1": XYZ, "x2": XYZ, "x3": XYZ, "y": XYZ}, "an array 'y', which is not known"),
    ({"x1": XYZ, "x2": XYZ[:2], "x3": XYZ}, "x2: has 2 rows, "),
    ({"x1": XYZ, "x2": XYZ, "x3": np.zeros((3, 4))}, "x3: the array has shape (3, 4)"),
    ({"x1": XYZ, "x2": XYZ, "x3": np.array(["a", "b", "c"])}, "holds values of type <U1"),
    ({"x1": XYZ[:0], "x2": XYZ[:0], "x3": XYZ[:0]}, "the array is empty"),
    ({"x1": XYZ, "x2": XYZ, "x3": XYZ + np.inf}, "row 1, column 1: inf is not finite"),
    ({"x1": XYZ, "x2": XYZ, "x3": XYZ, "weights": [1, 2]}, "weights has shape (2,), x1 has 3 rows"),
    ({"x1": XYZ, "x2": XYZ, "x3": XYZ, "weights": [1, 2, -1]}, "match 3: the weight is -1; weights are 0 or more"),
    ({"x1": XYZ, "x2": XYZ, "x3": XYZ, "static": [0, 1, 2]}, "static holds other values than 0 and 1"),
    ({"x1": XYZ, "x2": XYZ, "x3": XYZ, "static1": XYZ}, "static points are for lines"),
    ({"l1": np.zeros((3, 3)), "l2": np.zeros((3, 6))}, "lines are (n, 2, 3), two points each, or (n, 6)"),
    ({"l1": np.zeros((3, 6)), "l2": np.zeros((3, 6)), "static1": XYZ}, "1 files of 3D static points"),
    ({"x1": np.array([{}]), "x2": XYZ, "x3": XYZ}, "cannot be read"),
]


def test_npz_refused(tmp_path):
    for arrays, says in BAD_ARRAYS:
        np.savez(tmp_path / "m.npz", **arrays)
        refused(tmp_path / "m.npz", says, action=lambda path: read_matches([path]))


# ---- matching ------------------------------------------------------------------------------------------------------------
def files(folder: Path, *contents: str) -> list[Path]:
    return [text(folder / f"{name}.csv", content) for name, content in zip("abc", contents, strict=False)]


def test_rows_are_matched_by_name(tmp_path):
    found = read_matches(files(tmp_path, "id,x,y,static\np,1,2,1\nq,3,4,0\nr,5,6,1\n", "id,x,y\nr,7,8\ns,0,0\np,9,10\n"))
    assert found.ids == ("p", "r") and found.static.tolist() == [True, True]
    np.testing.assert_array_equal(found.views[1], [[9, 10], [7, 8]])
    assert found.notes == ("2 names are not in every view and were left out: q, s",)


def test_rows_are_matched_by_order_without_names(tmp_path):
    found = read_matches(files(tmp_path, "id,x,y\np,1,2\nq,3,4\n", "x,y\n5,6\n7,8\n"))
    assert found.ids == ("p", "q") and "matched by their order" in found.notes[0] and "b.csv" in found.notes[0]
    bare = read_matches(files(tmp_path, "1,2\n3,4\n", "5,6\n7,8\n"))
    assert isinstance(bare, Matched) and bare.ids == ("1", "2") and bare.notes == () and bare.dims == (2, 2)


def test_what_cannot_be_matched_is_refused(tmp_path):
    lines = "1,2,3,4,5,6\n"
    for contents, says in (
        (("1,2\n3,4\n", "5,6\n"), "b.csv: has 1 rows, "),
        (("p,1,2\n", "q,5,6\n"), "a.csv: no name is in all of"),
        (("1,2,3\n", lines), "b.csv: holds lines, but"),
    ):
        with pytest.raises(ValueError, match="; ") as caught:
            read_matches(files(tmp_path, *contents))
        assert says in str(caught.value)
    with pytest.raises(ValueError, match="no files; give"):
        read_matches([])
    with pytest.raises(ValueError, match="has no frames; leave --frames out"):
        read_matches(files(tmp_path, "1,2\n", "1,2\n"), frames=(1, 2))


def test_static_points_of_lines(tmp_path):
    lines = files(tmp_path, "1,2,3,4,5,6\n" * 2, "1,2,3,4,5,6\n" * 2)
    points = [text(tmp_path / f"{name}.csv", "1,2,3\n4,5,6\n7,8,9\n") for name in "pq"]
    found = read_matches(lines, static_points=points)
    assert [part.shape for part in found.static_points] == [(3, 3), (3, 3)]
    with pytest.raises(ValueError, match="static points are for lines; mark static matches by a column static"):
        read_matches(points, static_points=points)
