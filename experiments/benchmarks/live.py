"""Actions found while they are recorded: frames per second of a stream, beside the goal, and what it finds, beside the whole.

    python -m experiments.benchmarks.live

Needs no recordings: synthetic people, learned from one view, perform all actions in front of other cameras.  One thread; processor
time of this process, and the fastest of several rounds: others at work slow the caches down.  ``single frames``: pushed one by one,
as a camera gives them; ``one second``: 30 at once.  The goal is ten times faster than they are recorded.  F1 is that of events
that overlap a true one by half (intersection over union), of people who were not learned from.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from experiments.common.runner import BaseConfig, Tables, experiment
from experiments.common.tables import Row, note
from experiments.recognition.detection_metrics import f1
from indexing import ActionIndexer, Clip
from indexing.actors import ACTIONS, Person, dataset, detect, stream
from indexing.scoring import Event

FPS = 30.0  # at which synthetic people are recorded
GOAL = 10 * FPS
PUSHES = {"single frames": 1, "one second": 30}


@dataclass(frozen=True)
class Config(BaseConfig):
    """Speed of a stream of the action indexer, and what it finds."""

    exemplars: tuple[int, ...] = (26, 100)
    """How many are learned from, of thirteen actions."""
    rounds: int = 3
    """How often each speed is measured."""
    people: int = 4
    """Who perform all actions once each, for F1."""
    azimuths: tuple[float, ...] = (0.0, 60.0)
    """Degrees that their camera is turned."""
    lags: tuple[float | None, ...] = (None, 5.0)
    """Seconds; ``None``: the stream's own."""


@cache
def learned(exemplars: int, seed: int) -> ActionIndexer:
    """An indexer of so many clips, seen from the front."""
    clips = dataset(-(-exemplars // len(ACTIONS)), azimuth=0.0, rng=seed)[:exemplars]
    return ActionIndexer().fit(clips, clips.labels)


def performed(number: int, azimuth: float, seed: int) -> tuple[Clip, list[Event]]:
    """All actions once, in any order, by another person; and when."""
    rng = np.random.default_rng([seed, 1, number])
    solid, truth = stream([str(name) for name in rng.permutation(list(ACTIONS))], Person.random(rng), fps=FPS, rng=rng)
    return detect(solid, azimuth=azimuth, rng=rng), [Event(label, start, end, 0.0, 0.0) for label, start, end in truth]


def followed(indexer: ActionIndexer, clip: Clip, at_once: int, lag: float | None = None) -> dict[str, Any]:
    """Push a recording: the events, frames per second, the slowest push, most frames kept, and the lag."""
    live = indexer.stream(lag=lag, up=clip.up)
    found: list[Event] = []
    kept, slowest, begin = 0, 0.0, time.process_time()
    for at in range(0, len(clip), at_once):
        before = time.process_time()
        found += live.push(clip.joints[at : at + at_once], clip.times[at : at + at_once]).events
        slowest, kept = max(slowest, time.process_time() - before), max(kept, live.num_frames)
    found += live.finish().events
    speed = len(clip) / (time.process_time() - begin)
    return {"events": found, "speed": speed, "slowest": slowest, "kept": kept, "lag": live.lag}


def speeds(config: Config) -> list[Row]:
    """Frames per second, by exemplars and frames at once; of single frames the slowest, too, in which a block ends."""
    rows: list[Row] = []
    clip, _ = performed(0, config.azimuths[-1], config.seed)
    for exemplars in config.exemplars:
        indexer, setting = learned(exemplars, config.seed), f"{exemplars} exemplars"
        runs = {name: [followed(indexer, clip, count) for _ in range(config.rounds + 1)][1:] for name, count in PUSHES.items()}
        for name, some in runs.items():
            rows.append(Row(name, setting, max(one["speed"] for one in some), goal=GOAL, unit=" frames/s"))
            note(f"... {name}, {setting}: {rows[-1].measured:.0f} frames/s")
        single = runs["single frames"]
        rows.append(Row("slowest single frame", setting, min(one["slowest"] for one in single), unit=" s"))
        rows.append(Row("frames kept, at most", setting, single[0]["kept"]))
        rows.append(Row("lag", setting, single[0]["lag"], unit=" s"))
    return rows


def finds(config: Config) -> list[Row]:
    """F1 of what a stream tells, beside that of ``find``, which knows the whole recording."""
    rows, indexer = [], learned(config.exemplars[0], config.seed)
    for azimuth in config.azimuths:
        asked = [performed(number, azimuth, config.seed) for number in range(config.people)]
        truth = [events for _, events in asked]
        setting = f"camera turned {azimuth:g}°"
        whole = f1([indexer.find(clip) for clip, _ in asked], truth)
        rows.append(Row("find", setting, whole))
        for lag in config.lags:
            told = [followed(indexer, clip, 30, lag) for clip, _ in asked]
            rows.append(Row(f"stream, {told[0]['lag']:.1f} s lag", setting, f1([one["events"] for one in told], truth)))
    return rows


@experiment(Config(), quick={"exemplars": (13,), "rounds": 1, "people": 1})
def tables(config: Config) -> Tables:
    """Speed of a stream, and what it finds."""
    yield "Speed of a stream of the action indexer", speeds(config)
    yield "F1 of its events", finds(config)
