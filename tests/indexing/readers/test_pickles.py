"""Skeleton sets in pickles: read without running anything, whatever the file says."""

from __future__ import annotations

import builtins
import collections
import functools
import os
import pickle
import struct
import subprocess
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from indexing.readers import read
from indexing.readers.formats import pyskl as reader
from indexing.readers.pickles import _Reader, read_pickle, unpickle_bytes
from indexing.readers.recording import NobodySeen
from indexing.skeleton import COCO17, NTU25
from tests.grid import grid
from tests.indexing.readers import tools
from tests.indexing.readers.tools import list_failures, refused


@pytest.fixture
def people(person: np.ndarray) -> dict[str, np.ndarray]:
    """Three clips ``(people, 6, 17, 3)``: one person, two, and one with the first slot empty."""
    far = person + [300.0, 0.0, 0.0]  # noqa: RUF005  (arrays)
    return {"walk_1": person[None], "walk_2": np.stack([person, far]), "sit_1": np.stack([np.zeros_like(person), person])}


# ---- sets ----------------------------------------------------------------------------------------------------------------
@grid(("protocol", range(6)), ("bare", [False, True]))
def test_a_set_is_read_whatever_the_protocol(protocol, bare, people, expected, tmp_path):
    split = {"train": ["walk_1", "walk_2"], "test": ["sit_1"]}
    clips = read(tools.pyskl(tmp_path / "set.pkl", people, [3, 3, 5], split, bare, protocol, half=False))
    assert [clip.name for clip in clips] == list(people)
    assert clips.labels.tolist() == [3, 3, 5]
    assert all(clip.skeleton is COCO17 and clip.up == "-y" and clip.fps_assumed for clip in clips)
    assert all(clip.meta["img_shape"] == (1080, 1920) for clip in clips)
    for clip in (clips[0], clips[2]):
        np.testing.assert_allclose(clip.joints, expected, rtol=1e-6)
    if not bare:
        assert clips.column("split").tolist() == ["train", "train", "test"]


def test_parts_that_share_clips_people_and_clips_without(people, expected, tmp_path):
    none = np.zeros((1, 4, 17, 3))
    split = {"xsub_train": ["walk_1"], "xview_train": ["walk_1", "sit_1"]}
    path = tools.pyskl(tmp_path / "set.pkl", {**people, "none": none}, [0, 0, 1, 1], split)  # half floats
    clips = read(path)
    np.testing.assert_allclose(clips[0].joints, expected, rtol=1e-3)
    assert clips.column("xsub_train").tolist() == [1, 0, 0]  # a field each, where parts share clips
    assert clips.column("xview_train").tolist() == [1, 0, 1]
    assert len(read(path, person="everyone")) == 3
    clips = read(tools.pyskl(tmp_path / "set.pkl", {"walk_2": people["walk_2"]}, [0], half=False), person="all")
    assert [clip.name for clip in clips] == ["walk_2#0", "walk_2#1"]
    np.testing.assert_allclose(clips[1].joints[..., 0], expected[..., 0] + 300, rtol=1e-6)
    with pytest.raises(NobodySeen):
        read(tools.pyskl(tmp_path / "b.pkl", {"none": none}, [0]))


def test_three_dimensions_are_those_of_kinect(tmp_path: Path) -> None:
    body = tools.standing(NTU25, dims=3)[None]
    data = [{"frame_dir": "a", "label": 1, "keypoint": np.concatenate([body, np.zeros_like(body)]), "total_frames": 12}]
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(data))
    (clip,) = read(tmp_path / "a.pkl")
    assert (clip.skeleton, clip.dims, clip.up) == (NTU25, 3, "y")
    np.testing.assert_allclose(clip.joints, body[0])


SOUND = {"frame_dir": "a", "label": 0, "keypoint": np.ones((1, 4, 17, 2), np.float32)}


@pytest.mark.parametrize(
    ("data", "words"),
    [
        ({}, ("a pickle of a dictionary with none",)), ([], ("a pickle of a list",)), (3, ("a pickle of a int",)),
        ({"annotations": 3}, ("dictionary with annotations",)), ([3], ("annotation 0", "is a int")),
        ([{"frame_dir": "a"}], ("no array 'keypoint'", "has frame_dir")),
        ([SOUND | {"keypoint": [1, 2]}], ("no array 'keypoint'",)),
        ([SOUND | {"keypoint": np.ones((4, 17))}], ("annotation 0 ('a')", "(people, frames, joints, 2 or 3)")),
        ([SOUND | {"keypoint": np.ones((1, 4, 17, 5))}], ("(1, 4, 17, 5)",)),
        ([SOUND | {"keypoint": np.ones((1, 0, 17, 2))}], ("(1, 0, 17, 2)",)),
        ([SOUND | {"keypoint": np.ones((1, 300_000_000, 0, 2), np.float32)}], ("(1, 300000000, 0, 2)",)),
        ([SOUND | {"keypoint": np.array([[[["a", "b"]]]])}], ("<U1",)), ([SOUND | {"label": 2**63}], ("label must be a number",)),
        ([SOUND | {"keypoint_score": np.ones((1, 4, 9))}], ("keypoint_score must be (1, 4, 17)",)),
        ([SOUND | {"keypoint_score": 0.5}], ("got a float",)), ([SOUND | {"label": [1, 2]}], ("label must be a number or text",)),
        ({"split": 3, "annotations": [SOUND]}, ("split must be lists of names",)),
        ([SOUND | {"keypoint": np.full((1, 4, 17, 2), np.inf)}], ("infinite coordinates",)),
    ],
)  # fmt: skip
def test_sets_that_are_none_are_refused(data: Any, words: tuple[str, ...], tmp_path: Path) -> None:
    (tmp_path / "set.pkl").write_bytes(pickle.dumps(data))
    refused(tmp_path / "set.pkl", *words)


def test_the_same_array_again_and_again_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reader, "GROWTH_BLOCK", (2**20, 4))
    (tmp_path / "set.pkl").write_bytes(pickle.dumps([{**SOUND, "keypoint": np.ones((1, 400, 17, 2))}] * 5000))
    refused(tmp_path / "set.pkl", "the same array again and again")
    monkeypatch.setattr(reader, "GROWTH_BLOCK", (8 * 4 * (34 + 1) - 1, 0))
    (tmp_path / "set.pkl").write_bytes(pickle.dumps([SOUND]))
    refused(tmp_path / "set.pkl", "the same array again and again")
    monkeypatch.setattr(reader, "GROWTH_BLOCK", (8 * 4 * (34 + 1), 0))
    assert len(read(tmp_path / "set.pkl")) == 1
    size, long = 2**20, struct.pack("<I", 2**20)
    text = b"X" + long + b"a" * size + b"X\x06\x00\x00\x00latin1\x86q\x010"
    texts = name("_codecs", "encode") + b"q\x000" + text + b"h\x00h\x01R0" * 1000 + b"N."
    code = name("numpy", "dtype") + b"X\x08\x00\x00\x00S1048576\x85R"
    scalars = (
        name(MULTIARRAY, "scalar") + b"q\x00" + code + b"B" + long + b"x" * size + b"\x86q\x01(" + b"h\x00h\x01R" * 2000 + b"l."
    )
    made = name(MULTIARRAY, "_reconstruct") + b"q\x00" + name("numpy", "ndarray") + b"K\x00\x85C\x01b\x87q\x01"
    state = b"(K\x01J" + long + b"\x85" + name("numpy", "dtype") + b"X\x02\x00\x00\x00u1\x85R\x89X" + long + b"x" * size + b"tq\x02"
    for program in (texts, scalars, made + state + b"(" + b"h\x00h\x01Rh\x02b" * 2000 + b"l."):
        (tmp_path / "a.pkl").write_bytes(program)
        refused(tmp_path / "a.pkl", "the same bytes again and again", action=read_pickle)


def test_one_list_of_names_in_many_parts_is_refused(tmp_path: Path) -> None:
    names = [f"{i:x}" for i in range(500)]
    data = {"split": {f"{i:x}": names for i in range(100)}, "annotations": [SOUND]}
    (tmp_path / "set.pkl").write_bytes(pickle.dumps(data))
    refused(tmp_path / "set.pkl", "split has 100 parts with more names than the file has bytes")
    empty: list[str] = []
    data = {"split": {f"{i:x}": empty for i in range(2000)}, "annotations": [SOUND] * 100}
    (tmp_path / "set.pkl").write_bytes(pickle.dumps(data))
    refused(tmp_path / "set.pkl", "split has 2000 parts with more names")


# ---- hostile pickles -----------------------------------------------------------------------------------------------------
class Calls:
    """Calls something when it is unpickled by Python."""

    def __init__(self, called: Any, *arguments: Any, state: Any = None) -> None:
        self.called, self.arguments, self.state = called, arguments, state

    def __reduce__(self) -> Any:
        return (self.called, self.arguments) if self.state is None else (self.called, self.arguments, self.state)


NAMED = [
    (os.system, ("echo harm",)),
    (builtins.eval, ("1",)),
    (builtins.getattr, (1, "real")),
    (builtins.__import__, ("os",)),
    (subprocess.Popen, (["ls"],)),
    (functools.partial, (print,)),
    (np.frombuffer, (b"1",)),
    (np.zeros, ((10**12,),)),
    (collections.OrderedDict, ()),
    (Path, ("/etc",)),
]


def test_every_other_name_is_refused_and_said(tmp_path: Path) -> None:
    cases = {
        f"{i} {called!r} {protocol}": partial(check_name, called, arguments, protocol, tmp_path)
        for i, (called, arguments) in enumerate(NAMED)
        for protocol in (0, 2, 4)
    }
    assert list_failures(cases) == {}


def check_name(called: Any, arguments: tuple[Any, ...], protocol: int, tmp_path: Path) -> None:
    for data in (Calls(called, *arguments), called, [{**SOUND, "label": Calls(called, *arguments)}]):
        try:
            (tmp_path / "a.pkl").write_bytes(pickle.dumps(data, protocol))
        except pickle.PicklingError:
            continue
        refused(tmp_path / "a.pkl", "the pickle holds the name")


def name(module: str, attribute: str) -> bytes:
    return b"c" + module.encode() + b"\n" + attribute.encode() + b"\n"


MULTIARRAY = "numpy.core.multiarray"
ARRAY = name(MULTIARRAY, "_reconstruct") + b"(" + name("numpy", "ndarray") + b"K\x00\x85C\x01bt R".replace(b" ", b"")
FLOAT = (
    name("numpy", "dtype") + b"(X\x02\x00\x00\x00f8\x89\x88tR(K\x03X\x01\x00\x00\x00<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
)
TYPE = name("numpy", "dtype") + b"(X\x02\x00\x00\x00f8\x89\x88tR"
OBJECT = name("numpy", "dtype") + b"(X\x02\x00\x00\x00O8\x89\x88tR"

PADDING = b"B" + struct.pack("<I", 2**20) + bytes(2**20) + b"0"  # a file of that size may have so many steps

PROGRAMS: dict[str, tuple[bytes, str]] = {
    "system by its other name": (name("posix", "system") + b"(X\x02\x00\x00\x00lstR.", "posix.system"),
    "a name with dots": (name("numpy", "core.multiarray.os.system") + b".", "numpy.core.multiarray.os"),
    "a name from the stack": (b"\x8c\x02os\x8c\x06system\x93.", "os.system"),
    "a name that is no text": (b"K\x01K\x02\x93.", "cannot be read"),
    "an instance": (b"(ios\nsystem\n.", "the step INST"),
    "an object": (b"(" + name("os", "system") + b"o.", "os.system"),
    "an object of a known name": (b"(" + name("numpy", "dtype") + b"o.", "the step OBJ"),
    "a new object": (name("numpy", "dtype") + b")\x81.", "the step NEWOBJ"),
    "a new object with words": (name("numpy", "dtype") + b")}\x92.", "the step NEWOBJ_EX"),
    "a persistent id": (b"P1\n.", "a persistent id"),
    "a persistent id on the stack": (b"K\x01Q.", "a persistent id"),
    "an extension": (b"\x82\x01.", "an extension code"),
    "a buffer from elsewhere": (b"\x97.", "outside of the file"),
    "a function changed": (name(MULTIARRAY, "_reconstruct") + b"}X\x0c\x00\x00\x00__defaults__)sb.", "a change to a function"),
    "a function's slots changed": (
        name(MULTIARRAY, "scalar") + b"N}X\x07\x00\x00\x00_calledK\x01s\x86b.",
        "a change to a function",
    ),
    "an array called": (name("numpy", "ndarray") + b"K\x05\x85R.", "a call of numpy.ndarray"),
    "an array of another class": (
        name(MULTIARRAY, "_reconstruct") + b"(" + name("numpy", "dtype") + b"K\x00\x85C\x01btR.",
        "of another class",
    ),
    "an array of objects": (OBJECT + b".", "an array of 'O8'"),
    "a scalar of objects": (name(MULTIARRAY, "scalar") + OBJECT + b"C\x01a\x86R.", "an array of 'O8'"),
    "a scalar of a pickle": (name(MULTIARRAY, "scalar") + FLOAT + b"K\x01\x86R.", "an array of Python objects"),
    "records": (name("numpy", "dtype") + b"(X\x02\x00\x00\x00V8\x89\x88tR.", "an array of 'V8'"),
    "records by their state": (TYPE + b"(K\x03X\x01\x00\x00\x00<N)}J\x08\x00\x00\x00K\x01K\x00tb.", "array of records"),
    "a text as a type": (name("numpy", "dtype") + b"(X\x0b\x00\x00\x00f8,f8,f8,f8\x89\x88tR.", "neither numbers nor text"),
    "a huge type": (name("numpy", "dtype") + b"(X\x0b\x00\x00\x00U9999999999\x89\x88tR.", "numpy does not know"),
    "too few bytes": (ARRAY + b"(K\x01K\x09\x85" + FLOAT + b"\x89C\x08abcdefghtb.", "8 bytes for the shape (9,)"),
    "a huge shape": (
        ARRAY + b"(K\x01\x8a\x0a" + b"\x00" * 9 + b"\x01\x85" + FLOAT + b"\x89C\x08abcdefghtb.",
        "8 bytes for the shape",
    ),
    "a shape below zero": (ARRAY + b"(K\x01J\xff\xff\xff\xff\x85" + FLOAT + b"\x89C\x08abcdefghtb.", "without its parts"),
    "an empty array of many rows": (
        ARRAY + b"(K\x01\x8a\x06\x00\x00\x00\x00\x00\x01K\x00\x86" + FLOAT + b"\x89C\x00tb.",
        "an array of the shape",
    ),
    "a state that is none": (ARRAY + b"K\x01b.", "without its parts"),
    "an array never filled": (ARRAY + b".", "without its parts"),
    "an array inside itself": (ARRAY + b"q\x00(K\x01h\x00\x85h\x00\x89C\x00tb.", "without its parts"),
    "another encoding": (name("_codecs", "encode") + b"X\x01\x00\x00\x00aX\x05\x00\x00\x00rot13\x86R.", "in the encoding"),
    "a part of an array": (FLOAT + b".", "outside of one"),
    "a name": (name("numpy", "dtype") + b".", "outside of one"),
    "a huge memo": (b"Nr\xff\xff\xff\x7f0N.", ""),
    "a memo that is empty": (b"h\x07.", "cannot be read"),
    "a huge length": (b"\x8e" + struct.pack("<Q", 2**62) + b"abc.", "cannot be read"),
    "a huge array of bytes": (b"\x96" + struct.pack("<Q", 2**40) + b"abc.", "cannot be read"),
    "a huge frame": (b"\x80\x04\x95" + struct.pack("<Q", 2**40) + b"N.", ""),
    "a huge number": (b"\x8b" + struct.pack("<i", 2**30) + b"abc.", "cannot be read"),
    "a number below zero": (b"\x8b" + struct.pack("<i", -5) + b"abc.", "cannot be read"),
    "a number of thousands of digits": (b"I" + b"9" * 10_000 + b"\n.", "cannot be read"),
    "steps without end": (b"(" * 3_000_000, "more steps than its size allows"),
    "a stack that is empty": (b"0.", "cannot be read"),
    "no value": (b".", "cannot be read"),
    "nothing": (b"\x80\x04", "cannot be read"),
    "a protocol of the future": (b"\x80\x63N.", "cannot be read"),
    "no step": (b"\xff.", "the step"),
    "a list that is none": (b"K\x01K\x02a.", "cannot be read"),
    "an unhashable key": (b"}]K\x01s.", "a key of the type list"),
    # tuples in tuples: hashed by going into them, so deep that C has no stack left, or 2^60 times
    "a deep key": (PADDING + b"})" + b"\x85" * 200_000 + b"Ns.", "a key of the type tuple"),
    "a deep key among others": (PADDING + b"}()" + b"\x85" * 200_000 + b"Nu.", "a key of the type tuple"),
    "a deep key of a dictionary": (PADDING + b"()" + b"\x85" * 200_000 + b"Nd.", "a key of the type tuple"),
    "a wide key": (b"})" + b"2\x86" * 60 + b"Ns.", "a key of the type tuple"),
    "a deep value of a set": (PADDING + b"\x8f()" + b"\x85" * 200_000 + b"\x90.", "a set"),
    "a deep value of a frozen set": (PADDING + b"()" + b"\x85" * 200_000 + b"\x91.", "a set"),
    "a value of numpy's as a key": (
        b"}" + name(MULTIARRAY, "scalar") + FLOAT + b"C\x08abcdefgh\x86RNs.",
        "a key of the type float64",
    ),
    "keys of one hash": (
        b"}(" + b"".join(b"\x8a\x0a" + (i * (2**61 - 1) + 5).to_bytes(10, "little") + b"N" for i in range(20_000)) + b"u.",
        "the key 2305843009213693956",
    ),
    "many numbers as keys": (b"}(" + b"".join(b"J" + struct.pack("<i", i) + b"N" for i in range(10_000)) + b"u.", "8192 numbers"),
    "keys of a list": (b"](K\x01K\x02u.", "without a dictionary"),
    "a key without a value": (b"}(K\x01u.", "without a dictionary"),
    "a type of many digits": (name("numpy", "dtype") + b"X\x0d\x00\x00\x00f000000000008\x85R.", "neither numbers nor text"),
    "a shape of empty texts": (
        ARRAY + b"(K\x01M\xff\xffM\xff\xff\x86" + name("numpy", "dtype") + b"X\x02\x00\x00\x00U0\x85R\x89C\x00tb.",
        "an array of the shape",
    ),
}


@pytest.mark.slow
def test_programs_that_do_harm_are_refused(tmp_path: Path) -> None:
    assert list_failures({program: partial(check_program, program, tmp_path) for program in PROGRAMS}) == {}


def check_program(program: str, tmp_path: Path) -> None:
    data, word = PROGRAMS[program]
    (tmp_path / "a.pkl").write_bytes(data)
    if word:
        refused(tmp_path / "a.pkl", word, action=read_pickle)
    else:  # what C would make a table of 16 GB of is a number in a dictionary, and a frame ends where the file does
        assert read_pickle(tmp_path / "a.pkl") is None


def test_lists_that_are_deep_or_inside_themselves_are_refused_without_end(tmp_path: Path) -> None:
    endless: list[Any] = []
    endless.append(endless)
    billion: list[Any] = ["x"]
    for _ in range(40):
        billion = [billion] * 10
    deep = b"]q\x00" + b"]" * 50_000 + b"a" * 50_000 + b"."
    for program, word in (
        (deep, ""),
        (pickle.dumps({"annotations": endless}), "annotation 0"),
        (pickle.dumps(billion), "is a list"),
    ):
        (tmp_path / "a.pkl").write_bytes(program)
        refused(tmp_path / "a.pkl", word)


def test_nothing_is_imported_or_changed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = pickle.dumps(Calls(os.system, f"touch {tmp_path / 'harm'}"))

    def never(*_: Any, **__: Any) -> Any:
        raise AssertionError("a file was obeyed")

    monkeypatch.setattr(os, "system", never)
    monkeypatch.setattr(builtins, "__import__", never)
    assert isinstance(pickle._Unpickler.dispatch, dict)
    with pytest.raises(ValueError, match="system"):
        unpickle_bytes(tmp_path, program, "")


def test_what_is_pickled_is_read_as_it_was() -> None:
    value = {
        "a": np.arange(6.0).reshape(2, 3), "b": np.asfortranarray(np.arange(6.0).reshape(2, 3)), "c": np.arange(3, dtype=">i4"),
        "d": np.array(["ab", "c"]), "e": np.zeros((0, 3)), "f": np.array(True), "g": np.float32(2.5), "h": np.int64(7),
        "i": np.array([b"x"]), "j": b"", "k": (1, "two", None, -3.5), "l": [True, 2**70], "m": np.float16([1, 2]),
    }  # fmt: skip
    for protocol in range(6):
        found = unpickle_bytes(Path("a.pkl"), pickle.dumps(value, protocol), "")
        assert list(found) == list(value)
        for key, one in value.items():
            np.testing.assert_array_equal(found[key], one)
            assert getattr(found[key], "dtype", None) == getattr(one, "dtype", None)
    value = {"a": 1, b"b": 2, 3: 3, -(2**53): 4, 2.5: 5, None: 6, False: 7, **{f"class {i}": i for i in range(9000)}}
    for protocol in range(6):
        assert unpickle_bytes(Path("a.pkl"), pickle.dumps(value, protocol), "") == value
    numbers = [i * (2**61 - 1) + 5 for i in range(20_000)]  # all of one hash
    program = b"N" + b"".join(b"p%d\n" % number for number in numbers) + b"0](" + b"g%d\ng%d\n" % (numbers[0], numbers[-1]) + b"e."
    assert unpickle_bytes(Path("a.pkl"), program + bytes(2**16), "") == [None, None]
    reader_ = _Reader(program)
    assert reader_.load() == [None, None]
    assert len({hash(key) for key in reader_.memo}) > 19_000


def test_annotations_without_people_are_left_out(tmp_path: Path) -> None:
    nobody = SOUND | {"keypoint": np.ones((0, 300_000_000, 17, 2), np.float32), "keypoint_score": np.ones((0, 300_000_000, 17))}
    (tmp_path / "some.pkl").write_bytes(pickle.dumps([nobody, SOUND]))
    assert len(read(tmp_path / "some.pkl")) == 1
