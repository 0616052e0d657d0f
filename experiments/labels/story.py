"""An hour's recording, five labels, what is found, ten corrections, and what was learned anew: the machine's time for all of it.

    python -m experiments.labels.story

Needs no recordings: for an hour a synthetic person does five actions that matter and four that do not, with rests of 2 to 8 s, seen
by a noisy detector that loses joints; what it sees is a clip set of 108,000 frames, 30 per second, as ``dyntorch pose`` writes it.
Somebody marks the first performance of each action that matters in ELAN.  Then every step is a command of its own, its start
included:

1. ``index fit hour.npz --labels hour.eaf`` learns from five labels;
2. ``index scan hour.npz --write hour.eaf`` writes what is found into a tier beside them;
3. ten events (those with the least score) are corrected: names and times become the true ones, what does not matter is *other*;
4. ``index fit`` again, from five and ten labels.

The goal is one minute of the machine's time for the three commands: of its processor, and on the clock where nobody else works.
What the second scan finds better than the first is measured besides, and not counted.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from experiments.common.runner import BaseConfig, Grid, Tables, experiment
from experiments.common.tables import Row, note
from indexing import Clip
from indexing.actors import Person, detect, stream
from indexing.comparing import ComparedSpan, compare
from indexing.labels import Label, open_labels, write_labels

ACTIONS = ("squat", "wave", "kick", "throw", "bow")
BESIDES = ("lunge", "jumping_jack", "punch", "walk")
OTHER = "other"
FPS = 30.0
REST = (2.0, 8.0)  # seconds
GOAL = 60.0  # seconds


@dataclass(frozen=True)
class Config(BaseConfig):
    """How long an hour's recording takes."""

    minutes: float = 60.0
    """Of the recording."""
    corrections: int = 10
    """Events that the person corrects."""
    azimuth: float = 45.0
    """Degrees that the camera is turned."""


def recorded(config: Config) -> tuple[Clip, list[Label]]:
    """The recording, and everything that happens in it."""
    rng = np.random.default_rng(config.seed)
    person, parts, truth, at = Person.random(rng), [], [], 0.0
    while at < 60 * config.minutes:
        solid, done = stream(rng.choice(ACTIONS + BESIDES, 6).tolist(), person, rng=rng, rest=REST, fps=FPS)
        parts.append(detect(solid, azimuth=config.azimuth, rng=rng))
        truth += [Label(start + at, end + at, label if label in ACTIONS else OTHER) for label, start, end in done]
        at += len(solid) / FPS
    frames = round(60 * config.minutes * FPS)
    joints = np.concatenate([part.joints for part in parts])[:frames]
    confidence = np.concatenate([np.asarray(part.confidence) for part in parts])[:frames]
    clip = parts[0].replace(joints=joints, confidence=confidence, times=np.arange(len(joints)) / FPS, name="hour.npz")
    return clip, [label for label in truth if label.end <= clip.times[-1]]


def timed(*words: str | Path) -> tuple[float, float]:
    """Seconds on the clock and of the processor that a command takes, its start included.

    Raises:
        ValueError: it does not end well.
    """
    began, used = time.perf_counter(), os.times()
    done = subprocess.run(
        [sys.executable, "-m", "indexing.cli", *map(str, words)], capture_output=True, text=True, check=False, timeout=3600
    )
    if done.returncode:
        raise ValueError(f"{' '.join(map(str, words))}: ended with {done.returncode} ({done.stderr.strip()})")
    after = os.times()
    cpu = after.children_user + after.children_system - used.children_user - used.children_system
    return time.perf_counter() - began, cpu


def corrected(found: list[Label], truth: list[Label], number: int) -> list[Label]:
    """What somebody makes of the events with the least score: their true name and times; they go where nothing happened."""
    out: list[Label] = []
    for one in sorted(found, key=lambda each: each.score or 0.0)[:number]:
        shared = [(min(one.end, label.end) - max(one.start, label.start), label) for label in truth]
        length, best = max(shared, key=lambda pair: pair[0])
        if length > 0 and best not in out:
            out.append(best)
    return out


def agreement(found: list[Label], truth: list[Label], end: float) -> list[float]:
    """F1 of segments at overlaps of .1, .25 and .5, and Cohen's kappa over time, of the actions that matter."""
    known, said = ([(one.label, one.start, one.end) for one in side if one.label != OTHER] for side in (truth, found))
    both = compare([ComparedSpan("hour", 0.0, end, known, said)])
    return [*(one.f1 for one in both.segments.values()), both.kappa]


@experiment(Config(), quick={"minutes": 2.0, "corrections": 2}, one_thread=False)
def tables(config: Config) -> Tables:
    """How long an hour's recording takes, and what is found in it."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        keypoints, labels, model = folder / "hour.npz", folder / "hour.eaf", folder / "moves.safetensors"
        note("... the recording")
        clip, truth = recorded(config)
        clip.save(keypoints)
        first = [next(one for one in truth if one.label == action) for action in ACTIONS]
        write_labels(labels, first, recording=folder / "hour.mp4", tier="Ann", duration=clip.duration, fps=FPS)
        learn = ("index", "fit", keypoints, "--fps", f"{FPS:g}", "--labels", labels, "--tier", "Ann", "-o", model)
        search = ("index", "scan", keypoints, "--fps", f"{FPS:g}", "-m", model, "--write", labels)
        seconds: dict[str, tuple[float, float]] = {}
        note("... fit, scan, fit")
        seconds["fit, five labels"] = timed(*learn)
        seconds["scan --write"] = timed(*search)
        before = list(open_labels(labels, tier="dyntorch").labels)
        more = corrected(before, truth, config.corrections)
        mine = [*first, *(one for one in more if one not in first)]
        write_labels(labels, mine, recording=folder / "hour.mp4", tier="Ann", duration=clip.duration, fps=FPS)
        seconds[f"fit, {len(mine)} labels"] = timed(*learn)
        note("... what the second scan finds")
        timed(*search)
        after = list(open_labels(labels, tier="dyntorch").labels)
    total = [sum(column) for column in zip(*seconds.values(), strict=True)]
    kinds = ("on the clock, whoever else works", "of the processor")
    goals = [Row(f"seconds {kind}", "fit, scan, fit", time_, GOAL, at_most=True) for kind, time_ in zip(kinds, total, strict=True)]
    lines = {name: list(values) for name, values in seconds.items()} | {"together": total}
    title = (
        f"seconds, {len(clip):,} frames with {len(truth)} performances, {len(first)} labels and {config.corrections} corrections"
    )
    yield title, Grid(("on the clock", "of the processor"), lines, goals)
    found = {"five labels": (before, first), "and the corrections": (after, mine)}
    table = {name: [len(given), len(events), *agreement(events, truth, clip.duration)] for name, (events, given) in found.items()}
    yield "what is found", Grid(("labels", "found", "F1@0.1", "F1@0.25", "F1@0.5", "kappa"), table)
