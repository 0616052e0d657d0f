"""Synthetic people for the tests of the indexer: one clip per action to learn from, other people from elsewhere to recognize."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import dyntorch
from indexing import ActionIndexer, Clip, ClipSet
from indexing.action.bank import Windows
from indexing.actors import ACTIONS, Person, dataset, stream
from indexing.actors.textured import render_clip
from indexing.cli import main
from indexing.windows import concatenate_clips, resample_clips
from tests.indexing.sync.scene import filmed, shift

FILMED = ["squat", "wave", "bow", "punch", "kick"]
"""What the person of the videos to synchronize does."""
TEACHER, *STUDENTS = (Person.random(seed) for seed in range(3))


@pytest.fixture(scope="session")
def lesson() -> ClipSet:
    """One 2D clip of each of the 13 actions, by one person in one view."""
    return dataset([TEACHER], ACTIONS, azimuth=0.0, rng=0)


@pytest.fixture(scope="session")
def lesson_3d() -> ClipSet:
    """The same as 3D joints."""
    return dataset([TEACHER], ACTIONS, azimuth=None, rng=0)


@pytest.fixture(scope="session")
def others() -> ClipSet:
    """All actions by two other people, from two viewpoints that were not learned from."""
    return dataset(STUDENTS, ACTIONS, azimuth=(60.0, 150.0), rng=100)


@pytest.fixture(scope="session")
def _fitted(lesson: ClipSet) -> ActionIndexer:
    return ActionIndexer().fit(lesson)


@pytest.fixture
def indexer(_fitted: ActionIndexer) -> ActionIndexer:
    """Fitted to ``lesson``; a copy for each test."""
    copy = ActionIndexer(**_fitted.get_params())
    copy.__dict__.update(_fitted.__dict__)
    copy._rng = np.random.default_rng(0)
    return copy


@pytest.fixture(scope="session")
def windows_of() -> Callable[[Sequence[Clip]], Windows]:
    """Clips as whole windows of 12 steps."""

    def make(clips: Sequence[Clip], length: int = 12) -> Windows:
        source = concatenate_clips(list(clips))
        return Windows(resample_clips(source, length), torch.from_numpy(source.seen))

    return make


@pytest.fixture
def random_clip() -> Callable[..., Clip]:
    """A clip of smooth random joints."""

    def make(seed: int = 0, frames: int = 30, joints: int = 8, dims: int = 2, **known: Any) -> Clip:
        rng = np.random.default_rng(seed)
        t = np.linspace(0, 1, frames)[:, None, None]
        still, size, phase = rng.normal(size=(3, 1, joints, dims))
        return Clip(3 * still + size * np.sin(2 * np.pi * t + 3 * phase) + phase * np.cos(4 * np.pi * t), **known)

    return make


@pytest.fixture
def run(request, tmp_path, monkeypatch, capsys):
    """Runs a command in an empty folder: a line, or words, after the module's ``COMMAND``; ``@/`` in a word stands for the
    folder of the module's ``data``, and where the module says ``ONE_LINE`` the lines of a table are joined."""
    data = request.getfixturevalue("data") if hasattr(request.module, "data") else ""
    monkeypatch.chdir(tmp_path)
    capsys.readouterr()

    def call(*words: str | Path) -> tuple[int, str, str]:
        first = getattr(request.module, "COMMAND", "").split()
        rest = shlex.split(str(words[0])) if len(words) == 1 else map(str, words)
        code = main([*first, *(word.replace("@/", f"{data}/") for word in rest)])
        said = capsys.readouterr()
        return code, " ".join(said.out.split()) if hasattr(request.module, "ONE_LINE") else said.out, said.err

    return call


@pytest.fixture
def refuse(run, tmp_path):
    """Runs a command that must end with 2, one line with all the given words, and nothing written."""

    def call(*words: str | Path, says: Sequence[str]) -> None:
        before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
        code, out, err = run(*words)
        assert (code, out) == (2, "") and err.startswith("dyntorch: ") and err.count("\n") == 1, (out, err)
        assert [word for word in says if word not in err] == [], err
        assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before

    return call


@pytest.fixture(scope="session")
def cameras() -> list[Clip]:
    """One scene, filmed by three cameras that begin at different times."""
    return filmed()


@pytest.fixture
def library(monkeypatch):
    """What dyntorch.synchronize says, known; records how it was asked."""
    asked: list[dict] = []

    def answer(a, b, correspondence=True, **options):
        asked.append({"a": a, "b": b, "correspondence": correspondence, **options})
        return shift(points=torch.ones(a.shape[1], dtype=torch.bool) if correspondence else None)

    monkeypatch.setattr(dyntorch, "synchronize", answer, raising=False)
    return asked


def two_films(actions, seed, frames=120, image=(80, 60), turn=35.0, noise=2.0):
    clip, _ = stream(actions, Person.random(seed), rng=seed, rest=(0.1, 0.4))
    clip = clip.between(0.0, (frames - 1) / 30.0 + 1e-6)
    return tuple(
        render_clip(clip, azimuth=angle, image=image, noise=noise, rng=seed + k) for k, angle in enumerate((10.0, 10.0 + turn))
    )


@pytest.fixture(scope="session")
def films():
    """Two uint8 videos ``(150, 60, 80)`` in step."""
    return two_films(FILMED, 5, 150)


@pytest.fixture(scope="session")
def other():
    """A video of another person at other things."""
    return two_films(["jumping_jack", "sit_down", "kick", "bow"], 9, 120)[1]


@pytest.fixture
def rng():
    return np.random.default_rng(0)
