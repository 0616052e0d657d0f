"""The house: rooms that say what is in them, files of one concept, no prefixes, a README of one sitting."""

from __future__ import annotations

import ast
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("dyntorch", "indexing", "experiments")
LONGEST = 600
LONGER = {"dyntorch/geometry/pairs.py": 670}
"""Files that are longer than a concept should be, and by how much they may be: these bounds only go down."""


def modules(package):
    return [path for path in sorted((ROOT / package).rglob("*.py")) if path.name != "__init__.py"]


@pytest.mark.parametrize("package", PACKAGES)
def test_a_file_holds_one_concept(package):
    lines = {str(path.relative_to(ROOT)): path.read_text(encoding="utf-8").count("\n") for path in modules(package)}
    assert {name: count for name, count in lines.items() if count > LONGER.get(name, LONGEST)} == {}
    assert [name for name in LONGER if lines.get(name, LONGEST + 1) <= LONGEST] == []  # exceptions are needed


@pytest.mark.parametrize("package", PACKAGES)
def test_a_prefix_that_three_files_share_is_a_room(package):
    for room in {path.parent for path in modules(package)}:
        first = Counter(path.stem.split("_")[0] for path in room.glob("*.py") if "_" in path.stem.strip("_"))
        assert {name: count for name, count in first.items() if count > 2} == {}, room


@pytest.mark.parametrize("package", PACKAGES)
def test_every_room_says_what_is_in_it(package):
    for room in {path.parent for path in modules(package)}:
        said = ast.get_docstring(ast.parse((room / "__init__.py").read_text(encoding="utf-8")))
        assert said and len(said) > 20, room


def functions():
    for package in PACKAGES:
        for path in modules(package):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.FunctionDef):
                    yield f"{path.relative_to(ROOT)}: {node.name}", node


@pytest.mark.slow
def test_functions_are_short():
    long = {}
    for name, node in functions():
        first = node.body[1] if ast.get_docstring(node) and len(node.body) > 1 else node.body[0]
        length = (node.end_lineno or 0) - first.lineno + 1
        if length > 70:
            long[name] = length
    assert long == {}


@pytest.mark.slow
def test_no_sentence_is_lost():
    """A text on a line of its own inside a function is half a message that nobody reads, but for what describes an attribute."""
    lost = []
    for name, function in functions():
        for node in ast.walk(function):
            body = getattr(node, "body", None)
            for before, text in zip([None, *body], body, strict=False) if isinstance(body, list) else ():
                is_text = isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant | ast.JoinedStr)
                says = is_text and getattr(text.value, "value", "") is not ...
                is_docstring = before is None and isinstance(node, ast.FunctionDef | ast.ClassDef)
                of_attribute = isinstance(before, ast.Assign) and isinstance(before.targets[0], ast.Attribute)
                if says and not is_docstring and not of_attribute:
                    lost.append(f"{name}: {text.lineno}")
    assert lost == []
