"""The pages of results: each names a command that exists, and that command, run as the page says, writes it."""

from __future__ import annotations

import importlib.util
import sys
from fnmatch import fnmatch

import pytest

from experiments.common.results import COMMAND, MARK, RESULTS, as_markdown, page_name, published

PAGES = sorted(path for path in RESULTS.glob("*.md") if path.stem not in ("index", "one_example"))


def test_every_page_states_a_command_that_exists_and_is_in_the_list():
    patterns = (RESULTS / "index.md").read_text(encoding="utf-8").splitlines()
    for path in PAGES:
        text = path.read_text(encoding="utf-8")
        stated = COMMAND.search(text.partition(MARK)[0])
        assert stated is not None and MARK in text, path.stem
        assert page_name(stated["module"]) == path.stem and importlib.util.find_spec(stated["module"]) is not None
        assert any(fnmatch(path.stem, pattern) for pattern in patterns), path.stem


@pytest.mark.parametrize(("words", "written"), [(["--scenes", "20"], True), (["--scenes", "3"], False), ([], False)])
def test_a_command_writes_its_page_only_as_the_page_says(tmp_path, capsys, words, written):
    page = tmp_path / "some.md"
    head = f"# Some\n\nWhat it is.\n\n`DYNTORCH_DATA=... python -m experiments.some --scenes 20`\n\n{MARK}"
    page.write_text(head + "\n\nold table\n", encoding="utf-8")
    with published("experiments.some", words, {}, tmp_path):
        print("| new |\n|---|\n\ntwo\nlines")
    assert capsys.readouterr().out.startswith("| new |")
    text = page.read_text(encoding="utf-8")
    assert text.startswith(head)
    assert ("old table" in text) != written
    assert ("| new |\n|---|\n\n```text\ntwo\nlines\n```\n" in text and "*Measured on 20" in text) == written


def test_a_new_script_gets_a_page_and_what_fails_or_has_no_folder_none(tmp_path, monkeypatch):
    monkeypatch.setattr(sys.modules["__main__"], "__doc__", "What was asked.\n\nMore.")
    with published("experiments.benchmarks.new_one", ["--seeds", "2"], {}, tmp_path):
        print("| a |\n|---|")
    text = (tmp_path / "benchmarks-new_one.md").read_text(encoding="utf-8")
    assert text.startswith(
        "# Benchmarks-new one\n\nWhat was asked.\n\n`python -m experiments.benchmarks.new_one --seeds 2`\n\n" + MARK
    )
    with pytest.raises(ValueError, match="no data"), published("experiments.some", [], {}, tmp_path / "none"):
        raise ValueError("no data")
    for program, folder in (("experiments.some", tmp_path / "none"), ("pytest.__main__", tmp_path)):
        with published(program, [], {}, folder):
            print("| a |")
    assert [path.name for path in tmp_path.iterdir()] == ["benchmarks-new_one.md"]
    assert as_markdown("\n### T\n\n| a |\n|---|\n") == "### T\n\n| a |\n|---|"  # headings are below the title
