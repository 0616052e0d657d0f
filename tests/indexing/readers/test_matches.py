"""Matches of two images, and photographs, from files that the tests write, broken ones included."""

import numpy as np
from PIL import Image

from indexing.readers.matches import MAX_SIDE, read_image, read_pair
from tests.indexing.readers.tools import refused

X1, X2 = np.arange(20.0).reshape(10, 2), np.arange(20.0, 40.0).reshape(10, 2)


def table(path, text):
    path.write_text(text)
    return path


def test_tables(tmp_path):
    for text, ids in (
        ("1,2,3,4\n5,6,7,8", ("1", "2")),
        ("1;2;3;4\n5,0;6;7;8", ("1", "2")),
        ("1 2 3 4\n5 6 7 8", ("1", "2")),
        ("# x1 y1 x2 y2\n1 2 3 4\n5 6 7 8", ("1", "2")),
        ("#x1,y1,x2,y2\n1,2,3,4\n5,6,7,8", ("1", "2")),
        ("a,1,2,3,4\nb,5,6,7,8", ("a", "b")),
        ("x2,y2,score,X1,Y1,id\n3,4,9,1,2,a\n7,8,9,5,6,b", ("a", "b")),
    ):
        found = read_pair(table(tmp_path / "m.csv", text))
        assert found.ids == ids and found.x1.tolist() == [[1, 2], [5, 6]] and found.x2.tolist() == [[3, 4], [7, 8]]
        assert found.weights is None and found.known is None and found.name == "m.csv"
    found = read_pair(table(tmp_path / "m.csv", "x1,y1,x2,y2,label,weight\n1,2,3,4,2,0.5\n5,,7,8,0,"))
    assert found.known.tolist() == [2, 0] and found.weights.tolist() == [0.5, 0] and found.complete.tolist() == [True, False]


def test_arrays(tmp_path):
    np.savez(
        tmp_path / "a.npz", x1=X1[:, None].astype(np.float32), x2=X2, labels=np.ones(10), size=[64, 48], ids=list("abcdefghij")
    )
    found = read_pair(tmp_path / "a.npz")
    assert found.x1.tolist() == X1.tolist() and found.x1.dtype == np.float64 and found.size == (64, 48)
    assert found.ids[0] == "a" and found.known.dtype == np.int64
    np.savez(tmp_path / "b.npz", **{"one/x1": X1, "one/x2": X2})  # a single pair needs no name
    assert read_pair(tmp_path / "b.npz").name == read_pair(tmp_path / "b.npz", "one").name == "one"


BAD_TABLES = [
    (",,,\n", "the file is empty; export it again"),
    ("x1,y1,x2,y2\n", "has a header but no rows"),
    ("x,y\n1,2", "its columns are x, y; name the columns x1,y1,x2,y2"),
    ("x1,y1,x2\n1,2,3", "its columns are x1, y1, x2; name the columns"),
    ("hello world\nthis is not a table\n", "its columns are hello, world; name the columns"),
    (",".join("abcdefghij") + "\n" + "1," * 9 + "1", "its columns are a, b, c, d, e, f, g, h, ...; name the columns"),
    ("1,2,3\n4,5,6", "row 1 has 3 columns, and no row names them; name the columns x1,y1,x2,y2"),
    ("1,2,3,4,1\n1,2,3,4,1", "row 1 has 5 columns"),
    ("x1,y1,x2,y2,x1\n1,2,3,4,5", "there are two columns 'x1'"),
    ("x1,y1,x2,y2,label\n1,2,3,4,1.5", "match 1: the label is 1.5; labels are 0 for an outlier"),
    ("x1,y1,x2,y2,label\n1,2,3,4,", "match 1: the label is nan"),
    ("x1,y1,x2,y2,label\n1,2,3,4,cup", "row 2, column 'label': 'cup' is not a number"),
    ("x1,y1,x2,y2,weight\n1,2,3,4,-1", "match 1: the weight is -1; weights are 0 or more"),
]


def test_bad_tables_and_arrays_name_file_field_and_remedy(tmp_path):
    for text, says in BAD_TABLES:
        refused(table(tmp_path / "m.csv", text), says, action=read_pair)
    for arrays, says in BAD_ARRAYS:
        np.savez(tmp_path / "m.npz", **arrays)
        refused(tmp_path / "m.npz", says, action=read_pair)


BAD_ARRAYS = [
    ({"a": X1}, "has no x1 (its arrays are a); give x1 and x2 (n, 2)"),
    ({"car/y": np.stack([X1, X2]), "car/s": np.ones(10)}, "are car/y, car/s); it seems to hold tracks (frames, n, 2)"),
    ({"x1": X1}, "has no x2"),
    ({"x1": X1, "x2": X2[:9]}, "x1 has 10 rows, x2 9; give a row per match in both"),
    ({"x1": X1.T, "x2": X2.T}, "x1: the array has shape (2, 10); points of an image are (n, 2): transpose it"),
    ({"x1": np.c_[X1, X1[:, 0]], "x2": X2}, "(10, 3); points of an image are (n, 2): divide homogeneous ones by their third"),
    ({"x1": X1[None], "x2": X2}, "(1, 10, 2); points of an image are (n, 2)"),
    ({"x1": X1[:, :1], "x2": X2}, "(10, 1); points of an image are (n, 2)"),
    ({"x1": X1[:0], "x2": X2[:0]}, "the array is empty"),
    ({"x1": X1.astype(str), "x2": X2}, "holds values of type <U"),
    ({"x1": np.where(X1 == 3, np.inf, X1), "x2": X2}, "x1: row 2, column 2: inf is not finite"),
    ({"x1": X1, "x2": X2, "label": np.ones(9)}, "label has shape (9,), x1 has 10 rows; give one per match"),
    ({"x1": X1, "x2": X2, "label": -np.ones(10)}, "match 1: the label is -1"),
    ({"x1": X1, "x2": X2, "label": np.array(list("abcdefghij"))}, "label holds values of type <U1; give numbers"),
    ({"x1": X1, "x2": X2, "weights": np.full(10, np.inf)}, "match 1: the weight is inf"),
    ({"x1": X1, "x2": X2, "ids": np.ones(10)}, "ids: '1.0' names several matches"),
    ({"x1": np.array([{}] * 10), "x2": X2}, "array 'x1' cannot be read"),
]


def test_photographs_keep_the_size_of_the_file(tmp_path):
    gray = np.tile(np.linspace(0, 255, 40).astype(np.uint8), (30, 1))
    Image.fromarray(gray).save(tmp_path / "a.png")
    found = read_image(tmp_path / "a.png")
    assert found.size == (40, 30) and found.name == "a.png" and found.gray.shape == (30, 40)
    np.testing.assert_allclose(found.gray, gray / 255, atol=1e-6)
    Image.fromarray(gray.astype(np.uint16) * 100).save(tmp_path / "deep.png")
    np.testing.assert_allclose(read_image(tmp_path / "deep.png").gray, gray / 255, atol=0.01)
    Image.new("RGBA", (2 * MAX_SIDE, 10), "red").save(tmp_path / "large.png")
    large = read_image(tmp_path / "large.png")
    assert large.size == (2 * MAX_SIDE, 10) and large.gray.shape == (5, MAX_SIDE)


def test_photographs_are_turned_as_their_file_says(tmp_path):
    image = Image.fromarray(np.tile(np.linspace(0, 255, 40).astype(np.uint8), (30, 1)))
    exif = Image.Exif()
    exif[0x0112] = 6  # a quarter turn
    image.save(tmp_path / "a.jpg", exif=exif)
    found = read_image(tmp_path / "a.jpg")
    assert found.size == (30, 40) and found.gray[0].mean() < 0.1 < 0.9 < found.gray[-1].mean()


def test_what_is_no_image_or_array_of_matches(tmp_path):
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (50, 50), dtype=np.uint8)).save(tmp_path / "cut.png")
    (tmp_path / "cut.png").write_bytes((tmp_path / "cut.png").read_bytes()[:900])
    np.save(tmp_path / "m.npy", X1)
    refused(tmp_path / "no.png", "no such file", action=read_image)
    refused(tmp_path, "is a folder", action=read_image)
    refused(tmp_path / "cut.png", "cannot be read as an image", action=read_image)
    refused(tmp_path / "m.npy", "the array has shape (10, 2); matches are (n, 4)", action=read_pair)
