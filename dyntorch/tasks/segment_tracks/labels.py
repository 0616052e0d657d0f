"""What belongs to no body, how each body moved between the frames that were compared, and which one stands still."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.geometry.epipolar import sampson_squared
from dyntorch.geometry.homogeneous import skew, unit
from dyntorch.tasks.segment.labels import choose
from dyntorch.tasks.segment_tracks.descent import Geometry
from dyntorch.tasks.segment_tracks.frames import Film, FramePair
from dyntorch.tasks.segment_tracks.options import StaticOptions, StrayOptions, TrackSegmentOptions


def distances(pairs: Sequence[FramePair], geometry: Geometry, count: int) -> Tensor:
    """Sampson distances ``(P, K, n)`` in pixels of all tracks from all bodies, whose geometry is ``(1, K, 3, 3)`` for every pair;
    NaN where a track is not in the pair, or the body's motion between its frames is not known."""
    bodies = geometry[0].shape[1]
    found = torch.full((len(pairs), bodies, count), torch.nan, dtype=torch.float64, device=geometry[0].device)
    for row, pair, F in zip(found, pairs, geometry, strict=True):
        square = sampson_squared(F[0], pair.view.x1, pair.view.x2)
        known = (F[0] != 0).any(-1).any(-1)
        row[:, pair.index] = torch.where(known[:, None], square.sqrt() / pair.view.pixel, torch.nan)
    return found


def outliers(distance: Tensor, labels: Tensor, support: Tensor, options: StrayOptions) -> Tensor:
    """``(n,)`` bool: tracks that are usually farther from their body than a track of it may be."""
    own = distance.gather(1, labels.expand(len(distance), 1, -1))[:, 0]
    usual = own.nanquantile(0.5, dim=0).nan_to_num(nan=0.0)
    return usual > torch.where(support > options.support, options.supported, options.farthest)


@dataclass(frozen=True)
class BodyMotions:
    """Of K bodies between the frames of P pairs, in the coordinates of the input: F and H ``(P, K, 3, 3)``, planar ``(P, K)``."""

    fundamentals: Tensor
    homographies: Tensor
    planar: Tensor


def motions(
    pairs: Sequence[FramePair], geometry: Geometry, member: Tensor, film: Film, options: TrackSegmentOptions
) -> BodyMotions:
    """With members ``(K, n)``, 0 or 1; 0 where two frames have too few of them in common."""
    back = torch.linalg.inv(film.change)
    fundamentals, homographies, planar = [], [], []
    for pair, F in zip(pairs, geometry, strict=True):
        some = member[:, pair.index]
        there = some.sum(-1) >= options.descent.members
        models = choose(pair.view, F[0], some, options.views)
        flat = there & models.planar
        fundamentals.append(torch.where(there[:, None, None], unit(film.change.mT @ F[0] @ film.change), 0.0))
        homographies.append(torch.where(flat[:, None, None], unit(back @ models.homographies @ film.change), 0.0))
        planar.append(flat)
    return BodyMotions(torch.stack(fundamentals), torch.stack(homographies), torch.stack(planar))


def widths(film: Film, member: Tensor, options: StaticOptions) -> Tensor:
    """How wide bodies of members ``(K, n)`` are: the share ``(K,)`` of the cells of a grid over the picture that they are seen in,
    of those that anything is seen in, in the mean over the frames."""
    there = film.x[film.seen]
    low, high = there.quantile(there.new_tensor([0.01, 0.99]), dim=0)
    cell = ((film.x - low) / (high - low).clamp(min=1e-12) * options.cells).long().clamp(0, options.cells - 1)
    place = cell[..., 0] * options.cells + cell[..., 1]
    shares = []
    for seen, where in zip(film.seen, place, strict=True):
        if not bool(seen.any()):
            continue
        grid = torch.zeros(len(member), options.cells**2, dtype=torch.float64, device=member.device)
        grid.index_add_(1, where[seen], member[:, seen].double())
        shares.append((grid > 0).sum(-1) / (grid > 0).any(0).sum())
    return torch.stack(shares).mean(0)


def resting(film: Film, member: Tensor, options: StaticOptions) -> int | None:
    """Which body of members ``(K, n)`` must be what stands still: the largest, if it is the widest, too, and large enough."""
    size = member.sum(-1)
    largest = int(size.argmax())
    wide = widths(film, member, options)
    others = torch.arange(len(size), device=size.device) != largest
    clear = bool((size[largest] >= options.larger * size[others]).all()) and bool((wide[largest] >= wide[others]).all())
    return largest if clear and float(size[largest]) >= options.share * float(size.sum()) else None


def agreeing(tracks: Tensor, member: Tensor, cameras: Tensor, pairs: Sequence[FramePair]) -> Tensor:
    """Median Sampson distances ``(K,)`` of bodies of members ``(K, n)`` from the motion of cameras ``(frames, 3, 4)``."""
    found: list[list[Tensor]] = [[] for _ in member]
    for pair in pairs:
        first, second = cameras[pair.frames[0]], cameras[pair.frames[1]]
        centre = torch.linalg.svd(first)[2][-1]
        F = unit(skew(second @ centre) @ second @ torch.linalg.pinv(first))
        x1, x2 = (tracks[frame][pair.index] for frame in pair.frames)
        distance = sampson_squared(F, x1, x2).sqrt()
        for own, some in zip(found, member[:, pair.index] > 0, strict=True):
            own.append(distance[some])
    none = tracks.new_tensor(torch.inf)
    return torch.stack([torch.cat(own).median() if sum(map(len, own)) else none for own in found])
