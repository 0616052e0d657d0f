"""What is kept of the clips an indexer learns from: windows cut, cropped, mirrored and seen from elsewhere, ready to compare."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from indexing.action.bank import Windows, stack
from indexing.cameras import rotation, virtual
from indexing.clip import Clip, FloatArray, stretches
from indexing.modelfile import part, store
from indexing.skeleton import Skeleton
from indexing.windows import Ragged, concatenate_clips, resample_clips, sample

MAX_WINDOWS = 500  # exemplars by whose distances between joints a layout is recognized
MAX_DISTORTION = 0.25  # of the mean joint distance: the right layout fits to .02-.12 (one clip: .25), wrong ones to .34-.71
NUM_SHUFFLES = 20  # random layouts that show what fits by chance
MAX_CHANCE_RATIO = 0.5  # of their mean distortion, which the right layout stays below


def mirror_permutation(skeleton: Skeleton | None, windows: Tensor, seen: Tensor | None = None) -> Tensor | None:
    """``(joints,)`` index of every joint's mirror image (itself on the midline), or ``None`` where it cannot be told."""
    if skeleton is not None:
        named = permutation_from_names(skeleton.joints)
        if named is not None:
            return named
    return permutation_from_layouts(windows, seen)


def permutation_from_names(names: tuple[str, ...]) -> Tensor | None:
    """From names that say left and right (``left_knee``, ``LKnee``, ``knee.r``...); ``None`` where no pair is found."""
    index = {name: i for i, name in enumerate(names)}
    swap = list(range(len(names)))
    for name, i in index.items():
        for pattern, other in _SIDES:
            partner, changed = re.subn(pattern, other, name, count=1)
            if changed and partner != name and partner in index:
                swap[i] = index[partner]
                break
    if all(i == j for i, j in enumerate(swap)) or any(swap[j] != i for i, j in enumerate(swap)):
        return None
    return torch.tensor(swap)


_SIDES = (
    ("left", "right"), ("right", "left"), ("Left", "Right"), ("Right", "Left"), ("LEFT", "RIGHT"), ("RIGHT", "LEFT"),
    (r"(?<![a-zA-Z])[lL](?=[A-Z_\-. ])", lambda m: {"l": "r", "L": "R"}[m[0]]),
    (r"(?<![a-zA-Z])[rR](?=[A-Z_\-. ])", lambda m: {"r": "l", "R": "L"}[m[0]]),
    (r"(?<=[_\-. ])[lL](?![a-zA-Z])", lambda m: {"l": "r", "L": "R"}[m[0]]),
    (r"(?<=[_\-. ])[rR](?![a-zA-Z])", lambda m: {"r": "l", "R": "L"}[m[0]]),
    (r"^l(?=[a-z]{3})", "r"), (r"^r(?=[a-z]{3})", "l"),
)  # fmt: skip


# Mirror pairs of the common layouts, by number of joints, for data that come without names.
_LAYOUTS: dict[int, tuple[tuple[tuple[int, int], ...], ...]] = {
    13: (((1, 2), (3, 4), (5, 6), (7, 8), (9, 10), (11, 12)),),  # Penn Action
    14: (((0, 5), (1, 4), (2, 3), (6, 11), (7, 10), (8, 9)),),  # LSP
    15: (
        ((3, 6), (4, 7), (5, 8), (9, 12), (10, 13), (11, 14)),  # NITE: head, neck, torso, then limb by limb
        ((3, 4), (5, 6), (7, 8), (9, 10), (11, 12), (13, 14)),  # JHMDB: joint by joint
        ((2, 5), (3, 6), (4, 7), (8, 11), (9, 12), (10, 13)),  # OpenPose MPI
    ),
    16: (((0, 5), (1, 4), (2, 3), (10, 15), (11, 14), (12, 13)),),  # MPII
    17: (
        ((1, 2), (3, 4), (5, 6), (7, 8), (9, 10), (11, 12), (13, 14), (15, 16)),  # COCO
        ((1, 4), (2, 5), (3, 6), (11, 14), (12, 15), (13, 16)),  # Human3.6M
    ),
    18: (((2, 5), (3, 6), (4, 7), (8, 11), (9, 12), (10, 13), (14, 15), (16, 17)),),  # OpenPose COCO
    20: (
        ((4, 8), (5, 9), (6, 10), (7, 11), (12, 16), (13, 17), (14, 18), (15, 19)),  # Kinect SDK
        ((0, 1), (4, 5), (7, 8), (9, 10), (11, 12), (13, 14), (15, 16), (17, 18)),  # MSR Action3D
    ),
    24: (((1, 2), (4, 5), (7, 8), (10, 11), (13, 14), (16, 17), (18, 19), (20, 21), (22, 23)),),  # SMPL
    25: (
        ((4, 8), (5, 9), (6, 10), (7, 11), (12, 16), (13, 17), (14, 18), (15, 19), (21, 23), (22, 24)),  # Kinect 2
        ((2, 5), (3, 6), (4, 7), (9, 12), (10, 13), (11, 14), (15, 16), (17, 18), (19, 22), (20, 23), (21, 24)),  # BODY_25
    ),
    26: (
        ((1, 2), (3, 4), (5, 6), (7, 8), (9, 10), (11, 12), (13, 14), (15, 16), (20, 21), (22, 23), (24, 25)),  # Halpe
    ),
    33: (
        (
            (1, 4), (2, 5), (3, 6), (7, 8), (9, 10), (11, 12), (13, 14), (15, 16), (17, 18), (19, 20), (21, 22), (23, 24),
            (25, 26), (27, 28), (29, 30), (31, 32),
        ),  # MediaPipe
    ),
}  # fmt: skip


def permutation_from_layouts(windows: Tensor, seen: Tensor | None = None) -> Tensor | None:
    r"""The common layout with this number of joints whose mirror image keeps the distances between joints. windows
    ``(N, length, joints, 2)``."""
    joints = windows.shape[2]
    if joints not in _LAYOUTS:
        return None
    if seen is None:
        seen = torch.ones(len(windows), joints, dtype=torch.bool)
    x = windows.double()
    apart = (x[:, :, :, None] - x[:, :, None]).abs()
    both = (seen[:, :, None] & seen[:, None]).double()
    known = both.sum(0) > 0
    mean = [(d.mean(1) * both).sum(0) / both.sum(0).clamp(min=1) for d in (apart[..., 1], apart.square().sum(-1).sqrt())]
    tables = torch.stack(mean)
    tables = tables / (tables.sum(dim=(1, 2), keepdim=True) / known.sum().clamp(min=1)).clamp(min=1e-30)

    def distortion(swap: Tensor) -> float:
        counted = known & known[swap][:, swap]
        return float((tables - tables[:, swap][:, :, swap]).abs().mean(0)[counted].mean())

    shuffles = torch.Generator().manual_seed(0)
    chance = sum(distortion(torch.randperm(joints, generator=shuffles)) for _ in range(NUM_SHUFFLES)) / NUM_SHUFFLES
    best, chosen = min(MAX_DISTORTION, MAX_CHANCE_RATIO * chance), None
    for pairs in _LAYOUTS[joints]:
        swap = torch.arange(joints)
        for i, j in pairs:
            swap[i], swap[j] = j, i
        if distortion(swap) < best:
            best, chosen = distortion(swap), swap
    return chosen


# ----------------------------------------------------------------------------------------------------------------------
# Virtual views of the exemplars: what they would look like to cameras placed elsewhere.
#
# Where an exemplar has 3D joints they are rendered (:func:`indexing.cameras.virtual`).  Where it has one image only, the
# person is taken for a flat card and the card is turned: a random horizontal squeeze or mirror image with a slight pitch.
# Measured, that gives 65-85 % of the gain of true 3D to a view-bound kernel and nearly all of it once heights are compared
# too; it needs no weights, no training and no particular joints.


def turn(windows: Tensor, azimuth: FloatArray, pitch: FloatArray) -> Tensor:
    """Flat cards turned about the vertical and pitched, seen orthographically. windows ``(N, length, joints, 2)``, azimuth,
    pitch ``(N,)`` -> ``(N, length, joints, 2)``."""
    rotations = torch.tensor(np.stack([rotation(a, p) for a, p in zip(azimuth, pitch, strict=True)]))
    rotations = rotations.to(windows)
    centred = windows - windows.mean(dim=(1, 2), keepdim=True)
    return torch.einsum("nij,ntkj->ntki", rotations[:, :2, :2], centred)


# begin and end, in parts of the duration: extent and tempo search; the first is all of it
CROPS = ((0.0, 1.0), (0.0, 0.85), (0.15, 1.0), (0.1, 0.9), (0.0, 0.7), (0.3, 1.0))
NUM_VIEWS = 4  # virtual views per exemplar: of cards 8 give no more than 4
NUM_VIEWS_SOLID = 12  # the same of exemplars with depth: +1 % over 4
MAX_VIEW_CROP = 0.12  # part of the duration that a virtual view may lose at each end
VIEW_ELEVATION = 0.1  # radians, of virtual cameras around 3D exemplars
VIEW_ELEVATION_SIGMA = 0.15  # radians
CARD_PITCH_SIGMA = 0.1  # radians, of turned cards
MAX_SHORT_WINDOW = 0.5  # of the duration of an ordinary exemplar: a short window holds less than the action
RECURRENCE_STEPS = 96  # steps in which an exemplar is compared with itself: eight of each cycle where it holds twelve
SMOOTHED_STEPS = 2  # steps apart whose autocorrelation only noise keeps from 1: one step is smoothed into the next
RECURRENCE_DROP = 0.3  # autocorrelation below which a movement has left the pose that it may come back to
MAX_SAMPLED_MOMENTS = 500  # short windows that set the hub shares, and the levels of events


@dataclass(frozen=True)
class ExemplarPlan:
    """How windows are cut: steps per window, copies, and the stream's window and stride in seconds."""

    length: int = 12
    search: bool = True
    views: int = NUM_VIEWS
    turned: bool = True  # virtual views turn about the vertical; otherwise they are only cropped
    repair: bool = False
    window: float = 1.0
    stride: float = 0.3


@dataclass(frozen=True)
class Exemplars:
    """Windows of ``N`` exemplars."""

    crops: Windows = field(metadata=part(rows="crops"))
    views: Windows = field(metadata=part(rows="views"))
    moments: Windows = field(metadata=part(rows="moments"))
    owner: torch.Tensor = field(metadata=store("every", "moments", below="exemplars"))
    solid: torch.Tensor = field(metadata=store("truth", "exemplars"))
    seconds: torch.Tensor | None = field(default=None, metadata=store("real", "exemplars"))
    cyclic: torch.Tensor | None = field(default=None, metadata=store("real", "exemplars"))

    def __len__(self) -> int:
        return len(self.solid)

    def to(self, device: torch.device | str) -> Exemplars:
        """The same windows on another device."""
        crops, views, moments = (part.to(device) for part in (self.crops, self.views, self.moments))
        seconds, cyclic = (None if one is None else one.to(device) for one in (self.seconds, self.cyclic))
        return Exemplars(crops, views, moments, self.owner.to(device), self.solid.to(device), seconds, cyclic)

    def crop(self, index: int) -> Windows:
        """``N`` windows of one crop; 0 is the whole exemplar."""
        count = len(self)
        return self.crops[slice(index * count, (index + 1) * count)]

    def view(self, index: int) -> Windows:
        """``N`` windows of one virtual view."""
        count = len(self)
        return self.views[slice(index * count, (index + 1) * count)]

    def select(self, chosen: torch.Tensor) -> Exemplars:
        """Some of them, ``(N,)`` bool."""
        count, moments = len(self), chosen[self.owner]

        def copies(windows: Windows) -> Windows:
            return windows[chosen.repeat(len(windows) // count)] if len(windows) else windows

        seconds, cyclic = (None if one is None else one[chosen] for one in (self.seconds, self.cyclic))
        owner = (torch.cumsum(chosen, 0) - 1)[self.owner[moments]]
        return Exemplars(copies(self.crops), copies(self.views), self.moments[moments], owner, self.solid[chosen], seconds, cyclic)

    def join(self, other: Exemplars) -> Exemplars:
        """These and then the others."""
        mine, theirs = len(self), len(other)

        def interleave(a: Windows, b: Windows) -> Windows:
            copies = len(a) // mine
            return stack([part for i in range(copies) for part in (a[i * mine : (i + 1) * mine], b[i * theirs : (i + 1) * theirs])])

        return Exemplars(
            interleave(self.crops, other.crops),
            interleave(self.views, other.views) if len(self.views) else self.views,
            stack([self.moments, other.moments]),
            torch.cat([self.owner, other.owner + mine]),
            torch.cat([self.solid, other.solid]),
            None if self.seconds is None or other.seconds is None else torch.cat([self.seconds, other.seconds]),
            None if self.cyclic is None or other.cyclic is None else torch.cat([self.cyclic, other.cyclic]),
        )


def cut_exemplars(clips: Sequence[Clip], plan: ExemplarPlan, random_state: np.random.Generator) -> Exemplars:
    """Cut everything that is kept of the clips; 3D clips are rendered, first as seen along z, then from around."""
    images = [_render(clip, 0.0, VIEW_ELEVATION, random_state) for clip in clips]
    source = concatenate_clips(images, plan.repair)
    seen = torch.from_numpy(source.seen)
    crops = CROPS if plan.search else CROPS[:1]
    cropped = stack([Windows(resample_clips(source, plan.length, crop), seen) for crop in crops])
    views = [_view(clips, source, plan, random_state) for _ in range(plan.views)]
    seconds = torch.tensor([clip_seconds(clip) for clip in images], dtype=torch.float32)
    window = moment_window(plan.window, seconds)
    moments, owner = slide(source, plan.length, window, plan.stride * window / plan.window)
    solid = torch.tensor([clip.dims == 3 for clip in clips])
    return Exemplars(cropped, stack(views) if views else cropped[:0], moments, owner, solid, seconds, recurrence(source))


def clip_seconds(clip: Clip) -> float:
    """Seconds from the first frame of a clip to the end of its last one."""
    steps = np.diff(clip.times)
    return float(clip.duration + (np.median(steps) if len(steps) else 0.0))


def moment_window(longest: float, seconds: torch.Tensor | None) -> float:
    """Seconds of a short window: a part of an ordinary exemplar, and ``longest`` at most."""
    return longest if seconds is None else min(longest, MAX_SHORT_WINDOW * float(seconds.median()))


def recurrence(source: Ragged) -> torch.Tensor:
    r"""``(N,)`` how much each exemplar repeats itself within its first half: near 1 for two cycles or more, .3 or less for
    none."""
    count, fine = len(source.starts) - 1, RECURRENCE_STEPS
    begin, end = source.times[source.starts[:-1]], source.times[source.starts[1:] - 1]
    found = torch.zeros(count)
    for i in range(count):
        values = sample(source, np.array([i]), begin[i : i + 1], end[i : i + 1], fine)[0].double()
        x = values - values.mean(dim=1, keepdim=True)
        x = (x - x.mean(dim=0)).flatten(1)
        gram, energy = x @ x.T, x.square().sum(dim=1)
        lags = range(fine // 2 + 1)
        curve = torch.stack([gram.diagonal(k).sum() for k in lags])
        norm = torch.stack([(energy[: fine - k].sum() * energy[k:].sum()).sqrt() for k in lags]).clamp(min=1e-30)
        curve = curve / norm
        curve = (curve / curve[SMOOTHED_STEPS].clamp(min=RECURRENCE_DROP)).clamp(max=1.0)
        fallen = (curve < RECURRENCE_DROP).nonzero()
        if len(fallen):
            found[i] = float(curve[int(fallen[0]) :].max().clamp(min=0.0))
    return found


def _render(clip: Clip, azimuth: float, elevation: float, random_state: np.random.Generator) -> Clip:
    return virtual(clip, azimuth, elevation, random_state=random_state) if clip.dims == 3 else clip


def _view(clips: Sequence[Clip], source: Ragged, plan: ExemplarPlan, random_state: np.random.Generator) -> Windows:
    """One virtual view of every exemplar: rendered where it is 3D, the turned card where it is an image."""
    count = len(clips)
    azimuth = random_state.uniform(0, 2 * np.pi, count)
    pitch = random_state.normal(scale=CARD_PITCH_SIGMA, size=count)
    low, high = random_state.uniform(0, MAX_VIEW_CROP, count), 1 - random_state.uniform(0, MAX_VIEW_CROP, count)
    solid = np.array([clip.dims == 3 for clip in clips])
    if solid.any() and plan.turned:
        lifted = [
            _render(
                clip,
                float(np.rad2deg(azimuth[i])),
                VIEW_ELEVATION + VIEW_ELEVATION_SIGMA * float(random_state.normal()),
                random_state,
            )
            if solid[i]
            else clip
            for i, clip in enumerate(clips)
        ]
        source = concatenate_clips(lifted, plan.repair)
    begin, end = source.times[source.starts[:-1]], source.times[source.starts[1:] - 1]
    values = sample(source, np.arange(count), begin + low * (end - begin), begin + high * (end - begin), plan.length)
    if plan.turned and not solid.all():
        flat = torch.from_numpy(~solid)
        values[flat] = turn(values[flat], azimuth[~solid], pitch[~solid])
    return Windows(values, torch.from_numpy(source.seen))


def slide(source: Ragged, length: int, window: float, stride: float) -> tuple[Windows, torch.Tensor]:
    """Short windows every ``stride`` seconds inside each clip, or each part of one that gaps leave (all of it where that is shorter
    than a window), and whose they are."""
    clip, first, last = _parts(source, window)
    begin, end = source.times[first], source.times[last]
    counts = np.maximum(1, np.floor((end - begin - window) / stride + 1e-9).astype(int) + 1)
    part = np.repeat(np.arange(len(counts)), counts)
    step = np.arange(len(part)) - np.repeat(np.cumsum(counts) - counts, counts)
    # spread over the clip, so that its end is covered too
    room = np.maximum(end - begin - window, 0.0)
    start = begin[part] + room[part] * step / np.maximum(counts[part] - 1, 1)
    owner = clip[part]
    values = sample(source, owner, start, np.minimum(start + window, end[part]), length)
    return Windows(values, torch.from_numpy(source.seen[owner])), torch.from_numpy(owner)


def _parts(source: Ragged, window: float) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """For each part of a clip between gaps: its clip, and its first and last frame.  A frame by itself is none."""
    clips, cuts = [], []
    for i, (begin, end) in enumerate(pairwise(source.starts.tolist())):
        found = begin + stretches(source.times[begin:end], window)
        found = found[found[:, 1] - found[:, 0] > 1] if len(found) > 1 else found
        clips += [i] * len(found)
        cuts.append(found)
    joined = np.concatenate(cuts)
    return np.array(clips, dtype=np.intp), joined[:, 0], joined[:, 1] - 1
