"""What the README shows is what happens: the same words, and the same numbers within what is printed of them."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

README = Path(__file__).parent.parent / "README.md"


def blocks() -> list[str]:
    return re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)


def difference(shown: str, printed: str) -> str:
    """Where two outputs differ; empty where they say the same.

    Spaces do not count.  Whole numbers are equal; decimal numbers and percentages may differ by one in the last digit printed,
    as the last digits of a computation differ between processors.
    """
    ours, theirs = (re.findall(r"[-+]?\d+(?:\.\d*)?(?: ?%)?|[^\s\d]+", text) for text in (shown, printed))
    if len(ours) != len(theirs):
        return f"{len(ours)} words shown, {len(theirs)} printed: {printed}"
    for a, b in zip(ours, theirs, strict=True):
        if a == b:
            continue
        try:
            x, y = float(a.rstrip(" %")), float(b.rstrip(" %"))
        except ValueError:
            return f"shown {a!r}, printed {b!r}"
        digits = max(len(number.rstrip(" %").partition(".")[2]) for number in (a, b))
        if not (digits or a.endswith("%")) or abs(x - y) > 1.001 * 10.0**-digits:
            return f"shown {a}, printed {b}"
    return ""


@pytest.mark.parametrize(
    ("shown", "printed", "same"),
    [
        ("rms: 0.476 px,  47 static", "rms: 0.477 px, 47 static", True),
        ("[4.4  1.28]", "[4.41 1.28]", True),
        ("64 % done", "65 % done", True),
        ("rms: 0.476 px", "rms: 0.478 px", False),
        ("47 static", "48 static", False),
        ("64 % done", "66 % done", False),
        ("ok 1", "refused 1", False),
        ("ok 1", "ok 1 2", False),
    ],
)
def test_outputs_are_compared_as_words_and_numbers(shown, printed, same):
    assert (difference(shown, printed) == "") == same


@pytest.mark.parametrize(
    "name", ["align_planar", "dyn.segment", "dyn.reconstruct", "dyn.DynamicShapeTensor", "PhaseIndexer", "= BrightnessIndexer("]
)
def test_the_examples_print_what_they_say(name, capsys):
    (source,) = [block for block in blocks() if name in block]
    exec(compile(source, str(README), "exec"), {})
    (_, following) = README.read_text(encoding="utf-8").split(source)
    shown = re.search(r"```\n(.*?)```", following.removeprefix("```"), re.DOTALL)[1]
    assert difference(shown, capsys.readouterr().out) == ""


def test_the_python_example_runs_and_prints_what_it_says(tmp_path, monkeypatch, capsys):
    (source,) = [block for block in blocks() if "ActionIndexer" in block]
    monkeypatch.chdir(tmp_path)
    exec(compile(source, str(README), "exec"), {})
    first, *events = capsys.readouterr().out.splitlines()
    assert first == re.search(r"print\(indexer\.predict\(queries\)\) +# (.*)", source)[1]
    shown = re.findall(r"^ (\w+) +([\d.]+) +([\d.]+) +[\d.]+ +[\d.]+$", README.read_text(encoding="utf-8"), re.MULTILINE)
    assert [line.split()[0] for line in events] == [label for label, _, _ in shown]
    for line, (_, start, end) in zip(events, shown, strict=True):
        assert [float(second) for second in line.split()[1:]] == pytest.approx([float(start), float(end)], abs=0.1)
    assert {path.name for path in tmp_path.iterdir()} == {"moves.safetensors", "lesson.npz", "session.npz"}


def test_the_synchronization_example_finds_what_it_says(tmp_path, monkeypatch, capsys):
    (make,) = [block for block in blocks() if "keypoints.json" in block]
    (use,) = [block for block in blocks() if "from indexing import synchronize" in block]
    monkeypatch.chdir(tmp_path)
    exec(compile(make, str(README), "exec"), {})
    exec(compile(use, str(README), "exec"), {})
    first = capsys.readouterr().out.splitlines()[0]
    shown = next(line for line in README.read_text(encoding="utf-8").splitlines() if line.startswith("Shift("))
    assert difference(shown, first) == ""
    assert float(re.search(r"= (\S+) frames", first)[1]) == pytest.approx(-17, abs=0.1)


def test_every_file_the_readme_points_to_is_there():
    for target in re.findall(r"\]\(([^)#]+)\)", README.read_text(encoding="utf-8")):
        assert (README.parent / target).exists(), target
