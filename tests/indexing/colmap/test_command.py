"""``dyntorch segment --colmap``: what is written and said, and bad input in one line."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from indexing.cli import main
from indexing.cli.commands.segment import run_colmap
from indexing.cli.flags.geometry import Segment
from indexing.report.static import FILES
from tests.indexing.colmap.test_database import changed, sha256


def flags(database, out, images=None, **others):
    return Segment(files=(), colmap=database, out=out, images=None if images is None else (images,), **others)


@pytest.fixture
def quick(found, monkeypatch):
    """What was found once is found again at once."""
    monkeypatch.setattr("indexing.cli.commands.segment.find_static", lambda database, *_, **__: replace(found, database=database))


@pytest.mark.slow
def test_everything_is_written(given, quick, tmp_path, capsys):
    before = sha256(given)
    (tmp_path / "images").mkdir()
    Image.fromarray(np.full((720, 960), 128, dtype=np.uint8)).save(tmp_path / "images" / "000.png")
    Image.fromarray(np.full((72, 96), 128, dtype=np.uint8)).save(tmp_path / "images" / "001.png")
    job = flags(given, tmp_path / "static.db", images=tmp_path / "images", title="Street <1>")
    assert run_colmap(job) == 0
    assert sha256(given) == before
    said = capsys.readouterr().out
    assert "stand still; 15 pairs have enough of them" in said
    assert f"database: {tmp_path / 'static.db'}" in said and f"masks: {tmp_path / 'static-masks'}" in said
    assert "has no 002.png, 003.png, 004.png and 1 more" in said
    assert "001.png in --images" in said and "has another size" in said
    assert sorted(path.name for path in (tmp_path / "static-report").iterdir()) == sorted(FILES)
    assert len(list((tmp_path / "static-masks").iterdir())) == 6
    page = (tmp_path / "static-report" / "report.html").read_text(encoding="utf-8")
    assert "Street &lt;1&gt;" in page and "000.png and 001.png" in page
    kept = json.loads((tmp_path / "static-report" / "static.json").read_text(encoding="utf-8"))
    assert kept["status"] == "OK" and len(kept["images"]) == 6 and len(kept["pairs"]) == 15
    assert kept["manifest"]["inputs"] == {str(given): before}
    with open(tmp_path / "static-report" / "images.csv", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["image"] for row in rows] == [f"{k:03d}.png" for k in range(6)]
    assert all(int(row["static"]) > 50 and int(row["moving"]) > 50 for row in rows)


@pytest.mark.slow
def test_a_refusal_writes_a_report_and_no_database(given, found, tmp_path, monkeypatch, capsys):
    few = replace(found, refused=(0, 1, 2, 3), reason="fewer than 15 points stand still in 000.png, 4 of 6 images; add images")
    monkeypatch.setattr("indexing.cli.commands.segment.find_static", lambda *_, **__: few)
    assert run_colmap(flags(given, tmp_path / "static.db")) == 3
    assert "refused: fewer than 15 points stand still in 000.png" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["static-report"]
    assert "Refused" in (tmp_path / "static-report" / "report.html").read_text(encoding="utf-8")


def test_bad_input_is_one_line(given, tmp_path):
    out = tmp_path / "static.db"
    (tmp_path / "text.db").write_text("no database, but long enough for one")
    (tmp_path / "there.db").touch()
    empty = changed(given, tmp_path / "empty.db", "DELETE FROM matches", "DELETE FROM two_view_geometries")
    cases = [
        (flags(given, None), "where to"),
        (flags(given, given), "is the database that is read"),
        (flags(given, tmp_path / "there.db"), "is there already"),
        (flags(given, tmp_path / "text.db" / "static.db"), "is a file"),
        (flags(tmp_path / "none.db", out), "no such database"),
        (flags(tmp_path / "text.db", out), "is no SQLite database"),
        (flags(empty, out), "no matches; run a matcher first"),
        (flags(given, out, images=tmp_path / "none"), "no such folder"),
        (flags(given, out, images=given), "is a file"),
        (flags(given, out, masks=given), "is a file"),
        (flags(given, out, images=tmp_path, masks=tmp_path), "is the folder of the images"),
    ]
    before = set(tmp_path.iterdir())
    for job, said in cases:
        with pytest.raises(ValueError, match=said) as caught:
            run_colmap(job)
        assert "\n" not in str(caught.value)
    assert set(tmp_path.iterdir()) == before


@pytest.mark.slow
def test_the_command(given, quick, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    out = tmp_path / "static.db"
    assert main(["segment", "--colmap", str(given), "--out", "~/static.db", "--masks", "black"]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["black", "static-report", "static.db"]
    assert "stand still" in capsys.readouterr().out
    cases = [
        (["--out", str(out)], r"static\.db: is there already; choose another name for --out"),
        ([], "--colmap: where to"),
        (["m.npz", "--out", "b.db"], r"m\.npz: --colmap .* gives the matches"),
        (["--out", "b.db", "--images", "l.png", "r.png"], "give the folder of the images"),
        (["--out", "b.db", "--pair", "book"], "--pair does not go with --colmap"),
        (["--out", "b.db", "--bodies", "2"], "--bodies 2 does not go with --colmap"),
    ]
    for words, said in cases:
        assert main(["segment", *words, "--colmap", str(given)]) == 2
        told = capsys.readouterr().err
        assert re.search(said, told) and told.count("\n") == 1
    assert main(["segment", "--masks", "black"]) == 2
    assert "--masks black: it is for --colmap" in capsys.readouterr().err
