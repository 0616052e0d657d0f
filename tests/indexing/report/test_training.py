"""The report on what was learned, from the command that writes it."""

from __future__ import annotations

import json

import pytest

from indexing.actors import dataset
from indexing.cli import main


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    where = tmp_path_factory.mktemp("learned")
    clips = dataset(2, ["squat", "wave", "kick"], azimuth=0.0, rng=3)
    clips.save(where / "set.npz")
    assert main(["index", "fit", str(where / "set.npz"), "-o", str(where / "m.safetensors"), "--report", str(where / "out")]) == 0
    return where


@pytest.mark.slow
def test_the_report_says_what_was_learned(folder):
    assert sorted(path.name for path in (folder / "out").iterdir()) == [
        "body_parts.png",
        "manifest.json",
        "metrics.json",
        "report.html",
    ]
    html = (folder / "out" / "report.html").read_text()
    assert "3 actions learned" in html and "Which body parts matter" in html and "weights were not learned" in html
    measured = json.loads((folder / "out" / "metrics.json").read_text())
    assert measured["actions"] == ["kick", "squat", "wave"] and len(measured["importance"]) == 3
    assert len(measured["joints"]) == len(measured["importance"][0]) == 17
    assert (folder / "out" / "body_parts.png").read_bytes().startswith(b"\x89PNG")


def test_flags_of_the_other_kind_of_input_are_refused(folder, capsys):
    words = ["index", "fit", str(folder / "set.npz"), "-o", str(folder / "n.safetensors")]
    assert main([*words, "--region", "all"]) == 2
    assert "--region: of the pixels of videos only" in capsys.readouterr().err
    assert not (folder / "n.safetensors").exists()
