"""How long the first answer takes: every verb in a process of its own, first call and warm, and four commands from the shell.

    python -m experiments.benchmarks.first_answers

Seconds of processor time on one thread, which a busy machine changes little; importing torch and making the data are not counted.
Of the commands the whole process counts, Python's start included.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from experiments.benchmarks.verbs import VERBS
from experiments.common.runner import BaseConfig, Tables, experiment
from experiments.common.tables import Row, note

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
