"""Labels that people made on the command line: learned from, compared with, and written beside what was found."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from indexing import ActionIndexer, Clip, ClipSet
from indexing.actors import Person, detect, stream
from indexing.cli import main
from indexing.cli.flags.shared import Example, Labelling, Reading
from indexing.cli.labels import check_write, film_examples
from indexing.labels import Label, open_labels, write_labels
from tests.indexing.cli.footage import write_coco

ONE_LINE = True

DONE = ["kick", "wave", "squat", "kick", "wave", "squat"]
SEVERAL = (".boris", ".csv", ".tsv", ".json")


def session(rng: int, azimuth: float = 45.0) -> tuple[Clip, list[Label]]:
    """A recording of six actions and what a person would mark in it."""
    solid, truth = stream(DONE, Person.random(5), rng=rng)
    return detect(solid, azimuth=azimuth, rng=rng), [Label(round(a, 2), round(b, 2), name) for name, a, b in truth]


def sleap(path: Path, people: dict[str, Clip]) -> Path:
    """Several people as a table of tracks."""
    names = next(iter(people.values())).skeleton.joints
    head = ["track", "frame_idx", "instance.score", *(f"{name}.{part}" for name in names for part in ("x", "y", "score"))]
    rows = [
        [who, frame, 1.0, *np.column_stack([np.nan_to_num(clip.joints[frame], nan=-1.0), clip.confidence[frame]]).ravel()]
        for who, clip in people.items()
        for frame in range(len(clip))
    ]
    with open(path, "w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([head, *rows])
    return path


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``session.json`` with its labels in three formats, another recording with its own, and a model."""
    folder = tmp_path_factory.mktemp("labels")
    for rng, name in ((3, "session"), (4, "later")):
        clip, labels = session(rng)
        write_coco(folder / f"{name}.json", clip)
        marked = [replace(label, media=f"{name}.mp4") for label in labels]
        for suffix in (".boris", ".eaf", ".csv"):
            write_labels(folder / f"{name}{suffix}", marked, tier="by Ann", duration=clip.duration)
    both = [replace(one, media=f"{name}.mp4") for rng, name in ((3, "session"), (4, "later")) for one in session(rng)[1]]
    write_labels(folder / "both.csv", both)
    assert main(["index", "fit", f"{folder}/session.json", "--labels", f"{folder}/session.csv", "-o", f"{folder}/m.st"]) == 0
    return folder


@pytest.fixture
def refuse(refuse):
    """The same with the words after the line."""
    return lambda line, *words: refuse(line, says=words)


def table(path: Path, *rows: str, head: str = "label,start,end") -> Path:
    path.write_text("\n".join([head, *rows]) + "\n")
    return path


# ---- fit -------------------------------------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize("name", ["session.boris", "session.eaf", "session.csv"])
def test_what_is_marked_is_cut_out_and_learned(run, name: str) -> None:
    code, out, err = run(f"index fit @/session.json --labels @/{name} -o m.st")
    assert code == 0 and err == "" and "kick 2" in out and "17 in 2D" in out
    model = ActionIndexer.load("m.st")
    assert model.classes_.tolist() == ["kick", "squat", "wave"] and np.bincount(model.model_.labels).tolist() == [2, 2, 2]
    lengths = sorted(one.end - one.start for one in session(3)[1])
    assert np.allclose(sorted(model.model_.exemplars.seconds.tolist()), lengths, atol=0.05)


def test_labels_that_cannot_be_learned_from_are_said(run, tmp_path: Path) -> None:
    rows = ["kick,0.7,2.7", "wave,3.5,6.3", "clap,1,1", "squat,90,95", "jump,7,7.03", "squat,15,99", ",8,9"]
    table(tmp_path / "session.csv", *rows, "? bow,7,9")
    code, out, _ = run("index fit @/session.json --labels session.csv -o m.st")
    assert code == 0
    assert "session.csv: 1 label left out: of a moment, without duration" in out
    assert "1 label left out: suggested ('? ...'), and confirmed by nobody" in out
    assert "1 label left out: outside session.json, which runs from 0 to" in out and "squat at 90-95 s" in out
    assert "1 label cut: session.json" in out and "1 label left out, as too short or of nobody in view" in out
    assert ActionIndexer.load("m.st").classes_.tolist() == ["kick", "squat", "wave"]


@pytest.mark.slow
def test_several_recordings_each_with_its_labels(run, data: Path) -> None:
    for labels in ("--labels @/session.csv --labels @/later.csv", "--labels @/both.csv"):
        assert run(f"index fit @/session.json @/later.json {labels} -o m.st")[0] == 0
        assert np.bincount(ActionIndexer.load("m.st").model_.labels).tolist() == [4, 4, 4]
    code, out, _ = run("index fit @/later.json bow=@/session.json@0-0.6 --labels @/both.csv -o m.st")
    assert code == 0 and "6 labels left out: of other recordings (session.mp4)" in out
    assert ActionIndexer.load("m.st").classes_.tolist() == ["bow", "kick", "squat", "wave"]


@pytest.mark.slow
def test_what_lies_between_labels_is_background_where_that_is_said(run, data: Path, tmp_path: Path) -> None:
    table(tmp_path / "session.csv", *(f"{one.label},{one.start},{one.end}" for one in session(3)[1] if one.label == "kick"))
    code, out, _ = run("index fit @/session.json --labels session.csv --unlabelled-is-background -o m.st")
    assert code == 0 and "s between labels are learned as background" in out
    hidden = ActionIndexer.load("m.st").model_.hidden
    assert run("index fit @/session.json --labels session.csv -o m.st")[0] == 0
    assert hidden > ActionIndexer.load("m.st").model_.hidden > 0
    events = ActionIndexer.load("m.st").find(ClipSet.load(data / "session.json")[0])
    assert {event.label for event in events} <= {"kick"}


@pytest.mark.slow
def test_a_subject_is_the_person_of_that_name(run, tmp_path: Path) -> None:
    people = {"ann": session(3)[0], "ben": session(4)[0]}
    people["ben"] = people["ben"].replace(joints=people["ben"].joints + np.array([700.0, 0.0]))
    sleap(tmp_path / "two.csv", people)
    rows = [f"{one.label},{one.start},{one.end},{who}" for rng, who in ((3, "Ann"), (4, "Ben")) for one in session(rng)[1][:3]]
    table(tmp_path / "marked.csv", *rows, head="label,start,end,subject")
    assert run("index fit two.csv --labels marked.csv -o m.st")[0] == 0
    model = ActionIndexer.load("m.st")
    assert sorted(model.groups_) == ["Ann"] * 3 + ["Ben"] * 3
    assert run("index fit two.csv --labels marked.csv --subject Ann -o m.st")[0] == 0
    assert len(ActionIndexer.load("m.st").model_.labels) == 3
    assert run("index fit two.csv --labels marked.csv --subject Ann=ben -o m.st")[0] == 0
    code, out, _ = run("index evaluate two.csv -m m.st --labels marked.csv")
    assert code == 0 and "of 2 people in 1 recording" in out
    code, out, _ = run("index scan two.csv -m m.st --write found.csv")
    assert code == 0 and set(open_labels("found.csv").subjects) == {"ann", "ben"}


@pytest.mark.slow
def test_fit_refuses_bad_labels(refuse, data: Path, tmp_path: Path) -> None:
    fit = "index fit @/session.json -o m.st"
    table(tmp_path / "far.csv", "kick,100,102", "wave,103,105")
    table(tmp_path / "points.csv", "kick,1,1")
    table(tmp_path / "none.csv")
    table(tmp_path / "twice.csv", "kick,1,2,lower", "leg,1,2,all", head="label,start,end,tier")
    table(tmp_path / "hands.csv", "kick,1,2,Ann", "kick,1,2.1,Ben", head="label,start,end,observation")
    table(tmp_path / "who.csv", "kick,1,2,Ann", "wave,3.5,6,Ben", head="label,start,end,subject")
    table(tmp_path / "other.csv", "kick,1,2,garden.mp4", head="label,start,end,file")
    (tmp_path / "empty.eaf").touch()
    (tmp_path / "words.txt").write_text("once upon a time\n")
    refuse(f"{fit} --labels nope.csv", "nope.csv", "no such file")
    refuse(f"{fit} --labels empty.eaf", "empty.eaf", "the file is empty")
    refuse(f"{fit} --labels words.txt", "words.txt")
    refuse(f"{fit} --labels none.csv", "none.csv", "nothing is marked there")
    refuse(f"{fit} --labels points.csv", "points.csv", "nothing is marked there")
    refuse(f"{fit} --labels far.csv", "far.csv", "none of its 2 labels", "outside session.json", "kick at 100-102 s")
    refuse(f"{fit} --labels twice.csv", "session.json: 1 to 2 s is marked", "'kick'", "'leg'", "--tier", "all, lower")
    refuse(f"{fit} --labels hands.csv", "2 observations (Ann, Ben)", "--observation")
    refuse(f"{fit} --labels hands.csv --observation Cid", "no observation 'Cid'", "Ann, Ben")
    refuse(f"{fit} --labels twice.csv --tier arms", "no tier 'arms'", "lower, all")
    refuse(f"{fit} --labels who.csv", "is of Ann, Ben, but session.json shows one person", "--subject")
    refuse(f"{fit} --labels who.csv --subject Cid", "no label of the subject 'Cid'", "Ann, Ben")
    refuse(f"{fit} --labels other.csv", "other.csv", "garden.mp4", "session.json", "--media")
    both = "index fit @/session.json @/later.json -o m.st --labels"
    refuse(f"{both} @/session.csv", "later.json", "none of the files of labels is of it")
    refuse(f"{both} @/both.csv --labels other.csv", "other.csv", "garden.mp4", "none of the recordings")
    refuse(f"{fit} --tier arms", "--tier", "there are none", "--labels")
    refuse(f"{fit} --unlabelled-is-background", "--unlabelled-is-background", "--labels")
    refuse("index fit a=@/session.json b=@/later.json -o m.st --labels @/session.csv", "has a label already", "without label=")
    refuse("index fit @/session.json@1-9 -o m.st --labels @/session.csv", "leave @ out")
    refuse("index fit @/session.json -o @/session.csv --labels @/session.csv", "session.csv", "is an input")


def test_people_who_are_not_there_are_refused(refuse, tmp_path: Path) -> None:
    clip = session(3)[0]
    sleap(tmp_path / "two.csv", {"1": clip, "2": clip.replace(joints=clip.joints + np.array([700.0, 0.0]))})
    table(tmp_path / "who.csv", "kick,1,2,Ann", head="label,start,end,subject")
    refuse("index fit two.csv --labels who.csv -o m.st", "'Ann' is none of the people of two.csv (1, 2)", "--subject Ann=1")


# ---- scan ------------------------------------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".eaf", *SEVERAL])
def test_what_is_found_is_written_and_read_again(run, suffix: str) -> None:
    code, out, _ = run(f"index scan @/session.json -m @/m.st --write deep/found{suffix} --labels @/session.csv --report out")
    assert code == 0 and "of 6 known actions found" in out and f"written: deep/found{suffix}" in out
    rows = list(csv.DictReader(Path("out/events.csv").read_text().splitlines()))
    found = open_labels(f"deep/found{suffix}", recording="session.json")
    assert [one.label for one in found.labels] == [row["label"] for row in rows] and len(rows) >= 5
    assert np.allclose(
        [(one.start, one.end) for one in found.labels], [(float(row["start"]), float(row["end"])) for row in rows], atol=2e-3
    )
    assert found.machine or suffix in (".csv", ".tsv", ".json")


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".eaf", ".boris"])
def test_what_is_found_stands_beside_what_a_person_marked(run, data: Path, tmp_path: Path, suffix: str) -> None:
    mine = tmp_path / f"session{suffix}"
    mine.write_bytes((data / f"session{suffix}").read_bytes())
    before = open_labels(mine)
    assert run(f"index scan @/session.json -m @/m.st --write {mine.name}")[0] == 0
    after = open_labels(mine)
    assert set(before.labels) < set(after.labels)
    assert run(f"index scan @/session.json -m @/m.st --write {mine.name}")[0] == 0  # its own tier is replaced
    assert len(open_labels(mine).labels) == len(after.labels)
    if suffix == ".eaf":  # what was found is compared with the person's
        code, out, _ = run(f"index evaluate {mine.name} --labels @/session.csv")
        assert code == 0 and "Cohen's kappa over time 0." in out


@pytest.mark.slow
def test_detections_of_several_recordings_in_one_file(run, refuse) -> None:
    for suffix in SEVERAL:
        assert run(f"index scan @/session.json @/later.json -m @/m.st --write found{suffix}")[0] == 0
        found = open_labels(f"found{suffix}")
        assert {Path(name).stem for name in found.media} == {"session", "later"}
    refuse("index scan @/session.json @/later.json -m @/m.st --write two.eaf", "an ELAN .eaf is of one recording", "two.boris")


@pytest.mark.slow
def test_scan_refuses_before_it_begins(refuse, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ActionIndexer, "decode", None)  # whoever gets so far fails
    (tmp_path / "broken.eaf").write_text("<ANNOTATION_DOCUMENT>")
    scan = "index scan @/session.json -m @/m.st"
    refuse(f"{scan} --write found.txt", "found.txt", ".txt is no format", ".eaf")
    refuse(f"{scan} --write found", "without an ending", ".boris")
    refuse(f"{scan} --write broken.eaf", "broken.eaf")
    (tmp_path / "folder.eaf").mkdir()
    refuse(f"{scan} --write folder.eaf", "is a folder")
    refuse(f"{scan} --truth @/session.csv --labels @/session.csv", "--truth", "--labels")
    (tmp_path / "file.csv").write_bytes((data / "session.csv").read_bytes())
    refuse(f"{scan} --write file.csv", "is there already", ".boris, .eaf")
    refuse(f"{scan} --write file.csv/found.csv", "is a file")


@pytest.mark.slow
def test_corrections_are_not_written_over(refuse, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ActionIndexer, "decode", None)  # said before anything is searched
    found = [Label(1, 3, "kick", score=2.0), Label(4, 6, "wave", score=1.0)]
    scan = "index scan @/session.json -m @/m.st --write"
    for suffix in (".csv", ".tsv", ".json"):  # no row says whether somebody corrected it
        write_labels(f"found{suffix}", found, recording="session.mp4")
        refuse(f"{scan} found{suffix}", f"found{suffix}: is there already; give another name", ".boris, .eaf")
    Path("keypoints.json").write_text('[{"image_id": 1, "keypoints": [1.0, 2.0, 0.5]}]')  # nor is what holds no labels ours
    refuse(f"{scan} keypoints.json", "keypoints.json: is there already")
    for tier, command in (("dyntorch", "scan"), ("to label", "suggest")):
        write_labels("found.eaf", found, recording="session.mp4", tier=tier)
        write_labels("found.boris", [replace(one, media="session.mp4") for one in found], recording="later.mp4", tier=tier)
        eaf, boris = Path("found.eaf"), Path("found.boris")
        eaf.write_text(eaf.read_text().replace('"3000"', '"3100"'))
        boris.write_text(boris.read_text().replace("3.0", "3.1"))
        line = f"index {command} @/session.json -m @/m.st --write"
        refuse(f"{line} found.eaf", f"found.eaf: tier '{tier}'", "somebody has corrected it; rename it to take it over, delete it")
        refuse(f"{line} found.boris", f"found.boris: observation '{tier} session.mp4'", "somebody has corrected it", "another file")
        refuse(f"{line.replace('@/s', '@/later.json @/s')} found.boris", f"observation '{tier} session.mp4'")
    assert check_write(Path("found.boris"), [], [Path("later.json")], tier="to label") == Path("found.boris")  # another recording


# ---- evaluate --------------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_a_model_is_compared_with_what_a_person_marked(run, tmp_path: Path) -> None:
    code, out, err = run("index evaluate @/later.json -m @/m.st --labels @/later.eaf --report out")
    assert code == 0 and err == "" and "Cohen's kappa over time 0." in out and "F1@0.5" in out
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {"report.html", "metrics.json", "manifest.json", "confusion.png", "confusion.csv", "timeline.png"}
    measured = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert measured["kappa"] > 0.7 and measured["at_overlap"]["0.5"]["known"] == 6
    assert f"kappa over time {measured['kappa']:.3f}" in out
    assert np.sum(measured["confusion_seconds"]["rows_known_columns_found"]) == pytest.approx(measured["seconds_compared"])
    page = (tmp_path / "out" / "report.html").read_text()
    assert "Cohen" in page and "later.eaf" in page and "<script" not in page
    inputs = json.loads((tmp_path / "out" / "manifest.json").read_text())["inputs"]
    assert {Path(name).name for name in inputs} == {"later.json", "later.eaf", "m.st"}


def test_two_files_of_labels_are_compared(run, tmp_path: Path) -> None:
    code, out, _ = run("index evaluate @/session.eaf --labels @/session.csv")
    assert code == 0 and "the same in 100.0 % of the time, Cohen's kappa over time 1.000" in out
    table(tmp_path / "hands.csv", "kick,1,2,Ann", "kick,1,2.2,Ben", "squat,3,4,Ann", head="label,start,end,observation")
    code, out, _ = run("index evaluate hands.csv --labels hands.csv --observation Ann --found-observation Ben")
    assert code == 0 and "Ben against Ann: 4.0 s in 1 recording" in out
    assert "compared from 0 to 4 s, where the last label of either side ends" in out


def test_people_are_compared_each_with_their_own(run, refuse, tmp_path: Path) -> None:
    table(tmp_path / "a.csv", "kick,1,2,Ann", "kick,5,6,Ben", head="label,start,end,subject")
    table(tmp_path / "b.csv", "kick,5,6,Ann", "kick,1,2,Ben", head="label,start,end,subject")
    table(tmp_path / "c.csv", "kick,1,2,1", "kick,5,6,2", head="label,start,end,subject")
    code, out, _ = run("index evaluate b.csv --labels a.csv")
    assert code == 0 and "12.0 s of 2 people" in out and "0.5 0 2 2" in out
    refuse("index evaluate c.csv --labels a.csv", "no subject in common", "--subject Ann=1")
    code, out, _ = run("index evaluate c.csv --labels a.csv --subject Ann=1 --subject Ben=2")
    assert code == 0 and "kappa over time 1.000" in out


@pytest.mark.slow
def test_recordings_are_compared_each_with_their_own(run, refuse, tmp_path: Path) -> None:
    assert run("index evaluate @/both.csv --labels @/session.csv")[0] == 2
    code, out, _ = run("index evaluate @/session.csv --labels @/both.csv")
    assert code == 0 and "left out: later.mp4, of which" in out and "in 1 recording" in out
    code, out, _ = run("index evaluate @/both.csv --labels @/both.csv --report out")
    assert code == 0 and "in 2 recordings" in out and "kappa over time 1.000" in out
    assert (tmp_path / "out" / "timeline-2.png").exists()


HAND = ["squat,1,3,a.mp4", "squat,1,2,b.mp4", "squat,4,5,b.mp4"]


@pytest.mark.parametrize("suffix", [".boris", ".json"])
def test_where_nothing_was_found_everything_was_missed(run, suffix: str, tmp_path: Path) -> None:
    table(tmp_path / "mine.csv", *HAND, head="label,start,end,media")
    found = tmp_path / f"found{suffix}"
    write_labels(found, [Label(1, 3, "squat", media="a.mp4", score=2.0)], recording="b.mp4")
    code, out, _ = run(f"index evaluate {found.name} --labels mine.csv --report out")
    assert code == 0 and "left out: b.mp4" not in out
    measured = json.loads(Path("out/metrics.json").read_text())
    half = measured["at_overlap"]["0.5"]
    assert (half["right"], half["found"], half["known"], half["f1"]) == (1, 1, 3, 0.5)
    # of 3 + 5 s both say squat for 2 and nothing for 4; by chance (4 * 2 + 4 * 6) / 64
    assert measured["seconds_compared"] == 8 and measured["agreement"] == 0.75 and measured["kappa"] == pytest.approx(0.5)


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".boris", ".eaf", ".csv", ".json"])
def test_nothing_found_at_all_is_compared(run, refuse, suffix: str, tmp_path: Path) -> None:
    table(tmp_path / "mine.csv", *HAND[1:], head="label,start,end,media")
    write_labels(f"found{suffix}", [], recording="b.mp4")
    code, out, err = run(f"index evaluate found{suffix} --labels mine.csv --report out")
    assert (code, err) == (0, "") and f"found{suffix}: nothing was found there" in out
    measured = json.loads(Path("out/metrics.json").read_text())
    assert measured["at_overlap"]["0.5"]["known"] == 2 and measured["at_overlap"]["0.5"]["f1"] == 0
    assert measured["agreement"] == pytest.approx(0.6) and measured["kappa"] == 0
    refuse(f"index evaluate mine.csv --labels found{suffix}", f"found{suffix}", "holds no label that lasts")
    if suffix in (".boris", ".eaf"):
        table(tmp_path / "other.csv", "squat,1,2,c.mp4", head="label,start,end,media")
        refuse(f"index evaluate found{suffix} --labels other.csv", "is of b.mp4", "c.mp4", "the same recordings")


def test_an_empty_tier_beside_those_of_a_person_says_that_nothing_was_found(run, tmp_path: Path) -> None:
    table(tmp_path / "mine.csv", *HAND[1:], head="label,start,end,media")
    write_labels("b.eaf", [Label(1, 2, "squat"), Label(4, 5, "squat")], recording="b.mp4", tier="Ann")
    text = Path("b.eaf").read_text()
    Path("b.eaf").write_text(text.replace('ANNOTATOR="dyntorch ', 'ANNOTATOR="Ann '))
    write_labels("b.eaf", [], recording="b.mp4")
    code, out, _ = run("index evaluate b.eaf --labels mine.csv")
    assert code == 0 and "compared is what a program found (dyntorch)" in out and "nothing was found there" in out
    assert "0.5 0 0 2" in out
    Path("b.eaf").write_text(Path("b.eaf").read_text().replace('TIER_ID="dyntorch"', 'TIER_ID="to label"'))
    code, out, _ = run("index evaluate b.eaf --labels mine.csv")  # where nothing was suggested, the person's count
    assert code == 0 and "0.5 2 2 2" in out
    code, out, _ = run("index evaluate b.eaf --labels mine.csv --found-tier Ann")
    assert code == 0 and "0.5 2 2 2" in out


@pytest.mark.slow
def test_evaluate_refuses_what_makes_no_sense(refuse, data: Path, tmp_path: Path) -> None:
    table(tmp_path / "points.csv", "kick,1,1")
    labels = "--labels @/session.csv"
    refuse(f"index evaluate @/later.csv {labels}", "session.mp4", "later.mp4")
    refuse(f"index evaluate points.csv {labels}", "points.csv", "no label that lasts")
    refuse(f"index evaluate @/session.csv @/later.csv {labels}", "compare one file of labels with one")
    refuse(f"index evaluate {labels}", "compare one file of labels with one")
    refuse(f"index evaluate @/session.csv {labels} --train view=1", "--train", "of clip sets only")
    refuse(f"index evaluate @/session.json -m @/m.st {labels} --found-tier a", "--found-tier")
    refuse("index evaluate @/session.json -m @/m.st", "--model", "--labels FILE")
    refuse("index evaluate", "no clip set", "SET.npz")
    refuse("index evaluate @/session.json --tier a", "--tier", "--labels FILE")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "confusion.csv").write_bytes((data / "session.csv").read_bytes())
    refuse("index evaluate out/confusion.csv --labels @/session.csv --report out", "confusion.csv", "is an input")


@pytest.mark.slow
def test_a_name_within_a_name_is_the_recording_only_where_none_is_called_so(run, refuse, data: Path, tmp_path: Path) -> None:
    for name in ("session_2.json", "sessionDLC_resnet.json"):
        (tmp_path / name).write_bytes((data / "later.json").read_bytes())
    fit = "index fit @/session.json session_2.json -o m.st --labels @/session.csv"
    refuse(fit, "session_2.json", "none of the files of labels")
    code, out, _ = run("index fit sessionDLC_resnet.json @/later.json --labels @/both.csv -o m.st")
    assert code == 0 and np.bincount(ActionIndexer.load("m.st").model_.labels).tolist() == [4, 4, 4] and "left out" in out
    table(tmp_path / "other.csv", "kick,0.7,2.7,garden.mp4", "wave,3.5,6.3,garden.mp4", head="label,start,end,file")
    assert run("index fit @/session.json --labels other.csv --media garden.mp4 -o m.st")[0] == 0


def test_labels_of_videos_are_examples_with_their_seconds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    table(tmp_path / "a.csv", "kick,1,2.5,a.mp4", "clap,1,1,a.mp4", "wave,4,6,b.mp4", head="label,start,end,file")
    given = [Example(Path("a.mp4")), Example(Path("c.mp4"), "bow", None, 2.0)]
    found, notes = film_examples(given, Labelling(labels=(Path("a.csv"),)), Reading())
    assert found == [given[1], Example(Path("a.mp4"), "kick", 1.0, 2.5)]
    assert any("of a moment" in note for note in notes) and any("of other recordings (b.mp4)" in note for note in notes)
    table(tmp_path / "none.csv", "clap,1,1")
    with pytest.raises(ValueError, match=r"none\.csv: nothing is marked there \(1 label left out: of a moment, .*\); mark actions"):
        film_examples(given, Labelling(labels=(Path("none.csv"),)), Reading())
