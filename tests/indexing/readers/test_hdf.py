"""DeepLabCut, SLEAP and movement: their default outputs, which are HDF5."""

from __future__ import annotations

import builtins
import json
import pickle
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from indexing.readers import read, read_clip
from indexing.readers.hdf import open_hdf5
from indexing.readers.recording import NobodySeen
from indexing.skeleton import COCO17
from tests.indexing.readers import tools
from tests.indexing.readers.tools import refused

NAMES = COCO17.joints
ASIDE = np.array([500.0, 0.0, 0.0])  # pixels, and no more confidence


def unseen(person: np.ndarray) -> np.ndarray:
    """As networks write a joint that was not seen: without coordinates, SLEAP without a score, too."""
    out = person.copy()
    out[2, 3] = np.nan
    return out


MAKERS: dict[str, Callable[[Path, np.ndarray], Path]] = {
    "deeplabcut table": lambda path, p: tools.deeplabcut(path, p, NAMES),
    "deeplabcut fixed": lambda path, p: tools.deeplabcut(path, p, NAMES, "fixed"),
    "deeplabcut one animal": lambda path, p: tools.deeplabcut(path, {"mouse": p}, NAMES),
    "deeplabcut other key": lambda path, p: tools.deeplabcut(path, p, NAMES, key="keypoints"),
    "sleap analysis": lambda path, p: tools.sleap_analysis(path, {"": unseen(p)}, NAMES),
    "sleap analysis newer": lambda path, p: tools.sleap_analysis(path, {"track_0": unseen(p)}, NAMES, "standard"),
    "sleap project": lambda path, p: tools.sleap_project(path, {"": unseen(p)}, NAMES, fps=25.0),
    "sleap project tracked": lambda path, p: tools.sleap_project(path, {"A": unseen(p)}, NAMES, fps=25.0),
    "movement": lambda path, p: tools.movement(path, {"id_0": unseen(p)}, NAMES),
    "movement in frames": lambda path, p: tools.movement(path, {"id_0": unseen(p)}, NAMES, seconds=False),
    "movement older": lambda path, p: tools.movement(
        path, {"id_0": unseen(p)}, NAMES, axes=("time", "individuals", "keypoints", "space")
    ),
}


@pytest.mark.parametrize("maker", MAKERS)
def test_every_variant_gives_the_same_clip(maker: str, person: np.ndarray, expected: np.ndarray, tmp_path: Path) -> None:
    path = MAKERS[maker](tmp_path / "take.h5", person)
    clip = read_clip(path, fps=25.0)
    np.testing.assert_allclose(clip.joints, expected)
    np.testing.assert_allclose(np.nan_to_num(clip.confidence), person[..., 2])
    np.testing.assert_allclose(clip.times, np.arange(6) / 25)
    assert (clip.up, clip.name, clip.fps_assumed) == ("-y", "take.h5", False)
    assert clip.skeleton is not None and clip.skeleton.joints == NAMES
    if "project" in maker or maker.startswith("movement"):  # the file knows its rate
        clip = read_clip(path)
        np.testing.assert_allclose(clip.times, np.arange(6) / 25)
        assert not clip.fps_assumed


def test_several_animals_are_tracks(person: np.ndarray, expected: np.ndarray, tmp_path: Path) -> None:
    far = person + ASIDE
    people = {"mouse1": unseen(person), "mouse2": unseen(far)}
    for i, make in enumerate((tools.deeplabcut, tools.sleap_analysis, tools.sleap_project, tools.movement)):
        clips = read(make(tmp_path / f"{i}.h5", people, NAMES), person="all")
        assert [clip.meta["person"] for clip in clips] == ["mouse1", "mouse2"]
        np.testing.assert_allclose(clips[0].joints, expected)
        np.testing.assert_allclose(clips[1].joints, expected + ASIDE[:2])


def test_labels_of_images_have_their_numbers(person: np.ndarray, tmp_path: Path) -> None:
    index = [f"labeled-data/walk/img{3 * i:04d}.png" for i in range(6)]
    for layout in ("table", "fixed"):
        clip = read_clip(tools.deeplabcut(tmp_path / f"{layout}.h5", person[..., :2], NAMES, layout, index), fps=30.0)
        np.testing.assert_allclose(clip.times, np.arange(6) / 10)
        assert clip.confidence is None


# ---- SLEAP projects ------------------------------------------------------------------------------------------------------
def test_what_a_person_set_replaces_what_was_predicted(person: np.ndarray, tmp_path: Path) -> None:
    people = {"A": unseen(person), "B": unseen(person) + ASIDE}
    hand = {(1, "A"): person[1, :, :2] + 7.0, (4, "B"): np.full((17, 2), np.nan)}
    hand[4, "B"][0] = [9.0, 9.0]
    clips = read(tools.sleap_project(tmp_path / "a.slp", people, NAMES, hand), person="all")
    np.testing.assert_allclose(clips[0].joints[1], person[1, :, :2] + 7.0)
    assert (clips[0].confidence[1] == 1).all()
    np.testing.assert_allclose(clips[0].joints[0], person[0, :, :2])
    np.testing.assert_allclose(clips[1].joints[1], person[1, :, :2] + ASIDE[:2])
    np.testing.assert_allclose(clips[1].joints[4][0], [9.0, 9.0])
    assert np.isnan(clips[1].joints[4][1:]).all()


def test_projects_untracked_shuffled_old_and_empty(person: np.ndarray, expected: np.ndarray, tmp_path: Path) -> None:
    def project(shown: np.ndarray = unseen(person), **more: Any) -> Path:  # noqa: B008
        return tools.sleap_project(tmp_path / "a.slp", {"": shown}, NAMES, **more)

    # an animal without a track that was set by hand replaces all predictions
    clip = read_clip(project(by_hand={(0, ""): person[0, :, :2] + 3.0}))
    np.testing.assert_allclose(clip.joints[0], person[0, :, :2] + 3.0)
    clip = read_clip(project(order=np.random.default_rng(0).permutation(17).tolist()))
    assert clip.skeleton is not None and clip.skeleton.joints == NAMES
    assert clip.skeleton.bones[:2] == ((0, 1), (1, 2))
    # points of old projects count from the corner of a pixel
    np.testing.assert_allclose(read_clip(project(format_id=1.0)).joints, expected - 0.5)
    videos = project(videos=["C:\\data\\one.mp4", "two.mp4"])
    refused(videos, "labels in 2 videos (one.mp4, two.mp4)", "export each video by itself")
    with pytest.raises(NobodySeen, match=r"no person was detected in any of 4 frames"):
        read(project(np.full((4, 17, 3), np.nan)))


# ---- broken --------------------------------------------------------------------------------------------------------------
def changed(path: Path, change: Callable[[Any], None]) -> Path:
    with h5py.File(path, "r+") as file:
        change(file)
    return path


def put(file: Any, name: str, values: Any) -> None:
    attributes = dict(file[name].attrs) if name in file else {}
    if name in file:
        del file[name]
    file[name] = values
    file[name].attrs.update(attributes)


def filled(file: Any, name: str, field: str, value: float) -> None:
    table = file[name][()]
    table[field] = value
    file[name][...] = table


BROKEN: list[tuple[str, Callable[[Any], None], tuple[str, ...]]] = [
    ("sleap analysis", lambda f: f.__delitem__("node_names"), ("without keypoints",)),
    ("sleap analysis", lambda f: put(f, "node_names", np.array(["a"] * 17, "S")), ("node_names are a, a",)),
    ("sleap analysis", lambda f: put(f, "node_names", np.array(["a", "b"], "S")), ("2 node_names",)),
    ("sleap analysis", lambda f: put(f, "tracks", np.zeros((1, 4, 17, 6))), ("4 coordinates",)),
    ("sleap analysis", lambda f: put(f, "tracks", np.zeros((2, 17, 6))), ("tracks",)),
    ("sleap analysis", lambda f: put(f, "tracks", np.zeros((1, 2, 17, 0))), ("in 0 frames",)),
    ("sleap analysis", lambda f: put(f, "point_scores", np.zeros((1, 17, 7))), ("point_scores are",)),
    ("sleap analysis", lambda f: put(f, "track_names", np.array(["a", "b"], "S")), ("2 track_names",)),
    ("sleap analysis newer", lambda f: f["tracks"].attrs.__setitem__("dims", '["frame", "x"]'), ("has the axes",)),
    ("sleap analysis newer", lambda f: f["tracks"].attrs.__setitem__("dims", "[["), ("not valid JSON",)),
    ("sleap project", lambda f: f["metadata"].attrs.__setitem__("json", "{}"), ("no nodes and skeletons",)),
    ("sleap project", lambda f: f["metadata"].attrs.__delitem__("json"), ("metadata@json",)),
    ("sleap project", lambda f: f.__delitem__("pred_points"), ("pred_points",)),
    ("sleap project", lambda f: put(f, "pred_points", f["pred_points"][:9]), ("has no 17 points",)),
    ("sleap project", lambda f: put(f, "instances", f["instances"][:3]), ("share out its 3 instances",)),
    ("sleap project", lambda f: put(f, "frames", f["frames"][1:]), ("share out its 6 instances",)),
    ("sleap project", lambda f: put(f, "frames", np.zeros(3)), ("no field 'video'",)),
    ("sleap project tracked", lambda f: f.__delitem__("tracks_json"), ("is of track 0",)),
    ("sleap project", lambda f: filled(f, "instances", "instance_type", 2), ("of the type 2",)),
    ("movement", lambda f: f.__delitem__("keypoints"), ("without keypoints",)),
    ("movement", lambda f: put(f, "space", np.array(["u", "v"], h5py.string_dtype())), ("the axes u, v",)),
    ("movement", lambda f: put(f, "time", np.arange(3.0)), ("time",)),
    ("movement in frames", lambda f: f["time"].__setitem__(slice(None), 0.0), ("must be frame numbers that increase",)),
    ("deeplabcut table", lambda f: f["df_with_missing"].__delitem__("table"), ("no index and values",)),
    ("deeplabcut table", lambda f: f["df_with_missing/table"].attrs.__delitem__("values_block_0_kind"), ("kind",)),
    ("deeplabcut table", lambda f: f["df_with_missing"].attrs.__setitem__("pandas_type", "series"), ("'series' of pandas",)),
    ("deeplabcut fixed", lambda f: f["df_with_missing"].__delitem__("block0_values"), ("block0_values",)),
    ("deeplabcut fixed", lambda f: f["df_with_missing/block0_items_label1"].__setitem__(0, 99), ("words that are not there",)),
    ("deeplabcut fixed", lambda f: f["df_with_missing"].attrs.__setitem__("nblocks", 10**6), ("nblocks is",)),
    ("deeplabcut fixed", lambda f: put(f, "df_with_missing/block0_values", np.zeros((6, 50))), ("51 columns",)),
    ("deeplabcut fixed", lambda f: put(f, "df_with_missing/axis1", np.arange(5)), ("5 rows",)),
    ("deeplabcut fixed", lambda f: put(f, "df_with_missing/axis1", np.array(["a"] * 6, "S")), ("has no number",)),
]  # fmt: skip


def check_changed(person: np.ndarray, folder: Path, changes: list[tuple[str, Callable[[Any], None], tuple[str, ...]]]) -> None:
    cases = {}
    for i, (maker, change, words) in enumerate(changes):
        path = changed(MAKERS[maker](folder / f"{i}.h5", person), change)
        cases[f"{i} {maker}: {words[0]}"] = partial(refused, path, *words)
    assert tools.list_failures(cases) == {}


def test_broken_and_hostile_files_are_refused_in_one_line(person: np.ndarray, tmp_path: Path) -> None:
    check_changed(person, tmp_path, BROKEN)
    tools.sleap_analysis(tmp_path / OTHER, {"a": person}, NAMES)
    check_changed(person, tmp_path, HOSTILE)


# ---- hostile -------------------------------------------------------------------------------------------------------------
OTHER = "other.h5"  # beside the file that is changed


def link_outside(file: Any) -> None:
    del file["tracks"]
    file["tracks"] = h5py.ExternalLink(OTHER, "/tracks")


def link_softly_outside(file: Any) -> None:
    file["real"] = h5py.ExternalLink(OTHER, "/tracks")
    del file["tracks"]
    file["tracks"] = h5py.SoftLink("/real")


def keep_values_elsewhere(file: Any) -> None:
    del file["tracks"]
    file.create_dataset("tracks", (1, 2, 17, 6), "f8", external=[(OTHER, 0, 8 * 2 * 17 * 6)])


def keep_values_virtually(file: Any) -> None:
    del file["tracks"]
    layout = h5py.VirtualLayout((1, 2, 17, 6), "f8")
    layout[:] = h5py.VirtualSource(OTHER, "tracks", (1, 2, 17, 6))
    file.create_virtual_dataset("tracks", layout)


def declare_much(file: Any) -> None:
    del file["tracks"], file["point_scores"]
    file.create_dataset("tracks", (1, 2, 17, 3_000_000), "f8", chunks=(1, 2, 17, 1000), compression="gzip")  # nothing stored


def declare_many_rows(file: Any) -> None:
    del file["df_with_missing/block0_values"]
    file["df_with_missing"].create_dataset("block0_values", (10**7, 51), "f8", chunks=(1000, 51))


def name_by_rows_of_any_length(file: Any) -> None:
    del file["tracks_json"]
    file.create_dataset("tracks_json", (2,), dtype=h5py.vlen_dtype(np.float64))


def add_field_of_any_length(file: Any) -> None:
    old = file["pred_points"][()]
    new = np.zeros(len(old), dtype=[*old.dtype.descr, ("more", h5py.vlen_dtype(np.uint8))])
    for field in old.dtype.names:
        new[field] = old[field]
    new["more"] = [np.zeros(1, np.uint8) for _ in new]
    del file["pred_points"]
    file.create_dataset("pred_points", data=new, dtype=new.dtype)


def leave_no_joints(file: Any) -> None:
    put(file, "position", np.zeros((10**9, 2, 0, 1)))
    put(file, "keypoints", np.zeros(0, h5py.string_dtype()))


def name_columns_by(program: bytes) -> Callable[[Any], None]:
    return lambda file: file["df_with_missing/table"].attrs.__setitem__("values_block_0_kind", np.bytes_(program))


def name_more_than_any_table_has(name: str) -> Callable[[Any], None]:
    def change(file: Any) -> None:
        del file[f"df_with_missing/{name}"]
        file["df_with_missing"].create_dataset(name, data=np.zeros(2**22 + 1, np.int8), compression="gzip")

    return change


class Harm:
    def __reduce__(self) -> Any:
        return builtins.eval, ("1/0",)


TUPLE_KEY = b"})" + b"2\x86" * 60 + b"Ns."
TUPLE_WORD = b"(()" + b"2\x86" * 60 + b"\x85l."
MANY_WORDS = b"(" + b"(" + b"N" * 101 + b"t" + b"2" * 9 + b"l."
HOSTILE: list[tuple[str, Callable[[Any], None], tuple[str, ...]]] = [
    ("sleap analysis", link_outside, ("without keypoints",)),
    ("sleap analysis", link_softly_outside, ("no dataset 'tracks'",)),
    ("sleap analysis", keep_values_elsewhere, ("kept in another file",)),
    ("sleap analysis", keep_values_virtually, ("kept in another file",)),
    ("sleap analysis", declare_much, ("would take 0.8 GB of 0.0 MB",)),
    ("deeplabcut fixed", declare_many_rows, ("would take",)),
    ("sleap project tracked", name_by_rows_of_any_length, ("is no list of names",)),
    ("sleap project tracked", add_field_of_any_length, ("'pred_points' has fields that are neither numbers nor text of one",)),
    ("movement", leave_no_joints, ("position is (1000000000, 1, 0, 2)",)),
    ("deeplabcut table", name_columns_by(pickle.dumps(Harm(), 0)), ("the pickle holds the name", "eval")),
    ("deeplabcut table", name_columns_by(TUPLE_KEY), ("a key of the type tuple",)),
    ("deeplabcut table", name_columns_by(TUPLE_WORD), ("no columns named by",)),
    ("deeplabcut table", name_columns_by(MANY_WORDS), ("no columns named by",)),
    *(
        ("deeplabcut fixed", name_more_than_any_table_has(name), ("has more names than any table of points",))
        for name in ("axis1", "block0_items_label1", "block0_items_level1")
    ),
]


def test_heaps_of_text_without_end_and_texts_longer_than_the_file_are_refused(person: np.ndarray, tmp_path: Path) -> None:
    path = tools.movement(tmp_path / "a.nc", {"id": person}, NAMES)
    data = bytearray(path.read_bytes())
    at = data.index(b"GCOL\x01") + 16
    data[at : at + 16] = bytes(16)  # free, and of no size: the next piece is itself
    path.write_bytes(data)
    refused(path, "one of its heaps of text has no end")
    path = tools.sleap_project(tmp_path / "a.slp", {"A": unseen(person)}, NAMES)
    with h5py.File(path) as file:
        at = file["tracks_json"].id.get_offset()
    data = bytearray(path.read_bytes())
    data[at : at + 4] = (2**32 - 1).to_bytes(4, "little")
    path.write_bytes(data)
    refused(path, "'tracks_json' has a text longer than the file")


@pytest.mark.parametrize("packing", [{}, {"chunks": (100,)}, {"compression": "gzip"}, {"compression": "gzip", "shuffle": True}])
def test_many_texts_in_one_piece_of_a_heap_are_refused(packing: dict[str, Any], person: np.ndarray, tmp_path: Path) -> None:
    path = tools.sleap_project(tmp_path / "a.slp", {"A": unseen(person)}, NAMES)
    names = [f'[0, "{"x" * 2000}"]', *(f'[0, "{i}"]' for i in range(299))]
    text = h5py.string_dtype()

    def shared(file: Any) -> None:
        del file["tracks_json"]
        file.create_dataset("tracks_json", data=names, dtype=text, **packing)

    assert len(read(changed(path, shared))) == 1  # each has a piece of its own
    with h5py.File(path, "r+") as file:
        data = file["tracks_json"]
        if not packing:
            at = data.id.get_offset()
        elif "compression" not in packing:
            at = data.id.get_chunk_info(0).byte_offset
        else:  # the same entries, packed again
            mask, packed = data.id.read_direct_chunk((0,))
            raw = zlib.decompress(packed)
            data.id.write_direct_chunk((0,), zlib.compress(raw[:16] * (len(raw) // 16)), mask)
    if "compression" not in packing:
        raw = bytearray(path.read_bytes())
        count = 100 if packing else 300
        raw[at : at + 16 * count] = raw[at : at + 16] * count
        path.write_bytes(raw)
    refused(path, "'tracks_json' has texts that are together longer than the file")


def test_texts_whose_lengths_cannot_be_seen_are_refused(person: np.ndarray, tmp_path: Path) -> None:
    with h5py.File(tmp_path / "b.slp", "w", userblock_size=512) as file:
        file.create_dataset("names", data=["A"], dtype=h5py.string_dtype())
    with open_hdf5(tmp_path / "b.slp") as file, pytest.raises(ValueError, match="text is kept in an uncommon way"):
        file.texts("names")

    def packed(file: Any) -> None:
        del file["tracks_json"]
        file.create_dataset("tracks_json", data=['[0, "A"]'] * 99, dtype=h5py.string_dtype(), compression="lzf")

    def compact(file: Any) -> None:
        del file["tracks_json"]
        plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plan.set_layout(h5py.h5d.COMPACT)
        kind, space = h5py.h5t.py_create(h5py.string_dtype(), logical=True), h5py.h5s.create_simple((1,))
        h5py.Dataset(h5py.h5d.create(file.id, b"tracks_json", kind, space, plan))[0] = '[0, "A"]'

    words = ("in an uncommon way",)
    check_changed(person, tmp_path, [("sleap project tracked", packed, words), ("sleap project tracked", compact, words)])


def test_many_texts_in_an_attribute_are_not_read(person: np.ndarray, tmp_path: Path) -> None:
    path = tools.sleap_analysis(tmp_path / "a.h5", {"a": person}, NAMES)
    with h5py.File(path, "r+") as file:
        file.attrs.create("many", ["a", "b"], dtype=h5py.string_dtype())
        file.attrs["one"] = "a"
    with open_hdf5(path) as file:
        assert (file.attribute("/", "many"), file.attribute("/", "one")) == (None, "a")


def test_animals_are_checked_before_room_is_made_for_them(person, tmp_path, monkeypatch):
    path = tools.sleap_project(tmp_path / "a.slp", {"A": unseen(person)}, NAMES)
    count = 100_000

    def many(file: Any) -> None:  # of 17 points each, all of them the same
        table = np.repeat(file["instances"][:1], count)
        frames = file["frames"][()]
        frames["instance_id_start"][1:] = frames["instance_id_end"] = count
        put(file, "frames", frames)
        del file["instances"]
        file.create_dataset("instances", data=table, compression="gzip")

    refused(changed(path, many), "pred_points: 100000 animals of 17 points share 102")

    def wide(file: Any) -> None:
        about = json.loads(file["metadata"].attrs["json"])
        about["nodes"] = [{"name": str(i)} for i in range(1500)]
        about["skeletons"][0]["nodes"] = [{"id": i} for i in range(1500)]
        file["metadata"].attrs["json"] = np.bytes_(json.dumps(about))

    real = np.full

    def checked(shape: Any, *rest: Any) -> Any:
        assert isinstance(shape, int), "room is made before the animals are checked"
        return real(shape, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(np, "full", checked)
        refused(changed(path, wide), "pred_points: an animal has no 1500 points")


def test_what_rows_of_columns_are_called_is_as_usual_where_it_makes_no_sense(person: np.ndarray, tmp_path: Path) -> None:
    for program in (TUPLE_KEY, TUPLE_WORD, MANY_WORDS):
        info = np.bytes_(b"}K\x01}X\x05\x00\x00\x00names" + program[:-1] + b"ss.")
        path = tools.deeplabcut(tmp_path / "b.h5", person, NAMES)
        clip = read_clip(changed(path, lambda file, info=info: file["df_with_missing"].attrs.__setitem__("info", info)))
        assert clip.skeleton is not None and clip.skeleton.joints == NAMES


def test_without_h5py_one_line_says_what_to_install(person: np.ndarray, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tools.deeplabcut(tmp_path / "a.h5", person, NAMES)
    real = builtins.__import__

    def without(name: str, *rest: Any, **more: Any) -> Any:
        if name == "h5py":
            raise ImportError(name)
        return real(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", without)
    refused(path, "takes h5py to read", "pip install 'dyntorch[h5]'")
