"""Tracks from tables, arrays and files per view: what is read, and what is refused in one line."""

from __future__ import annotations

import numpy as np
import pytest

from indexing.readers.tracks import holds_tracks, read_tracks

NAN = float("nan")
VALUES = np.array([[[1.0, 2.0], [3.0, 4.0]], [[5.0, 6.0], [NAN, NAN]], [[7.0, 8.0], [9.0, 1.0]]])


@pytest.fixture
def write(write_json):
    return lambda text, name="t.csv": write_json(text, name)


# ---- what is read --------------------------------------------------------------------------------------------------------
def test_a_table_with_frames_and_times(write):
    found = read_tracks([write("frame,time,id,x,y\n10,0,p,1,2\n20,0.5,p,5,6\n30,2,q,9,1\n10,0,q,3,4\n20,.5,q,,\n30,2,p,7,8\n")])
    assert found.ids == ("p", "q") and found.views == ("10", "20", "30") and found.static is None and found.weights is None
    np.testing.assert_array_equal(found.values, VALUES)
    np.testing.assert_array_equal(found.times, [0, 0.5, 2])
    found = read_tracks([write(",frame,id,x,y\n0,0,a,1,2\n1,1,a,3,4\n")])  # an index without a heading
    np.testing.assert_array_equal(found.values[:, 0], [[1, 2], [3, 4]])


def test_what_an_archive_knows_besides(tmp_path):
    seen = np.isfinite(VALUES).all(-1)
    np.savez(tmp_path / "a.npz", **{"desk/y": np.nan_to_num(VALUES), "desk/vis": seen, "desk/s": np.array([2, 1], np.uint8)})
    found = read_tracks([tmp_path / "a.npz"], key="desk")
    np.testing.assert_array_equal(found.values, VALUES)
    assert found.known.tolist() == [2, 1] and found.drop_short(3).known.tolist() == [2]
    np.savez(tmp_path / "b.npz", tracks=VALUES, labels=np.array([0.5, 1]), visible=seen[:2])  # neither can be meant
    found = read_tracks([tmp_path / "b.npz"])
    assert found.known is None
    np.testing.assert_array_equal(found.values, VALUES)


def test_which_files_hold_tracks(write, tmp_path):
    np.savez(tmp_path / "t.npz", tracks=VALUES)
    np.savez(tmp_path / "several.npz", **{"desk/y": VALUES})
    np.savez(tmp_path / "m.npz", x1=VALUES[0], x2=VALUES[1])
    np.savez(tmp_path / "both.npz", **{"a/x1": VALUES[0], "a/y": VALUES})
    np.save(tmp_path / "t.npy", VALUES)
    np.save(tmp_path / "m.npy", np.zeros((9, 4)))
    write("frame,id,x,y\n0,a,1,2\n", "t.csv")
    write("x1,y1,x2,y2\n1,2,3,4\n", "m.csv")
    write("PK broken", "broken.npz")
    names = [path.name for path in sorted(tmp_path.iterdir()) if holds_tracks(path)]
    assert names == ["several.npz", "t.csv", "t.npy", "t.npz"] and not holds_tracks(tmp_path / "no.csv")


def test_times_alone_are_the_views_and_unsorted_rows_are_sorted(write):
    found = read_tracks([write("t;point;x;y\n1,5;a;1;2\n-0,5;a;3,5;4\n")])
    np.testing.assert_array_equal(found.times, [-0.5, 1.5])
    np.testing.assert_array_equal(found.values[:, 0], [[3.5, 4], [1, 2]])
    # times of day name the views in full, and then from the first
    found = read_tracks([write("time,id,x,y\n1700000000.25,a,1,2\n1700000000.45,a,3,4\n1700000001.25,a,3,4\n")])
    assert found.views == ("1700000000.25", "1700000000.45", "1700000001.25")
    short = found.select(found.views[1:]).since_first()
    assert short.views == ("0", "0.8") and short.start == 1700000000.45 and short.times[0] == 0


def test_columns_of_static_points_weights_and_depth(write):
    rows = "view,id,x,y,z,static,weight\n0,a,1,2,3,1,1\n1,a,1,2,3,1,0.5\n0,b,4,5,6,0,1\n1,b,4,5,6,1,1\n"
    found = read_tracks([write(rows)])
    assert found.values.shape == (2, 2, 3) and found.times is None
    np.testing.assert_array_equal(found.static, [True, False])  # static where all rows say so
    np.testing.assert_array_equal(found.weights, [[1, 1], [0.5, 1]])


def test_a_file_per_view_joins_names_and_rows(write):
    first, second = write("id,x,y\np,1,2\nq,3,4\n", "a.csv"), write("id,x,y,static\nr,5,6,1\np,7,8,0\n", "b.csv")
    found = read_tracks([first, second])
    assert found.ids == ("p", "q", "r") and found.views == ("a.csv", "b.csv")
    np.testing.assert_array_equal(found.values, [[[1, 2], [3, 4], [NAN, NAN]], [[7, 8], [NAN, NAN], [5, 6]]])
    bare = read_tracks([write("1,2\n3,4\n", "c.csv"), write("5,6\nnan,nan\n", "d.csv")])
    assert bare.ids == ("1", "2")
    np.testing.assert_array_equal(bare.values, VALUES[:2])


def test_arrays(tmp_path):
    np.savez(tmp_path / "t.npz", tracks=VALUES, times=[0, 1, 3], ids=["a", "b"], static=[1, 0], weights=np.ones((3, 2)))
    found = read_tracks([tmp_path / "t.npz"])
    np.testing.assert_array_equal(found.values, VALUES)
    assert found.ids == ("a", "b") and found.static.tolist() == [True, False] and found.times.tolist() == [0, 1, 3]
    np.savez(tmp_path / "h.npz", **{"cars1/y": VALUES, "cars1/s": [1, 2], "cars2/y": 2 * VALUES})
    np.testing.assert_array_equal(read_tracks([tmp_path / "h.npz"], key="cars2").values, 2 * VALUES)
    np.save(tmp_path / "t.npy", VALUES)
    chosen = read_tracks([tmp_path / "t.npy"], frames=["2", "0"])
    np.testing.assert_array_equal(chosen.values, VALUES[[2, 0]])
    assert chosen.views == ("2", "0")


def test_static_points_from_a_file(write):
    rows = "frame,id,x,y\n0,a,1,2\n1,a,1,2\n0,b,1,2\n0,c,1,2\n1,c,1,2\n"
    tracks = write(rows)
    assert read_tracks([tracks], static=write("id\nc\n", "s.csv")).static.tolist() == [False, False, True]
    assert read_tracks([tracks], static=write("b\na\n", "s.csv")).static.tolist() == [True, True, False]
    assert read_tracks([tracks], static=write("id,static\na,0\nb,1\n", "s.csv")).static.tolist() == [False, True, False]


def test_tracks_seen_once_are_left_out(write):
    found = read_tracks([write("frame,id,x,y,static\n0,a,1,2,1\n1,a,1,2,1\n0,b,1,2,0\n")])
    kept = found.drop_short()
    assert kept.ids == ("a",) and kept.static.tolist() == [True] and kept.drop_short() is kept
    assert kept.notes == ("1 track is seen in fewer than 2 views and was left out",)


# ---- what is refused -----------------------------------------------------------------------------------------------------
BAD_TABLES = [
    ("frame,id,x,y\n", r"t\.csv: the file has a header but no rows"),
    ("frame,x,y\n0,1,2\n", r"no column names the points \(its columns are frame, x, y\); name the columns"),
    ("frame,id,x,y\n,a,1,2\n", r"row 2, column 'frame': is empty"),
    ("frame,id,x,y\n0,,1,2\n", r"row 2, column 'id': is empty"),
    ("frame,id,x,y\n0,a,1,2\n1,a,1,2\n0,a,1,2\n", r"row 4 .* in frame 0 before, in row 2; give each point one row"),
    ("frame,time,id,x,y\n0,0,a,1,2\n0,1,b,1,2\n", r"row 3: frame 0 has the time 1 here and 0 before; a view has one time"),
    ("frame,id,x,y,weight\n0,a,1,2,-1\n", r"row 2, column 'weight': the weight is -1"),
    ("frame,id,x,y\n0,a,1,2\n0,b,1,2\n", r"holds 1 view"),
    ("id,x,y\na,1,2\n", r"holds the points of one view; give a table with columns frame"),
    ("", r"the file is empty"),
    ("0,a,1,2\n1,a,1,2\n", r"row 1 holds numbers, and no row names the columns; name the columns frame \(or time\), id, x, y"),
    ("frame,id,x\n0,a,1\n", r"its columns are frame, id, x; name the columns frame \(or time\), id, x, y"),
]


def test_bad_tables(write):
    for text, says in BAD_TABLES:
        with pytest.raises(ValueError, match=says):
            read_tracks([write(text)])


def test_bad_arrays(tmp_path):
    def refused(says: str, **arrays) -> None:
        np.savez(tmp_path / "t.npz", **arrays)
        with pytest.raises(ValueError, match=says):
            read_tracks([tmp_path / "t.npz"])

    refused(r"its arrays are a, b; give 'tracks' .* which array has the tracks: --key a", a=VALUES, b=VALUES)
    with pytest.raises(ValueError, match=r"has no array 'c'; its arrays are a, b"):
        read_tracks([tmp_path / "t.npz"], key="c")
    np.testing.assert_array_equal(read_tracks([tmp_path / "t.npz"], key="b").values, VALUES)
    refused(r"tracks has shape \(3, 2\)", tracks=VALUES[:, 0])
    refused(r"times has shape \(2,\), tracks has \(3, 2, 2\)", tracks=VALUES, times=[0, 1])
    refused(r"times holds values that are no finite numbers", tracks=VALUES, times=[0, 1, NAN])
    refused(r"weights holds values that are no finite numbers of 0 or more", tracks=VALUES, weights=-np.ones((3, 2)))
    refused(r"holds 2 sequences \(a, b\); say which: --key a", **{"a/y": VALUES, "b/y": VALUES})
    with pytest.raises(ValueError, match=r"has no sequence 'c'; its sequences are a, b"):
        read_tracks([tmp_path / "t.npz"], key="c")


def test_other_refusals(write, tmp_path):
    a, b = write("x,y\n1,2\n", "a.csv"), write("x,y,z\n1,2,3\n", "b.csv")
    tracks = write("frame,id,x,y\n0,a,1,2\n1,a,1,2\n")
    np.save(tmp_path / "t.npy", VALUES)
    for files, options, says in (
        ([], {}, "no files"),
        ([tmp_path / "no.csv"], {}, r"no\.csv: no such file"),
        ([a, b], {}, r"b\.csv: holds 3D points, .*a\.csv 2D"),
        ([a, write("x,y\n1,2\n3,4\n", "c.csv")], {}, r"c\.csv: has 2 rows, .*a\.csv 1; give a row per track"),
        ([a, tmp_path / "t.npy"], {}, r"t\.npy: holds 3 frames; give such a file alone"),
        ([tracks], {"key": "k"}, "--key k: has no keys"),
        ([tracks], {"frames": ["0", "7"]}, r"has no frame 7; its 2 frames are 0 to 1"),
        ([tracks], {"frames": ["0", "0"]}, "frame 0 is asked for twice"),
        ([tracks], {"static": tmp_path / "s.csv"}, r"s\.csv: no such file"),
        ([tracks], {"static": a}, r"a\.csv: has no column of names"),
        ([tracks], {"static": write("id\nzz\n", "z.csv")}, r"z\.csv: row 2: no track is named 'zz'"),
    ):
        with pytest.raises(ValueError, match=says):
            read_tracks(files, **options)
