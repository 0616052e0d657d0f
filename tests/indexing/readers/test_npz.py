"""Files made to do harm: sizes declared and not there, archives that unpack to gigabytes, pipes, devices, endless brackets."""

from __future__ import annotations

import io
import json
import os
import re
import zipfile
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from indexing.labels import open_labels
from indexing.opening import clip_text, parse_json, quote, read_text
from indexing.readers import npz as npz_gate
from indexing.readers import read
from indexing.readers.formats.clipset import read_film_set
from indexing.readers.matches import open_points, read_image, read_matches, read_pair
from indexing.readers.tracks import read_tracks
from indexing.sync.calibration import read_calibration
from tests.grid import grid
from tests.indexing.readers import tools

JOINTS = np.random.default_rng(0).uniform(0, 100, (6, 17, 2))
PEOPLE = [{"image_id": i, "category_id": 1, "keypoints": [10.5, 20.0, 1.0] * 17} for i in range(5)]
HUGE = (10**12, 17, 2)


def npy(shape: Any, kind: str = "<f8", data: bytes = b"", text: str | None = None) -> bytes:
    """An array of the format that declares what it likes."""
    head = (text or f"{{'descr': {kind!r}, 'fortran_order': False, 'shape': {shape!r}, }}").encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head + data


def npz(path: Path, packing: int = zipfile.ZIP_STORED, **members: Any) -> Path:
    """An archive of arrays, or of bytes that say they are."""
    with zipfile.ZipFile(path, "w") as archive:
        for name, value in members.items():
            stream = io.BytesIO()
            np.save(stream, value) if not isinstance(value, bytes) else stream.write(value)
            archive.writestr(f"{name}.npy", stream.getvalue(), packing)
    return path


def refused(path: Path, action: Callable[[Path], Any], *words: str) -> None:
    tools.refused(path, *words, action=action)


def directory(path: Path, field: int, value: int) -> Path:
    """A byte of every entry of an archive's directory."""
    data = bytearray(path.read_bytes())
    for found in re.finditer(rb"PK\x01\x02", bytes(data)):
        data[found.start() + field] = value
    path.write_bytes(bytes(data))
    return path


def tracks(path: Path) -> Any:
    return read_tracks([path])


def views(path: Path) -> Any:
    return read_matches([path])


# ---- arrays --------------------------------------------------------------------------------------------------------------
def test_declared_sizes_are_checked_before_anything_is_made(tmp_path: Path) -> None:
    for members in (
        {"joints": npy(HUGE)},
        {"joints": npy((10**9, 17, 2))},
        {"joints": JOINTS, "names": npy((100,), "<U99999999")},
        {"joints": JOINTS, "extra": npy((10**12,))},
        {"joints": JOINTS, "names": npy((10**12,), "<U0")},
        {"joints": npy((10**12, 0, 2))},
        {"joints": npy((-1, 17, 2), data=JOINTS.tobytes())},
    ):
        refused(npz(tmp_path / "a.npz", **members), read)


def test_headers_that_are_none_are_refused(tmp_path: Path) -> None:
    damaged = ("((((", "'a", "{'shape': (3, ", "-" * 9000, "x" * 30_000, "__import__('os')")
    for text, word in (
        *((text, "header is damaged") for text in damaged),
        ("{'descr': '|O', 'fortran_order': False, 'shape': (1,)}", "Python objects"),
        ("{'descr': [('a', '<f8')], 'fortran_order': False, 'shape': (10**12,)}", "header is damaged"),
        ("{'descr': [('a', '<f8')], 'fortran_order': False, 'shape': (1000000000000,)}", "records"),
        ("{'descr': '(1000000,)f8', 'fortran_order': False, 'shape': (1000000,)}", "records"),
        ("{'descr': '<f8', 'fortran_order': False, 'shape': [3, 2]}", "header is damaged"),
    ):
        (tmp_path / "a.npy").write_bytes(npy((), text=text))
        npz(tmp_path / "a.npz", x1=npy((), text=text), x2=JOINTS[0], tracks=npy((), text=text))
        for action in (read_pair, tracks):
            refused(tmp_path / "a.npy", action, word)
            refused(tmp_path / "a.npz", action, word)


def test_an_archive_that_unpacks_to_far_more_than_it_has_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(npz_gate, "PLENTY", (2**20, 250))
    bomb = np.zeros((10_000, 17, 2))
    refused(npz(tmp_path / "a.npz", zipfile.ZIP_DEFLATED, joints=bomb), read, "would unpack to", "numpy.savez instead")
    assert len(read(npz(tmp_path / "b.npz", joints=bomb + 1))[0]) == len(bomb)  # nothing is packed: it is what it is
    # what nobody asks for is not unpacked
    assert len(read(npz(tmp_path / "c.npz", zipfile.ZIP_DEFLATED, joints=JOINTS, junk=bomb))[0]) == len(JOINTS)


@grid(("action", [read, read_film_set, read_pair, views, tracks]))
def test_archives_that_are_packed_strangely_cut_off_or_damaged_are_refused(action: Callable[[Path], Any], tmp_path: Path) -> None:
    names = ("x1", "x2", "x3") if action is views else ("joints", "frames", "x1", "x2", "tracks")
    path, values = tmp_path / "a.npz", np.uint8(JOINTS) if action is read_film_set else JOINTS
    arrays = {name: JOINTS[0] if name[0] == "x" else values for name in names}
    refused(directory(npz(path, **arrays), 8, 1), action, "is encrypted")
    directory(path, 8, 0)
    refused(directory(path, 10, 99), action, "packed by AES")
    refused(npz(path, zipfile.ZIP_BZIP2, **arrays), action, "packed by bzip2")
    for save in (np.savez, np.savez_compressed):
        save(path, **arrays)
        whole = path.read_bytes()
        for size in (50, len(whole) // 2, len(whole) - 40):
            path.write_bytes(whole[:size])
            refused(path, action, "cannot be read as numpy data", "truncated")
    data = bytearray(whole)
    for found in re.finditer(rb"PK\x03\x04", whole):
        data[found.start() + 60 : found.start() + 100] = b"\xa5" * 40
    path.write_bytes(bytes(data))
    refused(path, action)
    path.write_bytes(b"PK cut off")
    refused(path, action, "it is not an .npz file")


def test_members_and_shapes_that_make_no_sense_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("tracks", b"not an array")
    refused(path, tracks, "is no array of numpy")
    refused(npz(path, joints=JOINTS, names=npy((1,), "<U1", b"\xff\xff\xff\x7f")), read, "letters that do not exist")
    refused(npz(tmp_path / "a.npz", x1=JOINTS[0], x2=JOINTS[0], x3=JOINTS[0], ids=np.array(1.5)), views, "ids has shape ()")
    assert read(npz(tmp_path / "b.npz", joints=JOINTS, fps=np.float16(30)))[0].fps == 30.0  # 1e6 is no number of 16 bits
    path = tmp_path / "a.json"
    with path.open("wb") as file:
        file.write(b"{" * 1000)
        file.truncate(3 * 2**30)  # takes no room on the disk
    refused(path, read, "3.0 GB", "split the recording")


def test_what_numpy_writes_is_read_as_numpy_reads_it(tmp_path: Path) -> None:
    arrays = {
        "a": np.asfortranarray(JOINTS), "b": JOINTS.astype(">f4"), "c": np.array(["a", "bcd"]), "d": np.zeros((0, 2), np.int64),
        "e": np.array(True), "f": np.array(["2020-01-01"], "M8[D]"), "g": np.array([b"x"]), "h": np.arange(5, dtype=np.uint8),
    }  # fmt: skip
    for save in (np.savez, np.savez_compressed):
        save(tmp_path / "a.npz", **arrays)
        archive = npz_gate.NumpyArchive(tmp_path / "a.npz")
        assert list(archive) == list(arrays)
        for name, value in arrays.items():
            np.testing.assert_array_equal(archive[name], value)
            assert archive.shape(name) == value.shape
    np.save(tmp_path / "a.npy", arrays["a"])
    np.testing.assert_array_equal(npz_gate.read_npy(tmp_path / "a.npy"), JOINTS)
    (tmp_path / "old.npy").write_bytes(
        npy((), data=JOINTS[0].tobytes(), text="{'descr': '<f8', 'fortran_order': False, 'shape': (17L, 2L)}")
    )
    np.testing.assert_array_equal(npz_gate.read_npy(tmp_path / "old.npy"), JOINTS[0])


# ---- things that are no files --------------------------------------------------------------------------------------------
ACTIONS = [
    ("a.json", read), ("a.csv", read), ("a.npz", read), ("a.npz", read_film_set), ("a.csv", read_pair), ("a.npz", read_pair),
    ("a.csv", open_points), ("a.csv", tracks), ("a.npz", tracks), ("a.toml", read_calibration), ("a.png", read_image),
    ("a.csv", open_labels),
]  # fmt: skip


WAYS: dict[str, tuple[Callable[[Path], None], str]] = {
    "pipe": (os.mkfifo, "is a pipe"),
    "device": (lambda path: path.symlink_to("/dev/zero"), "is a device"),
    "loop": (lambda path: path.symlink_to(path.name), "leads back to itself"),
    "nothing": (lambda path: path.symlink_to("nowhere"), "that is not there"),
    "folder": (lambda path: path.mkdir(), "is a folder"),
}


def test_pipes_devices_and_broken_links_are_refused(tmp_path: Path) -> None:
    for way, (number, (name, action)) in product(("pipe", "device", "loop", "nothing"), enumerate(ACTIONS)):
        path = tmp_path / f"{number}{way}{name}"
        WAYS[way][0](path)
        refused(path, action, WAYS[way][1])
    for way, suffix in product(("folder", "pipe", "device"), ("json", "txt")):  # a folder of frames names the one that is no file
        folder = tmp_path / f"{way}{suffix}"
        folder.mkdir()
        for i in range(3):
            (folder / f"a_{i}.{suffix}").write_text('{"people": []}')
        WAYS[way][0](folder / f"a_7.{suffix}")
        refused(folder / f"a_7.{suffix}", lambda path: read(path.parent), WAYS[way][1])


# ---- JSON, TOML, tables --------------------------------------------------------------------------------------------------
def test_json_of_numbers_and_brackets_without_end(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    for new, *words in (
        ("9" * 400, "annotation 0", "expected numbers"),
        ("9" * 5000, "thousands of digits"),
        ("[" * 100_000, "nested too deeply"),
        ("1e400", "infinite coordinates", "leave them empty"),
        ('"' + "x" * 10**5 + '"', "expected numbers, got ['xxx"),
    ):
        path.write_text(json.dumps(PEOPLE).replace("10.5", new))
        refused(path, read, *words)
    for nothing_else in ("[" * 900 + "]" * 900, "[" * 100_000, '{"a":' * 400 + "1" + "}" * 400):
        path.write_text(nothing_else)
        refused(path, read)


def test_toml_that_goes_deep_or_holds_no_camera(tmp_path: Path) -> None:
    for text in (
        "a = " + "[" * 5000 + "]" * 5000,
        "a = " + "{a=" * 5000,
        "[" + ".".join("a" * 5000) + "]",
        ".".join("a" * 5000) + " = 1",
        "a = " + "9" * 5000,
        "[c]\nmatrix = [[" + "9" * 400 + ", 0, 1], [0, 1, 1], [0, 0, 1]]",
        "#" * 2**21,
        "[c]\nmatrix = [[[[]]]]",
        "[c]\nmatrix = [[900, 0, 1], [0, 900, 1], [0, 0, 1e-320]]",
    ):
        (tmp_path / "a.toml").write_text(text)
        refused(tmp_path / "a.toml", read_calibration, "Pose2Sim")


def test_a_table_that_names_everything_differently_is_not_laid_out(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("frame,id,x,y\n" + "".join(f"{i},p{i},1,2\n" for i in range(5000)))
    refused(path, tracks, "5000 views and 5000 points", "same name")
    path.write_text("frame,landmark,x,y\n" + "".join(f"{i},p{i},1,2\n" for i in range(5000)))
    refused(path, read, "5000 landmarks", "same name")
    path.write_text("x," * 100_000 + "\n1,2\n")
    for action in (read, read_pair, open_points, tracks):
        refused(path, action, "100001 cells")


# ---- counts of C3D and PLY -----------------------------------------------------------------------------------------------
def test_counts_of_ply_are_held_against_the_file(tmp_path: Path) -> None:
    head = "ply\nformat binary_little_endian 1.0\nelement camera {}\nproperty float x\nelement vertex {}\n"
    head += "property float x\nproperty float y\nproperty float z\nend_header\n"
    for first, count in ((0, 10**12), (10**12, 2), (-5, 2), (0, -1)):
        (tmp_path / "a.ply").write_bytes(head.format(first, count).encode() + bytes(24))
        refused(tmp_path / "a.ply", open_points, "makes no sense")


def test_parameters_of_c3d_are_held_against_the_file(tmp_path: Path) -> None:
    sound = tools.c3d()
    (tmp_path / "a.c3d").write_bytes(sound)
    assert open_points(tmp_path / "a.c3d").values.shape == (5, 4, 3)
    at = sound.index(b"LABELS") + 6 + 2
    (tmp_path / "a.c3d").write_bytes(sound[:at] + bytes([255, 7, *[255] * 7]) + sound[at + 9 :])  # 255^7 letters
    refused(tmp_path / "a.c3d", open_points, "make no sense")


# ---- messages ------------------------------------------------------------------------------------------------------------
def test_messages_are_short_and_of_one_line() -> None:
    assert clip_text("a\x1b[31m\nb") == "a?[31m b"
    assert len(quote(10**4000)) < 60
    assert len(quote([[["x" * 10**6]]] * 10**5)) <= 60
    deep: Any = []
    for _ in range(10_000):
        deep = [deep]
    assert len(quote(deep)) <= 60
    with pytest.raises(ValueError, match=r"a\.json: frame 3: not valid JSON at line 1, column 1 \(Expecting value\); again"):
        parse_json("a.json", "", "again", "frame 3")
    with pytest.raises(ValueError, match="no file can have this name; check the path"):
        read_text("a\0b")
