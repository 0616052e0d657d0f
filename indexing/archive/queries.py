"""An example as it is asked: images of it, for each joint layout of an archive, and the probes that are slid along the codes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from indexing.action.bank import Windows
from indexing.archive.catalogue import Contents
from indexing.archive.layout import Layout
from indexing.archive.options import SearchOptions
from indexing.archive.sketches import Probe, orthonormal
from indexing.archive.tracks import images
from indexing.cameras import y_up
from indexing.clip import Clip
from indexing.windows import Ragged, mended, ragged, sample, unusable, whole


@dataclass(frozen=True, eq=False)
class Query:
    """An example as it faces the recordings of one layout."""

    windows: Windows
    probes: tuple[Probe, ...]
    fine: tuple[Probe, ...]


def checked(clip: Clip, shortest: float, options: SearchOptions) -> Clip:
    """An example that can be searched."""
    who = f"{clip.name!r}" if clip.name else "the example"
    there = np.flatnonzero(clip.seen.any(axis=1))
    if not len(there):
        raise ValueError(f"{who}: nobody is in view in any frame; give a clip that shows the movement")
    reason = unusable(clip)
    if reason:
        raise ValueError(f"{who}: {reason}; give a clip that shows the movement")
    clip = mended(clip.replace(joints=clip.joints[there], times=clip.times[there], confidence=None))
    if clip.duration < shortest * (1 - 1e-9):
        raise ValueError(
            f"{who}: shows {clip.duration:.3g} s, but the shortest window lasts {shortest:g} s; give more of the movement"
        )
    if clip.duration > options.deepest:
        raise ValueError(
            f"{who}: lasts {clip.duration:.4g} s, an example {options.deepest:g} s at most; cut out one performance, as in "
            "throw.json@2.1-3.0"
        )
    return clip


def queries_of(clip: Clip, contents: Contents, options: SearchOptions, mirrored: bool = False) -> dict[int, Query]:
    """The example, for each layout that it has enough joints of."""
    found: dict[int, Query] = {}
    for number, layout in contents.layouts.items():
        facing = layout.facing(clip)
        if facing is not None:
            example = _example(facing, layout, contents.options.rate, contents.options.views, options, mirrored)
            if example.probes:
                found[number] = example
    if not found:
        own = clip.skeleton.name if clip.skeleton is not None else f"{clip.joints.shape[1]} joints without names"
        known = ", ".join(layout.name for layout in contents.layouts.values())
        who = f"{clip.name!r}" if clip.name else "the example"
        raise ValueError(
            f"{who}: joints: {own} has too few in common with what is in the archive ({known}); use the same pose estimator"
        )
    return found


def _example(clip: Clip, layout: Layout, rate: float, views: Sequence[float], options: SearchOptions, mirrored: bool) -> Query:
    clips = [one.replace(joints=y_up(one), up="y", confidence=None) for one in images(clip, views)]
    windows = _windows(clips, options.length)
    count = len(clips)
    if mirrored:
        swap = layout.swap
        if swap is None:
            raise ValueError(f"{clip.name!r}: which joints are left and right cannot be told; name the joints, or search as it is")
        # an image and its mirror image are of one shape: only the joints change places
        clips += [one.replace(joints=one.joints[:, swap]) for one in clips]
        windows = _windows(clips, options.length)
    source = ragged(clips)
    coarse, fine = (
        [
            probe_of(source, i, layout, rate, tempo, replace(options, samples=samples), mirrored=i >= count)
            for i in range(len(clips))
            for tempo in dict.fromkeys((*options.scanned, *options.tempos))
        ]
        for samples in (options.samples, options.fine)
    )
    return Query(windows, tuple(one for one in coarse if one is not None), tuple(one for one in fine if one is not None))


def _windows(clips: Sequence[Clip], length: int) -> Windows:
    source = ragged(clips)
    return Windows(whole(source, length), torch.from_numpy(source.seen))


def probe_of(
    source: Ragged,
    image: int,
    layout: Layout,
    rate: float,
    tempo: float,
    options: SearchOptions,
    *,
    mirrored: bool = False,
    moving: bool = False,
) -> Probe | None:
    """One image of an example at one tempo; ``None`` where hardly any joint was seen."""
    first, last = source.starts[image], source.starts[image + 1] - 1
    begin, end = float(source.times[first]), float(source.times[last])
    seconds = (end - begin) * tempo
    stride = max(1, int(seconds * rate / options.samples + 1e-6))
    samples = max(2, int(seconds * rate / stride + 1e-6) + 1)
    # the moments of the example that lie under poses of the archive, in the middle of it
    at = (begin + end) / 2 + (np.arange(samples) - (samples - 1) / 2) * stride / rate / tempo
    half = 0.5 / rate / tempo
    poses = sample(source, np.full(samples, image), at - half, at + half, 1)[:, 0].numpy()
    poses[:, ~source.seen[image]] = np.nan
    each = np.ascontiguousarray(layout.project(poses).transpose(1, 0, 2))
    mean = each.mean(axis=1, keepdims=True)
    codes = orthonormal(each - mean if moving else each)
    if codes is None:
        return None
    moved = float(((each - mean) ** 2).sum() / max(float((each**2).sum()), 1e-30))
    longest = int(options.trimmed * seconds * rate)
    return Probe(image, mirrored, seconds, stride, codes, moved, tempo in options.scanned, longest)
