"""Clocks that break: frames that a camera lost or wrote twice, found by what another camera saw; and breaks where nothing broke.

    DYNTORCH_DATA=../shared/data python -m experiments.synchronization.breaks

Motion capture (CMU) before two virtual cameras for 20 s at 30 frames per second, 6 px of heavy-tailed noise, a tenth of the joints
missing, clocks unknown.  The second camera loses frames somewhere in the middle half, or has some twice, and its frame numbers go
on.
*Right* is one break, with the number of frames that was lost or doubled; *moment* is how far from the true moment it is told.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from statistics import median

import numpy as np
import torch
from torch import Tensor

import dyntorch as dyn
from experiments.calibration.rigs import Motion, RigSpec, motions, virtual_rig
from experiments.common.runner import SceneConfig, Tables, Words, experiment

FPS, FRAMES = 30.0, 600
CHANGES = (0, 1, 2, 3, 6, 12, -2, -6)
"""Frames that are lost; negative: there twice."""
HEAD = ("broken", "takes", "right", "another count", "none told", "refused", "moment, s (worst)", "processor s")


def broken(x: Tensor, at: int, lost: int) -> Tensor:
    """A recording ``(frames, n, 2)`` without ``lost`` frames from ``at`` on, or with so many of those before it twice."""
    return torch.cat([x[:at], x[at + lost :]])


def line(lost: int, config: SceneConfig, bodies: Sequence[Motion]) -> Sequence[str]:
    """A line of the table."""
    takes = config.scenes * (1 if lost else 4)
    right = other = none = refused = 0
    away, seconds = [], []
    for k in range(takes):
        rig = virtual_rig(config.seed + k, RigSpec(cameras=2, frames=FRAMES), bodies)
        at = int(np.random.default_rng(config.seed + k).integers(FRAMES // 4, 3 * FRAMES // 4))
        begun = time.process_time()
        found = dyn.tasks.breaks(rig.tracks[0], broken(rig.tracks[1], at, lost), fps=FPS)
        seconds.append(time.process_time() - begun)
        # of two cameras nobody knows which one lost frames and which has them twice: the one that is changed is the second
        frames = [one.frames for one in found.breaks]
        refused += not found.ok
        right += frames == ([abs(lost)] if lost else [])
        none += not frames
        other += bool(frames) and frames != [abs(lost)]
        if lost and frames == [abs(lost)]:
            moments = dict(zip(found.breaks[0].candidates, found.breaks[0].moments, strict=True))
            away.append(abs(moments[1] - at / FPS))
    frames_of = "frame" if abs(lost) == 1 else "frames"
    name = f"{abs(lost)} {frames_of} {'lost' if lost > 0 else 'twice'}" if lost else "nothing"
    told = f"{median(away):.2f} ({max(away):.2f})" if away else ""
    return name, str(takes), str(right), str(other), str(none), str(refused), told, f"{median(seconds):.1f}"


@experiment(SceneConfig(scenes=10), quick={"scenes": 2})
def tables(config: SceneConfig) -> Tables:
    """Broken clocks: so many takes per line, four times as many where nothing broke."""
    bodies = [body for body in motions() if len(body.joints) > 1.1 * FRAMES / FPS * body.fps]
    yield "broken clocks", Words(HEAD, [line(lost, config, bodies) for lost in CHANGES])
