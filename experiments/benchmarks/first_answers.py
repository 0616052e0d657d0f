"""How long the first answer takes: every verb in a process of its own, first call and warm, and four commands from the shell.

    python -m experiments.benchmarks.first_answers

Seconds of processor time on one thread, which a busy machine changes little; importing torch and making the data are not counted.
Of the commands the whole process counts, Python's start included.
"""

from __future__ import annotations

import json
import math
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray

import dyntorch as dyn
from experiments.common.runner import BaseConfig, Tables, experiment
from experiments.common.tables import Row, note

Verb = Callable[[], object]


def draw(seed: int = 0) -> torch.Generator:
    """A generator of random numbers."""
    return torch.Generator().manual_seed(seed)


def planar() -> Verb:
    """The road of the README."""
    from dyntorch import scenes

    views = scenes.planar(n=120, sigma=0.5, static=0.4, outliers=0.15, generator=draw(4)).views
    return lambda: dyn.align_planar(*views, threshold=1.5, generator=draw(4))


def points(model: str, **scene: Any) -> Callable[[], Verb]:
    """Points of space before three sensors."""

    def make() -> Verb:
        from dyntorch import scenes

        kind, n = scene.get("kind", "moving_points"), scene.get("n", 60)
        given = {key: value for key, value in scene.items() if key not in ("kind", "n", "threshold")}
        views = getattr(scenes, kind)(n, sigma=0.01, generator=draw(), **given).views
        return lambda: dyn.align_points(*views, model=model, threshold=0.03, generator=draw())

    return make


def lines() -> Verb:
    """Lines of space that translate, two poses of a sensor."""
    from dyntorch import scenes

    views = scenes.translating_lines(60, sigma=0.002, generator=draw()).views
    return lambda: dyn.align_lines(*views, threshold=0.006, generator=draw())


def segment() -> Verb:
    """The traffic of the README: 240 matches, three bodies."""
    from dyntorch import scenes

    views = scenes.bodies((110, 80, 50), bodies=3, sigma=0.4, outliers=0.2, generator=draw(4)).views
    return lambda: dyn.segment(*views, generator=draw(4))


def planes(matches: bool) -> Callable[[], Verb]:
    """Patches that translate by themselves."""

    def make() -> Verb:
        from dyntorch import scenes

        scene = scenes.translating_planes(8, sigma=0.5, generator=draw(4))
        if matches:
            return lambda: dyn.translating_planes(x1=scene.x1, x2=scene.x2)
        return lambda: dyn.translating_planes(scene.homographies)

    return make


def synchronize(correspondence: bool) -> Callable[[], Verb]:
    """Twelve points that wobble, five seconds before two cameras."""

    def make() -> Verb:
        g, t = draw(), torch.arange(150, dtype=torch.float64)[:, None, None] / 30
        speeds, phases, sizes, base = (
            scale * torch.randn(12, 3, generator=g, dtype=torch.float64) for scale in (4.0, 6.0, 1.0, 3.0)
        )

        def film(t: torch.Tensor, turn: float) -> torch.Tensor:
            p = base / 3 + 0.2 * sizes * torch.sin(speeds.abs() * t + phases)
            c, d = math.cos(turn), math.sin(turn)
            x, z = c * p[..., 0] + d * p[..., 2], c * p[..., 2] - d * p[..., 0]
            return 800 * torch.stack([x, p[..., 1]], -1) / (z + 5)[..., None]

        a, b = film(t, 0.0), film(t - 0.42, 1.0)
        return lambda: dyn.synchronize(a, b, correspondence=correspondence, fps=30.0)

    return make


def reconstruct() -> Verb:
    """The lifted scene of the README: 120 points of space, six views."""
    from dyntorch import scenes

    g = draw(5)
    scene = scenes.lifted_points("constant_velocity_3d", 120, views=6, static=0.4, sigma=0.5, outliers=0.05, generator=g)
    known = (scene.labels == 1) & (torch.rand(120, generator=g) < 0.5)
    return lambda: dyn.reconstruct(scene.tracks, "constant_velocity_3d", scene.times, static=known, threshold=1.5)


def reconstruct_pair() -> Verb:
    """A body that bends, before two cameras."""
    from dyntorch.scenes.two_cameras import nonrigid_pair

    scene = nonrigid_pair(12, 10, 90, sigma=0.3, offset=0.41, generator=draw())
    return lambda: dyn.reconstruct_pair(scene.a, scene.b, scene.offset, fps=scene.fps)


def estimate(verb: str) -> Callable[[], Verb]:
    """The homography tensor of one scene: ``fit``, ``robust_fit`` (30 % outliers) or ``refine``."""

    def make() -> Verb:
        from dyntorch import scenes

        outliers = 0.3 if verb == "robust_fit" else 0.0
        views = scenes.planar(n=100, sigma=0.5, outliers=outliers, generator=draw(4)).views
        if verb == "fit":
            return lambda: dyn.fit(dyn.HomographyTensor, *views)
        if verb == "robust_fit":
            return lambda: dyn.robust_fit(dyn.HomographyTensor, *views, threshold=1.5, generator=draw())
        return lambda: dyn.refine(dyn.fit(dyn.HomographyTensor, *views), *views)

    return make


def many() -> Verb:
    """A batch of the README: fits and refinements of 1000 scenes."""
    from dyntorch import scenes

    views = scenes.planar(n=100, batch=1000, sigma=0.5, generator=draw(4)).views
    return lambda: dyn.refine(dyn.fit(dyn.HomographyTensor, *views), *views)


def trajectories() -> Verb:
    """Two hundred points on straight lines before cameras that are known."""
    g = draw()
    cameras = torch.randn(6, 3, 4, generator=g).double()
    start, way = torch.randn(2, 200, 4, generator=g).double()
    x = (start + torch.randn(6, 200, 1, generator=g).double() * way) @ cameras.mT
    return lambda: dyn.triangulate_trajectories(cameras, x[..., :2] / x[..., 2:])


def action(verb: str) -> Callable[[], Verb]:
    """The README's lesson: four actions by one person, recognized in another from the side."""

    def make() -> Verb:
        from indexing import ActionIndexer, actors

        actions = ["squat", "lunge", "jumping_jack", "kick"]
        teacher, other = actors.Person.random(1), actors.Person.random(2)
        lesson = actors.dataset([teacher], actions, azimuth=0, rng=0)
        if verb == "fit":
            return lambda: ActionIndexer().fit(lesson, lesson.labels)
        indexer = ActionIndexer().fit(lesson, lesson.labels)
        asked = actors.dataset([other], actions, azimuth=90, rng=1)
        if verb == "predict":
            return lambda: indexer.predict(asked)
        session = actors.detect(actors.stream([*actions, "squat"], other, rng=3)[0], azimuth=70, rng=3)
        return lambda: getattr(indexer, verb)(session)

    return make


def phase(verb: str) -> Callable[[], Verb]:
    """The README's three actions by three people, frame by frame."""

    def make() -> Verb:
        from indexing import PhaseIndexer
        from indexing.actors import Person, detect, perform

        people, names = [Person.random(seed) for seed in range(3)], ["walk", "sit_down", "kick"]
        train = [detect(perform(name, p, rng=i), azimuth=40.0 * i, rng=i) for i, p in enumerate(people) for name in names]
        if verb == "fit":
            return lambda: PhaseIndexer().fit(train)
        indexer, asked = PhaseIndexer().fit(train), detect(perform("sit_down", Person.random(9), rng=9), azimuth=60.0, rng=9)
        return lambda: indexer.score_frames(asked)

    return make


def brightness(verb: str) -> Callable[[], Verb]:
    """Three actions on film."""

    def make() -> Verb:
        from indexing import BrightnessIndexer
        from indexing.actors import Person, dataset
        from indexing.actors.textured import render_clip

        moves = ["squat", "jumping_jack", "kick"]
        solid = [dataset([Person.random(person)], moves, azimuth=None, rng=person) for person in (1, 2)]
        shown, asked = (
            [render_clip(clip, azimuth=0, rng=i + 10 * k) for i, clip in enumerate(clips)] for k, clips in enumerate(solid)
        )
        if verb == "fit":
            return lambda: BrightnessIndexer(fps=30.0).fit(shown, moves)
        seen = BrightnessIndexer(fps=30.0).fit(shown, moves)
        return lambda: seen.predict(asked)

    return make


VERBS: dict[str, Callable[[], Verb]] = {
    "align_planar": planar,
    'align_points "rigid"': points("rigid", n=20, sensors="rigid"),
    'align_points "join"': points("join", n=80, static=0.3),
    'align_points "minimal_join"': points("minimal_join", n=80, static=0.3),
    'align_points "constant_velocity"': points("constant_velocity", kind="constant_velocity", static=0.3),
    'align_points "affine_constant_velocity"': points(
        "affine_constant_velocity", kind="constant_velocity", sensors="affine", static=0.3
    ),
    "fit": estimate("fit"),
    "robust_fit": estimate("robust_fit"),
    "refine": estimate("refine"),
    "fit and refine, 1000 problems": many,
    "align_lines": lines,
    "segment": segment,
    "translating_planes(H)": planes(matches=False),
    "translating_planes(x1, x2)": planes(matches=True),
    "synchronize": synchronize(correspondence=True),
    "synchronize, different points": synchronize(correspondence=False),
    "reconstruct": reconstruct,
    "reconstruct_pair": reconstruct_pair,
    "triangulate_trajectories": trajectories,
    "ActionIndexer.fit": action("fit"),
    "ActionIndexer.predict": action("predict"),
    "ActionIndexer.score_frames": action("score_frames"),
    "ActionIndexer.find": action("find"),
    "PhaseIndexer.fit": phase("fit"),
    "PhaseIndexer.score_frames": phase("score_frames"),
    "BrightnessIndexer.fit": brightness("fit"),
    "BrightnessIndexer.predict": brightness("predict"),
}
"""Each makes its data and returns the call."""


Array = NDArray[np.float64]
FIRST, WARM, SHELL = 1.0, 0.5, 4.0  # seconds
ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1"}
ONE = "import sys; from experiments.benchmarks.first_answers import answer; answer(sys.argv[1])"


@dataclass(frozen=True)
class Config(BaseConfig):
    """First answers beside the goals."""

    only: str = ""
    """Verbs and commands whose name holds this."""


def answer(name: str) -> None:
    """Print the seconds of the first call and of the quickest of two more, in a process that has done nothing else."""
    call, seconds = VERBS[name](), []
    for _ in range(3):
        start = time.process_time()
        call()
        seconds.append(time.process_time() - start)
    print(json.dumps([seconds[0], min(seconds[1:])]))


def verbs(config: Config) -> list[Row]:
    """First and warm calls of all verbs."""
    rows = []
    for name in VERBS:
        if config.only not in name:
            continue
        note(f"... {name}")
        done = subprocess.run([sys.executable, "-c", ONE, name], env=ENVIRONMENT, capture_output=True, text=True, check=True)
        first, warm = json.loads(done.stdout.splitlines()[-1])
        rows.append(Row(name, "first call of a process", first, FIRST, at_most=True, unit=" s"))
        rows.append(Row(name, "warm", warm, WARM, at_most=True, unit=" s"))
    return rows


def examples(folder: Path) -> dict[str, list[str]]:
    """The four commands on the examples of the README, whose files are written to a folder."""
    import torch

    from dyntorch import scenes
    from indexing.actors import Person, detect, stream

    draw = torch.Generator().manual_seed(4)
    for name, view in zip("abc", scenes.planar(n=120, sigma=0.5, static=0.4, outliers=0.15, generator=draw).views, strict=True):
        np.savetxt(folder / f"{name}.csv", view.numpy(), delimiter=",", header="x,y", comments="")
    draw = torch.Generator().manual_seed(4)
    x1, x2 = scenes.bodies((110, 80, 50), bodies=3, sigma=0.4, outliers=0.2, generator=draw).views
    np.savetxt(folder / "matches.csv", torch.cat([x1, x2], -1).numpy(), delimiter=",", header="x1,y1,x2,y2", comments="")
    scene, _ = stream(["squat", "kick", "wave"], Person(), fps=30, rng=1)
    for name, azimuth, late in (("cam1", 0, 0), ("cam2", 60, 17)):
        clip = detect(scene, azimuth=azimuth, rng=late)
        (folder / name).mkdir()
        for i, (joints, trust) in enumerate(zip(clip.joints[late:], cast("Array", clip.confidence)[late:], strict=True)):
            people = [{"pose_keypoints_2d": np.nan_to_num(np.c_[joints, trust]).ravel().tolist()}]
            (folder / name / f"{name}_{i:012d}_keypoints.json").write_text(json.dumps({"people": people}))
    draw = torch.Generator().manual_seed(5)
    lifted = scenes.lifted_points("constant_velocity_3d", 120, views=6, static=0.4, sigma=0.5, outliers=0.05, generator=draw)
    np.save(folder / "tracks.npy", lifted.tracks.numpy())
    return {
        "align": ["align", "a.csv", "b.csv", "c.csv", "--out", "align"],
        "segment": ["segment", "matches.csv", "--out", "segment"],
        "sync": ["sync", "cam1", "cam2", "--fps", "30", "--out", "sync"],
        "reconstruct": ["reconstruct", "tracks.npy", "--motion", "constant_velocity_3d", "--fps", "25", "--out", "reconstruct"],
    }


def commands(config: Config) -> list[Row]:
    """The commands from the shell, with their reports."""
    rows = []
    with tempfile.TemporaryDirectory() as place:
        for name, words in examples(Path(place)).items():
            if config.only not in f"dyntorch {name}":
                continue
            note(f"... dyntorch {name}")
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            code = "import sys; from indexing.cli import main; sys.exit(main(sys.argv[1:]))"
            path = os.pathsep.join([str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")])
            line = [sys.executable, "-c", code, *words]
            given = {**ENVIRONMENT, "PYTHONPATH": path}
            done = subprocess.run(line, cwd=place, env=given, capture_output=True, text=True)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            if done.returncode not in (0, 3):
                raise ValueError(f"dyntorch {' '.join(words)}: {done.stderr.strip()}")
            seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
            rows.append(Row(f"dyntorch {name}", "from the shell, with its report", seconds, SHELL, at_most=True, unit=" s"))
    return rows


@experiment(Config(), quick={"only": "fit"})
def tables(config: Config) -> Tables:
    """Verbs in processes of their own, and commands from the shell."""
    yield "Verbs", verbs(config)
    yield "Commands", commands(config)
