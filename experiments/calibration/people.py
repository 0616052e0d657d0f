"""Who is who in cameras that nobody calibrated: people who cross each other's paths, followed by trackers that exchange them.

    DYNTORCH_DATA=... python -m experiments.calibration.people

Virtual rigs (:mod:`experiments.calibration.rigs`, :mod:`experiments.calibration.crowd`): motion capture on paths that cross, 300
frames at 30 fps, focal lengths of 1100 to 1800 px, 6 px of heavy-tailed noise, 10 % of the joints missing, clocks unknown (up to 25
frames of 60 fps apart); every tracker has numbers of its own and exchanges two people in half of the encounters in which their
boxes overlap.  *Hidden*: the one behind is not found while more than half of the box is covered.  *False*: share of the frames in
which somebody is found who is not there.  *Right* is the share of all people in all frames of all cameras that have their identity,
one for the whole take; *trackers alone* is the same share where the numbers of each tracker are taken as they are, each for the
person whom it is most often.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from experiments.calibration.crowd import Crowd, CrowdSpec, crowd, share_right
from experiments.calibration.rigs import Motion, RigSpec, motions
from experiments.common.runner import SceneConfig, Tables, Words, experiment
from indexing.calibrate.people import Association, associate

GOAL = 0.98
"""Share right that is asked for."""
SETTINGS: dict[str, CrowdSpec] = {
    "2 people, 4 cameras": CrowdSpec(),
    "the same, hidden": CrowdSpec(hidden=1.0),
    "the same, hidden, 20 % false": CrowdSpec(hidden=1.0, false=0.2),
    "2 people, 2 cameras, hidden": CrowdSpec(hidden=1.0, rig=RigSpec(cameras=2)),
    "3 people, 3 cameras": CrowdSpec(people=3, rig=RigSpec(cameras=3)),
    "the same, hidden, 20 % false ": CrowdSpec(people=3, hidden=1.0, false=0.2, rig=RigSpec(cameras=3)),
    "5 people, 3 cameras, hidden, 10 % false": CrowdSpec(people=5, hidden=1.0, false=0.1, rig=RigSpec(cameras=3)),
    "6 people, 8 cameras, hidden, 10 % false": CrowdSpec(people=6, hidden=1.0, false=0.1, rig=RigSpec(cameras=8)),
}
LARGE = 5
"""People from which on a fifth of the rigs are filmed."""
HEAD = (
    "rigs of",
    "rigs",
    "right",
    "worst rig",
    "98 % right",
    "refused",
    "trackers alone",
    "false taken for somebody",
    "clock, frames",
    "seconds",
)


@dataclass(frozen=True)
class Trial:
    """What one rig gave."""

    right: float
    alone: float
    false: float
    """Share of the false detections that were taken for somebody; NaN without any."""
    clock: float
    """Frames, of the worst camera."""
    seconds: float
    """Of the processor."""
    ok: bool


def trial(scene: Crowd) -> Trial:
    """Associate the people of a rig and compare with the truth."""
    begun = time.process_time()
    found = associate(scene.cameras)
    seconds = time.process_time() - begun
    clock = float("nan")
    if found.clocks is not None:
        clock = float((found.clocks.offsets - scene.rig.offsets).abs().max()) * min(scene.rig.fps)
    return Trial(share_right(list(found.tracks), scene), alone(scene), taken(found, scene), clock, seconds, found.ok)


def alone(scene: Crowd) -> float:
    """Share right where each number of a tracker is the person whom it is most often."""
    right = total = 0
    for who in scene.truth:
        total += int((who >= 0).sum())
        counts = np.stack([(who == person).sum(0) for person in range(scene.people)])
        right += int(counts.max(0).sum())
    return right / max(total, 1)


def taken(found: Association, scene: Crowd) -> float:
    """Share of the false detections that belong to some identity."""
    false = sum(int((who == -2).sum()) for who in scene.truth)
    somebody = 0
    for tracks, who in zip(found.tracks, scene.truth, strict=True):
        rows, people = np.nonzero(tracks >= 0)
        somebody += int((who[rows, tracks[rows, people]] == -2).sum())
    return somebody / false if false else float("nan")


def line(name: str, spec: CrowdSpec, config: SceneConfig, bodies: list[Motion]) -> Sequence[str]:
    """A line of the table."""
    rigs = max(1, config.scenes // 5) if spec.people >= LARGE else config.scenes
    trials = [trial(crowd(config.seed + k, spec, bodies)) for k in range(rigs)]
    right = np.array([one.right for one in trials])
    false, clocks = (np.array([getattr(one, key) for one in trials]) for key in ("false", "clock"))
    return (
        name.strip(),
        str(rigs),
        f"{right.mean():.4f}",
        f"{right.min():.4f}",
        f"{(right >= GOAL).sum()} of {rigs}",
        str(sum(not one.ok for one in trials)),
        f"{np.mean([one.alone for one in trials]):.2f}",
        "" if np.isnan(false).all() else f"{np.nanmean(false):.3f}",
        f"{np.nanmedian(clocks):.2f}",
        f"{np.median([one.seconds for one in trials]):.1f}",
    )


@experiment(SceneConfig(scenes=20), quick={"scenes": 2})
def tables(config: SceneConfig) -> Tables:
    """Identities of people across cameras; quick: the first two lines."""
    bodies = motions()
    chosen = list(SETTINGS.items())[: 2 if config.quick else None]
    yield "identities of people", Words(HEAD, [line(name, spec, config, bodies) for name, spec in chosen])
