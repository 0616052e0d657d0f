"""Tables, ActivityNet, Label Studio and VIA as they come from other programs; which recording labels are of; where it ends."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path
from random import Random
from typing import Any

import pytest

from indexing.labels import Label, choose_labels, markup, open_labels, read_labels, within, write_labels
from indexing.labels.format import Request, base_name, of_recording
from indexing.labels.label import sort_key
from indexing.opening import first_duplicate
from tests.indexing.labels import test_boris, test_elan


def saved(path: Path, value: Any) -> Path:
    path.write_text(value if isinstance(value, str) else json.dumps(value), encoding="utf-8")
    return path


# ---- tables --------------------------------------------------------------------------------------------------------------
def test_tables(tmp_path: Path) -> None:
    for text in (
        "label,start,end\nsquat,1.5,4\n",
        "Action;Begin;Stop\nsquat;1,5;4,0\n",
        "behaviour\tonset\toffset\nsquat\t0:01.5\t00:00:04.000\n",
        "start,duration,behavior\n1.5,2.5,squat\n",
        "\ufefflabel,start_frame,end_frame\nsquat,45,120\n",
        "label,start,end\n\n squat ,1.5,4,,,\n\n",
    ):
        assert read_labels(saved(tmp_path / "a.csv", text), fps=30) == [Label(1.5, 4.0, "squat")]


def test_all_that_a_table_can_say(tmp_path: Path) -> None:
    head = "label,start,end,person,file,tier,annotator,comment,modifiers,score\n"
    path = saved(tmp_path / "a.csv", head + 'squat,1,2,Ann,films/a.mp4,t,Ben,"so, so",deep|slow,4.5\nclap,1,1,,b.mp4,,Ben,,,\n')
    found = open_labels(path)
    assert found.labels[1] == Label(
        1, 2, "squat", "Ann", "films/a.mp4", "t", "Ben", comment="so, so", modifiers=("deep", "slow"), score=4.5
    )
    assert (found.media, found.observations, found.subjects, found.tiers) == (("films/a.mp4", "b.mp4"), ("Ben",), ("Ann",), ("t",))
    assert [label.label for label in open_labels(path, recording="a.json").labels] == ["squat"]
    assert "1 label left out: of other recordings (b.mp4)" in open_labels(path, recording="a.json").notices


def test_what_is_left_out_or_taken_together_is_said(tmp_path: Path) -> None:
    found = open_labels(saved(tmp_path / "a.csv", "label,start,end\nsquat,1,2\nsquat,1,2.0\nsquat,1,3\n"))
    assert len(found.labels) == 2
    assert found.notices == ("1 label left out: there twice (squat at 1-2 s)",)
    path = saved(tmp_path / "a.csv", "label,start,end\n,1,2\nsquat,1,3\n")
    with pytest.warns(UserWarning, match=r"a\.csv: 1 label without a name left out"):
        assert len(read_labels(path)) == 1
    path = saved(tmp_path / "a.csv", "label,start,end,tier\nsquat,1,2,a\nsquat,1,3,b\n")
    assert choose_labels(open_labels(path)).notices == ("labels of 2 tiers are taken together (a, b); --tier NAME takes one",)
    assert len(open_labels(path, tier="a").labels) == 1
    with pytest.raises(ValueError, match="has no subject 'Ann', only none; give one of these"):
        open_labels(path, subject="Ann")


# ---- ActivityNet ---------------------------------------------------------------------------------------------------------
def test_activitynet(tmp_path: Path) -> None:
    truth = {"database": {"v_1": {"duration": 9, "subset": "training", "annotations": [{"segment": [1, 2.5], "label": "Jump"}]}}}
    assert read_labels(saved(tmp_path / "a.json", truth), recording="v_1.mp4") == [Label(1, 2.5, "Jump", media="v_1")]
    found = {"version": "x", "results": {"v_1": [{"label": "Jump", "score": 0.5, "segment": [1, 2.5]}], "v_2": []}}
    assert read_labels(saved(tmp_path / "b.json", found)) == [Label(1, 2.5, "Jump", media="v_1", score=0.5)]
    bad = {"results": {"v_1": [{"label": "Jump", "segment": [1]}]}}
    with pytest.raises(ValueError, match=r"video 'v_1', segment 1: 'segment' is \[1\], not \[start, end\]"):
        open_labels(saved(tmp_path / "c.json", bad))
    for part, wrong in product(("database", "results"), ([1], "a", 3, True)):
        path = saved(tmp_path / "a.json", {"database": {}, "results": {}} | {part: wrong})
        with pytest.raises(ValueError, match=rf"a\.json: '{part}' is .*, no object of videos; write segments as"):
            open_labels(path)
    path = saved(tmp_path / "a.json", {"database": {"a": {"annotations": []}}, "results": {"b": []}})
    assert open_labels(path).media == ("a", "b") and open_labels(path).watched == (("", "a"), ("", "b"))
    write_labels(path, [Label(1, 2, "x", media="a.mp4", score=1.0)], recording="b.mp4")
    assert json.loads(path.read_text())["results"]["b.mp4"] == []  # recordings without labels are named


# ---- Label Studio --------------------------------------------------------------------------------------------------------
def region(start: int, end: int, *names: str, **more: Any) -> dict[str, Any]:
    value = {"ranges": [{"start": start, "end": end}], "timelinelabels": list(names)}
    return {"id": "r1", "type": "timelinelabels", "from_name": "l", "to_name": "video", "value": value, **more}


def task(*regions: dict[str, Any], who: Any = 1, **more: Any) -> dict[str, Any]:
    annotations = [{"completed_by": who, "result": list(regions)}]
    return {"data": {"video": "/data/upload/1/3d3ad63e-session.mp4"}, "annotations": annotations, **more}


def test_timelines_count_frames_from_one(tmp_path: Path) -> None:
    path = saved(tmp_path / "a.json", [task(region(1, 51, "squat"), region(26, 26, "clap", "jump"))])
    of = {"media": "session.mp4", "observation": "annotator 1"}
    assert read_labels(path, recording="session.json", fps=25) == [
        Label(0, 2, "squat", **of),
        Label(1, 1, "clap", **of),
        Label(1, 1, "jump", **of),
    ]
    with pytest.raises(ValueError, match=r"counts frames, and does not say how many a second has; give them \(--fps\)"):
        read_labels(path)


def test_what_marks_no_time_is_named_and_the_least_export_is_read(tmp_path: Path) -> None:
    box = {"id": "r", "type": "videorectangle", "value": {"sequence": []}}
    words = {"id": "r", "type": "labels", "value": {"start": 1, "end": 5, "text": "hello", "labels": ["greeting"]}}
    sound = {"id": "r", "type": "labels", "value": {"start": 1.25, "end": 5, "channel": 0, "labels": ["song"]}}
    found = open_labels(saved(tmp_path / "a.json", [task(box, words, sound)]))
    assert [(label.start, label.label) for label in found.labels] == [(1.25, "song")]
    assert found.notices == ("2 regions left out: they mark no time (videorectangle: 1, labels: 1)",)
    one = {"id": 1, "video": "s3://films/session.mp4", "annotator": 3, "l": [region(1, 26, "squat")["value"]]}
    assert read_labels(saved(tmp_path / "a.json", [one]), fps=25) == [
        Label(0, 1, "squat", media="session.mp4", observation="annotator 3")
    ]


def test_annotators_and_predictions(tmp_path: Path) -> None:
    predictions = [{"model_version": "yolo", "result": [region(1, 26, "squat", score=0.5)]}, 17]
    path = saved(tmp_path / "a.json", [task(region(1, 51, "squat"), who={"email": "a@b.c"}, predictions=predictions)])
    found = open_labels(path, fps=25)
    assert (found.observations, found.machine) == (("a@b.c", "yolo"), ("yolo",))
    chosen = choose_labels(found)
    assert [label.end for label in chosen.labels] == [2]
    assert "1 label left out: a program found them (yolo); --observation NAME reads them" in chosen.notices


# ---- VIA -----------------------------------------------------------------------------------------------------------------
VIA = {
    "project": {"pname": "p"},
    "attribute": {
        "1": {"aname": "acts", "anchor_id": "FILE1_Z2_XY0", "type": 4, "options": {"0": "squat", "default": "Default"}},
        "2": {"aname": "parts", "anchor_id": "FILE1_Z2_XY0", "type": 2, "options": {"a": "left", "b": "right"}},
        "3": {"aname": "Person", "anchor_id": "FILE1_Z2_XY0", "type": 1, "options": {}},
    },
    "file": {"1": {"fid": "1", "fname": "session.mp4", "src": "films/session.mp4"}, "2": {"fname": "", "src": "films/other.mp4"}},
    "view": {"1": {"fid_list": ["1"]}, "2": {"fid_list": ["2"]}},
    "metadata": {
        "1_a": {"vid": "1", "flg": 0, "z": [1.5, 4], "xy": [], "av": {"1": "0", "2": "a,b", "3": "Ann"}},
        "1_b": {"vid": "1", "flg": 0, "z": [7], "xy": [], "av": {"1": "walk"}},
        "1_c": {"vid": "1", "flg": 0, "z": [7], "xy": [2, 10, 20, 50, 80], "av": {"1": "0"}},
        "1_d": {"vid": "1", "flg": 0, "z": [], "xy": [], "av": {"1": "0"}},
        "1_e": {"vid": "1", "flg": 0, "z": [8, 9], "xy": [], "av": {}},
        "2_a": {"vid": "2", "flg": 0, "z": [1, 2], "xy": [], "av": {"1": "default"}},
    },
}


def test_via_projects(tmp_path: Path) -> None:
    path = saved(tmp_path / "a.json", VIA)
    found = open_labels(path, recording="session.json")
    of = {"media": "session.mp4"}
    assert found.labels == (
        Label(1.5, 4, "left", "Ann", tier="parts", **of),
        Label(1.5, 4, "right", "Ann", tier="parts", **of),
        Label(1.5, 4, "squat", "Ann", tier="acts", **of),
        Label(7, 7, "walk", tier="acts", **of),
    )
    assert found.notices == (
        "1 annotation left out: regions of the picture, without a time that they last",
        "1 annotation left out: of a whole file, without a time that they last",
        "1 label without a name left out ((no name) at 8-9 s)",
        "1 label left out: of other recordings (other.mp4)",
    )
    assert [label.label for label in open_labels(path, recording="other.csv").labels] == ["Default"]


def test_via_tables(tmp_path: Path) -> None:
    found = open_labels(saved(tmp_path / "a.csv", VIA_TABLE))
    of = {"media": "session.mp4", "tier": "acts"}
    assert found.labels == (Label(1.5, 2.5, "squat", **of), Label(4, 4, "clap", **of))
    old = (
        "# Exported\nmetadata_id,file_list,temporal_segment_start,temporal_segment_end,metadata\n"
        'x,"[""a.mp4""]",1,2,"{""TEMPORAL-SEGMENTS"":""walk""}"\n'
    )
    assert read_labels(saved(tmp_path / "b.csv", old)) == [Label(1, 2, "walk", media="a.mp4", tier="TEMPORAL-SEGMENTS")]


# ---- which recording -----------------------------------------------------------------------------------------------------
def test_names_say_which_recording_labels_are_of() -> None:
    for recording, names, mine in (
        ("a/session.json", ["session.mp4", "session2.mp4"], "session.mp4"),
        ("session_keypoints.json", ["session.mp4", "other.mp4"], "session.mp4"),
        ("sessionDLC_resnet50_x.csv", ["session.mp4", "other.mp4"], "session.mp4"),
        ("SESSION.json", ["session.MP4", "other.mp4"], "session.MP4"),
        ("folder/cam1", ["C:\\films\\cam1.avi", "C:\\films\\cam10.avi"], "C:\\films\\cam1.avi"),
        ("b/cam.mp4", ["/x/a/cam.mp4", "/x/b/cam.mp4"], "/x/b/cam.mp4"),
        ("session_cam1.json", ["session.mp4", "session_cam1.mp4"], "session_cam1.mp4"),
        ("take.2024.json", ["take.2024.mp4", "take.2023.mp4"], "take.2024.mp4"),
    ):
        assert of_recording(names, Request(Path("l.csv"), recording)) == {mine}
    for recording, names, said in (
        ("sessions.json", ["session.mp4"], "l.csv: its labels are of session.mp4, not of sessions.json; name the recording as"),
        ("s.json", ["s_cam1.mp4", "s_cam2.mp4"], "s.json may be any of s_cam1.mp4, s_cam2.mp4"),
    ):
        with pytest.raises(ValueError, match=re.escape(said)):
            of_recording(names, Request(Path("l.csv"), recording))
    assert of_recording(["x/a.mp4", "b.mp4"], Request(Path("l.csv"), "z.json", "a.mp4")) == {"x/a.mp4"}
    with pytest.raises(ValueError, match=r"has no labels of c\.mp4, only of a\.mp4; give one of these names \(--media\)"):
        of_recording(["a.mp4"], Request(Path("l.csv"), "z.json", "c.mp4"))
    assert of_recording([], Request(Path("l.csv"), "z.json")) is None
    assert base_name("file:///C:/x%20y/") == "x y"


# ---- where it ends -------------------------------------------------------------------------------------------------------
def test_labels_outside_of_the_recording(monkeypatch: pytest.MonkeyPatch) -> None:
    labels = [Label(-1, 0.5, "a"), Label(0, 10.05, "b"), Label(10.05, 10.05, "c"), Label(10.02, 10.08, "d"), Label(11, 12, "e")]
    kept, notices = within(labels, 0, 10, "session.json")
    assert kept == [Label(0, 0.5, "a"), Label(0, 10, "b"), Label(10, 10, "c")]
    assert notices == [
        "2 labels left out: outside session.json, which runs from 0 to 10 s (d at 10.02-10.08 s, e at 11-12 s)",
        "1 label cut: session.json runs from 0 to 10 s (a at -1-0.5 s)",
    ]
    monkeypatch.setattr("indexing.labels.label.MAX_OVERHANG_SECONDS", 2.0)
    assert [notice[:12] for notice in within(labels, 0, 10)[1]] == ["2 labels lef"]
    monkeypatch.undo()
    assert within(labels[1:2], 0, 10) == ([Label(0, 10, "b")], [])
    for times in ((float("nan"), 1), (0, float("inf")), (2, 1)):
        with pytest.raises(ValueError, match="label 'x': "):
            Label(*times, "x")


# ---- writing -------------------------------------------------------------------------------------------------------------
def test_what_cannot_be_written(tmp_path: Path) -> None:
    for name, more, said in (
        ("a.txt", {}, r"the suffix '\.txt' does not say which format to write; end the name in one of \.boris, \.csv"),
        ("a.csv", {"format": "xml"}, "unknown format='xml'; use one of activitynet, boris"),
        ("a.csv", {"into": "b.csv"}, r"labels cannot be written beside those of b\.csv; write \.boris, \.eaf"),
        ("a.boris", {"duration": 0}, "duration=0 cannot be"),
        ("a.boris", {"fps": float("nan")}, "fps=nan cannot be"),
        ("a.boris", {"tier": " "}, "tier=' ' is no name"),
        ("none/a.csv", {}, "cannot write"),
        ("a.json", {"format": "label_studio"}, "Label Studio counts frames, and nobody says how many a second has"),
    ):
        with pytest.raises(ValueError, match=said):
            write_labels(tmp_path / name, [Label(0, 1, "x")], recording="a.mp4", **more)
    assert list(tmp_path.iterdir()) == []


def test_the_video_beside_the_keypoints_is_named(tmp_path: Path) -> None:
    (tmp_path / "films").mkdir()
    (tmp_path / "films" / "session.mov").write_bytes(b"")
    keypoints = tmp_path / "films" / "session.json"
    assert write_labels(tmp_path / "a.boris", [Label(0, 1, "x")], recording=keypoints) == []
    assert open_labels(tmp_path / "a.boris").media == ("films/session.mov",)
    assert write_labels(tmp_path / "a.eaf", [Label(0, 1, "x")], recording=keypoints) == []
    assert (tmp_path / "films" / "session.mov").as_uri() in (tmp_path / "a.eaf").read_text()
    assert write_labels(tmp_path / "b.boris", [], recording="other.json") == [
        "other.json is no video: BORIS asks for one when you open b.boris"
    ]
    assert write_labels(tmp_path / "b.csv", [Label(0, 1, "x")], recording="other.json") == []


def test_formats_that_are_unknown(tmp_path: Path) -> None:
    path = saved(tmp_path / "a.csv", "label,start,end\nsquat,1,2\n")
    with pytest.raises(ValueError, match="unknown format='xml'; use one of activitynet, boris, boris_tables, elan"):
        open_labels(path, format="xml")
    with pytest.raises(ValueError, match="is of the format 'tables', not 'elan'"):
        open_labels(path, format="elan")
    with pytest.raises(ValueError, match="fps=0 is no frame rate"):
        open_labels(path, fps=0)


# What is written is read again, in every format


SUFFIX = {"boris": ".boris", "elan": ".eaf", "csv": ".csv", "tsv": ".tsv"}
FORMATS = (*SUFFIX, "activitynet", "label_studio", "via")
LOST = {"boris": ("tier",), "elan": ("observation", "comment", "modifiers", "score"), "label_studio": ()}
"""Fields that a format has no place for; the docs say the same."""
RESOLUTION = {"boris": 1e-3, "elan": 1e-3, "label_studio": 1 / 50, "csv": 1e-6, "tsv": 1e-6, "activitynet": 1e-6, "via": 1e-6}
WORDS = (
    *("squat", "arm raise", "a,b;c", 'say "hi"', "it's <b> & ]]>", "\u05e9\u05dc\u05d5\u05dd", "\u0645\u0631\u062d", "two\nlines"),
    *("tab\there", "#hash", "=1+1", "NA", "null", "0", "1.5", "\u00e9", "e\u0301", "a\\b", "%41", "-", "[x]", "{}", "\U0001f938"),
    *("(2)", "x (2)", "@Ann", "y@Ann (3)"),
)
FPS = 50.0


def draw(rng: Random, count: int, media: tuple[str, ...]) -> list[Label]:
    """Labels of all kinds, no two the same."""
    found: list[Label] = []
    names = rng.sample(WORDS, 8)
    for _ in range(count):
        start = rng.choice((rng.uniform(0, 100), float(rng.randrange(20)), 0.0))
        length = rng.choice((0.0, rng.uniform(0.04, 30), 1.0))
        found.append(
            Label(
                start,
                start + length,
                rng.choice(names),
                subject=rng.choice(("", "", "Ann", "person 2", rng.choice(names))),
                media=rng.choice(media),
                tier=rng.choice(("", "", "mine", rng.choice(names))),
                observation=rng.choice(("", "Ann 1", rng.choice(names))),
                comment=rng.choice(("", "", rng.choice(WORDS))),
                modifiers=rng.choice(((), (), ("left",), ("left", "fast,slow"))),
                score=rng.choice((None, None, round(rng.uniform(-5, 9), 3), 0.0)),
            )
        )
    return found


def rounded(label: Label, name: str) -> Label:
    """A label as the format keeps it."""
    step = RESOLUTION[name]
    gone = {field: getattr(Label(0, 0, ""), field) for field in LOST.get(name, ())}
    start, end = (round(round(time / step) * step, 6) for time in (label.start, label.end))
    if name == "label_studio":
        start, end = (round(time * FPS) / FPS for time in (label.start, label.end))
    return replace(label, start=start, end=end, **gone)


def comparable(labels: list[Label], name: str) -> list[Label]:
    """Sorted, without what the format makes up."""
    out = []
    field = {"elan": "tier", "via": "tier", "boris": "observation", "label_studio": "observation"}.get(name)
    for label in labels:
        if field and getattr(label, field).partition(" ")[0] == "dyntorch":
            label = replace(label, **{field: ""})
        out.append(replace(label, start=round(label.start, 6), end=round(label.end, 6)))
    return sorted(out, key=lambda label: (sort_key(label), repr(label)))


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("name", FORMATS)
def test_what_is_written_is_read_again(name: str, seed: int, tmp_path: Path) -> None:
    rng = Random(seed)
    media = ("session.mp4",) if name == "elan" else ("session.mp4", "my films/other.mp4")
    wanted = draw(rng, rng.choice((0, 1, 3, 40)), media)
    if name in ("label_studio", "via"):
        wanted = [replace(label, media=label.media.rpartition("/")[2]) for label in wanted]
    if name == "boris":  # its observations are numbered where labels overlap: names that look so are not told apart
        wanted = [replace(label, observation="") for label in wanted]
    path = tmp_path / f"labels{SUFFIX.get(name, '.json')}"
    kept = [rounded(label, name) for label in wanted]
    while first_duplicate(kept) is not None:
        at = kept.index(first_duplicate(kept))
        del kept[at], wanted[at]
    write_labels(path, wanted, recording="session.mp4", duration=200.0, fps=FPS, format=name)
    found = open_labels(path, fps=FPS)
    assert comparable(list(found.labels), name) == comparable(kept, name)
    write_labels(path, wanted, recording="session.mp4", duration=200.0, fps=FPS, format=name)
    assert open_labels(path, fps=FPS).labels == found.labels


@pytest.mark.parametrize("name", ["boris", "elan"])
@pytest.mark.parametrize("seed", range(6))
def test_labels_of_a_person_are_left_alone(name: str, seed: int, tmp_path: Path) -> None:
    rng = Random(seed)
    path = tmp_path / f"a{SUFFIX.get(name, '.json')}"
    person = [replace(label, tier="acts", observation="one") for label in draw(rng, 30, ("session.mp4",))]
    write_labels(path, person, recording="session.mp4", duration=200.0)
    if name == "elan":
        path.write_text(re.sub('ANNOTATOR="dyntorch [0-9a-f]+"', 'ANNOTATOR="Ann"', path.read_text("utf-8")), "utf-8")
    before = set(open_labels(path).labels)
    for turn in range(3):
        found = [replace(label, tier="", observation="") for label in draw(rng, 20, ("session.mp4",))]
        write_labels(path, found, recording="session.json")
        after = open_labels(path)
        theirs = {label for label in after.labels if not {label.tier, label.observation} & set(after.machine)}
        assert theirs == before, turn
        assert len(after.labels) - len(theirs) == len({rounded(label, name) for label in found})


def test_what_no_file_can_hold_is_said(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    assert write_labels(path, [Label(0, 1, " x "), Label(1, 2, " ")]) == ["1 label without a name left out"]
    assert open_labels(path).labels == (Label(0, 1, "x"),)
    path = tmp_path / "a.eaf"
    said = write_labels(path, [Label(0, 1, "a\x00b\ud800")], recording="session.mp4")
    assert said == ["control characters in 1 label became \ufffd"]
    assert open_labels(path).labels[0].label == "a\ufffdb\ufffd"


# Files of labels that were damaged, or made to do harm


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


def elan(folder: Path) -> Path:
    note = test_elan.tier("note", test_elan.referring("a6", "a4", "deep"), kind="same", more=' PARENT_REF="parts"')
    bits = test_elan.tier("bits", test_elan.referring("a7", "a6", "x"), test_elan.referring("a8", "a6", "y", "a7"), kind="part")
    return test_elan.eaf(folder / "hand.eaf", test_elan.TIMES, test_elan.ACTS, test_elan.PARTS, note, bits)


def boris(folder: Path) -> Path:
    one = test_boris.observation(test_boris.EVENTS, {"1": ["session.mp4", "b.mp4"], "2": ["c.mp4"]})
    return test_boris.project(folder / "hand.boris", {"one": one, "two": test_boris.observation(test_boris.EVENTS)})


AGGREGATE = "one\ta.mp4\t90\t25\tAnn\tsquat\tl\tSTATE\t1.800\t8.125\t6.3\tx\ty\n"
BY_HAND: dict[str, Callable[[Path], Path]] = {
    "BORIS": boris,
    "ELAN": elan,
    "tabular events": lambda folder: saved(folder / "tabular.tsv", test_boris.OLD),
    "aggregated events": lambda folder: saved(folder / "aggregated.tsv", test_boris.AGGREGATED + AGGREGATE),
    "a table of VIA": lambda folder: saved(folder / "via.csv", VIA_TABLE),
    "ActivityNet": lambda folder: saved(folder / "both.json", BOTH),
}
"""Sound files as other programs write them; they are damaged in tests/fuzz."""


def test_what_is_said(tmp_path: Path) -> None:
    for name, data, said in (
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
    ):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(ValueError, match=said):
            open_labels(tmp_path / name)


def test_no_file_at_all(tmp_path: Path) -> None:
    assert all(open_labels(make(tmp_path)).labels for make in BY_HAND.values())
    for path in (tmp_path / "none.csv", tmp_path):
        with pytest.raises(ValueError, match=str(path)):
            open_labels(path)
        with pytest.raises(ValueError, match=str(path)):
            write_labels(tmp_path / "out.eaf", [Label(0, 1, "x")], recording="session.mp4", into=path)


def test_a_limit_to_the_size_of_a_tree(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(markup, "MAX_ELEMENTS", 10)
    path = elan(tmp_path)
    with pytest.raises(ValueError, match="has more than 10 XML elements; split it"):
        open_labels(path)
