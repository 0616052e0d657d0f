"""Joints that a detector put in the wrong place: found against the joint's own path in time, safe on clean data.

A wrong joint is far from where the joint's neighbouring sightings say it was.  How far is far, a recording says itself: its
own deviations, which grow with the noise, with the speed of the movement and with the gaps between frames.
"""

from __future__ import annotations

from itertools import combinations, pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from indexing.clip import Clip, FloatArray, stretches

# How far windows are from those of uncorrupted clips, in % of their deviation, Florence3D at 90 degrees.  As they are: 5 % wrong
# joints 33, 10 % 47, bursts of three 39, half the frames dropped 8.6.  Repaired so: 7.4, 14, 19, 8.9, and clean clips .09.
WIDTH = 9  # sightings of one joint compared: 7 finds more (6.2) and fails in bursts (23), 11 finds less (9.1)
LIMIT = 4.0  # spreads of the neighbours: 6 finds less (8.6)
# Times the deviation that this share of all joints stays below.  3 finds more (3.1), at the same accuracy (5 % wrong joints: .862)
# but takes movement for error where frames are dropped: Florence3D .856 -> .817, 8 -> .843.  Chosen on that set.
USUAL, SHARE = 8.0, 0.8
FLOOR = 0.01  # of the body: smaller steps are the noise of every detector
LEAST = 5  # sightings: among fewer nobody can say which is wrong
PART = 9000  # frames of a long recording that are judged together: 5 minutes at 30 per second
PASSES = 2  # the second sees past what the first took out: bursts 21 -> 19; a third adds nothing
CHUNK = 20_000  # sightings at once: bounds memory
_A, _B = zip(*((a, b) for a, b in combinations(range(WIDTH), 2) if b - a > 1), strict=True)


def wrong_joints(joints: FloatArray, times: FloatArray, starts: NDArray[np.intp]) -> NDArray[np.bool_]:
    r"""Sightings that do not lie on their joint's path.

    With :math:`x_k, t_k` the nine sightings of a joint around one of them, a robust line is laid through them (the median of
    the slopes :math:`(x_b - x_a) / (t_b - t_a)`, then of the remainders :math:`r_k`), and a sighting is wrong where

    .. math:: |r - \operatorname{med} r| > 4 \cdot 1.48 \operatorname{med}_k |r_k - \operatorname{med} r| + 8 q + 0.01 s

    in any coordinate; :math:`q` is the deviation that four fifths of the clip's sightings stay below, :math:`s` the size of
    the body.  Times are real: neither a varying frame rate nor gaps make a movement look like a jump.

    Args:
        joints: ``(frames of all, joints, dims)`` of clips end to end, NaN = missing.
        times: ``(frames of all,)`` seconds, increasing within a clip.
        starts: ``(clips + 1,)`` the first frame of each clip, and the number of frames.

    Returns:
        ``(frames of all, joints)``; missing joints are not wrong.

    Source: Hampel 1974 (deviation from a running median); Sen 1968 (median of slopes).

    Example:
        >>> walk = np.linspace(0, 1, 20)[:, None, None] * np.ones((1, 3, 2)) + np.arange(3)[:, None]
        >>> walk[7, 1] = 5.0
        >>> np.argwhere(wrong_joints(walk, np.arange(20) / 30, np.array([0, 20]))).tolist()
        [[7, 1]]
    """
    there: NDArray[np.bool_] = np.asarray(np.isfinite(joints).all(axis=2))
    clip_of = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    floor = FLOOR * _sizes(joints, there, starts)
    wrong, asked, usual = np.zeros_like(there), there, np.zeros_like(floor)
    for once in range(PASSES):
        # every joint's sightings in every clip, one path after the other
        joint, frame = np.nonzero((there & ~wrong).T)
        clip = clip_of[frame]
        around, counts = _around(joint * len(starts) + clip)
        rows = np.flatnonzero(asked[frame, joint] & (counts >= LEAST))
        far, spread = _deviations(joints[frame, joint], times[frame], around, rows)
        if once == 0:
            usual = USUAL * _share(far.max(axis=1), clip[rows], len(starts) - 1)
        bad = (far > LIMIT * spread + (usual + floor)[clip[rows], None]).any(axis=1)
        wrong[frame[rows[bad]], joint[rows[bad]]] = True
        # whoever had a wrong neighbour is asked once more
        touched = (wrong[frame[around], joint[:, None]] & (around >= 0)).any(axis=1)
        asked = np.zeros_like(there)
        asked[frame[touched], joint[touched]] = True
    return wrong


def mended(clip: Clip) -> Clip:
    """A clip of any length without its wrong joints; judged in parts of :data:`PART` frames, which bounds memory, between gaps."""
    pieces = [np.arange(begin, max(end - PART // 2, begin + 1), PART) for begin, end in stretches(clip.times).tolist()]
    parts = np.append(np.concatenate(pieces), len(clip))
    wrong = wrong_joints(clip.joints, clip.times, parts)
    if not wrong.any():
        return clip
    joints = clip.joints.copy()
    joints[wrong] = np.nan
    return clip.replace(joints=joints)


def _around(path: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """``(sightings, WIDTH)`` the nearest sightings on the same path, -1 where a path has fewer; and how many it has."""
    begin, end = np.searchsorted(path, path, side="left"), np.searchsorted(path, path, side="right")
    first = np.maximum(np.minimum(np.arange(len(path)) - WIDTH // 2, end - WIDTH), begin)
    around = first[:, None] + np.arange(WIDTH)
    return np.where(around < end[:, None], around, -1), end - begin


def _deviations(
    places: FloatArray, times: FloatArray, around: NDArray[np.intp], rows: NDArray[np.intp]
) -> tuple[FloatArray, FloatArray]:
    """``(rows, dims)`` distance of sightings from the robust line through their neighbours, and the neighbours' spread."""
    far, spread = (np.empty((len(rows), places.shape[1]), places.dtype) for _ in range(2))
    x, clock = torch.from_numpy(places), torch.from_numpy(times)
    for at in range(0, len(rows), CHUNK):
        some = torch.from_numpy(rows[at : at + CHUNK])
        index = torch.from_numpy(around)[some]
        near = torch.where((index >= 0)[..., None], x[index], torch.nan).mT.contiguous()
        since = (clock[index] - clock[some, None]).to(x)[:, None]
        slope = _median((near[..., _B] - near[..., _A]) / (since[..., _B] - since[..., _A])).nan_to_num()
        remainder = near - slope * since
        middle = _median(remainder)
        far[at : at + CHUNK] = (x[some] - middle[..., 0]).abs().numpy()
        spread[at : at + CHUNK] = 1.4826 * _median((remainder - middle).abs())[..., 0].numpy()
    return far, spread


def _median(values: Tensor) -> Tensor:
    return values.nanmedian(dim=-1, keepdim=True).values


def _share(far: FloatArray, clip: NDArray[np.intp], clips: int) -> FloatArray:
    """``(clips,)`` the deviation that a share of the clip's sightings stays below."""
    counts = np.bincount(clip, minlength=clips)
    last = np.cumsum(counts) - counts + np.minimum((SHARE * counts).astype(int), np.maximum(counts - 1, 0))
    ordered = np.append(far[np.lexsort((far, clip))], 0.0)
    return np.where(counts > 0, ordered[np.minimum(last, len(far))], 0.0)


def _sizes(joints: FloatArray, there: NDArray[np.bool_], starts: NDArray[np.intp]) -> FloatArray:
    """``(clips,)`` median extent of the body over a clip's frames, along its longer side."""
    known = there[..., None]
    extent = np.where(known, joints, -np.inf).max(axis=1) - np.where(known, joints, np.inf).min(axis=1)
    seen: NDArray[np.bool_] = np.asarray(there.any(axis=1))
    sizes = np.zeros(len(starts) - 1)
    for i, (begin, end) in enumerate(pairwise(starts)):
        if seen[begin:end].any():
            sizes[i] = np.median(extent[begin:end][seen[begin:end]], axis=0).max()
    return sizes
