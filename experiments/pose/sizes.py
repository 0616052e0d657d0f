"""How large a person must be to be found and followed: the shared videos, shrunk step by step.

    DYNTORCH_DATA=../shared/data python -m experiments.pose.sizes

*Shrunk*: the whole picture, as a camera of fewer pixels takes it.  *Far*: the same picture in the middle of a grey one of the old
size, as if the person were far away: the detector sees the whole picture at 224 pixels.  Sizes are those of the body from the head
to the feet, in pixels, median of the frames.  An error is the distance of a joint from where it is found at full size, in percent
of the body, of joints of confidence .5 and more; *found* are frames whose joints lie within a third of the body, in the mean.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from experiments.common.runner import BaseConfig, Tables, Words, experiment
from experiments.pose.videos import CAMERAS, FPS, camera, seen
from experiments.recognition.protocol import Array
from indexing import Clip
from indexing.pose import PoseOptions
from indexing.pose.blazepose import JOINTS, VideoPicture
from indexing.pose.models import load_models
from indexing.pose.networks import LiteNetworks
from indexing.pose.tracking import Tracker
from indexing.video.reading import av, read_video

HEIGHTS = (400, 200, 140, 100, 70, 50, 35, 25, 20)
"""Pixels of the body."""
NEAR, TRUSTED = 1 / 3, 0.5


@dataclass(frozen=True)
class Config(BaseConfig):
    """People who get smaller and smaller."""

    models: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Of the model files."""
    model: str = "full"
    """Which network."""
    every: int = 2
    """Of the frames, one in so many is looked at."""


def pictures(path: Path, scale: float, far: bool, every: int) -> Iterator[VideoPicture]:
    """The frames of a video, smaller."""
    for i, (frame, _) in enumerate(read_video(path).stored_frames()):
        if i % every:
            continue
        size = round(frame.width * scale), round(frame.height * scale)
        if not far:
            yield VideoPicture(frame, size)
            continue
        small = frame.reformat(*size, format="rgb24", interpolation="AREA").to_ndarray()
        image = np.full((frame.height, frame.width, 3), 128, np.uint8)
        x, y = (frame.width - size[0]) // 2, (frame.height - size[1]) // 2
        image[y : y + size[1], x : x + size[0]] = small
        yield VideoPicture(av().VideoFrame.from_ndarray(image, format="rgb24"))


def followed(path: Path, scale: float, far: bool, networks: LiteNetworks, every: int) -> Array:
    """``(frames, 33, 2)`` joints in pixels of the full size."""
    tracker, found = Tracker(networks, 1, PoseOptions()), []
    for i, picture in enumerate(pictures(path, scale, far, every)):
        people = tracker.step(picture, i * every / FPS)
        joints = people[0].joints if people else np.full((JOINTS, 2), np.nan)
        if far:
            width, height = picture.stored
            joints = joints - [(width - round(width * scale)) // 2, (height - round(height * scale)) // 2]
        found.append(joints / scale)
    return np.array(found)


def body(clip: Clip) -> float:
    """Median height of a body in pixels."""
    return float(np.median(np.nanmax(clip.joints[..., 1], axis=1) - np.nanmin(clip.joints[..., 1], axis=1)))


def row(height: int, far: bool, config: Config, networks: LiteNetworks) -> list[str]:
    """Share found, and errors, at one size."""
    hits, errors = [], []
    for name in CAMERAS:
        (full,) = seen(camera(name), config.model, config.models)
        tall = body(full)
        joints = followed(camera(name), height / tall, far, networks, config.every)
        apart = np.linalg.norm(joints - full.joints[:: config.every], axis=2) / tall
        hit = np.nan_to_num(apart, nan=np.inf).mean(axis=1) < NEAR
        assert full.confidence is not None
        hits.append(hit)
        errors.append(apart[hit][full.confidence[:: config.every][hit] >= TRUSTED])
    every = 100 * np.concatenate(errors)
    told = [f"{q:.1f} %" for q in np.percentile(every, [50, 90])] if len(every) else ["", ""]
    return [f"{height}", f"{np.concatenate(hits).mean():.3f}", *told]


@experiment(Config())
def tables(config: Config) -> Tables:
    """Shrunk pictures, and people far away; quick: three sizes."""
    chosen: Any = config.model
    networks = LiteNetworks(load_models(chosen, config.models))
    head = ("body (pixels)", "found", "error, median", "error, 90 %")
    for title, far in (("Shrunk", False), ("Far", True)):
        lines = [row(height, far, config, networks) for height in (HEIGHTS[::4] if config.quick else HEIGHTS)]
        yield title, Words(head, lines)
