"""Left and right exchanged in some cameras, and put right by the others: virtual rigs with known cameras.

    DYNTORCH_DATA=... python -m experiments.calibration.sides

Virtual rigs (:mod:`experiments.calibration.rigs`): motion capture, 300 frames at 30 fps, 6 px of heavy-tailed noise, 10 % of the
joints missing.  *Mirrored*: one camera takes left for right in the whole take.  *Stretches*: in every camera two stretches of 4 to
40 frames in which it exchanges the arms, the legs, or all.  The share of limbs (arms and legs, frame by frame and camera by camera)
whose sides are wrong, as given and as mended.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments.calibration.rigs import BODY, Motion, Rig, RigSpec, motions, virtual_rig
from experiments.common.runner import SceneConfig, Tables, Words, experiment
from indexing.calibrate.left_right import LIMBS, correct_sides, paired_joints

WORDS = {
    "humerus": "elbow", "radius": "wrist", "wrist": "hand", "femur": "knee", "tibia": "ankle", "foot": "heel", "toes": "big_toe",
}  # fmt: skip
"""What the ends of the recorded bones are called elsewhere."""
JOINTS = tuple(f"{'left' if name[0] == 'l' else 'right'}_{WORDS[name[1:]]}" if name[1:] in WORDS else name for name in BODY)
CASES = ("nothing", "mirrored", "stretches")
HEAD = ("cameras", "exchanged", "wrong as given", "wrong as mended", "rigs without any", "seconds")


def drawn(rng: np.random.Generator, case: str, cameras: int, frames: int) -> NDArray[np.bool_]:
    """Which limbs are exchanged, ``(cameras, frames, limbs)``."""
    out = np.zeros((cameras, frames, len(LIMBS)), dtype=bool)
    if case == "mirrored":
        out[int(rng.integers(cameras))] = True
    if case == "stretches":
        for camera in np.repeat(np.arange(cameras), 2).tolist():
            start, limb = int(rng.integers(frames - 4)), int(rng.integers(len(LIMBS)))
            out[camera, start : start + int(rng.integers(4, 41)), slice(None) if limb == 0 else limb] = True
    return out


def turned(rig: Rig, exchanged: NDArray[np.bool_]) -> list[NDArray[np.float64]]:
    """The tracks of a rig with left and right exchanged."""
    out = [track.numpy().copy() for track in rig.tracks]
    for track, flags in zip(out, exchanged, strict=True):
        for k, limb in enumerate(LIMBS):
            rows = np.flatnonzero(flags[:, k])
            for left, right in paired_joints(JOINTS)[limb]:
                track[rows, left], track[rows, right] = track[rows, right].copy(), track[rows, left].copy()
    return out


def line(cameras: int, case: str, config: SceneConfig, bodies: list[Motion]) -> Sequence[str]:
    """A line of the table."""
    given, mended, seconds = [], [], []
    there = [k for k, limb in enumerate(LIMBS) if paired_joints(JOINTS)[limb]]
    for seed in range(config.scenes):
        rig = virtual_rig(config.seed + seed, RigSpec(cameras=cameras), bodies)
        exchanged = drawn(np.random.default_rng([config.seed + seed, cameras]), case, cameras, len(rig.tracks[0]))
        known: Any = SimpleNamespace(
            K=rig.K, R=rig.R, t=rig.t, distortion=rig.distortion, clocks=SimpleNamespace(offsets=rig.offsets, rates=rig.rates)
        )
        begun = time.process_time()
        found = correct_sides(turned(rig, exchanged), known, JOINTS)
        seconds.append(time.process_time() - begun)
        answer = np.stack([one[:, 0] for one in found.exchanged])
        given.append(float(exchanged[..., there].mean()))
        mended.append(float((answer != exchanged)[..., there].mean()))
    return (
        str(cameras),
        case,
        f"{np.mean(given):.4f}",
        f"{np.mean(mended):.4f}",
        f"{sum(value == 0 for value in mended)} of {len(mended)}",
        f"{np.median(seconds):.2f}",
    )


@experiment(SceneConfig(scenes=20), quick={"scenes": 2})
def tables(config: SceneConfig) -> Tables:
    """Sides of people across cameras; quick: four cameras."""
    bodies = motions()
    chosen = [(cameras, case) for cameras in ((4,) if config.quick else (3, 4, 6, 8)) for case in CASES]
    yield "left and right", Words(HEAD, [line(cameras, case, config, bodies) for cameras, case in chosen])
