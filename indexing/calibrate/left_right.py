"""Left and right, exchanged: what pose networks do to bodies seen from behind, found and mended by what other cameras see."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from dyntorch import Calibration
from dyntorch.core import Notice, NoticeCode, Outcome, status_from
from dyntorch.geometry import undistort
from indexing.joints import canonical

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]
LIMBS = ("trunk", "arms", "legs")
"""What may be exchanged by itself: shoulders, hips and face; elbows, wrists and hands; knees, ankles and feet."""
_ARMS = re.compile(r"elbow|wrist|hand|thumb|index(?!toe)|middle|ring|pinky|radius|fingers")
_LEGS = re.compile(r"knee|ankle|heel|foot|toe|tibia")

JOINT_SIGMA = 0.015  # body sizes (diagonals in the picture): 6 to 8 px of 450
DEGREES_OF_FREEDOM = 3.0  # of Student's t for these distances: detectors have outliers
MAX_JOINT_EVIDENCE = 8.0  # nats of one joint of three cameras
INDEPENDENT_LIMB_JOINTS = 3.0  # in one limb: its joints are exchanged, and off, together
CORRELATION_SECONDS = 0.1  # within which frames carry the same evidence
MAX_TRIPLES = 20  # of cameras; of 7 and 8 cameras every second or third one
EXCHANGE_COST = 0.5  # nats per second of an exchanged camera: fewer exchanges are likelier
LIMB_COST = 1.0  # nats per second of a limb whose state differs from that of the body
SWITCH_COST = 4.0  # nats of a change in one camera: keeps single frames from flickering
MAX_FRAME_DISTANCE = 0.6  # frames from a moment within which a camera's frame stands for it
MIN_TIE_SECONDS = 0.2  # from which on a tie is reported


class SideNotice(NoticeCode):
    """What to know of left and right, or why nothing is said of them."""

    TWO = "two_cameras", "two cameras: which of them exchanges left and right cannot be told, so all stays as it is; add a camera"
    """Two cameras contradict each other, and nothing tells who is wrong."""
    SIDELESS = "no_sides", "no two joints of the layout are the left and the right one; name the joints"
    """A layout without sides."""
    TIED = (
        "tied",
        "from {start:.2f} to {end:.2f} s as many cameras exchange the {limb} of person {person} as do not, and all stays as it is",
    )
    """As many cameras for one reading as for the other."""
    MENDED = "mended", "{limb} of person {person} exchanged in {which:cameras} from {start:.2f} to {end:.2f} s, mended"
    """What was exchanged."""


@dataclass(frozen=True)
class SideExchange:
    """A stretch in which a camera shows left as right."""

    camera: int  # its number
    person: int  # the number of the person
    limb: str  # ``"body"`` (everything), ``"trunk"``, ``"arms"`` or ``"legs"``
    start: float  # seconds on the camera's clock, of the first and the last frame
    end: float
    evidence: float  # nats for it


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class SideCorrection(Outcome):
    """Left and right, as all cameras together see them."""

    tracks: tuple[Floats, ...]  # per camera ``(frames, n, 2)`` px as given, with what was exchanged put right
    weights: tuple[Floats, ...]  # per camera ``(frames, n)``
    exchanged: tuple[Booleans, ...]  # per camera ``(frames, people, 3)`` bool of :data:`LIMBS`
    exchanges: tuple[SideExchange, ...]  # the same as stretches, by camera and time

    TASK = "sides"

    def __repr__(self) -> str:
        lines = [f"Sides({len(self.tracks)} cameras, {len(self.exchanges)} stretches exchanged)"]
        lines += [f"  camera {e.camera}: {e.limb} of person {e.person}, {e.start:.2f} to {e.end:.2f} s" for e in self.exchanges]
        return "\n".join([*lines, *(f"  note: {notice.text}" for notice in self.notices if notice.code is not SideNotice.MENDED)])


def correct_sides(
    tracks: Sequence[ArrayLike],
    cameras: Calibration,
    joints: Sequence[str],
    *,
    times: Sequence[ArrayLike] | None = None,
    weights: Sequence[ArrayLike] | None = None,
) -> SideCorrection:
    r"""Which cameras show left as right, when, and of which limb; and the tracks with that put right. tracks
    ``(frames, n, 2)``, times ``(frames,)`` (30 a second by default), weights ``(frames, n)``."""
    x, w, moments, people = _check_tracks(tracks, cameras, joints, times, weights)
    pairs = paired_joints(joints)
    untouched = tuple(np.zeros((len(one), people, len(LIMBS)), dtype=bool) for one in x)
    if not any(pairs.values()) or len(x) < 3:
        notices = [Notice(SideNotice.TWO if any(pairs.values()) else SideNotice.SIDELESS)]
        return SideCorrection(
            status=status_from(()), notices=tuple(notices), tracks=tuple(x), weights=tuple(w), exchanged=untouched, exchanges=()
        )  # fmt: skip
    grid, positions, trust = _resample(x, w, moments, cameras)
    exchanges: list[SideExchange] = []
    notices = []
    for person in range(people):
        rows = slice(person * len(joints), (person + 1) * len(joints))
        labels, costs = _decode_sides(positions[:, :, rows], trust[:, :, rows], _projections(cameras), pairs, grid)
        labels, tied = _clear_ties(labels, grid, person)
        notices += tied
        for camera, own in enumerate(moments):
            common = (own - _clock(cameras, camera)[0]) / _clock(cameras, camera)[1]
            place = np.clip(np.searchsorted(grid, common - 0.5 * (grid[1] - grid[0] if len(grid) > 1 else 1.0)), 0, len(grid) - 1)
            untouched[camera][:, person] = labels[place, camera]
            exchanges += _exchange_intervals(untouched[camera][:, person], costs[place, camera], own, camera, person, pairs)
    mended, trusted = _exchange_joints(x, w, untouched, pairs, len(joints))
    for one in exchanges:
        values = {"limb": one.limb, "person": one.person, "which": [one.camera], "start": one.start, "end": one.end}
        notices.append(Notice(SideNotice.MENDED, one.evidence, values))
    return SideCorrection(
        status=status_from(()),
        notices=tuple(notices),
        tracks=tuple(mended),
        weights=tuple(trusted),
        exchanged=untouched,
        exchanges=tuple(exchanges),
    )


def paired_joints(joints: Sequence[str]) -> dict[str, list[tuple[int, int]]]:
    """The joints that have a left and a right one, as pairs of numbers, by limb."""
    words = [canonical(joint) for joint in joints]
    out: dict[str, list[tuple[int, int]]] = {limb: [] for limb in LIMBS}
    for left, word in enumerate(words):
        other = word.replace("left", "right", 1)
        if "left" in word and words.count(word) == 1 and words.count(other) == 1:
            limb = "legs" if _LEGS.search(word) else "arms" if _ARMS.search(word) else "trunk"
            out[limb].append((left, words.index(other)))
    return out


# ----------------------------------------------------------------------------------------------------------------------
# What is given, at common moments.


def _check_tracks(
    tracks: Sequence[ArrayLike],
    cameras: Calibration,
    joints: Sequence[str],
    times: Sequence[ArrayLike] | None,
    weights: Sequence[ArrayLike] | None,
) -> tuple[list[Floats], list[Floats], list[Floats], int]:
    count = len(cameras.K)
    for name, values in (("tracks", tracks), ("times", times), ("weights", weights)):
        if values is not None and len(values) != count:
            raise ValueError(f"{name}: {len(values)} given, and there are {count} cameras; give one for each")
    x = [np.array(np.asarray(one), dtype=np.float64) for one in tracks]
    for k, one in enumerate(x):
        if one.ndim != 3 or one.shape[2] != 2 or not len(joints) or one.shape[1] % len(joints) or one.shape[1] != x[0].shape[1]:
            raise ValueError(
                f"tracks[{k}]: expected (frames, people * {len(joints)} joints, 2) with the same people in every camera, "
                f"got {one.shape}"
            )
    moments = [np.asarray(one, dtype=np.float64) for one in times or (np.arange(len(one)) / 30.0 for one in x)]
    w: list[Floats] = []
    for k, (given, own) in enumerate(zip(weights or (np.ones(one.shape[:2]) for one in x), x, strict=True)):
        trust: Floats = np.asarray(given, dtype=np.float64)
        if trust.shape != own.shape[:2]:
            raise ValueError(f"weights[{k}]: expected {own.shape[:2]} as the tracks have it, got {trust.shape}")
        w.append(np.where(np.isfinite(own).all(2), np.nan_to_num(np.clip(trust, 0.0, None)), 0.0))
    for k, (one, own) in enumerate(zip(moments, x, strict=True)):
        if one.shape != (len(own),) or not (np.diff(one) > 0).all():
            raise ValueError(f"times[{k}]: expected {len(own)} increasing seconds, got shape {one.shape}; give one for each frame")
    return x, w, moments, int(x[0].shape[1] // len(joints))


def _clock(cameras: Calibration, camera: int) -> tuple[float, float]:
    """Offset and rate of a camera's clock."""
    return float(cameras.clocks.offsets[camera]), float(cameras.clocks.rates[camera])


def _projections(cameras: Calibration) -> Floats:
    """``(c, 3, 4)`` of undistorted pixels."""
    return np.asarray((cameras.K @ torch.cat([cameras.R, cameras.t[..., None]], dim=-1)).numpy(), dtype=np.float64)


def _resample(
    x: Sequence[Floats], w: Sequence[Floats], moments: Sequence[Floats], cameras: Calibration
) -> tuple[Floats, Floats, Floats]:
    """Common moments ``(T,)``, undistorted positions ``(T, c, n, 2)`` px and trust ``(T, c, n)`` there, by the nearest frames."""
    common = [(one - _clock(cameras, k)[0]) / _clock(cameras, k)[1] for k, one in enumerate(moments)]
    steps = [float(np.median(np.diff(one))) for one in common if len(one) > 1]
    step = min(steps) if steps else 1.0
    first, last = min(float(one[0]) for one in common), max(float(one[-1]) for one in common)
    grid = first + step * np.arange(math.floor((last - first) / step + 1e-6) + 1)
    seen = np.full((len(grid), len(x), x[0].shape[1], 2), np.nan)
    trust = np.zeros(seen.shape[:3])
    for k, (own, at) in enumerate(zip(x, common, strict=True)):
        lens, matrix = cameras.distortion[k], cameras.K[k]
        flat = undistort(torch.from_numpy(own.reshape(1, -1, 2)), matrix[None], lens[None]).numpy().reshape(own.shape)
        after = np.clip(np.searchsorted(at, grid), min(1, len(at) - 1), len(at) - 1)
        before = np.maximum(after - 1, 0)
        nearest = np.where(grid - at[before] > at[after] - grid, after, before)
        off = grid - at[nearest]
        near = np.abs(off) <= MAX_FRAME_DISTANCE * step
        seen[:, k] = np.where(near[:, None, None], flat[nearest] + off[:, None, None] * _speeds(flat, at)[nearest], np.nan)
        trust[:, k] = np.where(near[:, None], w[k][nearest], 0.0)
    known = np.asarray(np.isfinite(seen).all(-1) & (trust > 0))
    return np.asarray(grid), np.asarray(np.where(known[..., None], seen, np.nan)), np.asarray(np.where(known, trust, 0.0))


def _speeds(x: Floats, times: Floats) -> Floats:
    """``(frames, n, 2)`` px per second of the body as a whole: the median of its joints over two steps, 0 where it is not known."""
    out = np.zeros_like(x)
    if len(x) < 3:
        return out
    change = (x[2:] - x[:-2]) / (times[2:] - times[:-2])[:, None, None]
    known = np.asarray(np.isfinite(change).all(-1))
    for frame in np.flatnonzero(known.any(1)):
        out[frame + 1] = np.median(change[frame][known[frame]], axis=0)
    return out


# ----------------------------------------------------------------------------------------------------------------------
# The evidence of three cameras, and the likeliest reading over time.


def _decode_sides(
    x: Floats, w: Floats, projections: Floats, pairs: dict[str, list[tuple[int, int]]], grid: Floats
) -> tuple[Booleans, Floats]:
    """Who exchanges what ``(T, c, limbs)``, and the nats that speak for it, ``(T, c, limbs)``."""
    count = x.shape[1]
    step = float(grid[1] - grid[0]) if len(grid) > 1 else 1.0
    states = np.array(list(product((0, 1), repeat=count)), dtype=np.int64)
    energy = {limb: _energy(x, w, projections, pairs[limb], states, step) for limb in LIMBS}
    body = sum(energy.values()) + EXCHANGE_COST * step * states.sum(1)
    body_states = _viterbi(body, states, SWITCH_COST)
    labels = np.zeros((len(x), count, len(LIMBS)), dtype=bool)
    costs = np.zeros(labels.shape)
    for k, limb in enumerate(LIMBS):
        num_different = (states[None] != states[body_states][:, None]).sum(2)
        total = energy[limb] + EXCHANGE_COST * step * states.sum(1) + LIMB_COST * step * num_different
        limb_states = _viterbi(total, states, SWITCH_COST) if pairs[limb] else body_states
        labels[:, :, k] = states[limb_states] > 0
        for camera in range(count):
            turned = limb_states ^ (1 << (count - 1 - camera))
            rows = np.arange(len(x))
            costs[:, camera, k] = energy[limb][rows, turned] - energy[limb][rows, limb_states]
    return labels, costs


def _energy(
    x: Floats,
    w: Floats,
    projections: Floats,
    pairs: Sequence[tuple[int, int]],
    states: Integers,
    step: float,
) -> Floats:
    """Nats ``(T, states)`` against each reading of all cameras, by all joints that have two sides."""
    out = np.zeros((len(x), len(states)))
    if not pairs:
        return out
    left, right = (np.array(side) for side in zip(*pairs, strict=True))
    sides_ = np.stack([x[:, :, left], x[:, :, right]]), np.stack([w[:, :, left], w[:, :, right]])
    triples = list(combinations(range(x.shape[1]), 3))
    every = max(1, math.ceil(len(triples) / MAX_TRIPLES))
    triples = triples[::every]
    worth = INDEPENDENT_LIMB_JOINTS / max(1, len(pairs)) * min(1.0, step / CORRELATION_SECONDS) / len(triples) * x.shape[1]
    for triple in triples:
        size = _size(x[:, triple])
        costs = {}
        for sign in product((0, 1), repeat=3):  # which side each camera calls left
            points = np.stack([sides_[0][s, :, c] for s, c in zip(sign, triple, strict=True)], axis=1)
            trust = np.stack([sides_[1][s, :, c] for s, c in zip(sign, triple, strict=True)], axis=1)
            costs[sign] = _reprojection_cost(points, trust, projections[list(triple)], size)
        for sign in ((0, 0, 0), (0, 0, 1), (0, 1, 0), (1, 0, 0)):
            other = tuple(1 - s for s in sign)
            cost = worth * (costs[sign] + costs[other])
            own = states[:, triple]
            fits = (own == sign).all(1) | (own == other).all(1)
            out += cost[:, None] * fits
    return out


def _size(x: Floats) -> float:
    """px: the usual diagonal of the person in these cameras."""
    known = np.isfinite(x)
    low, high = np.where(known, x, np.inf).min(2), np.where(known, x, -np.inf).max(2)
    extent = np.linalg.norm(high - low, axis=-1)
    seen = extent[np.isfinite(extent) & (extent > 0)]
    return float(np.median(seen)) if seen.size else 1.0


def _reprojection_cost(x: Floats, w: Floats, projections: Floats, size: float) -> Floats:
    """Nats ``(T,)``: robust reprojection error of points triangulated from three cameras, over the joints that all three see."""
    known: Booleans = np.asarray(np.isfinite(x).all((1, 3)) & (w > 0).all(1))
    filled = np.where(np.isfinite(x), x, 0.0)
    rows = filled[..., None] * projections[None, :, None, None, 2] - projections[None, :, None, :2]
    rows = rows / np.linalg.norm(rows[..., :3], axis=-1, keepdims=True).clip(1e-12)
    normal, aim = rows[..., :3], -rows[..., 3]
    gram = np.einsum("tcjki,tcjkl->tjil", normal, normal) + 1e-12 * np.eye(3)
    points = np.linalg.solve(gram, np.einsum("tcjki,tcjk->tji", normal, aim)[..., None])[..., 0]
    seen = np.einsum("cik,tjk->tcji", projections[..., :3], points) + projections[None, :, None, :, 3]
    flat = seen[..., :2] / np.where(np.abs(seen[..., 2:]) > 1e-9, seen[..., 2:], 1e-9)
    square = np.square(flat - filled).sum(-1)
    # a point behind a camera is nowhere right
    square = np.asarray(np.where(seen[..., 2] > 0, square, np.inf)).sum(1) / 3
    sigma = JOINT_SIGMA * size
    cost = np.minimum(np.log1p(square / (DEGREES_OF_FREEDOM * sigma**2)) * (DEGREES_OF_FREEDOM + 3) / 2, MAX_JOINT_EVIDENCE)
    trust = np.cbrt(np.where(known[:, None], w, 1.0).prod(1))
    return np.asarray(np.where(known, cost * trust, 0.0)).sum(1)


def _viterbi(energy: Floats, states: Integers, change: float) -> Integers:
    """``(T,)`` the readings of least total, with a cost for every camera that changes."""
    count = states.shape[1]
    totals = np.zeros_like(energy)
    total = energy[0] if len(energy) else energy
    for frame in range(len(energy)):
        if frame:
            spread = total.copy()
            for bit in range(count):  # one camera after the other may change
                turned = np.arange(len(states)) ^ (1 << bit)
                spread = np.minimum(spread, spread[turned] + change)
            total = spread + energy[frame]
        totals[frame] = total
    out = np.zeros(len(energy), dtype=np.int64)
    for frame in range(len(energy) - 1, -1, -1):
        onward = change * (states != states[out[frame + 1]]).sum(1) if frame + 1 < len(energy) else 0.0
        out[frame] = int(np.round(totals[frame] + onward, 9).argmin())
    return out


def _clear_ties(labels: Booleans, grid: Floats, person: int) -> tuple[Booleans, list[Notice]]:
    """Without the exchanges that nothing tells from those of the other cameras: as many here as there, before and after, too."""
    out, notices = labels.copy(), []
    count = labels.shape[1]
    for k, limb in enumerate(LIMBS):
        for start, end in _runs(2 * labels[:, :, k].sum(1) == count):
            # cameras that change at the ends of the stretch, and how many would if the others were the exchanged ones
            ends = [labels[at, :, k] != labels[at - 1, :, k] for at in (start, end) if 0 < at < len(labels)]
            if sum(int(one.sum()) for one in ends) < sum(count - int(one.sum()) for one in ends):
                continue
            out[start:end, :, k] = False
            if grid[end - 1] - grid[start] >= MIN_TIE_SECONDS:
                values = {"limb": limb, "person": person, "start": float(grid[start]), "end": float(grid[end - 1])}
                notices.append(Notice(SideNotice.TIED, float(end - start), values))
    return out, notices


def _runs(there: Booleans) -> list[tuple[int, int]]:
    steps = np.flatnonzero(np.diff(np.concatenate([[0], there.astype(np.int64), [0]])))
    return [(int(a), int(b)) for a, b in zip(steps[::2], steps[1::2], strict=True)]


def _exchange_intervals(
    exchanged: Booleans, costs: Floats, times: Floats, camera: int, person: int, pairs: dict[str, list[tuple[int, int]]]
) -> list[SideExchange]:
    """Exchanges of a person in a camera ``(frames, limbs)`` as stretches; of all limbs together as those of the body."""
    there = [k for k, limb in enumerate(LIMBS) if pairs[limb]]
    body = exchanged[:, there].all(1)
    exchanges = []
    for limb, which, chosen in (
        ("body", body, there),
        *((LIMBS[k], exchanged[:, k] & ~body, [k]) for k in there),
    ):
        for start, end in _runs(np.asarray(which)):
            evidence = float(costs[start:end][:, chosen].sum())
            exchanges.append(SideExchange(camera, person, limb, float(times[start]), float(times[end - 1]), evidence))
    return sorted(exchanges, key=lambda one: (one.start, one.limb))


def _exchange_joints(
    x: Sequence[Floats], w: Sequence[Floats], exchanged: Sequence[Booleans], pairs: dict[str, list[tuple[int, int]]], joints: int
) -> tuple[list[Floats], list[Floats]]:
    """Positions and weights with left and right in their places."""
    tracks, weights = [one.copy() for one in x], [one.copy() for one in w]
    for camera, flags in enumerate(exchanged):
        for person, (k, limb) in product(range(flags.shape[1]), enumerate(LIMBS)):
            rows = np.flatnonzero(flags[:, person, k])
            for left, right in pairs[limb]:
                a, b = person * joints + left, person * joints + right
                for values in (tracks[camera], weights[camera]):
                    values[rows, a], values[rows, b] = values[rows, b].copy(), values[rows, a].copy()
    return tracks, weights
