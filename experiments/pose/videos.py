"""People found in real videos by BlazePose, and what their joints, not smoothed, are good for.

    DYNTORCH_DATA=../shared/data python -m experiments.pose.videos
    DYNTORCH_DATA=../shared/data python -m experiments.pose.videos --quick

**Found**: share of the frames in which the person is seen, of the two shared videos (1080x1920, 60 fps, a laboratory) and of twenty
signs (640x480, 30 fps, several persons); and with two people wanted, the bystander.

**Time**: of the processor, per frame, median: all from the file to the joints; and the networks alone, in between, on the same
machine: what others do on it slows both.

**Synchronization** of the two videos, whose true offset is 0, from the joints alone: the first frames of b are cut off, or of a
where the number is negative.  The error is in frames of 60 fps.

**Arm raises**: 18 grey videos of 160x120, 2 people, 3 actions: learned from one person, asked of the other, both ways; and learned
from all but one clip.

Model files are those that ``dyntorch pose --get-models`` keeps.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from statistics import median
from typing import Annotated, Any

import numpy as np
import tyro

from experiments.common.runner import BaseConfig, Tables, experiment
from experiments.common.tables import Row
from experiments.recognition.protocol import Array, data_folder
from indexing import ActionIndexer, Clip
from indexing.pose import PoseOptions, detect
from indexing.pose.blazepose import JOINTS, PICTURE, REGION, VideoPicture
from indexing.pose.chunks import plan, work
from indexing.pose.detection import in_view
from indexing.pose.models import load_models
from indexing.pose.networks import LiteNetworks
from indexing.pose.tracking import Tracker
from indexing.sync.synchronize import synchronize
from indexing.video.reading import av

MODELS = ("heavy", "full")
CAMERAS = ("cam01", "cam02")
FPS = 60.0
CUTS = (0, 5, 12, 24, -7, -18)
"""Frames cut from the start of b, or of a where negative."""
GOALS_TIME = {"heavy": 60.0, "full": 25.0}
"""Milliseconds of the processor per frame of 1080x1920."""


@dataclass(frozen=True)
class Config(BaseConfig):
    """Poses in the real videos of the folder DYNTORCH_DATA."""

    models: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Of the model files."""

    @property
    def names(self) -> Sequence[Any]:
        """The networks that are measured."""
        return MODELS[:1] if self.quick else MODELS


@cache
def seen(path: Path, model: Any, models: Path | None, people: int = 1) -> tuple[Clip, ...]:
    """The people of a video."""
    return tuple(detect(path, people, model=model, models=models))


def camera(name: str) -> Path:
    """A shared video."""
    return data_folder() / "pose2sim" / f"{name}.mp4"


def shown(clip: Clip) -> float:
    """Share of the frames that show the person."""
    return float(clip.seen.any(axis=1).mean())


def found(config: Config) -> list[Row]:
    """In how many frames people are seen."""
    rows = []
    signs = sorted((data_folder() / "asl_gestures").glob("*.mkv"))
    signs = signs[:3] if config.quick else signs
    for model in config.names:
        for name in CAMERAS:
            (clip,) = seen(camera(name), model, config.models)
            rows.append(Row(f"{name}, {model}", f"{len(clip)} frames", shown(clip), 0.99))
        clips = [seen(path, model, config.models)[0] for path in signs]
        frames = np.concatenate([clip.seen.any(axis=1) for clip in clips])
        rows.append(Row(f"signs, {model}", f"{len(clips)} videos, {len(frames)} frames", float(frames.mean()), 0.99))
        rows.append(Row(f"signs, {model}", "the worst video", min(map(shown, clips))))
    for name in CAMERAS:
        people = seen(camera(name), "full", config.models, 2)
        times = seen(camera(name), "full", config.models)[0].times
        share = len(people[1]) * shown(people[1]) / len(times) if len(people) > 1 else 0.0
        rows.append(Row(f"{name}, full", f"the bystander, of {len(people)} people", share))
    return rows


def milliseconds(config: Config) -> list[Row]:
    """Of the processor, per frame."""
    rows = []
    for model in config.names:
        networks = LiteNetworks(load_models(model, config.models))
        whole = [step for name in CAMERAS for step in _frames(camera(name), model, networks)]
        rows.append(Row(f"{model}, from file to joints", "1080x1920", median(whole), GOALS_TIME[model], at_most=True, unit=" ms"))
        region, picture = np.zeros((REGION, REGION, 3), np.uint8), np.zeros((PICTURE, PICTURE, 3), np.uint8)
        rows.append(Row(f"{model}, network of landmarks", "a region", _median(networks.landmarks, region), unit=" ms"))
        rows.append(Row(f"{model}, detector", "twice a second", _median(networks.detector, picture), unit=" ms"))
    return rows


def _frames(path: Path, model: str, networks: LiteNetworks) -> Iterator[float]:
    """Milliseconds of each frame, with all that is done between it and the one before."""
    task, clocks = plan(path, 1, 1, None, model, PoseOptions()), [time.process_time()]
    work(task, task.pieces[0], networks, lambda: clocks.append(time.process_time()))
    yield from (1e3 * np.diff(clocks)).tolist()


def _median(network: Any, image: Array, times: int = 30) -> float:
    steps = []
    for _ in range(times):
        begun = time.process_time()
        network(image)
        steps.append(1e3 * (time.process_time() - begun))
    return median(steps)


def synchronized(config: Config) -> list[Row]:
    """Errors of the offset in frames, and what is called ok."""
    rows = []
    for model in config.names:
        a, b = (seen(camera(name), model, config.models)[0] for name in CAMERAS)
        errors, ok = [], []
        for cut in CUTS[:2] if config.quick else CUTS:
            shift = synchronize(_late(a, -cut), _late(b, cut))
            errors.append(abs(shift.offset * FPS + cut))
            ok.append(shift.ok)
            told = f"cut {cut:+d}: {'ok' if shift.ok else 'refused'}, sigma {shift.sigma * FPS:.2f}"
            rows.append(Row(f"{model}, error in frames", told, errors[-1], 0.5 if model == "heavy" else None, at_most=True))
        believed = [error for error, good in zip(errors, ok, strict=True) if good]
        rows.append(Row(f"{model}, ok", f"of {len(ok)}", sum(ok) / len(ok), 1.0 if model == "heavy" else None))
        rows.append(Row(f"{model}, ok but wrong", "by more than a frame", sum(error > 1 for error in believed), 0.0, at_most=True))
    return rows


def _late(clip: Clip, frames: int) -> Clip:
    """A clip that begins so many frames later, on a clock of its own."""
    if frames <= 0:
        return clip
    left = clip.between(float(clip.times[frames]) - 1e-6, float(clip.times[-1]))
    return left.replace(times=left.times - left.times[0])


def arms(config: Config) -> list[Row]:
    """Arm raises recognized from poses."""
    with np.load(data_folder() / "armraise_gray160x120.npz") as file:
        data = {key: file[key] for key in ("frames", "offsets", "action", "subject", "fps")}
    rows = []
    for model in config.names:
        networks = LiteNetworks(load_models(model, config.models))
        parts = np.split(data["frames"], data["offsets"][1:-1])
        clips = [gray(part, float(data["fps"]), networks) for part in parts]
        share = np.concatenate([clip.seen.any(axis=1) for clip in clips])
        rows.append(Row(f"frames with the person, {model}", f"{len(clips)} videos, {len(share)} frames", float(share.mean())))
        label, who = data["action"], data["subject"]
        right = [asked(clips, label, np.flatnonzero(who != one), np.flatnonzero(who == one)) for one in np.unique(who)]
        rows.append(Row(f"the other person's, {model}", f"of {len(clips)}", float(np.concatenate(right).mean())))
        right = [asked(clips, label, np.delete(np.arange(len(clips)), i), np.array([i])) for i in range(len(clips))]
        rows.append(Row(f"all but one, {model}", f"of {len(clips)}", float(np.concatenate(right).mean())))
    return rows


def gray(frames: Array, fps: float, networks: LiteNetworks, people: int = 1) -> Clip:
    """The person of a grey video ``(f, h, w)`` in memory."""
    tracker = Tracker(networks, people, PoseOptions())
    joints, confidence = np.full((len(frames), JOINTS, 2), np.nan), np.zeros((len(frames), JOINTS))
    for i, frame in enumerate(frames):
        image = av().VideoFrame.from_ndarray(np.repeat(frame[..., None], 3, axis=2), format="rgb24")
        for one in tracker.step(VideoPicture(image), i / fps):
            joints[i], confidence[i] = in_view(one.joints, one.confidence, (frames.shape[2], frames.shape[1]))
    return Clip(joints, confidence=confidence, fps=fps, up="-y")


def asked(clips: Sequence[Clip], labels: Array, learned: Array, left: Array) -> Array:
    """Which of the clips that are left are recognized by those that were learned."""
    indexer = ActionIndexer().fit([clips[i] for i in learned], labels[learned])
    return np.asarray(indexer.predict([clips[i] for i in left]) == labels[left])


@experiment(Config())
def tables(config: Config) -> Tables:
    """The videos of the folder DYNTORCH_DATA; quick: three signs, two cuts, one model."""
    yield "Found", found(config)
    yield "Time", milliseconds(config)
    yield "Synchronization from video alone", synchronized(config)
    yield "Arm raises", arms(config)
