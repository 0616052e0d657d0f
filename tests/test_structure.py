"""The house keeps its rules, counted: ``python -m tests.test_structure`` prints figures, with bounds that only new things raise."""

import ast
import io
import re
import tokenize
from collections import Counter, defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("dyntorch", "indexing")
MAX_FIELDS = 12
"""Fields of the options of one verb."""
BOUNDS = {
    "files": 352,
    "lines": 94_908,
    "code lines": 58_779,
    "docstring lines": 14_477,
    "option fields": 111,
    "option fields that nobody sets": 0,
    "functions called by an everyday word": 2,
    "imports of our own inside functions": 29,
    "circles of imports": 0,
    "circles of imports, those for types too": 0,
    "lines of experiments": 19_372,
    "lines of tests": 54_604,
}
"""What each figure may be at most."""

WORDS_OF_EVERY_DAY = """
    told said settled known knowing standing kept taken seen left put found given held asked meant heard felt shown drawn made
    done gone come worn straight straightened better best besides beside others other own one few many most least apart alike near
    far whole rest lost strange stray foreign judged judge chosen choosing weighed weighing agreeing agree agreed resting moved
    moving broken breaking mixed blurred blunt rough calm clear sure unsure alone together followed following searched used tried
    cut cleared stretched named unnamed called wanted hopeful hopeless doubted doubtful bent thick sharp still shared common usual
    unusual plain gross wide narrow steady again remarks remark words book story films film courses course trial takes take unlike
    different same nothing something anything everything what which whose how written built
"""
EVERYDAY = frozenset(WORDS_OF_EVERY_DAY.split())
"""Words that say nothing as the name of a function; a participle in -ed says what came out, not what is done."""


def sources(*packages: str) -> list[Path]:
    return sorted(path for package in packages for path in (ROOT / package).rglob("*.py"))


@cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), str(path))


def is_text(node: ast.stmt) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def lines_of(path: Path) -> Counter[str]:
    """Lines of a file by what they are: docstrings (those of attributes too), comments, blank, imports, and the rest: code."""
    text = path.read_text(encoding="utf-8")
    lines, tree = text.splitlines(), parsed(path)
    texts: set[int] = set()
    imports: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            body = node.body if isinstance(node, ast.Module | ast.ClassDef) else node.body[:1]
            for part in filter(is_text, body):
                texts.update(range(part.lineno, (part.end_lineno or part.lineno) + 1))
        if isinstance(node, ast.Import | ast.ImportFrom):
            imports.update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    starts = [token.start[0] for token in tokens if token.type == tokenize.COMMENT]
    comments = {line for line in starts if lines[line - 1].strip().startswith("#")}
    blank = {number for number, line in enumerate(lines, 1) if not line.strip()} - texts
    code = len(lines) - len(texts) - len(comments) - len(blank) - len(imports)
    return Counter({"lines": len(lines), "docstring lines": len(texts), "code lines": code})


def options() -> Iterator[tuple[Path, ast.ClassDef, list[str]]]:
    """Every class of options with the names of its fields, stages left out."""
    for path in sources(*PACKAGES):
        for node in ast.walk(parsed(path)):
            if isinstance(node, ast.ClassDef) and node.name.endswith("Options"):
                parts = (part for part in node.body if isinstance(part, ast.AnnAssign))
                targets = [part.target for part in parts if not ast.unparse(part.annotation).endswith("Options")]
                yield path, node, [target.id for target in targets if isinstance(target, ast.Name)]


def settings() -> dict[str, set[Path]]:
    """Keyword or key of a dict -> the files in which it is written: in the library, the tests, the experiments and the gallery."""
    found: dict[str, set[Path]] = defaultdict(set)
    for path in sources(*PACKAGES, "tests", "experiments", "docs"):
        for node in ast.walk(parsed(path)):
            if isinstance(node, ast.Call):
                for keyword in node.keywords:
                    found[keyword.arg or ""].add(path)
            elif isinstance(node, ast.Dict):
                for key in node.keys:
                    if isinstance(key, ast.Constant) and isinstance(key.value, str):
                        found[key.value].add(path)
    return found


def unset_fields() -> list[str]:
    """Fields of options that no other file sets which names their class, and no page shows."""
    written = settings()
    texts = {path: path.read_text(encoding="utf-8") for path in set().union(*written.values())}
    pages = "\n".join(path.read_text(encoding="utf-8") for path in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))])
    unset = []
    for path, node, fields in options():
        for field in fields:
            hits = [other for other in written[field] if other != path and node.name in texts[other]]
            if not hits and f"{field}=" not in pages:
                unset.append(f"{path.relative_to(ROOT)}: {node.name}.{field}")
    return unset


def everyday_names() -> list[str]:
    """Functions and methods of one word that is an everyday word or a participle."""
    return [
        f"{path.relative_to(ROOT)}:{node.lineno}: {node.name}"
        for path in sources(*PACKAGES)
        for node in ast.walk(parsed(path))
        if isinstance(node, ast.FunctionDef)
        and re.fullmatch("[a-z]+", word := node.name.strip("_"))
        and (word in EVERYDAY or word.endswith("ed"))
    ]


def module_of(path: Path) -> str:
    name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
    return name.removesuffix(".__init__")


def imports() -> tuple[list[str], dict[str, set[str]], dict[str, set[str]]]:
    """Imports of our own inside functions; the arrows between modules as executed; those for types, too."""
    modules = {module_of(path): path for path in sources(*PACKAGES)}
    hidden: list[str] = []
    executed: dict[str, set[str]] = {name: set() for name in modules}
    drawn: dict[str, set[str]] = {name: set() for name in modules}
    for name, path in modules.items():
        tree = parsed(path)
        tests = [node for node in ast.walk(tree) if isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING"]
        typed = {id(part) for node in tests for part in ast.walk(node)}
        inside = {id(part) for node in ast.walk(tree) if isinstance(node, ast.FunctionDef) for part in ast.walk(node)}
        for node in ast.walk(tree):
            if not isinstance(node, ast.Import | ast.ImportFrom):
                continue
            if isinstance(node, ast.Import):
                targets = [alias.name for alias in node.names]
            else:
                whole = [f"{node.module}.{alias.name}" for alias in node.names]
                targets = [full if full in modules else str(node.module) for full in whole]
            for target in targets:
                if target.split(".")[0] in PACKAGES and id(node) in inside:
                    hidden.append(f"{path.relative_to(ROOT)}:{node.lineno}: {target}")
                if target in modules and target != name and modules[target].name != "__init__.py" and path.name != "__init__.py":
                    drawn[name].add(target)
                    if id(node) not in typed:
                        executed[name].add(target)
    return hidden, executed, drawn


def reached(graph: dict[str, set[str]], name: str) -> set[str]:
    seen: set[str] = set()
    waiting = list(graph[name])
    while waiting:
        other = waiting.pop()
        if other not in seen:
            seen.add(other)
            waiting += graph[other]
    return seen


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Groups of modules each of which reaches the others."""
    reach = {name: reached(graph, name) for name in graph}
    groups = {frozenset(other for other in reach[name] if name in reach[other]) for name in graph if name in reach[name]}
    return sorted(sorted(group) for group in groups)


def figures() -> dict[str, int]:
    """What the tests hold bounds for."""
    library = sources(*PACKAGES)
    total: Counter[str] = sum((lines_of(path) for path in library), Counter())
    hidden, executed, drawn = imports()
    return {
        "files": len(library),
        **{name: total[name] for name in ("lines", "code lines", "docstring lines")},
        "option fields": sum(len(fields) for *_, fields in options()),
        "option fields that nobody sets": len(unset_fields()),
        "functions called by an everyday word": len(everyday_names()),
        "imports of our own inside functions": len(hidden),
        "circles of imports": len(circles(executed)),
        "circles of imports, those for types too": len(circles(drawn)),
        "lines of experiments": sum(path.read_text(encoding="utf-8").count("\n") for path in sources("experiments")),
        "lines of tests": sum(path.read_text(encoding="utf-8").count("\n") for path in sources("tests")),
    }


@pytest.mark.slow
def test_the_house_does_not_grow():
    wrong = {name: f"{figure} of at most {BOUNDS[name]}" for name, figure in figures().items() if figure > BOUNDS[name]}
    assert wrong == {}, (
        "make it shorter, or for what is new raise BOUNDS by what it takes; python -m tests.test_structure lists what there is"
    )


@pytest.mark.slow
def test_options_of_a_verb_are_few_and_flat():
    many = {node.name: len(fields) for _, node, fields in options() if len(fields) > MAX_FIELDS}
    names = {node.name for _, node, _ in options()}
    nested = [
        f"{node.name}.{ast.unparse(part.target)}"
        for _, node, _ in options()
        for part in node.body
        if isinstance(part, ast.AnnAssign) and names & set(re.findall(r"\w+", ast.unparse(part.annotation)))
    ]
    # what every reader is called with holds what only videos need
    assert many == {} and nested == ["Options.watching"]


DAMPED = {"dyntorch/numerics/least_squares.py", "dyntorch/metrics.py"}
"""Files with a loop that damps its steps: the one Levenberg-Marquardt, and the one whose weights change with every step."""


def damps(loop):
    """Whether a loop sets its damping, or takes damped steps."""
    for node in ast.walk(loop):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and "damping" in node.id:
            return True
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "damped_step":
            return True
    return False


@pytest.mark.slow
def test_levenberg_and_marquardt_loop_once():
    found = set()
    for path in sources(*PACKAGES):
        loops = (node for node in ast.walk(parsed(path)) if isinstance(node, (ast.For, ast.While)))
        if any(map(damps, loops)):
            found.add(path.relative_to(ROOT).as_posix())
    assert found == DAMPED, "a problem of numerics.least_squares only accumulates: minimize() loops"


RESULTS = {
    "Solution", "Alignment", "Segmentation", "AffineSegmentation", "Reconstruction", "ProjectiveFactorization",
    "VelocityFactorization", "TranslatingPlanes", "PairReconstruction", "Trajectories", "TrajectoryCameras", "Shift", "Clocks",
    "MovingShapes", "Recovery", "DeformableShapes", "Calibration", "Breaks", "TrackSegmentation",
}  # fmt: skip
"""What the verbs of dyntorch return."""


def classes(*packages):
    """Every class of the packages by its name, as its source has it."""
    nodes = (node for path in sources(*packages) for node in ast.walk(parsed(path)))
    return {node.name: node for node in nodes if isinstance(node, ast.ClassDef)}


def bases(node):
    return {base.id for base in node.bases if isinstance(base, ast.Name)}


@pytest.mark.slow
def test_every_result_is_an_outcome():
    found = classes("dyntorch")

    def is_outcome(name):
        above = bases(found[name]) if name in found else set()
        return "Outcome" in above or any(map(is_outcome, above))

    # what others derive from is no result itself
    derived = {name for name in found if is_outcome(name)} - set().union(*map(bases, found.values()))
    assert derived == RESULTS
    own = {"status", "notices", "warnings", "notes", "reason", "ok", "degenerate"}
    fields = {name: {ast.unparse(item.target) for item in found[name].body if isinstance(item, ast.AnnAssign)} for name in RESULTS}
    assert {name: names & own for name, names in fields.items() if names & own} == {}


@pytest.mark.slow
def test_notices_have_codes_of_their_task_and_a_sentence():
    codes = {name: node for name, node in classes(*PACKAGES).items() if "NoticeCode" in bases(node)}
    assert len(codes) >= 8
    for name, node in codes.items():
        members = [item for item in node.body if isinstance(item, ast.Assign)]
        assert members and all(isinstance(item.value, ast.Tuple) and len(item.value.elts) in (2, 3) for item in members), name


WORDS = ("text", "reason", "message", "notes", "notices", "warnings")
"""Attributes that hold what the library says."""


@pytest.mark.slow
def test_nobody_parses_what_the_library_says():
    """No regular expression is applied to a sentence of the library: notices and messages carry their data."""
    wrong = []
    for path in sources(*PACKAGES):
        for node in ast.walk(parsed(path)):
            if isinstance(node, ast.Call) and regular(node) and any(map(said, [*node.args, *(k.value for k in node.keywords)])):
                wrong.append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert wrong == []


def regular(call):
    """Whether a call may be one of a regular expression."""
    name = call.func.attr if isinstance(call.func, ast.Attribute) else ""
    return name in ("sub", "subn", "match", "fullmatch", "search", "findall", "finditer")


def said(node):
    """Whether an expression is what the library says: ``x.reason``, ``notice.text``, ``str(problem)`` of an error."""
    for part in ast.walk(node):
        if isinstance(part, ast.Attribute) and part.attr in WORDS:
            return True
        if isinstance(part, ast.Call) and ast.unparse(part) in ("str(problem)", "str(error)"):
            return True
    return False


def main() -> None:
    hidden, _, drawn = imports()
    lists = {
        "option fields that nobody sets": unset_fields(),
        "functions called by an everyday word": everyday_names(),
        "imports of our own inside functions": hidden,
        "circles of imports, those for types too": [" <-> ".join(group) for group in circles(drawn)],
    }
    for title, entries in lists.items():
        print(f"{title}:", *entries, sep="\n  ", end="\n\n")
    for name, figure in figures().items():
        print(f"{figure:8,d}  {name} (at most {BOUNDS[name]:,d})")


if __name__ == "__main__":
    main()
