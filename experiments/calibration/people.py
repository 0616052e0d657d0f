"""Who is who in cameras that nobody calibrated: people who cross each other's paths, followed by trackers that exchange them.

    DYNTORCH_DATA=... python -m experiments.calibration.people

Virtual rigs (:mod:`experiments.calibration.rigs`): motion capture on paths that cross, 300
frames at 30 fps, focal lengths of 1100 to 1800 px, 6 px of heavy-tailed noise, 10 % of the joints missing, clocks unknown (up to 25
frames of 60 fps apart); every tracker has numbers of its own and exchanges two people in half of the encounters in which their
boxes overlap.  *Hidden*: the one behind is not found while more than half of the box is covered.  *False*: share of the frames in
which somebody is found who is not there.  *Right* is the share of all people in all frames of all cameras that have their identity,
one for the whole take; *trackers alone* is the same share where the numbers of each tracker are taken as they are, each for the
person whom it is most often.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray

from experiments.calibration.rigs import Motion, Rig, RigSpec, motions, virtual_rig
from experiments.common.runner import SceneConfig, Tables, Words, experiment
from indexing.calibrate.people import Association, associate
from indexing.clip import Clip
from indexing.skeleton import Skeleton

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]


@dataclass(frozen=True)
class CrowdSpec:
    """What is drawn besides the rig; ranges are uniform."""

    people: int = 2
    rig: RigSpec = field(default_factory=RigSpec)
    radius: tuple[float, float] = (1.2, 1.8)
    """Metres from the middle at which somebody turns around and crosses the middle again."""
    speed: tuple[float, float] = (0.7, 1.3)
    """Metres per second."""
    near: tuple[float, float] = (0.4, 0.9)
    """Metres: the least distance of everybody to those drawn before."""
    swap: float = 0.5
    """Probability that the tracker swaps two people while their boxes overlap, once an encounter."""
    hidden: float = 0.0
    """Probability that the one behind is not found in an encounter, while more than half of the box is covered."""
    false: float = 0.0
    """Share of the frames of a camera in which somebody is found who is not there."""


@dataclass(frozen=True)
class Crowd:
    """What the trackers give, and who it was."""

    rig: Rig
    cameras: list[list[Clip]]
    """Per camera the people that its tracker tells apart."""
    truth: list[Numbers]
    """Per camera ``(frames, tracks)``: who each of them is in a frame; -1 nobody, -2 somebody who is not there."""
    people: int


def crowd(seed: int, spec: CrowdSpec | None = None, bodies: list[Motion] | None = None) -> Crowd:
    """People who cross each other's paths, seen by a rig.

    Args:
        seed: of everything that is drawn.
        spec: what is drawn.
        bodies: the recordings to choose from; by default those of :func:`experiments.calibration.rigs.motions`.
    """
    spec = spec or CrowdSpec()
    rng = np.random.default_rng([seed, spec.people])
    every = motions(spec.rig.joints) if bodies is None else bodies
    seconds = spec.rig.frames / min(spec.rig.fps) + 4 * spec.rig.shift + 0.5
    count = math.ceil(seconds * 60.0)
    paths = _paths(rng, spec, count)
    chosen = rng.permutation(len(every))[: spec.people]
    group = np.concatenate([_walking(rng, every[i], paths[k], count) for k, i in enumerate(chosen)], axis=1)
    rig = virtual_rig(seed, spec.rig, [Motion(torch.from_numpy(group), 60.0)])
    joints = len(spec.rig.joints)
    cameras, truth = [], []
    for number, track in enumerate(rig.tracks):
        seen = track.numpy().reshape(len(track), spec.people, joints, 2)
        moments = (np.arange(len(seen)) / rig.fps[number] - float(rig.offsets[number])) / float(rig.rates[number])
        places = rig.points(torch.from_numpy(moments)).numpy().reshape(*seen.shape[:3], 3)
        depth = ((places @ rig.R[number, 2].numpy()) + float(rig.t[number, 2])).mean(2)
        found, who = _followed(rng, spec, seen, depth)
        cameras.append(_clips(found, rig.fps[number], f"cam{number + 1}", spec.rig.joints))
        truth.append(who)
    return Crowd(rig, cameras, truth, spec.people)


def _paths(rng: np.random.Generator, spec: CrowdSpec, count: int) -> Array:
    """``(people, count, 2)`` metres at 60 fps: everybody walks across a disc, turns at its border and comes back."""
    paths: list[Array] = []
    tries = 0
    while len(paths) < spec.people:
        one = _path(rng, spec, count)
        nearest = [float(np.linalg.norm(one - other, axis=1).min()) for other in paths]
        room = spec.near[0] * 0.99 ** (tries // 5)  # many people in a small place come nearer
        if not nearest or room < min(nearest) < spec.near[1]:
            paths.append(one)
            tries = 0
        tries += 1
    return np.stack(paths)


def _path(rng: np.random.Generator, spec: CrowdSpec, count: int) -> Array:
    angle, at, points = rng.uniform(0, 2 * math.pi), 0.0, []
    while at < count + 60:
        points.append((at, *(rng.uniform(*spec.radius) * np.array([math.cos(angle), math.sin(angle)]))))
        angle += math.pi + rng.uniform(-0.7, 0.7)
        at += 60 * 2 * float(np.mean(spec.radius)) / rng.uniform(*spec.speed)
    corners = np.array([*points, (at, points[-2][1], points[-2][2])])
    moments = np.arange(count) + rng.uniform(0, 60)
    straight = np.stack([np.interp(moments, corners[:, 0], corners[:, k]) for k in (1, 2)], axis=1)
    return _smooth(straight, 25)


def _smooth(values: Array, half: int) -> Array:
    """Running mean of ``2 half + 1`` values, the ends repeated."""
    kernel = np.full(2 * half + 1, 1 / (2 * half + 1))
    padded = np.pad(values, ((half, half), (0, 0)), mode="edge")
    return np.stack([np.convolve(column, kernel, mode="valid") for column in padded.T], axis=1)


def _walking(rng: np.random.Generator, motion: Motion, path: Array, count: int) -> Array:
    """``(count, n, 3)``: a part of a recording, with its own way over the ground replaced by a path."""
    first = int(rng.integers(max(1, len(motion.joints) - count)))
    body = motion.joints[first : first + count].numpy().copy()
    body = np.pad(body, ((0, count - len(body)), (0, 0), (0, 0)), mode="reflect") if len(body) < count else body
    body[..., :2] -= _smooth(body[..., :2].mean(1), 30)[:, None]
    body[..., 2] -= np.quantile(body[..., 2], 0.01)
    turn = rng.uniform(0, 2 * math.pi)
    rotation = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    body[..., :2] = body[..., :2] @ rotation.T + path[:, None]
    return body


def _boxes(seen: Array) -> Array:
    """``(..., 4)`` left, top, right, bottom of ``(..., joints, 2)``; NaN where nothing is seen."""
    known = np.isfinite(seen)
    low, high = np.where(known, seen, np.inf).min(-2), np.where(known, seen, -np.inf).max(-2)
    return np.where(np.isfinite(low).all(-1, keepdims=True), np.concatenate([low, high], axis=-1), np.nan)


def _overlaps(boxes: Array) -> tuple[Array, Array]:
    """``(frames, people, people)``: the common area of two boxes, and the share of the first that it is."""
    a, b = boxes[:, :, None], boxes[:, None]
    sides = np.minimum(a[..., 2:], b[..., 2:]) - np.maximum(a[..., :2], b[..., :2])
    common = np.nan_to_num(np.clip(sides, 0, None).prod(-1))
    return common, common / np.maximum((a[..., 2:] - a[..., :2]).prod(-1), 1e-9)


def _followed(rng: np.random.Generator, spec: CrowdSpec, seen: Array, depth: Array) -> tuple[Array, Numbers]:
    """What a tracker of boxes makes of the people of a camera ``(frames, people, joints, 2)``.

    Returns:
        ``(frames, tracks, joints, 2)``, and who each track is, ``(frames, tracks)``.
    """
    frames, people = seen.shape[:2]
    seen = seen.copy()
    seen[np.isfinite(seen[..., 0]).sum(-1) < 5] = np.nan  # so few joints are no detection
    boxes = _boxes(seen)
    common, covered = _overlaps(boxes)
    who = np.tile(rng.permutation(people), (frames, 1))
    for a in range(people):
        for b in range(a + 1, people):
            for start, end in _runs(common[:, a, b] > 0):
                if spec.hidden and rng.uniform() < spec.hidden:
                    behind = np.where(depth[start:end, a] > depth[start:end, b], a, b)
                    share = np.where(behind == a, covered[start:end, a, b], covered[start:end, b, a])
                    rows = np.arange(start, end)[share > 0.5]
                    seen[rows, behind[share > 0.5]] = np.nan
                if rng.uniform() < spec.swap:
                    after = who[int(rng.integers(start, end)) :]
                    first, second = after == a, after == b
                    after[first], after[second] = b, a
    found = np.stack([seen[np.arange(frames), who[:, k]] for k in range(people)], axis=1)
    who = np.where(np.isfinite(found).any((2, 3)), who, -1)
    return _with_false(rng, spec, found, who) if spec.false else (found, who)


def _runs(there: NDArray[np.bool_]) -> list[tuple[int, int]]:
    steps = np.flatnonzero(np.diff(np.concatenate([[0], there.astype(int), [0]])))
    return [(int(a), int(b)) for a, b in zip(steps[::2], steps[1::2], strict=True)]


def _with_false(rng: np.random.Generator, spec: CrowdSpec, found: Array, who: Numbers) -> tuple[Array, Numbers]:
    """Besides the people, somebody who is not there: a body of another moment anywhere in the picture, for a frame or a second."""
    frames = len(found)
    left = spec.false * frames
    while left > 0:
        length = min(int(rng.choice([1, 2, 5, 15, 40])), frames)
        start = int(rng.integers(0, frames - length + 1))
        body = found[int(rng.integers(frames)), int(rng.integers(found.shape[1]))]
        if np.isfinite(body[:, 0]).sum() < 5:
            continue
        middle = rng.uniform(0.1, 0.9, 2) * spec.rig.size
        ghost = (body - np.nanmean(body, axis=0)) * rng.uniform(0.5, 1.3) + middle
        spread = spec.rig.noise / math.sqrt(3)
        row = np.full((frames, 1, *body.shape), np.nan)
        row[start : start + length, 0] = ghost + spread * rng.standard_t(3, (length, *body.shape))
        number = np.full((frames, 1), -1)
        number[start : start + length] = -2
        found, who = np.concatenate([found, row], axis=1), np.concatenate([who, number], axis=1)
        left -= length
    return found, who


def _clips(found: Array, fps: float, name: str, joints: tuple[str, ...]) -> list[Clip]:
    """A clip for each track, from its first frame to its last."""
    skeleton, clips = Skeleton("CMU-17", joints), []
    for track in range(found.shape[1]):
        clips.append(
            Clip(found[:, track], times=np.arange(len(found)) / fps, name=name, skeleton=skeleton, up="-y", meta={"person": track})
        )
    return clips


def share_right(tracks: list[Numbers], crowd: Crowd) -> float:
    """Of all people that the cameras show, frame by frame, the share that has its identity.

    Args:
        tracks: per camera ``(frames, identities)``: which track each identity is, -1 none.
        crowd: the truth.

    Identities have no numbers of their own: those that fit best are compared, one for each person.
    """
    from scipy.optimize import linear_sum_assignment

    identities = max((one.shape[1] for one in tracks), default=0)
    agreed, total = np.zeros((crowd.people, max(identities, 1))), 0
    for one, who in zip(tracks, crowd.truth, strict=True):
        total += int((who >= 0).sum())
        for identity in range(one.shape[1]):
            rows = np.flatnonzero(one[:, identity] >= 0)
            people = who[rows, one[rows, identity]]
            agreed[:, identity] += np.bincount(people[people >= 0], minlength=crowd.people)
    rows, columns = linear_sum_assignment(-agreed)
    return float(agreed[rows, columns].sum()) / max(total, 1)


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
