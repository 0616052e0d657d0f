"""``dyntorch index suggest``: what to label next, as a table and as a file for the program in which people label."""

from __future__ import annotations

from pathlib import Path

import pytest

from indexing import ActionIndexer
from indexing.actors import Person, detect, stream
from indexing.cli import main
from indexing.labels import open_labels
from tests.indexing.cli.footage import write_coco

COMMAND = "index suggest"
ONE_LINE = True

DONE = ["squat", "kick", "wave", "bow", "squat"]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``session.json``, in which the first squat and the wave are labelled, and what was learned from them."""
    folder = tmp_path_factory.mktemp("suggest")
    solid, truth = stream(DONE, Person.random(5), rng=3)
    write_coco(folder / "session.json", detect(solid, azimuth=45, rng=3))
    rows = [f"{label},{start:.2f},{end:.2f}" for label, start, end in truth]
    (folder / "all.csv").write_text("\n".join(["label,start,end", *rows]) + "\n")
    (folder / "session.csv").write_text("\n".join(["label,start,end", rows[0], rows[2]]) + "\n")
    assert main(["index", "fit", f"{folder}/session.json", "--labels", f"{folder}/session.csv", "-o", f"{folder}/m.st"]) == 0
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".eaf", ".boris", ".csv", ".tsv", ".json"])
def test_parts_are_written_for_the_program_in_which_people_label(run, suffix: str) -> None:
    code, out, err = run(f"@/session.json -m @/m.st --labels @/session.csv --number 2 --write todo{suffix}")
    assert (code, err) == (0, "")
    assert "unlike what is known" in out and "2 parts to label" in out and f"written: todo{suffix}" in out
    found = open_labels(f"todo{suffix}", recording="session.json").labels
    assert len(found) == 2 and all(one.label in ("? squat", "? wave") for one in found)
    assert {one.tier or one.observation for one in found} <= {"to label", "to label session.json", ""}


@pytest.mark.slow
def test_what_is_corrected_is_learned_and_the_rest_is_not(run, data: Path, tmp_path: Path) -> None:
    assert run("@/session.json -m @/m.st --labels @/session.csv --number 2 --write todo.csv")[0] == 0
    lines = (tmp_path / "todo.csv").read_text().splitlines()
    lines[1] = "kick" + lines[1][lines[1].index(",") :]
    (tmp_path / "todo.csv").write_text("\n".join(lines) + "\n")
    labels = ["--labels", f"{data}/session.csv", "--labels", "todo.csv"]
    assert main(["index", "fit", f"{data}/session.json", *labels, "-o", "new.st"]) == 0
    assert ActionIndexer.load("new.st").classes_.tolist() == ["kick", "squat", "wave"]


def test_nothing_is_left_where_all_is_labelled(run) -> None:
    code, out, _ = run("@/session.json -m @/m.st --labels @/all.csv")
    assert code == 0 and ("part to label" in out or "nothing to label: nobody moves in what is left" in out)


@pytest.mark.slow
def test_suggestions_are_replaced_by_those_of_the_next_round(run, tmp_path: Path) -> None:
    for _ in range(2):
        assert run("@/session.json -m @/m.st --number 3 --write todo.eaf")[0] == 0
    assert len(open_labels(tmp_path / "todo.eaf").labels) == 3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("-m @/m.st", ("no recordings",)),
        ("@/session.json -m @/m.st --number 0", ("--number 0", "1 or more")),
        ("nope.json -m @/m.st", ("nope.json", "no such file")),
        ("@/session.json -m nope.st", ("nope.st",)),
        ("@/session.json -m @/m.st --write todo.doc", ("todo.doc", "no format that labels are written in")),
        ("@/session.json -m @/m.st --write @/session.csv", ("session.csv", "is there already")),
        ("@/session.json -m @/m.st --tier arms", ("--tier", "--labels FILE")),
        ("@/session.json -m @/m.st --labels nope.csv", ("nope.csv",)),
    ],
)
def test_bad_input_is_one_line(refuse, line: str, words: tuple[str, ...]) -> None:
    refuse(line, says=words)
