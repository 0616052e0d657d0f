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
    "indexing/archive/comparing.py": {"AROUND"},
    "indexing/brightness/library.py": {"GAP"},
    "indexing/phase/frames.py": {"LEAST"},
    "dyntorch/tasks/align/join.py": {"LABELLED", "MOVERS", "LINES", "ENOUGH"},
    "dyntorch/tasks/align/lines.py": {"PER_POINT"},
    "dyntorch/tasks/align/planar.py": {"LINES", "FEWEST", "NOTICES_MINIMAL", "LABELLED"},
    "dyntorch/tasks/align/result.py": {"OUTLIER", "STATIC", "MOVING"},
    "dyntorch/tasks/align/velocity.py": {"GAUGE", "ENTRIES"},
    "dyntorch/tasks/calibrate/bundle.py": {"RAYLEIGH"},
    "dyntorch/tasks/calibrate/bundle_problem.py": {"PARAMETERS"},
    "dyntorch/tasks/reconstruct/motions.py": {"STENCIL", "STEP", "RANK"},
    "dyntorch/tasks/reconstruct/robust.py": {"FAR"},
    "dyntorch/tasks/segment/affine.py": {"MATCHES"},
    "dyntorch/tasks/segment/labels.py": {"SAMPLE"},
    "dyntorch/tasks/segment/search.py": {"LEAST"},
    "dyntorch/tasks/segment/segment.py": {"MINIMAL"},
    "dyntorch/tasks/trajectories/trajectories.py": {"VIEWS"},
}
"""Constants that follow from equations (counts of matches, dimensions, quantiles) or from a file format, by file."""
ALGEBRA = {
    "dyntorch/counting/exact.py": {"INNER", "SMALL"},
    "dyntorch/counting/ranks.py": {"PRIMES"},
    "dyntorch/geometry/extensors.py": {"PAIRS", "TRIPLES"},
    "dyntorch/metrics/errors.py": {"OUTLIER"},
    "dyntorch/scenes/scene.py": {"OUTLIER", "STATIC", "MOVING"},
    "dyntorch/tasks/planes/input.py": {"PLANE_MATCHES", "BODY_MATCHES"},
    "dyntorch/tasks/segment/result.py": {"OUTLIER"},
    "indexing/calibrate/rig.py": {"Y_UP"},
    "indexing/report/calibration.py": {"FOCAL", "K1", "OFFSET", "RATE"},
}
"""Index sets, primes, minimal samples and the numbers of labels."""
FORMATS = {
    "indexing/action/saving.py": {"VERSION"},
    "indexing/archive/catalogue.py": {"VERSION"},
    "indexing/archive/layout.py": {"EIGHT"},
    "indexing/archive/segments.py": {"VERSION", "HEADER", "COLUMNS"},
    "indexing/archive/tracks.py": {"MISSING", "LARGEST"},
    "indexing/brightness/footage.py": {"LUMA"},
    "indexing/brightness/indexer.py": {"VERSION"},
    "indexing/calibrate/lenses.py": {"FOCAL_35"},
    "indexing/cli/commands/archive.py": {"PROBLEMS", "INTERRUPTED"},
    "indexing/cli/__init__.py": {"DONE", "BAD_INPUT", "REFUSED", "INTERRUPTED", "BROKEN_PIPE"},
    "indexing/cli/console.py": {"REFUSED"},
    "indexing/colmap/masks.py": {"BLACK", "WHITE"},
    "indexing/labels/formats/via.py": {"TEXT", "CHECKBOX", "SELECT", "VIDEO", "LOCAL"},
    "indexing/phase/saving.py": {"VERSION"},
    "indexing/pose/blazepose.py": {
        *("PICTURE", "REGION", "HEATMAP", "GRIDS", "POINTS", "LANDMARKS", "JOINTS", "HIPS", "CIRCLE", "CLIPPED"),
    },
    "indexing/pose/networks.py": {"OUTPUTS_FIELD", "OPERATORS_FIELD"},
    "indexing/pose/chunks.py": {"VERSION"},
    "indexing/readers/c3d.py": {"INTEL", "DEC", "MIPS", "MOST", "WORD"},
    "indexing/readers/formats/clipset.py": {"LAST"},
    "indexing/readers/hdf.py": {"ENTRY", "GZIP", "TEXT"},
    "indexing/readers/pickles.py": {"LONGEST_CODE", "WHOLE"},
    "indexing/readers/formats/sleap.py": {"SHIFTED", "HAND", "PREDICTED"},
    "indexing/readers/npz.py": {"HEADER", "AXES", "LAST_LETTER", "PACKED", "ENCRYPTED"},
    "indexing/readers/recording.py": {"LAST_FRAME"},
    "indexing/report/rig.py": {"MISSING"},
    "indexing/report/sync.py": {"PPM"},
    "indexing/writers/formats/c3d.py": {"KEY", "INTEL", "WORD", "LETTERS", "LABELS", "BLOCKS"},
}
"""What a file format, an operating system or a unit prescribes."""
SCENES = ("dyntorch/scenes/", "indexing/actors/", "indexing/cameras.py")
"""Places whose numbers say how large made-up scenes and people are: they are the truth, and decide nothing about it."""
WORDING = {
    "indexing/cli/commands/archive.py": {"MAX_EVENTS_PRINTED"},
    "indexing/cli/console.py": {"PLAIN_WIDTH", "SHOWN"},
    "indexing/cli/protocol.py": {"LISTED"},
    "indexing/cli/notes.py": {"LISTED"},
    "indexing/joints.py": {"LISTED"},
    "indexing/opening.py": {"VALUE", "SAID", "LISTED"},
    "indexing/readers/matches.py": {"SHOWN"},
    "indexing/remarks.py": {"NAMED"},
    "indexing/report/results.py": {"TIMES"},
    "indexing/sync/synchronize.py": {"LISTED"},
}
"""How much a message lists."""
DRAWING = {
    "indexing/report/alignment.py": {"PATHS", "ROOM", "REACH", "WIDTH", "MARGIN", "GAP", "TITLE", "FOOT", "WIDE"},
    "indexing/report/archive.py": {
        *(
            "PICTURED",
            "WEIGHT",
            "LEAST",
            "MOST",
            "DOUBTFUL",
            "ROWS",
            "FIRST",
            "FILM",
            "AROUND",
            "PLAYED",
            "PLAYED_SECONDS",
            "MARKS",
        ),
    },
    "indexing/cli/commands/segment_tracks.py": {"UNTIMED"},
    "indexing/report/bodies.py": {"ALIVE"},
    "indexing/report/bodies_picture.py": {
        *("PANELS", "WIDTH", "TALL", "EDGE", "GAP", "HEAD", "TICKS", "FOOT", "WIDE", "NARROW", "TAIL", "FRINGE", "DRAWN"),
    },
    "indexing/report/canvas.py": {"DPI", "FADE", "FRAMES", "AROUND", "WIDTH", "HEIGHT"},
    "indexing/report/training.py": {"COLUMNS", "PANEL", "PIECES", "THIN", "THICK", "DOT", "HEAD", "TRAIL", "NAMED"},
    "indexing/report/page.py": {"PIXEL_RATIO", "LISTED", "LINES"},
    "indexing/report/pictures.py": {"COLUMNS", "STEPS", "WIDTH", "ABOVE", "BESIDE"},
    "indexing/report/recognition.py": {"TIMELINES", "STRIPS", "TIPS", "ROWS", "LOST", "PERFORMANCES"},
    "indexing/report/reconstruction.py": {
        *("WIDTH", "FOOT", "TITLE", "TICKS", "SHOWN", "TANGLE", "LONG", "ROOM", "TALL", "STRAYS", "GAP", "LEFT"),
        *("TRACKS_TALL", "TRACKS_STRAYS"),
    },
    "indexing/report/rig.py": {"WIDTH", "TALL", "BESIDE", "EDGE", "FOOT", "CELL", "LEFT", "ROOF", "LONGEST"},
    "indexing/report/segmentation.py": {
        *("WIDTH", "TALL", "EDGE", "GAP", "HEAD", "TICKS", "FOOT", "WIDE", "STRAYS", "SLIM"),
    },
    "indexing/report/static.py": {"PANELS", "COLUMNS", "WIDE", "EDGE", "HEAD", "FOOT", "ROWS"},
    "indexing/report/sync.py": {
        *("WIDTH", "TOP", "ROW", "GAP", "FOOT", "LEFT", "MIDDLE", "CLOSE", "EDGE", "DRAWN", "NEAR", "LISTED"),
    },
    "indexing/video/check.py": {"STRIP", "PAPER", "INK", "BONE", "JOINT", "SMOOTHEST"},
    "indexing/video/overlay.py": {
        *("WIDEST", "LARGER", "TAIL", "SLOWEST", "FASTEST", "CALM", "LIGHTER"),
        *("STRAY", "STRIP", "PAPER", "INK", "MUTED", "SUBPIXEL"),
    },
}
"""Sizes, colours and lengths of pictures, tables and check videos."""
EXPLAINED = (MATHEMATICS, ALGEBRA, FORMATS, WORDING, DRAWING)
LOOSE = {"dyntorch": 129, "indexing": 67}
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


@pytest.mark.slow
@pytest.mark.parametrize("package", LOOSE)
def test_numbers_that_decide_are_options(package):
    found = list(loose(package))
    assert len(found) <= LOOSE[package], f"a new constant? make it a field of the verb's options: {found}"


DAMPED = {"dyntorch/numerics/least_squares.py", "dyntorch/metrics/errors.py"}
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
    for path in sorted(path for package in LOOSE for path in (ROOT / package).rglob("*.py")):
        loops = (node for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(node, (ast.For, ast.While)))
        if any(map(damps, loops)):
            found.add(path.relative_to(ROOT).as_posix())
    assert found == DAMPED, "a problem of numerics.least_squares only accumulates: minimize() loops"


@pytest.mark.slow
@pytest.mark.parametrize("kind", EXPLAINED)
def test_what_is_explained_is_there(kind):
    for file, names in kind.items():
        assert names <= set(constants(ROOT / file)), file


RESULTS = {
    "Solution", "Alignment", "Segmentation", "AffineSegmentation", "Reconstruction", "ProjectiveFactorization",
    "VelocityFactorization", "TranslatingPlanes", "PairReconstruction", "Trajectories", "TrajectoryCameras", "Shift", "Clocks",
    "MovingShapes", "Recovery", "DeformableShapes", "Calibration", "Breaks", "TrackSegmentation",
}  # fmt: skip
"""What the verbs of dyntorch return."""


def classes(package):
    """``(file, class)`` of every class of a package, as its source has it."""
    for path in sorted((ROOT / package).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"), str(path))):
            if isinstance(node, ast.ClassDef):
                yield path, node


def fields(node):
    return {item.target.id for item in node.body if isinstance(item, ast.AnnAssign) and isinstance(item.target, ast.Name)}


@pytest.mark.slow
def test_every_result_is_an_outcome():
    found = {node.name: node for _, node in classes("dyntorch")}
    assert set(found) >= RESULTS
    bases = {name: {base.id for base in node.bases if isinstance(base, ast.Name)} for name, node in found.items()}

    def is_outcome(name):
        return "Outcome" in bases.get(name, ()) or any(is_outcome(base) for base in bases.get(name, ()))

    # what others derive from is no result itself
    derived = {name for name in found if is_outcome(name)} - set().union(*bases.values())
    assert derived == RESULTS
    own = {"status", "notices", "warnings", "notes", "reason", "ok", "degenerate"}
    assert {name: fields(found[name]) & own for name in RESULTS if fields(found[name]) & own} == {}


def test_what_verbs_return_is_an_outcome():
    """By what the public verbs say that they return, so that a new one cannot bring a result of its own kind."""
    import dyntorch
    from dyntorch.core import Outcome

    names = {name: getattr(dyntorch, name) for name in dyntorch._HOME}
    results = {name for name, value in names.items() if isinstance(value, type) and "status" in dir(value)}
    returned = {
        str(getattr(value, "__annotations__", {}).get("return", "")) for value in names.values() if not isinstance(value, type)
    }
    assert {name for name in returned if name in RESULTS} >= {"Solution", "Alignment", "Segmentation", "Shift", "Clocks"}
    assert all(issubclass(names[name], Outcome) for name in results)


@pytest.mark.slow
def test_notices_have_codes_of_their_task_and_a_sentence():
    codes = {node.name: node for package in ("dyntorch", "indexing") for _, node in classes(package) if based(node, "NoticeCode")}
    assert len(codes) >= 8
    for name, node in codes.items():
        members = [item for item in node.body if isinstance(item, ast.Assign)]
        assert members and all(isinstance(item.value, ast.Tuple) and len(item.value.elts) in (2, 3) for item in members), name


def based(node, name):
    return any(isinstance(base, ast.Name) and base.id == name for base in node.bases)


WORDS = ("text", "reason", "message", "notes", "notices", "warnings")
"""Attributes that hold what the library says."""


@pytest.mark.slow
def test_nobody_parses_what_the_library_says():
    """No regular expression is applied to a sentence of the library: notices and messages carry their data."""
    wrong = []
    for package in ("dyntorch", "indexing"):
        for path in sorted((ROOT / package).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"), str(path))):
                if isinstance(node, ast.Call) and regular(node) and any(map(said, [*node.args, *(k.value for k in node.keywords)])):
                    wrong.append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert wrong == []
    for file in (
        "indexing/sync/synchronize.py",
        "indexing/cli/commands/align.py",
        "indexing/cli/commands/segment.py",
        "indexing/cli/commands/sync.py",
        "indexing/report/sync.py",
    ):
        assert "\nimport re\n" not in (ROOT / file).read_text(encoding="utf-8"), file


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


def main():
    for package in LOOSE:
        rooms = Counter(file.rsplit("/", 1)[0] for file, _ in loose(package))
        for room, count in sorted(rooms.items()):
            print(f"{count:5d}  {room}")
        print(f"{sum(rooms.values()):5d}  {package} (at most {LOOSE[package]})")


if __name__ == "__main__":
    main()
