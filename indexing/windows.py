"""Clips -> batched windows: every window is resampled uniformly in seconds, with missing joints interpolated in time.

All clips are handled together as one ragged array (frames of all clips end to end), so there is no loop over windows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dyntorch.numerics import native_deviations
from indexing.cameras import y_up
from indexing.clip import GAP, RARE, Clip, FloatArray, stretches

# ----------------------------------------------------------------------------------------------------------------------
# Joints that a detector put in the wrong place: found against the joint's own path in time, safe on clean data.
#
# A wrong joint is far from where the joint's neighbouring sightings say it was.  How far is far, a recording says itself: its
# own deviations, which grow with the noise, with the speed of the movement and with the gaps between frames.


# How far windows are from those of uncorrupted clips, in % of their deviation, Florence3D at 90 degrees.  As they are: 5 % wrong
# joints 33, 10 % 47, bursts of three 39, half the frames dropped 8.6.  Repaired so: 7.4, 14, 19, 8.9, and clean clips .09.

NUM_COMPARED = 9  # sightings of one joint: 7 finds more (6.2) and fails in bursts (23), 11 finds less (9.1)
MAX_SPREADS = 4.0  # of the neighbours, up to which a sighting is right: 6 finds less (8.6)
MAX_USUAL_FACTOR = 8.0  # times the deviation of most joints, added to that; 3 takes movement for error where frames are dropped
USUAL_SHARE = 0.8  # of all joints, that stays below that deviation
NOISE_FLOOR = 0.01  # of the body: smaller steps are the noise of every detector
MIN_SIGHTINGS = 5  # among fewer nobody can say which is wrong
NUM_PASSES = 2  # the second sees past what the first took out: bursts 21 -> 19; a third adds nothing
MAX_FRAMES_JUDGED = 9000  # of a long recording at once: 5 minutes at 30 per second
MAX_LEAVING_FACTOR = 3.0  # times the usual distance from the middle of its neighbours, in the faster test (``stride`` > 1)
REPAIR_CHUNK = 20_000  # sightings at once: bounds memory


def wrong_joints(joints: FloatArray, times: FloatArray, starts: NDArray[np.intp], stride: int = 1) -> NDArray[np.bool_]:
    r"""Sightings that do not lie on their joint's path. joints ``(frames of all, joints, dims)``, times ``(frames of all,)``,
    starts ``(clips + 1,)`` -> ``(frames of all, joints)``.

    ``stride``: the usual deviation is taken from every n-th sighting; above 1, the others are judged only near those that leave the
    middle of their neighbours.  8 takes a third of the time on clean clips and finds the same but for .5 %."""
    there = _every(np.isfinite(joints))
    clip_of = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    floor = NOISE_FLOOR * _sizes(joints, there, starts)
    wrong, asked, usual = np.zeros_like(there), there, np.zeros_like(floor)
    by_joint = joints.swapaxes(0, 1).reshape(-1, joints.shape[2])
    for once in range(NUM_PASSES):
        # every joint's sightings in every clip, one path after the other
        joint, frame = np.nonzero(np.ascontiguousarray((there & ~wrong).T))
        clip, path = clip_of.take(frame), joint * len(joints) + frame
        cuts = np.concatenate([[0], np.flatnonzero((clip[1:] != clip[:-1]) | (joint[1:] != joint[:-1])) + 1, [len(clip)]])
        long = (np.diff(cuts) >= MIN_SIGHTINGS).repeat(np.diff(cuts))
        judged, places = asked.T.reshape(-1).take(path) & long, by_joint.take(path, axis=0)
        if once == 0 and stride > 1:
            judged &= (np.arange(len(joint)) % stride == 0) | _near_leaving(places, times.take(frame), floor.take(clip))
        rows = np.flatnonzero(judged)
        far, spread = _deviations(places, times.take(frame), rows, cuts, NUM_COMPARED)
        beyond, owner = reduce(np.maximum, (far - MAX_SPREADS * spread).T), clip.take(rows)
        bad = beyond > floor.take(owner)
        if once == 0:
            # a usual deviation that is larger than this leaves no sighting wrong, whatever it is
            limit = np.zeros_like(floor)
            np.maximum.at(limit, owner[bad], (beyond[bad] - floor[owner[bad]]) / MAX_USUAL_FACTOR)
            sampled = slice(None, None, None) if stride == 1 else rows % stride == 0
            usual = MAX_USUAL_FACTOR * _share(reduce(np.maximum, far.T)[sampled], owner[sampled], limit, USUAL_SHARE)
        bad &= beyond > (usual + floor).take(owner)
        if not bad.any():
            break
        wrong[frame[rows[bad]], joint[rows[bad]]] = True
        # whoever had a wrong neighbour is asked once more
        changed = np.zeros(len(joint) + 1, dtype=np.intp)
        changed[rows[bad] + 1] = 1
        first, last = changed.cumsum()[_around(cuts, NUM_COMPARED).T]
        touched, asked = last > first, np.zeros_like(there)
        asked[frame[touched], joint[touched]] = True
    return wrong


def repair_clip(clip: Clip, stride: int = 1) -> Clip:
    """A clip of any length without its wrong joints; judged in parts, which bounds memory, between gaps."""
    half = MAX_FRAMES_JUDGED // 2
    pieces = [np.arange(begin, max(end - half, begin + 1), MAX_FRAMES_JUDGED) for begin, end in stretches(clip.times).tolist()]
    parts = np.append(np.concatenate(pieces), len(clip))
    wrong = wrong_joints(clip.joints, clip.times, parts, stride)
    if not wrong.any():
        return clip
    joints = clip.joints.copy()
    joints[wrong] = np.nan
    return clip.replace(joints=joints)


def _around(cuts: NDArray[np.intp], width: int) -> NDArray[np.intp]:
    """``(sightings, 2)`` the first and the end of the nearest sightings on the same path, ``width`` where it has so many; paths lie
    between cuts ``(paths + 1,)``."""
    begin, end = (one.repeat(np.diff(cuts)) for one in (cuts[:-1], cuts[1:]))
    first = np.maximum(np.minimum(np.arange(cuts[-1]) - width // 2, end - width), begin)
    return np.stack([first, np.minimum(first + width, end)], axis=1)


def _near_leaving(places: FloatArray, times: FloatArray, floor: FloatArray) -> NDArray[np.bool_]:
    """``(sightings,)`` whether one that leaves the middle of those before and after it is among the neighbours compared."""
    count = len(places)
    if count < 3:
        return np.ones(count, dtype=bool)
    span = times[2:] - times[:-2]
    inside = span > 0  # within one path: the clock of another one starts anew
    share = np.where(inside, (times[1:-1] - times[:-2]) / np.where(inside, span, 1.0), 0.0)[:, None].astype(places.dtype)
    leaves = np.abs(places[1:-1] - places[:-2] - share * (places[2:] - places[:-2])).max(axis=1)
    usual = np.quantile(leaves[inside], USUAL_SHARE) if inside.any() else 0.0
    marked = np.ones(count, dtype=bool)
    marked[1:-1] = ~inside | (leaves > MAX_LEAVING_FACTOR * usual + floor[1:-1] / 2)
    total = np.concatenate([[0], np.cumsum(marked)])
    reach = NUM_COMPARED // 2 + 1
    index = np.arange(count)
    return np.asarray(total[np.minimum(index + reach + 1, count)] > total[np.maximum(index - reach, 0)])


def _deviations(
    places: FloatArray, times: FloatArray, rows: NDArray[np.intp], cuts: NDArray[np.intp], width: int
) -> tuple[FloatArray, FloatArray]:
    """``(rows, dims)`` distance of sightings from the robust line through their neighbours, and the neighbours' spread."""
    far, spread = (np.empty((len(rows), places.shape[1]), np.float32) for _ in range(2))
    if native_deviations(places, times, rows, cuts, width, (far, spread)):
        return far, spread
    around = _around(cuts, width)[rows]
    x, clock = torch.from_numpy(places), torch.from_numpy(times)
    steps, lags = torch.arange(width), range(2, width)  # neighbours further apart than one step
    for at in range(0, len(rows), REPAIR_CHUNK):
        some = torch.from_numpy(rows[at : at + REPAIR_CHUNK])
        first, end = torch.from_numpy(around[at : at + REPAIR_CHUNK]).T[..., None]
        index = (first + steps).clamp_(max=len(x) - 1)
        near = torch.where((first + steps < end)[..., None], x[index], torch.nan).mT.contiguous()
        since = (clock[index] - clock[some, None]).to(x)[:, None]
        rises, runs = (torch.cat([one[..., lag:] - one[..., :-lag] for lag in lags], dim=-1) for one in (near, since))
        slope = _median(rises / runs).nan_to_num()
        remainder = near - slope * since
        middle = _median(remainder)
        far[at : at + REPAIR_CHUNK] = (x[some] - middle[..., 0]).abs().numpy()
        spread[at : at + REPAIR_CHUNK] = 1.4826 * _median((remainder - middle).abs())[..., 0].numpy()
    return far, spread


def _median(values: Tensor) -> Tensor:
    """The lower median of the last axis, without NaN.  Sorted by numpy: 28 numbers take 70 ns, torch's ``nanmedian`` 530."""
    ordered = torch.from_numpy(np.sort(values.numpy(), axis=-1))  # NaN comes last
    if not bool(ordered[..., -1].isnan().any()):
        return ordered[..., (ordered.shape[-1] - 1) // 2, None]
    there = ordered.isnan().logical_not_().sum(dim=-1, keepdim=True)
    return ordered.gather(-1, (there - 1).clamp_(min=0) // 2)


def _every(values: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """All of the last axis, which is short: its columns are combined, which is ten times faster than ``all``."""
    return np.asarray(reduce(np.logical_and, np.moveaxis(values, -1, 0)))


def _sorted_by_clip(values: FloatArray, clip: NDArray[np.intp]) -> NDArray[np.float32]:
    """Values of at least 0, those of each clip together and ascending: the bits of such numbers have their order."""
    keys = clip.astype(np.uint64) << np.uint64(32) | values.astype(np.float32).view(np.uint32)
    return np.sort(keys).astype(np.uint32).view(np.float32)


def _share(far: FloatArray, clip: NDArray[np.intp], limit: FloatArray, share: float) -> FloatArray:
    """``(clips,)`` the deviation that a share of the clip's sightings stays below; infinite where that is not below ``limit``."""
    counts = np.bincount(clip, minlength=len(limit))
    place = np.minimum((share * counts).astype(np.intp), np.maximum(counts - 1, 0))
    asked = (np.bincount(clip[far < limit.take(clip)], minlength=len(limit)) > place) & (counts > 0)
    some = asked.take(clip)
    counts = np.where(asked, counts, 0)
    ordered = np.append(_sorted_by_clip(far[some], clip[some]), np.inf)
    return np.where(asked, ordered[np.where(asked, np.cumsum(counts) - counts + place, -1)], np.where(limit > 0, np.inf, 0.0))


def _sizes(joints: FloatArray, there: NDArray[np.bool_], starts: NDArray[np.intp]) -> FloatArray:
    """``(clips,)`` median extent of the body over a clip's frames, along its longer side."""
    seen = there.any(axis=1)
    clip = np.repeat(np.arange(len(starts) - 1), np.diff(starts))[seen]
    counts = np.bincount(clip, minlength=len(starts) - 1)
    first, sizes = np.cumsum(counts) - counts, np.zeros(len(counts))
    for axis in range(joints.shape[2]):
        values = np.ascontiguousarray(joints[seen, :, axis].T)  # extremes over the first axis are found in whole rows
        known = there[seen].T
        extent = np.where(known, values, -np.inf).max(axis=0) - np.where(known, values, np.inf).min(axis=0)
        ordered = np.append(_sorted_by_clip(extent, clip), 0.0)
        middle = 0.5 * (ordered[first + np.maximum(counts - 1, 0) // 2] + ordered[first + counts // 2])
        sizes = np.where(counts > 0, np.maximum(sizes, middle), 0.0)
    return sizes


SUBSAMPLES = 4  # box average per step: a cheap denoiser; 1 costs about 1 % accuracy at 15 mm noise
CHUNK = 16_000_000  # numbers interpolated at once: bounds memory whatever the number of windows
SLOWEST = 10.0  # seconds between the frames of a clip: farther apart, times are not seconds


@dataclass(frozen=True)
class Ragged:
    """Frames of many clips end to end, y up, missing joints filled in time."""

    joints: FloatArray  # (frames of all, joints, dims)
    times: FloatArray  # (frames of all,)
    starts: NDArray[np.intp]  # (clips + 1,)
    seen: NDArray[np.bool_]  # (clips, joints): seen at least once; the others are zeros in `joints`


def concatenate_clips(clips: Sequence[Clip], repair: bool = False) -> Ragged:
    """Lay clips end to end and fill what is missing by linear interpolation in time, joint by joint."""
    joints = np.concatenate([y_up(clip) for clip in clips]).astype(np.float32)
    times = np.concatenate([clip.times for clip in clips])
    lengths = np.array([len(clip) for clip in clips])
    starts = np.concatenate([[0], np.cumsum(lengths)])
    if repair:
        joints[wrong_joints(joints, times, starts)] = np.nan
    return interpolate_gaps(joints, times, starts)


def interpolate_gaps(joints: FloatArray, times: FloatArray, starts: NDArray[np.intp]) -> Ragged:
    """Stretches that lie end to end, y up, with what is missing interpolated; arguments as in :class:`Ragged`, NaN = not seen."""
    there = _every(np.isfinite(joints))
    seen = np.logical_or.reduceat(there, starts[:-1], axis=0)
    if not there.all():
        lengths = np.diff(starts)
        joints = _fill(joints, there, times, np.repeat(starts[:-1], lengths), np.repeat(starts[1:], lengths))
    return Ragged(joints, times, starts, seen)


def _fill(joints: FloatArray, there: NDArray[np.bool_], times: FloatArray, first: FloatArray, last: FloatArray) -> FloatArray:
    """Linear interpolation in time between the sightings of each joint inside its own clip; zeros where there is none."""
    frame = np.arange(len(joints))[:, None]
    before = np.maximum.accumulate(np.where(there, frame, -1), axis=0)
    after = np.minimum.accumulate(np.where(there, frame, len(joints))[::-1], axis=0)[::-1]
    no_before, no_after = before < first[:, None], after >= last[:, None]
    before, after = np.where(no_before, after, before), np.where(no_after, before, after)
    nothing = no_before & no_after
    before, after = np.where(nothing, 0, before), np.where(nothing, 0, after)
    span = times[after] - times[before]
    weight = np.where(span > 0, (times[:, None] - times[before]) / np.where(span > 0, span, 1.0), 0.0).astype(joints.dtype)
    column = np.arange(joints.shape[1])[None]
    low, high = joints[before, column], joints[after, column]
    filled = low + weight[..., None] * (high - low)
    filled[nothing] = 0.0
    return np.where(there[..., None], joints, filled)


def check_clips(
    clips: Sequence[Clip],
    joints: int | None = None,
    items: Sequence[int] | None = None,
    fewest: int = 2,
    recordings: bool = False,
) -> None:
    """Raise where a clip cannot be compared."""
    expected = joints if joints is not None else clips[0].joints.shape[1]
    for i, clip in enumerate(clips):
        reason = ""
        if clip.joints.shape[1] != expected:
            other = "the fitted clips have" if joints is not None else "clip 0 has"
            reason = f"joints: {clip.joints.shape[1]} joints, but {other} {expected}; use clips of one joint layout"
        elif unusable := describe_unusable(clip, fewest):
            reason = f"joints: {unusable}; leave the clip out"
        elif not recordings and (gap := describe_gap(clip)):
            reason = f"times: {gap}"
        if reason:
            who = f"clip {i if items is None else items[i]}" + (f" ({clip.name!r})" if clip.name else "")
            raise ValueError(f"{who}: {reason}")


def describe_gap(clip: Clip) -> str | None:
    """Why a clip's times are not those of one performance, and what to do, or ``None``."""
    if clip.duration <= GAP or (steps := np.diff(clip.times)).max() <= GAP:
        return None
    usual, longest = float(np.median(steps)), int(steps.argmax())
    if usual > SLOWEST:
        return f"its frames are {usual:.3g} s apart; times are seconds: correct them, or fps"
    pauses = steps[steps > max(GAP, RARE * usual)]
    if len(pauses) and pauses.sum() > clip.duration / 2:
        more = f", with {len(pauses) - 1} pauses more" * (len(pauses) > 1)
        return (
            f"no frames for {steps[longest]:.3g} s after {clip.times[longest]:.6g} s, which is most of the clip{more}; a clip is "
            "one performance: cut it there"
        )
    return None


def describe_unusable(clip: Clip, fewest: int = 2, point: bool = False) -> str | None:
    """Why a clip cannot be compared with others, or ``None``; ``fewest``: frames it must have; ``point``: one joint is enough."""
    if len(clip) < fewest:
        return "one frame only, but an action needs at least two"
    if clip.joints.shape[1] == 1 and not point:
        return "one tracked point, but an action is of joints that move against each other"
    pose = clip.joints[0]
    if np.isfinite(pose.sum()) and pose[0].tolist() != pose[-1].tolist():
        return None  # the common case, without looking at every frame
    if not clip.seen.any():
        return "no joint was seen in any frame (all NaN)"
    first = clip.joints[clip.seen]
    if (first == first[0]).all():
        return f"all joints are at one place in all frames (all {first[0, 0]:g})"
    return None


def sample(source: Ragged, owner: NDArray[np.intp], start: FloatArray, end: FloatArray, length: int) -> Tensor:
    """Windows resampled to ``length`` steps, each the box average of its time slot. owner ``(windows,)``, start, end
    ``(windows,)`` -> ``(windows, length, joints, dims)``."""
    joints, dims = source.joints.shape[1:]
    # one increasing clock for all clips: clip i lives in [2 i, 2 i + 1], so that one search serves every window
    begin, finish = source.times[source.starts[:-1]], source.times[source.starts[1:] - 1]
    span = np.maximum(finish - begin, 1e-12)
    which = np.repeat(np.arange(len(span)), np.diff(source.starts))
    clock = (source.times - begin[which]) / span[which] + 2.0 * which
    slots = (np.arange(length * SUBSAMPLES) + 0.5) / (length * SUBSAMPLES)
    out = torch.empty(len(owner), length, joints, dims)
    step = max(1, CHUNK // (length * SUBSAMPLES * joints * dims))
    for at in range(0, len(owner), step):
        owners, lo, hi = owner[at : at + step], start[at : at + step], end[at : at + step]
        moment = ((lo[:, None] + (hi - lo)[:, None] * slots) - begin[owners, None]) / span[owners, None]
        moment = np.clip(moment, 0.0, 1.0) + 2.0 * owners[:, None]
        right = np.clip(
            np.searchsorted(clock, moment, side="right"), source.starts[owners, None] + 1, source.starts[owners + 1, None] - 1
        )
        left = right - 1
        gap = clock[right] - clock[left]
        weight = np.clip((moment - clock[left]) / np.where(gap > 0, gap, 1.0), 0.0, 1.0).astype(np.float32)
        low = source.joints[left]
        values = low + weight[..., None, None] * (source.joints[right] - low)
        out[at : at + step] = torch.from_numpy(values.reshape(len(owners), length, SUBSAMPLES, joints, dims).mean(axis=2))
    return out


def resample_clips(source: Ragged, length: int, crop: tuple[float, float] = (0.0, 1.0)) -> Tensor:
    """Every clip as one window: the part between two fractions of its duration.  ``(clips, length, joints, dims)``."""
    begin, finish = source.times[source.starts[:-1]], source.times[source.starts[1:] - 1]
    span = finish - begin
    return sample(source, np.arange(len(span)), begin + crop[0] * span, begin + crop[1] * span, length)
