"""From projections of P^k to the scene: the upgrade by the lifts, structured bundle adjustment, and the frame that is shown."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations
from math import comb

import torch
from torch import Tensor

from dyntorch.core.fit import fit_matches
from dyntorch.core.matches import Matches
from dyntorch.core.outcome import Status, is_failure
from dyntorch.core.refine import constrain_matches
from dyntorch.geometry.bundle import bundle_adjust, point_information
from dyntorch.geometry.lift import (
    balance_lifts,
    balanced_algebra,
    behind,
    center_frame,
    change_frame,
    finite,
    gauge_algebra,
    steadiest_frame,
    upgrade,
)
from dyntorch.geometry.pairs import hyperplane_pair, two_bodies
from dyntorch.geometry.triangulation import reproject, resect, triangulate, unit_projections
from dyntorch.invariants.grassmann_tensor import GrassmannTensor
from dyntorch.tasks.reconstruct.motions import Motion

# ----------------------------------------------------------------------------------------------------------------------
# Projections P^k -> P^l and points from tracks: tensor of a few views, resection of the others, free bundle adjustment.


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
        return self._each(lambda part: part[keep])

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

    def static_points(self) -> ViewTracks:
        """The points known to stand still alone."""
        assert self.static is not None
        return self.only(self.weights * self.static[:, None])

    def repeat(self, count: int) -> ViewTracks:
        """Every problem so many times in a row."""
        return self._each(lambda part: part.repeat_interleave(count, dim=0))

    def _each(self, function: Callable[[Tensor], Tensor]) -> ViewTracks:
        x, weights, scales, transforms = map(function, (self.x, self.weights, self.scales, self.transforms))
        return ViewTracks(x, weights, scales, transforms, self.times, None if self.static is None else function(self.static))


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
    many = tracks.repeat(count)
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


# ----------------------------------------------------------------------------------------------------------------------
# From projections of P^k to the scene: the upgrade by the lifts, structured bundle adjustment, and the frame that is shown.


# ----------------------------------------------------------------------------------------------------------------------
# Starts of structured bundle adjustment that need no tensor: the scene as if it stood still, in several frames.


WINDOW_VIEWS = (6, 5)  # views taken at once, in turn, where there are more


def middle_views(times: Tensor, number: int = 0) -> Tensor:
    """Indices of the views in the middle of the time, during which nothing moves far; all, where they are few."""
    count = len(times) if len(times) <= WINDOW_VIEWS[0] else WINDOW_VIEWS[number % len(WINDOW_VIEWS)]
    first = (len(times) - count) // 2
    return times.argsort()[first : first + count].sort().values


STATIC_TOLERANCE = 1e-8  # share of the lifts below which constants of a point do not change its position


def static_constants(lifts: Tensor) -> Tensor:
    """Orthonormal ``(K, a + 1)`` constants of the points that do not move; of no columns where not all positions are theirs."""
    change = (lifts - lifts.mean(0)).flatten(0, 1)
    _, values, vh = torch.linalg.svd(change, full_matrices=True)
    still = vh[int((values > STATIC_TOLERANCE * lifts.norm()).sum()) :].mT
    return still if still.shape[-1] >= lifts.shape[-2] else still[:, :0]


STATIC_TENSOR_VIEWS = 4  # views of the tensor of the static scene in space


def static_cameras(tracks: ViewTracks, sensor: int, dim: int) -> Tensor:
    """The cameras ``(b, views, l + 1, dim + 1)`` that explain tracks best if no point moves, points finite and of unit
    variance."""
    eye = torch.eye(dim + 1, dtype=tracks.x.dtype, device=tracks.x.device)
    views = tracks.x.shape[1]
    still = Motion(lambda time: torch.eye(dim + 1, dtype=torch.float64), sensor=sensor, static=True)
    invariant = still.tensor(min(views, STATIC_TENSOR_VIEWS if dim + 1 > sensor + 1 else 2))
    found = projections_of_tracks(tracks, invariant, view_subsets(tracks, len(invariant.profile))[:, :1])
    lifts = eye.expand(views, -1, -1)
    known = (found.structure != 0).any(-1).to(tracks.x.dtype)
    G, cameras, structure = finite(found.projections, found.structure, lifts, gauge_algebra(lifts), tracks.weights)
    cameras, structure = change_frame(G, cameras, structure, lifts)
    cameras, _ = change_frame(center_frame(structure, lifts, known), cameras, structure, lifts)
    return cameras


INFINITY_TILT = 0.25  # standard deviation of the hyperplane at infinity of further starts, points of unit variance


def tilt_infinity(cameras: Tensor, number: int) -> Tensor:
    """Cameras of the resting scene in one of many frames: the first as nearly affine as it can be, the others with the infinite
    tilted."""
    size = cameras.shape[-1]
    frame = torch.eye(size, dtype=torch.float64)
    if number:
        frame[-1, :-1] = INFINITY_TILT * torch.randn(size - 1, generator=torch.Generator().manual_seed(number), dtype=torch.float64)
    return cameras @ frame.to(cameras)


MIN_STATIC_POINTS = {2: 6, 3: 12}
"""Points known to stand still and seen by all views, half as many more as determine the cameras, from which on they do: in a plane
and in space."""


@dataclass(frozen=True)
class Lifting:
    """A motion model at the times of the views, in coordinates of :math:`P^k` in which neither the unit nor the origin of time
    matters."""

    motion: Motion
    lifts: Tensor
    """``(views, a + 1, K)`` with orthonormal columns in all."""
    root: Tensor
    """``(K, K)``: Y in these coordinates is root times Y of the model."""
    back: Tensor
    """``(K, K)`` its inverse."""
    start: Tensor
    """``(a + 1, K)`` the lift at time 0 in these coordinates."""
    slope: Tensor
    """``(a + 1, K)`` its derivative."""
    middle: Tensor
    """``(a + 1, K)`` the lift at the mean time of the views."""
    algebra: Tensor
    """``(dim, K, K)`` the ambiguity."""
    still: Tensor
    """``(K, a + 1)`` orthonormal: the constants of points that stand still; of no columns where none can."""

    @classmethod
    def of(cls, motion: Motion, times: Tensor, like: Tensor) -> Lifting:
        """The motion at these times, on the device of ``like``."""
        span = float(times.max() - times.min()) / max(1, len(times) - 1)
        even, shift, origin = motion.centred_lifts(times)
        lifts, root = balance_lifts(even)
        inverse = torch.linalg.inv(root)
        start, slope = motion.lifts([-origin])[0] @ inverse, motion.slope(-origin, span or 1.0) @ inverse
        middle = motion.lifts([float(times.mean()) - origin])[0] @ inverse
        # a shift is inverted exactly by the opposite one, however far
        back = (torch.eye(len(root), dtype=root.dtype) if motion.shift is None else motion.shift(-origin)) @ inverse
        parts = (lifts, root @ shift, back, start, slope, middle, balanced_algebra(lifts), static_constants(lifts))
        return cls(motion, *(part.to(like) for part in parts))


@dataclass(frozen=True)
class LiftedState:
    """Cameras and points of a scene, normalized images."""

    cameras: Tensor
    """``(b, views, l + 1, a + 1)``."""
    structure: Tensor
    """``(b, n, K)``, zero where a point is not determined."""
    cost: Tensor
    """``(b,)``."""


MULTISTART_SIZE = 7  # K from which on one start is not enough: in P^6 one of the tensor misses the minimum in 5 of 20 scenes
MULTISTART_SPARE = 6  # spare coordinates per point beyond which it is enough there as well


def scene_of(tracks: ViewTracks, found: Projections, lifting: Lifting) -> LiftedState:
    """Cameras and points from projections in a projective frame, and from the scene as if it stood still where that is safer."""
    lost = is_failure(found.status)
    aided = _static_points_suffice(tracks, lifting)
    coordinates = (tracks.weights > 0).sum(1) * tracks.x.shape[-1]
    size = lifting.lifts.shape[-1]
    known = torch.where(lost[:, None], coordinates >= size - 1, (found.structure != 0).any(-1))
    # of lost problems anything finite
    cameras = upgrade(torch.where(lost[:, None, None, None], 1.0, found.projections), lifting.lifts)[1]
    scene = _scene(tracks, cameras, known & ~lost[:, None], lifting)
    scene = replace(scene, cost=torch.where(lost, torch.inf, scene.cost))
    spare = (coordinates * known).sum(-1) - (size - 1) * known.sum(-1)
    shaky = ~lost & (size >= MULTISTART_SIZE) & (spare <= MULTISTART_SPARE * known.sum(-1))
    shaky = shaky | (~lost & has_points_behind(tracks, _finite(tracks, scene, lifting), lifting))
    unknown = camera_unknowns(tracks.x.shape[1], tracks.x.shape[-1] + 1, lifting.lifts.shape[1], len(lifting.algebra) - 1)
    unaided = (found.status == Status.TOO_FEW) & (spare > unknown)
    left = (shaky | unaided | aided).nonzero()[:, 0] if lifting.still.shape[-1] else lost.new_zeros(0, dtype=torch.long)
    return _multistart(tracks, scene, left, known, lifting) if len(left) else scene


MAX_BEHIND_SHARE = 0.05  # of the points: wrong minima have a tenth to a half of them behind cameras


def has_points_behind(tracks: ViewTracks, scene: LiftedState, lifting: Lifting) -> Tensor:
    """Problems ``(b,)`` with so many points behind cameras that the scene, in a finite frame, is that of a wrong minimum."""
    if tracks.x.shape[-1] != 2:
        return torch.zeros_like(scene.cost, dtype=torch.bool)
    known = (scene.structure != 0).any(-1)
    count = (behind(scene.cameras, scene.structure, lifting.lifts, tracks.weights) & known).sum(-1)
    return count > (MAX_BEHIND_SHARE * known.sum(-1)).clamp(min=2)


def _static_points_suffice(tracks: ViewTracks, lifting: Lifting) -> Tensor:
    """Problems ``(b,)`` whose cameras follow from the points known to stand still."""
    if tracks.static is None or lifting.motion.static or not lifting.still.shape[-1]:
        return torch.zeros_like(tracks.x[:, 0, 0, 0], dtype=torch.bool)
    resting = (tracks.weights > 0) & tracks.static[:, None]
    return resting.all(1).sum(-1) >= MIN_STATIC_POINTS[min(lifting.motion.dim, 3)]


def _scene(tracks: ViewTracks, cameras: Tensor, known: Tensor, lifting: Lifting) -> LiftedState:
    """The scene that adjustment finds from some cameras, with the known points ``(b, n)``."""
    structure = triangulate(cameras @ lifting.lifts, tracks.x, tracks.weights)
    start = LiftedState(cameras, torch.where(known[..., None], structure, 0.0), torch.zeros_like(tracks.x[:, 0, 0, 0]))
    done = adjust_scene(tracks, start, lifting)
    # a point that was lost costs the extent of the image
    gone = known & (done.structure == 0).all(-1)
    return replace(done, cost=done.cost + (tracks.weights * gone[:, None]).flatten(1).sum(-1))


NUM_STATIC_STARTS = 3  # static starts beside that from the tensor
NUM_STATIC_STARTS_ALONE = 6  # static starts where the tensor gives none
SAME_COST = 1e-2  # relative difference of the costs of one minimum
COST_ROUNDING = 1e-22  # cost per observation that is rounding


def _multistart(tracks: ViewTracks, scene: LiftedState, left: Tensor, known: Tensor, lifting: Lifting) -> LiftedState:
    """The scenes of least cost among those of several starts: further ones until two of them end in the same minimum."""
    cameras, structure, cost = scene.cameras.clone(), scene.structure.clone(), scene.cost.clone()
    seen = cost[left].isfinite().long()
    alone = left[seen == 0]
    floor = COST_ROUNDING * (tracks.weights > 0).flatten(1).sum(-1)
    for number in range(NUM_STATIC_STARTS_ALONE):
        some = tracks.subset(left)
        fresh = _scene(some, _start_cameras(some, number, lifting), known[left], lifting)
        least = cost[left]
        near = fresh.cost <= least * (1 + SAME_COST) + floor[left]
        seen = torch.where(fresh.cost * (1 + SAME_COST) + floor[left] < least, 1, seen + near)
        better = fresh.cost < least
        taken = left[better]
        cameras[taken], structure[taken], cost[taken] = fresh.cameras[better], fresh.structure[better], fresh.cost[better]
        doubt = (seen < 2) & (torch.isin(left, alone) | (number + 1 < NUM_STATIC_STARTS))
        left, seen = left[doubt], seen[doubt]
        if not len(left):
            break
    # without a tensor and without points known to stand still only what was found twice counts
    cost[left[torch.isin(left, alone) & ~_static_points_suffice(tracks, lifting)[left]]] = torch.inf
    return LiftedState(cameras, structure, cost)


def _start_cameras(tracks: ViewTracks, number: int, lifting: Lifting) -> Tensor:
    """Cameras of all views from those of the scene at rest; of a part of many views: adjusted, the others by resection."""
    aided = bool(_static_points_suffice(tracks, lifting).all())
    window = middle_views(tracks.times, number)
    near = tracks.at(window)
    near = near.static_points() if aided else near
    cameras = tilt_infinity(static_cameras(near, lifting.motion.sensor, lifting.motion.dim), number)
    if len(window) == tracks.x.shape[1]:
        return cameras
    some = replace(lifting, lifts=lifting.lifts[window])
    part = _scene(tracks.at(window), cameras, torch.ones_like(tracks.weights[:, 0], dtype=torch.bool), some)
    whole = resect(part.structure, tracks.x, tracks.weights, lifts=lifting.lifts)
    return whole.index_copy(1, window.to(whole.device), part.cameras)


MAX_ITERATIONS = 60  # of structured bundle adjustment
COST_TOLERANCE = 1e-7  # relative gain of a step that ends it


def adjust_scene(tracks: ViewTracks, scene: LiftedState, lifting: Lifting) -> LiftedState:
    """Structured bundle adjustment."""
    confined = tracks.static if lifting.still.shape[-1] else None
    done = bundle_adjust(
        tracks.x,
        tracks.weights,
        scene.cameras,
        scene.structure,
        lifting.lifts,
        iterations=MAX_ITERATIONS,
        tolerance=COST_TOLERANCE,
        confined=confined,
        subspace=None if confined is None else lifting.still,
    )
    return LiftedState(done.cameras, done.structure, done.cost)


def fix_frame(tracks: ViewTracks, scene: LiftedState, lifting: Lifting) -> LiftedState:
    """The scene in its frame: finite, with no motion common to all points (to the static ones), centred, of unit size."""
    lifts, static = lifting.lifts, tracks.static
    known = (scene.structure != 0).any(-1)
    scene = _finite(tracks, scene, lifting)
    cameras, structure = scene.cameras, scene.structure
    weights = known if static is None else torch.where((known & static).any(-1, keepdim=True), known & static, known)
    G = steadiest_frame(structure, lifts, lifting.middle, lifting.algebra, weights.to(structure.dtype))
    cameras, structure = change_frame(G, cameras, structure, lifts)
    G = center_frame(structure, lifts, known.to(structure.dtype))
    cameras, structure = change_frame(G, cameras, structure, lifts)
    depth = structure @ lifts[0, -1]
    structure = structure / torch.where(depth.abs() > 1e-12, depth, 1.0)[..., None]
    return LiftedState(unit_projections(cameras), structure, scene.cost)


def _finite(tracks: ViewTracks, scene: LiftedState, lifting: Lifting) -> LiftedState:
    """The scene in a frame in which all points are finite, if there is one."""
    G, cameras, structure = finite(scene.cameras, scene.structure, lifting.lifts, lifting.algebra, tracks.weights)
    return LiftedState(*change_frame(G, cameras, structure, lifting.lifts), scene.cost)


def positions(structure: Tensor, lift: Tensor) -> Tensor:
    """Inhomogeneous positions ``(b, n, d)`` under one lift; NaN where a point is not determined."""
    homogeneous = structure @ lift.mT
    known = (structure != 0).any(-1, keepdim=True)
    return torch.where(known, homogeneous[..., :-1] / homogeneous[..., -1:], torch.nan)


def velocities(structure: Tensor, lift: Tensor, slope: Tensor) -> Tensor:
    """Their derivative by the time, by the quotient rule, ``(b, n, d)``."""
    place, change = structure @ lift.mT, structure @ slope.mT
    known = (structure != 0).any(-1, keepdim=True)
    moving = (change[..., :-1] - place[..., :-1] / place[..., -1:] * change[..., -1:]) / place[..., -1:]
    return torch.where(known, moving, torch.nan)


def distances(tracks: ViewTracks, projections: Tensor, structure: Tensor) -> Tensor:
    """Reprojection distances ``(b, views, n)`` in the unit of the measurements; NaN where missing or not determined."""
    error = (tracks.x - reproject(projections, structure)).norm(dim=-1) / tracks.scales[..., None]
    known = (structure != 0).any(-1)[:, None] & (tracks.weights > 0)
    return torch.where(known, error, torch.nan)


# ----------------------------------------------------------------------------------------------------------------------
# Two bodies in relative translation: labels, cameras of each, and their points.


BODIES_ITERATIONS = 60  # of the bundle adjustment of two bodies


def bodies_of(tracks: ViewTracks, scene: LiftedState) -> tuple[Tensor, Tensor, Tensor, LiftedState]:
    """Labels by the two hyperplanes of the points, and the affine structure of each body."""
    done = bundle_adjust(tracks.x, tracks.weights, scene.cameras, scene.structure, iterations=BODIES_ITERATIONS)
    known = (done.structure != 0).any(-1)
    information = point_information(done.cameras, done.structure, tracks.weights)
    pair = hyperplane_pair(done.structure, known.to(done.structure.dtype), information=information)
    structure = _on_hyperplanes(tracks, done.cameras, pair.hyperplanes, pair.labels)
    bodies = two_bodies(done.cameras, structure, pair.hyperplanes, pair.labels)
    points = torch.where(known[..., None], bodies.points, torch.nan)
    return bodies.cameras, points, pair.labels, LiftedState(done.cameras, structure, done.cost)


def _on_hyperplanes(tracks: ViewTracks, cameras: Tensor, hyperplanes: Tensor, labels: Tensor) -> Tensor:
    """The points, each triangulated within the hyperplane of its body."""
    total = torch.zeros_like(labels[..., None] * hyperplanes[:, :1, :])
    for body in (1, 2):
        # an orthonormal basis of the hyperplane: the last columns of a complete QR
        basis = torch.linalg.qr(hyperplanes[:, body - 1, :, None], mode="complete")[0][..., 1:]
        mine = (labels == body)[..., None]
        inside = triangulate(cameras @ basis[:, None], tracks.x, tracks.weights * mine.mT, steps=2)
        total = torch.where(mine, inside @ basis.mT, total)
    return total
