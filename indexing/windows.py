"""Clips -> batched windows: every window is resampled uniformly in seconds, with missing joints interpolated in time.

All clips are handled together as one ragged array (frames of all clips end to end), so there is no loop over windows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

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
    there: NDArray[np.bool_] = np.asarray(np.isfinite(joints).all(axis=2))
    clip_of = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    floor = NOISE_FLOOR * _sizes(joints, there, starts)
    wrong, asked, usual = np.zeros_like(there), there, np.zeros_like(floor)
    for once in range(NUM_PASSES):
        # every joint's sightings in every clip, one path after the other
        joint, frame = np.nonzero((there & ~wrong).T)
        clip = clip_of[frame]
        around, counts = _around(joint * len(starts) + clip, NUM_COMPARED)
        judged, places = asked[frame, joint] & (counts >= MIN_SIGHTINGS), joints[frame, joint]
        if once == 0 and stride > 1:
            judged &= (np.arange(len(joint)) % stride == 0) | _near_leaving(places, times[frame], floor[clip])
        rows = np.flatnonzero(judged)
        far, spread = _deviations(places, times[frame], rows, around[rows], NUM_COMPARED)
        if once == 0:
            sampled = rows % stride == 0
            usual = MAX_USUAL_FACTOR * _share(far[sampled].max(axis=1), clip[rows[sampled]], len(starts) - 1, USUAL_SHARE)
        bad = (far > MAX_SPREADS * spread + (usual + floor)[clip[rows], None]).any(axis=1)
        if not bad.any():
            break
        wrong[frame[rows[bad]], joint[rows[bad]]] = True
        # whoever had a wrong neighbour is asked once more
        changed = np.zeros(len(joint) + 1, dtype=np.intp)
        changed[rows[bad] + 1] = 1
        first, last = changed.cumsum()[around.T]
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


def _around(path: NDArray[np.intp], width: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """``(sightings, 2)`` the first and the end of the nearest sightings on the same path, ``width`` where it has so many; and
    how many it has."""
    cuts = np.concatenate([[0], np.flatnonzero(np.diff(path)) + 1, [len(path)]])
    lengths = np.diff(cuts)
    begin, end, counts = (one.repeat(lengths) for one in (cuts[:-1], cuts[1:], lengths))
    first = np.maximum(np.minimum(np.arange(len(path)) - width // 2, end - width), begin)
    return np.stack([first, np.minimum(first + width, end)], axis=1), counts


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
    places: FloatArray, times: FloatArray, rows: NDArray[np.intp], around: NDArray[np.intp], width: int
) -> tuple[FloatArray, FloatArray]:
    """``(rows, dims)`` distance of sightings from the robust line through their neighbours, and the neighbours' spread."""
    far, spread = (np.empty((len(rows), places.shape[1]), places.dtype) for _ in range(2))
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


def _share(far: FloatArray, clip: NDArray[np.intp], clips: int, share: float) -> FloatArray:
    """``(clips,)`` the deviation that a share of the clip's sightings stays below."""
    ends = np.cumsum(np.bincount(clip, minlength=clips))
    out = np.zeros(clips)
    for i, mine in enumerate(np.split(far[np.argsort(clip, kind="stable")], ends[:-1])):
        if len(mine):
            out[i] = np.sort(mine)[min(int(share * len(mine)), len(mine) - 1)]
    return out


def _sizes(joints: FloatArray, there: NDArray[np.bool_], starts: NDArray[np.intp]) -> FloatArray:
    """``(clips,)`` median extent of the body over a clip's frames, along its longer side."""
    known = there[..., None]
    extent = np.where(known, joints, -np.inf).max(axis=1) - np.where(known, joints, np.inf).min(axis=1)
    seen: NDArray[np.bool_] = np.asarray(there.any(axis=1))
    sizes = np.zeros(len(starts) - 1)
    for i, (begin, end) in enumerate(pairwise(starts)):
        if seen[begin:end].any():
            mine = np.sort(extent[begin:end][seen[begin:end]], axis=0)
            sizes[i] = (0.5 * (mine[(len(mine) - 1) // 2] + mine[len(mine) // 2])).max()  # np.median takes 40 us more
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
    there: NDArray[np.bool_] = np.asarray(np.isfinite(joints).all(axis=2))
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
    for i, clip in enumerate(clips):
        who = f"clip {i if items is None else items[i]}" + (f" ({clip.name!r})" if clip.name else "")
        expected = joints if joints is not None else clips[0].joints.shape[1]
        if clip.joints.shape[1] != expected:
            other = "the fitted clips have" if joints is not None else "clip 0 has"
            raise ValueError(f"{who}: joints: {clip.joints.shape[1]} joints, but {other} {expected}; use clips of one joint layout")
        reason = describe_unusable(clip, fewest)
        if reason:
            raise ValueError(f"{who}: joints: {reason}; leave the clip out")
        reason = None if recordings else describe_gap(clip)
        if reason:
            raise ValueError(f"{who}: times: {reason}")


def describe_gap(clip: Clip) -> str | None:
    """Why a clip's times are not those of one performance, and what to do, or ``None``."""
    steps = np.diff(clip.times)
    if len(steps) == 0 or steps.max() <= GAP:
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
    if np.isfinite(clip.joints[0]).all() and (clip.joints[0] != clip.joints[0, 0]).any():
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
