"""What the README shows is what happens: every command, every Python block, its exit code and what it prints."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.documents import difference, excerpt, run, steps

ROOT = Path(__file__).parent.parent
README = ROOT / "README.md"


COMPARED = (
    ("rms: 0.476 px,  47 static", "rms: 0.477 px, 47 static", True),
    ("[4.4  1.28]", "[4.41 1.28]", True),
    ("64 % done", "65 % done", True),
    ("rms: 0.476 px", "rms: 0.478 px", False),
    ("47 static", "48 static", False),
    ("64 % done", "66 % done", False),
    ("ok 1", "refused 1", False),
    ("ok 1", "ok 1 2", False),
)


def test_outputs_are_compared_as_words_and_numbers_and_excerpts_in_their_order():
    for shown, printed, same in COMPARED:
        assert (difference(shown, printed) == "") == same, shown
    printed = "head\n ────\nfirst 1.00\nsecond 2.00\n"
    assert excerpt("head\nsecond 2.01\n", printed) == ""
    assert "second" not in excerpt("second 2.00\nfirst 1.00\n", printed).splitlines()[0]
    assert excerpt("third 3.00\n", printed).startswith("not printed")


def test_steps_of_a_document():
    text = "```\n$ dyntorch a  # exit code 3\nout\n$ cd b/\n```\n```python\nprint(1)\n```\n```\n1\n```\n```\nmake demo\n```\n"
    command, folder, code = steps(text.replace("  # exit", " # exit"))
    assert (command.typed, command.shown, command.code) == ("dyntorch a", "out\n", 3)
    assert folder.typed == "cd b/"
    assert (code.python, code.typed, code.shown) == (True, "print(1)\n", "1\n")


@pytest.mark.slow
def test_everything_the_readme_shows_happens(tmp_path):
    pytest.importorskip("av")  # the README's videos
    assert run(README, tmp_path) == []


def test_the_readme_is_read_in_one_sitting():
    assert len(README.read_text(encoding="utf-8").splitlines()) <= 250


def test_the_make_targets_of_the_readme_are_there():
    targets = re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    named = re.findall(r"^make (\w+)|`make (\w+)", README.read_text(encoding="utf-8"), re.MULTILINE)
    assert {"demo", "test", "docs"} <= {first or second for first, second in named} <= set(targets)
