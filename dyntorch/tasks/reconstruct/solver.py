"""The steps of a reconstruction: projections, scene, outliers, frame, labels, notices."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from dyntorch.core.limits import quantile
from dyntorch.core.outcome import Status, has_inliers, is_failure, notices
from dyntorch.geometry.bundle import bundle_adjust
from dyntorch.geometry.triangulation import triangulate, unit_projections
from dyntorch.numerics.blocks import each, replace_problems, select
from dyntorch.tasks.reconstruct.calibrated import metric_reconstruction, of_bodies
from dyntorch.tasks.reconstruct.diagnosis import diagnose, least_squares, spare, unknowns
from dyntorch.tasks.reconstruct.motions import MOTIONS, Motion
from dyntorch.tasks.reconstruct.result import Ranked, Reconstruction, ReconstructNotice, ReconstructOptions
from dyntorch.tasks.reconstruct.robust import have_outliers, moving_static_points, robust_projections, trim_outliers
from dyntorch.tasks.reconstruct.scene import (
    LiftedState,
    Lifting,
    Projections,
    ViewTracks,
    adjust_scene,
    bodies_of,
    distances,
    fix_frame,
    positions,
    projections_of_tracks,
    scene_of,
    velocities,
)


def solve(
    tracks: ViewTracks,
    motion: Motion,
    static: Tensor | None,
    limit: float | None,
    generator: torch.Generator | None,
    batch: tuple[int, ...],
    options: ReconstructOptions,
    calibration: Tensor | None = None,
) -> Reconstruction:
    """Reconstruct a flat batch of checked problems.

    Args:
        tracks: flat batch.
        motion: the model.
        static: ``(b, n)`` bool.
        limit: three standard deviations of the noise; None: estimated; infinite: no outliers.
        generator: of random samples.
        batch: the shape that the flat dimension comes from.
        options: what decides.
        calibration: K ``(b, views, l + 1, l + 1)``; None: cameras are any matrices.
    """
    lifting = None if motion.lift is None else Lifting.of(motion, tracks.times, tracks.x)
    tracks = replace(tracks, static=static)
    views = motion.views(tracks.times)
    invariant = motion.tensor(min(views, motion.k + 1))
    found = projections_of_tracks(tracks, invariant)
    found, scene = _scene(tracks, found, lifting)
    if lifting is not None and static is not None and not motion.static:
        tracks, scene = _correct_static(tracks, scene, lifting)
    free = unknowns(tracks, motion)
    doubt = have_outliers(tracks, _distances(tracks, scene, lifting), free, limit) | is_failure(found.status)
    chosen = doubt.nonzero()[:, 0] if limit != float("inf") else doubt.nonzero()[:0, 0]
    if lifting is not None and len(chosen):
        again, fewer, fine = trim_outliers(
            tracks.subset(chosen), each(lambda part: part[chosen], scene), lifting, free[chosen], limit
        )
        fine = fine & ~is_failure(found.status[chosen])
        tracks = tracks.only(tracks.weights.index_copy(0, chosen[fine], fewer.weights[fine]))
        scene = replace_problems(scene, chosen[fine], each(lambda part: part[fine], again))
        chosen = chosen[~fine]
    if len(chosen):
        some, fewer = robust_projections(tracks.subset(chosen), invariant, lifting, limit, generator, options)
        some, again = _scene(fewer, some, lifting)
        tracks = tracks.only(tracks.weights.index_copy(0, chosen, fewer.weights))
        found = replace_problems(found, chosen, some)
        scene = replace_problems(scene, chosen, again)
    return _result(tracks, motion, lifting, found, scene, static, batch, options, calibration)


MAX_STATIC_CORRECTIONS = 4  # times that points given as static are checked


def _correct_static(tracks: ViewTracks, scene: LiftedState, lifting: Lifting) -> tuple[ViewTracks, LiftedState]:
    """The scene without points said to stand still that move, a few at a time, and the tracks with the others."""
    for _ in range(MAX_STATIC_CORRECTIONS):
        assert tracks.static is not None
        wrong = moving_static_points(tracks, _distances(tracks, scene, lifting), unknowns(tracks, lifting.motion))
        left = (wrong.any(-1) & scene.cost.isfinite()).nonzero()[:, 0]
        if not len(left):
            break
        tracks = replace(tracks, static=tracks.static & ~wrong)
        some = tracks.subset(left)
        structure = triangulate(scene.cameras[left] @ lifting.lifts, some.x, some.weights)
        again = adjust_scene(some, LiftedState(scene.cameras[left], structure, scene.cost[left]), lifting)
        scene = replace_problems(scene, left, again)
    return tracks, scene


def _scene(tracks: ViewTracks, found: Projections, lifting: Lifting | None) -> tuple[Projections, LiftedState]:
    """With a lift the scene in any of its frames; bodies stay in the projective one, with their projections for cameras."""
    if lifting is not None:
        scene = scene_of(tracks, found, lifting)
        # no tensor: too few points in common, or too like each other; but a scene was found without it
        status = torch.where(is_failure(found.status) & scene.cost.isfinite(), int(Status.OK), found.status)
        return Projections(found.projections, found.structure, status), scene
    done = bundle_adjust(tracks.x, tracks.weights, found.projections, found.structure)
    return found, LiftedState(done.cameras, done.structure, done.cost)


def _distances(tracks: ViewTracks, scene: LiftedState, lifting: Lifting | None) -> Tensor:
    return distances(tracks, scene.cameras if lifting is None else scene.cameras @ lifting.lifts, scene.structure)


def _result(
    tracks: ViewTracks,
    motion: Motion,
    lifting: Lifting | None,
    found: Projections,
    scene: LiftedState,
    given: Tensor | None,
    batch: tuple[int, ...],
    options: ReconstructOptions,
    calibration: Tensor | None,
) -> Reconstruction:
    """Frame, labels, residuals and notices of solved problems, in the caller's batch."""
    bodies = None
    if lifting is None:
        bodies, points, labels, scene = bodies_of(tracks, scene)
        cameras, speed, projections = bodies[:, 0], None, scene.cameras
        structure, status = scene.structure, found.status
    else:
        scene = fix_frame(tracks, scene, lifting)
        projections = scene.cameras @ lifting.lifts
        known = (scene.structure != 0).any(-1)
        labels = torch.where(known, 2, 0)
        if tracks.static is not None:
            rests = tracks.static.any(-1, keepdim=True) & _is_static(tracks, scene, lifting, projections)
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
    status, limits = diagnose(tracks, scene, lifting, motion, status, sigma, batch, options)
    if given is not None and tracks.static is not None:
        wrong = (given & ~tracks.static).sum(-1)
        limits += tuple(notices(ReconstructNotice.STATIC_MOVES, wrong, wrong > 0, batch))
    bad = is_failure(status)

    def to_batch(value: Tensor, none: float = 0.0) -> Tensor:
        return select(bad, torch.full_like(value, none), value).reshape((*batch, *value.shape[1:]))

    nan = float("nan")
    plain = Reconstruction(
        motion=motion,
        cameras=to_batch(unit_projections(back @ cameras)),
        points=to_batch(points, nan),
        velocities=None if speed is None else to_batch(speed, nan),
        labels=to_batch(torch.where(has_inliers(status)[:, None], labels, 0)),
        residual=to_batch((total / number.clamp(min=1)).sqrt()),
        residuals=to_batch(apart, nan),
        sigma=to_batch(sigma),
        status=status.reshape(batch),
        structure=to_batch(structure),
        projections=to_batch(unit_projections(back @ (projections if lifting is None else projections @ lifting.root))),
        inliers=to_batch(counted),
        times=tracks.times,
        ambiguity=_ambiguity_text(motion, tracks.times, tracks.static),
        notices=limits,
        bodies=None if bodies is None else to_batch(unit_projections(back[:, None] @ bodies)),
    )
    if calibration is None:
        return plain
    start = scene if bodies is None else of_bodies(bodies, points, labels)
    return metric_reconstruction(plain, tracks, start, lifting, labels, calibration)


EXACT_VARIANCE = 1e-18  # of the noise of exact data, over the squared extent of the image


def _is_static(tracks: ViewTracks, scene: LiftedState, lifting: Lifting, projections: Tensor) -> Tensor:
    """Which points ``(b, n)`` are explained as well, within the noise, by one position for all times."""
    still = lifting.still
    apart = distances(tracks, projections, scene.structure)
    moving = apart.square().nansum(1)
    places = triangulate(projections @ still, tracks.x, tracks.weights, steps=2)
    resting = distances(tracks, projections @ still, places).square().nansum(1)
    free = spare(tracks, apart.isfinite(), lifting.motion).clamp(min=1)
    # rounding is noise as well
    extent = (1 / tracks.scales.amin(-1, keepdim=True)).square()
    sigma = moving.sum(-1, keepdim=True) / free[:, None] + EXACT_VARIANCE * extent
    extra = lifting.lifts.shape[-1] - lifting.lifts.shape[1]
    return resting - moving <= quantile(0.99, extra) * sigma


def _ambiguity_text(motion: Motion, times: Tensor, static: Tensor | None) -> str:
    """What the tracks cannot tell."""
    text = motion.open_text(times)
    if motion.lift is None or motion.static or motion.k == motion.dim:
        return f"known up to {text}" if text else ""
    if static is not None:
        return f"known up to {text}; the given static points fix the common motion"
    return f"known up to {text}; without static points the frame is the one in which the points move least"


# ----------------------------------------------------------------------------------------------------------------------
# The choice of a motion model by penalized cost.


MAX_HARMLESS_NOISE_RATIO = 1.1  # noise of least squares over that of the robust fit: one outlier of 100 px raises it by 800 %
MAX_CLEAR_NOISE = 0.02  # over the extent of the images: more may hide outliers


def choose(
    tracks: ViewTracks,
    static: Tensor | None,
    limit: float | None,
    generator: torch.Generator | None,
    batch: tuple[int, ...],
    options: ReconstructOptions,
    calibration: Tensor | None = None,
) -> Reconstruction:
    r"""Reconstruct with the declared model of least penalized cost; the others are listed in ``candidates``. static ``(b, n)``,
    calibration ``(b, views, l + 1, l + 1)``."""
    views, n = tracks.weights.shape[1:]
    reasons = {m.name: _missing_input(m, tracks.times, views, n) for m in MOTIONS.values() if m.sensor == tracks.x.shape[-1]}
    models = [MOTIONS[name] for name, reason in reasons.items() if not reason]
    untried = tuple(Ranked(name, math.inf, math.nan, reason) for name, reason in reasons.items() if reason)
    if not models:
        first = MOTIONS[next(iter(reasons))]
        need = first.min_views_and_tracks(tracks.times)
        raise ValueError(
            f"no declared motion takes {views} views of {n} tracks; {first.name!r} needs {need[0]} views and {need[1]} tracks"
        )
    plain = [LiftedFit.of(tracks, model, *least_squares(tracks, model)) for model in models]
    listed = rank_models(tracks, plain, limit)
    best = solve(tracks, MOTIONS[listed[0].motion], static, limit, generator, batch, options, calibration)
    fit = next(fit for fit in plain if fit.motion is best.motion)
    whole = (best.inliers.reshape(fit.apart.shape) >= fit.apart.isfinite()).flatten(1).all(1)
    # what was left out did not mislead least squares where it hardly made the noise larger
    noise = best.sigma.reshape(-1)
    harmless = (fit.sigma <= MAX_HARMLESS_NOISE_RATIO * noise) & (noise * tracks.scales.amax(1) <= MAX_CLEAR_NOISE)
    if bool((whole | harmless).all()):
        return replace(best, candidates=listed + untried)
    others = [model for model in models if model is not best.motion]
    robust = {best.motion.name: best} | {
        model.name: solve(tracks, model, static, limit, generator, batch, options, calibration) for model in others
    }
    fits = [
        LiftedFit.of(tracks, one.motion, one.residuals.reshape(tracks.weights.shape), one.status.reshape(-1))
        for one in robust.values()
    ]
    listed = rank_models(tracks, fits, limit)
    return replace(robust[listed[0].motion], candidates=listed + untried)


class LiftedFit(NamedTuple):
    """How a model fits the problems of a batch."""

    motion: Motion
    apart: Tensor
    """``(b, views, n)`` reprojection distances, NaN where an observation does not count."""
    lost: Tensor
    """``(b,)`` whether it failed."""
    sigma: Tensor
    """``(b,)`` noise that it leaves."""

    @classmethod
    def of(cls, tracks: ViewTracks, motion: Motion, apart: Tensor, status: Tensor) -> LiftedFit:
        """With the noise from the distances."""
        counted = apart.isfinite()
        sigma = (apart.square().nansum((1, 2)) / spare(tracks, counted, motion).clamp(min=1)).sqrt()
        return cls(motion, apart, is_failure(status), sigma)


def _missing_input(motion: Motion, times: Tensor, views: int, n: int) -> str:
    """What is missing of views, tracks, and observations to spare; empty where nothing is."""
    usual = motion.views(range(12))
    if views < usual:
        return f"needs {usual} views"
    need = motion.min_views_and_tracks(times)
    if need[0] > views or (motion.lift is not None and motion.ambiguity(times) > motion.ambiguity(range(12))):
        return f"needs views at {usual} different times"
    if need[1] > n:
        return f"needs {need[1]} tracks"
    if views * motion.sensor <= motion.k - (motion.bodies > 1):
        return "needs more views: a point has no observation to spare"
    return ""


def rank_models(tracks: ViewTracks, fits: list[LiftedFit], limit: float | None) -> tuple[Ranked, ...]:
    """The models by their penalized costs over the whole batch, the least first."""
    sigma = _noise(tracks, fits, limit)
    found = []
    for fit in fits:
        score = float("inf") if bool(fit.lost.all()) else float(penalized_cost(tracks, fit, sigma).sum())
        rest = fit.apart[~fit.lost]
        found.append(Ranked(fit.motion.name, score, float(rest.square().nanmean().sqrt())))
    return tuple(sorted(found, key=lambda one: one.score))


MIN_AGREEING_SHARE = 0.6  # of the observations, before the noise is taken from a model
MAX_NOISE_RATIO = 1.8  # over the least of all models, up to which a model fits: too many unknowns may leave .6 of the noise
MIN_RANKING_NOISE = 1e-9  # over the extent of the images: rounding


def _noise(tracks: ViewTracks, fits: list[LiftedFit], limit: float | None) -> Tensor:
    """The noise of every problem, ``(b,)``: a third of the limit, or what the models that fit leave in the middle."""
    floor = MIN_RANKING_NOISE / tracks.scales.square().mean(-1).sqrt()
    if limit is not None and math.isfinite(limit):
        return floor.clamp(min=limit / 3)
    count = (tracks.weights > 0).flatten(1).sum(-1)
    sound = [(fit.apart.isfinite().flatten(1).sum(-1) >= MIN_AGREEING_SHARE * count) & ~fit.lost for fit in fits]
    sigma = torch.stack([torch.where(ok, fit.sigma, torch.nan) for ok, fit in zip(sound, fits, strict=True)])
    near = sigma <= MAX_NOISE_RATIO * sigma.nan_to_num(nan=torch.inf).amin(0)
    return torch.where(near, sigma, torch.nan).nanmedian(0).values.nan_to_num(nan=1.0).maximum(floor)


OUTLIER_COST = 2.0  # of a coordinate that does not fit, in variances of the noise: Torr's lambda 3
LABEL_COST = 0.2  # of a point of two bodies: 0 takes one plane for two bodies in 1 of 5 scenes, log 2 a static scene for two planes


def penalized_cost(tracks: ViewTracks, fit: LiftedFit, sigma: Tensor) -> Tensor:
    """The penalized cost ``(b,)`` of one model; where it failed, that of outliers only.

    Torr's criterion: -2 log of the posterior, with the logarithms of BIC for points and cameras and robust squares over one noise
    that all models share.  One figure decides, and differences of it are log odds: other figures would count the data twice."""
    motion, seen = fit.motion, tracks.weights > 0
    r = seen.sum(1).to(sigma.dtype) * motion.sensor
    free = motion.k - (motion.bodies > 1)
    square = (fit.apart / sigma[:, None, None]).square()
    # an observation that was left out costs as much as one can
    square = torch.where(seen & square.isfinite(), square, torch.where(seen, OUTLIER_COST * motion.sensor, 0.0)).sum(1)
    misfit = square.minimum(OUTLIER_COST * (r - free).clamp(min=0)).sum(-1)
    cameras = r.sum(-1) - (r > 0).sum(-1) * free - spare(tracks, seen, motion)
    points = free * r.clamp(min=1).log() + LABEL_COST * (motion.bodies - 1) * (r > 0)
    return misfit + points.sum(-1) + cameras * r.sum(-1).clamp(min=1).log()
