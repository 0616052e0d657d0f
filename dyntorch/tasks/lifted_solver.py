"""The steps of a reconstruction: projections, scene, outliers, frame, labels, notices."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import torch
from torch import Tensor

from dyntorch.algebra.triangulation import triangulate, unit_projections
from dyntorch.bundle_adjustment import bundle_adjust
from dyntorch.chi_square import quantile
from dyntorch.motions import Motion
from dyntorch.solution import Status, agreed, failed
from dyntorch.tasks.lifted_bodies import bodies_of
from dyntorch.tasks.lifted_diagnosis import diagnose, spare, unknowns
from dyntorch.tasks.lifted_projections import Projections, Tracks, projections_of_tracks
from dyntorch.tasks.lifted_robust import robust_projections, suspicious, trimmed, unfounded
from dyntorch.tasks.lifted_scene import Lifting, Scene, adjusted, distances, framed, positions, scene_of, velocities
from dyntorch.tasks.notices import NoticeCode, notices
from dyntorch.tasks.reconstruction import Reconstruction

Part = TypeVar("Part", Projections, Scene)

CORRECTIONS = 4
"""Times that points said to stand still are looked at."""
EXACT = 1e-18
"""Square of the noise, over that of the extent of the image, that exact data are taken to have."""


def solve(
    tracks: Tracks,
    motion: Motion,
    static: Tensor | None,
    limit: float | None,
    generator: torch.Generator | None,
    batch: tuple[int, ...],
) -> Reconstruction:
    """Reconstruct a flat batch of checked problems.

    Args:
        tracks: flat batch.
        motion: the model.
        static: ``(b, n)`` bool.
        limit: three standard deviations of the noise; None: estimated; infinite: no outliers.
        generator: of random samples.
        batch: the shape that the flat dimension comes from.
    """
    lifting = None if motion.lift is None else Lifting.of(motion, tracks.times, tracks.x)
    tracks = replace(tracks, static=static)
    views = motion.views(tracks.times)
    invariant = motion.tensor(min(views, motion.k + 1))
    found = projections_of_tracks(tracks, invariant)
    found, scene = _scene(tracks, found, lifting)
    if lifting is not None and static is not None and not motion.static:
        tracks, scene = _corrected(tracks, scene, lifting)
    free = unknowns(tracks, motion)
    doubt = suspicious(tracks, _distances(tracks, scene, lifting), free, limit) | failed(found.status)
    chosen = doubt.nonzero()[:, 0] if limit != float("inf") else doubt.nonzero()[:0, 0]
    if lifting is not None and len(chosen):
        again, fewer, fine = trimmed(tracks.subset(chosen), _part(scene, chosen), lifting, free[chosen], limit)
        fine = fine & ~failed(found.status[chosen])
        tracks = tracks.only(tracks.weights.index_copy(0, chosen[fine], fewer.weights[fine]))
        scene = _merged(scene, _part(again, fine), chosen[fine])
        chosen = chosen[~fine]
    if len(chosen):
        some, fewer = robust_projections(tracks.subset(chosen), invariant, lifting, limit, generator)
        some, again = _scene(fewer, some, lifting)
        tracks = tracks.only(tracks.weights.index_copy(0, chosen, fewer.weights))
        found = _merged(found, some, chosen)
        scene = _merged(scene, again, chosen)
    return _result(tracks, motion, lifting, found, scene, static, batch)


def _corrected(tracks: Tracks, scene: Scene, lifting: Lifting) -> tuple[Tracks, Scene]:
    """The scene without points said to stand still that move, a few at a time, and the tracks with the others."""
    for _ in range(CORRECTIONS):
        assert tracks.static is not None
        wrong = unfounded(tracks, _distances(tracks, scene, lifting), unknowns(tracks, lifting.motion))
        left = (wrong.any(-1) & scene.cost.isfinite()).nonzero()[:, 0]
        if not len(left):
            break
        tracks = replace(tracks, static=tracks.static & ~wrong)
        some = tracks.subset(left)
        structure = triangulate(scene.cameras[left] @ lifting.lifts, some.x, some.weights)
        again = adjusted(some, Scene(scene.cameras[left], structure, scene.cost[left]), lifting)
        scene = _merged(scene, again, left)
    return tracks, scene


def _scene(tracks: Tracks, found: Projections, lifting: Lifting | None) -> tuple[Projections, Scene]:
    """With a lift the scene in any of its frames; bodies stay in the projective one, with their projections for cameras."""
    if lifting is not None:
        scene = scene_of(tracks, found, lifting)
        # no tensor: too few points in common, or too like each other; but a scene was found without it
        status = torch.where(failed(found.status) & scene.cost.isfinite(), int(Status.OK), found.status)
        return Projections(found.projections, found.structure, status), scene
    done = bundle_adjust(tracks.x, tracks.weights, found.projections, found.structure)
    return found, Scene(done.cameras, done.structure, done.cost)


def _merged(old: Part, new: Part, chosen: Tensor) -> Part:
    """Results of some problems in their places."""
    return type(old)(*(a.index_copy(0, chosen, b) for a, b in zip(vars(old).values(), vars(new).values(), strict=True)))


def _part(whole: Part, keep: Tensor) -> Part:
    """Some problems."""
    return type(whole)(*(part[keep] for part in vars(whole).values()))


def _distances(tracks: Tracks, scene: Scene, lifting: Lifting | None) -> Tensor:
    return distances(tracks, scene.cameras if lifting is None else scene.cameras @ lifting.lifts, scene.structure)


def _result(
    tracks: Tracks,
    motion: Motion,
    lifting: Lifting | None,
    found: Projections,
    scene: Scene,
    given: Tensor | None,
    batch: tuple[int, ...],
) -> Reconstruction:
    """Frame, labels, residuals and notices of solved problems, in the caller's batch."""
    bodies = None
    if lifting is None:
        bodies, points, labels, scene = bodies_of(tracks, scene)
        cameras, speed, projections = bodies[:, 0], None, scene.cameras
        structure, status = scene.structure, found.status
    else:
        scene = framed(tracks, scene, lifting)
        projections = scene.cameras @ lifting.lifts
        known = (scene.structure != 0).any(-1)
        labels = torch.where(known, 2, 0)
        if tracks.static is not None:
            rests = tracks.static.any(-1, keepdim=True) & _rests(tracks, scene, lifting, projections)
            labels = torch.where(known & (tracks.static | rests), 1, labels)
        status = found.status
        cameras, structure = scene.cameras, scene.structure @ lifting.back.mT
        points = positions(scene.structure, lifting.start)
        speed = velocities(scene.structure, lifting.start, lifting.slope)
    apart = distances(tracks, projections, scene.structure)
    counted = apart.isfinite()
    total = torch.where(counted, apart.square(), 0.0).flatten(1).sum(-1)
    number = counted.flatten(1).sum(-1)
    sigma = (total / spare(tracks, counted, motion).clamp(min=1)).sqrt()
    back = torch.linalg.inv(tracks.transforms)
    status, warnings = diagnose(tracks, scene, lifting, motion, status, sigma, batch)
    if given is not None and tracks.static is not None:
        wrong = (given & ~tracks.static).sum(-1)
        text = "{value:g} points given as static move, and are taken as moving; take them off static="
        warnings += tuple(notices(NoticeCode.STATIC_MOVES, text, wrong, wrong > 0, batch))
    bad = failed(status)

    def shaped(value: Tensor, none: float = 0.0) -> Tensor:
        wide = bad[(..., *[None] * (value.ndim - 1))]
        return torch.where(wide, torch.full_like(value, none), value).reshape((*batch, *value.shape[1:]))

    nan = float("nan")
    return Reconstruction(
        motion=motion,
        cameras=shaped(unit_projections(back @ cameras)),
        points=shaped(points, nan),
        velocities=None if speed is None else shaped(speed, nan),
        labels=shaped(torch.where(agreed(status)[:, None], labels, 0)),
        residual=shaped((total / number.clamp(min=1)).sqrt()),
        residuals=shaped(apart, nan),
        sigma=shaped(sigma),
        status=status.reshape(batch),
        structure=shaped(structure),
        projections=shaped(unit_projections(back @ (projections if lifting is None else projections @ lifting.root))),
        inliers=shaped(counted),
        times=tracks.times,
        ambiguity=_open(motion, tracks.times, tracks.static),
        warnings=warnings,
        bodies=None if bodies is None else shaped(unit_projections(back[:, None] @ bodies)),
    )


def _rests(tracks: Tracks, scene: Scene, lifting: Lifting, projections: Tensor) -> Tensor:
    """Which points ``(b, n)`` are explained as well, within the noise, by one position for all times."""
    still = lifting.still
    apart = distances(tracks, projections, scene.structure)
    moving = apart.square().nansum(1)
    places = triangulate(projections @ still, tracks.x, tracks.weights, steps=2)
    resting = distances(tracks, projections @ still, places).square().nansum(1)
    free = spare(tracks, apart.isfinite(), lifting.motion).clamp(min=1)
    # rounding is noise as well
    extent = (1 / tracks.scales.amin(-1, keepdim=True)).square()
    sigma = moving.sum(-1, keepdim=True) / free[:, None] + EXACT * extent
    extra = lifting.lifts.shape[-1] - lifting.lifts.shape[1]
    return resting - moving <= quantile(0.99, extra) * sigma


def _open(motion: Motion, times: Tensor, static: Tensor | None) -> str:
    """What the tracks cannot tell."""
    text = motion.open_text(times)
    if motion.lift is None or motion.static or motion.k == motion.dim:
        return f"known up to {text}" if text else ""
    if static is not None:
        return f"known up to {text}; the given static points fix the common motion"
    return f"known up to {text}; without static points the frame is the one in which the points move least"
