"""What every estimator, reader and command answers on fixed people, films and files: name -> function that returns a result."""

from __future__ import annotations

import contextlib
import csv
import hashlib
import html
import io
import json
import os
import re
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import safe_open

from indexing import ActionIndexer, BrightnessIndexer, Clip, ClipSet, PhaseIndexer, synchronize
from indexing.actors import Person, dataset, detect, perform, stream
from indexing.cli import main
from indexing.cli.flags import commands
from tests.freeze.geometry import Table, tried
from tests.fuzz import seeds

FEW = ("kick", "squat", "wave")


# ---- people and films ------------------------------------------------------------------------------------------------------
@cache
def lesson() -> tuple[ClipSet, ClipSet, Clip]:
    """Three actions by two people, by a third from elsewhere, and a recording of two of them."""
    taught = dataset([Person.random(seed) for seed in (20, 21)], FEW, azimuth=0.0, rng=1, fps=15.0)
    asked = dataset([Person.random(24)], FEW, azimuth=40.0, rng=2, fps=15.0)
    return taught, asked, detect(stream(FEW[:2], Person.random(24), rng=3, fps=15.0)[0], azimuth=30.0, rng=4)


def blob(kind: str, number: int, frames: int = 24) -> np.ndarray:
    """A bright spot that moves along, across, or to and fro."""
    rng, t = np.random.default_rng(number), np.linspace(0.0, 1.0, frames)
    travel = {"kick": 30 * t - 15, "squat": 0 * t, "wave": 12 * np.sin(4 * np.pi * t)}[kind], 24 * (kind == "squat") * (t - 0.5)
    rows, columns = np.mgrid[:48, :64]
    spots = [np.exp(-((columns - 32 - x) ** 2 + (rows - 24 - y) ** 2) / 20.0) for x, y in zip(*travel, strict=True)]
    return np.clip(40 + 180 * np.array(spots) + rng.normal(scale=2.0, size=(frames, 48, 64)), 0, 255).astype(np.uint8)


# ---- estimators ------------------------------------------------------------------------------------------------------------
def asked_of(indexer: Any, items: Any, recording: Any, path: Path) -> dict[str, Any]:
    """All answers of a fitted estimator, the file that it saves, and what the one loaded from it says."""
    indexer.save(path)
    again = type(indexer).load(path)
    return {
        "predict": indexer.predict(items), "decision_function": indexer.decision_function(items), "saved": read_file(path),
        "predict_proba": indexer.predict_proba(items), "evidence": indexer.evidence(items), "classes": indexer.classes_,
        "score_frames": indexer.score_frames(recording), "find": indexer.find(recording), "repr": repr(indexer),
        "loaded": again.decision_function(items), "parameters": indexer.get_params(),
    }  # fmt: skip


def actions(folder: Path, more: bool = False, **options: Any) -> Any:
    taught, asked, recording = lesson()
    indexer = ActionIndexer(fps=15.0, **options).fit(list(taught), taught.labels, groups=taught.column("subject"))
    if more:
        indexer.partial_fit(list(asked), asked.labels)
    return asked_of(indexer, list(asked), recording, folder / "model.safetensors")


def phases(folder: Path, **options: Any) -> Any:
    taught, asked, recording = lesson()
    indexer = PhaseIndexer(fps=15.0, harmonics=3, **options).fit(list(taught), taught.labels)
    return {**asked_of(indexer, list(asked), recording, folder / "model.safetensors"), "phase": indexer.phase(recording)}


def pixels(folder: Path, **options: Any) -> Any:
    films = [blob(kind, 10 * subject + i) for subject in range(2) for i, kind in enumerate(FEW)]
    asked = [blob(kind, 90 + i) for i, kind in enumerate(FEW)]
    indexer = BrightnessIndexer(**options).fit(films, np.array(FEW * 2))
    return asked_of(indexer, asked, np.concatenate(asked), folder / "model.safetensors")


# ---- clocks of two cameras, clip sets, actors --------------------------------------------------------------------------------
def clocks(method: str) -> Any:
    solid = stream(["wave", "squat"], Person(), rng=1, fps=30.0)[0]
    left, right = (detect(solid, azimuth=azimuth, rng=number) for number, azimuth in enumerate((0.0, 60.0)))
    late = right.between(float(right.times[12]), float(right.times[-1]))
    if method == "keypoints":
        return synchronize(left, late)
    if method == "arrays":
        return synchronize(left.joints, right.joints[9:], fps=30.0, max_shift=1.5)
    if method == "different":
        parts = [clip.replace(joints=clip.joints[:, joints], confidence=None, skeleton=None) for clip, joints in
                 ((left, slice(0, 9)), (late, slice(9, 17)))]  # fmt: skip
        return synchronize(*parts)
    films = [np.concatenate([blob(kind, 7 + view, 40) for kind in ("wave", "kick", "squat")]) for view in range(2)]
    return synchronize(films[0][14:], films[1][:-8], "brightness" if method == "brightness" else "auto", fps=30.0)


def clip_sets(folder: Path) -> Any:
    taught, _, recording = lesson()
    taught.save(folder / "set.npz")
    again = ClipSet.load(folder / "set.npz")
    return {"made": list(taught), "read": list(again), "subjects": again.column("subject"), "one": again.select(label="kick"),
            "solid": perform("kick", Person.random(3), rng=5), "recording": recording}  # fmt: skip


def answered(found: list[seeds.Seed]) -> Any:
    """What each reader makes of its file, as the fuzzing reads it; keypoints by the public names, too."""
    said: dict[str, Any] = {}
    for seed in found:
        said[seed.name] = tried(partial(seed.read, seed.path))
        if seed.read is seeds.keypoints:
            said[f"{seed.name} everyone"] = tried(lambda path=seed.path: list(ClipSet.load(path, person="everyone", fps=25.0)))
            said[f"{seed.name} one"] = tried(lambda path=seed.path: Clip.load(path, label="x", min_confidence=0.6))
    return said


# ---- commands --------------------------------------------------------------------------------------------------------------
def read_file(path: Path) -> Any:
    """A file that a command or estimator wrote, in parts that can be compared."""
    if path.suffix == ".json":
        return json.loads(path.read_text(encoding="utf-8"))
    if path.suffix == ".csv":
        with path.open(newline="", encoding="utf-8") as file:
            head, *rows = list(csv.reader(file))
        return {name: numbers(column) for name, column in zip(head, zip(*rows, strict=True), strict=False)}
    if path.suffix == ".npz":
        with np.load(path) as arrays:
            return {name: arrays[name] for name in arrays.files}
    if path.suffix == ".safetensors":
        with safe_open(path, "numpy") as file:
            about = {key: decoded(text) for key, text in (file.metadata() or {}).items()}
            return {"tensors": {key: file.get_tensor(key) for key in sorted(file.keys())}, "about": about}
    data = path.read_bytes()
    return data.decode() if path.suffix == ".txt" else hashlib.sha256(data).hexdigest()


def decoded(text: str) -> Any:
    """What JSON says, and any other text as it is."""
    try:
        return json.loads(text)
    except ValueError:
        return text


def numbers(column: tuple[str, ...]) -> Any:
    """A column of a table."""
    try:
        return np.array([float(cell or "nan") for cell in column])
    except ValueError:
        return "\n".join(column)


def visible(page: str) -> str:
    """The text of a page that a reader sees."""
    page = re.sub(r"<(style|script|svg)\b.*?</\1>", " ", page, flags=re.S)
    return " ".join(html.unescape(re.sub(r"<[^>]+>", " ", page)).split())


def _kept(folder: Path, before: set[Path]) -> Iterator[tuple[str, Any]]:
    frames = hashlib.sha256()
    new = sorted(path for path in folder.rglob("*") if path.is_file() and path not in before)
    for path in new:
        name = str(path.relative_to(folder))
        if path.name.endswith("_keypoints.json"):  # hundreds, one a frame
            frames.update(name.encode() + path.read_bytes())
        elif path.suffix not in (".html", ".png"):
            yield name, read_file(path)
    yield "names", [str(path.relative_to(folder)) for path in new if not path.name.endswith("_keypoints.json")]
    yield "frames", frames.hexdigest()


def command(folder: Path, pages: dict[str, Any], *words: str) -> dict[str, Any]:
    """Run a command in this process, in a folder: exit code, what it said, what it wrote; pages are put aside."""
    out, err, before = io.StringIO(), io.StringIO(), set(folder.rglob("*"))
    here = Path.cwd()
    os.chdir(folder)
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = main(list(words))
    finally:
        os.chdir(here)
    for path in sorted(set(folder.rglob("*.html")) - before):
        pages[f"{' '.join(words)}: {path.name}"] = visible(path.read_text(encoding="utf-8"))
    said = out.getvalue().splitlines()
    return {
        "code": code,
        "stdout": "\n".join(line.rstrip() for line in said),
        "stderr": err.getvalue(),
        "files": dict(_kept(folder, before)),
    }


COMMANDS = """\
align a.csv b.csv c.csv --out align
align a.csv b.csv c.csv --model planar --threshold 1.5
segment matches.npz --out segment
segment matches.npz --bodies 3 --threshold 2
reconstruct tracks.csv --motion constant_velocity_3d --static parked.csv --fps 25 --out reconstruct
sync cam1 cam2 cam3 --fps 30 --out sync
sync cam1 another-take --fps 30
index fit squat=squat.json lunge=lunge.json kick=kick.json@0.2-1.4 -o three.safetensors
index fit lesson.npz -o moves.safetensors
index scan session.npz -m moves.safetensors --truth truth.csv --report scan
index scan session.npz -m moves.safetensors --reject 0.1
index fit people.npz --weights learned -o learned.safetensors --report learned
index fit squat=squat.mp4 jumping_jack=jumping_jack.mp4 kick=kick.mp4@0-2 -o seen.safetensors
index scan filmed.mp4 -m seen.safetensors --report filmed
index evaluate people.npz --train azimuth=0 --test azimuth=90 --report evaluate
index evaluate solid.npz --camera virtual --azimuth 0,90 --leave-out subject
index evaluate people.npz --leave-out subject
index evaluate films.npz --leave-out subject
demo --people 2 --out demo
index scan week/monday.npz week/wednesday.npz week/friday.npz -m moves.safetensors --truth week.csv --report week-report
index suggest session.npz --write parts.csv
index scan session.npz -m moves.safetensors --write found.csv
segment street.csv --bodies 3 --size 1242 375 --out street
calibrate cam1 cam2 cam3 --size 1920x1080 --fps 30 --out calib
convert squat.json lunge.json -o two.npz
convert squat.json -o squat.trc --units px
archive add lab lesson.npz session.npz week --workers 1
archive info lab
archive search lab squat.json -k 5 --report found
archive find lab -m moves.safetensors --report acted
archive verify lab
archive remove lab session.npz
archive search lab missing.json
count
count homography --moving 30 --static 2
count constant_velocity_3d --static 100 --camera fixed
count --k 3 --views 2 2 2 2 --r 2
count --k 6 --profile 2 2 2 1 --json
count --dim-v 3 3 2
align a.csv b.csv
align missing.csv b.csv c.csv
align a.csv b.csv c.csv --model rigid
align a.csv b.csv c.csv --threshold -1
segment tracks.csv
segment matches.npz --bodies none
reconstruct tracks.csv --motion bent
reconstruct tracks.csv --motion constant_velocity_3d --frames 0,1
sync cam1
sync cam1 squat.json --max-shift 0
index fit squat=squat.json
index fit squat.json -o x.safetensors
index scan session.npz -m truth.csv
index scan session.npz
index evaluate people.npz --test azimuth=45
count nothing
count homography --k 3
fly
index
calibrate cam1 cam2 --size 12
convert squat.json -o squat.nothing
index suggest nowhere.npz
""".splitlines()


def of_seed(folder: Path, pages: dict[str, Any], seed: seeds.Seed) -> Any:
    """The command that reads a seed."""
    assert seed.words is not None
    return command(folder, pages, *(word.replace("{}", str(seed.path)) for word in seed.words))


def table(folder: Path) -> Table:
    """All cases; the commands run in the order given, on what those before have written."""
    pages: dict[str, Any] = {}
    examples, work = folder / "examples", folder / "work"
    work.mkdir()
    found: Table = {
        "action": partial(actions, work), "action same": partial(actions, work, view="same", scorer="nearest"),
        "action learned": partial(actions, work, weights="learned", reject=0.1),
        "action more": partial(actions, work, more=True, search=False),
        "action mirror": partial(actions, work, mirror=True, repair=False, virtual_views=2, random_state=3),
        "phase": partial(phases, work), "phase once": partial(phases, work, course="once", window=0.2, reject=0.1),
        "brightness": partial(pixels, work),
        "brightness all": partial(pixels, work, flip=False, region=None, reject=0.2),
    }  # fmt: skip
    found |= {
        f"indexing.synchronize {method}": partial(clocks, method)
        for method in ("keypoints", "arrays", "different", "brightness", "films")
    }
    found |= {"clip sets": partial(clip_sets, work), "estimator refusals": refusals}
    made: Callable[[], list[seeds.Seed]] = cache(lambda: seeds.make(folder / "seeds"))
    found["readers"] = lambda: answered(made())
    shown = cache(lambda: command(folder, pages, "demo", "--examples", str(examples)))
    found["command demo"] = shown
    helps = [f"{one.words} --help" for one in commands()]
    found |= {
        f"command {words}": lambda words=words: shown() and command(examples, pages, *words.split())
        for words in [*COMMANDS, *helps]
    }
    found["seed commands"] = lambda: {seed.name: tried(partial(of_seed, work, pages, seed)) for seed in made() if seed.words}
    found["pages"] = lambda: dict(pages)
    return found


def refusals() -> Any:
    """What estimators say to bad input."""
    taught, asked, _ = lesson()
    clips = list(taught)
    other = Clip(np.random.default_rng(0).normal(size=(20, 5, 2)))
    calls: dict[str, Callable[[], Any]] = {
        "view": lambda: ActionIndexer(view="front").fit(clips), "unfitted": lambda: ActionIndexer().predict(clips),
        "labels": lambda: ActionIndexer().fit(clips, ["a"]),
        "other joints": lambda: ActionIndexer(search=False).fit(clips).predict([other]),
        "course": lambda: PhaseIndexer(course="often").fit(clips),
        "film": lambda: BrightnessIndexer().fit([np.zeros((3, 4))], ["a"]),
        "shape": lambda: Clip(np.zeros((4, 3))), "times": lambda: Clip(np.zeros((4, 3, 2)), times=np.zeros(4)),
        "none": lambda: ActionIndexer().fit([]),
        "method": lambda: synchronize(clips[0], asked[0], "guess"),
        "short": lambda: synchronize(other.joints[:3], other.joints[:3], fps=30.0),
        "path": lambda: Clip.load("nowhere.json"), "format": lambda: Clip.load("nowhere.json", format="bvh"),
    }  # fmt: skip
    return {name: tried(call) for name, call in calls.items()}
