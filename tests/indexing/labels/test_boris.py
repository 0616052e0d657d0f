"""BORIS projects and tables: pairs, clocks, several observations; detections beside what a person marked."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from indexing.labels import Label, choose_labels, open_labels, read_labels, write_labels

S, P = "State event", "Point event"


def observation(events: list[list[Any]], files: dict[str, list[str]] | None = None, **more: Any) -> dict[str, Any]:
    """An observation as BORIS saves it."""
    files = {"1": ["session.mp4"], "2": []} if files is None else files
    lengths = {name: 60.0 for names in files.values() for name in names}
    info = {"length": lengths, "fps": dict.fromkeys(lengths, 25.0), "offset": dict.fromkeys(files, 0.0)}
    return {"file": files, "type": "MEDIA", "date": "2024-01-01T10:00:00", "description": "", "time offset": 0.0} | {
        "events": events,
        "media_info": info,
        **more,
    }


def project(path: Path, observations: dict[str, Any], **behaviours: str) -> Path:
    """A project as BORIS saves it."""
    kinds = {"squat": S, "clap": P, **behaviours}
    conf = {str(i): {"type": kind, "key": "", "code": code, "modifiers": {}} for i, (code, kind) in enumerate(kinds.items())}
    data = {"project_format_version": "7.0", "project_name": "p", "subjects_conf": {"0": {"name": "Ann", "key": "a"}}}
    path.write_text(json.dumps(data | {"behaviors_conf": conf, "observations": observations}))
    return path


EVENTS: list[list[Any]] = [
    [1.5, "Ann", "squat", "", "deep", "NA"],
    [2.0, "", "clap", "", ""],
    [2.5, "Ben", "squat", "left|fast", ""],
    [4.0, "Ann", "squat", "", ""],
    [5.0, "Ben", "squat", "left|fast", "end"],
]


def test_states_are_paired_by_subject_behaviour_and_modifiers(tmp_path: Path) -> None:
    found = open_labels(project(tmp_path / "a.boris", {"one": observation(EVENTS)}))
    of = {"media": "session.mp4", "observation": "one"}
    assert found.labels == (
        Label(1.5, 4.0, "squat", "Ann", comment="deep", **of),
        Label(2.0, 2.0, "clap", **of),
        Label(2.5, 5.0, "squat", "Ben", comment="end", modifiers=("left", "fast"), **of),
    )
    assert (found.observations, found.subjects, found.media, found.notices) == (("one",), ("Ann", "Ben"), ("session.mp4",), ())


def test_states_that_never_stop_or_have_modifiers_at_stop_and_an_offset(tmp_path: Path) -> None:
    events = [*EVENTS, [9.0, "Ann", "squat", "", ""], [10.0, "", "wave", "", ""]]
    found = open_labels(project(tmp_path / "a.boris", {"one": observation(events)}))
    assert len(found.labels) == 3
    assert "'squat' of Ann starts at 9 s and never stops; left out" in found.notices[1]
    assert "1 event left out: 'wave' is not in the ethogram" in found.notices[0]
    events = [[1.0, "", "squat", "None", ""], [2.0, "", "squat", "deep", ""]]
    found = open_labels(project(tmp_path / "a.boris", {"one": observation(events)}))
    assert [(label.start, label.end, label.modifiers) for label in found.labels] == [(1.0, 2.0, ("deep",))]
    assert "paired with the STOP" in found.notices[0]
    shifted = observation([[time + 100, *rest] for time, *rest in EVENTS], **{"time offset": 100.0})
    found = open_labels(project(tmp_path / "a.boris", {"one": shifted}))  # the offset is not of the recording
    assert [label.start for label in found.labels] == [1.5, 2.0, 2.5]


def test_files_after_each_other_have_their_own_clocks(tmp_path: Path) -> None:
    events = [[50.0, "", "squat", "", ""], [55.0, "", "squat", "", ""], [58.0, "", "squat", "", ""], [63.0, "", "squat", "", ""]]
    events += [[70.0, "", "clap", "", ""]]
    path = project(tmp_path / "a.boris", {"one": observation(events, {"1": ["a.mp4", "b.mp4"]})})
    found = open_labels(path)
    assert [(label.start, label.end, label.media) for label in found.labels] == [
        (0.0, 3.0, "b.mp4"),
        (10.0, 10.0, "b.mp4"),
        (50.0, 55.0, "a.mp4"),
        (58.0, 60.0, "a.mp4"),
    ]
    assert "cut in two" in found.notices[0]
    assert [label.start for label in open_labels(path, recording="b.json").labels] == [0.0, 10.0]


def test_a_file_beside_another_has_its_own_clock(tmp_path: Path) -> None:
    one = observation(EVENTS, {"1": ["front.mp4"], "2": ["side.mp4"]})
    one["media_info"]["offset"]["2"] = 1.25  # starts this much later
    path = project(tmp_path / "a.boris", {"one": one})
    assert [label.start for label in open_labels(path, recording="side.csv").labels] == [0.25, 0.75, 1.25]
    found = open_labels(path)
    assert [label.start for label in found.labels] == [1.5, 2.0, 2.5]
    assert "front.mp4, side.mp4 beside each other" in found.notices[0]


def test_a_name_or_the_recording_chooses_the_observation(tmp_path: Path) -> None:
    other = observation(EVENTS[1:2], {"1": ["other.mp4"]})
    path = project(tmp_path / "a.boris", {"one": observation(EVENTS), "two": other})
    assert len(read_labels(path, observation="two")) == 1
    with pytest.raises(ValueError, match=r"has no observation 'Cid', only one, two; give one of these \(--observation\)"):
        read_labels(path, observation="Cid")
    found = choose_labels(open_labels(path, recording=tmp_path / "other.json"))
    assert [label.observation for label in found.labels] == ["two"]
    assert "1 observation left out: of other recordings" in found.notices[0]
    with pytest.raises(ValueError, match=r"its labels are of session\.mp4, other\.mp4, not of third\.json; name the recording as"):
        open_labels(path, recording="third.json")
    assert len(open_labels(path, recording="third.json", media="other.mp4").labels) == 1


def test_observations_without_lengths_or_files(tmp_path: Path) -> None:
    path = project(tmp_path / "a.boris", {"live": observation(EVENTS, {}, type="LIVE")})
    found = open_labels(path, recording="x.json")
    assert len(found.labels) == 3
    assert "names no media file; its clock is taken for that of x.json" in found.notices[0]
    one = observation(EVENTS, {"1": ["a.mp4", "b.mp4"]})
    del one["media_info"]["length"]["a.mp4"]
    with pytest.raises(ValueError, match=r"a\.boris: observation 'one': does not say how long a\.mp4 is"):
        open_labels(project(tmp_path / "a.boris", {"one": one}))


def test_events_that_are_none(tmp_path: Path) -> None:
    for event, said in (
        ([None, "", "clap", "", ""], "event 1: time None is no time; give seconds"),
        (["soon", "", "clap", "", ""], "event 1: time 'soon' is no time"),
        ([float("nan"), "", "clap", "", ""], "event 1: time nan is no time"),
        (["x"], r"event 1 is \['x'\], not \[time, subject, code"),
        ([1, {}, "clap", "", ""], "event 1: {} is no name"),
    ):
        with pytest.raises(ValueError, match=said):
            open_labels(project(tmp_path / "a.boris", {"one": observation([event])}))


# ---- beside a person's ---------------------------------------------------------------------------------------------------
FOUND = [Label(1, 3, "squat", score=4.4), Label(2, 4, "squat", comment="again", score=1.0), Label(7, 7, "clap", "Cid")]


def test_detections_have_observations_of_their_own(tmp_path: Path) -> None:
    path = project(tmp_path / "a.boris", {"one": observation(EVENTS)})
    before = json.loads(path.read_text())
    assert write_labels(path, FOUND, recording="session.json", fps=25) == []
    after = json.loads(path.read_text())
    assert after["observations"]["one"] == before["observations"]["one"]
    assert list(after["observations"]) == ["one", "dyntorch session.mp4", "dyntorch session.mp4 (2)"]  # two overlap
    assert after["behaviors_conf"] == before["behaviors_conf"]
    assert [one["name"] for one in after["subjects_conf"].values()] == ["Ann", "Cid"]
    own = after["observations"]["dyntorch session.mp4"]
    assert own["media_info"]["length"] == {"session.mp4": 60.0}
    assert own["events"][0] == [1.0, "", "squat", "", "score 4.4", 25]
    found = choose_labels(open_labels(path, recording="session.json"))
    assert {label.observation for label in found.labels} == {"one"}
    assert "3 labels left out: a program found them" in found.notices[-1]
    mine = open_labels(path, observation="dyntorch session.mp4").labels  # both of them
    assert [(label.start, label.end, label.comment, label.score) for label in mine] == [
        (1.0, 3.0, "", 4.4),
        (2.0, 4.0, "again", 1.0),
        (7.0, 7.0, "", None),
    ]


def test_corrections_are_not_written_over(tmp_path: Path) -> None:
    path = tmp_path / "a.boris"
    found = [Label(1, 3, "squat", score=2.0), Label(2, 4, "squat", score=1.0), Label(5, 6, "wave")]
    write_labels(path, found, recording="session.mp4")
    sound = json.loads(path.read_text())
    name = "dyntorch session.mp4"

    def changed(change: Callable[[dict[str, Any]], Any]) -> None:
        whole = json.loads(json.dumps(sound))
        change(whole["observations"])
        path.write_text(json.dumps(whole))

    def refused(change: Callable[[dict[str, Any]], Any], which: str = name) -> None:
        changed(change)
        before = path.read_bytes()
        for dry in (True, False):
            said = rf"a\.boris: observation '{re.escape(which)}' is not as dyntorch wrote it: somebody has corrected it; rename it"
            with pytest.raises(ValueError, match=said):
                write_labels(path, found, recording="session.mp4", dry=dry)
        assert path.read_bytes() == before

    def end(at: dict[str, Any]) -> None:
        at[name]["events"][1][0] += 0.1

    def saved_again(at: dict[str, Any]) -> None:
        at[name]["events"] = [[event[0] + 1e-9, *event[1:3], event[3] or "None", event[4]] for event in at[name]["events"][::-1]]

    refused(end)
    refused(lambda at: at[name]["events"].pop())
    refused(lambda at: at[name]["events"].clear())
    refused(lambda at: at[name]["events"][0].__setitem__(2, "wave"))
    refused(lambda at: at[f"{name} (2)"]["events"][0].__setitem__(4, "surely"), f"{name} (2)")
    refused(lambda at: at.pop(f"{name} (2)"))
    refused(lambda at: at[name].update({"time offset": 1.0}))
    refused(lambda at: at[name].update(events=[["soon", "", "squat", "", ""]]))
    refused(lambda at: at[name].update(description="dyntorch: mine now"))
    for same in (saved_again, lambda at: at[name].update(date="2030-01-01T00:00:00")):
        changed(same)
        write_labels(path, found[1:], recording="session.mp4")
        assert len(open_labels(path).labels) == 2
    changed(lambda at: at.update({"Ann": at.pop(name)}))  # taken over, but for the second, which stands alone now
    with pytest.raises(ValueError, match=r"session\.mp4 \(2\)' is not as"):
        write_labels(path, found, recording="session.mp4")
    changed(lambda at: at.update({"Ann": at.pop(name)} | {"other": at.pop(f"{name} (2)")}))
    write_labels(path, found, recording="session.mp4")
    assert list(json.loads(path.read_text())["observations"]) == ["Ann", "other", name, f"{name} (2)"]


def test_a_point_event_of_the_project_cannot_last(tmp_path: Path) -> None:
    path = project(tmp_path / "a.boris", {"one": observation(EVENTS)})
    said = write_labels(path, [Label(1, 2, "clap"), Label(3, 3, "squat")], recording="session.mp4")
    assert said == ["'clap' is a point event in the project; its labels, some of which last, are written as 'clap (state)'"]
    labels = open_labels(path, observation="dyntorch session.mp4").labels
    assert [(label.start, label.end, label.label) for label in labels] == [(1, 2, "clap (state)"), (3, 3, "squat")]


def test_nothing_of_a_person_is_overwritten(tmp_path: Path) -> None:
    path = project(tmp_path / "a.boris", {"dyntorch session.mp4": observation(EVENTS)})
    before = path.read_bytes()
    said = r"somebody's observation is called 'dyntorch session\.mp4'; rename it, or write to another file"
    with pytest.raises(ValueError, match=said):
        write_labels(path, FOUND, recording="session.mp4")
    write_labels(tmp_path / "b.boris", FOUND, recording="other.mp4", into=path)
    assert path.read_bytes() == before
    assert open_labels(tmp_path / "b.boris").observations[0] == "dyntorch session.mp4"


def test_what_boris_checks_holds(tmp_path: Path) -> None:
    path = tmp_path / "new.boris"
    labels = [*FOUND, Label(2.5, 3, "squat", modifiers=("a(b)", "left,right"))]
    assert write_labels(path, labels, recording="session.mp4") == [
        "characters that BORIS forbids in modifiers, ( | ) ` ~, became spaces"
    ]
    data = json.loads(path.read_text())
    codes = {one["code"]: one["type"] for one in data["behaviors_conf"].values()}
    assert codes == {"squat": S, "clap": P}
    names = {one["name"] for one in data["subjects_conf"].values()}
    for one in data["observations"].values():
        assert set(one["media_info"]["length"]) == {name for files in one["file"].values() for name in files}
        for _, subject, code, *_ in one["events"]:
            assert code in codes
            assert not subject or subject in names
        states = [tuple(event[1:4]) for event in one["events"] if codes[event[2]] == S]
        assert all(states.count(key) % 2 == 0 for key in states)
        assert one["events"] == sorted(one["events"], key=lambda event: event[0])


# ---- exported tables -----------------------------------------------------------------------------------------------------
OLD = """Observation id\tone\t\t\t\t\t\t\t

Media file(s)\t\t\t\t\t\t\t\t
Player #1\tsession.mp4\t\t\t\t\t\t\t
Time offset (s)\t10.0\t\t\t\t\t\t\t

Time\tMedia file path\tTotal length\tFPS\tSubject\tBehavior\tBehavioral category\tComment\tStatus
13.300\tsession.mp4\t359.960\t25.0\tAnn\tsquat\t\tdeep\tSTART
15.000\tsession.mp4\t359.960\t25.0\tNo focal subject\tclap\t\t\tPOINT
17.750\tsession.mp4\t359.960\t25.0\tAnn\tsquat\t\t\tSTOP
19.000\tsession.mp4\t359.960\t25.0\tAnn\tsquat\t\t\tSTART
"""
NEW_HEAD = (
    "Observation id,Observation date,Description,Observation duration,Observation type,Source,Time offset (s),Media duration (s),"
    "FPS,Subject,Behavior,Behavioral category,Modifier #1,Modifier #2,Behavior type,Time,Media file name,Image index,"
    "Image file path,Comment\n"
)
AGGREGATED = (
    "Observation id\tMedia file\tTotal length\tFPS\tSubject\tBehavior\tModifiers\tBehavior type\tStart (s)\tStop (s)\t"
    "Duration (s)\tComment start\tComment stop\n"
)


def test_tabular_and_aggregated_events(tmp_path: Path) -> None:
    path = tmp_path / "a.tsv"
    path.write_text(OLD)
    found = open_labels(path)
    of = {"media": "session.mp4", "observation": "one"}
    assert found.format == "boris_tables"
    assert found.labels == (Label(3.3, 7.75, "squat", "Ann", comment="deep", **of), Label(5.0, 5.0, "clap", **of))
    assert "1 event left out: START without STOP, or the other way round (squat at 19 s)" in found.notices[0]
    rows = [
        "one\ta.mp4\t90\t25\tNo focal subject\tsquat\tleft|fast\tSTATE\t1.800\t8.125\t6.325\tx\ty",
        "one\ta.mp4\t90\t25\tAnn\tclap\t\tPOINT\t32.825\t32.825\tNA\t\t",
        "one\ta.mp4\t90\t25\tAnn\tclap\t\tPOINT\tNA\tNA\tNA\t\t",
        "one\tb.mp4\t90\t25\tAnn\tclap\t\tPOINT\t70\t70\tNA\t\t",
    ]
    path.write_text(AGGREGATED + "\n".join(rows))
    found = open_labels(path)
    assert found.labels == (
        Label(1.8, 8.125, "squat", media="a.mp4", observation="one", comment="x / y", modifiers=("left", "fast")),
        Label(32.825, 32.825, "clap", "Ann", media="a.mp4", observation="one"),
    )
    assert "pictures without a time" in found.notices[0]
    assert "1 label left out: of b.mp4, which is not played first" in found.notices[1]
    with pytest.raises(ValueError, match=r"does not say how long the first is; give the project \(\.boris\)"):
        open_labels(path, recording="b.json")


def test_tables_of_other_forms_and_such_that_say_too_little(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    for source in ("a.mp4;b.mp4", "player #1: a.mp4;b.mp4 player #2: c.mp4"):
        row = f"one,2024,,90,Media file(s),{source},0.0,60.000;30.000,25.000,Ann,clap,,,,POINT,70.5,b.mp4,NA,NA,"
        path.write_text(NEW_HEAD + row)
        assert [(label.start, label.media) for label in open_labels(path).labels] == [(10.5, "b.mp4")]
    path.write_text("Observation id,Subject,Behavior,Time\none,Ann,squat,1\n")
    with pytest.raises(ValueError, match="has no column 'Behavior type' or 'Status'"):
        open_labels(path)
    path.write_text("Observation id,Subject,Behavior,Behavior type,Time\none,Ann,squat,MAYBE,1\n")
    with pytest.raises(ValueError, match="line 2: 'MAYBE' is none of START, STOP and POINT"):
        open_labels(path)


def test_tabular_events_with_all_in_every_row(tmp_path: Path) -> None:
    source = "player #1:films/a.mp4;films/b.mp4|player #2:c.mp4"
    rows = [
        f"one,2024,,90,Media file(s),{source},0.0,60.000;30.000|90.000,25.000,Ann,squat,,left,,{kind},{time},{name},NA,NA,"
        for kind, time, name in [("START", 58, "a.mp4"), ("STOP", 62, "b.mp4"), ("POINT", 70.5, "b.mp4")]
    ]
    path = tmp_path / "a.csv"
    path.write_text(NEW_HEAD + "\n".join(rows))
    found = open_labels(path)
    assert [(label.start, label.end, label.media, label.modifiers) for label in found.labels] == [
        (0.0, 2.0, "films/b.mp4", ("left",)),
        (10.5, 10.5, "films/b.mp4", ("left",)),
        (58.0, 60.0, "films/a.mp4", ("left",)),
    ]
    with pytest.raises(ValueError, match=r"plays c\.mp4 beside films/a\.mp4, films/b\.mp4, and the table does not say how"):
        open_labels(path, recording="c.json")
