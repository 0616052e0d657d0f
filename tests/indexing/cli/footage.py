"""Files that several commands are tested on: a film of a poster that slides over a wall, and keypoints as detectors write them."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import torch

from indexing.actors.textured import render, sheet
from indexing.clip import Clip
from indexing.video.drawing import encode

SIZE = (240, 180)
"""Of the film."""


def write_film(folder: Path, name: str, count: int) -> np.ndarray:
    """``NAME.mp4`` and the pictures ``NAME/f0.png`` ..., before a camera that goes and turns; the frames."""
    generator = torch.Generator().manual_seed(0)
    wall = sheet((-6, -5, 6), (12, 0, 0), (0, 10, 0), 700, 0, generator)
    poster = sheet((-1.6, -1.4, 5.99), (2.2, 0, 0), (0, 2.0, 0), 130, 1, generator)
    motions = np.tile(np.eye(4), (count, 2, 1, 1))
    motions[:, 1, :2, 3] = np.arange(count)[:, None] * [0.09, 0.04]
    camera = np.array([[260.0, 0, 119.5], [0, 260.0, 89.5], [0, 0, 1]])
    cameras = np.stack([camera @ np.c_[np.eye(3), [-0.05 * i, 0.03 * i, 0.02 * i]] for i in range(count)])
    frames = render([wall, poster], cameras, motions, SIZE, noise=1.0, generator=generator).frames
    (folder / name).mkdir()
    for i, frame in enumerate(frames):
        cv2.imwrite(str(folder / name / f"f{i}.png"), frame)
    write_video(folder / f"{name}.mp4", frames)
    return np.asarray(frames)


def write_video(path: Path, frames: np.ndarray) -> None:
    """Gray frames as a video of 25 a second."""
    path.write_bytes(encode((np.repeat(frame[..., None], 3, axis=2) for frame in frames), 25))


def write_coco(path: Path, *people: Clip, ids: bool = False) -> Path:
    """Clips as COCO keypoint results: whom each frame shows, with an id (from 1) where asked."""
    rows = []
    for frame in range(max(map(len, people))):
        for who, clip in enumerate(people, start=1):
            if frame < len(clip) and clip.seen[frame].any():
                trust = clip.seen[frame] if clip.confidence is None else clip.confidence[frame]
                triples = np.nan_to_num(np.column_stack([clip.joints[frame], trust])).ravel().round(2).tolist()
                row = {"image_id": frame, "category_id": 1, "keypoints": triples, "score": 0.9}
                rows.append({**row, "track_id": who} if ids else row)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(rows))
    return path
