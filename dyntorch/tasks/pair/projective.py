"""Different points of one rigid body before two uncalibrated perspective cameras: both point sets in one projective frame."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import normalize

from dyntorch.core.outcome import Notice, Status
from dyntorch.geometry.body import BodyProblem, FilmedBody, fit_body
from dyntorch.geometry.homogeneous import homogeneous, similarity, skew
from dyntorch.geometry.triangulation import reproject
from dyntorch.numerics.least_squares import LeastSquaresOptions
from dyntorch.tasks.pair.result import PairNotice, PairReconstruction, failure
from dyntorch.tasks.pair.tracks import MAX_ALONG_EXTENT, MAX_ALONG_RATIO, MAX_DISTANCE_RATIO, MAX_RESIDUAL_SIGMAS, Overlap
from dyntorch.tasks.synchronize.projective import MAX_MISFIT, Poses, common_motion
from dyntorch.tasks.synchronize.rigid_body import MAX_ITERATIONS, MIN_RELATIVE_NOISE, BodyMotion, body_motion
from dyntorch.tasks.synchronize.tracks import Tracks


def body_pair(seen: Overlap, threshold: float | None, explained: float) -> PairReconstruction:
    r"""One body, two cameras, points of either's own:"""
    n, m = seen.a.shape[1], seen.b.shape[1]
    tracks = [_tracks(x, seen) for x in (seen.a, seen.b)]
    motions = []
    for name, one in zip("ab", tracks, strict=True):
        motion = body_motion(name, one)
        if isinstance(motion, Notice):
            return failure((n, m), seen.times, motion.code.refuses or Status.DEGENERATE, motion, 4, n + m)
        motions.append(motion)
    first, second = motions
    poses = [Poses.of(motion, seen.times) for motion in motions]
    shared, misfit = common_motion(poses[0], poses[1])
    if not misfit <= MAX_MISFIT:
        return failure((n, m), seen.times, Status.NO_CONSENSUS, Notice(PairNotice.TWO_MOTIONS, misfit), 4, n + m)
    body, problem = _joint_problem(first, second, shared, tracks)
    body, cost = fit_body(problem, body, LeastSquaresOptions(iterations=MAX_ITERATIONS, tolerance=1e-10))
    if not bool(cost.isfinite().all()):
        return failure((n, m), seen.times, Status.NO_CONSENSUS, Notice(PairNotice.TWO_MOTIONS, math.inf), 4, n + m)
    return _assemble(seen, body, first, second, threshold, explained)


def _tracks(x: Tensor, seen: Overlap) -> Tracks:
    known = x.isfinite().all(-1)
    step = float(seen.times.diff().median())
    return Tracks(torch.where(known[..., None], x, 0.0), known.double(), seen.times, step)


def _joint_problem(
    first: BodyMotion, second: BodyMotion, shared: tuple[Tensor, ...], tracks: list[Tracks]
) -> tuple[FilmedBody, BodyProblem]:
    """The start in the frame of a, and the problem of both cameras' tracks, each in its own unit."""
    turn, seat, (scale, *rest) = shared[0], shared[1], shared[2].split([1, 3, 3])
    place, origin = rest
    moved = (second.body.points[0] + origin) @ seat.mT / scale
    sight = torch.cat([turn, (place / scale)[:, None]], -1)
    body = FilmedBody(
        calibrations=torch.cat([first.body.calibrations, second.body.calibrations], 1),
        sights=torch.cat([first.body.sights, sight[None, None]], 1),
        motions=_merge_motions(first, second, shared),
        points=torch.cat([first.body.points, moved[None]], 1),
    )
    x, weights, camera = [], [], []
    for k, (motion, one) in enumerate(zip((first, second), tracks, strict=True)):
        own = one.x[:, motion.points]
        x.append((own - motion.centre) / motion.scale)
        noise = max(motion.residual, MIN_RELATIVE_NOISE * motion.scale)
        known = (one.weights[:, motion.points] > 0) & (first.seen | second.seen)[:, None]
        weights.append(known * (motion.scale / noise) ** 2)
        camera.append(torch.full((own.shape[1],), k, device=own.device))
    w = torch.cat(weights, 1)
    return body, BodyProblem(torch.cat(x, 1)[None], (w / w.max())[None], torch.cat(camera))


def _merge_motions(first: BodyMotion, second: BodyMotion, shared: tuple[Tensor, ...]) -> Tensor:
    """a's motions ``(1, frames, 3, 4)``; where only b knows one, b's in a's frame."""
    turn, seat, rest = shared
    own, other = first.body.motions[0], second.body.motions[0]
    rotation = turn.mT @ other[..., :3] @ seat.mT
    place = ((other[..., 3] - rest[1:4] - (other[..., :3] @ rest[4:])) @ turn) / rest[0]
    return torch.where(first.seen[:, None, None], own, torch.cat([rotation, place[..., None]], -1))[None]


def _assemble(
    seen: Overlap,
    body: FilmedBody,
    first: BodyMotion,
    second: BodyMotion,
    threshold: float | None,
    explained: float,
) -> PairReconstruction:
    n, m, frames = seen.a.shape[1], seen.b.shape[1], len(seen.times)
    kept = torch.cat([first.points, second.points])
    back = torch.stack([similarity(torch.as_tensor(one.scale).to(one.centre), -one.centre / one.scale) for one in (first, second)])
    inner = back @ body.calibrations[0]
    cameras = inner @ body.sights[0]
    placed = normalize(homogeneous(body.points_in_camera()[0]), dim=-1)
    known = first.seen | second.seen
    points = placed.new_full((frames, n + m, 4), math.nan)
    points[:, kept] = torch.where(known[:, None, None], placed, math.nan)
    both = reproject(cameras, points.nan_to_num().flatten(0, 1)).unflatten(1, (frames, n + m))
    both = torch.where(points.isnan().any(-1)[None, ..., None], math.nan, both)
    missed = torch.cat([both[0, :, :n] - seen.a, both[1, :, n:] - seen.b], 1)
    apart = missed.norm(dim=-1)
    residuals = apart.square().nanmean(0).sqrt()
    strangers = torch.cat([first.residuals, second.residuals]) * math.sqrt(2)
    residuals = torch.where(kept, residuals, torch.where(strangers.isfinite(), strangers, math.nan))
    # 1.1774: the median length of a two-dimensional error of unit variance
    sigma = float(apart[:, kept].nanmedian()) / 1.1774
    limit = MAX_RESIDUAL_SIGMAS * sigma if threshold is None else threshold
    counted = apart.isfinite()
    share = (counted & (apart <= max(limit, MIN_RELATIVE_NOISE * first.scale))).sum(0) / counted.sum(0).clamp(min=1)
    good = kept & (share >= explained)
    matches, distances = _match(both, good, n, float(apart[:, good].square().nanmean().sqrt()))
    rotation, place = body.sights[0, 1].split([3, 1], -1)
    F = torch.linalg.inv(inner[1]).mT @ skew(place[:, 0]) @ rotation @ torch.linalg.inv(inner[0])
    return PairReconstruction(
        cameras=cameras / torch.linalg.matrix_norm(cameras, keepdim=True),
        points=torch.where(good[:, None], points, math.nan),
        times=seen.times,
        source=(torch.arange(n + m, device=kept.device) >= n).long(),
        labels=good.long(),
        r2=torch.where(kept, share.double(), 0.0),
        matches=matches,
        distances=distances,
        normals=F.new_full((2, 2), math.nan),
        fundamental=F / F.norm(),
        residuals=residuals,
        residual=float(apart[:, good].square().nanmean().sqrt()),
        status=torch.tensor(int(Status.OK), device=F.device),
    )


def _match(both: Tensor, good: Tensor, n: int, residual: float) -> tuple[Tensor, Tensor]:
    """The track of a that a track of b is ``(m,)``, -1 = none, and rms distances ``(n, m)`` of all pairs in a's pixels."""
    apart = torch.stack([(x[:, :n, None] - x[:, None, n:]).square().sum(-1).nanmean(0).sqrt() for x in both])
    pairs = good[:n, None] & good[None, n:]
    distances = torch.where(pairs, apart[0], math.nan)
    worst = torch.where(pairs, apart.amax(0), math.inf)
    if not worst.numel():
        return torch.full((worst.shape[1],), -1, dtype=torch.long, device=good.device), distances
    extent = float((both[0] - both[0].nanmean(1, keepdim=True)).square().sum(-1).nanmean().sqrt())
    limit = max(MAX_ALONG_RATIO * residual, MAX_ALONG_EXTENT * extent)
    best, track = worst.min(0)
    mutual = worst.argmin(1)[track] == torch.arange(worst.shape[1], device=good.device)
    others = worst.clone()
    others[track, torch.arange(worst.shape[1], device=good.device)] = math.inf
    second = torch.minimum(others.amin(0), others[track].amin(1))
    sure = mutual & (best <= limit) & (best <= MAX_DISTANCE_RATIO * second)
    return torch.where(sure, track, -1), distances
