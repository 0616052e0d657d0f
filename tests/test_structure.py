"""The house keeps its rules: numbers that decide are options of their verb, not constants of a module.

    python -m tests.test_structure

prints how many loose ones each room has.
"""

import ast
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

KINDS = ("BLOCK", "CHUNK", "PIECE", "TINY", "EPSILON")
"""Ends of names of what decides nothing: sizes of blocks, and what keeps a division finite."""
MATHEMATICS = {
    "dyntorch/geometry/lens.py": {"COEFFICIENTS"},
    "dyntorch/shapes/moving.py": {"GAUGE"},
    "dyntorch/shapes/theory.py": {"SIX_DEGREE"},
    "indexing/action/bank.py": {"COMMON"},
    "indexing/brightness/footage.py": {"LUMA"},
    "indexing/brightness/library.py": {"GAP"},
    "indexing/phase/frames.py": {"LEAST"},
    "dyntorch/tasks/align/join.py": {"LABELLED", "MOVERS", "LINES", "ENOUGH"},
    "dyntorch/tasks/align/lines.py": {"PER_POINT"},
    "dyntorch/tasks/align/planar.py": {"LINES", "FEWEST", "NOTICES_MINIMAL", "LABELLED"},
    "dyntorch/tasks/align/result.py": {"OUTLIER", "STATIC", "MOVING"},
    "dyntorch/tasks/align/velocity.py": {"GAUGE", "ENTRIES"},
    "dyntorch/tasks/reconstruct/motions.py": {"STENCIL", "STEP", "RANK"},
    "dyntorch/tasks/reconstruct/robust.py": {"FAR"},
    "dyntorch/tasks/segment/affine.py": {"MATCHES"},
    "dyntorch/tasks/segment/labels.py": {"SAMPLE"},
    "dyntorch/tasks/segment/search.py": {"LEAST"},
    "dyntorch/tasks/segment/segment.py": {"MINIMAL"},
    "dyntorch/tasks/trajectories/trajectories.py": {"VIEWS"},
}
"""Constants that follow from equations (counts of matches, dimensions, quantiles) or from a file format, by file."""
LOOSE = {"dyntorch": 147, "indexing": 134}
"""Upper bounds of the loose constants of a package: they only go down."""


def number(node):
    """Whether an expression is a number or a tuple of numbers, as it stands."""
    if isinstance(node, ast.Constant):
        return isinstance(node.value, (int, float)) and not isinstance(node.value, bool)
    if isinstance(node, ast.UnaryOp):
        return number(node.operand)
    if isinstance(node, ast.BinOp):
        return number(node.left) and number(node.right)
    if isinstance(node, (ast.Tuple, ast.List)):
        return bool(node.elts) and all(map(number, node.elts))
    return False


def constants(path):
    """The names in capitals that a module binds to numbers."""
    for node in ast.parse(path.read_text(encoding="utf-8"), str(path)).body:
        if isinstance(node, ast.AnnAssign) and node.value is not None:
            bound = [(node.target, node.value)]
        elif isinstance(node, ast.Assign):
            bound = [(target, node.value) for target in node.targets]
        else:
            continue
        for target, value in bound:
            several = isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple)
            for name, one in zip(target.elts, value.elts, strict=True) if several else [(target, value)]:
                if isinstance(name, ast.Name) and name.id.isupper() and number(one):
                    yield name.id


def loose(package):
    """``(file, name)`` of every constant of a package that may decide something."""
    for path in sorted((ROOT / package).rglob("*.py")):
        file = path.relative_to(ROOT).as_posix()
        for name in constants(path):
            explained = name.endswith(KINDS) or file.startswith(SCENES) or any(name in kind.get(file, ()) for kind in EXPLAINED)
            if not explained:
                yield file, name


@pytest.mark.parametrize("package", LOOSE)
def test_numbers_that_decide_are_options(package):
    found = list(loose(package))
    assert len(found) <= LOOSE[package], f"a new constant? make it a field of the verb's options: {found}"


@pytest.mark.parametrize("kind", EXPLAINED)
def test_what_is_explained_is_there(kind):
    for file, names in kind.items():
        assert names <= set(constants(ROOT / file)), file


def main():
    for package in LOOSE:
        rooms = Counter(file.rsplit("/", 1)[0] for file, _ in loose(package))
        for room, count in sorted(rooms.items()):
            print(f"{count:5d}  {room}")
        print(f"{sum(rooms.values()):5d}  {package} (at most {LOOSE[package]})")


if __name__ == "__main__":
    main()
