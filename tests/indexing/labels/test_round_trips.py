"""What is written is read again, in every format: to its resolution, and in all that docs/guide/labels.md says it keeps."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from random import Random

import pytest

from indexing.labels import Label, open_labels, write_labels
from indexing.labels.label import sort_key
from indexing.opening import first_duplicate

SUFFIX = {"boris": ".boris", "elan": ".eaf", "csv": ".csv", "tsv": ".tsv"}
FORMATS = (*SUFFIX, "activitynet", "label_studio", "via")
LOST = {
    "boris": ("tier",),
    "elan": ("observation", "comment", "modifiers", "score"),
    "label_studio": (),
}
"""Fields that a format has no place for; the docs say the same."""
RESOLUTION = {"boris": 1e-3, "elan": 1e-3, "label_studio": 1 / 50, "csv": 1e-6, "tsv": 1e-6, "activitynet": 1e-6, "via": 1e-6}
WORDS = (
    *(
        "squat",
        "arm raise",
        "a,b;c",
        'say "hi"',
        "it's <b> & ]]>",
        "\u05e9\u05dc\u05d5\u05dd",
        "\u0645\u0631\u062d\u0628\u0627",
        "two\nlines",
    ),
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
    for label in labels:
        if name == "elan" or name == "via":
            label = replace(label, tier="" if label.tier == "dyntorch" else label.tier)
        if name == "boris":
            own = label.observation.startswith("dyntorch ")
            label = replace(label, observation="" if own else label.observation)
        if name == "label_studio":
            label = replace(label, observation="" if label.observation == "dyntorch" else label.observation)
        out.append(replace(label, start=round(label.start, 6), end=round(label.end, 6)))
    return sorted(out, key=lambda label: (sort_key(label), repr(label)))


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("name", FORMATS)
def test_what_is_written_is_read_again(name: str, seed: int, tmp_path: Path) -> None:
    rng = Random(seed)
    media = ("session.mp4",) if name == "elan" else ("session.mp4", "my films/other.mp4")
    wanted = draw(rng, rng.choice((0, 1, 3, 40)), media)
    if name == "label_studio":
        wanted = [replace(label, media=label.media.rpartition("/")[2]) for label in wanted]
    if name == "via":
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


def test_labels_without_a_name_are_not_written(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    assert write_labels(path, [Label(0, 1, " x "), Label(1, 2, " ")]) == ["1 label without a name left out"]
    assert open_labels(path).labels == (Label(0, 1, "x"),)


def test_characters_that_xml_cannot_write(tmp_path: Path) -> None:
    path = tmp_path / "a.eaf"
    said = write_labels(path, [Label(0, 1, "a\x00b\ud800")], recording="session.mp4")
    assert said == ["control characters in 1 label became \ufffd"]
    assert open_labels(path).labels[0].label == "a\ufffdb\ufffd"
