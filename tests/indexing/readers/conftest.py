"""A person to write in every format: what the readers must give back."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

FRAMES, JOINTS = 6, 17


@pytest.fixture
def person() -> np.ndarray:
    """``(6, 17, 3)``: x, y in pixels and confidence; joint 3 of frame 2 was not seen."""
    rng = np.random.default_rng(1)
    rest = rng.uniform([100, 100], [300, 400], size=(JOINTS, 2))
    xy = rest + np.arange(FRAMES)[:, None, None] * [4.0, 1.0]
    out = np.concatenate([xy, rng.uniform(0.5, 0.99, size=(FRAMES, JOINTS, 1))], axis=2).round(3)
    out[2, 3] = 0.0
    return out


@pytest.fixture
def expected(person: np.ndarray) -> np.ndarray:
    """``(6, 17, 2)``: the joints that every reader gives for :func:`person`."""
    xy = person[..., :2].copy()
    xy[2, 3] = np.nan
    return xy


@pytest.fixture
def write_json(tmp_path: Path) -> Callable[..., Path]:
    """Writes JSON to a file of the test's folder."""

    def write(data: Any, name: str = "take.json") -> Path:
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(data if isinstance(data, str) else json.dumps(data))
        return path

    return write


@pytest.fixture
def openpose_folder(tmp_path: Path) -> Callable[..., Path]:
    """Writes frames of people ``{frame number: [(n, 3), ...]}`` as OpenPose does."""

    def write(frames: dict[int, list[np.ndarray]], name: str = "take", ids: dict[int, list[int]] | None = None) -> Path:
        folder = tmp_path / name
        folder.mkdir()
        for number, people in frames.items():
            listed = [
                {"person_id": [-1 if ids is None else ids[number][i]], "pose_keypoints_2d": one.ravel().tolist()}
                for i, one in enumerate(people)
            ]
            (folder / f"clip2_{number:012d}_keypoints.json").write_text(json.dumps({"version": 1.3, "people": listed}))
        return folder

    return write
