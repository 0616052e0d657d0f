"""Files of labels that were damaged, or made to do harm: read, or refused in one line that names them."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import pytest

from indexing.labels import Label, choose_labels, markup, open_labels, write_labels
from tests.fuzz import mutations
from tests.indexing.labels import test_boris, test_elan

LABELS = [
    Label(1, 3, "squat", "Ann", comment="c", score=1.5, modifiers=("m",)),
    Label(2, 4, "squat", "Ann"),
    Label(5, 5, "clap", tier="t", observation="o"),
]
VIA_TABLE = """# Exported using VGG Image Annotator (http://www.robots.ox.ac.uk/~vgg/software/via)
# ATTRIBUTE = {"1":{"aname":"acts","anchor_id":"FILE1_Z2_XY0","type":4,"options":{"0":"squat","1":"clap"}}}
# CSV_HEADER = metadata_id,file_list,flags,temporal_coordinates,spatial_coordinates,metadata
"1_a","[""session.mp4""]",0,"[1.5,2.5]","[]","{""1"":""0""}"
"1_b","[""session.mp4""]",0,"[4]","[]","{""1"":""1""}"
"1_c","[""session.mp4""]",0,"[4]","[2,10,20,50,80]","{""1"":""1""}"
"""


BOTH = json.dumps(
    {
        "database": {"a": {"duration": 60, "annotations": [{"segment": [1, 2], "label": "squat"}]}},
        "results": {"b": [{"segment": [3, 4.5], "label": "wave", "score": 0.5}]},
    }
)


def written(name: str, suffix: str) -> Callable[[Path], Path]:
    """A sound file as this package writes it."""

    def make(folder: Path) -> Path:
        path = folder / f"{name}{suffix}"
        write_labels(path, LABELS, recording="session.mp4", duration=60, fps=25, format=name)
        return path

    return make


def by_hand(name: str, text: str) -> Callable[[Path], Path]:
    """A sound file as other programs write it."""

    def make(folder: Path) -> Path:
        path = folder / name
        path.write_text(text, encoding="utf-8")
        return path

    return make


def elan(folder: Path) -> Path:
    note = test_elan.tier("note", test_elan.referring("a6", "a4", "deep"), kind="same", more=' PARENT_REF="parts"')
    bits = test_elan.tier("bits", test_elan.referring("a7", "a6", "x"), test_elan.referring("a8", "a6", "y", "a7"), kind="part")
    return test_elan.eaf(folder / "hand.eaf", test_elan.TIMES, test_elan.ACTS, test_elan.PARTS, note, bits)


def boris(folder: Path) -> Path:
    one = test_boris.observation(test_boris.EVENTS, {"1": ["session.mp4", "b.mp4"], "2": ["c.mp4"]})
    return test_boris.project(folder / "hand.boris", {"one": one, "two": test_boris.observation(test_boris.EVENTS)})


SEEDS: dict[str, Callable[[Path], Path]] = {
    "boris": boris,
    "elan": elan,
    "tabular": by_hand("tabular.tsv", test_boris.OLD),
    "aggregated": by_hand("agg.tsv", test_boris.AGGREGATED + "one\ta.mp4\t90\t25\tAnn\tsquat\tl\tSTATE\t1.800\t8.125\t6.3\tx\ty\n"),
    "via table": by_hand("via.csv", VIA_TABLE),
    **{name: written(name, suffix) for name, suffix in {"csv": ".csv", "tsv": ".tsv", "activitynet": ".json"}.items()},
    **{f"our {name}": written(name, suffix) for name, suffix in {"boris": ".boris", "elan": ".eaf"}.items()},
    **{name: written(name, ".json") for name in ("label_studio", "via")},
    "activitynet, both parts": by_hand("both.json", BOTH),
}


def used(path: Path) -> None:
    """Read a file in all ways, and write beside what is in it: done, or refused in one line."""
    for action in (
        lambda: choose_labels(open_labels(path, fps=25)),
        lambda: open_labels(path, recording="session.json", fps=25),
        lambda: open_labels(path, fps=25).labels[0].duration,
        lambda: write_labels(path, LABELS[:2], recording="session.mp4") if path.suffix in (".eaf", ".boris") else None,
    ):
        before = path.read_bytes()
        try:
            action()
        except IndexError:
            pass  # no labels
        except ValueError as refused:
            said = str(refused)
            assert type(refused) is ValueError  # noqa: PT017  (some may be read)
            assert str(path) in said
            assert "\n" not in said and said.isprintable()
            assert "; " in said
            assert len(said.replace(str(path), "")) < 500
            assert path.read_bytes() == before


@pytest.mark.parametrize("name", SEEDS)
def test_sound_files_are_read(name: str, tmp_path: Path) -> None:
    path = SEEDS[name](tmp_path)
    assert open_labels(path, fps=25).labels
    used(path)


@pytest.mark.parametrize("name", SEEDS)
def test_files_that_were_cut_off(name: str, tmp_path: Path) -> None:
    path = SEEDS[name](tmp_path)
    data = path.read_bytes()
    for part in range(24):
        path.write_bytes(data[: len(data) * part // 24])
        used(path)


@pytest.mark.parametrize("name", SEEDS)
def test_files_that_were_damaged(name: str, tmp_path: Path) -> None:
    path = SEEDS[name](tmp_path)
    data = path.read_bytes()
    for number in range(120):
        rng = Random(f"{name} {number}")
        text = data.decode()
        if data.startswith((b"{", b"[")) and number % 3 == 0:
            path.write_bytes(mutations.dumped(mutations.of_json(json.loads(data), rng)))
        elif number % 3 == 1:
            path.write_bytes(mutations.of_text(text, rng).encode("utf-8", "replace"))
        else:
            path.write_bytes(mutations.of_bytes(data, rng))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            used(path)


NOTHING: list[Any] = [None, True, 0, -1, 1.5, float("nan"), float("inf"), 10**400, "", "x", [], {}, [[]], [None], {"a": 1}]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["boris", "activitynet, both parts", "label_studio", "via"])
def test_every_value_of_a_json_file_may_be_something_else(name: str, tmp_path: Path) -> None:
    path = SEEDS[name](tmp_path)
    whole = json.loads(path.read_text())

    def places(value: Any, *keys: Any) -> Any:
        yield keys
        for key, inner in value.items() if isinstance(value, dict) else enumerate(value[:3]) if isinstance(value, list) else ():
            yield from places(inner, *keys, key)

    rng = Random(0)
    for keys in places(whole):
        for wrong in rng.sample(NOTHING, 2 if name == "boris" else 5):  # a project has many places of each kind
            changed = json.loads(json.dumps(whole))
            inside = changed
            for key in keys[:-1]:
                inside = inside[key]
            if keys:
                inside[keys[-1]] = wrong
            path.write_text(json.dumps(changed if keys else wrong))
            used(path)


@pytest.mark.parametrize(
    ("name", "data", "said"),
    [
        ("a.boris", b"\x1f\x8b\x08\x00" + b"\x00" * 40, "is compressed"),
        ("a.csv", b"PK\x03\x04" + b"\x00" * 40, "is a zip archive or a spreadsheet; export it as TSV or CSV"),
        ("a.csv", "label,start,end".encode("utf-16"), "is text in UTF-16; save it in UTF-8"),
        ("a.csv", b"label,start,end\n\xff\xfe\xfd,1,2\n", "is not a text file in UTF-8"),
        ("a.csv", b"", "the file is empty"),
        ("a.json", b"{}", "JSON without labels that a reader knows"),
        ("a.json", b"[1, 2]", "a list of no tasks"),
        ("a.json", b"[" * 100_000, "nested too deeply"),
        ("a.json", b'{"observations": ' * 5000, "nested too deeply|not valid JSON"),
        ("a.csv", b"label,start,end\nsquat,1,0.5\n", "line 2: ends at 0.5 s, but starts at 1 s; give start first"),
        ("a.csv", b"label,start,end\nsquat,nan,1\n", "line 2: column 'start': 'nan' is no time; give seconds"),
        ("a.csv", b"label,start\nsquat,1\n", "has no column 'end'"),
        ("a.csv", b"name,start,end\nsquat,1,2\n", r"has no column 'label' \(the first line has name, start, end\)"),
        ("a.csv", b"label,start_frame,end_frame\nsquat,1,2\n", r"counts frames \(column 'start_frame'\).*give them \(--fps\)"),
    ],
)
def test_what_is_said(name: str, data: bytes, said: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(data)
    with pytest.raises(ValueError, match=said):
        open_labels(path)


def test_no_file_at_all(tmp_path: Path) -> None:
    for path in (tmp_path / "none.csv", tmp_path):
        with pytest.raises(ValueError, match=str(path)):
            open_labels(path)
        with pytest.raises(ValueError, match=str(path)):
            write_labels(tmp_path / "out.eaf", LABELS, recording="session.mp4", into=path)


def test_a_limit_to_the_size_of_a_tree(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(markup, "MAX_ELEMENTS", 10)
    path = elan(tmp_path)
    with pytest.raises(ValueError, match="has more than 10 XML elements; split it"):
        open_labels(path)
