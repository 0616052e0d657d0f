"""Projections P^k -> P^l and points from tracks: tensor of a few views, resection of the others, free bundle adjustment."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from math import comb

import torch
from torch import Tensor

from dyntorch.core.fit import fit_matches
from dyntorch.core.matches import Matches
from dyntorch.core.outcome import Status, is_failure
from dyntorch.core.refine import constrain_matches
from dyntorch.geometry.bundle import bundle_adjust
from dyntorch.geometry.triangulation import reproject, resect, triangulate
from dyntorch.invariants.grassmann_tensor import GrassmannTensor


@dataclass(frozen=True)
class ViewTracks:
    """Tracks with one flat batch dimension, every view normalized."""

    x: Tensor
    """``(b, views, n, l)``, 0 where missing."""
    weights: Tensor
    """``(b, views, n)`` of normalized coordinates: 1 over the square of the scale of the view, 0 where missing."""
    scales: Tensor
    """``(b, views)`` normalized unit over measured unit."""
    transforms: Tensor
    """``(b, views, l + 1, l + 1)`` from measured to normalized coordinates."""
    times: Tensor
    """``(views,)``."""
    static: Tensor | None = None
    """``(b, n)`` bool: points known to stand still."""

    def subset(self, keep: Tensor) -> ViewTracks:
        """Some problems of the batch."""
        static = None if self.static is None else self.static[keep]
        return ViewTracks(self.x[keep], self.weights[keep], self.scales[keep], self.transforms[keep], self.times, static)

    def at(self, views: Tensor) -> ViewTracks:
        """Some views."""
        x, weights, scales, transforms = (p[:, views] for p in (self.x, self.weights, self.scales, self.transforms))
        return ViewTracks(x, weights, scales, transforms, self.times[views], self.static)

    def scale(self) -> Tensor:
        """Normalized unit over measured unit, ``(b,)``, over all views."""
        return self.scales.square().mean(-1).sqrt()

    def only(self, weights: Tensor) -> ViewTracks:
        """Other weights."""
        return replace(self, weights=weights)

    def resting(self) -> ViewTracks:
        """The points known to stand still alone."""
        assert self.static is not None
        return self.only(self.weights * self.static[:, None])

    def repeated(self, count: int) -> ViewTracks:
        """Every problem so many times in a row."""
        x, weights, scales, transforms = (
            part.repeat_interleave(count, dim=0) for part in (self.x, self.weights, self.scales, self.transforms)
        )
        static = None if self.static is None else self.static.repeat_interleave(count, dim=0)
        return ViewTracks(x, weights, scales, transforms, self.times, static)


@dataclass(frozen=True)
class Projections:
    """Projections and points in a projective frame, or their failure."""

    projections: Tensor
    """``(b, views, l + 1, K)``, zero where there are none."""
    structure: Tensor
    """``(b, n, K)``, zero where a point is not determined."""
    status: Tensor
    """``(b,)`` of :class:`~dyntorch.core.solution.Status`."""


def camera_unknowns(views: int, rows: int, columns: int, gauge: int | None = None) -> int:
    """Entries of so many cameras up to scale, less the gauge: by default that of projections, the collineations of
    :math:`P^k`."""
    return views * (rows * columns - 1) - (columns**2 - 1 if gauge is None else gauge)


NUM_VIEW_SUBSETS = 6  # choices of views that a tensor is fitted to; the one of least error in all views wins
NUM_SCORED_SUBSETS = 60  # choices of views that are scored by what they see and how far they spread


def view_subsets(tracks: ViewTracks, size: int) -> Tensor:
    """Indices ``(b, s, size)`` of views for the tensor: seen by many points in common, spread over the time."""
    views = tracks.weights.shape[1]
    device = tracks.x.device
    if comb(views, size) <= NUM_SCORED_SUBSETS:
        choices = torch.tensor(list(combinations(range(views), size)), device=device)
    else:
        draw = torch.rand(NUM_SCORED_SUBSETS, views, generator=torch.Generator().manual_seed(0))
        choices = draw.argsort(-1)[:, :size].sort(-1).values.to(device)
        even = torch.linspace(0, views - 1, size).round().long().to(device)
        choices = torch.cat([even[None], choices]).unique(dim=0)
    seen = (tracks.weights > 0).to(tracks.x.dtype)[:, choices].prod(2).sum(-1)  # (b, choices)
    span = (tracks.times.amax() - tracks.times.amin()).clamp(min=torch.finfo(tracks.x.dtype).tiny)
    ordered = (tracks.times.to(device)[choices].sort(-1).values / span).to(tracks.x)
    gap = ordered.diff(dim=-1).amin(-1) * (size - 1)
    score = seen * gap.clamp(min=1e-6).sqrt()
    best = score.topk(min(NUM_VIEW_SUBSETS, len(choices)), dim=-1).indices
    return choices[best]


def projections_of_tracks(tracks: ViewTracks, invariant: GrassmannTensor, subsets: Tensor | None = None) -> Projections:
    """Linear, constrained, resected, adjusted: the best of several choices of views. subsets ``(b, s, size)``."""
    size = len(invariant.profile)
    subsets = view_subsets(tracks, size) if subsets is None else subsets
    b, count, _ = subsets.shape
    many = tracks.repeated(count)
    found = _from_subset(many, invariant, subsets.flatten(0, 1))
    if count == 1:
        return found
    error = mean_error(many, found).nan_to_num(nan=torch.inf)
    error = torch.where(is_failure(found.status), torch.inf, error).unflatten(0, (b, count))
    # where all fail the status of the first choice stands
    best = error.argmin(1) + count * torch.arange(b, device=error.device)
    return Projections(found.projections[best], found.structure[best], found.status[best])


def mean_error(tracks: ViewTracks, found: Projections) -> Tensor:
    """Mean square reprojection error ``(b,)`` over the spare observations, in measured units; points that are not determined
    cost the extent of the image."""
    error = (tracks.x - reproject(found.projections, found.structure)).square().sum(-1) * tracks.weights
    known = (found.structure != 0).any(-1)[:, None] & (tracks.weights > 0)
    missed = ((tracks.weights > 0) & ~known).to(error.dtype) * tracks.weights
    return (torch.where(known, error, 0.0) + missed).flatten(1).sum(-1) / (tracks.weights > 0).flatten(1).sum(-1).clamp(min=1)


CONSTRAINED_ITERATIONS = 3  # enough to start the structured adjustment: 18 of 20 scenes of constant_velocity_3d, as with 30
FREE_ITERATIONS = 3  # of free bundle adjustment
FREE_TOLERANCE = 1e-2  # relative gain of a step that ends it


def _from_subset(tracks: ViewTracks, invariant: GrassmannTensor, chosen: Tensor) -> Projections:
    """From one choice of views ``(b, size)`` each."""
    b, views, n, dim = tracks.x.shape
    x = tracks.x.gather(1, chosen[..., None, None].expand(-1, -1, n, dim))
    seen = tracks.weights.gather(1, chosen[..., None].expand(-1, -1, n)) > 0
    parts = x.unbind(1)
    data = Matches(tuple(parts), seen.all(1).to(x.dtype), None, (b,), x.dtype, x.device)
    linear = fit_matches(invariant, data)
    some = torch.stack(constrain_matches(linear, data, CONSTRAINED_ITERATIONS).motion, dim=1)  # (b, size, l + 1, K)
    status = linear.status
    structure = triangulate(some, x, seen.to(x.dtype))
    if views > len(invariant.profile):
        whole = resect(structure, tracks.x, tracks.weights)
        whole = whole.scatter(1, chosen[..., None, None].expand(-1, -1, *some.shape[2:]), some)
        whole, structure = _grow(tracks, whole)
        lost = _missing_views(tracks, whole).any(-1)
        status = torch.where(lost & (status == Status.OK), int(Status.DEGENERATE), status)
    else:
        order = chosen.argsort(1)
        whole = some.gather(1, order[..., None, None].expand_as(some))
    adjusted = bundle_adjust(tracks.x, tracks.weights, whole, structure, iterations=FREE_ITERATIONS, tolerance=FREE_TOLERANCE)
    bad = is_failure(status)[:, None, None]
    return Projections(torch.where(bad[..., None], 0.0, adjusted.cameras), torch.where(bad, 0.0, adjusted.structure), status)


def _grow(tracks: ViewTracks, whole: Tensor) -> tuple[Tensor, Tensor]:
    """All views and points from some of them, in turns: tracks shorter than the recording lead from views to their neighbours.
    whole ``(b, views, l + 1, K)``."""
    structure = triangulate(whole, tracks.x, _known_weights(tracks, whole))
    missing = _missing_views(tracks, whole)
    left = (missing.any(-1) & (structure != 0).flatten(1).any(-1)).nonzero()[:, 0]
    while len(left):
        some, before = tracks.subset(left), missing[left]
        # drift is adjusted away before it is built upon
        seen = _known_weights(some, whole[left])
        done = bundle_adjust(some.x, seen, whole[left], structure[left], iterations=FREE_ITERATIONS, tolerance=FREE_TOLERANCE)
        more = torch.where(before[..., None, None], resect(done.structure, some.x, some.weights), done.cameras)
        whole = whole.index_copy(0, left, more)
        structure = structure.index_copy(0, left, triangulate(more, some.x, _known_weights(some, more)))
        missing = _missing_views(tracks, whole)
        left = left[missing[left].any(-1) & (missing[left].sum(-1) < before.sum(-1))]
    return whole, structure


def _missing_views(tracks: ViewTracks, whole: Tensor) -> Tensor:
    """Views ``(b, views)`` that see something but are not known."""
    return (whole == 0).flatten(2).all(-1) & (tracks.weights > 0).any(-1)


def _known_weights(tracks: ViewTracks, whole: Tensor) -> Tensor:
    """The weights of the views that are known."""
    return tracks.weights * (whole != 0).flatten(2).any(-1)[..., None]
