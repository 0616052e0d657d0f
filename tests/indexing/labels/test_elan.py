"""ELAN files: tiers, slots without a time, references; detections beside what a person marked, byte by byte."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from xml.etree import ElementTree

import pytest

from indexing.labels import Label, choose_labels, open_labels, read_labels, write_labels

HEAD = """<?xml version="1.0" encoding="UTF-8"?>
<!-- made by hand -->
<ANNOTATION_DOCUMENT AUTHOR="" DATE="2020-01-01T00:00:00+01:00" FORMAT="3.0" VERSION="3.0">
    <HEADER MEDIA_FILE="" TIME_UNITS="milliseconds">
        <MEDIA_DESCRIPTOR MEDIA_URL="file:///C:/my%20films/session.mp4" MIME_TYPE="video/mp4"/>
        <MEDIA_DESCRIPTOR MEDIA_URL="file:///C:/my%20films/side.mp4" MIME_TYPE="video/mp4" TIME_ORIGIN="2000"/>
        <PROPERTY NAME="lastUsedAnnotationId">7</PROPERTY>
    </HEADER>
"""
TYPES = """    <LINGUISTIC_TYPE LINGUISTIC_TYPE_ID="plain" TIME_ALIGNABLE="true"/>
    <LINGUISTIC_TYPE LINGUISTIC_TYPE_ID="time" TIME_ALIGNABLE="true" CONSTRAINTS="Time_Subdivision"/>
    <LINGUISTIC_TYPE LINGUISTIC_TYPE_ID="same" TIME_ALIGNABLE="false" CONSTRAINTS="Symbolic_Association"/>
    <LINGUISTIC_TYPE LINGUISTIC_TYPE_ID="part" TIME_ALIGNABLE="false" CONSTRAINTS="Symbolic_Subdivision"/>
    <CONTROLLED_VOCABULARY CV_ID="v"><CV_ENTRY_ML CVE_ID="cve1"><CVE_VALUE LANG_REF="und">jump</CVE_VALUE></CV_ENTRY_ML>
    </CONTROLLED_VOCABULARY>
</ANNOTATION_DOCUMENT>
"""


def slots(**times: int | None) -> str:
    """Time slots by name."""
    each = [
        f'<TIME_SLOT TIME_SLOT_ID="{name}"' + ("" if time is None else f' TIME_VALUE="{time}"') + "/>"
        for name, time in times.items()
    ]
    return f"    <TIME_ORDER>{''.join(each)}</TIME_ORDER>\n"


def alignable(name: str, first: str, last: str, value: str, more: str = "") -> str:
    return (
        f'<ANNOTATION><ALIGNABLE_ANNOTATION ANNOTATION_ID="{name}" TIME_SLOT_REF1="{first}" TIME_SLOT_REF2="{last}"{more}>'
        f"<ANNOTATION_VALUE>{value}</ANNOTATION_VALUE></ALIGNABLE_ANNOTATION></ANNOTATION>"
    )


def referring(name: str, parent: str, value: str, previous: str = "") -> str:
    before = f' PREVIOUS_ANNOTATION="{previous}"' * bool(previous)
    return (
        f'<ANNOTATION><REF_ANNOTATION ANNOTATION_ID="{name}" ANNOTATION_REF="{parent}"{before}>'
        f"<ANNOTATION_VALUE>{value}</ANNOTATION_VALUE></REF_ANNOTATION></ANNOTATION>"
    )


def tier(name: str, *annotations: str, kind: str = "plain", more: str = "") -> str:
    return f'    <TIER TIER_ID="{name}" LINGUISTIC_TYPE_REF="{kind}"{more}>\n{"".join(annotations)}</TIER>\n'


def eaf(path: Path, *parts: str) -> Path:
    path.write_text(HEAD + "".join(parts) + TYPES, encoding="utf-8")
    return path


TIMES = slots(ts1=0, ts2=None, ts3=None, ts4=3000, ts5=5000, ts6=5500)
ACTS = tier("acts", alignable("a1", "ts1", "ts4", "squat &amp; go"), alignable("a2", "ts5", "ts6", ""), more=' PARTICIPANT="Ann"')
PARTS = tier(
    "parts",
    *(alignable("a3", "ts1", "ts2", "down"), alignable("a4", "ts2", "ts3", "hold"), alignable("a5", "ts3", "ts4", "up")),
    kind="time",
    more=' PARENT_REF="acts"',
)


def test_tiers_participants_and_media(tmp_path: Path) -> None:
    path = eaf(tmp_path / "a.eaf", TIMES, ACTS)
    found = open_labels(path)
    assert found.labels == (Label(0.0, 3.0, "squat & go", "Ann", media="session.mp4", tier="acts"),)
    assert (found.tiers, found.subjects, found.media) == (("acts",), ("Ann",), ("session.mp4", "side.mp4"))
    assert found.notices == (
        "has media that begin at other times (session.mp4, side.mp4); times are those of session.mp4",
        "1 label without a name left out ((no name) at 5-5.5 s)",
    )
    found = open_labels(path, recording="side.json")  # a shifted medium has its own clock
    assert [(label.start, label.end, label.media) for label in found.labels] == [(2.0, 5.0, "side.mp4")]


def test_times_that_nobody_set_lie_between_their_neighbours(tmp_path: Path) -> None:
    found = open_labels(eaf(tmp_path / "a.eaf", TIMES, ACTS, PARTS), tier="parts")
    assert [(label.start, label.end, label.label) for label in found.labels] == [(0, 1, "down"), (1, 2, "hold"), (2, 3, "up")]
    assert "2 times that nobody set taken from the neighbours, as ELAN does" in found.notices
    lone = tier("lone", alignable("a9", "ts7", "ts8", "lost"))  # without neighbours
    times = slots(ts1=0, ts4=3000, ts7=None, ts8=None)
    found = open_labels(eaf(tmp_path / "a.eaf", times, tier("b", alignable("a1", "ts1", "ts4", "x")), lone))
    assert [label.label for label in found.labels] == ["x"]
    assert "1 annotation left out: without a time (a9 of lone)" in found.notices


def test_annotations_of_symbolic_tiers_take_the_time_of_their_parents(tmp_path: Path) -> None:
    note = tier("note", referring("a6", "a4", "deep"), kind="same", more=' PARENT_REF="parts"')
    bits = tier("bits", referring("a8", "a6", "y", "a7"), referring("a7", "a6", "x"), kind="part", more=' PARENT_REF="note"')
    path = eaf(tmp_path / "a.eaf", TIMES, bits, note, ACTS, PARTS)  # in any order
    assert [(label.start, label.end) for label in open_labels(path, tier="note").labels] == [(1, 2)]
    assert [(label.start, label.end, label.label) for label in open_labels(path, tier="bits").labels] == [
        (1, 1.5, "x"),
        (1.5, 2, "y"),
    ]
    path = eaf(tmp_path / "b.eaf", TIMES, tier("acts", alignable("a1", "ts1", "ts4", "", ' CVE_REF="cve1"')))
    assert [label.label for label in open_labels(path).labels] == ["jump"]  # of a controlled vocabulary


BROKEN = {
    "linguistic type": ([TIMES, tier("t", kind="other")], "tier 't': its linguistic type 'other' is not there; give"),
    "slot": ([TIMES, tier("t", alignable("a1", "ts1", "ts99", "x"))], "tier 't', annotation a1: its time slot 'ts99' is not there"),
    "slot twice": (
        [TIMES.replace('"ts2"', '"ts1"'), tier("t", alignable("a1", "ts1", "ts4", "x"))],
        "time slot 'ts1' is there twice",
    ),
    "no number": ([slots(ts1=0, ts2=1).replace('"1"', '"soon"')], "time slot 'ts2': TIME_VALUE 'soon' is no whole number"),
    "backwards": (
        [TIMES, tier("t", alignable("a1", "ts4", "ts1", "x"))],
        "tier 't', annotation a1: ends at 0 s, but starts at 3 s",
    ),
    "two tiers": ([TIMES, tier("t"), tier("t")], "two tiers are called 't'; rename one"),
    "id twice": ([TIMES, tier("t", *[alignable("a1", "ts1", "ts4", "x")] * 2)], "two annotations have the id 'a1'"),
    "parent tier": ([TIMES, tier("t", more=' PARENT_REF="u"')], "tier 't': its parent tier 'u' is not there"),
    "own parent": ([TIMES, tier("t", more=' PARENT_REF="u"'), tier("u", more=' PARENT_REF="t"')], "tier 't' is its own parent"),
    "parent": (
        [TIMES, ACTS, tier("t", referring("a9", "a99", "x"), kind="same")],
        "tier 't', annotation a9: its parent 'a99' is not",
    ),
    "circle": (
        [TIMES, ACTS, tier("t", referring("a8", "a9", "x"), referring("a9", "a8", "x"), kind="same")],
        "tier 't', annotation a8: it is its own parent",
    ),
    "previous": (
        [TIMES, ACTS, tier("t", referring("a8", "a1", "x"), referring("a9", "a1", "x", "a77"), kind="part")],
        "annotation a9: that before it, 'a77', is not of the same parent",
    ),
    "previous in a circle": (
        [TIMES, ACTS, tier("t", referring("a8", "a1", "x", "a9"), referring("a9", "a1", "x", "a8"), kind="part")],
        "annotation a8: that before it, 'a9', is not of the same parent",
    ),
    "no annotation": ([TIMES, tier("t", "<ANNOTATION><OTHER/></ANNOTATION>")], "tier 't': holds OTHER, which is no annotation"),
}


def test_broken_references_are_named(tmp_path: Path) -> None:
    for parts, said in BROKEN.values():
        with pytest.raises(ValueError, match=rf"a\.eaf: .*{re.escape(said)}") as caught:
            open_labels(eaf(tmp_path / "a.eaf", *parts))
        assert "\n" not in str(caught.value)


BOMB = """<?xml version="1.0"?><!DOCTYPE lolz [<!ENTITY a "aaaaaaaaaa">
<!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;&a;">]><ANNOTATION_DOCUMENT>&b;</ANNOTATION_DOCUMENT>"""


def test_hostile_xml_and_empty_elements(tmp_path: Path) -> None:
    path = tmp_path / "a.eaf"
    for text, said in (
        (BOMB, "declares a document type or entities"),
        ('<!DOCTYPE a SYSTEM "file:///etc/passwd"><a/>', "declares a document type or entities"),
        ("<a>" * 100_000, "elements 65 deep"),
        ("<ANNOTATION_DOCUMENT><TIER></ANNOTATION_DOCUMENT>", "is no sound XML at line 1, column 30"),
        ("<html/>", "is XML, but no ELAN file"),
        ('<?xml version="1.0" encoding="klingon"?><a/>', "encoding"),
        ("<a>&nbsp;</a>", "is no sound XML"),
    ):
        path.write_text(text)
        for action in (open_labels, partial(write_labels, labels=[Label(0, 1, "x")], recording="session.mp4")):
            with pytest.raises(ValueError, match=said):
                action(path)
            assert path.read_text() == text
    path = tmp_path / "b.eaf"
    write_labels(path, [Label(1.0, 1.001, "a"), Label(2.0, 2.0003, "b"), Label(3.0, 3.0, "c")], recording="session.mp4")
    assert [(one.start, one.end) for one in open_labels(path).labels] == [(1.0, 1.002), (2.0, 2.002), (3.0, 3.0)]
    path.write_text(
        '<ANNOTATION_DOCUMENT><HEADER A="x>/>" TIME_UNITS="milliseconds"/><TIME_ORDER B="/>" />'
        '<TIER TIER_ID="/&gt;" C=">"></TIER>x/><!-- <TIER> --></ANNOTATION_DOCUMENT>'
    )
    write_labels(path, FOUND[2:3], recording="session.mp4")
    text = path.read_text()
    assert '<HEADER A="x>/>" TIME_UNITS="milliseconds"/><TIME_ORDER B="/>">' in text
    assert '<TIER TIER_ID="/&gt;" C=">"></TIER>\n    <TIER ANNOTATOR' in text
    assert text.endswith("x/><!-- <TIER> --></ANNOTATION_DOCUMENT>")
    assert [label.label for label in open_labels(path, tier="dyntorch").labels] == ["clap"]


# ---- beside a person's ---------------------------------------------------------------------------------------------------
FOUND = [
    Label(1, 2, 'a <&> "b"', "Ann"),
    Label(1.5, 3, "x\ny\r", "Ann"),
    Label(5, 5, "clap"),
    Label(0.2, 1, "\u05e9\u05dc\u05d5\u05dd"),
]


def test_detections_have_tiers_of_their_own(tmp_path: Path) -> None:
    path = eaf(tmp_path / "a.eaf", TIMES, ACTS, PARTS)
    before = path.read_text("utf-8")
    persons = open_labels(path).labels
    assert write_labels(path, FOUND, recording="session.json") == []
    after = path.read_text("utf-8")
    without = re.sub(r"\n    <(?:TIER ANN|LINGUISTIC_TYPE GR).*?(?:</TIER>|/>)", "", after, flags=re.DOTALL)
    without = re.sub(r'\n        <TIME_SLOT TIME_SLOT_ID="ts\d+" TIME_VALUE="\d+"/>', "", without)
    assert without.replace('"lastUsedAnnotationId">9<', '"lastUsedAnnotationId">7<') == before
    names = [one.get("TIER_ID") for one in ElementTree.fromstring(after).iterfind("TIER")]
    assert names == ["acts", "parts", "dyntorch", "dyntorch@Ann", "dyntorch@Ann (2)"]
    found = open_labels(path)
    assert found.machine == ("dyntorch",)
    assert tuple(label for label in found.labels if label.tier != "dyntorch") == persons
    mine = open_labels(path, tier="dyntorch").labels
    assert sorted((label.start, label.end, label.label, label.subject) for label in mine) == [
        (0.2, 1.0, "\u05e9\u05dc\u05d5\u05dd", ""),
        (1.0, 2.0, 'a <&> "b"', "Ann"),
        (1.5, 3.0, "x\ny", "Ann"),
        (5.0, 5.0, "clap", ""),
    ]
    chosen = choose_labels(found)
    assert {label.tier for label in chosen.labels} == {"acts", "parts"}
    assert "4 labels left out: a program found them (dyntorch); --tier NAME reads them" in chosen.notices


def test_a_second_run_replaces_the_first_and_times_are_those_of_the_document(tmp_path: Path) -> None:
    path = eaf(tmp_path / "a.eaf", TIMES, ACTS)
    write_labels(path, FOUND, recording="session.mp4")
    once = path.read_bytes()
    write_labels(path, FOUND, recording="session.mp4")
    assert path.read_bytes() == once
    write_labels(path, FOUND, recording="session.mp4", tier="others")
    write_labels(path, [], recording="session.mp4")
    found = open_labels(path)
    assert found.tiers == ("acts", "others", "dyntorch")
    assert len(found.labels) == 5
    path = eaf(tmp_path / "a.eaf", TIMES, ACTS)
    assert write_labels(path, [Label(1, 3, "early"), Label(4, 5, "late")], recording="side.mp4") == [
        "1 label left out: before the time at which the ELAN file begins (early at 1-3 s)"
    ]
    assert open_labels(path, recording="side.mp4", tier="dyntorch").labels[0].start == 4
    assert open_labels(path, recording="session.mp4", tier="dyntorch").labels[0].start == 2


def test_a_tier_that_a_person_took_over_is_theirs(tmp_path: Path) -> None:
    path = eaf(tmp_path / "a.eaf", TIMES, ACTS)
    write_labels(path, FOUND[2:], recording="session.mp4")
    path.write_text(re.sub('ANNOTATOR="dyntorch [0-9a-f]{8}"', 'ANNOTATOR="Ann"', path.read_text()))
    assert open_labels(path).machine == ()
    before = path.read_bytes()
    with pytest.raises(ValueError, match="somebody's tier is called 'dyntorch'; rename it, or write to another file"):
        write_labels(path, FOUND, recording="session.mp4")
    assert path.read_bytes() == before
    path = eaf(tmp_path / "b.eaf", TIMES, ACTS)
    write_labels(path, FOUND[2:], recording="session.mp4")
    kind = "    <LINGUISTIC_TYPE LINGUISTIC_TYPE_ID"
    path.write_text(path.read_text().replace(kind, tier("mine", kind="same", more=' PARENT_REF="dyntorch"') + kind, 1))
    with pytest.raises(ValueError, match="tier 'mine' hangs on 'dyntorch'"):
        write_labels(path, FOUND, recording="session.mp4")


def test_corrections_are_not_written_over(tmp_path: Path) -> None:
    path = eaf(tmp_path / "a.eaf", TIMES, ACTS)
    write_labels(path, [Label(1, 3, "squat", "Ann"), Label(2, 4, "squat", "Ann")], recording="session.mp4")
    sound = path.read_text()
    second = sound[sound.index("<TIER ANNOTATOR", sound.index('TIER_ID="dyntorch@Ann"')) :]
    second = second[: second.index("</TIER>") + 7]
    assert 'TIER_ID="dyntorch@Ann (2)"' in second and "<ANNOTATION_VALUE>squat" in second
    saved_again = sound.replace("\n    <ANNOTATION>", "\r\n\t<ANNOTATION>")  # by ELAN: other bytes, the same annotations
    for same in (sound, saved_again):
        path.write_text(same, newline="")
        write_labels(path, [Label(1, 3, "squat", "Ann"), Label(2, 4, "squat", "Ann")], recording="session.mp4")
        assert open_labels(path, tier="dyntorch").labels[0].label == "squat"
    for wrong, tier_ in (
        (sound.replace(second, second.replace(">squat<", ">lunge<")), "dyntorch@Ann (2)"),
        (sound.replace('TIME_VALUE="3000"', 'TIME_VALUE="3100"'), "dyntorch@Ann"),
        (sound.replace(second, ""), "dyntorch@Ann"),  # what is taken out is a correction, too
    ):
        assert wrong != sound
        path.write_text(wrong)
        before = path.read_bytes()
        for dry in (True, False):
            with pytest.raises(ValueError, match=rf"a\.eaf: tier '{re.escape(tier_)}' is not as dyntorch wrote it.*; rename it to"):
                write_labels(path, FOUND, recording="session.mp4", dry=dry)
        assert path.read_bytes() == before


def test_files_that_are_no_place_for_labels(tmp_path: Path) -> None:
    path = eaf(tmp_path / "a.eaf", TIMES, ACTS)
    with pytest.raises(ValueError, match=r"its labels are of session\.mp4, side\.mp4, not of third\.mp4"):
        write_labels(path, FOUND, recording="third.mp4")
    write_labels(path, FOUND, recording="third.mp4", media="side.mp4")
    with pytest.raises(ValueError, match="these labels are of 2"):
        write_labels(tmp_path / "b.eaf", [Label(0, 1, "x", media="a"), Label(0, 1, "x", media="b")])
    path.write_text(HEAD.replace("UTF-8", "ISO-8859-1") + TIMES + TYPES)
    with pytest.raises(ValueError, match="is in the encoding ISO-8859-1; save it again in ELAN"):
        write_labels(path, FOUND, recording="session.mp4")
    eaf(path, ACTS)
    with pytest.raises(ValueError, match="has no TIME_ORDER"):
        write_labels(path, FOUND, recording="session.mp4")


def test_a_new_file_is_what_elan_asks_for(tmp_path: Path) -> None:
    path = tmp_path / "new.eaf"
    assert write_labels(path, [Label(0, 1, "x", score=1.0, comment="c")], recording=tmp_path / "my film.mp4") == [
        "ELAN keeps no comments and no scores"
    ]
    root = ElementTree.parse(path).getroot()
    assert [child.tag for child in root] == ["HEADER", "TIME_ORDER", "TIER", "LINGUISTIC_TYPE", *["CONSTRAINT"] * 4]
    medium = root.find("HEADER/MEDIA_DESCRIPTOR")
    assert medium is not None
    assert medium.get("MEDIA_URL") == (tmp_path / "my film.mp4").as_uri()
    assert read_labels(path, recording="my film.csv") == [Label(0, 1, "x", media="my film.mp4", tier="dyntorch")]
