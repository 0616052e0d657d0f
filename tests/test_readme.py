"""What the README shows is what happens."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

README = Path(__file__).parent.parent / "README.md"


def blocks() -> list[str]:
    return re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)


@pytest.mark.parametrize(
    "name", ["align_planar", "dyn.segment", "dyn.reconstruct", "dyn.DynamicShapeTensor", "PhaseIndexer", "= BrightnessIndexer("]
)
def test_the_examples_print_what_they_say(name, capsys):
    (source,) = [block for block in blocks() if name in block]
    exec(compile(source, str(README), "exec"), {})
    printed = capsys.readouterr().out.strip()
    assert f"```\n{printed}\n```" in README.read_text(encoding="utf-8")


def test_the_python_example_runs_and_prints_what_it_says(tmp_path, monkeypatch, capsys):
    (source,) = [block for block in blocks() if "ActionIndexer" in block]
    monkeypatch.chdir(tmp_path)
    exec(compile(source, str(README), "exec"), {})
    first, *events = capsys.readouterr().out.splitlines()
    assert first == re.search(r"print\(indexer\.predict\(queries\)\) +# (.*)", source)[1]
    shown = re.findall(r"^ (\w+) +([\d.]+) +([\d.]+) +[\d.]+ +[\d.]+$", README.read_text(encoding="utf-8"), re.MULTILINE)
    assert [line.split()[0] for line in events] == [label for label, _, _ in shown]
    for line, (_, start, end) in zip(events, shown, strict=True):
        assert abs(float(line.split()[1]) - float(start)) <= 0.1 and abs(float(line.split()[2]) - float(end)) <= 0.1
    assert {path.name for path in tmp_path.iterdir()} == {"moves.safetensors", "lesson.npz", "session.npz"}


def test_the_synchronization_example_finds_what_it_says(tmp_path, monkeypatch, capsys):
    (make,) = [block for block in blocks() if "keypoints.json" in block]
    (use,) = [block for block in blocks() if "from indexing import synchronize" in block]
    monkeypatch.chdir(tmp_path)
    exec(compile(make, str(README), "exec"), {})
    exec(compile(use, str(README), "exec"), {})
    first = capsys.readouterr().out.splitlines()[0]
    assert first in README.read_text(encoding="utf-8").splitlines()
    assert float(re.search(r"= (\S+) frames", first)[1]) == pytest.approx(-17, abs=0.1)


def test_every_file_the_readme_points_to_is_there():
    for target in re.findall(r"\]\(([^)#]+)\)", README.read_text(encoding="utf-8")):
        assert (README.parent / target).exists(), target
