"""Reconstruction from tracks of which some are wrong."""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.algebra.triangulation import reproject, resect, triangulate
from dyntorch.bundle_adjustment import bundle_adjust
from dyntorch.invariants.grassmann_tensor import GrassmannTensor
from dyntorch.solution import Status
from dyntorch.tasks.lifted_agreement import EXACT, agreeing, bound, distance, freedom, noise, settled_noise
from dyntorch.tasks.lifted_consensus import Consensus, consensus, doubtful
from dyntorch.tasks.lifted_projections import Projections, Tracks, camera_unknowns
from dyntorch.tasks.lifted_scene import Lifting, Scene, adjusted, distances, scene_of

ALARMS, RARE = 0.05, 1e-4
"""Share of the problems without outliers that are suspected, those whose farthest point is farther than in the others: where few
conditions are left for every unknown of the cameras, and where there are :data:`PLENTY`."""
PLENTY = 6.0
"""Conditions per unknown of the projections from which on one outlier cannot hide.  Of 200 scenes of constant velocity in a plane
with one outlier among 30, 60 and 100 points the rare alarm misses 40, 3.5, 0.5 %, the other one 12, 0.5, 0 % (space, 60, 100 and
200 points: 60, 28 and 8 %, 28, 8 and 0 %).  A false alarm costs the time of a robust search, fifty times that of a clean batch."""
LOUD = 0.01
"""Noise over the extent of the images from which on even residuals without extremes are looked into: where a fifth of the tracks
are altogether wrong, least squares spreads the misfit over all."""
TRUSTED = 0.7
"""Share of the observations that agree from which on no more is asked: wrong ones may be spread over most of the tracks."""
TRIMS, MOST = 2, 0.9
"""Times that observations are taken from the least squares scene, and share of them that has to stay."""
WRONG = 2.0
"""Threshold of points said to stand still over that of the others, above which they move."""
TOLERANT = 4
"""Coordinates of a point beyond its unknowns that make an accidental agreement of most observations impossible."""
WIDTHS = (6.0, 3.0, 1.5, 1.0, 1.0)
"""Thresholds over the final one, while all views settle."""
RESECTED = 10
"""Reweightings of the views that the tensor does not see."""
ADJUSTED = 10
"""Steps of bundle adjustment after each choice of the observations."""


def suspicious(tracks: Tracks, apart: Tensor, unknowns: Tensor | int, limit: float | None) -> Tensor:
    """Which problems ``(b,)`` show outliers after least squares.

    Args:
        tracks: flat batch.
        apart: ``(b, views, n)`` reprojection distances, NaN = missing.
        unknowns: of every point, ``(b, n)`` or one number.
        limit: three standard deviations of the noise, None: judged by the residuals alone.
    """
    square, free, sigma = _misfit(tracks, apart, unknowns, limit)
    if not len(apart):
        return apart.new_zeros(0, dtype=torch.bool)
    size = int(torch.as_tensor(unknowns).max()) + 1
    used = camera_unknowns(tracks.x.shape[1], tracks.x.shape[-1] + 1, size)
    plenty = size <= 5 and int(free.sum(-1).min()) >= PLENTY * used
    share = (RARE if plenty else ALARMS) / max(1, apart.shape[-1])
    loud = sigma * tracks.scales.amax(1) > LOUD
    return loud | (square > sigma.square()[:, None] * bound(free, 1 - share)).logical_and(free >= 1).any(-1)


def unfounded(tracks: Tracks, apart: Tensor, unknowns: Tensor) -> Tensor:
    """The points ``(b, n)`` said to stand still that fit by far the worst: they move.

    Args:
        tracks: flat batch, with ``static``.
        apart: ``(b, views, n)`` reprojection distances, NaN = missing.
        unknowns: of every point, ``(b, n)``.
    """
    assert tracks.static is not None
    square, free, sigma = _misfit(tracks, apart, unknowns, None)
    excess = torch.where(
        tracks.static, square / (sigma.square()[:, None] * bound(free)).clamp(min=torch.finfo(sigma.dtype).tiny), 0.0
    )
    return (excess > WRONG**2) & (excess >= excess.amax(-1, keepdim=True) / 2)


def trimmed(tracks: Tracks, scene: Scene, lifting: Lifting, unknowns: Tensor, limit: float | None) -> tuple[Scene, Tracks, Tensor]:
    """The least squares scene after the few observations that disagree with it are taken away, the tracks without them, and whether
    ``(b,)`` that is all there was to do: one wrong track in many does not need a search.

    Args:
        tracks: flat batch of suspected problems.
        scene: of least squares.
        lifting: the model.
        unknowns: of every point, ``(b, n)``.
        limit: three standard deviations of the noise, None: judged by the residuals alone.
    """
    fewer = tracks
    for _ in range(TRIMS):
        projections = scene.cameras @ lifting.lifts
        _, _, sigma = _misfit(fewer, distances(fewer, projections, scene.structure), unknowns, limit)
        fewer = tracks.only(agreeing(tracks, projections, sigma))
        structure = triangulate(projections, fewer.x, fewer.weights, steps=2)
        scene = adjusted(fewer, Scene(scene.cameras, structure, scene.cost), lifting)
    apart = distances(fewer, scene.cameras @ lifting.lifts, scene.structure)
    return scene, fewer, ~suspicious(fewer, apart, unknowns, limit) & (_kept(fewer, tracks) >= MOST)


def _misfit(tracks: Tracks, apart: Tensor, unknowns: Tensor | int, limit: float | None) -> tuple[Tensor, Tensor, Tensor]:
    """Squared distance of every point, its conditions ``(b, n)``, and the noise ``(b,)``, a third of the limit or by the median."""
    square = apart.square().nansum(1)
    free = (apart.isfinite().sum(1) * tracks.x.shape[-1] - unknowns).clamp(min=0)
    least = EXACT / tracks.scales.amin(1)
    sigma = noise(square, free, free >= 1) if limit is None else torch.full_like(least, limit / 3)
    return square, free, torch.maximum(sigma, least)


def _kept(fewer: Tracks, tracks: Tracks) -> Tensor:
    """Share ``(b,)`` of the observations that are left."""
    return (fewer.weights > 0).flatten(1).sum(-1) / (tracks.weights > 0).flatten(1).sum(-1).clamp(min=1)


def robust_projections(
    tracks: Tracks, invariant: GrassmannTensor, lifting: Lifting | None, limit: float | None, generator: torch.Generator | None
) -> tuple[Projections, Tracks]:
    """Projections from the tracks that agree, and the tracks with weight 0 for all other observations.

    Args:
        tracks: flat batch.
        invariant: of as many views as the tensor takes.
        lifting: the model, or None.
        limit: three standard deviations of the noise of one coordinate, measured unit; None: estimated.
        generator: of the random samples.
    """
    given = None if limit is None else torch.full_like(tracks.scales[:, 0], limit / 3)
    best, sigma, _ = consensus(tracks, invariant, given, generator)
    cameras = _extended(tracks, best, sigma)
    cameras = _settled(tracks, cameras, None, sigma, WIDTHS)
    sigma = _level(tracks, cameras, sigma, given)
    if lifting is not None:
        cameras = _structured(tracks, cameras, lifting, sigma, given)
        sigma = _level(tracks, cameras, sigma, given)
    fewer = tracks.only(agreeing(tracks, cameras, sigma))
    ample = tracks.x.shape[1] * tracks.x.shape[-1] >= cameras.shape[-1] + TOLERANT
    doubt = doubtful(tracks, distance(tracks, cameras), sigma, invariant) & ~((_kept(fewer, tracks) >= TRUSTED) & ample)
    status = torch.where(doubt, int(Status.NO_CONSENSUS), int(Status.OK))
    return Projections(cameras, triangulate(cameras, fewer.x, fewer.weights, steps=2), status), fewer


def _level(tracks: Tracks, cameras: Tensor, sigma: Tensor, given: Tensor | None) -> Tensor:
    """The noise ``(b,)``: as given, or that of the points that agree."""
    if given is not None:
        return given
    fewer = tracks.only(agreeing(tracks, cameras, sigma))
    free = freedom(fewer, cameras.shape[-1] - 1)
    return settled_noise(tracks, distance(fewer, cameras), free, free >= 1, camera_unknowns(*cameras.shape[1:]))


def _extended(tracks: Tracks, found: Consensus, sigma: Tensor) -> Tensor:
    """Projections of all views: the others by resection from the points that agree, reweighted."""
    b, size = found.chosen.shape
    if size == tracks.x.shape[1]:
        return found.projections.gather(1, found.chosen.argsort(1)[..., None, None].expand_as(found.projections))
    rows = torch.arange(b, device=found.chosen.device)[:, None]
    some = (tracks.x[rows, found.chosen], tracks.weights[rows, found.chosen])
    structure = triangulate(found.projections, *some, steps=2)
    free = torch.full_like(found.square, size * tracks.x.shape[-1] - structure.shape[-1] + 1).long()
    known = found.square <= sigma.square()[:, None] * bound(free)
    structure = torch.where(known[..., None], structure, 0.0)
    counted = (tracks.weights > 0) & known[:, None]
    weights, scale = tracks.weights, None
    for _ in range(RESECTED):
        whole = resect(structure, tracks.x, weights)
        square = (tracks.x - reproject(whole, structure)).square().sum(-1) / tracks.scales.square()[..., None]
        middle = square.masked_fill(~counted, torch.nan).nanmedian(-1).values.nan_to_num(nan=0.0)
        middle = torch.maximum(middle, sigma.square()[:, None])
        scale = 4 * middle if scale is None else torch.maximum(scale / 2, middle)
        weights = tracks.weights * (scale[..., None] / (scale[..., None] + square)).square()
    return whole.index_put((rows, found.chosen), found.projections)


def _settled(tracks: Tracks, cameras: Tensor, lifts: Tensor | None, sigma: Tensor, widths: tuple[float, ...]) -> Tensor:
    """Projections adjusted to the observations that agree, which are chosen again after each time."""
    for width in widths:
        projections = cameras if lifts is None else cameras @ lifts
        weights = agreeing(tracks, projections, width * sigma)
        structure = triangulate(projections, tracks.x, weights, steps=2)
        cameras = bundle_adjust(tracks.x, weights, cameras, structure, lifts, iterations=ADJUSTED).cameras
    return cameras if lifts is None else cameras @ lifts


def _structured(tracks: Tracks, cameras: Tensor, lifting: Lifting, sigma: Tensor, given: Tensor | None) -> Tensor:
    """Projections that the lifts allow, where as many observations agree with them."""
    weights = agreeing(tracks, cameras, sigma)
    fewer = tracks.only(weights)
    found = Projections(cameras, triangulate(cameras, fewer.x, weights, steps=2), torch.zeros_like(sigma).long())
    scene = scene_of(fewer, found, lifting)
    better = _settled(tracks, scene.cameras, lifting.lifts, sigma, (1.0, 1.0))
    more = (agreeing(tracks, better, sigma) > 0).sum((1, 2)) >= 0.98 * (weights > 0).sum((1, 2))
    return torch.where(more[:, None, None, None], better, cameras)
