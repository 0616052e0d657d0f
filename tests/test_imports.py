"""Imports point one way, and importing a package costs nothing before something is used."""

import ast
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

from dyntorch.core.invariant import Invariant

ROOT = Path(__file__).resolve().parents[1]
HEAVY = ("torch", "sklearn", "scipy", "kornia", "matplotlib", "safetensors", "cv2", "av", "rich", "jinja2")


def files(package):
    found = sorted((ROOT / package).rglob("*.py"))
    assert found, package
    return found


def imported(path):
    """``(module, names)`` of every import of a file, wherever in it: names is None for ``import module``."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"), str(path))):
        if isinstance(node, ast.Import):
            yield from ((alias.name, None) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            here = path.relative_to(ROOT).with_suffix("").parts
            base = ".".join(here[: len(here) - node.level]) if node.level else ""
            yield ".".join(part for part in (base, node.module) if part), [alias.name for alias in node.names]


def offenders(package, wrong):
    return [
        f"{path.relative_to(ROOT)}: {module} {names or ''}"
        for path in files(package)
        for module, names in imported(path)
        if wrong(module, names)
    ]


def within(module, package):
    return module == package or module.startswith(package + ".")


@pytest.mark.slow
@pytest.mark.parametrize(("package", "above"), [("dyntorch", ("indexing",)), ("indexing", ())])
def test_packages_do_not_import_what_stands_on_them(package, above):
    assert offenders(package, lambda module, _: any(within(module, p) for p in ("experiments", "tests", *above))) == []


LAYERS = [{"native", "counting"}, {"numerics"}, {"geometry"}, {"core"}, {"shapes"}, {"invariants"}, {"tasks"}]
"""The rooms of dyntorch, from the ground up; each imports those below it."""
ASIDE = {"scenes", "metrics"}
"""Nothing of the library stands on these: they serve tests, experiments and the demo."""


def room_of(module):
    parts = module.split(".")
    return parts[1] if parts[0] == "dyntorch" and len(parts) > 1 else None


@pytest.mark.slow
def test_the_rooms_of_dyntorch_import_downwards():
    level = {room: number for number, rooms in enumerate(LAYERS) for room in rooms}
    wrong, seen = [], set()
    for path in files("dyntorch"):
        here = path.relative_to(ROOT / "dyntorch").with_suffix("").parts[0]
        if here in ASIDE | {"__init__"}:
            continue
        seen.add(here)
        for module, _ in imported(path):
            room = room_of(module)
            if room and (room in ASIDE or level[room] > level[here]):
                wrong.append(f"{path.relative_to(ROOT)}: {module}")
    assert wrong == []
    assert seen == set(level)


def test_counting_stands_alone():
    found = {module for path in files("dyntorch/counting") for module, _ in imported(path)}
    outside = {module for module in found if module.split(".")[0] not in sys.stdlib_module_names}
    assert {module.split(".")[0] for module in outside if not within(module, "dyntorch.counting")} == {"numpy"}


@pytest.mark.slow
def test_indexing_uses_only_public_names_of_dyntorch():
    """Those of the top level, and those that the faces of its rooms hand on."""

    def wrong(module, names):
        if not within(module, "dyntorch"):
            return False
        public = set(getattr(import_module(module), "__all__", ())) | {"__version__"}
        return not set(names or ()) <= public

    assert offenders("indexing", wrong) == []


@pytest.mark.parametrize("room", ["core", "geometry", "invariants", "numerics", "shapes", "tasks"])
def test_every_name_that_a_room_hands_on_exists_and_is_no_module_beside_it(room):
    """Importing the module would put it where the name is looked for."""
    face = import_module(f"dyntorch.{room}")
    assert face.__all__ and all(getattr(face, name) is not None for name in face.__all__)
    assert not {path.stem for path in Path(face.__path__[0]).iterdir()} & set(face.__all__)


@pytest.mark.slow
def test_only_the_demo_and_the_background_use_the_actors():
    inside = ("indexing/action/background", "indexing/actors/", "indexing/cli/", "indexing/examples")
    found = offenders("indexing", lambda module, names: within(module, "indexing.actors") or (names and "actors" in names))
    assert [line for line in found if not line.startswith(inside)] == []


@pytest.mark.parametrize("package", ["dyntorch", "indexing"])
def test_every_public_name_exists(package):
    module = __import__(package)
    for name in module.__all__:
        assert getattr(module, name) is not None
    assert set(module.__all__) <= set(dir(module))
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = module.nothing
    # what a verb decides with stands beside the verb, one class each; every invariant is public
    invariants = {
        name for name in module.__all__ if isinstance(part := getattr(module, name), type) and issubclass(part, Invariant)
    }
    assert len([name for name in getattr(module, "_HOME", ()) if not name.endswith("Options") and name not in invariants]) <= 40


@pytest.mark.parametrize("package", ["dyntorch", "indexing"])
def test_importing_a_package_loads_nothing_heavy(package):
    code = f"import sys, {package}; print(*sorted(set({HEAVY!r}) & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.split() == []


@pytest.mark.slow
@pytest.mark.parametrize("package", ["dyntorch", "indexing"])
def test_a_class_name_occurs_once_in_a_package(package):
    places = {}
    for path in files(package):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                places.setdefault(node.name, []).append(str(path.relative_to(ROOT)))
    assert {name: found for name, found in places.items() if len(found) > 1} == {}
