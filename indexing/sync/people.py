"""Which person of one camera is which of the other: every likely pairing is tried, and the evidence decides."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from dyntorch import Shift
from dyntorch.core import Notice, status_from
from indexing.clip import Clip
from indexing.joints import has_names, places
from indexing.skeleton import Skeleton, usual_layout
from indexing.sync.recordings import FloatArray, SyncNotice, Take, accepted_notices

Solve = Callable[[Clip, Clip], Shift]


@dataclass(frozen=True, eq=False)
class Pairing:
    """One person of each camera, and what they say."""

    shift: Shift
    people: tuple[int, int]
    rivals: tuple[float, ...] = ()
    sound: Shift | None = None

    @property
    def offset_at_center(self) -> float:
        """Seconds between the clocks in the middle of the overlap."""
        return float(self.shift.at(self.shift.center)) - self.shift.center


NUM_THOROUGH_PAIRINGS = 3  # Pairings that are tried thoroughly where a fast look accepts none.


def match_people(a: Take, b: Take, solve: Solve, trial: Solve) -> Pairing:
    """The pairing of people on which the evidence is best."""
    every = sorted(((i, j) for i in range(len(a.people)) for j in range(len(b.people))), key=sum)
    if len(every) == 1:
        return Pairing(solve(a.people[0], b.people[0]), (0, 0))
    frame = 1.0 / min(a.fps, b.fps)
    found: list[Pairing] = []
    for i, j in every:
        found.append(Pairing(trial(a.people[i], b.people[j]), (i, j)))
        if backing(found[-1], found, frame) > 1:  # two people of each camera say the same
            break
    # the last word on the winner, or where none is sure, on the likeliest
    likely: list[tuple[Pairing, tuple[float, ...]]] = [decide(found, frame)]
    if not any(pairing.shift.ok for pairing in found):
        likely = [(pairing, ()) for pairing in sorted(found, key=lambda each: -each.shift.confidence)[:NUM_THOROUGH_PAIRINGS]]
    again = [Pairing(solve(a.people[i], b.people[j]), (i, j), rivals) for (i, j), rivals in ((p.people, r) for p, r in likely)]
    best, rivals = (again[0], again[0].rivals) if len(again) == 1 else decide(again, frame)
    shift = best.shift
    chosen = [f"{person_label(take, i)} of {take.name}" for take, i in zip((a, b), best.people, strict=True)]
    note = Notice(SyncNotice.PEOPLE, float(len(found)), {"first": chosen[0], "second": chosen[1]})
    shift = dataclasses.replace(shift, notices=(*shift.notices, note))
    if rivals:
        listed = " and ".join(f"{rival:+.3f} s" for rival in rivals[:2])
        limits = (Notice(SyncNotice.PAIRINGS, shift.offset, {"rivals": listed}), *accepted_notices(shift))
        shift = dataclasses.replace(shift, status=status_from(limits), notices=limits)
    return Pairing(shift, best.people, rivals)


def backing(one: Pairing, found: Sequence[Pairing], frame: float) -> int:
    """How many pairings of other people, and this one, are sure of its offset."""
    others = [other for other in found if not set(enumerate(one.people)) & set(enumerate(other.people))]
    return one.shift.ok + sum(one.shift.ok and other.shift.ok and not contradict(one, other, frame) for other in others)


OFFSET_TOLERANCE_FRAMES = 2.0  # Within this two answers are the same,
OFFSET_TOLERANCE_SIGMAS = 3  # beside the sum of their standard deviations times this.


def contradict(one: Pairing, other: Pairing, frame: float) -> bool:
    """Whether two answers differ by more than what both leave open."""
    return abs(one.offset_at_center - other.offset_at_center) > OFFSET_TOLERANCE_FRAMES * frame + OFFSET_TOLERANCE_SIGMAS * (
        one.shift.sigma + other.shift.sigma
    )


def person_label(take: Take, index: int) -> str:
    """A person of a camera in words."""
    person = take.people[index].meta.get("person")
    return "the largest person of each frame" if person is None else f"person {person}"


MIN_CONFIDENCE_RATIO = 0.5  # Confidence over that of the best pairing below which an answer is no rival.


def decide(found: Sequence[Pairing], frame: float) -> tuple[Pairing, tuple[float, ...]]:
    """The best pairing, and the offsets of those that contradict it."""
    behind = {id(pairing): backing(pairing, found, frame) for pairing in found}
    ranked = sorted(found, key=lambda pairing: (-behind[id(pairing)], -pairing.shift.confidence))
    best = ranked[0]
    rivals = [
        pairing.offset_at_center
        for pairing in ranked[1:]
        if behind[id(pairing)] >= max(1, behind[id(best)])
        and pairing.shift.confidence >= MIN_CONFIDENCE_RATIO * best.shift.confidence
        and contradict(best, pairing, frame)
    ]
    return best, tuple(rivals)


MIN_COMMON_JOINTS = 8  # Joints of the same name in two layouts, to compare them as the same points.


def common_joints(a: Clip, b: Clip) -> tuple[Clip, Clip, bool, str]:
    """Both clips with the joints that they have in common, whether these correspond, and what to say about it."""
    first, second = a.skeleton, b.skeleton
    count = a.joints.shape[1], b.joints.shape[1]
    if first is None or second is None or first.joints == second.joints:
        if count[0] == count[1]:
            return a, b, True, ""
    else:
        there = [(i, j) for i, j in enumerate(places(second, first)) if j >= 0] if has_names(first) and has_names(second) else []
        if len(there) >= MIN_COMMON_JOINTS:
            both = tuple(first.joints[i] for i, _ in there)
            said = f"{first.name} and {second.name} share {len(there)} joints; these are compared"
            return _only(a, [i for i, _ in there], both), _only(b, [j for _, j in there], both), True, said
    names = [clip.skeleton.name if clip.skeleton is not None else f"{n} joints" for clip, n in zip((a, b), count, strict=True)]
    return a, b, False, f"different joints ({names[0]}, {names[1]}): compared as different points, which needs longer takes"


def _only(clip: Clip, index: list[int], names: tuple[str, ...]) -> Clip:
    confidence = None if clip.confidence is None else clip.confidence[:, index]
    return clip.replace(joints=clip.joints[:, index], confidence=confidence, skeleton=Skeleton("common joints", names))


# Epipolar distance over the usual one that makes a stretch of another person: of one person it stays below 1.5.
MAX_DISTANCE_RATIO = 2.0
MIN_STRETCH_SECONDS = 0.25  # Duration of such a stretch.


def disagreements(a: Clip, b: Clip, shift: Shift) -> list[tuple[float, float, float]]:
    """Stretches in which both do not show the same person: start and end on a's clock, and how many times the usual distance."""
    if shift.fundamental is None:
        return []
    distance = _running_median(_distances(a, b, shift), round(MIN_STRETCH_SECONDS / 2 * float(a.fps or 30.0)))
    usual = float(np.nanmedian(distance)) if np.isfinite(distance).any() else 0.0
    if not usual > 0:
        return []
    far = np.nan_to_num(distance / usual) > MAX_DISTANCE_RATIO
    steps = np.flatnonzero(np.diff(np.concatenate([[0], far.astype(int), [0]])))
    found = []
    for start, end in zip(steps[::2], steps[1::2], strict=True):
        if a.times[end - 1] - a.times[start] >= MIN_STRETCH_SECONDS:
            found.append((float(a.times[start]), float(a.times[end - 1]), float(distance[start:end].max()) / usual))
    return found


MIN_VISIBLE_JOINTS = 4  # Joints that must be visible for a frame to be judged.
MAX_STEP_OF_BOX = 0.5  # Box diagonals from one frame to the next that make another person.


def jumps(clip: Clip) -> list[float]:
    """When the person is somewhere else from one frame to the next, and not back at once: seconds."""
    steps = np.diff(clip.times) <= 1.5 / float(clip.fps or 30.0)
    apart = np.linalg.norm(np.diff(clip.joints, axis=0), axis=2)
    low, high = (
        edge(np.where(np.isfinite(clip.joints), clip.joints, fill), axis=1) for edge, fill in ((np.min, np.inf), (np.max, -np.inf))
    )
    size = np.linalg.norm(high - low, axis=1)
    known = steps & (np.isfinite(apart).sum(axis=1) >= MIN_VISIBLE_JOINTS) & np.isfinite(size[1:]) & np.isfinite(size[:-1])
    moved = np.nanmedian(apart[known], axis=1) > MAX_STEP_OF_BOX * np.maximum(size[1:], size[:-1])[known]
    times = clip.times[1:][known][moved]
    alone = np.diff(times, prepend=-np.inf, append=np.inf) >= MIN_STRETCH_SECONDS  # a false detection leaves and comes back
    return [float(time) for time in times[alone[1:] & alone[:-1]]]


def _running_median(values: FloatArray, half: int) -> FloatArray:
    """Running median over ``2 half + 1`` values; NaN where fewer than half of them are known."""
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(values, half, constant_values=np.nan), 2 * half + 1)
    enough = np.isfinite(windows).sum(axis=1) > half
    out = np.full(len(values), np.nan)
    if enough.any():
        out[enough] = np.nanmedian(windows[enough], axis=1)
    return out


def _distances(a: Clip, b: Clip, shift: Shift) -> FloatArray:
    """``(frames,)`` of a; NaN where fewer than ``MIN_VISIBLE_JOINTS`` joints can be compared."""
    assert shift.fundamental is not None
    matrix = shift.fundamental.detach().cpu().numpy().astype(np.float64)
    moments = shift.at(0.0).item() + shift.rate * a.times
    after = np.clip(np.searchsorted(b.times, moments), 1, len(b) - 1) if len(b) > 1 else np.zeros(len(a), dtype=np.int64)
    before = np.maximum(after - 1, 0)
    width = np.maximum(b.times[after] - b.times[before], 1e-12)
    share = (moments - b.times[before]) / width
    inside = (share >= 0) & (share <= 1) & (width <= 1.5 / shift.fps[1])
    other = b.joints[before] + share[:, None, None] * (b.joints[after] - b.joints[before])
    there = np.where(inside[:, None, None], other, np.nan)
    one = np.ones((*a.joints.shape[:2], 1))
    xa, xb = np.concatenate([a.joints, one], axis=2), np.concatenate([there, one], axis=2)
    la, lb = xb @ matrix, xa @ matrix.T
    size = np.square(la[..., :2]).sum(axis=2) + np.square(lb[..., :2]).sum(axis=2)
    distance = np.abs((xb * lb).sum(axis=2)) / np.sqrt(np.maximum(size, 1e-300))
    enough = np.isfinite(distance).sum(axis=1) >= MIN_VISIBLE_JOINTS
    out = np.full(len(a), np.nan)
    if enough.any():
        out[enough] = np.nanmedian(distance[enough], axis=1)
    return out


def joint_names(a: Take, b: Take, people: tuple[int, int]) -> tuple[str, ...]:
    """Names of the joints that were compared; none where they do not correspond or nobody knows their names."""
    if not (a.people and b.people):
        return ()
    first, _, same, _ = common_joints(a.people[people[0]], b.people[people[1]])
    layout = first.skeleton or usual_layout(first.joints.shape[1])
    return layout.joints if same and layout is not None else ()
