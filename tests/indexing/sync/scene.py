"""Recordings of one scene by cameras that start at different times, and the files that hold them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch

from dyntorch import Shift, Status
from dyntorch.core import Notice, NoticeCode, status_from
from indexing.actors import Person, detect, stream
from indexing.clip import Clip

FPS = 30.0
SKIPPED = (0, 12, 25)  # frames that each camera starts late: the true offsets are minus these
ACTIONS = ("squat", "kick")


def cut(clip: Clip, first: int, last: int | None = None) -> Clip:
    """Some frames, on a clock that begins with them."""
    joints = clip.joints[first:last]
    confidence = None if clip.confidence is None else clip.confidence[first:last]
    return clip.replace(joints=joints, times=np.arange(len(joints)) / FPS, confidence=confidence)


def filmed(seed: int = 1, skipped: tuple[int, ...] = SKIPPED, actions: tuple[str, ...] = ACTIONS, **camera: float) -> list[Clip]:
    """One scene in several cameras, with a detector's noise."""
    scene, _ = stream(actions, Person.random(seed), fps=FPS, rng=seed)
    seen = [detect(scene, azimuth=50.0 * i, rng=seed + i, **camera) for i in range(len(skipped))]
    return [cut(clip, skip).replace(name=f"cam{i}") for i, (clip, skip) in enumerate(zip(seen, skipped, strict=True), start=1)]


def moved(clip: Clip, by: float) -> Clip:
    """The same person elsewhere in the image, by so many pixels to the right."""
    return clip.replace(joints=clip.joints + np.array([by, 0.0]))


def write_openpose(folder: Path, people: list[Clip], start: int = 0, missing: tuple[int, ...] = ()) -> Path:
    """A folder as OpenPose writes it: ``<name>_000000000012_keypoints.json``."""
    folder.mkdir(parents=True, exist_ok=True)
    for frame in range(max(map(len, people))):
        found = []
        for clip in people:
            if frame < len(clip) and clip.seen[frame].any():
                trust = np.ones(clip.joints.shape[:2]) if clip.confidence is None else clip.confidence
                table = np.nan_to_num(np.concatenate([clip.joints[frame], trust[frame][:, None]], axis=1))
                found.append({"person_id": [-1], "pose_keypoints_2d": table.ravel().tolist()})
        if frame not in missing:
            name = f"{folder.name}_{frame + start:012d}_keypoints.json"
            (folder / name).write_text(json.dumps({"version": 1.3, "people": found}))
    return folder


def shift(offset: float = -0.4, **changes: object) -> Shift:
    """What the library might say."""
    lags = torch.linspace(-2, 2, 121, dtype=torch.float64)
    values: dict = {
        "offset": offset, "sigma": 0.002, "rate": 1.0, "rate_sigma": 0.0, "confidence": 0.99,
        "peaks": torch.tensor([[offset, 9.0], [offset + 1.1, 4.0]], dtype=torch.float64), "status": torch.tensor(0), "notices": (),
        "method": "epipolar", "fps": (FPS, FPS), "center": 2.0, "lags": lags, "scores": 9 - (lags - offset).abs(),
    }  # fmt: skip
    return Shift(**{**values, **told(changes)})


class Told(NoticeCode):
    NOTE = "note", "{text}"
    REFUSED = "refused", "{text}", Status.AMBIGUOUS


def told(changes: dict[str, object]) -> dict[str, object]:
    """``ok``, ``reason`` and ``notes`` of a shift as status and notices."""
    left = {name: value for name, value in changes.items() if name not in ("ok", "reason", "notes")}
    if {"ok", "reason", "notes"} & set(changes):
        refusal = () if changes.get("ok", True) else (Notice(Told.REFUSED, 0.0, {"text": changes.get("reason", "")}),)
        notices = (*refusal, *(Notice(Told.NOTE, 0.0, {"text": text}) for text in changes.get("notes", ())))
        left |= {"status": status_from(notices), "notices": notices}
    return left
