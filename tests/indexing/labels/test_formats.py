"""Tables, ActivityNet, Label Studio and VIA as they come from other programs; which recording labels are of; where it ends."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from indexing.labels import Label, choose_labels, open_labels, read_labels, within, write_labels
from indexing.labels.format import Request, base_name, of_recording


def saved(path: Path, value: Any) -> Path:
    path.write_text(value if isinstance(value, str) else json.dumps(value), encoding="utf-8")
    return path


# ---- tables --------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    "text",
    [
        "label,start,end\nsquat,1.5,4\n",
        "Action;Begin;Stop\nsquat;1,5;4,0\n",
        "behaviour\tonset\toffset\nsquat\t0:01.5\t00:00:04.000\n",
        "start,duration,behavior\n1.5,2.5,squat\n",
        "\ufefflabel,start_frame,end_frame\nsquat,45,120\n",
        "label,start,end\n\n squat ,1.5,4,,,\n\n",
    ],
)
def test_tables(text: str, tmp_path: Path) -> None:
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


def test_duplicates_are_kept_once(tmp_path: Path) -> None:
    found = open_labels(saved(tmp_path / "a.csv", "label,start,end\nsquat,1,2\nsquat,1,2.0\nsquat,1,3\n"))
    assert len(found.labels) == 2
    assert found.notices == ("1 label left out: there twice (squat at 1-2 s)",)


def test_notices_of_read_labels_are_warnings(tmp_path: Path) -> None:
    path = saved(tmp_path / "a.csv", "label,start,end\n,1,2\nsquat,1,3\n")
    with pytest.warns(UserWarning, match=r"a\.csv: 1 label without a name left out"):
        assert len(read_labels(path)) == 1


def test_several_tiers_are_taken_together_and_named(tmp_path: Path) -> None:
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


@pytest.mark.parametrize("part", ["database", "results"])
@pytest.mark.parametrize("wrong", [[1], "a", 3, True])
def test_parts_of_activitynet_that_are_no_object(part: str, wrong: Any, tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text(json.dumps({"database": {}, "results": {}} | {part: wrong}))
    with pytest.raises(ValueError, match=rf"a\.json: '{part}' is .*, no object of videos; write segments as"):
        open_labels(path)


def test_videos_without_a_segment_are_known(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text(json.dumps({"database": {"a": {"annotations": []}}, "results": {"b": []}}))
    assert open_labels(path).media == ("a", "b") and open_labels(path).watched == (("", "a"), ("", "b"))


def test_results_name_recordings_without_labels(tmp_path: Path) -> None:
    write_labels(tmp_path / "a.json", [Label(1, 2, "x", media="a.mp4", score=1.0)], recording="b.mp4")
    assert json.loads((tmp_path / "a.json").read_text())["results"]["b.mp4"] == []


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


def test_what_marks_no_time_is_named(tmp_path: Path) -> None:
    box = {"id": "r", "type": "videorectangle", "value": {"sequence": []}}
    words = {"id": "r", "type": "labels", "value": {"start": 1, "end": 5, "text": "hello", "labels": ["greeting"]}}
    sound = {"id": "r", "type": "labels", "value": {"start": 1.25, "end": 5, "channel": 0, "labels": ["song"]}}
    found = open_labels(saved(tmp_path / "a.json", [task(box, words, sound)]))
    assert [(label.start, label.label) for label in found.labels] == [(1.25, "song")]
    assert found.notices == ("2 regions left out: they mark no time (videorectangle: 1, labels: 1)",)


def test_annotators_and_predictions(tmp_path: Path) -> None:
    predictions = [{"model_version": "yolo", "result": [region(1, 26, "squat", score=0.5)]}, 17]
    path = saved(tmp_path / "a.json", [task(region(1, 51, "squat"), who={"email": "a@b.c"}, predictions=predictions)])
    found = open_labels(path, fps=25)
    assert (found.observations, found.machine) == (("a@b.c", "yolo"), ("yolo",))
    chosen = choose_labels(found)
    assert [label.end for label in chosen.labels] == [2]
    assert "1 label left out: a program found them (yolo); --observation NAME reads them" in chosen.notices


def test_the_least_export(tmp_path: Path) -> None:
    one = {"id": 1, "video": "s3://films/session.mp4", "annotator": 3, "l": [region(1, 26, "squat")["value"]]}
    assert read_labels(saved(tmp_path / "a.json", [one]), fps=25) == [
        Label(0, 1, "squat", media="session.mp4", observation="annotator 3")
    ]


def test_frames_need_a_rate_to_be_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="Label Studio counts frames, and nobody says how many a second has"):
        write_labels(tmp_path / "a.json", [Label(0, 1, "x")], recording="a.mp4", format="label_studio")
    assert not (tmp_path / "a.json").exists()


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
    from tests.indexing.labels.test_hostile import VIA_TABLE

    found = open_labels(saved(tmp_path / "a.csv", VIA_TABLE))
    of = {"media": "session.mp4", "tier": "acts"}
    assert found.labels == (Label(1.5, 2.5, "squat", **of), Label(4, 4, "clap", **of))
    old = (
        "# Exported\nmetadata_id,file_list,temporal_segment_start,temporal_segment_end,metadata\n"
        'x,"[""a.mp4""]",1,2,"{""TEMPORAL-SEGMENTS"":""walk""}"\n'
    )
    assert read_labels(saved(tmp_path / "b.csv", old)) == [Label(1, 2, "walk", media="a.mp4", tier="TEMPORAL-SEGMENTS")]


# ---- which recording -----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("recording", "names", "mine"),
    [
        ("a/session.json", ["session.mp4", "session2.mp4"], "session.mp4"),
        ("session_keypoints.json", ["session.mp4", "other.mp4"], "session.mp4"),
        ("sessionDLC_resnet50_x.csv", ["session.mp4", "other.mp4"], "session.mp4"),
        ("SESSION.json", ["session.MP4", "other.mp4"], "session.MP4"),
        ("folder/cam1", ["C:\\films\\cam1.avi", "C:\\films\\cam10.avi"], "C:\\films\\cam1.avi"),
        ("b/cam.mp4", ["/x/a/cam.mp4", "/x/b/cam.mp4"], "/x/b/cam.mp4"),
        ("session_cam1.json", ["session.mp4", "session_cam1.mp4"], "session_cam1.mp4"),
        ("take.2024.json", ["take.2024.mp4", "take.2023.mp4"], "take.2024.mp4"),
    ],
)
def test_names_say_which_recording_labels_are_of(recording: str, names: list[str], mine: str) -> None:
    assert of_recording(names, Request(Path("l.csv"), recording)) == {mine}


@pytest.mark.parametrize(
    ("recording", "names", "said"),
    [
        ("sessions.json", ["session.mp4"], r"l\.csv: its labels are of session\.mp4, not of sessions\.json; name the recording as"),
        (
            "session.json",
            ["session_cam1.mp4", "session_cam2.mp4"],
            r"session\.json may be any of session_cam1\.mp4, session_cam2\.mp4",
        ),
    ],
)
def test_names_that_do_not_say(recording: str, names: list[str], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        of_recording(names, Request(Path("l.csv"), recording))


def test_a_name_that_somebody_gives() -> None:
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


@pytest.mark.parametrize("times", [(float("nan"), 1), (0, float("inf")), (2, 1)])
def test_labels_without_sound_times_are_none(times: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match="label 'x': "):
        Label(*times, "x")


# ---- writing -------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("name", "more", "said"),
    [
        ("a.txt", {}, r"the suffix '\.txt' does not say which format to write; end the name in one of \.boris, \.csv"),
        ("a.csv", {"format": "xml"}, "unknown format='xml'; use one of activitynet, boris"),
        ("a.csv", {"into": "b.csv"}, r"labels cannot be written beside those of b\.csv; write \.boris, \.eaf"),
        ("a.boris", {"duration": 0}, "duration=0 cannot be"),
        ("a.boris", {"fps": float("nan")}, "fps=nan cannot be"),
        ("a.boris", {"tier": " "}, "tier=' ' is no name"),
        ("none/a.csv", {}, "cannot write"),
    ],
)
def test_what_cannot_be_written(name: str, more: dict[str, Any], said: str, tmp_path: Path) -> None:
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
