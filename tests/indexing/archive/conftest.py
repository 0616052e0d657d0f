"""Movement for the tests of the archive: joints that swing, each in its own way, as clips and as files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from indexing import Archive, Clip, ClipSet


@pytest.fixture(scope="session")
def moves() -> Callable[..., Clip]:
    """A clip of smooth random joints in pixels; the same for the same seed."""

    def make(seed: int = 0, seconds: float = 3.0, joints: int = 8, dims: int = 2, fps: float = 30.0, **known: Any) -> Clip:
        rng = np.random.default_rng(seed)
        t = np.arange(round(seconds * fps))[:, None, None] / fps
        still, size, phase, pace = rng.normal(size=(4, 1, joints, dims))
        return Clip(300 * still + 60 * size * np.sin(4 * t * (1 + 0.3 * pace) + 3 * phase), fps=fps, **known)

    return make


@pytest.fixture
def saved(tmp_path: Path, moves: Callable[..., Clip]) -> Callable[..., Path]:
    """Writes the clip of a seed to a file."""

    def make(name: str, seed: int = 0, **options: Any) -> Path:
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        ClipSet([moves(seed, **options)]).save(path)
        return path

    return make


@pytest.fixture
def archive(tmp_path: Path) -> Archive:
    """A new one."""
    return Archive(tmp_path / "lab.archive")
