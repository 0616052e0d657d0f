"""What should be known about a reconstruction: which of the conditions of its model fail."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from dyntorch.core.outcome import Note, Notice, Status, in_order, is_failure, noting
from dyntorch.core.solution import NOISY
from dyntorch.geometry.lift import behind
from dyntorch.geometry.pairs import hyperplane_pair
from dyntorch.geometry.triangulation import unit_projections
from dyntorch.numerics.blocks import map_blocks
from dyntorch.numerics.nullspace import eigenvalues, spectrum
from dyntorch.tasks.reconstruct.motions import Motion, smaller_motion
from dyntorch.tasks.reconstruct.result import ReconstructNotice, ReconstructOptions
from dyntorch.tasks.reconstruct.scene import (
    LiftedState,
    Lifting,
    ViewTracks,
    bodies_of,
    camera_unknowns,
    distances,
    has_points_behind,
    projections_of_tracks,
    scene_of,
)

# ----------------------------------------------------------------------------------------------------------------------
# How well noise leaves the points of a lifted scene determined, cameras and all.


BLOCK = 1 << 17
"""Entries of the largest array per block of the batch: 200 problems of 3 views and 60 points of P^4 take 0.10 s, 2^21 0.17 s."""


def point_uncertainty(
    cameras: Tensor, structure: Tensor, lifts: Tensor, depth: Tensor, weights: Tensor, gauge: int, metric: Tensor, step: int
) -> Tensor:
    r"""Standard deviation of each point per unit of noise, when cameras and points are both unknown."""
    b, views, n = weights.shape
    wide = structure.shape[-1] * cameras.shape[-2] * cameras.shape[-1] * views
    value = (structure * depth).sum(-1, keepdim=True)
    known = (structure != 0).any(-1) & (value[..., 0].abs() > 1e-12)
    unit = torch.where(known[..., None], structure / torch.where(known[..., None], value, 1.0), 0.0)
    given = cameras, unit, depth.expand(b, n, -1), weights * known[:, None], lifts, metric
    found = map_blocks(partial(_uncertainty, gauge=gauge, step=step), *given, size=max(1, BLOCK // (n * wide + 1)))
    return torch.where(known[:, ::step] & found.isfinite(), found, torch.inf)


EIGENVALUE_ROUNDING = 1e-10  # over the largest: sound scenes of 60 points have 3e-6 to .1, the gauge up to 1e-11


def _uncertainty(
    cameras: Tensor, structure: Tensor, depth: Tensor, weights: Tensor, lifts: Tensor, metric: Tensor, gauge: int, step: int
) -> Tensor:
    """The same of one block, with depths ``(b, n, K)`` and points of depth 1."""
    by_camera, by_point = _derivatives(cameras, structure, weights, lifts)
    information = torch.einsum("bvnlk,bvnlj->bnkj", by_point, by_point)
    trace = information.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    along = torch.nn.functional.normalize(structure, dim=-1)
    eye = torch.eye(structure.shape[-1], dtype=structure.dtype, device=structure.device)
    # the scale of a point is nobody's business: an equation of its own keeps it
    held = information + trace * along[..., :, None] * along[..., None, :] + torch.where(trace > 0, 1e-14 * trace, 1.0) * eye
    factor = torch.linalg.cholesky_ex(held)[0]
    between = torch.einsum("bvnlp,bvnlk->bnkvp", by_camera, by_point).flatten(-2)
    whitened = torch.linalg.solve_triangular(factor, between, upper=False)  # L^-1 W^T
    blocks = torch.einsum("bvnlp,bvnlq->bvpq", by_camera, by_camera)
    whole = torch.diag_embed(blocks.permute(0, 2, 3, 1)).permute(0, 3, 1, 4, 2).flatten(3).flatten(1, 2)
    reduced = whole - whitened.flatten(1, 2).mT @ whitened.flatten(1, 2)
    values, vectors = spectrum(reduced)
    seen = (weights > 0).any(-1).sum(-1)
    open_ = seen + gauge + (weights.shape[1] - seen) * cameras.shape[-2] * cameras.shape[-1]
    free = torch.arange(values.shape[-1], device=values.device) >= open_[:, None]
    rounding = torch.where(free, -torch.inf, values).amax(-1, keepdim=True)
    told = values > torch.maximum(EIGENVALUE_ROUNDING * values[:, -1:], 100 * rounding)
    spread = vectors * torch.where(free & told, values.clamp(min=torch.finfo(values.dtype).tiny).rsqrt(), 0.0)[:, None]
    factor, whitened, structure, depth = factor[:, ::step], whitened[:, ::step], structure[:, ::step], depth[:, ::step]
    inverse = torch.linalg.solve_triangular(factor, eye.expand_as(factor), upper=False)
    moved = torch.cat([inverse.mT, inverse.mT @ (whitened @ spread[:, None])], dim=-1)
    # at depth 1: what only changes the scale does not count
    moved = moved - structure[..., None] * (depth[..., None, :] @ moved)
    moved = metric[:, None] @ moved
    return torch.where((told | ~free).all(-1, keepdim=True), moved.square().sum((-2, -1)).sqrt(), torch.inf)


def _derivatives(cameras: Tensor, structure: Tensor, weights: Tensor, lifts: Tensor) -> tuple[Tensor, Tensor]:
    """Of the weighted images by the entries of their cameras ``(b, v, n, l, m (a + 1))`` and by the points ``(b, v, n, l, K)``."""
    world = structure[:, None] @ lifts.mT
    image = world @ cameras.mT
    below = image[..., -1:]
    seen = (weights > 0)[..., None] & (below.abs() > 1e-12)
    below = torch.where(seen, below, 1.0)
    eye = torch.eye(image.shape[-1] - 1, dtype=image.dtype, device=image.device).expand(*image.shape[:-1], -1, -1)
    slope = torch.cat([eye, -(image[..., :-1] / below)[..., None]], dim=-1) / below[..., None]
    slope = slope * torch.where(seen, weights[..., None].sqrt(), 0.0)[..., None]
    return (slope[..., None] * world[..., None, None, :]).flatten(-2), slope @ (cameras @ lifts)[:, :, None]


NOTED_UNCERTAINTY = 0.1  # expected error of the points over the size of the scene from which smaller models are tried
SMALLER_NOISE_RATIO = 1.25  # noise of a smaller model over that of the model, up to which it explains the tracks
NOISE_ROUNDING = 1e-7  # noise over the extent of the images that counts as none
MIN_STACK = 3e-3  # least singular value of the stacked projections: .015 to .8 in sound scenes, below .005 with a fixed camera
MAX_NOISE_OVER_STACK = 0.3  # noise over that value: up to .1 in sound scenes, above .3 with a fixed camera


def diagnose(
    tracks: ViewTracks,
    scene: LiftedState,
    lifting: Lifting | None,
    motion: Motion,
    status: Tensor,
    sigma: Tensor,
    batch: tuple[int, ...],
    options: ReconstructOptions,
) -> tuple[Tensor, tuple[Notice, ...]]:
    """The status ``(b,)`` of every problem, judged by the scene, and the notices on all of them."""
    found, note = noting(batch)
    lost = (scene.cameras == 0).flatten(1).all(-1) | ~scene.cameras.isfinite().flatten(1).all(-1)
    status = torch.where(lost & ~is_failure(status), int(Status.DEGENERATE), status)
    enough, size = _num_through(tracks, motion)
    status = torch.where(is_failure(status) & (enough < motion.tensor(size).minimal()), int(Status.TOO_FEW), status)
    solved = ~is_failure(status)
    noise = sigma * tracks.scale()
    stack, doubt = conditions(tracks, scene, lifting, noise)
    stack, doubt = torch.where(solved, stack, 0.0), torch.where(solved, doubt, torch.inf)
    cheap = motion.k <= 4 or motion.bodies > 1
    suspect = (status == Status.DEGENERATE) | (solved & (doubt > NOTED_UNCERTAINTY)) | ((status == Status.AMBIGUOUS) & cheap)
    explained = torch.zeros_like(solved)
    for entry in motion.smaller:
        smaller = smaller_motion(entry)
        asked = (suspect | (smaller.static & (status == Status.AMBIGUOUS))) & ~explained
        left = _noise_left_by(tracks, smaller, asked)
        same = asked & (left <= SMALLER_NOISE_RATIO * torch.where(solved, noise, 0.0) + NOISE_ROUNDING)
        note(ReconstructNotice[entry.notice.upper()], left / tracks.scale(), same, case=entry.case, smaller=smaller.name)
        explained = explained | same
    judged = torch.where((explained | (doubt > options.max_uncertainty)) & solved, int(Status.AMBIGUOUS), int(Status.OK))
    astray = torch.zeros_like(solved) if lifting is None else has_points_behind(tracks, scene, lifting)
    judged = torch.where(solved & ~explained & ((noise > NOISY) | astray), int(Status.NO_CONSENSUS), judged)
    status = torch.where((status == Status.OK) | (status == Status.AMBIGUOUS), judged, status)
    note(ReconstructNotice.UNCERTAIN, doubt, solved & (doubt > NOTED_UNCERTAINTY) & doubt.isfinite())
    note(ReconstructNotice.UNCERTAIN, doubt, solved & doubt.isinf(), case="family")
    note(ReconstructNotice.WEAK_STACK, stack, solved & ((stack < MIN_STACK) | (noise > MAX_NOISE_OVER_STACK * stack)))
    _observations(tracks, motion, status, note)
    _images(tracks, scene, lifting, noise, solved, note)
    if lifting is None:
        status = _bodies(scene, status, noise, solved, note)
    return status, in_order(found)


NUM_SAMPLED_POINTS = 20  # whose median uncertainty is taken


def conditions(tracks: ViewTracks, scene: LiftedState, lifting: Lifting | None, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Least singular value of the stacked projections over the largest, in coordinates in which the points fill the space, and
    the median expected error of the points over the size of the scene, ``(b,)`` each."""
    unit = torch.nn.functional.normalize(scene.structure.nan_to_num(), dim=-1)
    size = unit.shape[-1]
    eye = torch.eye(size, dtype=unit.dtype, device=unit.device)
    known = (unit != 0).any(-1)
    moments = unit.mT @ unit / known.sum(-1).clamp(min=1)[:, None, None] + 1e-12 * eye
    spread = torch.linalg.cholesky_ex(moments)[0]
    projections = scene.cameras if lifting is None else scene.cameras @ lifting.lifts
    white = unit_projections(projections @ spread[:, None]).nan_to_num()
    values = torch.linalg.svdvals(white.flatten(1, 2))
    stack = values[:, -1] / values[:, 0].clamp(min=torch.finfo(values.dtype).tiny)
    points = torch.linalg.solve_triangular(spread, unit.mT, upper=False).mT
    if lifting is None:
        points = torch.nn.functional.normalize(points, dim=-1)
        cameras, lifts, depth, metric = white, eye.expand(*white.shape[:2], -1, -1), points, eye.expand(len(white), -1, -1)
        gauge, extent = size**2 - 1, torch.ones_like(stack)
    else:
        below = lifting.lifts[:, -1].mean(0)
        world = (unit[:, None] @ lifting.lifts.mT).flatten(1, 2)
        axes = torch.linalg.cholesky_ex(world.mT @ world / world.shape[1] + 1e-12 * eye[: world.shape[-1], : world.shape[-1]])[0]
        cameras = unit_projections(scene.cameras @ axes[:, None]).nan_to_num()
        lifts = torch.linalg.solve_triangular(axes[:, None], lifting.lifts @ spread[:, None], upper=False)
        depth, metric = (below @ spread)[:, None], spread
        gauge, extent = len(lifting.algebra) - 1, _extent(scene.structure.nan_to_num(), below, known)
    step = -(-known.shape[-1] // NUM_SAMPLED_POINTS)
    found = point_uncertainty(cameras, points, lifts, depth, tracks.weights, gauge, metric, step)
    middle = torch.where(known[:, ::step], found, torch.nan).nanmedian(-1).values
    return stack, (middle * noise / extent).nan_to_num(nan=torch.inf, posinf=torch.inf)


def _extent(structure: Tensor, depth: Tensor, known: Tensor) -> Tensor:
    """Median distance of the points, scaled to depth 1, from their middle, ``(b,)``."""
    below = (structure @ depth)[..., None]
    unit = torch.where(known[..., None], structure / torch.where(below.abs() > 1e-12, below, 1.0), torch.nan)
    off = (unit - unit.nanmedian(1, keepdim=True).values).norm(dim=-1)
    return off.nanmedian(-1).values.nan_to_num().clamp(min=torch.finfo(off.dtype).tiny)


def least_squares(tracks: ViewTracks, motion: Motion) -> tuple[Tensor, Tensor]:
    """Reprojection distances ``(b, views, n)`` of a model fitted to all observations, in the unit of the tracks, and its status."""
    size = min(motion.views(tracks.times), motion.k + 1)
    found = projections_of_tracks(tracks, motion.tensor(size))
    if motion.lift is None:
        scene = bodies_of(tracks, LiftedState(found.projections, found.structure, torch.zeros_like(tracks.x[:, 0, 0, 0])))[-1]
        return distances(tracks, scene.cameras, scene.structure), found.status
    lifting = Lifting.of(motion, tracks.times, tracks.x)
    scene = scene_of(tracks, found, lifting)
    return distances(tracks, scene.cameras @ lifting.lifts, scene.structure), found.status


def spare(tracks: ViewTracks, counted: Tensor, motion: Motion) -> Tensor:
    """Observed coordinates less all unknowns, ``(b,)``; two bodies with their hyperplanes."""
    views, wide = tracks.x.shape[1], motion.sensor + 1
    if motion.lift is None:
        cameras = camera_unknowns(views, wide, motion.k + 1) + 2 * motion.k
    else:
        cameras = camera_unknowns(views, wide, motion.dim + 1, motion.ambiguity(tracks.times))
    points = torch.where(counted.any(1), unknowns(tracks, motion), 0).sum(-1)
    return counted.flatten(1).sum(-1) * motion.sensor - points - cameras


def unknowns(tracks: ViewTracks, motion: Motion) -> Tensor:
    """Unknowns of every point, ``(b, n)``: those of the model, of a point known to stand still its position."""
    free = torch.full_like(tracks.weights[:, 0], motion.k - (motion.bodies > 1), dtype=torch.long)
    return free if tracks.static is None or motion.lift is None else torch.where(tracks.static, motion.dim, free)


def _noise_left_by(tracks: ViewTracks, motion: Motion, asked: Tensor) -> Tensor:
    """Noise ``(b,)`` in normalized images that another model leaves; infinite where it was not asked for, or has no result."""
    left = torch.full_like(tracks.x[:, 0, 0, 0], torch.inf)
    chosen = asked.nonzero()[:, 0]
    views, n = tracks.weights.shape[1:]
    need = motion.views(tracks.times)
    if not len(chosen) or need > views or n < motion.tensor(min(need, motion.k + 1)).minimal():
        return left
    some = tracks.subset(chosen)
    apart, status = least_squares(some, motion)
    counted = apart.isfinite()
    mean = (apart.square().nansum((1, 2)) / spare(some, counted, motion).clamp(min=1)).sqrt() * some.scale()
    # a model that loses points explains nothing
    whole = counted.flatten(1).sum(-1) >= 0.9 * (some.weights > 0).flatten(1).sum(-1)
    return left.index_copy(0, chosen, torch.where(is_failure(status) | ~whole, torch.inf, mean))


def _observations(tracks: ViewTracks, motion: Motion, status: Tensor, note: Note) -> None:
    """Notices on tracks and views with too few observations."""
    seen = tracks.weights > 0
    need = -(-motion.k // motion.sensor)
    count = seen.sum(1)
    few = ((count > 0) & (count < need)).sum(-1)
    note(ReconstructNotice.FEW_OBSERVED, few, (few > 0) & ~is_failure(status), case="points", needed=need)
    enough, size = _num_through(tracks, motion)
    least = motion.tensor(size).minimal()
    where = {"case": "tracks", "views": size, "motion": motion.name, "needed": least}
    note(ReconstructNotice.FEW_OBSERVED, enough, status == Status.TOO_FEW, **where)


def _num_through(tracks: ViewTracks, motion: Motion) -> tuple[Tensor, int]:
    """How many tracks ``(b,)`` are seen in as many views as the tensor takes, and these."""
    size = min(motion.views(tracks.times), motion.k + 1)
    return ((tracks.weights > 0).sum(1) >= size).sum(-1), size


MIN_LINE_SIGMAS = 3.0  # standard deviations across a line of images below which they may lie on it


def _images(tracks: ViewTracks, scene: LiftedState, lifting: Lifting | None, noise: Tensor, solved: Tensor, note: Note) -> None:
    """Notices on images on a line, and on points behind the cameras."""
    seen = (tracks.weights > 0).to(tracks.x.dtype)
    number = seen.sum(-1).clamp(min=1)[..., None]
    off = (tracks.x - (seen[..., None] * tracks.x).sum(2, keepdim=True) / number[..., None]) * seen[..., None]
    across = eigenvalues(off.mT @ off / number[..., None])[..., -2].clamp(min=0).sqrt()
    across = torch.where(seen.sum(-1) > 2, across, torch.inf).amin(1)
    thin = across / noise.nan_to_num(posinf=0.0).clamp(min=NOISE_ROUNDING)
    note(ReconstructNotice.COLLINEAR, thin, thin < MIN_LINE_SIGMAS)
    if lifting is None or tracks.x.shape[-1] != 2:
        return
    count = behind(scene.cameras, scene.structure, lifting.lifts, tracks.weights).sum(-1)
    note(ReconstructNotice.BEHIND, count, solved & (count > 0))


def _bodies(scene: LiftedState, status: Tensor, noise: Tensor, solved: Tensor, note: Note) -> Tensor:
    """The status where a body has too few points for its hyperplane, and a notice."""
    known = (scene.structure != 0).any(-1) & solved[:, None]
    pair = hyperplane_pair(scene.structure, known.to(scene.structure.dtype))
    least, size = torch.stack([(pair.labels == body).sum(-1) for body in (1, 2)]).amin(0), scene.structure.shape[-1]
    # a hyperplane of noisy points takes the nearest one of the others in
    few = solved & (least < size - 1 + (noise > NOISE_ROUNDING))
    note(ReconstructNotice.ONE_BODY, least, few, case="few", needed=size - 1)
    return torch.where(few & (status == Status.OK), int(Status.AMBIGUOUS), status)
